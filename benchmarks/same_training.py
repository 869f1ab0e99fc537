"""Whether the code of every result and that of HEAD train to the same bits, by its command cut to a few updates.

    python -m benchmarks.same_training                          # every result: some 20 minutes of one core
    python -m benchmarks.same_training results/di --updates 20

results/commits.json names the commit that trained each seed. The code of each of these commits, and that of HEAD, is
taken out of git into a temporary folder and runs the first of the result's commands, cut to `--updates`. Schedules are
over a training's updates, so a cut training goes through the whole schedule. Prints a line for each commit. The exit
status is 1 if one bit of the weights differs. The averaged weights are not compared, because they are no part of the
training. Table 1's long runs are not compared, because the code that trained them has other flags.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from benchmarks.run_seeds import ROOT, read_trainings
from common.command_line import OneLineParser, integer

COMMITS = ROOT / "results" / "commits.json"
RESULTS = ROOT / "benchmarks" / "trainings" / "results.txt"


def checkout(commit, folder):
    """Put the files of a commit into an empty folder. Raises OSError if git has no such commit."""
    archive = folder.with_suffix(".zip")
    got = subprocess.run(["git", "archive", "--output", archive, commit], cwd=ROOT, stderr=subprocess.PIPE, text=True)
    if got.returncode:
        raise OSError(f"git has no files of {commit}: {got.stderr.strip()}")
    shutil.unpack_archive(archive, folder)  # tarfile has its safe filter from Python 3.11.4 on; a zip file needs none
    archive.unlink()


def train(command, folder, updates):
    """{name: weight} that a command cut to `updates` learns by a folder's code. Raises RuntimeError if it fails."""
    script, *flags = command
    runs = set((folder / "runs").glob("*"))
    cut = [sys.executable, script, *flags, "--total-updates", str(updates)]
    trained = subprocess.run(cut, cwd=folder, capture_output=True, text=True)
    if trained.returncode:
        raise RuntimeError(f"{' '.join(cut)} failed: {trained.stderr.strip()[-300:]}")
    (run,) = set((folder / "runs").glob("*")) - runs
    return torch.load(run / "training_state.pt", map_location="cpu", weights_only=True)["agent"]


def bits(weight):
    """A weight's type, shape and bytes, which tell NaN and the sign of zero apart."""
    return weight.dtype, weight.shape, weight.numpy().tobytes()


def differing(one, other):
    """The number of weights by name that have other bits, or are only on one side."""
    of_both = one.keys() & other.keys()
    return len(one.keys() ^ other.keys()) + sum(bits(one[name]) != bits(other[name]) for name in of_both)


def first_trainings():
    """{results folder: its first training} of the list of results."""
    first = {}
    for training in read_trainings(RESULTS):
        first.setdefault(str(training.results), training)
    return first


def results_folder(text):
    """Argument type: a results folder, as results/commits.json names it."""
    return text.rstrip("/")


def compare(name, command, commits, updates, temporary):
    """Train a result's command by HEAD and by each commit, and print a line for each. Whether all bits are the same."""
    found = {}
    for commit in ("HEAD", *commits):
        folder = temporary / commit
        if not folder.exists():
            checkout(commit, folder)
        if commit != "HEAD":  # a training that begins with a policy must begin with the same one
            for policy in (temporary / "HEAD" / "results").glob("*/agent.safetensors"):
                shutil.copy(policy, folder / "results" / policy.parent.name)
        found[commit] = train(command, folder, updates)
    wrong = {commit: differing(found["HEAD"], found[commit]) for commit in commits}
    for commit, count in wrong.items():
        verdict = f"{count} of {len(found[commit])} tensors differ" if count else "the same bits"
        print(f"{name}, {updates} updates by {commit} and HEAD: {verdict}", flush=True)
    return not any(wrong.values())


def main():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", nargs="*", type=results_folder, help="without one, all of results/commits.json")
    parser.add_argument("--updates", type=integer(1, 10**6), default=6, help="updates of each training")
    options = parser.parse_args()
    commits = json.loads(COMMITS.read_text())
    unknown = sorted(set(options.results) - commits.keys())
    if unknown:
        sys.exit(f"error: {', '.join(unknown)} must be among {', '.join(commits)}")
    try:
        with tempfile.TemporaryDirectory() as folder:
            same = []
            trainings = first_trainings()
            for name in options.results or commits:
                command = trainings[name].command
                same.append(compare(name, command, commits[name], options.updates, Path(folder)))
    except (OSError, RuntimeError, ValueError) as error:
        sys.exit(f"error: {error}")
    sys.exit(0 if all(same) else 1)


if __name__ == "__main__":
    main()
