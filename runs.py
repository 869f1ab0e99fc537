"""What surrounds the learning in the ppo_gtrxl_*.py scripts.

Reading order: arguments, start of a script, a run with its files and messages, checkpoints, memory, processes. Bad
input ends a script with one line and exit status 1.
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
import numpy as np
import safetensors.torch
import torch
import torch.distributed as dist
import tyro

import envs as _envs  # noqa: F401 - makes every id known to `task_of`
from common import files
from common.batch import make_batch
from common.checkpoints import COUNTERS, read_checkpoint
from common.curves import read_curve
from common.errors import BadInput, NoOptimum
from common.evaluations import write_evaluation
from common.tasks import Task, task_of
from common.tasks import env_ids as known_ids
from drawing.evaluation import draw_animation, draw_figures

gc.freeze()  # imported modules are never garbage, and looking through them takes a fifth of the time of --help

# ---------------------------------------------------------------------------------------------------------------------
# Arguments
# ---------------------------------------------------------------------------------------------------------------------


def schedule_of(words):
    """The schedule that a flag's words give: one number, or points "0:-1 0.4:-2 1:-6" as one string.

    Raises ValueError if they are neither.
    """
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
RANGES = {  # lowest and highest value of every numeric flag; NaN and infinity are out of range
    **dict.fromkeys(["seed", "eval_seed", "eval_every"], (0, 2**31 - 1)),
    "num_threads": (0, 256),
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
    **{"failure_emphasis": (0.0, 10.0), "failed_fuel_share": (0.0, 1.0)},
    **{"thrust_share": (0.2, 1.0), "start_spread": (0.0, 2.0), "wind": (0.0, 10.0), "action_hold": (1.0, 500.0)},
    "failure": (0.0, 0.3),
}
ROOT = Path(__file__).resolve().parent
RECIPE_WORDS = ("ours", "paper")
NETWORK = ("num_blocks", "embed_dim", "num_heads", "memory_length", "mlp_dim", "hidden_dim")
# environment options that every run and evaluation chooses anew
NOT_OF_A_CHECKPOINT = {"dispersion", "failure", "navigation_noise"}
# environment options that a checkpoint decides unless they are typed
MAY_DIFFER_FROM_A_CHECKPOINT = {"failure_probability", "failure_size", "failure_time"}
CHANGED_BY_TRAINING = {"differences"}  # constants of an agent that a training may set anew
MAY_CHANGE_ON_RESUME = {"resume", "cuda", "num_threads"}


def fail(message) -> NoReturn:
    """End with one line on stderr and exit status 1."""
    sys.exit(f"error: {' '.join(str(message).split())}")


def refuse(name, value, allowed) -> NoReturn:
    """End with one line that names the flag of an Args field, its value and what is allowed."""
    flag = f"--{name.replace('_', '-')} {value}".strip()
    fail(f"{flag}: {allowed}")


def read_flags(defaults, argv):
    """The dataclass that a command line describes, and the set of fields that it names. `defaults` has the others.

    tyro knows which flags there are and what they take. It does not tell which flags were typed, so we read their names
    from `argv`. It complains in a frame of several lines, so we show the frame's first paragraph as one line.
    """
    with contextlib.redirect_stderr(io.StringIO()) as frame:
        try:
            args = tyro.cli(type(defaults), args=argv, default=defaults, description=allowed(defaults))
        except SystemExit as stop:
            if not stop.code:  # --help
                raise
            lines = [line.strip("│ ") for line in frame.getvalue().splitlines() if line[:1] != "╭"]
            first_paragraph = takewhile(lambda line: line[:1] not in ("─", "╰"), lines)
            fail(f"{' '.join(first_paragraph)} (--help lists what is allowed)")
    flags = [word.split("=")[0] for word in argv if word.startswith("--")]
    names = [flag.removeprefix("--").replace("-", "_") for flag in flags]
    return args, {name.removeprefix("no_") for name in names}


def allowed(args):
    """The line of --help that gives the range of each numeric flag."""
    ranges = {name: bounds for name, bounds in RANGES.items() if hasattr(args, name)}
    flags = (f"--{name.replace('_', '-')} {low:g} to {high:g}" for name, (low, high) in ranges.items())
    return f"Ranges: {', '.join(flags)}"


def parse_args(kind, recipe, argv, env_options, buffers):
    """A script's checked arguments, and what it begins with: a saved training state, a checkpoint's contents or None.

    - kind: the script's Args
    - recipe: the function recipe(args) -> what the recipe changes for these environments
    - env_options: names of the arguments that go to the environments
    - buffers: {environment id: the buffers of its agents}

    A typed flag wins over a checkpoint, a checkpoint over the recipe, and the recipe over Args. Raises SystemExit with
    one line that names the flag, the value and what is allowed.
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
    options = options_of(args, env_options)
    unfit = task.refusal(not args.eval_only, **options)
    if unfit:
        name, why = unfit
        refuse(name, getattr(args, name, ""), why)
    check_share(args, typed)
    if args.eval_only and saved and saved["progress"]["seed"] == args.eval_seed:
        remark = task.remark_on_seed(args.eval_seed)
        if remark:
            print(remark)
    if args.eval_starts is None:
        is_cut_short = not args.eval_only and args.total_updates < defaults.total_updates
        args.eval_starts = task.default_flights(is_cut_short, **options)
    return args, saved


