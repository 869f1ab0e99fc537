"""Target orbits that are drawn anew for each flight.

A target has five elements: a (m), e, i, raan and argp (degrees). `aim.py` has what the environment makes of them.
Reading order: the ranges, the plane through the launch site, forms of a target.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import product

import numpy as np

from common.errors import is_finite, refuse_unless
from rocket.vehicle import OrbitalElements, Rocket

ELEMENTS = ("a", "e", "i", "raan", "argp")


@dataclass(frozen=True)
class Targets:
    """The range (low, high) of each number that describes a target orbit. Raises BadInput for a range that cannot be.

    The plane through the launch site has the rocket's own direction, north or south. In the natural place the perigee
    lies as many degrees after the launch site as in the rocket's own orbit.
    """

    perigee_km: tuple[float, float]  # altitude above Re
    apogee_km: tuple[float, float]  # altitude above Re, drawn uniformly in its logarithm; at least the perigee's
    i_deg: tuple[float, float]
    raan_deg: tuple[float, float] = (0.0, 0.0)  # relative to the plane through the launch site at t = 0
    argp_deg: tuple[float, float] = (0.0, 0.0)  # relative to the natural place

    def __post_init__(self):
        for each in fields(self):
            name, value = f"targets' {each.name}", getattr(self, each.name)
            pair = isinstance(value, tuple) and len(value) == 2 and all(is_finite(number) for number in value)
            refuse_unless(pair, name, repr(value), "must be (low, high), two finite numbers")
            refuse_unless(value[0] <= value[1], name, value, "must be (low, high) with low at most high")
        for name in ("perigee_km", "apogee_km"):
            refuse_unless(getattr(self, name)[0] > 0, f"targets' {name}", getattr(self, name), "must be positive")
        highest, allowed = self.apogee_km[1], f"must be at least the highest perigee, {self.perigee_km[1]}"
        refuse_unless(highest >= self.perigee_km[1], "targets' apogee_km", self.apogee_km, allowed)
        within = 0 <= self.i_deg[0] and self.i_deg[1] <= 180
        refuse_unless(within, "targets' i_deg", self.i_deg, "must be between 0 and 180")

    def at(self, shares, rocket: Rocket) -> np.ndarray:
        """The targets (n, 5) at the shares (n, 5) of the ranges, each from 0 to 1, in the order of the fields."""
        shares = np.asarray(shares, dtype=np.float64)
        low, high = np.array([getattr(self, each.name) for each in fields(self)]).T
        low[1], high[1] = np.log(low[1]), np.log(high[1])
        perigee, log_apogee, i, raan, argp = (low + shares * (high - low)).T
        perigee_radius = rocket.Re + 1e3 * perigee
        apogee_radius = rocket.Re + 1e3 * np.maximum(np.exp(log_apogee), perigee)
        a = (perigee_radius + apogee_radius) / 2
        node, site = launch_plane(rocket, i)
        _, own_site = launch_plane(rocket, np.array(rocket.i))
        e = (apogee_radius - perigee_radius) / (2 * a)
        return np.column_stack([a, e, i, (node + raan) % 360, (site + rocket.argp - own_site + argp) % 360])

    def corners(self, rocket: Rocket) -> np.ndarray:
        """The targets (n, 5) at the ends of the ranges, and the one in the middle of all ranges, which comes first."""
        ends = [(0.0, 1.0) if low < high else (0.0,) for low, high in vars(self).values()]
        return self.at([[0.5] * len(ends), *product(*ends)], rocket)


def launch_plane(rocket: Rocket, i):
    """The node's right ascension and the launch site's argument of latitude, degrees (n,) each, of planes through it.

    i (n,) are inclinations in degrees. Launches go south if the rocket's own orbit is nearer to a launch to the south.
    """
    north, _ = site_plane(rocket.latitude, rocket.i)
    goes_south = np.cos(np.radians(180 - north - rocket.raan)) > np.cos(np.radians(north - rocket.raan)) + 1e-9
    node, site = site_plane(rocket.latitude, i)
    return (180 - node, 180 - site) if goes_south else (node, site)


def site_plane(latitude: float, i):
    """`launch_plane` of launches towards the north, from a latitude in degrees."""
    latitude, i = np.radians(latitude), np.radians(i)
    with np.errstate(divide="ignore", invalid="ignore"):  # an equatorial orbit has no node
        along = np.nan_to_num(np.tan(latitude) / np.tan(i), nan=0.0)
        above = np.nan_to_num(np.sin(latitude) / np.sin(i), nan=0.0)
    along, above = (np.degrees(np.arcsin(np.clip(ratio, -1, 1))) for ratio in (along, above))
    return -along, above


def own_target(rocket: Rocket) -> np.ndarray:
    """The rocket's own orbit as a target (5,)."""
    return np.array([getattr(rocket, name) for name in ELEMENTS])


def elements_of(targets) -> OrbitalElements:
    """The elements (n,) each, in m and rad, of targets (n, 5)."""
    a, e, *angles = np.asarray(targets, dtype=np.float64).T
    return OrbitalElements(a, e, *np.radians(angles))
