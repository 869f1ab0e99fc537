"""Animations and `render`: the GIF as Pillow reads it, frames of every environment, and what the drawings show."""

import json
import shutil
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from PIL import Image

import envs
import evaluate
from common.evaluations import read_evaluation
from drawing import animation
from drawing.animation import Flight
from drawing.evaluation import draw_animation
from phased.animation import PhasePlane
from rocket.animation import AscentSheet

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
SHAPE = (450, 800, 3)
RED, BLUE, GREEN = (214, 39, 40), (31, 119, 180), (44, 160, 44)  # tab:red, tab:blue, tab:green


def pixels_like(frame, colour):
    """How many pixels of a frame are within 30 of a colour in each channel."""
    return int((np.abs(np.asarray(frame, dtype=int) - colour) <= 30).all(axis=-1).sum())


def frames_of(path):
    """The frames (uint8) and durations (ms) of a GIF, as Pillow plays it."""
    frames, durations = [], []
    with Image.open(path) as image:
        assert image.format == "GIF" and image.info["loop"] == 0
        for k in range(image.n_frames):
            image.seek(k)
            frames.append(np.asarray(image.convert("RGB")))
            durations.append(image.info["duration"])
    return frames, durations


def copied(result, folder):
    """A folder with the evaluation of a result, as a run's has it: no seeds, no figures."""
    folder.mkdir()
    for name in ("eval.json", "eval.npz"):
        shutil.copy(ROOT / "results" / result / name, folder)
    return folder


def command_line(monkeypatch, *argv):
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *map(str, argv)])
    evaluate.main()


# --- the GIF ----------------------------------------------------------------------------------------------------------


def test_animate_writes_a_gif(tmp_path, monkeypatch, capsys):
    """Of any folder with an evaluation: both sides move, the last frame is held, nothing but the GIF is left."""
    monkeypatch.setattr(animation, "FRAMES", 5)
    folder = copied("vdp_waypoints", tmp_path / "run")
    command_line(monkeypatch, "animate", folder)
    path = folder / "figures" / "animation.gif"
    assert capsys.readouterr().out == f"{path}\n" and [*path.parent.iterdir()] == [path]
    frames, durations = frames_of(path)
    assert all(frame.shape == SHAPE for frame in frames)
    assert durations == [80] * 4 + [2000]
    assert all((before != after).any() for before, after in zip(frames, frames[1:]))
    assert pixels_like(frames[-1], GREEN) > 50
    for colour in (RED, BLUE):
        assert pixels_like(frames[-1], colour) > pixels_like(frames[0], colour)


@pytest.mark.parametrize("fault", ["no folder", "no npz", "other id", "short", "nan"])
def test_bad_folders_are_one_line_and_write_nothing(fault, tmp_path, monkeypatch):
    folder = copied("rocket_cutoff", tmp_path / "run")
    with np.load(folder / "eval.npz") as file:
        arrays = dict(file)
    if fault == "no folder":
        shutil.rmtree(folder)
    elif fault == "no npz":
        (folder / "eval.npz").unlink()
    elif fault == "other id":
        (folder / "eval.json").write_text(json.dumps({"env_id": "CartPole-v1", "seed": 1}))
    elif fault == "short":
        np.savez(folder / "eval.npz", **{**arrays, "u": arrays["u"][:-7]})
    else:
        arrays["y_reference"][3, 2] = np.nan
        np.savez(folder / "eval.npz", **arrays)
    words = {"no folder": "eval.json", "no npz": "eval.npz", "other id": "env_id is 'Cart", "short": r"u \(456, 3\)"}
    with pytest.raises(SystemExit, match=words.get(fault, "the optimum's flight holds a NaN")) as refusal:
        command_line(monkeypatch, "animate", folder)
    assert str(refusal.value).startswith("evaluate.py: ") and "\n" not in str(refusal.value)
    assert not [*tmp_path.rglob("*.gif"), *tmp_path.rglob("*.tmp")]