def resolve(args, typed, kind, recipe, env_options, buffers):
    """Args as they are without the typed flags: the checkpoint's, then the recipe's; and what the checkpoint holds."""
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
            print(f"{flag}: the recipe's first policy, {first}, has another")
            changes = recipe(replace(args, checkpoint=""))  # "": there is no policy to begin with
        else:
            args.checkpoint = first
            saved, decided = take_checkpoint_args(args, kind, typed, env_options, buffers)
    return replace(kind(), **{**changes, **decided, "checkpoint": args.checkpoint}), saved


def observation_scale(env_id):
    """The buffer by which `features` divides observations, from the environment."""
    return {"observation_scale": make_batch(env_id, 1).observation_scale.tolist()}


def options_of(args, env_options):
    """The keyword arguments of the environments: {name: value} of the `args` that `env_options` names."""
    return {name: getattr(args, name) for name in env_options}


def read_policy(path, kind, env_options, buffers):
    """What an agent.safetensors holds, and the arguments that it decides.

    Raises BadInput if the file is damaged or of another script.
    """
    options = [name for name in env_options if name not in NOT_OF_A_CHECKPOINT]
    names = ("env_id", *options, *NETWORK)
    hints = get_type_hints(kind)
    kinds = {name: hints[name] for name in names}
    younger = {name: getattr(kind, name) for name in options}  # options that an older file does not have
    saved = read_checkpoint(path, kinds, tuple(buffers), younger)
    return saved, {name: saved["args"][name] for name in names}


def contradictions(args, typed, decided):
    """The typed fields that differ from what a checkpoint decides."""
    fixed = {name: value for name, value in decided.items() if name not in MAY_DIFFER_FROM_A_CHECKPOINT}
    return [name for name, value in fixed.items() if name in typed and getattr(args, name) != value]


def take_checkpoint_args(args, kind, typed, env_options, buffers):
    """What the file --checkpoint holds, and the arguments that it decides.

    Sets these arguments, and refuses flags that contradict them. --env-id may name another environment with the same
    buffers. A learned log-std goes on from the file's, unless --log-std is typed.
    """
    saved, decided = read_policy(args.checkpoint, kind, env_options, buffers)
    for name in contradictions(args, typed, decided):
        value = decided[name]
        given = getattr(args, name)
        if name == "env_id" and buffers.get(value) == buffers.get(given):
            print(f"--checkpoint is of {value}; it goes on with {given}")
            decided[name] = given
        elif name == "env_id":
            refuse(name, given, f"the checkpoint has {value}, whose policy does not fit")
        else:
            refuse(name, given, f"the checkpoint has {value}; leave the flag out")
    decided |= {name: getattr(args, name) for name in MAY_DIFFER_FROM_A_CHECKPOINT & typed}
    for name, value in decided.items():
        setattr(args, name, value)
    saved["keeps_log_std"] = "log_std" not in typed
    return saved, decided


def check_values(args, env_ids):
    """Refuse a number that is out of its range, and a word that its flag does not take."""
    check_env_id(args, env_ids)
    choices = {"recipe": RECIPE_WORDS}
    if args.env_id in known_ids():  # `check_buffers` refuses an unknown id
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


