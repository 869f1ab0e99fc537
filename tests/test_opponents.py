"""The opponents against the environment, SciPy and least squares; the comparison's command against bad input."""

import json
import shutil
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from helpers import save
from rocket_oracle import CUTOFF, LEO, PAPER

import envs
import evaluate
from common.errors import NoOptimum
from envs import ROCKET, ROCKETS
from rocket import comparison, guidance
from rocket.dispersion import draw_names
from rocket.metrics import dispersed_metrics, draws, evaluate_dispersed, fly_dispersed
from rocket.optimum import rocket_reference

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
SHIPPED = ROOT / "results" / "rocket_cutoff"
SCORES = len(draw_names(ROCKET))
HIT = 0.015  # the success of the compared flights: of three that are replayed one is none


def ends(law, z, env_id=CUTOFF):
    """The ends of flights with the draws z (m, k) at dispersion 1."""
    return fly_dispersed(env_id, law, np.asarray(z), 1.0)


# --- open loop and LQR ------------------------------------------------------------------------------------------------


def test_without_a_difference_every_law_of_the_optimum_reaches_the_target():
    z = np.zeros((1, len(envs.draw_names(ROCKETS[LEO].rocket))))
    for law in (guidance.open_loop(LEO), guidance.tvlqr(LEO), guidance.tvlqr(LEO, by_energy=True)):
        assert ends(law, z, LEO)["error_norm"][0] < 2e-4


@pytest.fixture(scope="module")
def linear():
    """The optimum, its steering axes, A (K, 6, 6) and B (K, 6, 2)."""
    flight = rocket_reference(CUTOFF)
    axes = guidance.normal_axes(flight["u"])
    return flight, axes, *guidance.linearise_flight(ROCKETS[CUTOFF], flight, axes)


@pytest.mark.parametrize("k", [3, 37, 130, 461])  # 37 and 130: steps with a staging; 462 is the last
def test_linearised_steps_are_scipys(linear, k):
    """Central differences of SciPy's integration between the stagings, with other differences and other axes."""
    flight, axes, A, B = linear
    begin, end, y, u = flight["t"][k], flight["t"][k + 1], flight["y"][k], flight["u"][k]

    def step(dx, du):
        w = u + du
        return PAPER.integrate(y + np.append(dx, 0.0), begin, end, w / np.linalg.norm(w))[:6]

    for j, h in enumerate(np.repeat([200.0, 0.2], 3)):
        column = (step(h * np.eye(6)[j], 0.0) - step(-h * np.eye(6)[j], 0.0)) / (2 * h)
        np.testing.assert_allclose(A[k, :, j], column, rtol=2e-4, atol=2e-6)
    np.testing.assert_allclose(axes[k] @ axes[k].T, np.eye(2), atol=1e-14)
    np.testing.assert_allclose(axes[k] @ u, 0.0, atol=1e-14)
    for j in range(2):
        column = (step(np.zeros(6), 1e-3 * axes[k, j]) - step(np.zeros(6), -1e-3 * axes[k, j])) / 2e-3
        np.testing.assert_allclose(B[k, :, j], column, rtol=1e-4, atol=1e-4 * np.abs(column).max())


def test_gains_are_the_least_squares_of_the_last_steps(linear):
    """From step K - 12 on: the angles that minimise |C x_K|^2 + R dt |angles|^2, all at once, without a recursion."""
    flight, _, A, B = linear
    gains, _ = guidance.lqr_gains(ROCKETS[CUTOFF], flight)
    K, first, dt = len(A), len(A) - 12, np.diff(flight["t"])
    rate = (flight["y"][-1] - flight["y"][-2])[:6] / dt[-1]
    C = guidance.cutoff_jacobian(ROCKET, flight["y"][-1], rate)
    ahead, columns = np.eye(6), []
    for k in reversed(range(first, K)):
        columns.insert(0, C @ ahead @ B[k])
        ahead = ahead @ A[k]
    weights = np.sqrt(guidance.STEERING_WEIGHT * np.repeat(dt[first:], 2))
    system = np.vstack([np.hstack(columns), np.diag(weights)])
    best = np.linalg.lstsq(system, np.vstack([-C @ ahead, np.zeros((24, 6))]), rcond=1e-15)[0][:2]
    np.testing.assert_allclose(-gains[first], best, rtol=1e-5, atol=1e-7 * np.abs(best).max())


