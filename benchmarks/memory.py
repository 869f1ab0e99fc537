"""What the memory is for: the table and the figure of results/memory, from the evaluations of its runs.

    python -m benchmarks.memory              # prints, draws: seconds
    python -m benchmarks.memory --by-seed    # a line for each run

results/memory/README.md has the commands that train the runs. The ablation is not about the memory. It shows what each
addition to PPO brings (docs/method.md).

Each row is one way of learning. Each number is the median over its seeds, with the range of all. Rows without a
finished run are left out. The experiment with the hidden velocity also has the expected cost that no memory can beat.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

import baselines
import envs
from benchmarks.records import cell
from common.command_line import OneLineParser
from common.evaluations import read_json
from drawing.style import save_figures

FOLDER = Path(__file__).resolve().parents[1] / "results" / "memory"


@dataclass
class Experiment:
    """Runs that differ in one thing: the question, and the keys of eval.json that answer it."""

    title: str
    rows: dict[str, str]  # folder, seen from results/memory/<experiment> -> what is printed of it
    keys: dict[str, str]  # key of eval.json -> what is printed of it; the first is drawn
    log: bool = False  # whether the figure's axis is logarithmic
    bound: Callable | None = None  # () -> {key: the value that no memory can beat}, for the keys with a known one
    drawn: bool = True


def lengths(*steps):
    return {f"memory_{L}": f"L_mem {L}" for L in steps}


@functools.cache
def velocity_from_the_second_step():
    """The least ratio of sums if the first action is chosen without the velocity, over the starts of eval.json.

    Two positions and the action between them tell the velocity, so a memory can know it from the second step on. The
    best first action for the expected quadratic cost is that of velocity zero, the mean over the starts (certainty
    equivalence, e.g. Bertsekas, Dynamic Programming and Optimal Control, vol. 1). For other statistics it is not the
    best: actions that cost more on average can have a lower p95. On 1000 starts and with the bound on u the value holds
    to three digits.
    """
    problem = envs.DOUBLE_INTEGRATOR
    lqr = baselines.lqr_policy(problem)
    x0 = baselines.starts(0, 1000)

    def blind_at_first(obs, t):
        return lqr(obs * [1.0, float(t > 0), 1.0], t)

    flight, best = (envs.fly(problem.env_id, flown, x0) for flown in (blind_at_first, lqr))
    return {"ratio_of_sums": flight["cost"].sum() / best["cost"].sum()}


PLAIN = {"mlp": "MLP of about the same size", "no_blocks": "MLP as wide as ours"}


def rocket_rows(result):
    """The rocket's rows. L_mem 32 is the front page's result, whose runs are not trained twice."""
    return {**lengths(0, 1), f"../../{result}": "L_mem 32", **PLAIN}


DISPERSED = {
    "dispersed_error_median": "median",
    "dispersed_error_p95": "p95",
    "dispersed_perigee_error_std_km": "perigee, sigma (km)",
    "dispersed_box_rate": "in the box",
    "dispersed_mass_mean_kg": "mass (kg)",
}
FAILED = {
    "failure_saved_rate": "saved",
    "failure_error_median": "median",
    "failure_error_p95": "p95",
    "failure_mass_short_mean_kg": "short (kg)",
    "dispersed_error_median": "median, no failure",
}
LANDED = {
    "landed_rate": "landed",
    "position_error_mean_m": "position error, mean (m)",
    "position_error_p95_m": "p95 (m)",
    "speed_mean_m_s": "speed, mean (m/s)",
    "fuel_ratio": "propellant / optimum's",
}
EXPERIMENTS = {
    "hidden_velocity": Experiment(
        "Double integrator, velocity hidden: cost over the optimum's, which sees it (ratio of sums)",
        {
            **lengths(0, 1, 4, 32),
            "shown_memory_0": "L_mem 0, velocity shown",
            "../../di": "L_mem 32, velocity shown",
        },
        {"ratio_of_sums": "ratio of sums", "ratio_p95": "p95", "hit_rate": "hit the circle"},
        log=True,
        bound=velocity_from_the_second_step,
    ),
    "hidden_phase": Experiment(
        "Double integrator, two waypoints, time and phase hidden: share of the starts that hit both circles",
        {
            **lengths(0, 32),
            "shown_memory_0": "L_mem 0, both shown",
            "../../di_waypoints": "L_mem 32, both shown",
        },
        {
            "hit_rate": "hit both",
            "hit_rate_phase_1": "circle 1",
            "hit_rate_phase_2": "circle 2",
            "ratio_of_sums": "ratio of sums of those",
        },
    ),
    "../ablation": Experiment(
        "Double integrator, the command of results/di with one addition off",
        {
            "../di": "all additions",
            "noise_learned": "noise learned",
            "rate_constant": "learning rate constant",
            "rate_linear": "learning rate falls linearly",
            "no_groups": "flights not compared",
            "memory_noise_stays": "noise of the memory stays",
            "last_weights": "last weights, not averaged",
            "no_kl_limit": "no KL limit",
            "lambda_stays": "GAE lambda stays at 0.95",
            "discounted": "gamma 0.99",
            "rewards_unscaled": "rewards not scaled",
        },
        {
            "ratio_of_sums": "ratio of sums",
            "ratio_mean": "mean ratio",
            "ratio_p95": "p95",
            "hit_rate": "hit the circle",
        },
        drawn=False,
    ),
    "nominal": Experiment(
        "Rocket, cut-off, nominal flight: the policies that the next rows begin with",
        rocket_rows("rocket_cutoff"),
        {"error_norm": "||error||", "perigee_km": "perigee (km)", "final_mass_kg": "mass (kg)"},
        drawn=False,
    ),
    "rocket": Experiment(
        "Dispersed rocket, cut-off: ||error|| over 1705 flights",
        rocket_rows("rocket_dispersed"),
        DISPERSED,
    ),
    "failures": Experiment(
        "Dispersed rocket, loss of thrust at a random moment: share of the savable flights that are saved",
        {**lengths(0, 32), "mlp": PLAIN["mlp"], "../../rocket_failures": PLAIN["no_blocks"]},
        FAILED,
    ),
    "navigation": Experiment(
        "Dispersed rocket, position and velocity seen with noise of 10 m and 0.1 m/s: ||error|| over 1705 flights",
        lengths(0, 32),
        DISPERSED,
        drawn=False,
    ),
    "lander": Experiment(
        "Landing, failure from the start: share of the flights that landed",
        {
            **lengths(0),
            "../../mars_landing": "L_mem 8",
            **PLAIN,
        },
        LANDED,
    ),
}


def read(folder, experiment):
    """The evaluations of every seed: row -> list of eval.json."""
    paths = {row: sorted((folder / row / "seeds").glob("*.json")) for row in experiment.rows}
    return {row: [read_json(path) for path in seeds] for row, seeds in paths.items() if seeds}


def cell_of(runs, key):
    """The cell of a key, with the number of runs that have it if some do not. A run without hits has no ratio."""
    values = [run[key] for run in runs if key in run]
    if 0 < len(values) < len(runs):
        return f"{cell(values)}, {len(values)} of {len(runs)}"
    return cell(values)


def digits(bound):
    """A bound with the three digits to which it is known, or "-" without one."""
    return "-" if bound is None else f"{bound:#.3g}"


def table(experiment, found, by_seed=False):
    """The lines of one experiment's table: each row's median and range, or each of its runs."""
    lines = [["", "seed" if by_seed else "seeds", *experiment.keys.values()]]
    for row, seeds in found.items():
        groups = {str(run["seed"]): [run] for run in seeds} if by_seed else {str(len(seeds)): seeds}
        for label, group in groups.items():
            cells = [cell_of(group, key) for key in experiment.keys]
            lines.append([experiment.rows[row], label, *cells])
    if experiment.bound:
        bound = experiment.bound()
        lines.append(["limit for any memory", "", *(digits(bound.get(key)) for key in experiment.keys)])
    widths = [max(map(len, column)) for column in zip(*lines)]
    printed = ["  ".join(word.ljust(width) for word, width in zip(line, widths)).rstrip() for line in lines]
    return [experiment.title, *(f"  {line}" for line in printed)]


def memory_figure(results):
    """One panel for each experiment, with a dot for each seed and a bar for their median."""
    figure = Figure(figsize=(5 * len(results), 4.5), layout="constrained")
    panels = figure.subplots(1, len(results), squeeze=False)[0]
    for ax, (name, found) in zip(panels, results.items()):
        experiment = EXPERIMENTS[name]
        key, label = next(iter(experiment.keys.items()))
        for x, seeds in enumerate(found.values()):
            values = [run[key] for run in seeds if key in run]
            ax.plot([x] * len(values), values, "o", color="tab:red", alpha=0.6)
            if values:
                ax.hlines(np.median(values), x - 0.3, x + 0.3, color="tab:red")
        if experiment.bound:
            ax.axhline(
                experiment.bound()[key],
                color="0.5",
                linestyle="--",
                label=f"limit for any memory {digits(experiment.bound()[key])}",
            )
            ax.legend()
        ax.set_xticks(range(len(found)), [experiment.rows[row] for row in found], rotation=30, ha="right")
        ax.set_ylabel(label)
        if experiment.log:
            ax.set_yscale("log")
            ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            ax.yaxis.set_major_formatter("{x:g}")
            ax.yaxis.set_minor_formatter(NullFormatter())
        ax.set_title(experiment.title.replace(": ", ":\n"), fontsize=9)
        ax.grid(alpha=0.3)
    return figure


def main():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=FOLDER)
    parser.add_argument("--by-seed", action="store_true", help="print each run, draw nothing")
    options = parser.parse_args()
    folder = options.folder
    try:
        results = {name: read(folder / name, experiment) for name, experiment in EXPERIMENTS.items()}
        results = {name: found for name, found in results.items() if found}
        if not results:
            raise ValueError(f"{folder} has no finished run; benchmarks/trainings/memory_*.txt list them")
        for name, found in results.items():
            print("\n".join(table(EXPERIMENTS[name], found, options.by_seed)))
        drawn = {name: found for name, found in results.items() if EXPERIMENTS[name].drawn}
        if drawn and not options.by_seed:
            save_figures(folder, {"memory.png": memory_figure(drawn)})
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
