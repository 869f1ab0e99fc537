"""What each law saves, by the size of the loss of thrust, and comparisons of two laws on the same flights.

Flights are grouped by the share of thrust that they lose. For each group a law has the share of flights that it saves,
its errors, and the kilograms that it is short of the optimum which knows of the failure from its strike on. Two laws
that flew the same draws are compared flight by flight. The interval is that of the mean difference (Student's t).

Reading order: groups, one law, two laws, the report, the printed tables.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rocket.metrics import SUCCESS

EDGES = (0.0, 0.05, 0.10, 0.20, 0.25, 0.30)  # shares of thrust lost
LARGE = 0.15  # share of thrust lost, above which it helps most to know of a failure beforehand
STANDARD = "replan_measured"  # the law that the others are compared with
IN_WORDS = {  # the names of the laws in figures, where they are not their own words
    "replay": "open loop",
    "tvlqr": "LQR",
    "tvlqr_energy": "LQR by energy",
    "replan": "replanning",
    "replan_measured": "replanning, acceleration measured",
    "replan_after_lqr": "LQR, then replanning",
    "replan_hint": "replanning with a hint",
}
CONFIDENCE = 0.95


class Ends(NamedTuple):
    """How the first n of a law's flights ended, (n,) each."""

    error: np.ndarray  # ||error||
    short: np.ndarray  # kg less than the optimum has in the orbit reached; NaN without a known optimum

    @classmethod
    def of(cls, arrays: dict, name: str) -> Ends:
        """The ends of the law `name`, from the arrays of `Comparison.flights_by_loss`."""
        short = arrays[f"{name}_mass_reached_kg"] - arrays[f"{name}_final_mass_kg"]
        return cls(arrays[f"{name}_error_norm"], short)

    @property
    def saved(self) -> np.ndarray:
        """The flights (n,) that reached the orbit, as a mask."""
        return self.error < SUCCESS


# ---------------------------------------------------------------------------------------------------------------------
# Groups of flights
# ---------------------------------------------------------------------------------------------------------------------


def in_words(name: str) -> str:
    """A law's name in a figure."""
    law = name.removesuffix("_filtered")
    return IN_WORDS.get(law, law) + (" behind a filter" if law != name else "")


def groups(failure: np.ndarray, largest: float) -> dict[str, np.ndarray]:
    """{label: mask (n,) of the flights that lose this share of thrust}, for failure (n, 3) as in `final_info`.

    largest is the greatest share that is drawn. Healthy flights come first, those that lose more than `LARGE` last.
    """
    has_failed = failure[:, 0] >= 0
    lost = failure[:, 2]
    found = {"0": ~has_failed}
    for low, high in zip(EDGES, EDGES[1:]):
        if low < largest:
            top = min(high, largest)
            found[f"{low:.0%} to {top:.0%}"] = has_failed & (lost > low) & (lost <= high)
    if LARGE < largest:
        found[f"above {LARGE:.0%}"] = has_failed & (lost > LARGE)
    return found


def can_reach_orbit(arrays: dict) -> np.ndarray:
    """The flights (n,) that can reach the orbit: healthy ones, and those whose optimum ends above the dry mass."""
    is_healthy = arrays["failure"][:, 0] < 0
    return is_healthy | (arrays["best_mass_kg"] > arrays["dry_mass_kg"])


# ---------------------------------------------------------------------------------------------------------------------
# One law, and two laws
# ---------------------------------------------------------------------------------------------------------------------


def summary(ends: Ends, savable: np.ndarray) -> dict:
    """A law's numbers on the flights `savable` (n,) of a group. Without such a flight only their number, 0.

    `short_mean_kg` is the mean over the flights that the law saved and whose optimum is known. `short_flights` is the
    number of these flights.
    """
    flights = int(savable.sum())
    if not flights:
        return {"savable": 0}
    saved = savable & ends.saved
    known = saved & np.isfinite(ends.short)
    errors = ends.error[savable]
    found = {"savable": flights, "saved": int(saved.sum()), "saved_rate": saved.sum() / flights}
    found |= {"error_median": np.median(errors), "error_p95": np.percentile(errors, 95)}
    found["short_flights"] = int(known.sum())
    if known.any():
        found["short_mean_kg"] = ends.short[known].mean()
    return {key: value if isinstance(value, int) else float(value) for key, value in found.items()}


