"""Dispersed flights compared with their mean, step by step: what `update_running_statistics` learns and is seen."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

import ppo_gtrxl_rocket as script
from envs import ROCKETS, local_frame, target_axes

CUTOFF = "RocketAscentCutoff-v0"
SMALL = {"embed_dim": 8, "num_heads": 2, "mlp_dim": 8, "hidden_dim": 8, "num_blocks": 1, "memory_length": 4}
SCALES = [0.03, 0.015, 0.005, 0.0015, 0.004, 0.003, 0.001]
torch.set_num_threads(1)


def compared(y, rocket):
    """What flights are compared by, of one state, in the plain units of the text: 100 km, km/s, 7.9 km/s, rad."""
    r, v = y[:3], y[3:6]
    perigee, semi_latus, normal = target_axes(rocket)
    radius, circular = np.linalg.norm(r), np.sqrt(rocket.mu / rocket.Re)
    altitude, climb = 64 * (radius / rocket.Re - 1), 8 * (r @ v) / radius / circular
    out = 64 * (r @ normal) / rocket.Re, 8 * (v @ normal) / circular
    angle = np.arctan2(r @ semi_latus, r @ perigee)
    return [altitude, climb, *out, np.linalg.norm(v) / circular, np.log(y[6] / rocket.dry_mass), angle]


@pytest.fixture(scope="module")
def flights():
    """Eight dispersed flights that climb and tilt, some of which end early: a Batch, in double precision."""
    T, N = 60, 8
    env = gym.make_vec(CUTOFF, num_envs=N, dispersion=1.0, action_frame="local")
    obs, _ = env.reset(seed=5)
    seen = np.zeros((T, N, 9))
    for t in range(T):
        seen[t] = obs
        obs, *_ = env.advance(np.tile([1.0, 0.01 * t, 0.0], (N, 1)))
    alive = np.arange(T)[:, None] < [60, 50, 50, 20, 10, 10, 10, 10]
    zeros = torch.zeros(T, N, dtype=torch.float64)
    parts = {name: zeros for name in ("actions", "logprobs", "rewards", "values", "memory")}
    return script.Batch(obs=torch.as_tensor(seen), alive=torch.as_tensor(alive).double(), **parts)


def make_agent(dispersion=1.0):
    args = script.Args(**SMALL, env_id=CUTOFF, dispersion=dispersion)
    torch.manual_seed(0)
    return script.Agent(args, gym.make_vec(CUTOFF, num_envs=1, dispersion=dispersion)).double(), args


def test_the_mean_is_of_the_flights_that_live(flights):
    """All the way at first, a tenth of it later; from step 50 on fewer than a quarter are left: not learnt."""
    agent, args = make_agent()
    rocket = ROCKETS[CUTOFF].rocket
    assert agent.mean_flight.shape == (482, 7) and not agent.mean_flight.any()
    script.update_running_statistics(agent, agent, args, flights)
    expected = np.zeros((482, 7))
    for t in range(60):
        living = [k for k in range(8) if flights.alive[t, k]]
        if len(living) >= 2:
            expected[t] = np.mean([compared(flights.obs[t, k].numpy(), rocket) for k in living], axis=0)
    assert expected[:50].any(axis=1).all() and not expected[50:].any()
    near = {"rtol": 1e-6, "atol": 1e-5}  # the constants are of single precision
    np.testing.assert_allclose(agent.mean_flight.numpy(), expected, **near)
    higher = script.Batch(**{**vars(flights), "obs": flights.obs * torch.tensor([1.001] * 3 + [1.0] * 6)})
    one = script.Batch(**{**vars(higher), "alive": flights.alive * (torch.arange(8) == 0)})
    script.update_running_statistics(agent, agent, args, one)
    np.testing.assert_allclose(agent.mean_flight.numpy(), expected, **near)  # one of eight says little
    script.update_running_statistics(agent, agent, args, higher)
    raised = [
        np.mean([compared(flights.obs[5, k].numpy() * ([1.001] * 3 + [1] * 6), rocket) for k in range(8)], axis=0)
    ]
    np.testing.assert_allclose(agent.mean_flight[5], 0.9 * expected[5] + 0.1 * raised[0], **near)


def test_without_dispersion_nothing_is_learnt(flights):
    agent, args = make_agent(0.0)
    before = {name: tensor.clone() for name, tensor in agent.state_dict().items()}
    script.update_running_statistics(agent, agent, args, flights)
    for name, tensor in agent.state_dict().items():
        assert torch.equal(tensor, before[name]), name


def test_what_is_seen_of_a_flight_beside_the_mean(flights):
    """The difference over its size, at most 10; nothing where no flight has been, and the last step's mean after it."""
    agent, args = make_agent()
    rocket, t = ROCKETS[CUTOFF].rocket, 30
    assert not script.features(agent, flights.obs)[..., -7:].any()
    script.update_running_statistics(agent, agent, args, flights)
    seen = script.features(agent, flights.obs)
    assert seen.shape == (60, 8, 36)
    mean = np.mean([compared(flights.obs[t, k].numpy(), rocket) for k in range(3)], axis=0)
    for k in range(8):
        expected = np.clip((compared(flights.obs[t, k].numpy(), rocket) - mean) / SCALES, -10, 10)
        np.testing.assert_allclose(seen[t, k, -7:], expected, atol=2e-4)
    assert seen[t, :, -7:].std() > 0.1  # dispersed flights are told apart
    far = flights.obs[t, :1].clone()
    far[..., 7] = 0.2  # a time that no flight has reached
    assert not script.features(agent, far)[..., -7:].any()
    far[..., 7] = -0.1  # later than the nominal vehicle could fly
    agent.mean_flight[-1] = torch.tensor(compared(far[0].numpy(), rocket)) - 0.5 * torch.tensor(SCALES)
    np.testing.assert_allclose(script.features(agent, far)[0, -7:], 0.5, atol=1e-3)
    agent.mean_flight[-1] -= 4.0 * torch.tensor(SCALES)  # what grows to the cut-off stays linear, and so do sums of it
    np.testing.assert_allclose(script.features(agent, far)[0, -7:], 4.5, atol=1e-3)
    agent.mean_flight[-1] -= 40.0 * torch.tensor(SCALES)  # as where one flight has dropped a stage and the mean has not
    np.testing.assert_array_equal(script.features(agent, far)[0, -7:], 10.0)


