"""Stable-Baselines3's PPO on the same environments, with the same reward and samples, evaluated by the same table.

    pip install -r benchmarks/requirements.txt
    python -m benchmarks.sb3_ppo --env-id DoubleIntegrator-v0 --samples 2560000
    python -m benchmarks.sb3_ppo --env-id RocketAscentCutoff-v0 --batch-size 512 --learning-rate 1e-3 --mass-weight 0.3
    python -m benchmarks.sb3_ppo --env-id RocketAscentCutoff-v0 --recurrent --dispersion 1 --start RUN.zip

It gets what our script gives its own learner: the curriculum (scale of R_terminal), the first mean action and its
noise, the local frame, and our features of the observation, for dispersed flights with the differences from the nominal
flight. With --features raw it gets the observation itself. Propellant has a price by the kilogram. The rest is that
library's: feed-forward networks for actor and critic (with --recurrent an LSTM of sb3-contrib), VecNormalize of inputs
and rewards, its discount, clipping and epochs. `peers.py` runs and lists all.
"""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import torch
from sb3_contrib import RecurrentPPO
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
from common.flags import Range, facts
from common.schedule import Schedule
from common.tasks import task_of
from sb3_env import NativeVecEnv

PARTS = 20  # evaluated after each such part of the samples
NUM_ENVS = 32
OF_THE_SCRIPT = ("dispersion", "mass_weight", "log_std")  # flags that are arguments of the script
SCRIPTS = {"DoubleIntegrator-v0": ppo_gtrxl_di, "RocketAscentCutoff-v0": ppo_gtrxl_rocket}


class OurFeatures(VecEnvWrapper):
    """Observations as our script's encoder sees them. `raw` are the environments' last observations (N, obs)."""

    def __init__(self, venv, script, env_id):
        constants = {name: torch.tensor(value) for name, value in script.constants(env_id).items()}
        self.script = script
        self.constants = SimpleNamespace(**constants)
        size = self(venv.observation_space.sample()[None]).shape[1]
        super().__init__(venv, observation_space=gym.spaces.Box(-np.inf, np.inf, (size,), np.float32))

    def __call__(self, obs):
        return self.script.features(self.constants, torch.as_tensor(obs, dtype=torch.float32)).numpy()

    def reset(self):
        self.raw = self.venv.reset()
        return self(self.raw)

    def step_wait(self):
        self.raw, rewards, dones, infos = self.venv.step_wait()
        for k in np.flatnonzero(dones):
            infos[k]["terminal_observation"] = self(infos[k]["terminal_observation"][None])[0]
        return self(self.raw), rewards, dones, infos


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
            training["mass_weight"] = float(self.batch.cutoff * self.args.mass_weight.at(0.0) * price)
        training["flights_per_start"] = 1  # the library compares no flights of one start
        self.batch.hand_over(training)  # not at a reset, because its rollouts end in the middle of flights

    def _on_step(self):
        return True


class OurNominalFlight(BaseCallback):
    """When a dispersed training begins, fly the nominal flight and keep it, as our script does."""

    def __init__(self, script, env_id, env_options, seen):
        super().__init__()
        self.script, self.seen = script, seen
        self.nominal = gym.make_vec(env_id, num_envs=1, **{**env_options, "dispersion": 0.0})
        self.new = len(script.DIFFERENCES)  # features that were all zero until there is a flight

    def _on_training_start(self):
        kept = vars(self.training_env)  # a part of VecNormalize, so that --save and --start keep it
        if "nominal_flight" not in kept:
            self.script.fly_nominal(self.seen.constants, make_policy(self.model, self.training_env), self.nominal)
            kept["nominal_flight"] = self.seen.constants.nominal_flight
            self._come_into_sight()
        self.seen.constants.nominal_flight = kept["nominal_flight"]

    def _on_step(self):
        return True

    @torch.no_grad()
    def _come_into_sight(self):
        """As in our script, the new features change nothing at first."""
        for weight in input_weights(self.model.policy):
            weight[:, -self.new :] = 0.0
        # after all the zeros VecNormalize would enlarge them ten thousandfold; they are of order one as they are
        seen = self.training_env.obs_rms
        seen.mean[-self.new :], seen.var[-self.new :] = 0.0, 1.0


def input_weights(policy):
    """The first weights (width, inputs) of actor and critic."""
    if hasattr(policy, "lstm_actor"):
        return [policy.lstm_actor.weight_ih_l0, policy.lstm_critic.weight_ih_l0]
    return [policy.mlp_extractor.policy_net[0].weight, policy.mlp_extractor.value_net[0].weight]


class Evaluation(BaseCallback):
    """Evaluates after each part of the samples, with as many draws of dispersed flights as our script.

    `curve` has the processor's minutes, without those of the evaluations.
    """

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
    state = None  # of an LSTM

    def policy(obs, t):
        nonlocal state
        inputs = normalised.normalize_obs(seen(obs.astype(np.float32)))
        begins = np.full(len(obs), t == 0)
        action, state = model.predict(inputs, state if t else None, begins, deterministic=True)
        return action

    return policy


