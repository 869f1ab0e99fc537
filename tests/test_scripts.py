"""The scripts as a user meets them: sections and imports, defaults, files and tags, resume bit for bit, bad input."""

import contextlib
import dataclasses
import errno
import hashlib
import importlib
import importlib.machinery
import io
import itertools
import json
import os
import pickle
import re
import runpy
import shlex
import shutil
import sys
import time
import types
from pathlib import Path
from types import SimpleNamespace
from typing import get_args, get_type_hints

import numpy as np
import pytest
import safetensors
import safetensors.torch
import torch
from helpers import NETWORK, TINY, parse, save
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import baselines
import envs
import runs
from common.command_line import typed_command
from common.errors import BadInput, NoOptimum
from common.fingerprint import KEY
from common.flags import Range, facts, plain_args
from common.schedule import Schedule
from drawing import animation
from phased.task import PhasedTask

torch.set_num_threads(1)
ROOT = Path(__file__).parent.parent
SCRIPTS = sorted(ROOT.glob("ppo_gtrxl_*.py"))
MODULES = [importlib.import_module(path.stem) for path in SCRIPTS]
DI, LANDER, ROCKET, VDP = MODULES
# a user's own are tested in test_problems.py
CASES = [(script, env_id) for script in MODULES for env_id in script.ENV_IDS if env_id not in envs.own_ids()]


def files(folder):
    """Every file below a folder with what it holds."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}


def run_folder():
    """The one run in the current directory."""
    (folder,) = Path("runs").iterdir()
    return folder


def scalars(folder):
    """TensorBoard's scalars: {tag: [(global step, value), ...]}."""
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    return {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


# --- the text of the scripts ------------------------------------------------------------------------------------------


def shared(text):
    """From the first section that begins with "# Shared" to the end."""
    lines = text.splitlines(keepends=True)
    return "".join(lines[next(k for k, line in enumerate(lines) if line.startswith("# Shared")) :])


# by script, the lines of the shared sections that only it has; they end with "# this problem"
ITS_OWN = {
    "ppo_gtrxl_rocket": [
        "self.sees_target = ROCKETS[args.env_id].targets is not None",
        "self.direct = None",
        "if args.direct_differences:",
        "self.direct = linear(len(DIFFERENCES), d, gain=0.0, bias=None)",
        "x = x + past_the_blocks(self, obs)",
        "x = x + past_the_blocks(self, obs)",
        "add_rewards(args, progress, training, envs, batch, episodes)",
        "saved = with_direct_path(saved, args)",
        "show_differences(agent, args, env_options)",
    ]
}


def test_shared_sections_are_the_same_but_for_the_lines_of_a_problem():
    common = set()
    for path in SCRIPTS:
        lines = shared(path.read_text()).splitlines()
        own = [line for line in lines if line.endswith("  # this problem")]
        assert [line.removesuffix("  # this problem").strip() for line in own] == ITS_OWN.get(path.stem, [])
        common.add("\n".join(line for line in lines if line not in own))
    assert len(SCRIPTS) >= 2 and len(common) == 1


# Table 1 of the paper: (double integrator, Van der Pol, rocket)
TABLE_1 = {
    "num_blocks": (3, 3, 6),
    "embed_dim": (128, 128, 384),
    "num_heads": (2, 2, 8),
    "memory_length": (32, 32, 256),
    "mlp_dim": (128, 128, 384),
    "gamma": (0.99, 0.99, 0.99),
    "gae_lambda": (0.95, 0.95, 0.95),
    "hidden_dim": (128, 256, 384),
    "total_updates": (1000, 1000, 5000),
    "update_epochs": (8, 10, 16),
    "vf_coef": (0.2, 0.2, 0.8),
    "learning_rate": ((3e-4, 3e-5), (3e-4, 3e-5), (1e-4, 5e-6)),
    "ent_coef": ((1e-3, 1e-4), (1e-3, 1e-4), (1e-3, 1e-4)),
    "clip_coef": (0.2, 0.2, 0.12),
}
TURNED_OFF = {"lr_times_std": False, "flights_per_start": 1, "weight_average": 0.0}  # what is ours


@pytest.mark.parametrize("k, script", [(0, DI), (1, VDP), (2, ROCKET)])
def test_the_papers_recipe_is_table_1(k, script):
    """Every row of its column, first and last value, and nothing of ours in the learning."""
    args = parse(script, "--recipe=paper")
    for name, row in TABLE_1.items():
        value, expected = plain_args(args)[name], row[k]
        if isinstance(expected, tuple):
            value = Schedule(value).at(0.0), Schedule(value).at(1.0)
        assert value == expected, name
    assert {name: plain_args(args)[name] for name in TURNED_OFF} == TURNED_OFF
    assert not args.log_std.has_points  # learned


def test_flags_of_the_interface():
    words = "exp_name seed torch_deterministic cuda track wandb_project_name wandb_entity capture_video save_model"
    words += " env_id learning_rate num_envs gamma gae_lambda num_minibatches update_epochs norm_adv clip_coef ent_coef"
    words += " vf_coef max_grad_norm target_kl total_updates num_blocks embed_dim num_heads memory_length mlp_dim"
    words += " hidden_dim recipe checkpoint resume eval_only eval_starts eval_seed eval_json eval_npz eval_every"
    words += " observe_phase num_threads torch_compile"
    for script in MODULES:
        assert set(words.split()) <= {field.name for field in dataclasses.fields(script.Args)}


# --- recipes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("script, env_id", CASES)
def test_a_recipe_is_what_no_flag_sets(script, env_id):
    """Of every id, and of the two that win over it: a flag and the paper's column."""
    changes = script.recipe(script.Args(env_id=env_id))
    ours = vars(script.Args(**changes))
    args, paper = parse(script, "--env-id", env_id), parse(script, "--env-id", env_id, "--recipe=paper")
    defaults = vars(script.Args(env_id=env_id))
    del defaults["recipe"], defaults["eval_starts"]
    for name, value in defaults.items():
        assert getattr(paper, name) == value, name
        assert getattr(args, name) == (ours[name] if name in changes else value), name
    assert "eval_starts" not in changes
    typed = parse(script, "--env-id", env_id, "--log-std", "0:-1", "1:-2", "--target-kl=0.5")
    assert (str(typed.log_std), typed.target_kl) == ("0:-1 1:-2", 0.5)
    assert typed.total_updates == changes["total_updates"]


@pytest.mark.parametrize("script", [DI, VDP, ROCKET])
def test_the_optimiser_is_cleanrls_adam(script, monkeypatch, tmp_path):
    """Adam with epsilon 1e-5; its learning rate is set by `train`."""
    monkeypatch.chdir(tmp_path)
    optimizers = []
    monkeypatch.setattr(script, "train", lambda args, agent, average, optimizer, *rest: optimizers.append(optimizer))
    monkeypatch.setattr(runs.Run, "__enter__", lambda run: run)
    monkeypatch.setattr(runs.Run, "__exit__", lambda run, *error: None)
    monkeypatch.setattr(runs.Run, "finish", lambda run: None)
    script.main(["--embed-dim=8", "--num-heads=2", "--num-envs=2", "--num-minibatches=1", "--flights-per-start=1"])
    (optimizer,) = optimizers
    assert type(optimizer) is torch.optim.Adam
    assert (optimizer.defaults["eps"], optimizer.defaults["betas"]) == (1e-5, (0.9, 0.999))


def test_a_rocket_without_a_policy_is_dispersed_anew(monkeypatch, capsys):
    """A vehicle that somebody registers."""
    for like in ("RocketAscentCutoff-v0", "RocketAscent-v0"):
        monkeypatch.setitem(ROCKET.RECIPES, "Mine-v0", ROCKET.RECIPES[like])
        monkeypatch.setitem(ROCKET.ROCKETS, "Mine-v0", ROCKET.ROCKETS[like])
        anew = ROCKET.recipe(ROCKET.Args(env_id="Mine-v0", dispersion=1.0))
        assert anew == ROCKET.RECIPES[like] | {"num_envs": 64, "flights_per_start": 16}
        assert "no policy of Mine-v0 to begin with, so this training begins anew" in capsys.readouterr().out
    mine = ROCKET.recipe(ROCKET.Args(env_id="Mine-v0", dispersion=1.0, checkpoint="mine.safetensors"))
    assert mine["checkpoint"] == "mine.safetensors" and mine["log_std"] == ROCKET.DISPERSED["log_std"]
    assert mine["flights_per_start"] == 16
    any_orbit = ROCKET.recipe(ROCKET.Args(env_id="RocketAscentAnyOrbit-v0", dispersion=1.0))
    assert any_orbit["flights_per_start"] == 8  # flights that share a target and a vehicle


@pytest.mark.parametrize("script", [DI, ROCKET])
def test_help_shows_what_would_be_trained(capsys, script):
    env_id = script.ENV_IDS[1]
    for more, args in (([], script.RECIPES[env_id]), (["--recipe=paper"], vars(script.Args()))):
        with pytest.raises(SystemExit) as stop:
            parse(script, "--env-id", env_id, *more, "--help")
        assert stop.value.code == 0
        words = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert re.search(rf"--total-updates INT number of updates \(default: {args['total_updates']}\)", words)


@pytest.mark.parametrize(
    "env_id, trainer", [("PendulumUpright-v0", "vdp"), ("MarsLanding-v0", "lander"), ("No-v0", None)]
)
def test_an_environment_of_another_script_is_refused_with_that_scripts_name(env_id, trainer):
    with pytest.raises(SystemExit) as stop:
        parse(DI, "--env-id", env_id)
    ours = f"error: --env-id {env_id}: must be one of DoubleIntegrator-v0, DoubleIntegratorWaypoints-v0"
    assert stop.value.code == ours + (f"; ppo_gtrxl_{trainer}.py trains {env_id}" if trainer else "")


def dispersed(*argv):
    return parse(ROCKET, "--env-id=RocketAscentCutoff-v0", "--dispersion=1", *argv)


def test_a_dispersed_training_begins_with_the_shipped_policy(monkeypatch, capsys, tmp_path):
    """Named in its recipe; a line where it is missing, or where a flag asks for another network."""
    monkeypatch.chdir(ROOT)
    args = dispersed()
    assert args.checkpoint == "results/rocket_cutoff/agent.safetensors" and str(args.log_std) == "0:-3.5 1:-6.5"
    failing = dispersed("--failure=0.25")
    assert failing.checkpoint == "results/memory/rocket/no_blocks/agent.safetensors" and failing.total_updates == 225
    assert failing.num_blocks == 0  # of its first policy
    anew = dispersed("--embed-dim=8")
    assert anew.checkpoint is None and anew.num_envs == 64
    assert str(anew.log_std) == ROCKET.RECIPES["RocketAscentCutoff-v0"]["log_std"]  # not that of a trained policy
    said = capsys.readouterr().out
    assert re.match("--embed-dim 8: .*results/rocket_cutoff.* has another\n.* begins anew", said)
    assert dispersed("--recipe=paper").checkpoint is None
    monkeypatch.chdir(tmp_path)
    assert dispersed().checkpoint == str(ROOT / "results/rocket_cutoff/agent.safetensors")
    monkeypatch.setitem(ROCKET.FIRST_POLICY, "RocketAscentCutoff-v0", "results/none/agent.safetensors")
    with pytest.raises(SystemExit) as stop:
        dispersed()
    assert re.match("error: .*results/none/agent.safetensors, which is not there: .*--checkpoint", stop.value.code)
    assert "\n" not in stop.value.code


@pytest.mark.parametrize("script, starts, brief", [(DI, 1000, 50), (ROCKET, 1000, 50), (LANDER, 10000, 10)])
def test_a_training_cut_short_is_evaluated_briefly(script, starts, brief):
    assert parse(script).eval_starts == starts
    assert parse(script, "--total-updates=2").eval_starts == brief
    assert parse(script, "--total-updates=2", "--eval-starts=99").eval_starts == 99


# --- a run's files ----------------------------------------------------------------------------------------------------

CHARTS = {f"charts/{name}" for name in ("episodic_return", "episodic_length", "learning_rate", "SPS")}
LOSSES = "value_loss policy_loss entropy old_approx_kl approx_kl clipfrac explained_variance total_loss"
LOSSES += " baseline_explained_variance gradient_norm"
CLOCKS = {"training_seconds", "wall_seconds"}
RUN_FILES = {"args.json", "training_state.pt", "agent.safetensors", "eval.json", "eval.npz"}
COMMON_KEYS = "env_id seed eval_seed eval_starts checkpoint_sha256 total_updates global_step wall_seconds device"
COMMON_KEYS += " training_seconds torch_version episodic_return reference_episodic_return"
LANDER_KEYS = """landed_rate position_error_mean_m position_error_max_m speed_mean_m_s speed_max_m_s fuel_mean_kg
    reference_starts reference_fuel_mean_kg fuel_ratio"""

# each script and each kind of table once: the least and the most steps of an episode, and a word of its table
SMOKED = {
    "DoubleIntegrator-v0": (50, 50, "ratio"),
    "VanDerPolWaypoints-v0": (140, 140, "ratio"),
    "RocketAscentCutoff-v0": (1, 481, "difference"),
    "PoweredDescent-v0": (1, 250, "Propellant ours / optimum"),
}


@pytest.fixture(scope="module", params=SMOKED)
def smoke(request, tmp_path_factory):
    """A training of two updates of four episodes: its script, folder, id and what it printed."""
    env_id, folder = request.param, tmp_path_factory.mktemp("smoke")
    (script,) = [script for script in MODULES if env_id in script.ENV_IDS]
    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()) as printed:
        script.main([*NETWORK, "--env-id", env_id, "--total-updates=2", "--num-envs=4", "--eval-starts=10"])
    return script, folder, env_id, printed.getvalue()


