"""Flights to targets of their own, against the environment that has the target in its table, rotation matrices typed
here, the other program of the optimum, and an LQR's own prediction.
"""

import re
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch

import envs
import ppo_gtrxl_rocket as script
from common.errors import NoOptimum
from common.tasks import task_of
from envs import ROCKET, ROCKETS, BadInput
from exports.rocket import interface
from rocket import guidance, neighbours
from rocket.any_orbit import refuse_unreachable, solve_target, solve_targets, target_masses
from rocket.metrics import element_misses, inside_box, targets_of
from rocket.missions import Mission
from rocket.optimum import AscentCase, optimise_ascent
from rocket.rewards import mass_rewards
from rocket.targets import own_target

ANY = "RocketAscentAnyOrbit-v0"
CUTOFF = "RocketAscentCutoff-v0"
RANGES = ROCKETS[ANY].targets
TARGETS = targets_of(ROCKETS[ANY], 5, 3)
STEER = np.array([[1.0, 0.35, 0.02], [1.0, 0.4, 0.0], [1.0, 0.3, -0.05]])


def make(num_envs=3, **options):
    return gym.make_vec(ANY, num_envs=num_envs, **options).unwrapped


def with_target(target):
    """The paper's rocket with this target in its table."""
    return replace(ROCKET, **dict(zip(("a", "e", "i", "raan", "argp"), map(float, target))))


def fly(batch, obs, steps=470):
    """Pitch over and fly, until all end: rewards (steps, N), the observations, and the ends."""
    seen, rewards, ends = [obs], [], {}
    flew = np.ones(batch.num_envs, dtype=bool)
    for k in range(steps):
        tilt = min(k / 130, 1.0)
        action = np.array([1.0 - tilt, 0.05 + tilt, 0.0]) + 0.01 * STEER[: batch.num_envs]
        obs, reward, ended, final = batch.advance(action)
        seen.append(obs)
        rewards.append(reward * flew)
        for key, value in final.items():
            ends.setdefault(key, value.copy())[flew & ended] = value[flew & ended]
        flew &= ~ended
        if not flew.any():
            break
    return np.array(rewards), seen, ends


def test_a_given_target_flies_as_one_in_the_table():
    batch = make(action_frame="local")
    obs, _ = batch.reset(options={"target": TARGETS})
    rewards, seen, ends = fly(batch, obs)
    for k, target in enumerate(TARGETS):
        alone = gym.make_vec(CUTOFF, num_envs=3, rocket=with_target(target), action_frame="local").unwrapped
        obs, _ = alone.reset()
        _, own, own_ends = fly(alone, obs)
        assert len(own) >= 200
        for row, other in zip(own[:200], seen):
            np.testing.assert_allclose(other[k, :9], row[k], rtol=1e-12)
        for key in ("error", "error_norm", "a_km", "final_mass_kg", "final_time_s", "R_orbital", "R_terminal"):
            np.testing.assert_allclose(ends[key][k], own_ends[key][k], rtol=1e-9, atol=1e-12, err_msg=key)
    np.testing.assert_array_equal(ends["target"], TARGETS)
    assert np.isfinite(rewards).all()


def test_the_target_is_seen():
    obs, _ = make().reset(options={"target": TARGETS})
    for row, (a, e, *angles) in zip(obs, TARGETS):
        i, raan, argp = np.radians(angles)

        def about(axis, angle):
            c, s = np.cos(angle), np.sin(angle)
            return np.array({"z": [[c, -s, 0], [s, c, 0], [0, 0, 1]], "x": [[1, 0, 0], [0, c, -s], [0, s, c]]}[axis])

        turn = about("z", raan) @ about("x", i) @ about("z", argp)
        np.testing.assert_allclose(row[9:12], turn[:, 0], atol=1e-12)
        np.testing.assert_allclose(row[12:15], turn[:, 2], atol=1e-12)
        apogee = a * (1 + e)
        speed_there = np.sqrt(ROCKET.mu * (2 / apogee - 1 / a))
        np.testing.assert_allclose(row[15:], [apogee * speed_there, e], rtol=1e-12)


def test_one_target_for_all_and_the_single_environment():
    batch = make()
    batch.reset(options={"target": TARGETS[1]})
    np.testing.assert_array_equal(batch.target, np.repeat(TARGETS[1:2], 3, axis=0))
    env = gym.make(ANY).unwrapped
    obs, _ = env.reset(options={"target": TARGETS[1]})
    both, _ = batch.reset(options={"target": TARGETS})
    np.testing.assert_array_equal(obs, both[1])


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ([7e6, 0.0, 30.0, 0.0], "of shape"),
        ([7e6, 1.0, 30.0, 0.0, 0.0], "e of options['target'] is 1.0; it must be at least 0 and below 1"),
        ([6.5e6, 0.1, 30.0, 0.0, 0.0], "must have its perigee above the ground"),
        ([7e6, 0.0, 181.0, 0.0, 0.0], "i of options['target'] is 181.0"),
        ([7e6, 0.0, np.nan, 0.0, 0.0], "is nan"),
        ([1e12, 0.0, 30.0, 0.0, 0.0], "a of options['target']"),
    ],
)
def test_a_target_that_cannot_be_is_refused(target, words):
    with pytest.raises(BadInput, match=re.escape(words)):
        make().reset(options={"target": target})


