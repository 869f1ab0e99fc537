"""Try to hurt a run from outside: kills, damaged files, absurd flags and actions, two thousand updates.

    python -m benchmarks.robustness                        # all checks: twenty minutes
    python -m benchmarks.robustness kills --tries 5        # one, with other than its usual number of tries

Prints how the tries ended. The first failure is an AssertionError. The tests call the same checks with fewer tries.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import gc
import inspect
import io
import json
import multiprocessing
import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields
from pathlib import Path
from unittest import mock

import gymnasium as gym
import numpy as np
import torch

import ppo_gtrxl_di as script
import runs
from benchmarks.policies import SCRIPTS
from common import files
from common.checkpoints import read_checkpoint
from common.command_line import OneLineParser, integer
from common.errors import BadInput
from common.tasks import env_ids

NETWORK = ["--embed-dim=8", "--num-heads=2", "--num-blocks=1", "--memory-length=4", "--mlp-dim=8", "--hidden-dim=8"]
TINY = [*NETWORK, "--num-envs=2", "--num-minibatches=2", "--update-epochs=2", "--eval-starts=10", "--num-threads=1"]
PROCESSES = multiprocessing.get_context("forkserver")  # its children have torch already: each starts at once
PROCESSES.set_forkserver_preload(["ppo_gtrxl_di"])


# --- kills ------------------------------------------------------------------------------------------------------------


def train(folder, argv, slow_disk):
    """In a child: train, saving after every second update. A slow disk takes 40 ms for each file."""

    def write_slowly(path, data):
        half = len(data) // 2
        with files.replacing(path) as file:
            file.write(data[:half])
            file.flush()
            time.sleep(0.04)
            file.write(data[half:])

    runs.SAVE_EVERY = 2
    if slow_disk:
        files.write_bytes = write_slowly
    os.chdir(folder)
    sys.stdout = open(os.devnull, "w")
    script.main(argv)


def start(folder, argv, slow_disk=False):
    """A child that trains in `folder`."""
    process = PROCESSES.Process(target=train, args=(str(folder), argv, slow_disk))
    process.start()
    return process


def finish(folder, argv):
    """Train in `folder` to the end; the bits of all that was trained."""
    process = start(folder, argv)
    process.join(600)
    assert process.exitcode == 0, f"exit code {process.exitcode} of {argv}"
    (run,) = (folder / "runs").iterdir()
    assert not list(run.glob(".*.tmp")), f"{run} holds what a killed writer left"
    state = torch.load(run / "training_state.pt", weights_only=True)
    trained = [state[name] for name in ("agent", "average", "optimizer", "rng")]
    trained.append(read_checkpoint(run / "agent.safetensors")["tensors"])
    return json.loads(json.dumps(trained, default=lambda array: array.tolist()))  # comparable


def kills(tries, seed=0):
    """SIGKILL runs at random moments, every other time in the middle of a write, and resume. Returns the counts.

    A resumed run must end with the bits of the uninterrupted run. A run that is killed before its first checkpoint
    begins anew.
    """
    rng, ended = np.random.default_rng(seed), Counter()
    argv = [*TINY, "--total-updates=12"]
    for _ in range(2):  # the first one also starts the fork server
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            expected = finish(Path(folder), argv)
        seconds = time.monotonic() - began
    for k in range(tries):
        in_a_write = k % 2 == 1
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            process = start(folder, argv, slow_disk=in_a_write)
            process.join(seconds * rng.uniform())
            while in_a_write and process.is_alive() and not list(folder.glob("runs/*/.*.tmp")):
                time.sleep(0.0005)
            process.kill()
            process.join()
            kind = "in a write" if in_a_write else "at random"
            if process.exitcode == 0:
                kind = "after its end"
            ended[kind] += 1
            again = [f"--resume={state.parent}" for state in folder.glob("runs/*/training_state.pt")]
            if not again:
                shutil.rmtree(folder / "runs", ignore_errors=True)
            assert finish(folder, again or argv) == expected, f"kill {k}, {kind}: other bits than uninterrupted"
    return ended


# --- flags, files and actions -----------------------------------------------------------------------------------------


def outcome(case, call, *inputs):
    """'works', or 'refused' if it ends with one line. Everything else is an AssertionError that names the case."""
    errors = io.StringIO()
    line = ""
    try:
        with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
            call(*inputs)
    except SystemExit as stop:
        line = str(stop.code or "")  # none of --help
        assert not line or line.startswith("error: "), (case, line)
    except (BadInput, OSError) as error:  # the scripts print it as one line
        line = str(error)
    except BaseException as error:
        raise AssertionError(f"{case}: {error!r}") from error
    assert "\n" not in line and not errors.getvalue(), (case, line, errors.getvalue())
    return "refused" if line else "works"


def in_an_empty_folder(check):
    """A check whose tries run in a temporary folder. tyro reads each source once, and not for each command line."""

    @functools.wraps(check)
    def checked(*inputs):
        read_once = mock.patch("inspect.getsource", functools.cache(inspect.getsource))
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), read_once:
            return check(*inputs)

    return checked


WORDS = ["", "\0", "ü\n", "'; rm -rf x", "10" * 20]
WORDS += "0 1 -1 3 4 8 1e-3 0.5 2.5 nan inf -inf 1e400 True None none schedule std learned local -- -h".split()
WORDS += "/ . runs nowhere/file [1] {} %s RocketAscent-v0 DoubleIntegrator-v0 VanDerPol-v0".split()


def random_arguments(rng, names):
    """A command line of one to four flags, some mutilated, with values that fit, nearly fit or do not fit at all."""
    argv = []
    for _ in range(rng.integers(1, 5)):
        name = str(rng.choice(names)).replace("_", "-" if rng.random() < 0.9 else "_")
        if rng.random() < 0.1:
            name = name[: rng.integers(len(name))] + str(rng.choice(list("xyz-=")))
        name = f"--no-{name}" if rng.random() < 0.1 else f"--{name}"
        value = str(rng.choice(WORDS))
        argv += [[name, value], [f"{name}={value}"], [name], [value]][rng.choice(4, p=[0.5, 0.35, 0.1, 0.05])]
    return argv


@in_an_empty_folder
def command_lines(tries, seed=0):
    """Random command lines through a script's parsing and checks. The folder must stay empty."""
    rng, ended = np.random.default_rng(seed), Counter()
    for _ in range(tries):
        kind = SCRIPTS[rng.integers(len(SCRIPTS))]
        argv = random_arguments(rng, [field.name for field in fields(kind.Args)])
        ended[outcome(f"{kind.__name__} {argv}", runs.parse_args, kind, argv)] += 1
        assert not os.listdir()
    return ended


