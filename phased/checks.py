"""Checks of a table. Each slip raises BadInput with one line that names the field, its value and what is allowed."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from common.errors import BadInput, is_finite, refuse_unless

ENV_ID = re.compile(r"[A-Za-z0-9_.-]+-v\d+")
TRIALS = 8  # points at which the table's functions are tried
LARGEST_STEP_ERROR = 0.01  # error of a Runge-Kutta step in `x_scale`; a larger one is far from the dynamics


def check_problem(problem):
    """Refuse a `Problem` that cannot be flown. Sizes and signs are checked first, then its functions are tried."""
    named = isinstance(problem.env_id, str) and ENV_ID.fullmatch(problem.env_id)
    refuse_unless(named, "env_id", repr(problem.env_id), "must be letters, digits, _ . - and a version, as 'Mine-v0'")
    for name in ("f", "step", "constraints", "parameters", "guess"):
        function = getattr(problem, name)
        refuse(problem, callable(function) or function is None, name, function, "must be a function")
    one_of_them = "must be given, or step(x, u), and not both"
    refuse(problem, (problem.f is None) != (problem.step is None), "f", problem.f, one_of_them)
    check_numbers(problem)
    phases = problem.phases
    hint = "must be a tuple of at least one Phase (of one: a comma behind it)"
    refuse(problem, isinstance(phases, tuple) and len(phases) > 0, "phases", phases, hint)
    for k, phase in enumerate(phases, start=1):
        shaped = all(hasattr(phase, name) for name in ("steps", "target", "radius"))
        refuse(problem, shaped, f"phases[{k - 1}]", phase, "must be a Phase")
        check_phase(problem, phase, k)
    if problem.step is not None:
        check_discrete(problem)
    try_functions(problem)


def check_discrete(problem):
    """What a table with `step` cannot have: nothing is integrated, and nothing ends within a step."""
    allowed = "must be 1 with step(x, u), which nothing integrates"
    refuse(problem, problem.substeps == 1, "substeps", problem.substeps, allowed)
    for k, phase in enumerate(problem.phases, start=1):
        for name in ("end", "f"):
            function = getattr(phase, name)
            refuse(problem, function is None, f"{name} of phase {k}", function, "must not be given with step(x, u)")


def refuse(problem, possible, field: str, value, allowed: str):
    """Raise BadInput that also names the table, unless `possible`."""
    refuse_unless(possible, f"{field} of {problem.env_id}", one_line(value), allowed)


def one_line(value) -> str:
    """A value as a message shows it."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:77]}..."


def check_numbers(problem):
    """The numbers of the table beside its phases."""
    n_states = "numbers, one for each state"
    x_max = problem.x_max
    possible = is_tuple_of(positive, x_max) and len(x_max) > 0
    refuse(problem, possible, "x_max", x_max, f"must be a tuple of positive {n_states}")
    n = len(x_max)
    u_max = problem.u_max
    one_or_each = "must be one finite number, or a tuple with one for each control"
    for name in ("u_max", "u_min"):
        value = getattr(problem, name)
        possible = is_finite(value) or is_tuple_of(is_finite, value) or (name == "u_min" and value is None)
        refuse(problem, possible, name, value, one_or_each)
    if problem.u_min is None:
        refuse(problem, all(np.atleast_1d(u_max) > 0), "u_max", u_max, "must be positive if u_min is not given")
    else:
        alike = np.shape(problem.u_min) == np.shape(u_max)
        refuse(problem, alike, "u_min", problem.u_min, f"must have as many numbers as u_max {u_max}")
        refuse(problem, all(np.less(*problem.u_box)), "u_min", problem.u_min, f"must be less than u_max {u_max}")
    check_norm(problem)
    whole(problem, "substeps", problem.substeps, 1)
    whole(problem, "scores", problem.scores, 0)
    noise = problem.noise
    refuse(problem, is_tuple_of(positive, noise), "noise", noise, "must be a tuple of positive numbers")
    refuse(problem, not noise or problem.step is not None, "noise", noise, "needs step(x, u, w)")
    refuse(problem, positive(problem.dt), "dt", problem.dt, "must be a positive number of seconds")
    if problem.u_scale is not None:
        refuse(problem, positive(problem.u_scale), "u_scale", problem.u_scale, "must be a positive number")
    check_starts(problem, n)
    check_rows(problem, n, n_states)


def check_norm(problem):
    """`u_norm`, the least and greatest norm of the control vector."""
    norm = problem.u_norm
    if norm is None:
        return
    possible = is_tuple_of(is_finite, norm, 2) and 0 <= norm[0] < norm[1]
    refuse(problem, possible, "u_norm", norm, "must be a least and a greatest norm, 0 <= least < greatest")
    refuse(problem, problem.controls > 1, "u_norm", norm, "needs a vector: u_max must be a tuple")
    holds = problem.u_min is None and all(high == norm[1] for high in problem.u_max)
    refuse(
        problem, holds, "u_max", problem.u_max, f"must be the greatest norm {norm[1]} in each control, without u_min"
    )


