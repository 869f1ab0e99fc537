"""A policy against the optimum: `evaluate`, and the results folders. This module imports neither torch nor a script.

    python evaluate.py publish RUN_DIR results/di     # add a run to a results folder (--ship: make it the shipped one;
                                                      # --replace: in place of an older run of its seed)
    python evaluate.py shorten RUN_DIR                # half the bytes: RUN_DIR/bfloat16 can be published instead
    python evaluate.py figures results/di             # redraw its figures and print its table (a run folder works too)
    python evaluate.py animate results/di             # and its figures/animation.gif
    python evaluate.py opponents results/rocket_cutoff     # classical guidance on its policy's dispersed flights
    python evaluate.py page results/rocket_dispersed       # one HTML file in which the policy flies in a browser
    python evaluate.py export results/rocket_cutoff --onnx policy.onnx     # the policy, or its flights, for other tools

A problem's family (`phased/`, `rocket/`, `landing/`) says what is measured, printed and drawn. `exports/` writes what
is taken away. Reading order: evaluation, results folders, command line.
"""

from __future__ import annotations

import common.interrupts  # noqa: F401 # isort: skip - first, so that Ctrl-C in the other imports prints no traceback
import sys
import tempfile
from pathlib import Path

import numpy as np

import envs  # noqa: F401 - makes every id known to `task_of`
from common.checkpoints import read_checkpoint, read_record, script_of, write_bfloat16
from common.command_line import OneLineParser, integer, named_path, number, output_file, positive, utc
from common.curves import evaluated, read_csv, read_curve, write_csv
from common.errors import BadInput
from common.evaluations import first_edited, read_evaluation, read_json, read_metrics, refuse_another_policy
from common.files import read_npz, write_bytes, write_npz
from common.interrupts import catch_signals, leave
from common.policies import evaluate_by_script
from common.schedule import Schedule
from common.tasks import task_of
from exports.folders import EPOCH, LAUNCH_LONGITUDE, export, page


def evaluate(env_id: str, policy, eval_seed: int, n: int, reference: dict | None = None, **env_options):
    """Fly `policy(obs (n, obs), t) -> action (n, actions)` on the n flights of a seed and compare it with the optimum.

    `reference` is `task_of(env_id).optimum(eval_seed, n)`, which is solved here if it is not given. `env_options` go to
    the environment. Returns the `metrics` of eval.json that do not depend on the run, as plain numbers, and the
    `arrays` of eval.npz. Raises BadInput for an unknown id, and ValueError if the reference belongs to other flights.
    """
    return task_of(env_id).evaluate(policy, eval_seed, n, reference, **env_options)


# ---------------------------------------------------------------------------------------------------------------------
# Results folders
# ---------------------------------------------------------------------------------------------------------------------


# arguments in which the runs of a results folder may differ: their seed, the machine, and what is shown on the way
OWN_ARGUMENTS = {
    *("seed", "exp_name", "resume", "save_model", "capture_video", "eval_every", "eval_only", "eval_json", "eval_npz"),
    *("cuda", "num_threads", "torch_deterministic", "torch_compile", "track", "wandb_project_name", "wandb_entity"),
}