@pytest.mark.parametrize(
    ("ranges", "words"),
    [
        ({"perigee_km": (250.0, 180.0)}, "targets' perigee_km is (250.0, 180.0); it must be (low, high)"),
        ({"apogee_km": 400.0}, "targets' apogee_km is 400.0"),
        ({"perigee_km": (180.0, 500.0), "apogee_km": (200.0, 400.0)}, "targets' apogee_km"),
        ({"i_deg": (28.0, 181.0)}, "must be between 0 and 180"),
        ({"argp_deg": (0.0, np.inf)}, "two finite numbers"),
    ],
)
def test_ranges_that_cannot_be_are_refused(ranges, words):
    with pytest.raises(BadInput, match=re.escape(words)):
        replace(RANGES, **ranges)


def test_targets_need_cut_off():
    with pytest.raises(BadInput, match="without cut-off"):
        Mission(ROCKET, targets=RANGES)
    with pytest.raises(BadInput, match="reset options"):
        gym.make_vec(CUTOFF, num_envs=2).unwrapped.reset(options={"target": TARGETS[:2]})


def test_where_the_ranges_lie():
    targets = RANGES.at(np.random.default_rng(0).random((500, 5)), ROCKET)
    a, e, i, *_ = targets.T
    perigee, apogee = ((a * (1 + sign * e) - ROCKET.Re) / 1e3 for sign in (-1, 1))
    for values, (low, high) in ((perigee, RANGES.perigee_km), (apogee, RANGES.apogee_km), (i, RANGES.i_deg)):
        assert low <= values.min() < low + 0.1 * (high - low) and high - 0.1 * (high - low) < values.max() <= high
    assert np.median(apogee) == pytest.approx(np.sqrt(400 * 36_000), rel=0.2)  # uniform in the logarithm
    obs, _ = make(500).reset(options={"target": targets})
    site = ROCKET.x0[:3] / ROCKET.Re
    assert np.abs(obs[:, 12:15] @ site).max() < 1e-12  # the plane holds the launch site
    own, _ = make(1).reset(options={"target": own_target(ROCKET)})
    angle = np.degrees(np.arccos(obs[:, 9:12] @ site)) - np.degrees(np.arccos(own[0, 9:12] @ site))
    assert -6.2 < angle.min() < -5 and 5 < angle.max() < 6.2  # the rocket's node is 0.2 degrees aside


def test_groups_share_a_target_and_come_in_pairs():
    batch = make(8)
    batch.reset(seed=3, options={"training": {"flights_per_start": 2}})
    np.testing.assert_array_equal(batch.target[::2], batch.target[1::2])
    assert len(np.unique(batch.target[:, 0])) == 4
    np.testing.assert_allclose(batch.target[0, 2] + batch.target[2, 2], sum(RANGES.i_deg))
    batch.reset(seed=3)
    assert len(np.unique(batch.target[:, 0])) == 8


def test_a_training_draws_more_at_the_ends():
    batch = make(400)
    batch.reset(seed=0, options={"training": {"target_ends": 0.2}})
    i = batch.target[:, 2]
    at_ends = [np.isclose(i, end) for end in RANGES.i_deg]
    assert all(0.06 < ends.mean() < 0.14 for ends in at_ends)
    inside = i[~np.any(at_ends, axis=0)]
    assert np.mean(inside) == pytest.approx(np.mean(RANGES.i_deg), abs=0.6)
    assert np.std(inside) == pytest.approx(np.diff(RANGES.i_deg)[0] / 12**0.5, rel=0.1)


def test_southern_launches_keep_their_direction():
    rocket = replace(ROCKET, i=60.0, raan=(180 - envs.launch_raan(28.5, 60.0)) % 360)
    targets = replace(RANGES, i_deg=(60.0, 60.0)).at([[0.5] * 5], rocket)
    assert targets[0, 3] == pytest.approx(rocket.raan)
    assert targets[0, 4] == pytest.approx(rocket.argp)


def test_the_script_sees_an_own_target_as_the_one_of_its_table():
    args = script.Args(env_id=ANY, num_blocks=0, embed_dim=8, hidden_dim=8)
    told = script.Agent(args, make(1))
    fixed = script.Agent(replace(args, env_id=CUTOFF), gym.make_vec(CUTOFF, num_envs=1).unwrapped)
    batch = make(3, action_frame="local")
    obs, _ = batch.reset(options={"target": own_target(ROCKET)})
    _, seen, _ = fly(batch, obs)
    for k in (5, 120, 200):
        rows = torch.as_tensor(seen[k], dtype=torch.float32)
        *numbers, own = script.motion(told, rows)
        *expected, one = script.motion(fixed, rows[:, :9])
        for value, other in zip([*numbers, *own], [*expected, *one]):
            torch.testing.assert_close(value, other.expand_as(value), rtol=2e-5, atol=2e-6)


