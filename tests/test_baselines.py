"""baselines.py against the published numbers, against one another, and against cost sums written out here."""

import json
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import baselines
from baselines import box_qp, fly_solution, lqr, lqr_policy, optimise, reference
from common.ipopt import interruptible
from common.tasks import env_ids, task_of
from envs import DOUBLE_INTEGRATOR, PROBLEMS, VAN_DER_POL, Phase, Problem, double_integrator, fly
from phased.optimum import guesses, hermite_simpson

ROOT = Path(__file__).resolve().parents[1]
KEYS = {"x", "u", "reward", "episodic_return", "cost", "cost_state", "cost_control", "cost_terminal", "hit"}
KEYS |= {"terminal_error"}


def starts(n, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (n, 2))


def over_the_box(points):
    """Starts (points^2, 2) and weights of the Gauss-Legendre rule: the mean over the box without sampling error."""
    nodes, weights = np.polynomial.legendre.leggauss(points)
    return np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2), np.outer(weights, weights).ravel() / 4


def flown(env_id, x0, u):
    return fly(env_id, lambda obs, t: u[:, t, None], x0)


# --- double integrator ------------------------------------------------------------------------------------------------


def test_riccati_numbers():
    K, P = lqr(DOUBLE_INTEGRATOR)
    assert K.shape == (50, 2) and P.shape == (51, 2, 2)
    np.testing.assert_allclose(K[0], [2.585923, 3.443511], atol=5e-7)
    np.testing.assert_allclose(P[0], [[13.317991, 3.201823], [3.201823, 4.603603]], atol=5e-7)
    assert np.trace(P[0]) / 3 == pytest.approx(5.97386, abs=5e-6)
    np.testing.assert_array_equal(P[-1], 20 * np.eye(2))


def test_riccati_is_the_least_squares_optimum():
    """Without its bound the problem is least squares in u: x'P_0 x is its minimum and -K_0 x its first control."""
    A, B = np.array([[1, 0.1], [0, 1]]), np.array([0.005, 0.1])
    K, P = lqr(DOUBLE_INTEGRATOR)
    x0 = np.array([0.7, -0.4])
    free, forced, rows, right = x0, np.zeros((2, 50)), [], []
    for t in range(51):
        scale = np.sqrt(20.0) if t == 50 else 1.0
        rows.append(scale * forced)
        right.append(-scale * free)
        free, forced = A @ free, A @ forced
        if t < 50:
            forced[:, t] += B
    system, right = np.vstack([*rows, np.sqrt(0.1) * np.eye(50)]), np.concatenate([*right, np.zeros(50)])
    u, residual, *_ = np.linalg.lstsq(system, right)
    assert x0 @ P[0] @ x0 == pytest.approx(residual[0], rel=1e-12)
    assert -K[0] @ x0 == pytest.approx(u[0], rel=1e-10)


def test_saturation_numbers():
    x0 = starts(1000)
    optimum, (_, P) = reference("DoubleIntegrator-v0", x0), lqr(DOUBLE_INTEGRATOR)
    unbounded = np.einsum("ni,ij,nj->n", x0, P[0], x0)
    ratio, saturates = optimum["cost"] / unbounded, (np.abs(optimum["u"]) == 4).any(axis=1)
    assert saturates.mean() == pytest.approx(0.11, abs=0.01)
    assert ratio.mean() == pytest.approx(1.0007, abs=1e-4)
    assert ratio.max() == pytest.approx(1.027, abs=2e-3)
    np.testing.assert_allclose(ratio[~saturates], 1, rtol=0, atol=1e-12)
    assert optimum["episodic_return"].mean() == pytest.approx(14.0, abs=0.1)


def test_clipped_lqr_is_the_box_qp_optimum():
    x0 = np.vstack([starts(100), [[1, 1], [-1, -1], [1, -1]]])
    u = box_qp(DOUBLE_INTEGRATOR, x0)
    optimum = reference("DoubleIntegrator-v0", x0)
    assert (np.abs(u).max(axis=1) > 4 - 1e-12).sum() >= 5, "some starts should saturate"
    np.testing.assert_allclose(optimum["cost"], flown("DoubleIntegrator-v0", x0, u)["cost"], rtol=1e-9)
    np.testing.assert_allclose(optimum["u"], u, rtol=0, atol=1e-9)


