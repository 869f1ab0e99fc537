"""The rocket's animation: its ascent in the target's plane, its pitch, and the orbit on which it would coast."""

from __future__ import annotations

import numpy as np
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Circle
from matplotlib.path import Path as Outline
from matplotlib.transforms import Affine2D

from drawing.animation import DOT, LOOKS, SIDES, Animation, Flight, Sheet, room
from drawing.style import BOUNDARY, OPTIMUM, POLICY, TARGET_ORBIT, in_tonnes
from rocket.dispersion import Vehicles
from rocket.orbits import orbit_vectors, orbital_elements, target_axes
from rocket.vehicle import Rocket, engine_groups

# nose at +x, one long; the flame behind it
BODY = Outline([(1.0, 0.0), (0.45, 0.24), (-0.6, 0.24), (-0.6, -0.24), (0.45, -0.24), (1.0, 0.0)])
FLAME = Outline([(-0.6, 0.2), (-1.6, 0.0), (-0.6, -0.2), (-0.6, 0.2)])
EARTH, FAILURE = "#d7e6f2", "crimson"
ALTITUDE, DOWNRANGE = 60.0, 600.0  # km, the size of the axes when a flight has just begun


class AscentSheet(Sheet):
    """A rocket's ascent in the target's plane with its stagings, its pitch, and the orbit on which it would coast."""

    def __init__(
        self, rocket: Rocket, title: str = "Rocket ascent", compared: bool = False, vehicle: Vehicles | None = None
    ):
        """`vehicle` is the flight's drawn vehicle, whose stagings and failure are shown."""
        super().__init__(title)
        self.rocket, self.axes = rocket, target_axes(rocket)
        self.stagings = stagings(rocket, vehicle)
        self.burn_out = rocket.burns[-1].end if vehicle is None else vehicle.burn_end[-1, 0]  # s
        self.strike = None if vehicle is None else loss_of_thrust(rocket, vehicle)
        self.styles = [{**POLICY, "linewidth": 2.0}, {**OPTIMUM, "linewidth": 1.3}][: 2 if compared else 1]
        self.ascent = self.panel((0.07, 0.47, 0.545, 0.45), ylabel="altitude (km)", xlabel="downrange (km)")
        self.pitch = self.panel((0.07, 0.105, 0.545, 0.235), ylabel="pitch (deg)", xlabel="time (s)")
        self.pitch.set(xlim=(0, rocket.end_time), yticks=(-90, -60, -30, 0, 30, 60, 90))
        self.orbit = self.figure.add_axes((0.63, 0.32, 0.36, 0.61))
        self._draw_orbit_panel()
        self.launch = self._polar(rocket.x0[None])[0][0]
        self._draw_target_altitude()
        self._prepare_lines()
        self._prepare_events()
        self.clock = self.figure.text(0.635, 0.275, "", fontsize=9, weight="bold")
        rows = "altitude (km)\nspeed (km/s)\nmass (t)\nperigee (km)\napogee (km)"
        self.readings = self.add_readings(self.styles, rows, 0.635, 0.215, 1.35)
        self.moving = [*self.paths, *self.pitches, *self.orbits, *self.dots, self.flame, self.body, self.marks]
        self.moving += [*self.labels, self.clock, *self.readings]
        self.moving += [self.failed, self.cross] if self.strike else []

    def _draw_orbit_panel(self):
        """Draw Earth and the target orbit in the target's plane, to scale, with the perigee to the right."""
        Re, a, e = self.rocket.Re, self.rocket.a, self.rocket.e
        self.orbit.add_patch(Circle((0, 0), Re, facecolor=EARTH, edgecolor="0.6", linewidth=0.6, zorder=0))
        self.orbit.plot(*self._orbit(self._target_state()), **TARGET_ORBIT)
        low = -a * (1 + e)
        high = max(a * (1 - e), Re)
        side = max(a * np.sqrt(1 - e * e), Re)
        margin = 0.06 * (high - low)
        top = side + 3 * margin  # room for the caption, because a title above would meet the figure's title
        self.orbit.set(xlim=(low - margin, high + margin), ylim=(-side - margin, top), aspect="equal")
        self.orbit.set_axis_off()
        caption = "orbit if the engines stopped now, and the target"
        self.orbit.text((low + high) / 2, top, caption, ha="center", va="top", fontsize=8)
        self.orbit.text(0, -0.6 * Re, self.rocket.body, ha="center", va="center", fontsize=7, color="0.4")

    def _target_state(self) -> np.ndarray:
        """r (m) and v (m/s) in ECI at the target's perigee, (6,)."""
        a, e, (perigee, ahead, _) = self.rocket.a, self.rocket.e, self.axes
        return np.append(a * (1 - e) * perigee, np.sqrt(self.rocket.mu / a * (1 + e) / (1 - e)) * ahead)

    def _draw_target_altitude(self):
        """Draw the target orbit's altitude over the downrange from the pad, for half a turn."""
        angle = self.launch + np.linspace(0, np.pi, 721)
        r = self.rocket.a * (1 - self.rocket.e**2) / (1 + self.rocket.e * np.cos(angle))
        x = (angle - self.launch) * self.rocket.Re / 1e3
        y = (r - self.rocket.Re) / 1e3
        self.ascent.plot(x, y, **TARGET_ORBIT)
        self.ascent.axhspan(-1e4, 0, color=EARTH, zorder=0)

    def _prepare_lines(self):
        self.paths = []
        self.pitches = []
        self.orbits = []
        self.dots = []
        for style in self.styles:
            self.paths += self.ascent.plot([], [], zorder=4, **style)
            self.pitches += self.pitch.plot([], [], zorder=4, **style)
            self.orbits += self.orbit.plot([], [], zorder=3, **{**style, "linewidth": 1.3})
        for style, look in zip(self.styles, LOOKS):
            self.dots += self.orbit.plot([], [], color=style["color"], **DOT, **look)
        look = {"linestyle": "", "zorder": 7, "clip_on": False}
        self.flame = self.ascent.plot([], [], color="orange", markersize=26, markeredgecolor="none", **look)[0]
        edge = {"markeredgecolor": "0.25", "markeredgewidth": 0.6}
        self.body = self.ascent.plot([], [], color=POLICY["color"], markersize=17, **edge, **look)[0]

    def _prepare_events(self):
        """Prepare the labels of stagings, failure and end of the flight. They are invisible until they happen."""
        for time, _ in self.stagings:
            self.pitch.axvline(time, **BOUNDARY)
        self.marks = self.ascent.plot([], [], "o", color="k", markersize=4, zorder=8)[0]
        style = {"textcoords": "offset points", "fontsize": 8, "va": "center", "zorder": 8}
        style["bbox"] = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1}
        self.labels = [self.ascent.annotate("", (0, 0), (9, -3), **style) for _ in self.stagings]
        self.labels.append(self.ascent.annotate("", (0, 0), (6, -18), ha="right", **style))  # inside, at the far end
        if self.strike:
            time, text = self.strike
            self.pitch.axvline(time, **{**BOUNDARY, "color": FAILURE})
            side = "left" if time <= self.rocket.end_time / 2 else "right"  # text towards the middle stays inside
            self.failed = self.pitch.text(time, 78, f" {text} ", ha=side, color=FAILURE, fontsize=8, weight="bold")
            self.cross = self.ascent.plot([], [], "X", color=FAILURE, markersize=8, zorder=9)[0]

    def _polar(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angle from the target's perigee (rad, without jumps) and altitude (m) of states y (n, 7), (n,) each."""
        x, ahead, _ = self.axes @ y[:, :3].T
        return np.unwrap(np.arctan2(ahead, x)), np.linalg.norm(y[:, :3], axis=1) - self.rocket.Re

    def _track(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Downrange over the ground of the start and altitude of states y (n, 7), in km, (n,) each."""
        angle, altitude = self._polar(y)
        return (angle - self.launch) * self.rocket.Re / 1e3, altitude / 1e3

    def _orbit(self, y: np.ndarray) -> np.ndarray:
        """The orbit (2, n) in m, in the target's plane, on which a state y (r, v, ...) would coast; cut far out."""
        h, e = np.array(orbit_vectors(y, self.rocket.mu))
        size = np.linalg.norm(e)
        along = e / size if size > 1e-9 else y[:3] / np.linalg.norm(y[:3])
        across = np.cross(h / max(np.linalg.norm(h), 1e-300), along)  # a launch from a pole begins with h = 0
        # half angles also give an almost straight fall points at its far end
        half = np.arctan(np.sqrt((1 + size) / max(abs(1 - size), 1e-9)) * np.tan(np.linspace(-np.pi, np.pi, 361) / 2))
        slowness = 1 + size * np.cos(2 * half)
        r = h @ h / self.rocket.mu / np.where(slowness > 1e-9, slowness, np.nan)
        points = r * (np.cos(2 * half) * along[:, None] + np.sin(2 * half) * across[:, None])
        return (self.axes @ np.where(r < 20 * self.rocket.a, points, np.nan))[:2]

    def fit(self, flights: list[Flight]):
        """Set axes that hold all these flights."""
        tracks = [self._track(flight.y) for flight in flights]
        x, altitude = (np.concatenate(values) for values in zip(*tracks))
        top = room(ALTITUDE, 1.1 * altitude)
        right = room(DOWNRANGE, 1.03 * x)
        pitch = np.concatenate([pitch_above_horizon(flight) for flight in flights])
        self.pitch.set(ylim=(-room(10.0, 1.1 * np.minimum(pitch, 0.0)), 100))
        self.pitch.set_xlim(0, max(self.rocket.end_time, *(flight.t[-1] for flight in flights)))
        self.ascent.set(xlim=(min(-0.03 * right, 1.03 * x.min()), right), ylim=(-0.06 * top, top))

    def show(self, *sides: list[Flight], ended: bool = False):
        """Draw the one flight of each side as far as it goes. `ended` says that the policy's flight has ended."""
        flights = [flight for (flight,) in sides]
        for flight, path, pitch, orbit, dot, reading in zip(
            flights, self.paths, self.pitches, self.orbits, self.dots, self.readings
        ):
            path.set_data(*self._track(flight.y))
            angle = pitch_above_horizon(flight)
            pitch.set_data(np.repeat(flight.t, 2)[1:-1], np.repeat(angle, 2))
            orbit.set_data(*self._orbit(flight.y[-1]))
            dot.set_data(*(self.axes @ flight.y[-1:, :3].T)[:2])
            reading.set_text(self._reading(flight.y[-1]))
        self._show_rocket(flights[0], ended)
        self._show_events(flights[0], ended)
        running = min(sum(flights[0].t[-1] >= time for time, _ in self.stagings) + 1, len(self.rocket.burns))
        self.clock.set_text(f"t = {flights[0].t[-1]:.0f} s\nphase {running} of {len(self.rocket.burns)}")

    def _reading(self, y: np.ndarray) -> str:
        elements = orbital_elements(y, self.rocket.mu)
        perigee, apogee = (elements.a * (1 + sign * elements.e) - self.rocket.Re for sign in (-1, 1))
        apogee = f"{apogee / 1e3:.0f}" if 0 < elements.a < 1e12 else "-"
        altitude = np.linalg.norm(y[:3]) - self.rocket.Re
        speed = np.linalg.norm(y[3:6])
        return f"{altitude / 1e3:.1f}\n{speed / 1e3:.2f}\n{y[6] / 1e3:.2f}\n{perigee / 1e3:.0f}\n{apogee}"

    def _show_rocket(self, flight: Flight, ended: bool):
        """Draw the rocket at the path's head, at its pitch. Its flame goes out at the end."""
        x, altitude = self._track(flight.y)
        pitch = pitch_above_horizon(flight)[-1] if len(flight.u) else 90.0
        turn = Affine2D().rotate_deg(pitch)
        for line, outline, seen in ((self.body, BODY, True), (self.flame, FLAME, len(flight.u) and not ended)):
            line.set_data(x[-1:], altitude[-1:])
            line.set_marker(MarkerStyle(outline, transform=turn))
            line.set_visible(bool(seen))

    def _show_events(self, flight: Flight, ended: bool):
        x, altitude = self._track(flight.y)
        happened = [(time, text) for time, text in self.stagings if time <= flight.t[-1]]
        if ended:
            how = "cut-off" if flight.t[-1] < self.burn_out - 1e-6 else "end of the last burn"
            happened.append((flight.t[-1], f"{flight.t[-1]:.0f} s: {'crash' if altitude[-1] < 0 else how}"))
        times = [time for time, _ in happened]
        spots = np.interp(times, flight.t, x), np.interp(times, flight.t, altitude)
        self.marks.set_data(*(values[: len(self.stagings)] for values in spots))
        for k, label in enumerate(self.labels):
            label.set_visible(k < len(happened))
            if k < len(happened):
                label.xy = spots[0][k], spots[1][k]
                label.set_text(happened[k][1])
        if self.strike:
            self._show_failure(flight.t, x, altitude)

    def _show_failure(self, t, x, altitude):
        time, _ = self.strike
        for artist in (self.failed, self.cross):
            artist.set_visible(time <= t[-1])
        self.cross.set_data([np.interp(time, t, x)], [np.interp(time, t, altitude)])


def stagings(rocket: Rocket, vehicle: Vehicles | None) -> list[tuple[float, str]]:
    """The ends (s) of all burns but the last and what is dropped then, for a drawn vehicle or the nominal one."""
    if vehicle is None:
        ends = [burn.end for burn in rocket.burns]
        dropped = rocket.jettison
    else:
        ends = vehicle.burn_end[:, 0]
        dropped = [vehicle.dropped[vehicle.burn[:, 0] == k, 0].sum() for k in range(len(ends))]
    told = []
    for burn, end, mass in zip(rocket.burns[:-1], ends, dropped):
        number = sum(n for n, _ in burn.dropped)
        engines = f"{number} engine{'s' * (number != 1)}, " if number else ""
        told.append((end, f"{end:.0f} s: {engines}{in_tonnes(mass, 1)} dropped"))
    return told


def loss_of_thrust(rocket: Rocket, vehicle: Vehicles) -> tuple[float, str] | None:
    """The time (s) when a drawn vehicle's failure strikes, and its loss in words. None for a healthy one."""
    group, time, share = vehicle.failure[:, 0]
    if group < 0:
        return None
    number = engine_groups(rocket)[int(group)].number
    return time, f"{time:.0f} s: {number} engine{'s' * (number != 1)} lose{'s' * (number == 1)} {share:.0%} of thrust"


def pitch_above_horizon(flight: Flight) -> np.ndarray:
    """Degrees of the thrust direction above the local horizon at each step's start, (K,)."""
    r = flight.y[: len(flight.u), :3]
    up = np.einsum("kc,kc->k", flight.u, r) / np.linalg.norm(r, axis=1)
    return np.degrees(np.arcsin(np.clip(up, -1, 1)))


HASTE = 1.5  # time goes with this power of the share played, since the stagings come early


def ascent_animation(rocket: Rocket, arrays: dict, title: str, vehicle: Vehicles | None = None) -> Animation:
    """The flight of an evaluation, policy beside the nominal flight's optimum.

    With a drawn `vehicle` it is the vehicle's flight, which was saved and which a failure made burn longest.
    """
    shown = SIDES if vehicle is None else {"_saved": "saved", "_reference": "optimum"}
    sides = []
    for suffix, name in shown.items():
        sides.append([Flight.of(*(arrays[f"{key}{suffix}"] for key in ("t", "u", "y")), name)])
    return Animation.of(AscentSheet(rocket, title, compared=True, vehicle=vehicle), sides, HASTE)
