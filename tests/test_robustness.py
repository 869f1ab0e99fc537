"""Kills, signals, full disks, damaged files, absurd flags and actions: nothing hurts a run, each gives one line.

`benchmarks/robustness.py` does the same more often.
"""

import importlib
import json
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parent.parent
SCRIPT = ROOT / "ppo_gtrxl_di.py"


@pytest.fixture(scope="module")
def robustness():
    """The benchmark as a module that its child processes can import, too."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    yield importlib.import_module("robustness")
    sys.path.remove(str(ROOT / "benchmarks"))


# --- kills and signals ------------------------------------------------------------------------------------------------


def test_ten_kills(robustness):
    """SIGKILL at random moments and in the middle of writes: the resumed run has the uninterrupted one's bits."""
    ended = robustness.kill_and_resume(10)
    assert sum(ended.values()) == 10 and ended["in a write"] >= 3, ended


def begin(robustness, folder, *argv, limit=None):
    """A tiny endless run as a user starts it, and its folder once it has its first checkpoint."""
    command = [sys.executable, SCRIPT, *robustness.TINY, "--total-updates=100000", *argv]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(command, cwd=folder, preexec_fn=limit, **streams)
    while process.poll() is None and not list(folder.glob("runs/*/training_state.pt")):
        time.sleep(0.02)
    return process


@pytest.mark.parametrize("number, code", [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_signals_end_with_a_saved_state(robustness, tmp_path, number, code):
    process = begin(robustness, tmp_path)
    time.sleep(0.5)
    process.send_signal(number)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == code and errors == ""
    (run,) = (tmp_path / "runs").iterdir()
    done = torch.load(run / "training_state.pt", weights_only=True)["progress"]["total_updates"]
    last = output.splitlines()[-1]
    assert last == f"stopped after update {done}; go on with: python ppo_gtrxl_di.py --resume runs/{run.name}"


def test_full_disk_leaves_the_old_checkpoint(robustness, tmp_path):
    """Files may not grow beyond the first checkpoint's size when the second, with Adam's moments, is written."""
    process = begin(robustness, tmp_path)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    (run,) = (tmp_path / "runs").iterdir()
    whole = (run / "training_state.pt").read_bytes()
    if torch.load(run / "training_state.pt", weights_only=True)["progress"]["total_updates"]:
        pytest.skip("the second checkpoint was already there")
    limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (len(whole), len(whole)))  # noqa: E731
    command = [sys.executable, SCRIPT, f"--resume={run}"]
    done = subprocess.run(command, cwd=tmp_path, preexec_fn=limit, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert re.fullmatch(rf"error: \[Errno 27\] File too large: '{run}/training_state.pt'\n", done.stderr)
    assert (run / "training_state.pt").read_bytes() == whole and not list(run.glob(".*.tmp"))


# --- fuzzing ----------------------------------------------------------------------------------------------------------


def test_thousand_command_lines(robustness):
    ended = robustness.fuzz_arguments(1000)
    assert sum(ended.values()) == 1000 and min(ended["works"], ended["refused"]) > 10, ended


def test_thousand_damaged_files(robustness):
    ended = robustness.fuzz_checkpoints(1000)
    refused = ended["agent.safetensors refused"], ended["training_state.pt refused"]
    assert sum(ended.values()) == 1000 and min(refused) > 100 and sum(refused) < 1000, ended


def test_thousand_actions(robustness):
    ended = robustness.fuzz_actions(1000)
    assert sum(ended.values()) == 1000 and min(ended.values()) > 100, ended


def test_flight_of_weights_that_overflow(robustness, tmp_path, monkeypatch, capsys):
    """Finite weights whose action is not: the environment's one line, no traceback."""
    monkeypatch.chdir(tmp_path)
    script = robustness.SCRIPTS[0]
    script.main([*robustness.TINY, "--total-updates=1"])
    (run,) = Path("runs").iterdir()
    state = torch.load(run / "training_state.pt", weights_only=True)
    state["average"]["module.actor.2.weight"].fill_(3e38)
    state["average"]["module.actor.0.bias"].fill_(3e38)
    script.save_run(run, state)
    command = [sys.executable, SCRIPT, "--eval-only", f"--checkpoint={run}/agent.safetensors", "--eval-starts=10"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert re.fullmatch(r"error: action of env 0 at step 0 is \[(inf|nan|-inf)\]; it must be finite\n", done.stderr)


# --- many updates, many environments ----------------------------------------------------------------------------------


def test_soak(robustness):
    """After the first 100 of 300 tiny updates neither memory nor open files grow (benchmark: 2000)."""
    memory, files = robustness.soak(300).T
    assert memory[-1] < 1.01 * memory[99] and max(files[100:]) <= max(files[:100])  # one more now and then: the writer


@pytest.mark.parametrize("name", ["di", "rocket"])
def test_4096_environments(robustness, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    script = importlib.import_module(f"ppo_gtrxl_{name}")
    argv = [*robustness.NETWORK, "--num-envs=4096", "--num-minibatches=32", "--update-epochs=1", "--total-updates=1"]
    script.main([*argv, "--eval-starts=10", "--eval-every=0"])
    (run,) = Path("runs").iterdir()
    steps = json.loads((run / "eval.json").read_text())["global_step"]
    assert 4096 < steps <= 4096 * 481
