"""A landing's printed table, "optimum | ours"."""

from __future__ import annotations

from common.tables import lines_of
from landing.rewards import POSITION_LIMIT, SLOPE_LIMIT, SPEED_LIMIT

CONDITION = f"landed (within {POSITION_LIMIT:g} m and {SPEED_LIMIT:g} m/s, steeper than {SLOPE_LIMIT:g} : 1)"
ROWS = (  # label, key of eval.json, number format
    (CONDITION, "landed_rate", ".2%"),
    ("the same, whatever the slope", "soft_rate", ".2%"),
    ("touched the ground", "down_rate", ".2%"),
    ("position error, mean (m)", "position_error_mean_m", ".3f"),
    ("position error, p95 (m)", "position_error_p95_m", ".3f"),
    ("position error, max (m)", "position_error_max_m", ".3f"),
    ("speed at touchdown, mean (m/s)", "speed_mean_m_s", ".3f"),
    ("speed at touchdown, max (m/s)", "speed_max_m_s", ".3f"),
    ("slope of the last 2 m, 5th percentile", "slope_p05", ".2f"),
    ("propellant, mean (kg)", "fuel_mean_kg", ".1f"),
    ("duration, mean (s)", "final_time_mean_s", ".1f"),
)


def table(metrics: dict) -> str:
    """The table of an evaluation."""
    rows = [("", "optimum", "ours")]
    for label, key, digits in ROWS:
        optimum = metrics.get(f"reference_{key}")
        rows.append((label, "-" if optimum is None else f"{optimum:{digits}}", f"{metrics[key]:{digits}}"))
    lines = [f"{metrics['env_id']}: {metrics['eval_starts']} draws of eval seed {metrics['eval_seed']}"]
    lines += lines_of(rows)
    lines.append(
        f"  The optimum knows mass, gravity and failure; it is of the first {metrics['reference_starts']} draws."
    )
    lines.append(f"  Propellant ours / optimum on them: {metrics['fuel_ratio']:.4f}")
    return "\n".join([*lines, *failure_lines(metrics)])


def failure_lines(metrics: dict) -> list[str]:
    """The lines below the table about the failures. There are none without failures."""
    if not metrics["failure_probability"]:
        return []
    when = "at a random moment" if metrics["failure_time"] == "random" else "from the start"
    share = metrics["failure_probability"]
    size, vertical = metrics["failure_size"], metrics.get("failure_vertical", 1.5)  # older files do not tell
    sizes = f"the thrust along x or y is divided by {size:g}, that along z by {vertical:g}"
    return [f"  A share of {share:g} of the flights has a hidden failure {when}: {sizes}."]
