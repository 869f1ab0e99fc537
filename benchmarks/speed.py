"""How fast environments and updates are. Let nothing else run beside it.

    python -m benchmarks.speed environments                           # steps a second of every id: some minutes
    python -m benchmarks.speed update                                 # rollout and epoch of three networks on one core
    python -m benchmarks.speed update di rocket --ways plain compiled
    python -m benchmarks.speed update table1 --ways plain graphs compiled --cuda    # on a GPU; --tf32

`update` measures each size and way in a process of its own: by plain PyTorch, by CUDA graphs (on a GPU), and compiled,
which is --torch-compile (on a GPU with graphs, too). It prints

- the seconds of the first update, of a rollout, of an epoch, and of the update with all its epochs that they make
- where a rollout and an epoch spend their seconds, with the GPU waited for after each part
- on a CPU: an epoch in which every sample has a copy of its memory window, whose keys and values are projected again.
  The public PPO-Transformer-XL codes do so. It is timed with 64 samples and scaled up.
- how far a rollout's policy is from the same policy in training, at log-std -8: the KL divergence that rounding makes
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import resource
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from statistics import median
from unittest import mock

import gymnasium as gym
import numpy as np
import torch
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

import cuda_graphs
import ppo_gtrxl_rocket
from benchmarks.policies import environment_options
from common.command_line import OneLineParser, integer
from common.tasks import env_ids, task_of
from runs import keep_memory

SIZES = {  # by Table 1, but for our rocket
    "di": ("ppo_gtrxl_di", {}),
    "vdp": ("ppo_gtrxl_vdp", {}),
    "rocket": ("ppo_gtrxl_rocket", ppo_gtrxl_rocket.RECIPES["RocketAscent-v0"]),
    "table1": ("ppo_gtrxl_rocket", {}),
    "table1_8": ("ppo_gtrxl_rocket", {"num_envs": 8, "num_minibatches": 1}),  # fits into a CPU's memory and patience
}
BATCH = 128  # environments
WAYS = ("plain", "graphs", "compiled")
# one epoch an update, every minibatch takes its step, and with a learning rate of 0 each update finds the same weights
STILL = {"total_updates": 1, "update_epochs": 1, "target_kl": None, "learning_rate": 0.0, "lr_times_std": False}


def timed(function, *inputs):
    """Wall-clock seconds of a call, the GPU's work included, and its result."""
    synchronize()
    start = time.perf_counter()
    result = function(*inputs)
    synchronize()
    return time.perf_counter() - start, result


def synchronize():
    if torch.cuda.is_available():
        torch.cuda.synchronize()


# ---------------------------------------------------------------------------------------------------------------------
# Environments
# ---------------------------------------------------------------------------------------------------------------------


def steps_per_second(env, action, steps, seconds):
    """Environment steps a second of `env.step(action)`, which flies `steps` of them; the best of three runs."""
    best = 0.0
    for _ in range(3):
        calls, start = 0, time.perf_counter()
        while time.perf_counter() - start < seconds / 3:
            terminated = env.step(action)[2]
            if steps == 1 and terminated:
                env.reset()
            calls += 1
        best = max(best, calls * steps / (time.perf_counter() - start))
    return best


def environments(options):
    """A line for each id: environments in one native batch, and a Python loop over single ones, on one core."""
    print(f"{'id':35} {f'batch of {BATCH}':>14} {'single':>10}   steps/s on one core")
    for env_id in env_ids():
        for label, env_options, action in task_of(env_id).speed_cases():
            batch = gym.make_vec(env_id, num_envs=BATCH, **env_options)
            single = gym.make(env_id, **env_options)
            rates = []
            for env, steps in ((batch, BATCH), (single, 1)):
                env.reset(seed=0)
                env.action_space.seed(0)
                flown = env.action_space.sample() if action is None else np.broadcast_to(action, env.action_space.shape)
                rates.append(steps_per_second(env, flown, steps, options.seconds))
            print(f"{env_id + label:35} {rates[0]:14,.0f} {rates[1]:10,.0f}", flush=True)


