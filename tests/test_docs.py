"""The pages: their links, tables and commands, and the front page's numbers against the results."""

import dataclasses
import importlib
import itertools
import json
import re
import shlex
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pytest

import baselines
import envs
import runs
from benchmarks import memory
from common.checkpoints import read_checkpoint
from phased.problem import flights_of_seed

ROOT = Path(__file__).resolve().parents[1]
OWN_PROBLEM = ROOT / "docs" / "own-problem.md"
PAGES = [ROOT / f"{name}.md" for name in ("README", "CHANGELOG", "CONTRIBUTING", "problems/README", "pages/README")]
PAGES += sorted((ROOT / "docs").rglob("*.md"))
PAGES += sorted((ROOT / "results").rglob("README.md"))  # they hold the commands of all results
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
ROCKETS = ("rocket_fixed", "rocket_cutoff", "rocket_dispersed", "rocket_failures", "two_stage_leo")
GO_ON_FROM = {"rocket_dispersed": ["rocket_cutoff"], "rocket_failures": ["rocket_cutoff", "rocket_dispersed"]}
LANDERS = ("mars_landing",)
OTHERS = ("di", "vdp", "di_waypoints", "vdp_waypoints")
COUNTS = {1: "one", 2: "two", 3: "three", 4: "four", 5: "five"}


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
def test_tables_are_whole_and_their_cells_short(page):
    columns = 0
    for line in text_of(page).splitlines():
        row = cells(line) if line.startswith("|") else []
        assert not row or columns in (0, len(row)), line
        columns = len(row)
        assert all(len(cell.split()) <= 40 for cell in row), line


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
        args, _ = runs.read_flags(script.Args(), words[words.index(files[0]) + 1 :])
        if not any("runs/" in word for word in words):  # the reader's run, of which a page cannot know
            runs.check(args, script.ENV_IDS)


def test_the_python_versions_are_one():
    """Of the front page, of the workflow's jobs and of pyproject.toml; and the requirements are one list."""
    readme = (ROOT / "README.md").read_text()
    workflow = (ROOT / ".github" / "workflows" / "tests.yml").read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    oldest, newest = re.search(r'python-version: \["(\S+)", "(\S+)"\]', workflow).groups()
    (on_mac,) = re.findall(r'os: macos-latest\n +python-version: "(\S+)"', workflow)
    assert f"Python {oldest} to {newest}" in readme
    assert f"with {oldest} and {newest} on Linux and with {on_mac} on macOS" in readme
    minor = int(newest.removeprefix("3.")) + 1
    assert project["project"]["requires-python"] == f">={oldest},<3.{minor}"
    assert project["project"]["dynamic"] == ["dependencies"] and "dependencies" not in project["project"]
    assert project["tool"]["setuptools"]["dynamic"]["dependencies"] == {"file": ["requirements.txt"]}


def test_the_page_s_policy_in_c_is_the_model_s():
    """The names and the memory's shape of docs/take-with-you.md, by the arguments of the policy that it exports."""
    (code,) = re.findall(r"```cpp\n(.*?)```", (ROOT / "docs" / "take-with-you.md").read_text(), flags=re.DOTALL)
    args = read_checkpoint(ROOT / "results" / "rocket_cutoff" / "agent.safetensors", {})["args"]
    heads, length, dk = args["num_heads"], args["memory_length"], args["embed_dim"] // args["num_heads"]
    shape = [args["num_blocks"], 2, 1, heads, length, dk]
    assert f"shape{{{', '.join(map(str, shape))}}}" in code and " * ".join(map(str, shape)) in code
    assert re.findall(r'"(\w+)"', code) == ["observation", "memory", "action", "next_memory"]


def row_of(result):
    """README's row that links a result: column -> cell."""
    lines = text_of(ROOT / "README.md").splitlines()
    (head,) = [cells(line) for line in lines if line.startswith("| problem |")]
    (row,) = [cells(line) for line in lines if f"(results/{result}/README.md)" in line]
    return dict(zip(head, row))


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
    if result in LANDERS:
        here = [(100 * found["landed_rate"], 2, " %"), (found["position_error_mean_m"], 2, " m")]
        return [(found["reference_fuel_mean_kg"], 1, " kg")], [*here, (found["fuel_ratio"], 3, "")]
    if "failure_saved_rate" in found:
        here = [(100 * found["failure_saved_rate"], 1, " %"), (found["failure_error_median"], 5, "")]
        return [([100.0], 0, " %")], [*here, (found["failure_mass_short_mean_kg"], 1, " kg")]
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


