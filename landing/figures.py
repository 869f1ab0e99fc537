"""The landers' figures: paths and thrust, touchdowns, and propellant beside the optimum's.

Each takes the arrays of eval.npz: n flights by periods of `decision_s` seconds, NaN behind a flight's end. These are
`effectiveness` (n, T, 3), `gravity` (n, 3) m/s^2, `final_y` (n, 7), `fuel_kg` (n,) and `fuel_kg_reference` (j,), and
the states of the first flights and of their optima, `y` (k, T+1, 7) and `y_reference` (j, T'+1, 7). A state is r (m),
v (m/s) and m (kg).
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from drawing.style import BOUNDARY, OPTIMUM, POLICY, TARGET
from landing.lander import Lander
from landing.rewards import POSITION_LIMIT, SPEED_LIMIT

PATHS = 15  # flights of which the path is shown
THRUSTS = 3  # flights of which the thrust is shown, too
HEALTHY, FAILED = POLICY["color"], "tab:purple"
STRIKE = {"color": "k", "linewidth": 1.0, "linestyle": "--"}
BOX = {**TARGET, "linestyle": "--"}
SMALLEST = 1e-4  # m and m/s; a smaller error is shown as this
WHOLE_CIRCLE = 0.2  # share of `POSITION_LIMIT`; wider touchdowns are shown with the whole circle around them


def has_failed(effectiveness: np.ndarray) -> np.ndarray:
    """The flights (n,) that a failure struck while they flew, as a mask."""
    return (effectiveness < 1).any(axis=(1, 2))


def groups_of(effectiveness: np.ndarray) -> list[tuple]:
    """(label, colour, marker, mask (n,)) of the healthy and of the failed flights. An empty group is left out."""
    failed = has_failed(effectiveness)
    groups = [("healthy", HEALTHY, "o", ~failed), ("with a failure", FAILED, "x", failed)]
    return [group for group in groups if group[-1].any()]


def strike_time(effectiveness: np.ndarray, period: float) -> float | None:
    """The time (s) when a failure struck a flight with this effectiveness (T, 3) by `period` (s). None if healthy."""
    acts = (effectiveness < 1).any(axis=1)
    return float(np.argmax(acts) * period) if acts.any() else None


def flown_states(flights: np.ndarray, row: int) -> np.ndarray:
    """The states (K+1, 7) of one flight of (n, T+1, 7) up to its end. Without such a flight there are none."""
    y = flights[row : row + 1].reshape(-1, 7)
    return y[np.isfinite(y).all(axis=1)]


def flown_thrust(y: np.ndarray, gravity: np.ndarray, period: float) -> np.ndarray:
    """The thrust (K, 3) in N that acted in each period of one flight y (K+1, 7): m (dv/dt - g).

    A touchdown cuts the last period short by an unknown time, so its thrust is given as that of the period before.
    """
    mass = (y[1:, 6:] + y[:-1, 6:]) / 2
    thrust = mass * (np.diff(y[:, 3:6], axis=0) / period - gravity)
    thrust[-1] = thrust[max(len(thrust) - 2, 0)]
    return thrust


# ---------------------------------------------------------------------------------------------------------------------
# Paths and thrust
# ---------------------------------------------------------------------------------------------------------------------


def descent_figure(arrays: dict, title: str, lander: Lander) -> Figure:
    """Altitude over downrange and crossrange (m) of the first flights; thrust (kN) over time (s) of three of them.

    Only these three are shown with their optima. Dotted lines are the limits of the lander's thrust.
    """
    figure = Figure(figsize=(13, 9.5), layout="constrained")
    paths, thrusts = figure.subfigures(2, 1, height_ratios=[3, 2])
    chosen = chosen_flights(arrays)
    for axis, ax in enumerate(paths.subplots(1, 2, sharey=True)):
        plot_paths(ax, arrays, axis, chosen)
        ax.set(xlabel=("downrange (m)", "crossrange (m)")[axis], ylabel="altitude (m)")
    for row, ax in zip(chosen, thrusts.subplots(1, len(chosen), sharey=True, squeeze=False)[0]):
        plot_thrust(ax, arrays, row, lander)
        ax.set(xlabel="time (s)", ylabel="thrust (kN)")
    for ax in figure.axes:
        ax.label_outer()
        ax.grid(alpha=0.3)
    count = len(arrays["y"][:PATHS])
    figure.suptitle(f"{title}\npaths of the first {count} flights" if count > 1 else title)
    add_legend(figure, arrays, chosen)
    return figure


def add_legend(figure: Figure, arrays: dict, chosen: list[int]):
    """One legend for all panels, of what is there."""
    effectiveness = arrays["effectiveness"]
    handles = [
        Line2D([], [], **{**POLICY, "color": colour}, label=label)
        for label, colour, _, _ in groups_of(effectiveness[: len(arrays["y"])][:PATHS])
    ]
    handles.append(Line2D([], [], **OPTIMUM, label="optimum, of the flights below"))
    handles.append(Line2D([], [], color=TARGET["color"], marker="^", markersize=9, linestyle="", label="pad"))
    if any(strike_time(effectiveness[row], 1.0) for row in chosen):  # later than at the start
        handles.append(Line2D([], [], **STRIKE, label="the failure strikes"))
    handles.append(Line2D([], [], **BOUNDARY, label="limits of the thrust"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))


def chosen_flights(arrays: dict) -> list[int]:
    """The rows of the flights whose thrust is shown: the first healthy one, then failed ones, then the others."""
    failed = has_failed(arrays["effectiveness"][: len(arrays["y"])][:PATHS])
    healthy = np.flatnonzero(~failed)
    others = np.flatnonzero(failed)
    order = [*healthy[:1], *others[: THRUSTS - 1], *healthy[1:], *others[THRUSTS - 1 :]]
    return sorted(int(row) for row in order[:THRUSTS])


def plot_paths(ax, arrays: dict, axis: int, chosen: list[int]):
    """Altitude over one horizontal axis; the chosen flights bold, with their optima."""
    failed = has_failed(arrays["effectiveness"])
    for row, y in enumerate(arrays["y"][:PATHS]):
        is_chosen = row in chosen
        look = {"linewidth": 1.8, "zorder": 3} if is_chosen else {"linewidth": 0.8, "alpha": 0.5}
        ax.plot(y[:, axis], y[:, 2], color=FAILED if failed[row] else HEALTHY, **look)
        if is_chosen:
            best = flown_states(arrays["y_reference"], row)
            ax.plot(best[:, axis], best[:, 2], **{**OPTIMUM, "linewidth": 1.4}, zorder=4)
    ax.plot(0, 0, "^", color=TARGET["color"], markersize=9, zorder=5)
    low, high = ax.get_xlim()
    if high - low < 1.0:  # all fly in one plane
        ax.set_xlim(-100, 100)


def plot_thrust(ax, arrays: dict, row: int, lander: Lander):
    """The thrust that acted in one flight and in its optimum."""
    period = float(arrays["decision_s"])
    gravity = arrays["gravity"][row]
    strike = strike_time(arrays["effectiveness"][row], period)
    sides = [(arrays["y"], {**POLICY, "color": HEALTHY if strike is None else FAILED})]
    sides.append((arrays["y_reference"], OPTIMUM))
    for flights, style in sides:
        y = flown_states(flights, row)
        if len(y):
            thrust = flown_thrust(y, gravity, period)
            size = np.linalg.norm(thrust, axis=1) / 1e3
            ax.stairs(size, period * np.arange(len(size) + 1), baseline=None, **style)
    for limit in (lander.least_thrust, lander.greatest_thrust):
        ax.axhline(limit / 1e3, **BOUNDARY)
    if strike:
        ax.axvline(strike, **STRIKE)
    ax.set_title(f"flight {row + 1}: {words_of(strike)}")
    ax.set_ylim(bottom=0)


def words_of(strike: float | None) -> str:
    """What happened to a flight."""
    if strike is None:
        return "healthy"
    return f"failure at {strike:.1f} s" if strike else "failure from the start"


# ---------------------------------------------------------------------------------------------------------------------
# Touchdowns
# ---------------------------------------------------------------------------------------------------------------------


def touchdown_figure(arrays: dict, title: str) -> Figure:
    """Where flights touch down in the plane of the pad (m), and speed (m/s) over position error (m) at the end."""
    figure = Figure(figsize=(12.5, 6.2), layout="constrained")
    plane, errors = figure.subplots(1, 2)
    final = arrays["final_y"]
    is_down = final[:, 2] < SMALLEST
    position = np.linalg.norm(final[:, :3], axis=1)
    speed = np.linalg.norm(final[:, 3:6], axis=1)
    colours = np.where(has_failed(arrays["effectiveness"]), FAILED, HEALTHY)
    look = {"s": min(3000 / len(final) ** 0.7, 40), "alpha": 0.6, "linewidths": 0}
    plane.scatter(*final[is_down, :2].T, c=colours[is_down], **look)
    errors.scatter(*np.maximum([position, speed], SMALLEST), c=colours, **look)
    remarks = fit_plane(plane, final[is_down, :2])
    if not is_down.all():
        remarks.append(f"{(~is_down).sum()} ended in the air")
    plane.set_title("\n".join([f"Touchdowns of {counted(len(final), 'flight')}", ", ".join(remarks)]))
    draw_box(errors)
    is_small = min(position.min(), speed.min()) < SMALLEST
    errors.set_title("\n".join(["Errors at the end", f"below {SMALLEST:g} shown as that" if is_small else ""]))
    for ax in figure.axes:
        ax.grid(alpha=0.3)
    handles = []
    for label, colour, _, mask in groups_of(arrays["effectiveness"]):
        label = f"{label} ({counted(mask.sum(), 'flight')})"
        handles.append(Line2D([], [], color=colour, marker="o", linestyle="", label=label))
    box = f"published box: |r| < {POSITION_LIMIT:g} m, |v| < {SPEED_LIMIT:g} m/s"
    handles.append(Line2D([], [], label=box, **BOX))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    figure.suptitle(title)
    return figure


def counted(count: int, noun: str) -> str:
    """1 flight, 2 flights."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def fit_plane(ax, points: np.ndarray) -> list[str]:
    """Set axes that hold 99 % of the touchdowns (k, 2). Returns remarks on what is out of view.

    The circle of `POSITION_LIMIT` is in view, unless the touchdowns would then be a dot.
    """
    reach = np.abs(points).max(axis=1, initial=0.0)
    half = 1.15 * float(np.percentile(reach, 99)) if len(points) else POSITION_LIMIT
    if half > WHOLE_CIRCLE * POSITION_LIMIT:
        half = max(half, 1.1 * POSITION_LIMIT)
    half = max(half, 10 * SMALLEST)
    ax.add_patch(Circle((0, 0), POSITION_LIMIT, fill=False, zorder=4, **BOX))
    ax.plot(0, 0, "+", color=TARGET["color"], markersize=18, markeredgewidth=1.5, zorder=1)
    ax.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")
    ax.set(xlabel="downrange $x$ (m)", ylabel="crossrange $y$ (m)")
    remarks = []
    if half < POSITION_LIMIT:
        remarks.append(f"the circle of {POSITION_LIMIT:g} m is out of view")
    if (reach > half).any():
        remarks.append(f"{(reach > half).sum()} are out of view")
    return remarks


