"""A trained policy in this process, as `--eval-only` reads it."""

from __future__ import annotations

import importlib
from pathlib import Path

import gymnasium as gym

import runs
from common.checkpoints import read_checkpoint
from common.errors import refuse_unless

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = [importlib.import_module(path.stem) for path in sorted(ROOT.glob("ppo_gtrxl_*.py"))]


def script_of(env_id):
    """The script that trains an id, or None."""
    return next((script for script in SCRIPTS if env_id in script.ENV_IDS), None)


def environment_options(script, args):
    """The constructor keywords of a script's environments, by its arguments."""
    return {name: getattr(args, name) for name in script.ENV_OPTIONS} | script.FIXED_OPTIONS


def load(checkpoint):
    """The agent of an agent.safetensors, its script's arguments, and the options of its environments."""
    env_id = read_checkpoint(checkpoint)["args"]["env_id"]
    script = script_of(env_id)
    refuse_unless(script, f"env_id of {checkpoint}", env_id, "must be one that a script trains")
    argv = ["--eval-only", "--checkpoint", str(checkpoint)]
    args, saved = runs.parse_args(script, argv)
    args.dispersion = saved["args"].get("dispersion", 0.0)
    options = environment_options(script, args)
    agent = script.Agent(args, gym.make_vec(env_id, num_envs=1, **options))
    runs.load_checkpoint(agent, args, saved)
    return agent, args, options
