"""CUDA graphs: a step of a rollout, a minibatch's gradient and the optimiser's step, each as one launch on the GPU.

At Table 1's size a GPU computes most operations in a few microseconds, and PyTorch takes as long to launch each one. A
CUDA graph records the launches of a function once and repeats them together. It reads and writes the same memory each
time, so inputs are copied to where the graph reads them. The decisions whether a step is taken (NaN, the KL limit) stay
outside of the graphs.

https://pytorch.org/docs/stable/notes/cuda.html#cuda-graphs
"""

from __future__ import annotations

import dataclasses
import types

import torch
import torch.distributed as dist
import torch.nn.functional as F


def speed_up(agent, average, optimizer, gradient):
    """Compile the agent's network. On a GPU also replace the functions that training repeats by CUDA graphs.

    Returns the gradient function that `train` is to call: `gradient` itself, or its CapturedGradient. Under torchrun
    nothing is captured, because the processes exchange numbers within the gradient.
    """
    captured = on_gpu(agent) and not dist.is_initialized()
    if captured:
        for block in agent.blocks:
            block.attention.step = types.MethodType(ring_step, block.attention)
    agent.encode = torch.compile(agent.encode)
    agent.encode_step = torch.compile(agent.encode_step)
    if not captured:
        return gradient
    agent.act = CapturedAct(agent)
    optimizer.step = CapturedStep(optimizer)
    average.update_parameters = CapturedAverage(average, agent)
    return CapturedGradient(gradient)


def on_gpu(agent):
    """Whether the agent's weights are on a GPU."""
    return agent.actor_logstd.device.type == "cuda"


def capture(function, warm_ups=3):
    """A CUDA graph of function(), and what function() returns: tensors that each replay writes again.

    Before the capture, `warm_ups` calls let libraries choose their kernels. The capture itself computes nothing.
    """
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream), torch.random.fork_rng():  # the random state is put back after the warm-up
        for _ in range(warm_ups):
            function()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        outputs = function()
    return graph, outputs


# ---------------------------------------------------------------------------------------------------------------------
# A rollout's step
# ---------------------------------------------------------------------------------------------------------------------


def ring_step(attention, x, ring, t):
    """RelativeAttention.step with a tensor t (1,): x (N, d) -> (N, d).

    A graph cannot slice at another place in each replay. So keys and values (2, N, H, L + 1, dk) are kept in a ring of
    L + 1 slots. Step t writes slot t mod (L + 1), which held step t - L - 1. Then it reads all slots.
    """
    kv, projections = ring
    slots = torch.arange(kv.shape[3], device=x.device)
    q, kv_of_step = attention.project(x, projections)
    kv.index_copy_(3, t % len(slots), kv_of_step)
    distance = (t - slots) % len(slots)
    return attention.attend(q, kv, attention.R[:, distance])


def new_rings(cache, L):
    """A ring (kv, projections) for each block of an agent's `start_cache`. The memory is in the slots 1 to L."""
    return [(F.pad(kv[..., :L, :], (0, 0, 1, 0)), projections.clone()) for kv, projections, _ in cache]


class CapturedAct:
    """In place of an agent's `act`, for steps t = 0, 1, 2, ... of the same number of environments."""

    def __init__(self, agent):
        self.act = agent.act
        self.L = agent.memory_length
        self.graph = None

    @torch.no_grad()
    def __call__(self, obs, cache, t):
        """hidden (N, d) and actions (N, actions) of obs (N, obs). The next call overwrites them.

        At t = 0 the memory is read from `cache`.
        """
        if self.graph is None:
            self.obs = obs.clone()
            self.t = torch.zeros(1, dtype=torch.long, device=obs.device)
            self.rings = new_rings(cache, self.L)
            self.graph, self.outputs = capture(self.step)
        if t == 0:
            self.begin(cache)
        self.obs.copy_(obs)
        self.graph.replay()
        return self.outputs

    def step(self):
        outputs = self.act(self.obs, self.rings, self.t)
        self.t += 1
        return outputs

    def begin(self, cache):
        self.t.zero_()
        for ring, new_ring in zip(self.rings, new_rings(cache, self.L)):
            for tensor, new in zip(ring, new_ring):
                tensor.copy_(new)


