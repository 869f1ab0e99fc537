"""A policy against the optimum: cases, ratios, table, results folders. Needs no torch, imports no script.

    python evaluate.py publish RUN_DIR results/di     # add a run to a results folder (--ship: make it the shipped one)
    python evaluate.py figures results/di             # redraw its figures and print its table (a run folder works too)
    python evaluate.py animate results/di             # and its figures/animation.gif
    python evaluate.py opponents results/rocket_cutoff     # classical guidance on its policy's dispersed flights

Reading order: cases and ratios, table, files, training curves, rocket ascent (its metrics and table), dispersed
flights, results folders, command line. The figures are in `figures.py` and `animation.py`, imported only where
something is drawn, the comparison with opponents in `comparison.py`. The names of all metrics (`eval.json`) and arrays
(`eval.npz`) are the interface of the project. Costs are the paper's J: plain sums.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import math
import sys
import tempfile
import time
from functools import lru_cache
from pathlib import Path

import numpy as np
import safetensors.numpy

import baselines
import envs
from baselines import OneLineParser, integer, replacing, starts
from envs import BadInput
from rocket_baselines import DAMAGED_NPZ

# ---------------------------------------------------------------------------------------------------------------------
# Cases and ratios
# ---------------------------------------------------------------------------------------------------------------------

PAPER_STARTS, PAPER_DRAWS = 10, 100  # the paper reports the mean ratio of ten starts; we draw such tens a hundred times
NEAR_ORIGIN = 0.2  # |x0| within which J* is so small that the ratio says little and the loss J - J* says more


@lru_cache(maxsize=4)  # evaluations during training fly the same starts again and again
def optimum(env_id: str, eval_seed: int, n: int, mission: envs.Mission | None = None) -> dict:
    """`baselines.reference` from the n starts of a seed; of a rocket, which has one start, the flown optimum.

    A rocket's `mission` only tells apart what an id was registered for before and is now.
    """
    if env_id in envs.ROCKETS:
        return baselines.rocket_reference(env_id)
    return baselines.reference(env_id, starts(eval_seed, n, envs.PROBLEMS[env_id].x0_max))


def evaluate(env_id, policy, eval_seed: int, n: int, reference: dict | None = None, **env_options):
    """Fly `policy(obs (n, obs), t) -> action (n, 1)` from n starts and compare it, start by start, with the optimum.

    `reference` is `optimum(env_id, eval_seed, n)`, solved here when it is not given; `env_options`
    go to the environment. Returns the `metrics` of eval.json that do not depend on the run, as plain numbers, and the
    `arrays` of eval.npz. Raises ValueError if the reference belongs to other starts. A rocket has one start.
    """
    if env_id in envs.ROCKETS:
        return evaluate_rocket(env_id, policy, eval_seed, n, reference, **env_options)
    x0 = starts(eval_seed, n, envs.PROBLEMS[env_id].x0_max)
    flight = envs.fly(env_id, policy, x0, **env_options)
    reference = optimum(env_id, eval_seed, n) if reference is None else reference
    if not np.array_equal(reference["x"][:, 0], x0):
        raise ValueError(f"reference does not belong to the {n} starts of eval_seed {eval_seed}")
    metrics = {"env_id": env_id, "eval_seed": eval_seed, "eval_starts": n}
    metrics |= flight_metrics(flight, reference)
    chosen = comparable(env_id, flight["x"], reference["x"])
    costs = flight["cost"][chosen], reference["cost"][chosen]
    metrics |= ratio_metrics(*costs, eval_seed) | near_origin_metrics(env_id, x0[chosen], *costs)
    problem = envs.PROBLEMS[env_id]
    arrays = {"t": problem.dt * np.arange(problem.steps + 1)}
    arrays |= {key: flight[key] for key in ("x", "u", "reward", "cost")}
    arrays |= {f"{key}_reference": reference[key] for key in ("x", "u", "cost")}
    return metrics, arrays


def flight_metrics(flight: dict, reference: dict) -> dict:
    """Means over all starts of what was flown and of the optimum, and the shares of starts that hit their circles."""
    metrics = {}
    for prefix, result in (("", flight), ("reference_", reference)):
        metrics[f"{prefix}episodic_return"] = float(result["episodic_return"].mean())
        for part in ("cost", "cost_state", "cost_control", "cost_terminal"):
            metrics[f"{prefix}{part}_mean"] = float(result[part].mean())
        metrics[f"{prefix}hit_rate"] = float(result["hit"].all(axis=1).mean())
    for k, rate in enumerate(flight["hit"].mean(axis=0), start=1):
        metrics[f"hit_rate_phase_{k}"] = float(rate)
    metrics["terminal_error_max"] = float(flight["terminal_error"].max())
    return metrics


def hits_every_circle(env_id: str, x: np.ndarray) -> np.ndarray:
    """Whether flights x (n, T+1, 2) are within the target's radius at the end of every phase; (n,) bool."""
    phases = envs.PROBLEMS[env_id].phases
    ends = np.cumsum([phase.steps for phase in phases])
    d = x[:, ends] - [phase.target for phase in phases]  # (n, phases, 2)
    # hypot, as in the environment: the optimum is on the circle's edge, where another rounding would decide otherwise
    return (np.hypot(d[..., 0], d[..., 1]) <= [phase.radius for phase in phases]).all(axis=1)


def comparable(env_id: str, x: np.ndarray, x_reference: np.ndarray) -> np.ndarray:
    """The starts (n,) whose costs may be compared: all, or with waypoints those where both sides hit every circle.

    Skipping a circle is cheaper than hitting it, so that a miss would count as better than the optimum. An optimum that
    hits every circle is the radius-constrained one, also where the constraint did not have to be imposed.
    """
    if len(envs.PROBLEMS[env_id].phases) == 1:
        return np.ones(len(x), dtype=bool)
    return hits_every_circle(env_id, x) & hits_every_circle(env_id, x_reference)


