"""Navigation noise: its statistics, what it leaves alone, and the filter against closed forms, SciPy and its own P."""

import copy
import math
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from rocket_oracle import CUTOFF
from scipy.linalg import solve_discrete_are
from scipy.stats import chi2, kstest

import envs
import evaluate
import runs
from common.errors import BadInput
from common.tasks import task_of
from rocket import guidance, kalman
from rocket.metrics import draws, evaluate_dispersed, fly_dispersed
from rocket.navigation import flight_noise

NOISE = (10.0, 0.1)
SIGMAS = np.repeat(NOISE, 3)
UP = [1.0, 0.0, 0.0]


def make(n, noise=NOISE, **options):
    return gym.make_vec(CUTOFF, num_envs=n, navigation_noise=noise, action_frame="local", **options)


def script():
    import ppo_gtrxl_rocket

    return ppo_gtrxl_rocket


def parse(*argv):
    rocket = script()
    return runs.parse_args(rocket, list(argv))[0]


def observed(env, steps, seed=0):
    """Observations and states (steps + 1, n, ...) of a climb."""
    obs, _ = env.reset(seed=seed)
    seen, states = [obs], [env.y.T.copy()]
    for _ in range(steps):
        obs, *_ = env.step([UP] * env.num_envs)
        seen.append(obs)
        states.append(env.y.T.copy())
    return np.array(seen), np.array(states)


# --- the noise --------------------------------------------------------------------------------------------------------


def test_noise_is_white_and_normal_with_the_sizes_given():
    """Kolmogorov and Smirnov against the normal distribution; no correlation in time, of components or of flights."""
    seen, states = observed(make(200, dispersion=1.0), 40)
    scores = (seen[..., :6] - states[..., :6]) / SIGMAS  # (41, 200, 6)
    assert kstest(scores.ravel(), "norm").pvalue > 0.001
    for component in range(6):
        assert scores[..., component].std() == pytest.approx(1, abs=4 / np.sqrt(2 * 41 * 200))
    limit = 5 / np.sqrt(40 * 200 * 6)
    assert abs((scores[1:] * scores[:-1]).mean()) < limit
    assert abs((scores[:, 1:] * scores[:, :-1]).mean()) < limit
    between = np.corrcoef(scores.reshape(-1, 6).T) - np.eye(6)
    assert np.abs(between).max() < 5 / np.sqrt(41 * 200)


def test_only_position_and_velocity_are_noisy_and_the_flight_is_exact():
    """Equal states, rewards, draws and ends with the noise and without."""
    exact, noisy = (make(4, noise, dispersion=1.0) for noise in (None, NOISE))
    pairs = [env.reset(seed=5)[0] for env in (exact, noisy)]
    ends = 0
    for t in range(120):  # up, and down into the ground: other vehicles are drawn
        np.testing.assert_array_equal(exact.y, noisy.y)
        np.testing.assert_array_equal(exact.draw, noisy.draw)
        np.testing.assert_array_equal(pairs[0][:, 6:], pairs[1][:, 6:])
        assert (pairs[0][:, :6] != pairs[1][:, :6]).all()
        action = np.tile([1.0, 0.1, 0.0] if t < 20 else [-1.0, 0.1, 0.0], (4, 1))
        stepped = [env.step(action) for env in (exact, noisy)]
        ends += stepped[0][2].sum()
        pairs = [step[0] for step in stepped]
        np.testing.assert_array_equal(stepped[0][1], stepped[1][1])
        np.testing.assert_array_equal(stepped[0][2], stepped[1][2])
        for name, values in stepped[0][4].get("final_info", {}).items():
            np.testing.assert_array_equal(values, stepped[1][4]["final_info"][name])
        if stepped[0][2].any():
            state = stepped[1][4]["final_info"]["final_y"][stepped[0][2]]
            np.testing.assert_array_equal(state[:, :6], stepped[0][4]["final_obs"][stepped[0][2], :6])
    assert ends >= 4


def test_noise_is_reproducible_by_seed_and_new_in_each_episode():
    env = make(3)
    first, _ = observed(env, 5, seed=1)
    again, _ = observed(env, 5, seed=1)
    np.testing.assert_array_equal(first, again)
    assert (observed(env, 5, seed=2)[0][..., :6] != first[..., :6]).all()
    assert (observed(env, 5, seed=None)[0][..., :6] != first[..., :6]).all()
    np.testing.assert_array_equal(observed(copy.deepcopy(make(3)), 5, seed=1)[0], first)


