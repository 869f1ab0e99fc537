"""The landers' environment: N descents in closed form with exact touchdowns."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode

from common.batch import (
    RENDERED,
    BatchedEnv,
    SingleEnv,
    Training,
    check_options,
    checked,
    numeric,
    refuse_autoreset,
    switch,
)
from common.errors import is_finite, refuse_unless
from common.flying import fly_until_ended
from landing.dynamics import Arc
from landing.lander import DRAW, LANDERS, Failure, Flights, Lander, check_failure, draw_flights
from landing.rewards import (
    ALOFT_PRICE,
    FUEL_PRICE,
    POSITION_SCALE,
    SLOPE_HEIGHT,
    SLOPE_PRICE,
    SPEED_SCALE,
    has_landed,
    slope_reward,
    terminal_reward,
)

PERIOD = 0.2  # s; a command is held for one or more periods, and a failure strikes at the begin of a period
MULTIPLE = f"must be a multiple of {PERIOD} s"
PUBLISHED_CHECKS = (0.05, 0.1, 0.15, 0.2)  # s within a period, when the published code looks at the altitude
PUBLISHED_GROWTH = 500.0  # m by which the range may exceed its least value


def is_multiple(seconds) -> bool:
    """Whether `seconds` is one or more periods."""
    return is_finite(seconds) and seconds > 0 and abs(seconds / PERIOD % 1 - 0.5) > 0.5 - 1e-6


SIZES = "must be two numbers of at least 1, the smaller first"


def are_sizes(pair) -> bool:
    """Whether `pair` is None or a least and a greatest size of failures."""
    return pair is None or (len(pair) == 2 and all(map(is_finite, pair)) and 1 <= pair[0] <= pair[1])


@dataclass(frozen=True)
class LanderTraining(Training):
    """What a training of a lander hands over. The defaults are the reported reward, starts and failures."""

    position_scale: float = numeric(POSITION_SCALE, low=1e-12)  # m, scale of the position error in the terminal reward
    speed_scale: float = numeric(SPEED_SCALE, low=1e-12)  # m/s, scale of the speed in it
    sink_rate: float = numeric(0.0)  # m/s, the vertical speed at touchdown that the reward counts as none
    fuel_price: float = numeric(FUEL_PRICE)  # reward lost for 100 kg of propellant
    aloft_price: float = numeric(ALOFT_PRICE)  # reward lost where a flight ends in the air
    slope_price: float = numeric(SLOPE_PRICE)  # weight of `slope_reward`
    slope_height: float = numeric(SLOPE_HEIGHT)  # m, the height from which the slope is counted
    start_spread: float = numeric(1.0)  # factor on the width of the starts along x and y
    edge_starts: bool = switch()  # draw more starts near the edges of their box (`draw_flights`)
    # the least and the greatest size of a failure; None: all have the environment's
    failure_sizes: tuple[float, float] | None = checked(None, are_sizes, SIZES)
    failure_verticals: tuple[float, float] | None = checked(None, are_sizes, SIZES)
    # the environment's argument of the same name, where it is not None
    decision_s: float | None = checked(None, lambda s: s is None or is_multiple(s), MULTIPLE)


class LanderVectorEnv(BatchedEnv):
    """N descents of a `Lander`.

    Action: the thrust vector over `greatest_thrust`. Its norm is clipped to the engine's limits. A zero command gives
    the least thrust straight up. A command is held for `decision_s` seconds, 0.2 or a multiple. A failure multiplies
    each axis by its effectiveness, and the norm is clipped once more.

    Observation: r (m), v (m/s), time (s), and the last clipped command in units of the action (0 at first). Mass,
    gravity and failure are hidden. `observe_velocity=False`, `observe_phase=False` (the time) and
    `observe_command=False` show zeros instead. Two options show more, in this order:

    - `observe_acceleration`: the change of v over the last decision, per second, in m/s^2 (3). At first it is that of a
      free fall under nominal gravity.
    - `observe_draw`: mass over its nominal value, gravity's deviation over its nominal value (3), and the current
      effectiveness of each axis (3)

    A flight ends at the exact moment of touchdown, or after `longest_flight` seconds (by default the lander's). With
    `published_end` it ends as in the published code. That code looks at the altitude every 0.05 s, flies one step
    beyond the longest time, and stops a flight whose range exceeds its least value by 500 m.

    Reward: -`FUEL_PRICE` for 100 kg burnt in the step. The last step adds `terminal_reward`. It also adds
    `slope_reward` on the ground, or -`ALOFT_PRICE` in the air (`rewards.py`). `LanderTraining` may change these prices.

    `final_info`: `episodic_return` (with the prices and scales of `rewards.py`), `position_error` (m), `speed` (m/s),
    `slope`, `down`, `landed`, `fuel_kg` and `final_time` (s), (N,) each, `final_y` (N, 7) and `draw` (N, 13).

    `reset(options={"draw": z})` sets the draws z (N, 13), numbers from 0 to 1 (`lander.DRAW`). `{"x0": x}` sets r and v
    by x (N, 6). `{"training": {...}}` hands over fields of `LanderTraining`. Raises BadInput for anything else.
    """

    metadata = {**BatchedEnv.metadata, **RENDERED}
    training = LanderTraining()
    set_when_made = ("decision_s", "longest_flight")

    def __init__(
        self,
        lander: Lander,
        num_envs: int = 1,
        failure_probability: float | None = None,
        failure_size: float | None = None,
        failure_vertical: float | None = None,
        failure_time: str = "start",
        observe_command: bool = True,
        observe_acceleration: bool = False,
        observe_draw: bool = False,
        observe_velocity: bool = True,
        observe_phase: bool = True,
        decision_s: float = PERIOD,
        longest_flight: float | None = None,
        published_end: bool = False,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    ):
        self.lander = lander
        self.failure_probability = lander.failure_probability if failure_probability is None else failure_probability
        self.failure_size = lander.failure_size if failure_size is None else failure_size
        self.failure_vertical = lander.failure_vertical if failure_vertical is None else failure_vertical
        self.failure_time = failure_time
        check_failure(self.failure_probability, self.failure_size, self.failure_vertical, failure_time)
        self.observe_command = observe_command
        self.observe_acceleration = observe_acceleration
        self.observe_draw = observe_draw
        self.observe_velocity = observe_velocity
        self.observe_phase = observe_phase
        self.published_end = published_end
        self.longest_flight = lander.longest if longest_flight is None else longest_flight
        possible = is_finite(self.longest_flight) and 0 < self.longest_flight <= lander.longest
        allowed = f"must be above 0 and at most the lander's, {lander.longest:g} s"
        refuse_unless(possible, "longest_flight", repr(longest_flight), allowed)
        refuse_unless(is_multiple(decision_s), "decision_s", repr(decision_s), MULTIPLE)
        self.decision_s = decision_s
        self._set_decision()
        action = Box(-1.0, 1.0, (3,), dtype=np.float64)
        super().__init__(num_envs, self.episode_steps, self._observation_space(), action, render_mode, autoreset_mode)
        self.observation_scale = np.array([1000.0] * 3 + [50.0] * 3 + [self.longest_flight] + [1.0] * 3)
        if observe_acceleration:
            self.observation_scale = np.append(self.observation_scale, [lander.gravity] * 3)
        if observe_draw:
            self.observation_scale = np.append(self.observation_scale, np.ones(7))
        self.draw = np.zeros((num_envs, len(DRAW)))
        self.flights = self._drawn(self.draw)
        self.r = self.flights.r.copy()
        self.v = self.flights.v.copy()
        self.mass = self.flights.mass.copy()
        self.u = np.zeros((num_envs, 3))  # N, the clipped command of the step before
        self.acceleration = np.zeros((3, num_envs))  # m/s^2, the mean over the step before
        self.down = np.zeros(num_envs, dtype=bool)
        self._ended = np.zeros(num_envs, dtype=bool)
        self._ticks = np.zeros(num_envs, dtype=np.int64)  # periods flown
        self.time = np.zeros(num_envs)  # s
        self._above = self.r.copy()  # the last position that was more than `slope_height` up
        self._nearest = np.full(num_envs, np.inf)  # m, the least range so far

    @property
    def dt(self) -> float:
        """Seconds between two decisions."""
        return self._hold * PERIOD

    def hand_over(self, training: dict):
        """As in `BatchedEnv`. Another `decision_s` changes the number of steps, too."""
        super().hand_over(training)
        self._set_decision()

    def _set_decision(self):
        """Set the periods between two decisions, and the number of steps."""
        self._hold = round(self.setting("decision_s") / PERIOD)
        self.episode_steps = math.ceil(self.longest_flight / self.dt - 1e-9) + self.published_end

    @property
    def failure(self) -> Failure:
        """Which failures the flights draw. A training may draw their sizes from a range."""
        sizes = self.training.failure_sizes or (self.failure_size, self.failure_size)
        verticals = self.training.failure_verticals or (self.failure_vertical, self.failure_vertical)
        return Failure(self.failure_probability, sizes, verticals, self.failure_time)

    def _drawn(self, draw) -> Flights:
        handed = self.training
        return draw_flights(self.lander, draw, self.failure, handed.start_spread, handed.edge_starts)

    def _observation_space(self):
        """The box that holds every observation."""
        lander = self.lander
        r, v = lander.reach
        high = [r] * 3 + [v] * 3 + [lander.longest + PERIOD] + [1.0] * 3
        low = [-r] * 3 + [-v] * 3 + [0.0] + [-1.0] * 3
        if self.observe_acceleration:
            greatest = lander.greatest_thrust / lander.dry_mass + lander.gravity * (1 + 2 * lander.gravity_spread)
            high += [greatest] * 3
            low += [-greatest] * 3
        if self.observe_draw:
            spread = max(lander.gravity_spread, 1e-3)  # a box must have a width
            high += [1 + max(lander.mass_spread, 1e-3)] + [spread + 1e-9] * 3 + [1.0] * 3
            low += [0.0] + [-spread - 1e-9] * 3 + [0.0] * 3
        return Box(np.array(low), np.array(high), dtype=np.float64)

    def _start(self, mask, options):
        self.refuse_options(options, ["x0", "draw"])
        count = int(mask.sum())
        draw = self._draw_starts(lambda n: self.np_random.random((n, len(DRAW))), count)
        if "draw" in options:
            in_unit = lambda z: (z >= 0) & (z <= 1)  # noqa: E731
            draw = self.rows_of(options, "draw", len(DRAW), in_unit, "from 0 to 1")[mask]
        new = self._drawn(draw)
        if "x0" in options:
            above_ground = lambda x: x[:, 2:3] > 0  # noqa: E731
            x0 = self.rows_of(options, "x0", 6, above_ground, "finite, and above the ground (z > 0)")[mask]
            new = new._replace(r=x0[:, :3].T, v=x0[:, 3:].T)
        for column, drawn in zip(self.flights, new):
            column[..., mask] = drawn
        self.draw[mask] = draw
        self.r[:, mask] = new.r
        self.v[:, mask] = new.v
        self.mass[mask] = new.mass
        self._above[:, mask] = new.r
        self._nearest[mask] = np.inf
        self.u[mask] = 0.0
        self.acceleration[:, mask] = [[0.0], [0.0], [-self.lander.gravity]]
        self.time[mask] = 0
        self._ticks[mask] = 0
        self.down[mask] = False
        self._ended[mask] = False

    def effectiveness(self) -> np.ndarray:
        """The factors (3, N) on the thrust along each axis in this period."""
        has_struck = self._ticks * PERIOD >= self.flights.strike
        return np.where(has_struck, self.flights.failed, 1.0)

    def _observe(self):
        obs = np.empty((self.num_envs, self.single_observation_space.shape[0]))
        obs[:, 0:3] = self.r.T
        obs[:, 3:6] = self.v.T if self.observe_velocity else 0.0
        obs[:, 6] = self.time * self.observe_phase
        obs[:, 7:10] = self.u / self.lander.greatest_thrust if self.observe_command else 0.0
        if self.observe_acceleration:
            obs[:, 10:13] = self.acceleration.T
        if self.observe_draw:
            obs[:, -7] = self.mass / self.lander.mass
            obs[:, -6:-3] = self.flights.gravity.T / self.lander.gravity + [0.0, 0.0, 1.0]
            obs[:, -3:] = self.effectiveness().T
        return obs

    def _advance(self, actions):
        handed = self.training
        greatest = self.lander.greatest_thrust
        mass, v, time = self.mass, self.v, self.time
        command = greatest * limited(actions.T, self.lander.least_thrust / greatest, 1.0)
        self.u[:] = command.T
        for _ in range(self._hold):
            self._fly(command)
        self.t += 1
        self.acceleration = (self.v - v) / np.maximum(self.time - time, 1e-9)  # an ended flight does not move on
        rewards = -handed.fuel_price / 100 * (mass - self.mass)
        if self._ended.any():
            end = np.where(self.down, slope_reward(self.slope(), handed.slope_price), -handed.aloft_price)
            speed_error = np.sqrt(self.v[0] ** 2 + self.v[1] ** 2 + (self.v[2] + handed.sink_rate) ** 2)
            end += terminal_reward(self.position_error(), speed_error, handed.position_scale, handed.speed_scale)
            rewards = rewards + np.where(self._ended, end, 0.0)
        return rewards, self._ended.copy(), self._final_info

    def _fly(self, command):
        """Fly one period in the environments whose flight has not ended."""
        lander = self.lander
        thrust = limited(command * self.effectiveness(), lander.least_thrust, lander.greatest_thrust)
        norm = np.sqrt((thrust * thrust).sum(axis=0))
        arc = Arc(self.r, self.v, self.mass, thrust / norm, norm / lander.exhaust, self.flights.gravity)
        length = PERIOD
        r, v, mass = arc.after(PERIOD, lander)
        if self.published_end:
            touches, when = published_touchdown(arc, lander)
        elif (r[2] < np.maximum(v[2], 0.0) * PERIOD).any():  # a flight is below ground, or may have been in the period
            touches, when = arc.touchdown(PERIOD, (r, v), lander)
        else:
            touches = np.zeros(self.num_envs, dtype=bool)
        if touches.any():
            length = np.where(touches, when, PERIOD)
            r, v, mass = arc.after(length, lander)
        if self._ended.any():
            flies = ~self._ended
            r, v, mass = (np.where(flies, new, old) for new, old in zip((r, v, mass), (self.r, self.v, self.mass)))
            touches &= flies
            length = length * flies
            self._ticks += flies
        else:
            self._ticks += 1
        self.r, self.v, self.mass = r, v, mass
        self.time = self.time + length
        is_high = r[2] > self.training.slope_height
        self._above = np.where(is_high, r, self._above)
        self.down = self.down | touches
        self._ended = self._ended | touches | self._is_over()

    def _is_over(self):
        """The flights (N,) that end without a touchdown, as a mask."""
        elapsed = self._ticks * PERIOD
        if not self.published_end:
            return elapsed >= self.longest_flight - 1e-9
        distance = self.position_error()
        grows = distance - self._nearest > PUBLISHED_GROWTH
        self._nearest = np.minimum(self._nearest, distance)
        return grows | (elapsed > self.longest_flight + 1e-9)

    def position_error(self) -> np.ndarray:
        """The distance (N,) to the pad in m."""
        return np.sqrt((self.r * self.r).sum(axis=0))

    def speed(self) -> np.ndarray:
        """The speed (N,) in m/s."""
        return np.sqrt((self.v * self.v).sum(axis=0))

    def slope(self) -> np.ndarray:
        """Fall over run (N,) from the last sampled position above `slope_height`. From 2 m it is the published one."""
        dx, dy, dz = self._above - self.r
        return dz / np.maximum(np.hypot(dx, dy), 1e-9)

    def _final_info(self):
        position_error = self.position_error()
        speed = self.speed()
        slope = self.slope()
        fuel = self.flights.mass - self.mass
        end = np.where(self.down, slope_reward(slope, SLOPE_PRICE), -ALOFT_PRICE)
        points = terminal_reward(position_error, speed, POSITION_SCALE, SPEED_SCALE)
        return {
            "episodic_return": points + end - FUEL_PRICE / 100 * fuel,
            "position_error": position_error,
            "speed": speed,
            "slope": slope,
            "down": self.down.copy(),
            "landed": has_landed(position_error, speed, slope, self.down),
            "fuel_kg": fuel,
            "final_time": self.time.copy(),
            "final_y": state_of(self),
            "draw": self.draw.copy(),
        }

    def _snapshot(self):
        return self.time.copy(), self.u.copy(), state_of(self)

    def _make_sheet(self):
        # only a picture should wait the quarter of a second that Matplotlib takes to load
        from landing.animation import DescentSheet

        return DescentSheet(self.lander, "Descent")


def limited(vectors, least: float, greatest: float):
    """Vectors (3, n) with their norms clipped to these limits. A zero vector points up.

    Each vector is first divided by its largest component, so that no square overflows.
    """
    size = np.abs(vectors).max(axis=0)
    if size.all():
        direction = vectors / size
    else:
        upward = np.array([[0.0], [0.0], [1.0]])
        direction = np.where(size == 0, upward, vectors / np.where(size == 0, 1.0, size))
    length = np.sqrt((direction * direction).sum(axis=0))
    return direction * (np.minimum(np.maximum(size * length, least), greatest) / length)


def published_touchdown(arc: Arc, lander: Lander):
    """The flights below ground when the published code looks, and the times in s: a mask (n,) and times (n,)."""
    touches = np.zeros(len(arc.mass), dtype=bool)
    when = np.full(len(arc.mass), PERIOD)
    for h in PUBLISHED_CHECKS:
        is_below = arc.after(h, lander)[0][2] < 0
        when[is_below & ~touches] = h
        touches |= is_below
    return touches, when


class LanderEnv(SingleEnv):
    """One flight of `LanderVectorEnv`."""


def make_lander_vector(env_id: str, num_envs: int = 1, **options) -> LanderVectorEnv:
    """The batched environment of a lander in `LANDERS`. `gymnasium.make_vec` calls it."""
    check_options(LanderVectorEnv, options)
    return LanderVectorEnv(LANDERS[env_id], num_envs, **options)


def make_lander(env_id: str, **options) -> LanderEnv:
    """The single environment of a lander in `LANDERS`. `gymnasium.make` calls it."""
    refuse_autoreset(options)
    return LanderEnv(make_lander_vector(env_id, **options))


make_lander.metadata = RENDERED  # gym.make looks here before there is an environment


def fly_lander(env_id: str, policy: Callable, draw: np.ndarray, decision_s: float = PERIOD, **options) -> dict:
    """Fly `policy(obs (n, obs), t) -> action (n, 3)` on draws (n, 13), and record the flights by periods of 0.2 s.

    t counts decisions, one every `decision_s` seconds. A command is held until the next decision.

    Returns u (n, T, 3) in N, the commands before the failure acts, effectiveness (n, T, 3), and y (n, T+1, 7) with r, v
    and m at the periods' ends. These are NaN after a flight's last period. Also returns start (n, 7), gravity (n, 3)
    and the arrays of `final_info`.
    """
    hold = round(decision_s / PERIOD)
    batch: Any = gym.make_vec(env_id, num_envs=len(draw), **options)  # a LanderVectorEnv
    obs, _ = batch.reset(options={"draw": draw})
    start = state_of(batch)
    gravity = batch.flights.gravity.T.copy()
    u, effectiveness, y = [], [], [start]
    command = None

    def held(obs, period):
        nonlocal command
        if period % hold == 0:
            command = policy(obs, period // hold)
        effectiveness.append(batch.effectiveness().T)  # before the period, in which a failure may strike
        return command

    def record(period):
        flew = period.flew[:, None]
        u.append(np.where(flew, batch.u, np.nan))
        effectiveness[-1] = np.where(flew, effectiveness[-1], np.nan)
        y.append(np.where(flew, state_of(batch), np.nan))

    final = fly_until_ended(batch, held, obs, record)
    flown = {"u": u, "effectiveness": effectiveness, "y": y}
    flown = {key: np.stack(rows, axis=1) for key, rows in flown.items()}
    return {**flown, "start": start, "gravity": gravity, **final}


def state_of(batch: LanderVectorEnv) -> np.ndarray:
    """r (m), v (m/s) and m (kg) of all flights, (N, 7)."""
    return np.vstack([batch.r, batch.v, batch.mass]).T
