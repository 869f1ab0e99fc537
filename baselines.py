"""Reference optima: Riccati, box QP, and IPOPT for the small problems; the command that solves any id's optimum.

    python baselines.py double-integrator --starts 1000 --seed 0
    python baselines.py van-der-pol --json van_der_pol.json --npz van_der_pol.npz
    python baselines.py double-integrator-waypoints
    python baselines.py van-der-pol-waypoints
    python baselines.py VanDerPol-v0 --starts 20          # every id is a sub-command, too
    python baselines.py TwoStageLEO-v0
    python baselines.py rocket --json results/rocket_reference.json --npz results/rocket_reference.npz

Each prints mean costs over random starts and what they are compared with; a rocket has one start. All optima are flown
once more by the environments.
Reading order: linear-quadratic optimum, nonlinear programs, references, what they are compared with, command line; the
rockets' optima are in `rocket/optimum.py`. CasADi and SciPy are imported only where they are used: in a training at its
start, when it solves the optimum that its evaluations fly.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from functools import cache, lru_cache
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np

from common.command_line import OneLineParser, integer, output_file
from common.errors import BadInput, NoOptimum
from common.files import replacing, write_npz
from common.ipopt import interruptible, limit
from common.tasks import add_family, env_ids, task_of
from envs import DOUBLE_INTEGRATOR, PROBLEMS, Phase, Problem, fly
from phased.problem import flights_of_seed, starts
from phased.task import PhasedTask
from rocket.optimum import rocket_reference
from rocket.report import report_all_rockets

__all__ = [  # what users import from here
    "NoOptimum", "box_qp", "linearise", "lqr", "lqr_policy", "optimise", "reference", "riccati", "rocket_reference",
    "starts",
]  # fmt: skip

STARTS_PER_PROCESS = 100  # fewer are solved sooner than another process has started
# relative difference between the cost of a program's solution and of its flight; an event is met to rounding alone
REPLAY_TOLERANCE = 1e-8
REPLAY_TOLERANCE_OF_EVENTS = 1e-5

# ---------------------------------------------------------------------------------------------------------------------
# Linear-quadratic optimum
# ---------------------------------------------------------------------------------------------------------------------


def linearise(problem: Problem, point=None):
    """A (n, n) and B (n, m) of x_{k+1} = A x_k + B u_k + const. about a point (the origin), for the environment's step.

    Central differences of fourth order, with a step that is a power of two: for a linear problem they are exact but for
    rounding, and dynamics need not be analytic, as those with np.abs or np.interp are not.
    """
    n, m = problem.states, problem.controls
    point = np.zeros(n) if point is None else np.asarray(point, dtype=float)
    h = 2.0**-9
    changes = np.hstack([k * h * np.eye(n + m) for k in (-2, -1, 1, 2)])  # (n + m, 4 (n + m)), a change a column
    p = tuple(value[:1] for value in problem.hidden(np.zeros((1, problem.scores))))
    x = tuple(point[:, None] + changes[:n])
    after, _ = problem.step(problem.phases[0], x, problem.as_control(changes[n:]), p, problem.dt)
    far_below, below, above, far_above = np.split(np.array(after), 4, axis=1)
    AB = (8 * (above - below) - (far_above - far_below)) / (12 * h)
    return AB[:, :n], AB[:, n:]


def riccati(problem: Problem):
    """Finite-horizon discrete LQR by the backward Riccati recursion (e.g. Anderson and Moore, Optimal Control, 1990).

    The dynamics are linearised about each phase's target x*, which need not be at rest: with d = x - x* the control is
    u_t = -K_t d_t - k_t and the cost to go d'P_t d + 2 p_t'd + const. A state without a target has no weight, and 0 in
    place of it. Returns K (T, m, n), k (T, m) and P (T+1, n, n). Raises ValueError where costs are not by weights.
    """
    if not problem.weighted or problem.has_events:
        raise ValueError(f"{problem.env_id} has costs by functions, or events; LQR is for weights and fixed times")
    n, m, T = problem.states, problem.controls, problem.steps
    K, k, P, p = np.empty((T, m, n)), np.empty((T, m)), np.zeros((T + 1, n, n)), np.zeros(n)
    end, next_target = T, point_of(problem, problem.phases[-1])
    for phase in reversed(problem.phases):
        target = point_of(problem, phase)
        A, B = linearise(problem, target)
        hidden = problem.hidden(np.zeros((1, problem.scores)))
        rest, _ = problem.step(phase, tuple(target[:, None]), problem.as_control(np.zeros((m, 1))), hidden, problem.dt)
        drift = np.array(rest)[:, 0] - target
        p = p + P[end] @ (target - next_target)  # d is now the distance to this phase's target
        aimed = [value is not None for value in problem.targets_of(phase)]
        P[end] += phase.Qf * np.diag(np.array(aimed, dtype=float))
        R = np.diag(problem.control_weights(phase))
        for t in reversed(range(end - phase.steps, end)):
            weight, ahead = R + B.T @ P[t + 1] @ B, P[t + 1] @ drift + p
            K[t] = np.linalg.solve(weight, B.T @ P[t + 1] @ A)
            k[t] = np.linalg.solve(weight, B.T @ ahead)
            P[t] = np.diag(problem.state_weights(phase)) + A.T @ P[t + 1] @ (A - B @ K[t])
            p = (A - B @ K[t]).T @ ahead
        end, next_target = end - phase.steps, target
    return K, k, P


def point_of(problem: Problem, phase: Phase) -> np.ndarray:
    """A phase's target (n,), with 0 for the states that have none."""
    return np.array([target or 0.0 for target in problem.targets_of(phase)])


