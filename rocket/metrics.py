"""What a rocket's flights are measured by: elements, altitudes, mass; and statistics of flights that differ.

One start and a deterministic policy: one nominal flight says everything. Dispersed flights have each its own vehicle
and air, some a failure, so that a policy is measured by statistics. The names of all metrics (eval.json) are the
project's interface.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from rocket.dispersion import draw_bounds
from rocket.environment import RocketVectorEnv, fly_rocket
from rocket.failure import failure_scores
from rocket.missions import ROCKETS, Mission
from rocket.navigation import flight_noise
from rocket.orbits import orbital_elements
from rocket.vehicle import Rocket

SUCCESS = 0.02  # of the error's norm: ours; the paper pays for a "successful orbital insertion" and gives no bound
ELEMENT_ERRORS = {"a_km": "a_error_km", "e": "e_error", "i_deg": "i_error_deg"}
ELEMENT_ERRORS |= {"raan_deg": "raan_error_deg", "argp_deg": "argp_error_deg"}
EQUATORIAL = (0.0, 180.0)  # inclinations in degrees at which an orbit has no node


def rocket_metrics(flight: dict, reference: dict, mission: Mission) -> dict:
    """The metrics of a flight of `fly_rocket` beside the optimum's, `rocket_reference`."""
    metrics, best = (flight_summary(flown, mission) for flown in (flight, reference))
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


def flight_summary(flight: dict, mission: Mission) -> dict:
    """What is said of ours and of the optimum alike: elements, altitudes (km above Re), mass, time, return."""
    keys = ("error_norm", *ELEMENT_ERRORS, "final_mass_kg", "final_time_s", "max_altitude_km", "episodic_return")
    summary = {key: flight[key] for key in keys} | apsides(flight["a_km"], flight["e"], mission.rocket)
    if mission.rocket.i in EQUATORIAL:
        summary["argp_deg"] = perigee_longitude(summary["raan_deg"], summary["argp_deg"], mission.rocket.i)
    after = altitude_km(flight["y"], mission.rocket)[flight["t"] > mission.floor_from]
    return summary | {lowest_key(mission): after.min(initial=np.inf)}


def lowest_key(mission: Mission) -> str:
    """The metric of the lowest altitude after the air has been left, `min_altitude_after_300s_km` by default."""
    return f"min_altitude_after_{mission.floor_from:.0f}s_km"


def perigee_longitude(raan: float, argp: float, i: float) -> float:
    """The perigee's angle from the x axis in the direction of flight, in degrees as all, where there is no node."""
    return (argp + (raan if i < 90 else -raan)) % 360.0


def apsides(a_km: float, e: float, rocket: Rocket) -> dict:
    """Altitudes of perigee and apogee above Re in km; a hyperbola (a < 0) has its apogee at infinity."""
    Re = rocket.Re / 1e3
    return {"perigee_km": a_km * (1 - e) - Re, "apogee_km": a_km * (1 + e) - Re if a_km > 0 else np.inf}


def altitude_km(y: np.ndarray, rocket: Rocket) -> np.ndarray:
    """Altitudes (K+1,) in km of states y (K+1, 7)."""
    return (np.linalg.norm(y[:, :3], axis=1) - rocket.Re) / 1e3


def target_summary(rocket: Rocket) -> dict:
    """The target orbit in the metrics' names and units, without the angles that a circle or no node leaves open."""
    target = {"a_km": rocket.a / 1e3, "e": rocket.e, "i_deg": rocket.i, "raan_deg": rocket.raan % 360.0}
    target["argp_deg"] = rocket.argp % 360.0
    if rocket.i in EQUATORIAL:
        target["argp_deg"] = perigee_longitude(target.pop("raan_deg"), rocket.argp, rocket.i)
    if rocket.e == 0:
        del target["argp_deg"]
    return target | apsides(rocket.a / 1e3, rocket.e, rocket)


def wrapped(key: str, difference: float) -> float:
    """A difference of the metric `key`; of angles in degrees the short way round, -180 to 180."""
    return (difference + 180.0) % 360.0 - 180.0 if key.endswith("_deg") else difference


# ---------------------------------------------------------------------------------------------------------------------
# Dispersed flights
# ---------------------------------------------------------------------------------------------------------------------