def check_starts(problem, n: int):
    """The box or function of the starts."""
    half, centre = problem.x0_max, problem.x0
    possible = is_weight(half) or is_tuple_of(is_weight, half, n)
    refuse(problem, possible, "x0_max", half, f"must be one number of at least 0, or {n}, one for each state")
    if callable(centre):
        refuse(
            problem, problem.scores > 0, "scores", problem.scores, "must be at least 1 where x0 is a function of them"
        )
        return
    possible = centre is None or is_tuple_of(is_finite, centre, n)
    refuse(problem, possible, "x0", centre, f"must be {n} finite numbers, one for each state, or a function of z")
    edge = np.abs(np.zeros(n) if centre is None else np.array(centre)) + np.array(half)
    beyond = edge > np.array(problem.x_max)
    allowed = f"must hold the starts, which go to {edge.tolist()}"
    refuse(problem, not beyond.any(), "x_max", problem.x_max, allowed)


def check_rows(problem, n: int, n_states: str):
    """The fields with one entry for each state or control."""
    scale = problem.x_scale
    possible = scale is None or is_tuple_of(positive, scale, n)
    refuse(problem, possible, "x_scale", scale, f"must be {n} positive {n_states}")
    for name, count in (("x_names", n), ("u_names", problem.controls)):
        names = getattr(problem, name)
        possible = names is None or is_tuple_of(lambda word: isinstance(word, str), names, count)
        each = "state (x_max" if name == "x_names" else "control (u_max"
        refuse(problem, possible, name, names, f"must be a tuple of words, {count}: one for each {each} has {count})")
    hidden = problem.velocities
    possible = hidden is None or is_tuple_of(lambda k: isinstance(k, int) and 0 <= k < n, hidden)
    refuse(problem, possible, "velocities", hidden, f"must be a tuple of the states' indices, from 0 to {n - 1}")
    bounds = problem.bounds
    if bounds is not None:
        possible = is_tuple_of(is_bound, bounds, n)
        refuse(problem, possible, "bounds", bounds, f"must be {n} pairs (least, greatest) or None, one for each state")
        refuse(
            problem, positive(problem.bound_price), "bound_price", problem.bound_price, "must be positive with bounds"
        )
        low, high = problem.limits
        if not callable(problem.x0):
            centre = np.zeros(n) if problem.x0 is None else np.array(problem.x0)
            half = np.array(problem.x0_max)
            holds = (centre - half >= low).all() and (centre + half <= high).all()
            refuse(problem, holds, "bounds", bounds, f"must hold the starts, {centre.tolist()} +- {problem.x0_max}")


def check_phase(problem, phase, k: int):
    """One phase, the k-th from 1."""
    n, m = problem.states, problem.controls

    def check(possible, name, allowed):
        refuse(problem, possible, f"{name} of phase {k}", getattr(phase, name), allowed)

    whole(problem, f"steps of phase {k}", phase.steps, 1)
    target = phase.target
    possible = target is None or is_tuple_of(is_finite_or_none, target, n)
    check(possible, "target", f"must be {n} numbers or None, one for each state (x_max has {n})")
    beyond = any(value is not None and abs(value) > most for value, most in zip(target or (), problem.x_max))
    check(not beyond, "target", f"must be within x_max {problem.x_max}")
    aimed = sum(value is not None for value in problem.targets_of(phase))
    is_radius = lambda value: isinstance(value, int | float) and value > 0  # noqa: E731
    count = None if callable(phase.conditions) else aimed  # how many conditions there are, a trial tells
    possible = is_radius(phase.radius) or is_tuple_of(is_radius, phase.radius, count)
    check(possible, "radius", f"must be one positive number, or {aimed}, one for each state with a target")
    check(not phase.has_circle or aimed > 0 or phase.conditions is not None, "radius", "needs a target or conditions")
    check(phase.conditions is None or phase.has_circle, "conditions", "need a radius, within which they are met")
    for name, count in (("R", m), ("Q", n)):
        value = getattr(phase, name)
        single = name == "R" and is_weight(value)
        possible = single or (name == "Q" and value is None) or is_tuple_of(is_weight, value, count)
        one = "one number of at least 0, or " if name == "R" else ""
        check(possible, name, f"must be {one}a tuple of {count}, none below 0")
    for name in ("Qf", "bonus"):
        check(is_weight(getattr(phase, name)), name, "must be a number of at least 0")
    check(not phase.bonus or phase.has_circle, "bonus", "needs a radius, within which it is paid")
    for name in ("running", "terminal", "conditions", "end", "f"):
        function = getattr(phase, name)
        check(function is None or callable(function), name, "must be a function")


