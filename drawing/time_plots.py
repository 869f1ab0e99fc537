"""A sheet with a panel for each state and each control, over time."""

from __future__ import annotations

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D

from drawing.animation import SIDES, Flight, Sheet
from drawing.style import OPTIMUM, POLICY


class TimePlots(Sheet):
    """Any number of flights over `horizon` seconds. `mark(panels)` draws still parts, `compared` adds the optimum's."""

    def __init__(self, title: str, labels: list[str], states: int, horizon: float, compared: bool = False, mark=None):
        super().__init__(title)
        self.states = states
        self.styles = [POLICY, OPTIMUM] if compared else [POLICY]
        columns = min(3, len(labels))
        rows = -(-len(labels) // columns)
        width, height = 0.96 / columns, 0.84 / rows
        self.panels = []
        for k, label in enumerate(labels):
            row, column = divmod(k, columns)
            box = (0.06 + column * width, 0.94 - (row + 1) * height + 0.06, width - 0.075, height - 0.09)
            self.panels.append(self.panel(box, ylabel=label, xlim=(0, horizon)))
        handles = [Line2D([], [], **style, label=name) for style, name in zip(self.styles, SIDES.values())]
        handles += mark(self.panels) if mark else []
        self.lines = [[self._lines(ax, style) for ax in self.panels] for style in self.styles]
        self.figure.legend(handles=handles, loc="lower center", ncols=len(handles), fontsize=8, frameon=False)
        self.clock = self.figure.text(0.01, 0.02, "", fontsize=9, weight="bold")
        self.moving = [*sum(self.lines, []), self.clock]

    def _lines(self, ax, style: dict) -> LineCollection:
        look = {"colors": style["color"], "linewidths": style["linewidth"] * 0.8, "linestyles": [style["linestyle"]]}
        return ax.add_collection(LineCollection([], zorder=4, **look), autolim=False)

    def fit(self, flights: list[Flight]):
        """Set axes that hold all these flights. They never shrink, so that those of a running flight do not jump."""
        for k, ax in enumerate(self.panels):
            columns = [flight.y[:, k] if k < self.states else flight.u[:, k - self.states] for flight in flights]
            values = np.concatenate(columns)
            low = min(0.0, values.min(initial=0.0))
            high = max(0.0, values.max(initial=0.0))
            margin = 0.08 * (high - low) or 1.0
            ax.set(ylim=(low - margin, high + margin))

    def show(self, *sides: list[Flight], ended: bool = False):
        """Draw the flights of each side so far: the policy's, then the optimum's. `pixels` gives the frame."""
        for flights, lines in zip(sides, self.lines):
            for k, line in enumerate(lines):
                if k < self.states:
                    segments = [np.column_stack([flight.t, flight.y[:, k]]) for flight in flights]
                else:
                    segments = [stairs(flight, k - self.states) for flight in flights]
                line.set_segments(segments)
        self.clock.set_text(f"t = {max(flight.t[-1] for flight in sides[0]):.2f} s")


def stairs(flight: Flight, k: int = 0) -> np.ndarray:
    """The corners (2 K, 2) of control k over time, held over each step."""
    times = np.repeat(flight.t, 2)[1:-1]
    return np.column_stack([times, np.repeat(flight.u[:, k], 2)])
