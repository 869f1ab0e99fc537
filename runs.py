"""What surrounds the learning in the ppo_gtrxl_*.py scripts: arguments, files of a run, memory, processes.

Bad input ends with one line and exit status 1.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import io
import json
import os
import sys
import zipfile
from itertools import takewhile
from pathlib import Path
from typing import get_type_hints

import safetensors.torch
import torch
import torch.distributed as dist
import tyro

import evaluate

# ---------------------------------------------------------------------------------------------------------------------
# Arguments
# ---------------------------------------------------------------------------------------------------------------------

RANGES = {  # lowest and highest value of every numeric flag; NaN and infinity are outside
    **dict.fromkeys(["seed", "eval_seed", "num_threads", "eval_every"], (0, 2**31 - 1)),
    **dict.fromkeys(["total_updates", "num_envs", "num_minibatches", "update_epochs", "radius_curriculum"], (1, 10**6)),
    **dict.fromkeys(["embed_dim", "num_heads", "mlp_dim", "hidden_dim"], (1, 8192)),
    **dict.fromkeys(["learning_rate", "learning_rate_final", "clip_coef", "weight_average"], (0.0, 1.0)),
    **dict.fromkeys(["gamma", "gae_lambda", "gae_lambda_final", "memory_noise"], (0.0, 1.0)),
    **dict.fromkeys(["ent_coef", "ent_coef_final", "vf_coef", "mass_weight"], (0.0, 1e3)),
    **dict.fromkeys(["reward_scale", "max_grad_norm", "target_kl", "target_kl_final"], (1e-9, 1e9)),
    **dict.fromkeys(["log_std", "log_std_final"], (-5.0, 0.5)),
    **{"eval_starts": (10, 10**6), "num_blocks": (1, 64), "memory_length": (0, 8192), "noise_decay": (0.1, 1.0)},
}
CHOICES = {"action_frame": ("local", "eci"), "guidance": ("none", "linear", "knots")}
CHOICES |= {"noise": ("learned", "schedule", "gated"), "return_norm": ("none", "time", "linear")}
CHOICES |= {"lr_schedule": ("linear", "kl")}


def fail(message):
    """End with one line on stderr and exit status 1."""
    sys.exit(f"error: {' '.join(str(message).split())}")


def refuse(name, value, allowed):
    """End with one line that names a field of Args as its flag, its value and what is allowed."""
    fail(f"--{name.replace('_', '-')} {value}: {allowed}")


def parse(kind, argv):
    """tyro's reading of a command line into the dataclass `kind`; of its framed errors only the first paragraph."""
    with contextlib.redirect_stderr(io.StringIO()) as frame:
        try:
            return tyro.cli(kind, args=argv)
        except SystemExit as stop:
            if not stop.code:  # --help
                raise
    lines = (line.strip("│ ") for line in frame.getvalue().splitlines() if line[:1] != "╭")
    fail(" ".join(takewhile(lambda line: line[:1] not in ("─", "╰"), lines)) + " (--help lists what is allowed)")


