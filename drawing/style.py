"""The look of every figure, and how figures become files."""

from __future__ import annotations

import io
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

from common.files import replacing

SHOWN = 10  # the paper shows ten starts
# policy red, optimum blue, target green, as in the paper. Time is in s; x, u, J have no unit
# the optimum is plotted last and dashed: both lines are seen where they coincide, also without telling red from blue
POLICY = {"color": "tab:red", "linewidth": 1.6, "linestyle": "-"}
OPTIMUM = {"color": "tab:blue", "linewidth": 1.0, "linestyle": (0, (4, 2))}
TARGET = {"color": "tab:green", "linewidth": 1.5}
TARGET_ORBIT = {**TARGET, "linewidth": 4.0, "alpha": 0.4}  # beneath the lines of flights
BOUNDARY = {"color": "0.5", "linewidth": 0.8, "linestyle": ":"}


def in_tonnes(mass: float, digits: int) -> str:
    """A mass (kg) in words: in t, below one of them in kg."""
    return f"{mass:.0f} kg" if mass < 1e3 else f"{mass / 1e3:.{digits}f} t"


def save_figures(folder, figures: dict[str, Figure]) -> list[Path]:
    """Write figures by their file names, in 256 colours, which take a quarter of the size. Returns the paths."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        png = io.BytesIO()
        figure.savefig(png, format="png", dpi=130)
        with Image.open(png) as image, replacing(folder / name) as file:
            palette = image.convert("RGB").quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
            palette.save(file, format="png", optimize=True)
    return [folder / name for name in figures]
