"""The environment of the small problems: N copies of a `Problem` with one or several phases."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode

from common.batch import RENDERED, BatchedEnv, SingleEnv, check_options, of_batch, refuse_autoreset
from common.errors import BadInput
from common.integration import rk4
from phased.problem import PROBLEMS, Problem

# the observed target moves to the new waypoint over these first steps of a phase: the paper's number, linearly by ours
TRANSITION_STEPS = 5


class PhasedVectorEnv(BatchedEnv):
    """The double integrator and Van der Pol families: N copies of a `Problem` with one or several phases.

    Observation: the paper's o_t = [x1, x2, x1_target, x2_target, tau, phi] with several phases, [x1, x2, tau] with one
    (ours); tau = t / T, phi the 0-based phase over (phases - 1). The target that is seen moves to a new waypoint over
    the first `TRANSITION_STEPS` of its phase. Action: u, clipped at the control bound.

    Reward: the paper's r_t, -(dx'Q dx + R u^2) with dx the distance to the phase's target before the step; a phase's
    last step adds -Qf |dx|^2 + B 1[|dx| <= r] after it, so that an episode's rewards sum to bonus - J. The paper prints
    r_t for one phase and target 0; that each phase has its own is ours. The end of the horizon is `terminated` (time is
    observed).

    `final_info`: `episodic_return` (with the true radii), `cost`, `cost_state`, `cost_control`, `cost_terminal`, each
    (N,), and `hit` and `terminal_error` (the distance to the target at each phase's end), each (N, phases).

    `observe_phase=False` shows tau and phi as 0, `observe_velocity=False` x2. `reset(options={"x0": (N, 2)})` sets the
    starts.

    Attributes that only training changes, to be set before a `reset`: `radius_scale`, a scalar or one number a phase,
    enlarges the radii in which the *reward* pays the bonus (1 is the paper); `bonus_width`, the distance beyond them
    over which that bonus falls to 0 linearly (0, a step, is the paper); and `flights_per_start` (`BatchedEnv`).
    """

    metadata = {**BatchedEnv.metadata, **RENDERED}

    def __init__(
        self,
        problem: Problem,
        num_envs: int = 1,
        observe_phase: bool = True,
        observe_velocity: bool = True,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    ):
        self.problem, self.observe_phase, self.observe_velocity = problem, observe_phase, observe_velocity
        self.radius_scale, self.bonus_width = 1.0, 0.0
        target_max = np.max([np.abs(phase.target) for phase in problem.phases], axis=0)
        target_max[target_max == 0] = 1.0  # of velocity, where all waypoints are at rest: a box must have a width
        high = np.array([*problem.x_max, *target_max, 1.0, 1.0] if problem.waypoints else [*problem.x_max, 1.0])
        low = -high
        low[-2 if problem.waypoints else -1 :] = 0.0
        u_max = np.array([problem.u_max])
        spaces = Box(low, high, dtype=np.float64), Box(-u_max, u_max, dtype=np.float64)
        super().__init__(num_envs, problem.steps, *spaces, render_mode, autoreset_mode)
        self._tabulate()
        self.x = (np.zeros(num_envs), np.zeros(num_envs))
        self.u = np.zeros(num_envs)  # the control of the step before, as applied
        self._running_cost = np.zeros((2, num_envs))  # state and control part of the running episode's cost
        self._terminal_cost = np.zeros(num_envs)
        self._bonus = np.zeros(num_envs)
        self._terminal_error = np.zeros((num_envs, len(problem.phases)))

    @property
    def dt(self) -> float:
        """The step in s."""
        return self.problem.dt

    @property
    def phase(self) -> np.ndarray:
        """The 0-based phase (N,) of the running steps; after the last step the last one."""
        return self._phase[np.minimum(self.t, self.problem.steps - 1)]

    def _tabulate(self):
        """The tables by step: `t` picks a row, whatever the phase."""
        phases, T = self.problem.phases, self.problem.steps
        self._phase = np.repeat(np.arange(len(phases)), [phase.steps for phase in phases])  # (T,)
        self._phase_ends = np.append(self._phase[1:] != self._phase[:-1], True)  # (T,) a phase ends after this step
        self._target, self._Q = (np.array([getattr(phases[k], name) for k in self._phase]) for name in ("target", "Q"))
        self._R = np.array([phases[k].R for k in self._phase])
        targets = np.array([phase.target for phase in phases])
        step_in_phase = np.concatenate([np.arange(phase.steps) for phase in phases])
        blend = np.minimum(step_in_phase / TRANSITION_STEPS, 1.0)[:, None]
        seen = (1 - blend) * targets[np.maximum(self._phase - 1, 0)] + blend * targets[self._phase]
        clock = np.stack([np.arange(T + 1) / T, np.append(self._phase, self._phase[-1]) / max(len(phases) - 1, 1)], 1)
        clock *= self.observe_phase
        # what is observed beside x, by step 0..T
        target_and_clock = np.hstack([np.vstack([seen, targets[-1]]), clock])
        self._seen_beside_x = target_and_clock if self.problem.waypoints else clock[:, :1]

    def _start(self, mask, options):
        if options.keys() - {"x0"}:
            raise BadInput(f"reset options are {options!r}; the only one is 'x0'")
        count, bound = int(mask.sum()), self.problem.x0_max
        if "x0" in options:
            x0 = np.asarray(options["x0"], dtype=np.float64)
            if x0.shape != (self.num_envs, 2) or not np.isfinite(x0).all():
                raise ValueError(f"options['x0'] must be finite, of shape ({self.num_envs}, 2); got {options['x0']!r}")
        else:
            x0 = self._draw_starts(lambda n: self.np_random.uniform(-bound, bound, (n, 2)), count)
        for component, start in zip(self.x, x0.T):
            component[mask] = start
        self._running_cost[:, mask] = 0.0
        self._terminal_cost[mask] = self._bonus[mask] = self._terminal_error[mask] = 0.0

    def _observe(self):
        """The paper's o_t of the running steps."""
        position, velocity = self.x
        return np.column_stack([position, velocity * self.observe_velocity, self._seen_beside_x[self.t]])

    def _advance(self, actions):
        t = self.t
        u = np.clip(actions[:, 0], -self.problem.u_max, self.problem.u_max)
        d1, d2 = self.x[0] - self._target[t, 0], self.x[1] - self._target[t, 1]
        cost = np.stack([self._Q[t, 0] * d1 * d1 + self._Q[t, 1] * d2 * d2, self._R[t] * u * u])
        self._running_cost += cost
        rewards = -cost.sum(axis=0)
        self.x = rk4(self.problem.f, self.x, u, self.problem.dt)
        ends = self._phase_ends[t]
        self.u, self.t = u, t + 1
        if ends.any():
            rewards += self._end_phase(np.flatnonzero(ends))
        return rewards, self.t == self.problem.steps, self._final_info

    def _end_phase(self, ending):
        """Terminal cost and bonus of the environments `ending`, whose phase ends here; returns their reward, (N,)."""
        last, phases = self.t[ending] - 1, self.problem.phases
        k = self._phase[last]
        radius, Qf, B = (np.array([getattr(phase, name) for phase in phases])[k] for name in ("radius", "Qf", "bonus"))
        scale = np.broadcast_to(self.radius_scale, len(phases))[k]
        error = np.hypot(self.x[0][ending] - self._target[last, 0], self.x[1][ending] - self._target[last, 1])
        self._terminal_error[ending, k] = error
        self._terminal_cost[ending] += Qf * error**2
        self._bonus[ending] += B * (error <= radius)
        share = error <= scale * radius
        if self.bonus_width:
            share = np.clip(1 - (error - scale * radius) / self.bonus_width, 0, 1)
        rewards = np.zeros(self.num_envs)
        rewards[ending] = -Qf * error**2 + B * share
        return rewards

    def _final_info(self):
        state, control = self._running_cost.copy()
        cost = state + control + self._terminal_cost
        parts = {"cost_state": state, "cost_control": control, "cost_terminal": self._terminal_cost.copy()}
        error = self._terminal_error.copy()
        hit = error <= [phase.radius for phase in self.problem.phases]
        return {"episodic_return": self._bonus - cost, "cost": cost, **parts, "hit": hit, "terminal_error": error}

    def _snapshot(self):
        return self.t * self.problem.dt, self.u[:, None], np.column_stack(self.x)

    def _make_sheet(self):
        # Matplotlib takes a quarter of a second that only a picture should cost
        from phased.animation import PhasePlane

        return PhasePlane(self.problem)


class PhasedEnv(SingleEnv):
    """One `PhasedVectorEnv`."""

    radius_scale = of_batch("radius_scale", "Factor on the radii in which the reward pays the bonus (1: the paper).")
    bonus_width = of_batch("bonus_width", "Distance beyond them over which the bonus falls to 0 (0: the paper).")


def make_phased_vector(env_id: str, num_envs: int = 1, **options) -> PhasedVectorEnv:
    """The batched environment of a problem in `PROBLEMS`; what `gymnasium.make_vec` calls."""
    check_options(PhasedVectorEnv, options)
    return PhasedVectorEnv(PROBLEMS[env_id], num_envs, **options).sealed()


def make_phased(env_id: str, **options) -> PhasedEnv:
    """The single environment of a problem in `PROBLEMS`; what `gymnasium.make` calls."""
    refuse_autoreset(options)
    return PhasedEnv(make_phased_vector(env_id, **options)).sealed()


def fly(env_id: str, policy: Callable, x0, **options) -> dict:
    """Fly `policy(obs (n, obs), t) -> action (n, 1)` from each start x0 (n, 2) and record what happened.

    Returns x (n, T+1, 2), the applied (clipped) u (n, T), reward (n, T), and the arrays of `final_info`.
    """
    batch: Any = gym.make_vec(env_id, num_envs=len(x0), **options)  # a PhasedVectorEnv
    problem = PROBLEMS[env_id]
    x = np.empty((len(x0), problem.steps + 1, 2))
    u, reward = np.empty((2, len(x0), problem.steps))
    obs, _ = batch.reset(options={"x0": x0})
    for t in range(problem.steps):
        x[:, t] = np.column_stack(batch.x)  # not of obs: the velocity may be hidden there
        obs, reward[:, t], _, final = batch.advance(policy(obs, t))
        u[:, t] = batch.u
    x[:, -1] = np.column_stack(batch.x)
    return {"x": x, "u": u, "reward": reward, **final}


make_phased.metadata = RENDERED  # where gym.make looks before there is an environment
