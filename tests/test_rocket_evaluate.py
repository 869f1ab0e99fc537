"""evaluate.py on the rocket: metrics, arrays, table, figures against plain formulas and CSPICE, results, bad input."""

import json
import math
import sys

import numpy as np
import pytest
import spiceypy
from helpers import figure_of, headline_of, table_of
from rocket_oracle import CUTOFF, FIXED, LEO, MU, RE, VEHICLES

import envs
import evaluate
from common.files import write_json, write_npz
from common.tasks import task_of
from rocket.metrics import rocket_metrics

IDS = [FIXED, CUTOFF, LEO]
PAPER = {"a_km": 24361.14, "e": 0.7308, "i_deg": 28.5, "raan_deg": 269.8, "argp_deg": 130.5}
NODE = math.degrees(math.asin(math.tan(math.radians(28.5)) / math.tan(math.radians(51.6))))
CIRCLE = {"a_km": 6778.145, "e": 0.0, "i_deg": 51.6, "raan_deg": 360 - NODE, "argp_deg": 0.0}  # of no perigee: none
TARGETS = {FIXED: PAPER, CUTOFF: PAPER, LEO: CIRCLE}
START_MASS = {FIXED: 301454, CUTOFF: 301454, LEO: 564500}  # kg
LAST_BURN = {FIXED: (261, 23464, 16820 / 700), LEO: (162, 131500, 107500 / 393)}  # s, kg, kg/s
LAST_BURN[CUTOFF] = LAST_BURN[FIXED]

# INTERFACE, "eval.json": all but what the script adds (seed, checkpoint_sha256, total_updates, ...)
COMMON = {"env_id", "eval_seed", "eval_starts", "episodic_return", "reference_episodic_return"}
ROCKET = "error_norm perigee_km apogee_km a_error_km e_error i_error_deg raan_error_deg argp_error_deg final_mass_kg"
ROCKET += " final_time_s mass_ratio reference_mass_kg reference_time_s max_altitude_km success"
PARTS = {"R_orbital", "R_trajectory", "R_guidance", "R_penalties", "R_terminal"}
EXTRA = {"points", "crashed", "min_altitude_after_300s_km", "nine_pitch_error_norm", "reference_error_norm"}
EXTRA |= {f"reference_{key}" for key in (*PAPER, "perigee_km", "apogee_km", "max_altitude_km")}
KEYS = COMMON | set(ROCKET.split()) | set(PAPER) | PARTS | EXTRA | {"reference_min_altitude_after_300s_km"}
KEYS_OF = {FIXED: KEYS, CUTOFF: KEYS, LEO: KEYS - {"argp_error_deg"}}
ARRAYS = {"t", "u", "y", "reward", "t_reference", "u_reference", "y_reference"}

TIMES = [0, 15, 40, 75, 150, 261, 500, 800, 960]  # s
BY_HAND = [90, 84, 68, 50, 30, 18, 4, -2, -4]  # degrees above the horizon: high, but it reaches the orbit's energy
LOWER = [90, 82, 65, 46, 28, 18, 5, -1, -4]
TIMES_OF = {FIXED: TIMES, CUTOFF: TIMES, LEO: [0, 10, 40, 80, 162, 250, 350, 450, 554]}
BY_HAND_OF = {FIXED: BY_HAND, CUTOFF: BY_HAND, LEO: [90, 88, 70, 52, 33, 26, 15, 4, -6]}
LOWER_OF = {FIXED: LOWER, CUTOFF: LOWER, LEO: [70, 67, 62, 52, 43, 34, 20, 2, -15]}
TARGET_ORBIT, REACHED = "of the optimum's for the target orbit", "of the optimum's for the orbit reached"
WEAVE = [0, 261, 500, 961], [0, 0, 4, -4]  # s, degrees from the target plane


def programme(pitch, times=TIMES, yaw=((0, 961), (0, 0))):
    """A policy in the local frame that flies a pitch programme (degrees at times in s), and one of yaw."""

    def policy(obs, step):
        p, y = math.radians(np.interp(2 * step, times, pitch)), math.radians(np.interp(2 * step, *yaw))
        return 3.0 * np.array([[math.sin(p), math.cos(p) * math.cos(y), math.cos(p) * math.sin(y)]])

    return policy


def by_hand(env_id):
    """The weaving hand-made programme of a vehicle."""
    return programme(BY_HAND_OF[env_id], TIMES_OF[env_id], WEAVE)


