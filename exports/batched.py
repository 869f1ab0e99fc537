"""Of an environment without a table: columns by number."""

from __future__ import annotations

from typing import Any

import numpy as np

from batched.task import BatchedTask
from common.batch import make_batch
from exports.columns import held, named, numbered, stacked
from exports.offers import Interface


def interface(task: BatchedTask, **env_options) -> Interface:
    """What a policy observes and commands; names and units are the environment's own."""
    batch = make_batch(task.env_id, 1, **env_options)
    space: Any = batch.single_action_space
    observation = [(name, "") for name in numbered("obs", batch.single_observation_space.shape[0])]
    action = [(name, "") for name in numbered("u", space.shape[0])]
    return Interface(observation, action, f"Action: from {space.low.tolist()} to {space.high.tolist()}.")


def step_columns(task: BatchedTask, arrays: dict, launch_longitude: float) -> dict[str, np.ndarray]:
    """The episodes below one another, a row each observation, with the action from there on."""
    obs, u = arrays["obs"], arrays["u"]
    columns = {"t_s": np.tile(arrays["t"], (len(obs), 1)), **named(numbered("obs", obs.shape[2]), obs)}
    columns |= named(numbered("u", u.shape[2]), held(u))
    return stacked(columns, np.isfinite(obs).all(axis=2))


def flight_columns(task: BatchedTask, arrays: dict, metrics: dict) -> dict[str, np.ndarray]:
    """A row for each episode."""
    steps = np.isfinite(arrays["u"]).all(axis=2).sum(axis=1)
    return {"flight": np.arange(len(steps)), "steps": steps, "return": arrays["reward"].sum(axis=1)}
