"""A rocket's policy against its opponents, all on the same dispersed flights: one table, opponents.json, one figure.

    python evaluate.py opponents results/rocket_cutoff --also again=results/rocket_cutoff/agent.safetensors

`guidance.py` has the opponents; here they are flown, measured as a policy is, and printed. Policies are flown by their
script in processes of its own: nothing imports a script, or torch.
Reading order: policies, all on the same draws, table, command.
"""

from __future__ import annotations

import json
import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from common.checkpoints import read_checkpoint
from common.errors import refuse_unless
from common.files import write_json
from common.policies import evaluate_by_script
from rocket import guidance
from rocket.dispersion import draw_vehicles
from rocket.metrics import (
    AT_ONCE,
    SUCCESS,
    decision_us,
    dispersed_metrics,
    draws,
    evaluate_dispersed,
    final_elements,
)
from rocket.missions import ROCKETS
from rocket.vehicle import Rocket

POLICY_SCRIPT = Path(__file__).parents[1] / "ppo_gtrxl_rocket.py"
PROCESSES = 2  # that solve, and policies flown at a time
KNOWLEDGE = {  # what each opponent has to know
    "replay": "optimum once",
    "tvlqr": "optimum and its gains once",
    "tvlqr_energy": "optimum and its gains once",
    "replan": "nominal model + IPOPT on board",
    "replan_measured": "nominal exhaust velocity + IPOPT on board",
    "replan_hint": "its own exhaust velocity, drawn + IPOPT on board",
    "optimum": "the draw itself",
}
REPLANS = ("replan", "replan_measured", "replan_hint")


# ---------------------------------------------------------------------------------------------------------------------
# Policies
# ---------------------------------------------------------------------------------------------------------------------


def knowledge(args: dict) -> str:
    """What a policy has to know, by the arguments of its training; an older file's have fewer."""
    knows = "draws in training" if args.get("dispersion") else "the nominal flight in training"
    knows += ", the true mass" if args.get("observe_mass") else ""
    return knows + (", the draw itself" if args.get("observe_draw") else "")


def fly_checkpoint(path, dispersion: float, eval_seed: int, n: int):
    """A policy on the first n draws of a seed: the arrays of `evaluate_dispersed`, `knows` and `decision_us`.

    BadInput with the script's own line where it refuses.
    """
    args = read_checkpoint(path, {}, flag="")["args"]
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / name for name in ("eval.json", "eval.npz")]
        flags = {"dispersion": dispersion, "eval-starts": n, "eval-seed": eval_seed}
        flags |= {"eval-json": files[0], "eval-npz": files[1], "num-threads": 1}
        evaluate_by_script(POLICY_SCRIPT, path, flags)
        decision_us = json.loads(files[0].read_text())["decision_us"]
        with np.load(files[1]) as file:
            arrays = {key: file[key] for key in ("draw", "final_y", "final_t", "final_error")}
    return arrays, {"knows": knowledge(args), "decision_us": decision_us}


# ---------------------------------------------------------------------------------------------------------------------
# Policies and opponents on the same draws
# ---------------------------------------------------------------------------------------------------------------------