def publish(run_dir, folder, ship: bool = False, numbers: bool = False, replace: bool = False):
    """Add a run to a results folder: its eval.json and training curve under seeds/, and the policy if it is shipped.

    The policy, its evaluation and the figures are replaced only if the folder ships no policy, or with `ship`. With
    `numbers` the folder gets only seeds/. A curve has only the updates that were evaluated, but for the policy's own.
    The folder may keep a part of the flights, but its figures show all.

    A run of a seed that is there is refused without `replace`. So is a run that does not belong to the folder's others:
    of another problem, with other arguments (but for OWN_ARGUMENTS), or of a problem that has been edited since.

    Raises OSError or ValueError that says what is missing or does not fit. Then nothing has been written. All files are
    made first, and seeds/<seed>.json is written last. So if it is there, the rest is there, too.
    """
    run_dir, folder = Path(run_dir), Path(folder)
    seed = read_json(run_dir / "eval.json")["seed"]
    refuse_strangers(run_dir, folder, seed)
    metrics, _ = read_evaluation(run_dir)
    refuse_another_policy(run_dir, metrics)
    curve = read_curve(run_dir)
    if not curve:
        raise ValueError(f"{run_dir} has no TensorBoard scalars")
    shipped = read_metrics(folder / "eval.json") if (folder / "eval.json").exists() else None
    is_shipped = shipped is not None and shipped["seed"] == seed
    if is_shipped and not ship and not replace:
        raise ValueError(f"{folder} already ships seed {seed}; --ship or --replace replaces it")
    there = folder / "seeds" / f"{seed}.json"
    is_another = there.exists() and not (ship and there.read_bytes() == (run_dir / "eval.json").read_bytes())
    if is_another and not is_shipped and not replace:
        raise ValueError(f"{folder} already has seed {seed}; --replace replaces it")
    ships = (ship or is_shipped or not shipped) and not numbers
    with tempfile.TemporaryDirectory() as name:
        staged = Path(name)
        (staged / "seeds").mkdir()
        for path in (folder / "seeds").glob("*.csv"):
            write_bytes(staged / "seeds" / path.name, path.read_bytes())
        write_csv(staged / "seeds" / f"{seed}.csv", curve if ships else evaluated(curve))
        last = staged / "seeds" / f"{seed}.json"
        write_bytes(last, (run_dir / "eval.json").read_bytes())
        if ships:
            for file in ("agent.safetensors", "eval.npz", "eval.json"):
                write_bytes(staged / file, (run_dir / file).read_bytes())
            redraw(staged)
            animate(staged)
            write_npz(staged / "eval.npz", task_of(metrics["env_id"]).kept_arrays(read_npz(staged / "eval.npz")))
        move(staged, folder, last, replaced=of_another_policy(folder) if ships else ())


def refuse_strangers(run_dir: Path, folder: Path, seed: int):
    """Raise ValueError if a run does not belong to the runs of other seeds in a results folder, or to today's problem.

    The folder's policy says with which arguments all were trained.
    """
    evaluations = [*folder.glob("eval.json"), *(folder / "seeds").glob("*.json")]
    others = [path for path in evaluations if read_json(path)["seed"] != seed]
    for path in others:
        refuse_difference(read_json(run_dir / "eval.json"), read_json(path), EVALUATED, run_dir, path)
    policies = list(folder.glob("agent.safetensors")) if others else []
    for path in policies:
        mine, theirs = (compared_arguments(policy) for policy in (run_dir / "agent.safetensors", path))
        refuse_difference(mine, theirs, mine.keys() & theirs.keys(), run_dir, path)
    edited = first_edited([run_dir / "eval.json", run_dir / "agent.safetensors", *others, *policies])
    if edited:
        path, changed = edited
        raise ValueError(
            f"the problem of {path} has been edited since ({changed} differ); undo the edit, or train anew"
        )


EVALUATED = ("env_id", "eval_seed", "eval_starts", "total_updates")  # keys of eval.json that are the same in a folder


def compared_arguments(policy: Path) -> dict:
    """The arguments of a policy that the runs of a folder have in common. Of a path only whether it is given."""
    args = read_record(policy)["args"]
    return {
        name: "a policy" if name == "checkpoint" and value else value
        for name, value in args.items()
        if name not in OWN_ARGUMENTS
    }


def refuse_difference(mine: dict, theirs: dict, names, run_dir: Path, path: Path):
    """Raise ValueError for the first of the names under which two runs hold other values. An older one may lack it."""
    for name in sorted(names):
        if name not in mine or name not in theirs:
            continue
        if not are_one(mine[name], theirs[name], mine.get("total_updates")):
            raise ValueError(f"{name} of {run_dir} is {mine[name]}; it must be {theirs[name]}, as in {path}")


