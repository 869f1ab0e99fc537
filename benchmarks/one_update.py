"""One update of a script's `train` on given episodes, for tests and timings of the learning alone."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from unittest import mock

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


class UpdateDone(Exception):
    """Ends `train` after the update."""


class OneUpdate:
    """In place of `runs.Run`: `train` begins with update `iteration`, its losses are kept, and it ends."""

    def __init__(self, iteration):
        self.updates_done, self.losses = iteration - 1, None

    def end_update(self, iteration, alive, episodes, losses, learning_rate):
        self.losses = losses
        raise UpdateDone


def one_update(script, args, modules, envs, batch, iteration=1, group=None):
    """Do update `iteration` of `script.train` without its rollout. Returns its losses.

    modules are agent, average and optimiser. `batch` takes the place of the rollout's. With a `group` there is no other
    curriculum, and the environments need only `num_envs`.
    """
    given = {"rollout": lambda *inputs: (batch, None)}
    if group is not None:
        given["curriculum"] = lambda *inputs: {"flights_per_start": group}
    run = OneUpdate(iteration)
    with contextlib.suppress(UpdateDone), mock.patch.multiple(script, **given):
        script.train(args, *modules, envs, run)
    return run.losses
