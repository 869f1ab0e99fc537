"""Write the tables of "What each law saves" into docs/failures.md, from the two comparisons in results/rocket_failures.

python docs/failure_tables.py
"""

from __future__ import annotations

import json
import re
from pathlib import Path

PAGE = Path(__file__).resolve().parent / "failures.md"
RESULT = PAGE.parents[1] / "results" / "rocket_failures"
FILES = {"random moment": "opponents.json", "last ignition": "opponents_at_ignition.json"}
LAWS = {  # name in the files -> in the tables
    "policy": "our policy, trained for failures",
    "dispersed": "our policy for dispersed flights",
    "gradient": "policy by the gradient, for dispersed flights",
    "tvlqr_energy": "LQR, in the last burn by energy",
    "replan": "replanned, nominal model",
    "replan_measured": "replanned, measured acceleration",
    "replan_after_lqr": "the same after the LQR",
}
STANDARD = "replan_measured"
LARGE = "above 15%"


def figure(value: float | None) -> str:
    """An error as a decimal fraction, with two digits, or one below 0.001."""
    if value is None:
        return "–"
    rounded = float(f"{value:.{2 if value >= 0.001 else 1}g}")
    return f"{rounded:.9f}".rstrip("0").rstrip(".")


def percent(rate: float | None) -> str:
    return "–" if rate is None else f"{100 * rate:.1f} %".replace("100.0", "100")


def kilograms(mass: float | None) -> str:
    return "–" if mass is None else f"{mass:.1f}"


TABLES = {  # the first cell of a table's head -> how it writes the summary of a law's flights in one group
    "saved": lambda found: percent(found["saved_rate"]),
    "‖error‖ median, p95": lambda found: f"{figure(found['error_median'])}, {figure(found['error_p95'])}",
    "short (kg)": lambda found: kilograms(found.get("short_mean_kg")),
}
COUNTED = {"policy": "policies and LQR", STANDARD: "replanning laws"}  # each of them flew as many


def losses(by_loss: dict) -> list[str]:
    """The groups of flights by the share lost, without those of `LARGE`."""
    return [label for label in by_loss if label != LARGE]


def by_size(by_loss: dict, name: str) -> list[list[str]]:
    """A row for each law, a column for each group of flights."""
    written = TABLES[name]
    return [[words] + [written(by_loss[label][law]) for label in losses(by_loss)] for law, words in LAWS.items()]


def flights(by_loss: dict) -> list[list[str]]:
    """How many savable flights each column has."""
    return [
        [words] + [str(by_loss[label][law]["savable"]) for label in losses(by_loss)] for law, words in COUNTED.items()
    ]


def interval(against: dict, key: str, factor: float = 1.0, digits: int = 1) -> str:
    """A paired difference with its interval in brackets."""
    if key not in against:
        return "–"
    middle, low, high = (
        f"{factor * against[key + end]:+.{digits}f}".replace("-", "−") for end in ("", "_low", "_high")
    )
    return f"{middle} ({low} to {high})"


def compared(by_loss: dict) -> list[list[str]]:
    """A row for each law: its differences from the standard law on the same flights."""
    rows = []
    for law, words in LAWS.items():
        if law == STANDARD:
            continue
        large = by_loss[LARGE][law]["against"]
        none = by_loss["0"][law]["against"]
        both_saved = f"{interval(large, 'mass_kg')} of {large['mass_kg_flights']}"
        rows.append([words, interval(large, "saved_rate", 100, 0), interval(none, "mass_kg"), both_saved])
    return rows


def with_rows(text: str, name: str, rows: list[list[str]]) -> str:
    """The text with these rows in the table whose head's first cell is `name`. Raises ValueError if none has it."""
    table = re.search(rf"(\| {re.escape(name)} \|.*\n\|[-|]+\|\n)(?:\|.*\n)*", text)
    if table is None:
        raise ValueError(f"{PAGE} must have a table that begins with | {name} |")
    lines = "".join(f"| {' | '.join(row)} |\n" for row in rows)
    return text[: table.start()] + table[1] + lines + text[table.end() :]


def with_tables(text: str) -> str:
    """The page's text with the rows of all its tables. Their heads' first cells are as "saved, random moment"."""
    for moment, file in FILES.items():
        by_loss = json.loads((RESULT / file).read_text())["by_loss"]
        for name in TABLES:
            text = with_rows(text, f"{name}, {moment}", by_size(by_loss, name))
        text = with_rows(text, f"flights, {moment}", flights(by_loss))
        text = with_rows(text, f"beside the standard, {moment}", compared(by_loss))
    return text


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text()))
