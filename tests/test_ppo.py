"""PPO of the scripts: GAE, loss, update and schedules against sums, cases and averages written out by hand.

The scripts' shared sections are the same to the letter (test_scripts.py), so one script stands for all.
"""

import copy
import math

import gymnasium as gym
import numpy as np
import pytest
import torch
from scipy.stats import norm
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

import ppo_gtrxl_di as script

torch.set_num_threads(1)
TINY = {"embed_dim": 8, "num_heads": 2, "mlp_dim": 8, "hidden_dim": 8, "num_blocks": 1, "memory_length": 4}
TINY |= {"log_std": -0.5}


def make_args(**changes):
    return script.Args(**{**TINY, "num_minibatches": 2, "update_epochs": 3, **changes})


def make_agent(args, envs, dtype=torch.float64):
    torch.manual_seed(0)
    return script.Agent(args, envs).to(dtype)


class RecordingAdam(torch.optim.Adam):
    """Adam that keeps a copy of the weights after each step."""

    def __init__(self, agent, lr=1e-3):
        super().__init__(agent.parameters(), lr=lr, eps=1e-5)
        self.agent, self.weights = agent, []

    def step(self):
        super().step()
        self.weights.append(copy.deepcopy(self.agent.state_dict()))


class Learner:
    """What `update` needs, for episodes of the given lengths: agent, average, optimiser and a batch."""

    def __init__(self, envs, **changes):
        self.args, self.envs = make_args(**changes), envs
        self.agent = make_agent(self.args, envs)
        self.average = AveragedModel(self.agent, multi_avg_fn=get_ema_multi_avg_fn(0.9))
        self.optimizer = RecordingAdam(self.agent)
        self.collect()

    def collect(self):
        self.batch, self.finals = script.rollout(self.agent, self.envs, 1.0, 0.1)

    def update(self):
        modules = self.agent, self.average, self.optimizer
        return script.update(*modules, self.batch, self.args)


@pytest.fixture
def learner(uneven_envs):
    return lambda lengths=(6, 2, 5, 1, 6, 3, 4), **changes: Learner(uneven_envs(lengths), **changes)


@pytest.fixture
def minibatches(monkeypatch):
    """The episodes of every minibatch, in the order in which `update` asks for their loss."""
    seen, loss = [], script.ppo_loss

    def spy(agent, batch, mb, args):
        seen.append(mb.tolist())
        return loss(agent, batch, mb, args)

    monkeypatch.setattr(script, "ppo_loss", spy)
    return seen


# --- GAE and schedules ------------------------------------------------------------------------------------------------


def direct_gae(rewards, values, lengths, gamma, lam):
    """A_t = sum_l (gamma lambda)^l delta_{t+l}, delta_t = r_t + gamma V_{t+1} - V_t, V = 0 at the end; (T, N)."""
    advantages = np.zeros_like(rewards)
    for n, end in enumerate(lengths):
        V = np.append(values[:end, n], 0.0)
        for t in range(end):
            deltas = [rewards[k, n] + gamma * V[k + 1] - V[k] for k in range(t, end)]
            advantages[t, n] = sum((gamma * lam) ** k * delta for k, delta in enumerate(deltas))
    return advantages


@pytest.mark.parametrize("gamma, lam", [(0.99, 0.95), (1.0, 1.0), (0.9, 0.0)])
def test_gae_is_the_direct_sum(gamma, lam):
    """Also where an episode ended: what lies beyond (here of the order 1e3) counts for nothing."""
    rng, lengths = np.random.default_rng(0), [12, 7, 1]
    rewards, values = rng.normal(size=(2, 12, 3))
    alive = np.arange(12)[:, None] < lengths
    rewards[~alive], values[~alive] = 1e3, -2e3
    advantages, returns = script.gae(*(torch.tensor(x) for x in (rewards, values, alive.astype(float))), gamma, lam)
    expected = direct_gae(rewards, values, lengths, gamma, lam)
    np.testing.assert_allclose(advantages.numpy()[alive], expected[alive], atol=1e-12)
    np.testing.assert_allclose(returns.numpy()[alive], (expected + values)[alive], atol=1e-12)
    if gamma == lam == 1:  # then the returns are plain sums of rewards
        np.testing.assert_allclose(returns[0], [rewards[:end, n].sum() for n, end in enumerate(lengths)], atol=1e-12)


