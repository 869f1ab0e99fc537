"""What can be saved of a flight with a failure, and how such flights are evaluated.

The optimum against the environment that flies it, another optimum's numbers, and orbits that it is solved for again.
"""

import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers import figure_of, table_of
from rocket_oracle import CUTOFF, FIXED

import baselines
import envs
import evaluate
import runs
from common.tasks import task_of
from envs import ROCKET, ROCKETS, BadInput, fly_rocket
from rocket import comparison, guidance, rescue
from rocket.dispersion import draw_names
from rocket.metrics import draws, evaluate_dispersed, failure_metrics
from rocket.optimum import rocket_reference
from rocket.orbits import target_axes, target_orbit
from rocket.rescue import Failing, Known

ROOT = Path(__file__).parents[1]
DRAW = draw_names(ROCKET)
SCORES = len(DRAW)
PROTOCOL = Failing(1.0, 0.3, "random")
FLIGHTS = 12


def script():
    import ppo_gtrxl_rocket

    return ppo_gtrxl_rocket


def parse(*argv):
    rocket = script()
    return runs.parse_args(rocket, list(argv))[0]


# --- the optimum ------------------------------------------------------------------------------------------------------


def stage_2(*losses):
    """Draws (n, k + 4) of failures of stage 2 without dispersion, (moment, share) each."""
    z = np.zeros((len(losses), SCORES + 4))
    for row, (moment, share) in zip(z, losses):
        row[SCORES:] = 0.0, 0.9, (moment - 261) / 700, share / 0.3
    return z


def solve(z, failure_time="random", dispersion=0.0):
    failing = Failing(dispersion, 0.3, failure_time)
    return rescue.failing_optima(CUTOFF, ROCKETS[CUTOFF], failing, np.atleast_2d(z), processes=1)


@pytest.mark.slow
def test_knowing_earlier_saves_what_another_program_says():
    """kg that the optimum saves that knows before lift-off; the pairs are of a script that shares nothing with ours."""
    elsewhere = {(262.0, 0.15): 9.5, (400.0, 0.25): 15.0}
    optima = solve(stage_2(*elsewhere))
    guess, (h, e) = guidance.optimum_guess(CUTOFF), target_orbit(ROCKET.target, ROCKET.mu)
    for ((moment, share), saves), optimum in zip(elsewhere.items(), optima):
        end = np.array([75.2, 150.4, 261.0, moment, 1400.0])
        left = np.array([1.0, 1, 1, 1, 1 - share])
        thrust = left * [6 * 628500 + 1083100, 3 * 628500 + 1083100, 1083100, 110094, 110094]
        flow = left * [1723.268, 1044.67928, 95550 / 261, 16820 / 700, 16820 / 700]
        burnt = flow[:4] * np.diff(end[:4], prepend=0)
        mass = 301454 - np.append(0, np.cumsum(burnt + [6 * 2280, 3 * 2280, 8830, 0]))
        remaining = guidance.RemainingAscent(0.0, ROCKET.x0[:6], end, thrust, flow, mass, h, e)
        known = guidance.optimise_remaining(ROCKET, remaining, guess, (3, 3, 5, 4, 20))
        assert known["final_mass"] - optimum["final_mass"] == pytest.approx(saves, abs=0.5)