def stub(env_id):
    """A hand-made reference in the form of `baselines.rocket_reference`."""
    flight = envs.fly_rocket(env_id, programme(LOWER_OF[env_id], TIMES_OF[env_id]), action_frame="local")
    mass, time = flight["final_mass_kg"], flight["final_time_s"]
    return flight | {"reference_mass_kg": mass, "reference_time_s": time, "nine_pitch_error_norm": 0.0123}


@pytest.fixture(scope="module")
def references():
    return {env_id: stub(env_id) for env_id in IDS}


@pytest.fixture(scope="module")
def flown(references):
    """Metrics and arrays by id, of the weaving hand-made programme."""
    return {
        env_id: evaluate.evaluate(env_id, by_hand(env_id), 3, 50, reference, action_frame="local")
        for env_id, reference in references.items()
    }


@pytest.fixture(scope="module")
def crashed(references):
    return evaluate.evaluate(CUTOFF, programme([-20] * 9), 3, 50, references[CUTOFF], action_frame="local")


def norm(a):
    return math.sqrt(sum(x * x for x in a))


def elements(y):
    """Elements of a state by CSPICE, km and degrees."""
    rp, e, i, node, argp, *_ = spiceypy.oscelt(y[:6], 0.0, MU)
    return dict(zip(PAPER, (rp / (1 - e) / 1e3, e, *np.degrees([i, node, argp]).tolist())))


# ---------------------------------------------------------------------------------------------------------------------
# Metrics and arrays
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", IDS)
def test_keys_are_exactly_the_interfaces_and_plain(flown, env_id, tmp_path):
    metrics, arrays = flown[env_id]
    assert metrics.keys() == KEYS_OF[env_id] and arrays.keys() == ARRAYS
    assert (metrics["env_id"], metrics["eval_seed"], metrics["eval_starts"]) == (env_id, 3, 1)
    assert {type(value) for value in metrics.values()} == {str, int, float, bool}
    assert {key for key, value in metrics.items() if type(value) is bool} == {"success", "crashed"}
    write_json(tmp_path / "eval.json", metrics)
    assert json.loads((tmp_path / "eval.json").read_text()) == metrics
    write_npz(tmp_path / "eval.npz", arrays)
    with np.load(tmp_path / "eval.npz") as file:
        assert all(np.array_equal(file[key], arrays[key]) for key in ARRAYS)


@pytest.mark.parametrize("env_id", IDS)
def test_orbit_equals_plain_formulas(flown, references, env_id):
    (metrics, arrays), target = flown[env_id], TARGETS[env_id]
    end = arrays["y"][-1]
    for prefix, y in (("", end), ("reference_", references[env_id]["y"][-1])):
        ours = elements(y)
        found = {key: metrics[f"{prefix}{key}"] for key in PAPER}
        assert found == pytest.approx(ours, rel=1e-9)
        apsides = [metrics[f"{prefix}{name}_km"] for name in ("perigee", "apogee")]
        assert apsides == pytest.approx([ours["a_km"] * (1 - s * ours["e"]) - RE / 1e3 for s in (1, -1)], rel=1e-9)
        assert metrics[f"{prefix}error_norm"] == pytest.approx(norm(VEHICLES[env_id].goal_errors(y)), rel=1e-9)
    ours = elements(end)
    angles = ("i", "raan", "argp") if target["e"] else ("i", "raan")
    expected = {"a_error_km": ours["a_km"] - target["a_km"], "e_error": ours["e"] - target["e"]}
    expected |= {f"{name}_error_deg": ours[f"{name}_deg"] - target[f"{name}_deg"] for name in angles}
    assert {error: metrics[error] for error in expected} == pytest.approx(expected, abs=1e-9, rel=1e-8)
    d = norm(VEHICLES[env_id].goal_errors(end))
    assert metrics["success"] == (d < 0.02) == (env_id == CUTOFF)
    points = 2000 * (d < 0.02) + 1600 * math.exp(-d / 0.01) + 1600 * math.exp(-d / 0.001)
    assert metrics["points"] == pytest.approx(points, rel=1e-9)


