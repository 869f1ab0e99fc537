"""The figures of an evaluation: policy against optimum, and the training curves. Needs no torch, imports no script.

`draw` is all that others call. It is imported only where something is drawn, so that a training loads no Matplotlib.
Reading order: what every problem shows, double integrator and Van der Pol, rocket ascent.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter
from PIL import Image

import envs
from baselines import replacing
from evaluate import (
    BOX,
    NEAR_ORIGIN,
    SUCCESS,
    altitude_km,
    comparable,
    cost_parts,
    element_misses,
    final_elements,
)

# ---------------------------------------------------------------------------------------------------------------------
# What every problem shows: policy red, optimum blue, target green, as in the paper. Time is in s; x, u, J have no unit
# ---------------------------------------------------------------------------------------------------------------------

SHOWN = 10  # the paper shows ten starts
# the optimum is drawn last and dashed: both lines are seen where they coincide, also without telling red from blue
POLICY = {"color": "tab:red", "linewidth": 1.6, "linestyle": "-"}
OPTIMUM = {"color": "tab:blue", "linewidth": 1.0, "linestyle": (0, (4, 2))}
TARGET = {"color": "tab:green", "linewidth": 1.5}
BOUNDARY = {"color": "0.5", "linewidth": 0.8, "linestyle": ":"}


def draw(folder, arrays: dict, metrics: dict, curve: dict | None = None, others=()) -> list[Path]:
    """Draw trajectories.png, costs.png and, given the run's training curve, training.png into `folder`.

    Of a single phase also cost_error.png. Of a rocket trajectory.png and orbit.png, and none of these but training.png.
    `arrays` and `metrics` are those of `evaluate`; `others` are the training curves of other seeds. Returns the paths.
    """
    drawn = {} if curve is None else {"training.png": draw_training([curve, *others], metrics)}
    if metrics["env_id"] in envs.ROCKETS:
        drawn |= {"trajectory.png": draw_ascent(arrays, metrics), "orbit.png": draw_orbit(arrays, metrics)}
        if "dispersion" in metrics:
            drawn |= {"dispersed.png": draw_dispersed({"policy": arrays}, metrics)}
    else:
        drawn |= {"trajectories.png": draw_trajectories(arrays, metrics), "costs.png": draw_costs(arrays, metrics)}
        if len(envs.PROBLEMS[metrics["env_id"]].phases) == 1:  # with waypoints a missed circle would count as a gain
            drawn |= {"cost_error.png": draw_cost_error(arrays, metrics)}
    return save(folder, drawn)


def save(folder, drawn: dict[str, Figure]) -> list[Path]:
    """Write figures by their file names, in 256 colours: a third of the size. Returns the paths."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in drawn.items():
        png = io.BytesIO()
        figure.savefig(png, format="png", dpi=130)
        with Image.open(png) as image, replacing(folder / name) as file:
            image.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(file, format="png", optimize=True)
    return [folder / name for name in drawn]


def headline(metrics: dict) -> str:
    """A figure's title: the problem and how close to the optimum the policy flies."""
    if metrics["env_id"] in envs.ROCKETS:
        return rocket_headline(metrics)
    if "ratio_of_sums" not in metrics:
        return f"{metrics['env_id']}: no cost ratio, {metrics['hit_rate']:.1%} of the starts hit every circle"
    title = f"{metrics['env_id']}: cost {metrics['ratio_of_sums']:.4f} x optimum"
    if len(envs.PROBLEMS[metrics["env_id"]].phases) == 1:
        return f"{title} ({metrics['eval_starts']} starts)"
    return f"{title} over the starts that hit every circle ({metrics['hit_rate']:.1%})"


def rocket_headline(metrics: dict) -> str:
    """A figure's title: error and mass."""
    crash = ", crashed" if metrics["crashed"] else ""
    best = f"optimum {metrics['reference_mass_kg']:.1f} kg"
    if "mass_ratio_reached" in metrics:
        best = f"optimum for the orbit reached {metrics['reference_mass_reached_kg']:.1f} kg"
    mass = f"final mass {metrics['final_mass_kg']:.1f} kg, {best}"
    return f"{metrics['env_id']}: ||error|| {metrics['error_norm']:.6f}, {mass}{crash}"


