"""docs/walkthrough.md: its code runs as printed, from one step to the next, and prints what the page says."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
sys.path.append(str(DOCS))
import walkthrough  # noqa: E402

pytestmark = pytest.mark.slow

PAGE = walkthrough.PAGE.read_text()
STEPS = walkthrough.steps(PAGE)
NUMBER = re.compile(r"-?\d+(?:\.\d*)?")


def differing(said, printed):
    """The lines (said, printed) that differ by more than one unit of the last digit that is shown."""
    pairs = list(zip(said.splitlines(), printed.splitlines()))
    if len(said.splitlines()) != len(printed.splitlines()):
        return [(said, printed)]
    return [pair for pair in pairs if not same(*pair)]


def same(said, printed):
    """Whether two lines say the same, their blanks aside; whole numbers below 100, which count, are exact."""
    words = [NUMBER.sub("#", line).split() for line in (said, printed)]
    numbers = [NUMBER.findall(line) for line in (said, printed)]
    return words[0] == words[1] and all(close(*pair) for pair in zip(*numbers))


def close(said, printed):
    """Whether two numbers, as text, are one unit of the last digit apart at most."""
    decimals = len(said.partition(".")[2])
    unit = 10.0**-decimals if decimals or abs(int(float(said))) >= 100 else 0.0
    return abs(float(said) - float(printed)) <= 1.001 * unit


RUN = """
import json, sys, walkthrough
printed, names = walkthrough.run([code for code, _ in walkthrough.steps(walkthrough.PAGE.read_text())])
walkthrough.draw(sys.argv[1], names)
print(json.dumps(printed))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the pictures are drawn."""
    return tmp_path_factory.mktemp("pictures")


@pytest.fixture(scope="module")
def printed(folder):
    """What each step prints, all in one new process, as a reader runs them."""
    environment = {**os.environ, "PYTHONPATH": str(DOCS)}
    command = [sys.executable, "-c", RUN, str(folder)]
    done = subprocess.run(command, env=environment, cwd=DOCS.parent, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("number", range(1, 11))
def test_a_step_prints_what_the_page_says(printed, number):
    _, said = STEPS[number - 1]
    assert not differing(said, printed[number - 1])
