"""How fast environments, updates and whole trainings are. Let nothing else run beside it.

    python -m benchmarks.speed environments                           # steps a second of every id: some minutes
    python -m benchmarks.speed update                                 # rollout and epoch of three networks on one core
    python -m benchmarks.speed update di rocket --ways plain compiled
    python -m benchmarks.speed update table1 --ways plain graphs compiled --cuda    # on a GPU; --tf32
    python -m benchmarks.speed growth results/update_speed.png        # an epoch against T, L and N
    python -m benchmarks.speed trainings [results/di ...]             # beside the shipped runs: ten minutes for all

`update` measures each size and way in a process of its own: by plain PyTorch, by CUDA graphs (on a GPU), and compiled,
which is --torch-compile (on a GPU with graphs, too). It prints

- the seconds of the first update, of a rollout, of an epoch, and of the update with all its epochs that they make
- where a rollout and an epoch spend their seconds, with the GPU waited for after each part
- on a CPU: FLOP of an epoch by torch's counter; the rate over that of the same matrix products alone; what kinds of
  operations take the time; and an epoch in which every sample has a copy of its memory window, whose keys and values
  are projected again. The public PPO-Transformer-XL codes do so. It is timed with 64 samples and scaled up.
- on a GPU: launches and kernels of a step and of a minibatch
- how far a rollout's policy is from the same policy in training, at log-std -8: the KL divergence that rounding makes

`trainings` starts each result's first training and ends it after some seconds. The shipped run had another training
beside it, on the machine's other core.
"""

from __future__ import annotations

import contextlib
import importlib
import math
import multiprocessing
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from statistics import median
from unittest import mock

import gymnasium as gym
import numpy as np
import torch
from matplotlib.figure import Figure
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

import cuda_graphs
import ppo_gtrxl_di
import ppo_gtrxl_rocket
from benchmarks.policies import environment_options
from benchmarks.run_seeds import ROOT
from benchmarks.same_training import first_trainings, results_folder
from common.command_line import OneLineParser, integer
from common.curves import read_csv, read_curve
from common.tasks import env_ids, task_of
from drawing.style import save_figures
from runs import keep_memory

