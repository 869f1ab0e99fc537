"""Reading an agent.safetensors, without torch. `runs.save_run` writes it: the averaged weights, last saved."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import safetensors.numpy

from common.errors import BadInput

COUNTERS = {"seed": int, "total_updates": int, "global_step": int, "training_seconds": float, "wall_seconds": float}


def read_checkpoint(
    path, expected: dict[str, type], env_ids=(), defaults: dict | None = None, flag: str = "--checkpoint "
) -> dict:
    """An agent.safetensors: `args` (the run's arguments), `progress` (its counters), `tensors` (NumPy arrays).

    `expected` gives the type of each argument that must be there, `env_ids` the environments that it may be of (none:
    any), `defaults` what an older file need not hold. Raises BadInput, which begins with `flag` and the path, if the
    file is missing, damaged or of something else, or holds a weight that is not finite.
    """
    try:
        data = Path(path).read_bytes()
        tensors = safetensors.numpy.load(data)
        metadata = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]
        args = {**(defaults or {}), **json.loads(metadata["args"])}
        env_id = args["env_id"]
        if env_ids and isinstance(env_id, str) and env_id not in env_ids:  # another script's has other arguments, too
            raise BadInput(f"{flag}{path}: is of {env_id}; this script takes {', '.join(env_ids)}")
        wrong = [name for name, kind in expected.items() if type(args[name]) is not kind]
        metadata.setdefault("training_seconds", metadata["wall_seconds"])  # an older file counted no other time
        progress = {name: kind(metadata[name]) for name, kind in COUNTERS.items()}
        if not all(math.isfinite(value) and value >= 0 for value in progress.values()):
            raise ValueError(f"its counters are {progress}")
    except BadInput:
        raise
    except OSError as error:
        raise BadInput(f"{flag}{path}: {error.strerror}; it must be an agent.safetensors") from error
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError) as error:
        raise BadInput(f"{flag}{path}: damaged or foreign ({error}); it must be an agent.safetensors") from error
    if wrong:
        name = wrong[0]
        raise BadInput(f"{flag}{path}: its {name} is {args[name]!r}; must be {expected[name].__name__}")
    if not all(np.isfinite(tensor).all() for tensor in tensors.values()):
        raise BadInput(f"{flag}{path}: holds a NaN or an infinity; its weights must be finite")
    return {"args": args, "progress": progress, "tensors": tensors}
