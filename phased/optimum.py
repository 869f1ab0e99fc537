"""The optimum of a table by IPOPT. The unknowns are states and held controls of every step; dynamics are constraints.

Reading order: meshes and transcriptions ("defects"), the program, guesses, solutions. `baselines.py` flies the
solutions. CasADi is imported only where it is used.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from common.errors import BadInput, NoOptimum
from common.ipopt import interruptible, limit
from phased.environment import fly
from phased.lqr import lqr_policy
from phased.problem import PROBLEMS, Phase, Problem

FIRST_STEPS = 40  # most steps of a phase with an event, while its length is unknown
HELD_TRIES = 4  # other numbers of steps that are tried when its length is known
AIMS = (1e-9, 1e-7, 1e-5)  # how far inside its circles and past its events a solution is aimed that misses them
AGREEMENT = 1e-6  # largest relative difference of costs that count as the same optimum
ENOUGH = 2  # guesses that have to lead to the best solution, or more are tried
ALWAYS = 2  # further guesses that are tried in any case
MOST_HISTORIES = 12  # random histories of the controls that are tried


class PhaseMesh(NamedTuple):
    """The steps into which a program cuts each phase.

    A phase of fixed time has steps of dt / `refine`. A phase that ends by an event has one unknown length h. It is the
    length of the last step, after steps of dt as the environment flies them. With `stretched` it is the length of all
    steps.
    """

    counts: tuple[int, ...]
    stretched: bool = False
    refine: int = 1

    @classmethod
    def of(cls, problem: Problem) -> PhaseMesh:
        """A problem's mesh without events, or its first one with events, which finds out how long the phases are."""
        most = FIRST_STEPS
        counts = [phase.steps if phase.end is None else min(phase.steps, most) for phase in problem.phases]
        return cls(tuple(counts), problem.has_events)

    def refined(self, factor: int) -> PhaseMesh:
        """The mesh with steps that are `factor` times shorter."""
        return PhaseMesh(tuple(count * factor for count in self.counts), True, factor)


def shooting(problem: Problem, phase: Phase, x, u, p, h, x_next, w=()):
    """Defect of multiple shooting, x_{k+1} - step(x_k, u_k) with the environment's step, the running cost, and the
    states after the step's beginning at which constraints hold.
    """
    after, running, points = problem.advance(phase, x, u, p, h, w)
    ends = [*points[:-1], x_next] if points else []
    return tuple(b - a for a, b in zip(after, x_next)), running, ends


def hermite_simpson(problem: Problem, phase: Phase, x, u, p, h, x_next, w=()):
    """Defect of direct collocation, the running cost by Simpson's rule, and the states at which constraints hold after
    the step's beginning.

    A cubic through both ends of the step obeys x' = f(x, u) at mid-step, with a held control. Source: Hargraves and
    Paris (1987), in the compressed form of Betts, Practical Methods for Optimal Control, section 4.5.
    """
    f = problem.with_parameters(phase.f or problem.f, p)
    dx = f(x, u)
    dx_next = f(x_next, u)
    x_mid = tuple((a + b) / 2 + h / 8 * (da - db) for a, b, da, db in zip(x, x_next, dx, dx_next))
    dx_mid = f(x_mid, u)
    defects = tuple(b - a - h / 6 * (da + 4 * dm + db) for a, b, da, dm, db in zip(x, x_next, dx, dx_mid, dx_next))
    if phase.running is None:
        return defects, 0.0, [x_mid, x_next]
    running = problem.with_parameters(phase.running, p)
    return defects, h / 6 * (running(x, u) + 4 * running(x_mid, u) + running(x_next, u)), [x_mid, x_next]


