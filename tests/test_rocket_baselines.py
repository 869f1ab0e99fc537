"""The rocket's optima in optimum.py against published numbers, the maximum principle and their flights."""

import json
import math
import re
import subprocess
import sys
import time
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest

import baselines
import envs
from common import ipopt
from common.errors import NoOptimum
from envs import ROCKET, ROCKETS, Burn, Engine, Rocket, fly_rocket, launch_raan, rk4
from envs import ascent_dynamics as dynamics
from rocket import optimum
from rocket.optimum import ASCENTS, STORED, nine_pitch_angles, rocket_reference

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
KEYS = {"final_mass_kg", "final_time_s", "error_norm", "replay_error_norm", "solve_seconds", "status"}
FREE = ("free", "free_table_isp", "drag_free", "TwoStageLEO-v0")
LEO = ROCKETS["TwoStageLEO-v0"].rocket
VEHICLES = {key: case.rocket for key, case in ASCENTS.items()} | {"TwoStageLEO-v0": LEO}  # by the solves' keys
OPPONENTS = {"free": "nine_pitch_angles", "fixed_capped": "nine_pitch_angles_fixed"}
OPPONENTS["TwoStageLEO-v0"] = "nine_pitch_angles_TwoStageLEO-v0"


@pytest.fixture(scope="module")
def command(tmp_path_factory):
    """One run of `python baselines.py rocket`: the folder with its files, its numbers and its arrays."""
    folder = tmp_path_factory.mktemp("results")
    args = baselines.parse_args(
        ["rocket", "--json", str(folder / "rocket_reference.json"), "--npz", str(folder / "rocket_reference.npz")]
    )
    baselines.save(args, *args.solve(args))
    numbers = json.loads((folder / "rocket_reference.json").read_text())
    with np.load(folder / "rocket_reference.npz") as file:
        return folder, numbers, dict(file)


@pytest.fixture(scope="module")
def flights(command):
    """What the npz holds, flown by the environment without anything from optimum.py."""
    _, _, arrays = command
    return {key: fly(arrays, key) for key in VEHICLES}


def fly(arrays, key, env_id="RocketAscent-v0"):
    rocket, u = VEHICLES[key], arrays[f"{key}_u"]
    options = {"end_time": arrays[f"{key}_t"][-1], "rocket": rocket, "table_isp": key == "free_table_isp"}
    return fly_rocket(env_id, lambda obs, k: u[k : k + 1], **options)


# --- optima -----------------------------------------------------------------------------------------------------------


def test_published_optimum(command):
    """Betts 7529.712412 kg and 924.139 s; YAPSS 7529.712287 kg; MPOPT 7529.7123 kg and 924.1393 s."""
    _, numbers, _ = command
    free = numbers["free"]
    assert free["final_mass_kg"] == pytest.approx(7529.7123, rel=1e-7)
    assert free["final_time_s"] == pytest.approx(924.1393, abs=2e-4) and free["error_norm"] < 1e-10


def test_optimum_with_the_papers_isp(command):
    _, numbers, _ = command
    assert numbers["free_table_isp"]["final_mass_kg"] == pytest.approx(7495.894850, rel=1e-8)
    assert numbers["free_table_isp"]["final_time_s"] == pytest.approx(933.655225, abs=1e-5)


def test_thrust_is_parallel_to_the_costate_of_the_velocity(command):
    _, numbers, _ = command
    assert 0 < numbers["checks"]["costate_angle_deg_median"] <= numbers["checks"]["costate_angle_deg_max"] < 1e-4


def test_other_meshes_give_the_same_mass(command):
    _, numbers, _ = command
    coarse, fine = (abs(numbers["checks"][f"mass_change_kg_{n}_segments"]) for n in (40, 160))
    assert fine < 1e-6 and fine < coarse < 1e-4


def test_drag_costs_mass(command):
    _, numbers, _ = command
    gain = numbers["drag_free"]["final_mass_kg"] - numbers["free"]["final_mass_kg"]
    assert gain == pytest.approx(numbers["checks"]["drag_free_mass_gain_kg"]) and 600 < gain < 750
    assert replace(ROCKET, Cd=0.0) == ASCENTS["drag_free"].rocket


def test_optimum_for_the_orbit_reached():
    """A lower apogee, with the same perigee, leaves more than the target's 7529.7 kg."""
    lower = {"a_km": 24361.14 - 100, "e": 1 - 24361.14 * (1 - 0.7308) / (24361.14 - 100)}
    lower |= {"i_deg": 28.5, "raan_deg": 269.8, "argp_deg": 130.5}
    assert 7530 < optimum.reached_optimum(lower)["final_mass"] < 7550


