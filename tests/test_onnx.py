"""Exported policies: onnxruntime's actions beside torch's, whole flights, with and without memory."""

import copy
import json
import shutil
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import safetensors.torch

EXTRAS = "needs requirements-extras.txt"
for package in ("onnx", "onnxscript", "onnxruntime"):
    pytest.importorskip(package, reason=EXTRAS)

from helpers import save  # noqa: E402

import evaluate  # noqa: E402
import ppo_gtrxl_di  # noqa: E402
import ppo_gtrxl_lander  # noqa: E402
import ppo_gtrxl_vdp  # noqa: E402
from benchmarks.decision import OnnxPolicy, compare  # noqa: E402
from benchmarks.policies import load  # noqa: E402
from common.errors import BadInput  # noqa: E402
from common.tasks import task_of  # noqa: E402
from exports import onnx_model  # noqa: E402
from exports.offers import offer  # noqa: E402
from rocket.environment import fly_rocket  # noqa: E402

ROOT = Path(__file__).parents[1]
TOLERANCE = 1e-5


RESULT = ROOT / "results" / "rocket_dispersed"
WITHOUT_BLOCKS = ROOT / "results" / "rocket_failures"


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Shipped policies, exported as the command does: one with memory, and an MLP with a direct path."""
    folder = tmp_path_factory.mktemp("onnx")
    paths = {result: folder / f"{result.name}.onnx" for result in (RESULT, WITHOUT_BLOCKS)}
    for result, path in paths.items():
        evaluate.export(result, {"onnx": path})
    return paths


@pytest.mark.slow
@pytest.mark.parametrize("result", [RESULT, WITHOUT_BLOCKS], ids=lambda result: result.name)
def test_a_policy_acts_as_torchs_in_float64(exported, result):
    """Several flights at once, by features that magnify rounding 20 000 times: torch's in float32 is 4e-5 off."""
    n = 3
    agent, args, options = load(result / "agent.safetensors")
    steps = gym.make_vec(args.env_id, num_envs=1, **options).episode_steps + 20  # drawn flights may be longer
    policies = {"float32": agent.make_policy(steps), "onnx": OnnxPolicy(exported[result])}
    policies["float64"] = copy.deepcopy(agent).double().make_policy(steps)
    _, actions = compare(args.env_id, policies, n=n, **options)
    assert np.isfinite(actions["onnx"]).all(axis=2).sum() > 450 * n
    in_float32, in_float64 = (np.nanmax(np.abs(actions[key] - actions["onnx"])) for key in ("float32", "float64"))
    assert in_float64 < TOLERANCE and in_float32 < 1e-4


@pytest.mark.slow
def test_a_flight_by_onnxruntime_alone_ends_in_the_orbit(exported):
    metrics = json.loads((RESULT / "eval.json").read_text())
    flight = fly_rocket(metrics["env_id"], OnnxPolicy(exported[RESULT]), action_frame="local")
    assert flight["error_norm"] == pytest.approx(metrics["error_norm"], abs=1e-6)
    assert flight["final_mass_kg"] == pytest.approx(metrics["final_mass_kg"], abs=0.01)


@pytest.mark.slow
def test_the_model_says_what_it_takes(exported):
    found = OnnxPolicy(exported[RESULT])
    metrics = json.loads((RESULT / "eval.json").read_text())
    assert {key: found.metadata[key] for key in ("checkpoint_sha256", "env_id", "step_s")} == {
        "checkpoint_sha256": metrics["checkpoint_sha256"],
        "env_id": metrics["env_id"],
        "step_s": "2",
    }
    given = {one.name: (one.type, one.shape) for one in found.session.get_inputs()}
    answered = {one.name: (one.type, one.shape) for one in found.session.get_outputs()}
    observation, action = (json.loads(found.metadata[key]) for key in ("observation", "action"))
    assert given["observation"] == ("tensor(double)", ["flights", len(observation)])
    assert answered["action"] == ("tensor(float)", ["flights", len(action)])
    assert given["memory"] == answered["next_memory"] == ("tensor(float)", [2, 2, "flights", 4, 32, 16])
    assert observation[0] == ["x", "m"] and observation[6] == ["mass", "kg"]
    assert "up = r / |r|" in found.metadata["notes"]


