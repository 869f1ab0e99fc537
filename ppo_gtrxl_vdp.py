"""PPO with a Gated Transformer-XL on the Van der Pol oscillator, measured against the true optimum in the same run.

    python ppo_gtrxl_vdp.py --seed 1                                 # our recipe, which trained results/vdp
    python ppo_gtrxl_vdp.py --seed 1 --env-id VanDerPolWaypoints-v0  # three waypoints, one policy
    python ppo_gtrxl_vdp.py --seed 1 --env-id CartPoleSwingUp-v0     # a problem of problems/, yours too
    python ppo_gtrxl_vdp.py --seed 1 --recipe paper                  # plain PPO with Table 1
    python ppo_gtrxl_vdp.py --eval-only --checkpoint results/vdp/agent.safetensors

Reading order: arguments, recipes, problem, Gated Transformer-XL, agent, PPO, what we add to PPO, training, main. From
the first section "Shared" on, all ppo_gtrxl_*.py are the same but for lines that end with "# this problem". A section
headed "Problem, ours" or "Shared, ours" contains nothing from the paper. In the other sections "ours" marks what
changes the paper's algorithm. Where the paper is silent, docs/decisions.md says what we chose. "Line 8" means line 8 of
Algorithm 1, "Eq. (7)" the seventh numbered equation of the paper. `runs.py` saves, logs, and flies the
optimum of `baselines.py` beside each evaluation.

T is the number of steps, N of environments, H of heads. L is the memory length, d the width, and dk = d / H.
Algorithm 1 writes E for our N, and N for its iterations.

The dynamics are Eq. (16), the cost J is Eq. (17), the reward r_t Eq. (18). With waypoints the observation o_t is
Eq. (19). The problems' tables are in envs.py, cost, reward and observation in phased/environment.py.
"""

from __future__ import annotations

import common.interrupts  # noqa: F401 # isort: skip - first, so that Ctrl-C in the other imports prints no traceback
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn
from torch.distributions import Normal
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

import runs
from common import flags
from common.schedule import Schedule
from cuda_graphs import speed_up
from envs import PROBLEMS, own_ids
from phased.lqr import free_ends, next_constraints


@dataclass
class Args:
    """The flags of the script. The values written here are Table 1's for this problem.

    --recipe paper uses these values. --recipe ours, the default, first replaces those that RECIPES names. A flag that
    is typed wins over both. A Schedule is one number, or points "place:value place:value ...". Place 0 is the first
    update, place 1 the last. The types are in common/flags.py: what each flag takes, and whether a policy decides it.
    """

    # experiment
    exp_name: str = Path(__file__).stem  # the name of this experiment
    seed: flags.Natural = 1  # seed of the experiment
    recipe: flags.Recipe = "ours"  # what the untyped flags are: "paper" (these values) or "ours" (RECIPES first)
    torch_deterministic: bool = True  # if toggled, `torch.backends.cudnn.deterministic=True`
    cuda: bool = True  # if toggled, a GPU is used when there is one
    num_threads: flags.Threads = 1  # CPU threads of torch (0: torch's own choice); the bits of the results depend on it
    torch_compile: bool = False  # compile the network (on a GPU: CUDA graphs), for a slower start and faster updates
    track: bool = False  # if toggled, this experiment will be tracked with Weights and Biases
    wandb_project_name: str = "ppo-gtrxl"  # the wandb's project name
    wandb_entity: str | None = None  # the entity (team) of wandb's project
    capture_video: bool = False  # draw the final evaluation into the run's folder: animation.gif and the figures
    save_model: bool = True  # write checkpoints and the evaluation (off: TensorBoard events only)
    checkpoint: str | None = None  # start from these weights (.safetensors)
    resume: str | None = None  # go on with the interrupted run in this run folder, bit for bit
    eval_only: bool = False  # fly the mean action of --checkpoint, train nothing, write only --eval-json and --eval-npz
    eval_starts: flags.Starts | None = None  # number of evaluation starts (default 1000; 50 in a training cut short)
    eval_seed: flags.Natural = 0  # seed of the evaluation starts
    eval_json: str | None = None  # where --eval-only writes the metrics
    eval_npz: str | None = None  # where --eval-only writes the trajectories
    eval_every: flags.Natural = 10  # updates between two evaluations, which have their own starts (0: only at the end)

    # environment
    env_id: str = "VanDerPol-v0"  # the id of the environment, one of ENV_IDS
    observe_phase: flags.Observed = True  # show time and phase to the policy
    observe_velocity: flags.Observed = True  # show the velocity to the policy

    # Table 1
    num_blocks: flags.Blocks = 3  # number of GTrXL blocks (0: a plain MLP, without memory)
    embed_dim: flags.Width = 128  # embedding dimension d
    num_heads: flags.Width = 2  # number of attention heads
    memory_length: flags.Length = 32  # memory length L: a step attends to itself and the L steps before it
    mlp_dim: flags.Width = 128  # width of the position-wise MLP
    hidden_dim: flags.Width = 256  # width of the hidden layer of each head
    gamma: flags.Share = 0.99  # the discount factor gamma
    gae_lambda: flags.ShareSchedule = Schedule(0.95)  # lambda of generalized advantage estimation, Eq. (12)
    total_updates: flags.Count = 1000  # number of updates
    update_epochs: flags.Count = 10  # the K epochs to update the policy
    vf_coef: flags.Weight = 0.2  # coefficient of the value function
    learning_rate: flags.ShareSchedule = Schedule("0:3e-4 1:3e-5")  # the learning rate of the optimizer
    ent_coef: flags.WeightSchedule = Schedule("0:1e-3 1:1e-4")  # coefficient of the entropy
    clip_coef: flags.Share = 0.2  # the surrogate clipping coefficient

    # not in Table 1: our choice
    num_envs: flags.Count = 117  # parallel environments, one episode each per update (512 steps of 16 workers, a guess)
    num_minibatches: flags.Count = 4  # the number of mini-batches of whole episodes
    norm_adv: bool = True  # normalise the advantages over an update
    max_grad_norm: flags.Positive = 0.5  # the maximum norm for the gradient clipping
    target_kl: flags.Positive | None = None  # the KL divergence at which an update takes no further step (None: never)
    log_std: flags.LogStd = Schedule(-0.5)  # log of the action's std. A number: learned from there; points: not learned
    memory_noise: flags.ShareSchedule = Schedule(0.1)  # std of the memory before an episode (Algorithm 1, line 5)
    reward_scale: flags.Positive = 1.0  # factor on the rewards in training; losses are logged with it, returns without

    # ours: off here, on in RECIPES
    lr_times_std: bool = False  # the learning rate is --learning-rate times the policy's std
    flights_per_start: flags.CountSchedule = Schedule(1)  # flights of each start, compared with one another
    # waypoints: log of the training radius in target radii
    log_radius: Annotated[Schedule, flags.Range(-5.0, 14.0)] = Schedule(0.0)
    weight_average: flags.Decay = 0.0  # decay, per optimiser step, of the averaged weights used in evaluation

    def __post_init__(self):
        flags.parse_schedules(self)


