"""Goddard's rocket: how high can it rise straight up on its propellant, in air?

The classic constants, without units (Tsiotras and Kelley 1991; Bryson, Dynamic Optimization, 1999): the greatest height
is 1.01283 from the Earth's centre, an altitude of 0.01283. The optimum has an arc of part thrust (a singular arc).
"""

import numpy as np

import envs

EXHAUST, EMPTY = 0.5, 0.6  # exhaust velocity, mass without propellant
DRAG, DECAY = 310.0, 500.0  # of the air, and its decay with altitude


def goddard(x, u):
    """Altitude, velocity and mass; u is the thrust. Without propellant there is none."""
    altitude, velocity, mass = x
    thrust = np.where(mass > EMPTY, u, 0.0)
    drag = DRAG * velocity * np.abs(velocity) * np.exp(-DECAY * np.maximum(altitude, 0.0))
    return velocity, (thrust - drag) / mass - 1 / (1 + altitude) ** 2, -thrust / EXHAUST


GODDARD = envs.Problem(
    env_id="Goddard-v0",
    f=goddard,
    u_max=3.5,
    u_min=0.0,
    phases=(
        envs.Phase(
            steps=60,
            end=lambda x: x[1],  # the top: the velocity falls through 0
            terminal=lambda x: -100 * x[0],
        ),
    ),
    dt=0.005,
    x0=(0.0, 0.0, 1.0),
    x0_max=0.0,  # one start
    bounds=(None, None, (EMPTY, None)),
    bound_price=300.0,  # `baselines.py` says what is needed: 135
    x_max=(0.1, 1.0, 1.0),
    x_scale=(0.01, 0.1, 0.3),
    x_names=("altitude", "velocity", "mass"),
    u_names=("thrust",),
)
envs.register_problem(GODDARD)
