"""Reference optima, flown: LQR, box QP and IPOPT for the small problems; the command that solves any id's optimum.

    python baselines.py double-integrator --starts 1000 --seed 0
    python baselines.py van-der-pol --json van_der_pol.json --npz van_der_pol.npz
    python baselines.py double-integrator-waypoints
    python baselines.py van-der-pol-waypoints
    python baselines.py VanDerPol-v0 --starts 20          # every id is a sub-command, too
    python baselines.py Goddard-v0 --starts 1             # also those of problems/ and vehicles/
    python baselines.py rocket --json results/rocket_reference.json --npz results/rocket_reference.npz

Each command prints mean costs over random starts, and what they are compared with. A rocket has one start. The
environments fly all optima once more.

Reading order: the double integrator's bounded optimum, IPOPT from many starts, references, what they are compared with,
command line. The methods are in `phased/lqr.py` and `phased/optimum.py`, the rockets' are in `rocket/optimum.py`.
CasADi and SciPy are imported only where they are used. A training uses them at its start, when it solves the optimum
that its evaluations fly.
"""

from __future__ import annotations

import common.interrupts  # noqa: F401 # isort: skip - first, so that Ctrl-C in the other imports prints no traceback
import json
import sys
import time
from collections.abc import Callable
from functools import lru_cache
from pkgutil import resolve_name

import numpy as np

from common.command_line import OneLineParser, integer, output_file, typed_command
from common.errors import BadInput, NoOptimum
from common.files import replacing, write_npz
from common.interrupts import catch_signals, leave
from common.ipopt import limit
from common.tasks import env_ids, task_of
from common.workers import Workers, usable_cores
from envs import DOUBLE_INTEGRATOR, TABLES_OF_FILES
from phased.environment import fly
from phased.lqr import linearise, lqr, lqr_policy, riccati
from phased.metrics import say_what_is_beyond
from phased.optimum import StartJob, agrees, best_solution, coarse, controls_of, hermite_simpson, refined, shooting
from phased.problem import PROBLEMS, Problem, flights_of_seed, starts
from phased.task import PhasedTask

__all__ = [  # what users import from here
    "NoOptimum", "box_qp", "linearise", "lqr", "lqr_policy", "optimise", "reference", "riccati", "rocket_reference",
    "starts",
]  # fmt: skip

# largest relative difference between the cost of a program's solution and that of its flight
REPLAY_TOLERANCE = 1e-8
REPLAY_TOLERANCE_OF_EVENTS = 1e-5  # larger, because an event is met only up to rounding
NO_FLIGHT = "has no flight that reaches its circles and events within bounds and longest times, or none was found"
STARTS_PER_PROCESS = 100  # fewer starts are solved sooner than another process starts

# ---------------------------------------------------------------------------------------------------------------------
# The double integrator's bounded optimum
# ---------------------------------------------------------------------------------------------------------------------


def box_qp(problem: Problem, x0):
    """Optimal controls u (n, T) of the bounded double integrator from x0 (n, 2), to check the clipped LQR.

    `problem` has one phase and one control.

    All states are written as x = Phi x0 + Gamma u, the condensed form of model predictive control (e.g. Rawlings and
    Mayne). This leaves least squares in u within |u| <= u_max, which SciPy's active-set method BVLS solves.
    """
    from scipy.optimize import lsq_linear

    (phase,) = problem.phases
    T = problem.steps
    A, B = linearise(problem)
    Phi = np.zeros((T + 1, 2, 2))
    Gamma = np.zeros((T + 1, 2, T))
    Phi[0] = np.eye(2)
    for t in range(T):
        Phi[t + 1] = A @ Phi[t]
        Gamma[t + 1] = A @ Gamma[t]
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
# IPOPT from many starts
# ---------------------------------------------------------------------------------------------------------------------


def _solve_start(job: StartJob):
    """Solve one start: control (T, m), the cost, whether there is a solution, and the circles' multipliers."""
    problem = PROBLEMS[job.env_id]
    best, exists = best_solution(job)
    return controls_of(problem, best), best.cost, exists, best.multipliers