@pytest.mark.parametrize("env_id", IDS)
def test_mass_time_and_altitudes(flown, references, env_id):
    metrics, arrays = flown[env_id]
    for prefix, t, y in (("", arrays["t"], arrays["y"]), ("reference_", *(references[env_id][k] for k in "ty"))):
        altitudes = [(norm(row[:3]) - RE) / 1e3 for row in y]
        assert metrics[f"{prefix}max_altitude_km"] == pytest.approx(max(altitudes), rel=1e-9)
        late = [altitude for altitude, time in zip(altitudes, t) if time > 300]
        assert metrics[f"{prefix}min_altitude_after_300s_km"] == pytest.approx(min(late), rel=1e-9)
    ignition, mass, flow = LAST_BURN[env_id]
    burnt = flow * (arrays["t"][-1] - ignition)
    assert metrics["final_mass_kg"] == arrays["y"][-1, 6] == pytest.approx(mass - burnt, rel=1e-12)
    assert metrics["final_time_s"] == arrays["t"][-1]
    assert metrics["mass_ratio"] == metrics["final_mass_kg"] / references[env_id]["final_mass_kg"]
    assert metrics["reference_time_s"] == references[env_id]["t"][-1]
    assert not metrics["crashed"]


@pytest.mark.parametrize("env_id", IDS)
def test_arrays_are_the_interfaces(flown, references, env_id):
    metrics, arrays = flown[env_id]
    t, u, y = (arrays[key] for key in "tuy")
    K = len(t) - 1
    assert u.shape == (K, 3) and y.shape == (K + 1, 7) and arrays["reward"].shape == (K,)
    assert np.array_equal(t[:-1], 2.0 * np.arange(K)) and 0 < t[-1] - t[-2] <= 2
    assert y[0] == pytest.approx([5605222.973, 0, 3043387.761, 0, 408.739, 0, START_MASS[env_id]], abs=1e-3)
    assert np.linalg.norm(u, axis=1) == pytest.approx(np.ones(K), abs=1e-12)
    if env_id == FIXED:
        assert K == 481 and t[-1] == 961
    else:
        energy = norm(y[-1, 3:6]) ** 2 / 2 - MU / norm(y[-1, :3])
        assert energy == pytest.approx(-MU / (2e3 * TARGETS[env_id]["a_km"]), rel=1e-10)
    assert all(np.array_equal(arrays[f"{key}_reference"], references[env_id][key]) for key in "tuy")


@pytest.mark.parametrize("ours, error", [(269.9, 0.1), (0.5, 90.7), (89.7, 179.9), (90.0, -179.8), (268.8, -1.0)])
def test_angles_differ_the_short_way_round(references, ours, error):
    flight = references[CUTOFF] | {"raan_deg": ours}
    metrics = rocket_metrics(flight, references[CUTOFF], envs.ROCKETS[CUTOFF])
    assert metrics["raan_error_deg"] == pytest.approx(error, abs=1e-9)


@pytest.fixture(scope="module")
def hyperbolic(references):
    """The reference's flight, but with 1.5 times the speed at the end: metrics and arrays."""
    flight = references[FIXED] | {"y": references[FIXED]["y"].copy()}
    flight["y"][-1, 3:6] *= 1.5
    flight |= elements(flight["y"][-1]) | {"error_norm": np.float64(norm(VEHICLES[FIXED].goal_errors(flight["y"][-1])))}
    assert flight["a_km"] < 0 and flight["e"] > 1
    metrics = {"env_id": FIXED, "eval_seed": 0, "eval_starts": 1}
    metrics |= rocket_metrics(flight, references[FIXED], envs.ROCKETS[FIXED])
    arrays = {
        f"{key}{side}": run[key] for key in "tuy" for side, run in (("", flight), ("_reference", references[FIXED]))
    }
    return metrics, arrays | {"reward": flight["reward"]}


def test_hyperbola_has_no_apogee(hyperbolic, tmp_path):
    metrics, arrays = hyperbolic
    assert metrics.keys() == KEYS - {"apogee_km"} and not metrics["success"]
    ours = elements(arrays["y"][-1])
    assert metrics["perigee_km"] == pytest.approx(ours["a_km"] * (1 - ours["e"]) - RE / 1e3, rel=1e-9)
    write_json(tmp_path / "eval.json", metrics)
    (row,) = (line for line in table_of(metrics).splitlines() if "apogee" in line)
    assert row.split()[-2:] == ["-", "-"]
    figure = figure_of("orbit.png", arrays, metrics)
    reached = lines_of(figure.axes[0])["orbit reached"]
    assert np.isnan(reached).any() and np.isfinite(reached).any()


