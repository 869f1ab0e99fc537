"""The data of a rocket's page: constants of vehicle, Earth and target, the policy, the optimum and its gains.

pages/rocket_physics.js and pages/rocket_laws.js read them by these names, in SI units.
"""

from __future__ import annotations

import math

import numpy as np

from common.errors import refuse_unless
from exports.page import Page, network
from rocket.any_orbit import flown_to, solve_targets
from rocket.dispersion import (
    DISPERSION,
    WIND_ALTITUDE,
    WIND_DEPTH,
    arc_masses,
    check_drawable,
    draw_names,
    draw_sigmas,
    draw_vehicles,
)
from rocket.guidance import tracked
from rocket.metrics import apsides
from rocket.missions import Mission
from rocket.orbits import target_axes, target_orbit
from rocket.policy_constants import DIFFERENCES
from rocket.targets import launch_plane, site_plane
from rocket.task import RocketTask
from rocket.vehicle import EngineGroup, Rocket, engine_groups

OPTIONS = {"observe_phase": True, "observe_draw": False, "observe_mass": False}  # a policy is trained with these
SLIDER_SIGMAS = 6  # how far a slider goes, in standard deviations of a draw
SEEN = 8 + 3 + 2 + 12  # number of `features` of the script, without those of the phase, the draw and the differences
TO_THE_TARGET = 12  # number of those of a target of its own


def page(task: RocketTask, metrics: dict, arrays: dict, checkpoint: dict, launch_longitude: float) -> Page:
    """The page of a policy: the nominal flight beside the optimum, and what the browser needs to fly both anew.

    Raises BadInput if no vehicle can be drawn of the table, or if the policy has other features.
    """
    env_id = task.env_id
    mission = task.mission
    rocket = mission.rocket
    allowed = "must be False for a page: its stages keep what a vehicle of the page would drop"
    refuse_unless(not rocket.table_isp, f"table_isp of {env_id}", rocket.table_isp, allowed)
    check_drawable(rocket)
    options = {name: checkpoint["args"].get(name, default) for name, default in OPTIONS.items()}
    alike = mission.targets is None  # all fly to one orbit
    scores = len(draw_names(rocket)) if options["observe_draw"] else 0
    optimum = {key: arrays[f"{key}_reference"] for key in ("t", "u", "y")}
    policy = network(checkpoint, SEEN + len(rocket.burns) + scores + (len(DIFFERENCES) if alike else TO_THE_TARGET))
    dispersion = checkpoint["args"].get("dispersion", 0.0)
    of_laws = {"sliders": sliders(rocket), "optimum": {"t": optimum["t"]} | tracked(mission, optimum)._asdict()}
    if not alike:
        of_laws = {"sliders": target_sliders(mission), "optimum": optimum, "optima": grid_optima(env_id, mission)}
    data = {
        "env_id": env_id,
        "launch_longitude": launch_longitude,
        "rocket": constants(mission, dispersion),
        **of_laws,
        "policy": policy | {"options": options, "sees_target": not alike},
        "python": {key: metrics[key] for key in ("error_norm", "final_mass_kg", "final_time_s")},
    }
    return Page("ascent", f"{env_id}: an ascent to orbit, flown by a neural network beside the optimum", data)


def constants(mission: Mission, dispersion: float) -> dict:
    """The constants that the page's physics reads."""
    rocket = mission.rocket
    h_target, e_target = target_orbit(rocket.target, rocket.mu)
    nominal = draw_vehicles(rocket, 1.0, np.zeros((1, len(draw_names(rocket)))))
    return {
        **{name: getattr(rocket, name) for name in ("mu", "Re", "omega_e", "rho0", "H", "Cd", "S", "dt", "end_time")},
        **{name: getattr(rocket, name) for name in ("payload", "dry_mass", "target_energy", "body")},
        "wind_altitude": WIND_ALTITUDE,
        "wind_depth": WIND_DEPTH,
        "cutoff": mission.cutoff,
        "ends_at_burn_out": mission.cutoff and rocket.end_time == rocket.burns[-1].end,
        "x0": rocket.x0.tolist(),
        "h_target": h_target.tolist(),
        "e_target": e_target.tolist(),
        "axes": target_axes(rocket).tolist(),
        "targets": None if mission.targets is None else plane_constants(rocket),
        "a": rocket.a,
        "e": rocket.e,
        "burns": [
            {"end": burn.end, "coast": burn.is_coast, "thrust": burn.thrust, "flow": burn.flow(rocket.table_isp)}
            for burn in rocket.burns
        ],
        "groups": [group_constants(rocket, group) for group in engine_groups(rocket)],
        "seen_mass": arc_masses(nominal).tolist(),  # the flight computer's mass (kg) when each burn begins
        "scores": [
            {"of": slider(name), "sigma": dispersion * sigma}
            for name, sigma in zip(draw_names(rocket), draw_sigmas(rocket))
        ],
    }