def draw_training(curves: list[dict], metrics: dict) -> Figure:
    """Reward, policy loss, total loss and the mean action's miss over the samples.

    With several seeds each is thin and their median thick. The miss is ||error|| or the cost over the optimum's less 1.
    A rocket's reward is that of the mean action, without the noise that changes during the training.
    """
    losses = {"losses/policy_loss": "policy loss", "losses/total_loss": "total loss"}
    panels = {"charts/episodic_return": "episodic return"} | losses
    if any("eval/error_norm" in curve for curve in curves):
        panels = {"eval/episodic_return": "episodic return of the mean action"} | losses
        panels["eval/error_norm"] = "$\\Vert$error$\\Vert$ of the mean action"
    elif any("eval/ratio_of_sums" in curve for curve in curves):
        panels["eval/ratio_of_sums"] = "cost / optimum's, less 1, mean action"
    figure = Figure(figsize=(4 * len(panels), 3.8), layout="constrained")
    seeds = f", {len(curves)} seeds" if len(curves) > 1 else ""
    mean = metrics["reference_episodic_return"]
    figure.suptitle(f"{headline(metrics)}{seeds}")
    for ax, (tag, label) in zip(figure.subplots(1, len(panels)), panels.items()):
        logged = [curve[tag] for curve in curves if tag in curve]
        if tag == "eval/ratio_of_sums":
            logged = [(steps, ratios - 1) for steps, ratios in logged]
        if len(logged) > 1:
            for k, (steps, values) in enumerate(logged):
                ax.plot(steps, values, color="tab:red", linewidth=0.7, alpha=0.4, label="" if k else "each seed")
            ax.plot(*median_curve(logged), **POLICY, label=f"median of {len(logged)} seeds")
        elif logged:
            actions = "mean" if tag.startswith("eval/") else "sampled"
            ax.plot(*logged[0], **{**POLICY, "linewidth": 1.1}, label=f"policy, {actions} actions")
        if tag.endswith("episodic_return"):
            ax.axhline(mean, **{**OPTIMUM, "linewidth": 1.4}, label=f"optimum, mean {mean:.2f}")
            ax.legend(loc="lower right")
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))
        ax.set(xlabel="environment steps", ylabel=label)
        ax.grid(alpha=0.3)
        if logged:
            seen = [mean] if tag.endswith("episodic_return") else []
            scale_panel(ax, tag, np.concatenate([seen, *[values for _, values in logged]]))
    return figure


def scale_panel(ax, tag: str, values: np.ndarray):
    """The y axis of a training panel: a miss in log scale; the rest without the few updates that would dominate it."""
    if tag == "eval/error_norm":
        ax.set_yscale("log")
        line = ax.axhline(SUCCESS, **{**TARGET, "linestyle": "--"}, label=f"success: below {SUCCESS}")
        ax.legend(handles=[line], loc="upper right")
    elif tag == "eval/ratio_of_sums":
        ax.set_yscale("log")
    else:
        low, high = np.percentile(values, [5, 95])
        span = high - low
        inside = values[(values >= low - span) & (values <= high + span)]
        if len(inside) < len(values):
            margin = 0.05 * np.ptp(inside)
            ax.set_ylim(inside.min() - margin, inside.max() + margin)
            ax.set_title(f"cut; all values: {values.min():.3g} to {values.max():.3g}", fontsize=9)


def median_curve(curves: list[tuple]) -> tuple[np.ndarray, np.ndarray]:
    """Median over seeds at the first seed's steps, as far as every seed has come; curves are linear between steps."""
    start, end = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    grid = curves[0][0]
    grid = grid[(start <= grid) & (grid <= end)]
    return grid, np.median([np.interp(grid, steps, values) for steps, values in curves], axis=0)


# ---------------------------------------------------------------------------------------------------------------------
# Double integrator and Van der Pol
# ---------------------------------------------------------------------------------------------------------------------


