"""Dynamics, problem tables and environments: one batched code for the single and the vector environment.

Importing this module registers (section "Numerical Simulations" of the paper)

    DoubleIntegrator-v0  DoubleIntegratorWaypoints-v0  VanDerPol-v0  VanDerPolWaypoints-v0

`gymnasium.make(id)` gives one environment, `gymnasium.make_vec(id, num_envs=N)` N of them, stepped together in float64
NumPy with no Python loop over environments. Reading order: problem tables, dynamics, environments, registration.
To add a problem of this kind: write its dynamics, its table, and one line in `PROBLEMS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

# ---------------------------------------------------------------------------------------------------------------------
# Dynamics: x is a tuple of components, each a NumPy array over environments or a CasADi symbol
# ---------------------------------------------------------------------------------------------------------------------


def double_integrator(x, u):
    """Position and velocity driven by an acceleration: x1' = x2, x2' = u ("Double Integrator Problem")."""
    _, x2 = x
    return x2, u


def van_der_pol(x, u, epsilon=0.1):
    """Van der Pol oscillator: x1' = x2, x2' = -x1 + epsilon (1 - x1^2) x2 + u ("Van der Pol Oscillator Problem")."""
    x1, x2 = x
    return x2, -x1 + epsilon * (1 - x1 * x1) * x2 + u


def rk4(f, x, u, dt):
    """One classical Runge-Kutta step of x' = f(x, u) with the control held, x a tuple of components (Eq. of x_{k+1}).

    Exact for the double integrator: its solution is quadratic in dt.
    """
    k1 = f(x, u)
    k2 = f(tuple(xi + 0.5 * dt * ki for xi, ki in zip(x, k1)), u)
    k3 = f(tuple(xi + 0.5 * dt * ki for xi, ki in zip(x, k2)), u)
    k4 = f(tuple(xi + dt * ki for xi, ki in zip(x, k3)), u)
    return tuple(xi + dt / 6 * (a + 2 * (b + c) + d) for xi, a, b, c, d in zip(x, k1, k2, k3, k4))


# ---------------------------------------------------------------------------------------------------------------------
# Problem tables (the paper's tables "Double Integrator / Van der Pol Oscillator Simulation Parameters")
# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Phase:
    """One column of a parameter table. Matrices are diagonal: Q = diag(Q), Q_f = Qf I_2."""

    steps: int  # duration / dt
    target: tuple[float, float]  # position and velocity; passed through at the phase's end, not held
    radius: float  # r_target: within it the bonus is paid
    R: float  # control cost
    Qf: float  # terminal cost
    bonus: float  # terminal bonus B
    Q: tuple[float, float] = (1.0, 1.0)  # state cost


@dataclass(frozen=True)
class Problem:
    """A parameter table: dynamics, control bound, phases. `x_max` bounds every state reachable from the start box."""

    env_id: str
    f: Callable
    u_max: float
    phases: tuple[Phase, ...]
    x_max: tuple[float, float]
    dt: float = 0.1  # s
    x0_max: float = 1.0  # "state bounds": the box of the initial states, never a constraint

    @property
    def steps(self) -> int:
        """Number of steps T of an episode."""
        return sum(phase.steps for phase in self.phases)


DOUBLE_INTEGRATOR = Problem(
    env_id="DoubleIntegrator-v0",
    f=double_integrator,
    u_max=4.0,
    phases=(Phase(steps=50, target=(0.0, 0.0), radius=0.05, R=0.1, Qf=20.0, bonus=20.0),),
    x_max=(57.0, 22.0),  # |x2| <= 1 + u T, |x1| <= 1 + T + u T^2 / 2, and room for rounding
)

DOUBLE_INTEGRATOR_WAYPOINTS = Problem(
    env_id="DoubleIntegratorWaypoints-v0",
    f=double_integrator,
    u_max=3.0,
    phases=(
        Phase(steps=50, target=(0.0, 0.0), radius=0.02, R=0.1, Qf=20.0, bonus=20.0),
        Phase(steps=50, target=(0.5, 0.5), radius=0.02, R=0.1, Qf=30.0, bonus=20.0),
    ),
    x_max=(162.0, 32.0),
)

VAN_DER_POL = Problem(
    env_id="VanDerPol-v0",
    f=van_der_pol,
    u_max=1.5,
    phases=(Phase(steps=70, target=(0.0, 0.0), radius=0.05, R=1.0, Qf=20.0, bonus=20.0),),
    x_max=(19.0, 19.0),  # |x|' <= epsilon |x| + u, so |x(T)| <= (sqrt 2 + u / epsilon) e^(epsilon T) - u / epsilon
)

VAN_DER_POL_WAYPOINTS = Problem(
    env_id="VanDerPolWaypoints-v0",
    f=van_der_pol,
    u_max=1.5,
    phases=(
        Phase(steps=50, target=(0.0, 0.0), radius=0.05, R=0.005, Qf=25.0, bonus=25.0),
        Phase(steps=40, target=(0.2, 0.2), radius=0.05, R=0.005, Qf=30.0, bonus=30.0),
        Phase(steps=50, target=(0.5, 0.5), radius=0.05, R=0.01, Qf=40.0, bonus=40.0),
    ),
    x_max=(52.0, 52.0),
)

PROBLEMS = {
    problem.env_id: problem
    for problem in (DOUBLE_INTEGRATOR, DOUBLE_INTEGRATOR_WAYPOINTS, VAN_DER_POL, VAN_DER_POL_WAYPOINTS)
}

TRANSITION_STEPS = 5  # the observed target moves from the old waypoint to the new one over these steps of a phase

# ---------------------------------------------------------------------------------------------------------------------
# Environments
# ---------------------------------------------------------------------------------------------------------------------


class BatchedEnv(VectorEnv):
    """What every problem shares: step counters, checks of the action, and autoreset in the same step.

    A problem gives the spaces, `episode_steps` (the longest episode) and three methods:
    `_start(mask, options)` puts the environments in `mask` at a start, `_observe()` returns (N, obs) float64, and
    `_advance(actions)` flies one step and returns `(rewards (N,), terminated (N,), final)`, where `final()` gives the
    `final_info` arrays of the finished episodes; it is only called when there is one.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, num_envs: int, episode_steps: int, single_observation_space: Box, single_action_space: Box):
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}; it must be at least 1")
        self.num_envs, self.episode_steps = num_envs, episode_steps
        self.single_observation_space = single_observation_space
        self.single_action_space = single_action_space
        self.observation_space = batch_space(single_observation_space, num_envs)
        self.action_space = batch_space(single_action_space, num_envs)
        self.t = np.zeros(num_envs, dtype=np.int64)  # steps flown in the running episode

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start every environment anew; returns (N, obs) float64 and an empty info."""
        super().reset(seed=seed)
        self._restart(np.ones(self.num_envs, dtype=bool), options)
        return self._observe(), {}

    def step(self, actions):
        """Fly one step and restart what ended; the ended episodes' last values are `final_obs` and `final_info`."""
        obs, rewards, terminated, final = self.advance(actions)
        info = {}
        if terminated.any():
            final_info = {**final, **{f"_{key}": terminated.copy() for key in final}}
            info = {"final_obs": obs, "_final_obs": terminated.copy()}
            info |= {"final_info": final_info, "_final_info": terminated.copy()}
            self._restart(terminated, None)
            obs = self._observe()
        return obs, rewards, terminated, np.zeros(self.num_envs, dtype=bool), info

    def advance(self, actions):
        """Fly one step without autoreset: `(obs, rewards, terminated, final_info)`; raises ValueError on a NaN."""
        actions = np.asarray(actions, dtype=np.float64)
        if actions.shape != self.action_space.shape:
            raise ValueError(f"actions have shape {actions.shape}; expected {self.action_space.shape}")
        if not np.isfinite(actions).all():
            bad = int(np.flatnonzero(~np.isfinite(actions).all(axis=1))[0])
            raise ValueError(f"action of env {bad} at step {self.t[bad]} is {actions[bad].tolist()}; it must be finite")
        rewards, terminated, final = self._advance(actions)
        return self._observe(), rewards, terminated, final() if terminated.any() else {}

    def _restart(self, mask, options):
        self.t[mask] = 0
        self._start(mask, options or {})