class Comparison:
    """Policies and opponents on the first `n` draws of a seed; what solves for each flight on the first `solved`.

    `arrays`: by name, those of `evaluate_dispersed`; `about`: by name, `knows` and `decision_us`.
    """

    def __init__(self, env_id: str, dispersion: float, eval_seed: int, n: int, solved: int):
        self.env_id, self.rocket, self.dispersion = env_id, ROCKETS[env_id].rocket, dispersion
        self.eval_seed, self.n, self.solved = eval_seed, n, solved
        self.arrays, self.about, self.optima = {}, {}, []

    def fly_policies(self, checkpoints: dict):
        """Fly the policies of these files, name -> agent.safetensors; ValueError where one flew other draws."""
        z = draws(self.rocket, self.dispersion, self.eval_seed, self.n)
        fly = lambda path: fly_checkpoint(path, self.dispersion, self.eval_seed, self.n)  # noqa: E731
        with ThreadPoolExecutor(PROCESSES) as pool:  # each thread waits for a process
            for name, flown in zip(checkpoints, pool.map(fly, checkpoints.values())):
                if not np.array_equal(flown[0]["draw"], z):
                    raise ValueError(f"{name} did not fly the draws of eval seed {self.eval_seed}")
                self.arrays[name], self.about[name] = flown

    def fly_opponents(self):
        """Fly the guidance laws, and the optima that know the draw."""
        env_id = self.env_id
        self.fly("replay", guidance.open_loop(env_id), self.n)
        self.fly("tvlqr", guidance.tvlqr(env_id), self.n)
        self.fly("tvlqr_energy", guidance.tvlqr(env_id, by_energy=True), self.n)
        z = draws(self.rocket, self.dispersion, self.eval_seed, self.solved)
        drawn = guidance.drawn_exhaust(self.rocket, self.dispersion, z)
        for name, exhaust in zip(REPLANS, (None, guidance.nominal_exhaust(self.rocket), drawn)):
            self.replan(name, exhaust)
        self.optima = self.solve()
        self.fly("optimum", guidance.fly_optima(env_id, self.optima), self.solved)

    def fly(self, name: str, opponent, n: int):
        """Fly an opponent on the first n draws; what solves tells the time of its decisions itself."""
        _, self.arrays[name] = evaluate_dispersed(self.env_id, opponent, self.eval_seed, n, self.dispersion)
        self.about[name] = {"knows": KNOWLEDGE[name]}
        if name not in (*REPLANS, "optimum"):
            self.about[name]["decision_us"] = decision_us(self.env_id, opponent)

    def replan(self, name: str, exhaust):
        """Fly `Replanning` on the first flights."""
        with guidance.Replanning(self.env_id, PROCESSES, exhaust) as replanning:
            self.fly(name, replanning, self.solved)
        self.about[name] |= {"solves": len(replanning.seconds), "solves_failed": replanning.failed}
        if replanning.seconds:
            self.about[name]["decision_us"] = 1e6 * float(np.median(replanning.seconds))

    def solve(self, reached=None) -> list:
        """The optima that know the draws of the first flights, to the target or to the orbits of `reached`.

        `reached`: states (n, 7), competitor by competitor; solved in one go, since processes take seconds to start.
        """
        z = draws(self.rocket, self.dispersion, self.eval_seed, self.solved)
        if reached is not None:
            z = np.tile(z, (len(reached) // len(z), 1))
        return guidance.drawn_optima(self.env_id, self.dispersion, z, reached, PROCESSES)

    def metrics(self, name: str, n: int) -> dict:
        """The `dispersed_...` metrics of a competitor's first n flights, or of all where it flew fewer."""
        flights = recorded_flights(
            {key: value[:n] for key, value in self.arrays[name].items()}, self.rocket, self.dispersion
        )
        starts = len(flights["error_norm"])
        return {"dispersed_starts": starts} | dispersed_metrics(flights, self.rocket)

    def shares(self, name: str, reached: list) -> dict:
        """A competitor's mass over that of the optimum that knows the draw: to the target, and to the orbit `reached`.

        Of those of the first flights that are successes and whose optimum was found.
        """
        ends, shares = {key: value[: self.solved] for key, value in self.arrays[name].items()}, {}
        success = np.linalg.norm(ends["final_error"], axis=1) < SUCCESS
        for key, optima in (("target", self.optima), ("reached", reached)):
            mass = np.array([optimum["final_mass"] if optimum else np.nan for optimum in optima])
            share = (ends["final_y"][:, 6] / mass)[success & np.isfinite(mass)]
            shares[f"share_{key}_flights"] = len(share)
            if len(share):
                shares |= {f"share_{key}_mean": float(share.mean()), f"share_{key}_median": float(np.median(share))}
        return shares

    def report(self) -> dict:
        """What opponents.json holds: of each its metrics, those of its first flights (`first`), and `shares`."""
        report = {"env_id": self.env_id, "dispersion": self.dispersion, "eval_seed": self.eval_seed}
        masses = [optimum["final_mass"] for optimum in self.optima if optimum]
        report["bound_flights"] = len(masses)
        if masses:
            report["bound_mass_mean_kg"] = float(np.mean(masses))
        reached = self.solve(np.concatenate([arrays["final_y"][: self.solved] for arrays in self.arrays.values()]))
        competitors = {}
        for k, (name, about) in enumerate(self.about.items()):
            shares = self.shares(name, reached[k * self.solved : (k + 1) * self.solved])
            competitors[name] = about | self.metrics(name, self.n) | {"first": self.metrics(name, self.solved)} | shares
        return report | {"laws": competitors}


def recorded_flights(arrays: dict, rocket: Rocket, dispersion: float) -> dict:
    """What `dispersed_metrics` reads, of flights (n,) as eval.npz has them."""
    y, burn_out = arrays["final_y"], draw_vehicles(rocket, dispersion, arrays["draw"]).burn_out
    flights = final_elements(y, rocket) | {"final_mass_kg": y[:, 6]}
    flights |= {
        "error_norm": np.linalg.norm(arrays["final_error"], axis=1),
        "dry": arrays["final_t"] >= burn_out - 1e-6,
    }
    return flights | {"crashed": np.linalg.norm(y[:, :3], axis=1) < rocket.Re}


# ---------------------------------------------------------------------------------------------------------------------
# Table
# ---------------------------------------------------------------------------------------------------------------------

COLUMNS = ("flights", "||error|| median", "p95", "max", "perigee off (km)", "in the box (95 %)", "mass (kg)")
COLUMNS += ("of the bound", "orbit reached", "a decision", "knows")
WIDTHS = (7, 16, 8, 8, 16, 24, 9, 14, 14, 10, 0)


def table(report: dict) -> str:
    """opponents.json as a table: a line a competitor, then the first flights of those that flew more."""
    competitors, known = report["laws"], report["bound_flights"]
    fewest = min(entry["dispersed_starts"] for entry in competitors.values())
    rows = [("", *COLUMNS)]
    rows += [(name, *cells(entry, entry, known)) for name, entry in competitors.items()]
    for name, entry in competitors.items():
        if entry["dispersed_starts"] > fewest:
            rows.append((f"{name}, the first", *cells(entry, entry["first"], known)))
    width = max(len(row[0]) for row in rows)
    draws = f"the draws of eval seed {report['eval_seed']}, the same for all"
    lines = [f"{report['env_id']} at dispersion {report['dispersion']:g}, {draws}"]
    for name, *others in rows:
        lines.append(f"  {name:<{width}}" + "".join(f"  {cell:>{w}}" for cell, w in zip(others, WIDTHS)))
    lines.append("  Shares: mean mass over that of the optimum that knows the draw, to the target and to the orbit")
    flights = f"of {known} flights; of fewer (in brackets) where one missed the orbit."
    lines.append(f"    that was reached, {flights}")
    if "bound_mass_mean_kg" in report:
        lines[-1] += f" To the target it leaves {report['bound_mass_mean_kg']:.2f} kg on average."
    for name in REPLANS:
        solves, failed = (competitors[name][key] for key in ("solves", "solves_failed"))
        lines.append(f"  {name}: {solves} solves, {failed} failed.")
    return "\n".join(lines)


def share(entry: dict, name: str, known: int) -> str:
    """A competitor's share of the optima's mass, with the number of its flights where they are not all `known` ones."""
    if f"share_{name}_mean" not in entry:
        return "-"
    flights = entry[f"share_{name}_flights"]
    return f"{entry[f'share_{name}_mean']:.3%}" + (f" ({flights})" if flights != known else "")


def cells(entry: dict, metrics: dict, known: int) -> list[str]:
    """A competitor's cells: those of its `metrics`, then what does not depend on how many flights they are of.

    known: how many flights have an optimum that knows their draw.
    """
    errors = [f"{metrics[f'dispersed_error_{name}']:.6f}" for name in ("median", "p95", "max")]
    perigee = [metrics.get(f"dispersed_perigee_error_{part}_km") for part in ("mean", "std")]
    perigee = "-" if None in perigee else f"{perigee[0]:+.2f} ± {perigee[1]:.2f}"
    rate, low, high = (metrics[f"dispersed_box_{part}"] for part in ("rate", "low", "high"))
    return [
        str(metrics["dispersed_starts"]),
        *errors,
        perigee,
        f"{rate:.1%} ({low:.1%} to {high:.1%})",
        f"{metrics['dispersed_mass_mean_kg']:.2f}",
        share(entry, "target", known),
        share(entry, "reached", known),
        duration(entry.get("decision_us")),
        entry["knows"],
    ]


def duration(microseconds: float | None) -> str:
    """A time in the unit that suits it; "-" where nothing is decided in flight."""
    if microseconds is None:
        return "-"
    return f"{microseconds:.0f} µs" if microseconds < 5000 else f"{microseconds / 1000:.0f} ms"


# ---------------------------------------------------------------------------------------------------------------------
# Command
# ---------------------------------------------------------------------------------------------------------------------


def check(env_id: str, folder: Path, n: int, solved: int, checkpoints: dict):
    """BadInput, before anything is flown, where the flags do not fit a results folder of this id."""
    refuse_unless(ROCKETS[env_id].cutoff, f"the env_id of {folder}", env_id, "must be a rocket's with cut-off")
    most = min(n, AT_ONCE)
    allowed = f"must be at most {most}: --starts is {n}, a batch {AT_ONCE}"
    refuse_unless(solved <= most, "--solved", solved, allowed)
    for path in checkpoints.values():
        other = read_checkpoint(path, {}, flag="")["args"]["env_id"]
        refuse_unless(other == env_id, f"the env_id of {path}", other, f"must be {env_id}, as that of {folder}")
    refuse_unless(os.access(folder, os.W_OK), "the folder", folder, "must be writable")


def compare(env_id: str, folder: Path, dispersion: float, n: int, solved: int, eval_seed: int, also=()):
    """Compare a results folder's policy, and those of `also` (name, path), with all opponents; print and write it.

    opponents.json and figures/opponents.png are written when all is flown. OSError or ValueError says what is bad.
    """
    checkpoints = {"policy": folder / "agent.safetensors"}
    for name, path in also:
        is_new = name not in {*checkpoints, *KNOWLEDGE}
        refuse_unless(is_new, "the NAME of --also", name, "must be that of no other row")
        checkpoints[name] = path
    check(env_id, folder, n, solved, checkpoints)
    comparison = Comparison(env_id, dispersion, eval_seed, n, solved)
    comparison.fly_policies(checkpoints)
    comparison.fly_opponents()
    report, labelled = comparison.report(), {}
    for name, entry in report["laws"].items():
        label = f"{name}: {entry['dispersed_box_rate']:.1%} of {entry['dispersed_starts']}"
        labelled[label] = comparison.arrays[name]

    from drawing.style import save_figures
    from rocket.figures import dispersed_figure

    title = f"{env_id} at dispersion {dispersion:g}"
    figure = dispersed_figure(comparison.rocket, labelled, title)
    write_json(folder / "opponents.json", report)
    print(table(report))
    for path in save_figures(folder / "figures", {"opponents.png": figure}):
        print(path)
