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

import numpy as np

from common.command_line import OneLineParser, integer, output_file
from common.errors import BadInput, NoOptimum
from common.files import replacing, write_npz
from common.integration import rk4
from common.ipopt import interruptible, limit
from common.tasks import add_family, env_ids, task_of
from envs import DOUBLE_INTEGRATOR, PROBLEMS, Problem, fly
from phased.problem import starts
from phased.task import PhasedTask
from rocket.optimum import rocket_reference
from rocket.report import report_all_rockets

__all__ = [  # what users import from here
    "NoOptimum", "box_qp", "linearise", "lqr", "lqr_policy", "optimise", "reference", "riccati", "rocket_reference",
    "starts",
]  # fmt: skip

STARTS_PER_PROCESS = 100  # fewer are solved sooner than another process has started
REPLAY_TOLERANCE = 1e-8  # relative difference between the cost of a program's solution and of its flight

# ---------------------------------------------------------------------------------------------------------------------
# Linear-quadratic optimum
# ---------------------------------------------------------------------------------------------------------------------


def linearise(problem: Problem, point=(0.0, 0.0)):
    """A (2, 2) and B (2, 1) of x_{k+1} = A x_k + B u_k + const. about a point, for the environment's own step.

    Complex-step derivative (Squire and Trapp, SIAM Review 40, 1998): no difference is taken, so nothing cancels, and
    a linear problem gives its exact discretisation. Central differences where the dynamics take no complex number.
    """

    def step(dx1, dx2, du):
        return rk4(problem.f, (point[0] + dx1, point[1] + dx2), du, problem.dt)

    try:
        h = 1e-20
        AB = np.imag([step(*(1j * h * direction)) for direction in np.eye(3)]).T / h
    except TypeError:
        h = 1e-6
        AB = np.array([np.subtract(step(*dz), step(*-dz)) for dz in h * np.eye(3)]).T / (2 * h)
    return AB[:, :2], AB[:, 2:]


def riccati(problem: Problem):
    """Finite-horizon discrete LQR by the backward Riccati recursion (e.g. Anderson and Moore, Optimal Control, 1990).

    The dynamics are linearised about each phase's target x*, which need not be at rest: with d = x - x* the control is
    u_t = -K_t d_t - k_t and the cost to go d'P_t d + 2 p_t'd + const. Returns K (T, 2), k (T,) and P (T+1, 2, 2).
    """
    K, k, P, p = np.empty((problem.steps, 2)), np.empty(problem.steps), np.zeros((problem.steps + 1, 2, 2)), np.zeros(2)
    end, next_target = problem.steps, problem.phases[-1].target
    for phase in reversed(problem.phases):
        A, B = linearise(problem, phase.target)
        drift = np.subtract(rk4(problem.f, phase.target, 0.0, problem.dt), phase.target)
        p = p + P[end] @ np.subtract(phase.target, next_target)  # d is now the distance to this phase's target
        P[end] += phase.Qf * np.eye(2)
        for t in reversed(range(end - phase.steps, end)):
            weight, ahead = phase.R + B.T @ P[t + 1] @ B, P[t + 1] @ drift + p
            K[t] = np.linalg.solve(weight, B.T @ P[t + 1] @ A)[0]
            k[t] = (B[:, 0] @ ahead) / weight[0, 0]
            P[t] = np.diag(phase.Q) + A.T @ P[t + 1] @ (A - B @ K[t : t + 1])
            p = (A - B @ K[t : t + 1]).T @ ahead
        end, next_target = end - phase.steps, phase.target
    return K, k, P


def lqr(problem: Problem):
    """The gains K (T, 2) of u_t = -K_t x_t and P (T+1, 2, 2) with the cost to go x'P_t x, by `riccati`.

    Exact for the double integrator without its bound; for Van der Pol the linearisation about the origin. Raises
    ValueError on waypoints.
    """
    if problem.waypoints:
        raise ValueError(f"{problem.env_id} has {len(problem.phases)} phases; LQR is for problems with 1")
    K, _, P = riccati(problem)
    return K, P


def targets(problem: Problem) -> np.ndarray:
    """The target of each step's phase, (T, 2)."""
    return np.repeat([phase.target for phase in problem.phases], [phase.steps for phase in problem.phases], axis=0)