@pytest.mark.parametrize("off", [0, (0, 0)])
def test_without_noise_no_random_number_is_drawn(off):
    plain, env = gym.make_vec(CUTOFF, num_envs=2, dispersion=1.0), make(2, off, dispersion=1.0)
    assert list(env.generators) == ["envs"] and env.navigation_noise is None
    for one in (plain, env):
        one.reset(seed=3)
    assert plain.np_random.bit_generator.state == env.np_random.bit_generator.state
    assert env.single_observation_space == plain.single_observation_space


def test_noise_that_is_given_is_flown():
    env = make(2)
    scores = np.arange(2 * (env.episode_steps + 1) * 6).reshape(2, -1, 6) / 1000
    obs, _ = env.reset(options={"noise": scores})
    for t in range(3):
        np.testing.assert_allclose(obs[:, :6] - env.y.T[:, :6], SIGMAS * scores[:, t], atol=1e-8)
        obs, *_ = env.step([UP, UP])


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("create", [gym.make, gym.make_vec])
@pytest.mark.parametrize("value", [(-1, 0.1), (10, math.nan), (10,), "10 0.1"])
def test_a_noise_that_cannot_be_is_one_line(create, value):
    message = r"^navigation_noise is .*; it must be two numbers from 0 to 10000, standard deviations in m and m/s$"
    with pytest.raises(BadInput, match=message):
        create(CUTOFF, navigation_noise=value)


@pytest.mark.parametrize(
    "scores, message",
    [
        (
            np.zeros((1, 10, 6)),
            r"is of shape \(1, 10, 6\); it must hold finite numbers, of shape \(1, T, 6\), T at least",
        ),
        (np.zeros((1, 600)), "is of shape"),
        ("noise", "is of shape"),
        (np.full((1, 600, 6), np.nan), "^an entry of .* is nan; it must hold finite numbers"),
    ],
)
def test_given_noise_that_does_not_fit_is_one_line(scores, message):
    with pytest.raises(BadInput, match=message):
        make(1).reset(options={"noise": scores})


def test_options_of_a_reset_that_do_not_fit_are_one_line():
    with pytest.raises(BadInput, match="the only one is 'noise'$"):
        make(1).reset(options={"draw": np.zeros((1, 16))})
    with pytest.raises(BadInput, match="they may be 'draw' and 'noise'$"):
        make(1, dispersion=1.0).reset(options={"x0": 1})
    with pytest.raises(BadInput, match="a rocket has none without targets, dispersion, failure or navigation noise$"):
        make(1, None).reset(options={"noise": np.zeros((1, 600, 6))})


@pytest.mark.parametrize("words", [["10"], ["10", "-1"], ["nan", "1"]])
def test_flags_that_do_not_fit_are_one_line(words):
    with pytest.raises(SystemExit) as refusal:
        parse(f"--env-id={CUTOFF}", "--navigation-noise", *words)
    assert "--navigation-noise" in str(refusal.value) and "\n" not in str(refusal.value)


@pytest.mark.parametrize("words", [["10", "-1"]])
def test_a_command_that_does_not_fit_is_one_line(monkeypatch, tmp_path, words):
    monkeypatch.setattr("sys.argv", ["evaluate.py", "opponents", str(tmp_path), "--navigation-noise", *words])
    with pytest.raises(SystemExit, match="^error: argument --navigation-noise: ") as refusal:
        evaluate.main()
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("words", [["10", "0.1"], ["10 0.1"]])
def test_the_flag_takes_two_numbers(words):
    args = parse(f"--env-id={CUTOFF}", "--navigation-noise", *words)
    assert args.navigation_noise == [10.0, 0.1]
    assert parse(f"--env-id={CUTOFF}").navigation_noise is None


# --- evaluation -------------------------------------------------------------------------------------------------------


def test_an_evaluation_does_not_depend_on_its_batches():
    law = guidance.tvlqr(CUTOFF, by_energy=True)
    ends = [evaluate_dispersed(CUTOFF, law, 2, 6, 1.0, at_once, navigation_noise=NOISE)[1] for at_once in (6, 4)]
    for name, values in ends[0].items():
        np.testing.assert_array_equal(values, ends[1][name])
    energy = (ends[0]["final_y"][:, 3:6] ** 2).sum(axis=1) / 2 - envs.ROCKET.mu / np.linalg.norm(
        ends[0]["final_y"][:, :3], axis=1
    )
    np.testing.assert_allclose(energy, envs.ROCKET.target_energy, rtol=1e-9)  # the cut-off is exact, and so is the end


