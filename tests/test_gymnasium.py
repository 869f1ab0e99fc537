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


@pytest.mark.parametrize("mode", ["disabled", "next", 3])
def test_other_modes_are_refused(mode):
    with pytest.raises(ValueError, match="autoreset_mode is .*; it must be one of 'SameStep', 'NextStep', 'Disabled'"):
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
    with pytest.raises(BadInput, match="unexpected .* 'max_episode_steps', 5; it must be one of .*observe_phase"):
        make(env_id, 2, max_episode_steps=5)


@pytest.mark.parametrize("env_id", [*IDS, "MarsLanding-v0"])
def test_a_seed_for_each_environment_is_the_single_environments(env_id):
    options = {"dispersion": 1.0} if "Rocket" in env_id else {}
    batch = make(env_id, 3, **options)
    seeds = [5, 9, 5]
    obs, _ = batch.reset(seed=seeds)
    for row, seed in zip(obs, seeds):
        np.testing.assert_array_equal(row, make(env_id, 1, **options).reset(seed=seed)[0][0])
    np.testing.assert_array_equal(batch.reset(seed=np.array(seeds))[0], obs)
    for wrong in ([1, 2], [1, 2, -3], [1, 2, 0.5]):
        with pytest.raises(BadInput, match="seed is .*; it must be one whole number, or 3 of them"):
            batch.reset(seed=wrong)


@every_kind
def test_a_mask_restarts_as_gymnasiums_own_vectors_do(env_id):
    """Without autoreset the same masks, seeds and actions give what Gymnasium's vector of single environments gives."""
    frame = {"action_frame": "local"} if "Rocket" in env_id else {}
    mode = gym.vector.AutoresetMode.DISABLED
    theirs = gym.vector.SyncVectorEnv([lambda: gym.make(env_id, **frame)] * 3, autoreset_mode=mode)
    ours = make(env_id, 3, autoreset_mode="Disabled")
    random = actions_of(ours, 2)
    flight = range(ours.unwrapped.episode_steps + 3)
    both = (ours, theirs)
    for env in both:
        env.reset(seed=[1, 2, 3])
    for t in flight:
        action = next(random).astype(ours.action_space.dtype)
        (obs, rewards, terminated, _, _), (their_obs, their_rewards, their_ends, _, _) = (e.step(action) for e in both)
        np.testing.assert_allclose(obs, their_obs, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(rewards, their_rewards, rtol=1e-6, atol=1e-9)
        np.testing.assert_array_equal(terminated, their_ends)
        mask = terminated | ([t == 1, False, False])
        if not mask.any():
            continue
        if terminated.any():
            with pytest.raises(gym.error.ResetNeeded, match="have ended"):
                ours.step(action)
        restarted, expected = (e.reset(seed=[t, t, t], options={"reset_mask": mask.copy()})[0] for e in both)
        np.testing.assert_allclose(restarted, expected, rtol=1e-6, atol=1e-9)


def test_a_mask_that_does_not_fit_is_refused():
    batch = make("VanDerPol-v0", 2, autoreset_mode="Disabled")
    with pytest.raises(gym.error.ResetNeeded, match="never begun"):
        batch.reset(options={"reset_mask": np.array([True, False])})
    batch.reset(seed=0)
    for mask in ([True, False], np.array([1, 0]), np.array([True]), np.array([False, False])):
        with pytest.raises(BadInput, match="reset_mask.* it must be an array of bool, of shape"):
            batch.reset(options={"reset_mask": mask})


@pytest.mark.parametrize("env_id", [*IDS, "MarsLanding-v0"])
def test_torchrl_makes_checks_and_flies_them(env_id):
    """TorchRL is not among our requirements. Its GymEnv tries options that our environments do not have."""
    torchrl = pytest.importorskip("torchrl.envs")
    env = torchrl.GymEnv(env_id)
    torchrl.check_env_specs(env)
    env.set_seed(3)
    flight = env.rollout(4)
    twin = gym.make(env_id)
    twin.reset(seed=3)
    twin.reset()
    rewards = [twin.step(action.numpy())[1] for action in flight["action"]]
    np.testing.assert_allclose(flight["next", "reward"][:, 0], rewards, rtol=1e-6)
