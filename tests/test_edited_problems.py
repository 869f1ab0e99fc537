"""A problem that is edited after its training: what its fingerprint shows, and what commands say of it."""

import json
import random
import shutil
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from test_batched import Countdown

import envs
import evaluate
import ppo_gtrxl_vdp as script
from common.batch import SingleEnv
from common.fingerprint import KEY, changes, fingerprint
from phased.environment import fly
from phased.task import PhasedTask

PUSH = envs.Problem(
    env_id="EditedPush-v0",
    f=lambda x, u: (x[1], u),
    u_max=2.0,
    x_max=(20.0, 10.0),
    x0=(1.0, 0.0),
    x0_max=0.0,
    phases=(
        envs.Phase(steps=20, target=(0.0, 0.0), radius=0.1, R=0.1, Qf=50.0, bonus=20.0),
        envs.Phase(steps=20, target=(1.0, 0.0), radius=0.1, R=0.1, Qf=50.0, bonus=20.0),
    ),
    single_optimum=True,
)
TINY = ["--num-blocks=1", "--embed-dim=8", "--mlp-dim=8", "--hidden-dim=8", "--num-envs=8", "--eval-starts=10"]
TINY += ["--total-updates=1", "--eval-every=0", f"--env-id={PUSH.env_id}"]


def last_phase(**edit):
    return replace(PUSH, phases=(PUSH.phases[0], replace(PUSH.phases[1], **edit)))


EDITS = {
    "dynamics": (replace(PUSH, f=lambda x, u: (x[1], 1.00001 * u)), "rewards"),
    "u_max": (replace(PUSH, u_max=2.1), "rewards"),
    "start": (replace(PUSH, x0=(1.1, 0.0)), "start states"),
    "box of starts": (replace(PUSH, x0_max=0.1), "start states"),
    "price of the control": (last_phase(R=0.11), "rewards"),
    "terminal weight": (last_phase(Qf=51.0), "rewards"),
    "target": (last_phase(target=(1.01, 0.0)), "rewards"),
    "radius": (last_phase(radius=0.11), "goals"),
    "bonus": (last_phase(bonus=21.0), "goals"),
    "steps": (last_phase(steps=21), "number of steps"),
    "no last phase": (replace(PUSH, phases=PUSH.phases[:1]), "number of steps"),
    "a bound": (replace(PUSH, bounds=((-9.0, 9.0), None), bound_price=1.0), "goals"),
}


@pytest.fixture
def put(new_problem):
    """A function that registers a `Problem` in the place of one of its id, as a new process reads an edited file."""

    def register(problem):
        envs.PROBLEMS.pop(problem.env_id, None)
        return new_problem(problem)

    return register


@pytest.mark.parametrize("edit", EDITS)
@pytest.mark.parametrize("options", [{}, {"scaled_action": True, "observe_velocity": False, "observe_phase": False}])
def test_every_edit_of_a_table_shows(put, edit, options):
    env_id = put(PUSH)
    stored = fingerprint(env_id, **options)
    assert stored and changes(stored, env_id) is None
    edited, where = EDITS[edit]
    put(edited)
    assert where in changes(stored, env_id)


def test_rounding_does_not_show(put):
    """Neither in a plain motion, nor in Lorenz's, where 30 s turn it into another flight."""

    def lorenz(scale):
        return lambda x, u: (10 * (x[1] - x[0]) * scale, x[0] * (28 - x[2]) - x[1] + u, x[0] * x[1] - 8 / 3 * x[2])

    phase = envs.Phase(steps=600, target=(0.0, 0.0, 0.0))
    chaotic = replace(PUSH, f=lorenz(1.0), x_max=(30.0,) * 3, x0=(1.0, 1.0, 1.0), dt=0.05, phases=(phase,))
    for problem, rounded in (
        (PUSH, replace(PUSH, f=lambda x, u: (x[1] * (1 + 1e-15), u))),
        (chaotic, replace(chaotic, f=lorenz(1 + 1e-15))),
    ):
        env_id = put(problem)
        stored = fingerprint(env_id)
        ends = [json.loads(stored)["final states"]]
        put(rounded)
        ends.append(json.loads(fingerprint(env_id))["final states"])
        assert stored and changes(stored, env_id) is None
    assert None in ends[0], "the case is not chaotic"
    put(replace(chaotic, f=lorenz(1.001)))
    assert "rewards" in changes(stored, env_id)


def test_a_state_that_diverges_still_tells(put):
    env_id = put(replace(PUSH, f=lambda x, u: (x[1], x[0] ** 3 + u)))
    stored = fingerprint(env_id)
    put(replace(PUSH, f=lambda x, u: (x[1], x[0] ** 3 + 1.01 * u)))
    assert "rewards" in changes(stored, env_id)


@pytest.mark.parametrize("env_id, tables", [("TwoStageLEO-v0", envs.ROCKETS), ("PoweredDescent-v0", envs.LANDERS)])
def test_vehicles_and_landers_are_told_by_what_they_do(monkeypatch, env_id, tables):
    stored = fingerprint(env_id)
    table = tables[env_id]
    if env_id == "TwoStageLEO-v0":
        edited = replace(table, rocket=replace(table.rocket, payload=table.rocket.payload + 1.0))
    else:
        edited = replace(table, mass=table.mass + 1.0)
    monkeypatch.setitem(tables, env_id, edited)
    assert "rewards" in changes(stored, env_id)


