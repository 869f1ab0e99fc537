"""What is taken along: the tables and files read again, against closed forms, SPICE and astropy; bad input."""

import csv
import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import spiceypy

import baselines
import envs
import evaluate
from batched.task import BatchedTask
from common.errors import BadInput
from common.tasks import task_of
from exports import extras
from exports.columns import csv_bytes
from exports.offers import offer
from landing.metrics import draws, flight_arrays, fly_draws
from phased.problem import flights_of_seed
from rocket.task import RocketTask

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results"
SITE = 20.0  # degrees east
EXTRAS = "needs requirements-extras.txt"
ROCKET_OPTIONS = [{"action_frame": "local"}, {"observe_draw": True, "dispersion": 1.0}]
PHASED_OPTIONS = [{"scaled_action": True}, {"observe_phase": False}]


def command(monkeypatch, capsys, *words):
    """`python evaluate.py export words...` in this process: what it prints, or the line with which it ends."""
    monkeypatch.setattr(sys, "argv", ["evaluate.py", "export", *map(str, words)])
    try:
        evaluate.main()
    except SystemExit as stop:
        return str(stop.code)
    return capsys.readouterr().out


def exported(folder, name, tmp_path, **place):
    """One file of a results folder."""
    path = tmp_path / f"flight.{name}"
    evaluate.export(RESULTS / folder, {name: path}, **place)
    return path


def table(path):
    """A CSV's columns; empty cells are NaN."""
    with open(path, newline="") as file:
        head, *rows = csv.reader(file)
    cells = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows])
    return dict(zip(head, cells.T, strict=True))


def columns(found, *names):
    return np.column_stack([found[name] for name in names])


def arrays_of(folder):
    with np.load(RESULTS / folder / "eval.npz") as file:
        return dict(file)


# --- names of what is observed and commanded --------------------------------------------------------------------------


def options_of(env_id):
    if env_id in envs.ROCKETS:
        return [{}, *ROCKET_OPTIONS]
    if env_id in envs.LANDERS:
        hidden = {"observe_velocity": False, "observe_command": False}
        return [{}, {"observe_acceleration": True, "observe_draw": True}, hidden]
    scores = [{"observe_draw": True}] if envs.PROBLEMS[env_id].scores else []
    return [{}, *PHASED_OPTIONS, *scores]


@pytest.mark.parametrize("env_id", [*envs.PROBLEMS, *envs.ROCKETS, *envs.LANDERS])
def test_every_number_of_a_policy_has_a_name_and_a_unit(env_id):
    for options in options_of(env_id):
        batch = gym.make_vec(env_id, num_envs=1, **options)
        interface = offer(task_of(env_id), "interface")(**options)
        for named, space in (
            (interface.observation, batch.single_observation_space),
            (interface.action, batch.single_action_space),
        ):
            names = [name for name, _ in named]
            assert len(names) == len(set(names)) == space.shape[0], options
            assert all(unit for _, unit in named)


def test_a_rockets_names_are_those_of_its_observation():
    batch = gym.make_vec("RocketAscent-v0", num_envs=1, observe_draw=True, dispersion=1.0)
    z = np.arange(batch.draw.size, dtype=float)[None] / 10
    obs, _ = batch.reset(options={"draw": z})
    interface = offer(task_of("RocketAscent-v0"), "interface")(observe_draw=True, dispersion=1.0)
    names = [name for name, _ in interface.observation]
    seen = dict(zip(names, obs[0]))
    assert (seen["x"], seen["vy"]) == (batch.y[0, 0], batch.y[4, 0])
    assert (seen["time_left"], seen["phase"]) == (1.0, 0.0)
    assert seen["drag"] == z[0, envs.draw_names(envs.ROCKET).index("drag")]


def test_the_frame_of_an_action_is_the_environments():
    """The note's n and formulas give the direction that the environment flies."""
    batch = gym.make_vec("RocketAscentCutoff-v0", num_envs=1, action_frame="local")
    note = offer(task_of("RocketAscentCutoff-v0"), "interface")(action_frame="local").notes
    n = np.array([float(word) for word in note.split("n = (")[1].split(")")[0].split(",")])
    batch.reset()
    for action in ([1.0, 0.2, -0.1], [0.5, 0.6, 0.3]):
        r = batch.y[:3, 0].copy()
        batch.advance(np.array([action]))
        up = r / np.linalg.norm(r)
        along = np.cross(n, up) / np.linalg.norm(np.cross(n, up))
        direction = np.array([up, along, np.cross(up, along)]).T @ action
        np.testing.assert_allclose(batch.u[:, 0], direction / np.linalg.norm(direction), atol=1e-8)


