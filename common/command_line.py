"""The base of all commands: errors of one line, and types of arguments that are checked when they are read."""

from __future__ import annotations

import argparse
import math
import os
import shlex
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def typed_command(script: str, *words) -> str:
    """A command line to copy: a Python file of this project and its words, started as this process was.

    It works from the current directory. Under torchrun it begins with torchrun.
    """
    path = str(ROOT / script)
    try:
        path = min(os.path.relpath(path), path, key=len)
    except ValueError:  # Windows has no relative path to another drive
        pass
    return shlex.join([*launcher(), path, *map(str, words)])


def launcher() -> list[str]:
    """The words that start a script in as many processes as torchrun started this one in; `python` without torchrun."""
    environment = os.environ
    if "LOCAL_WORLD_SIZE" not in environment:
        return ["python"]
    processes = f"--nproc-per-node={environment['LOCAL_WORLD_SIZE']}"
    machines = environment.get("GROUP_WORLD_SIZE", "1")
    if machines == "1":
        return ["torchrun", processes]
    first = [f"--master-addr={environment['MASTER_ADDR']}", f"--master-port={environment['MASTER_PORT']}"]
    return ["torchrun", f"--nnodes={machines}", f"--node-rank={environment['GROUP_RANK']}", processes, *first]


class OneLineParser(argparse.ArgumentParser):
    """A parser whose errors are one line, without the usage."""

    def error(self, message):
        sys.exit(f"error: {message}")


def integer(low: int, high: int) -> Callable:
    """Argument type: a whole number from `low` to `high`."""

    def parse(text):
        if not text.isdecimal() or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"{text!r} must be a whole number from {low} to {high}")
        return int(text)

    return parse


def number_in(text: str) -> float:
    """The number that a text is. NaN, which is in no range, if it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def number(low: float, high: float) -> Callable:
    """Argument type: a number from `low` to `high`."""

    def parse(text):
        value = number_in(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} must be a number from {low} to {high}")
        return value

    return parse


def positive(text: str) -> float:
    """Argument type: a dispersion above 0, at most 10."""
    value = number_in(text)
    if not 0 < value <= 10:
        raise argparse.ArgumentTypeError(f"{text!r} must be a number above 0, at most 10")
    return value


def output_file(text: str) -> Path:
    """Argument type: a file to write. A file that cannot be written is refused before anything is solved."""
    path = Path(text)
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise argparse.ArgumentTypeError(f"{text!r} must be a file in an existing, writable folder")
    return path


def named_path(text: str) -> tuple[str, Path]:
    """Argument type: NAME=PATH."""
    name, _, path = text.partition("=")
    if not name or not path:
        raise argparse.ArgumentTypeError(f"{text!r} must be NAME=PATH, a name and an agent.safetensors")
    return name, Path(path)


def utc(text: str) -> datetime:
    """Argument type: a moment in ISO 8601, in UTC unless it names another zone."""
    try:
        moment = datetime.fromisoformat(text)
        moment = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)
    except (OverflowError, ValueError) as error:
        raise argparse.ArgumentTypeError(f"{text!r} must be a moment such as 2026-01-01T12:00:00") from error
    if not 1900 <= moment.year <= 2200:
        raise argparse.ArgumentTypeError(f"{text!r} must be a moment of the years 1900 to 2200")
    return moment