def ratio_metrics(cost: np.ndarray, reference_cost: np.ndarray, eval_seed: int) -> dict:
    """Statistics of the cost ratios ours / optimum of the comparable starts, both (m,); without a start, no key.

    The paper's number is the mean of ten ratios: `ratio_mean` is its expectation, the draws of ten are its spread.
    """
    if len(cost) == 0:
        return {}
    ratio = cost / reference_cost
    metrics = {"ratio_of_sums": cost.sum() / reference_cost.sum(), "ratio_mean": ratio.mean()}
    metrics |= {"ratio_median": np.median(ratio), "ratio_p95": np.percentile(ratio, 95)}
    metrics |= {"ratio_min": ratio.min(), "ratio_max": ratio.max()}
    if len(ratio) >= PAPER_STARTS:
        rng = np.random.default_rng([eval_seed, 1])  # not the stream that drew the starts
        means = [rng.choice(ratio, PAPER_STARTS, replace=False).mean() for _ in range(PAPER_DRAWS)]
        for percentile in (5, 50, 95):
            metrics[f"ten_start_ratio_mean_p{percentile:02d}"] = np.percentile(means, percentile)
    return {key: float(value) for key, value in metrics.items()}


def near_origin_metrics(env_id: str, x0: np.ndarray, cost: np.ndarray, reference_cost: np.ndarray) -> dict:
    """The mean loss J - J* of the starts x0 (m, 2) near the origin; without one, or with another target, no key.

    There J* vanishes with |x0|^2, so that a loss c makes a start's ratio 1 + c / J* as large as one likes, and a few
    such starts make the mean ratio of all. With waypoints J* does not vanish: the second is not at the origin.
    """
    near, (first, *later) = np.hypot(*x0.T) <= NEAR_ORIGIN, envs.PROBLEMS[env_id].phases
    if later or any(first.target) or not near.any():
        return {}
    return {"loss_near_origin_mean": float((cost - reference_cost)[near].mean())}


def cost_parts(env_id: str, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """State, control and terminal part (n, 3) of the cost J of flights x (n, T+1, 2), u (n, T) (the paper's Eq. of J).

    eval.npz holds the flights and their total cost; the figures take its parts from here.
    """
    parts, start = np.zeros((len(x), 3)), 0
    for phase in envs.PROBLEMS[env_id].phases:
        d = x[:, start : start + phase.steps + 1] - phase.target
        parts[:, 0] += (d[:, :-1] ** 2 @ phase.Q).sum(axis=1)  # the state before each step
        parts[:, 1] += phase.R * (u[:, start : start + phase.steps] ** 2).sum(axis=1)
        parts[:, 2] += phase.Qf * (d[:, -1] ** 2).sum(axis=1)
        start += phase.steps
    return parts


# ---------------------------------------------------------------------------------------------------------------------
# Table
# ---------------------------------------------------------------------------------------------------------------------


def table(metrics: dict, mission: envs.Mission | None = None) -> str:
    """The table "optimum | ours | ratio" of an evaluation, to be read in a terminal.

    The means are over all starts. Where some miss a circle, the ratio of J is over the others and its parts have none.
    A rocket's `mission` is its id's, unless `evaluate` was told to fly another rocket.
    """
    if metrics["env_id"] in envs.ROCKETS:
        return rocket_table(metrics, mission or envs.ROCKETS[metrics["env_id"]])
    phases = envs.PROBLEMS[metrics["env_id"]].phases
    all_compared = len(phases) == 1 or metrics["hit_rate"] == metrics["reference_hit_rate"] == 1
    rows = [("", "optimum", "ours", "ratio")]
    labels = {"cost": f"cost J (mean of {metrics['eval_starts']} starts)", "cost_state": "  of it: state"}
    labels |= {"cost_control": "  of it: control", "cost_terminal": "  of it: terminal"}
    for part, label in labels.items():
        optimum, ours = metrics[f"reference_{part}_mean"], metrics[f"{part}_mean"]
        ratio = metrics.get("ratio_of_sums") if part == "cost" else ours / optimum if all_compared and optimum else None
        rows.append((label, f"{optimum:.4f}", f"{ours:.4f}", f"{ratio:.4f}" if ratio is not None else "-"))
    optimum, ours = metrics["reference_episodic_return"], metrics["episodic_return"]
    rows.append(("reward (bonus - J, mean)", f"{optimum:.4f}", f"{ours:.4f}", "-"))
    label = "starts that hit the target circle" if len(phases) == 1 else "starts that hit every circle"
    rows.append((label, f"{metrics['reference_hit_rate']:.1%}", f"{metrics['hit_rate']:.1%}", "-"))
    for k, phase in enumerate(phases if len(phases) > 1 else (), start=1):
        label = f"  circle {k}: {phase.target}, radius {phase.radius}"
        rows.append((label, "", f"{metrics[f'hit_rate_phase_{k}']:.1%}", ""))
    width = max(len(row[0]) for row in rows)
    lines = [f"{metrics['env_id']}: {metrics['eval_starts']} starts of eval seed {metrics['eval_seed']}"]
    lines += [(f"  {row[0]:<{width}}" + "".join(f" {cell:>11}" for cell in row[1:])).rstrip() for row in rows]
    return "\n".join([*lines, *ratio_lines(metrics)])


def ratio_lines(metrics: dict) -> list[str]:
    """The lines below the table: the statistics of the cost ratio, or why there is none."""
    waypoints = len(envs.PROBLEMS[metrics["env_id"]].phases) > 1
    if "ratio_of_sums" not in metrics:
        reason = "no start hit every circle" if metrics["hit_rate"] == 0 else "where ours hit, the optimum does not"
        return [f"  No cost ratio: {reason} (missing a circle is cheaper, not better)."]
    over = "the starts that hit every circle" if waypoints else f"all {metrics['eval_starts']} starts"
    lines = [f"  Cost ratio ours / optimum over {over}:"]
    lines.append(f"    mean {metrics['ratio_mean']:.4f}: the paper's statistic, a mean of ten starts, on average")
    draws = {key: metrics.get(f"ten_start_ratio_mean_{key}") for key in ("p05", "p50", "p95")}
    if None not in draws.values():  # fewer than ten starts, or an older eval.json
        interval = f"{draws['p05']:.4f} to {draws['p95']:.4f} (5 % to 95 %), median {draws['p50']:.4f}"
        lines.append(f"      {PAPER_DRAWS} draws of ten: {interval}")
    if not waypoints and not any(envs.PROBLEMS[metrics["env_id"]].phases[0].target):
        lines.append("      dominated by starts near the origin, where the optimal cost J* vanishes")
    lines.append(f"    ratio of sums {metrics['ratio_of_sums']:.4f}")
    statistics = ", ".join(f"{s} {metrics[f'ratio_{s}']:.4f}" for s in ("min", "median", "max", "p95"))
    lines.append(f"    start by start: {statistics}")
    if "loss_near_origin_mean" in metrics:
        lines[-1] += f"; mean J - J* within {NEAR_ORIGIN} of the origin {metrics['loss_near_origin_mean']:.4f}"
    return lines


# ---------------------------------------------------------------------------------------------------------------------
# Files: each is written beside its place and renamed, so that a failure leaves the old one
# ---------------------------------------------------------------------------------------------------------------------


def write_bytes(path, data: bytes | memoryview):
    """Write a whole file."""
    with replacing(path) as file:
        file.write(data)


def write_json(path, metrics: dict):
    """Write metrics as JSON in the given order; ValueError names the key that holds a number which is not finite."""
    plain = {key: value.item() if isinstance(value, np.generic) else value for key, value in metrics.items()}
    for key, value in plain.items():
        try:
            json.dumps(value, allow_nan=False)
        except ValueError as error:
            raise ValueError(f"{key} is {value}; {Path(path).name} holds finite numbers only") from error
    write_bytes(path, (json.dumps(plain, indent=2) + "\n").encode())


def write_npz(path, arrays: dict):
    """Write arrays as a compressed .npz."""
    with replacing(path) as file:
        np.savez_compressed(file, **arrays)


def write(metrics: dict, arrays: dict, checkpoint, json_path, npz_path):
    """Write an evaluation of the file `checkpoint`, which `metrics` then names by its sha256; None writes nothing."""
    metrics["checkpoint_sha256"] = hashlib.sha256(Path(checkpoint).read_bytes()).hexdigest()
    if npz_path is not None:
        write_npz(npz_path, arrays)
    if json_path is not None:  # last: a run with its eval.json is finished
        write_json(json_path, metrics)


def read_checkpoint(
    path, expected: dict[str, type], env_ids=(), defaults: dict | None = None, flag: str = "--checkpoint "
) -> dict:
    """An agent.safetensors: `args` (the run's arguments), `progress` (its counters), `tensors` (NumPy arrays).

    `expected` gives the type of each argument that must be there, `env_ids` the environments that it may be of (none:
    any), `defaults` what an older file need not hold. Raises BadInput, which begins with `flag` and the path, if the
    file is missing, damaged or of something else, or holds a weight that is not finite.
    """
    try:
        data = Path(path).read_bytes()
        tensors = safetensors.numpy.load(data)
        metadata = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]
        args = {**(defaults or {}), **json.loads(metadata["args"])}
        env_id = args["env_id"]
        if env_ids and isinstance(env_id, str) and env_id not in env_ids:  # another script's has other arguments, too
            raise BadInput(f"{flag}{path}: is of {env_id}; this script takes {', '.join(env_ids)}")
        wrong = [name for name, kind in expected.items() if type(args[name]) is not kind]
        metadata.setdefault("training_seconds", metadata["wall_seconds"])  # an older file counted no other time
        counters = {"seed": int, "total_updates": int, "global_step": int}
        counters |= {"training_seconds": float, "wall_seconds": float}
        progress = {name: kind(metadata[name]) for name, kind in counters.items()}
        if not all(math.isfinite(value) and value >= 0 for value in progress.values()):
            raise ValueError(f"its counters are {progress}")
    except BadInput:
        raise
    except OSError as error:
        raise BadInput(f"{flag}{path}: {error.strerror}; it must be an agent.safetensors") from error
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError) as error:
        raise BadInput(f"{flag}{path}: damaged or foreign ({error}); it must be an agent.safetensors") from error
    if wrong:
        name = wrong[0]
        raise BadInput(f"{flag}{path}: its {name} is {args[name]!r}; must be {expected[name].__name__}")
    if not all(np.isfinite(tensor).all() for tensor in tensors.values()):
        raise BadInput(f"{flag}{path}: holds a NaN or an infinity; its weights must be finite")
    return {"args": args, "progress": progress, "tensors": tensors}