# Recipes: the values that we replace (docs/decisions.md has Table 1's beside them, docs/method.md the reasons) --------
# --log-std first falls as a learned one does. It jumps down where flights begin to be compared in groups, and falls
# linearly from there. --flights-per-start, --log-std and --log-radius jump at the same place.
OURS = {
    "gae_lambda": "0:0.95 1:1",
    "target_kl": 0.05,
    "reward_scale": 0.1,
    "lr_times_std": True,
    "weight_average": 0.99,
}
RECIPES = {
    "VanDerPol-v0": {
        **OURS,
        "total_updates": 80,
        "num_envs": 320,
        "num_minibatches": 16,
        "update_epochs": 2,
        "learning_rate": 1.5e-3,
        "gamma": 1.0,
        "memory_noise": "0:0.1 1:0",
        "log_std": "0:-0.5 0.3:-1 0.3:-2.5 1:-5",
        "flights_per_start": "0:1 0.3:1 0.3:8",
    },
    "VanDerPolWaypoints-v0": {
        **OURS,
        "total_updates": 280,
        "num_envs": 160,
        "num_minibatches": 8,
        "update_epochs": 3,
        "learning_rate": 1e-3,
        "log_std": "0:-0.5 0.35:-1 0.35:-2 1:-4.3",
        "flights_per_start": "0:1 0.35:1 0.35:8",
        "log_radius": "0:1.8 0.35:0 0.35:-0.1",
    },
}
OWN = {  # a problem of your own; flights are compared from the first update on, so its units do not matter
    **OURS,
    "num_blocks": 2,  # as deep and wide as the rocket's
    "embed_dim": 64,
    "mlp_dim": 64,
    "hidden_dim": 64,
    "gae_lambda": 0.9,  # 1 adds the noise of all later steps, 0 the error of the next state's fit
    "update_epochs": 4,
    "num_minibatches": 4,
    "learning_rate": 2e-3,
    "gamma": 1.0,
    "memory_noise": "0:0.1 1:0",
    "log_std": "0:-0.7 0.2:-1.7 1:-4.5",  # the bound is e^0
    "log_radius": "0:2.5 0.5:0",
    "weight_average": 0.998,
}
OWN_WITH_ONE_START = {**OWN, "total_updates": 1400, "num_envs": 64, "flights_per_start": 64}
OWN_WITH_STARTS = {**OWN, "total_updates": 150, "num_envs": 256, "flights_per_start": 32}
OWN_WITH_IMPULSES = {  # a flight of a few impulses is short, so there can be many; little noise lets the others be 0
    **OWN_WITH_STARTS,
    "num_blocks": 1,  # two cost 0.1 to 0.5 % less, in twice the time
    "log_std": "0:-0.7 0.1:-1.7 0.85:-4.6 1:-6",
}
STEPS_WITH_IMPULSES = 42_000  # of each environment, in a training


