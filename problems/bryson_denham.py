"""The Bryson-Denham problem: from velocity 1 to -1 in a second with least effort, without going further than 1/9.

Bryson and Ho, Applied Optimal Control (1975), section 3.11: the least J = 1/2 integral of u^2 is 4. The state x may not
exceed its bound l = 1/9 on the way, and the optimum moves along it for a while.
"""

import envs

BRYSON_DENHAM = envs.Problem(
    env_id="BrysonDenham-v0",
    f=lambda x, u: (x[1], u),
    u_max=10.0,
    phases=(
        envs.Phase(
            steps=25,
            target=(0.0, -1.0),
            radius=0.01,
            bonus=20.0,
            running=lambda x, u: 0.5 * u**2,
        ),
    ),
    dt=0.04,
    x0=(0.0, 1.0),
    x0_max=0.0,  # one start
    bounds=((None, 1 / 9), None),
    bound_price=150.0,  # `baselines.py` says what is needed: 69
    x_max=(7.0, 12.0),  # |v| <= 1 + u T, |x| <= T + u T^2 / 2
    x_scale=(0.1, 1.0),
    x_names=("position x", "velocity v"),
)
envs.register_problem(BRYSON_DENHAM)
