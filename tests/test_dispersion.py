"""Rockets that differ from flight to flight, against SciPy's integrator with the drawn vehicle typed once more here,
closed forms of masses and events, and themselves: given against own draws, single against batched.
"""

import math
import warnings
from dataclasses import replace
from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from rocket_oracle import CUTOFF, FIXED, LEO, MU, OMEGA, RE, VEHICLES, between_events, energy

import envs
from envs import ROCKET, ROCKETS, BadInput, fly_rocket
from rocket.dispersion import draw_names
from rocket.vehicle import STAGE_2

IDS = [FIXED, CUTOFF, LEO]
DRAW = draw_names(ROCKET)
LEO_DRAW = ["burn_rate_1", "burn_rate_2", "isp_1", "isp_2", "propellant_1", "propellant_2", "dry_mass_1", "dry_mass_2"]
LEO_DRAW += ["payload", "drag", "wind_east", "wind_north"]

# --- a drawn vehicle, typed once more ---------------------------------------------------------------------------------

SIGMAS = {"burn_rate": 0.005, "isp": 0.003, "propellant": 0.003, "dry_mass": 0.005, "drag": 0.14}
# total mass, propellant, thrust, nominal burn time of the types, in order of ignition
PAPER = [(19290, 17010, 628500, 75.2), (104380, 95550, 1083100, 261.0), (19300, 16820, 110094, 700.0)]
TWO = [(433e3, 411e3, 7.6e6, 162.0), (111.5e3, 107.5e3, 934e3, 393.0)]


def scores(env_id):
    """A draw with nothing zero: scores by name; the last stage lasts shorter than the nominal one."""
    names = LEO_DRAW if env_id == LEO else DRAW
    z = dict(zip(names, np.random.default_rng(3).uniform(0.3, 2.5, len(names)) * (-1.0) ** np.arange(len(names))))
    last = 2 if env_id == LEO else 3
    return z | {f"burn_rate_{last}": 0.9, f"propellant_{last}": -1.1, "burn_rate_1": -1.2, "propellant_1": 1.4}


def typed(env_id, z):
    """Of a draw: mass at lift-off, rows of start, end, thrust, flow and kg dropped, factor on the drag, wind."""
    factor = lambda name, j=None: 1 + SIGMAS[name] * z[name if j is None else f"{name}_{j + 1}"]  # noqa: E731
    engines = []  # of each type: dry mass, load, thrust, flow, burn time
    for j, (total, load, thrust, duration) in enumerate(TWO if env_id == LEO else PAPER):
        b, s, p, d = (factor(name, j) for name in ("burn_rate", "isp", "propellant", "dry_mass"))
        engines.append(((total - load) * d, load * p, thrust * b * s, load / duration * b, duration * p / b))
    payload = (20e3 if env_id == LEO else 4164) + 20 * z["payload"]
    if env_id == LEO:
        (d1, m1, T1, f1, t1), (d2, m2, T2, f2, t2) = engines
        rows = [(0, t1, T1, f1, d1), (t1, t1 + t2, T2, f2, 0), (t1 + t2, math.inf, 0, 0, 0)]
        mass = payload + d1 + m1 + d2 + m2
    else:
        (d1, m1, T1, f1, t1), (d2, m2, T2, f2, t2), (d3, m3, T3, f3, t3) = engines
        rows = [(0, t1, 6 * T1 + T2, 6 * f1 + f2, 6 * d1), (t1, 2 * t1, 3 * T1 + T2, 3 * f1 + f2, 3 * d1)]
        rows += [(2 * t1, t2, T2, f2, d2), (t2, t2 + t3, T3, f3, 0), (t2 + t3, math.inf, 0, 0, 0)]
        mass = payload + 9 * (d1 + m1) + d2 + m2 + d3 + m3
    return mass, rows, factor("drag"), (20 * z["wind_east"], 20 * z["wind_north"])


def integrate(env_id, z, s, begin, end, u, goal=None):
    """State at `end`, by DOP853 between the drawn events; with a goal (time, state) where the energy reaches it."""
    _, rows, *air = typed(env_id, z)
    reached = (lambda t, s, *_: (energy(s) - goal) / 1e6) if goal else None
    return between_events(rows, VEHICLES[env_id].derivative, s, begin, end, (u,), air, reached)


