"""The statistics of dispersed flights against plain formulas, the flags that ask for them, and the figure."""

import math

import numpy as np
import pytest
from helpers import save, table_of

import envs
import evaluate
import runs
from common.tasks import task_of
from rocket.metrics import box_rate, dispersed_metrics, draws

CUTOFF, LEO = "RocketAscentCutoff-v0", "TwoStageLEO-v0"
FLIGHTS = 12


def optimum_replayed(env_id):
    """A policy: the optimum's directions, open loop, the last one held."""
    u = task_of(env_id).optimum(0, 1)["u"]
    return lambda obs, t: np.repeat(u[None, min(t, len(u) - 1)], len(obs), axis=0)


@pytest.fixture(scope="module", params=[CUTOFF, LEO])
def flown(request):
    env_id = request.param
    return evaluate.evaluate(env_id, optimum_replayed(env_id), 7, FLIGHTS, dispersion=1)


def misses(y, rocket):
    """Perigee and apogee (km), i, RAAN, argument of perigee (degrees) off the target, by vectors and arc cosines."""
    r, v = y[:3], y[3:6]
    h, n = np.cross(r, v), np.cross([0, 0, 1], np.cross(r, v))
    e = np.cross(v, h) / rocket.mu - r / np.linalg.norm(r)
    p, ecc = h @ h / rocket.mu, np.linalg.norm(e)
    raan = math.degrees(math.atan2(n[1], n[0]))
    argp = math.degrees(math.acos(np.clip(n @ e / np.linalg.norm(n) / ecc, -1, 1)))
    argp = argp if e[2] >= 0 else 360 - argp
    i = math.degrees(math.acos(h[2] / np.linalg.norm(h)))
    turn = lambda x: (x + 180) % 360 - 180  # noqa: E731
    found = [
        p / (1 + ecc) / 1e3 - rocket.a * (1 - rocket.e) / 1e3,
        p / (1 - ecc) / 1e3 - rocket.a * (1 + rocket.e) / 1e3,
    ]
    return [*found, i - rocket.i, turn(raan - rocket.raan), turn(argp - rocket.argp)]


def test_statistics_equal_plain_formulas(flown):
    metrics, arrays = flown
    rocket = envs.ROCKETS[metrics["env_id"]].rocket
    errors = np.sort(np.sqrt((arrays["final_error"] ** 2).sum(1)))
    assert len(errors) == metrics["dispersed_starts"] == FLIGHTS and metrics["dispersion"] == 1
    assert metrics["dispersed_error_median"] == pytest.approx((errors[5] + errors[6]) / 2)
    assert metrics["dispersed_error_max"] == pytest.approx(errors[-1])
    assert metrics["dispersed_error_p95"] == pytest.approx(errors[10] + 0.45 * (errors[11] - errors[10]))
    table = np.array([misses(y, rocket) for y in arrays["final_y"]])
    keys = ["perigee_error_{}_km", "apogee_error_{}_km", "i_error_{}_deg", "raan_error_{}_deg", "argp_error_{}_deg"]
    if rocket.e == 0:  # a circle has no perigee to measure its argument from
        assert not any("argp" in key for key in metrics if key.startswith("dispersed"))
        keys, table = keys[:4], table[:, :4]
    for key, column in zip(keys, table.T):
        assert metrics["dispersed_" + key.format("mean")] == pytest.approx(column.mean(), rel=1e-6, abs=1e-6)
        deviation = math.sqrt(((column - column.mean()) ** 2).mean())
        assert metrics["dispersed_" + key.format("std")] == pytest.approx(deviation, rel=1e-6, abs=1e-6)
    box = np.array([10, 500, 0.1, 0.1, 0.3])[: len(keys)]
    inside = int((np.abs(table) <= box).all(1).sum())
    assert metrics["dispersed_box_rate"] == inside / FLIGHTS
    mass = np.sort(arrays["final_y"][:, 6])
    assert metrics["dispersed_mass_mean_kg"] == pytest.approx(mass.mean())
    assert metrics["dispersed_mass_p01_kg"] == pytest.approx(mass[0] + 0.11 * (mass[1] - mass[0]))


def test_draws_are_the_seeds_and_nobody_elses(flown):
    metrics, arrays = flown
    env_id = metrics["env_id"]
    expected = np.random.default_rng([7, 2]).standard_normal(arrays["draw"].shape).clip(-3, 3)
    np.testing.assert_array_equal(arrays["draw"], expected)
    rocket = envs.ROCKETS[env_id].rocket
    np.testing.assert_array_equal(draws(rocket, 1.0, 7, 5), expected[:5])
    assert not np.isin(draws(rocket, 1.0, 8, 5), expected[np.abs(expected) < 3]).any()
    assert arrays["final_y"].shape == (FLIGHTS, 7) and arrays["final_t"].shape == (FLIGHTS,)


