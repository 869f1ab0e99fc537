"""docs/read-the-log.md: every tag and every piece of a printed line is there, and nothing that no run writes."""

import contextlib
import importlib
import io
import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import envs
import evaluate
import runs
from common import curves
from rocket import guidance

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "docs"))
import read_the_log  # noqa: E402

PAGE = read_the_log.PAGE.read_text()
DI = importlib.import_module("ppo_gtrxl_di")
TAG = re.compile(r"`((?:charts|losses|eval)/[^`]+)`")


def tags_of_the_page():
    """The tags in the first cells of the tables below "Every TensorBoard tag"."""
    _, section = PAGE.split("\n## Every TensorBoard tag\n")
    section = section.split("\n## ")[0]
    return [tag for line in section.splitlines() if line.startswith("| `") for tag in TAG.findall(line.split(" | ")[0])]


def pattern_of(tag):
    """A tag of the page as a pattern: <...> is filled in by the run."""
    return re.compile(r"\w+".join(re.escape(part) for part in re.split(r"<\w+>", tag)))


def documented(tag, patterns):
    """The tags of the page that a written tag is an instance of; one of the optimum has to be one of ours, too."""
    if tag in patterns:
        return [tag]
    found = [name for name, pattern in patterns.items() if pattern.fullmatch(tag)]
    if found == ["eval/reference_<key>"]:
        ours = tag.replace("reference_", "")
        return found if ours in LEFT_TO_THE_OPTIMUM or documented(ours, patterns) else []
    return [name for name in found if name != "eval/reference_<key>"] or found


# the optimum's mass and time are named without "final"; its mass for another orbit is explained beside its ratio
LEFT_TO_THE_OPTIMUM = {"eval/mass_kg", "eval/mass_reached_kg"}


def numbers_of(metrics):
    """The tags of an evaluation's numbers, as `Run.log` writes them."""
    return {f"eval/{key}" for key, value in metrics.items() if isinstance(value, int | float)}


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    """A smoke run of the double integrator: what it prints, and its tags."""
    folder = tmp_path_factory.mktemp("smoke")
    network = "--embed-dim=8 --num-heads=2 --num-blocks=1 --memory-length=4 --mlp-dim=8 --hidden-dim=8"
    flags = f"{network} --num-envs=2 --num-minibatches=2 --eval-starts=10 --total-updates=2 --eval-every=1"
    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()) as printed:
        DI.main(flags.split())
    (run,) = (folder / "runs").iterdir()
    events = EventAccumulator(str(run), size_guidance={"scalars": 0})
    events.Reload()
    return printed.getvalue(), set(events.Tags()["scalars"])


@pytest.fixture(scope="module")
def written(smoke):
    """Every tag that some run writes: the smoke run's, those of the shipped curves, of a landing, and of failures."""
    tags = set(smoke[1])
    for path in (ROOT / "results").rglob("seeds/*.csv"):
        tags |= set(curves.read_csv(path))
    no_thrust = lambda obs, t: np.zeros((len(obs), 3))  # noqa: E731
    tags |= numbers_of(evaluate.evaluate("MarsLanding-v0", no_thrust, 0, 2)[0])
    cutoff = "RocketAscentCutoff-v0"  # of eval seed 0 and these options the optima are stored
    open_loop = guidance.open_loop(cutoff)
    return tags | numbers_of(evaluate.evaluate(cutoff, open_loop, 0, 100, dispersion=1.0, failure=0.3)[0])


@pytest.mark.slow
def test_every_tag_of_a_run_is_on_the_page(written):
    patterns = {tag: pattern_of(tag) for tag in tags_of_the_page()}
    assert {"charts/SPS", "losses/approx_kl", "eval/ratio_of_sums", "eval/failure_saved_rate"} <= written
    wrong = {tag: documented(tag, patterns) for tag in sorted(written) if len(documented(tag, patterns)) != 1}
    assert wrong == {}


@pytest.mark.slow
def test_every_tag_of_the_page_is_written_by_a_run(written):
    tags = tags_of_the_page()
    assert len(tags) == len(set(tags)) > 80
    idle = [tag for tag in tags if not any(pattern_of(tag).fullmatch(one) for one in written)]
    assert idle == []


def test_a_tag_that_is_missing_is_seen():
    patterns = {tag: pattern_of(tag) for tag in tags_of_the_page()}
    assert not documented("eval/another", patterns) and not documented("eval/reference_another", patterns)
    assert documented("eval/cost_running_mean", patterns) == ["eval/cost_<part>_mean"]


# --- the printed lines ------------------------------------------------------------------------------------------------

LINES = re.findall(r"`python (\w+)\.py[^`]*`:\n\n```text\n(update .*)\n```", PAGE)


def words_of(line):
    """A line without its numbers and the number of its blanks: what the script says around them."""
    return " ".join(re.sub(r"[-+]?\d[\d.]*", "#", line).split())


def line_of(script, episodes, metrics):
    """What a run of a script prints, of these ends of episodes and this evaluation."""
    progress = {"total_updates": 10, "global_step": 160_000}
    args = SimpleNamespace(total_updates=100)
    run = SimpleNamespace(progress=progress, args=args, began=0.0, describe=script.describe, metrics=metrics)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        runs.Run.print_line(run, episodes)
    return printed.getvalue()


