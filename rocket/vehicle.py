"""Vehicle, Earth and target orbit of a rocket: the tables, what is aboard when, and which rockets cannot fly.

Reading order: the tables (`Engine`, `Burn`, `Rocket`; `ROCKET` is the paper's), which engines burn and leave together,
the checks. A table of your own goes into `vehicles/`.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from common.errors import is_finite, refuse_unless, refuse_unless_finite

# ---------------------------------------------------------------------------------------------------------------------
# Tables (the paper's table "Vehicle Properties and Simulation Parameters". Where it rounds or has no row, we take the
# constants of the GPOPS-II benchmark from which the paper adapted it)
# ---------------------------------------------------------------------------------------------------------------------


G0 = 9.80665  # m/s^2
ISP_TOLERANCE = 0.02  # the numbers of the paper's second stage contradict one another by 0.0104


@dataclass(frozen=True)
class Engine:
    """One row block of the table: a solid booster or a stage. Raises BadInput for an engine that cannot be.

    Thrust, propellant and burn_time are flown. They give the specific impulse `flown_isp`. With `table_isp` the table's
    `isp` is flown in place of the burn time. A warning says if the two differ by more than 2 %.

    Two engines with equal numbers and names are one type. In dispersed flights they share their draws.
    """

    total_mass: float  # kg
    propellant: float  # kg
    thrust: float  # N
    isp: float  # s
    burn_time: float  # s
    name: str = ""  # tells engines of equal numbers apart

    def __post_init__(self):
        refuse_unless(isinstance(self.name, str), "an engine's name", repr(self.name), "must be a string")
        whose = f"engine {self.name!r}'s" if self.name else "an engine's"
        refuse_unless_finite(whose, self)
        mass = self.total_mass
        refuse_unless(mass > 0, f"{whose} total_mass", mass, "must be positive")
        for name in ("burn_time", "isp"):
            allowed = f"must be positive, also of what only drops off, as a fairing; the engine has {mass:g} kg"
            refuse_unless(getattr(self, name) > 0, f"{whose} {name}", getattr(self, name), allowed)
        allowed = f"must be between 0 and its total_mass, {mass} kg"
        refuse_unless(0 <= self.propellant <= mass, f"{whose} propellant", self.propellant, allowed)
        refuse_unless(self.thrust >= 0, f"{whose} thrust", self.thrust, "must not be negative")
        burns = self.propellant > 0 or self.thrust == 0
        refuse_unless(burns, f"{whose} propellant", self.propellant, "must be positive where it has thrust")
        if self.thrust and abs(self.flown_isp / self.isp - 1) > ISP_TOLERANCE:
            flown = f"its thrust, propellant and burn_time make {self.flown_isp:.4g} s, and these three rule"
            consistent = f"a burn_time of {self.propellant * G0 * self.isp / self.thrust:.6g} s would agree"
            warnings.warn(f"{whose} isp is {self.isp:g} s, but {flown}; {consistent}", stacklevel=3)

    @property
    def flown_isp(self) -> float:
        """Thrust / (g0 flow) in s, with the flow propellant / burn_time; 0 without thrust."""
        if not self.thrust:
            return 0.0
        return self.thrust * self.burn_time / (G0 * self.propellant)

    def flow(self, table_isp: bool) -> float:
        """Propellant flow in kg/s: propellant / burn_time as in the GPOPS-II benchmark, or thrust / (g0 isp)."""
        if table_isp:
            return self.thrust / (G0 * self.isp)
        return self.propellant / self.burn_time


@dataclass(frozen=True)
class Burn:
    """A phase: the engines that burn until `end` and those that are dropped then, as (number, engine).

    `Burn(end, ())` is a coast. Nothing burns in it, and the thrust direction does not count.
    """

    end: float  # s
    engines: tuple[tuple[int, Engine], ...]
    dropped: tuple[tuple[int, Engine], ...] = ()

    def __post_init__(self):
        for name in ("engines", "dropped"):
            parts = getattr(self, name)
            pairs = isinstance(parts, tuple) and all(isinstance(part, tuple) and len(part) == 2 for part in parts)
            pairs = pairs and all(is_finite(n) and isinstance(engine, Engine) for n, engine in parts)
            allowed = "must be a tuple of (number, engine), as in ((1, STAGE_1),)"
            refuse_unless(pairs, f"a burn's {name}", f"{parts!r:.60}", allowed)
        number = isinstance(self.end, int | float | np.number)
        refuse_unless(number, "a burn's end", repr(self.end), "must be a number of seconds")

    @property
    def is_coast(self) -> bool:
        return not self.engines

    @property
    def thrust(self) -> float:
        """N."""
        return sum(n * engine.thrust for n, engine in self.engines)

    def flow(self, table_isp: bool) -> float:
        """kg/s."""
        return sum(n * engine.flow(table_isp) for n, engine in self.engines)


class OrbitalElements(NamedTuple):
    """Keplerian elements, each an array over the states, or one orbit's number."""

    a: np.ndarray | float  # semi-major axis, m (negative on a hyperbola, infinite on a parabola)
    e: np.ndarray | float  # eccentricity
    i: np.ndarray | float  # inclination, rad, 0..pi
    raan: np.ndarray | float  # right ascension of the ascending node, rad, 0..2 pi; 0 on an equatorial orbit
    argp: np.ndarray | float  # argument of perigee, rad, 0..2 pi; 0 on a circular orbit


