"""The parts of the reward. The paper says what each part is for and gives no formula. The formulas are ours.

The paper names five parts. R_trajectory has no weight here: it is always 0, so it has no formula. R_orbital already
pays for every step towards the target.
"""

from __future__ import annotations

import numpy as np

from rocket.missions import Mission
from rocket.vehicle import Rocket


def orbital_reward(distance, next_distance):
    """R_orbital = 10 (L_t - L_{t+1}), where L is the sum of |component| of the terminal error in the target's axes.

    The paper speaks of "exponential shaping". This form is linear. Over an episode it adds up to 10 (L_0 - L_T). So it
    is the objective itself, not a shaping that leaves the best policy unchanged. L is a sum, because a norm hides small
    components behind the largest.
    """
    return 10.0 * (distance - next_distance)


# (times, degrees above the horizon), our guess; times are parts of a mission's `guided_until` (paper's rocket: 150.4 s)
REFERENCE_PITCH = ((0.0, 10 / 150.4, 40 / 150.4, 0.5, 1.0), (90.0, 88.0, 72.0, 55.0, 35.0))
GUIDANCE_WEIGHT = 0.1  # price of a step at a right angle to the reference direction


def guidance_reward(u, up, along, pitch):
    """R_guidance = -0.1 (1 - u . d), where d has the reference pitch above the horizon and lies in the target's plane.

    u, up and along are (3, N). pitch (N,) is in rad at the step's start. It is NaN where there is no guidance.
    """
    cosine = (u * (np.sin(pitch) * up + np.cos(pitch) * along)).sum(axis=0)
    return np.where(np.isnan(pitch), 0.0, -GUIDANCE_WEIGHT * (1 - cosine))


def penalties(mission: Mission, altitude, time, turn, burnt, left, propellant_price):
    """R_penalties = -40 c (2 - t / t_end) - 0.024 o - 0.024 s - 0.001 |u_t - u_{t-1}| - p (b + c l) / mass_unit.

    - c = 1[h < 0] is a crash. It must cost more than the worst miss, and more the earlier it comes. A policy whose
      flights all crash then improves by crashing later.
    - o = clip((h + 5 km - ceiling) / 100 km, 0, 1) is the overshoot.
    - s = clip((floor - h) / 30 km, 0, 1) from `floor_from` on: the flight is too low for its speed.
    - p is the `propellant_price` of `RocketTraining`.
    - b (kg) is the propellant that a step of the last phase burns, l (kg) what a crash leaves of it.

    Altitude h (m) and time t (s) are those of the step's end. t_end (s) is the rocket's end_time. The mission has the
    ceiling, the floor (110 km; 130 km for the paper's rocket at the fixed time), floor_from (300 s) and mass_unit
    (100 kg for the paper's rocket).

    The paper names h > 0, overshoot beyond 250 km and |u_t - u_{t-1}|. The sizes, the margin of 5 km below the ceiling,
    the floor and the price of propellant are ours.
    """
    crash = altitude < 0
    overshoot = np.minimum(np.maximum((altitude - (mission.ceiling - 5e3)) / 100e3, 0.0), 1.0)
    sag = np.minimum(np.maximum((1e3 * mission.floor_km - altitude) / 30e3, 0.0), 1.0) * (time > mission.floor_from)
    mass_unit = mission.mass_unit or 0.06 * mission.rocket.dry_mass
    crashed = -40.0 * crash * (2 - time / mission.rocket.end_time)
    return crashed - 0.024 * (overshoot + sag) - 0.001 * turn - propellant_price * (burnt + crash * left) / mass_unit


TERMINAL_SCALE = 0.005  # the scale of the reported R_terminal


def terminal_reward(error_norm, scale=TERMINAL_SCALE):
    """R_terminal = -2 ln(1 + d / scale) at the episode's end, where d is the norm of the terminal error.

    It replaces the paper's points (`precision_points`) and is steep near the target. It has a norm, where R_orbital has
    a sum. Near the target the largest component matters most. A norm hardly counts the noise in the other components,
    and a sum of absolute values would charge it in full. Errors far below the scale earn almost the same, so a scale
    that shrinks with the policy's noise is a curriculum of training.
    """
    return -2.0 * np.log1p(error_norm / scale)


def mass_rewards(ends, rocket: Rocket, scale, group_size, also_far=False):
    """Rewards (n,) for the mass that flights have left beyond what their misses saved. Ours, only in training.

    `ends` is the `final_info` of n flights, `scale` the scale of their R_terminal. Each `group_size` flights in a row
    have the same start or draw.

    A group's flights that end with ||error|| < 0.05 at the target's energy are compared, if they are at least eight and
    half of the group. A flight that runs dry, or has too much energy before the last burn, gets nothing.

    A low perigee saves propellant (the paper's rocket: 18 t for a unit of ||error||). R_terminal judges the perigee. So
    mass and R_terminal are each regressed linearly on the terminal errors, which have four directions at one energy.
    The residuals of the mass are paid, scaled to the spread of R_terminal's residuals. In kilograms they would fall
    with the noise, and R_terminal, whose spread does not fall, would hide them. While the orbit is off to one side,
    R_terminal is nearly linear in the errors, so its residuals are small, and little is paid. With `also_far` the
    spread is R_terminal's own, so as much is paid there as near the target.
    """
    a = ends["target"][:, 0] if "target" in ends else rocket.a
    cut_off = np.abs(1e3 * ends["a_km"] / a - 1) < 1e-6  # other energies would add a fifth direction
    near = cut_off & (ends["error_norm"] < 0.05)
    paid = np.zeros(len(ends["error"]))
    judged = np.column_stack([ends["final_mass_kg"], terminal_reward(ends["error_norm"], scale)])
    for group in np.arange(len(paid)).reshape(-1, group_size):
        flights = group[near[group]]
        if len(flights) < max(8, group_size // 2):
            continue
        x = ends["error"][flights]
        x = x - x.mean(axis=0)
        y = judged[flights]
        y = y - y.mean(axis=0)
        directions = np.linalg.svd(x, full_matrices=False)[0][:, :4]
        mass, terminal = (y - directions @ (directions.T @ y)).T
        if also_far:
            terminal = y[:, 1]
        paid[flights] = terminal.std() * mass / max(mass.std(), 1e-9)
    return paid


def precision_points(error_norm):
    """2000 1[d < 0.02] + 1600 e^(-d/0.01) + 1600 e^(-d/0.001), with d as in `terminal_reward`. Only reported.

    The paper pays 2000 points "for successful orbital insertion" and "precision bonuses up to 3200 points". It does not
    say what is successful and how the bonuses fall. So 0.02 and the exponentials are ours.
    """
    return 2000.0 * (error_norm < 0.02) + 1600.0 * (np.exp(-error_norm / 0.01) + np.exp(-error_norm / 0.001))
