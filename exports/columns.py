"""A table of columns as CSV (RFC 4180): a line of names, then a line for each row."""

from __future__ import annotations

import csv
import io

import numpy as np

STATE = ("x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s", "mass_kg")  # of a vehicle


def csv_bytes(columns: dict[str, np.ndarray]) -> bytes:
    """The file of columns (rows,) by name. Numbers are read back exactly, to the last bit. A NaN is an empty cell."""
    file = io.StringIO()
    writer = csv.writer(file)
    writer.writerow(columns)
    cells = [[cell(value) for value in column.tolist()] for column in columns.values()]
    writer.writerows(zip(*cells))
    return file.getvalue().encode()


def cell(value) -> str:
    """One entry: the shortest digits that are read back as the same number. Truth values are 1 and 0."""
    if isinstance(value, bool):
        return str(int(value))
    return "" if value != value else repr(value)


def named(names, array: np.ndarray) -> dict[str, np.ndarray]:
    """{name: column} of the last axis of an array (..., k), for k names."""
    return {name: array[..., k] for k, name in enumerate(names)}


def numbered(name: str, count: int) -> list[str]:
    """name1, name2, ... up to `count`."""
    return [f"{name}{k}" for k in range(1, count + 1)]


def stacked(columns: dict[str, np.ndarray], lives: np.ndarray) -> dict[str, np.ndarray]:
    """The flights in one table: the rows of columns (n, rows) where `lives` (n, rows), with the flight's number."""
    flight = np.broadcast_to(np.arange(len(lives))[:, None], lives.shape)
    return {"flight": flight[lives], **{name: column[lives] for name, column in columns.items()}}


def last_living(rows: np.ndarray) -> np.ndarray:
    """The last row (n, k) of rows (n, T, k) that is not NaN."""
    last = np.isfinite(rows).all(axis=2).sum(axis=1) - 1
    return rows[np.arange(len(rows)), last]


def held(controls: np.ndarray) -> np.ndarray:
    """Controls (n, T, m) as (n, T+1, m). Each is in the row in which it begins, and the last row is NaN."""
    return np.concatenate([controls, np.full_like(controls[:, :1], np.nan)], axis=1)