def program(problem: Problem, mesh: PhaseMesh, defect: Callable, in_circles: bool):
    """The nonlinear program as CasADi symbols, and the bounds of its constraints: (symbols, lbg, ubg).

    - unknowns: the controls u_0..u_{T-1}, m each, the states x_1..x_T, n each, and the lengths h of `PhaseMesh`
    - parameters: x_0, the hidden parameters, and the numbers w of every step
    - cost: J of `phased/environment.py`, which is the paper's "J" as a sum over steps
    - constraints: the defects (n T of them, = 0); with `in_circles` the sum of (dx / r)^2 at each phase's end (<= 1);
      for a phase with an event its value at the end (= 0) and before (>= 0); the square of a bounded norm; the table's
      own `constraints` (<= 0)
    """
    import casadi as ca

    ca.GlobalOptions.setNumpyMode(1)  # np.sin of a symbol is a symbol; without this CasADi warns
    n, m, T = problem.states, problem.controls, sum(mesh.counts)
    hidden = len(problem.hidden(np.zeros((1, problem.drawn))))
    x0 = ca.SX.sym("x0", n)
    p = ca.SX.sym("p", hidden)
    w = ca.SX.sym("w", len(problem.noise), T)
    u = ca.SX.sym("u", m, T)
    x = ca.SX.sym("x", n, T)
    h = ca.SX.sym("h", sum(phase.end is not None for phase in problem.phases))
    parameters = tuple(ca.vertsplit(p))
    lengths = iter(ca.vertsplit(h))
    state = tuple(ca.vertsplit(x0))
    t = 0
    cost = 0
    defects, circles, events, norms, constraints = [], [], [], [], []
    for phase, count in zip(problem.phases, mesh.counts):
        dt = problem.dt / mesh.refine
        length = dt if phase.end is None else next(lengths)
        for step in range(count):
            is_last = step == count - 1
            seconds = length if is_last or mesh.stretched else dt
            state_next = tuple(x[k, t] for k in range(n))
            controls = [u[k, t] for k in range(m)]
            share = seconds / problem.dt
            aims = zip(problem.state_weights(phase), state, problem.targets_of(phase))
            cost += share * sum(q * (xi - target) ** 2 for q, xi, target in aims if target is not None)
            cost += share * sum(r * ui**2 for r, ui in zip(problem.control_weights(phase), controls))
            control = problem.as_control(controls)
            gaps, running, points = defect(
                problem, phase, state, control, parameters, seconds, state_next, ca.vertsplit(w[:, t])
            )
            cost += running
            defects += gaps
            if phase.end is not None:
                events.append((problem.with_parameters(phase.end, parameters)(state_next), is_last))
            if problem.u_norm is not None:
                norms.append(sum(ui**2 for ui in controls))
            for value in problem.constraints_at(state, control, parameters):
                # what the new control leaves as it is has been asked at the end of the step before
                if ca.depends_on(ca.SX(value), u[:, t]) or (problem.step is not None and t > 0):
                    constraints.append(value)
            for point in points:
                constraints += problem.constraints_at(point, control, parameters)
            state = state_next
            t += 1
        d = problem.distances(phase, state)
        cost += phase.Qf * sum(di**2 for di in d)
        if phase.terminal is not None:
            cost += problem.with_parameters(phase.terminal, parameters)(state)
        if phase.has_circle:
            d = problem.misses(phase, state, parameters)
            radii = phase.radius if isinstance(phase.radius, tuple) else (phase.radius,) * len(d)
            circles.append(sum((di / r) ** 2 for di, r in zip(d, radii)))
    circles = circles if in_circles else []
    g = ca.vertcat(*defects, *circles, *(value for value, _ in events), *norms, *constraints)
    least, greatest = problem.u_norm or (0.0, 0.0)
    low = [0.0] * len(defects) + [-np.inf] * len(circles) + [0.0] * len(events) + [least**2] * len(norms)
    low += [-np.inf] * len(constraints)
    high = [0.0] * len(defects) + [1.0] * len(circles)
    high += [0.0 if is_last else np.inf for _, is_last in events] + [greatest**2] * len(norms)
    high += [0.0] * len(constraints)
    symbols = {"x": ca.vertcat(ca.vec(u), ca.vec(x), h), "p": ca.vertcat(x0, p, ca.vec(w)), "f": cost, "g": g}
    return symbols, np.array(low), np.array(high)


