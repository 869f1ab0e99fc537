"""Of a small problem: names of a policy's numbers, columns of its flights, its page."""

from __future__ import annotations

import numpy as np

from exports.columns import held, last_living, named, numbered, stacked
from exports.offers import Interface
from exports.phased_page import page
from phased.problem import Problem
from phased.task import PhasedTask

__all__ = ["flight_columns", "interface", "page", "step_columns"]  # what this family offers


def state_names(problem: Problem) -> list[str]:
    """x1, x2, ..., as the paper counts."""
    return numbered("x", problem.states)


def control_names(problem: Problem) -> list[str]:
    """u, or u1, u2, ..."""
    return ["u"] if problem.controls == 1 else numbered("u", problem.controls)


def interface(
    task: PhasedTask,
    observe_phase: bool = True,
    observe_velocity: bool = True,
    observe_draw: bool = False,
    scaled_action: bool = False,
) -> Interface:
    """What a policy observes and commands, with these options of the environment."""
    problem = task.problem
    states = state_names(problem)
    controls = control_names(problem)
    clocks = ["tau", "phi"] if problem.waypoints else ["tau"]
    seen = list(states)
    if problem.waypoints:
        seen += [f"{name}_target" for name in states]
    seen += clocks
    if observe_draw:
        seen += numbered("score", problem.scores)
    longest = problem.steps * problem.dt
    notes = f"Units are the table's. tau: time / {longest:g} s, at most 1. "
    if problem.waypoints:
        notes += "The targets move to a new phase's over its first 5 steps. phi: the phase, from 0 to 1. "
    hidden = [] if observe_phase else clocks
    hidden += [] if observe_velocity else [states[k] for k in problem.hidden_velocities]
    if hidden:
        notes += f"Hidden in training, give 0: {', '.join(hidden)}. "
    low, high = problem.u_box.tolist()
    if scaled_action:
        action = "sinh(action)" if problem.step else "action"
        notes += f"Control: {problem.u_centre.tolist()} + {problem.u_unit.tolist()} x {action}, "
    else:
        notes += "Control: the action, "
    bound = f"within {low} to {high}" if problem.u_norm is None else f"its norm within {list(problem.u_norm)}"
    notes += f"clipped {bound}, held for {problem.dt:g} s."
    return Interface([(name, "1") for name in seen], [(name, "1") for name in controls], notes)


def step_columns(task: PhasedTask, arrays: dict, launch_longitude: float) -> dict[str, np.ndarray]:
    """The columns of all flights, a row for each state: time (s), state, and the control from there on."""
    problem = task.problem
    x = arrays["x"]
    u = arrays["u"].reshape(*arrays["u"].shape[:2], problem.controls)
    times = np.tile(arrays["t"], (len(x), 1))
    if "final_time" in arrays:  # an event ended the last step before its end
        times = np.minimum(times, arrays["final_time"][:, None])
    lives = np.isfinite(x).all(axis=2)
    columns = {"t_s": times, **named(state_names(problem), x), **named(control_names(problem), held(u))}
    return stacked(columns, lives)


def flight_columns(task: PhasedTask, arrays: dict, metrics: dict) -> dict[str, np.ndarray]:
    """The columns with a row for each flight: start, end, cost, and the optimum's cost from the same start."""
    problem = task.problem
    x = arrays["x"]
    names = state_names(problem)
    columns = {"flight": np.arange(len(x))}
    if "draw" in arrays:
        columns |= named(numbered("score", problem.scores), arrays["draw"][:, : problem.scores])
    columns |= named([f"{name}_start" for name in names], x[:, 0])
    columns |= named([f"{name}_end" for name in names], last_living(x))
    if "final_time" in arrays:
        columns["t_end_s"] = arrays["final_time"]
    return columns | {"cost": arrays["cost"], "cost_of_optimum": arrays["cost_reference"]}
