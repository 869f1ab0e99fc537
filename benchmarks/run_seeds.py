"""Train a list of runs, some at a time, and publish them. Finished runs are skipped, and interrupted ones go on.

    python benchmarks/run_seeds.py jobs.txt [--at-once 2] [--numbers]

Each line of jobs.txt is a results folder and the command that trains for it; empty lines and # comments are skipped:

    results/my_di  ppo_gtrxl_di.py --seed 1 --num-threads 1
    results/my_di  ppo_gtrxl_di.py --seed 2 --num-threads 1

With --numbers the results folders get only evaluations and curves, no weights and no figures.

A run in runs/ belongs to a line if it has the same arguments. So after a power cut the same command does the rest. Each
run's output is added to a log in runs/, named after its folder and seed. The exit status is 1 if a run failed or could
not be published. The other runs go on. Ctrl-C and SIGTERM also end the runs, which save their state.
"""

from __future__ import annotations

import functools
import importlib
import json
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
import evaluate  # noqa: E402
import runs  # noqa: E402
from common.command_line import OneLineParser, integer  # noqa: E402
from common.evaluations import read_json  # noqa: E402
from common.flags import plain_args  # noqa: E402

SCRIPTS = sorted(path.name for path in ROOT.glob("ppo_gtrxl_*.py"))
MACHINE = ("cuda", "num_threads", "resume")  # arguments that another start may change


@dataclass
class Job:
    results: Path  # the folder to which it is published
    command: list[str]  # script and flags
    args: dict  # the script's arguments with these flags

    def identity(self):
        """The arguments that tell this job's run from others."""
        return {name: value for name, value in self.args.items() if name not in MACHINE}

    def run_dir(self):
        """The newest run in runs/ that has the arguments of this job, or None."""
        mine = self.identity()
        for path in sorted(Path("runs").glob("*/args.json"), key=lambda path: path.stat().st_mtime, reverse=True):
            others = read_args(path)
            if mine == {name: value for name, value in others.items() if name not in MACHINE}:
                return path.parent
        return None

    def is_trained(self):
        """Whether it has a whole evaluation, with eval.json, which is written last, and eval.npz."""
        run = self.run_dir()
        return run is not None and all((run / name).exists() for name in ("eval.json", "eval.npz"))

    def start(self):
        """Begin the job, or go on with its saved run."""
        run = self.run_dir()
        script, *flags = self.command
        if run is not None and (run / "training_state.pt").exists():
            flags = ["--resume", str(run), "--num-threads", str(self.args["num_threads"])]
        Path("runs").mkdir(exist_ok=True)
        with open(f"runs/{'_'.join(self.results.parts[-2:])}_seed_{self.args['seed']}.log", "a") as log:
            return subprocess.Popen([sys.executable, ROOT / script, *flags], stdout=log, stderr=subprocess.STDOUT)

    def publish(self, numbers):
        """Add the run, or only its numbers, to its results folder, unless all of it is there already.

        The shipped policy is replaced if it is of another run of this seed. Raises OSError or ValueError that says what
        is missing.
        """
        run = self.run_dir()
        shipped = self.results / "eval.json"
        if run is None:
            raise ValueError("runs/ holds no run with these arguments")
        ship = shipped.exists() and read_json(shipped)["seed"] == self.args["seed"]
        ships = not numbers and (ship or not shipped.exists())  # an empty folder ships the first run
        if not self.has_numbers(run) or (ships and not self.is_shipped(run)):
            evaluate.publish(run, self.results, ship=ship, numbers=numbers)

    def has_numbers(self, run):
        """Whether its results folder has this run's evaluation among its seeds."""
        return same(run / "eval.json", self.results / "seeds" / f"{self.args['seed']}.json")

    def is_shipped(self, run):
        """Whether its results folder ships this run, with policy and figures."""
        there = all((self.results / name).exists() for name in ("agent.safetensors", "eval.npz", "figures"))
        return there and same(run / "eval.json", self.results / "eval.json")