def lqr_policy(problem: Problem) -> Callable:
    """LQR about the targets, clipped at the control bound, as a policy for `envs.fly`."""
    K, k, _ = riccati(problem)
    target, u_max = targets(problem), problem.u_max
    return lambda obs, t: np.clip(-(obs[:, :2] - target[t]) @ K[t] - k[t], -u_max, u_max)[:, None]


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
    weight = np.sqrt(np.vstack([np.tile(phase.Q, (T, 1)), np.full((1, 2), phase.Qf)]))  # (T+1, 2)
    states = (weight[:, :, None] * Gamma).reshape(-1, T)
    offsets = (weight * (Phi @ np.asarray(x0, dtype=float)[:, None, :, None])[..., 0]).reshape(len(x0), -1)
    system = np.vstack([states, np.sqrt(phase.R) * np.eye(T)])
    bounds = (-problem.u_max, problem.u_max)
    return np.array(
        [lsq_linear(system, np.append(-b, np.zeros(T)), bounds, method="bvls", tol=1e-15).x for b in offsets]
    )


# ---------------------------------------------------------------------------------------------------------------------
# Nonlinear programs: states and held controls of every step are unknowns, the dynamics are constraints ("defects")
# ---------------------------------------------------------------------------------------------------------------------


def shooting(problem: Problem, x, u, x_next):
    """Defect of multiple shooting, x_{k+1} - step(x_k, u_k), with the environment's own Runge-Kutta step."""
    return tuple(b - a for a, b in zip(rk4(problem.f, x, u, problem.dt), x_next))


def hermite_simpson(problem: Problem, x, u, x_next):
    """Defect of direct collocation: a cubic through both ends that obeys x' = f(x, u) at mid-step, control held.

    Hargraves and Paris (1987), in the compressed form of Betts, Practical Methods for Optimal Control, section 4.5.
    """
    f, dt = problem.f, problem.dt
    dx, dx_next = f(x, u), f(x_next, u)
    x_mid = tuple((a + b) / 2 + dt / 8 * (da - db) for a, b, da, db in zip(x, x_next, dx, dx_next))
    dx_mid = f(x_mid, u)
    return tuple(b - a - dt / 6 * (da + 4 * dm + db) for a, b, da, dm, db in zip(x, x_next, dx, dx_mid, dx_next))


def program(problem: Problem, defect: Callable, in_circles: bool):
    """The nonlinear program as CasADi symbols: unknowns u_0..u_{T-1}, x_1..x_T, parameter x_0.

    Cost J = sum of dx'Q dx + R u^2 over the steps and Qf |dx|^2 at each phase's end (the paper's "J", summed by us).
    Constraints: the defects (2T of them, = 0); with `in_circles` also |dx|^2 / r^2 (<= 1) at each phase's end.
    """
    import casadi as ca

    ca.GlobalOptions.setNumpyMode(1)  # np.sin of a symbol is a symbol, without the warning that it was not always so
    x0, u, x = ca.SX.sym("x0", 2), ca.SX.sym("u", problem.steps), ca.SX.sym("x", 2, problem.steps)
    state, t, cost, defects, circles = (x0[0], x0[1]), 0, 0, [], []
    for phase in problem.phases:
        for _ in range(phase.steps):
            state_next = (x[0, t], x[1, t])
            cost += sum(q * (xi - target) ** 2 for q, xi, target in zip(phase.Q, state, phase.target))
            cost += phase.R * u[t] ** 2
            defects += defect(problem, state, u[t], state_next)
            state, t = state_next, t + 1
        distance2 = sum((xi - target) ** 2 for xi, target in zip(state, phase.target))
        cost += phase.Qf * distance2
        circles.append(distance2 / phase.radius**2)
    constraints = ca.vertcat(*defects, *(circles if in_circles else ()))
    return {"x": ca.vertcat(u, ca.vec(x)), "p": x0, "f": cost, "g": constraints}


