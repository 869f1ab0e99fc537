"""The rocket's figures: the ascent, its orbit, where dispersed flights end, and what laws save of failures."""

from __future__ import annotations

import itertools

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle

from drawing.style import BOUNDARY, OPTIMUM, POLICY, TARGET, TARGET_ORBIT, in_tonnes
from rocket.losses import STANDARD, in_words
from rocket.metrics import BOX, altitude_km, apsides, element_misses, wilson
from rocket.missions import Mission
from rocket.orbits import final_elements, local_frame, orbit_vectors, target_axes, target_orbit
from rocket.vehicle import Rocket

DASHED = {"linewidth": 1.4, "linestyle": (0, (6, 5))}  # the gaps show the other line beneath
OURS = {**POLICY, "linewidth": 2.2}
BEST = {**OPTIMUM, **DASHED}
# velocities share a panel with positions, so they have the same widths and dashes, but paler colours
VELOCITY = {**OURS, "color": "lightcoral"}, {**BEST, "color": "deepskyblue", "alpha": 0.6}
FLIGHTS = {"": OURS, "_reference": BEST}  # by the suffix of their arrays


def ascent_figure(mission: Mission, arrays: dict, title: str) -> Figure:
    """The paper's six panels (mass, altitude, speed, components), and below them thrust direction, pitch and yaw."""
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
    figure.suptitle(title)
    lines = [(OURS, "policy"), (BEST, "optimum"), (VELOCITY[0], "velocity, policy")]
    lines += [(VELOCITY[1], "velocity, optimum"), (BOUNDARY, "end of a phase")]
    if mission.ceiling_km is not None:
        panels["altitude"].axhline(mission.ceiling_km, **{**TARGET, "linestyle": "--"})
        lines += [({**TARGET, "linestyle": "--"}, f"{mission.ceiling_km:.0f} km")]
    handles = [Line2D([], [], **style, label=label) for style, label in lines]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def label_ascent(panels: dict, velocity: list, rocket: Rocket):
    """Label the axes, and mark the phases' ends with what is dropped there."""
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
    panels["yaw"].set_ylim(min(low, -5), max(high, 5))  # else a flight in the plane would only show rounding errors
    for axis, ax in zip("xyz", velocity):
        ax.set_ylabel(f"velocity $v_{axis}$ (km/s), pale", color="0.4")
        ax.tick_params(axis="y", colors="0.4")
    for k, (burn, dropped) in enumerate(zip(rocket.burns[:-1], rocket.jettison)):  # the last burn drops nothing
        text, height = f" {burn.end:g} s: {in_tonnes(dropped, 2)} dropped", 0.9 - 0.15 * (k % 5)  # of the axes
        side = "left" if burn.end <= rocket.end_time / 2 else "right"  # text towards the middle stays in the panel
        where = {"transform": panels["mass"].get_xaxis_transform(), "horizontalalignment": side}
        panels["mass"].text(burn.end, height, text if side == "left" else f"{text.strip()} ", fontsize=9, **where)


def pitch_and_yaw(u: np.ndarray, y: np.ndarray, rocket: Rocket) -> tuple[np.ndarray, np.ndarray]:
    """Pitch above the local horizon and yaw from the target plane, (K,) each in degrees, of u (K, 3) at y (K+1, 7).

    Yaw is NaN within six degrees of the vertical, where it is noise.
    """
    up, along, cross = np.einsum("cdk,kd->ck", local_frame(y[: len(u)].T, target_axes(rocket)[2]), u)
    yaw = np.where(np.hypot(along, cross) > 0.1, np.degrees(np.arctan2(cross, along)), np.nan)
    return np.degrees(np.arcsin(np.clip(up, -1, 1))), yaw


def orbit_points(h: np.ndarray, e: np.ndarray, rocket: Rocket) -> np.ndarray:
    """Points (n, 3) in km, ECI, of the orbit with this angular momentum and eccentricity vector, (3,) each.

    r = p / (1 + e . d) in every direction d of the plane, with p = |h|^2 / mu. It is NaN where a hyperbola has none.
    """
    normal = h / np.linalg.norm(h)
    along = np.cross(normal, target_axes(rocket)[0])  # any direction of the plane can be the first
    ahead = along / np.linalg.norm(along)
    angle = np.radians(np.linspace(-180, 180, 3601))[:, None]
    directions = np.cos(angle) * np.cross(ahead, normal) + np.sin(angle) * ahead
    slowness = 1 + directions @ e
    r = (h @ h) / rocket.mu / 1e3 / np.where(slowness > 1e-3, slowness, np.nan)
    return r[:, None] * directions