def check_env_id(args, env_ids):
    """Refuse an --env-id that the script does not have, and name the script that trains it if there is one."""
    if args.env_id in env_ids:
        return
    others = "".join(f"; {name}.py trains {args.env_id}" for name in scripts_with(args.env_id))
    refuse("env_id", args.env_id, f"must be one of {', '.join(env_ids)}{others}")


def scripts_with(env_id):
    """The names of the scripts that have this environment."""
    names = sorted(path.stem for path in ROOT.glob("ppo_gtrxl_*.py"))
    return [name for name in names if env_id in importlib.import_module(name).ENV_IDS]


def check_word(args, name, words):
    """Refuse a flag whose value is none of `words`. A flag that the script does not have is not checked."""
    value = getattr(args, name, words[0])
    if value not in words:
        refuse(name, value, f"must be one of {', '.join(words)}")


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


def schedule_values(name, schedule):
    """The numbers that a schedule goes through. Ends with one line if it is no schedule."""
    if not isinstance(schedule, str):
        return [float(schedule)]
    return schedule_points(name, schedule)[1]


def schedule_points(name, schedule):
    """The places and the values of a schedule's points. Ends with one line if it is no schedule."""
    try:
        points = [[float(word) for word in point.split(":")] for point in schedule.split()]
        places, values = zip(*points, strict=True)
        if len(points[0]) != 2 or list(places) != sorted(places) or not all(0 <= place <= 1 for place in places):
            raise ValueError
    except ValueError:
        refuse(name, schedule, "must be a number, or points as 0:-1 0.4:-2 1:-6 whose places rise from 0 to 1")
    return places, values


def group_sizes(args):
    """The sizes of the groups of all updates, as `set_curriculum` of the scripts rounds them."""
    schedule = args.flights_per_start
    if not isinstance(schedule, str):
        return {round(schedule)}
    places, values = schedule_points("flights_per_start", schedule)
    in_updates = np.interp(np.linspace(0, 1, args.total_updates), places, values)
    return {round(size) for size in in_updates} | {round(value) for value in values}


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


def check_buffers(args, buffers):
    """Refuse BUFFERS whose scale does not fit the observations, and an id that no environment has.

    buffers are those of --env-id. `observation_scale` has to hold one number for each observation. Other buffers are
    not checked.
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
    for group in group_sizes(args):
        fits = largest_group(group, shares)
        if fits == group:
            continue
        if "flights_per_start" in typed:
            in_one = f"; it is {group} in one update" if isinstance(args.flights_per_start, str) else ""
            refuse("flights_per_start", args.flights_per_start, f"must divide {total_envs}{in_one}")
        print(f"--flights-per-start lowered from {group} to {fits}, which divides {total_envs}")
        if isinstance(args.flights_per_start, str):
            args.flights_per_start = re.sub(rf":{group}\b", f":{fits}", args.flights_per_start)
        else:
            args.flights_per_start = fits


def largest_group(most, shares):
    """The largest group of at most `most` flights that divides every process's share of the environments."""
    fitting = [group for group in range(1, most + 1) if all(share % group == 0 for share in shares)]
    return fitting[-1]


# ---------------------------------------------------------------------------------------------------------------------
# Start of a script
# ---------------------------------------------------------------------------------------------------------------------


def start(main):
    """Run a script's `main(argv)`.

    Ctrl-C ends it with exit status 130, SIGTERM with 143, and bad input with one line and 1.
    """
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
    expected = {name: tuple(tensor.shape) for name, tensor in agent.state_dict().items()}
    shapes = {name: array.shape for name, array in saved["tensors"].items()}
    differing = [name for name in {**expected, **shapes} if expected.get(name) != shapes.get(name)]
    if differing:
        name = differing[0]
        in_file = shapes.get(name, "missing")
        here = expected.get(name, "missing")
        why = f"{name} is {in_file} in the file and {here} in this script"
        todo = "train it anew, or fly it by the version that trained it (CHANGELOG.md)"
        fail(f"--checkpoint {args.checkpoint}: does not fit its own args, BUFFERS or features ({why}); {todo}")
    for name, constant in constants_of(agent).items():
        if not torch.allclose(constant.cpu(), torch.from_numpy(saved["tensors"][name]), rtol=1e-6):
            print(f"--checkpoint {args.checkpoint}: {args.env_id} has another {name} now; the policy keeps its own")
            break
    try:
        agent.load_state_dict({name: torch.from_numpy(array) for name, array in saved["tensors"].items()})
    except (RuntimeError, TypeError) as error:  # the file can have a number type that torch does not have
        fail(f"--checkpoint {args.checkpoint}: its weights do not fit its own args ({error})")
    if agent.actor_logstd.requires_grad and not saved["keeps_log_std"]:
        torch.nn.init.constant_(agent.actor_logstd, float(args.log_std))
    if not args.eval_only:
        digest = hashlib.sha256(Path(args.checkpoint).read_bytes()).hexdigest()
        print(f"begins with {args.checkpoint}, sha256 {digest}")