# --- flights ----------------------------------------------------------------------------------------------------------


def test_every_solve_is_ready_to_fly(command, flights):
    _, numbers, arrays = command
    assert set(arrays) >= {f"{key}_{name}" for key in VEHICLES for name in "tu"}  # and those of a user's own
    for key, flight in flights.items():
        assert set(numbers[key]) >= KEYS and numbers[key]["status"] == "Solve_Succeeded"
        # the fixed-time programs have the environment's own steps; the others are collocated, and held over its steps
        assert flight["error_norm"] < (2e-5 if key in FREE else 1e-9) and numbers[key]["error_norm"] < 1e-10
        assert flight["error_norm"] == pytest.approx(numbers[key]["replay_error_norm"], abs=1e-11)
        assert flight["final_mass_kg"] == pytest.approx(numbers[key]["final_mass_kg"], rel=1e-9)
        t, u = arrays[f"{key}_t"], arrays[f"{key}_u"]
        assert t.shape == (len(u) + 1,) and u.shape[1:] == (3,)
        np.testing.assert_array_equal(t[:-1], 2.0 * np.arange(len(u)))
        np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1, atol=1e-12)
        np.testing.assert_allclose(flight["u"], u, atol=1e-12)
        assert flight["final_time_s"] == t[-1] == numbers[key]["final_time_s"] and not flight["crashed"]
        assert (np.linalg.norm(flight["y"][1:, :3], axis=1) - ROCKET.Re).min() > 0, "none flies through the ground"


def test_fixed_time_spends_all_and_stays_below_the_ceiling(command, flights):
    _, numbers, _ = command
    for key in ("fixed", "fixed_capped"):
        assert numbers[key]["final_time_s"] == 961 and flights[key]["t"].shape == (482,)
        assert numbers[key]["final_mass_kg"] == pytest.approx(6644.0, abs=1e-6)
        turning = (np.diff(flights[key]["u"], axis=0) ** 2).sum()
        assert turning == pytest.approx(numbers[key]["turning"]) and turning < 0.0046
    assert numbers["fixed"]["turning"] < numbers["fixed_capped"]["turning"]
    assert flights["fixed"]["max_altitude_km"] > 250.1
    assert 249.9 < flights["fixed_capped"]["max_altitude_km"] <= 250.0
    middle = [
        half_step(y, u) for y, u in zip(flights["fixed_capped"]["y"][131:480], flights["fixed_capped"]["u"][131:])
    ]
    assert max(middle) < 250.1


def half_step(y, u):
    """Altitude in km one second after a step of the last phase began."""
    *_, thrust, flow, _ = ROCKET.arcs()[-1]
    y = rk4(dynamics, tuple(y), (*u, thrust, flow), 1.0)
    return (np.linalg.norm(y[:3]) - ROCKET.Re) / 1e3


# --- what evaluate.py takes -------------------------------------------------------------------------------------------


@pytest.fixture
def shipped(command, tmp_path, monkeypatch):
    """A copy of the command's files in the place of results/."""
    for path in command[0].iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.setattr(optimum, "RESULTS", tmp_path)
    return tmp_path


def refuse(case):
    raise AssertionError(f"{case.key} was solved anew")


@pytest.mark.parametrize("env_id", ["RocketAscent-v0", "RocketAscentCutoff-v0", "TwoStageLEO-v0"])
def test_reference_is_the_solve(command, flights, shipped, monkeypatch, env_id):
    monkeypatch.setattr(optimum, "solve_and_fly", refuse)
    _, numbers, _ = command
    key, found = STORED.get(env_id, env_id), rocket_reference(env_id)
    assert found["reference_mass_kg"] == numbers[key]["final_mass_kg"]
    assert found["reference_time_s"] == numbers[key]["final_time_s"]
    np.testing.assert_allclose(found["y"][:-1], flights[key]["y"][:-1], rtol=0, atol=1e-3)
    assert found["error_norm"] < 2e-5 and found["t"][-1] == pytest.approx(flights[key]["t"][-1], abs=1e-3)
    assert found["nine_pitch_error_norm"] == pytest.approx(numbers[OPPONENTS[key]]["error_norm"], rel=1e-3)
    assert found["nine_pitch_error_norm"] < 1e-3


def drop_json(folder):
    (folder / "rocket_reference.json").unlink()