def group_constants(rocket: Rocket, group: EngineGroup) -> dict:
    """The constants of engines that are dropped together. All but `number` are those of one engine."""
    engine = group.engine
    engines = "engine" if group.number == 1 else "engines"
    return {
        "name": f"{group.number:g} {engines} until {rocket.burns[group.dropped_after].end:g} s",
        "number": group.number,
        "thrust": engine.thrust,
        "flow": engine.flow(rocket.table_isp),
        "propellant": engine.propellant,
        "dry_mass": engine.total_mass - engine.propellant,
        "dropped_after": group.dropped_after,
        "burns": sorted(group.burns),
        "seconds_lit": group.seconds_lit,
        "seconds_full": group.seconds_full if math.isfinite(group.seconds_full) else None,
    }


def slider(score: str) -> str:
    """The page's slider that moves a score of a draw, or "" if none does."""
    of_all_engines = "thrust" if score.startswith("burn_rate") else ""
    named = {"payload": "payload", "drag": "drag", "wind_east": "windEast", "wind_north": "windNorth"}
    return named.get(score, of_all_engines)


def sliders(rocket: Rocket) -> list[dict]:
    """The page's sliders: what they change (`vehicleOf` of pages/rocket_physics.js), by how much, and sigma of a draw.

    Values are `unit` times `scale`: 1 % is 0.01. None moves the payload by more than it is.
    """
    rows = [
        ("thrust", "thrust, all engines", "%", 0.01, DISPERSION.burn_rate, 0.1, math.inf),
        ("drag", "drag", "%", 0.01, DISPERSION.drag, 1.0, 1.0),
        ("windEast", "wind to the east", "m/s", 1.0, DISPERSION.wind, 1.0, math.inf),
        ("windNorth", "wind to the north", "m/s", 1.0, DISPERSION.wind, 1.0, math.inf),
        ("payload", "payload", "kg", 1.0, DISPERSION.payload, 1.0, rocket.payload),
    ]
    return [
        {
            "name": name,
            "label": label,
            "unit": unit,
            "scale": scale,
            "sigma": sigma / scale,
            "step": step,
            "most": step * math.floor(min(SLIDER_SIGMAS * sigma, most) / scale / step + 1e-9),
        }
        for name, label, unit, scale, sigma, step, most in rows
    ]


# ---------------------------------------------------------------------------------------------------------------------
# Any orbit
# ---------------------------------------------------------------------------------------------------------------------


def plane_constants(rocket: Rocket) -> dict:
    """What the page's `withTarget` reads to place a target about the launch site."""
    node, site = (float(angle) for angle in launch_plane(rocket, rocket.i))
    north, _ = site_plane(rocket.latitude, rocket.i)
    return {
        "latitude": rocket.latitude,
        "goes_south": bool(abs(node - north) > 1e-9),
        "own_argp_from_site": rocket.argp - site,  # degrees
    }


def target_sliders(mission: Mission) -> list[dict]:
    """The page's sliders of the target: their ranges, and where they stand for the rocket's own orbit.

    The apogee's slider moves by its logarithm.
    """
    rocket = mission.rocket
    own = {key: float(value) for key, value in apsides(rocket.a / 1e3, rocket.e, rocket).items()}
    rows = [
        ("perigee", "perigee", "km", mission.ranges.perigee_km, own["perigee_km"], 1.0, False),
        ("apogee", "apogee", "km", mission.ranges.apogee_km, own["apogee_km"], 0.01, True),
        ("i", "inclination", "°", mission.ranges.i_deg, rocket.i, 0.1, False),
        ("argp", "perigee off its natural place", "°", mission.ranges.argp_deg, 0.0, 0.1, False),
    ]
    names = ("name", "label", "unit", "range", "value", "step", "logarithmic")
    return [dict(zip(names, row)) for row in rows]


def grid_optima(env_id: str, mission: Mission) -> list[dict]:
    """The optima of a grid of targets with the sliders' numbers, for the page to show the nearest.

    The perigee and its place are in the middle of their ranges.
    """
    ranges = mission.ranges
    shares = [[0.5, apogee, i, 0.5, 0.5] for apogee in np.linspace(0, 1, 4) for i in np.linspace(0, 1, 3)]
    targets = ranges.at(shares, mission.rocket)
    optima = solve_targets(env_id, mission, targets, processes=1)
    flights = flown_to(env_id, targets, optima)
    rows = []
    for (_, apogee, i, *_), flight in zip(shares, flights):
        low, high = np.log(ranges.apogee_km)
        place = {"apogee": float(np.exp(low + apogee * (high - low))), "i": float(np.interp(i, (0, 1), ranges.i_deg))}
        place |= {"perigee": float(np.mean(ranges.perigee_km)), "argp": float(np.mean(ranges.argp_deg))}
        rows.append({"target": place} | {key: flight[key].astype(np.float32) for key in ("t", "u", "y")})
    return rows
