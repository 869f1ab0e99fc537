"""Pages: the JavaScript that flies in them beside Python, in V8; and the file around it."""

import copy
import json
import math
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("py_mini_racer", reason="needs mini-racer, of requirements-extras.txt")

from helpers import save  # noqa: E402

import baselines  # noqa: E402
import evaluate  # noqa: E402
import ppo_gtrxl_di  # noqa: E402
import ppo_gtrxl_rocket  # noqa: E402
import ppo_gtrxl_vdp  # noqa: E402
from benchmarks import page_flights  # noqa: E402
from benchmarks.page_flights import NO_CHANGES, Engine  # noqa: E402
from benchmarks.policies import load  # noqa: E402
from common.checkpoints import read_checkpoint  # noqa: E402
from common.errors import BadInput  # noqa: E402
from common.evaluations import read_evaluation  # noqa: E402
from common.tasks import task_of  # noqa: E402
from envs import ROCKET, ROCKETS, draw_names, fly, fly_rocket  # noqa: E402
from exports import page, rocket_page  # noqa: E402
from exports.offers import offer  # noqa: E402
from exports.rocket_page import constants, sliders  # noqa: E402
from phased.problem import PROBLEMS  # noqa: E402
from rocket import guidance  # noqa: E402
from rocket.dispersion import DISPERSION, draw_sigmas  # noqa: E402
from rocket.task import RocketTask  # noqa: E402

ROOT = Path(__file__).parents[1]
CHANGES = {"thrust": 0.01, "drag": 0.1, "windEast": 15.0, "windNorth": -10.0, "payload": 30.0, "failure": None}


@cache
def page_of(result: str) -> str:
    """The page of a result."""
    return page_flights.page_of(ROOT / "results" / result)


@cache
def engine_of(result: str) -> Engine:
    return Engine(page_of(result))


def flights_of(result, changes=NO_CHANGES):
    """The three flights of a vehicle with these changes, by JavaScript."""
    return engine_of(result)(f"flyAll(data, {json.dumps(changes)})")


def draw_of(rocket, changes):
    """The scores (k,), at dispersion 1, that change a vehicle as the sliders do."""
    names, sigmas = draw_names(rocket), draw_sigmas(rocket)
    slider = {"drag": "drag", "wind_east": "windEast", "wind_north": "windNorth", "payload": "payload"}
    slider |= {name: "thrust" for name in names if name.startswith("burn_rate")}
    return np.array([changes[slider[name]] / sigma if name in slider else 0.0 for name, sigma in zip(names, sigmas)])


# ---------------------------------------------------------------------------------------------------------------------
# Rockets
# ---------------------------------------------------------------------------------------------------------------------


def assert_ends_alike(flight, error_norm, y, m=1.0):
    """The page's bound: ||error|| to 1e-6, the state to 1 m (and 0.01 m/s, 0.1 kg)."""
    end = np.array(flight["y"][-1])
    assert flight["errorNorm"] == pytest.approx(error_norm, abs=1e-6)
    assert np.linalg.norm(end[:3] - y[:3]) < m
    assert np.linalg.norm(end[3:6] - y[3:6]) < m / 100
    assert end[6] == pytest.approx(y[6], abs=0.1 * m)


@pytest.mark.slow
@pytest.mark.parametrize("result", ["rocket_failures", "rocket_fixed", "rocket_any_orbit"])
def test_with_all_sliders_at_zero_the_flight_is_pythons(result):
    metrics, arrays = read_evaluation(ROOT / "results" / result)
    flight = flights_of(result)["policy"]
    assert_ends_alike(flight, metrics["error_norm"], arrays["y"][-1])
    assert flight["t"][-1] == pytest.approx(metrics["final_time_s"], abs=1e-3)
    np.testing.assert_allclose(flight["u"], arrays["u_own" if "u_own" in arrays else "u"], atol=1e-4)
    assert not flight["crashed"] and not flight["dry"]


