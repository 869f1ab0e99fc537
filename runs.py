"""What surrounds the learning in the ppo_gtrxl_*.py scripts: arguments, a run's files and messages, memory, processes.

Bad input ends with one line and exit status 1.
"""

from __future__ import annotations

import contextlib
import copy
import ctypes
import gc
import hashlib
import importlib.util
import io
import json
import math
import os
import re
import signal
import sys
import time
import zipfile
from dataclasses import asdict, replace
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, NoReturn, get_type_hints

import gymnasium as gym
import safetensors.torch
import torch
import torch.distributed as dist
import tyro

import evaluate
from common import files
from common.batch import make_batch
from common.checkpoints import COUNTERS, read_checkpoint
from common.curves import read_curve
from common.errors import BadInput, NoOptimum
from common.evaluations import write_evaluation
from common.tasks import Task, task_of
from common.tasks import env_ids as known_ids

gc.freeze()  # what was imported is never garbage; looking through it took a fifth of the time of --help

# ---------------------------------------------------------------------------------------------------------------------
# Arguments
# ---------------------------------------------------------------------------------------------------------------------


def schedule_of(words):
    """A flag's words: one number, or points "0:-1 0.4:-2 1:-6" over the training. ValueError where they are neither."""
    if len(words) > 1 or ":" in "".join(words):
        return " ".join(words)
    if not words:
        raise ValueError("must be a number, or points as 0:-1 0.4:-2 1:-6")
    word = words[0]
    return int(word) if word.isdigit() else float(word)


Schedule = Annotated[
    float | int | str,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs="*",
        metavar="VALUE | PLACE:VALUE ...",
        instance_from_str=schedule_of,
        is_instance=lambda value: isinstance(value, float | int | str),
        str_from_instance=lambda value: str(value).split(),
    ),
]
Numbers = Annotated[
    list | None,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs="*",
        metavar="NUMBER ...",
        instance_from_str=lambda words: [float(word) for word in " ".join(words).split()],
        is_instance=lambda value: value is None or isinstance(value, list),
        str_from_instance=lambda value: [str(number) for number in value or ()],
    ),
]
RANGES = {  # lowest and highest value of every numeric flag; NaN and infinity are outside
    **dict.fromkeys(["seed", "eval_seed", "num_threads", "eval_every"], (0, 2**31 - 1)),
    **dict.fromkeys(["total_updates", "num_envs", "num_minibatches", "update_epochs"], (1, 10**6)),
    **dict.fromkeys(["embed_dim", "num_heads", "mlp_dim", "hidden_dim"], (1, 8192)),
    **dict.fromkeys(["learning_rate", "clip_coef", "gamma", "gae_lambda", "memory_noise"], (0.0, 1.0)),
    **dict.fromkeys(["ent_coef", "vf_coef", "mass_weight", "fuel_weight", "slope_weight"], (0.0, 1e3)),
    **dict.fromkeys(["reward_scale", "max_grad_norm", "target_kl"], (1e-9, 1e9)),
    **{"log_std": (-8.0, 0.5), "log_radius": (-5.0, 14.0)},
    **{"eval_starts": (10, 10**6), "num_blocks": (0, 64), "memory_length": (0, 8192)},
    **{"flights_per_start": (1, 10**6), "dispersion": (0.0, 10.0), "weight_average": (0.0, 0.99999)},
    **{"failure_probability": (0.0, 1.0), "decision_s": (0.2, 10.0), "longest_flight": (1.0, 1000.0)},
    **dict.fromkeys(["failure_size", "training_failure_size"], (1.0, 100.0)),
    **{"thrust_share": (0.2, 1.0), "start_spread": (0.0, 2.0), "wind": (0.0, 10.0), "action_hold": (1.0, 500.0)},
    "failure": (0.0, 0.3),
}
RECIPE_WORDS = ("ours", "paper")
NETWORK = ("num_blocks", "embed_dim", "num_heads", "memory_length", "mlp_dim", "hidden_dim")
# options of the environment: chosen anew for each run and evaluation
NOT_OF_A_CHECKPOINT = {"dispersion", "failure", "navigation_noise"}
MAY_DIFFER_FROM_A_CHECKPOINT = {"failure_probability", "failure_size", "failure_time"}  # else they are the file's
CHANGED_BY_TRAINING = {"differences"}  # constants of an agent that a training may set anew
MAY_CHANGE_ON_RESUME = {"resume", "cuda", "num_threads"}


def fail(message) -> NoReturn:
    """End with one line on stderr and exit status 1."""
    sys.exit(f"error: {' '.join(str(message).split())}")


