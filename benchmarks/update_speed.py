"""How fast an update is, against this machine's matrix products and against windows gathered per sample.

    python benchmarks/update_speed.py                      # all sizes, one core
    python benchmarks/update_speed.py --sizes di rocket --repeats 5 --threads 2
    python benchmarks/update_speed.py --compile            # what --torch-compile brings
    python benchmarks/update_speed.py --growth results/update_speed.png

Each size runs in its own process, so that its peak memory can be measured. It prints

- the seconds of a rollout and of a PPO epoch, and the rollout's share of an update
- the epoch's FLOP (`flop_of_epoch`, and torch's count), and their rate over that of the same matrix products alone
- the epoch of the straightforward implementation of the public PPO-Transformer-XL codes, in which every sample has a
  copy of its window, whose keys and values are projected again
"""

from __future__ import annotations

import argparse
import importlib
import math
import multiprocessing
import re
import resource
import sys
import time
from collections import Counter
from functools import partial
from pathlib import Path

import gymnasium as gym
import torch
from matplotlib.figure import Figure
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from one_update import one_update  # noqa: E402

import ppo_gtrxl_rocket  # noqa: E402
from drawing.style import save_figures  # noqa: E402
from runs import keep_memory  # noqa: E402

SIZES = {  # by Table 1, but for our rocket
    "di": ("ppo_gtrxl_di", {}),
    "vdp": ("ppo_gtrxl_vdp", {}),
    "rocket": ("ppo_gtrxl_rocket", ppo_gtrxl_rocket.RECIPES["RocketAscent-v0"]),
    "table1": ("ppo_gtrxl_rocket", {"num_envs": 8, "num_minibatches": 1}),
}
GATHERED_SAMPLES = {"table1": 64}  # of a minibatch, where a whole one would need more memory than there is
# every minibatch takes its step, with a learning rate of 0: each epoch finds the same weights
STILL = {"target_kl": None, "learning_rate": 0.0}


def timed(function):
    """Wall-clock seconds of a call, and its result."""
    start = time.perf_counter()
    result = function()
    return time.perf_counter() - start, result