def test_what_is_along_the_trajectory_costs_nothing():
    """And what keeps the energy costs its terminal error."""
    y = rocket_reference(CUTOFF)["y"][-1]
    rate = np.append(y[3:6], -ROCKET.mu * y[:3] / np.linalg.norm(y[:3]) ** 3 + 14.0 * y[3:6] / np.linalg.norm(y[3:6]))
    C = guidance.cutoff_jacobian(ROCKET, y, rate)
    beside = np.append([30.0, -20.0, 10.0], [0.02, 0.01, -0.03])
    assert np.linalg.norm(C @ rate) < 1e-9 < 1e-6 < np.linalg.norm(C @ beside)
    moved = y[:6] + beside
    kinetic = ROCKET.target_energy + ROCKET.mu / np.linalg.norm(moved[:3])  # at the target's energy
    moved[3:] *= np.sqrt(2 * kinetic) / np.linalg.norm(moved[3:])
    at = y[:6].copy()
    at[3:] *= np.sqrt(2 * (ROCKET.target_energy + ROCKET.mu / np.linalg.norm(at[:3]))) / np.linalg.norm(at[3:])
    miss = envs.terminal_error(moved, ROCKET) - envs.terminal_error(at, ROCKET)
    np.testing.assert_allclose(C @ (moved - at), miss, atol=2e-4 * np.linalg.norm(miss))


def test_feedback_is_worth_something():
    """On the same eight draws the LQR ends closer than the replay; by energy the worst flight closer still."""
    z = draws(ROCKET, 1.0, 5, 8)
    laws = guidance.open_loop(CUTOFF), guidance.tvlqr(CUTOFF), guidance.tvlqr(CUTOFF, by_energy=True)
    open_loop, by_time, by_energy = (ends(law, z)["error_norm"] for law in laws)
    assert (by_time < open_loop / 2).all() and by_time.max() < 2e-3
    assert by_energy.max() < 5e-4 and by_energy.max() < by_time.max()


@pytest.mark.parametrize("by_energy", [False, True])
def test_a_late_flight_is_steered_as_gently_as_the_one_before(by_energy):
    """The optimum's last step is a fraction of the others, and the angle that mends an error within it is large."""
    flight, law = rocket_reference(LEO), guidance.tvlqr(LEO, by_energy)
    last, beside = len(flight["u"]), np.repeat([10.0, 0.05], 3)  # m and m/s

    def turn(place, t):
        """Between the directions of the optimum's state and one beside it, rad."""
        obs = np.tile(np.concatenate([flight["y"][place], [0.0, 1.0]]), (2, 1))
        obs[1, :6] += beside
        return np.arccos(np.clip(np.prod(law(obs, t), axis=0).sum(), -1, 1))

    assert turn(last, last + 3) < 3 * turn(last - 2, last - 2) < 0.05


@pytest.mark.parametrize("env_id", [CUTOFF, LEO])
def test_plans_have_directions_until_the_last_vehicle_burns_out(env_id):
    """The 1705 draws of eval seed 0: some burn longer than the nominal vehicle may."""
    rocket = ROCKETS[env_id].rocket
    burn_out = envs.draw_vehicles(rocket, 1.0, draws(rocket, 1.0, 0, 1705)).burn_out.max()
    assert rocket.end_time < burn_out < guidance.middles(rocket)[-1]


# --- what solves ------------------------------------------------------------------------------------------------------


def test_replanning_the_nominal_flight_loses_nothing():
    law = guidance.Replanning(CUTOFF)
    flown = ends(law, np.zeros((1, SCORES)))
    assert len(law.seconds) >= 30 and law.failed == 0
    assert flown["error_norm"][0] < 2e-5
    # a direction that is held for 2 s costs 0.06 kg
    assert flown["final_mass_kg"][0] == pytest.approx(rocket_reference(CUTOFF)["reference_mass_kg"], abs=0.1)


