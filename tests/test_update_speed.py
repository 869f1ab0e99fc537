"""`benchmarks/update_speed.py`: its FLOP formula against torch's counter, its gathered windows against the scripts."""

import importlib
import re

import pytest
import torch

pytestmark = pytest.mark.slow

TINY = {"num_envs": 3, "num_minibatches": 2, "num_blocks": 2, "embed_dim": 8, "num_heads": 2, "memory_length": 20}


@pytest.fixture(scope="module")
def speed():
    return importlib.import_module("update_speed")


def test_a_script_is_measured(speed):
    """With three episodes; the FLOP by formula are those that torch counts."""
    figures = speed.measure("di", 1, 1, changes=TINY)
    formula, counted = re.findall(r"[0-9.]+e[+][0-9]+", figures["FLOP of an epoch"])
    assert float(formula) == float(counted)
    seconds = [float(re.match(r"[0-9.]+", figures[name])[0]) for name in ("rollout", "epoch", "update")]
    assert seconds[0] > 0 and seconds[2] >= seconds[1] > 0
    assert float(re.search(r"([0-9.]+) of the same", figures["FLOP/s"])[1]) < 1.1


def test_gathered_windows_give_the_same_hidden_states(speed):
    """Every sample with its own window, at the first steps, too, where the window is memory: 1e-5 in float32."""
    bench = speed.Workbench("ppo_gtrxl_di", **TINY)
    for block in bench.agent.blocks:
        torch.nn.init.normal_(block.attention.R)  # zero at first, when the order in a window does not matter
    batch = bench.rollout()
    obs = batch.obs.transpose(0, 1)
    hidden, slots = bench.agent.encode(obs, batch.memory), speed.block_inputs(bench.agent, obs, batch.memory)
    n, t = torch.cartesian_prod(torch.arange(3), torch.arange(50)).T
    windows = slots[:, n[:, None], t[:, None] + torch.arange(20)]
    gathered = speed.encode_gathered(bench.agent, obs[n, t], windows)
    torch.testing.assert_close(gathered, hidden[n, t], rtol=0, atol=1e-5)
    wrong = speed.encode_gathered(bench.agent, obs[n, t], windows.roll(1, dims=2))
    assert (wrong - hidden[n, t]).abs().max() > 1e-3
