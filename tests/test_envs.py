"""envs.py against the paper's tables (typed once more here), exact discretisation, SciPy's integrator, and itself.

What holds for every problem in the plane is asked of every one in `PROBLEMS`, also that `x_max` bounds what can be
reached.
"""

import math
import warnings
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from envs import PROBLEMS, BadInput, PhasedVectorEnv, fly

# The paper's tables, a phase a row: steps, target, radius, R, terminal weight, bonus. Q is the identity throughout.
PAPER = {
    "DoubleIntegrator-v0": (4.0, [(50, (0.0, 0.0), 0.05, 0.1, 20.0, 20.0)]),
    "DoubleIntegratorWaypoints-v0": (
        3.0,
        [(50, (0.0, 0.0), 0.02, 0.1, 20.0, 20.0), (50, (0.5, 0.5), 0.02, 0.1, 30.0, 20.0)],
    ),
    "VanDerPol-v0": (1.5, [(70, (0.0, 0.0), 0.05, 1.0, 20.0, 20.0)]),
    "VanDerPolWaypoints-v0": (
        1.5,
        [
            (50, (0.0, 0.0), 0.05, 0.005, 25.0, 25.0),
            (40, (0.2, 0.2), 0.05, 0.005, 30.0, 30.0),
            (50, (0.5, 0.5), 0.05, 0.01, 40.0, 40.0),
        ],
    ),
}
IDS = list(PAPER)


def columns(problem):
    """The table of another problem, whose numbers are its own."""
    names = ("steps", "target", "radius", "R", "Qf", "bonus")
    return problem.u_max, [tuple(getattr(phase, name) for name in names) for phase in problem.phases]


# tables of two states, one control and costs by weights; others are tested in test_problems.py
PLANE = {
    env_id: problem
    for env_id, problem in PROBLEMS.items()
    if problem.weighted and problem.states == 2 and problem.controls == 1 and not problem.has_events
}
TABLES = {env_id: PAPER[env_id] if env_id in PAPER else columns(problem) for env_id, problem in PLANE.items()}
WAYPOINT_IDS = [env_id for env_id in TABLES if len(TABLES[env_id][1]) > 1]
KINDS = ["DoubleIntegrator-v0", "VanDerPolWaypoints-v0"]  # the tables differ, the code is the same
CORNERS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])


def paper_episode(env_id, x, u):
    """Rewards, cost parts (state, control, terminal), bonus, hits and distances of one episode, by plain loops."""
    rewards, parts, bonus, hits, distances, t = [], [0.0, 0.0, 0.0], 0.0, [], [], 0
    for steps, target, radius, R, Qf, B in PAPER[env_id][1]:
        for _ in range(steps):
            state = (x[t][0] - target[0]) ** 2 + (x[t][1] - target[1]) ** 2
            control = R * u[t] ** 2
            parts[0] += state
            parts[1] += control
            rewards.append(-state - control)
            t += 1
        distance = math.sqrt((x[t][0] - target[0]) ** 2 + (x[t][1] - target[1]) ** 2)
        hit = distance <= radius
        parts[2] += Qf * distance**2
        rewards[-1] += -Qf * distance**2 + (B if hit else 0.0)
        bonus += B if hit else 0.0
        hits.append(hit)
        distances.append(distance)
    return rewards, parts, bonus, hits, distances


def horizon(env_id):
    return sum(phase[0] for phase in TABLES[env_id][1])


def random_actions(env_id, num_envs, seed=0):
    """Actions (T, N, 1), a third of them beyond the bound."""
    u_max = TABLES[env_id][0]
    return np.random.default_rng(seed).uniform(-1.5 * u_max, 1.5 * u_max, (horizon(env_id), num_envs, 1))


def steer(env_id):
    """A feedback along lines that pass each target, with its velocity, at its phase's end: it pays some bonuses."""
    position, velocity = [], []
    for steps, target, *_ in PAPER[env_id][1]:
        position += [target[0] - 0.1 * (steps - step) * target[1] for step in range(steps)]
        velocity += [target[1]] * steps
    spring = 1.0 if "VanDerPol" in env_id else 0.0
    return lambda obs, t: (
        spring * obs[:, 0] - 4.0 * (obs[:, 0] - position[t]) - 3.0 * (obs[:, 1] - velocity[t])
    )[:, None]  # fmt: skip


