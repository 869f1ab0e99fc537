"""A policy as an ONNX model. `exports.onnx_model` makes it in its own process, because this module imports no torch."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from common.checkpoints import script_of
from common.policies import ROOT, run_quietly
from exports.extras import need


def onnx_bytes(checkpoint: Path) -> bytes:
    """The model of an agent.safetensors. Raises BadInput if the file is damaged or a package is missing."""
    need("--onnx", "onnx", "onnxscript")
    script = script_of(checkpoint)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "policy.onnx"
        command = [sys.executable, "-m", "exports.onnx_model", script.stem, str(checkpoint.resolve()), str(target)]
        run_quietly(command, checkpoint, cwd=ROOT)
        return target.read_bytes()