def test_ipopt_is_lqr_where_it_does_not_saturate():
    x0 = starts(60)
    expected = reference("DoubleIntegrator-v0", x0)
    inside = np.abs(expected["u"]).max(axis=1) < 3.9
    assert 40 < inside.sum() < 60
    u, cost, feasible, _ = optimise("DoubleIntegrator-v0", x0[inside])
    assert feasible.all()
    np.testing.assert_allclose(cost, expected["cost"][inside], rtol=1e-9)
    np.testing.assert_allclose(u, expected["u"][inside], rtol=0, atol=1e-6)


# --- Van der Pol ------------------------------------------------------------------------------------------------------


def test_van_der_pol_numbers():
    x0, weights = over_the_box(8)
    optimum = reference("VanDerPol-v0", x0)
    assert weights @ optimum["cost"] == pytest.approx(11.792, abs=0.002)
    assert optimum["terminal_error"].max() == pytest.approx(0.0145, abs=1e-3) and optimum["hit"].all()
    assert optimum["replay_error"].max() < 1e-8 and KEYS <= set(optimum)


def test_collocation_and_linear_feedback_beside_the_optimum():
    x0 = starts(50)
    optimum = reference("VanDerPol-v0", x0)["cost"]
    u, cost, feasible, _ = optimise("VanDerPol-v0", x0, hermite_simpson)
    assert feasible.all()
    np.testing.assert_allclose(cost, optimum, rtol=1e-5)
    assert not np.array_equal(cost, optimum), "collocation should be another discretisation"
    collocated = flown("VanDerPol-v0", x0, u)["cost"]
    assert (collocated >= optimum * (1 - 1e-9)).all() and collocated.sum() / optimum.sum() < 1 + 1e-6
    linear = fly("VanDerPol-v0", lqr_policy(VAN_DER_POL), x0)["cost"]
    assert (linear > optimum * (1 - 1e-9)).all() and 1.00005 < linear.sum() / optimum.sum() < 1.001


def test_a_signal_in_a_solve_is_not_lost():
    """CasADi turns what a signal's handler raises into one more of IPOPT's return statuses, among others."""
    x0 = starts(300)
    optimise("VanDerPol-v0", x0[:1], processes=1)  # builds the program
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        for delay in (0.02, 0.023, 0.026):  # of 300 solves, which take 0.7 s or more
            timer = threading.Timer(delay, signal.raise_signal, [signal.SIGINT])
            timer.start()
            with pytest.raises(KeyboardInterrupt):
                optimise("VanDerPol-v0", x0, processes=1)
            timer.join()
            assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("passed_over", ["nothing", "an exception of another kind", "an interrupt"])
def test_what_a_handler_raised_is_raised_at_the_end(passed_over):
    """Where CasADi passes over it; the handler that was there is back then."""

    def handler(signum, frame):
        raise KeyboardInterrupt(signum)

    @interruptible()
    def solve():
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            if passed_over == "an interrupt":
                raise
        if passed_over == "an exception of another kind":
            raise RuntimeError

    before = signal.signal(signal.SIGTERM, handler)
    try:
        with pytest.raises(KeyboardInterrupt, match=str(signal.SIGTERM.value)):
            solve()
        assert signal.getsignal(signal.SIGTERM) is handler
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_signal_while_the_handlers_are_put_back(monkeypatch):
    put = signal.signal

    def late(signum, handler):
        if handler is signal.default_int_handler:
            signal.raise_signal(signal.SIGINT)
        return put(signum, handler)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), interruptible():
            monkeypatch.setattr(signal, "signal", late)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        put(signal.SIGINT, before)


def test_a_block_without_a_signal_keeps_its_own_errors():
    with pytest.raises(ZeroDivisionError), interruptible():
        raise ZeroDivisionError


def test_result_does_not_depend_on_the_number_of_processes():
    x0 = starts(12)
    alone = optimise("VanDerPol-v0", x0, processes=1)
    shared = optimise("VanDerPol-v0", x0, processes=2)
    backwards = optimise("VanDerPol-v0", x0[::-1], processes=1)
    for value, other, mirrored in zip(alone, shared, backwards, strict=True):
        np.testing.assert_array_equal(other, value)
        np.testing.assert_array_equal(mirrored[::-1], value)


# --- waypoints --------------------------------------------------------------------------------------------------------

