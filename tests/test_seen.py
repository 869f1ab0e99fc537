"""`benchmarks/seen.py`: shares of variance by closed forms, the shipped policy's table, and what it refuses."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import seen

RESULTS = Path(__file__).parent.parent / "results"


def test_explained_is_the_square_of_the_correlation():
    """Of one input; of several that the target is the sum of, one; of what has nothing to do with it, next to none."""
    x, noise = np.random.default_rng(0).standard_normal((2, 1000))
    assert seen.explained(x[:, None], x + noise) == pytest.approx(np.corrcoef(x, x + noise)[0, 1] ** 2)
    assert seen.explained(np.stack([x, noise], 1), 3 * x - noise + 5) == pytest.approx(1)
    assert seen.explained(noise[:, None], x) < 0.01


def run(monkeypatch, path, flights=seen.FLIGHTS):
    monkeypatch.setattr(sys, "argv", ["seen.py", str(path)])
    monkeypatch.setattr(seen, "FLIGHTS", flights)
    seen.main()


def test_the_shipped_policy(monkeypatch, capsys):
    """No difference is far from its size; ten seconds before the end they tell the misses that are left."""
    run(monkeypatch, RESULTS / "rocket_dispersed/agent.safetensors", flights=40)
    _, _, *lines = capsys.readouterr().out.splitlines()
    rows = np.array([re.findall(r"[\d.]+", line) for line in lines], dtype=float)
    assert rows.shape == (10, 1 + 8 + 4) and rows[0, 0] == 100 and (np.diff(rows[:, 0]) > 0).all()
    assert rows[:, 1:9].max() < 10
    assert (rows[:, 9:] <= 1).all() and rows[-1, 9:].min() > 0.8
