"""A rocket's printed table, "target | optimum | ours | difference", and the lines below it."""

from __future__ import annotations

import math

from common.tables import lines_of
from rocket.environment import RocketVectorEnv
from rocket.failure import WHEN
from rocket.metrics import BOX, ELEMENT_ERRORS, EQUATORIAL, SUCCESS, lowest_key, target_summary, wrapped
from rocket.missions import Mission


def table(metrics: dict, mission: Mission) -> str:
    """The table of a rocket's evaluation, with "-" for a number that there is not."""
    target = target_summary(mission.rocket)
    optimum = {key: metrics.get(f"reference_{key}") for _, key, _ in table_rows(mission)}
    optimum |= {"mass_ratio": 1.0, "mass_ratio_reached": 1.0}
    optimum |= {"final_mass_kg": metrics["reference_mass_kg"], "final_time_s": metrics["reference_time_s"]}
    rows: list[tuple] = [("", "target", "optimum", "ours", "difference")]
    for label, key, digits in table_rows(mission):
        without_meaning = key in ELEMENT_ERRORS and key not in target  # an angle that the target orbit does not have
        if without_meaning:
            rows.append((label, "-", "-", "-", "-"))
        elif key in metrics or key != "mass_ratio_reached":
            rows.append((label, *cells(key, digits, target.get(key), optimum[key], metrics.get(key))))
    optimum_succeeds = metrics["reference_error_norm"] < SUCCESS
    success = ["yes" if hit else "no" for hit in (optimum_succeeds, metrics["success"])]
    rows.append(("success", "-", *success, "crashed" if metrics["crashed"] else "-"))
    title = f"{metrics['env_id']}: difference from the target, or where there is none from the optimum"
    below = [*remarks(metrics, mission), *target_lines(metrics), *dispersed_lines(metrics), *failure_lines(metrics)]
    return "\n".join([title, *lines_of(rows), *below])


def cells(key: str, digits: int, target: float | None, optimum: float | None, ours: float | None) -> list[str]:
    """Target, optimum, the policy's number, and its difference from the target, or without one from the optimum."""
    compared = optimum if target is None else target
    numbers = ["-" if value is None else f"{value:.{digits}f}" for value in (target, optimum, ours)]
    if ours is None or compared is None:
        return [*numbers, "-"]
    return [*numbers, f"{wrapped(key, ours - compared):+.{digits}f}"]


def remarks(metrics: dict, mission: Mission) -> list[str]:
    """The lines below the rocket's table: remarks on its numbers, the return and its parts, the opponent."""
    lines = []
    stopped = abs(metrics.get("a_error_km", math.inf)) < 1e-3  # a crash or an empty tank may come first
    if mission.cutoff and stopped:
        lines.append("  With cut-off the engine stops at the target's orbital energy: a is exact because of this rule.")
    if "navigation_noise_m" in metrics:
        position, velocity = (metrics[f"navigation_noise_{unit}"] for unit in ("m", "m_s"))
        lines.append(f"  Position and velocity are seen with a noise of {position:g} m and {velocity:g} m/s.")
    if "mass_ratio_reached" in metrics:
        mass = f"{metrics['reference_mass_reached_kg']:.3f} kg"
        lines.append(f"  The optimum for the five elements reached leaves {mass}: the measure of our mass.")
    returns = f"return {metrics['episodic_return']:.3f} (the optimum's {metrics['reference_episodic_return']:.3f})"
    lines.append(f"  {returns}; points (the paper's 2000 + up to 3200, their shape ours): {metrics['points']:.1f}")
    parts = ", ".join(f"{part} {metrics[part]:.3f}" for part in RocketVectorEnv.PARTS)
    lines.append(f"    of it: {parts}")
    opponent = f"||error|| {metrics['nine_pitch_error_norm']:.6f}"
    return [*lines, f"  Opponent, open loop: the optimum's pitch (and yaw) at nine times, interpolated: {opponent}"]


