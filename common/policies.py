"""Running a policy's script in its own process, so that this module imports neither a script nor torch."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from common.checkpoints import read_checkpoint
from common.errors import BadInput, refuse_unless

ROOT = Path(__file__).parents[1]


def evaluate_by_script(script: Path, checkpoint, flags: dict):
    """Run `script --eval-only` on a checkpoint, on the CPU. `flags` has fields of its Args.

    Raises BadInput with the script's line if it refuses.
    """
    command = [sys.executable, str(script), "--eval-only", "--no-cuda", f"--checkpoint={checkpoint}"]
    for name, value in flags.items():
        words = " ".join(map(str, value)) if isinstance(value, list | tuple) else value
        command.append(f"--{name.replace('_', '-')}={words}")
    run_quietly(command, checkpoint)


def fly_by_script(script: Path, checkpoint, flags: dict) -> tuple[dict, dict]:
    """What `evaluate_by_script` writes, on one core: (metrics, arrays)."""
    with tempfile.TemporaryDirectory() as folder:
        metrics, arrays = (Path(folder) / name for name in ("eval.json", "eval.npz"))
        files = {"eval_json": metrics, "eval_npz": arrays, "num_threads": 1}
        evaluate_by_script(script, checkpoint, flags | files)
        with np.load(arrays) as file:
            return json.loads(metrics.read_text()), dict(file)


def competitors(env_id: str, folder: Path, also, taken) -> dict[str, Path]:
    """{name: agent.safetensors} of a results folder's policy and of those of `also` (name, path).

    Raises BadInput for a name that is `taken`, for a policy on another id, and if the folder cannot be written to.
    """
    checkpoints = {"policy": folder / "agent.safetensors"}
    for name, path in also:
        refuse_unless(name not in {*checkpoints, *taken}, "the NAME of --also", name, "must be that of no other row")
        checkpoints[name] = path
    for path in checkpoints.values():
        other = read_checkpoint(path)["args"]["env_id"]
        refuse_unless(other == env_id, f"the env_id of {path}", other, f"must be {env_id}, as that of {folder}")
    refuse_unless(os.access(folder, os.W_OK), "the folder", folder, "must be writable")
    return checkpoints


def run_quietly(command: list[str], checkpoint, cwd=None):
    """Run a command on a checkpoint. Raises BadInput with the command's last line if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, cwd=cwd)
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"{command[1]} ended with {done.returncode}"]
        raise BadInput(f"{checkpoint}: {said[-1]}")
