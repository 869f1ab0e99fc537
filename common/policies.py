"""Running a policy's script in its own process, so that this module imports neither a script nor torch."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from common.checkpoints import read_checkpoint
from common.errors import BadInput, refuse_unless

ROOT = Path(__file__).parents[1]


def script_of(checkpoint) -> Path:
    """The script that trained an agent.safetensors. Raises BadInput if the file is bad or names no script."""
    name = read_checkpoint(checkpoint, {"exp_name": str}, flag="")["args"]["exp_name"]
    scripts = {path.stem: path for path in ROOT.glob("ppo_gtrxl_*.py")}
    allowed = f"must be that of a script, which flies it: {', '.join(sorted(scripts))}"
    refuse_unless(name in scripts, f"the exp_name of {checkpoint}", repr(name), allowed)
    return scripts[name]


def evaluate_by_script(script: Path, checkpoint, flags: dict):
    """Run `script --eval-only` on a checkpoint, on the CPU. Raises BadInput with the script's line if it refuses."""
    command = [sys.executable, str(script), "--eval-only", "--no-cuda", f"--checkpoint={checkpoint}"]
    command += [f"--{name}={value}" for name, value in flags.items()]
    run_quietly(command, checkpoint)


def run_quietly(command: list[str], checkpoint, cwd=None):
    """Run a command on a checkpoint. Raises BadInput with the command's last line if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, cwd=cwd)
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"{command[1]} ended with {done.returncode}"]
        raise BadInput(f"{checkpoint}: {said[-1]}")