# env id: mean costs over the box without and with the circles, distances at the phases' ends without and with.
# The costs are means over the box (16 x 16 Gauss-Legendre points); the distances hardly depend on the start.
WAYPOINTS = {
    "DoubleIntegratorWaypoints-v0": ((16.747, 17.659), (0.075, 0.157), (0.02, 0.02), 0.91),
    "VanDerPolWaypoints-v0": ((17.019, 17.271), (0.0117, 0.0058, 0.118), (0.0117, 0.0055, 0.05), 0.25),
}


@pytest.mark.slow
@pytest.mark.parametrize("env_id", WAYPOINTS)
def test_waypoint_numbers(env_id):
    (cost_free, cost), distance_free, distance, extra = WAYPOINTS[env_id]
    x0, weights = over_the_box(6)
    optimum = reference(env_id, x0)
    assert weights @ optimum["cost_free"] == pytest.approx(cost_free, abs=0.02)
    assert weights @ optimum["cost"] == pytest.approx(cost, abs=0.02)
    np.testing.assert_allclose(optimum["cost"] - optimum["cost_free"], extra, atol=0.01)
    np.testing.assert_allclose(optimum["terminal_error_free"].mean(axis=0), distance_free, atol=1e-3)
    np.testing.assert_allclose(optimum["terminal_error"].mean(axis=0), distance, atol=1e-3)
    assert optimum["hit"].all() and optimum["constrained"].all() and not optimum["infeasible"].any()
    assert optimum["replay_error"].max() < 1e-8
    assert KEYS | {"constrained"} <= set(optimum)


@pytest.mark.parametrize("bonus, constrained", [(0.4, False), (0.5, True)])
def test_better_solution_is_chosen_with_its_bonus(new_problem, bonus, constrained):
    """Hitting both circles costs 0.912 more: two bonuses of 0.4 are not worth it, two of 0.5 are."""
    problem = PROBLEMS["DoubleIntegratorWaypoints-v0"]
    phases = tuple(replace(phase, bonus=bonus) for phase in problem.phases)
    env_id = new_problem(replace(problem, env_id=f"Bonus{bonus}-v0", phases=phases))
    optimum = reference(env_id, starts(3))
    assert (optimum["constrained"] == constrained).all() and (optimum["hit"] == constrained).all()
    np.testing.assert_allclose(optimum["cost"] - optimum["cost_free"], 0.912 if constrained else 0, rtol=0, atol=0.005)
    np.testing.assert_allclose(optimum["episodic_return"], 2 * bonus * constrained - optimum["cost"], rtol=1e-12)


@pytest.mark.parametrize("env_id, near, far", [
    ("DoubleIntegratorWaypoints-v0", [18.0, 0.0], [30.0, 0.0]),  # from rest 3 m/s^2 moves u T^2 / 4 = 18.75 in 5 s
    ("VanDerPolWaypoints-v0", [5.0, 0.0], [8.0, 0.0]),
])  # fmt: skip
def test_unreachable_circle_falls_back_to_the_free_optimum(env_id, near, far):
    optimum = reference(env_id, [near, far])
    assert optimum["constrained"].tolist() == [True, False] and optimum["infeasible"].tolist() == [False, True]
    assert optimum["hit"][0].all() and not optimum["hit"][1, 0]
    assert (optimum["circle_price"][0] > 0).any() and np.isnan(optimum["circle_price"][1]).all()
    assert optimum["cost"][0] > optimum["cost_free"][0] and optimum["cost"][1] == optimum["cost_free"][1]


@pytest.mark.slow
@pytest.mark.parametrize("env_id, phase", [
    ("DoubleIntegratorWaypoints-v0", 0),
    ("VanDerPolWaypoints-v0", -1),
])  # fmt: skip
def test_circle_price_is_what_a_wider_circle_saves(new_problem, env_id, phase):
    problem, change, cost, x0 = PROBLEMS[env_id], 1e-4, {}, starts(3)
    for sign in (-1, 1):
        phases = list(problem.phases)
        phases[phase] = replace(phases[phase], radius=phases[phase].radius + sign * change)
        like = replace(problem, env_id=f"Circle{abs(phase)}{sign}-{env_id}", phases=tuple(phases))
        cost[sign] = reference(new_problem(like), x0)["cost"]
    price = reference(env_id, x0)["circle_price"][:, phase]
    np.testing.assert_allclose(price, (cost[-1] - cost[1]) / (2 * change), rtol=1e-3, atol=1e-3)