def flying(law, z, step=0, lost=0.0):
    """Flights with the draws z (m, k) whose last stages lose a part of thrust and flow at the begin of a step.

    What is observed, the batch, and its `final_info`, after each step until the first of them ends.
    """
    env = gym.make_vec(CUTOFF, num_envs=len(z), dispersion=1.0).unwrapped
    obs, _ = env.reset(options={"draw": z})
    final, t = {}, 0
    while not final:
        if t == step:
            vehicles, last = env.vehicles, len(ROCKET.burns) - 1
            left = (vehicles.end[last] - t * ROCKET.dt) / (1 - lost)  # s: what is aboard lasts longer
            vehicles.thrust[last] *= 1 - lost
            vehicles.flow[last] *= 1 - lost
            vehicles.end[last] = vehicles.burn_out[:] = t * ROCKET.dt + left
            env._set_ends(vehicles)
        obs, _, _, final = env.advance(law(obs, t))
        t += 1
        yield obs, env, final


def test_the_measured_engine_is_the_flight_s():
    """Thrust and flow over mass, from r and v alone, of vehicles in the nominal air, before and after a loss.

    In their own air a part of the little drag that is left there counts as thrust.
    """
    z, fly = np.repeat(draws(ROCKET, 1.0, 6, 3), 2, axis=0), guidance.open_loop(CUTOFF)
    z[::2, -3:] = 0.0
    allowed = np.tile([1e-6, 1e-4], 3)
    engine = guidance.MeasuredEngine(ROCKET, guidance.drawn_exhaust(ROCKET, 1.0, z), len(z))
    for t, (obs, env, _) in enumerate(flying(fly, z, 250, 0.3), 1):
        engine.update(obs, env.u.T, obs[:, 8] == 1)
        if t in (135, 200, 250, 251, 400):
            for name in ("thrust", "flow"):
                true = getattr(env.vehicles, name)[3] / env.y[6]
                assert (np.abs(getattr(engine, name) / engine.mass / true - 1) < allowed).all(), (t, name)
    assert t > 450


@pytest.mark.parametrize("step", [131, 455])
def test_a_loss_of_thrust_is_measured(step):
    """A fifth, from before the last burn on, within the step before a plan, after the last plan that is due.

    The first flight lasts 180 s longer than the nominal one, beyond its burn-out. The nominal plan misses by far more.
    """
    z, law = np.zeros((1, SCORES)), guidance.Replanning(CUTOFF, exhaust=guidance.nominal_exhaust(ROCKET))
    *_, (_, _, final) = flying(law, z, step, 0.2)
    assert final["error_norm"][0] < 5e-6
    assert (final["final_time_s"][0] > 1090) == (step == 131)
    *_, (_, _, final) = flying(guidance.open_loop(CUTOFF), z, step, 0.2)
    assert final["error_norm"][0] > 5e-5


def test_after_the_lqr_an_early_loss_costs_less(monkeypatch):
    """Stage 1 loses an eighth after a fifth of its burn. The LQR answers at once, the open loop not at all."""
    monkeypatch.setattr(guidance, "REPLAN_EVERY", 100.0)
    z, exhaust = np.zeros((1, SCORES + 4)), guidance.nominal_exhaust(ROCKET)
    z[0, SCORES:] = 0.1, 0.6, 0.2, 0.5
    masses = []
    for before in (None, guidance.tvlqr(CUTOFF, by_energy=True)):
        law = guidance.Replanning(CUTOFF, exhaust=exhaust, before=before)
        end = fly_dispersed(CUTOFF, law, z, 1.0, failure=0.25)
        assert end["error_norm"][0] < 1e-5
        masses.append(end["final_y"][0, 6])
    assert masses[1] > masses[0] + 20


