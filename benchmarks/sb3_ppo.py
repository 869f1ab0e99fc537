"""Stable-Baselines3's PPO, a feed-forward network, on the same environments and samples, evaluated by the same table.

    pip install -r benchmarks/requirements.txt
    python benchmarks/sb3_ppo.py --env-id DoubleIntegrator-v0 --samples 1200000
    python benchmarks/sb3_ppo.py --env-id RocketAscentCutoff-v0 --samples 5000000

Its own defaults (two layers of 64, learning rate 3e-4, 10 epochs of minibatches of 64, gamma 0.99, lambda 0.95) with
observations and rewards normalised by its VecNormalize, as its users do. Nothing of the environment is changed.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, VecNormalize

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import envs  # noqa: E402
import evaluate  # noqa: E402

PARTS = 10  # evaluated after each tenth of the samples


class NativeVecEnv(VecEnv):
    """A native batched environment in Stable-Baselines3's own vector interface."""

    def __init__(self, batch: envs.BatchedEnv):
        self.batch = batch
        super().__init__(batch.num_envs, batch.single_observation_space, batch.single_action_space)

    def reset(self):
        return self.batch.reset(seed=self._seeds[0])[0].astype(np.float32)

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        obs, rewards, terminated, _, info = self.batch.step(self.actions)
        infos = [{} for _ in range(self.num_envs)]
        for k in np.flatnonzero(terminated):
            infos[k] = {"terminal_observation": info["final_obs"][k].astype(np.float32), "TimeLimit.truncated": False}
        return obs.astype(np.float32), rewards, terminated, infos

    def close(self):
        pass

    def get_attr(self, name, indices=None):
        return [getattr(self.batch, name, None)] * self.num_envs

    def set_attr(self, name, value, indices=None):
        setattr(self.batch, name, value)

    def env_method(self, name, *args, indices=None, **kwargs):
        return [getattr(self.batch, name)(*args, **kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env-id", default="DoubleIntegrator-v0", choices=[*envs.PROBLEMS, *envs.ROCKETS])
    parser.add_argument("--samples", type=int, default=1_200_000)
    parser.add_argument("--num-envs", type=int, default=32)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(1)
    options = {"action_frame": "local"} if args.env_id in envs.ROCKETS else {}
    batch = gym.make_vec(args.env_id, num_envs=args.num_envs, **options)
    normalised = VecNormalize(VecMonitor(NativeVecEnv(batch)), gamma=0.99)
    model = PPO("MlpPolicy", normalised, n_steps=batch.episode_steps, seed=args.seed, device="cpu", verbose=0)
    headline, minutes = "error_norm" if args.env_id in envs.ROCKETS else "ratio_of_sums", 0.0

    def policy(obs, t):
        return model.predict(normalised.normalize_obs(obs.astype(np.float32)), deterministic=True)[0]

    for part in range(1, PARTS + 1):
        start = time.time()
        model.learn(max(0, args.samples * part // PARTS - model.num_timesteps), reset_num_timesteps=False)
        minutes += (time.time() - start) / 60
        metrics, _ = evaluate.evaluate(args.env_id, policy, 0, 1000, **options)
        print(f"{model.num_timesteps} samples, {minutes:.1f} min: {headline} {metrics.get(headline)}", flush=True)
    print(f"Stable-Baselines3 PPO, {model.num_timesteps} samples, seed {args.seed}, {minutes:.1f} min")
    print(evaluate.table(metrics))


if __name__ == "__main__":
    main()
