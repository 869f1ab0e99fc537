"""The data of a small problem's page: its table and the policy. pages/plane_physics.js reads them."""

from __future__ import annotations

from typing import Any

import numpy as np

from common.errors import refuse_unless
from exports.page import Page, network
from phased.environment import TRANSITION_STEPS
from phased.problem import Phase, Problem
from phased.task import PhasedTask

DYNAMICS = ("double_integrator", "van_der_pol")  # functions of envs.py that pages/plane_physics.js has, too


def page(task: PhasedTask, metrics: dict, arrays: dict, checkpoint: dict, launch_longitude: float) -> Page:
    """The page of a policy: the phase plane, in which its start is dragged.

    Raises BadInput if the problem is not written in JavaScript, or if the policy has other features.
    """
    problem = task.problem
    f: Any = problem.f or problem.step
    known = f.__module__ == "envs" and f.__name__ in DYNAMICS
    allowed = f"must be one of envs.py's {', '.join(DYNAMICS)}, which are written in JavaScript, too"
    refuse_unless(known, f"the dynamics of {problem.env_id}", f"{f.__module__}.{f.__name__}", allowed)
    allowed = "has more than a page can fly: phases of weights and fixed times, with one dynamics, from a box of starts"
    refuse_unless(is_plain(problem), "the table", problem.env_id, allowed)
    args = checkpoint["args"]
    clocks = 2 if problem.waypoints else 1
    inputs = problem.states * (2 if problem.waypoints else 1) + clocks
    options = {
        "observe_phase": args.get("observe_phase", True),
        "hidden": [] if args.get("observe_velocity", True) else list(problem.hidden_velocities),
    }
    data = {
        "env_id": problem.env_id,
        "problem": constants(problem) | {"options": options},
        "policy": network(checkpoint, inputs),
        "starts": arrays["x"][:, 0].tolist(),
    }
    return Page("plane", f"{problem.env_id}: drag the start", data)


def is_plain(problem: Problem) -> bool:
    """Whether the page's physics has all that the table has."""
    more = [problem.has_events, problem.scores, problem.bounds, problem.x0, problem.u_norm, problem.substeps > 1]
    more += [problem.constraints]
    more += [phase.f is not None or phase.conditions is not None for phase in problem.phases]
    aimed = all(None not in problem.targets_of(phase) for phase in problem.phases)
    return problem.weighted and aimed and problem.controls == 1 and not any(more)


def constants(problem: Problem) -> dict:
    """The table's constants."""
    low, high = problem.u_box[:, 0].tolist()
    f: Any = problem.f
    return {
        "dynamics": f.__name__,
        "dt": problem.dt,
        "steps": problem.steps,
        "u_low": low,
        "u_high": high,
        "u_centre": problem.u_centre[0],
        "u_unit": problem.u_unit[0],
        "x0_max": np.broadcast_to(problem.x0_max, problem.states).tolist(),
        "circles_count": problem.circles_count,
        "transition_steps": TRANSITION_STEPS,
        "phases": [phase_constants(problem, phase) for phase in problem.phases],
    }


def phase_constants(problem: Problem, phase: Phase) -> dict:
    """The constants of one phase."""
    return {
        "steps": phase.steps,
        "target": phase.target,
        "radius": phase.radius if phase.has_circle else None,
        "Q": problem.state_weights(phase),
        "R": problem.control_weights(phase)[0],
        "Qf": phase.Qf,
        "bonus": phase.bonus,
    }
