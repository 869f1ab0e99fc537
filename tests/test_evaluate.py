"""evaluate.py against plain loops: ratios, the interface's keys, figures, results folders, bad input."""

import errno
import hashlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import figure_of, headline_of, table_of
from safetensors.numpy import save_file

import baselines
import envs
import evaluate
from common import files
from common.curves import evaluated, read_csv, read_curve, write_csv
from common.files import write_json, write_npz
from drawing import animation
from phased.metrics import cost_parts, near_origin_metrics, ratio_metrics

SINGLE, WAYPOINTS = "DoubleIntegrator-v0", "DoubleIntegratorWaypoints-v0"

# INTERFACE, "eval.json": all but what the script adds (seed, checkpoint_sha256, total_updates, ...)
COMMON = {"env_id", "eval_seed", "eval_starts", "episodic_return", "reference_episodic_return"}
RATIOS = {"ratio_of_sums", "ratio_mean", "ratio_median", "ratio_p95", "ratio_min", "ratio_max"}
TEN_STARTS = {"ten_start_ratio_mean_p05", "ten_start_ratio_mean_p50", "ten_start_ratio_mean_p95"}
NEAR = {"loss_near_origin_mean"}  # of single phases, where a start is near the origin
COSTS = {f"{side}cost{part}_mean" for side in ("", "reference_") for part in ("", "_state", "_control", "_terminal")}
HITS = {"hit_rate", "reference_hit_rate", "terminal_error_max", "hit_rate_phase_1"}

# the problems that `feedback` was written for, and the effort with which it hits their circles: low gains where only
# these make the linear law good enough
SOFT = {SINGLE: 1.0, WAYPOINTS: 1.0, "VanDerPol-v0": 1.0, "VanDerPolWaypoints-v0": 100.0}


def feedback(env_id, terminal_weight, effort=1.0):
    """A policy that steers to each phase's target: affine LQR of the dynamics linearised about the origin.

    The state is [x1, x2, 1]; a large `terminal_weight` ends close to the target. The environment clips.
    """
    problem = envs.PROBLEMS[env_id]
    h = 1e-6
    step = [envs.rk4(problem.f, (h * a, h * b), h * c, problem.dt) for a, b, c in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    A, B = np.eye(3), np.zeros((3, 1))
    A[:2, :2], B[:2, 0] = np.array(step[:2]).T / h, np.array(step[2]) / h
    P, gains = np.zeros((3, 3)), []
    for phase in problem.phases[::-1]:
        d = np.array([[1, 0, -phase.target[0]], [0, 1, -phase.target[1]]])  # distance to the target
        P = P + terminal_weight * d.T @ d
        for _ in range(phase.steps):
            K = np.linalg.solve(B.T @ P @ B + effort * phase.R, B.T @ P @ A)
            P = d.T @ d + A.T @ P @ (A - B @ K)
            gains.insert(0, K[0])
    return lambda obs, t: -(obs[:, :2] @ gains[t][:2] + gains[t][2])[:, None]


def lets_go(policy, mask, t_end):
    """The policy, but without control from step t_end on in the flights of `mask`, (n,) or one bool: they miss."""
    return lambda obs, t: policy(obs, t) * np.where(np.broadcast_to(mask, len(obs)) & (t >= t_end), 0.0, 1.0)[:, None]


def reference_flight(env_id, seed, n, misses=False):
    """A hand-made reference in the form of `baselines.reference`: a feedback that hits but in the flights `misses`."""
    policy = lets_go(feedback(env_id, 1e3, SOFT.get(env_id, 1.0)), misses, 90)
    return envs.fly(env_id, policy, baselines.starts(seed, n, envs.PROBLEMS[env_id].x0_max))


def make_run(folder, seed=1, env_id=SINGLE, level=0.0):
    """A synthetic run folder: events, checkpoint, eval.json, eval.npz; returns it."""
    from torch.utils.tensorboard import SummaryWriter

    folder.mkdir(parents=True)
    with SummaryWriter(folder) as writer:
        for update in range(1, 31):
            step = 4000 * update
            writer.add_scalar("charts/episodic_return", 14 - 30 * 0.8**update + level, step)
            writer.add_scalar("losses/policy_loss", -0.1 / update, step)
            writer.add_scalar("losses/total_loss", 5 / update, step)
            if update % 10 == 0:
                writer.add_scalar("eval/ratio_of_sums", 1 + 1 / update, step)
    (folder / "agent.safetensors").write_bytes(b"weights of seed %d" % seed)
    reference = reference_flight(env_id, 3, 12)
    metrics, arrays = evaluate.evaluate(env_id, feedback(env_id, 1e3, effort=1.5), 3, 12, reference)
    digest = hashlib.sha256((folder / "agent.safetensors").read_bytes()).hexdigest()
    write_json(folder / "eval.json", {**metrics, "seed": seed, "checkpoint_sha256": digest})
    write_npz(folder / "eval.npz", arrays)
    return folder


def snapshot(folder):
    """Every file below a folder with its bytes."""
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def command_line(monkeypatch, capsys, *words):
    """Run `python evaluate.py words...` in this process; returns what it printed, raises SystemExit as it does."""
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *map(str, words)])
    evaluate.main()
    return capsys.readouterr().out


