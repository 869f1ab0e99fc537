"""PPO with a Gated Transformer-XL on the double integrator, measured against the true optimum in the same run.

    python ppo_gtrxl_di.py --seed 1                                            # Table 1 of the paper
    python ppo_gtrxl_di.py --seed 1 --env-id DoubleIntegratorWaypoints-v0      # two waypoints, one policy
    python ppo_gtrxl_di.py --eval-only --checkpoint results/di/agent.safetensors

Top to bottom: arguments (Table 1), problem, Gated Transformer-XL, agent, PPO, checkpoints, main. From the first
"Shared" on, all ppo_gtrxl_*.py are the same to the letter. T steps, N environments, L memory, d width, H heads.
"""

from __future__ import annotations

import copy
import json
import math
import signal
import sys
import time
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
import torch.nn.functional as F
from torch import nn
from torch.distributions import Normal
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.utils.tensorboard import SummaryWriter

import evaluate
from runs import check, fail, gathered, join_processes, keep_memory, load_state, parse, process, refuse, save_run, total


@dataclass
class Args:
    # experiment
    exp_name: str = Path(__file__).stem  # the name of this experiment
    seed: int = 1  # seed of the experiment
    torch_deterministic: bool = True  # if toggled, `torch.backends.cudnn.deterministic=True`
    cuda: bool = True  # if toggled, a GPU is used when there is one
    num_threads: int = 0  # CPU threads of torch (0: torch's own choice)
    torch_compile: bool = False  # compile the network: a minute or more at the start, quicker updates after it
    track: bool = False  # if toggled, this experiment will be tracked with Weights and Biases
    wandb_project_name: str = "ppo-gtrxl"  # the wandb's project name
    wandb_entity: str | None = None  # the entity (team) of wandb's project
    capture_video: bool = False  # draw the figures of the final evaluation into the run's folder
    save_model: bool = True  # write checkpoints and the evaluation (off: TensorBoard events only)
    checkpoint: str | None = None  # start from these weights (.safetensors)
    resume: str | None = None  # run folder of an interrupted run to go on with, bit for bit
    eval_only: bool = False  # fly the mean action of --checkpoint, train nothing, write only --eval-json and --eval-npz
    eval_starts: int | None = None  # number of evaluation starts (default: 1000 with --eval-only, 50 at a run's end)
    eval_seed: int = 0  # seed of the evaluation starts
    eval_json: str | None = None  # where --eval-only writes the metrics
    eval_npz: str | None = None  # where --eval-only writes the trajectories
    eval_every: int = 0  # evaluate every so many updates, on starts of its own (0: only at the end)

    # environment
    env_id: str = "DoubleIntegrator-v0"  # the id of the environment, one of ENV_IDS
    observe_phase: bool = True  # show time and phase to the policy
    radius_curriculum: float = 12.0  # waypoints: training radius at first, in target radii (1: the paper)
    reward_scale: float = 0.1  # factor on the rewards in training; everything logged is unscaled

    # transformer (Table 1)
    num_blocks: int = 3  # number of GTrXL blocks
    embed_dim: int = 128  # embedding dimension d
    num_heads: int = 2  # number of attention heads
    memory_length: int = 32  # memory length L: a step attends to itself and the L steps before it
    mlp_dim: int = 128  # width of the position-wise MLP
    hidden_dim: int = 128  # width of the hidden layer of each head
    memory_noise: float = 0.1  # spread of the memory before an episode's start in training (Algorithm 1, line 5)

    # PPO (Table 1)
    total_updates: int = 1000  # number of updates
    num_envs: int = 80  # number of parallel environments, each flying one episode per update
    learning_rate: float = 3e-4  # learning rate of the first update
    learning_rate_final: float = 3e-5  # learning rate of the last update (linear in between); with kl the lowest
    gamma: float = 0.99  # the discount factor gamma
    gae_lambda: float = 0.95  # the lambda for the general advantage estimation
    gae_lambda_final: float | None = None  # the same in the last update (linear in between; none: --gae-lambda)
    num_minibatches: int = 4  # the number of mini-batches of whole episodes
    update_epochs: int = 8  # the K epochs to update the policy
    norm_adv: bool = True  # normalise the advantages over an update
    clip_coef: float = 0.2  # the surrogate clipping coefficient
    ent_coef: float = 1e-3  # coefficient of the entropy in the first update
    ent_coef_final: float = 1e-4  # coefficient of the entropy in the last update (linear in between)
    vf_coef: float = 0.2  # coefficient of the value function
    max_grad_norm: float = 0.5  # the maximum norm for the gradient clipping
    target_kl: float | None = None  # KL divergence from which an update takes no further step
    target_kl_final: float | None = None  # the same in the last update (linear in between; none: --target-kl)
    lr_schedule: str = "linear"  # linear, or kl: the learning rate follows half of --target-kl between its two ends
    return_norm: str = "none"  # none, time (the critic learns returns less their mean at a step), linear (less a fit)
    noise: str = "learned"  # who sets the log-std: learned, schedule (linear), gated (falls as the episodes succeed)
    log_std: float = 0.0  # initial log of the policy's standard deviation, in the action's unit
    log_std_final: float = -4.0  # with schedule the last update's, with gated the lowest (--log-std: the highest)
    noise_decay: float = 0.985  # gated: factor on the standard deviation after an update whose episodes succeed
    weight_average: float = 0.998  # decay of the averaged weights used in evaluation (0: off)


