"""A hidden loss of thrust in flight, against SciPy with the failing vehicle typed by hand, closed forms, and itself."""

import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from rocket_oracle import CUTOFF, FIXED, LEO, PAPER, between_events

import envs
from envs import ROCKET, ROCKETS, BadInput, fly_rocket
from rocket.dispersion import draw_names
from rocket.metrics import draws

DRAW = draw_names(ROCKET)
SCORES = len(DRAW)
LARGEST = 0.3
# of the paper's engines: how many, thrust (N), flow (kg/s), kg that are dropped with them, s that they burn
ENGINES = [
    (6, 628500, 17010 / 75.2, 6 * 2280, 75.2),
    (3, 628500, 17010 / 75.2, 3 * 2280, 75.2),
    (1, 1083100, 95550 / 261, 8830, 261),
    (1, 110094, 16820 / 700, 0, 700),
]
# the first two run dry, the third crashes, the last is cut off
STRIKES = [(0, 37.3, 0.21), (1, 90.5, 0.3), (2, 61.9, 0.12), (3, 600.1, 0.02)]


def draw_of(group, moment, share, ignition=None):
    """A draw without dispersion whose failure is this one, for the failure 0.3 of the paper's rocket."""
    begins = [0, 75.2, 0, 261][group] if ignition is None else ignition
    z = np.zeros(SCORES + 4)
    z[SCORES:] = 0.2, (group + 0.5) / 4, (moment - begins) / ENGINES[group][4], share / LARGEST
    return z


def typed(group, moment, share):
    """Rows of start, end, thrust, flow and kg dropped of the paper's rocket with a failure: each burn worked out."""
    late = lambda g, end: moment + (end - moment) / (1 - share) if g == group else end  # noqa: E731
    begins, ends = [0.0, 0.0, 0.0, 0.0], [0.0] * 4
    ends[0] = late(0, 75.2)
    begins[1] = ends[0]
    ends[1] = late(1, begins[1] + 75.2)
    ends[2] = late(2, 261.0)
    begins[3] = ends[2]
    ends[3] = late(3, begins[3] + 700.0)
    rows, start = [], 0.0
    for end in sorted({*ends, moment}):
        thrust = flow = dropped = 0.0
        for g, (number, T, rate, dry, _) in enumerate(ENGINES):
            left = 1 - share if g == group and start >= moment else 1.0
            if begins[g] <= start < ends[g]:
                thrust, flow = thrust + number * T * left, flow + number * rate * left
            if end == ends[g]:
                dropped += dry
        rows.append((start, end, thrust, flow, dropped))
        start = end
    return rows


def programme(obs, k):
    return PAPER.programme(2.0 * k)[None]


def make(env_id=CUTOFF, num_envs=1, failure=LARGEST, **options):
    return gym.make_vec(env_id, num_envs=num_envs, failure=failure, action_frame="local", **options)


def episodes(batch, steps, options=None, seed=None):
    """Observations (steps + 1, N, obs) and rewards (steps, N) of the programme."""
    obs, _ = batch.reset(seed=seed, options=options)
    seen, rewards = [obs], []
    for k in range(steps):
        obs, reward, *_ = batch.step(np.repeat(programme(obs, k), batch.num_envs, axis=0))
        seen.append(obs)
        rewards.append(reward)
    return np.array(seen), np.array(rewards)


