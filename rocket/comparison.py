"""A rocket's policy against its opponents, all on the same dispersed flights: one table, opponents.json, one figure.

    python evaluate.py opponents results/rocket_cutoff --also again=results/rocket_cutoff/agent.safetensors

`guidance.py` has the opponents. Here they are flown, measured as a policy is, and printed. The policies' script flies
the policies in its own processes, so this module imports neither a script nor torch.

Reading order: policies, all on the same draws, table, command.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path

import numpy as np

from common.checkpoints import read_checkpoint
from common.errors import refuse_unless
from common.files import write_json, write_npz
from common.flying import decision_us
from common.policies import competitors, fly_by_script
from rocket import guidance
from rocket.failure import WHEN, check_failure
from rocket.kalman import Filtered
from rocket.losses import aligned, in_words, loss_lines, loss_report
from rocket.metrics import (
    AT_ONCE,
    SUCCESS,
    chosen,
    dispersed_metrics,
    evaluate_dispersed,
    failure_metrics,
    healthy,
)
from rocket.missions import ROCKETS
from rocket.navigation import checked_noise, noise_metrics
from rocket.orbits import final_elements
from rocket.rescue import Failing, Known, directions_at, failing_optima, known_optima
from rocket.vehicle import Rocket

POLICY_SCRIPT = Path(__file__).parents[1] / "ppo_gtrxl_rocket.py"
PROCESSES = 2  # processes that solve, and policies that are flown at a time
KNOWLEDGE = {  # what each opponent has to know
    "replay": "optimum once",
    "tvlqr": "optimum and its gains once",
    "tvlqr_energy": "optimum and its gains once",
    "replan": "nominal model + IPOPT on board",
    "replan_measured": "nominal exhaust velocity + IPOPT on board",
    "replan_after_lqr": "nominal exhaust velocity, optimum and its gains + IPOPT on board",
    "replan_hint": "its own exhaust velocity, drawn + IPOPT on board",
    "optimum": "the draw itself",
}
REPLANS = ("replan", "replan_measured", "replan_after_lqr", "replan_hint")
# with navigation noise these laws also fly by the estimates of a Kalman filter
FILTERED = {f"{name}_filtered": name for name in ("tvlqr_energy", "replan", "replan_measured")}
SOLVING = (*REPLANS, "replan_filtered", "replan_measured_filtered", "optimum")  # these fly only the first flights


# ---------------------------------------------------------------------------------------------------------------------
# Policies
# ---------------------------------------------------------------------------------------------------------------------


def knowledge(args: dict) -> str:
    """What a policy has to know, in words, by the arguments of its training. An older file has fewer arguments."""
    knows = "draws in training" if args.get("dispersion") else "the nominal flight in training"
    knows += ", the true mass" if args.get("observe_mass") else ""
    return knows + (", the draw itself" if args.get("observe_draw") else "")


def fly_checkpoint(path, dispersion: float, eval_seed: int, n: int, **options):
    """A policy on the first n draws of a seed: the arrays of `evaluate_dispersed`, and {`knows`, `decision_us`}.

    Raises BadInput with the script's own line if the script refuses the policy.
    """
    args = read_checkpoint(path)["args"]
    flags = {"dispersion": dispersion, "eval_starts": n, "eval_seed": eval_seed, **options}
    metrics, arrays = fly_by_script(POLICY_SCRIPT, path, flags)
    names = ("draw", "final_y", "final_t", "final_error", "failure")
    ends = {key: arrays[key] for key in names if key in arrays}
    return ends, {"knows": knowledge(args), "decision_us": metrics["decision_us"]}


# ---------------------------------------------------------------------------------------------------------------------
# Policies and opponents on the same draws
# ---------------------------------------------------------------------------------------------------------------------


class Comparison:
    """Policies and opponents on the first `n` draws of a seed. Laws that solve for each flight fly the first `solved`.

    - `arrays`: {name: the arrays of `evaluate_dispersed`}
    - `about`: {name: `knows` and `decision_us`}
    - `failures`: the options `failure` and `failure_time` of the environment, or none; with them a competitor's metrics
      are those of its healthy flights, except `failure_metrics`
    - `noise`: the option `navigation_noise` of the environment
    """

    def __init__(self, env_id: str, dispersion: float, eval_seed: int, n: int, solved: int, noise=None, **failures):
        self.env_id = env_id
        self.rocket = ROCKETS[env_id].rocket
        self.dispersion = dispersion
        self.eval_seed = eval_seed
        self.n = n
        self.solved = solved
        self.failures = failures
        self.failing = Failing(dispersion, **failures)
        self.noise = checked_noise(noise)
        self.options = dict(failures)
        if self.noise:
            self.options["navigation_noise"] = self.noise
        self.arrays, self.about, self.optima = {}, {}, []

    def fly_policies(self, checkpoints: dict):
        """Fly the policies of {name: agent.safetensors}. Raises ValueError if one flew other draws."""
        z = self.draws(self.n)

        def fly(path):
            return fly_checkpoint(path, self.dispersion, self.eval_seed, self.n, **self.options)

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
        nominal = guidance.nominal_exhaust(self.rocket)
        self.replan("replan", None)
        self.replan("replan_measured", nominal)
        self.replan("replan_after_lqr", nominal, guidance.tvlqr(env_id, by_energy=True))
        if not self.failures:  # the hint says nothing of them
            drawn = guidance.drawn_exhaust(self.rocket, self.dispersion, self.draws(self.solved))
            self.replan("replan_hint", drawn)
        if self.noise:
            self.fly("tvlqr_energy_filtered", self.behind_filter(guidance.tvlqr(env_id, by_energy=True)), self.n)
            self.replan("replan_filtered", None)
            self.replan("replan_measured_filtered", nominal)
        if self.failures:
            self.optima = failing_optima(env_id, ROCKETS[env_id], self.failing, self.draws(self.solved), PROCESSES)
        else:
            self.optima = self.solve()
        self.fly("optimum", guidance.fly_optima(env_id, self.optima, directions_at), self.solved)

    def draws(self, n: int) -> np.ndarray:
        """The first n draws of the seed."""
        return self.failing.draws(self.rocket, self.eval_seed, n)

    def fly(self, name: str, opponent, n: int):
        """Fly an opponent on the first n draws, and time its decisions unless it solves.

        An opponent that solves is made for the first `solved` flights, so it flies them in one batch.
        """
        at_once = n if name in SOLVING else AT_ONCE
        _, self.arrays[name] = evaluate_dispersed(
            self.env_id, opponent, self.eval_seed, n, self.dispersion, at_once, **self.options
        )
        self.about[name] = {"knows": KNOWLEDGE[FILTERED.get(name, name)]}
        if name in FILTERED:
            self.about[name]["knows"] += ", the noise and the dispersion"
        if name not in SOLVING:
            self.about[name]["decision_us"] = decision_us(self.env_id, opponent)

    def behind_filter(self, law):
        """The same law, which then flies by the estimates of a Kalman filter."""
        assert self.noise is not None
        return Filtered(law, self.env_id, self.noise, self.dispersion)

    def replan(self, name: str, exhaust, before=None):
        """Fly `Replanning` on the first flights, and note the number and time of its solves."""
        velocity_noise = self.noise[1] if self.noise else 0.0
        with guidance.Replanning(self.env_id, PROCESSES, exhaust, velocity_noise, before) as replanning:
            law = self.behind_filter(replanning) if name in FILTERED else replanning
            self.fly(name, law, self.solved)
        self.about[name] |= {"solves": len(replanning.seconds), "solves_failed": replanning.failed}
        if replanning.seconds:
            self.about[name]["decision_us"] = 1e6 * float(np.median(replanning.seconds))

    def solve(self, reached=None) -> list:
        """The optima that know the draws of the first flights, to the target or to the orbits of the states `reached`.

        `reached` (n, 7) has the competitors one after another. They are solved in one go, because processes take
        seconds to start.
        """
        z = self.draws(self.solved)
        if reached is not None:
            z = np.tile(z, (len(reached) // len(z), 1))
        return guidance.drawn_optima(self.env_id, self.dispersion, z, reached, PROCESSES)

    def vehicles(self, z: np.ndarray):
        """The vehicles of draws z (n, k)."""
        return self.failing.vehicles(self.rocket, z)

    def metrics(self, name: str, n: int) -> dict:
        """The metrics of a competitor's first n flights, or of all its flights if it flew fewer."""
        arrays = {key: value[:n] for key, value in self.arrays[name].items()}
        flights = recorded_flights(chosen(arrays, healthy(arrays)), self.rocket, Failing(self.dispersion))
        starts = len(flights["error_norm"])
        metrics = {"dispersed_starts": starts} | dispersed_metrics(flights, self.rocket)
        if self.failures:
            known = self.known().first(len(arrays["draw"]))
            reached = known.mass_at(arrays["final_error"], self.rocket)
            metrics |= failure_metrics(arrays, known.mass, reached, self.vehicles(arrays["draw"]).dry_mass)
        return metrics

    def known(self) -> Known:
        """What is left by the optima that know of a failure from its strike on."""
        return known_optima(self.env_id, ROCKETS[self.env_id], self.failing, self.eval_seed, self.n)

    def best(self) -> Known:
        """`known`, where the healthy flights among the first ones have what their own optimum leaves."""
        known = Known(*(values.copy() for values in self.known()))
        flights = np.flatnonzero(self.vehicles(self.draws(self.solved)).failure[0] < 0)
        known.note(flights, [self.optima[k] for k in flights])
        return known

    def flights_by_loss(self) -> dict:
        """The arrays of opponents.npz: each flight's failure, what could be saved of it, and how each competitor ended.

        - `failure` (n, 3) and `dry_mass_kg` (n,)
        - `best_mass_kg` (n,): what the optimum leaves that knows of the failure; NaN for healthy flights beyond the
          first `solved`
        - `<name>_error_norm` and `<name>_final_mass_kg` of each competitor's flights, which are the first ones
        - `<name>_mass_reached_kg`: what the same optimum leaves in the orbit that the competitor reached
        """
        vehicles = self.vehicles(self.draws(self.n))
        best = self.best()
        arrays = {"failure": vehicles.failure.T, "best_mass_kg": best.mass, "dry_mass_kg": vehicles.dry_mass}
        for name, ends in self.arrays.items():
            error = ends["final_error"]
            arrays[f"{name}_error_norm"] = np.linalg.norm(error, axis=1)
            arrays[f"{name}_final_mass_kg"] = ends["final_y"][:, 6]
            arrays[f"{name}_mass_reached_kg"] = best.first(len(error)).mass_at(error, self.rocket)
        return arrays

    def shares(self, name: str, **optima: list) -> dict:
        """A competitor's mass over that of optima that know the draw: `target`, to the target, and `reached`.

        The flights are those of the first `solved` that are a success and whose optimum was found. `reached` are the
        optima to the orbits that the competitor reached.
        """
        ends = {key: value[: self.solved] for key, value in self.arrays[name].items()}
        shares = {}
        success = (np.linalg.norm(ends["final_error"], axis=1) < SUCCESS) & healthy(ends)
        for key, found in optima.items():
            mass = np.array([optimum["final_mass"] if optimum else np.nan for optimum in found])
            share = (ends["final_y"][:, 6] / mass)[success & np.isfinite(mass)]
            shares[f"share_{key}_flights"] = len(share)
            if len(share):
                shares |= {f"share_{key}_mean": float(share.mean()), f"share_{key}_median": float(np.median(share))}
        return shares

    def optima_of_reached(self) -> dict:
        """For each competitor the optima to the orbits that it reached, as {"reached": optima}.

        With failures there are none: `flights_by_loss` corrects the mass of one optimum for the orbit reached, which
        saves thousands of solves.
        """
        if self.failures:
            return {name: {} for name in self.arrays}
        ends = [arrays["final_y"][: self.solved] for arrays in self.arrays.values()]
        optima = iter(self.solve(np.concatenate(ends)))
        return {name: {"reached": list(islice(optima, self.solved))} for name in self.arrays}

    def report(self) -> dict:
        """What opponents.json holds: each competitor's metrics, those of its first flights (`first`), and `shares`."""
        report = {"env_id": self.env_id, "dispersion": self.dispersion, "eval_seed": self.eval_seed} | self.failures
        report |= noise_metrics(self.noise)
        is_healthy = self.vehicles(self.draws(self.solved)).failure[0] < 0
        masses = [optimum["final_mass"] for optimum, counts in zip(self.optima, is_healthy) if optimum and counts]
        report["bound_flights"] = len(masses)
        if masses:
            report["bound_mass_mean_kg"] = float(np.mean(masses))
        reached = self.optima_of_reached()
        competitors = {}
        for name, about in self.about.items():
            shares = self.shares(name, target=self.optima, **reached[name])
            competitors[name] = about | self.metrics(name, self.n) | {"first": self.metrics(name, self.solved)} | shares
        report["laws"] = competitors
        if self.failures:
            report["by_loss"] = loss_report(self.flights_by_loss(), list(self.arrays), self.failures["failure"])
        return report


