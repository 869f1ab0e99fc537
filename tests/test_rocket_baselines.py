"""The rocket's optima in baselines.py against published numbers, the maximum principle and their flights."""

import json
import subprocess
import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import baselines
from baselines import ASCENTS, PITCH_TIMES, ROCKET_REFERENCES, collocate, nine_pitch_angles, rocket_reference
from envs import ROCKET, fly_rocket, rk4
from envs import ascent as dynamics

ROOT = Path(__file__).resolve().parents[1]
KEYS = {"final_mass_kg", "final_time_s", "error_norm", "replay_error_norm", "solve_seconds", "status"}
FREE = ("free", "free_table_isp", "drag_free")


@pytest.fixture(scope="module")
def command(tmp_path_factory):
    """One run of `python baselines.py rocket`: the folder with its files, its numbers and its arrays."""
    folder = tmp_path_factory.mktemp("results")
    args = baselines.parse_args(
        ["rocket", "--json", str(folder / "rocket_reference.json"), "--npz", str(folder / "rocket_reference.npz")]
    )
    args.run(args)
    numbers = json.loads((folder / "rocket_reference.json").read_text())
    with np.load(folder / "rocket_reference.npz") as file:
        return folder, numbers, dict(file)


@pytest.fixture(scope="module")
def flights(command):
    """What the npz holds, flown by the environment without anything from baselines.py."""
    _, _, arrays = command
    return {key: fly(arrays, key) for key in ASCENTS}


def fly(arrays, key, env_id="RocketAscent-v0"):
    rocket, u = ASCENTS[key].rocket, arrays[f"{key}_u"]
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


def test_pontryagin_angle_sees_an_error():
    u = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    angle = baselines.pontryagin_angle({"u": u, "costate": 7.0 * np.array([[1.0, 0, 0], [0, -1, 0], [1, 0, 1]])})
    np.testing.assert_allclose(angle, [0, 180, 45])


def test_other_meshes_give_the_same_mass(command):
    _, numbers, _ = command
    coarse, fine = (abs(numbers["checks"][f"mass_change_kg_{n}_segments"]) for n in (40, 160))
    assert fine < 1e-6 and fine < coarse < 1e-4


def test_drag_costs_mass(command):
    _, numbers, _ = command
    gain = numbers["drag_free"]["final_mass_kg"] - numbers["free"]["final_mass_kg"]
    assert gain == pytest.approx(numbers["checks"]["drag_free_mass_gain_kg"]) and 600 < gain < 750
    assert replace(ROCKET, Cd=0.0) == ASCENTS["drag_free"].rocket


def test_solving_twice_gives_the_same_bits(command):
    _, numbers, arrays = command
    again, flight, _ = baselines.solve_ascent("free")
    assert {**again, "solve_seconds": 0} == {**numbers["free"], "solve_seconds": 0}
    np.testing.assert_array_equal(flight["u"], arrays["free_u"])


def test_optimum_for_the_orbit_reached():
    """For the target's own elements it is the known optimum; a lower apogee, with the same perigee, leaves more."""
    elements = {"a_km": 24361.14, "e": 0.7308, "i_deg": 28.5, "raan_deg": 269.8, "argp_deg": 130.5}
    assert baselines.reached_optimum(elements)["final_mass"] == pytest.approx(7529.712296, rel=1e-8)
    lower = elements | {"a_km": 24361.14 - 100, "e": 1 - 24361.14 * (1 - 0.7308) / (24361.14 - 100)}
    assert 7530 < baselines.reached_optimum(lower)["final_mass"] < 7550


# --- flights ----------------------------------------------------------------------------------------------------------


def test_every_solve_is_ready_to_fly(command, flights):
    _, numbers, arrays = command
    assert set(arrays) == {f"{key}_{name}" for key in ASCENTS for name in "tu"}
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


def test_no_ascent_flies_through_the_ground(flights):
    for flight in flights.values():
        assert (np.linalg.norm(flight["y"][1:, :3], axis=1) - ROCKET.Re).min() > 0


# --- what evaluate.py takes -------------------------------------------------------------------------------------------


@pytest.fixture
def shipped(command, tmp_path, monkeypatch):
    """A copy of the command's files in the place of results/."""
    for path in command[0].iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.setattr(baselines, "RESULTS", tmp_path)
    return tmp_path


def refuse(key):
    raise AssertionError(f"{key} was solved anew")


@pytest.mark.parametrize("env_id", ROCKET_REFERENCES)
def test_reference_is_the_solve(command, flights, shipped, monkeypatch, env_id):
    monkeypatch.setattr(baselines, "solve_ascent", refuse)
    _, numbers, _ = command
    key, found = ROCKET_REFERENCES[env_id], rocket_reference(env_id)
    assert found["reference_mass_kg"] == numbers[key]["final_mass_kg"]
    assert found["reference_time_s"] == numbers[key]["final_time_s"]
    np.testing.assert_allclose(found["y"][:-1], flights[key]["y"][:-1], rtol=0, atol=1e-3)
    assert found["error_norm"] < 2e-5 and found["t"][-1] == pytest.approx(flights[key]["t"][-1], abs=1e-3)
    opponent = {"free": "nine_pitch_angles", "fixed_capped": "nine_pitch_angles_fixed"}[key]
    assert found["nine_pitch_error_norm"] == pytest.approx(numbers[opponent]["error_norm"], rel=1e-3)
    assert found["nine_pitch_error_norm"] < 1e-3