def refuse(name, value, allowed) -> NoReturn:
    """End with one line that names a field of Args as its flag, its value and what is allowed."""
    flag = f"--{name.replace('_', '-')} {value}".strip()
    fail(f"{flag}: {allowed}")


def read_flags(defaults, argv):
    """The dataclass that a command line describes, and the set of fields that it names; `defaults` has the others.

    tyro alone knows which flags there are and what they take, but neither which of them were typed nor how to complain
    in one line: the names are read from `argv`, and of its framed message the first paragraph is shown.
    """
    with contextlib.redirect_stderr(io.StringIO()) as frame:
        try:
            args = tyro.cli(type(defaults), args=argv, default=defaults, description=allowed(defaults))
        except SystemExit as stop:
            if not stop.code:  # --help
                raise
            lines = (line.strip("│ ") for line in frame.getvalue().splitlines() if line[:1] != "╭")
            first = " ".join(takewhile(lambda line: line[:1] not in ("─", "╰"), lines))
            fail(f"{first} (--help lists what is allowed)")
    words = [word.split("=")[0] for word in argv if word.startswith("--")]
    return args, {word.removeprefix("--").replace("-", "_").removeprefix("no_") for word in words}


def allowed(args):
    """What --help says of the numbers: each flag with its range."""
    ranges = {name: bounds for name, bounds in RANGES.items() if hasattr(args, name)}
    flags = (f"--{name.replace('_', '-')} {low:g} to {high:g}" for name, (low, high) in ranges.items())
    return f"Ranges: {', '.join(flags)}"


def parse_args(kind, recipe, argv, env_options, buffers):
    """A script's checked arguments; with --resume the saved training state, with a checkpoint what that file holds.

    kind is the script's Args, `recipe(args)` what its recipe changes for these environments, env_options the arguments
    that go to its environments, buffers what its agents hold by environment id. What was typed wins over what a
    checkpoint decides, that over the recipe, and that over Args. SystemExit with one line that names the flag, the
    value and what is allowed.
    """
    asks_for_help = not {"-h", "--help"}.isdisjoint(argv)
    typed_args, typed = read_flags(kind(), [word for word in argv if word not in ("-h", "--help")])
    env_ids = tuple(buffers)
    if typed_args.resume is not None and not asks_for_help:
        refused = sorted(typed - MAY_CHANGE_ON_RESUME)
        if refused:
            refuse(refused[0], "", "only --cuda and --num-threads may be given beside --resume")
        saved = load_state(typed_args.resume, kind, env_ids)
        args = kind(**{**saved["args"], **{name: getattr(typed_args, name) for name in typed}})
        defaults = args
    else:
        defaults, saved = resolve(typed_args, typed, kind, recipe, env_options, buffers)
        args, _ = read_flags(defaults, argv)
    check(args, env_ids)
    check_buffers(args, buffers[args.env_id])
    task = task_of(args.env_id)
    if unfit := task.refusal(not args.eval_only, **options_of(args, env_options)):
        name, why = unfit
        refuse(name, getattr(args, name, ""), why)
    check_share(args, typed)
    if args.eval_only and saved and saved["progress"]["seed"] == args.eval_seed:
        if remark := task.remark_on_seed(args.eval_seed):
            print(remark)
    if args.eval_starts is None:
        is_cut_short = not args.eval_only and args.total_updates < defaults.total_updates
        args.eval_starts = task.default_flights(is_cut_short, **options_of(args, env_options))
    return args, saved


def resolve(args, typed, kind, recipe, env_options, buffers):
    """Args with all that was not typed as the checkpoint and the recipe have it; and what the checkpoint holds."""
    saved = None
    decided = {}
    if args.checkpoint is not None:
        saved, decided = take_checkpoint_args(args, kind, typed, env_options, buffers)
    elif args.eval_only:
        refuse("checkpoint", None, "must name the agent.safetensors that --eval-only flies")
    check_values(args, tuple(buffers))
    changes = recipe(args) if args.recipe == "ours" else {}
    if args.checkpoint is None and "checkpoint" in changes:
        first = changes["checkpoint"]
        if not Path(first).is_file():
            first = str(Path(__file__).parent / first)
        if not Path(first).is_file():
            fail(
                f"the recipe begins with the policy {first}, which is not there: train it first, or name a --checkpoint"
            )
        _, its_own = read_policy(first, kind, env_options, buffers)
        differing = contradictions(args, typed, its_own)
        if differing:
            flag = f"--{differing[0].replace('_', '-')} {getattr(args, differing[0])}"
            print(f"{flag}: the recipe's first policy, {first}, has another; this training begins anew")
        else:
            args.checkpoint = first
            saved, decided = take_checkpoint_args(args, kind, typed, env_options, buffers)
    return replace(kind(), **{**changes, **decided, "checkpoint": args.checkpoint}), saved


