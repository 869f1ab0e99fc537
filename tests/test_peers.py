"""`benchmarks/peers.py`: its table of what is trained, and which runs are left to do."""

import json
import subprocess

import peers


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


def test_a_run_that_is_there_is_not_done_again(tmp_path, monkeypatch):
    monkeypatch.setattr(peers, "FOLDER", tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    started = []
    monkeypatch.setattr(
        subprocess, "run", lambda command, **_: started.append(command) or subprocess.CompletedProcess([], 0)
    )
    trained(tmp_path, "di", 1)
    peers.train("di", 1)
    assert not started
    peers.train("di", 2)
    assert started[0][started[0].index("--seed") + 1] == "2" and str(tmp_path / "di_2.json") in started[0]
