"""What the project asks of an environment id: a `Task` for each id, with the same methods in every family.

A *family* is a kind of environment. The small problems (`phased/`), the rockets (`rocket/`) and the landers
(`landing/`) have tables. `batched/` is for all other environments derived from `BatchedEnv`. `evaluate.py`, `runs.py`,
the command of `baselines.py` and the benchmarks call `task_of(env_id)`. They never ask which family an id is of.

A new family is a folder with a class of this shape, and one line `add_family(TABLES, "module:function")` in `envs.py`.
So every id is known after `import envs`. A family's module is imported when the task of one of its ids is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Protocol

from common.errors import BadInput


class Task(Protocol):
    """One environment id: its table, its optimum, how a policy on it is measured, printed and drawn.

    `policy(obs (n, obs), t) -> action (n, actions)` is any NumPy function. It is called at the steps t = 0, 1, ... of n
    flights. `env_options` are keyword arguments of the environment. `metrics` is the flat dictionary of eval.json,
    `arrays` is that of eval.npz. Each call of `task_of` makes a new task, so expensive things are kept elsewhere.
    """

    @property
    def env_id(self) -> str: ...

    # --- flying and measuring

    def reset_options(self, eval_seed: int, n: int, **env_options) -> dict:
        """The `options` of a `reset` that starts a batch of n environments on the n evaluated flights of a seed."""
        ...

    def optimum(self, eval_seed: int, n: int, **env_options) -> dict:
        """The optimum of the n evaluated flights of a seed, as the environment flies it.

        Recent answers are remembered. Raises NoOptimum if a solve fails.
        """
        ...

    def evaluate(
        self, policy: Callable, eval_seed: int, n: int, reference: dict | None = None, **env_options
    ) -> tuple[dict, dict]:
        """Fly the policy beside the optimum: (metrics, arrays). `reference` is the answer of `optimum`, if it is known.

        The metrics do not depend on the run. Each is a finite number, a truth value or a string.
        """
        ...

    def reported_metrics(self, metrics: dict, timed_policy: Callable | None = None, **env_options) -> dict:
        """More metrics for the reported evaluation. They are too slow for the evaluations during a training.

        With `timed_policy` they include the time of a decision, if this task reports it.
        """
        ...

    # --- the size of an evaluation, and what a run may not do

    def default_flights(self, is_brief: bool, **env_options) -> int:
        """The number of flights in the reported evaluation if --eval-starts is not given. Fewer if `is_brief`."""
        ...

    def interim_flights(self, n: int, **env_options) -> int:
        """The number of flights in an evaluation during a training, if the reported evaluation has n."""
        ...

    def remark_on_seed(self, eval_seed: int) -> str | None:
        """The line to print if the evaluation's seed is that of the training."""
        ...

    def refusal(self, trains: bool, **env_options) -> tuple[str, str] | None:
        """A flag, such as `no_observe_phase`, that does not fit these options, and why. None if all fit."""
        ...

    # --- words and pictures

    def table(self, metrics: dict) -> str:
        """The printed table, with the optimum beside the policy. Raises KeyError if a number is missing."""
        ...

    def seed_rows(self) -> dict[str, tuple[str, str]]:
        """The rows of a results folder's table of seeds: {key of eval.json: (label, number format)}."""
        ...

    def progress_keys(self, **env_options) -> list[str]:
        """The keys of eval.json that show how a training goes."""
        ...

    def figures(self, arrays: dict, metrics: dict, curves: list[dict]) -> dict[str, Any]:
        """The figures of an evaluation: {file name: Matplotlib figure}.

        curves are {TensorBoard tag: (steps, values)}, this run's first, then those of other seeds. Without curves there
        is no training.png.
        """
        ...

    def animation(self, arrays: dict, metrics: dict) -> Any:
        """The animation of an evaluation, a `drawing.animation.Animation`."""
        ...

    # --- files

    def required_arrays(self, metrics: dict) -> set[str]:
        """The names of the arrays that an eval.npz with these metrics must have."""
        ...

    def kept_arrays(self, arrays: dict) -> dict:
        """The arrays that a results folder keeps."""
        ...

    # --- commands

    def speed_cases(self) -> list[tuple[str, dict, list | None]]:
        """What `benchmarks.speed` times: label, options, and an action to hold (None: random actions)."""
        ...

    def add_arguments(self, parser) -> None:
        """Add the flags of `python baselines.py ENV_ID`."""
        ...

    def baseline_command(self, args) -> tuple[dict, dict]:
        """`python baselines.py ENV_ID`: solve and print. Returns the numbers for --json and the arrays for --npz."""
        ...

    def fly_opponents(self, folder: Path, **options) -> None:
        """`python evaluate.py opponents FOLDER`: other guidance on the same flights. Raises BadInput without any."""
        ...


class SampledTask:
    """The base of tasks in which every seed samples new flights. It has the answers that several families give."""

    env_id: str
    kept_flights = 30  # in a results folder

    def reported_metrics(self, metrics: dict, timed_policy: Callable | None = None, **env_options) -> dict:
        return {}

    def default_flights(self, is_brief: bool, **env_options) -> int:
        return 50 if is_brief else 1000

    def interim_flights(self, n: int, **env_options) -> int:
        return n

    def remark_on_seed(self, eval_seed: int) -> str | None:
        return f"--eval-seed {eval_seed} is the training's --seed: it may have flown these starts"

    def refusal(self, trains: bool, **env_options) -> tuple[str, str] | None:
        return None

    def kept_arrays(self, arrays: dict) -> dict:
        """The arrays of the first flights. Only `t` and `decision_s` are the same for all."""
        shared = ("t", "decision_s")
        return {key: array if key in shared else array[: self.kept_flights] for key, array in arrays.items()}

    def speed_cases(self) -> list[tuple[str, dict, list | None]]:
        return [("", {}, None)]

    def fly_opponents(self, folder: Path, **options) -> None:
        raise BadInput(f"the env_id of {folder} is {self.env_id}; it must be a rocket's with cut-off or a lander's")


# (tables by environment id, "module:function" that makes an id's task) of each family
FAMILIES: list[tuple[Mapping[str, Any], str]] = []


def add_family(tables: Mapping[str, Any], make_task: str) -> None:
    """Make a family's ids known, also those that are added to `tables` later.

    `make_task` names the function that makes an id's task, as "module:function".
    """
    FAMILIES.append((tables, make_task))


def env_ids() -> list[str]:
    """Every id that has a task."""
    return [env_id for tables, _ in FAMILIES for env_id in tables]


def task_of(env_id: str) -> Task:
    """The task of an environment id. Raises BadInput if no family has the id."""
    for tables, make_task in FAMILIES:
        if env_id in tables:
            return resolve_name(make_task)(env_id)
    raise BadInput(f"env_id is {env_id!r}, of no family (`add_family`); it must be one of {', '.join(env_ids())}")
