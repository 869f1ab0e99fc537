"""`benchmarks/peers.py`: its table of what is trained, and which runs are left to do."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import peers
import pytest


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


def test_rows_trains_these_alone(folder, commands, monkeypatch):
    """A row that begins with another needs that one's policy, which may be of an earlier call."""
    started, _ = commands
    two_rows(monkeypatch)
    for name in ("first", "second"):
        monkeypatch.setattr(sys, "argv", ["peers.py", "--rows", name])
        peers.main()
        assert {line.split()[1] for line in started} == {f"runs/peer_{name}_{seed}.zip" for seed in (1, 2)}
        started.clear()


def test_rows_may_be_named_in_any_order(folder, commands, monkeypatch):
    started, _ = commands
    two_rows(monkeypatch)
    assert peers.train_all(1, ["second", "first", "second"]) == [] and len(started) == 2 * 4


def test_failed_runs_are_named_and_exit_with_1(folder, commands, monkeypatch, capsys):
    """Also those that had nothing to begin with; the others are trained."""
    started, failing = commands
    two_rows(monkeypatch)
    failing.append("runs/peer_first_2.zip")
    monkeypatch.setattr(sys, "argv", ["peers.py"])
    with pytest.raises(SystemExit) as stop:
        peers.main()
    failed, missing = str(stop.value.code).splitlines()
    assert failed == "error: first, seed 2: ended with 1, see runs/peer_first_2.log"
    assert missing.startswith("error: second, seed 2: runs/peer_first_2.zip is missing, with which it begins; ")
    assert len(started) == 2 * 3 and (folder / "figures" / "second_1.json").exists()


def test_a_policy_that_is_gone_is_named(folder, commands, monkeypatch):
    """Its figures are in results/, which git has, the policy in runs/, which git has not."""
    started, _ = commands
    two_rows(monkeypatch)
    trained(folder / "figures", "first", 1)
    assert "delete figures/first_1.json, if it is there" in peers.train("second", 1) and not started


@pytest.mark.parametrize("content", ['{"curve": [{"samp', "[]", '{"final": {}}'])
def test_a_damaged_file_is_one_line(folder, monkeypatch, content):
    (folder / "figures" / "di_1.json").write_text(content)
    monkeypatch.setattr(sys, "argv", ["peers.py", "--table"])
    with pytest.raises(SystemExit, match=r"^error: figures/di_1.json is not what sb3_ppo.py writes .*again$"):
        peers.main()


def test_every_command_is_one_that_the_script_takes(monkeypatch):
    pytest.importorskip("sb3_contrib")
    import sb3_ppo

    for peer in peers.PEERS.values():
        monkeypatch.setattr(sys, "argv", ["sb3_ppo.py", *peer.flags.split()])
        options = sb3_ppo.parse_args()
        assert (peer.start == "lstm") == bool(options.dispersion)


def test_the_dispersed_row_has_the_noise_of_ours():
    """The flags that result_jobs.txt gives our script for its dispersed rocket; the mass is paid for in another way."""
    lines = (Path(peers.ROOT) / "benchmarks" / "result_jobs.txt").read_text().splitlines()
    (ours, *_) = (line for line in lines if line.startswith("results/rocket_dispersed "))
    theirs = peers.PEERS["lstm_dispersed"].flags
    for name in ("--dispersion", "--log-std"):
        value, other = (re.search(rf"{name} (\S+)", flags)[1] for flags in (ours, theirs))
        assert float(value) == float(other), name