def constants_of(agent):
    """{name: buffer} of a new agent, without the buffers that a training changes or fills.

    A buffer that a training fills is zero in a new agent.
    """
    return {name: x for name, x in agent.named_buffers() if x.any() and name not in CHANGED_BY_TRAINING}


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

    `progress` holds the counters. `training_seconds` is the time of rollouts and updates. `wall_seconds` is all time up
    to the end of the last update, with the evaluations and saves before it.
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
        if self.rank > 0:  # all processes have the same weights, but draw other noise
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
        """The number of updates that are learned and counted."""
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
                with contextlib.suppress(OSError):  # a folder that holds other runs or files stays
                    self.folder.rmdir()
                    self.folder.parent.rmdir()
            raise
        print(f"run folder: {self.folder}", flush=True)
        for leftover in self.folder.glob(".*.tmp"):  # a killed writer leaves such a file
            leftover.unlink()
        arguments = {**asdict(self.args), "resume": None}
        if self.args.save_model:
            files.write_json(self.folder / "args.json", arguments)
        self.writer = new_writer(self.folder, self.progress["global_step"] + 1, arguments)
        self.save()
        self.update_began = time.time()
        return self

    def solve_reference(self):
        """Find the optima that evaluations fly before anything is learned. A missing optimum ends the run here."""
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
            with contextlib.suppress(OSError):  # a full disk may be what ended the training
                self.save()
            return
        self.save()
        updates = self.state["progress"]["total_updates"]
        saved = self.args.save_model and self.rank == 0
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
        """Count and log an update. Save every ten updates, evaluate every --eval-every, and print a line now and then.

        alive (T, N) is the batch's. episodes is the `final_info` of all processes. losses are means over the update.
        """
        args = self.args
        now = time.time()
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
        self.state = state  # only now, so that a resume repeats an update whose evaluation was interrupted
        if iteration % SAVE_EVERY == 0 or iteration == args.total_updates:
            self.save()
        self.update_began = time.time()

    def print_line(self, episodes):
        """Print how far the run is, what the sampled episodes earned and what the last evaluation found."""
        done = self.progress["total_updates"]
        of = self.args.total_updates
        seconds = time.time() - self.began
        clock = f"{seconds / 60:.1f} min gone, {(of - done) * seconds / done / 60:.1f} to go"
        line = f"update {done}/{of}, {self.progress['global_step']} steps, {clock}"
        print(f"{line}: {self.describe(episodes, self.metrics)}", flush=True)

    def log(self, prefix, values):
        """Write every number of `values` under its TensorBoard tag."""
        for name, value in values.items():
            if isinstance(value, int | float):
                self.writer.add_scalar(f"{prefix}/{name}", value, self.progress["global_step"])

    def evaluate(self, eval_seed):
        """Fly the mean action of the averaged weights, and the optimum. Returns the metrics and arrays of eval.*."""
        average = self.modules["average"].module
        policy = average.make_policy(self.longest_episode)
        metrics, arrays = self.task.evaluate(policy, eval_seed, self.flights(eval_seed), **self.env_options)
        device = average.actor_logstd.device.type
        return {**metrics, **self.progress, "device": device, "torch_version": torch.__version__}, arrays

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
        """Fly the reported starts, write the evaluation and print the table."""
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
        self.writer.close()
        if args.save_model:
            paths = (self.folder / name for name in ("agent.safetensors", "eval.json", "eval.npz"))
            write_evaluation(metrics, arrays, *paths)
        if args.capture_video:
            draw_figures(self.folder, arrays, metrics, [read_curve(self.folder)])
            draw_animation(self.folder, arrays, metrics)
        print(self.task.table(metrics))
        print(f"run folder: {self.folder}")


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
        wandb.init(**names, resume="allow", sync_tensorboard=True, config=asdict(args), save_code=True)
    except Exception as error:  # wandb's errors (no login, no network, no such entity) have no common class
        fail(f"--track: Weights and Biases refuses the run ({error}); `wandb login` first, or leave --track out")


