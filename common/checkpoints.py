"""Reading and shortening an agent.safetensors without torch.

`runs.save_run` writes the averaged weights to it. A large network may be kept in bfloat16, which is a float32 without
its lower 16 bits. It has half the bytes and three digits.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType, UnionType
from typing import Any, get_args

import numpy as np
import safetensors

from common.errors import BadInput, refuse_unless
from common.files import write_bytes
from common.fingerprint import KEY

ROOT = Path(__file__).resolve().parents[1]
KINDS = {"F64": np.float64, "F32": np.float32, "F16": np.float16, "BF16": np.uint16, "I64": np.int64}
LARGE = 10_000  # a tensor of this many numbers or more is shortened
COUNTERS = {"seed": int, "total_updates": int, "global_step": int, "training_seconds": float, "wall_seconds": float}


def read_checkpoint(
    path,
    expected: Mapping[str, type | UnionType] = MappingProxyType({}),
    env_ids=(),
    defaults: Mapping = MappingProxyType({}),
    flag: str = "",
) -> dict:
    """An agent.safetensors: `args` (the run's arguments), `counters`, `tensors` (NumPy arrays), and the
    fingerprint of its environment, or None.

    - expected: the type of each argument that must be there
    - env_ids: the environments that the file may be of; empty: any
    - defaults: arguments that an older file need not have

    Raises BadInput, which begins with `flag` and the path, if the file is missing, damaged or of something else, or if
    a weight is not finite.
    """
    try:
        data = Path(path).read_bytes()
        tensors = read_tensors(data)
        metadata = read_metadata(data)
        args = {**defaults, **json.loads(metadata["args"])}
        env_id = args["env_id"]
        # this check comes first, because another script's file has other arguments, too
        if env_ids and isinstance(env_id, str) and env_id not in env_ids:
            raise BadInput(f"{flag}{path}: is of {env_id}; this script takes {', '.join(env_ids)}")
        allowed: dict[str, Any] = {name: get_args(kind) or (kind,) for name, kind in expected.items()}
        wrong = [name for name, kinds in allowed.items() if type(args[name]) not in kinds]
        metadata.setdefault("training_seconds", metadata["wall_seconds"])  # an older file has only this time
        counters = {name: kind(metadata[name]) for name, kind in COUNTERS.items()}
        if not all(math.isfinite(value) and value >= 0 for value in counters.values()):
            raise ValueError(f"its counters are {counters}")
    except BadInput:
        raise
    except OSError as error:
        raise BadInput(f"{flag}{path}: {error.strerror}; it must be an agent.safetensors") from error
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError) as error:
        raise BadInput(f"{flag}{path}: damaged or foreign ({error}); it must be an agent.safetensors") from error
    if wrong:
        name = wrong[0]
        kinds = " or ".join(kind.__name__ for kind in allowed[name])
        raise BadInput(f"{flag}{path}: its {name} is {args[name]!r}; must be {kinds}")
    if not all(np.isfinite(tensor).all() for tensor in tensors.values()):
        raise BadInput(f"{flag}{path}: holds a NaN or an infinity; its weights must be finite")
    return {"args": args, "counters": counters, "tensors": tensors, KEY: metadata.get(KEY)}


def script_of(checkpoint) -> Path:
    """The script that trained an agent.safetensors. Raises BadInput if the file is bad or names no script."""
    name = read_checkpoint(checkpoint, {"exp_name": str})["args"]["exp_name"]
    scripts = {path.stem: path for path in ROOT.glob("ppo_gtrxl_*.py")}
    allowed = f"must be that of a script, which flies it: {', '.join(sorted(scripts))}"
    refuse_unless(name in scripts, f"the exp_name of {checkpoint}", repr(name), allowed)
    return scripts[name]


def read_metadata(data: bytes) -> dict[str, str]:
    """The metadata of a safetensors file. Raises KeyError without metadata."""
    header = data[8 : 8 + int.from_bytes(data[:8], "little")]
    return json.loads(header)["__metadata__"]


def read_record(path) -> dict:
    """What an agent.safetensors says of its training: `args`, and its environment's fingerprint or None.

    {"args": {}, ...: None} if it says nothing. Raises OSError if it is not there.
    """
    try:
        metadata = read_metadata(Path(path).read_bytes())
        return {"args": json.loads(metadata["args"]), KEY: metadata.get(KEY)}
    except (KeyError, TypeError, ValueError):
        return {"args": {}, KEY: None}


def read_tensors(data: bytes) -> dict[str, np.ndarray]:
    """The arrays of a safetensors file by name. A bfloat16 array is returned as float32, because NumPy has no bfloat16.

    Raises KeyError for a kind of number that is not in KINDS.
    """
    tensors = {}
    for name, tensor in safetensors.deserialize(data):
        array = np.frombuffer(tensor["data"], dtype=KINDS[tensor["dtype"]]).reshape(tensor["shape"])
        if tensor["dtype"] == "BF16":
            array = (array.astype(np.uint32) << 16).view(np.float32)
        tensors[name] = array
    return tensors


def write_bfloat16(source, target):
    """Write an agent.safetensors again, with its LARGE tensors rounded to bfloat16.

    Small tensors stay as they are, because rounding the problem's constants (units, axes) would cost more accuracy than
    rounding all weights.
    """
    data = Path(source).read_bytes()
    specs, arrays = {}, []
    for name, array in read_tensors(data).items():
        kind = array.dtype.name
        if array.dtype == np.float32 and array.size >= LARGE:
            kind = "bfloat16"
            bits = array.view(np.uint32)
            array = ((bits + 0x7FFF + ((bits >> 16) & 1)) >> 16).astype(np.uint16)  # to the nearest, ties to even
        arrays.append(array)  # keeps the memory that `serialize` reads
        specs[name] = safetensors.TensorSpec(
            dtype=kind, shape=array.shape, data_ptr=array.ctypes.data, data_len=array.nbytes
        )
    write_bytes(target, bytes(safetensors.serialize(specs, metadata=read_metadata(data))))
