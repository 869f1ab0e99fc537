"""What is asked of a lander's id: metrics by hand, the optimum beside a policy, the script from training to files."""

import dataclasses
import importlib
import json
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch

import baselines
import envs
import evaluate
from benchmarks.policies import load
from common.evaluations import read_evaluation
from common.tasks import task_of
from landing.environment import LanderVectorEnv, fly_lander
from landing.lander import LANDERS
from landing.metrics import KEPT_FLIGHTS, draws, evaluate_policy, flight_metrics, fly_draws
from landing.optimum import references
from landing.task import held

ID = "MarsLanding-v0"
script = importlib.import_module("ppo_gtrxl_lander")


def falls(obs, t):
    """A policy that asks for nothing: the least thrust, straight up."""
    return np.zeros((len(obs), 3))


def test_draws_are_those_of_the_seed_and_not_of_their_number():
    assert np.array_equal(draws(4, 50)[:20], draws(4, 20))
    assert not np.array_equal(draws(5, 20), draws(4, 20))
    assert draws(0, 1000).min() >= 0 and draws(0, 1000).max() <= 1


def test_metrics_by_hand():
    flown = {
        "episodic_return": np.array([-1.0, -3.0]),
        "position_error": np.array([0.0, 4.0]),
        "speed": np.array([1.0, 1.5]),
        "slope": np.array([9.0, 3.0]),
        "down": np.array([True, True]),
        "landed": np.array([True, False]),
        "fuel_kg": np.array([200.0, 210.0]),
        "final_time": np.array([40.0, 50.0]),
    }
    metrics = flight_metrics(flown)
    assert metrics["landed_rate"] == 0.5 and metrics["soft_rate"] == 1.0
    assert metrics["position_error_mean_m"] == 2.0 and metrics["position_error_max_m"] == 4.0
    assert metrics["speed_std_m_s"] == 0.25 and metrics["fuel_mean_kg"] == 205.0


def test_batches_do_not_change_a_flight():
    """1500 flights in two batches are the flights of one batch."""
    z = draws(1, 1500)
    parts = fly_draws(ID, lambda some: falls, z)
    whole = fly_lander(ID, falls, z)
    assert np.array_equal(parts["final_y"], whole["final_y"])
    assert np.array_equal(parts["u"], whole["u"], equal_nan=True)
    assert parts["y"].shape[0] == KEPT_FLIGHTS


def test_flights_of_a_draw_are_compared_by_position_and_velocity():
    """A fit that saw the command and the acceleration, too, would leave nearly nothing of what an action brings."""
    generator = torch.Generator().manual_seed(0)
    obs = torch.randn(3, 32, 13, generator=generator)
    rewards = torch.randn(3, 32, generator=generator)
    alive = torch.ones(3, 32)
    batch = SimpleNamespace(obs=obs, rewards=rewards, critic=torch.zeros(3, 32), alive=alive)
    baseline, _ = script.returns_baseline(batch, gamma=1.0, group=16)
    obs[..., 6:] = 0.0  # time, command, acceleration
    assert torch.equal(script.returns_baseline(batch, gamma=1.0, group=16)[0], baseline)
    obs[..., 5] = 0.0  # vertical velocity
    assert not torch.equal(script.returns_baseline(batch, gamma=1.0, group=16)[0], baseline)


def test_the_optimum_lands_and_a_policy_is_measured_beside_it():
    task = task_of(ID)
    reference = task.optimum(3, 4)
    assert reference["solved"].all() and reference["down"].all()
    assert reference["position_error"].max() < 0.01 and reference["speed"].max() < 0.02
    metrics, arrays = task.evaluate(falls, 3, 4, reference)
    assert metrics["landed_rate"] == 0 and metrics["reference_starts"] == 4
    assert all(np.isfinite(value) for value in metrics.values() if not isinstance(value, str))
    assert task.table(metrics).count("\n") > 10
    assert task.required_arrays(metrics) <= arrays.keys()
    again = fly_lander(ID, held(arrays["u"], envs.MARS), draws(3, 4))
    assert again["final_y"] == pytest.approx(arrays["final_y"])


