"""`benchmarks.speed`: an update's figures, gathered windows against the scripts, a training beside its shipped run."""

import csv
import re
import sys
from argparse import Namespace

import numpy as np
import pytest
import torch

from benchmarks import speed

pytestmark = pytest.mark.slow

DI = speed.ROOT / "results" / "di" / "seeds" / "1.csv"


@pytest.fixture
def small(monkeypatch):
    """The double integrator's script with a small network, two minibatches and a memory of 20."""
    sizes = {"num_envs": 3, "num_minibatches": 2, "num_blocks": 2, "embed_dim": 8, "num_heads": 2, "memory_length": 20}
    monkeypatch.setitem(speed.SIZES, "small", ("ppo_gtrxl_di", sizes))


def test_a_script_is_measured(small):
    """Parts are parts of the whole; the products alone take less than the epoch of which they are."""
    figures = speed.measure("small", "plain", Namespace(threads=1, repeats=1, tf32=False, cuda=False))
    rollout, epoch, update = (float(re.match(r"[0-9.]+", figures[key])[0]) for key in ("rollout", "epoch", "update"))
    assert rollout > 0 and epoch > 0 and update == pytest.approx(rollout + 8 * epoch, abs=0.02)
    parts = {name: float(seconds) for name, seconds in re.findall(r"(\w+) ([0-9.]+) s", figures["parts"])}
    assert 0 < parts["environment"] + parts["network"] <= parts["rollout"] < parts["update"]
    assert 0 < parts["gradients"] < parts["update"]
    assert float(figures["rate"].split()[0]) < 1.1


def test_gathered_windows_give_the_same_hidden_states(small):
    """Every sample with its own window, at the first steps, too, where the window is memory: 1e-5 in float32."""
    bench = speed.Bench("small")
    for block in bench.agent.blocks:
        torch.nn.init.normal_(block.attention.R)  # zero at first, when the order in a window does not matter
    batch = bench.flown()
    obs = batch.obs.transpose(0, 1)
    hidden, slots = bench.agent.encode(obs, batch.memory), speed.block_inputs(bench.agent, obs, batch.memory)
    n, t = torch.cartesian_prod(torch.arange(3), torch.arange(50)).T
    windows = slots[:, n[:, None], t[:, None] + torch.arange(20)]
    gathered = speed.encode_gathered(bench, obs[n, t], windows)
    torch.testing.assert_close(gathered, hidden[n, t], rtol=0, atol=1e-5)
    wrong = speed.encode_gathered(bench, obs[n, t], windows.roll(1, dims=2))
    assert (wrong - hidden[n, t]).abs().max() > 1e-3


def test_a_line_sets_a_training_beside_the_shipped_run_after_as_many_updates(monkeypatch):
    third = float(list(csv.DictReader(DI.open()))[2]["charts/SPS"])
    curve = {speed.SPS: (np.array([1, 2, 3]), np.array([5.0, 6.0, 2 * third]))}
    monkeypatch.setattr(speed, "curve_of", lambda training, seconds: curve)
    training = speed.first_trainings()["results/di"]
    name, fast, shipped, ratio, updates = speed.compare("results/di", training, 50).split()
    assert (name, updates, ratio) == ("results/di", "3", "2.00")
    assert float(fast) == pytest.approx(2 * third, abs=0.5) and float(shipped) == pytest.approx(third, abs=0.5)


def test_a_training_is_started_and_its_folder_deleted():
    before = set((speed.ROOT / "runs").glob("*"))
    speed.curve_of(speed.first_trainings()["results/di"], seconds=1)
    assert set((speed.ROOT / "runs").glob("*")) == before


@pytest.mark.parametrize(
    "argv, said",
    [
        (["trainings", "results/nothing"], "results/nothing must be among results/di"),
        (["trainings", "results/di/"], "results/di made no update in 50 s"),
        (["update", "huge"], "huge must be among tiny, di"),
    ],
)
def test_refusals_are_one_line(argv, said, monkeypatch):
    monkeypatch.setattr(speed, "curve_of", lambda training, seconds: {})
    monkeypatch.setattr(sys, "argv", ["speed", *argv])
    with pytest.raises(SystemExit) as end:
        speed.main()
    assert str(end.value).startswith(f"error: {said}") and "\n" not in str(end.value)
