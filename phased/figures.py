"""The small problems' figures: flights, costs, and where the policy is least optimal."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import LogLocator, NullFormatter

from drawing.style import BOUNDARY, OPTIMUM, POLICY, SHOWN, TARGET
from phased.metrics import NEAR_ORIGIN, comparable, cost_parts
from phased.problem import Problem


def trajectories_figure(problem: Problem, arrays: dict, title: str) -> Figure:
    """Phase plane, position, velocity and control of the first ten starts, with targets and the phases' ends.

    `arrays` are those of eval.npz, here and below.
    """
    t = arrays["t"]
    figure = Figure(figsize=(11, 8.5), layout="constrained")
    (plane, position), (velocity, control) = figure.subplots(2, 2)
    for suffix, style in (("", POLICY), ("_reference", OPTIMUM)):
        for x, u in zip(arrays[f"x{suffix}"][:SHOWN], arrays[f"u{suffix}"][:SHOWN]):
            plane.plot(x[:, 0], x[:, 1], **style)
            position.plot(t, x[:, 0], **style)
            velocity.plot(t, x[:, 1], **style)
            control.stairs(u, t, baseline=None, **style)  # held over each step
    plane.plot(*arrays["x"][:SHOWN, 0].T, "k.")
    mark_targets(problem, plane, position, velocity)
    for end in problem.phase_ends[:-1]:
        for ax in (position, velocity, control):
            ax.axvline(t[end], **BOUNDARY)
    for bound in (-problem.u_max, problem.u_max):
        control.axhline(bound, **{**BOUNDARY, "linestyle": "--"})
    plane.set(xlabel="position $x_1$", ylabel="velocity $x_2$", title="Phase plane")
    plane.axis("equal")
    position.set(xlabel="time (s)", ylabel="position $x_1$", title="Position")
    velocity.set(xlabel="time (s)", ylabel="velocity $x_2$", title="Velocity")
    control.set(xlabel="time (s)", ylabel="control $u$", title=f"Control (bounds ±{problem.u_max})")
    for ax in figure.axes:
        ax.grid(alpha=0.3)
    figure.suptitle(f"{title}\nthe first {len(arrays['x'][:SHOWN])} starts")
    add_legend(figure, problem)
    return figure


def mark_targets(problem: Problem, plane, position, velocity):
    """Green: each phase's target circle in the phase plane, and its target as a dashed line over the phase's time."""
    start = 0.0
    for k, phase in enumerate(problem.phases, start=1):
        plane.add_patch(Circle(phase.target, phase.radius, fill=False, zorder=3, **TARGET))
        if problem.waypoints:
            offset = (-3, -16) if k == 1 else (-10, 5)  # points: the paths come in from the other sides
            plane.annotate(f"{k}", phase.target, offset, textcoords="offset points", color="tab:green", weight="bold")
        end = start + phase.steps * problem.dt
        for ax, value in zip((position, velocity), phase.target):
            ax.plot([start, end], [value, value], linestyle="--", zorder=3, **TARGET)
        start = end


def add_legend(figure: Figure, problem: Problem):
    """One legend for all panels, below them."""
    radius = problem.phases[0].radius
    handles = [
        Line2D([], [], **POLICY, label="policy"),
        Line2D([], [], **OPTIMUM, label="optimum"),
        Line2D([], [], **TARGET, linestyle="--", marker="o", fillstyle="none", label=f"target (radius {radius})"),
        Line2D([], [], color="k", marker=".", linestyle="", label="start"),
    ]
    if problem.waypoints:
        handles.append(Line2D([], [], **BOUNDARY, label="end of a phase"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))


def costs_figure(problem: Problem, arrays: dict, title: str) -> Figure:
    """Total costs of all starts as a histogram; of the first ten their total with the ratio, and its three parts."""
    ours, optimum = (cost_parts(problem, arrays[f"x{s}"], arrays[f"u{s}"]) for s in ("", "_reference"))
    figure = Figure(figsize=(12, 7), layout="constrained")
    panels = figure.subplot_mosaic([["all", "total", "total"], ["state", "control", "terminal"]])
    cost, reference_cost = arrays["cost"], arrays["cost_reference"]
    bins = np.histogram_bin_edges([cost, reference_cost], bins=min(40, max(5, len(cost) // 5)))
    panels["all"].hist(cost, bins, color="tab:red", alpha=0.45, label="policy")
    panels["all"].hist(reference_cost, bins, histtype="step", color="tab:blue", linewidth=1.4, label="optimum")
    panels["all"].set(xlabel="total cost J", ylabel="starts", title=f"All {len(cost)} starts")
    plot_bars(panels["total"], cost, reference_cost, "total cost J")
    chosen = comparable(problem, arrays["x"], arrays["x_reference"])
    for k in range(min(SHOWN, len(cost))):
        text = f"{cost[k] / reference_cost[k]:.3f}" if chosen[k] else "miss"  # a missed circle forbids a ratio
        top = k + 1, max(cost[k], reference_cost[k])
        panels["total"].annotate(text, top, (0, 3), textcoords="offset points", ha="center", fontsize=9)
    panels["total"].margins(y=0.12)
    panels["total"].set_title("The first starts, with the ratio policy / optimum")
    for part, name in enumerate(("state", "control", "terminal")):
        plot_bars(panels[name], ours[:, part], optimum[:, part], f"{name} cost")
    panels["all"].legend()
    figure.suptitle(title)
    return figure


def plot_bars(ax, ours: np.ndarray, optimum: np.ndarray, label: str):
    """Bars of the first ten starts side by side; `ours` and `optimum` are costs, (n,)."""
    case = np.arange(1, min(SHOWN, len(ours)) + 1)
    ax.bar(case - 0.2, ours[:SHOWN], 0.4, color="tab:red", label="policy")
    ax.bar(case + 0.2, optimum[:SHOWN], 0.4, color="tab:blue", hatch="///", edgecolor="white", label="optimum")
    ax.set(xlabel="start", ylabel=label, xticks=case)
    ax.grid(axis="y", alpha=0.3)


SMALLEST_LOSS = 1e-6  # a smaller one is shown as this: the optimum itself is known to about 1e-8


def cost_error_figure(problem: Problem, arrays: dict, title: str) -> Figure:
    """Where the policy is least optimal: J - J* over the box of the starts, and over |x0| beside J* itself.

    Near the origin J* falls with |x0|^2 and the loss need not: such starts have the large ratios J / J*.
    """
    x0, best = arrays["x"][:, 0], arrays["cost_reference"]
    loss, distance = np.maximum(arrays["cost"] - best, SMALLEST_LOSS), np.hypot(*x0.T)
    figure = Figure(figsize=(12.5, 5.6), layout="constrained")
    box, over_distance = figure.subplots(1, 2)
    low, high = np.percentile(loss, [1, 99])
    order = np.argsort(loss)  # the largest on top
    style = {"s": 2000 / len(x0) ** 0.7, "cmap": "viridis_r", "norm": LogNorm(low, max(high, 2 * low))}
    dots = box.scatter(*x0[order].T, c=loss[order], **style)
    figure.colorbar(dots, ax=box, label="loss $J - J^*$", extend="both")
    box.add_patch(Circle((0, 0), NEAR_ORIGIN, fill=False))
    edge = 1.05 * problem.x0_max
    box.set(xlim=(-edge, edge), ylim=(-edge, edge), aspect="equal", title=f"Loss of {len(x0)} starts")
    box.set(xlabel="position $x_1$ of the start", ylabel="velocity $x_2$ of the start")
    over_distance.loglog(distance, best, "x", color="tab:blue", markersize=4, alpha=0.6, label="optimum $J^*$")
    over_distance.loglog(distance, loss, ".", color="tab:red", alpha=0.5, label="loss of the policy $J - J^*$")
    label = f"$|x_0| = {NEAR_ORIGIN}$, the circle on the left"
    over_distance.axvline(NEAR_ORIGIN, color="k", linewidth=1.0, label=label)
    over_distance.set(xlabel="distance of the start from the origin $|x_0|$", ylabel="cost")
    over_distance.set(title="Loss beside the optimum: where they meet, $J = 2 J^*$")
    over_distance.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))  # all of a decade's labels overlap
    over_distance.xaxis.set_major_formatter("{x:g}")
    over_distance.xaxis.set_minor_formatter(NullFormatter())
    over_distance.legend(loc="upper left")
    over_distance.grid(alpha=0.3)
    figure.suptitle(title)
    return figure