def median(values):
    """The middle value. Of an even number of values it is the higher of the two middle ones."""
    return sorted(values)[len(values) // 2]


def median_seconds(function, repeats):
    """Median wall-clock seconds of `repeats` calls after one that is not counted, and the last call's result."""
    seconds, results = zip(*(timed(function) for _ in range(repeats + 1)))
    return median(seconds[1:]), results[-1]


class Workbench:
    """A script's agent, optimiser and environments at one size, with one epoch an update."""

    def __init__(self, script, **changes):
        self.script = importlib.import_module(script)
        self.epochs = changes.get("update_epochs", self.script.Args().update_epochs)
        self.args = args = self.script.Args(**{**changes, **STILL, "update_epochs": 1})
        torch.manual_seed(args.seed)
        options = {name: getattr(args, name) for name in self.script.ENV_OPTIONS} | self.script.FIXED_OPTIONS
        self.envs = gym.make_vec(args.env_id, num_envs=args.num_envs, **options)
        self.envs.reset(seed=args.seed)
        self.agent = self.script.Agent(args, self.envs)
        self.average = AveragedModel(self.agent, multi_avg_fn=get_ema_multi_avg_fn(args.weight_average))
        self.optimizer = torch.optim.Adam(self.agent.parameters(), eps=1e-5, fused=True)

    def rollout(self):
        args = self.args
        memory_noise = args.memory_noise.at(0.0)
        batch, _ = self.script.rollout(self.agent, self.envs, {}, args.reward_scale, memory_noise)
        return batch

    def epoch(self, batch):
        """All that `train` does with the episodes: advantages, baseline, one epoch of minibatches, what is logged."""
        modules = self.agent, self.average, self.optimizer
        return one_update(self.script, self.args, modules, self.envs, batch)


# --- FLOP -------------------------------------------------------------------------------------------------------------


def flop_of_epoch(bench, batch):
    """FLOP of the matrix products of one epoch, a multiplication and an addition each.

    Per step and block: query and output d^2, key and value d^2 (also of the memory), the gates 4 d^2, the MLP 2 d m;
    scores and values d (L + C), positions d (L + 1). Backward twice as much, but for the observation's gradient.
    """
    args, (T, N) = bench.args, batch.alive.shape
    L = args.memory_length
    d = args.embed_dim
    m = args.mlp_dim
    h = args.hidden_dim
    chunks = math.ceil(T / max(L // 2, 64))
    C = math.ceil(T / chunks)
    inputs = bench.agent.encoder[0].in_features
    actions = batch.actions.shape[-1]
    attention = chunks * C * d * (2 * (L + C) + L + 1)
    block = T * (2 * d * d + 4 * d * d + 2 * d * m) + 2 * (L + T) * d * d + attention
    heads = T * (2 * d * h + h * actions + h)
    return 2 * N * (3 * (args.num_blocks * block + heads) + 2 * T * inputs * d)


class Products(TorchDispatchMode):
    """Counts the matrix products that run under it, by operation, shapes and strides."""

    def __init__(self):
        super().__init__()
        self.seen = Counter()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if function.overloadpacket in (torch.ops.aten.mm, torch.ops.aten.addmm, torch.ops.aten.bmm):
            tensors = [argument for argument in args if isinstance(argument, torch.Tensor)]
            self.seen[function, tuple((tuple(x.shape), x.stride()) for x in tensors)] += 1
        return function(*args, **(kwargs or {}))


def random_operand(shape, stride):
    """A random tensor of this layout; windows of an unfold overlap in memory."""
    return torch.randn(1 + sum((n - 1) * step for n, step in zip(shape, stride))).as_strided(shape, stride)


def seconds_of_products(call, repeats):
    """Seconds that the matrix products of a call take alone, on random operands of the same shapes and strides."""
    with Products() as products:
        call()
    seconds = 0.0
    for (function, operands), count in products.seen.items():
        tensors = [random_operand(*operand) for operand in operands]
        seconds += count * median_seconds(lambda: function(*tensors), max(repeats, 5))[0]  # noqa: B023
    return seconds


# --- where the time goes ----------------------------------------------------------------------------------------------

KINDS = {  # regular expressions for torch's names of operations
    "products": "aten::(addmm|mm|bmm)",
    "softmax": "aten::_softmax.*",
    "gates, norms, GELU": "aten::(sigmoid.*|lerp|.*layer_norm.*|gelu.*)",
    "copies": "aten::(copy_|cat|fill_|unfold_backward|index.*)",
    "optimiser": ".*(Adam|_fused_adam_|aten::lerp_|vector_norm).*",
}


def shares(call):
    """What part of the time of a call's operations each of KINDS takes; the rest is sums, views and dispatch."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        call()
    taken = Counter()
    for row in profile.key_averages():
        kind = next((kind for kind, names in KINDS.items() if re.fullmatch(names, row.key)), "rest")
        taken[kind] += row.self_cpu_time_total
    return {kind: taken[kind] / sum(taken.values()) for kind in [*KINDS, "rest"]}


# --- the straightforward implementation -------------------------------------------------------------------------------


@torch.no_grad()
def block_inputs(agent, obs, memory):
    """What the memory slots hold, (blocks, N, L + T, d): the memory, then each block's inputs."""
    x, slots = agent.encoder(agent_features(agent, obs)), []
    for block, block_memory in zip(agent.blocks, memory):
        slots.append(torch.cat([block_memory, x], dim=1))
        x = block(x, block.attention(x, block_memory))
    return torch.stack(slots)


def agent_features(agent, obs):
    return sys.modules[type(agent).__module__].features(agent, obs)


def encode_gathered(agent, obs, windows):
    """Encode single samples: obs (B, obs), windows (blocks, B, L, d) -> hidden (B, d). The memory has no gradient."""
    x = agent.encoder(agent_features(agent, obs))
    for block, window in zip(agent.blocks, windows):
        attention, heads = block.attention, block.attention.num_heads
        context = torch.cat([window, x[:, None]], dim=1)  # (B, L + 1, d)
        q = attention.query(x).unflatten(-1, (heads, 1, -1)) / math.sqrt(attention.dk)  # (B, H, 1, dk)
        k, v = (map_(context).unflatten(-1, (heads, -1)).transpose(1, 2) for map_ in (attention.key, attention.value))
        scores = q @ (k + attention.R.flip(1)).transpose(-1, -2)  # (B, H, 1, L + 1)
        x = block(x, attention.out((scores.softmax(dim=-1) @ v).flatten(1)))
    return x


def gathered_epoch(bench, batch, samples):
    """Seconds of one epoch of shuffled samples with gathered windows; with `samples` only so many, scaled to all."""
    agent, args, (T, N) = bench.agent, bench.args, batch.alive.shape
    slots = block_inputs(agent, batch.obs.transpose(0, 1), batch.memory)
    reach = torch.arange(args.memory_length)
    order = torch.randperm(T * N)
    size = samples or math.ceil(T * N / args.num_minibatches)
    taken, start = 0, time.perf_counter()
    for chosen in order.split(size)[: 1 if samples else None]:
        t, n = chosen // N, chosen % N
        windows = slots[:, n[:, None], t[:, None] + reach]  # (blocks, B, L, d): steps t - L .. t - 1
        hidden = encode_gathered(agent, batch.obs[t, n], windows)
        newlogprob, entropy, newvalue = agent.evaluate_actions(hidden, batch.actions[t, n])
        ratio = (newlogprob - batch.logprobs[t, n]).exp()
        advantages = batch.advantages[t, n]
        clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
        loss = torch.max(-advantages * ratio, -advantages * clipped).mean() - args.ent_coef.at(0.0) * entropy.mean()
        loss = loss + args.vf_coef * 0.5 * (newvalue - batch.targets[t, n]).square().mean()
        bench.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
        bench.optimizer.step()
        taken += len(chosen)
    return (time.perf_counter() - start) * T * N / taken


# --- measurements -----------------------------------------------------------------------------------------------------


def measure(size, threads, repeats, pipe=None, changes=None):
    """All numbers of one size."""
    keep_memory()
    torch.set_num_threads(threads)
    script, preset = SIZES[size]
    bench = Workbench(script, **{**preset, **(changes or {})})
    rollout, batch = median_seconds(bench.rollout, 1 if size == "table1" else repeats)
    T, N = batch.alive.shape
    bench.epoch(batch)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    samples, epochs, gathered = GATHERED_SAMPLES.get(size), [], []
    for _ in range(repeats):  # by turns: another program on the machine slows both
        epochs.append(timed(lambda: bench.epoch(batch))[0])
        gathered.append(gathered_epoch(bench, batch, samples))
    epoch, gathered = median(epochs), median(gathered)
    with FlopCounterMode(display=False) as counted:
        bench.epoch(batch)
    products = seconds_of_products(lambda: bench.epoch(batch), 1)
    flop = flop_of_epoch(bench, batch)
    update = rollout + bench.epochs * epoch
    figures = {
        "episodes x steps": f"{N} x {T}",
        "rollout": f"{rollout:.3f} s",
        "rollout step": f"{1e3 * rollout / T:.2f} ms",
        "epoch": f"{epoch:.3f} s",
        "update": f"{update:.2f} s of {bench.epochs} epochs",
        "rollout's share": f"{rollout / update:.1%}",
        "samples a second": f"{T * N / update:.0f}",
        "FLOP of an epoch": f"{flop:.3e} by formula, {counted.get_total_flops():.3e} counted",
        "FLOP/s": f"{flop / epoch / 1e9:.1f} G, {products / epoch:.2f} of the same products alone",
        "shares": ", ".join(f"{kind} {share:.0%}" for kind, share in shares(lambda: bench.epoch(batch)).items()),
        "gathered windows": f"{gathered:.2f} s an epoch, {gathered / epoch:.1f} times ours",
        "peak memory": f"{peak:.0f} MB after a rollout and an update",
    }
    pipe.send(figures) if pipe else None
    return figures


def compiled(size, threads, repeats, pipe):
    """The rollout and the epoch as --torch-compile runs them, by turns with those that are not compiled."""
    keep_memory()
    torch.set_num_threads(threads)
    script, preset = SIZES[size]
    plain = Workbench(script, **preset)
    quick = Workbench(script, **preset)
    batch = plain.rollout()
    quick.agent.encode = torch.compile(quick.agent.encode)
    quick.agent.encode_step = torch.compile(quick.agent.encode_step)
    figures = {"compilation": f"{timed(quick.rollout)[0]:.0f} s and {timed(lambda: quick.epoch(batch))[0]:.0f} s"}
    for name in ("rollout", "epoch"):
        calls = {bench: partial(bench.epoch, batch) if name == "epoch" else bench.rollout for bench in (plain, quick)}
        seconds = [[timed(call)[0] for call in calls.values()] for _ in range(repeats)]
        before, after = (median(column) for column in zip(*seconds))
        figures[name] = f"{before:.3f} s, compiled {after:.3f} s"
    pipe.send(figures)


def growth(path, repeats):
    """Seconds of an epoch against T, L and N at the laptop rocket's width: a table, and a figure."""
    script = importlib.import_module("ppo_gtrxl_di")
    network = {"num_blocks": 2, "embed_dim": 64, "num_heads": 4, "mlp_dim": 64, "hidden_dim": 64, "num_minibatches": 1}
    base = {"T": 480, "L": 32, "N": 16}
    sweeps = {"T": [60, 120, 240, 480, 960], "L": [16, 32, 64, 128, 256], "N": [4, 8, 16, 32, 64]}
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    for ax, (name, values) in zip(figure.subplots(1, 3), sweeps.items()):
        seconds = []
        for value in values:
            T, L, N = {**base, name: value}.values()
            bench = Workbench(script.__name__, **network, memory_length=L, num_envs=N)
            steps = torch.randn(T, N)
            obs = torch.randn(T, N, 3)
            memory = bench.agent.new_memory(N, 0.1)
            batch = script.Batch(obs, steps[..., None], steps, steps, steps, torch.ones(T, N), memory)
            seconds.append(median_seconds(lambda: bench.epoch(batch), repeats)[0])  # noqa: B023
            print(f"T {T:4} L {L:3} N {N:3}: {seconds[-1]:.3f} s an epoch", flush=True)
        ax.plot(values, seconds, "o-", color="tab:red", label="measured")
        ax.plot(values, [seconds[-1] * value / values[-1] for value in values], ":", color="0.5", label="in proportion")
        labels = {"T": "steps of an episode T", "L": "memory length L", "N": "episodes N"}
        others = ", ".join(f"{key} = {value}" for key, value in base.items() if key != name)
        ax.set(xlabel=f"{labels[name]} ({others})", ylabel="seconds of an epoch", xlim=(0, None), ylim=(0, None))
        ax.grid(alpha=0.3)
        ax.legend()
    save_figures(path.parent, {path.name: figure})


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=["di", "rocket", "table1"])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--compile", action="store_true", help="measure --torch-compile instead")
    parser.add_argument("--growth", type=Path, metavar="PNG", help="measure and draw the growth with T, L, N instead")
    options = parser.parse_args()
    if options.growth:
        keep_memory()
        torch.set_num_threads(options.threads)
        return growth(options.growth, options.repeats)
    spawn = multiprocessing.get_context("spawn")
    function = compiled if options.compile else measure
    for size in options.sizes:
        ours, theirs = spawn.Pipe(duplex=False)
        process = spawn.Process(target=function, args=(size, options.threads, options.repeats, theirs))
        process.start()
        theirs.close()
        print(f"{size}, {options.threads} thread(s)")
        for name, value in ours.recv().items():
            print(f"  {name:18} {value}", flush=True)
        process.join()


if __name__ == "__main__":
    main()
