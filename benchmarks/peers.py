"""Stable-Baselines3 beside our results: trains what is missing in results/peers, then prints the table.

    pip install -r benchmarks/requirements.txt
    python benchmarks/peers.py --at-once 2    # hours
    python benchmarks/peers.py --table        # of what is there

Each row is one way of learning, seeds 1 to 3, by `benchmarks/sb3_ppo.py` with the settings that were best for it in
short trials (docs/other-learners.md). Figures are medians with the range of all seeds.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))
from memory import cell  # noqa: E402

FOLDER = ROOT / "results" / "peers"
CUTOFF = "--env-id RocketAscentCutoff-v0 --batch-size 512 --learning-rate 1e-3"
LSTM = "--env-id RocketAscentCutoff-v0 --recurrent --batch-size 3848 --epochs 6 --learning-rate 1e-3 --samples 3700000"
DI_KEYS = {"ratio_of_sums": "ratio of sums", "ratio_p95": "p95", "hit_rate": "hits"}
ROCKET_KEYS = {"error_norm": "||error||", "perigee_km": "perigee (km)", "mass_ratio": "mass / optimum"}
DISPERSED_KEYS = {"dispersed_error_median": "median", "dispersed_error_p95": "p95", "dispersed_box_rate": "in the box"}


@dataclass
class Peer:
    """A row: what is printed of it, the flags of `sb3_ppo.py`, the keys of its final evaluation, its seeds."""

    title: str
    flags: str
    keys: dict[str, str]
    seeds: tuple[int, ...] = (1, 2, 3)


PEERS = {
    "lstm": Peer("LSTM, cut-off", LSTM, ROCKET_KEYS, (1,)),
    "di": Peer("double integrator, our samples", "--samples 2560000", DI_KEYS),
    "cutoff": Peer("cut-off, our features, our samples", f"{CUTOFF} --samples 7450000", ROCKET_KEYS),
    "cutoff_longer": Peer("cut-off, our features, our minutes", f"{CUTOFF} --samples 11000000", ROCKET_KEYS),
    "cutoff_raw": Peer("cut-off, raw, our samples", f"{CUTOFF} --samples 7450000 --features raw", ROCKET_KEYS),
    "lstm_dispersed": Peer(
        "LSTM, from there, dispersed",
        f"{LSTM} --dispersion 1 --mass-weight 0.5 --log-std -3.5 --start runs/peer_lstm_1.zip",
        DISPERSED_KEYS,
        (1,),
    ),
}


def train(name, seed):
    """One run, unless its file is there."""
    path = FOLDER / f"{name}_{seed}.json"
    if path.exists():
        return
    flags = f"{PEERS[name].flags} --seed {seed} --save runs/peer_{name}_{seed}.zip --json {path}"
    with open(f"runs/peer_{name}_{seed}.log", "w") as log:
        command = [sys.executable, ROOT / "benchmarks" / "sb3_ppo.py", *shlex.split(flags)]
        ended = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT)
    print(f"{name}, seed {seed}: ended with {ended.returncode}", flush=True)


def table():
    """Rows with different figures have headers of their own."""
    lines, keys = [], None
    for name, peer in PEERS.items():
        paths = [FOLDER / f"{name}_{seed}.json" for seed in peer.seeds]
        runs = [json.loads(path.read_text()) for path in paths if path.exists()]
        if runs and peer.keys != keys:
            keys = peer.keys
            lines.append(["", "seeds", "samples", "minutes", *keys.values()])
        if runs:
            last = [run["curve"][-1] for run in runs]
            cells = [cell([run["final"][key] for run in runs]) for key in keys]
            minutes = cell([point["minutes"] for point in last])
            lines.append([peer.title, str(len(runs)), str(last[0]["samples"]), minutes, *cells])
    return lines


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--at-once", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="train nothing")
    options = parser.parse_args()
    if not options.table:
        FOLDER.mkdir(parents=True, exist_ok=True)
        Path("runs").mkdir(exist_ok=True)
        jobs = [(name, seed) for name, peer in PEERS.items() for seed in peer.seeds]
        with ThreadPoolExecutor(options.at_once) as pool:
            list(pool.map(lambda job: train(*job), jobs))
    for line in table():
        print(f"{line[0]:36}" + "  ".join(f"{word:24}" for word in line[1:]).rstrip())


if __name__ == "__main__":
    main()
