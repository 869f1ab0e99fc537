"""Flying a policy until the last of its flights has ended: the loop of all evaluations, comparisons and benchmarks."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from common.batch import BatchedEnv


class FlownStep(NamedTuple):
    """A step of n flights."""

    t: int  # how many steps came before
    obs: np.ndarray  # (n, obs) what the policy saw
    action: np.ndarray  # (n, actions)
    next_obs: np.ndarray  # (n, obs) after the step
    reward: np.ndarray  # (n,)
    flew: np.ndarray  # (n,) whether the step belongs to a flight; False after a flight's end


def fly_until_ended(
    batch: BatchedEnv,
    policy: Callable,
    obs: np.ndarray,
    record: Callable[[FlownStep], object] | None = None,
    restart: bool = False,
) -> dict:
    """Fly `policy(obs (n, obs), t) -> action (n, actions)` from a `reset` until all n flights have ended.

    `obs` is the answer of the `reset`. `record(step)` is called after each step, when the attributes of `batch` are
    those of the step's end. Returns the arrays of `final_info`, with each flight's own numbers.

    An environment whose flight has ended flies on until all have. With `restart` it flies from a new start.
    """
    flew = np.ones(batch.num_envs, dtype=bool)
    final = {}
    for t in range(batch.episode_steps):
        action = np.asarray(policy(obs, t))
        next_obs, reward, ended, info = batch.advance(action)
        if record is not None:
            record(FlownStep(t, obs, action, next_obs, reward, flew))
        ends_here = flew & ended
        for key, value in info.items():
            final.setdefault(key, value.copy())[ends_here] = value[ends_here]
        flew = flew & ~ended
        if not flew.any():
            break
        obs = batch.restart(ended) if restart and ended.any() else next_obs
    return final


def decision_us(env_id: str, policy: Callable, **env_options) -> float:
    """The median time in microseconds, on one core, of a policy's decision in a flight that is alone in its batch."""
    seconds = []

    def timed(obs, t):
        begin = time.process_time()
        action = policy(obs, t)
        seconds.append(time.process_time() - begin)
        return action

    batch: Any = gym.make_vec(env_id, num_envs=1, **env_options).unwrapped
    obs, _ = batch.reset()
    fly_until_ended(batch, timed, obs)
    return 1e6 * float(np.median(seconds))