def lqr(problem: Problem):
    """The gains K (T, n) of u_t = -K_t x_t and P (T+1, n, n) with the cost to go x'P_t x, by `riccati`; of one control.

    Exact for the double integrator without its bound; for Van der Pol the linearisation about the origin. Raises
    ValueError on waypoints.
    """
    if problem.waypoints:
        raise ValueError(f"{problem.env_id} has {len(problem.phases)} phases; LQR is for problems with 1")
    K, _, P = riccati(problem)
    return K[:, 0], P


def targets(problem: Problem) -> np.ndarray:
    """The target of each step's phase, (T, n)."""
    points = [point_of(problem, phase) for phase in problem.phases]
    return np.repeat(points, [phase.steps for phase in problem.phases], axis=0)


def lqr_policy(problem: Problem) -> Callable:
    """LQR about the targets, clipped at the control bounds, as a policy for `envs.fly`."""
    K, k, _ = riccati(problem)
    target, (low, high) = targets(problem), problem.u_box
    n = problem.states
    return lambda obs, t: np.clip(-(obs[:, :n] - target[t]) @ K[t].T - k[t], low, high)


def box_qp(problem: Problem, x0):
    """Optimal controls u (n, T) of the bounded double integrator from x0 (n, 2): the check of clipped LQR.

    All states are written as x = Phi x0 + Gamma u (the condensed form of model predictive control, e.g. Rawlings and
    Mayne), which leaves least squares in u within |u| <= u_max: solved by SciPy's active-set method BVLS.
    """
    from scipy.optimize import lsq_linear

    (phase,), T = problem.phases, problem.steps
    A, B = linearise(problem)
    Phi, Gamma = np.zeros((T + 1, 2, 2)), np.zeros((T + 1, 2, T))
    Phi[0] = np.eye(2)
    for t in range(T):
        Phi[t + 1], Gamma[t + 1] = A @ Phi[t], A @ Gamma[t]
        Gamma[t + 1, :, t] = B[:, 0]
    weight = np.sqrt(np.vstack([np.tile(problem.state_weights(phase), (T, 1)), np.full((1, 2), phase.Qf)]))  # (T+1, 2)
    states = (weight[:, :, None] * Gamma).reshape(-1, T)
    offsets = (weight * (Phi @ np.asarray(x0, dtype=float)[:, None, :, None])[..., 0]).reshape(len(x0), -1)
    system = np.vstack([states, np.sqrt(phase.R) * np.eye(T)])
    bounds = tuple(problem.u_box[:, 0])
    return np.array(
        [lsq_linear(system, np.append(-b, np.zeros(T)), bounds, method="bvls", tol=1e-15).x for b in offsets]
    )


# ---------------------------------------------------------------------------------------------------------------------
# Nonlinear programs: states and held controls of every step are unknowns, the dynamics are constraints ("defects")
# ---------------------------------------------------------------------------------------------------------------------


class Mesh(NamedTuple):
    """The steps into which a program cuts each phase.

    A phase of fixed time has steps of dt / `refine`. One that ends by an event has one length h as an unknown: of its
    last step, behind steps of dt as the environment flies them, or with `stretched` of all its steps.
    """

    counts: tuple[int, ...]
    stretched: bool = False
    refine: int = 1

    @classmethod
    def of(cls, problem: Problem) -> Mesh:
        """That of a problem without events, or the first one with events, which finds out how long the phases are."""
        counts = (phase.steps if phase.end is None else min(phase.steps, FIRST_STEPS) for phase in problem.phases)
        return cls(tuple(counts), problem.has_events)

    def refined(self, factor: int) -> Mesh:
        """One of shorter steps."""
        return Mesh(tuple(count * factor for count in self.counts), True, factor)


FIRST_STEPS = 40


def shooting(problem: Problem, phase: Phase, x, u, p, h, x_next):
    """Defect of multiple shooting, x_{k+1} - step(x_k, u_k), with the environment's own step; and the running cost."""
    after, running = problem.step(phase, x, u, p, h)
    return tuple(b - a for a, b in zip(after, x_next)), running


def hermite_simpson(problem: Problem, phase: Phase, x, u, p, h, x_next):
    """Defect of direct collocation: a cubic through both ends that obeys x' = f(x, u) at mid-step, control held.

    Hargraves and Paris (1987), in the compressed form of Betts, Practical Methods for Optimal Control, section 4.5; the
    running cost by Simpson's rule.
    """
    f = problem.with_parameters(phase.f or problem.f, p)
    dx, dx_next = f(x, u), f(x_next, u)
    x_mid = tuple((a + b) / 2 + h / 8 * (da - db) for a, b, da, db in zip(x, x_next, dx, dx_next))
    dx_mid = f(x_mid, u)
    defects = tuple(b - a - h / 6 * (da + 4 * dm + db) for a, b, da, dm, db in zip(x, x_next, dx, dx_mid, dx_next))
    if phase.running is None:
        return defects, 0.0
    running = problem.with_parameters(phase.running, p)
    return defects, h / 6 * (running(x, u) + 4 * running(x_mid, u) + running(x_next, u))


