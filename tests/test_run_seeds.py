"""`benchmarks/run_seeds.py`: skips what is finished, goes on with what was cut, publishes, reports what failed."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import run_seeds

import evaluate

ROOT = Path(__file__).parent.parent
TINY = "--embed-dim 8 --num-heads 2 --num-blocks 1 --memory-length 4 --mlp-dim 8 --hidden-dim 8 --num-envs 2"
TINY += " --num-minibatches 2 --update-epochs 2 --eval-starts 10 --num-threads 1"


def start(folder, lines):
    (folder / "jobs.txt").write_text("\n".join(lines))
    command = [sys.executable, ROOT / "benchmarks" / "run_seeds.py", "jobs.txt", "--at-once", "2", "--numbers"]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_run_seeds_survives_a_restart(tmp_path):
    """Two seeds, interrupted once both train; the second start goes on with both, the third has nothing to do."""
    lines = [f"results/tiny ppo_gtrxl_di.py --seed {seed} --total-updates 150 {TINY}  # seed {seed}" for seed in (1, 2)]
    first = start(tmp_path, ["# two seeds", "", *lines])
    while first.poll() is None and len(list(tmp_path.glob("runs/*/training_state.pt"))) < 2:
        time.sleep(0.02)
    first.send_signal(signal.SIGINT)
    first.communicate(timeout=60)
    assert first.returncode == 130 and not list(tmp_path.glob("runs/*/eval.json"))
    second = start(tmp_path, lines)
    output, errors = second.communicate(timeout=120)
    assert second.returncode == 0, errors
    assert "2 jobs, 0 trained already" in output and output.count("ended with 0") == 2
    assert len(list(tmp_path.glob("runs/*/"))) == 2  # resumed, not begun anew
    assert {path.name for path in tmp_path.glob("results/tiny/*")} == {
        "seeds"
    }  # --numbers: neither weights nor figures
    seeds = {path.stem: json.loads(path.read_text()) for path in (tmp_path / "results/tiny/seeds").glob("*.json")}
    assert {name: metrics["total_updates"] for name, metrics in seeds.items()} == {"1": 150, "2": 150}
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("results/**/*")}
    third = start(tmp_path, lines)
    output, _ = third.communicate(timeout=60)
    assert third.returncode == 0 and output == "2 jobs, 2 trained already\n"
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("results/**/*")} == before


@pytest.mark.parametrize("line", ["results/tiny", "results/tiny nothing.py --seed 1", "results/tiny README.md"])
def test_lines_that_are_no_job(tmp_path, line):
    process = start(tmp_path, [line])
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1 and errors.startswith("error: jobs.txt, line 1: ") and errors.count("\n") == 1


def test_a_job_with_a_bad_flag_stops_before_any_training(tmp_path):
    process = start(tmp_path, [f"results/tiny ppo_gtrxl_di.py {TINY}", "results/tiny ppo_gtrxl_di.py --gamma 7"])
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1 and "--gamma 7.0: must be between 0.0 and 1.0" in errors
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("seed, replaces", [(1, True), (2, False)])
def test_a_new_run_of_the_shipped_seed_replaces_what_is_shipped(tmp_path, monkeypatch, seed, replaces):
    run, results, published = tmp_path / "run", tmp_path / "results", []
    for folder, shipped in ((run, seed), (results, 1)):
        folder.mkdir()
        (folder / "eval.json").write_text(json.dumps({"env_id": "VanDerPol-v0", "seed": shipped}))
    monkeypatch.setattr(run_seeds.Job, "run_dir", lambda job: run)
    monkeypatch.setattr(evaluate, "publish", lambda *args, **options: published.append((args, options)))
    run_seeds.Job(results, [], {"seed": seed}).publish(numbers=False)
    assert published == [((run, results), {"ship": replaces, "numbers": False})]
