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
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import envs  # noqa: E402
import evaluate  # noqa: E402
from sb3_env import NativeVecEnv  # noqa: E402

PARTS = 10  # evaluated after each tenth of the samples


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
