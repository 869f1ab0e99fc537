"""The optimum that knows of a failure from the moment it strikes. It shows whether a flight can be saved.

Until the strike it is the optimum of the drawn vehicle, which expects no failure. Then the remaining ascent is solved
again, with the thrust that is left. Its last burn may go on below the dry mass, so there is nearly always an optimum.
A flight is savable if this optimum ends above the dry mass.

Reading order: one flight, many flights, stored optima. CasADi and SciPy are imported only where they are used.
"""

from __future__ import annotations

import sys
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from common.errors import NoOptimum
from common.files import DAMAGED_NPZ
from common.workers import Workers, usable_cores
from rocket import guidance
from rocket.dispersion import DISPERSION, Vehicles, arc_masses, draw_vehicles
from rocket.metrics import draws
from rocket.missions import Mission
from rocket.optimum import RESULTS, kept_reference
from rocket.orbits import target_axes, target_orbit
from rocket.vehicle import Rocket


class Failing(NamedTuple):
    """The environment's options that say which failures and which vehicles are drawn."""

    dispersion: float = 0.0
    failure: float = 0.0
    failure_time: str = "random"

    @classmethod
    def of(cls, env_options: dict) -> Failing:
        """The fields among the options of an environment."""
        return cls(**{name: env_options[name] for name in cls._fields if name in env_options})

    def draws(self, rocket: Rocket, eval_seed: int, n: int) -> np.ndarray:
        """The n draws (n, k) of a seed."""
        return draws(rocket, self.dispersion, eval_seed, n, self.failure)

    def vehicles(self, rocket: Rocket, z: np.ndarray) -> Vehicles:
        """The vehicles of draws z (n, k)."""
        return draw_vehicles(rocket, self.dispersion, z, self.failure, self.failure_time)


# ---------------------------------------------------------------------------------------------------------------------
# One flight
# ---------------------------------------------------------------------------------------------------------------------

RELAXED_MASS = 0.5  # the last burn may go on down to this part of the dry mass
# on a healthy flight's intervals, tried in turn; IPOPT gives up on a few early strikes
INTERVAL_FACTORS = (1, 2, 0.5)


def solve_rescue(job):
    """The optimum of one flight, or None if IPOPT finds none. job is (rocket, failing, z, guess), z (k + 4,) its draw.

    A healthy flight has the optimum of `guidance.drawn_optima`, another flight that of `rescued`.
    """
    rocket, failing, z, guess = job
    orbit = target_orbit(rocket.target, rocket.mu)
    healthy = guidance.solve_drawn((rocket, failing.dispersion, z, orbit, guess))
    vehicle = failing.vehicles(rocket, z[None])
    group, moment, _ = vehicle.failure[:, 0]
    # no failure, or one after the cut-off, or one in the environment's last step, after which no direction is chosen
    if healthy is None or group < 0 or moment > healthy["final_time"] - rocket.dt:
        return healthy
    before = draw_vehicles(rocket, failing.dispersion, z[None])
    intervals = guidance.drawn_intervals(rocket, guess["t"][-1])
    for factor in INTERVAL_FACTORS:
        scaled = tuple(max(round(factor * number), 1) for number in intervals)
        try:
            return rescued(rocket, vehicle, before, healthy, orbit, scaled)
        except NoOptimum:
            continue
    return None


def rescued(rocket: Rocket, vehicle: Vehicles, before: Vehicles, healthy: dict, orbit, intervals) -> dict:
    """The optimum of a vehicle that flies `healthy` until its failure strikes, and knows of the failure from then on.

    `before` is the vehicle without the failure. `intervals` has a number for each burn. Returns what
    `optimise_remaining` does for the time after the strike, with `healthy` and the `strike` (s). Raises NoOptimum if
    IPOPT finds none.
    """
    strike = vehicle.failure[1, 0]
    state = state_at(healthy, strike)
    first = int((before.burn_end[:-1, 0] <= strike).sum())  # the burn in which it strikes
    remaining = remaining_after(vehicle, strike, state, orbit)
    # The guess is the rest of the healthy flight, with each burn stretched to its new length. The ratio of the flows
    # stretches the last burn.
    flow_before = before.flow[len(before.burn_end) - 1, 0]
    flow_now = remaining.flow[-1]
    old = np.array([strike, *before.burn_end[first:-1, 0], healthy["final_time"]])
    new = np.array([strike, *vehicle.burn_end[first:-1, 0], 0.0])
    new[-1] = new[-2] + (old[-1] - old[-2]) * flow_before / flow_now
    guess = {}
    for t, values in (("t", "y"), ("t_u", "u")):
        later = healthy[t] > min(strike, healthy[t][-2])
        guess |= {t: np.interp(healthy[t][later], old, new), values: healthy[values][later]}
    guess["t"] = np.append(strike, guess["t"])
    guess["y"] = np.vstack([state, guess["y"]])
    found = guidance.optimise_remaining(rocket, remaining, guess, intervals[first:])
    return found | {"healthy": healthy, "strike": strike}


