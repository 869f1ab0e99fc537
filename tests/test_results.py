"""The files of results/ against one another: each policy has the evaluation, curves and flights that it ships with."""

import hashlib
import importlib
import json
from pathlib import Path

import numpy as np
import pytest
import safetensors

import envs
from benchmarks import run_seeds
from common.schedule import Schedule

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
        if isinstance(getattr(script.Args, name, None), Schedule):  # two ways to write a jump are one schedule
            return Schedule(value).over(args["total_updates"]).tolist()
        return table.get(name) if value is None else value

    differ = {name for name, value in job.args.items() if given(name, args[name]) != given(name, value)}
    assert differ <= {"exp_name", "eval_starts"}
    assert on_gpu or set(job.command[1::2]) <= {"--env-id", "--dispersion", "--failure", "--seed"}