def check(args, typed, env_ids):
    """Refuse what no run can use: SystemExit with one line that names the flag, the value and what is allowed.

    args is a script's Args, typed the set of fields that the user gave, env_ids the script's environments.
    """
    choices = {"env_id": env_ids, **CHOICES}
    for name, value in vars(args).items():
        if name in RANGES and value is not None and not RANGES[name][0] <= value <= RANGES[name][1]:
            refuse(name, value, f"must be between {RANGES[name][0]} and {RANGES[name][1]}")
        if name in choices and value not in choices[name]:
            refuse(name, value, f"must be one of {', '.join(choices[name])}")
    if args.lr_schedule == "kl" and args.target_kl is None:
        refuse("lr_schedule", args.lr_schedule, "needs --target-kl")
    if args.embed_dim % args.num_heads:
        refuse("num_heads", args.num_heads, f"must divide --embed-dim {args.embed_dim}")
    for name in ("eval_json", "eval_npz"):
        path = getattr(args, name)
        if path is not None and not (args.eval_only and Path(path).parent.is_dir()):
            refuse(name, path, "only with --eval-only, and must be in an existing folder")
    if args.track and importlib.util.find_spec("wandb") is None:
        refuse("track", "", "needs wandb: pip install wandb")
    processes = int(os.environ.get("WORLD_SIZE", 1))  # torchrun's: each flies its share of the environments
    if args.num_envs < processes:
        refuse("num_envs", args.num_envs, f"must be at least the number of processes, {processes}")
    if args.num_minibatches > (share := args.num_envs // processes):
        most = f"--num-envs {args.num_envs}" + (f" / {processes} processes" if processes > 1 else "")
        if "num_minibatches" in typed:
            refuse("num_minibatches", args.num_minibatches, f"must be at most {most}")
        print(f"--num-minibatches lowered from {args.num_minibatches} to {most}")
        args.num_minibatches = share


# ---------------------------------------------------------------------------------------------------------------------
# Files of a run
# ---------------------------------------------------------------------------------------------------------------------


def load_state(run_dir, kind, env_ids):
    """The training state of a run folder; one line if there is none, or it is damaged or another script's.

    kind is the script's Args, env_ids its environments.
    """
    try:
        if damaged := zipfile.ZipFile(path := Path(run_dir) / "training_state.pt").testzip():  # torch checks no CRC
            raise ValueError(f"{damaged} is damaged")
        state = torch.load(path, map_location="cpu", weights_only=True)
        args, kinds = state["args"], get_type_hints(kind)
        if args.keys() != kinds.keys() or args["env_id"] not in env_ids:
            raise ValueError("of another script")
        if wrong := [name for name in kinds if not isinstance(args[name], kinds[name])]:
            raise ValueError(f"{wrong[0]} is {args[wrong[0]]!r}")
    except Exception as error:  # a missing, damaged or foreign file fails in many ways, all alike to the user
        fail(f"--resume {run_dir}: must hold a training_state.pt of {kind().exp_name}.py ({error})")
    return state


def save_run(run_dir, state):
    """Write the training state and, derived from it, the weights that evaluation uses; each whole or not at all."""
    torch.save(state, buffer := io.BytesIO())
    evaluate.write_bytes(run_dir / "training_state.pt", buffer.getbuffer())
    metadata = {"env_id": state["args"]["env_id"], "args": json.dumps(state["args"]), **state["progress"]}
    weights = {k.removeprefix("module."): v.cpu() for k, v in state["average"].items() if k != "n_averaged"}
    data = safetensors.torch.save(weights, {key: str(value) for key, value in metadata.items()})
    evaluate.write_bytes(run_dir / "agent.safetensors", data)


# ---------------------------------------------------------------------------------------------------------------------
# Memory
# ---------------------------------------------------------------------------------------------------------------------


def keep_memory():
    """Let glibc keep what tensors free, for the next ones; without glibc nothing happens.

    It would hand large blocks back to the system, which clears each page before it lends it again: a tenth of an update
    of the small networks, a quarter at Table 1's size.
    """
    with contextlib.suppress(AttributeError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        for option, value in ((-4, 0), (-1, 2**31 - 1)):  # M_MMAP_MAX, M_TRIM_THRESHOLD of <malloc.h>
            mallopt(option, value)


# ---------------------------------------------------------------------------------------------------------------------
# Processes: torchrun starts several of a script, which share the environments and sum what they find
# ---------------------------------------------------------------------------------------------------------------------


def join_processes(cuda):
    """Under torchrun, which sets RANK, become one of its processes, each with its own GPU if there are; `process`."""
    if "RANK" in os.environ and not dist.is_initialized():
        if gpu := torch.cuda.is_available() and cuda:
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
        dist.init_process_group("nccl" if gpu else "gloo")
    return process()


def process():
    """Rank and number of the processes that torchrun started; 0, 1 without it."""
    return (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)


def gathered(value):
    """The values of all processes, in the order of their ranks."""
    values = [value] * process()[1]
    if dist.is_initialized():
        dist.all_gather_object(values, value)
    return values


def total(x):
    """The sum of a tensor over all processes, in place."""
    if dist.is_initialized():
        dist.all_reduce(x)
    return x
