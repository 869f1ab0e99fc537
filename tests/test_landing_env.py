"""The landers' environment against an integrator, printed rows, and flights that can be computed by hand."""

import math

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import envs
from common.errors import BadInput
from landing.environment import PERIOD, fly_lander, limited
from landing.lander import DRAW, MARS, POWERED_DESCENT, Failure, draw_flights
from landing.rewards import has_landed, slope_reward

ID = "MarsLanding-v0"
MIDDLE = np.full((1, len(DRAW)), 0.5)  # the nominal lander in the middle of its box, healthy: 0.5 is not below 0.5


def up(envs, newtons):
    """An action for each environment: so much thrust straight up."""
    return np.tile([0.0, 0.0, newtons / envs.lander.greatest_thrust], (envs.num_envs, 1))


def equation_of_motion(t, y, thrust, g, exhaust):
    return np.concatenate([y[3:6], thrust / y[6] + g, [-np.linalg.norm(thrust) / exhaust]])


# ---------------------------------------------------------------------------------------------------------------------
# Dynamics
# ---------------------------------------------------------------------------------------------------------------------


def test_flights_agree_with_dop853():
    """Random commands, failures in flight: every period's end as another integrator has it, to a millimetre."""
    rng = np.random.default_rng(1)
    draw = rng.random((6, len(DRAW)))
    commands = rng.normal([0.0, 0.0, 0.4], 0.3, (200, 6, 3))
    flown = fly_lander(ID, lambda obs, t: commands[t % 200], draw, failure_probability=1.0, failure_time="random")
    for k in range(6):
        acts = np.isfinite(flown["u"][k, :, 0])
        y = flown["start"][k]
        for u, effectiveness, after in zip(flown["u"][k, acts][:-1], flown["effectiveness"][k], flown["y"][k, 1:]):
            thrust = u * effectiveness
            norm = np.linalg.norm(thrust)
            thrust *= np.clip(norm, 4000, 24000) / norm
            arguments = (thrust, flown["gravity"][k], 210 * 9.81)
            y = solve_ivp(equation_of_motion, (0, 0.2), y, "DOP853", args=arguments, rtol=1e-12, atol=1e-9).y[:, -1]
            assert np.abs(y - after).max() < 1e-3
        assert acts.sum() > 50


def test_an_empty_tank_ends_the_thrust():
    """At full thrust the powered descent's 400 kg last 59 s; from there on it falls with Mars's gravity."""
    batch = gym.make_vec("PoweredDescent-v0", num_envs=1)
    batch.reset(options={"x0": [[0.0, 0.0, 9000.0, 0.0, 0.0, 0.0]]})
    flow = POWERED_DESCENT.greatest_thrust / POWERED_DESCENT.exhaust
    assert 400 / flow == pytest.approx(59.3, abs=0.1)
    for _ in range(320):
        batch.advance(up(batch, 1e6))
    assert batch.mass[0] == 1505.0
    before = batch.v[2, 0]
    batch.advance(up(batch, 1e6))
    assert batch.v[2, 0] - before == pytest.approx(-3.7114 * 0.2, rel=1e-12)


def test_thrust_is_clipped_and_zero_points_up():
    thrust = np.array([[0.0, 1.0, 3e4, 6e3], [0.0, 0.0, 4e4, 0.0], [0.0, 0.0, 0.0, 8e3]])
    clipped = limited(thrust, MARS.least_thrust, MARS.greatest_thrust)
    expected = [[0.0, 4000.0, 14400.0, 6000.0], [0.0, 0.0, 19200.0, 0.0], [4000.0, 0.0, 0.0, 8000.0]]
    assert clipped == pytest.approx(np.array(expected))


# ---------------------------------------------------------------------------------------------------------------------
# Failure
# ---------------------------------------------------------------------------------------------------------------------