def test_linear_schedule():
    assert script.linear_schedule(3e-4, 3e-5, 1, 1000) == 3e-4
    assert script.linear_schedule(3e-4, 3e-5, 1000, 1000) == pytest.approx(3e-5, rel=1e-12)
    assert script.linear_schedule(1.0, 0.0, 6, 11) == pytest.approx(0.5)
    assert script.linear_schedule(2.0, 1.0, 1, 1) == 2.0


@pytest.mark.parametrize("iteration, scale", [(1, 12.0), (31, 12**0.5), (61, 1.0), (81, 1.0), (101, 1.0)])
def test_radius_curriculum(iteration, scale):
    """From K to 1 over 60 % of the updates, geometrically: half-way in 12^(1/2)."""
    envs = gym.make_vec("DoubleIntegratorWaypoints-v0", num_envs=1)
    script.set_curriculum(envs, script.Args(), script.linear_schedule(0.0, 1.0, iteration, 101))
    assert envs.radius_scale == pytest.approx(scale)


def schedules(iteration, **changes):
    """`begin_update` of update `iteration` of 11: what it returns, the learning rate and log-std that it set."""
    args = make_args(learning_rate=1e-3, learning_rate_final=1e-4, ent_coef=0.5, ent_coef_final=0.1, **changes)
    envs = gym.make_vec(args.env_id, num_envs=1)
    agent = make_agent(args, envs)
    optimizer = RecordingAdam(agent, lr=7.0)
    now = script.begin_update(args, agent, optimizer, envs, (iteration, 11))
    rate, log_std = optimizer.param_groups[0]["lr"], agent.actor_logstd.item()
    return now.ent_coef, now.target_kl, now.gae_lambda, rate, log_std


def test_schedules_half_way():
    """Update 6 of 11 is half-way; the log-std is linear, so the standard deviation falls geometrically."""
    assert schedules(6) == pytest.approx((0.3, None, 0.95, 5.5e-4, -0.5))
    ends = {"target_kl": 0.03, "target_kl_final": 0.01, "gae_lambda": 0.9, "gae_lambda_final": 1.0}
    assert schedules(6, noise="schedule", log_std_final=-3.5, **ends) == pytest.approx((0.3, 0.02, 0.95, 5.5e-4, -2.0))
    assert schedules(11, **ends) == pytest.approx((0.1, 0.01, 1.0, 1e-4, -0.5))
    assert schedules(6, noise="gated", lr_schedule="kl", target_kl=0.03) == pytest.approx((0.3, 0.03, 0.95, 7.0, -0.5))


@pytest.mark.parametrize("kl, rate", [(0.005, 6e-4), (0.012, 5e-4), (0.03, 5e-4 / 1.3), (0.0, 6e-4)])
def test_learning_rate_follows_the_kl(uneven_envs, kl, rate):
    """Towards half of the limit 0.02: unchanged within a factor of 1.5 of it, and never beyond its two ends."""
    args = make_args(lr_schedule="kl", learning_rate=1e-3, learning_rate_final=1e-5, target_kl=0.02)
    optimizer = RecordingAdam(make_agent(args, uneven_envs([1])), lr=5e-4)
    script.end_update(args, None, optimizer, {}, kl)
    assert optimizer.param_groups[0]["lr"] == pytest.approx(rate)
    for _ in range(50):
        script.end_update(args, None, optimizer, {}, kl)
    assert optimizer.param_groups[0]["lr"] == pytest.approx(1e-3 if rate > 5e-4 else 1e-5 if rate < 5e-4 else 5e-4)


