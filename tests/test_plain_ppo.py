"""What `train` does with Table 1's settings is PPO: on a small network, its weights are those of a plain PPO.

Plain means: one list of steps for each episode, no masks, no groups, no schedule but Table 1's. The network is the
script's own: test_gtrxl.py holds it to the paper's equations.
"""

import copy

import gymnasium as gym
import torch
from helpers import SMALL
from torch.distributions import Normal

import ppo_gtrxl_di as script

torch.set_num_threads(1)
UPDATES = 3


# Table 1's two numbers are the first update's and the last one's
LEARNING_RATE = (3e-4, 3e-5)
ENT_COEF = (1e-3, 1e-4)


def between(first, last, update):
    return first + (last - first) * update / (UPDATES - 1)


def fly(agent, envs, args):
    """One episode in each environment: the memory before them, and for each a list of (obs, action, log pi, V, r)."""
    memory = agent.new_memory(envs.num_envs, args.memory_noise.at(0.0))
    episodes = [[] for _ in range(envs.num_envs)]
    flying = set(range(envs.num_envs))
    obs, _ = envs.reset()
    history = []
    while flying:
        history.append(torch.tensor(obs))
        with torch.no_grad():
            hidden = agent.encode(torch.stack(history, dim=1), memory)[:, -1]
            policy = Normal(agent.get_mean_action(hidden), agent.actor_logstd.exp())
            action = policy.sample()
            logprob = policy.log_prob(action).sum(-1)
            value = agent.critic(hidden)[:, 0]
        obs, reward, terminated, _, _ = envs.step(action.numpy())
        for n in sorted(flying):
            episodes[n].append((history[-1][n], action[n], logprob[n], value[n], args.reward_scale * reward[n]))
            if terminated[n]:
                flying.remove(n)
    return memory, episodes


def advantages_of(episode, args):
    """Generalised advantages from an episode's end to its beginning; no value lies beyond the end."""
    advantages = []
    next_value = next_advantage = 0.0
    for _, _, _, value, reward in reversed(episode):
        delta = reward + args.gamma * next_value - value
        advantage = delta + args.gamma * args.gae_lambda.at(0.0) * next_advantage
        advantages.insert(0, advantage)
        next_value = value
        next_advantage = advantage
    return torch.stack(advantages)


def loss_of(agent, args, ent_coef, memory, episodes, advantages, returns):
    """-L_CLIP + c1 L_VF - c2 H, the mean over all steps of these episodes."""
    terms = []
    for n, episode in enumerate(episodes):
        obs, action, old_logprob, _, _ = zip(*episode)
        hidden = agent.encode(torch.stack(obs)[None], memory[:, n : n + 1])[0]
        policy = Normal(agent.get_mean_action(hidden), agent.actor_logstd.exp())
        ratio = (policy.log_prob(torch.stack(action)).sum(-1) - torch.stack(old_logprob)).exp()
        clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
        surrogate = torch.minimum(ratio * advantages[n], clipped * advantages[n])
        value_error = agent.critic(hidden)[:, 0] - returns[n]
        terms.append(-surrogate + args.vf_coef * value_error**2 / 2 - ent_coef * policy.entropy().sum(-1))
    return torch.cat(terms).mean()


def plain_ppo(agent, envs, args):
    optimizer = torch.optim.Adam(agent.parameters(), eps=1e-5)
    for update in range(UPDATES):
        optimizer.param_groups[0]["lr"] = between(*LEARNING_RATE, update)
        ent_coef = between(*ENT_COEF, update)
        memory, episodes = fly(agent, envs, args)
        advantages = [advantages_of(episode, args) for episode in episodes]
        values = [torch.stack([value for _, _, _, value, _ in episode]) for episode in episodes]
        returns = [A + V for A, V in zip(advantages, values)]
        everyone = torch.cat(advantages)
        spread = everyone.std(correction=0) + 1e-8
        advantages = [(A - everyone.mean()) / spread for A in advantages]
        for _ in range(args.update_epochs):
            for mb in torch.randperm(envs.num_envs).tensor_split(args.num_minibatches):
                loss = loss_of(
                    agent,
                    args,
                    ent_coef,
                    memory[:, mb],
                    [episodes[n] for n in mb],
                    [advantages[n] for n in mb],
                    [returns[n] for n in mb],
                )
                optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
                optimizer.step()


class Counter:
    """In place of `runs.Run`: nothing but the count of updates."""

    updates_done = 0

    def end_update(self, iteration, *what_is_logged):
        self.updates_done = iteration


def weights_of(learn, agent, seed=7):
    torch.manual_seed(seed)
    learn(agent)
    return {name: weight.detach() for name, weight in agent.named_parameters()}


def test_table_1_is_plain_ppo():
    """Three updates, in double precision: to 1e-9 of the largest change in a weight's tensor."""
    check(lambda: gym.make_vec("DoubleIntegrator-v0", num_envs=6))


def test_episodes_of_different_lengths(uneven_envs, monkeypatch):
    """An episode that has ended weighs nothing more, in the advantages, their normalisation and the loss."""
    monkeypatch.setattr(script, "curriculum", lambda *inputs: {"flights_per_start": 1})
    check(lambda: uneven_envs((6, 2, 5, 1, 6, 3, 4)))


def check(make_envs):
    args = script.Args(**{**SMALL, "num_blocks": 2, "total_updates": UPDATES})
    torch.manual_seed(0)
    first = script.Agent(args, make_envs()).double()

    def train(agent):
        average = torch.optim.swa_utils.AveragedModel(agent)
        optimizer = torch.optim.Adam(agent.parameters(), eps=1e-5)
        envs = make_envs()
        envs.reset(seed=1)
        script.train(args, agent, average, optimizer, envs, Counter())

    def train_plainly(agent):
        envs = make_envs()
        envs.reset(seed=1)
        plain_ppo(agent, envs, args)

    trained = weights_of(train, copy.deepcopy(first))
    plain = weights_of(train_plainly, copy.deepcopy(first))
    for name, weight in first.named_parameters():
        moved = (plain[name] - weight.detach()).abs().max().item()
        assert moved > 0, name
        torch.testing.assert_close(trained[name], plain[name], rtol=0, atol=1e-9 * moved, msg=name)
