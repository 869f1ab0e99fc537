"""Landers: the table of a vehicle and its descent, what each flight draws, and which landers cannot fly.

`MARS` is the problem of Gaudet, Linares and Furfaro, "Adaptive guidance and integrated navigation with reinforcement
meta-learning" (Acta Astronautica, 2020), with the numbers of their public code. `POWERED_DESCENT` is the lander of
Acikmese and Ploen, "Convex programming approach to powered descent guidance for Mars landing" (JGCD, 2007).

Axes: x downrange, y crossrange, z up; the pad is the origin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from common.errors import is_finite, refuse_unless, refuse_unless_finite
from common.registration import register

FAILURE_TIMES = ("start", "random")
LAST_FAILURE = 40.0  # s, before which "random" failures strike
ROCK = 3340.0  # kg/m^3, the density of the Moon; Mars and the Earth are denser, and so smaller for their gravity
G = 6.674e-11  # m^3/(kg s^2)
MOST_NEGLECTED = 0.5  # share of gravity that flat ground may neglect


class Failure(NamedTuple):
    """Which failures flights draw. A size is what a failure divides thrust by; it is drawn from (least, greatest)."""

    probability: float
    sizes: tuple[float, float]  # along x or y
    verticals: tuple[float, float]  # along z
    time: str = "start"  # one of `FAILURE_TIMES`


@dataclass(frozen=True)
class Lander:
    """A vehicle, its planet and the box of its starts. Raises BadInput for a lander that cannot fly."""

    mass: float  # kg, at the start
    dry_mass: float  # kg, at which the engine stops
    isp: float  # s
    least_thrust: float  # N
    greatest_thrust: float  # N
    start: tuple[float, ...]  # centre of the box of r (m) and v (m/s), six numbers
    spread: tuple[float, ...] = (0.0,) * 6  # half widths of the box
    g0: float = 9.81  # m/s^2; isp g0 is the exhaust velocity
    cant: float = 0.0  # degrees between the nozzles and the thrust, whose cosine multiplies the exhaust velocity
    gravity: float = 3.7114  # m/s^2, downwards
    mass_spread: float = 0.0  # the largest relative error of a flight's mass
    gravity_spread: float = 0.0  # the largest error of gravity in each axis, relative to `gravity`
    failure_probability: float = 0.0  # probability of a hidden failure, unless the environment is given another
    failure_size: float = 2.5  # a failure divides the thrust along one lateral axis by this
    failure_vertical: float = 1.5  # and that along z by this
    longest: float = 100.0  # s, the longest flight
    radius: float | None = None  # m, of the planet, which tells how far flat ground holds (None: `ROCK`'s)

    def __post_init__(self):
        refuse_unless_finite("a lander's", self)
        for name in ("mass", "dry_mass", "isp", "least_thrust", "g0", "gravity", "longest"):
            refuse_unless(getattr(self, name) > 0, f"a lander's {name}", getattr(self, name), "must be positive")
        for name in ("mass_spread", "gravity_spread"):
            refuse_unless(0 <= getattr(self, name) < 1, f"a lander's {name}", getattr(self, name), "must be in [0, 1)")
        allowed = f"must be below its mass, {self.mass} kg, with its spread"
        refuse_unless(self.dry_mass < self.mass * (1 - self.mass_spread), "a lander's dry_mass", self.dry_mass, allowed)
        allowed = f"must be at least its least_thrust, {self.least_thrust} N"
        possible = self.greatest_thrust >= self.least_thrust
        refuse_unless(possible, "a lander's greatest_thrust", self.greatest_thrust, allowed)
        weight = self.dry_mass * self.gravity
        allowed = f"must be above the weight of its dry mass, {weight:.0f} N, or it cannot brake"
        refuse_unless(self.greatest_thrust > weight, "a lander's greatest_thrust", self.greatest_thrust, allowed)
        refuse_unless(0 <= self.cant < 90, "a lander's cant", self.cant, "must be from 0 to below 90 degrees")
        check_failure(self.failure_probability, self.failure_size, self.failure_vertical)
        for name in ("start", "spread"):
            values = getattr(self, name)
            six = isinstance(values, tuple | list) and len(values) == 6 and all(map(is_finite, values))
            refuse_unless(six, f"a lander's {name}", values, "must be six finite numbers: r in m, v in m/s")
            object.__setattr__(self, name, tuple(map(float, values)))
        refuse_unless(min(self.spread) >= 0, "a lander's spread", self.spread, "must not be negative")
        low = self.start[2] - self.spread[2]
        refuse_unless(low > 0, "a lander's start", self.start, "must be above the ground (z > 0), with its spread")
        possible = self.radius is None or (is_finite(self.radius) and self.radius > 0)
        refuse_unless(possible, "a lander's radius", self.radius, "must be positive and finite, or None")
        check_flatness(self)

    @property
    def exhaust(self) -> float:
        """The exhaust velocity in m/s: thrust in N for each kg/s of propellant."""
        return self.isp * self.g0 * math.cos(math.radians(self.cant))

    @property
    def failure(self) -> Failure:
        """The failures of this table, from the start of the flights on."""
        sizes = self.failure_size, self.failure_size
        verticals = self.failure_vertical, self.failure_vertical
        return Failure(self.failure_probability, sizes, verticals)

    @property
    def reach(self) -> tuple[float, float]:
        """Bounds of |r| (m) and |v| (m/s), as if thrust and gravity pointed one way for the longest flight."""
        r0 = self.farthest(slice(0, 3))
        v0 = self.farthest(slice(3, 6))
        gravity = self.gravity * (1 + 2 * self.gravity_spread)  # three components, each off by the spread
        gain = self.exhaust * math.log(self.mass * (1 + self.mass_spread) / self.dry_mass)
        v = v0 + gain + gravity * self.longest
        return r0 + v * self.longest, v

    @property
    def height(self) -> float:
        """|r| + v^2 / (2 g) in m of the farthest and fastest start: its energy as a height above the pad."""
        return self.farthest(slice(0, 3)) + self.farthest(slice(3, 6)) ** 2 / (2 * self.gravity)

    @property
    def has_one_flight(self) -> bool:
        """Whether all flights are equal, as long as nothing fails."""
        return not any((*self.spread, self.mass_spread, self.gravity_spread, self.failure_probability))

    def farthest(self, of: slice) -> float:
        """The greatest norm of some components of a start."""
        return float(np.linalg.norm(np.abs(self.start[of]) + np.array(self.spread[of])))


def check_flatness(lander: Lander):
    """Raise BadInput for a start that is too far from the pad or too fast for flat ground.

    Over a round planet gravity at the start points elsewhere by distance / radius, and a horizontal speed v carries
    v^2 / (g radius) of the weight. Flat ground neglects both.
    """
    radius = lander.radius or 3 * lander.gravity / (4 * math.pi * G * ROCK)
    turned = lander.farthest(slice(0, 2)) / radius
    carried = lander.farthest(slice(3, 5)) ** 2 / (lander.gravity * radius)
    planet = f"the ground is flat here, and on a planet with a radius of {radius / 1e3:.4g} km"
    shares = f"distance / radius and v^2 / (gravity radius) are {turned:.2f} + {carried:.2f}"
    allowed = f"must be nearer or slower: {planet} {shares}, above {MOST_NEGLECTED:g}"
    refuse_unless(turned + carried <= MOST_NEGLECTED, "a lander's start", lander.start, allowed)


def check_failure(probability: float, size: float, vertical: float, time: str = "start"):
    """Raise BadInput for a failure that cannot be drawn."""
    in_unit = is_finite(probability) and 0 <= probability <= 1
    refuse_unless(in_unit, "failure_probability", repr(probability), "must be from 0 to 1")
    for name, divisor in (("failure_size", size), ("failure_vertical", vertical)):
        refuse_unless(is_finite(divisor) and divisor >= 1, name, repr(divisor), "must be at least 1")
    refuse_unless(time in FAILURE_TIMES, "failure_time", repr(time), f"must be one of {', '.join(FAILURE_TIMES)}")


class Flights(NamedTuple):
    """What n flights draw. A policy sees only r and v of it."""

    r: np.ndarray  # (3, n) m, at the start
    v: np.ndarray  # (3, n) m/s, at the start
    mass: np.ndarray  # (n,) kg, at the start
    gravity: np.ndarray  # (3, n) m/s^2
    failed: np.ndarray  # (3, n) effectiveness of each axis after the failure; 1 in a healthy flight
    strike: np.ndarray  # (n,) s, when the failure strikes; infinite in a healthy flight

    def one(self, k: int) -> Flights:
        """Flight k alone."""
        return Flights(*(array[..., [k]] for array in self))


# a draw is a row of uniform numbers from 0 to 1
DRAW = ("x", "y", "z", "vx", "vy", "vz", "mass", "gx", "gy", "gz", "failure", "axis", "moment")


def draw_flights(
    lander: Lander, draw: np.ndarray, failure: Failure, start_spread: float = 1.0, edge_starts: bool = False
) -> Flights:
    """The flights of draws (n, 13). `start_spread` widens the box of the starts, but not its heights and sink rates.

    With `edge_starts` more flights begin near the edges of the box. In each direction a start's place is that of a
    swing at a random moment (the arcsine law), where it is else uniform.

    A flight has a failure if the draw's "failure" is below the probability. The failure weakens the thrust along x, if
    "axis" is below 0.5, or along y, and the thrust along z. In the failed flights "failure" / probability is uniform
    from 0 to 1, and so is "axis" in its half, stretched to the whole. They choose the sizes between the least and the
    greatest: "failure" that along z, "axis" the other.
    """
    start = np.array(lander.start)
    spread = np.array(lander.spread)
    centred = 2 * draw - 1
    widths = np.array([start_spread, start_spread, 1.0] * 2)
    place = -np.cos(np.pi * draw[:, :6]) if edge_starts else centred[:, :6]
    state = start + widths * spread * place
    gravity = lander.gravity * lander.gravity_spread * centred[:, 7:10]
    gravity[:, 2] -= lander.gravity
    has_failed = draw[:, 10] < failure.probability
    failed = np.ones((len(draw), 3))
    rows = np.flatnonzero(has_failed)
    axis, lateral = np.divmod(2 * draw[rows, 11], 1)
    vertical = draw[rows, 10] / failure.probability
    failed[rows, np.minimum(axis, 1).astype(int)] = 1 / between(failure.sizes, lateral)
    failed[rows, 2] = 1 / between(failure.verticals, vertical)
    moment = LAST_FAILURE * draw[:, 12] if failure.time == "random" else np.zeros(len(draw))
    strike = np.where(has_failed, moment, np.inf)
    mass = lander.mass * (1 + lander.mass_spread * centred[:, 6])
    return Flights(state[:, :3].T.copy(), state[:, 3:].T.copy(), mass, gravity.T.copy(), failed.T.copy(), strike)


def between(ends: tuple[float, float], share):
    """The numbers (n,) at these shares (n,) of the way from the first end to the second."""
    low, high = ends
    return low + (high - low) * share


MARS = Lander(
    mass=2000.0,
    dry_mass=200.0,
    isp=210.0,
    least_thrust=4000.0,
    greatest_thrust=24000.0,
    start=(1000.0, 0.0, 2350.0, -40.0, 0.0, -80.0),
    spread=(1000.0, 1000.0, 50.0, 30.0, 30.0, 10.0),
    mass_spread=0.05,
    gravity_spread=0.05,
    failure_probability=0.5,
)

CANT = 27.0
POWERED_DESCENT = Lander(  # six engines of 3100 N, throttled between 0.3 and 0.8
    mass=1905.0,
    dry_mass=1505.0,
    isp=225.0,
    g0=9.807,
    cant=CANT,
    least_thrust=0.3 * 6 * 3100.0 * math.cos(math.radians(CANT)),
    greatest_thrust=0.8 * 6 * 3100.0 * math.cos(math.radians(CANT)),
    start=(2000.0, 0.0, 1500.0, 100.0, 0.0, -75.0),
)

LANDERS: dict[str, Lander] = {}  # by environment id; `register_lander` fills it


def register_lander(env_id: str, lander: Lander):
    """Register a lander as an environment id, which `ppo_gtrxl_lander.py`, evaluations and references then take, too.

    Its environment (`environment.py`) is imported when one is made. Raises BadInput if the id is taken or not in
    Gymnasium's form.
    """
    register(env_id, "make_lander")
    LANDERS[env_id] = lander