@pytest.mark.parametrize("flag", ["--starts=3", "--seed=7"])
def test_a_lander_of_one_start_takes_no_draws(flag, monkeypatch):
    monkeypatch.setattr("landing.task.report_lander", None)  # nothing is solved
    monkeypatch.setattr("sys.argv", ["baselines.py", "PoweredDescent-v0", flag])
    name, value = flag.split("=")
    with pytest.raises(SystemExit, match=f"^error: {name} is {value}; it must be left out: PoweredDescent-v0 has one"):
        baselines.main()


def test_the_fuel_ratio_is_of_the_solved_draws():
    solved = {"solved": np.array([True, False, True]), "fuel_kg": np.array([20.0, np.nan, 70.0])}
    solved |= {"final_time": np.ones(3), "episodic_return": np.ones(3), "y": np.zeros((3, 2, 7))}
    fuel = fly_draws(ID, lambda z: falls, draws(4, 4))["fuel_kg"]
    metrics, _ = evaluate_policy(ID, falls, solved, 4, 4)
    assert metrics["fuel_ratio"] == pytest.approx((fuel[0] + fuel[2]) / 90)


def test_the_optima_are_of_the_evaluations_draws():
    """The draws of seed 3 as README of results/ can make them: numbers of NumPy's generator of [3, 3]."""
    z = np.random.default_rng([3, 3]).random((2, 13))
    np.testing.assert_array_equal(draws(3, 2), z)
    np.testing.assert_array_equal(task_of(ID).optimum(3, 2)["fuel_kg"], references(ID, z)["fuel_kg"])
    np.testing.assert_array_equal(task_of(ID).reset_options(3, 2)["draw"], z)


def test_the_shipped_policy_flies_as_it_did():
    folder = Path(script.__file__).parent / "results" / "mars_landing"
    agent, args, options = load(folder / "agent.safetensors")
    with np.load(folder / "eval.npz") as file:
        z, ends = file["draw"], file["final_y"]
    np.testing.assert_array_equal(z, draws(0, len(z)))
    steps = gym.make_vec(ID, num_envs=1, **options).unwrapped.episode_steps
    flown = fly_lander(ID, agent.make_policy(steps), z, **options)
    np.testing.assert_allclose(flown["final_y"], ends, atol=0.02)


def test_the_curriculum_of_our_recipe():
    """At its points: the scales follow the noise, commands are held for 1 s and at the end for 0.4 s."""
    args = script.Args(**script.MARS)
    batch = gym.make_vec(ID, num_envs=2, decision_s=args.decision_s, longest_flight=args.longest_flight).unwrapped
    for progress, log_std, hold, fuel, slope in (
        (0, -1, 1.0, 4, 0),
        (0.6, -2.5, 1.0, 14, 2),
        (1, -3.6, 0.4, 14, 4),
    ):
        batch.reset(options={"training": script.curriculum(args, progress)})
        flown = batch.training
        std = np.exp(log_std)
        assert flown.position_scale == pytest.approx(max(30 * std, 0.1))
        assert flown.speed_scale == pytest.approx(max(10 * std, 0.1))
        assert batch.dt == pytest.approx(hold)
        assert (flown.fuel_price, flown.slope_price) == (pytest.approx(fuel), pytest.approx(slope))


