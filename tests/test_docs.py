"""The pages: links, commands, the front page's numbers; their code, the notebook and the site as a reader has them."""

import importlib
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from helpers import TINY
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import baselines
import envs
import evaluate
import ppo_gtrxl_di
import runs
from common import curves
from phased.problem import flights_of_seed
from rocket import guidance

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "docs"))
import walkthrough  # noqa: E402

OWN_PROBLEM = ROOT / "docs" / "own-problem.md"
PAGES = [ROOT / f"{name}.md" for name in ("README", "CHANGELOG", "CONTRIBUTING", "problems/README", "pages/README")]
PAGES += sorted((ROOT / "docs").rglob("*.md"))
PAGES += sorted((ROOT / "results").rglob("README.md"))  # they hold the commands of all results
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
ROCKETS = ("rocket_fixed", "rocket_cutoff", "rocket_dispersed", "rocket_failures", "rocket_any_orbit", "two_stage_leo")
GO_ON_FROM = {
    "rocket_dispersed": ["rocket_cutoff"],
    "rocket_failures": ["memory/nominal/no_blocks", "memory/rocket/no_blocks"],
}
LANDERS = ("mars_landing",)
OTHERS = ("di", "vdp", "di_waypoints", "vdp_waypoints")
RESULT_TABLES = (ROOT / "README.md", ROOT / "docs" / "results.md")


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
    """The commands of a page's bash blocks, a line each, without comments; what the reader fills in is one word."""
    blocks = re.findall(r"```bash\n(.*?)```", path.read_text(), flags=re.DOTALL)
    lines = re.sub(r"<[^>\n]*>", "placeholder", "\n".join(blocks).replace("\\\n", " ")).splitlines()
    return [shlex.split(line, comments=True) for line in lines]


@each_page
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


@each_page
def test_commands_name_what_is_there(page):
    """Scripts and lists exist, and scripts that train accept the flags and their values."""
    for words in command_lines(page):
        files = [word for word in words if word.endswith((".py", ".txt"))]
        files += [f"{word.replace('.', '/')}.py" for word in words if word.startswith("benchmarks.")]
        assert all((ROOT / word).exists() for word in files), words
        # the reader's rocket is no id here
        if not files or not files[0].startswith("ppo_gtrxl") or {"MyRocket-v0", "--help"} & set(words):
            continue
        script = importlib.import_module(files[0].removesuffix(".py"))
        args = script.Args(**runs.read_flags(script.Args(), words[words.index(files[0]) + 1 :]))
        if not any("runs/" in word for word in words):  # the reader's run, of which a page cannot know
            runs.check(args, script.ENV_IDS)


def row_of(result):
    """The row of README, or of docs/results.md, that links a result: column -> cell."""
    tables = re.findall(
        r"^\| problem \| what is measured \|.*\n(?:\|.*\n)+", "".join(map(text_of, RESULT_TABLES)), flags=re.M
    )
    lines = [line for table in tables for line in table.splitlines()]
    (row,) = [line for line in lines if f"results/{result}/README.md)" in line or f"]({result}/README.md)" in line]
    return dict(zip(cells(lines[0]), cells(row)))


def numbers_of(cell):
    """A cell's numbers, units included, and behind each its range (low, high), empty where it has none."""
    return re.findall(r"([-−]?\d[\d.]*(?: %| kg| m|°)?)\** ?(?:\((\S+) to (\S+)\))?", cell)


def seeds_of(result):
    """What every seed's evaluation found: key -> a value a seed."""
    paths = sorted((ROOT / "results" / result / "seeds").glob("*.json"), key=lambda path: int(path.stem))
    seeds = [json.loads(path.read_text()) for path in paths]
    return {key: np.array([seed[key] for seed in seeds]) for key in set.intersection(*map(set, seeds))}