# --- problems of a user's own -----------------------------------------------------------------------------------------


def pendulum(x, u):
    """About upright: x1' = x2, x2' = sin x1 + u."""
    return x[1], np.sin(x[0]) + u


def swing_up(env_id, seconds, u_max=0.3, **changes):
    """A pendulum too weak to be lifted at once: it must be swung up."""
    phase = Phase(steps=10 * seconds, target=(0.0, 0.0), radius=0.05, R=0.1, Qf=20.0, bonus=20.0)
    return Problem(env_id, pendulum, u_max, (phase,), x_max=(100.0, 50.0), x0_max=np.pi, **changes)


@pytest.fixture
def hard_start():
    """The eleventh of these starts."""
    return (np.random.default_rng(1).uniform(-1, 1, (20, 2)) * (np.pi, 1))[10:11]


@pytest.mark.slow
def test_best_of_several_guesses_swings_a_pendulum_up(new_problem, hard_start):
    """From one guess the pendulum ends elsewhere, at several times the cost; both are what the environment flies."""
    one = reference(new_problem(swing_up("OneGuess-v0", 15, single_optimum=True)), hard_start)
    best = reference(new_problem(swing_up("SeveralGuesses-v0", 15)), hard_start)
    assert best["cost"][0] < 0.5 * one["cost"][0]
    assert best["hit"].all() and np.abs(best["u"]).max() <= 0.3
    x, u = best["x"][0], best["u"][0]
    assert best["cost"][0] == pytest.approx((x[:-1] ** 2).sum() + 0.1 * (u**2).sum() + 20 * (x[-1] ** 2).sum())


@pytest.mark.slow
@pytest.mark.parametrize("built_in", ["VanDerPol-v0", "DoubleIntegratorWaypoints-v0"])
def test_single_optimum_is_a_promise_that_is_kept(new_problem, built_in):
    """More guesses find nothing better for the problems of the paper."""
    env_id = new_problem(replace(PROBLEMS[built_in], env_id=f"Again-{built_in}", single_optimum=False))
    count = lambda name: len(list(guesses(PROBLEMS[name], np.ones(2), np.zeros(0))))  # noqa: E731
    assert count(built_in) == 1 < count(env_id)
    x0 = np.vstack([starts(2), [[1.0, 1.0]]])
    _, one, feasible, _ = optimise(built_in, x0, in_circles=True)
    _, several, _, _ = optimise(env_id, x0, in_circles=True)
    assert feasible.all()
    np.testing.assert_allclose(several, one, rtol=1e-9)


def test_feedback_about_waypoints_is_the_optimum_where_it_does_not_saturate():
    x0 = starts(30)
    flight = fly("DoubleIntegratorWaypoints-v0", lqr_policy(PROBLEMS["DoubleIntegratorWaypoints-v0"]), x0)
    inside = np.abs(flight["u"]).max(axis=1) < 2.99
    assert 10 < inside.sum()
    cost = optimise("DoubleIntegratorWaypoints-v0", x0[inside])[1]
    np.testing.assert_allclose(flight["cost"][inside], cost, rtol=1e-9)


def test_feedback_about_a_target_that_is_not_at_rest(new_problem):
    """Linear dynamics that drift: x2' = 0.3 - 0.5 x1 + u about (0.4, 0.2)."""
    drifts = lambda x, u: (x[1], 0.3 - 0.5 * x[0] + u)  # noqa: E731
    phase = Phase(steps=40, target=(0.4, 0.2), radius=0.05, R=0.5, Qf=5.0, bonus=1.0, Q=(1.0, 0.2))
    env_id = new_problem(Problem("Drifts-v0", drifts, 50.0, (phase,), x_max=(50.0, 50.0)))
    x0 = starts(5)
    np.testing.assert_allclose(
        fly(env_id, lqr_policy(PROBLEMS[env_id]), x0)["cost"], optimise(env_id, x0)[1], rtol=1e-9
    )


