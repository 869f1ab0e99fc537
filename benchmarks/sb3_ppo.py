"""Stable-Baselines3's PPO on the same environments, with the same reward and samples, evaluated by the same table.

    pip install -r benchmarks/requirements.txt
    python benchmarks/sb3_ppo.py --env-id DoubleIntegrator-v0 --samples 2560000
    python benchmarks/sb3_ppo.py --env-id RocketAscentCutoff-v0 --batch-size 512 --learning-rate 1e-3
    python benchmarks/sb3_ppo.py --env-id RocketAscentCutoff-v0 --recurrent --dispersion 1 --start RUN.zip

It is given what our script gives its own learner: the curriculum (price of the propellant, scale of R_terminal), the
first mean action and its noise, the local frame, and our features of the observation, or with --features raw the
observation itself. The rest is that library's: feed-forward networks for actor and critic (an LSTM with --recurrent, of
sb3-contrib), VecNormalize of inputs and rewards, its discount, clipping and epochs. `peers.py` runs and lists all.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor, VecNormalize

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import envs  # noqa: E402
import evaluate  # noqa: E402
from sb3_env import NativeVecEnv  # noqa: E402

PARTS = 20  # evaluated after each such part of the samples
SCRIPTS = ("ppo_gtrxl_di", "ppo_gtrxl_vdp", "ppo_gtrxl_rocket")


class OurFeatures(VecEnvWrapper):
    """Observations as our script's encoder sees them."""

    def __init__(self, venv, script, env_id):
        constants = {name: torch.tensor(value) for name, value in script.BUFFERS[env_id].items()}
        self.script, self.constants = script, SimpleNamespace(**constants)
        size = self(venv.observation_space.sample()[None]).shape[1]
        super().__init__(venv, observation_space=gym.spaces.Box(-np.inf, np.inf, (size,), np.float32))

    def __call__(self, obs):
        return self.script.features(self.constants, torch.as_tensor(obs, dtype=torch.float32)).numpy()

    def reset(self):
        return self(self.venv.reset())

    def step_wait(self):
        obs, rewards, dones, infos = self.venv.step_wait()
        for k in np.flatnonzero(dones):
            infos[k]["terminal_observation"] = self(infos[k]["terminal_observation"][None])[0]
        return self(obs), rewards, dones, infos


class OurCurriculum(BaseCallback):
    """Before each rollout, what our script changes by the share of training done; and its noise, where that is set."""

    def __init__(self, script, args, batch, noise):
        super().__init__()
        self.script, self.args, self.batch, self.noise = script, args, batch, noise

    def _on_rollout_start(self):
        progress = self.num_timesteps / self.model.total_samples
        if self.noise == "schedule":
            first, last = self.args.log_std, self.args.log_std_final
            self.model.policy.log_std.data.fill_(first + (last - first) * min(progress, 1.0))
            self.model.policy.log_std.requires_grad_(False)
        std = self.model.policy.log_std.exp().mean().item()
        self.script.set_curriculum(self.batch, self.args, progress, False, std)
        self.batch.flights_per_start = 1  # the library compares no flights of one start

    def _on_step(self):
        return True


