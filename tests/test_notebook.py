"""docs/first_flight.ipynb: it runs as it is, prints and draws what it shows, and stays small."""

import copy
import re
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[1] / "docs" / "first_flight.ipynb"
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def shown():
    """The notebook as it is committed."""
    nbformat = pytest.importorskip("nbformat", reason="a notebook needs nbclient (requirements-extras.txt)")
    return nbformat.read(NOTEBOOK, as_version=4)


@pytest.fixture(scope="module")
def executed(shown):
    """A copy of it, run in a kernel of its own as a reader runs it; it writes into a temporary folder alone."""
    nbclient = pytest.importorskip("nbclient", reason="a notebook needs nbclient (requirements-extras.txt)")
    pytest.importorskip("ipykernel", reason="a notebook needs ipykernel (requirements-extras.txt)")
    notebook = copy.deepcopy(shown)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    where = {"metadata": {"path": str(NOTEBOOK.parent)}}
    return nbclient.NotebookClient(notebook, timeout=600, resources=where).execute()


def printed(notebook):
    """What all cells print."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return "".join(output["text"] for output in outputs if output.output_type == "stream" and output.name == "stdout")


def pictures(notebook):
    """The pictures of each cell."""
    return ["image/png" in output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", [])]


def words_of(text):
    """A text without its numbers and blanks."""
    return re.sub(r"-?\d[\d.]*", "#", text).split()


def test_it_prints_and_draws_what_it_shows(shown, executed):
    assert words_of(printed(executed)) == words_of(printed(shown))
    assert pictures(executed) == pictures(shown) and sum(pictures(shown)) == 2


def test_the_rocket_reaches_its_orbit_and_the_training_learns(executed):
    """Of the run, not of what is committed: the shipped policy misses by little, the brief training ends near LQR."""
    text = printed(executed)
    misses = [float(number) for number in re.findall(r"\|\|error\|\| (\S+),", text)]
    assert len(misses) == 2 and max(misses) < 1e-4
    ratios = [float(number) for number in re.findall(r"ratio (\S+)", text)]
    assert len(ratios) == 4 and 1 <= ratios[-1] < 1.3 and ratios[-1] < ratios[0]
