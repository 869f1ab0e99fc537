"""A landing policy against its opponents, all on the same draws: one table, opponents.json.

    python evaluate.py opponents runs/<run>

`guidance.py` has the opponents. Here they are flown, measured as a policy is, and printed beside the rows that the
notebooks of the published code print. The policies' script flies the policies in its own processes, so this module
imports neither a script nor torch.

Reading order: policies, laws, table, command.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from common.errors import refuse_unless
from common.files import write_json
from common.policies import competitors, fly_by_script
from landing.environment import fly_lander
from landing.guidance import LAWS, Replanned, drdv, drdv_estimated
from landing.lander import LANDERS, MARS, Lander, draw_flights
from landing.metrics import FAILURE, draws, flight_metrics, fly_draws
from landing.optimum import references

POLICY_SCRIPT = Path(__file__).parents[1] / "ppo_gtrxl_lander.py"
SOLVING = {"replanned", "replanned_wary"}  # laws that fly only the first draws
TIMED_FLIGHTS = 100  # flights in a batch when a decision is timed

# rows that the published notebooks print (RL-Meta-Learning-ACTA, Experiments/Mars3DOF/Engine_failure, cells of
# `test_policy_batch`): position error mean and max (m), speed mean, sigma and max (m/s), fuel (kg), number of flights
PUBLISHED = {
    "DR/DV, no failure": (0.0, 0.1, 0.52, 0.24, 1.0, 255.2, 1000),
    "DR/DV": (144.9, 1322.8, 19.5, 19.9, 63.1, 214.4, 1000),
    "MLP": (0.7, 2.2, 1.00, 0.62, 4.8, 301.8, 10000),
    "GRU, 60 steps": (0.3, 1.3, 1.00, 0.06, 1.2, 294.9, 10000),
}
PUBLISHED_KEYS = ("position_error_mean_m", "position_error_max_m", "speed_mean_m_s", "speed_std_m_s", "speed_max_m_s")
PUBLISHED_KEYS += ("fuel_mean_kg", "eval_starts")
# the same notebooks fly the GRU with these failures, too: size, vertical size; then the row without its sigma
STRESS = {(3.0, 1.5): (0.3, 7.6, 1.00, 1.17, 295.1, 10000), (2.5, 1.75): (1.0, 231.0, 1.12, 31.9, 295.1, 10000)}
STRESS_KEYS = tuple(key for key in PUBLISHED_KEYS if key != "speed_std_m_s")


# ---------------------------------------------------------------------------------------------------------------------
# Policies
# ---------------------------------------------------------------------------------------------------------------------


def fly_checkpoint(path, failure: dict, eval_seed: int, n: int) -> dict:
    """The metrics that the policy's script finds on the first n draws of a seed.

    Raises BadInput with the script's own line if the script refuses the policy.
    """
    metrics, _ = fly_by_script(POLICY_SCRIPT, path, {"eval_starts": n, "eval_seed": eval_seed, **failure})
    kept = {key: value for key, value in metrics.items() if isinstance(value, int | float)}
    return kept | {"knows": "flights in training; nominal mass, gravity and thrust"}


# ---------------------------------------------------------------------------------------------------------------------
# Laws
# ---------------------------------------------------------------------------------------------------------------------


def fly_law(env_id: str, make_law: Callable, z: np.ndarray, fuel: np.ndarray, **options) -> dict:
    """The metrics of a law on draws z (n, 13). `fuel` (k,) is the optimum's for the first k draws, NaN without one."""
    flown = fly_draws(env_id, make_law, z, **options)
    known = np.flatnonzero(np.isfinite(fuel[: len(z)]))
    ratio = float(flown["fuel_kg"][known].mean() / fuel[known].mean())
    return {"eval_starts": len(z)} | flight_metrics(flown) | {"fuel_ratio": ratio, "reference_starts": len(known)}


