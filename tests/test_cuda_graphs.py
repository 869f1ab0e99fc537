"""The code of a GPU with --torch-compile, on a CPU: instead of replaying a graph, the function is called again."""

import gymnasium as gym
import pytest
import torch
from helpers import SMALL
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

import cuda_graphs
import ppo_gtrxl_di
import ppo_gtrxl_rocket

torch.set_num_threads(1)


class Graph:
    """As a CUDA graph's, its results and the gradients stand where those of the capture stood."""

    def __init__(self, function, agent, computes):
        self.function, self.agent = function, agent
        with torch.random.fork_rng():
            self.outputs = function() if computes else None
        self.tensors = self.written(self.outputs)
        self.read_at = None if computes else self.gradients_at()

    def written(self, outputs):
        results = [] if outputs is None else list(outputs.values()) if isinstance(outputs, dict) else list(outputs)
        return results + [weight.grad for weight in self.agent.parameters() if weight.grad is not None]

    def gradients_at(self):
        return [weight.grad.data_ptr() for weight in self.agent.parameters() if weight.grad is not None]

    def replay(self):
        if self.read_at:  # the optimiser's graph reads the gradients where they were at its capture
            assert self.gradients_at() == self.read_at
            return self.function()
        for static, new in zip(self.tensors, self.written(self.function())):
            static.detach().copy_(new.detach())


@pytest.fixture
def captured(monkeypatch):
    """A function that does to an agent what `speed_up` does on a GPU; returns the gradient function."""

    def speed_up(agent, average, optimizer, gradient):
        def capture(function, warm_ups=3):
            graph = Graph(function, agent, computes=warm_ups > 0)
            return graph, graph.outputs

        monkeypatch.setattr(cuda_graphs, "capture", capture)
        monkeypatch.setattr(torch, "compile", lambda function: function)
        monkeypatch.setattr(cuda_graphs, "on_gpu", lambda agent: True)
        return cuda_graphs.speed_up(agent, average, optimizer, gradient)

    return speed_up


def new_agent(script, dtype=torch.float32, **changes):
    args = script.Args(**{**SMALL, "num_blocks": 2, "update_epochs": 2, **changes})
    torch.manual_seed(0)
    envs = gym.make_vec(args.env_id, num_envs=4)
    envs.reset(seed=0)
    return args, script.Agent(args, envs).to(dtype), envs


@pytest.mark.parametrize(
    "script, L", [(ppo_gtrxl_di, 0), (ppo_gtrxl_di, 1), (ppo_gtrxl_di, 7), (ppo_gtrxl_di, 300), (ppo_gtrxl_rocket, 7)]
)
def test_the_same_flights(script, L, captured):
    """Two rollouts one after the other, shorter and longer than the memory: the plain ones to 1e-9."""
    _, plain, envs = new_agent(script, torch.float64, memory_length=L)
    _, quick, other_envs = new_agent(script, torch.float64, memory_length=L)
    with torch.no_grad():
        for agent in (plain, quick):
            torch.manual_seed(1)
            for parameter in agent.parameters():
                parameter += 0.1 * torch.randn_like(parameter)
    captured(quick, *learner_of(quick), script.ppo_gradient)
    for seed in (2, 3):
        flown = []
        for agent, flights in ((plain, envs), (quick, other_envs)):
            torch.manual_seed(seed)
            flown.append(script.rollout(agent, flights, {}, 1.0, 0.1)[0])
        for name, expected in vars(flown[0]).items():
            if expected is not None:
                torch.testing.assert_close(vars(flown[1])[name], expected, rtol=1e-9, atol=1e-9, msg=name)


def learner_of(agent):
    average = AveragedModel(agent, multi_avg_fn=get_ema_multi_avg_fn(0.9))
    return average, torch.optim.Adam(agent.parameters(), eps=1e-5, fused=True)


class Counter:
    """In place of `runs.Run`: it keeps the losses."""

    def __init__(self):
        self.updates_done = 0
        self.losses = []

    def end_update(self, iteration, alive, episodes, losses, learning_rate):
        self.losses.append(losses)


def learn(script, speed_up=None, num_envs=4, **changes):
    """The weights and the losses of three updates in double precision."""
    args, agent, envs = new_agent(script, torch.float64, total_updates=3, memory_length=6, **changes)
    average, optimizer = learner_of(agent)
    gradient = speed_up(agent, average, optimizer, script.ppo_gradient) if speed_up else script.ppo_gradient
    counter = Counter()
    script.train(args, agent, average, optimizer, envs, counter, gradient)
    return dict(average.named_parameters()), counter.losses


@pytest.mark.parametrize(
    "script, changes",
    [
        (ppo_gtrxl_di, {}),
        (ppo_gtrxl_di, {"target_kl": 1e-4}),
        (ppo_gtrxl_di, {"num_minibatches": 3}),
        (ppo_gtrxl_rocket, {"target_kl": 1e-4, "num_minibatches": 3}),
    ],
)
def test_the_same_learning(script, changes, captured):
    """With a KL limit that ends updates, and minibatches of two sizes: the same weights and losses."""
    changes = {"num_minibatches": 2, "log_std": "0:-1 1:-3", **changes}
    weights, losses = learn(script, captured, **changes)
    expected, expected_losses = learn(script, **changes)
    for name, weight in expected.items():
        torch.testing.assert_close(weights[name], weight, rtol=0, atol=1e-9, msg=name)
    for found, wanted in zip(losses, expected_losses, strict=True):
        assert found == pytest.approx(wanted, rel=1e-6, abs=1e-9)


def test_nan_takes_no_step(captured):
    """A loss that is not finite ends the training before the optimiser moves a weight."""
    script = ppo_gtrxl_di
    args, agent, envs = new_agent(script, num_minibatches=1, reward_scale=float("inf"))
    average, optimizer = learner_of(agent)
    gradient = captured(agent, average, optimizer, script.ppo_gradient)
    before = {name: weight.clone() for name, weight in agent.state_dict().items()}
    with pytest.raises(FloatingPointError, match="in epoch 1, minibatch 1"):
        script.train(args, agent, average, optimizer, envs, Counter(), gradient)
    for name, weight in agent.state_dict().items():
        torch.testing.assert_close(weight, before[name], rtol=0, atol=0)
