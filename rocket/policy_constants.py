"""What a policy is told of a rocket beside its observations: constants that are saved with its weights."""

from __future__ import annotations

import numpy as np

from rocket.orbits import target_axes, target_orbit
from rocket.vehicle import Rocket

# Flights at dispersion 1 differ by about these sizes at the same energy of the same burn. The numbers are the three
# components of (h - h_T) / |h_T|, the three of e - e_T, the logarithm of the observed mass, and the angle flown in rad.
DIFFERENCES = [5e-5, 5e-5, 5e-5, 1e-4, 3e-4, 2e-5, 0.01, 0.004]
NEAR = 10.0  # such sizes, up to which a network's blocks see a difference; healthy flights hardly go beyond
FAR = 100.0  # up to which its direct path does: so far a quarter less thrust of the last stage moves the orbit


def policy_constants(rocket: Rocket) -> dict:
    """The constants of a policy for a rocket, as lists, in units in which mu = 1 and in the target orbit's axes.

    - `axes` (3, 3): rows to the perigee, along the semi-latus rectum and normal to the plane
    - `units` (7,) of r, v and m: the Earth's radius (m), the circular speed there (m/s) and the dry mass (kg)
    - `h_target` and `e_target` (3,) each: angular momentum and eccentricity vector
    - `phases`: the observed phase of each burn
    - `nominal_flight` (steps + 1, 10): rows of burn, specific energy and the 8 numbers by which flights are compared; a
      dispersed training fills it
    - `differences` (8,): the sizes of those numbers' differences
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