def test_a_failure_divides_one_lateral_axis_and_the_vertical_one():
    draw = np.array([[*MIDDLE[0, :10], 0.2, axis, 0.25] for axis in (0.1, 0.9)])
    failure = Failure(0.5, (2.5, 2.5), (1.5, 1.5), "random")
    flown = draw_flights(MARS, draw, failure)
    assert flown.failed.T == pytest.approx(np.array([[0.4, 1.0, 1 / 1.5], [1.0, 0.4, 1 / 1.5]]))
    assert flown.strike == pytest.approx([10.0, 10.0])
    healthy = draw_flights(MARS, draw, failure._replace(probability=0.2))
    assert (healthy.failed == 1).all() and np.isinf(healthy.strike).all()


def test_a_training_draws_the_sizes_of_failures_from_a_range():
    """Uniformly, each apart from the other, and of as many flights along x as along y; a pair is checked."""
    batch = gym.make_vec(ID, num_envs=4000, failure_probability=0.4)
    batch.reset(seed=3, options={"training": {"failure_sizes": (1.0, 3.0), "failure_verticals": (1.0, 1.75)}})
    failed = batch.flights.failed[:, np.isfinite(batch.flights.strike)]
    assert failed.shape[1] / 4000 == pytest.approx(0.4, abs=0.03)
    assert ((failed[0] < 1) != (failed[1] < 1)).all() and (failed[0] < 1).mean() == pytest.approx(0.5, abs=0.05)
    lateral, vertical = 1 / failed[:2].min(axis=0), 1 / failed[2]
    for sizes, greatest in ((lateral, 3.0), (vertical, 1.75)):
        shares = np.histogram(sizes, 4, (1.0, greatest))[0] / len(sizes)
        assert shares == pytest.approx(np.full(4, 0.25), abs=0.045)
    assert abs(np.corrcoef(lateral, vertical)[0, 1]) < 0.08
    for pair in ((3.0, 1.0), (0.5, 2.0), (1.0, np.inf), (1.0,)):
        with pytest.raises(BadInput, match="^training's failure_sizes is .*; it must be two numbers of at least 1"):
            batch.reset(options={"training": {"failure_sizes": pair}})


def test_a_failure_strikes_at_its_moment():
    """The speed gained in each period tells the thrust that acted: full before 10 s, two thirds from there on."""
    draw = MIDDLE.copy()
    draw[0, 10:] = [0.2, 0.1, 0.25]
    batch = gym.make_vec(ID, num_envs=1, failure_time="random")
    batch.reset(options={"draw": draw})
    for period in range(100):
        mass, v = batch.mass[0], batch.v[2, 0]
        batch.advance(up(batch, 9000.0))
        thrust = (batch.mass[0] + mass) / 2 * ((batch.v[2, 0] - v) / PERIOD + 3.7114)
        assert thrust == pytest.approx(9000.0 if period < 50 else 6000.0, rel=1e-6)


def test_half_of_the_flights_fail_with_the_published_probability():
    batch = gym.make_vec(ID, num_envs=4000)
    batch.reset(seed=3)
    has_failed = np.isfinite(batch.flights.strike)
    assert has_failed.mean() == pytest.approx(0.5, abs=0.03)
    assert (batch.flights.failed[0, has_failed] < 1).mean() == pytest.approx(0.5, abs=0.04)
    assert (
        batch.mass.min() >= 1900
        and batch.mass.max() <= 2100
        and batch.mass.std() == pytest.approx(200 / 12**0.5, rel=0.05)
    )


# ---------------------------------------------------------------------------------------------------------------------
# Touchdown
# ---------------------------------------------------------------------------------------------------------------------


def fall(height, speed=0.0, **options):
    """Under the least thrust straight up from a height, in the middle of the box: `final_info`."""
    batch = gym.make_vec(ID, num_envs=1, **options)
    batch.reset(options={"draw": MIDDLE, "x0": [[0.0, 0.0, height, 0.0, 0.0, speed]]})
    while True:
        _, _, ended, final = batch.advance(up(batch, 0.0))
        if ended[0]:
            return {key: value[0] for key, value in final.items()}


