"""The small problems' figures: flights, costs, and where the policy is least optimal."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Ellipse
from matplotlib.ticker import LogLocator, NullFormatter

from drawing.animation import SIDES, Flight, handles_of
from drawing.style import BOUNDARY, OPTIMUM, POLICY, SHOWN, TARGET
from drawing.time_plots import plot_flight, time_panels
from phased.metrics import NEAR_ORIGIN, comparable, cost_parts, cost_ratio
from phased.problem import Phase, Problem

NOT_ARRIVED = {"color": "black", "marker": "x", "linestyle": "", "zorder": 6}


def trajectories_figure(problem: Problem, arrays: dict, title: str) -> Figure:
    """Phase plane, position, velocity and control of the first ten starts, with targets and the phases' ends.

    Of more states or controls each over time. `arrays` are those of eval.npz, here and below.
    """
    if problem.states != 2 or problem.controls != 1 or problem.has_events or problem.constraints:
        return time_figure(problem, arrays, title)
    t = arrays["t"]
    position_name, velocity_name = problem.state_labels
    figure = Figure(figsize=(11, 8.5), layout="constrained")
    (plane, position), (velocity, control) = figure.subplots(2, 2)
    for suffix, style in (("", POLICY), ("_reference", OPTIMUM)):
        for x, u in zip(arrays[f"x{suffix}"][:SHOWN], arrays[f"u{suffix}"][:SHOWN]):
            plane.plot(x[:, 0], x[:, 1], **style)
            position.plot(t, x[:, 0], **style)
            velocity.plot(t, x[:, 1], **style)
            control.stairs(u, t, baseline=None, **style)  # a control is held over each step
    plane.plot(*arrays["x"][:SHOWN, 0].T, "k.")
    mark_circles(problem, plane)
    mark_table(problem, [position, velocity, control])
    plane.set(xlabel=position_name, ylabel=velocity_name, title="Phase plane")
    plane.axis("equal")
    position.set(xlabel="time (s)", ylabel=position_name, title="Position")
    velocity.set(xlabel="time (s)", ylabel=velocity_name, title="Velocity")
    low, high = problem.u_box[:, 0]
    bounds = f"±{high}" if low == -high else f"{low:g} to {high:g}"
    control.set(xlabel="time (s)", ylabel=problem.control_labels[0], title=f"Control (bounds {bounds})")
    for ax in figure.axes:
        ax.grid(alpha=0.3)
    figure.suptitle(with_count(problem, arrays, title))
    add_legend(figure, problem)
    return figure


def time_figure(problem: Problem, arrays: dict, title: str) -> Figure:
    """Each state and each control of the first ten starts over time, with targets, bounds and the phases' ends."""
    labels = [*problem.state_labels, *problem.control_labels]
    if problem.constraints:
        labels.append("largest constraint")
    figure, panels = time_panels(labels, row_height=2.9, rest=1.0)
    for suffix, style in (("", POLICY), ("_reference", OPTIMUM)):
        for flight in flights_of(problem, arrays, suffix):
            plot_flight(panels, flight, style)
    mark_table(problem, panels)
    if problem.constraints:
        plot_constraints(problem, arrays, panels[len(labels) - 1])
    figure.suptitle(with_count(problem, arrays, title))
    handles = handles_of([POLICY, OPTIMUM])
    late = flights_out_of_time(arrays)
    for flight in late:
        for k, ax in enumerate(panels[: problem.states]):
            ax.plot(flight[0], flight[1][k], **NOT_ARRIVED)
    if late:
        handles.append(Line2D([], [], **NOT_ARRIVED, label="did not arrive"))
    if any(phase.target is not None for phase in problem.phases):
        handles.append(Line2D([], [], **TARGET, linestyle="--", label="target"))
    handles.append(Line2D([], [], **BOUNDARY, label="bound, or end of a phase"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def plot_constraints(problem: Problem, arrays: dict, ax):
    """Plot the largest constraint at both ends of each step, or where a discrete step begins. It must not exceed 0."""
    draw = arrays.get("draw", np.zeros((len(arrays["x"]), problem.drawn)))[:SHOWN]
    p = tuple(value[:, None, None] for value in problem.hidden(draw))
    t = arrays["t"]
    sides = 2 if problem.step is None else 1
    times = np.column_stack([t[:-1], t[1:]])[:, :sides]
    for suffix, style in (("", POLICY), ("_reference", OPTIMUM)):
        x = arrays[f"x{suffix}"][:SHOWN]
        x = np.stack([x[:, :-1], x[:, 1:]], axis=2)[:, :, :sides]  # (flights, T, sides, n)
        u = arrays[f"u{suffix}"][:SHOWN].reshape(*x.shape[:2], 1, problem.controls)
        values = problem.constraints_at(tuple(np.moveaxis(x, -1, 0)), problem.as_control(np.moveaxis(u, -1, 0)), p)
        largest = np.maximum.reduce(np.broadcast_arrays(x[..., 0], *values)[1:])
        ax.plot(times.ravel(), largest.reshape(len(x), -1).T, **style)
    ax.axhline(0.0, **{**BOUNDARY, "linestyle": "--"})


def flights_out_of_time(arrays: dict) -> list[tuple]:
    """The final time and state of the shown flights of the policy that did not arrive."""
    arrived = arrays.get("arrived", np.ones(len(arrays["x"]), dtype=bool))
    ends = []
    for k in np.flatnonzero(~arrived[:SHOWN]):
        last = int(np.isfinite(arrays["x"][k]).all(axis=1).sum()) - 1
        ends.append((arrays["final_time"][k], arrays["x"][k, last]))
    return ends


def with_count(problem: Problem, arrays: dict, title: str) -> str:
    """The title, with the number of starts that are shown."""
    return title if problem.has_one_flight else f"{title}\nthe first {len(arrays['x'][:SHOWN])} starts"


def flights_of(problem: Problem, arrays: dict, suffix: str) -> list[Flight]:
    """The first flights of one side, each up to its end."""
    flights = []
    for k, (x, u) in enumerate(zip(arrays[f"x{suffix}"][:SHOWN], arrays[f"u{suffix}"][:SHOWN])):
        steps = int(np.isfinite(x).all(axis=1).sum()) - 1
        t = arrays["t"][: steps + 1].copy()
        if problem.has_events:
            t[-1] = arrays[f"final_time{suffix}"][k]
        u = u.reshape(len(u), problem.controls)
        flights.append(Flight.of(t, u[:steps], x[: steps + 1], SIDES[suffix]))
    return flights


def mark_table(problem: Problem, panels):
    """Mark targets and bounds of each state, the set of controls, and the ends of phases of fixed time."""
    start = 0.0
    for phase in problem.phases:
        end = start + phase.steps * problem.dt
        for ax, target in zip(panels, problem.targets_of(phase)):
            if target is not None:
                ax.plot([start, end], [target, target], linestyle="--", zorder=3, **TARGET)
        start = end
    for ax, limits in zip(panels, [*problem.limits.T, *problem.u_box.T]):
        for limit in limits[np.isfinite(limits)]:
            ax.axhline(limit, **{**BOUNDARY, "linestyle": "--"})
    if not problem.has_events:
        for end in problem.phase_ends[:-1]:
            for ax in panels:
                ax.axvline(end * problem.dt, **BOUNDARY)


def mark_circles(problem: Problem, plane):
    """Draw in green each phase's target circle in the phase plane, with its number if there are several."""
    for k, phase in enumerate(problem.phases, start=1):
        add_circle(problem, phase, plane)
        if problem.waypoints and None not in problem.targets_of(phase):
            offset = (-3, -16) if k == 1 else (-10, 5)  # points: the paths come in from the other sides
            plane.annotate(f"{k}", phase.target, offset, textcoords="offset points", color="tab:green", weight="bold")


def add_circle(problem: Problem, phase: Phase, plane, zorder: int = 3):
    """The patch of a phase's circle or ellipse in the phase plane. None without one, or if a state is free."""
    target = problem.targets_of(phase)
    if not phase.has_circle or None in target:
        return None
    look = {"fill": False, "zorder": zorder, **TARGET}
    if isinstance(phase.radius, tuple):
        width, height = (2 * radius for radius in phase.radius[:2])  # after them come the radii of conditions
        return plane.add_patch(Ellipse(target, width, height, **look))
    return plane.add_patch(Circle(target, phase.radius, **look))


def add_legend(figure: Figure, problem: Problem):
    """One legend for all panels, below them."""
    handles = handles_of([POLICY, OPTIMUM])
    radii = dict.fromkeys(str(phase.radius) for phase in problem.phases if phase.has_circle)
    if any(phase.target is not None for phase in problem.phases):
        label = f"target (radius {', '.join(radii)})" if radii else "target"
        handles.append(Line2D([], [], **TARGET, linestyle="--", marker="o", fillstyle="none", label=label))
    handles.append(Line2D([], [], color="k", marker=".", linestyle="", label="start"))
    if problem.waypoints:
        handles.append(Line2D([], [], **BOUNDARY, label="end of a phase"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))


def costs_figure(problem: Problem, arrays: dict, title: str) -> Figure:
    """A histogram of all starts' total costs, and for the first ten the total with the ratio and its three parts."""
    has_parts = problem.weighted and not problem.has_events  # others are told in eval.json alone
    rows = [["all", "total", "total"], *([["state", "control", "terminal"]] if has_parts else [])]
    figure = Figure(figsize=(12, 3.5 * len(rows)), layout="constrained")
    panels = figure.subplot_mosaic(rows)
    cost = arrays["cost"]
    reference_cost = arrays["cost_reference"]
    bins = np.histogram_bin_edges([cost, reference_cost], bins=min(40, max(5, len(cost) // 5)))
    panels["all"].hist(cost, bins, color="tab:red", alpha=0.45, label="policy")
    panels["all"].hist(reference_cost, bins, histtype="step", color="tab:blue", linewidth=1.4, label="optimum")
    panels["all"].set(xlabel="total cost J", ylabel="starts", title=f"{len(cost)} starts")
    plot_bars(panels["total"], cost, reference_cost, "total cost J")
    chosen = comparable(problem, arrays) & (reference_cost != 0)
    ratio = cost_ratio(cost, np.where(chosen, reference_cost, 1.0))
    for k in range(min(SHOWN, len(cost))):
        text = f"{ratio[k]:.3f}" if chosen[k] else "miss"  # a missed circle forbids a ratio
        top = k + 1, max(cost[k], reference_cost[k])
        panels["total"].annotate(text, top, (0, 3), textcoords="offset points", ha="center", fontsize=9)
    panels["total"].margins(y=0.12)
    panels["total"].set_title("The first starts, with the ratio policy / optimum")
    if has_parts:
        ours, optimum = (cost_parts(problem, arrays[f"x{s}"], arrays[f"u{s}"]) for s in ("", "_reference"))
    for part, name in enumerate(("state", "control", "terminal") if has_parts else ()):
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


SMALLEST_LOSS = 1e-6  # a smaller loss is shown as this, because the optimum itself is known to about 1e-8


def cost_error_figure(problem: Problem, arrays: dict, title: str) -> Figure:
    """The loss J - J* of the policy over the box of the starts, and over |x0| beside J* itself.

    Near the origin J* falls with |x0|^2 and the loss need not: such starts have the large ratios J / J*.
    """
    x0, best = arrays["x"][:, 0], arrays["cost_reference"]
    loss = np.maximum(arrays["cost"] - best, SMALLEST_LOSS)
    distance = np.hypot(*x0.T)
    figure = Figure(figsize=(12.5, 5.6), layout="constrained")
    box, over_distance = figure.subplots(1, 2)
    low, high = np.percentile(loss, [1, 99])
    order = np.argsort(loss)  # the largest on top
    style = {"s": 2000 / len(x0) ** 0.7, "cmap": "viridis_r", "norm": LogNorm(low, max(high, 2 * low))}
    dots = box.scatter(*x0[order].T, c=loss[order], **style)
    figure.colorbar(dots, ax=box, label="loss $J - J^*$", extend="both")
    box.add_patch(Circle((0, 0), NEAR_ORIGIN, fill=False))
    edge = 1.05 * np.max(np.abs(x0))
    box.set(xlim=(-edge, edge), ylim=(-edge, edge), aspect="equal", title=f"Loss of {len(x0)} starts")
    position, velocity = problem.state_labels
    box.set(xlabel=f"{position} of the start", ylabel=f"{velocity} of the start")
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