@pytest.mark.slow
@pytest.mark.parametrize("result", ["rocket_failures", "two_stage_leo"])
def test_another_vehicle_flies_as_pythons(result):
    """All sliders moved: the policy by torch, the laws by rocket/guidance.py, on the same draw."""
    agent, args, options = load(ROOT / "results" / result / "agent.safetensors")
    z, dispersed = draw_of(ROCKETS[args.env_id].rocket, CHANGES), {**options, "dispersion": 1.0}
    flights = flights_of(result, CHANGES)
    flown = fly_rocket(args.env_id, agent.make_policy(600), draw=z, **dispersed)
    assert_ends_alike(flights["policy"], flown["error_norm"], flown["y"][-1])
    laws = {"openLoop": guidance.open_loop(args.env_id), "lqr": guidance.tvlqr(args.env_id, by_energy=True)}
    for name, law in laws.items():
        flown = fly_rocket(args.env_id, law, draw=z, dispersion=1.0)
        assert_ends_alike(flights[name], flown["error_norm"], flown["y"][-1], m=0.01)
        assert flights[name]["errorNorm"] == pytest.approx(flown["error_norm"], abs=1e-9)


@pytest.mark.slow
def test_any_orbit_flies_as_pythons():
    """A target by the sliders' numbers is that of `Targets.at`, and the policy flies to it as by torch."""
    agent, args, options = load(ROOT / "results" / "rocket_any_orbit" / "agent.safetensors")
    mission = ROCKETS[args.env_id]
    ranges = mission.ranges
    shares = {"perigee": 0.3, "apogee": 0.6, "i": 0.8, "argp": 0.1}
    (target,) = ranges.at([[0.3, 0.6, 0.8, 0.5, 0.1]], mission.rocket)
    low, high = np.log(ranges.apogee_km)
    place = {"apogee": float(np.exp(low + 0.6 * (high - low)))}
    for name, span in (("perigee", ranges.perigee_km), ("i", ranges.i_deg), ("argp", ranges.argp_deg)):
        place[name] = float(np.interp(shares[name], (0, 1), span))
    changes = json.dumps({**NO_CHANGES, "target": place})
    flight = engine_of("rocket_any_orbit")(f"flyAll(data, {changes}).policy")
    flown = fly_rocket(args.env_id, agent.make_policy(600), target=target, **options)
    assert_ends_alike(flight, flown["error_norm"], flown["y"][-1])


@pytest.mark.slow
def test_lqr_at_a_fixed_time():
    """Its gains leave less of a small change's error than open loop does, and JavaScript flies them as Python."""
    env_id, changes = "RocketAscent-v0", {**NO_CHANGES, "windEast": 2.0, "drag": 0.01}
    z = draw_of(ROCKET, changes)
    flights = flights_of("rocket_fixed", changes)
    for name, law in (("openLoop", guidance.open_loop(env_id)), ("lqr", guidance.tvlqr(env_id))):
        flown = fly_rocket(env_id, law, draw=z, dispersion=1.0)
        assert_ends_alike(flights[name], flown["error_norm"], flown["y"][-1], m=0.01)
    assert flights["lqr"]["errorNorm"] < 0.1 * flights["openLoop"]["errorNorm"]