def optimise(
    env_id: str,
    x0,
    defect: Callable = shooting,
    in_circles: bool = False,
    processes: int | None = None,
    draw=None,
):
    """Solve `program` from each start x0 (n, states). draw (n, k) are the standard scores.

    Returns the controls u (n, T), or (n, T, m) if the table has a tuple of controls, the costs (n,), whether a solution
    exists (n,), and the multipliers of the circles' constraints (n, circles), or (n, 0) without `in_circles`.

    The best solution of several `guesses` counts. A guess that fails is no error if another does not fail. Without any
    solution (circles, bounds or an event out of reach) the other numbers are IPOPT's last ones and mean nothing. Raises
    NoOptimum that names the start for any other failure. Equal starts are solved once. `processes` changes only the
    time. Its default depends on the number of starts and cores.
    """
    problem = PROBLEMS[env_id]
    x0 = np.asarray(x0, dtype=np.float64)
    draw = np.zeros((len(x0), problem.drawn)) if draw is None else np.asarray(draw, dtype=np.float64)
    _, first, of_start = np.unique(np.hstack([x0, draw]), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)  # in the order of the starts, so that an error names the first one
    rank = np.argsort(order)
    jobs = [StartJob(env_id, defect, in_circles, int(k), x0[k], draw[k]) for k in first[order]]
    if processes is None:
        processes = max(1, min(usable_cores(), len(jobs) // STARTS_PER_PROCESS))
    if problem is not TABLES_OF_FILES.get(env_id):
        processes = 1  # another process would not know the table
    with Workers(processes) as workers:
        solutions = workers.map(_solve_start, jobs)
    u, cost, feasible, multipliers = (list(column) for column in zip(*solutions))
    same = rank[of_start.ravel()]
    u = np.array(u)[same]
    u = u if isinstance(problem.u_max, tuple) else u[..., 0]
    return u, np.array(cost)[same], np.array(feasible)[same], np.array(multipliers)[same]


# ---------------------------------------------------------------------------------------------------------------------
# References: optima flown by the environments
# ---------------------------------------------------------------------------------------------------------------------


def fly_controls(env_id: str, x0, u, draw=None) -> dict:
    """Fly the controls u (n, T) or (n, T, m) from x0 (n, states): what `envs.fly` returns."""
    return fly(env_id, lambda obs, t: u[:, t].reshape(len(u), -1), x0, draw)


def fly_solution(env_id: str, x0, u, cost, draw=None):
    """Fly the controls u (n, T) or (n, T, m) from x0 (n, states): what `envs.fly` returns, and `replay_error` (n,).

    The replay error is the relative difference between the program's `cost` (n,) and the flight's. Above
    `REPLAY_TOLERANCE` (with events `REPLAY_TOLERANCE_OF_EVENTS`) the program is not the environment's problem. Then
    NoOptimum is raised, which names the start.
    """
    flight = fly_controls(env_id, x0, u, draw)
    # a cost below 1e-4 (a start within 0.003 of the origin) is compared absolutely, because of IPOPT's own tolerance
    error = np.abs(cost - flight["cost"]) / np.maximum(np.abs(flight["cost"]), 1e-4)
    worst = int(np.argmax(error))
    tolerance = REPLAY_TOLERANCE_OF_EVENTS if PROBLEMS[env_id].has_events else REPLAY_TOLERANCE
    if not error[worst] <= tolerance:
        raise NoOptimum(
            f"start {worst}, x0 = {x0[worst].tolist()}, of {env_id}: its optimum costs {cost[worst]} in the program "
            f"and {flight['cost'][worst]} in the environment; at most {tolerance:g} (relative) is allowed"
        )
    return {**flight, "replay_error": error}


def reference(env_id: str, x0, draw=None) -> dict:
    """The optimum from each start x0 (n, states), flown by the environment: the arrays of `envs.fly`.

    draw (n, k) are the standard scores, if the table has any. The optimum knows the hidden parameters. The method is

    - for DoubleIntegrator-v0, LQR clipped at the bound, which is the bounded optimum from the start box (`box_qp`
      agrees)
    - for other problems without circles that count, multiple shooting, which adds `replay_error` (n,)
    - for costs by weights with circles, `waypoint_reference`
    - for costs by functions with circles, `reference_in_circles`

    Raises ValueError for an unknown id or a bad x0, and NoOptimum if a solve or replay fails.
    """
    x0 = np.asarray(x0, dtype=np.float64)
    if env_id not in PROBLEMS:
        raise ValueError(f"env_id is {env_id!r}; it must be one of {', '.join(PROBLEMS)}")
    problem = PROBLEMS[env_id]
    n = problem.states
    if x0.ndim != 2 or x0.shape[1] != n or len(x0) == 0 or not np.isfinite(x0).all():
        raise ValueError(f"x0 must be finite, of shape (n, {n}) with n >= 1; got {x0.tolist()!r:.80}")
    if env_id == DOUBLE_INTEGRATOR.env_id:
        return fly(env_id, lqr_policy(DOUBLE_INTEGRATOR), x0)
    if not problem.circles_count:
        u, cost, feasible, _ = optimise(env_id, x0, draw=draw)
        refuse_first(~feasible, env_id, x0, NO_FLIGHT)
        return fly_solution(env_id, x0, u, cost, draw)
    if not problem.weighted:
        return reference_in_circles(env_id, x0, draw)
    return waypoint_reference(env_id, x0, draw)


def reference_in_circles(env_id: str, x0, draw) -> dict:
    """The optimum that ends each phase in its circle. Raises NoOptimum if there is none, or if its flight misses.

    A learner learns of the circles only by the bonus. So the bonus has to be more than the cost of reaching them.
    """
    u, cost, feasible, _ = optimise(env_id, x0, in_circles=True, draw=draw)
    refuse_first(~feasible, env_id, x0, NO_FLIGHT)
    flight = fly_solution(env_id, x0, u, cost, draw)
    refuse_missed(~flight["hit"].all(axis=1), env_id, x0, flight)
    return flight


def refuse_first(bad: np.ndarray, env_id: str, x0, what: str):
    """Raise NoOptimum that names the first bad start of the mask (n,), if there is one."""
    if bad.any():
        start = int(np.argmax(bad))
        raise NoOptimum(f"start {start}, x0 = {x0[start].tolist()}, of {env_id} {what}")


def refuse_missed(missed: np.ndarray, env_id: str, x0, flight: dict):
    """Raise NoOptimum that says how far the first start of the mask (n,) ends from its targets, if there is one."""
    if missed.any():
        distances = flight["terminal_error"][np.argmax(missed)].tolist()
        refuse_first(missed, env_id, x0, f"misses its circles: {distances}")


def waypoint_reference(env_id: str, x0, draw) -> dict:
    """The better of two optima, with and without the constraints |x - target| <= r at every phase's end.

    Bonuses count in this comparison. Beside the arrays of `fly_solution` it returns

    - `constrained` (n,): whether the optimum with the constraints is the better one
    - `infeasible` (n,): whether no control reaches all circles; then the other optimum is taken
    - `cost_free` (n,) and `terminal_error_free` (n, phases) of the optimum without the constraints
    - `circle_price` (n, phases): what a unit of radius would save the optimum with the constraints, by their
      multipliers; 0 if it ends inside the circle, NaN if infeasible

    Raises NoOptimum if an optimum with the constraints misses a circle in flight.
    """
    u_free, cost_free, _, _ = optimise(env_id, x0, draw=draw)
    u, cost, feasible, multipliers = optimise(env_id, x0, in_circles=True, draw=draw)
    free = fly_solution(env_id, x0, u_free, cost_free, draw)
    best_u = np.where(feasible.reshape(-1, *[1] * (u.ndim - 1)), u, u_free)
    circled = fly_solution(env_id, x0, best_u, np.where(feasible, cost, cost_free), draw)
    refuse_missed(feasible & ~circled["hit"].all(axis=1), env_id, x0, circled)
    constrained = circled["episodic_return"] > free["episodic_return"]
    best = {key: free[key].copy() for key in free}
    for key, values in best.items():
        values[constrained] = circled[key][constrained]
    price = np.full(free["hit"].shape, np.nan)
    with_circle = [k for k, phase in enumerate(PROBLEMS[env_id].phases) if phase.has_circle]
    radius = np.array([np.max(PROBLEMS[env_id].phases[k].radius) for k in with_circle])  # an ellipse's long axis
    # on the edge d(|dx|^2 / r^2) / dr = -2 / r
    price[:, with_circle] = np.where(feasible[:, None], multipliers * 2 / radius, np.nan)
    compared = {"cost_free": free["cost"], "terminal_error_free": free["terminal_error"], "circle_price": price}
    return {**best, "constrained": constrained, "infeasible": ~feasible, **compared}


def rocket_reference(env_id: str, **options) -> dict:
    """The optimum of a rocket's id, by `rocket/optimum.py`. Small problems are solved without importing that."""
    return resolve_name("rocket.optimum:rocket_reference")(env_id, **options)


# ---------------------------------------------------------------------------------------------------------------------
# What a reference is compared with
# ---------------------------------------------------------------------------------------------------------------------


def summarise(problem: Problem, flight: dict) -> dict:
    """The first lines of every problem's table: means over the starts of a flight, flat and ready for JSON."""
    parts = ("cost", *(f"cost_{part}" for part in problem.parts))
    numbers = {f"{key}_mean": flight[key].mean() for key in parts}
    numbers |= {"episodic_return_mean": flight["episodic_return"].mean(), "hit_rate": flight["hit"].all(axis=1).mean()}
    if problem.waypoints:
        numbers |= {f"hit_rate_phase_{k}": rate for k, rate in enumerate(flight["hit"].mean(axis=0), start=1)}
    numbers |= {"terminal_error_max": flight["terminal_error"].max(), "control_max": np.nanmax(np.abs(flight["u"]))}
    if problem.constraints:
        numbers["constraint_max"] = flight["constraint_max"].max()
    if problem.has_events:
        numbers["final_time_mean"] = flight["final_time"].mean()
    if "replay_error" in flight:
        numbers["replay_error_max"] = flight["replay_error"].max()
    return numbers


def compare_double_integrator(env_id: str, x0, flight: dict) -> dict:
    """Riccati's K_0 and P_0, and the clipped LQR against the unbounded LQR (cost x'P_0 x) and against the box QP."""
    K, P = lqr(PROBLEMS[env_id])
    unbounded = np.einsum("ni,ij,nj->n", x0, P[0], x0)
    saturated = (np.abs(np.einsum("tj,ntj->nt", K, flight["x"][:, :-1])) > PROBLEMS[env_id].u_max).any(axis=1)
    qp = fly_controls(env_id, x0, box_qp(PROBLEMS[env_id], x0))
    ratio = flight["cost"] / unbounded
    numbers = {"K0_1": K[0, 0], "K0_2": K[0, 1], "P0_11": P[0, 0, 0], "P0_12": P[0, 0, 1], "P0_22": P[0, 1, 1]}
    numbers |= {"expected_cost_unbounded": np.trace(P[0]) / 3, "saturated_share": saturated.mean()}
    numbers |= {"ratio_to_unbounded_mean": ratio.mean(), "ratio_to_unbounded_max": ratio.max()}
    return numbers | {"box_qp_error_max": np.abs(flight["cost"] / qp["cost"] - 1).max()}


def compare_single_phase(env_id: str, x0, flight: dict) -> dict:
    """The paper's other references: direct collocation (as solved, and flown) and LQR about the target."""
    u, cost, _, _ = optimise(env_id, x0, hermite_simpson)
    collocated = fly_controls(env_id, x0, u)["cost"]
    linear = fly(env_id, lqr_policy(PROBLEMS[env_id]), x0)["cost"]
    numbers = {}
    for name, other in (("collocation", cost), ("collocation_flown", collocated), ("lqr", linear)):
        numbers |= {f"{name}_cost_mean": other.mean(), f"{name}_ratio_of_sums": other.sum() / flight["cost"].sum()}
    return numbers


def compare_waypoints(env_id: str, flight: dict) -> dict:
    """The optimum without circles beside the reference, and what hitting the circles costs and wins."""
    numbers = {"infeasible_starts": int(flight["infeasible"].sum())}
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
ANOTHER_OPTIMUM = 1e-3  # a larger relative loss means that IPOPT found another local optimum


def compare_finer(env_id: str, x0, flight: dict, draw) -> dict:
    """The optimum in shorter steps, by shooting and by collocation. A policy with longer steps cannot reach it.

    It is solved from the first `FINER_STARTS` starts. The two transcriptions share only the table's functions. With
    bounds there is also `bound_price_needed`, the least `Problem.bound_price` with which crossing a bound does not pay.
    A number that was not found has no key.
    """
    problem = PROBLEMS[env_id]
    some = range(min(len(x0), FINER_STARTS))
    jobs = [StartJob(env_id, shooting, problem.circles_count, k, x0[k], draw[k]) for k in some]
    best = [best_solution(job)[0] for job in jobs]
    doubtful = min(best, key=lambda solution: solution.guesses_agree)
    numbers: dict[str, float] = {
        "finer_starts": len(jobs),
        "guesses": doubtful.guesses,
        "guesses_agree": doubtful.guesses_agree,
    }
    for name, limits in (("bound_price", problem.bounds), ("constraint_price", problem.constraints)):
        if not limits:
            continue
        needed = max(getattr(solution, name) for solution in best)
        price = getattr(problem, name)
        numbers[f"{name}_needed"] = needed if needed > 1e-6 else 0.0
        if needed > price:
            print(f"{name} {price:g} is less than {needed:g}: crossing a limit pays", file=sys.stderr)
    if problem.step is not None:  # its steps are no approximation
        return numbers
    for name, defect in (("finer", shooting), ("finer_collocation", hermite_simpson)):
        finer = [refined(job._replace(defect=defect), solution, FINER) for job, solution in zip(jobs, best)]
        costs = np.array([solution.cost for solution in finer])
        saves = flight["cost"][list(some)] - costs
        # shorter steps cannot cost more; if they do, IPOPT has gone to another local optimum
        found = saves >= -ANOTHER_OPTIMUM * np.abs(costs)
        if found.all() and all(solution.succeeded for solution in finer):
            numbers[f"{name}_cost_mean"] = costs.mean()
            numbers[f"{name}_saves_mean"] = saves.mean()
        if defect is shooting:
            warn_of_better(jobs, best, finer)
    return numbers


def warn_of_better(jobs: list[StartJob], best, finer):
    """Print a line if the finer solution of a start leads back to a better one in the environment's own steps."""
    for job, own, other in zip(jobs, best, finer):
        if not other.succeeded:
            continue
        better = coarse(job, own, other)
        if better.succeeded and better.cost < own.cost and not agrees(better.cost, own.cost):
            print(
                f"{job.env_id}: the optimum of start {job.index} is a local one: it costs {own.cost:g}, and the finer "
                f"solution leads to {better.cost:g} in the same steps; give the table a `guess`",
                file=sys.stderr,
            )


def compare(env_id: str, x0, flight: dict, draw) -> dict:
    """The numbers that the reference `flight` from x0 (n, states) is compared with, by the kind of problem."""
    problem = PROBLEMS[env_id]
    if env_id == DOUBLE_INTEGRATOR.env_id:
        return compare_double_integrator(env_id, x0, flight)
    more = [problem.has_events, problem.drawn, problem.bounds, problem.constraints, problem.step]
    if not problem.weighted or any(more):
        return compare_finer(env_id, x0, flight, draw)
    if problem.circles_count:
        return compare_waypoints(env_id, flight)
    return compare_single_phase(env_id, x0, flight)


# ---------------------------------------------------------------------------------------------------------------------
# The optimum and the report of a small problem's id, for `phased/task.py`
# ---------------------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=4)
def kept_reference(env_id: str, problem: Problem, eval_seed: int, n: int) -> dict:
    """`reference` of the n flights of a seed, which is kept because evaluations during a training fly it repeatedly."""
    x0, draw = flights_of_seed(problem, eval_seed, n)
    count = len(np.unique(np.hstack([x0, draw]), axis=0))
    if env_id != DOUBLE_INTEGRATOR.env_id and count > 1:
        print(f"solving the optima of {count} starts of seed {eval_seed}, once", file=sys.stderr, flush=True)
    return reference(env_id, x0, draw=draw)


@lru_cache(maxsize=4)
def kept_nominal(env_id: str, problem: Problem) -> dict:
    """`reference` of the one flight from the middle of the starts whose steps draw nothing."""
    return reference(env_id, np.zeros((1, problem.states)) if problem.x0 is None else np.array([problem.x0]))


def report(env_id: str, n: int, seed: int) -> tuple[dict, dict]:
    """Solve the n flights of a seed, and print the optimum and its comparison. Returns the numbers and arrays."""
    problem = PROBLEMS[env_id]
    x0, draw = flights_of_seed(problem, seed, n)
    begin = time.perf_counter()
    flight = reference(env_id, x0, draw=draw)
    say_what_is_beyond(problem, flight["x"])
    solved = summarise(problem, flight) | compare(env_id, x0, flight, draw)
    seconds = time.perf_counter() - begin  # with the finer solves
    numbers = {"env_id": env_id, "starts": n, "seed": seed, "solve_seconds": seconds, **solved}
    for key, value in numbers.items():
        print(f"{key:<32}{value if isinstance(value, str) else format(value, '.7g')}")
    arrays = {f"{key}_reference": flight[key] for key in ("x", "u", "cost")}
    return numbers, {"t": problem.dt * np.arange(flight["x"].shape[1]), **arrays}


def problem_task(env_id: str) -> PhasedTask:
    """The task of a small problem's id, for `common.tasks.task_of`."""
    return PhasedTask(env_id, PROBLEMS[env_id], kept_reference, kept_nominal, report)


# ---------------------------------------------------------------------------------------------------------------------
# Command line
# ---------------------------------------------------------------------------------------------------------------------

SHORT_NAMES = {  # short names of sub-commands; every id is one, too
    "DoubleIntegrator-v0": "double-integrator",
    "VanDerPol-v0": "van-der-pol",
    "DoubleIntegratorWaypoints-v0": "double-integrator-waypoints",
    "VanDerPolWaypoints-v0": "van-der-pol-waypoints",
}


def save(args, numbers: dict, arrays: dict) -> None:
    """Write the files that were asked for: the numbers as JSON, the trajectories as npz."""
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
    command.set_defaults(solve=lambda args: resolve_name("rocket.report:report_all_rockets")())
    for command in set(commands.choices.values()):  # a problem with two names is there twice
        command.add_argument("--json", type=output_file, metavar="F", help="write the numbers to this file")
        command.add_argument("--npz", type=output_file, metavar="F", help="write the trajectories to this file")
        at_most = f"limit of each solve, a rocket's with all its tries: default {limit['seconds']:g}"
        command.add_argument(
            "--solve-seconds", type=integer(1, 86400), default=limit["seconds"], metavar="S", help=at_most
        )
    argv = sys.argv[1:] if argv is None else argv
    if argv and not argv[0].startswith("-") and argv[0] not in commands.choices:
        sys.exit(f"error: {argv[0]!r} is no id here; {typed_command('baselines.py', '--help')} lists them")
    return parser.parse_args(argv)


def main() -> None:
    """Run the sub-command; what can go wrong in it ends in one line."""
    catch_signals()
    args = parse_args()
    limit["seconds"] = args.solve_seconds
    try:
        save(args, *args.solve(args))
    except (BadInput, ImportError, OSError, RuntimeError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        leave()


if __name__ == "__main__":
    main()
