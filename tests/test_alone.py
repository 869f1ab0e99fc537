"""`benchmarks/alone.py`: the line of a training by its shipped curve, the run that it deletes, and what is refused."""

import csv
import sys

import alone
import numpy as np
import pytest

DI = alone.ROOT / "results" / "di" / "seeds" / "1.csv"


def test_a_line_sets_a_training_beside_the_shipped_run_after_as_many_updates(monkeypatch):
    third = float(list(csv.DictReader(DI.open()))[2]["charts/SPS"])
    curve = {alone.SPS: (np.array([1, 2, 3]), np.array([5.0, 6.0, 2 * third]))}
    monkeypatch.setattr(alone, "curve_of", lambda job, seconds: curve)
    name, fast, shipped, ratio, updates = alone.compare("results/di", alone.first_jobs()["results/di"], 50).split()
    assert (name, updates, ratio) == ("results/di", "3", "2.00")
    assert float(fast) == pytest.approx(2 * third, abs=0.5) and float(shipped) == pytest.approx(third, abs=0.5)


@pytest.mark.slow
def test_a_training_is_started_and_its_folder_deleted():
    before = set((alone.ROOT / "runs").glob("*"))
    alone.curve_of(alone.first_jobs()["results/di"], seconds=1)
    assert set((alone.ROOT / "runs").glob("*")) == before


@pytest.mark.parametrize("curve", [{}, None])
def test_refusals_are_one_line(curve, monkeypatch):
    """A training without an update, and a result that is not in the list."""
    monkeypatch.setattr(alone, "curve_of", lambda job, seconds: curve)
    monkeypatch.setattr(sys, "argv", ["alone.py", "results/nothing" if curve is None else "results/di"])
    with pytest.raises(SystemExit) as end:
        alone.main()
    said = str(end.value)
    assert said.startswith("error: ") and "\n" not in said
    assert ("must be among" in said) if curve is None else ("made no update" in said)
