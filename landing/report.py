"""`python baselines.py MarsLanding-v0`, or the same with another lander's id: solve the optima and print rows.

The functions return the numbers and arrays for the files.
"""

from __future__ import annotations

import time

import numpy as np

from landing.lander import LANDERS, draw_flights
from landing.metrics import draws
from landing.optimum import optimise_landing, references

CONSTRAINTS = {"no constraint on the path": None, "altitude at least 0": 0.0, "glide slope of 4 degrees": 4.0}


def report_lander(env_id: str, starts: int, seed: int) -> tuple[dict, dict]:
    """Solve and print a lander's optima: with each constraint if it has one start, else for the draws of a seed."""
    if LANDERS[env_id].has_one_flight:
        return report_constraints(env_id)
    return report_draws(env_id, starts, seed)


def report_constraints(env_id: str) -> tuple[dict, dict]:
    """Solve and print the optima of a lander's one start, with each of `CONSTRAINTS`."""
    lander = LANDERS[env_id]
    flight = draw_flights(lander, draws(0, 1), lander.failure)
    numbers, arrays = {}, {}
    print(f"{env_id:<32}{'propellant (kg)':>16}{'duration (s)':>14}{'solved in (s)':>15}")
    for name, glide_slope in CONSTRAINTS.items():
        began = time.monotonic()
        optimum = optimise_landing(lander, flight, glide_slope)
        row = {"fuel_kg": optimum["fuel_kg"], "final_time_s": optimum["final_time"]}
        row["solve_seconds"] = time.monotonic() - began
        print(f"  {name:<30}{row['fuel_kg']:>16.2f}{row['final_time_s']:>14.2f}{row['solve_seconds']:>15.1f}")
        key = name.replace(" ", "_")
        numbers[key] = row
        arrays |= {f"{key}_{part}": optimum[part] for part in ("t", "u", "y")}
    return numbers, arrays


def report_draws(env_id: str, starts: int, seed: int) -> tuple[dict, dict]:
    """Solve and print the optima of the first draws of a seed, with the lander's own failures.

    There is a row for all flights, one for the healthy ones and one for the failed ones.
    """
    lander = LANDERS[env_id]
    z = draws(seed, starts)
    began = time.monotonic()
    solved = references(env_id, z)
    numbers: dict[str, float] = {"starts": starts, "seed": seed, "solved": int(solved["solved"].sum())}
    numbers["solve_seconds"] = time.monotonic() - began
    has_failed = np.isfinite(draw_flights(lander, z, lander.failure).strike)
    is_solved = solved["solved"]
    groups = {"all": is_solved, "healthy": is_solved & ~has_failed, "failed": is_solved & has_failed}
    print(f"{env_id}: {starts} draws of seed {seed}, solved in {numbers['solve_seconds']:.0f} s")
    print(f"  {'':<10}{'draws':>8}{'propellant (kg)':>18}{'duration (s)':>15}")
    for name, chosen in groups.items():
        if not chosen.any():
            continue
        fuel, duration = (float(solved[key][chosen].mean()) for key in ("fuel_kg", "final_time"))
        numbers |= {f"fuel_{name}_mean_kg": fuel, f"final_time_{name}_mean_s": duration}
        print(f"  {name:<10}{chosen.sum():>8}{fuel:>18.2f}{duration:>15.2f}")
    return numbers, {"draw": z} | {key: solved[key] for key in ("fuel_kg", "final_time", "u", "y", "solved")}