# ---------------------------------------------------------------------------------------------------------------------
# Cases and ratios
# ---------------------------------------------------------------------------------------------------------------------


def test_starts_are_those_of_the_interface():
    assert np.array_equal(baselines.starts(7, 5), np.random.default_rng(7).uniform(-1, 1, (5, 2)))


@pytest.mark.parametrize("x0_max", [0.25, 3.0])
def test_starts_are_from_the_problems_own_box(new_problem, x0_max):
    """At the evaluation, and for the optimum that it is compared with."""
    env_id = new_problem(replace(envs.PROBLEMS[SINGLE], env_id=f"Box{x0_max}-v0", x0_max=x0_max, single_optimum=True))
    metrics, arrays = evaluate.evaluate(env_id, feedback(env_id, 20.0), 7, 12)
    x0 = np.random.default_rng(7).uniform(-x0_max, x0_max, (12, 2))
    assert np.array_equal(arrays["x"][:, 0], x0) and np.array_equal(arrays["x_reference"][:, 0], x0)
    assert metrics["ratio_min"] > 1 - 1e-9


def test_metrics_of_a_single_phase_equal_plain_loops():
    n = 30
    reference = reference_flight(SINGLE, 5, n)
    metrics, arrays = evaluate.evaluate(SINGLE, feedback(SINGLE, 0.0, effort=60.0), 5, n, reference)
    state, control, terminal, hits, errors = [], [], [], 0, []
    for x, u in zip(arrays["x"], arrays["u"]):  # the table's numbers: Q = I, R = 0.1, Qf = 20, radius 0.05
        state.append(sum(a * a + b * b for a, b in x[:-1]))
        control.append(sum(0.1 * v * v for v in u))
        terminal.append(20.0 * (x[-1][0] ** 2 + x[-1][1] ** 2))
        errors.append((x[-1][0] ** 2 + x[-1][1] ** 2) ** 0.5)
        hits += errors[-1] <= 0.05
    total = [sum(parts) for parts in zip(state, control, terminal)]
    ratios = sorted(ours / best for ours, best in zip(total, reference["cost"]))
    position = 0.95 * (n - 1)
    p95 = ratios[int(position)] + (position % 1) * (ratios[int(position) + 1] - ratios[int(position)])
    expected = {
        "cost_mean": sum(total) / n,
        "cost_state_mean": sum(state) / n,
        "cost_control_mean": sum(control) / n,
        "cost_terminal_mean": sum(terminal) / n,
        "reference_cost_mean": sum(reference["cost"]) / n,
        "reference_cost_control_mean": sum(0.1 * v * v for u in reference["u"] for v in u) / n,
        "ratio_of_sums": sum(total) / sum(reference["cost"]),
        "ratio_mean": sum(ratios) / n,
        "ratio_median": (ratios[14] + ratios[15]) / 2,
        "ratio_p95": p95,
        "ratio_min": ratios[0],
        "ratio_max": ratios[-1],
        "episodic_return": (20.0 * hits - sum(total)) / n,
        "reference_episodic_return": sum(map(sum, reference["reward"])) / n,
        "hit_rate": hits / n,
        "hit_rate_phase_1": hits / n,
        "reference_hit_rate": 1.0,
        "terminal_error_max": max(errors),
    }
    assert 0 < hits < n, "the case must tell hits from misses"
    assert {key: metrics[key] for key in expected} == pytest.approx(expected, rel=1e-12)
    assert cost_parts(envs.PROBLEMS[SINGLE], arrays["x"], arrays["u"]) == pytest.approx(np.c_[state, control, terminal])