def table_rows(mission: Mission) -> list[tuple[str, str, int]]:
    """The rows of a rocket's table: label, metric, digits."""
    equatorial = mission.rocket.i in EQUATORIAL
    return [
        ("semi-major axis a (km)", "a_km", 3),
        ("eccentricity e", "e", 6),
        ("inclination i (deg)", "i_deg", 4),
        ("right ascension of the node (deg)", "raan_deg", 4),
        ("perigee from the x axis (deg)" if equatorial else "argument of perigee (deg)", "argp_deg", 4),
        ("perigee altitude (km)", "perigee_km", 3),
        ("apogee altitude (km)", "apogee_km", 3),
        ("final mass (kg)", "final_mass_kg", 3),
        ("  of the optimum's for the orbit reached", "mass_ratio_reached", 6),
        ("  of the optimum's for the target orbit", "mass_ratio", 6),
        ("final time (s)", "final_time_s", 3),
        ("maximum altitude (km)", "max_altitude_km", 3),
        (f"lowest altitude after {mission.floor_from:.0f} s (km)", lowest_key(mission), 3),
        (f"||error|| (success: below {SUCCESS})", "error_norm", 6),
    ]


def target_lines(metrics: dict) -> list[str]:
    """The lines below the rocket's table about flights to other targets. There are none where all fly to one orbit."""
    if "target_starts" not in metrics:
        return []
    errors = ", ".join(f"{name} {metrics[f'target_error_{name}']:.6f}" for name in ("median", "p95", "max"))
    lines = [f"  {metrics['target_starts']} flights, each to its own target: ||error|| {errors}"]
    lines.append(f"    inside the box {metrics['target_box_rate']:.2%}; {metrics['target_crashed']} crashed")
    if "target_mass_ratio_mean" in metrics:
        ratios = ", ".join(f"{name} {metrics[f'target_mass_ratio_{name}']:.4%}" for name in ("mean", "min"))
        lines.append(f"    mass of the optimum's for the first {metrics['target_reference_starts']} targets: {ratios}")
    return lines


def dispersed_lines(metrics: dict) -> list[str]:
    """The lines below the rocket's table about dispersed flights. There are none without such flights."""
    if "dispersion" not in metrics or metrics["dispersed_starts"] == 0:
        return []
    n = metrics["dispersed_starts"]
    errors = ", ".join(f"{name} {metrics[f'dispersed_error_{name}']:.6f}" for name in ("median", "p95", "p99", "max"))
    flights = "healthy flights" if "failure" in metrics else "flights"
    lines = [f"  {n} {flights} at dispersion {metrics['dispersion']:g}: ||error|| {errors}"]
    spreads = []
    for key, half in BOX.items():
        name, unit = key.rsplit("_", 1)
        if f"dispersed_{name}_error_mean_{unit}" in metrics:
            mean, std = (metrics[f"dispersed_{name}_error_{part}_{unit}"] for part in ("mean", "std"))
            digits = 2 if unit == "km" else 4
            spreads.append(f"{name} {mean:+.{digits}f} ± {std:.{digits}f} {unit} (box ± {half:g})")
    if spreads:  # of those that reached an orbit
        lines.append(f"    off the target, mean ± standard deviation: {', '.join(spreads)}")
    rate, low, high = (metrics[f"dispersed_box_{part}"] for part in ("rate", "low", "high"))
    lines.append(f"    inside the box in all of them {rate:.2%} (95 %: {low:.2%} to {high:.2%})")
    mass = f"final mass {metrics['dispersed_mass_mean_kg']:.2f} kg on average, 1 % below"
    ends = f"{metrics['dispersed_dry']} ran dry, {metrics['dispersed_crashed']} crashed"
    return [*lines, f"    {mass} {metrics['dispersed_mass_p01_kg']:.2f} kg; {ends}"]


def failure_lines(metrics: dict) -> list[str]:
    """The lines below the rocket's table about flights with a failure. There are none without such flights."""
    if not metrics.get("failure"):
        return []
    loss = f"up to {metrics['failure']:.0%} of thrust lost {WHEN[metrics['failure_time']]}"
    n = metrics["failure_starts"]
    savable = metrics["failure_savable"]
    lines = [f"  {n} flights with a failure, {loss}; {savable} of them can be saved"]
    if "failure_saved_rate" in metrics:
        errors = ", ".join(f"{name} {metrics[f'failure_error_{name}']:.6f}" for name in ("median", "p95"))
        saved = f"{metrics['failure_saved_rate']:.2%} are saved, below {SUCCESS}"
        lines.append(f"    of these {saved}; ||error|| {errors}")
    if "failure_mass_short_mean_kg" in metrics:
        best = "the optimum that knows of the failure from its strike on"
        short = f"{metrics['failure_mass_short_mean_kg']:.2f} kg"
        lines.append(f"    the saved end with {short} less on average than {best}")
    return lines