def test_the_script_trains_evaluates_and_publishes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    tiny = ["--embed-dim=8", "--num-heads=2", "--num-blocks=1", "--memory-length=4", "--mlp-dim=8", "--hidden-dim=8"]
    argv = ["--total-updates=1", "--num-envs=4", "--eval-starts=10", "--failure-time=random", "--failure-vertical=1.2"]
    script.main([*tiny, *argv])
    (run,) = (tmp_path / "runs").iterdir()
    metrics, arrays = read_evaluation(run)
    assert metrics["failure_time"] == "random" and metrics["decision_s"] == 0.4
    assert metrics["failure_vertical"] == 1.2
    failed = arrays["effectiveness"][..., 2]
    assert np.nanmin(failed) == 1 / 1.2
    assert arrays["u"].shape[::2] == (10, 3) and float(arrays["decision_s"]) == 0.2
    script.main(
        [f"--checkpoint={run / 'agent.safetensors'}", "--eval-only", "--eval-starts=10", "--eval-json=again.json"]
    )
    again = json.loads((tmp_path / "again.json").read_text())
    assert again["position_error_mean_m"] == metrics["position_error_mean_m"]
    evaluate.publish(run, tmp_path / "results", ship=False)
    assert (tmp_path / "results" / "eval.npz").is_file()
    capsys.readouterr()


def test_training_goes_beyond_what_is_flown():
    """On Mars failures from 1 to 3 and from 1 to 1.75, and a box wider by a third; a flag means that size alone."""
    args = script.Args(**script.MARS)
    batch = gym.make_vec(ID, num_envs=args.num_envs).unwrapped
    batch.reset(seed=0, options={"training": script.curriculum(args, 0.0)})
    assert batch.failure[:3] == (0.5, (1.0, pytest.approx(3.0)), (1.0, pytest.approx(1.75)))
    assert np.abs(batch.r[1]).max() == pytest.approx(4000 / 3, rel=0.01)
    args = script.Args(**script.MARS, failure_size=2.0, failure_vertical=1.5)
    batch = gym.make_vec(ID, num_envs=1, failure_size=2.0, failure_vertical=1.5).unwrapped
    batch.reset(seed=0, options={"training": script.curriculum(args, 0.0)})
    assert batch.failure[:3] == (0.5, (2.0, 2.0), (1.5, 1.5))


def test_the_network_sees_how_the_lander_answers():
    """Zero for a nominal lander that does what it was told, whatever the command; nothing more if it is hidden."""
    constants = script.constants(ID)
    agent = SimpleNamespace(**{name: torch.tensor(value) for name, value in constants.items()})
    command = torch.tensor([[0.3, -0.2, 0.5], [0.0, 0.1, 0.9]])
    acceleration = 12.0 * command - torch.tensor([0.0, 0.0, 3.7114])  # 24 kN on 2000 kg
    acceleration[1, 2] /= 2
    obs = torch.cat([torch.ones(2, 7), command, acceleration], dim=1)
    seen = script.features(agent, obs)
    torch.testing.assert_close(seen[:, 10:13], acceleration / 3.7114)
    answer = torch.zeros(2, 3)
    answer[1, 2] = -acceleration[1, 2] / 3.7114  # half of what was told
    torch.testing.assert_close(seen[:, 13:16], answer)
    hidden = script.features(agent, obs[:, :10])
    assert torch.equal(hidden, torch.cat([seen[:, :10], seen[:, 16:]], dim=1))


def test_a_lander_of_your_own_trains_with_the_failures_of_its_table(monkeypatch):
    own = dataclasses.replace(LANDERS[ID], failure_probability=0.3, failure_size=1.5, longest=80.0)
    monkeypatch.setitem(LANDERS, "Own-v0", own)
    args = script.Args(env_id="Own-v0", **script.recipe(script.Args(env_id="Own-v0")))
    batch = LanderVectorEnv(own, num_envs=8, **{name: getattr(args, name) for name in script.ENV_OPTIONS})
    batch.reset(options={"training": script.curriculum(args, 0.5)})
    failure = batch.failure
    assert (failure.probability, batch.longest_flight) == (0.3, 80.0)
    assert failure.sizes == (1.0, pytest.approx(1 + 0.5 * 4 / 3))
