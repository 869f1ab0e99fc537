"""Classical guidance of the landers: a policy's opponents.

    drdv              D'Souza's energy-optimal law, as published: it knows the true gravity
    drdv_estimated    the same law with each axis's effectiveness and gravity estimated in flight
    Replanned         the fuel optimum of the rest of the flight, by IPOPT with the same estimate, every few seconds

A law is a function policy(obs (n, obs), t) -> action (n, 3), the command over the greatest thrust. obs is that of
`LanderVectorEnv`, with a decision every 0.2 s. The last two laws remember something of each flight, and t = 0 begins
new flights.

Reading order: DR/DV, the estimate, replanning. CasADi is imported only where it solves.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from common.errors import NoOptimum
from common.workers import Workers
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


def drdv(lander: Lander, gravity: np.ndarray) -> Callable:
    """D'Souza's law with the gravity (n, 3) of each flight and the nominal mass, which it takes as constant.

    Gaudet, Linares and Furfaro fly it with the time to go of the nominal gravity, straight down. So do we.
    """

    def policy(obs, t):
        r, v = obs[:, :3], obs[:, 3:6]
        seconds = energy_optimal_time(r, v, lander.gravity)
        acceleration = energy_optimal_acceleration(r, v, seconds) - gravity
        return lander.mass * acceleration / lander.greatest_thrust

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
        r, v = obs[:, :3], obs[:, 3:6]
        seconds = energy_optimal_time(r, v, lander.gravity)
        return estimate.command(energy_optimal_acceleration(r, v, seconds)) / lander.greatest_thrust

    return policy


# ---------------------------------------------------------------------------------------------------------------------
# Replanning
# ---------------------------------------------------------------------------------------------------------------------

REPLAN_EVERY = 5.0  # s
LAST_REPLAN = 12.0  # s before the planned touchdown; later plans postpone a touchdown that they cannot reach any more
CHANGE = 0.05  # change of the estimated effectiveness that is replanned at once
HANDOVER = 3.0  # s before the planned touchdown, when the energy-optimal law takes over
OWN_TIME = 0.5  # s before the planned touchdown, when that law begins to choose the time to go
RESERVE = 0.95  # share of the greatest thrust that plans use; the rest is for the feedback
WARY_RESERVE = 0.55  # the same share while the engine is whole, if a failure may come
WHOLE = 0.85  # the least effectiveness of an engine that has not failed
PLANNED_LEAST = 1.3  # times the least thrust: below it the engine would hide a failure, which it does not go below
FEEDBACK_TIME = 5.0  # s in which what a flight is off its plan is taken back
PLAN_INTERVALS = 25
DURATIONS = (0.8, 1.2)  # guesses of a first plan's, in units of the energy-optimal time


class PlanJob(NamedTuple):
    """A plan to be solved; it holds all that a process needs."""

    lander: Lander
    descent: Descent
    limits: tuple[float, float]  # N, least and greatest thrust
    guess: Trajectory | None  # the rest of the last plan


def plan_one(job: PlanJob) -> tuple[Trajectory | None, float]:
    """The plan of one flight, or None if IPOPT finds none, and the seconds that it took on one core."""
    begin = time.process_time()
    if job.guess is None:
        guesses = straight_lines(job.lander, job.descent, DURATIONS, PLAN_INTERVALS)
    else:
        guesses = [job.guess]
    plan = None
    for guess in guesses:
        mesh = LandingMesh.stretched(PLAN_INTERVALS, guess.seconds)
        try:
            plan = solve_from_guess(job.lander, job.descent, guess, mesh, limits=job.limits)
            break
        except NoOptimum:
            continue
    return plan, time.process_time() - begin


class Replanned:
    """The law that flies the fuel optimum of the rest of the flight, solved again and again with the estimate.

    A flight is planned at its start, every `REPLAN_EVERY` seconds until `LAST_REPLAN`, and when the estimate of its
    engine changes. A plan has `PLAN_INTERVALS` of held thrust. Between plans the plan's acceleration is flown with
    feedback: the energy-optimal law takes back the flight's errors in r and v. The same law flies the last seconds. If
    IPOPT fails, the last plan is kept. Without any plan DR/DV flies.

    With `is_wary` plans use little thrust until a failure is seen, so that a failure can still be survived. The optimum
    of a whole engine falls fast and brakes late. We flew 200 draws of a seed that docs/landing.md does
    not use; failures at random moments struck 79. The table has the share of the 79 that did not land softly, and the
    propellant beyond that of the optimum, which knows all:

                not soft   propellant
        plain   53 %       +1.4 %
        wary     1 %       +9 %

    `processes` share the solves, which changes only the time. `failed` counts the solves without a plan. `seconds` has
    one number for each solve.
    """

    def __init__(self, lander: Lander, is_wary: bool = False, processes: int = 1):
        self.lander, self.is_wary = lander, is_wary
        self.failed, self.seconds = 0, []
        self.workers = Workers(processes)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.workers.__exit__(*error)

    def __call__(self, obs, t):
        if t == 0:
            self._begin(len(obs))
        self.estimate.update(obs)
        r, v, now = obs[:, :3], obs[:, 3:6], obs[:, 6]
        flights = self._due(obs, t)
        if len(flights):
            self._replan(obs, flights)
        left = self.ends[:, -1] - now  # s; without a plan below 0
        planned = self._acceleration(r, v, now)
        own = energy_optimal_time(r, v, self.lander.gravity)
        closing = energy_optimal_acceleration(r, v, np.where(left > OWN_TIME, left, own))
        acceleration = np.where((left > HANDOVER)[:, None], planned, closing)
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
        jobs = [self._job(obs[k], k) for k in flights]
        for k, (plan, seconds) in zip(flights, self.workers.map(plan_one, jobs)):
            self.seconds.append(seconds)
            self.planned_with[k] = self.estimate.effectiveness[k]
            if plan is None:
                self.failed += 1
                continue
            self.plans[k] = plan
            self.ends[k] = obs[k, 6] + plan.t
            self.thrust[k] = plan.thrust
            self.y[k] = plan.y

    def _job(self, obs, k: int) -> PlanJob:
        """The job of planning flight k at obs (obs,), by the estimate, with the rest of the last plan as the guess."""
        effectiveness = self.estimate.effectiveness[k]
        plan = self.plans[k]
        state = np.append(obs[:6], self.estimate.mass[k])
        descent = Descent(state, self.estimate.gravity[k], effectiveness, strike=0.0)
        is_whole = effectiveness.min() > WHOLE
        share = WARY_RESERVE if self.is_wary and is_whole else RESERVE
        limits = PLANNED_LEAST * self.lander.least_thrust, share * self.lander.greatest_thrust
        if plan is None:
            return PlanJob(self.lander, descent, limits, None)
        passed = obs[6] - self.ends[k, 0]
        t = np.linspace(passed, plan.seconds, PLAN_INTERVALS + 1)
        rest = Trajectory(t - passed, plan.thrust_at((t[:-1] + t[1:]) / 2), plan.state_at(t))
        return PlanJob(self.lander, descent, limits, rest)

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
