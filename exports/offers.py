"""What a family offers to take away. `exports/<family>.py` has it, under the name of the family's folder.

Such a module may have these functions. Each takes the task of an id first:

- `interface(task, **env_options)`: an `Interface`
- `step_columns(task, arrays, launch_longitude)`: the flights of eval.npz with a row for each step, {name: column}
- `flight_columns(task, arrays, metrics)`: the flights with a row for each. Raises BadInput if there is only one
- `track(task, arrays)`: the flight around the Earth, a `Track`
- `page(task, metrics, arrays, checkpoint, launch_longitude)`: a `Page`; `checkpoint` is the answer of `read_checkpoint`

Only rockets use the longitude. What a module lacks is refused here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import NamedTuple

from common.errors import BadInput
from common.tasks import Task

LACKING = {
    "track": "for OEM and CZML it must be a rocket's",
    "page": "a page is of a rocket or of a small problem",
}


class Interface(NamedTuple):
    """The numbers that a policy takes and gives, for users who call it elsewhere."""

    observation: Sequence[tuple[str, str]]  # name and unit of each number, in order
    action: Sequence[tuple[str, str]]  # the same for the action
    notes: str  # frames, hidden observations, and the use of an action


def offer(task: Task, name: str) -> Callable:
    """The function `name` of the task's family, with the task filled in. Raises BadInput if the family has none."""
    family = type(task).__module__.split(".")[0]
    module = import_module(f"exports.{family}") if find_spec(f"exports.{family}") else None
    if not hasattr(module, name):
        raise BadInput(f"the env_id is {task.env_id}; {LACKING.get(name, 'its family has nothing to export')}")
    return partial(getattr(module, name), task)
