"""Rendezvous by impulses: a chaser comes from 15 km to 1 km behind a target, inside a cone about the target's axis.

Source: Federici, Benedikter, Zavoli, Deep Learning Techniques for Autonomous Spacecraft Guidance During Proximity
Operations, AIAA 2021-0668, and their code, github.com/LorenzoFederici/DL-rendezvous-guidance.

Positions are in m, velocities in m/s, impulses in units of the greatest. The axes are Hill's: x radial, y along the
target's orbit, z normal to it.
"""

import numpy as np

import envs

OMEGA = 8.5193e-4  # rad/s, of the target's circular orbit
DT = 200.0  # s between two impulses
GREATEST = 5.0  # m/s
S, C = np.sin(OMEGA * DT), np.cos(OMEGA * DT)
EDGE = np.tan(np.radians(20.0))  # of the cone, which is a pyramid of four sides about -y


def impulse(x, u, w):
    """The state after an impulse u, an acceleration w (m/s^2) that acts as one, too, and DT of free flight.

    The flight is the closed form of Hill, Clohessy and Wiltshire.
    """
    x, y, z, *velocity = x
    vx, vy, vz = (v + GREATEST * du + DT * dw for v, du, dw in zip(velocity, u, w))
    return (
        (4 - 3 * C) * x + (S * vx + 2 * (1 - C) * vy) / OMEGA,
        6 * (S - OMEGA * DT) * x + y + (-2 * (1 - C) * vx + (4 * S - 3 * OMEGA * DT) * vy) / OMEGA,
        C * z + S / OMEGA * vz,
        3 * OMEGA * S * x + C * vx + 2 * S * vy,
        -6 * OMEGA * (1 - C) * x - 2 * S * vx + (4 * C - 3) * vy,
        -OMEGA * S * z + C * vz,
    )


def length(size, *vector):
    """The norm, rounded below `size`: IPOPT cannot have a kink, and the best flight has many impulses of 0."""
    return np.sqrt(sum(value**2 for value in vector) + size**2) - size


RENDEZVOUS = envs.Problem(
    env_id="Rendezvous-v0",
    step=impulse,
    noise=(1e-5, 1e-5, 5e-7),  # m/s^2
    u_max=(1.0, 1.0, 1.0),
    u_norm=(0.0, 1.0),
    u_scale=0.02,  # 0.1 m/s
    phases=(
        envs.Phase(
            steps=30,
            target=(0.0, -1000.0, 0.0, None, None, None),
            radius=0.5,
            running=lambda x, u: GREATEST * length(2e-5, *u),
            # the last impulse stops the chaser; a metre off costs 0.05 m/s
            terminal=lambda x: length(1e-4, *x[3:]) + 0.05 * length(0.1, x[0], x[1] + 1000, x[2]),
        ),
    ),
    dt=DT,
    constraints=lambda x, u: tuple(side + EDGE * x[1] for side in (x[0], -x[0], x[2], -x[2])),
    constraint_price=2e-4,
    constraint_margin=3.0,
    x0=(0.0, -15e3, 0.0, 0.0, 0.0, 0.0),
    x0_max=(1500.0, 1500.0, 75.0, 0.0, 0.0, 0.0),
    x_max=(3e5, 2e6, 3e5, 400.0, 800.0, 400.0),
    x_scale=(5e3, 5e3, 100.0, 5.0, 5.0, 0.1),
    x_names=("radial (m)", "along track (m)", "normal (m)", "radial (m/s)", "along track (m/s)", "normal (m/s)"),
    u_names=("radial", "along track", "normal"),
    single_optimum=True,
)
envs.register_problem(RENDEZVOUS)
