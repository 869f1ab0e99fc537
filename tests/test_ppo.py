"""PPO of the scripts: GAE, groups, loss, update, schedules against sums, cases and averages written out by hand.

The scripts' shared sections are the same (test_scripts.py), so one script stands for all.
"""

import copy
import importlib
import math
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import update
from scipy.stats import norm
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

import ppo_gtrxl_di as script
from common.schedule import Schedule

torch.set_num_threads(1)
TINY = {"embed_dim": 8, "num_heads": 2, "mlp_dim": 8, "hidden_dim": 8, "num_blocks": 1, "memory_length": 4}
TINY |= {"log_std": -0.5}


def make_args(**changes):
    defaults = {**TINY, "num_minibatches": 2, "update_epochs": 3, "learning_rate": 1e-3}
    return script.Args(**{**defaults, **changes})


def make_agent(args, envs, dtype=torch.float64):
    torch.manual_seed(0)
    return script.Agent(args, envs).to(dtype)


class RecordingAdam(torch.optim.Adam):
    """Adam that keeps a copy of the weights after each step."""

    def __init__(self, agent):
        super().__init__(agent.parameters(), lr=1e-3, eps=1e-5)
        self.agent, self.weights = agent, []

    def step(self):
        super().step()
        self.weights.append(copy.deepcopy(self.agent.state_dict()))


class Learner:
    """What one update needs, for episodes of the given lengths: agent, average, optimiser and a batch."""

    def __init__(self, envs, **changes):
        self.args, self.envs = make_args(**changes), envs
        envs.flights_per_start = round(self.args.flights_per_start.at(0.0))
        self.agent = make_agent(self.args, envs)
        self.average = AveragedModel(self.agent, multi_avg_fn=get_ema_multi_avg_fn(0.9))
        self.optimizer = RecordingAdam(self.agent)
        self.collect()

    def collect(self):
        self.batch, _ = script.rollout(self.agent, self.envs, {}, 1.0, 0.1)

    def update(self, iteration=1):
        modules = self.agent, self.average, self.optimizer
        return update(script, self.args, modules, self.envs, self.batch, iteration)


@pytest.fixture
def learner(uneven_envs):
    return lambda lengths=(6, 2, 5, 1, 6, 3, 4), **changes: Learner(uneven_envs(lengths), **changes)


@pytest.fixture
def asked(monkeypatch):
    """What `train` asks `ppo_loss` for, in this order: the episodes and the three coefficients of every minibatch."""
    seen, loss = [], script.ppo_loss

    def spy(agent, batch, mb, clip_coef, vf_coef, ent_coef):
        seen.append((mb.tolist(), clip_coef, vf_coef, ent_coef))
        return loss(agent, batch, mb, clip_coef, vf_coef, ent_coef)

    monkeypatch.setattr(script, "ppo_loss", spy)
    return seen


# --- schedules -------------------------------------------------------------------------------------------------


def direct_gae(rewards, values, lengths, gamma, lam):
    """A_t = sum_l (gamma lambda)^l delta_{t+l}, delta_t = r_t + gamma V_{t+1} - V_t, V = 0 at the end; (T, N)."""
    advantages = np.zeros_like(rewards)
    for n, end in enumerate(lengths):
        V = np.append(values[:end, n], 0.0)
        for t in range(end):
            deltas = [rewards[k, n] + gamma * V[k + 1] - V[k] for k in range(t, end)]
            advantages[t, n] = sum((gamma * lam) ** k * delta for k, delta in enumerate(deltas))
    return advantages


def test_schedule_is_linear_between_its_points():
    """Of two points at one place the second counts from there on; before the first and after the last: constant."""
    schedule = Schedule("0.1:1 0.4:-2 0.4:8 0.9:3")
    expected = {0.0: 1, 0.1: 1, 0.2: 0, 0.3: -1, 0.399: -1.99, 0.4: 8, 0.65: 5.5, 0.9: 3, 1.0: 3}
    for progress, value in expected.items():
        assert schedule.at(progress) == pytest.approx(value), progress
    updates = 21
    found = schedule.over(updates)
    np.testing.assert_array_equal(found, [schedule.at(k / (updates - 1)) for k in range(updates)])
    assert Schedule("0:3e-4 1:3e-5").at(0.0) == 3e-4 and Schedule("0:3e-4 1:3e-5").at(1.0) == 3e-5
    assert Schedule(0.7).at(0.3) == 0.7


