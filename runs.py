"""What surrounds the learning in the ppo_gtrxl_*.py scripts.

Reading order: arguments, start of a script, a run with its files and messages, checkpoints, the memory of a process,
processes. Bad input ends a script with one line and exit status 1.
"""

from __future__ import annotations

import contextlib
import copy
import ctypes
import gc
import hashlib
import importlib
import importlib.util
import io
import json
import math
import os
import sys
import time
import zipfile
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from typing import Any, NoReturn, get_type_hints

import gymnasium as gym
import numpy as np
import safetensors.torch
import torch
import torch.distributed as dist
import tyro

import envs as _envs  # noqa: F401 - makes every id known to `task_of`
from common import files
from common.batch import make_batch
from common.checkpoints import COUNTERS, read_checkpoint
from common.command_line import typed_command
from common.curves import read_curve
from common.errors import BadInput, NoOptimum, refuse_unless
from common.evaluations import write_evaluation
from common.fingerprint import KEY, changes, fingerprint
from common.flags import Policy, Range, Words, facts, plain_args
from common.interrupts import catch_signals, leave, say, uninterrupted
from common.schedule import Schedule
from common.tasks import Task, task_of

gc.freeze()  # imported modules are never garbage, and looking through them takes a fifth of the time of --help

# ---------------------------------------------------------------------------------------------------------------------
# Arguments
# ---------------------------------------------------------------------------------------------------------------------

WORDS_OF_SCHEDULES = tyro.constructors.PrimitiveConstructorSpec(
    nargs="*",
    metavar="VALUE | PLACE:VALUE ...",
    instance_from_str=lambda words: Schedule(" ".join(words)),
    is_instance=lambda value: isinstance(value, Schedule),
    str_from_instance=lambda value: str(value).split(),
)
REGISTRY = tyro.constructors.ConstructorRegistry()
REGISTRY.primitive_rule(lambda flag: WORDS_OF_SCHEDULES if flag.type is Schedule else None)
ROOT = Path(__file__).resolve().parent
fcntl: Any = importlib.import_module("fcntl") if importlib.util.find_spec("fcntl") else None  # Windows has none


def fail(message) -> NoReturn:
    """End with one line on stderr and exit status 1."""
    sys.exit(f"error: {' '.join(str(message).split())}")


def flag_of(name, value):
    """An Args field and its value as they are typed."""
    return f"--{name.replace('_', '-')} {value}".strip()


def refuse(name, value, allowed) -> NoReturn:
    """End with one line that names the flag of an Args field, its value and what is allowed."""
    fail(f"{flag_of(name, value)}: {allowed}")


def parse_args(script, argv):
    """A script's checked arguments, and what it begins with: a saved training state, a checkpoint's contents or None.

    `script` is the module. It has:

    - Args: the dataclass of the flags
    - recipe(args): what the recipe changes for these environments
    - ENV_IDS: the script's environments
    - ENV_OPTIONS: names of the arguments that go to the environments
    - constants(environment id): the buffers of the environment's agents

    A typed flag wins over a checkpoint, a checkpoint over the recipe, and the recipe over Args. Raises SystemExit with
    one line that names the flag, the value and what is allowed.
    """
    asks_for_help = not {"-h", "--help"}.isdisjoint(argv)
    typed = read_flags(script.Args(), [word for word in argv if word not in ("-h", "--help")])
    if typed.get("resume") is not None and not asks_for_help:
        untyped, saved = resumed(typed, script)
    else:
        untyped, saved = resolve(typed, script)
    args = replace(untyped, **typed)
    if asks_for_help:
        read_flags(args, ["--help"], f"--env-id is one of {', '.join(script.ENV_IDS)}.")  # prints, and ends the script
    check(args, script.ENV_IDS)
    task = task_of(args.env_id)
    options = {name: getattr(args, name) for name in script.ENV_OPTIONS}
    unfit = task.refusal(not args.eval_only, **options)
    if unfit:
        name, why = unfit
        refuse(name, getattr(args, name, ""), why)
    check_share(args, typed)
    if args.eval_only and saved and saved["counters"]["seed"] == args.eval_seed:
        remark = task.remark_on_seed(args.eval_seed)
        if remark:
            print(remark)
    if args.eval_starts is None:
        is_cut_short = not args.eval_only and args.total_updates < untyped.total_updates
        args.eval_starts = task.default_flights(is_cut_short, **options)
    return args, saved


