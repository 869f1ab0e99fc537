"""What the project asks of an environment id: one `Task` object for each, the same few methods for every family.

A *family* is a kind of environment: the small problems (`phased/`) and the rockets (`rocket/`), which have tables, and
every other environment that is derived from `BatchedEnv` (`batched/`). `evaluate.py`, `runs.py`, the command of
`baselines.py` and the benchmarks call `task_of(env_id)` and never ask which family it is. A new family is a folder with
a class of this shape, and one line `add_family(TABLES, make_task)` in `envs.py`. The small problems' line is in
`baselines.py`, which solves them: their ids are known once that is imported, as `evaluate.py` does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from common.errors import BadInput


class Interface(NamedTuple):
    """What a policy is given and what it answers, for those who call it elsewhere."""

    observation: Sequence[tuple[str, str]]  # name and unit of each number, in order
    action: Sequence[tuple[str, str]]
    notes: str  # frames, what was hidden, and how an action is used


class Task(Protocol):
    """One environment id: its table, its optimum, how a policy on it is measured, printed and drawn.

    `policy(obs (n, obs), t) -> action (n, actions)` is any function in NumPy, called at the steps t = 0, 1, ... of n
    flights. `env_options` are keywords of the environment. `metrics` are what eval.json holds, a flat dictionary;
    `arrays` what eval.npz holds. A task is made anew for each call of `task_of`: what is expensive is kept elsewhere.
    """

    @property
    def env_id(self) -> str: ...

    # --- flying and measuring

    def reset_options(self, eval_seed: int, n: int, **env_options) -> dict:
        """The `options` of a `reset` that starts a batch of n environments on the n evaluated flights of a seed."""
        ...

    def optimum(self, eval_seed: int, n: int, **env_options) -> dict:
        """The optimum of the n evaluated flights of a seed, as the environment flies it.

        What was asked for lately is remembered. Raises NoOptimum where a solve fails.
        """
        ...

    def evaluate(
        self, policy: Callable, eval_seed: int, n: int, reference: dict | None = None, **env_options
    ) -> tuple[dict, dict]:
        """Fly the policy beside the optimum: (metrics, arrays). `reference` is that of `optimum`, if it is known.

        The metrics are those that do not depend on the run; each is a finite number, a truth value or a string.
        """
        ...

    def reported_metrics(self, metrics: dict, timed_policy: Callable | None = None, **env_options) -> dict:
        """More metrics, too slow for the evaluations during a training: only the reported evaluation has them.

        With `timed_policy` also the time of a decision, where this task reports it.
        """
        ...

    # --- the size of an evaluation, and what a run may not do

    def default_flights(self, is_brief: bool, **env_options) -> int:
        """How many flights the reported evaluation has where --eval-starts is not given; fewer if `is_brief`."""
        ...

    def interim_flights(self, n: int, **env_options) -> int:
        """How many flights an evaluation during a training has whose reported evaluation has n."""
        ...

    def remark_on_seed(self, eval_seed: int) -> str | None:
        """What to print where the evaluation's seed is that of the training."""
        ...

    def choices(self) -> dict[str, tuple[str, ...]]:
        """The words that flags of this task may take: name -> words."""
        ...

    def refusal(self, trains: bool, **env_options) -> tuple[str, str] | None:
        """A flag (`no_observe_phase`) that does not fit these options, and why; None where all fit."""
        ...

    # --- words and pictures

    def table(self, metrics: dict) -> str:
        """The printed table: optimum beside policy. Raises KeyError where a number is missing."""
        ...

    def seed_rows(self) -> dict[str, tuple[str, str]]:
        """The rows of a results folder's table of seeds: key of eval.json -> (label, number format)."""
        ...

    def progress_keys(self, **env_options) -> list[str]:
        """The keys of eval.json that show how a training goes."""
        ...

    def figures(self, arrays: dict, metrics: dict, curves: list[dict]) -> dict[str, Any]:
        """The figures of an evaluation: file name -> Matplotlib figure.

        curves: {TensorBoard tag: (steps, values)}, that of this run first, then those of other seeds; none, no
        training.png.
        """
        ...

    def animation(self, arrays: dict, metrics: dict) -> Any:
        """The picture that moves: a `drawing.animation.Animation`."""
        ...

    # --- files

    def required_arrays(self, metrics: dict) -> set[str]:
        """The names of the arrays that the eval.npz of these metrics has to hold."""
        ...

    def kept_arrays(self, arrays: dict) -> dict:
        """The arrays that a results folder keeps."""
        ...

    # --- what is taken along (`python evaluate.py export`, `page`)

    def interface(self, **env_options) -> Interface:
        """Names and units of what a policy observes and commands."""
        ...

    def step_columns(self, arrays: dict, launch_longitude: float) -> dict[str, Any]:
        """The flights of eval.npz, a row each step: NumPy columns by name. The longitude is a rocket's."""
        ...

    def flight_columns(self, arrays: dict, metrics: dict) -> dict[str, Any]:
        """The flights of eval.npz, a row each: NumPy columns by name. BadInput where there is but one."""
        ...

    def track(self, arrays: dict) -> Any:
        """The flight around the Earth, a `formats.track.Track`; BadInput where it is none."""
        ...

    def page(self, metrics: dict, arrays: dict, checkpoint: dict, launch_longitude: float) -> Any:
        """The flight in the browser, a `pages.assemble.Page`; BadInput where there is none.

        `checkpoint` is what `read_checkpoint` returns. The longitude is a rocket's.
        """
        ...

    # --- commands

    def speed_cases(self) -> list[tuple[str, dict, list | None]]:
        """What `benchmarks/env_speed.py` times: a label, options, and an action to hold (None: a random one)."""
        ...

    def add_arguments(self, parser) -> None:
        """Add the flags of `python baselines.py ENV_ID`."""
        ...

    def baseline_command(self, args) -> tuple[dict, dict]:
        """`python baselines.py ENV_ID`: solve and print; the numbers and arrays that --json and --npz ask for."""
        ...

    def fly_opponents(self, folder: Path, **options) -> None:
        """`python evaluate.py opponents FOLDER`: other guidance on the same flights; BadInput where there is none."""
        ...


