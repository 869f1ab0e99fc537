"""Rockets of your own: what cannot fly is refused in one line; what can goes through registration, environment,
reference, evaluation, table and figures, whatever its number of burns, its site and its target."""

import math
import shutil
import subprocess
import sys
import warnings
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import spiceypy
from helpers import table_of
from rocket_oracle import CUTOFF, FIXED, LEO, MU, RE, single_burn

import baselines
import envs
import evaluate
from common.tasks import task_of
from envs import ROCKET, ROCKETS, BadInput, Burn, Engine, Rocket, register_rocket
from rocket import optimum
from rocket.metrics import rocket_metrics
from rocket.table import table as rocket_table
from rocket.vehicle import BOOSTER

ROOT = Path(__file__).resolve().parents[1]
TWO = ROCKETS[LEO].rocket
FIRST, SECOND = (burn.engines[0][1] for burn in TWO.burns)


@contextmanager
def restored():
    """What is registered within is gone after it, and what it replaced is back."""
    missions, specs = dict(ROCKETS), dict(gym.registry)
    try:
        yield
    finally:
        for registry, before in ((ROCKETS, missions), (gym.registry, specs)):
            registry.clear()
            registry.update(before)
        optimum.kept_reference.cache_clear()


@pytest.fixture(autouse=True)
def own_registry():
    with restored():
        yield


# --- refusals ---------------------------------------------------------------------------------------------------------


def two_stages(first=FIRST, second=SECOND, number=1, dropped=1, end=162.0, last=555.0, **changes):
    burns = (Burn(end, ((number, first),), ((dropped, first),) if dropped else ()), Burn(last, ((1, second),)))
    return replace(TWO, burns=burns, **changes)


