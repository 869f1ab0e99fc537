"""One step of a trained policy as an ONNX model, a program of its own; `exports.policy` runs it.

    python -m exports.onnx_model ppo_gtrxl_rocket results/rocket_cutoff/agent.safetensors policy.onnx

The script is loaded by its file's name. Its `features`, its agent and its weights are written to the model. The memory
is an input and an output of each step.
"""

from __future__ import annotations

import contextlib
import copy
import importlib
import json
import logging
import sys
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import nn

from common.batch import make_batch
from common.checkpoints import read_checkpoint
from common.errors import BadInput
from common.evaluations import sha256_of
from common.files import write_bytes
from common.tasks import task_of
from exports.offers import offer


class PolicyStep(nn.Module):
    """The mean action of one step.

    - inputs: `observation` (flights, obs) float64, and `memory` (blocks, 2, flights, heads, L, dk) float32
    - outputs: `action` (flights, actions) and `next_memory`, both float32

    The memory has the keys and values of the last L steps, the oldest first. It is zero before the first step, as in
    evaluations. A policy without blocks, or with L = 0, has no memory.

    The features are computed in float64, and the network in float32, in which it was trained. Some features are small
    differences of large numbers. In float32 each runtime would round them differently.
    """

    def __init__(self, agent, script):
        super().__init__()
        self.agent = agent
        self.features = script.features
        self.direct = script.past_the_blocks if getattr(agent, "direct", None) is not None else None
        self.in_float64 = copy.deepcopy(agent).double()  # the features read its buffers
        memory = agent.new_memory(1, noise=0.0)
        self.constants = [constants for _, *constants in agent.start_cache(memory, steps=0)]

    def forward(self, observation, memory=None):
        x = self.agent.encoder(self.features(self.in_float64, observation).float())
        next_memory = []
        for k, (block, (projections, R)) in enumerate(zip(self.agent.blocks, self.constants)):
            q, window = block.attention.project(x, projections)
            if memory is not None:
                window = torch.cat([memory[k], window], dim=3)  # (2, N, H, L + 1, dk)
            x = block(x, block.attention.attend(q, window, R))
            next_memory.append(window[:, :, :, 1:])
        if self.direct is not None:
            x = x + self.direct(self.in_float64, observation).float()
        action = self.agent.get_mean_action(x)
        return action if memory is None else (action, torch.stack(next_memory))


# ---------------------------------------------------------------------------------------------------------------------
# Operations that torch's exporter or onnxruntime lacks
# ---------------------------------------------------------------------------------------------------------------------


def translations():
    """Operations of the features that torch's exporter does not know, or that onnxruntime has only in float32."""
    from onnxscript import opset18  # pyright: ignore[reportMissingImports] - optional

    op: Any = opset18
    FLOAT, DOUBLE, INT64 = 1, 11, 7  # of TensorProto.DataType

    def searchsorted(sorted_sequence, self, *, out_int32=False, right=False, side=None, sorter=None):
        """The number of entries of a short table that are below each value."""
        values = op.Unsqueeze(self, [-1])
        is_below = op.LessOrEqual(sorted_sequence, values) if right else op.Less(sorted_sequence, values)
        return op.ReduceSum(op.Cast(is_below, to=INT64), [-1], keepdims=0)

    def atan2(self, other):
        """atan2 in float32, then one step of Newton's method in float64."""
        y, x = op.Cast(self, to=FLOAT), op.Cast(other, to=FLOAT)
        first = op.Atan(op.Div(y, x))
        half_turn = op.Where(op.Less(y, 0.0), -3.14159265, 3.14159265)
        first = op.Cast(op.Where(op.Less(x, 0.0), op.Add(first, half_turn), first), to=DOUBLE)
        sine, cosine = op.Sin(first), op.Cos(first)
        across = op.Sub(op.Mul(self, cosine), op.Mul(other, sine))
        along = op.Add(op.Mul(other, cosine), op.Mul(self, sine))
        return op.Add(first, op.Div(across, along))

    def asinh(self):
        size = op.Abs(self)
        root = op.Sqrt(op.Add(op.Mul(size, size), op.CastLike(1.0, size)))
        return op.Mul(op.Sign(self), op.Log(op.Add(size, root)))

    aten = torch.ops.aten
    return {aten.searchsorted.Tensor: searchsorted, aten.atan2.default: atan2, aten.asinh.default: asinh}


# ---------------------------------------------------------------------------------------------------------------------
# From a checkpoint to a model
# ---------------------------------------------------------------------------------------------------------------------


def load(script, checkpoint):
    """The agent of an agent.safetensors, its arguments, its environment's options and its environment.

    Raises BadInput if the file is damaged.
    """
    defaults = vars(script.Args())
    sizes = ("num_blocks", "embed_dim", "num_heads", "memory_length", "mlp_dim", "hidden_dim")
    kinds = {name: type(defaults[name]) for name in ("env_id", *sizes)}
    saved = read_checkpoint(checkpoint, kinds, script.ENV_IDS, defaults)
    args = script.Args(**{name: saved["args"][name] for name in defaults})
    options = {name: getattr(args, name) for name in script.ENV_OPTIONS} | script.FIXED_OPTIONS
    envs = make_batch(args.env_id, 1, **options)
    agent = script.Agent(args, envs)
    try:
        agent.load_state_dict({name: torch.from_numpy(array.copy()) for name, array in saved["tensors"].items()})
    except RuntimeError as error:
        why = "does not fit its own args; fly it by the version that trained it (CHANGELOG.md)"
        raise BadInput(f"{checkpoint}: {why}: {' '.join(str(error).split())}") from error
    return agent.eval(), args, options, envs


def export(script, checkpoint) -> Any:
    """The ONNX program of a policy, with its metadata."""
    agent, args, options, envs = load(script, checkpoint)
    names = ["observation"]
    shapes = {"observation": {0: torch.export.Dim("flights")}}
    inputs = [torch.ones(2, *envs.single_observation_space.shape, dtype=torch.float64)]
    outputs = ["action"]
    if args.num_blocks and args.memory_length:
        heads, dk = args.num_heads, args.embed_dim // args.num_heads
        inputs.append(torch.zeros(args.num_blocks, 2, 2, heads, args.memory_length, dk))
        names.append("memory")
        shapes["memory"] = {2: shapes["observation"][0]}
        outputs.append("next_memory")
    program = torch.onnx.export(
        PolicyStep(agent, script).eval(),
        tuple(inputs),
        dynamo=True,
        input_names=names,
        output_names=outputs,
        dynamic_shapes=shapes,
        custom_translation_table=translations(),
        verbose=False,
    )
    assert program is not None
    interface = offer(task_of(args.env_id), "interface")(**options)
    metadata = {
        "env_id": args.env_id,
        "checkpoint_sha256": sha256_of(checkpoint),
        "step_s": f"{envs.dt:g}",
        "steps": str(envs.episode_steps),
        "observation": json.dumps(interface.observation),
        "action": json.dumps(interface.action),
        "notes": interface.notes,
    }
    program.model.metadata_props.update(metadata)
    return program


def main(script_name, checkpoint, target):
    """Write the model of `checkpoint` to `target`. If that fails, end with one line on stderr and status 1."""
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)  # torch's exporter would name every missing optional package
    try:
        with contextlib.redirect_stdout(sys.stderr):
            program = export(importlib.import_module(script_name), checkpoint)
        write_bytes(target, program.model_proto.SerializeToString())
    except (BadInput, OSError) as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