class GroundTask:
    """What is refused of an id whose flights do not go around the Earth."""

    env_id: str

    def track(self, arrays: dict) -> Any:
        raise BadInput(f"the env_id is {self.env_id}; for OEM and CZML it must be a rocket's")

    def page(self, metrics: dict, arrays: dict, checkpoint: dict, launch_longitude: float) -> Any:
        raise BadInput(f"the env_id is {self.env_id}; a page is of a rocket or of a small problem")


class SampledTask(GroundTask):
    """What tasks have in common whose flights are sampled anew by every seed, and all cost the same."""

    def reported_metrics(self, metrics: dict, timed_policy: Callable | None = None, **env_options) -> dict:
        return {}

    def default_flights(self, is_brief: bool, **env_options) -> int:
        return 50 if is_brief else 1000

    def interim_flights(self, n: int, **env_options) -> int:
        return n

    def choices(self) -> dict[str, tuple[str, ...]]:
        return {}

    def remark_on_seed(self, eval_seed: int) -> str | None:
        return f"--eval-seed {eval_seed} is the training's --seed: it may have flown these starts"


# of each family its tables by environment id, and how to make a task of an id
FAMILIES: list[tuple[Mapping[str, Any], Callable[[str], Task]]] = []


def add_family(tables: Mapping[str, Any], make_task: Callable[[str], Task]) -> None:
    """Make a family's ids known, or known anew. `tables` is kept: an id that is added to it later is known, too."""
    FAMILIES[:] = [family for family in FAMILIES if family[0] is not tables]
    FAMILIES.append((tables, make_task))


class ForEachId(Mapping):
    """A mapping by environment id whose values are made when they are asked for."""

    def __init__(self, env_ids, make: Callable[[str], Any]):
        self.env_ids, self.make = tuple(env_ids), make

    def __getitem__(self, env_id: str):
        if env_id not in self.env_ids:
            raise KeyError(env_id)
        return self.make(env_id)

    def __iter__(self):
        return iter(self.env_ids)

    def __len__(self) -> int:
        return len(self.env_ids)


def env_ids() -> list[str]:
    """Every id that has a task."""
    return [env_id for tables, _ in FAMILIES for env_id in tables]


def task_of(env_id: str) -> Task:
    """The task of an environment id. Raises BadInput where no family has it."""
    for tables, make_task in FAMILIES:
        if env_id in tables:
            return make_task(env_id)
    raise BadInput(f"env_id is {env_id!r}, of no family (`add_family`); it must be one of {', '.join(env_ids())}")
