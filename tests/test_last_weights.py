"""`benchmarks.last_weights`: columns that must agree and differ, the flags of a run, and what is refused."""

import importlib
import sys

import pytest
import torch

from benchmarks import last_weights
from benchmarks.robustness import TINY
from common.evaluations import read_json

pytestmark = pytest.mark.slow


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Train three tiny updates whose weights are averaged by this decay; returns the run's folder."""

    def train(decay):
        monkeypatch.chdir(tmp_path)
        importlib.import_module("ppo_gtrxl_di").main([*TINY, "--total-updates=3", f"--weight-average={decay}"])
        (folder,) = tmp_path.glob("runs/*")
        return folder

    return train


def test_without_averaging_both_columns_are_the_evaluation(run, capsys):
    folder = run(0.0)
    capsys.readouterr()
    title, head, *rows = last_weights.table(folder)
    assert str(folder) in title and head.split() == ["averaged", "last"]
    assert rows and all(row.split()[-1] == row.split()[-2] for row in rows)
    metrics, last = read_json(folder / "eval.json"), last_weights.last_weights_flown(folder)
    assert last["eval_starts"] == metrics["eval_starts"] and last["cost_mean"] == metrics["cost_mean"]


def test_averaged_and_last_weights_fly_differently(run):
    folder = run(0.9)
    assert last_weights.last_weights_flown(folder)["cost_mean"] != read_json(folder / "eval.json")["cost_mean"]


def test_the_flags_are_those_that_a_file_of_weights_does_not_decide():
    args = {"eval_seed": 3, "eval_starts": 20, "dispersion": 1.0, "failure": 0.0, "navigation_noise": [10.0, 0.1]}
    args |= {"failure_time": "random", "seed": 7}
    assert last_weights.flags_of(args) == {
        **{"eval-seed": 3, "eval-starts": 20, "dispersion": 1.0, "failure": 0.0, "navigation-noise": "10.0 0.1"}
    }
    assert last_weights.flags_of({"eval_seed": 0, "navigation_noise": None}) == {"eval-seed": 0}


def test_a_damaged_run_gets_one_line(run, monkeypatch):
    folder = run(0.0)
    state = torch.load(folder / "training_state.pt", weights_only=True)
    for damage in (b"", None):
        if damage is None:
            del state["agent"]
            torch.save(state, folder / "training_state.pt")
        else:
            (folder / "training_state.pt").write_bytes(damage)
        monkeypatch.setattr(sys, "argv", ["last_weights.py", str(folder)])
        with pytest.raises(SystemExit) as end:
            last_weights.main()
        assert str(end.value).startswith(f"error: {folder} must hold a run's training_state.pt")
        assert "\n" not in str(end.value)
