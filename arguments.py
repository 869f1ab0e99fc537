"""What the arguments of the ppo_gtrxl_*.py scripts may be. Bad input ends with one line and exit status 1."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import sys
from itertools import takewhile
from pathlib import Path

import tyro

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
CHOICES |= {"lr_schedule": ("linear", "kl"), "return_norm": ("none", "time"), "noise": ("learned", "schedule", "gated")}


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
    if args.num_minibatches > args.num_envs:
        if "num_minibatches" in typed:
            refuse("num_minibatches", args.num_minibatches, f"must be at most --num-envs {args.num_envs}")
        print(f"--num-minibatches lowered from {args.num_minibatches} to --num-envs {args.num_envs}")
        args.num_minibatches = args.num_envs
