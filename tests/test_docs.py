"""README and docs/: their links, tables and commands, and the front page's numbers against the results."""

import importlib
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import envs
import runs

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
ROCKETS = ("rocket_fixed", "rocket_cutoff", "rocket_dispersed", "two_stage_leo")
OTHERS = ("di", "vdp", "di_waypoints", "vdp_waypoints")


def text_of(path):
    """A page without its code blocks."""
    return re.sub(r"^ *(?:\d+\. )?```.*?^ *```", "", path.read_text(), flags=re.DOTALL | re.MULTILINE)


def anchor(heading):
    """What a heading is linked by."""
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def cells(line):
    """A table row's cells; a | behind a backslash is none of its bars."""
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip())[1:-1]]


def command_lines(path):
    """The commands of a page's bash blocks, a line each, without comments."""
    blocks = re.findall(r"```bash\n(.*?)```", path.read_text(), flags=re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True) for line in lines if "<" not in line]


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 220


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(page)):
        if "://" in target:
            continue
        name, _, part = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.exists(), target
        if part:
            headings = re.findall(r"^#+ (.*)$", text_of(path), flags=re.MULTILINE)
            assert part in map(anchor, headings), target


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_tables_are_whole_and_their_cells_short(page):
    columns = 0
    for line in text_of(page).splitlines():
        row = cells(line) if line.startswith("|") else []
        assert not row or columns in (0, len(row)), line
        columns = len(row)
        assert all(len(cell.split()) <= 40 for cell in row), line


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_commands_name_what_is_there(page):
    """Scripts exist, and those that train accept the flags."""
    for words in command_lines(page):
        files = [word for word in words if word.endswith(".py")]
        new = "MyRocket-v0" in words or any(name in word for word in words for name in ("jobs.txt", "my_rocket"))
        assert new or all((ROOT / word).exists() for word in files), words
        if not files or new or not files[0].startswith("ppo_gtrxl") or "--help" in words:
            continue
        script = importlib.import_module(files[0].removesuffix(".py"))
        runs.read_flags(script.Args, words[words.index(files[0]) + 1 :])


def row_of(result):
    """The line of README's table that links a result."""
    (line,) = [line for line in text_of(ROOT / "README.md").splitlines() if f"(results/{result}/README.md)" in line]
    return line


def seeds_of(result):
    """What every seed's evaluation found: key -> values."""
    seeds = [json.loads(path.read_text()) for path in (ROOT / "results" / result / "seeds").glob("*.json")]
    return {key: [seed[key] for seed in seeds if key in seed] for key in seeds[0]}


@pytest.mark.parametrize("result", [*OTHERS, *ROCKETS])
def test_the_front_page_says_what_the_results_hold(result):
    """The median over the seeds; the range is the writer's."""
    found, row = seeds_of(result), row_of(result)
    medians = {key: np.median(values) for key, values in found.items() if not isinstance(values[0], str)}
    expected = [f"{round(medians['wall_seconds'] / 60)}"]
    if result in OTHERS:
        expected += [f"**{medians['ratio_of_sums']:.4f}**", f"{medians['ratio_mean']:.4f}"]
        assert medians["hit_rate"] == 1  # as the first line below the table says
    elif "dispersed_error_median" in medians:
        error, rate = (found[f"dispersed_{key}"] for key in ("error_median", "box_rate"))
        expected += [f"**{np.median(error):.5f}** ({min(error):.5f} to {max(error):.5f})"]
        expected += ["{:.1f} % ({:.1f} to {:.1f})".format(*(100 * f(rate) for f in (np.median, min, max)))]
    else:
        rocket = envs.ROCKETS[found["env_id"][0]].rocket
        expected += [f"**{medians['error_norm']:.5f}**", f"{medians['reference_error_norm']:.5f}"]
        if "mass_ratio_reached" in medians:
            expected += [f"{medians['final_mass_kg']:.1f} kg", f"{medians['reference_mass_kg']:.1f} kg"]
            expected += [f"{100 * medians['mass_ratio_reached']:.2f} %"]
        else:
            off = 100 * abs(medians["a_error_km"]) * 1e3 / rocket.a, 100 * abs(medians["e_error"]) / rocket.e
            expected += [f"{off[0]:.2f} %, {off[1]:.2f} %, {abs(medians['i_error_deg']):.2f}°"]
    assert not [number for number in expected if number not in row]