def measured(result, found):
    """What the cells "optimum" and "here" are of, in their order: (values, digits, unit) each."""
    if result in OTHERS:
        return [([1.0], 0, "")], [(found["ratio_of_sums"], 4, ""), (found["ratio_mean"], 4, "")]
    if result == "rendezvous":
        here = [(found["nominal_ratio"], 3, ""), (100 * found["hit_rate"], 1, " %")]
        return [([1.0], 0, "")], [*here, (100 * found["constraints_kept_rate"], 1, " %")]
    if result in LANDERS:
        here = [(100 * found["landed_rate"], 2, " %"), (found["position_error_mean_m"], 2, " m")]
        return [(found["reference_fuel_mean_kg"], 1, " kg")], [*here, (found["fuel_ratio"], 3, "")]
    if "failure_saved_rate" in found:
        here = [(100 * found["failure_saved_rate"], 1, " %"), (found["failure_error_median"], 5, "")]
        return [([100.0], 0, " %")], [*here, (found["failure_mass_short_mean_kg"], 1, " kg")]
    if "target_starts" in found:
        best = json.loads((ROOT / "results" / result / "opponents.json").read_text())["laws"]["IPOPT for each"]
        optimum = [(np.array([best["error_median"]]), 6, ""), (np.array([100 * best["box_rate"]]), 0, " %")]
        here = [(found["target_error_median"], 5, ""), (100 * found["target_box_rate"], 1, " %")]
        return optimum, [*here, (100 * found["target_mass_ratio_mean"], 2, " %")]
    optimum, here = [(found["reference_error_norm"], 6, "")], [(found["error_norm"], 6, "")]
    if "dispersed_error_median" in found:
        best = json.loads((ROOT / "results" / result / "opponents.json").read_text())["laws"]["optimum"]
        optimum = [([best["dispersed_error_median"]], 5, ""), ([100 * best["dispersed_box_rate"]], 0, " %")]
        here = [(found["dispersed_error_median"], 5, ""), (100 * found["dispersed_box_rate"], 1, " %")]
    elif "mass_ratio_reached" in found:
        optimum += [(found["reference_mass_kg"], 1, " kg")]
        here += [(found["final_mass_kg"], 1, " kg"), (100 * found["mass_ratio_reached"], 3, " %")]
    else:
        rocket = envs.ROCKETS[found["env_id"][0]].rocket
        here += [(100 * abs(found["a_error_km"]) * 1e3 / rocket.a, 3, " %")]
        here += [(100 * abs(found["e_error"]) / rocket.e, 3, " %"), (abs(found["i_error_deg"]), 3, "°")]
    return optimum, here


def test_edits_of_a_script_change_one_line():
    """A page's `sed 's/old/new/' script` is for the script of today."""
    edits = [edit for page in PAGES for edit in re.findall(r"`sed (?:-i )?('[^']*') (\w+\.py)", page.read_text())]
    assert edits
    for expression, script in edits:
        text = (ROOT / script).read_text()
        edited = subprocess.run(["sed", shlex.split(expression)[0]], input=text, capture_output=True, text=True).stdout
        changed = [pair for pair in zip(text.splitlines(), edited.splitlines(), strict=True) if pair[0] != pair[1]]
        assert len(changed) == 1, f"sed {expression} {script}"


@pytest.mark.parametrize("result", [*OTHERS, *ROCKETS, *LANDERS, "rendezvous"])
def test_the_front_page_says_what_the_results_hold(result):
    """Medians over the seeds, in order and nothing else; ranges wherever they are given."""
    found, row = seeds_of(result), row_of(result)
    *before, minutes = row["minutes"].split(" + ")
    assert minutes == f"{np.median(found['wall_seconds']) / 60:.0f}"
    first = [seeds_of(name)["wall_seconds"] for name in GO_ON_FROM.get(result, [])]
    assert before == [f"{np.median(seconds) / 60:.0f}" for seconds in first]
    for column, figures in zip(("optimum", "here"), measured(result, found)):
        numbers = numbers_of(row[column])
        medians = [f"{np.median(values):.{digits}f}{unit}" for values, digits, unit in figures]
        assert [number for number, *_ in numbers] == medians
        for (_, *span), (values, digits, _) in zip(numbers, figures):
            assert not any(span) or span == [f"{end:.{digits}f}" for end in (min(values), max(values))]
    assert any(numbers_of(row["here"])[0][1:]) == (len(found["wall_seconds"]) > 1)
    held_out = "–"
    if (ROOT / "results" / "held_out" / result).exists():
        first_figure = measured(result, seeds_of(f"held_out/{result}"))[1][0]
        held_out = ", ".join(f"{value:.{first_figure[1]}f}" for value in first_figure[0]) + first_figure[2]
    assert row["held out"] == held_out


