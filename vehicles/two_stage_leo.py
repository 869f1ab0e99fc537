"""A second vehicle, an example of a rocket of your own: two stages to a circular orbit of 400 km and 51.6 degrees.

It resembles a Falcon 9 without landing, with a payload of 20 t to the space station's orbit. The numbers are rounded
from what is public of it (stage 1: 411 t of propellant, 22.2 t dry, 7.6 MN at sea level, 162 s; stage 2: 107.5 t, 4 t
dry, 934 kN, 348 s of specific impulse, which make 393 s; 3.7 m across): an example, not a model of that launcher.
"""

import envs

STAGE_1 = envs.Engine(total_mass=433e3, propellant=411e3, thrust=7.6e6, isp=306.0, burn_time=162.0)
STAGE_2 = envs.Engine(total_mass=111.5e3, propellant=107.5e3, thrust=934e3, isp=348.0, burn_time=393.0)

ROCKET = envs.Rocket(
    burns=(
        envs.Burn(162.0, ((1, STAGE_1),), dropped=((1, STAGE_1),)),
        envs.Burn(555.0, ((1, STAGE_2),)),
    ),
    payload=20e3,
    Cd=0.5,
    S=10.5,
    latitude=28.5,
    a=6778145.0,  # 400 km above Re
    e=0.0,
    i=51.6,
    raan=envs.launch_raan(28.5, 51.6),  # the plane of the launch site at lift-off
    argp=0.0,  # a circle has none; its angles are counted from the node
    end_time=555.0,
)
envs.register_rocket("TwoStageLEO-v0", ROCKET, cutoff=True)