def observation_scale(env_id):
    """The constant of an agent by which `features` divides observations: the environment's."""
    return {"observation_scale": make_batch(env_id, 1).observation_scale.tolist()}


def options_of(args, env_options):
    """The keywords of the environments, from the arguments of these names."""
    return {name: getattr(args, name) for name in env_options}


def read_policy(path, kind, env_options, buffers):
    """What an agent.safetensors holds, and the arguments that it decides. BadInput where it is damaged or foreign."""
    options = [name for name in env_options if name not in NOT_OF_A_CHECKPOINT]
    names = ("env_id", *options, *NETWORK)
    kinds = {name: type(getattr(kind, name)) for name in names}
    younger = {name: getattr(kind, name) for name in options}  # perhaps than the file
    saved = read_checkpoint(path, kinds, tuple(buffers), younger)
    return saved, {name: saved["args"][name] for name in names}


def contradictions(args, typed, decided):
    """The fields that were typed and are not as a checkpoint decides them."""
    fixed = {name: value for name, value in decided.items() if name not in MAY_DIFFER_FROM_A_CHECKPOINT}
    return [name for name, value in fixed.items() if name in typed and getattr(args, name) != value]


def take_checkpoint_args(args, kind, typed, env_options, buffers):
    """What the file --checkpoint holds, and the arguments that it decides; sets these, refuses flags that contradict.

    Its environment may be another with the same buffers. A noise that is learned goes on from the file's, unless a flag
    says otherwise.
    """
    saved, decided = read_policy(args.checkpoint, kind, env_options, buffers)
    for name in contradictions(args, typed, decided):
        value, given = decided[name], getattr(args, name)
        if name == "env_id" and buffers.get(value) == buffers.get(given):
            print(f"--checkpoint is of {value}; it goes on with {given}")
            decided[name] = given
        else:
            refuse(name, given, f"the checkpoint has {value}; leave the flag out")
    decided |= {name: getattr(args, name) for name in MAY_DIFFER_FROM_A_CHECKPOINT & typed}
    for name, value in decided.items():
        setattr(args, name, value)
    saved["keeps_log_std"] = "log_std" not in typed
    return saved, decided


def check_values(args, env_ids):
    """Refuse a number out of its range, and a word that is not among those of its flag."""
    check_word(args, "env_id", env_ids)
    choices = {"recipe": RECIPE_WORDS}
    if args.env_id in known_ids():  # of another one `check_buffers` says what is missing
        choices |= task_of(args.env_id).choices()
    for name, words in choices.items():
        check_word(args, name, words)
    kinds = get_type_hints(type(args), include_extras=True)
    for name, value in vars(args).items():
        if name not in RANGES or value is None:
            continue
        low, high = RANGES[name]
        values = schedule_values(name, value) if kinds[name] == Schedule else [value]
        if not all(low <= number <= high for number in values):
            refuse(name, value, f"must be between {low} and {high}")
    if not all(number.is_integer() for number in schedule_values("flights_per_start", args.flights_per_start)):
        refuse("flights_per_start", args.flights_per_start, "must be whole numbers")


def check_word(args, name, words):
    """Refuse a flag that is none of the words that it may be; a script need not have it."""
    value = getattr(args, name, words[0])
    if value not in words:
        refuse(name, value, f"must be one of {', '.join(words)}")


def check(args, env_ids):
    """Refuse what no run can use: SystemExit with one line that names the flag, the value and what is allowed.

    args is a script's Args, env_ids the script's environments.
    """
    check_values(args, env_ids)
    if args.embed_dim % args.num_heads:
        refuse("num_heads", args.num_heads, f"must divide --embed-dim {args.embed_dim}")
    check_outputs(args)
    if Path(args.exp_name).name != args.exp_name:
        refuse("exp_name", args.exp_name, "must be the name of a folder, without /")
    if args.track and importlib.util.find_spec("wandb") is None:
        refuse("track", "", "needs wandb: pip install wandb")


