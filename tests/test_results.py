"""The files of results/ against one another: each policy has the evaluation, curves and flights that it ships with."""

import hashlib
import importlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
import safetensors

import envs
from benchmarks import run_seeds
from common import curves

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "results"
SHIPPED = sorted(path.parent for path in RESULTS.glob("*/eval.json"))


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_a_result_is_whole(folder):
    metrics = json.loads((folder / "eval.json").read_text())
    assert metrics["checkpoint_sha256"] == hashlib.sha256((folder / "agent.safetensors").read_bytes()).hexdigest()
    assert json.loads((folder / "seeds" / f"{metrics['seed']}.json").read_text()) == metrics
    seeds = [json.loads(path.read_text()) for path in (folder / "seeds").glob("*.json")]
    assert {(seed["env_id"], seed["total_updates"]) for seed in seeds} == {
        (metrics["env_id"], metrics["total_updates"])
    }
    assert {path.stem for path in (folder / "seeds").glob("*.csv")} == {str(seed["seed"]) for seed in seeds}
    with np.load(folder / "eval.npz") as arrays:
        if metrics["env_id"] in envs.PROBLEMS:  # the first starts alone are kept
            assert len(arrays["x"]) == 30 and len(arrays["cost"]) <= 1000
        elif metrics["env_id"] in envs.LANDERS:
            assert len(arrays["u"]) == len(arrays["y"]) == 15
        else:
            error = np.linalg.norm(envs.terminal_error(arrays["y"][-1], envs.ROCKETS[metrics["env_id"]].rocket))
            assert error == pytest.approx(metrics["error_norm"], rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_a_policy_was_trained_by_the_command_that_its_list_gives(folder, monkeypatch):
    """All arguments, those that the recipe sets, too. The command is an id and a seed, but for the GPU's."""
    monkeypatch.chdir(ROOT)  # a command names a policy of results/
    on_gpu = folder.name == "rocket_paper"
    jobs = run_seeds.read_trainings("benchmarks/trainings/gpu.txt" if on_gpu else "benchmarks/trainings/results.txt")
    (job, *_) = [job for job in jobs if job.results.name == folder.name]
    with safetensors.safe_open(folder / "agent.safetensors", "pt") as file:
        args = json.loads(file.metadata()["args"])
    script = importlib.import_module(Path(job.command[0]).stem)
    args = vars(script.Args()) | args  # a flag that came after the policy has its default
    table = vars(envs.LANDERS[args["env_id"]]) if args["env_id"] in envs.LANDERS else {}

    def given(name, value):
        return table.get(name) if value is None else value

    differ = {name for name, value in job.args.items() if given(name, args[name]) != given(name, value)}
    assert differ <= {"exp_name", "eval_starts"}
    assert on_gpu or set(job.command[1::2]) <= {"--env-id", "--dispersion", "--failure", "--seed"}


def test_held_out_runs_are_the_results_commands_with_other_seeds(monkeypatch):
    """Two a row, no seed twice; all are measured on the starts and draws of one seed that no result has."""
    monkeypatch.chdir(ROOT)
    shipped = {job.results.name: job.args for job in run_seeds.read_trainings("benchmarks/trainings/results.txt")}
    held_out = run_seeds.read_trainings("benchmarks/trainings/held_out.txt")
    assert sorted(job.results.name for job in held_out) == sorted(2 * list(shipped))
    for job in held_out:
        assert job.results.parent.name == "held_out"
        differ = {name for name, value in job.args.items() if value != shipped[job.results.name][name]}
        assert differ == {"seed", "eval_seed"}
    (eval_seed,) = {job.args["eval_seed"] for job in held_out}
    seeds = [job.args["seed"] for job in held_out]
    assert len({*seeds, eval_seed, 0}) == len(seeds) + 2 and not {*seeds, eval_seed} & {1, 2, 3, 4, 5}


def test_table_1_s_rocket_is_the_last_evaluation_of_its_curve():
    """And its table is that of all evaluations, with the sampled flights' median as it was printed then."""
    folder = RESULTS / "table_1" / "rocket"
    metrics, curve = json.loads((folder / "seeds/1.json").read_text()), curves.read_csv(folder / "seeds/1.csv")
    for key in set(metrics) - {"env_id", "device", "torch_version"}:  # a curve holds no words
        assert curve[f"eval/{key}"][1][-1] == pytest.approx(float(metrics[key]), rel=5e-6), key
    sampled = dict(re.findall(r"update (\d+)/.* sampled error (\S+)  mean", (folder / "training.log").read_text()))
    updates, seconds, misses, perigees = (
        curve[f"eval/{key}"][1] for key in ("total_updates", "training_seconds", "error_norm", "perigee_km")
    )
    returns = curve["charts/episodic_return"][1][updates.astype(int) - 1]
    expected = [
        f"| {n:.0f} | {s / 60:.1f} | {g:.2f} | {float(sampled[f'{n:.0f}']):.3f} | {miss:.3f} | {perigee:.0f} |"
        for n, s, g, miss, perigee in zip(updates, seconds, returns, misses, perigees, strict=True)
    ]
    page = (folder / "README.md").read_text().replace("−", "-").splitlines()
    assert [line for line in page if re.match(r"\| \d", line)] == expected


def test_every_file_of_the_results_is_below_40_megabytes():
    assert max(path.stat().st_size for path in RESULTS.rglob("*") if path.is_file()) < 40e6
