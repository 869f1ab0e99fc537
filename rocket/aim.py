"""What flights aim at: one target orbit, or each flight its own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rocket.orbits import components, target_axes, target_orbit
from rocket.targets import elements_of
from rocket.vehicle import OrbitalElements, Rocket

OBSERVED_TARGET = 8  # numbers that a flight shows of its own target


class Aim(NamedTuple):
    """What N flights aim at: one target orbit, or each flight its own."""

    elements: OrbitalElements  # m and rad, one orbit's or (N,)
    energy: np.ndarray | float  # J/kg, () or (N,)
    axes: np.ndarray  # the target's axes (3, 3) or (3, 3, N)
    momentum_axes: np.ndarray  # the same over |h|
    orbit: np.ndarray  # h / |h| and e in these axes, (6, 1) or (6, N)
    seen: np.ndarray | None  # (N, OBSERVED_TARGET), what each flight shows of its own target


def aim_at(rocket: Rocket, targets: np.ndarray | None = None) -> Aim:
    """The Aim at the rocket's own orbit, or at targets (N, 5)."""
    elements = rocket.target if targets is None else elements_of(targets)
    axes = target_axes(rocket, elements)
    h, e = target_orbit(elements, rocket.mu)
    if targets is None:
        momentum_axes = axes / np.linalg.norm(h)
        orbit = np.concatenate([momentum_axes @ h, axes @ e])[:, None]
        return Aim(elements, rocket.target_energy, axes, momentum_axes, orbit, None)
    energy = -rocket.mu / (2 * elements.a)
    momentum = np.linalg.norm(h, axis=1)
    seen = np.column_stack([axes[:, 0], axes[:, 2], momentum, elements.e])
    axes = np.moveaxis(axes, 0, -1)
    momentum_axes = axes / momentum
    orbit = np.concatenate([components(momentum_axes, h.T), components(axes, e.T)])
    return Aim(elements, energy, axes, momentum_axes, orbit, seen)
