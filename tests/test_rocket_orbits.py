"""rocket/orbits.py against CSPICE's conics and closed forms: elements, targets of every shape, terminal error."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import spiceypy
from rocket_oracle import MU, RE, rotation

from envs import ROCKET, launch_raan, orbital_elements, target_axes, target_orbit, terminal_error

# --- orbital elements -------------------------------------------------------------------------------------------------


def spice_state(a, e, i, raan, argp, mean_anomaly):
    return spiceypy.conics([a * (1 - e), e, i, raan, argp, mean_anomaly, 0.0, MU], 0.0)


def angle_between(a, b):
    return np.abs((np.asarray(a) - b + math.pi) % (2 * math.pi) - math.pi)


def assert_elements(state, expected, atol=1e-9):
    """Elements of a state against expected (a, e, i, raan, argp); any warning is an error."""
    with warnings.catch_warnings(), np.errstate(all="raise", under="ignore"):
        warnings.simplefilter("error")
        got = orbital_elements(state)
    assert np.isfinite(got).all()
    assert got.a == pytest.approx(expected[0], rel=atol)
    assert got.e == pytest.approx(expected[1], abs=atol) and got.i == pytest.approx(expected[2], abs=atol)
    assert angle_between(got.raan, expected[3]) < atol and angle_between(got.argp, expected[4]) < atol
    assert 0 <= got.i <= math.pi and 0 <= got.raan <= 2 * math.pi and 0 <= got.argp <= 2 * math.pi


def test_elements_of_random_ellipses_agree_with_spice():
    rng = np.random.default_rng(0)
    a, e, i = rng.uniform(6.6e6, 5e7, 300), rng.uniform(0.01, 0.95, 300), rng.uniform(0.02, math.pi - 0.02, 300)
    drawn = np.column_stack([a, e, i, rng.uniform(0, 2 * math.pi, (300, 3))])
    states = np.array([spice_state(*row) for row in drawn])
    for state, row in zip(states, drawn):
        rp, ecc, inc, node, argp, *_ = spiceypy.oscelt(state, 0.0, MU)
        assert_elements(state, (rp / (1 - ecc), ecc, inc, node, argp))
        assert_elements(state, row[:5])
    batch = orbital_elements(states.reshape(20, 15, 6))
    assert batch.a.shape == (20, 15)
    np.testing.assert_array_equal(np.array(batch).reshape(5, -1), np.array([orbital_elements(s) for s in states]).T)
    np.testing.assert_array_equal(orbital_elements(np.column_stack([states, states[:, 0]])), orbital_elements(states))


def test_elements_of_hyperbolas_agree_with_spice():
    rng = np.random.default_rng(1)
    for _ in range(100):
        rp, e, i = rng.uniform(6.6e6, 2e7), rng.uniform(1.05, 4), rng.uniform(0.02, math.pi - 0.02)
        node, argp, mean_anomaly = rng.uniform(0, 2 * math.pi, 2).tolist() + [rng.uniform(-2, 2)]
        state = spiceypy.conics([rp, e, i, node, argp, mean_anomaly, 0.0, MU], 0.0)
        oracle = spiceypy.oscelt(state, 0.0, MU)
        assert_elements(state, (oracle[0] / (1 - oracle[1]), *oracle[1:5]), atol=2e-9)
        assert oracle[0] / (1 - oracle[1]) < 0


@pytest.mark.parametrize("inclination", [0.0, math.pi])
def test_elements_of_equatorial_ellipses(inclination):
    """The node is 0 and the perigee is counted from the x axis in the direction of flight, as CSPICE does."""
    sense = 1 if inclination == 0 else -1
    for longitude in np.linspace(0, 6.2, 12):
        for anomaly in (0.0, 0.7, 3.0, 5.0):
            p, e = 1.1e7, 0.3
            r, v, c, s = p / (1 + e * math.cos(anomaly)), math.sqrt(MU / p), math.cos(anomaly), math.sin(anomaly)
            turn = rotation("z", sense * longitude)[:2, :2] * [1, sense]
            state = np.zeros(6)
            state[:2], state[3:5] = turn @ [r * c, r * s], turn @ [-v * s, v * (e + c)]
            assert_elements(state, (p / (1 - e * e), e, inclination, 0.0, longitude))
            assert orbital_elements(state).raan == 0
            oracle = spiceypy.oscelt(state, 0.0, MU)
            assert oracle[2] == pytest.approx(inclination)
            assert angle_between(oracle[3] + sense * oracle[4], sense * longitude) < 1e-9


def test_elements_of_circles():
    rng = np.random.default_rng(2)
    for _ in range(100):
        r, i, node, place = rng.uniform(6.6e6, 4e7), rng.uniform(0.1, 3), *rng.uniform(0, 2 * math.pi, 2)
        turn = rotation("z", node) @ rotation("x", i) @ rotation("z", place)
        state = np.concatenate([turn @ [r, 0, 0], turn @ [0, math.sqrt(MU / r), 0]])
        assert_elements(state, (r, 0.0, i, node, 0.0))
        oracle = spiceypy.oscelt(state, 0.0, MU)
        assert oracle[2] == pytest.approx(i) and angle_between(oracle[3], node) < 1e-9
    for sense, i in ((1, 0.0), (-1, math.pi)):
        for x, y in ((7e6, 0), (0, 7e6), (-7e6, 0), (0, -7e6), (4.2e6, 5.6e6)):
            v = sense * math.sqrt(MU / 7e6) / 7e6
            state = [x, y, 0, -v * y, v * x, 0]
            assert_elements(state, (7e6, 0.0, i, 0.0, 0.0))
            elements = orbital_elements(state)
            assert elements.raan == elements.argp == 0


def test_elements_of_parabolic_and_rectilinear_states_are_defined():
    with warnings.catch_warnings(), np.errstate(all="raise", under="ignore"):
        warnings.simplefilter("error")
        parabola = orbital_elements([2.0, 0, 0, 0, 0.6, 0.8], mu=1.0)  # |v|^2 / 2 = mu / r exactly
        lines = orbital_elements([[0.0, 0, 7e6, 0, 0, 1000.0], [3e6, 4e6, 5e6, 0, 0, 0], [7e6, 0, 0, -2e4, 0, 0],
                                  [3e6, -4e6, 5e6, 30, -40, 50]])  # fmt: skip
    assert parabola.a == math.inf and parabola.e == pytest.approx(1, abs=1e-15)
    assert parabola.i == pytest.approx(math.atan2(0.8, 0.6)) and angle_between(parabola.raan, 0) < 1e-12
    assert angle_between(parabola.argp, 0) < 1e-12, "the state is at the perigee, on the node"
    assert np.isfinite(lines).all()
    np.testing.assert_allclose(lines.e, 1, atol=1e-12)
    speeds = [(7e6, 1e3), (math.sqrt(50) * 1e6, 0), (7e6, 2e4), (math.sqrt(50) * 1e6, math.sqrt(5000))]
    np.testing.assert_allclose(lines.a, [-MU / 2 / (v**2 / 2 - MU / r) for r, v in speeds], rtol=1e-12)


def test_target_orbit_is_the_benchmarks():
    h, e = target_orbit()
    np.testing.assert_allclose(h / math.sqrt(MU * RE), (-0.6365358, 0.0022219, 1.1723603), rtol=0, atol=6e-8)
    np.testing.assert_allclose(e, (0.4900165, 0.4729090, 0.2651594), rtol=0, atol=6e-8)


# --- targets of every shape -------------------------------------------------------------------------------------------

SHAPES = [(e, i) for e in (0.0, 0.1, 0.7) for i in (0.0, 28.6, 51.6, 90.0, 98.0, 151.0, 180.0)]


def rocket_to(**target):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # i = 0 is a dog-leg, and these do not fly
        return replace(ROCKET, **target)


@pytest.mark.parametrize("e, i", SHAPES)
def test_targets_of_every_shape_agree_with_spice(e, i):
    """Circular, equatorial, polar, retrograde: axes, vectors and error of CSPICE's states on the orbit, and off it."""
    rocket = rocket_to(a=24e6, e=e, i=i, raan=200.0, argp=70.0)
    goal = (24e6, e, *map(math.radians, (i, 200.0, 70.0)))
    states = np.array([spice_state(*goal, anomaly) for anomaly in np.linspace(0, 6, 7)])
    h_spice = np.cross(states[:, :3], states[:, 3:])
    h, ecc = target_orbit(rocket.target, rocket.mu)
    np.testing.assert_allclose(h_spice, np.broadcast_to(h, h_spice.shape), rtol=0, atol=1e-10 * np.linalg.norm(h))
    perigee = states[0, :3] / np.linalg.norm(states[0, :3])  # of a circle: where its angles are counted from
    np.testing.assert_allclose(ecc, e * perigee, rtol=0, atol=1e-13)
    assert np.abs(terminal_error(states, rocket)).max() < 1e-12
    axes = target_axes(rocket)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(axes) == pytest.approx(1)
    np.testing.assert_allclose(axes[0], perigee, rtol=0, atol=1e-12)
    assert states[0, 3:] @ axes[1] > 0, "in the direction of flight"
    np.testing.assert_allclose(axes[2], h_spice[0] / np.linalg.norm(h_spice[0]), rtol=0, atol=1e-12)
    # elsewhere: the error's length is that of the vectors' differences, by CSPICE's states
    other = spice_state(7.3e6, e + 0.01, math.radians(min(i + 0.5, 180)), goal[3] + 0.01, goal[4], 0.3)
    h_other = np.cross(other[:3], other[3:])
    e_other = np.cross(other[3:], h_other) / MU - other[:3] / np.linalg.norm(other[:3])
    expected = [*(h_other - h_spice[0]) / np.linalg.norm(h_spice[0]), *(e_other - e * perigee)]
    np.testing.assert_allclose(terminal_error(other, rocket), expected, rtol=0, atol=1e-11)
    assert np.linalg.norm(expected) > 0.01


@pytest.mark.parametrize("latitude", [0.0, 5.2, 28.5, 51.0, -34.0])
@pytest.mark.parametrize("i", [51.6, 90.0, 98.0, 128.4])
def test_launch_raan_holds_the_launch_site(latitude, i):
    """The plane's normal is a right angle from the launch site, which is passed on the way north."""
    raan = launch_raan(latitude, i)
    assert 0 <= raan <= 360
    site = np.array([math.cos(math.radians(latitude)), 0.0, math.sin(math.radians(latitude))])
    normal = rotation("z", math.radians(raan)) @ rotation("x", math.radians(i)) @ [0, 0, 1]
    assert abs(normal @ site) < 1e-15
    assert np.cross(normal, site)[2] > 0.01 or abs(latitude) == 51.0 and np.cross(normal, site)[2] > 0


def test_launch_raan_where_no_plane_holds_the_site():
    """Nearest is the plane that turns back at the site's longitude; from the equator every node will do."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert launch_raan(28.5, 20.0) == launch_raan(28.5, 0.0) == 270
        assert launch_raan(28.5, 160.0) == 90 and launch_raan(-28.5, 20.0) == 90
        assert launch_raan(0.0, 0.0) == 0 and launch_raan(0.0, 180.0) == 0
