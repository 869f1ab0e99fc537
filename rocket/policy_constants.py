"""What a policy is given of a rocket beside its observations: constants that are saved with its weights."""

from __future__ import annotations

import numpy as np

from rocket.orbits import target_axes, target_orbit
from rocket.vehicle import Rocket

# sizes by which flights at dispersion 1 differ on their way (at the cut-off by up to four times that): altitude
# 3 km, climb rate 15 m/s, position and speed out of the plane 0.5 km and 1.5 m/s, speed 30 m/s, the logarithm of the
# observed mass, angle flown 6 km of arc
DIFFERENCES = [0.03, 0.015, 0.005, 0.0015, 0.004, 0.003, 0.001]


def policy_constants(rocket: Rocket) -> dict:
    """What a policy is given of a rocket, as lists, saved with its weights: the target orbit in its own axes, mu = 1.

    `axes` (3, 3), rows towards the perigee, along the semi-latus rectum and normal to the plane; `units` (7,) of r, v
    and m (the Earth's radius, circular speed there, the dry mass); angular momentum `h_target` and eccentricity vector
    `e_target` (3,); `phases`, what is observed of each burn; `nominal_flight` (steps + 1, 9), rows of burn, specific
    energy and seven quantities, which a dispersed training fills, and the `differences` (7,) by which flights differ.
    """
    axes = target_axes(rocket)
    steps = int(np.ceil(rocket.end_time / rocket.dt))
    h_target, e_target = target_orbit(rocket.target, rocket.mu)
    length, speed = rocket.Re, (rocket.mu / rocket.Re) ** 0.5  # 6378 km and 7.9 km/s
    return {
        "axes": axes.tolist(),
        "units": [length] * 3 + [speed] * 3 + [rocket.dry_mass],
        "h_target": (axes @ h_target / (length * speed)).tolist(),
        "e_target": (axes @ e_target).tolist(),
        "phases": np.linspace(0.0, 1.0, len(rocket.burns)).tolist(),
        "differences": DIFFERENCES,
        "nominal_flight": np.zeros((steps + 1, 2 + len(DIFFERENCES))).tolist(),
    }
