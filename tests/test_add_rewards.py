"""What training pays the cut-off rocket for its mass: against least squares, and what must not change it."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import ppo_gtrxl_rocket as script
from envs import ROCKET
from rocket.rewards import mass_rewards, terminal_reward

ROOT = Path(__file__).resolve().parents[1]
N = 32
ENV_ID = "RocketAscentCutoff-v0"


def flights(seed=0, size=1e-3):
    """Ends of N flights near the target, their errors of four directions, as with cut-off."""
    rng = np.random.default_rng(seed)
    error = size * rng.standard_normal((N, 4)) @ rng.standard_normal((4, 6))
    mass = 7500 + rng.standard_normal(N)
    a_km = np.full(N, ROCKET.a / 1e3)
    return {"error": error, "error_norm": np.linalg.norm(error, axis=1), "final_mass_kg": mass, "a_km": a_km}


def paid(episodes, progress=0.4, env_id=ENV_ID, flying=N, **flags):
    """The rewards (T, flying) that `add_rewards` adds; flight k lives k + 1 steps."""
    args = script.Args(**{**script.RECIPES[ENV_ID], "env_id": env_id, "num_envs": flying, **flags})
    envs = gym.make_vec(env_id, num_envs=flying, dispersion=args.dispersion).unwrapped
    training = {"flights_per_start": round(args.flights_per_start.at(0.0)), "terminal_scale": 0.002}
    alive = (torch.arange(flying)[:, None] <= torch.arange(flying)).float()
    rewards = torch.zeros(flying, flying)
    batch = script.Batch(*[torch.zeros(0)] * 3, rewards, torch.zeros(0), alive, torch.zeros(0))
    script.add_rewards(args, progress, training, envs, batch, episodes)
    return batch.rewards.numpy()


def at_the_end(rewards):
    """The rewards of the last steps (N,); there are no others."""
    assert np.count_nonzero(rewards - np.diag(np.diag(rewards))) == 0
    return np.diag(rewards)


def residuals(episodes, who=slice(None)):
    """Masses and R_terminal less what a linear function of the errors says of them, by least squares."""
    x = np.column_stack([np.ones(len(episodes["error"][who])), 1e3 * episodes["error"][who]])
    ends = np.column_stack([episodes["final_mass_kg"], terminal_reward(episodes["error_norm"], 0.002)])[who]
    return (ends - x @ np.linalg.lstsq(x, ends, rcond=1e-9)[0]).T


def test_residuals_in_units_of_the_terminal_rewards():
    episodes = flights()
    mass, terminal = residuals(episodes)
    expected = 2.0 * terminal.std() / mass.std() * mass * 0.2  # --mass-weight, --reward-scale
    np.testing.assert_allclose(at_the_end(paid(episodes)), expected, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(at_the_end(paid(episodes, mass_weight=0.5)), expected / 4, rtol=1e-5, atol=1e-7)


def test_where_thrust_may_be_lost_mass_counts_as_much_as_the_orbit():
    """In units of R_terminal's own spread, which for flights that are off to one side is larger than its residuals'."""
    episodes = flights(size=1e-4)
    episodes["error"] += 0.005
    episodes["error_norm"] = np.linalg.norm(episodes["error"], axis=1)
    mass, residual = residuals(episodes)
    terminal = terminal_reward(episodes["error_norm"], 0.002)
    assert terminal.std() > 20 * residual.std()
    for failure, spread in ((0.0, residual.std()), (0.25, terminal.std())):
        rewards = at_the_end(paid(episodes, failure=failure, flights_per_start=N))
        np.testing.assert_allclose(rewards, 0.4 * spread / mass.std() * mass, rtol=1e-4, atol=1e-9)


def test_what_a_miss_saves_and_kilograms_do_not_count():
    episodes = flights()
    before = paid(episodes)
    saved = episodes["error"] @ np.array([7e3, 0.0, -13e3, 6e3, 6e3, 3e3])  # 18 t a unit, as in ascents
    lower = episodes | {"final_mass_kg": 2 * (episodes["final_mass_kg"] + saved) - 5000}
    np.testing.assert_allclose(paid(lower), before, rtol=1e-5, atol=1e-7)


def test_far_flights_take_no_part():
    episodes = flights()
    mass, terminal = residuals(episodes, slice(4, None))
    episodes["error"][:4] += 1.0
    episodes["error_norm"] = np.linalg.norm(episodes["error"], axis=1)
    rewards = at_the_end(paid(episodes))
    assert not rewards[:4].any()
    np.testing.assert_allclose(rewards[4:], 0.4 * terminal.std() / mass.std() * mass, rtol=1e-5, atol=1e-7)
    episodes["error_norm"][4:20] = 0.06
    assert not paid(episodes).any(), "fewer than half of them say little"


def test_a_near_flight_that_ran_dry_takes_no_part():
    """Its error has a fifth direction, which would take one of the four from the others."""
    episodes = flights()
    mass, terminal = residuals(episodes, slice(1, None))
    ran_dry = {name: values.copy() for name, values in episodes.items()}
    ran_dry["a_km"][0] *= 1 - 1e-5
    ran_dry["error"][0] = 0.01
    ran_dry["error_norm"][0] = 0.01 * np.sqrt(6)
    rewards = at_the_end(paid(ran_dry))
    assert rewards[0] == 0
    np.testing.assert_allclose(rewards[1:], 0.4 * terminal.std() / mass.std() * mass, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("env_id, result", [(ENV_ID, "rocket_cutoff"), ("TwoStageLEO-v0", "two_stage_leo")])
def test_flights_that_are_cut_off_are_compared(env_id, result):
    """The stored optimum, each flight turned a little: at the target's energy but for rounding, on both vehicles."""
    u = np.load(ROOT / "results" / result / "eval.npz")["u_reference"]
    turned = 0.003 * np.random.default_rng(0).standard_normal((N, 3))
    envs = gym.make_vec(env_id, num_envs=N, action_frame="eci").unwrapped
    ends, alive, _ = {}, np.ones(N, dtype=bool), envs.reset(seed=0)
    for t in range(envs.episode_steps):
        _, _, terminated, _, info = envs.step(u[min(t, len(u) - 1)] + turned)
        for key, value in info.get("final_info", {}).items():
            ended = alive & terminated
            ends.setdefault(key, np.zeros_like(value))[ended] = value[ended]
        alive &= ~terminated
    assert not alive.any() and np.ptp(ends["final_mass_kg"]) > 10
    assert (mass_rewards(ends, envs.rocket, 0.002, N) != 0).all()