def test_a_failed_solve_keeps_the_last_plan(monkeypatch):
    def fail(*_):
        raise NoOptimum("none")

    monkeypatch.setattr(guidance, "optimise_remaining", fail)
    z, law = draws(ROCKET, 1.0, 5, 2), guidance.Replanning(CUTOFF)
    np.testing.assert_array_equal(ends(law, z)["final_y"], ends(guidance.open_loop(CUTOFF), z)["final_y"])
    assert law.failed == len(law.seconds) > 50


@pytest.mark.parametrize("flow", [-0.01, 1e9])
def test_a_measured_flow_that_leaves_nothing_to_burn_keeps_the_last_plan(flow):
    """Low in the air, drag that differs can hide the thrust. Nothing but that flight's plan is lost."""
    rocket, target = ROCKET, envs.target_orbit(ROCKET.target, ROCKET.mu)
    y, guess = rocket_reference(CUTOFF)["y"][150], guidance.optimum_guess(CUTOFF)
    now, mass, thrust = 300.0, np.array([y[6]]), np.array([1e5])
    end = now + (mass - rocket.dry_mass) / flow
    if flow > 0:
        end = np.array([now])
    remaining = guidance.RemainingAscent(now, y[:6], end, thrust, np.array([flow]), mass, *target)
    with pytest.raises(NoOptimum, match="^the remaining ascent from 300.0 s: nothing is left to burn$"):
        guidance.optimise_remaining(rocket, remaining, guess, (guidance.REPLAN_INTERVALS,))
    plan, _ = guidance.replan_one((rocket, remaining, guess))
    assert plan is None


def test_the_optimum_of_a_draw_is_flown_by_the_environment():
    """To the target, with its mass; another flight's optimum misses: thrust, staging, drag and wind are the draw's."""
    z = draws(ROCKETS[LEO].rocket, 1.0, 5, 2)
    optima = guidance.drawn_optima(LEO, 1.0, z)
    own, other = (ends(guidance.fly_optima(LEO, plans), z, LEO) for plans in (optima, optima[::-1]))
    assert own["error_norm"].max() < 2e-4 < 1e-3 < other["error_norm"].min()
    np.testing.assert_allclose(own["final_mass_kg"], [optimum["final_mass"] for optimum in optima], rtol=2e-5)


def test_to_the_orbit_reached_the_bound_holds():
    """A replay that misses is lighter than the optimum of its own draw and orbit, heavier perhaps than the target's."""
    z = draws(ROCKET, 1.0, 5, 3)
    flown = ends(guidance.open_loop(CUTOFF), z)
    optima = guidance.drawn_optima(CUTOFF, 1.0, z, flown["final_y"])
    for optimum, y in zip(optima, flown["final_y"]):
        assert 0.998 < y[6] / optimum["final_mass"] < 1
        reached, planned = (envs.orbital_elements(state) for state in (y, optimum["y"][-1]))
        np.testing.assert_allclose(planned, reached, rtol=1e-7)