def same(path, other):
    """Whether the second file is there and has the bytes of the first."""
    return other.exists() and other.read_bytes() == path.read_bytes()


def read_args(path):
    """A run's arguments, {} for a damaged file. This is printed, because the file may be that of any run."""
    try:
        args = json.loads(path.read_text())
        if not isinstance(args, dict):
            raise ValueError("it holds no arguments")
        return args
    except (OSError, ValueError) as error:
        print_once(f"{path} is skipped, a job of this run begins anew: {error}")
        return {}


@functools.cache
def print_once(line):
    print(line, flush=True)


def read_jobs(path):
    """The jobs of a file. Raises ValueError that names a line which is no job."""
    jobs = []
    for number, line in enumerate(Path(path).read_text().splitlines(), start=1):
        try:
            words = shlex.split(line, comments=True)
            if words:
                jobs.append(read_job(words))
        except (OSError, ValueError, SystemExit) as error:
            raise ValueError(f"{path}, line {number}: {str(error).removeprefix('error: ')}") from error
    return jobs


def read_job(words):
    """The job of a line. Raises ValueError, OSError or SystemExit that says why it is none."""
    if len(words) < 2 or words[1] not in SCRIPTS:
        raise ValueError(f"{shlex.join(words)!r} must be a results folder, one of {', '.join(SCRIPTS)} and its flags")
    results, script, *flags = words
    kind = importlib.import_module(Path(script).stem)
    if {"--help", "-h"} & set(flags):
        raise ValueError("--help trains nothing")
    args, _ = runs.parse_args(kind, flags)
    if args.eval_only or not args.save_model:
        raise ValueError(f"{'--eval-only' if args.eval_only else '--no-save-model'} leaves no run to publish")
    return Job(Path(results), [script, *flags], plain_args(args))


def publish(job, numbers):
    """Publish a job's run. Returns whether that worked. A failure prints a line, and the other jobs go on."""
    try:
        job.publish(numbers)
    except (OSError, ValueError) as error:
        print(f"not published: {shlex.join(job.command)}: {error}", flush=True)
        return False
    return True


def next_free(waiting, running):
    """The first waiting job that has other arguments than the running jobs, and so another run. None without one."""
    busy = [job.identity() for job in running]
    return next((job for job in waiting if job.identity() not in busy), None)


def work(jobs, at_once, numbers):
    """Train the jobs, `at_once` at a time, and publish each when it ends. Returns those that failed."""
    waiting = [job for job in jobs if not job.is_trained()]
    running = []
    print(f"{len(jobs)} jobs, {len(jobs) - len(waiting)} trained already", flush=True)
    failed = [job for job in jobs if job not in waiting and not publish(job, numbers)]
    try:
        while waiting or running:
            while len(running) < at_once and (job := next_free(waiting, [job for job, _ in running])):
                waiting.remove(job)
                running.append((job, job.start()))
                print(f"started {shlex.join(job.command)}", flush=True)
            time.sleep(0.2)
            for job, process in [pair for pair in running if pair[1].poll() is not None]:
                running.remove((job, process))
                print(f"ended with {process.returncode}: {shlex.join(job.command)}", flush=True)
                if process.returncode or not publish(job, numbers):
                    failed.append(job)
    finally:
        for _, process in running:
            process.terminate()  # saves its state
        for _, process in running:
            process.wait()
    return failed


def main():
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell sets it to be ignored in the background
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that `work` ends the runs that it has started
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("jobs", help="file with one run a line")
    parser.add_argument("--at-once", type=integer(1, 64), default=1, help="number of runs at a time")
    parser.add_argument("--numbers", action="store_true", help="publish evaluations and curves, no policies")
    options = parser.parse_args()
    try:
        sys.exit(1 if work(read_jobs(options.jobs), options.at_once, options.numbers) else 0)
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
