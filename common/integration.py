"""The integrator of all environments and of their nonlinear programs, and the roots of events."""

from __future__ import annotations

import numpy as np


def rk4(f, x, u, dt):
    """One classical Runge-Kutta step of x' = f(x, u) over dt with a held control. x is a tuple of components.

    It is the paper's x_{k+1}, "performed using numerical methods such as Runge-Kutta schemes". It is exact for the
    double integrator, whose solution is quadratic in dt. Components are NumPy arrays, CasADi symbols or torch tensors.
    """
    k1 = f(x, u)
    k2 = f(tuple(xi + 0.5 * dt * ki for xi, ki in zip(x, k1)), u)
    k3 = f(tuple(xi + 0.5 * dt * ki for xi, ki in zip(x, k2)), u)
    k4 = f(tuple(xi + dt * ki for xi, ki in zip(x, k3)), u)
    return tuple(xi + dt / 6 * (a + 2 * (b + c) + d) for xi, a, b, c, d in zip(x, k1, k2, k3, k4))


def exp(x):
    """e^x of an array, a symbol or a torch tensor. NumPy's function would lose a tensor's derivative."""
    return x.exp() if hasattr(x, "exp") else np.exp(x)


ROOT_TOLERANCE = 1e-12  # relative to the value at the begin
EVALUATIONS = 14


def falling_root(value, begin, end, until):
    """The times (n,) in (0, until] at which value(h (n,)) falls through 0, where it is 0 to 1e-12 of `begin`.

    begin > 0 >= end are the values at 0 and at `until` (n,). A value that is above 0 only by rounding counts as 0,
    because secants from above may come near the root without ever passing it. The method is regula falsi with the
    Pegasus change (Dowell and Jarratt, 1972): if one end of the bracket is replaced twice in a row, the value at the
    other end is made smaller. All rows take the same number of evaluations, so no row depends on the rest of the batch.
    """
    low = np.zeros_like(begin)
    high = until.copy()
    f_low = begin.copy()
    f_high = np.minimum(end, -1e-300)
    last = np.zeros(len(begin))  # 1: the last round replaced `high`, -1: `low`
    for _ in range(EVALUATIONS):
        h = np.clip(high - f_high * (high - low) / (f_high - f_low), low, high)
        f = value(h)
        below = f <= ROOT_TOLERANCE * begin
        with np.errstate(divide="ignore", invalid="ignore"):  # a bad number here is not used below
            lighter_low = f_low * f_high / (f_high + f)
            lighter_high = f_high * f_low / (f_low + f)
        f_low = np.where(below & (last == 1), lighter_low, f_low)
        f_high = np.where(~below & (last == -1), lighter_high, f_high)
        high = np.where(below, h, high)
        f_high = np.where(below, np.minimum(f, -1e-300), f_high)
        low = np.where(below, low, h)
        f_low = np.where(below, f_low, f)
        last = np.where(below, 1, -1)
    return high
