"""How fast an update is on a GPU: launch by launch, by CUDA graphs, and by graphs of the compiled network.

    python benchmarks/gpu_speed.py                           # Table 1, three ways, with and without TF32
    python benchmarks/gpu_speed.py --sizes di vdp rocket table1 --ways graphs
    python benchmarks/gpu_speed.py --sizes tiny --cpu                  # that it runs, without a GPU

Each size and way runs in its own process. All processes prepare at the same time, and are timed one after the other.
It prints

- the seconds of an update, the median of three, and of its rollout
- where one more update spends its seconds, with the GPU waited for after each part
- the launches of a step and of a minibatch, and the kernels that they run (torch's profiler)
- how far a rollout's policy is from the same policy in training, at log-std -8: the KL divergence of the first
  minibatch, which rounding alone makes; from --target-kl on it would end an update before its first step
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import multiprocessing
import sys
import time
import traceback
from collections import Counter
from pathlib import Path
from unittest import mock

import gymnasium as gym
import torch
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import cuda_graphs  # noqa: E402
import ppo_gtrxl_rocket  # noqa: E402

STILL = {"target_kl": None, "learning_rate": 0.0, "lr_times_std": False}  # every update does the same work
TINY = {"num_blocks": 1, "embed_dim": 8, "num_heads": 2, "memory_length": 4, "update_epochs": 1, "num_minibatches": 2}
SIZES = {  # by Table 1, but for our rocket
    "di": ("ppo_gtrxl_di", {}),
    "vdp": ("ppo_gtrxl_vdp", {}),
    "rocket": ("ppo_gtrxl_rocket", ppo_gtrxl_rocket.RECIPES["RocketAscent-v0"]),
    "table1": ("ppo_gtrxl_rocket", {}),
    "tiny": ("ppo_gtrxl_di", {**TINY, "num_envs": 4}),
}
WAYS = ("plain", "graphs", "compiled")


def synchronize():
    if torch.cuda.is_available():
        torch.cuda.synchronize()


class Stopwatch:
    """The seconds spent in wrapped functions, by name. The stopwatch waits for the GPU's work."""

    def __init__(self):
        self.seconds = Counter()

    def wrap(self, name, function):
        def timed(*args, **kwargs):
            synchronize()
            start = time.perf_counter()
            result = function(*args, **kwargs)
            synchronize()
            self.seconds[name] += time.perf_counter() - start
            return result

        return timed


class UpdateClock:
    """In place of `runs.Run`: the seconds of each update, and what it logs."""

    def __init__(self):
        self.updates_done = 0
        self.seconds = []
        self.losses = []
        self.last = time.perf_counter()

    def end_update(self, iteration, alive, episodes, losses, learning_rate):
        synchronize()
        self.seconds.append(time.perf_counter() - self.last)
        self.losses.append(losses)
        self.last = time.perf_counter()


