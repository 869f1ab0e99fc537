"""The small problems' animation: the phase plane, with position and control over time, or all states over time."""

from __future__ import annotations

import numpy as np
from matplotlib.lines import Line2D

from drawing.animation import DOT, HEIGHT, LOOKS, SIDES, WIDTH, Animation, Flight, Sheet, handles_of, room
from drawing.style import BOUNDARY, OPTIMUM, POLICY, TARGET
from drawing.time_plots import TimePlots, stairs
from phased.figures import add_circle, flights_of, mark_table
from phased.problem import Problem


class PhasePlane(Sheet):
    """The phase plane with the circles, and beside it position and control over time, for any number of flights."""

    def __init__(self, problem: Problem, title: str, compared: bool):
        super().__init__(title)
        self.problem = problem
        self.styles = [POLICY, OPTIMUM] if compared else [POLICY]
        position, velocity = problem.state_labels
        self.plane = self.panel((0.075, 0.16, 0.46, 0.765), xlabel=position, ylabel=velocity)
        horizon = problem.steps * problem.dt
        self.position = self.panel((0.62, 0.58, 0.365, 0.345), ylabel=position, xlim=(0, horizon))
        self.control = self.panel((0.62, 0.16, 0.365, 0.345), xlabel="time (s)", ylabel=problem.control_labels[0])
        self.control.set(xlim=(0, horizon), ylim=widened(*problem.u_box[:, 0]))
        for side in problem.u_box[:, 0]:
            self.control.axhline(side, **{**BOUNDARY, "linestyle": "--"})
        self._mark_phases()
        panels = self.plane, self.position, self.control
        self.lines = [[self.add_lines(ax, style) for ax in panels] for style in self.styles]
        looks = zip(self.styles, LOOKS)
        self.heads = [self.plane.plot([], [], color=style["color"], **DOT, **look)[0] for style, look in looks]
        self.starts = self.plane.plot([], [], "k.", markersize=4)[0]
        style = {"transform": self.plane.transAxes, "va": "top", "fontsize": 9, "weight": "bold", "zorder": 8}
        self.clock = self.plane.text(0.02, 0.98, "", **style)
        self._add_legend()
        self.moving = [*sum(self.lines, []), *self.heads, *self.circles, self.starts, self.clock]

    def _mark_phases(self):
        """Draw in green each phase's circle, and its target over the phase's time."""
        self.circles, self.ends, start = [], [], 0.0
        for k, phase in enumerate(self.problem.phases, start=1):
            target = self.problem.targets_of(phase)
            if circle := add_circle(self.problem, phase, self.plane, zorder=5):
                self.circles.append(circle)
            if self.problem.waypoints and None not in target:
                style = {"color": TARGET["color"], "weight": "bold", "fontsize": 9}
                self.plane.annotate(f"{k}", target, (6, 6), textcoords="offset points", zorder=5, **style)
            end = start + phase.steps * self.problem.dt
            if target[0] is not None:
                self.position.plot([start, end], [target[0]] * 2, linestyle="--", zorder=3, **TARGET)
            if k < len(self.problem.phases):
                for ax in (self.position, self.control):
                    ax.axvline(end, **BOUNDARY)
            self.ends.append(end)
            start = end

    def _add_legend(self):
        handles = handles_of(self.styles)
        label = "targets" if self.problem.waypoints else "target"
        handles.append(Line2D([], [], **TARGET, linestyle="", marker="o", fillstyle="none", label=label))
        handles.append(Line2D([], [], color="k", marker=".", linestyle="", label="start"))
        self.figure.legend(handles=handles, loc="lower center", ncols=len(handles), fontsize=8, frameon=False)

    def fit(self, flights: list[Flight]):
        """Set axes that hold all these flights."""
        points = np.concatenate([flight.y for flight in flights])
        x = room(1.15, 1.05 * points[:, 0])
        y = room(1.15, 1.05 * points[:, 1])
        _, _, width, height = self.plane.get_position().bounds
        width, height = width * WIDTH, height * HEIGHT
        scale = max(x / width, y / height)  # one for both axes: circles are round
        self.plane.set(xlim=(-scale * width, scale * width), ylim=(-scale * height, scale * height))
        self.position.set(ylim=(-x, x))

    def show(self, *sides: list[Flight], ended: bool = False):
        """Draw the flights of each side so far: the policy's, then the optimum's. `pixels` gives the frame."""
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


def widened(low: float, high: float) -> tuple[float, float]:
    """The limits of an axis that shows both bounds."""
    margin = 0.075 * (high - low)
    return low - margin, high + margin


def time_plots(problem: Problem, title: str, compared: bool) -> TimePlots:
    """Each state and each control over time, with the table's targets and bounds."""

    def mark(panels):
        mark_table(problem, panels)
        return [Line2D([], [], **TARGET, linestyle="--", label="target")]

    labels = [*problem.state_labels, *problem.control_labels]
    horizon = problem.steps * problem.dt
    return TimePlots(title, labels, problem.states, horizon, compared, mark)


def sheet_of(problem: Problem, title: str = "", compared: bool = False) -> Sheet:
    """The sheet that a problem is drawn on."""
    is_plane = problem.states == 2 and problem.controls == 1 and not problem.has_events
    return (PhasePlane if is_plane else time_plots)(problem, title or problem.env_id, compared)


def problem_animation(problem: Problem, arrays: dict, title: str) -> Animation:
    """The first flights of an evaluation, policy beside optimum."""
    sides = [flights_of(problem, arrays, suffix) for suffix in SIDES]
    return Animation.of(sheet_of(problem, title, compared=True), sides)