def flip_bits(folder):
    """One bit in the middle of the stored times: the archive's directory stays whole, their data does not."""
    path = folder / "rocket_reference.npz"
    data = bytearray(path.read_bytes())
    with ZipFile(path) as archive:
        entry = archive.getinfo("free_t.npy")
    data[entry.header_offset + 30 + len(entry.filename) + entry.compress_size // 2] ^= 1
    path.write_bytes(data)


def turn(folder):
    """Directions that no longer reach the target, as after a change of the dynamics."""
    with np.load(folder / "rocket_reference.npz") as file:
        arrays = dict(file)
    arrays["free_u"] = arrays["free_u"] + 1e-4
    np.savez_compressed(folder / "rocket_reference.npz", **arrays)


@pytest.mark.parametrize("damage", [drop_json, flip_bits, turn])
def test_reference_is_solved_anew_where_the_files_do_not_serve(command, flights, shipped, monkeypatch, damage):
    damage(shipped)
    before, solved = {path.name: path.read_bytes() for path in shipped.iterdir()}, []

    def solve(case):
        solved.append(case.key)
        return command[1][case.key], flights[case.key], None

    monkeypatch.setattr(optimum, "solve_and_fly", solve)
    found = rocket_reference("RocketAscentCutoff-v0")
    assert solved == ["free"] and found["error_norm"] < 2e-5
    assert found["reference_mass_kg"] == command[1]["free"]["final_mass_kg"]
    assert {path.name: path.read_bytes() for path in shipped.iterdir()} == before


def test_results_hold_the_command_s_files(command):
    """What is shipped in results/ is what the command gives; up to rounding on another machine."""
    _, numbers, arrays = command
    kept = json.loads((optimum.RESULTS / "rocket_reference.json").read_text())
    assert kept.keys() <= numbers.keys()
    for key in VEHICLES:
        assert kept[key]["final_mass_kg"] == pytest.approx(numbers[key]["final_mass_kg"], rel=1e-9)
    with np.load(optimum.RESULTS / "rocket_reference.npz") as file:
        assert set(file) <= set(arrays)
        for key in FREE:
            np.testing.assert_allclose(file[f"{key}_t"], arrays[f"{key}_t"], rtol=0, atol=1e-5)


def test_reference_needs_no_casadi():
    code = "import sys, baselines; baselines.rocket_reference('RocketAscent-v0'); sys.exit('casadi' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=60).returncode == 0


def test_unknown_id_is_refused():
    ids = "RocketAscent-v0, RocketAscentCutoff-v0, RocketAscentAnyOrbit-v0, RocketAscentLowOrbits-v0, TwoStageLEO-v0"
    with pytest.raises(ValueError, match=f"'Rocket-v0'; it must be one of {ids}$"):
        rocket_reference("Rocket-v0")


# --- opponent, failures -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "env_id, key, between, kg",
    [
        ("RocketAscentCutoff-v0", "free", [20, 60, 100, 180, 260, 330, 420], (7531, 3)),
        ("TwoStageLEO-v0", "TwoStageLEO-v0", [7, 25, 70, 90, 120, 160, 210, 250], (25890, 15)),
    ],
)
def test_nine_angles_are_all_the_opponent_knows(flights, env_id, key, between, kg):
    """Of the second vehicle pitch and yaw: its optimum leaves the target's plane."""
    flight = nine_pitch_angles(env_id, flights[key], VEHICLES[key])
    assert 1e-5 < flight["error_norm"] < 5e-4 and flight["final_mass_kg"] == pytest.approx(kg[0], abs=kg[1])
    changed = {**flights[key], "u": flights[key]["u"].copy()}
    changed["u"][between] = changed["y"][between, :3] / envs.ROCKET.Re  # up, between the nine times
    assert nine_pitch_angles(env_id, changed, VEHICLES[key])["error_norm"] == flight["error_norm"]


def test_final_time_is_bounded_by_the_flights_end():
    """Below the optimum's 924 s there is an optimum no more; above it the bound does not touch it."""
    case = optimum.AscentCase("short", replace(ROCKET, end_time=930.0))
    assert optimum.collocation_mesh(case, 900.0, 80).final_time == (261.0, 930.0)
    assert optimum.optimise_ascent(case)["final_time"] == pytest.approx(924.1392, abs=1e-3)


