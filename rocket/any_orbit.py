"""Flights to many targets: their optima and their evaluation.

Each flight has its own target orbit. `targets.py` has the ranges. Reading order: the optima, the evaluation. CasADi is
imported only where it solves.
"""

from __future__ import annotations

import sys
from contextlib import suppress
from functools import lru_cache, partial

import numpy as np

from common.errors import NoOptimum
from common.files import DAMAGED_NPZ
from common.workers import Workers, usable_cores
from rocket import guidance
from rocket.dispersion import check_drawable, draw_names, draw_vehicles
from rocket.environment import fly_rocket
from rocket.metrics import fly_batches, inside_box, targets_of
from rocket.missions import Mission
from rocket.navigation import flight_noise
from rocket.optimum import RESULTS, kept_reference
from rocket.orbits import target_axes, target_orbit
from rocket.targets import elements_of
from rocket.vehicle import Rocket

# ---------------------------------------------------------------------------------------------------------------------
# The optimum of each target: stored, or solved once
# ---------------------------------------------------------------------------------------------------------------------

STORED = RESULTS / "target_optima"
REFERENCES = 300  # targets of an evaluation that have their optimum
OF_FEW = 30  # of those of a small evaluation, which a training makes on its way
FLIGHTS_PER_PROCESS = 50  # a process takes two seconds to start, a solve half of one


def solve_target(job) -> dict | None:
    """The optimum of one target, as `optimise_remaining` returns it, or None. job is (rocket, target (5,), guesses)."""
    rocket, target, guesses = job
    vehicle = draw_vehicles(rocket, 0.0, np.zeros((1, len(draw_names(rocket)))))  # as the table has it
    elements = elements_of(target)
    orbit = target_orbit(elements, rocket.mu)
    last_end = min(vehicle.burn_out[0], rocket.end_time)
    ascent = guidance.vehicle_ascent(vehicle, 0.0, rocket.x0[:6], last_end, orbit)
    ascent = ascent._replace(axes=target_axes(rocket, elements)[:2])
    for guess in guesses:
        try:
            return guidance.optimise_remaining(rocket, ascent, guess, guidance.drawn_intervals(rocket, guess["t"][-1]))
        except NoOptimum:
            continue
    return None


