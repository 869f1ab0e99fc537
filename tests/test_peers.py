"""`benchmarks.peers`: its table of what is trained, and which runs are left to do."""

import json
import subprocess
import sys

import pytest

from benchmarks import peers


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
    """An empty folder to train in, with one row of two seeds."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(peers, "PEERS", {"first": peers.Peer("", "", {})})
    monkeypatch.setattr(peers, "SEEDS", (1, 2))
    return tmp_path


@pytest.fixture
def started(monkeypatch):
    """The commands that are started. In the place of a training is a program that writes an empty record."""
    commands = []

    def start(command, name):
        commands.append(command)
        file = command[command.index("--json") + 1]
        code = f"import time; time.sleep(0.1); open({file!r}, 'w').write({RECORD!r})"
        return subprocess.Popen([sys.executable, "-c", code])

    monkeypatch.setattr(peers, "start_logged", start)
    return commands


RECORD = json.dumps({"curve": [{"samples": 1, "minutes": 1.0}], "final": {}})


def test_a_run_that_is_there_is_not_done_again(folder, started):
    peers.FOLDER.mkdir(parents=True)
    trained(peers.FOLDER, "first", 1)
    assert peers.train_all(1, ["first"]) == []
    (command,) = started
    assert command[command.index("--seed") + 1] == "2" and "results/peers/first_2.json" in command


def test_every_command_is_one_that_the_script_takes(monkeypatch):
    pytest.importorskip("stable_baselines3")
    from benchmarks import sb3_ppo

    for peer in peers.PEERS.values():
        monkeypatch.setattr(sys, "argv", ["sb3_ppo.py", *peer.flags.split()])
        sb3_ppo.parse_args()
