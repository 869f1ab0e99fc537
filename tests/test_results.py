"""The files of results/ against one another: each policy has the evaluation, curves and flights that it ships with."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import safetensors

import envs
import ppo_gtrxl_rocket
import runs

RESULTS = Path(__file__).parent.parent / "results"
SHIPPED = sorted(path.parent for path in RESULTS.glob("*/eval.json"))


def test_eight_policies_are_shipped():
    assert len(SHIPPED) == 8 and sorted(RESULTS.glob("*/agent.safetensors")) == [
        folder / "agent.safetensors" for folder in SHIPPED
    ]


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
            assert len(arrays["x"]) == 100 and len(arrays["cost"]) <= 1000
        else:
            error = np.linalg.norm(envs.terminal_error(arrays["y"][-1], envs.ROCKETS[metrics["env_id"]].rocket))
            assert error == pytest.approx(metrics["error_norm"], rel=1e-6)


def test_the_bare_rocket_command_is_the_one_of_its_result():
    args = ppo_gtrxl_rocket.Args()
    runs.fill_last_values(args)
    with safetensors.safe_open(RESULTS / "rocket_fixed" / "agent.safetensors", "pt") as file:
        shipped = json.loads(file.metadata()["args"])
    differ = {name for name, value in vars(args).items() if shipped[name] != value}
    assert differ == {"num_threads", "eval_starts", "guidance"}
    assert (args.guidance, shipped["guidance"]) == ("auto", "knots")  # auto: tests/test_ppo.py


def test_results_are_below_25_megabytes():
    assert sum(path.stat().st_size for path in RESULTS.rglob("*") if path.is_file()) < 25e6