# 1705 flights without a failure show a success rate of 99.865 % (3 sigma) at 90 % confidence: the size of NASA's Monte
# Carlo analyses by order statistics (Hanson and Beard, 2012)
DISPERSED_STARTS = 1705
AT_ONCE = 341  # flights of a batch: a fifth, so that the caches of a policy stay below 0.3 GB
# what the Falcon 9 user's guide gives as its 3 sigma accuracy of insertion into a transfer orbit (from memory)
BOX = {"perigee_km": 10.0, "apogee_km": 500.0, "i_deg": 0.1, "raan_deg": 0.1, "argp_deg": 0.3}


def draws(rocket: Rocket, dispersion: float, eval_seed: int, n: int, failure: float = 0.0) -> np.ndarray:
    """The n draws (n, k) of a seed, standard scores: the same for every policy and guidance law.

    Clipped as the environment's own: at 3, earlier where a dispersion is so large that no such vehicle can be. With a
    `failure` (n, k + 4): behind the same scores the flights' failures, the same ones whatever its size.
    """
    bounds = draw_bounds(rocket, dispersion)
    scores = np.random.default_rng([eval_seed, 2]).standard_normal((n, len(bounds))).clip(-bounds, bounds)
    if not failure:
        return scores
    return np.hstack([scores, failure_scores(np.random.default_rng([eval_seed, 4]), n)])


def healthy(arrays: dict) -> np.ndarray:
    """Which of the flights of `evaluate_dispersed`'s arrays have no failure, (n,)."""
    return arrays["failure"][:, 0] < 0 if "failure" in arrays else np.ones(len(arrays["draw"]), dtype=bool)


def chosen(arrays: dict, flights: np.ndarray) -> dict:
    """The arrays (n, ...) of some of the flights (n,)."""
    return {key: value[flights] for key, value in arrays.items()}


def evaluate_dispersed(
    env_id: str, policy, eval_seed: int, n: int, dispersion: float, at_once: int = AT_ONCE, **env_options
):
    """Fly `policy(obs (m, obs), t) -> action (m, 3)` on the first n draws of a seed, in batches of at most `at_once`.

    Returns the `dispersed_...` metrics of eval.json and the arrays `draw` (n, k), `final_y` (n, 7) with the true mass,
    `final_t` (n,), `final_error` (n, 6). Flights that crash or run dry are counted, and are among the errors. With the
    option `failure` also the array `failure` (n, 3), as in `final_info`; the metrics are then of the healthy flights.
    """
    rocket = env_options.get("rocket") or ROCKETS[env_id].rocket
    z, parts = draws(rocket, dispersion, eval_seed, n, env_options.get("failure", 0.0)), []
    for first in range(0, n, at_once):
        batch = range(first, min(first + at_once, n))
        noise = partial(flight_noise, eval_seed, batch)
        parts.append(fly_dispersed(env_id, policy, z[batch.start : batch.stop], dispersion, noise, **env_options))
    flights = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    names = ("final_y", "final_t", "final_error", "failure")
    arrays = {"draw": z} | {key: flights[key] for key in names if key in flights}
    if not dispersion:  # healthy flights are then all alike
        return {}, arrays
    flights = chosen(flights, healthy(arrays))
    metrics = {"dispersion": float(dispersion), "dispersed_starts": len(flights["error"])}
    return metrics | (dispersed_metrics(flights, rocket) if len(flights["error"]) else {}), arrays


def fly_dispersed(env_id: str, policy, z: np.ndarray, dispersion: float, noise=None, **env_options) -> dict:
    """The ends of one batch of flights with the draws z (m, k): `final_info`'s arrays, `final_y` (m, 7) and others.

    noise(T): the standard scores (m, T, 6) of the observations, with the option `navigation_noise`; else random.
    """
    batch: Any = gym.make_vec(env_id, num_envs=len(z), dispersion=dispersion, **env_options)
    given = {"draw": z}
    if noise is not None and batch.navigation_noise:
        given["noise"] = noise(batch.episode_steps + 1)
    obs, _ = batch.reset(options=given)
    alive, ends, t = np.ones(len(z), dtype=bool), {}, 0
    while alive.any():
        obs, _, terminated, _, info = batch.step(policy(obs, t))
        ended, t = alive & terminated, t + 1  # an ended environment has started anew; its first flight counts
        if ended.any():
            # with navigation noise what is observed is not the state, and the info has it
            final = {"final_y": info["final_obs"][:, :7], **info["final_info"]}
            for key, value in final.items():
                ends.setdefault(key, np.zeros_like(value))[ended] = value[ended]
        alive = alive & ~terminated
    ends["final_y"][:, 6] = ends["final_mass_kg"]  # what is observed is the flight computer's
    return ends | {"final_t": ends["final_time_s"], "final_error": ends["error"]}


