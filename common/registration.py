"""Gymnasium's registry: how our ids become known to it, and which other ids it has."""

from __future__ import annotations

import sys
from collections.abc import Container, Iterator, Mapping

import gymnasium as gym
from gymnasium.envs.registration import ENV_ID_RE, EnvSpec

from common.errors import BadInput

REMARKS: dict[str, list[str]] = {}  # by environment id: lines about the file that registered it, until they are said


def say_remarks(env_id: str):
    """Print the lines about the file of an id on stderr, once."""
    for line in REMARKS.pop(env_id, []):
        print(line, file=sys.stderr, flush=True)


def register(env_id: str, maker: str, replaceable: Container[str] = ()):
    """Make an environment id known to Gymnasium. An id among `replaceable` is registered anew.

    The functions `maker` and `maker`_vector of `envs.py` make the environment and its batch from the id. They are
    imported when they are called. They are named by way of `envs`, so that a process that knows only the spec gets all
    tables.

    Raises BadInput if another environment has the id, or if it is not in Gymnasium's form.
    """
    allowed = f"env_id is {env_id!r}; it must be a new id such as Mine-v0"
    is_new = env_id not in gym.registry or env_id in replaceable
    if not is_new or not ENV_ID_RE.fullmatch(env_id) or "/" in env_id:
        raise BadInput(allowed)
    gym.registry.pop(env_id, None)
    REMARKS.pop(env_id, None)
    try:
        gym.register(
            id=env_id,
            entry_point=f"envs:{maker}",
            vector_entry_point=f"envs:{maker}_vector",
            kwargs={"env_id": env_id},
        )
    except gym.error.Error as error:  # the name of another environment without its version
        raise BadInput(f"{allowed}: {error}") from error


class RegisteredIds(Mapping[str, EnvSpec]):
    """The specs by id of all that was registered with a `vector_entry_point`, but for some.

    A view of Gymnasium's registry: an id that is registered later is in it, too.
    """

    def __init__(self, *others: Mapping):
        self.others = others  # tables of the other families

    def _is_of_ours(self, spec: EnvSpec) -> bool:
        entry = spec.vector_entry_point
        module = entry if isinstance(entry, str) else getattr(entry, "__module__", "")
        known = any(spec.id in tables for tables in self.others)
        return entry is not None and not module.startswith("gymnasium.") and not known

    def __getitem__(self, env_id: str) -> EnvSpec:
        spec = gym.registry[env_id]
        if not self._is_of_ours(spec):
            raise KeyError(env_id)
        return spec

    def __iter__(self) -> Iterator[str]:
        return (env_id for env_id, spec in list(gym.registry.items()) if self._is_of_ours(spec))

    def __len__(self) -> int:
        return sum(1 for _ in self)