def vector(env_id, z):
    return np.array([z[name] for name in (LEO_DRAW if env_id == LEO else DRAW)])


def changed(name, value):
    z = np.zeros(16)
    z[DRAW.index(name)] = value
    return z


@cache
def flown(env_id, **options):
    """The sensible ascent with the draw of `scores`."""
    pilot = lambda obs, k: VEHICLES[env_id].programme(2.0 * k)[None]  # noqa: E731
    draw = vector(env_id, scores(env_id))
    return fly_rocket(env_id, pilot, draw=draw, dispersion=1, action_frame="local", **options)


def make(env_id, num_envs=1, dispersion=1.0, **options):
    return gym.make_vec(env_id, num_envs=num_envs, dispersion=dispersion, action_frame="local", **options)


def episode(batch, env_id, options=None):
    """One episode of each environment: observations, rewards and the final info of each, by lists over steps."""
    obs, _ = batch.reset(seed=5, options=options)
    seen, rewards, final = [obs], [], {}
    while len(final) < batch.num_envs:
        action = np.tile(VEHICLES[env_id].programme(2.0 * len(rewards)), (batch.num_envs, 1))
        obs, reward, ended, _, info = batch.step(action)
        shown = obs.copy()
        for k in np.flatnonzero(ended):
            shown[k] = info["final_obs"][k]
            final.setdefault(k, {key: value[k] for key, value in info["final_info"].items() if key[0] != "_"})
        seen.append(shown)
        rewards.append(reward)
    return np.array(seen), np.array(rewards), final


# --- the flight -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", IDS)
def test_a_dispersed_flight_agrees_with_scipy(env_id):
    flight, z = flown(env_id), scores(env_id)
    mass, rows, *_ = typed(env_id, z)
    assert flight["y"][0, 6] == pytest.approx(mass, rel=1e-14) and abs(mass - ROCKETS[env_id].rocket.x0[6]) > 50
    y, t, goal = flight["y"][0], flight["t"], -MU / (2 * ROCKETS[env_id].rocket.a)
    assert not flight["crashed"] and (flight["max_altitude_km"] > 120)
    for k, u in enumerate(flight["u"]):
        last = k == len(flight["u"]) - 1
        if last and env_id != FIXED:
            cut, y = integrate(env_id, z, y, t[k], 2.0 * k + 2, u, goal)
            assert cut == pytest.approx(flight["final_time_s"], rel=1e-6)
        else:
            y = integrate(env_id, z, y, t[k], t[k + 1], u)
        for part in (slice(0, 3), slice(3, 6), slice(6, 7)):
            miss = np.linalg.norm(flight["y"][k + 1, part] - y[part])
            assert miss < 1e-6 * np.linalg.norm(y[part]), (k, part)
    if env_id == FIXED:
        assert rows[-2][1] < 961 - 4 == flight["final_time_s"] - 4, "it should have run dry and coasted"
        assert flight["y"][-1, 6] == flight["y"][-2, 6]


def test_the_first_to_run_out_ends_a_burn_and_none_burns_what_it_has_not():
    a = envs.Engine(20e3, 18e3, 1.5e6, 280.0, 100.0)
    b = envs.Engine(30e3, 28e3, 1.5e6, 280.0, 100.0)
    top = envs.Engine(9e3, 8e3, 2e5, 300.0, 100.0)
    both = envs.Burn(100.0, ((1, a), (1, b)), dropped=((1, a), (1, b)))
    rocket = replace(ROCKET, burns=(both, envs.Burn(200.0, ((1, top),))), end_time=200.0)
    names = envs.draw_names(rocket)
    assert names[:3] == ("burn_rate_1", "burn_rate_2", "burn_rate_3") and len(names) == 16
    z = np.zeros((1, 16))
    z[0, [0, 1]] = 2.0, -2.0
    vehicles = envs.draw_vehicles(rocket, 1.0, z)
    end = 100 / 1.01
    assert vehicles.end[0, 0] == pytest.approx(end, rel=1e-14)
    assert vehicles.dropped[0, 0] == pytest.approx(2e3 + 2e3 + 28e3 - 280 * 0.99 * end, rel=1e-12)
    # a core that would outlive its boosters nominally ends their burn where it runs out before them
    b = replace(b, burn_time=101.0)
    core = envs.Burn(101.0, ((1, b),), dropped=((1, b),))
    boosted = envs.Burn(100.0, ((1, a), (1, b)), dropped=((1, a),))
    rocket = replace(ROCKET, burns=(boosted, core, envs.Burn(201.0, ((1, top),))), end_time=201.0)
    z[0, [0, 1]] = -2.0, 3.0
    vehicles = envs.draw_vehicles(rocket, 1.0, z)
    assert vehicles.end[0, 0] == vehicles.end[1, 0] == pytest.approx(101 / 1.015, rel=1e-14)
    burnt = vehicles.flow[0, 0] * vehicles.end[0, 0]
    dropped = vehicles.dropped[:, 0].sum()
    assert vehicles.mass[0] - burnt - dropped == pytest.approx(ROCKET.payload + 9e3, abs=1e-6)