@pytest.mark.parametrize("hits, factor", [(17, 0.9), (16, 1.0), (10, 1.0), (9, 1 / 0.9)])
def test_gated_noise_follows_success(uneven_envs, hits, factor):
    """17 of 20 episodes are 85 %, 10 are half; it stays between --log-std-final and --log-std."""
    args = make_args(noise="gated", noise_decay=0.9, log_std=0.0, log_std_final=-1.0)
    agent = make_agent(args, uneven_envs([1]))
    agent.actor_logstd.data.fill_(-0.5)
    optimizer, episodes = RecordingAdam(agent), {"hit": np.arange(20)[:, None] < hits}
    script.end_update(args, agent, optimizer, episodes, 0.0)
    assert agent.actor_logstd.item() == pytest.approx(-0.5 + math.log(factor))
    for _ in range(20):
        script.end_update(args, agent, optimizer, episodes, 0.0)
    assert agent.actor_logstd.item() == pytest.approx({17: -1.0, 9: 0.0}.get(hits, -0.5))


@pytest.mark.parametrize("noise", ["learned", "schedule", "gated"])
def test_only_learned_noise_is_learned(learner, noise):
    run = learner(noise=noise)
    before = run.agent.actor_logstd.clone()
    run.update()
    assert torch.equal(run.agent.actor_logstd, before) == (noise != "learned")


# --- returns normalised by time ---------------------------------------------------------------------------------------


def monte_carlo(rewards, lengths, gamma):
    """Discounted sums of the rewards to come, (T, N), NaN beyond an episode's end."""
    returns = np.full(rewards.shape, np.nan)
    for n, end in enumerate(lengths):
        for t in range(end):
            returns[t, n] = sum(gamma**k * rewards[t + k, n] for k in range(end - t))
    return returns


def test_return_norm_time(learner):
    """By hand, with episodes of different lengths: the statistics, the critic's targets, and V in the advantages."""
    run = learner(return_norm="time", gamma=0.9, gae_lambda=0.8, norm_adv=False)
    lengths, critic = run.envs.lengths, run.batch.values.numpy().copy()
    returns = monte_carlo(run.batch.rewards.numpy(), lengths, 0.9)
    mean, spread = np.nanmean(returns, axis=1, keepdims=True), np.nanstd(returns, axis=1, keepdims=True)
    std = np.sqrt(spread**2 + (0.3 * spread.mean()) ** 2 + 1e-8)
    script.prepare(run.batch, run.args)
    alive = np.isfinite(returns)
    np.testing.assert_allclose(run.batch.returns.numpy()[alive], ((returns - mean) / std)[alive], rtol=1e-9)
    expected = direct_gae(run.batch.rewards.numpy(), mean + std * critic, lengths, 0.9, 0.8)
    np.testing.assert_allclose(run.batch.advantages.numpy()[alive], expected[alive], rtol=1e-9, atol=1e-12)


def test_return_norm_linear(learner):
    """The fit by NumPy's least squares, ridge and all, over the episodes alive at a step; the rest is as with time."""
    run = learner(return_norm="linear", gamma=0.9, gae_lambda=0.8, norm_adv=False)
    lengths, critic, obs = run.envs.lengths, run.batch.values.numpy().copy(), run.batch.obs.numpy()
    returns = monte_carlo(run.batch.rewards.numpy(), lengths, 0.9)
    alive, fit = np.isfinite(returns), np.zeros(returns.shape)
    for t, living in enumerate(alive):
        x, y, k = obs[t, living], returns[t, living], obs.shape[-1]
        x = (x - x.mean(axis=0)) / (x.std(axis=0) + 1e-6)
        rows = np.vstack([x, np.sqrt(0.01 * len(y)) * np.eye(k)])
        slope = np.linalg.lstsq(rows, np.concatenate([y - y.mean(), np.zeros(k)]))[0]
        fit[t, living] = y.mean() + x @ slope
    spread = np.nanstd(returns - fit, axis=1, keepdims=True)
    std = np.sqrt(spread**2 + (0.3 * spread.mean()) ** 2 + 1e-8)
    script.prepare(run.batch, run.args)
    np.testing.assert_allclose(run.batch.returns.numpy()[alive], ((returns - fit) / std)[alive], rtol=1e-7)
    expected = direct_gae(run.batch.rewards.numpy(), fit + std * critic, lengths, 0.9, 0.8)
    np.testing.assert_allclose(run.batch.advantages.numpy()[alive], expected[alive], rtol=1e-7, atol=1e-9)


