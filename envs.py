"""Problems and environments: one batched code for the single and the vector environment.

Importing this module registers (section "Numerical Simulations" of the paper; the last, with free final time, is ours)

    DoubleIntegrator-v0  DoubleIntegratorWaypoints-v0  VanDerPol-v0  VanDerPolWaypoints-v0
    RocketAscent-v0  RocketAscentCutoff-v0

and the rockets in the files of `vehicles/`.

`gymnasium.make(id)` gives one environment, `gymnasium.make_vec(id, num_envs=N)` N of them, stepped together in float64
NumPy with no Python loop over environments. Vehicle, equations of motion and rewards of the rocket are in `rocket.py`,
best read before `RocketVectorEnv`; all its names are also this module's. Reading order: dynamics and tables of the
small problems, the batch that every environment is, theirs, the single environment, the rocket's, registration.
To add a problem of this kind: write its dynamics, its table, and one line in `PROBLEMS`. To add a rocket: a file in
`vehicles/` that calls `register_rocket`.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from rocket import (  # noqa: F401 - every name of rocket.py is also one of envs.py
    BOOSTER,
    DISPERSION,
    DRAW,
    G0,
    LARGEST_DISPERSION,
    PAPER_MISSION,
    REFERENCE_PITCH,
    ROCKET,
    ROCKETS,
    STAGE_1,
    STAGE_2,
    TERMINAL_SCALE,
    BadInput,
    Burn,
    Dispersion,
    Engine,
    Mission,
    OrbitalElements,
    Rocket,
    Vehicles,
    ascent,
    delta_v,
    draw_bounds,
    draw_names,
    draw_vehicles,
    guidance_reward,
    largest_draw,
    launch_raan,
    local_frame,
    nominal_vehicles,
    orbit_vectors,
    orbital_elements,
    orbital_reward,
    penalties,
    precision_points,
    refuse_unless,
    specific_energy,
    target_axes,
    target_orbit,
    terminal_error,
    terminal_reward,
    trajectory_reward,
)

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
    """One classical Runge-Kutta step of x' = f(x, u) with the control held, x a tuple of components.

    The paper's x_{k+1}, "performed using numerical methods such as Runge-Kutta schemes". Exact for the double
    integrator: its solution is quadratic in dt.
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
    """One column of a parameter table. Matrices are diagonal: Q = diag(Q), Q_f = Qf I_2 (printed for one column)."""

    steps: int  # duration / dt
    target: tuple[float, float]  # position and velocity; by our reading passed through at the phase's end, not held
    radius: float  # r_target: within it the bonus is paid
    R: float  # control cost
    Qf: float  # terminal cost
    bonus: float  # terminal bonus B
    Q: tuple[float, float] = (1.0, 1.0)  # state cost


@dataclass(frozen=True)
class Problem:
    """A parameter table: dynamics, control bound, phases; `x_max` (ours) bounds every state reachable from the box.

    `single_optimum` is a promise that IPOPT ends in the same optimum from every guess, so that the reference tries one
    (see `baselines.guesses`): left out, a new problem's reference is the best of several.
    """

    env_id: str
    f: Callable
    u_max: float
    phases: tuple[Phase, ...]
    x_max: tuple[float, float]
    dt: float = 0.1  # s
    x0_max: float = 1.0  # the table's "state bounds", by our reading the box of the initial states, never a constraint
    single_optimum: bool = False

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
    single_optimum=True,
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
    single_optimum=True,
)

VAN_DER_POL = Problem(
    env_id="VanDerPol-v0",
    f=van_der_pol,
    u_max=1.5,
    phases=(Phase(steps=70, target=(0.0, 0.0), radius=0.05, R=1.0, Qf=20.0, bonus=20.0),),
    x_max=(19.0, 19.0),  # |x|' <= epsilon |x| + u, so |x(T)| <= (sqrt 2 + u / epsilon) e^(epsilon T) - u / epsilon
    single_optimum=True,
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
    single_optimum=True,
)

PROBLEMS = {
    problem.env_id: problem
    for problem in (DOUBLE_INTEGRATOR, DOUBLE_INTEGRATOR_WAYPOINTS, VAN_DER_POL, VAN_DER_POL_WAYPOINTS)
}

# the observed target moves to the new waypoint over these first steps of a phase: the paper's number, linearly by ours
TRANSITION_STEPS = 5

# ---------------------------------------------------------------------------------------------------------------------
# Environments
# ---------------------------------------------------------------------------------------------------------------------


DRAWN = {"render_modes": ["rgb_array"], "render_fps": 15}