class Bench:
    """A script's training at one size, in one way."""

    def __init__(self, size, way, device):
        name, changes = SIZES[size]
        self.script = importlib.import_module(name)
        self.args = self.script.Args(**{**changes, **STILL})
        torch.manual_seed(1)
        options = {option: getattr(self.args, option) for option in self.script.ENV_OPTIONS}
        options |= self.script.FIXED_OPTIONS
        self.envs = gym.make_vec(self.args.env_id, num_envs=self.args.num_envs, **options)
        self.envs.reset(seed=1)
        self.agent = self.script.Agent(self.args, self.envs).to(device)
        self.average = AveragedModel(self.agent, multi_avg_fn=get_ema_multi_avg_fn(0.99))
        self.optimizer = torch.optim.Adam(self.agent.parameters(), eps=1e-5, fused=True)
        self.gradient = self.script.ppo_gradient
        if way == "compiled":
            self.gradient = cuda_graphs.speed_up(self.agent, self.average, self.optimizer, self.gradient)
        if way == "graphs":
            with mock.patch.object(torch, "compile", lambda function: function):
                self.gradient = cuda_graphs.speed_up(self.agent, self.average, self.optimizer, self.gradient)

    def train(self, updates, gradient=None):
        clock = UpdateClock()
        args = self.script.Args(**{**vars(self.args), "total_updates": updates})
        modules = self.agent, self.average, self.optimizer
        self.script.train(args, *modules, self.envs, clock, gradient or self.gradient)
        return clock

    def parts(self):
        """Seconds of the parts of one update."""
        watch = Stopwatch()
        script, agent = self.script, self.agent
        with contextlib.ExitStack() as patched:
            for name in ("rollout", "returns_baseline", "gae", "explained_variance"):
                function = watch.wrap(name, getattr(script, name))
                patched.enter_context(mock.patch.object(script, name, function))
            patched.enter_context(mock.patch.object(self.envs, "step", watch.wrap("envs.step", self.envs.step)))
            act = watch.wrap("act", agent.act)
            patched.enter_context(mock.patch.object(agent, "act", act))
            patched.enter_context(
                mock.patch.object(
                    self.average, "update_parameters", watch.wrap("average", self.average.update_parameters)
                )
            )
            if self.gradient is script.ppo_gradient:
                patched.enter_context(mock.patch.object(script, "ppo_loss", watch.wrap("forward", script.ppo_loss)))
                backward = watch.wrap("backward", torch.Tensor.backward)
                patched.enter_context(mock.patch.object(torch.Tensor, "backward", backward))
            step = self.optimizer.step
            self.optimizer.step = watch.wrap("optimizer", step)
            clock = self.train(1, watch.wrap("gradient", self.gradient))
            self.optimizer.step = step
        return {"update": clock.seconds[0], **watch.seconds}

    def kl_of_rounding(self):
        """The first minibatch's approx_kl at log-std -8."""
        self.agent.actor_logstd.data.fill_(-8.0)
        args, script = self.args, self.script
        batch, _ = script.rollout(self.agent, self.envs, {}, args.reward_scale, 0.0)
        batch.advantages = batch.targets = torch.zeros_like(batch.rewards)
        mb = torch.arange(args.num_envs // args.num_minibatches, device=batch.rewards.device)
        return self.gradient(args, self.agent, batch, mb, 0.0)["approx_kl"].item()

    def launches(self):
        """Launches and kernels, and the kernels' milliseconds, of one minibatch and of a rollout's share of steps."""
        args, script = self.args, self.script
        batch, _ = script.rollout(self.agent, self.envs, {}, args.reward_scale, 0.0)
        batch.advantages = batch.targets = torch.zeros_like(batch.rewards)
        mb = torch.arange(args.num_envs // args.num_minibatches, device=batch.rewards.device)
        cache = self.agent.start_cache(batch.memory, 8)
        with torch.no_grad():
            self.agent.act(batch.obs[0], cache, 0)

        def minibatch():
            self.gradient(args, self.agent, batch, mb, 0.0)

        @torch.no_grad()
        def step():
            self.agent.act(batch.obs[0], cache, 1)

        return {"minibatch": profile(minibatch), "step": profile(step)}


def profile(call):
    activities = [torch.profiler.ProfilerActivity.CPU]
    if torch.cuda.is_available():
        activities.append(torch.profiler.ProfilerActivity.CUDA)
    call()
    synchronize()
    with torch.profiler.profile(activities=activities) as found:
        call()
        synchronize()
    launches = kernels = 0
    milliseconds = 0.0
    kinds = Counter()
    for event in found.events():
        if event.name.startswith(("cudaLaunchKernel", "cuLaunchKernel", "cudaGraphLaunch")):
            launches += 1
        if event.device_type == torch.autograd.DeviceType.CUDA and not event.name.startswith("ProfilerStep"):
            kernels += 1
            duration = event.time_range.elapsed_us() / 1000
            milliseconds += duration
            kinds[event.name[:60]] += duration
    top = {name: round(value, 3) for name, value in kinds.most_common(12)}
    return {"launches": launches, "kernels": kernels, "ms": round(milliseconds, 3), "top": top}


def measure(size, way, tf32, device, lock, results):
    """Put all numbers of one size and way into `results`. An error is printed and ends only this one."""
    name = f"{size} {way}{' TF32' if tf32 else ''}"
    try:
        torch.set_num_threads(1)
        torch.backends.cuda.matmul.allow_tf32 = tf32
        start = time.perf_counter()
        bench = Bench(size, way, device)
        first = bench.train(1)
        prepared = time.perf_counter() - start
        with lock:
            clock = bench.train(3)
            seconds = sorted(clock.seconds)[1]
            figures = {"prepared": prepared, "update": seconds, "parts": bench.parts(), "losses": first.losses[0]}
            print(f"{name}: {seconds:.3f} s an update, prepared in {prepared:.0f} s", flush=True)
        figures["kl"] = bench.kl_of_rounding()
        with lock:
            figures["launches"] = bench.launches()
        if torch.cuda.is_available():
            figures["peak GB"] = torch.cuda.max_memory_allocated() / 1e9
        results[name] = figures
    except Exception:
        print(f"{name} failed:\n{traceback.format_exc()}", flush=True)


def report(results):
    """Print the tables."""
    for name, figures in results.items():
        parts = "  ".join(f"{part} {seconds:.3f}" for part, seconds in figures["parts"].items())
        print(f"\n{name}: update {figures['update']:.3f} s  KL of rounding {figures['kl']:.2g}")
        print(f"  seconds of one update, each part waited for: {parts}")
        for what, found in figures["launches"].items():
            print(f"  a {what}: {found['launches']} launches, {found['kernels']} kernels of {found['ms']} ms in all")
            print(f"    {found['top']}")
        print("  first update:", {key: float(f"{value:.6g}") for key, value in figures["losses"].items()})


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=["table1"])
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--tf32", choices=["off", "on", "both"], default="both")
    parser.add_argument("--cpu", action="store_true", help="only that it runs")
    parser.add_argument("--json", type=Path, help="also write the figures here")
    options = parser.parse_args()
    device = "cpu" if options.cpu else "cuda"
    precisions = {"off": [False], "on": [True], "both": [False, True]}[options.tf32]
    spawn = multiprocessing.get_context("spawn")
    with spawn.Manager() as manager:
        results, lock = manager.dict(), manager.Lock()
        jobs = [(size, way, tf32) for size in options.sizes for way in options.ways for tf32 in precisions]
        processes = [spawn.Process(target=measure, args=(*job, device, lock, results)) for job in jobs]
        for process in processes:
            process.start()
        for process in processes:
            process.join()
        results = dict(results)
    report(results)
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