def program(problem: Problem, mesh: Mesh, defect: Callable, in_circles: bool):
    """The nonlinear program as CasADi symbols, and the bounds of its constraints: (symbols, lbg, ubg).

    Unknowns: the controls u_0..u_{T-1}, m each, the states x_1..x_T, n each, and the lengths h of `Mesh`. Parameters:
    x_0 and the hidden ones. Cost: J of `phased/environment.py` (the paper's "J", summed by us). Constraints: the
    defects (n T of them, = 0); with `in_circles` the sum of (dx / r)^2 at each phase's end (<= 1); where a phase ends
    by an event its value there (= 0) and before (>= 0); the square of a bounded norm.
    """
    import casadi as ca

    ca.GlobalOptions.setNumpyMode(1)  # np.sin of a symbol is a symbol, without the warning that it was not always so
    n, m, T = problem.states, problem.controls, sum(mesh.counts)
    hidden = len(problem.hidden(np.zeros((1, problem.scores))))
    x0, p = ca.SX.sym("x0", n), ca.SX.sym("p", hidden)
    u, x = ca.SX.sym("u", m, T), ca.SX.sym("x", n, T)
    h = ca.SX.sym("h", sum(phase.end is not None for phase in problem.phases))
    parameters, lengths = tuple(ca.vertsplit(p)), iter(ca.vertsplit(h))
    state, t, cost, defects, circles, events, norms = tuple(ca.vertsplit(x0)), 0, 0, [], [], [], []
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
            gaps, running = defect(problem, phase, state, control, parameters, seconds, state_next)
            cost += running
            defects += gaps
            if phase.end is not None:
                events.append((problem.with_parameters(phase.end, parameters)(state_next), is_last))
            if problem.u_norm is not None:
                norms.append(sum(ui**2 for ui in controls))
            state, t = state_next, t + 1
        d = problem.distances(phase, state)
        cost += phase.Qf * sum(di**2 for di in d)
        if phase.terminal is not None:
            cost += problem.with_parameters(phase.terminal, parameters)(state)
        if phase.has_circle:
            circles.append(sum((di / r) ** 2 for di, r in zip(d, problem.radii(phase))))
    circles = circles if in_circles else []
    g = ca.vertcat(*defects, *circles, *(value for value, _ in events), *norms)
    least, greatest = problem.u_norm or (0.0, 0.0)
    low = [0.0] * len(defects) + [-np.inf] * len(circles) + [0.0] * len(events) + [least**2] * len(norms)
    high = [0.0] * len(defects) + [1.0] * len(circles)
    high += [0.0 if is_last else np.inf for _, is_last in events] + [greatest**2] * len(norms)
    symbols = {"x": ca.vertcat(ca.vec(u), ca.vec(x), h), "p": ca.vertcat(x0, p), "f": cost, "g": g}
    return symbols, np.array(low), np.array(high)


