"""Environment steps a second on one core: N environments in one native batch against a Python loop over single ones.

    python benchmarks/env_speed.py [--num-envs 128] [--seconds 1]

It prints the best of three runs of each.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import baselines  # noqa: E402, F401 - makes every id known
from common.command_line import OneLineParser, integer  # noqa: E402
from common.tasks import env_ids, task_of  # noqa: E402


def steps_per_second(env, action, steps, seconds):
    """Environment steps a second of `env.step(action)`, which flies `steps` of them; the best of three runs."""
    best = 0.0
    for _ in range(3):
        calls, start = 0, time.perf_counter()
        while time.perf_counter() - start < seconds / 3:
            terminated = env.step(action)[2]
            if steps == 1 and terminated:
                env.reset()
            calls += 1
        best = max(best, calls * steps / (time.perf_counter() - start))
    return best


def main():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("--num-envs", type=integer(1, 10**6), default=128)
    parser.add_argument("--seconds", type=integer(1, 3600), default=1)
    args = parser.parse_args()
    print(f"{'id':35} {'batch of ' + str(args.num_envs):>14} {'single':>10}   steps/s on one core")
    for env_id in env_ids():
        for label, options, action in task_of(env_id).speed_cases():
            batch = gym.make_vec(env_id, num_envs=args.num_envs, **options)
            single = gym.make(env_id, **options)
            rates = []
            for env, steps in ((batch, args.num_envs), (single, 1)):
                env.reset(seed=0)
                env.action_space.seed(0)
                flown = env.action_space.sample() if action is None else np.broadcast_to(action, env.action_space.shape)
                rates.append(steps_per_second(env, flown, steps, args.seconds))
            print(f"{env_id + label:35} {rates[0]:14,.0f} {rates[1]:10,.0f}")


if __name__ == "__main__":
    main()