@cache
def solver(problem: Problem, mesh: PhaseMesh, defect: Callable, in_circles: bool):
    """IPOPT for `program`, built once per process: its CasADi function, and the arguments that all starts share.

    Raises NoOptimum if the table's functions make no program.
    """
    import casadi as ca

    options = {
        "expand": True,
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "show_eval_warnings": False,  # IPOPT takes a shorter step where a function is NaN
        "ipopt.tol": 1e-10,
        "ipopt.bound_relax_factor": 0,  # the default lets solutions end 2.5e-7 outside their circle
        "ipopt.max_wall_time": limit["seconds"],
    }
    T = sum(mesh.counts)
    (u_low, u_high), (x_low, x_high) = problem.u_box, problem.limits
    longest = []
    for phase, count in zip(problem.phases, mesh.counts):
        if phase.end is not None:
            longest.append(problem.dt * phase.steps / count if mesh.stretched else problem.dt)
    shortest = 1e-6 * np.array(longest) if mesh.stretched else np.zeros(len(longest))
    try:
        symbols, lbg, ubg = program(problem, mesh, defect, in_circles)
    except Exception as error:  # a user's function can fail in any way on symbols
        raise NoOptimum(why_no_symbols(problem, error)) from error
    arguments = {
        "lbx": np.concatenate([np.tile(u_low, T), np.tile(x_low, T), shortest]),
        "ubx": np.concatenate([np.tile(u_high, T), np.tile(x_high, T), longest]),
        "lbg": lbg,
        "ubg": ubg,
    }
    return ca.nlpsol("optimum", "ipopt", symbols, options), arguments


def why_no_symbols(problem: Problem, error: Exception) -> str:
    """One line that says what CasADi cannot take in a table's functions."""
    if "truth value" in str(error):
        allowed = "no `if`, `min` or `max` of Python, but NumPy's `where`, `minimum` and `maximum`"
        return f"the dynamics of {problem.env_id} decide by a value; they may hold {allowed}"
    first = next(iter(str(error).strip().splitlines()), "")
    allowed = "arithmetic and NumPy's functions of one state at a time; a matrix product has to be written out"
    return f"the functions of {problem.env_id} fail on CasADi's symbols ({first:.100}); they may hold {allowed}"


class Sketch(NamedTuple):
    """A guess or solution of a phase, in any number K of steps."""

    u: np.ndarray  # (K, m) controls, held between the states
    x: np.ndarray  # (K+1, n) states
    seconds: float  # duration of the phase