def test_two_events_in_one_step_are_both_flown():
    """Two stages that leave 0.6 s apart, both within a step, flown once more by hand."""
    step = 17
    first = envs.Engine(2000.0, 1500.0, 4e6, 280.0, 2.0 * step + 0.7)
    second = envs.Engine(1000.0, 900.0, 3e6, 280.0, 0.6)
    burns = [envs.Burn(2.0 * step + 0.7, ((1, first),), ((1, first),)), envs.Burn(2.0 * step + 1.3, ((1, second),),
             ((1, second),)), envs.Burn(2.0 * step + 101.0, ((1, STAGE_2),))]  # fmt: skip
    rocket = replace(ROCKET, burns=tuple(burns), end_time=burns[-1].end)
    for dispersion in (0, 1):
        options = {} if dispersion == 0 else {"options": {"draw": np.zeros((1, 16))}}
        batch = make(FIXED, dispersion=dispersion, rocket=rocket, observe_mass=True)
        batch.reset(**options)
        for _ in range(step + 1):
            obs = batch.step([[1.0, 0.0, 0.0]])[0]
        mass = rocket.payload + 19300 - 0.7 * 16820 / 700
        assert obs[0, 6] == pytest.approx(mass, abs=1e-6)
        assert obs[0, 8] == 1.0


def test_the_observed_mass_is_the_flight_computers():
    z = scores(FIXED)
    rows = typed(FIXED, z)[1]
    seen = np.array([obs[0] for obs in episode(make(FIXED), FIXED, {"draw": [vector(FIXED, z)]})[0]])
    # the nominal vehicle: masses at the beginning of its burns, and its flows
    masses = [301454, 301454 - 75.2 * (6 * 17010 / 75.2 + 95550 / 261) - 6 * 2280]
    masses.append(masses[1] - 75.2 * (3 * 17010 / 75.2 + 95550 / 261) - 3 * 2280)
    masses.append(4164 + 19300)
    flows = [6 * 17010 / 75.2 + 95550 / 261, 3 * 17010 / 75.2 + 95550 / 261, 95550 / 261, 16820 / 700]
    for k, t in enumerate(np.append(np.arange(0, 961, 2.0), 961)):
        burn = sum(row[1] <= t for row in rows[:3])
        mass = max(masses[burn] - flows[burn] * (t - rows[burn][0]), 4164 + 2480)
        assert seen[k, 6] == pytest.approx(mass, abs=1e-6), t
        if t < 961:
            assert seen[k, 8] == burn / 3
    true = flown(FIXED)["y"][:, 6]
    assert np.abs(seen[:, 6] - true).min() > 0 and np.abs(seen[:, 6] - true).max() > 300
    shown = episode(make(FIXED, observe_mass=True), FIXED, {"draw": [vector(FIXED, z)]})[0][:, 0]
    np.testing.assert_array_equal(shown[:, 6], true)
    np.testing.assert_array_equal(np.delete(shown, 6, axis=1), np.delete(seen, 6, axis=1))


