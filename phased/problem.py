"""The table of a small problem: dynamics, bounds and phases, as in the paper's tables of simulation parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


def lists_to_tuples(table):
    """Make lists and arrays of a table tuples: equal tables are then one key of what is solved once."""
    for name, value in vars(table).items():
        if isinstance(value, list | np.ndarray):
            object.__setattr__(table, name, tuple(value))


@dataclass(frozen=True)
class Phase:
    """One column of a parameter table. Matrices are diagonal: Q = diag(Q), Q_f = Qf I_2 (printed for one column)."""

    steps: int  # duration / dt
    target: tuple[float, float]  # position and velocity; by our reading passed through at the phase's end, not held
    radius: float  # r_target: within it the bonus is paid
    R: float  # control cost
    Qf: float  # terminal cost
    bonus: float  # terminal bonus B
    Q: tuple[float, float] = (1.0, 1.0)  # state cost

    def __post_init__(self):
        lists_to_tuples(self)


@dataclass(frozen=True)
class Problem:
    """A parameter table: dynamics, control bound, phases; `x_max` (ours) bounds every state reachable from the box.

    `single_optimum` is a promise that IPOPT ends in the same optimum from every guess, so that the reference tries one
    (see `baselines.guesses`): left out, a new problem's reference is the best of several.
    """

    env_id: str
    f: Callable
    u_max: float
    phases: tuple[Phase, ...]
    x_max: tuple[float, float]
    dt: float = 0.1  # s
    x0_max: float = 1.0  # the table's "state bounds", by our reading the box of the initial states, never a constraint
    single_optimum: bool = False

    def __post_init__(self):
        lists_to_tuples(self)

    @property
    def steps(self) -> int:
        """Number of steps T of an episode."""
        return sum(phase.steps for phase in self.phases)

    @property
    def waypoints(self) -> bool:
        """Whether it has several phases."""
        return len(self.phases) > 1

    @property
    def phase_ends(self) -> np.ndarray:
        """The step with which each phase ends, (phases,)."""
        return np.cumsum([phase.steps for phase in self.phases])


PROBLEMS: dict[str, Problem] = {}  # by environment id; `envs.py` fills it


def starts(seed: int, n: int, x0_max: float = 1.0) -> np.ndarray:
    """The n starts (n, 2) of a seed, in evaluations and references: uniform in [-x0_max, x0_max] in each component.

    `x0_max` is the problem's; 1 are the paper's "state bounds".
    """
    return np.random.default_rng(seed).uniform(-x0_max, x0_max, (n, 2))
