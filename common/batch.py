"""The base of all environments: the batch of N flights, and the single environment as a view of a batch of one."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from common.errors import BadInput, BadOption, is_finite, refuse_unless

RENDERED = {"render_modes": ["rgb_array"], "render_fps": 15}
AUTORESET_MODES = (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED)


def numeric(default, low: float = 0.0, high: float = np.inf):
    """A field of `Training` that is a finite number from low to high. If `default` is None, it may be None, too."""

    def fits(value):
        if value is None:
            return default is None
        return is_finite(value) and low <= value <= high

    allowed = f"must be a number from {low:g} to {high:g}" if high < np.inf else f"must be a number of at least {low:g}"
    return checked(default, fits, allowed)


def checked(default, fits: Callable, allowed: str):
    """A field of `Training` for whose values `fits` is true. `allowed` says so in words."""
    return field(default=default, metadata={"fits": fits, "allowed": allowed})


def switch() -> Any:
    """A field of `Training` that is off unless a training turns it on."""
    return checked(False, lambda value: isinstance(value, bool), "must be True or False")


def is_group(size) -> bool:
    """Whether `size` is a number of flights."""
    return isinstance(size, int | np.integer) and bool(size >= 1)


@dataclass(frozen=True)
class Training:
    """What a training hands over to its environments, and no evaluation does. The defaults are what evaluations fly.

    Raises BadInput for a value that cannot be.
    """

    flights_per_start: int = checked(1, is_group, "must be a whole number of at least 1")  # flights of each start

    def __post_init__(self):
        for each in fields(self):
            value = getattr(self, each.name)
            fits = each.metadata["fits"](value)
            refuse_unless(fits, f"training's {each.name}", repr(value), each.metadata["allowed"])


def refuse_assignment(env, name: str, batch: BatchedEnv):
    """Raise AttributeError for an attribute whose assignment would do nothing, or not all that it should."""
    if name in batch.set_when_made:
        raise AttributeError(f"{name} of {type(env).__name__} is set when it is made; make another one with {name}=...")
    if name in vars(batch.training) and not hasattr(env, name):
        handed_over = f"reset(options={{'training': {{{name!r}: ...}}}})"
        raise AttributeError(
            f"{type(env).__name__} has no attribute {name!r}; a training hands it over by {handed_over}"
        )


class BatchedEnv(VectorEnv):
    """The base of every problem's batch: step counters, checks of the action, and autoreset.

    With `autoreset_mode` "SameStep", the default, the step in which an episode ends returns the next episode's first
    observation. The ended episode's last values are `final_obs` and `final_info`. Some of Gymnasium's vector wrappers
    expect "NextStep". Then that step returns the episode's last observation, and its last values in the info. The next
    step ignores that environment's action and returns the next episode's first observation, with reward 0. With
    "Disabled" the user starts ended episodes by `reset(options={"reset_mask": mask})`, mask (N,) of bool, which leaves
    the other environments as they are. All modes take a mask.
    https://farama.org/Vector-Autoreset-Mode

    A problem gives the spaces, `episode_steps` (of the longest episode) and three methods:

    - `_start(mask, options)` puts the environments in `mask` (N,) at a start
    - `_observe()` returns (N, obs) float64
    - `_advance(actions)` flies one step, adds 1 to `self.t` (N,), the steps flown, and returns `(rewards (N,),
      terminated (N,), final)`; `final()` gives the `final_info` arrays (N, ...) of the finished episodes, among them
      `episodic_return`, and is called only if there are any

    A problem that can be rendered has `RENDERED` in its `metadata` and two more methods:

    - `_snapshot()` returns new arrays: time (N,) in s, the last control (N, m) and state (N, n)
    - `_make_sheet()` returns the drawing, whose `frame(t, u, y)` is a flight's picture

    Every problem has five attributes with a default: `dt`, the step in s (1); `phase` (N,), the 0-based phase in which
    the running steps begin (0); `observation_scale`, a usual size of each observation (1), by which the networks of our
    scripts divide the observation; `generators`, its streams of random numbers, which a resume restores; and `goals`,
    numbers that few flights show (none).

    `reset(options={"training": {name: value}})` hands over what only a training changes. The names are the fields of
    `Training` or of the problem's own kind of it. The values stand in `self.training` and hold until the next `reset`.
    A reset without them flies what evaluations fly.

    With `flights_per_start` G environment k flies start k // G, so the flights of a group differ only by their actions.
    With 1 each environment flies its own start. The last group is smaller if G does not divide N. A dispersed rocket's
    start is its vehicle and air, and every second group has the draw of the group before it with the signs changed
    (antithetic variates). This holds for the episodes that begin at a `reset`, and our scripts train only on these. An
    autoreset groups the environments that ended in the same step, in their order.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
    training = Training()  # a problem with a kind of its own has it here, with the values that evaluations fly
    set_when_made: tuple[str, ...] = ()  # the constructor's options that cannot be assigned later
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
            allowed = ", ".join(repr(mode.value) for mode in AUTORESET_MODES)
            raise ValueError(f"autoreset_mode is {autoreset_mode!r}; it must be one of {allowed}")
        self.metadata = {**self.metadata, "autoreset_mode": AutoresetMode(autoreset_mode)}
        self._waiting = np.zeros(num_envs, dtype=bool)  # but with SameStep: the episodes that have ended
        if render_mode not in (None, *self.metadata["render_modes"]):
            allowed = ", ".join(["None", *self.metadata["render_modes"]])
            wrong = ValueError if self.metadata["render_modes"] else TypeError  # Stable-Baselines3 then asks for none
            raise wrong(f"render_mode is {render_mode!r}; it must be one of {allowed}")
        self.render_mode, self._sheet = render_mode, None
        self._trails = [[] for _ in range(num_envs)]  # the records of the running episodes, only with a render mode
        self.num_envs, self.episode_steps = num_envs, episode_steps
        self.single_observation_space = single_observation_space
        self.single_action_space = single_action_space
        self.observation_space = batch_space(single_observation_space, num_envs)
        self.action_space = batch_space(single_action_space, num_envs)
        self.t = np.zeros(num_envs, dtype=np.int64)  # steps flown in the running episode
        self.observation_scale = np.ones(single_observation_space.shape)
        self._was_reset = False

    def __setattr__(self, name, value):
        if "_was_reset" in self.__dict__:  # it is made whole; options of the constructor may have a training's names
            refuse_assignment(self, name, self)
        super().__setattr__(name, value)

    @property
    def dt(self) -> float:
        """The step in s."""
        return 1.0

    @property
    def generators(self) -> dict[str, np.random.Generator]:
        """The streams of random numbers, by name. A resumed training restores the states of all of them."""
        return {"envs": self.np_random}

    @property
    def phase(self) -> np.ndarray:
        """The 0-based phase (N,) of the running steps."""
        return np.zeros(self.num_envs, dtype=np.int64)

    @property
    def goals(self) -> list[float]:
        """Numbers of the table that a few flights need not show, such as the radius of a circle that they miss."""
        return []

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: dict | None = None):
        """Start all environments anew, or those of `options["reset_mask"]`. Returns (N, obs) float64 and an empty info.

        With one seed for each environment, environment k starts where a single environment starts with seed k. Later
        starts come from the first seed's stream.
        """
        options = dict(options or {})
        mask = self._mask_of(options.pop("reset_mask", None))
        seeds = self._seeds_of(seed)
        before = vars(self.training)
        self.hand_over(options.pop("training", {} if mask.all() else before))
        try:
            if seeds is None:
                super().reset(seed=seed)  # pyright: ignore[reportArgumentType] - one number or None
                self._restart(mask, options)
            else:
                self._restart_each(mask, options, seeds)
        except BadInput:
            self.hand_over(before)
            raise
        self._waiting[mask] = False
        self._was_reset = True
        return self._observe(), {}

    def _mask_of(self, given) -> np.ndarray:
        """The environments (N,) that a reset starts anew, by its option `reset_mask`."""
        if given is None:
            return np.ones(self.num_envs, dtype=bool)
        fits = isinstance(given, np.ndarray) and given.dtype == bool and given.shape == (self.num_envs,)
        allowed = f"must be an array of bool, of shape ({self.num_envs},), with a True"
        refuse_unless(fits and given.any(), "options['reset_mask']", repr(given), allowed)
        if not (self._was_reset or given.all()):
            raise ResetNeeded("some episodes have never begun: call reset() without a reset_mask first")
        return given.copy()

    def _seeds_of(self, given) -> list[int | None] | None:
        """One seed for each environment, or None if `given` is one seed for all of them."""
        if not isinstance(given, list | tuple | np.ndarray):
            return None
        seeds = [int(seed) if isinstance(seed, np.integer) else seed for seed in given]
        are_seeds = all(seed is None or (isinstance(seed, int) and seed >= 0) for seed in seeds)
        fits = len(seeds) == self.num_envs and are_seeds
        refuse_unless(fits, "seed", repr(given), f"must be one whole number, or {self.num_envs} of them")
        return seeds

    def _restart_each(self, mask, options, seeds):
        """Start each environment in `mask` by its own seed. One without a seed starts by the batch's stream."""
        stream = self.np_random
        streams = [stream if seed is None else seeding.np_random(seed)[0] for seed in seeds]
        for k in np.flatnonzero(mask):
            self._np_random = streams[k]
            self._restart(np.arange(self.num_envs) == k, options)
        self._np_random = streams[0]

    def refuse_options(self, options: dict, known: list[str], none: str = "there are none"):
        """Raise BadInput if a reset has an option that is not among these. `none` says why none is known."""
        if options.keys() - set(known):
            names = " and ".join(map(repr, known))
            allowed = f"the only one is {names}" if len(known) == 1 else f"they may be {names}"
            if not known:
                allowed = none
            raise BadInput(f"reset options are {options!r}; {allowed}")

    def rows_of(self, options: dict, name: str, width: int, holds: Callable = np.isfinite, allowed: str = "finite"):
        """An option of a reset as an array (N, width) of finite numbers. BadInput unless `holds` is true of all."""
        given = options[name]
        rows = as_numbers(given)
        if rows.shape != (self.num_envs, width) or not (np.isfinite(rows) & holds(rows)).all():
            raise BadInput(f"options[{name!r}] must be {allowed}, of shape ({self.num_envs}, {width}); got {given!r}")
        return rows

    def setting(self, name: str):
        """What the training hands over by this name, or else this environment's attribute of the same name."""
        handed_over = getattr(self.training, name)
        return getattr(self, name) if handed_over is None else handed_over

    def hand_over(self, training: dict):
        """Take what a training hands over from here on. What it does not name is as in evaluations.

        `reset` calls it. A learner that goes on without a reset, such as Stable-Baselines3's, calls it itself. Raises
        BadInput for an unknown name or a bad value.
        """
        kind = type(self.training)
        names = [each.name for each in fields(kind)]
        refuse_unless(isinstance(training, dict), "options['training']", repr(training), "must be a dictionary")
        for name, value in training.items():
            refuse_unless(name in names, f"training's {name}", repr(value), f"must be one of {', '.join(names)}")
        self.training = kind(**training)

    def step(self, actions):
        """Fly one step. Ended episodes restart in this step, unless `autoreset_mode` is "NextStep" or "Disabled"."""
        mode = self.metadata["autoreset_mode"]
        if mode is AutoresetMode.NEXT_STEP:
            return self._step_and_wait(actions)
        if mode is AutoresetMode.DISABLED:
            return self._step_and_stay(actions)
        obs, rewards, terminated, final = self.advance(actions)
        info = {}
        if terminated.any():
            final_info = {**final, **{f"_{key}": terminated.copy() for key in final}}
            info = {"final_obs": obs, "_final_obs": terminated.copy()}
            info |= {"final_info": final_info, "_final_info": terminated.copy()}
            obs = self.restart(terminated)
        return obs, rewards, terminated, np.zeros(self.num_envs, dtype=bool), info

    def _step_and_wait(self, actions):
        """`step` with autoreset in the next step."""
        begins = self._waiting.copy()
        if begins.any():
            self._restart(begins, None)  # they fly this step with the others, and are put back to a start after it
            if np.shape(actions) == self.action_space.shape:
                actions = np.where(begins[:, None], 1.0, actions)
        obs, rewards, terminated, final = self.advance(actions)
        if begins.any():
            obs = self.restart(begins)
            rewards = np.where(begins, 0.0, rewards)
        terminated = terminated & ~begins
        return self._waiting_for(terminated, obs, rewards, final)

    def _step_and_stay(self, actions):
        """`step` without autoreset."""
        if self._waiting.any():
            ended = np.flatnonzero(self._waiting).tolist()
            raise ResetNeeded(f"the episodes of envs {ended} have ended: call reset(options={{'reset_mask': mask}})")
        obs, rewards, terminated, final = self.advance(actions)
        return self._waiting_for(terminated, obs, rewards, final)

    def _waiting_for(self, terminated, obs, rewards, final):
        """What a step returns after which the `terminated` episodes wait for a start."""
        self._waiting = terminated
        info = {}
        if terminated.any():
            info = {**final, **{f"_{key}": terminated.copy() for key in final}}
        return obs, rewards, terminated.copy(), np.zeros(self.num_envs, dtype=bool), info

    def __getstate__(self):
        return {**self.__dict__, "_sheet": None}  # a drawing cannot be copied, so the copy makes its own

    def advance(self, actions):
        """Fly one step without autoreset: `(obs, rewards, terminated, final_info)`.

        Raises BadInput for a bad action, and ResetNeeded before the first reset.
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

    def restart(self, mask):
        """Start the environments in `mask` (N,) anew. Returns the observations (N, obs) of all."""
        self._restart(mask, None)
        return self._observe()

    def render(self):
        """The running episodes so far, a tuple of N frames, uint8 (H, W, 3). Without a render mode a warning and None.

        With autoreset in the same step, an episode that has just ended is already the next one.
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
        """Starts (count, k) of episodes that begin together. Each is repeated `flights_per_start` times in a row.

        `draw(n)` draws n starts. At a `reset`, when all episodes begin, row k is that of environment k.
        """
        group = self.training.flights_per_start
        return np.repeat(draw(-(-count // group)), group, axis=0)[:count]  # rounded up

    def _restart(self, mask, options):
        self._start(mask, options or {})  # comes first, because it may refuse the options
        self.t[mask] = 0
        if self.render_mode is not None:
            for k in np.flatnonzero(mask):
                self._trails[k] = []
            self._record(mask)

    def _record(self, mask):
        """Add time, last control and state to the trails of the environments in `mask`."""
        time, control, state = self._snapshot()
        for k in np.flatnonzero(mask):
            self._trails[k].append((time[k], control[k], state[k]))


def as_numbers(given) -> np.ndarray:
    """An option of a reset as a new array in float64. It is empty if the option has no numbers."""
    try:
        return np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(0)


def warn_of_no_mode(env):
    """Gymnasium's usual warning for a call of `render` without a render mode."""
    env_id = env.spec.id if env.spec else "id"
    gym.logger.warn(
        "You are calling render method without specifying any render mode. You can specify the render_mode at "
        f'initialization, e.g. gym.make("{env_id}", render_mode="rgb_array")'
    )


class SingleEnv(gym.Env):
    """One environment: a thin view of a batch of one (`batch`), without its autoreset.

    A step before a reset, or after an episode's end, raises `gymnasium.error.ResetNeeded`.
    """

    def __init__(self, batch: BatchedEnv):
        self.batch, self.render_mode = batch, batch.render_mode
        self.metadata = {key: value for key, value in batch.metadata.items() if key != "autoreset_mode"}
        self._running = False  # from a reset to the end of its episode
        self.observation_space = batch.single_observation_space
        self.action_space = batch.single_action_space

    def __setattr__(self, name, value):
        if name != "batch":
            refuse_assignment(self, name, self.batch)
        super().__setattr__(name, value)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start anew. Returns the observation and an empty info. `options` are the batch's without their first axis."""
        super().reset(seed=seed)
        self._running = False  # stays so if the options are refused
        for name in ("x0", "draw", "noise", "target"):
            if options and name in options:
                options = {**options, name: [options[name]]}
        obs, info = self.batch.reset(seed=seed, options=options)
        self._running = True
        return obs[0], info

    def step(self, action):
        """Fly one step. The last step's info has the entries of the batch's `final_info`."""
        if not self._running:
            raise ResetNeeded("no episode is running: call reset() first, and again after an episode has ended")
        obs, rewards, terminated, final = self.batch.advance(np.asarray(action)[None])
        self._running = not terminated[0]
        return obs[0], float(rewards[0]), bool(terminated[0]), False, {key: value[0] for key, value in final.items()}

    def render(self):
        """The episode so far, uint8 (H, W, 3). Without a render mode a warning and None."""
        if self.render_mode is None:
            warn_of_no_mode(self)
            return None
        frames = self.batch.render()
        return frames[0] if frames else None


def check_options(environment: type, options: dict, *others: str):
    """Raise BadOption for an option that is neither an argument of an environment's constructor nor in `others`.

    TorchRL looks for Python's own words in it.
    """
    given_otherwise = ("num_envs", "problem", "mission", "lander")
    taken = [name for name in inspect.signature(environment).parameters if name not in given_otherwise]
    allowed = [*taken, *others]
    for name, value in options.items():
        if name not in allowed:
            raise BadOption(f"unexpected keyword argument {name!r}, {value!r}; it must be one of {', '.join(allowed)}")


def refuse_autoreset(options: dict):
    """Raise BadInput if a single environment is asked for an autoreset, which it does not have."""
    mode = options.get("autoreset_mode")
    allowed = "must not be given: a single environment is reset by its user; use gym.make_vec"
    refuse_unless(mode is None, "autoreset_mode", repr(mode), allowed)


def make_batch(env_id: str, num_envs: int, **env_options) -> BatchedEnv:
    """N environments of an id, with the options that it takes. An option that is off may be one that it does not take.

    Raises BadInput for other options, and for an environment that is not derived from `BatchedEnv`.
    """
    entry: Any = gym.spec(env_id).vector_entry_point
    make = load_env_creator(entry) if isinstance(entry, str) else entry
    taken = inspect.signature(make).parameters
    takes_all = any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in taken.values())
    for name, value in env_options.items():
        refuse_unless(value or takes_all or name in taken, name, value, f"is no option of {env_id}; leave it out")
    envs = gym.make_vec(env_id, num_envs, **{k: v for k, v in env_options.items() if takes_all or k in taken})
    if not isinstance(envs.unwrapped, BatchedEnv):
        raise BadInput(f"env_id is {env_id!r}; its vector_entry_point must make an environment derived from BatchedEnv")
    return envs.unwrapped
