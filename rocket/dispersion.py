"""What differs from flight to flight.

A draw is a vector of k standard scores in the order of `draw_names`. Reading order: the standard deviations, the
vehicles, the scores, the vehicles of draws, ends of burns, wind, which rockets can be drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from common.errors import refuse_unless
from common.integration import exp
from rocket.failure import Losses, drawn_losses, largest_failures, no_losses
from rocket.vehicle import ROCKET, Rocket, engine_groups, engine_types


@dataclass(frozen=True)
class Dispersion:
    """Standard deviations of a flight's differences from the table: relative, in kg or in m/s.

    We quote two studies from memory and did not look them up again. Study A, a public Monte-Carlo study of launch
    guidance, has thrust 1 %, Isp 0.3 %, propellant and dry mass 0.5 %, density 5 %. Study B, of the Saturn V with
    10 000 trials, has Isp 0.3 % and thrust 0.4 %. "Our choice" has no source.
    """

    burn_rate: float = 0.005  # of thrust and flow together; between the thrusts of B and A
    isp: float = 0.003  # of the thrust at a given flow; A and B
    propellant: float = 0.003  # of the load; our choice, below A's 0.5 % because the burn rate moves the burn-out, too
    dry_mass: float = 0.005  # A
    payload: float = 20.0  # kg; our choice, A's 0.5 % of the paper's payload
    drag: float = 0.14  # of density times Cd; A's 5 % of density, and 13 % of Cd by our choice
    wind: float = 20.0  # m/s at its altitude, east and north each; our choice, the jet stream from day to day


DISPERSION = Dispersion()
OF_ENGINES = ("burn_rate", "isp", "propellant", "dry_mass")  # one score each for every type of engine
OF_FLIGHT = ("payload", "drag", "wind_east", "wind_north")
LARGEST_SCORE = 3.0  # drawn scores are clipped there
LARGEST_CHANGE = 0.9  # the largest relative change of a drawn factor or payload, so that none reaches zero
LARGEST_DISPERSION = 100.0
WIND_ALTITUDE, WIND_DEPTH = 12e3, 5e3  # m, of the profile exp(-((h - altitude) / depth)^2), which is our choice


class Vehicles(NamedTuple):
    """N drawn vehicles. An arc is a time between two events, as in `Rocket.arcs`; there are A arcs.

    With failures there is one more arc, because the strike cuts a burn in two. A healthy flight never comes to it.
    """

    mass: np.ndarray  # (N,) kg at lift-off
    dry_mass: np.ndarray  # (N,) kg, as `Rocket.dry_mass`
    propellant: np.ndarray  # (N,) kg in the last stage
    burn_end: np.ndarray  # (burns, N) s; the last burn ends when it runs dry
    burn: np.ndarray  # (A, N) the burn of each arc, from 0
    end: np.ndarray  # (A, N) s, the last infinite
    thrust: np.ndarray  # (A, N) N
    flow: np.ndarray  # (A, N) kg/s
    dropped: np.ndarray  # (A, N) kg at the arc's end
    burn_out: np.ndarray  # (N,) s, when the last stage has burnt as much as nominally, or runs dry
    wind: np.ndarray  # (2, N) m/s towards east and north, where the profile of `wind_velocity` is 1
    drag: np.ndarray  # (N,) factor on the drag
    failure: np.ndarray  # (3, N) group of engines, moment (s) and share lost; -1, 0, 0: healthy


def draw_names(rocket: Rocket) -> tuple[str, ...]:
    """The names of the k scores of a draw. Types of engines are counted from 1."""
    types = range(1, len(engine_types(rocket)) + 1)
    return (*(f"{name}_{j}" for name in OF_ENGINES for j in types), *OF_FLIGHT)


def draw_sigmas(rocket: Rocket) -> np.ndarray:
    """The entry of `DISPERSION` for each score, (k,)."""
    table = {**vars(DISPERSION), "wind_east": DISPERSION.wind, "wind_north": DISPERSION.wind}
    kinds = [name if name in table else name.rpartition("_")[0] for name in draw_names(rocket)]
    return np.array([table[kind] for kind in kinds])


def draw_bounds(rocket: Rocket, dispersion: float) -> np.ndarray:
    """The largest scores (k,) that are drawn: 3, or less if a factor or the payload would change by more than 90 %."""
    nominal = np.ones(len(draw_names(rocket)))
    nominal[-4:] = rocket.payload, 1.0, np.inf, np.inf
    sigmas = dispersion * draw_sigmas(rocket)
    bounds = np.full(len(nominal), LARGEST_SCORE)
    return np.minimum(bounds, np.divide(LARGEST_CHANGE * nominal, sigmas, out=bounds.copy(), where=sigmas > 0))


def largest_draw(rocket: Rocket, dispersion: float, failure_time: str = "") -> np.ndarray:
    """The draw (1, k) of the vehicle that burns longest and is heaviest.

    With a `failure_time` the draws are (F, k + 4), a row for each group of engines that may fail. One of these vehicles
    burns longest.
    """
    types = len(engine_types(rocket))
    signs = np.zeros(len(draw_names(rocket)))
    signs[:types] = -1.0
    signs[2 * types : 4 * types + 1] = 1.0
    largest = (signs * draw_bounds(rocket, dispersion))[None]
    if not failure_time:
        return largest
    failures = largest_failures(rocket, failure_time)
    return np.hstack([np.repeat(largest, len(failures), axis=0), failures])


class Factors(NamedTuple):
    """What the draws make of the nominal values. The first four are by type of engine, (types, N) each."""

    burn_rate: np.ndarray
    isp: np.ndarray
    propellant: np.ndarray
    dry_mass: np.ndarray
    drag: np.ndarray  # (N,)
    payload: np.ndarray  # (N,) kg, no factor
    wind: np.ndarray  # (2, N) m/s towards east and north, no factor


def draw_factors(rocket: Rocket, dispersion: float, draw: np.ndarray) -> Factors:
    """The factors that scores (N, k) give. Raises BadInput for the first score that no vehicle can have."""
    types = len(engine_types(rocket))
    change = dispersion * draw_sigmas(rocket)[:, None] * draw.T
    value = change + 1.0
    value[-4] = change[-4] + rocket.payload
    value[-2:] = change[-2:]
    possible = value > 0
    possible[-4] = value[-4] >= 0
    possible[-2:] = True
    if not possible.all():
        k, n = np.argwhere(~possible)[0]
        allowed = f"must be larger: with dispersion {dispersion} it makes of the nominal value {value[k, n]:.6g}"
        refuse_unless(False, f"{draw_names(rocket)[k]} of draw {n}", draw[n, k], allowed)
    of_engines = value[: 4 * types].reshape(4, types, -1)
    return Factors(*of_engines, drag=value[-3], payload=value[-4], wind=value[-2:])


def draw_vehicles(
    rocket: Rocket, dispersion: float, draw: np.ndarray, failure: float = 0.0, failure_time: str = "random"
) -> Vehicles:
    """The vehicles of N draws (N, k). Each value is the nominal one changed by dispersion times sigma times score.

    The arcs are the burns, and a last arc without thrust. All propellant is burnt or dropped, also what an engine does
    not burn. With a `failure` draws may be (N, k + 4), where the last four numbers are those of `FAILURE_DRAW`. Without
    them the flights are healthy. Raises BadInput for a draw that no vehicle can have.
    """
    draw = np.asarray(draw, dtype=np.float64)
    scores = len(draw_names(rocket))
    factors = draw_factors(rocket, dispersion, draw[:, :scores])
    groups, types = engine_groups(rocket), engine_types(rocket)
    type_of = {engine: j for j, engine in enumerate(types)}
    none = np.zeros_like(factors.payload)

    def empty(parts):
        return sum(n * (e.total_mass - e.propellant) * factors.dry_mass[type_of[e]] for n, e in parts)

    def loaded(parts):
        return sum(n * e.propellant * factors.propellant[type_of[e]] for n, e in parts)

    def thrust(parts):
        return sum(n * e.thrust * factors.burn_rate[type_of[e]] * factors.isp[type_of[e]] for n, e in parts)

    def flow(parts):
        return sum(n * e.flow(rocket.table_isp) * factors.burn_rate[type_of[e]] for n, e in parts)

    lasting = factors.propellant / factors.burn_rate
    losses = no_losses(groups, len(none))
    if failure and draw.shape[1] > scores:
        _, _, seconds_lit = burn_ends(rocket, lasting, losses)
        losses = drawn_losses(rocket, draw[:, scores:], failure, failure_time, seconds_lit)
    end, burn_out, seconds_lit = burn_ends(rocket, lasting, losses)
    dropped = np.zeros_like(end)
    for g, (group, seconds) in enumerate(zip(groups, seconds_lit)):
        if group.dropped_after < len(rocket.burns) - 1:
            rate = group.engine.flow(rocket.table_isp) * factors.burn_rate[group.type]
            burnt = rate * losses.spent(g, seconds)
            unburnt = np.maximum(group.engine.propellant * factors.propellant[group.type] - burnt, 0.0)
            dropped[group.dropped_after] += empty([(group.number, group.engine)]) + group.number * unburnt

    last = rocket.burns[-1].engines
    aboard = [*(part for burn in rocket.burns for part in burn.dropped), *last]
    vehicles = Vehicles(
        mass=factors.payload + empty(aboard) + loaded(aboard),
        dry_mass=factors.payload + empty(last),
        propellant=none + loaded(last),
        burn_end=end,
        burn=np.tile(arc_burns(rocket, len(end) + 1)[:, None], len(none)),
        end=np.vstack([end, none + np.inf]),
        thrust=np.array([*(none + thrust(burn.engines) for burn in rocket.burns), none]),
        flow=np.array([*(none + flow(burn.engines) for burn in rocket.burns), none]),
        dropped=np.vstack([dropped, none]),
        burn_out=burn_out,
        wind=factors.wind,
        drag=factors.drag,
        failure=np.tile([[-1.0], [0.0], [0.0]], len(none)),
    )
    if not failure:
        return vehicles
    whole = [[(group.number, group.engine)] for group in groups]
    of_groups = (np.array([none + of(parts) for parts in whole]) for of in (thrust, flow))
    return struck(vehicles, groups, losses, losses.strike(groups, end), *of_groups)


def struck(vehicles: Vehicles, groups, losses: Losses, strike: np.ndarray, thrust: np.ndarray, flow: np.ndarray):
    """The vehicles after failures: their burns are cut at the `strike` (N,) s, and then have the thrust and flow left.

    vehicles are the healthy ones. thrust and flow (G, N) are those of each group of engines. An infinite strike never
    comes.
    """
    last_arc = len(vehicles.end) - 1
    cut = (vehicles.end <= strike).sum(axis=0)  # the arc that the strike ends
    arcs = np.arange(last_arc + 2)[:, None]
    after = arcs > cut
    source = np.minimum(arcs - after, last_arc)  # the healthy flight's arc that each arc is part of

    def of_arcs(column):
        return np.take_along_axis(column, source, axis=0)

    def left(column, of_groups):
        lost = np.zeros_like(column)
        for group, share, full in zip(groups, losses.share, of_groups):
            lost[list(group.burns)] += share * full
        return of_arcs(column) - after * of_arcs(lost)

    has_failed = np.isfinite(strike)
    failure = [np.isfinite(losses.after).argmax(axis=0), strike, losses.share.max(axis=0)]
    return vehicles._replace(
        burn=of_arcs(vehicles.burn),
        end=np.sort(np.vstack([vehicles.end, strike]), axis=0),
        thrust=left(vehicles.thrust, thrust),
        flow=left(vehicles.flow, flow),
        dropped=of_arcs(vehicles.dropped) * (arcs != cut),
        failure=np.where(has_failed, failure, vehicles.failure),
    )


def arc_burns(rocket: Rocket, arcs: int) -> np.ndarray:
    """The burn of each arc (arcs,). What follows the last burn counts as part of it."""
    return np.minimum(np.arange(arcs), len(rocket.burns) - 1)


def burn_ends(rocket: Rocket, lasting: np.ndarray, losses: Losses):
    """The ends of the burns (B, N) s, `burn_out` (N,) s, and the seconds (G, N) that the groups of engines are lit.

    lasting (types, N) is how long an engine's propellant lasts, as a part of the nominal time.

    - a burn that drops burning engines ends when the first of them has burnt its nominal part of its propellant
    - a coast ends after its nominal length
    - any other burn ends at its nominal time
    - no burn goes on without the propellant of one of its engines, and the last burn goes on until then

    Engines that lose thrust and flow burn the same propellant for longer.
    """
    groups = engine_groups(rocket)
    last = len(rocket.burns) - 1
    start = burn_out = np.zeros(lasting.shape[1])
    seconds_lit = np.zeros((len(groups), lasting.shape[1]))
    ends = []
    for k, burn in enumerate(rocket.burns):
        until_empty, until_due = seconds_left(groups, k, lasting, seconds_lit, losses)
        planned = burn.end - (rocket.burns[k - 1].end if burn.is_coast else start)  # a coast keeps its length
        until_due = np.where(np.isfinite(until_due), until_due, planned)
        burn_out = start + np.maximum(np.minimum(until_due, until_empty), 0.0)
        end = start + np.maximum(until_empty, 0.0) if k == last else burn_out
        for group, seconds in zip(groups, seconds_lit):
            if k in group.burns:
                seconds += end - start
        ends.append(end)
        start = end
    return np.array(ends), burn_out, seconds_lit


def seconds_left(groups, k: int, lasting: np.ndarray, seconds_lit: np.ndarray, losses: Losses):
    """Two times (N,) in s from the beginning of burn k on; infinite if there is none.

    - until the first of its engines is empty
    - until the first engine that leaves after it is due, which is when it has burnt its nominal part of its propellant
    """
    until_empty = until_due = np.full(lasting.shape[1], np.inf)
    for g, (group, seconds) in enumerate(zip(groups, seconds_lit)):
        if k not in group.burns or group.seconds_full == np.inf:
            continue
        until_empty = np.minimum(until_empty, losses.lasts(g, group.seconds_full * lasting[group.type]) - seconds)
        if k == group.dropped_after:
            until_due = np.minimum(until_due, losses.lasts(g, group.seconds_lit * lasting[group.type]) - seconds)
    return until_empty, until_due


def arc_masses(vehicle: Vehicles) -> np.ndarray:
    """The kg (A - 1,) of one vehicle when each arc begins. The last arc is left out."""
    end, flow, dropped = (column[:-1, 0] for column in (vehicle.end, vehicle.flow, vehicle.dropped))
    lost = flow * np.diff(end, prepend=0.0) + dropped
    return vehicle.mass[0] - np.append(0.0, np.cumsum(lost)[:-1])


def nominal_vehicles(rocket: Rocket, number: int) -> Vehicles:
    """`number` vehicles as the table has them. With `table_isp` propellant that a stage has not burnt stays aboard."""
    _, end, thrust, flow, dropped = np.array(rocket.arcs()).T
    values = {
        "mass": rocket.x0[6],
        "dry_mass": rocket.dry_mass,
        "propellant": sum(n * engine.propellant for n, engine in rocket.burns[-1].engines),
        "burn_end": [burn.end for burn in rocket.burns],
        "burn": arc_burns(rocket, len(end)),
        "end": np.append(end[:-1], np.inf),
        "thrust": thrust,
        "flow": flow,
        "dropped": dropped,
        "burn_out": rocket.burns[-1].end,
        "wind": np.zeros(2),
        "drag": 1.0,
        "failure": [-1.0, 0.0, 0.0],
    }
    columns = {name: np.asarray(value)[..., None] for name, value in values.items()}
    return Vehicles(**{name: np.repeat(column, number, axis=-1) for name, column in columns.items()})


def wind_velocity(place, wind, rocket: Rocket = ROCKET):
    """The wind in ECI, m/s by components, at the place (rx, ry, rz, |r|) in m.

    wind is (east, north) in m/s where the profile over the altitude is 1.
    """
    rx, ry, rz, r = place
    profile = exp(-(((r - (rocket.Re + WIND_ALTITUDE)) / WIND_DEPTH) ** 2))
    axis = (rx * rx + ry * ry) ** 0.5 + 1e-9  # m from the Earth's axis; never 0, so that a pole gives no NaN
    east, north = profile * wind[0] / axis, profile * wind[1] / r
    south = north * rz / axis
    return -east * ry - south * rx, east * rx - south * ry, north * axis


NAMES = "; engines of equal numbers that are lit at other times need a `name` of their own"


def check_drawable(rocket: Rocket):
    """Raise BadInput for a rocket of which no flights can be drawn: with all scores 0 they must be the nominal ones.

    Each drawn engine burns from its own tank, and engines that are dropped together burn together.
    """
    drawn = draw_vehicles(rocket, 1.0, np.zeros((1, len(draw_names(rocket)))))
    last = len(rocket.burns) - 1
    for k, (burn, dropped) in enumerate(zip(rocket.burns, rocket.jettison)):
        ends = drawn.end[k, 0]
        leaves = drawn.dropped[k, 0]
        same = np.isclose(burn.end, ends) or (k == last and (ends > burn.end or rocket.table_isp))
        allowed = f"cannot be drawn: its engines, each from its own tank, burn until {ends:.6g} s{NAMES}"
        refuse_unless(same, f"burns[{k}].end", burn.end, allowed)
        same = np.isclose(dropped, leaves) or rocket.table_isp  # a drawn flight drops what has not burnt
        allowed = f"cannot be drawn: with what has not burnt then it is {leaves:.6g} kg{NAMES}"
        refuse_unless(same, f"what burns[{k}] drops", f"{dropped:.6g} kg", allowed)