def test_ten_start_statistic_is_the_papers():
    rng = np.random.default_rng(0)
    cost, optimum = rng.uniform(2, 3, (2, 40))
    gain = ratio_metrics(np.array([-8.0, -12.0]), np.array([-10.0, -12.0]), 0)  # of Goddard's rocket: less is worse
    assert gain["ratio_max"] == pytest.approx(1.2) and gain["ratio_of_sums"] == pytest.approx(1 + 2 / 22)
    metrics = ratio_metrics(cost, optimum, eval_seed=9)
    rng, means = np.random.default_rng([9, 1]), []
    for _ in range(100):
        drawn = rng.choice(40, 10, replace=False)
        assert len(set(drawn)) == 10
        means.append(sum(cost[i] / optimum[i] for i in drawn) / 10)
    means.sort()
    assert metrics["ten_start_ratio_mean_p05"] == pytest.approx(means[4] + 0.95 * (means[5] - means[4]), rel=1e-12)
    assert metrics["ten_start_ratio_mean_p50"] == pytest.approx((means[49] + means[50]) / 2, rel=1e-12)
    assert metrics["ten_start_ratio_mean_p95"] == pytest.approx(means[94] + 0.05 * (means[95] - means[94]), rel=1e-12)
    assert metrics == ratio_metrics(cost, optimum, eval_seed=9)
    assert metrics != ratio_metrics(cost, optimum, eval_seed=10)
    ten = ratio_metrics(cost[:10], optimum[:10], eval_seed=9)
    assert ten["ten_start_ratio_mean_p95"] == pytest.approx(ten["ratio_mean"])  # one way only to draw ten of ten
    assert ratio_metrics(cost[:9], optimum[:9], eval_seed=9).keys() == RATIOS


def test_loss_near_the_origin_by_hand():
    x0 = np.array([[0.0, 0.2], [0.12, -0.16], [0.15, 0.15], [-1.0, 0.0], [0.0, 0.0]])  # |x0| 0.2, 0.2, 0.21, 1, 0
    cost, optimum = np.array([0.5, 0.25, 9.0, 8.0, 0.0625]), np.array([0.25, 0.125, 1.0, 1.0, 0.0])
    expected = {"loss_near_origin_mean": (0.25 + 0.125 + 0.0625) / 3}
    assert near_origin_metrics(envs.PROBLEMS[SINGLE], x0, cost, optimum) == pytest.approx(expected, rel=1e-14)
    assert near_origin_metrics(envs.PROBLEMS["VanDerPol-v0"], x0, cost, optimum) == pytest.approx(expected, rel=1e-14)
    assert near_origin_metrics(envs.PROBLEMS[WAYPOINTS], x0, cost, optimum) == {}
    assert near_origin_metrics(envs.PROBLEMS[SINGLE], x0[2:4], cost[2:4], optimum[2:4]) == {}


def test_waypoint_ratios_are_over_the_starts_that_hit_every_circle():
    n = 24
    good = feedback(WAYPOINTS, 1e3, effort=1.3)

    # every third of ours lets go before the second circle, and every fourth optimum does not bother to hit
    policy = lets_go(good, np.arange(n) % 3 == 0, 90)
    reference = reference_flight(WAYPOINTS, 2, n, misses=np.arange(n) % 4 == 1)
    assert reference["hit"][:, 1].tolist() == [i % 4 != 1 for i in range(n)]
    metrics, arrays = evaluate.evaluate(WAYPOINTS, policy, 2, n, reference)
    ours = best = 0.0
    chosen, second = [], 0
    for i in range(n):
        first_hit = np.hypot(*arrays["x"][i, 50]) <= 0.02
        second_hit = np.hypot(*(arrays["x"][i, 100] - [0.5, 0.5])) <= 0.02
        second += second_hit
        assert first_hit and second_hit == (i % 3 != 0)
        if first_hit and second_hit and i % 4 != 1:
            chosen.append(i)
            ours, best = ours + arrays["cost"][i], best + reference["cost"][i]
    assert len(chosen) == 12
    assert metrics["ratio_of_sums"] == pytest.approx(ours / best, rel=1e-12)
    assert metrics["ratio_max"] == max(arrays["cost"][i] / reference["cost"][i] for i in chosen)
    assert metrics["hit_rate"] == metrics["hit_rate_phase_2"] == second / n
    assert metrics["hit_rate_phase_1"] == 1.0
    assert metrics["cost_mean"] == pytest.approx(sum(arrays["cost"]) / n, rel=1e-12)  # the means: all starts
    lines = table_of(metrics).splitlines()
    assert lines[2].split()[-1] == f"{metrics['ratio_of_sums']:.4f}"
    assert [line.split()[-1] for line in lines[3:6]] == ["-"] * 3  # no ratio of parts of different starts