TINY = {"num_envs": 4, "num_blocks": 1, "embed_dim": 8, "num_heads": 2, "memory_length": 4, "num_minibatches": 2}
SIZES = {  # by Table 1, but for our rocket and the tiny one
    "tiny": ("ppo_gtrxl_di", TINY),
    "di": ("ppo_gtrxl_di", {}),
    "vdp": ("ppo_gtrxl_vdp", {}),
    "rocket": ("ppo_gtrxl_rocket", ppo_gtrxl_rocket.RECIPES["RocketAscent-v0"]),
    "table1": ("ppo_gtrxl_rocket", {}),
    "table1_8": ("ppo_gtrxl_rocket", {"num_envs": 8, "num_minibatches": 1}),  # fits into a CPU's memory and patience
}
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
    """A line for each id: N environments in one native batch, and a Python loop over single ones, on one core."""
    print(f"{'id':35} {'batch of ' + str(options.num_envs):>14} {'single':>10}   steps/s on one core")
    for env_id in env_ids():
        for label, env_options, action in task_of(env_id).speed_cases():
            batch = gym.make_vec(env_id, num_envs=options.num_envs, **env_options)
            single = gym.make(env_id, **env_options)
            rates = []
            for env, steps in ((batch, options.num_envs), (single, 1)):
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

    def minibatch(self, batch):
        """The gradient of a first minibatch. Returns what is logged."""
        mb = torch.arange(self.args.num_envs // self.args.num_minibatches, device=batch.rewards.device)
        return self.gradient(self.args, self.agent, batch, mb, 0.0)


def measure(size, way, options, pipe=None):
    """All figures of one size and way, as they are printed."""
    keep_memory()
    torch.set_num_threads(options.threads)
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
    memory = torch.cuda.max_memory_allocated() / 1e6 if options.cuda else peak_memory()
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
    if options.cuda:
        figures |= launches(bench, batch)
    elif way == "plain":
        figures |= limits(bench, batch, epoch)
    bench.agent.actor_logstd.data.fill_(-8.0)
    figures["KL of rounding"] = f"{bench.minibatch(bench.flown())['approx_kl'].item():.2g}"
    if pipe:
        pipe.send(figures)
    return figures


def peak_memory():
    """The most MB that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


# --- on a GPU: launches and kernels


def launches(bench, batch):
    """Launches and kernels of one minibatch and of a rollout's step."""
    cache = bench.agent.start_cache(batch.memory, 8)
    with torch.no_grad():
        bench.agent.act(batch.obs[0], cache, 0)
        step = launches_of(lambda: bench.agent.act(batch.obs[0], cache, 1))
    return {"a step": step, "a minibatch": launches_of(lambda: bench.minibatch(batch))}


def launches_of(call):
    call()
    synchronize()
    with torch.profiler.profile() as found:
        call()
        synchronize()
    launched = ("cudaLaunchKernel", "cuLaunchKernel", "cudaGraphLaunch")
    starts = [event for event in found.events() if event.name.startswith(launched)]
    kernels = [event for event in found.events() if event.device_type == torch.autograd.DeviceType.CUDA]
    milliseconds = sum(event.time_range.elapsed_us() for event in kernels) / 1000
    return f"{len(starts)} launches, {len(kernels)} kernels of {milliseconds:.3f} ms in all"


# --- on a CPU: how near the limit it is

KINDS = {  # regular expressions for torch's names of operations
    "products": "aten::(addmm|mm|bmm)",
    "softmax": "aten::_softmax.*",
    "gates, norms, GELU": "aten::(sigmoid.*|lerp|.*layer_norm.*|gelu.*)",
    "copies": "aten::(copy_|cat|fill_|unfold_backward|index.*)",
}


def limits(bench, batch, epoch):
    """FLOP and where the time of an epoch goes, beside matrix products alone and beside windows by sample."""

    def gradients():
        for _, _, mb in bench.script.minibatches(bench.args, bench.envs, "cpu"):
            bench.gradient(bench.args, bench.agent, batch, mb, 0.0)

    with FlopCounterMode(display=False) as counted:
        gradients()
    with Products() as products:
        gradients()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        gradients()
    shares = Counter()
    for row in profile.key_averages():
        kind = next((kind for kind, names in KINDS.items() if re.fullmatch(names, row.key)), "rest")
        shares[kind] += row.self_cpu_time_total / profile.key_averages().self_cpu_time_total
    flop = counted.get_total_flops()
    gathered = gathered_seconds(bench, batch)
    return {
        "FLOP of an epoch": f"{flop:.3e}, {flop / epoch / 1e9:.1f} G a second",
        "rate": f"{products.seconds_alone() / epoch:.2f} of the same matrix products alone",
        "shares": ", ".join(f"{kind} {shares[kind]:.0%}" for kind in [*KINDS, "rest"]),
        "gathered windows": f"{gathered:.2f} s an epoch, {gathered / epoch:.1f} times ours",
    }


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

    def seconds_alone(self):
        """Seconds of all these products on random operands of the same layouts, by the median of five each."""
        seconds = 0.0
        for (function, layouts), count in self.seen.items():
            operands = [random_operand(*layout) for layout in layouts]
            function(*operands)
            seconds += count * median(timed(function, *operands)[0] for _ in range(5))
        return seconds


def random_operand(shape, stride):
    """A random tensor of this layout; windows of an unfold overlap in memory."""
    return torch.randn(1 + sum((n - 1) * step for n, step in zip(shape, stride))).as_strided(shape, stride)


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
        attention, heads = block.attention, block.attention.num_heads
        context = torch.cat([window, x[:, None]], dim=1)  # (B, L + 1, d)
        q = attention.query(x).unflatten(-1, (heads, 1, -1)) / math.sqrt(attention.dk)  # (B, H, 1, dk)
        k = attention.key(context).unflatten(-1, (heads, -1)).transpose(1, 2)  # (B, H, L + 1, dk)
        v = attention.value(context).unflatten(-1, (heads, -1)).transpose(1, 2)
        scores = q @ (k + attention.R.flip(1)).transpose(-1, -2)  # (B, H, 1, L + 1)
        x = block(x, attention.out((scores.softmax(dim=-1) @ v).flatten(1)))
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
            ours, theirs = spawn.Pipe(duplex=False)
            process = spawn.Process(target=measure, args=(size, way, options, theirs))
            process.start()
            theirs.close()
            print(f"{size}, {way}, {options.threads} thread(s)", flush=True)
            try:
                figures = ours.recv()
            except EOFError:
                sys.exit(f"error: {size}, {way} was not measured")
            for name, value in figures.items():
                print(f"  {name:18} {value}", flush=True)
            process.join()


# ---------------------------------------------------------------------------------------------------------------------
# Growth, and whole trainings
# ---------------------------------------------------------------------------------------------------------------------

LABELS = {"T": "steps of an episode T", "L": "memory length L", "N": "episodes N"}
BASE = {"T": 480, "L": 32, "N": 16}
SWEEPS = {"T": [60, 120, 240, 480, 960], "L": [16, 32, 64, 128, 256], "N": [4, 8, 16, 32, 64]}


def epoch_seconds(T, L, N, repeats):
    """Seconds of an epoch of one minibatch, for N random episodes of T steps, by the laptop rocket's network."""
    script = ppo_gtrxl_di
    args = script.Args(num_blocks=2, embed_dim=64, num_heads=4, mlp_dim=64, hidden_dim=64, memory_length=L, num_envs=N)
    agent = script.Agent(args, gym.make_vec(args.env_id, num_envs=N))
    steps = torch.randn(T, N)
    batch = script.Batch(
        obs=torch.randn(T, N, 3),
        actions=steps[..., None],
        logprobs=steps,
        rewards=steps,
        critic=steps,
        alive=torch.ones(T, N),
        memory=agent.new_memory(N, 0.1),
        advantages=steps,
        targets=steps,
    )
    inputs = args, agent, batch, torch.arange(N), 0.0
    script.ppo_gradient(*inputs)
    return median(timed(script.ppo_gradient, *inputs)[0] for _ in range(repeats))


def growth(options):
    """Seconds of an epoch against T, L and N: a table, and a figure."""
    keep_memory()
    torch.set_num_threads(options.threads)
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    for ax, (name, values) in zip(figure.subplots(1, 3), SWEEPS.items()):
        seconds = []
        for value in values:
            sizes = {**BASE, name: value}
            seconds.append(epoch_seconds(**sizes, repeats=options.repeats))
            print(*(f"{key} {size}" for key, size in sizes.items()), f"{seconds[-1]:.3f} s an epoch", flush=True)
        ax.plot(values, seconds, "o-", color="tab:red", label="measured")
        ax.plot(values, [seconds[-1] * value / values[-1] for value in values], ":", color="0.5", label="in proportion")
        others = ", ".join(f"{key} = {value}" for key, value in BASE.items() if key != name)
        ax.set(xlabel=f"{LABELS[name]} ({others})", ylabel="seconds of an epoch", xlim=(0, None), ylim=(0, None))
        ax.grid(alpha=0.3)
        ax.legend()
    save_figures(options.figure.parent, {options.figure.name: figure})


SPS = "charts/SPS"


def curve_of(training, seconds):
    """The curve of a training that is ended after some seconds. Its run folder is deleted."""
    command = [sys.executable, *training.command]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    first = next((line for line in process.stdout if line.startswith("run folder: ")), None)
    if first is None:
        raise RuntimeError(f"{' '.join(training.command)} ended with {process.wait()}")
    folder = ROOT / first.removeprefix("run folder: ").strip()
    time.sleep(seconds)
    process.send_signal(signal.SIGINT)
    process.communicate()
    try:
        return read_curve(folder)
    finally:
        shutil.rmtree(folder)


def compare(name, training, seconds):
    """A line: steps a second (evaluations not counted) here and in the shipped run after as many updates, their ratio.

    Raises RuntimeError if the training makes no update in these seconds.
    """
    curve = curve_of(training, seconds)
    if SPS not in curve:
        raise RuntimeError(f"{name} made no update in {seconds} s; give more --seconds")
    shipped = read_csv(ROOT / name / "seeds" / f"{training.args['seed']}.csv")
    updates, speeds = curve[SPS]
    here, there = speeds[-1], shipped[SPS][1][len(updates) - 1]
    return f"{name:26}{here:>10.0f}{there:>22.0f}{here / there:>10.2f}{len(updates):>10}"


def trainings(options):
    """A line for each result's first training."""
    found = first_trainings()
    unknown = sorted(set(options.results) - found.keys())
    if unknown:
        raise ValueError(f"{', '.join(unknown)} must be among {', '.join(found)}")
    print(f"{'steps a second':26}{'alone':>10}{'the shipped run':>22}{'ratio':>10}{'updates':>10}", flush=True)
    for name in options.results or found:
        print(compare(name, found[name], options.seconds), flush=True)


def parse_args():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True, metavar="{environments,update,growth,trainings}")

    command = commands.add_parser("environments", help="environment steps a second on one core")
    command.set_defaults(function=environments)
    command.add_argument("--num-envs", type=integer(1, 10**6), default=128)
    command.add_argument("--seconds", type=integer(1, 3600), default=1)

    command = commands.add_parser("update", help="rollout, epoch and update of a script's training")
    command.set_defaults(function=updates)
    command.add_argument("sizes", nargs="*", default=["di", "rocket", "table1_8"], help=f"of {', '.join(SIZES)}")
    command.add_argument("--ways", nargs="+", choices=WAYS, default=["plain"])
    command.add_argument("--threads", type=integer(1, 1024), default=1)
    command.add_argument("--repeats", type=integer(1, 1000), default=3)
    command.add_argument("--cuda", action="store_true", help="on a GPU")
    command.add_argument("--tf32", action="store_true", help="round the factors of matrix products, on a GPU")

    command = commands.add_parser("growth", help="how an epoch grows with T, L and N")
    command.set_defaults(function=growth)
    command.add_argument("figure", type=Path, help="the .png to write")
    command.add_argument("--threads", type=integer(1, 1024), default=1)
    command.add_argument("--repeats", type=integer(1, 1000), default=3)

    command = commands.add_parser("trainings", help="the first seconds of each result's training")
    command.set_defaults(function=trainings)
    command.add_argument("results", nargs="*", type=results_folder, help="results folders; without one, all")
    command.add_argument("--seconds", type=integer(1, 3600), default=50, help="seconds of each training")

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