# --- comparison -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", ["replay", "down"])
def test_recorded_flights_give_the_metrics_again(law):
    policy = guidance.open_loop(CUTOFF) if law == "replay" else lambda obs, t: -obs[:, :3]
    metrics, arrays = evaluate_dispersed(CUTOFF, policy, 4, 12, 6.0)
    flights = comparison.recorded_flights(arrays, ROCKET, comparison.Failing(6.0))
    again = dispersed_metrics(flights, ROCKET)
    assert again.keys() == metrics.keys() - {"dispersion", "dispersed_starts"}
    assert all(again[key] == pytest.approx(metrics[key], rel=1e-12) for key in again)
    assert metrics["dispersed_crashed"] == (12 if law == "down" else 0)


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """The command on a copy of the shipped results, with few solves in this process.

    Its folder, its Comparison, and the masses (laws, 3) of the optima to the orbits that were reached: the first law's
    first optimum is not found.
    """
    folder = shutil.copytree(
        SHIPPED, tmp_path_factory.mktemp("results") / "rocket", ignore=shutil.ignore_patterns("*.gif")
    )

    def fly_checkpoint(path, dispersion, eval_seed, n):
        """What a policy's process would give, without torch."""
        _, arrays = evaluate_dispersed(CUTOFF, guidance.open_loop(CUTOFF), eval_seed, n, dispersion)
        return arrays, {"knows": comparison.knowledge({"dispersion": 1.0, "observe_draw": True}), "decision_us": 7.0}

    solve, masses = guidance.drawn_optima, []

    def drawn_optima(env_id, dispersion, z, reached=None, processes=1):
        optima = solve(env_id, dispersion, z, reached, processes)
        if reached is not None:
            masses.extend([np.nan, *(optimum["final_mass"] for optimum in optima[1:])])
            optima[0] = None
        return optima

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparison, "SUCCESS", HIT)
        patch.setattr(guidance, "drawn_optima", drawn_optima)
        patch.setattr(guidance, "REPLAN_EVERY", 200.0)
        patch.setattr(guidance, "DRAWN_SEGMENTS", 8)
        patch.setattr(comparison, "PROCESSES", 1)
        patch.setattr(comparison, "fly_checkpoint", fly_checkpoint)
        made, keep = [], comparison.Comparison.__init__
        patch.setattr(comparison.Comparison, "__init__", lambda self, *a: made.append(self) or keep(self, *a))
        comparison.compare(CUTOFF, folder, 1.0, 6, 3, 3, [("again", folder / "agent.safetensors")])
    return folder, made[0], np.reshape(masses, (-1, 3))


def test_all_laws_fly_the_same_draws(compared):
    _, flown, _ = compared
    z = draws(ROCKET, 1.0, 3, 6)
    assert set(flown.arrays) == {"policy", "again", *comparison.KNOWLEDGE}
    for name, arrays in flown.arrays.items():
        n = 3 if name in (*comparison.REPLANS, "optimum") else 6
        np.testing.assert_array_equal(arrays["draw"], z[:n])


def test_a_policy_on_other_draws_is_refused(monkeypatch):
    """Its flights could not be set beside those of the laws."""

    def fly_checkpoint(path, dispersion, eval_seed, n):
        return {"draw": draws(ROCKET, dispersion, eval_seed + 1, n)}, {}

    monkeypatch.setattr(comparison, "fly_checkpoint", fly_checkpoint)
    flown = comparison.Comparison(CUTOFF, 1.0, 3, 10, 10)
    with pytest.raises(ValueError, match="^mine did not fly the draws of eval seed 3$"):
        flown.fly_policies({"mine": SHIPPED / "agent.safetensors"})
    assert not flown.arrays


