"""The Gated Transformer-XL: rollout = training, and both against the paper's equations in plain NumPy loops.

The scripts' shared sections are the same (test_scripts.py), so one script stands for all.
"""

import gymnasium as gym
import numpy as np
import pytest
import torch
from helpers import SMALL
from scipy.special import erf
from torch.utils.flop_counter import FlopCounterMode

import ppo_gtrxl_di as script

torch.set_num_threads(1)
TOLERANCE = {torch.float64: 1e-9, torch.float32: 1e-5}


def make_agent(dtype=torch.float64, envs=None, plain=False, **sizes):
    """A small agent. Unless `plain`, what starts as a constant (R, biases, norms) is moved away from it."""
    args = script.Args(**{**SMALL, "num_blocks": 2, **sizes})
    torch.manual_seed(0)
    agent = script.Agent(args, envs or gym.make_vec(args.env_id, num_envs=1)).to(dtype)
    if not plain:
        with torch.no_grad():
            for name, parameter in agent.named_parameters():
                if name.endswith(("bias", "R")) or "norm" in name:
                    parameter += 0.5 * torch.randn_like(parameter)
            agent.actor[-1].weight *= 20  # means of order one
    return agent


def episodes(agent, N, T, noise=0.1):
    """Random observations (N, T, 3) and memory for them."""
    return torch.randn(N, T, 3, dtype=agent.actor_logstd.dtype), agent.new_memory(N, noise)


@torch.no_grad()
def encode_stepwise(agent, obs, memory):
    """The rollout's way: one step at a time on the key/value cache."""
    cache = agent.start_cache(memory, obs.shape[1])
    return torch.stack([agent.encode_step(obs[:, t], cache, t) for t in range(obs.shape[1])], dim=1)


def array(tensor):
    return tensor.detach().numpy().astype(np.float64)


# --- rollout = training -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype, num_blocks", [(torch.float64, 0), (torch.float64, 3), (torch.float32, 1)], ids=str)
@pytest.mark.parametrize("T, L", [(3, 8), (8, 8), (1, 4), (80, 8), (80, 20), (133, 20), (150, 160), (5, 0), (80, 0)])
def test_cache_and_parallel_pass_agree(dtype, num_blocks, T, L):
    """T shorter than, equal to and longer than L, and not a multiple of the chunk (of at most max(L / 2, 64) steps)."""
    agent = make_agent(dtype, num_blocks=num_blocks, memory_length=L)
    obs, memory = episodes(agent, 3, T)
    parallel, stepwise = agent.encode(obs, memory), encode_stepwise(agent, obs, memory)
    same = {"rtol": 0, "atol": TOLERANCE[dtype]}
    torch.testing.assert_close(stepwise, parallel, **same)
    torch.testing.assert_close(agent.get_mean_action(stepwise), agent.get_mean_action(parallel), **same)
    actions = agent.get_policy(stepwise).sample()
    for rolled, trained in zip(*(agent.evaluate_actions(hidden, actions) for hidden in (stepwise, parallel))):
        torch.testing.assert_close(rolled, trained, **same)


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
def test_rollout_stores_what_training_recomputes(dtype, uneven_envs):
    """The real `rollout`, episodes of different lengths in one batch and restarts within it."""
    envs = uneven_envs([23, 5, 17, 1], spare_steps=2)
    agent = make_agent(dtype, envs, memory_length=4)
    batch, finals = script.rollout(agent, envs, {}, 0.1, 0.1)
    alive = np.arange(25)[:, None] < envs.lengths
    np.testing.assert_array_equal(batch.alive.numpy(), alive)
    hidden = agent.encode(batch.obs.transpose(0, 1), batch.memory).transpose(0, 1)
    logprobs, _, values = agent.evaluate_actions(hidden, batch.actions)
    for rolled, trained in ((batch.logprobs, logprobs), (batch.critic, values)):
        torch.testing.assert_close(rolled[batch.alive > 0], trained[batch.alive > 0], rtol=0, atol=TOLERANCE[dtype])
    living = alive[:23]
    np.testing.assert_allclose(array(batch.obs)[:23][living], np.array(envs.given_obs)[:23][living], atol=1e-7)
    np.testing.assert_array_equal(array(batch.actions)[:23][living], np.array(envs.taken_actions)[:23][living])
    rewards = np.array(envs.given_rewards)[:23] * living
    np.testing.assert_allclose(array(batch.rewards)[:23], 0.1 * rewards, rtol=1e-6)
    np.testing.assert_allclose(finals["episodic_return"], rewards.sum(axis=0), rtol=1e-6)