def test_a_flight_three_kilometres_higher_reads_one(flights):
    """The sizes are what their comment says they are."""
    agent, args = make_agent()
    rocket = ROCKETS[CUTOFF].rocket
    y = flights.obs[30, 0].numpy().copy()
    up, along, cross = local_frame(y[:7, None], target_axes(rocket)[2])
    agent.mean_flight[30] = torch.tensor(compared(y, rocket))
    y[:3] += 3000 * 6378145 / 6.4e6 * up[:, 0]  # 64: the unit of length is 99.66 km
    seen = script.features(agent, torch.as_tensor(y)[None])[0, -7:]
    assert seen[0] == pytest.approx(1.0, abs=1e-3)
    assert seen[5:].abs().max() < 1e-3 and seen[3] == pytest.approx(0.0, abs=1e-3)


def test_what_comes_into_sight_changes_nothing_at_first(flights):
    """The policy that a dispersed training begins with flies on as it did; the next mean leaves the weights alone."""
    agent, args = make_agent()
    obs, memory = flights.obs.transpose(0, 1), agent.new_memory(8, 0.0)
    before = agent.encode(obs, memory)
    script.update_running_statistics(agent, agent, args, flights)
    torch.testing.assert_close(agent.encode(obs, memory), before, rtol=0, atol=0)
    assert script.features(agent, flights.obs)[..., -7:].any()
    with torch.no_grad():
        agent.encoder[0].weight[:, -7:] = 0.5
    assert (agent.encode(obs, memory) != before).any()
    script.update_running_statistics(agent, agent, args, flights)
    assert (agent.encoder[0].weight[:, -7:] == 0.5).all()


def test_it_changes_nothing_at_first_in_what_evaluation_flies(flights):
    """The averaged weights, too: they take over the mean flight with the optimiser's next step."""
    agent, args = make_agent()
    average = AveragedModel(agent, multi_avg_fn=get_ema_multi_avg_fn(0.99))
    obs, memory = flights.obs.transpose(0, 1), agent.new_memory(8, 0.0)
    before = average.module.encode(obs, memory)
    average.update_parameters(agent)
    script.update_running_statistics(agent, average.module, args, flights)
    average.update_parameters(agent)
    assert script.features(average.module, flights.obs)[..., -7:].any()
    torch.testing.assert_close(average.module.encode(obs, memory), before, rtol=0, atol=1e-12)


def test_the_oracles_draw_changes_nothing_at_first(flights):
    """Nominal flights have shown it zeros: the weights on it are still random when the dispersed training begins."""
    args = script.Args(**SMALL, env_id=CUTOFF, dispersion=1.0, observe_draw=True)
    agent = script.Agent(args, gym.make_vec(CUTOFF, num_envs=1, dispersion=1.0, observe_draw=True)).double()
    draw = torch.randn(1, 8, 16, dtype=torch.float64).expand(60, 8, 16)
    seen = script.Batch(**{**vars(flights), "obs": torch.cat([flights.obs, draw], dim=-1)})
    zero = script.Batch(**{**vars(flights), "obs": torch.cat([flights.obs, 0 * draw], dim=-1)})
    encode = lambda batch: agent.encode(batch.obs.transpose(0, 1), agent.new_memory(8, 0.0))  # noqa: E731
    before = encode(zero)
    assert (encode(seen) != before).any()
    script.update_running_statistics(agent, agent, args, seen)
    torch.testing.assert_close(encode(seen), before, rtol=0, atol=0)


def test_a_nominal_training_leaves_the_draw_without_weight(flights):
    """So that the first dispersed update flies the nominal policy, not what random weights on the draw make of it."""
    args = script.Args(**SMALL, env_id=CUTOFF, observe_draw=True)
    agent = script.Agent(args, gym.make_vec(CUTOFF, num_envs=1, observe_draw=True)).double()
    seen = script.Batch(**{**vars(flights), "obs": torch.cat([flights.obs, torch.zeros(60, 8, 16)], dim=-1)})
    script.update_running_statistics(agent, agent, args, seen)
    assert not agent.encoder[0].weight[:, -23:].any() and agent.encoder[0].weight[:, -24].any()
    assert not agent.mean_flight.any()
