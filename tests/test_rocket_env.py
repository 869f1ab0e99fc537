"""Rockets in flight, each test with every vehicle that it means something for: against the equations typed once more
(`rocket_oracle.py`) with SciPy's integrator, closed forms, and itself: single against batched, ECI against local frame.
"""

import math
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from rocket_oracle import (
    CUTOFF,
    FIXED,
    LEO,
    LEO_FIXED,
    MU,
    PAPER,
    PARTS,
    RE,
    TWO_STAGE,
    VEHICLES,
    assert_states_agree,
    both,
    energy,
    fly,
    make,
    single,
    unit,
)

from envs import BadInput, Rocket, RocketVectorEnv, fly_rocket

KEYS = {
    "final_y",
    *PARTS, "error", "error_norm", "a_km", "e", "i_deg", "raan_deg", "argp_deg", "final_mass_kg", "final_time_s",
    "max_altitude_km", "episodic_return", "points", "crashed",
}  # fmt: skip

# --- dynamics ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("v, table_isp", [(PAPER, False), (PAPER, True), (TWO_STAGE, False)])
def test_flights_agree_with_scipy(v, table_isp):
    """To the end of a fixed time at every step, and to the cut-off, before which the two are one flight."""
    u, y, (cut_time, cut_state) = v.reference(table_isp)
    whole, rewards, final = fly(make(v.fixed, table_isp=table_isp), lambda obs, t: u[t])
    assert len(rewards) == v.steps and final["final_time_s"] == v.end and not final["crashed"]
    assert_states_agree(whole[:, :7], y)
    assert cut_time < v.end - 5, "the fixed-time flight goes on where the other is cut"
    np.testing.assert_allclose(whole[:, 6], y[:, 6], rtol=0, atol=1e-6)
    altitude = np.linalg.norm(y[:, :3], axis=1) - RE
    assert altitude.min() > -1e-6 and altitude[150:].min() > 90e3, "the flight to compare should be an ascent"
    assert final["max_altitude_km"] == pytest.approx(altitude.max() / 1e3, rel=1e-6)
    assert final["final_mass_kg"] == whole[-1, 6]
    seen, rewards, final = fly(make(v.cutoff, table_isp=table_isp), lambda obs, t: u[t])
    last = len(rewards) - 1
    assert 2 * last < final["final_time_s"] <= 2 * last + 2
    assert final["final_time_s"] == pytest.approx(cut_time, rel=1e-6)
    assert_states_agree(seen[-1, :7], cut_state)
    np.testing.assert_array_equal(seen[-2, :7], whole[last, :7])
    assert energy(seen[-1]) == pytest.approx(v.goal_energy, rel=1e-10)
    assert abs(final["a_km"] * 1e3 - v.goal[0]) < 1.0
    # the state is the one that a step of just this length leads to
    last_step = v.integrate(seen[-2, :7], 2.0 * last, final["final_time_s"], u[last], table_isp)
    assert_states_agree(seen[-1, :7], last_step, 1e-9)


# --- steering ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id, end_time", [(CUTOFF, None), (FIXED, 262.0), (LEO, 163.0)])
def test_fly_rocket_records_the_flight(env_id, end_time):
    v = VEHICLES[env_id]
    envs = make(env_id, action_frame="local", end_time=end_time)
    seen, rewards, final = fly(envs, lambda obs, t: 3 * v.programme(2 * t))
    flight = fly_rocket(env_id, lambda obs, t: 3 * v.programme(2 * t)[None], end_time, action_frame="local")
    np.testing.assert_array_equal(flight["y"], seen[:, :7])
    np.testing.assert_array_equal(flight["reward"], rewards)
    np.testing.assert_array_equal(flight["t"][:-1], v.grid[: len(rewards)])
    assert flight["t"][-1] == final["final_time_s"] and set(flight) == KEYS | {"t", "u", "y", "reward", "parts"}
    np.testing.assert_array_equal(flight["parts"][-1], [final[part] for part in RocketVectorEnv.PARTS])
    np.testing.assert_allclose(np.diff(flight["parts"].sum(axis=1)), rewards[1:], rtol=0, atol=1e-9)
    assert end_time is None or final["final_time_s"] == end_time
    expected = [v.programme(2 * t) @ v.up_along_cross(s) for t, s in enumerate(seen[:-1])]
    np.testing.assert_allclose(flight["u"], expected, rtol=0, atol=1e-14)
    again = fly_rocket(env_id, lambda obs, t: flight["u"][t][None], end_time)
    np.testing.assert_allclose(again["y"], flight["y"], rtol=1e-12, atol=1e-9)