def test_metrics_have_the_noise_as_their_only_new_keys():
    law = guidance.open_loop(CUTOFF)
    plain, _ = evaluate.evaluate(CUTOFF, law, 2, 10, dispersion=1.0)
    noisy, _ = evaluate.evaluate(CUTOFF, law, 2, 10, dispersion=1.0, navigation_noise=NOISE)
    assert noisy.keys() - plain.keys() == {"navigation_noise_m", "navigation_noise_m_s"}
    changed = {key for key in plain if plain[key] != noisy[key]}
    assert not changed  # an open loop sees nothing
    assert "with a noise of 10 m and 0.1 m/s." in task_of(CUTOFF).table(
        noisy | dict.fromkeys(["seed", "total_updates", "global_step"], 1)
    )


# --- the filter -------------------------------------------------------------------------------------------------------


def test_the_gain_of_a_hidden_acceleration_is_that_of_the_riccati_equation():
    """Position and velocity observed, the acceleration not: SciPy's solution of the discrete equation."""
    dt, stays = 2.0, 0.98
    F = np.array([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, stays]])
    Q, R = np.diag([0.0, 1e-4, 0.05]), np.diag([100.0, 0.01])
    P = np.zeros((1, 3, 3))
    for _ in range(3000):
        before = kalman.predicted_covariance(P, F[None], Q[None])
        gain, P = kalman.corrected(before, R)
    steady = solve_discrete_are(F.T, np.eye(3)[:, :2], Q, R)
    np.testing.assert_allclose(before[0], steady, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(gain[0], steady[:, :2] @ np.linalg.inv(steady[:2, :2] + R), rtol=1e-6, atol=1e-12)


@pytest.fixture(scope="module")
def tracked():
    """Of 60 flights of eval seed 4 behind the filter: errors (steps, n, 6) and covariances (steps, n, 6, 6)."""
    n = 60
    env = gym.make_vec(CUTOFF, num_envs=n, dispersion=1.0, navigation_noise=NOISE)
    noise = flight_noise(4, range(n), env.episode_steps + 1)
    obs, _ = env.reset(options={"draw": draws(envs.ROCKET, 1.0, 4, n), "noise": noise})
    law = kalman.Filtered(guidance.tvlqr(CUTOFF, by_energy=True), CUTOFF, NOISE, 1.0)
    errors, covariances = [], []
    for t in range(440):  # before the first cut-off
        u = law(obs, t)
        errors.append(law.filter.x[:, :6] - env.y.T[:, :6])
        covariances.append(law.filter.P[:, :6, :6])
        obs, *_ = env.step(u)
    return np.array(errors), np.array(covariances)


@pytest.mark.parametrize("begin, end", [(20, 37), (45, 74), (85, 129), (150, 440)])
def test_the_filter_knows_how_far_off_it_is(tracked, begin, end):
    """In every burn: errors weighed by the filter's covariance have the mean 6 of six numbers; less is caution.

    Few estimates are as far off as one in a thousand would be.
    """
    errors, covariances = (values[begin:end] for values in tracked)
    weighed = np.einsum("tni,tnij,tnj->tn", errors, np.linalg.inv(covariances), errors)
    assert 2 < weighed.mean() < 6.6
    assert (weighed > chi2.ppf(0.999, 6)).mean() < 0.006


def test_behind_the_filter_a_law_flies_closer():
    """The LQR by energy on the same draws and noise; without noise it is closer still."""
    z, noise = draws(envs.ROCKET, 1.0, 4, 40), partial(flight_noise, 4, range(40))
    medians = []
    for filtered, options in ((False, {}), (True, {"navigation_noise": NOISE}), (False, {"navigation_noise": NOISE})):
        law = guidance.tvlqr(CUTOFF, by_energy=True)
        law = kalman.Filtered(law, CUTOFF, NOISE, 1.0) if filtered else law
        ends = fly_dispersed(CUTOFF, law, z, 1.0, noise, **options)
        medians.append(np.median(ends["error_norm"]))
    assert medians[0] < medians[1] < medians[2] < 5e-5


def test_noise_is_no_failure(monkeypatch):
    """A measured flow that noise throws off does not make a flight be replanned in every step."""
    z, noise = draws(envs.ROCKET, 1.0, 4, 1), partial(flight_noise, 4, [0])
    counts = []
    for velocity_noise in (0.0, NOISE[1]):
        exhaust = guidance.nominal_exhaust(envs.ROCKET)
        with guidance.Replanning(CUTOFF, 1, exhaust, velocity_noise) as law:
            monkeypatch.setattr(law.workers, "map", lambda f, jobs: [(None, 0.0)] * len(jobs))  # plans are not needed
            fly_dispersed(CUTOFF, law, z, 1.0, noise, navigation_noise=NOISE)
            counts.append(law.failed)
    assert counts[1] < 40 < counts[0]