def test_crash(crashed):
    metrics, arrays = crashed
    assert metrics.keys() == KEYS - {"min_altitude_after_300s_km"}
    assert metrics["crashed"] and not metrics["success"]
    assert metrics["R_penalties"] == pytest.approx(-40 * (2 - metrics["final_time_s"] / 961))
    assert norm(arrays["y"][-1, :3]) < RE and metrics["perigee_km"] < -6000
    table = table_of(metrics)
    assert "crashed" in table and "nan" not in table and "inf" not in table
    assert table_row(table, "lowest altitude after 300 s (km)")[2:] == ["-", "-"]
    assert "crashed" in headline_of(metrics)


# ---------------------------------------------------------------------------------------------------------------------
# Table
# ---------------------------------------------------------------------------------------------------------------------


def table_row(table, label):
    """The cells of the row with this label."""
    (line,) = (line for line in table.splitlines() if line.strip().startswith(label))
    return line.split(label)[1].split()


@pytest.mark.parametrize("env_id", [CUTOFF, LEO])
def test_table_shows_target_optimum_ours_and_difference(flown, env_id):
    target = TARGETS[env_id]
    metrics = json.loads(json.dumps(flown[env_id][0]))  # eval.json is all it needs
    table = table_of(metrics)
    rows = {"semi-major axis a (km)": "a_km", "eccentricity e": "e", "inclination i (deg)": "i_deg"}
    rows |= {"right ascension of the node (deg)": "raan_deg"}
    if target["e"]:
        rows |= {"argument of perigee (deg)": "argp_deg"}
    else:
        assert table_row(table, "argument of perigee (deg)") == ["-"] * 4
    for label, key in rows.items():
        cells = [float(cell) for cell in table_row(table, label)]
        ours, best, wanted = metrics[key], metrics[f"reference_{key}"], target[key]
        assert cells == pytest.approx([wanted, best, ours, ours - wanted], abs=6e-4), label
    rows = {"final mass (kg)": ("final_mass_kg", "reference_mass_kg")}
    rows |= {"final time (s)": ("final_time_s", "reference_time_s")}
    rows |= {"||error|| (success: below 0.02)": ("error_norm", "reference_error_norm")}
    for label, (key, best) in rows.items():
        none, *cells = table_row(table, label)
        ours, best = metrics[key], metrics[best]
        assert none == "-" and [float(c) for c in cells] == pytest.approx([best, ours, ours - best], abs=6e-4), label
    assert float(table_row(table, TARGET_ORBIT)[2]) == pytest.approx(metrics["mass_ratio"], abs=1e-6)
    assert table_row(table, "success")[2] == ("yes" if env_id == CUTOFF else "no")


def test_mass_for_the_orbit_reached(flown, monkeypatch):
    """For the target's own elements the optimum is the known one; what is compared with it is our final mass."""
    metrics = flown[CUTOFF][0] | PAPER
    pytest.importorskip("casadi")
    assert metrics["success"] and task_of(CUTOFF).reported_metrics(metrics) == pytest.approx(
        {"mass_ratio_reached": metrics["final_mass_kg"] / 7529.712296, "reference_mass_reached_kg": 7529.712296},
        rel=1e-8,
    )
    assert task_of(CUTOFF).reported_metrics(metrics | {"success": False}) == {}
    assert task_of(FIXED).reported_metrics(metrics | {"env_id": FIXED}) == {}
    assert task_of("DoubleIntegrator-v0").reported_metrics({"env_id": "DoubleIntegrator-v0"}) == {}
    monkeypatch.setitem(sys.modules, "casadi", None)  # as if it were not installed
    assert task_of(CUTOFF).reported_metrics(metrics) == {}


def test_an_orbit_without_an_optimum_has_no_mass_ratio(flown, monkeypatch):
    def stop(flight, rocket):
        raise RuntimeError("rocket ascent reached: IPOPT stopped with Infeasible_Problem_Detected")

    monkeypatch.setattr("rocket.task.reached_optimum", stop)
    assert task_of(CUTOFF).reported_metrics(flown[CUTOFF][0]) == {}


# ---------------------------------------------------------------------------------------------------------------------
# Figures
# ---------------------------------------------------------------------------------------------------------------------


def lines_of(ax):
    """The labelled lines of a panel, (n, 2) each."""
    return {line.get_label(): line.get_xydata() for line in ax.lines if not line.get_label().startswith("_")}