def test_memory_is_noise_of_the_given_spread():
    agent = make_agent(torch.float32, memory_length=32, num_blocks=3)
    memory = agent.new_memory(50, noise=0.1)
    assert memory.shape == (3, 50, 32, 8)
    assert memory.std().item() == pytest.approx(0.1, rel=0.02) and abs(memory.mean().item()) < 2e-3
    assert memory.unique().numel() > 0.99 * memory.numel()  # its own draw for each block, episode, slot and entry
    assert not agent.new_memory(2, noise=0.0).any()


# --- the paper's equations, in NumPy ----------------------------------------------------------------------------------


def naive_attention(attention, x, memory):
    """A_ij = (x_i W^Q)(x_j W^K + R_{i-j})^T / sqrt(d_k) by loops over episodes, heads, i and j; j from i - L to i."""
    (N, T, d), L, H = x.shape, memory.shape[1], attention.num_heads
    WQ, WK, WV, WO = (array(w.weight).T for w in (attention.query, attention.key, attention.value, attention.out))
    dk, R, result = d // H, array(attention.R), np.zeros_like(x)
    for n in range(N):
        for h in range(H):
            head = slice(h * dk, (h + 1) * dk)
            for i in range(T):
                A, v = [], []
                for j in range(i - L, i + 1):
                    x_j = x[n, j] if j >= 0 else memory[n, L + j]
                    A.append((x[n, i] @ WQ[:, head]) @ (x_j @ WK[:, head] + R[h, i - j]) / np.sqrt(dk))
                    v.append(x_j @ WV[:, head])
                weight = np.exp(A) / np.exp(A).sum()
                result[n, i, head] = weight @ np.array(v)
    return result @ WO


def naive_gate(gate, x, y):
    """lambda x + (1 - lambda) y, lambda = sigmoid(W_g [x, y] + b_g)."""
    lam = 1 / (1 + np.exp(-(np.concatenate([x, y], -1) @ array(gate.linear.weight).T + array(gate.linear.bias))))
    return lam * x + (1 - lam) * y


def naive_norm(norm, x):
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5)
    return x * array(norm.weight) + array(norm.bias)


def naive_linear(layer, x):
    return x @ array(layer.weight).T + array(layer.bias)


def gelu(x):
    return x * (1 + erf(x / np.sqrt(2))) / 2


def naive_block(block, x, attended):
    """h1 = gate(x, LayerNorm(x + MultiHead(x))), h2 = gate(h1, LayerNorm(h1 + MLP(h1)))."""
    h1 = naive_gate(block.gate1, x, naive_norm(block.norm1, x + attended))
    mlp = naive_linear(block.mlp[2], gelu(naive_linear(block.mlp[0], h1)))
    return naive_gate(block.gate2, h1, naive_norm(block.norm2, h1 + mlp))