def test_the_moment_of_touchdown_is_exact():
    """By the integrator's event: time and speed of a fall that begins 30 m up."""
    ground = lambda t, y, *_: y[2]  # noqa: E731
    ground.terminal = True
    y0, thrust = [0, 0, 30.0, 0, 0, -2.0, 2000.0], np.array([0, 0, 4000.0])
    arguments = (thrust, np.array([0, 0, -3.7114]), 210 * 9.81)
    options = {"events": ground, "rtol": 1e-12, "atol": 1e-12, "args": arguments}
    solution = solve_ivp(equation_of_motion, (0, 60), y0, "DOP853", **options)
    final = fall(30.0, speed=-2.0)
    assert final["final_time"] == pytest.approx(solution.t[-1], abs=1e-9)
    assert final["speed"] == pytest.approx(-solution.y[5, -1], abs=1e-9)
    assert final["position_error"] < 1e-9 and final["down"]


def test_a_dip_below_ground_is_a_touchdown():
    """A thrust that lifts off again within the period touches the ground in between, softly."""
    batch = gym.make_vec(ID, num_envs=1)
    # at 0.01 m, sinking 0.5 m/s, with 24 kN: a = 12 - 3.7, lowest after 0.06 s, 0.015 m lower
    batch.reset(options={"draw": MIDDLE, "x0": [[0.0, 0.0, 0.01, 0.0, 0.0, -0.5]]})
    _, _, ended, final = batch.advance(up(batch, 24000.0))
    deceleration = 24000 / 2000 - 3.7114
    assert ended[0] and final["down"][0]
    assert final["speed"][0] == pytest.approx((0.25 - 2 * deceleration * 0.01) ** 0.5, rel=1e-3)


def test_the_published_end_is_found_later():
    """The published code looks every 0.05 s: the state is that of the first look below ground."""
    exact, published = fall(30.0, speed=-2.0), fall(30.0, speed=-2.0, published_end=True)
    assert published["final_y"][2] < 0
    late = -published["final_y"][2] / published["speed"]
    assert 0 < late < 0.05
    assert late == pytest.approx(0.05 - exact["final_time"] % 0.05, abs=1e-3)


def test_a_flight_that_hovers_ends_at_its_longest_time():
    draw = MIDDLE.copy()
    hover = lambda obs, t: np.array([[0.0, 0.0, 3.7114 * 1900 / 24000]])  # noqa: E731
    flown = fly_lander(ID, hover, draw, longest_flight=20.0)
    assert flown["final_time"][0] == pytest.approx(20.0) and not flown["down"][0] and not flown["landed"][0]


def test_the_slope_is_that_of_the_last_two_metres():
    """Straight down it is endless, and 45 degrees are 1; the published limit asks for 5."""
    batch = gym.make_vec(ID, num_envs=3)
    rows = [[0, 0, 30.0, 0, 0, -5.0], [30.0, 0, 30.0, -5.0, 0, -5.0], [5.0, 0, 30.0, -5 / 6, 0, -5.0]]
    batch.reset(options={"draw": np.repeat(MIDDLE, 3, axis=0), "x0": rows})
    final, ended = {}, np.zeros(3, dtype=bool)
    while not ended.all():
        _, _, ended, final = batch.advance(up(batch, 3.7114 * 2000))
    assert final["slope"][0] > 1e6
    assert final["slope"][1:] == pytest.approx([1.0, 6.0], rel=0.03)  # the lander grows lighter: not quite straight


def test_the_slope_pays_by_doublings():
    """Steeper than 20 : 1 pays nothing more; half as steep costs ln 2 of the price each time, down to 1 : 20."""
    slope = np.array([1e9, 20.0, 10.0, 5.0, 0.05, 0.0])
    assert slope_reward(slope, 2.0) == pytest.approx(-2 * np.log([1.0, 1.0, 2.0, 4.0, 400.0, 400.0]))