@pytest.mark.parametrize("why", ["none hits", "no optimum hits"])
def test_waypoints_without_a_comparable_start_have_no_ratio(why):
    reference = reference_flight(WAYPOINTS, 2, 12, misses=why == "no optimum hits")
    policy = lets_go(feedback(WAYPOINTS, 1e3), why == "none hits", 0)
    metrics, arrays = evaluate.evaluate(WAYPOINTS, policy, 2, 12, reference)
    assert metrics.keys() == COMMON | COSTS | HITS | {"hit_rate_phase_2"}
    text = table_of(metrics)
    assert ("no start hit every circle" in text) == (why == "none hits")
    assert "No cost ratio" in text and "nan" not in text.lower()
    assert "no cost ratio" in headline_of(metrics)


@pytest.mark.parametrize("env_id", SOFT)
def test_keys_are_exactly_the_interfaces(env_id):
    reference = reference_flight(env_id, 5, 20)  # one start is near the origin
    metrics, _ = evaluate.evaluate(env_id, feedback(env_id, 1e3, 1.5 * SOFT[env_id]), 5, 20, reference)
    phases = len(envs.PROBLEMS[env_id].phases)
    extra = {f"hit_rate_phase_{k}" for k in range(2, phases + 1)} if phases > 1 else NEAR
    assert metrics.keys() == COMMON | RATIOS | TEN_STARTS | COSTS | HITS | extra


def test_arrays_hold_the_flight_and_not_the_next_episode():
    n, T = 12, 50
    reference = reference_flight(SINGLE, 4, n)
    metrics, arrays = evaluate.evaluate(SINGLE, lambda obs, t: -30 * obs[:, :1] - 9 * obs[:, 1:2], 4, n, reference)
    shapes = {"t": (T + 1,), "x": (n, T + 1, 2), "u": (n, T), "reward": (n, T), "cost": (n,)}
    shapes |= {"x_reference": (n, T + 1, 2), "u_reference": (n, T), "cost_reference": (n,)}
    assert {key: value.shape for key, value in arrays.items()} == shapes
    x, u = arrays["x"], arrays["u"]
    assert np.array_equal(x[:, 0], np.random.default_rng(4).uniform(-1, 1, (n, 2)))
    assert np.abs(u).max() == 4.0 < np.abs(30 * x[:, 0, 0] + 9 * x[:, 0, 1]).max()
    last = np.column_stack([x[:, -2, 0] + 0.1 * x[:, -2, 1] + 0.005 * u[:, -1], x[:, -2, 1] + 0.1 * u[:, -1]])
    np.testing.assert_allclose(x[:, -1], last, atol=1e-12)  # by the exact discretisation


def test_reference_of_other_starts_is_refused():
    with pytest.raises(ValueError, match="12 starts of eval_seed 1"):
        evaluate.evaluate(SINGLE, feedback(SINGLE, 20.0), 1, 12, reference_flight(SINGLE, 2, 12))
    with pytest.raises(ValueError, match="12 starts of eval_seed 1"):
        evaluate.evaluate(SINGLE, feedback(SINGLE, 20.0), 1, 12, reference_flight(SINGLE, 1, 13))


def test_missing_reference_is_solved_and_options_reach_the_environment(monkeypatch):
    asked, seen = [], []

    def solve(env_id, x0, draw):
        asked.append((env_id, x0))
        return reference_flight(SINGLE, 6, 10)

    def policy(obs, t):
        seen.append(obs[0, 2])
        return np.zeros((len(obs), 1))

    monkeypatch.setattr(baselines, "reference", solve)
    evaluate.evaluate(SINGLE, policy, 6, 10, observe_phase=False)
    assert asked[0][0] == SINGLE and np.array_equal(asked[0][1], baselines.starts(6, 10))
    assert set(seen) == {0.0}


# ---------------------------------------------------------------------------------------------------------------------
# Table and files
# ---------------------------------------------------------------------------------------------------------------------


