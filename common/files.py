"""Files that are whole or untouched: each is written beside its place and renamed, so a failure leaves the old one."""

from __future__ import annotations

import json
import os
import tokenize
import zlib
from contextlib import contextmanager
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

DAMAGED_NPZ = (ValueError, EOFError, BadZipFile, zlib.error, tokenize.TokenError)  # what np.load raises on one


@contextmanager
def naming(path):
    """Let an OSError in the block name `path` if it names no file, as that of a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno and not error.filename:
            error.filename = str(path)
        raise


@contextmanager
def replacing(path, mode: str = "wb"):
    """Open a temporary file that becomes `path` when the block ends without an error: whole or untouched."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with naming(path):
            with open(temporary, mode, newline=None if "b" in mode else "") as file:
                yield file
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path, data: bytes | memoryview):
    """Write a whole file."""
    with replacing(path) as file:
        file.write(data)


def write_json(path, metrics: dict):
    """Write metrics as JSON in the given order; ValueError names the key that holds a number which is not finite."""
    plain = {key: value.item() if isinstance(value, np.generic) else value for key, value in metrics.items()}
    for key, value in plain.items():
        try:
            json.dumps(value, allow_nan=False)
        except ValueError as error:
            raise ValueError(f"{key} is {value}; {Path(path).name} holds finite numbers only") from error
    write_bytes(path, (json.dumps(plain, indent=2) + "\n").encode())


def write_npz(path, arrays: dict):
    """Write arrays as a compressed .npz."""
    with replacing(path) as file:
        np.savez_compressed(file, **arrays)


def read_npz(path) -> dict:
    """All arrays of a .npz; ValueError names the file that is damaged."""
    try:
        with np.load(path) as file:
            return {key: file[key] for key in file.files}
    except DAMAGED_NPZ as error:
        raise ValueError(f"{path} is not a readable .npz: {error}") from error