@pytest.mark.parametrize("plain", [1, 0.95, -1.4, 3e-4, "0:3e-4 1:3e-5", "0:-1"])
def test_a_file_holds_a_schedule_as_number_or_words(plain):
    """Read again it is the same schedule. One point is not a number: it is set where a number is learned."""
    schedule = Schedule(plain)
    assert schedule.plain == plain and type(schedule.plain) is type(plain)
    assert Schedule(schedule.plain) == Schedule(str(schedule)) == Schedule(schedule) == schedule
    assert schedule.has_points == (":" in str(plain))
    assert Schedule("0:-1") != Schedule(-1) and Schedule(1) == Schedule(1.0)


@pytest.mark.parametrize("words", ["", "x", "0:1 x", "0.5:1 0:2", "0:1 2:3", "-0.1:1", "nan:1", "0:1:2", "1 2"])
def test_words_that_are_no_schedule(words):
    with pytest.raises(
        ValueError, match=f"^{words or 'nothing'}: must be a number, or points as 0:-1 0.4:-2 1:-6 whose places ris"
    ):
        Schedule(words)


def test_a_lowered_group_keeps_its_places():
    assert str(Schedule("0:1 0.4:1 0.4:8").replaced(8, 4)) == "0:1 0.4:1 0.4:4"
    assert Schedule(32).replaced(32, 4) == Schedule(4)


@pytest.mark.parametrize("name, env_id, first", [
    ("ppo_gtrxl_di", "DoubleIntegratorWaypoints-v0", 12.0),
    ("ppo_gtrxl_vdp", "VanDerPolWaypoints-v0", 6.0),
])  # fmt: skip
def test_radius_curriculum(name, env_id, first):
    """From about K times the radius, geometrically, to the true one; from there on a tenth less, flown in groups."""
    script = importlib.import_module(name)
    args = script.Args(env_id=env_id, **script.RECIPES[env_id])
    refined = args.log_radius.places[-2]
    for progress, scale in (
        (0.0, first),
        (refined / 2, first**0.5),
        (0.999 * refined, 1.0),
        (refined, 0.9),
        (1.0, 0.9),
    ):
        training = script.curriculum(args, progress)
        assert training["radius_scale"] == pytest.approx(scale, rel=0.02)
        assert training["bonus_width"] == (0.4 if progress >= refined else 0.0)
        assert training["flights_per_start"] == (8 if progress >= refined else 1)
    paper = script.curriculum(script.Args(env_id=env_id), 0.7)
    assert paper == {"flights_per_start": 1, "radius_scale": 1, "bonus_width": 0}
    assert script.curriculum(script.Args(), 0.7) == {"flights_per_start": 1}  # no circles


@pytest.mark.parametrize("std, dispersion, scale", [
    (1.0, 0, 0.005), (0.016, 0, 0.002), (0.0016, 0, 0.0002), (0.016, 1, 0.002), (0.0016, 1, 0.001),
])  # fmt: skip
def test_the_rockets_curriculum(std, dispersion, scale):
    """R_terminal's scale is an eighth of the noise, within its bounds; guidance and groups are those of the flags."""
    rocket = importlib.import_module("ppo_gtrxl_rocket")
    log_std = f"0:0.2 0.5:{math.log(std)} 1:-7"
    args = rocket.Args(guidance=True, flights_per_start=16, dispersion=dispersion, log_std=log_std)
    training = rocket.curriculum(args, 0.5)
    assert training == {"flights_per_start": 16, "guidance": True, "terminal_scale": pytest.approx(scale)}
    paper = rocket.curriculum(rocket.Args(), 0.5)
    assert paper == {"flights_per_start": 1, "guidance": False, "terminal_scale": 0.005}


@pytest.mark.parametrize("asked", ["random", "ignition"])
def test_every_second_update_of_random_failures_flies_those_at_the_last_ignition(asked):
    """As the flights tell it: the last group of engines, at one moment."""
    rocket = importlib.import_module("ppo_gtrxl_rocket")
    options = {"failure": 0.25, "failure_time": asked}
    envs = gym.make_vec("RocketAscentCutoff-v0", num_envs=40, **options)
    args = rocket.Args(**options, total_updates=300)
    for before in (*range(6), 298, 299):
        envs.reset(seed=before, options={"training": rocket.curriculum(args, before / 299)})
        groups, moments, _ = envs.unwrapped.vehicles.failure[:, envs.unwrapped.vehicles.failure[0] >= 0]
        at_ignition = set(groups) == {3} and np.ptp(moments) == 0
        assert at_ignition == (asked == "ignition" or before % 2 == 1)


