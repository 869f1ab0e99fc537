"""A small problem's policy against the optimum: costs, ratios and shares of hits. Costs are the paper's J, plain sums.

The names of all metrics (eval.json) and arrays (eval.npz) are the project's interface.
"""

from __future__ import annotations

import sys

import numpy as np

from phased.problem import Problem

PAPER_STARTS, PAPER_SAMPLES = 10, 100  # the paper reports the mean ratio of ten starts; we draw ten starts 100 times
KEPT = 1e-6  # a constraint of up to this counts as kept
NEAR_ORIGIN = 0.2  # for smaller |x0|, J* is so small that the loss J - J* says more than the ratio


def flight_metrics(problem: Problem, flight: dict, reference: dict) -> dict:
    """Means over all starts for the policy and the optimum, and the shares of starts that hit their circles."""
    metrics = {}
    parts = ("cost", *(f"cost_{part}" for part in problem.parts))
    for prefix, result in (("", flight), ("reference_", reference)):
        metrics[f"{prefix}episodic_return"] = float(result["episodic_return"].mean())
        for part in parts:
            metrics[f"{prefix}{part}_mean"] = float(result[part].mean())
        metrics[f"{prefix}hit_rate"] = float(result["hit"].all(axis=1).mean())
        if problem.constraints:
            metrics[f"{prefix}constraint_max"] = float(result["constraint_max"].max())
            kept = result["constraint_max"] <= KEPT
            metrics[f"{prefix}constraints_kept_rate"] = float(kept.mean())
        if problem.has_events:
            metrics[f"{prefix}final_time_mean"] = float(result["final_time"].mean())
            metrics[f"{prefix}arrival_rate"] = float(result["arrived"].mean())
    for k, rate in enumerate(flight["hit"].mean(axis=0), start=1):
        metrics[f"hit_rate_phase_{k}"] = float(rate)
    metrics["terminal_error_max"] = float(flight["terminal_error"].max())
    return metrics


def say_what_is_beyond(problem: Problem, x: np.ndarray) -> None:
    """Print a line if flights x (n, T+1, states) leave the observations' box, so that the table's `x_max` is wrong."""
    most = np.nanmax(np.abs(x), axis=(0, 1))
    for k in np.flatnonzero(most > problem.x_max):
        name = problem.x_names[k] if problem.x_names else f"x{k + 1}"
        line = f"{problem.env_id}: the state {name} reaches {most[k]:.4g}, beyond its x_max of {problem.x_max[k]:g}"
        print(f"{line}, which must be larger than every state that can be reached", file=sys.stderr)


def hits_every_circle(problem: Problem, x: np.ndarray, p: tuple) -> np.ndarray:
    """Whether flights x (n, T+1, states) are in the target's circle at the end of every phase, (n,) bool.

    p are the flights' hidden parameters, arrays (n,). With events the problem must have one phase, which ends at the
    last finite state.
    """
    hits = np.ones(len(x), dtype=bool)
    last = np.isfinite(x).all(axis=2).sum(axis=1) - 1
    for phase, end in zip(problem.phases, problem.phase_ends):
        step = last if problem.has_events else np.full(len(x), end)
        # computed as in the environment, because the optimum is on the circle's edge, where rounding decides
        state = tuple(x[np.arange(len(x)), step].T)
        error = problem.circle_distance(phase, state, p)
        hits &= error <= phase.circle_radius
    return hits


def comparable(problem: Problem, arrays: dict) -> np.ndarray:
    """The starts (n,) whose costs may be compared: those from which both sides arrive and hit every circle that counts.

    Skipping a circle is cheaper than hitting it, so a miss would count as better than the optimum. An optimum that hits
    every circle is the radius-constrained optimum, even if the constraint did not have to be imposed.
    """
    n = len(arrays["x"])
    compared = np.ones(n, dtype=bool)
    p = problem.hidden(arrays.get("draw", np.zeros((n, problem.drawn))))
    for suffix in ("", "_reference"):
        if problem.circles_count:
            compared &= hits_every_circle(problem, arrays[f"x{suffix}"], p)
        compared &= arrays.get(f"arrived{suffix}", True)  # an older file does not say it
    return compared