def test_the_front_page_s_code_runs(new_problem, monkeypatch, capsys):
    """Its policy flies to a target. Its table is an environment, with an optimum that hits both circles."""
    code, fly = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    monkeypatch.chdir(ROOT)
    exec(fly, {})
    error, mass = capsys.readouterr().out.split()
    assert float(error) < 0.001 and float(mass) > 10_000
    monkeypatch.setattr(envs, "register_problem", new_problem)
    names = {}
    exec(code, names)
    env_id = names["DUFFING"].env_id
    x0 = baselines.starts(0, 5, names["DUFFING"].x0_max)
    assert baselines.reference(env_id, x0)["hit"].all()
    x = envs.fly(env_id, lambda obs, t: np.zeros((5, 1)), x0)["x"]  # without control the damped spring loses energy
    energy = x[..., 1] ** 2 / 2 - x[..., 0] ** 2 / 2 + x[..., 0] ** 4 / 4
    assert (np.diff(energy, axis=1) < 0).all()


def test_the_page_s_problem_is_that_of_the_folder(new_problem, monkeypatch):
    """The table of docs/own-problem.md as printed, flown beside problems/goddard.py."""
    code, boat, obstacles, _ = re.findall(r"```python\n(.*?)```", OWN_PROBLEM.read_text(), flags=re.DOTALL)
    made, names = [], {}
    monkeypatch.setattr(envs, "register_problem", lambda table: made.append(new_problem(table)))
    exec(code, names)
    for more, name in ((boat, "BOAT"), (obstacles, "OBSTACLES")):
        exec(more, names)
        table = names[name]
        x0, draw = flights_of_seed(table, 0, 1)
        optimum = baselines.reference(new_problem(table), x0, draw=draw)
        if name == "BOAT":  # Bryson and Ho, section 2.7: about 5.46 to the point itself; the circle saves some of it
            assert 5.3 < optimum["final_time"][0] < 5.46
        else:  # tests/test_problems.py compares it with the shortest way
            assert optimum["cost"][0] == pytest.approx(4.5456, abs=1e-4)
    thrust = np.random.default_rng(0).uniform(0, 3.5, (60, 1, 1))
    x0 = np.array([[0.0, 0.0, 1.0]])
    printed, shipped = (envs.fly(env_id, lambda obs, t: thrust[t], x0) for env_id in (made[0], "Goddard-v0"))
    for key, value in printed.items():
        np.testing.assert_array_equal(value, shipped[key])


# --- a run as a reader makes it: the ten steps, the notebook, the site, the log ---------------------------------------

NUMBER = re.compile(r"-?\d+(?:\.\d*)?")


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


@pytest.mark.slow
def test_the_ten_steps_print_what_the_page_says():
    """In one namespace, as a reader runs them, to one unit of the last digit that is shown."""
    steps = walkthrough.steps(walkthrough.PAGE.read_text())
    for (_, said), printed in zip(steps, walkthrough.run([code for code, _ in steps])[0], strict=True):
        lines, found = said.splitlines(), printed.splitlines()
        assert len(lines) == len(found) and all(map(same, lines, found)), (said, printed)


@pytest.mark.slow
def test_the_notebook_prints_what_it_shows(monkeypatch):
    """But for the numbers. The shipped policy misses by little, the brief training ends near LQR."""
    monkeypatch.setattr(plt, "show", lambda: plt.close("all"))
    cells = json.loads((ROOT / "docs" / "first_flight.ipynb").read_text())["cells"]
    cells = [cell for cell in cells if cell["cell_type"] == "code"]
    outputs = [output for cell in cells for output in cell["outputs"] if output.get("name") == "stdout"]
    said = "".join(line for output in outputs for line in output["text"])
    with plt.rc_context():
        text = "".join(walkthrough.run(["".join(cell["source"]) for cell in cells])[0])
    assert NUMBER.sub("#", text).split() == NUMBER.sub("#", said).split()
    misses = [float(number) for number in re.findall(r"\|\|error\|\| (\S+),", text)]
    assert len(misses) == 2 and max(misses) < 1e-4
    ratios = [float(number) for number in re.findall(r"ratio (\S+)", text)]
    assert len(ratios) == 4 and 1 <= ratios[-1] < 1.3 and ratios[-1] < ratios[0]


