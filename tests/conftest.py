"""What several test files share: environments whose episodes end at different times, one update, a benchmark."""

import contextlib
import dataclasses
import importlib
import os
import signal
from unittest import mock

os.environ["OMP_NUM_THREADS"] = "1"  # two workers on two cores, and whatever they start

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box

import envs

# a shell starts what it sends to the background with Ctrl-C ignored, and so would be what a test starts and interrupts
signal.signal(signal.SIGINT, signal.default_int_handler)


LONGEST = [
    "test_processes",
    "test_scripts",
    "test_opponents",
    "test_rescue",
    "test_rocket_baselines",
    "test_docs",
    "test_onnx",
]


def pytest_collection_modifyitems(items):
    """Begin with the longest files: a worker takes a file at a time, and none should wait for another's last one."""
    items.sort(key=lambda item: [*LONGEST, item.path.stem].index(item.path.stem))


class UnevenEnvs:
    """N environments with SAME_STEP autoreset: episodes of environment i last lengths[i] steps.

    Observations are random; the reward is a function of the action. Everything given and taken is kept for the test.
    """

    def __init__(self, lengths, spare_steps=0, reward=lambda action: action[:, 0], u_max=(4.0,)):
        self.lengths, self.num_envs = np.array(lengths), len(lengths)
        self.episode_steps = max(lengths) + spare_steps
        high = np.array(u_max)
        self.single_observation_space, self.single_action_space = Box(-1, 1, (3,)), Box(-high, high, dtype=np.float64)
        self.reward, self.rng, self.flights_per_start = reward, np.random.default_rng(0), 1

    def _draw(self):
        self.given_obs.append(self.rng.uniform(-1, 1, (self.num_envs, 3)))
        return self.given_obs[-1]

    def reset(self, seed=None, options=None):
        self.t, self.sums = np.zeros(self.num_envs, dtype=int), np.zeros(self.num_envs)
        self.given_obs, self.taken_actions, self.given_rewards = [], [], []
        return self._draw(), {}

    def step(self, actions):
        self.taken_actions.append(actions.copy())
        self.given_rewards.append(np.asarray(self.reward(actions), dtype=np.float64))
        self.t, self.sums = self.t + 1, self.sums + self.given_rewards[-1]
        terminated, info = self.t == self.lengths, {}
        if terminated.any():
            # where no episode ended, the arrays hold something else on purpose
            returns = np.where(terminated, self.sums, -1e6)
            info["final_info"] = {"episodic_return": returns, "_episodic_return": terminated.copy()}
            self.t, self.sums = np.where(terminated, 0, self.t), np.where(terminated, 0.0, self.sums)
        return self._draw(), self.given_rewards[-1], terminated, np.zeros(self.num_envs, dtype=bool), info


@pytest.fixture
def uneven_envs():
    return UnevenEnvs


@pytest.fixture
def new_problem(monkeypatch):
    """A function that registers a `Problem` for one test, as a line in `envs.PROBLEMS` does; returns its id.

    Solvers are kept by id: each test has ids of its own.
    """

    def register(problem):
        like = gym.spec("VanDerPol-v0")
        spec = dataclasses.replace(like, id=problem.env_id, kwargs={"env_id": problem.env_id})
        monkeypatch.delitem(envs.PROBLEMS, problem.env_id, raising=False)  # a user's table may have the id
        monkeypatch.setitem(envs.PROBLEMS, problem.env_id, problem)
        monkeypatch.setitem(gym.registry, problem.env_id, spec)
        return problem.env_id

    return register


class UpdateDone(Exception):
    """Ends `train` after the update."""


class OneUpdate:
    """In place of `runs.Run`: `train` begins with update `iteration`, its losses are kept, and it ends."""

    def __init__(self, iteration):
        self.updates_done, self.losses = iteration - 1, None

    def end_update(self, iteration, alive, episodes, losses, learning_rate):
        self.losses = losses
        raise UpdateDone


def update(script, args, modules, envs, batch, iteration=1):
    """One update of `script.train` on this batch, in groups of `envs.flights_per_start` and without a curriculum."""
    training = {"flights_per_start": envs.flights_per_start}
    given = {"rollout": lambda *inputs: (batch, None), "curriculum": lambda *inputs: training}
    run = OneUpdate(iteration)
    with contextlib.suppress(UpdateDone), mock.patch.multiple(script, **given):
        script.train(args, *modules, envs, run)
    return run.losses


@pytest.fixture(scope="module")
def robustness():
    """The benchmark as a module that its child processes can import, too."""
    return importlib.import_module("benchmarks.robustness")


@pytest.fixture
def cut_figures(monkeypatch):
    """From now on the disk is full when a figure is half drawn, wherever it is drawn to."""

    def savefig(figure, target, **options):
        with contextlib.nullcontext(target) if hasattr(target, "write") else open(target, "wb") as file:
            file.write(b"\x89PNG")
            raise OSError(28, "No space left on device")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", savefig)