# --- observations -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", [FIXED, LEO])
def test_observation(env_id):
    v = VEHICLES[env_id]
    u = v.reference(False)[0]
    seen, rewards, final = fly(make(env_id), lambda obs, t: u[t])
    hidden, hidden_rewards, _ = fly(make(env_id, observe_phase=False), lambda obs, t: u[t])
    phase = np.where(v.grid < 162, 0.0, 1.0)
    if v is PAPER:
        phase = np.select([v.grid < 75.2, v.grid < 150.4, v.grid < 261], [0, 1 / 3, 2 / 3], 1.0)
    np.testing.assert_allclose(seen[:-1, 7], 1 - v.grid[: len(rewards)] / v.end, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(seen[:, 8], phase[: len(seen)])
    assert seen[0, 7] == 1 and seen.shape[1] == 9
    assert (seen[-1, 7] == 0) == (env_id == v.fixed) and seen[-1, 7] < seen[-2, 7]
    assert not hidden[:, 7:].any()
    np.testing.assert_array_equal(hidden[:, :7], seen[:, :7])
    np.testing.assert_array_equal(hidden_rewards, rewards)


def hostile(v, obs, t):
    """Directions (12, 3) by (up, along, across): what drives a rocket high, fast, down, or anywhere."""
    forward = {n: v.up_along_cross(obs[n]) @ unit(obs[n, 3:6]) for n in (5, 10)}
    rng = np.random.default_rng(t)
    safe, part = v.programme(2 * t), 2 * t / v.end
    late = part > 400 / 961
    return np.array([
        [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [-1, 0, 0], forward[5], rng.normal(size=3) + [1, 0, 0],
        rng.normal(size=3), [-1, 0, 0] if part > 0.21 else [1, 0, 0], [-1, 0, 0] if late else safe,
        -forward[10] if late else safe, [-1, 0.3, 0] if part > 0.83 else safe,
    ])  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("env_id, table_isp", [(FIXED, False), (LEO_FIXED, True)])
def test_every_observation_lies_in_the_space(env_id, table_isp):
    v = VEHICLES[env_id]
    envs = make(env_id, 12, action_frame="local", table_isp=table_isp)
    space, crashes = envs.single_observation_space, np.zeros(12, dtype=int)
    assert np.isfinite(space.low).all() and np.isfinite(space.high).all() and space.dtype == np.float64
    obs, _ = envs.reset()
    with np.errstate(invalid="raise", over="raise", divide="raise"):
        for t in range(v.steps + 9):
            assert envs.observation_space.contains(obs)
            obs, rewards, terminated, _, info = envs.step(hostile(v, obs, t))
            assert np.isfinite(rewards).all()
            if terminated.any():
                assert np.isin(info["final_obs"][:, 8], [0, 1 / 3, 2 / 3, 1] if v is PAPER else [0, 1]).all()
                assert envs.observation_space.contains(info["final_obs"])
                assert all(np.isfinite(each).all() for each in info["final_info"].values())
                crashed = info["final_info"]["crashed"] & terminated
                altitude = np.linalg.norm(info["final_obs"][:, :3], axis=1) - RE
                np.testing.assert_array_equal(crashed, terminated & (altitude < 0))
                crashes += crashed
    assert crashes[[1, 2, 3, 4, 7, 8, 9]].all() and not crashes[0]


@pytest.mark.parametrize("angle", [-10, -30, -60])
def test_plunge_at_orbital_speed_agrees_with_scipy(angle):
    v = PAPER
    up, along, _ = v.up_along_cross(v.start)
    path = math.cos(math.radians(angle)) * along + math.sin(math.radians(angle)) * up
    state = np.array([*(RE + 70e3) * up, *7800 * path, 12000.0])
    envs, step = make(v.fixed), 300
    envs.reset()
    envs.unwrapped.y[:, 0] = state
    envs.unwrapped.t[:] = step
    slowest, terminated = 7800.0, [False]
    while not terminated[0]:
        obs, _, terminated, _, info = envs.step([-up])
        expected = v.integrate(state, 2.0 * step, 2.0 * step + 2, -up)
        if not terminated[0]:
            slowest = min(slowest, np.linalg.norm(obs[0, 3:6]))
            miss = np.abs(obs[0, :7] - expected)
            assert miss[:3].max() < 5 and miss[3:6].max() < 1 and miss[6] < 1e-6, (step, miss)
        state, step = obs[0, :7], step + 1
    final = info["final_info"]
    assert final["crashed"][0] and slowest < 4000 and np.isfinite(info["final_obs"]).all()
    assert envs.single_observation_space.contains(info["final_obs"][0])
    assert np.linalg.norm(info["final_obs"][0, 3:6]) < 7900


# --- the cut-off ------------------------------------------------------------------------------------------------------


@both
def test_cutoff_of_many_flights_is_exact(v):
    envs, rng = make(v.cutoff, 64, action_frame="local"), np.random.default_rng(6)
    bias, running = rng.normal(scale=0.01, size=(64, 3)), np.ones(64, dtype=bool)
    cuts = 0
    envs.reset()
    for t in range(v.steps):
        obs, _, terminated, _, info = envs.step(v.programme(2 * t) + bias)
        if terminated.any():
            final = info["final_info"]
            for n in np.flatnonzero(terminated & running & (t < v.steps - 1)):
                assert energy(info["final_obs"][n]) == pytest.approx(v.goal_energy, rel=1e-10)
                assert abs(final["a_km"][n] * 1e3 - v.goal[0]) < 1.0
                time = final["final_time_s"][n]
                assert 2 * t < time <= 2 * t + 2
                assert info["final_obs"][n, 6] == pytest.approx(v.dry_mass + v.last_flow * (v.end - time), abs=1e-6)
                assert info["final_obs"][n, 7] == pytest.approx(1 - time / v.end, abs=1e-12)
                cuts += 1
            running &= ~terminated
        assert all(energy(s) < v.goal_energy for s in obs[running]), "none goes on with more than the target's energy"
    assert cuts > 50


@both
def test_nothing_is_cut_before_the_last_phase(v, monkeypatch):
    a, reached = (3.5e6, 100) if v is PAPER else (3.4e6, 80)  # its energy is reached long before: by this step
    monkeypatch.setattr(Rocket, "target_energy", -MU / (2 * a))
    envs = [make(env_id, action_frame="local") for env_id in (v.cutoff, v.fixed)]
    cut, whole = [fly(each, lambda obs, t: v.programme(2 * t)) for each in envs]
    assert energy(whole[0][reached]) > -MU / (2 * a), "reached before the last phase"
    assert v.last_ignition <= cut[2]["final_time_s"] < v.last_ignition + 3 and whole[2]["final_time_s"] == v.end


# --- batch and autoreset ----------------------------------------------------------------------------------------------


def mixed(v, t, n, episode):
    """Environment n's direction: cut off, crash early (each second time earlier), go on to the end, crash late."""
    early_dive = [-1.0, 1.0, 0.0] if t > (20, 12)[episode % 2] else [1.0, 0.0, 0.0]
    late_dive = [-1.0, 0.0, 0.1] if t > v.steps // 3 else v.programme(2 * t)
    return np.array([v.programme(2 * t), early_dive, [1.0, 0.01, 0.0], late_dive][n])


@pytest.mark.slow
def test_single_environment_is_the_vector_environment():
    """Over the first episodes' ends into the next ones; the singles' next episode is flown by new environments."""
    v = PAPER
    options, steps = {"action_frame": "local", "table_isp": True}, v.steps + 39
    envs = make(v.cutoff, 4, **options)
    obs, _ = envs.reset()
    singles, clock, start = [single(v.cutoff, **options) for _ in range(4)], np.zeros(4, dtype=int), obs[0]
    sums, ends = np.zeros(4), [[] for _ in range(4)]
    for n, env in enumerate(singles):
        np.testing.assert_array_equal(env.reset()[0], obs[n])
    for _ in range(steps):
        actions = np.array([mixed(v, t, n, len(ends[n])) for n, t in enumerate(clock)])
        obs, rewards, terminated, truncated, info = envs.step(actions)
        clock += 1
        assert not truncated.any() and terminated.any() == bool(info)
        if info:
            for flag in (info["_final_obs"], info["_final_info"], info["final_info"]["_error"]):
                np.testing.assert_array_equal(flag, terminated)
        for n in range(4):
            single_obs, reward, ended, cut, single_info = singles[n].step(actions[n])
            sums[n] += reward
            assert (reward, ended, cut) == (pytest.approx(rewards[n], rel=0, abs=1e-9), terminated[n], False)
            # a matrix product in the local frame may round by the batch's size, hence not to the bit
            np.testing.assert_allclose(single_obs, (info["final_obs"] if ended else obs)[n], rtol=1e-12, atol=1e-8)
            assert set(single_info) == (KEYS if ended else set())
            for key, value in single_info.items():
                np.testing.assert_allclose(info["final_info"][key][n], value, rtol=1e-10, atol=1e-9, err_msg=key)
            if ended:
                np.testing.assert_array_equal(obs[n], start)
                assert single_info["episodic_return"] == pytest.approx(sums[n], rel=1e-12, abs=1e-10)
                ends[n].append(single_info)
                singles[n], clock[n], sums[n] = single(v.cutoff, **options), 0, 0.0
                singles[n].reset()
    cut_off, early, to_the_end, late = (end[0] for end in ends)
    assert cut_off["final_time_s"] < v.end == to_the_end["final_time_s"] and early["crashed"] and late["crashed"]
    heights = [end["max_altitude_km"] for end in ends[1]]
    assert len(heights) > 2 and heights[1] < heights[0], "nothing of the one before"


def advance_from(env_id, states, t, actions):
    envs = make(env_id, len(states))
    envs.reset()
    envs.unwrapped.y[:], envs.unwrapped.t[:] = np.array(states).T, t
    return envs.unwrapped.advance(np.array(actions))


@both
def test_a_row_of_a_batch_is_a_batch_of_one(v):
    u, y, (time, _) = v.reference(False)
    last, rng = int(time // 2), np.random.default_rng(8)
    actions = u[last] + rng.normal(scale=0.5, size=(200, 3))
    states = np.repeat(y[last][None], 200, axis=0)
    states[:, 3:6] *= 1 + rng.uniform(-2e-5, 2e-5, (200, 1))
    obs, _, terminated, final = advance_from(v.cutoff, states, last, actions)
    cut = np.flatnonzero(terminated)
    assert len(cut) > 50
    for n in [*cut[:10], *np.flatnonzero(~terminated)[:3]]:
        one, _, _, one_final = advance_from(v.cutoff, states[n : n + 1], last, actions[n : n + 1])
        np.testing.assert_array_equal(one[0], obs[n])
        assert not terminated[n] or one_final["final_time_s"][0] == final["final_time_s"][n]


# --- end time ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "v, end_time, steps", [(PAPER, 924.139, 463), (PAPER, 1.0, 1), (PAPER, 75.2, 38), (TWO_STAGE, 163.0, 82)]
)
def test_end_time(v, end_time, steps):
    u, y, _ = v.reference(False)
    env = make(v.fixed, end_time=end_time)
    assert env.unwrapped.episode_steps == steps
    seen, rewards, final = fly(env, lambda obs, t: u[t])
    assert len(rewards) == steps
    obs = seen[-1]
    assert final["final_time_s"] == end_time
    expected = v.integrate(y[steps - 1], 2.0 * steps - 2, end_time, u[steps - 1])
    assert_states_agree(obs[:7], expected)
    assert obs[7] == pytest.approx(1 - end_time / v.end, abs=1e-15)


@pytest.mark.parametrize("v, value", [(PAPER, 0), (PAPER, math.nan), (PAPER, 962), (TWO_STAGE, 555.1)])
def test_bad_end_times_are_refused(v, value):
    for make_env in (lambda: make(v.fixed, 2, end_time=value), lambda: gym.make(v.cutoff, end_time=value)):
        with pytest.raises(BadInput, match=rf"end_time is {value} s; it must be positive and at most {v.end}"):
            make_env()


# --- bad and odd input ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [[0.0, 0.0, 0.0], [-0.0, 0.0, 0.0], [1.0, np.nan, 0.0], [np.inf, 0.0, 0.0],
                                 [0.0, 0.0, -np.inf]])  # fmt: skip