def draw_trajectories(arrays: dict, metrics: dict) -> Figure:
    """Phase plane, position, velocity and control of the first ten starts, with targets and the phases' ends."""
    problem, t = envs.PROBLEMS[metrics["env_id"]], arrays["t"]
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
    end = 0
    for phase in problem.phases[:-1]:
        end += phase.steps
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
    figure.suptitle(f"{headline(metrics)}\nthe first {len(arrays['x'][:SHOWN])} starts")
    add_legend(figure, problem)
    return figure


def mark_targets(problem: envs.Problem, plane, position, velocity):
    """Green: each phase's target circle in the phase plane, and its target as a dashed line over the phase's time."""
    start = 0.0
    for k, phase in enumerate(problem.phases, start=1):
        plane.add_patch(Circle(phase.target, phase.radius, fill=False, zorder=3, **TARGET))
        if len(problem.phases) > 1:
            offset = (-3, -16) if k == 1 else (-10, 5)  # points: the paths come in from the other sides
            plane.annotate(f"{k}", phase.target, offset, textcoords="offset points", color="tab:green", weight="bold")
        end = start + phase.steps * problem.dt
        for ax, value in zip((position, velocity), phase.target):
            ax.plot([start, end], [value, value], linestyle="--", zorder=3, **TARGET)
        start = end


def add_legend(figure: Figure, problem: envs.Problem):
    """One legend for all panels, below them."""
    radius = problem.phases[0].radius
    handles = [
        Line2D([], [], **POLICY, label="policy"),
        Line2D([], [], **OPTIMUM, label="optimum"),
        Line2D([], [], **TARGET, linestyle="--", marker="o", fillstyle="none", label=f"target (radius {radius})"),
        Line2D([], [], color="k", marker=".", linestyle="", label="start"),
    ]
    if len(problem.phases) > 1:
        handles.append(Line2D([], [], **BOUNDARY, label="end of a phase"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))


