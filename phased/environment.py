"""The environment of the small problems: N copies of a `Problem` with one or several phases."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode

from common.batch import RENDERED, BatchedEnv, SingleEnv, Training, check_options, numeric, refuse_autoreset
from common.errors import BadInput, refuse_unless
from common.flying import fly_until_ended
from common.integration import falling_root
from phased.problem import LARGEST_SCORE, PROBLEMS, Phase, Problem

# The observed target moves to the new waypoint over these first steps of a phase. The number is the paper's. That it
# moves linearly is our choice.
TRANSITION_STEPS = 5


@dataclass(frozen=True)
class PhasedTraining(Training):
    """What a training of a small problem hands over. The defaults are the paper's reward."""

    radius_scale: float = numeric(1.0)  # factor on the radii in which the reward pays the bonus
    # distance beyond these radii over which the bonus falls linearly to 0 (0: a step)
    bonus_width: float = numeric(0.0)
    # of the draws of each number of a start, the share that lies at the ends of its range
    start_ends: float = numeric(0.0, high=0.9)
    # how far below 0 a constraint must stay: what is above costs
    constraint_margin: float = numeric(0.0)


class PhasedVectorEnv(BatchedEnv):
    """N copies of a `Problem`: the double integrator and Van der Pol families, and problems of a user's own.

    Observation: with several phases the paper's o_t, Eq. (19), [x1, x2, x1_target, x2_target, tau, phi], with one phase
    [x1, x2, tau], which is our choice. tau = t / T, and phi is the 0-based phase over (phases - 1). The observed target
    moves to a new waypoint over the first `TRANSITION_STEPS` of its phase.

    Action: u, clipped to the set of controls. A vector whose norm has a lower bound keeps its direction. A zero vector
    then points along the last axis.

    Reward: the paper's r_t, Eq. (15) and (18), -(dx'Q dx + R u^2), where dx is the distance to the phase's target
    before the step. A phase's last step adds -Qf |dx|^2 + B 1[|dx| <= r] with dx after the step. So an episode's
    rewards sum to bonus - J. Eq. (6) multiplies the running cost by the length of a step; these two do not, and neither
    do we. The paper prints r_t for one phase and target 0. A reward for each phase is our extension, and so are the
    functions and bounds of a table (`Problem`). The end of the horizon is `terminated`, because the time is observed.

    If a phase ends by its event, the step ends at that moment, and its weights count in proportion to its length. The
    next phase begins at the same moment. With events tau is the time over the longest possible one.

    `final_info`:

    - `episodic_return` (N,), with the true radii
    - `cost` (N,) and its parts `cost_state`, `cost_control`, `cost_terminal` (N,), or those of `Problem.parts`
    - `hit` and `terminal_error` (N, phases): the distance to the target at each phase's end, in radii for an ellipse;
      conditions count in it
    - with events `final_time` (N,) in s, and `arrived` (N,): whether every phase with an `end` ended by it
    - with constraints `constraint_max` (N,): the largest value of any of them on the way
    - with scores or noise `draw` (N, `Problem.drawn`)

    `observe_phase=False` shows tau and phi as 0, and `observe_velocity=False` the velocities. `observe_draw` adds the
    standard scores to the observation. With `scaled_action`, which our scripts use, an action of 0 is the middle of the
    set of controls, and an action of 1 is `Problem.u_unit` more. With `step` it is sinh(1) as much
    (`Problem.control_of`).

    `reset(options={"x0": x})` sets the starts x (N, n). `{"draw": z}` sets the scores and the numbers of every
    step, z (N, `Problem.drawn`). `{"training": {...}}` hands over fields of `PhasedTraining`. Raises BadInput for
    anything else.
    """

    metadata = {**BatchedEnv.metadata, **RENDERED}
    training = PhasedTraining()

    def __init__(
        self,
        problem: Problem,
        num_envs: int = 1,
        observe_phase: bool = True,
        observe_velocity: bool = True,
        observe_draw: bool = False,
        scaled_action: bool = False,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    ):
        self.problem = problem
        self.observe_phase = observe_phase
        self.observe_velocity = observe_velocity
        self.observe_draw = observe_draw
        self.scaled_action = scaled_action
        allowed = "needs `velocities` in the table, the states that it hides"
        refuse_unless(observe_velocity or problem.hidden_velocities, "observe_velocity", observe_velocity, allowed)
        allowed = "needs `scores` in the table, which it shows"
        refuse_unless(problem.scores or not observe_draw, "observe_draw", observe_draw, allowed)
        action_box = problem.scaled(problem.u_box) if scaled_action else problem.u_box
        spaces = Box(*self._observation_box(), dtype=np.float64), Box(*action_box, dtype=np.float64)
        super().__init__(num_envs, problem.steps, *spaces, render_mode, autoreset_mode)
        self._tabulate()
        self.observation_scale = self._scale_of_observations()
        self.x = tuple(np.zeros(num_envs) for _ in range(problem.states))
        # the last applied control: (N,), or (N, m) if the table has a tuple of controls
        self.u = np.zeros((num_envs, problem.controls) if isinstance(problem.u_max, tuple) else num_envs)
        self.time = np.zeros(num_envs)  # s
        self.draw = np.zeros((num_envs, problem.drawn))
        self._parameters = problem.hidden(self.draw)
        self._phase = np.zeros(num_envs, dtype=np.int64)
        self._step_in_phase = np.zeros(num_envs, dtype=np.int64)
        self._costs = {part: np.zeros(num_envs) for part in problem.parts}
        self._bonus = np.zeros(num_envs)
        self._constraint_max = np.full(num_envs, -np.inf)
        self._arrived = np.ones(num_envs, dtype=bool)
        self._terminal_error = np.zeros((num_envs, len(problem.phases)))

    def _observation_box(self):
        """The least and the greatest observation."""
        problem = self.problem
        high = [*problem.x_max]
        low = [-bound for bound in high]
        if problem.waypoints:
            for component in zip(*map(problem.targets_of, problem.phases)):
                largest = max(abs(target or 0.0) for target in component)
                high.append(largest or 1.0)  # a box must have a width, even if all targets are 0
                low.append(-high[-1])
        clocks = 2 if problem.waypoints else 1
        high += [1.0] * clocks
        low += [0.0] * clocks
        scores = problem.scores if self.observe_draw else 0
        high += [LARGEST_SCORE] * scores
        low += [-LARGEST_SCORE] * scores
        return np.array(low), np.array(high)

    def _scale_of_observations(self):
        """A usual size of each observation: the table's for states and targets, and 1 for the rest."""
        scale = np.ones(self.single_observation_space.shape)
        n = self.problem.states
        scale[:n] = self.problem.scale
        if self.problem.waypoints:
            scale[n : 2 * n] = self.problem.scale
        return scale

    @property
    def dt(self) -> float:
        """The step in s."""
        return self.problem.dt

    @property
    def phase(self) -> np.ndarray:
        """The 0-based phase (N,) of the running steps. After the last step it is the last phase."""
        return np.minimum(self._phase, len(self.problem.phases) - 1)

    @property
    def goals(self) -> list[float]:
        """Radii, bonuses, bounds and prices of the table, and its targets, conditions and constraints at one state."""
        problem = self.problem
        radii = [np.ravel(phase.radius) for phase in problem.phases]
        bonuses = [phase.bonus for phase in problem.phases]
        prices = [problem.bound_price, problem.constraint_price]
        x = tuple(problem.scale[:, None])
        u = problem.as_control(problem.u_unit[:, None])
        p = problem.hidden(np.zeros((1, problem.drawn)))
        values = [*problem.constraints_at(x, u, p)]
        for phase in problem.phases:
            values += problem.misses(phase, x, p)
        return [
            *np.concatenate(radii),
            *bonuses,
            *problem.limits.ravel(),
            *prices,
            *np.ravel(np.hstack(values or [0.0])),
        ]

    def _tabulate(self):
        """Make the tables by phase, of which `_phase` picks a row."""
        problem = self.problem
        phases = problem.phases
        self._steps = np.array([phase.steps for phase in phases])
        self._target = np.array([problem.aim_of(phase) for phase in phases])  # (phases, n)
        self._Q = np.array([problem.state_weights(phase) for phase in phases])
        self._R = np.array([problem.control_weights(phase) for phase in phases])
        self._low, self._high = problem.u_box[:, :, None]
        self._limits = problem.limits[:, :, None]
        self._hidden = () if self.observe_velocity else problem.hidden_velocities
        self._has_events = problem.has_events
        # the observed target by phase and step in the phase, up to TRANSITION_STEPS
        blend = np.minimum(np.arange(TRANSITION_STEPS + 1) / TRANSITION_STEPS, 1.0)[:, None]
        before = self._target[[max(k - 1, 0) for k in range(len(phases))]]
        self._seen_target = np.stack([(1 - blend) * old + blend * new for old, new in zip(before, self._target)])
        self._moves = [(k, phase) for k, phase in enumerate(phases) if phase.end is not None]
        self._alike = len({(phase.f, phase.running) for phase in phases}) == 1  # all phases have the same dynamics

    def _start(self, mask, options):
        problem, count = self.problem, int(mask.sum())
        self.refuse_options(options, ["x0", "draw"] if problem.drawn else ["x0"])
        draw = self.draw[mask]
        if problem.drawn:
            draw = self._draw_starts(lambda n: problem.draws(self.np_random, n), count)
        if "draw" in options:
            draw = self.rows_of(options, "draw", problem.drawn)[mask]
        if "x0" in options:
            x0 = self.rows_of(options, "x0", problem.states)[mask]
        elif callable(problem.x0):
            x0 = np.column_stack([np.broadcast_to(x, count) for x in problem.x0(problem.scores_of(draw))])
        else:
            at_ends = self.training.start_ends
            x0 = self._draw_starts(lambda n: problem.starts_in_box(self.np_random, n, at_ends), count)
        for component, start in zip(self.x, x0.T):
            component[mask] = start
        self.draw[mask] = draw
        for parameter, drawn in zip(self._parameters, problem.hidden(draw)):
            parameter[mask] = drawn
        for part in self._costs.values():
            part[mask] = 0.0
        for array in (self.time, self._bonus, self._terminal_error):
            array[mask] = 0.0
        self._constraint_max[mask] = -np.inf
        self._arrived[mask] = True
        self._phase[mask] = 0
        self._step_in_phase[mask] = 0

    def _observe(self):
        """The paper's o_t of the running steps."""
        problem = self.problem
        phase = self.phase
        columns = [x * 0.0 if k in self._hidden else x for k, x in enumerate(self.x)]
        if problem.waypoints:
            running = np.where(self._phase == phase, self._step_in_phase, TRANSITION_STEPS)
            columns.append(self._seen_target[phase, np.minimum(running, TRANSITION_STEPS)])
        share = self.time / (problem.steps * problem.dt) if self._has_events else self.t / problem.steps
        columns.append(np.minimum(share, 1.0) * self.observe_phase)
        if problem.waypoints:
            columns.append(phase / (len(problem.phases) - 1) * self.observe_phase)
        if self.observe_draw:
            columns.append(self.draw[:, : problem.scores])
        return np.column_stack(columns)

    def _applied(self, actions):
        """The controls (m, N) that actions (N, m) apply."""
        problem = self.problem
        u = (problem.control_of(actions) if self.scaled_action else actions).T
        if problem.u_norm is None:
            return np.clip(u, self._low, self._high)
        norm = np.sqrt((u * u).sum(axis=0))
        upward = np.zeros_like(u)
        upward[-1] = 1.0
        direction = np.where(norm > 0, u / np.where(norm > 0, norm, 1.0), upward)
        return direction * np.clip(norm, *problem.u_norm)

    def _advance(self, actions):
        problem = self.problem
        u = self._applied(actions)
        before, phase = self.x, self.phase
        length = np.full(self.num_envs, problem.dt)
        controls = problem.as_control(u)
        with np.errstate(over="ignore", invalid="ignore"):  # what diverges is refused below
            self.x, *cost = self._fly(before, controls, phase, problem.dt)
        cost = [np.zeros(self.num_envs) + value for value in cost]  # a table's `running` may be one number for all
        if self._has_events:
            has_ended = self._phase >= len(problem.phases)  # ended in an earlier step and not reset, so it stays
            self.x = tuple(np.where(has_ended, x, after) for x, after in zip(before, self.x))
        ends = self._step_in_phase + 1 == self._steps[phase]
        for k, event in self._moves:
            met = self._end_by_event(k, event, before, controls, cost, length)
            self._arrived &= met | ~ends | (self._phase != k)
            ends = ends | met
        self._refuse_divergence()
        running, excess, worst = cost
        self._constraint_max = np.maximum(self._constraint_max, worst)
        costs = self._step_costs(before, u, running, excess, length, phase)
        for part, cost in costs.items():
            self._costs[part] += cost
        rewards = -sum(costs.values(), np.zeros(self.num_envs))
        self.u = u.T.copy() if isinstance(problem.u_max, tuple) else u[0]
        self.t = self.t + 1
        self.time = self.time + length
        self._step_in_phase += 1
        if ends.any():
            rewards += self._end_phase(np.flatnonzero(ends))
        return rewards, self._phase >= len(problem.phases), self._final_info

    def _refuse_divergence(self):
        """Raise BadInput that names the first state that is not finite after this step."""
        x = np.array(self.x)
        is_finite = np.isfinite(x)
        if is_finite.all():
            return
        bad = int(np.argmin(is_finite.all(axis=0)))
        k = int(np.argmin(is_finite[:, bad]))
        name = self.problem.x_names[k] if self.problem.x_names else f"x{k + 1}"
        raise BadInput(
            f"the state {name} of {self.problem.env_id} is {x[k, bad]} after step {self.t[bad]} of env {bad}; "
            "it must be finite: the dynamics diverge"
        )

    def _noise(self):
        """The numbers w that this step draws, a tuple of arrays (N,)."""
        if not self.problem.noise:
            return ()
        return self.problem.noise_of(self.draw, np.minimum(self.t, self.problem.steps - 1))

    def _fly(self, x, u, phase, h):
        """What `flown` returns, by the phase of each environment."""
        problem, phases, margin = self.problem, self.problem.phases, self.training.constraint_margin
        if self._alike or (phase == phase[0]).all():
            return flown(problem, phases[phase[0]], x, u, self._parameters, h, self._noise(), margin)
        after = np.empty((problem.states, self.num_envs))
        cost, excess, worst = np.zeros((3, self.num_envs))
        for k in np.unique(phase):
            there = phase == k
            *_, fly = self._view(there, phases[k], x, u)
            after[:, there], cost[there], excess[there], worst[there] = fly(h)
        return tuple(after), cost, excess, worst

    def _end_by_event(self, k, phase: Phase, before, u, cost, length):
        """The environments (N,) in phase k whose event falls through 0 in this step. Puts them where it does."""
        problem = self.problem
        event = problem.with_parameters(phase.end, self._parameters)
        begin = np.zeros(self.num_envs) + event(before)
        end = np.zeros(self.num_envs) + event(self.x)
        falls = (self._phase == k) & (begin > 0)
        until = np.full(self.num_envs, problem.dt)  # s, a time when the event is below 0
        dips = np.flatnonzero(falls & (end > 0))
        if len(dips):
            lowest, value = self._dip(dips, phase, before, u, begin[dips], end[dips])
            until[dips], end[dips] = lowest, value
        met = falls & (end <= 0)
        there = np.flatnonzero(met)
        if len(there):
            _, _, of_event, fly = self._view(there, phase, before, u)
            h = falling_root(lambda h: of_event(fly(h)[0]), begin[there], end[there], until[there])
            x, *at_event = fly(h)
            for component, value in zip([*self.x, *cost], [*x, *at_event]):
                component[there] = value
            length[there] = h
        return met

    def _view(self, there, phase: Phase, before, u):
        """For the environments `there`, a mask or indices: f(x), states at the begin, event(x), fly(h) by `flown`."""
        problem = self.problem
        x, p, w = (tuple(value[there] for value in values) for values in (before, self._parameters, self._noise()))
        u = tuple(value[there] for value in u) if isinstance(u, tuple) else u[there]
        f = problem.with_parameters(phase.f or problem.f, p)
        event = problem.with_parameters(phase.end, p)
        margin = self.training.constraint_margin
        return lambda x: f(x, u), x, event, lambda h: flown(problem, phase, x, u, p, h, w, margin)

    def _dip(self, there, phase: Phase, before, u, begin, end):
        """The times (n,) in s at which the event is least in this step, and its values there.

        The event is above 0 at both ends of the step. A soft touchdown is such a dip: its thrust, held for the rest of
        the step, would lift off again. The time is that of the least value of the cubic through both ends with the
        event's slopes. It is looked for only if the event falls at the begin and rises at the end.
        """
        dt = self.problem.dt
        f, x, event, fly = self._view(there, phase, before, u)
        after = tuple(component[there] for component in self.x)
        slope, slope_after = (dt * slope_along(event, y, f(y)) for y in (x, after))
        turns = np.flatnonzero((slope < 0) & (slope_after > 0))
        lowest = np.full(len(there), dt)
        value = end.copy()
        if len(turns):
            m0, m1 = slope[turns], slope_after[turns]
            g0, g1 = begin[turns], end[turns]
            a = 6 * (g0 - g1) + 3 * (m0 + m1)
            b = 6 * (g1 - g0) - 4 * m0 - 2 * m1
            share = -2 * m0 / (b + np.sqrt(b * b - 4 * a * m0))
            lowest[turns] = dt * np.clip(share, 0.0, 1.0)
            _, _, event, fly = self._view(there[turns], phase, before, u)
            value[turns] = event(fly(lowest[turns])[0])
        return lowest, value

    def _step_costs(self, before, u, running, excess, length, phase) -> dict:
        """The parts of the cost that a step adds, (N,) each."""
        problem, costs = self.problem, {}
        if "state" in self._costs:
            share = length / problem.dt if self._has_events else 1.0
            d = [x - target for x, target in zip(before, self._target[phase].T)]
            costs["state"] = share * sum(q * di * di for q, di in zip(self._Q[phase].T, d))
            costs["control"] = share * sum(r * ui * ui for r, ui in zip(self._R[phase].T, u))
        if "running" in self._costs:
            costs["running"] = running
        if "bounds" in self._costs:
            low, high = self._limits
            x = np.array(self.x)
            beyond = np.maximum(np.maximum(low - x, x - high), 0.0)
            costs["bounds"] = problem.bound_price * (beyond / problem.scale[:, None]).sum(axis=0) * length
        if "constraints" in self._costs:
            costs["constraints"] = problem.constraint_price * excess
        return costs

    def _end_phase(self, ending):
        """Add the terminal cost and bonus of the environments `ending`, whose phase ends. Returns their reward (N,)."""
        rewards = np.zeros(self.num_envs)
        phases = self.problem.phases
        of_phase = self.phase[ending]
        for k in np.unique(of_phase):
            some = ending[of_phase == k]
            x, p = (tuple(value[some] for value in values) for values in (self.x, self._parameters))
            scale = self.training.radius_scale
            cost, error, radius = end_of_phase(self.problem, phases[k], x, p)
            self._terminal_error[some, k] = error
            self._costs["terminal"][some] += cost
            self._bonus[some] += phases[k].bonus * (error <= radius)
            share = error <= scale * radius
            width = self.training.bonus_width
            if width and phases[k].has_circle:
                share = np.clip(1 - (error - scale * radius) / width, 0, 1)
            rewards[some] = -cost + phases[k].bonus * share
        self._phase[ending] += 1
        self._step_in_phase[ending] = 0
        return rewards

    def _final_info(self):
        parts = {f"cost_{part}": cost.copy() for part, cost in self._costs.items()}
        cost = sum(parts.values(), np.zeros(self.num_envs))
        error = self._terminal_error.copy()
        hit = error <= [phase.circle_radius for phase in self.problem.phases]
        info = {"episodic_return": self._bonus - cost, "cost": cost, **parts, "hit": hit, "terminal_error": error}
        if self.problem.constraints:
            info["constraint_max"] = self._constraint_max.copy()
        if self._has_events:
            info["final_time"] = self.time.copy()
            info["arrived"] = self._arrived.copy()
        if self.problem.drawn:
            info["draw"] = self.draw.copy()
        return info

    def _snapshot(self):
        controls = self.u if self.u.ndim == 2 else self.u[:, None]
        return self.time.copy(), controls, np.column_stack(self.x)

    def _make_sheet(self):
        # only a picture should wait the quarter of a second that Matplotlib takes to load
        from phased.animation import sheet_of

        return sheet_of(self.problem)