@pytest.fixture
def schedules(learner, asked, monkeypatch):
    """The entropy's coefficient, lambda and the learning rate that update `iteration` of 11 uses."""
    lambdas, gae = [], script.gae
    monkeypatch.setattr(script, "gae", lambda *inputs: [lambdas.append(inputs[-1]), gae(*inputs)][1])
    ends = {"learning_rate": "0:2e-3 1:1e-3", "ent_coef": "0:0.5 1:0.1"}

    def of_update(iteration, **changes):
        run = learner(**{**ends, **changes}, total_updates=11)
        rates, step = [], run.optimizer.step
        run.optimizer.step = lambda: [rates.append(run.optimizer.param_groups[0]["lr"]), step()]
        asked.clear(), lambdas.clear()
        run.update(iteration)
        assert len({minibatch[1:] for minibatch in asked}) == len(set(lambdas)) == len(set(rates)) == 1
        assert asked[0][1:3] == (run.args.clip_coef, run.args.vf_coef)
        return asked[0][3], lambdas[0], rates[0]

    return of_update


def test_schedules_half_way(schedules):
    """Update 6 of 11 is half-way, 11 the end."""
    lambdas = "0:0.9 1:1"
    assert schedules(1, gae_lambda=lambdas) == pytest.approx((0.5, 0.9, 2e-3))
    assert schedules(6, gae_lambda=lambdas) == pytest.approx((0.3, 0.95, 1.5e-3))
    assert schedules(11, gae_lambda=lambdas) == pytest.approx((0.1, 1.0, 1e-3))
    assert schedules(6, gae_lambda=0.7)[1] == 0.7


def test_memory_noise_half_way(learner, monkeypatch):
    """What `rollout` is asked for in the first, the middle and the last of 11 updates."""

    class Asked(Exception):
        pass

    def rollout(agent, envs, training, reward_scale, memory_noise):
        raise Asked(memory_noise)

    def of_update(iteration, **changes):
        run, start = learner(total_updates=11, **changes), SimpleNamespace(updates_done=iteration - 1)
        with monkeypatch.context() as patch, pytest.raises(Asked) as asked:
            patch.setattr(script, "rollout", rollout)
            script.train(run.args, run.agent, run.average, run.optimizer, run.envs, start)
        return asked.value.args[0]

    assert [of_update(iteration, memory_noise="0:0.2 1:0") for iteration in (1, 6, 11)] == pytest.approx([0.2, 0.1, 0])
    assert of_update(6, memory_noise=0.2) == 0.2


@pytest.mark.parametrize("log_std", [0.0, -1.5, -8.0])
def test_learning_rate_follows_the_noise(schedules, log_std):
    """What a step does to the log-probabilities goes with its size over the standard deviation."""
    rate = schedules(6, lr_times_std=True, log_std=f"0:{log_std}", learning_rate=2e-3)[2]
    assert rate == pytest.approx(2e-3 * math.exp(log_std))


# --- who sets the noise -----------------------------------------------------------------------------------------------


def log_stds(run, updates):
    """The log-std after each of so many updates."""
    seen = []
    for iteration in range(1, updates + 1):
        run.update(iteration)
        seen.append(run.agent.actor_logstd.item())
    return seen


def test_points_set_the_noise_of_their_update(learner):
    """From the first point in update 1 to the last in the last one, wherever a checkpoint's noise was."""
    run = learner(log_std="0:-0.5 0.5:-1 0.5:-3 1:-5", total_updates=11)
    run.agent.actor_logstd.data.fill_(-7.0)
    assert log_stds(run, 11) == pytest.approx([*np.linspace(-0.5, -1, 6)[:5], *np.linspace(-3, -5, 6)])


def test_learned_noise_stays_where_it_can_be_learned(learner):
    """An entropy bonus pushes it up; beyond its bounds it would have no gradient, and never come back."""
    run = learner(log_std=0.5, ent_coef=1.0)
    assert min(log_stds(run, 3)) > 0.5
    run.collect()
    script.set_log_std(run.agent, run.args, 0.5)
    assert run.agent.actor_logstd.item() == 0.5


