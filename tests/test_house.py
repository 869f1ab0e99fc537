"""The house: imports run one way, each in the open, and what a command or training waits for stays light."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import gymnasium as gym
import pytest

import envs
from common import tasks
from common.errors import BadInput

ROOT = Path(__file__).parent.parent
OUTSIDE = {"tests", "benchmarks", "docs"}  # they import the house; nothing in it imports them
PATHS = [
    path
    for path in sorted(ROOT.rglob("*.py"))
    if not OUTSIDE & set(path.relative_to(ROOT).parts) and not any(part.startswith(".") for part in path.parts)
]
ROOMS = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in PATHS}
# what may be imported inside a function: it takes long to load, or is optional
SLOW = {"casadi", "scipy", "matplotlib", "tensorboard", "torch.utils.tensorboard", "wandb"}
SLOW |= {"oem", "astropy", "erfa", "onnxscript"}  # of requirements-extras.txt


def imports(tree):
    """Every import of a file: (the syntax node, the full names that it may import)."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield node, [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            yield node, [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]


def rooms_of(tree):
    """The rooms that a file imports, wherever it does."""
    return {name for _, names in imports(tree) for name in names if name in ROOMS}


def arrows():
    """Of each room the rooms that it imports."""
    return {room: rooms_of(ast.parse(path.read_text())) - {room} for room, path in ROOMS.items()}


def test_imports_run_one_way():
    """No circle, imports inside functions included: neither between files nor between folders."""
    found = arrows()
    TopologicalSorter(found).prepare()  # CycleError names the circle
    folders = {}
    for room, others in found.items():
        head = room.split(".")[0]
        folders.setdefault(head, set()).update({other.split(".")[0] for other in others} - {head})
    TopologicalSorter(folders).prepare()


def test_nothing_imports_a_script_or_what_stands_outside():
    for path in PATHS:
        for _, names in imports(ast.parse(path.read_text())):
            assert not any(name.startswith("ppo_gtrxl") or name.split(".")[0] in OUTSIDE for name in names), path


@pytest.mark.parametrize("path", PATHS, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_are_in_the_open(path):
    """No star; inside a function only what is slow to load or optional, and rooms that load such a thing."""
    tree = ast.parse(path.read_text())
    top = {id(node) for node in tree.body}
    for node, names in imports(tree):
        assert not any(name.endswith(".*") for name in names), names
        if id(node) not in top:
            rooms = [name for name in names if name in ROOMS]
            loads_slow = any(loads(room) & SLOW for room in rooms)
            assert loads_slow or names[0] in SLOW or names[0].split(".")[0] in SLOW, names


def loads(room, seen=None):
    """The heads of all modules that importing a room loads at once, other rooms' included."""
    seen = set() if seen is None else seen
    seen.add(room)
    found = set()
    for node in ast.parse(ROOMS[room].read_text()).body:
        for _, names in imports(node):
            found |= {name.split(".")[0] for name in names}
            for name in names:
                if name in ROOMS and name not in seen:
                    found |= loads(name, seen)
    return found


LIGHT = {room for room in ROOMS if room.split(".")[0] not in {"drawing", "runs", "cuda_graphs", "sb3_env"}}
LIGHT -= {room for room in ROOMS if room.startswith("ppo_gtrxl") or room.endswith((".figures", ".animation"))}
LIGHT -= {"exports.onnx_model"}  # a program of its own


def test_rooms_load_nothing_heavy():
    """A training and `--help` wait for no solver and no drawing; the environments need no torch."""
    heavy = ["torch", "casadi", "scipy", "matplotlib", "PIL", "astropy", "onnx"]
    names = sorted(LIGHT)
    assert {"envs", "baselines", "evaluate", "rocket.guidance", "phased.task"} <= set(names)
    code = f"import importlib, sys; [importlib.import_module(name) for name in {names}]\n"
    code += f"print(*{{*{heavy}}} & sys.modules.keys())"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == ""


# --- a family is an object --------------------------------------------------------------------------------------------


def test_nothing_asks_which_family_an_id_is_of():
    """The tables by id are read by their own family, by what registers it, and by the scripts' Problem section."""
    families = {"PROBLEMS": ("phased", "envs", "baselines", "ppo_gtrxl"), "ROCKETS": ("rocket", "envs", "ppo_gtrxl")}
    families["LANDERS"] = ("landing", "envs", "ppo_gtrxl")
    for path in [*PATHS, *(ROOT / "benchmarks").glob("*.py")]:
        head = path.relative_to(ROOT).parts[0].removesuffix(".py")
        nodes = list(ast.walk(ast.parse(path.read_text())))
        names = {node.id for node in nodes if isinstance(node, ast.Name)}
        names |= {node.attr for node in nodes if isinstance(node, ast.Attribute)}
        for table, readers in families.items():
            assert table not in names or head.startswith(readers), (path, table)


def test_an_id_without_a_task_is_one_line():
    with pytest.raises(BadInput, match="^env_id is 'CartPole-v1', of no family .* one of [^\\n]*VanDerPol-v0"):
        tasks.task_of("CartPole-v1")


def test_a_process_that_knows_only_the_specs_makes_the_environments():
    """As a worker that is spawned by Gymnasium's AsyncVectorEnv, which imports nothing of ours."""
    specs = [gym.spec(env_id).to_json() for env_id in ("VanDerPol-v0", "TwoStageLEO-v0")]
    code = "import gymnasium as gym\nfrom_json = gym.envs.registration.EnvSpec.from_json\n"
    code += f"for spec in {specs}: print(*gym.make(from_json(spec)).reset(seed=0)[0].shape)"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0 and result.stdout.split() == ["3", "9"], result.stderr


# --- a script loads what it needs -------------------------------------------------------------------------------------


def test_the_double_integrators_script_loads_no_other_familys_environment():
    """Nor an optimum, an exporter or a figure; and with its task still nothing of rockets and landers but tables."""
    code = "import sys, ppo_gtrxl_di\nprint(*sys.modules)\nfrom common.tasks import task_of\n"
    code += "task_of('DoubleIntegrator-v0')\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    script, task = (set(line.split()) for line in done.stdout.splitlines())
    ours = {name for name in script if name in ROOMS}
    assert not {name for name in ours if name.endswith(("optimum", "export", "task", "figures", "environment"))}
    assert not script & {"baselines", "evaluate", "rocket.kalman", "matplotlib"}
    assert {name for name in task if name.startswith("rocket.")} == {
        "rocket.missions",
        "rocket.targets",
        "rocket.vehicle",
    }
    assert {name for name in task if name.startswith("landing.")} == {"landing.lander"}


def test_every_name_of_envs_can_be_imported():
    assert [name for name in envs.__all__ if not hasattr(envs, name)] == []


def test_a_name_that_envs_lacks_is_an_error():
    with pytest.raises(AttributeError, match="^module 'envs' has no attribute 'fly_roket'$"):
        _ = envs.fly_roket