def solve_targets(env_id: str, mission: Mission, targets: np.ndarray, processes: int | None = None) -> list:
    """The optima of targets (n, 5), as `solve_target` returns them.

    They are looked for from the optimum of the rocket's own orbit, and then from that of the middle of all ranges.
    Raises BadInput for a rocket that cannot be drawn (`check_drawable`).
    """
    rocket = mission.rocket
    check_drawable(rocket)
    guesses = [guidance.guess_of(kept_reference(env_id, mission))]
    middle = solve_target((rocket, mission.ranges.corners(rocket)[0], guesses))
    if middle:
        guesses.append(middle)
    if processes is None:
        processes = max(1, min(usable_cores(), len(targets) // FLIGHTS_PER_PROCESS))
    with Workers(processes) as workers:
        return workers.map(solve_target, [(rocket, target, guesses) for target in targets])


def flown_to(env_id: str, targets: np.ndarray, optima: list) -> list[dict]:
    """The flights, as `fly_rocket` returns them, of the optima that were found among those of targets (n, 5)."""
    return [
        fly_rocket(env_id, guidance.fly_optima(env_id, [optimum]), target=target)
        for target, optimum in zip(targets, optima)
        if optimum
    ]


def references(n: int) -> int:
    """How many of an evaluation's n targets have their optimum."""
    return min(n, REFERENCES if n >= REFERENCES else OF_FEW)


def about(env_id: str, mission: Mission, eval_seed: int) -> str:
    """What the optima of a seed's targets depend on, in words. A stored file with the same words fits."""
    return f"{env_id} eval_seed {eval_seed} {mission.targets} {mission.rocket}"


@lru_cache(maxsize=8)
def target_masses(env_id: str, mission: Mission, eval_seed: int, n: int) -> np.ndarray:
    """The kg (n,) that the optima of a seed's first n targets leave. It is read from results/ if it is stored there.

    Raises NoOptimum, with a line about the first one, if the vehicle cannot reach a corner of its targets' ranges.
    """
    words = about(env_id, mission, eval_seed)
    for path in sorted(STORED.glob("*.npz")):
        with suppress(OSError, KeyError, *DAMAGED_NPZ), np.load(path) as file:
            if str(file["about"]) == words and len(file["mass"]) >= n:
                return file["mass"][:n]
    refuse_unreachable(env_id, mission)
    print(f"{env_id}: solving the optima of {n} targets, once", file=sys.stderr, flush=True)
    return masses(solve_targets(env_id, mission, targets_of(mission, eval_seed, n)))


def masses(optima: list) -> np.ndarray:
    """The kg (n,) that optima leave, NaN where none was found."""
    return np.array([optimum["final_mass"] if optimum else np.nan for optimum in optima])


def refuse_unreachable(env_id: str, mission: Mission):
    """Raise NoOptimum if the optimum of a corner of the targets' ranges is not found."""
    corners = mission.ranges.corners(mission.rocket)
    for target, optimum in zip(corners, solve_targets(env_id, mission, corners)):
        if optimum is None:
            raise NoOptimum(f"{env_id}: no optimum to {in_words(target, mission.rocket)}, which is in its targets")


def in_words(target: np.ndarray, rocket: Rocket) -> str:
    """A target (5,) in words."""
    a, e, i, raan, argp = target
    perigee, apogee = (a * (1 + sign * e) - rocket.Re for sign in (-1, 1))
    return f"{perigee / 1e3:.4g} km by {apogee / 1e3:.6g} km, i {i:.4g}, raan {raan:.4g}, argp {argp:.4g} degrees"


# ---------------------------------------------------------------------------------------------------------------------
# Evaluation
# ---------------------------------------------------------------------------------------------------------------------

RECORDED = 20  # flights whose directions are kept


def evaluate_targets(env_id: str, mission: Mission, policy, eval_seed: int, n: int, **env_options):
    """Fly `policy(obs (m, obs), t) -> action (m, 3)` to the first n targets of a seed, the vehicle as the table has it.

    Returns the `target_...` metrics of eval.json, and the arrays of eval.npz: `target` (n, 5), `final_y` (n, 7),
    `final_t` (n,), `final_error` (n, 6), `best_mass` (n,) in kg, NaN where it is not known, and `t` (k, K+1) and
    `u` (k, K, 3) of the first flights, NaN after their ends.
    """
    targets = targets_of(mission, eval_seed, n)
    ends = fly_batches(env_id, policy, eval_seed, {"target": targets}, **env_options)
    errors = ends["error_norm"]
    metrics = {"target_error_median": np.median(errors), "target_error_p95": np.percentile(errors, 95)}
    metrics |= {"target_error_max": errors.max(), "target_box_rate": inside_box(ends, mission.rocket).mean()}
    best = np.full(n, np.nan)
    solved = references(n)
    best[:solved] = target_masses(env_id, mission, eval_seed, solved)
    known = np.isfinite(best)
    if known.any():
        ratio = ends["final_mass_kg"][known] / best[known]
        metrics |= {"target_mass_ratio_mean": ratio.mean(), "target_mass_ratio_min": ratio.min()}
    metrics = {key: float(value) for key, value in metrics.items()} | {"target_starts": n}
    metrics |= {"target_reference_starts": int(known.sum()), "target_crashed": int(ends["crashed"].sum())}
    arrays = {"target": targets, **{key: ends[key] for key in ("final_y", "final_t", "final_error")}, "best_mass": best}
    arrays |= record_flights(env_id, policy, targets[:RECORDED], eval_seed, **env_options)
    return metrics, arrays


def record_flights(env_id: str, policy, targets: np.ndarray, eval_seed: int, **env_options) -> dict:
    """Times `t` (k, K+1) in s and directions `u` (k, K, 3) in ECI of flights to targets (k, 5). NaN after an end."""
    flights = [
        fly_rocket(env_id, policy, target=target, noise=partial(flight_noise, eval_seed, [k]), **env_options)
        for k, target in enumerate(targets)
    ]
    longest = max(len(flight["u"]) for flight in flights)
    t = np.full((len(flights), longest + 1), np.nan)
    u = np.full((len(flights), longest, 3), np.nan)
    for k, flight in enumerate(flights):
        t[k, : len(flight["t"])] = flight["t"]
        u[k, : len(flight["u"])] = flight["u"]
    return {"t": t, "u": u}