def steps_flown(run, env_id):
    """Environment steps after each of the two updates of 4 episodes."""
    lengths = np.array([value for _, value in scalars(run)["charts/episodic_length"]])
    low, high, _ = SMOKED[env_id]
    assert lengths.shape == (2,) and lengths.min() >= low and lengths.max() <= high
    return np.cumsum(4 * lengths).round().astype(int).tolist()


@pytest.mark.slow
def test_smoke_run_writes_what_the_interface_names(smoke):
    script, folder, env_id, output = smoke
    (run,) = (folder / "runs").iterdir()
    assert re.fullmatch(rf"{env_id}__{Path(script.__file__).stem}__1__\d+", run.name)
    names = {path.name for path in run.iterdir()}
    events = {name for name in names if name.startswith("events.out.tfevents.")}
    assert len(events) == 1 and names - events == RUN_FILES
    assert os.listdir(folder) == ["runs"]
    metrics = json.loads((run / "eval.json").read_text())
    own = LANDER_KEYS if script is LANDER else ""
    assert {*COMMON_KEYS.split(), *own.split()} <= metrics.keys()
    assert (metrics["env_id"], metrics["seed"], metrics["eval_seed"]) == (env_id, 1, 0)
    assert (metrics["total_updates"], metrics["global_step"]) == (2, steps_flown(run, env_id)[-1])
    assert metrics["checkpoint_sha256"] == hashlib.sha256((run / "agent.safetensors").read_bytes()).hexdigest()
    assert all(word in output for word in ("optimum", "ours", SMOKED[env_id][-1]))