def try_functions(problem):
    """Call the table's functions at a few points. Refuse wrong sizes, NaN, and what arrays or CasADi cannot take."""
    rng = np.random.default_rng(0)
    draw = problem.draws(rng, TRIALS)
    scores = tuple(read_only(column) for column in problem.scores_of(draw))
    p = ()
    if problem.parameters is not None:
        refuse(problem, problem.scores > 0, "scores", problem.scores, "must be at least 1 where parameters are drawn")
        p = attempt(problem, "parameters", problem.parameters, scores)
        refuse(problem, isinstance(p, tuple), "what parameters returns", p, "must be a tuple")
        p = as_rows(problem, "parameters", p)
    if callable(problem.x0):
        x = attempt(problem, "x0", problem.x0, scores)
        check_size(problem, "x0", x, problem.states)
        x = np.array(as_rows(problem, "x0", x))
    else:
        x = problem.starts_in_box(rng, TRIALS).T
    low, high = problem.u_box
    u = rng.uniform(low, high, (TRIALS, problem.controls)).T
    u[:, 0], u[:, 1] = low, high
    x, u = tuple(read_only(x)), problem.as_control(read_only(u))
    if problem.guess is not None:
        controls = attempt(problem, "guess", problem.guess, x)
        if isinstance(problem.u_max, tuple):
            check_size(problem, "guess", controls, problem.controls, "control")
        as_rows(problem, "guess", controls if isinstance(problem.u_max, tuple) else (controls,))
    for k, phase in enumerate(problem.phases, start=1):
        name = "step" if problem.f is None else "f" if phase.f is None else f"f of phase {k}"
        dynamics: Any = problem.step or phase.f or problem.f
        w = [problem.noise_of(draw, np.zeros(TRIALS, dtype=int))] if problem.noise else []
        check_tuple(problem, name, dynamics, (x, u, *w), p, problem.states)
        if phase.conditions is not None:
            field = f"conditions of phase {k}"
            count = check_tuple(problem, field, phase.conditions, (x,), p, None)
            aimed = sum(value is not None for value in problem.targets_of(phase))
            fits = not isinstance(phase.radius, tuple) or len(phase.radius) == aimed + count
            allowed = f"must be one number, or {aimed + count}: {aimed} for the target and {count} for the conditions"
            refuse(problem, fits, f"radius of phase {k}", phase.radius, allowed)
        for name, arguments in (("running", (x, u)), ("terminal", (x,)), ("end", (x,))):
            function = getattr(phase, name)
            if callable(function):
                field = f"{name} of phase {k}"
                value = attempt(problem, field, problem.with_parameters(function, p), *arguments)
                rows = as_rows(problem, field, (value,))
                check_alone(problem, field, function, arguments, p, rows)
                above = name != "end" or k > 1 or (rows[0] >= 0).all()
                allowed = "must not be below 0 at the starts: the phase ends when it falls through 0"
                refuse_unless(above, f"{field} of {problem.env_id}", f"{np.min(rows[0]):.6g} at a start", allowed)
        if problem.step is None:
            check_step(problem, phase, x, u, p)
    if problem.constraints is not None:
        check_tuple(problem, "constraints", problem.constraints, (x, u), p, None)
        allowed = "must be positive with constraints"
        refuse(problem, positive(problem.constraint_price), "constraint_price", problem.constraint_price, allowed)
    margin = problem.constraint_margin
    refuse(problem, is_weight(margin), "constraint_margin", margin, "must be a number of at least 0")


def check_tuple(problem, field: str, function: Callable, arguments, p, count: int | None) -> int:
    """Raise BadInput unless a function returns a tuple of `count` numbers, any if None, for each flight.

    Returns how many.
    """
    values = attempt(problem, field, problem.with_parameters(function, p), *arguments)
    check_size(problem, field, values, count)
    rows = as_rows(problem, field, values)
    check_alone(problem, field, function, arguments, p, rows)
    return len(rows)


def last_flight(value):
    """The last entry of an array, or of each array of a tuple, as an array of one."""
    return tuple(last_flight(entry) for entry in value) if isinstance(value, tuple) else read_only(value[-1:])


def check_alone(problem, field: str, function: Callable, arguments, p, rows):
    """Raise BadInput unless a function gives the last flight alone the same values as among the others."""
    alone = problem.with_parameters(function, last_flight(p))
    values = attempt(problem, field, alone, *(last_flight(argument) for argument in arguments))
    again = as_rows(problem, field, values if isinstance(values, tuple) else (values,))
    is_alone = all(np.allclose(row[-1], other, rtol=1e-9, atol=1e-12) for row, other in zip(rows, again))
    allowed = "must depend on the flight's own x and u: each of them holds one entry a flight, so index none of them"
    refuse_unless(is_alone, f"what {field} of {problem.env_id} returns", "mixed over the flights, or random", allowed)