@pytest.mark.parametrize("inside, n", [(0, 20), (20, 20), (13, 20), (1705, 1705)])
def test_wilson_interval(inside, n):
    """(p + z^2 / 2n -+ z sqrt(p (1 - p) / n + z^2 / 4 n^2)) / (1 + z^2 / n), z = 1.959964."""
    z, p = 1.959963984540054, inside / n
    middle, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    found = box_rate(inside, n)
    low, high = (middle - half) / (1 + z * z / n), (middle + half) / (1 + z * z / n)
    assert found["dispersed_box_low"] == pytest.approx(low, abs=1e-12)
    assert found["dispersed_box_high"] == pytest.approx(high, abs=1e-12)


def test_crashes_are_counted_and_leave_no_gap():
    """Five times the table: whoever falls is counted, the metrics stay finite."""
    down = lambda obs, t: np.repeat([[-1.0, 0.2, 0.0]], len(obs), axis=0)  # noqa: E731
    metrics, _ = evaluate.evaluate(CUTOFF, down, 0, 10, dispersion=5, action_frame="local")
    assert metrics["dispersed_crashed"] == 10 and metrics["dispersed_box_rate"] == 0
    assert not any("perigee_error" in key and "dispersed" in key for key in metrics)
    assert all(math.isfinite(value) for value in metrics.values() if isinstance(value, float))
    assert "10 crashed" in table_of(metrics)


def test_only_closed_orbits_have_elements():
    """Two ellipses by hand, both dry, a hyperbola and a crash: the errors and masses are of all four."""
    rocket, n = envs.ROCKET, 4
    perigee, apogee = 6378.145 + np.array([180.0, 190.0]), 6378.145 + np.array([35000.0, 37000.0])
    a = np.array([*(perigee + apogee) / 2, -2e4, 7e3])
    flights = {"a_km": a, "e": np.array([*(apogee - perigee) / (apogee + perigee), 1.5, 0.1])}
    flights |= {"i_deg": np.array([28.6, 28.4, 60.0, 5.0]), "error_norm": np.array([0.001, 0.002, 1.5, 1.0])}
    flights |= {"raan_deg": np.full(n, rocket.raan), "argp_deg": np.full(n, rocket.argp)}
    flights |= {"dry": np.array([1, 1, 0, 1], bool), "crashed": np.array([0, 0, 0, 1], bool)}
    metrics = dispersed_metrics(flights | {"final_mass_kg": np.array([7e3, 8e3, 9e3, 1e4])}, rocket)
    target = rocket.a / 1e3 * (1 - rocket.e) - rocket.Re / 1e3
    assert metrics["dispersed_perigee_error_mean_km"] == pytest.approx(185 - target)
    assert metrics["dispersed_perigee_error_std_km"] == pytest.approx(5.0)
    assert metrics["dispersed_i_error_mean_deg"] == pytest.approx(0.0, abs=1e-12)
    assert (metrics["dispersed_dry"], metrics["dispersed_crashed"], metrics["dispersed_mass_mean_kg"]) == (3, 1, 8500)
    assert metrics["dispersed_error_max"] == 1.5
    assert metrics["dispersed_error_p99"] == pytest.approx(1.0 + 0.97 * 0.5)  # of 0.001, 0.002, 1, 1.5


# --- flags ------------------------------------------------------------------------------------------------------------


def script():
    import ppo_gtrxl_rocket

    return ppo_gtrxl_rocket


def parse(*argv):
    rocket = script()
    return runs.parse_args(rocket, list(argv))[0]


def test_how_many_flights():
    shipped = f"--checkpoint={runs.Path(__file__).parents[1]}/results/rocket_cutoff/agent.safetensors"
    assert parse("--eval-only", shipped).eval_starts == 1000
    assert parse("--eval-only", shipped, "--dispersion=1").eval_starts == 1705
    assert parse("--dispersion=1").eval_starts == 1705 and parse("--dispersion=1", "--eval-starts=30").eval_starts == 30


def test_an_oracle_needs_its_draw(tmp_path):
    """What sees a draw cannot be flown as if it did not."""
    save(script(), tmp_path, env_id=LEO, observe_draw=True, dispersion=1.0)
    with pytest.raises(SystemExit, match="--observe-draw False: the checkpoint has True; leave the flag out"):
        parse("--eval-only", f"--checkpoint={tmp_path}/agent.safetensors", "--no-observe-draw")
    assert parse("--eval-only", f"--checkpoint={tmp_path}/agent.safetensors").observe_draw