def ratio_metrics(cost: np.ndarray, reference_cost: np.ndarray, eval_seed: int) -> dict:
    """Statistics of the cost ratios, policy over optimum, of the m comparable starts. Without a start there is no key.

    The paper's number is the mean of ten ratios. `ratio_mean` is its expectation, and samples of ten show its spread.
    If the optimum's cost is below 0 (a gain), the ratio is 1 + loss / |gain|, so that above 1 is worse, as everywhere.
    A start whose optimum costs nothing has no ratio.
    """
    has_ratio = reference_cost != 0
    cost = cost[has_ratio]
    reference_cost = reference_cost[has_ratio]
    if len(cost) == 0 or reference_cost.sum() == 0:
        return {}
    ratio = cost_ratio(cost, reference_cost)
    metrics = {"ratio_of_sums": cost_ratio(cost.sum(), reference_cost.sum()), "ratio_mean": ratio.mean()}
    metrics |= {"ratio_median": np.median(ratio), "ratio_p95": np.percentile(ratio, 95)}
    metrics |= {"ratio_min": ratio.min(), "ratio_max": ratio.max()}
    if len(ratio) >= PAPER_STARTS:
        rng = np.random.default_rng([eval_seed, 1])  # another stream than that of the starts
        means = [rng.choice(ratio, PAPER_STARTS, replace=False).mean() for _ in range(PAPER_SAMPLES)]
        for percentile in (5, 50, 95):
            metrics[f"ten_start_ratio_mean_p{percentile:02d}"] = np.percentile(means, percentile)
    return {key: float(value) for key, value in metrics.items()}


def cost_ratio(cost, reference_cost):
    """cost / reference_cost, or 1 + loss / |gain| if reference_cost is a gain, below 0."""
    return np.where(reference_cost > 0, cost / reference_cost, 1 + (cost - reference_cost) / np.abs(reference_cost))


def ends_at_origin(problem: Problem) -> bool:
    """Whether the only target is the origin of two states, where the optimal cost of a start vanishes."""
    (phase, *others) = problem.phases
    return problem.states == 2 and problem.weighted and not others and phase.target == (0.0, 0.0)


def near_origin_metrics(problem: Problem, x0: np.ndarray, cost: np.ndarray, reference_cost: np.ndarray) -> dict:
    """The mean loss J - J* of the starts x0 (m, 2) near the origin. With none, or another target, there is no key.

    J* vanishes there with |x0|^2. So a loss c can make a start's ratio 1 + c / J* arbitrarily large, and a few such
    starts dominate the mean ratio of all. With waypoints J* does not vanish, because the second is not at the origin.
    """
    if not ends_at_origin(problem):
        return {}
    near = np.hypot(*x0.T) <= NEAR_ORIGIN
    if not near.any():
        return {}
    return {"loss_near_origin_mean": float((cost - reference_cost)[near].mean())}


def cost_parts(problem: Problem, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """State, control and terminal part (n, 3) of the cost J of flights, Eq. (14) and (17).

    x (n, T+1, states), u (n, T) or (n, T, m).

    eval.npz holds the flights and their total cost; the figures take its parts from here. This is for costs by weights
    without events. The parts of other costs are in eval.json alone.
    """
    u = u.reshape(len(u), -1, problem.controls)
    parts, start = np.zeros((len(x), 3)), 0
    for phase in problem.phases:
        aimed = np.array([target is not None for target in problem.targets_of(phase)])
        d = (x[:, start : start + phase.steps + 1] - problem.aim_of(phase)) * aimed
        parts[:, 0] += (d[:, :-1] ** 2 @ np.array(problem.state_weights(phase))).sum(axis=1)  # before each step
        parts[:, 1] += (u[:, start : start + phase.steps] ** 2 @ np.array(problem.control_weights(phase))).sum(axis=1)
        parts[:, 2] += phase.Qf * (d[:, -1] ** 2).sum(axis=1)
        start += phase.steps
    return parts