@pytest.mark.slow
@pytest.mark.parametrize("group, lit, burns, time, share", [(3, 261.0, 700.0, 401.3, 0.1), (0, 0.0, 75.2, 30.0, 0.2)])
def test_a_failure_flies_as_pythons(group, lit, burns, time, share):
    """Open loop, on a draw of the same failure."""
    changes = {**NO_CHANGES, "failure": {"time": time, "group": group, "share": share}}
    flight = flights_of("rocket_cutoff", changes)["openLoop"]
    env_id = "RocketAscentCutoff-v0"
    z = np.append(draw_of(ROCKET, NO_CHANGES), [0.0, (group + 0.5) / 4, (time - lit) / burns, share / 0.3])
    flown = fly_rocket(env_id, guidance.open_loop(env_id), draw=z, failure=0.3)
    assert_ends_alike(flight, flown["error_norm"], flown["y"][-1], m=0.01)
    assert flight["burnEnds"][group] == pytest.approx(time + (lit + burns - time) / (1 - share), abs=1e-6)
    assert flight["errorNorm"] > 0.01 and flight["t"][-1] == pytest.approx(flown["final_time_s"], abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("payload, end", [(1200.0, "dry"), (2500.0, "crashed")])
def test_flights_that_fail(payload, end):
    """Too heavy: it runs out of fuel, or falls; as in Python."""
    env_id, changes = "RocketAscentCutoff-v0", {**NO_CHANGES, "payload": payload}
    flight = flights_of("rocket_cutoff", changes)["openLoop"]
    flown = fly_rocket(env_id, guidance.open_loop(env_id), draw=draw_of(ROCKET, changes), dispersion=1.0)
    assert {key: flight[key] for key in ("dry", "crashed")} == {key: flown[key] for key in ("dry", "crashed")}
    assert flight[end]
    assert_ends_alike(flight, flown["error_norm"], flown["y"][-1], m=0.1)


RANDOM_ROCKETS = [
    {"env_id": "TwoStageLEO-v0", "memory_length": 0, "observe_draw": True, "dispersion": 1.0},
    {"env_id": "RocketAscentCutoff-v0", "num_blocks": 0, "observe_mass": True, "dispersion": 1.0},
    {"env_id": "RocketAscent-v0", "num_blocks": 2, "observe_phase": False},
]


@pytest.mark.slow
@pytest.mark.parametrize("changes", RANDOM_ROCKETS, ids=lambda changes: changes["env_id"])
def test_random_policies_of_rockets(changes, tmp_path):
    """Networks with and without memory and blocks, and what they may observe: the first actions, in float64."""
    agent, args, options = save(ppo_gtrxl_rocket, tmp_path, **changes)
    result = {"TwoStageLEO-v0": "two_stage_leo", "RocketAscentCutoff-v0": "rocket_cutoff"}.get(
        args.env_id, "rocket_fixed"
    )
    metrics, arrays = read_evaluation(ROOT / "results" / result)
    checkpoint = read_checkpoint(tmp_path / "agent.safetensors")
    engine = Engine(page.html_bytes(offer(task_of(args.env_id), "page")(metrics, arrays, checkpoint, 0.0)).decode())
    flight = engine(f"flyAll(data, {json.dumps(CHANGES)}).policy")
    z, dispersed = draw_of(ROCKETS[args.env_id].rocket, CHANGES), {**options, "dispersion": 1.0}
    flown = fly_rocket(args.env_id, copy.deepcopy(agent).double().make_policy(600), draw=z, **dispersed)
    steps = min(len(flight["u"]), len(flown["u"]), 20)
    np.testing.assert_allclose(flight["u"][:steps], flown["u"][:steps], atol=1e-7)
    assert np.std(flight["u"][:steps], axis=0).max() > 1e-3


def test_readings_of_an_orbit():
    engine = engine_of("rocket_cutoff")
    found = engine("elementsOf(targetState(data.rocket), data.rocket)")
    expected = {"a": ROCKET.a / 1e3, "e": ROCKET.e, "i": ROCKET.i, "raan": ROCKET.raan, "argp": ROCKET.argp}
    assert {key: found[key] for key in expected} == pytest.approx(expected, rel=1e-9)
    assert found["perigee"] == pytest.approx((ROCKET.a * (1 - ROCKET.e) - ROCKET.Re) / 1e3)
    assert engine("stateAt({t: [0, 2, 3], y: [[0], [2], [6]]}, 2.5)") == [4]
    assert engine("stateAt({t: [0, 2, 3], y: [[0], [2], [6]]}, 9)") == [6]


def test_sliders_move_what_a_draw_moves():
    sliders = {slider["name"]: slider for slider in engine_of("rocket_cutoff")("data.sliders")}
    assert sliders.keys() == CHANGES.keys() - {"failure"}
    sigma = {name: slider["sigma"] * slider["scale"] for name, slider in sliders.items()}
    assert sigma["thrust"] == pytest.approx(DISPERSION.burn_rate) and sigma["payload"] == DISPERSION.payload
    assert all(slider["most"] == pytest.approx(6 * slider["sigma"]) for slider in sliders.values())


# ---------------------------------------------------------------------------------------------------------------------
# The phase plane
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("result", ["di", "vdp_waypoints"])
def test_policy_and_optimum_from_given_starts(result):
    """Both to 1e-6 in the cost, of the first starts of the evaluation."""
    _, arrays = read_evaluation(ROOT / "results" / result)
    policies = engine_of(result)(
        "data.starts.slice(0, 3).map(x => flyPlane(data.problem, x, planePolicy(data.policy, data.problem)))"
    )
    optima = engine_of(result)("data.starts.slice(0, 8).map(x => planeOptimum(data.problem, x))")
    for flights, suffix in ((policies, ""), (optima, "_reference")):
        for k, flight in enumerate(flights):
            assert flight["cost"] == pytest.approx(arrays[f"cost{suffix}"][k], abs=1e-6)
            np.testing.assert_allclose(flight["x"], arrays[f"x{suffix}"][k], atol=1e-6)
            assert all(flight["hits"])
    assert all(policy["cost"] > optimum["cost"] for policy, optimum in zip(policies, optima))


@pytest.mark.slow
def test_the_optimum_of_a_table_in_which_one_phase_has_no_circle(new_problem):
    """The page's, and IPOPT's of the same table."""
    waypoints = PROBLEMS["DoubleIntegratorWaypoints-v0"]
    first = replace(waypoints.phases[0], radius=math.inf, bonus=0.0)
    table = replace(waypoints, env_id="OneCircle-v0", phases=(first, *waypoints.phases[1:]))
    x0 = np.array([[0.6, -0.4]])
    optimum = baselines.reference(new_problem(table), x0)
    opened = "Object.assign(data.problem.phases[0], {radius: null, bonus: 0})"
    flight = engine_of("di_waypoints")(f"({opened}, planeOptimum(data.problem, {x0[0].tolist()}))")
    assert flight["hits"][1] and optimum["hit"][0, 1]
    assert flight["cost"] == pytest.approx(optimum["cost"][0], abs=1e-5)


RANDOM_PLANES = [
    (ppo_gtrxl_di, {"observe_velocity": False}),
    (ppo_gtrxl_vdp, {"env_id": "VanDerPolWaypoints-v0", "num_blocks": 0}),
    (ppo_gtrxl_di, {"env_id": "DoubleIntegratorWaypoints-v0", "observe_phase": False, "memory_length": 0}),
]


@pytest.mark.slow
@pytest.mark.parametrize("script, changes", RANDOM_PLANES, ids=["velocity", "blocks", "phase"])
def test_random_policies_of_small_problems(script, changes, tmp_path):
    """Beside torch in float64; their controls meet the bounds, too."""
    agent, args, options = save(script, tmp_path, **changes)
    x0 = np.random.default_rng(0).uniform(-1, 1, (2, 2))
    flown = fly(args.env_id, copy.deepcopy(agent).double().make_policy(200), x0, **options)
    checkpoint = read_checkpoint(tmp_path / "agent.safetensors")
    made = offer(task_of(args.env_id), "page")({}, {"x": flown["x"]}, checkpoint, 0.0)
    engine = Engine(page.html_bytes(made).decode())
    flights = engine("data.starts.map(x => flyPlane(data.problem, x, planePolicy(data.policy, data.problem)))")
    for k, flight in enumerate(flights):
        np.testing.assert_allclose(flight["x"], flown["x"][k], rtol=1e-9, atol=1e-9)
        assert flight["cost"] == pytest.approx(flown["cost"][k], rel=1e-9)
        assert flight["hits"] == flown["hit"][k].tolist()


# ---------------------------------------------------------------------------------------------------------------------
# Numbers, and the file
# ---------------------------------------------------------------------------------------------------------------------


def test_arrays_arrive_as_they_are():
    """Float64 and float32 to the last bit; in bfloat16 only what has no more digits."""
    rng = np.random.default_rng(0)
    exact = rng.standard_normal((3, 5))
    single = exact.astype(np.float32)
    short = (single.view(np.uint32) & 0xFFFF0000).view(np.float32)
    written = {"exact": exact, "single": single, "short": short, "one": np.float32([0.1])}
    data = json.dumps({"of": [written], "count": np.int64(3)}, default=page.encoded)
    assert [json.loads(data)["of"][0][name]["dtype"] for name in written] == [
        "float64",
        "float32",
        "bfloat16",
        "float32",
    ]
    engine = engine_of("di")
    engine.v8.eval(f"const read = decoded({data})")
    assert engine("read.count") == 3
    for name, array in written.items():
        values = engine(f"Array.from(read.of[0].{name}.values)")
        np.testing.assert_array_equal(np.reshape(values, array.shape), array.astype(float))


@pytest.mark.parametrize("result", ["rocket_dispersed", "di"])
def test_one_file_without_network(result):
    html = page_of(result)
    assert len(html.encode()) < 2_000_000
    assert "default-src 'none'" in html and "{{" not in html
    loads = re.sub(r"""<script.*?</script>|<a href="[^"]*">""", "", html, flags=re.DOTALL)  # a link loads nothing
    assert not re.search(r"""(src|href)=["'](?!data:)|@import|url\(""", loads)
    assert html.count("<script") == html.count("</script>")
    if result == "rocket_dispersed":
        assert "The MIT License" in html and "three.js authors" in html


def test_the_command(tmp_path):
    command = [sys.executable, "evaluate.py", "page", "results/di", "--out", str(tmp_path / "di.html")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r".*di\.html: 1\.\d\d MB\n", done.stdout)
    assert (tmp_path / "di.html").read_text() == page_of("di")


# ---------------------------------------------------------------------------------------------------------------------
# Bad input
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ["MarsLanding-v0", "Goddard-v0"])
def test_what_has_no_page_is_one_line(env_id):
    with pytest.raises(BadInput) as refusal:
        offer(task_of(env_id), "page")({}, {}, {}, 0.0)
    assert "\n" not in str(refusal.value) and env_id in str(refusal.value)


