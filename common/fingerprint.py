"""What an environment does, as a short JSON of numbers. It tells an edited problem from the one that was trained."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from common.batch import BatchedEnv, make_batch
from common.errors import BadInput

KEY = "environment_fingerprint"  # in training_state.pt, in the metadata of agent.safetensors and in eval.json
SEED = 2**31 + 1
PAIRS = 4  # of flights
SHOWN = 2  # flights of which the first and the last observation are kept
PARTS = 4  # of an episode, whose rewards are summed
PLACES = (0.3, 0.7, 0.51)  # of actions in their box: low, high, and a little beside the middle
NUDGE = 1e-12  # of the width of the box, by which the actions of a pair differ: more than processors' rounding


def fingerprint(env_id: str, **env_options) -> str | None:
    """The JSON of what an environment does with these options. Its keys are words for a message.

    None if the environment fails, or if it is random beyond its seed. A class of a user's own may be so.
    """
    try:
        first = flown(make_batch(env_id, 2 * PAIRS, **env_options))
        again = flown(make_batch(env_id, 2 * PAIRS, **env_options), steps=3)
        if not all(np.array_equal(one, other) for one, other in zip(first["seen"], again["seen"])):
            return None
        return json.dumps({"options": env_options, **numbers_of(first)})
    except Exception:  # such a class may fail in any way, which must not end its training
        return None


def changes(stored: str, env_id: str) -> str | None:
    """What has changed in an environment since its fingerprint was `stored`, in words. None if nothing has.

    Raises BadInput if `stored` is no fingerprint.
    """
    try:
        old = json.loads(stored)
        now = fingerprint(env_id, **old["options"])
        new = old if now is None else json.loads(now)
        changed = [name for name in old if name != "options" and differs(old[name], new[name])]
    except (KeyError, TypeError, ValueError) as error:
        raise BadInput(f"{KEY} is {stored!r}; it must be the JSON of an environment ({error})") from error
    return ", ".join(changed) or None


def differs(old: list, new: list) -> bool:
    """Whether two lists of numbers differ by more than the rounding of processors. None stands for any number."""
    if len(old) != len(new):
        return True
    one, other = (np.array(numbers, dtype=float) for numbers in (old, new))  # None becomes NaN
    known = ~np.isnan(one) & ~np.isnan(other)
    return not np.allclose(one[known], other[known], rtol=1e-6, atol=1e-8)


def flown(batch: BatchedEnv, steps: int | None = None) -> dict[str, Any]:
    """Fly whole episodes, or their first steps, from the starts of SEED, and record them.

    The flights 2k and 2k + 1 are a pair: they have one start, and their actions differ by NUDGE.
    """
    obs, _ = batch.reset(seed=SEED, options={"training": {"flights_per_start": 2}})
    flew = np.ones(len(obs), dtype=bool)
    last = obs.copy()
    length = np.zeros(len(obs))
    rewards = np.full((batch.episode_steps, len(obs)), np.nan)
    seen = [obs]  # up to the third step
    flight = {"batch": batch, "obs": obs, "last": last, "length": length, "rewards": rewards, "seen": seen}
    for t in range(steps or batch.episode_steps):
        actions = actions_at(batch, t)
        actions[~flew] = actions[np.argmax(flew)]  # which still flies, so the next episode does not end at once, too
        try:
            obs, reward, ended, _ = batch.advance(actions)
        except Exception:  # such actions may let a state diverge; what was flown before tells enough
            last[flew] = np.nan
            length[flew] = np.nan
            break
        last[flew] = obs[flew]
        length += flew
        rewards[t] = np.where(flew, reward, 0.0)
        if t < 3:
            seen += [obs, reward]
        flew = flew & ~ended
        if not flew.any():
            rewards[t + 1 :] = 0.0
            break
        if ended.any():
            batch.restart(ended)
    return flight


def actions_at(batch: BatchedEnv, t: int) -> np.ndarray:
    """The actions (n, m) of step t. A pair moves one action to its high or low place; every second pair alternates."""
    low, high = action_box(batch)
    flight = np.arange(batch.num_envs)
    pair = flight // 2
    place = np.full((len(flight), len(low)), PLACES[2])
    is_high = (pair % 2 == 0) | (t % 2 == 1)
    place[flight, pair // 2 % len(low)] = np.where(is_high, PLACES[1], PLACES[0])
    place += NUDGE * (flight % 2)[:, None] * np.arange(1, len(low) + 1)
    return low + place * (high - low)


def action_box(batch: BatchedEnv) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest actions (m,). An action without a bound is held between -1 and 1."""
    box = batch.single_action_space
    return np.where(np.isfinite(box.low), box.low, -1.0), np.where(np.isfinite(box.high), box.high, 1.0)


def numbers_of(flight: dict[str, Any]) -> dict[str, list]:
    """{words: numbers} of a record of `flown`.

    A number is None if a pair's flights differ in it, as after a chaotic motion. Processors would differ, too. If all
    pairs differ from the beginning on, because an environment draws starts or noise for each flight, no number is None.
    """
    batch = flight["batch"]
    are_pairs = not any(np.isnan(of_pairs(numbers)).any() for numbers in flight["seen"])
    sums = np.stack([part.sum(axis=0) for part in np.array_split(flight["rewards"], PARTS)], axis=1)
    numbers = {
        "action limits": np.concatenate(action_box(batch)),
        "start states": of_pairs(flight["obs"], are_pairs)[:SHOWN],
        "number of steps": of_pairs(flight["length"], are_pairs),
        "rewards": of_pairs(sums, are_pairs),
        "final states": of_pairs(flight["last"], are_pairs)[:SHOWN],
        "goals": np.array(batch.goals, dtype=float),
    }
    numbers["number of steps"] = np.append(numbers["number of steps"], batch.episode_steps)
    return {name: listed(values) for name, values in numbers.items()}


def of_pairs(values: np.ndarray, is_checked: bool = True) -> np.ndarray:
    """The numbers of each pair's first flight, with NaN where the second differs if `is_checked`."""
    first, second = values[::2], values[1::2]
    steady = np.isclose(first, second, rtol=1e-7, atol=1e-9)
    return np.where(steady, first, np.nan) if is_checked else first


def listed(values: np.ndarray) -> list[float | None]:
    """The numbers with nine digits, None for one that is not finite."""
    return [float(f"{value:.9g}") if np.isfinite(value) else None for value in values.ravel()]
