"""Stable-Baselines3 beside our results: train the runs that results/peers lacks, then print the table.

    pip install -r benchmarks/requirements.txt
    python -m benchmarks.peers --at-once 2    # hours; --rows di cutoff: these alone
    python -m benchmarks.peers --table        # of what is there

Each row is one way of learning, with seeds 1 to 3, by `benchmarks.sb3_ppo` with the settings that were best for it in
short trials (docs/other-learners.md). Numbers are medians with the range of all seeds. Logs are in runs/. The exit
status is 1 if a run failed.
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

from benchmarks.records import cell, read_record
from benchmarks.run_seeds import end_with_the_runs, start_logged, work
from common.command_line import OneLineParser, integer

FOLDER = Path("results/peers")
SEEDS = (1, 2, 3)
LOW_PRICE = "--mass-weight 0.3"  # of the propellant: under the full one, which rises to 3, it loses the orbit
CUTOFF = f"--env-id RocketAscentCutoff-v0 --batch-size 512 --learning-rate 1e-3 --samples 7450000 {LOW_PRICE}"
DI_KEYS = {"ratio_of_sums": "ratio of sums", "ratio_p95": "p95", "hit_rate": "hits"}
ROCKET_KEYS = {"error_norm": "||error||", "perigee_km": "perigee (km)", "mass_ratio": "mass / optimum"}


@dataclass
class Peer:
    """A row: its label, the flags of `sb3_ppo`, the keys of its final evaluation."""

    title: str
    flags: str
    keys: dict[str, str]


PEERS = {
    "cutoff": Peer("cut-off, propellant at full price", f"{CUTOFF} --mass-weight 3", ROCKET_KEYS),
    "cutoff_low_price": Peer("cut-off, a tenth of that price", CUTOFF, ROCKET_KEYS),
    "cutoff_raw": Peer("cut-off, a tenth, raw observations", f"{CUTOFF} --features raw", ROCKET_KEYS),
    "cutoff_longer": Peer("cut-off, a tenth, twice the samples", f"{CUTOFF} --samples 14900000", ROCKET_KEYS),
    "di": Peer("double integrator", "--samples 2560000", DI_KEYS),
}


def record(name, seed):
    """The file in which a run writes its numbers."""
    return FOLDER / f"{name}_{seed}.json"


class PeerTraining:
    """A run of a row, as `run_seeds.work` takes it."""

    def __init__(self, name, seed):
        self.name = name
        self.seed = seed
        peer = PEERS[name]
        self.command = ["-m", "benchmarks.sb3_ppo", *shlex.split(peer.flags), "--seed", str(seed)]
        self.command += ["--json", str(record(name, seed))]

    def is_trained(self):
        return record(self.name, self.seed).exists()

    def identity(self):
        return self.name, self.seed

    def start(self):
        return start_logged(self.command, f"peer_{self.name}_{self.seed}")

    def publish(self, numbers):
        """The run itself has written its numbers. Raises ValueError that names a file of another kind."""
        read_record(record(self.name, self.seed))


def train_all(at_once, rows):
    """Every run of the rows that is missing, `at_once` at a time. Returns those that failed."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    trainings = [PeerTraining(name, seed) for name in PEERS if name in rows for seed in SEEDS]
    return work(trainings, at_once, numbers=True)


def table():
    """The lines of the table. Rows with other numbers have their own header."""
    lines, keys = [], None
    for name, peer in PEERS.items():
        paths = [record(name, seed) for seed in SEEDS]
        records = [read_record(path) for path in paths if path.exists()]
        if not records:
            continue
        if peer.keys != keys:
            keys = peer.keys
            lines.append(["", "seeds", "samples", "minutes", *keys.values()])
        cells = [cell([final[key] for _, final in records]) for key in keys]
        minutes = cell([last["minutes"] for last, _ in records])
        lines.append([peer.title, str(len(records)), str(records[0][0]["samples"]), minutes, *cells])
    return lines


def main():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("--at-once", type=integer(1, 64), default=1)
    parser.add_argument("--rows", nargs="+", choices=PEERS, default=list(PEERS), help="train these alone")
    parser.add_argument("--table", action="store_true", help="train nothing")
    options = parser.parse_args()
    end_with_the_runs()
    try:
        failed = [] if options.table else train_all(options.at_once, options.rows)
        for line in table():
            print(f"{line[0]:36}" + "  ".join(f"{word:24}" for word in line[1:]).rstrip())
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