# --- tables -----------------------------------------------------------------------------------------------------------


def test_a_number_is_read_again_to_the_last_bit():
    values = np.array([0.1, -1e-300, np.pi, 6378145.0, np.nan])
    text = csv_bytes({"a": values, "flag": values > 0, "n": np.arange(5)}).decode()
    rows = list(csv.reader(text.splitlines()))
    assert rows[0] == ["a", "flag", "n"] and rows[-1] == ["", "0", "4"] and rows[1][1] == "1"
    assert [float(row[0]) for row in rows[1:-1]] == values[:-1].tolist()


def test_the_double_integrators_steps_are_its_closed_form(tmp_path):
    """From a row, with its control held, to the next: x2 + u dt, x1 + x2 dt + u dt^2 / 2."""
    found = table(exported("di", "csv", tmp_path))
    flights, rows = 30, 51
    t, x1, x2, u = (found[name].reshape(flights, rows) for name in ("t_s", "x1", "x2", "u"))
    assert np.array_equal(found["flight"].reshape(flights, rows)[:, 0], np.arange(flights))
    dt = np.diff(t, axis=1)
    u, ends = u[:, :-1], u[:, -1]
    np.testing.assert_allclose(x2[:, 1:], x2[:, :-1] + u * dt, atol=1e-12)
    np.testing.assert_allclose(x1[:, 1:], x1[:, :-1] + x2[:, :-1] * dt + u * dt**2 / 2, atol=1e-12)
    assert np.isnan(ends).all() and np.abs(u).max() <= 4


def test_a_small_problems_flights_have_their_costs(tmp_path):
    """The table's J by its formula, of the rows of the steps."""
    steps = table(exported("di", "csv", tmp_path))
    flights = table(exported("di", "flights", tmp_path))
    x, u = columns(steps, "x1", "x2").reshape(30, 51, 2), steps["u"].reshape(30, 51)[:, :-1]
    cost = (x[:, :-1] ** 2).sum((1, 2)) + 0.1 * (u**2).sum(1) + 20 * (x[:, -1] ** 2).sum(1)
    np.testing.assert_allclose(flights["cost"], cost, rtol=1e-12)
    assert np.array_equal(columns(flights, "x1_end", "x2_end"), x[:, -1])
    assert np.array_equal(columns(flights, "x1_start", "x2_start"), x[:, 0])
    lqr = baselines.reference("DoubleIntegrator-v0", x[:, 0])
    np.testing.assert_allclose(flights["cost_of_optimum"], lqr["cost"], rtol=1e-9)


def test_a_flight_with_an_event_ends_at_its_moment():
    """Goddard's rocket by its own table: no rows behind the apex, and the last row's time is that of the event."""
    env_id, n = "Goddard-v0", 3
    x0, draw = flights_of_seed(envs.PROBLEMS[env_id], 0, n)
    flown = envs.fly(env_id, lambda obs, t: np.full((n, 1), 3.5 if t < 10 else 0.0), x0)
    problem = envs.PROBLEMS[env_id]
    arrays = {"t": problem.dt * np.arange(problem.steps + 1), "cost_reference": flown["cost"], **flown}
    found = offer(task_of(env_id), "step_columns")(arrays, 0.0)
    last = np.flatnonzero(np.append(np.diff(found["flight"]) > 0, True))
    assert last[0] < problem.steps
    np.testing.assert_allclose(found["t_s"][last], flown["final_time"])
    ends = offer(task_of(env_id), "flight_columns")(arrays, {})
    np.testing.assert_array_equal(ends["x1_end"], found["x1"][last])
    np.testing.assert_array_equal(ends["t_end_s"], flown["final_time"])


