"""What a policy is given of a rocket beside its observations: constants that are saved with its weights."""

from __future__ import annotations

import numpy as np

from rocket.orbits import target_axes, target_orbit
from rocket.vehicle import Rocket

# sizes by which flights at dispersion 1 differ at the same energy of the same burn: the three components of
# (h - h_T) / |h_T| and those of e - e_T, the logarithm of the observed mass, the angle flown in rad
DIFFERENCES = [5e-5, 5e-5, 5e-5, 1e-4, 3e-4, 2e-5, 0.01, 0.004]
# for flights that lose thrust: a quarter less of the last stage's moves the orbit by up to a hundred of those
WIDE_DIFFERENCES = [10 * size for size in DIFFERENCES[:6]] + DIFFERENCES[6:]


def policy_constants(rocket: Rocket) -> dict:
    """What a policy is given of a rocket, as lists, saved with its weights: the target orbit in its own axes, mu = 1.

    `axes` (3, 3), rows towards the perigee, along the semi-latus rectum and normal to the plane; `units` (7,) of r, v
    and m (the Earth's radius, circular speed there, the dry mass); angular momentum `h_target` and eccentricity vector
    `e_target` (3,); `phases`, what is observed of each burn; `nominal_flight` (steps + 1, 10), rows of burn, specific
    energy and what flights are compared by, which a dispersed training fills; `differences` (8,), the sizes of those,
    which a training with failures makes wide.
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