def schedule_values(name, schedule):
    """The numbers that a schedule goes through; one line if it is none."""
    if not isinstance(schedule, str):
        return [float(schedule)]
    try:
        points = [[float(word) for word in point.split(":")] for point in schedule.split()]
        places, values = zip(*points)
        if list(places) != sorted(places) or not all(0 <= place <= 1 for place in places):
            raise ValueError
    except ValueError:
        refuse(name, schedule, "must be a number, or points as 0:-1 0.4:-2 1:-6 whose places rise from 0 to 1")
    return values


def check_outputs(args):
    """Refuse an --eval-json or --eval-npz that cannot be written, or would replace another file of the command."""
    taken = {Path(args.checkpoint or "").resolve()}
    for name in ("eval_json", "eval_npz"):
        value = getattr(args, name)
        if value is None:
            continue
        path = Path(value).resolve()
        if not args.eval_only or path.is_dir() or not os.access(path.parent, os.W_OK):
            refuse(name, value, "only with --eval-only, and must be a file in an existing, writable folder")
        if path in taken:
            refuse(name, value, "must be a file of its own, neither --checkpoint nor --eval-json")
        taken.add(path)


def check_buffers(args, buffers):
    """Refuse a script's BUFFERS whose scale does not fit the observations, and an id that no environment has.

    buffers are those of --env-id. Only `observation_scale` is one number an observation; the others are the script's.
    """
    try:
        spec = gym.spec(args.env_id)
    except gym.error.Error:
        refuse("env_id", args.env_id, "no environment of this id is registered; envs.PROBLEMS must have it")
    scale = buffers.get("observation_scale")
    if scale is None:
        return
    where = f"BUFFERS of {type(args)().exp_name}.py: observation_scale of {args.env_id}"
    inputs = gym.spaces.flatdim(gym.make_vec(spec, num_envs=1).single_observation_space)
    if len(scale) != inputs:
        allowed = f"must hold {inputs} numbers, one for each of its observations"
        fail(f"{where} holds {len(scale)}; {allowed}")
    if not all(math.isfinite(number) and number for number in scale):
        fail(f"{where} is {scale}; must be finite, without 0")


def check_share(args, typed):
    """What each of torchrun's processes flies: at least one episode a minibatch, and whole groups.

    --num-minibatches and --flights-per-start are lowered where they were left alone, with a printed line.
    """
    processes = int(os.environ.get("WORLD_SIZE", 1))
    if args.num_envs < processes:
        refuse("num_envs", args.num_envs, f"must be at least the number of processes, {processes}")
    smallest, largest = args.num_envs // processes, -(-args.num_envs // processes)  # the first processes fly one more
    total_envs = f"--num-envs {args.num_envs}" + (f" / {processes} processes" if processes > 1 else "")

    if args.num_minibatches > smallest:
        if "num_minibatches" in typed:
            refuse("num_minibatches", args.num_minibatches, f"must be at most {total_envs}")
        print(f"--num-minibatches lowered from {args.num_minibatches} to {total_envs}")
        args.num_minibatches = smallest

    shares = {smallest, largest}
    groups = {int(group) for group in schedule_values("flights_per_start", args.flights_per_start)}
    for group in groups:
        fits = largest_group(group, shares)
        if fits == group:
            continue
        if "flights_per_start" in typed:
            refuse("flights_per_start", args.flights_per_start, f"must divide {total_envs}")
        print(f"--flights-per-start lowered from {group} to {fits}, which divides {total_envs}")
        if isinstance(args.flights_per_start, str):
            args.flights_per_start = re.sub(rf":{group}\b", f":{fits}", args.flights_per_start)
        else:
            args.flights_per_start = fits


def largest_group(most, shares):
    """The largest group of at most `most` flights that divides every process's share of the environments."""
    return next(group for group in range(most, 0, -1) if all(share % group == 0 for share in shares))


# ---------------------------------------------------------------------------------------------------------------------
# Start of a script
# ---------------------------------------------------------------------------------------------------------------------


def start(main):
    """Run a script's `main(argv)`: Ctrl-C and SIGTERM end it with status 130 and 143, bad input with one line and 1."""
    status = [128 + signal.SIGINT]

    def interrupt(signum, _):
        status[0] = 128 + signum
        raise KeyboardInterrupt

    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, interrupt)
    try:
        main(sys.argv[1:])
    except (BadInput, NoOptimum, ImportError, OSError) as error:
        fail(error)
    except KeyboardInterrupt:
        sys.exit(status[0])


def prepare_torch(args):
    """Threads, seeds and torchrun's processes; returns the device of the networks."""
    keep_memory()
    torch.set_num_threads(args.num_threads or torch.get_num_threads())
    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    join_processes(args.cuda)
    return "cuda" if torch.cuda.is_available() and args.cuda else "cpu"