def test_training_may_count_the_slope_from_higher_up():
    """On a line at 6 : 1 the slope is the same from any height; from 40 m up it begins where the flight does."""
    slopes = []
    for height in (2.0, 10.0, 40.0):
        batch = gym.make_vec(ID, num_envs=1)
        start = {"draw": MIDDLE, "x0": [[5.0, 0, 30.0, -5 / 6, 0, -5.0]]}
        batch.reset(options={**start, "training": {"slope_height": height}})
        ended = np.zeros(1, dtype=bool)
        sideways = batch.r[0].copy()
        while not ended.all():
            _, _, ended, final = batch.advance(up(batch, 3.7114 * 2000))
        slopes.append(float(final["slope"][0]))
    assert slopes == pytest.approx([6.0, 6.0, 6.0], rel=0.03)
    assert 30.0 / (sideways - final["final_y"][0, 0]) == pytest.approx(slopes[2])


# ---------------------------------------------------------------------------------------------------------------------
# Decisions, observations, input
# ---------------------------------------------------------------------------------------------------------------------


def test_a_longer_decision_is_a_repeated_command():
    draw = np.random.default_rng(5).random((8, len(DRAW)))
    commands = np.random.default_rng(6).normal([0, 0, 0.35], 0.1, (60, 8, 3))
    options = {"failure_time": "random"}
    slow = gym.make_vec(ID, num_envs=8, decision_s=1.0, **options)
    fast = gym.make_vec(ID, num_envs=8, **options)
    obs, _ = slow.reset(options={"draw": draw})
    fast.reset(options={"draw": draw})
    for t in range(25):
        obs, rewards, _, _ = slow.advance(commands[t])
        others = [fast.advance(commands[t]) for _ in range(5)]
        assert np.array_equal(obs, others[-1][0])
        assert rewards == pytest.approx(sum(other[1] for other in others))


def test_decisions_may_be_handed_over_at_a_reset():
    """Decisions of 1 s are those of an environment made so, and a wrong one changes nothing."""
    draw = np.random.default_rng(7).random((4, len(DRAW)))
    changed, made = gym.make_vec(ID, num_envs=4), gym.make_vec(ID, num_envs=4, decision_s=1.0)
    changed.reset(options={"draw": draw, "training": {"decision_s": 1.0}})
    for seconds in (0.3, 0.0, float("nan")):
        with pytest.raises(BadInput, match="^training's decision_s is .*must be a multiple of 0.2 s"):
            changed.reset(options={"training": {"decision_s": seconds}})
    made.reset(options={"draw": draw})
    assert changed.unwrapped.episode_steps == made.unwrapped.episode_steps == 100
    for _ in range(5):
        assert np.array_equal(changed.advance(up(changed, 9000.0))[0], made.advance(up(made, 9000.0))[0])


def test_training_may_widen_the_starts_along_x_and_y():
    draw = np.random.default_rng(9).random((4, len(DRAW)))
    wide, drawn = gym.make_vec(ID, num_envs=4), gym.make_vec(ID, num_envs=4)
    wide_obs, _ = wide.reset(options={"draw": draw, "training": {"start_spread": 1.5}})
    obs, _ = drawn.reset(options={"draw": draw})
    assert wide_obs[:, 0] - 1000 == pytest.approx(1.5 * (obs[:, 0] - 1000))
    assert wide_obs[:, 1] == pytest.approx(1.5 * obs[:, 1])
    assert wide_obs[:, 3] + 40 == pytest.approx(1.5 * (obs[:, 3] + 40))
    assert wide_obs[:, 4] == pytest.approx(1.5 * obs[:, 4])
    assert np.array_equal(wide_obs[:, [2, 5]], obs[:, [2, 5]])


