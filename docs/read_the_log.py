"""Draw the pictures of docs/read-the-log.md and write its table of ranges, from the curves and policy of results/.

    python docs/read_the_log.py

Reading order: the ranges of a healthy run, its picture, the parts of the reward over one flight.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

HERE = Path(__file__).resolve().parent
PAGE, ROOT = HERE / "read-the-log.md", HERE.parent
sys.path.insert(0, str(ROOT))
import envs  # noqa: E402
import ppo_gtrxl_rocket as script  # noqa: E402
import runs  # noqa: E402
from common.curves import read_csv  # noqa: E402
from drawing.style import BOUNDARY, OPTIMUM, save_figures  # noqa: E402
from drawing.training import plot_seeds  # noqa: E402
from rocket.environment import RocketVectorEnv  # noqa: E402

# result folder: the name in pictures, the tag and label of its miss, what is subtracted from it, --target-kl
HEALTHY = {
    "di": ("Double integrator", "eval/ratio_of_sums", "eval/ratio_of_sums, less 1", 1.0, 0.05),
    "rocket_cutoff": ("Rocket with cut-off", "eval/error_norm", "eval/error_norm", 0.0, 0.02),
}
SHARES = {"first tenth": (0.0, 0.1), "until half": (0.1, 0.5), "second half": (0.5, 1.0)}  # of the updates
RANGED = ("approx_kl", "clipfrac", "explained_variance")


def curves_of(result):
    """The training curves of all seeds of a result."""
    return [read_csv(path) for path in sorted((ROOT / "results" / result / "seeds").glob("*.csv"))]


# ------------------------------------------------------------------------------------------ the ranges of healthy runs
TABLE = re.compile(r"(\| tag \| run \| first tenth .*\n\|[-|]+\|\n)(?:\|.*\n)+")  # head, then rows


def ranges():
    """The rows of the page's table: of each tag and result the 5th to 95th percentile, by shares of the updates."""
    rows = []
    for name in RANGED:
        for result, (title, *_) in HEALTHY.items():
            values = [curve[f"losses/{name}"][1] for curve in curves_of(result)]
            cells = [span_of(values, *share) for share in SHARES.values()]
            rows.append(f"| `losses/{name}` | {title.lower()} | {' | '.join(cells)} |\n")
    return rows


def span_of(values, begin, end):
    """The 5th to 95th percentile of all seeds' values between two shares of their updates, as text."""
    part = np.concatenate([column[round(begin * len(column)) : round(end * len(column))] for column in values])
    low, high = (two_digits(bound) for bound in np.percentile(part, [5, 95]))
    return low if low == high else f"{low} to {high}"


def two_digits(number):
    """A number as text with two significant digits, never in powers of ten."""
    rounded = float(f"{number:.2g}")
    return np.format_float_positional(rounded, trim="-").replace("-", "−")


def with_ranges(page, rows):
    """The page with these rows in its table."""
    return TABLE.sub(lambda found: found[1] + "".join(rows), page)


# ---------------------------------------------------------------------------------------------------- a healthy run
def draw_healthy():
    """Six panels for each of two results: return, KL, clipped share, explained variances, entropy, miss."""
    figure = Figure(figsize=(9.0, 8.8), layout="constrained")
    for half, result in zip(figure.subfigures(2, 1), HEALTHY):
        draw_result(half, result)
    return figure