@cache
def solver(problem: Problem, mesh: Mesh, defect: Callable, in_circles: bool):
    """IPOPT for `program`, built once per process: its CasADi function and the arguments that no start changes."""
    import casadi as ca

    options = {
        "expand": True,
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
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
    """One line on what CasADi cannot take in a table's functions."""
    if "truth value" in str(error):
        allowed = "no `if`, `min` or `max` of Python, but NumPy's `where`, `minimum` and `maximum`"
        return f"the dynamics of {problem.env_id} decide by a value; they may hold {allowed}"
    first = next(iter(str(error).strip().splitlines()), "")
    allowed = "arithmetic and NumPy's functions of one state at a time; a matrix product has to be written out"
    return f"the functions of {problem.env_id} fail on CasADi's symbols ({first:.100}); they may hold {allowed}"


class Sketch(NamedTuple):
    """A guess or solution of a phase, whatever its steps: controls (K, m) held between the states (K+1, n), seconds."""

    u: np.ndarray
    x: np.ndarray
    seconds: float


def lasting(times: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The controls u (K, m), each held for a K-th of the time 0 to 1, at the middle of the steps between `times`."""
    middle = (times[:-1] + times[1:]) / 2
    return u[np.minimum((middle * len(u)).astype(int), len(u) - 1)]


def placed(problem: Problem, mesh: Mesh, sketches: list[Sketch]) -> np.ndarray:
    """The unknowns of a mesh, as the sketches of the phases have them."""
    controls, states, lengths = [], [], []
    for phase, count, sketch in zip(problem.phases, mesh.counts, sketches):
        times = np.linspace(0, 1, count + 1)
        if phase.end is not None and not mesh.stretched:  # whole steps, and a last one
            times = np.minimum(np.arange(count + 1) * problem.dt / sketch.seconds, 1.0)
            times[-1] = 1.0
        controls.append(lasting(times, sketch.u))
        own_times = np.linspace(0, 1, len(sketch.x))
        states.append(np.column_stack([np.interp(times[1:], own_times, row) for row in sketch.x.T]))
        if phase.end is not None:
            last = np.clip(sketch.seconds - problem.dt * (count - 1), 0.0, problem.dt)
            lengths.append(sketch.seconds / count if mesh.stretched else last)
    return np.concatenate([np.vstack(controls).ravel(), np.vstack(states).ravel(), lengths])


def sketches_of(problem: Problem, mesh: Mesh, x0, solution: np.ndarray) -> list[Sketch]:
    """The unknowns of a solution by phase; `placed` turns them into those of another mesh."""
    T, n, m = sum(mesh.counts), problem.states, problem.controls
    u, x = solution[: m * T].reshape(T, m), np.vstack([x0, solution[m * T : (m + n) * T].reshape(T, n)])
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
    """The feedback laws whose flights are guesses.

    With costs by weights LQR about the targets, and full control along the velocity, which adds most energy, wherever
    that LQR saturates (for two states and one control). With others the middle of the set of controls and its ends, or
    the table's own law.
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
    """A feedback law u = law(x) of the table as a policy for `envs.fly`."""

    def policy(obs, t):
        controls = law(tuple(obs[:, : problem.states].T))
        rows = controls if isinstance(problem.u_max, tuple) else (controls,)
        return np.column_stack([np.broadcast_to(row, len(obs)) for row in rows])

    return policy


def guesses(problem: Problem, x0, draw):
    """Where IPOPT begins from the start x0 (n,): yields the sketches of the phases.

    The first rests on the targets in the middle of the set of controls, which is all with `Problem.single_optimum`.
    Otherwise more: straight lines from the start to the targets, and the flights of `guess_policies` that do not
    diverge. A guess is the start's own, so that a solution depends neither on its neighbours nor on how the starts are
    shared out.

    Chosen on pendulums x2' = sin x1 + u swung up with |u| <= 0.2 to 0.3, 20 starts each. Over 10 to 15 s the first
    guess ended above the best of the four at up to 5 % of the starts, with up to 1.46 of their sum of costs; over 20 s
    it failed at 85 %, the two flights at none. They take less time than the first two. Full control of either sign, no
    control, and full control against the velocity added little. The best of four can still be a local optimum.
    """
    corners = [np.asarray(x0, dtype=float)]
    for phase in problem.phases:
        aims = zip(problem.targets_of(phase), corners[-1])
        corners.append(np.array([before if target is None else target for target, before in aims]))
    middle = problem.u_centre
    if problem.u_norm is not None:
        middle = np.eye(problem.controls)[-1] * np.mean(problem.u_norm)

    def resting(phase, x):
        share = 0.5 if phase.end is not None else 1.0  # of the longest time
        return Sketch(np.tile(middle, (phase.steps, 1)), x, share * phase.steps * problem.dt)

    yield [resting(phase, np.tile(end, (phase.steps + 1, 1))) for phase, end in zip(problem.phases, corners[1:])]
    if problem.single_optimum:
        return
    lines = zip(problem.phases, corners[:-1], corners[1:])
    yield [resting(phase, np.linspace(begin, end, phase.steps + 1)) for phase, begin, end in lines]
    for policy in guess_policies(problem):
        with suppress(BadInput), np.errstate(all="ignore"):  # a state that overflows gives an action that is refused
            sketches = flown_sketches(problem, policy, x0, draw)
            if sketches is not None:
                yield sketches


def flown_sketches(problem: Problem, policy, x0, draw) -> list[Sketch] | None:
    """The flight of a policy as sketches; None where it diverges, or has events and several phases."""
    flight = fly(problem.env_id, policy, x0[None], draw[None])
    x, u = flight["x"][0], flight["u"][0].reshape(problem.steps, problem.controls)
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


class Solution(NamedTuple):
    """What IPOPT found on a mesh; `status` is IPOPT's."""

    mesh: Mesh
    unknowns: np.ndarray
    cost: float
    multipliers: np.ndarray  # of the circles
    bound_price: float  # the least `Problem.bound_price` with which crossing a bound does not pay
    status: str

    @property
    def succeeded(self) -> bool:
        return self.status in ("Solve_Succeeded", "Solved_To_Acceptable_Level")


def solve_on(problem: Problem, mesh: Mesh, job: Job, sketches: list[Sketch]) -> Solution:
    """Solve from a guess."""
    solve, arguments = solver(problem, mesh, job.defect, job.in_circles)
    p = [float(value[0]) for value in problem.hidden(job.draw[None])]
    found = solve(p=np.concatenate([job.x0, p]), x0=placed(problem, mesh, sketches), **arguments)
    begin = problem.states * sum(mesh.counts)
    circles = sum(phase.has_circle for phase in problem.phases) if job.in_circles else 0
    multipliers = found["lam_g"].full()[begin : begin + circles, 0]
    status = solve.stats()["return_status"]
    unknowns = found["x"].full()[:, 0]
    first = problem.controls * sum(mesh.counts)
    of_states = found["lam_x"].full()[first : first + begin, 0].reshape(-1, problem.states)
    bound_price = float((np.abs(of_states) * problem.scale).max() / problem.dt * mesh.refine)
    return Solution(mesh, unknowns, float(found["f"]), multipliers, bound_price, status)


def held_steps(problem: Problem, job: Job, stretched: Solution) -> Solution:
    """The solution in the environment's own steps, from one that has found out how long the phases are.

    The number of steps is that of the stretched solution. Where the last step of a phase ends at 0 or dt, a neighbour
    may be better, and is tried.
    """
    sketches = sketches_of(problem, stretched.mesh, job.x0, stretched.unknowns)

    def steps_of(sketch, phase):
        whole = int(np.ceil(sketch.seconds / problem.dt - 1e-9))
        return phase.steps if phase.end is None else min(max(whole, 1), phase.steps)

    mesh = Mesh(tuple(steps_of(sketch, phase) for sketch, phase in zip(sketches, problem.phases)))
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
        other = solve_on(problem, Mesh(tuple(counts)), job, sketches)
        if other.succeeded and not (best.succeeded and best.cost <= other.cost):
            best = other
        elif best.succeeded:
            break
    return best


HELD_TRIES = 4  # other numbers of steps


class Job(NamedTuple):
    """A start to be solved; it holds all that a process needs."""

    env_id: str
    defect: Callable
    in_circles: bool
    index: int
    x0: np.ndarray
    draw: np.ndarray


@interruptible()
def _solve_start(job: Job):
    """Solve one start: control (T, m), the cost, whether there is a solution, and the circles' multipliers."""
    problem, (best, exists) = PROBLEMS[job.env_id], best_solution(job)
    u = best.unknowns[: problem.controls * sum(best.mesh.counts)].reshape(-1, problem.controls)
    u = np.vstack([u, np.tile(u[-1], (problem.steps - len(u), 1))])  # held on behind an event
    return u, best.cost, exists, best.multipliers


def best_solution(job: Job) -> tuple[Solution, bool]:
    """The best solution of a start's guesses in the environment's steps, and whether it is one."""
    problem = PROBLEMS[job.env_id]
    mesh = Mesh.of(problem)
    found: list[Solution] = []
    for guess in guesses(problem, job.x0, job.draw):
        solution = solve_on(problem, mesh, job, guess)
        if solution.succeeded and problem.has_events:
            solution = held_steps(problem, job, solution)
        found.append(solution)
    solved = [solution for solution in found if solution.succeeded]
    statuses = dict.fromkeys(solution.status for solution in found)
    # circles, bounds and events can be out of reach: without them every control has its trajectory
    can_be_infeasible = job.in_circles or problem.bounds or problem.has_events
    if not solved and not (can_be_infeasible and "Infeasible_Problem_Detected" in statuses):
        where = f"start {job.index}, x0 = {job.x0.tolist()}, of {job.env_id}"
        raise NoOptimum(f"{where}: IPOPT stopped with {', '.join(statuses)}{why_it_stopped(statuses)}")
    return min(solved, key=lambda solution: solution.cost, default=found[0]), bool(solved)


@interruptible()
def refined(job: Job, best: Solution, factor: int) -> Solution:
    """The solution of a start with steps that are `factor` times shorter, by the job's defect, from its best one."""
    problem = PROBLEMS[job.env_id]
    sketches = sketches_of(problem, best.mesh, job.x0, best.unknowns)
    return solve_on(problem, best.mesh.refined(factor), job, sketches)


def why_it_stopped(statuses) -> str:
    """The usual cause of a solve that does not end."""
    if "Maximum_Iterations_Exceeded" in statuses or "Restoration_Failed" in statuses:
        return (
            " (the usual cause: a function with a step or kink, as np.sign, np.clip or np.abs, or one that is NaN in"
            " the branch of np.where that is not taken)"
        )
    if "Maximum_WallTime_Exceeded" in statuses:
        return f" (after {limit['seconds']:g} s; --solve-seconds gives it more)"
    return ""


def optimise(
    env_id: str,
    x0,
    defect: Callable = shooting,
    in_circles: bool = False,
    processes: int | None = None,
    draw=None,
):
    """Solve `program` from each start x0 (n, states): controls u (n, T), or (n, T, m) where the table has a tuple of
    them, costs (n,), whether a solution exists (n,), and the multipliers of the circles' constraints (n, circles), or
    (n, 0) without `in_circles`. draw (n, k) are the standard scores.

    Of several `guesses` the best solution counts; one that fails is no error where another does not. Where no solution
    exists (circles, bounds or an event out of reach) the rest are IPOPT's last ones and mean nothing. Any other failure
    is a RuntimeError that names the start. Equal starts are solved once. `processes` (default: by the number of starts
    and cores) changes only the time; they are spawned, which is safe beside the threads of other libraries.
    """
    problem, x0 = PROBLEMS[env_id], np.asarray(x0, dtype=np.float64)
    draw = np.zeros((len(x0), problem.scores)) if draw is None else np.asarray(draw, dtype=np.float64)
    _, first, of_start = np.unique(np.hstack([x0, draw]), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)  # as the starts are given: an error names the first
    rank = np.argsort(order)
    jobs = [Job(env_id, defect, in_circles, int(k), x0[k], draw[k]) for k in first[order]]
    if processes is None:
        processes = max(1, min(os.cpu_count() or 1, len(jobs) // STARTS_PER_PROCESS))
    if processes == 1:
        solutions = [_solve_start(job) for job in jobs]
    else:
        chunk = -(-len(jobs) // (4 * processes))
        spawn = get_context("spawn")
        with ProcessPoolExecutor(processes, spawn, limit.update, ({"seconds": limit["seconds"]},)) as pool:
            solutions = list(pool.map(_solve_start, jobs, chunksize=chunk))
    u, cost, feasible, multipliers = (list(column) for column in zip(*solutions))
    same = rank[of_start.ravel()]
    u = np.array(u)[same]
    u = u if isinstance(problem.u_max, tuple) else u[..., 0]
    return u, np.array(cost)[same], np.array(feasible)[same], np.array(multipliers)[same]


# ---------------------------------------------------------------------------------------------------------------------
# References: optima flown by the environments
# ---------------------------------------------------------------------------------------------------------------------


def fly_solution(env_id: str, x0, u, cost, draw=None):
    """Fly the controls u (n, T) from x0 (n, 2): what `envs.fly` returns, and `replay_error` (n,).

    That is the relative difference between the program's `cost` (n,) and the flight's. Raises RuntimeError, naming the
    start, above `REPLAY_TOLERANCE`: then the program is not the environment's problem.
    """
    flight = fly(env_id, lambda obs, t: u[:, t].reshape(len(u), -1), x0, draw)
    # a cost below 1e-4 (a start within 0.003 of the origin) is compared absolutely: IPOPT has a tolerance too
    error = np.abs(cost - flight["cost"]) / np.maximum(np.abs(flight["cost"]), 1e-4)
    worst = int(np.argmax(error))
    tolerance = REPLAY_TOLERANCE_OF_EVENTS if PROBLEMS[env_id].has_events else REPLAY_TOLERANCE
    if not error[worst] <= tolerance:
        raise NoOptimum(
            f"start {worst}, x0 = {x0[worst].tolist()}, of {env_id}: its optimum costs {cost[worst]} in the program "
            f"and {flight['cost'][worst]} in the environment; at most {tolerance:g} (relative) is allowed"
        )
    return {**flight, "replay_error": error}


def reference(env_id: str, x0, processes: int | None = None, draw=None) -> dict:
    """The optimum from each start x0 (n, states), flown by the environment: `envs.fly`'s arrays, from these methods.

    draw (n, k) are the standard scores of a table that has some; the optimum knows the hidden parameters.

    DoubleIntegrator-v0: LQR clipped at the bound, which is the bounded optimum from the start box (`box_qp` agrees).
    Other costs by weights with one phase: multiple shooting, with `replay_error` (n,). With several phases: see
    `waypoint_reference`; with costs by functions, `reference_in_circles`.
    Raises ValueError on an unknown id, a bad x0 or number of processes, RuntimeError where a solve or replay fails.
    """
    x0 = np.asarray(x0, dtype=np.float64)
    if env_id not in PROBLEMS:
        raise ValueError(f"env_id is {env_id!r}; it must be one of {', '.join(PROBLEMS)}")
    problem = PROBLEMS[env_id]
    n = problem.states
    if x0.ndim != 2 or x0.shape[1] != n or len(x0) == 0 or not np.isfinite(x0).all():
        raise ValueError(f"x0 must be finite, of shape (n, {n}) with n >= 1; got {x0.tolist()!r:.80}")
    if processes is not None and processes < 1:
        raise ValueError(f"processes is {processes}; it must be at least 1")
    if env_id == DOUBLE_INTEGRATOR.env_id:
        return fly(env_id, lqr_policy(DOUBLE_INTEGRATOR), x0)
    if not problem.circles_count:
        u, cost, feasible, _ = optimise(env_id, x0, processes=processes, draw=draw)
        refuse_first(~feasible, env_id, x0, "has no flight within its bounds and longest times")
        return fly_solution(env_id, x0, u, cost, draw)
    if not problem.weighted:
        return reference_in_circles(env_id, x0, processes, draw)
    return waypoint_reference(env_id, x0, processes, draw)


def reference_in_circles(env_id: str, x0, processes: int | None = None, draw=None) -> dict:
    """The optimum that ends each phase in its circle. Raises RuntimeError where it does not exist, or misses in flight.

    A bonus is what tells a learner of the circles: it has to be more than what reaching them costs.
    """
    u, cost, feasible, _ = optimise(env_id, x0, in_circles=True, processes=processes, draw=draw)
    refuse_first(~feasible, env_id, x0, "has no flight within its circles, bounds and longest times")
    flight = fly_solution(env_id, x0, u, cost, draw)
    refuse_first(~flight["hit"].all(axis=1), env_id, x0, "misses its circles")
    return flight


def refuse_first(bad: np.ndarray, env_id: str, x0, what: str):
    """NoOptimum that names the first bad start (n,), if there is one."""
    if bad.any():
        start = int(np.argmax(bad))
        raise NoOptimum(f"start {start}, x0 = {x0[start].tolist()}, of {env_id} {what}")


def waypoint_reference(env_id: str, x0, processes: int | None = None, draw=None) -> dict:
    """The better, bonuses counted, of the optima with and without |x - target| <= r at every phase's end.

    Beside `fly_solution`'s arrays: `constrained` (n,), whether it is the one with the circles; `infeasible` (n,),
    whether no control reaches all circles (then it is the one without); `cost_free` (n,), `terminal_error_free`
    (n, phases) of the optimum without; `circle_price` (n, phases), what a unit of radius would save the one with the
    circles: from their multipliers, 0 where it ends inside, NaN where infeasible. Raises RuntimeError where an optimum
    with the circles misses one in flight.
    """
    u_free, cost_free, _, _ = optimise(env_id, x0, processes=processes, draw=draw)
    u, cost, feasible, multipliers = optimise(env_id, x0, in_circles=True, processes=processes, draw=draw)
    free = fly_solution(env_id, x0, u_free, cost_free, draw)
    best_u = np.where(feasible.reshape(-1, *[1] * (u.ndim - 1)), u, u_free)
    circled = fly_solution(env_id, x0, best_u, np.where(feasible, cost, cost_free), draw)
    missed = feasible & ~circled["hit"].all(axis=1)
    if missed.any():
        start = int(np.argmax(missed))
        distances = circled["terminal_error"][start].tolist()
        raise NoOptimum(f"start {start}, x0 = {x0[start].tolist()}, of {env_id} misses its circles: {distances}")
    constrained = circled["episodic_return"] > free["episodic_return"]
    best = {key: free[key].copy() for key in free}
    for key, values in best.items():
        values[constrained] = circled[key][constrained]
    price = np.full(free["hit"].shape, np.nan)
    with_circle = [k for k, phase in enumerate(PROBLEMS[env_id].phases) if phase.has_circle]
    radius = np.array([np.max(PROBLEMS[env_id].phases[k].radius) for k in with_circle])  # of an ellipse its long axis
    # on the edge d(|dx|^2 / r^2) / dr = -2 / r
    price[:, with_circle] = np.where(feasible[:, None], multipliers * 2 / radius, np.nan)
    compared = {"cost_free": free["cost"], "terminal_error_free": free["terminal_error"], "circle_price": price}
    return {**best, "constrained": constrained, "infeasible": ~feasible, **compared}


# ---------------------------------------------------------------------------------------------------------------------
# What a reference is compared with
# ---------------------------------------------------------------------------------------------------------------------


def summarise(problem: Problem, flight: dict) -> dict:
    """What every problem's table begins with: means over the starts of a flight, flat and ready for JSON."""
    parts = ("cost", *(f"cost_{part}" for part in problem.parts))
    numbers = {f"{key}_mean": flight[key].mean() for key in parts}
    numbers |= {"episodic_return_mean": flight["episodic_return"].mean(), "hit_rate": flight["hit"].all(axis=1).mean()}
    if problem.waypoints:
        numbers |= {f"hit_rate_phase_{k}": rate for k, rate in enumerate(flight["hit"].mean(axis=0), start=1)}
    numbers |= {"terminal_error_max": flight["terminal_error"].max(), "control_max": np.nanmax(np.abs(flight["u"]))}
    if problem.has_events:
        numbers["final_time_mean"] = flight["final_time"].mean()
    if "replay_error" in flight:
        numbers["replay_error_max"] = flight["replay_error"].max()
    return numbers


def compare_double_integrator(env_id: str, x0, flight: dict) -> dict:
    """Riccati's K_0 and P_0, and clipped LQR against unbounded LQR (cost x'P_0 x) and against the box QP."""
    K, P = lqr(PROBLEMS[env_id])
    unbounded = np.einsum("ni,ij,nj->n", x0, P[0], x0)
    saturated = (np.abs(np.einsum("tj,ntj->nt", K, flight["x"][:, :-1])) > PROBLEMS[env_id].u_max).any(axis=1)
    u_qp = box_qp(PROBLEMS[env_id], x0)
    qp = fly(env_id, lambda obs, t: u_qp[:, t, None], x0)
    ratio = flight["cost"] / unbounded
    numbers = {"K0_1": K[0, 0], "K0_2": K[0, 1], "P0_11": P[0, 0, 0], "P0_12": P[0, 0, 1], "P0_22": P[0, 1, 1]}
    numbers |= {"expected_cost_unbounded": np.trace(P[0]) / 3, "saturated_share": saturated.mean()}
    numbers |= {"ratio_to_unbounded_mean": ratio.mean(), "ratio_to_unbounded_max": ratio.max()}
    return numbers | {"box_qp_error_max": np.abs(flight["cost"] / qp["cost"] - 1).max()}


def compare_single_phase(env_id: str, x0, flight: dict) -> dict:
    """The paper's other references: direct collocation (as solved, and flown) and LQR about the target."""
    u, cost, _, _ = optimise(env_id, x0, hermite_simpson)
    collocated = fly(env_id, lambda obs, t: u[:, t, None], x0)["cost"]
    linear = fly(env_id, lqr_policy(PROBLEMS[env_id]), x0)["cost"]
    numbers = {}
    for name, other in (("collocation", cost), ("collocation_flown", collocated), ("lqr", linear)):
        numbers |= {f"{name}_cost_mean": other.mean(), f"{name}_ratio_of_sums": other.sum() / flight["cost"].sum()}
    return numbers


def compare_waypoints(env_id: str, x0, flight: dict) -> dict:
    """The optimum without circles beside the reference, and what hitting the circles costs and wins."""
    numbers = {"constrained_share": flight["constrained"].mean(), "infeasible_starts": int(flight["infeasible"].sum())}
    numbers["cost_free_mean"] = flight["cost_free"].mean()
    numbers["extra_cost_mean"] = (flight["cost"] - flight["cost_free"]).mean()
    numbers["extra_cost_max"] = (flight["cost"] - flight["cost_free"]).max()
    bonus = np.array([phase.bonus for phase in PROBLEMS[env_id].phases])
    radius = np.array([phase.circle_radius for phase in PROBLEMS[env_id].phases])
    hit_free = flight["terminal_error_free"] <= radius
    numbers["bonus_won_mean"] = ((flight["hit"].astype(int) - hit_free) @ bonus).mean()
    for name, key in (("distance_free", "terminal_error_free"), ("distance", "terminal_error")):
        numbers |= {f"{name}_phase_{k}": mean for k, mean in enumerate(flight[key].mean(axis=0), start=1)}
    price = flight["circle_price"][~flight["infeasible"]]
    if len(price):
        means = enumerate(price.mean(axis=0), start=1)
        numbers |= {f"circle_price_phase_{k}": mean for k, mean in means if np.isfinite(mean)}
    return numbers


FINER = 4  # steps in place of one
FINER_STARTS = 5


def compare_finer(env_id: str, x0, flight: dict, draw) -> dict:
    """The optimum of shorter steps, which a policy of longer ones cannot reach: by shooting and by collocation.

    Over the first `FINER_STARTS` starts. The two transcriptions have nothing in common but the table's functions. With
    bounds also `bound_price_needed`, the least `Problem.bound_price` with which crossing them does not pay.
    """
    problem, some = PROBLEMS[env_id], range(min(len(x0), FINER_STARTS))
    jobs = [Job(env_id, shooting, problem.circles_count, k, x0[k], draw[k]) for k in some]
    best = [best_solution(job)[0] for job in jobs]
    numbers = {}
    if problem.bounds:
        numbers["bound_price_needed"] = max(solution.bound_price for solution in best)
    for name, defect in (("finer", shooting), ("finer_collocation", hermite_simpson)):
        finer = [refined(job._replace(defect=defect), solution, FINER) for job, solution in zip(jobs, best)]
        if all(solution.succeeded for solution in finer):
            costs = np.array([solution.cost for solution in finer])
            numbers[f"{name}_cost_mean"] = costs.mean()
            numbers[f"{name}_saves_mean"] = (flight["cost"][list(some)] - costs).mean()
    return numbers


def compare(env_id: str, x0, flight: dict, draw) -> dict:
    """What the reference `flight` from x0 (n, states) is compared with, by the kind of problem."""
    problem = PROBLEMS[env_id]
    if env_id == DOUBLE_INTEGRATOR.env_id:
        return compare_double_integrator(env_id, x0, flight)
    if not problem.weighted or problem.has_events or problem.scores or problem.bounds:
        return compare_finer(env_id, x0, flight, draw)
    return compare_waypoints(env_id, x0, flight) if problem.circles_count else compare_single_phase(env_id, x0, flight)


# ---------------------------------------------------------------------------------------------------------------------
# What is asked of a small problem's id (`phased/task.py`)
# ---------------------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=4)
def kept_reference(env_id: str, problem: Problem, eval_seed: int, n: int) -> dict:
    """`reference` from the n flights of a seed: evaluations during a training fly the same starts again and again."""
    x0, draw = flights_of_seed(problem, eval_seed, n)
    return reference(env_id, x0, draw=draw)


def report(env_id: str, n: int, seed: int) -> tuple[dict, dict]:
    """Solve the n flights of a seed and print the optimum beside what it is compared with: its numbers and arrays."""
    problem = PROBLEMS[env_id]
    x0, draw = flights_of_seed(problem, seed, n)
    begin = time.perf_counter()
    flight = reference(env_id, x0, draw=draw)
    seconds = time.perf_counter() - begin
    numbers = {"env_id": env_id, "starts": n, "seed": seed, "solve_seconds": seconds}
    numbers |= summarise(problem, flight) | compare(env_id, x0, flight, draw)
    for key, value in numbers.items():
        print(f"{key:<32}{value if isinstance(value, str) else format(value, '.7g')}")
    arrays = {f"{key}_reference": flight[key] for key in ("x", "u", "cost")}
    return numbers, {"t": problem.dt * np.arange(flight["x"].shape[1]), **arrays}


add_family(PROBLEMS, lambda env_id: PhasedTask(env_id, PROBLEMS[env_id], kept_reference, report))


# ---------------------------------------------------------------------------------------------------------------------
# Command line
# ---------------------------------------------------------------------------------------------------------------------

SHORT_NAMES = {  # of sub-commands; every problem has its id, too
    "DoubleIntegrator-v0": "double-integrator",
    "VanDerPol-v0": "van-der-pol",
    "DoubleIntegratorWaypoints-v0": "double-integrator-waypoints",
    "VanDerPolWaypoints-v0": "van-der-pol-waypoints",
}


def save(args, numbers: dict, arrays: dict) -> None:
    """Write the files asked for: the numbers as JSON, the trajectories as npz."""
    if args.json:
        with replacing(args.json, "w") as file:
            json.dump(numbers, file, indent=2)
    if args.npz:
        write_npz(args.npz, arrays)


def parse_args(argv=None):
    """One sub-command for each id, and `rocket`; each sets `solve`, which the main part calls with the arguments."""
    parser = OneLineParser(description=str(__doc__).splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    for env_id in env_ids():
        names = [SHORT_NAMES[env_id]] if env_id in SHORT_NAMES else []
        command = commands.add_parser(env_id, aliases=names, help=f"the optimum of {env_id}")
        task_of(env_id).add_arguments(command)
        command.set_defaults(solve=task_of(env_id).baseline_command)
    command = commands.add_parser("rocket", help="the optima of all rockets")
    command.set_defaults(solve=lambda args: report_all_rockets())
    for command in set(commands.choices.values()):  # a problem with two names is there twice
        command.add_argument("--json", type=output_file, metavar="F", help="write the numbers to this file")
        command.add_argument("--npz", type=output_file, metavar="F", help="write the trajectories to this file")
        at_most = f"limit of each solve, a rocket's with all its tries: default {limit['seconds']:g}"
        command.add_argument(
            "--solve-seconds", type=integer(1, 86400), default=limit["seconds"], metavar="S", help=at_most
        )
    return parser.parse_args(argv)


def main() -> None:
    """Run the sub-command; what can go wrong in it ends in one line."""
    args = parse_args()
    limit["seconds"] = args.solve_seconds
    try:
        save(args, *args.solve(args))
    except (BadInput, ImportError, OSError, RuntimeError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
