"""The rockets' environment.

Reading order: the batched environment (draws, observations, step, reward), the single environment, one recorded flight.
`flight.py` has the flight within a step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
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
    as_numbers,
    check_options,
    checked,
    numeric,
    refuse_autoreset,
    switch,
)
from common.errors import BadInput, is_finite, refuse_unless
from common.flying import fly_until_ended
from common.registration import say_remarks
from rocket.aim import OBSERVED_TARGET, aim_at
from rocket.dispersion import (
    DISPERSION,
    LARGEST_DISPERSION,
    arc_masses,
    check_drawable,
    draw_bounds,
    draw_names,
    draw_vehicles,
    largest_draw,
    nominal_vehicles,
)
from rocket.failure import FAILURE_DRAW, FAILURE_TIMES, HEALTHY_DRAW, check_failure, failure_scores
from rocket.flight import Fleet, Steps, cut_off, fly_step, steps_at, steps_until, unit_directions
from rocket.missions import PAPER_MISSION, ROCKETS, Mission
from rocket.navigation import LARGEST_SCORE as LARGEST_NOISE_SCORE
from rocket.navigation import OBSERVED, checked_noise, deviations
from rocket.orbits import components, final_elements, local_frame, orbit_vectors, specific_energy, terminal_error
from rocket.rewards import (
    REFERENCE_PITCH,
    TERMINAL_SCALE,
    guidance_reward,
    orbital_reward,
    penalties,
    precision_points,
    terminal_reward,
)
from rocket.targets import ELEMENTS, own_target
from rocket.vehicle import Rocket, delta_v

ACTION_FRAMES = ("eci", "local")
ALWAYS_SEEN = 9  # numbers: r, v, m, t_norm and phi


@dataclass(frozen=True)
class RocketTraining(Training):
    """What a training of a rocket hands over. The defaults are the reported reward and the environment's failures."""

    # scale of R_terminal in the reward, a curriculum; `final_info` keeps TERMINAL_SCALE
    terminal_scale: float = numeric(TERMINAL_SCALE, low=1e-12)
    guidance: bool = switch()  # pay R_guidance
    # reward lost per `mass_unit` of propellant burnt in the last phase; our script pays `mass_rewards` instead
    propellant_price: float = numeric(0.0)
    # of the draws of each number of a target, the share that lies at the ends of its range
    target_ends: float = numeric(0.0, high=0.9)
    # "ignition" for a while where the environment's `failure_time` is "random" (None: the environment's)
    failure_time: str | None = checked(
        None,
        lambda value: value is None or (isinstance(value, str) and value in FAILURE_TIMES),
        f"must be None or one of {', '.join(FAILURE_TIMES)}",
    )


