"""The small problems' picture that moves: the phase plane, with position and control over time."""

from __future__ import annotations

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from drawing.animation import DOT, HEIGHT, LOOKS, SIDES, WIDTH, Animation, Flight, Sheet, room
from drawing.style import BOUNDARY, OPTIMUM, POLICY, SHOWN, TARGET
from phased.problem import Problem


class PhasePlane(Sheet):
    """The phase plane with the circles, beside it position and control over time; any number of flights."""

    def __init__(self, problem: Problem, title: str = "", compared: bool = False):
        super().__init__(title or problem.env_id)
        self.problem, self.styles = problem, [POLICY, OPTIMUM] if compared else [POLICY]
        self.plane = self.panel((0.075, 0.16, 0.46, 0.765), xlabel="position $x_1$", ylabel="velocity $x_2$")
        horizon = problem.steps * problem.dt
        self.position = self.panel((0.62, 0.58, 0.365, 0.345), ylabel="position $x_1$", xlim=(0, horizon))
        self.control = self.panel((0.62, 0.16, 0.365, 0.345), xlabel="time (s)", ylabel="control $u$")
        bound = problem.u_max
        self.control.set(xlim=(0, horizon), ylim=(-1.15 * bound, 1.15 * bound))
        for side in (-bound, bound):
            self.control.axhline(side, **{**BOUNDARY, "linestyle": "--"})
        self._mark_phases()
        self.lines = [
            [self._lines(ax, style) for ax in (self.plane, self.position, self.control)] for style in self.styles
        ]
        looks = zip(self.styles, LOOKS)
        self.heads = [self.plane.plot([], [], color=style["color"], **DOT, **look)[0] for style, look in looks]
        self.starts = self.plane.plot([], [], "k.", markersize=4)[0]
        style = {"transform": self.plane.transAxes, "va": "top", "fontsize": 9, "weight": "bold", "zorder": 8}
        self.clock = self.plane.text(0.02, 0.98, "", **style)
        self._add_legend()
        self.moving = [*sum(self.lines, []), *self.heads, *self.circles, self.starts, self.clock]

    def _lines(self, ax, style: dict) -> LineCollection:
        look = {"colors": style["color"], "linewidths": style["linewidth"] * 0.8, "linestyles": [style["linestyle"]]}
        return ax.add_collection(LineCollection([], zorder=4, **look), autolim=False)

    def _mark_phases(self):
        """Green: each phase's circle, and its target over the phase's time."""
        self.circles, self.ends, start = [], [], 0.0
        for k, phase in enumerate(self.problem.phases, start=1):
            self.circles.append(
                self.plane.add_patch(Circle(phase.target, phase.radius, fill=False, zorder=5, **TARGET))
            )
            if self.problem.waypoints:
                style = {"color": TARGET["color"], "weight": "bold", "fontsize": 9}
                self.plane.annotate(f"{k}", phase.target, (6, 6), textcoords="offset points", zorder=5, **style)
            end = start + phase.steps * self.problem.dt
            self.position.plot([start, end], [phase.target[0]] * 2, linestyle="--", zorder=3, **TARGET)
            if k < len(self.problem.phases):
                for ax in (self.position, self.control):
                    ax.axvline(end, **BOUNDARY)
            self.ends.append(end)
            start = end

    def _add_legend(self):
        handles = [Line2D([], [], **style, label=name) for style, name in zip(self.styles, SIDES.values())]
        label = "targets" if self.problem.waypoints else "target"
        handles.append(Line2D([], [], **TARGET, linestyle="", marker="o", fillstyle="none", label=label))
        handles.append(Line2D([], [], color="k", marker=".", linestyle="", label="start"))
        self.figure.legend(handles=handles, loc="lower center", ncols=len(handles), fontsize=8, frameon=False)

    def fit(self, flights: list[Flight]):
        """Axes that hold all these flights."""
        points = np.concatenate([flight.y for flight in flights])
        x, y = room(1.15, 1.05 * points[:, 0]), room(1.15, 1.05 * points[:, 1])
        _, _, width, height = self.plane.get_position().bounds
        width, height = width * WIDTH, height * HEIGHT
        scale = max(x / width, y / height)  # one for both axes: circles are round
        self.plane.set(xlim=(-scale * width, scale * width), ylim=(-scale * height, scale * height))
        self.position.set(ylim=(-x, x))

    def show(self, *sides: list[Flight], ended: bool = False):
        """Draw the flights of each side (the policy's; then the optimum's) as far as they go; `pixels` is the frame."""
        for flights, (plane, position, control), head in zip(sides, self.lines, self.heads):
            plane.set_segments([flight.y for flight in flights])
            position.set_segments([np.column_stack([flight.t, flight.y[:, 0]]) for flight in flights])
            control.set_segments([stairs(flight) for flight in flights])
            head.set_data(*np.array([flight.y[-1] for flight in flights]).T)
        self.starts.set_data(*np.array([flight.y[0] for flight in sides[0]]).T)
        time = sides[0][0].t[-1]
        running = min(int(np.searchsorted(self.ends, time - 1e-9)), len(self.ends) - 1)
        for k, circle in enumerate(self.circles):
            circle.set(alpha=1.0 if k <= running else 0.35, linewidth=2.2 if k == running else 1.5)
        phase = f", phase {running + 1} of {len(self.ends)}" if len(self.ends) > 1 else ""
        self.clock.set_text(f"t = {time:.1f} s{phase}")


def stairs(flight: Flight) -> np.ndarray:
    """The corners (2 K, 2) of the control over time, held over each step."""
    times = np.repeat(flight.t, 2)[1:-1]
    return np.column_stack([times, np.repeat(flight.u[:, 0], 2)])


def phase_plane_animation(problem: Problem, arrays: dict, title: str) -> Animation:
    """The first flights of an evaluation, policy beside optimum."""
    sides = []
    for suffix, name in SIDES.items():
        flown = zip(arrays[f"u{suffix}"][:SHOWN], arrays[f"x{suffix}"][:SHOWN])
        sides.append([Flight.of(arrays["t"], u[..., None], x, name) for u, x in flown])
    return Animation.of(PhasePlane(problem, title, compared=True), sides)