def are_one(value, other, updates: int | None) -> bool:
    """Whether two arguments of trainings are the same. Schedules are, if they have the same value in each update."""
    if value == other:
        return True
    have_points = all(isinstance(words, str) and ":" in words for words in (value, other))
    if updates is None or not have_points:
        return False
    return np.array_equal(Schedule(value).over(updates), Schedule(other).over(updates))


def shorten(run_dir) -> Path:
    """Make RUN_DIR/bfloat16, a run folder whose policy has large weights in bfloat16 and is flown again.

    Raises OSError or BadInput that says what is missing, or with the script's line if it cannot fly the policy.
    """
    run_dir = Path(run_dir)
    args = read_checkpoint(run_dir / "agent.safetensors")["args"]
    script = script_of(run_dir / "agent.safetensors")
    with tempfile.TemporaryDirectory() as name:
        staged = Path(name)
        for path in run_dir.glob("events.out.tfevents.*"):
            write_bytes(staged / path.name, path.read_bytes())
        policy = staged / "agent.safetensors"
        write_bfloat16(run_dir / "agent.safetensors", policy)
        flags = {"eval_npz": staged / "eval.npz", "eval_json": staged / "eval.json"}
        for name in ("dispersion", "failure", "navigation_noise", "eval_seed", "eval_starts"):
            if args.get(name) is not None:
                flags[name] = args[name]
        evaluate_by_script(script, policy, flags)
        move(staged, run_dir / "bfloat16", staged / "eval.json", replaced=())
    return run_dir / "bfloat16"


def of_another_policy(folder) -> list[str]:
    """The files of a folder's old policy, beside the three files. They would look current beside a new policy."""
    figures = [f"figures/{path.name}" for path in (folder / "figures").glob("*") if path.is_file()]
    return [*(path.name for path in folder.glob("opponents*")), "page.html", *figures]


def move(staged, folder, last, replaced):
    """Put every file of `staged` into a folder. Before the `last` one delete `replaced` files without a new one."""
    files = [path for path in staged.rglob("*") if path.is_file()]
    for path in sorted(files, key=lambda path: (path == last, path)):
        if path == last:
            for name in replaced:
                if not (staged / name).exists():
                    (folder / name).unlink(missing_ok=True)
        target = folder / path.relative_to(staged)
        target.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(target, path.read_bytes())


def redraw(folder) -> list[Path]:
    """Draw the figures of a results or run folder from its files. Returns their paths.

    Raises OSError or ValueError that names the file that is missing or damaged.
    """
    folder = Path(folder)
    metrics, arrays = read_evaluation(folder)
    curves = {path.stem: read_csv(path) for path in sorted((folder / "seeds").glob("*.csv"))}
    own = curves.pop(str(metrics["seed"]), None) or read_curve(folder)
    from drawing.evaluation import (
        draw_figures,  # only a drawing should wait the quarter of a second that Matplotlib takes
    )

    return draw_figures(folder, arrays, metrics, [own, *curves.values()] if own else [])


def animate(folder) -> Path:
    """Write figures/animation.gif of a results or run folder from its eval.json and eval.npz. Returns its path.

    Raises OSError or ValueError that names the file that is missing or damaged.
    """
    folder = Path(folder)
    metrics, arrays = read_evaluation(folder)
    from drawing.evaluation import draw_animation

    return draw_animation(folder, arrays, metrics)


