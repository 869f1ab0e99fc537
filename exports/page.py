"""One self-contained HTML file of a `Page`, with template, style, scripts and data in it.

The scripts are plain JavaScript files of `pages/`. They are read in the order of `KINDS` into one global scope.
"""

from __future__ import annotations

import base64
import html
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from common.errors import refuse_unless

PARTS = Path(__file__).parents[1] / "pages"
KINDS = {
    "ascent": ["numbers.js", "policy.js", "rocket_physics.js", "rocket_laws.js"]
    + ["vendor/three.min.js", "vendor/coastlines.js", "chart.js", "scene.js", "ascent.js"],
    "plane": ["numbers.js", "policy.js", "plane_physics.js", "plane_optimum.js", "chart.js", "plane.js"],
}
UNUSED = ("critic.", "actor_logstd")  # tensors that no evaluation needs


class Page(NamedTuple):
    """The content of a page."""

    kind: str  # one of KINDS: `<kind>.html` and its scripts
    title: str
    data: dict[str, Any]  # plain values and NumPy arrays, at any depth


def html_bytes(page: Page) -> bytes:
    """The file."""
    values = {
        "title": html.escape(page.title),
        "style": (PARTS / "page.css").read_text(),
        "data": json.dumps(page.data, default=encoded, allow_nan=False).replace("<", "\\u003c"),
        "scripts": "\n".join(script(name) for name in KINDS[page.kind]),
    }
    text = (PARTS / f"{page.kind}.html").read_text()
    for name, value in values.items():
        text = text.replace(f"{{{{{name}}}}}", value)
    return text.encode()


def script(name: str) -> str:
    """A script as an element of the page, with the license of a library before it."""
    path = PARTS / name
    license_path = path.with_name(f"{path.name.split('.')[0]}.LICENSE")
    terms = f"/*\n{license_path.read_text()}*/\n" if license_path.exists() else ""
    return f'<script data-file="{name}">\n{terms}{path.read_text()}</script>'


def encoded(value):
    """A value for JSON: an array as {dtype, shape, base64}, a NumPy number as a plain number.

    Weights that were rounded to bfloat16 are written as bfloat16. They take half the bytes, and nothing is lost.
    """
    if isinstance(value, np.generic):
        return value.item()
    array = np.ascontiguousarray(value)
    dtype = array.dtype.name
    if array.dtype == np.float32 and not (array.view(np.uint32) & 0xFFFF).any():
        dtype = "bfloat16"
        array = (array.view(np.uint32) >> 16).astype(np.uint16)
    return {"dtype": dtype, "shape": value.shape, "base64": base64.b64encode(array.tobytes()).decode()}


def network(checkpoint: dict, inputs: int) -> dict:
    """A policy's network for policy.js, from the answer of `read_checkpoint`. `inputs` is the number of its features.

    Raises BadInput if the policy was trained with other features.
    """
    tensors, args = checkpoint["tensors"], checkpoint["args"]
    wide = tensors["encoder.0.weight"].shape[1] if "encoder.0.weight" in tensors else 0
    refuse_unless(wide == inputs, "the policy's number of features", wide, f"must be {inputs} to fly in a page")
    return {
        "heads": args["num_heads"],
        "memory_length": args["memory_length"],
        "tensors": {name: tensors[name] for name in sorted(tensors) if not name.startswith(UNUSED)},
    }