def test_the_front_page_says_how_many_flights_miss_a_circle():
    rates = np.concatenate([seeds_of(result)["hit_rate"] for result in OTHERS])
    missed = round(1000 * (1 - rates).sum())
    assert f"of all {1000 * len(rates)} flights {missed} miss one" in (ROOT / "README.md").read_text()


@pytest.mark.parametrize("result", [*OTHERS, *ROCKETS, *LANDERS])
def test_the_front_page_says_what_the_results_hold(result):
    """Medians over the seeds, in order and nothing else; ranges wherever they are given."""
    found, row = seeds_of(result), row_of(result)
    count = len(found["wall_seconds"])
    assert row["seeds"] == COUNTS[count]
    *before, minutes = row["minutes"].split(" + ")
    assert minutes == f"{np.median(found['wall_seconds']) / 60:.0f}"
    assert before == [row_of(name)["minutes"].split(" + ")[-1] for name in GO_ON_FROM.get(result, [])]
    for column, figures in zip(("optimum", "here"), measured(result, found)):
        numbers = numbers_of(row[column])
        medians = [f"{np.median(values):.{digits}f}{unit}" for values, digits, unit in figures]
        assert [number for number, *_ in numbers] == medians
        for (_, *span), (values, digits, _) in zip(numbers, figures):
            assert not any(span) or span == [f"{end:.{digits}f}" for end in (min(values), max(values))]
    assert any(numbers_of(row["here"])[0][1:]) == (count > 1)  # as the last line below the table says
    held_out = "–"
    if (ROOT / "results" / "held_out" / result).exists():
        first_figure = measured(result, seeds_of(f"held_out/{result}"))[1][0]
        held_out = ", ".join(f"{value:.{first_figure[1]}f}" for value in first_figure[0]) + first_figure[2]
    assert row["held out"] == held_out


def rows_below(page, heading):
    """The cells of the table of a page whose head begins so, a list a row."""
    lines = (ROOT / page).read_text().splitlines()
    (begin,) = [number for number, line in enumerate(lines) if line.startswith(heading)]
    rows = itertools.takewhile(lambda line: line.startswith("|"), lines[begin + 2 :])
    return [[cell.replace("**", "").replace("−", "-") for cell in cells(row)] for row in rows]


def test_the_opponents_are_those_of_the_results():
    laws = json.loads((ROOT / "results" / "rocket_dispersed" / "opponents.json").read_text())["laws"]
    names = ["policy", "nominal flight only", "replay", "tvlqr", "tvlqr_energy", "replan", "replan_measured"]
    names += ["replan_after_lqr", "replan_hint", "optimum"]
    for name, (_, _, errors, perigee, box, *_) in zip(
        names, rows_below("docs/rocket.md", "| law | what it has to know |"), strict=True
    ):
        law = {key.removeprefix("dispersed_"): value for key, value in laws[name].items()}
        for shown, key in zip(errors.split(", "), ("error_median", "error_p95", "error_max"), strict=True):
            digits = len(shown.partition(".")[2])
            assert float(shown) == pytest.approx(law[key], rel=0.03, abs=0.5 * 10**-digits), (name, key)
        assert perigee == "{perigee_error_mean_km:+.{0}f} ± {perigee_error_std_km:.{0}f}".format(
            len(perigee.rpartition(".")[2]), **law
        )
        assert box.split(" % ")[0] == f"{100 * law['box_rate']:.3g}", name


MEMORY_TABLES = {  # by the head's beginning: the experiment, and the columns that are compared
    "| | ratio of sums | p95 |": ("hidden_velocity", {0: ("ratio_of_sums", 1), 1: ("ratio_p95", 1)}),
    "| | seeds | hit both |": ("hidden_phase", {1: ("hit_rate", 100), 4: ("ratio_of_sums", 1)}),
}


@pytest.mark.parametrize("heading", MEMORY_TABLES)
def test_the_memorys_tables_are_those_of_the_results(heading):
    """Medians and ranges over the seeds of results/memory, by the rows and keys that benchmarks.memory prints."""
    name, columns = MEMORY_TABLES[heading]
    experiment = memory.EXPERIMENTS[name]
    found = memory.read(ROOT / "results" / "memory" / name, experiment)
    rows = {label: row for row, label in experiment.rows.items()}
    table = {
        label.removesuffix(" (five seeds)"): shown for label, *shown in rows_below("results/memory/README.md", heading)
    }
    assert set(table) - {"limit for any memory"} == set(rows)
    for label, shown in table.items():
        if label not in rows:
            continue
        runs_of = found[rows[label]]
        for column, (key, factor) in columns.items():
            values = [factor * run[key] for run in runs_of if key in run]
            cell = shown[column].replace(" %", "")
            if not values:
                assert cell == "-", label
                continue
            numbers = re.fullmatch(r"(\S+)(?: \((\S+) to (\S+)\))?", cell).groups()
            for number, value in zip(numbers, (np.median(values), min(values), max(values))):
                digits = len(number.partition(".")[2]) if number else 0
                assert number is None or float(number) == pytest.approx(value, abs=0.51 * 10**-digits), (label, key)


