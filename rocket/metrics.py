"""The metrics of a rocket's flights: orbital elements, altitudes and mass of one, statistics of flights that differ.

The nominal rocket has one start and the policy is deterministic, so one flight says everything. Each dispersed flight
has its own vehicle and air, and some have a failure, so statistics measure a policy there. The names of all metrics
(eval.json) are the project's interface.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from common.flying import fly_until_ended
from rocket.dispersion import draw_bounds
from rocket.environment import RocketVectorEnv
from rocket.failure import failure_scores
from rocket.missions import ROCKETS, Mission
from rocket.navigation import flight_noise
from rocket.targets import ELEMENTS
from rocket.vehicle import Rocket

SUCCESS = 0.02  # bound of ||error||, our choice: the paper's "successful orbital insertion" has no bound
ELEMENT_ERRORS = {"a_km": "a_error_km", "e": "e_error", "i_deg": "i_error_deg"}
ELEMENT_ERRORS |= {"raan_deg": "raan_error_deg", "argp_deg": "argp_error_deg"}
EQUATORIAL = (0.0, 180.0)  # inclinations in degrees at which an orbit has no node


def rocket_metrics(flight: dict, reference: dict, mission: Mission) -> dict:
    """The metrics of a flight of `fly_rocket`, beside those of the optimum, `rocket_reference`."""
    metrics = flight_summary(flight, mission)
    best = flight_summary(reference, mission)
    target = target_summary(mission.rocket)
    for key, error in ELEMENT_ERRORS.items():
        if key in target:
            metrics[error] = wrapped(key, metrics[key] - target[key])
    metrics |= {f"reference_{key}": value for key, value in best.items() if not key.startswith("final_")}
    metrics |= {key: reference[key] for key in ("reference_mass_kg", "reference_time_s", "nine_pitch_error_norm")}
    metrics["mass_ratio"] = metrics["final_mass_kg"] / metrics["reference_mass_kg"]
    metrics |= {key: flight[key] for key in (*RocketVectorEnv.PARTS, "points")}
    metrics = {key: float(value) for key, value in metrics.items() if np.isfinite(value)}
    return metrics | {"success": bool(flight["error_norm"] < SUCCESS), "crashed": bool(flight["crashed"])}


def own_flight(arrays: dict) -> dict:
    """The arrays of an evaluation, where `t` and `u` are those of the flight to the rocket's own orbit."""
    return arrays | {key: arrays[f"{key}_own"] for key in ("t", "u") if f"{key}_own" in arrays}


def flight_summary(flight: dict, mission: Mission) -> dict:
    """The metrics that the policy's flight and the optimum's both have: elements, altitudes, mass, time, return.

    Altitudes are in km above Re.
    """
    keys = ("error_norm", *ELEMENT_ERRORS, "final_mass_kg", "final_time_s", "max_altitude_km", "episodic_return")
    summary = {key: flight[key] for key in keys} | apsides(flight["a_km"], flight["e"], mission.rocket)
    if mission.rocket.i in EQUATORIAL:
        summary["argp_deg"] = perigee_longitude(summary["raan_deg"], summary["argp_deg"], mission.rocket.i)
    after = altitude_km(flight["y"], mission.rocket)[flight["t"] > mission.floor_from]
    return summary | {lowest_key(mission): after.min(initial=np.inf)}


def lowest_key(mission: Mission) -> str:
    """The name of the metric for the lowest altitude above the air, by default `min_altitude_after_300s_km`."""
    return f"min_altitude_after_{mission.floor_from:.0f}s_km"


def perigee_longitude(raan: float, argp: float, i: float) -> float:
    """The perigee's angle from the x axis in the direction of flight, for an orbit without a node. All in degrees."""
    return (argp + (raan if i < 90 else -raan)) % 360.0


def apsides(a_km, e, rocket: Rocket) -> dict:
    """Altitudes of perigee and apogee above Re in km, (n,) or one. A hyperbola (a < 0) has an infinite apogee."""
    Re = rocket.Re / 1e3
    return {"perigee_km": a_km * (1 - e) - Re, "apogee_km": np.where(a_km > 0, a_km * (1 + e) - Re, np.inf)}