def paired(ends: Ends, others: Ends, savable: np.ndarray) -> dict:
    """One law minus another on the same flights `savable` (n,): the share saved, and kg where both laws saved."""
    share = ends.saved[savable].astype(float) - others.saved[savable]
    both = savable & ends.saved & others.saved
    heavier = (others.short - ends.short)[both]
    found = mean_interval(share, "saved_rate")
    for bound in found.keys() & {"saved_rate_low", "saved_rate_high"}:
        found[bound] = min(max(found[bound], -1.0), 1.0)
    return found | mean_interval(heavier[np.isfinite(heavier)], "mass_kg")


def mean_interval(values: np.ndarray, name: str) -> dict:
    """`<name>_flights`, and the mean of the values with its interval by Student's t, if there are two or more."""
    found = {f"{name}_flights": len(values)}
    if len(values) < 2:
        return found
    from scipy.stats import t

    mean = values.mean()
    half = t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values))
    return found | {name: float(mean), f"{name}_low": float(mean - half), f"{name}_high": float(mean + half)}


# ---------------------------------------------------------------------------------------------------------------------
# The report
# ---------------------------------------------------------------------------------------------------------------------


def loss_report(arrays: dict, names: list[str], largest: float) -> dict:
    """{label of a group: {law: its `summary`, and `against`, which is `paired` with the standard law}}.

    arrays are those of `Comparison.flights_by_loss`. A law is measured on all its flights. It is compared on the first
    flights, which both laws flew.
    """
    savable = can_reach_orbit(arrays)
    laws = {name: Ends.of(arrays, name) for name in names}
    standard = laws[STANDARD]
    report = {}
    for label, group in groups(arrays["failure"], largest).items():
        rows = {}
        for name, ends in laws.items():
            rows[name] = summary(ends, (group & savable)[: len(ends.error)])
            both = min(len(ends.error), len(standard.error))
            if name != STANDARD:
                first = Ends(ends.error[:both], ends.short[:both])
                others = Ends(standard.error[:both], standard.short[:both])
                rows[name]["against"] = paired(first, others, (group & savable)[:both])
        report[label] = rows
    return report


# ---------------------------------------------------------------------------------------------------------------------
# Tables
# ---------------------------------------------------------------------------------------------------------------------

COLUMNS = ("savable", "saved", "||error|| median", "p95", "short (kg)", "saved, points", "kg, both saved")
WIDTHS = (7, 7, 16, 8, 10, 22, 24)


def loss_lines(report: dict) -> list[str]:
    """The lines of `loss_report`: a table for each group of flights."""
    lines = ["By the share of thrust lost: of the savable flights, and beside them less " + STANDARD]
    lines.append("  on the flights that both flew, with 95 % intervals (paired, Student's t)")
    for label, laws in report.items():
        title = "no failure" if label == "0" else f"{label} lost"
        lines.append(aligned(f"{title:<22}", COLUMNS, WIDTHS))
        lines += [aligned(f"  {name:<20}", law_cells(law), WIDTHS) for name, law in laws.items()]
    return lines


def aligned(name: str, cells, widths) -> str:
    """A line of a table: the name, then the cells to the right in these widths."""
    return f"  {name}" + "".join(f"  {cell:>{width}}" for cell, width in zip(cells, widths))


def law_cells(law: dict) -> list[str]:
    """A law's cells."""
    if not law["savable"]:
        return ["0"]
    short = f"{law['short_mean_kg']:.2f}" if "short_mean_kg" in law else "-"
    cells = [f"{law['savable']}", f"{law['saved_rate']:.1%}", f"{law['error_median']:.6f}", f"{law['error_p95']:.6f}"]
    against = law.get("against", {})
    return [*cells, short, interval(against, "saved_rate", 100, ".1f"), interval(against, "mass_kg", 1, ".2f")]


def interval(found: dict, name: str, factor: float, form: str) -> str:
    """A difference with its interval, or "-" without one."""
    if name not in found:
        return "-"
    mean, low, high = (format(factor * found[f"{name}{part}"], f"+{form}") for part in ("", "_low", "_high"))
    return f"{mean} ({low} to {high})"