def test_table_shows_optimum_ours_and_ratio():
    metrics, _ = evaluate.evaluate(SINGLE, feedback(SINGLE, 20.0, 2.0), 5, 20, reference_flight(SINGLE, 5, 20))
    lines = table_of(metrics).splitlines()
    assert lines[1].split() == ["optimum", "ours", "ratio"]
    for label, part in (("cost J (mean of 20 starts)", "cost"), ("of it: control", "cost_control")):
        (line,) = (line for line in lines if label in line)
        optimum, ours = metrics[f"reference_{part}_mean"], metrics[f"{part}_mean"]
        assert line.split()[-3:] == [f"{optimum:.4f}", f"{ours:.4f}", f"{ours / optimum:.4f}"]
    text = "\n".join(lines)
    for key in RATIOS | TEN_STARTS | NEAR:
        assert f"{metrics[key]:.4f}" in text, key


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), np.float64("nan")])
def test_json_refuses_what_is_not_finite_and_keeps_the_old_file(bad, tmp_path):
    path = tmp_path / "eval.json"
    write_json(path, {"seed": np.int64(1), "ratio_of_sums": np.float64(1.5)})
    assert json.loads(path.read_text()) == {"seed": 1, "ratio_of_sums": 1.5}
    before = snapshot(tmp_path)
    with pytest.raises(ValueError, match="ratio_mean is"):
        write_json(path, {"seed": 2, "ratio_mean": bad})
    with pytest.raises(ValueError, match="laws is .*; eval.json holds finite"):
        write_json(path, {"seed": 2, "laws": {"replay": {"share": float(bad)}}})
    assert snapshot(tmp_path) == before


def test_failing_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "eval.npz"
    write_npz(path, {"x": np.arange(3)})
    before = snapshot(tmp_path)

    def break_off(file, **arrays):
        file.write(b"half")
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "savez_compressed", break_off)
    with pytest.raises(OSError, match="no space left"):
        write_npz(path, {"x": np.arange(4)})
    assert snapshot(tmp_path) == before
    with pytest.raises(OSError):
        write_json(tmp_path / "no such folder" / "eval.json", {})


def test_curve_of_a_resumed_run_keeps_the_last_value(tmp_path):
    from torch.utils.tensorboard import SummaryWriter

    for shift, steps in ((0.0, (100, 200, 300)), (0.5, (300, 400))):  # stopped after 300, resumed from 200
        with SummaryWriter(tmp_path, filename_suffix=f".{shift}") as writer:
            for step in steps:
                writer.add_scalar("losses/policy_loss", step / 3 + shift, step)
            writer.add_scalar("eval/ratio_mean", 1.0 + shift, steps[-1])
    (resumed,) = tmp_path.glob("*.0.5")
    resumed.rename(tmp_path / "events.out.tfevents.0")  # its name comes first
    curve = read_curve(tmp_path)
    steps, values = curve["losses/policy_loss"]
    assert steps.tolist() == [100, 200, 300, 400]
    assert values == pytest.approx([100 / 3, 200 / 3, 100.5, 400 / 3 + 0.5], rel=1e-6)
    path = tmp_path / "1.csv"
    write_csv(path, curve)
    head, *rows = path.read_text().splitlines()
    assert head == "global_step,losses/policy_loss,eval/ratio_mean" and rows[2] == "300,100.5,1"
    again = read_csv(path)
    for tag, (steps, values) in curve.items():
        assert np.array_equal(again[tag][0], steps)
        assert again[tag][1] == pytest.approx(values, rel=5e-6)
    short = evaluated(curve)
    assert short["losses/policy_loss"][0].tolist() == [300, 400] == short["eval/ratio_mean"][0].tolist()
    assert short["losses/policy_loss"][1].tolist() == curve["losses/policy_loss"][1][2:].tolist()
    for text in ("step,loss\n1,2\n", "global_step,loss\n1\n", ""):
        path.write_text(text)
        with pytest.raises(ValueError, match="not a training curve"):
            read_csv(path)


# ---------------------------------------------------------------------------------------------------------------------
# Figures
# ---------------------------------------------------------------------------------------------------------------------


def test_figures_show_policy_optimum_targets_and_bounds():
    reference = reference_flight(WAYPOINTS, 3, 12)
    metrics, arrays = evaluate.evaluate(WAYPOINTS, feedback(WAYPOINTS, 1e3, effort=2.0), 3, 12, reference)
    plane, position, velocity, control = figure_of("trajectories.png", arrays, metrics).axes
    assert [(patch.center, patch.radius) for patch in plane.patches] == [((0.0, 0.0), 0.02), ((0.5, 0.5), 0.02)]
    for colour, suffix in (("tab:red", ""), ("tab:blue", "_reference")):
        drawn = [line.get_ydata() for line in position.lines if line.get_color() == colour]
        assert np.array_equal(drawn, arrays[f"x{suffix}"][:10, :, 0])
    assert any(np.array_equal(line.get_xdata(), [5.0, 5.0]) for line in control.lines), "the end of phase 1"
    assert {line.get_ydata()[0] for line in control.lines if line.get_linestyle() == "--"} == {-3.0, 3.0}


