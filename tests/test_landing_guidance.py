"""The landers' guidance: against printed rows, NumPy's roots, and what is hidden from it."""

import gymnasium as gym
import numpy as np
import pytest

from common.errors import NoOptimum
from envs import MARS, fly_lander
from landing import guidance
from landing.guidance import Estimate, Replanned, drdv_estimated, energy_optimal_acceleration
from landing.lander import DRAW
from landing.optimum import energy_optimal_time, references

pytestmark = pytest.mark.slow

LANDING = "MarsLanding-v0"
RANDOM = {"failure_time": "random"}


def rows(n, seed=0):
    """Draws (n, 13)."""
    return np.random.default_rng(seed).random((n, len(DRAW)))


def drawn(draw, **options):
    """The hidden numbers of draws, with the environment's defaults."""
    return gym.make_vec(LANDING, num_envs=1, **options).unwrapped._drawn(draw)


def soft(flown):
    """Which flights touch down within 5 m and 2 m/s."""
    return flown["down"] & (flown["position_error"] < 5) & (flown["speed"] < 2)


# --- DR/DV ------------------------------------------------------------------------------------------------------------


def test_the_time_to_go_is_a_root_of_the_polynomial():
    """Over seven decades of distance; some of these states have three roots."""
    rng = np.random.default_rng(1)
    distance = 10 ** rng.uniform(-3, 3.5, 500)
    r = rng.normal(size=(500, 3)) * distance[:, None]
    v = rng.normal(size=(500, 3)) * (np.sqrt(distance) * rng.uniform(0, 3, 500))[:, None]
    for t, r_k, v_k in zip(energy_optimal_time(r, v, 3.71), r, v):
        roots = np.roots([3.71**2 / 2, 0, -2 * v_k @ v_k, -12 * v_k @ r_k, -18 * r_k @ r_k])
        real = roots[np.abs(roots.imag) < 1e-6 * np.abs(roots)].real
        assert np.abs(real / t - 1).min() < 1e-9


def test_the_law_arrives_in_its_time():
    """Its acceleration, linear in time, integrated in closed form: a(t) = a + b t with r and v zero at the end."""
    rng = np.random.default_rng(2)
    r, v, T = rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), rng.uniform(1, 9, 5)
    a, t = energy_optimal_acceleration(r, v, T), T[:, None]
    slope = -2 / t**2 * (v + a * t)
    np.testing.assert_allclose(r + v * t + a * t**2 / 2 + slope * t**3 / 6, 0, atol=1e-12)


# --- the estimate -----------------------------------------------------------------------------------------------------


def excited(draw, seed, **options):
    """What the estimate is after 20 s of commands that change, and what is true then: effectiveness, gravity."""
    rng, estimate = np.random.default_rng(seed), Estimate(MARS, len(draw))

    def policy(obs, t):
        if t <= 100:
            estimate.update(obs)
        return np.array([0, 0, 0.5]) + 0.3 * rng.uniform(-1, 1, (len(obs), 3))

    flown = fly_lander(LANDING, policy, draw, **options)
    masses = MARS.mass / drawn(draw).mass  # effectiveness also holds what the mass is off by
    return estimate, flown["effectiveness"][:, 99] * masses[:, None], flown["gravity"]


@pytest.mark.parametrize("options", [{}, RANDOM], ids=["from the start", "at a random moment"])
def test_the_estimate_finds_what_is_hidden(options):
    draw = rows(50, seed=4)
    draw[:, 12] *= 0.45  # strikes within 18 s
    estimate, effectiveness, gravity = excited(draw, 5, **options)
    assert (effectiveness < 0.8).any() and (effectiveness > 0.95).any()
    np.testing.assert_allclose(estimate.effectiveness, effectiveness, atol=0.01)
    np.testing.assert_allclose(estimate.gravity, gravity, atol=0.05)


@pytest.mark.parametrize("options", [{}, RANDOM], ids=["from the start", "at a random moment"])
def test_with_the_estimate_every_flight_lands_softly(options):
    flown = fly_lander(LANDING, drdv_estimated(MARS), rows(300), **options)
    assert soft(flown).all()
    assert flown["position_error"].max() < 0.1
    assert flown["fuel_kg"].mean() == pytest.approx(248, abs=3)


def test_a_flight_depends_on_itself_alone():
    """Neither on the rest of its batch, nor on what the same law has flown before."""
    draw, law = rows(20, seed=6), drdv_estimated(MARS)
    together, alone = fly_lander(LANDING, law, draw), fly_lander(LANDING, law, draw[:3])
    np.testing.assert_allclose(alone["final_y"], together["final_y"][:3], rtol=1e-9, atol=1e-9)


# --- replanning -------------------------------------------------------------------------------------------------------


def test_replanned_flights_land_steeply_near_the_optimum():
    draw = rows(4, seed=1)
    law = Replanned(MARS)
    flown = fly_lander(LANDING, law, draw)
    assert flown["landed"].all()
    assert flown["position_error"].max() < 0.1 and flown["speed"].max() < 1.0
    fuel = references(LANDING, draw)["fuel_kg"].mean()
    assert 1.0 < flown["fuel_kg"].mean() / fuel < 1.03
    assert len(law.seconds) > 4 * len(draw)
    assert law.failed < 0.1 * len(law.seconds)


def test_wary_plans_survive_a_late_failure():
    draw = rows(4, seed=1)
    draw[:, 10], draw[:, 12] = 0.0, np.linspace(0.3, 0.7, 4)  # strikes at 12 to 28 s
    wary, bold = (fly_lander(LANDING, Replanned(MARS, is_wary), draw, **RANDOM) for is_wary in (True, False))
    assert wary["landed"].all() and not soft(bold).all()


def test_without_a_plan_drdv_flies(monkeypatch):
    def fail(*arguments, **options):
        raise NoOptimum("none")

    monkeypatch.setattr(guidance, "solve_from_guess", fail)
    draw, law = rows(5), Replanned(MARS)
    flown, other = fly_lander(LANDING, law, draw), fly_lander(LANDING, drdv_estimated(MARS), draw)
    np.testing.assert_array_equal(flown["final_y"], other["final_y"])
    assert law.failed == len(law.seconds) > 0