def check_step(problem, phase, x, u, p):
    """Raise BadInput if a step is too long for its Runge-Kutta formula, so that two half steps end elsewhere."""
    with np.errstate(all="ignore"):
        whole_step, *_ = problem.advance(phase, x, u, p, problem.dt)
        half, *_ = problem.advance(phase, x, u, p, problem.dt / 2)
        two_halves, *_ = problem.advance(phase, half, u, p, problem.dt / 2)
    size = problem.scale[:, None] + np.abs(np.array(two_halves))
    error = np.max(np.abs(np.array(whole_step) - two_halves) / size)
    allowed = f"is too long: a step misses by {error:.2g} of its state; it needs a smaller dt, or more substeps"
    refuse_unless(error <= LARGEST_STEP_ERROR, f"dt of {problem.env_id}", problem.dt, allowed)


HINTS = (  # a part of an error's message -> its usual cause
    ("truth value", "it decides by a value; it may hold no `if`, `min` or `max` of Python, but NumPy's where, minimum"),
    ("to Python scalars", "`math`'s functions take one number; it must use NumPy's, as np.sin"),
    ("broadcast", "arrays of different shapes meet; a matrix product must be written out by components"),
    ("matmul", "arrays of different shapes meet; a matrix product must be written out by components"),
    ("unpack", "its tuples have other lengths; u is one number where u_max is one, and a tuple where it is a tuple"),
    ("read-only", "it changes its arguments in place; it must return new values"),
)


def attempt(problem, field: str, function: Callable, *arguments):
    """What a function of the table returns. Raises BadInput with the usual cause if it fails."""
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return function(*arguments)
    except Exception as error:  # a user's function can fail in any way
        hint = next((cause for part, cause in HINTS if part in str(error)), None)
        why = hint or f"{type(error).__name__}: {error} ({problem.states} states, {problem.controls} controls)"
        raise BadInput(f"{field} of {problem.env_id} fails: {why}") from error


def check_size(problem, field: str, values, count: int | None, of: str = "state"):
    """Raise BadInput unless a function returned a tuple of `count` values, one for each state or control (`of`).

    With None they may be any number but 0.
    """
    if not isinstance(values, tuple):
        allowed = f"must be a tuple of {count}, one for each {of} (write the components of a matrix product)"
        if count is None:
            allowed = "must be a tuple (of one number: a comma behind it)"
        refuse(problem, False, f"what {field} returns", f"a {type(values).__name__}", allowed)
    fits = len(values) == count or (count is None and len(values) > 0)
    refuse(problem, fits, f"the number of what {field} returns", len(values), f"must be {count or 'at least 1'}")


def as_rows(problem, field: str, values) -> tuple:
    """The values as finite arrays (TRIALS,). Raises BadInput with the field's name for others."""
    rows = []
    for value in values:
        try:
            row = np.broadcast_to(np.asarray(value, dtype=np.float64), TRIALS)
        except (TypeError, ValueError) as error:
            allowed = "must be one number for each flight (a control is a tuple where u_max is one)"
            refuse_unless(False, f"what {field} of {problem.env_id} returns", one_line(value), allowed)
            raise AssertionError from error
        allowed = f"must be finite at the starts: {one_line(row.tolist())}"
        refuse_unless(np.isfinite(row).all(), f"a value of {field} of {problem.env_id}", "NaN or infinite", allowed)
        rows.append(row)
    return tuple(rows)


def read_only(rows: np.ndarray) -> np.ndarray:
    """A copy that cannot be written to."""
    rows = rows.copy()
    rows.setflags(write=False)
    return rows


def whole(problem, name: str, value, least: int):
    """Raise BadInput unless `value` is a whole number of at least `least`."""
    possible = isinstance(value, int | np.integer) and value >= least
    refuse(problem, possible, name, value, f"must be a whole number of at least {least}")


def positive(value) -> bool:
    return is_finite(value) and value > 0


def is_weight(value) -> bool:
    return is_finite(value) and value >= 0


def is_finite_or_none(value) -> bool:
    return value is None or is_finite(value)


def is_tuple_of(kind: Callable, value, count: int | None = None) -> bool:
    """Whether `value` is a tuple of this kind of entries, `count` of them unless that is None."""
    return isinstance(value, tuple) and count in (None, len(value)) and all(kind(entry) for entry in value)


def is_bound(pair) -> bool:
    """Whether `pair` can be an entry of `bounds`."""
    if pair is None:
        return True
    if not is_tuple_of(is_finite_or_none, pair, 2):
        return False
    low, high = pair
    return low is None or high is None or low < high