def read_flags(defaults, argv, description=""):
    """{field: value} of the flags that a command line names. --help shows a description and the values of `defaults`.

    `defaults` is an Args.

    tyro knows which flags there are and what they take. It does not tell which flags were typed, so we read their names
    from `argv`. It complains in a frame of several lines, so we show the frame's first paragraph as one line.
    """
    with contextlib.redirect_stderr(io.StringIO()) as frame:
        try:
            with REGISTRY:
                args = tyro.cli(type(defaults), args=argv, default=defaults, description=description)
        except SystemExit as stop:
            if not stop.code:  # --help
                print(allowed(type(defaults)))
                raise
            lines = [line.strip("│ ") for line in frame.getvalue().splitlines() if line[:1] != "╭"]
            first_paragraph = takewhile(lambda line: line[:1] not in ("─", "╰"), lines)
            fail(f"{' '.join(first_paragraph).removeprefix('Error parsing ')} (--help lists what is allowed)")
    flags = [word.split("=")[0] for word in argv if word.startswith("--")]
    names = {flag.removeprefix("--").replace("-", "_").removeprefix("no_") for flag in flags}
    return {name: getattr(args, name) for name in names & vars(args).keys()}  # "--" alone names none


def allowed(kind):
    """The lines of --help that give the ranges of the numeric flags."""
    flags = {}
    for name, (low, high) in facts(kind, Range).items():
        flags.setdefault(f"{low:g} to {high:g}", []).append(flag_of(name, ""))
    return "\n".join(["Ranges:", *(f"  {bounds}: {', '.join(names)}" for bounds, names in flags.items())])


def resumed(typed, script):
    """The Args of the run that --resume goes on with, and its training state."""
    refused = sorted(typed.keys() - {"resume", "cuda", "num_threads"})
    if refused:
        refuse(refused[0], "", "only --cuda and --num-threads may be given beside --resume")
    saved = load_state(typed["resume"], script)
    changed = changes_since(saved)
    if changed:
        env_id = saved["args"]["env_id"]
        todo = "undo the edit, or begin a new training with --checkpoint"
        fail(f"--resume {typed['resume']}: {env_id} has been edited since ({changed} differ); {todo}")
    return script.Args(**saved["args"]), saved


def resolve(typed, script):
    """Args as they are without the typed flags, and what the checkpoint holds, or None.

    The checkpoint is the one that is typed, or else the one with which the recipe begins.
    """
    saved = None
    of_policy = {}
    check_env_id(typed.get("env_id", script.Args.env_id), script.ENV_IDS)
    if typed.get("checkpoint") is not None:
        saved, of_policy = read_policy(typed["checkpoint"], script)
        refuse_contradictions(typed, of_policy, script)
    elif typed.get("eval_only"):
        refuse("checkpoint", None, "must name the agent.safetensors that --eval-only flies")
    args = script.Args(**{**of_policy, **typed})
    check_values(args, script.ENV_IDS)

    of_recipe = dict(script.recipe(args)) if args.recipe == "ours" else {}
    if saved is None and "checkpoint" in of_recipe:
        first = of_recipe["checkpoint"] = path_of_policy(of_recipe["checkpoint"])
        first_saved, of_first = read_policy(first, script)
        differing = contradictions(typed, of_first, script.Args)
        if differing:
            name = differing[0]
            print(f"{flag_of(name, typed[name])}: the recipe's first policy, {first}, has another")
            of_recipe = script.recipe(args, anew=True)
        else:
            saved, of_policy = first_saved, of_first
    if saved is not None:
        saved["keeps_log_std"] = "log_std" not in typed  # a learned log-std goes on from the file's
    if not args.eval_only:  # what a policy only suggests, the recipe of its further training may change
        suggested = [name for name, mark in facts(script.Args, Policy).items() if mark is Policy.SUGGESTS]
        of_policy |= {name: of_recipe[name] for name in suggested if name in of_recipe}
    return script.Args(**{**of_recipe, **of_policy}), saved


def path_of_policy(path):
    """The path of the policy with which a recipe begins: here, or beside the scripts.

    Ends with one line if it is missing.
    """
    found = [place for place in (Path(path), ROOT / path) if place.is_file()]
    if not found:
        todo = "train it first, or name a --checkpoint"
        fail(f"the recipe begins with the policy {ROOT / path}, which is not there: {todo}")
    return str(found[0])


def younger(script):
    """The arguments that an older file need not have: options of environments, and flags that are off.

    Their defaults are what was trained before the flags existed.
    """
    return {
        name: value
        for name, value in plain_args(script.Args()).items()
        if value is None or value is False or name in script.ENV_OPTIONS
    }


def read_policy(path, script):
    """What an agent.safetensors holds, and the arguments {name: value} that it decides.

    Raises BadInput if the file is damaged or of another script.
    """
    names = ["env_id", *facts(script.Args, Policy)]
    kinds = get_type_hints(script.Args)
    expected = {name: kinds[name] for name in names}
    saved = read_checkpoint(path, expected, script.ENV_IDS, younger(script), "--checkpoint ")
    return saved, {name: saved["args"][name] for name in names}


def contradictions(typed, of_policy, kind):
    """The typed fields that differ from what a policy's file fixes."""
    marks = facts(kind, Policy)
    fixed = ["env_id", *(name for name, mark in marks.items() if mark is Policy.FIXES)]
    return [name for name in fixed if name in typed and typed[name] != of_policy[name]]