def damaged(rng, data):
    """A bit flipped, the end cut off, or noise put in or written over, mostly in the first 3000 bytes."""
    place = int(rng.integers(min(len(data), 3000) if rng.random() < 0.7 else len(data)))
    noise = rng.bytes(int(rng.integers(1, 200)))
    before, byte, after = data[:place], data[place], data[place + 1 :]
    flipped = bytes([byte ^ 1 << int(rng.integers(8))])
    kinds = [before + flipped + after, before, before + noise + after, before + noise + after[len(noise) :]]
    return kinds[rng.integers(len(kinds))]


class RunsCode:
    """Unpickling it makes a folder."""

    def __reduce__(self):
        return os.mkdir, ("executed",)


def hostile_state(rng, state):
    """A training state with one entry of the wrong shape or type, missing, or code that unpickling would run."""
    state = copy.deepcopy(state)
    part = state[str(rng.choice(["args", "progress", "rng", "agent", "average", "optimizer"]))]
    part = part[0] if isinstance(part, list) else part
    key = list(part)[rng.integers(len(part))]
    values = [RunsCode(), None, "x", -1, float("nan"), [], {}, torch.zeros(3), torch.zeros(8, 8)]
    part[key] = values[rng.integers(len(values))]
    if rng.random() < 0.2:
        del part[key]
    return state


def load(flag, path):
    """All that --checkpoint does with a file before it flies, or --resume with a run before it trains."""
    argv = [f"--{flag}={path}"]
    if flag == "checkpoint":
        argv.append("--eval-only")
    args, saved = runs.parse_args(script, argv)
    batch = gym.make_vec(args.env_id, num_envs=args.num_envs)
    agent = script.Agent(args, batch)
    runs.load_checkpoint(agent, args, saved)
    if flag == "resume":
        batch.reset(seed=0)
        average = script.AveragedModel(agent, multi_avg_fn=script.get_ema_multi_avg_fn(args.weight_average))
        optimizer = torch.optim.Adam(agent.parameters(), eps=1e-5, fused=True)
        runs.restore(saved, path, {"agent": agent, "average": average, "optimizer": optimizer}, batch)