# --- dynamics ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", IDS[:2])
def test_double_integrator_step_is_the_exact_discretisation(env_id):
    x0 = np.random.default_rng(1).uniform(-2, 2, (50, 2))
    u = np.random.default_rng(2).uniform(-3, 3, (50, 1))
    envs = gym.make_vec(env_id, num_envs=50)
    envs.reset(options={"x0": x0})
    obs = envs.step(u)[0]
    exponential = expm(0.1 * np.array([[0, 1, 0], [0, 0, 1], [0, 0, 0]]))  # of the state, extended by the held control
    expected = x0 @ exponential[:2, :2].T + u @ exponential[:2, 2:].T
    np.testing.assert_allclose(obs[:, :2], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("env_id", IDS[2:])
def test_van_der_pol_step_agrees_with_scipy(env_id):
    x0 = np.random.default_rng(3).uniform(-1.5, 1.5, (50, 2))
    u = np.random.default_rng(4).uniform(-1.5, 1.5, (50, 1))
    envs = gym.make_vec(env_id, num_envs=50)
    envs.reset(options={"x0": x0})
    obs = envs.step(u)[0]

    def derivative(t, x, control):
        return [x[1], -x[0] + 0.1 * (1 - x[0] ** 2) * x[1] + control]

    for start, control, got in zip(x0, u[:, 0], obs[:, :2]):
        exact = solve_ivp(derivative, (0, 0.1), start, "DOP853", rtol=1e-12, atol=1e-12, args=(control,)).y[:, -1]
        np.testing.assert_allclose(got, exact, rtol=0, atol=1e-6)


# --- rewards and costs ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", IDS)
def test_rewards_are_the_papers(env_id):
    x0, policy = np.random.default_rng(5).uniform(-1, 1, (20, 2)), steer(env_id)
    drifts = np.append(np.zeros(19), 1)[:, None]  # the last start gets no control, and misses
    flight = fly(env_id, lambda obs, t: (1 - drifts) * policy(obs, t), x0)
    assert np.abs(flight["u"]).max() == PAPER[env_id][0], "the steering should saturate somewhere"
    for n in range(len(x0)):
        rewards, parts, bonus, hits, distances = paper_episode(env_id, flight["x"][n], flight["u"][n])
        np.testing.assert_allclose(flight["reward"][n], rewards, rtol=1e-12, atol=1e-12)
        got = [flight[key][n] for key in ("cost_state", "cost_control", "cost_terminal")]
        np.testing.assert_allclose(got, parts, rtol=1e-12)
        assert flight["cost"][n] == pytest.approx(sum(parts), rel=1e-12)
        assert flight["reward"][n].sum() == pytest.approx(bonus - sum(parts), rel=1e-12)
        assert flight["episodic_return"][n] == pytest.approx(bonus - sum(parts), rel=1e-12)
        assert flight["hit"][n].tolist() == hits
        np.testing.assert_allclose(flight["terminal_error"][n], distances, rtol=1e-12)
    assert flight["hit"].any(axis=0).all() and not flight["hit"].all(axis=0).any(), "both outcomes should occur"


def returns_with(env_id, name, values):
    """Sums of rewards (3,) of the same flights with each value handed over, and the `final_info` of the first.

    What is reported must be the same to the bit with all of them.
    """
    actions, sums, finals = random_actions(env_id, 3), [], []
    for value in values:
        envs = gym.make_vec(env_id, num_envs=3)
        envs.reset(options={"x0": CORNERS[:3], "training": {name: value}})
        steps = [envs.step(action) for action in actions]
        sums.append(sum(step[1] for step in steps))
        finals.append(steps[-1][4]["final_info"])
    for final in finals[1:]:
        for key, reported in final.items():
            np.testing.assert_array_equal(reported, finals[0][key])
    return sums, finals[0]


@pytest.mark.parametrize("env_id", IDS)
def test_radius_scale_changes_only_the_reward(env_id):
    bonuses = [phase[5] for phase in PAPER[env_id][1]]
    sums, final = returns_with(env_id, "radius_scale", (1.0, 1e4))
    assert not final["hit"].any()
    np.testing.assert_allclose(sums[1] - sums[0], sum(bonuses))


@pytest.mark.parametrize("env_id", IDS)
def test_bonus_falls_to_nothing_over_its_width(env_id):
    """From the whole bonus on the circle to none a width beyond it, in proportion; what is reported stays."""
    sums, final = returns_with(env_id, "bonus_width", (0.0, 1e-9, 20.0, 1e9))
    radii, bonuses = np.array([[phase[2], phase[5]] for phase in PAPER[env_id][1]]).T
    beyond = final["terminal_error"] - radii
    assert (beyond > 0).all() and (beyond < 20).any()
    np.testing.assert_allclose(sums[1], sums[0])
    np.testing.assert_allclose(sums[2] - sums[0], (bonuses * np.maximum(1 - beyond / 20, 0)).sum(axis=1), atol=1e-9)
    np.testing.assert_allclose(sums[3] - sums[0], bonuses.sum(), rtol=1e-6)


@pytest.mark.parametrize("env_id, name", [("VanDerPol-v0", "radius_scale"), ("MarsLanding-v0", "edge_starts")])
def test_what_a_training_hands_over_is_no_attribute(env_id, name):
    """Assigning it would do nothing, so it is refused."""
    for env in (gym.make(env_id).unwrapped, gym.make_vec(env_id, num_envs=2).unwrapped):
        with pytest.raises(AttributeError, match=f"no attribute '{name}'; a training hands it over by reset"):
            setattr(env, name, 0.5)


@pytest.mark.parametrize("env_id, name", [("RocketAscent-v0", "end_time"), ("MarsLanding-v0", "decision_s")])
def test_what_is_set_when_an_environment_is_made_cannot_be_assigned(env_id, name):
    for env in (gym.make(env_id).unwrapped, gym.make_vec(env_id, num_envs=2).unwrapped):
        with pytest.raises(AttributeError, match=f"^{name} of .* make another one with {name}="):
            setattr(env, name, 0.4)


@pytest.mark.parametrize("name, value", [("radius_scale", [1.0, 2.0]), ("radius_scale", "2"), ("bonus_width", -1.0)])
def test_bad_values_of_a_training_are_refused_at_reset(name, value):
    with pytest.raises(BadInput, match=f"^training's {name} is .*; it must be a number of at least 0"):
        gym.make_vec("VanDerPolWaypoints-v0", num_envs=2).reset(options={"training": {name: value}})


# --- observations -----------------------------------------------------------------------------------------------------


def observations(env_id, **options):
    """Every observation (T+1, obs) of one environment, the last from `final_obs`, and its states (T+1, 2) by `fly`."""
    actions, x0 = random_actions(env_id, 1), [[0.3, -0.4]]
    envs = gym.make_vec(env_id, num_envs=1, **options)
    seen = [envs.reset(options={"x0": x0})[0][0]]
    for action in actions:
        obs, _, terminated, _, info = envs.step(action)
        seen.append(info["final_obs"][0] if terminated[0] else obs[0])
    return np.array(seen), fly(env_id, lambda obs, t: actions[t], x0)["x"][0]


@pytest.mark.parametrize("env_id", ["DoubleIntegrator-v0", "VanDerPol-v0"])
def test_single_phase_observation(env_id):
    obs, x = observations(env_id)
    T = horizon(env_id)
    np.testing.assert_array_equal(obs[:, :2], x)
    np.testing.assert_allclose(obs[:, 2], [t / T for t in range(T + 1)], rtol=1e-15)
    assert obs.shape[1] == 3


@pytest.mark.parametrize(
    "env_id, target, phi",
    [
        (
            "DoubleIntegratorWaypoints-v0",
            [0.0] * 50 + [0.0, 0.1, 0.2, 0.3, 0.4] + [0.5] * 46,
            [0.0] * 50 + [1.0] * 51,
        ),
        (
            "VanDerPolWaypoints-v0",
            [0.0] * 50 + [0.0, 0.04, 0.08, 0.12, 0.16] + [0.2] * 35 + [0.2, 0.26, 0.32, 0.38, 0.44] + [0.5] * 46,
            [0.0] * 50 + [0.5] * 40 + [1.0] * 51,
        ),
    ],
)
def test_waypoint_observation(env_id, target, phi):
    obs, x = observations(env_id)
    T = horizon(env_id)
    np.testing.assert_array_equal(obs[:, :2], x)
    np.testing.assert_allclose(obs[:, 2], target, atol=1e-15)
    np.testing.assert_allclose(obs[:, 3], target, atol=1e-15)
    np.testing.assert_allclose(obs[:, 4], [t / T for t in range(T + 1)], rtol=1e-15)
    np.testing.assert_array_equal(obs[:, 5], phi)


@pytest.mark.parametrize("env_id", KINDS)
def test_hidden_phase_reads_zero(env_id):
    shown, hidden = observations(env_id)[0], observations(env_id, observe_phase=False)[0]
    clock = slice(-2, None) if env_id in WAYPOINT_IDS else slice(-1, None)
    assert shown[1:, clock].any() and not hidden[:, clock].any()
    shown[:, clock] = 0
    np.testing.assert_array_equal(hidden, shown)


@pytest.mark.parametrize("env_id", KINDS)
def test_hidden_velocity_reads_zero_and_flies_on(env_id):
    """What is hidden is hidden from the policy alone: flights record the true velocity and cost the same."""
    (shown, _), (hidden, _) = observations(env_id), observations(env_id, observe_velocity=False)
    assert shown[1:, 1].any() and not hidden[:, 1].any()
    np.testing.assert_array_equal(np.delete(hidden, 1, axis=1), np.delete(shown, 1, axis=1))
    x0 = np.array([[0.4, -0.7], [-1.0, 0.3]])
    push = lambda obs, t: np.full((2, 1), math.sin(t))  # noqa: E731
    open_eyes, blind = fly(env_id, push, x0), fly(env_id, push, x0, observe_velocity=False)
    assert open_eyes.keys() == blind.keys() and blind["x"][:, :, 1].any(axis=1).all()
    for key in open_eyes:
        np.testing.assert_array_equal(open_eyes[key], blind[key])


@pytest.mark.parametrize("env_id", PLANE)
def test_observation_space_contains_what_the_worst_controls_reach(env_id):
    u_max, envs = TABLES[env_id][0], gym.make_vec(env_id, num_envs=4)
    space = envs.single_observation_space
    assert np.isfinite(space.low).all() and np.isfinite(space.high).all()
    assert space.shape[0] == (6 if env_id in WAYPOINT_IDS else 3) and space.dtype == np.float64
    pushes = {
        "right": lambda obs: np.full((4, 1), u_max),
        "left": lambda obs: np.full((4, 1), -u_max),
        "pump": lambda obs: u_max * np.where(obs[:, 1:2] >= 0, 1.0, -1.0),  # along the velocity: adds most energy
    }
    for name, push in pushes.items():
        obs = envs.reset(options={"x0": PROBLEMS[env_id].x0_max * CORNERS})[0]
        for _ in range(horizon(env_id)):
            assert all(space.contains(row) for row in obs), (name, obs)
            obs, _, _, _, info = envs.step(push(obs))
        assert all(space.contains(row) for row in info["final_obs"]), (name, info["final_obs"])


# --- the gymnasium interface ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", KINDS)
def test_check_env(env_id):
    env = gym.make(env_id)
    assert env.spec.max_episode_steps is None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    unexpected = [str(w.message) for w in caught if "symmetric and normalized" not in str(w.message)]
    assert not unexpected


def test_waypoints_at_rest_have_a_box_with_a_width(new_problem):
    """All velocities 0: Gymnasium warns of bounds that are equal."""
    phases = tuple(replace(phase, target=(phase.target[0], 0.0)) for phase in PROBLEMS["VanDerPolWaypoints-v0"].phases)
    env_id = new_problem(replace(PROBLEMS["VanDerPolWaypoints-v0"], env_id="AtRest-v0", phases=phases))
    space = gym.make_vec(env_id, num_envs=1).single_observation_space
    assert (space.low[:4] < space.high[:4]).all() and space.high[2] == 0.5


@pytest.mark.parametrize("env_id", KINDS)
def test_single_environment_is_the_vector_environment(env_id):
    starts, actions = np.random.default_rng(6).uniform(-1, 1, (3, 2)), random_actions(env_id, 3)
    envs, singles = gym.make_vec(env_id, num_envs=3), [gym.make(env_id) for _ in range(3)]
    obs, _ = envs.reset(options={"x0": starts})
    for env, start, row in zip(singles, starts, obs):
        np.testing.assert_array_equal(env.reset(options={"x0": start})[0], row)
    for action in actions:
        obs, rewards, terminated, truncated, info = envs.step(action)
        obs = info.get("final_obs", obs)
        for n, env in enumerate(singles):
            single_obs, reward, ended, cut, single_info = env.step(action[n])
            np.testing.assert_array_equal(single_obs, obs[n])
            assert (reward, ended, cut) == (rewards[n], terminated[n], truncated[n])
            assert set(single_info) == {key for key in info.get("final_info", {}) if not key.startswith("_")}
            for key, value in single_info.items():
                np.testing.assert_array_equal(value, info["final_info"][key][n])
    assert terminated.all() and not truncated.any()


@pytest.mark.parametrize("env_id", KINDS)
def test_steps_outside_an_episode_are_refused(env_id):
    """Before the first reset, after the end, after a refused reset; a refused action ends nothing."""
    env = gym.make(env_id, disable_env_checker=True).unwrapped  # Gymnasium's wrapper refuses the first step by itself
    action = np.zeros(1)
    with pytest.raises(ResetNeeded, match=r"call reset\(\) first"):
        env.step(action)
    for _ in range(2):
        env.reset()
        for t in range(horizon(env_id)):
            with pytest.raises(ValueError, match="must be finite"):
                env.step([math.nan])
            assert env.step(action)[2] == (t == horizon(env_id) - 1)
        for _ in range(2):
            with pytest.raises(ResetNeeded, match="again after an episode has ended"):
                env.step(action)
    env.reset()
    with pytest.raises(ValueError, match="x0"):
        env.reset(options={"x0": [math.nan, 0.0]})
    with pytest.raises(ValueError, match=r"reset options are .*'x1'.*; the only one is 'x0'"):
        env.reset(options={"x1": 0.5})
    with pytest.raises(ResetNeeded):
        env.step(action)


@pytest.mark.parametrize("env_id", KINDS)
def test_row_of_a_large_batch_is_a_batch_of_one(env_id):
    starts, actions = np.random.default_rng(7).uniform(-1, 1, (1000, 2)), random_actions(env_id, 1000)
    large = fly(env_id, lambda obs, t: actions[t], starts)
    for n in (0, 123, 999):
        one = fly(env_id, lambda obs, t, n=n: actions[t, n : n + 1], starts[n : n + 1])
        for key, value in one.items():
            np.testing.assert_array_equal(value[0], large[key][n])


@pytest.mark.parametrize("env_id", KINDS)
def test_autoreset_of_a_batch_out_of_phase(env_id):
    """Environment 1 starts two steps before its end: it must restart alone, and its next episode count from zero."""
    T, envs = horizon(env_id), gym.make_vec(env_id, num_envs=2)
    actions = np.concatenate([random_actions(env_id, 2, seed) for seed in (0, 1)])
    states, ends, rewards = [envs.reset(seed=0, options={"x0": CORNERS[:2]})[0][:, :2]], {}, []
    batch, last = envs.unwrapped, PROBLEMS[env_id].phases[-1]
    batch.t[1], batch._phase[1], batch._step_in_phase[1] = T - 2, len(batch.problem.phases) - 1, last.steps - 2
    for step in range(T + 2):
        obs, reward, terminated, _, info = envs.step(actions[step])
        states.append(obs[:, :2])
        rewards.append(reward)
        if terminated.any():
            np.testing.assert_array_equal(info["_final_obs"], terminated)
            np.testing.assert_array_equal(info["_final_info"], terminated)
            np.testing.assert_array_equal(info["final_info"]["_hit"], terminated)
            ends[step + 1] = (terminated.tolist(), info)
    assert {step: ended for step, (ended, _) in ends.items()} == {
        2: [False, True], T: [True, False], T + 2: [False, True]
    }  # fmt: skip
    undisturbed = fly(env_id, lambda obs, t: actions[t, :1], CORNERS[:1])
    np.testing.assert_array_equal(np.array(states)[:T, 0], undisturbed["x"][0, :T])
    np.testing.assert_array_equal(np.array(rewards)[:T, 0], undisturbed["reward"][0])
    second = fly(env_id, lambda obs, t: actions[t + 2, 1:], states[2][1:])
    np.testing.assert_array_equal(np.array(rewards)[2:, 1], second["reward"][0])
    np.testing.assert_array_equal(ends[T + 2][1]["final_obs"][1, :2], second["x"][0, -1])
    assert ends[T][1]["final_info"]["cost"][0] == undisturbed["cost"][0]
    assert ends[T + 2][1]["final_info"]["cost"][1] == second["cost"][0]


# --- starts and bad input ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", KINDS)
def test_starts_follow_the_seed(env_id):
    def first_starts(seed):
        envs = gym.make_vec(env_id, num_envs=1000)
        return envs.reset(seed=seed)[0][:, :2], envs.reset()[0][:, :2]

    starts, next_starts = first_starts(1)
    for got, expected in zip(first_starts(1), (starts, next_starts)):
        np.testing.assert_array_equal(got, expected)
    assert not np.array_equal(first_starts(2)[0], starts) and not np.array_equal(next_starts, starts)
    starts = starts / PROBLEMS[env_id].x0_max
    assert np.abs(starts).max() <= 1 and np.abs(starts).max(axis=0).min() > 0.95
    np.testing.assert_allclose(starts.mean(axis=0), 0, atol=0.1)
    single, batch = gym.make(env_id).reset(seed=1)[0], gym.make_vec(env_id, num_envs=1).reset(seed=1)[0]
    np.testing.assert_array_equal(single, batch[0])


@pytest.mark.parametrize("env_id", KINDS)
@pytest.mark.parametrize("num_envs, group, groups", [(6, 2, 3), (7, 3, 3)])
def test_flights_per_start(env_id, num_envs, group, groups):
    """Environment k flies start k // G: the draws of a smaller batch, each G times, at a reset and where all end."""
    envs, few = gym.make_vec(env_id, num_envs=num_envs), gym.make_vec(env_id, num_envs=groups)
    rows = np.arange(num_envs) // group
    actions = random_actions(env_id, num_envs)
    seen, _ = envs.reset(seed=3, options={"training": {"flights_per_start": group}})
    drawn, _ = few.reset(seed=3)
    for _ in range(2):
        np.testing.assert_array_equal(seen, drawn[rows])
        assert len(np.unique(seen[:, 0])) == groups
        for action in actions:
            seen, drawn = envs.step(action)[0], few.step(action[:groups])[0]
    np.testing.assert_array_equal(seen, drawn[rows])
    start = np.random.default_rng(0).uniform(-1, 1, (num_envs, 2))
    np.testing.assert_array_equal(envs.reset(options={"x0": start})[0][:, :2], start)


@pytest.mark.parametrize("x0", [[[0.0, 0.0]], [[0.0, 0.0], [np.nan, 0.0]]])
def test_bad_starts_are_refused(x0):
    with pytest.raises(ValueError, match=r"options\['x0'\] must be finite, of shape \(2, 2\)"):
        gym.make_vec("VanDerPol-v0", num_envs=2).reset(options={"x0": x0})


@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_bad_actions_name_environment_and_step(value):
    envs = gym.make_vec("VanDerPol-v0", num_envs=4)
    envs.reset(seed=0)
    first, *_ = envs.step(np.zeros((4, 1)))
    bad = np.zeros((4, 1))
    bad[2] = value
    with pytest.raises(ValueError, match="env 2 at step 1 "):
        envs.step(bad)
    env = gym.make("VanDerPol-v0")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="env 0 at step 0 "):
        env.step(np.array([value]))


def test_bad_shapes_are_refused():
    envs = gym.make_vec("VanDerPol-v0", num_envs=4)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(4,\); expected \(4, 1\)"):
        envs.step(np.zeros(4))
    with pytest.raises(ValueError, match="num_envs is 0"):
        PhasedVectorEnv(PROBLEMS["VanDerPol-v0"], 0)