def draw_costs(arrays: dict, metrics: dict) -> Figure:
    """Total costs of all starts as a histogram; of the first ten their total with the ratio, and its three parts."""
    env_id = metrics["env_id"]
    ours, optimum = (cost_parts(env_id, arrays[f"x{s}"], arrays[f"u{s}"]) for s in ("", "_reference"))
    figure = Figure(figsize=(12, 7), layout="constrained")
    panels = figure.subplot_mosaic([["all", "total", "total"], ["state", "control", "terminal"]])
    cost, reference_cost = arrays["cost"], arrays["cost_reference"]
    bins = np.histogram_bin_edges([cost, reference_cost], bins=min(40, max(5, len(cost) // 5)))
    panels["all"].hist(cost, bins, color="tab:red", alpha=0.45, label="policy")
    panels["all"].hist(reference_cost, bins, histtype="step", color="tab:blue", linewidth=1.4, label="optimum")
    panels["all"].set(xlabel="total cost J", ylabel="starts", title=f"All {len(cost)} starts")
    draw_bars(panels["total"], cost, reference_cost, "total cost J")
    chosen = comparable(env_id, arrays["x"], arrays["x_reference"])
    for k in range(min(SHOWN, len(cost))):
        text = f"{cost[k] / reference_cost[k]:.3f}" if chosen[k] else "miss"  # a missed circle forbids a ratio
        top = k + 1, max(cost[k], reference_cost[k])
        panels["total"].annotate(text, top, (0, 3), textcoords="offset points", ha="center", fontsize=9)
    panels["total"].margins(y=0.12)
    panels["total"].set_title("The first starts, with the ratio policy / optimum")
    for part, name in enumerate(("state", "control", "terminal")):
        draw_bars(panels[name], ours[:, part], optimum[:, part], f"{name} cost")
    panels["all"].legend()
    figure.suptitle(headline(metrics))
    return figure


def draw_bars(ax, ours: np.ndarray, optimum: np.ndarray, label: str):
    """Bars of the first ten starts side by side; `ours` and `optimum` are costs, (n,)."""
    case = np.arange(1, min(SHOWN, len(ours)) + 1)
    ax.bar(case - 0.2, ours[:SHOWN], 0.4, color="tab:red", label="policy")
    ax.bar(case + 0.2, optimum[:SHOWN], 0.4, color="tab:blue", hatch="///", edgecolor="white", label="optimum")
    ax.set(xlabel="start", ylabel=label, xticks=case)
    ax.grid(axis="y", alpha=0.3)


SMALLEST_LOSS = 1e-6  # a smaller one is drawn as this: the optimum itself is known to about 1e-8


def draw_cost_error(arrays: dict, metrics: dict) -> Figure:
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
    edge = 1.05 * envs.PROBLEMS[metrics["env_id"]].x0_max
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
    figure.suptitle(headline(metrics))
    return figure


# ---------------------------------------------------------------------------------------------------------------------
# Rocket ascent
# ---------------------------------------------------------------------------------------------------------------------

DASHED = {"linewidth": 1.4, "linestyle": (0, (6, 5))}  # one line a panel: gaps that show the other line beneath
OURS, BEST = {**POLICY, "linewidth": 2.2}, {**OPTIMUM, **DASHED}
# velocities share a panel with positions: the same widths and dashes, paler
VELOCITY = {**OURS, "color": "lightcoral"}, {**BEST, "color": "deepskyblue", "alpha": 0.6}
FLIGHTS = {"": OURS, "_reference": BEST}  # by the suffix of their arrays


def draw_ascent(arrays: dict, metrics: dict) -> Figure:
    """The paper's six panels (mass, altitude, speed, components), the thrust direction below them, pitch and yaw."""
    mission = envs.ROCKETS[metrics["env_id"]]
    figure = Figure(figsize=(15, 13), layout="constrained")
    rows = [["mass", "altitude", "speed"], ["x", "y", "z"], ["ux", "uy", "uz"]]
    mosaic = [[name for name in row for _ in range(2)] for row in rows] + [["pitch"] * 3 + ["yaw"] * 3]
    panels = figure.subplot_mosaic(mosaic, height_ratios=[3, 3, 1.3, 2])
    velocity = [panels[axis].twinx() for axis in "xyz"]
    for (side, style), pale in zip(FLIGHTS.items(), VELOCITY):
        t, u, y = (arrays[f"{key}{side}"] for key in ("t", "u", "y"))
        panels["mass"].plot(t, y[:, 6] / 1e3, **style)
        panels["altitude"].plot(t, altitude_km(y, mission.rocket), **style)
        panels["speed"].plot(t, np.linalg.norm(y[:, 3:6], axis=1) / 1e3, **style)
        for k, axis in enumerate("xyz"):
            panels[axis].plot(t, y[:, k] / 1e3, **style)
            velocity[k].plot(t, y[:, 3 + k] / 1e3, **pale)
            panels[f"u{axis}"].stairs(u[:, k], t, baseline=None, **{**style, "linewidth": style["linewidth"] / 1.5})
        for name, angle in zip(("pitch", "yaw"), pitch_and_yaw(u, y, mission.rocket)):
            panels[name].stairs(angle, t, baseline=None, **style)
    label_ascent(panels, velocity, mission.rocket)
    figure.suptitle(rocket_headline(metrics))
    lines = [(OURS, "policy"), (BEST, "optimum"), (VELOCITY[0], "velocity, policy")]
    lines += [(VELOCITY[1], "velocity, optimum"), (BOUNDARY, "end of a phase")]
    if mission.ceiling_km is not None:
        panels["altitude"].axhline(mission.ceiling_km, **{**TARGET, "linestyle": "--"})
        lines += [({**TARGET, "linestyle": "--"}, f"{mission.ceiling_km:.0f} km")]
    handles = [Line2D([], [], **style, label=label) for style, label in lines]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def label_ascent(panels: dict, velocity: list, rocket: envs.Rocket):
    """Axes' labels, the phases' ends, and what is dropped at each of them."""
    labels = {"mass": "(a) mass (t)", "altitude": "(b) altitude (km)", "speed": "(c) inertial speed (km/s)"}
    labels |= {axis: f"({letter}) position ${axis}$ (km)" for letter, axis in zip("def", "xyz")}
    labels |= {f"u{axis}": f"thrust $u_{axis}$" for axis in "xyz"}
    labels |= {"pitch": "pitch above the horizon (deg)", "yaw": "yaw from the target plane (deg)"}
    for name, ax in panels.items():
        ax.set(xlabel="time (s)", ylabel=labels[name], ylim=(-1.1, 1.1) if name[0] == "u" else None)
        ax.grid(alpha=0.3)
        for burn in rocket.burns[:-1]:
            ax.axvline(burn.end, **BOUNDARY)
    low, high = panels["yaw"].get_ylim()
    panels["yaw"].set_ylim(min(low, -5), max(high, 5))  # a flight in the plane would show rounding errors only
    for axis, ax in zip("xyz", velocity):
        ax.set_ylabel(f"velocity $v_{axis}$ (km/s), pale", color="0.4")
        ax.tick_params(axis="y", colors="0.4")
    for k, (burn, dropped) in enumerate(zip(rocket.burns[:-1], rocket.jettison)):  # the last burn drops nothing
        text, height = f" {burn.end:g} s: {dropped / 1e3:.2f} t dropped", 0.9 - 0.15 * (k % 5)  # of the axes
        side = "left" if burn.end <= rocket.end_time / 2 else "right"  # towards the middle: inside the panel
        where = {"transform": panels["mass"].get_xaxis_transform(), "horizontalalignment": side}
        panels["mass"].text(burn.end, height, text if side == "left" else f"{text.strip()} ", fontsize=9, **where)


def pitch_and_yaw(u: np.ndarray, y: np.ndarray, rocket: envs.Rocket) -> tuple[np.ndarray, np.ndarray]:
    """Pitch above the local horizon and yaw from the target plane, (K,) each in degrees, of u (K, 3) at y (K+1, 7).

    Yaw is NaN within six degrees of the vertical: its direction there is noise.
    """
    up, along, cross = np.einsum("cdk,kd->ck", envs.local_frame(y[: len(u)].T, envs.target_axes(rocket)[2]), u)
    yaw = np.where(np.hypot(along, cross) > 0.1, np.degrees(np.arctan2(cross, along)), np.nan)
    return np.degrees(np.arcsin(np.clip(up, -1, 1))), yaw


def target_points(rocket: envs.Rocket) -> np.ndarray:
    """Points (n, 3) in km, ECI, of the target orbit."""
    return orbit_points(*envs.target_orbit(rocket.target, rocket.mu), rocket)


def reached_points(y: np.ndarray, rocket: envs.Rocket) -> np.ndarray:
    """Points (n, 3) in km, ECI, of the orbit that a flight y (K+1, 7) ended in."""
    return orbit_points(*(np.array(vector) for vector in envs.orbit_vectors(y[-1], rocket.mu)), rocket)


def orbit_points(h: np.ndarray, e: np.ndarray, rocket: envs.Rocket) -> np.ndarray:
    """Points (n, 3) in km, ECI, of the orbit with this angular momentum and eccentricity vector, (3,) each.

    r = p / (1 + e . d) in every direction d of its plane, p = |h|^2 / mu; NaN where a hyperbola has none.
    """
    normal = h / np.linalg.norm(h)
    along = np.cross(normal, envs.target_axes(rocket)[0])  # any direction of the plane will do to count from
    ahead = along / np.linalg.norm(along)
    angle = np.radians(np.linspace(-180, 180, 3601))[:, None]
    directions = np.cos(angle) * np.cross(ahead, normal) + np.sin(angle) * ahead
    slowness = 1 + directions @ e
    r = (h @ h) / rocket.mu / 1e3 / np.where(slowness > 1e-3, slowness, np.nan)
    return r[:, None] * directions


def draw_orbit(arrays: dict, metrics: dict) -> Figure:
    """Ascent, target orbit and the orbit reached in the target's plane; the insertion enlarged; the ground track."""
    figure = Figure(figsize=(13, 11), layout="constrained")
    panels = figure.subplot_mosaic([["plane", "insertion"], ["ground", "ground"]], height_ratios=[3, 2])
    mission = envs.ROCKETS[metrics["env_id"]]
    reached = reached_points(arrays["y"], mission.rocket)
    lines = {
        "target orbit": (target_points(mission.rocket), {**TARGET, "linewidth": 4.0, "alpha": 0.4}),
        "policy": (arrays["y"][:, :3] / 1e3, OURS),
        "orbit reached": (reached, {**OURS, "linewidth": 1.0, "linestyle": ":"}),
        "optimum": (arrays["y_reference"][:, :3] / 1e3, BEST),
    }
    draw_target_plane(panels["plane"], panels["insertion"], lines, mission.rocket)
    top = 1.15 * max(mission.ceiling_km or 0.0, metrics["max_altitude_km"], metrics["reference_max_altitude_km"])
    panels["insertion"].set(ylim=(-0.03 * top, top))
    draw_ground_track(panels["ground"], arrays, mission.rocket)
    for ax in figure.axes:
        ax.grid(alpha=0.3)
    figure.suptitle(rocket_headline(metrics))
    figure.legend(*panels["plane"].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def draw_target_plane(plane, insertion, lines: dict, rocket: envs.Rocket):
    """The target's plane, perigee to the right, to scale; and in it altitude over angle, from launch to insertion.

    `lines`: label -> (points (n, 3) in km, ECI; style). The second panel cuts the first along the horizon.
    """
    axes, Re, ends = envs.target_axes(rocket), rocket.Re / 1e3, []
    launch = axes @ lines["policy"][0][0]
    middle = np.degrees(np.arctan2(launch[1], launch[0])) + 90  # no ascent goes further round the Earth than half
    for label, (r, style) in lines.items():
        x, y, _ = axes @ r.T
        angle, altitude = (np.degrees(np.arctan2(y, x)) - middle + 180) % 360 - 180, np.linalg.norm(r, axis=1) - Re
        altitude[1:][np.abs(np.diff(angle)) > 180] = np.nan  # no line from one edge to the other
        angle = angle + middle
        plane.plot(x / 1e3, y / 1e3, label=label, **style)
        insertion.plot(angle, altitude, **style)
        if label in ("policy", "optimum"):
            insertion.plot(angle[-1], altitude[-1], "o", color=style["color"], fillstyle="none")
            ends += [angle[0], angle[-1]]
    plane.add_patch(Circle((0, 0), Re / 1e3, color="0.85", zorder=0))
    plane.text(0, 0, "Earth", ha="center", va="center")
    a, b = rocket.a / 1e6, rocket.a / 1e6 * np.sqrt(1 - rocket.e**2)  # half axes
    left, right = max(a * (1 + rocket.e), Re / 1e3), max(a * (1 - rocket.e), Re / 1e3)
    margin, half = 0.06 * left, 1.1 * max(b, Re / 1e3)
    plane.set(xlim=(-left - margin, right + margin), ylim=(-half, half), aspect="equal")
    first = "the target's perigee" if rocket.e else f"{rocket.argp:g}° from the target's node"  # a circle's axes
    plane.set(xlabel=f"towards {first} (1000 km)", ylabel="a right angle ahead of it (1000 km)")
    plane.set_title("Plane of the target orbit")
    insertion.set(xlabel=f"angle from {first} (deg)", ylabel="altitude (km)")
    insertion.set(xlim=(min(ends) - 2, max(ends) + 8), title="Ascent and insertion (circles)")


def draw_ground_track(ax, arrays: dict, rocket: envs.Rocket):
    """Longitude (the launch site's is 0) and geocentric latitude of both flights, over the turning Earth."""
    along = np.radians(np.linspace(-90, 90, 361))[:, None]  # either side of the perigee
    perigee, semi_latus, _ = envs.target_axes(rocket)
    circle = np.cos(along) * perigee + np.sin(along) * semi_latus
    tracks = [(circle, 0.0, {**TARGET, "alpha": 0.4}, "target plane at launch")]
    tracks += [(circle, arrays["t"][-1], {**TARGET, "alpha": 0.4, "linestyle": ":"}, "target plane at the end")]
    tracks += [(arrays[f"y{side}"], arrays[f"t{side}"], style, "") for side, style in FLIGHTS.items()]
    for r, t, style, label in tracks:
        longitude = np.degrees(np.unwrap(np.arctan2(r[:, 1], r[:, 0])) - rocket.omega_e * t)
        ax.plot(longitude, np.degrees(np.arctan2(r[:, 2], np.hypot(r[:, 0], r[:, 1]))), label=label or None, **style)
    flown = np.concatenate([line.get_xydata() for line in ax.lines[2:]])
    (west, south), (east, north) = flown.min(axis=0), flown.max(axis=0)
    ax.set(xlim=(west - 2, east + 2), ylim=(south - 2, north + 2), title="Ground track")
    ax.set(xlabel="longitude from the launch site (deg)", ylabel="geocentric latitude (deg)")
    ax.legend(loc="lower left")


# policies first; not green, which is the target's
LAWS = ("tab:red", "tab:orange", "tab:purple", "tab:cyan", "tab:brown", "tab:blue", "tab:pink", "tab:olive", "tab:gray")
LAWS += ("black", "gold", "navy")


def draw_dispersed(laws: dict[str, dict], metrics: dict) -> Figure:
    """Where dispersed flights end: perigee over its argument, inclination over the node, distribution of ||error||.

    `laws`: label -> the `draw`, `final_y`, ... arrays of `evaluate.evaluate_dispersed`, one colour each. Flights beyond
    the axes, four boxes wide, are counted in the third panel alone. An angle that the target does not have is left out.
    """
    rocket = envs.ROCKETS[metrics["env_id"]].rocket
    figure = Figure(figsize=(15, 5), layout="constrained")
    *scatters, distribution = figure.subplots(1, 3)
    for ax in figure.axes:
        ax.set_prop_cycle(color=LAWS)
    labels = {"perigee_km": "perigee (km)", "i_deg": "inclination (deg)"}
    labels |= {"raan_deg": "right ascension of the node (deg)", "argp_deg": "argument of perigee (deg)"}
    for ax, (x, y) in zip(scatters, (("argp_deg", "perigee_km"), ("raan_deg", "i_deg"))):
        for label, arrays in laws.items():
            misses = element_misses(final_elements(arrays["final_y"], rocket), rocket)
            across = misses.get(x, np.zeros(len(arrays["final_y"])))
            ax.plot(across, misses[y], ".", markersize=3, alpha=0.5, label=label)
        ax.add_patch(Rectangle((-BOX[x], -BOX[y]), 2 * BOX[x], 2 * BOX[y], fill=False, **TARGET))
        ax.set(xlabel=f"{labels[x]} off the target", ylabel=f"{labels[y]} off the target")
        ax.set(xlim=(-4 * BOX[x], 4 * BOX[x]), ylim=(-4 * BOX[y], 4 * BOX[y]))
    for label, arrays in laws.items():
        errors = np.sort(np.linalg.norm(arrays["final_error"], axis=1))
        distribution.step(errors, np.arange(1, len(errors) + 1) / len(errors), where="post", label=label)
    distribution.set(xlabel="$\\Vert$error$\\Vert$", ylabel="share of the flights at most that far off", xscale="log")
    for ax in figure.axes:
        ax.grid(alpha=0.3)
    handles, names = distribution.get_legend_handles_labels()
    handles.append(Line2D([], [], **TARGET))
    figure.legend(handles, [*names, "a launcher's accuracy"], loc="outside lower center", ncols=min(len(handles), 5))
    title = f"{metrics['env_id']} at dispersion {metrics['dispersion']:g}"
    if len(laws) == 1:
        title += f": {metrics['dispersed_box_rate']:.1%} of {metrics['dispersed_starts']} flights inside the box"
    figure.suptitle(title)
    return figure