def test_a_rockets_rows_over_the_ground_are_spices(tmp_path):
    """Latitude, longitude and altitude by SPICE's rotations and its spherical coordinates."""
    found = table(exported("two_stage_leo", "csv", tmp_path, launch_longitude=SITE))
    arrays, rocket = arrays_of("two_stage_leo"), envs.ROCKETS["TwoStageLEO-v0"].rocket
    assert np.array_equal(columns(found, "x_m", "y_m", "z_m", "vx_m_s", "vy_m_s", "vz_m_s", "mass_kg"), arrays["y"])
    assert np.array_equal(columns(found, "thrust_x", "thrust_y", "thrust_z")[:-1], arrays["u"])
    assert (found["latitude_deg"][0], found["longitude_deg"][0]) == pytest.approx((rocket.latitude, SITE))
    assert found["altitude_m"][0] == pytest.approx(0.0, abs=1e-6)
    ends = [burn.end for burn in rocket.burns]
    assert all(found["burn"] == [1 + sum(end <= t for end in ends[:-1]) for t in found["t_s"]])
    for k in (40, 150, -1):
        turn = spiceypy.rotate(rocket.omega_e * found["t_s"][k] - np.radians(SITE), 3)
        radius, longitude, latitude = spiceypy.reclat(turn @ arrays["y"][k, :3])
        expected = radius - rocket.Re, np.degrees(latitude), np.degrees(longitude)
        row = found["altitude_m"][k], found["latitude_deg"][k], found["longitude_deg"][k]
        assert row == pytest.approx(expected, rel=1e-9)


def test_a_monte_carlo_has_the_statistics_of_its_evaluation(tmp_path):
    found = table(exported("rocket_dispersed", "flights", tmp_path))
    metrics = json.loads((RESULTS / "rocket_dispersed" / "eval.json").read_text())
    assert len(found["flight"]) == metrics["dispersed_starts"] == 1705
    assert np.median(found["error_norm"]) == pytest.approx(metrics["dispersed_error_median"], rel=1e-9)
    assert found["mass_kg"].mean() == pytest.approx(metrics["dispersed_mass_mean_kg"], rel=1e-12)
    assert found["dry"].sum() == metrics["dispersed_dry"] and found["crashed"].sum() == metrics["dispersed_crashed"]
    rocket = envs.ROCKETS[metrics["env_id"]].rocket
    perigee = rocket.a * (1 - rocket.e) / 1e3 - rocket.Re / 1e3
    expected = metrics["dispersed_perigee_error_mean_km"]
    assert (found["perigee_km"] - perigee).mean() == pytest.approx(expected, abs=1e-6)
    assert abs(found["score_drag"].std() - 1) < 0.05  # standard scores


def steer(obs, t):
    """A lander's thrust that ends somewhere on the ground."""
    left = np.maximum(45.0 - obs[:, 6:7], 4.0)
    below = obs[:, :3] + [0.0, 0.0, 2.0]  # 2 m below the pad, so that none hovers above it
    return 2000 * (-6 * below / left**2 - 4 * obs[:, 3:6] / left + [0.0, 0.0, 3.7114]) / 24000


def test_a_landers_tables(tmp_path):
    """The propellant by the rocket equation of the rows, the touchdown at the ground, one row a flight."""
    z = draws(0, 6)
    flown = fly_draws("MarsLanding-v0", lambda z: steer, z)
    best = {key: value[:4] for key, value in flown.items()}
    arrays, task = flight_arrays(flown, best), task_of("MarsLanding-v0")
    steps = offer(task, "step_columns")(arrays, 0.0)
    flights = offer(task, "flight_columns")(arrays, {})
    last = np.flatnonzero(np.append(np.diff(steps["flight"]) > 0, True))
    np.testing.assert_allclose(steps["t_s"][last], flown["final_time"])
    np.testing.assert_allclose(columns(steps, "x_m", "z_m")[last], flown["final_y"][:, [0, 2]])
    np.testing.assert_allclose(flights["z_m_end"], 0.0, atol=1e-6)
    assert np.isnan(flights["fuel_of_optimum_kg"]).tolist() == [False] * 4 + [True] * 2
    for row in range(6):
        mine = {name: column[steps["flight"] == row] for name, column in steps.items()}
        command = np.column_stack([mine[f"thrust_{axis}_N"] for axis in "xyz"])[:-1]
        acts = np.column_stack([mine[f"effectiveness_{axis}"] for axis in "xyz"])[:-1]
        thrust = np.clip(np.linalg.norm(command * acts, axis=1), 4000, 24000)
        burnt = (thrust * np.diff(mine["t_s"])).sum() / (210 * 9.81)
        assert flights["fuel_kg"][row] == pytest.approx(burnt, rel=1e-9)
        assert flights["mass_kg_start"][row] - flights["mass_kg_end"][row] == pytest.approx(burnt, rel=1e-9)