@pytest.mark.parametrize("ceiling_km", [None, 260.0])
def test_another_ceiling_is_another_reference(monkeypatch, flights, ceiling_km):
    """The paper's id with another ceiling, or none, does not find the stored optimum below 250 km."""
    solved = []
    numbers = {"final_mass_kg": 6644.0, "final_time_s": 961.0}
    monkeypatch.setattr(optimum, "solve_and_fly", lambda case: solved.append(case) or (numbers, flights["fixed"], None))
    monkeypatch.setitem(ROCKETS, "RocketAscent-v0", replace(ROCKETS["RocketAscent-v0"], ceiling_km=ceiling_km))
    found = rocket_reference("RocketAscent-v0")
    assert found["max_altitude_km"] > 250.1, "the flight without a ceiling"
    assert [(case.ceiling, case.free) for case in solved] == [(np.inf if ceiling_km is None else 260e3, False)]


@pytest.mark.parametrize("changed", [{"cutoff": False}, {"cutoff": False, "ceiling_km": 300.0}])
def test_another_rule_of_a_vehicle_is_another_reference(monkeypatch, changed):
    """Its stored optimum still reaches the orbit: earlier than at the end time, and above the ceiling."""
    monkeypatch.setattr(optimum, "solve_and_fly", refuse)
    env_id = "TwoStageLEO-v0"
    rocket_reference(env_id)
    monkeypatch.setitem(ROCKETS, env_id, replace(ROCKETS[env_id], **changed))
    with pytest.raises(AssertionError, match="solved anew"):
        rocket_reference(env_id)


def test_options_change_what_is_solved(monkeypatch, flights):
    solved = []
    numbers = {"final_mass_kg": 7000.0, "final_time_s": 924.0}
    monkeypatch.setattr(optimum, "solve_and_fly", lambda case: solved.append(case) or (numbers, flights["free"], None))
    mine = replace(ROCKET, payload=4000.0)
    rocket_reference("RocketAscentCutoff-v0", rocket=mine)
    rocket_reference("RocketAscentCutoff-v0", table_isp=True)
    rocket_reference("RocketAscentCutoff-v0", rocket=ROCKET, table_isp=False)
    assert [case.rocket for case in solved] == [mine, replace(ROCKET, table_isp=True)]


# --- failures ---------------------------------------------------------------------------------------------------------


def test_an_infeasible_ascent_is_an_error_of_one_line():
    """It says what to look at; 334.5108 is -arcsin(tan 28.5 / tan 51.6) in degrees."""
    case = optimum.AscentCase("heavy", replace(LEO, payload=30e3, raan=244.5))
    with pytest.raises(RuntimeError) as error:
        optimum.optimise_ascent(case, 8)
    message = str(error.value)
    assert re.match("^rocket ascent heavy: IPOPT stopped with [A-Za-z_]+ after [0-9]+ s: ", message)
    hints = [
        "payload, 30000.0 kg",
        "raan, 244.5 ",
        "334.5108 towards the north and 205.4892 towards the south",
        "its i, 51.6",
        "its argp",
        "its a and e",
    ]
    assert chr(10) not in message and all(hint in message for hint in hints)


def test_a_rocket_without_the_energy_is_refused_before_any_solve(monkeypatch):
    """Its delta-v by Tsiolkovsky: 3.0 and 3.4 km/s times the mass ratios' logarithms, and 359 m/s of turning Earth."""
    monkeypatch.setattr(optimum, "solve_from_guess", None)
    m0 = 433e3 + 111.5e3 + 45e3
    delta_v = 7.6e6 * 162 / 411e3 * math.log(m0 / (m0 - 411e3))
    delta_v += 934e3 * 393 / 107.5e3 * math.log((111.5e3 + 45e3) / (4e3 + 45e3))
    speed = round(delta_v + 7.29211585e-5 * 6378145 * math.cos(math.radians(28.5)))
    message = f"^rocket ascent heavy: .* {speed} m/s, .*; look at its payload, 45000.0 kg$"
    with pytest.raises(RuntimeError, match=message):
        optimum.optimise_ascent(optimum.AscentCase("heavy", replace(LEO, payload=45e3)))


def test_a_flight_that_misses_is_an_error(flights, monkeypatch):
    early = {"u": flights["fixed"]["u"], "final_time": 960.0}
    monkeypatch.setattr(optimum, "solve_from_guess", lambda case, mesh, guess, clock: early)
    optimum.solve_and_fly.cache_clear()
    with pytest.raises(RuntimeError, match="rocket ascent fixed: flown by the environment it misses by 0.0"):
        optimum.solve_and_fly(ASCENTS["fixed"])


