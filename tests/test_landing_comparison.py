"""`python evaluate.py opponents` of a landing: rows, table, refusals; `python baselines.py` of a lander."""

import json

import numpy as np
import pytest

from common.errors import BadInput
from landing import comparison
from landing.lander import LANDERS, MARS
from landing.metrics import draws
from landing.report import report_lander

ID = "MarsLanding-v0"
FAILURE = {"failure_probability": 0.5, "failure_size": 2.5, "failure_vertical": 1.5, "failure_time": "start"}


def test_the_printed_rows_are_reproduced():
    """DR/DV by the published end: means within three standard errors of the notebooks' rows, fuel within 2 %."""
    rows = comparison.published_rows(ID, 0, 1000)
    for name, printed in (
        ("drdv, p = 0, published end", "DR/DV, no failure"),
        ("drdv, p = 0.5, published end", "DR/DV"),
    ):
        ours = rows[name]
        _, _, speed, sigma, _, fuel, n = comparison.PUBLISHED[printed]
        assert ours["speed_mean_m_s"] == pytest.approx(speed, abs=3 * sigma / n**0.5)
        assert ours["fuel_mean_kg"] == pytest.approx(fuel, rel=0.02)
    assert rows["drdv, p = 0.5, published end"]["position_error_mean_m"] == pytest.approx(
        144.9, abs=3 * 227.5 / 1000**0.5
    )
    exact, published = (rows[f"drdv, p = 0, {end} end"]["speed_mean_m_s"] for end in ("exact", "published"))
    assert exact < published  # the law's speed grows again below ground


def test_a_law_is_compared_where_the_optimum_is_known():
    """The ratio is over the draws whose optimum was found."""
    z = draws(0, 6)
    make_law = comparison.law_makers(MARS)["drdv"]
    fuel = np.array([100.0, np.nan, 300.0])
    row = comparison.fly_law(ID, make_law, z, fuel, **FAILURE)
    flown = comparison.fly_draws(ID, make_law, z, **FAILURE)["fuel_kg"]
    assert row["fuel_ratio"] == pytest.approx((flown[0] + flown[2]) / 400)
    assert (row["eval_starts"], row["reference_starts"]) == (6, 2)


def test_the_harder_failures_are_those_that_the_notebooks_print(monkeypatch):
    flown = []

    def note(env_id, failure, *rest):
        flown.append(failure)
        return {}

    monkeypatch.setattr(comparison, "fly_laws", note)
    rows = comparison.stress_rows(ID, {}, FAILURE, 0, 3, 2)
    assert [(f["failure_size"], f["failure_vertical"], f["failure_probability"]) for f in flown] == [
        (3.0, 1.5, 0.5),
        (2.5, 1.75, 0.5),
    ]
    assert rows["3 / 1.5: GRU, 60 steps, printed"]["position_error_max_m"] == 7.6
    assert rows["2.5 / 1.75: GRU, 60 steps, printed"]["speed_max_m_s"] == 31.9


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "eval.json").write_text(json.dumps({"env_id": ID, **FAILURE}))
    return tmp_path


@pytest.mark.parametrize(
    "changed, says",
    [
        ({"dispersion": 2.0}, "--dispersion is 2.0"),
        ({"solved": 300}, "--solved is 300"),
        ({"also": [("drdv", "x")]}, "the NAME of --also is drdv"),
        ({}, "agent.safetensors"),
    ],
)
def test_what_cannot_be_compared_is_refused(folder, changed, says):
    asked = {"dispersion": 1.0, "n": 200, "solved": 200, "eval_seed": 0, "also": ()} | changed
    with pytest.raises(BadInput, match=says):
        comparison.compare(ID, folder, **asked)
    assert not (folder / "opponents.json").exists()


def test_a_lander_of_one_start_is_reported_by_constraint(capsys):
    numbers, arrays = report_lander("PoweredDescent-v0", 1, 0)
    assert numbers["altitude_at_least_0"]["fuel_kg"] == pytest.approx(390.4, abs=0.2)
    assert arrays["no_constraint_on_the_path_y"][:, 2].min() < 0  # it would fly below ground
    assert capsys.readouterr().out.count("\n") == 4


def test_the_reported_optima_are_those_of_the_draws(capsys):
    numbers, arrays = report_lander(ID, 2, 5)
    assert numbers["solved"] == 2 and numbers["fuel_all_mean_kg"] == pytest.approx(arrays["fuel_kg"].mean())
    assert 150 < numbers["fuel_all_mean_kg"] < 280
    assert LANDERS[ID] is MARS and "propellant" in capsys.readouterr().out
