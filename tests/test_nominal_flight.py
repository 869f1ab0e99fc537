"""Dispersed flights beside the nominal one: what `show_differences` keeps of it, how it is looked up, what is seen."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch

import ppo_gtrxl_rocket as script
from envs import ROCKETS, Burn, register_rocket, target_axes, target_orbit

CUTOFF = "RocketAscentCutoff-v0"
SMALL = {"embed_dim": 8, "num_heads": 2, "mlp_dim": 8, "hidden_dim": 8, "num_blocks": 1, "memory_length": 4}
SCALES = [5e-5, 5e-5, 5e-5, 1e-4, 3e-4, 2e-5, 0.01, 0.004]
torch.set_num_threads(1)


def compared(y, rocket):
    """What flights are compared by, of one state, by textbook formulas in SI and unit vectors."""
    r, v = y[:3], y[3:6]
    axes = np.array(target_axes(rocket))
    h_target, e_target = target_orbit(rocket.target, rocket.mu)
    h = np.cross(r, v)
    e = np.cross(v, h) / rocket.mu - r / np.linalg.norm(r)
    angle = np.arctan2(r @ axes[1], r @ axes[0])
    mass = np.log(y[6] / rocket.dry_mass)
    return [*axes @ (h - h_target) / np.linalg.norm(h_target), *axes @ (e - e_target), mass, angle]


def make_agent(dispersion=1.0, env_id=CUTOFF, **options):
    """A small agent in double precision, its args, which name a policy to begin with, and the environment's options."""
    args = script.Args(**SMALL, env_id=env_id, dispersion=dispersion, checkpoint="a policy", **options)
    env_options = {name: getattr(args, name) for name in script.ENV_OPTIONS} | script.FIXED_OPTIONS
    torch.manual_seed(0)
    return script.Agent(args, gym.make_vec(env_id, num_envs=1, **env_options)).double(), args, env_options


def climb(obs, t):
    """Up, and tilted more and more: a flight of all burns."""
    tilt = min(1.5, 0.01 * t)
    return np.tile([np.cos(tilt), np.sin(tilt), 0.0], (len(obs), 1))


def fly(policy, num_envs=1, env_id=CUTOFF, **options):
    """The observations (T + 1, N, 9) of N flights by a policy, and when each ended (N,)."""
    env = gym.make_vec(env_id, num_envs=num_envs, action_frame="local", **options)
    obs, _ = env.reset(seed=5)
    seen, ended = [obs], np.full(num_envs, -1)
    while (ended < 0).any():
        obs, _, terminated, _ = env.advance(policy(obs, len(seen) - 1))
        seen.append(obs)
        ended[terminated & (ended < 0)] = len(seen) - 1
    return np.array(seen), ended


def energy(y, rocket):
    """The specific energy in units of mu / Re."""
    return 0.5 * (y[3:6] @ y[3:6]) * rocket.Re / rocket.mu - rocket.Re / np.linalg.norm(y[:3])


@pytest.fixture(scope="module")
def flown():
    """An agent that keeps the nominal flight of `climb`, and that flight's observations (T + 1, 9)."""
    agent, _, _ = make_agent()
    script.fly_nominal(agent, climb, gym.make_vec(CUTOFF, num_envs=1, action_frame="local"))
    seen, _ = fly(climb)
    return agent, seen[:, 0]


def test_the_nominal_flight_is_kept_as_it_was_flown(flown):
    """Burn, energy and what is compared of every step, the last one's too."""
    agent, seen = flown
    rocket = ROCKETS[CUTOFF].rocket
    table = agent.nominal_flight.numpy()
    assert table.shape == (482, 10) and len(seen) == 482
    np.testing.assert_array_equal(table[:, 0], np.round(3 * seen[:, 8]))
    assert set(table[:, 0]) == {0, 1, 2, 3}
    expected = [[energy(y, rocket), *compared(y, rocket)] for y in seen]
    np.testing.assert_allclose(table[:, 1:], expected, rtol=1e-5, atol=2e-5)  # of single precision


