"""A small problem's printed table, "optimum | ours | ratio"."""

from __future__ import annotations

from common.tables import lines_of
from phased.metrics import NEAR_ORIGIN, PAPER_SAMPLES, ends_at_origin
from phased.problem import Problem


def table(problem: Problem, metrics: dict) -> str:
    """The table of an evaluation. The means are over all starts.

    If some starts miss a circle, the ratio of J is over the other starts, and the parts of J have no ratio.
    """
    rows = [("", "optimum", "ours", "ratio"), *cost_rows(problem, metrics), *hit_rows(problem, metrics)]
    starts = f"{metrics['eval_starts']} starts of eval seed {metrics['eval_seed']}"
    title = f"{metrics['env_id']}: {'its one start' if problem.has_one_flight else starts}"
    return "\n".join([title, *lines_of(rows), *ratio_lines(problem, metrics)])


def cost_rows(problem: Problem, metrics: dict) -> list[tuple]:
    """The cost, its parts, and the reward: label, optimum, ours, ratio."""
    all_compared = not problem.circles_count or metrics["hit_rate"] == metrics["reference_hit_rate"] == 1
    all_compared &= metrics.get("compared_starts", metrics["eval_starts"]) == metrics["eval_starts"]
    parts = {f"cost_{part}": f"  of it: {part}" for part in problem.parts}
    optimum = metrics["reference_cost_mean"]
    ours = metrics["cost_mean"]
    of_starts = "" if problem.has_one_flight else f" (mean of {metrics['eval_starts']} starts)"
    rows = [row(f"cost J{of_starts}", optimum, ours, metrics.get("ratio_of_sums"))]
    for part, label in parts.items():
        optimum = metrics[f"reference_{part}_mean"]
        ours = metrics[f"{part}_mean"]
        ratio = ours / optimum if all_compared and optimum > 0 else None
        rows.append(row(label, optimum, ours, ratio))
    optimum = metrics["reference_episodic_return"]
    ours = metrics["episodic_return"]
    rows.append(row("reward (bonus - J, mean)", optimum, ours, None))
    if problem.has_events:
        rows.append(row("final time (s, mean)", metrics["reference_final_time_mean"], metrics["final_time_mean"], None))
    return rows


def row(label: str, optimum: float, ours: float, ratio: float | None) -> tuple:
    """A row's cells, to four digits."""
    return label, f"{optimum:.4f}", f"{ours:.4f}", "-" if ratio is None else f"{ratio:.4f}"


def hit_rows(problem: Problem, metrics: dict) -> list[tuple]:
    """The shares of flights that arrive, and of starts that hit their circles: label, optimum, ours, ratio."""
    rows = []
    if "arrival_rate" in metrics:  # not in an older eval.json
        rate = f"{metrics['arrival_rate']:.1%}"
        rows.append(("flights that arrive", f"{metrics['reference_arrival_rate']:.1%}", rate, "-"))
    if problem.constraints:
        kept = (f"{metrics[f'{side}constraints_kept_rate']:.1%}" for side in ("reference_", ""))
        rows.append(("flights that keep all constraints", *kept, "-"))
    if not any(phase.has_circle for phase in problem.phases):
        return rows
    label = "starts that hit every circle" if problem.waypoints else "starts that hit the target circle"
    rows.append((label, f"{metrics['reference_hit_rate']:.1%}", f"{metrics['hit_rate']:.1%}", "-"))
    if problem.waypoints:
        for k, phase in enumerate(problem.phases, start=1):
            if not phase.has_circle:
                continue
            label = f"  circle {k}: {phase.target}, radius {phase.radius}"
            rows.append((label, "", f"{metrics[f'hit_rate_phase_{k}']:.1%}", ""))
    return rows


def ratio_lines(problem: Problem, metrics: dict) -> list[str]:
    """The lines below the table: the statistics of the cost ratio, or why there is none."""
    if "ratio_of_sums" not in metrics:
        if metrics.get("compared_starts") == 0:
            reason = "no flight arrives" if metrics["arrival_rate"] == 0 else "no flight arrives and hits every circle"
            return [f"  No cost ratio: {reason} (0 of {metrics['eval_starts']} are compared)."]
        if not problem.circles_count:
            return ["  No cost ratio: the optimum costs nothing."]
        reason = "no start hit every circle" if metrics["hit_rate"] == 0 else "where ours hit, the optimum does not"
        return [f"  No cost ratio: {reason} (missing a circle is cheaper, not better)."]
    over = "the starts that hit every circle" if problem.circles_count else f"all {metrics['eval_starts']} starts"
    of_flights = ""
    if "compared_starts" in metrics:
        both = "arrive and hit every circle" if problem.circles_count else "arrive"
        over = f"{metrics['compared_starts']} of {metrics['eval_starts']} starts, whose flights {both}"
        of_flights = f" over {metrics['compared_starts']} of {metrics['eval_starts']} flights, which {both}"
    if problem.has_one_flight:
        return [f"  Cost ratio ours / optimum{of_flights}: {metrics['ratio_of_sums']:.4f}"]
    lines = [f"  Cost ratio ours / optimum over {over}:"]
    lines.append(f"    mean {metrics['ratio_mean']:.4f}: the paper's statistic, a mean of ten starts, on average")
    draws = {key: metrics.get(f"ten_start_ratio_mean_{key}") for key in ("p05", "p50", "p95")}
    if None not in draws.values():  # fewer than ten starts, or an older eval.json
        interval = f"{draws['p05']:.4f} to {draws['p95']:.4f} (5 % to 95 %), median {draws['p50']:.4f}"
        lines.append(f"      {PAPER_SAMPLES} samples of ten: {interval}")
    if ends_at_origin(problem):
        lines.append("      dominated by starts near the origin, where the optimal cost J* vanishes")
    lines.append(f"    ratio of sums {metrics['ratio_of_sums']:.4f}")
    statistics = ", ".join(f"{s} {metrics[f'ratio_{s}']:.4f}" for s in ("min", "median", "max", "p95"))
    lines.append(f"    start by start: {statistics}")
    if "nominal_ratio" in metrics:
        lines.append(f"  The flight without scatter costs {metrics['nominal_ratio']:.4f} of its optimum.")
    if "loss_near_origin_mean" in metrics:
        lines[-1] += f"; mean J - J* within {NEAR_ORIGIN} of the origin {metrics['loss_near_origin_mean']:.4f}"
    return lines
