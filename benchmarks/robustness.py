"""Try to hurt a run from outside: kills, damaged files, absurd flags and actions, two thousand updates.

    python -m benchmarks.robustness [--kills 50] [--fuzz 10000] [--soak 2000] [--seed 0]

Prints what was tried and how it ended. The first failure is an AssertionError. The tests do the same, but fewer times.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib
import inspect
import io
import json
import multiprocessing
import os
import pickle
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from dataclasses import fields
from pathlib import Path
from unittest import mock

import gymnasium as gym
import numpy as np
import torch

import envs
import runs
from benchmarks.policies import SCRIPTS
from common import files
from common.checkpoints import read_checkpoint
from common.command_line import OneLineParser, integer
from common.tasks import env_ids

NETWORK = ["--embed-dim=8", "--num-heads=2", "--num-blocks=1", "--memory-length=4", "--mlp-dim=8", "--hidden-dim=8"]
TINY = [*NETWORK, "--num-envs=2", "--num-minibatches=2", "--update-epochs=2", "--eval-starts=10", "--num-threads=1"]
PROCESSES = multiprocessing.get_context("forkserver")  # its children have torch already: each starts at once
PROCESSES.set_forkserver_preload(["ppo_gtrxl_di"])


# --- kills ------------------------------------------------------------------------------------------------------------


def train(folder, argv, slow_disk):
    """In a child: the double integrator's script, saving after every second update; a slow disk writes for 40 ms."""
    script = importlib.import_module("ppo_gtrxl_di")
    runs.SAVE_EVERY = 2

    def write_slowly(path, data):
        data = bytes(data)
        with files.replacing(path) as file:
            for part in range(20):
                file.write(data[len(data) * part // 20 : len(data) * (part + 1) // 20])
                file.flush()
                time.sleep(0.002)

    if slow_disk:
        files.write_bytes = write_slowly
    os.chdir(folder)
    sys.stdout = open(os.devnull, "w")
    script.main(argv)


def start(folder, *argv, slow_disk=False):
    """A child that trains in `folder`."""
    process = PROCESSES.Process(target=train, args=(str(folder), list(argv), slow_disk))
    process.start()
    return process


def finish(folder, *argv):
    """Train in `folder` to the end; the bits of all that was trained."""
    process = start(folder, *argv)
    process.join(600)
    assert process.exitcode == 0, f"exit code {process.exitcode} of {argv}"
    (run,) = (folder / "runs").iterdir()
    assert not list(run.glob(".*.tmp")), f"{run} holds what a killed writer left"
    state = torch.load(run / "training_state.pt", weights_only=True)
    weights = read_checkpoint(run / "agent.safetensors", {})["tensors"]
    trained = {name: state[name] for name in ("agent", "average", "optimizer", "rng")}
    return json.loads(json.dumps([trained, weights], default=lambda array: array.tolist()))  # comparable


def kill_and_resume(kills, seed=0):
    """SIGKILL runs at random moments, every other time in the middle of a write, and resume. Returns the counts.

    A resumed run must end with the bits of the uninterrupted run. A run that is killed before its first checkpoint
    begins anew.
    """
    rng, ended = np.random.default_rng(seed), Counter()
    argv = [*TINY, "--total-updates=12"]
    for _ in range(2):  # the first one also starts the fork server
        with tempfile.TemporaryDirectory() as folder:
            before = time.monotonic()
            expected = finish(Path(folder), *argv)
            seconds = time.monotonic() - before
    for kill in range(kills):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            process = start(folder, *argv, slow_disk=kill % 2)
            began = time.monotonic()
            written = f"runs/*/.{rng.choice(['training_state.pt', 'agent.safetensors'])}.*"
            moment = rng.uniform()
            process.join(seconds * moment)
            while kill % 2 and process.is_alive() and not list(folder.glob(written)):
                time.sleep(0.0005)
            if process.is_alive():
                os.kill(process.pid, signal.SIGKILL)
            else:
                seconds = time.monotonic() - began  # the machine has become less busy
            process.join()
            saved = list(folder.glob("runs/*/training_state.pt"))
            kind = "after its end" if process.exitcode == 0 else "in a write" if kill % 2 else "at random"
            ended[kind if saved else "before the first checkpoint"] += 1
            if saved:
                again = [f"--resume={saved[0].parent}"]
            else:
                again = argv
                shutil.rmtree(folder / "runs", ignore_errors=True)
            assert finish(folder, *again) == expected, f"kill {kill}, {kind}: other bits than uninterrupted"
    return ended


# --- fuzzing ----------------------------------------------------------------------------------------------------------


def outcome(case, call, *inputs):
    """'works', or 'refused' if it ends with one line. Everything else is an AssertionError that names the case."""
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
            call(*inputs)
    except SystemExit as stop:
        line = str(stop.code)
        is_help = not stop.code
        is_line = line.startswith("error: ") and "\n" not in line and not errors.getvalue()
        assert is_help or is_line, (case, line, errors.getvalue())
        return "works" if is_help else "refused"
    except (envs.BadInput, OSError) as error:  # the scripts print it as one line
        assert "\n" not in str(error), (case, error)
        return "refused"
    except BaseException as error:
        raise AssertionError(f"{case}: {error!r}") from error
    return "works"


WORDS = ["", "0", "1", "-1", "3", "4", "8", "1e-3", "0.5", "2.5", "nan", "inf", "-inf", "1e400", "10" * 20, "True"]
WORDS += ["None", "none", "schedule", "std", "learned", "local", "RocketAscent-v0", "DoubleIntegrator-v0"]
WORDS += ["/", ".", "runs", "nowhere/file", "\0", "ü\n", "--", "-h", "'; rm -rf x", "[1]", "{}", "%s", "VanDerPol-v0"]


def random_arguments(rng, script):
    """A command line of one to four flags, some mutilated, with values that fit, nearly fit or do not fit at all."""
    names = [field.name for field in fields(script.Args)]
    argv = []
    for _ in range(rng.integers(1, 5)):
        name = str(rng.choice(names)).replace("_", "-" if rng.random() < 0.9 else "_")
        if rng.random() < 0.1:
            name = name[: rng.integers(len(name))] + str(rng.choice(list("xyz-=")))
        name = f"--no-{name}" if rng.random() < 0.1 else f"--{name}"
        value = str(rng.choice(WORDS))
        argv += [[name, value], [f"{name}={value}"], [name], [value]][rng.choice(4, p=[0.5, 0.35, 0.1, 0.05])]
    return argv


def parse_args(script, argv):
    """The script's arguments and what it starts from."""
    return runs.parse_args(script, argv)


def fuzz_arguments(count, seed=0):
    """Random command lines through a script's parsing and checks, in an empty folder, which must stay empty."""
    rng, ended = np.random.default_rng(seed), Counter()
    read_once = mock.patch("inspect.getsource", functools.cache(inspect.getsource))  # tyro reads it for each line
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), read_once:
        for _ in range(count):
            script = SCRIPTS[rng.integers(len(SCRIPTS))]
            argv = random_arguments(rng, script)
            ended[outcome(f"{script.__name__} {argv}", parse_args, script, argv)] += 1
            assert not os.listdir()
    return ended


def damaged(rng, data):
    """Bit flips, a cut, bytes in excess, a stretch of zeros or of noise, mostly in the first 3000 bytes."""
    data = bytearray(data)
    place = int(rng.integers(min(len(data), 3000) if rng.random() < 0.7 else len(data)))
    kind = rng.integers(5)
    if kind == 0:
        for _ in range(rng.integers(1, 4)):
            data[min(place + int(rng.integers(100)), len(data) - 1)] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        del data[place:]
    elif kind == 2:
        data[place:place] = rng.bytes(int(rng.integers(1, 100)))
    else:
        length = int(rng.integers(1, 200))
        data[place : place + length] = bytes(length) if kind == 3 else rng.bytes(length)
    return bytes(data)


class RunsCode:
    """Unpickling it makes a folder."""

    def __reduce__(self):
        return os.mkdir, ("executed",)


def hostile_state(rng, state):
    """A training state with one entry of the wrong shape or type, missing, or code that unpickling would run."""
    state = pickle.loads(pickle.dumps(state))
    part = state[str(rng.choice(["args", "progress", "rng", "agent", "average", "optimizer"]))]
    part = part[0] if isinstance(part, list) else part
    key = list(part)[rng.integers(len(part))]
    values = [RunsCode(), None, "x", -1, float("nan"), [], {}, torch.zeros(3), torch.zeros(8, 8)]
    part[key] = values[rng.integers(len(values))]
    if rng.random() < 0.2:
        del part[key]
    return state


def parse_at_once(script, **flags):
    """`parse_args` of these flags without tyro, which takes ten times as long as the rest."""
    with mock.patch.object(runs, "read_flags", lambda defaults, argv: flags):
        return parse_args(script, [])


def load_checkpoint(script, path):
    """All that --eval-only does with a file before it flies."""
    args, saved = parse_at_once(script, eval_only=True, checkpoint=str(path))
    agent = script.Agent(args, gym.make_vec(args.env_id, num_envs=args.num_envs))
    runs.load_checkpoint(agent, args, saved)


def load_state(script, folder):
    """All that --resume does with a folder before it trains."""
    args, saved = parse_at_once(script, resume=str(folder))
    batch = gym.make_vec(args.env_id, num_envs=args.num_envs)
    batch.reset(seed=0)
    agent = script.Agent(args, batch)
    runs.load_checkpoint(agent, args, saved)
    average = script.AveragedModel(agent, multi_avg_fn=script.get_ema_multi_avg_fn(args.weight_average))
    optimizer = torch.optim.Adam(agent.parameters(), eps=1e-5, fused=True)
    runs.restore(saved, Path(folder), {"agent": agent, "average": average, "optimizer": optimizer}, batch)


def fuzz_checkpoints(count, seed=0):
    """Damaged agent.safetensors and training_state.pt, and states that fit nothing or would run code."""
    rng = np.random.default_rng(seed)
    ended = Counter()
    script = importlib.import_module("ppo_gtrxl_di")
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        with contextlib.redirect_stdout(io.StringIO()):
            script.main([*TINY, "--total-updates=1"])
        (run,) = Path("runs").iterdir()
        names = "agent.safetensors", "training_state.pt"
        whole = {name: (run / name).read_bytes() for name in names}
        state = torch.load(run / "training_state.pt", weights_only=True)
        listing = sorted(os.listdir(run))
        for k in range(count):
            name = names[k % 2]
            if k % 4 == 3:
                torch.save(hostile_state(rng, state), run / name)
            else:
                (run / name).write_bytes(damaged(rng, whole[name]))
            before = (run / name).read_bytes()
            load, path = (load_checkpoint, run / name) if name == names[0] else (load_state, run)
            ended[f"{name} {outcome(f'case {k}, a damaged {name}', load, script, path)}"] += 1
            assert (run / name).read_bytes() == before and sorted(os.listdir(run)) == listing
            assert os.listdir() == ["runs"], "unpickling ran code"
    return ended


def random_actions(rng, shape):
    """Actions of the right shape that may hold NaN, infinities, zeros and huge numbers, or something else."""
    actions = rng.standard_normal(shape) * 10.0 ** rng.integers(-320, 308)
    special = rng.choice([np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, 1.7e308], size=shape)
    actions = np.where(rng.random(shape) < rng.choice([0.0, 0.1, 1.0]), special, actions)
    others = [actions[..., None], actions[:-1], actions.astype(np.float32), actions.astype(complex), actions.tolist()]
    others += [actions.astype(str), actions.astype(object), actions > 0, np.zeros(shape, dtype=int), None, "x", {}, 3]
    with np.errstate(all="ignore"):
        return actions if rng.random() < 0.6 else others[rng.integers(len(others))]


def fuzz_actions(count, seed=0):
    """Actions of every kind to every environment: a finite step, or BadInput with one line."""
    rng, ended = np.random.default_rng(seed), Counter()
    batches = [gym.make_vec(env_id, num_envs=5) for env_id in env_ids()]
    for batch in batches:
        batch.reset(seed=0)
    for _ in range(count):
        batch = batches[rng.integers(len(batches))]
        with np.errstate(over="ignore"):
            actions = random_actions(rng, batch.action_space.shape)
        ended[outcome(actions, step, batch, actions)] += 1
    return ended


def step(batch, actions):
    """One step, whose observations and rewards must be finite."""
    observations, rewards, *_ = batch.step(actions)
    assert np.isfinite(observations).all() and np.isfinite(rewards).all()


# --- soak -------------------------------------------------------------------------------------------------------------


def resources():
    """Resident memory in bytes and number of open files of this process (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE"), len(os.listdir("/proc/self/fd"))


def living_tensors():
    """The number of tensors in this process. Looking through all objects takes half a second."""
    gc.collect()
    return sum(issubclass(type(thing), torch.Tensor) for thing in gc.get_objects())


def soak_in_child(pipe, argv):
    """In a child: train in a temporary folder and send `resources` after every update, tensors after each hundredth."""
    script = importlib.import_module("ppo_gtrxl_di")
    end_update = runs.Run.end_update

    def end_and_send(run, iteration, *inputs):
        end_update(run, iteration, *inputs)
        pipe.send((*resources(), 0 if iteration % 100 else living_tensors()))

    runs.Run.end_update = end_and_send
    sys.stdout = open(os.devnull, "w")
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        script.main(argv)


def soak(updates):
    """Train for so many tiny updates: resident memory (bytes), open files and, each hundredth, living tensors.

    Raises AssertionError if the child dies, with the number of updates until then.
    """
    ours, theirs = PROCESSES.Pipe(duplex=False)
    process = PROCESSES.Process(target=soak_in_child, args=(theirs, [*TINY, f"--total-updates={updates}"]))
    process.start()
    theirs.close()  # the child's alone: where it dies, `recv` ends instead of waiting
    seen = []
    with contextlib.suppress(EOFError):
        while len(seen) < updates:
            seen.append(ours.recv())
    process.join()
    assert process.exitcode == 0, f"soak: exit code {process.exitcode} after {len(seen)} of {updates} updates"
    return np.array(seen)


def main():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=integer(0, 10**6), default=50)
    parser.add_argument("--fuzz", type=integer(0, 10**9), default=10_000)
    parser.add_argument("--soak", type=integer(1, 10**6), default=2000)
    parser.add_argument("--seed", type=integer(0, 2**31 - 1), default=0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    ended = kill_and_resume(args.kills, args.seed)
    print(f"{args.kills} kills, each resumed run ended with the uninterrupted one's bits: {dict(ended)}", flush=True)
    for fuzz in (fuzz_arguments, fuzz_checkpoints, fuzz_actions):
        print(f"{fuzz.__name__}, {args.fuzz} cases: {dict(fuzz(args.fuzz, args.seed))}", flush=True)
    memory, files, tensors = soak(args.soak).T
    first = min(99, len(memory) - 1)
    growth = memory[-1] / memory[first] - 1
    counted = set(tensors) - {0}
    print(f"{args.soak} updates: memory {growth:+.2%} after the first 100, open files {min(files)} to {max(files)}")
    if counted:
        print(f"tensors after each hundredth: {min(counted):.0f} to {max(counted):.0f}")


if __name__ == "__main__":
    main()
