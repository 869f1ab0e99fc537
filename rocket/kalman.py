"""An extended Kalman filter, by whose estimates a guidance law flies when navigation is noisy.

The filter estimates r, v and the excess of the acceleration over the nominal vehicle's. The excess fades with
`CORRELATION`. The process noise renews it, as strongly as the dispersion makes vehicles and air differ. The filter
knows what every law knows: the table, the flight computer's mass, the phase, and the sizes of noise and dispersion. It
does not know the draw.

Source: e.g. Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, ch. 5, 8.
"""

from __future__ import annotations

import numpy as np

from common.integration import rk4
from rocket.dispersion import DISPERSION
from rocket.dynamics import ascent_dynamics
from rocket.missions import ROCKETS
from rocket.navigation import OBSERVED, deviations
from rocket.vehicle import Rocket

STATES = 9  # r (m), v (m/s), the acceleration's excess (m/s^2)
CORRELATION = 300.0  # s; with the LQR by energy better than 30 and 100, on 200 draws of eval seed 1
OF_THRUST = float(np.linalg.norm([DISPERSION.burn_rate, DISPERSION.isp, DISPERSION.propellant, DISPERSION.dry_mass]))


def predicted_covariance(P, F, Q):
    """The covariance (n, k, k) a step later."""
    return F @ P @ np.swapaxes(F, 1, 2) + Q


def corrected(P, R):
    """Gain (n, k, j) and new covariance (n, k, k) when the first j states are observed with the noise R (j, j)."""
    j = len(R)
    gain = np.swapaxes(np.linalg.solve(P[:, :j, :j] + R, P[:, :j]), 1, 2)
    P = P - gain @ P[:, :j]
    return gain, (P + np.swapaxes(P, 1, 2)) / 2


class KalmanFilter:
    """The estimates x (n, 9) of n flights of a rocket, from lift-off on, when r and v are known.

    noise has the standard deviations (m, m/s) of the observations. dispersion is that of the vehicles.
    """

    def __init__(self, rocket: Rocket, noise: tuple[float, float], dispersion: float, n: int):
        self.rocket, self.dispersion = rocket, dispersion
        self.R = np.diag(deviations(noise) ** 2)
        self.thrust = np.array([burn.thrust for burn in rocket.burns])
        self.flow = np.array([burn.flow(rocket.table_isp) for burn in rocket.burns])
        self.x = np.zeros((n, STATES))
        self.P = np.zeros((n, STATES, STATES))
        self.begin(np.ones(n, dtype=bool))

    def begin(self, flights):
        """Put these flights, a mask (n,), to lift-off, when the excess of the thrust is unknown."""
        self.x[flights] = 0.0
        self.x[flights, :OBSERVED] = self.rocket.x0[:OBSERVED]
        sigma = self.dispersion * OF_THRUST * self.thrust[0] / self.rocket.x0[6]
        self.P[flights] = np.diag([0.0] * OBSERVED + [sigma**2] * 3)

    def predict(self, before, now, u):
        """Go a step on. `before` and `now` (n, 9) are the observations around it, u (n, 3) the directions flown."""
        rocket, dt = self.rocket, self.rocket.dt
        u = u / np.linalg.norm(u, axis=1, keepdims=True)
        burn = np.rint(before[:, 8] * max(len(self.thrust) - 1, 1)).astype(int)
        has_staged = before[:, 8] != now[:, 8]
        y = np.column_stack([self.x[:, :OBSERVED], before[:, 6]]).T  # (7, n)
        push = self.thrust[burn] / y[6]  # m/s^2
        differs = self.dispersion * (OF_THRUST * push + self._air(y))

        excess = self.x[:, OBSERVED:].T
        gain = np.vstack([np.zeros_like(excess), excess, np.zeros_like(push)])
        f = lambda x, u: (np.array(ascent_dynamics(x[0], u, rocket)) + gain,)  # noqa: E731
        (y,) = rk4(f, (y,), (*u.T, self.thrust[burn], self.flow[burn]), dt)
        stays = np.where(has_staged, 0.0, np.exp(-dt / CORRELATION))  # of the excess; a new stage has a new one
        self.x = np.column_stack([y[:OBSERVED].T, stays[:, None] * self.x[:, OBSERVED:]])

        one = np.eye(3)
        F = np.tile(np.eye(STATES), (len(u), 1, 1))
        F[:, :3, 3:6] = dt * one
        F[:, :3, 6:] = dt**2 / 2 * one
        F[:, 3:6, 6:] = dt * one
        F[:, 6:, 6:] = stays[:, None, None] * one
        Q = np.zeros_like(self.P)
        Q[:, 6:, 6:] = ((1 - stays**2) * differs**2)[:, None, None] * one
        # a staging is anywhere in its step; these are second moments of what the thrust then adds to r and v
        staged = np.kron([[dt**4 / 20, dt**3 / 8], [dt**3 / 8, dt**2 / 3]], one)
        Q[:, :OBSERVED, :OBSERVED] = ((push * has_staged) ** 2)[:, None, None] * staged
        self.P = predicted_covariance(self.P, F, Q)

    def _air(self, y) -> np.ndarray:
        """Standard deviation (n,) in m/s^2 of the drag in the wind at y (7, n), for dispersion 1."""
        fall = self.rocket.mu * y[:3] / np.linalg.norm(y[:3], axis=0) ** 3
        drag = np.array(ascent_dynamics(y, np.zeros(5), self.rocket)[3:6]) + fall
        part = DISPERSION.drag + 2 * DISPERSION.wind / np.linalg.norm(y[3:6], axis=0)
        return part * np.linalg.norm(drag, axis=0)

    def correct(self, seen):
        """Take in the observed r and v, seen (n, 6)."""
        gain, self.P = corrected(self.P, self.R)
        self.x = self.x + np.einsum("nij,nj->ni", gain, seen - self.x[:, :OBSERVED])


class Filtered:
    """A guidance law that flies by the estimates of a `KalmanFilter`, not by its observations."""

    def __init__(self, law, env_id: str, noise: tuple[float, float], dispersion: float):
        self.law = law
        self.rocket = ROCKETS[env_id].rocket
        self.noise = noise
        self.dispersion = dispersion

    def __call__(self, obs, t):
        if t == 0:
            self.filter = KalmanFilter(self.rocket, self.noise, self.dispersion, len(obs))
        else:
            self.filter.predict(self.before, obs, self.u)
            self.filter.correct(obs[:, :OBSERVED])
            self.filter.begin(obs[:, 7] == 1)  # a flight that has ended is on the ground again
        self.before = obs
        self.u = self.law(np.hstack([self.filter.x[:, :OBSERVED], obs[:, OBSERVED:]]), t)
        return self.u
