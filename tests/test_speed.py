"""`benchmarks.speed`: an update's figures, gathered windows against the scripts."""

import re
import sys
from argparse import Namespace

import pytest
import torch

from benchmarks import speed

pytestmark = pytest.mark.slow


@pytest.fixture
def small(monkeypatch):
    """The double integrator's script with a small network, two minibatches and a memory of 20."""
    sizes = {"num_envs": 3, "num_minibatches": 2, "num_blocks": 2, "embed_dim": 8, "num_heads": 2, "memory_length": 20}
    monkeypatch.setitem(speed.SIZES, "small", ("ppo_gtrxl_di", sizes))


def test_a_script_is_measured(small):
    """Parts are parts of the whole."""
    figures = speed.measure("small", "plain", Namespace(repeats=1, tf32=False, cuda=False))
    rollout, epoch, update = (float(re.match(r"[0-9.]+", figures[key])[0]) for key in ("rollout", "epoch", "update"))
    assert rollout > 0 and epoch > 0 and update == pytest.approx(rollout + 8 * epoch, abs=0.02)
    parts = {name: float(seconds) for name, seconds in re.findall(r"(\w+) ([0-9.]+) s", figures["parts"])}
    assert 0 < parts["environment"] + parts["network"] <= parts["rollout"] < parts["update"]
    assert 0 < parts["gradients"] < parts["update"]


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


def test_a_size_that_is_none_is_refused_in_one_line(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["speed", "update", "huge"])
    with pytest.raises(SystemExit) as end:
        speed.main()
    assert str(end.value).startswith("error: huge must be among di, vdp") and "\n" not in str(end.value)
