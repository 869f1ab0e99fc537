"""`benchmarks.run_seeds`: skips what is finished, goes on with what was cut, publishes, reports what failed."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import evaluate
from benchmarks import run_seeds

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent
TINY = "--embed-dim 8 --num-heads 2 --num-blocks 1 --memory-length 4 --mlp-dim 8 --hidden-dim 8 --num-envs 2"
TINY += " --num-minibatches 2 --update-epochs 2 --eval-starts 10 --recipe paper"


def start(folder, lines):
    (folder / "jobs.txt").write_text("\n".join(lines))
    command = [sys.executable, "-m", "benchmarks.run_seeds", "jobs.txt", "--at-once", "2", "--numbers"]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, **streams)


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_run_seeds_survives_a_restart(tmp_path, monkeypatch, capsys, signum):
    """A seed is stopped and saved; the second start goes on with it, the third has nothing to do."""
    lines = ["# one seed", "", f"results/tiny ppo_gtrxl_di.py --seed 1 --total-updates 60 {TINY}  # seed 1"]
    process, log = start(tmp_path, lines), tmp_path / "runs" / "results_tiny_seed_1.log"
    while process.poll() is None and not (log.exists() and "update 1/60" in log.read_text()):
        time.sleep(0.02)
    process.send_signal(signum)
    process.communicate(timeout=60)
    assert process.returncode == 128 + signum and not list(tmp_path.glob("runs/*/eval.json"))
    assert "stopped after update" in log.read_text(), "what it started, it ended"
    if signum == signal.SIGTERM:
        return
    second = start(tmp_path, lines)
    output, errors = second.communicate(timeout=120)
    assert second.returncode == 0, errors
    assert "1 trainings, 0 done already" in output and output.count("ended with 0") == 1
    (folder,) = tmp_path.glob("runs/*/")  # resumed, not begun anew
    # --numbers: neither weights nor figures
    assert [path.name for path in tmp_path.glob("results/tiny/*")] == ["seeds"]
    assert json.loads((tmp_path / "results/tiny/seeds/1.json").read_text())["total_updates"] == 60
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("results/**/*")}
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    assert run_seeds.work(run_seeds.read_trainings("jobs.txt"), 2, numbers=True) == []
    assert capsys.readouterr().out == "1 trainings, 1 done already\n"
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("results/**/*")} == before


def test_a_run_is_trained_once_its_evaluation_is_whole(tmp_path, monkeypatch):
    monkeypatch.setattr(run_seeds.Training, "run_dir", lambda job: tmp_path)
    job = run_seeds.Training(tmp_path, [], {})
    (tmp_path / "eval.json").touch()
    assert not job.is_trained()
    (tmp_path / "eval.npz").touch()
    assert job.is_trained()


def published_folder(tmp_path, shipped, *missing):
    """A run of seed 1, and a results folder that has it and ships the run of seed `shipped`, but for some files."""
    run, results = tmp_path / "run", tmp_path / "results"
    (results / "seeds").mkdir(parents=True)
    run.mkdir()
    text = {seed: json.dumps({"env_id": "VanDerPol-v0", "seed": seed, "of": "this run"}) for seed in (1, 2)}
    (run / "eval.json").write_text(text[1])
    for name in {"seeds/1.json", "agent.safetensors", "eval.npz", "figures", "eval.json"} - {*missing}:
        (results / name).write_text(text[shipped] if name == "eval.json" else text[1])
    return run, results


@pytest.mark.parametrize(
    "shipped, missing, numbers, again",
    [
        (1, [], False, None),
        (1, ["seeds/1.json"], False, True),
        (1, ["agent.safetensors"], False, True),
        (1, ["figures"], False, True),
        (1, ["eval.json", "agent.safetensors", "eval.npz", "figures"], False, False),  # nothing is shipped yet
        (1, ["agent.safetensors", "figures"], True, None),
        (1, ["eval.json", "agent.safetensors", "eval.npz", "figures"], True, None),
        (2, ["agent.safetensors", "figures"], False, None),  # another seed's affair
        (2, ["seeds/1.json"], False, False),
    ],
)
def test_what_is_missing_of_a_published_run_is_published(tmp_path, monkeypatch, shipped, missing, numbers, again):
    """`again` is whether with `ship`, None if not at all."""
    run, results = published_folder(tmp_path, shipped, *missing)
    published = []
    monkeypatch.setattr(run_seeds.Training, "run_dir", lambda job: run)
    monkeypatch.setattr(evaluate, "publish", lambda *folders, **options: published.append(options["ship"]))
    run_seeds.Training(results, [], {"seed": 1}).publish(numbers)
    assert published == ([] if again is None else [again])


class Trained:
    """A job that is trained already, or by a process that ends at once, and may not be publishable."""

    def __init__(self, name, trained, error=None):
        self.command, self.trained, self.error, self.published = [name], trained, error, False

    def is_trained(self):
        return self.trained

    def identity(self):
        return self.command

    def start(self):
        return subprocess.Popen([sys.executable, "-c", ""])

    def publish(self, numbers):
        if self.error:
            raise self.error
        self.published = True


@pytest.mark.parametrize("trained", [True, False])
def test_what_cannot_be_published_fails_alone(capsys, trained):
    jobs = [
        Trained("first", trained, ValueError("results/x is of another problem")),
        Trained("second", trained, OSError(28, "No space left on device", "results/x/eval.npz")),
        Trained("third", trained),
        Trained("last", False),
    ]
    assert run_seeds.work(jobs, 1, False) == jobs[:2]
    assert [job.published for job in jobs] == [False, False, True, True]
    failed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("not published")]
    assert failed == [
        "not published: first: results/x is of another problem",
        "not published: second: [Errno 28] No space left on device: 'results/x/eval.npz'",
    ]


def test_two_jobs_never_go_on_with_one_run():
    """A folder of its own does not make a job another run: it waits for the one with its arguments."""
    here, there = (run_seeds.Training(Path("results/a"), [], {"seed": seed}) for seed in (1, 2))
    again = run_seeds.Training(Path("results/b"), [], {"seed": 1, "num_threads": 2})
    assert run_seeds.next_free([again, there], [here]) is there and run_seeds.next_free([again], [there]) is again
    assert run_seeds.next_free([again], [here, there]) is None


@pytest.mark.parametrize("seed, replaces", [(1, True), (2, False)])
def test_a_new_run_of_the_shipped_seed_replaces_what_is_shipped(tmp_path, monkeypatch, seed, replaces):
    run, results, published = tmp_path / "run", tmp_path / "results", []
    for folder, shipped in ((run, seed), (results, 1)):
        folder.mkdir()
        (folder / "eval.json").write_text(json.dumps({"env_id": "VanDerPol-v0", "seed": shipped}))
    monkeypatch.setattr(run_seeds.Training, "run_dir", lambda job: run)
    monkeypatch.setattr(evaluate, "publish", lambda *args, **options: published.append((args, options)))
    run_seeds.Training(results, [], {"seed": seed}).publish(numbers=False)
    assert published == [((run, results), {"ship": replaces, "numbers": False, "replace": True})]
