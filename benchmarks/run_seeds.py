"""Train a list of runs, some at a time; what is finished is skipped, what was cut goes on, and all is published.

    python benchmarks/run_seeds.py jobs.txt [--at-once 2] [--numbers]

Each line of jobs.txt is a results folder and the command that trains for it; empty lines and # comments are skipped:

    results/rocket_fixed  ppo_gtrxl_rocket.py --seed 1 --num-threads 1 --guidance knots
    results/rocket_fixed  ppo_gtrxl_rocket.py --seed 2 --num-threads 1 --guidance knots

With --numbers the results folders get the evaluations and curves alone: no weights, no figures.

A run in runs/ belongs to a line if it has the same arguments, so nothing else is kept: start it again after a power
cut and it does the rest. Each run's output is added to runs/<its name>.log. Exit status 1 if a run failed.
"""

from __future__ import annotations

import argparse
import importlib
import json
import shlex
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
import evaluate  # noqa: E402
import runs  # noqa: E402

MACHINE = ("cuda", "num_threads", "resume")  # arguments that another start may change


@dataclass
class Job:
    results: Path  # the folder that it is published to
    command: list[str]  # script and flags
    args: dict  # the script's arguments that follow from them

    def run_dir(self):
        """The newest run in runs/ that has the arguments of this job, or None."""
        mine = {name: value for name, value in self.args.items() if name not in MACHINE}
        for path in sorted(Path("runs").glob("*/args.json"), key=lambda path: path.stat().st_mtime, reverse=True):
            theirs = json.loads(path.read_text())
            if mine == {name: value for name, value in theirs.items() if name not in MACHINE}:
                return path.parent
        return None

    def is_trained(self):
        return (run := self.run_dir()) is not None and (run / "eval.json").exists()

    def start(self):
        """Begin it, or go on with it where a run of it was saved."""
        run, (script, *flags) = self.run_dir(), self.command
        if run is not None and (run / "training_state.pt").exists():
            flags = ["--resume", str(run), "--num-threads", str(self.args["num_threads"])]
        Path("runs").mkdir(exist_ok=True)
        with open(f"runs/{self.results.name}_seed_{self.args['seed']}.log", "a") as log:
            return subprocess.Popen([sys.executable, ROOT / script, *flags], stdout=log, stderr=subprocess.STDOUT)

    def publish(self, numbers):
        """Add the run, or its numbers alone, to its results folder, unless it is there already.

        What the folder ships is replaced if it is another run of this seed.
        """
        run, seed, shipped = self.run_dir(), self.args["seed"], self.results / "eval.json"
        published = self.results / "seeds" / f"{seed}.json"
        if not published.exists() or published.read_bytes() != (run / "eval.json").read_bytes():
            ship = shipped.exists() and evaluate.read_json(shipped)["seed"] == seed
            evaluate.publish(run, self.results, ship=ship, numbers=numbers)


def read_jobs(path):
    """The jobs of a file; SystemExit names the line that cannot be one."""
    jobs = []
    for number, line in enumerate(Path(path).read_text().splitlines(), start=1):
        if not (words := shlex.split(line, comments=True)):
            continue
        results, script, *flags = [*words, ""] if len(words) < 2 else words
        if not (script.endswith(".py") and (ROOT / script).is_file()):
            sys.exit(f"error: {path}, line {number}: {line!r} must be a results folder, a script and its flags")
        kind = importlib.import_module(Path(script).stem)
        args, _ = runs.parse_args(kind.Args, flags, kind.ENV_OPTIONS, kind.BUFFERS)
        jobs.append(Job(Path(results), [script, *flags], asdict(args)))
    return jobs


def work(jobs, at_once, numbers):
    """Train the jobs, `at_once` at a time, and publish each as it ends; returns those that failed."""
    waiting, running, failed = [job for job in jobs if not job.is_trained()], [], []
    print(f"{len(jobs)} jobs, {len(jobs) - len(waiting)} trained already", flush=True)
    for job in jobs:
        job.publish(numbers) if job not in waiting else None
    try:
        while waiting or running:
            while waiting and len(running) < at_once:
                job = waiting.pop(0)
                running.append((job, job.start()))
                print(f"started {shlex.join(job.command)}", flush=True)
            time.sleep(0.2)
            for job, process in [pair for pair in running if pair[1].poll() is not None]:
                running.remove((job, process))
                print(f"ended with {process.returncode}: {shlex.join(job.command)}", flush=True)
                job.publish(numbers) if process.returncode == 0 else failed.append(job)
    finally:
        for _, process in running:
            process.terminate()  # saves its state
        for _, process in running:
            process.wait()
    return failed


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("jobs", help="file with one run a line")
    parser.add_argument("--at-once", type=int, default=1, help="number of runs at a time")
    parser.add_argument("--numbers", action="store_true", help="publish evaluations and curves, no policies")
    options = parser.parse_args()
    try:
        sys.exit(1 if work(read_jobs(options.jobs), max(1, options.at_once), options.numbers) else 0)
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