class BatchedEnv(VectorEnv):
    """What every problem shares: step counters, checks of the action, and autoreset in the same step.

    A problem gives the spaces, `episode_steps` (the longest episode) and three methods:
    `_start(mask, options)` puts the environments in `mask` at a start, `_observe()` returns (N, obs) float64, and
    `_advance(actions)` flies one step and returns `(rewards (N,), terminated (N,), final)`, where `final()` gives the
    `final_info` arrays of the finished episodes; it is only called when there is one. One that can be drawn has
    `DRAWN` in its `metadata` and two more: `_snapshot()` returns time (N,) s, the control of the step before (N, m) and
    state (N, n), arrays of their own, and `_make_sheet(animation)` the drawing.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        num_envs: int,
        episode_steps: int,
        single_observation_space: Box,
        single_action_space: Box,
        render_mode: str | None = None,
    ):
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}; it must be at least 1")
        if render_mode not in (None, *self.metadata["render_modes"]):
            allowed = ", ".join(["None", *self.metadata["render_modes"]])
            raise ValueError(f"render_mode is {render_mode!r}; it must be one of {allowed}")
        self.render_mode, self._sheet = render_mode, None
        self._trails = [[] for _ in range(num_envs)]  # of each running episode, only where it is rendered
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
        """Fly one step without autoreset: `(obs, rewards, terminated, final_info)`. BadInput names a bad action."""
        actions = np.asarray(actions)
        if actions.dtype.kind not in "fiu":
            raise BadInput(f"actions are of type {actions.dtype}; they must be real numbers")
        actions = actions.astype(np.float64)
        if actions.shape != self.action_space.shape:
            raise BadInput(f"actions have shape {actions.shape}; expected {self.action_space.shape}")
        if not np.isfinite(actions).all():
            bad = int(np.flatnonzero(~np.isfinite(actions).all(axis=1))[0])
            raise BadInput(f"action of env {bad} at step {self.t[bad]} is {actions[bad].tolist()}; it must be finite")
        rewards, terminated, final = self._advance(actions)
        if self.render_mode is not None:
            self._record(np.ones(self.num_envs, dtype=bool))
        return self._observe(), rewards, terminated, final() if terminated.any() else {}

    def render(self):
        """The running episodes so far, a tuple of N frames, uint8 (H, W, 3); without a render mode a warning and None.

        An episode that has just ended is the next one already, as autoreset in the same step has it.
        """
        if self.render_mode is None:
            warn_of_no_mode(self)
            return None
        if not self._trails[0]:
            raise ResetNeeded("nothing to render: call reset() first")
        import animation  # Matplotlib takes a quarter of a second that only a drawing should cost

        self._sheet = self._sheet or self._make_sheet(animation)
        columns = [[np.array(column) for column in zip(*trail)] for trail in self._trails]
        return tuple(self._sheet.frame(animation.Flight(t, u[1:], y)) for t, u, y in columns)

    def _restart(self, mask, options):
        self.t[mask] = 0
        self._start(mask, options or {})
        if self.render_mode is not None:
            for k in np.flatnonzero(mask):
                self._trails[k] = []
            self._record(mask)

    def _record(self, mask):
        """Add time, control of the step before, and state to the trails of the environments in `mask`."""
        time, control, state = self._snapshot()
        for k in np.flatnonzero(mask):
            self._trails[k].append((time[k], control[k], state[k]))


def warn_of_no_mode(env):
    """Gymnasium's usual warning where `render` is called without a render mode."""
    env_id = env.spec.id if env.spec else "id"
    gym.logger.warn(
        "You are calling render method without specifying any render mode. You can specify the render_mode at "
        f'initialization, e.g. gym.make("{env_id}", render_mode="rgb_array")'
    )