def test_report(compared):
    folder, flown, reached = compared
    laws = json.loads((folder / "opponents.json").read_text())["laws"]
    counts = []
    for (name, law), masses in zip(laws.items(), reached, strict=True):
        errors = np.linalg.norm(flown.arrays[name]["final_error"], axis=1)
        assert law["dispersed_starts"] == len(errors) and law["first"]["dispersed_starts"] == 3
        assert law["dispersed_error_max"] == errors.max() and law["first"]["dispersed_error_max"] == errors[:3].max()
        counted = (errors[:3] < HIT) & np.isfinite(masses)
        counts.append(law["share_reached_flights"])
        assert counts[-1] == counted.sum() > 0
        shares = (flown.arrays[name]["final_y"][:3, 6] / masses)[counted]
        assert law["share_reached_mean"] == pytest.approx(shares.mean(), rel=1e-12) and shares.max() < 1.0001
    assert counts[:4] == [1, 2, 2, 3]  # what is no success, or has no optimum, is left out: not all count alike
    assert laws["policy"]["knows"] == "draws in training, the draw itself"
    assert laws["optimum"]["share_target_mean"] == pytest.approx(1, abs=1e-4)
    share = flown.arrays["tvlqr"]["final_y"][:3, 6] / [optimum["final_mass"] for optimum in flown.optima]
    assert laws["tvlqr"]["share_target_mean"] == pytest.approx(share.mean())
    for name in comparison.REPLANS:
        assert laws[name]["solves"] == 9 and laws[name]["decision_us"] > 1000 > laws["replay"]["decision_us"] > 0
    assert (folder / "figures" / "opponents.png").stat().st_size > 10_000


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Copies of three results, without figures."""
    folder = tmp_path_factory.mktemp("copies")
    for name in ("rocket_cutoff", "rocket_fixed", "di"):
        shutil.copytree(ROOT / "results" / name, folder / name, ignore=shutil.ignore_patterns("figures"))
    return folder


@pytest.mark.parametrize(
    "argv, line",
    [
        (["{missing}"], "eval.json is not there"),
        (["{fixed}"], "the env_id of .* is RocketAscent-v0; it must be a rocket's with cut-off"),
        (["{good}", "--starts=9"], "'9' must be a whole number from 10 to 100000"),
        (["{good}", "--starts=20", "--solved=21"], "--solved is 21; it must be at most 20, as --starts is"),
        (["{good}", "--dispersion=nan"], "'nan' must be a number above 0, at most 10"),
        (["{good}", "--also", "mine"], "'mine' must be NAME=PATH"),
        (
            ["{good}", "--also", "replan={good}/agent.safetensors"],
            "the NAME of --also is replan; it must be that of no",
        ),
        (["{good}", "--also", "mine={missing}"], "No such file"),
        (["{good}", "--also", "mine={good}/eval.json"], "damaged or foreign"),
        (["{good}", "--also", "mine={di}/agent.safetensors"], f"is DoubleIntegrator-v0; it must be {CUTOFF}"),
    ],
)
def test_bad_input_is_one_line_and_changes_nothing(results, monkeypatch, argv, line):
    monkeypatch.setattr(comparison, "Comparison", None)  # nothing is flown
    places = {"good": "rocket_cutoff", "fixed": "rocket_fixed", "di": "di", "missing": "nowhere"}
    argv = [word.format(**{key: results / name for key, name in places.items()}) for word in argv]
    before = {path: path.read_bytes() for path in results.rglob("*") if path.is_file()}
    monkeypatch.setattr("sys.argv", ["evaluate.py", "opponents", *argv])
    with pytest.raises(SystemExit, match=line) as refusal:
        evaluate.main()
    assert "\n" not in str(refusal.value)
    assert {path: path.read_bytes() for path in results.rglob("*") if path.is_file()} == before


def test_a_script_that_refuses_is_said_in_its_own_line(tmp_path):
    """A policy with another network than its file says."""
    broken = tmp_path / "agent.safetensors"
    data = (SHIPPED / "agent.safetensors").read_bytes().replace(b'\\"embed_dim\\": 64', b'\\"embed_dim\\": 32')
    broken.write_bytes(data)
    with pytest.raises(envs.BadInput, match=f"^{broken}: error: --checkpoint .* does not fit its own args"):
        comparison.fly_checkpoint(broken, 1.0, 0, 10)


def test_a_policys_process_flies_the_draws_that_were_asked_for(tmp_path):
    """Two of ten flights again, by the file's weights in this process."""
    import ppo_gtrxl_rocket as script

    seed, dispersion = 3, 2.0  # no flag's default
    agent, _, _ = save(script, tmp_path, env_id=CUTOFF, dispersion=1.0)
    arrays, about = comparison.fly_checkpoint(tmp_path / "agent.safetensors", dispersion, seed, 10)
    np.testing.assert_array_equal(arrays["draw"], draws(ROCKET, dispersion, seed, 10))
    assert about["knows"] == "draws in training" and about["decision_us"] > 0

    steps = gym.make_vec(CUTOFF, num_envs=1, dispersion=dispersion).unwrapped.episode_steps
    again = fly_dispersed(CUTOFF, agent.make_policy(steps), arrays["draw"][[0, 9]], dispersion, action_frame="local")
    # float32 rounds a smaller batch otherwise
    np.testing.assert_allclose(arrays["final_error"][[0, 9]], again["error"], atol=1e-6)
    np.testing.assert_allclose(arrays["final_y"][[0, 9], 6], again["final_mass_kg"], atol=0.01)
    np.testing.assert_allclose(arrays["final_t"][[0, 9]], again["final_time_s"], atol=0.001)
