"""Stable-Baselines3 beside our results: train the runs that results/peers lacks, then print the table.

    pip install -r benchmarks/requirements.txt
    python benchmarks/peers.py --at-once 2    # hours; --rows di cutoff: these alone
    python benchmarks/peers.py --table        # of what is there

Each row is one way of learning, with seeds 1 to 3, by `benchmarks/sb3_ppo.py` with the settings that were best for it
in short trials (docs/other-learners.md). Numbers are medians with the range of all seeds. The exit status is 1 if a run
failed.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))
from memory import cell  # noqa: E402

from common.command_line import OneLineParser, integer  # noqa: E402

FOLDER = ROOT / "results" / "peers"
LOW_PRICE = "--mass-weight 0.3"  # of the propellant: under the full one, which rises to 3, it loses the orbit
CUTOFF = f"--env-id RocketAscentCutoff-v0 --batch-size 512 --learning-rate 1e-3 --samples 7450000 {LOW_PRICE}"
LSTM = "--env-id RocketAscentCutoff-v0 --recurrent --batch-size 3848 --epochs 6 --learning-rate 1e-3 --samples 3700000"
DI_KEYS = {"ratio_of_sums": "ratio of sums", "ratio_p95": "p95", "hit_rate": "hits"}
ROCKET_KEYS = {"error_norm": "||error||", "perigee_km": "perigee (km)", "mass_ratio": "mass / optimum"}
DISPERSED_KEYS = {"dispersed_error_median": "median", "dispersed_error_p95": "p95", "dispersed_box_rate": "in the box"}


@dataclass
class Peer:
    """A row: its label, the flags of `sb3_ppo.py`, the keys of its final evaluation, its seeds.

    `start` names an earlier row: each seed begins with the policy that it saved.
    """

    title: str
    flags: str
    keys: dict[str, str]
    seeds: tuple[int, ...] = (1, 2, 3)
    start: str = ""


PEERS = {
    "cutoff": Peer("cut-off, propellant at full price", f"{CUTOFF} --mass-weight 3", ROCKET_KEYS),
    "cutoff_low_price": Peer("cut-off, a tenth of that price", CUTOFF, ROCKET_KEYS),
    "cutoff_raw": Peer("cut-off, a tenth, raw observations", f"{CUTOFF} --features raw", ROCKET_KEYS),
    "cutoff_longer": Peer("cut-off, a tenth, twice the samples", f"{CUTOFF} --samples 14900000", ROCKET_KEYS),
    "lstm": Peer("LSTM, cut-off, a tenth", f"{LSTM} {LOW_PRICE}", ROCKET_KEYS, (1,)),
    "lstm_dispersed": Peer(
        "LSTM, from there, dispersed",
        f"{LSTM} --dispersion 1 --mass-weight 0.5 --log-std -3.5 --learning-rate 1e-4",  # with 1e-3 it loses the orbit
        DISPERSED_KEYS,
        (1,),
        start="lstm",
    ),
    "di": Peer("double integrator", "--samples 2560000", DI_KEYS),
}


def result(name, seed):
    """The file in which a run writes its numbers, relative to here, so that no machine's folders are in its command."""
    return Path(os.path.relpath(FOLDER / f"{name}_{seed}.json"))


def policy(name, seed):
    """The file in which a run saves its policy. VecNormalize is beside it as .pkl."""
    return Path(f"runs/peer_{name}_{seed}.zip")


def train(name, seed, before=None):
    """Do one run after the future `before`, unless its file is there. Returns why it failed, or None."""
    path, peer = result(name, seed), PEERS[name]
    if before:
        before.result()
    if path.exists():
        return None
    flags = [*shlex.split(peer.flags), "--seed", str(seed), "--save", str(policy(name, seed)), "--json", str(path)]
    if peer.start:
        start = policy(peer.start, seed)
        for file in (start, start.with_suffix(".pkl")):
            if not file.is_file():
                again = f"delete {result(peer.start, seed)}, if it is there, to train that again"
                return f"{name}, seed {seed}: {file} is missing, with which it begins; {again}"
        flags += ["--start", str(start)]
    log = policy(name, seed).with_suffix(".log")
    with open(log, "w") as file:
        command = [sys.executable, ROOT / "benchmarks" / "sb3_ppo.py", *flags]
        ended = subprocess.run(command, stdout=file, stderr=subprocess.STDOUT)
    print(f"{name}, seed {seed}: ended with {ended.returncode}", flush=True)
    return f"{name}, seed {seed}: ended with {ended.returncode}, see {log}" if ended.returncode else None


def train_all(at_once, rows=None):
    """Every run of `rows` (None: all) that is missing, `at_once` at a time, each after the one that it begins with.

    Returns why some failed.
    """
    FOLDER.mkdir(parents=True, exist_ok=True)
    Path("runs").mkdir(exist_ok=True)
    futures = {}
    with ThreadPoolExecutor(at_once) as pool:
        for name in (name for name in PEERS if rows is None or name in rows):
            for seed in PEERS[name].seeds:
                futures[name, seed] = pool.submit(train, name, seed, futures.get((PEERS[name].start, seed)))
    return [future.result() for future in futures.values() if future.result()]


def read(path):
    """The numbers that a run wrote. Raises ValueError that names a file of another kind."""
    try:
        run = json.loads(path.read_text())
        return {"curve": run["curve"], "final": run["final"]}
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path} is not what sb3_ppo.py writes ({error!r}); delete it to train it again") from error


def table():
    """The lines of the table. Rows with other numbers have their own header."""
    lines, keys = [], None
    for name, peer in PEERS.items():
        paths = [result(name, seed) for seed in peer.seeds]
        runs = [read(path) for path in paths if path.exists()]
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
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("--at-once", type=integer(1, 64), default=1)
    parser.add_argument("--rows", nargs="+", choices=PEERS, help="train these alone")
    parser.add_argument("--table", action="store_true", help="train nothing")
    options = parser.parse_args()
    try:
        failed = [] if options.table else train_all(options.at_once, options.rows)
        for line in table():
            print(f"{line[0]:36}" + "  ".join(f"{word:24}" for word in line[1:]).rstrip())
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")
    if failed:
        sys.exit("\n".join(f"error: {line}" for line in failed))


if __name__ == "__main__":
    main()
