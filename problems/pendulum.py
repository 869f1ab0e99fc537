"""A pendulum is brought upright and held, from any angle and rate of a box."""

import numpy as np

import envs

PENDULUM = envs.Problem(
    env_id="PendulumUpright-v0",
    f=lambda x, u: (x[1], np.sin(x[0]) + u),  # the angle is counted from upright
    u_max=1.5,  # a motor that holds it anywhere: its weight pulls with 1 at most
    phases=(envs.Phase(steps=60, target=(0.0, 0.0), radius=0.05, R=0.1, Qf=20.0, bonus=20.0),),
    x0_max=(np.pi, 1.0),
    x_max=(60.0, 16.0),  # |x2| <= 1 + (1 + u) T
    x_scale=(2.0, 1.0),
    x_names=("angle (rad)", "rate (rad/s)"),
    u_names=("torque",),
)
envs.register_problem(PENDULUM)