def test_the_flight_computer_never_shows_less_than_the_nominal_dry_mass():
    """A last stage lit early flies on longer than its nominal propellant would last."""
    z = changed("burn_rate_2", 3.0) + changed("propellant_2", -3.0)
    seen = episode(make(FIXED), FIXED, {"draw": [z]})[0][:, 0, 6]
    lit = 261 * 0.991 / 1.015
    assert lit + 700 < 956 and seen[-4:].tolist() == [6644.0] * 4
    assert seen[475] == pytest.approx(4164 + 19300 - 16820 / 700 * (950 - lit), abs=1e-6)


# --- dispersion 0 and 1 -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", [FIXED, LEO])
def test_a_draw_of_zeros_is_the_nominal_flight(env_id):
    nominal = episode(gym.make_vec(env_id, num_envs=1, action_frame="local"), env_id)
    drawn = episode(make(env_id), env_id, {"draw": np.zeros((1, len(vector(env_id, scores(env_id)))))})
    np.testing.assert_allclose(drawn[0], nominal[0], rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(drawn[1], nominal[1], rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("dispersion", [1, 2.0])
def test_dispersion_scales_the_scores(dispersion):
    z = vector(CUTOFF, scores(CUTOFF))[None]
    once, scaled = envs.draw_vehicles(ROCKET, 1, dispersion * z), envs.draw_vehicles(ROCKET, dispersion, z)
    for a, b in zip(once, scaled):
        np.testing.assert_allclose(a, b, rtol=1e-13)


# --- draws ------------------------------------------------------------------------------------------------------------


def test_statistics_of_the_draws():
    batch = make(CUTOFF, 20000)
    batch.reset(seed=3)
    z = batch.draw
    n = z.shape[0]
    assert z.shape == (n, 16) and np.abs(z).max() == 3.0
    assert np.abs(z.mean(axis=0)).max() < 5 / math.sqrt(n)
    np.testing.assert_allclose(z.std(axis=0), 1.0, atol=5 / math.sqrt(2 * n) + 0.007)  # clipping takes 0.5 %
    assert np.abs(np.corrcoef(z.T) - np.eye(16)).max() < 5 / math.sqrt(n)
    beyond = 2 * 0.00135
    assert np.mean(np.abs(z) == 3.0) == pytest.approx(beyond, abs=5 * math.sqrt(beyond / z.size))
    assert batch.vehicles.mass.std() == pytest.approx(math.sqrt(
        (0.003**2 * ((9 * 17010) ** 2 + 95550**2 + 16820**2)) + 20**2
        + 0.005**2 * ((9 * 2280) ** 2 + 8830**2 + 2480**2)), rel=0.03)  # fmt: skip


@pytest.mark.parametrize("num_envs, group, groups", [(7, 3, 3), (8, 2, 4)])
def test_flights_of_a_group_share_their_draw(num_envs, group, groups):
    """Flight k has draw k // G, every second one the mirror of the one before; given draws stay each flight's own."""
    batch, half, few = make(CUTOFF, num_envs), make(CUTOFF, -(-groups // 2)), make(CUTOFF, groups)
    training = {"training": {"flights_per_start": group}}
    rows = np.arange(num_envs) // group
    for seed in (1, None):  # the second draws anew
        batch.reset(seed=seed, options=training)
        half.reset(seed=seed)  # a smaller batch without groups, whose draws have no mirror
        few.reset(options={"draw": np.concatenate([[z, -z] for z in half.draw])[:groups]})
        np.testing.assert_array_equal(batch.draw, few.draw[rows])
        np.testing.assert_array_equal(batch.vehicles.mass, few.vehicles.mass[rows])
        assert len(np.unique(batch.draw[:, 0])) == groups
    given = np.linspace(-1, 1, batch.draw.size).reshape(batch.draw.shape)
    batch.reset(options={"draw": given, **training})
    np.testing.assert_array_equal(batch.draw, given)


def test_autoreset_draws_anew_only_for_those_that_ended():
    batch = make(CUTOFF, 3)
    batch.reset(seed=1)
    before, mass = batch.draw.copy(), batch.vehicles.mass.copy()
    action = np.array([[1.0, 0.1, 0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.1]])  # the second into the ground
    ended = np.zeros(3, dtype=bool)
    while not ended.any():
        obs, _, ended, _, info = batch.step(action)
    assert ended.tolist() == [False, True, False] and info["final_info"]["crashed"][1]
    np.testing.assert_array_equal(info["final_info"]["draw"], before)
    np.testing.assert_array_equal(batch.draw[[0, 2]], before[[0, 2]])
    np.testing.assert_array_equal(batch.vehicles.mass[[0, 2]], mass[[0, 2]])
    assert (batch.draw[1] != before[1]).all() and batch.vehicles.mass[1] != mass[1]
    assert batch.y[6, 1] == batch.vehicles.mass[1] == envs.draw_vehicles(ROCKET, 1, batch.draw[1:2]).mass[0]
    assert obs[1, 6] == 301454


@pytest.mark.slow
def test_given_draws_reproduce_a_flight_alone_and_in_a_batch():
    env_id = CUTOFF
    batch = make(env_id, 4, observe_draw=True)
    obs, rewards, final = episode(batch, env_id)
    assert len({f["final_time_s"] for f in final.values()}) == 4, "flights should differ"
    again = episode(make(env_id, 4, observe_draw=True), env_id, {"draw": [final[k]["draw"] for k in range(4)]})
    alone = gym.make(env_id, disable_env_checker=True, dispersion=1, action_frame="local", observe_draw=True)
    for k in range(4):
        seen, paid, ended = [alone.reset(options={"draw": final[k]["draw"]})[0]], [], False
        while not ended:
            row, reward, ended, _, info = alone.step(VEHICLES[env_id].programme(2.0 * len(paid)))
            seen.append(row)
            paid.append(reward)
        n = len(paid)
        for got in (obs, again[0]):
            np.testing.assert_array_equal(got[: n + 1, k], seen)
        for got in (rewards, again[1]):
            np.testing.assert_allclose(got[:n, k], paid, rtol=0, atol=1e-12)
        for key, value in final[k].items():
            np.testing.assert_allclose(value, info[key], rtol=1e-12, atol=1e-11)
            np.testing.assert_array_equal(value, again[2][k][key])


def test_the_oracle_sees_the_draw_behind_the_nine():
    batch, plain = make(CUTOFF, 3, observe_draw=True), make(CUTOFF, 3)
    obs, nine = batch.reset(seed=2)[0], plain.reset(seed=2)[0]
    assert obs.shape == (3, 25) and batch.single_observation_space.shape == (25,)
    np.testing.assert_array_equal(obs[:, 9:], batch.draw)
    np.testing.assert_array_equal(obs[:, :9], nine)
    obs = batch.step(np.eye(3)[[0, 0, 0]])[0]
    np.testing.assert_array_equal(obs[:, 9:], batch.draw)
    assert (obs[0, 9:] != obs[1, 9:]).all() and obs in batch.observation_space
    assert make(LEO, observe_draw=True).reset()[0].shape == (1, 21)


# --- wind and drag ----------------------------------------------------------------------------------------------------


def plunge(batch, altitude, speed, mass, **options):
    """The state (7,) after a step from a fall through dense air, late in the flight."""
    batch.reset(**options)
    batch.y[:, 0] = RE + altitude, 0.0, 0.0, -speed, OMEGA * RE + 100, 50.0, mass
    batch.t[:] = 400
    start = batch.y[:, 0].copy()
    batch.advance([[1.0, 0.2, -0.3]])
    return start, batch.y[:, 0].copy(), batch.u[:, 0]


def test_a_plunge_through_the_wind_agrees_with_scipy():
    z = scores(CUTOFF) | {"drag": -1.0, "wind_east": 3.0, "wind_north": -3.0}
    start, y, u = plunge(make(CUTOFF), 14e3, 1500.0, 2000.0, options={"draw": [vector(CUTOFF, z)]})
    expected = integrate(CUTOFF, z, start, 800.0, 802.0, u)
    calm = integrate(CUTOFF, z | {"wind_east": 0.0, "wind_north": 0.0}, start, 800.0, 802.0, u)
    assert np.linalg.norm(calm[3:6] - expected[3:6]) > 20
    np.testing.assert_allclose(y[3:6], expected[3:6], rtol=0, atol=0.05)


# --- refusals and extremes --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [-0.1, math.nan, 101, "1"])
def test_bad_dispersions_are_refused(value):
    for create in (gym.make_vec, gym.make):
        with pytest.raises(BadInput, match=r"^dispersion is .* must be a number from 0 to 100$"):
            create(CUTOFF, dispersion=value)


@pytest.mark.parametrize(
    "draw, message",
    [
        (np.zeros(15), r"of shape \(1, 15\)"),
        (0.0, r"of shape \(1,\)"),
        ([[1.0], [2.0, 3.0]], r"options\['draw'\] is of shape"),
        (changed("isp_2", math.nan), "is nan; it must hold finite numbers"),
        (changed("burn_rate_1", -200.0), "burn_rate_1 of draw 0 is -200.0; it must be larger"),
        (changed("propellant_3", -400.0), "propellant_3 of draw 0 is -400.0; it must be larger"),
        (changed("drag", -7.2), "drag of draw 0"),
    ],
)
def test_bad_draws_are_refused(draw, message):
    batch, alone = make(CUTOFF), gym.make(CUTOFF, dispersion=1)
    batch.reset(seed=0)
    before = batch.draw.copy()
    for reset, given in ((batch.reset, [draw]), (alone.reset, draw)):
        with pytest.raises(BadInput, match=message) as caught:
            reset(options={"draw": given})
        assert "\n" not in str(caught.value)
    np.testing.assert_array_equal(batch.draw, before)


def test_bad_options_are_refused():
    with pytest.raises(BadInput, match="'draw'.*a rocket has none without targets, dispersion, failure or"):
        gym.make_vec(CUTOFF).reset(options={"draw": np.zeros((1, 16))})
    with pytest.raises(BadInput, match="the only one is 'draw'"):
        make(CUTOFF).reset(options={"x0": 1})
    batch = make(CUTOFF)
    batch.reset(options={"draw": changed("drag", -7.0)[None]})
    batch.reset(options={"draw": changed("payload", -208.0)[None]})
    assert batch.vehicles.dry_mass[0] == pytest.approx(4 + 2480)


@pytest.mark.slow
def test_wild_dispersions_crash_but_do_not_raise():
    dispersion = 100
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        batch = make(CUTOFF, 16, dispersion=dispersion, observe_draw=True, observe_mass=True)
        obs, rewards, final = episode(batch, CUTOFF)
    assert np.isfinite(obs).all() and np.isfinite(rewards).all()
    assert any(f["crashed"] for f in final.values())
    inside = (obs >= batch.single_observation_space.low) & (obs <= batch.single_observation_space.high)
    assert inside.all()
    draws = np.array([f["draw"] for f in final.values()])
    assert np.abs(dispersion * 0.14 * draws[:, DRAW.index("drag")]).max() == pytest.approx(0.9)
    again = envs.draw_vehicles(ROCKET, dispersion, draws)  # what was drawn can be given again
    assert again.drag.min() == pytest.approx(0.1) and again.mass.min() > 0


def test_check_env():
    env = gym.make(FIXED, dispersion=1, observe_draw=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=r".*A Box (observation|action) space")
        check_env(env.unwrapped, skip_render_check=True)


def test_table_isp_flies_dispersed_and_drops_what_is_left():
    z = scores(FIXED)
    final = episode(make(FIXED, table_isp=True), FIXED, {"draw": [vector(FIXED, z)]})[2][0]
    dry = 4164 + 20 * z["payload"] + 2480 * (1 + 0.005 * z["dry_mass_3"])
    assert final["final_time_s"] == 961 and final["final_mass_kg"] == pytest.approx(dry, abs=1e-6)


def test_a_crash_is_charged_the_flights_own_propellant():
    z = np.zeros((2, 16))
    z[1, DRAW.index("propellant_3")] = 2.0
    batch = make(CUTOFF, 2)
    batch.reset(options={"draw": z, "training": {"propellant_price": 1.0}})
    final = batch.step(np.tile([-1.0, 0.0, 0.0], (2, 1)))[4]["final_info"]
    assert final["crashed"].all()
    difference = final["R_penalties"][1] - final["R_penalties"][0]
    assert difference == pytest.approx(-16820 * 2 * 0.003 / 100, rel=1e-9)
