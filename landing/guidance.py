"""Classical guidance of the landers: a policy's opponents.

    drdv              D'Souza's energy-optimal law, as published: it knows the true gravity
    drdv_estimated    the same with each axis's effectiveness and gravity estimated in flight
    Replanned         the fuel optimum from here on, by IPOPT with the same estimate, every few seconds

A law is `policy(obs (n, obs), t) -> action (n, 3)`, the command over the greatest thrust, with obs as `LanderVectorEnv`
shows it and a decision every 0.2 s. The last two keep something of each flight; t = 0 begins anew.
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
from landing.optimum import Descent, Mesh, Trajectory, energy_optimal_time, solve_from_guess, straight_line

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
    """The acceleration (n, 3) now, gravity's included, that takes r, v (n, 3) to 0 in `seconds` (n,).

    On the way it is linear in time, which has the least integral of its square.
    """
    t = np.maximum(seconds, SOONEST)[:, None]
    return -6 * r / t**2 - 4 * v / t


def drdv(lander: Lander, gravity: np.ndarray) -> Callable:
    """D'Souza's law with the gravity (n, 3) of each flight, and the nominal mass, which it takes for constant.

    As Gaudet, Linares and Furfaro fly it: the time to go is that of the nominal gravity, straight down.
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

PRIOR_EFFECTIVENESS, PRIOR_GRAVITY = 0.5, 0.2  # uncertainty at first, of 1 and of the nominal m/s^2
MODEL_ERROR = 0.003  # m/s^2, of an acceleration
DRIFT = 1e-4  # by which an effectiveness may change in a step; gravity stays
JUMP = 0.1  # m/s^2; where an acceleration is off by more, the effectiveness is as uncertain as at first
LEAST_EFFECTIVENESS = 0.1  # commands are divided by it


class Estimate:
    """What n flights show of their engine and gravity.

    Along each axis, acceleration = effectiveness command / mass + gravity.
    The mass is the nominal one less the propellant that the estimated thrust has burnt. So the effectiveness also holds
    what the mass is off by, which stays the same share.
    Least squares that forget lose the gravity, too, and then split an acceleration wrongly: with a failure at a random
    moment and 0.9 a period, 13 % of 1000 flights of DR/DV did not land softly. Here only the effectiveness may change.
    """

    def __init__(self, lander: Lander, n: int):
        self.lander = lander
        self.fitted = np.ones((n, 3))  # effectiveness, before it is kept above `LEAST_EFFECTIVENESS`
        self.gravity = np.tile([0.0, 0.0, -lander.gravity], (n, 1))
        self.mass = np.full(n, lander.mass)
        self.covariance = np.tile([PRIOR_EFFECTIVENESS**2, 0.0, PRIOR_GRAVITY**2], (n, 3, 1))  # (n, 3, 3): ee, eg, gg
        self.v = np.zeros((n, 3))
        self.time = np.zeros(n)

    @property
    def effectiveness(self) -> np.ndarray:
        """Of each axis, (n, 3)."""
        return np.maximum(self.fitted, LEAST_EFFECTIVENESS)

    def command(self, acceleration) -> np.ndarray:
        """The command (n, 3) in N that gives an acceleration (n, 3), gravity's included."""
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
        """A step of least squares: acceleration = fitted push + gravity, each (n, 3), in the flights has_flown (n, 1).

        The textbook's formulas, with phi = (push, 1): K = P phi / (R + phi' P phi), P = P - K phi' P.
        """
        ee, eg, gg = np.moveaxis(self.covariance, 2, 0)
        missing = acceleration - self.fitted * push - self.gravity
        ee = ee + np.where(np.abs(missing) > JUMP, PRIOR_EFFECTIVENESS, DRIFT) ** 2
        e, g = ee * push + eg, eg * push + gg  # P phi
        variance = MODEL_ERROR**2 + push * e + g
        covariance = np.stack([ee - e * e / variance, eg - e * g / variance, gg - g * g / variance], axis=2)
        self.fitted = np.where(has_flown, self.fitted + e / variance * missing, self.fitted)
        self.gravity = np.where(has_flown, self.gravity + g / variance * missing, self.gravity)
        self.covariance = np.where(has_flown[..., None], covariance, self.covariance)


def drdv_estimated(lander: Lander) -> Callable:
    """DR/DV with the estimate of effectiveness, gravity and mass; nothing hidden is told to it."""
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
LAST_REPLAN = 12.0  # s before the planned touchdown; later plans put off what they cannot reach any more
CHANGE = 0.05  # of the estimated effectiveness, at which a flight is replanned at once
HANDOVER = 3.0  # s before the planned touchdown, from when on the energy-optimal law flies
OWN_TIME = 0.5  # s before it, from when on that law also chooses the time to go
RESERVE = 0.95  # share of the greatest thrust that plans use; the rest is for the feedback
WARY_RESERVE = 0.55  # the same while the engine is whole, where a failure may come
WHOLE = 0.85  # effectiveness of an engine that has not failed, at least
PLANNED_LEAST = 1.3  # times the least thrust: below it the engine would hide a failure, which it does not go below
FEEDBACK_TIME = 5.0  # s in which what a flight is off its plan is taken back
PLAN_INTERVALS = 25
DURATIONS = (0.8, 1.2)  # guesses of a first plan's, in units of the energy-optimal time