REFUSED = {
    "end_time is 556": lambda: replace(TWO, end_time=556.0),
    "propellant of burns[0].engines, 411000.0 kg each, is 411000 kg in all": lambda: two_stages(end=163.0, last=556.0),
    "propellant of burns[0].engines": lambda: two_stages(replace(FIRST, isp=305.0), table_isp=True),
    "it must be dropped by this burn or a later one, or burn in the last": lambda: two_stages(dropped=0),
    "it must be empty: the last burn's engines stay aboard": lambda: replace(
        TWO, burns=(TWO.burns[0], replace(TWO.burns[1], dropped=((1, SECOND),)))
    ),
    "a mission's ceiling_km is nan; it must be positive": lambda: envs.Mission(two_stages(), ceiling_km=np.nan),
    "a mission's floor_from is None; it must be a finite": lambda: envs.Mission(two_stages(), floor_from=None),
    "a burn's engines is (1, Engine(": lambda: Burn(162.0, (1, FIRST)),
    "a burn's dropped is ": lambda: Burn(162.0, ((1, FIRST),), dropped=[(1, FIRST)]),
    "a rocket's a is 6778.145 m": lambda: replace(TWO, a=6778.145),
    "number of an engine in burns[0].engines is 7; it must be positive and at most 6": lambda: replace(
        ROCKET, burns=(Burn(75.2, ((7, BOOSTER),), ((6, BOOSTER),)), *ROCKET.burns[2:])
    ),
    "thrust of burns[0] is 5.5e+06 N; it must be above the weight at lift-off": lambda: two_stages(
        replace(FIRST, thrust=5.5e6, isp=221.1)
    ),
    "burns[1].end is 100.0": lambda: replace(TWO, burns=(TWO.burns[0], Burn(100.0, ((1, SECOND),)))),
    "burns[1].engines is ()": lambda: replace(TWO, burns=(TWO.burns[0], Burn(555.0, ()))),
    "burns is ()": lambda: replace(TWO, burns=()),
    "payload is nan": lambda: replace(TWO, payload=math.nan),
    "payload is -1": lambda: replace(TWO, payload=-1.0),
    "e is 1.0": lambda: replace(TWO, e=1.0),
    "i is 181": lambda: replace(TWO, i=181.0),
    "raan is None; it must be a number: all five elements are given": lambda: replace(TWO, raan=None),
    "a rocket's a is 6778145.0 m with e 0.5, -2989.1 km by 3789.1 km; it must": lambda: replace(TWO, e=0.5),
    "an engine's name is 7; it must be a string": lambda: replace(FIRST, name=7),
    "burns[0].engines is (); it must hold an engine: only a burn between others may be a coast": lambda: replace(
        TWO, burns=(Burn(10.0, ()), *TWO.burns)
    ),
    "latitude is 90": lambda: replace(TWO, latitude=90.0),
    "dt is 0": lambda: replace(TWO, dt=0.0),
    "engine's thrust is nan": lambda: replace(FIRST, thrust=math.nan),
    "engine's isp is 0": lambda: replace(FIRST, isp=0.0),
    "engine's propellant is 434000": lambda: replace(FIRST, propellant=434e3),
    "engine's propellant is 0.0; it must be positive where it has thrust": lambda: replace(FIRST, propellant=0.0),
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_cannot_fly_is_refused_in_one_line(message):
    with warnings.catch_warnings(), pytest.raises(BadInput) as error:
        warnings.simplefilter("error")
        REFUSED[message]()
    assert message in str(error.value) and "\n" not in str(error.value) and "; it must" in str(error.value)


def test_what_is_refused_can_fly_a_little_beside_it():
    """The same changes on the other side of their bounds."""
    weight = TWO.x0[6] * MU / RE**2
    two_stages(replace(FIRST, thrust=1.001 * weight, isp=222.5))
    two_stages(last=554.0, end_time=554.0)
    two_stages(table_isp=True)
    replace(TWO, i=180.0 - 51.6, e=0.059, latitude=-51.0, payload=0.0, end_time=1.0)
    replace(TWO, a=1e9, e=0.99)


# the first stage of a public table of the Saturn V, and its second
@pytest.mark.parametrize(
    "numbers, isp, flown, burn_time",
    [
        ((2.93e6, 2.8e6, 52.0e6), (263.0, 168.0), "318.2", "138.877"),
        ((670e3, 630e3, 7.5e6), (421.0, 390.0), "473.4", "346.802"),
    ],
)
def test_an_isp_that_the_other_numbers_contradict_is_said(numbers, isp, flown, burn_time):
    """Thrust times burn time over propellant and g0; the line names both, which rule, and a burn time that agrees."""
    message = (
        f"an engine's isp is {isp[0]:g} s, but its thrust, propellant and burn_time make {flown} s, .*{burn_time} s"
    )
    with pytest.warns(UserWarning, match=message):
        engine = Engine(*numbers, *isp)
    assert engine.flown_isp == pytest.approx(numbers[2] * isp[1] / numbers[1] / 9.80665)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Engine(*numbers, isp[0], numbers[1] * 9.80665 * isp[0] / numbers[2])
        Engine(*numbers, isp[0], 1.019 * numbers[1] * 9.80665 * isp[0] / numbers[2])


# --- coasts -----------------------------------------------------------------------------------------------------------

RESTART = replace(
    TWO,
    burns=(TWO.burns[0], Burn(462.0, ((1, SECOND),)), Burn(762.0, ()), Burn(855.0, ((1, SECOND),))),
    end_time=855.0,
)


def test_a_coast_is_a_flight_of_kepler():
    """Between two burns of one stage nothing but gravity acts: CSPICE's two-body state, the mass as it was."""
    register_rocket("Restart-v0", RESTART, cutoff=True)
    env = gym.make_vec("Restart-v0", num_envs=2, action_frame="local")
    obs, _ = env.reset(seed=0)
    rng = np.random.default_rng(0)
    states, turns = {}, []
    for k in range(385):
        tilt = min(1.5, 0.007 * k)
        action = np.tile([math.cos(tilt), math.sin(tilt), 0.0], (2, 1))
        if 462 <= 2 * k < 762:
            action[1] = rng.normal(size=3)  # what it does in the coast counts for nothing
        obs, reward, *_ = env.advance(action)
        states[2 * (k + 1)] = env.y.copy()
        turns.append(reward)
    begin, end = (np.ascontiguousarray(states[time][:, 0]) for time in (462, 762))
    assert obs.shape == (2, 9) and begin[6] == end[6]
    np.testing.assert_allclose(spiceypy.prop2b(MU, begin[:6], 300.0), end[:6], rtol=2e-6)
    for time, state in states.items():
        np.testing.assert_array_equal(state[:, 0], state[:, 1], err_msg=str(time))
    np.testing.assert_array_equal(np.array(turns)[:, 0], np.array(turns)[:, 1])


def test_a_drawn_coast_keeps_its_length():
    """The stage before it burns out at a time of its own; the coast lasts its 18 s all the same."""
    late = replace(RESTART, burns=(*RESTART.burns[:1], Burn(180.0, ()), Burn(573.0, ((1, SECOND),))), end_time=573.0)
    register_rocket("Late-v0", late, cutoff=True)
    env = gym.make_vec("Late-v0", num_envs=64, dispersion=3.0)
    env.reset(seed=1)
    ends = env.unwrapped.vehicles.end
    assert np.ptp(ends[0]) > 5
    np.testing.assert_allclose(ends[1] - ends[0], 18.0)


def test_engines_of_equal_numbers_are_told_apart_by_their_names():
    """Two boosters lit on the ground, two in the air, as on Delta II: one type cannot be drawn, two can."""

    def with_boosters(air):
        ground = Engine(30e3, 27e3, 1e6, 280.0, 27e3 * 9.80665 * 280.0 / 1e6)
        air = replace(ground, name=air)
        lit = ground.burn_time
        core = Engine(433e3, 411e3, 7.6e6, 306.0, 162.0)
        burns = (
            Burn(lit, ((2, ground), (1, core)), ((2, ground),)),
            Burn(2 * lit, ((2, air), (1, core)), ((2, air),)),
            Burn(162.0, ((1, core),), ((1, core),)),
            TWO.burns[1],
        )
        return replace(TWO, burns=burns)

    register_rocket("Boosters-v0", with_boosters("air-lit"), cutoff=True)
    draw = gym.make_vec("Boosters-v0", num_envs=2, dispersion=1.0).reset(seed=0)
    assert np.isfinite(draw[0]).all()
    assert len(envs.draw_names(with_boosters("air-lit"))) == 4 * 4 + 4


def test_a_stage_that_is_dropped_early_takes_its_propellant_along():
    """Nominal and with nothing drawn alike: 140 of 162 s burnt, and 22.2 t of dry mass leave with the rest."""
    rocket = two_stages(end=140.0, last=533.0, end_time=533.0)
    unburnt = 411e3 * (1 - 140 / 162)
    assert rocket.jettison == pytest.approx([22e3 + unburnt, 0.0])
    register_rocket("Early-v0", rocket)
    for options in ({}, {"dispersion": 1.0}):
        batch = gym.make_vec("Early-v0", num_envs=1, action_frame="local", **options)
        batch.reset(seed=0, options={"draw": np.zeros((1, 12))} if options else None)
        masses = [batch.step(np.array([[1.0, 0.05, 0.0]])) and batch.y[6, 0] for _ in range(71)]
        start, burnt = 433e3 + 111.5e3 + 20e3, 411e3 * 140 / 162
        assert masses[69] == pytest.approx(start - burnt - 22e3 - unburnt, abs=1e-6)


@pytest.mark.parametrize("first, later", [((3, 100.0, 2), 250.0), ((2, 120.0, 0), 200.0)])
def test_engines_that_share_a_tank_never_burn_what_was_dropped(first, later):
    """Two of three cores dropped early, and two of five lit first: what burns and what leaves is what was loaded."""
    number, end, gone = first
    core = Engine(total_mass=433e3, propellant=411e3, thrust=12e6, isp=306.0, burn_time=150.0)
    last = 1 if gone else 5
    burns = (Burn(end, ((number, core),), ((gone, core),) if gone else ()), Burn(later, ((last, core),)))
    rocket = replace(TWO, burns=burns, payload=1e3 if gone else 1e2, end_time=later)
    arcs = rocket.arcs()
    assert len(arcs) == 2 and arcs[-1][2] == last * 12e6  # none without thrust
    burnt = sum((stop - start) * flow for start, stop, _, flow, _ in arcs)
    assert burnt == pytest.approx(411e3 / 150 * (number * end + last * (later - end)))
    assert rocket.x0[6] - burnt - sum(rocket.jettison) >= rocket.dry_mass - 1e-6
    register_rocket("Shared-v0", rocket)
    with pytest.raises(BadInput, match="cannot be drawn"):
        gym.make_vec("Shared-v0", num_envs=1, dispersion=1.0)


def test_plane_below_the_launch_latitude_is_a_warning():
    for i, warned in ((28.4, True), (28.5, False), (151.5, False), (151.6, True), (0.0, True)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            replace(TWO, i=i)
        assert len(caught) == warned
        assert all(f"i is {i} degrees, below the launch latitude 28.5" in str(w.message) for w in caught)


# --- registration -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ["DoubleIntegrator-v0", "CartPole-v1", "a/b", "", "my rocket", "DoubleIntegrator"])
def test_foreign_ids_are_refused(env_id):
    missions, specs = dict(ROCKETS), dict(gym.registry)
    with pytest.raises(BadInput, match=f"^env_id is {env_id!r}; it must be a new id such as Mine-v0"):
        register_rocket(env_id, TWO)
    assert missions == ROCKETS and specs == gym.registry


def test_registering_again_replaces(monkeypatch):
    """Environment, reference and evaluation are the new rocket's, with a warning where it is another one."""
    solved = []
    monkeypatch.setattr(optimum, "solve_and_fly", lambda case: solved.append(case.rocket) or 1 / 0)
    lighter = replace(TWO, payload=19e3)
    for rocket in (TWO, lighter):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            register_rocket("Again-v0", rocket, cutoff=True, floor_from=200.0)
        said = [str(warning.message) for warning in caught]
        assert said == (
            ["Again-v0 was another rocket's id; from here on it is this one's"] if rocket is lighter else []
        )
        assert gym.make_vec("Again-v0", num_envs=2).unwrapped.rocket == rocket
        assert gym.make("Again-v0").unwrapped.batch.mission.floor_from == 200.0
        with pytest.raises(ZeroDivisionError):
            evaluate.evaluate("Again-v0", lambda obs, t: np.ones((1, 3)), 0, 1)
    assert solved == [TWO, lighter]
    with pytest.warns(UserWarning, match=LEO):
        register_rocket(LEO, lighter, cutoff=True)  # whose old reference is stored
    with pytest.raises(ZeroDivisionError):
        baselines.rocket_reference(LEO)


def test_a_bad_file_of_vehicles_is_left_out_with_a_line(tmp_path):
    shutil.copy(ROOT / "envs.py", tmp_path)
    for room in ("common", "landing", "phased", "rocket"):
        shutil.copytree(ROOT / room, tmp_path / room)
    (tmp_path / "vehicles").mkdir()
    good = (ROOT / "vehicles" / "two_stage_leo.py").read_text()
    (tmp_path / "vehicles" / "a_bad_one.py").write_text(good.replace("payload=20e3", "payload=-20e3"))
    (tmp_path / "vehicles" / "b_foreign.py").write_text(good.replace("TwoStageLEO-v0", "VanDerPol-v0"))
    (tmp_path / "vehicles" / "c_broken.py").write_text(good.replace("payload=20e3", "payload=heavy"))
    (tmp_path / "vehicles" / "d_ends.py").write_text("raise SystemExit(2)\n")
    (tmp_path / "vehicles" / "z_good.py").write_text(good)
    (tmp_path / "vehicles" / "zz_copy.py").write_text(good.replace("payload=20e3", "payload=19e3"))
    code = "import envs, gymnasium; print(*envs.ROCKETS); print(gymnasium.make('TwoStageLEO-v0').reset()[0][6])"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == [FIXED, CUTOFF, "RocketAscentAnyOrbit-v0", LEO, "564500.0"]
    first, second, third, fourth, copy = done.stderr.splitlines()
    assert first == "vehicles/a_bad_one.py is left out: a rocket's payload is -20000.0; it must not be negative"
    assert second.startswith("vehicles/b_foreign.py is left out: env_id is 'VanDerPol-v0'")
    assert third == "vehicles/c_broken.py is left out: NameError: name 'heavy' is not defined"
    assert fourth == "vehicles/d_ends.py is left out: SystemExit: 2"
    allowed = "env_id is 'TwoStageLEO-v0', which vehicles/z_good.py has already; it must be new"
    assert copy == f"vehicles/zz_copy.py is left out: {allowed}"


def test_a_warning_of_a_file_is_said_with_its_own_rocket_alone(tmp_path):
    shutil.copy(ROOT / "envs.py", tmp_path)
    for room in ("common", "landing", "phased", "rocket"):
        shutil.copytree(ROOT / room, tmp_path / room)
    (tmp_path / "vehicles").mkdir()
    doubtful = (ROOT / "vehicles" / "two_stage_leo.py").read_text().replace("isp=348.0", "isp=300.0")
    (tmp_path / "vehicles" / "doubtful.py").write_text(doubtful)
    said = []
    for env_id in (FIXED, LEO):
        code = f"import envs, gymnasium; gymnasium.make('{env_id}'); gymnasium.make('{env_id}')"
        done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
        said.append(done.stderr.splitlines())
    assert said[0] == []
    assert len(said[1]) == 1 and said[1][0].startswith("vehicles/doubtful.py: an engine's isp is 300 s")


# --- one burn, three burns, another site and target -------------------------------------------------------------------


def test_one_burn():
    """No staging, no phase but the last: features of the clock, prices and arcs without a division by zero."""
    register_rocket("Single-v0", single_burn(), cutoff=True)
    env = gym.make_vec("Single-v0", num_envs=1, action_frame="local")
    with np.errstate(all="raise", under="ignore"):
        obs, _ = env.reset(options={"training": {"propellant_price": 1.0, "guidance": True}})
        assert obs[0, 6] == 40000 and obs[0, 7:].tolist() == [1.0, 0.0]
        obs, reward, *_ = env.step(np.array([[1.0, 0.0, 0.0]]))
        assert obs[0, 7:].tolist() == [1 - 2 / 250, 0.0]
        flight = envs.fly_rocket("Single-v0", lambda obs, t: np.array([[1.0, 0.1, 0.0]]), action_frame="local")
    assert flight["R_trajectory"] == 0, "every burn is the last"
    burnt, dry = 2 * 36500 / 250, 3500.0
    energy = env.unwrapped._parts[3, 0]
    assert energy == pytest.approx(-burnt / (0.06 * dry))
    assert flight["final_time_s"] < 250, "cut off before the burn's end"
    assert flight["final_mass_kg"] == pytest.approx(40e3 - 36.5e3 / 250 * flight["final_time_s"], abs=1e-6)


def three_burns(**changes):
    """Two boosters, a core, a short last stage, from 5.2 degrees to a retrograde ellipse; with a ceiling."""
    booster = Engine(total_mass=40e3, propellant=36e3, thrust=1.2e6, isp=280.0, burn_time=80.0)
    core = Engine(total_mass=110e3, propellant=100e3, thrust=1.3e6, isp=330.0, burn_time=240.0)
    last = Engine(total_mass=17e3, propellant=15e3, thrust=200e3, isp=450.0, burn_time=330.0)
    burns = (
        Burn(80.0, ((2, booster), (1, core)), ((2, booster),)),
        Burn(240.0, ((1, core),), ((1, core),)),
        Burn(570.0, ((1, last),)),
    )
    options = {"payload": 3e3, "S": 9.0, "latitude": 5.2, "end_time": 570.0, "a": 6.9e6, "e": 0.03, "i": 98.0}
    return Rocket(**{"burns": burns, "raan": envs.launch_raan(5.2, 98.0), "argp": 20.0} | options | changes)


@pytest.fixture(scope="module")
def solved():
    """The optima of two rockets, flown and evaluated: id -> (metrics, arrays, mission)."""
    found = {}
    with restored():
        for env_id, rocket in {"Single-v0": single_burn(), "ThreeBurns-v0": three_burns()}.items():
            mission = envs.Mission(rocket, cutoff=True, ceiling_km=400.0 if env_id == "ThreeBurns-v0" else None)
            register_rocket(env_id, rocket, mission.cutoff, mission.ceiling_km)
            reference = baselines.rocket_reference(env_id)
            u = reference["u"]
            metrics, arrays = evaluate.evaluate(env_id, lambda obs, t, u=u: u[t : t + 1], 0, 1, reference)
            found[env_id] = metrics, arrays, mission
    return found


OWN = ["Single-v0", "ThreeBurns-v0"]


@pytest.mark.slow
@pytest.mark.parametrize("env_id", OWN)
def test_a_rocket_of_your_own_from_reference_to_figures(solved, env_id):
    metrics, arrays, mission = solved[env_id]
    rocket = mission.rocket
    register_rocket(env_id, rocket, mission.cutoff, mission.ceiling_km)
    assert metrics["success"] and metrics["error_norm"] < 1e-3 and not metrics["crashed"]
    assert metrics["mass_ratio"] == pytest.approx(1, abs=2e-3) and metrics["nine_pitch_error_norm"] < 0.05
    # the last state's elements by CSPICE, beside the target's numbers
    rp, e, i, raan, argp, *_ = spiceypy.oscelt(arrays["y"][-1, :6], 0.0, MU)
    assert rp / (1 - e) == pytest.approx(rocket.a, rel=1e-4) and e == pytest.approx(rocket.e, abs=1e-3)
    assert math.degrees(i) == pytest.approx(rocket.i, abs=0.05) == metrics["i_deg"]
    assert (math.degrees(raan) - rocket.raan + 180) % 360 - 180 == pytest.approx(0, abs=0.05)
    assert ("argp_error_deg" in metrics) == (rocket.e > 0)
    if rocket.e:
        assert metrics["argp_error_deg"] == pytest.approx(math.degrees(argp) - 20, abs=1e-6)
    table = table_of(metrics)
    (row,) = (line for line in table.splitlines() if "argument of perigee" in line)
    assert (row.split()[-4:] == ["-"] * 4) == (rocket.e == 0) and table.startswith(env_id)
    figures = task_of(env_id).figures(arrays, metrics, [])
    assert list(figures) == ["trajectory.png", "orbit.png"]
    for figure in figures.values():
        figure.canvas.draw()


# --- evaluation against the rocket that flies -------------------------------------------------------------------------


@pytest.mark.parametrize("option", [{"rocket": replace(ROCKET, a=25e6, i=30.0, argp=120.0)}, {"table_isp": True}])
def test_evaluation_is_against_the_rocket_that_flies(monkeypatch, option):
    """Target, errors, table and the optimum asked for are the changed rocket's, not those of the id."""
    flown = option.get("rocket", replace(ROCKET, table_isp=True))
    solved = []

    def solve(case):
        solved.append(case.rocket)
        flight = envs.fly_rocket(CUTOFF, lambda obs, t: np.array([[1.0, 0.1, 0.0]]), end_time=100.0, rocket=flown)
        return {"final_mass_kg": 4321.0, "final_time_s": 100.0}, flight, None

    monkeypatch.setattr(optimum, "solve_and_fly", solve)
    policy = lambda obs, t: np.array([[1.0, 0.3, 0.0]])  # noqa: E731
    metrics, arrays = evaluate.evaluate(CUTOFF, policy, 0, 1, action_frame="local", **option)
    assert solved == [flown] and metrics["reference_mass_kg"] == 4321.0
    assert metrics["a_error_km"] == pytest.approx(metrics["a_km"] - flown.a / 1e3)
    assert metrics["i_error_deg"] == pytest.approx(metrics["i_deg"] - flown.i)
    s = arrays["y"][-1]
    h, h_target = np.cross(s[:3], s[3:6]), envs.target_orbit(flown.target)[0]
    e = np.cross(s[3:6], h) / MU - s[:3] / np.linalg.norm(s[:3])
    error = [*(h - h_target) / np.linalg.norm(h_target), *(e - envs.target_orbit(flown.target)[1])]
    assert metrics["error_norm"] == pytest.approx(np.linalg.norm(error))
    table = rocket_table(metrics, envs.flown_mission(ROCKETS[CUTOFF], **option))
    (row,) = (line for line in table.splitlines() if "semi-major" in line)
    assert float(row.split()[4]) == pytest.approx(flown.a / 1e3)


@pytest.mark.parametrize("i, sense", [(0.0, 1), (180.0, -1)])
@pytest.mark.parametrize("e", [0.0, 0.1])
def test_equatorial_targets_are_measured_from_the_x_axis(i, sense, e):
    """By CSPICE's state on an orbit whose perigee is 30 degrees from the x axis in the direction of flight, 50 of the
    target's: neither node nor, on a circle, perigee have an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rocket = replace(ROCKET, a=8e6, e=e, i=i, raan=sense * 20.0, argp=30.0)
    conic = [8e6 * (1 - 0.1), 0.1, math.radians(i), 0.0, math.radians(30), 1.0, 0, MU]
    state = np.append(spiceypy.conics(conic, 0), 5e3)
    elements = envs.orbital_elements(state)
    flight = {"error_norm": np.linalg.norm(envs.terminal_error(state, rocket)), "a_km": elements.a / 1e3}
    flight |= {"e": elements.e, "crashed": False, "y": state[None], "t": np.ones(1), "final_mass_kg": 5e3}
    flight |= {f"{name}_deg": math.degrees(getattr(elements, name)) for name in ("i", "raan", "argp")}
    rest = ("final_time_s", "max_altitude_km", "episodic_return", "points", *envs.RocketVectorEnv.PARTS)
    flight |= dict.fromkeys((*rest, "reference_mass_kg", "reference_time_s", "nine_pitch_error_norm"), 1.0)
    metrics = rocket_metrics(flight, flight, envs.Mission(rocket, cutoff=True))
    assert "raan_error_deg" not in metrics and ("argp_error_deg" in metrics) == (e > 0)
    assert metrics["i_error_deg"] == pytest.approx(0, abs=1e-9) and metrics["a_error_km"] == pytest.approx(0, abs=1e-6)
    assert metrics["argp_deg"] == pytest.approx(30)
    if e:
        assert metrics["argp_error_deg"] == pytest.approx(30 - 50)
        assert metrics["error_norm"] == pytest.approx(2 * 0.1 * math.sin(math.radians(10)), rel=1e-6)


def test_mass_for_an_equatorial_orbit_reached_is_of_its_perigee(monkeypatch):
    """The metric counts from the x axis; what is solved gets the element, from the node."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for i, sense in ((0.0, 1), (180.0, -1)):
            register_rocket("Equatorial-v0", replace(ROCKET, i=i), cutoff=True)
            asked = []
            monkeypatch.setattr(
                "rocket.task.reached_optimum", lambda flight, rocket, a=asked: a.append(flight) or 1 / 0
            )
            metrics = {"env_id": "Equatorial-v0", "success": True, "raan_deg": 300.0}
            metrics["argp_deg"] = (100.0 + sense * 300.0) % 360
            with pytest.raises(ZeroDivisionError):
                task_of("Equatorial-v0").reported_metrics(metrics)
            assert asked[0]["argp_deg"] == pytest.approx(100.0) and asked[0]["raan_deg"] == 300.0