@cache
def solver(env_id: str, defect: Callable, in_circles: bool):
    """IPOPT for `program`, built once per process: its CasADi function and the arguments that no start changes."""
    import casadi as ca

    problem = PROBLEMS[env_id]
    options = {
        "expand": True,
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.tol": 1e-10,
        "ipopt.bound_relax_factor": 0,  # the default lets solutions end 2.5e-7 outside their circle
        "ipopt.max_wall_time": limit["seconds"],
    }
    T, circles = problem.steps, len(problem.phases) if in_circles else 0
    u_bound, x_free, dynamics = np.full(T, problem.u_max), np.full(2 * T, np.inf), np.zeros(2 * T)
    arguments = {
        "lbx": np.append(-u_bound, -x_free),
        "ubx": np.append(u_bound, x_free),
        "lbg": np.append(dynamics, np.full(circles, -np.inf)),
        "ubg": np.append(dynamics, np.ones(circles)),
    }
    try:
        symbols = program(problem, defect, in_circles)
    except RuntimeError as error:  # CasADi's, of a symbol whose truth Python asks for
        if "truth value" not in str(error):
            raise
        allowed = "no `if`, `min` or `max` of Python, but NumPy's `where`, `minimum` and `maximum`"
        raise NoOptimum(f"the dynamics of {env_id} decide by a value; they may hold {allowed}") from error
    return ca.nlpsol("optimum", "ipopt", symbols, options), arguments


@cache
def guess_policies(env_id: str) -> tuple[Callable, ...]:
    """The feedback laws whose flights are guesses: LQR about the targets, and full control along the velocity, which
    adds most energy, wherever that LQR saturates."""
    u_max, near = PROBLEMS[env_id].u_max, lqr_policy(PROBLEMS[env_id])

    def pump(obs, t):
        u = near(obs, t)
        return np.where(np.abs(u) < u_max, u, u_max * np.sign(obs[:, 1:2]))

    return near, pump


def guesses(env_id: str, x0):
    """Where IPOPT begins from the start x0 (2,): yields values (3 T,) of the unknowns u_0..u_{T-1}, x_1..x_T.

    The first rests on the targets with no control, which is all with `Problem.single_optimum`. Otherwise three more:
    straight lines from the start to the targets, and the flights of `guess_policies` that do not diverge. A guess is
    the start's own, so that a solution depends neither on its neighbours nor on how the starts are shared out.

    Chosen on pendulums x2' = sin x1 + u swung up with |u| <= 0.2 to 0.3, 20 starts each. Over 10 to 15 s the first
    guess ended above the best of the four at up to 5 % of the starts, with up to 1.46 of their sum of costs; over 20 s
    it failed at 85 %, the two flights at none. They take less time than the first two. Full control of either sign, no
    control, and full control against the velocity added little. The best of four can still be a local optimum.
    """
    problem, ends = PROBLEMS[env_id], np.append(0, PROBLEMS[env_id].phase_ends)
    T, corners = problem.steps, np.array([x0, *(phase.target for phase in problem.phases)])
    yield np.append(np.zeros(T), targets(problem))
    if problem.single_optimum:
        return
    line = np.column_stack([np.interp(np.arange(1, T + 1), ends, corner) for corner in corners.T])
    yield np.append(np.zeros(T), line)
    for policy in guess_policies(env_id):
        with suppress(BadInput), np.errstate(all="ignore"):  # a state that overflows gives an action that is refused
            flight = fly(env_id, policy, x0[None])
            guess = np.append(flight["u"], flight["x"][0, 1:])
            if np.isfinite(guess).all():
                yield guess


@interruptible()
def _solve_start(job):
    """Solve one start, as `optimise` returns it. A job holds all it needs, so that any process can take it."""
    env_id, defect, in_circles, index, x0 = job
    solve, arguments = solver(env_id, defect, in_circles)
    T = PROBLEMS[env_id].steps
    solutions, statuses = [], []
    for guess in guesses(env_id, x0):
        solution = solve(p=x0, x0=guess, **arguments)
        statuses.append(solve.stats()["return_status"])
        multipliers = solution["lam_g"].full()[2 * T :, 0]
        solutions.append((solution["x"].full()[:T, 0], float(solution["f"]), multipliers))
    solved = [k for k, status in enumerate(statuses) if status == "Solve_Succeeded"]
    # only the circles can be out of reach: without them every control has its trajectory
    if not solved and not (in_circles and "Infeasible_Problem_Detected" in statuses):
        stopped = ", ".join(dict.fromkeys(statuses))
        raise NoOptimum(f"start {index}, x0 = {x0.tolist()}, of {env_id}: IPOPT stopped with {stopped}")
    best = min(solved, key=lambda k: solutions[k][1], default=0)
    u, cost, multipliers = solutions[best]
    return u, cost, bool(solved), multipliers


