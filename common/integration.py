"""The integrator of all environments and of the nonlinear programs that are solved for them, and its events."""

from __future__ import annotations

import numpy as np


def rk4(f, x, u, dt):
    """One classical Runge-Kutta step of x' = f(x, u) with the control held, x a tuple of components.

    The paper's x_{k+1}, "performed using numerical methods such as Runge-Kutta schemes". Exact for the double
    integrator: its solution is quadratic in dt. The components are NumPy arrays, CasADi symbols or torch tensors.
    """
    k1 = f(x, u)
    k2 = f(tuple(xi + 0.5 * dt * ki for xi, ki in zip(x, k1)), u)
    k3 = f(tuple(xi + 0.5 * dt * ki for xi, ki in zip(x, k2)), u)
    k4 = f(tuple(xi + dt * ki for xi, ki in zip(x, k3)), u)
    return tuple(xi + dt / 6 * (a + 2 * (b + c) + d) for xi, a, b, c, d in zip(x, k1, k2, k3, k4))


def exp(x):
    """e^x of an array, a symbol or a torch tensor, whose derivative NumPy's function would lose."""
    return x.exp() if hasattr(x, "exp") else np.exp(x)


ROOT_TOLERANCE = 1e-12  # of the value at the begin


def falling_root(value, begin, end, until, evaluations=14):
    """The times (n,) in (0, until] at which value(h (n,)) falls through 0: there it is 0, to 1e-12 of `begin`.

    begin > 0 >= end: its values at 0 and `until` (n,). A value that is above 0 by rounding alone counts as 0: secants
    from above may come near the root without ever passing it. Regula falsi with the Pegasus change (Dowell and Jarratt,
    1972): where one end of the bracket is replaced twice in a row, the value at the other is made smaller. The number
    of evaluations is the same for all, so that a row does not depend on the rest of the batch.
    """
    low, high = np.zeros_like(begin), until.copy()
    f_low, f_high = begin.copy(), np.minimum(end, -1e-300)
    last = np.zeros(len(begin))  # 1: the last round replaced `high`, -1: `low`
    for _ in range(evaluations):
        h = np.clip(high - f_high * (high - low) / (f_high - f_low), low, high)
        f = value(h)
        below = f <= ROOT_TOLERANCE * begin
        with np.errstate(divide="ignore", invalid="ignore"):  # where it is not used
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
