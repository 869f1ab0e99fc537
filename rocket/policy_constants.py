"""What a policy is given of a rocket beside its observations: constants that are saved with its weights."""

from __future__ import annotations

import numpy as np

from rocket.orbits import target_axes, target_orbit
from rocket.vehicle import Rocket

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