def test_linear_fit_finds_a_line():
    """float32 states of 1e6 with differences of 100, and a column without any: y is found again within a per cent."""
    rng = np.random.default_rng(0)
    x = np.stack([6e6 + 100 * rng.standard_normal((5, 64)), rng.standard_normal((5, 64)), np.ones((5, 64))], axis=-1)
    y = 3.0 + 0.02 * (x[..., 0] - 6e6) - 4 * x[..., 1]
    fit = script.linear_fit(*(torch.tensor(array, dtype=torch.float32) for array in (x, y, np.ones((5, 64)))))
    assert fit.dtype == torch.float32 and np.abs(fit.numpy() - y).max() < 0.01 * np.ptp(y)


@pytest.mark.parametrize("return_norm", ["time", "linear"])
def test_return_norm_of_steps_that_no_episode_reached(uneven_envs, return_norm):
    run = Learner(uneven_envs([3, 2], spare_steps=2), return_norm=return_norm)
    losses = run.update()
    assert np.isfinite(list(losses.values())).all() and run.batch.returns.isfinite().all()


# --- policy -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("logstd, used", [(-0.5, -0.5), (7.0, 0.5), (-9.0, -5.0)])
def test_policy_is_a_gaussian_in_the_actions_unit(uneven_envs, logstd, used):
    """SciPy's densities, and the entropy log(sigma sqrt(2 pi e)) a component; the log-std is clamped to [-5, 0.5]."""
    agent = make_agent(make_args(), uneven_envs([1], u_max=(4.0, 0.5)))
    torch.nn.init.constant_(agent.actor_logstd, logstd)
    hidden = torch.randn(2000, 8, dtype=torch.float64)
    action = agent.get_policy(hidden).sample()
    logprob, entropy, _ = agent.evaluate_actions(hidden, action)
    mean, action, sigma = agent.get_mean_action(hidden).detach().numpy(), action.detach().numpy(), math.exp(used)
    np.testing.assert_allclose(mean, (agent.actor(hidden) * torch.tensor([4.0, 0.5])).detach().numpy())
    np.testing.assert_allclose(logprob.detach(), norm.logpdf(action, mean, sigma).sum(-1), atol=1e-9)
    np.testing.assert_allclose(entropy.detach(), 2 * (used + 0.5 * math.log(2 * math.pi * math.e)), atol=1e-12)
    np.testing.assert_allclose((action - mean).std(axis=0), sigma, rtol=0.05)


# --- loss -------------------------------------------------------------------------------------------------------------


class PrescribedAgent:
    """An agent whose new log-probability, entropy and value are given; `encode` hands the observations through."""

    def encode(self, obs, memory):
        return obs

    def evaluate_actions(self, hidden, actions):
        return hidden.unbind(-1)


