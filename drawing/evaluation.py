"""The figures and the animation of an evaluation, as its task draws them, in a folder."""

from __future__ import annotations

from pathlib import Path

from common.tasks import task_of
from drawing.style import save_figures


def draw_figures(folder, arrays: dict, metrics: dict, curves: list[dict]) -> list[Path]:
    """Draw the figures of an evaluation and of these training curves into folder/figures. Returns their paths."""
    return save_figures(Path(folder) / "figures", task_of(metrics["env_id"]).figures(arrays, metrics, curves))


def draw_animation(folder, arrays: dict, metrics: dict) -> Path:
    """Write the animation of an evaluation, policy beside optimum, into folder/figures. Returns its path."""
    path = Path(folder) / "figures" / "animation.gif"
    task_of(metrics["env_id"]).animation(arrays, metrics).write(path)
    return path