def test_dynamics_that_are_not_analytic_are_linearised():
    """|v| v drag about (2, 1.5): v' = -v^2 + u there, so that over a step the exact v is v0 / (1 + v0 t)."""
    drag = replace(VAN_DER_POL, f=lambda x, u: (x[1], u - x[1] * np.abs(x[1])))
    A, _ = baselines.linearise(drag, (2.0, 1.5))
    assert A[1, 1] == pytest.approx(1 / (1 + 1.5 * 0.1) ** 2, abs=2e-5)
    assert A[1, 0] == 0 and A[0, 0] == pytest.approx(1, abs=1e-12)


# --- errors -----------------------------------------------------------------------------------------------------------


def test_solver_failure_names_the_start():
    with pytest.raises(RuntimeError, match=r"start 1, x0 = \[1000.0, 1000.0\], of VanDerPol-v0: IPOPT stopped with "):
        reference("VanDerPol-v0", [[0.1, 0.1], [1000.0, 1000.0]])


def test_replay_refuses_a_cost_that_is_not_flown():
    x0 = starts(4)
    u, cost, _, _ = optimise("VanDerPol-v0", x0)
    assert fly_solution("VanDerPol-v0", x0, u, cost * (1 + 1e-10))["replay_error"].max() < 1e-8
    wrong = cost.copy()
    wrong[2] *= 1 + 1e-7
    with pytest.raises(RuntimeError, match="start 2, .* of VanDerPol-v0: its optimum costs"):
        fly_solution("VanDerPol-v0", x0, u, wrong)
    with pytest.raises(RuntimeError, match="start 3, "):
        fly_solution("VanDerPol-v0", x0, u, np.where(np.arange(4) == 3, np.nan, cost))


def test_optimum_that_misses_its_circle_is_an_error(monkeypatch):
    def without_circles(env_id, x0, in_circles=False, draw=None):
        return optimise(env_id, x0)

    monkeypatch.setattr(baselines, "optimise", without_circles)
    with pytest.raises(RuntimeError, match="start 0, .* misses its circles"):
        reference("DoubleIntegratorWaypoints-v0", starts(2))


@pytest.mark.parametrize("env_id, x0, message", [
    ("Pendulum-v1", [[0.0, 0.0]], "env_id is 'Pendulum-v1'; it must be one of DoubleIntegrator-v0"),
    ("VanDerPol-v0", [0.0, 0.0], r"x0 must be finite, of shape \(n, 2\)"),
    ("VanDerPol-v0", np.zeros((0, 2)), r"x0 must be finite, of shape \(n, 2\)"),
    ("DoubleIntegrator-v0", [[0.0, np.nan]], r"x0 must be finite, of shape \(n, 2\)"),
])  # fmt: skip
def test_bad_arguments_are_refused(env_id, x0, message):
    with pytest.raises(ValueError, match=message):
        reference(env_id, x0)


def test_lqr_refuses_waypoints():
    with pytest.raises(ValueError, match="DoubleIntegratorWaypoints-v0 has 2 phases"):
        lqr(PROBLEMS["DoubleIntegratorWaypoints-v0"])


# --- command line -----------------------------------------------------------------------------------------------------


def run(folder, *arguments):
    command = [sys.executable, str(ROOT / "baselines.py"), *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=60)


@pytest.mark.slow
def test_command_writes_what_it_prints(tmp_path):
    name, env_id = "van-der-pol-waypoints", "VanDerPolWaypoints-v0"
    ended = run(tmp_path, name, "--starts", "0", "--json", "a.json")
    assert ended.returncode == 1 and ended.stderr.count("\n") == 1 and ended.stdout == ""
    assert not list(tmp_path.iterdir())
    ended = run(tmp_path, name, "--starts", "5", "--seed", "7", "--json", "a.json", "--npz", "a.npz")
    assert ended.returncode == 0 and ended.stderr == ""
    numbers = json.loads((tmp_path / "a.json").read_text())
    printed = dict(line.split() for line in ended.stdout.splitlines())
    assert numbers["env_id"] == env_id and printed.keys() == numbers.keys() and "circle_price_phase_3" in numbers
    assert all(isinstance(value, str | int | float) for value in numbers.values())
    assert float(printed["cost_mean"]) == pytest.approx(numbers["cost_mean"], rel=1e-6)
    with np.load(tmp_path / "a.npz") as arrays:
        assert set(arrays) == {"t", "x_reference", "u_reference", "cost_reference"}
        np.testing.assert_array_equal(arrays["x_reference"][:, 0], starts(5, seed=7))
        np.testing.assert_allclose(arrays["t"], 0.1 * np.arange(PROBLEMS[env_id].steps + 1))
        again = flown(env_id, starts(5, seed=7), arrays["u_reference"])
        np.testing.assert_array_equal(arrays["x_reference"], again["x"])
        np.testing.assert_array_equal(arrays["cost_reference"], again["cost"])
    assert numbers["cost_mean"] == pytest.approx(again["cost"].mean())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.json", "a.npz"]