def refuse_contradictions(typed, of_policy, script):
    """Refuse typed flags that do not fit the policy of --checkpoint.

    --env-id may name another environment whose agents have the same constants.
    """
    for name in contradictions(typed, of_policy, script.Args):
        given = typed[name]
        in_file = of_policy[name]
        if name != "env_id":
            refuse(name, given, f"the checkpoint has {in_file}; leave the flag out")
        if script.constants(given) != script.constants(in_file):
            refuse(name, given, f"the checkpoint has {in_file}, whose policy does not fit")
        print(f"--checkpoint is of {in_file}; it goes on with {given}")


def check(args, env_ids):
    """Refuse arguments that no run can use.

    args is a script's Args, env_ids are the script's environments. Raises SystemExit with one line that names the flag,
    the value and what is allowed.
    """
    check_values(args, env_ids)
    if args.embed_dim % args.num_heads:
        refuse("num_heads", args.num_heads, f"must divide --embed-dim {args.embed_dim}")
    check_outputs(args)
    if Path(args.exp_name).name != args.exp_name:
        refuse("exp_name", args.exp_name, "must be the name of a folder, without /")
    if args.track and importlib.util.find_spec("wandb") is None:
        refuse("track", "", "needs wandb: pip install wandb")


def check_values(args, env_ids):
    """Refuse a number that is out of its range, and a word that its flag does not take."""
    check_env_id(args.env_id, env_ids)
    for name, (words,) in facts(type(args), Words).items():
        value = getattr(args, name)
        if value not in words:
            refuse(name, value, f"must be one of {', '.join(words)}")
    for name, (low, high) in facts(type(args), Range).items():
        value = getattr(args, name)
        numbers = value.values if isinstance(value, Schedule) else [value]
        if value is not None and not all(low <= number <= high for number in numbers):
            refuse(name, value, f"must be between {low} and {high}")
    if not all(number.is_integer() for number in args.flights_per_start.values):
        refuse("flights_per_start", args.flights_per_start, "must be whole numbers")


def check_env_id(env_id, env_ids):
    """Refuse an --env-id that the script does not have, and name the script that trains it if there is one."""
    if env_id in env_ids:
        return
    others = "".join(f"; {name}.py trains {env_id}" for name in scripts_with(env_id))
    refuse("env_id", env_id, f"must be one of {', '.join(env_ids)}{others}")


def scripts_with(env_id):
    """The names of the scripts that have this environment."""
    names = sorted(path.stem for path in ROOT.glob("ppo_gtrxl_*.py"))
    return [name for name in names if env_id in importlib.import_module(name).ENV_IDS]


def check_outputs(args):
    """Refuse an --eval-json or --eval-npz that cannot be written, or would replace another file of the command."""
    taken = {Path(args.checkpoint or "").resolve()}
    for name in ("eval_json", "eval_npz"):
        value = getattr(args, name)
        if value is None:
            continue
        path = Path(value).resolve()
        if not args.eval_only:
            refuse(name, value, "only with --eval-only")
        if path.is_dir() or not os.access(path.parent, os.W_OK):
            refuse(name, value, "must be a file in an existing, writable folder")
        if path in taken:
            refuse(name, value, "must be a file of its own; another flag names it, too")
        taken.add(path)


