"""A small problem's script whose policy also sees time as a clock's hands. What is then left for the memory?

    python benchmarks/clock.py ppo_gtrxl_di.py --env-id DoubleIntegratorWaypoints-v0 --memory-length 0 --seed 1

The script's flags follow its name. All of them work, also --eval-only and --resume. In an episode of 100 steps tau,
time as a number from 0 to 1, changes by 0.01 in a step. Its sines and cosines change by up to 1. Only the policy's
input differs from the script's. The results are in results/memory/clock.
"""

from __future__ import annotations

import importlib
import math
import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import runs  # noqa: E402

SCRIPTS = ("ppo_gtrxl_di.py", "ppo_gtrxl_vdp.py")
TURNS = (1.0, 2.0, 4.0, 8.0, 16.0)  # of each hand, over an episode
TAU = {3: 2, 6: 4}  # its place in an observation of one phase, of several


def with_hands(features):
    """A script's `features`, then sin and cos of 2 pi k tau for k in TURNS: (..., inputs + 10)."""

    def seen(agent, obs):
        tau = obs[..., TAU[obs.shape[-1]], None]
        angle = 2 * math.pi * tau * torch.tensor(TURNS, dtype=obs.dtype, device=obs.device)
        return torch.cat([features(agent, obs), angle.sin(), angle.cos()], dim=-1)

    return seen


def main(argv):
    script, *flags = argv or [""]
    if script not in SCRIPTS:
        runs.fail(f"the script is {script!r}; it must be one of {', '.join(SCRIPTS)}")
    module = importlib.import_module(script.removesuffix(".py"))
    module.features = with_hands(module.features)
    sys.argv = [script, *flags]
    runs.start(module.main)


if __name__ == "__main__":
    main(sys.argv[1:])