def test_ascent_figure_shows_both_flights(flown):
    metrics, arrays = flown[CUTOFF]
    figure = figure_of("trajectory.png", arrays, metrics)
    panels = {ax.get_ylabel(): ax for ax in figure.axes}
    altitude, other = ([(norm(row[:3]) - RE) / 1e3 for row in arrays[key]] for key in ("y", "y_reference"))
    expected = {"(a) mass (t)": arrays["y"][:, 6] / 1e3, "(b) altitude (km)": altitude}
    expected["(c) inertial speed (km/s)"] = [norm(row[3:6]) / 1e3 for row in arrays["y"]]
    for k, (letter, axis) in enumerate(zip("def", "xyz")):
        expected[f"({letter}) position ${axis}$ (km)"] = arrays["y"][:, k] / 1e3
        expected[f"velocity $v_{axis}$ (km/s), pale"] = arrays["y"][:, 3 + k] / 1e3
        assert np.array_equal(panels[f"thrust $u_{axis}$"].patches[0].get_data().values, arrays["u"][:, k])
    for label, values in expected.items():
        red = panels[label].lines[0]
        assert red.get_xdata() == pytest.approx(arrays["t"]) and red.get_ydata() == pytest.approx(values), label
    assert panels["(b) altitude (km)"].lines[1].get_ydata() == pytest.approx(other)
    ends = [line.get_xdata()[0] for line in panels["(a) mass (t)"].lines if line.get_linestyle() == ":"]
    assert ends == [75.2, 150.4, 261.0]
    assert f"{metrics['error_norm']:.6f}" in figure.get_suptitle()


def test_orbit_figure_shows_orbits_insertion_and_ground_track(flown):
    metrics, arrays = flown[CUTOFF]
    plane, insertion, ground = figure_of("orbit.png", arrays, metrics).axes
    lines, y, frame = lines_of(plane), arrays["y"], VEHICLES[CUTOFF].plane.T
    a, e, drawn = PAPER["a_km"] / 1e3, PAPER["e"], lines["target orbit"]
    assert drawn[:, 0].max() == pytest.approx(a * (1 - e)) and np.ptp(drawn[:, 0]) == pytest.approx(2 * a)
    assert np.ptp(drawn[:, 1]) == pytest.approx(2 * a * math.sqrt(1 - e**2), rel=1e-5)
    assert lines["policy"] == pytest.approx((y[:, :3] @ frame[:2].T) / 1e6)
    distance = np.hypot(*(lines["orbit reached"] - lines["policy"][-1]).T)
    assert distance.min() < 0.02  # 1000 km: it passes through the last state
    angle = math.degrees(math.atan2(*lines["policy"][-1][::-1]))
    circle = [line.get_xydata()[0] for line in insertion.lines if line.get_marker() == "o"][0]
    assert circle == pytest.approx([angle, (norm(y[-1, :3]) - RE) / 1e3])
    longitude = [math.degrees(math.atan2(row[1], row[0]) - 7.29211585e-5 * t) for row, t in zip(y, arrays["t"])]
    latitude = [math.degrees(math.asin(row[2] / norm(row[:3]))) for row in y]
    red = next(line for line in ground.lines if line.get_color() == "tab:red")
    assert red.get_xydata() == pytest.approx(np.c_[longitude, latitude])
    plane_at_launch = lines_of(ground)["target plane at launch"]
    assert np.hypot(*(plane_at_launch - [0, 28.5]).T).min() < 0.5  # the launch site is in it, nearly


# ---------------------------------------------------------------------------------------------------------------------
# Results folders
# ---------------------------------------------------------------------------------------------------------------------


def test_rows_of_a_results_folder(flown, tmp_path):
    metrics = flown[CUTOFF][0]
    (tmp_path / "seeds").mkdir()
    for seed, error in ((1, metrics["error_norm"]), (2, 0.5)):
        write_json(tmp_path / "seeds" / f"{seed}.json", metrics | {"seed": seed, "error_norm": error})
    rows = {line[:40].strip(): line[40:].split() for line in evaluate.seed_lines(tmp_path)}
    error = metrics["error_norm"]
    found = [float(cell) for cell in rows["||error||"]]
    assert found == pytest.approx([error, 0.5, (error + 0.5) / 2, error, 0.5], abs=1e-6)