def dispersed_metrics(flights: dict, rocket: Rocket) -> dict:
    """The statistics of dispersed flights (n,): errors of all, elements of those that reached a closed orbit."""
    errors = flights["error_norm"]
    metrics = {"dispersed_error_median": np.median(errors), "dispersed_error_max": errors.max()}
    metrics |= {f"dispersed_error_p{p}": np.percentile(errors, p) for p in (95, 99)}
    misses, closed = element_misses(flights, rocket), (flights["a_km"] > 0) & ~flights["crashed"]
    for key, miss in misses.items():
        name, unit = key.rsplit("_", 1)
        if closed.any():
            metrics[f"dispersed_{name}_error_mean_{unit}"] = miss[closed].mean()
            metrics[f"dispersed_{name}_error_std_{unit}"] = miss[closed].std()
    inside = closed & np.all([np.abs(miss) <= BOX[key] for key, miss in misses.items()], axis=0)
    metrics |= box_rate(int(inside.sum()), len(errors))
    mass = flights["final_mass_kg"]
    metrics |= {"dispersed_mass_mean_kg": mass.mean(), "dispersed_mass_p01_kg": np.percentile(mass, 1)}
    counts = {"dispersed_dry": int(flights["dry"].sum()), "dispersed_crashed": int(flights["crashed"].sum())}
    return {key: float(value) for key, value in metrics.items() if np.isfinite(value)} | counts


def savable_flights(arrays: dict, best_mass: np.ndarray, dry_mass: np.ndarray) -> np.ndarray:
    """The flights (n,) that lose thrust and could yet reach their orbit.

    best_mass (n,) kg: what the optimum has left in the target orbit that knows of the failure from its strike on, its
    dry mass relaxed (`rescue.py`; NaN where none was found). A flight is savable where that is above dry_mass (n,) kg.
    """
    return ~healthy(arrays) & (best_mass > dry_mass)


def failure_metrics(arrays: dict, best_mass: np.ndarray, mass_reached: np.ndarray, dry_mass: np.ndarray) -> dict:
    """The statistics of the flights with a failure, of n flights as `evaluate_dispersed` returns their arrays.

    best_mass and dry_mass (n,) kg: see `savable_flights`. Errors and the rate are of the savable flights. The mass that
    is short is that of the saved flights, beside mass_reached (n,) kg, what the same optimum has left in the orbit that
    the flight reached.
    """
    has_failed = ~healthy(arrays)
    savable = savable_flights(arrays, best_mass, dry_mass)
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
    """What flights miss the target by, (n,) each, in the order of `BOX`: km and degrees, only angles that it has."""
    target, flown = target_summary(rocket), {key: flights[key] for key in ("i_deg", "raan_deg", "argp_deg")}
    if rocket.i in EQUATORIAL:
        flown["argp_deg"] = perigee_longitude(flown["raan_deg"], flown["argp_deg"], rocket.i)
    a, e, Re = flights["a_km"], flights["e"], rocket.Re / 1e3
    flown |= {"perigee_km": a * (1 - e) - Re, "apogee_km": a * (1 + e) - Re}
    return {key: wrapped(key, flown[key] - target[key]) for key in BOX if key in target}


def box_rate(inside: int, n: int) -> dict:
    """The share of flights inside the launcher's accuracy, and its Wilson interval at 95 % confidence."""
    from scipy.stats import binomtest

    interval = binomtest(inside, n).proportion_ci(0.95, method="wilson")
    return {
        "dispersed_box_rate": inside / n,
        "dispersed_box_low": float(interval.low),
        "dispersed_box_high": float(interval.high),
    }


def final_elements(y: np.ndarray, rocket: Rocket) -> dict:
    """The elements of states (n, 7) in the names of `final_info`."""
    elements = orbital_elements(y, rocket.mu)
    degrees = {f"{name}_deg": np.degrees(getattr(elements, name)) for name in ("i", "raan", "argp")}
    return {"a_km": elements.a / 1e3, "e": elements.e, **degrees}


def decision_us(env_id: str, policy, **env_options) -> float:
    """Median microseconds on one core of a policy's decision, over a flight that is alone in its batch."""
    seconds = []

    def timed(obs, t):
        begin = time.process_time()
        action = policy(obs, t)
        seconds.append(time.process_time() - begin)
        return action

    fly_rocket(env_id, timed, **env_options)
    return 1e6 * float(np.median(seconds))
