"""Equations of motion. Components are NumPy arrays over environments, CasADi symbols or torch tensors."""

from __future__ import annotations

from common.integration import exp
from rocket.dispersion import wind_velocity
from rocket.vehicle import ROCKET, Rocket


def ascent_dynamics(x, u, rocket: Rocket = ROCKET, wind=None, drag_factor=None):
    """r' = v, v' = -mu r / |r|^3 + T u / m + D / m, m' = -flow (Eq. (20)).

    D = -1/2 rho Cd S |v_rel| v_rel, rho = rho0 exp(-h / H), v_rel = v - omega_e x r. The paper's drag acts "during
    atmospheric phases". This drag acts always, and fades with the density.

    - x: the components of position r (m) and velocity v (m/s), both in ECI, and the mass m (kg)
    - u: the components of the unit thrust direction in ECI, the thrust T (N) and the propellant flow (kg/s)
    - wind: (east, north) in m/s where its profile over the altitude is 1; it is subtracted from v_rel
    - drag_factor: multiplies D

    Returns the time derivative of x, by components.
    """
    rx, ry, rz, vx, vy, vz, m = x
    ux, uy, uz, thrust, flow = u
    r2 = rx * rx + ry * ry + rz * rz
    r = r2**0.5
    gravity = -rocket.mu / (r2 * r)
    push = thrust / m
    # v_rel, from which the wind is subtracted below
    relative_x = vx + rocket.omega_e * ry
    relative_y = vy - rocket.omega_e * rx
    relative_z = vz
    if wind is not None:
        blow_x, blow_y, blow_z = wind_velocity((rx, ry, rz, r), wind, rocket)
        relative_x = relative_x - blow_x
        relative_y = relative_y - blow_y
        relative_z = relative_z - blow_z
    rho = rocket.rho0 * exp((rocket.Re - r) / rocket.H)
    if drag_factor is not None:
        rho = drag_factor * rho
    speed = (relative_x * relative_x + relative_y * relative_y + relative_z * relative_z) ** 0.5
    drag = (-0.5 * rocket.Cd * rocket.S) * rho * speed / m
    ax = gravity * rx + push * ux + drag * relative_x
    ay = gravity * ry + push * uy + drag * relative_y
    az = gravity * rz + push * uz + drag * relative_z
    return vx, vy, vz, ax, ay, az, -flow
