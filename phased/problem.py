"""The table of a small problem: dynamics, controls, starts and phases. A problem of your own is such a table.

A table cannot have states that jump between phases, parameters that the optimum may choose, costs with explicit time
(make the clock a state), or final times that are chosen without an event.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.errors import refuse_unless
from common.integration import rk4
from common.registration import register
from phased.checks import check_problem

LARGEST_SCORE = 3.0  # standard scores are drawn within +-3


def lists_to_tuples(table):
    """Turn a table's lists and arrays into tuples, so that equal tables are one key of the cache of solutions."""
    for name, value in vars(table).items():
        if isinstance(value, list | np.ndarray):
            object.__setattr__(table, name, tuple(value))


@dataclass(frozen=True)
class Phase:
    """One column of a parameter table: how long a phase is, what it costs, and where it should end.

    The cost is given by weights, as in the paper, or by functions, or by both:

    - weights, with d the distance to the target: d'Q d + R u^2, summed over the steps, and Qf |d|^2 at the phase's end
    - `running(x, u)`, integrated over the phase's time, and `terminal(x)` at its end

    Every function of a table takes x as a tuple of states. With hidden parameters it also takes their tuple p as its
    last argument: f(x, u, p), running(x, u, p), terminal(x, p), end(x, p), conditions(x, p).
    """

    steps: int  # duration / dt; with `end` the longest duration
    target: tuple[float | None, ...] | None = None  # of each state, at the phase's end; None: free
    # r_target; a tuple has an ellipse's axes, one for each aimed state and then for each of the conditions
    radius: float | tuple[float, ...] = math.inf
    R: float | tuple[float, ...] = 0.0  # weight of the control, or of each control
    Qf: float = 0.0  # weight of |d|^2 at the end
    bonus: float = 0.0  # terminal bonus B, paid within the radius
    Q: tuple[float, ...] | None = None  # weight of each state; None: 1, or 0 with `running` or `terminal`
    running: Callable | None = None  # cost for each second
    terminal: Callable | None = None  # cost at the end
    end: Callable | None = None  # the phase ends at the moment when end(x) falls through 0
    f: Callable | None = None  # dynamics of this phase; None: the problem's
    conditions: Callable | None = None  # numbers that should be 0 at the end, counted in `radius` beside the target

    def __post_init__(self):
        lists_to_tuples(self)
        if self.Q is None and isinstance(self.target, tuple):
            object.__setattr__(self, "Q", (1.0 if self.weighted else 0.0,) * len(self.target))

    @property
    def weighted(self) -> bool:
        """Whether its cost is the paper's, by weights alone."""
        functions = (self.running, self.terminal, self.conditions)
        return self.target is not None and all(function is None for function in functions)

    @property
    def has_circle(self) -> bool:
        """Whether its end can hit or miss a circle."""
        return self.radius != math.inf

    @property
    def circle_radius(self) -> float:
        """The bound of `Problem.circle_distance`: the radius, or 1 if the distance is in radii."""
        return 1.0 if isinstance(self.radius, tuple) else self.radius


