"""A rocket's policy against its opponents, all on the same dispersed flights: one table, opponents.json, one figure.

    python evaluate.py opponents results/rocket_cutoff --also again=results/rocket_cutoff/agent.safetensors

`opponents.py` has the laws and the bound; here they are flown, measured as `evaluate.py` measures a policy, and
printed. Policies are flown by their script in processes of its own: nothing imports a script, or torch.
Reading order: policies, all laws on the same draws, table, command.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

import envs
import evaluate
import opponents
from envs import BadInput, refuse_unless

POLICY_SCRIPT = Path(__file__).with_name("ppo_gtrxl_rocket.py")
PROCESSES = 2  # that solve, and policies flown at a time
KNOWLEDGE = {  # what each law of ours has to know
    "replay": "optimum once",
    "tvlqr": "optimum and its gains once",
    "tvlqr_energy": "optimum and its gains once",
    "replan": "nominal model + IPOPT on board",
    "optimum": "the draw itself",
}


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
    args = evaluate.read_checkpoint(path, {}, flag="")["args"]
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / name for name in ("eval.json", "eval.npz")]
        flags = {"checkpoint": path, "dispersion": dispersion, "eval-starts": n, "eval-seed": eval_seed}
        flags |= {"eval-json": files[0], "eval-npz": files[1], "num-threads": 1}
        command = [sys.executable, str(POLICY_SCRIPT), "--eval-only", "--no-cuda"]
        command += [f"--{name}={value}" for name, value in flags.items()]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            said = done.stderr.strip().splitlines() or [f"{POLICY_SCRIPT.name} ended with {done.returncode}"]
            raise BadInput(f"{path}: {said[-1]}")
        decision_us = json.loads(files[0].read_text())["decision_us"]
        with np.load(files[1]) as file:
            arrays = {key: file[key] for key in ("draw", "final_y", "final_t", "final_error")}
    return arrays, {"knows": knowledge(args), "decision_us": decision_us}


# ---------------------------------------------------------------------------------------------------------------------
# All laws on the same draws
# ---------------------------------------------------------------------------------------------------------------------


class Comparison:
    """Policies and laws on the first `n` draws of a seed; what solves for each flight, on the first `solved` alone.

    `arrays`: by law, those of `evaluate.evaluate_dispersed`; `about`: by law, `knows` and `decision_us`.
    """

    def __init__(self, env_id: str, dispersion: float, eval_seed: int, n: int, solved: int):
        self.env_id, self.rocket, self.dispersion = env_id, envs.ROCKETS[env_id].rocket, dispersion
        self.eval_seed, self.n, self.solved = eval_seed, n, solved
        self.arrays, self.about, self.optima = {}, {}, []

    def fly_policies(self, checkpoints: dict):
        """Fly the policies of these files, name -> agent.safetensors; ValueError where one flew other draws."""
        z = evaluate.draws(self.rocket, self.dispersion, self.eval_seed, self.n)
        fly = lambda path: fly_checkpoint(path, self.dispersion, self.eval_seed, self.n)  # noqa: E731
        with ThreadPoolExecutor(PROCESSES) as pool:  # each thread waits for a process
            for name, flown in zip(checkpoints, pool.map(fly, checkpoints.values())):
                if not np.array_equal(flown[0]["draw"], z):
                    raise ValueError(f"{name} did not fly the draws of eval seed {self.eval_seed}")
                self.arrays[name], self.about[name] = flown

    def fly_opponents(self):
        """Fly `opponents`' laws, and the optima that know the draw."""
        env_id = self.env_id
        self.fly("replay", opponents.replay(env_id), self.n)
        self.fly("tvlqr", opponents.tvlqr(env_id), self.n)
        self.fly("tvlqr_energy", opponents.tvlqr(env_id, by_energy=True), self.n)
        with opponents.Replan(env_id, PROCESSES) as law:
            self.fly("replan", law, self.solved)
            self.about["replan"] |= {"solves": len(law.seconds), "solves_failed": law.failed}
            if law.seconds:
                self.about["replan"]["decision_us"] = 1e6 * float(np.median(law.seconds))
        self.optima = self.solve()
        self.fly("optimum", opponents.fly_optima(env_id, self.optima), self.solved)

    def fly(self, name: str, law, n: int):
        """Fly a law on the first n draws; what solves tells the time of its decisions itself."""
        _, self.arrays[name] = evaluate.evaluate_dispersed(self.env_id, law, self.eval_seed, n, self.dispersion)
        self.about[name] = {"knows": KNOWLEDGE[name]}
        if name not in ("replan", "optimum"):
            self.about[name]["decision_us"] = evaluate.decision_us(self.env_id, law)

    def solve(self, reached=None) -> list:
        """The optima that know the draws of the first flights, to the target or to the orbits of `reached`.

        `reached`: states (n, 7) of one law after the other; solved in one go, since processes take seconds to start.
        """
        z = evaluate.draws(self.rocket, self.dispersion, self.eval_seed, self.solved)
        if reached is not None:
            z = np.tile(z, (len(reached) // len(z), 1))
        return opponents.drawn_optima(self.env_id, self.dispersion, z, reached, PROCESSES)

    def metrics(self, name: str, n: int) -> dict:
        """The `dispersed_...` metrics of a law's first n flights, or of all where it flew fewer."""
        flights = recorded_flights(
            {key: value[:n] for key, value in self.arrays[name].items()}, self.rocket, self.dispersion
        )
        starts = len(flights["error_norm"])
        return {"dispersed_starts": starts} | evaluate.dispersed_metrics(flights, self.rocket)

    def shares(self, name: str, reached: list) -> dict:
        """A law's mass over that of the optimum that knows the draw: to the target, and to the orbit that it `reached`.

        Of those of the first flights that are successes and whose optimum was found.
        """
        ends, shares = {key: value[: self.solved] for key, value in self.arrays[name].items()}, {}
        success = np.linalg.norm(ends["final_error"], axis=1) < evaluate.SUCCESS
        for key, optima in (("target", self.optima), ("reached", reached)):
            mass = np.array([optimum["final_mass"] if optimum else np.nan for optimum in optima])
            share = (ends["final_y"][:, 6] / mass)[success & np.isfinite(mass)]
            shares[f"share_{key}_flights"] = len(share)
            if len(share):
                shares |= {f"share_{key}_mean": float(share.mean()), f"share_{key}_median": float(np.median(share))}
        return shares

    def report(self) -> dict:
        """What opponents.json holds: of each law its metrics, those of its first flights (`first`), and `shares`."""
        report = {"env_id": self.env_id, "dispersion": self.dispersion, "eval_seed": self.eval_seed}
        masses = [optimum["final_mass"] for optimum in self.optima if optimum]
        report["bound_flights"] = len(masses)
        if masses:
            report["bound_mass_mean_kg"] = float(np.mean(masses))
        reached = self.solve(np.concatenate([arrays["final_y"][: self.solved] for arrays in self.arrays.values()]))
        laws = {}
        for k, (name, about) in enumerate(self.about.items()):
            shares = self.shares(name, reached[k * self.solved : (k + 1) * self.solved])
            laws[name] = about | self.metrics(name, self.n) | {"first": self.metrics(name, self.solved)} | shares
        return report | {"laws": laws}


def recorded_flights(arrays: dict, rocket: envs.Rocket, dispersion: float) -> dict:
    """What `evaluate.dispersed_metrics` reads, of flights (n,) as eval.npz has them."""
    y, burn_out = arrays["final_y"], envs.draw_vehicles(rocket, dispersion, arrays["draw"]).burn_out
    flights = evaluate.final_elements(y, rocket) | {"final_mass_kg": y[:, 6]}
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
    """opponents.json as a table: a line a law, then the first flights of the laws that flew more."""
    laws, bound = report["laws"], report["bound_flights"]
    fewest = min(law["dispersed_starts"] for law in laws.values())
    rows = [("", *COLUMNS), *((name, *cells(law, law, bound)) for name, law in laws.items())]
    more = {name: law for name, law in laws.items() if law["dispersed_starts"] > fewest}
    rows += [(f"{name}, the first", *cells(law, law["first"], bound)) for name, law in more.items()]
    width = max(len(row[0]) for row in rows)
    draws = f"the draws of eval seed {report['eval_seed']}, the same for all"
    lines = [f"{report['env_id']} at dispersion {report['dispersion']:g}, {draws}"]
    for name, *others in rows:
        lines.append(f"  {name:<{width}}" + "".join(f"  {cell:>{w}}" for cell, w in zip(others, WIDTHS)))
    lines.append("  Shares: mean mass over that of the optimum that knows the draw, to the target and to the orbit")
    flights = f"of {bound} flights; of fewer (in brackets) where a law missed the orbit."
    lines.append(f"    that was reached, {flights}")
    if "bound_mass_mean_kg" in report:
        lines[-1] += f" To the target it leaves {report['bound_mass_mean_kg']:.2f} kg on average."
    return "\n".join(
        [*lines, f"  replan: {laws['replan']['solves']} solves, {laws['replan']['solves_failed']} failed."]
    )


def share(law: dict, name: str, bound_flights: int) -> str:
    """A law's share of the bound's mass, with the number of its flights where they are not all that have a bound."""
    if f"share_{name}_mean" not in law:
        return "-"
    flights = law[f"share_{name}_flights"]
    return f"{law[f'share_{name}_mean']:.3%}" + (f" ({flights})" if flights != bound_flights else "")


def cells(law: dict, metrics: dict, bound_flights: int) -> list[str]:
    """A law's cells of the table: those of its `metrics`, then what does not depend on how many flights they are of."""
    found = [str(metrics["dispersed_starts"])]
    found += [
        f"{metrics[f'dispersed_error_{name}']:.{digits}f}" for name, digits in (("median", 6), ("p95", 6), ("max", 6))
    ]
    perigee = [metrics.get(f"dispersed_perigee_error_{part}_km") for part in ("mean", "std")]
    found.append("-" if None in perigee else f"{perigee[0]:+.2f} ± {perigee[1]:.2f}")
    rate, low, high = (metrics[f"dispersed_box_{part}"] for part in ("rate", "low", "high"))
    found += [f"{rate:.1%} ({low:.1%} to {high:.1%})", f"{metrics['dispersed_mass_mean_kg']:.2f}"]
    found += [share(law, name, bound_flights) for name in ("target", "reached")]
    return [*found, duration(law.get("decision_us")), law["knows"]]


def duration(microseconds: float | None) -> str:
    """A time in the unit that suits it; "-" where nothing is decided in flight."""
    if microseconds is None:
        return "-"
    return f"{microseconds:.0f} µs" if microseconds < 5000 else f"{microseconds / 1000:.0f} ms"


# ---------------------------------------------------------------------------------------------------------------------
# Command
# ---------------------------------------------------------------------------------------------------------------------


def check(folder: Path, n: int, solved: int, checkpoints: dict) -> str:
    """The environment id of a results folder; BadInput, before anything is flown, where the flags do not fit it."""
    env_id = evaluate.read_json(folder / "eval.json")["env_id"]
    has_optimum = env_id in envs.ROCKETS and envs.ROCKETS[env_id].cutoff
    refuse_unless(has_optimum, f"the env_id of {folder}", env_id, "must be a rocket's with cut-off")
    most = min(n, evaluate.AT_ONCE)
    refuse_unless(
        solved <= most, "--solved", solved, f"must be at most {most}: --starts is {n}, a batch {evaluate.AT_ONCE}"
    )
    for path in checkpoints.values():
        other = evaluate.read_checkpoint(path, {}, flag="")["args"]["env_id"]
        refuse_unless(other == env_id, f"the env_id of {path}", other, f"must be {env_id}, as that of {folder}")
    refuse_unless(os.access(folder, os.W_OK), "the folder", folder, "must be writable")
    return env_id


def run(folder: Path, dispersion: float, n: int, solved: int, eval_seed: int, also=()):
    """Compare a results folder's policy, and those of `also` (name, path), with all opponents; print and write it.

    opponents.json and figures/opponents.png are written when all is flown. OSError or ValueError says what is bad.
    """
    checkpoints = {"policy": folder / "agent.safetensors"}
    for name, path in also:
        refuse_unless(
            name not in {*checkpoints, *KNOWLEDGE}, "the NAME of --also", name, "must be that of no other law"
        )
        checkpoints[name] = path
    comparison = Comparison(check(folder, n, solved, checkpoints), dispersion, eval_seed, n, solved)
    comparison.fly_policies(checkpoints)
    comparison.fly_opponents()
    import figures

    report, labelled = comparison.report(), {}
    for name, law in report["laws"].items():
        labelled[f"{name}: {law['dispersed_box_rate']:.1%} of {law['dispersed_starts']}"] = comparison.arrays[name]
    figure = figures.draw_dispersed(labelled, report)
    evaluate.write_json(folder / "opponents.json", report)
    print(table(report))
    for path in figures.save(folder / "figures", {"opponents.png": figure}):
        print(path)