def test_episodes_without_a_table():
    """A row for each observation of an episode, numbered names, and its return."""
    obs = np.arange(24.0).reshape(2, 4, 3)
    u = np.ones((2, 3, 1))
    obs[1, 3] = u[1, 2] = np.nan  # the second episode is one step shorter
    reward = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 0.0]])
    arrays = {"t": np.arange(4.0), "obs": obs, "u": u, "reward": reward}
    task = BatchedTask("Mine-v0")
    steps = offer(task, "step_columns")(arrays, 0.0)
    flights = offer(task, "flight_columns")(arrays, {})
    assert steps["flight"].tolist() == [0] * 4 + [1] * 3 and steps["obs3"].tolist() == [2, 5, 8, 11, 14, 17, 20]
    assert flights["steps"].tolist() == [3, 2] and flights["return"].tolist() == [6, 9]


# --- files for trajectory tools ---------------------------------------------------------------------------------------


@pytest.fixture
def astropy():
    """Without its downloads."""
    pytest.importorskip("oem", reason=EXTRAS)
    from astropy.utils import iers

    with iers.conf.set_temp("auto_download", False):
        yield


def test_an_oem_is_read_again(tmp_path, astropy):
    """Each state within 1 mm and 1 um/s of the evaluation's, in a frame turned about the Earth's axis."""
    from oem import OrbitEphemerisMessage

    path = exported("rocket_cutoff", "oem", tmp_path)
    message, arrays = OrbitEphemerisMessage.open(path), arrays_of("rocket_cutoff")
    (segment,) = message.segments
    assert [segment.metadata[key] for key in ("CENTER_NAME", "REF_FRAME", "TIME_SYSTEM")] == ["EARTH", "TOD", "UTC"]
    r = 1e3 * np.array([state.position for state in message.states])
    v = 1e3 * np.array([state.velocity for state in message.states])
    angle = np.arctan2(r[0, 1], r[0, 0])  # our x axis points to the launch site at lift-off
    back = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    assert np.abs(r @ back.T - arrays["y"][:, :3]).max() < 1e-3
    assert np.abs(v @ back.T - arrays["y"][:, 3:6]).max() < 1e-6
    begin = datetime(2026, 1, 1, tzinfo=UTC)
    seconds = [(state.epoch.to_datetime(timezone=UTC) - begin).total_seconds() for state in message.states]
    np.testing.assert_allclose(seconds, arrays["t"], atol=2e-6)


def test_an_oem_begins_at_the_launch_site(tmp_path, astropy):
    """By astropy's true equator and equinox (TETE) and its terrestrial frame, at another epoch and site."""
    from astropy import units
    from astropy.coordinates import ITRS, TETE, CartesianRepresentation
    from oem import OrbitEphemerisMessage

    epoch = datetime(2024, 7, 4, 15, 30, tzinfo=UTC)
    path = exported("rocket_cutoff", "oem", tmp_path, epoch=epoch, launch_longitude=SITE)
    first = OrbitEphemerisMessage.open(path).states[0]
    there = TETE(CartesianRepresentation(*first.position, unit=units.km), obstime=first.epoch)
    ground = there.transform_to(ITRS(obstime=first.epoch)).cartesian.xyz.to_value(units.m)
    _, longitude, latitude = spiceypy.reclat(ground)
    assert np.degrees([longitude, latitude]).tolist() == pytest.approx([SITE, 28.5], abs=0.004)  # 0.9 s of UT1