def optimise(env_id: str, x0, defect: Callable = shooting, in_circles: bool = False, processes: int | None = None):
    """Solve `program` from each start x0 (n, 2): controls u (n, T), costs (n,), whether a solution exists (n,), and the
    multipliers of |dx|^2 / r^2 <= 1 (n, phases), or (n, 0) without `in_circles`.

    Of several `guesses` the best solution counts; one that fails is no error where another does not. Where no solution
    exists (`in_circles` only) the rest are IPOPT's last ones and mean nothing. Any other failure is a RuntimeError
    that names the start. `processes` (default: by the number of starts and cores) changes only the time; they are
    spawned, which is safe beside the threads of other libraries.
    """
    if processes is None:
        processes = max(1, min(os.cpu_count() or 1, len(x0) // STARTS_PER_PROCESS))
    jobs = [(env_id, defect, in_circles, index, start) for index, start in enumerate(x0)]
    if processes == 1:
        solutions = [_solve_start(job) for job in jobs]
    else:
        chunk = -(-len(jobs) // (4 * processes))
        spawn = get_context("spawn")
        with ProcessPoolExecutor(processes, spawn, limit.update, ({"seconds": limit["seconds"]},)) as pool:
            solutions = list(pool.map(_solve_start, jobs, chunksize=chunk))
    u, cost, feasible, multipliers = zip(*solutions)
    return np.array(u), np.array(cost), np.array(feasible), np.array(multipliers)


# ---------------------------------------------------------------------------------------------------------------------
# References: optima flown by the environments
# ---------------------------------------------------------------------------------------------------------------------


def fly_solution(env_id: str, x0, u, cost):
    """Fly the controls u (n, T) from x0 (n, 2): what `envs.fly` returns, and `replay_error` (n,).

    That is the relative difference between the program's `cost` (n,) and the flight's. Raises RuntimeError, naming the
    start, above `REPLAY_TOLERANCE`: then the program is not the environment's problem.
    """
    flight = fly(env_id, lambda obs, t: u[:, t, None], x0)
    # a cost below 1e-4 (a start within 0.003 of the origin) is compared absolutely: IPOPT has a tolerance too
    error = np.abs(cost - flight["cost"]) / np.maximum(flight["cost"], 1e-4)
    worst = int(np.argmax(error))
    if not error[worst] <= REPLAY_TOLERANCE:
        raise NoOptimum(
            f"start {worst}, x0 = {x0[worst].tolist()}, of {env_id}: its optimum costs {cost[worst]} in the program "
            f"and {flight['cost'][worst]} in the environment; at most {REPLAY_TOLERANCE:g} (relative) is allowed"
        )
    return {**flight, "replay_error": error}


def reference(env_id: str, x0, processes: int | None = None) -> dict:
    """The optimum from each start x0 (n, 2), flown by the environment: the arrays of `envs.fly`, from these methods.

    DoubleIntegrator-v0: LQR clipped at the bound, which is the bounded optimum from the start box (`box_qp` agrees).
    Others with one phase: multiple shooting, with `replay_error` (n,). Waypoints: see `waypoint_reference`.
    Raises ValueError on an unknown id, a bad x0 or number of processes, RuntimeError where a solve or replay fails.
    """
    x0 = np.asarray(x0, dtype=np.float64)
    if env_id not in PROBLEMS:
        raise ValueError(f"env_id is {env_id!r}; it must be one of {', '.join(PROBLEMS)}")
    if x0.ndim != 2 or x0.shape[1] != 2 or len(x0) == 0 or not np.isfinite(x0).all():
        raise ValueError(f"x0 must be finite, of shape (n, 2) with n >= 1; got {x0.tolist()!r:.80}")
    if processes is not None and processes < 1:
        raise ValueError(f"processes is {processes}; it must be at least 1")
    if env_id == DOUBLE_INTEGRATOR.env_id:
        return fly(env_id, lqr_policy(DOUBLE_INTEGRATOR), x0)
    if not PROBLEMS[env_id].waypoints:
        u, cost, _, _ = optimise(env_id, x0, processes=processes)
        return fly_solution(env_id, x0, u, cost)
    return waypoint_reference(env_id, x0, processes)


def waypoint_reference(env_id: str, x0, processes: int | None = None) -> dict:
    """The better, bonuses counted, of the optima with and without |x - target| <= r at every phase's end.

    Beside `fly_solution`'s arrays: `constrained` (n,), whether it is the one with the circles; `infeasible` (n,),
    whether no control reaches all circles (then it is the one without); `cost_free` (n,), `terminal_error_free`
    (n, phases) of the optimum without; `circle_price` (n, phases), what a unit of radius would save the one with the
    circles: from their multipliers, 0 where it ends inside, NaN where infeasible. Raises RuntimeError where an optimum
    with the circles misses one in flight.
    """
    u_free, cost_free, _, _ = optimise(env_id, x0, processes=processes)
    u, cost, feasible, multipliers = optimise(env_id, x0, in_circles=True, processes=processes)
    free = fly_solution(env_id, x0, u_free, cost_free)
    circled = fly_solution(env_id, x0, np.where(feasible[:, None], u, u_free), np.where(feasible, cost, cost_free))
    missed = feasible & ~circled["hit"].all(axis=1)
    if missed.any():
        start = int(np.argmax(missed))
        distances = circled["terminal_error"][start].tolist()
        raise NoOptimum(f"start {start}, x0 = {x0[start].tolist()}, of {env_id} misses its circles: {distances}")
    constrained = circled["episodic_return"] > free["episodic_return"]
    best = {key: free[key].copy() for key in free}
    for key, values in best.items():
        values[constrained] = circled[key][constrained]
    radius = np.array([phase.radius for phase in PROBLEMS[env_id].phases])
    price = np.where(feasible[:, None], multipliers * 2 / radius, np.nan)  # on the edge d(|dx|^2 / r^2) / dr = -2 / r
    compared = {"cost_free": free["cost"], "terminal_error_free": free["terminal_error"], "circle_price": price}
    return {**best, "constrained": constrained, "infeasible": ~feasible, **compared}


# ---------------------------------------------------------------------------------------------------------------------
# What a reference is compared with
# ---------------------------------------------------------------------------------------------------------------------


def summarise(flight: dict) -> dict:
    """What every problem's table begins with: means over the starts of a flight, flat and ready for JSON."""
    parts = ("cost", "cost_state", "cost_control", "cost_terminal")
    numbers = {f"{key}_mean": flight[key].mean() for key in parts}
    numbers |= {"episodic_return_mean": flight["episodic_return"].mean(), "hit_rate": flight["hit"].all(axis=1).mean()}
    if flight["hit"].shape[1] > 1:
        numbers |= {f"hit_rate_phase_{k}": rate for k, rate in enumerate(flight["hit"].mean(axis=0), start=1)}
    numbers |= {"terminal_error_max": flight["terminal_error"].max(), "control_max": np.abs(flight["u"]).max()}
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
    radius = np.array([phase.radius for phase in PROBLEMS[env_id].phases])
    hit_free = flight["terminal_error_free"] <= radius
    numbers["bonus_won_mean"] = ((flight["hit"].astype(int) - hit_free) @ bonus).mean()
    for name, key in (("distance_free", "terminal_error_free"), ("distance", "terminal_error")):
        numbers |= {f"{name}_phase_{k}": mean for k, mean in enumerate(flight[key].mean(axis=0), start=1)}
    price = flight["circle_price"][~flight["infeasible"]]
    if len(price):
        numbers |= {f"circle_price_phase_{k}": mean for k, mean in enumerate(price.mean(axis=0), start=1)}
    return numbers


def compare(env_id: str, x0, flight: dict) -> dict:
    """What the reference `flight` from x0 (n, 2) is compared with, by the kind of problem."""
    if env_id == DOUBLE_INTEGRATOR.env_id:
        return compare_double_integrator(env_id, x0, flight)
    kind = compare_single_phase if not PROBLEMS[env_id].waypoints else compare_waypoints
    return kind(env_id, x0, flight)


# ---------------------------------------------------------------------------------------------------------------------
# What is asked of a small problem's id (`phased/task.py`)
# ---------------------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=4)
def kept_reference(env_id: str, problem: Problem, eval_seed: int, n: int) -> dict:
    """`reference` from the n starts of a seed: evaluations during a training fly the same starts again and again."""
    return reference(env_id, starts(eval_seed, n, problem.x0_max))


def report(env_id: str, n: int, seed: int) -> tuple[dict, dict]:
    """Solve the n starts of a seed and print the optimum beside what it is compared with: its numbers and arrays."""
    problem = PROBLEMS[env_id]
    x0 = starts(seed, n, problem.x0_max)
    begin = time.perf_counter()
    flight = reference(env_id, x0)
    seconds = time.perf_counter() - begin
    numbers = {"env_id": env_id, "starts": n, "seed": seed, "solve_seconds": seconds}
    numbers |= summarise(flight) | compare(env_id, x0, flight)
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
    except (ImportError, OSError, RuntimeError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