def read_evaluation(folder: Path) -> tuple[dict, dict]:
    """The `metrics` and `arrays` of a run's or results folder; OSError or ValueError names the file that is bad."""
    metrics, path = read_metrics(folder / "eval.json"), folder / "eval.npz"
    try:
        with np.load(path) as file:
            arrays = {key: file[key] for key in file.files}
    except DAMAGED_NPZ as error:
        raise ValueError(f"{path} is not a readable .npz: {error}") from error
    needed = {"t", "x", "u", "reward", "cost", "x_reference", "u_reference", "cost_reference"}
    if metrics["env_id"] in envs.ROCKETS:
        needed = {f"{key}{side}" for key in ("t", "u", "y") for side in ("", "_reference")} | {"reward"}
        needed |= {"draw", "final_y", "final_error"} if "dispersion" in metrics else set()
    if missing := needed - arrays.keys():
        raise ValueError(f"{path} lacks {', '.join(sorted(missing))}")
    return metrics, arrays


def read_metrics(path: Path) -> dict:
    """An eval.json that holds all of its table; ValueError names the file and what is wrong with it."""
    metrics = read_json(path)
    try:
        table(metrics)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} lacks a number of its table, or has a wrong one: {error}") from error
    return metrics


def read_json(path: Path) -> dict:
    """The eval.json of a finished run; ValueError names the file and what is wrong with it."""
    try:
        metrics = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is not readable JSON: {error}") from error
    known = [*envs.PROBLEMS, *envs.ROCKETS]
    if not isinstance(metrics, dict) or metrics.get("env_id") not in known:
        raise ValueError(f"{path}: env_id must be one of {', '.join(known)}")
    if not isinstance(metrics.get("seed"), int):
        raise ValueError(f"{path}: seed is {metrics.get('seed')!r}; it must be an integer")
    return metrics


# ---------------------------------------------------------------------------------------------------------------------
# Training curves: {TensorBoard tag: (global steps (k,), values (k,))}
# ---------------------------------------------------------------------------------------------------------------------


