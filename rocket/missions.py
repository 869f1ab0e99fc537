"""Missions: a vehicle and the rules that it flies by, under an environment id.

Environments, references, evaluations, figures and the script read `ROCKETS`. `register_rocket` adds to it. The target
orbit is a field of `Rocket` (`vehicle.py`). `metrics.py` says what counts as a success.

Registering a rocket needs this table alone. Its environment (`environment.py`) is imported when one is made.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields

import numpy as np

from common.errors import BadInput, is_finite, refuse_unless
from common.registration import register
from rocket.targets import Targets
from rocket.vehicle import ROCKET, Rocket


@dataclass(frozen=True)
class Mission:
    """A rocket and the rules of its flight. Raises BadInput for a rule that cannot be."""

    rocket: Rocket
    cutoff: bool = False  # the engine stops at the target's energy; without cut-off at end_time
    ceiling_km: float | None = None  # altitude above which an overshoot is penalised, and the reference's bound
    floor_km: float = 110.0  # altitude below which a flight is penalised, from `floor_from` on
    floor_from: float = 300.0  # s
    guided_until: float | None = None  # s until which R_guidance has a reference pitch (None: the first burn's end)
    targets: Targets | None = None  # every flight draws its target orbit from these (None: all fly to the rocket's)
    mass_unit: float | None = None  # kg, what `propellant_price` is the price of (None: 6 % of the dry mass)

    def __post_init__(self):
        for name in ("floor_km", "floor_from"):
            value = getattr(self, name)
            refuse_unless(is_finite(value), f"a mission's {name}", value, "must be a finite number")
        for name in ("ceiling_km", "guided_until", "mass_unit"):
            value = getattr(self, name)
            possible = value is None or (is_finite(value) and value > 0)
            refuse_unless(possible, f"a mission's {name}", value, "must be positive and finite, or None")
        possible = self.targets is None or isinstance(self.targets, Targets)
        refuse_unless(possible, "a mission's targets", repr(self.targets), "must be envs.Targets(...), or None")
        allowed = "must be None without cut-off: flights that all end at one time cannot reach orbits of any energy"
        refuse_unless(self.targets is None or self.cutoff, "a mission's targets", self.targets, allowed)

    @property
    def ceiling(self) -> float:
        """The ceiling in m, infinite without one."""
        return np.inf if self.ceiling_km is None else 1e3 * self.ceiling_km

    @property
    def ranges(self) -> Targets:
        """The ranges of the targets, for a mission whose flights have their own."""
        assert self.targets is not None
        return self.targets


# The paper penalises an overshoot beyond 250 km. The boosters burn until 150.4 s. At the fixed time speed has to be
# wasted, and too flat a climb wastes it as well: with a floor of 110 km two of three seeds flew along the floor.
PAPER_MISSION = Mission(ROCKET, ceiling_km=250.0, floor_km=130.0, guided_until=ROCKET.burns[1].end, mass_unit=100.0)
# Ours. The orbits are a launcher's usual ones from its site, from low ones to transfers to geostationary altitude.
ANY_ORBIT = Mission(
    ROCKET,
    cutoff=True,
    targets=Targets(
        perigee_km=(180.0, 250.0),
        apogee_km=(400.0, 36_000.0),
        i_deg=(28.6, 40.0),
        argp_deg=(-6.0, 6.0),
    ),
)
ROCKETS: dict[str, Mission] = {}  # by environment id; `envs.py` and the files of `vehicles/` fill it


def register_rocket(env_id: str, rocket: Rocket, cutoff: bool = False, ceiling_km: float | None = None, **rules):
    """Register a rocket as an environment id, which `ppo_gtrxl_rocket.py`, evaluations and references then take, too.

    `cutoff`, `ceiling_km` and `rules` are the fields of `Mission`. An id that is registered already is replaced. A
    warning says so if it was another rocket's. Raises BadInput if the id is another environment's or not in Gymnasium's
    form.
    """
    names = [field.name for field in fields(Mission)]
    for name in rules.keys() - set(names):
        raise BadInput(f"register_rocket has no keyword {name!r}; it must be one of {', '.join(names)}")
    mission = Mission(rocket, cutoff, ceiling_km, **rules)
    register(env_id, "make_rocket", replaceable=ROCKETS)
    if ROCKETS.get(env_id, mission) != mission:
        warnings.warn(f"{env_id} was another rocket's id; from here on it is this one's", stacklevel=2)
    ROCKETS[env_id] = mission
