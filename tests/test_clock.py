"""`benchmarks/clock.py`: the hands by a clock's geometry, a policy trained with them, and what is refused."""

import importlib
import json

import clock
import gymnasium as gym
import numpy as np
import pytest
import torch
from robustness import TINY

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("env_id", ["DoubleIntegratorWaypoints-v0", "VanDerPol-v0"])
def test_the_hands_turn_with_the_episode(env_id):
    """Of the observations of an environment: after part s of the steps hand k has turned k s times."""
    env = gym.make(env_id)
    obs, ended = [env.reset(seed=1)[0]], False
    while not ended:
        next_obs, _, ended, *_ = env.step(np.zeros(1))
        obs.append(next_obs)
    obs = torch.tensor(np.array(obs[:-1]))
    sine, cosine = clock.with_hands(lambda agent, obs: obs)(None, obs)[:, obs.shape[1] :].split(5, dim=1)
    turned = torch.arange(len(obs))[:, None] / len(obs) * torch.tensor([1, 2, 4, 8, 16], dtype=torch.float64)
    hands = torch.polar(torch.ones_like(turned), 2 * torch.pi * turned)
    assert torch.allclose(torch.complex(cosine, sine), hands, atol=1e-9)


def test_a_policy_with_hands_is_trained_and_flown_by_it_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    env_id, script = "DoubleIntegratorWaypoints-v0", importlib.import_module("ppo_gtrxl_di")
    with monkeypatch.context() as patch:
        patch.setattr(script, "features", clock.with_hands(script.features))
        script.main([*TINY, "--total-updates=1", f"--env-id={env_id}", "--memory-length=0"])
        (run,) = tmp_path.glob("runs/*")
        checkpoint = [f"--checkpoint={run}/agent.safetensors", "--eval-only", "--eval-starts=10"]
        script.main([*checkpoint, "--eval-json=again.json"])
    trained, again = (json.loads(path.read_text()) for path in (run / "eval.json", tmp_path / "again.json"))
    assert trained["env_id"] == again["env_id"] == env_id and trained["cost_mean"] == again["cost_mean"]
    with pytest.raises(SystemExit, match=r"encoder.0.weight is \(8, 16\) in the file and \(8, 6\) in this script"):
        script.main(checkpoint)