@pytest.mark.slow
def test_smoke_run_logs_the_tags(smoke):
    script, folder, env_id, _ = smoke
    (run,) = (folder / "runs").iterdir()
    metrics, logged = json.loads((run / "eval.json").read_text()), scalars(run)
    numbers = {f"eval/{key}": value for key, value in metrics.items() if not isinstance(value, str)}
    assert logged.keys() == CHARTS | {f"losses/{name}" for name in LOSSES.split()} | numbers.keys()
    updates = steps_flown(run, env_id)
    assert all([step for step, _ in logged[tag]] == updates for tag in logged if not tag.startswith("eval/"))
    for tag, value in numbers.items():
        ((step, shown),) = logged[tag]
        assert step == updates[-1] and shown == pytest.approx(float(value), rel=1e-6), tag
    rates = [value for _, value in logged["charts/learning_rate"]]
    args = script.Args(**script.recipe(script.Args(env_id=env_id)))
    expected = [args.learning_rate.at(end) * np.exp(args.log_std.at(end)) for end in (0.0, 1.0)]
    assert rates == pytest.approx(expected, rel=1e-6)


def test_what_is_logged_is_what_was_flown_and_learned(tmp_path, monkeypatch, capsys):
    """Every loss, and the mean return as the environment has it, unscaled; the printed lines say the same."""
    monkeypatch.chdir(tmp_path)
    seen, end_update = [], runs.Run.end_update
    record = lambda run, *inputs: [seen.append(inputs), end_update(run, *inputs)]  # noqa: E731
    monkeypatch.setattr(runs.Run, "end_update", record)
    DI.main([*TINY, "--total-updates=2", "--eval-every=0"])
    logged = scalars(run_folder())
    printed = re.findall(r"^update .*return +(\S+)  cost.*  hits +\d+%", capsys.readouterr().out, flags=re.MULTILINE)
    assert len(seen) == len(printed) == 2
    for k, (_, _, episodes, losses, _) in enumerate(seen):
        assert losses["value_loss"] > 0 and losses.keys() == set(LOSSES.split())
        for name, value in losses.items():
            assert logged[f"losses/{name}"][k][1] == pytest.approx(value, rel=1e-6), name
        mean = 40.0 * episodes["hit"].mean() - episodes["cost"].mean()  # the bonus of the circle, less J
        assert logged["charts/episodic_return"][k][1] == pytest.approx(mean, rel=1e-6)
        assert float(printed[k]) == pytest.approx(mean, abs=0.01)


def test_flags_of_the_machine(tmp_path, monkeypatch):
    """They reach torch, and Weights and Biases where it is there."""
    monkeypatch.chdir(tmp_path)
    compiled, tracked, threads = [], [], torch.get_num_threads()
    monkeypatch.setattr(torch, "compile", lambda function: [compiled.append(function.__name__), function][1])
    monkeypatch.setattr(torch.backends.cudnn, "deterministic", True)
    wandb = types.ModuleType("wandb")
    wandb.__spec__, wandb.init = importlib.machinery.ModuleSpec("wandb", None), lambda **names: tracked.append(names)
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    flags = ["--torch-compile", "--num-threads=1", "--no-torch-deterministic", "--track", "--wandb-project-name=mine"]
    torch.set_num_threads(2)
    try:
        DI.main([*TINY, "--total-updates=1", *flags])
        assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(threads)
    assert compiled == ["encode", "encode_step"] and not torch.backends.cudnn.deterministic
    (names,) = tracked
    assert (names["project"], names["name"]) == ("mine", run_folder().name)
    assert (names["id"], names["resume"]) == (run_folder().name, "allow")  # a resumed run goes on with it


@pytest.mark.slow
def test_smoke_run_saves_the_averaged_weights(smoke):
    _, folder, env_id, _ = smoke
    (run,) = (folder / "runs").iterdir()
    state = torch.load(run / "training_state.pt", weights_only=True)
    with safetensors.safe_open(run / "agent.safetensors", "pt") as file:
        metadata, weights = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}
    assert metadata.keys() == {"env_id", "args", "seed", "total_updates", "global_step", KEY, *CLOCKS}
    assert json.loads(metadata["args"]) == json.loads((run / "args.json").read_text()) == state["args"]
    assert (metadata["env_id"], metadata["seed"], metadata["total_updates"]) == (env_id, "1", "2")
    assert metadata["global_step"] == str(steps_flown(run, env_id)[-1])
    assert 0 < float(metadata["training_seconds"]) <= float(metadata["wall_seconds"])
    assert weights.keys() == state["agent"].keys()
    for name, tensor in weights.items():
        assert torch.equal(tensor, state["average"][f"module.{name}"]), name
    assert not torch.equal(weights["actor.0.weight"], state["agent"]["actor.0.weight"])


@pytest.mark.slow
def test_eval_only_repeats_the_runs_evaluation(smoke, tmp_path, monkeypatch, capsys):
    """Same checkpoint and starts: the same numbers to the last bit, and only the named files."""
    script, folder, env_id, output = smoke
    monkeypatch.chdir(tmp_path)
    (run,) = (folder / "runs").iterdir()
    argv = ["--eval-only", f"--checkpoint={run / 'agent.safetensors'}", "--eval-starts=10"]
    script.main([*argv, "--eval-json=a.json", "--eval-npz=a.npz"])
    assert sorted(os.listdir()) == ["a.json", "a.npz"]
    assert json.loads(Path("a.json").read_text()) == json.loads((run / "eval.json").read_text())
    with np.load("a.npz") as again, np.load(run / "eval.npz") as first:
        assert again.keys() == first.keys()
        assert all(np.array_equal(again[key], first[key], equal_nan=True) for key in first)
    table = output[output.index(f"{env_id}: ") : output.rindex("run folder: ")]
    assert table in capsys.readouterr().out


@pytest.fixture(scope="module", autouse=True)
def few_frames():
    """Of an animation; the others are drawn alike."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(animation, "FRAMES", 3)
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a finished tiny run of the double integrator, with figures."""
    folder = tmp_path_factory.mktemp("trained")
    with contextlib.chdir(folder):
        DI.main([*TINY, "--total-updates=2", "--capture-video", "--no-observe-phase"])
    (run,) = (folder / "runs").iterdir()
    return run


@pytest.mark.slow
def test_capture_video_draws_the_figures_and_the_animation(trained):
    names = {"training.png", "trajectories.png", "costs.png", "cost_error.png", "animation.gif"}
    assert {path.name for path in (trained / "figures").iterdir()} == names
    heads = {".png": b"\x89PNG", ".gif": b"GIF89a"}
    assert all(path.read_bytes().startswith(heads[path.suffix]) for path in (trained / "figures").iterdir())


def test_hyperparameters_are_logged_as_text(trained):
    """CleanRL's table of all arguments."""
    events = EventAccumulator(str(trained))
    events.Reload()
    (event,) = events.Tensors("hyperparameters/text_summary")
    (text,) = event.tensor_proto.string_val
    args = json.loads((trained / "args.json").read_text())
    assert text.decode().splitlines() == ["|param|value|", "|-|-|", *(f"|{k}|{v}|" for k, v in args.items())]


@pytest.mark.slow
def test_run_folder_is_printed_at_the_start_and_the_end(smoke):
    _, folder, _, output = smoke
    (run,) = (folder / "runs").iterdir()
    line = f"run folder: {run.relative_to(folder)}"
    lines = [printed for printed in output.splitlines() if "lowered from" not in printed]
    assert lines[0] == lines[-1] == line and output.count(line) == 2


@pytest.mark.slow
def test_two_runs_within_a_second(tmp_path, monkeypatch):
    """Another run of this script has begun in this second, and in the next: this one waits for its own."""
    monkeypatch.chdir(tmp_path)
    now = int(time.time())
    taken = {Path(f"runs/DoubleIntegrator-v0__ppo_gtrxl_di__1__{second}") for second in (now, now + 1)}
    for folder in taken:
        folder.mkdir(parents=True)
    DI.main([*TINY, "--total-updates=1"])
    (run,) = set(Path("runs").iterdir()) - taken
    assert (run / "eval.json").exists() and not any(os.listdir(folder) for folder in taken)
    assert int(run.name.split("__")[-1]) >= now + 2