def seed_lines(folder) -> list[str]:
    """The table of a results folder's seeds, with a row for each number and its median and range. None for one seed.

    Raises ValueError if one of the numbers is none.
    """
    runs = [read_json(path) for path in (Path(folder) / "seeds").glob("*.json")]
    runs.sort(key=lambda run: run["seed"])
    if len(runs) < 2:
        return []
    heads = [*(f"seed {run['seed']}" for run in runs), "median", "lowest", "highest"]
    lines = [f"{'':40}" + "".join(f"{head:>10}" for head in heads)]
    rows = task_of(runs[0]["env_id"]).seed_rows() | {"training_seconds": ("seconds of training", ".0f")}
    for key, (label, form) in rows.items():
        values = [run[key] for run in runs if key in run]
        if not values:
            continue
        if not all(isinstance(value, int | float) for value in values):
            raise ValueError(f"{key} is {values} in {folder}/seeds; it must be a number")
        cells = [format(run[key], form) if key in run else "-" for run in runs]
        cells += [format(value, form) for value in (np.median(values), min(values), max(values))]
        lines.append(f"  {label:38}" + "".join(f"{cell:>10}" for cell in cells))
    return lines


# ---------------------------------------------------------------------------------------------------------------------
# Command line
# ---------------------------------------------------------------------------------------------------------------------


def publish_command(args):
    publish(args.run_dir, args.folder, args.ship, replace=args.replace)
    print_tables(args.folder)


def shorten_command(args):
    folder = shorten(args.run_dir)
    print_tables(folder)
    print(folder)


def figures_command(args):
    for path in redraw(args.folder):
        print(path)
    print_tables(args.folder)


def animate_command(args):
    print(animate(args.folder))


def opponents_command(args):
    task = task_of(read_json(args.folder / "eval.json")["env_id"])
    task.fly_opponents(
        args.folder,
        dispersion=args.dispersion,
        failure=args.failure,
        failure_time=args.failure_time,
        navigation_noise=args.navigation_noise,
        n=args.starts or task.default_flights(is_brief=False, dispersion=args.dispersion),
        solved=args.solved,
        eval_seed=args.eval_seed,
        also=args.also,
    )


def export_command(args):
    targets = {name: getattr(args, name) for name in FORMATS if getattr(args, name) is not None}
    if not targets:
        raise BadInput(f"nothing to export: name a file by {', '.join(f'--{name}' for name in FORMATS)}")
    if len({path.resolve() for path in targets.values()}) < len(targets):
        raise BadInput("two of the flags name one file: each must have a file of its own")
    if args.epoch != EPOCH and not targets.keys() & {"oem", "czml"}:
        raise BadInput(f"--epoch is {args.epoch:%Y-%m-%dT%H:%M:%SZ}; it needs --oem or --czml")
    export(args.folder, targets, args.epoch, args.launch_longitude)
    for path in targets.values():
        print(path)


def page_command(args):
    path = page(args.folder, args.out, args.launch_longitude)
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


def say_if_edited(folder: Path):
    """Print a line if a folder's flights are of another problem than today's table."""
    edited = first_edited([folder / "eval.json"])
    if edited:
        print(f"{folder}: its problem has been edited since ({edited[1]} differ); its flights are of the old one")


def print_tables(folder: Path):
    """Print the table of a results or run folder, and that of its seeds."""
    metrics = read_json(folder / "eval.json")
    print("\n".join([task_of(metrics["env_id"]).table(metrics), *seed_lines(folder)]))


COMMANDS = {
    "publish": publish_command,
    "shorten": shorten_command,
    "figures": figures_command,
    "animate": animate_command,
    "opponents": opponents_command,
    "export": export_command,
    "page": page_command,
}
SHOWING = ("figures", "animate", "opponents", "export", "page")  # commands that show the flights of a folder
FORMATS = {
    "onnx": "one step of the policy, memory in and out",
    "csv": "the flights, a row each step",
    "flights": "the flights, a row each: a Monte Carlo",
    "oem": "a rocket's flight as a CCSDS Orbit Ephemeris Message",
    "czml": "a rocket's flight for Cesium",
}