def test_costs_figure_shows_the_parts_and_marks_misses():
    policy = lets_go(feedback(WAYPOINTS, 1e3, effort=1.3), np.arange(12) == 2, 90)
    reference = reference_flight(WAYPOINTS, 3, 12, misses=np.arange(12) == 4)
    metrics, arrays = evaluate.evaluate(WAYPOINTS, policy, 3, 12, reference)
    panels = {ax.get_ylabel(): ax for ax in figure_of("costs.png", arrays, metrics).axes}
    flown = envs.fly(WAYPOINTS, policy, baselines.starts(3, 12))
    for name in ("state", "control", "terminal"):
        heights = [bar.get_height() for bar in panels[f"{name} cost"].patches]
        assert heights == pytest.approx([*flown[f"cost_{name}"][:10], *reference[f"cost_{name}"][:10]])
    labels = [text.get_text() for text in panels["total cost J"].texts]
    expected = [f"{a / b:.3f}" for a, b in zip(arrays["cost"][:10], arrays["cost_reference"][:10])]
    assert labels == [*expected[:2], "miss", expected[3], "miss", *expected[5:]]


# ---------------------------------------------------------------------------------------------------------------------
# Results folders
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_publish_ships_the_first_seed_and_adds_the_second(tmp_path, monkeypatch, capsys):
    first, second = make_run(tmp_path / "a", seed=1), make_run(tmp_path / "b", seed=2, level=-1.0)
    results = tmp_path / "results" / "di"
    monkeypatch.setattr(animation, "FRAMES", 3)
    printed = command_line(monkeypatch, capsys, "publish", first, results)
    assert "ratio" in printed and SINGLE in printed
    names = {"agent.safetensors", "eval.json", "eval.npz", "seeds/1.json", "seeds/1.csv"}
    names |= {f"figures/{name}.png" for name in ("training", "trajectories", "costs", "cost_error")}
    names.add("figures/animation.gif")
    files = snapshot(results)
    assert {str(name) for name in files} == names
    for name in ("agent.safetensors", "eval.json", "eval.npz"):
        assert files[Path(name)] == (first / name).read_bytes()
    assert files[Path("seeds/1.json")] == files[Path("eval.json")]
    steps, returns = read_csv(results / "seeds" / "1.csv")["charts/episodic_return"]
    assert steps.tolist() == [4000 * update for update in range(1, 31)]
    assert returns == pytest.approx([14 - 30 * 0.8**update for update in range(1, 31)], rel=5e-6)

    command_line(monkeypatch, capsys, "publish", second, results)
    after = snapshot(results)
    assert {str(name) for name in after} == names | {"seeds/2.json", "seeds/2.csv"}
    assert {name: after[name] for name in files} == files
    printed = command_line(monkeypatch, capsys, "figures", results)
    (row,) = (line for line in printed.splitlines() if line.startswith("  ratio of sums") and len(line.split()) == 8)
    one, two, median, lowest, highest = map(float, row.split()[3:])
    assert (lowest, highest) == (min(one, two), max(one, two)) and median == pytest.approx((one + two) / 2, abs=1e-4)
    assert snapshot(results)[Path("figures/training.png")] != files[Path("figures/training.png")]


