"""The linear-quadratic optimum for costs by weights: the finite-horizon discrete LQR about the targets."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from phased.problem import Phase, Problem


def linearise(problem: Problem, point=None, phase: Phase | None = None):
    """A (n, n) and B (n, m) of x_{k+1} = A x_k + B u_k + const. for the environment's step.

    They are taken about a point, by default the origin, with the dynamics of a phase, by default the first. They are
    central differences of fourth order, with a step that is a power of two. For a linear problem these are exact up to
    rounding. They also suit dynamics that are not analytic, such as those with np.abs or np.interp.
    """
    n, m = problem.states, problem.controls
    point = np.zeros(n) if point is None else np.asarray(point, dtype=float)
    h = 2.0**-9
    changes = np.hstack([k * h * np.eye(n + m) for k in (-2, -1, 1, 2)])  # (n + m, 4 (n + m)), a change a column
    p = tuple(value[:1] for value in problem.hidden(np.zeros((1, problem.drawn))))
    x = tuple(point[:, None] + changes[:n])
    after, *_ = problem.advance(phase or problem.phases[0], x, problem.as_control(changes[n:]), p, problem.dt)
    far_below, below, above, far_above = np.split(np.array(after), 4, axis=1)
    AB = (8 * (above - below) - (far_above - far_below)) / (12 * h)
    return AB[:, :n], AB[:, n:]


def drift_at(problem: Problem, phase: Phase) -> np.ndarray:
    """What a step without control changes (n,) at a phase's target, which need not be at rest."""
    target = problem.aim_of(phase)
    hidden = problem.hidden(np.zeros((1, problem.drawn)))
    rest, *_ = problem.advance(
        phase, tuple(target[:, None]), problem.as_control(np.zeros((problem.controls, 1))), hidden, problem.dt
    )
    return np.array(rest)[:, 0] - target


def free_ends(problem: Problem):
    """Where a flight of one phase ends without control, and what a control does, by dynamics linearised at its target.

    The numbers that have a target are n' of n. From the state x at step t they miss it by Phi_t (x - x*) + c_t, the
    zero-effort miss of guidance, and a control u held from there on adds G_t u. Returns the target x* (n,), Phi
    (T+1, n', n), c (T+1, n') and G (T+1, n', m).
    """
    (phase,) = problem.phases
    target = problem.aim_of(phase)
    A, B = linearise(problem, target, phase)
    drift = drift_at(problem, phase)
    Phi, c, G = [np.eye(len(A))], [0 * drift], [0 * B]
    for _ in range(phase.steps):
        c.append(Phi[-1] @ drift + c[-1])
        G.append(Phi[-1] @ B + G[-1])
        Phi.append(Phi[-1] @ A)
    aims = [k for k, value in enumerate(problem.targets_of(phase)) if value is not None]
    return target, *(np.array(rows[::-1])[:, aims] for rows in (Phi, c, G))


def next_constraints(problem: Problem):
    """The constraints after a step without control, linear about the target of a problem of one phase.

    From the state x they are a + b (x - x*). An action of 1 in each control moves them by at most `effect`. Returns a
    (k,), b (k, n) and `effect` (k,).
    """
    (phase,) = problem.phases
    n = problem.states
    target = problem.aim_of(phase)
    h = 2.0**-9
    points = target[:, None] + h * np.hstack([np.zeros((n, 1)), -np.eye(n), np.eye(n)])
    control = problem.as_control(np.zeros((problem.controls, 1)))
    hidden = problem.hidden(np.zeros((1, problem.drawn)))
    rows = problem.constraints_at(tuple(points), control, hidden)
    values = np.array([np.broadcast_to(row, 2 * n + 1) for row in rows]).reshape(-1, 2 * n + 1)
    slope = (values[:, n + 1 :] - values[:, 1 : n + 1]) / (2 * h)
    A, B = linearise(problem, target, phase)
    return values[:, 0] + slope @ drift_at(problem, phase), slope @ A, np.abs(slope @ B) @ problem.u_unit


def riccati(problem: Problem):
    """Finite-horizon discrete LQR by the backward Riccati recursion (e.g. Anderson and Moore, Optimal Control, 1990).

    The dynamics are linearised about each phase's target x*, which need not be at rest. With d = x - x* the control is
    u_t = -K_t d_t - k_t, and the cost to go is d'P_t d + 2 p_t'd + const. A state without a target has no weight and
    the target 0. Returns K (T, m, n), k (T, m) and P (T+1, n, n). Raises ValueError if costs are not by weights.
    """
    if not problem.weighted or problem.has_events:
        raise ValueError(f"{problem.env_id} has costs by functions, or events; LQR is for weights and fixed times")
    n, m, T = problem.states, problem.controls, problem.steps
    K = np.empty((T, m, n))
    k = np.empty((T, m))
    P = np.zeros((T + 1, n, n))
    p = np.zeros(n)
    end = T
    next_target = problem.aim_of(problem.phases[-1])
    for phase in reversed(problem.phases):
        target = problem.aim_of(phase)
        A, B = linearise(problem, target, phase)
        drift = drift_at(problem, phase)
        p = p + P[end] @ (target - next_target)  # d is now the distance to this phase's target
        aimed = [value is not None for value in problem.targets_of(phase)]
        P[end] += phase.Qf * np.diag(np.array(aimed, dtype=float))
        R = np.diag(problem.control_weights(phase))
        for t in reversed(range(end - phase.steps, end)):
            weight = R + B.T @ P[t + 1] @ B
            ahead = P[t + 1] @ drift + p
            K[t] = solved(weight, B.T @ P[t + 1] @ A)
            k[t] = solved(weight, B.T @ ahead)
            P[t] = np.diag(problem.state_weights(phase)) + A.T @ P[t + 1] @ (A - B @ K[t])
            p = (A - B @ K[t]).T @ ahead
        end -= phase.steps
        next_target = target
    return K, k, P


def solved(weight: np.ndarray, right: np.ndarray) -> np.ndarray:
    """weight^-1 right, or the least solution where a control neither costs nor changes anything that does."""
    try:
        return np.linalg.solve(weight, right)
    except np.linalg.LinAlgError:
        return np.linalg.pinv(weight) @ right


def lqr(problem: Problem):
    """The gains K (T, n) of u_t = -K_t x_t, and P (T+1, n, n) of the cost to go x'P_t x, for problems with one control.

    They are exact for the double integrator without its bound. For Van der Pol they are those of the linearisation
    about the origin. Raises ValueError for waypoints.
    """
    if problem.waypoints:
        raise ValueError(f"{problem.env_id} has {len(problem.phases)} phases; LQR is for problems with 1")
    K, _, P = riccati(problem)
    return K[:, 0], P


def targets(problem: Problem) -> np.ndarray:
    """The target of each step's phase, (T, n)."""
    points = [problem.aim_of(phase) for phase in problem.phases]
    return np.repeat(points, [phase.steps for phase in problem.phases], axis=0)


def lqr_policy(problem: Problem) -> Callable:
    """The policy for `envs.fly` of LQR about the targets, clipped at the control bounds."""
    K, k, _ = riccati(problem)
    target, (low, high) = targets(problem), problem.u_box
    n = problem.states
    return lambda obs, t: np.clip(-(obs[:, :n] - target[t]) @ K[t].T - k[t], low, high)