def test_training_may_draw_more_starts_near_the_edges():
    """By the arcsine law: the shares of a box's ten slices are differences of arcsines, in each direction."""
    batch = gym.make_vec(ID, num_envs=20_000).unwrapped
    batch.reset(seed=1, options={"training": {"edge_starts": True}})
    start, spread = np.array(MARS.start), np.array(MARS.spread)
    places = (np.concatenate([batch.r, batch.v]).T - start) / spread
    slices = np.linspace(-1, 1, 11)
    for place in places.T:
        shares = np.histogram(place, slices)[0] / len(place)
        assert shares == pytest.approx(np.diff(np.arcsin(slices)) / np.pi, abs=0.012)
    assert np.abs(np.corrcoef(places.T) - np.eye(6)).max() < 0.03
    assert batch.mass.std() == pytest.approx(200 / 12**0.5, rel=0.03)  # the mass is uniform as before
    with pytest.raises(BadInput, match="^training's edge_starts is .*must be True or False"):
        batch.reset(options={"training": {"edge_starts": 1}})


def test_the_acceleration_is_the_change_of_the_velocity():
    """By thrust over mean mass and gravity, to the mass's change in a decision. At first it is a nominal free fall."""
    draw = np.random.default_rng(4).random((6, len(DRAW)))
    draw[:3, 10] = 0.1  # half of them have failed
    options = {"observe_acceleration": True, "observe_draw": True, "decision_s": 0.4}
    batch = gym.make_vec(ID, num_envs=6, **options).unwrapped
    obs, _ = batch.reset(options={"draw": draw})
    assert (obs[:, 10:13] == [0.0, 0.0, -3.7114]).all()
    for _ in range(3):
        mass = batch.mass.copy()
        obs, *_ = batch.advance(np.tile([0.1, -0.1, 0.6], (6, 1)))
        thrust = batch.u * batch.effectiveness().T
        expected = thrust / ((mass + batch.mass)[:, None] / 2) + batch.flights.gravity.T
        assert obs[:, 10:13] == pytest.approx(expected, rel=1e-5)
    assert obs[:, 13] == pytest.approx(batch.mass / 2000)
    assert batch.single_observation_space.contains(obs[0]) and len(batch.observation_scale) == obs.shape[1]
    hidden = gym.make_vec(ID, num_envs=6, observe_draw=True)
    assert hidden.reset(options={"draw": draw})[0].shape == (6, 17)


def test_what_is_hidden_and_what_an_oracle_sees():
    draw = np.random.default_rng(2).random((5, len(DRAW)))
    draw[:, 10] = 0.1
    options = {"observe_draw": True, "observe_velocity": False, "observe_phase": False, "observe_command": False}
    batch = gym.make_vec(ID, num_envs=5, **options)
    batch.reset(options={"draw": draw})
    obs, *_ = batch.advance(up(batch, 8000.0))
    assert (obs[:, 3:10] == 0).all()
    assert obs[:, 10] == pytest.approx(batch.mass / 2000)
    assert obs[:, 11:14].T == pytest.approx((batch.flights.gravity - [[0], [0], [-3.7114]]) / 3.7114)
    assert np.array_equal(obs[:, 14:17], batch.effectiveness().T) and (obs[:, 16] == 1 / 1.5).all()
    assert batch.single_observation_space.contains(obs[0])


BAD_OPTIONS = {
    "failure_probability": 1.5,
    "failure_size": 0.5,
    "failure_vertical": 0.5,
    "failure_time": "late",
    "decision_s": 0.3,
    "longest_flight": 200.0,
}


@pytest.mark.parametrize("name", BAD_OPTIONS)
def test_a_bad_option_is_one_line(name):
    with pytest.raises(BadInput, match=f"^{name} is .*must be"):
        gym.make_vec(ID, num_envs=1, **{name: BAD_OPTIONS[name]})


BAD_STARTS = {
    "draw": [np.full((1, 12), 0.5), np.full((1, 13), 1.5), np.full((1, 13), np.nan), "words"],
    "x0": [[[0, 0, -1.0, 0, 0, 0]], [[0, 0, np.inf, 0, 0, 0]], [[0, 0, 1.0]]],
}


@pytest.mark.parametrize("name,value", [(name, value) for name, values in BAD_STARTS.items() for value in values])
def test_a_bad_start_is_one_line(name, value):
    batch = gym.make_vec(ID, num_envs=1)
    with pytest.raises(BadInput, match=f"options\\['{name}'\\] must be"):
        batch.reset(options={name: value})