def make_model(options, script, args, normalised, steps):
    """The library's learner with our first mean action and its noise, or with the parameters of --start.

    Like our script it keeps the noise of --start, unless --log-std says otherwise.
    """
    kind, policy = (RecurrentPPO, "MlpLstmPolicy") if options.recurrent else (PPO, "MlpPolicy")
    width = {"lstm_hidden_size": 64} if options.recurrent else {}
    model = kind(
        policy,
        normalised,
        learning_rate=lambda left: options.learning_rate * left,
        n_steps=steps,
        batch_size=options.batch_size,
        n_epochs=options.epochs,
        policy_kwargs={"net_arch": [64, 64], "log_std_init": args.log_std.at(0.0), **width},
        seed=options.seed,
        device="cpu",
    )
    model.policy.action_net.bias.data = torch.tensor(script.INITIAL_ACTION)
    if options.start:
        model.set_parameters(options.start)
    if options.log_std is not None:
        model.policy.log_std.data.fill_(options.log_std)
    return model


def parse_args():
    parser = OneLineParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env-id", default="DoubleIntegrator-v0", choices=SCRIPTS)
    parser.add_argument("--samples", type=integer(1, 10**9), default=2_560_000)
    parser.add_argument("--features", default="ours", choices=["ours", "raw"])
    parser.add_argument("--recurrent", action="store_true", help="an LSTM: sb3-contrib's RecurrentPPO")
    parser.add_argument("--dispersion", type=float, help="every flight another vehicle (a rocket's)")
    parser.add_argument("--mass-weight", type=float, help="highest price of a mission's mass_unit; without it none")
    parser.add_argument("--log-std", type=float, help="first log-std (default: our script's, or that of --start)")
    parser.add_argument("--batch-size", type=integer(1, 10**9), default=64)
    parser.add_argument("--epochs", type=integer(1, 10**9), default=10)
    parser.add_argument("--learning-rate", type=float, default=3e-4, help="falls linearly to zero")
    parser.add_argument("--seed", type=integer(1, 2**31 - 1), default=1, help="0 is that of the evaluation")
    parser.add_argument("--start", type=Path, help="begin with this .zip and the .pkl beside it")
    parser.add_argument("--save", type=output_file, help="write the policy as this .zip and a .pkl beside it")
    parser.add_argument("--json", type=output_file, help="write the figures there")
    options = parser.parse_args()
    script = SCRIPTS[options.env_id]
    ranges = facts(script.Args, Range)
    for name in OF_THE_SCRIPT:
        value = getattr(options, name)
        if value is None:
            continue
        flag = f"--{name.replace('_', '-')} {value}"
        if not hasattr(script.Args, name):
            parser.error(f"{flag}: only a rocket has it, not {options.env_id}")
        low, high = ranges.get(name, (-np.inf, np.inf))
        if not low <= value <= high:
            parser.error(f"{flag}: must be between {low} and {high}")
    for path in (options.start, options.start and options.start.with_suffix(".pkl")):
        if path and not path.is_file():
            parser.error(f"--start {options.start}: there is no {path}")
    return options


def main():
    options = parse_args()
    code = provenance()  # now: hours later it may be another
    torch.set_num_threads(1)
    script = SCRIPTS[options.env_id]
    args = script.Args(**{**script.recipe(script.Args(env_id=options.env_id)), "env_id": options.env_id})
    args = replace(args, log_std=script.Args.log_std, flights_per_start=1)  # the library learns its noise
    given = {name: getattr(options, name) for name in OF_THE_SCRIPT}
    args = replace(args, **{name: value for name, value in given.items() if value is not None})
    env_options = environment_options(script, args)

    batch = gym.make_vec(options.env_id, num_envs=NUM_ENVS, **env_options).unwrapped
    venv = VecMonitor(NativeVecEnv(batch))
    if options.features == "ours":
        venv = OurFeatures(venv, script, options.env_id)
    if options.start:
        normalised = VecNormalize.load(options.start.with_suffix(".pkl"), venv)
    else:
        normalised = VecNormalize(venv, clip_reward=np.inf)

    model = make_model(options, script, args, normalised, batch.episode_steps)
    evaluation = Evaluation(options.env_id, env_options, options.samples)
    callbacks = [OurCurriculum(script, args, batch, options.samples), evaluation]
    if options.dispersion and options.features == "ours":
        callbacks.append(OurNominalFlight(script, options.env_id, env_options, venv))
    model.learn(options.samples, callback=callbacks)
    print(task_of(options.env_id).table(evaluation.metrics))
    if options.save:
        model.save(options.save)
        normalised.save(options.save.with_suffix(".pkl"))
    if options.json:
        write_json(options.json, {**code, "curve": evaluation.curve, "final": evaluation.metrics})


if __name__ == "__main__":
    main()