def altitude_km(y: np.ndarray, rocket: Rocket) -> np.ndarray:
    """Altitudes (K+1,) in km of states y (K+1, 7)."""
    return (np.linalg.norm(y[:, :3], axis=1) - rocket.Re) / 1e3


def target_summary(rocket: Rocket) -> dict:
    """The target orbit in the metrics' names and units. Angles that a circular or equatorial one lacks are left out."""
    target = {"a_km": rocket.a / 1e3, "e": rocket.e, "i_deg": rocket.i, "raan_deg": rocket.raan % 360.0}
    target["argp_deg"] = rocket.argp % 360.0
    if rocket.i in EQUATORIAL:
        target["argp_deg"] = perigee_longitude(target.pop("raan_deg"), rocket.argp, rocket.i)
    if rocket.e == 0:
        del target["argp_deg"]
    return target | apsides(rocket.a / 1e3, rocket.e, rocket)


def wrapped(key: str, difference: float) -> float:
    """A difference of the metric `key`. Angles differ by the short way round, from -180 to 180 degrees."""
    if not key.endswith("_deg"):
        return difference
    return (difference + 180.0) % 360.0 - 180.0


# ---------------------------------------------------------------------------------------------------------------------
# Dispersed flights
# ---------------------------------------------------------------------------------------------------------------------

# If all of 1705 flights succeed, the success rate is at least 99.865 % (3 sigma) with 90 % confidence. NASA's Monte
# Carlo analyses by order statistics have this size (Hanson and Beard, 2012).
DISPERSED_STARTS = 1705
AT_ONCE = 341  # flights of a batch, a fifth of all, so that the caches of a policy stay below 0.3 GB
# 3 sigma accuracy of insertion into a transfer orbit by the Falcon 9 user's guide, quoted from memory and not looked up
BOX = {"perigee_km": 10.0, "apogee_km": 500.0, "i_deg": 0.1, "raan_deg": 0.1, "argp_deg": 0.3}
NEARLY_A_CIRCLE = 0.01  # eccentricity below which the place of a target's perigee does not count


def draws(rocket: Rocket, dispersion: float, eval_seed: int, n: int, failure: float = 0.0) -> np.ndarray:
    """The n draws (n, k) of a seed, in standard scores. They are the same for every policy and guidance law.

    They are clipped as in the environment (`draw_bounds`). With a `failure` they are (n, k + 4): the same scores, then
    the failures. The failures' numbers are the same for every size of `failure`.
    """
    bounds = draw_bounds(rocket, dispersion)
    scores = np.random.default_rng([eval_seed, 2]).standard_normal((n, len(bounds))).clip(-bounds, bounds)
    if not failure:
        return scores
    return np.hstack([scores, failure_scores(np.random.default_rng([eval_seed, 4]), n)])


def healthy(arrays: dict) -> np.ndarray:
    """The flights (n,) without a failure, as a mask, in the arrays of `evaluate_dispersed`."""
    if "failure" not in arrays:
        return np.ones(len(arrays["draw"]), dtype=bool)
    return arrays["failure"][:, 0] < 0


def chosen(arrays: dict, flights: np.ndarray) -> dict:
    """The arrays (n, ...) of the chosen flights, a mask or indices."""
    return {key: value[flights] for key, value in arrays.items()}


def targets_of(mission: Mission, eval_seed: int, n: int) -> np.ndarray:
    """The n targets (n, 5) of a seed: a (m), e, i, raan, argp (degrees), for a mission with ranges of targets.

    They are the same for every policy and guidance law.
    """
    shares = np.random.default_rng([eval_seed, 5]).random((n, len(ELEMENTS)))
    return mission.ranges.at(shares, mission.rocket)


