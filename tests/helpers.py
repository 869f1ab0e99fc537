"""What several test files use: a tiny network, checked arguments; a task's table, title and figures."""

import json

import gymnasium as gym
import safetensors.torch
import torch

import runs
from common.flags import plain_args
from common.tasks import task_of

SMALL = {"embed_dim": 8, "num_heads": 2, "num_blocks": 1, "memory_length": 4, "mlp_dim": 12, "hidden_dim": 10}
NETWORK = [f"--{name.replace('_', '-')}={value}" for name, value in SMALL.items()]
TINY = [*NETWORK, "--num-envs=2", "--num-minibatches=2", "--update-epochs=2", "--eval-starts=10"]


def parse(script, *argv):
    """A script's checked arguments."""
    return runs.parse_args(script, list(map(str, argv)))[0]


def table_of(metrics):
    """The printed table of an evaluation."""
    return task_of(metrics["env_id"]).table(metrics)


def headline_of(metrics):
    """The title of an evaluation's figures."""
    return task_of(metrics["env_id"]).headline(metrics)


def figure_of(name, arrays, metrics, curves=()):
    """One of an evaluation's figures."""
    return task_of(metrics["env_id"]).figures(arrays, metrics, list(curves))[name]


def save(script, folder, **changes):
    """A run folder's agent.safetensors with random weights: what starts as a constant is moved away from it."""
    args = script.Args(**{**SMALL, "memory_length": 5, **changes})
    options = {name: getattr(args, name) for name in script.ENV_OPTIONS} | script.FIXED_OPTIONS
    torch.manual_seed(0)
    agent = script.Agent(args, gym.make_vec(args.env_id, num_envs=1, **options))
    with torch.no_grad():
        for parameter in agent.parameters():
            parameter += 0.3 * torch.randn_like(parameter)
    counters = dict.fromkeys(["seed", "total_updates", "global_step", "training_seconds", "wall_seconds"], "1")
    metadata = {"env_id": args.env_id, "args": json.dumps(plain_args(args)), **counters}
    safetensors.torch.save_file(agent.state_dict(), folder / "agent.safetensors", metadata)
    return agent, args, options