BOOSTER = Engine(total_mass=19290.0, propellant=17010.0, thrust=628500.0, isp=284.0, burn_time=75.2)
STAGE_1 = Engine(total_mass=104380.0, propellant=95550.0, thrust=1083100.0, isp=301.7, burn_time=261.0)
STAGE_2 = Engine(total_mass=19300.0, propellant=16820.0, thrust=110094.0, isp=462.4, burn_time=700.0)


@dataclass(frozen=True)
class Rocket:
    """A rocket with its planet and target orbit. The defaults are the paper's.

    A vehicle of your own is `Rocket(burns=..., payload=..., ...)`. Raises BadInput that names the field if the rocket
    cannot fly (`check_rocket`).
    """

    burns: tuple[Burn, ...] = (
        Burn(75.2, ((6, BOOSTER), (1, STAGE_1)), dropped=((6, BOOSTER),)),
        Burn(150.4, ((3, BOOSTER), (1, STAGE_1)), dropped=((3, BOOSTER),)),
        Burn(261.0, ((1, STAGE_1),), dropped=((1, STAGE_1),)),
        Burn(961.0, ((1, STAGE_2),)),
    )
    payload: float = 4164.0  # kg
    mu: float = 3.986012e14  # m^3/s^2
    Re: float = 6378145.0  # m
    omega_e: float = 7.29211585e-5  # rad/s
    rho0: float = 1.225  # kg/m^3
    H: float = 7200.0  # m
    Cd: float = 0.5
    S: float = 4 * np.pi  # m^2
    latitude: float = 28.5  # degrees, geocentric by our reading; the longitude is 0 by our choice
    a: float = 24361140.0  # m, target orbit
    e: float = 0.7308
    i: float = 28.5  # degrees
    raan: float = 269.8  # degrees
    argp: float = 130.5  # degrees
    dt: float = 2.0  # s
    end_time: float = 961.0  # s
    table_isp: bool = False

    def __post_init__(self):
        check_rocket(self)

    @property
    def body(self) -> str:
        """The planet's name in figures, by its gravitational parameter."""
        return "Earth" if abs(self.mu / 3.986e14 - 1) < 0.01 else "ground"

    @property
    def ignitions(self) -> list[float]:
        """The times in s at which the burns begin."""
        return [0.0, *(burn.end for burn in self.burns[:-1])]

    @property
    def x0(self) -> np.ndarray:
        """The start (7,): r (m) and v (m/s) in ECI, at rest on the ground, and the mass (kg) of the whole rocket."""
        latitude = np.radians(self.latitude)
        r = self.Re * np.array([np.cos(latitude), 0.0, np.sin(latitude)])
        parts = [*(part for burn in self.burns for part in burn.dropped), *self.burns[-1].engines]
        mass = self.payload + sum(n * engine.total_mass for n, engine in parts)
        return np.array([*r, 0.0, self.omega_e * r[0], 0.0, mass])

    @property
    def dry_mass(self) -> float:
        """The mass in kg of the empty last stage and the payload."""
        return self.payload + empty_mass(self.burns[-1].engines)

    @property
    def target(self) -> OrbitalElements:
        """The target orbit's elements in m and rad."""
        return OrbitalElements(self.a, self.e, *np.radians([self.i, self.raan, self.argp]))

    @property
    def target_energy(self) -> float:
        """Specific energy of the target orbit, -mu / (2 a), in J/kg."""
        return -self.mu / (2 * self.a)

    def arcs(self) -> list[tuple[float, float, float, float, float]]:
        """The times between events, in order: (start s, end s, thrust N, flow kg/s, kg dropped at the end) of each.

        If the last stage runs dry before its phase ends, a last arc without thrust follows.
        """
        arcs, start = [], 0.0
        for burn, dropped in zip(self.burns, self.jettison):
            flow = burn.flow(self.table_isp)
            may_run_dry = burn is self.burns[-1] and self.table_isp and flow  # else the propellant covers the burn
            if may_run_dry:
                dry = start + self.last_propellant / flow
                if dry < burn.end - 1e-6:  # rounding alone is not an event
                    arcs.append((start, dry, burn.thrust, flow, 0.0))
                    start, flow = dry, 0.0
            arcs.append((start, burn.end, burn.thrust if flow else 0.0, flow, dropped))
            start = burn.end
        return arcs

    @property
    def jettison(self) -> list[float]:
        """The kg that leave at the end of each burn: dry mass, and propellant that the dropped engines have not burnt.

        Propellant that other engines of the type burn later stays aboard. With `table_isp` all unburnt propellant stays
        aboard. The paper's table contradicts itself and is flown in this way.
        """
        jettison = [float(empty_mass(burn.dropped)) for burn in self.burns]
        if self.table_isp:
            return jettison
        used = propellant_used(self)
        aboard = engines_aboard(self, 0)
        spare = {engine: n * engine.propellant - used.get(engine, 0.0) for engine, n in aboard.items()}
        for group in engine_groups(self):
            burns_all = group.seconds_lit >= group.seconds_full * (1 - 1e-9)
            if group.dropped_after == len(self.burns) - 1 or burns_all:
                continue
            engine = group.engine
            unburnt = group.number * (engine.propellant - engine.flow(False) * group.seconds_lit)
            leaves = max(min(unburnt, spare[engine]), 0.0)
            jettison[group.dropped_after] += leaves
            spare[engine] -= leaves
        return jettison

    @property
    def last_propellant(self) -> float:
        """The kg of propellant in the last burn's engines when it begins. Each has its own tank."""
        seconds = self.burns[-1].end - self.ignitions[-1]
        return sum(
            group.number * (group.engine.propellant - group.engine.flow(self.table_isp) * (group.seconds_lit - seconds))
            for group in engine_groups(self)
            if group.dropped_after == len(self.burns) - 1
        )


