"""Write the table of docs/failures.md from the two comparisons in results/rocket_failures.

python docs/failure_tables.py
"""

from __future__ import annotations

import json
import re
from pathlib import Path

PAGE = Path(__file__).resolve().parent / "failures.md"
RESULT = PAGE.parents[1] / "results" / "rocket_failures"
FILES = ("opponents.json", "opponents_at_ignition.json")
LAWS = {  # name in the files -> in the table
    "policy": "our policy",
    "dispersed": "our policy for dispersed flights",
    "gradient": "policy by the gradient, for dispersed flights",
    "tvlqr_energy": "LQR, in the last burn by energy",
    "replan": "replanned, nominal model",
    "replan_measured": "replanned, measured acceleration",
    "replan_after_lqr": "the same after the LQR",
}
HEAD = "law"  # the first cell of the table's head


def figure(value: float) -> str:
    """An error as a decimal fraction, with two digits, or one below 0.001."""
    rounded = float(f"{value:.{2 if value >= 0.001 else 1}g}")
    return f"{rounded:.9f}".rstrip("0").rstrip(".")


def cells(row: dict) -> list[str]:
    """What the table says of a law's savable flights: saved, error, kilograms short."""
    saved = f"{100 * row['failure_saved_rate']:.1f} %".replace("100.0", "100")
    errors = f"{figure(row['failure_error_median'])}, {figure(row['failure_error_p95'])}"
    return [saved, errors, f"{row['failure_mass_short_mean_kg']:.1f}"]


def rows() -> list[list[str]]:
    """A row for each law: its name, its flights, then its cells for each file."""
    random, ignition = (json.loads((RESULT / file).read_text())["laws"] for file in FILES)
    return [
        [words, str(random[law]["failure_savable"]), *cells(random[law]), *cells(ignition[law])]
        for law, words in LAWS.items()
    ]


def with_table(text: str) -> str:
    """The page's text with the rows of its table. Raises ValueError if it has none."""
    table = re.search(rf"(\| {HEAD} \|.*\n\|[-|]+\|\n)(?:\|.*\n)*", text)
    if table is None:
        raise ValueError(f"{PAGE} must have a table that begins with | {HEAD} |")
    lines = "".join(f"| {' | '.join(row)} |\n" for row in rows())
    return text[: table.start()] + table[1] + lines + text[table.end() :]


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
