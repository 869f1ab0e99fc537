"""The site, docs/mkdocs.yml: it builds without a warning and holds every page; its tables are the results'."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import run_seeds

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "docs"))
import failure_tables  # noqa: E402
import script_pages  # noqa: E402

CONFIG = ROOT / "docs" / "mkdocs.yml"
PAGES = sorted((ROOT / "docs").rglob("*.md"))


def build(config, folder):
    """mkdocs with --strict: whether it ended well, and what it said."""
    pytest.importorskip("material", reason="the site needs mkdocs-material (requirements-extras.txt)")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", str(config), "-d", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    return done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_the_site_builds_and_holds_every_page(tmp_path):
    succeeded, said = build(CONFIG, tmp_path)
    assert succeeded, said
    for page in [*PAGES, ROOT / "CONTRIBUTING.md"]:
        assert (tmp_path / page.relative_to(ROOT)).with_suffix(".html").exists(), page
    front = (tmp_path / "index.html").read_text()
    assert "results/rocket_cutoff/figures/animation.gif" in front and "docs/read-the-log.html" in front
    assert (tmp_path / "results/di/index.html").exists() and (tmp_path / "results/di/figures/training.png").exists()
    styles = re.findall(r'<link rel="stylesheet" href="([^"]+)"', front)
    assert styles and all((tmp_path / style).exists() for style in styles)
    heavy = [path for path in tmp_path.rglob("*") if path.suffix in {".npz", ".safetensors", ".csv", ".pt"}]
    assert heavy == []
    # links to folders are left as they are: there has to be a page to be shown
    for name in re.findall(r"unrecognized relative link '[./]*(\w+)'", said):
        assert (tmp_path / name / "index.html").exists(), name


@pytest.mark.slow
def test_a_link_that_leads_nowhere_is_refused(tmp_path):
    """The same settings, two pages: a link to a file and one to a heading that are not there."""
    docs = tmp_path / "repository" / "docs"
    docs.mkdir(parents=True)
    settings = CONFIG.read_text().split("\nnav:\n")[0]
    (docs / "mkdocs.yml").write_text(settings)
    (docs.parent / "README.md").write_text("# Front\n\n[a page](docs/page.md#a-heading-of-its-own)\n")
    (docs / "page.md").write_text("# Page\n\n## A heading, of its own\n")
    assert build(docs / "mkdocs.yml", tmp_path / "site")[0]
    for wrong in ("docs/none.md", "docs/page.md#none"):
        (docs.parent / "README.md").write_text(f"# Front\n\n[a page]({wrong})\n")
        succeeded, said = build(docs / "mkdocs.yml", tmp_path / "site")
        assert not succeeded and wrong.partition("#")[2] in said and "strict" in said


def test_every_page_is_in_the_navigation():
    named = set(re.findall(r": (docs/\S+\.md)$", CONFIG.read_text(), flags=re.MULTILINE))
    assert named == {str(page.relative_to(ROOT)) for page in PAGES}


def test_every_script_has_a_page():
    scripts = {path.stem for path in ROOT.glob("ppo_gtrxl_*.py")}
    assert {path.stem for path in (ROOT / "docs" / "scripts").glob("*.md")} == scripts


@pytest.mark.parametrize("name", script_pages.ROWS)
def test_the_table_of_a_script_is_that_of_the_results(name):
    """`python docs/script_pages.py` would write nothing new; and another table would be seen."""
    text = (script_pages.PAGES / f"{name}.md").read_text()
    assert script_pages.with_rows(text, name) == text
    assert all(f"results/{result}/README.md" in text for result in script_pages.ROWS[name])
    assert script_pages.with_rows(text.replace("(0.0000", "(0.1").replace("(1.00", "(1.1"), name) == text


def test_the_table_of_held_out_runs_is_that_of_the_results():
    """`python docs/script_pages.py` would write nothing new, and another table would be seen. Runs are those listed."""
    text = (ROOT / "docs" / "results.md").read_text()
    assert script_pages.with_held_out_rows(text) == text
    assert script_pages.with_held_out_rows(text.replace("| 1.0002 (", "| 1.0003 (")) == text
    jobs = run_seeds.read_trainings(ROOT / "benchmarks" / "trainings" / "held_out.txt")
    for result in script_pages.HELD_OUT:
        trained = {int(path.stem) for path in (ROOT / "results" / "held_out" / result).glob("seeds/*.json")}
        assert trained <= {job.args["seed"] for job in jobs if job.results.name == result}
        assert len(trained) in (0, 2)


def test_a_row_has_the_median_and_the_range():
    assert script_pages.span([3.0, 1.0, 2.0], 1) == "2.0 (1.0 to 3.0)" and script_pages.span([1.0, 1.0], 0) == "1"


def test_the_tables_of_failures_are_those_of_the_comparisons():
    """`python docs/failure_tables.py` would write nothing new. Another row would be seen, a missing table, too."""
    text = failure_tables.PAGE.read_text()
    assert failure_tables.with_tables(text) == text
    changed = re.sub(r"^\| our policy, trained for failures \| .*%.*$", "| nothing |", text, flags=re.MULTILINE)
    assert changed.count("| nothing |") >= 2 and failure_tables.with_tables(changed) == text
    with pytest.raises(ValueError, match="short .kg., last ignition"):
        failure_tables.with_tables(text.replace("| short (kg), last ignition |", "| short |"))
