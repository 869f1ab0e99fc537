"""The five parts of the reward. The paper says what each is for and gives no formula: these are ours."""

from __future__ import annotations

import numpy as np

from rocket.missions import Mission
from rocket.vehicle import Rocket


def orbital_reward(distance, next_distance):
    """R_orbital = 10 (L_t - L_{t+1}), L the sum of |component| of the terminal error in the target orbit's axes.

    The paper speaks of "exponential shaping"; this is linear. Over an episode it adds up to 10 (L_0 - L_T): it is the
    objective, not a policy-invariant shaping. A sum over components, because a norm hides the small ones behind the
    largest.
    """
    return 10.0 * (distance - next_distance)


def trajectory_reward(energy, next_energy, early, weight):
    """R_trajectory = w (E_{t+1} - E_t) / (1 MJ/kg) where `early`, before the last burn; E the specific energy."""
    return weight * (next_energy - energy) / 1e6 * early


# degrees above the horizon over time, as a part of a mission's `guided_until` (the paper's rocket: 150.4 s); our guess
REFERENCE_PITCH = ((0.0, 10 / 150.4, 40 / 150.4, 0.5, 1.0), (90.0, 88.0, 72.0, 55.0, 35.0))


def guidance_reward(u, up, along, pitch, weight):
    """R_guidance = -w (1 - u . d), d the direction at the reference pitch above the horizon, along the target's plane.

    u, up, along (3, N); pitch (N,) in rad at the step's start, NaN where there is no guidance: by default everywhere.
    """
    cosine = (u * (np.sin(pitch) * up + np.cos(pitch) * along)).sum(axis=0)
    return np.where(np.isnan(pitch), 0.0, -weight * (1 - cosine))


def penalties(mission: Mission, altitude, time, turn, burnt, left, mass_weight):
    """R_penalties = -40 c (2 - t / t_end) - 0.024 o - 0.024 s - 0.001 |u_t - u_{t-1}| - w_m (b + c l) / mass_unit.

    c = 1[h < 0], a crash, which must cost more than the worst miss, and the more the earlier: from a policy whose
    flights all crash the way back leads through later crashes. o = clip((h + 5 km - ceiling) / 100 km, 0, 1),
    overshoot; s = clip((floor - h) / 30 km, 0, 1) from `floor_from` on, too low for its speed; b (kg), the propellant
    that a step of the last phase burns, l, what a crash leaves of it. Altitude h (m), time t (s): the step's end's;
    t_end (s) is the rocket's end_time. Ceiling, floor (110 km, the paper's rocket at the fixed time: 130 km),
    floor_from (300 s) and mass_unit (the paper's rocket: 100 kg) are the mission's.

    The paper names h > 0, overshoot beyond 250 km and |u_t - u_{t-1}|; the sizes, the margin that lets o begin 5 km
    below the ceiling, the floor and the price of propellant are ours.
    """
    crash = altitude < 0
    overshoot = np.minimum(np.maximum((altitude - (mission.ceiling - 5e3)) / 100e3, 0.0), 1.0)
    sag = np.minimum(np.maximum((1e3 * mission.floor_km - altitude) / 30e3, 0.0), 1.0) * (time > mission.floor_from)
    mass_unit = mission.mass_unit or 0.06 * mission.rocket.dry_mass
    crashed = -40.0 * crash * (2 - time / mission.rocket.end_time)
    return crashed - 0.024 * (overshoot + sag) - 0.001 * turn - mass_weight * (burnt + crash * left) / mass_unit


TERMINAL_SCALE = 0.005  # of the reported R_terminal


def terminal_reward(error_norm, scale=TERMINAL_SCALE):
    """R_terminal = -2 ln(1 + d / scale) at the episode's end, d the norm of the terminal error: steep near the target.

    In place of the paper's points (`precision_points`). A norm, unlike R_orbital's sum: near the target the largest
    component is the one to work on, and the noise in the others, which a sum of absolute values charges in full, hardly
    counts. Errors far below the scale earn almost the same, so a scale that shrinks with the policy's noise is a
    curriculum of training.
    """
    return -2.0 * np.log1p(error_norm / scale)


def mass_rewards(ends, rocket: Rocket, scale, group_size):
    """Rewards (n,) of flights for the mass that they have left, apart from what their misses saved; only in training.

    `ends` are n flights' `final_info`, `scale` that of their R_terminal; each `group_size` in a row have the same start
    or draw. Those that end with ||error|| < 0.05 at the target's energy are compared, where they are at least eight and
    half of the group: what runs dry, or has too much energy before the last burn, gets nothing. A low perigee saves
    propellant (the paper's rocket: 18 t a unit of ||error||), which is R_terminal's to judge. So mass and R_terminal
    are each regressed linearly on the terminal errors, which have four directions at one energy. The mass's residuals
    are paid, scaled to the spread of R_terminal's: kilograms would fall with the noise and be hidden by R_terminal,
    whose spread does not. While the orbit is off to one side, R_terminal is nearly linear in the errors, and little is
    paid. Ours.
    """
    cut_off = np.abs(1e3 * ends["a_km"] / rocket.a - 1) < 1e-6  # others would add a fifth direction
    near, paid = cut_off & (ends["error_norm"] < 0.05), np.zeros(len(ends["error"]))
    judged = np.column_stack([ends["final_mass_kg"], terminal_reward(ends["error_norm"], scale)])
    for group in np.arange(len(paid)).reshape(-1, group_size):
        flights = group[near[group]]
        if len(flights) < max(8, group_size // 2):
            continue
        x, y = (values[flights] - values[flights].mean(axis=0) for values in (ends["error"], judged))
        directions = np.linalg.svd(x, full_matrices=False)[0][:, :4]
        mass, terminal = (y - directions @ (directions.T @ y)).T
        paid[flights] = terminal.std() * mass / max(mass.std(), 1e-9)
    return paid


def precision_points(error_norm):
    """2000 1[d < 0.02] + 1600 e^(-d/0.01) + 1600 e^(-d/0.001), d as in `terminal_reward`: reported only.

    The paper pays 2000 points "for successful orbital insertion" and "precision bonuses up to 3200 points"; what is
    successful and how the bonuses fall it does not say: 0.02 and the exponentials are ours.
    """
    return 2000.0 * (error_norm < 0.02) + 1600.0 * (np.exp(-error_norm / 0.01) + np.exp(-error_norm / 0.001))
