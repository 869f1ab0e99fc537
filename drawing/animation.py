"""Animations: the sheet that a flight is drawn on, and the GIF.

Each family has its own `Sheet`. `render_mode="rgb_array"` gives its `frame`. An evaluation's `Animation` is a sheet
with flights on it. Pillow, which Matplotlib needs anyway, writes the GIF, so neither torch nor ffmpeg is needed.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from common.errors import BadInput
from common.files import replacing

WIDTH, HEIGHT, DPI = 800, 450, 100  # pixels of a frame, and pixels of an inch, because text and lines are in points
SIDES = {"": "policy", "_reference": "optimum"}  # by the suffix of their arrays in eval.npz
# a flight's head: a dot for the policy, a ring around it for the optimum
DOT = {"linestyle": "", "marker": "o", "zorder": 6}
LOOKS = {"markersize": 4.5}, {"markersize": 7, "fillstyle": "none"}
GROWTH = 1.25  # axes grow by this factor, so that those of a running environment do not creep


class Flight(NamedTuple):
    """A flight: times t (K+1,) in s, controls u (K, m) held from each time to the next, states y (K+1, n)."""

    t: np.ndarray
    u: np.ndarray
    y: np.ndarray

    @classmethod
    def of(cls, t, u, y, name: str) -> Flight:
        """The flight of these arrays. Raises BadInput with its name if they are not of one flight or have a NaN."""
        flight = cls(t, u, y)
        if not (u.ndim == y.ndim == 2 and len(t) == len(y) == len(u) + 1 > 1):
            shapes = f"t {t.shape}, u {u.shape}, states {y.shape}"
            raise BadInput(f"eval.npz: the {name}'s arrays have shapes {shapes}; must be (K+1,), (K, m), (K+1, n)")
        if not all(np.isfinite(array).all() for array in flight):
            raise BadInput(f"eval.npz: the {name}'s flight holds a NaN or an infinity; it must be finite")
        return flight

    def until(self, time: float) -> Flight:
        """The part up to `time` (s), with the state between two steps on the chord."""
        if time >= self.t[-1]:
            return self
        k = max(int(np.searchsorted(self.t, time, side="right")), 1)  # number of steps that have begun
        part = (time - self.t[k - 1]) / (self.t[k] - self.t[k - 1])
        y = (1 - part) * self.y[k - 1] + part * self.y[k]
        return Flight(np.append(self.t[:k], time), self.u[:k], np.vstack([self.y[:k], y]))


class Sheet:
    """A figure of WIDTH x HEIGHT pixels that is drawn again and again. `moving` are the artists that change."""

    def __init__(self, title: str):
        self.figure = Figure(figsize=(WIDTH / DPI, HEIGHT / DPI), dpi=DPI)
        self.canvas = FigureCanvasAgg(self.figure)
        self.figure.text(0.5, 0.955, title, ha="center", fontsize=10)
        self.moving, self._limits, self._still = [], None, None

    def panel(self, box, **labels):
        """Axes at `box` (left, bottom, width, height as shares of the sheet), small text, a pale grid."""
        ax = self.figure.add_axes(box)
        ax.set(**labels)
        ax.tick_params(labelsize=7, length=2)
        ax.xaxis.label.set_size(8)
        ax.yaxis.label.set_size(8)
        ax.grid(alpha=0.3)
        return ax

    def add_lines(self, ax, style: dict) -> LineCollection:
        """Add the lines of any number of flights to a panel."""
        look = {"colors": style["color"], "linewidths": style["linewidth"] * 0.8, "linestyles": [style["linestyle"]]}
        return ax.add_collection(LineCollection([], zorder=4, **look), autolim=False)

    def add_readings(self, styles: list[dict], rows: str, left: float, top: float, linespacing: float) -> list:
        """Name the rows of the readings at (left, top), and head a column for each side. Returns the columns' texts."""
        look = {"fontsize": 8, "va": "top", "linespacing": linespacing}
        self.figure.text(left, top, rows, **look)
        readings = []
        for style, name, right in zip(styles, SIDES.values(), (0.88, 0.985)):
            look |= {"color": style["color"], "ha": "right"}
            self.figure.text(right, top + 0.05, name, **{**look, "weight": "bold"})
            readings.append(self.figure.text(right, top, "", **look))
        return readings

    def fit(self, flights: list[Flight]):
        """Set axes that hold all these flights."""
        raise NotImplementedError

    def show(self, *sides: list[Flight], ended: bool = False):
        """Draw the flights of each side as far as they go: the policy's, then the optimum's. `pixels` gives the frame.

        `ended` says that the policy's flights have ended.
        """
        raise NotImplementedError

    def frame(self, t, u, y) -> np.ndarray:
        """The picture of one flight so far, uint8 (HEIGHT, WIDTH, 3).

        The flight has times t (K+1,), controls u (K, m) and states y (K+1, n).
        """
        flight = Flight(t, u, y)
        self.fit([flight])
        self.show([flight])
        return self.pixels()

    def pixels(self) -> np.ndarray:
        """The sheet as it is now, uint8 (HEIGHT, WIDTH, 3)."""
        limits = [(ax.get_xlim(), ax.get_ylim()) for ax in self.figure.axes]
        if limits != self._limits:  # ticks and text take most of a drawing's time, so still artists are drawn once
            for artist in self.moving:
                artist.set_animated(True)
            self.canvas.draw()
            self._limits = limits
            self._still = self.canvas.copy_from_bbox(self.figure.bbox)
        self.canvas.restore_region(self._still)
        for artist in sorted(self.moving, key=lambda artist: artist.zorder):
            self.figure.draw_artist(artist)
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()