# ---------------------------------------------------------------------------------------------------------------------
# Checkpoints
# ---------------------------------------------------------------------------------------------------------------------


def training_state(args, modules, envs, progress):
    """A copy of all that a bit-exact resume needs. Training does not change the copy."""
    modules = {name: module.state_dict() for name, module in modules.items()}
    rng = {"torch": torch.get_rng_state()}
    rng |= {name: json.dumps(stream.bit_generator.state) for name, stream in envs.generators.items()}
    rng = all_gather({**rng, "cuda": torch.cuda.get_rng_state_all()})
    return copy.deepcopy({"args": {**asdict(args), "resume": None}, "progress": progress, "rng": rng, **modules})


def restore(state, run_dir, modules, envs):
    """Put everything back where `training_state` found it. Returns the progress.

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


def load_state(run_dir, kind, env_ids):
    """The training state of a run folder. kind is the script's Args, env_ids are its environments.

    Ends with one line if the state is missing, damaged or of another script.
    """
    try:
        path = Path(run_dir) / "training_state.pt"
        damaged = zipfile.ZipFile(path).testzip()  # torch checks no CRC
        if damaged:
            raise ValueError(f"{damaged} is damaged")
        state = torch.load(path, map_location="cpu", weights_only=True)
        # a flag that is newer than this run changes nothing if its default is None; any other is refused below
        newer = {name: value for name, value in vars(kind()).items() if value is None}
        args = {**newer, **state["args"]}
        state["args"] = args
        kinds = get_type_hints(kind)
        if args["env_id"] not in env_ids:
            raise ValueError(f"it is of {args['env_id']}; this script takes {', '.join(env_ids)}")
        if args.keys() != kinds.keys():
            raise ValueError(f"{min(args.keys() ^ kinds.keys())} is not among the arguments of both")
        wrong = [name for name in kinds if not isinstance(args[name], kinds[name])]
        if wrong:
            raise ValueError(f"{wrong[0]} is {args[wrong[0]]!r}")
    except Exception as error:  # a missing or damaged file fails in many ways, which are all the same to the user
        fail(f"--resume {run_dir}: must hold a training_state.pt of {kind().exp_name}.py ({error})")
    return state


def save_run(run_dir, state):
    """Write the training state, and the averaged weights in it as agent.safetensors. A file is never half-written."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    files.write_bytes(run_dir / "training_state.pt", buffer.getbuffer())
    metadata = {"env_id": state["args"]["env_id"], "args": json.dumps(state["args"]), **state["progress"]}
    averaged = {name: x for name, x in state["average"].items() if name != "n_averaged"}
    weights = {name.removeprefix("module."): x.cpu() for name, x in averaged.items()}
    data = safetensors.torch.save(weights, {key: str(value) for key, value in metadata.items()})
    files.write_bytes(run_dir / "agent.safetensors", data)


# ---------------------------------------------------------------------------------------------------------------------
# Memory
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


def join_processes(cuda):
    """Under torchrun, which sets RANK, become one of its processes. With GPUs each process takes its own."""
    if "RANK" not in os.environ or dist.is_initialized():
        return
    use_gpu = torch.cuda.is_available() and cuda
    if use_gpu:
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    dist.init_process_group("nccl" if use_gpu else "gloo")


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


def local_shard(values, count):
    """This process's part of `values`, which hold `count` values for each process in the order of their ranks."""
    rank, _ = rank_and_world_size()
    begin = sum(all_gather(count)[:rank])
    return values[begin : begin + count]


def sum_gradients(agent):
    """Sum the gradients over all processes, in place. One buffer holds them all, because each exchange takes time."""
    if not dist.is_initialized():
        return
    gradients = [parameter.grad for parameter in agent.parameters() if parameter.grad is not None]
    flat = all_reduce_sum(torch.cat([gradient.flatten() for gradient in gradients]))
    parts = flat.split([gradient.numel() for gradient in gradients])
    for gradient, part in zip(gradients, parts):
        gradient.copy_(part.view_as(gradient))


def all_reduce_sum(x):
    """The sum of a tensor over all processes, in place."""
    if dist.is_initialized():
        dist.all_reduce(x)
    return x
