"""Train a list of runs, some at a time; what is finished is skipped, what was cut goes on, and all is published.

    python benchmarks/run_seeds.py jobs.txt [--at-once 2] [--numbers]

Each line of jobs.txt is a results folder and the command that trains for it; empty lines and # comments are skipped:

    results/my_di  ppo_gtrxl_di.py --seed 1 --num-threads 1
    results/my_di  ppo_gtrxl_di.py --seed 2 --num-threads 1

With --numbers the results folders get the evaluations and curves alone: no weights, no figures.

A run in runs/ belongs to a line if it has the same arguments, so nothing else is kept: start it again after a power
cut and it does the rest. Each run's output is added to a log in runs/, named after its folder and seed. Exit status 1
if a run failed or could not be published; the others go on. Ctrl-C and SIGTERM end the runs, too, which are saved.
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
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
import evaluate  # noqa: E402
import runs  # noqa: E402
from common.command_line import OneLineParser, integer  # noqa: E402
from common.evaluations import read_json  # noqa: E402

SCRIPTS = sorted(path.name for path in ROOT.glob("ppo_gtrxl_*.py"))
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
            theirs = read_args(path)
            if mine == {name: value for name, value in theirs.items() if name not in MACHINE}:
                return path.parent
        return None

    def is_trained(self):
        """Whether its evaluation is whole: eval.json is written after eval.npz."""
        run = self.run_dir()
        return run is not None and all((run / name).exists() for name in ("eval.json", "eval.npz"))

    def start(self):
        """Begin it, or go on with it where a run of it was saved."""
        run, (script, *flags) = self.run_dir(), self.command
        if run is not None and (run / "training_state.pt").exists():
            flags = ["--resume", str(run), "--num-threads", str(self.args["num_threads"])]
        Path("runs").mkdir(exist_ok=True)
        with open(f"runs/{'_'.join(self.results.parts[-2:])}_seed_{self.args['seed']}.log", "a") as log:
            return subprocess.Popen([sys.executable, ROOT / script, *flags], stdout=log, stderr=subprocess.STDOUT)

    def publish(self, numbers):
        """Add the run, or its numbers alone, to its results folder, unless all of it is there already.

        What the folder ships is replaced if it is another run of this seed. OSError or ValueError says what is missing.
        """
        run, shipped = self.run_dir(), self.results / "eval.json"
        if run is None:
            raise ValueError("runs/ holds no run with these arguments")
        ship = shipped.exists() and read_json(shipped)["seed"] == self.args["seed"]
        ships = not numbers and (ship or not shipped.exists())  # a folder that ships none ships what comes first
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
    """A run's arguments; none of a file that is damaged, which is printed: it can be that of any other run."""
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
    """The jobs of a file; ValueError names the line that cannot be one."""
    jobs = []
    for number, line in enumerate(Path(path).read_text().splitlines(), start=1):
        try:
            if words := shlex.split(line, comments=True):
                jobs.append(read_job(words))
        except (OSError, ValueError, SystemExit) as error:
            raise ValueError(f"{path}, line {number}: {str(error).removeprefix('error: ')}") from error
    return jobs


def read_job(words):
    """The job of a line; ValueError, OSError or SystemExit says why it cannot be one."""
    if len(words) < 2 or words[1] not in SCRIPTS:
        raise ValueError(f"{shlex.join(words)!r} must be a results folder, one of {', '.join(SCRIPTS)} and its flags")
    results, script, *flags = words
    kind = importlib.import_module(Path(script).stem)
    if {"--help", "-h"} & set(flags):
        raise ValueError("--help trains nothing")
    args, _ = runs.parse_args(kind.Args, kind.recipe, flags, kind.ENV_OPTIONS, kind.BUFFERS)
    if args.eval_only or not args.save_model:
        raise ValueError(f"{'--eval-only' if args.eval_only else '--no-save-model'} leaves no run to publish")
    return Job(Path(results), [script, *flags], asdict(args))


def publish(job, numbers):
    """Publish a job's run, and whether that worked: a line is printed where it failed, and the other jobs go on."""
    try:
        job.publish(numbers)
    except (OSError, ValueError) as error:
        print(f"not published: {shlex.join(job.command)}: {error}", flush=True)
        return False
    return True


def next_free(waiting, running):
    """The first waiting job whose run no running one has, or None: it would go on with it."""
    busy = {job.run_dir() for job in running}
    return next((job for job in waiting if job.run_dir() is None or job.run_dir() not in busy), None)


def work(jobs, at_once, numbers):
    """Train the jobs, `at_once` at a time, and publish each as it ends; returns those that failed."""
    waiting, running = [job for job in jobs if not job.is_trained()], []
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
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell ignores it for what it starts in the background
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that `work` ends what it has started
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