def draw_box(ax):
    """Logarithmic axes of the errors, which hold the corner of the published box, and the box itself."""
    ax.set(xscale="log", yscale="log")
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    left = min(left, POSITION_LIMIT / 10)
    bottom = min(bottom, SPEED_LIMIT / 10)
    ax.set(xlim=(left, max(right, 2 * POSITION_LIMIT)), ylim=(bottom, max(top, 2 * SPEED_LIMIT)))
    corners = [left, POSITION_LIMIT, POSITION_LIMIT], [SPEED_LIMIT, SPEED_LIMIT, bottom]
    ax.plot(*corners, zorder=4, **BOX)
    ax.set(xlabel="position error $|r|$ (m)", ylabel="speed $|v|$ (m/s)")


# ---------------------------------------------------------------------------------------------------------------------
# Propellant
# ---------------------------------------------------------------------------------------------------------------------


def propellant_figure(arrays: dict, title: str) -> Figure:
    """Propellant (kg) of each flight over the optimum's on the same draw, with the ratio of their sums.

    Only draws with a known optimum are shown.
    """
    figure = Figure(figsize=(7.5, 7.2), layout="constrained")
    ax = figure.subplots()
    fuel = arrays["fuel_kg"][: len(arrays["fuel_kg_reference"])]
    best = arrays["fuel_kg_reference"][: len(fuel)]
    known = np.isfinite(best)
    fuel, best = fuel[known], best[known]
    for label, colour, marker, mask in groups_of(arrays["effectiveness"][: len(known)][known]):
        ratio = fuel[mask].sum() / best[mask].sum()
        label = f"{label} ({counted(mask.sum(), 'flight')}): {ratio:.3f} x optimum"
        ax.scatter(best[mask], fuel[mask], s=28, color=colour, marker=marker, alpha=0.7, label=label)
    both = np.concatenate([fuel, best])
    margin = 0.05 * max(np.ptp(both), 0.02 * both.max())
    limits = both.min() - margin, both.max() + margin
    ax.plot(limits, limits, color=OPTIMUM["color"], linewidth=1.2, linestyle="--", label="as much as the optimum")
    ax.set(xlim=limits, ylim=limits, aspect="equal")
    ax.set(xlabel="propellant of the optimum (kg)", ylabel="propellant of the policy (kg)")
    ax.set_title(f"{title}\n{counted(len(fuel), 'draw')}", fontsize=11)
    ax.legend(loc="upper left")
    ax.grid(alpha=0.3)
    return figure
