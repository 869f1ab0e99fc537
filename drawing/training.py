"""Training curves of one run or of several seeds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from drawing.style import OPTIMUM, POLICY, TARGET


class Miss(NamedTuple):
    """A policy's distance from its aim, as the evaluations during a training log it."""

    tag: str  # of TensorBoard
    label: str
    subtract: float = 0.0
    success: float | None = None  # below it a policy has succeeded
    by_mean_action: bool = False  # also the return is shown without the noise, which changes during the training


def training_figure(curves: list[dict], title: str, reference_return: float, miss: Miss) -> Figure:
    """Reward, policy loss, total loss and, if it was logged, the mean action's miss over the samples.

    curves: {tag: (steps, values)} of each seed; with several each is thin and their median thick. `reference_return` is
    the optimum's mean.
    """
    losses = {"losses/policy_loss": "policy loss", "losses/total_loss": "total loss"}
    panels = {"charts/episodic_return": "episodic return"} | losses
    if any(miss.tag in curve for curve in curves):
        if miss.by_mean_action:
            panels = {"eval/episodic_return": "episodic return of the mean action"} | losses
        panels[miss.tag] = miss.label
    figure = Figure(figsize=(4 * len(panels), 3.8), layout="constrained")
    seeds = f", {len(curves)} seeds" if len(curves) > 1 else ""
    figure.suptitle(f"{title}{seeds}")
    for ax, (tag, label) in zip(figure.subplots(1, len(panels)), panels.items()):
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))
        ax.set(xlabel="environment steps", ylabel=label)
        ax.grid(alpha=0.3)
        logged = [curve[tag] for curve in curves if tag in curve]
        if tag == miss.tag:
            logged = [(steps, values - miss.subtract) for steps, values in logged]
        plot_seeds(ax, logged, "mean" if tag.startswith("eval/") else "sampled")
        seen = [values for _, values in logged]
        if tag.endswith("episodic_return"):
            label = f"optimum, mean {reference_return:.2f}"
            ax.axhline(reference_return, **{**OPTIMUM, "linewidth": 1.4}, label=label)
            ax.legend(loc="lower right")
            seen.append([reference_return])
        if logged and tag == miss.tag:
            scale_miss(ax, miss)
        elif logged:
            cut_outliers(ax, np.concatenate(seen))
    return figure


def plot_seeds(ax, logged: list[tuple], actions: str):
    """One curve, or the curves of several seeds and their median.

    `logged` has (steps, values) of each seed. `actions`, "mean" or "sampled", is for the label.
    """
    if len(logged) > 1:
        for k, (steps, values) in enumerate(logged):
            ax.plot(steps, values, color="tab:red", linewidth=0.7, alpha=0.4, label="" if k else "each seed")
        ax.plot(*median_curve(logged), **POLICY, label=f"median of {len(logged)} seeds")
    elif logged:
        ax.plot(*logged[0], **{**POLICY, "linewidth": 1.1}, label=f"policy, {actions} actions")


def scale_miss(ax, miss: Miss):
    """A miss in log scale, with the line below which it is a success."""
    ax.set_yscale("log")
    if miss.success is not None:
        label = f"success: below {miss.success}"
        line = ax.axhline(miss.success, **{**TARGET, "linestyle": "--"}, label=label)
        ax.legend(handles=[line], loc="upper right")


def cut_outliers(ax, values: np.ndarray):
    """A y axis without the few updates that would dominate it."""
    low, high = np.percentile(values, [5, 95])
    span = high - low
    inside = values[(values >= low - span) & (values <= high + span)]
    if len(inside) < len(values):
        margin = 0.05 * np.ptp(inside)
        ax.set_ylim(inside.min() - margin, inside.max() + margin)
        ax.set_title(f"cut; all values: {values.min():.3g} to {values.max():.3g}", fontsize=9)


def median_curve(curves: list[tuple]) -> tuple[np.ndarray, np.ndarray]:
    """Median over seeds at the first seed's steps, as far as every seed has come; curves are linear between steps."""
    start = max(steps[0] for steps, _ in curves)
    end = min(steps[-1] for steps, _ in curves)
    grid = curves[0][0]
    grid = grid[(start <= grid) & (grid <= end)]
    return grid, np.median([np.interp(grid, steps, values) for steps, values in curves], axis=0)
