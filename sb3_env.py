"""The batched environments in Stable-Baselines3's own vector interface: quicker than a DummyVecEnv of single ones.

    pip install -r benchmarks/requirements.txt

    import gymnasium as gym
    from sb3_env import NativeVecEnv
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

    batch = gym.make_vec("RocketAscentCutoff-v0", num_envs=32, action_frame="local")
    PPO("MlpPolicy", VecNormalize(VecMonitor(NativeVecEnv(batch)), gamma=1.0)).learn(1_000_000)

`benchmarks.sb3_ppo` measures it, and alone in the project imports it. It is for users of that library, whose
`make_vec_env` and `DummyVecEnv` take the single environments as they are.
"""

from __future__ import annotations

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

import envs


class NativeVecEnv(VecEnv):
    """A `BatchedEnv` as a VecEnv. Observations are float32, as that library's networks want them.

    The last step of an episode has in its info, besides that library's `terminal_observation`, what `final_info` holds.
    The copies are one object: attributes and methods are the batch's, whatever `indices` says.
    """

    def __init__(self, batch: envs.BatchedEnv):
        self.batch = getattr(batch, "unwrapped", batch)
        mode = self.batch.metadata["autoreset_mode"]
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"the batch's autoreset_mode is {mode.value!r}; it must be 'SameStep', the default")
        super().__init__(batch.num_envs, batch.single_observation_space, batch.single_action_space)

    def reset(self):
        """Start every copy anew, the first time after them with the seed of `seed()` and `set_options()`; (N, obs).

        The options are the batch's, of all copies at once.
        """
        obs, _ = self.batch.reset(seed=self._seeds[0], options=self._options[0])
        self._reset_seeds()
        self._reset_options()
        return obs.astype(np.float32)

    def step_async(self, actions):
        """Keep the actions (N, act) for `step_wait`."""
        self.actions = actions

    def step_wait(self):
        """Observations (N, obs), rewards (N,), dones (N,), and N infos."""
        obs, rewards, terminated, _, info = self.batch.step(self.actions)
        infos = [{} for _ in range(self.num_envs)]
        for k in np.flatnonzero(terminated):
            infos[k] = {key: value[k] for key, value in info["final_info"].items() if not key.startswith("_")}
            infos[k]["terminal_observation"] = info["final_obs"][k].astype(np.float32)
            infos[k]["TimeLimit.truncated"] = False
        return obs.astype(np.float32), rewards, terminated, infos

    def get_images(self):
        """A frame of each copy, uint8 (H, W, 3), for VecVideoRecorder."""
        return list(self.batch.render())

    def close(self):
        """Nothing is open."""

    def get_attr(self, attr_name, indices=None):
        """The batch's attribute, once a copy; AttributeError if it has none."""
        return [getattr(self.batch, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name, value, indices=None):
        """Set the batch's attribute: for all copies."""
        setattr(self.batch, attr_name, value)

    def env_method(self, method_name, *args, indices=None, **kwargs):
        """Call the batch's method once; its result, once a copy."""
        return [getattr(self.batch, method_name)(*args, **kwargs)] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class, indices=None):
        """No copy is wrapped."""
        return [False] * len(list(self._get_indices(indices)))