FLIGHTS = {  # ends of two episodes, and an evaluation's numbers
    "ppo_gtrxl_di": ({"cost": 2.0, "hit": [[0.0], [1.0]]}, {"ratio_of_sums": 1.1}),
    "ppo_gtrxl_vdp": ({"cost": 2.0, "hit": [[0.0, 1.0, 1.0]]}, {}),
    "ppo_gtrxl_rocket": ({"error_norm": 1.9}, {"a_km": 6e3, "e": 0.9, "i_deg": 30.0, "error_norm": 1.9}),
    "ppo_gtrxl_lander": ({"position_error": 9.0, "speed": 9.0, "down": 1.0, "fuel_kg": 99.0}, {"landed_rate": 0.5}),
}
MORE = {"ppo_gtrxl_rocket": {"final_mass_kg": 7e3}}
MORE["ppo_gtrxl_lander"] = {"position_error_mean_m": 3.0, "speed_mean_m_s": 2.0, "fuel_ratio": 1.2}


@pytest.mark.parametrize("name, line", LINES, ids=[name for name, _ in LINES])
def test_a_line_of_the_page_is_what_the_script_prints(name, line):
    """But for the numbers."""
    flown, metrics = FLIGHTS[name]
    episodes = {key: np.atleast_1d(np.array(value)) for key, value in {"episodic_return": -9.0, **flown}.items()}
    printed = line_of(importlib.import_module(name), episodes, metrics | MORE.get(name, {}))
    assert words_of(line) == words_of(printed)


def test_every_script_has_a_line():
    scripts = {path.stem for path in ROOT.glob("ppo_gtrxl_*.py")}
    assert [name for name, _ in LINES] == list(FLIGHTS) and set(FLIGHTS) == scripts


@pytest.mark.slow
def test_a_smoke_run_prints_such_lines(smoke):
    printed = [line for line in smoke[0].splitlines() if line.startswith("update ")]
    assert len(printed) == 2
    assert {words_of(line) for line in printed} == {words_of(dict(LINES)["ppo_gtrxl_di"])}


def test_every_piece_of_a_line_is_explained():
    """What is left of a line without its numbers, units and the explained pieces is nothing."""
    _, section = PAGE.split("\n## The printed lines\n")
    cells = [row.split(" | ")[0] for row in section.split("\n## ")[0].splitlines() if row.startswith("| `")]
    pieces = {word for cell in cells for piece in re.findall(r"`([^`]+)`", cell) for word in words_of(piece).split()}
    units = {"#", "#%", "m", "m/s", "kg", "km", "min", ","}
    for _, line in LINES:
        words = {word.rstrip(",:") for word in words_of(line).split()}
        assert words - {piece.rstrip(",:") for piece in pieces} - units == set(), line


# --- the table of ranges and the pictures -----------------------------------------------------------------------------


def test_the_ranges_are_those_of_the_shipped_curves():
    rows = read_the_log.ranges()
    assert len(rows) == 12 and read_the_log.with_ranges(PAGE, rows) == PAGE
    assert read_the_log.with_ranges(PAGE, ["| other |\n"]) != PAGE


def test_a_row_by_hand():
    """The rocket's entropy is that of its --log-std, 3 (log std + log(2 pi e) / 2): from -1 to -8."""
    (row,) = [row for row in read_the_log.ranges() if row.startswith("| `losses/entropy` | rocket")]
    numbers = [float(number) for number in re.findall(r"[\d.]+", row.replace("−", ""))]
    assert max(numbers) < 3 * (8 - 1.4189) and numbers[1] < 3 * (1.4189 - 1)


@pytest.fixture(scope="module")
def flights():
    """The shipped policy's flight and one straight up."""
    return read_the_log.fly_shipped(), read_the_log.fly_straight_up()


@pytest.mark.slow
def test_the_parts_add_up_to_what_was_paid(flights):
    """At every step; and at the end they are those of the shipped evaluation."""
    for flight in flights:
        paid = np.cumsum(flight["reward"])
        np.testing.assert_allclose(flight["parts"].sum(axis=1), paid, atol=1e-9)
    metrics = json.loads((ROOT / "results" / "rocket_cutoff" / "eval.json").read_text())
    for part, value in zip(envs.RocketVectorEnv.PARTS, flights[0]["parts"][-1]):
        assert value == pytest.approx(metrics[part], abs=1e-3), part


@pytest.mark.slow
def test_pictures_are_drawn_and_small(flights, tmp_path, monkeypatch):
    monkeypatch.setattr(read_the_log, "fly_shipped", lambda: flights[0])
    monkeypatch.setattr(read_the_log, "fly_straight_up", lambda: flights[1])
    drawn = read_the_log.save_figures(tmp_path, read_the_log.pictures())
    assert {path.name for path in drawn} == set(re.findall(r"!\[.+\]\((.+)\)", PAGE))
    assert all((read_the_log.HERE / path.name).stat().st_size < 150e3 for path in drawn)
