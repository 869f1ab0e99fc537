"""Of a lander: names and units of a policy's numbers, columns of its flights."""

from __future__ import annotations

import numpy as np

from exports.columns import STATE, held, last_living, named, stacked
from exports.offers import Interface
from landing.task import LanderTask

THRUST = ("thrust_x_N", "thrust_y_N", "thrust_z_N")
GRAVITY = ("gravity_x_m_s2", "gravity_y_m_s2", "gravity_z_m_s2")
EFFECTIVENESS = ("effectiveness_x", "effectiveness_y", "effectiveness_z")


def interface(
    task: LanderTask,
    observe_phase: bool = True,
    observe_velocity: bool = True,
    observe_command: bool = True,
    observe_acceleration: bool = False,
    observe_draw: bool = False,
    **options,
) -> Interface:
    """What a policy observes and commands, with these options of the environment."""
    lander = task.lander
    commands = ["thrust_x", "thrust_y", "thrust_z"]
    before = [f"{name}_before" for name in commands]
    units = [*["m"] * 3, *["m/s"] * 3, "s", *["1"] * 3]
    observation = list(zip(("x", "y", "z", "vx", "vy", "vz", "time", *before), units))
    if observe_acceleration:
        observation += [(name, "m/s^2") for name in ("ax", "ay", "az")]
    if observe_draw:
        observation += [(name, "1") for name in ("mass", "dgx", "dgy", "dgz", *EFFECTIVENESS)]
    notes = "Axes: x downrange, y crossrange, z up, the pad the origin. "
    shown = {"time": observe_phase, "vx, vy, vz": observe_velocity, ", ".join(before): observe_command}
    hidden = [names for names, is_shown in shown.items() if not is_shown]
    if hidden:
        notes += f"Hidden in training, give 0: {', '.join(hidden)}. "
    notes += f"Action: the thrust over {lander.greatest_thrust:g} N, "
    notes += f"its norm clipped to {lander.least_thrust / lander.greatest_thrust:.6g} to 1, held until the next step; "
    notes += "so clipped it is observed in that step, 0 in the first."
    return Interface(observation, [(name, "1") for name in commands], notes)


def step_columns(task: LanderTask, arrays: dict, launch_longitude: float) -> dict[str, np.ndarray]:
    """The columns of all flights, a row for each period: state, command from there on, effectiveness of each axis."""
    y = arrays["y"]
    n, rows = y.shape[:2]
    times = np.minimum(float(arrays["decision_s"]) * np.arange(rows), arrays["final_t"][:n, None])
    columns = {"t_s": times, **named(STATE, y)}
    columns |= named(THRUST, held(arrays["u"][:n, : rows - 1]))
    columns |= named(EFFECTIVENESS, held(arrays["effectiveness"][:n, : rows - 1]))
    return stacked(columns, np.isfinite(y).all(axis=2))


def flight_columns(task: LanderTask, arrays: dict, metrics: dict) -> dict[str, np.ndarray]:
    """The columns with a row for each flight: start, gravity, touchdown, propellant, and the optimum's if solved."""
    final = arrays["final_y"]
    n = len(final)
    reference = np.full(n, np.nan)
    solved = arrays["fuel_kg_reference"][:n]
    reference[: len(solved)] = solved
    return {
        "flight": np.arange(n),
        **named([f"{name}_start" for name in STATE], arrays["start"]),
        **named(GRAVITY, arrays["gravity"]),
        **named(EFFECTIVENESS, last_living(arrays["effectiveness"])),
        "t_end_s": arrays["final_t"],
        **named([f"{name}_end" for name in STATE], final),
        "position_error_m": np.linalg.norm(final[:, :3], axis=1),
        "speed_m_s": np.linalg.norm(final[:, 3:6], axis=1),
        "fuel_kg": arrays["fuel_kg"],
        "fuel_of_optimum_kg": reference,
    }