class RocketVectorEnv(BatchedEnv):
    """N launches of a mission's rocket into its orbit, steered by the thrust direction, in steps of 2 s.

    Observation: [r (3) m, v (3) m/s, m kg, t_norm, phi], r and v in ECI. t_norm, the paper's name, is the time that is
    left, 1 - t / rocket.end_time (961 s). phi is the phase at the step's start, from 0 to 1 (the paper counts 0 to 3).
    A burn is a phase.

    Action: the thrust direction, of any length but 0, which raises BadInput. It is normalised here and held in ECI over
    the step. With `action_frame="local"` its components are up, along-track and cross-track of the target plane, at the
    step's start.

    A step is one RK4 step between two events. Events are staging, a stage that runs dry (`table_isp`), the strike
    of a failure and the end of the episode. They are met exactly.

    With `dispersion` D > 0 flights differ. Each group of `flights_per_start` episodes draws k standard scores in the
    order of `draw_names`, clipped at +-3 (`draw_bounds`). It flies the vehicle of `draw_vehicles`, which differs from
    the nominal one by D times `DISPERSION`. Each flight has its own events and phases. The observed mass is the flight
    computer's, which follows the nominal schedule from the last staging on. `observe_mass` shows the true mass.
    `observe_draw` adds the scores behind the nine numbers. `reset(options={"draw": z})` gives the scores z (N, k), also
    beyond 3. It raises BadInput for a vehicle that cannot be.

    With `failure` K > 0, for missions with cut-off, half of the episodes have a hidden loss of thrust (`failure.py`).
    One group of engines loses a share of thrust and flow. The share is uniform from 0 to K, and the loss begins at a
    uniformly random moment of the group's burn. With `failure_time` "ignition" the last stage loses it from its
    ignition on. A draw then has four more numbers from 0 to 1, which `FAILURE_DRAW` names. A draw of k scores alone is
    a healthy flight's. No observation shows the failure.

    With `navigation_noise` (m, m/s) normal numbers of these standard deviations are added to the observed r and v, new
    ones for each component and step. The state, events, cut-off and rewards stay exact. The noise has its own random
    stream, so the draws are the same without it. `reset(options={"noise": w})` gives the standard scores w (N, T, 6) of
    `episode_steps` + 1 or more observations.

    With a mission that has `targets` each flight, or each group, flies to an orbit of its own: five elements, a in m
    and angles in degrees, drawn from the mission's `Targets`. `reset(options={"target": elements})` gives them, (5,) or
    (N, 5). Eight numbers follow phi in the observation: the unit vectors to the target's perigee and normal to its
    plane, its angular momentum (m^2/s) and eccentricity. Wherever this text says target, it is the flight's own.

    With a `cutoff` mission (ours; the paper fixes the final time) the engine stops when the energy reaches the target's
    in the last phase. The moment is found within the step, to 1e-10, and ends the episode.

    Every flight also ends below altitude 0, which is a crash, and at `end_time` (s, by default the rocket's, which is
    the latest possible). With cut-off and draws the burn-out of the flight's own last stage takes the place of
    `end_time`, so t_norm may end below 0. This holds unless `end_time` is given or is not the last burn's end.

    Reward: the sum of R_orbital, R_trajectory, R_guidance, R_penalties and R_terminal (`rewards.py`). `final_info` has,
    (N,) each unless a shape is given:

    - `final_y` (N, 7), the exact r, v and m
    - `error_norm`, and `error` (N, 6), the terminal error in ECI
    - `a_km e i_deg raan_deg argp_deg final_mass_kg final_time_s`
    - `max_altitude_km`, of the steps' ends
    - the sums of the five parts, `episodic_return`, `points` (`precision_points`) and `crashed`
    - with targets `target` (N, 5)
    - with dispersion or failures `draw` (N, k), and `dry` for a flight that is out of fuel
    - with failures `failure` (N, 3): group of engines, moment (s) and share lost; -1, 0, 0 for a healthy flight

    `reset(options={"training": {...}})` hands over fields of `RocketTraining`.
    """

    metadata = {**BatchedEnv.metadata, **RENDERED}
    training = RocketTraining()
    set_when_made = ("end_time",)
    PARTS = ("R_orbital", "R_trajectory", "R_guidance", "R_penalties", "R_terminal")

    def __init__(
        self,
        num_envs: int = 1,
        mission: Mission = PAPER_MISSION,
        action_frame: str = "eci",
        table_isp: bool = False,
        observe_phase: bool = True,
        render_mode: str | None = None,
        dispersion: float = 0.0,
        observe_draw: bool = False,
        observe_mass: bool = False,
        failure: float = 0.0,
        failure_time: str = "random",
        navigation_noise: tuple[float, float] | None = None,
        end_time: float | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    ):
        if action_frame not in ACTION_FRAMES:
            raise ValueError(f"action_frame is {action_frame!r}; it must be one of {', '.join(ACTION_FRAMES)}")
        number = isinstance(dispersion, int | float | np.number) and 0 <= dispersion <= LARGEST_DISPERSION
        refuse_unless(number, "dispersion", dispersion, f"must be a number from 0 to {LARGEST_DISPERSION:.0f}")
        check_failure(failure, failure_time, mission.cutoff)
        one_orbit = "must be 0 where flights have targets of their own"
        refuse_unless(not failure or mission.targets is None, "failure", failure, one_orbit)
        self.mission = flown_mission(mission, table_isp=table_isp)
        self.has_draws = bool(dispersion or failure)  # whether flights differ from the table and from one another
        if self.has_draws:
            check_drawable(self.mission.rocket)
        self.rocket, self.cutoff, self.targets = self.mission.rocket, mission.cutoff, mission.targets
        self._last_phase = len(self.rocket.burns) - 1
        self._coasts = np.array([burn.is_coast for burn in self.rocket.burns])  # by phase
        self._has_coasts = bool(self._coasts.any())
        self.action_frame, self.observe_phase = action_frame, observe_phase
        self.dispersion = dispersion
        self.observe_draw = observe_draw
        self.observe_mass = observe_mass
        self.failure, self.failure_time = failure, failure_time
        self.navigation_noise = checked_noise(navigation_noise)
        self._noise = np.zeros((num_envs, 0, OBSERVED))  # standard scores of the running episodes' observations
        self._noise_stream: tuple | None = None  # the seeded generator, and the noise's own
        latest = self.rocket.end_time
        self.end_time = latest if end_time is None else end_time
        possible = is_finite(self.end_time) and 0 < self.end_time <= latest
        refuse_unless(possible, "end_time", f"{end_time} s", f"must be positive and at most {latest}")
        super().__init__(num_envs, 1, *self._spaces(), render_mode, autoreset_mode)
        self._build()
        self._make_clock()
        self.target = np.zeros((num_envs, 0))  # (N, 5) where flights have their own
        if self.targets is not None:
            self.target = np.repeat(own_target(self.rocket)[None], num_envs, axis=0)
        self._set_aim()
        self.y = np.repeat(self.rocket.x0[:, None], num_envs, axis=1)  # (7, N)
        self.u = np.zeros((3, num_envs))  # the direction of the step before, in ECI
        self._parts = np.zeros((len(self.PARTS), num_envs))
        self._distance, self.time, self._max_altitude = np.zeros((3, num_envs))
        self._crashed = np.zeros(num_envs, dtype=bool)
        self._coasted = np.zeros(num_envs, dtype=bool)  # in the step before
        self._everyone = np.arange(num_envs)

    def _set_aim(self):
        """Set what flights are compared with, by their targets."""
        self._aim = aim_at(self.rocket, None if self.targets is None else self.target)

    def _build(self):
        """Make the vehicles, which are all nominal until an episode draws its own."""
        self._scores_drawn = len(draw_names(self.rocket))
        self.draw = np.zeros((self.num_envs, self._scores_drawn))
        self.vehicles = nominal_vehicles(self.rocket, self.num_envs)
        if not self.has_draws:
            return
        # the flight computer's nominal mass (kg) at each burn's beginning, and each burn's flow (kg/s)
        nominal = draw_vehicles(self.rocket, self.dispersion, self.draw)
        self._seen_mass = arc_masses(nominal)
        self._seen_flow = nominal.flow[:-1, 0]
        if self.failure:
            self.draw = np.hstack([self.draw, np.tile(HEALTHY_DRAW, (self.num_envs, 1))])
        self.vehicles = self._drawn(self.draw)

    def _drawn(self, draw):
        """The vehicles of draws (n, k)."""
        return draw_vehicles(self.rocket, self.dispersion, draw, self.failure, self.setting("failure_time"))

    def _spaces(self):
        """The spaces of one environment. Their bounds hold every vehicle that may be drawn."""
        self._draw_bounds = draw_bounds(self.rocket, self.dispersion)
        self._largest = nominal_vehicles(self.rocket, 1)
        if self.has_draws:
            failure_time = self.failure_time if self.failure else ""
            self._largest = self._drawn(largest_draw(self.rocket, self.dispersion, failure_time))
        latest = self.rocket.end_time
        if self.has_draws:
            latest = max(self._largest.burn_out.max(), latest)
        r_max, v_max = reachable(self.rocket, self.dispersion, latest)
        self._largest_momentum = r_max * v_max
        target = [] if self.targets is None else [*[1.0] * 6, self._largest_momentum, 1.0]
        scores = self._draw_bounds if self.observe_draw else []
        high = np.array([*[r_max] * 3, *[v_max] * 3, self._largest.mass[0], 1.0, 1.0, *target, *scores])
        high[:OBSERVED] += LARGEST_NOISE_SCORE * deviations(self.navigation_noise)
        low = -high
        low[6:9] = 0.0, min(0.0, 1 - latest / self.rocket.end_time), 0.0
        if target:
            low[15:17] = 0.0
        return Box(low, high, dtype=np.float64), Box(-1.0, 1.0, (3,), dtype=np.float64)

    def _make_clock(self):
        """Set the number of steps, and make the table of the steps that all flights share without draws."""
        self.episode_steps = int(self._set_ends(self._largest).max())
        # without draws all flights have the same steps, which are worked out once for the one vehicle
        self._table = None
        if not self.has_draws:
            self._table = steps_at(np.arange(self.episode_steps + 1), self._largest, self._latest, self._steps, self.dt)
        self._set_ends(self.vehicles)

    def _set_ends(self, vehicles):
        """Set when the episodes of these vehicles end at the latest. Returns the number of their steps."""
        own = self.has_draws and self.cutoff and self.end_time == self.rocket.end_time == self.rocket.burns[-1].end
        self._latest = vehicles.burn_out if own else np.full(len(vehicles.mass), float(self.end_time))  # s
        self._steps = steps_until(self._latest, self.dt)
        return self._steps

    def _start(self, mask, options):
        taken = ["draw"] * self.has_draws + ["noise"] * bool(self.navigation_noise)
        taken += ["target"] * (self.targets is not None)
        self.refuse_options(
            options, taken, "a rocket has none without targets, dispersion, failure or navigation noise"
        )
        if self.targets is not None:
            self._aim_anew(mask, options.get("target"))
        if self.has_draws:
            self._launch(mask, options.get("draw"))
        if self.navigation_noise:
            self._draw_noise(mask, options.get("noise"))
        self.y[:, mask] = self.rocket.x0[:, None]
        self.y[6, mask] = self.vehicles.mass[mask]
        self._parts[:, mask] = 0.0
        self.u[:, mask] = 0.0
        self._max_altitude[mask] = 0.0
        self.time[mask] = 0.0
        self._distance[mask] = self._progress()[mask]

    def _launch(self, mask, given):
        """Set the vehicles of the environments in `mask`, by the given draws (N, k) or by new ones.

        Each new draw is for `flights_per_start` environments, in the order of those in `mask`.
        """
        if given is None:
            draw = self._draw_starts(self._scores, int(mask.sum()))
        else:
            draw = self._checked_draw(given)[mask]
        drawn = self._drawn(draw)  # before anything is changed, because a draw may be refused
        self.draw[mask] = draw
        for mine, new in zip(self.vehicles, drawn):
            mine[..., mask] = new
        self.episode_steps = max(self.episode_steps, int(self._set_ends(self.vehicles).max()))

    def _aim_anew(self, mask, given):
        """Set the targets of the environments in `mask`, by the given ones (N, 5) or (5,), or by new ones."""
        if given is None:
            targets = self._draw_starts(self._new_targets, int(mask.sum()))
        else:
            targets = self._checked_targets(given)[mask]
        self.target[mask] = targets
        self._set_aim()

    def _new_targets(self, n):
        """New targets (n, 5). Those of groups come in pairs, from opposite ends of the ranges."""
        if self.training.flights_per_start == 1:
            shares = self.np_random.random((n, len(ELEMENTS)))
        else:
            half = self.np_random.random((-(-n // 2), len(ELEMENTS)))
            shares = np.stack([half, 1 - half], axis=1).reshape(-1, len(ELEMENTS))[:n]
        at_ends = self.training.target_ends
        shares = np.clip((shares - at_ends / 2) / (1 - at_ends), 0.0, 1.0)
        return self.mission.ranges.at(shares, self.rocket)

    def _checked_targets(self, given):
        """The targets given to `reset`, one or each flight's own, as (N, 5). Raises BadInput for one that cannot be."""
        shapes = [(len(ELEMENTS),), (self.num_envs, len(ELEMENTS))]
        allowed = f"must hold finite numbers, of shape {' or '.join(map(str, shapes))}: {', '.join(ELEMENTS)}"
        targets = given_numbers("target", given, lambda shape: shape in shapes, allowed)
        targets = np.broadcast_to(targets, shapes[1])
        a, e, i, _, _ = targets.T
        momentum = np.sqrt(np.maximum(self.rocket.mu * a * (1 - e * e), 0.0))
        checks = [
            ("a", (a > 0) & (momentum <= self._largest_momentum), "must be positive, and that of a reachable orbit"),
            ("e", (e >= 0) & (e < 1), "must be at least 0 and below 1, a closed orbit"),
            ("a", a * (1 - e) > self.rocket.Re, f"must have its perigee above the ground, {self.rocket.Re} m"),
            ("i", (i >= 0) & (i <= 180), "must be between 0 and 180 degrees"),
        ]
        for name, possible, allowed in checks:
            value = targets[~possible, ELEMENTS.index(name)][:1].sum()
            refuse_unless(possible.all(), f"{name} of options['target']", value, allowed)
        return targets

    @property
    def generators(self) -> dict[str, np.random.Generator]:
        """The streams of random numbers, by name."""
        if not self.navigation_noise:
            return super().generators
        return super().generators | {"navigation": self._noise_generator()}

    def _noise_generator(self) -> np.random.Generator:
        """The noise's own stream. It is a child of the seeded one, which stays as it is."""
        seeded = self.np_random
        if self._noise_stream is None or self._noise_stream[0] is not seeded:
            (child,) = seeded.spawn(1)
            self._noise_stream = seeded, child
        return self._noise_stream[1]

    def _draw_noise(self, mask, given):
        """Set the noise of the whole episodes that begin in `mask`, by the given scores (N, T, 6) or by new ones."""
        observations = self.episode_steps + 1
        missing = observations - self._noise.shape[1]
        if missing > 0:  # flights can be longer than before; those that are running end earlier
            self._noise = np.pad(self._noise, ((0, 0), (0, missing), (0, 0)))
        if given is None:
            self._noise[mask] = self._noise_generator().standard_normal((int(mask.sum()), *self._noise.shape[1:]))
            return
        allowed = f"must hold finite numbers, of shape ({self.num_envs}, T, {OBSERVED}), T at least {observations}"

        def fits(shape):
            return len(shape) == 3 and shape[::2] == (self.num_envs, OBSERVED) and shape[1] >= observations

        noise = given_numbers("noise", given, fits, allowed)
        self._noise[mask, :observations] = noise[mask, :observations]

    def _scores(self, n):
        """New draws (n, k). Draws of groups come in pairs, z and -z, so that the mean of a few is near zero."""
        in_pairs = self.training.flights_per_start > 1
        if in_pairs:
            half = self.np_random.standard_normal((-(-n // 2), self._scores_drawn))
            scores = np.stack([half, -half], axis=1).reshape(-1, self._scores_drawn)[:n]
        else:
            scores = self.np_random.standard_normal((n, self._scores_drawn))
        scores = np.clip(scores, -self._draw_bounds, self._draw_bounds)
        if not self.failure:
            return scores
        return np.hstack([scores, failure_scores(self.np_random, n, in_pairs)])

    def _checked_draw(self, given):
        """The draws given to `reset` (N, k), in float64. Draws without failures get a healthy flight's numbers.

        Raises BadInput for anything else.
        """
        widths = dict.fromkeys([self._scores_drawn, self.draw.shape[1]])
        shapes = [(self.num_envs, width) for width in widths]
        names = [*draw_names(self.rocket), *(FAILURE_DRAW if self.failure else ())]
        allowed = f"must hold finite numbers, of shape {' or '.join(map(str, shapes))}: {', '.join(names)}"
        draw = given_numbers("draw", given, lambda shape: shape in shapes, allowed)
        if not self.failure:
            return draw
        if draw.shape != self.draw.shape:
            return np.hstack([draw, np.tile(HEALTHY_DRAW, (self.num_envs, 1))])
        for name, column in zip(FAILURE_DRAW, draw.T[self._scores_drawn :]):
            outside = column[(column < 0) | (column > 1)]
            refuse_unless(not len(outside), f"{name} of options['draw']", outside[:1].sum(), "must be from 0 to 1")
        return draw

    def _progress(self):
        """The distance L (N,) to the target orbit (see `orbital_reward`)."""
        h, e = orbit_vectors(self.y, self.rocket.mu)
        error = (
            np.concatenate([components(self._aim.momentum_axes, h), components(self._aim.axes, e)]) - self._aim.orbit
        )
        return np.abs(error).sum(axis=0)

    def _observe(self):
        obs = np.empty((self.num_envs, *self.single_observation_space.shape))
        obs[:, :7] = self.y.T
        if self.navigation_noise:
            obs[:, :OBSERVED] += deviations(self.navigation_noise) * self._noise[self._everyone, self.t]
        if self._aim.seen is not None:
            obs[:, ALWAYS_SEEN : ALWAYS_SEEN + OBSERVED_TARGET] = self._aim.seen
        if self.observe_draw:
            obs[:, -self._scores_drawn :] = self.draw[:, : self._scores_drawn]
        if self.has_draws and not self.observe_mass:
            obs[:, 6] = self._computed_mass()
        phi = self.phase / max(self._last_phase, 1)
        obs[:, 7] = (1 - self.time / self.rocket.end_time) * self.observe_phase
        obs[:, 8] = phi * self.observe_phase
        return obs

    @property
    def dt(self) -> float:
        """The step in s."""
        return self.rocket.dt

    @property
    def phase(self) -> np.ndarray:
        """The 0-based phase (N,) in which the running steps begin: a burn is a phase."""
        return self.vehicles.burn[self._running_steps().arc, self._everyone]

    def _running_steps(self) -> Steps:
        """The steps that the environments fly next."""
        if self._table is None:
            return steps_at(self.t, self.vehicles, self._latest, self._steps, self.dt)
        table, t = self._table, self.t
        return Steps(table.begin[t], table.end[t], table.arc[t], self._everyone)

    def _computed_mass(self):
        """The flight computer's mass (N,) in kg. It follows the nominal burn from the last staging on."""
        ends = self.vehicles.burn_end
        burn = (ends[: self._last_phase] <= self.time).sum(axis=0)
        began = np.where(burn > 0, ends[burn - 1, self._everyone], 0.0)
        return np.maximum(self._seen_mass[burn] - self._seen_flow[burn] * (self.time - began), self.rocket.dry_mass)

    def _directions(self, actions):
        """Unit thrust directions in ECI (3, N) of actions (N, 3). Raises BadInput for the first of length zero."""
        has_length = actions.any(axis=1)
        if not has_length.all():
            bad = int(np.argmin(has_length))
            raise BadInput(f"action of env {bad} at step {self.t[bad]} is [0, 0, 0]; a direction must have a length")
        u = unit_directions(actions)
        if self.action_frame == "eci":
            return u
        up, along, cross = local_frame(self.y, self._aim.axes[2])
        return up * u[0] + along * u[1] + cross * u[2]

    def _advance(self, actions):
        t = self.t
        u = self._directions(actions)
        before = self.y
        fleet = Fleet(self.rocket, self.vehicles, bool(self.dispersion))
        steps = self._running_steps()
        duration = steps.end - steps.begin
        phase = self.vehicles.burn[steps.arc, steps.who]
        done = t + 1 == self._steps
        self.y = fly_step(fleet, before, u, steps, duration)
        if self.cutoff:
            energy = specific_energy(self.y, self.rocket.mu)
            reached = (phase == self._last_phase) & (energy >= self._aim.energy)
            if reached.any():
                ends = before[:, reached], self.y[:, reached]
                energy = np.broadcast_to(self._aim.energy, reached.shape)[reached]
                cut = cut_off(fleet, *ends, u[:, reached], steps.of(reached), duration[reached], energy)
                self.y[:, reached], duration[reached] = cut
            done = done | reached
        altitude = np.sqrt((self.y[:3] ** 2).sum(axis=0)) - self.rocket.Re
        self._crashed = altitude < 0
        done = done | self._crashed
        self.time = steps.begin + duration
        self._max_altitude = np.maximum(self._max_altitude, altitude)
        rewards = self._reward(before, u, phase, altitude, done)
        self.u, self.t = u, t + 1
        return rewards, done, self._final_info

    def _reward(self, before, u, phase, altitude, done):
        """Add the five parts of this step to their sums. Returns the reward (N,): their total.

        R_trajectory stays 0 (`rewards.py`). The reward has R_terminal with the training's `terminal_scale`, the sums
        have it with `TERMINAL_SCALE`.
        """
        t = self.t
        distance = self._progress()
        turn = np.sqrt(((u - self.u) ** 2).sum(axis=0)) * (t > 0)
        if self._has_coasts:  # without thrust neither a direction nor the turn away from it counts
            coasts = self._coasts[phase]
            turn = turn * ~(coasts | self._coasted)
            self._coasted = coasts
        burnt = (before[6] - self.y[6]) * (phase == self._last_phase)
        parts = np.zeros_like(self._parts)
        parts[0] = orbital_reward(self._distance, distance)
        if self.training.guidance:
            until = self.mission.guided_until or self.rocket.burns[0].end
            times, angles = REFERENCE_PITCH
            pitch = np.radians(np.interp(self.rocket.dt * t, until * np.array(times), angles, right=np.nan))
            parts[2] = guidance_reward(u, *local_frame(before, self._aim.axes[2])[:2], pitch)
        left = np.minimum(self.y[6] - self.vehicles.dry_mass, self.vehicles.propellant)
        parts[3] = penalties(self.mission, altitude, self.time, turn, burnt, left, self.training.propellant_price)
        self._parts += parts
        if done.any():
            error_norm = np.linalg.norm(self._terminal_error()[done], axis=1)
            self._parts[4, done] += terminal_reward(error_norm)
            parts[4, done] = terminal_reward(error_norm, self.training.terminal_scale)
        self._distance = distance
        return parts.sum(axis=0)

    def _terminal_error(self):
        """`terminal_error` (N, 6) from each flight's target."""
        return terminal_error(self.y.T, self.rocket, self._aim.elements)

    def _final_info(self):
        y = self.y.T
        error = self._terminal_error()
        error_norm = np.sqrt((error * error).sum(axis=1))
        info = {"final_y": y.copy(), "error": error, "error_norm": error_norm, **final_elements(y, self.rocket)}
        info |= {"final_mass_kg": self.y[6].copy(), "final_time_s": self.time.copy(), "crashed": self._crashed.copy()}
        info |= {"max_altitude_km": self._max_altitude / 1e3, "points": precision_points(error_norm)}
        if self.has_draws:
            info |= {"draw": self.draw.copy(), "dry": self.time >= self.vehicles.burn_out - 1e-6}
        if self.targets is not None:
            info["target"] = self.target.copy()
        if self.failure:
            info["failure"] = self.vehicles.failure.T.copy()
        return info | dict(zip(self.PARTS, self._parts.copy())) | {"episodic_return": self._parts.sum(axis=0)}

    def _snapshot(self):
        return self.time.copy(), self.u.T.copy(), self.y.T.copy()

    def _make_sheet(self):
        # only a picture should wait the quarter of a second that Matplotlib takes to load
        from rocket.animation import AscentSheet

        title = "Rocket ascent, nominal stagings marked" if self.has_draws else "Rocket ascent"
        return AscentSheet(self.rocket, title)


def given_numbers(name: str, given, fits: Callable, allowed: str) -> np.ndarray:
    """An option of `reset` in float64. Raises BadInput unless its shape `fits` and all its numbers are finite."""
    numbers = as_numbers(given)
    refuse_unless(fits(numbers.shape), f"options[{name!r}]", f"of shape {numbers.shape}", allowed)
    bad = numbers[~np.isfinite(numbers)]
    refuse_unless(not len(bad), f"an entry of options[{name!r}]", bad[:1].sum(), allowed)
    return numbers


def reachable(rocket: Rocket, dispersion: float, end: float) -> tuple[float, float]:
    """Bounds of |r| (m) and |v| (m/s), as if delta-v and gravity pointed one way until `end` (s).

    With dispersion the bound of the delta-v is that of one stage with the fastest exhaust, the heaviest start and the
    lightest end.
    """
    gain = delta_v(rocket)
    if dispersion:
        draw = largest_draw(rocket, dispersion)
        scores = dict(zip(draw_names(rocket), draw_bounds(rocket, dispersion)))
        heavy = draw_vehicles(rocket, dispersion, draw)
        light = draw_vehicles(rocket, dispersion, -draw)
        engines = [(e.thrust, e.flow(rocket.table_isp)) for burn in rocket.burns for _, e in burn.engines]
        fastest = max((thrust / flow for thrust, flow in engines if flow), default=0.0)
        gain = fastest * (1 + dispersion * DISPERSION.isp * scores["isp_1"])
        gain *= np.log(heavy.mass[0] / light.dry_mass[0])
    v_max = np.linalg.norm(rocket.x0[3:6]) + gain + rocket.mu / rocket.Re**2 * end
    return float(rocket.Re + v_max * end), float(v_max)


class RocketEnv(SingleEnv):
    """One flight of `RocketVectorEnv`."""

    draw = property(lambda self: self.batch.draw, doc="The running episode's draw (1, k); zeros if nothing is drawn.")


def flown_mission(mission: Mission, rocket: Rocket | None = None, table_isp: bool = False) -> Mission:
    """The mission with these options of the environment: another rocket, or the table's Isp."""
    rocket = rocket or mission.rocket
    return replace(mission, rocket=replace(rocket, table_isp=table_isp or rocket.table_isp))


def make_rocket_vector(env_id: str, num_envs: int = 1, rocket: Rocket | None = None, **options) -> RocketVectorEnv:
    """The batched environment of a mission in `ROCKETS`, or of another rocket on it. `gymnasium.make_vec` calls it."""
    check_options(RocketVectorEnv, options, "rocket")
    say_remarks(env_id)
    return RocketVectorEnv(num_envs, flown_mission(ROCKETS[env_id], rocket), **options)


def make_rocket(env_id: str, **options) -> RocketEnv:
    """The single environment of a mission in `ROCKETS`. `gymnasium.make` calls it."""
    refuse_autoreset(options)
    return RocketEnv(make_rocket_vector(env_id, **options))


def fly_rocket(
    env_id: str,
    policy: Callable,
    end_time: float | None = None,
    draw=None,
    noise: Callable | None = None,
    target=None,
    **options,
) -> dict:
    """Fly `policy(obs (1, obs), t) -> action (1, 3)` once, to `end_time` (s) at the latest, and record the flight.

    - draw (k,): the standard scores of the vehicle and its failure, with the options `dispersion` and `failure`
    - noise(T): gives the standard scores (1, T, 6) of the observations, with the option `navigation_noise`; without it
      they are random
    - target (5,): where flights have targets of their own; without it, it is the rocket's own orbit

    Returns t (K+1,) s, u (K, 3) unit directions in ECI, y (K+1, 7) with r, v and m, reward (K,), the sums so far of
    `PARTS` as `parts` (K, 5), and the entries of the last step's `final_info`.
    """
    env: Any = gym.make_vec(env_id, num_envs=1, end_time=end_time, **options)  # a RocketVectorEnv
    given: dict[str, Any] = {} if draw is None else {"draw": [draw]}
    if env.targets is not None:
        given["target"] = own_target(env.rocket) if target is None else target
    if noise is not None and env.navigation_noise:
        given["noise"] = noise(env.episode_steps + 1)
    obs, _ = env.reset(options=given)
    t, y = [0.0], [env.y[:, 0].copy()]
    u, rewards, parts = [], [], []

    def record(step):
        t.append(env.time[0])
        u.append(env.u[:, 0])
        y.append(env.y[:, 0].copy())
        rewards.append(step.reward[0])
        parts.append(env._parts[:, 0].copy())

    final = {key: value[0] for key, value in fly_until_ended(env, policy, obs, record).items()}
    flight = {"t": np.array(t), "u": np.array(u), "y": np.array(y), "reward": np.array(rewards)}
    return {**flight, "parts": np.array(parts), **final}


make_rocket.metadata = RENDERED  # gym.make looks here before there is an environment
