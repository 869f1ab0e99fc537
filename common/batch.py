"""What every environment shares: the batch of N flights, and the single environment as a view of a batch of one."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from common.errors import BadInput, refuse_unless

RENDERED = {"render_modes": ["rgb_array"], "render_fps": 15}
AUTORESET_MODES = (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP)


class Sealed:
    """An environment that takes no attribute which it does not have: a misspelt one would do nothing, silently."""

    _is_sealed = False

    def sealed(self):
        """This environment, from here on without new public attributes."""
        self._is_sealed = True
        return self

    def __setattr__(self, name, value):
        if self._is_sealed and not name.startswith("_") and not hasattr(self, name):
            known = [other for other in dir(self) if not other.startswith("_")]
            near = difflib.get_close_matches(name, known, n=1)
            meant = f"; did you mean {near[0]!r}?" if near else ""
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}{meant}")
        super().__setattr__(name, value)


class BatchedEnv(Sealed, VectorEnv):
    """What every problem shares: step counters, checks of the action, and autoreset.

    With `autoreset_mode` "SameStep", the default, an episode that ends is followed by the next one's first observation
    in the same step; its own last values are `final_obs` and `final_info`. With "NextStep", as some of Gymnasium's
    vector wrappers expect it, that step returns the episode's last observation and, in the info, its last values. The
    step after it ignores that environment's action and returns the next episode's first observation, with reward 0.
    https://farama.org/Vector-Autoreset-Mode

    A problem gives the spaces, `episode_steps` (the longest episode) and three methods:
    `_start(mask, options)` puts the environments in `mask` at a start, `_observe()` returns (N, obs) float64, and
    `_advance(actions)` flies one step and returns `(rewards (N,), terminated (N,), final)`, where `final()` gives the
    `final_info` arrays of the finished episodes; it is only called when there is one. One that can be rendered has
    `RENDERED` in its `metadata` and two more: `_snapshot()` returns time (N,) s, the control of the step before (N, m)
    and state (N, n), arrays of their own; `_make_sheet()` returns the drawing, whose `frame(t, u, y)` is a flight's
    picture.

    Every problem has more attributes: `dt`, the step in s (1 unless given); `phase` (N,), the 0-based phase in which
    the running steps begin (0 unless given); and `observation_scale`, a usual size of each observation (1 unless
    given), by which the networks of our scripts divide it.

    With the attribute `flights_per_start` G, to be set before a `reset` and only in training, environment k flies start
    k // G, so that flights differ by their actions alone (1: each flies its own start; the last group is smaller where
    G does not divide N). A dispersed rocket's start is its vehicle and air; of two groups the second has the first
    one's draw, its signs changed (antithetic variates). This is promised of the episodes that begin at a `reset`, and
    our scripts train on no others: an autoreset groups the environments that ended in its step, whatever their k.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
    single_observation_space: Box
    single_action_space: Box
    _start: Callable  # the problem's
    _observe: Callable
    _advance: Callable
    _snapshot: Callable
    _make_sheet: Callable

    def __init__(
        self,
        num_envs: int,
        episode_steps: int,
        single_observation_space: Box,
        single_action_space: Box,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    ):
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}; it must be at least 1")
        if autoreset_mode not in [*AUTORESET_MODES, *(mode.value for mode in AUTORESET_MODES)]:
            allowed = " or ".join(repr(mode.value) for mode in AUTORESET_MODES)
            raise ValueError(f"autoreset_mode is {autoreset_mode!r}; it must be {allowed}")
        self.metadata = {**self.metadata, "autoreset_mode": AutoresetMode(autoreset_mode)}
        self._waiting = np.zeros(num_envs, dtype=bool)  # with NextStep: whose episode ended in the step before
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
        self.flights_per_start = 1
        self.observation_scale = np.ones(single_observation_space.shape)
        self.has_circles = False  # True: `radius_scale` and `bonus_width` of the small problems can be set
        self._was_reset = False

    @property
    def dt(self) -> float:
        """The step in s."""
        return 1.0

    @property
    def generators(self) -> dict[str, np.random.Generator]:
        """The streams of random numbers, by name: a resumed training puts the states of all of them back."""
        return {"envs": self.np_random}

    @property
    def phase(self) -> np.ndarray:
        """The 0-based phase (N,) of the running steps."""
        return np.zeros(self.num_envs, dtype=np.int64)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start every environment anew; returns (N, obs) float64 and an empty info."""
        super().reset(seed=seed)
        self._restart(np.ones(self.num_envs, dtype=bool), options)
        self._waiting[:] = False
        self._was_reset = True
        return self._observe(), {}

    def step(self, actions):
        """Fly one step and restart what ended, in this step or, with `autoreset_mode` "NextStep", in the next one."""
        if self.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP:
            return self._step_and_wait(actions)
        obs, rewards, terminated, final = self.advance(actions)
        info = {}
        if terminated.any():
            final_info = {**final, **{f"_{key}": terminated.copy() for key in final}}
            info = {"final_obs": obs, "_final_obs": terminated.copy()}
            info |= {"final_info": final_info, "_final_info": terminated.copy()}
            self._restart(terminated, None)
            obs = self._observe()
        return obs, rewards, terminated, np.zeros(self.num_envs, dtype=bool), info

    def _step_and_wait(self, actions):
        """`step` with autoreset in the next step."""
        begins = self._waiting.copy()
        if begins.any():
            self._restart(begins, None)  # they are flown along, and put back to a start behind that
            if np.shape(actions) == self.action_space.shape:
                actions = np.where(begins[:, None], 1.0, actions)
        obs, rewards, terminated, final = self.advance(actions)
        if begins.any():
            self._restart(begins, None)
            obs = self._observe()
            rewards = np.where(begins, 0.0, rewards)
        terminated = terminated & ~begins
        self._waiting = terminated
        info = {}
        if terminated.any():
            info = {**final, **{f"_{key}": terminated.copy() for key in final}}
        return obs, rewards, terminated.copy(), np.zeros(self.num_envs, dtype=bool), info

    def __getstate__(self):
        return {**self.__dict__, "_sheet": None}  # a drawing cannot be copied, and is made anew

    def advance(self, actions):
        """Fly one step without autoreset: `(obs, rewards, terminated, final_info)`.

        BadInput names a bad action; ResetNeeded where there was no reset yet.
        """
        if not self._was_reset:
            raise ResetNeeded("no episode is running: call reset() first")
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
        self._sheet = self._sheet or self._make_sheet()
        columns = [[np.array(column) for column in zip(*trail)] for trail in self._trails]
        return tuple(self._sheet.frame(t, u[1:], y) for t, u, y in columns)

    def _draw_starts(self, draw, count):
        """Starts (count, k) of episodes that begin together, each `flights_per_start` in a row; `draw(n)` draws n.

        At a `reset`, where all begin, row k is environment k's.
        """
        group = self.flights_per_start
        if not (isinstance(group, int | np.integer) and group >= 1):
            raise ValueError(f"flights_per_start is {group!r}; it must be a whole number of at least 1")
        return np.repeat(draw(-(-count // group)), group, axis=0)[:count]  # rounded up

    def _restart(self, mask, options):
        self._start(mask, options or {})  # first: it may refuse the options
        self.t[mask] = 0
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


class SingleEnv(Sealed, gym.Env):
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
        for name in ("draw", "noise"):
            if options and name in options:
                options = {**options, name: [options[name]]}
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
        frames = self.batch.render()
        return frames[0] if frames else None


def of_batch(name: str, doc: str) -> property:
    """A property of a single environment that is its batch's."""
    return property(lambda env: getattr(env.batch, name), lambda env, value: setattr(env.batch, name, value), doc=doc)


