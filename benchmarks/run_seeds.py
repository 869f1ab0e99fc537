"""Train a list of runs, some at a time, and publish them. Finished runs are skipped, and interrupted ones go on.

    python -m benchmarks.run_seeds LIST [--at-once 2] [--numbers]

Each line of LIST is a results folder and the command that trains for it; empty lines and # comments are skipped:

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

import evaluate
import runs
from common.command_line import OneLineParser, integer
from common.evaluations import read_json
from common.flags import plain_args

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = sorted(path.name for path in ROOT.glob("ppo_gtrxl_*.py"))
MACHINE = ("cuda", "num_threads", "resume")  # arguments that another start may change


def start_logged(command, name):
    """Start Python with a command. What it prints is added to runs/<name>.log."""
    Path("runs").mkdir(exist_ok=True)
    with open(f"runs/{name}.log", "a") as log:
        return subprocess.Popen([sys.executable, *command], stdout=log, stderr=subprocess.STDOUT)


@dataclass
class Training:
    """A line of a list. `work` needs its `command`, `is_trained`, `identity`, `start` and `publish`."""

    results: Path  # the folder to which it is published
    command: list[str]  # script and flags
    args: dict  # the script's arguments with these flags

    def run_dir(self):
        """The newest run in runs/ that has the arguments of this training, or None."""
        mine = self.identity()
        for path in sorted(Path("runs").glob("*/args.json"), key=lambda path: path.stat().st_mtime, reverse=True):
            if mine == without_machine(read_args(path)):
                return path.parent
        return None

    def is_trained(self):
        """Whether it has a whole evaluation, with eval.json, which is written last, and eval.npz."""
        run = self.run_dir()
        return run is not None and all((run / name).exists() for name in ("eval.json", "eval.npz"))

    def identity(self):
        """The arguments that tell this training's run from others. Two of one identity never run at the same time."""
        return without_machine(self.args)

    def start(self):
        """Begin the training, or go on with its saved run."""
        run = self.run_dir()
        script, *flags = self.command
        if run is not None and (run / "training_state.pt").exists():
            flags = ["--resume", str(run), "--num-threads", str(self.args["num_threads"])]
        return start_logged([ROOT / script, *flags], f"{'_'.join(self.results.parts[-2:])}_seed_{self.args['seed']}")

    def publish(self, numbers):
        """Add the run, or only its numbers, to its results folder, unless all of it is there already.

        The shipped policy is replaced if it is of another run of this seed. An empty folder ships the first run. Raises
        OSError or ValueError that says what is missing.
        """
        run = self.run_dir()
        if run is None:
            raise ValueError("runs/ holds no run with these arguments")
        shipped = self.results / "eval.json"
        ship = shipped.exists() and read_json(shipped)["seed"] == self.args["seed"]
        is_there = same(run / "eval.json", self.results / "seeds" / f"{self.args['seed']}.json")
        if not numbers and (ship or not shipped.exists()):
            files = [self.results / name for name in ("agent.safetensors", "eval.npz", "figures")]
            is_there &= all(file.exists() for file in files) and same(run / "eval.json", shipped)
        if not is_there:
            evaluate.publish(run, self.results, ship=ship, numbers=numbers, replace=True)


def without_machine(args):
    return {name: value for name, value in args.items() if name not in MACHINE}


def same(path, other):
    """Whether the second file is there and has the bytes of the first."""
    return other.exists() and other.read_bytes() == path.read_bytes()


@functools.cache
def print_once(line):
    print(line, flush=True)


def read_args(path):
    """A run's arguments, {} for a damaged file. This is printed, because the file may be that of any run."""
    try:
        args = json.loads(path.read_text())
        if not isinstance(args, dict):
            raise ValueError("it holds no arguments")
        return args
    except (OSError, ValueError) as error:
        print_once(f"{path} is skipped, a training of this run begins anew: {error}")
        return {}


def read_trainings(path):
    """The trainings of a list. Raises ValueError that names a line which is none."""
    trainings = []
    for number, line in enumerate(Path(path).read_text().splitlines(), start=1):
        try:
            words = shlex.split(line, comments=True)
            if words:
                trainings.append(read_training(words))
        except (OSError, ValueError, SystemExit) as error:
            raise ValueError(f"{path}, line {number}: {str(error).removeprefix('error: ')}") from error
    return trainings


def read_training(words):
    """The training of a line. Raises ValueError, OSError or SystemExit that says why it is none."""
    if len(words) < 2 or words[1] not in SCRIPTS:
        raise ValueError(f"{shlex.join(words)!r} must be a results folder, one of {', '.join(SCRIPTS)} and its flags")
    results, script, *flags = words
    if {"--help", "-h"} & set(flags):
        raise ValueError("--help trains nothing")
    kind = importlib.import_module(Path(script).stem)
    args, _ = runs.parse_args(kind, flags)
    if args.eval_only or not args.save_model:
        raise ValueError(f"{'--eval-only' if args.eval_only else '--no-save-model'} leaves no run to publish")
    return Training(Path(results), [script, *flags], plain_args(args))


def publish(training, numbers):
    """Publish a training's run. Returns whether that worked. A failure prints a line, and the others go on."""
    try:
        training.publish(numbers)
    except (OSError, ValueError) as error:
        print(f"not published: {shlex.join(training.command)}: {error}", flush=True)
        return False
    return True


def next_free(waiting, running):
    """The first waiting training that has another identity than the running ones. None without one."""
    busy = [training.identity() for training in running]
    return next((training for training in waiting if training.identity() not in busy), None)


def work(trainings, at_once, numbers):
    """Train a list, `at_once` at a time, and publish each when it ends. Returns those that failed."""
    waiting = [training for training in trainings if not training.is_trained()]
    running = []
    print(f"{len(trainings)} trainings, {len(trainings) - len(waiting)} done already", flush=True)
    failed = [training for training in trainings if training not in waiting and not publish(training, numbers)]
    try:
        while waiting or running:
            training = next_free(waiting, [training for training, _ in running])
            if training and len(running) < at_once:
                waiting.remove(training)
                running.append((training, training.start()))
                print(f"started {shlex.join(training.command)}", flush=True)
                continue
            time.sleep(0.2)
            for training, process in [pair for pair in running if pair[1].poll() is not None]:
                running.remove((training, process))
                print(f"ended with {process.returncode}: {shlex.join(training.command)}", flush=True)
                if process.returncode or not publish(training, numbers):
                    failed.append(training)
    finally:
        for _, process in running:
            process.terminate()  # saves its state
        for _, process in running:
            process.wait()
    return failed


def end_with_the_runs():
    """Let Ctrl-C and SIGTERM raise, so that `work` ends what it has started."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell sets it to be ignored in the background
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))


def main():
    end_with_the_runs()
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("list", help="file with one run a line")
    parser.add_argument("--at-once", type=integer(1, 64), default=1, help="number of runs at a time")
    parser.add_argument("--numbers", action="store_true", help="publish evaluations and curves, no policies")
    options = parser.parse_args()
    try:
        sys.exit(1 if work(read_trainings(options.list), options.at_once, options.numbers) else 0)
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