def read_curve(run_dir) -> dict:
    """The curve of a run from its TensorBoard events; a resumed run repeats steps, and the last value counts."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run_dir), size_guidance={"scalars": 0})
    events.Reload()
    curve = {}
    for tag in events.Tags()["scalars"]:
        values = {event.step: event.value for event in events.Scalars(tag)}
        steps = sorted(values)
        curve[tag] = np.array(steps), np.array([values[step] for step in steps])
    return curve


def write_csv(path, curve: dict):
    """Write a curve: `global_step`, then one column a tag; an empty cell where a tag has no value at that step."""
    columns = {tag: dict(zip(steps.tolist(), values.tolist())) for tag, (steps, values) in curve.items()}
    with replacing(path, "w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["global_step", *columns])
        for step in sorted(set().union(*columns.values())):
            # TensorBoard keeps float32, which nine digits give back exactly
            cells = (f"{column[step]:.9g}" if step in column else "" for column in columns.values())
            writer.writerow([step, *cells])


def read_csv(path) -> dict:
    """The curve that `write_csv` wrote; ValueError if the file is not such a table."""
    with open(path, newline="") as file:
        header, *rows = list(csv.reader(file)) or [[]]
    try:
        if header[:1] != ["global_step"] or not rows or any(len(row) != len(header) for row in rows):
            raise ValueError("global_step, then one column a TensorBoard tag, and a row")
        curve = {}
        for column, tag in enumerate(header[1:], start=1):
            filled = [row for row in rows if row[column]]
            curve[tag] = np.array([int(row[0]) for row in filled]), np.array([float(row[column]) for row in filled])
    except ValueError as error:
        raise ValueError(f"{path} is not a training curve: {error}") from error
    return curve


# ---------------------------------------------------------------------------------------------------------------------
# Rocket ascent: metrics and table. One start and a deterministic policy, so that one flight says everything
# ---------------------------------------------------------------------------------------------------------------------

SUCCESS = 0.02  # of the error's norm: ours; the paper pays for a "successful orbital insertion" and gives no bound
ELEMENT_ERRORS = {"a_km": "a_error_km", "e": "e_error", "i_deg": "i_error_deg"}
ELEMENT_ERRORS |= {"raan_deg": "raan_error_deg", "argp_deg": "argp_error_deg"}


def rocket_rows(mission: envs.Mission) -> list[tuple[str, str, int]]:
    """The rows of a rocket's table: label, metric, digits."""
    equatorial = mission.rocket.i in EQUATORIAL
    return [
        ("semi-major axis a (km)", "a_km", 3),
        ("eccentricity e", "e", 6),
        ("inclination i (deg)", "i_deg", 4),
        ("right ascension of the node (deg)", "raan_deg", 4),
        ("perigee from the x axis (deg)" if equatorial else "argument of perigee (deg)", "argp_deg", 4),
        ("perigee altitude (km)", "perigee_km", 3),
        ("apogee altitude (km)", "apogee_km", 3),
        ("final mass (kg)", "final_mass_kg", 3),
        ("  of the optimum's for the orbit reached", "mass_ratio_reached", 6),
        ("  of the optimum's for the target orbit", "mass_ratio", 6),
        ("final time (s)", "final_time_s", 3),
        ("maximum altitude (km)", "max_altitude_km", 3),
        (f"lowest altitude after {mission.late:.0f} s (km)", lowest_key(mission), 3),
        (f"||error|| (success: below {SUCCESS})", "error_norm", 6),
    ]


EQUATORIAL = (0.0, 180.0)  # inclinations in degrees at which an orbit has no node


def evaluate_rocket(env_id, policy, eval_seed: int, n: int, reference=None, dispersion: float = 0.0, **env_options):
    """`evaluate` for a rocket: `policy(obs (1, 9), t) -> action (1, 3)` flown once beside the optimum's flight.

    With `dispersion` also n dispersed flights, see `evaluate_dispersed`; without it seed and n are only noted. With the
    options `rocket` or `table_isp` the target and the optimum are those of that rocket, too. Metrics that are not
    finite (the apogee of a hyperbola) or have no meaning are left out.
    """
    changed = {name: env_options[name] for name in ("rocket", "table_isp") if name in env_options}
    mission = envs.flown_mission(envs.ROCKETS[env_id], **changed)
    if reference is None:
        reference = baselines.rocket_reference(env_id, **changed) if changed else optimum(env_id, 0, 1, mission)
    flight = envs.fly_rocket(env_id, policy, **env_options)
    metrics = {"env_id": env_id, "eval_seed": eval_seed, "eval_starts": 1} | rocket_metrics(flight, reference, mission)
    arrays = {key: flight[key] for key in ("t", "u", "y", "reward")}
    arrays |= {f"{key}_reference": reference[key] for key in ("t", "u", "y")}
    if dispersion:
        of_all, ends = evaluate_dispersed(env_id, policy, eval_seed, n, dispersion, **env_options)
        metrics, arrays = metrics | of_all, arrays | ends
    return metrics, arrays


def rocket_metrics(flight: dict, reference: dict, mission: envs.Mission) -> dict:
    """The metrics of a flight of `envs.fly_rocket` beside the optimum's, `baselines.rocket_reference`."""
    metrics, best = (flight_summary(flown, mission) for flown in (flight, reference))
    target = target_summary(mission.rocket)
    for key, error in ELEMENT_ERRORS.items():
        if key in target:
            metrics[error] = wrapped(key, metrics[key] - target[key])
    metrics |= {f"reference_{key}": value for key, value in best.items() if not key.startswith("final_")}
    metrics |= {key: reference[key] for key in ("reference_mass_kg", "reference_time_s", "nine_pitch_error_norm")}
    metrics["mass_ratio"] = metrics["final_mass_kg"] / metrics["reference_mass_kg"]
    metrics |= {key: flight[key] for key in (*envs.RocketVectorEnv.PARTS, "points")}
    metrics = {key: float(value) for key, value in metrics.items() if np.isfinite(value)}
    return metrics | {"success": bool(flight["error_norm"] < SUCCESS), "crashed": bool(flight["crashed"])}


def mass_reached(metrics: dict) -> dict:
    """`mass_ratio_reached`: the final mass / the optimum's for the five elements reached, `reference_mass_reached_kg`.

    `mass_ratio` compares two orbits: one a little off the target can be cheaper to reach. With cut-off and success
    only, for it takes a solve of half a second and an orbit to solve for; without CasADi or a solution, no key.
    """
    mission = envs.ROCKETS.get(metrics["env_id"])
    if mission is None or not mission.cutoff or not metrics["success"]:
        return {}
    flight = metrics
    if mission.rocket.i in EQUATORIAL:  # the metric counts the perigee from the x axis, an element from the node
        flight = metrics | {"argp_deg": perigee_longitude(-metrics["raan_deg"], metrics["argp_deg"], mission.rocket.i)}
    try:
        mass = float(baselines.reached_optimum(flight, mission.rocket)["final_mass"])
    except (ImportError, RuntimeError):
        return {}
    return {"mass_ratio_reached": metrics["final_mass_kg"] / mass, "reference_mass_reached_kg": mass}