def test_the_front_page_s_problem_is_solved(new_problem, monkeypatch):
    """Its table as printed: an environment of its own, and an optimum that hits both circles."""
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
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
    code, boat, craft, _ = re.findall(r"```python\n(.*?)```", OWN_PROBLEM.read_text(), flags=re.DOTALL)
    made, names = [], {}
    monkeypatch.setattr(envs, "register_problem", lambda table: made.append(new_problem(table)))
    exec(code, names)
    for more, name in ((boat, "BOAT"), (craft, "CRAFT")):
        exec(more, names)
        table = names[name]
        x0, draw = flights_of_seed(table, 0, 1)
        optimum = baselines.reference(new_problem(table), x0, draw=draw)
        if name == "BOAT":  # Bryson and Ho, section 2.7: about 5.46 to the point itself; the circle saves some of it
            assert 5.3 < optimum["final_time"][0] < 5.46
        else:  # by minimum energy, 12 d^2 / T^3 of each axis
            assert optimum["cost_running"][0] == pytest.approx(2 * 12 / 2**3, rel=0.05)
    thrust = np.random.default_rng(0).uniform(0, 3.5, (60, 1, 1))
    x0 = np.array([[0.0, 0.0, 1.0]])
    printed, shipped = (envs.fly(env_id, lambda obs, t: thrust[t], x0) for env_id in (made[0], "Goddard-v0"))
    for key, value in printed.items():
        np.testing.assert_array_equal(value, shipped[key])


def test_every_field_of_a_table_is_on_its_page():
    page = OWN_PROBLEM.read_text()
    for table in (envs.Problem, envs.Phase):
        for field in dataclasses.fields(table):
            assert f"`{field.name}`" in page, field.name


@pytest.mark.slow
def test_noise_wastes_the_speed_that_the_page_says(monkeypatch, capsys):
    """Its code as printed: action noise slows the 961 s policy by half a km/s, noise in the memory does nothing."""
    monkeypatch.chdir(ROOT)  # it names a policy of results/
    page = (ROOT / "results" / "table_1" / "rocket" / "README.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    exec(code, {})
    calm, memory, action, both = ([float(x) for x in line.split()] for line in capsys.readouterr().out.splitlines())
    assert [row[:2] for row in (calm, memory, action, both)] == [[0, 0], [0, 0.1], [0.176, 0], [0.176, 0.1]]
    assert calm[2] < 0.0002 and memory[2] < 0.001 and max(abs(calm[3]), abs(memory[3])) < 0.002
    for *_, miss, too_fast in (action, both):
        assert miss == pytest.approx(0.18, abs=0.015) and too_fast == pytest.approx(-0.5, abs=0.06)


def glossary():
    """The terms of docs/glossary.md by section."""
    sections = re.split(r"^## ", text_of(ROOT / "docs" / "glossary.md"), flags=re.MULTILINE)[1:]
    tables = {
        section.splitlines()[0]: [line for line in section.splitlines() if line[:1] == "|"] for section in sections
    }
    rows = {name: [cells(line) for line in lines[2:]] for name, lines in tables.items()}
    assert len(rows) == 5 and all(rows.values())
    return rows


def test_the_glossary_is_in_order_and_each_term_has_one_sentence_and_a_link():
    plain = lambda term: re.sub(r"[^\w ]", "", term).lower()  # noqa: E731
    terms = [term for rows in glossary().values() for term, *_ in rows]
    assert len(terms) == len(set(terms)) > 70
    for rows in glossary().values():
        assert [term for term, *_ in rows] == sorted((term for term, *_ in rows), key=plain)
        for term, meaning, where in rows:
            assert meaning and ". " not in meaning and re.fullmatch(r"\[[^]]+\]\([^)]+\)", where), term


def test_the_terms_of_the_glossary_are_used():
    """On the front page or another one; a plural counts."""
    used = "\n".join(text_of(page) for page in PAGES if page.name not in ("glossary.md", "CHANGELOG.md")).lower()
    idle = [
        term
        for rows in glossary().values()
        for terms, *_ in rows
        for term in terms.split(", ")
        if not re.search(rf"(?<!\w){re.escape(term.lower())}", used)
    ]
    assert idle == []
