"""The rewards of a landing, and when a lander has landed. The conditions are published, the rewards are ours."""

from __future__ import annotations

import numpy as np

# "landed": the published code's `landing_rlimit`, `landing_vlimit` and `landing_gslimit`
POSITION_LIMIT = 5.0  # m
SPEED_LIMIT = 2.0  # m/s
SLOPE_LIMIT = 5.0  # fall over run, from the last position that was more than `SLOPE_HEIGHT` higher
SLOPE_HEIGHT = 2.0  # m

# the scales and prices of the reported return; a training may set others
POSITION_SCALE = 0.1  # m
SPEED_SCALE = 0.1  # m/s
FAR = 10.0  # m
FAST = 2.0  # m/s; braking by 1 m/s must pay more than its propellant, which is 2 to 3 kg
FUEL_PRICE = 1.0  # for 100 kg
ALOFT_PRICE = 10.0  # for a flight that ends in the air
SLOPE_PRICE = 2.0
STEEP = 20.0  # a steeper slope pays no more
FLATTEST = 0.05  # a flatter slope costs no more


def has_landed(position_error, speed, slope, is_down):
    """The flights (n,) that have landed by the published conditions, as a mask."""
    return is_down & (position_error < POSITION_LIMIT) & (speed < SPEED_LIMIT) & (slope > SLOPE_LIMIT)


def terminal_reward(position_error, speed, position_scale, speed_scale):
    """-ln(1 + |r| / position_scale) - ln(1 + |v| / speed_scale) - |r| / 10 m - |v| / 2 m/s.

    Each halving of an error pays the same. There are two logarithms, not one of a norm, so the larger error does not
    hide the smaller one. The linear terms outweigh the propellant that a flight saves by giving up a far pad or the
    braking.
    """
    near = np.log1p(position_error / position_scale) + np.log1p(speed / speed_scale)
    return -near - position_error / FAR - speed / FAST


def slope_reward(slope, price):
    """-price ln(20 / slope), at most 0. Each doubling of a flat slope pays the same, well beyond the limit of 5."""
    return -price * np.log(np.maximum(STEEP / np.maximum(slope, FLATTEST), 1.0))
