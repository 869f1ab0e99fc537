"""Rendezvous by impulses: a chaser comes from 15 km to 1 km behind a target, inside a cone about the target's axis.

Source: Federici, Benedikter, Zavoli, Deep Learning Techniques for Autonomous Spacecraft Guidance During Proximity
Operations, AIAA 2021-0668, and their code, github.com/LorenzoFederici/DL-rendezvous-guidance.

Positions are in km, velocities in m/s. The axes are Hill's: x radial, y along the target's orbit, z normal to it.
"""

import numpy as np

import envs

OMEGA = 8.5193e-4  # rad/s, of the target's circular orbit
DT = 200.0  # s between two impulses
S, C = np.sin(OMEGA * DT), np.cos(OMEGA * DT)
SWING = 1e-3 / OMEGA  # km for each m/s
WIDTH = np.tan(np.radians(20.0))  # of the cone, half
ACCELERATION = (0.01, 0.01, 0.0005)  # mm/s^2, disturbances of a step


def drift(x, y, z, vx, vy, vz):
    """DT of free flight, the closed form of Hill, Clohessy and Wiltshire."""
    return (
        (4 - 3 * C) * x + SWING * (S * vx + 2 * (1 - C) * vy),
        6 * (S - OMEGA * DT) * x + y + SWING * (-2 * (1 - C) * vx + (4 * S - 3 * OMEGA * DT) * vy),
        C * z + SWING * S * vz,
        3 * S / SWING * x + C * vx + 2 * S * vy,
        -6 * (1 - C) / SWING * x - 2 * S * vx + (4 * C - 3) * vy,
        -S / SWING * z + C * vz,
    )


def after_impulse(x, u, w):
    """The state after an impulse u (m/s), an acceleration w (mm/s^2) that acts as an impulse, too, and DT of flight."""
    kick = [du + 1e-3 * DT * dw for du, dw in zip(u, w)]
    return drift(*x[:3], *(v + dv for v, dv in zip(x[3:], kick)))


def length(*vector):
    """The norm, rounded at 1e-4: IPOPT cannot have a kink, and the best flight drifts for many steps."""
    return np.sqrt(sum(value**2 for value in vector) + 1e-8) - 1e-4


def beyond_cone(x, u):
    """What is to be at most 0: the four sides of a pyramid about -y."""
    edge = -WIDTH * x[1]
    return x[0] - edge, -x[0] - edge, x[2] - edge, -x[2] - edge


RENDEZVOUS = envs.Problem(
    env_id="Rendezvous-v0",
    step=after_impulse,
    noise=ACCELERATION,
    u_max=(5.0, 5.0, 5.0),
    u_norm=(0.0, 5.0),
    u_scale=0.3,
    phases=(
        envs.Phase(
            steps=30,
            target=(0.0, -1.0, 0.0, None, None, None),
            radius=0.0005,
            bonus=10.0,
            running=lambda x, u: length(*u),
            terminal=lambda x: length(*x[3:]) + 50 * length(x[0], x[1] + 1, x[2]),  # the last impulse stops the chaser
        ),
    ),
    dt=DT,
    constraints=beyond_cone,
    constraint_price=0.1,
    x0=(0.0, -15.0, 0.0, 0.0, 0.0, 0.0),
    x0_max=(1.5, 1.5, 0.075, 0.0, 0.0, 0.0),
    x_max=(300.0, 2000.0, 300.0, 400.0, 800.0, 400.0),
    x_scale=(5.0, 5.0, 0.1, 5.0, 5.0, 0.1),
    x_names=(
        "radial (km)",
        "along track (km)",
        "out of plane (km)",
        "radial (m/s)",
        "along track (m/s)",
        "out of plane (m/s)",
    ),
    u_names=("radial (m/s)", "along track (m/s)", "out of plane (m/s)"),
    single_optimum=True,
)
envs.register_problem(RENDEZVOUS)