# ---------------------------------------------------------------------------------------------------------------------
# An update
# ---------------------------------------------------------------------------------------------------------------------


class Bench:
    """A script's training at one size, in one way."""

    updates_done = 0  # `train` takes it for a `runs.Run`

    def __init__(self, size, way="plain", device="cpu"):
        name, changes = SIZES[size]
        self.script = importlib.import_module(name)
        self.epochs = self.script.Args(**changes).update_epochs
        self.args = self.script.Args(**{**changes, **STILL})
        torch.manual_seed(1)
        options = environment_options(self.script, self.args)
        self.envs = gym.make_vec(self.args.env_id, num_envs=self.args.num_envs, **options)
        self.envs.reset(seed=1)
        self.agent = self.script.Agent(self.args, self.envs).to(device)
        self.average = AveragedModel(self.agent, multi_avg_fn=get_ema_multi_avg_fn(0.99))
        self.optimizer = torch.optim.Adam(self.agent.parameters(), eps=1e-5, fused=True)
        self.gradient = self.script.ppo_gradient
        not_compiled = mock.patch.object(torch, "compile", lambda function: function)
        if way != "plain":
            with not_compiled if way == "graphs" else contextlib.nullcontext():
                self.gradient = cuda_graphs.speed_up(self.agent, self.average, self.optimizer, self.gradient)

    def end_update(self, *what_is_logged):
        """As a `runs.Run`'s, but nothing is kept."""

    def update(self, *parts):
        """Do one update. Returns its seconds, and those of the parts."""
        owners = {
            "rollout": (self.script, "rollout"),
            "environment": (self.envs, "step"),
            "network": (self.agent, "act"),
            "gradients": (self, "gradient"),
            "optimiser": (self.optimizer, "step"),
            "average": (self.average, "update_parameters"),
        }
        seconds = Counter()

        def watched(part, function):
            def call(*inputs):
                taken, result = timed(function, *inputs)
                seconds[part] += taken
                return result

            return call

        with contextlib.ExitStack() as patched:
            for part in parts:
                owner, name = owners[part]
                patched.enter_context(mock.patch.object(owner, name, watched(part, getattr(owner, name))))
            modules = self.agent, self.average, self.optimizer
            seconds["update"], _ = timed(self.script.train, self.args, *modules, self.envs, self, self.gradient)
        return seconds

    def flown(self):
        """The episodes of a rollout, with advantages of zero."""
        batch, _ = self.script.rollout(self.agent, self.envs, {}, self.args.reward_scale, 0.0)
        batch.advantages = batch.targets = torch.zeros_like(batch.rewards)
        return batch

    def rounding(self):
        """The KL divergence between rollout and training that rounding makes, at log-std -8."""
        self.agent.actor_logstd.data.fill_(-8.0)
        batch = self.flown()
        mb = torch.arange(self.args.num_envs // self.args.num_minibatches, device=batch.rewards.device)
        return self.gradient(self.args, self.agent, batch, mb, 0.0)["approx_kl"].item()


def measure(size, way, options):
    """All figures of one size and way, as they are printed."""
    keep_memory()
    torch.set_num_threads(1)
    torch.backends.cuda.matmul.allow_tf32 = options.tf32
    bench = Bench(size, way, "cuda" if options.cuda else "cpu")
    first = bench.update()["update"]
    updates = [bench.update("rollout") for _ in range(options.repeats)]
    rollout = median(seconds["rollout"] for seconds in updates)
    epoch = median(seconds["update"] - seconds["rollout"] for seconds in updates)
    update = rollout + bench.epochs * epoch
    parts = bench.update("rollout", "environment", "network", "gradients", "optimiser", "average")
    batch = bench.flown()
    T, N = batch.alive.shape
    if options.cuda:
        memory = torch.cuda.max_memory_allocated() / 1e6
    else:
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    figures = {
        "episodes x steps": f"{N} x {T}",
        "first update": f"{first:.1f} s",
        "rollout": f"{rollout:.3f} s, {1e3 * rollout / T:.2f} ms a step",
        "epoch": f"{epoch:.3f} s",
        "update": f"{update:.2f} s of {bench.epochs} epochs, {T * N / update:.0f} samples a second",
        "rollout's share": f"{rollout / update:.1%}",
        "parts": ", ".join(f"{part} {seconds:.3f} s" for part, seconds in parts.items()),
        "peak memory": f"{memory:.0f} MB",
    }
    if way == "plain" and not options.cuda:
        gathered = gathered_seconds(bench, batch)
        figures["gathered windows"] = f"{gathered:.2f} s an epoch, {gathered / epoch:.1f} times ours"
    figures["KL of rounding"] = f"{bench.rounding():.2g}"
    return figures


@torch.no_grad()
def block_inputs(agent, obs, memory):
    """What the memory slots hold, (blocks, N, L + T, d): the memory, then each block's inputs."""
    inputs = []
    hooks = [block.register_forward_pre_hook(lambda _, given: inputs.append(given[0])) for block in agent.blocks]
    agent.encode(obs, memory)
    for hook in hooks:
        hook.remove()
    return torch.cat([memory, torch.stack(inputs)], dim=2)


def encode_gathered(bench, obs, windows):
    """Encode single samples: obs (B, obs), windows (blocks, B, L, d) -> hidden (B, d). The memory has no gradient."""
    agent = bench.agent
    x = agent.encoder(bench.script.features(agent, obs))
    for block, window in zip(agent.blocks, windows):
        context = torch.cat([window, x[:, None]], dim=1)  # (B, L + 1, d)
        kv, projections, R = block.attention.start_cache(context, 0)
        q, _ = block.attention.project(x, projections)
        x = block(x, block.attention.attend(q, kv, R))
    return x


def gathered_seconds(bench, batch, samples=64):
    """Seconds of an epoch with windows by sample: gathering, encoding and its gradient, of some samples, scaled up."""
    T, N = batch.alive.shape
    slots = block_inputs(bench.agent, batch.obs.transpose(0, 1), batch.memory)
    t = torch.randint(T, (samples,))
    n = torch.randint(N, (samples,))

    def learn():
        windows = slots[:, n[:, None], t[:, None] + torch.arange(bench.args.memory_length)]  # steps t - L .. t - 1
        encode_gathered(bench, batch.obs[t, n], windows).sum().backward()

    learn()
    return median(timed(learn)[0] for _ in range(3)) * T * N / samples


def updates(options):
    """Print the figures of each size and way, each measured in a process of its own."""
    spawn = multiprocessing.get_context("spawn")
    for size in options.sizes:
        for way in options.ways:
            print(f"{size}, {way}", flush=True)
            with ProcessPoolExecutor(1, mp_context=spawn) as own:
                figures = own.submit(measure, size, way, options).result()
            for name, value in figures.items():
                print(f"  {name:18} {value}", flush=True)


def parse_args():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True, metavar="{environments,update}")

    command = commands.add_parser("environments", help="environment steps a second on one core")
    command.set_defaults(function=environments)
    command.add_argument("--seconds", type=integer(1, 3600), default=1)

    command = commands.add_parser("update", help="rollout, epoch and update of a script's training")
    command.set_defaults(function=updates)
    command.add_argument("sizes", nargs="*", default=["di", "rocket", "table1_8"], help=f"of {', '.join(SIZES)}")
    command.add_argument("--ways", nargs="+", choices=WAYS, default=["plain"])
    command.add_argument("--repeats", type=integer(1, 1000), default=3)
    command.add_argument("--cuda", action="store_true", help="on a GPU")
    command.add_argument("--tf32", action="store_true", help="round the factors of matrix products, on a GPU")

    options = parser.parse_args()
    unknown = [size for size in getattr(options, "sizes", []) if size not in SIZES]
    if unknown:
        parser.error(f"{', '.join(unknown)} must be among {', '.join(SIZES)}")
    return options


def main():
    options = parse_args()
    try:
        options.function(options)
    except (OSError, RuntimeError, ValueError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