@pytest.mark.parametrize("phases", [1, 2])
def test_command_of_a_problem_of_a_users_own(new_problem, capsys, phases):
    """Its id is a sub-command, its starts are from its own box, and it is compared like the paper's of its kind."""
    column = Phase(steps=20, target=(0.5, 0.0), radius=0.1, R=0.1, Qf=20.0, bonus=20.0)
    problem = Problem(f"Own{phases}-v0", double_integrator, 5.0, (column,) * phases, (200.0, 90.0), x0_max=2.0)
    args = baselines.parse_args([new_problem(problem), "--starts", "3", "--seed", "7"])
    args.solve(args)
    printed = dict(line.split() for line in capsys.readouterr().out.splitlines())
    assert printed["env_id"] == problem.env_id
    assert ("lqr_ratio_of_sums" if phases == 1 else "distance_phase_2") in printed
    x0 = np.random.default_rng(7).uniform(-2, 2, (3, 2))
    assert float(printed["cost_mean"]) == pytest.approx(reference(problem.env_id, x0)["cost"].mean(), rel=1e-6)


def test_a_table_may_hold_lists_and_arrays(new_problem):
    """Solved once, as a table of tuples is, under the id that it is registered by."""
    column = Phase(steps=20, target=[0.5, 0.0], radius=0.1, R=0.1, Qf=20.0, bonus=20.0)
    problem = Problem("Lists-v0", double_integrator, 5.0, [column], np.array([200.0, 90.0]))
    task, optima = task_of(new_problem(problem)), []
    for _ in range(2):
        optima.append(task.optimum(3, 4))
    assert optima[0] is optima[1] and optima[0]["x"].shape == (4, 21, 2)


def test_every_id_and_every_short_name_is_a_command():
    short = ["double-integrator", "van-der-pol", "double-integrator-waypoints", "van-der-pol-waypoints"]
    ids = ["DoubleIntegrator-v0", "VanDerPol-v0", "DoubleIntegratorWaypoints-v0", "VanDerPolWaypoints-v0"]
    solved = lambda names: [baselines.parse_args([name]).solve.__self__.env_id for name in names]  # noqa: E731
    assert solved(short) == ids and solved(env_ids()) == env_ids()
    assert baselines.parse_args(["rocket"]).json is None


@pytest.mark.parametrize("arguments, message", [
    (["pendulum"], "'pendulum' is no id here"),
    ([], "required: command"),
    (["van-der-pol", "--starts", "0"], "--starts: '0' must be a whole number from 1 to 100000"),
    (["van-der-pol", "--starts", "nan"], "--starts: 'nan' must be a whole number from 1 to 100000"),
    (["van-der-pol", "--seed", "-1"], "--seed: '-1' must be a whole number from 0 to 4294967295"),
    (["van-der-pol", "--npz", "missing/a.npz"], "--npz: 'missing/a.npz' must be a file in an existing"),
])  # fmt: skip
def test_bad_command_is_one_line(tmp_path, capsys, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        baselines.parse_args([*arguments, "--json", "a.json"] if arguments else [])
    assert ended.value.code.startswith("error: ") and message in ended.value.code
    assert "\n" not in ended.value.code and capsys.readouterr().err == "" and not list(tmp_path.iterdir())


def test_a_table_of_this_session_is_solved_here(monkeypatch):
    """No other process would know it, although its id may be asked to be shared out."""
    table = replace(VAN_DER_POL, env_id="OfThisSession-v0")
    monkeypatch.setitem(PROBLEMS, table.env_id, table)
    x0 = starts(4)
    shared = optimise(table.env_id, x0, processes=2)
    for mine, known in zip(shared, optimise("VanDerPol-v0", x0, processes=1)):
        np.testing.assert_array_equal(mine, known)