def flight_summary(flight: dict, mission: envs.Mission) -> dict:
    """What is said of ours and of the optimum alike: elements, altitudes (km above Re), mass, time, return."""
    keys = ("error_norm", *ELEMENT_ERRORS, "final_mass_kg", "final_time_s", "max_altitude_km", "episodic_return")
    summary = {key: flight[key] for key in keys} | apsides(flight["a_km"], flight["e"], mission.rocket)
    if mission.rocket.i in EQUATORIAL:
        summary["argp_deg"] = perigee_longitude(summary["raan_deg"], summary["argp_deg"], mission.rocket.i)
    late = altitude_km(flight["y"], mission.rocket)[flight["t"] > mission.late]
    return summary | {lowest_key(mission): late.min(initial=np.inf)}


def lowest_key(mission: envs.Mission) -> str:
    """The metric of the lowest altitude after the air has been left, `min_altitude_after_300s_km` by default."""
    return f"min_altitude_after_{mission.late:.0f}s_km"


def perigee_longitude(raan: float, argp: float, i: float) -> float:
    """The perigee's angle from the x axis in the direction of flight, in degrees as all, where there is no node."""
    return (argp + (raan if i < 90 else -raan)) % 360.0


def apsides(a_km: float, e: float, rocket: envs.Rocket) -> dict:
    """Altitudes of perigee and apogee above Re in km; a hyperbola (a < 0) has its apogee at infinity."""
    Re = rocket.Re / 1e3
    return {"perigee_km": a_km * (1 - e) - Re, "apogee_km": a_km * (1 + e) - Re if a_km > 0 else np.inf}


def altitude_km(y: np.ndarray, rocket: envs.Rocket) -> np.ndarray:
    """Altitudes (K+1,) in km of states y (K+1, 7)."""
    return (np.linalg.norm(y[:, :3], axis=1) - rocket.Re) / 1e3


def target_summary(rocket: envs.Rocket) -> dict:
    """The target orbit in the metrics' names and units, without the angles that a circle or no node leaves open."""
    target = {"a_km": rocket.a / 1e3, "e": rocket.e, "i_deg": rocket.i, "raan_deg": rocket.raan % 360.0}
    target["argp_deg"] = rocket.argp % 360.0
    if rocket.i in EQUATORIAL:
        target["argp_deg"] = perigee_longitude(target.pop("raan_deg"), rocket.argp, rocket.i)
    if rocket.e == 0:
        del target["argp_deg"]
    return target | apsides(rocket.a / 1e3, rocket.e, rocket)


def wrapped(key: str, difference: float) -> float:
    """A difference of the metric `key`; of angles in degrees the short way round, -180 to 180."""
    return (difference + 180.0) % 360.0 - 180.0 if key.endswith("_deg") else difference


def rocket_table(metrics: dict, mission: envs.Mission) -> str:
    """The table "target | optimum | ours | difference" of a rocket's evaluation; "-" where there is no number."""
    target, table_rows = target_summary(mission.rocket), rocket_rows(mission)
    best = {key: metrics.get(f"reference_{key}") for _, key, _ in table_rows}
    best |= {"mass_ratio": 1.0, "mass_ratio_reached": 1.0}
    best |= {"final_mass_kg": metrics["reference_mass_kg"], "final_time_s": metrics["reference_time_s"]}
    rows = [("", "target", "optimum", "ours", "difference")]
    for label, key, digits in table_rows:
        if key == "mass_ratio_reached" and key not in metrics:
            continue
        ours, compared = metrics.get(key), target.get(key, best[key])
        if key in ELEMENT_ERRORS and key not in target:  # an angle that the target orbit does not have
            ours = compared = best[key] = None
        cells = ["-" if v is None else f"{v:.{digits}f}" for v in (target.get(key), best[key], ours)]
        missing = ours is None or compared is None
        rows.append((label, *cells, "-" if missing else f"{wrapped(key, ours - compared):+.{digits}f}"))
    success = ["yes" if hit else "no" for hit in (best["error_norm"] < SUCCESS, metrics["success"])]
    rows.append(("success", "-", *success, "crashed" if metrics["crashed"] else "-"))
    width = max(len(row[0]) for row in rows)
    lines = [f"{metrics['env_id']}: difference from the target, or where there is none from the optimum"]
    lines += [f"  {row[0]:<{width}}" + "".join(f" {cell:>11}" for cell in row[1:]) for row in rows]
    return "\n".join([*lines, *rocket_remarks(metrics, mission), *dispersed_lines(metrics)])


def rocket_remarks(metrics: dict, mission: envs.Mission) -> list[str]:
    """The lines below the rocket's table: what its numbers rest on, the return and its parts, the opponent."""
    lines = []
    stopped = abs(metrics.get("a_error_km", math.inf)) < 1e-3  # a crash or an empty tank may come first
    if mission.cutoff and stopped:
        lines.append("  With cut-off the engine stops at the target's orbital energy: a is exact because of this rule.")
    if "mass_ratio_reached" in metrics:
        mass = f"{metrics['reference_mass_reached_kg']:.3f} kg"
        lines.append(f"  The optimum for the five elements reached leaves {mass}: the measure of our mass.")
    returns = f"return {metrics['episodic_return']:.3f} (the optimum's {metrics['reference_episodic_return']:.3f})"
    lines.append(f"  {returns}; points (the paper's 2000 + up to 3200, their shape ours): {metrics['points']:.1f}")
    parts = ", ".join(f"{part} {metrics[part]:.3f}" for part in envs.RocketVectorEnv.PARTS)
    lines.append(f"    of it: {parts}")
    opponent = f"||error|| {metrics['nine_pitch_error_norm']:.6f}"
    return [*lines, f"  Opponent, open loop: the optimum's pitch (and yaw) at nine times, interpolated: {opponent}"]


