"""The differences between the flights of a page, in V8, and Python's flights in eval.npz.

    python -m benchmarks.page_flights results/rocket_cutoff results/rocket_dispersed results/di
    python -m benchmarks.page_flights --changed results/rocket_dispersed      # what other vehicles do to the three laws

Needs `mini-racer` of requirements-extras.txt.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
from py_mini_racer import MiniRacer

import envs  # noqa: F401 - makes every id known to `task_of`
from common.checkpoints import read_checkpoint
from common.command_line import OneLineParser
from common.evaluations import read_evaluation
from common.tasks import task_of
from exports.folders import LAUNCH_LONGITUDE
from exports.offers import offer
from exports.page import html_bytes

NO_CHANGES = {"thrust": 0.0, "drag": 0.0, "windEast": 0.0, "windNorth": 0.0, "payload": 0.0, "failure": None}
CHANGED = [
    {"thrust": 0.01},
    {"thrust": -0.01},
    {"drag": 0.3},
    {"windEast": 40.0},
    {"payload": 60.0},
    {"failure": {"time": 400.0, "group": 3, "share": 0.1}},
]
POLICIES = "data.starts.slice(0, 10).map(x => flyPlane(data.problem, x, planePolicy(data.policy, data.problem)))"
OPTIMA = "data.starts.map(x => planeOptimum(data.problem, x))"


class Engine:
    """The scripts of a page in V8, without those that draw. `engine(expression)` evaluates an expression."""

    def __init__(self, html: str):
        self.v8 = MiniRacer()
        scripts = re.findall(r'<script data-file="([\w./]+)">\n(.*?)</script>', html, flags=re.DOTALL)
        for name, code in scripts:
            if name in ("numbers.js", "policy.js") or name.startswith(("rocket_", "plane_")):
                self.v8.eval(code)
        (data,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', html, flags=re.DOTALL)
        self.v8.eval(f"const data = decoded({data})")

    def __call__(self, expression: str):
        return json.loads(self.v8.eval(f"JSON.stringify({expression})"))


def page_of(folder: Path) -> str:
    """The page of a results or run folder."""
    metrics, arrays = read_evaluation(folder)
    checkpoint = read_checkpoint(folder / "agent.safetensors")
    return html_bytes(offer(task_of(metrics["env_id"]), "page")(metrics, arrays, checkpoint, LAUNCH_LONGITUDE)).decode()


def print_differences(folder: Path, engine: Engine):
    """Print a line with the differences of the page's flights from the evaluation's."""
    metrics, arrays = read_evaluation(folder)
    if "error_norm" in metrics:
        flight = engine(f"flyAll(data, {json.dumps(NO_CHANGES)}).policy")
        error = flight["errorNorm"] - metrics["error_norm"]
        metres = np.linalg.norm(np.subtract(flight["y"][-1][:3], arrays["y"][-1, :3]))
        print(f"{folder}: ||error|| {error:+.1e}, last position {metres:.3f} m")
        return
    differences = []
    for expression, key in ((POLICIES, "cost"), (OPTIMA, "cost_reference")):
        cost = np.array([flight["cost"] for flight in engine(expression)])
        differences.append(np.abs(cost - arrays[key][: len(cost)]).max())
    print(f"{folder}: largest difference of the cost, policy {differences[0]:.1e}, optimum {differences[1]:.1e}")


def print_changed(folder: Path, engine: Engine):
    """Print ||error|| of the three laws with other vehicles."""
    print(f"{folder}: ||error||{'policy':>22}{'LQR':>12}{'open loop':>12}")
    for change in CHANGED:
        flights = engine(f"flyAll(data, {json.dumps({**NO_CHANGES, **change})})")
        cells = (f"{flights[name]['errorNorm']:>12.2g}" for name in ("policy", "lqr", "openLoop"))
        ((name, value),) = change.items()
        words = "10 % lost at 400 s" if name == "failure" else f"{name} {value:+g}"
        print(f"  {words:<30}{''.join(cells)}")


def main():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="results/<name> or runs/...")
    parser.add_argument("--changed", action="store_true", help="fly other vehicles of the paper's rocket instead")
    args = parser.parse_args()
    for folder in args.folders:
        (print_changed if args.changed else print_differences)(folder, Engine(page_of(folder)))


if __name__ == "__main__":
    main()