def test_a_table_with_more_than_a_page_flies_is_one_line(new_problem):
    table = replace(PROBLEMS["VanDerPol-v0"], env_id="Bounded-v0", bounds=((-9.0, 9.0), None), bound_price=1.0)
    with pytest.raises(BadInput, match="^the table is Bounded-v0; it has more than a page can fly"):
        offer(task_of(new_problem(table)), "page")({}, {}, {"args": {}}, 0.0)


def test_a_policy_with_other_features_is_one_line(tmp_path):
    save(ppo_gtrxl_di, tmp_path)
    checkpoint = read_checkpoint(tmp_path / "agent.safetensors")
    checkpoint["tensors"]["encoder.0.weight"] = np.zeros((8, 5), dtype=np.float32)
    with pytest.raises(BadInput, match="^the policy's number of features is 5; it must be 3 to fly in a page"):
        offer(task_of("DoubleIntegrator-v0"), "page")({}, {"x": np.zeros((1, 2, 2))}, checkpoint, 0.0)


def test_a_rocket_by_the_tables_isp_is_one_line():
    mission = replace(ROCKETS["RocketAscentCutoff-v0"], rocket=replace(ROCKET, table_isp=True))
    with pytest.raises(BadInput, match="^table_isp of Mine-v0 is True; it must be False for a page"):
        rocket_page.page(RocketTask("Mine-v0", mission), {}, {}, {}, 0.0)


def test_a_page_that_fails_leaves_the_old_one(tmp_path):
    """Of a folder whose policy is another's."""
    for name in ("eval.json", "eval.npz"):
        shutil.copy(ROOT / "results" / "di" / name, tmp_path)
    shutil.copy(ROOT / "results" / "vdp" / "agent.safetensors", tmp_path)
    (tmp_path / "page.html").write_text("as before")
    with pytest.raises(ValueError, match="eval.json is not of its agent.safetensors"):
        evaluate.page(tmp_path)
    assert (tmp_path / "page.html").read_text() == "as before"


def test_another_policy_takes_the_page_with_it(tmp_path):
    assert "page.html" in evaluate.of_another_policy(tmp_path)


def test_every_rocket_has_a_page_s_constants():
    """Whatever is registered: what the sliders need can be written as JSON."""
    for env_id, mission in ROCKETS.items():
        assert gym.spec(env_id)
        text = json.dumps([constants(mission, 1.0), sliders(mission.rocket)], allow_nan=False)
        assert len(json.loads(text)[0]["groups"]) >= 1