def delta_v(rocket: Rocket) -> float:
    """The velocity in m/s that all burns give without gravity and drag: the sum of T / flow ln(m / (m - burnt))."""
    mass, sum_of_arcs = rocket.x0[-1], 0.0
    for start, end, thrust, flow, dropped in rocket.arcs():
        burnt = flow * (end - start)
        sum_of_arcs += thrust / flow * np.log(mass / (mass - burnt)) if burnt else 0.0
        mass -= burnt + dropped
    return float(sum_of_arcs)


def launch_raan(latitude: float, i: float) -> float:
    """The node's right ascension of the plane with inclination i that holds the launch site at t = 0.

    All angles are in degrees, the result is from 0 to 360. The site's longitude is 0 by our choice. So for a launch
    towards the north RAAN is -arcsin(tan latitude / tan i). A target in another plane costs propellant: at 7.7 km/s
    1 degree costs about 130 m/s times sin i.
    """
    with np.errstate(divide="ignore", invalid="ignore"):  # i = 0, where every node suits a launch from the equator
        ratio = np.nan_to_num(np.tan(np.radians(latitude)) / np.tan(np.radians(i)), nan=0.0)
    return float(np.degrees(-np.arcsin(np.clip(ratio, -1, 1))) % 360)


# ---------------------------------------------------------------------------------------------------------------------
# Which engines are aboard, burn together and leave together. `parts` are (number, engine), as in a `Burn`
# ---------------------------------------------------------------------------------------------------------------------


def empty_mass(parts) -> float:
    """The mass in kg of these engines without propellant."""
    return sum(n * (engine.total_mass - engine.propellant) for n, engine in parts)


