"""The integrator of all environments and of the nonlinear programs that are solved for them."""


def rk4(f, x, u, dt):
    """One classical Runge-Kutta step of x' = f(x, u) with the control held, x a tuple of components.

    The paper's x_{k+1}, "performed using numerical methods such as Runge-Kutta schemes". Exact for the double
    integrator: its solution is quadratic in dt. The components are NumPy arrays or CasADi symbols.
    """
    k1 = f(x, u)
    k2 = f(tuple(xi + 0.5 * dt * ki for xi, ki in zip(x, k1)), u)
    k3 = f(tuple(xi + 0.5 * dt * ki for xi, ki in zip(x, k2)), u)
    k4 = f(tuple(xi + dt * ki for xi, ki in zip(x, k3)), u)
    return tuple(xi + dt / 6 * (a + 2 * (b + c) + d) for xi, a, b, c, d in zip(x, k1, k2, k3, k4))