def orbit_figure(mission: Mission, arrays: dict, title: str, highest_km: float) -> Figure:
    """Ascent, target orbit and orbit reached in the target's plane, the enlarged insertion, and the ground track.

    highest_km is the greatest altitude of both flights.
    """
    figure = Figure(figsize=(13, 11), layout="constrained")
    panels = figure.subplot_mosaic([["plane", "insertion"], ["ground", "ground"]], height_ratios=[3, 2])
    rocket = mission.rocket
    target = orbit_points(*target_orbit(rocket.target, rocket.mu), rocket)
    reached = orbit_points(*np.array(orbit_vectors(arrays["y"][-1], rocket.mu)), rocket)
    lines = {
        "target orbit": (target, TARGET_ORBIT),
        "policy": (arrays["y"][:, :3] / 1e3, OURS),
        "orbit reached": (reached, {**OURS, "linewidth": 1.0, "linestyle": ":"}),
        "optimum": (arrays["y_reference"][:, :3] / 1e3, BEST),
    }
    plot_target_plane(panels["plane"], panels["insertion"], lines, rocket)
    top = 1.15 * max(mission.ceiling_km or 0.0, highest_km)
    panels["insertion"].set(ylim=(-0.03 * top, top))
    plot_ground_track(panels["ground"], arrays, rocket)
    for ax in figure.axes:
        ax.grid(alpha=0.3)
    figure.suptitle(title)
    figure.legend(*panels["plane"].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def plot_target_plane(plane, insertion, lines: dict, rocket: Rocket):
    """Plot the target's plane to scale, with the perigee to the right, and altitude over angle up to the insertion.

    `lines` are {label: (points (n, 3) in km, ECI, style)}. The second panel unrolls the first along the horizon.
    """
    axes, Re, ends = target_axes(rocket), rocket.Re / 1e3, []
    launch = axes @ lines["policy"][0][0]
    middle = np.degrees(np.arctan2(launch[1], launch[0])) + 90  # no ascent goes further than half round the Earth
    for label, (r, style) in lines.items():
        x, y, _ = axes @ r.T
        angle = (np.degrees(np.arctan2(y, x)) - middle + 180) % 360 - 180
        altitude = np.linalg.norm(r, axis=1) - Re
        altitude[1:][np.abs(np.diff(angle)) > 180] = np.nan  # no line from one edge to the other
        angle = angle + middle
        plane.plot(x / 1e3, y / 1e3, label=label, **style)
        insertion.plot(angle, altitude, **style)
        if label in ("policy", "optimum"):
            insertion.plot(angle[-1], altitude[-1], "o", color=style["color"], fillstyle="none")
            ends += [angle[0], angle[-1]]
    plane.add_patch(Circle((0, 0), Re / 1e3, color="0.85", zorder=0))
    plane.text(0, 0, rocket.body, ha="center", va="center")
    a, b = rocket.a / 1e6, rocket.a / 1e6 * np.sqrt(1 - rocket.e**2)  # half axes
    left = max(a * (1 + rocket.e), Re / 1e3)
    right = max(a * (1 - rocket.e), Re / 1e3)
    margin, half = 0.06 * left, 1.1 * max(b, Re / 1e3)
    plane.set(xlim=(-left - margin, right + margin), ylim=(-half, half), aspect="equal")
    first = "the target's perigee" if rocket.e else f"{rocket.argp:g}° from the target's node"  # a circle's axes
    plane.set(xlabel=f"towards {first} (1000 km)", ylabel="a right angle ahead of it (1000 km)")
    plane.set_title("Plane of the target orbit")
    insertion.set(xlabel=f"angle from {first} (deg)", ylabel="altitude (km)")
    insertion.set(xlim=(min(ends) - 2, max(ends) + 8), title="Ascent and insertion (circles)")


def plot_ground_track(ax, arrays: dict, rocket: Rocket):
    """Plot longitude (0 at the launch site) and geocentric latitude of both flights, over the turning Earth."""
    along = np.radians(np.linspace(-90, 90, 361))[:, None]  # either side of the perigee
    perigee, semi_latus, _ = target_axes(rocket)
    circle = np.cos(along) * perigee + np.sin(along) * semi_latus
    tracks = [(circle, 0.0, {**TARGET, "alpha": 0.4}, "target plane at launch")]
    tracks += [(circle, arrays["t"][-1], {**TARGET, "alpha": 0.4, "linestyle": ":"}, "target plane at the end")]
    tracks += [(arrays[f"y{side}"], arrays[f"t{side}"], style, "") for side, style in FLIGHTS.items()]
    for r, t, style, label in tracks:
        longitude = np.degrees(np.unwrap(np.arctan2(r[:, 1], r[:, 0])) - rocket.omega_e * t)
        ax.plot(longitude, np.degrees(np.arctan2(r[:, 2], np.hypot(r[:, 0], r[:, 1]))), label=label or None, **style)
    flown = np.concatenate([line.get_xydata() for line in ax.lines[2:]])
    (west, south) = flown.min(axis=0)
    (east, north) = flown.max(axis=0)
    ax.set(xlim=(west - 2, east + 2), ylim=(south - 2, north + 2), title="Ground track")
    ax.set(xlabel="longitude from the launch site (deg)", ylabel="geocentric latitude (deg)")
    ax.legend(loc="lower left")


# policies come first; green is the target's colour
COLOURS = ("tab:red", "tab:orange", "tab:purple", "tab:cyan", "tab:brown", "tab:blue", "tab:pink", "tab:olive")
COLOURS += ("tab:gray", "black", "gold", "navy")


def dispersed_figure(rocket: Rocket, flights: dict[str, dict], title: str) -> Figure:
    """Where dispersed flights end: perigee over its argument, inclination over the node, distribution of ||error||.

    `flights` are {label: arrays of `evaluate_dispersed`}, with one colour each. The axes are four boxes wide. Flights
    beyond them are only in the third panel. An angle that the target does not have is left out.
    """
    figure = Figure(figsize=(15, 5), layout="constrained")
    *scatters, distribution = figure.subplots(1, 3)
    for ax in figure.axes:
        ax.set_prop_cycle(color=COLOURS)
    labels = {"perigee_km": "perigee (km)", "i_deg": "inclination (deg)"}
    labels |= {"raan_deg": "right ascension of the node (deg)", "argp_deg": "argument of perigee (deg)"}
    for ax, (x, y) in zip(scatters, (("argp_deg", "perigee_km"), ("raan_deg", "i_deg"))):
        for label, arrays in flights.items():
            ends = final_elements(arrays["final_y"], rocket)
            ends |= {key: arrays[key] for key in ("target",) if key in arrays}
            misses = element_misses(ends, rocket)
            across = misses.get(x, np.zeros(len(arrays["final_y"])))
            ax.plot(across, misses[y], ".", markersize=3, alpha=0.5, label=label)
        ax.add_patch(Rectangle((-BOX[x], -BOX[y]), 2 * BOX[x], 2 * BOX[y], fill=False, **TARGET))
        ax.set(xlabel=f"{labels[x]} off the target", ylabel=f"{labels[y]} off the target")
        ax.set(xlim=(-4 * BOX[x], 4 * BOX[x]), ylim=(-4 * BOX[y], 4 * BOX[y]))
    for label, arrays in flights.items():
        errors = np.sort(np.linalg.norm(arrays["final_error"], axis=1))
        distribution.step(errors, np.arange(1, len(errors) + 1) / len(errors), where="post", label=label)
    distribution.set(xlabel="$\\Vert$error$\\Vert$", ylabel="share of the flights at most that far off", xscale="log")
    decades = np.log10(distribution.get_xlim())
    distribution.set_xlim(10 ** np.floor(decades[0]), 10 ** np.ceil(decades[1]))  # else ticks between them have labels
    for ax in figure.axes:
        ax.grid(alpha=0.3)
    handles, names = distribution.get_legend_handles_labels()
    handles.append(Line2D([], [], **TARGET))
    figure.legend(handles, [*names, "a launcher's accuracy"], loc="outside lower center", ncols=min(len(handles), 4))
    figure.suptitle(title)
    return figure


def targets_figure(rocket: Rocket, arrays: dict, title: str) -> Figure:
    """||error|| and the mass that is missing, over the targets' apogee and inclination. The worst are named.

    `arrays` are those of `evaluate_targets`. The missing mass is in percent of the optimum's, where it is known.
    """
    figure = Figure(figsize=(13, 8), layout="constrained")
    a, e, i, _, _ = arrays["target"].T
    apogee = apsides(a / 1e3, e, rocket)["apogee_km"]
    errors = np.linalg.norm(arrays["final_error"], axis=1)
    missing = 100 * (1 - arrays["final_y"][:, 6] / arrays["best_mass"])
    rows = (("$\\Vert$error$\\Vert$", errors, "log"), ("mass less than the optimum's (%)", missing, "linear"))
    for axes, (label, values, scale) in zip(figure.subplots(2, 2), rows):
        known = np.flatnonzero(np.isfinite(values))
        for ax, across, name in zip(
            axes, (apogee, i), ("apogee of the target (km)", "inclination of the target (deg)")
        ):
            ax.plot(across[known], values[known], ".", markersize=3, alpha=0.5)
            ax.set(xlabel=name, ylabel=label, yscale=scale)
            ax.grid(alpha=0.3)
            for k, aside in zip(known[np.argsort(values[known])[-3:]], ((4, -9), (-22, -4), (4, 3))):
                ax.annotate(f"{k}", (across[k], values[k]), xytext=aside, textcoords="offset points", fontsize=8)
        axes[0].set(xscale="log")
    figure.suptitle(f"{title}. Numbers are those of the worst targets, from 0")
    return figure


def losses_figure(report: dict, title: str) -> Figure:
    """The share saved of the savable flights over the share of thrust lost, and kilograms beside `losses.STANDARD`.

    report is that of `losses.loss_report`. A group of flights is at the middle of its losses. Bars are 95 % intervals,
    by Wilson for a share, and paired for a difference. The group above `LARGE` is left out, because its flights are
    also in other groups.
    """
    figure = Figure(figsize=(12, 5), layout="constrained")
    share, kilograms = figure.subplots(1, 2)
    places = {"0": 0.0}
    for label in report:
        low, between, high = label.partition(" to ")
        if between:
            places[label] = (float(low.rstrip("%")) + float(high.rstrip("%"))) / 2
    names = list(report["0"])
    for k, (name, colour) in enumerate(zip(names, itertools.cycle(COLOURS))):
        aside = 0.12 * (k - (len(names) - 1) / 2)  # so that equal points do not hide one another
        style = {
            "color": colour,
            "marker": "o",
            "markersize": 4,
            "linewidth": 1.0,
            "capsize": 2,
            "label": in_words(name),
        }
        rows = [(place + aside, report[label][name]) for label, place in places.items()]
        saved = [(x, row["saved"], row["savable"]) for x, row in rows if row["savable"]]
        if saved:
            bounds = np.array([wilson(hits, flights) for _, hits, flights in saved])
            rate = np.array([hits / flights for _, hits, flights in saved])
            share.errorbar([x for x, *_ in saved], 100 * rate, 100 * np.abs(bounds.T - rate), **style)
        pairs = [(x, row["against"]) for x, row in rows if "mass_kg" in row.get("against", {})]
        if pairs:
            x = [place for place, _ in pairs]
            mean, low, high = (
                np.array([pair[f"mass_kg{part}"] for _, pair in pairs]) for part in ("", "_low", "_high")
            )
            kilograms.errorbar(x, mean, [mean - low, high - mean], **style)
    share.set(ylabel="saved of the savable (%)")
    kilograms.set(ylabel=f"kg more than {in_words(STANDARD)},\nwhere both saved")
    for ax in figure.axes:
        ax.set(xlabel="share of thrust lost (%)")
        ax.grid(alpha=0.3)
    handles, labels = share.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(handles), 5))
    figure.suptitle(title)
    return figure