def evaluate_dispersed(
    env_id: str, policy, eval_seed: int, n: int, dispersion: float, at_once: int = AT_ONCE, **env_options
):
    """Fly `policy(obs (m, obs), t) -> action (m, 3)` on the first n draws of a seed, in batches of at most `at_once`.

    Returns the `dispersed_...` metrics of eval.json, and the arrays `draw` (n, k), `final_y` (n, 7) with the true mass,
    `final_t` (n,) and `final_error` (n, 6). Flights that crash or run dry are counted, and the errors include them.
    With the option `failure` there is an array `failure` (n, 3) as in `final_info`, and the metrics are those of the
    healthy flights. Where flights have targets of their own there is an array `target` (n, 5).
    """
    mission = ROCKETS[env_id]
    rocket = env_options.get("rocket") or mission.rocket
    given = {"draw": draws(rocket, dispersion, eval_seed, n, env_options.get("failure", 0.0))}
    if mission.targets is not None:
        given["target"] = targets_of(mission, eval_seed, n)
    flights = fly_batches(env_id, policy, eval_seed, given, at_once, dispersion=dispersion, **env_options)
    names = ("draw", "target", "final_y", "final_t", "final_error", "failure")
    arrays = {key: flights[key] for key in names if key in flights} | given
    if not dispersion:  # all healthy flights are equal
        return {}, arrays
    flights = chosen(flights, healthy(arrays))
    metrics = {"dispersion": float(dispersion), "dispersed_starts": len(flights["error"])}
    if len(flights["error"]):
        metrics |= dispersed_metrics(flights, rocket)
    return metrics, arrays


def fly_batches(env_id: str, policy, eval_seed: int, given: dict, at_once: int = AT_ONCE, **env_options) -> dict:
    """The ends of the flights with these options of `reset`, {name: (n, ...)}, in batches of at most `at_once`."""
    n = len(next(iter(given.values())))
    parts = []
    for first in range(0, n, at_once):
        batch = range(first, min(first + at_once, n))
        noise = partial(flight_noise, eval_seed, batch)
        part = {name: values[batch.start : batch.stop] for name, values in given.items()}
        parts.append(fly_given(env_id, policy, part, noise, **env_options))
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def fly_dispersed(env_id: str, policy, z: np.ndarray, dispersion: float, noise=None, **env_options) -> dict:
    """`fly_given` of one batch of flights with the draws z (m, k)."""
    return fly_given(env_id, policy, {"draw": z}, noise, dispersion=dispersion, **env_options)


def fly_given(env_id: str, policy, given: dict, noise=None, **env_options) -> dict:
    """The ends of one batch of flights: `final_info`'s arrays, `final_t` (m,) and `final_error` (m, 6).

    `given` are the options of their `reset`, {name: (m, ...)}. noise(T) gives the standard scores (m, T, 6) of the
    observations, with the option `navigation_noise`. Without it the scores are random.
    """
    number = len(next(iter(given.values())))
    batch: Any = gym.make_vec(env_id, num_envs=number, **env_options)
    if noise is not None and batch.navigation_noise:
        given = given | {"noise": noise(batch.episode_steps + 1)}
    obs, _ = batch.reset(options=given)
    ends = fly_until_ended(batch, policy, obs, restart=True)
    return ends | {"final_t": ends["final_time_s"], "final_error": ends["error"]}


def dispersed_metrics(flights: dict, rocket: Rocket) -> dict:
    """The statistics of dispersed flights (n,): errors of all, elements of those that reached a closed orbit.

    flights has `error_norm` and the elements, masses and ends of `final_info`.
    """
    errors = flights["error_norm"]
    metrics = {"dispersed_error_median": np.median(errors), "dispersed_error_max": errors.max()}
    metrics |= {f"dispersed_error_p{p}": np.percentile(errors, p) for p in (95, 99)}
    closed = reached_orbit(flights)
    for key, miss in element_misses(flights, rocket).items():
        name, unit = key.rsplit("_", 1)
        if closed.any():
            metrics[f"dispersed_{name}_error_mean_{unit}"] = miss[closed].mean()
            metrics[f"dispersed_{name}_error_std_{unit}"] = miss[closed].std()
    metrics |= box_rate(int(inside_box(flights, rocket).sum()), len(errors))
    mass = flights["final_mass_kg"]
    metrics |= {"dispersed_mass_mean_kg": mass.mean(), "dispersed_mass_p01_kg": np.percentile(mass, 1)}
    counts = {"dispersed_dry": int(flights["dry"].sum()), "dispersed_crashed": int(flights["crashed"].sum())}
    return {key: float(value) for key, value in metrics.items() if np.isfinite(value)} | counts


