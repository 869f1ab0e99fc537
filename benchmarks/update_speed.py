"""Seconds of one rollout and of one PPO epoch at a script's default sizes, on one core.

    python benchmarks/update_speed.py [--script ppo_gtrxl_di] [--env-id DoubleIntegrator-v0] [--repeats 5]
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from pathlib import Path

import gymnasium as gym
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


def median_seconds(function, repeats):
    """Median wall-clock seconds of `repeats` calls after one that is not counted, and the last call's result."""
    seconds = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - start)
    return sorted(seconds[1:])[repeats // 2], result


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--script", default="ppo_gtrxl_di")
    parser.add_argument("--env-id", default=None)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    script = importlib.import_module(options.script)
    args = script.Args()
    args.env_id, args.target_kl = options.env_id or args.env_id, None
    epochs, args.update_epochs = args.update_epochs, 1
    torch.set_num_threads(1)
    torch.manual_seed(args.seed)
    env_options = {name: getattr(args, name) for name in script.ENV_OPTIONS}
    envs = gym.make_vec(args.env_id, num_envs=args.num_envs, **env_options)
    agent = script.Agent(args, envs)
    average = script.AveragedModel(agent, multi_avg_fn=script.get_ema_multi_avg_fn(args.weight_average))
    optimizer = torch.optim.Adam(agent.parameters(), lr=0.0, eps=1e-5, fused=True)
    fly = lambda: script.rollout(agent, envs, args.reward_scale, args.memory_noise)  # noqa: E731
    rollout_seconds, (batch, _) = median_seconds(fly, options.repeats)
    learn = lambda: script.update(agent, average, optimizer, batch, args)  # noqa: E731
    epoch_seconds, _ = median_seconds(learn, options.repeats)
    update_seconds = rollout_seconds + epochs * epoch_seconds
    print(f"{args.env_id}: {args.num_envs} episodes of {envs.episode_steps} steps, one core")
    share = rollout_seconds / update_seconds
    print(f"  rollout    {rollout_seconds:.3f} s, {share:.1%} of an update of {epochs} epochs")
    print(f"  PPO epoch  {epoch_seconds:.3f} s")
    print(f"  update     {update_seconds:.2f} s")


if __name__ == "__main__":
    main()