def flown(problem: Problem, phase: Phase, x, u, p, h, w=(), margin=0.0) -> tuple:
    """(x, running, excess, worst) of a step of h seconds: `Problem.advance` and `Problem.violation`."""
    after, running, points = problem.advance(phase, x, u, p, h, w)
    return after, running, *problem.violation(x, points, u, p, h, margin)


def end_of_phase(problem: Problem, phase: Phase, x, p):
    """Terminal cost (n,), distance to the target (n,), and the radius that it must not exceed, for states x at the end.

    The distance is in radii if each state has its own radius.
    """
    d = problem.distances(phase, x)
    distance = np.hypot.reduce(np.array(d), axis=0) if d else np.zeros_like(x[0])
    cost = phase.Qf * distance**2
    if phase.terminal is not None:
        cost = cost + problem.with_parameters(phase.terminal, p)(x)
    return cost, problem.circle_distance(phase, x, p), phase.circle_radius


def slope_along(event: Callable, x, dx) -> np.ndarray:
    """The change of event(x) in a second along the derivatives dx, by a difference quotient."""
    small = 1e-6
    ahead = event(tuple(xi + small * di for xi, di in zip(x, dx)))
    return (ahead - event(x)) / small


class PhasedEnv(SingleEnv):
    """One flight of `PhasedVectorEnv`."""


