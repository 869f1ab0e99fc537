"""Write the tables of results into the pages of docs/scripts/.

python docs/script_pages.py
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
RESULTS, PAGES = HERE.parent / "results", HERE / "scripts"
ROWS = {  # page: result folder -> its name
    "ppo_gtrxl_di": {"di": "Double integrator", "di_waypoints": "Two waypoints"},
    "ppo_gtrxl_vdp": {"vdp": "Van der Pol", "vdp_waypoints": "Three waypoints"},
    "ppo_gtrxl_rocket": {
        "rocket_fixed": "961 s",
        "rocket_cutoff": "Cut-off",
        "rocket_dispersed": "Cut-off, dispersed",
        "rocket_failures": "Cut-off, dispersed, losses of thrust",
        "two_stage_leo": "Two stages",
    },
    "ppo_gtrxl_lander": {"mars_landing": "Mars landing"},
}
TABLE = re.compile(r"(\| result \| .*\n\|[-|]+\|\n)(?:\|.*\n)*")  # head, then rows


def row(result, name):
    """A result's row: the median over its seeds, and the range of all."""
    seeds = [json.loads(path.read_text()) for path in sorted((RESULTS / result / "seeds").glob("*.json"))]
    found = {key: np.array([seed[key] for seed in seeds]) for key in seeds[0] if all(key in seed for seed in seeds)}
    if "ratio_of_sums" in found:
        cells = [span(found["ratio_of_sums"], 4), span(100 * found["hit_rate"], 1) + " %"]
    elif "landed_rate" in found:
        cells = [span(100 * found["landed_rate"], 2) + " %", span(found["position_error_mean_m"], 2)]
        cells += [span(found["fuel_ratio"], 3)]
    else:
        mass = found.get("mass_ratio_reached")
        cells = [span(found["error_norm"], 6), "–" if mass is None else span(100 * mass, 3) + " %"]
    updates, minutes = found["total_updates"][0], np.median(found["wall_seconds"]) / 60
    cells += [str(len(seeds)), str(updates), f"{minutes:.0f}"]
    return f"| [{name}](../../results/{result}/README.md) | {' | '.join(cells)} |\n"


def span(values, digits):
    """The median of some values and their range."""
    middle, low, high = (f"{value:.{digits}f}" for value in (np.median(values), min(values), max(values)))
    return middle if low == high else f"{middle} ({low} to {high})"


def with_rows(text, name):
    """A page's text with the rows of its table."""
    rows = "".join(row(result, words) for result, words in ROWS[name].items())
    return TABLE.sub(lambda found: found[1] + rows, text)


if __name__ == "__main__":
    for name in ROWS:
        path = PAGES / f"{name}.md"
        path.write_text(with_rows(path.read_text(), name))
