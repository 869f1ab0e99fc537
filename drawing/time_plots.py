"""A panel for each state and each control over time: figures, and the sheet of an animation."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from drawing.animation import Flight, Sheet, handles_of
from drawing.style import OPTIMUM, POLICY


def grid_of(labels: list[str]) -> tuple[int, int]:
    """The rows and columns of panels with these labels."""
    columns = min(3, len(labels))
    return -(-len(labels) // columns), columns


def time_panels(labels: list[str], row_height: float, rest: float) -> tuple[Figure, np.ndarray]:
    """A figure with a panel for each label, and its panels. `row_height` and `rest` are the figure's, in inches."""
    rows, columns = grid_of(labels)
    figure = Figure(figsize=(4.2 * columns, row_height * rows + rest), layout="constrained")
    panels = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    for ax, label in zip(panels, labels):
        ax.set(xlabel="time (s)", ylabel=label)
        ax.grid(alpha=0.3)
    for ax in panels[len(labels) :]:
        ax.set_axis_off()
    return figure, panels


def plot_flight(panels, flight: Flight, style: dict):
    """Plot a flight's states in the first panels, and its controls in the next ones."""
    states = flight.y.shape[1]
    for ax, state in zip(panels, flight.y.T):
        ax.plot(flight.t, state, **style)
    for ax, control in zip(panels[states:], flight.u.T):
        ax.stairs(control, flight.t, baseline=None, **style)  # a control is held over each step


class TimePlots(Sheet):
    """Any number of flights over `horizon` seconds. `mark(panels)` draws still parts, `compared` adds the optimum's."""

    def __init__(self, title: str, labels: list[str], states: int, horizon: float, compared: bool = False, mark=None):
        super().__init__(title)
        self.states = states
        self.styles = [POLICY, OPTIMUM] if compared else [POLICY]
        rows, columns = grid_of(labels)
        width, height = 0.96 / columns, 0.84 / rows
        self.panels = []
        for k, label in enumerate(labels):
            row, column = divmod(k, columns)
            box = (0.06 + column * width, 0.94 - (row + 1) * height + 0.06, width - 0.075, height - 0.09)
            self.panels.append(self.panel(box, ylabel=label, xlim=(0, horizon)))
        handles = handles_of(self.styles)
        handles += mark(self.panels) if mark else []
        self.lines = [[self.add_lines(ax, style) for ax in self.panels] for style in self.styles]
        self.figure.legend(handles=handles, loc="lower center", ncols=len(handles), fontsize=8, frameon=False)
        self.clock = self.figure.text(0.01, 0.02, "", fontsize=9, weight="bold")
        self.moving = [*sum(self.lines, []), self.clock]

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
