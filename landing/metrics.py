"""The metrics of landings. The names of all metrics (eval.json) and arrays (eval.npz) are the project's interface.

Draws differ, so one flight says little. A policy is measured on many draws. Its fuel is compared with the optimum's on
the first `REFERENCE_STARTS` draws.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

from landing.environment import PERIOD, fly_lander
from landing.lander import DRAW
from landing.rewards import POSITION_LIMIT, SPEED_LIMIT

FLIGHTS = 10_000  # the published code's number
REFERENCE_STARTS = 200
AT_ONCE = 1000  # flights of a batch, so that the caches of a policy stay below 0.2 GB
FAILURE = ("failure_probability", "failure_size", "failure_vertical", "failure_time")  # options that say what fails
KEPT_FLIGHTS = 15  # flights whose states eval.npz keeps


def draws(eval_seed: int, n: int) -> np.ndarray:
    """The n draws (n, 13) of a seed. They are the same for every policy and guidance law."""
    return np.random.default_rng([eval_seed, 3]).random((n, len(DRAW)))


def fly_draws(env_id: str, make_policy: Callable, z: np.ndarray, **env_options) -> dict:
    """The arrays of `fly_lander` for draws z (n, 13), flown in batches. `make_policy(z)` gives the policy of a batch.

    y has only the first `KEPT_FLIGHTS` flights.
    """
    parts = []
    for first in range(0, len(z), AT_ONCE):
        some = z[first : first + AT_ONCE]
        part = fly_lander(env_id, make_policy(some), some, **env_options)
        part["y"] = part["y"][: max(KEPT_FLIGHTS - first, 0)]
        parts.append(part)
    longest = max(part["u"].shape[1] for part in parts)
    for part in parts:
        for key in ("u", "effectiveness"):
            part[key] = until(part[key], longest)
        part["y"] = until(part["y"], longest + 1)
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def until(rows: np.ndarray, steps: int) -> np.ndarray:
    """Rows (n, T, k) padded with NaN to (n, steps, k)."""
    padded = np.full((len(rows), steps, rows.shape[2]), np.nan)
    padded[:, : rows.shape[1]] = rows
    return padded


def flight_metrics(flown: dict) -> dict:
    """The metrics of flights, without those that need a reference."""
    position, speed = flown["position_error"], flown["speed"]
    is_soft = flown["down"] & (position < POSITION_LIMIT) & (speed < SPEED_LIMIT)
    return {
        "episodic_return": float(flown["episodic_return"].mean()),
        "landed_rate": float(flown["landed"].mean()),
        "soft_rate": float(is_soft.mean()),  # landed, whatever the slope
        "down_rate": float(flown["down"].mean()),
        "position_error_mean_m": float(position.mean()),
        "position_error_p95_m": float(np.percentile(position, 95)),
        "position_error_max_m": float(position.max()),
        "speed_mean_m_s": float(speed.mean()),
        "speed_std_m_s": float(speed.std()),
        "speed_max_m_s": float(speed.max()),
        "slope_p05": float(np.percentile(flown["slope"], 5)),
        "slope_min": float(flown["slope"].min()),
        "fuel_mean_kg": float(flown["fuel_kg"].mean()),
        "final_time_mean_s": float(flown["final_time"].mean()),
    }


def evaluate_policy(env_id: str, policy: Callable, reference: dict, eval_seed: int, n: int, **env_options):
    """Fly `policy(obs (m, obs), t) -> action (m, 3)` on the n draws of a seed. Returns metrics and arrays."""
    flown = fly_draws(env_id, lambda z: policy, draws(eval_seed, n), **env_options)
    solved = np.flatnonzero(reference["solved"])
    batch: Any = gym.make_vec(env_id, num_envs=1, **env_options)  # a LanderVectorEnv
    metrics = {"env_id": env_id, "eval_seed": eval_seed, "eval_starts": n} | flight_metrics(flown)
    metrics |= {name: getattr(batch, name) for name in FAILURE}
    metrics |= {"decision_s": float(batch.dt), "reference_starts": len(solved)}
    for name, key in (("fuel_mean_kg", "fuel_kg"), ("final_time_mean_s", "final_time")):
        metrics[f"reference_{name}"] = float(reference[key][solved].mean())
    metrics["reference_episodic_return"] = float(reference["episodic_return"][solved].mean())
    metrics["fuel_ratio"] = float(flown["fuel_kg"][solved].mean() / reference["fuel_kg"][solved].mean())
    return metrics, flight_arrays(flown, reference)


def flight_arrays(flown: dict, reference: dict) -> dict:
    """The arrays of eval.npz. Its `decision_s` is 0.2 s, the period by which flights are recorded."""
    kept = ("u", "effectiveness", "y", "start", "gravity", "draw", "final_y", "slope", "fuel_kg")
    arrays = {key: flown[key] for key in kept}
    arrays |= {"decision_s": np.array(PERIOD), "final_t": flown["final_time"]}
    return arrays | {"y_reference": reference["y"], "fuel_kg_reference": reference["fuel_kg"]}
