"""A small problem's policy against the optimum: costs, ratios and shares of hits. Costs are the paper's J: plain sums.

The names of all metrics (eval.json) and arrays (eval.npz) are the interface of the project.
"""

from __future__ import annotations

import numpy as np

from phased.problem import Problem

PAPER_STARTS, PAPER_DRAWS = 10, 100  # the paper reports the mean ratio of ten starts; we draw such tens a hundred times
NEAR_ORIGIN = 0.2  # |x0| within which J* is so small that the ratio says little and the loss J - J* says more


def flight_metrics(flight: dict, reference: dict) -> dict:
    """Means over all starts of what was flown and of the optimum, and the shares of starts that hit their circles."""
    metrics = {}
    for prefix, result in (("", flight), ("reference_", reference)):
        metrics[f"{prefix}episodic_return"] = float(result["episodic_return"].mean())
        for part in ("cost", "cost_state", "cost_control", "cost_terminal"):
            metrics[f"{prefix}{part}_mean"] = float(result[part].mean())
        metrics[f"{prefix}hit_rate"] = float(result["hit"].all(axis=1).mean())
    for k, rate in enumerate(flight["hit"].mean(axis=0), start=1):
        metrics[f"hit_rate_phase_{k}"] = float(rate)
    metrics["terminal_error_max"] = float(flight["terminal_error"].max())
    return metrics


def hits_every_circle(problem: Problem, x: np.ndarray) -> np.ndarray:
    """Whether flights x (n, T+1, 2) are within the target's radius at the end of every phase; (n,) bool."""
    phases = problem.phases
    d: np.ndarray = x[:, problem.phase_ends] - [phase.target for phase in phases]  # (n, phases, 2)
    # hypot, as in the environment: the optimum is on the circle's edge, where another rounding would decide otherwise
    distance: np.ndarray = np.hypot(d[..., 0], d[..., 1])
    return np.all(distance <= [phase.radius for phase in phases], axis=1)


def comparable(problem: Problem, x: np.ndarray, x_reference: np.ndarray) -> np.ndarray:
    """The starts (n,) whose costs may be compared: all, or with waypoints those where both sides hit every circle.

    Skipping a circle is cheaper than hitting it, so that a miss would count as better than the optimum. An optimum that
    hits every circle is the radius-constrained one, also where the constraint did not have to be imposed.
    """
    if not problem.waypoints:
        return np.ones(len(x), dtype=bool)
    return hits_every_circle(problem, x) & hits_every_circle(problem, x_reference)


def ratio_metrics(cost: np.ndarray, reference_cost: np.ndarray, eval_seed: int) -> dict:
    """Statistics of the cost ratios ours / optimum of the comparable starts, both (m,); without a start, no key.

    The paper's number is the mean of ten ratios: `ratio_mean` is its expectation, the draws of ten are its spread.
    """
    if len(cost) == 0:
        return {}
    ratio = cost / reference_cost
    metrics = {"ratio_of_sums": cost.sum() / reference_cost.sum(), "ratio_mean": ratio.mean()}
    metrics |= {"ratio_median": np.median(ratio), "ratio_p95": np.percentile(ratio, 95)}
    metrics |= {"ratio_min": ratio.min(), "ratio_max": ratio.max()}
    if len(ratio) >= PAPER_STARTS:
        rng = np.random.default_rng([eval_seed, 1])  # not the stream that drew the starts
        means = [rng.choice(ratio, PAPER_STARTS, replace=False).mean() for _ in range(PAPER_DRAWS)]
        for percentile in (5, 50, 95):
            metrics[f"ten_start_ratio_mean_p{percentile:02d}"] = np.percentile(means, percentile)
    return {key: float(value) for key, value in metrics.items()}


def ends_at_origin(problem: Problem) -> bool:
    """Whether its only target is the origin, where the optimal cost of a start vanishes."""
    return not problem.waypoints and not any(problem.phases[0].target)


def near_origin_metrics(problem: Problem, x0: np.ndarray, cost: np.ndarray, reference_cost: np.ndarray) -> dict:
    """The mean loss J - J* of the starts x0 (m, 2) near the origin; without one, or with another target, no key.

    There J* vanishes with |x0|^2, so that a loss c makes a start's ratio 1 + c / J* as large as one likes, and a few
    such starts make the mean ratio of all. With waypoints J* does not vanish: the second is not at the origin.
    """
    near = np.hypot(*x0.T) <= NEAR_ORIGIN
    if not ends_at_origin(problem) or not near.any():
        return {}
    return {"loss_near_origin_mean": float((cost - reference_cost)[near].mean())}


def cost_parts(problem: Problem, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """State, control and terminal part (n, 3) of the cost J of flights x (n, T+1, 2), u (n, T) (the paper's Eq. of J).

    eval.npz holds the flights and their total cost; the figures take its parts from here.
    """
    parts, start = np.zeros((len(x), 3)), 0
    for phase in problem.phases:
        d = x[:, start : start + phase.steps + 1] - phase.target
        parts[:, 0] += (d[:, :-1] ** 2 @ phase.Q).sum(axis=1)  # the state before each step
        parts[:, 1] += phase.R * (u[:, start : start + phase.steps] ** 2).sum(axis=1)
        parts[:, 2] += phase.Qf * (d[:, -1] ** 2).sum(axis=1)
        start += phase.steps
    return parts