def check_options(environment: type, options: dict, *others: str):
    """BadInput for an option that is neither of an environment's constructor nor among the `others`."""
    given_otherwise = ("num_envs", "problem", "mission")
    taken = [name for name in inspect.signature(environment).parameters if name not in given_otherwise]
    allowed = [*taken, *others]
    for name, value in options.items():
        refuse_unless(name in allowed, f"the option {name}", repr(value), f"must be one of {', '.join(allowed)}")


def refuse_autoreset(options: dict):
    """BadInput where a single environment is asked for an autoreset: it has none."""
    mode = options.get("autoreset_mode")
    allowed = "must not be given: a single environment is reset by its user; use gym.make_vec"
    refuse_unless(mode is None, "autoreset_mode", repr(mode), allowed)


def make_batch(env_id: str, num_envs: int, **env_options) -> BatchedEnv:
    """N environments of an id, with those options that it takes.

    Raises BadInput where it is not derived from `BatchedEnv`, or an option that it does not take would hide something.
    """
    entry: Any = gym.spec(env_id).vector_entry_point
    taken = inspect.signature(load_env_creator(entry) if isinstance(entry, str) else entry).parameters
    takes_all = any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in taken.values())
    for name, value in env_options.items():
        refuse_unless(value or takes_all or name in taken, name, value, f"is no option of {env_id}; leave it out")
    envs = gym.make_vec(env_id, num_envs, **{k: v for k, v in env_options.items() if takes_all or k in taken})
    if not isinstance(envs.unwrapped, BatchedEnv):
        raise BadInput(f"env_id is {env_id!r}; its vector_entry_point must make an environment derived from BatchedEnv")
    return envs.unwrapped