# --- every script, with and without memory ----------------------------------------------------------------------------


def write(script, checkpoint, path):
    """The model, made in this process."""
    path.write_bytes(onnx_model.export(script, checkpoint).model_proto.SerializeToString())


CASES = [
    (ppo_gtrxl_di, {"observe_velocity": False, "memory_length": 0, "num_blocks": 2}),
    (ppo_gtrxl_vdp, {"env_id": "Goddard-v0", "num_blocks": 0}),
    (ppo_gtrxl_lander, {"num_blocks": 2, "observe_acceleration": True, "observe_draw": True}),
]


@pytest.mark.slow
@pytest.mark.parametrize("script, changes", CASES, ids=[script.__name__ for script, _ in CASES])
def test_policies_of_all_scripts(script, changes, tmp_path):
    """Random networks: blocks that see their own step alone; a plain MLP; memory and the lander's asinh."""
    agent, args, options = save(script, tmp_path, **changes)
    path = tmp_path / "policy.onnx"
    write(script, tmp_path / "agent.safetensors", path)
    policy = OnnxPolicy(path)
    assert bool(policy.memory_shape) == bool(args.num_blocks and args.memory_length)
    envs = gym.make_vec(args.env_id, num_envs=1, **options)
    hold = task_of(args.env_id).speed_cases()[0][2] or 0.0  # an action with which a flight lasts
    pilot = lambda obs, t: np.tile(np.broadcast_to(hold, envs.single_action_space.shape), (len(obs), 1))  # noqa: E731
    policies = {"pilot": pilot, "onnx": policy, "torch": copy.deepcopy(agent).double().make_policy(envs.episode_steps)}
    _, actions = compare(args.env_id, policies, n=4, **options)
    assert np.nanmax(np.abs(actions["onnx"] - actions["torch"])) < TOLERANCE
    assert np.nanstd(actions["onnx"], axis=(0, 1)).max() > 1e-3  # they differ from step to step


# --- bad input --------------------------------------------------------------------------------------------------------


def test_a_policy_of_no_script_is_one_line(tmp_path):
    save(ppo_gtrxl_di, tmp_path, exp_name="mine")
    with pytest.raises(BadInput, match="^the exp_name of .* is 'mine'; it must be that of a script"):
        evaluate.export(tmp_path, {"onnx": tmp_path / "policy.onnx"})
    assert not (tmp_path / "policy.onnx").exists()


@pytest.mark.slow
def test_a_policy_that_does_not_fit_its_script_is_one_line(tmp_path):
    save(ppo_gtrxl_di, tmp_path)
    path = tmp_path / "agent.safetensors"
    with safetensors.safe_open(path, "pt") as file:
        metadata, tensors = file.metadata(), {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    del tensors["critic.0.bias"]
    safetensors.torch.save_file(tensors, path, metadata)
    (tmp_path / "policy.onnx").write_bytes(b"as before")
    with pytest.raises(BadInput, match="does not fit its own args") as refusal:
        evaluate.export(tmp_path, {"onnx": tmp_path / "policy.onnx"})
    assert "\n" not in str(refusal.value)
    assert (tmp_path / "policy.onnx").read_bytes() == b"as before"


def test_a_damaged_policy_is_one_line(tmp_path):
    shutil.copy(ROOT / "results" / "di" / "agent.safetensors", tmp_path)
    path = tmp_path / "agent.safetensors"
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(BadInput, match="damaged or foreign"):
        evaluate.export(tmp_path, {"onnx": tmp_path / "policy.onnx"})


def test_tasks_have_the_interface_that_the_model_names():
    interface = offer(task_of("MarsLanding-v0"), "interface")(observe_command=False)
    assert "give 0: thrust_x_before, thrust_y_before, thrust_z_before" in interface.notes