def make_envs(args, env_options):
    """This process's share of the environments, seeded; env_options go to each.

    An evaluation draws its starts as a reset does: its seed would train on them, so another takes its place.
    """
    rank, processes = rank_and_world_size()
    share = args.num_envs // processes + (rank < args.num_envs % processes)
    envs = make_batch(args.env_id, share, **env_options)
    seed = args.seed + 2**31 * rank
    envs.reset(seed=seed + 2**40 if seed in (args.eval_seed, TRAINING_EVAL_SEED) else seed)
    return envs


def load_checkpoint(agent, args, saved):
    """Put the weights of --checkpoint, if there is one, into a new agent; one line if they do not fit."""
    if args.checkpoint is None or args.resume is not None:
        return
    expected = {name: tuple(tensor.shape) for name, tensor in agent.state_dict().items()}
    shapes = {name: array.shape for name, array in saved["tensors"].items()}
    if differing := [name for name in {**expected, **shapes} if expected.get(name) != shapes.get(name)]:
        name = differing[0]
        theirs, here = (shape.get(name, "missing") for shape in (shapes, expected))
        why = f"{name} is {theirs} in the file and {here} in this script"
        todo = "train it anew, or fly it by the version that trained it (CHANGELOG.md)"
        fail(f"--checkpoint {args.checkpoint}: does not fit its own args, BUFFERS or features ({why}); {todo}")
    for name, constant in constants_of(agent).items():
        if not torch.allclose(constant.cpu(), torch.from_numpy(saved["tensors"][name]), rtol=1e-6):
            print(f"--checkpoint {args.checkpoint}: its {name} is not that of {args.env_id} now; it flies by its own")
            break
    try:
        agent.load_state_dict({name: torch.from_numpy(array) for name, array in saved["tensors"].items()})
    except (RuntimeError, TypeError) as error:  # a type that torch does not have
        fail(f"--checkpoint {args.checkpoint}: its weights do not fit its own args ({error})")
    if agent.actor_logstd.requires_grad and not saved["keeps_log_std"]:
        torch.nn.init.constant_(agent.actor_logstd, float(args.log_std))
    if not args.eval_only:
        print(f"begins with {args.checkpoint}, sha256 {hashlib.sha256(Path(args.checkpoint).read_bytes()).hexdigest()}")


def constants_of(agent):
    """The buffers of a new agent that no training changes, by name; one that a training fills is zeros in it."""
    return {name: x for name, x in agent.named_buffers() if x.any() and name not in CHANGED_BY_TRAINING}


def finite(values, epoch, minibatch):
    """These logged tensors as numbers, in one copy from a GPU. FloatingPointError that names one that is not finite."""
    numbers = dict(zip(values, torch.stack(list(values.values())).tolist()))
    for name, number in numbers.items():
        if not math.isfinite(number):
            raise FloatingPointError(f"{name} is {number} in epoch {epoch}, minibatch {minibatch}")
    return numbers


# ---------------------------------------------------------------------------------------------------------------------
# A run: its folder, counters, messages and evaluations
# ---------------------------------------------------------------------------------------------------------------------

SAVE_EVERY = 10  # updates
TRAINING_EVAL_SEED = 2**31  # beyond --eval-seed: no reported start is flown during training


