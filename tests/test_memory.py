"""`benchmarks.attention` and `benchmarks.memory`: the weights against the network's own output, the tables."""

import dataclasses
import json
import shlex
import sys
from pathlib import Path
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
import torch
from matplotlib.image import imread

import baselines
import envs
import evaluate
import ppo_gtrxl_di as script
import runs
from benchmarks import attention, memory, run_seeds
from common.flags import plain_args
from common.schedule import Schedule

ROOT = Path(__file__).parent.parent
torch.set_num_threads(1)


@torch.no_grad()
@pytest.mark.parametrize("L", [0, 5, 40])
def test_weights_are_the_networks(L):
    """Put to work on the values, they give what the attention itself gives; before the start stands the memory."""
    args = script.Args(embed_dim=8, num_heads=2, mlp_dim=8, hidden_dim=8, num_blocks=2, memory_length=L)
    torch.manual_seed(1)
    agent = script.Agent(args, gym.make_vec(args.env_id, num_envs=1)).double()
    for block in agent.blocks:
        block.attention.R.normal_()
    obs = np.random.default_rng(0).uniform(-3, 3, (23, 3))
    found = attention.weights(agent, obs)
    assert found.shape == (2, 2, 23, L + 1)
    np.testing.assert_allclose(found.sum(axis=-1), 1.0, rtol=1e-12)
    assert L == 0 or found.std(axis=-1).mean() > 0.01
    passes = []
    for block in agent.blocks:
        block.attention.register_forward_hook(lambda _, given, out: passes.append((*given, out)))
    agent.encode(torch.as_tensor(obs)[None], agent.new_memory(1, noise=0.0))
    for block, (x, before, out), weights in zip(agent.blocks, passes, found):
        values = block.attention.value(torch.cat([before[0], x[0]])).unflatten(-1, (2, 4)).numpy()
        attended = np.zeros((23, 2, 4))
        for i in range(23):
            for back in range(L + 1):
                attended[i] += weights[:, i, back, None] * values[L + i - back]
        expected = attended.reshape(23, 8) @ block.attention.out.weight.numpy().T
        np.testing.assert_allclose(out[0].numpy(), expected, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name, heads", [("vdp_waypoints", 6), ("rocket_cutoff", 8)])
def test_attention_of_a_shipped_policy(name, heads, tmp_path, monkeypatch, capsys):
    path = tmp_path / "attention.png"
    monkeypatch.setattr(sys, "argv", ["attention.py", str(ROOT / "results" / name), str(path)])
    attention.main()
    printed = capsys.readouterr().out
    assert printed.count("head") == heads and imread(path).std() > 0.05


def test_the_flight_begins_with_the_evaluations_first_start(new_problem):
    """Of a problem whose starts are of another box than the paper's."""
    env_id = new_problem(dataclasses.replace(envs.DOUBLE_INTEGRATOR, env_id="WideBox-v0", x0_max=2.5))
    args, resting = script.Args(env_id=env_id), mock.Mock()
    resting.make_policy.return_value = lambda obs, t: np.zeros((1, 1))
    obs, t, _ = attention.observations(resting, args, {})
    _, flight = evaluate.evaluate(env_id, lambda obs, t: np.zeros((len(obs), 1)), 0, 10)
    np.testing.assert_allclose(obs[:, :2], flight["x"][0, :-1])
    assert len(t) == len(obs) == 50 and np.abs(obs[0, :2]).max() < 2.5


def evaluations(folder, values):
    for seed, value in enumerate(values, start=1):
        (folder / "seeds").mkdir(parents=True, exist_ok=True)
        metrics = {"env_id": "DoubleIntegrator-v0", "seed": seed, "ratio_of_sums": value, "hit_rate": 1.0}
        (folder / "seeds" / f"{seed}.json").write_text(json.dumps(metrics))


def test_table_and_figure_of_what_is_there(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "results" / "memory"
    evaluations(folder / "hidden_velocity" / "memory_4", [1.5, 1.25, 3.0])
    evaluations(folder / "hidden_velocity" / "shown_memory_0", [1.005])
    monkeypatch.setattr(sys, "argv", ["memory.py", str(folder)])
    memory.main()
    title, header, *rows = capsys.readouterr().out.splitlines()
    assert "velocity hidden" in title and header.split()[:2] == ["seeds", "ratio"]
    assert rows[0].split("  ")[1:] and "L_mem 4" in rows[0] and "1.5 (1.25 to 3)" in rows[0] and " 3 " in rows[0]
    assert "velocity shown" in rows[1] and "1.005" in rows[1] and "-" in rows[1]
    assert rows[2].split() == ["limit", "for", "any", "memory", "1.10", "-", "-"] and len(rows) == 3
    assert imread(folder / "memory.png").std() > 0.05


def test_a_cell_says_of_how_many_seeds_it_is():
    """Where no start hit every circle there is no ratio."""
    runs = [{"hit_rate": 1.0, "ratio_of_sums": 1.05}, {"hit_rate": 0.0}, {"hit_rate": 0.0}]
    assert memory.cell_of(runs, "ratio_of_sums") == "1.05, 1 of 3"
    assert memory.cell_of(runs, "hit_rate") == "0 (0 to 1)" and memory.cell_of(runs[1:], "ratio_of_sums") == "-"


def test_what_no_memory_can_beat_is_the_best_of_first_actions_that_see_the_position_alone():
    """Against the costs to go of the states that other first actions lead to, the bound on u left out."""
    problem = envs.DOUBLE_INTEGRATOR
    (_, P), x0 = baselines.lqr(problem), baselines.starts(0, 1000)
    (A, B), (phase,) = baselines.linearise(problem), problem.phases
    ratios = []
    for gain in np.linspace(0.0, 6.0, 601):
        u = -gain * x0[:, 0]
        x1 = x0 @ A.T + u[:, None] @ B.T
        total = (x0**2) @ phase.Q + phase.R * u**2 + np.einsum("ni,ij,nj->n", x1, P[1], x1)
        ratios.append(total.sum() / np.einsum("ni,ij,nj->n", x0, P[0], x0).sum())
    assert memory.velocity_from_the_second_step()["ratio_of_sums"] == pytest.approx(min(ratios), abs=2e-3)
    assert min(ratios) < ratios[0] - 0.04  # the first action matters


def test_the_heaviest_weight_is_on_an_earlier_step_of_the_flight():
    found = np.array([[0.1, 0.0, 0.9], [0.2, 0.5, 0.3], [0.6, 0.1, 0.3]])  # the first step: 0.9 on what lies before it
    assert attention.heaviest(found) == (0.5, 1, 0)
    assert attention.heaviest(np.ones((3, 1)))[0] == 0.0


def test_every_row_of_the_tables_has_its_three_jobs(monkeypatch):
    """The seeds that are published, by the command of the shipped row with what the row says changed."""
    monkeypatch.chdir(ROOT)  # other shipped commands name the shipped policy
    jobs = run_seeds.read_trainings(ROOT / "benchmarks" / "trainings" / "memory_di.txt")
    shipped = run_seeds.read_trainings(ROOT / "benchmarks" / "trainings" / "results.txt")
    shipped = {(job.results.name, job.args["seed"]): job.args for job in shipped}
    found = 0
    for name, result, observed in (
        ("hidden_velocity", "di", "observe_velocity"),
        ("hidden_phase", "di_waypoints", "observe_phase"),
    ):
        rows = set(memory.EXPERIMENTS[name].rows)
        assert f"../../{result}" in rows
        for row in rows - {f"../../{result}"}:
            mine = [job for job in jobs if job.results == Path(f"results/memory/{name}/{row}")]
            published = (ROOT / "results" / "memory" / name / row / "seeds").glob("*.json")
            assert [job.args["seed"] for job in mine] == sorted(int(path.stem) for path in published), (name, row)
            expected = {"memory_length": int(row.rpartition("_")[2]), observed: row.startswith("shown")}
            for job in mine:
                assert job.args == {**shipped[result, job.args["seed"]], **expected}, shlex.join(job.command)
            found += len(mine)
    assert found == len(jobs)


CHANGED = {
    "memory_0": {"memory_length": 0},
    "memory_1": {"memory_length": 1},
    "mlp": {"num_blocks": 0, "embed_dim": 192, "hidden_dim": 192},
    "no_blocks": {"num_blocks": 0},
}


SHIPPED = {"nominal": "results/rocket_cutoff", "rocket": "results/rocket_dispersed"}  # beside results/memory/<this>


@pytest.fixture
def rocket_jobs(monkeypatch):
    """The jobs of a list in benchmarks/. For a policy of results/memory the shipped one stands in."""
    monkeypatch.chdir(ROOT)  # the shipped commands name the shipped policy
    read_policy = runs.read_policy

    def read(path, *rest):
        if Path(path).is_file():
            return read_policy(path, *rest)
        kind, row = Path(path).parts[-3:-1]
        saved, decided = read_policy(f"{SHIPPED[kind]}/agent.safetensors", *rest)
        return saved, decided | CHANGED[row]

    monkeypatch.setattr(runs, "read_policy", read)
    return lambda name: run_seeds.read_trainings(ROOT / "benchmarks" / "trainings" / name)


def test_the_rockets_rows_are_the_shipped_commands_but_for_what_they_say(rocket_jobs):
    """L_mem 32 is the front page's result, so each other row has to be its command with one thing changed."""
    shipped = {(job.results.name, job.args["seed"]): job.args for job in rocket_jobs("results.txt")}
    nominal = rocket_jobs("memory_nominal.txt")
    dispersed = rocket_jobs("memory_rocket.txt")
    assert [job.args["seed"] for job in nominal + dispersed] == [1] * 8
    for result, experiment, jobs in (("rocket_cutoff", "nominal", nominal), ("rocket_dispersed", "rocket", dispersed)):
        rows = set(memory.EXPERIMENTS[experiment].rows)
        assert rows == {f"../../{result}", *CHANGED} and {job.results.name for job in jobs} == set(CHANGED)
        for job in jobs:
            theirs = shipped[result, job.args["seed"]]
            different = {key: value for key, value in job.args.items() if value != theirs[key] and key != "checkpoint"}
            assert different == CHANGED[job.results.name], shlex.join(job.command)


def test_rows_with_failures_are_the_shipped_command_but_for_what_they_say(rocket_jobs):
    shipped = [job.args for job in rocket_jobs("results.txt") if job.results.name == "rocket_failures"]
    assert [args["seed"] for args in shipped] == [1, 2, 3]
    rows = {
        "memory_0": {"num_blocks": 2, "memory_length": 0},
        "memory_32": {"num_blocks": 2},
        "mlp": {"embed_dim": 192, "hidden_dim": 192},
    }
    jobs = rocket_jobs("memory_failures.txt")
    assert [(job.results.name, job.args["seed"]) for job in jobs] == [(row, seed) for row in rows for seed in (1, 2)]
    assert set(memory.EXPERIMENTS["failures"].rows) == {"../../rocket_failures", *rows}
    for job in jobs:
        theirs = shipped[job.args["seed"] - 1]
        different = {name: value for name, value in job.args.items() if value != theirs[name]}
        different.pop("checkpoint", None)
        assert different == rows[job.results.name], shlex.join(job.command)


def test_rows_with_noise_are_the_shipped_command_but_for_what_they_say(rocket_jobs):
    (shipped, *_) = (job.args for job in rocket_jobs("results.txt") if job.results.name == "rocket_dispersed")
    without, own = rocket_jobs("memory_navigation.txt")
    for job, expected in ((without, CHANGED["memory_0"]), (own, {})):
        different = {name: value for name, value in job.args.items() if value != shipped[name]}
        different.pop("checkpoint", None)
        assert different == expected | {"navigation_noise": [10.0, 0.1]}, shlex.join(job.command)
    assert own.args["checkpoint"] == "results/rocket_dispersed/agent.safetensors"


ADDITIONS = {
    "noise_learned": {"log_std"},
    "rate_constant": {"lr_times_std"},
    "rate_linear": {"lr_times_std", "learning_rate"},
    "no_groups": {"flights_per_start"},
    "memory_noise_stays": {"memory_noise"},
    "last_weights": {"weight_average"},
    "no_kl_limit": {"target_kl"},
    "lambda_stays": {"gae_lambda"},
    "discounted": {"gamma"},
    "rewards_unscaled": {"reward_scale"},
}


def test_the_ablation_is_the_shipped_command_with_one_addition_off():
    """Three seeds of each row. What is off has the value of the paper's recipe, but for a rate that falls."""
    shipped = run_seeds.read_trainings(ROOT / "benchmarks" / "trainings" / "results.txt")
    shipped = {job.args["seed"]: job.args for job in shipped if job.results == Path("results/di")}
    paper = plain_args(script.Args())
    jobs = run_seeds.read_trainings(ROOT / "benchmarks" / "trainings" / "ablation.txt")
    assert [job.args["seed"] for job in jobs] == [1, 2, 3] * len(ADDITIONS)
    for row, changed in ADDITIONS.items():
        mine = [job for job in jobs if job.results == Path(f"results/ablation/{row}")]
        assert len(mine) == 3
        for job in mine:
            off = {name: value for name, value in job.args.items() if value != shipped[job.args["seed"]][name]}
            assert set(off) == changed, shlex.join(job.command)
            assert row == "rate_linear" or off == {name: paper[name] for name in changed}
    assert set(memory.EXPERIMENTS["../ablation"].rows) == {"../di", *ADDITIONS}
    (linear,) = {job.args["learning_rate"] for job in jobs if job.results.name == "rate_linear"}
    found = [Schedule(linear).at(progress) for progress in (0.0, 1.0)]
    std = np.exp([Schedule(shipped[1]["log_std"]).at(progress) for progress in (0.0, 1.0)])
    np.testing.assert_allclose(found, shipped[1]["learning_rate"] * std, rtol=0.02)  # the shipped rate's ends
