"""What averaged weights are worth: a run's averaged and its last weights, flown on the same starts.

    python benchmarks/last_weights.py runs/<a run> runs/<another run>

A run averages its weights over the optimiser's steps (--weight-average), and evaluations fly this average. The run's
training_state.pt holds the last weights, too. They are flown by the run's script, with the run's options of the
environment and its evaluation seed. Prints both columns for each run, with the rows of `evaluate.py figures`.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
import runs  # noqa: E402
from common.command_line import OneLineParser  # noqa: E402
from common.errors import BadInput  # noqa: E402
from common.evaluations import read_json  # noqa: E402
from common.policies import evaluate_by_script, script_of  # noqa: E402
from common.tasks import task_of  # noqa: E402

OPTIONS = ("eval_seed", "dispersion", "failure", "failure_time")  # those that a file of weights does not decide


def last_weights_flown(run: Path) -> dict:
    """The metrics of a run's last weights, on the flights of its eval.json. Raises BadInput if its script refuses."""
    state = torch.load(run / "training_state.pt", map_location="cpu", weights_only=True)
    flags = {name: value for name, value in state["args"].items() if name in OPTIONS and value is not None}
    flags = {name.replace("_", "-"): value for name, value in flags.items()}
    state["average"] = state["agent"]
    with tempfile.TemporaryDirectory() as folder:
        runs.save_run(Path(folder), state)
        weights, found = Path(folder) / "agent.safetensors", Path(folder) / "eval.json"
        evaluate_by_script(script_of(weights), weights, flags | {"eval-json": found})
        return json.loads(found.read_text())


def table(run: Path) -> list[str]:
    """The lines of a run: averaged weights beside the last ones."""
    averaged, last = read_json(run / "eval.json"), last_weights_flown(run)
    lines = [f"{run}", f"  {'':38}{'averaged':>12}{'last':>12}"]
    for key, (label, form) in task_of(averaged["env_id"]).seed_rows().items():
        if isinstance(averaged.get(key), int | float):
            lines.append(f"  {label:38}{format(averaged[key], form):>12}{format(last[key], form):>12}")
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
