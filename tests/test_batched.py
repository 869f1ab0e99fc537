"""An environment of a user's own without an optimum: derived from `BatchedEnv`, registered, trained, drawn."""

import json
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box
from helpers import TINY

import envs
import evaluate
import ppo_gtrxl_vdp as script
import runs
from common.errors import BadInput
from common.tasks import env_ids, task_of
from drawing import animation
from envs import BatchedEnv, SingleEnv


class Countdown(BatchedEnv):
    """Episode k ends after 3 + (k mod 4) steps; the reward is the action, the observation how far it has come."""

    def __init__(self, num_envs=1, render_mode=None):
        spaces = Box(-1.0, 1.0, (2,), dtype=np.float64), Box(-2.0, 2.0, (1,), dtype=np.float64)
        super().__init__(num_envs, 6, *spaces, render_mode)
        self.observation_scale = np.array([0.5, 2.0])
        self.lengths = 3 + np.arange(num_envs) % 4
        self.sums = np.zeros(num_envs)
        self.x = np.zeros(num_envs)

    def _start(self, mask, options):
        self.x[mask] = self._draw_starts(lambda n: self.np_random.uniform(-1, 1, (n, 1)), int(mask.sum()))[:, 0]
        self.sums[mask] = 0.0

    def _observe(self):
        return np.column_stack([self.x, self.t / 6])

    def _advance(self, actions):
        reward = actions[:, 0]
        self.sums += reward
        self.t = self.t + 1
        final = lambda: {"episodic_return": self.sums.copy(), "half": self.sums / 2}  # noqa: E731
        return reward, self.t == self.lengths, final


class Foreign(gym.vector.VectorEnv):
    """Not ours."""

    def __init__(self, num_envs=1):
        self.num_envs = num_envs


@pytest.fixture
def countdown(monkeypatch):
    """Its id, registered for one test, in the script's mappings too."""
    entries = {"entry_point": lambda **options: SingleEnv(Countdown(**options)), "vector_entry_point": Countdown}
    spec = gym.envs.registration.EnvSpec(id="Countdown-v0", **entries)
    monkeypatch.setitem(gym.registry, "Countdown-v0", spec)
    ids = (*script.ENV_IDS, "Countdown-v0")
    monkeypatch.setattr(script, "ENV_IDS", ids)
    return "Countdown-v0"


def test_a_registered_environment_is_an_id(countdown, monkeypatch):
    assert countdown in env_ids() and countdown in envs.own_ids() and "CartPole-v1" not in env_ids()
    assert task_of(countdown).env_id == countdown
    assert runs.observation_scale(countdown) == [0.5, 2.0]
    spec = gym.envs.registration.EnvSpec(id="Foreign-v0", entry_point=Foreign, vector_entry_point=Foreign)
    monkeypatch.setitem(gym.registry, "Foreign-v0", spec)
    with pytest.raises(BadInput, match="^env_id is 'Foreign-v0'; .* derived from BatchedEnv"):
        runs.observation_scale("Foreign-v0")


def test_it_is_measured_episode_by_episode(countdown):
    """Only first episodes count, and each ends where it does: 8 of 3, 4, 5 and 6 steps at an action of 0.5."""
    metrics, arrays = evaluate.evaluate(countdown, lambda obs, t: np.full((len(obs), 1), 0.5), 3, 8)
    lengths = np.array([3, 4, 5, 6] * 2)
    assert metrics["episodic_length"] == 4.5 and metrics["episodic_return"] == pytest.approx(2.25)
    assert metrics["half_mean"] == pytest.approx(1.125)
    np.testing.assert_array_equal(np.isfinite(arrays["u"][..., 0]).sum(axis=1), lengths)
    np.testing.assert_array_equal(np.isfinite(arrays["obs"][..., 0]).sum(axis=1), lengths + 1)
    for obs, length in zip(arrays["obs"], lengths):
        assert obs[length].tolist() == [obs[0, 0], length / 6]  # the last one, not the next episode's first
    np.testing.assert_allclose(arrays["reward"].sum(axis=1), lengths / 2)


def test_it_trains_and_is_published(countdown, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(animation, "FRAMES", 3)  # the others are drawn alike
    script.main([*TINY, f"--env-id={countdown}", "--total-updates=2", "--eval-every=1", "--capture-video"])
    (run,) = (tmp_path / "runs").iterdir()
    metrics = json.loads((run / "eval.json").read_text())
    assert metrics["env_id"] == countdown and np.isfinite(metrics["episodic_return"])
    assert {path.name for path in (run / "figures").iterdir()} == {"animation.gif", "episodes.png", "training.png"}
    evaluate.publish(run, tmp_path / "result")
    assert (tmp_path / "result" / "seeds" / "1.csv").exists()
    table = task_of(countdown).table(metrics)
    assert "no optimum known" in table and "half_mean" in table


def test_what_it_cannot_do_is_one_line(countdown, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        script.main([*TINY, f"--env-id={countdown}", "--no-observe-phase"])
    assert ended.value.code.startswith(
        "error: --no-observe-phase: observe_phase is False; it is no option of Countdown-v0"
    )
    with pytest.raises(BadInput, match="'Countdown-v0', without an optimum"):
        task_of(countdown).baseline_command(SimpleNamespace())
    assert not list(tmp_path.iterdir())
