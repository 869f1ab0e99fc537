"""What laws save by the size of the loss: groups, summaries and paired intervals against cases worked out by hand."""

import numpy as np
import pytest

from rocket import losses

NAN = np.nan


def ends(error, short):
    """`Ends` of lists."""
    return losses.Ends(np.array(error), np.array(short, dtype=float))


def test_every_flight_with_a_failure_is_in_one_group():
    """Bounds belong to the smaller losses; what is above 15 % is counted a second time."""
    lost = [0.0, 0.0, 0.05, 0.0501, 0.1, 0.15, 0.16, 0.2, 0.21, 0.25]
    failure = np.column_stack([[-1, 3, 3, 3, 0, 1, 2, 3, 3, 3], np.zeros(10), lost])
    failure[1, 2] = 1e-9
    groups = losses.groups(failure, 0.25)
    found = {label: np.flatnonzero(flights).tolist() for label, flights in groups.items()}
    assert found == {
        "0": [0],
        "0% to 5%": [1, 2],
        "5% to 10%": [3, 4],
        "10% to 20%": [5, 6, 7],
        "20% to 25%": [8, 9],
        "above 15%": [6, 7, 8, 9],
    }
    assert list(losses.groups(failure, 0.12)) == ["0", "0% to 5%", "5% to 10%", "10% to 12%"]
    assert list(losses.groups(failure, 0.3))[-2:] == ["25% to 30%", "above 15%"]


def test_a_law_by_hand():
    """Saved with a known optimum; saved without; missed; not savable."""
    law = ends([0.001, 0.019, 0.03, 0.001], [2.0, NAN, 50.0, 100.0])
    found = losses.summary(law, np.array([True, True, True, False]))
    assert found.pop("error_p95") == pytest.approx(0.019 + 0.9 * 0.011)
    assert found == {
        "savable": 3,
        "saved": 2,
        "saved_rate": 2 / 3,
        "error_median": 0.019,
        "short_flights": 1,
        "short_mean_kg": 2.0,
    }
    assert losses.summary(law, np.zeros(4, dtype=bool)) == {"savable": 0}


def test_a_paired_interval_by_hand():
    """Differences 1, 2 and 3: mean 2, deviation 1; t of two degrees of freedom at 97.5 % is 4.302653."""
    found = losses.mean_interval(np.array([1.0, 2.0, 3.0]), "mass_kg")
    half = 4.302653 / np.sqrt(3)
    assert found["mass_kg_flights"] == 3 and found["mass_kg"] == 2
    assert (found["mass_kg_low"], found["mass_kg_high"]) == pytest.approx((2 - half, 2 + half), abs=1e-6)
    assert losses.mean_interval(np.array([1.0]), "mass_kg") == {"mass_kg_flights": 1}


def test_two_laws_are_compared_on_the_flights_that_both_saved():
    """What one of them missed says nothing of kilograms; a law that is less short has more left."""
    savable = np.array([True, True, True, True, False])
    law = ends([0.001, 0.001, 0.001, 0.5, 0.001], [1.0, 2.0, 0.0, 0.0, -99.0])
    other = ends([0.001, 0.001, 0.5, 0.001, 0.001], [4.0, 9.0, 0.0, 0.0, 99.0])
    found = losses.paired(law, other, savable)
    assert (found["saved_rate"], found["saved_rate_flights"]) == (0, 4)
    assert (found["mass_kg"], found["mass_kg_flights"]) == (5, 2)
    backwards = losses.paired(other, law, savable)
    assert backwards["mass_kg"] == -5 and backwards["mass_kg_low"] == -found["mass_kg_high"]


@pytest.fixture
def arrays():
    """Six flights, two healthy; the standard law flew the first four."""
    failure = np.array([[-1, 0, 0], [3, 9, 0.03], [3, 9, 0.18], [3, 9, 0.24], [-1, 0, 0], [3, 9, 0.19]])
    best = np.array([7530, 7500, 7200, 6600, NAN, 7100])
    arrays = {"failure": failure, "best_mass_kg": best, "dry_mass_kg": np.full(6, 6644.0)}
    for name, n, short in (("mine", 6, 1.0), (losses.STANDARD, 4, 3.0)):
        arrays[f"{name}_error_norm"] = np.full(n, 1e-3)
        arrays[f"{name}_final_mass_kg"] = best[:n] - short
        arrays[f"{name}_mass_reached_kg"] = best[:n]
    return arrays


def test_a_report_counts_what_each_law_flew(arrays):
    report = losses.loss_report(arrays, ["mine", losses.STANDARD], 0.25)
    counts = {label: [rows[name]["savable"] for name in rows] for label, rows in report.items()}
    # the flight that loses 24 % ends below the dry mass at best; healthy ones count without an optimum, too
    assert counts == {
        "0": [2, 1],
        "0% to 5%": [1, 1],
        "5% to 10%": [0, 0],
        "10% to 20%": [2, 1],
        "20% to 25%": [0, 0],
        "above 15%": [2, 1],
    }
    assert report["0"]["mine"]["short_flights"] == 1 and report["0"]["mine"]["short_mean_kg"] == 1
    against = report["10% to 20%"]["mine"]["against"]
    assert against == {"saved_rate_flights": 1, "mass_kg_flights": 1}
    assert "against" not in report["0"][losses.STANDARD]
