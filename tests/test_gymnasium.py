"""Gymnasium's conventions on every kind of environment: autoreset modes, wrappers, copies, options, attributes."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers.vector import NormalizeObservation, NormalizeReward, RecordEpisodeStatistics

from envs import BadInput

IDS = ["DoubleIntegrator-v0", "VanDerPolWaypoints-v0", "RocketAscentCutoff-v0"]
every_kind = pytest.mark.parametrize("env_id", IDS)


def actions_of(env, seed):
    """Endless random actions (N, actions), the rocket's roughly upwards."""
    rng = np.random.default_rng(seed)
    shape = env.action_space.shape
    while True:
        action = rng.uniform(-1, 1, shape)
        if shape[1] == 3:
            action = 0.3 * action + [1.0, 0.0, 0.0]
        yield action


def make(env_id, num_envs, **options):
    frame = {"action_frame": "local"} if "Rocket" in env_id else {}
    return gym.make_vec(env_id, num_envs=num_envs, **frame, **options)


@every_kind
def test_next_step_autoreset_is_same_step_with_a_step_between(env_id):
    """Both modes fly the same first episodes by the same actions; the next step begins a new one and pays nothing."""
    same, late = make(env_id, 3), make(env_id, 3, autoreset_mode="NextStep")
    if env_id != "RocketAscentCutoff-v0":
        np.testing.assert_array_equal(same.reset(seed=4)[0], late.reset(seed=4)[0])
    else:
        same.reset(seed=4), late.reset(seed=4)
    for action in actions_of(same, 0):
        obs, reward, ended, _, info = same.step(action)
        late_obs, late_reward, late_ended, truncated, late_info = late.step(action)
        np.testing.assert_array_equal(late_reward, reward)
        np.testing.assert_array_equal(late_ended, ended)
        assert not truncated.any()
        if ended.any():
            break
        np.testing.assert_array_equal(late_obs, obs)
    np.testing.assert_array_equal(late_obs[ended], info["final_obs"][ended])
    for key, value in info["final_info"].items():
        np.testing.assert_array_equal(late_info[key][ended], value[ended])

    action = np.where(ended[:, None], np.nan, 0.5) * np.ones(late.action_space.shape)  # ignored where NaN
    _, reward, ended_again, _, info = late.step(action)
    assert (reward[ended] == 0).all() and not ended_again[ended].any()
    begun = late.unwrapped.t[ended]
    assert (begun == 0).all()


def test_environments_that_end_at_different_steps_wait_for_nobody():
    """Crashed rockets begin anew while the others fly on as if nothing had been."""
    alone, batch = make("RocketAscentCutoff-v0", 1), make("RocketAscentCutoff-v0", 2, autoreset_mode="NextStep")
    alone.reset(seed=0), batch.reset(seed=0)
    restarts = 0
    for k in range(200):
        up, dive = [1.0, 0.2, 0.0], [-1.0, 0.5, 0.0]
        expected, *_ = alone.step(np.array([up]))
        obs, reward, ended, *_ = batch.step(np.array([up, dive if k % 60 > 10 else up]))
        np.testing.assert_array_equal(obs[0], expected[0])
        restarts += ended[1]
    assert restarts > 2 and not ended[0]


def test_gymnasiums_wrappers_take_the_native_batch():
    batch = make("RocketAscentCutoff-v0", 2, autoreset_mode=gym.vector.AutoresetMode.NEXT_STEP)
    env = NormalizeReward(NormalizeObservation(RecordEpisodeStatistics(batch)))
    env.reset(seed=1)
    for action in actions_of(env, 0):
        obs, _, ended, _, info = env.step(action)
        assert np.isfinite(obs).all()
        if ended.all():
            break
    assert (info["episode"]["l"] == batch.unwrapped.episode_steps).all()
    with pytest.raises(ValueError, match="autoreset_mode"):
        NormalizeObservation(make("RocketAscentCutoff-v0", 2))


@pytest.mark.parametrize("mode", ["Disabled", "next", 3])
def test_other_modes_are_refused(mode):
    with pytest.raises(ValueError, match="autoreset_mode is .*; it must be 'SameStep' or 'NextStep'"):
        make("DoubleIntegrator-v0", 2, autoreset_mode=mode)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", IDS[::2])
@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_a_drawn_environment_can_be_copied(env_id, clone):
    """Gymnasium's checkers and search algorithms do: the copy steps and draws as the original."""
    env = gym.make(env_id, render_mode="rgb_array")
    env.reset(seed=3)
    action = np.array([0.3, 0.1, 0.0])[: env.action_space.shape[0]]
    env.step(action)
    frame = env.render()
    twin = clone(env)
    np.testing.assert_array_equal(twin.render(), frame)
    np.testing.assert_array_equal(twin.step(action)[0], env.step(action)[0])
    np.testing.assert_array_equal(twin.render(), env.render())


@every_kind
def test_what_a_training_hands_over_is_checked(env_id):
    """An unknown name and a bad value are named. Through wrappers, too, it holds until the next reset."""
    for env in (make(env_id, 2), gym.make(env_id)):
        with pytest.raises(BadInput, match="^training's flights_per_stat is 2; it must be one of flights_per_start"):
            env.reset(options={"training": {"flights_per_stat": 2}})
        for bad in (0, 1.5):
            with pytest.raises(
                BadInput, match=f"^training's flights_per_start is {bad}; it must be a whole number of at"
            ):
                env.reset(options={"training": {"flights_per_start": bad}})
        batch = getattr(env.unwrapped, "batch", env.unwrapped)
        for options, held in (({"training": {"flights_per_start": 2}}, 2), (None, 1)):
            env.reset(seed=0, options=options)
            assert batch.training.flights_per_start == held
        with pytest.raises(BadInput):
            env.reset(options={"draw": "no draw", "training": {"flights_per_start": 2}})
        assert batch.training.flights_per_start == 1  # a refused reset changes nothing


@every_kind
def test_a_single_environment_has_no_autoreset(env_id):
    with pytest.raises(BadInput, match="autoreset_mode is 'NextStep'; it must not be given"):
        gym.make(env_id, autoreset_mode="NextStep")


@every_kind
def test_an_unknown_option_is_named(env_id):
    with pytest.raises(BadInput, match="the option max_episode_steps is 5; it must be one of .*observe_phase"):
        make(env_id, 2, max_episode_steps=5)