def test_a_flight_that_ends_early_leaves_rows_of_no_burn():
    agent, _, _ = make_agent()
    crash = lambda obs, t: np.tile([-1.0, 0.1, 0.0], (len(obs), 1))  # noqa: E731
    script.fly_nominal(agent, crash, gym.make_vec(CUTOFF, num_envs=1, action_frame="local"))
    burns = agent.nominal_flight[:, 0]
    assert 2 <= (burns == 0).sum() < 100 and (burns > 0).sum() == (burns == 4).sum()
    seen, _ = fly(climb, 2, dispersion=1.0)  # later burns than it had
    assert script.features(agent, torch.as_tensor(seen)).isfinite().all()


def by_hand(y, burn, table, rocket):
    """The same by a plain search among the burn's rows, beyond which the nearest two are extended."""
    rows = table[table[:, 0] == burn]
    here = energy(y, rocket)
    k = int(np.clip(np.searchsorted(rows[:, 1], here), 1, len(rows) - 1))
    share = (here - rows[k - 1, 1]) / (rows[k, 1] - rows[k - 1, 1])
    nominal = rows[k - 1, 2:] + share * (rows[k, 2:] - rows[k - 1, 2:])
    return np.clip((compared(y, rocket) - nominal) / SCALES, -10, 10)


def test_dispersed_flights_are_seen_beside_it_at_equal_energy(flown):
    """Eight vehicles, all their steps; whatever the clock says."""
    agent, _ = flown
    rocket, table = ROCKETS[CUTOFF].rocket, agent.nominal_flight.numpy().astype(float)
    seen, ended = fly(climb, 8, dispersion=1.0)
    features = script.features(agent, torch.as_tensor(seen)).numpy()
    assert features.shape[2] == 37
    checked = 0
    for k in range(8):
        for t in range(20, ended[k], 7):
            expected = by_hand(seen[t, k], round(3 * seen[t, k, 8]), table, rocket)
            np.testing.assert_allclose(features[t, k, -8:], expected, atol=0.05)
            checked += np.abs(expected).max() > 0.5
    assert checked > 100  # they are told apart
    later = seen[100, :1].copy()
    later[:, 7] -= 0.2
    at_once = [script.features(agent, torch.as_tensor(obs))[0, -8:] for obs in (seen[100, :1], later)]
    assert torch.equal(*at_once)


def test_before_a_dispersed_training_nothing_is_seen(flown):
    agent, _, _ = make_agent()
    assert not script.features(agent, torch.as_tensor(flown[1]))[..., -8:].any()


def test_what_comes_into_sight_changes_nothing_at_first():
    """The policy that a dispersed training begins with flies on as it did, also where it will see the draw."""
    agent, args, env_options = make_agent(observe_draw=True)
    obs = torch.as_tensor(fly(climb, 4, dispersion=1.0, observe_draw=True)[0][:60]).transpose(0, 1)
    memory = agent.new_memory(4, 0.0)
    blind = obs.clone()
    blind[..., 9:] = 0.0  # as nominal flights show it
    before = agent.encode(blind, memory)
    script.show_differences(agent, args, env_options)
    torch.testing.assert_close(agent.encode(obs, memory), before, rtol=0, atol=0)
    assert script.has_nominal_flight(agent)
    with torch.no_grad():
        agent.encoder[0].weight[:, -8:] = 0.5
    kept = agent.nominal_flight.clone()
    script.show_differences(agent, args, env_options)  # a policy that has its nominal flight keeps it
    assert (agent.encoder[0].weight[:, -8:] == 0.5).all() and torch.equal(agent.nominal_flight, kept)