class Job(NamedTuple):
    """A plan to be solved; it holds all that a process needs."""

    lander: Lander
    descent: Descent
    limits: tuple[float, float]  # N, of the thrust
    guess: Trajectory | None  # what is left of the last plan


def plan_one(job: Job) -> tuple[Trajectory | None, float]:
    """The plan of one flight, None where IPOPT finds none, and its seconds on one core."""
    begin = time.process_time()
    guesses = first_guesses(job) if job.guess is None else [job.guess]
    plan = None
    for guess in guesses:
        mesh = Mesh.stretched(PLAN_INTERVALS, guess.seconds)
        try:
            plan = solve_from_guess(job.lander, job.descent, guess, mesh, limits=job.limits)
            break
        except NoOptimum:
            continue
    return plan, time.process_time() - begin


def first_guesses(job: Job) -> list[Trajectory]:
    """Where IPOPT begins without a last plan."""
    r, v = job.descent.state[None, :3], job.descent.state[None, 3:6]
    energy_optimal = float(energy_optimal_time(r, v, job.lander.gravity)[0])
    return [straight_line(job.lander, job.descent, share * energy_optimal, PLAN_INTERVALS) for share in DURATIONS]


class Replanned:
    """The fuel optimum from here on, solved again and again with the estimate, as a policy.

    A flight is planned at its start, every `REPLAN_EVERY` seconds until `LAST_REPLAN`, and where the estimate of its
    engine changes. A plan has `PLAN_INTERVALS` of held thrust. Between plans its acceleration is flown, with feedback:
    what a flight is off in r and v is taken back by the energy-optimal law, which also flies the last seconds. Where
    IPOPT fails, the last plan is kept; without one DR/DV flies.

    With `is_wary` plans use so little thrust, until a failure is seen, that one can still be survived. The optimum of
    a whole engine falls fast and brakes late: of 79 flights of 200 that a failure struck at a random moment 53 % did
    not land softly. Of the wary ones 1 % did not; they burn 9 % more than the optimum that knows all, the others 1.4 %.

    Solves are shared out to `processes`, which changes only the time. `failed` and `seconds` (one a solve) are counted
    from its making on.
    """

    def __init__(self, lander: Lander, is_wary: bool = False, processes: int = 1):
        self.lander, self.is_wary = lander, is_wary
        self.failed, self.seconds = 0, []
        self.workers = Workers(processes)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.workers.close()

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
        self.ends = np.tile(np.arange(-PLAN_INTERVALS - 1.0, 0.0), (n, 1))  # s, of the plans' intervals; of none, past
        self.thrust = np.zeros((n, PLAN_INTERVALS, 3))  # N, in them
        self.y = np.zeros((n, PLAN_INTERVALS + 1, 7))  # at their ends
        self.planned_with = np.ones((n, 3))  # the effectiveness

    def _due(self, obs, t) -> np.ndarray:
        """The flights that are to be planned now."""
        left = self.ends[:, -1] - obs[:, 6]
        has_changed = (np.abs(self.estimate.effectiveness - self.planned_with) > CHANGE).any(axis=1)
        is_time = t % round(REPLAN_EVERY / PERIOD) == 0
        due = (is_time & (left > LAST_REPLAN)) | (has_changed & (left > HANDOVER)) | (t == 0)
        return np.flatnonzero(due & (obs[:, 2] > 0))

    def _replan(self, obs, flights):
        """New plans for some flights."""
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

    def _job(self, obs, k: int) -> Job:
        """The plan of flight k of obs (obs,), by the estimate and from what is left of the last plan."""
        effectiveness, plan = self.estimate.effectiveness[k], self.plans[k]
        state = np.append(obs[:6], self.estimate.mass[k])
        descent = Descent(state, self.estimate.gravity[k], effectiveness, strike=0.0)
        is_whole = effectiveness.min() > WHOLE
        share = WARY_RESERVE if self.is_wary and is_whole else RESERVE
        limits = PLANNED_LEAST * self.lander.least_thrust, share * self.lander.greatest_thrust
        if plan is None:
            return Job(self.lander, descent, limits, None)
        passed = obs[6] - self.ends[k, 0]
        t = np.linspace(passed, plan.seconds, PLAN_INTERVALS + 1)
        rest = Trajectory(t - passed, plan.thrust_at((t[:-1] + t[1:]) / 2), plan.state_at(t))
        return Job(self.lander, descent, limits, rest)

    def _acceleration(self, r, v, now) -> np.ndarray:
        """The plans' over the period from `now` (n,) s on, gravity's included, with feedback, (n, 3)."""
        flights = np.arange(len(now))
        ends = self.ends[:, 1:-1]
        interval = (ends <= now[:, None]).sum(axis=1)
        begin, length = self.ends[flights, interval], np.diff(self.ends, axis=1)[flights, interval]
        y, y_next = self.y[flights, interval], self.y[flights, interval + 1]
        past = (now - begin)[:, None]
        mean = (y_next[:, 3:6] - y[:, 3:6]) / length[:, None]
        r_planned = y[:, :3] + y[:, 3:6] * past + mean * past**2 / 2
        v_planned = y[:, 3:6] + mean * past
        left = np.minimum(self.ends[:, -1] - now, FEEDBACK_TIME)
        back = energy_optimal_acceleration(r - r_planned, v - v_planned, left)
        middle = (ends <= (now + PERIOD / 2)[:, None]).sum(axis=1)
        thrust = self.thrust[flights, middle]
        return thrust / self.estimate.mass[:, None] + self.estimate.gravity + back