@pytest.mark.parametrize(
    "num_heads, T, L", [(1, 1, 3), (2, 5, 3), (4, 3, 5), (4, 80, 3), (2, 135, 18), (1, 70, 132), (2, 80, 0)]
)
def test_attention_is_the_papers_equation(num_heads, T, L):
    attention = make_agent(num_heads=num_heads, memory_length=L).blocks[0].attention
    x, memory = torch.randn(2, T, 8, dtype=torch.float64), torch.randn(2, L, 8, dtype=torch.float64)
    expected = naive_attention(attention, array(x), array(memory))
    np.testing.assert_allclose(array(attention(x, memory)), expected, atol=1e-12)
    cache = attention.start_cache(memory, T)
    with torch.no_grad():
        stepwise = torch.stack([attention.step(x[:, t], cache, t) for t in range(T)], dim=1)
    np.testing.assert_allclose(array(stepwise), expected, atol=1e-12)


def test_whole_network_is_encoder_blocks_and_heads():
    """Each block has its own memory, which holds inputs of that block; the heads read the last block's output."""
    agent = make_agent(memory_length=3, num_blocks=2)
    agent.observation_scale.copy_(torch.tensor([2.0, 0.5, 4.0]))
    agent.action_scale.fill_(3.0)
    obs, memory = episodes(agent, 2, 20, noise=1.0)
    x = gelu(naive_linear(agent.encoder[0], array(obs) / [2.0, 0.5, 4.0]))
    for block, block_memory in zip(agent.blocks, array(memory)):
        x = naive_block(block, x, naive_attention(block.attention, x, block_memory))
    hidden = agent.encode(obs, memory)
    np.testing.assert_allclose(array(hidden), x, atol=1e-12)
    mean, value = (naive_linear(head[2], gelu(naive_linear(head[0], x))) for head in (agent.actor, agent.critic))
    np.testing.assert_allclose(array(agent.get_mean_action(hidden)), 3.0 * mean, atol=1e-12)
    np.testing.assert_allclose(array(agent.critic(hidden)), value, atol=1e-12)


# --- initialisation ---------------------------------------------------------------------------------------------------


def test_initialisation():
    """R is zero, the gates' bias 2, other biases zero, weights orthogonal with CleanRL's gains."""
    agent = make_agent(plain=True, num_blocks=3, memory_length=6, log_std=-0.75)
    layers = {name: layer for name, layer in agent.named_modules() if isinstance(layer, torch.nn.Linear)}
    gains = {"encoder.0": 2**0.5, "actor.0": 2**0.5, "critic.0": 2**0.5, "actor.2": 0.01}
    for name, layer in layers.items():
        weight = layer.weight if layer.weight.shape[0] <= layer.weight.shape[1] else layer.weight.T
        eye = gains.get(name, 1.0) ** 2 * torch.eye(len(weight), dtype=torch.float64)
        torch.testing.assert_close(weight @ weight.T, eye, rtol=0, atol=1e-6)
        if layer.bias is not None:
            assert (layer.bias == (2.0 if "gate" in name else 0.0)).all(), name
    for block in agent.blocks:
        assert block.attention.R.shape == (2, 7, 4) and not block.attention.R.any()
        projections = (block.attention.query, block.attention.key, block.attention.value, block.attention.out)
        assert all(layer.bias is None for layer in projections)
    assert len(layers) == 1 + 3 * 8 + 4  # encoder; four projections, two gates, two of the MLP a block; two a head
    assert agent.actor_logstd.tolist() == [-0.75]


# --- cost -------------------------------------------------------------------------------------------------------------


def flops(function, *inputs):
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        function(*inputs)
    return counter.get_total_flops()


def test_training_pass_costs_linearly_in_the_steps():
    agent = make_agent(torch.float32, memory_length=16)
    short, long = (flops(agent.encode, *episodes(agent, 1, T)) for T in (256, 1024))
    assert 3.5 < long / short < 4.2  # a full T x T matrix would approach 16


def test_rollout_step_cost_does_not_grow():
    agent = make_agent(torch.float32, memory_length=16)
    obs, memory = episodes(agent, 1, 1000)
    cache = agent.start_cache(memory, 1000)
    first, late = (flops(agent.encode_step, obs[:, t], cache, t) for t in (0, 990))
    assert first == late > 0