class PhasedVectorEnv(BatchedEnv):
    """The double integrator and Van der Pol families: N copies of a `Problem` with one or several phases.

    Observation: [x1, x2, tau] with one phase, [x1, x2, x1_target, x2_target, tau, phi] with several; tau = t / T, phi
    the 0-based phase over (phases - 1). Action: u, clipped at the control bound. Reward: -(dx'Q dx + R u^2) with dx the
    distance to the phase's target before the step; a phase's last step adds -Qf |dx|^2 + B 1[|dx| <= r] after it, so
    that an episode's rewards sum to bonus - J. The end of the horizon is `terminated` (time is observed).

    `final_info`: `episodic_return` (with the true radii), `cost`, `cost_state`, `cost_control`, `cost_terminal`, each
    (N,), and `hit` and `terminal_error` (the distance to the target at each phase's end), each (N, phases).

    `observe_phase=False` shows tau and phi as 0. `radius_scale`, a scalar or one number a phase, enlarges the radii in
    which the *reward* pays the bonus; 1 is the paper. `reset(options={"x0": (N, 2)})` sets the starts.
    """

    def __init__(self, problem: Problem, num_envs: int = 1, observe_phase: bool = True):
        self.problem, self.observe_phase, self.radius_scale = problem, observe_phase, 1.0
        multi_phase = len(problem.phases) > 1
        target_max = np.max([np.abs(phase.target) for phase in problem.phases], axis=0)
        high = np.array([*problem.x_max, *target_max, 1.0, 1.0] if multi_phase else [*problem.x_max, 1.0])
        low = -high
        low[-2 if multi_phase else -1 :] = 0.0
        u_max = np.array([problem.u_max])
        spaces = Box(low, high, dtype=np.float64), Box(-u_max, u_max, dtype=np.float64)
        super().__init__(num_envs, problem.steps, *spaces)
        self._tabulate()
        self.x = (np.zeros(num_envs), np.zeros(num_envs))
        self._running_cost = np.zeros((2, num_envs))  # state and control part of the running episode's cost
        self._terminal_cost = np.zeros(num_envs)
        self._bonus = np.zeros(num_envs)
        self._terminal_error = np.zeros((num_envs, len(problem.phases)))

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
        self._context = np.hstack([np.vstack([seen, targets[-1]]), clock]) if len(phases) > 1 else clock[:, :1]

    def _start(self, mask, options):
        count, bound = int(mask.sum()), self.problem.x0_max
        if "x0" in options:
            x0 = np.asarray(options["x0"], dtype=np.float64)
            if x0.shape != (self.num_envs, 2) or not np.isfinite(x0).all():
                raise ValueError(f"options['x0'] must be finite, of shape ({self.num_envs}, 2); got {options['x0']!r}")
        else:
            x0 = self.np_random.uniform(-bound, bound, (count, 2))
        for component, start in zip(self.x, x0.T):
            component[mask] = start
        self._running_cost[:, mask] = 0.0
        self._terminal_cost[mask] = self._bonus[mask] = self._terminal_error[mask] = 0.0

    def _observe(self):
        return np.column_stack([*self.x, self._context[self.t]])

    def _advance(self, actions):
        t = self.t
        u = np.clip(actions[:, 0], -self.problem.u_max, self.problem.u_max)
        d1, d2 = self.x[0] - self._target[t, 0], self.x[1] - self._target[t, 1]
        cost = np.stack([self._Q[t, 0] * d1 * d1 + self._Q[t, 1] * d2 * d2, self._R[t] * u * u])
        self._running_cost += cost
        rewards = -cost.sum(axis=0)
        self.x = rk4(self.problem.f, self.x, u, self.problem.dt)
        ends = self._phase_ends[t]
        self.t = t + 1
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
        rewards = np.zeros(self.num_envs)
        rewards[ending] = -Qf * error**2 + B * (error <= scale * radius)
        return rewards

    def _final_info(self):
        state, control = self._running_cost.copy()
        cost = state + control + self._terminal_cost
        parts = {"cost_state": state, "cost_control": control, "cost_terminal": self._terminal_cost.copy()}
        error = self._terminal_error.copy()
        hit = error <= [phase.radius for phase in self.problem.phases]
        return {"episodic_return": self._bonus - cost, "cost": cost, **parts, "hit": hit, "terminal_error": error}