def decision_in_batch_us(env_id: str, make_law: Callable, z: np.ndarray, **options) -> float:
    """The mean time in microseconds of a law's decision for one flight, in a batch of flights.

    It is less than `common.flying.decision_us`, the time of a decision for a flight that is alone.
    """
    spent = 0.0
    calls = 0
    law = make_law(z)

    def timed(obs, t):
        nonlocal spent, calls
        began = time.perf_counter()
        action = law(obs, t)
        spent += time.perf_counter() - began
        calls += len(obs)
        return action

    fly_lander(env_id, timed, z, **options)
    return 1e6 * spent / calls


def law_makers(lander: Lander) -> dict[str, Callable]:
    """{name of `LAWS`: make_law}, where make_law(z) gives the law for the flights of draws z (n, 13)."""
    return {
        "drdv": lambda z: drdv(lander, draw_flights(lander, z, lander.failure).gravity.T),
        "drdv_estimated": lambda z: drdv_estimated(lander),
        "replanned": lambda z: Replanned(lander),
        "replanned_wary": lambda z: Replanned(lander, is_wary=True),
    }


def fly_laws(env_id: str, failure: dict, eval_seed: int, n: int, solved: int, names=tuple(LAWS)) -> dict:
    """{name: metrics} of the laws `names`, then of the optimum."""
    z = draws(eval_seed, n)
    optimum = references(env_id, z[:solved], **failure)
    rows = {}
    for name, make_law in law_makers(LANDERS[env_id]).items():
        if name not in names:
            continue
        flown = z[:solved] if name in SOLVING else z
        rows[name] = fly_law(env_id, make_law, flown, optimum["fuel_kg"], **failure)
        timed = z[: 4 if name in SOLVING else TIMED_FLIGHTS]
        rows[name]["knows"] = LAWS[name]
        rows[name]["decision_in_batch_us"] = decision_in_batch_us(env_id, make_law, timed, **failure)
    return rows | {"optimum": optimum_row(optimum)}


def optimum_row(optimum: dict) -> dict:
    """The optimum's row."""
    fuel = optimum["fuel_kg"][optimum["solved"]]
    row = {"eval_starts": len(fuel), "fuel_mean_kg": float(fuel.mean()), "fuel_ratio": 1.0}
    return row | {"reference_starts": len(fuel), "knows": "mass, gravity and failure"}


def published_rows(env_id: str, eval_seed: int, n: int) -> dict:
    """{label: metrics} of the published law, with the exact and the published end, without and with failures."""
    lander = LANDERS[env_id]
    z = draws(eval_seed, n)
    rows = {}
    for probability in (0.0, lander.failure_probability):
        make_law = law_makers(lander)["drdv"]
        for published_end in (False, True):
            options = {"failure_probability": probability, "published_end": published_end}
            flown = fly_draws(env_id, make_law, z, **options)
            end = "published" if published_end else "exact"
            rows[f"drdv, p = {probability:g}, {end} end"] = {"eval_starts": n} | flight_metrics(flown)
    return rows


def stress_rows(env_id: str, checkpoints: dict, failure: dict, eval_seed: int, n: int, solved: int) -> dict:
    """{"size / vertical size: name": metrics} of the policies, of replanning and as printed, for each of `STRESS`."""
    rows = {}
    for (size, vertical), printed in STRESS.items():
        harder = failure | {"failure_size": size, "failure_vertical": vertical}
        flown = {name: fly_checkpoint(path, harder, eval_seed, n) for name, path in checkpoints.items()}
        flown |= fly_laws(env_id, harder, eval_seed, n, solved, ("replanned",))
        flown["GRU, 60 steps, printed"] = dict(zip(STRESS_KEYS, printed))
        rows |= {f"{size:g} / {vertical:g}: {name}": row for name, row in flown.items()}
    return rows


# ---------------------------------------------------------------------------------------------------------------------
# Table
# ---------------------------------------------------------------------------------------------------------------------

