"""Rockets without any environment: vehicle, Earth and target orbit, equations of motion, orbits, rewards.

Reading order: the tables (`Engine`, `Burn`, `Rocket`; `ROCKET` is the paper's), what cannot fly, the missions, what
differs from flight to flight (`Dispersion`), the equations of motion (`ascent`), the geometry of orbits, what a policy
is given of a rocket, the five parts of the reward. Functions of a state without memory; nothing is imported but NumPy,
and `ascent`, `orbit_vectors` and `specific_energy` take CasADi symbols, too. `rocket_env.py` flies them: time grid,
events, RK4, cut-off. Every name here is also one of `envs`.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np


class BadInput(ValueError):
    """A value or file that a user gave and nothing can be done with; its message is the one line that is shown."""


def refuse_unless(possible, field: str, value, allowed: str):
    """BadInput with one line that names the field, the value and what is allowed."""
    if not possible:
        raise BadInput(f"{field} is {value}; it {allowed}")


def is_finite(value) -> bool:
    """Whether it is a number, and not infinite."""
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value))


def refuse_unless_finite(whose: str, table):
    """BadInput for the first number of a dataclass that is not one, or is infinite."""
    for field in fields(table):
        value = getattr(table, field.name)
        if field.type == "float":
            refuse_unless(is_finite(value), f"{whose} {field.name}", value, "must be a finite number")


# ---------------------------------------------------------------------------------------------------------------------
# Vehicle, Earth and target (the paper's table "Vehicle Properties and Simulation Parameters", and where it rounds or
# has no row the constants of the GPOPS-II benchmark that it is adapted from)
# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Engine:
    """One row block of the table: a solid booster or a stage."""

    total_mass: float  # kg
    propellant: float  # kg
    thrust: float  # N
    isp: float  # s, the table's, flown with table_isp alone: the other four contradict it
    burn_time: float  # s

    def __post_init__(self):
        refuse_unless_finite("an engine's", self)
        for name in ("total_mass", "burn_time", "isp"):
            refuse_unless(getattr(self, name) > 0, f"an engine's {name}", getattr(self, name), "must be positive")
        allowed = f"must be between 0 and its total_mass, {self.total_mass} kg"
        refuse_unless(0 <= self.propellant <= self.total_mass, "an engine's propellant", self.propellant, allowed)
        refuse_unless(self.thrust >= 0, "an engine's thrust", self.thrust, "must not be negative")
        burns = self.propellant > 0 or self.thrust == 0
        refuse_unless(burns, "an engine's propellant", self.propellant, "must be positive where it has thrust")

    def flow(self, table_isp: bool) -> float:
        """Propellant flow in kg/s: propellant / burn time (the GPOPS-II benchmark's), or T / (g0 Isp) of the table."""
        return self.thrust / (G0 * self.isp) if table_isp else self.propellant / self.burn_time


@dataclass(frozen=True)
class Burn:
    """A phase: the engines that burn until `end` and those that are dropped then, as (number, engine)."""

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


G0 = 9.80665  # m/s^2
BOOSTER = Engine(total_mass=19290.0, propellant=17010.0, thrust=628500.0, isp=284.0, burn_time=75.2)
STAGE_1 = Engine(total_mass=104380.0, propellant=95550.0, thrust=1083100.0, isp=301.7, burn_time=261.0)
STAGE_2 = Engine(total_mass=19300.0, propellant=16820.0, thrust=110094.0, isp=462.4, burn_time=700.0)


@dataclass(frozen=True)
class Rocket:
    """The paper's rocket, Earth and target by default; a vehicle of your own is `Rocket(burns=..., payload=..., ...)`.

    Raises BadInput, which names the field, where it cannot fly: see `check_rocket`.
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
    latitude: float = 28.5  # degrees, by our reading geocentric; the longitude is 0 (ours)
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
    def last_ignition(self) -> float:
        """s: when the last burn begins."""
        return self.burns[-2].end if len(self.burns) > 1 else 0.0

    @property
    def x0(self) -> np.ndarray:
        """The start (7,): r (m) and v (m/s) in ECI, at rest on the ground, and the mass (kg) of all that is dropped, of
        the last stage and of the payload."""
        latitude = np.radians(self.latitude)
        r = self.Re * np.array([np.cos(latitude), 0.0, np.sin(latitude)])
        parts = [*(part for burn in self.burns for part in burn.dropped), *self.burns[-1].engines]
        mass = self.payload + sum(n * engine.total_mass for n, engine in parts)
        return np.array([*r, 0.0, self.omega_e * r[0], 0.0, mass])

    @property
    def dry_mass(self) -> float:
        """kg: what is left when the last stage has burnt all its propellant, the payload included."""
        last_stage = self.burns[-1].engines
        return self.payload + sum(n * (engine.total_mass - engine.propellant) for n, engine in last_stage)

    @property
    def target(self) -> OrbitalElements:
        """The target orbit's elements in m and rad."""
        return OrbitalElements(self.a, self.e, *np.radians([self.i, self.raan, self.argp]))

    @property
    def target_energy(self) -> float:
        """Specific energy of the target orbit, -mu / (2 a), in J/kg."""
        return -self.mu / (2 * self.a)

    def arcs(self) -> list[tuple[float, float, float, float, float]]:
        """What is constant between events: (start s, end s, thrust N, flow kg/s, kg dropped at the end), in order.

        A last stage that runs dry before its phase ends gives an arc of its own without thrust.
        """
        arcs, start = [], 0.0
        for burn, dropped in zip(self.burns, self.jettison):
            flow = burn.flow(self.table_isp)
            if burn is self.burns[-1] and self.table_isp and flow:  # without it the propellant covers all burns
                dry = start + self.last_propellant / flow
                if dry < burn.end - 1e-6:  # rounding alone is not an event
                    arcs.append((start, dry, burn.thrust, flow, 0.0))
                    start, flow = dry, 0.0
            arcs.append((start, burn.end, burn.thrust if flow else 0.0, flow, dropped))
            start = burn.end
        return arcs

    @property
    def jettison(self) -> list[float]:
        """kg that leave at the end of each burn: dry mass, and the propellant that the dropped engines have not burnt.

        What others of their type burn later stays on board. With `table_isp` all of it does: so the paper's table,
        which contradicts itself, is flown.
        """
        dry = lambda parts: sum(n * (engine.total_mass - engine.propellant) for n, engine in parts)  # noqa: E731
        dropped, used = [float(dry(burn.dropped)) for burn in self.burns], propellant_used(self)
        left = {engine: n * engine.propellant - used.get(engine, 0.0) for engine, n in engines_aboard(self, 0).items()}
        for number, engine, _, k, _, part, full in engine_groups(self):
            if k < len(self.burns) - 1 and part < full * (1 - 1e-9) and not self.table_isp:
                leaves = max(min(number * (engine.propellant - engine.flow(False) * part), left[engine]), 0.0)
                dropped[k] += leaves
                left[engine] -= leaves
        return dropped

    @property
    def last_propellant(self) -> float:
        """kg in the last burn's engines when it begins, each with its own tank: all, less what they burnt before."""
        seconds = self.burns[-1].end - self.last_ignition
        groups = [group for group in engine_groups(self) if group.dropped == len(self.burns) - 1]
        return sum(
            group.number * (group.engine.propellant - group.engine.flow(self.table_isp) * (group.part - seconds))
            for group in groups
        )


# ---------------------------------------------------------------------------------------------------------------------
# What cannot fly is refused where it is made
# ---------------------------------------------------------------------------------------------------------------------


def check_rocket(rocket: Rocket):
    """BadInput where a rocket cannot be; a warning where it can, at a price that is easily overlooked."""
    refuse_unless_finite("a rocket's", rocket)
    for name in ("mu", "Re", "H", "dt", "a", "end_time"):
        refuse_unless(getattr(rocket, name) > 0, f"a rocket's {name}", getattr(rocket, name), "must be positive")
    for name in ("payload", "rho0", "Cd", "S"):
        refuse_unless(getattr(rocket, name) >= 0, f"a rocket's {name}", getattr(rocket, name), "must not be negative")
    allowed = f"must be above half of Re, {rocket.Re / 2:.6g} m: with less energy it lies on the ground"
    refuse_unless(rocket.a > rocket.Re / 2, "a rocket's a", f"{rocket.a} m", allowed)
    refuse_unless(0 <= rocket.e < 1, "a rocket's e", rocket.e, "must be at least 0 and below 1, a closed orbit")
    refuse_unless(0 <= rocket.i <= 180, "a rocket's i", rocket.i, "must be between 0 and 180 degrees")
    refuse_unless(-90 < rocket.latitude < 90, "a rocket's latitude", rocket.latitude, "must be between -90 and 90")
    check_burns(rocket)
    last = rocket.burns[-1].end
    allowed = f"must be at most the last burn's end, {last}"
    refuse_unless(rocket.end_time <= last, "a rocket's end_time", rocket.end_time, allowed)
    thrust, weight = rocket.burns[0].thrust, rocket.x0[6] * rocket.mu / rocket.Re**2
    allowed = f"must be above the weight at lift-off, {weight:.6g} N"
    refuse_unless(thrust > weight, "the thrust of burns[0]", f"{thrust:.6g} N", allowed)
    if min(rocket.i, 180 - rocket.i) < abs(rocket.latitude):
        needs = f"below the launch latitude {rocket.latitude}: the plane can only be reached by a dog-leg"
        warnings.warn(f"a rocket's i is {rocket.i} degrees, {needs}")  # noqa: B028 - from one place: it is said once


def check_burns(rocket: Rocket):
    """BadInput where the burns are not in order, burn what is not aboard, or longer than their propellant lasts."""
    refuse_unless(isinstance(rocket.burns, tuple), "a rocket's burns", rocket.burns, "must be a tuple")
    refuse_unless(rocket.burns, "a rocket's burns", rocket.burns, "must hold at least one burn")
    start = 0.0
    for k, burn in enumerate(rocket.burns):
        refuse_unless(isinstance(burn, Burn), f"burns[{k}]", f"{burn!r:.60}", "must be a Burn")
    for k, burn in enumerate(rocket.burns):
        refuse_unless(
            start < burn.end < np.inf, f"burns[{k}].end", burn.end, f"must be finite and later than {start} s"
        )
        refuse_unless(burn.engines, f"burns[{k}].engines", burn.engines, "must hold an engine")
        aboard = engines_aboard(rocket, k)
        for number, engine in burn.engines:
            field, has = f"the number of an engine in burns[{k}].engines", aboard.get(engine, 0)
            allowed = "must be dropped by this burn or a later one, or burn in the last: it is not aboard"
            refuse_unless(has > 0, f"an engine of burns[{k}]", engine, allowed)
            allowed = f"must be positive and at most {has}: so many are dropped then or later, or are of the last burn"
            refuse_unless(0 < number <= has, field, number, allowed)
        for number, _ in burn.dropped:
            refuse_unless(number > 0, f"the number of an engine in burns[{k}].dropped", number, "must be positive")
        start = burn.end
    last, allowed = rocket.burns[-1].dropped, "must be empty: the last burn's engines stay aboard"
    refuse_unless(not last, f"burns[{k}].dropped", f"{last!r:.60}", allowed)
    first, used = engines_aboard(rocket, 0), propellant_used(rocket)
    runs_dry = [engine for _, engine in rocket.burns[-1].engines] if rocket.table_isp else []
    for k, burn in enumerate(rocket.burns):
        for _, engine in burn.engines:
            has = first[engine] * engine.propellant
            covered = engine in runs_dry or used[engine] <= has * (1 + 1e-9)
            field = f"the propellant of burns[{k}].engines, {engine.propellant} kg each,"
            refuse_unless(covered, field, f"{has:.6g} kg in all", f"must cover their burns, {used[engine]:.6g} kg")


def propellant_used(rocket: Rocket) -> dict:
    """kg of propellant that all engines of each type burn, if none runs dry."""
    start, used = 0.0, {}
    for burn in rocket.burns:
        for number, engine in burn.engines:
            used[engine] = used.get(engine, 0.0) + number * engine.flow(rocket.table_isp) * (burn.end - start)
        start = burn.end
    return used


def engines_aboard(rocket: Rocket, k: int) -> dict:
    """How many of each engine fly in burn k: those dropped at its end or later, and the last burn's."""
    aboard = {}
    for number, engine in [*(part for burn in rocket.burns[k:] for part in burn.dropped), *rocket.burns[-1].engines]:
        aboard[engine] = aboard.get(engine, 0) + number
    return aboard


# ---------------------------------------------------------------------------------------------------------------------
# Missions: a vehicle and the rules that it flies by. `ROCKETS` is what environments, references, evaluation, figures
# and the script read; `envs.register_rocket` adds to it
# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mission:
    """A registered rocket."""

    rocket: Rocket
    cutoff: bool = False  # the engine stops at the target's energy; without it at end_time
    ceiling_km: float | None = None  # altitude beyond which an overshoot is penalised, and the reference's bound
    floor_km: float = 110.0  # altitude below which a flight is penalised late in its ascent
    late: float = 300.0  # s after which it is late
    guided_until: float | None = None  # s until which R_guidance has a reference pitch (none: the first burn's end)
    mass_unit: float | None = None  # kg of propellant that `mass_weight` is the price of (none: 6 % of the dry mass)

    def __post_init__(self):
        for name in ("ceiling_km", "floor_km", "late", "guided_until", "mass_unit"):
            value = getattr(self, name)
            number, optional = is_finite(value), name not in ("floor_km", "late")
            allowed = "must be positive and finite, or None" if optional else "must be a finite number"
            possible = value is None or (number and value > 0) if optional else number
            refuse_unless(possible, f"a mission's {name}", value, allowed)

    @property
    def ceiling(self) -> float:
        """m; infinite where there is none."""
        return np.inf if self.ceiling_km is None else 1e3 * self.ceiling_km


ROCKET = Rocket()
# the paper penalises an overshoot beyond 250 km; until 150.4 s the boosters burn; at the fixed time speed has to be
# wasted, and too flat a climb wastes it as well: with a floor of 110 km two of three seeds flew along it
PAPER_MISSION = Mission(ROCKET, ceiling_km=250.0, floor_km=130.0, guided_until=ROCKET.burns[1].end, mass_unit=100.0)
ROCKETS: dict[str, Mission] = {}  # by environment id


def delta_v(rocket: Rocket) -> float:
    """m/s that all burns together give a rocket without gravity and drag: the sum of T / flow ln(m / (m - burnt))."""
    mass, sum_of_arcs = rocket.x0[-1], 0.0
    for start, end, thrust, flow, dropped in rocket.arcs():
        burnt = flow * (end - start)
        sum_of_arcs += thrust / flow * np.log(mass / (mass - burnt)) if burnt else 0.0
        mass -= burnt + dropped
    return float(sum_of_arcs)


def launch_raan(latitude: float, i: float) -> float:
    """The node's right ascension (degrees, 0 to 360) of the plane of inclination i that holds the launch site at t = 0.

    The site's longitude is 0 (ours), so that RAAN = -arcsin(tan latitude / tan i), for a launch towards the north. A
    target in another plane costs propellant: 1 degree at 7.7 km/s about 130 m/s times sin i.
    """
    with np.errstate(divide="ignore", invalid="ignore"):  # i = 0; from the equator every node will do
        ratio = np.nan_to_num(np.tan(np.radians(latitude)) / np.tan(np.radians(i)), nan=0.0)
    return float(np.degrees(-np.arcsin(np.clip(ratio, -1, 1))) % 360)


# ---------------------------------------------------------------------------------------------------------------------
# What differs from flight to flight: a draw is a vector of standard scores, in the order of `draw_names`
# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Dispersion:
    """Standard deviations of a flight's differences from the table: relative ones, kg and m/s.

    The studies named are quoted from memory and were not looked up again; "ours" is nobody else's number. A public
    Monte-Carlo study of launch guidance has thrust 1 %, Isp 0.3 %, propellant and dry mass 0.5 %, density 5 %; one of
    the Saturn V with 10 000 trials Isp 0.3 %, thrust 0.4 %.
    """

    burn_rate: float = 0.005  # thrust and flow together: between the studies' 0.4 % and 1 %
    isp: float = 0.003  # thrust at a given flow: both studies'
    propellant: float = 0.003  # load: ours, below the study's 0.5 %, for the burn rate moves the burn-out, too
    dry_mass: float = 0.005  # the study's
    payload: float = 20.0  # kg: ours, the study's 0.5 % of the paper's payload
    drag: float = 0.14  # density times Cd: the study's 5 % of density and, ours, 13 % of Cd
    wind: float = 20.0  # m/s at its altitude, east and north each: ours, the jet stream from day to day


DISPERSION = Dispersion()
OF_ENGINES = ("burn_rate", "isp", "propellant", "dry_mass")  # one score each for every type of engine
OF_FLIGHT = ("payload", "drag", "wind_east", "wind_north")
LARGEST_SCORE = 3.0  # drawn scores are clipped there
LARGEST_CHANGE = 0.9  # part of its nominal value by which a drawn factor or payload may differ: nothing vanishes
LARGEST_DISPERSION = 100.0
WIND_ALTITUDE, WIND_DEPTH = 12e3, 5e3  # m, of the profile exp(-((h - altitude) / depth)^2): ours


class Vehicles(NamedTuple):
    """N vehicles as they were drawn, arcs as in `Rocket.arcs` (A of them): what is constant between events."""

    mass: np.ndarray  # (N,) kg at lift-off
    dry_mass: np.ndarray  # (N,) kg, as `Rocket.dry_mass`
    propellant: np.ndarray  # (N,) kg in the last stage
    end: np.ndarray  # (A, N) s, the last infinite; the first ones are the ends of all burns but the last
    thrust: np.ndarray  # (A, N) N
    flow: np.ndarray  # (A, N) kg/s
    dropped: np.ndarray  # (A, N) kg at the arc's end
    burn_out: np.ndarray  # (N,) s: when the last stage has burnt what the nominal one burns, or runs dry
    wind: np.ndarray  # (2, N) m/s, towards east and north where the profile is 1
    drag: np.ndarray  # (N,) factor on the drag


class Group(NamedTuple):
    """Engines of one type that are dropped together, or are the last stage's."""

    number: int
    engine: Engine
    type: int  # index in `engine_types`
    dropped: int  # the burn at whose end
    lit: tuple[int, ...]  # the burns in which they burn
    part: float  # s that each of them nominally burns
    full: float  # s for which its nominal propellant lasts, infinite without a flow


def engine_types(rocket: Rocket) -> tuple[Engine, ...]:
    """The distinct engines in order of first ignition; behind them what is dropped without ever being lit."""
    lit = [engine for burn in rocket.burns for _, engine in burn.engines]
    return tuple(dict.fromkeys([*lit, *(engine for burn in rocket.burns for _, engine in burn.dropped)]))


def draw_names(rocket: Rocket) -> tuple[str, ...]:
    """What the k scores of a draw are of; types of engines are counted from 1."""
    types = range(1, len(engine_types(rocket)) + 1)
    return (*(f"{name}_{j}" for name in OF_ENGINES for j in types), *OF_FLIGHT)


DRAW = draw_names(ROCKET)


def draw_sigmas(rocket: Rocket) -> np.ndarray:
    """(k,): the entry of `DISPERSION` for each score."""
    table = {**vars(DISPERSION), "wind_east": DISPERSION.wind, "wind_north": DISPERSION.wind}
    return np.array([table[name if name in table else name.rpartition("_")[0]] for name in draw_names(rocket)])


def draw_bounds(rocket: Rocket, dispersion: float) -> np.ndarray:
    """(k,): the largest score that is drawn: 3, less where a factor or the payload would change by more than 90 %."""
    nominal = np.ones(len(draw_names(rocket)))
    nominal[-4:] = rocket.payload, 1.0, np.inf, np.inf
    sigmas = dispersion * draw_sigmas(rocket)
    bounds = np.full(len(nominal), LARGEST_SCORE)
    return np.minimum(bounds, np.divide(LARGEST_CHANGE * nominal, sigmas, out=bounds.copy(), where=sigmas > 0))


def largest_draw(rocket: Rocket, dispersion: float) -> np.ndarray:
    """(1, k): the draw of the vehicle that burns longest and is heaviest."""
    types = len(engine_types(rocket))
    signs = np.zeros(len(draw_names(rocket)))
    signs[:types], signs[2 * types : 4 * types + 1] = -1.0, 1.0
    return (signs * draw_bounds(rocket, dispersion))[None]


def engine_groups(rocket: Rocket) -> tuple[Group, ...]:
    """The groups in the order in which they leave, the last stage's at the end.

    A group is lit in the burns of its engine back to where no more of them burn than are dropped: what burnt before
    was another group.
    """
    starts = [0.0, *(burn.end for burn in rocket.burns)]
    count = lambda parts, engine: sum(n for n, other in parts if other == engine)  # noqa: E731
    groups, last, types = [], len(rocket.burns) - 1, engine_types(rocket)
    for k, burn in enumerate(rocket.burns):
        for number, engine in burn.engines if k == last else burn.dropped:
            lit = []
            for j in range(k, -1, -1):
                burning = count(rocket.burns[j].engines, engine)
                if j < k and 0 < burning <= count(rocket.burns[j].dropped, engine):
                    break
                lit += [j] if burning else []
            flow, part = engine.flow(rocket.table_isp), sum(rocket.burns[j].end - starts[j] for j in lit)
            full = engine.propellant / flow if flow else np.inf
            groups.append(Group(number, engine, types.index(engine), k, tuple(lit), part, full))
    return tuple(groups)


def draw_values(rocket: Rocket, dispersion: float, draw: np.ndarray):
    """Factors (4, types, N) in the order of `OF_ENGINES`, payload (N,) kg, factor on the drag (N,), wind (2, N) m/s.

    draw: scores (N, k). Raises BadInput for the first that no vehicle can have.
    """
    types = len(engine_types(rocket))
    change = dispersion * draw_sigmas(rocket)[:, None] * draw.T
    value = change + 1.0
    value[-4], value[-2:] = change[-4] + rocket.payload, change[-2:]
    possible = value > 0
    possible[-4], possible[-2:] = value[-4] >= 0, True
    if not possible.all():
        k, n = np.argwhere(~possible)[0]
        allowed = f"must be larger: with dispersion {dispersion} it makes of the nominal value {value[k, n]:.6g}"
        refuse_unless(False, f"{draw_names(rocket)[k]} of draw {n}", draw[n, k], allowed)
    return value[: 4 * types].reshape(4, types, -1), value[-4], value[-3], value[-2:]


def draw_vehicles(rocket: Rocket, dispersion: float, draw: np.ndarray) -> Vehicles:
    """The vehicles of N draws (N, k): each value is the nominal one changed by dispersion times sigma times score.

    Arcs are the burns, and a last one without thrust. What is loaded is burnt or dropped, also what an engine keeps
    that uses a part of its propellant. Raises BadInput for a draw that no vehicle can have.
    """
    (rate, isp, load, dry), payload, drag, wind = draw_values(rocket, dispersion, np.asarray(draw, dtype=np.float64))
    of = {engine: j for j, engine in enumerate(engine_types(rocket))}.get
    empty = lambda parts: sum(n * (e.total_mass - e.propellant) * dry[of(e)] for n, e in parts)  # noqa: E731
    full = lambda parts: sum(n * e.propellant * load[of(e)] for n, e in parts)  # noqa: E731
    last = rocket.burns[-1].engines
    parts = [*(part for burn in rocket.burns for part in burn.dropped), *last]
    end, burn_out, seconds = burn_ends(rocket, load / rate)
    none, dropped = np.zeros_like(payload), np.zeros_like(end)
    for group, lit in zip(engine_groups(rocket), seconds):
        if group.dropped < len(rocket.burns) - 1:
            burnt = group.engine.flow(rocket.table_isp) * rate[group.type] * lit
            residual = np.maximum(group.engine.propellant * load[group.type] - burnt, 0.0)
            dropped[group.dropped] += empty([(group.number, group.engine)]) + group.number * residual
    thrust, flow = [], []
    for burn in rocket.burns:
        thrust.append(sum(n * e.thrust * rate[of(e)] * isp[of(e)] for n, e in burn.engines))
        flow.append(sum(n * e.flow(rocket.table_isp) * rate[of(e)] for n, e in burn.engines))
    coast = (np.vstack([end, none + np.inf]), np.array([*thrust, none]), np.array([*flow, none]))
    mass = payload + empty(parts) + full(parts)
    dry_mass, propellant = payload + empty(last), none + full(last)
    return Vehicles(mass, dry_mass, propellant, *coast, np.vstack([dropped, none]), burn_out, wind, drag)


def burn_ends(rocket: Rocket, lasting: np.ndarray):
    """Ends of the burns (B, N) s, the last one's when it runs dry; `burn_out` (N,) s; seconds lit of the groups (G, N).

    lasting (types, N): how long an engine's propellant lasts, as a part of the nominal time. A burn that drops burning
    engines ends when the first of them has burnt as large a part of its propellant as nominally, any other at its
    nominal time, and none goes on without an engine's propellant.
    """
    groups, last = engine_groups(rocket), len(rocket.burns) - 1
    start, lit = np.zeros(lasting.shape[1]), np.zeros((len(groups), lasting.shape[1]))
    ends = []
    for k, burn in enumerate(rocket.burns):
        limit = due = np.full(len(start), np.inf)
        for group, spent in zip(groups, lit):
            if k in group.lit and group.full < np.inf:
                limit = np.minimum(limit, group.full * lasting[group.type] - spent)
                if k == group.dropped:
                    due = np.minimum(due, group.part * lasting[group.type] - spent)
        due = np.where(np.isfinite(due), due, burn.end - start)
        first = np.maximum(np.minimum(due, limit), 0.0)
        ends.append(start + (np.maximum(limit, 0.0) if k == last else first))
        burn_out, before = start + first, start
        start = ends[-1]
        for group, spent in zip(groups, lit):
            if k in group.lit:
                spent += start - before
    return np.array(ends), burn_out, lit


def nominal_vehicles(rocket: Rocket, number: int) -> Vehicles:
    """`number` vehicles just as the table has them; what a stage has not burnt (`table_isp`) stays on board."""
    _, end, thrust, flow, dropped = np.array(rocket.arcs()).T
    numbers = [rocket.x0[6], rocket.dry_mass, sum(n * engine.propellant for n, engine in rocket.burns[-1].engines)]
    columns = [*numbers, np.append(end[:-1], np.inf), thrust, flow, dropped, rocket.burns[-1].end, np.zeros(2), 1.0]
    return Vehicles(*(np.repeat(np.asarray(column)[..., None], number, axis=-1) for column in columns))


def check_drawable(rocket: Rocket):
    """BadInput where no flights can be drawn of a rocket: with all scores 0 it has to be the nominal one.

    Drawn engines burn each from a tank of its own, and those that are dropped together burn together.
    """
    drawn = draw_vehicles(rocket, 1.0, np.zeros((1, len(draw_names(rocket)))))
    last = len(rocket.burns) - 1
    for k, (burn, dropped) in enumerate(zip(rocket.burns, rocket.jettison)):
        ends, leaves = drawn.end[k, 0], drawn.dropped[k, 0]
        same = np.isclose(burn.end, ends) or (k == last and (ends > burn.end or rocket.table_isp))
        allowed = f"cannot be drawn: its engines, each from its own tank, burn until {ends:.6g} s"
        refuse_unless(same, f"burns[{k}].end", burn.end, allowed)
        same = np.isclose(dropped, leaves) or rocket.table_isp  # a drawn flight drops what has not burnt
        allowed = f"cannot be drawn: with what has not burnt then it is {leaves:.6g} kg"
        refuse_unless(same, f"what burns[{k}] drops", f"{dropped:.6g} kg", allowed)


# ---------------------------------------------------------------------------------------------------------------------
# Equations of motion: x is a tuple of components, each a NumPy array over environments or a CasADi symbol
# ---------------------------------------------------------------------------------------------------------------------


def ascent(x, u, rocket: Rocket = ROCKET, wind=None, drag_factor=None):
    """r' = v, v' = -mu r / |r|^3 + T u / m + D / m, m' = -flow ("Multiphase Rocket Ascent Problem").

    D = -1/2 rho Cd S |v_rel| v_rel, rho = rho0 exp(-h / H), v_rel = v - omega_e x r. x: r, v, m by components; u: the
    unit thrust direction by components, thrust T (N) and propellant flow (kg/s). The paper's drag acts "during
    atmospheric phases", this one always: it fades with the density.

    A wind (east, north; m/s where its profile over the altitude is 1) is taken from v_rel, a factor multiplies D.
    """
    rx, ry, rz, vx, vy, vz, m = x
    ux, uy, uz, thrust, flow = u
    r2 = rx * rx + ry * ry + rz * rz
    r = r2**0.5
    gravity, push = -rocket.mu / (r2 * r), thrust / m
    wx, wy, wz = vx + rocket.omega_e * ry, vy - rocket.omega_e * rx, vz  # v_rel
    if wind is not None:
        blow_x, blow_y, blow_z = wind_velocity((rx, ry, rz, r), wind, rocket)
        wx, wy, wz = wx - blow_x, wy - blow_y, wz - blow_z
    rho = rocket.rho0 * np.exp((rocket.Re - r) / rocket.H)
    if drag_factor is not None:
        rho = drag_factor * rho
    drag = (-0.5 * rocket.Cd * rocket.S) * rho * (wx * wx + wy * wy + wz * wz) ** 0.5 / m
    ax = gravity * rx + push * ux + drag * wx
    ay = gravity * ry + push * uy + drag * wy
    az = gravity * rz + push * uz + drag * wz
    return vx, vy, vz, ax, ay, az, -flow


def wind_velocity(place, wind, rocket: Rocket = ROCKET):
    """The wind in ECI, m/s by components, at (rx, ry, rz, |r|) in m; wind: (east, north) where the profile is 1."""
    rx, ry, rz, r = place
    profile = np.exp(-(((r - (rocket.Re + WIND_ALTITUDE)) / WIND_DEPTH) ** 2))
    axis = (rx * rx + ry * ry) ** 0.5 + 1e-9  # m from the Earth's axis; over a pole nothing is east, nor NaN
    east, north = profile * wind[0] / axis, profile * wind[1] / r
    south = north * rz / axis
    return -east * ry - south * rx, east * rx - south * ry, north * axis


# ---------------------------------------------------------------------------------------------------------------------
# Orbits: what a state's is, how far it is from the target's, and the frame in which a pilot steers
# ---------------------------------------------------------------------------------------------------------------------


def orbit_vectors(x, mu: float = ROCKET.mu):
    """Angular momentum h = r x v and eccentricity vector e = v x h / mu - r / |r|, each a tuple of components."""
    rx, ry, rz, vx, vy, vz = x[:6]
    hx, hy, hz = ry * vz - rz * vy, rz * vx - rx * vz, rx * vy - ry * vx
    r = (rx * rx + ry * ry + rz * rz) ** 0.5
    ex, ey, ez = (vy * hz - vz * hy) / mu - rx / r, (vz * hx - vx * hz) / mu - ry / r, (vx * hy - vy * hx) / mu - rz / r
    return (hx, hy, hz), (ex, ey, ez)


def specific_energy(x, mu: float = ROCKET.mu):
    """|v|^2 / 2 - mu / |r|, in J/kg, of a state by components."""
    rx, ry, rz, vx, vy, vz = x[:6]
    return (vx * vx + vy * vy + vz * vz) / 2 - mu / (rx * rx + ry * ry + rz * rz) ** 0.5


def orbital_elements(state, mu: float = ROCKET.mu) -> OrbitalElements:
    """Keplerian elements of states (..., 6 or more: r in m, v in m/s), each (...,); e.g. Vallado, algorithm 9 (RV2COE).

    Where an angle has no meaning it is 0: the node of an equatorial orbit (the perigee is then counted from the x axis,
    in the direction of flight), the perigee of a circular one. |r| must be positive.
    """
    x = np.moveaxis(np.asarray(state, dtype=np.float64), -1, 0)
    h, e = (np.array(vector) for vector in orbit_vectors(x, mu))
    energy = specific_energy(x, mu)
    a = np.divide(-mu, 2 * energy, out=np.full(energy.shape, np.inf), where=energy != 0)
    equatorial, eccentricity = (h[0] == 0) & (h[1] == 0), np.sqrt((e * e).sum(axis=0))
    node = np.where(equatorial, 1.0, -h[1]), np.where(equatorial, 0.0, h[0])  # z x h, of any length
    i = np.arctan2(np.hypot(h[0], h[1]), h[2])
    along = node[0] * e[0] + node[1] * e[1]
    # e . (h x node), in units of |h|: the component of e a right angle ahead of the node
    ahead = e[0] * -h[2] * node[1] + e[1] * h[2] * node[0] + e[2] * (h[0] * node[1] - h[1] * node[0])
    argp = np.arctan2(ahead, along * np.sqrt((h * h).sum(axis=0)))
    circular = eccentricity < 1e-14
    raan, argp = np.arctan2(node[1], node[0]) % (2 * np.pi), np.where(circular, 0.0, argp % (2 * np.pi))
    return OrbitalElements(a, eccentricity, i, raan, argp)


def target_orbit(elements: OrbitalElements = ROCKET.target, mu: float = ROCKET.mu):
    """Angular momentum (..., 3), m^2/s, and eccentricity vector (..., 3) of orbits given by their elements (m, rad)."""
    a, e, i, raan, argp = (np.asarray(element, dtype=np.float64) for element in elements)
    normal = np.stack([np.sin(raan) * np.sin(i), -np.cos(raan) * np.sin(i), np.cos(i)], axis=-1)
    perigee = [
        np.cos(raan) * np.cos(argp) - np.sin(raan) * np.sin(argp) * np.cos(i),
        np.sin(raan) * np.cos(argp) + np.cos(raan) * np.sin(argp) * np.cos(i),
        np.sin(argp) * np.sin(i),
    ]
    return np.sqrt(mu * a * (1 - e * e))[..., None] * normal, e[..., None] * np.stack(perigee, axis=-1)


def target_axes(rocket: Rocket = ROCKET) -> np.ndarray:
    """Rows: perigee direction, semi-latus direction, plane normal of the target orbit, (3, 3), unit vectors in ECI.

    A circle has no perigee: its axes are those of an ellipse with the same angles.
    """
    h, e = target_orbit(rocket.target._replace(e=rocket.e or 0.5), rocket.mu)
    normal, perigee = h / np.linalg.norm(h), e / np.linalg.norm(e)
    return np.array([perigee, np.cross(normal, perigee), normal])


def terminal_error(state, rocket: Rocket = ROCKET) -> np.ndarray:
    """(h - h_T) / |h_T| and e - e_T in ECI, (..., 6), of states (..., 6 or more: r in m, v in m/s).

    Our measure. Smooth, without a singularity, and zero exactly where all five elements are the target's.
    """
    h, e = orbit_vectors(np.moveaxis(np.asarray(state, dtype=np.float64), -1, 0), rocket.mu)
    h_target, e_target = target_orbit(rocket.target, rocket.mu)
    return np.concatenate(
        [(np.stack(h, axis=-1) - h_target) / np.linalg.norm(h_target), np.stack(e, axis=-1) - e_target], axis=-1
    )


def local_frame(y, normal):
    """Unit vectors up, along-track (normal x up), cross-track (up x along) at states y (7, N): (3, N) each.

    Written out: a matrix product would round a row differently in a larger batch.
    """
    up = y[:3] / np.sqrt((y[:3] ** 2).sum(axis=0))
    (rx, ry, rz), (nx, ny, nz) = up, normal
    along = np.array([ny * rz - nz * ry, nz * rx - nx * rz, nx * ry - ny * rx])
    length = np.sqrt((along * along).sum(axis=0))
    cross = normal[:, None] - (nx * rx + ny * ry + nz * rz) * up
    return up, along / length, cross / length


# ---------------------------------------------------------------------------------------------------------------------
# What a policy is given of a rocket
# ---------------------------------------------------------------------------------------------------------------------


# sizes by which flights at dispersion 1 differ at the same step (at the cut-off by up to four times that): altitude
# 3 km, climb rate 15 m/s, position and speed out of the plane 0.5 km and 1.5 m/s, speed 30 m/s, the logarithm of the
# observed mass, angle flown 6 km of arc
DIFFERENCES = [0.03, 0.015, 0.005, 0.0015, 0.004, 0.003, 0.001]


def policy_constants(rocket: Rocket) -> dict:
    """What a policy is given of a rocket, as lists, saved with its weights: the target orbit in its own axes, mu = 1.

    `axes` (3, 3), rows towards the perigee, along the semi-latus rectum and normal to the plane; `units` (7,) of r, v
    and m (the Earth's radius, circular speed there, the dry mass); angular momentum `h_target` and eccentricity vector
    `e_target` (3,); `phases`, what is observed of each burn; `steps`, end_time / dt; `mean_flight`, (ceil(steps) + 1,
    7), learnt from dispersed flights (later steps take its last row), and the `differences` (7,) from it.
    """
    axes, steps = target_axes(rocket), rocket.end_time / rocket.dt
    h_target, e_target = target_orbit(rocket.target, rocket.mu)
    length, speed = rocket.Re, (rocket.mu / rocket.Re) ** 0.5  # 6378 km and 7.9 km/s
    return {
        "axes": axes.tolist(),
        "units": [length] * 3 + [speed] * 3 + [rocket.dry_mass],
        "h_target": (axes @ h_target / (length * speed)).tolist(),
        "e_target": (axes @ e_target).tolist(),
        "phases": np.linspace(0.0, 1.0, len(rocket.burns)).tolist(),
        "steps": steps,
        "differences": DIFFERENCES,
        "mean_flight": np.zeros((int(np.ceil(steps)) + 1, len(DIFFERENCES))).tolist(),
    }


# ---------------------------------------------------------------------------------------------------------------------
# The five parts of the reward (the paper says what each is for and gives no formula: these are ours)
# ---------------------------------------------------------------------------------------------------------------------


def orbital_reward(distance, next_distance):
    """R_orbital = 10 (L_t - L_{t+1}), L the sum of |component| of the terminal error in the target orbit's axes.

    The paper speaks of "exponential shaping"; this is linear. Over an episode it adds up to 10 (L_0 - L_T): it is the
    objective, not a policy-invariant shaping. A sum over components, because a norm hides the small ones behind the
    largest.
    """
    return 10.0 * (distance - next_distance)


def trajectory_reward(energy, next_energy, early, weight):
    """R_trajectory = w (E_{t+1} - E_t) / (1 MJ/kg) where `early`, before the last burn; E the specific energy."""
    return weight * (next_energy - energy) / 1e6 * early


REFERENCE_PITCH = {  # degrees above the horizon over time, as a part of a mission's `guided_until`; our own guess
    "none": None,
    "linear": ((0.0, 1.0), (90.0, 40.0)),
    "knots": ((0.0, 10 / 150.4, 40 / 150.4, 0.5, 1.0), (90.0, 88.0, 72.0, 55.0, 35.0)),  # s of the paper's rocket
}


def guidance_reward(u, up, along, pitch, weight):
    """R_guidance = -w (1 - u . d), d the direction at the reference pitch above the horizon, along the target's plane.

    u, up, along (3, N); pitch (N,) in rad at the step's start, NaN where there is no guidance: by default everywhere.
    """
    cosine = (u * (np.sin(pitch) * up + np.cos(pitch) * along)).sum(axis=0)
    return np.where(np.isnan(pitch), 0.0, -weight * (1 - cosine))


def penalties(mission: Mission, altitude, time, turn, burnt, left, mass_weight):
    """R_penalties = -40 c (2 - t / t_end) - 0.024 o - 0.024 s - 0.001 |u_t - u_{t-1}| - w_m (b + c l) / mass_unit.

    c = 1[h < 0], a crash, which must cost more than the worst miss, and the more the earlier: from a policy whose
    flights all crash the way back leads through later crashes. o = clip((h + 5 km - ceiling) / 100 km, 0, 1),
    overshoot; s = clip((floor - h) / 30 km, 0, 1) late in the flight, too low for its speed; b (kg), the propellant
    that a step of the last phase burns, l, what a crash leaves of it. Altitude h (m), time t (s): the step's end's;
    t_end (s) is the rocket's end_time. Ceiling, floor (110 km, the paper's rocket at the fixed time: 130 km), what is
    late (after 300 s) and mass_unit (the paper's rocket: 100 kg) are the mission's.

    The paper names h > 0, overshoot beyond 250 km and |u_t - u_{t-1}|; the sizes, the margin that lets o begin 5 km
    below the ceiling, the floor and the price of propellant are ours.
    """
    crash = altitude < 0
    overshoot = np.minimum(np.maximum((altitude - (mission.ceiling - 5e3)) / 100e3, 0.0), 1.0)
    sag = np.minimum(np.maximum((1e3 * mission.floor_km - altitude) / 30e3, 0.0), 1.0) * (time > mission.late)
    mass_unit = mission.mass_unit or 0.06 * mission.rocket.dry_mass
    crashed = -40.0 * crash * (2 - time / mission.rocket.end_time)
    return crashed - 0.024 * (overshoot + sag) - 0.001 * turn - mass_weight * (burnt + crash * left) / mass_unit


TERMINAL_SCALE = 0.005  # of the reported R_terminal


def terminal_reward(error_norm, scale=TERMINAL_SCALE):
    """R_terminal = -2 ln(1 + d / scale) at the episode's end, d the norm of the terminal error: steep near the target.

    In place of the paper's points (see below). A norm, unlike R_orbital's sum: near the target the largest
    component is the one to work on, and the noise in the others, which a sum of absolute values charges in full, hardly
    counts. Errors far below the scale earn almost the same, so a scale that shrinks with the policy's noise is a
    curriculum of training.
    """
    return -2.0 * np.log1p(error_norm / scale)


def mass_rewards(ends, rocket: Rocket, scale, group_size):
    """Rewards (n,) of flights for the mass that they have left, apart from what their misses saved; only in training.

    `ends` are n flights' `final_info`, `scale` that of their R_terminal; each `group_size` in a row have the same start
    or draw. Those that end with ||error|| < 0.05 at the target's energy are compared, where they are at least eight and
    half of the group: what runs dry, or has too much energy before the last burn, gets nothing. A low perigee saves
    propellant (the paper's rocket: 18 t a unit of ||error||), which is R_terminal's to judge. So mass and R_terminal
    are each regressed linearly on the terminal errors, which have four directions at one energy. The mass's residuals
    are paid, scaled to the spread of R_terminal's: kilograms would fall with the noise and be hidden by R_terminal,
    whose spread does not. While the orbit is off to one side, R_terminal is nearly linear in the errors, and little is
    paid. Ours.
    """
    cut_off = np.abs(1e3 * ends["a_km"] / rocket.a - 1) < 1e-6  # others would add a fifth direction
    near, paid = cut_off & (ends["error_norm"] < 0.05), np.zeros(len(ends["error"]))
    judged = np.column_stack([ends["final_mass_kg"], terminal_reward(ends["error_norm"], scale)])
    for group in np.arange(len(paid)).reshape(-1, group_size):
        flights = group[near[group]]
        if len(flights) < max(8, group_size // 2):
            continue
        x, y = (values[flights] - values[flights].mean(axis=0) for values in (ends["error"], judged))
        directions = np.linalg.svd(x, full_matrices=False)[0][:, :4]
        mass, terminal = (y - directions @ (directions.T @ y)).T
        paid[flights] = terminal.std() * mass / max(mass.std(), 1e-9)
    return paid


def precision_points(error_norm):
    """2000 1[d < 0.02] + 1600 e^(-d/0.01) + 1600 e^(-d/0.001), d as in `terminal_reward`: reported only.

    The paper pays 2000 points "for successful orbital insertion" and "precision bonuses up to 3200 points"; what is
    successful and how the bonuses fall it does not say: 0.02 and the exponentials are ours.
    """
    return 2000.0 * (error_norm < 0.02) + 1600.0 * (np.exp(-error_norm / 0.01) + np.exp(-error_norm / 0.001))
