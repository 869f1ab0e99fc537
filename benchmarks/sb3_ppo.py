"""Stable-Baselines3's PPO on the same environments, with the same reward and samples, evaluated by the same table.

    pip install -r benchmarks/requirements.txt
    python -m benchmarks.sb3_ppo --env-id DoubleIntegrator-v0 --samples 2560000
    python -m benchmarks.sb3_ppo --env-id RocketAscentCutoff-v0 --batch-size 512 --learning-rate 1e-3 --mass-weight 0.3

It gets what our script gives its own learner: the curriculum (scale of R_terminal), the first mean action and its
noise, the local frame, and our features of the observation. With --features raw it gets the observation itself.
Propellant has a price by the kilogram. The rest is that library's: feed-forward networks for actor and critic,
VecNormalize of inputs and rewards, its discount, clipping and epochs. `peers.py` runs and lists all.
"""

from __future__ import annotations

import json
import time
from dataclasses import replace
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor, VecNormalize

import evaluate
import ppo_gtrxl_di
import ppo_gtrxl_rocket
from benchmarks.policies import environment_options
from benchmarks.records import provenance
from common.command_line import OneLineParser, integer, output_file
from common.files import write_json
from common.schedule import Schedule
from common.tasks import task_of
from sb3_env import NativeVecEnv

PARTS = 20  # evaluated after each such part of the samples
NUM_ENVS = 32
SCRIPTS = {"DoubleIntegrator-v0": ppo_gtrxl_di, "RocketAscentCutoff-v0": ppo_gtrxl_rocket}


class OurFeatures(VecEnvWrapper):
    """Observations as our script's encoder sees them."""

    def __init__(self, venv, script, env_id):
        constants = {name: torch.tensor(value) for name, value in script.constants(env_id).items()}
        self.script = script
        self.constants = SimpleNamespace(**constants)
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
    """Before each rollout, hand over what our script does by the share of training done, and a price of propellant.

    Our script compares the masses of flights that have all ended (`add_rewards`). This library's rollouts end in the
    middle of flights, so here propellant has a price by the kilogram. It is zero in the first quarter, highest at 60 %,
    and a tenth of that at the end.
    """

    def __init__(self, script, args, batch, samples):
        super().__init__()
        self.script = script
        self.args = args
        self.batch = batch
        self.samples = samples

    def _on_rollout_start(self):
        progress = self.num_timesteps / self.samples
        self.args.log_std = Schedule(self.model.policy.log_std.mean().item())  # as it was learned
        training = self.script.curriculum(self.args, progress)
        if hasattr(type(self.args), "mass_weight"):  # the rocket's script
            price = np.interp(progress, [0.25, 0.6, 1.0], [0.0, 1.0, 0.1])
            training["propellant_price"] = float(self.batch.cutoff * self.args.mass_weight.at(0.0) * price)
        training["flights_per_start"] = 1  # the library compares no flights of one start
        self.batch.hand_over(training)  # not at a reset, because its rollouts end in the middle of flights

    def _on_step(self):
        return True


class Evaluation(BaseCallback):
    """Evaluates after each part of the samples. `curve` has the processor's minutes, without the evaluations'."""

    def __init__(self, env_id, env_options, samples):
        super().__init__()
        self.env_id, self.env_options, self.samples = env_id, env_options, samples
        task = task_of(env_id)
        self.keys = task.progress_keys(**env_options)
        self.starts = task.default_flights(is_brief=False, **env_options)
        self.curve, self.metrics, self.seconds = [], {}, 0.0

    def _on_training_start(self):
        self.began = time.process_time()

    def _on_step(self):
        return True

    def _on_rollout_start(self):
        if self.num_timesteps >= self.samples * (len(self.curve) + 1) / PARTS:
            self.evaluate()

    def _on_training_end(self):
        self.evaluate()

    def evaluate(self):
        self.seconds += time.process_time() - self.began
        flown = make_policy(self.model, self.training_env)
        self.metrics, _ = evaluate.evaluate(self.env_id, flown, 0, self.starts, **self.env_options)
        point = {"samples": self.num_timesteps, "minutes": self.seconds / 60}
        self.curve.append(point | {key: self.metrics[key] for key in self.keys if key in self.metrics})
        print(json.dumps(self.curve[-1]), flush=True)
        self.began = time.process_time()


def make_policy(model, normalised):
    """The mean action of (obs (N, obs), t) in NumPy, as `evaluate.evaluate` flies it."""
    seen = normalised.venv if isinstance(normalised.venv, OurFeatures) else lambda obs: obs

    def policy(obs, t):
        inputs = normalised.normalize_obs(seen(obs.astype(np.float32)))
        return model.predict(inputs, deterministic=True)[0]

    return policy


def make_model(options, script, args, normalised, steps):
    """The library's learner with our first mean action and its noise."""
    model = PPO(
        "MlpPolicy",
        normalised,
        learning_rate=lambda left: options.learning_rate * left,
        n_steps=steps,
        batch_size=options.batch_size,
        policy_kwargs={"net_arch": [64, 64], "log_std_init": args.log_std.at(0.0)},
        seed=options.seed,
        device="cpu",
    )
    model.policy.action_net.bias.data = torch.tensor(script.INITIAL_ACTION)
    return model


def parse_args():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env-id", default="DoubleIntegrator-v0", choices=SCRIPTS)
    parser.add_argument("--samples", type=integer(1, 10**9), default=2_560_000)
    parser.add_argument("--features", default="ours", choices=["ours", "raw"])
    parser.add_argument("--mass-weight", type=float, help="highest price of a mission's mass_unit; without it none")
    parser.add_argument("--batch-size", type=integer(1, 10**9), default=64)
    parser.add_argument("--learning-rate", type=float, default=3e-4, help="falls linearly to zero")
    parser.add_argument("--seed", type=integer(1, 2**31 - 1), default=1, help="0 is that of the evaluation")
    parser.add_argument("--json", type=output_file, help="write the figures there")
    options = parser.parse_args()
    if options.mass_weight is not None:
        if not hasattr(SCRIPTS[options.env_id].Args, "mass_weight"):
            parser.error(f"--mass-weight {options.mass_weight}: only a rocket has it, not {options.env_id}")
        if not 0 <= options.mass_weight < np.inf:
            parser.error(f"--mass-weight {options.mass_weight}: must be between 0 and infinity")
    return options


def main():
    options = parse_args()
    code = provenance()  # now: hours later it may be another
    torch.set_num_threads(1)
    script = SCRIPTS[options.env_id]
    args = script.Args(**{**script.recipe(script.Args(env_id=options.env_id)), "env_id": options.env_id})
    args = replace(args, log_std=script.Args.log_std, flights_per_start=1)  # the library learns its noise
    if options.mass_weight is not None:
        args = replace(args, mass_weight=options.mass_weight)
    env_options = environment_options(script, args)

    batch = gym.make_vec(options.env_id, num_envs=NUM_ENVS, **env_options).unwrapped
    venv = VecMonitor(NativeVecEnv(batch))
    if options.features == "ours":
        venv = OurFeatures(venv, script, options.env_id)
    normalised = VecNormalize(venv, clip_reward=np.inf)

    model = make_model(options, script, args, normalised, batch.episode_steps)
    evaluation = Evaluation(options.env_id, env_options, options.samples)
    model.learn(options.samples, callback=[OurCurriculum(script, args, batch, options.samples), evaluation])
    print(task_of(options.env_id).table(evaluation.metrics))
    if options.json:
        write_json(options.json, {**code, "curve": evaluation.curve, "final": evaluation.metrics})


if __name__ == "__main__":
    main()