def recorded_flights(arrays: dict, rocket: Rocket, failing: Failing) -> dict:
    """The flights (n,) of eval.npz's arrays, in the form that `dispersed_metrics` reads."""
    y = arrays["final_y"]
    flights = final_elements(y, rocket) | {
        "final_mass_kg": y[:, 6],
        "error_norm": np.linalg.norm(arrays["final_error"], axis=1),
        "crashed": np.linalg.norm(y[:, :3], axis=1) < rocket.Re,
    }
    if "draw" in arrays:
        flights["dry"] = arrays["final_t"] >= failing.vehicles(rocket, arrays["draw"]).burn_out - 1e-6
    return flights | {key: arrays[key] for key in ("target",) if key in arrays}


# ---------------------------------------------------------------------------------------------------------------------
# Table
# ---------------------------------------------------------------------------------------------------------------------

COLUMNS = ("flights", "||error|| median", "p95", "max", "perigee off (km)", "in the box (95 %)", "mass (kg)")
COLUMNS += ("of the optimum", "orbit reached", "a decision", "knows")
WIDTHS = (7, 16, 8, 8, 16, 24, 9, 14, 14, 10, 0)


def table(report: dict) -> str:
    """opponents.json as a table: a line for each competitor, then one for the first flights of each that flew more."""
    competitors = report["laws"]
    known = report["bound_flights"]
    fewest = min(entry["dispersed_starts"] for entry in competitors.values())
    about = " healthy flights of" if "failure" in report else ""
    rows = [("", *COLUMNS)]
    rows += [(name, *cells(entry, entry, known)) for name, entry in competitors.items()]
    for name, entry in competitors.items():
        if entry["dispersed_starts"] > fewest:
            rows.append((f"{name}, the first", *cells(entry, entry["first"], known)))
    width = max(len(row[0]) for row in rows)
    draws = f"the draws of eval seed {report['eval_seed']}, the same for all"
    lines = [f"{report['env_id']} at dispersion {report['dispersion']:g},{noise_words(report)}{about} {draws}"]
    lines += [aligned(f"{name:<{width}}", others, WIDTHS) for name, *others in rows]
    lines.append("  Shares: mean mass over that of the optimum that knows the draw, to the target and to the orbit")
    flights = f"of {known} flights; of fewer (in brackets) where one missed the orbit."
    lines.append(f"    that was reached, {flights}")
    if "bound_mass_mean_kg" in report:
        lines[-1] += f" To the target it leaves {report['bound_mass_mean_kg']:.2f} kg on average."
    for name, entry in competitors.items():
        if "solves" in entry:
            lines.append(f"  {name}: {entry['solves']} solves, {entry['solves_failed']} failed.")
    return "\n".join([*lines, *failure_lines(report)])


