"""Classical guidance of the landers: a policy's opponents.

    drdv              D'Souza's energy-optimal law, as published: it knows the true gravity
    drdv_estimated    the same law with each axis's effectiveness and gravity estimated in flight
    Replanned         the fuel optimum of the rest of the flight, by IPOPT with the same estimate, every few seconds; it
                      ends above the pad, and the last seconds go straight down

A law is a function policy(obs (n, obs), t) -> action (n, 3), the command over the greatest thrust. obs is that of
`LanderVectorEnv`, with a decision every 0.2 s. The last two laws remember something of each flight, and t = 0 begins
new flights.

Reading order: DR/DV, the estimate, replanning. CasADi is imported only where it solves.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from common.errors import NoOptimum
from landing.environment import PERIOD
from landing.lander import Lander
from landing.optimum import Descent, LandingMesh, Trajectory, energy_optimal_time, solve_from_guess, straight_lines

LAWS = {  # what each law has to know
    "drdv": "true gravity; nominal mass",
    "drdv_estimated": "nominal mass, gravity and exhaust velocity",
    "replanned": "nominal mass, gravity and exhaust velocity; IPOPT on board",
    "replanned_wary": "the same, and that a failure may strike at any moment",
}

# ---------------------------------------------------------------------------------------------------------------------
# DR/DV
# ---------------------------------------------------------------------------------------------------------------------

SOONEST = 1e-3  # s; the law divides by the time to go


def energy_optimal_acceleration(r, v, seconds) -> np.ndarray:
    """The acceleration (n, 3) now, with gravity, that takes r and v (n, 3) to 0 in `seconds` (n,).

    It is linear in time on the way. So the integral of its square is the least.
    """
    t = np.maximum(seconds, SOONEST)[:, None]
    return -6 * r / t**2 - 4 * v / t


def arriving_acceleration(r, v, r_end, v_end, seconds) -> np.ndarray:
    """The acceleration (n, 3) now, with gravity, that takes r and v (n, 3) to r_end and v_end (3,) in `seconds` (n, 1).

    It is the energy-optimal one in axes that move with v_end and are at r_end at that time.
    """
    return energy_optimal_acceleration(r - r_end + v_end * seconds, v - v_end, seconds[:, 0])


def drdv_acceleration(lander: Lander, obs) -> np.ndarray:
    """D'Souza's acceleration (n, 3), with gravity, by the time to go of the nominal gravity."""
    r, v = obs[:, :3], obs[:, 3:6]
    return energy_optimal_acceleration(r, v, energy_optimal_time(r, v, lander.gravity))


def drdv(lander: Lander, gravity: np.ndarray) -> Callable:
    """D'Souza's law with the gravity (n, 3) of each flight and the nominal mass, which it takes as constant.

    Gaudet, Linares and Furfaro fly it with the time to go of the nominal gravity, straight down. So do we.
    """

    def policy(obs, t):
        return lander.mass * (drdv_acceleration(lander, obs) - gravity) / lander.greatest_thrust

    return policy


# ---------------------------------------------------------------------------------------------------------------------
# The estimate: each axis's effectiveness and gravity, by recursive least squares
# ---------------------------------------------------------------------------------------------------------------------

PRIOR_EFFECTIVENESS, PRIOR_GRAVITY = 0.5, 0.2  # uncertainty at first: of an effectiveness of 1, of gravity in m/s^2
MODEL_ERROR = 0.003  # m/s^2, standard deviation of an acceleration
DRIFT = 1e-4  # standard deviation by which an effectiveness may change in a step; gravity does not change
JUMP = 0.1  # m/s^2; after a larger error of the acceleration, the effectiveness is as uncertain as at first
LEAST_EFFECTIVENESS = 0.1  # lower bound, because commands are divided by the effectiveness


class Estimate:
    """What n flights show of their engine and gravity.

    Along each axis acceleration = effectiveness command / mass + gravity. The mass is the nominal one minus the
    propellant that the estimated thrust has burnt. So the effectiveness also absorbs the relative error of the mass,
    which stays the same.

    Only the effectiveness may change here. Least squares that forget all old data also lose the gravity, and then split
    an acceleration wrongly. With a forgetting factor of 0.9 a period and failures at random moments, 13 % of 1000
    flights of DR/DV did not land softly.
    """

    def __init__(self, lander: Lander, n: int):
        self.lander = lander
        self.fitted = np.ones((n, 3))  # effectiveness, before its lower bound `LEAST_EFFECTIVENESS`
        self.gravity = np.tile([0.0, 0.0, -lander.gravity], (n, 1))
        self.mass = np.full(n, lander.mass)
        self.covariance = np.tile([PRIOR_EFFECTIVENESS**2, 0.0, PRIOR_GRAVITY**2], (n, 3, 1))  # (n, 3, 3): ee, eg, gg
        self.v = np.zeros((n, 3))
        self.time = np.zeros(n)

    @property
    def effectiveness(self) -> np.ndarray:
        """The effectiveness of each axis, (n, 3)."""
        return np.maximum(self.fitted, LEAST_EFFECTIVENESS)

    def command(self, acceleration) -> np.ndarray:
        """The command (n, 3) in N that gives an acceleration (n, 3), which includes gravity."""
        return self.mass[:, None] * (acceleration - self.gravity) / self.effectiveness

    def update(self, obs):
        """Learn from the change of velocity since the last call, under the command that obs (n, obs) shows."""
        v, now = obs[:, 3:6], obs[:, 6]
        seconds = now - self.time
        has_flown = seconds > 0
        if has_flown.any():
            command = obs[:, 7:10] * self.lander.greatest_thrust
            flow = np.linalg.norm(self.effectiveness * command, axis=1) / self.lander.exhaust
            burnt = flow * seconds
            acceleration = (v - self.v) / np.where(has_flown, seconds, 1.0)[:, None]
            self._fit(command / (self.mass - burnt / 2)[:, None], acceleration, has_flown[:, None])
            self.mass = self.mass - burnt
        self.v, self.time = v.copy(), now.copy()

    def _fit(self, push, acceleration, has_flown):
        """A step of least squares: acceleration = fitted push + gravity, (n, 3) each, in the flights has_flown (n, 1).

        These are the textbook's formulas with phi = (push, 1): K = P phi / (R + phi' P phi), P = P - K phi' P.
        """
        ee, eg, gg = np.moveaxis(self.covariance, 2, 0)
        missing = acceleration - self.fitted * push - self.gravity
        ee = ee + np.where(np.abs(missing) > JUMP, PRIOR_EFFECTIVENESS, DRIFT) ** 2
        e = ee * push + eg  # P phi is (e, g)
        g = eg * push + gg
        variance = MODEL_ERROR**2 + push * e + g
        covariance = np.stack([ee - e * e / variance, eg - e * g / variance, gg - g * g / variance], axis=2)
        self.fitted = np.where(has_flown, self.fitted + e / variance * missing, self.fitted)
        self.gravity = np.where(has_flown, self.gravity + g / variance * missing, self.gravity)
        self.covariance = np.where(has_flown[..., None], covariance, self.covariance)


def drdv_estimated(lander: Lander) -> Callable:
    """DR/DV with the estimate of effectiveness, gravity and mass. It knows nothing that is hidden."""
    estimate = Estimate(lander, 0)

    def policy(obs, t):
        nonlocal estimate
        if t == 0:
            estimate = Estimate(lander, len(obs))
        estimate.update(obs)
        return estimate.command(drdv_acceleration(lander, obs)) / lander.greatest_thrust

    return policy


# ---------------------------------------------------------------------------------------------------------------------
# Replanning
# ---------------------------------------------------------------------------------------------------------------------

REPLAN_EVERY = 5.0  # s
LAST_REPLAN = 12.0  # s before the planned touchdown; later plans postpone a touchdown that they cannot reach any more
CHANGE = 0.05  # change of the estimated effectiveness that is replanned at once
HANDOVER = 3.0  # s before the plan's end, when the energy-optimal law takes over
GATE = np.array([0.0, 0.0, 3.0, 0.0, 0.0, -5.0])  # m and m/s, where plans end, above the pad: the rest is straight down
TOUCH = np.array([0.0, 0.0, -0.8])  # m/s, the velocity at touchdown
SLOWEST = 0.5  # m/s downwards, by which the last seconds are reckoned where a flight has stopped sinking
RESERVE = 0.95  # share of the greatest thrust that plans use; the rest is for the feedback
WARY_RESERVE = 0.55  # the same share while the engine is whole, if a failure may come
WHOLE = 0.85  # the least effectiveness of an engine that has not failed
PLANNED_LEAST = 1.3  # times the least thrust: below it the engine would hide a failure, which it does not go below
FEEDBACK_TIME = 5.0  # s in which what a flight is off its plan is taken back
PLAN_INTERVALS = 25
DURATIONS = (0.8, 1.2)  # guesses of a first plan's, in units of the energy-optimal time


class Replanned:
    """The law that flies the fuel optimum of the rest of the flight, solved again and again with the estimate.

    A flight is planned at its start, every `REPLAN_EVERY` seconds until `LAST_REPLAN`, and when the estimate of its
    engine changes. A plan has `PLAN_INTERVALS` of held thrust and ends at `GATE`. Between plans the plan's acceleration
    is flown with feedback: the energy-optimal law takes back the flight's errors in r and v. The same law flies the
    last seconds to the gate, and then straight down, because a landing has to be steep. If IPOPT fails, the last plan
    is kept. Without any plan DR/DV flies.

    With `is_wary` plans use little thrust until a failure is seen, so that a failure can still be survived. The optimum
    of a whole engine falls fast and brakes late. We flew 200 draws of a seed that docs/landing.md does
    not use, with failures at random moments. A wary flight takes longer, so more of them are struck. The table has the
    share of the struck flights that did not land, and the propellant beyond that of the optimum, which knows all:

                struck   not landed   propellant
        plain   79       58 %         -5 %, because a crash saves it
        wary    97        3 %         +9 %

    `failed` counts the solves without a plan. `seconds` has one number for each solve.
    """

    def __init__(self, lander: Lander, is_wary: bool = False):
        self.lander, self.is_wary = lander, is_wary
        self.failed, self.seconds = 0, []

    def __call__(self, obs, t):
        if t == 0:
            self._begin(len(obs))
        self.estimate.update(obs)
        r, v, now = obs[:, :3], obs[:, 3:6], obs[:, 6]
        flights = self._due(obs, t)
        if len(flights):
            self._replan(obs, flights)
        left = (self.ends[:, -1] - now)[:, None]  # s to the gate
        closing = arriving_acceleration(r, v, GATE[:3], GATE[3:], left)
        acceleration = np.where(left > HANDOVER, self._acceleration(r, v, now), closing)
        sinks = np.maximum(-v[:, 2:], SLOWEST) - TOUCH[2]
        down = arriving_acceleration(r, v, 0.0, TOUCH, 2 * r[:, 2:] / sinks)
        acceleration = np.where(left > PERIOD / 2, acceleration, down)
        is_unplanned = np.array([plan is None for plan in self.plans])
        if is_unplanned.any():
            acceleration[is_unplanned] = drdv_acceleration(self.lander, obs[is_unplanned])
        return self.estimate.command(acceleration) / self.lander.greatest_thrust

    def _begin(self, n: int):
        """Forget all flights; n others begin."""
        self.estimate = Estimate(self.lander, n)
        self.plans: list[Trajectory | None] = [None] * n
        # s, the ends of the plans' intervals; without a plan they lie in the past
        self.ends = np.tile(np.arange(-PLAN_INTERVALS - 1.0, 0.0), (n, 1))
        self.thrust = np.zeros((n, PLAN_INTERVALS, 3))  # N, in the intervals
        self.y = np.zeros((n, PLAN_INTERVALS + 1, 7))  # at the intervals' ends
        self.planned_with = np.ones((n, 3))  # the effectiveness that each plan was made with

    def _due(self, obs, t) -> np.ndarray:
        """The indices of the flights that are to be planned now."""
        left = self.ends[:, -1] - obs[:, 6]
        has_changed = (np.abs(self.estimate.effectiveness - self.planned_with) > CHANGE).any(axis=1)
        is_time = t % round(REPLAN_EVERY / PERIOD) == 0
        due = (is_time & (left > LAST_REPLAN)) | (has_changed & (left > HANDOVER)) | (t == 0)
        return np.flatnonzero(due & (obs[:, 2] > 0))

    def _replan(self, obs, flights):
        """Make new plans for these flights, indices of obs (n, obs)."""
        for k in flights:
            plan, seconds = self._plan(obs[k], k)
            self.seconds.append(seconds)
            self.planned_with[k] = self.estimate.effectiveness[k]
            if plan is None:
                self.failed += 1
                continue
            self.plans[k] = plan
            self.ends[k] = obs[k, 6] + plan.t
            self.thrust[k] = plan.thrust
            self.y[k] = plan.y

    def _plan(self, obs, k: int) -> tuple[Trajectory | None, float]:
        """The plan of flight k at obs (obs,) by the estimate, or None if IPOPT finds none, and the seconds it took.

        The guess is the rest of the last plan.
        """
        effectiveness = self.estimate.effectiveness[k]
        plan = self.plans[k]
        state = np.append(obs[:6], self.estimate.mass[k])
        descent = Descent(state, self.estimate.gravity[k], effectiveness, strike=0.0)
        is_whole = effectiveness.min() > WHOLE
        share = WARY_RESERVE if self.is_wary and is_whole else RESERVE
        limits = PLANNED_LEAST * self.lander.least_thrust, share * self.lander.greatest_thrust
        begin = time.process_time()
        if plan is None:
            guesses = straight_lines(self.lander, descent, DURATIONS, PLAN_INTERVALS)
        else:
            passed = obs[6] - self.ends[k, 0]
            t = np.linspace(passed, plan.seconds, PLAN_INTERVALS + 1)
            guesses = [Trajectory(t - passed, plan.thrust_at((t[:-1] + t[1:]) / 2), plan.state_at(t))]
        for guess in guesses:
            mesh = LandingMesh.stretched(self.lander, PLAN_INTERVALS, guess.seconds)
            with suppress(NoOptimum):
                found = solve_from_guess(self.lander, descent, guess, mesh, limits=limits, target=GATE)
                return found, time.process_time() - begin
        return None, time.process_time() - begin

    def _acceleration(self, r, v, now) -> np.ndarray:
        """The plans' acceleration (n, 3) over the period from `now` (n,) s on, with gravity and feedback."""
        flights = np.arange(len(now))
        ends = self.ends[:, 1:-1]
        interval = (ends <= now[:, None]).sum(axis=1)
        begin = self.ends[flights, interval]
        length = np.diff(self.ends, axis=1)[flights, interval]
        y = self.y[flights, interval]
        y_next = self.y[flights, interval + 1]
        past = (now - begin)[:, None]
        mean = (y_next[:, 3:6] - y[:, 3:6]) / length[:, None]
        r_planned = y[:, :3] + y[:, 3:6] * past + mean * past**2 / 2
        v_planned = y[:, 3:6] + mean * past
        left = np.minimum(self.ends[:, -1] - now, FEEDBACK_TIME)
        back = energy_optimal_acceleration(r - r_planned, v - v_planned, left)
        middle = (ends <= (now + PERIOD / 2)[:, None]).sum(axis=1)
        thrust = self.thrust[flights, middle]
        return thrust / self.estimate.mass[:, None] + self.estimate.gravity + back
