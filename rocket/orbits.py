"""Orbits: the orbit that a state is on, its distance from the target orbit, and the frame in which a pilot steers.

Where a docstring says "by components", a state's components may be NumPy arrays or CasADi symbols.
"""

from __future__ import annotations

import numpy as np

from rocket.vehicle import ROCKET, OrbitalElements, Rocket


def orbit_vectors(x, mu: float = ROCKET.mu):
    """Angular momentum h = r x v (m^2/s) and eccentricity vector e = v x h / mu - r / |r| of a state by components."""
    rx, ry, rz, vx, vy, vz = x[:6]
    hx = ry * vz - rz * vy
    hy = rz * vx - rx * vz
    hz = rx * vy - ry * vx
    r = (rx * rx + ry * ry + rz * rz) ** 0.5
    ex = (vy * hz - vz * hy) / mu - rx / r
    ey = (vz * hx - vx * hz) / mu - ry / r
    ez = (vx * hy - vy * hx) / mu - rz / r
    return (hx, hy, hz), (ex, ey, ez)


def specific_energy(x, mu: float = ROCKET.mu):
    """|v|^2 / 2 - mu / |r|, in J/kg, of a state by components."""
    rx, ry, rz, vx, vy, vz = x[:6]
    return (vx * vx + vy * vy + vz * vz) / 2 - mu / (rx * rx + ry * ry + rz * rz) ** 0.5


def orbital_elements(state, mu: float = ROCKET.mu) -> OrbitalElements:
    """Keplerian elements (...,) each of states (..., 6 or more: r in m, v in m/s). |r| must be positive.

    An angle without meaning is 0: the node of an equatorial orbit, and the perigee of a circular one. The perigee of an
    equatorial orbit is counted from the x axis in the direction of flight. Source: e.g. Vallado, algorithm 9 (RV2COE).
    """
    x = np.moveaxis(np.asarray(state, dtype=np.float64), -1, 0)
    h, e = np.array(orbit_vectors(x, mu))
    energy = specific_energy(x, mu)
    a = np.divide(-mu, 2 * energy, out=np.full(energy.shape, np.inf), where=energy != 0)
    equatorial = (h[0] == 0) & (h[1] == 0)
    eccentricity = np.sqrt((e * e).sum(axis=0))
    node = np.where(equatorial, 1.0, -h[1]), np.where(equatorial, 0.0, h[0])  # z x h, of any length
    i = np.arctan2(np.hypot(h[0], h[1]), h[2])
    along = node[0] * e[0] + node[1] * e[1]
    # e . (h x node) in units of |h|, the component of e at a right angle ahead of the node
    ahead = e[0] * -h[2] * node[1] + e[1] * h[2] * node[0] + e[2] * (h[0] * node[1] - h[1] * node[0])
    argp = np.arctan2(ahead, along * np.sqrt((h * h).sum(axis=0)))
    circular = eccentricity < 1e-14
    raan = np.arctan2(node[1], node[0]) % (2 * np.pi)
    argp = np.where(circular, 0.0, argp % (2 * np.pi))
    return OrbitalElements(a, eccentricity, i, raan, argp)


def final_elements(y: np.ndarray, rocket: Rocket) -> dict:
    """The elements of states (n, 7) in the names of `final_info`."""
    elements = orbital_elements(y, rocket.mu)
    degrees = {f"{name}_deg": np.degrees(getattr(elements, name)) for name in ("i", "raan", "argp")}
    return {"a_km": elements.a / 1e3, "e": elements.e, **degrees}


def target_orbit(elements: OrbitalElements = ROCKET.target, mu: float = ROCKET.mu):
    """Angular momentum (..., 3) in m^2/s and eccentricity vector (..., 3) of orbits with these elements (m, rad)."""
    a, e, i, raan, argp = (np.asarray(element, dtype=np.float64) for element in elements)
    normal = np.stack([np.sin(raan) * np.sin(i), -np.cos(raan) * np.sin(i), np.cos(i)], axis=-1)
    perigee = [
        np.cos(raan) * np.cos(argp) - np.sin(raan) * np.sin(argp) * np.cos(i),
        np.sin(raan) * np.cos(argp) + np.cos(raan) * np.sin(argp) * np.cos(i),
        np.sin(argp) * np.sin(i),
    ]
    return np.sqrt(mu * a * (1 - e * e))[..., None] * normal, e[..., None] * np.stack(perigee, axis=-1)


def target_axes(rocket: Rocket = ROCKET, target: OrbitalElements | None = None) -> np.ndarray:
    """The target orbit's axes (..., 3, 3), unit vectors in ECI: to the perigee, along the semi-latus rectum, normal.

    `target` has the elements (...,) each of flights with targets of their own; without it, it is the rocket's. A circle
    has no perigee. Its axes are those of an ellipse with the same angles.
    """
    target = target or rocket.target
    h, e = target_orbit(target._replace(e=np.where(np.equal(target.e, 0), 0.5, target.e)), rocket.mu)
    normal = h / np.linalg.norm(h, axis=-1, keepdims=True)
    perigee = e / np.linalg.norm(e, axis=-1, keepdims=True)
    return np.stack([perigee, np.cross(normal, perigee), normal], axis=-2)


def terminal_error(state, rocket: Rocket = ROCKET, target: OrbitalElements | None = None) -> np.ndarray:
    """(h - h_T) / |h_T| and e - e_T in ECI, (..., 6), of states (..., 6 or more: r in m, v in m/s).

    `target` is as in `target_axes`. This is our measure. It is smooth and has no singularity. It is zero if and only if
    all five elements are the target's.
    """
    h, e = orbit_vectors(np.moveaxis(np.asarray(state, dtype=np.float64), -1, 0), rocket.mu)
    h_target, e_target = target_orbit(target or rocket.target, rocket.mu)
    size = np.linalg.norm(h_target, axis=-1, keepdims=True)
    of_momentum = (np.stack(h, axis=-1) - h_target) / size
    of_eccentricity = np.stack(e, axis=-1) - e_target
    return np.concatenate([of_momentum, of_eccentricity], axis=-1)


def components(axes, x):
    """The components (3, N) of vectors x (3, N) along axes (3, 3), or along each one's own axes (3, 3, N)."""
    if axes.ndim == 2:
        return axes @ x
    return (axes * x).sum(axis=1)


def local_frame(y, normal):
    """Unit vectors up, along-track (normal x up), cross-track (up x along) at states y (7, N): (3, N) each.

    `normal` (3,) is the unit normal of the target's plane, in ECI. It is (3, N) if each state has its own target.

    The products are written out, because a matrix product would round a row differently in a larger batch.
    """
    up = y[:3] / np.sqrt((y[:3] ** 2).sum(axis=0))
    rx, ry, rz = up
    nx, ny, nz = normal
    along = np.array([ny * rz - nz * ry, nz * rx - nx * rz, nx * ry - ny * rx])
    length = np.sqrt((along * along).sum(axis=0))
    cross = normal.reshape(3, -1) - (nx * rx + ny * ry + nz * rz) * up
    return up, along / length, cross / length