def make_phased_vector(env_id: str, num_envs: int = 1, **options) -> PhasedVectorEnv:
    """The batched environment of a problem in `PROBLEMS`. `gymnasium.make_vec` calls it."""
    check_options(PhasedVectorEnv, options)
    return PhasedVectorEnv(PROBLEMS[env_id], num_envs, **options)


def make_phased(env_id: str, **options) -> PhasedEnv:
    """The single environment of a problem in `PROBLEMS`. `gymnasium.make` calls it."""
    refuse_autoreset(options)
    return PhasedEnv(make_phased_vector(env_id, **options))


def fly(env_id: str, policy: Callable, x0, draw=None, **options) -> dict:
    """Fly `policy(obs (n, obs), t) -> action (n, m)` from each start x0 (n, states), and record the flights.

    draw (n, `Problem.drawn`) are the standard scores and the numbers of every step, if the table has any; all 0 unless
    given.

    Returns x (n, T+1, states), the applied (clipped) u (n, T), or (n, T, m) if the table has a tuple of controls,
    reward (n, T), and the arrays of `final_info`. After an episode's end x and u are NaN, and rewards are 0.
    """
    batch: Any = gym.make_vec(env_id, num_envs=len(x0), **options)  # a PhasedVectorEnv
    problem = batch.problem
    n, T = len(x0), problem.steps
    x = np.full((n, T + 1, problem.states), np.nan)
    u = np.full((T, *batch.u.shape), np.nan)
    reward = np.zeros((n, T))
    options = {"x0": x0}
    if problem.drawn:
        options["draw"] = np.zeros((n, problem.drawn)) if draw is None else draw
    obs, _ = batch.reset(options=options)
    x[:, 0] = np.column_stack(batch.x)  # not from obs, where the velocity may be hidden

    def record(step):
        x[step.flew, step.t + 1] = np.column_stack(batch.x)[step.flew]
        u[step.t, step.flew] = batch.u[step.flew]
        reward[step.flew, step.t] = step.reward[step.flew]

    final = fly_until_ended(batch, policy, obs, record)
    return {"x": x, "u": np.moveaxis(u, 0, 1), "reward": reward, **final}


make_phased.metadata = RENDERED  # gym.make looks here before there is an environment
