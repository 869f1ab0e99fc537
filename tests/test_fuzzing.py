"""Damaged files, absurd flags and actions: each works or gives one line.

`benchmarks.robustness` tries many more.
"""

import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import runs

pytestmark = pytest.mark.slow


def test_hundreds_of_command_lines(robustness):
    ended = robustness.command_lines(300)
    assert sum(ended.values()) == 300 and min(ended["works"], ended["refused"]) > 3, ended


def test_hundreds_of_damaged_files(robustness):
    ended = robustness.damaged_files(300)
    refused = ended["agent.safetensors refused"], ended["training_state.pt refused"]
    assert sum(ended.values()) == 300 and min(refused) > 30 and sum(refused) < 300, ended


def test_hundreds_of_actions(robustness):
    ended = robustness.actions(300)
    assert sum(ended.values()) == 300 and min(ended.values()) > 30, ended


def test_flight_of_weights_that_overflow(robustness, tmp_path, monkeypatch, capsys):
    """Finite weights whose action is not: the environment's one line, no traceback."""
    monkeypatch.chdir(tmp_path)
    script = importlib.import_module("ppo_gtrxl_di")
    script.main([*robustness.TINY, "--total-updates=1"])
    (run,) = Path("runs").iterdir()
    state = torch.load(run / "training_state.pt", weights_only=True)
    state["average"]["module.actor.2.weight"].fill_(3e38)
    state["average"]["module.actor.0.bias"].fill_(3e38)
    runs.save_run(run, state)
    flags = ["--eval-only", f"--checkpoint={run}/agent.safetensors", "--eval-starts=10"]
    command = [sys.executable, script.__file__, *flags]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert re.fullmatch(r"error: action of env 0 at step 0 is \[(inf|nan|-inf)\]; it must be finite\n", done.stderr)
