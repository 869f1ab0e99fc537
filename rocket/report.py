"""`python baselines.py rocket`, or the same with a rocket's id: solve, print rows, checks and the open-loop opponent.

With --failure it solves and prints what flights with failures can still reach. Where flights have targets of their own
it solves those of a seed.
"""

from __future__ import annotations

import time

import numpy as np

from rocket.any_orbit import about as about_targets
from rocket.any_orbit import masses, refuse_unreachable, solve_targets
from rocket.failure import group_names
from rocket.metrics import targets_of
from rocket.missions import ROCKETS
from rocket.optimum import (
    ASCENTS,
    CUTOFF,
    FIXED,
    SEGMENTS,
    STORED,
    mission_case,
    nine_pitch_angles,
    optimise_ascent,
    solve_and_fly,
)
from rocket.rescue import Failing, about, solve_known

COLUMNS = ("final_mass_kg", "final_time_s", "error_norm", "replay_error_norm", "max_altitude_km", "solve_seconds")


def report_all_rockets() -> tuple[dict, dict]:
    """Solve `ASCENTS` and the other missions, print them and their checks. Returns numbers and arrays for the files."""
    others = {key: mission_case(key, mission) for key, mission in ROCKETS.items() if key not in STORED}
    numbers, flights, optima = solve_and_print(ASCENTS | others)
    numbers["checks"] = optimum_checks(numbers, optima["free"])
    for name, value in numbers["checks"].items():
        print(f"{name:<32}{value:.7g}")
    return numbers | open_loop_numbers(flights), solution_arrays(flights)


def report_rocket(env_id: str) -> tuple[dict, dict]:
    """Solve one mission and print it. Returns the numbers and arrays for the files."""
    numbers, flights, _ = solve_and_print({env_id: mission_case(env_id, ROCKETS[env_id])})
    return numbers | open_loop_numbers(flights), solution_arrays(flights)


def solve_and_print(cases: dict) -> tuple[dict, dict, dict]:
    """Solve each case and print its row. Returns numbers, flights and collocations, by the case's key."""
    print(f"{'':<16}" + "".join(f"{name:>19}" for name in COLUMNS) + "  status")
    numbers, flights, optima = {}, {}, {}
    for key, case in cases.items():
        numbers[key], flights[key], optima[key] = solve_and_fly(case)
        cells = "".join(f"{numbers[key][name]:>19.10g}" for name in COLUMNS)
        print(f"{key:<16}{cells}  {numbers[key]['status']}", flush=True)
    return numbers, flights, optima


def solution_arrays(flights: dict) -> dict:
    """Times and directions of each flight, as --npz writes them."""
    return {f"{key}_{name}": flight[name] for key, flight in flights.items() for name in ("t", "u")}


def pontryagin_angle(optimum: dict):
    """Angles (m,) in degrees between the thrust and the velocity's costate. By the maximum principle they are 0."""
    u = optimum["u"]
    costate = optimum["costate"]
    across = np.linalg.norm(np.cross(u, costate), axis=1)
    along = (u * costate).sum(axis=1)
    return np.degrees(np.arctan2(across, along))