@in_an_empty_folder
def damaged_files(tries, seed=0):
    """Damaged agent.safetensors and training_state.pt, and states that fit nothing or would run code."""
    rng, ended = np.random.default_rng(seed), Counter()
    with contextlib.redirect_stdout(io.StringIO()):
        script.main([*TINY, "--total-updates=1"])
    (run,) = Path("runs").iterdir()
    weights, training = run / "agent.safetensors", run / "training_state.pt"
    whole = {path: path.read_bytes() for path in (weights, training)}
    state = torch.load(training, weights_only=True)
    listing = sorted(os.listdir(run))
    for k in range(tries):
        path = training if k % 2 else weights
        path.write_bytes(damaged(rng, whole[path]))
        if k % 4 == 3:
            torch.save(hostile_state(rng, state), path)
        before = path.read_bytes()
        flag, given = ("resume", run) if path == training else ("checkpoint", weights)
        ended[f"{path.name} {outcome(f'case {k}, a damaged {path.name}', load, flag, given)}"] += 1
        assert path.read_bytes() == before and sorted(os.listdir(run)) == listing
        assert os.listdir() == ["runs"], "unpickling ran code"
    return ended


def random_actions(rng, shape):
    """Actions of the right shape that may hold NaN, infinities, zeros and huge numbers, or something else."""
    actions = rng.standard_normal(shape) * 10.0 ** rng.integers(-320, 308)
    special = rng.choice([np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, 1.7e308], size=shape)
    actions = np.where(rng.random(shape) < rng.choice([0.0, 0.1, 1.0]), special, actions)
    others = [actions[..., None], actions[:-1], actions.tolist(), None, "x", {}, 3]
    others += [actions.astype(kind) for kind in (np.float32, complex, str, object, bool)]
    return actions if rng.random() < 0.6 else others[rng.integers(len(others))]


def actions(tries, seed=0):
    """Actions of every kind to every environment: a finite step, or BadInput with one line."""
    rng, ended = np.random.default_rng(seed), Counter()
    batches = [gym.make_vec(env_id, num_envs=5) for env_id in env_ids()]
    for batch in batches:
        batch.reset(seed=0)
    for _ in range(tries):
        batch = batches[rng.integers(len(batches))]
        with np.errstate(all="ignore"):
            given = random_actions(rng, batch.action_space.shape)
        ended[outcome(given, step, batch, given)] += 1
    return ended


def step(batch, given):
    """One step, whose observations and rewards must be finite."""
    observations, rewards, *_ = batch.step(given)
    assert np.isfinite(observations).all() and np.isfinite(rewards).all()


# --- many updates -----------------------------------------------------------------------------------------------------


def resources(iteration):
    """Of this process (Linux): resident memory in bytes, open files, and after each hundredth update living tensors."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    tensors = 0
    if iteration % 100 == 0:  # looking through all objects takes half a second
        gc.collect()
        tensors = sum(issubclass(type(thing), torch.Tensor) for thing in gc.get_objects())
    return pages * os.sysconf("SC_PAGE_SIZE"), len(os.listdir("/proc/self/fd")), tensors


def train_and_count(total):
    """In a child: `resources` after every update of a training."""
    seen = []
    end_update = runs.Run.end_update

    def end_and_count(run, iteration, *inputs):
        end_update(run, iteration, *inputs)
        seen.append(resources(iteration))

    runs.Run.end_update = end_and_count
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()):
        script.main([*TINY, f"--total-updates={total}"])
    return seen


def resources_of_updates(total):
    """Train for so many tiny updates in a child; memory, open files and tensors after each, (3, updates)."""
    with ProcessPoolExecutor(1, mp_context=PROCESSES) as child:
        return np.transpose(child.submit(train_and_count, total).result())


def updates(tries, seed=0):
    """What a long training takes."""
    memory, files, tensors = resources_of_updates(tries)
    hundredths = tensors[99::100]
    return {
        "memory after the first 100": f"{memory[-1] / memory[:100][-1] - 1:+.2%}",
        "open files": f"{min(files)} to {max(files)}",
        "tensors": f"{min(hundredths, default=0)} to {max(hundredths, default=0)}",
    }


CHECKS = {  # its usual number of tries
    kills: 50,
    command_lines: 10_000,
    damaged_files: 10_000,
    actions: 10_000,
    updates: 2000,
}


def main():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    names = [check.__name__ for check in CHECKS]
    parser.add_argument("check", nargs="?", choices=names, help="this one alone")
    parser.add_argument("--tries", type=integer(1, 10**9), help="of each check")
    parser.add_argument("--seed", type=integer(0, 2**31 - 1), default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for check, usual in CHECKS.items():
        if options.check in (None, check.__name__):
            tries = options.tries or usual
            print(f"{check.__name__}, {tries} tries: {dict(check(tries, options.seed))}", flush=True)


if __name__ == "__main__":
    main()