def test_nothing_is_written_unless_asked(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    baselines.save(Namespace(json=None, npz=None), {}, {})
    assert not list(tmp_path.iterdir())


# --- other people's vehicles: coasts, orbits that come early, orbits out of reach -------------------------------------


def test_held_steps_arrive_where_a_spline_through_the_jumps_does_not():
    """Three solids with coasts of 51 and 164 s: the spline missed by 0.011. Twice the segments give the same mass."""
    stages = [
        Engine(16779.0, 15000.0, 469054.0, 248.7, 78.0),
        Engine(5607.0, 5080.0, 220345.0, 283.0, 64.0),
        Engine(1949.0, 1760.0, 106212.0, 283.0, 46.0),
    ]
    burns = (
        Burn(78.0, ((1, stages[0]),), ((1, stages[0]),)),
        Burn(129.0, ()),
        Burn(193.0, ((1, stages[1]),), ((1, stages[1]),)),
        Burn(357.0, ()),
        Burn(403.0, ((1, stages[2]),)),
    )
    orbit = {"a": 6378145.0 + 500e3, "e": 0.0, "i": 97.4, "raan": launch_raan(34.7, 97.4), "argp": 0.0}
    rocket = Rocket(burns=burns, payload=5.0, Cd=0.4, S=1.55, latitude=34.7, end_time=403.0, **orbit)
    case = optimum.AscentCase("solids", rocket)
    numbers, flight, collocated = optimum.solve_and_fly(case)
    assert flight["error_norm"] < 1e-9
    assert numbers["final_mass_kg"] == pytest.approx(flight["final_mass_kg"], abs=1e-6)
    finer = optimum.optimise_ascent(case, 160)["final_mass"]
    assert collocated["final_mass"] == pytest.approx(finer, rel=1e-6)
    assert finer - 0.02 < flight["final_mass_kg"] < finer, "held steps cost a little"


def test_an_orbit_before_the_last_burn_is_said_in_a_line():
    """A public table of the Saturn V, whose burn times make too good engines of it."""
    stages = [
        Engine(2.93e6, 2.8e6, 52.0e6, 318.2, 168.0),
        Engine(670e3, 630e3, 7.5e6, 473.4, 390.0),
        Engine(209494.0, 196e3, 1.5e6, 612.6, 785.0),
    ]
    ends = (168.0, 558.0, 1343.0)
    burns = tuple(Burn(end, ((1, stage),), ((1, stage),)) for end, stage in zip(ends, stages))
    burns = (*burns[:2], replace(burns[2], dropped=()))
    orbit = {"a": 6378145.0 + 200e3, "e": 0.0, "i": 28.573, "raan": launch_raan(28.573, 28.573), "argp": 0.0}
    rocket = Rocket(burns=burns, payload=45e3, Cd=0.25, S=80.0, latitude=28.573, end_time=1343.0, **orbit)
    message = "^rocket ascent early: the orbit is reached before the last burn begins, 558 s; leave that burn out"
    with pytest.raises(NoOptimum, match=message):
        optimum.optimise_ascent(optimum.AscentCase("early", rocket))


def test_a_solve_ends_in_its_seconds_and_is_heard_of(monkeypatch, capsys):
    """An argument of perigee that no ascent from this site can reach, with a second for all tries."""
    monkeypatch.setitem(ipopt.limit, "seconds", 1)
    monkeypatch.setattr(ipopt, "PATIENCE", 0.2)
    case = optimum.AscentCase("far", replace(ROCKET, argp=300.0, raan=90.0))
    begin = time.monotonic()
    message = "^rocket ascent far: not solved within . s .--solve-seconds.: .* at its raan, 90 degrees .*argp, 300 "
    with pytest.raises(NoOptimum, match=message):
        optimum.optimise_ascent(case)
    assert time.monotonic() - begin < 10
    assert capsys.readouterr().err.splitlines() == ["rocket ascent far: IPOPT is still solving; it stops after 1 s"]


def test_the_restart_of_the_page(monkeypatch):
    """Its file as printed, and its numbers: burn, coast, burn again."""
    page = (ROOT / "docs" / "rocket.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    monkeypatch.setattr(envs, "register_rocket", lambda env_id, rocket, cutoff: None)
    monkeypatch.setattr(envs, "ROCKETS", {})  # its file is read before two_stage_leo.py
    names = {}
    exec(code, names)
    numbers, flight, _ = optimum.solve_and_fly(optimum.AscentCase("restart", names["ROCKET"]))
    assert f"{flight['final_mass_kg']:.1f}" == "24459.7" and f"{flight['final_time_s']:.2f}" == "1135.04"
    assert flight["error_norm"] < 1e-9
    assert "24 459.7 kg at 1135.04 s" in page
