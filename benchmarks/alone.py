"""How fast each result's training is with nothing else on the machine, beside the speed of its shipped run.

    python benchmarks/alone.py [results/di ...] [--seconds 50]    # all in 10 minutes; let nothing else run

The shipped runs had one core each of a machine with two, and another training used the other core. Each result's first
command of result_jobs.txt is started here, and ended after some seconds. Prints the environment steps a second
(charts/SPS, evaluations not counted) after its last update, the same of the shipped run after the same update, and
their ratio. The runs that are made here are deleted.
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
from same_training import first_jobs  # noqa: E402

from common.command_line import OneLineParser, integer  # noqa: E402
from common.curves import read_csv, read_curve  # noqa: E402

SPS = "charts/SPS"


def curve_of(job, seconds: int) -> dict:
    """The curve of a training that is ended after some seconds. Raises RuntimeError if it makes no run folder."""
    command = [sys.executable, *job.command]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    first = next((line for line in process.stdout if line.startswith("run folder: ")), None)
    if first is None:
        raise RuntimeError(f"{' '.join(job.command)} ended with {process.wait()}")
    folder = ROOT / first.removeprefix("run folder: ").strip()
    time.sleep(seconds)
    process.send_signal(signal.SIGINT)
    process.communicate()
    try:
        return read_curve(folder)
    finally:
        shutil.rmtree(folder)


def compare(name: str, job, seconds: int) -> str:
    """A line: steps a second alone, of the shipped run, their ratio, and after how many updates.

    Raises RuntimeError if the training makes no update in these seconds.
    """
    curve = curve_of(job, seconds)
    if SPS not in curve:
        raise RuntimeError(f"{name} made no update in {seconds} s; give more --seconds")
    shipped = read_csv(ROOT / name / "seeds" / f"{job.args['seed']}.csv")
    steps, speeds = curve[SPS]
    updates = len(steps)
    alone, beside = speeds[-1], shipped[SPS][1][updates - 1]
    return f"{name:26}{alone:>10.0f}{beside:>22.0f}{alone / beside:>10.2f}{updates:>10}"


def main():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    jobs = first_jobs()
    parser.add_argument(
        "results", nargs="*", type=lambda name: name.rstrip("/"), help="results folders; without one, all"
    )
    parser.add_argument("--seconds", type=integer(5, 3600), default=50, help="seconds of each training")
    options = parser.parse_args()
    names = options.results or list(jobs)
    unknown = sorted(set(names) - jobs.keys())
    if unknown:
        sys.exit(f"error: {', '.join(unknown)} must be among {', '.join(jobs)}")
    print(f"{'steps a second':26}{'alone':>10}{'the shipped run':>22}{'ratio':>10}{'updates':>10}", flush=True)
    try:
        for name in names:
            print(compare(name, jobs[name], options.seconds), flush=True)
    except (OSError, RuntimeError, ValueError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