def test_failing_write_leaves_the_old_gif(tmp_path, monkeypatch):
    metrics, arrays = read_evaluation(ROOT / "results" / "di")
    monkeypatch.setattr(animation, "FRAMES", 3)
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "animation.gif").write_bytes(b"old")
    monkeypatch.setattr(PhasePlane, "show", lambda *sides, ended: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        draw_animation(tmp_path, arrays, metrics)
    assert [path.read_bytes() for path in (tmp_path / "figures").iterdir()] == [b"old"]


# --- what the drawings show -------------------------------------------------------------------------------------------


def test_a_flight_until_a_time():
    flight = Flight(np.array([0.0, 2.0, 3.0]), np.array([[7.0], [8.0]]), np.array([[0.0, 1.0], [4.0, 1.0], [4.0, 3.0]]))
    assert flight.until(3.0) is flight and flight.until(99.0) is flight
    for time, times, controls, state in [
        (0.0, [0, 0], [7], [0, 1]),
        (0.5, [0, 0.5], [7], [1, 1]),
        (2.5, [0, 2, 2.5], [7, 8], [4, 2]),
    ]:
        part = flight.until(time)
        assert part.t.tolist() == times and part.u[:, 0].tolist() == controls and part.y[-1].tolist() == state


def rocket_flight(result="rocket_cutoff", suffix=""):
    with np.load(ROOT / "results" / result / "eval.npz") as file:
        return Flight(*(file[f"{key}{suffix}"] for key in ("t", "u", "y")))


def test_the_path_is_altitude_over_downrange():
    flight, sheet = rocket_flight(), AscentSheet(envs.ROCKET)
    sheet.show([flight])
    x, altitude = sheet.paths[0].get_data()
    r = flight.y[:, :3]
    assert altitude == pytest.approx(np.linalg.norm(r, axis=1) / 1e3 - 6378.145, abs=1e-6)
    # the angle between two directions; the flight leaves the target's plane by less than half a degree
    cosine = r @ r[0] / np.linalg.norm(r, axis=1) / np.linalg.norm(r[0])
    assert x == pytest.approx(np.arccos(cosine.clip(-1, 1)) * 6378.145, abs=10)
    assert x[-1] > 5000


@pytest.mark.parametrize(
    "time, ended, shown",
    [
        (74.0, False, []),
        (76.0, False, ["75 s: 6 engines, 13.7 t"]),
        (920.0, False, ["75 s: 6 engines, 13.7 t", "150 s: 3 engines, 6.8 t", "261 s: 1 engine, 8.8 t"]),
        (
            9e9,
            True,
            ["75 s: 6 engines, 13.7 t", "150 s: 3 engines, 6.8 t", "261 s: 1 engine, 8.8 t", "{:.0f} s: cut-off"],
        ),
    ],
)
def test_stagings_are_named_when_they_happen(time, ended, shown):
    sheet = AscentSheet(envs.ROCKET)
    flight = rocket_flight()
    sheet.show([flight.until(time)], ended=ended)
    named = [label.get_text().replace(" dropped", "") for label in sheet.labels if label.get_visible()]
    assert named == [name.format(flight.t[-1]) for name in shown]
    assert len(sheet.marks.get_xdata()) == min(len(shown), 3)
    assert sheet.flame.get_visible() != ended


# --- render_mode="rgb_array" ------------------------------------------------------------------------------------------


def action_of(env):
    """A climb, or half the largest control."""
    return np.array([1.0, 0.2, 0.0]) if env.action_space.shape == (3,) else env.action_space.high / 2


def test_frames_of_the_single_environment():
    env = gym.make("RocketAscentCutoff-v0", render_mode="rgb_array", action_frame="local")
    assert env.metadata["render_modes"] == ["rgb_array"] and env.metadata["render_fps"] > 0
    env.reset(seed=1)
    frames = [env.render()]
    for steps in (1, 4):
        for _ in range(steps):
            env.step(action_of(env))
        frames.append(env.render())
    assert all(frame.shape == SHAPE and frame.dtype == np.uint8 for frame in frames)
    assert (frames[0] != frames[1]).any() and (frames[1] != frames[2]).any()
    assert np.array_equal(env.render(), frames[2])  # a look changes nothing
    assert pixels_like(frames[2], RED) > 20 and not pixels_like(frames[2], BLUE)
    env.reset(seed=1)
    assert np.array_equal(env.render(), frames[0])


def test_frames_of_the_batch_are_those_of_single_environments():
    env_id = "VanDerPolWaypoints-v0"
    batch = gym.make_vec(env_id, num_envs=2, render_mode="rgb_array")
    single = gym.make(env_id, render_mode="rgb_array")
    obs, _ = batch.reset(seed=3)
    single.reset(options={"x0": obs[1, :2]})
    action = action_of(single)
    for _ in range(3):
        batch.step(np.stack([-action, action]))
        single.step(action)
    frames = batch.render()
    assert isinstance(frames, tuple) and len(frames) == 2
    assert np.array_equal(frames[1], single.render()) and (frames[0] != frames[1]).any()


def test_after_autoreset_the_next_episode_is_drawn():
    options = {"render_mode": "rgb_array", "action_frame": "local", "end_time": 6.0}
    batch = gym.make_vec("RocketAscent-v0", num_envs=2, **options)
    batch.reset()
    begin = batch.render()[0]
    for _ in range(3):
        assert np.array_equal(batch.render()[0], begin) == (batch.unwrapped.t[0] == 0)
        _, _, terminated, _, _ = batch.step(np.tile([1.0, 0.2, 0.0], (2, 1)))
    assert terminated.all() and np.array_equal(batch.render()[0], begin)


def test_rendering_changes_no_number():
    """The frames are kept copies: neither the flight nor what was recorded earlier moves."""
    plain, drawn = (gym.make("VanDerPol-v0", render_mode=mode) for mode in (None, "rgb_array"))
    for env in (plain, drawn):
        env.reset(seed=5)
    drawn.render()
    for _ in range(5):
        one, other = (env.step(action_of(env)) for env in (plain, drawn))
        assert np.array_equal(one[0], other[0]) and one[1] == other[1]
    trail = drawn.unwrapped.batch._trails[0]
    assert len(trail) == 6 and len({tuple(state) for _, _, state in trail}) == 6
    assert plain.unwrapped.batch._trails == [[]]  # nothing is kept that nobody will look at


def test_bad_render_modes_and_render_before_reset_are_refused():
    with pytest.raises(ValueError, match="render_mode is 'ansi'; it must be one of None, rgb_array"):
        gym.make_vec("VanDerPol-v0", num_envs=2, render_mode="ansi")
    with (
        pytest.warns(UserWarning, match="render_mode='ansi'"),
        pytest.raises(ValueError, match="render_mode is 'ansi'"),
    ):
        gym.make("RocketAscent-v0", render_mode="ansi")
    with pytest.raises(ResetNeeded, match="call reset"):
        gym.make_vec("VanDerPol-v0", num_envs=2, render_mode="rgb_array").render()
