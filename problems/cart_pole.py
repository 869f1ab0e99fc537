"""Cart-pole swing-up: a pole that hangs from a cart is swung up, the cart a metre away, in two seconds.

Kelly, An Introduction to Trajectory Optimization, SIAM Review 59 (2017), section 6: the least integral of the squared
force. There the end is a point, here a small circle with a terminal cost, which a policy can learn.
"""

import numpy as np

import envs

CART, POLE = 1.0, 0.3  # kg
LENGTH, GRAVITY = 0.5, 9.81  # m, m/s^2
TARGET = (1.0, np.pi, 0.0, 0.0)


def cart_pole(x, u):
    """Cart position and pole angle (0: hanging), their velocities; u is the force on the cart."""
    _, angle, speed, rate = x
    sin, cos = np.sin(angle), np.cos(angle)
    mass = CART + POLE * (1 - cos * cos)
    acceleration = (LENGTH * POLE * sin * rate**2 + u + POLE * GRAVITY * cos * sin) / mass
    turn = -(LENGTH * POLE * cos * sin * rate**2 + u * cos + (CART + POLE) * GRAVITY * sin) / (LENGTH * mass)
    return speed, rate, acceleration, turn


def miss(x):
    """The terminal cost: it grows as the distance to the target, not as its square, which would drown all else."""
    distance2 = sum((xi - target) ** 2 for xi, target in zip(x, TARGET))
    return 100 * (np.sqrt(distance2 + 0.05**2) - 0.05)


CART_POLE = envs.Problem(
    env_id="CartPoleSwingUp-v0",
    f=cart_pole,
    u_max=20.0,  # N
    phases=(
        envs.Phase(
            steps=25,
            target=TARGET,
            radius=0.1,
            bonus=50.0,
            running=lambda x, u: u**2,
            terminal=miss,
        ),
    ),
    dt=0.08,
    substeps=4,
    x0=(0.0, 0.0, 0.0, 0.0),
    x0_max=0.0,  # one start
    x_max=(50.0, 200.0, 50.0, 200.0),
    x_scale=(1.0, 2.0, 2.0, 5.0),
    velocities=(2, 3),
    x_names=("cart (m)", "pole (rad)", "cart (m/s)", "pole (rad/s)"),
    u_names=("force (N)",),
)
envs.register_problem(CART_POLE)
