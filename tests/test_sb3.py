"""Stable-Baselines3 on these environments, in its own ways and by the native batch; skipped where it is missing."""

import json
import shlex
import subprocess
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import envs

pytest.importorskip("stable_baselines3")
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from rocket.task import RocketTask
from sb3_env import NativeVecEnv

ROOT = Path(__file__).parent.parent
IDS = ["VanDerPolWaypoints-v0", "RocketAscentCutoff-v0"]
OPTIONS = {env_id: {"action_frame": "local"} if env_id in envs.ROCKETS else {} for env_id in IDS}


def native(env_id, num_envs, **options):
    return NativeVecEnv(gym.make_vec(env_id, num_envs=num_envs, **OPTIONS.get(env_id, {}), **options))


def weights(model):
    return np.concatenate([weight.detach().numpy().ravel() for weight in model.policy.parameters()])


@pytest.mark.parametrize("env_id", IDS)
def test_its_checker_accepts_the_single_environments(env_id):
    check_env(gym.make(env_id, **OPTIONS[env_id]).unwrapped)


@pytest.mark.parametrize("env_id", IDS)
def test_ppo_learns_in_its_own_vector_environments(env_id):
    dummy = DummyVecEnv([lambda: gym.make(env_id, **OPTIONS[env_id])] * 2)
    made = make_vec_env(env_id, n_envs=2, env_kwargs=OPTIONS[env_id])
    for venv in (dummy, made, VecMonitor(native(env_id, 2))):
        model = PPO("MlpPolicy", VecNormalize(venv), n_steps=16, batch_size=16, n_epochs=1, device="cpu", seed=0)
        before = weights(model)
        model.learn(64)
        after = weights(model)
        assert np.isfinite(after).all() and (after != before).any() and model.num_timesteps == 64


@pytest.mark.parametrize("env_id", IDS)
def test_sac_learns_on_a_single_environment(env_id):
    env = gym.make(env_id, **OPTIONS[env_id])
    model = SAC("MlpPolicy", env, learning_starts=8, batch_size=8, buffer_size=100, device="cpu", seed=0)
    before = weights(model)
    model.learn(24)
    after = weights(model)
    assert np.isfinite(after).all() and (after != before).any()
    assert env.action_space.contains(model.predict(env.reset()[0])[0].astype(np.float64))


def test_options_are_those_of_the_next_reset():
    env, x0 = NativeVecEnv(gym.make_vec("DoubleIntegrator-v0", num_envs=3)), np.full((3, 2), 0.5)
    env.seed(0)
    env.set_options({"x0": x0})
    np.testing.assert_allclose(env.reset()[:, :2], x0)
    assert (env.reset()[:, :2] != x0).all()


def test_native_batch_flies_as_a_dummy_of_single_rockets():
    """The same actions through both, over a crash and into the next episode."""
    env_id, steps = "RocketAscent-v0", 40
    batch = NativeVecEnv(gym.make_vec(env_id, num_envs=2))
    dummy = DummyVecEnv([lambda: gym.make(env_id)] * 2)
    assert batch.reset() == pytest.approx(dummy.reset().astype(np.float32))
    actions, ends = np.array([[1.0, 0.0, 0.5], [-1.0, 0.3, -0.5]]), 0
    for _ in range(steps):
        ours, theirs = batch.step(actions), dummy.step(actions)
        for one, other in zip(ours[:3], theirs[:3]):
            assert one == pytest.approx(other, rel=1e-6)
        for one, other in zip(ours[3], theirs[3]):
            assert ("terminal_observation" in one) == ("terminal_observation" in other)
            if "terminal_observation" in one:
                ends += 1
                assert one["terminal_observation"] == pytest.approx(other["terminal_observation"], rel=1e-6)
                assert one["crashed"] and other["crashed"] and one["error_norm"] == other["error_norm"]
                assert not one["TimeLimit.truncated"] and not other["TimeLimit.truncated"]
    assert ends >= 2


def test_native_batch_keeps_the_interface():
    batch = native("VanDerPolWaypoints-v0", 3, render_mode="rgb_array")
    batch.seed(4)
    first = batch.reset()
    second = batch.reset()  # a seed is used once
    batch.seed(4)
    assert np.array_equal(batch.reset(), first) and (first != second).any() and first.dtype == np.float32
    assert [image.shape for image in batch.get_images()] == [(450, 800, 3)] * 3
    assert batch.get_attr("num_envs") == [3] * 3 and batch.get_attr("num_envs", [0, 2]) == [3] * 2
    assert batch.has_attr("training") and not batch.has_attr("no_such")
    batch.set_attr("spec", None)
    assert batch.batch.spec is None and batch.env_is_wrapped(gym.Wrapper, 1) == [False]


