"""A range of targets of your own, an example: the paper's rocket to low orbits, circular, polar and sun-synchronous.

The corners of the range are in the vehicle's reach. With apogees of 8000 km one of them would not be.
"""

from envs import ROCKET, Targets, register_rocket

LOW_ORBITS = Targets(
    perigee_km=(180.0, 400.0),
    apogee_km=(200.0, 6000.0),
    i_deg=(28.6, 100.0),
    raan_deg=(-2.0, 2.0),
    argp_deg=(-6.0, 6.0),
)
register_rocket("RocketAscentLowOrbits-v0", ROCKET, cutoff=True, targets=LOW_ORBITS)
