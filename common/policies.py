"""A policy flown by its script in a process of its own: nothing imports a script, or torch."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from common.errors import BadInput


def evaluate_by_script(script: Path, checkpoint, flags: dict):
    """Run `script --eval-only` on a checkpoint, on the CPU. BadInput with the script's own line where it refuses."""
    command = [sys.executable, str(script), "--eval-only", "--no-cuda", f"--checkpoint={checkpoint}"]
    command += [f"--{name}={value}" for name, value in flags.items()]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f"{script.name} ended with {done.returncode}"]
        raise BadInput(f"{checkpoint}: {said[-1]}")
