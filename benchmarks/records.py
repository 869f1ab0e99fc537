"""The files of results/peers, and the cells of the tables that are printed of several seeds."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np


def provenance() -> dict:
    """The short hash of the code's commit (None where there is no git), and the command's flags."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    try:
        commit = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = None
    return {"commit": commit, "flags": shlex.join(sys.argv[1:])}


def read_record(path: Path) -> tuple[dict, dict]:
    """The last point of a training's curve, and its final numbers. Raises ValueError that names another file."""
    try:
        record = json.loads(path.read_text())
        return dict(record["curve"][-1]), dict(record["final"])
    except (ValueError, TypeError, KeyError, IndexError) as error:
        raise ValueError(f"{path} is no record of a training ({error!r}); delete it to train it again") from error


def cell(values: list) -> str:
    """The median of the seeds' values and their range, to five figures, or all of a whole number."""
    if not values:
        return "-"
    form = ".0f" if isinstance(values[0], int) else ".5g"
    low, middle, high = (format(value, form) for value in (min(values), np.median(values), max(values)))
    return middle if low == high else f"{middle} ({low} to {high})"