# ---------------------------------------------------------------------------------------------------------------------
# Dispersed flights: every one has its own vehicle and air, so that a policy is measured by statistics
# ---------------------------------------------------------------------------------------------------------------------

# 1705 flights without a failure show a success rate of 99.865 % (3 sigma) at 90 % confidence: the size of NASA's Monte
# Carlo analyses by order statistics (Hanson and Beard, 2012)
DISPERSED_STARTS = 1705
AT_ONCE = 341  # flights of a batch: a fifth, so that the caches of a policy stay below 0.3 GB
# what the Falcon 9 user's guide gives as its 3 sigma accuracy of insertion into a transfer orbit (from memory)
BOX = {"perigee_km": 10.0, "apogee_km": 500.0, "i_deg": 0.1, "raan_deg": 0.1, "argp_deg": 0.3}


def draws(rocket: envs.Rocket, dispersion: float, eval_seed: int, n: int) -> np.ndarray:
    """The n draws (n, k) of a seed, standard scores: the same for every law that is measured on them.

    Clipped as the environment's own: at 3, earlier where a dispersion is so large that no such vehicle can be.
    """
    bounds = envs.draw_bounds(rocket, dispersion)
    return np.random.default_rng([eval_seed, 2]).standard_normal((n, len(bounds))).clip(-bounds, bounds)


def evaluate_dispersed(env_id: str, policy, eval_seed: int, n: int, dispersion: float, **env_options):
    """Fly `policy(obs (m, obs), t) -> action (m, 3)` on the first n draws of a seed, in batches of at most `AT_ONCE`.

    Returns the `dispersed_...` metrics of eval.json and the arrays `draw` (n, k), `final_y` (n, 7) with the true mass,
    `final_t` (n,), `final_error` (n, 6). Flights that crash or run dry are counted, and are among the errors.
    """
    rocket = env_options.get("rocket") or envs.ROCKETS[env_id].rocket
    z, parts = draws(rocket, dispersion, eval_seed, n), []
    for first in range(0, n, AT_ONCE):
        parts.append(fly_dispersed(env_id, policy, z[first : first + AT_ONCE], dispersion, **env_options))
    flights = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    metrics = {"dispersion": float(dispersion), "dispersed_starts": n} | dispersed_metrics(flights, rocket)
    return metrics, {"draw": z} | {key: flights[key] for key in ("final_y", "final_t", "final_error")}


def fly_dispersed(env_id: str, policy, z: np.ndarray, dispersion: float, **env_options) -> dict:
    """The ends of one batch of flights with the draws z (m, k): `final_info`'s arrays, `final_y` (m, 7) and others."""
    batch = envs.gym.make_vec(env_id, num_envs=len(z), dispersion=dispersion, **env_options)
    obs, _ = batch.reset(options={"draw": z})
    alive, ends, t = np.ones(len(z), dtype=bool), {}, 0
    while alive.any():
        obs, _, terminated, _, info = batch.step(policy(obs, t))
        ended, t = alive & terminated, t + 1  # an ended environment has started anew; its first flight counts
        if ended.any():
            final = {**info["final_info"], "final_y": info["final_obs"][:, :7]}
            for key, value in final.items():
                ends.setdefault(key, np.zeros_like(value))[ended] = value[ended]
        alive = alive & ~terminated
    ends["final_y"][:, 6] = ends["final_mass_kg"]  # what is observed is the flight computer's
    return ends | {"final_t": ends["final_time_s"], "final_error": ends["error"]}


def dispersed_metrics(flights: dict, rocket: envs.Rocket) -> dict:
    """The statistics of dispersed flights (n,): errors of all, elements of those that reached a closed orbit."""
    errors = flights["error_norm"]
    metrics = {"dispersed_error_median": np.median(errors), "dispersed_error_max": errors.max()}
    metrics |= {f"dispersed_error_p{p}": np.percentile(errors, p) for p in (95, 99)}
    misses, closed = element_misses(flights, rocket), (flights["a_km"] > 0) & ~flights["crashed"]
    for key, miss in misses.items():
        name, unit = key.rsplit("_", 1)
        if closed.any():
            metrics[f"dispersed_{name}_error_mean_{unit}"] = miss[closed].mean()
            metrics[f"dispersed_{name}_error_std_{unit}"] = miss[closed].std()
    inside = closed & np.all([np.abs(miss) <= BOX[key] for key, miss in misses.items()], axis=0)
    metrics |= box_rate(int(inside.sum()), len(errors))
    mass = flights["final_mass_kg"]
    metrics |= {"dispersed_mass_mean_kg": mass.mean(), "dispersed_mass_p01_kg": np.percentile(mass, 1)}
    counts = {"dispersed_dry": int(flights["dry"].sum()), "dispersed_crashed": int(flights["crashed"].sum())}
    return {key: float(value) for key, value in metrics.items() if np.isfinite(value)} | counts


def element_misses(flights: dict, rocket: envs.Rocket) -> dict:
    """What flights miss the target by, (n,) each, in the order of `BOX`: km and degrees, only angles that it has."""
    target, flown = target_summary(rocket), {key: flights[key] for key in ("i_deg", "raan_deg", "argp_deg")}
    if rocket.i in EQUATORIAL:
        flown["argp_deg"] = perigee_longitude(flown["raan_deg"], flown["argp_deg"], rocket.i)
    a, e, Re = flights["a_km"], flights["e"], rocket.Re / 1e3
    flown |= {"perigee_km": a * (1 - e) - Re, "apogee_km": a * (1 + e) - Re}
    return {key: wrapped(key, flown[key] - target[key]) for key in BOX if key in target}


def box_rate(inside: int, n: int) -> dict:
    """The share of flights inside the launcher's accuracy, and its Wilson interval at 95 % confidence."""
    from scipy.stats import binomtest

    interval = binomtest(inside, n).proportion_ci(0.95, method="wilson")
    return {
        "dispersed_box_rate": inside / n,
        "dispersed_box_low": float(interval.low),
        "dispersed_box_high": float(interval.high),
    }


def final_elements(y: np.ndarray, rocket: envs.Rocket) -> dict:
    """The elements of states (n, 7) in the names of `final_info`."""
    elements = envs.orbital_elements(y, rocket.mu)
    degrees = {f"{name}_deg": np.degrees(getattr(elements, name)) for name in ("i", "raan", "argp")}
    return {"a_km": elements.a / 1e3, "e": elements.e, **degrees}