def handles_of(styles: list[dict]) -> list[Line2D]:
    """The legend's handles of the policy's style, and of the optimum's if there is one."""
    return [Line2D([], [], **style, label=name) for style, name in zip(styles, SIDES.values())]


def room(base: float, values: np.ndarray) -> float:
    """The smallest base * GROWTH^k, k >= 0, that holds every |value|."""
    largest = np.abs(values).max(initial=0.0)
    return base * GROWTH ** max(0, int(np.ceil(np.log(max(largest, base) / base) / np.log(GROWTH) - 1e-9)))


# ---------------------------------------------------------------------------------------------------------------------
# The GIF
# ---------------------------------------------------------------------------------------------------------------------

FRAMES, FRAME_MS, HOLD_MS = 110, 80, 2000  # the last frame is held; a GIF counts in hundredths of a second
COLOURS = 48  # colours of the one palette of all frames, so that none flickers and still parts take no bytes


class Animation(NamedTuple):
    """A sheet, the flights of policy and optimum on it, and the times (FRAMES,) in s at which the frames show them."""

    sheet: Sheet
    sides: list[list[Flight]]
    times: np.ndarray

    @classmethod
    def of(cls, sheet: Sheet, sides: list[list[Flight]], haste: float = 1.0) -> Animation:
        """The flights from begin to end. The time shown is the power `haste` of the share played."""
        flights = [flight for side in sides for flight in side]
        sheet.fit(flights)
        share = np.linspace(0, 1, FRAMES) ** haste
        return cls(sheet, sides, share * max(flight.t[-1] for flight in flights))

    def frame(self, k: int) -> np.ndarray:
        """Frame k, uint8 (HEIGHT, WIDTH, 3)."""
        time = self.times[k]
        ended = time >= self.sides[0][0].t[-1]
        self.sheet.show(*([flight.until(time) for flight in flights] for flights in self.sides), ended=ended)
        return self.sheet.pixels()

    def write(self, path: Path):
        """Write the animation as a GIF."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            write_gif(file, self.frame, len(self.times))


def write_gif(file, frame, count: int):
    """Write `count` frames as a GIF that plays for ever. `frame(k)` gives a frame, uint8 (H, W, 3)."""
    samples = np.vstack([frame(0), frame(count // 2), frame(count - 1)])
    palette = Image.fromarray(samples).quantize(COLOURS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    images = [Image.fromarray(frame(k)) for k in range(count)]
    first, *others = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    durations = [FRAME_MS] * (count - 1) + [HOLD_MS]
    first.save(file, format="GIF", save_all=True, append_images=others, duration=durations, loop=0, disposal=1)