def test_a_results_folder_keeps_the_first_thirty_starts(tmp_path, monkeypatch):
    """Drawn of all, kept of some."""
    run, drawn = make_run(tmp_path / "a", seed=1), []
    with np.load(run / "eval.npz") as file:
        arrays = {key: file[key] for key in file.files}
    many = {key: a if key == "t" else np.repeat(a, 150 // len(a) + 1, axis=0)[:150] for key, a in arrays.items()}
    np.savez(run / "eval.npz", **many)
    monkeypatch.setattr(evaluate, "redraw", lambda folder: drawn.append(len(np.load(folder / "eval.npz")["x"])))
    monkeypatch.setattr(evaluate, "animate", lambda folder: None)
    evaluate.publish(run, tmp_path / "results")
    with np.load(tmp_path / "results" / "eval.npz") as kept:
        assert drawn == [150] and kept.files == list(many)
        for key, array in many.items():
            np.testing.assert_array_equal(kept[key], array if key == "t" else array[:30])


def test_numbers_alone_keep_the_curve_of_the_evaluations(tmp_path):
    evaluate.publish(make_run(tmp_path / "run"), tmp_path / "results", numbers=True)
    curve = read_csv(tmp_path / "results" / "seeds" / "1.csv")
    assert curve["charts/episodic_return"][0].tolist() == [40_000, 80_000, 120_000]


def with_args(run, **args):
    """The run, whose policy says that it was trained with these arguments."""
    metadata = {"env_id": SINGLE, "args": json.dumps({"env_id": SINGLE, "total_updates": 10, **args})}
    save_file({"weight": np.zeros(1, np.float32)}, run / "agent.safetensors", metadata)
    metrics = json.loads((run / "eval.json").read_text())
    digest = hashlib.sha256((run / "agent.safetensors").read_bytes()).hexdigest()
    write_json(run / "eval.json", {**metrics, "checkpoint_sha256": digest})
    return run


def test_a_folder_has_runs_of_one_recipe_and_each_seed_once(tmp_path, monkeypatch):
    for name in ("redraw", "animate"):
        monkeypatch.setattr(evaluate, name, lambda folder: [])
    results = tmp_path / "results"
    first = {"recipe": "ours", "num_blocks": 2, "seed": 1, "num_threads": 1, "log_std": "0:-1 0.5:-1 0.5:-3 1:-3"}
    evaluate.publish(with_args(make_run(tmp_path / "1", 1), **first), results)

    own = {"seed": 2, "num_threads": 4, "exp_name": "my run", "log_std": "0:-1 0.5:-1 0.501:-3 1:-3", "track": True}
    second = with_args(make_run(tmp_path / "2", 2), **{**first, **own})
    evaluate.publish(second, results)
    before = snapshot(results)
    other = with_args(make_run(tmp_path / "3", 3), **first)
    refused = {"recipe": "paper", "num_blocks": 3, "log_std": "0:-1 0.3:-1 0.3:-3 1:-3"}
    for name, value in refused.items():
        with pytest.raises(ValueError, match=f"^{name} of .*3 is {value}; it must be {first[name]}, as in .*results"):
            evaluate.publish(with_args(other, **{**first, name: value}), results)
    with_args(other, **first)
    metrics = json.loads((other / "eval.json").read_text())
    write_json(other / "eval.json", {**metrics, "eval_starts": 13})
    with pytest.raises(ValueError, match="^eval_starts of .*3 is 13; it must be 12, as in .*results"):
        evaluate.publish(other, results)

    again = with_args(make_run(tmp_path / "again", 2), **first, level=1)
    with pytest.raises(ValueError, match="already has seed 2; --replace replaces it"):
        evaluate.publish(again, results)
    assert snapshot(results) == before
    evaluate.publish(again, results, replace=True)
    assert (results / "seeds" / "2.json").read_bytes() == (again / "eval.json").read_bytes()
    assert (results / "eval.json").read_bytes() == before[Path("eval.json")]


def test_seeds_alone_say_of_which_problem_a_folder_is(tmp_path):
    run, other = make_run(tmp_path / "a", seed=1), tmp_path / "results" / "seeds" / "2.json"
    other.parent.mkdir(parents=True)
    other.write_text(json.dumps({"env_id": "VanDerPol-v0", "seed": 2}))
    with pytest.raises(ValueError, match="it must be VanDerPol-v0, as in .*2.json"):
        evaluate.publish(run, tmp_path / "results", numbers=True)
    assert [path.name for path in other.parent.iterdir()] == ["2.json"]


def test_shipping_another_seed_replaces_all_or_nothing(tmp_path, monkeypatch, capsys):
    first, second = make_run(tmp_path / "a", seed=1), make_run(tmp_path / "b", seed=2)
    results = tmp_path / "results" / "di"

    def draw(name):  # a stand-in for redraw and animate that shows of which policy it is
        def drawn(folder):
            (folder / "figures").mkdir(exist_ok=True)
            (folder / "figures" / name).write_bytes((folder / "agent.safetensors").read_bytes())

        return drawn

    for function, name in (("redraw", "training.png"), ("animate", "animation.gif")):
        monkeypatch.setattr(evaluate, function, draw(name))
    command_line(monkeypatch, capsys, "publish", first, results)
    before = snapshot(results)
    with monkeypatch.context() as patch:
        patch.setattr(evaluate, "animate", full_disk)
        with pytest.raises(SystemExit, match="No space left"):
            command_line(monkeypatch, capsys, "publish", second, results, "--ship")
    assert snapshot(results) == before
    (results / "opponents.json").write_text("of seed 1")
    with monkeypatch.context() as patch:
        write = files.write_bytes
        patch.setattr(
            evaluate, "write_bytes", lambda path, data: (full_disk if results in path.parents else write)(path, data)
        )
        with pytest.raises(SystemExit, match="No space left"):
            command_line(monkeypatch, capsys, "publish", second, results, "--ship")
    assert (results / "opponents.json").exists()
    command_line(monkeypatch, capsys, "publish", second, results, "--ship")
    assert not (results / "opponents.json").exists()
    for name in ("agent.safetensors", "figures/training.png", "figures/animation.gif"):
        assert (results / name).read_bytes() == b"weights of seed 2"
    assert json.loads((results / "eval.json").read_text())["seed"] == 2


def test_a_seed_is_listed_once_the_rest_is_there(tmp_path, monkeypatch, capsys):
    """`run_seeds.py` takes seeds/<seed>.json as the sign that a run is published."""
    run, results, written = make_run(tmp_path / "run", seed=1), tmp_path / "results", []
    for name in ("redraw", "animate"):
        monkeypatch.setattr(evaluate, name, lambda folder: [])
    write = files.write_bytes
    monkeypatch.setattr(evaluate, "write_bytes", lambda path, data: [written.append(Path(path)), write(path, data)])
    command_line(monkeypatch, capsys, "publish", run, results)
    assert written[-1] == results / "seeds" / "1.json"
    assert {path.name for path in written if results in path.parents} == {"1.csv", "1.json", *SHIPPED}


SHIPPED = ("agent.safetensors", "eval.npz", "eval.json")


def full_disk(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


def spoil(run, fault):
    """Damage a run folder in one way."""
    if fault == "unfinished":
        (run / "eval.json").unlink()
        (run / "training_state.pt").touch()
    elif fault == "no events":
        for path in run.glob("events*"):
            path.unlink()
    elif fault in ("agent.safetensors", "eval.json", "eval.npz"):
        (run / fault).unlink()
    elif fault == "a bit of the npz":
        data = bytearray((run / "eval.npz").read_bytes())
        data[len(data) // 2] ^= 1
        (run / "eval.npz").write_bytes(data)
    elif fault == "no table":
        metrics = json.loads((run / "eval.json").read_text())
        del metrics["reference_cost_mean"]
        (run / "eval.json").write_text(json.dumps(metrics))
    elif fault == "truncated npz":
        (run / "eval.npz").write_bytes((run / "eval.npz").read_bytes()[:200])
    elif fault == "broken json":
        (run / "eval.json").write_text('{"env_id": ')
    elif fault == "other weights":
        (run / "agent.safetensors").write_bytes(b"other")
    else:
        metrics = json.loads((run / "eval.json").read_text())
        changes = {"other env": {"env_id": "VanDerPol-v0"}, "unknown env": {"env_id": "Pendulum-v1"}}
        metrics |= changes.get(fault, {"seed": "../1"})
        (run / "eval.json").write_text(json.dumps(metrics))


FAULTS = {
    "agent.safetensors": "agent.safetensors",
    "eval.json": "eval.json is not there",
    "unfinished": "eval.json is not there; the training has not ended: go on with --resume",
    "eval.npz": "eval.npz",
    "no events": "no TensorBoard scalars",
    "truncated npz": "not a readable .npz",
    "a bit of the npz": "not a readable .npz",
    "no table": "lacks a number of its table",
    "broken json": "not readable JSON",
    "other weights": "checkpoint_sha256",
    "other env": "VanDerPol-v0",
    "unknown env": "it must be one of",
    "bad seed": "seed is '../1'",
    "shipped seed": "--ship",
}


def test_refused_publishing_leaves_the_folder_untouched(tmp_path, monkeypatch, capsys):
    results = tmp_path / "results"
    good = make_run(tmp_path / "good", seed=1)
    for name in ("redraw", "animate"):  # drawing is tested above
        monkeypatch.setattr(evaluate, name, lambda folder: [])
    command_line(monkeypatch, capsys, "publish", good, results)
    before = snapshot(results)
    for fault, message in FAULTS.items():
        run = tmp_path / fault
        run.mkdir()
        for path in good.iterdir():
            (run / path.name).write_bytes(path.read_bytes())
        if fault != "shipped seed":
            metrics = json.loads((run / "eval.json").read_text())
            (run / "eval.json").write_text(json.dumps({**metrics, "seed": 2}))
            spoil(run, fault)
        with pytest.raises(SystemExit) as refusal:
            command_line(monkeypatch, capsys, "publish", run, results)
        assert message in str(refusal.value) and "\n" not in str(refusal.value), fault
        assert snapshot(results) == before, fault
    with pytest.raises(SystemExit, match="eval.json"):
        command_line(monkeypatch, capsys, "publish", tmp_path / "eval.json", tmp_path / "new")
    assert not (tmp_path / "new").exists()
