"""docs/read-the-log.md: every tag and every piece of a printed line is there, and nothing that no run writes."""

import contextlib
import importlib
import io
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import evaluate
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


# --- the printed lines ------------------------------------------------------------------------------------------------


# --- the table of ranges and the pictures -----------------------------------------------------------------------------