@pytest.mark.slow
def test_the_site_builds_and_holds_every_page(tmp_path):
    """A link that leads nowhere would end the build."""
    pytest.importorskip("material", reason="the site needs mkdocs-material (requirements-extras.txt)")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", str(ROOT / "docs" / "mkdocs.yml")]
    done = subprocess.run([*command, "-d", str(tmp_path)], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    for page in [*(ROOT / "docs").rglob("*.md"), ROOT / "CONTRIBUTING.md"]:
        assert (tmp_path / page.relative_to(ROOT)).with_suffix(".html").exists(), page
    front = (tmp_path / "index.html").read_text()
    assert "results/rocket_failures/figures/animation.gif" in front and (tmp_path / "results/di/index.html").exists()
    styles = re.findall(r'<link rel="stylesheet" href="([^"]+)"', front)
    assert styles and all((tmp_path / style).exists() for style in styles)
    assert not [path for path in tmp_path.rglob("*") if path.suffix in {".npz", ".safetensors", ".csv", ".pt"}]
    # links to folders are left as they are: there has to be a page to be shown
    for name in re.findall(r"unrecognized relative link '[./]*(\w+)'", done.stdout + done.stderr):
        assert (tmp_path / name / "index.html").exists(), name


# --- the log's tags ---------------------------------------------------------------------------------------------------

# the optimum's mass and time are named without "final"; its mass for another orbit is explained beside its ratio
LEFT_TO_THE_OPTIMUM = {"eval/mass_kg", "eval/mass_reached_kg"}


def documented(tag, patterns):
    """Whether a written tag is an instance of one of the page's; one of the optimum has to be one of ours, too."""
    found = [name for name, pattern in patterns.items() if pattern.fullmatch(tag)]
    if found == ["eval/reference_<key>"]:
        ours = tag.replace("reference_", "")
        return ours in LEFT_TO_THE_OPTIMUM or documented(ours, patterns)
    return bool(found)


@pytest.mark.slow
def test_every_tag_of_a_run_is_on_its_page(tmp_path, monkeypatch):
    """Of a smoke run, of the shipped curves, of a landing, and of flights with failures."""
    monkeypatch.chdir(tmp_path)
    ppo_gtrxl_di.main([*TINY, "--total-updates=2", "--eval-every=1"])
    (run,) = Path("runs").iterdir()
    tags = set(EventAccumulator(str(run)).Reload().Tags()["scalars"])
    for path in (ROOT / "results").rglob("seeds/*.csv"):
        tags |= set(curves.read_csv(path))
    no_thrust = lambda obs, t: np.zeros((len(obs), 3))  # noqa: E731
    cutoff = "RocketAscentCutoff-v0"  # of eval seed 0 and these options the optima are stored
    for metrics, _ in (
        evaluate.evaluate("MarsLanding-v0", no_thrust, 0, 2),
        evaluate.evaluate(cutoff, guidance.open_loop(cutoff), 0, 100, dispersion=1.0, failure=0.3),
    ):
        tags |= {f"eval/{key}" for key, value in metrics.items() if isinstance(value, int | float)}
    page = (ROOT / "docs" / "read-the-log.md").read_text()
    named = re.findall(r"`((?:charts|losses|eval)/[^`]+)`", page)
    patterns = {tag: re.compile(r"\w+".join(map(re.escape, re.split(r"<\w+>", tag)))) for tag in named}
    assert "eval/failure_saved_rate" in tags
    assert [tag for tag in sorted(tags) if not documented(tag, patterns)] == []