def test_no_save_model_writes_events_only(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    DI.main([*TINY, "--total-updates=1", "--no-save-model"])
    names = {path.name for path in run_folder().iterdir()}
    assert len(names) == 1 and names.pop().startswith("events.")
    assert "eval/ratio_of_sums" in scalars(run_folder())


def test_flags_that_do_not_do_what_they_seem_to_say_so(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shipped = [f"--checkpoint={ROOT / 'results' / 'di' / 'agent.safetensors'}", "--eval-only", "--eval-starts=10"]
    for seed, warned in ((1, True), (2, False)):  # it was trained with --seed 1
        DI.main([*shipped, f"--eval-seed={seed}"])
        assert ("it may have flown these starts" in capsys.readouterr().out) == warned


def test_eval_only_defaults(trained, tmp_path, monkeypatch):
    """1000 starts; architecture and observation from the checkpoint; without a path nothing is written."""
    monkeypatch.chdir(tmp_path)
    asked = []

    def evaluate(task, policy, eval_seed, n, **options):
        asked.append((task.env_id, eval_seed, n, options))
        policy(np.zeros((n, 3)), 0)
        return {"env_id": task.env_id}, {}

    monkeypatch.setattr(PhasedTask, "evaluate", evaluate)
    monkeypatch.setattr(PhasedTask, "table", lambda task, metrics: "")
    DI.main(["--eval-only", f"--checkpoint={trained / 'agent.safetensors'}", "--embed-dim=8", "--eval-seed=7"])
    options = {"observe_phase": False, "observe_velocity": True, "scaled_action": True}
    assert asked == [("DoubleIntegrator-v0", 7, 1000, options)]
    assert os.listdir() == []


def test_checkpoint_starts_training_from_its_weights(trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    checkpoint = trained / "agent.safetensors"
    DI.main([*TINY, f"--checkpoint={checkpoint}", "--total-updates=1", "--learning-rate=0", "--recipe=paper"])
    first, second = (safetensors.torch.load_file(path / "agent.safetensors") for path in (trained, run_folder()))
    torch.testing.assert_close(second, first, rtol=1e-6, atol=1e-8)  # the average of equal weights rounds


def test_log_std_of_a_checkpoint_and_of_the_user(trained, fresh_folder, monkeypatch):
    """What the first rollout samples with: the checkpoint's where it is learned, with --log-std that of the flag."""
    seen = []

    def rollout(agent, *inputs):
        seen.append(agent.actor_logstd.item())
        raise KeyboardInterrupt

    monkeypatch.setattr(DI, "rollout", rollout)
    checkpoint = trained / "agent.safetensors"
    flags = {
        "kept": ["--recipe=paper"],
        "learned": ["--recipe=paper", "--log-std=-1.5"],
        "whole": ["--recipe=paper", "--log-std=0"],
        "set": ["--log-std", "0:-2", "1:-3"],
    }
    for name, argv in flags.items():
        fresh_folder(name)
        with pytest.raises(KeyboardInterrupt):
            DI.main([*TINY, f"--checkpoint={checkpoint}", "--total-updates=1", *argv])
    assert seen == [safetensors.torch.load_file(checkpoint)["actor_logstd"].item(), -1.5, 0.0, -2.0]


def test_eval_every_uses_starts_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    seeds, evaluate = [], PhasedTask.evaluate
    monkeypatch.setattr(PhasedTask, "evaluate", lambda *a, **k: [seeds.append(a[2]), evaluate(*a, **k)][1])
    DI.main([*TINY, "--total-updates=3", "--eval-every=2", "--eval-seed=5"])
    assert len(seeds) == 2 and seeds[1] == 5
    assert seeds[0] > facts(DI.Args, Range)["eval_seed"].high  # no --eval-seed reaches it
    assert [step for step, _ in scalars(run_folder())["eval/ratio_of_sums"]] == [200, 300]


@pytest.mark.parametrize("eval_every", [0, 2])
def test_the_reported_starts_have_an_optimum_before_anything_is_learned(tmp_path, monkeypatch, eval_every):
    def refuse(env_id, x0, draw):
        if np.array_equal(x0, baselines.starts(77, 10)):
            raise NoOptimum("start 3 has none")
        return reference(env_id, x0)

    monkeypatch.chdir(tmp_path)
    reference = baselines.reference
    monkeypatch.setattr(baselines, "reference", refuse)
    with pytest.raises(NoOptimum):
        DI.main([*TINY, "--total-updates=3", f"--eval-every={eval_every}", "--eval-seed=77"])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("seed", [0, 3])
def test_no_evaluated_start_is_trained_on(seed):
    """Also where the seeds are the same: both draw uniformly from a generator of that seed."""
    args = DI.Args(seed=seed, eval_seed=seed, num_envs=40)
    first_starts = runs.make_envs(args, {}).reset()[0][:, :2]
    evaluated = baselines.starts(seed, 1000)
    assert not np.isin(first_starts, evaluated).any()


def test_run_averages_with_its_decay(tmp_path, monkeypatch):
    """The saved weights are the exponential average, by hand, of the agent's after every optimiser step."""
    monkeypatch.chdir(tmp_path)
    decay, weights, update = 0.9, [], DI.AveragedModel.update_parameters

    def record(average, agent):
        weights.append({name: tensor.clone() for name, tensor in agent.state_dict().items()})
        update(average, agent)

    monkeypatch.setattr(DI.AveragedModel, "update_parameters", record)
    DI.main([*TINY, "--total-updates=2", f"--weight-average={decay}"])
    saved = safetensors.torch.load_file(run_folder() / "agent.safetensors")
    assert len(weights) == 8
    for name, tensor in saved.items():
        average = weights[0][name]
        for current in weights[1:]:
            average = decay * average + (1 - decay) * current[name]
        torch.testing.assert_close(tensor, average, rtol=1e-5, atol=1e-7)


# --- the rocket -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ["RocketAscent-v0", "TwoStageLEO-v0"])
def test_phases_are_one_hot_whatever_their_number(env_id):
    """The environment shows the phases as 0, 1 / (n - 1) .. 1."""
    buffers = ROCKET.constants(env_id)
    number = len(ROCKET.ROCKETS[env_id].rocket.burns)
    agent = SimpleNamespace(sees_target=False, **{name: torch.tensor(value) for name, value in buffers.items()})
    obs = torch.tensor([[6.4e6, 0.0, 0.0, 0.0, 7e3, 0.0, 1e4, 0.5, phase] for phase in np.linspace(0, 1, number)])
    seen = ROCKET.features(agent, obs.float())
    (columns,) = np.nonzero((seen != seen[0]).any(0).numpy())
    assert len(columns) == number and torch.equal(seen[:, columns], torch.eye(number))


# --- seeds and resume -------------------------------------------------------------------------------------------------


def state_of(folder):
    """The training state without what may differ between equal trainings: wall time and the --resume flag."""
    state = torch.load(Path(folder) / "training_state.pt", weights_only=True)
    for name in CLOCKS:
        del state["progress"][name]
    del state["args"]["resume"]
    return state


def assert_same_bits(one, other):
    """Nested dicts and lists of tensors and values: equal in structure and in every bit."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        one, other = list(one.values()), list(other.values())
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other)
    elif isinstance(one, list | tuple):
        assert len(one) == len(other)
        for a, b in zip(one, other):
            assert_same_bits(a, b)
    else:
        assert one == other


@pytest.fixture
def fresh_folder(tmp_path, monkeypatch):
    """A function that changes into a new empty directory."""

    def change(name):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)

    return change


def stop_in_update(monkeypatch, number, error, losses_before=3, script=DI):
    """Raise `error` in the middle of update `number`: the weights have moved since its start."""
    loss, calls = script.ppo_loss, []

    def stops(*inputs):
        calls.append(1)
        if len(calls) == 4 * (number - 1) + 1 + losses_before:  # TINY has 4 minibatches an update
            monkeypatch.setattr(script, "ppo_loss", loss)
            raise error
        return loss(*inputs)

    monkeypatch.setattr(script, "ppo_loss", stops)


def test_a_seed_gives_the_bits_of_a_training(fresh_folder, monkeypatch):
    """Also of one that is evaluated on its way. Another seed begins with other weights and ends with others."""
    first, train = [], DI.train

    def record(args, agent, *rest):
        first.append(agent.actor[0].weight.detach().clone())
        return train(args, agent, *rest)

    monkeypatch.setattr(DI, "train", record)
    states = []
    for name, seed, every in (("one", 3, 0), ("evaluated", 3, 1), ("other", 4, 0)):
        fresh_folder(name)
        DI.main([*TINY, "--total-updates=2", f"--seed={seed}", f"--eval-every={every}"])
        states.append(state_of(run_folder()))
        del states[-1]["args"]["eval_every"]
    assert_same_bits(states[0], states[1])
    assert not torch.equal(states[0]["agent"]["actor.0.weight"], states[2]["agent"]["actor.0.weight"])
    assert torch.equal(first[0], first[1]) and not torch.equal(first[0], first[2])


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """The state, scalars and evaluation after 4 updates in one go. From the third on, flights share their start."""
    starts, rollout = [], DI.rollout

    def record(*inputs):
        batch, episodes = rollout(*inputs)
        starts.append(batch.obs[0, :, :2])
        return batch, episodes

    with contextlib.chdir(tmp_path_factory.mktemp("uninterrupted")), pytest.MonkeyPatch.context() as patch:
        patch.setattr(DI, "rollout", record)
        DI.main([*TINY, "--total-updates=4"])
        assert [len(start.unique(dim=0)) for start in starts] == [2, 2, 1, 1]
        return state_of(run_folder()), scalars(run_folder()), json.loads((run_folder() / "eval.json").read_text())


def assert_resumes(uninterrupted):
    """`--resume` the run in the current directory: bits, curve and evaluation are those of the uninterrupted run."""
    state, curve, metrics = uninterrupted
    run = run_folder()
    DI.main([f"--resume={run}"])
    assert run_folder() == run
    assert_same_bits(state_of(run), state)
    resumed = json.loads((run / "eval.json").read_text())
    for key in metrics.keys() - {*CLOCKS, "checkpoint_sha256"}:
        assert resumed[key] == metrics[key], key
    for tag, values in scalars(run).items():
        if tag not in ("charts/SPS", "eval/training_seconds", "eval/wall_seconds"):
            assert values == curve[tag], tag  # no step twice


def test_ctrl_c_and_resume(uninterrupted, fresh_folder, monkeypatch, capsys):
    """Ctrl-C in the third of four updates: two whole updates saved, the same bits in the end."""
    fresh_folder("ctrl_c")
    stop_in_update(monkeypatch, 3, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        DI.main([*TINY, "--total-updates=4"])
    assert f"--resume {run_folder()}" in capsys.readouterr().out
    assert state_of(run_folder())["progress"]["total_updates"] == 2
    assert not (run_folder() / "eval.json").exists()
    assert_resumes(uninterrupted)


@pytest.mark.slow
def test_a_dispersed_rocket_is_resumed_bit_for_bit(tmp_path, fresh_folder, monkeypatch, capsys):
    """With what only it has: draws, failures, the noise's own stream, and the nominal flight in both networks.

    It begins with a policy of the other variant, and a line says so.
    """
    save(ROCKET, tmp_path)
    argv = [*TINY, "--env-id=RocketAscentCutoff-v0", f"--checkpoint={tmp_path / 'agent.safetensors'}"]
    argv += ["--total-updates=2", "--eval-every=0", "--dispersion=1", "--failure=0.2", "--memory-length=5"]
    argv += ["--navigation-noise", "10", "0.1"]
    fresh_folder("whole")
    ROCKET.main(argv)
    assert "--checkpoint is of RocketAscent-v0; it goes on with RocketAscentCutoff-v0" in capsys.readouterr().out
    whole = state_of(run_folder())
    fresh_folder("stopped")
    stop_in_update(monkeypatch, 2, KeyboardInterrupt(), script=ROCKET)
    with pytest.raises(KeyboardInterrupt):
        ROCKET.main(argv)
    ROCKET.main([f"--resume={run_folder()}"])
    assert_same_bits(state_of(run_folder()), whole)
    assert whole["rng"][0].keys() == {"torch", "envs", "navigation", "cuda"}
    assert whole["agent"]["nominal_flight"].any() and whole["average"]["module.nominal_flight"].any()
    assert whole["agent"]["direct.weight"].any() and whole["average"]["module.direct.weight"].any()


def test_resume_after_a_crash(uninterrupted, fresh_folder, monkeypatch):
    """Killed in the fourth update, saved after the second: the third is flown again."""
    fresh_folder("crash")
    monkeypatch.setattr(runs, "SAVE_EVERY", 2)
    monkeypatch.setattr(runs.Run, "__exit__", lambda *error: None)  # as a killed process leaves it
    stop_in_update(monkeypatch, 4, RuntimeError("killed"))
    with pytest.raises(RuntimeError, match="killed"):
        DI.main([*TINY, "--total-updates=4"])
    assert state_of(run_folder())["progress"]["total_updates"] == 2
    assert_resumes(uninterrupted)


def test_an_error_saves_what_was_learned(fresh_folder, monkeypatch):
    fresh_folder("error")
    stop_in_update(monkeypatch, 4, RuntimeError("out of memory"))
    with pytest.raises(RuntimeError, match="out of memory"):
        DI.main([*TINY, "--total-updates=4"])
    assert state_of(run_folder())["progress"]["total_updates"] == 3


def test_an_interrupted_evaluation_is_made_again(fresh_folder, monkeypatch, capsys):
    """Its update is not counted yet, so that no row of TensorBoard is missing after the resume."""
    fresh_folder("in_an_evaluation")
    evaluated, evaluate_run = [], runs.Run.evaluate

    def interrupted(run, eval_seed):
        evaluated.append(run.updates_done)
        if len(evaluated) == 2:
            raise KeyboardInterrupt
        return evaluate_run(run, eval_seed)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(runs.Run, "evaluate", interrupted)
        DI.main([*TINY, "--total-updates=4", "--eval-every=1", "--exp-name=mine"])
    assert f"ppo_gtrxl_di.py --resume {run_folder()}" in capsys.readouterr().out
    assert state_of(run_folder())["progress"]["total_updates"] == 1
    DI.main([f"--resume={run_folder()}"])
    for tag in ("losses/policy_loss", "eval/ratio_of_sums"):
        steps = [step for step, _ in scalars(run_folder())[tag]]
        assert steps[:4] == [100, 200, 300, 400]  # the fifth is the reported evaluation


@pytest.mark.slow
def test_seconds_of_training_and_of_all(fresh_folder, monkeypatch):
    """An evaluation is no training; both are summed over a resume, which does not count the pause before it."""
    fresh_folder("seconds")
    evaluate = PhasedTask.evaluate
    monkeypatch.setattr(PhasedTask, "evaluate", lambda *a, **k: [time.sleep(0.3), evaluate(*a, **k)][1])
    stop_in_update(monkeypatch, 3, KeyboardInterrupt())
    began = time.time()
    with pytest.raises(KeyboardInterrupt):
        DI.main([*TINY, "--total-updates=4", "--eval-every=1"])
    first = torch.load(run_folder() / "training_state.pt", weights_only=True)["progress"]
    assert 0 < first["training_seconds"] <= first["wall_seconds"] - 0.3 < time.time() - began
    pause = 1.0
    time.sleep(pause)
    DI.main([f"--resume={run_folder()}"])
    last = json.loads((run_folder() / "eval.json").read_text())
    for name in CLOCKS:
        assert first[name] < last[name] < time.time() - began - pause, name
    assert 0.6 < last["wall_seconds"] - last["training_seconds"]  # two updates after which it was evaluated


def test_a_clock_that_is_set_back_changes_no_duration(fresh_folder, monkeypatch):
    fresh_folder("clock")
    clock = itertools.count(1_800_000_000, -3600)
    monkeypatch.setattr(time, "time", lambda: next(clock))
    DI.main([*TINY, "--total-updates=2"])
    metrics = json.loads((run_folder() / "eval.json").read_text())
    assert 0 < metrics["training_seconds"] <= metrics["wall_seconds"] < 600


def test_a_run_folder_is_one_processs(tmp_path, capsys):
    """The lock is of another open file, as another process has it, and goes with the file."""
    fcntl = pytest.importorskip("fcntl")
    other = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(other, fcntl.LOCK_EX)
    with pytest.raises(SystemExit, match=f"^error: --resume {tmp_path}: another process trains in this folder"):
        runs.lock_folder(tmp_path)
    os.close(other)  # as at the end of a process, also of a killed one
    runs.lock_folder(tmp_path)
    runs.lock_folder(tmp_path)  # the next run of the same process
    other = os.open(tmp_path, os.O_RDONLY)
    with pytest.raises(BlockingIOError):
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    runs.unlock_folder()
    fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.close(other)


def test_a_run_that_trains_is_not_resumed(trained, tmp_path, monkeypatch):
    run = Path(shutil.copytree(trained, tmp_path / "my run"))
    runs.lock_folder(run)
    before = files(run)
    monkeypatch.setattr(runs, "locked", of_another := [])
    with pytest.raises(SystemExit, match="^error: --resume .*my run: another process trains in this folder"):
        DI.main([f"--resume={run}"])
    assert files(run) == before and not of_another
    monkeypatch.undo()
    runs.unlock_folder()


@pytest.mark.parametrize("here", ["", "results/di", "/"])
def test_a_printed_command_works_where_it_is_printed(monkeypatch, here):
    monkeypatch.chdir(ROOT / here)
    line = typed_command("ppo_gtrxl_di.py", "--resume", Path("runs/my run"))
    python, script, *flags = shlex.split(line)
    assert python == "python" and (Path.cwd() / script).resolve() == SCRIPTS[0]
    assert flags == ["--resume", "runs/my run"]
    assert here or script == "ppo_gtrxl_di.py"
    processes = {"RANK": 0, "LOCAL_RANK": 0, "WORLD_SIZE": 2, "LOCAL_WORLD_SIZE": 2, "GROUP_WORLD_SIZE": 1}
    for name, value in processes.items():
        monkeypatch.setenv(name, str(value))
    line = typed_command("ppo_gtrxl_di.py", "--resume", "runs/x")
    assert shlex.split(line) == ["torchrun", "--nproc-per-node=2", script, "--resume", "runs/x"]


def test_a_full_disk_names_what_tensorboard_writes(tmp_path):
    """Its thread's errors name no file."""

    def no_space(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    writer = SimpleNamespace(add_scalar=no_space)
    run = SimpleNamespace(folder=tmp_path, writer=writer, counters={"global_step": 1})
    with pytest.raises(OSError, match=f"No space left on device: '{tmp_path}'"):
        runs.Run.log(run, "eval", {"cost_mean": 1.0})


def test_nan_keeps_and_names_the_last_good_checkpoint(fresh_folder, monkeypatch):
    """A NaN in the third update: one line names update, term and folder, which holds the state after the second."""
    fresh_folder("nan")
    rollout, calls = DI.rollout, []

    def breaks(*inputs):
        batch, episodes = rollout(*inputs)
        calls.append(1)
        if len(calls) == 3:
            batch.rewards[5, 1] = torch.nan
        return batch, episodes

    monkeypatch.setattr(DI, "rollout", breaks)
    with pytest.raises(SystemExit) as stop:
        DI.main([*TINY, "--total-updates=4"])
    message = stop.value.code
    assert "\n" not in message and "update 3: policy_loss is nan in epoch 1, minibatch" in message
    assert str(run_folder()) in message
    state = state_of(run_folder())
    assert state["progress"]["total_updates"] == 2
    assert all(tensor.isfinite().all() for tensor in state["agent"].values())
    weights = safetensors.torch.load_file(run_folder() / "agent.safetensors")
    assert all(tensor.isfinite().all() for tensor in weights.values())


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.fixture
def refuses(tmp_path, monkeypatch, capsys):
    """Start a script as a program: it must end with one line and exit code 1 and write nothing. Returns the line."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)

    def trains(optimizer):
        pytest.fail("the script trains")  # at once, instead of after a thousand updates

    monkeypatch.setattr(torch.optim.Adam, "step", trains)

    def start(*argv, script=DI):
        before = files(tmp_path)
        monkeypatch.setattr(sys, "argv", [script.__file__, *map(str, argv)])
        with pytest.raises(SystemExit) as stop:
            runpy.run_path(script.__file__, run_name="__main__")
        message = stop.value.code  # a text as exit code: Python prints it on stderr and exits with 1
        assert isinstance(message, str) and message.startswith("error: ") and "\n" not in message
        assert files(tmp_path) == before and not Path("runs").is_dir()
        assert capsys.readouterr().err == ""
        return message

    return start


def flag(name):
    return f"--{name.replace('_', '-')}"


FIELDS = {field.name: (module, field) for module in reversed(MODULES) for field in dataclasses.fields(module.Args)}
RANGES = {name: bounds for module in MODULES for name, bounds in facts(module.Args, Range).items()}
NUMBERS = [FIELDS[name] for name in FIELDS if name in RANGES]
POSITIVE = "total_updates num_envs num_minibatches update_epochs embed_dim num_heads mlp_dim hidden_dim"
POSITIVE += " eval_starts reward_scale max_grad_norm target_kl flights_per_start"


@pytest.mark.parametrize("module, field", NUMBERS, ids=[field.name for _, field in NUMBERS])
def test_every_number_has_a_range(module, field):
    """NaN, infinities and absurd values in every numeric flag, and zero where nothing can be of size zero."""
    values = ["-9", "1" + "0" * 20] + (["0"] if field.name in POSITIVE.split() else [])
    if isinstance(RANGES[field.name].low, float) or isinstance(field.default, Schedule):
        values += ["nan", "inf", "-inf"]
    for value in values:
        with pytest.raises(SystemExit) as stop:
            parse(module, f"{flag(field.name)}={value}")
        message = stop.value.code
        low, high = re.search(r"must be between (\S+) and (\S+)$", message).groups()
        assert re.match(rf"error: {flag(field.name)} \S+: ", message), message
        number = float(re.search(r" (\S+): ", message).group(1))
        assert number == float(value) or np.isnan(number) and value == "nan"
        assert np.isfinite([float(low), float(high)]).all() and not float(low) <= number <= float(high)


def test_numbers_are_all_there():
    """Every flag of numbers has a range."""
    for module in MODULES:
        hints = get_type_hints(module.Args)
        numeric = {name for name, hint in hints.items() if {int, float, Schedule} & {hint, *get_args(hint)}}
        assert numeric == facts(module.Args, Range).keys()


@pytest.mark.parametrize("argv", [["--num-envs", "nan"], ["--num-envs", "2.5"], ["--gamma", "x"], ["--no-such-flag"]])
def test_what_is_no_number_and_no_flag(refuses, argv):
    assert argv[0] in refuses(*argv)


FLOWN = ["--eval-only", "--checkpoint", ROOT / "results" / "di" / "agent.safetensors"]


@pytest.mark.parametrize(
    "argv, line",
    [
        (["--recipe=mine"], "--recipe mine: must be one of "),
        (["--gamma", 1.5], "--gamma 1.5: must be between 0.0 and 1.0"),
        (["--gae-lambda", 1.5], "--gae-lambda 1.5: must be between 0.0 and 1.0"),
        (["--clip-coef", 1.5], "--clip-coef 1.5: must be between 0.0 and 1.0"),
        (["--learning-rate", 1.5], "--learning-rate 1.5: must be between 0.0 and 1.0"),
        (["--weight-average=1"], "--weight-average 1.0: must be between 0.0 and 0.99999"),
        (["--num-heads", 3], "--num-heads 3: must divide --embed-dim 128"),
        (["--embed-dim", 9], "--num-heads 2: must divide --embed-dim 9"),
        (["--num-envs", 4, "--num-minibatches", 5], "--num-minibatches 5: must be at most --num-envs 4"),
        (["--num-envs", 4, "--num_minibatches=8"], "--num-minibatches 8: must be at most --num-envs 4"),
        (["--num-envs", 80, "--flights-per-start", 3], "--flights-per-start 3: must divide --num-envs 80"),
        (["--num-envs", 4, "--flights-per-start=8"], "--flights-per-start 8: must divide --num-envs 4"),
        (["--num-envs", 8, "--flights-per-start", "0:1", "1:4"], "must divide --num-envs 8; it is 3 in one update"),
        (["--log-std", "0:-1", "0.4:-2:-7"], "--log-std: 0:-1 0.4:-2:-7: must be a number, or points as"),
        (["--log-std", "0:-1:-2", "0.4:-2:-7"], "--log-std: 0:-1:-2 0.4:-2:-7: must be a number, or points as"),
        (["--eval-only"], "--checkpoint"),
        (["--eval-json", "a.json"], "--eval-json a.json: only with --eval-only"),
        (["--eval-npz", "a.npz"], "--eval-npz a.npz: only with --eval-only"),
        ([*FLOWN, "--eval-npz=nowhere/file"], "--eval-npz nowhere/file: "),
        ([*FLOWN, "--eval-json", "."], "--eval-json .: must be a file in an existing"),
        ([*FLOWN, "--eval-json=a.x", "--eval-npz=a.x"], "--eval-npz a.x: must be a file of its own"),
        ([*FLOWN, "--eval-json", FLOWN[-1]], "agent.safetensors: must be a file of its own"),
    ],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, list) else "",
)
def test_values_that_are_not_allowed(refuses, argv, line):
    assert line in refuses(*argv)


def test_tracking_without_wandb_says_how_to_install_it(refuses, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "wandb" else find(name, *a))
    assert "pip install wandb" in refuses("--track")


def test_tracking_without_a_login_is_one_line_before_any_solve(refuses, monkeypatch):
    """And leaves no run folder."""

    def init(**names):
        raise RuntimeError("api_key not configured (no-tty)")

    wandb = types.ModuleType("wandb")
    wandb.__spec__, wandb.init = importlib.machinery.ModuleSpec("wandb", None), init
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    monkeypatch.setattr(runs.Run, "solve_reference", None)
    assert "--track: Weights and Biases refuses the run (api_key not configured (no-tty)); `wandb login`" in refuses(
        "--track"
    )
    assert not list(Path("runs").glob("*"))


@pytest.mark.parametrize("scale", [[1.0] * 5, [1.0] * 7, [1.0] * 5 + [0.0], [1.0] * 5 + [np.nan]])
def test_scale_that_does_not_fit_the_observations(monkeypatch, scale):
    """A slip in an environment, before anything is learned or written."""
    batch = runs.make_batch("VanDerPolWaypoints-v0", 1)
    batch.observation_scale = np.array(scale)
    monkeypatch.setattr(runs, "make_batch", lambda env_id, num_envs: batch)
    line = r"observation_scale of VanDerPolWaypoints-v0 is \[1.0, .*\]; it must hold 6 finite numbers other than 0"
    with pytest.raises(BadInput, match=line):
        VDP.constants("VanDerPolWaypoints-v0")


def test_id_that_no_environment_has(monkeypatch):
    """A script's id whose line in PROBLEMS is missing."""
    monkeypatch.setattr(DI, "ENV_IDS", (*DI.ENV_IDS, "Forgotten-v0"))
    with pytest.raises(BadInput, match="env_id is 'Forgotten-v0', of no family"):
        parse(DI, "--env-id=Forgotten-v0", "--recipe=paper")


def test_minibatches_left_alone_are_lowered(capsys):
    default = DI.Args().num_minibatches
    args = parse(DI, "--num-envs=2", "--recipe=paper")
    assert args.num_minibatches == 2 < default
    assert capsys.readouterr().out == f"--num-minibatches lowered from {default} to --num-envs 2\n"


@pytest.mark.parametrize("num_envs, flights", [(32, 32), (64, 32), (4, 4), (1, 1)])
def test_flights_per_start_left_alone_are_lowered(capsys, num_envs, flights):
    """The rocket's 32."""
    assert parse(ROCKET, "--num-envs", num_envs, "--num-minibatches=1").flights_per_start == Schedule(flights)
    line = capsys.readouterr().out
    assert line.startswith(f"--flights-per-start lowered from 32 to {flights}") if flights < 32 else line == ""


@pytest.mark.parametrize("num_envs", [48, 33, 6007])
def test_flights_per_start_left_alone_divide_the_environments(num_envs):
    assert num_envs % parse(ROCKET, "--num-envs", num_envs).flights_per_start.at(0.0) == 0


def test_unwritable_run_folder(refuses):
    Path("runs").write_text("in the way")
    assert "runs" in refuses(*TINY, "--total-updates=1")


# --- bad checkpoints --------------------------------------------------------------------------------------------------


def edited_checkpoint(trained, path, tensors=None, args=None, **metadata):
    """A copy of the tiny run's checkpoint with other tensors, arguments or metadata."""
    with safetensors.safe_open(trained / "agent.safetensors", "pt") as file:
        kept = {**file.metadata(), **metadata}
        weights = {**{name: file.get_tensor(name) for name in file.keys()}, **(tensors or {})}
    kept["args"] = json.dumps({**json.loads(kept["args"]), **(args or {})})
    safetensors.torch.save_file(weights, path, kept)
    return path


def test_an_edited_copy_is_read(trained, tmp_path):
    """The edits below are what is refused, not the copying."""
    parse(DI, "--eval-only", f"--checkpoint={edited_checkpoint(trained, tmp_path / 'copy')}")


def damage(kind, trained, path):
    """Write a checkpoint that is damaged or not one at all."""
    whole = (trained / "agent.safetensors").read_bytes()
    if kind == "directory":
        path.mkdir()
    elif kind == "without metadata":
        safetensors.torch.save_file({"weight": torch.zeros(3)}, path)
    elif kind == "args are a list":
        safetensors.torch.save_file({"weight": torch.zeros(3)}, path, {"args": "[]", "env_id": "DoubleIntegrator-v0"})
    elif kind != "missing":
        contents = {"empty": b"", "half": whole[: len(whole) // 2]}
        path.write_bytes(contents[kind])
    return path


KINDS = ["missing", "directory", "empty", "half", "without metadata", "args are a list"]


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_checkpoint(refuses, trained, tmp_path, kind):
    path = damage(kind, trained, tmp_path / "agent.safetensors")
    message = refuses(*(["--eval-only"] if kind == "half" else TINY), "--checkpoint", path)
    assert f"--checkpoint {path}: " in message and "must be an agent.safetensors" in message


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_checkpoint_with_weights_that_are_not_finite(refuses, trained, tmp_path, value):
    path = edited_checkpoint(trained, tmp_path / "bad", {"actor.0.bias": torch.full((10,), value)})
    assert f"--checkpoint {path}: " in refuses("--eval-only", "--checkpoint", path)


@pytest.mark.parametrize(
    "name, value",
    [("embed_dim", "8"), ("num_heads", 3), ("observe_phase", 1), ("env_id", 1)],
)
def test_checkpoint_with_impossible_args(refuses, trained, tmp_path, name, value):
    message = refuses("--eval-only", "--checkpoint", edited_checkpoint(trained, tmp_path / "bad", args={name: value}))
    assert re.search(name.replace("_", "[-_]"), message)


@pytest.mark.parametrize("value", ["nan", "x"])
def test_checkpoint_with_impossible_counters(refuses, trained, tmp_path, value):
    path = edited_checkpoint(trained, tmp_path / "bad", wall_seconds=value)
    argv = ["--eval-only", "--eval-starts=10", "--eval-json=a.json"]
    assert f"--checkpoint {path}: " in refuses(*argv, "--checkpoint", path)


@pytest.mark.parametrize("script", MODULES, ids=lambda script: script.__name__)
def test_checkpoint_of_another_script(refuses, trained, tmp_path, script):
    """Its environment is named and the script's are, whatever else the file lacks of this script's arguments."""
    for other in MODULES:
        if set(other.ENV_IDS) & set(script.ENV_IDS):
            continue
        env_id = other.ENV_IDS[-1]
        path = edited_checkpoint(trained, tmp_path / "agent", args={"env_id": env_id})
        for flags in ([], [f"--env-id={script.ENV_IDS[0]}"]):
            message = refuses("--eval-only", "--checkpoint", path, *flags, script=script)
            assert (
                message == f"error: --checkpoint {path}: is of {env_id}; this script takes {', '.join(script.ENV_IDS)}"
            )


def test_checkpoint_of_other_buffers_and_sizes(refuses, trained, tmp_path):
    """What does not fit is named with both shapes."""
    for tensors, shapes in [
        ({"observation_scale": torch.ones(6)}, r"observation_scale is \(6,\) in the file and \(3,\) in this script"),
        ({"encoder.0.weight": torch.ones(8, 6)}, r"encoder.0.weight is \(8, 6\) in the file and \(8, 3\) in this "),
        ({"units": torch.ones(2)}, r"units is \(2,\) in the file and missing in this script"),
    ]:
        path = edited_checkpoint(trained, tmp_path / "agent", tensors)
        message = refuses("--eval-only", "--checkpoint", path)
        assert re.search(f"--checkpoint {path}: does not fit its own args, constants or features .{shapes}", message)


@pytest.mark.parametrize(
    "argv, line",
    [
        (["--embed-dim", 16], "--embed-dim 16: the checkpoint has 8"),
        (["--num-heads=4"], "--num-heads 4: the checkpoint has 2"),
        (["--memory_length", 0], "--memory-length 0: the checkpoint has 4"),
        (["--observe-phase"], "--observe-phase True: the checkpoint has False"),
        (["--env-id", "DoubleIntegratorWaypoints-v0"], "--env-id DoubleIntegratorWaypoints-v0: the checkpoint has Dou"),
    ],
    ids=str,
)
def test_flag_that_contradicts_the_checkpoint(refuses, trained, argv, line):
    assert line in refuses("--eval-only", "--checkpoint", trained / "agent.safetensors", *argv)


# --- bad --resume -----------------------------------------------------------------------------------------------------


class RunsCode:
    """Unpickling it would make a folder."""

    def __reduce__(self):
        return os.mkdir, ("executed",)


def foreign_state(kind, trained, folder):
    """Write a run folder whose training state cannot be gone on with."""
    whole = (trained / "training_state.pt").read_bytes()
    state = torch.load(trained / "training_state.pt", weights_only=True)
    folder.mkdir()
    path = folder / "training_state.pt"
    if kind == "truncated":
        path.write_bytes(whole[: len(whole) // 2])
    elif kind == "one bit":  # of a weight; torch checks no sum
        at = whole.index(state["agent"]["encoder.0.weight"].numpy().tobytes())
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    elif kind == "runs code":
        path.write_bytes(pickle.dumps({**state, "progress": RunsCode()}, protocol=2))
    elif kind == "runs code, torch's format":
        torch.save({**state, "progress": RunsCode()}, path)
    elif kind != "missing":
        kinds = {"a dict": {"model": torch.zeros(1)}}
        kinds["of another problem"] = {**state, "args": {**state["args"], "env_id": "VanDerPol-v0"}}
        kinds["of another version"] = {**state, "args": {**state["args"], "old_flag": 1}}
        kinds["without weights"] = {key: value for key, value in state.items() if key != "agent"}
        kinds["of another size"] = {**state, "args": {**state["args"], "embed_dim": 16}}
        torch.save(kinds[kind], path)


STATES = ["missing", "truncated", "one bit", "runs code", "runs code, torch's format", "a dict"]
STATES += ["without weights", "of another size"]


@pytest.mark.parametrize("kind", STATES)
def test_resume_of_what_is_no_run(refuses, trained, tmp_path, kind):
    foreign_state(kind, trained, tmp_path / "run")
    message = refuses("--resume", tmp_path / "run")
    assert f"--resume {tmp_path / 'run'}: " in message and "training_state.pt" in message
    assert not Path("executed").exists()


@pytest.mark.parametrize(
    "kind, reason",
    [
        ("of another problem", "it is of VanDerPol-v0; this script takes DoubleIntegrator-v0, DoubleIntegratorWay"),
        ("of another version", "old_flag is not among the arguments of both"),
    ],
)
def test_resume_of_another_script_says_so(refuses, trained, tmp_path, kind, reason):
    foreign_state(kind, trained, tmp_path / "run")
    assert reason in refuses("--resume", tmp_path / "run")


def test_the_name_of_a_run_is_no_path(refuses):
    for name in ("a/b", "../outside", "/tmp"):
        assert f"--exp-name {name}: must be the name of a folder" in refuses("--exp-name", name)


def test_a_dispersed_training_sees_its_time(refuses):
    """Its flights are compared with the nominal one in the same burn, which the observed phase tells."""
    message = refuses("--dispersion", 1, "--no-observe-phase", "--recipe=paper", script=ROCKET)
    assert message.startswith("error: --no-observe-phase: not in a training with --dispersion")


def test_resume_of_another_vehicle(refuses, trained, tmp_path):
    """A constant that the script no longer makes so, as after a change of a vehicle's file."""
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    state = torch.load(run / "training_state.pt", weights_only=True)
    state["agent"]["observation_scale"][0] *= 2
    torch.save(state, run / "training_state.pt")
    assert "observation_scale is not that of DoubleIntegrator-v0 now" in refuses("--resume", run)


@pytest.mark.parametrize("argv", [["--seed", 2], ["--no-save-model"]], ids=str)
def test_resume_takes_no_other_flags(refuses, trained, argv):
    message = refuses("--resume", trained, *argv)
    assert "--resume" in message and "--cuda" in message and "--num-threads" in message
    assert argv[0].split("=")[0].replace("--no-", "--") in message


@pytest.mark.slow
def test_resume_of_a_finished_run_repeats_its_evaluation(trained, tmp_path, monkeypatch):
    run = Path(shutil.copytree(trained, tmp_path / "run"))
    monkeypatch.chdir(tmp_path)
    DI.main(["--resume=run", "--num-threads=1", "--no-cuda"])
    first, again = (json.loads((folder / "eval.json").read_text()) for folder in (trained, run))
    del first["checkpoint_sha256"], again["checkpoint_sha256"]  # the file's args now name --resume
    assert again == first and os.listdir() == ["run"]
    state = state_of(trained)
    state["args"] |= {"cuda": False, "num_threads": 1}
    assert_same_bits(state_of(run), state)
