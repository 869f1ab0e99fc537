"""Navigation noise: the observed position and velocity differ from the true ones by new random numbers in each step.

The noise is white and normal, and its three components have the same standard deviation. Physics, events and the
cut-off have the exact state.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from common.errors import is_finite, refuse_unless

OBSERVED = 6  # r and v
LARGEST_NOISE = 1e4  # m and m/s
LARGEST_SCORE = 10.0  # standard deviations, which no normal number of NumPy exceeds
NOMINAL_FLIGHT = 10**6  # the nominal flight's number in an evaluation; all other flights have smaller numbers
ALLOWED = f"must be two numbers from 0 to {LARGEST_NOISE:g}, standard deviations in m and m/s"


def is_noise(value) -> bool:
    """Whether `value` can be the option `navigation_noise`: None or 0 for no noise, or two numbers."""
    if value is None or (is_finite(value) and value == 0):
        return True
    if not isinstance(value, list | tuple | np.ndarray) or len(value) != 2:
        return False
    return all(is_finite(sigma) and 0 <= sigma <= LARGEST_NOISE for sigma in value)


def checked_noise(value) -> tuple[float, float] | None:
    """The option `navigation_noise` as (m, m/s), or None without noise. Raises BadInput if it is neither."""
    refuse_unless(is_noise(value), "navigation_noise", repr(value), ALLOWED)
    if value is None or not np.any(value):
        return None
    position, velocity = value
    return float(position), float(velocity)


def deviations(noise: tuple[float, float] | None) -> np.ndarray:
    """Standard deviations (6,) of r (m) and v (m/s)."""
    return np.repeat(noise or (0.0, 0.0), 3)


def flight_noise(eval_seed: int, flights: Iterable[int], steps: int) -> np.ndarray:
    """Standard scores (m, steps, 6) of m flights of a seed. They are the same for every policy and law.

    A flight's scores do not depend on the other flights or on the number of steps.
    """
    streams = (np.random.default_rng([eval_seed, 6, flight]) for flight in flights)
    return np.stack([stream.standard_normal((steps, OBSERVED)) for stream in streams])


def noise_metrics(noise) -> dict:
    """The noise's entries of eval.json. There are none without noise."""
    checked = checked_noise(noise)
    if checked is None:
        return {}
    position, velocity = checked
    return {"navigation_noise_m": position, "navigation_noise_m_s": velocity}