class PhasedVectorEnv(BatchedEnv):
    """The double integrator and Van der Pol families: N copies of a `Problem` with one or several phases.

    Observation: the paper's o_t = [x1, x2, x1_target, x2_target, tau, phi] with several phases, [x1, x2, tau] with one
    (ours); tau = t / T, phi the 0-based phase over (phases - 1). Action: u, clipped at the control bound. Reward: the
    paper's r_t, -(dx'Q dx + R u^2) with dx the distance to the phase's target before the step; a phase's last step adds
    -Qf |dx|^2 + B 1[|dx| <= r] after it, so that an episode's rewards sum to bonus - J. The paper prints r_t for one
    phase and target 0; that each phase has its own is ours. The end of the horizon is `terminated` (time is observed).

    `final_info`: `episodic_return` (with the true radii), `cost`, `cost_state`, `cost_control`, `cost_terminal`, each
    (N,), and `hit` and `terminal_error` (the distance to the target at each phase's end), each (N, phases).

    `observe_phase=False` shows tau and phi as 0. `reset(options={"x0": (N, 2)})` sets the starts.

    Attributes that only training changes, to be set before a `reset`: `radius_scale`, a scalar or one number a phase,
    enlarges the radii in which the *reward* pays the bonus (1 is the paper); with `flights_per_start` G environment k
    flies start k // G, so that flights differ by their actions alone (1: each flies its own start; the last group is
    smaller where G does not divide N).
    """

    metadata = {**BatchedEnv.metadata, **DRAWN}

    def __init__(self, problem: Problem, num_envs: int = 1, observe_phase: bool = True, render_mode: str | None = None):
        self.problem, self.observe_phase = problem, observe_phase
        self.radius_scale, self.flights_per_start = 1.0, 1
        multi_phase = len(problem.phases) > 1
        target_max = np.max([np.abs(phase.target) for phase in problem.phases], axis=0)
        target_max[target_max == 0] = 1.0  # of velocity, where all waypoints are at rest: a box must have a width
        high = np.array([*problem.x_max, *target_max, 1.0, 1.0] if multi_phase else [*problem.x_max, 1.0])
        low = -high
        low[-2 if multi_phase else -1 :] = 0.0
        u_max = np.array([problem.u_max])
        spaces = Box(low, high, dtype=np.float64), Box(-u_max, u_max, dtype=np.float64)
        super().__init__(num_envs, problem.steps, *spaces, render_mode)
        self._tabulate()
        self.x = (np.zeros(num_envs), np.zeros(num_envs))
        self.u = np.zeros(num_envs)  # the control of the step before, as applied
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
            group = self.flights_per_start
            if not (isinstance(group, int | np.integer) and group >= 1):
                raise ValueError(f"flights_per_start is {group!r}; it must be a whole number of at least 1")
            x0 = self.np_random.uniform(-bound, bound, (-(-count // group), 2))  # rounded up
            x0 = np.repeat(x0, group, axis=0)[:count]
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

    def _snapshot(self):
        return self.t * self.problem.dt, self.u[:, None], np.column_stack(self.x)

    def _make_sheet(self, animation):
        return animation.PhasePlane(self.problem)


class SingleEnv(gym.Env):
    """One environment: a thin view of a batch of one (`batch`), without its autoreset.

    A step without a reset before it, also the one after an episode's end, raises `gymnasium.error.ResetNeeded`.
    """

    def __init__(self, batch: BatchedEnv):
        self.batch, self.render_mode = batch, batch.render_mode
        self.metadata = {key: value for key, value in batch.metadata.items() if key != "autoreset_mode"}
        self._running = False  # from a reset to the end of its episode
        self.observation_space, self.action_space = batch.single_observation_space, batch.single_action_space

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start anew, `options` being the batch's without its first axis; returns the observation and an empty info."""
        super().reset(seed=seed)
        self._running = False  # also where the options are refused
        if options and "x0" in options:
            options = {**options, "x0": np.asarray(options["x0"])[None]}
        if options and "draw" in options:
            options = {**options, "draw": [options["draw"]]}
        obs, info = self.batch.reset(seed=seed, options=options)
        self._running = True
        return obs[0], info

    def step(self, action):
        """Fly one step; the last one's info holds what `final_info` holds in the batch."""
        if not self._running:
            raise ResetNeeded("no episode is running: call reset() first, and again after an episode has ended")
        obs, rewards, terminated, final = self.batch.advance(np.asarray(action)[None])
        self._running = not terminated[0]
        return obs[0], float(rewards[0]), bool(terminated[0]), False, {key: value[0] for key, value in final.items()}

    def render(self):
        """The episode so far, uint8 (H, W, 3); without a render mode a warning and None."""
        if self.render_mode is None:
            warn_of_no_mode(self)
            return None
        return self.batch.render()[0]


def of_batch(name: str, doc: str) -> property:
    """A property of a single environment that is its batch's."""
    return property(lambda env: getattr(env.batch, name), lambda env, value: setattr(env.batch, name, value), doc=doc)


class PhasedEnv(SingleEnv):
    """One `PhasedVectorEnv`."""

    radius_scale = of_batch("radius_scale", "Factor on the radii in which the reward pays the bonus (1: the paper).")


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
# Rocket ascent
# ---------------------------------------------------------------------------------------------------------------------

ACTION_FRAMES = ("eci", "local")
STIFF = 0.25  # drag's rate |D| / (m |v_rel|) times the step, from which a step is cut


class RocketVectorEnv(BatchedEnv):
    """N launches of a mission's rocket into its orbit, steered by the thrust direction; 2 s steps, exact events.

    Observation: [r (3) m, v (3) m/s, m kg, t_norm, phi] in ECI, t_norm = 1 - t / end_time (961 s), phi in 0 to 1 the
    phase at the step's start (the paper's 0 to 3, over 3; a burn is a phase). Action: the thrust direction, any length
    but 0 (BadInput), normalised here; with `action_frame="local"` by (up, along-track, cross-track of the target plane)
    at the step's start, then held in ECI. A step is one RK4 step between events: staging, a stage that runs dry
    (`table_isp`), the end of the episode.

    With `dispersion` k > 0 no flight is like another: each episode draws standard scores, clipped at +-3 (see
    `draw_bounds`), in the order of `draw_names`, and flies the vehicle of `draw_vehicles`, k times `DISPERSION` from
    the nominal one. `reset(options={"draw": z})`, z (N, k), gives them, also beyond 3; BadInput refuses what no vehicle
    can be. Events and phases are then each flight's own. The mass that is observed is the flight computer's: the
    nominal schedule from the last staging on; `observe_mass` shows the true one. `observe_draw` puts the scores behind
    the nine.

    With a `cutoff` mission (ours: the paper fixes the final time) the engine stops when, in the last phase, the energy
    reaches the target's: the root within the step, to 1e-10, ends the episode. An altitude below 0 ends it too (crash),
    and so does `end_time`; with dispersion the burn-out of a flight's own last stage does in its place, and t_norm may
    end below 0 (unless `end_time` is another than the rocket's, or that one before the last burn's end).

    Reward: the sum of the five parts R_orbital, R_trajectory, R_guidance, R_penalties and R_terminal, each a function
    of `rocket.py`. `final_info`, (N,) each: `error_norm` (and `error` (N, 6), the terminal error in ECI), `a_km e i_deg
    raan_deg argp_deg final_mass_kg final_time_s max_altitude_km` (at the steps' ends), the parts' sums,
    `episodic_return`, `points` (`precision_points`), `crashed`, with dispersion `draw` (N, k).

    Attributes that only training changes, to be set before a `reset`: `mass_weight`, `trajectory_weight`,
    `guidance_weight`, `guidance` (a key of `REFERENCE_PITCH`), `end_time` (s, at most the last phase's end) and
    `terminal_scale`, a curriculum: the *reward* pays R_terminal with it, `final_info` reports it with `TERMINAL_SCALE`.
    """

    metadata = {**BatchedEnv.metadata, **DRAWN}
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
    ):
        if action_frame not in ACTION_FRAMES:
            raise ValueError(f"action_frame is {action_frame!r}; it must be one of {', '.join(ACTION_FRAMES)}")
        number = isinstance(dispersion, int | float | np.number) and 0 <= dispersion <= LARGEST_DISPERSION
        refuse_unless(number, "dispersion", dispersion, f"must be a number from 0 to {LARGEST_DISPERSION:.0f}")
        self.mission = flown_mission(mission, table_isp=table_isp)
        self.rocket, self.cutoff = self.mission.rocket, mission.cutoff
        self._last_phase = len(self.rocket.burns) - 1
        self.action_frame, self.observe_phase = action_frame, observe_phase
        self.dispersion, self.observe_draw, self.observe_mass = dispersion, observe_draw, observe_mass
        self.mass_weight, self.trajectory_weight, self.guidance_weight, self.guidance = 0.0, 0.0, 0.1, "none"
        self.terminal_scale = TERMINAL_SCALE
        super().__init__(num_envs, 1, *self._spaces(), render_mode)
        self._build()
        self.end_time = self.rocket.end_time  # sets episode_steps, too
        self._axes = target_axes(self.rocket)
        h, e = target_orbit(self.rocket.target, self.rocket.mu)
        self._h_axes = self._axes / np.linalg.norm(h)
        self._target = np.concatenate([self._h_axes @ h, self._axes @ e])[:, None]
        self.y = np.repeat(self.rocket.x0[:, None], num_envs, axis=1)  # (7, N)
        self.u = np.zeros((3, num_envs))  # the direction of the step before, in ECI
        self._parts = np.zeros((len(self.PARTS), num_envs))
        self._distance, self._energy, self.time, self._max_altitude = np.zeros((4, num_envs))
        self._crashed = np.zeros(num_envs, dtype=bool)
        self._everyone = np.arange(num_envs)

    def _build(self):
        """The vehicles: all alike until an episode draws its own."""
        self.vehicles = nominal_vehicles(self.rocket, self.num_envs)
        self.draw = np.zeros((self.num_envs, len(draw_names(self.rocket))))
        if self.dispersion:
            self.vehicles = draw_vehicles(self.rocket, self.dispersion, self.draw)
            # of the flight computer: by burn the nominal mass at its beginning and the flow
            ends, flow, dropped = (getattr(self.vehicles, name)[:-1, 0] for name in ("end", "flow", "dropped"))
            burnt = flow[:-1] * np.diff(ends[:-1], prepend=0.0)
            self._seen_mass = self.vehicles.mass[0] - np.append(0.0, np.cumsum(burnt + dropped[:-1]))
            self._seen_flow = flow.copy()  # drawn flows will be written where it lies

    def _spaces(self):
        """The spaces of one environment, which hold all that may be drawn."""
        self._draw_bounds, self._largest = draw_bounds(self.rocket, self.dispersion), nominal_vehicles(self.rocket, 1)
        if self.dispersion:
            self._largest = draw_vehicles(self.rocket, self.dispersion, largest_draw(self.rocket, self.dispersion))
        r_max, v_max = reachable(self.rocket, self.dispersion)
        scores = self._draw_bounds if self.observe_draw else []
        latest = max(self._largest.burn_out.max(), self.rocket.end_time)
        high = np.array([*[r_max] * 3, *[v_max] * 3, self._largest.mass[0], 1.0, 1.0, *scores])
        low = -high
        low[6:9] = 0.0, min(0.0, 1 - latest / self.rocket.end_time) if self.dispersion else 0.0, 0.0
        return Box(low, high, dtype=np.float64), Box(-1.0, 1.0, (3,), dtype=np.float64)

    @property
    def end_time(self) -> float:
        """Seconds after which an episode ends at the latest; the last step is shorter where 2 s do not divide it."""
        return self._end_time

    @end_time.setter
    def end_time(self, value: float):
        if not 0 < value <= self.rocket.end_time:
            raise ValueError(f"end_time is {value} s; it must be positive and at most {self.rocket.end_time}")
        self._end_time = float(value)
        self.episode_steps = int(self._set_ends(self._largest).max())
        # without dispersion all flights share their steps, worked out here for the one vehicle
        self._table = None if self.dispersion else self._work_out(np.arange(self.episode_steps + 1), self._largest)
        self._set_ends(self.vehicles)

    def _set_ends(self, vehicles):
        """When the episodes of these vehicles end at the latest: sets and returns the number of their steps."""
        own = self.dispersion and self.cutoff and self._end_time == self.rocket.end_time == self.rocket.burns[-1].end
        self._latest = vehicles.burn_out if own else np.full(len(vehicles.mass), self._end_time)  # s
        self._steps = np.maximum(np.ceil(self._latest / self.rocket.dt - 1e-9), 1.0).astype(np.int64)
        return self._steps

    def _start(self, mask, options):
        if options and not (self.dispersion and options.keys() == {"draw"}):
            allowed = "the only one is 'draw'" if self.dispersion else "without dispersion a rocket has no options"
            raise BadInput(f"reset options are {options!r}; {allowed}")
        if self.guidance not in REFERENCE_PITCH:
            raise ValueError(f"guidance is {self.guidance!r}; it must be one of {', '.join(REFERENCE_PITCH)}")
        if not 0 < self.terminal_scale < np.inf:
            raise ValueError(f"terminal_scale is {self.terminal_scale}; it must be positive and finite")
        if self.dispersion:
            self._launch(mask, options.get("draw"))
        self.y[:, mask] = self.rocket.x0[:, None]
        self.y[6, mask] = self.vehicles.mass[mask]
        self._parts[:, mask] = self.u[:, mask] = 0.0
        self._max_altitude[mask] = self.time[mask] = 0.0
        distance, energy = self._progress()
        self._distance[mask], self._energy[mask] = distance[mask], energy[mask]

    def _launch(self, mask, given):
        """Vehicles for the environments in `mask`: of the given draws (N, k), else of their own."""
        if given is None:
            draw = self.np_random.standard_normal((int(mask.sum()), self.draw.shape[1]))
            draw = np.clip(draw, -self._draw_bounds, self._draw_bounds)
        else:
            draw = self._checked_draw(given)[mask]
        drawn = draw_vehicles(self.rocket, self.dispersion, draw)  # before anything is changed: it may be refused
        self.draw[mask] = draw
        for mine, new in zip(self.vehicles, drawn):
            mine[..., mask] = new
        self.episode_steps = max(self.episode_steps, int(self._set_ends(self.vehicles).max()))

    def _checked_draw(self, given):
        """The draws of `reset` (N, k), float64; BadInput where they are none."""
        allowed = f"must hold finite numbers, of shape {self.draw.shape}: {', '.join(draw_names(self.rocket))}"
        try:
            draw = np.array(given, dtype=np.float64)
        except (TypeError, ValueError):
            draw = np.empty(0)
        refuse_unless(draw.shape == self.draw.shape, "options['draw']", f"of shape {draw.shape}", allowed)
        bad = draw[~np.isfinite(draw)]
        refuse_unless(not len(bad), "an entry of options['draw']", bad[:1].sum(), allowed)
        return draw

    def _progress(self):
        """The distance L to the target orbit (see `orbital_reward`) and the specific energy, both (N,)."""
        h, e = orbit_vectors(self.y, self.rocket.mu)
        error = np.concatenate([self._h_axes @ h, self._axes @ e]) - self._target
        return np.abs(error).sum(axis=0), specific_energy(self.y, self.rocket.mu)

    def _observe(self):
        obs = np.empty(self.observation_space.shape)
        obs[:, :7] = self.y.T
        if self.observe_draw:
            obs[:, 9:] = self.draw
        if self.dispersion and not self.observe_mass:
            obs[:, 6] = self._computed_mass()
        clock, _ = self._schedule()
        obs[:, 7:9] = clock[2:].T
        return obs

    def _schedule(self):
        """Of the running steps, as `_work_out` has it."""
        if self._table is None:
            return self._work_out(self.t, self.vehicles)
        clock, arc = self._table
        return clock[:, self.t], arc[self.t]

    def _work_out(self, t, vehicles):
        """Begin and end (s), t_norm and phi as observed before the steps t (N,), (4, N); the arcs they begin in, (N,).

        After an episode's last step phi is still that one's.
        """
        dt, ends = self.rocket.dt, vehicles.end
        time, end = (np.where(k >= self._steps, self._latest, dt * k) for k in (t, t + 1))
        arc = (ends <= dt * np.minimum(t, self._steps - 1)).sum(axis=0)
        phi = np.minimum(arc, self._last_phase) / max(self._last_phase, 1)
        t_norm = 1 - time / self.rocket.end_time
        return np.array([time, end, t_norm * self.observe_phase, phi * self.observe_phase]), arc

    def _computed_mass(self):
        """The flight computer's mass (N,) in kg: the nominal burn's, counted from the staging that has just been."""
        burn = (self.vehicles.end[: self._last_phase] <= self.time).sum(axis=0)
        began = np.where(burn > 0, self.vehicles.end[burn - 1, self._everyone], 0.0)
        return np.maximum(self._seen_mass[burn] - self._seen_flow[burn] * (self.time - began), self.rocket.dry_mass)

    def _directions(self, actions):
        """Unit thrust directions in ECI (3, N) of actions (N, 3); BadInput names the first of length zero."""
        largest = np.abs(actions).max(axis=1)
        if not largest.all():
            bad = int(np.argmin(largest))
            raise BadInput(f"action of env {bad} at step {self.t[bad]} is [0, 0, 0]; a direction must have a length")
        u = actions.T / largest  # before squaring: neither overflow nor underflow
        u /= np.sqrt((u * u).sum(axis=0))
        if self.action_frame == "eci":
            return u
        up, along, cross = local_frame(self.y, self._axes[2])
        return up * u[0] + along * u[1] + cross * u[2]

    def _advance(self, actions):
        t, u, before = self.t, self._directions(actions), self.y
        (begin, end, *_), arc = self._schedule()
        duration, phase, done = end - begin, np.minimum(arc, self._last_phase), t + 1 == self._steps
        self.y = self._fly(before, u, begin, end, duration, self._everyone, arc)
        if self.cutoff:
            energy = specific_energy(self.y, self.rocket.mu)
            reached = (phase == self._last_phase) & (energy >= self.rocket.target_energy)
            if reached.any():
                step = before, u, begin, end, duration, self._everyone, arc
                self.y[:, reached], duration[reached] = self._cut(*(part[..., reached] for part in step))
            done = done | reached
        altitude = np.sqrt((self.y[:3] ** 2).sum(axis=0)) - self.rocket.Re
        self._crashed = altitude < 0
        done = done | self._crashed
        self.time = begin + duration
        self._max_altitude = np.maximum(self._max_altitude, altitude)
        rewards = self._reward(before, u, phase, altitude, done)
        self.u, self.t = u, t + 1
        return rewards, done, self._final_info

    def _fly(self, y, u, begin, end, duration, who, arc):
        """States (7, n) `duration` (n,) s after `begin` (n,) of steps that end at `end` (n,), u (3, n) held.

        y (7, n): the states at `begin` of the environments `who` (n,), which are then in the arcs `arc` (n,).
        """
        event = self.vehicles.end[arc, who]
        until = event - begin
        thrust, flow = self.vehicles.thrust[arc, who], self.vehicles.flow[arc, who]
        y = self._arc(y, u, np.minimum(duration, until), who, thrust, flow)
        passed = np.flatnonzero(event <= end)
        if len(passed):
            # a duration is rounded: an event at the step's very end, which the next step takes as past, is not missed
            passed = passed[(duration >= until - 1e-9)[passed]]
            u, end, who, arc = u[:, passed], end[passed], who[passed], arc[passed]
            y[6, passed] -= self.vehicles.dropped[arc, who]
            late = np.maximum((duration - until)[passed], 0.0)
            y[:, passed] = self._fly(y[:, passed], u, event[passed], end, late, who, arc + 1)
        return y

    def _arc(self, y, u, dt, who, thrust, flow):
        """States (7, n) after dt (n,) seconds without an event: one RK4 step, several for a plunge into dense air.

        There drag is stiff: its rate times the step, at the lowest altitude that the step can reach, is kept below
        `STIFF`. No ascent comes near it; without this a crash at orbital speed would end in numbers without meaning.
        """
        rocket, controls = self.rocket, (*u, thrust, flow)
        drag, wind = (self.vehicles.drag[who], self.vehicles.wind[:, who]) if self.dispersion else (None, None)
        # the state as one component (7, n): rk4 then takes a seventh of the array operations
        f = lambda x, u: (np.array(ascent(x[0], u, rocket, wind, drag)),)  # noqa: E731
        speed = np.sqrt((y[3:6] ** 2).sum(axis=0))
        lowest = np.maximum(np.sqrt((y[:3] ** 2).sum(axis=0)) - rocket.Re - speed * dt, 0.0)
        rate = rocket.rho0 * np.exp(-lowest / rocket.H) * rocket.Cd * rocket.S * speed / y[6]
        if self.dispersion:
            rate = drag * rate
        (y_next,) = rk4(f, (y,), controls, dt)
        stiff = np.flatnonzero(rate * dt > STIFF)
        if len(stiff):
            n = np.ceil((rate * dt)[stiff] / STIFF)  # for each its own: it must not depend on the rest of the batch
            y_sub, controls, dt = y[:, stiff], tuple(c[stiff] for c in controls), dt[stiff] / n
            if self.dispersion:
                drag, wind = drag[stiff], wind[:, stiff]
            for k in range(int(n.max())):
                aloft = (y_sub[:3] ** 2).sum(axis=0) >= rocket.Re**2  # who is below the ground stays there
                y_sub = np.where(aloft & (k < n), rk4(f, (y_sub,), controls, dt)[0], y_sub)
            y_next[:, stiff] = y_sub
        return y_next

    def _cut(self, before, u, begin, end, duration, who, arc):
        """States (7, n) and times (n,) within the step at which `who` reach the target's energy; the rest as `_fly`'s.

        Regula falsi with the Illinois change (Dowell and Jarratt, 1971). The energy grows almost linearly in a step, so
        that four evaluations reach rounding; six, for all alike, keep a row independent of the rest of the batch.
        """
        goal = self.rocket.target_energy
        low, high, above = np.zeros(len(who)), duration, np.full(len(who), -1)
        f_low = np.minimum(specific_energy(before, self.rocket.mu) - goal, -1e-300)  # beyond it at the start: cut there
        f_high = specific_energy(self.y[:, who], self.rocket.mu) - goal
        for _ in range(6):
            time = low - f_low * (high - low) / (f_high - f_low)
            y = self._fly(before, u, begin, end, time, who, arc)
            f, above_before = specific_energy(y, self.rocket.mu) - goal, above
            above = f >= 0
            kept = above == above_before  # the same end twice: its value is halved
            f_low, f_high = np.where(above, f_low / (1 + kept), f), np.where(above, f, f_high / (1 + kept))
            low, high = np.where(above, low, time), np.where(above, time, high)
        return y, time

    def _reward(self, before, u, phase, altitude, done):
        """The five parts of this step, added to their sums; returns what is paid, (N,): their total, R_terminal with
        `terminal_scale`."""
        t = self.t
        distance, energy = self._progress()
        turn = np.sqrt(((u - self.u) ** 2).sum(axis=0)) * (t > 0)
        burnt = (before[6] - self.y[6]) * (phase == self._last_phase)
        parts = np.zeros_like(self._parts)
        parts[0] = orbital_reward(self._distance, distance)
        parts[1] = trajectory_reward(self._energy, energy, phase < self._last_phase, self.trajectory_weight)
        if REFERENCE_PITCH[self.guidance] is not None:
            until = self.mission.guided_until or self.rocket.burns[0].end
            times, angles = REFERENCE_PITCH[self.guidance]
            pitch = np.radians(np.interp(self.rocket.dt * t, until * np.array(times), angles, right=np.nan))
            parts[2] = guidance_reward(u, *local_frame(before, self._axes[2])[:2], pitch, self.guidance_weight)
        left = np.minimum(self.y[6] - self.vehicles.dry_mass, self.vehicles.propellant)
        parts[3] = penalties(self.mission, altitude, self.time, turn, burnt, left, self.mass_weight)
        self._parts += parts
        if done.any():
            error_norm = np.linalg.norm(terminal_error(self.y[:, done].T, self.rocket), axis=1)
            self._parts[4, done] += terminal_reward(error_norm)
            parts[4, done] = terminal_reward(error_norm, self.terminal_scale)
        self._distance, self._energy = distance, energy
        return parts.sum(axis=0)

    def _final_info(self):
        y = self.y.T
        error, elements = terminal_error(y, self.rocket), orbital_elements(y, self.rocket.mu)
        error_norm = np.sqrt((error * error).sum(axis=1))
        info = {"error": error, "error_norm": error_norm, "a_km": elements.a / 1e3, "e": elements.e}
        info |= {f"{name}_deg": np.degrees(getattr(elements, name)) for name in ("i", "raan", "argp")}
        info |= {"final_mass_kg": self.y[6].copy(), "final_time_s": self.time.copy(), "crashed": self._crashed.copy()}
        info |= {"max_altitude_km": self._max_altitude / 1e3, "points": precision_points(error_norm)}
        if self.dispersion:
            info |= {"draw": self.draw.copy(), "dry": self.time >= self.vehicles.burn_out - 1e-6}
        return info | dict(zip(self.PARTS, self._parts.copy())) | {"episodic_return": self._parts.sum(axis=0)}

    def _snapshot(self):
        return self.time.copy(), self.u.T.copy(), self.y.T.copy()

    def _make_sheet(self, animation):
        return animation.Ascent(self.rocket)


def reachable(rocket: Rocket, dispersion: float = 0.0) -> tuple[float, float]:
    """Bounds of |r| (m) and |v| (m/s): the launcher's delta-v and gravity all pointing one way, the whole flight.

    With dispersion the delta-v is bounded by one stage's with the fastest exhaust, the heaviest start and the lightest
    end.
    """
    gain, end = delta_v(rocket), rocket.end_time
    if dispersion:
        draw = largest_draw(rocket, dispersion)
        scores = dict(zip(draw_names(rocket), draw_bounds(rocket, dispersion)))
        heavy, light = draw_vehicles(rocket, dispersion, draw), draw_vehicles(rocket, dispersion, -draw)
        engines = [(e.thrust, e.flow(rocket.table_isp)) for burn in rocket.burns for _, e in burn.engines]
        fastest = max((thrust / flow for thrust, flow in engines if flow), default=0.0)
        gain = fastest * (1 + dispersion * DISPERSION.isp * scores["isp_1"])
        gain *= np.log(heavy.mass[0] / light.dry_mass[0])
        end = max(end, heavy.burn_out[0])
    v_max = np.linalg.norm(rocket.x0[3:6]) + gain + rocket.mu / rocket.Re**2 * end
    return rocket.Re + v_max * end, v_max


class RocketEnv(SingleEnv):
    """One `RocketVectorEnv`; its public attributes are the batch's."""

    mass_weight = of_batch("mass_weight", "Reward lost per `mass_unit` of propellant burnt in the last phase.")
    trajectory_weight = of_batch("trajectory_weight", "Weight of R_trajectory.")
    guidance_weight = of_batch("guidance_weight", "Weight of R_guidance.")
    guidance = of_batch("guidance", "The reference pitch of R_guidance, a key of REFERENCE_PITCH.")
    end_time = of_batch("end_time", "Seconds after which an episode ends at the latest.")
    terminal_scale = of_batch("terminal_scale", "The scale of R_terminal in the reward; reports keep TERMINAL_SCALE.")
    draw = of_batch("draw", "The running episode's standard scores (1, k), zeros without dispersion.")


def flown_mission(mission: Mission, rocket: Rocket | None = None, table_isp: bool = False) -> Mission:
    """A mission as these options of the environment have it flown: by another rocket, with the table's Isp."""
    rocket = rocket or mission.rocket
    return replace(mission, rocket=replace(rocket, table_isp=table_isp or rocket.table_isp))


def make_rocket_vector(env_id: str, num_envs: int = 1, rocket: Rocket | None = None, **options) -> RocketVectorEnv:
    """The batched environment of a mission in `ROCKETS`, or of another rocket on it; `gymnasium.make_vec` calls it."""
    return RocketVectorEnv(num_envs, flown_mission(ROCKETS[env_id], rocket), **options)


def make_rocket(env_id: str, **options) -> RocketEnv:
    """The single environment of a mission in `ROCKETS`; what `gymnasium.make` calls."""
    return RocketEnv(make_rocket_vector(env_id, **options))


def fly_rocket(env_id: str, policy: Callable, end_time: float | None = None, draw=None, **options) -> dict:
    """Fly `policy(obs (1, obs), t) -> action (1, 3)` once, to `end_time` (s) at the latest, and record what happened.

    draw (k,): the vehicle's standard scores, with the option `dispersion`.

    Returns t (K+1,) s, u (K, 3) the unit directions in ECI, y (K+1, 7) r, v, m, reward (K,), and the last step's info.
    """
    env = gym.make_vec(env_id, num_envs=1, **options)
    if end_time is not None:
        env.end_time = end_time
    obs, _ = env.reset(options=None if draw is None else {"draw": [draw]})
    t, u, y, rewards, final = [0.0], [], [env.y[:, 0].copy()], [], {}
    while not final:
        obs, reward, _, final = env.advance(policy(obs, len(u)))
        t.append(env.time[0])
        u.append(env.u[:, 0])
        y.append(env.y[:, 0].copy())
        rewards.append(reward[0])
    final = {key: value[0] for key, value in final.items()}
    return {"t": np.array(t), "u": np.array(u), "y": np.array(y), "reward": np.array(rewards), **final}


# ---------------------------------------------------------------------------------------------------------------------
# Registration (no max_episode_steps: the horizon is the problem's own, and its end, by our reading, a true one)
# ---------------------------------------------------------------------------------------------------------------------

make_phased.metadata = make_rocket.metadata = DRAWN  # where gym.make looks before there is an environment

for _env_id in PROBLEMS:
    gym.register(
        id=_env_id,
        entry_point=f"{__name__}:make_phased",
        vector_entry_point=f"{__name__}:make_phased_vector",
        kwargs={"env_id": _env_id},
    )


def register_rocket(env_id: str, rocket: Rocket, cutoff: bool = False, ceiling_km: float | None = None, **rules):
    """Make a rocket an environment id that references, evaluation, figures and `ppo_gtrxl_rocket.py` take, too.

    `cutoff`, `ceiling_km` and `rules` are the fields of `Mission`. An id that is registered already is replaced, with a
    warning if it was another rocket's. Raises BadInput where the id is another environment's or not one of Gymnasium's.
    """
    others = gym.registry.keys() - ROCKETS.keys()
    if env_id in others or not gym.envs.registration.ENV_ID_RE.fullmatch(env_id) or "/" in env_id:
        raise BadInput(f"env_id is {env_id!r}; it must be a new id such as MyRocket-v0")
    mission = Mission(rocket, cutoff, ceiling_km, **rules)
    if ROCKETS.get(env_id, mission) != mission:
        warnings.warn(f"{env_id} was another rocket's id; from here on it is this one's", stacklevel=2)
    gym.registry.pop(env_id, None)
    try:
        gym.register(
            id=env_id,
            entry_point=f"{__name__}:make_rocket",
            vector_entry_point=f"{__name__}:make_rocket_vector",
            kwargs={"env_id": env_id},
        )
    except gym.error.Error as error:  # the name of another environment without its version
        raise BadInput(f"env_id is {env_id!r}; it must be a new id such as MyRocket-v0: {error}") from error
    ROCKETS[env_id] = mission


def import_vehicles():
    """Run every file of `vehicles/`; one that cannot be is left out with a line that says why."""
    for path in sorted(Path(__file__).parent.glob("vehicles/*.py")):
        try:
            importlib.import_module(f"vehicles.{path.stem}")
        except BadInput as error:
            print(f"vehicles/{path.name} is left out: {error}", file=sys.stderr)
        except Exception as error:  # whatever is wrong with one file must not stop the others
            why = f"{type(error).__name__}: {error}"
            print(f"vehicles/{path.name} is left out: {why}", file=sys.stderr)


for _env_id, _cutoff in {"RocketAscent-v0": False, "RocketAscentCutoff-v0": True}.items():
    register_rocket(_env_id, **vars(replace(PAPER_MISSION, cutoff=_cutoff)))
import_vehicles()
