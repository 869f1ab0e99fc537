"""The site, docs/mkdocs.yml: it builds without a warning and holds every page; its tables are the results'."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "docs"))

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