# --- groups of flights that began alike -------------------------------------------------------------------------------


def monte_carlo(rewards, lengths, gamma):
    """Discounted sums of the rewards to come, (T, N), NaN beyond an episode's end."""
    returns = np.full(rewards.shape, np.nan)
    for n, end in enumerate(lengths):
        for t in range(end):
            returns[t, n] = sum(gamma**k * rewards[t + k, n] for k in range(end - t))
    return returns


def standardised(x):
    return (x - x.mean(axis=0)) / (x.std(axis=0) + 1e-6)


def direct_fit(obs, returns, group):
    """Each group's ridge fit at each step, over the episodes that live then, by NumPy's least squares; (T, N)."""
    fit = np.zeros(returns.shape)
    for t, first in np.ndindex(len(returns), returns.shape[1] // group):
        episodes = np.arange(first * group, (first + 1) * group)
        living = episodes[np.isfinite(returns[t, episodes])]
        if len(living) == 0:
            continue
        x, y, k = standardised(obs[t, living]), returns[t, living], obs.shape[-1]
        rows = np.vstack([x, np.sqrt(0.01 * len(y)) * np.eye(k)])
        slope = np.linalg.lstsq(rows, np.concatenate([y - y.mean(), np.zeros(k)]))[0]
        fit[t, living] = y.mean() + x @ slope
    return fit


@pytest.mark.parametrize("group", [2, 4, 12])
def test_groups_are_compared_within_themselves(learner, group):
    """Episodes of different lengths: baseline, spread, the critic's targets and V in the advantages, by hand."""
    lengths = (6, 2, 5, 1, 6, 3, 4, 6, 5, 5, 1, 2)
    run = learner(lengths, flights_per_start=group, gamma=0.9, gae_lambda=0.8, norm_adv=False)
    critic, obs, rewards = (getattr(run.batch, name).numpy().copy() for name in ("critic", "obs", "rewards"))
    returns = monte_carlo(rewards, lengths, 0.9)
    alive, fit = np.isfinite(returns), direct_fit(obs, returns, group)
    spread = np.nanstd(returns - fit, axis=1, keepdims=True)  # of all groups' episodes
    std = np.sqrt(spread**2 + (0.3 * spread.mean()) ** 2 + 1e-8)
    advantages = direct_gae(rewards, fit + std * critic, lengths, 0.9, 0.8)
    targets = (advantages + std * critic) / std  # the normalised A + V
    losses = run.update()
    np.testing.assert_allclose(run.batch.advantages.numpy()[alive], advantages[alive], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(run.batch.targets.numpy()[alive], targets[alive], rtol=1e-7, atol=1e-9)
    whole, left = (advantages + fit + std * critic)[alive], (advantages + std * critic)[alive]
    assert losses["baseline_explained_variance"] == pytest.approx(1 - left.var() / whole.var())
    assert losses["explained_variance"] == pytest.approx(1 - (targets - critic)[alive].var() / targets[alive].var())


def test_linear_fit_finds_a_line():
    """float32 states of 1e6 with differences of 100, and a column without any: y is found again within a per cent."""
    rng = np.random.default_rng(0)
    x = np.stack([6e6 + 100 * rng.standard_normal((5, 64)), rng.standard_normal((5, 64)), np.ones((5, 64))], axis=-1)
    y = 3.0 + 0.02 * (x[..., 0] - 6e6) - 4 * x[..., 1]
    fit = script.linear_fit(*(torch.tensor(array, dtype=torch.float32) for array in (x, y, np.ones((5, 64)))))
    assert fit.dtype == torch.float32 and np.abs(fit.numpy() - y).max() < 0.01 * np.ptp(y)


@pytest.mark.parametrize("flights, numbers", [(16, 6), (32, 7), (8, 2)])
def test_how_much_of_pure_noise_a_fit_leaves(flights, numbers):
    """A least-squares fit of k numbers and a mean to G values leaves the share 1 - (k + 1) / G of their variance."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(20_000, flights, numbers, generator=generator)
    y = torch.randn(20_000, flights, generator=generator)
    left = (y - script.linear_fit(x, y, torch.ones_like(y))).square().mean().item()
    assert left == pytest.approx(1 - (numbers + 1) / flights, rel=0.02)


@pytest.mark.parametrize("group", [1, 2])
def test_steps_that_no_episode_reached(uneven_envs, group):
    run = Learner(uneven_envs([3, 2, 1, 1], spare_steps=2), flights_per_start=group)
    losses = run.update()
    assert np.isfinite(list(losses.values())).all() and run.batch.targets.isfinite().all()


@pytest.mark.parametrize("env_id", script.ENV_IDS)
def test_flights_of_a_group_share_their_start_and_nothing_else(env_id):
    args = make_args(env_id=env_id, flights_per_start=3)
    envs = gym.make_vec(env_id, num_envs=6)
    envs.reset(seed=1)
    batch, _ = script.rollout(make_agent(args, envs), envs, script.curriculum(args, 0.0), 1.0, 0.1)
    first, second = batch.obs[0, :3], batch.obs[0, 3:]
    assert (first == first[0]).all() and (second == second[0]).all() and (first[0, :2] != second[0, :2]).all()
    for own in (batch.actions[0, :, 0], batch.logprobs[0], batch.obs[1, :, 1], batch.rewards[1]):
        assert len(own.unique()) == 6
    assert len(batch.memory[0, :, 0, 0].unique()) == 6


# --- policy -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("logstd, used", [(-0.5, -0.5), (7.0, 0.5), (-9.0, -8.0)])
def test_policy_is_a_gaussian_in_the_actions_unit(uneven_envs, logstd, used):
    """SciPy's densities, and the entropy log(sigma sqrt(2 pi e)) a component; the log-std is clamped to [-8, 0.5]."""
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
    loss, losses = script.ppo_loss(PrescribedAgent(), hand_made_batch(), torch.tensor([0, 1]), 0.2, 0.25, 0.01)
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


def test_dead_steps_do_not_touch_the_gradient(learner):
    """Change all that was stored after an episode's end, also beyond what `exp` can hold: loss and gradient stay."""
    gradients = []
    for garbage, unlikely in ((0.0, 0.0), (3.0, 0.0), (0.0, 1e9)):
        run = learner([6, 2, 5])
        dead = run.batch.alive == 0
        for name in ("obs", "actions", "logprobs", "rewards", "critic"):
            getattr(run.batch, name)[dead] += garbage
        run.batch.logprobs[dead] -= unlikely
        gae = script.gae(run.batch.rewards, run.batch.critic, run.batch.alive, 0.99, 0.95)
        run.batch.advantages, run.batch.targets = gae
        loss, _ = script.ppo_loss(run.agent, run.batch, torch.arange(3), 0.2, 0.2, 1e-3)
        loss.backward()
        gradients.append([loss.detach(), *(p.grad for p in run.agent.parameters() if p.grad is not None)])
    for changed in gradients[1:]:
        torch.testing.assert_close(changed, gradients[0], rtol=0, atol=1e-12)
    assert max(gradient.abs().max() for gradient in gradients[0][1:]) > 1e-3


# --- update -----------------------------------------------------------------------------------------------------------


def test_update_returns_means_over_all_minibatches(learner, monkeypatch):
    """STYLE: losses are means over the update, not the last minibatch; the explained variance is of the old values."""
    logged, loss = [], script.ppo_loss
    monkeypatch.setattr(script, "ppo_loss", lambda *inputs: [result := loss(*inputs), logged.append(result[1])][0])
    run = learner()
    alive, values = run.batch.alive.numpy() > 0, run.batch.critic.numpy()
    returned = run.update()
    assert len(logged) == 6
    for name in ("policy_loss", "value_loss", "entropy", "total_loss", "approx_kl", "old_approx_kl", "clipfrac"):
        assert returned[name] == pytest.approx(np.mean([losses[name].item() for losses in logged])), name
    returns = run.batch.targets.numpy()[alive]
    expected = 1 - np.var(returns - values[alive]) / np.var(returns)
    assert returned["explained_variance"] == pytest.approx(expected)


def test_a_minibatch_beyond_the_limit_ends_the_update(learner, monkeypatch):
    """Also if the next ones would be within it."""
    run, loss = learner((6, 2, 5, 1), target_kl=0.5, update_epochs=5), script.ppo_loss
    kls = iter([0.0, 0.7, *[0.0] * 8])

    def prescribed(*arguments):
        total, losses = loss(*arguments)
        return total, {**losses, "approx_kl": torch.tensor(next(kls))}

    monkeypatch.setattr(script, "ppo_loss", prescribed)
    run.update()
    assert len(run.optimizer.weights) == 1


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