def noise_words(report: dict) -> str:
    """The navigation noise in words, " ... ,"; empty without noise."""
    if "navigation_noise_m" not in report:
        return ""
    return f" seen with a noise of {report['navigation_noise_m']:g} m and {report['navigation_noise_m_s']:g} m/s,"


def failure_lines(report: dict) -> list[str]:
    """The table of the flights with a failure, a line for each competitor; no lines without failures."""
    if "failure" not in report:
        return []
    when = WHEN[report["failure_time"]]
    lines = [f"Flights with a failure, up to {report['failure']:.0%} of thrust lost {when}"]
    columns = {
        "failure_starts": ("flights", "g"),
        "failure_savable": ("savable", "g"),
        "failure_saved_rate": ("saved", ".1%"),
        "failure_error_median": ("||error|| median", ".6f"),
        "failure_error_p95": ("p95", ".6f"),
        "failure_mass_short_mean_kg": ("short of the optimum (kg)", ".2f"),
    }
    rows = [["", *(head for head, _ in columns.values())]]
    for name, entry in report["laws"].items():
        rows.append([name, *(format(entry[key], form) if key in entry else "-" for key, (_, form) in columns.items())])
    width = max(len(row[0]) for row in rows)
    widths = [max(len(head), 8) for head, _ in columns.values()]
    lines += [aligned(f"{name:<{width}}", others, widths) for name, *others in rows]
    return lines + loss_lines(report["by_loss"])


