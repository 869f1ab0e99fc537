"""Training curves: {TensorBoard tag: (global steps (k,), values (k,))}."""

from __future__ import annotations

import csv

import numpy as np

from common.files import replacing


def read_curve(run_dir) -> dict:
    """The curve of a run from its TensorBoard events. A resumed run repeats steps, and the last written value counts.

    The time decides which value is the last: the names of files of one second are not in the order of writing.
    """
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run_dir), size_guidance={"scalars": 0})
    events.Reload()
    curve = {}
    for tag in events.Tags()["scalars"]:
        as_written = sorted(events.Scalars(tag), key=lambda event: event.wall_time)
        values = {event.step: event.value for event in as_written}
        steps = sorted(values)
        curve[tag] = np.array(steps), np.array([values[step] for step in steps])
    return curve


def write_csv(path, curve: dict):
    """Write a curve: `global_step`, then one column for each tag. A cell is empty if a tag has no value there."""
    columns = {tag: dict(zip(steps.tolist(), values.tolist())) for tag, (steps, values) in curve.items()}
    with replacing(path, "w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["global_step", *columns])
        for step in sorted(set().union(*columns.values())):
            cells = (cell(column[step]) if step in column else "" for column in columns.values())
            writer.writerow([step, *cells])


def cell(value: float) -> str:
    """A number as text. A whole number is exact. Another has six digits, which are enough to draw the same curve."""
    return f"{value:.0f}" if value.is_integer() else f"{value:.6g}"


def evaluated(curve: dict) -> dict:
    """The part of a curve at the steps of its evaluations. Without evaluations it is the whole curve."""
    of_evaluations = [steps for tag, (steps, _) in curve.items() if tag[:5] == "eval/"]
    kept = np.unique(np.concatenate([np.empty(0), *of_evaluations]))
    if not len(kept):
        return curve
    rows = {tag: np.isin(steps, kept) for tag, (steps, _) in curve.items()}
    return {tag: (steps[rows[tag]], values[rows[tag]]) for tag, (steps, values) in curve.items()}


def read_csv(path) -> dict:
    """The curve that `write_csv` wrote. Raises ValueError if the file is not such a table."""
    with open(path, newline="") as file:
        header, *rows = list(csv.reader(file)) or [[]]
    try:
        if header[:1] != ["global_step"] or not rows or any(len(row) != len(header) for row in rows):
            raise ValueError("global_step, then one column a TensorBoard tag, and a row")
        curve = {}
        for column, tag in enumerate(header[1:], start=1):
            filled = [row for row in rows if row[column]]
            curve[tag] = np.array([int(row[0]) for row in filled]), np.array([float(row[column]) for row in filled])
    except ValueError as error:
        raise ValueError(f"{path} is not a training curve: {error}") from error
    return curve
