"""One update of a script's flat `train` on episodes that are given: for tests and timings of the learning alone."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


class UpdateDone(Exception):
    """Ends `train` after the update."""


class OneUpdate:
    """In place of `runs.Run`: `train` begins with update `iteration` and ends after it, its losses are kept."""

    def __init__(self, iteration):
        self.updates_done, self.losses = iteration - 1, None

    def end_update(self, iteration, alive, episodes, losses, learning_rate):
        self.losses = losses
        raise UpdateDone


def one_update(script, args, modules, envs, batch, iteration=1, group=None):
    """All that update `iteration` of `script.train` does but for its rollout; returns its losses.

    modules: agent, average, optimiser. `batch` stands for what `rollout` returns. With a `group` the environments have
    no curriculum, and need only `num_envs`.
    """
    given = {"rollout": lambda *inputs: (batch, None)}
    if group is not None:
        given["set_curriculum"] = lambda *inputs: group
    run = OneUpdate(iteration)
    with contextlib.suppress(UpdateDone), mock.patch.multiple(script, **given):
        script.train(args, *modules, envs, run)
    return run.losses
