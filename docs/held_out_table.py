"""Write the table of the held-out runs into docs/results.md.

python docs/held_out_table.py
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
RESULTS, PAGE = HERE.parent / "results", HERE / "results.md"
HELD_OUT = {  # result folder -> its name on the page
    "di": "Double integrator",
    "vdp": "Van der Pol",
    "di_waypoints": "Double integrator, 2 waypoints",
    "vdp_waypoints": "Van der Pol, 3 waypoints",
    "rocket_fixed": "Rocket, 961 s",
    "rocket_cutoff": "Rocket with cut-off",
    "rocket_dispersed": "The same, every flight another vehicle",
    "rocket_failures": "The same, an engine may lose thrust",
    "rocket_any_orbit": "The same, any orbit of a range",
    "two_stage_leo": "Two stages",
    "mars_landing": "Landing on Mars",
}
TABLE = re.compile(r"(\| result \| .*\n\|[-|]+\|\n)(?:\|.*\n)*")  # head, then rows
FIGURES = (  # the numbers of a held-out row: those of the first line whose keys a result has
    {"ratio_of_sums": ("cost / optimum's", 1, 4, ""), "hit_rate": ("every circle hit", 100, 1, " %")},
    {
        "landed_rate": ("landed", 100, 2, " %"),
        "position_error_mean_m": ("distance to the pad", 1, 2, " m"),
        "fuel_ratio": ("propellant / optimum's", 1, 3, ""),
    },
    {
        "failure_saved_rate": ("saved", 100, 1, " %"),
        "failure_error_median": ("‖error‖, median", 1, 5, ""),
        "failure_error_p95": ("‖error‖, p95", 1, 4, ""),
        "failure_mass_short_mean_kg": ("short of the optimum", 1, 1, " kg"),
    },
    {"dispersed_error_median": ("‖error‖, median", 1, 5, ""), "dispersed_box_rate": ("in the box", 100, 1, " %")},
    {
        "target_error_median": ("‖error‖, median", 1, 5, ""),
        "target_error_p95": ("‖error‖, p95", 1, 4, ""),
        "target_box_rate": ("in the box", 100, 1, " %"),
        "target_mass_ratio_mean": ("mass / optimum's", 100, 2, " %"),
    },
    {
        "error_norm": ("‖error‖", 1, 6, ""),
        "mass_ratio_reached": ("mass / optimum's for the orbit reached", 100, 3, " %"),
    },
    {"error_norm": ("‖error‖", 1, 6, "")},
)


def found_by_seeds(result):
    """{key: (seeds,)} of what every seed of a result has found."""
    paths = sorted((RESULTS / result / "seeds").glob("*.json"), key=lambda path: int(path.stem))
    seeds = [json.loads(path.read_text()) for path in paths]
    return {key: np.array([seed[key] for seed in seeds]) for key in seeds[0] if all(key in seed for seed in seeds)}


def span(values, digits):
    """The median of some values and their range."""
    middle, low, high = (f"{value:.{digits}f}" for value in (np.median(values), min(values), max(values)))
    return middle if low == high else f"{middle} ({low} to {high})"


def rows_of(result, name):
    """The rows of a result: a number's median and range over the reported seeds, and each held-out seed's."""
    reported = found_by_seeds(result)
    held_out = found_by_seeds(f"held_out/{result}")
    figures = next(figures for figures in FIGURES if figures.keys() <= reported.keys())
    rows = []
    for key, (label, factor, digits, unit) in figures.items():
        each = ", ".join(f"{factor * value:.{digits}f}" for value in held_out[key])
        rows.append(f"| {name} | {label} | {span(factor * reported[key], digits)}{unit} | {each}{unit} |\n")
        name = ""
    return "".join(rows)


def with_rows(text):
    """The page's text with the rows of its table."""
    there = {path.parent.parent.name for path in (RESULTS / "held_out").glob("*/seeds/*.json")}
    rows = "".join(rows_of(result, name) for result, name in HELD_OUT.items() if result in there)
    return TABLE.sub(lambda found: found[1] + rows, text)


if __name__ == "__main__":
    PAGE.write_text(with_rows(PAGE.read_text()))