@pytest.mark.parametrize("action_frame", ["eci", "local"])
def test_bad_actions_name_environment_and_step(bad, action_frame):
    envs = make(FIXED, 4, action_frame=action_frame)
    envs.reset()
    good = np.tile([1.0, 0.0, 0.5], (4, 1))
    first = envs.step(good)[0]
    actions = good.copy()
    actions[2] = bad
    with pytest.raises(ValueError, match="env 2 at step 1 "):
        envs.step(actions)
    np.testing.assert_array_equal(envs.unwrapped.y.T, first[:, :7])
    env = gym.make(FIXED, action_frame=action_frame)
    env.reset()
    with pytest.raises(ValueError, match="env 0 at step 0 "):
        env.step(np.array(bad))


@pytest.mark.parametrize("action_frame", ["eci", "local"])
def test_only_the_direction_of_an_action_counts(action_frame):
    lengths = np.array([1.0, 1e-320, 1e-300, 1e300, 1.7e308, 7.0])
    envs = make(FIXED, len(lengths), action_frame=action_frame)
    envs.reset()
    for direction in ([1.0, 1.0, 1.0], [0.0, 1.0, 0.0], [1.0, -1.0, 0.0]):
        with np.errstate(over="raise", invalid="raise", divide="raise"):
            obs = envs.step(lengths[:, None] * direction)[0]
        np.testing.assert_allclose(obs, [obs[0]] * len(lengths), rtol=1e-15, atol=1e-9)
    expected = np.array([1.0, -1.0, 0.0]) / math.sqrt(2)
    if action_frame == "eci":
        np.testing.assert_allclose(envs.unwrapped.u.T, [expected] * len(lengths), atol=1e-15)
    with_zeros = make(FIXED).unwrapped
    with_zeros.reset()
    with_zeros.step([[1e300, 1e-320, -0.0]])
    np.testing.assert_array_equal(with_zeros.u[:, 0], [1, 0, 0])


def test_other_bad_input_is_refused():
    for maker in (make, gym.make):
        with pytest.raises(ValueError, match="action_frame is 'ned'; it must be one of eci, local"):
            maker(FIXED, action_frame="ned")
    with pytest.raises(ValueError, match="reset options"):
        make(FIXED).reset(options={"x0": np.zeros((1, 7))})
    with pytest.raises(ValueError, match="reset options"):
        gym.make(FIXED).reset(options={"x0": np.zeros(7)})
    make(FIXED).reset(options={})
    envs = make(FIXED, 2)
    envs.reset()
    with pytest.raises(ValueError, match=r"shape \(3,\); expected \(2, 3\)"):
        envs.step(np.ones(3))
    with pytest.raises(ValueError, match="num_envs is 0"):
        RocketVectorEnv(0)


# --- the gymnasium interface ------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("env_id", [CUTOFF, LEO])
def test_check_env(env_id):
    env = gym.make(env_id)
    assert env.spec.max_episode_steps is None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    assert not [str(w.message) for w in caught if "symmetric and normalized" not in str(w.message)]
