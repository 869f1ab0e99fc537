"""The files that people take away of a results or run folder: `python evaluate.py export` and `page`."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from common.checkpoints import read_checkpoint
from common.evaluations import read_evaluation, refuse_another_policy
from common.files import write_bytes
from common.tasks import task_of
from exports.columns import csv_bytes
from exports.czml import czml_bytes
from exports.oem import oem_bytes
from exports.offers import offer
from exports.page import html_bytes
from exports.policy import onnx_bytes

EPOCH = datetime(2026, 1, 1, tzinfo=UTC)  # the moment of an exported lift-off
LAUNCH_LONGITUDE = -80.6  # degrees east, Cape Canaveral


def export(folder, targets: dict[str, Path], epoch: datetime = EPOCH, launch_longitude: float = LAUNCH_LONGITUDE):
    """Write files for other tools from a results or run folder. `targets` are {format: file}:

    - onnx: one step of the policy, as a model
    - csv: its flights, a row for each step
    - flights: its flights, a row for each
    - oem, czml: a rocket's flight around the Earth; lift-off is at `epoch`, from `launch_longitude` (degrees east)

    Raises BadInput if the folder cannot give a format, or if a package is missing. Then no file is written.
    """
    folder = Path(folder)
    made = {}
    if "onnx" in targets:
        made["onnx"] = onnx_bytes(folder / "agent.safetensors")
    if targets.keys() - {"onnx"}:
        metrics, arrays = read_evaluation(folder)
        task = task_of(metrics["env_id"])
        if "csv" in targets:
            made["csv"] = csv_bytes(offer(task, "step_columns")(arrays, launch_longitude))
        if "flights" in targets:
            made["flights"] = csv_bytes(offer(task, "flight_columns")(arrays, metrics))
        if "oem" in targets:
            made["oem"] = oem_bytes(offer(task, "track")(arrays), epoch, launch_longitude)
        if "czml" in targets:
            made["czml"] = czml_bytes(offer(task, "track")(arrays), epoch, launch_longitude)
    for name, data in made.items():
        write_bytes(targets[name], data)


def page(folder, target=None, launch_longitude: float = LAUNCH_LONGITUDE) -> Path:
    """Write the page of a results or run folder, in which its policy flies in a browser. Returns its path.

    `target` is by default page.html in the folder. Only rockets use the longitude (degrees east). Raises OSError or
    ValueError if a file is missing or bad, or if there is no page for such an environment or policy.
    """
    folder = Path(folder)
    target = Path(target or folder / "page.html")
    metrics, arrays = read_evaluation(folder)
    refuse_another_policy(folder, metrics)
    checkpoint = read_checkpoint(folder / "agent.safetensors", {"num_heads": int, "memory_length": int})
    made = offer(task_of(metrics["env_id"]), "page")(metrics, arrays, checkpoint, launch_longitude)
    write_bytes(target, html_bytes(made))
    return target
