"""A policy's decision by onnxruntime and by torch: its time on one core, and the difference of the actions.

    python -m benchmarks.decision results/rocket_cutoff

Exports the policy and flies it once. Both decide on the same observations, and each has its own memory. torch decides
in float32, as evaluations do, and in float64, because features that are small differences of large numbers are rounded
in float32.
"""

from __future__ import annotations

import copy
import sys
import tempfile
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch

import evaluate
from benchmarks.policies import load
from common.command_line import OneLineParser
from common.flying import fly_until_ended
from common.tasks import task_of


class OnnxPolicy:
    """`policy(obs (n, obs), t) -> actions (n, actions)` of an exported model, on one core; at t = 0 a flight begins."""

    def __init__(self, path):
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        self.metadata = self.session.get_modelmeta().custom_metadata_map
        self.memory_shape = [given.shape for given in self.session.get_inputs() if given.name == "memory"]
        self.memory = None

    def __call__(self, obs, t):
        inputs = {"observation": obs}
        if self.memory_shape:
            if t == 0:
                (shape,) = self.memory_shape
                self.memory = np.zeros([len(obs) if size == "flights" else size for size in shape], dtype=np.float32)
            inputs["memory"] = self.memory
        action, *memory = self.session.run(None, inputs)
        if memory:
            self.memory = memory[0]
        return action


def compare(env_id: str, policies: dict, n: int = 1, **env_options):
    """Fly the first of `policies` on n flights and ask the others, too, on the same observations.

    Returns the median microseconds of a decision and the actions (T, n, actions), by policy. Actions after a flight's
    end are NaN.
    """
    envs = gym.make_vec(env_id, num_envs=n, **env_options)
    obs, _ = envs.reset(options=task_of(env_id).reset_options(0, n, **env_options))
    actions = {name: [] for name in policies}
    seconds = {name: [] for name in policies}
    first = next(iter(policies))

    def all_decide(obs, t):
        for name, policy in policies.items():
            begin = time.perf_counter()
            actions[name].append(policy(obs, t))
            seconds[name].append(time.perf_counter() - begin)
        return actions[first][-1]

    def record(step):
        for name in policies:
            actions[name][-1] = np.where(step.flew[:, None], actions[name][-1], np.nan)

    fly_until_ended(envs, all_decide, obs, record)
    microseconds = {name: 1e6 * float(np.median(values)) for name, values in seconds.items()}
    return microseconds, {name: np.array(rows) for name, rows in actions.items()}


def main():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="results/<name> or runs/...")
    folder = parser.parse_args().folder
    torch.set_num_threads(1)
    try:
        with tempfile.TemporaryDirectory() as name:
            path = Path(name) / "policy.onnx"
            evaluate.export(folder, {"onnx": path})
            onnx = OnnxPolicy(path)
        agent, args, options = load(folder / "agent.safetensors")
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")
    steps = gym.make_vec(args.env_id, num_envs=1, **options).episode_steps
    policies = {"torch": agent.make_policy(steps), "onnxruntime": onnx}
    policies["torch in float64"] = copy.deepcopy(agent).double().make_policy(steps)
    microseconds, actions = compare(args.env_id, policies, **options)
    for name in policies:
        off = np.nanmax(np.abs(actions[name] - actions["onnxruntime"]))
        print(f"  {name:<18}{microseconds[name]:8.0f} µs a decision, actions {off:.1e} from onnxruntime's")


if __name__ == "__main__":
    main()
