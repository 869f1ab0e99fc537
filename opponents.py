"""Opponents of a policy on dispersed flights: laws that know the nominal optimum or model, and the bound on the mass.

    replay        the optimum's directions, open loop
    tvlqr         time-varying LQR about the optimum
    replan        open loop through the air, then IPOPT with the nominal model from the measured state, every 20 s
    drawn_optimum the optimum of a flight's own vehicle and air: a bound, not a law

A law is `policy(obs (m, obs), t) -> action (m, 3)`, directions in ECI, as `evaluate.evaluate_dispersed` flies it with
the environment's own `action_frame="eci"`; it sees r, v, the flight computer's mass, time and phase, never the draw.
Reading order: replay, LQR, the program of the rest of an ascent, replanning, the bound. `evaluate.py` flies, compares
and prints them. CasADi is imported only where it solves.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import envs
from envs import Mission, Rocket
from rocket_baselines import rocket_reference

# ---------------------------------------------------------------------------------------------------------------------
# Open loop
# ---------------------------------------------------------------------------------------------------------------------


def replay(env_id: str):
    """The optimum's directions in ECI by time, the last one held where a flight lasts longer."""
    u = rocket_reference(env_id)["u"]
    return lambda obs, t: np.repeat(u[None, min(t, len(u) - 1)], len(obs), axis=0)


# ---------------------------------------------------------------------------------------------------------------------
# Time-varying LQR about the optimum
# ---------------------------------------------------------------------------------------------------------------------

STEERING_WEIGHT = 1e-7  # R: what a radian of steering for a second costs, in squares of the terminal error
LARGEST_TILT = 0.1  # rad that each of the two angles may turn a direction from the optimum's


def turned(u, axes, angles):
    """Directions (m, 3) turned from u (m, 3) towards axes (m, 2, 3), at right angles to it, by angles (m, 2) rad."""
    w = u + (np.tan(angles)[..., None] * axes).sum(axis=-2)
    return w / np.linalg.norm(w, axis=1, keepdims=True)


def normal_axes(u):
    """Two unit vectors at right angles to each direction u (K, 3) and to each other, (K, 2, 3)."""
    smallest = np.eye(3)[np.abs(u).argmin(axis=1)]
    first = np.cross(u, smallest)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(u, first)], axis=1)


def linearise_flight(mission: Mission, flight: dict, axes):
    """A (K, 6, 6) and B (K, 6, 2) of dx_{k+1} = A_k dx_k + B_k da_k along a flight, for the environment's own steps.

    x: r (m) and v (m/s); a: the two angles (rad) towards axes (K, 2, 3). Central differences of the nominal
    environment, events included: all 16 neighbours of a state are one batch. Their differences, 10 m, 0.01 m/s and
    1e-4 rad, are far above rounding, and the terms of third order that they leave below 1e-7.
    """
    h = np.repeat([10.0, 0.01, 1e-4], [3, 3, 2])
    shifts = np.concatenate([np.diag(h), -np.diag(h)])  # (16, 8)
    env = envs.RocketVectorEnv(len(shifts), replace(mission, cutoff=False))
    env.end_time = flight["t"][-1]
    env.reset()
    jacobians = []
    for k, (y, u) in enumerate(zip(flight["y"], flight["u"])):
        env.t[:], env.y = k, y[:, None] + np.pad(shifts[:, :6], ((0, 0), (0, 1))).T
        env.advance(turned(u, axes[k], shifts[:, 6:]))
        ahead, behind = env.y[:6, :8], env.y[:6, 8:]
        jacobians.append((ahead - behind) / (2 * h))
    AB = np.array(jacobians)
    return AB[..., :6], AB[..., 6:]


def cutoff_jacobian(rocket: Rocket, y, rate):
    """Derivative (6, 6) of the terminal error at the cut-off by r, v of a state y (7,) that moves at `rate` (6,).

    The engine stops at the target's energy, whenever that is: dt = -E_x dx / (E_x rate) later than planned. What a
    state is ahead or behind along the trajectory costs nothing, only what it is beside it.
    """
    h = np.repeat([10.0, 0.01], 3)
    states = y[:6] + np.concatenate([np.diag(h), -np.diag(h)])
    differences = lambda f: ((f[:6] - f[6:]) / (2 * h[:, None] if f.ndim > 1 else 2 * h)).T  # noqa: E731
    error = differences(envs.terminal_error(states, rocket))
    energy = differences(envs.specific_energy(states.T, rocket.mu))
    return error @ (np.eye(6) - np.outer(rate, energy) / (energy @ rate))


def lqr_gains(mission: Mission, flight: dict, steering_weight: float = STEERING_WEIGHT):
    """Gains (K, 2, 6) of da_k = -G_k dx_k and the axes (K, 2, 3) of the angles, by the backward Riccati recursion.

    Minimises |terminal error at the cut-off|^2 + sum of R dt |da|^2 for the flight linearised: no weight is put on
    states on the way, which are free. About a heaviest flight every other is a loss of second order that R bounds.
    """
    axes = normal_axes(flight["u"])
    A, B = linearise_flight(mission, flight, axes)
    last, dt = flight["y"][-2:], np.diff(flight["t"])
    C = cutoff_jacobian(mission.rocket, last[1], (last[1] - last[0])[:6] / dt[-1])
    P, gains = C.T @ C, np.empty((len(B), 2, 6))
    for k in reversed(range(len(B))):
        gains[k] = np.linalg.solve(steering_weight * dt[k] * np.eye(2) + B[k].T @ P @ B[k], B[k].T @ P @ A[k])
        P = A[k].T @ P @ (A[k] - B[k] @ gains[k])
        P = (P + P.T) / 2
    return gains, axes


def tvlqr(env_id: str, by_energy: bool = False, steering_weight: float = STEERING_WEIGHT):
    """LQR about the optimum, by time; `by_energy` from the last ignition on by the specific energy instead.

    By time the cut-off is met by holding the last direction and gain from the optimum's end on. By energy, which grows
    all through the last burn, a flight is compared with the optimum's state of its own energy: the last gain then comes
    with the cut-off, whenever that is. R and tilt were chosen on 341 draws of eval seed 1, others than the reported:
    a smaller R than 1e-7 gained nothing by either index, a larger tilt cost accuracy by time (0.1, 0.3, 0.6 rad).
    """
    mission, flight = envs.ROCKETS[env_id], rocket_reference(env_id)
    (gains, axes), y, u = lqr_gains(mission, flight, steering_weight), flight["y"], flight["u"]
    ignition = int(np.searchsorted(flight["t"], mission.rocket.last_ignition))
    energy = np.maximum.accumulate(envs.specific_energy(y[ignition:].T, mission.rocket.mu))
    phi_last = min(len(mission.rocket.burns) - 1, 1)  # as observed in the last burn

    def policy(obs, t):
        place = np.full(len(obs), min(t, len(u) - 1.0))  # along the optimum, in its steps
        if by_energy:
            now = np.interp(envs.specific_energy(obs.T, mission.rocket.mu), energy, np.arange(ignition, len(y)))
            place = np.where(obs[:, 8] >= phi_last, now, place)
        step = np.minimum(place.astype(int), len(u) - 1)
        part, nearest = (place - step)[:, None], np.minimum(np.rint(place).astype(int), len(u) - 1)
        dx = obs[:, :6] - (1 - part) * y[step, :6] - part * y[step + 1, :6]
        angles = -np.einsum("mai,mi->ma", gains[nearest], dx).clip(-LARGEST_TILT, LARGEST_TILT)
        return turned(u[nearest], axes[nearest], angles)

    return policy