def check_share(args, typed):
    """Give each process of torchrun at least one episode a minibatch, and whole groups.

    --num-minibatches and --flights-per-start are lowered with a printed line if they were not typed. If they were
    typed, they are refused.
    """
    processes = int(os.environ.get("WORLD_SIZE", 1))
    if args.num_envs < processes:
        refuse("num_envs", args.num_envs, f"must be at least the number of processes, {processes}")
    smallest = args.num_envs // processes
    largest = -(-args.num_envs // processes)  # the first processes fly one more
    total_envs = f"--num-envs {args.num_envs}"
    if processes > 1:
        total_envs += f" / {processes} processes"

    if args.num_minibatches > smallest:
        if "num_minibatches" in typed:
            refuse("num_minibatches", args.num_minibatches, f"must be at most {total_envs}")
        print(f"--num-minibatches lowered from {args.num_minibatches} to {total_envs}")
        args.num_minibatches = smallest

    shares = {smallest, largest}
    schedule = args.flights_per_start
    for group in {round(size) for size in [*schedule.over(args.total_updates), *schedule.values]}:
        fits = largest_group(group, shares)
        if fits == group:
            continue
        if "flights_per_start" in typed:
            in_one = f"; it is {group} in one update" if schedule.has_points else ""
            refuse("flights_per_start", schedule, f"must divide {total_envs}{in_one}")
        print(f"--flights-per-start lowered from {group} to {fits}, which divides {total_envs}")
        args.flights_per_start = args.flights_per_start.replaced(group, fits)


def largest_group(most, shares):
    """The largest group of at most `most` flights that divides every process's share of the environments."""
    fitting = [group for group in range(1, most + 1) if all(share % group == 0 for share in shares)]
    return fitting[-1]


# ---------------------------------------------------------------------------------------------------------------------
# Start of a script
# ---------------------------------------------------------------------------------------------------------------------


def run_script(main):
    """Run a script's `main(argv)`.

    Ctrl-C ends it with exit status 130, SIGTERM with 143, the end of its terminal with 129, and bad input with one line
    and 1.
    """
    catch_signals()
    try:
        main(sys.argv[1:])
    except (BadInput, NoOptimum, ImportError, OSError) as error:
        fail(error)
    except KeyboardInterrupt:
        leave()


def prepare_torch(args):
    """Set the threads and seeds of torch, and join torchrun's processes. Returns the device of the networks."""
    keep_memory()
    torch.set_num_threads(args.num_threads or torch.get_num_threads())
    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    join_processes(args.cuda)
    return "cuda" if torch.cuda.is_available() and args.cuda else "cpu"


def make_envs(args, env_options):
    """This process's share of the environments, made with env_options and seeded. Raises BadInput for a bad option."""
    rank, processes = rank_and_world_size()
    share = args.num_envs // processes + (rank < args.num_envs % processes)
    envs = make_batch(args.env_id, share, **env_options)
    seed = args.seed + 2**31 * rank
    if seed in (args.eval_seed, TRAINING_EVAL_SEED):
        seed += 2**40  # a reset draws as an evaluation does, so this seed would train on the starts of the evaluation
    envs.reset(seed=seed)
    return envs


def load_checkpoint(agent, args, saved):
    """Put the weights of --checkpoint into a new agent. Does nothing without it or with --resume.

    Ends with one line if the weights do not fit the agent.
    """
    if args.checkpoint is None or args.resume is not None:
        return
    changed = changes_since(saved) if saved["args"]["env_id"] == args.env_id else None
    if changed:
        print(f"--checkpoint {args.checkpoint}: {args.env_id} has been edited since its training ({changed} differ)")
    expected = {name: tuple(tensor.shape) for name, tensor in agent.state_dict().items()}
    shapes = {name: array.shape for name, array in saved["tensors"].items()}
    differing = [name for name in {**expected, **shapes} if expected.get(name) != shapes.get(name)]
    if differing:
        name = differing[0]
        in_file = shapes.get(name, "missing")
        here = expected.get(name, "missing")
        why = f"{name} is {in_file} in the file and {here} in this script"
        todo = "train it anew, or fly it by the version that trained it (CHANGELOG.md)"
        fail(f"--checkpoint {args.checkpoint}: does not fit its own args, constants or features ({why}); {todo}")
    for name, constant in constants_of(agent).items():
        if not torch.allclose(constant.cpu(), torch.from_numpy(saved["tensors"][name]), rtol=1e-6):
            print(f"--checkpoint {args.checkpoint}: {args.env_id} has another {name} now; the policy keeps its own")
            break
    agent.load_state_dict({name: torch.from_numpy(array) for name, array in saved["tensors"].items()})
    if agent.actor_logstd.requires_grad and not saved["keeps_log_std"]:
        torch.nn.init.constant_(agent.actor_logstd, args.log_std.at(0.0))
    if not args.eval_only:
        digest = hashlib.sha256(Path(args.checkpoint).read_bytes()).hexdigest()
        print(f"begins with {args.checkpoint}, sha256 {digest}")


def changes_since(saved):
    """What has changed in the environment of a training state or checkpoint since its training, in words, or None.

    An older file does not say what its environment did.
    """
    if saved.get(KEY) is None:
        return None
    return changes(saved[KEY], saved["args"]["env_id"])


def options_of_policy(args, env_options):
    """The environment's options that the file of a policy decides, and those that no flag sets."""
    decided = facts(type(args), Policy)
    return {name: value for name, value in env_options.items() if name in decided or name not in vars(args)}


def observation_scale(env_id):
    """A usual size of each observation of an environment. Raises BadInput if it does not fit the observations."""
    envs = make_batch(env_id, 1)
    scale = envs.observation_scale.tolist()
    inputs = gym.spaces.flatdim(envs.single_observation_space)
    fits = len(scale) == inputs and all(math.isfinite(size) and size for size in scale)
    allowed = f"must hold {inputs} finite numbers other than 0, one for each of its observations"
    refuse_unless(fits, f"observation_scale of {env_id}", scale, allowed)
    return scale


def constants_of(agent):
    """{name: buffer} of an agent, without the two of a rocket's that a training sets anew."""
    return {name: x for name, x in agent.named_buffers() if name not in ("differences", "nominal_flight")}


def finite(values, epoch, minibatch):
    """The logged tensors {name: ()} as numbers, in one copy from a GPU.

    Raises FloatingPointError with the name of the first number that is not finite.
    """
    numbers = dict(zip(values, torch.stack(list(values.values())).tolist()))
    for name, number in numbers.items():
        if not math.isfinite(number):
            raise FloatingPointError(f"{name} is {number} in epoch {epoch}, minibatch {minibatch}")
    return numbers


# ---------------------------------------------------------------------------------------------------------------------
# A run: its folder, counters, messages and evaluations
# ---------------------------------------------------------------------------------------------------------------------

SAVE_EVERY = 10  # updates
TRAINING_EVAL_SEED = 2**31  # beyond every --eval-seed, so no reported start is flown during training


class Run:
    """One run with its folder, counters, messages and evaluations. Under torchrun only the first process writes.

    - `with run:` opens the folder, and saves what was learned however the training ends
    - `end_update` counts, saves, evaluates and logs
    - `finish` makes the reported evaluation

    Of the `counters`, `training_seconds` is the time of rollouts and updates. `wall_seconds` is all time up to the end
    of the last update, with the evaluations and saves before it.
    """

    def __init__(self, args, saved, agent, average, optimizer, envs, env_options, describe):
        self.args = args
        self.envs = envs
        self.env_options = env_options
        self.describe = describe
        self.first_steps = envs.episode_steps  # training may make the episodes of `envs` longer or shorter
        self.modules = {"agent": agent, "average": average, "optimizer": optimizer}
        self.rank, _ = rank_and_world_size()
        self.task: Task = task_of(args.env_id)
        self.folder: Any = None  # a Path; only the first process sets it and the writer, in `with run:`
        self.writer: Any = None
        self.metrics = {}
        self.fingerprint = None if self.rank > 0 else fingerprint(args.env_id, **options_of_policy(args, env_options))
        if self.rank > 0:  # all processes have the same weights, but draw other noise
            torch.manual_seed(args.seed + 2**31 * self.rank)
        self.counters = {"seed": args.seed, "total_updates": 0, "global_step": 0}
        self.counters |= {"training_seconds": 0.0, "wall_seconds": 0.0}
        if args.resume is not None:
            self.folder = Path(args.resume)
            self.counters = restore(saved, self.folder, self.modules, envs)
        elif args.eval_only:
            self.counters = saved["counters"]
        self.began = time.monotonic() - self.counters["wall_seconds"]
        self.update_began = time.monotonic()
        self.first_line: Any = None  # updates and seconds at the first printed line

    @property
    def updates_done(self):
        """The number of updates that are learned and counted."""
        return self.counters["total_updates"]

    def __enter__(self):
        self.state = self.current_state()
        if self.rank > 0:
            return self
        is_new = self.folder is None
        self.folder = self.folder or new_folder(f"{self.args.env_id}__{self.args.exp_name}__{self.args.seed}")
        lock_folder(self.folder)
        try:
            if self.args.track:
                track(self.args, self.folder.name)
            self.solve_reference()
        except BaseException:
            if is_new:
                with contextlib.suppress(OSError):  # a folder that holds other runs or files stays
                    self.folder.rmdir()
                    self.folder.parent.rmdir()
            raise
        print(f"run folder: {self.folder}", flush=True)
        for leftover in self.folder.glob(".*.tmp"):  # a killed writer leaves such a file
            leftover.unlink()
        arguments = {**plain_args(self.args), "resume": None}
        if self.args.save_model:
            files.write_json(self.folder / "args.json", arguments)
        self.writer = new_writer(self.folder, self.counters["global_step"] + 1, arguments)
        self.save()
        self.update_began = time.monotonic()
        return self

    def solve_reference(self):
        """Find the optima that evaluations fly before anything is learned. A missing optimum ends the run here."""
        evaluates_on_the_way = 0 < self.args.eval_every <= self.args.total_updates
        seeds = [TRAINING_EVAL_SEED] * evaluates_on_the_way + [self.args.eval_seed]
        for seed in seeds:
            self.task.optimum(seed, self.flights(seed), **self.env_options)

    def __exit__(self, kind, error, traceback):
        with uninterrupted():
            self.close(error)

    def close(self, error):
        """Save what was learned until `error`, and say how to go on. Without an error it is saved already."""
        if self.writer:
            with files.naming(self.folder):
                self.writer.flush()
        if error is None:
            return
        if not isinstance(error, KeyboardInterrupt | FloatingPointError):
            with contextlib.suppress(OSError):  # a full disk may be what ended the training
                self.save()
            return
        self.save()
        updates = self.state["progress"]["total_updates"]
        saved = self.args.save_model and self.rank == 0
        if isinstance(error, FloatingPointError):
            kept = f"; the last good checkpoint is {self.folder}/training_state.pt" if saved else ""
            fail(f"update {updates + 1}: {error}, must be finite{kept}")
        self.say_stopped()

    def say_stopped(self):
        """Print after which update a signal has stopped the run, and the command that goes on."""
        if self.rank > 0:
            return
        script = f"{type(self.args)().exp_name}.py"
        kept = "nothing saved"
        if self.args.save_model:
            kept = f"go on with: {typed_command(script, '--resume', self.folder)}"
        say(f"stopped after update {self.state['progress']['total_updates']}; {kept}")

    def current_state(self):
        """A copy of all that a resume needs. An environment that cannot be told by what it does has no fingerprint."""
        state = training_state(self.args, self.modules, self.envs, self.counters)
        return state if self.fingerprint is None else {**state, KEY: self.fingerprint}

    def save(self):
        """Write the state after the last whole update."""
        if self.args.save_model and self.rank == 0:
            save_run(self.folder, self.state)

    def end_update(self, iteration, alive, episodes, losses, learning_rate):
        """Count and log an update. Save every ten updates, evaluate every --eval-every, and print a line now and then.

        alive (T, N) is the batch's, episodes the `final_info` of its flights. losses are means over the update.
        """
        args = self.args
        now = time.monotonic()
        steps = int(total(alive.sum()))
        episodes = gathered(episodes)
        self.counters = {**self.counters, "total_updates": iteration, "wall_seconds": now - self.began}
        self.counters["global_step"] += steps
        self.counters["training_seconds"] += now - self.update_began
        state = self.current_state()
        if self.rank == 0:
            if args.eval_every and iteration % args.eval_every == 0:
                self.metrics, _ = self.evaluate(TRAINING_EVAL_SEED)
                self.log("eval", self.metrics)
            charts = {"episodic_return": episodes["episodic_return"].mean().item(), "learning_rate": learning_rate}
            charts["episodic_length"] = steps / args.num_envs
            charts["SPS"] = int(self.counters["global_step"] / self.counters["training_seconds"])
            self.log("charts", charts)
            self.log("losses", losses)
            if iteration % (args.eval_every or max(1, args.total_updates // 100)) == 0 or iteration == 1:
                self.print_line(episodes)
        self.state = state  # only now, so that a resume repeats an update whose evaluation was interrupted
        if iteration % SAVE_EVERY == 0 or iteration == args.total_updates:
            self.save()
        self.update_began = time.monotonic()

    def print_line(self, episodes):
        """Print how far the run is, what the sampled episodes earned and what the last evaluation found."""
        done = self.counters["total_updates"]
        of = self.args.total_updates
        seconds = time.monotonic() - self.began
        clock = f"{seconds / 60:.1f} min gone"
        if self.first_line is None:  # the first update also starts everything, so it tells nothing about the others
            self.first_line = done, seconds
        else:
            first, seconds_before = self.first_line
            clock += f", {(of - done) * (seconds - seconds_before) / (done - first) / 60:.1f} to go"
        line = f"update {done}/{of}, {self.counters['global_step']} steps, {clock}"
        print(f"{line}: {self.describe(episodes, self.metrics)}", flush=True)

    def log(self, prefix, values):
        """Write every number of `values` under its TensorBoard tag."""
        numbers = {name: value for name, value in values.items() if isinstance(value, int | float)}
        with files.naming(self.folder):  # TensorBoard writes in a thread, whose errors do not name the file
            for name, value in numbers.items():
                self.writer.add_scalar(f"{prefix}/{name}", value, self.counters["global_step"])

    def evaluate(self, eval_seed):
        """Fly the mean action of the averaged weights, and the optimum. Returns the metrics and arrays of eval.*."""
        average = self.modules["average"].module
        policy = average.make_policy(self.longest_episode)
        metrics, arrays = self.task.evaluate(policy, eval_seed, self.flights(eval_seed), **self.env_options)
        device = average.actor_logstd.device.type
        metrics = {**metrics, **self.counters, "device": device, "torch_version": torch.__version__}
        return metrics if self.fingerprint is None else {**metrics, KEY: self.fingerprint}, arrays

    @property
    def longest_episode(self):
        """The most steps that an episode of an evaluation can have."""
        return max(self.first_steps, self.envs.episode_steps)

    def flights(self, eval_seed):
        """The number of flights in the evaluation of a seed."""
        if eval_seed == TRAINING_EVAL_SEED:
            return self.task.interim_flights(self.args.eval_starts, **self.env_options)
        return self.args.eval_starts

    def finish(self):
        """Fly the reported starts, write the evaluation and print the table. A signal leaves the trained policy."""
        try:
            self.report()
        except KeyboardInterrupt:
            if not self.args.eval_only:
                self.say_stopped()
            raise

    def report(self):
        """What `finish` does without a signal."""
        args = self.args
        if self.rank > 0:
            return
        metrics, arrays = self.evaluate(args.eval_seed)
        timed_policy = None
        if args.eval_only:
            timed_policy = self.modules["average"].module.make_policy(self.longest_episode)
        metrics |= self.task.reported_metrics(metrics, timed_policy, **self.env_options)
        if args.eval_only:
            write_evaluation(metrics, arrays, args.checkpoint, args.eval_json, args.eval_npz)
            print(self.task.table(metrics))
            return
        self.log("eval", metrics)
        with files.naming(self.folder):
            self.writer.close()
        if args.save_model:
            paths = (self.folder / name for name in ("agent.safetensors", "eval.json", "eval.npz"))
            write_evaluation(metrics, arrays, *paths)
        if args.capture_video:
            from drawing.evaluation import (  # only a drawing should wait the quarter of a second that Matplotlib takes
                draw_animation,
                draw_figures,
            )

            draw_figures(self.folder, arrays, metrics, [read_curve(self.folder)])
            draw_animation(self.folder, arrays, metrics)
        print(self.task.table(metrics))
        print(f"run folder: {self.folder}")
        unlock_folder()


def new_folder(name):
    """Make a new folder runs/{name}__{unix time}. If another run has taken this second, wait for the next one."""
    while True:
        folder = Path(f"runs/{name}__{int(time.time())}")
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            if not folder.is_dir():
                raise
            time.sleep(0.1)


locked = []  # the open run folder that this process has locked, if any


def lock_folder(folder):
    """Lock a run folder until `unlock_folder` or the end of this process, however it ends.

    Ends with one line if another process has locked it, as two would write the same files. Where the system or the file
    system has no such locks, nothing happens.
    """
    unlock_folder()
    if fcntl is None:
        return
    locked.append(os.open(folder, os.O_RDONLY))
    try:
        fcntl.flock(locked[0], fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        unlock_folder()
        fail(f"--resume {folder}: another process trains in this folder; stop it first, or wait for its end")
    except OSError:  # as on some network drives
        unlock_folder()


def unlock_folder():
    """Let other processes have the run folder that this one has locked, if any."""
    while locked:
        os.close(locked.pop())


def new_writer(folder, first_step, arguments):
    """TensorBoard's writer, with the hyperparameters as a text table, as in CleanRL.

    TensorBoard drops events from `first_step` on, because a resumed run writes them again.
    """
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(folder, purge_step=first_step)
    rows = "\n".join(f"|{name}|{value}|" for name, value in arguments.items())
    writer.add_text("hyperparameters", f"|param|value|\n|-|-|\n{rows}")
    return writer


def track(args, name):
    """Follow the run with Weights and Biases. A resumed run goes on with its own earlier record.

    Ends with one line on failure.
    """
    import wandb  # pyright: ignore[reportMissingImports] - optional, not among the requirements

    names = {"project": args.wandb_project_name, "entity": args.wandb_entity, "name": name, "id": name}
    try:
        wandb.init(**names, resume="allow", sync_tensorboard=True, config=plain_args(args), save_code=True)
    except Exception as error:  # wandb's errors (no login, no network, no such entity) have no common class
        fail(f"--track: Weights and Biases refuses the run ({error}); `wandb login` first, or leave --track out")


# ---------------------------------------------------------------------------------------------------------------------
# Checkpoints
# ---------------------------------------------------------------------------------------------------------------------


def training_state(args, modules, envs, counters):
    """A copy of all that a bit-exact resume needs. Training does not change the copy."""
    modules = {name: module.state_dict() for name, module in modules.items()}
    rng = {"torch": torch.get_rng_state()}
    rng |= {name: json.dumps(stream.bit_generator.state) for name, stream in envs.generators.items()}
    rng = all_gather({**rng, "cuda": torch.cuda.get_rng_state_all()})
    return copy.deepcopy({"args": {**plain_args(args), "resume": None}, "progress": counters, "rng": rng, **modules})


def restore(state, run_dir, modules, envs):
    """Put everything back where `training_state` found it. Returns the counters.

    Ends with one line if something does not fit.
    """
    try:
        for name, constant in constants_of(modules["agent"]).items():
            if not torch.allclose(constant.cpu(), state["agent"][name], rtol=1e-6):
                raise ValueError(f"{name} is not that of {state['args']['env_id']} now")
        for name, module in modules.items():
            module.load_state_dict(state[name])
        if len(state["rng"]) != rank_and_world_size()[1]:
            raise ValueError(f"it was trained by {len(state['rng'])} processes")
        rng = state["rng"][rank_and_world_size()[0]]
        torch.set_rng_state(rng["torch"])
        torch.cuda.set_rng_state_all(rng["cuda"][: torch.cuda.device_count()])
        for name, stream in envs.generators.items():
            stream.bit_generator.state = json.loads(rng[name])
        return {name: state["progress"][name] for name in COUNTERS}
    except Exception as error:  # an edited file fails in many ways, which are all the same to the user
        allowed = "must be whole, and of the script and vehicle as they are"
        fail(f"--resume {run_dir}: its training_state.pt does not fit ({error}); {allowed}")


def load_state(run_dir, script):
    """The training state of a run folder.

    Ends with one line if the state is missing, damaged or of another script.
    """
    try:
        path = Path(run_dir) / "training_state.pt"
        damaged = zipfile.ZipFile(path).testzip()  # torch checks no CRC
        if damaged:
            raise ValueError(f"{damaged} is damaged")
        state = torch.load(path, map_location="cpu", weights_only=True)
        args = state["args"] = {**younger(script), **state["args"]}
        kinds = get_type_hints(script.Args)
        if args["env_id"] not in script.ENV_IDS:
            raise ValueError(f"it is of {args['env_id']}; this script takes {', '.join(script.ENV_IDS)}")
        if args.keys() != kinds.keys():
            raise ValueError(f"{min(args.keys() ^ kinds.keys())} is not among the arguments of both")
        values = vars(script.Args(**args))
        wrong = [name for name in kinds if not isinstance(values[name], kinds[name])]
        if wrong:
            raise ValueError(f"{wrong[0]} is {args[wrong[0]]!r}")
    except Exception as error:  # a missing or damaged file fails in many ways, which are all the same to the user
        fail(f"--resume {run_dir}: must hold a training_state.pt of {script.Args.exp_name}.py ({error})")
    return state


def save_run(run_dir, state):
    """Write the training state, and the averaged weights in it as agent.safetensors. A file is never half-written."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    files.write_bytes(run_dir / "training_state.pt", buffer.getbuffer())
    metadata = {"env_id": state["args"]["env_id"], "args": json.dumps(state["args"]), **state["progress"]}
    if KEY in state:
        metadata[KEY] = state[KEY]
    averaged = {name: x for name, x in state["average"].items() if name != "n_averaged"}
    weights = {name.removeprefix("module."): x.cpu() for name, x in averaged.items()}
    data = safetensors.torch.save(weights, {key: str(value) for key, value in metadata.items()})
    files.write_bytes(run_dir / "agent.safetensors", data)


# ---------------------------------------------------------------------------------------------------------------------
# The memory of a process
# ---------------------------------------------------------------------------------------------------------------------


def keep_memory():
    """Let glibc keep the memory that tensors free, for the next tensors. Without glibc nothing happens.

    By default glibc hands large blocks back to the system, which clears each page before it lends the page again. The
    clearing takes a tenth of an update of the small networks, and a quarter at Table 1's size.
    """
    with contextlib.suppress(AttributeError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        for option, value in ((-4, 0), (-1, 2**31 - 1)):  # M_MMAP_MAX, M_TRIM_THRESHOLD of <malloc.h>
            mallopt(option, value)


# ---------------------------------------------------------------------------------------------------------------------
# Processes: torchrun starts several processes of a script, which share the environments and sum their gradients
# ---------------------------------------------------------------------------------------------------------------------


OF_TORCHRUN = ("WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT")  # it sets them beside RANK


def join_processes(cuda):
    """Under torchrun, which sets RANK, become one of its processes. With GPUs each process takes its own."""
    if "RANK" not in os.environ or dist.is_initialized():
        return
    missing = [name for name in OF_TORCHRUN if name not in os.environ]
    if missing:
        todo = "torchrun sets both; without it unset RANK"
        fail(f"RANK is {os.environ['RANK']}, but {missing[0]} is not set; {todo}")
    use_gpu = torch.cuda.is_available() and cuda
    try:
        if use_gpu:
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
        dist.init_process_group("nccl" if use_gpu else "gloo")
    except (RuntimeError, ValueError) as error:  # a wrong number, or processes that do not meet
        found = ", ".join(f"{name}={os.environ[name]}" for name in ("RANK", *OF_TORCHRUN))
        fail(f"{found}: torchrun's processes cannot start ({error})")


def rank_and_world_size():
    """This process's rank, and the number of processes that torchrun started. Without torchrun they are 0 and 1."""
    if not dist.is_initialized():
        return 0, 1
    return dist.get_rank(), dist.get_world_size()


def all_gather(value):
    """The values of all processes, in the order of their ranks."""
    values = [value] * rank_and_world_size()[1]
    if dist.is_initialized():
        dist.all_gather_object(values, value)
    return values


def gathered(episodes):
    """The `final_info` {key: (N, ...)} of the flights of all processes, in the order of their ranks."""
    of_each_process = all_gather(episodes)
    return {key: np.concatenate([part[key] for part in of_each_process]) for key in episodes}


def local_shard(values, count):
    """This process's part of `values`, which hold `count` values for each process in the order of their ranks."""
    rank, _ = rank_and_world_size()
    begin = sum(all_gather(count)[:rank])
    return values[begin : begin + count]


def total(x):
    """The sum over all processes of a tensor, or of each tensor of a list, in place. In one process it is x itself.

    One buffer holds all tensors of a list, because each exchange takes time.
    """
    if not dist.is_initialized():
        return x
    if isinstance(x, torch.Tensor):
        dist.all_reduce(x)
        return x
    flat = total(torch.cat([tensor.flatten() for tensor in x]))
    for tensor, part in zip(x, flat.split([tensor.numel() for tensor in x])):
        tensor.copy_(part.view_as(tensor))
    return x