SLIPS = {
    "mass": {"mass": float("nan")},
    "dry_mass": {"dry_mass": 3000.0},
    "greatest_thrust": {"greatest_thrust": 100.0},
    "cant": {"cant": 95.0},
    "start": {"start": (0.0, 0.0, -5.0, 0.0, 0.0, 0.0)},
    "spread": {"spread": (1.0, 2.0)},
    "mass_spread": {"mass_spread": 1.5},
    "failure_probability": {"failure_probability": -0.1},
}


@pytest.mark.parametrize("name", SLIPS)
def test_a_slip_in_a_lander_is_one_line(name):
    with pytest.raises(BadInput, match=name):
        envs.Lander(**{**vars(MARS), **SLIPS[name]})


def test_an_id_that_is_taken_is_refused():
    with pytest.raises(BadInput, match="MarsLanding-v0"):
        envs.register_lander("MarsLanding-v0", MARS)


# ---------------------------------------------------------------------------------------------------------------------
# Rewards
# ---------------------------------------------------------------------------------------------------------------------


def test_rewards_and_return_by_hand():
    """One flight touches down, one ends in the air: propellant, the last step, and the return with the fixed scales."""
    batch = gym.make_vec(ID, num_envs=2, longest_flight=8.0).unwrapped
    prices = {"fuel_price": 3.0, "aloft_price": 7.0, "slope_price": 1.5}
    scales = {"sink_rate": 0.8, "position_scale": 0.5, "speed_scale": 0.4}
    start = {"draw": np.repeat(MIDDLE, 2, 0), "x0": [[9, 2, 30, -0.8, 0.1, -6], [300, 0, 900, 1, 2, -3]]}
    batch.reset(options={**start, "training": prices | scales})

    def of_miss(r, v, position_scale, speed_scale):
        far, fast = np.linalg.norm(r), np.linalg.norm(v)
        return -math.log(1 + far / position_scale) - math.log(1 + fast / speed_scale) - far / 10 - fast / 2

    ended = np.zeros(2, dtype=bool)
    while not ended.all():
        mass, flies = batch.mass.copy(), ~ended
        _, reward, ended, final = batch.advance(np.tile([0, 0, 0.3], (2, 1)))
        expected = -3 * (mass - batch.mass) / 100
        for k in np.flatnonzero(ended & flies):
            r, v = np.split(final["final_y"][k, :6], 2)
            flat = math.log(max(20 / max(final["slope"][k], 0.05), 1))
            expected[k] += -1.5 * flat if final["down"][k] else -7
            expected[k] += of_miss(r, v + [0, 0, 0.8], 0.5, 0.4)
            as_evaluated = (-2 * flat if final["down"][k] else -10) + of_miss(r, v, 0.1, 0.1)
            assert final["episodic_return"][k] == pytest.approx(as_evaluated - final["fuel_kg"][k] / 100)
        assert reward[flies] == pytest.approx(expected[flies], rel=1e-12)
    assert final["down"].tolist() == [True, False]


def test_a_landing_needs_every_condition():
    good = {"position_error": 4.9, "speed": 1.9, "slope": 5.1, "is_down": True}
    assert has_landed(**good)
    for name, value in (("position_error", 5.1), ("speed", 2.1), ("slope", 4.9), ("is_down", False)):
        assert not has_landed(**good | {name: value}), name


def test_the_published_end_stops_a_flight_that_leaves():
    """500 m farther from the pad than at its least."""
    batch = gym.make_vec(ID, num_envs=1, published_end=True).unwrapped
    batch.reset(options={"draw": MIDDLE, "x0": [[0, 0, 100, 0, 0, 50]]})
    ended = np.zeros(1, dtype=bool)
    while not ended.all():
        _, _, ended, final = batch.advance(np.array([[0.0, 0.0, 1.0]]))
    assert not final["down"][0] and 600 < final["position_error"][0] < 650