def hand_made_batch():
    """Three steps of two episodes, the second of which has died after two: (ratio, advantage, V, return, entropy)."""
    steps = [
        [(1.5, 1.0, 2.0, 1.0, 0.3), (0.5, -1.0, 0.0, 4.0, 0.5)],  # clipped above; clipped below
        [(0.5, 1.0, 1.0, 1.0, 0.3), (1.5, -1.0, 3.0, 1.0, 0.5)],  # not clipped, both: the pessimistic bound
        [(1.1, 2.0, 0.0, -1.0, 0.4), (9.0, 50.0, 70.0, -9.0, 80.0)],  # inside; dead
    ]
    ratio, advantages, values, returns, entropy = torch.tensor(steps, dtype=torch.float64).unbind(-1)
    old = torch.tensor([[-1.0, -2.0], [0.5, -0.3], [0.1, 0.0]], dtype=torch.float64)
    obs = torch.stack([old + ratio.log(), entropy, values], dim=-1)
    alive = torch.tensor([[1.0, 1], [1, 1], [1, 0]], dtype=torch.float64)
    memory, none = torch.zeros(1, 2, 0, 1), torch.zeros(3, 2, dtype=torch.float64)
    return script.Batch(obs, none[..., None], old, none, none, alive, memory, advantages, returns)


def test_loss_is_the_hand_computed_one():
    args = make_args(clip_coef=0.2, vf_coef=0.25, ent_coef=0.01)
    loss, losses = script.ppo_loss(PrescribedAgent(), hand_made_batch(), torch.tensor([0, 1]), args)
    # L_CLIP, min(r A, clip(r) A) of the five living steps: 1.2, -0.8, 0.5, -1.5, 2.2
    assert losses["policy_loss"].item() == pytest.approx(-(1.2 - 0.8 + 0.5 - 1.5 + 2.2) / 5)
    # half the squared errors 1, 16, 0, 4, 1
    assert losses["value_loss"].item() == pytest.approx(22 / 2 / 5)
    assert losses["entropy"].item() == pytest.approx((0.3 + 0.5 + 0.3 + 0.5 + 0.4) / 5)
    assert loss.item() == losses["total_loss"].item() == pytest.approx(-0.32 + 0.25 * 2.2 - 0.01 * 0.4)
    assert losses["clipfrac"].item() == pytest.approx(4 / 5)
    logs = [math.log(ratio) for ratio in (1.5, 0.5, 0.5, 1.5, 1.1)]
    assert losses["old_approx_kl"].item() == pytest.approx(-sum(logs) / 5)
    assert losses["approx_kl"].item() == pytest.approx((1.5 + 0.5 + 0.5 + 1.5 + 1.1 - 5 - sum(logs)) / 5)


def test_loss_of_a_minibatch_reads_only_its_episodes():
    args = make_args(clip_coef=0.2, vf_coef=0.25, ent_coef=0.01)
    _, losses = script.ppo_loss(PrescribedAgent(), hand_made_batch(), torch.tensor([1]), args)
    assert losses["policy_loss"].item() == pytest.approx(-(-0.8 - 1.5) / 2)
    assert losses["value_loss"].item() == pytest.approx((16 + 4) / 2 / 2)


def test_dead_steps_do_not_touch_the_gradient(learner):
    """Change all that was stored after an episode's end: loss and gradient stay."""
    gradients = []
    for garbage in (0.0, 3.0):
        run = learner([6, 2, 5])
        dead = run.batch.alive == 0
        for name in ("obs", "actions", "logprobs", "rewards", "values"):
            getattr(run.batch, name)[dead] += garbage
        gae = script.gae(run.batch.rewards, run.batch.values, run.batch.alive, 0.99, 0.95)
        run.batch.advantages, run.batch.returns = gae
        loss, _ = script.ppo_loss(run.agent, run.batch, torch.arange(3), run.args)
        loss.backward()
        gradients.append([loss.detach(), *(p.grad for p in run.agent.parameters() if p.grad is not None)])
    torch.testing.assert_close(*gradients, rtol=0, atol=1e-12)
    assert max(gradient.abs().max() for gradient in gradients[0][1:]) > 1e-3


# --- update -----------------------------------------------------------------------------------------------------------