COLUMNS = (  # heading, keys of a row, number format, width
    ("flights", ("eval_starts",), "d", 7),
    ("landed", ("landed_rate",), ".2%", 8),
    ("soft", ("soft_rate",), ".2%", 8),
    ("position mean, max (m)", ("position_error_mean_m", "position_error_max_m"), ".2f", 22),
    ("speed mean, max (m/s)", ("speed_mean_m_s", "speed_max_m_s"), ".2f", 21),
    ("fuel (kg)", ("fuel_mean_kg",), ".1f", 9),
    ("/ optimum", ("fuel_ratio",), ".3f", 9),
    ("a decision (us)", ("decision_in_batch_us",), ".0f", 15),
)


def table(report: dict) -> str:
    """opponents.json as a table: a line for each competitor, then the published rows."""
    parts = [part for part in ("laws", "published_law", "published", "stress") if part in report]
    width = max(len(name) for part in parts for name in report[part])
    lines = [f"{report['env_id']}, the draws of eval seed {report['eval_seed']}, the same for all"]
    lines.append(" " * (width + 2) + "".join(f"  {heading:>{w}}" for heading, _, _, w in COLUMNS) + "  knows")
    for part in parts:
        for name, row in report[part].items():
            lines.append(f"  {name:<{width}}" + "".join(f"  {cell(row, *column):>{column[3]}}" for column in COLUMNS))
            lines[-1] += f"  {row.get('knows', '')}".rstrip()
        lines.append("")
    lines.append("  landed: within 5 m and 2 m/s, the last 2 m steeper than 5 : 1; soft: whatever the slope")
    lines.append(f"  / optimum: on the draws of the first {report['solved']} that IPOPT solves, knowing all")
    return "\n".join(lines)


def cell(row: dict, heading: str, keys: tuple, digits: str, width: int) -> str:
    """A row's numbers in one column, or "-" without them."""
    if not all(key in row for key in keys):
        return "-"
    return ", ".join(f"{row[key]:{digits}}" for key in keys)


# ---------------------------------------------------------------------------------------------------------------------
# Command
# ---------------------------------------------------------------------------------------------------------------------


def compare(
    env_id: str,
    folder: Path,
    dispersion: float,
    n: int,
    solved: int,
    eval_seed: int,
    also=(),
    failure: float = 0.0,
    failure_time: str = "random",
    navigation_noise=None,
):
    """Compare a results folder's policy, and those of `also` (name, path), with all laws. Print and write it.

    All meet the failures of the folder's eval.json. `dispersion`, `failure`, `failure_time` and `navigation_noise` are
    flags for rockets. Writes opponents.json. Raises BadInput if one of those flags is given, or for other bad input.
    """
    given = {"dispersion": (dispersion, 1.0), "failure": (failure, 0.0), "failure-time": (failure_time, "random")}
    given["navigation-noise"] = (navigation_noise, None)
    for name, (value, default) in given.items():
        refuse_unless(value == default, f"--{name}", value, f"is no flag of {env_id}; leave it out")
    refuse_unless(solved <= n, "--solved", solved, f"must be at most --starts, {n}")
    checkpoints = competitors(env_id, folder, also, LAWS)
    metrics = json.loads((folder / "eval.json").read_text())
    failures = {name: metrics.get(name, getattr(LANDERS[env_id], name, None)) for name in FAILURE}  # older files
    rows = {name: fly_checkpoint(path, failures, eval_seed, n) for name, path in checkpoints.items()}
    rows |= fly_laws(env_id, failures, eval_seed, n, solved)
    published = {name: dict(zip(PUBLISHED_KEYS, values)) for name, values in PUBLISHED.items()}
    report = {"env_id": env_id, "eval_seed": eval_seed, "solved": solved} | failures
    report |= {"laws": rows, "published_law": published_rows(env_id, eval_seed, n), "published": published}
    if LANDERS[env_id] is MARS:
        report["stress"] = stress_rows(env_id, checkpoints, failures, eval_seed, n, solved)
    write_json(folder / "opponents.json", report)
    print(table(report))