def state_at(plan: dict, time: float) -> np.ndarray:
    """r (m) and v (m/s), (6,), of an optimum of `optimise_remaining` at `time` (s), by its interval's polynomial."""
    from scipy.interpolate import BarycentricInterpolator

    size = len(guidance.GAUSS_POINTS) + 1  # the interval's begin, and its points
    last = len(plan["t"]) - 1 - size
    begin = min(size * ((np.searchsorted(plan["t"], time, side="right") - 1) // size), last)
    nodes = slice(begin, begin + size)
    return BarycentricInterpolator(plan["t"][nodes], plan["y"][nodes])(time)


def remaining_after(vehicle: Vehicles, strike: float, state: np.ndarray, orbit) -> guidance.RemainingAscent:
    """What is left of the ascent of one vehicle from its failure on, with a relaxed last burn (`RELAXED_MASS`)."""
    begin = max(strike, vehicle.end[-3, 0])  # s, when the last arc with thrust begins
    propellant = arc_masses(vehicle)[-1] - RELAXED_MASS * vehicle.dry_mass[0]
    last_end = begin + propellant / vehicle.flow[-2, 0]
    return guidance.vehicle_ascent(vehicle, strike, state, last_end, orbit)


def directions_at(optimum: dict, times: np.ndarray) -> np.ndarray:
    """An optimum's directions (m, 3) at `times` (m,) in s. From the strike on they know of the failure."""
    if "strike" not in optimum:
        return guidance.directions_at(optimum, times)
    before = guidance.directions_at(optimum["healthy"], times)
    after = guidance.directions_at(optimum, times)
    return np.where((times < optimum["strike"])[:, None], before, after)


# ---------------------------------------------------------------------------------------------------------------------
# Many flights
# ---------------------------------------------------------------------------------------------------------------------

FLIGHTS_PER_PROCESS = 50  # a process takes two seconds to start, a flight a third of one


def failing_optima(
    env_id: str, mission: Mission, failing: Failing, z: np.ndarray, processes: int | None = None
) -> list:
    """The optima of draws z (n, k + 4), as `solve_rescue` returns them.

    `processes` share the solves, which changes only the time. The default depends on the number of draws and cores.
    """
    guess = guidance.guess_of(kept_reference(env_id, mission))
    jobs = [(mission.rocket, failing, row, guess) for row in z]
    if processes is None:
        processes = max(1, min(usable_cores(), len(jobs) // FLIGHTS_PER_PROCESS))
    with Workers(processes) as workers:
        return workers.map(solve_rescue, jobs)


class Known(NamedTuple):
    """What is left by the optima of n flights that know of a failure from its strike on."""

    mass: np.ndarray  # (n,) kg in the target orbit; NaN for healthy flights and without an optimum
    price: np.ndarray  # (n, 5) kg that a unit of each number of `orbit_defect` saves; NaN as the mass

    def first(self, n: int) -> Known:
        """The same for the first n flights."""
        return Known(*(values[:n] for values in self))

    def note(self, flights, optima: list):
        """Set the numbers of these flights by their optima. A flight without one keeps its numbers."""
        for k, optimum in zip(flights, optima):
            if optimum:
                self.mass[k] = optimum["final_mass"]
                self.price[k] = optimum["orbit_price"]

    def mass_at(self, error: np.ndarray, rocket: Rocket) -> np.ndarray:
        """The masses (n,) in kg for the orbits with these terminal errors (n, 6), to first order.

        We compared them with fourteen optima to orbits that were reached. Below an error of 0.001 they agree within
        0.1 kg. At an error of 0.01 they are up to 1.5 kg too large.
        """
        in_plane = error[:, 3:] @ target_axes(rocket)[:2].T
        return self.mass + (self.price * np.hstack([error[:, :3], in_plane])).sum(axis=1)


def solve_known(env_id: str, mission: Mission, failing: Failing, z: np.ndarray) -> Known:
    """`Known` of draws z (n, k + 4)."""
    vehicles = failing.vehicles(mission.rocket, z)
    has_failed = np.flatnonzero(vehicles.failure[0] >= 0)
    known = Known(np.full(len(z), np.nan), np.full((len(z), 5), np.nan))
    known.note(has_failed, failing_optima(env_id, mission, failing, z[has_failed]))
    return known


# ---------------------------------------------------------------------------------------------------------------------
# The optima of a seed's draws: stored, or solved once
# ---------------------------------------------------------------------------------------------------------------------

STORED = RESULTS / "failure_optima"


def about(env_id: str, mission: Mission, failing: Failing, eval_seed: int) -> str:
    """What the optima of a seed's draws depend on, in words. A stored file with the same words fits."""
    options = " ".join(f"{name} {value}" for name, value in failing._asdict().items())
    return f"{env_id} {options} eval_seed {eval_seed} {DISPERSION} {mission.rocket}"


@lru_cache(maxsize=8)
def known_optima(env_id: str, mission: Mission, failing: Failing, eval_seed: int, n: int) -> Known:
    """`solve_known` of the first n draws of a seed. It is read from results/ if it is stored there."""
    known = stored_optima(about(env_id, mission, failing, eval_seed), n)
    if known is None:
        print(f"{env_id}: solving what can be saved of {n} flights with failures, once", file=sys.stderr, flush=True)
        known = solve_known(env_id, mission, failing, failing.draws(mission.rocket, eval_seed, n))
    for values in known:
        values.flags.writeable = False
    return known


def stored_optima(words: str, n: int) -> Known | None:
    """The optima of the first n flights, from the file in results/ with these words of `about`; None without it."""
    for path in sorted(STORED.glob("*.npz")):
        try:
            with np.load(path) as file:
                if str(file["about"]) == words and len(file["mass"]) >= n:
                    return Known(file["mass"], file["price"]).first(n)
        except (OSError, KeyError, *DAMAGED_NPZ):
            continue
    return None
