"""The ground: agent.safetensors in bfloat16 against torch's own rounding, and jobs that are shared out."""

import hashlib
import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import types
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

import evaluate
from common import interrupts, ipopt
from common.checkpoints import LARGE, read_checkpoint, write_bfloat16
from common.errors import NoOptimum
from common.workers import Workers

ROOT = Path(__file__).parent.parent


def test_large_weights_become_bfloat16(tmp_path):
    """Every kind of float32: the file's bits are torch's, small tensors and metadata stay."""
    torch.manual_seed(0)
    bits = torch.randint(-(2**31), 2**31 - 1, (300, 500), dtype=torch.int64).to(torch.int32)
    large = bits.view(torch.float32)
    large[~large.isfinite() | (large.abs() > 1e38)] = 1.0
    large[0, :4] = torch.tensor([0.0, -0.0, 1.00390625, 1.01171875])  # the last two lie between two bfloat16
    tensors = {"large": large, "small": torch.randn(LARGE - 1), "rows": torch.arange(4)}
    counters = {"seed": 3, "total_updates": 4, "global_step": 5, "training_seconds": 6.0, "wall_seconds": 7.0}
    metadata = {"args": json.dumps({"env_id": "X-v0"}), **{name: str(value) for name, value in counters.items()}}
    source, target = tmp_path / "agent.safetensors", tmp_path / "short.safetensors"
    safetensors.torch.save_file(tensors, source, metadata)

    write_bfloat16(source, target)
    written = safetensors.torch.load_file(target)
    assert torch.equal(written["large"].view(torch.int16), large.to(torch.bfloat16).view(torch.int16))
    assert torch.equal(written["small"], tensors["small"]) and torch.equal(written["rows"], tensors["rows"])

    found = read_checkpoint(target)
    assert found["args"] == {"env_id": "X-v0"} and found["counters"] == counters
    assert found["tensors"]["large"].dtype == np.float32
    np.testing.assert_array_equal(found["tensors"]["large"], large.to(torch.bfloat16).float().numpy())
    np.testing.assert_array_equal(found["tensors"]["small"], tensors["small"].numpy())
    assert target.stat().st_size < source.stat().st_size * 0.6


@pytest.mark.slow
def test_a_shorter_policy_is_flown_anew(tmp_path, monkeypatch):
    """With tensors of 2000 numbers rounded the rocket still arrives, a little off; its run folder is left alone."""
    run = tmp_path / "run"
    run.mkdir()
    shutil.copy(ROOT / "results" / "rocket_cutoff" / "agent.safetensors", run)
    monkeypatch.setattr("common.checkpoints.LARGE", 2000)
    shorter = evaluate.shorten(run)
    metrics = json.loads((shorter / "eval.json").read_text())
    sha256 = hashlib.sha256((shorter / "agent.safetensors").read_bytes()).hexdigest()
    assert metrics["checkpoint_sha256"] == sha256
    assert 1e-6 < metrics["error_norm"] < 0.01 and metrics["success"]
    assert (shorter / "eval.npz").exists()
    assert {path.name for path in run.iterdir()} == {"agent.safetensors", "bfloat16"}


def test_a_shorter_policy_flies_the_starts_of_its_run(tmp_path, monkeypatch):
    run = tmp_path / "run"
    run.mkdir()
    shutil.copy(ROOT / "results" / "rocket_cutoff" / "agent.safetensors", run)
    flags = {"eval_seed": 273427, "eval_starts": 7, "dispersion": 1.0, "failure": 0.2, "navigation_noise": [10.0, 0.1]}
    held_out = lambda *words, **flag: {"args": flags}  # noqa: E731
    monkeypatch.setattr(evaluate, "read_checkpoint", held_out)
    flown = []
    refused = types.SimpleNamespace(returncode=1, stderr="not flown")
    monkeypatch.setattr("common.policies.subprocess.run", lambda command, **_: flown.extend(command) or refused)
    with pytest.raises(ValueError, match="not flown"):
        evaluate.shorten(run)
    assert {"--eval-seed=273427", "--eval-starts=7", "--dispersion=1.0", "--failure=0.2"} <= set(flown)
    assert "--navigation-noise=10.0 0.1" in flown


def about(job):
    """A job's square, who did it, and that process's limit of a solve."""
    return job**2, os.getpid(), ipopt.limit["seconds"]


@pytest.mark.parametrize("number", [1, 2])
def test_jobs_come_back_in_order(number, monkeypatch):
    monkeypatch.setitem(ipopt.limit, "seconds", 7)
    with Workers(number) as workers:
        for jobs in ([], [3], list(range(21))):
            done = workers.map(about, jobs)
            assert [square for square, *_ in done] == [job**2 for job in jobs]
            assert all(limit == 7 for *_, limit in done)
    here = {process == os.getpid() for _, process, _ in done}
    assert here == {number == 1}


def test_closed_workers_do_nothing_more():
    workers = Workers(2)
    workers.close()
    with pytest.raises(RuntimeError, match="after shutdown"):
        workers.map(about, [1])


def children():
    """The process ids of this process's children that solve."""
    return [process.pid for process in multiprocessing.active_children()]


def test_a_lost_worker_is_one_line():
    with Workers(2) as workers:
        workers.map(abs, [1, 2])
        threading.Timer(0.2, lambda: os.kill(children()[0], signal.SIGKILL)).start()
        with pytest.raises(NoOptimum, match="^a process that solves is lost"):
            workers.map(time.sleep, [60, 60])


def test_an_error_ends_the_workers_at_once():
    began = time.monotonic()
    with pytest.raises(ZeroDivisionError), Workers(2) as workers:
        workers.map(abs, [1, 2])
        workers.pool.submit(time.sleep, 60)
        raise ZeroDivisionError
    assert time.monotonic() - began < 30 and not children()


def test_workers_end_with_the_process_that_is_killed(tmp_path):
    """The script has no guard of its main part, which a worker must not run again."""
    script = """
import os, time
from common.workers import Workers
workers = Workers(2)
print(*set(workers.map(os.getpgid, [0] * 8)), flush=True)
workers.map(time.sleep, [60, 60])
"""
    path = tmp_path / "unguarded.py"
    path.write_text(script)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(path)]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout.readline() == f"{process.pid}\n"
    process.kill()
    process.stdout.read()  # ends when no process holds the stream
    process.wait()


def test_a_second_signal_does_not_interrupt(monkeypatch):
    monkeypatch.setattr(interrupts, "came", [])
    monkeypatch.setattr(interrupts, "state", {"last": -interrupts.GRACE, "is_saving": False})
    monkeypatch.setattr(interrupts.time, "monotonic", lambda: now)
    now = 10.0
    with pytest.raises(KeyboardInterrupt):
        interrupts.interrupt(signal.SIGTERM, None)
    interrupts.interrupt(signal.SIGINT, None)
    now = 20.0
    with interrupts.uninterrupted():
        interrupts.interrupt(signal.SIGINT, None)
    with pytest.raises(KeyboardInterrupt):  # Python may have lost the first one
        interrupts.interrupt(signal.SIGINT, None)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    with pytest.raises(SystemExit) as end:
        interrupts.leave()
    assert end.value.code == 143