@pytest.mark.slow
def test_the_environment_flies_the_optimum():
    """Failures of two engines in drawn vehicles and air: to the target, with its mass, healthy until the strike."""
    z = draws(ROCKET, 1.0, 5, 2, 0.3)
    z[:, SCORES] = 0.0
    z[:, SCORES + 1] = 0.1, 0.6
    optima = solve(z, dispersion=1.0)
    times = guidance.middles(ROCKET)
    for row, optimum in zip(z, optima):
        u = rescue.directions_at(optimum, times)
        flight = fly_rocket(CUTOFF, lambda obs, k, u=u: u[k, None], draw=row, dispersion=1.0, failure=0.3)
        assert flight["error_norm"] < 2e-3  # the step in which it strikes is steered without knowing
        bound = optimum["final_mass"] + 0.05 + optimum["orbit_price"] @ defect(flight["error"])
        assert bound - 5 < flight["final_mass_kg"] < bound
        before = np.flatnonzero(times < optimum["strike"])
        healthy = guidance.directions_at(optimum["healthy"], times)
        np.testing.assert_array_equal(u[before], healthy[before])
        step = int(optimum["strike"] // 2)
        begins = rescue.state_at(optimum["healthy"], 2.0 * step)
        miss = begins - flight["y"][step, :6]  # its directions are held for 2 s
        assert np.linalg.norm(miss[:3]) < 20 and np.linalg.norm(miss[3:]) < 0.1


def defect(error):
    """The five numbers of `orbit_defect` of a terminal error (6,)."""
    return np.append(error[:3], target_axes(ROCKET)[:2] @ error[3:])


@pytest.mark.slow
def test_a_loss_of_next_to_nothing_costs_next_to_nothing():
    """Also one that strikes in the last step, or behind the cut-off; more and earlier losses cost more."""
    best = rocket_reference(CUTOFF)["reference_mass_kg"]
    small, last, behind, late, early, large = solve(
        stage_2((300.0, 1e-6), (923.0, 0.3), (950.0, 0.3), (600.0, 0.2), (400.0, 0.2), (400.0, 0.3))
    )
    for optimum in (small, last, behind):
        assert optimum["final_mass"] == pytest.approx(best, abs=0.01)
    masses = [optimum["final_mass"] for optimum in (small, late, early, large)]
    assert masses == sorted(masses, reverse=True) and masses[1] - masses[2] > 50 and masses[2] - masses[3] > 50


@pytest.mark.slow
def test_the_dry_mass_is_relaxed():
    """A last stage with too little left reaches the orbit below its dry mass: no flight of it does."""
    z = np.zeros(SCORES + 4)
    z[DRAW.index("isp_3")] = -3.0
    z[-1] = 1.0
    (optimum,) = solve(z, "ignition", dispersion=1.0)
    dry_mass = envs.draw_vehicles(ROCKET, 1.0, z[None]).dry_mass[0]
    assert dry_mass - 500 < optimum["final_mass"] < dry_mass - 20
    u = rescue.directions_at(optimum, guidance.middles(ROCKET))
    options = {"draw": z, "dispersion": 1.0, "failure": 0.3, "failure_time": "ignition"}
    flight = fly_rocket(CUTOFF, lambda obs, k: u[k, None], **options)
    assert flight["dry"] and flight["error_norm"] > 0.003


@pytest.mark.slow
def test_the_price_of_an_orbit_is_what_another_orbit_costs():
    """The optimum of the same flight solved again, to an orbit a little off: to first order as the price says."""
    (z,) = stage_2((420.0, 0.15))
    (optimum,) = solve(z)
    vehicle = envs.draw_vehicles(ROCKET, 0.0, z[None], 0.3)
    h, e = target_orbit(ROCKET.target, ROCKET.mu)
    error = np.array([3e-4, -2e-4, 1e-4, -2e-4, 1e-4, 0.0])
    h, e = h + error[:3] * np.linalg.norm(h), e + error[3:]
    e = e - h * (e @ h) / (h @ h)  # an eccentricity vector lies in its orbit's plane
    error[3:] = e - target_orbit(ROCKET.target, ROCKET.mu)[1]
    remaining = rescue.remaining_after(vehicle, optimum["strike"], optimum["y"][0], (h, e))
    again = guidance.optimise_remaining(ROCKET, remaining, optimum, (20,))
    known = Known(np.array([optimum["final_mass"]]), optimum["orbit_price"][None])
    difference = again["final_mass"] - optimum["final_mass"]
    assert abs(difference) > 1
    found = known.mass_at(error[None], ROCKET)[0]
    assert found == pytest.approx(optimum["final_mass"] + optimum["orbit_price"] @ defect(error), abs=1e-9)
    assert found - optimum["final_mass"] == pytest.approx(difference, rel=0.02)


def test_a_flight_that_no_optimum_is_found_for_is_nothing_known(monkeypatch):
    """Nor a healthy one; nothing is solved for that."""
    asked = []

    def failing_optima(env_id, mission, failing, z, processes=None):
        asked.extend(z)
        found = {"final_mass": 7000.0, "orbit_price": np.arange(5.0)}
        return [None, *[found] * (len(z) - 1)]

    monkeypatch.setattr(rescue, "failing_optima", failing_optima)
    z = draws(ROCKET, 1.0, 5, 9, 0.3)
    has_failed = z[:, SCORES] < 0.5
    known = rescue.solve_known(CUTOFF, ROCKETS[CUTOFF], PROTOCOL, z)
    np.testing.assert_array_equal(asked, z[has_failed])
    first = int(np.argmax(has_failed))
    expected = has_failed & (np.arange(9) != first)
    np.testing.assert_array_equal(np.isfinite(known.mass), expected)
    assert (known.mass[expected] == 7000).all() and np.isnan(known.price[~expected]).all()


# --- what is stored ---------------------------------------------------------------------------------------------------


@pytest.fixture
def no_solves(monkeypatch, tmp_path):
    """From here on whatever is solved is counted, and has no mass; the stored files are those of an empty folder."""
    solved = []

    def solve_known(env_id, mission, failing, z):
        solved.append(len(z))
        return Known(np.full(len(z), np.nan), np.full((len(z), 5), np.nan))

    monkeypatch.setattr(rescue, "solve_known", solve_known)
    monkeypatch.setattr(rescue, "STORED", tmp_path)
    rescue.known_optima.cache_clear()
    yield solved
    rescue.known_optima.cache_clear()


def test_what_is_stored_is_not_solved(no_solves, tmp_path):
    """The first flights of a file fit, other options, seeds and vehicles do not; damaged files are none."""
    mission = ROCKETS[CUTOFF]
    words = rescue.about(CUTOFF, mission, PROTOCOL, 3)
    np.savez(tmp_path / "b.npz", about=words, mass=np.arange(9.0), price=np.ones((9, 5)))
    (tmp_path / "a.npz").write_bytes(b"damaged")
    np.savez(tmp_path / "c.npz", mass=np.ones(9))
    known = rescue.known_optima(CUTOFF, mission, PROTOCOL, 3, 5)
    np.testing.assert_array_equal(known.mass, np.arange(5.0))
    assert known.price.shape == (5, 5) and no_solves == []
    with pytest.raises(ValueError, match="read-only"):
        known.mass[0] = 1
    heavier = envs.flown_mission(mission, rocket=envs.Rocket(payload=4200.0))
    others = [(mission, PROTOCOL, 4, 5), (mission, PROTOCOL, 3, 10), (heavier, PROTOCOL, 3, 5)]
    changes = ({"dispersion": 0.0}, {"failure": 0.2}, {"failure_time": "ignition"})
    others += [(mission, PROTOCOL._replace(**change), 3, 5) for change in changes]
    for other in others:
        rescue.known_optima(CUTOFF, *other)
    assert no_solves == [5, 10, 5, 5, 5, 5]
    rescue.known_optima(CUTOFF, *others[0])
    assert len(no_solves) == 6  # remembered


@pytest.mark.parametrize("failure_time", ["random", "ignition"])
@pytest.mark.parametrize("env_id, failure", [(CUTOFF, 0.3), (CUTOFF, 0.25), ("TwoStageLEO-v0", 0.3)])
def test_the_stored_optima_fit_today(env_id, failure, failure_time):
    """All 1705 flights of eval seed 0, in files that are small; one of them solved again."""
    rescue.known_optima.cache_clear()
    mission, failing = ROCKETS[env_id], Failing(1.0, failure, failure_time)
    known = rescue.stored_optima(rescue.about(env_id, mission, failing, 0), 1705)
    z = draws(mission.rocket, 1.0, 0, 1705, failure)
    has_failed = z[:, -4] < 0.5
    np.testing.assert_array_equal(np.isfinite(known.mass), has_failed)
    k = np.flatnonzero(has_failed)[100]
    (optimum,) = rescue.failing_optima(env_id, mission, failing, z[[k]], processes=1)
    assert optimum["final_mass"] == pytest.approx(known.mass[k], abs=1e-3)
    np.testing.assert_allclose(optimum["orbit_price"], known.price[k], rtol=1e-3, atol=1.0)
    assert sum(path.stat().st_size for path in rescue.STORED.glob("*")) < 200_000


def test_the_command_prints_and_gives_what_is_stored(monkeypatch, capsys, tmp_path):
    """By engines; the file that it writes is found by an evaluation of the same flights."""
    z = draws(ROCKET, 1.0, 3, 40, 0.2)
    group = envs.draw_vehicles(ROCKET, 1.0, z, 0.2).failure[0]
    mass = np.where(group == 3, 6000.0, 7000.0)

    def failing_optima(env_id, mission, failing, rows, processes=None):
        assert (env_id, failing) == (CUTOFF, Failing(1.0, 0.2, "random"))
        chosen = mass[[int(np.flatnonzero((z == row).all(axis=1))[0]) for row in rows]]
        return [{"final_mass": value, "orbit_price": np.zeros(5)} for value in chosen]

    monkeypatch.setattr(rescue, "failing_optima", failing_optima)
    argv = [CUTOFF, "--failure=0.2", "--dispersion=1", "--starts=40", "--seed=3", f"--npz={tmp_path / 'mine.npz'}"]
    monkeypatch.setattr("sys.argv", ["baselines.py", *argv])
    baselines.main()
    rows = {line[:30].strip(): line[30:].split() for line in capsys.readouterr().out.splitlines()[2:]}
    counts = [int((group == g).sum()) for g in range(4)]
    assert [int(row[0]) for row in rows.values()] == [sum(counts), *counts]
    assert [int(row[2]) for row in rows.values()] == [sum(counts[:3]), *counts[:3], 0]
    monkeypatch.setattr(rescue, "STORED", tmp_path)
    found = rescue.stored_optima(rescue.about(CUTOFF, ROCKETS[CUTOFF], Failing(1.0, 0.2), 3), 40)
    np.testing.assert_array_equal(found.mass, np.where(group < 0, np.nan, mass))


# --- evaluation -------------------------------------------------------------------------------------------------------


def test_statistics_of_the_failures_by_hand():
    """Healthy; saved; savable and missed; not savable but near the target; nothing known."""
    error = np.zeros((6, 6))
    error[:, 2] = 0.5, 0.001, 0.004, 0.03, 0.002, 0.003
    failure = np.array([[-1, 0, 0], [0, 9, 0.1], [2, 9, 0.1], [3, 9, 0.1], [3, 9, 0.1], [1, 9, 0.1]])
    y = np.zeros((6, 7))
    y[:, 6] = 7500, 7400, 7300, 7200, 7100, 7000
    arrays = {"draw": np.zeros((6, 20)), "failure": failure, "final_error": error, "final_y": y}
    best = np.array([np.nan, 7405, 7320, 7300, 6600, np.nan])
    metrics = failure_metrics(arrays, best, best + 1, np.full(6, 6644.0))
    assert metrics.pop("failure_error_p95") == pytest.approx(0.004 + 0.9 * 0.026)
    assert metrics == {
        "failure_starts": 5,
        "failure_savable": 3,
        "failure_saved_rate": 2 / 3,
        "failure_error_median": 0.004,
        "failure_mass_short_mean_kg": pytest.approx((6 + 21) / 2),
    }
    nothing = failure_metrics(arrays, np.full(6, np.nan), best, np.full(6, 6644.0))
    assert nothing == {"failure_starts": 5, "failure_savable": 0}


@pytest.fixture(scope="module")
def flown():
    """The LQR by energy on a dozen drawn flights of seed 7, and what can be saved of them."""
    law = guidance.tvlqr(CUTOFF, by_energy=True)
    return law, *evaluate.evaluate(CUTOFF, law, 7, FLIGHTS, dispersion=1.0, failure=0.3)


@pytest.mark.slow
def test_healthy_and_failing_flights_are_told_apart(flown):
    law, metrics, arrays = flown
    failure = arrays["failure"]
    has_failed = failure[:, 0] >= 0
    np.testing.assert_array_equal(arrays["draw"], draws(ROCKET, 1.0, 7, FLIGHTS, 0.3))
    np.testing.assert_array_equal(has_failed, arrays["draw"][:, SCORES] < 0.5)
    assert (failure[~has_failed] == [-1, 0, 0]).all() and (failure[has_failed, 2] <= 0.3).all()
    assert metrics["failure_starts"] == has_failed.sum() and 0 < has_failed.sum() < FLIGHTS
    assert metrics["dispersed_starts"] == FLIGHTS - has_failed.sum()
    assert (metrics["failure"], metrics["failure_time"], metrics["dispersion"]) == (0.3, "random", 1.0)
    assert all(math.isfinite(value) for value in metrics.values() if isinstance(value, float))

    _, plain = evaluate_dispersed(CUTOFF, law, 7, FLIGHTS, 1.0)
    np.testing.assert_array_equal(arrays["final_y"][~has_failed], plain["final_y"][~has_failed])
    errors = np.linalg.norm(plain["final_error"], axis=1)[~has_failed]
    assert metrics["dispersed_error_median"] == np.median(errors)
    assert metrics["dispersed_error_max"] == errors.max()


@pytest.mark.slow
def test_no_flight_ends_heavier_than_the_optimum_that_knows(flown):
    """Of the orbit that was reached; a flight whose optimum is below the dry mass is not counted as savable."""
    _, metrics, arrays = flown
    known = rescue.known_optima(CUTOFF, ROCKETS[CUTOFF], PROTOCOL, 7, FLIGHTS)
    dry_mass = envs.draw_vehicles(ROCKET, 1.0, arrays["draw"]).dry_mass
    has_failed = arrays["failure"][:, 0] >= 0
    assert metrics["failure_savable"] == (known.mass[has_failed] > dry_mass[has_failed]).sum() > 0
    errors = np.linalg.norm(arrays["final_error"], axis=1)
    close = has_failed & (errors < 5e-3)
    short = (known.mass_at(arrays["final_error"], ROCKET) - arrays["final_y"][:, 6])[close]
    assert close.sum() > 2 and short.min() > -0.5 and metrics["failure_mass_short_mean_kg"] > 0


@pytest.mark.slow
def test_the_saved_flight_that_burns_longest_is_kept(flown):
    """Flown alone it ends as it did among the others; the animation marks its own stagings."""
    _, metrics, arrays = flown
    known = rescue.known_optima(CUTOFF, ROCKETS[CUTOFF], PROTOCOL, 7, FLIGHTS)
    vehicles = envs.draw_vehicles(ROCKET, 1.0, arrays["draw"], 0.3)
    errors = np.linalg.norm(arrays["final_error"], axis=1)
    saved = (known.mass > vehicles.dry_mass) & (errors < 0.02) & (arrays["failure"][:, 0] >= 0)
    k = int(arrays["saved"])
    assert saved[k] and arrays["t_saved"][-1] == arrays["final_t"][k] == arrays["final_t"][saved].max()
    np.testing.assert_allclose(arrays["y_saved"][-1, :6], arrays["final_y"][k, :6], rtol=1e-9)
    animation = task_of(CUTOFF).animation(arrays, metrics)
    animation.frame(len(animation.times) - 1)
    ends = [float(label.get_text().split()[0]) for label in animation.sheet.labels[:3]]
    assert ends == [round(end) for end in vehicles.burn_end[:3, k]]


def test_failures_without_dispersion_have_no_dispersed_statistics(no_solves):
    metrics, arrays = evaluate.evaluate(CUTOFF, guidance.open_loop(CUTOFF), 7, 10, failure=0.01)
    assert not any(key.startswith("dispers") for key in metrics)
    has_failed = arrays["failure"][:, 0] >= 0
    assert metrics["failure_starts"] == has_failed.sum() and metrics["failure_savable"] == 0
    assert np.ptp(arrays["final_y"][~has_failed], axis=0).max() == 0
    assert "0 of them can be saved" in table_of(metrics)
    assert figure_of("trajectory.png", arrays, metrics)


@pytest.mark.slow
def test_a_training_with_failures(no_solves, tmp_path, monkeypatch):
    """The evaluation at its end has its keys; the file says nothing of the failure.

    Its policy flies up. It remembers, so it has to be made for flights longer than any without a failure.
    """
    monkeypatch.chdir(tmp_path)
    tiny = ["--embed-dim=8", "--num-heads=2", "--num-blocks=1", "--memory-length=4", "--mlp-dim=8", "--hidden-dim=8"]
    flags = [f"--env-id={CUTOFF}", "--dispersion=1", "--failure=0.3", "--failure-time=ignition", "--total-updates=1"]
    script().main([*tiny, *flags, "--num-envs=2", "--eval-starts=10", "--eval-seed=4", "--update-epochs=1"])
    (run,) = (tmp_path / "runs").iterdir()
    metrics = json.loads((run / "eval.json").read_text())
    assert metrics["failure"] == 0.3 and metrics["failure_starts"] > 0 and no_solves == [10]
    longest = envs.RocketVectorEnv(1, ROCKETS[CUTOFF], dispersion=1.0).episode_steps
    assert np.load(run / "eval.npz")["final_t"].max() > 2 * longest + 50
    args = parse("--eval-only", f"--checkpoint={run}/agent.safetensors")
    assert args.failure == 0.0 and args.eval_starts == 1000


# --- flags ------------------------------------------------------------------------------------------------------------


def test_a_training_with_failures_begins_as_a_dispersed_one():
    args = parse(f"--env-id={CUTOFF}", "--failure=0.2")
    assert args.checkpoint.endswith("no_blocks/agent.safetensors") and args.flights_per_start.at(0.0) == 16
    assert args.eval_starts == 1705 and args.dispersion == 0.0


@pytest.mark.parametrize(
    "argv, message",
    [
        (["--failure=0.1", "--failure-time=late"], "error: --failure-time late: must be one of random, ignition"),
        (["--failure=0.1", f"--env-id={FIXED}"], "error: --failure 0.1: must be 0 where flights end at a fixed time"),
        (["--failure=0.1", "--no-observe-phase", "--recipe=paper"], "error: --no-observe-phase: not in a training"),
    ],
)
def test_flags_that_do_not_fit_are_one_line(argv, message):
    with pytest.raises(SystemExit) as refusal:
        parse(f"--env-id={CUTOFF}", *argv)
    assert str(refusal.value).startswith(message) and "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "argv, line",
    [
        ([FIXED, "--failure=0.1"], "error: --failure is 0.1; it must be 0 where flights end at a fixed time"),
        ([CUTOFF, "--failure=0.4"], "error: argument --failure: '0.4' must be a number from 0 to 0.3"),
        ([CUTOFF, "--failure=0.1", "--failure-time=late"], "error: argument --failure-time: invalid choice: 'late'"),
    ],
)
def test_a_command_that_does_not_fit_is_one_line(monkeypatch, argv, line):
    monkeypatch.setattr("sys.argv", ["baselines.py", *argv])
    with pytest.raises(SystemExit) as refusal:
        baselines.main()
    assert str(refusal.value).startswith(line) and "\n" not in str(refusal.value)


