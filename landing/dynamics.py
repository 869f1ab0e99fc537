"""The flight of a lander while its thrust is held: a closed form for NumPy arrays and CasADi symbols.

r' = v, v' = T / m + g, m' = -|T| / c with constant T and g. The mass falls linearly, and both integrals are elementary.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from common.integration import falling_root
from landing.lander import Lander

TINY = 1e-300  # keeps a division by q finite where h, and so q, is 0


def burn(r, v, mass, direction, flow, g, h, exhaust, log1p=np.log1p):
    """The state (r, v, m) after h seconds of thrust. direction is a unit vector, flow the propellant in kg/s, above 0.

    With the mass m' = m - flow h at the end, q = (m - m') / m', and c the exhaust velocity:

        v' = v + g h + c direction ln(1 + q)
        r' = r + v h + g h^2 / 2 + c direction h (1 - ln(1 + q) / q)
    """
    after = mass - flow * h
    q = flow * h / after
    log = log1p(q)
    push = exhaust * direction
    rise = h * (1 - log / (q + TINY))
    return r + v * h + g * (0.5 * h * h) + push * rise, v + g * h + push * log, after


class Arc(NamedTuple):
    """A step of n flights: the state at its begin, and the thrust and gravity that are held during it."""

    r: np.ndarray  # (3, n)
    v: np.ndarray  # (3, n)
    mass: np.ndarray  # (n,)
    direction: np.ndarray  # (3, n) of the thrust
    flow: np.ndarray  # (n,) kg/s
    g: np.ndarray  # (3, n)

    def of(self, chosen) -> Arc:
        """The arc of the chosen flights, a mask or indices."""
        return Arc(*(array[..., chosen] for array in self))

    def after(self, h, lander: Lander):
        """(r, v, m) after h seconds, a number or (n,). At the dry mass the thrust ends."""
        left = (self.mass - lander.dry_mass) / self.flow  # s of propellant
        if (left > h).all():
            return burn(*self, h, lander.exhaust)
        burning = np.clip(left, 0.0, h)
        r, v, mass = burn(*self, burning, lander.exhaust)
        coasting = np.maximum(h - burning, 0.0)
        r = r + v * coasting + self.g * (0.5 * coasting**2)
        return r, v + self.g * coasting, np.maximum(mass, lander.dry_mass)

    def touchdown(self, h: float, end, lander: Lander):
        """The flights that touch the ground within h seconds, and the times in s: a mask (n,) and times (n,).

        `end` is (r, v, m) after h. A flight that begins on the ground does not touch it. A soft touchdown is a dip: its
        thrust, held on, would lift the lander off again. The acceleration along z grows while the mass falls, so the
        altitude has at most one lowest point.
        """
        low = end[0][2].copy()
        until = np.full(len(self.mass), h)
        dips = np.flatnonzero((low > 0) & (self.r[2] > 0) & (self.v[2] < 0) & (end[1][2] > 0))
        if len(dips):
            some = self.of(dips)
            until[dips] = falling_root(
                lambda t: -some.after(t, lander)[1][2], -some.v[2], -end[1][2][dips], until[dips]
            )
            low[dips] = some.after(until[dips], lander)[0][2]
        touches = (low <= 0) & (self.r[2] > 0)
        there = np.flatnonzero(touches)
        if len(there):
            some = self.of(there)
            until[there] = falling_root(lambda t: some.after(t, lander)[0][2], some.r[2], low[there], until[there])
        return touches, until