def make_policy(model, inputs):
    """The mean action of (obs (N, obs), t) in NumPy, as `evaluate.evaluate` flies it."""
    state = [None]

    def policy(obs, t):
        if t == 0:
            state[0] = None
        begins = np.full(len(obs), t == 0)
        action, state[0] = model.predict(inputs(obs), state[0], begins, deterministic=True)
        return action

    return policy


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env-id", default="DoubleIntegrator-v0", choices=[*envs.PROBLEMS, *envs.ROCKETS])
    parser.add_argument("--samples", type=int, default=2_560_000)
    parser.add_argument("--features", default="ours", choices=["ours", "raw"])
    parser.add_argument("--recurrent", action="store_true", help="an LSTM: sb3-contrib's RecurrentPPO")
    parser.add_argument("--dispersion", type=float, default=0.0, help="every flight another vehicle (a rocket's)")
    parser.add_argument("--noise", default="learned", choices=["learned", "schedule"], help="who sets the log-std")
    parser.add_argument("--num-envs", type=int, default=32)
    parser.add_argument("--batch-size", type=int, default=64)
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--learning-rate", type=float, default=3e-4, help="falls linearly to zero")
    parser.add_argument("--gamma", type=float, default=0.99)
    parser.add_argument("--gae-lambda", type=float, default=0.95)
    parser.add_argument("--width", type=int, default=64, help="of the two hidden layers, and of the LSTM")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--eval-seed", type=int, default=0)
    parser.add_argument("--start", help="begin with this .zip and the .pkl beside it")
    parser.add_argument("--save", help="write the policy as this .zip and its VecNormalize as .pkl beside it")
    parser.add_argument("--json", help="write the figures there")
    options = parser.parse_args()
    torch.set_num_threads(1)

    env_id, rocket = options.env_id, options.env_id in envs.ROCKETS
    script = next(s for s in map(importlib.import_module, SCRIPTS) if env_id in s.ENV_IDS)
    args = script.Args(env_id=env_id, dispersion=options.dispersion) if rocket else script.Args(env_id=env_id)
    env_options = {name: getattr(args, name) for name in script.ENV_OPTIONS}
    batch = gym.make_vec(env_id, num_envs=options.num_envs, **env_options)
    venv = VecMonitor(NativeVecEnv(batch))
    ours = OurFeatures(venv, script, env_id) if options.features == "ours" else None
    if options.start:
        normalised = VecNormalize.load(Path(options.start).with_suffix(".pkl"), ours or venv)
    else:
        normalised = VecNormalize(ours or venv, gamma=options.gamma, clip_reward=np.inf)
    kind, policy = (RecurrentPPO, "MlpLstmPolicy") if options.recurrent else (PPO, "MlpPolicy")
    network = {"net_arch": [options.width] * 2, "log_std_init": args.log_std}
    if options.recurrent:
        network["lstm_hidden_size"] = options.width
    model = kind(
        policy,
        normalised,
        learning_rate=lambda left: options.learning_rate * left,
        n_steps=batch.unwrapped.episode_steps,
        batch_size=options.batch_size,
        n_epochs=options.epochs,
        gamma=options.gamma,
        gae_lambda=options.gae_lambda,
        policy_kwargs=network,
        seed=options.seed,
        device="cpu",
    )
    model.policy.action_net.bias.data = torch.tensor(script.INITIAL_ACTION)
    if options.start:
        model.set_parameters(options.start)
    model.total_samples = options.samples

    def inputs(obs):
        obs = obs.astype(np.float32)
        return normalised.normalize_obs(ours(obs) if ours else obs)

    kinds = {"dispersed_error_median", "dispersed_error_p95", "dispersed_box_rate"} if options.dispersion else set()
    kinds |= {"error_norm", "mass_ratio"} if rocket else {"ratio_of_sums", "ratio_p95", "hit_rate"}
    curve = []

    class Evaluation(BaseCallback):
        """Stops the clock, evaluates after each part."""

        seconds, began = 0.0, 0.0

        def _on_training_start(self):
            self.began = time.process_time()

        def _on_step(self):
            return True

        def _on_rollout_start(self):
            if self.num_timesteps >= options.samples * (len(curve) + 1) / PARTS:
                self.evaluate()

        def _on_training_end(self):
            self.evaluate()

        def evaluate(self):
            self.seconds += time.process_time() - self.began
            flown = make_policy(model, inputs)
            metrics, _ = evaluate.evaluate(env_id, flown, options.eval_seed, 1000, **env_options)
            curve.append({"samples": self.num_timesteps, "minutes": self.seconds / 60} | {k: metrics[k] for k in kinds})
            self.metrics = metrics
            print(json.dumps(curve[-1]), flush=True)
            self.began = time.process_time()

    evaluation = Evaluation()
    model.learn(options.samples, callback=[OurCurriculum(script, args, batch.unwrapped, options.noise), evaluation])
    print(evaluate.table(evaluation.metrics))
    if options.save:
        model.save(options.save)
        normalised.save(Path(options.save).with_suffix(".pkl"))
    if options.json:
        Path(options.json).write_text(json.dumps({"curve": curve, "final": evaluation.metrics}, indent=1) + "\n")


if __name__ == "__main__":
    main()