def reached_orbit(flights: dict) -> np.ndarray:
    """Whether flights (n,) ended on a closed orbit and not on the ground."""
    return (flights["a_km"] > 0) & ~flights["crashed"]


def inside_box(flights: dict, rocket: Rocket) -> np.ndarray:
    """Whether flights (n,) ended inside the launcher's accuracy."""
    misses = element_misses(flights, rocket)
    return reached_orbit(flights) & np.all([np.abs(miss) <= BOX[key] for key, miss in misses.items()], axis=0)


def savable_failures(arrays: dict, best_mass: np.ndarray, dry_mass: np.ndarray) -> np.ndarray:
    """The flights (n,), as a mask, that lose thrust and can still reach their orbit.

    best_mass (n,) in kg is what is left in the target orbit by the optimum that knows of the failure from its strike
    on, with a relaxed dry mass (`rescue.py`). It is NaN if no optimum was found. A flight is savable if its best_mass
    is above its dry_mass (n,) in kg.
    """
    return ~healthy(arrays) & (best_mass > dry_mass)


def failure_metrics(arrays: dict, best_mass: np.ndarray, mass_reached: np.ndarray, dry_mass: np.ndarray) -> dict:
    """The statistics of the flights with a failure, from the arrays that `evaluate_dispersed` returns for n flights.

    best_mass and dry_mass (n,) in kg are those of `savable_failures`. Errors and the saved rate are those of the
    savable flights. The missing mass is that of the saved flights, beside mass_reached (n,) in kg: what the same
    optimum has left in the orbit that the flight reached.
    """
    has_failed = ~healthy(arrays)
    savable = savable_failures(arrays, best_mass, dry_mass)
    errors = np.linalg.norm(arrays["final_error"], axis=1)
    saved = savable & (errors < SUCCESS)
    counts = {"failure_starts": int(has_failed.sum()), "failure_savable": int(savable.sum())}
    metrics = {}
    if savable.any():
        metrics["failure_saved_rate"] = saved.sum() / savable.sum()
        metrics["failure_error_median"] = np.median(errors[savable])
        metrics["failure_error_p95"] = np.percentile(errors[savable], 95)
    if saved.any():
        metrics["failure_mass_short_mean_kg"] = (mass_reached - arrays["final_y"][:, 6])[saved].mean()
    return counts | {key: float(value) for key, value in metrics.items()}


def element_misses(flights: dict, rocket: Rocket) -> dict:
    """The differences (n,) of flights from the target, in the order of `BOX`, in km and degrees.

    Flights with targets of their own have a `target` (n, 5). An angle that the rocket's own target does not have is
    left out. The perigee's argument of a target that is nearly a circle is no miss.
    """
    flown = {key: flights[key] for key in ("i_deg", "raan_deg", "argp_deg")}
    if "target" in flights:
        a, e, *angles = flights["target"].T
        target = dict(zip(flown, angles)) | apsides(a / 1e3, e, rocket)
    else:
        target = target_summary(rocket)
        if rocket.i in EQUATORIAL:
            flown["argp_deg"] = perigee_longitude(flown["raan_deg"], flown["argp_deg"], rocket.i)
    flown |= apsides(flights["a_km"], flights["e"], rocket)
    misses = {key: wrapped(key, flown[key] - target[key]) for key in BOX if key in target}
    if "target" not in flights:
        return misses
    has_perigee = flights["target"][:, 1] >= NEARLY_A_CIRCLE
    return misses | {"argp_deg": has_perigee * misses["argp_deg"]}


def box_rate(inside: int, n: int) -> dict:
    """The share of n flights inside the launcher's accuracy, and its Wilson interval at 95 % confidence."""
    low, high = wilson(inside, n)
    return {"dispersed_box_rate": inside / n, "dispersed_box_low": low, "dispersed_box_high": high}


def wilson(hits: int, n: int) -> tuple[float, float]:
    """The Wilson interval of the share of hits among n, at 95 % confidence."""
    from scipy.stats import binomtest

    interval = binomtest(hits, n).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)