@pytest.mark.parametrize(
    ("progress", "share"), [(0.0, 0), (0.1, 0), (0.15, 0.5), (0.5, 1), (0.675, 0.5), (0.85, 0), (1, 0)]
)
def test_course(progress, share):
    np.testing.assert_allclose(paid(flights(), progress), share * paid(flights(), 0.3), rtol=1e-5, atol=1e-7)


def test_a_fixed_final_time_pays_nothing():
    assert not paid(flights(), env_id="RocketAscent-v0").any()


def test_groups_of_one_draw_are_compared_among_themselves():
    """Another draw may have any mass and save another mass by a miss."""
    episodes, flags = flights(), {"dispersion": 1.0, "flights_per_start": 16}
    before = paid(episodes, **flags)
    other = np.arange(N) >= 16
    episodes["final_mass_kg"] += other * (300 + episodes["error"] @ np.full(6, 5e3))
    np.testing.assert_allclose(paid(episodes, **flags), before, rtol=1e-5, atol=1e-7)
    for group in (slice(16), slice(16, None)):
        mass, terminal = residuals(episodes, group)
        np.testing.assert_allclose(
            at_the_end(before)[group], 0.4 * terminal.std() / mass.std() * mass, rtol=1e-5, atol=1e-7
        )


def test_equal_masses_are_no_division_by_zero():
    rewards = paid(flights() | {"final_mass_kg": np.full(N, 6644.0)})
    assert np.abs(rewards).max() < 1e-3


@pytest.mark.parametrize("dispersion", [0.0, 1.0])
def test_several_processes_pay_what_one_pays(dispersion, monkeypatch):
    """Each its own flights, by the fit to all flights of one start; 8 of 32 are the first process's."""
    episodes, flags = flights(), {"dispersion": dispersion, "flights_per_start": 8}
    whole = at_the_end(paid(episodes, **flags))
    monkeypatch.setattr(script.runs, "gathered", lambda own: episodes)
    monkeypatch.setattr(script.runs, "all_gather", lambda count: [8, 24])
    for rank, part in ((0, slice(8)), (1, slice(8, None))):
        monkeypatch.setattr(script.runs, "rank_and_world_size", lambda rank=rank: (rank, 2))
        own = {name: values[part] for name, values in episodes.items()}
        rewards = at_the_end(paid(own, flying=len(whole[part]), **flags))
        np.testing.assert_array_equal(rewards, whole[part])