def decision_us(env_id: str, policy, **env_options) -> float:
    """Median microseconds on one core of a policy's decision, over a flight that is alone in its batch."""
    seconds = []

    def timed(obs, t):
        begin = time.process_time()
        action = policy(obs, t)
        seconds.append(time.process_time() - begin)
        return action

    envs.fly_rocket(env_id, timed, **env_options)
    return 1e6 * float(np.median(seconds))


def dispersed_lines(metrics: dict) -> list[str]:
    """The lines below the rocket's table on its dispersed flights; none where none were flown."""
    if "dispersion" not in metrics:
        return []
    n = metrics["dispersed_starts"]
    errors = ", ".join(f"{name} {metrics[f'dispersed_error_{name}']:.6f}" for name in ("median", "p95", "p99", "max"))
    lines = [f"  {n} flights at dispersion {metrics['dispersion']:g}: ||error|| {errors}"]
    spreads = []
    for key, half in BOX.items():
        name, unit = key.rsplit("_", 1)
        if f"dispersed_{name}_error_mean_{unit}" in metrics:
            mean, std = (metrics[f"dispersed_{name}_error_{part}_{unit}"] for part in ("mean", "std"))
            digits = 2 if unit == "km" else 4
            spreads.append(f"{name} {mean:+.{digits}f} ± {std:.{digits}f} {unit} (box ± {half:g})")
    if spreads:  # of those that reached an orbit
        lines.append(f"    off the target, mean ± standard deviation: {', '.join(spreads)}")
    rate, low, high = (metrics[f"dispersed_box_{part}"] for part in ("rate", "low", "high"))
    lines.append(f"    inside the box in all of them {rate:.2%} (95 %: {low:.2%} to {high:.2%})")
    mass = f"final mass {metrics['dispersed_mass_mean_kg']:.2f} kg on average, 1 % below"
    ends = f"{metrics['dispersed_dry']} ran dry, {metrics['dispersed_crashed']} crashed"
    return [*lines, f"    {mass} {metrics['dispersed_mass_p01_kg']:.2f} kg; {ends}"]


# ---------------------------------------------------------------------------------------------------------------------
# Results folders
# ---------------------------------------------------------------------------------------------------------------------


def publish(run_dir, folder, ship: bool = False, numbers: bool = False):
    """Add a run to a results folder: its eval.json and training curve under seeds/, and the policy if it is shipped.

    The policy, its evaluation and the figures are replaced only where the folder ships none or with `ship`; with
    `numbers` the folder holds seeds/ alone. Of a small problem it keeps the flights of the first 100 starts; its
    figures are drawn of all. OSError or ValueError says what is missing or does not fit; nothing has
    been written then. All is drawn before, and seeds/<seed>.json is written last: where it is, the rest is, too.
    """
    run_dir, folder = Path(run_dir), Path(folder)
    metrics, _ = read_evaluation(run_dir)
    digest = hashlib.sha256((run_dir / "agent.safetensors").read_bytes()).hexdigest()
    if metrics.get("checkpoint_sha256") != digest:
        raise ValueError(f"{run_dir}/eval.json is not of its agent.safetensors (checkpoint_sha256 differs)")
    curve = read_curve(run_dir)
    if not curve:
        raise ValueError(f"{run_dir} has no TensorBoard scalars")
    shipped = read_metrics(folder / "eval.json") if (folder / "eval.json").exists() else None
    for path in [*folder.glob("eval.json"), *(folder / "seeds").glob("*.json")]:
        if (other := read_json(path)["env_id"]) != metrics["env_id"]:
            raise ValueError(f"{run_dir} is of {metrics['env_id']}, {path} of {other}")
    if shipped and not ship and shipped["seed"] == metrics["seed"]:
        raise ValueError(f"{folder} already ships seed {metrics['seed']}; --ship replaces it")
    seed, ships = metrics["seed"], (ship or not shipped) and not numbers
    with tempfile.TemporaryDirectory() as name:
        staged = Path(name)
        (staged / "seeds").mkdir()
        for path in (folder / "seeds").glob("*.csv"):
            write_bytes(staged / "seeds" / path.name, path.read_bytes())
        write_csv(staged / "seeds" / f"{seed}.csv", curve)
        last = staged / "seeds" / f"{seed}.json"
        write_bytes(last, (run_dir / "eval.json").read_bytes())
        if ships:
            for file in ("agent.safetensors", "eval.npz", "eval.json"):
                write_bytes(staged / file, (run_dir / file).read_bytes())
            redraw(staged)
            animate(staged)
            if metrics["env_id"] in envs.PROBLEMS:
                keep_first_starts(staged / "eval.npz")
        move(staged, folder, last, replaced=OF_ONE_POLICY if ships else ())


KEPT_STARTS = 100  # of a small problem in a results folder


def keep_first_starts(path):
    """Cut an eval.npz of a small problem to the first `KEPT_STARTS`; all of its arrays but the times are by start."""
    with np.load(path) as file:
        arrays = {key: file[key] for key in file.files}
    if len(arrays["x"]) > KEPT_STARTS:
        write_npz(path, {key: array if key == "t" else array[:KEPT_STARTS] for key, array in arrays.items()})


OF_ONE_POLICY = ("opponents.json", "figures/opponents.png", "figures/dispersed.png")  # another's would look current


def move(staged, folder, last, replaced):
    """Put every file of `staged` into a folder, one of them last; before it goes what is `replaced` by none of them."""
    files = [path for path in staged.rglob("*") if path.is_file()]
    for path in sorted(files, key=lambda path: (path == last, path)):
        if path == last:
            for name in replaced:
                if not (staged / name).exists():
                    (folder / name).unlink(missing_ok=True)
        target = folder / path.relative_to(staged)
        target.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(target, path.read_bytes())


def redraw(folder) -> list[Path]:
    """Draw the figures of a results or run folder from its files; returns their paths."""
    import figures  # Matplotlib takes a quarter of a second that only a drawing should cost

    folder = Path(folder)
    metrics, arrays = read_evaluation(folder)
    curves = {path.stem: read_csv(path) for path in sorted((folder / "seeds").glob("*.csv"))}
    curve = curves.pop(str(metrics["seed"]), None) or read_curve(folder) or None
    return figures.draw(folder / "figures", arrays, metrics, curve, list(curves.values()))


