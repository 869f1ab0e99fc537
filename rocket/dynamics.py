"""Equations of motion: x is a tuple of components, each a NumPy array over environments or a CasADi symbol."""

from __future__ import annotations

import numpy as np

from rocket.dispersion import wind_velocity
from rocket.vehicle import ROCKET, Rocket


def ascent_dynamics(x, u, rocket: Rocket = ROCKET, wind=None, drag_factor=None):
    """r' = v, v' = -mu r / |r|^3 + T u / m + D / m, m' = -flow ("Multiphase Rocket Ascent Problem").

    D = -1/2 rho Cd S |v_rel| v_rel, rho = rho0 exp(-h / H), v_rel = v - omega_e x r. x: r, v, m by components; u: the
    unit thrust direction by components, thrust T (N) and propellant flow (kg/s). The paper's drag acts "during
    atmospheric phases", this one always: it fades with the density.

    A wind (east, north; m/s where its profile over the altitude is 1) is taken from v_rel, a factor multiplies D.
    """
    rx, ry, rz, vx, vy, vz, m = x
    ux, uy, uz, thrust, flow = u
    r2 = rx * rx + ry * ry + rz * rz
    r = r2**0.5
    gravity, push = -rocket.mu / (r2 * r), thrust / m
    wx, wy, wz = vx + rocket.omega_e * ry, vy - rocket.omega_e * rx, vz  # v_rel
    if wind is not None:
        blow_x, blow_y, blow_z = wind_velocity((rx, ry, rz, r), wind, rocket)
        wx, wy, wz = wx - blow_x, wy - blow_y, wz - blow_z
    rho = rocket.rho0 * np.exp((rocket.Re - r) / rocket.H)
    if drag_factor is not None:
        rho = drag_factor * rho
    drag = (-0.5 * rocket.Cd * rocket.S) * rho * (wx * wx + wy * wy + wz * wz) ** 0.5 / m
    ax = gravity * rx + push * ux + drag * wx
    ay = gravity * ry + push * uy + drag * wy
    az = gravity * rz + push * uz + drag * wz
    return vx, vy, vz, ax, ay, az, -flow