def test_a_direct_path_sees_large_differences_in_proportion(flown):
    """Beyond ten units the blocks receive the same, and what is added behind them grows in proportion, up to 100."""
    agent, _, _ = make_agent(failure=0.25, direct_differences=True)
    agent.nominal_flight.copy_(flown[0].nominal_flight)
    torch.nn.init.normal_(agent.direct.weight)
    obs = torch.as_tensor(fly(climb, 4, dispersion=1.0)[0][60])
    units = agent.differences.clone()

    def at(largest):
        agent.differences.copy_(units)
        now = script.differences(agent, script.motion(agent, obs), obs[:, 8:9])
        agent.differences.copy_(units * now.abs().max(dim=0).values / largest)
        return script.features(agent, obs)[:, -8:], script.past_the_blocks(agent, obs)

    five, ten, forty, eighty, far, farther = (at(largest) for largest in (5.0, 10.0, 40.0, 80.0, 1e6, 1e9))
    assert five[0].abs().max() < 10 and eighty[0].abs().max() == 10.0
    torch.testing.assert_close(2 * five[1], ten[1])
    torch.testing.assert_close(2 * forty[1], eighty[1])
    torch.testing.assert_close(far[1], farther[1])


def test_a_direct_path_changes_nothing_at_first(flown):
    """A policy without one flies on as before, and what the file lacks is the path alone."""
    before = flown[0]
    saved = {"tensors": {name: tensor.numpy() for name, tensor in before.state_dict().items()}}
    agent, args, _ = make_agent(failure=0.25, direct_differences=True)
    filled = script.with_direct_path(saved, args)["tensors"]
    assert filled.keys() - saved["tensors"].keys() == {"direct.weight"} and "direct.weight" not in saved["tensors"]
    agent.load_state_dict({name: torch.as_tensor(array) for name, array in filled.items()})
    obs = torch.as_tensor(fly(climb, 4, dispersion=1.0)[0][:60]).transpose(0, 1)
    memory = agent.new_memory(4, 0.0)
    assert torch.equal(agent.encode(obs, memory), before.encode(obs, memory))
    assert script.with_direct_path({"tensors": filled}, args)["tensors"] is filled
    assert script.with_direct_path(saved, make_agent()[1]) is saved


@pytest.mark.parametrize(
    "changes", [{"dispersion": 0.0}, {"checkpoint": None}, {"eval_only": True}, {"resume": "runs/before"}], ids=str
)
def test_nothing_is_flown_where_no_dispersed_training_begins(changes):
    agent, args, env_options = make_agent()
    vars(args).update(changes)
    before = {name: tensor.clone() for name, tensor in agent.state_dict().items()}
    script.show_differences(agent, args, env_options)
    for name, tensor in agent.state_dict().items():
        assert torch.equal(tensor, before[name]), name


def test_the_policy_itself_flies_it():
    """By its mean action, nominal vehicle and all."""
    agent, args, env_options = make_agent()
    script.show_differences(agent, args, env_options)
    again, _, _ = make_agent()
    script.fly_nominal(again, again.make_policy(481), gym.make_vec(CUTOFF, num_envs=1, action_frame="local"))
    torch.testing.assert_close(agent.nominal_flight, again.nominal_flight, rtol=1e-5, atol=1e-5)


def test_in_a_coast_flights_are_compared_with_its_beginning():
    """There the energy stays: a rounding error of it must not choose the row. Only the angle goes on."""
    two_stages = ROCKETS["TwoStageLEO-v0"].rocket
    first, second = two_stages.burns
    burns = (first, Burn(300.0, second.engines), Burn(600.0, ()), Burn(693.0, second.engines))
    register_rocket("Restart-v0", replace(two_stages, burns=burns, end_time=693.0), cutoff=True)
    try:
        agent, *_ = make_agent(env_id="Restart-v0")
        envs = gym.make_vec("Restart-v0", num_envs=1, action_frame="local")
        script.fly_nominal(agent, climb, envs)
        rows = agent.nominal_flight
        coast = rows[rows[:, 0] == 2]
        assert len(coast) == 150
        phase = torch.full((5, 1), 2 / 3, dtype=torch.float64)
        energy = coast[0, 1] + torch.tensor([[-1e-3], [-1e-9], [0.0], [1e-9], [1e-3]], dtype=torch.float64)
        found = script.nominal_at(agent, phase, energy)
        np.testing.assert_array_equal(found, coast[:1, 2:].expand(5, -1))
        np.testing.assert_allclose(coast[:, 2:9], coast[:1, 2:9].expand(len(coast), -1), atol=2e-6)
    finally:
        for registry in (ROCKETS, gym.registry):
            del registry["Restart-v0"]