def parse_args(argv=None):
    """The arguments of a sub-command."""
    parser = OneLineParser(description="Results folders: add a run, redraw figures, print the table.")
    commands = parser.add_subparsers(dest="command", required=True)
    of_folder = OneLineParser(add_help=False)
    of_folder.add_argument("folder", type=Path, help="results/<name> or runs/...")
    from_site = OneLineParser(add_help=False)
    site = f"of a rocket's launch site, degrees east: default {LAUNCH_LONGITUDE}"
    from_site.add_argument(
        "--launch-longitude", type=number(-180, 360), default=LAUNCH_LONGITUDE, metavar="L", help=site
    )
    command = commands.add_parser("publish", help="add a run to a results folder")
    command.add_argument("run_dir", type=Path, help="a finished run: runs/...")
    command.add_argument("folder", type=Path, help="results/<name>, made if it does not exist")
    command.add_argument("--ship", action="store_true", help="replace the policy that the folder ships")
    command.add_argument("--replace", action="store_true", help="replace the run of this seed that the folder has")
    command = commands.add_parser("shorten", help="write a run's policy in bfloat16 into RUN_DIR/bfloat16, and fly it")
    command.add_argument("run_dir", type=Path, help="a run: runs/...")
    redrawn = "redraw the figures of a results or run folder, print its table"
    commands.add_parser("figures", parents=[of_folder], help=redrawn)
    animated = "write figures/animation.gif of a results or run folder"
    commands.add_parser("animate", parents=[of_folder], help=animated)
    command = commands.add_parser(
        "opponents", help="classical guidance and other policies on the same dispersed flights"
    )
    command.add_argument("folder", type=Path, help="results/<name> of a rocket with cut-off or a lander")
    command.add_argument("--dispersion", type=positive, default=1.0, metavar="D", help="default 1: envs.Dispersion")
    lost = "and failures that lose up to this share of thrust, from 0 to 0.3: default 0, none"
    command.add_argument("--failure", type=number(0, 0.3), default=0.0, metavar="K", help=lost)
    strikes = "when these strike: random (default) or ignition"
    command.add_argument("--failure-time", default="random", metavar="WHEN", help=strikes)
    sigma = number(0, 1e4)
    off = "noise of what laws and policies see of position and velocity: default none"
    command.add_argument("--navigation-noise", nargs=2, type=sigma, metavar=("M", "M/S"), help=off)
    size = integer(10, 100_000)
    command.add_argument("--starts", type=size, metavar="N", help="flights (default: as many as an evaluation has)")
    command.add_argument(
        "--solved", type=size, default=200, metavar="N", help="the first of them, for IPOPT: default 200"
    )
    command.add_argument("--eval-seed", type=integer(0, 2**31 - 1), default=0, metavar="S", help="default 0")
    also = "another policy, as often as wanted"
    command.add_argument("--also", type=named_path, action="append", default=[], metavar="NAME=PATH", help=also)
    exported = "write the policy, or its flights, for other tools"
    command = commands.add_parser("export", parents=[of_folder, from_site], help=exported)
    for name, help_line in FORMATS.items():
        command.add_argument(f"--{name}", type=output_file, metavar="FILE", help=help_line)
    moment = f"lift-off of --oem and --czml, UTC: default {EPOCH:%Y-%m-%dT%H:%M:%S}"
    command.add_argument("--epoch", type=utc, default=EPOCH, metavar="TIME", help=moment)
    paged = "write one HTML file in which the policy flies in a browser"
    command = commands.add_parser("page", parents=[of_folder, from_site], help=paged)
    command.add_argument("--out", type=output_file, metavar="FILE", help="default: page.html in the folder")
    return parser.parse_args(argv)


def main():
    """Run the sub-command. An error in it ends in one line."""
    catch_signals()
    args = parse_args()
    try:
        if args.command in SHOWING and (args.folder / "eval.json").exists():
            say_if_edited(args.folder)
        COMMANDS[args.command](args)
    except (ImportError, OSError, RuntimeError, ValueError) as error:
        sys.exit(f"evaluate.py: {error}")
    except KeyboardInterrupt:
        print("evaluate.py: stopped", file=sys.stderr)
        leave()


if __name__ == "__main__":
    main()