# Problem: what differs from the other scripts -------------------------------------------------------------------------
ENV_IDS = ("DoubleIntegrator-v0", "DoubleIntegratorWaypoints-v0")
ENV_OPTIONS = ("observe_phase",)  # arguments of the environments
BUFFERS = {env_id: {"observation_scale": [1.0] * n} for env_id, n in zip(ENV_IDS, (3, 6))}  # all is of order one
INITIAL_ACTION = [0.0]


def features(agent, obs):
    """What the encoder sees of observations (..., obs); the agent holds `BUFFERS`, as its checkpoint does."""
    return obs / agent.observation_scale


def mean_action(output, action_scale):
    """The policy's mean in the action's unit; the environment clips it at the bound."""
    return output * action_scale


def set_curriculum(envs, args, progress):
    """Training radius of the waypoints: K r at first, shrinking geometrically to r over 60 % of the updates."""
    if len(envs.problem.phases) > 1:
        envs.radius_scale = args.radius_curriculum ** max(0.0, 1 - progress / 0.6)


def noise_trend(episodes, std):
    """--noise gated: -1 lowers the noise (85 % of the sampled episodes hit every circle), 1 raises it (not half)."""
    hits = episodes["hit"].all(axis=1).mean()
    return -1 if hits >= 0.85 else int(hits < 0.5)


def describe(episodes, metrics):
    """What a progress line says of the sampled episodes (`final_info` arrays) and of the last evaluation, if any."""
    hit = " ".join(f"{share:4.0%}" for share in episodes["hit"].mean(axis=0))
    ratio = f"  ratio {metrics['ratio_of_sums']:.4f}" if "ratio_of_sums" in metrics else ""
    return f"return {episodes['episodic_return'].mean():8.2f}  cost {episodes['cost'].mean():7.3f}  hits {hit}{ratio}"


# Shared: Gated Transformer-XL ("Gated Transformer-XL Implementation") -------------------------------------------------
def linear(inputs, outputs, gain=1.0, bias=0.0):
    """A linear layer with orthogonal weights and a constant bias (CleanRL's layer_init), or without one (None)."""
    layer = nn.Linear(inputs, outputs, bias=bias is not None)
    nn.init.orthogonal_(layer.weight, gain)
    if bias is not None:
        nn.init.constant_(layer.bias, bias)
    return layer


class Gate(nn.Module):
    """gate(x, y) = lambda x + (1 - lambda) y, lambda = sigmoid(W_g [x, y] + b_g); b_g > 0 begins near the identity."""

    def __init__(self, embed_dim):
        super().__init__()
        self.linear = linear(2 * embed_dim, embed_dim, bias=2.0)

    def forward(self, x, y):
        lam = torch.sigmoid(self.linear(torch.cat([x, y], dim=-1)))
        return torch.lerp(y, x, lam)