def optimum_checks(numbers: dict, optimum: dict) -> dict:
    """Checks of the case `free`: the maximum principle on its collocation, the mass that drag costs, other meshes."""
    mass = numbers["free"]["final_mass_kg"]
    angle = pontryagin_angle(optimum)
    checks = {"costate_angle_deg_max": angle.max(), "costate_angle_deg_median": np.median(angle)}
    checks["drag_free_mass_gain_kg"] = numbers["drag_free"]["final_mass_kg"] - mass
    for segments in (SEGMENTS // 2, 2 * SEGMENTS):
        checks[f"mass_change_kg_{segments}_segments"] = optimise_ascent(ASCENTS["free"], segments)["final_mass"] - mass
    return {key: float(value) for key, value in checks.items()}


def open_loop_numbers(flights: dict) -> dict:
    """Print `nine_pitch_angles` of every mission whose optimum is among the flights. Returns {name: its numbers}."""
    names = {CUTOFF: "nine_pitch_angles", FIXED: "nine_pitch_angles_fixed"}
    numbers = {}
    for env_id, mission in ROCKETS.items():
        key = STORED.get(env_id, env_id)
        name = names.get(env_id, f"nine_pitch_angles_{env_id}")
        flight = flights.get(env_id, flights.get(key))
        if flight is not None:
            opponent = nine_pitch_angles(env_id, flight, mission.rocket)
            numbers[name] = {part: float(opponent[part]) for part in ("error_norm", "final_mass_kg", "final_time_s")}
            print(f"{name:<40}" + "  ".join(f"{part} {value:.7g}" for part, value in numbers[name].items()))
    return numbers


def report_targets(env_id: str, starts: int, seed: int) -> tuple[dict, dict]:
    """Solve the optima of the first targets of a seed, and print what they leave.

    Returns the numbers, and the arrays `about`, `target` (n, 5) and `mass` (n,) in kg, NaN without an optimum.
    Evaluations read them from a file in results/. Raises NoOptimum if a corner of the ranges is out of reach.
    """
    mission = ROCKETS[env_id]
    refuse_unreachable(env_id, mission)
    targets = targets_of(mission, seed, starts)
    began = time.perf_counter()
    mass = masses(solve_targets(env_id, mission, targets))
    seconds = time.perf_counter() - began
    solved = np.isfinite(mass)
    numbers = {"starts": starts, "seed": seed, "solved": int(solved.sum()), "solve_seconds": seconds}
    numbers |= {"mass_mean_kg": float(mass[solved].mean()), "mass_min_kg": float(mass[solved].min())}
    numbers |= {"mass_max_kg": float(mass[solved].max())}
    print(f"{env_id}: {starts} targets of seed {seed}, {numbers['solved']} solved in {seconds:.0f} s")
    print(
        "  mass left (kg): " + ", ".join(f"{name} {numbers[f'mass_{name}_kg']:.2f}" for name in ("mean", "min", "max"))
    )
    return numbers, {"about": np.array(about_targets(env_id, mission, seed)), "target": targets, "mass": mass}


def report_failures(env_id: str, failing: Failing, starts: int, seed: int) -> tuple[dict, dict]:
    """Solve what the flights with a failure among the draws of a seed can still reach. Print it by group of engines.

    Returns the numbers, and the arrays of `Known` and `about`. Evaluations read the arrays from a file in results/.
    """
    mission = ROCKETS[env_id]
    z = failing.draws(mission.rocket, seed, starts)
    vehicles = failing.vehicles(mission.rocket, z)
    group = vehicles.failure[0]
    began = time.perf_counter()
    known = solve_known(env_id, mission, failing, z)
    mass = known.mass
    seconds = time.perf_counter() - began

    numbers = failing._asdict() | {"starts": starts, "seed": seed, "solve_seconds": seconds}
    lost = f"up to {failing.failure:.0%} of thrust lost"
    print(f"{env_id}: {starts} draws of seed {seed}, {lost}, solved in {seconds:.0f} s")
    heads = ("flights", "solved", "savable", "mass (kg)", "lightest")
    print(f"  {'':<28}" + "".join(f"{head:>11}" for head in heads))
    names = group_names(mission.rocket)
    groups = {"all": group >= 0} | {name: group == g for g, name in enumerate(names)}
    for name, flights in groups.items():
        if not flights.any():
            continue
        solved = flights & np.isfinite(mass)
        savable = flights & (mass > vehicles.dry_mass)
        row = {"flights": int(flights.sum()), "solved": int(solved.sum()), "savable": int(savable.sum())}
        if solved.any():
            row |= {"mass_mean_kg": float(mass[solved].mean()), "mass_min_kg": float(mass[solved].min())}
        numbers[name] = row
        print(f"  {name:<28}" + "".join(f"{value:>11.6g}" for value in row.values()))
    words = about(env_id, mission, failing, seed)
    return numbers, {"about": np.array(words), "mass": mass, "price": known.price.astype(np.float32)}