class Wild(Countdown):
    """Its rewards are random beyond its seed."""

    def _advance(self, actions):
        reward, *rest = super()._advance(actions)
        return reward + random.random(), *rest


class Noisy(Countdown):
    """Its rewards are random by its seed, for each flight."""

    gain = 1.0

    def _advance(self, actions):
        reward, *rest = super()._advance(actions)
        return self.gain * reward + self.np_random.normal(size=self.num_envs), *rest


class Broken(Countdown):
    """It cannot be reset twice, or flown by a probe's actions."""

    def _start(self, mask, options):
        raise RuntimeError("no licence for a second simulator")


def registered(monkeypatch, kind):
    entries = {"entry_point": lambda **options: SingleEnv(kind(**options)), "vector_entry_point": kind}
    spec = gym.envs.registration.EnvSpec(id="Class-v0", **entries)
    monkeypatch.setitem(gym.registry, "Class-v0", spec)
    return "Class-v0"


def test_a_class_of_ones_own(monkeypatch):
    assert fingerprint(registered(monkeypatch, Wild)) is None
    assert fingerprint(registered(monkeypatch, Broken)) is None
    env_id = registered(monkeypatch, Noisy)
    stored = fingerprint(env_id)
    assert changes(stored, env_id) is None
    monkeypatch.setattr(Noisy, "gain", 1.01)
    assert changes(stored, env_id) == "rewards"


@pytest.fixture
def trained(put, tmp_path, monkeypatch):
    """A run of the problem, in the current directory."""
    put(PUSH)
    monkeypatch.chdir(tmp_path)

    def at_rest(task, seed, n, **options):
        return fly(task.env_id, lambda obs, t: np.zeros((len(obs), 1)), [PUSH.x0] * n)

    monkeypatch.setattr(PhasedTask, "optimum", at_rest)  # no solve: only the comparison of problems is tested
    monkeypatch.setattr(script, "ENV_IDS", (*script.ENV_IDS, PUSH.env_id))
    script.main(TINY)
    (run,) = (tmp_path / "runs").iterdir()
    return run


def test_what_commands_say_of_an_edited_problem(trained, put, tmp_path, monkeypatch, capsys):
    for name in ("redraw", "animate"):
        monkeypatch.setattr(evaluate, name, lambda folder: [])
    evaluate.publish(trained, tmp_path / "results")
    state = torch.load(trained / "training_state.pt", weights_only=True)
    assert state[KEY] == json.loads((trained / "eval.json").read_text())[KEY]
    flown = [*TINY[:4], "--eval-only", f"--checkpoint={trained / 'agent.safetensors'}", "--eval-starts=10"]
    again = [*TINY, f"--checkpoint={trained / 'agent.safetensors'}"]
    capsys.readouterr()
    script.main(again)
    assert "edited" not in capsys.readouterr().out

    put(last_phase(Qf=51.0))
    for argv in (flown, again):
        script.main(argv)
        assert "agent.safetensors: EditedPush-v0 has been edited since its training (rewards differ)" in (
            capsys.readouterr().out
        )
    with pytest.raises(SystemExit, match=r"^error: --resume .*EditedPush-v0 has been edited since \(rewards differ\)"):
        script.main([f"--resume={trained}"])
    with pytest.raises(ValueError, match=r"eval.json has been edited since \(rewards differ\)"):
        evaluate.publish(trained, tmp_path / "other")
    script.main([*TINY, "--seed=2"])
    (newest,) = (tmp_path / "runs").glob("*__2__*")
    with pytest.raises(ValueError, match=r"results/.*\.json has been edited since \(rewards differ\)"):
        evaluate.publish(newest, tmp_path / "results")  # a new run of the new problem beside one of the old
    monkeypatch.setattr("sys.argv", ["evaluate.py", "figures", str(tmp_path / "results")])
    evaluate.main()
    assert "results: its problem has been edited since (rewards differ)" in capsys.readouterr().out

    put(replace(PUSH, phases=PUSH.phases[:1]))
    with pytest.raises(ValueError, match="edited since .*number of steps.* differ"):
        evaluate.publish(trained, tmp_path / "other")
    with pytest.raises(SystemExit, match="edited since .*number of steps.* differ"):
        script.main([f"--resume={trained}"])
    assert not (tmp_path / "other").exists()


def test_files_without_a_fingerprint_are_accepted(trained, put, tmp_path, monkeypatch, capsys):
    for name in ("redraw", "animate"):
        monkeypatch.setattr(evaluate, name, lambda folder: [])
    old = tmp_path / "old"
    shutil.copytree(trained, old)
    state = torch.load(old / "training_state.pt", weights_only=True)
    del state[KEY]
    torch.save(state, old / "training_state.pt")
    put(last_phase(Qf=51.0))
    script.main([f"--resume={old}"])  # writes it anew, and its evaluation with today's fingerprint
    assert "edited" not in capsys.readouterr().out
    assert changes(json.loads((old / "eval.json").read_text())[KEY], PUSH.env_id) is None
    evaluate.publish(old, tmp_path / "results")


def test_a_fingerprint_that_is_none_is_one_line(trained, tmp_path):
    state = torch.load(trained / "training_state.pt", weights_only=True)
    torch.save({**state, KEY: "[1, 2]"}, trained / "training_state.pt")
    with pytest.raises(ValueError, match="environment_fingerprint is '\\[1, 2\\]'"):
        script.main([f"--resume={trained}"])