def drop_json(folder):
    (folder / "rocket_reference.json").unlink()


def cut_npz(folder):
    path = folder / "rocket_reference.npz"
    path.write_bytes(path.read_bytes()[:2000])


def forget_key(folder):
    (folder / "rocket_reference.json").write_text('{"fixed_capped": {}}')


def break_json(folder):
    (folder / "rocket_reference.json").write_text("[1, 2")


def turn(folder):
    """Directions that no longer reach the target, as after a change of the dynamics."""
    with np.load(folder / "rocket_reference.npz") as file:
        arrays = dict(file)
    arrays["free_u"] = arrays["free_u"] + 1e-4
    np.savez_compressed(folder / "rocket_reference.npz", **arrays)


def shorten(folder):
    with np.load(folder / "rocket_reference.npz") as file:
        arrays = dict(file)
    arrays["free_u"] = arrays["free_u"][:100]
    np.savez_compressed(folder / "rocket_reference.npz", **arrays)


@pytest.mark.parametrize("damage", [drop_json, cut_npz, forget_key, break_json, turn, shorten])
def test_reference_is_solved_anew_where_the_files_do_not_serve(command, flights, shipped, monkeypatch, damage):
    damage(shipped)
    before, solved = {path.name: path.read_bytes() for path in shipped.iterdir()}, []

    def solve(key):
        solved.append(key)
        return command[1][key], flights[key], None

    monkeypatch.setattr(baselines, "solve_ascent", solve)
    found = rocket_reference("RocketAscentCutoff-v0")
    assert solved == ["free"] and found["error_norm"] < 2e-5
    assert found["reference_mass_kg"] == command[1]["free"]["final_mass_kg"]
    assert {path.name: path.read_bytes() for path in shipped.iterdir()} == before


def test_results_hold_the_command_s_files(command):
    """What is shipped in results/ is what the command gives; up to rounding on another machine."""
    _, numbers, arrays = command
    kept = json.loads((baselines.RESULTS / "rocket_reference.json").read_text())
    assert kept.keys() == numbers.keys()
    for key in ASCENTS:
        assert kept[key]["final_mass_kg"] == pytest.approx(numbers[key]["final_mass_kg"], rel=1e-9)
    with np.load(baselines.RESULTS / "rocket_reference.npz") as file:
        assert set(file) == set(arrays)
        np.testing.assert_allclose(file["free_t"], arrays["free_t"], rtol=0, atol=1e-5)


def test_reference_needs_no_casadi():
    code = "import sys, baselines; baselines.rocket_reference('RocketAscent-v0'); sys.exit('casadi' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=60).returncode == 0


def test_unknown_id_is_refused():
    with pytest.raises(ValueError, match="'Rocket-v0'; it must be one of RocketAscentCutoff-v0, RocketAscent-v0"):
        rocket_reference("Rocket-v0")


# --- opponent, failures -----------------------------------------------------------------------------------------------


def test_nine_angles_are_all_the_opponent_knows(flights):
    flight = nine_pitch_angles("RocketAscentCutoff-v0", flights["free"])
    assert len(PITCH_TIMES) + 5 == 9
    assert 1e-5 < flight["error_norm"] < 5e-4 and flight["final_mass_kg"] == pytest.approx(7531, abs=3)
    changed = {**flights["free"], "u": flights["free"]["u"].copy()}
    changed["u"][[20, 60, 100, 180, 260, 330, 420]] = [1.0, 0.0, 0.0]  # between the nine times
    assert nine_pitch_angles("RocketAscentCutoff-v0", changed)["error_norm"] == flight["error_norm"]


def test_an_infeasible_ascent_is_an_error_of_one_line(monkeypatch):
    monkeypatch.setitem(ASCENTS, "heavy", ASCENTS["free"]._replace(key="heavy", rocket=replace(ROCKET, payload=40e3)))
    with pytest.raises(RuntimeError, match="^rocket ascent heavy: IPOPT stopped with [A-Za-z_]+$"):
        collocate(ASCENTS["heavy"], 8)


def test_a_flight_that_misses_is_an_error(flights, monkeypatch):
    early = {"u": flights["fixed"]["u"], "final_time": 960.0}
    monkeypatch.setattr(baselines, "ascend", lambda case, mesh, guess: early)
    with pytest.raises(RuntimeError, match="rocket ascent fixed: flown by the environment it misses by 0.0"):
        baselines.solve_ascent("fixed")


def test_nothing_is_written_unless_asked(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    baselines.save(Namespace(json=None, npz=None), {}, {})
    assert not list(tmp_path.iterdir())
