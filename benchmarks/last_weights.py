"""What averaged weights are worth: a run's averaged and its last weights, flown on the same starts.

    python -m benchmarks.last_weights runs/<a run> runs/<another run>

A run averages its weights over the optimiser's steps (--weight-average), and evaluations fly this average. The run's
training_state.pt holds the last weights, too. They are flown by the run's script, with the run's options of the
environment, evaluation seed and number of starts. Prints both columns for each run, with the rows of
`evaluate.py figures`; "-" stands for a number that an evaluation does not have.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import torch

import runs
from common.command_line import OneLineParser
from common.errors import BadInput
from common.evaluations import read_json
from common.policies import evaluate_by_script, script_of
from common.tasks import task_of

NOT_OF_WEIGHTS = (
    "eval_seed",
    "eval_starts",
    "dispersion",
    "failure",
    "navigation_noise",
)  # what a file of weights does not decide


def flags_of(args: dict) -> dict:
    """{flag: value} of an evaluation like that of a run with these arguments."""
    flags = {}
    for name in NOT_OF_WEIGHTS:
        value = args.get(name)
        if value is not None:
            is_several = isinstance(value, list | tuple)
            flags[name.replace("_", "-")] = " ".join(map(str, value)) if is_several else value
    return flags


def last_weights_flown(run: Path) -> dict:
    """The metrics of a run's last weights. Raises BadInput that names the run if they cannot be flown."""
    try:
        state = torch.load(run / "training_state.pt", map_location="cpu", weights_only=True)
        state["average"] = state["agent"]
        flags = flags_of(state["args"])
    except Exception as error:  # a missing or damaged file fails in many ways, which are all the same to the user
        raise BadInput(f"{run} must hold a run's training_state.pt ({' '.join(str(error).split()):.120})") from error
    with tempfile.TemporaryDirectory() as folder:
        runs.save_run(Path(folder), state)
        weights = Path(folder) / "agent.safetensors"
        found = Path(folder) / "eval.json"
        try:
            evaluate_by_script(script_of(weights), weights, flags | {"eval-json": found})
        except BadInput as error:
            raise BadInput(f"the last weights of {run} do not fly: {error}") from error
        return read_json(found)


def table(run: Path) -> list[str]:
    """The lines of a run: averaged weights beside the last ones. Raises BadInput or OSError that says what is wrong."""
    averaged = read_json(run / "eval.json")
    last = last_weights_flown(run)
    lines = [f"{run}", f"  {'':38}{'averaged':>12}{'last':>12}"]
    for key, (label, form) in task_of(averaged["env_id"]).seed_rows().items():
        both = [metrics.get(key) for metrics in (averaged, last)]
        if any(value is not None for value in both):
            cells = ["-" if value is None else format(value, form) for value in both]
            lines.append(f"  {label:38}" + "".join(f"{cell:>12}" for cell in cells))
    return lines


def main():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path, help="run folders with a training_state.pt and an eval.json")
    for run in parser.parse_args().runs:
        try:
            print("\n".join(table(run)), flush=True)
        except (BadInput, OSError, ValueError) as error:
            sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