@dataclass(frozen=True)
class Problem:
    """A parameter table with n states and m controls, as many as `x_max` and `u_max` have numbers.

    If `u_max` is one number, the control is a number u. If it is a tuple, the control is a tuple. The set of controls
    is the box from `u_min` (by default -u_max) to `u_max`. With `u_norm` it is all vectors from a least to a greatest
    norm.

    An episode begins in the box `x0` +- `x0_max`. With `scores` k it first draws k standard scores z, clipped at +-3.
    `x0` may then be a function of z, a tuple of k arrays, and `parameters(z)` gives the hidden parameters p.

    The dynamics are x' = `f`(x, u), or x_next = `step`(x, u), such as impulses and closed forms. With `step` a phase
    has no event, and `running` is a sum over the steps. With `noise` `step`(x, u, w) also takes a tuple w of numbers
    that each step draws anew, uniform within +-`noise`. The optimum knows them all.

    `bounds` are constraints in the optimum. The environment charges `bound_price` for each second at a distance of one
    `x_scale` beyond them. `constraints`(x, u) are numbers that must not be above 0 at the beginning of a step and at
    the end of each of its Runge-Kutta steps; with `step` at the beginning alone, where u acts. The environment charges
    `constraint_price` for each second of an excess of 1. A flight along a limit is off by a little, so our training
    charges from `constraint_margin` below 0 on. Both functions take p last.

    `single_optimum` promises that IPOPT ends in the same optimum from every guess, so the reference tries one guess
    (`guesses` of phased/optimum.py). Without it the reference is the best of several.

    Raises BadInput for a table that cannot be flown.
    """

    env_id: str
    f: Callable | None = None  # x' = f(x, u), a tuple of n derivatives
    # these three have to be given, too; the checks refuse the defaults, which stand here because f may be left out
    u_max: float | tuple[float, ...] = math.nan
    phases: tuple[Phase, ...] = ()
    x_max: tuple[float, ...] = ()  # a bound of every reachable |state|, for the observation's box; never a constraint
    dt: float = 0.1  # s, a step, for which a control is held
    x0_max: float | tuple[float, ...] = 1.0  # the paper's "state bounds", by our reading the box of initial states
    single_optimum: bool = False
    guess: Callable | None = None  # u = guess(x), a feedback law whose flight is one more guess at the optimum
    u_min: float | tuple[float, ...] | None = None  # None: -u_max
    u_norm: tuple[float, float] | None = None  # least and greatest norm of the control vector
    u_scale: float | None = None  # the unit of scaled actions (`control_of`); None: half the width of the controls
    x0: tuple[float, ...] | Callable | None = None  # centre of the box (None: the origin), or a function of z
    scores: int = 0  # number of standard scores z
    parameters: Callable | None = None  # hidden parameters of z
    bounds: tuple[tuple[float | None, float | None] | None, ...] | None = None  # least and greatest of each state
    bound_price: float = 0.0
    x_scale: tuple[float, ...] | None = None  # a usual size of each state; None: 1
    velocities: tuple[int, ...] | None = None  # states that `observe_velocity=False` hides; None: the second of two
    substeps: int = 1  # Runge-Kutta steps in a step
    x_names: tuple[str, ...] | None = None
    u_names: tuple[str, ...] | None = None
    step: Callable | None = None  # x_next = step(x, u), a tuple of n states, instead of f
    constraints: Callable | None = None  # a tuple of numbers of (x, u), each to be at most 0
    constraint_price: float = 0.0
    constraint_margin: float = 0.0
    noise: tuple[float, ...] = ()  # half widths of the numbers w that each step draws

    def __post_init__(self):
        lists_to_tuples(self)
        check_problem(self)

    @property
    def steps(self) -> int:
        """The number of steps T of an episode, with events of the longest episode."""
        return sum(phase.steps for phase in self.phases)

    @property
    def waypoints(self) -> bool:
        """Whether it has several phases."""
        return len(self.phases) > 1

    @property
    def phase_ends(self) -> np.ndarray:
        """The step with which each phase ends, (phases,)."""
        return np.cumsum([phase.steps for phase in self.phases])

    @property
    def states(self) -> int:
        """The number of states n."""
        return len(self.x_max)

    @property
    def controls(self) -> int:
        """The number of controls m."""
        return len(self.u_max) if isinstance(self.u_max, tuple) else 1

    @property
    def weighted(self) -> bool:
        """Whether all costs are by weights, as in the paper."""
        return all(phase.weighted for phase in self.phases)

    @property
    def has_events(self) -> bool:
        """Whether a phase may end before its last step."""
        return any(phase.end is not None for phase in self.phases)

    @property
    def drawn(self) -> int:
        """How many numbers an episode draws beside its start: the standard scores, then those of every step."""
        return self.scores + self.steps * len(self.noise)

    @property
    def has_one_flight(self) -> bool:
        """Whether all episodes have the same start."""
        return not self.drawn and not np.any(self.x0_max)

    @property
    def circles_count(self) -> bool:
        """Whether the optimum has to end in the circles. With one phase by weights only J counts, so it need not."""
        return any(phase.has_circle for phase in self.phases) and (self.waypoints or not self.weighted)

    @property
    def u_box(self) -> np.ndarray:
        """The least and the greatest value of each control, (2, m)."""
        high = np.atleast_1d(self.u_max).astype(float)
        low = -high if self.u_min is None else np.atleast_1d(self.u_min).astype(float)
        return np.array([low, high])

    @property
    def u_centre(self) -> np.ndarray:
        """The middle of the set of controls, (m,)."""
        return self.u_box.mean(axis=0)

    @property
    def u_unit(self) -> np.ndarray:
        """The unit (m,) of scaled actions, `control_of`: `u_scale`, or half the width of the set of controls."""
        low, high = self.u_box
        return (high - low) / 2 if self.u_scale is None else np.full(self.controls, self.u_scale)

    def control_of(self, action: np.ndarray) -> np.ndarray:
        """The controls (..., m), not clipped, that scaled actions (..., m) mean.

        With `step` the scale is linear for controls below `u_unit` and logarithmic above it. The impulses of one flight
        can differ by a factor of a thousand. On this scale an error of the policy is small for a small impulse.
        """
        if self.step:
            action = np.sinh(np.clip(action, -50, 50))  # beyond it sinh would overflow
        return action * self.u_unit + self.u_centre

    def scaled(self, u: np.ndarray) -> np.ndarray:
        """The scaled actions (..., m) that mean the controls u (..., m)."""
        action = (u - self.u_centre) / self.u_unit
        return np.arcsinh(action) if self.step else action

    @property
    def scale(self) -> np.ndarray:
        """A usual size of each state, (n,)."""
        return np.ones(self.states) if self.x_scale is None else np.array(self.x_scale, dtype=float)

    @property
    def limits(self) -> np.ndarray:
        """The least and the greatest allowed value of each state, (2, n), infinite for a free state."""
        rows = [(None, None) if row is None else row for row in self.bounds or [None] * self.states]
        low = [-math.inf if least is None else least for least, _ in rows]
        high = [math.inf if greatest is None else greatest for _, greatest in rows]
        return np.array([low, high])

    @property
    def hidden_velocities(self) -> tuple[int, ...]:
        """The indices of the states that are velocities."""
        if self.velocities is not None:
            return self.velocities
        return (1,) if self.states == 2 else ()

    @property
    def state_labels(self) -> list[str]:
        """A name for each state, for figures and tables."""
        if self.x_names is not None:
            return list(self.x_names)
        if self.states == 2:
            return ["position $x_1$", "velocity $x_2$"]
        return [f"$x_{{{k}}}$" for k in range(1, self.states + 1)]

    @property
    def control_labels(self) -> list[str]:
        """A name for each control."""
        if self.u_names is not None:
            return list(self.u_names)
        return ["control $u$"] if self.controls == 1 else [f"control $u_{{{k}}}$" for k in range(1, self.controls + 1)]

    @property
    def parts(self) -> tuple[str, ...]:
        """The names of the cost's parts."""
        weights = ("state", "control") if any(phase.weighted or phase.R for phase in self.phases) else ()
        running = ("running",) if any(phase.running for phase in self.phases) else ()
        bounds = ("bounds",) if self.bounds else ()
        constraints = ("constraints",) if self.constraints else ()
        return (*weights, *running, "terminal", *bounds, *constraints)

    def targets_of(self, phase: Phase) -> tuple[float | None, ...]:
        """The target of each state, None for a free state."""
        return (None,) * self.states if phase.target is None else phase.target

    def aim_of(self, phase: Phase) -> np.ndarray:
        """The target (n,), with 0 for a free state."""
        return np.array([target or 0.0 for target in self.targets_of(phase)])

    def state_weights(self, phase: Phase) -> tuple[float, ...]:
        """Q of each state, 0 without a target."""
        if phase.target is None or phase.Q is None:
            return (0.0,) * self.states
        return tuple(0.0 if target is None else weight for weight, target in zip(phase.Q, phase.target))

    def control_weights(self, phase: Phase) -> tuple[float, ...]:
        """R of each control."""
        return phase.R if isinstance(phase.R, tuple) else (phase.R,) * self.controls

    def distances(self, phase: Phase, x) -> list:
        """The signed distances to the target, of the states that have one."""
        return [xi - target for xi, target in zip(x, self.targets_of(phase)) if target is not None]

    def misses(self, phase: Phase, x, p) -> list:
        """What `radius` bounds: the signed distances to the target, and then the conditions."""
        conditions = () if phase.conditions is None else self.with_parameters(phase.conditions, p)(x)
        return [*self.distances(phase, x), *conditions]

    def circle_distance(self, phase: Phase, x, p) -> np.ndarray:
        """The norm (n,) of `misses` at states x, a tuple of arrays; in radii if `radius` is a tuple."""
        d = self.misses(phase, x, p)
        if not d:
            return np.zeros_like(x[0])
        if isinstance(phase.radius, tuple):
            d = [di / r for di, r in zip(d, phase.radius)]
        return np.hypot.reduce(np.array(d), axis=0)

    def with_parameters(self, function, p) -> Callable:
        """A function of the table, with the hidden parameters p filled in."""
        if self.parameters is None:
            return function
        return lambda *arguments: function(*arguments, p)

    def advance(self, phase: Phase, x, u, p, h, w=()) -> tuple:
        """(x_next, cost, points): the states after h seconds, the cost `running` until then, and what lies between.

        The cost is an integral, or 0 without `running`. `points` are the states after each Runge-Kutta step; the last
        ones are x_next. With `step` there are none. x is a tuple of n arrays or symbols, u is one of them or a tuple,
        p has the hidden parameters, and w the step's own numbers, 0 unless given.
        """
        running = None if phase.running is None else self.with_parameters(phase.running, p)
        if self.step is not None:
            noise = [w or (0.0,) * len(self.noise)] if self.noise else []
            after = self.with_parameters(self.step, p)(x, u, *noise)
            return after, 0.0 if running is None else running(x, u), []
        f = self.with_parameters(phase.f or self.f, p)
        h = h / self.substeps if self.substeps > 1 else h
        points = []
        if running is None:
            for _ in range(self.substeps):
                x = rk4(f, x, u, h)
                points.append(x)
            return x, 0.0, points
        y = (*x, 0.0)  # the cost is one more state
        for _ in range(self.substeps):
            y = rk4(lambda y, u: (*f(y[:-1], u), running(y[:-1], u)), y, u, h)
            points.append(y[:-1])
        return y[:-1], y[-1], points

    def constraints_at(self, x, u, p) -> tuple:
        """The values of `constraints`, or () without it."""
        return () if self.constraints is None else self.with_parameters(self.constraints, p)(x, u)

    def violation(self, x, points, u, p, h, margin: float = 0.0) -> tuple:
        """(excess, worst) of a step of h seconds from x: the integral of what exceeds -`margin`, and the largest
        constraint.

        `points` are those of `advance`. The integral is by the trapezoidal rule; with `step` the excess lasts h.
        Without constraints they are 0 and -inf.
        """
        excess = 0.0
        worst = -math.inf
        if self.constraints is None:
            return excess, worst
        shares = [1.0]
        if points:
            shares = [0.5, *[1.0] * (len(points) - 1), 0.5]
        for point, share in zip([x, *points], shares):
            for value in self.constraints_at(point, u, p):
                excess = excess + share * np.maximum(value + margin, 0.0)
                worst = np.maximum(worst, value)
        return excess * h / sum(shares), worst

    def as_control(self, u):
        """Rows u (m, ...) as the table's functions take them: one row, or a tuple of rows."""
        return tuple(u) if isinstance(self.u_max, tuple) else u[0]

    def starts_in_box(self, rng: np.random.Generator, n: int, at_ends: float = 0.0) -> np.ndarray:
        """n starts (n, states) in the box of a table without a function for them.

        A share `at_ends` of the draws of each number lies at an end of its range.
        """
        centre = np.zeros(self.states) if self.x0 is None else np.array(self.x0, dtype=float)
        half = np.broadcast_to(np.asarray(self.x0_max, dtype=float), self.states)
        wider = half / (1 - at_ends)
        return np.clip(rng.uniform(centre - wider, centre + wider, (n, self.states)), centre - half, centre + half)

    def draws(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """n draws (n, `drawn`): the standard scores, then w of each step."""
        scores = np.clip(rng.standard_normal((n, self.scores)), -LARGEST_SCORE, LARGEST_SCORE)
        if not self.noise:
            return scores
        most = np.tile(self.noise, self.steps)
        return np.hstack([scores, rng.uniform(-most, most, (n, len(most)))])

    def scores_of(self, draw: np.ndarray) -> tuple:
        """The standard scores of draws (n, `drawn`): a tuple of arrays (n,)."""
        return tuple(draw[:, : self.scores].T)

    def hidden(self, draw: np.ndarray) -> tuple:
        """The hidden parameters of draws (n, `drawn`): a tuple of arrays (n,)."""
        if self.parameters is None:
            return ()
        return tuple(np.broadcast_to(value, len(draw)).astype(float) for value in self.parameters(self.scores_of(draw)))

    def noise_of(self, draw: np.ndarray, t: np.ndarray) -> tuple:
        """The numbers w of step t (n,) of draws (n, `drawn`): a tuple of arrays (n,)."""
        first = self.scores + len(self.noise) * t
        return tuple(draw[np.arange(len(draw)), first + k] for k in range(len(self.noise)))


class Tables(dict[str, Problem]):
    """Tables by environment id. Raises BadInput if the id is not the table's, or has another table already."""

    def __setitem__(self, env_id: str, problem: Problem):
        refuse_unless(env_id == problem.env_id, "the id", repr(env_id), f"must be the table's, {problem.env_id}")
        taken = env_id in self and self[env_id] != problem
        refuse_unless(not taken, "env_id", repr(env_id), "is taken already; it must be an id of its own")
        super().__setitem__(env_id, problem)


PROBLEMS = Tables()  # `register_problem` fills it


def register_problem(problem: Problem):
    """Make a table known to `gymnasium.make`, to the scripts and to `baselines.py`, under its `env_id`.

    Its environment (`environment.py`) is imported when one is made. Raises BadInput if the id is taken.
    """
    register(problem.env_id, "make_phased")
    PROBLEMS[problem.env_id] = problem


def starts(seed: int, n: int, x0_max: float | tuple[float, ...] = 1.0) -> np.ndarray:
    """The n starts (n, states) of a seed, uniform in [-x0_max, x0_max] in each component.

    `x0_max` is the problem's: a number for each state, or one number for two states. 1 is the paper's "state bounds".
    """
    bound = np.asarray(x0_max, dtype=float)
    return np.random.default_rng(seed).uniform(-bound, bound, (n, bound.size if bound.ndim else 2))


def uniform(z, low: float, high: float):
    """A uniform number between low and high, from a standard score z, for functions of scores in a table."""
    from scipy.special import ndtr

    return low + (high - low) * ndtr(z)


def flights_of_seed(problem: Problem, seed: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """The starts (n, states) and draws (n, k) of the n flights of a seed, in evaluations and references."""
    rng = np.random.default_rng(seed)
    if callable(problem.x0):
        draw = problem.draws(rng, n)
        x0 = problem.x0(problem.scores_of(draw))
        return np.column_stack([np.broadcast_to(x, n) for x in x0]).astype(float), draw
    x0 = problem.starts_in_box(rng, n)
    return x0, problem.draws(rng, n)