def animate(folder) -> Path:
    """Write figures/animation.gif of a results or run folder from its eval.json and eval.npz; returns its path."""
    import animation

    folder = Path(folder)
    metrics, arrays = read_evaluation(folder)
    return animation.write(folder / "figures", arrays, metrics)


SEED_ROWS = {  # key of eval.json -> its row in the table of a folder's seeds
    "ratio_of_sums": ("ratio of sums", ".4f"),
    "ratio_mean": ("mean ratio", ".4f"),
    "ratio_median": ("median ratio", ".4f"),
    "ratio_p95": ("p95", ".4f"),
    "loss_near_origin_mean": ("mean loss near the origin", ".4f"),
    "hit_rate": ("starts that hit every circle", ".1%"),
    "error_norm": ("||error||", ".6f"),
    "perigee_km": ("perigee (km)", ".2f"),
    "apogee_km": ("apogee (km)", ".2f"),
    "max_altitude_km": ("highest (km)", ".1f"),
    "min_altitude": ("lowest, late in the ascent (km)", ".1f"),  # in eval.json its key names the seconds: `lowest_key`
    "final_mass_kg": ("final mass (kg)", ".2f"),
    "mass_ratio": ("mass / optimum's", ".4f"),
    "mass_ratio_reached": ("mass / optimum's for the orbit reached", ".4f"),
    "dispersed_error_median": ("dispersed: ||error||, median", ".6f"),
    "dispersed_error_p95": ("dispersed: ||error||, p95", ".6f"),
    "dispersed_perigee_error_mean_km": ("dispersed: perigee off, mean (km)", ".2f"),
    "dispersed_perigee_error_std_km": ("dispersed: perigee off, sigma (km)", ".2f"),
    "dispersed_box_rate": ("dispersed: in the box", ".1%"),
    "dispersed_mass_mean_kg": ("dispersed: final mass, mean (kg)", ".2f"),
    "training_seconds": ("seconds of training", ".0f"),
}


def seed_lines(folder) -> list[str]:
    """A table of a results folder's seeds with their medians and ranges, a row each figure; none for one seed."""
    runs = sorted((read_json(path) for path in (Path(folder) / "seeds").glob("*.json")), key=lambda run: run["seed"])
    if len(runs) < 2:
        return []
    for run in runs:
        if run["env_id"] in envs.ROCKETS and (key := lowest_key(envs.ROCKETS[run["env_id"]])) in run:
            run["min_altitude"] = run[key]
    heads = [*(f"seed {run['seed']}" for run in runs), "median", "lowest", "highest"]
    lines = [f"{'':40}" + "".join(f"{head:>10}" for head in heads)]
    for key, (label, form) in SEED_ROWS.items():
        if values := [run[key] for run in runs if key in run]:
            if not all(isinstance(value, int | float) for value in values):
                raise ValueError(f"{key} is {values} in {folder}/seeds; it must be a number")
            cells = [format(run[key], form) if key in run else "-" for run in runs]
            cells += [format(value, form) for value in (np.median(values), min(values), max(values))]
            lines.append(f"  {label:38}" + "".join(f"{cell:>10}" for cell in cells))
    return lines


# ---------------------------------------------------------------------------------------------------------------------
# Command line
# ---------------------------------------------------------------------------------------------------------------------


def named_path(text: str) -> tuple[str, Path]:
    """Argument type: NAME=PATH."""
    name, _, path = text.partition("=")
    if not name or not path:
        raise argparse.ArgumentTypeError(f"{text!r} must be NAME=PATH, a name and an agent.safetensors")
    return name, Path(path)


def positive(text: str) -> float:
    """Argument type: a dispersion that disperses."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value <= 10:
        raise argparse.ArgumentTypeError(f"{text!r} must be a number above 0, at most 10")
    return value


def parse_args(argv=None):
    """`publish RUN_DIR FOLDER [--ship]`, `figures FOLDER`, `animate FOLDER`, `opponents FOLDER [...]`."""
    parser = OneLineParser(description="Results folders: add a run, redraw figures, print the table.")
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("publish", help="add a run to a results folder")
    command.add_argument("run_dir", type=Path, help="a finished run: runs/...")
    command.add_argument("folder", type=Path, help="results/<name>, made if it does not exist")
    command.add_argument("--ship", action="store_true", help="replace the policy that the folder ships")
    command = commands.add_parser("figures", help="redraw the figures of a results or run folder, print its table")
    command.add_argument("folder", type=Path, help="results/<name> or runs/...")
    command = commands.add_parser("animate", help="write figures/animation.gif of a results or run folder")
    command.add_argument("folder", type=Path, help="results/<name> or runs/...")
    command = commands.add_parser(
        "opponents", help="classical guidance and other policies on the same dispersed flights"
    )
    command.add_argument("folder", type=Path, help="results/<name> of a rocket with cut-off")
    command.add_argument("--dispersion", type=positive, default=1.0, metavar="K", help="default 1: envs.Dispersion")
    size = integer(10, 100_000)
    command.add_argument("--starts", type=size, default=DISPERSED_STARTS, metavar="N", help="flights, default 1705")
    command.add_argument(
        "--solved", type=size, default=200, metavar="N", help="the first of them, for IPOPT: default 200"
    )
    command.add_argument("--eval-seed", type=integer(0, 2**31 - 1), default=0, metavar="S", help="default 0")
    also = "another policy, as often as wanted"
    command.add_argument("--also", type=named_path, action="append", default=[], metavar="NAME=PATH", help=also)
    return parser.parse_args(argv)


def main():
    """Run the sub-command; what can go wrong in it ends in one line."""
    args = parse_args()
    try:
        if args.command == "animate":
            print(animate(args.folder))
            return
        if args.command == "opponents":
            import comparison

            comparison.run(args.folder, args.dispersion, args.starts, args.solved, args.eval_seed, args.also)
            return
        if args.command == "publish":
            publish(args.run_dir, args.folder, args.ship)
        else:
            for path in redraw(args.folder):
                print(path)
        print("\n".join([table(read_json(args.folder / "eval.json")), *seed_lines(args.folder)]))
    except (ImportError, OSError, RuntimeError, ValueError) as error:
        sys.exit(f"evaluate.py: {error}")


if __name__ == "__main__":
    main()
