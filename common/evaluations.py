"""The two files of an evaluation, eval.json and eval.npz. They are written whole and checked when they are read."""

from __future__ import annotations

import hashlib
import json
import shlex
from pathlib import Path

from common.checkpoints import read_record, script_of
from common.command_line import typed_command
from common.errors import BadInput
from common.files import read_npz, write_json, write_npz
from common.fingerprint import KEY, changes
from common.tasks import env_ids, task_of


def sha256_of(path) -> str:
    """The digest by which an evaluation names its agent.safetensors."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def write_evaluation(metrics: dict, arrays: dict, checkpoint, json_path, npz_path):
    """Write an evaluation of the file `checkpoint`, whose sha256 is added to `metrics`. A path None is not written."""
    metrics["checkpoint_sha256"] = sha256_of(checkpoint)
    if npz_path is not None:
        write_npz(npz_path, arrays)
    if json_path is not None:  # written last, because a run with an eval.json counts as finished
        write_json(json_path, metrics)


def read_evaluation(folder: Path) -> tuple[dict, dict]:
    """The `metrics` and `arrays` of a run or results folder. Raises OSError or ValueError that names the bad file."""
    metrics = read_metrics(folder / "eval.json")
    path = folder / "eval.npz"
    arrays = read_npz(path)
    missing = task_of(metrics["env_id"]).required_arrays(metrics) - arrays.keys()
    if missing:
        raise ValueError(f"{path} lacks {', '.join(sorted(missing))}")
    return metrics, arrays


def read_metrics(path: Path) -> dict:
    """An eval.json with all numbers of its table. Raises ValueError that names the file and what is wrong with it."""
    metrics = read_json(path)
    try:
        task_of(metrics["env_id"]).table(metrics)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} lacks a number of its table, or has a wrong one: {error}") from error
    return metrics


def read_json(path: Path) -> dict:
    """The eval.json of a finished run. Raises ValueError that names the file and what is wrong with it."""
    if not path.exists():
        begun = (path.parent / "training_state.pt").exists()
        why = f"; the training has not ended: go on with {resume_command(path.parent)}" if begun else ""
        raise ValueError(f"{path} is not there{why}")
    try:
        metrics = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is not readable JSON: {error}") from error
    if not isinstance(metrics, dict) or metrics.get("env_id") not in env_ids():
        found = metrics.get("env_id") if isinstance(metrics, dict) else type(metrics).__name__
        raise ValueError(f"{path}: env_id is {found!r}; it must be one of {', '.join(env_ids())}")
    if not isinstance(metrics.get("seed"), int):
        raise ValueError(f"{path}: seed is {metrics.get('seed')!r}; it must be an integer")
    return metrics


def resume_command(run_dir: Path) -> str:
    """The command line that goes on with a run. Only its flag if the run's files do not say of which script it is."""
    try:
        return typed_command(script_of(run_dir / "agent.safetensors").name, "--resume", run_dir)
    except BadInput:
        return shlex.join(["--resume", str(run_dir)])


def fingerprint_in(path: Path) -> tuple[str | None, str]:
    """The fingerprint in an eval.json or agent.safetensors, or None, and its environment's id.

    Raises OSError or ValueError for a bad file.
    """
    if path.suffix == ".json":
        metrics = read_json(path)
        return metrics.get(KEY), metrics["env_id"]
    record = read_record(path)
    return record[KEY], record["args"].get("env_id", "")


def first_edited(paths: list[Path]) -> tuple[Path, str] | None:
    """The first of these files that is of another problem than today's, and what differs, in words. None without one.

    A file without a fingerprint is older, and does not say. Raises OSError or ValueError for a bad file.
    """
    found = {}
    for path in paths:
        found.setdefault(fingerprint_in(path), path)
    for (stored, env_id), path in found.items():
        changed = None if stored is None else changes(stored, env_id)
        if changed:
            return path, changed
    return None


def refuse_another_policy(folder: Path, metrics: dict):
    """Raise ValueError if a folder's evaluation is not of its policy."""
    if metrics.get("checkpoint_sha256") != sha256_of(folder / "agent.safetensors"):
        raise ValueError(f"{folder}/eval.json is not of its agent.safetensors (checkpoint_sha256 differs)")
