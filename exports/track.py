"""A flight around the Earth for OEM and CZML, and its place over the ground."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Track(NamedTuple):
    """Positions and velocities of one flight in an inertial frame.

    The origin is the Earth's centre, z its axis. At lift-off, t = 0, the x axis points to the meridian of the launch
    site.
    """

    name: str
    t: np.ndarray  # (K+1,) s after lift-off
    r: np.ndarray  # (K+1, 3) m
    v: np.ndarray  # (K+1, 3) m/s
    events: list[tuple[float, str]]  # s after lift-off, and what happens
    radius: float  # m, the radius of the sphere above which altitudes count
    turn_rate: float  # rad/s, the Earth's rotation


def turned(vectors: np.ndarray, angle: float) -> np.ndarray:
    """Vectors (n, 3) turned about z by an angle in rad. They are the same vectors in axes that lie this far behind."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.column_stack([c * x - s * y, s * x + c * y, z])


def over_ground(track: Track, launch_longitude: float) -> dict[str, np.ndarray]:
    """Altitude (m), geocentric latitude and longitude (degrees, -180 to 180) over the turning sphere, (K+1,) each."""
    x, y, z = track.r.T
    east = np.degrees(np.arctan2(y, x) - track.turn_rate * track.t) + launch_longitude
    return {
        "altitude_m": np.linalg.norm(track.r, axis=1) - track.radius,
        "latitude_deg": np.degrees(np.arctan2(z, np.hypot(x, y))),
        "longitude_deg": (east + 180.0) % 360.0 - 180.0,
    }
