"""Missions: a vehicle and the rules that it flies by, under an environment id.

`ROCKETS` is what environments, references, evaluation, figures and the script read; `register_rocket` adds to it. The
target orbit is the `Rocket`'s own (`vehicle.py`); what counts as a success is in `metrics.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.errors import is_finite, refuse_unless
from rocket.vehicle import ROCKET, Rocket


@dataclass(frozen=True)
class Mission:
    """A registered rocket."""

    rocket: Rocket
    cutoff: bool = False  # the engine stops at the target's energy; without it at end_time
    ceiling_km: float | None = None  # altitude beyond which an overshoot is penalised, and the reference's bound
    floor_km: float = 110.0  # altitude below which a flight is penalised, from `floor_from` on
    floor_from: float = 300.0  # s
    guided_until: float | None = None  # s until which R_guidance has a reference pitch (none: the first burn's end)
    mass_unit: float | None = None  # kg of propellant that `mass_weight` is the price of (none: 6 % of the dry mass)

    def __post_init__(self):
        for name in ("ceiling_km", "floor_km", "floor_from", "guided_until", "mass_unit"):
            value = getattr(self, name)
            number, optional = is_finite(value), name not in ("floor_km", "floor_from")
            allowed = "must be positive and finite, or None" if optional else "must be a finite number"
            possible = value is None or (number and value > 0) if optional else number
            refuse_unless(possible, f"a mission's {name}", value, allowed)

    @property
    def ceiling(self) -> float:
        """m; infinite where there is none."""
        return np.inf if self.ceiling_km is None else 1e3 * self.ceiling_km


# the paper penalises an overshoot beyond 250 km; until 150.4 s the boosters burn; at the fixed time speed has to be
# wasted, and too flat a climb wastes it as well: with a floor of 110 km two of three seeds flew along it
PAPER_MISSION = Mission(ROCKET, ceiling_km=250.0, floor_km=130.0, guided_until=ROCKET.burns[1].end, mass_unit=100.0)
ROCKETS: dict[str, Mission] = {}  # by environment id; `envs.py` and the files of `vehicles/` fill it