def test_mass_is_paid_at_each_flight_s_own_energy():
    rng = np.random.default_rng(0)
    error = 1e-3 * rng.standard_normal((16, 6))
    ends = {"error": error, "error_norm": np.linalg.norm(error, axis=1), "final_mass_kg": 7e3 + rng.random(16)}
    ends |= {"a_km": np.full(16, 9000.0)}
    assert not mass_rewards(ends, ROCKET, 1e-3, 16).any()
    assert mass_rewards(ends | {"target": np.tile([9e6, 0.2, 30, 0, 0], (16, 1))}, ROCKET, 1e-3, 16).any()


def test_misses_are_counted_from_each_flight_s_target():
    ends = {"a_km": TARGETS[:, 0] / 1e3, "e": TARGETS[:, 1] + 1e-3, "target": TARGETS}
    ends |= {f"{name}_deg": TARGETS[:, k] + 0.1 * k for k, name in ((2, "i"), (3, "raan"), (4, "argp"))}
    misses = element_misses(ends, ROCKET)
    np.testing.assert_allclose(misses["perigee_km"], -TARGETS[:, 0] / 1e6)
    np.testing.assert_allclose(misses["argp_deg"], 0.4, rtol=1e-9)


def test_a_nearly_circular_target_has_no_perigee_to_miss():
    """Its perigee may lie anywhere in a launcher's accuracy, that of an ellipse within 0.3 degrees."""
    target = np.array([[7e6, e, 33.0, 303.0, 100.0] for e in (0.0, 0.009, 0.011)])
    a, e, i, raan, argp = target.T
    flown = {"a_km": a / 1e3, "e": e, "i_deg": i, "raan_deg": raan, "argp_deg": argp + 90, "crashed": np.zeros(3, bool)}
    assert inside_box({**flown, "target": target}, ROCKET).tolist() == [True, True, False]


# --- optima and opponents ---------------------------------------------------------------------------------------------


def test_the_optimum_of_a_target_agrees_with_the_program_of_one_rocket():
    optimum = solve_targets(ANY, ROCKETS[ANY], TARGETS[:1], processes=1)[0]
    other = optimise_ascent(AscentCase("other", with_target(TARGETS[0])))
    assert optimum["final_mass"] == pytest.approx(other["final_mass"], abs=2e-3)
    stored = target_masses(ANY, ROCKETS[ANY], 0, 300)
    assert np.isfinite(stored).all()
    again = solve_targets(ANY, ROCKETS[ANY], targets_of(ROCKETS[ANY], 0, 7)[6:], processes=1)[0]
    assert again["final_mass"] == pytest.approx(stored[6], abs=1e-3)


def test_a_corner_out_of_reach_is_named():
    far = replace(RANGES, perigee_km=(180.0, 180.0), argp_deg=(0.0, 0.0), i_deg=(28.6, 120.0))
    with pytest.raises(NoOptimum, match="no optimum to 180 km by 36000 km, i 120"):
        refuse_unreachable(ANY, replace(ROCKETS[ANY], targets=far))


def test_the_nearest_of_the_solved_flown_to_another_target():
    mission = ROCKETS[ANY]
    middle = RANGES.corners(ROCKET)[:1]
    optimum = solve_target((ROCKET, middle[0], [guidance.optimum_guess(ANY)]))
    flights = neighbours.flown_optima(ANY, middle, [optimum])
    close = middle + [2e4, 2e-3, 0.05, 0.02, -0.05]
    assert neighbours.nearest(np.vstack([TARGETS, close]), middle, ROCKET) == [3]
    chosen = np.zeros(1, dtype=int)
    errors = {}
    for name, law in (
        ("itself", neighbours.open_loops(flights, chosen)),
        ("open loop", neighbours.open_loops(flights, chosen)),
        ("LQR", neighbours.NearestLQR(mission, flights, chosen, close)),
    ):
        target = middle if name == "itself" else close
        batch = make(1)
        obs, _ = batch.reset(options={"target": target})
        errors[name] = float(neighbours.fly_until_ended(batch, law, obs)["error_norm"][0])
    assert errors["itself"] < 2e-5
    assert errors["LQR"] < 0.1 * errors["open loop"]  # first order is nulled, the second order stays


def test_an_export_names_every_number_that_is_seen():
    for options in ({}, {"observe_draw": True, "dispersion": 1.0}):
        named = interface(task_of(ANY), action_frame="local", **options)
        assert len(named.observation) == make(1, **options).single_observation_space.shape[0]
    assert "n = target_normal" in named.notes