# --- opponents --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """The command with failures on a copy of the shipped results, with few solves, here: folder and Comparison."""
    ignored = shutil.ignore_patterns("*.gif")
    source = ROOT / "results" / "rocket_cutoff"
    folder = shutil.copytree(source, tmp_path_factory.mktemp("results") / "rocket", ignore=ignored)

    def fly_checkpoint(path, dispersion, eval_seed, n, **failures):
        """What a policy's process would give, without torch."""
        _, arrays = evaluate_dispersed(CUTOFF, guidance.open_loop(CUTOFF), eval_seed, n, dispersion, **failures)
        return arrays, {"knows": "nothing", "decision_us": 7.0}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guidance, "REPLAN_EVERY", 300.0)
        patch.setattr(guidance, "DRAWN_SEGMENTS", 8)
        patch.setattr(comparison, "PROCESSES", 1)
        patch.setattr(comparison, "fly_checkpoint", fly_checkpoint)
        made, keep = [], comparison.Comparison.__init__
        patch.setattr(comparison.Comparison, "__init__", lambda self, *a, **k: made.append(self) or keep(self, *a, **k))
        rescue.known_optima.cache_clear()
        comparison.compare(CUTOFF, folder, 1.0, 6, 3, 4, failure=0.2, failure_time="ignition")
        rescue.known_optima.cache_clear()
    return folder, made[0]


