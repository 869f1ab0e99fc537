"""Of a rocket: names and units of a policy's numbers, columns of its flights, its track, its page."""

from __future__ import annotations

import numpy as np

from common.errors import BadInput, refuse_unless
from exports.columns import STATE, named
from exports.offers import Interface
from exports.rocket_page import page
from exports.track import Track, over_ground
from rocket.comparison import recorded_flights
from rocket.dispersion import draw_names
from rocket.metrics import apsides, own_flight
from rocket.orbits import target_axes
from rocket.rescue import Failing
from rocket.task import RocketTask
from rocket.vehicle import Rocket

__all__ = ["flight_columns", "interface", "page", "step_columns", "track"]  # what this family offers

ACTIONS = {"eci": ("x", "y", "z"), "local": ("up", "along_track", "cross_track")}


def interface(
    task: RocketTask, action_frame: str = "eci", observe_phase: bool = True, observe_draw: bool = False, **options
) -> Interface:
    """What a policy observes and commands, with these options of the environment."""
    rocket = task.mission.rocket
    units = [*["m"] * 3, *["m/s"] * 3, "kg", "1", "1"]
    observation = list(zip(("x", "y", "z", "vx", "vy", "vz", "mass", "time_left", "phase"), units))
    has_own_target = task.mission.targets is not None
    if has_own_target:
        vectors = [f"target_{name}_{axis}" for name in ("perigee", "normal") for axis in "xyz"]
        observation += [*((name, "1") for name in vectors), ("target_momentum", "m^2/s"), ("target_eccentricity", "1")]
    if observe_draw:
        observation += [(name, "1") for name in draw_names(rocket)]
    notes = "Position and velocity: inertial, x through the launch meridian at lift-off, z the Earth's axis. "
    notes += f"time_left: 1 - t / {rocket.end_time:g} s. phase: the burn, from 0, / {max(len(rocket.burns) - 1, 1)}. "
    if not observe_phase:
        notes += "time_left and phase were hidden in training: give 0. "
    notes += "Action: the direction of thrust, held in inertial axes until the next step. "
    if action_frame == "local":
        normal = ", ".join(f"{component:.9f}" for component in target_axes(rocket)[2])
        n = "target_normal" if has_own_target else f"({normal})"
        notes += f"up = r / |r|; along_track = n x up over its length, n = {n}; cross_track = up x along_track."
    return Interface(observation, [(name, "1") for name in ACTIONS[action_frame]], notes.strip())


def step_columns(task: RocketTask, arrays: dict, launch_longitude: float) -> dict[str, np.ndarray]:
    """The columns of the nominal flight, a row for each step: state, thrust direction from there on, burn from 1."""
    rocket = task.mission.rocket
    arrays = own_flight(arrays)
    ends = [burn.end for burn in rocket.burns[:-1]]
    direction = np.vstack([arrays["u"], np.full((1, 3), np.nan)])
    return {
        "t_s": arrays["t"],
        **named(STATE, arrays["y"]),
        **named(("thrust_x", "thrust_y", "thrust_z"), direction),
        "burn": 1 + np.searchsorted(ends, arrays["t"], side="right"),
        **over_ground(track_of("", rocket, arrays), launch_longitude),
    }


def flight_columns(task: RocketTask, arrays: dict, metrics: dict) -> dict[str, np.ndarray]:
    """The columns of the flights that differ, a row for each: standard scores, failure, target, end and orbit.

    A flight with a failure has the group of engines that fails, from 1, the moment (s) and the share of thrust lost; a
    healthy one has zeros.
    """
    if not {"draw", "target"} & arrays.keys():
        needs = "--flights needs one with --dispersion or --failure"
        raise BadInput(f"the evaluation of {task.env_id} holds one flight; {needs}")
    rocket = task.mission.rocket
    failing = Failing.of(metrics)
    flights = recorded_flights(arrays, rocket, failing)
    differs = {}
    if "draw" in arrays:
        scores = draw_names(rocket)
        differs |= named([f"score_{name}" for name in scores], arrays["draw"][:, : len(scores)])
    if failing.failure:
        differs |= named(("failed_group", "failure_t_s", "thrust_lost"), arrays["failure"] + [1, 0, 0])
    if "target" in arrays:
        elements = ("target_a_m", "target_e", "target_i_deg", "target_raan_deg", "target_argp_deg")
        differs |= named(elements, arrays["target"])
    orbit = {key: flights[key] for key in ("error_norm", "a_km", "e", "i_deg", "raan_deg", "argp_deg")}
    perigee, apogee = apsides(flights["a_km"], flights["e"], rocket).values()
    return {
        "flight": np.arange(len(arrays["final_t"])),
        **differs,
        "t_s": arrays["final_t"],
        **named(STATE, arrays["final_y"]),
        **orbit,
        "perigee_km": perigee,
        "apogee_km": np.where(np.isfinite(apogee), apogee, np.nan),
        **{name: flights[name] for name in ("dry", "crashed") if name in flights},
    }


def track_of(name: str, rocket: Rocket, arrays: dict) -> Track:
    """The track of the nominal flight."""
    end = arrays["t"][-1]
    burns = zip(rocket.ignitions, rocket.burns)
    events = [
        (begin, "coast" if burn.is_coast else f"burn {k}") for k, (begin, burn) in enumerate(burns, 1) if begin < end
    ]
    y = arrays["y"]
    return Track(name, arrays["t"], y[:, :3], y[:, 3:6], events, rocket.Re, rocket.omega_e)


def track(task: RocketTask, arrays: dict) -> Track:
    """The track of a rocket that is launched from the Earth. Raises BadInput for another planet."""
    rocket = task.mission.rocket
    allowed = "must be the Earth's: OEM and CZML name it"
    refuse_unless(rocket.body == "Earth", f"mu of {task.env_id}", rocket.mu, allowed)
    return track_of(task.env_id, rocket, own_flight(arrays))