class SingleEnv(gym.Env):
    """One environment: a thin view of a batch of one (`batch`), without its autoreset."""

    metadata = {"render_modes": []}

    def __init__(self, batch: BatchedEnv):
        self.batch = batch
        self.observation_space, self.action_space = batch.single_observation_space, batch.single_action_space

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start anew, `options={"x0": (2,)}` from a given state; returns the observation and an empty info."""
        super().reset(seed=seed)
        if options and "x0" in options:
            options = {**options, "x0": np.asarray(options["x0"])[None]}
        obs, info = self.batch.reset(seed=seed, options=options)
        return obs[0], info

    def step(self, action):
        """Fly one step; the last one's info holds what `final_info` holds in the batch."""
        obs, rewards, terminated, final = self.batch.advance(np.asarray(action)[None])
        return obs[0], float(rewards[0]), bool(terminated[0]), False, {key: value[0] for key, value in final.items()}


class PhasedEnv(SingleEnv):
    """One `PhasedVectorEnv`."""

    @property
    def radius_scale(self):
        """Factor on the radii in which the reward pays the bonus (1: the paper)."""
        return self.batch.radius_scale

    @radius_scale.setter
    def radius_scale(self, value):
        self.batch.radius_scale = value


def make_phased_vector(env_id: str, num_envs: int = 1, **options) -> PhasedVectorEnv:
    """The batched environment of a problem in `PROBLEMS`; what `gymnasium.make_vec` calls."""
    return PhasedVectorEnv(PROBLEMS[env_id], num_envs, **options)


