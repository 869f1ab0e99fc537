"""The picture that moves: an evaluation as animation.gif, and a running environment's flight so far as one frame.

`write` draws a folder's animation; `PhasePlane` and `Ascent` are the two drawings, whose `frame` is also what
`render_mode="rgb_array"` gives. Imported only where something is drawn. Needs no torch, no ffmpeg: Pillow, on which
Matplotlib stands, writes the GIF. Reading order: flights, double integrator and Van der Pol, rocket ascent, the GIF.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Circle
from matplotlib.path import Path as Outline
from matplotlib.transforms import Affine2D
from PIL import Image

import envs
from baselines import replacing
from figures import BOUNDARY, OPTIMUM, POLICY, SHOWN, TARGET, headline

# ---------------------------------------------------------------------------------------------------------------------
# Flights and the sheet they are drawn on
# ---------------------------------------------------------------------------------------------------------------------

WIDTH, HEIGHT, DPI = 800, 450, 100  # pixels of a frame, and of an inch: sizes of text and lines are in points
SIDES = {"": "policy", "_reference": "optimum"}  # by the suffix of their arrays
# a flight's head: ours a dot, the optimum's a ring around it
DOT, LOOKS = (
    {"linestyle": "", "marker": "o", "zorder": 6},
    ({"markersize": 4.5}, {"markersize": 7, "fillstyle": "none"}),
)
GROWTH = 1.25  # axes grow by this factor, so that a running environment's do not creep


class Flight(NamedTuple):
    """What was flown: times t (K+1,) s, controls u (K, m) held from each time to the next, states y (K+1, n)."""

    t: np.ndarray
    u: np.ndarray
    y: np.ndarray

    @classmethod
    def of(cls, t, u, y, name: str) -> Flight:
        """The flight of these arrays; BadInput, with its name, if they are not of one flight or hold a NaN."""
        flight = cls(t, u, y)
        if not (u.ndim == y.ndim == 2 and len(t) == len(y) == len(u) + 1 > 1):
            shapes = f"t {t.shape}, u {u.shape}, states {y.shape}"
            raise envs.BadInput(f"eval.npz: the {name}'s arrays have shapes {shapes}; must be (K+1,), (K, m), (K+1, n)")
        if not all(np.isfinite(array).all() for array in flight):
            raise envs.BadInput(f"eval.npz: the {name}'s flight holds a NaN or an infinity; it must be finite")
        return flight

    def until(self, time: float) -> Flight:
        """The part up to `time` (s), with the state between two steps on the chord."""
        if time >= self.t[-1]:
            return self
        k = max(int(np.searchsorted(self.t, time, side="right")), 1)  # steps begun
        part = (time - self.t[k - 1]) / (self.t[k] - self.t[k - 1])
        y = (1 - part) * self.y[k - 1] + part * self.y[k]
        return Flight(np.append(self.t[:k], time), self.u[:k], np.vstack([self.y[:k], y]))


class Sheet:
    """A figure of WIDTH x HEIGHT pixels that is drawn again and again; `moving` are the artists that change."""

    def __init__(self, title: str):
        self.figure = Figure(figsize=(WIDTH / DPI, HEIGHT / DPI), dpi=DPI)
        self.canvas = FigureCanvasAgg(self.figure)
        self.figure.text(0.5, 0.955, title, ha="center", fontsize=10)
        self.moving, self._limits, self._still = [], None, None

    def panel(self, box, title: str = "", **labels):
        """Axes at `box` (left, bottom, width, height as shares of the sheet), small text, a pale grid."""
        ax = self.figure.add_axes(box)
        ax.set(**labels)
        ax.set_title(title, fontsize=9)
        ax.tick_params(labelsize=7, length=2)
        ax.xaxis.label.set_size(8)
        ax.yaxis.label.set_size(8)
        ax.grid(alpha=0.3)
        return ax

    def pixels(self) -> np.ndarray:
        """The sheet as it is now: uint8, (HEIGHT, WIDTH, 3)."""
        limits = [(ax.get_xlim(), ax.get_ylim()) for ax in self.figure.axes]
        if limits != self._limits:  # ticks and text cost most of a drawing: what stands still is drawn once
            for artist in self.moving:
                artist.set_animated(True)
            self.canvas.draw()
            self._limits, self._still = limits, self.canvas.copy_from_bbox(self.figure.bbox)
        self.canvas.restore_region(self._still)
        for artist in sorted(self.moving, key=lambda artist: artist.zorder):
            self.figure.draw_artist(artist)
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()


def room(base: float, values: np.ndarray) -> float:
    """The smallest base * GROWTH^k, k >= 0, that holds every |value|."""
    largest = np.abs(values).max(initial=0.0)
    return base * GROWTH ** max(0, int(np.ceil(np.log(max(largest, base) / base) / np.log(GROWTH) - 1e-9)))


# ---------------------------------------------------------------------------------------------------------------------
# Double integrator and Van der Pol
# ---------------------------------------------------------------------------------------------------------------------


class PhasePlane(Sheet):
    """The phase plane with the circles, beside it position and control over time; any number of flights."""

    def __init__(self, problem: envs.Problem, title: str = "", compared: bool = False):
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
            if len(self.problem.phases) > 1:
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
        label = "target" if len(self.problem.phases) == 1 else "targets"
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

    def frame(self, flight: Flight) -> np.ndarray:
        """One flight as far as it has come: uint8, (HEIGHT, WIDTH, 3)."""
        self.fit([flight])
        self.show([flight])
        return self.pixels()


def stairs(flight: Flight) -> np.ndarray:
    """The corners (2 K, 2) of the control over time, held over each step."""
    times = np.repeat(flight.t, 2)[1:-1]
    return np.column_stack([times, np.repeat(flight.u[:, 0], 2)])


# ---------------------------------------------------------------------------------------------------------------------
# Rocket ascent
# ---------------------------------------------------------------------------------------------------------------------

# nose at +x, one long; the flame behind it
BODY = Outline([(1.0, 0.0), (0.45, 0.24), (-0.6, 0.24), (-0.6, -0.24), (0.45, -0.24), (1.0, 0.0)])
FLAME = Outline([(-0.6, 0.2), (-1.6, 0.0), (-0.6, -0.2), (-0.6, 0.2)])
EARTH = "#d7e6f2"
ALTITUDE, DOWNRANGE = 60.0, 600.0  # km: what the axes of a flight that has just begun show


class Ascent(Sheet):
    """A rocket's ascent in the target's plane with its stagings, its pitch, and the orbit that it would coast on."""

    def __init__(self, rocket: envs.Rocket, title: str = "Rocket ascent", compared: bool = False):
        super().__init__(title)
        self.rocket, self.axes = rocket, envs.target_axes(rocket)
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
        self._prepare_readings()
        self.moving = [*self.paths, *self.pitches, *self.orbits, *self.dots, self.flame, self.body, self.marks]
        self.moving += [*self.labels, self.clock, *self.readings]

    def _draw_orbit_panel(self):
        """The target's plane to scale, perigee to the right: Earth and the target orbit."""
        Re, a, e = self.rocket.Re, self.rocket.a, self.rocket.e
        self.orbit.add_patch(Circle((0, 0), Re, facecolor=EARTH, edgecolor="0.6", linewidth=0.6, zorder=0))
        self.orbit.plot(
            *self._orbit(np.concatenate(self._target_state())), **{**TARGET, "linewidth": 4.0, "alpha": 0.4}
        )
        low, high, side = -a * (1 + e), max(a * (1 - e), Re), max(a * np.sqrt(1 - e * e), Re)
        margin = 0.06 * (high - low)
        top = side + 3 * margin  # room for the caption: a title above a round orbit would meet the figure's
        self.orbit.set(xlim=(low - margin, high + margin), ylim=(-side - margin, top), aspect="equal")
        self.orbit.set_axis_off()
        caption = "orbit if the engines stopped now, and the target"
        self.orbit.text((low + high) / 2, top, caption, ha="center", va="top", fontsize=8)
        self.orbit.text(0, -0.6 * Re, "Earth", ha="center", va="center", fontsize=7, color="0.4")

    def _target_state(self) -> tuple[np.ndarray, np.ndarray]:
        """r (m) and v (m/s) in ECI at the target's perigee."""
        a, e, (perigee, ahead, _) = self.rocket.a, self.rocket.e, self.axes
        return a * (1 - e) * perigee, np.sqrt(self.rocket.mu / a * (1 + e) / (1 - e)) * ahead

    def _draw_target_altitude(self):
        """The target orbit's altitude over the downrange from the pad, half a turn of it."""
        angle = self.launch + np.linspace(0, np.pi, 721)
        r = self.rocket.a * (1 - self.rocket.e**2) / (1 + self.rocket.e * np.cos(angle))
        x, y = (angle - self.launch) * self.rocket.Re / 1e3, (r - self.rocket.Re) / 1e3
        self.ascent.plot(x, y, **{**TARGET, "linewidth": 4.0, "alpha": 0.4})
        self.ascent.axhspan(-1e4, 0, color=EARTH, zorder=0)

    def _prepare_lines(self):
        self.paths, self.pitches, self.orbits, self.dots = [], [], [], []
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
        """What is dropped at the end of each burn, unseen until it happens; the last is the end of the flight."""
        self.events = []
        for burn, dropped in zip(self.rocket.burns[:-1], self.rocket.jettison):
            number = sum(n for n, _ in burn.dropped)
            engines = f"{number} engine{'s' * (number != 1)}, " if number else ""
            self.events.append((burn.end, f"{burn.end:.0f} s: {engines}{dropped / 1e3:.1f} t dropped"))
        for time, _ in self.events:
            self.pitch.axvline(time, **BOUNDARY)
        self.marks = self.ascent.plot([], [], "o", color="k", markersize=4, zorder=8)[0]
        style = {"textcoords": "offset points", "fontsize": 8, "va": "center", "zorder": 8}
        style["bbox"] = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1}
        self.labels = [self.ascent.annotate("", (0, 0), (9, -3), **style) for _ in self.events]
        self.labels.append(self.ascent.annotate("", (0, 0), (6, -18), ha="right", **style))  # inside, at the far end

    def _prepare_readings(self):
        """Below the orbit: the clock, and of each side altitude, speed, mass, perigee and apogee."""
        self.clock = self.figure.text(0.635, 0.275, "", fontsize=9, weight="bold")
        rows = "altitude (km)\nspeed (km/s)\nmass (t)\nperigee (km)\napogee (km)"
        look = {"fontsize": 8, "va": "top", "linespacing": 1.35}
        self.figure.text(0.635, 0.215, rows, **look)
        self.readings = []
        for style, name, right in zip(self.styles, SIDES.values(), (0.88, 0.985)):
            look |= {"color": style["color"], "ha": "right"}
            self.figure.text(right, 0.265, name, **{**look, "weight": "bold"})
            self.readings.append(self.figure.text(right, 0.215, "", **look))

    def _polar(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angle from the target's perigee (rad, without jumps) and altitude (m) of states y (n, 7), (n,) each."""
        x, ahead, _ = self.axes @ y[:, :3].T
        return np.unwrap(np.arctan2(ahead, x)), np.linalg.norm(y[:, :3], axis=1) - self.rocket.Re

    def _track(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Downrange over the ground of the start and altitude of states y (n, 7), in km, (n,) each."""
        angle, altitude = self._polar(y)
        return (angle - self.launch) * self.rocket.Re / 1e3, altitude / 1e3

    def _orbit(self, y: np.ndarray) -> np.ndarray:
        """The orbit (2, n), m, in the target's plane on which a state y (r, v, ...) would coast; cut far from Earth."""
        h, e = (np.array(vector) for vector in envs.orbit_vectors(y, self.rocket.mu))
        size = np.linalg.norm(e)
        along = e / size if size > 1e-9 else y[:3] / np.linalg.norm(y[:3])
        across = np.cross(h / max(np.linalg.norm(h), 1e-300), along)  # a launch from a pole begins with h = 0
        # half angles, so that an almost straight fall has points at its far end, too
        half = np.arctan(np.sqrt((1 + size) / max(abs(1 - size), 1e-9)) * np.tan(np.linspace(-np.pi, np.pi, 361) / 2))
        slowness = 1 + size * np.cos(2 * half)
        r = h @ h / self.rocket.mu / np.where(slowness > 1e-9, slowness, np.nan)
        points = r * (np.cos(2 * half) * along[:, None] + np.sin(2 * half) * across[:, None])
        return (self.axes @ np.where(r < 20 * self.rocket.a, points, np.nan))[:2]

    def fit(self, flights: list[Flight]):
        """Axes that hold all these flights."""
        tracks = [self._track(flight.y) for flight in flights]
        x, altitude = (np.concatenate(values) for values in zip(*tracks))
        top, right = room(ALTITUDE, 1.1 * altitude), room(DOWNRANGE, 1.03 * x)
        pitch = np.concatenate([pitch_above_horizon(flight) for flight in flights])
        self.pitch.set(ylim=(-room(10.0, 1.1 * np.minimum(pitch, 0.0)), 100))
        self.ascent.set(xlim=(min(-0.03 * right, 1.03 * x.min()), right), ylim=(-0.06 * top, top))

    def show(self, *sides: list[Flight], ended: bool = False):
        """Draw the one flight of each side as far as it goes; `ended`: the policy's goes no further."""
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
        running = min(sum(flights[0].t[-1] >= time for time, _ in self.events) + 1, len(self.rocket.burns))
        self.clock.set_text(f"t = {flights[0].t[-1]:.0f} s\nphase {running} of {len(self.rocket.burns)}")

    def _reading(self, y: np.ndarray) -> str:
        elements = envs.orbital_elements(y, self.rocket.mu)
        perigee, apogee = (elements.a * (1 + sign * elements.e) - self.rocket.Re for sign in (-1, 1))
        apogee = f"{apogee / 1e3:.0f}" if 0 < elements.a < 1e12 else "-"
        altitude, speed = np.linalg.norm(y[:3]) - self.rocket.Re, np.linalg.norm(y[3:6])
        return f"{altitude / 1e3:.1f}\n{speed / 1e3:.2f}\n{y[6] / 1e3:.2f}\n{perigee / 1e3:.0f}\n{apogee}"

    def _show_rocket(self, flight: Flight, ended: bool):
        """The rocket at the path's head, pointing at its pitch; its flame goes out at the end."""
        x, altitude = self._track(flight.y)
        pitch = pitch_above_horizon(flight)[-1] if len(flight.u) else 90.0
        turn = Affine2D().rotate_deg(pitch)
        for line, outline, seen in ((self.body, BODY, True), (self.flame, FLAME, len(flight.u) and not ended)):
            line.set_data(x[-1:], altitude[-1:])
            line.set_marker(MarkerStyle(outline, transform=turn))
            line.set_visible(bool(seen))

    def _show_events(self, flight: Flight, ended: bool):
        x, altitude = self._track(flight.y)
        happened = [(time, text) for time, text in self.events if time <= flight.t[-1]]
        if ended:
            how = "cut-off" if flight.t[-1] < self.rocket.burns[-1].end - 1e-6 else "end of the last burn"
            happened.append((flight.t[-1], f"{flight.t[-1]:.0f} s: {'crash' if altitude[-1] < 0 else how}"))
        times = [time for time, _ in happened]
        spots = np.interp(times, flight.t, x), np.interp(times, flight.t, altitude)
        self.marks.set_data(*(values[: len(self.events)] for values in spots))
        for k, label in enumerate(self.labels):
            label.set_visible(k < len(happened))
            if k < len(happened):
                label.xy = spots[0][k], spots[1][k]
                label.set_text(happened[k][1])

    def frame(self, flight: Flight) -> np.ndarray:
        """One flight as far as it has come: uint8, (HEIGHT, WIDTH, 3)."""
        self.fit([flight])
        self.show([flight])
        return self.pixels()


def pitch_above_horizon(flight: Flight) -> np.ndarray:
    """Degrees of the thrust direction above the local horizon at each step's start, (K,)."""
    r = flight.y[: len(flight.u), :3]
    up = np.einsum("kc,kc->k", flight.u, r) / np.linalg.norm(r, axis=1)
    return np.degrees(np.arcsin(np.clip(up, -1, 1)))


# ---------------------------------------------------------------------------------------------------------------------
# The GIF
# ---------------------------------------------------------------------------------------------------------------------

FRAMES, FRAME_MS, HOLD_MS = 130, 80, 2000  # the last frame is held; a GIF counts in hundredths of a second
COLOURS = 96  # of the palette that all frames share: none flickers, and what stands still costs nothing
HASTE = 1.5  # of a rocket's clock: time goes with this power of the share played, since the stagings come early


def write(folder, arrays: dict, metrics: dict) -> Path:
    """Write animation.gif of an evaluation's `arrays` and `metrics` into `folder`; returns its path.

    Ours beside the optimum: the ascent of a rocket, or the phase plane of the first ten starts.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    sheet, sides, times = scene(arrays, metrics)
    with replacing(folder / "animation.gif") as file:
        write_gif(file, lambda k: shown_at(sheet, sides, times[k]), len(times))
    return folder / "animation.gif"


def scene(arrays: dict, metrics: dict) -> tuple[Sheet, list[list[Flight]], np.ndarray]:
    """The sheet, the flights of both sides, and the times (FRAMES,) in s at which the frames show them."""
    env_id = metrics["env_id"]
    if env_id in envs.ROCKETS:
        sheet = Ascent(envs.ROCKETS[env_id].rocket, headline(metrics), compared=True)
        sides = [
            [Flight.of(*(arrays[f"{key}{side}"] for key in ("t", "u", "y")), name)] for side, name in SIDES.items()
        ]
    else:
        sheet = PhasePlane(envs.PROBLEMS[env_id], headline(metrics), compared=True)
        sides = []
        for side, name in SIDES.items():
            flown = zip(arrays[f"u{side}"][:SHOWN], arrays[f"x{side}"][:SHOWN])
            sides.append([Flight.of(arrays["t"], u[..., None], x, name) for u, x in flown])
    flights = [flight for side in sides for flight in side]
    sheet.fit(flights)
    share = np.linspace(0, 1, FRAMES) ** (HASTE if env_id in envs.ROCKETS else 1.0)
    return sheet, sides, share * max(flight.t[-1] for flight in flights)


def shown_at(sheet: Sheet, sides: list[list[Flight]], time: float) -> np.ndarray:
    """The frame at `time` (s): uint8, (HEIGHT, WIDTH, 3)."""
    ended = time >= sides[0][0].t[-1]
    sheet.show(*([flight.until(time) for flight in flights] for flights in sides), ended=ended)
    return sheet.pixels()


def write_gif(file, frame, count: int):
    """Write `count` frames, `frame(k)` each uint8 (H, W, 3), as a GIF that plays for ever."""
    samples = np.vstack([frame(0), frame(count // 2), frame(count - 1)])
    palette = Image.fromarray(samples).quantize(COLOURS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    first, *others = indexed(frame, count, palette)
    durations = [FRAME_MS] * (count - 1) + [HOLD_MS]
    first.save(file, format="GIF", save_all=True, append_images=others, duration=durations, loop=0, disposal=1)


def indexed(frame, count: int, palette: Image.Image) -> Iterator[Image.Image]:
    """The frames in the palette's colours, without dither, one after the other."""
    for k in range(count):
        yield Image.fromarray(frame(k)).quantize(palette=palette, dither=Image.Dither.NONE)