def test_the_benchmark_shows_what_our_encoder_sees():
    """Over a flight and a crash, features of the wrapper against those of a script's own agent."""
    import ppo_gtrxl_rocket as script
    from benchmarks import sb3_ppo

    env_id = "RocketAscentCutoff-v0"
    batch = gym.make_vec(env_id, num_envs=2, action_frame="local")
    agent = script.Agent(script.Args(env_id=env_id), batch)
    venv, twin = sb3_ppo.OurFeatures(native(env_id, 2), script, env_id), native(env_id, 2)
    seen, raw, crashes = venv.reset(), twin.reset(), 0
    for _ in range(30):
        np.testing.assert_array_equal(seen, script.features(agent, torch.as_tensor(raw)).numpy())
        action = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
        seen, _, dones, infos = venv.step(action)
        raw, _, _, twins = twin.step(action)
        for k in np.flatnonzero(dones):
            crashes += 1
            last = torch.as_tensor(twins[k]["terminal_observation"])
            np.testing.assert_array_equal(infos[k]["terminal_observation"], script.features(agent, last).numpy())
    assert crashes


def test_the_benchmark_follows_our_curriculum():
    import ppo_gtrxl_rocket as script
    from benchmarks import sb3_ppo

    env_id, args = "RocketAscentCutoff-v0", script.Args(env_id="RocketAscentCutoff-v0", mass_weight=3.0)
    batch = gym.make_vec(env_id, num_envs=2, action_frame="local").unwrapped
    model = PPO("MlpPolicy", NativeVecEnv(batch), n_steps=8, batch_size=16, n_epochs=1, device="cpu", seed=0)
    prices = []

    class Watch(sb3_ppo.OurCurriculum):
        def _on_rollout_start(self):
            super()._on_rollout_start()
            prices.append((batch.training.propellant_price, batch.training.flights_per_start))

    model.learn(64, callback=Watch(script, args, batch, 64))
    assert prices == [(pytest.approx(price), 1) for price in (0, 0, 3 * 0.25 / 0.35, 3 * (1 - 0.9 * 0.15 / 0.4))]


def test_the_benchmark_trains_and_writes_its_record(tmp_path, monkeypatch):
    """With a price of its own, flown on as many starts as ours; a record is whole or untouched."""
    from benchmarks import sb3_ppo

    made, evaluated, make_model = [], [], sb3_ppo.make_model

    def keep_model(options, script, args, *rest):
        model = make_model(options, script, args, *rest)
        made.append((args.mass_weight.at(0.0), model.policy.log_std.detach().tolist()))
        return model

    def keep_evaluation(env_id, policy, eval_seed, n, **options):
        evaluated.append(n)
        return {"env_id": env_id, "error_norm": 1.0, "mass_ratio": 0.9}, {}

    monkeypatch.setattr(sb3_ppo, "make_model", keep_model)
    monkeypatch.setattr(sb3_ppo.evaluate, "evaluate", keep_evaluation)
    monkeypatch.setattr(RocketTask, "table", lambda task, metrics: "")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sb3_ppo, "NUM_ENVS", 1)
    flags = "--env-id RocketAscentCutoff-v0 --batch-size 1000 --samples 900".split()

    def cut(*paths):
        raise InterruptedError

    def run(*more):
        monkeypatch.setattr("sys.argv", ["sb3_ppo.py", *flags, *more])
        sb3_ppo.main()

    run("--json", "nominal.json")
    written = json.loads((tmp_path / "nominal.json").read_text())
    assert written["flags"] == shlex.join([*flags, "--json", "nominal.json"])
    assert written["final"]["mass_ratio"] == 0.9 and written["curve"][-1]["samples"] >= 900
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True).stdout
    assert head.startswith(written["commit"] or "-") or not head  # the project may stand outside git
    with monkeypatch.context() as broken, pytest.raises(InterruptedError):
        broken.setattr("os.replace", cut)
        run("--mass-weight", "0.5", "--json", "nominal.json")
    assert json.loads((tmp_path / "nominal.json").read_text()) == written  # whole or untouched
    assert made == [(0.0, [pytest.approx(-1.4)] * 3), (0.5, [pytest.approx(-1.4)] * 3)]
    assert evaluated == [1000] * 4  # twice in each run