def make_phased(env_id: str, **options) -> PhasedEnv:
    """The single environment of a problem in `PROBLEMS`; what `gymnasium.make` calls."""
    return PhasedEnv(make_phased_vector(env_id, **options))


def fly(env_id: str, policy: Callable, x0, **options) -> dict:
    """Fly `policy(obs (n, obs), t) -> action (n, 1)` from each start x0 (n, 2) and record what happened.

    Returns x (n, T+1, 2), the applied (clipped) u (n, T), reward (n, T), and the arrays of `final_info`.
    """
    envs = gym.make_vec(env_id, num_envs=len(x0), **options)
    problem = PROBLEMS[env_id]
    x = np.empty((len(x0), problem.steps + 1, 2))
    u, reward = np.empty((2, len(x0), problem.steps))
    obs, info = envs.reset(options={"x0": x0})
    for t in range(problem.steps):
        action = np.asarray(policy(obs, t), dtype=np.float64)
        x[:, t], u[:, t] = obs[:, :2], np.clip(action[:, 0], -problem.u_max, problem.u_max)
        obs, reward[:, t], _, _, info = envs.step(action)
    x[:, -1] = info["final_obs"][:, :2]
    final = {key: value for key, value in info["final_info"].items() if not key.startswith("_")}
    return {"x": x, "u": u, "reward": reward, **final}


# ---------------------------------------------------------------------------------------------------------------------
# Registration (no max_episode_steps: the horizon is the problem's own, and its end a true one)
# ---------------------------------------------------------------------------------------------------------------------

for _env_id in PROBLEMS:
    gym.register(
        id=_env_id,
        entry_point=f"{__name__}:make_phased",
        vector_entry_point=f"{__name__}:make_phased_vector",
        kwargs={"env_id": _env_id},
    )
