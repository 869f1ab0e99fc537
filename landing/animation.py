"""The landers' picture that moves: a descent from two sides with its flame, its thrust over time, and its readings."""

from __future__ import annotations

import numpy as np
from matplotlib.patches import Polygon, Rectangle

from drawing.animation import DOT, HEIGHT, LOOKS, SIDES, WIDTH, Animation, Flight, Sheet, room
from drawing.style import BOUNDARY, OPTIMUM, POLICY, TARGET
from landing.figures import FAILED, STRIKE, flown_states, flown_thrust, has_failed, strike_time, words_of
from landing.lander import Lander

# feet at 0, nose at +x; the flame, one long at full thrust
BODY = np.array([(1.6, -0.3), (1.6, 0.3), (0.8, 0.6), (0.0, 0.9), (0.5, 0.5), (0.5, -0.5), (0.0, -0.9), (0.8, -0.6)])
FLAME = np.array([(0.0, 0.4), (-1.0, 0.0), (0.0, -0.4)])
SIZE, LENGTH = 0.028, 0.2  # of the body and of a full flame, as shares of the height in view
GROUND = "#f2ddcf"
BELOW = 0.07  # share of the height in view that is below the ground, with room for the pad's name
LONGEST = 50.0  # s, the length of the time axis when a flight has just begun
NONE = np.empty((0, 1, 7))  # flights
DOWN = 1e-3  # m; a lower flight has touched down