def number_of(engine: Engine, parts) -> float:
    """The number of engines in `parts` that equal `engine`."""
    return sum(n for n, other in parts if other == engine)


def propellant_used(rocket: Rocket) -> dict[Engine, float]:
    """The kg of propellant that all engines of each type burn, if none runs dry."""
    used = {}
    for start, burn in zip(rocket.ignitions, rocket.burns):
        for number, engine in burn.engines:
            burnt = number * engine.flow(rocket.table_isp) * (burn.end - start)
            used[engine] = used.get(engine, 0.0) + burnt
    return used


def engines_aboard(rocket: Rocket, k: int) -> dict[Engine, float]:
    """The number of each engine that flies in burn k: those dropped at its end or later, and the last burn's."""
    dropped_later = [part for burn in rocket.burns[k:] for part in burn.dropped]
    aboard = {}
    for number, engine in [*dropped_later, *rocket.burns[-1].engines]:
        aboard[engine] = aboard.get(engine, 0) + number
    return aboard


def engine_types(rocket: Rocket) -> tuple[Engine, ...]:
    """The distinct engines in order of first ignition, then those that are dropped without ever being lit."""
    lit = [engine for burn in rocket.burns for _, engine in burn.engines]
    dropped = [engine for burn in rocket.burns for _, engine in burn.dropped]
    return tuple(dict.fromkeys([*lit, *dropped]))


class EngineGroup(NamedTuple):
    """Engines of one type that are dropped together, or are the last stage's."""

    number: int
    engine: Engine
    type: int  # index in `engine_types`
    dropped_after: int  # the burn at whose end they leave; the last burn for the last stage
    burns: tuple[int, ...]  # the burns in which they are lit, the last first
    seconds_lit: float  # s for which each of them nominally burns
    seconds_full: float  # s for which the nominal propellant of each lasts, infinite without a flow


def engine_groups(rocket: Rocket) -> tuple[EngineGroup, ...]:
    """The groups in the order in which they leave, the last stage's at the end."""
    types, last = engine_types(rocket), len(rocket.burns) - 1
    groups = []
    for k, burn in enumerate(rocket.burns):
        leaving = burn.engines if k == last else burn.dropped
        for number, engine in leaving:
            burns = burns_of_group(rocket, engine, k)
            seconds_lit = sum(rocket.burns[j].end - rocket.ignitions[j] for j in burns)
            flow = engine.flow(rocket.table_isp)
            seconds_full = engine.propellant / flow if flow else np.inf
            groups.append(EngineGroup(number, engine, types.index(engine), k, burns, seconds_lit, seconds_full))
    return tuple(groups)


def burns_of_group(rocket: Rocket, engine: Engine, k: int) -> tuple[int, ...]:
    """The burns in which the engines of a type that leave after burn k are lit, the last first.

    They are counted back to a burn at whose end all burning engines of the type are dropped. Those are another group.
    """
    burns = []
    for j in range(k, -1, -1):
        burning = number_of(engine, rocket.burns[j].engines)
        all_are_dropped = 0 < burning <= number_of(engine, rocket.burns[j].dropped)
        if j < k and all_are_dropped:
            break
        if burning:
            burns.append(j)
    return tuple(burns)


# ---------------------------------------------------------------------------------------------------------------------
# A rocket that cannot fly is refused where it is made
# ---------------------------------------------------------------------------------------------------------------------