# ---------------------------------------------------------------------------------------------------------------------
# A minibatch's gradient
# ---------------------------------------------------------------------------------------------------------------------


class CapturedGradient:
    """In place of a script's `ppo_gradient`: a graph for each size of a minibatch.

    The optimiser's graph reads the gradients at one place. So the gradients of all sizes are copied to the tensors of
    the first size.
    """

    def __init__(self, gradient):
        self.gradient = gradient
        self.batch = None  # the graphs read its tensors
        self.copied = None  # the batch that was last copied into them
        self.graphs = {}
        self.gradients = None

    def __call__(self, args, agent, batch, mb, ent_coef):
        if self.batch is None or self.batch.obs.shape != batch.obs.shape:  # the length of episodes may change
            self.batch = dataclasses.replace(batch)
            self.graphs = {}
            self.ent_coef = torch.zeros((), device=mb.device)
        elif batch is not self.copied:
            for field in dataclasses.fields(batch):
                getattr(self.batch, field.name).copy_(getattr(batch, field.name))
        self.copied = batch
        self.ent_coef.fill_(ent_coef)

        if len(mb) not in self.graphs:
            self.capture(args, agent, mb)
        graph, episodes, losses, gradients = self.graphs[len(mb)]
        episodes.copy_(mb)
        graph.replay()
        if gradients is not self.gradients:
            torch._foreach_copy_(self.gradients, gradients)
        weights = [weight for weight in agent.parameters() if weight.requires_grad]
        for weight, gradient in zip(weights, self.gradients, strict=True):
            weight.grad = gradient
        return dict(losses)

    def capture(self, args, agent, mb):
        episodes = mb.clone()
        graph, losses = capture(lambda: self.gradient(args, agent, self.batch, episodes, self.ent_coef))
        gradients = [weight.grad for weight in agent.parameters() if weight.requires_grad]
        self.gradients = self.gradients or gradients
        self.graphs[len(mb)] = (graph, episodes, losses, gradients)


# ---------------------------------------------------------------------------------------------------------------------
# The optimiser's step, and the average of the weights
# ---------------------------------------------------------------------------------------------------------------------


class CapturedStep:
    """In place of a fused Adam's `step`. The first call is a plain step, in which Adam makes its moments."""

    def __init__(self, optimizer):
        self.step = optimizer.step
        (self.settings,) = optimizer.param_groups
        self.lr = torch.zeros((), device=self.settings["params"][0].device)
        self.began = False
        self.graph = None

    def __call__(self):
        if not self.began:
            self.began = True
            self.step()
            return
        if self.graph is None:
            self.graph, _ = capture(self.step_with_tensor, warm_ups=0)
        self.lr.fill_(self.settings["lr"])
        self.graph.replay()

    def step_with_tensor(self):
        """The step with its learning rate in a tensor, which a graph reads anew in each replay."""
        learning_rate = self.settings["lr"]
        self.settings.update(lr=self.lr, capturable=True)
        self.step()
        self.settings.update(lr=learning_rate, capturable=False)


class CapturedAverage:
    """In place of an AveragedModel's `update_parameters`. The first call is a plain one, which copies the weights."""

    def __init__(self, average, agent):
        self.average = average
        self.update_parameters = average.update_parameters
        self.averaged = [weight.detach() for weight in average.parameters()]
        self.weights = [weight.detach() for weight in agent.parameters()]
        self.graph = None

    def __call__(self, agent):
        if self.average.n_averaged == 0:
            self.update_parameters(agent)
            return
        if self.graph is None:
            self.graph, _ = capture(self.update, warm_ups=0)
        self.graph.replay()
        self.average.n_averaged += 1

    def update(self):
        self.average.multi_avg_fn(self.averaged, self.weights, self.average.n_averaged)
