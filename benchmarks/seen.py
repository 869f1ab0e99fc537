"""How far dispersed flights differ from the nominal one, and how much of their miss these differences predict.

    python benchmarks/seen.py results/rocket_dispersed/agent.safetensors

Flies the mean action on 341 draws. Every 100 s, and 40 and 10 s before the first flight ends, it prints the standard
deviation of each of the eight differences, in the units of `DIFFERENCES`. A vehicle whose flights differ by far more or
less needs other units. Beside it is the part of the variance of each element's final miss that is a linear function of
the differences (R squared).
"""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from attention import load  # noqa: E402

from common.errors import BadInput  # noqa: E402
from rocket.metrics import draws, element_misses, fly_dispersed  # noqa: E402

SCRIPT = importlib.import_module("ppo_gtrxl_rocket")
FLIGHTS = 341
NAMES = ("h, three components", "e, three components", "log mass", "angle")


def fly(agent, args, options, n):
    """n dispersed flights of the mean action: observed (T, n, obs), steps flown (n,), final misses by element (n,)."""
    environment = gym.make_vec(args.env_id, num_envs=1, **options)
    seen = []
    policy = agent.make_policy(environment.episode_steps)
    rocket = environment.rocket

    def recorded(obs, t):
        seen.append(obs.copy())
        return policy(obs, t)

    z = draws(rocket, args.dispersion, args.eval_seed, n)
    ends = fly_dispersed(args.env_id, recorded, z, **options)
    flown = np.ceil(ends["final_t"] / rocket.dt - 1e-9).astype(int)
    return torch.tensor(np.stack(seen), dtype=torch.float32), flown, element_misses(ends, rocket)


def explained(inputs, y):
    """R squared of the linear fit of y (n,) by inputs (n, k) and a constant."""
    columns = np.column_stack([np.ones(len(y)), inputs])
    left = y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]
    return 1 - left.var() / y.var()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoint", help="agent.safetensors of a rocket trained with --dispersion")
    path = parser.parse_args().checkpoint
    try:
        agent, args, options = load(path)
    except BadInput as error:
        sys.exit(f"error: {error}")
    if not args.dispersion:
        sys.exit(f"error: checkpoint {path}: its dispersion is 0; it must be of a rocket trained with --dispersion")
    obs, flown, misses = fly(agent, args, options, FLIGHTS)
    misses = {key.rsplit("_", 1)[0]: miss for key, miss in misses.items() if key != "apogee_km"}
    dt = gym.make(args.env_id).unwrapped.batch.dt
    last = int(flown.min())
    late = [last - round(seconds / dt) for seconds in (40, 10)]
    print("standard deviations of the differences, in their sizes:", ", ".join(NAMES))
    print("and R squared of the final misses by the differences:", ", ".join(misses))
    period = round(100 / dt)
    for t in [*range(period, late[0], period), *late]:
        differences = SCRIPT.features(agent, obs[t])[:, -len(SCRIPT.DIFFERENCES) :].numpy()
        spread = " ".join(f"{size:5.2f}" for size in differences.std(axis=0))
        shares = (f"{explained(differences, y):5.2f}" for y in misses.values())
        print(f"{dt * t:5.0f} s   {spread}   " + "   ".join(shares))


if __name__ == "__main__":
    main()