def draw_result(figure, result):
    """The six panels of one result."""
    title, miss, label, subtract, target_kl = HEALTHY[result]
    curves = curves_of(result)
    figure.suptitle(f"{title}, results/{result}")
    axes = figure.subplots(2, 3).flat
    tags = ("charts/episodic_return", "losses/approx_kl", "losses/clipfrac", "losses/explained_variance")
    for ax, tag in zip(axes, (*tags, "losses/entropy", miss)):
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))
        ax.grid(alpha=0.3)
        ax.set_title(label if tag == miss else tag, fontsize=9)
        ax.tick_params(labelsize=8)
        plot_seeds(ax, [curve[tag] for curve in curves], "sampled")
        if tag == "charts/episodic_return":
            shown = np.concatenate([curve[tag][1][len(curve[tag][1]) // 10 :] for curve in curves])
            low = np.percentile(shown, 2)
            ax.set_ylim(low, shown.max() + 0.08 * (shown.max() - low))
            ax.legend(loc="lower right", fontsize=8)
        if tag == "losses/approx_kl":
            ax.axhline(target_kl, **{**BOUNDARY, "color": "black"}, label=f"--target-kl {target_kl}")
            ax.set_ylim(0, 1.3 * target_kl)
            ax.legend(handles=ax.lines[-1:], loc="upper right", fontsize=8)
        if tag == "losses/explained_variance":
            show_both_variances(ax, curves)
        if tag == miss:
            show_miss(ax, curves, tag, subtract)
    for ax in figure.axes[3:6]:
        ax.set_xlabel("environment steps", fontsize=8)


def show_both_variances(ax, curves):
    """Below the critic's explained variance the baseline's, dashed."""
    tag = "losses/baseline_explained_variance"
    for k, curve in enumerate(curves):
        ax.plot(*curve[tag], **{**OPTIMUM, "linewidth": 0.8, "alpha": 0.6}, label="" if k else tag)
    ax.set_ylim(-0.4, 1.1)
    ax.legend(handles=ax.lines[-len(curves) :][:1], loc="lower left", fontsize=7)


def show_miss(ax, curves, tag, subtract):
    """The miss of the mean action in log scale, in the place of what was plotted."""
    ax.clear()
    ax.set_title(f"{tag}{', less 1' if subtract else ''}", fontsize=9)
    ax.xaxis.set_major_formatter(EngFormatter(sep=""))
    ax.set_yscale("log")
    ax.grid(alpha=0.3)
    ax.tick_params(labelsize=8)
    plot_seeds(ax, [(steps, values - subtract) for steps, values in (curve[tag] for curve in curves)], "mean")


# ------------------------------------------------------------------------------ the parts of the reward over one flight
ENV_ID = "RocketAscentCutoff-v0"
PART_COLORS = ("tab:red", "tab:green", "tab:blue", "tab:orange", "black")


def fly_shipped():
    """The flight of the shipped policy's mean action."""
    argv = ["--eval-only", "--checkpoint", str(ROOT / "results/rocket_cutoff/agent.safetensors")]
    args, saved = runs.parse_args(script, argv)
    options = {name: getattr(args, name) for name in script.ENV_OPTIONS} | script.FIXED_OPTIONS
    batch = runs.make_envs(args, options)
    agent = script.Agent(args, batch)
    runs.load_checkpoint(agent, args, saved)
    return envs.fly_rocket(ENV_ID, agent.make_policy(batch.episode_steps), **options)


def fly_straight_up():
    """The flight of an agent before training: its mean action is straight up."""
    up = np.array([script.INITIAL_ACTION])
    return envs.fly_rocket(ENV_ID, lambda obs, t: up, **script.FIXED_OPTIONS)


def draw_reward(shipped, straight_up):
    """The sums so far of the parts: of the shipped policy, its penalties enlarged, and straight up."""
    figure = Figure(figsize=(9.4, 3.4), layout="constrained")
    trained, enlarged, untrained = figure.subplots(1, 3)
    for ax, flight, title in ((trained, shipped, "the shipped policy"), (untrained, straight_up, "straight up")):
        for part, values, color in zip(RocketVectorEnv.PARTS, flight["parts"].T, PART_COLORS):
            ax.plot(flight["t"], [0.0, *values], color=color, linewidth=1.4, label=f"{part} {values[-1]:+.3f}")
        ax.set_title(f"{title}: return {flight['episodic_return']:.3f}", fontsize=10)
        ax.legend(fontsize=7)
    penalties = RocketVectorEnv.PARTS.index("R_penalties")
    sums = 1e3 * np.array([0.0, *shipped["parts"][:, penalties]])
    enlarged.plot(shipped["t"], sums, color=PART_COLORS[penalties], linewidth=1.4)
    enlarged.set_title("the shipped policy: 1000 R_penalties", fontsize=10)
    for ax in figure.axes:
        ax.set_xlabel("time (s); dotted: staging", fontsize=9)
        ax.tick_params(labelsize=8)
        for burn in envs.ROCKETS[ENV_ID].rocket.burns[:-1]:
            ax.axvline(burn.end, **BOUNDARY)
    trained.set_ylabel("sum so far")
    return figure


def pictures():
    """The page's pictures by file name."""
    return {"log_healthy.png": draw_healthy(), "log_reward.png": draw_reward(fly_shipped(), fly_straight_up())}


if __name__ == "__main__":
    PAGE.write_text(with_ranges(PAGE.read_text(), ranges()))
    save_figures(HERE, pictures())