@pytest.mark.slow
def test_opponents_meet_the_same_failures(compared):
    folder, flown = compared
    report = json.loads((folder / "opponents_at_ignition.json").read_text())
    assert (report["failure"], report["failure_time"]) == (0.2, "ignition")
    z = draws(ROCKET, 1.0, 4, 6, 0.2)
    has_failed = z[:, SCORES] < 0.5
    for name, law in report["laws"].items():
        n = 3 if name in (*comparison.REPLANS, "optimum") else 6
        np.testing.assert_array_equal(flown.arrays[name]["draw"], z[:n])
        assert law["failure_starts"] == has_failed[:n].sum() and law["dispersed_starts"] == (~has_failed[:n]).sum()
        assert law["first"]["failure_starts"] == has_failed[:3].sum()
        savable = [rows[name]["savable"] for label, rows in report["by_loss"].items() if " to " in label]
        assert sum(savable) == law["failure_savable"]
    best = report["laws"]["optimum"]
    assert best["failure_saved_rate"] == 1 and best["failure_error_p95"] < 2e-3
    assert best["failure_mass_short_mean_kg"] < report["laws"]["tvlqr_energy"]["failure_mass_short_mean_kg"]
    with np.load(folder / "opponents_at_ignition.npz") as file:
        np.testing.assert_array_equal(np.isfinite(file["best_mass_kg"]), has_failed | (np.arange(6) < 3))


@pytest.mark.parametrize("flag", ["--dispersion=1", "--starts=5"])
def test_flags_of_failing_flights_need_a_failure(monkeypatch, flag):
    monkeypatch.setattr("rocket.task.report_rocket", None)  # nothing is solved
    monkeypatch.setattr("sys.argv", ["baselines.py", "RocketAscentCutoff-v0", flag])
    with pytest.raises(SystemExit) as refusal:
        baselines.main()
    name, value = flag.split("=")
    assert re.fullmatch(f"error: {name} is '?{value}(.0)?'?; it must be left out without --failure", refusal.value.code)


def test_a_landers_opponents_take_no_failure(tmp_path):
    with pytest.raises(BadInput, match="^--failure is 0.1; it is no flag of MarsLanding-v0; leave it out$"):
        task_of("MarsLanding-v0").fly_opponents(tmp_path, dispersion=1.0, n=10, solved=10, eval_seed=0, failure=0.1)