def check_rocket(rocket: Rocket):
    """Raise BadInput for a rocket that cannot fly. Warn if its target costs much and this is easily overlooked."""
    for name in ("a", "e", "i", "raan", "argp"):
        allowed = "must be a number: all five elements are given; give a free one a value"
        refuse_unless(getattr(rocket, name) is not None, f"a rocket's {name}", None, allowed)
    refuse_unless_finite("a rocket's", rocket)
    for name in ("mu", "Re", "H", "dt", "a", "end_time"):
        refuse_unless(getattr(rocket, name) > 0, f"a rocket's {name}", getattr(rocket, name), "must be positive")
    for name in ("payload", "rho0", "Cd", "S"):
        refuse_unless(getattr(rocket, name) >= 0, f"a rocket's {name}", getattr(rocket, name), "must not be negative")
    refuse_unless(0 <= rocket.e < 1, "a rocket's e", rocket.e, "must be at least 0 and below 1, a closed orbit")
    perigee, apogee = (rocket.a * (1 + sign * rocket.e) - rocket.Re for sign in (-1, 1))
    orbit = f"{rocket.a} m with e {rocket.e}, {perigee / 1e3:.1f} km by {apogee / 1e3:.1f} km"
    allowed = f"must have its perigee above the ground; a is counted from the centre, {rocket.Re / 1e3:.6g} km below it"
    refuse_unless(perigee > 0, "a rocket's a", orbit, allowed)
    refuse_unless(0 <= rocket.i <= 180, "a rocket's i", rocket.i, "must be between 0 and 180 degrees")
    refuse_unless(-90 < rocket.latitude < 90, "a rocket's latitude", rocket.latitude, "must be between -90 and 90")
    check_burns(rocket)
    last = rocket.burns[-1].end
    allowed = f"must be at most the last burn's end, {last}"
    refuse_unless(rocket.end_time <= last, "a rocket's end_time", rocket.end_time, allowed)
    thrust = rocket.burns[0].thrust
    weight = rocket.x0[6] * rocket.mu / rocket.Re**2
    allowed = f"must be above the weight at lift-off, {weight:.6g} N"
    refuse_unless(thrust > weight, "the thrust of burns[0]", f"{thrust:.6g} N", allowed)
    if min(rocket.i, 180 - rocket.i) < abs(rocket.latitude):
        needs = f"below the launch latitude {rocket.latitude}: the plane can only be reached by a dog-leg"
        warnings.warn(f"a rocket's i is {rocket.i} degrees, {needs}")  # noqa: B028 - one place, so it is said once


def check_burns(rocket: Rocket):
    """Raise BadInput for burns that are out of order, or burn engines or propellant that are not aboard.

    With `table_isp` the last burn may run dry.
    """
    refuse_unless(isinstance(rocket.burns, tuple), "a rocket's burns", rocket.burns, "must be a tuple")
    refuse_unless(rocket.burns, "a rocket's burns", rocket.burns, "must hold at least one burn")
    for k, burn in enumerate(rocket.burns):
        refuse_unless(isinstance(burn, Burn), f"burns[{k}]", f"{burn!r:.60}", "must be a Burn")
    for k, (start, burn) in enumerate(zip(rocket.ignitions, rocket.burns)):
        refuse_unless(
            start < burn.end < np.inf, f"burns[{k}].end", burn.end, f"must be finite and later than {start} s"
        )
        may_coast = 0 < k < len(rocket.burns) - 1
        allowed = "must hold an engine: only a burn between others may be a coast"
        refuse_unless(burn.engines or may_coast, f"burns[{k}].engines", burn.engines, allowed)
        aboard = engines_aboard(rocket, k)
        for number, engine in burn.engines:
            field = f"the number of an engine in burns[{k}].engines"
            has = aboard.get(engine, 0)
            allowed = "must be dropped by this burn or a later one, or burn in the last: it is not aboard"
            refuse_unless(has > 0, f"an engine of burns[{k}]", engine, allowed)
            allowed = f"must be positive and at most {has}: so many are dropped then or later, or are of the last burn"
            refuse_unless(0 < number <= has, field, number, allowed)
        for number, _ in burn.dropped:
            refuse_unless(number > 0, f"the number of an engine in burns[{k}].dropped", number, "must be positive")
    last = rocket.burns[-1].dropped
    allowed = "must be empty: the last burn's engines stay aboard"
    refuse_unless(not last, f"burns[{k}].dropped", f"{last!r:.60}", allowed)
    first = engines_aboard(rocket, 0)
    used = propellant_used(rocket)
    runs_dry = [engine for _, engine in rocket.burns[-1].engines] if rocket.table_isp else []
    for k, burn in enumerate(rocket.burns):
        for _, engine in burn.engines:
            has = first[engine] * engine.propellant
            covered = engine in runs_dry or used[engine] <= has * (1 + 1e-9)
            field = f"the propellant of burns[{k}].engines, {engine.propellant} kg each,"
            refuse_unless(covered, field, f"{has:.6g} kg in all", f"must cover their burns, {used[engine]:.6g} kg")


ROCKET = Rocket()  # the paper's