class Run:
    """One run: `with run:` opens its folder and keeps what was learned whatever ends the training, `end_update` counts,
    saves, evaluates and logs, `finish` makes the reported evaluation. Under torchrun only the first process writes.

    `progress` holds the counters; `training_seconds` are those of rollouts and updates, `wall_seconds` all until the
    end of the last rollout and update: the evaluations and saves before it, too.
    """

    def __init__(self, args, saved, agent, average, optimizer, envs, env_options, describe):
        self.args, self.envs, self.env_options, self.describe = args, envs, env_options, describe
        self.first_steps = envs.episode_steps  # training may make episodes of `envs` longer or shorter
        self.modules = {"agent": agent, "average": average, "optimizer": optimizer}
        self.rank, _ = rank_and_world_size()
        self.task: Task = task_of(args.env_id)
        self.folder: Any = None  # a Path; it and TensorBoard's writer are of the first process, from `with run:` on
        self.writer: Any = None
        self.metrics = {}
        if self.rank > 0:  # the same weights, other noise
            torch.manual_seed(args.seed + 2**31 * self.rank)
        self.progress = {"seed": args.seed, "total_updates": 0, "global_step": 0}
        self.progress |= {"training_seconds": 0.0, "wall_seconds": 0.0}
        if args.resume is not None:
            self.folder = Path(args.resume)
            self.progress = restore(saved, self.folder, self.modules, envs)
        elif args.eval_only:
            self.progress = saved["progress"]
        self.began = time.time() - self.progress["wall_seconds"]
        self.update_began = time.time()

    @property
    def updates_done(self):
        """Updates that are learned and counted."""
        return self.progress["total_updates"]

    def __enter__(self):
        self.state = training_state(self.args, self.modules, self.envs, self.progress)
        if self.rank > 0:
            return self
        is_new = self.folder is None
        self.folder = self.folder or new_folder(f"{self.args.env_id}__{self.args.exp_name}__{self.args.seed}")
        try:
            if self.args.track:
                track(self.args, self.folder.name)
            self.solve_reference()
        except BaseException:
            if is_new:
                with contextlib.suppress(OSError):  # what holds other runs, or files, stays
                    self.folder.rmdir()
                    self.folder.parent.rmdir()
            raise
        print(f"run folder: {self.folder}", flush=True)
        for leftover in self.folder.glob(".*.tmp"):  # of a writer that was killed
            leftover.unlink()
        arguments = {**asdict(self.args), "resume": None}
        if self.args.save_model:
            files.write_json(self.folder / "args.json", arguments)
        self.writer = new_writer(self.folder, self.progress["global_step"] + 1, arguments)
        self.save()
        self.update_began = time.time()
        return self

    def solve_reference(self):
        """The optima that evaluations fly, before anything is learned: one that does not exist is said at once."""
        evaluates_on_the_way = 0 < self.args.eval_every <= self.args.total_updates
        seeds = [TRAINING_EVAL_SEED] * evaluates_on_the_way + [self.args.eval_seed]
        for seed in seeds:
            self.task.optimum(seed, self.flights(seed), **self.env_options)

    def __exit__(self, kind, error, traceback):
        if self.writer:
            self.writer.flush()
        if error is None:
            return
        if not isinstance(error, KeyboardInterrupt | FloatingPointError):
            with contextlib.suppress(OSError):  # a full disk is perhaps what ended it
                self.save()
            return
        self.save()
        updates, saved = self.state["progress"]["total_updates"], self.args.save_model and self.rank == 0
        if isinstance(error, FloatingPointError):
            kept = f"; the last good checkpoint is {self.folder}/training_state.pt" if saved else ""
            fail(f"update {updates + 1}: {error}, must be finite{kept}")
        script = type(self.args)().exp_name
        kept = f"go on with: python {script}.py --resume {self.folder}" if saved else "nothing saved"
        if self.rank == 0:
            print(f"stopped after update {updates}; {kept}")

    def save(self):
        """Write the state after the last whole update."""
        if self.args.save_model and self.rank == 0:
            save_run(self.folder, self.state)

    def end_update(self, iteration, alive, episodes, losses, learning_rate):
        """Count an update; save every ten, evaluate every --eval-every, log it and now and then print a line.

        alive (T, N) is the batch's, episodes the `final_info` of all, losses the means over the update.
        """
        args, now = self.args, time.time()
        steps = int(all_reduce_sum(alive.sum()))
        self.progress = {**self.progress, "total_updates": iteration, "wall_seconds": now - self.began}
        self.progress["global_step"] += steps
        self.progress["training_seconds"] += now - self.update_began
        state = training_state(args, self.modules, self.envs, self.progress)
        if self.rank == 0:
            if args.eval_every and iteration % args.eval_every == 0:
                self.metrics, _ = self.evaluate(TRAINING_EVAL_SEED)
                self.log("eval", self.metrics)
            charts = {"episodic_return": episodes["episodic_return"].mean().item(), "learning_rate": learning_rate}
            charts["episodic_length"] = steps / args.num_envs
            charts["SPS"] = int(self.progress["global_step"] / self.progress["training_seconds"])
            self.log("charts", charts)
            self.log("losses", losses)
            if iteration % (args.eval_every or max(1, args.total_updates // 100)) == 0 or iteration == 1:
                self.print_line(episodes)
        self.state = state  # only now: where an evaluation is interrupted, a resume makes its update again
        if iteration % SAVE_EVERY == 0 or iteration == args.total_updates:
            self.save()
        self.update_began = time.time()

    def print_line(self, episodes):
        """A line to follow the run by."""
        done, of, seconds = self.progress["total_updates"], self.args.total_updates, time.time() - self.began
        clock = f"{seconds / 60:.1f} min gone, {(of - done) * seconds / done / 60:.1f} to go"
        line = f"update {done}/{of}, {self.progress['global_step']} steps, {clock}"
        print(f"{line}: {self.describe(episodes, self.metrics)}", flush=True)

    def log(self, prefix, values):
        """Write every number of `values` under its TensorBoard tag."""
        for name, value in values.items():
            if isinstance(value, int | float):
                self.writer.add_scalar(f"{prefix}/{name}", value, self.progress["global_step"])

    def evaluate(self, eval_seed):
        """Fly the mean action of the averaged weights and the optimum: eval.json's metrics and eval.npz's arrays."""
        average = self.modules["average"].module
        policy = average.make_policy(self.longest_episode)
        metrics, arrays = self.task.evaluate(policy, eval_seed, self.flights(eval_seed), **self.env_options)
        device = average.actor_logstd.device.type
        return {**metrics, **self.progress, "device": device, "torch_version": torch.__version__}, arrays

    @property
    def longest_episode(self):
        """Steps that an episode of an evaluation has at most."""
        return max(self.first_steps, self.envs.episode_steps)

    def flights(self, eval_seed):
        """How many flights the evaluation of a seed has."""
        if eval_seed == TRAINING_EVAL_SEED:
            return self.task.interim_flights(self.args.eval_starts, **self.env_options)
        return self.args.eval_starts

    def finish(self):
        """Fly the reported starts; write the evaluation where it was asked for, print the table."""
        args = self.args
        if self.rank > 0:
            return
        metrics, arrays = self.evaluate(args.eval_seed)
        timed_policy = self.modules["average"].module.make_policy(self.longest_episode) if args.eval_only else None
        metrics |= self.task.reported_metrics(metrics, timed_policy, **self.env_options)
        if args.eval_only:
            write_evaluation(metrics, arrays, args.checkpoint, args.eval_json, args.eval_npz)
            print(self.task.table(metrics))
            return
        self.log("eval", metrics)
        self.writer.close()
        if args.save_model:
            paths = (self.folder / name for name in ("agent.safetensors", "eval.json", "eval.npz"))
            write_evaluation(metrics, arrays, *paths)
        if args.capture_video:
            evaluate.draw_figures(self.folder, arrays, metrics, [read_curve(self.folder)])
            evaluate.draw_animation(self.folder, arrays, metrics)
        print(self.task.table(metrics))
        print(f"run folder: {self.folder}")


def new_folder(name):
    """A new runs/{name}__{unix time}; of two runs that start within a second the later one waits for the next."""
    while True:
        folder = Path(f"runs/{name}__{int(time.time())}")
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            if not folder.is_dir():
                raise
            time.sleep(0.1)


def new_writer(folder, first_step, arguments):
    """TensorBoard's writer, with the hyperparameters as text, as CleanRL's; a resumed run drops what it does again."""
    from torch.utils.tensorboard import SummaryWriter

    writer = SummaryWriter(folder, purge_step=first_step)
    rows = "\n".join(f"|{name}|{value}|" for name, value in arguments.items())
    writer.add_text("hyperparameters", f"|param|value|\n|-|-|\n{rows}")
    return writer


def track(args, name):
    """Follow the run with Weights and Biases; a resumed run goes on with the one that it began. One line on failure."""
    import wandb  # pyright: ignore[reportMissingImports] - optional, not among the requirements

    names = {"project": args.wandb_project_name, "entity": args.wandb_entity, "name": name, "id": name}
    try:
        wandb.init(**names, resume="allow", sync_tensorboard=True, config=asdict(args), save_code=True)
    except Exception as error:  # no login, no network, no such entity: wandb's errors have no common kind
        fail(f"--track: Weights and Biases refuses the run ({error}); `wandb login` first, or leave --track out")


# ---------------------------------------------------------------------------------------------------------------------
# Checkpoints
# ---------------------------------------------------------------------------------------------------------------------


def training_state(args, modules, envs, progress):
    """All that a bit-exact resume needs, copied, so that training can go on while it is kept."""
    modules = {name: module.state_dict() for name, module in modules.items()}
    rng = {"torch": torch.get_rng_state()}
    rng |= {name: json.dumps(stream.bit_generator.state) for name, stream in envs.generators.items()}
    rng = all_gather({**rng, "cuda": torch.cuda.get_rng_state_all()})
    return copy.deepcopy({"args": {**asdict(args), "resume": None}, "progress": progress, "rng": rng, **modules})


def restore(state, run_dir, modules, envs):
    """Put everything back where `training_state` found it; returns the progress. One line if something does not fit."""
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
    except Exception as error:  # an edited file fails in many ways, all alike to the user
        allowed = "must be whole, and of the script and vehicle as they are"
        fail(f"--resume {run_dir}: its training_state.pt does not fit ({error}); {allowed}")


def load_state(run_dir, kind, env_ids):
    """The training state of a run folder; one line if there is none, or it is damaged or another script's.

    kind is the script's Args, env_ids its environments.
    """
    try:
        path = Path(run_dir) / "training_state.pt"
        damaged = zipfile.ZipFile(path).testzip()  # torch checks no CRC
        if damaged:
            raise ValueError(f"{damaged} is damaged")
        state = torch.load(path, map_location="cpu", weights_only=True)
        # a flag that came after this run changes nothing where its default is None; any other is refused below
        came_later = {name: value for name, value in vars(kind()).items() if value is None}
        args = state["args"] = {**came_later, **state["args"]}
        kinds = get_type_hints(kind)
        if args["env_id"] not in env_ids:
            raise ValueError(f"it is of {args['env_id']}; this script takes {', '.join(env_ids)}")
        if args.keys() != kinds.keys():
            raise ValueError(f"{min(args.keys() ^ kinds.keys())} is not among the arguments of both")
        wrong = [name for name in kinds if not isinstance(args[name], kinds[name])]
        if wrong:
            raise ValueError(f"{wrong[0]} is {args[wrong[0]]!r}")
    except Exception as error:  # a missing, damaged or foreign file fails in many ways, all alike to the user
        fail(f"--resume {run_dir}: must hold a training_state.pt of {kind().exp_name}.py ({error})")
    return state


def save_run(run_dir, state):
    """Write the training state and, derived from it, the weights that evaluation uses; each whole or not at all."""
    torch.save(state, buffer := io.BytesIO())
    files.write_bytes(run_dir / "training_state.pt", buffer.getbuffer())
    metadata = {"env_id": state["args"]["env_id"], "args": json.dumps(state["args"]), **state["progress"]}
    weights = {k.removeprefix("module."): v.cpu() for k, v in state["average"].items() if k != "n_averaged"}
    data = safetensors.torch.save(weights, {key: str(value) for key, value in metadata.items()})
    files.write_bytes(run_dir / "agent.safetensors", data)


# ---------------------------------------------------------------------------------------------------------------------
# Memory
# ---------------------------------------------------------------------------------------------------------------------


def keep_memory():
    """Let glibc keep what tensors free, for the next ones; without glibc nothing happens.

    It would hand large blocks back to the system, which clears each page before it lends it again: a tenth of an update
    of the small networks, a quarter at Table 1's size.
    """
    with contextlib.suppress(AttributeError, TypeError):
        mallopt = ctypes.CDLL(None).mallopt
        for option, value in ((-4, 0), (-1, 2**31 - 1)):  # M_MMAP_MAX, M_TRIM_THRESHOLD of <malloc.h>
            mallopt(option, value)


# ---------------------------------------------------------------------------------------------------------------------
# Processes: torchrun starts several of a script, which share the environments and sum what they find
# ---------------------------------------------------------------------------------------------------------------------


def join_processes(cuda):
    """Under torchrun, which sets RANK, become one of its processes, each with its own GPU if there are."""
    if "RANK" in os.environ and not dist.is_initialized():
        if gpu := torch.cuda.is_available() and cuda:
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
        dist.init_process_group("nccl" if gpu else "gloo")


def rank_and_world_size():
    """Rank and number of the processes that torchrun started; 0, 1 without it."""
    return (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)


def all_gather(value):
    """The values of all processes, in the order of their ranks."""
    values = [value] * rank_and_world_size()[1]
    if dist.is_initialized():
        dist.all_gather_object(values, value)
    return values


def local_shard(values, count):
    """Of all processes' `values`, in the order of their ranks, the `count` of this one."""
    rank, _ = rank_and_world_size()
    begin = sum(all_gather(count)[:rank])
    return values[begin : begin + count]


def sum_gradients(agent):
    """Sum the gradients over all processes, in place, in one buffer: small exchanges cost their latency."""
    if dist.is_initialized():
        gradients = [parameter.grad for parameter in agent.parameters() if parameter.grad is not None]
        flat = all_reduce_sum(torch.cat([gradient.flatten() for gradient in gradients]))
        for gradient, part in zip(gradients, flat.split([gradient.numel() for gradient in gradients])):
            gradient.copy_(part.view_as(gradient))


def all_reduce_sum(x):
    """The sum of a tensor over all processes, in place."""
    if dist.is_initialized():
        dist.all_reduce(x)
    return x
