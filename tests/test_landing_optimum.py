"""The landers' fuel optima: against published numbers, SciPy's integrator and the environment."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from common.errors import BadInput, NoOptimum
from envs import MARS, POWERED_DESCENT, fly_lander
from landing import optimum
from landing.lander import DRAW, Lander, draw_flights
from landing.optimum import optimise_landing, references

pytestmark = pytest.mark.slow

LANDING, DESCENT = "MarsLanding-v0", "PoweredDescent-v0"
RANDOM = {"failure_probability": 0.7, "failure_time": "random"}

HEALTHY = MARS.failure._replace(probability=0.0)


def rows(n, seed=0):
    """Draws (n, 13)."""
    return np.random.default_rng(seed).random((n, len(DRAW)))


def played(u):
    """The policy that plays commands u (n, T, 3) in N of the Mars lander."""
    actions = np.nan_to_num(u) / MARS.greatest_thrust
    return lambda obs, t: actions[:, min(t, actions.shape[1] - 1)]


# --- Acikmese and Ploen's lander --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def descent():
    """Its one flight, solved by glide slope."""
    flight = draw_flights(POWERED_DESCENT, np.full((1, len(DRAW)), 0.5), HEALTHY)
    return {slope: optimise_landing(POWERED_DESCENT, flight, slope) for slope in (None, 0.0, 4.0)}


@pytest.mark.parametrize(
    "slope, fuel, seconds",
    [(None, 387.9, 72.2), (0.0, 390.4, 74.3), (4.0, 398.1, 77.7)],
    ids=["no path constraint", "above ground", "glide slope of 4 degrees"],
)
def test_powered_descent_is_that_of_other_solves(descent, slope, fuel, seconds):
    assert descent[slope]["fuel_kg"] == pytest.approx(fuel, rel=3e-4)
    assert descent[slope]["final_time"] == pytest.approx(seconds, abs=0.3)


def test_paths_keep_their_constraints(descent):
    assert descent[None]["y"][:, 2].min() < -100  # else the other two would say nothing
    assert descent[0.0]["y"][:-1, 2].min() >= 0
    r = descent[4.0]["y"][:-1, :3]
    assert (r[:, 2] >= np.tan(np.radians(4)) * np.hypot(r[:, 0], r[:, 1]) - 1e-3).all()
    for found in descent.values():
        norm = np.linalg.norm(found["u"], axis=1)
        assert norm.min() >= POWERED_DESCENT.least_thrust * (1 - 1e-6)
        assert norm.max() <= POWERED_DESCENT.greatest_thrust * (1 + 1e-6)
        assert found["y"][:, 6].min() >= POWERED_DESCENT.dry_mass
        assert len(found["t"]) == len(found["y"]) == len(found["u"]) + 1


def test_equal_flights_are_solved_once(monkeypatch):
    """Nothing of this lander is drawn."""
    calls = []

    def counted(lander, flight):
        calls.append(flight)
        return optimise_landing(lander, flight)

    monkeypatch.setattr(optimum, "optimise_landing", counted)
    found = references(DESCENT, rows(3, seed=9))
    assert len(calls) == 1
    assert np.ptp(found["fuel_kg"]) == 0


# --- Mars -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mars():
    """Draws (5, 13) and their references, with failures at random moments."""
    draw = rows(5)
    return draw, references(LANDING, draw, **RANDOM)


def test_every_reference_lands_as_it_was_solved(mars):
    draw, found = mars
    flown = fly_lander(LANDING, played(found["u"]), draw, **RANDOM)
    assert found["solved"].all() and flown["down"].all()
    assert flown["position_error"].max() < 0.01
    assert flown["speed"].max() < 0.02
    np.testing.assert_allclose(flown["fuel_kg"], found["fuel_kg"], atol=1e-6)
    np.testing.assert_allclose(flown["final_time"], found["final_time"], atol=1e-6)
    np.testing.assert_allclose(flown["u"], found["u"], atol=1e-2)  # nothing is clipped


def test_commands_lead_there_by_scipys_integrator(mars):
    """DOP853 with its own reading of the draw, of the failure and of the engine."""
    draw, found = mars
    struck = (draw[:, 10] < 0.7) & (40 * draw[:, 12] < found["final_time"])
    k = int(np.flatnonzero(struck)[0])
    z, end = 2 * draw[k] - 1, found["final_time"][k]
    g = 3.7114 * 0.05 * z[7:10] - [0, 0, 3.7114]
    y = np.concatenate([[1000, 0, 2350] + [1000, 1000, 50] * z[:3], [-40, 0, -80] + [30, 30, 10] * z[3:6]])
    y = np.append(y, 2000 * (1 + 0.05 * z[6]))
    start = y.copy()
    loss = np.array([2.5, 1, 1.5]) if draw[k, 11] < 0.5 else np.array([1, 2.5, 1.5])
    for period, begin in enumerate(np.arange(0, end, 0.2)):
        u = found["u"][k, period]
        thrust = u / loss if begin >= 40 * draw[k, 12] else u
        assert 4000 * (1 - 1e-6) <= np.linalg.norm(thrust) and np.linalg.norm(u) <= 24000 * (1 + 1e-6)
        flow = np.linalg.norm(thrust) / (210 * 9.81)
        rate = lambda t, y, T=thrust, q=flow: np.concatenate([y[3:6], T / y[6] + g, [-q]])  # noqa: E731
        span = begin, min(begin + 0.2, end)
        y = solve_ivp(rate, span, y, method="DOP853", rtol=1e-12, atol=1e-9).y[:, -1]
    assert np.linalg.norm(y[:3]) < 1e-4
    assert np.linalg.norm(y[3:6]) < 0.02
    assert start[6] - y[6] == pytest.approx(found["fuel_kg"][k], abs=1e-5)


def test_knowing_when_a_failure_strikes(mars):
    """The later, the less propellant; behind the touchdown it does not matter. A failure from the start costs most."""
    draw = np.repeat(rows(1, seed=3), 4, axis=0)
    draw[:, 10], draw[:, 12] = 0.0, [0.0, 0.3, 0.6, 1.0]
    by_moment = references(LANDING, draw, **RANDOM)["fuel_kg"]
    healthy = references(LANDING, draw[:1], failure_probability=0.0)["fuel_kg"][0]
    assert (np.diff(by_moment) < 0).all()
    assert by_moment[3] == pytest.approx(healthy, abs=1e-6)
    at_start = references(LANDING, draw[:1], failure_probability=1.0)["fuel_kg"][0]
    assert at_start == pytest.approx(by_moment[0], abs=1e-6)


def test_the_guess_does_not_matter(monkeypatch):
    drawn = draw_flights(MARS, rows(3, seed=5), MARS.failure._replace(probability=0.7, time="random"))
    found = []
    for share in (0.8, 1.3):
        monkeypatch.setattr(optimum, "DURATIONS", (share,))
        found.append([optimise_landing(MARS, drawn.one(k))["fuel_kg"] for k in range(3)])
    np.testing.assert_allclose(*found, atol=1e-3)


def test_references_are_remembered_and_cannot_be_written_to(mars):
    draw, found = mars
    again = references(LANDING, draw.copy(), **RANDOM, observe_draw=True)
    assert again["u"] is found["u"]
    with pytest.raises(ValueError, match="read-only"):
        found["fuel_kg"][0] = 0.0


def test_an_optimum_that_is_not_there_is_one_line():
    weak = replace(MARS, greatest_thrust=7000.0)  # 3.5 m/s^2
    with pytest.raises(NoOptimum, match="^landing: IPOPT stopped with [^\n]*$"):
        optimise_landing(weak, draw_flights(weak, rows(1), HEALTHY))
    brief = replace(MARS, longest=10.0)
    with pytest.raises(NoOptimum, match="^landing: it takes [^\n]* longer than a flight, 10 s$"):
        optimise_landing(brief, draw_flights(brief, rows(1), HEALTHY))


APOLLO = Lander(
    mass=15200.0, dry_mass=6800.0, isp=311.0, least_thrust=4500.0, greatest_thrust=45000.0, g0=9.80665,
    gravity=1.6249, longest=400.0, start=(-20500.0, 0.0, 6000.0, 250.0, 0.0, -50.0),
)  # fmt: skip


@pytest.mark.parametrize("x, speed, fuel", [(-20500.0, 250.0, 1743.9), (-30000.0, 300.0, 2032.8)])
def test_a_start_may_be_far_away(x, speed, fuel):
    """Solved elsewhere with bounds of 100 km and 5 km/s."""
    far = replace(APOLLO, start=(x, 0.0, 6000.0, speed, 0.0, -50.0))
    found = optimise_landing(far, draw_flights(far, np.full((1, len(DRAW)), 0.5), HEALTHY), 0)
    assert found["fuel_kg"] == pytest.approx(fuel, abs=0.05)


def test_a_start_in_orbit_is_refused_on_flat_ground():
    orbit = (-420e3, 0.0, 15e3, 1700.0, 0.0, 0.0)
    with pytest.raises(BadInput, match="^a lander's start is [^\n]* the ground is flat here"):
        replace(APOLLO, start=orbit)
    replace(APOLLO, start=orbit, radius=1e9)  # the Sun's size: it is flat there


def test_a_least_thrust_above_the_weight_is_named(monkeypatch):
    monkeypatch.setattr(optimum, "DURATIONS", (0.8,))
    strong = replace(MARS, least_thrust=23000.0, start=(0.0, 0.0, 2000.0, 0.0, 0.0, 0.0), dry_mass=1800.0)
    with pytest.raises(NoOptimum, match="least_thrust, 23000 N, too great: the weight is 7423 N at first"):
        optimise_landing(strong, draw_flights(strong, rows(1), HEALTHY), 0)


def test_a_solution_that_does_not_land_is_refused(monkeypatch):
    monkeypatch.setattr(optimum, "TOUCHDOWN", np.array([0.0, 0.0, -1e-7, 0.0, 0.0, -0.5]))
    with pytest.raises(NoOptimum, match="^landing: the replay of a solution of [^\n]* m from the pad with 0.5 m/s$"):
        optimise_landing(MARS, draw_flights(MARS, rows(1), HEALTHY))


def test_an_unknown_option_is_refused():
    with pytest.raises(BadInput, match="failure_moment"):
        references(LANDING, rows(1), failure_moment="random")
