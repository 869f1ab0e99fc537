"""Which ids are of this family: what is registered with Gymnasium beside its own environments and our tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec


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