class RelativeAttention(nn.Module):
    """Multi-head attention over a sliding window: A_ij = (x_i W^Q) (x_j W^K + R_{i-j})^T / sqrt(d_k), i - L <= j <= i.

    R is learned, one vector for each head and distance 0..L; j runs over [memory; segment].
    """

    def __init__(self, embed_dim, num_heads, memory_length):
        super().__init__()
        self.num_heads, self.memory_length, self.dk = num_heads, memory_length, embed_dim // num_heads
        self.query, self.key, self.value, self.out = (linear(embed_dim, embed_dim, bias=None) for _ in range(4))
        self.R = nn.Parameter(torch.zeros(num_heads, memory_length + 1, self.dk))

    def forward(self, x, memory):
        """The whole segment at once: x (N, T, d), memory (N, L, d) -> (N, T, d).

        Queries in chunks of C <= max(L / 2, 64) steps, each against its own window of L + C keys: linear in T.
        """
        (N, T, d), L, H, dk = x.shape, self.memory_length, self.num_heads, self.dk
        chunks = math.ceil(T / max(L // 2, 64))
        C = math.ceil(T / chunks)
        pad = (0, 0, 0, chunks * C - T)
        context = torch.cat([memory, x], dim=1)  # (N, L + T, d)
        q = F.pad(self.query(x) / math.sqrt(dk), pad).view(N, chunks, C, H, dk).transpose(2, 3)  # (N, chunks, H, C, dk)
        k, v = (F.pad(map_(context), pad).unfold(1, L + C, C).unflatten(2, (H, dk)) for map_ in (self.key, self.value))
        scores = q @ k + self.position_scores(q)  # k, v (N, chunks, H, dk, L + C), scores (N, chunks, H, C, L + C)
        attended = scores.softmax(dim=-1) @ v.transpose(-1, -2)  # (N, chunks, H, C, dk)
        return self.out(attended.transpose(2, 3).reshape(N, chunks * C, d)[:, :T])

    def position_scores(self, q):
        """q_i R_{i-j}^T of q (N, chunks, H, C, dk) under the keys of its window, -inf elsewhere: (..., C, L + C).

        Row i belongs under keys i..i+L (distance L..0): padded with C times -inf and cut anew, it moves right by i.
        """
        C, L = q.shape[-2], self.memory_length
        products = F.pad(torch.einsum("nchqd,hld->nchql", q, self.R.flip(1)), (0, C), value=-torch.inf)
        return products.flatten(-2)[..., : C * (L + C)].unflatten(-1, (C, L + C))

    def start_cache(self, memory, steps):
        """Keys and values of the memory (N, L, d) with room for `steps` more, (2, N, H, L + steps, dk); and what every
        step uses: the three projections as one (3 d, d), and R in the order of the window's keys (H, L + 1, dk)."""
        kv = torch.stack([self.key(memory), self.value(memory)]).unflatten(-1, (self.num_heads, self.dk))
        projections = torch.cat([self.query.weight / math.sqrt(self.dk), self.key.weight, self.value.weight])
        return F.pad(kv.transpose(2, 3), (0, 0, 0, steps)), projections, self.R.flip(1)

    def step(self, x, cache, t):
        """Step t alone: x (N, d) -> (N, d); writes its key and value into the cache, reads the window before it."""
        (kv, projections, R), L = cache, self.memory_length
        qkv = F.linear(x, projections).view(len(x), 3, self.num_heads, 1, self.dk).transpose(0, 1)
        kv[:, :, :, t + L : t + L + 1] = qkv[1:]
        k, v = kv[:, :, :, t : t + L + 1]  # (N, H, L + 1, dk)
        scores = qkv[0] @ (k + R).transpose(-1, -2)  # (N, H, 1, L + 1)
        return self.out((scores.softmax(dim=-1) @ v).flatten(1))


class GTrXLBlock(nn.Module):
    """h1 = gate(x, LayerNorm(x + MultiHead(x))), h2 = gate(h1, LayerNorm(h1 + MLP(h1)))."""

    def __init__(self, embed_dim, num_heads, memory_length, mlp_dim):
        super().__init__()
        self.attention = RelativeAttention(embed_dim, num_heads, memory_length)
        self.norm1, self.norm2 = nn.LayerNorm(embed_dim), nn.LayerNorm(embed_dim)
        self.gate1, self.gate2 = Gate(embed_dim), Gate(embed_dim)
        self.mlp = nn.Sequential(linear(embed_dim, mlp_dim), nn.GELU(), linear(mlp_dim, embed_dim))

    def forward(self, x, attended):
        """x is the block's input, `attended` its MultiHead(x), of the whole segment or of one step."""
        h1 = self.gate1(x, self.norm1(x + attended))
        return self.gate2(h1, self.norm2(h1 + self.mlp(h1)))


# Shared: agent ("Architecture Overview": encoder, GTrXL, policy head, value head) -------------------------------------
class Agent(nn.Module):
    """Actor and critic on one GTrXL trunk. The policy is Gaussian with a learned, state-independent log-std."""

    def __init__(self, args, envs):
        super().__init__()
        d, hidden, actions = args.embed_dim, args.hidden_dim, envs.single_action_space.shape[0]
        self.num_blocks, self.memory_length, self.embed_dim = args.num_blocks, args.memory_length, d
        for name, value in {**BUFFERS[args.env_id], "action_scale": envs.single_action_space.high.tolist()}.items():
            self.register_buffer(name, torch.tensor(value))
        inputs = len(features(self, torch.ones(envs.single_observation_space.shape)))
        self.encoder = nn.Sequential(linear(inputs, d, gain=2**0.5), nn.GELU())
        sizes = d, args.num_heads, args.memory_length, args.mlp_dim
        self.blocks = nn.ModuleList(GTrXLBlock(*sizes) for _ in range(args.num_blocks))
        self.actor = nn.Sequential(linear(d, hidden, gain=2**0.5), nn.GELU(), linear(hidden, actions, gain=0.01))
        self.actor[-1].bias.data = torch.tensor(INITIAL_ACTION)
        self.critic = nn.Sequential(linear(d, hidden, gain=2**0.5), nn.GELU(), linear(hidden, 1))
        self.actor_logstd = nn.Parameter(torch.full((actions,), args.log_std), requires_grad=args.noise == "learned")

    def new_memory(self, num_envs, noise):
        """m_0 ~ N(0, noise^2), drawn once per episode and block: (blocks, N, L, d)."""
        zeros = self.actor_logstd.new_zeros(self.num_blocks, num_envs, self.memory_length, self.embed_dim)
        return zeros.normal_(std=noise) if noise else zeros  # an evaluation must not move the random stream

    def encode(self, obs, memory):
        """Whole episodes in parallel (training): obs (N, T, obs), memory (blocks, N, L, d) -> hidden (N, T, d)."""
        x = self.encoder(features(self, obs))
        for block, block_memory in zip(self.blocks, memory):
            x = block(x, block.attention(x, block_memory))
        return x

    @torch.no_grad()
    def start_cache(self, memory, steps):
        """The key/value caches with which `encode_step` begins episodes of at most `steps` steps."""
        return [block.attention.start_cache(m, steps) for block, m in zip(self.blocks, memory)]

    def encode_step(self, obs, cache, t):
        """Step t of the same episodes (rollout): obs (N, obs) -> hidden (N, d); its cost does not grow with t."""
        x = self.encoder(features(self, obs))
        for block, block_cache in zip(self.blocks, cache):
            x = block(x, block.attention.step(x, block_cache, t))
        return x

    def get_mean_action(self, hidden):
        """What evaluation flies: the policy without its noise."""
        return mean_action(self.actor(hidden), self.action_scale)

    def get_policy(self, hidden):
        """The Gaussian that training samples from, of hidden (..., d): over actions (..., actions), in their unit."""
        mean = self.get_mean_action(hidden)
        return Normal(mean, self.actor_logstd.clamp(-5.0, 0.5).exp().expand_as(mean), validate_args=False)

    def evaluate_actions(self, hidden, actions):
        """log pi(a|s), the policy's entropy and the critic's output, (...) each, of hidden (..., d), (..., actions)."""
        probs = self.get_policy(hidden)
        return probs.log_prob(actions).sum(-1), probs.entropy().sum(-1), self.critic(hidden).squeeze(-1)


# Shared: PPO (Algorithm 1) --------------------------------------------------------------------------------------------
@dataclass
class Batch:
    """The episodes of one update; `alive` is 1 for steps before an episode's end, 0 after it."""

    obs: torch.Tensor  # (T, N, obs)
    actions: torch.Tensor  # (T, N, actions)
    logprobs: torch.Tensor  # (T, N)
    rewards: torch.Tensor  # (T, N), scaled
    values: torch.Tensor  # (T, N), the critic's output
    alive: torch.Tensor  # (T, N)
    memory: torch.Tensor  # (blocks, N, L, d)
    advantages: torch.Tensor | None = None  # (T, N), filled by update, as the returns
    returns: torch.Tensor | None = None  # (T, N), the critic's target


@torch.no_grad()
def rollout(agent, envs, reward_scale, memory_noise):
    """One episode in each environment (Algorithm 1, lines 4-11): the Batch and all processes' `final_info`."""
    T, N, like = envs.episode_steps, envs.num_envs, agent.actor_logstd
    shapes = envs.single_observation_space.shape, envs.single_action_space.shape, (), (), (), ()
    batch = Batch(*(like.new_zeros(T, N, *shape) for shape in shapes), agent.new_memory(N, memory_noise))
    cache, hidden = agent.start_cache(batch.memory, T), like.new_zeros(T, N, agent.embed_dim)
    alive, episodes, (next_obs, _) = np.ones(N, dtype=bool), {}, envs.reset()
    batch.obs[:] = torch.as_tensor(next_obs)  # steps that nobody lives to are computed, too: they need a real state
    for t in range(T):
        batch.obs[t], batch.alive[t] = torch.as_tensor(next_obs), torch.as_tensor(alive)
        hidden[t] = agent.encode_step(batch.obs[t], cache, t)
        batch.actions[t] = agent.get_policy(hidden[t]).sample()
        next_obs, reward, terminated, _, info = envs.step(batch.actions[t].cpu().numpy())
        batch.rewards[t] = torch.as_tensor(reward * alive * reward_scale)
        ended = alive & terminated
        for key, value in info.get("final_info", {}).items():
            episodes.setdefault(key, value.copy())[ended] = value[ended]
        alive = alive & ~terminated  # an ended environment has started anew; only its first episode counts
        if not alive.any():
            break
    batch.logprobs, _, batch.values = agent.evaluate_actions(hidden, batch.actions)
    everyone = gathered(episodes)
    return batch, {key: np.concatenate([part[key] for part in everyone]) for key in episodes}


def gae(rewards, values, alive, gamma, gae_lambda):
    """A_t = sum_l (gamma lambda)^l delta_{t+l} and the returns A + V, all (T, N); V is 0 beyond an episode's end."""
    advantages, lastgaelam = torch.zeros_like(rewards), 0.0
    next_value, next_alive = torch.zeros_like(values[0]), torch.zeros_like(alive[0])
    for t in reversed(range(len(rewards))):
        delta = rewards[t] + gamma * next_value * next_alive - values[t]
        advantages[t] = lastgaelam = (delta + gamma * gae_lambda * next_alive * lastgaelam) * alive[t]
        next_value, next_alive = values[t], alive[t]
    return advantages, advantages + values


def ppo_loss(agent, batch, mb, args):
    """-L_CLIP + c1 L_VF - c2 H over the living steps of the episodes `mb`; returns it and what is logged.

    The minibatch is that of all processes: the loss is this one's share of its mean, what is logged is the sum.
    """
    alive, advantages = batch.alive[:, mb], batch.advantages[:, mb]
    steps = total(alive.sum())
    mean = lambda x: (x * alive).sum() / steps  # noqa: E731
    hidden = agent.encode(batch.obs[:, mb].transpose(0, 1), batch.memory[:, mb]).transpose(0, 1)
    newlogprob, entropy, newvalue = agent.evaluate_actions(hidden, batch.actions[:, mb])
    logratio = newlogprob - batch.logprobs[:, mb]
    ratio = logratio.exp()
    clipped = torch.clamp(ratio, 1 - args.clip_coef, 1 + args.clip_coef)
    pg_loss = mean(torch.max(-advantages * ratio, -advantages * clipped))
    v_loss = mean(0.5 * (newvalue - batch.returns[:, mb]) ** 2)
    entropy_loss = mean(entropy)
    loss = pg_loss - args.ent_coef * entropy_loss + args.vf_coef * v_loss
    losses = {"policy_loss": pg_loss, "value_loss": v_loss, "entropy": entropy_loss, "total_loss": loss}
    with torch.no_grad():  # http://joschu.net/blog/kl-approx.html
        losses |= {"old_approx_kl": mean(-logratio), "approx_kl": mean((ratio - 1) - logratio)}
        losses["clipfrac"] = mean(((ratio - 1.0).abs() > args.clip_coef).to(ratio.dtype))
    return loss, dict(zip(losses, total(torch.stack([value.detach() for value in losses.values()]))))


def moments(x, alive, dim):
    """Mean and variance along dim of the living steps of every process."""
    count = total(alive.sum(dim, keepdim=True)).clamp(min=1)
    mean = total((x * alive).sum(dim, keepdim=True)) / count
    return mean, total(((x - mean) ** 2 * alive).sum(dim, keepdim=True)) / count


def linear_fit(x, y, alive):
    """Ridge regression of y (T, N) on x (T, N, k) over the living episodes of each step: the fitted y, (T, N)."""
    (x_mean, variance), (y_mean, _) = moments(x.double(), alive[..., None], 1), moments(y, alive, 1)
    x, steps = (x - x_mean) / (variance.sqrt() + 1e-6) * alive[..., None], total(alive.sum(1)).clamp(min=1)
    ridge = 0.01 * steps[:, None, None] * torch.eye(x.shape[-1]).to(x)  # what all episodes share has no slope
    slope = torch.linalg.solve(total(x.mT @ x) + ridge, total(x.mT @ (y - y_mean).double()[..., None]))
    return y_mean + (x @ slope)[..., 0].to(y.dtype)


def prepare(batch, args):
    """Fill in advantages and the critic's targets (Algorithm 1, lines 12-13); returns the explained variance.

    --return-norm time: V(s, t) = mean_t + std_t critic(s), from these episodes' returns from step t on. They share the
    clock, so most of a return is common to all; the critic is left with what differs between them. linear: mean_t is
    their linear fit in the observation; near one path, that is half of what differs.
    """
    alive, mean, std = batch.alive, 0.0, 1.0
    if args.return_norm != "none":
        target, _ = gae(batch.rewards, torch.zeros_like(batch.values), alive, args.gamma, 1.0)  # Monte-Carlo returns
        mean = linear_fit(batch.obs, target, alive) if args.return_norm == "linear" else moments(target, alive, 1)[0]
        variance = moments(target - mean, alive, 1)[1]
        std = (variance + 0.09 * variance.sqrt().mean() ** 2 + 1e-8).sqrt()  # some steps have next to no spread
    values = mean + std * batch.values
    batch.advantages, returns = gae(batch.rewards, values, alive, args.gamma, args.gae_lambda)
    batch.returns = returns if args.return_norm == "none" else (target - mean) / std
    if args.norm_adv:
        mean, variance = moments(batch.advantages, alive, (0, 1))
        batch.advantages = (batch.advantages - mean) / (variance.sqrt() + 1e-8)
    return 1 - (moments(returns - values, alive, (0, 1))[1] / moments(returns, alive, (0, 1))[1]).squeeze()


def update(agent, average, optimizer, batch, args):
    """K epochs of minibatches of whole episodes (Algorithm 1, lines 14-19); returns the mean of each logged loss.

    Raises FloatingPointError, before the optimiser moves the weights, when a loss or the gradient is not finite.
    """
    explained_variance, log, N = prepare(batch, args), [], batch.alive.shape[1]
    orders = [torch.randperm(N, device=batch.alive.device) for _ in range(args.update_epochs)]
    minibatches = [(k + 1, mb) for order in orders for k, mb in enumerate(order.tensor_split(args.num_minibatches))]
    for minibatch, mb in minibatches:
        loss, losses = ppo_loss(agent, batch, mb, args)
        log.append(losses)
        if args.target_kl is not None and losses["approx_kl"] > args.target_kl:
            break
        optimizer.zero_grad()
        loss.backward()
        for grad in [parameter.grad for parameter in agent.parameters() if parameter.grad is not None]:
            total(grad)
        gradient = nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
        for name, value in {**losses, "gradient norm": gradient}.items():
            if not value.isfinite():
                epoch = (len(log) - 1) // args.num_minibatches + 1
                raise FloatingPointError(f"{name} is {value} in epoch {epoch}, minibatch {minibatch}")
        optimizer.step()
        average.update_parameters(agent)
    means = {name: torch.stack([losses[name] for losses in log]).mean() for name in losses}
    return {name: value.item() for name, value in {**means, "explained_variance": explained_variance}.items()}


def linear_schedule(first, last, iteration, iterations):
    """`first` in iteration 1, `last` in iteration `iterations`, linear in between."""
    return first + (last - first) * (iteration - 1) / max(iterations - 1, 1)


def begin_update(args, agent, optimizer, envs, span):
    """Set what follows a schedule; returns the arguments of this update. span: iteration, iterations."""
    if args.lr_schedule == "linear":
        optimizer.param_groups[0]["lr"] = linear_schedule(args.learning_rate, args.learning_rate_final, *span)
    if args.noise == "schedule":
        agent.actor_logstd.fill_(linear_schedule(args.log_std, args.log_std_final, *span))
    set_curriculum(envs, args, linear_schedule(0.0, 1.0, *span))
    names = "gae_lambda", "ent_coef", "target_kl"
    ends = {name: (getattr(args, name), getattr(args, f"{name}_final")) for name in names}
    return replace(args, **{name: linear_schedule(*pair, *span) for name, pair in ends.items() if None not in pair})


def end_update(args, agent, optimizer, episodes, approx_kl):
    """Set what follows this update: the learning rate its KL (kl), the noise its episodes (gated)."""
    group = optimizer.param_groups[0]
    if args.lr_schedule == "kl":
        factor = 1 / 1.3 if approx_kl > 0.75 * args.target_kl else 1.2 if approx_kl < args.target_kl / 3 else 1.0
        group["lr"] = min(max(group["lr"] * factor, args.learning_rate_final), args.learning_rate)
    if args.noise == "gated":
        step = -math.log(args.noise_decay) * noise_trend(episodes, agent.actor_logstd.exp().mean().item())
        agent.actor_logstd.add_(step).clamp_(args.log_std_final, args.log_std)


# Shared: arguments ----------------------------------------------------------------------------------------------------
NETWORK = ("num_blocks", "embed_dim", "num_heads", "memory_length", "mlp_dim", "hidden_dim")
POLICY = {name: type(getattr(Args, name)) for name in ("env_id", *ENV_OPTIONS, *NETWORK)}  # a checkpoint decides


def parse_args(argv):
    """The checked arguments; with --resume the saved training state, with --checkpoint what that file holds."""
    args, saved = parse(Args, argv), None
    typed = {word.split("=")[0][2:].replace("-", "_").removeprefix("no_") for word in argv if word.startswith("--")}
    if args.resume is not None:
        if refused := typed - {"resume", "cuda", "num_threads"}:
            refuse(min(refused), "", "only --cuda and --num-threads may be given beside --resume")
        saved = load_state(args.resume, Args, ENV_IDS)
        args = Args(**{**saved["args"], **{name: getattr(args, name) for name in typed}})
    elif args.checkpoint is not None:
        saved = evaluate.read_checkpoint(args.checkpoint, POLICY)
        for name in POLICY:
            value, given = saved["args"][name], getattr(args, name)
            if name == "env_id" and name in typed and value != given and BUFFERS.get(value) == BUFFERS.get(given):
                print(f"--checkpoint is of {value}; it goes on with {given}")
            elif name in typed and value != given:
                refuse(name, given, f"the checkpoint has {value}; leave the flag out")
            else:
                setattr(args, name, value)
    elif args.eval_only:
        refuse("checkpoint", None, "must name the agent.safetensors that --eval-only flies")
    check(args, typed, ENV_IDS)
    args.eval_starts = args.eval_starts or (1000 if args.eval_only else 50)
    return args, saved


# Shared: checkpoints --------------------------------------------------------------------------------------------------
def training_state(args, modules, envs, progress):
    """All that a bit-exact resume needs, copied, so that training can go on while it is kept."""
    modules = {name: module.state_dict() for name, module in modules.items()}
    rng = {"torch": torch.get_rng_state(), "envs": json.dumps(envs.np_random.bit_generator.state)}
    rng = gathered({**rng, "cuda": torch.cuda.get_rng_state_all()})
    return copy.deepcopy({"args": {**asdict(args), "resume": None}, "progress": progress, "rng": rng, **modules})


def restore(state, run_dir, modules, envs):
    """Put everything back where `training_state` found it; returns the progress. One line if something does not fit."""
    try:
        for name, module in modules.items():
            module.load_state_dict(state[name])
        if len(state["rng"]) != process()[1]:
            raise ValueError(f"it was trained by {len(state['rng'])} processes")
        rng = state["rng"][process()[0]]
        torch.set_rng_state(rng["torch"])
        torch.cuda.set_rng_state_all(rng["cuda"][: torch.cuda.device_count()])
        envs.np_random.bit_generator.state = json.loads(rng["envs"])
        return {name: state["progress"][name] for name in ("seed", "total_updates", "global_step", "wall_seconds")}
    except Exception as error:  # an edited file fails in many ways, all alike to the user
        fail(f"--resume {run_dir}: its training_state.pt does not fit its own args ({error}); it must be whole")


# Shared: evaluation, training, main -----------------------------------------------------------------------------------
SAVE_EVERY = 10  # updates
TRAINING_EVAL_SEED = 2**31  # beyond --eval-seed: no reported start is flown during training


def evaluate_agent(agent, args, envs, eval_seed, progress):
    """Fly the mean action, from noise-free memory, and the optimum: eval.json's metrics and eval.npz's arrays."""
    like, cache = agent.actor_logstd, []

    @torch.no_grad()
    def policy(obs, t):
        if t == 0:
            cache[:] = agent.start_cache(agent.new_memory(len(obs), noise=0.0), envs.episode_steps)
        hidden = agent.encode_step(torch.as_tensor(obs, dtype=like.dtype, device=like.device), cache, t)
        return agent.get_mean_action(hidden).cpu().numpy()

    options = {name: getattr(args, name) for name in ENV_OPTIONS}
    metrics, arrays = evaluate.evaluate(args.env_id, policy, eval_seed, args.eval_starts, **options)
    return {**metrics, **progress, "device": like.device.type, "torch_version": torch.__version__}, arrays


def log_scalars(writer, prefix, values, global_step):
    """Write every number of `values` under its TensorBoard tag."""
    for name, value in values.items():
        if isinstance(value, (int, float)):
            writer.add_scalar(f"{prefix}/{name}", value, global_step)


def log_update(writer, args, progress, batch, episodes, losses, learning_rate, metrics):
    """CleanRL's tags for one update and, with each evaluation or a hundred times a run, a line to follow it by."""
    iteration, step, seconds = (progress[name] for name in ("total_updates", "global_step", "wall_seconds"))
    charts = {"episodic_return": episodes["episodic_return"].mean().item(), "learning_rate": learning_rate}
    charts |= {"episodic_length": batch.alive.sum(dim=0).mean().item(), "SPS": int(step / seconds)}
    log_scalars(writer, "charts", charts, step)
    log_scalars(writer, "losses", losses, step)
    if iteration % (args.eval_every or max(1, args.total_updates // 100)) == 0 or iteration == 1:
        clock = f"{seconds / 60:.1f} min gone, {(args.total_updates - iteration) * seconds / iteration / 60:.1f} to go"
        line = f"update {iteration}/{args.total_updates}, {step} steps, {clock}"
        print(f"{line}: {describe(episodes, metrics)}", flush=True)


def train(args, modules, envs, writer, run_dir, progress):
    """Algorithm 1; returns the progress. Also what ends it early leaves the state after the last whole update."""
    agent, average, optimizer = modules.values()
    state, metrics = training_state(args, modules, envs, progress), {}
    saves = args.save_model and run_dir is not None
    save = partial(save_run, run_dir) if saves else lambda state: None
    save(state)
    try:
        for iteration in range(progress["total_updates"] + 1, args.total_updates + 1):
            start = time.time()
            now = begin_update(args, agent, optimizer, envs, (iteration, args.total_updates))
            learning_rate = optimizer.param_groups[0]["lr"]
            batch, episodes = rollout(agent, envs, args.reward_scale, args.memory_noise)
            losses = update(*modules.values(), batch, now)
            end_update(now, agent, optimizer, episodes, losses["approx_kl"])
            progress = {**progress, "total_updates": iteration}
            progress["global_step"] += int(total(batch.alive.sum()))
            progress["wall_seconds"] += time.time() - start
            state = training_state(args, modules, envs, progress)
            if process()[0] > 0:
                continue  # the first process saves, evaluates and logs
            if iteration % SAVE_EVERY == 0 or iteration == args.total_updates:
                save(state)
            if args.eval_every and iteration % args.eval_every == 0:
                metrics, _ = evaluate_agent(average.module, args, envs, TRAINING_EVAL_SEED, progress)
                log_scalars(writer, "eval", metrics, progress["global_step"])
            log_update(writer, args, progress, batch, episodes, losses, learning_rate, metrics)
    except (KeyboardInterrupt, FloatingPointError) as error:
        save(state)
        if isinstance(error, FloatingPointError):
            kept = f"; the last good checkpoint is {run_dir}/training_state.pt" if saves else ""
            fail(f"update {iteration}: {error}, must be finite{kept}")
        kept = f"go on with: python {Path(__file__).name} --resume {run_dir}" if saves else "nothing saved"
        if process()[0] == 0:
            print(f"stopped after update {state['progress']['total_updates']}; {kept}")
        raise
    finally:
        if writer:
            writer.flush()
    return progress


def run(args, agent, envs, saved):
    """Train (or go on), save, evaluate, print the table."""
    run_dir = Path(args.resume or f"runs/{args.env_id}__{args.exp_name}__{args.seed}__{int(time.time())}")
    modules = make_modules(args, agent)
    if args.torch_compile:
        agent.encode, agent.encode_step = torch.compile(agent.encode), torch.compile(agent.encode_step)
    progress = {"seed": args.seed, "total_updates": 0, "global_step": 0, "wall_seconds": 0.0}
    if args.resume is not None:
        progress = restore(saved, run_dir, modules, envs)
    if process()[0] > 0:
        train(args, modules, envs, None, None, progress)
        return
    if args.track:
        import wandb

        names = {"project": args.wandb_project_name, "entity": args.wandb_entity, "name": run_dir.name}
        wandb.init(**names, sync_tensorboard=True, config=asdict(args), save_code=True)
    run_dir.mkdir(parents=True, exist_ok=args.resume is not None)
    for leftover in run_dir.glob(".*.tmp"):  # of a writer that was killed
        leftover.unlink()
    evaluate.write_json(run_dir / "args.json", {**asdict(args), "resume": None})
    writer = SummaryWriter(run_dir, purge_step=progress["global_step"] + 1)
    progress = train(args, modules, envs, writer, run_dir, progress)
    metrics, arrays = evaluate_agent(modules["average"].module, args, envs, args.eval_seed, progress)
    log_scalars(writer, "eval", metrics, metrics["global_step"])
    writer.close()
    if args.save_model:
        evaluate.write(metrics, arrays, run_dir / "agent.safetensors", run_dir / "eval.json", run_dir / "eval.npz")
    if args.capture_video:
        evaluate.figures(run_dir / "figures", arrays, metrics, evaluate.read_curve(run_dir))
    print(evaluate.table(metrics))


def make_agent(args, envs, saved):
    """A new agent, with the weights of --checkpoint if there is one; one line if they do not fit."""
    agent = Agent(args, envs).to("cuda" if torch.cuda.is_available() and args.cuda else "cpu")
    if args.checkpoint is not None and args.resume is None:
        try:
            agent.load_state_dict({name: torch.from_numpy(array) for name, array in saved["tensors"].items()})
        except (RuntimeError, TypeError) as error:
            fail(f"--checkpoint {args.checkpoint}: its weights do not fit its own args ({error})")
    return agent


def make_modules(args, agent):
    """All that training changes: the agent, its averaged weights, the optimiser."""
    average = AveragedModel(agent, multi_avg_fn=get_ema_multi_avg_fn(args.weight_average))
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)
    return {"agent": agent, "average": average, "optimizer": optimizer}


def interrupt(signum, _):
    """Ctrl-C and SIGTERM end a run alike; the exit status tells them apart: 130 and 143."""
    raise KeyboardInterrupt(128 + signum)


def main(argv):
    args, saved = parse_args(argv)
    keep_memory()
    torch.set_num_threads(args.num_threads or torch.get_num_threads())
    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    rank, processes = join_processes(args.cuda)
    share = args.num_envs // processes + (rank < args.num_envs % processes)
    envs = gym.make_vec(args.env_id, num_envs=share, **{name: getattr(args, name) for name in ENV_OPTIONS})
    envs.reset(seed=args.seed + 2**31 * rank)
    agent = make_agent(args, envs, saved)
    if rank > 0:  # the same weights, other noise
        torch.manual_seed(args.seed + 2**31 * rank)
    if args.eval_only:
        metrics, arrays = evaluate_agent(agent, args, envs, args.eval_seed, saved["progress"])
        evaluate.write(metrics, arrays, args.checkpoint, args.eval_json, args.eval_npz)
        print(evaluate.table(metrics))
    else:
        run(args, agent, envs, saved)


if __name__ == "__main__":
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, interrupt)
    try:
        main(sys.argv[1:])
    except (evaluate.BadInput, OSError) as error:
        fail(error)
    except KeyboardInterrupt as error:
        sys.exit(*error.args)