def lasting(times: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The controls at mid-step between `times`. Each of u (K, m) is held for 1 / K of the time 0 to 1."""
    middle = (times[:-1] + times[1:]) / 2
    return u[np.minimum((middle * len(u)).astype(int), len(u) - 1)]


def placed(problem: Problem, mesh: PhaseMesh, sketches: list[Sketch]) -> np.ndarray:
    """The unknowns of a mesh, interpolated from the sketches of the phases."""
    controls, states, lengths = [], [], []
    for phase, count, sketch in zip(problem.phases, mesh.counts, sketches):
        times = np.linspace(0, 1, count + 1)
        if phase.end is not None and not mesh.stretched:  # whole steps and a shorter last one
            times = np.minimum(np.arange(count + 1) * problem.dt / sketch.seconds, 1.0)
            times[-1] = 1.0
        controls.append(lasting(times, sketch.u))
        own_times = np.linspace(0, 1, len(sketch.x))
        states.append(np.column_stack([np.interp(times[1:], own_times, row) for row in sketch.x.T]))
        if phase.end is not None:
            last = np.clip(sketch.seconds - problem.dt * (count - 1), 0.0, problem.dt)
            lengths.append(sketch.seconds / count if mesh.stretched else last)
    return np.concatenate([np.vstack(controls).ravel(), np.vstack(states).ravel(), lengths])


def sketches_of(problem: Problem, mesh: PhaseMesh, x0, solution: np.ndarray) -> list[Sketch]:
    """The unknowns of a solution by phase. `placed` turns them into those of another mesh."""
    T, n, m = sum(mesh.counts), problem.states, problem.controls
    u = solution[: m * T].reshape(T, m)
    x = np.vstack([x0, solution[m * T : (m + n) * T].reshape(T, n)])
    lengths = iter(solution[(m + n) * T :])
    sketches, begin = [], 0
    for phase, count in zip(problem.phases, mesh.counts):
        seconds = problem.dt * count / mesh.refine
        if phase.end is not None:
            h = next(lengths)
            seconds = h * count if mesh.stretched else problem.dt * (count - 1) + h
        sketches.append(Sketch(u[begin : begin + count], x[begin : begin + count + 1], seconds))
        begin += count
    return sketches


def guess_policies(problem: Problem) -> list[Callable]:
    """The feedback laws whose flights are guesses: the table's own law, if it has one.

    Otherwise, with costs by weights, they are LQR about the targets and, for two states and one control, a law that
    replaces a saturated LQR by full control along the velocity, which adds most energy. With other costs they are the
    middle of the set of controls and its ends.
    """
    low, high = problem.u_box
    if problem.guess is not None:
        return [law_of(problem, problem.guess)]
    if not problem.weighted or problem.has_events:
        constants = [problem.u_centre, high, low]
        if problem.u_norm is not None:
            constants = [np.eye(problem.controls)[-1] * size for size in problem.u_norm]
        return [lambda obs, t, u=u: np.tile(u, (len(obs), 1)) for u in constants]
    near = lqr_policy(problem)
    if problem.states > 2 or problem.controls > 1:
        return [near]

    def pump(obs, t):
        u = near(obs, t)
        return np.where(np.abs(u) < problem.u_max, u, problem.u_max * np.sign(obs[:, 1:2]))

    return [near, pump]


def law_of(problem: Problem, law: Callable) -> Callable:
    """The policy for `envs.fly` of a table's feedback law u = law(x)."""

    def policy(obs, t):
        controls = law(tuple(obs[:, : problem.states].T))
        rows = controls if isinstance(problem.u_max, tuple) else (controls,)
        return np.column_stack([np.broadcast_to(row, len(obs)) for row in rows])

    return policy


def guesses(problem: Problem, x0, draw):
    """Yield IPOPT's guesses for the start x0 (n,), each as the sketches of the phases.

    The first guess rests on the targets, in the middle of the set of controls. With `Problem.single_optimum` it is the
    only one. The next guess is straight lines from the start to the targets. Then come the flights of `guess_policies`
    that do not diverge. Each start has its own guesses, so its solution does not depend on other starts or on how
    processes share the starts.

    We chose the guesses on pendulums x2' = sin x1 + u, swung up with |u| <= 0.2 to 0.3 from 20 starts each. Over 10 to
    15 s the first guess ended above the best of the four at up to 5 % of the starts, with up to 1.46 of their sum of
    costs. Over 20 s the first guess failed at 85 % of the starts, and the two flights at none. The flights take less
    time than the first two guesses. Full control of either sign, no control, and full control against the velocity
    added little. The best of four can still be a local optimum.
    """
    corners = [np.asarray(x0, dtype=float)]
    for phase in problem.phases:
        aims = zip(problem.targets_of(phase), corners[-1])
        corners.append(np.array([before if target is None else target for target, before in aims]))
    middle = problem.u_centre
    if problem.u_norm is not None:
        middle = np.eye(problem.controls)[-1] * np.mean(problem.u_norm)

    def resting(phase, x):
        share = 0.5 if phase.end is not None else 1.0  # share of the longest time
        return Sketch(np.tile(middle, (phase.steps, 1)), x, share * phase.steps * problem.dt)

    yield [resting(phase, np.tile(end, (phase.steps + 1, 1))) for phase, end in zip(problem.phases, corners[1:])]
    if problem.single_optimum:
        return
    if not np.array_equal(corners[:-1], corners[1:]):  # without targets the lines are the rest
        lines = zip(problem.phases, corners[:-1], corners[1:])
        yield [resting(phase, np.linspace(begin, end, phase.steps + 1)) for phase, begin, end in lines]
    for policy in guess_policies(problem):
        sketches = flown_sketches(problem, policy, x0, draw)
        if sketches is not None:
            yield sketches


def further_guesses(problem: Problem, x0, draw):
    """Yield guesses for a table with events or with costs by functions: flights of controls that change with time.

    The first flight sweeps each control from 10 % to 90 % of its range. The others follow lines through 2 to 4 random
    values. Their seeds are fixed, so all starts have the same ones. On Bryson and Ho's orbit raising the constants of
    `guess_policies` end in a local optimum. The sweep reaches the best one, and so does a tenth of the random
    histories. Random controls at each step do not.
    """
    if problem.single_optimum or problem.weighted and not problem.has_events:
        return
    low, high = problem.u_box
    anchors = [low + np.array([[0.1], [0.9]]) * (high - low)]
    for seed in range(MOST_HISTORIES):
        rng = np.random.default_rng(seed)
        anchors.append(rng.uniform(low, high, (2 + seed % 3, problem.controls)))
    for values in anchors:
        own_times = np.linspace(0, problem.steps - 1, len(values))
        history = np.column_stack([np.interp(np.arange(problem.steps), own_times, row) for row in values.T])
        sketches = flown_sketches(problem, policy_of(history), x0, draw)
        if sketches is not None:
            yield sketches


def policy_of(u: np.ndarray) -> Callable:
    """The policy of one flight that applies the controls u (K, m), and then holds the last one."""
    return lambda obs, t: u[min(t, len(u) - 1)][None]


def flown_sketches(problem: Problem, policy, x0, draw) -> list[Sketch] | None:
    """The flight of a policy as sketches. None if it diverges, or if there are events and several phases."""
    try:
        with np.errstate(all="ignore"):
            flight = fly(problem.env_id, policy, x0[None], draw[None])
    except BadInput:  # a state that overflows is refused
        return None
    x = flight["x"][0]
    u = flight["u"][0].reshape(problem.steps, problem.controls)
    if problem.has_events:
        flown = int(np.isfinite(u).all(axis=1).sum())
        beyond = np.abs(x[: flown + 1]) > problem.x_max
        if problem.waypoints or not flown or beyond.any():
            return None
        return [Sketch(u[:flown], x[: flown + 1], float(flight["final_time"][0]))]
    if not (np.isfinite(x).all() and np.isfinite(u).all()):
        return None
    ends = [0, *problem.phase_ends]
    pieces = zip(ends[:-1], ends[1:])
    return [Sketch(u[a:b], x[a : b + 1], (b - a) * problem.dt) for a, b in pieces]


class StartJob(NamedTuple):
    """A start that is to be solved, with all that a process needs."""

    env_id: str
    defect: Callable
    in_circles: bool
    index: int
    x0: np.ndarray
    draw: np.ndarray


class Solution(NamedTuple):
    """What IPOPT found on a mesh."""

    mesh: PhaseMesh
    unknowns: np.ndarray
    cost: float
    multipliers: np.ndarray  # of the circles' constraints
    bound_price: float  # the least `Problem.bound_price` with which crossing a bound does not pay
    constraint_price: float  # the same of `Problem.constraint_price`
    status: str  # IPOPT's return status
    guesses: int = 1  # guesses that were tried
    guesses_agree: int = 1  # those that lead to this cost

    @property
    def succeeded(self) -> bool:
        return self.status in ("Solve_Succeeded", "Solved_To_Acceptable_Level")


def aimed(problem: Problem, mesh: PhaseMesh, job: StartJob, sketches: list[Sketch], aim: float) -> dict:
    """The arguments of `solver` with smaller circles, and with ends past their events.

    Circles are smaller by the share `aim`, or its root if there are events. An event's value is at least the share
    `aim` of its largest value on the way until the end, where it is -`aim`.
    """
    _, arguments = solver(problem, mesh, job.defect, job.in_circles)
    low = arguments["lbg"].copy()
    high = arguments["ubg"].copy()
    begin = problem.states * sum(mesh.counts)
    if job.in_circles:
        circles = sum(phase.has_circle for phase in problem.phases)
        # an event that is grazed comes sooner by the root of the aim, and the state there differs as much
        smaller = np.sqrt(aim) if problem.has_events else aim
        high[begin : begin + circles] = (1 - smaller) ** 2
        begin += circles
    hidden = tuple(float(value[0]) for value in problem.hidden(job.draw[None]))
    for phase, count, sketch in zip(problem.phases, mesh.counts, sketches):
        if phase.end is None:
            continue
        values = problem.with_parameters(phase.end, hidden)(tuple(sketch.x.T))
        past = aim * np.abs(values).max()
        last = begin + count - 1
        low[begin:last] = past
        low[last] = high[last] = -past
        begin += count
    return {**arguments, "lbg": low, "ubg": high}


def solve_on(problem: Problem, mesh: PhaseMesh, job: StartJob, sketches: list[Sketch], aim: float = 0.0) -> Solution:
    """Solve a job on a mesh, from a guess. `aim` is how far it is `aimed` beyond what it has to reach."""
    solve, arguments = solver(problem, mesh, job.defect, job.in_circles)
    if aim:
        arguments = aimed(problem, mesh, job, sketches, aim)
    p = [float(value[0]) for value in problem.hidden(job.draw[None])]
    w = job.draw[problem.scores :]
    found = solve(p=np.concatenate([job.x0, p, w]), x0=placed(problem, mesh, sketches), **arguments)
    begin = problem.states * sum(mesh.counts)
    circles = sum(phase.has_circle for phase in problem.phases) if job.in_circles else 0
    multipliers = found["lam_g"].full()[begin : begin + circles, 0]
    status = solve.stats()["return_status"]
    unknowns = found["x"].full()[:, 0]
    first = problem.controls * sum(mesh.counts)
    of_states = found["lam_x"].full()[first : first + begin, 0].reshape(-1, problem.states)
    bound_price = float((np.abs(of_states) * problem.scale).max() / problem.dt * mesh.refine)
    constraint_price = 0.0
    if problem.constraints:  # the last rows
        a_step = problem.substeps if job.defect is shooting else 2
        count = len(problem.constraints_at(tuple(job.x0), problem.as_control(problem.u_centre), tuple(p)))
        events = sum(number for number, phase in zip(mesh.counts, problem.phases) if phase.end is not None)
        norms = 0 if problem.u_norm is None else sum(mesh.counts)
        rows = np.abs(found["lam_g"].full()[begin + circles + events + norms :, 0])
        # the environment's integral counts half of the flight's last state, and of both ends of a step if u is limited
        if problem.step is None and len(rows) > count * a_step * sum(mesh.counts):
            rows *= 2
        elif problem.step is None:
            rows[-count:] *= 2
        constraint_price = float(rows.max(initial=0.0) / problem.dt * mesh.refine * a_step)
    return Solution(mesh, unknowns, float(found["f"]), multipliers, bound_price, constraint_price, status)


def held_steps(problem: Problem, job: StartJob, sketches: list[Sketch]) -> Solution:
    """The solution in the environment's own steps, from the sketches of one that knows how long the phases are.

    The number of steps is first that of the sketches. If the last step of a phase has the length 0 or dt, one step less
    or more may be better, and is tried.
    """

    def steps_of(sketch, phase):
        whole = int(np.ceil(sketch.seconds / problem.dt - 1e-9))
        return phase.steps if phase.end is None else min(max(whole, 1), phase.steps)

    mesh = PhaseMesh(tuple(steps_of(sketch, phase) for sketch, phase in zip(sketches, problem.phases)))
    best = solve_on(problem, mesh, job, sketches)
    for _ in range(HELD_TRIES):
        sketches = sketches_of(problem, best.mesh, job.x0, best.unknowns)
        counts = list(best.mesh.counts)
        for k, (phase, sketch) in enumerate(zip(problem.phases, sketches)):
            if phase.end is not None and best.succeeded:
                last = sketch.seconds / problem.dt - (counts[k] - 1)
                counts[k] = min(max(counts[k] + (last > 1 - 1e-4) - (last < 1e-4), 1), phase.steps)
            elif phase.end is not None:
                counts[k] = min(counts[k] + 1, phase.steps)  # held steps need more time than stretched ones
        if tuple(counts) == best.mesh.counts:
            break
        other = solve_on(problem, PhaseMesh(tuple(counts)), job, sketches)
        if other.succeeded and not (best.succeeded and best.cost <= other.cost):
            best = other
        elif best.succeeded:
            break
    return best


def agrees(cost: float, other: float) -> bool:
    """Whether two solutions cost the same, up to `AGREEMENT`."""
    return abs(cost - other) <= AGREEMENT * max(abs(other), 1e-4)


def solve_guess(problem: Problem, job: StartJob, guess: list[Sketch]) -> Solution:
    """The solution in the environment's steps that a guess leads to."""
    solution = solve_on(problem, PhaseMesh.of(problem), job, guess)
    if solution.succeeded and problem.has_events:
        return held_steps(problem, job, sketches_of(problem, solution.mesh, job.x0, solution.unknowns))
    return solution


def solutions_of(problem: Problem, job: StartJob) -> list[Solution]:
    """What the guesses lead to, solved or not: first `guesses`, then `further_guesses` until enough agree.

    The stored optima keep their bits: a solution of the further guesses stands before the others only if it is better
    by more than `AGREEMENT`.
    """
    found = [solve_guess(problem, job, guess) for guess in guesses(problem, job.x0, job.draw)]
    solved = sorted((solution for solution in found if solution.succeeded), key=lambda solution: solution.cost)
    for number, guess in enumerate(further_guesses(problem, job.x0, job.draw), start=1):
        if number > ALWAYS and sum(agrees(solution.cost, solved[0].cost) for solution in solved) >= ENOUGH:
            break
        solution = solve_guess(problem, job, guess)
        found.append(solution)
        if not solution.succeeded:
            continue
        is_better = [not agrees(solution.cost, other.cost) and solution.cost < other.cost for other in solved]
        solved.insert(is_better.index(True) if True in is_better else len(solved), solution)
    return [*solved, *(solution for solution in found if not solution.succeeded)]


def controls_of(problem: Problem, solution: Solution) -> np.ndarray:
    """The controls (T, m) of a solution in the environment's steps. The last one is held after an event."""
    u = solution.unknowns[: problem.controls * sum(solution.mesh.counts)].reshape(-1, problem.controls)
    return np.vstack([u, np.tile(u[-1], (problem.steps - len(u), 1))])


def why_it_misses(problem: Problem, job: StartJob, solution: Solution) -> str | None:
    """Why the environment's flight of a solution is no solution, in words. None if it arrives and hits every circle."""
    try:
        with np.errstate(all="ignore"):
            flight = fly(problem.env_id, policy_of(controls_of(problem, solution)), job.x0[None], job.draw[None])
    except BadInput:  # after an event that it does not meet, a flight can diverge
        return "does not meet the event `end`, and diverges"
    if problem.has_events and not flight["arrived"][0]:
        return "does not meet the event `end`"
    if not job.in_circles:
        return None
    for k, phase in enumerate(problem.phases):
        if not flight["hit"][0, k]:
            distance = flight["terminal_error"][0, k]
            return f"ends phase {k + 1} at a distance of {distance:.12g}, outside its circle of {phase.circle_radius:g}"
    return None


def that_arrives(problem: Problem, job: StartJob, solved: list[Solution]) -> Solution:
    """The first of the solutions that agree with the best one and arrive in flight, or the best one aimed anew.

    A solution may miss its event or circle by rounding. Raises NoOptimum if none arrives.
    """
    best = solved[0]
    if job.defect is not shooting or not (job.in_circles or problem.has_events):
        return best
    why = why_it_misses(problem, job, best)
    if why is None:
        return best
    for other in solved[1:]:
        if agrees(other.cost, best.cost) and why_it_misses(problem, job, other) is None:
            return other
    sketches = sketches_of(problem, best.mesh, job.x0, best.unknowns)
    for aim in AIMS:
        other = solve_on(problem, best.mesh, job, sketches, aim)
        if other.succeeded and why_it_misses(problem, job, other) is None:
            return other
    raise NoOptimum(f"the best flight from {named(job)} {why}")


def named(job: StartJob) -> str:
    """A start in a message."""
    return f"start {job.index}, x0 = {job.x0.tolist()}, of {job.env_id}"


@interruptible()
def best_solution(job: StartJob) -> tuple[Solution, bool]:
    """The best solution of a start's guesses in the environment's steps that arrives, and whether IPOPT succeeded.

    Raises NoOptimum if no guess leads to a solution that arrives, unless circles, bounds or events are out of reach.
    """
    problem = PROBLEMS[job.env_id]
    found = solutions_of(problem, job)
    solved = [solution for solution in found if solution.succeeded]
    statuses = dict.fromkeys(solution.status for solution in found)
    # circles, bounds and events can be out of reach; without them every control has a trajectory
    can_be_infeasible = job.in_circles or problem.bounds or problem.constraints or problem.has_events
    if not solved and not (can_be_infeasible and "Infeasible_Problem_Detected" in statuses):
        raise NoOptimum(f"{named(job)}: IPOPT stopped with {', '.join(statuses)}{why_it_stopped(statuses)}")
    if not solved:
        return found[0], False
    agree = sum(agrees(solution.cost, solved[0].cost) for solution in solved)
    return that_arrives(problem, job, solved)._replace(guesses=len(found), guesses_agree=agree), True


@interruptible()
def refined(job: StartJob, best: Solution, factor: int) -> Solution:
    """The solution in steps that are `factor` times shorter, with the job's defect, from the start's best solution."""
    problem = PROBLEMS[job.env_id]
    sketches = sketches_of(problem, best.mesh, job.x0, best.unknowns)
    return solve_on(problem, best.mesh.refined(factor), job, sketches)


@interruptible()
def coarse(job: StartJob, best: Solution, finer: Solution) -> Solution:
    """The solution in the environment's own steps, from a finer one, whose controls are averaged over each step."""
    problem = PROBLEMS[job.env_id]
    sketches = []
    for count, sketch in zip(best.mesh.counts, sketches_of(problem, finer.mesh, job.x0, finer.unknowns)):
        sketches.append(sketch._replace(u=sketch.u.reshape(count, -1, problem.controls).mean(axis=1)))
    if problem.has_events:
        return held_steps(problem, job, sketches)
    return solve_on(problem, best.mesh, job, sketches)


def why_it_stopped(statuses) -> str:
    """The usual cause of a solve that does not end, in words."""
    if "Maximum_Iterations_Exceeded" in statuses or "Restoration_Failed" in statuses:
        return (
            " (the usual cause: a function with a step or kink, as np.sign, np.clip or np.abs, or one that is NaN in"
            " the branch of np.where that is not taken)"
        )
    if "Maximum_WallTime_Exceeded" in statuses:
        return f" (after {limit['seconds']:g} s; --solve-seconds gives it more)"
    return ""