class DescentSheet(Sheet):
    """Altitude over downrange and over crossrange, thrust over time, and readings.

    The controls of a flight are thrust vectors in N: the commands for a running environment, the thrust that acted for
    an animation. `strike` is the time (s) when a failure strikes the policy's flight.
    """

    def __init__(self, lander: Lander, title: str, compared: bool = False, strike: float | None = None):
        super().__init__(title)
        self.lander, self.strike = lander, strike
        ours = {**POLICY, "linewidth": 2.0, "color": POLICY["color"] if strike is None else FAILED}
        self.styles = [ours, {**OPTIMUM, "linewidth": 1.3}][: 2 if compared else 1]
        self.views = [
            self.panel((0.075, 0.115, 0.30, 0.80), xlabel="downrange (m)", ylabel="altitude (m)"),
            self.panel((0.395, 0.115, 0.30, 0.80), xlabel="crossrange (m)"),
        ]
        self.views[1].tick_params(labelleft=False)
        self.thrust = self.panel((0.765, 0.57, 0.22, 0.345), xlabel="time (s)", ylabel="thrust (kN)")
        self._draw_still()
        self._prepare_flights()
        self.clock = self.figure.text(0.72, 0.455, "", fontsize=9, weight="bold", va="top", linespacing=1.4)
        rows = "altitude (m)\nspeed (m/s)\npropellant (kg)"
        self.readings = self.add_readings(self.styles, rows, 0.72, 0.23, 1.4)
        self.moving = [*sum(self.paths, []), *self.thrusts, *self.rings, *self.flames, *self.bodies]
        self.moving += [self.clock, *self.readings]

    def _draw_still(self):
        """Ground, pad, the limits of the thrust, and when the failure strikes."""
        for ax in self.views:
            ax.locator_params(axis="x", nbins=5)
            ax.axhspan(-1e6, 0, color=GROUND, zorder=0)
            ax.plot(0, 0, "^", color=TARGET["color"], markersize=7, zorder=3)
            ax.annotate("pad", (0, 0), (7, -10), textcoords="offset points", fontsize=8, zorder=3)
        for limit in (self.lander.least_thrust, self.lander.greatest_thrust):
            self.thrust.axhline(limit / 1e3, **BOUNDARY)
        self.thrust.set(ylim=(0, 1.1 * self.lander.greatest_thrust / 1e3))
        if self.strike:
            self.thrust.axvline(self.strike, **STRIKE)

    def _prepare_flights(self):
        """Each side's lines; at the head of the policy's path the lander, at the optimum's a ring."""
        self.paths = [[ax.plot([], [], zorder=4, **style)[0] for ax in self.views] for style in self.styles]
        self.thrusts = [self.thrust.plot([], [], zorder=4, **style)[0] for style in self.styles]
        ring = {"color": OPTIMUM["color"], **DOT, **LOOKS[1], "zorder": 9}
        self.rings = [ax.plot([], [], **ring)[0] for ax in self.views] if len(self.styles) > 1 else []
        fire = {"facecolor": "orange", "linewidth": 0, "zorder": 7}
        self.flames = [ax.add_patch(Polygon(FLAME, **fire)) for ax in self.views]
        for ax, flame in zip(self.views, self.flames):
            flame.set_clip_path(Rectangle((-1e6, 0), 2e6, 1e6, transform=ax.transData))  # above ground
        hull = {"facecolor": self.styles[0]["color"], "linewidth": 0, "zorder": 8}
        self.bodies = [ax.add_patch(Polygon(BODY, **hull)) for ax in self.views]

    def fit(self, flights: list[Flight]):
        """Axes that hold all these flights and the box of the starts: of one scale, so that directions are true."""
        points = np.concatenate([flight.y[:, :3] for flight in flights])
        centre = np.array(self.lander.start[:3])
        spread = np.array(self.lander.spread[:3])
        lowest = np.minimum(centre - spread, 0.0)
        highest = np.maximum(centre + spread, 0.0)
        margin = 0.05 * np.maximum(highest - lowest, 0.2 * highest[2])
        left, right = np.empty(3), np.empty(3)
        for axis in range(3):
            left[axis] = lowest[axis] - room(margin[axis], np.maximum(lowest[axis] - points[:, axis], 0.0))
            right[axis] = highest[axis] + room(margin[axis], np.maximum(points[:, axis] - highest[axis], 0.0))
        left[2] = min(points[:, 2].min(), 0.0)
        _, _, width, height = self.views[0].get_position().bounds
        width, height = width * WIDTH, height * HEIGHT
        scale = max((right - left) / [width, width, (1 - BELOW) * height])  # m
        self.height = scale * height
        bottom = left[2] - BELOW * self.height
        middle = (left + right) / 2
        for axis, ax in enumerate(self.views):
            sides = middle[axis] - scale * width / 2, middle[axis] + scale * width / 2
            ax.set(xlim=sides, ylim=(bottom, bottom + self.height))
        self.thrust.set(xlim=(0, room(LONGEST, np.concatenate([flight.t for flight in flights]))))

    def show(self, *sides: list[Flight], ended: bool = False):
        """Draw the one flight of each side as far as it goes; `pixels` is the frame.

        Until touchdown, thrust and readings are those of the last whole second, because faster ones could not be read.
        """
        flights = [flight for (flight,) in sides]
        second = np.floor(max(flight.t[-1] for flight in flights) + 1e-9)
        for flight, paths, thrust, reading in zip(flights, self.paths, self.thrusts, self.readings):
            for axis, path in enumerate(paths):
                path.set_data(flight.y[:, axis], flight.y[:, 2])
            seen = flight if flight.y[-1, 2] < DOWN else flight.until(second)
            size = np.linalg.norm(seen.u, axis=1) / 1e3
            thrust.set_data(np.repeat(seen.t, 2)[1:-1], np.repeat(size, 2))
            reading.set_text(reading_of(seen.y))
        for axis, ring in enumerate(self.rings):
            ring.set_data(flights[1].y[-1:, axis], flights[1].y[-1:, 2])
        self._show_lander(flights[0], ended)
        self.clock.set_text("\n".join([f"t = {second:.0f} s", *self._events(flights[0])]))

    def _show_lander(self, flight: Flight, ended: bool):
        """The lander at the path's head, its nose along the thrust and its flame away from it, as each view sees it."""
        position = flight.y[-1, :3]
        thrust = flight.u[-1] if len(flight.u) else np.array([0.0, 0.0, 1.0])
        burns = len(flight.u) > 0 and not ended and position[2] > DOWN
        for axis, body, flame in zip((0, 1), self.bodies, self.flames):
            head, seen = position[[axis, 2]], thrust[[axis, 2]]
            size = max(np.linalg.norm(seen), 1e-9)
            along, up = seen / size
            turn = np.array([[along, up], [-up, along]])
            body.set_xy(head + self.height * SIZE * BODY @ turn)
            stretch = LENGTH * size / self.lander.greatest_thrust, SIZE
            flame.set_xy(head + self.height * (FLAME * stretch) @ turn)
            flame.set_visible(burns)

    def _events(self, flight: Flight) -> list[str]:
        """What has happened to the policy's flight."""
        events, y = [], flight.y[-1]
        if self.strike is not None and flight.t[-1] >= self.strike:
            events.append(words_of(self.strike))
        if y[2] < DOWN:
            miss = np.linalg.norm(y[:3])
            events.append(f"down at {flight.t[-1]:.1f} s, {miss:.{2 if miss < 100 else 0}f} m off")
        return events


def reading_of(y: np.ndarray) -> str:
    """Altitude (m), speed (m/s) and propellant used (kg), each on a line, at the end of states y (K+1, 7)."""
    altitude = max(y[-1, 2], 0.0)
    speed = np.linalg.norm(y[-1, 3:6])
    propellant = y[0, 6] - y[-1, 6]
    return f"{altitude:.0f}\n{speed:.{1 if speed < 10 else 0}f}\n{propellant:.0f}"


def descent_animation(lander: Lander, arrays: dict, title: str) -> Animation:
    """The first flight that a failure struck, or else the first flight, beside its optimum if that is known.

    Only flights whose states are in the arrays are considered.
    """
    failed = np.flatnonzero(has_failed(arrays["effectiveness"][: len(arrays["y"])]))
    row = int(failed[0]) if len(failed) else 0
    period = float(arrays["decision_s"])
    gravity = arrays["gravity"][row]
    sides = []
    for suffix, name in SIDES.items():
        y = flown_states(arrays.get(f"y{suffix}", NONE), row)
        if len(y):
            t = period * np.arange(len(y))
            if not suffix:
                t[-1] = arrays["final_t"][row]
            sides.append([Flight.of(t, flown_thrust(y, gravity, period), y, name)])
    strike = strike_time(arrays["effectiveness"][row], period)
    return Animation.of(DescentSheet(lander, title, len(sides) > 1, strike), sides)