def recipe(args):
    """What our recipe changes for the environments of `args`. A problem of your own takes one of three recipes."""
    if args.env_id in RECIPES:
        return RECIPES[args.env_id]
    problem = PROBLEMS.get(args.env_id)
    if problem and problem.step:
        updates = max(OWN_WITH_STARTS["total_updates"], STEPS_WITH_IMPULSES // problem.steps)
        return {**OWN_WITH_IMPULSES, "total_updates": updates}
    if problem and problem.has_one_flight:
        return OWN_WITH_ONE_START
    return OWN_WITH_STARTS


# Problem: input and action --------------------------------------------------------------------------------------------
ENV_IDS = (*RECIPES, *own_ids())  # and problems of your own
ENV_OPTIONS = ("observe_phase", "observe_velocity")  # arguments of the environments
FIXED_OPTIONS = {"scaled_action": True}  # arguments that no flag sets
INITIAL_ACTION = [0.0]  # the policy's output before training, in units of the bound
STATE = slice(None)  # what tells the returns of one start's flights apart: all that is observed (`returns_baseline`)


def constants(env_id):
    """The buffers of an environment's agents, saved with the weights; `features` reads them as agent.<name>."""
    return {"observation_scale": runs.observation_scale(env_id), **miss_constants(env_id)}


def miss_constants(env_id):
    """The buffers of `to_make_up` and `excess`: for impulses in one phase that should end in a circle, else none.

    `make_up` (T+1, 2m, n) and `drift` (T+1, 2m) give m components of a constant control, then m of a single one.
    """
    problem = PROBLEMS.get(env_id)
    if problem is None or problem.step is None or problem.waypoints or not problem.circles_count:
        return {}
    target, Phi, c, push = free_ends(problem)
    single = push.copy()
    single[:-1] -= push[1:]  # of the control of one step
    gain = -np.hstack([np.linalg.pinv(push), np.linalg.pinv(single)]) / np.tile(problem.u_unit, 2)[:, None]
    buffers = {"target": target, "make_up": gain @ Phi, "drift": (gain @ c[..., None])[..., 0]}
    limit, slope, effect = next_constraints(problem)
    unit = np.where(effect > 0, effect, 1.0)
    buffers["limit"], buffers["limit_slope"] = limit / unit, slope / unit[:, None]
    return {name: value.tolist() for name, value in buffers.items()}


def to_make_up(agent, obs):
    """The controls (..., 2 actions) that would bring the flight to its target, in units of `u_scale`. Ours.

    The first is held to the end, the second is given in this step alone. Each is the zero-effort miss of guidance over
    what such a control still does, by the dynamics linearised about the target. The first hardly depends on how far the
    end is, while the distance that matters falls from the way to the circle.
    """
    n = len(agent.target)
    step = (obs[..., n] * (len(agent.make_up) - 1)).round().long()
    distance = obs[..., :n] - agent.target
    return (agent.make_up[step] @ distance[..., None])[..., 0] + agent.drift[step]


def excess(agent, obs):
    """How far beyond each constraint (..., k) this step ends without control, linear about the target. Ours.

    The unit is what controls of `u_scale` change. A limit that is more than ten units away does not matter in this
    step.
    """
    distance = obs[..., : len(agent.target)] - agent.target
    return (agent.limit + distance @ agent.limit_slope.mT).clamp(min=-10)


def features(agent, obs):
    """What the encoder sees of observations (..., obs): in units of their scale, `to_make_up` and `excess` if known.

    asinh shows small values of these in proportion, and large ones by their logarithm. Actions have the same scale
    (`Problem.control_of`), so the single impulse that would hit is an action.
    """
    seen = obs / agent.observation_scale
    if not hasattr(agent, "make_up"):
        return seen
    return torch.cat([seen, to_make_up(agent, obs).asinh(), excess(agent, obs).asinh()], dim=-1)


def mean_action(output, action_scale):
    """The policy's mean (..., actions), in the action's unit. It has no bound: the environment clips the action."""
    return output * action_scale


def describe(episodes, metrics):
    """The part of a progress line about the sampled episodes (`final_info` arrays) and the last evaluation, if any."""
    words = f"return {episodes['episodic_return'].mean():8.2f}"
    if "cost" in episodes:
        words += f"  cost {episodes['cost'].mean():7.3f}"
    if "arrived" in episodes:
        words += f"  arrive {episodes['arrived'].mean():4.0%}"
    has_target = "terminal_error" in episodes and episodes["terminal_error"].any()
    if "hit" in episodes and (has_target or "arrived" not in episodes):  # without a target nothing can be missed
        words += "  hits " + " ".join(f"{share:4.0%}" for share in episodes["hit"].mean(axis=0))
    if "ratio_of_sums" in metrics:
        words += f"  ratio {metrics['ratio_of_sums']:.4f}"
    return words


# Problem, ours: what only training changes ----------------------------------------------------------------------------
BONUS_WIDTH = 0.4


def curriculum(args, progress):
    """What this update hands over to the environments, by name (`PhasedTraining` of phased/environment.py).

    At first every flight has its own start. Later several flights share a start and are compared. On a problem of your
    own a fifth of the draws of each number of a start lies at an end of its range. A network is least accurate at the
    edge of what it has seen. Constraints cost from the table's `constraint_margin` on.

    A waypoint's circle is wide at first, so that flights find it. It shrinks to its true radius. Compared flights aim
    at circles a tenth smaller, because the optimum ends on the edge of the last circle, where half of the noisy flights
    would miss. Beyond the circle their bonus falls to 0 over BONUS_WIDTH, by 25 / 0.4 = 62 to 40 / 0.4 = 100 for each
    unit of distance. A miss saves at most 7 for each unit (`circle_price` of baselines.py), so it does not pay. A
    steeper fall would hide the cost.
    """
    group = round(args.flights_per_start.at(progress))
    training = {"flights_per_start": group}
    problem = PROBLEMS.get(args.env_id)
    if problem and args.env_id not in RECIPES:
        training["start_ends"] = 0.2
        training["constraint_margin"] = problem.constraint_margin
    if problem and problem.circles_count:
        training["radius_scale"] = math.exp(args.log_radius.at(progress))
        training["bonus_width"] = BONUS_WIDTH if group > 1 else 0.0
    return training


# Shared: Gated Transformer-XL ("Gated Transformer-XL Implementation") -------------------------------------------------
def linear(inputs, outputs, gain=1.0, bias=0.0):
    """A linear layer with orthogonal weights and a constant bias, as CleanRL's layer_init. None leaves the bias out."""
    layer = nn.Linear(inputs, outputs, bias=bias is not None)
    nn.init.orthogonal_(layer.weight, gain)
    if bias is not None:
        nn.init.constant_(layer.bias, bias)
    return layer


class Gate(nn.Module):
    """Eq. (7): gate(x, y) = lambda x + (1 - lambda) y, lambda = sigmoid(W_g [x, y] + b_g), of x and y (..., d).

    With b_g > 0 an untrained gate is near the identity gate(x, y) = x. It resembles the highway gate of Parisotto et
    al. (2020), where lambda sees x alone, and not their GRU gate.
    """

    def __init__(self, embed_dim):
        super().__init__()
        self.linear = linear(2 * embed_dim, embed_dim, bias=2.0)

    def forward(self, x, y):
        lam = torch.sigmoid(self.linear(torch.cat([x, y], dim=-1)))
        return torch.lerp(y, x, lam)


class RelativeAttention(nn.Module):
    """Multi-head attention over a sliding window, i - L <= j <= i, with the scores of Eq. (10).

    A_ij = (x_i W^Q) (x_j W^K + R_{i-j})^T / sqrt(d_k), and j runs over the memory and the episode. R is learned. It has
    one vector for each head and each distance 0 to L.
    """

    def __init__(self, embed_dim, num_heads, memory_length):
        super().__init__()
        self.num_heads = num_heads
        self.memory_length = memory_length
        self.dk = embed_dim // num_heads
        self.query = linear(embed_dim, embed_dim, bias=None)  # W^Q
        self.key = linear(embed_dim, embed_dim, bias=None)  # W^K
        self.value = linear(embed_dim, embed_dim, bias=None)  # W^V
        self.out = linear(embed_dim, embed_dim, bias=None)
        self.R = nn.Parameter(torch.zeros(num_heads, memory_length + 1, self.dk))

    def forward(self, x, memory):
        """MultiHead(x) of whole episodes: x (N, T, d), memory (N, L, d) -> (N, T, d).

        The queries are cut into chunks of C <= max(L / 2, 64) steps. Each chunk sees a window of L + C keys, so the
        cost grows linearly with T.
        """
        N, T, d = x.shape
        L, H, dk = self.memory_length, self.num_heads, self.dk
        chunks = math.ceil(T / max(L // 2, 64))
        C = math.ceil(T / chunks)
        pad = (0, 0, 0, chunks * C - T)  # zeros after the last step give every chunk C steps
        context = torch.cat([memory, x], dim=1)  # (N, L + T, d)

        q = F.pad(self.query(x) / math.sqrt(dk), pad)  # (N, chunks * C, d)
        q = q.view(N, chunks, C, H, dk).transpose(2, 3)  # (N, chunks, H, C, dk)

        k = F.pad(self.key(context), pad).unfold(1, L + C, C)  # (N, chunks, d, L + C), one window a chunk
        k = k.unflatten(2, (H, dk))  # (N, chunks, H, dk, L + C)
        v = F.pad(self.value(context), pad).unfold(1, L + C, C)
        v = v.unflatten(2, (H, dk))

        scores = q @ k + self.position_scores(q)  # (N, chunks, H, C, L + C)
        attended = scores.softmax(dim=-1) @ v.transpose(-1, -2)  # (N, chunks, H, C, dk)
        attended = attended.transpose(2, 3).reshape(N, chunks * C, d)
        return self.out(attended[:, :T])

    def position_scores(self, q):
        """q_i R_{i-j}^T of q (N, chunks, H, C, dk) for all keys j of its window: (N, chunks, H, C, L + C).

        Key i + L of a window is query i itself, so query i reaches the keys i to i + L. All other keys get -inf.

        `products` has a row for each query and a column for each distance, L first. Row i has to move right by i. One
        reshape, the relative shift of Transformer-XL, moves all rows: pad each row with C columns of -inf, join the
        rows to one line, and cut this line into rows that are one column shorter. Here L = 2 and C = 3; a2 is query a
        at distance 2, and "." is -inf:

            a2 a1 a0 .  .  .        a2 a1 a0 .  .
            b2 b1 b0 .  .  .   ->   .  b2 b1 b0 .
            c2 c1 c0 .  .  .        .  .  c2 c1 c0
        """
        C, L = q.shape[-2], self.memory_length
        products = torch.einsum("nchqd,hld->nchql", q, self.R.flip(1))  # (N, chunks, H, C, L + 1)
        line = F.pad(products, (0, C), value=-torch.inf).flatten(-2)  # (N, chunks, H, C * (L + 1 + C))
        return line[..., : C * (L + C)].unflatten(-1, (C, L + C))

    def start_cache(self, memory, steps):
        """The cache of `step`, for episodes of at most `steps` steps that begin with the memory (N, L, d):

        - kv (2, N, H, L + steps, dk): keys and values of the memory, then room for those of the steps
        - projections (3 d, d): W^Q / sqrt(dk), W^K and W^V as one matrix
        - R (H, L + 1, dk): distance L first, which is the order of the window's keys
        """
        kv = torch.stack([self.key(memory), self.value(memory)])  # (2, N, L, d)
        kv = kv.unflatten(-1, (self.num_heads, self.dk)).transpose(2, 3)  # (2, N, H, L, dk)
        kv = F.pad(kv, (0, 0, 0, steps))
        projections = torch.cat([self.query.weight / math.sqrt(self.dk), self.key.weight, self.value.weight])
        return kv, projections, self.R.flip(1)

    def step(self, x, cache, t):
        """MultiHead(x) of step t alone: x (N, d) -> (N, d).

        It writes the step's key and value into the cache. Then it attends to the window that ends with them.
        """
        kv, projections, R = cache
        L = self.memory_length
        q, kv_of_step = self.project(x, projections)
        kv[:, :, :, t + L : t + L + 1] = kv_of_step
        return self.attend(q, kv[:, :, :, t : t + L + 1], R)

    def project(self, x, projections):
        """One step's query (N, H, 1, dk), and its key and value (2, N, H, 1, dk), of x (N, d)."""
        qkv = F.linear(x, projections)  # (N, 3 d)
        qkv = qkv.view(-1, 3, self.num_heads, 1, self.dk).transpose(0, 1)  # (3, N, H, 1, dk)
        return qkv[0], qkv[1:]

    def attend(self, q, window, R):
        """MultiHead(x) (N, d) of one step, from its query and the window's keys and values (2, N, H, L + 1, dk)."""
        k, v = window  # (N, H, L + 1, dk)
        scores = q @ (k + R).transpose(-1, -2)  # (N, H, 1, L + 1)
        attended = scores.softmax(dim=-1) @ v  # (N, H, 1, dk)
        return self.out(attended.flatten(1))


class GTrXLBlock(nn.Module):
    """h1 = gate(x, LayerNorm(x + MultiHead(x))), h2 = gate(h1, LayerNorm(h1 + MLP(h1))): Eq. (8) and (9)."""

    def __init__(self, embed_dim, num_heads, memory_length, mlp_dim):
        super().__init__()
        self.attention = RelativeAttention(embed_dim, num_heads, memory_length)
        self.norm1 = nn.LayerNorm(embed_dim)
        self.norm2 = nn.LayerNorm(embed_dim)
        self.gate1 = Gate(embed_dim)
        self.gate2 = Gate(embed_dim)
        self.mlp = nn.Sequential(linear(embed_dim, mlp_dim), nn.GELU(), linear(mlp_dim, embed_dim))

    def forward(self, x, attended):
        """h2 of the block's input x and `attended`, its MultiHead(x): (..., d) each, whole episodes or one step."""
        h1 = self.gate1(x, self.norm1(x + attended))
        return self.gate2(h1, self.norm2(h1 + self.mlp(h1)))


# Shared: agent ("Architecture Overview": encoder, GTrXL, policy head, value head) -------------------------------------
LOG_STD_RANGE = (-8.0, 0.5)


class Agent(nn.Module):
    """Actor and critic on one GTrXL trunk. The policy is Gaussian, with one log-std for all states, learned or set.

    A block's memory at step t is what the block received at the steps t - L to t - 1. Before the first step it is m_0.
    A rollout stores the memory as keys and values (`encode_step`). Training stores only m_0. It computes the whole
    episode again from m_0 with the current weights (`encode`), so gradients flow through the memory, where
    Transformer-XL stops them. This replaces how lines 10, 11 and 17 keep the memory. Line 10 also stores the action
    a_t. We leave the action out, because two fully observed states in a row tell which action lay between them.
    """

    def __init__(self, args, envs):
        super().__init__()
        d, hidden = args.embed_dim, args.hidden_dim
        actions = envs.single_action_space.shape[0]
        self.num_blocks = args.num_blocks
        self.memory_length = args.memory_length
        self.embed_dim = d

        # saved with the weights; `features` and `mean_action` read them as agent.<name>
        buffers = {**constants(args.env_id), "action_scale": envs.single_action_space.high.tolist()}
        for name, value in buffers.items():
            self.register_buffer(name, torch.tensor(value))
        any_observation = torch.ones(envs.single_observation_space.shape)  # only the number of its features is used
        inputs = len(features(self, any_observation))

        self.encoder = nn.Sequential(linear(inputs, d, gain=2**0.5), nn.GELU())
        blocks = [GTrXLBlock(d, args.num_heads, args.memory_length, args.mlp_dim) for _ in range(args.num_blocks)]
        self.blocks = nn.ModuleList(blocks)
        self.actor = nn.Sequential(linear(d, hidden, gain=2**0.5), nn.GELU(), linear(hidden, actions, gain=0.01))
        self.actor[-1].bias.data[:] = torch.tensor(INITIAL_ACTION)
        self.critic = nn.Sequential(linear(d, hidden, gain=2**0.5), nn.GELU(), linear(hidden, 1))
        learned = not args.log_std.has_points  # a number is where learning begins; points are set
        self.actor_logstd = nn.Parameter(torch.full((actions,), args.log_std.at(0.0)), requires_grad=learned)

    def new_memory(self, num_envs, noise):
        """m_0 ~ N(0, noise^2), drawn once per episode and block: (blocks, N, L, d)."""
        zeros = self.actor_logstd.new_zeros(self.num_blocks, num_envs, self.memory_length, self.embed_dim)
        if not noise:
            return zeros  # nothing is drawn
        return zeros.normal_(std=noise)

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
        """Step t of the same episodes (rollout): obs (N, obs) -> hidden (N, d). The cost does not grow with t."""
        x = self.encoder(features(self, obs))
        for block, block_cache in zip(self.blocks, cache):
            x = block(x, block.attention.step(x, block_cache, t))
        return x

    def get_mean_action(self, hidden):
        """The policy without its noise, which evaluation flies: actions (..., actions) of hidden (..., d)."""
        return mean_action(self.actor(hidden), self.action_scale)

    def get_policy(self, hidden):
        """The Gaussian that training samples from: over actions (..., actions) in their unit, of hidden (..., d)."""
        mean = self.get_mean_action(hidden)
        std = self.actor_logstd.clamp(*LOG_STD_RANGE).exp()
        return Normal(mean, std.expand_as(mean), validate_args=False)

    def act(self, obs, cache, t):
        """Step t of a rollout: hidden (N, d) and sampled actions (N, actions) of obs (N, obs)."""
        hidden = self.encode_step(obs, cache, t)  # lines 7 and 10
        actions = self.get_policy(hidden).rsample()  # line 8; `sample` would wait for a GPU
        return hidden, actions

    def evaluate_actions(self, hidden, actions):
        """log pi(a|s), entropy and the critic's output, (...) each, of hidden (..., d) and actions (..., actions)."""
        probs = self.get_policy(hidden)
        logprob = probs.log_prob(actions).sum(-1)
        entropy = probs.entropy().sum(-1)
        value = self.critic(hidden).squeeze(-1)
        return logprob, entropy, value

    def make_policy(self, steps):
        """The function that evaluation flies: policy(obs (N, obs), t) -> mean actions (N, actions), in NumPy.

        A call with t = 0 begins new episodes, of at most `steps` steps, with a memory of zeros.
        """
        dtype, device = self.actor_logstd.dtype, self.actor_logstd.device
        cache = []

        @torch.no_grad()
        def policy(obs, t):
            if t == 0:
                cache[:] = self.start_cache(self.new_memory(len(obs), noise=0.0), steps)
            hidden = self.encode_step(torch.as_tensor(obs, dtype=dtype, device=device), cache, t)
            return self.get_mean_action(hidden).cpu().numpy()

        return policy


# Shared: PPO (Algorithm 1) --------------------------------------------------------------------------------------------
@dataclass
class Batch:
    """The episodes of one update. `alive` is 1 up to an episode's last step and 0 after it."""

    obs: torch.Tensor  # (T, N, obs)
    actions: torch.Tensor  # (T, N, actions)
    logprobs: torch.Tensor  # (T, N)
    rewards: torch.Tensor  # (T, N), scaled
    critic: torch.Tensor  # (T, N), the critic's output, from which `train` makes V
    alive: torch.Tensor  # (T, N)
    memory: torch.Tensor  # (blocks, N, L, d), m_0
    advantages: torch.Tensor | None = None  # (T, N), set by train
    targets: torch.Tensor | None = None  # (T, N), set by train; the critic learns them


@torch.no_grad()
def rollout(agent, envs, training, reward_scale, memory_noise):
    """Fly one episode in each environment (lines 3-13). `training` is what `curriculum` hands over to them.

    Returns the Batch, and {key: (N, ...)}, the `final_info` of its episodes.
    """
    next_obs, _ = envs.reset(options={"training": training})
    T, N = envs.episode_steps, envs.num_envs
    zeros = agent.actor_logstd.new_zeros  # on the agent's device, in its precision
    batch = Batch(
        obs=zeros(T, N, *envs.single_observation_space.shape),
        actions=zeros(T, N, *envs.single_action_space.shape),
        logprobs=zeros(T, N),  # set after the flight
        rewards=zeros(T, N),  # set after the flight
        critic=zeros(T, N),  # set after the flight
        alive=zeros(T, N),  # set after the flight
        memory=agent.new_memory(N, memory_noise),  # line 5
    )
    cache = agent.start_cache(batch.memory, T)
    hidden = zeros(T, N, agent.embed_dim)
    rewards = np.zeros((T, N))
    alive_at = np.zeros((T, N))
    alive = np.ones(N, dtype=bool)
    episodes = {}  # `final_info` of each environment's first episode
    batch.obs[:] = torch.as_tensor(next_obs)  # no step stays zero: the features of zeros could be NaN

    for t in range(T):  # line 6
        batch.obs[t] = torch.as_tensor(next_obs)
        alive_at[t] = alive
        hidden[t], batch.actions[t] = agent.act(batch.obs[t], cache, t)  # lines 7, 8 and 10
        # line 9. The end of an episode is a true end, where V is 0: nothing is ever truncated.
        next_obs, reward, terminated, _, info = envs.step(batch.actions[t].cpu().numpy())
        rewards[t] = reward * alive * reward_scale  # line 11
        ended = alive & terminated
        for key, value in info.get("final_info", {}).items():
            first_episodes = episodes.setdefault(key, np.zeros_like(value))
            first_episodes[ended] = value[ended]
        alive = alive & ~terminated  # an ended environment starts a new episode, which does not count
        if not alive.any():
            break

    batch.rewards[:] = torch.as_tensor(rewards)
    batch.alive[:] = torch.as_tensor(alive_at)
    # v_t of line 8 and log pi(a_t). Sampling needs neither, so one call computes them for all steps.
    batch.logprobs, _, batch.critic = agent.evaluate_actions(hidden, batch.actions)
    return batch, episodes


def gae(rewards, values, alive, gamma, gae_lambda):
    """Advantages A_t = sum_l (gamma lambda)^l delta_{t+l}, Eq. (12), and returns A_t + V_t, all (T, N).

    delta_t = r_t + gamma V_{t+1} - V_t, where V is 0 beyond an episode's end.
    """
    device = rewards.device
    rewards, values, alive = rewards.cpu(), values.cpu(), alive.cpu()  # a GPU is slower at T small steps
    advantages = torch.zeros_like(rewards)
    lastgaelam = torch.zeros_like(values[0])
    next_value = torch.zeros_like(values[0])
    for t in reversed(range(len(rewards))):
        delta = rewards[t] + gamma * next_value - values[t]
        lastgaelam = (delta + gamma * gae_lambda * lastgaelam) * alive[t]
        advantages[t] = lastgaelam
        next_value = values[t] * alive[t]  # 0 beyond the episode's end
    return advantages.to(device), (advantages + values).to(device)


def moments(x, alive, dim):
    """Mean and variance of x (T, N, ...) along dim, over the living steps. dim is kept as 1."""
    count = runs.total(alive.sum(dim, keepdim=True)).clamp(min=1)
    mean = runs.total((x * alive).sum(dim, keepdim=True)) / count
    variance = runs.total(((x - mean) ** 2 * alive).sum(dim, keepdim=True)) / count
    return mean, variance


def explained_variance(prediction, returns, alive):
    """1 - Var(returns - prediction) / Var(returns) over the living steps of (T, N), as in CleanRL."""
    _, unexplained = moments(returns - prediction, alive, (0, 1))
    _, total = moments(returns, alive, (0, 1))
    return (1 - unexplained / total).item()


def ppo_loss(agent, batch, mb, clip_coef, vf_coef, ent_coef):
    """The loss -L_CLIP + c1 L_VF - c2 H over the living steps of the episodes `mb`, and the means that are logged.

    L_CLIP is Eq. (11), whose epsilon is --clip-coef. Line 18 prints +L_CLIP, which a minimiser would lower. c1 is
    --vf-coef, c2 --ent-coef. The paper leaves L_VF open; ours is 1/2 (critic - target)^2. With several processes
    `runs.total` sums over them: the loss is this process's part of the mean, and what is logged is the whole mean.
    """
    alive = batch.alive[:, mb]
    advantages = batch.advantages[:, mb]
    steps = runs.total(alive.sum())

    def mean(x):
        return (x * alive).sum() / steps

    hidden = agent.encode(batch.obs[:, mb].transpose(0, 1), batch.memory[:, mb]).transpose(0, 1)  # line 17
    newlogprob, entropy, newvalue = agent.evaluate_actions(hidden, batch.actions[:, mb])
    logratio = (newlogprob - batch.logprobs[:, mb]) * alive  # beyond an episode's end it could overflow
    ratio = logratio.exp()

    # policy loss, -L_CLIP
    clipped = torch.clamp(ratio, 1 - clip_coef, 1 + clip_coef)
    pg_loss = mean(torch.max(-advantages * ratio, -advantages * clipped))

    # value loss, L_VF
    v_loss = mean(0.5 * (newvalue - batch.targets[:, mb]) ** 2)

    entropy_loss = mean(entropy)
    loss = pg_loss - ent_coef * entropy_loss + vf_coef * v_loss

    losses = {"policy_loss": pg_loss, "value_loss": v_loss, "entropy": entropy_loss, "total_loss": loss}
    with torch.no_grad():  # http://joschu.net/blog/kl-approx.html
        losses["old_approx_kl"] = mean(-logratio)
        losses["approx_kl"] = mean((ratio - 1) - logratio)
        losses["clipfrac"] = mean(((ratio - 1.0).abs() > clip_coef).to(ratio.dtype))
    means = runs.total(torch.stack([value.detach() for value in losses.values()]))
    return loss, dict(zip(losses, means))


def ppo_gradient(args, agent, batch, mb, ent_coef):
    """Set the parameters' `.grad` to the clipped gradient of `ppo_loss`.

    Returns what is logged, with the norm that the gradient had before it was clipped.
    """
    loss, losses = ppo_loss(agent, batch, mb, args.clip_coef, args.vf_coef, ent_coef)
    agent.zero_grad()
    loss.backward()
    runs.total([weight.grad for weight in agent.parameters() if weight.grad is not None])  # of all processes
    losses["gradient_norm"] = nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
    return losses


# Shared, ours: what we add to PPO -------------------------------------------------------------------------------------
def set_log_std(agent, args, progress):
    """Set the log-std of this update if --log-std is a schedule. Clamp it if it is learned.

    Beyond LOG_STD_RANGE the clamp in `get_policy` has no gradient, so a learned log-std would never come back.
    """
    if agent.actor_logstd.requires_grad:
        agent.actor_logstd.data.clamp_(*LOG_STD_RANGE)
    else:
        agent.actor_logstd.data.fill_(args.log_std.at(progress))


def learning_rate_of(agent, args, progress):
    """The learning rate of this update. With --lr-times-std it is multiplied by the policy's standard deviation.

    Two policies whose means differ by delta have the KL divergence delta^2 / (2 std^2). A step of Adam moves each
    weight by about the learning rate, so it moves the mean by an amount in proportion to the learning rate. If the
    learning rate is in proportion to the std, a step changes the policy by about the same KL at any noise, and the
    policy still learns when the noise is small.
    """
    learning_rate = args.learning_rate.at(progress)
    if not args.lr_times_std:
        return learning_rate
    return learning_rate * agent.actor_logstd.exp().mean().item()


def linear_fit(x, y, alive):
    """The values (..., G) that a linear regression of y (..., G) on x (..., G, k) predicts, over a group's G episodes.

    Only living episodes count. The regression has a small ridge penalty. The leverage of an episode is the weight of
    its own return in its own fit, so its residual is smaller by the factor 1 - leverage. On average the leverage is at
    most (k + 1) / G, where k counts the columns that differ, so k should be small. It depends on the states of this
    step and not on the action. So with --gae-lambda 1 the expected policy gradient of a state keeps its direction.
    Below 1 this holds only approximately.
    """
    x = x.double()
    y = y.double()[..., None]  # (..., G, 1)
    weight = alive.double()[..., None]  # (..., G, 1)
    count = weight.sum(-2, keepdim=True).clamp(min=1)  # (..., 1, 1)

    x_mean = (x * weight).sum(-2, keepdim=True) / count
    y_mean = (y * weight).sum(-2, keepdim=True) / count
    x = (x - x_mean) * weight
    spread = ((x * x).sum(-2, keepdim=True) / count).sqrt()
    x = x / spread.add(1e-6)

    # a column that is equal in all episodes (the time) is zero here, and the ridge keeps the matrix invertible
    ridge = 0.01 * count * torch.eye(x.shape[-1]).to(x)
    slope = torch.linalg.solve(x.mT @ x + ridge, x.mT @ (y - y_mean))
    fitted = y_mean + x @ slope  # (..., G, 1)
    return fitted[..., 0].to(alive.dtype)


SMALLEST_SPREAD = 0.3  # of the mean spread; a step of almost no spread would be divided by almost 0


def returns_baseline(batch, gamma, group):
    """The baseline (T, N) and the scale (T, 1) of the value V(s_t) = baseline_t + scale_t * critic(s_t).

    The paper has V = critic, which is baseline 0 and scale 1. Group 1 gives these. With small noise the critic's error
    is larger than the effect of an action. Flights of one start, compared with one another, still show that effect.

    Each `group` of neighbouring episodes flew the same start. Their returns from step t on are regressed linearly on
    their state at step t, the observations that STATE names. The fit is the baseline. Its residuals have a standard
    deviation, the spread, at each step, over all flights of all groups. scale^2 is the spread^2 of the step plus
    (SMALLEST_SPREAD x the mean spread of the steps)^2. The critic learns (return - baseline) / scale, of order 1.

    RLOO (Kool et al. 2019) takes the mean return of the other samples of a question as the baseline. GRPO (Shao et al.
    2024) takes the mean return of the whole group, and divides by the group's spread. Both have one return for each
    sample. We have one for each step, so we regress it on the state.
    """
    if group == 1:
        return torch.zeros_like(batch.rewards), torch.ones_like(batch.rewards[:, :1])
    no_values = torch.zeros_like(batch.critic)
    returns_to_go, _ = gae(batch.rewards, no_values, batch.alive, gamma, 1.0)  # with V = 0 and lambda = 1
    state = batch.obs[..., STATE].unflatten(1, (-1, group))
    grouped_returns = returns_to_go.unflatten(1, (-1, group))
    alive = batch.alive.unflatten(1, (-1, group))
    baseline = linear_fit(state, grouped_returns, alive).flatten(1)
    _, variance = moments(returns_to_go - baseline, batch.alive, 1)
    mean_spread = variance.sqrt().mean()  # steps that no flight reaches count as zeros
    scale = (variance + (SMALLEST_SPREAD * mean_spread) ** 2 + 1e-8).sqrt()
    return baseline, scale


# Shared: training (Algorithm 1) and main ------------------------------------------------------------------------------
def minibatches(args, envs, device):
    """Yield the numbers of epoch and minibatch, and its episodes' indices `mb`: lines 15 and 16.

    Each epoch has every episode once, in a new order.
    """
    for epoch in range(1, args.update_epochs + 1):
        order = torch.randperm(envs.num_envs, device=device)
        for minibatch, mb in enumerate(order.tensor_split(args.num_minibatches), start=1):
            yield epoch, minibatch, mb


def train(args, agent, average, optimizer, envs, run, gradient=ppo_gradient):
    """Algorithm 1, with its line numbers as comments.

    `run` counts, logs, saves and evaluates. It changes nothing that is learned. Raises FloatingPointError if a loss or
    the gradient is not finite, before the optimiser moves the weights.
    """
    target_kl = math.inf if args.target_kl is None else args.target_kl
    for iteration in range(run.updates_done + 1, args.total_updates + 1):  # line 2
        progress = (iteration - 1) / max(args.total_updates - 1, 1)
        memory_noise = args.memory_noise.at(progress)
        gae_lambda = args.gae_lambda.at(progress)
        ent_coef = args.ent_coef.at(progress)
        set_log_std(agent, args, progress)  # ours
        learning_rate = learning_rate_of(agent, args, progress)  # ours
        optimizer.param_groups[0]["lr"] = learning_rate
        training = curriculum(args, progress)  # ours

        # lines 3-13: fly one episode in every environment
        batch, episodes = rollout(agent, envs, training, args.reward_scale, memory_noise)

        # line 14: returns and advantages
        group = training["flights_per_start"]
        baseline, scale = returns_baseline(batch, args.gamma, group)  # ours; 0 and 1 with group 1
        values = baseline + scale * batch.critic
        advantages, returns = gae(batch.rewards, values, batch.alive, args.gamma, gae_lambda)
        batch.targets = (returns - baseline) / scale
        batch.advantages = advantages
        if args.norm_adv:  # as in CleanRL
            mean, variance = moments(advantages, batch.alive, (0, 1))
            batch.advantages = (advantages - mean) / (variance.sqrt() + 1e-8)

        # lines 15-18: epochs of minibatches
        log = []
        for epoch, minibatch, mb in minibatches(args, envs, advantages.device):  # lines 15 and 16
            losses = gradient(args, agent, batch, mb, ent_coef)  # lines 17 and 18
            losses = runs.finite(losses, epoch, minibatch)
            log.append(losses)
            if losses["approx_kl"] > target_kl:
                break  # ours: this minibatch takes no step and ends the update
            optimizer.step()  # line 18
            average.update_parameters(agent)  # ours; evaluation flies the average

        means = {name: torch.tensor([logged[name] for logged in log]).mean().item() for name in losses}
        means["explained_variance"] = explained_variance(batch.critic, batch.targets, batch.alive)
        means["baseline_explained_variance"] = explained_variance(baseline, returns, batch.alive)

        run.end_update(iteration, batch.alive, episodes, means, learning_rate)


def main(argv):
    """Train and evaluate, or with --eval-only evaluate, by the flags `argv`."""
    args, saved = runs.parse_args(sys.modules[__name__], argv)
    device = runs.prepare_torch(args)
    env_options = {name: getattr(args, name) for name in ENV_OPTIONS} | FIXED_OPTIONS
    envs = runs.make_envs(args, env_options)
    agent = Agent(args, envs).to(device)  # line 1
    runs.load_checkpoint(agent, args, saved)
    average = AveragedModel(agent, multi_avg_fn=get_ema_multi_avg_fn(args.weight_average))
    optimizer = torch.optim.Adam(agent.parameters(), eps=1e-5, fused=True)  # train sets its learning rate
    run = runs.Run(
        args=args,
        saved=saved,
        agent=agent,
        average=average,
        optimizer=optimizer,
        envs=envs,
        env_options=env_options,
        describe=describe,
    )
    gradient = ppo_gradient
    if args.torch_compile:
        gradient = speed_up(agent, average, optimizer, ppo_gradient)
    if not args.eval_only:
        with run:  # however training ends, the state after its last whole update is kept
            train(args, agent, average, optimizer, envs, run, gradient)
    run.finish()


if __name__ == "__main__":
    runs.run_script(main)