# --- the flight -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("group, moment, share", STRIKES)
def test_a_failing_flight_agrees_with_scipy(group, moment, share):
    """The steps around the strike and the stagings, some between them, and the cut-off."""
    draw = draw_of(group, moment, share)
    flight = fly_rocket(CUTOFF, programme, draw=draw, failure=LARGEST, action_frame="local")
    rows = typed(group, moment, share)
    np.testing.assert_allclose(flight["failure"], [group, moment, share], rtol=1e-12)
    y, t, u, last = flight["y"], flight["t"], flight["u"], len(flight["u"]) - 1
    near = {int(end // 2) + j for *_, end in [row[:2] for row in rows] for j in (-1, 0, 1)}
    for k in sorted({0, *(near & set(range(last))), *range(5, last, 40)}):
        expected = between_events(rows, PAPER.derivative, y[k], t[k], t[k + 1], (u[k],))
        for part in (slice(0, 3), slice(3, 6), slice(6, 7)):
            miss = np.linalg.norm(y[k + 1, part] - expected[part])
            assert miss < 1e-6 * np.linalg.norm(expected[part]), (k, part)
    if flight["crashed"]:
        return
    if flight["dry"]:
        assert flight["final_time_s"] == pytest.approx(rows[-1][1], rel=1e-13)
        return
    begin, goal = t[last], PAPER.at_goal_energy
    cut, _ = between_events(rows, PAPER.derivative, y[last], begin, begin + 2, (u[last],), events=goal)
    assert cut == pytest.approx(flight["final_time_s"], rel=1e-6)


def test_a_stage_that_loses_a_fifth_at_its_ignition_burns_for_five_quarters():
    draw = np.zeros(SCORES + 4)
    draw[-1] = 0.2 / LARGEST  # which of the burns and when does not matter
    vehicles = envs.draw_vehicles(ROCKET, 0.0, draw[None], LARGEST, "ignition")
    np.testing.assert_allclose(vehicles.failure[:, 0], [3, 261.0, 0.2])
    assert vehicles.burn_out[0] == pytest.approx(261 + 700 * 5 / 4, rel=1e-14)
    assert vehicles.thrust[4, 0] == pytest.approx(0.8 * 110094, rel=1e-14)
    leo = envs.draw_vehicles(ROCKETS[LEO].rocket, 0.0, np.append(np.zeros(12), draw[-4:])[None], LARGEST, "ignition")
    np.testing.assert_allclose(leo.failure[:, 0], [1, 162.0, 0.2])
    assert leo.burn_out[0] == pytest.approx(162 + 393 * 5 / 4, rel=1e-14)


def test_a_drawn_vehicle_loses_a_share_of_its_own_thrust():
    """The moment is a part of the burn as it is drawn, and what was burnt before is its own."""
    z = np.zeros(SCORES + 4)
    z[[DRAW.index("burn_rate_2"), DRAW.index("propellant_2"), DRAW.index("isp_2")]] = 2.0, -1.0, 1.5
    z[SCORES:] = 0.0, 0.6, 0.25, 0.5
    vehicles = envs.draw_vehicles(ROCKET, 1.0, z[None], LARGEST)
    burns = 261 * 0.997 / 1.01
    moment, end = burns / 4, burns / 4 + burns * 3 / 4 / 0.85
    np.testing.assert_allclose(vehicles.failure[:, 0], [2, moment, 0.15], rtol=1e-13)
    assert vehicles.end[-3, 0] == pytest.approx(end, rel=1e-13)
    lost = 0.15 * 1083100 * 1.01 * 1.0045
    healthy = envs.draw_vehicles(ROCKET, 1.0, z[None, :SCORES])
    assert vehicles.thrust[0, 0] == healthy.thrust[0, 0]
    np.testing.assert_allclose(vehicles.thrust[1:4, 0], healthy.thrust[:3, 0] - lost, rtol=1e-13)
    assert vehicles.mass[0] == healthy.mass[0] and vehicles.dry_mass[0] == healthy.dry_mass[0]


# --- vehicles of one's own --------------------------------------------------------------------------------------------


def test_what_is_dropped_early_takes_its_rest_along():
    """Two types burn together and leave when the first of them is empty: the failing one has some left."""
    a = envs.Engine(20e3, 18e3, 2.5e6, 708.0, 50.0)
    b = envs.Engine(30e3, 28e3, 1.5e6, 273.0, 50.0)
    top = envs.Engine(9e3, 8e3, 2e5, 255.0, 100.0)
    both = envs.Burn(50.0, ((1, a), (1, b)), dropped=((1, a), (1, b)))
    rocket = replace(ROCKET, burns=(both, envs.Burn(150.0, ((1, top),))), end_time=150.0)
    z = np.zeros((1, len(envs.draw_names(rocket)) + 4))
    z[0, -4:] = 0.0, 0.4, 0.5, 1.0  # the second of three groups, from 25 s on
    vehicles = envs.draw_vehicles(rocket, 0.0, z, LARGEST)
    np.testing.assert_allclose(vehicles.failure[:, 0], [1, 25.0, 0.3])
    np.testing.assert_allclose(vehicles.end[:3, 0], [25.0, 50.0, 150.0])
    assert vehicles.dropped[:, 0] == pytest.approx([0, 2e3 + 2e3 + 0.3 * 14e3, 0, 0])
    assert vehicles.thrust[1, 0] == pytest.approx(2.5e6 + 0.7 * 1.5e6)


def restart():
    """The built-in two stages whose second burns twice, as docs/rocket.md has them."""
    first, second = ROCKETS[LEO].rocket.burns
    again = envs.Burn(512.0, second.engines), envs.Burn(1112.0, ()), envs.Burn(1155.0, second.engines)
    return replace(ROCKETS[LEO].rocket, burns=(first, *again), payload=15e3, a=6378145.0 + 800e3, end_time=1155.0)


@pytest.mark.parametrize("moment, strike, end", [(0.5, 162 + 196.5, None), (0.95, 1112 + 373.35 - 350, 1155 + 16.45)])
def test_a_stage_that_burns_twice_keeps_its_schedule_and_its_coast(moment, strike, end):
    """It fails once: in its first burn, which ends at its time all the same, or in the second, never in the coast."""
    z = np.zeros((1, 16))
    z[0, 12:] = 0.0, 0.9, moment, 0.5
    vehicles = envs.draw_vehicles(restart(), 0.0, z, LARGEST)
    share = 0.15
    np.testing.assert_allclose(vehicles.failure[:, 0], [1, strike, share])
    burnt = 512 - strike if strike < 512 else 0.0
    spent = 350 - share * burnt if burnt else 350 + (strike - 1112)
    runs_dry = (1112 if burnt else strike) + (393 - spent) / (1 - share)
    assert vehicles.end[-2, 0] == pytest.approx(runs_dry, rel=1e-12)
    np.testing.assert_allclose(vehicles.burn_end[:3, 0], [162, 512, 1112])
    assert (vehicles.thrust[np.flatnonzero(vehicles.burn[:, 0] == 2), 0] == 0).all()


# --- healthy flights --------------------------------------------------------------------------------------------------


def test_a_healthy_flight_is_the_flight_without_failures():
    """To the bit, beside flights that fail; the same seed draws the same vehicles."""
    plain = gym.make_vec(CUTOFF, num_envs=6, dispersion=1, action_frame="local")
    failing = make(num_envs=6, dispersion=1)
    steps = 200
    obs, rewards = episodes(plain, steps, seed=4)
    other, paid = episodes(failing, steps, seed=4)
    scores = plain.draw.shape[1]
    np.testing.assert_array_equal(failing.draw[:, :scores], plain.draw)
    is_healthy = failing.vehicles.failure[0] < 0
    assert 0 < is_healthy.sum() < 6
    np.testing.assert_array_equal(other[:, is_healthy], obs[:, is_healthy])
    np.testing.assert_array_equal(paid[:, is_healthy], rewards[:, is_healthy])
    assert (other[-1, ~is_healthy] != obs[-1, ~is_healthy]).any()


def test_a_draw_of_the_old_width_is_healthy():
    batch = make(num_envs=2, dispersion=1)
    batch.reset(options={"draw": draws(ROCKET, 1.0, 3, 2)})
    assert batch.vehicles.failure.T.tolist() == [[-1, 0, 0]] * 2


def test_nothing_announces_a_failure():
    """Until the strike every observation is the healthy flight's; then the computer's mass still is, to the staging."""
    z = np.array([draw_of(2, 120.0, 0.3), np.zeros(SCORES + 4)])
    z[1, SCORES] = 1.0
    options = {"observe_draw": True}
    seen, _ = episodes(make(num_envs=2, dispersion=1, **options), 125, {"draw": z})
    struck, healthy = seen[:, 0], seen[:, 1]
    assert seen.shape[2] == 9 + SCORES
    np.testing.assert_array_equal(struck[:61], healthy[:61])
    differs = (struck != healthy).any(axis=0)
    assert differs.tolist() == [True] * 6 + [False] * (3 + SCORES)
    true, _ = episodes(make(num_envs=2, observe_mass=True), 125, {"draw": z})
    np.testing.assert_allclose(true[:, 1, 6], healthy[:, 6], rtol=1e-12)
    assert true[125, 0, 6] - true[125, 1, 6] == pytest.approx(0.3 * 95550 / 261 * 130, rel=1e-9)


# --- draws ------------------------------------------------------------------------------------------------------------


def test_statistics_of_the_failures():
    n = 20000
    batch = make(num_envs=n)
    batch.reset(seed=5)
    group, moment, share = batch.vehicles.failure
    has_failed = group >= 0
    sigma = 5 / math.sqrt(n)
    assert has_failed.mean() == pytest.approx(0.5, abs=sigma / 2)
    assert (moment[~has_failed] == 0).all() and (share[~has_failed] == 0).all()
    for g, (begin, seconds) in enumerate([(0, 75.2), (75.2, 75.2), (0, 261), (261, 700)]):
        mine = group == g
        assert mine.mean() == pytest.approx(1 / 8, abs=sigma / 2)
        parts = (moment[mine] - begin) / seconds
        assert 0 <= parts.min() < 0.01 < 0.99 < parts.max() <= 1
        assert parts.mean() == pytest.approx(0.5, abs=5 * 0.29 / math.sqrt(mine.sum()))
        assert parts.std() == pytest.approx(math.sqrt(1 / 12), rel=0.05)
    assert share[has_failed].mean() == pytest.approx(LARGEST / 2, rel=0.02)
    assert 0 <= share.min() and 0.29 < share.max() <= LARGEST


def test_of_two_groups_one_fails():
    batch = make(num_envs=40, dispersion=1)
    batch.reset(seed=3, options={"training": {"flights_per_start": 4}})
    by_group = batch.draw.reshape(10, 4, -1)
    assert (by_group == by_group[:, :1]).all()
    pairs = by_group[:, 0].reshape(5, 2, -1)
    np.testing.assert_array_equal(pairs[:, 0, :SCORES], -pairs[:, 1, :SCORES])
    np.testing.assert_allclose(pairs[:, 0, SCORES:], 1 - pairs[:, 1, SCORES:])
    failed = batch.vehicles.failure[0].reshape(5, 2, 4) >= 0
    assert (failed.sum(axis=1) == 1).all()


# --- the longest flight, spaces, refusals -----------------------------------------------------------------------------


@pytest.mark.parametrize("failure_time", ["random", "ignition"])
def test_the_longest_flight_stays_within_the_space_and_the_steps(failure_time):
    """Never at the target's energy: it burns all, 1000 s of stage 2 and more."""
    batch = make(dispersion=1, failure_time=failure_time)
    largest = batch._largest
    k = int(largest.burn_out.argmax())
    z = np.zeros((1, SCORES + 4))
    z[0, :SCORES] = [-3.0] * 3 + [0.0] * 3 + [3.0] * 7 + [0.0] * 3
    z[0, SCORES:] = 0.0, 0.99, 0.0, 1.0
    steps = batch.episode_steps
    obs, _ = batch.reset(options={"draw": z})
    assert batch.vehicles.burn_out[0] == pytest.approx(largest.burn_out[k], rel=1e-12)
    assert batch.vehicles.burn_out[0] > 1270
    assert batch.episode_steps == steps == math.ceil(largest.burn_out[k] / 2)
    t, final = 0, {}
    while not final:
        assert obs in batch.observation_space
        obs, _, _, final = batch.advance([[1.0, 0.05, 0.4 if t % 2 else -0.4]])
        t += 1
    assert obs in batch.observation_space
    assert t == steps and final["dry"][0] and not final["crashed"][0]
    assert final["final_time_s"][0] == batch.vehicles.burn_out[0]


@pytest.mark.parametrize("create", [gym.make, gym.make_vec])
@pytest.mark.parametrize("value", [-0.01, 0.31, math.nan, "0.1"])
def test_a_failure_that_cannot_be_is_one_line(create, value):
    with pytest.raises(BadInput, match=r"^failure is .*; it must be a number from 0 to 0.3$"):
        create(CUTOFF, failure=value)


@pytest.mark.parametrize("create", [gym.make, gym.make_vec])
def test_options_that_do_not_fit_are_one_line(create):
    with pytest.raises(BadInput, match=r"^failure_time is 'late'; it must be one of random, ignition$"):
        create(CUTOFF, failure=0.1, failure_time="late")
    with pytest.raises(BadInput, match=r"^failure is 0.1; it must be 0 where flights end at a fixed time: [^\n]*$"):
        create(FIXED, failure=0.1)
    create(FIXED, failure=0.0)


@pytest.mark.parametrize(
    "draw, message",
    [
        (np.zeros(SCORES + 3), r"of shape \(1, 19\); it must hold .*\(1, 16\) or \(1, 20\): burn_rate_1, .*, share$"),
        (np.full(SCORES + 4, np.nan), "is nan; it must hold finite numbers"),
        (np.append(np.zeros(SCORES), [0.0, 1.5, 0, 0]), "^failed_group of .* is 1.5; it must be from 0 to 1$"),
        (np.append(np.zeros(SCORES), [-0.1, 0, 0, 0]), "^failure of .* is -0.1; it must be from 0 to 1$"),
    ],
)
def test_bad_draws_are_one_line(draw, message):
    batch = make()
    batch.reset(seed=0)
    before = batch.draw.copy()
    with pytest.raises(BadInput, match=message):
        batch.reset(options={"draw": [draw]})
    np.testing.assert_array_equal(batch.draw, before)
    plain = gym.make_vec(CUTOFF, num_envs=1, dispersion=1)
    with pytest.raises(BadInput, match=r"of shape \(1, 20\); it must hold finite numbers, of shape \(1, 16\): "):
        plain.reset(options={"draw": np.zeros((1, SCORES + 4))})