def test_minibatches_cover_each_episode_once_an_epoch(learner, minibatches):
    learner(num_minibatches=3, update_epochs=4).update()
    assert [len(mb) for mb in minibatches] == [3, 2, 2] * 4
    epochs = [sum(minibatches[k : k + 3], []) for k in range(0, 12, 3)]
    assert all(sorted(epoch) == list(range(7)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 1  # shuffled anew


@pytest.mark.parametrize("norm_adv", [True, False])
def test_advantages_are_normalised_over_living_steps(learner, norm_adv):
    run = learner(norm_adv=norm_adv)
    rewards, values = run.batch.rewards.numpy(), run.batch.values.numpy()
    expected = direct_gae(rewards, values, run.envs.lengths, 0.99, 0.95)
    alive = np.arange(6)[:, None] < run.envs.lengths
    run.update()
    np.testing.assert_allclose(run.batch.returns.numpy()[alive], (expected + values)[alive], atol=1e-9)
    living = expected[alive]
    living = (living - living.mean()) / living.std() if norm_adv else living
    np.testing.assert_allclose(run.batch.advantages.numpy()[alive], living, rtol=1e-6, atol=1e-9)


def test_update_returns_means_over_all_minibatches(learner, monkeypatch):
    """STYLE: losses are means over the update, not the last minibatch; the explained variance is of the old values."""
    logged, loss = [], script.ppo_loss
    monkeypatch.setattr(script, "ppo_loss", lambda *inputs: [result := loss(*inputs), logged.append(result[1])][0])
    run = learner()
    alive, values = run.batch.alive.numpy() > 0, run.batch.values.numpy()
    returned = run.update()
    assert len(logged) == 6
    for name in ("policy_loss", "value_loss", "entropy", "total_loss", "approx_kl", "old_approx_kl", "clipfrac"):
        assert returned[name] == pytest.approx(np.mean([losses[name].item() for losses in logged])), name
    returns = run.batch.returns.numpy()[alive]
    expected = 1 - np.var(returns - values[alive]) / np.var(returns)
    assert returned["explained_variance"] == pytest.approx(expected)


def test_first_minibatch_has_ratio_one(learner):
    """Nothing has moved yet: rollout's log-probabilities are training's, KL 0 and nothing clipped."""
    losses = learner(num_minibatches=1, update_epochs=1).update()
    assert abs(losses["approx_kl"]) < 1e-12 and losses["clipfrac"] == 0


def test_average_is_the_exponential_one(learner):
    """w_1, then D average + (1 - D) w_k after every optimiser step, recomputed from the recorded weights."""
    run = learner()
    run.update()
    assert len(run.optimizer.weights) == 6
    for name, tensor in run.average.module.state_dict().items():
        average = run.optimizer.weights[0][name]
        for weights in run.optimizer.weights[1:]:
            average = 0.9 * average + (1 - 0.9) * weights[name]
        torch.testing.assert_close(tensor, average, rtol=1e-12, atol=1e-12)
    assert (run.average.module.actor[0].weight != run.agent.actor[0].weight).any()


def test_gradient_norm_is_limited(learner, monkeypatch):
    norms, step = [], torch.optim.Adam.step

    def spy(optimizer):
        gradients = [p.grad.flatten() for p in optimizer.param_groups[0]["params"]]
        norms.append(torch.cat(gradients).norm().item())
        return step(optimizer)

    monkeypatch.setattr(torch.optim.Adam, "step", spy)
    learner(max_grad_norm=1e-3).update()
    assert len(norms) == 6 and max(norms) == pytest.approx(1e-3, rel=1e-3)


@pytest.mark.parametrize("target_kl, steps", [(None, 10), (1e9, 10), (1e-9, 1)])
def test_target_kl_ends_the_update_at_once(learner, target_kl, steps):
    """The first minibatch has KL 0; the one whose KL is beyond the limit takes no step, whatever epoch it is in."""
    run = learner(target_kl=target_kl, update_epochs=5)
    run.update()
    assert len(run.optimizer.weights) == steps


def test_nan_reward_stops_before_the_weights_move(learner):
    run = learner()
    run.batch.rewards[2, 0] = torch.nan
    before = copy.deepcopy(run.agent.state_dict())
    with pytest.raises(FloatingPointError, match="policy_loss is nan in epoch 1, minibatch 1"):
        run.update()
    torch.testing.assert_close(run.agent.state_dict(), before, rtol=0, atol=0)


def test_nan_loss_names_term_epoch_and_minibatch(learner, monkeypatch):
    """The critic breaks before the fourth minibatch (epoch 2, minibatch 2 of 2): three steps were taken, no fourth."""
    run, loss = learner(), script.ppo_loss

    def breaks(agent, *inputs):
        if len(run.optimizer.weights) == 3:
            monkeypatch.setattr(agent.critic[2], "forward", lambda x: x[..., :1] * torch.nan)
        return loss(agent, *inputs)

    monkeypatch.setattr(script, "ppo_loss", breaks)
    with pytest.raises(FloatingPointError, match="value_loss is nan in epoch 2, minibatch 2"):
        run.update()
    assert len(run.optimizer.weights) == 3
    torch.testing.assert_close(run.agent.state_dict(), run.optimizer.weights[-1], rtol=0, atol=0)


def test_infinite_gradient_of_a_finite_loss_does_not_reach_the_weights(learner):
    """sqrt(0) is finite, its gradient is not: clipping such a gradient would make every weight NaN."""
    run = learner()
    run.agent.critic.append(torch.nn.Identity()).register_forward_hook(lambda _, x, y: y + (0 * y).sqrt())
    before = copy.deepcopy(run.agent.state_dict())
    with pytest.raises(FloatingPointError):
        run.update()
    torch.testing.assert_close(run.agent.state_dict(), before, rtol=0, atol=0)


# --- rollout and learning ---------------------------------------------------------------------------------------------


def test_rewards_are_scaled_in_training_and_logged_unscaled():
    args = make_args()
    envs = gym.make_vec(args.env_id, num_envs=3)
    envs.reset(seed=1)
    batch, episodes = script.rollout(make_agent(args, envs), envs, 0.1, 0.1)
    assert batch.rewards.shape == (50, 3) and batch.alive.all()
    np.testing.assert_allclose(batch.rewards.sum(0) / 0.1, episodes["episodic_return"], rtol=1e-9)
    x, v, u = batch.obs[..., 0], batch.obs[..., 1], batch.actions[..., 0].clip(-4, 4)
    np.testing.assert_allclose(batch.rewards[:-1], -0.1 * (x**2 + v**2 + 0.1 * u**2)[:-1], rtol=1e-9)  # the paper's


def test_one_step_bandit(uneven_envs):
    """Reward -(a - 1)^2: one update makes a = 1 likelier, twenty move the mean to it."""
    envs = uneven_envs([1] * 64, reward=lambda action: -((action[:, 0] - 1) ** 2))
    run = Learner(envs, num_minibatches=2, update_epochs=4)
    run.optimizer = RecordingAdam(run.agent, lr=1e-2)

    def best_action():
        hidden = run.agent.encode(run.batch.obs.transpose(0, 1), run.batch.memory)
        logprob = run.agent.evaluate_actions(hidden, torch.ones(64, 1, 1, dtype=torch.float64))[0]
        return logprob.mean().item(), run.agent.get_mean_action(hidden).mean().item()

    first_logprob, first_mean = best_action()
    run.update()
    assert best_action()[0] > first_logprob
    assert abs(first_mean) < 0.2
    for _ in range(20):
        run.collect()
        run.update()
    assert best_action()[1] == pytest.approx(1.0, abs=0.15)