def share(entry: dict, name: str, known: int) -> str:
    """A competitor's share of the optima's mass, and the number of its flights in brackets if it is not `known`."""
    if f"share_{name}_mean" not in entry:
        return "-"
    flights = entry[f"share_{name}_flights"]
    return f"{entry[f'share_{name}_mean']:.3%}" + (f" ({flights})" if flights != known else "")


def cells(entry: dict, metrics: dict, known: int) -> list[str]:
    """A competitor's cells: those of its `metrics`, then those that do not depend on the number of flights.

    known is the number of flights that have an optimum which knows their draw.
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
    """A time in µs or ms; "-" if nothing is decided in flight."""
    if microseconds is None:
        return "-"
    return f"{microseconds:.0f} µs" if microseconds < 5000 else f"{microseconds / 1000:.0f} ms"


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
    """Compare a results folder's policy, and those of `also` (name, path), with all opponents. Print and write it.

    When all is flown, opponents.json and figures/opponents.png are written. With failures opponents.npz
    (`flights_by_loss`) and figures/opponents_by_loss.png are written, too. With failures at the ignition the names
    begin with opponents_at_ignition, so that both comparisons have room in one folder. Only opponents.png keeps its
    name: it shows the healthy flights, which are the same. Raises OSError or ValueError for bad input.
    """
    check_failure(failure, failure_time, ROCKETS[env_id].cutoff)
    noise = checked_noise(navigation_noise)
    refuse_unless(ROCKETS[env_id].cutoff, f"the env_id of {folder}", env_id, "must be a rocket's with cut-off")
    refuse_unless(solved <= n, "--solved", solved, f"must be at most {n}, as --starts is")
    checkpoints = competitors(env_id, folder, also, {*KNOWLEDGE, *FILTERED})
    failures = {"failure": failure, "failure_time": failure_time} if failure else {}
    comparison = Comparison(env_id, dispersion, eval_seed, n, solved, noise, **failures)
    comparison.fly_policies(checkpoints)
    comparison.fly_opponents()
    report = comparison.report()
    labelled = {}
    for name, entry in report["laws"].items():
        label = f"{in_words(name)}: {entry['dispersed_box_rate']:.1%} of {entry['dispersed_starts']}"
        arrays = comparison.arrays[name]
        labelled[label] = chosen(arrays, healthy(arrays))

    from drawing.style import save_figures
    from rocket.figures import dispersed_figure, losses_figure

    title = f"{env_id} at dispersion {dispersion:g}{noise_words(report).rstrip(',')}"
    stem = "opponents_at_ignition" if failure and failure_time == "ignition" else "opponents"
    flown = f"{title}, healthy flights" if failure else title
    figures = {"opponents.png": dispersed_figure(comparison.rocket, labelled, flown)}
    if failure:
        figures[f"{stem}_by_loss.png"] = losses_figure(report["by_loss"], f"{title}, {WHEN[failure_time]}")
        arrays = {key: values.astype(np.float32) for key, values in comparison.flights_by_loss().items()}
        write_npz(folder / f"{stem}.npz", arrays)
    write_json(folder / f"{stem}.json", report)
    print(table(report))
    for path in save_figures(folder / "figures", figures):
        print(path)
