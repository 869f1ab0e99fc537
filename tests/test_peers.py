"""`benchmarks/peers.py`: its table of what is trained, and which runs are left to do."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import peers
import pytest

import ppo_gtrxl_rocket
from common.schedule import Schedule


def trained(folder, name, seed, **final):
    curve = [{"samples": 10, "minutes": 1.0}, {"samples": 20, "minutes": 2.0 + seed}]
    (folder / f"{name}_{seed}.json").write_text(json.dumps({"curve": curve, "final": final}))


def test_table_of_what_is_there(tmp_path, monkeypatch):
    monkeypatch.setattr(peers, "FOLDER", tmp_path)
    assert peers.table() == []
    for seed, ratio in ((1, 1.02), (2, 1.01), (3, 1.5)):
        trained(tmp_path, "di", seed, ratio_of_sums=ratio, ratio_p95=1.1, hit_rate=1.0)
    header, row = peers.table()
    assert header == ["", "seeds", "samples", "minutes", "ratio of sums", "p95", "hits"]
    assert row[1:5] == ["3", "20", "4 (3 to 5)", "1.02 (1.01 to 1.5)"]
    trained(tmp_path, "cutoff", 1, error_norm=0.002, perigee_km=180.0, mass_ratio=0.99)
    assert len(peers.table()) == 4  # another problem has another header


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder to train in: where it is and where the figures go."""
    monkeypatch.setattr(peers, "FOLDER", tmp_path / "figures")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "figures").mkdir()
    return tmp_path


@pytest.fixture
def commands(monkeypatch):
    """What is started instead of a training; each lasts a moment, is told apart by its --save, and ends with 0."""
    started, failing = [], []

    def run(command, **_):
        started.append(f"begin {saved(command)}")
        time.sleep(0.1)
        code = int(saved(command) in failing)
        if not code:
            Path(saved(command)).touch()
            Path(saved(command)).with_suffix(".pkl").touch()
            name, seed = Path(saved(command)).stem.removeprefix("peer_").rsplit("_", 1)
            trained(Path("figures"), name, int(seed))
        started.append(f"end {saved(command)}")
        return subprocess.CompletedProcess(command, code)

    monkeypatch.setattr(subprocess, "run", run)
    return started, failing


def saved(command):
    return command[command.index("--save") + 1]


def test_a_run_that_is_there_is_not_done_again(folder, monkeypatch):
    started = []
    ended = subprocess.CompletedProcess([], 0)
    monkeypatch.setattr(subprocess, "run", lambda command, **_: started.append(command) or ended)
    trained(folder / "figures", "di", 1)
    assert peers.train("di", 1) is None and not started
    assert peers.train("di", 2) is None
    assert started[0][started[0].index("--seed") + 1] == "2" and "figures/di_2.json" in started[0]


def two_rows(monkeypatch):
    rows = {"first": peers.Peer("", "", {}, (1, 2)), "second": peers.Peer("", "", {}, (1, 2), start="first")}
    monkeypatch.setattr(peers, "PEERS", rows)


def test_a_row_waits_for_the_one_that_it_begins_with(folder, commands, monkeypatch):
    started, _ = commands
    two_rows(monkeypatch)
    assert peers.train_all(4) == []
    for seed in (1, 2):
        first, second = f"end runs/peer_first_{seed}.zip", f"begin runs/peer_second_{seed}.zip"
        assert started.index(first) < started.index(second)


def test_every_command_is_one_that_the_script_takes(monkeypatch):
    pytest.importorskip("sb3_contrib")
    import sb3_ppo

    for peer in peers.PEERS.values():
        monkeypatch.setattr(sys, "argv", ["sb3_ppo.py", *peer.flags.split()])
        options = sb3_ppo.parse_args()
        assert (peer.start == "lstm") == bool(options.dispersion)


def test_the_dispersed_row_has_the_noise_of_ours():
    """That with which our recipe begins; the mass is paid for in another way."""
    theirs = float(re.search(r"--log-std (\S+)", peers.PEERS["lstm_dispersed"].flags)[1])
    assert Schedule(ppo_gtrxl_rocket.DISPERSED["log_std"]).at(0.0) == theirs