def test_czml_shows_the_flight(tmp_path):
    """From the launch site at the epoch to the altitude of the evaluation, with a label for each burn."""
    epoch = datetime(2027, 3, 1, 6, tzinfo=UTC)
    path = exported("rocket_cutoff", "czml", tmp_path, epoch=epoch, launch_longitude=SITE)
    document, vehicle = json.loads(path.read_text())
    arrays = arrays_of("rocket_cutoff")
    begin, end = map(datetime.fromisoformat, document["clock"]["interval"].split("/"))
    assert begin == epoch and (end - begin).total_seconds() == pytest.approx(arrays["t"][-1], abs=1e-6)
    t, longitude, latitude, height = np.reshape(vehicle["position"]["cartographicDegrees"], (-1, 4)).T
    np.testing.assert_allclose(t, arrays["t"], atol=1e-6)
    assert t[-1] == (end - begin).total_seconds()  # after the last sample Cesium shows nothing
    assert vehicle["position"]["forwardExtrapolationType"] == "HOLD"
    assert (longitude[0], latitude[0], height[0]) == pytest.approx((SITE, 28.5, 0.0), abs=1e-6)
    np.testing.assert_allclose(height, np.linalg.norm(arrays["y"][:, :3], axis=1) - 6378145.0, atol=1e-6)
    ends = [datetime.fromisoformat(label["interval"].split("/")[1]) for label in vehicle["label"]["text"]]
    seconds = [(moment - epoch).total_seconds() for moment in ends]
    assert seconds == pytest.approx([75.2, 150.4, 261.0, arrays["t"][-1]], abs=1e-6)


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "folder, words, line",
    [
        ("di", ["--oem={}"], "evaluate.py: the env_id is DoubleIntegrator-v0; for OEM and CZML it must be a rocket's"),
        (
            "rocket_fixed",
            ["--flights={}"],
            "evaluate.py: the evaluation of RocketAscent-v0 holds one flight; --flights",
        ),
        ("di", [], "evaluate.py: nothing to export: name a file by --onnx, --csv, --flights, --oem, --czml"),
        ("di", ["--csv={}", "--flights={}"], "evaluate.py: two of the flags name one file"),
        (
            "rocket_cutoff",
            ["--csv={}", "--epoch=2027-01-01"],
            "evaluate.py: --epoch is 2027-01-01T00:00:00Z; it needs --oem or --czml",
        ),
        ("memory", ["--csv={}"], f"evaluate.py: {RESULTS}/memory/eval.json is not there"),
        ("rocket_cutoff", ["--czml={}", "--epoch=tomorrow"], "error: argument --epoch: 'tomorrow' must be a moment"),
        ("rocket_cutoff", ["--czml={}", "--launch-longitude=1e9"], "error: argument --launch-longitude: '1e9' must be"),
    ],
)
def test_what_cannot_be_exported_is_one_line(folder, words, line, tmp_path, monkeypatch, capsys):
    target = tmp_path / "file"
    said = command(monkeypatch, capsys, RESULTS / folder, *(word.format(target) for word in words))
    assert said.startswith(line) and "\n" not in said.strip()
    assert not list(tmp_path.iterdir())


def test_one_refusal_writes_no_file(tmp_path, monkeypatch, capsys):
    said = command(monkeypatch, capsys, RESULTS / "di", "--csv", tmp_path / "a.csv", "--czml", tmp_path / "a.czml")
    assert "it must be a rocket's" in said and not list(tmp_path.iterdir())


@pytest.mark.parametrize("name, packages", [("onnx", "onnx and onnxscript"), ("oem", "oem")])
def test_a_missing_package_is_named(name, packages, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(extras, "find_spec", lambda package: None)
    said = command(monkeypatch, capsys, RESULTS / "rocket_cutoff", f"--{name}", tmp_path / "file")
    assert said == f"evaluate.py: --{name} needs {packages}: pip install -r requirements-extras.txt"
    assert not list(tmp_path.iterdir())


def test_another_planets_rocket_is_no_track():
    mission = SimpleNamespace(rocket=SimpleNamespace(mu=4.28e13, body="ground"))
    with pytest.raises(BadInput, match="mu of Mars-v0 is 42800000000000.0; it must be the Earth's"):
        offer(RocketTask("Mars-v0", mission), "track")({})


def test_a_family_without_exports_is_one_line():
    task = SimpleNamespace(env_id="Mine-v0")  # of a folder that `exports/` does not know
    for name in ("interface", "step_columns", "flight_columns", "track", "page"):
        with pytest.raises(BadInput, match="^the env_id is Mine-v0; "):
            offer(task, name)
