"""The rocket of rocket.py and envs.py against the paper's equations (typed once more here) with SciPy's integrator,
against CSPICE's conics, closed forms, and itself: single against batched, ECI against local action frame.
"""

import math
import warnings
from dataclasses import replace
from functools import cache

import gymnasium as gym
import numpy as np
import pytest
import spiceypy
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from scipy.integrate import solve_ivp

from envs import (
    REFERENCE_PITCH,
    ROCKET,
    OrbitalElements,
    RocketVectorEnv,
    ascent,
    fly_rocket,
    guidance_reward,
    local_frame,
    orbital_elements,
    orbital_reward,
    penalties,
    precision_points,
    rk4,
    target_axes,
    target_orbit,
    terminal_error,
    terminal_reward,
    trajectory_reward,
)

FIXED, CUTOFF = IDS = ["RocketAscent-v0", "RocketAscentCutoff-v0"]
PARTS = ["R_orbital", "R_trajectory", "R_guidance", "R_penalties", "R_terminal"]
KEYS = {
    *PARTS, "error", "error_norm", "a_km", "e", "i_deg", "raan_deg", "argp_deg", "final_mass_kg", "final_time_s",
    "max_altitude_km", "episodic_return", "points", "crashed",
}  # fmt: skip

# --- the paper's problem with the benchmark's constants, typed once more ----------------------------------------------

MU, RE, OMEGA, SEA_LEVEL_G = 3.986012e14, 6378145.0, 7.29211585e-5, 9.80665
LATITUDE = math.radians(28.5)
START = [RE * math.cos(LATITUDE), 0.0, RE * math.sin(LATITUDE), 0.0, OMEGA * RE * math.cos(LATITUDE), 0.0, 301454.0]
GOAL = (24361140.0, 0.7308, math.radians(28.5), math.radians(269.8), math.radians(130.5))  # a, e, i, RAAN, argp
GOAL_ENERGY = -MU / (2 * GOAL[0])


def stretches(table_isp):
    """Rows of start, end, thrust, flow and mass dropped at the end; with the table's Isp stage 2 runs dry early."""
    if table_isp:
        solid, first, second = (
            T / (SEA_LEVEL_G * isp) for T, isp in ((628500, 284.0), (1083100, 301.7), (110094, 462.4))
        )
    else:
        solid, first, second = 17010 / 75.2, 95550 / 261, 16820 / 700
    dry = 261 + 16820 / second
    return [
        (0.0, 75.2, 6 * 628500 + 1083100, 6 * solid + first, 6 * (19290 - 17010)),
        (75.2, 150.4, 3 * 628500 + 1083100, 3 * solid + first, 3 * (19290 - 17010)),
        (150.4, 261.0, 1083100, first, 104380 - 95550),
        (261.0, min(dry, 961.0), 110094, second, 0),
        *([(dry, 961.0, 0.0, 0.0, 0)] if table_isp else []),
    ]


def derivative(t, s, u, thrust, flow):
    x, y, z, vx, vy, vz, m = s
    r = math.sqrt(x * x + y * y + z * z)
    wx, wy, wz = vx + OMEGA * y, vy - OMEGA * x, vz  # v - omega x r
    drag = 0.5 * 1.225 * math.exp(-(r - RE) / 7200.0) * 0.5 * 4 * math.pi * math.sqrt(wx * wx + wy * wy + wz * wz)
    g = MU / r**3
    return [
        vx, vy, vz,
        -g * x + (thrust * u[0] - drag * wx) / m,
        -g * y + (thrust * u[1] - drag * wy) / m,
        -g * z + (thrust * u[2] - drag * wz) / m,
        -flow,
    ]  # fmt: skip


def energy(s):
    return (s[3] ** 2 + s[4] ** 2 + s[5] ** 2) / 2 - MU / math.sqrt(s[0] ** 2 + s[1] ** 2 + s[2] ** 2)


def at_goal_energy(t, s, u, thrust, flow):
    return (energy(s) - GOAL_ENERGY) / 1e6


ATOL = [1e-5] * 3 + [1e-8] * 3 + [1e-8]


def integrate(s, begin, end, u, table_isp=False, events=None):
    """State at `end`, by DOP853 between the events of the vehicle; with `events` (time, state) at the first of them."""
    for start, stop, thrust, flow, dropped in stretches(table_isp):
        a, b = max(begin, start), min(end, stop)
        if a < b:
            options = {"rtol": 1e-11, "atol": ATOL, "first_step": b - a, "args": (u, thrust, flow), "events": events}
            solution = solve_ivp(derivative, (a, b), s, "DOP853", **options)
            if events and len(solution.t_events[0]):
                return solution.t_events[0][0], solution.y_events[0][0]
            s = solution.y[:, -1].copy()
            s[6] -= dropped if stop <= end else 0
    return s


def rotation(axis, angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array({"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}[axis])


# columns: perigee, a right angle ahead of it, normal
PLANE = rotation("z", GOAL[3]) @ rotation("x", GOAL[2]) @ rotation("z", GOAL[4])
GOAL_H = math.sqrt(MU * GOAL[0] * (1 - GOAL[1] ** 2))


def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def unit(a):
    length = math.hypot(*a)
    return [component / length for component in a]


def up_along_cross(s):
    up = unit([float(component) for component in s[:3]])
    along = unit(cross(PLANE[:, 2].tolist(), up))
    return np.array([up, along, cross(up, along)])


@cache
def programme(t):
    """A sensible ascent: direction by (up, along, across) at time t, pitching over, with some yaw to and fro."""
    times = [0, 10, 40, 75, 150, 261, 400, 600, 800, 961]
    pitch = math.radians(np.interp(t, times, [90, 88, 72, 42, 24, 11, 8, 1, 0, 5]))
    yaw = math.radians(3) * math.sin(t / 80)
    return np.array([math.sin(pitch), math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw)])


GRID = np.append(np.arange(0.0, 961.0, 2.0), 961.0)


@cache
def reference(table_isp):
    """The programme flown by SciPy: directions u (481, 3), states y (482, 7), and (time, state) of the cut-off."""
    u, y, cut = [], [np.array(START)], None
    for begin, end in zip(GRID[:-1], GRID[1:]):
        u.append(programme(begin) @ up_along_cross(y[-1]))
        y.append(integrate(y[-1], begin, end, u[-1], table_isp))
        if cut is None and energy(y[-1]) >= GOAL_ENERGY:
            cut = integrate(y[-2], begin, end, u[-1], table_isp, at_goal_energy)
    return np.array(u), np.array(y), cut


def assert_states_agree(got, expected, relative=1e-6):
    """Position, velocity and mass, each by the length of the difference."""
    for part in (slice(0, 3), slice(3, 6), slice(6, 7)):
        miss = np.linalg.norm(got[..., part] - expected[..., part], axis=-1)
        np.testing.assert_array_less(miss, relative * np.linalg.norm(expected[..., part], axis=-1))


def fly(envs, policy):
    """One episode of a batch of one through its public interface: observations (K+1, 9), rewards (K,), final info."""
    obs, info = envs.reset()
    seen, rewards = [obs[0]], []
    while "final_obs" not in info:
        obs, reward, terminated, truncated, info = envs.step(np.asarray(policy(seen[-1], len(rewards)))[None])
        assert not truncated.any() and terminated[0] == ("final_obs" in info)
        seen.append(info["final_obs"][0] if terminated[0] else obs[0])
        rewards.append(reward[0])
    return np.array(seen), np.array(rewards), {k: v[0] for k, v in info["final_info"].items() if k[0] != "_"}


def make(env_id, num_envs=1, rocket=None, **options):
    return gym.make_vec(env_id, num_envs=num_envs, **options, **({"rocket": rocket} if rocket else {}))


def single(env_id, **options):
    return gym.make(env_id, disable_env_checker=True, **options)  # it would take half of the time


# --- dynamics ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("table_isp", [False, True])
def test_whole_flight_agrees_with_scipy(table_isp):
    u, y, cut = reference(table_isp)
    seen, rewards, final = fly(make(FIXED, table_isp=table_isp), lambda obs, t: u[t])
    assert len(rewards) == 481 and final["final_time_s"] == 961.0 and not final["crashed"]
    assert_states_agree(seen[:, :7], y)
    assert cut[0] < 950, "the fixed-time flight goes on where the other is cut"
    np.testing.assert_allclose(seen[:, 6], y[:, 6], rtol=0, atol=1e-6)
    altitude = np.linalg.norm(y[:, :3], axis=1) - RE
    assert altitude.min() > -1e-6 and altitude[150:].min() > 90e3, "the flight to compare should be an ascent"
    assert final["max_altitude_km"] == pytest.approx(altitude.max() / 1e3, rel=1e-6)
    assert final["final_mass_kg"] == seen[-1, 6]


@pytest.mark.parametrize("table_isp", [False, True])
def test_cutoff_agrees_with_scipy(table_isp):
    u, y, (cut_time, cut_state) = reference(table_isp)
    seen, rewards, final = fly(make(CUTOFF, table_isp=table_isp), lambda obs, t: u[t])
    last = len(rewards) - 1
    assert 2 * last < final["final_time_s"] <= 2 * last + 2
    assert final["final_time_s"] == pytest.approx(cut_time, rel=1e-6)
    assert_states_agree(seen[-1, :7], cut_state)
    np.testing.assert_array_equal(seen[-2, :7], fly(make(FIXED, table_isp=table_isp), lambda o, t: u[t])[0][last, :7])
    assert energy(seen[-1]) == pytest.approx(GOAL_ENERGY, rel=1e-10)
    assert abs(final["a_km"] * 1e3 - GOAL[0]) < 1.0
    # the state is the one that a step of just this length leads to
    last_step = integrate(seen[-2, :7], 2.0 * last, final["final_time_s"], u[last], table_isp)
    assert_states_agree(seen[-1, :7], last_step, 1e-9)


def test_start():
    obs, info = make(FIXED, 2).reset()
    np.testing.assert_allclose(obs, [START + [1.0, 0.0]] * 2, rtol=1e-15)
    np.testing.assert_allclose(obs[0, :5], [5605222.973, 0, 3043387.761, 0, 408.74], rtol=1e-5)
    assert info == {} and np.linalg.norm(obs[0, :3]) == pytest.approx(RE, rel=1e-15)


def test_mass_history_to_the_gram():
    u = reference(False)[0]
    m = dict(zip(GRID, fly(make(FIXED), lambda obs, t: u[t])[0][:, 6]))
    for event, before, dropped in ((75.2, 171863.885, 13680), (150.4, 79623.770, 6840), (261.0, 32294.000, 8830)):
        left, right = math.floor(event / 2) * 2.0, math.floor(event / 2) * 2.0 + 2
        flow_before, flow_after = (m[left - 2] - m[left]) / 2, (m[right] - m[right + 2]) / 2
        at_event = m[left] - flow_before * (event - left)
        assert at_event == pytest.approx(before, abs=1e-3)
        assert m[right] + flow_after * (right - event) == pytest.approx(at_event - dropped, abs=1e-6)
    assert m[0.0] == 301454
    assert m[262.0] == pytest.approx(23464 - 16820 / 700, abs=1e-6)
    assert flow_after == pytest.approx(24.02857, abs=1e-5)
    assert m[960.0] == pytest.approx(6668.02857, abs=1e-4) and m[961.0] == pytest.approx(6644, abs=1e-6)


def test_table_isp_runs_dry_and_keeps_the_residual():
    u = reference(True)[0]
    m = dict(zip(GRID, fly(make(FIXED, table_isp=True), lambda obs, t: u[t])[0][:, 6]))
    flow = (m[950.0] - m[952.0]) / 2
    assert flow == pytest.approx(110094 / (9.80665 * 462.4), rel=1e-9)
    assert 952 + (m[952.0] - m[954.0]) / flow == pytest.approx(953.79, abs=5e-3)
    assert m[954.0] == m[956.0] == m[960.0] == m[961.0]
    solids, first = 17010 - 75.2 * 628500 / (9.80665 * 284), 95550 - 261 * 1083100 / (9.80665 * 301.7)
    assert m[961.0] == pytest.approx(4164 + 19300 - 16820 + 9 * solids + first, abs=1e-6)


def dry_vehicle(**changes):
    """The rocket without drag; engines burn as they do, but `thrust=0` takes their thrust away."""
    thrust = changes.pop("thrust", 1)
    burns = [
        replace(burn, engines=tuple((n, replace(e, thrust=thrust * e.thrust)) for n, e in burn.engines))
        for burn in ROCKET.burns
    ]
    return replace(ROCKET, burns=tuple(burns) if thrust != 1 else ROCKET.burns, Cd=0.0, **changes)


def on_goal_orbit(anomaly):
    """State on the target orbit at a true anomaly, by the orbit's equation in its own plane."""
    p, c, s = GOAL[0] * (1 - GOAL[1] ** 2), math.cos(anomaly), math.sin(anomaly)
    r = p / (1 + GOAL[1] * c)
    v = math.sqrt(MU / p)
    return np.concatenate([PLANE @ [r * c, r * s, 0], PLANE @ [-v * s, v * (GOAL[1] + c), 0]])


def test_coast_conserves_energy_and_angular_momentum():
    envs = make(FIXED, 3, rocket=dry_vehicle(thrust=0, omega_e=0.0))
    envs.reset()
    envs.unwrapped.y[:6] = np.array([on_goal_orbit(anomaly) for anomaly in (-1.0, 0.1, 2.0)]).T
    states = [envs.step(np.eye(3))[0][:, :7] for _ in range(480)]
    E = np.array([[energy(s) for s in row] for row in states])
    h = np.cross(np.array(states)[..., :3], np.array(states)[..., 3:6])
    np.testing.assert_allclose(E, GOAL_ENERGY, rtol=1e-11)
    np.testing.assert_allclose(h, np.broadcast_to(GOAL_H * PLANE[:, 2], h.shape), rtol=0, atol=1e-11 * GOAL_H)
    # the same by the integrator alone, along a quarter of the orbit and back
    s = (*on_goal_orbit(0.0), 1000.0)
    for dt in [4.0] * 1000 + [-4.0] * 1000:
        s = rk4(lambda x, u: ascent(x, u, dry_vehicle()), s, (1.0, 0.0, 0.0, 0.0, 0.0), dt)
        assert energy(s) == pytest.approx(GOAL_ENERGY, rel=1e-9)
    np.testing.assert_allclose(s[:3], on_goal_orbit(0.0)[:3], atol=1.0)


def test_in_plane_steering_keeps_the_plane():
    envs = make(FIXED, 2, rocket=dry_vehicle(omega_e=0.0), action_frame="local")
    envs.reset()
    envs.unwrapped.y[:6] = np.array([on_goal_orbit(1.0), on_goal_orbit(2.0)]).T
    for pitch in np.linspace(-1.5, 2.0, 480):
        up, along = math.sin(pitch), math.cos(pitch)
        obs, _, terminated, *_ = envs.step([[up, along, 0.0], [-up, 2 * along, 0.0]])
        assert not terminated.any()
        h = np.cross(obs[:, :3], obs[:, 3:6])
        direction = h / np.linalg.norm(h, axis=1, keepdims=True)
        np.testing.assert_allclose(direction, [PLANE[:, 2]] * 2, rtol=0, atol=1e-12)
    assert (np.abs(np.linalg.norm(h, axis=1) / GOAL_H - 1) > 0.1).all(), "the thrust should have acted"


@pytest.mark.parametrize("side", ["east", "up", "north"])
def test_air_turns_with_the_earth(side):
    """At rest in the inertial frame the wind blows eastwards; at rest on the turning ground there is none."""
    still, ground = [*START[:3], 0.0, 0.0, 0.0, 1e5], START[:6] + [1e5]
    v = {"east": (0, 100, 0), "up": (80, 0, 60), "north": (-60, 0, 80)}[side]
    moving = [*START[:3], *(a + b for a, b in zip(START[3:6], v)), 1e5]
    off = (1.0, 0.0, 0.0, 0.0, 0.0)
    gravity = -MU / RE**3 * np.array(START[:3])
    drag = [np.array(ascent(s, off)[3:6]) - gravity for s in (still, ground, moving)]
    pressure = 0.5 * 1.225 * 0.5 * 4 * math.pi / 1e5
    np.testing.assert_allclose(drag[0], [0, pressure * START[4] ** 2, 0], rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(drag[1], 0, atol=1e-13)
    np.testing.assert_allclose(drag[2], [-pressure * 100 * c for c in v], rtol=1e-9, atol=1e-13)


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
    for anomaly in (0.0, 1.0, 2.5, 6.0):
        state = spice_state(*GOAL, anomaly)
        np.testing.assert_allclose(np.cross(state[:3], state[3:]), h, rtol=1e-11, atol=1e-11 * GOAL_H)
        of_state = np.cross(state[3:], np.cross(state[:3], state[3:])) / MU - state[:3] / np.linalg.norm(state[:3])
        np.testing.assert_allclose(of_state, e, rtol=0, atol=1e-12)
    np.testing.assert_allclose(target_axes(), PLANE.T, rtol=0, atol=1e-15)


def test_target_orbit_and_orbital_elements_are_inverse():
    rng = np.random.default_rng(3)
    elements = OrbitalElements(
        rng.uniform(7e6, 4e7, 200), rng.uniform(0.01, 0.9, 200), rng.uniform(0.05, 3, 200),
        rng.uniform(0, 6.28, 200), rng.uniform(0, 6.28, 200),
    )  # fmt: skip
    h, e = target_orbit(elements)
    states = np.array([spice_state(*row, anomaly) for *row, anomaly in zip(*elements, rng.uniform(0, 6, 200))])
    np.testing.assert_allclose(h, np.cross(states[:, :3], states[:, 3:]), rtol=0, atol=1e-11 * np.abs(h).max())
    back = orbital_elements(states)
    again = target_orbit(back)
    np.testing.assert_allclose(np.array(back), np.array(elements), rtol=1e-8)
    np.testing.assert_allclose(again[0], h, rtol=0, atol=1e-11 * np.abs(h).max())
    np.testing.assert_allclose(again[1], e, rtol=0, atol=1e-11)


def test_terminal_error_is_zero_on_the_target_orbit_only():
    anomalies = np.linspace(0, 6, 13)
    for anomaly in anomalies:
        assert np.abs(terminal_error(on_goal_orbit(anomaly))).max() < 1e-12
        assert np.abs(terminal_error(spice_state(*GOAL, anomaly))).max() < 1e-12
        for changed in range(5):
            for sign in (-1, 1):
                elements = list(GOAL)
                elements[changed] += sign * (1e-5 * GOAL[0] if changed == 0 else 1e-5)
                error = terminal_error(spice_state(*elements, anomaly))
                assert error.shape == (6,) and 1e-6 < np.linalg.norm(error) < 1e-4
    # the formula, at a state far away, in a batch, with a mass that does not count
    s = np.array([7e6, 1e6, -2e6, 1e3, 6e3, 3e3, 5e3])
    h = np.cross(s[:3], s[3:6])
    e = np.cross(s[3:6], h) / MU - s[:3] / math.sqrt(54e12)
    expected = [*(h / GOAL_H - PLANE[:, 2]), *(e - 0.7308 * PLANE[:, 0])]
    np.testing.assert_allclose(terminal_error(np.array([[s, s]])), [[expected] * 2], rtol=1e-12, atol=1e-14)


def test_terminal_error_is_smooth_at_its_zero():
    state = on_goal_orbit(0.5)
    for component in range(6):
        step = np.zeros(6)
        step[component] = 1e-7 * np.linalg.norm(state[:3] if component < 3 else state[3:])
        ahead, behind = terminal_error(state + step), -terminal_error(state - step)
        assert np.linalg.norm(ahead) > 1e-9
        np.testing.assert_allclose(ahead, behind, rtol=0, atol=1e-6 * np.linalg.norm(ahead) + 1e-15)


# --- steering ---------------------------------------------------------------------------------------------------------


def test_local_frame():
    rng = np.random.default_rng(4)
    states = rng.normal(size=(7, 50)) * 7e6
    frames = np.moveaxis(local_frame(states, PLANE[:, 2]), 2, 0)
    for s, frame in zip(states.T, frames):
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(frame) == pytest.approx(1)
        np.testing.assert_allclose(frame, up_along_cross(s), atol=1e-13)
    flight = np.array([on_goal_orbit(anomaly) for anomaly in np.linspace(0, 6, 9)])
    frames = local_frame(np.column_stack([flight, flight[:, 0]]).T, PLANE[:, 2])
    assert ((frames[1] * flight[:, 3:].T).sum(axis=0) > 0).all(), "along-track is the direction of flight"
    np.testing.assert_allclose(frames[2], np.repeat(PLANE[:, 2:], 9, axis=1), atol=1e-14)


@pytest.mark.parametrize("env_id", [CUTOFF])
def test_local_actions_are_eci_actions_rotated_at_the_steps_start(env_id):
    rng = np.random.default_rng(5)
    eci, local = make(env_id), make(env_id, action_frame="local")
    wobble = rng.normal(scale=0.05, size=(481, 3))
    steer = lambda obs, t: rng.uniform(0.1, 10) * (programme(2 * t) + wobble[t])  # noqa: E731
    got, got_rewards, got_final = fly(local, steer)
    expected, rewards, final = fly(eci, lambda obs, t: (programme(2 * t) + wobble[t]) @ up_along_cross(obs))
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(got_rewards, rewards, rtol=1e-9, atol=1e-10)
    # and one step, from the same states, to rounding
    states = expected[20:480:20, :7]
    eci, local = make(env_id, len(states)), make(env_id, len(states), action_frame="local")
    u = rng.normal(size=(len(states), 3))
    for envs in (eci, local):
        envs.reset()
        envs.unwrapped.y[:] = states.T
        envs.unwrapped.t[:] = np.arange(20, 480, 20)
    turned = eci.unwrapped.advance([a @ up_along_cross(s) for a, s in zip(u, states)])[0]
    scale = np.array([1e7] * 3 + [1e4] * 3 + [1e5, 1, 1])
    np.testing.assert_allclose(local.unwrapped.advance(u)[0] / scale, turned / scale, rtol=0, atol=2e-15)


@pytest.mark.parametrize("env_id, end_time", [(CUTOFF, None), (CUTOFF, 301.5), (FIXED, 262.0)])
def test_fly_rocket_records_the_flight(env_id, end_time):
    envs = make(env_id, action_frame="local")
    envs.unwrapped.end_time = end_time or 961.0
    seen, rewards, final = fly(envs, lambda obs, t: 3 * programme(2 * t))
    flight = fly_rocket(env_id, lambda obs, t: 3 * programme(2 * t)[None], end_time, action_frame="local")
    np.testing.assert_array_equal(flight["y"], seen[:, :7])
    np.testing.assert_array_equal(flight["reward"], rewards)
    np.testing.assert_array_equal(flight["t"][:-1], GRID[: len(rewards)])
    assert flight["t"][-1] == final["final_time_s"] and set(flight) == KEYS | {"t", "u", "y", "reward"}
    assert end_time is None or final["final_time_s"] == end_time
    expected = [programme(2 * t) @ up_along_cross(s) for t, s in enumerate(seen[:-1])]
    np.testing.assert_allclose(flight["u"], expected, rtol=0, atol=1e-14)
    again = fly_rocket(env_id, lambda obs, t: flight["u"][t][None], end_time)
    np.testing.assert_allclose(again["y"], flight["y"], rtol=1e-12, atol=1e-9)


# --- observations -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", IDS)
def test_observation(env_id):
    u = reference(False)[0]
    seen, rewards, final = fly(make(env_id), lambda obs, t: u[t])
    hidden, hidden_rewards, _ = fly(make(env_id, observe_phase=False), lambda obs, t: u[t])
    phase = np.select([GRID < 75.2, GRID < 150.4, GRID < 261], [0, 1 / 3, 2 / 3], 1.0)
    np.testing.assert_allclose(seen[:-1, 7], 1 - GRID[: len(rewards)] / 961, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(seen[:, 8], phase[: len(seen)])
    assert seen[0, 7] == 1 and seen.shape[1] == 9
    assert (seen[-1, 7] == 0) == (env_id == FIXED) and seen[-1, 7] < seen[-2, 7]
    assert not hidden[:, 7:].any()
    np.testing.assert_array_equal(hidden[:, :7], seen[:, :7])
    np.testing.assert_array_equal(hidden_rewards, rewards)


def hostile(obs, t):
    """Directions (12, 3) by (up, along, across): what drives a rocket high, fast, down, or anywhere."""
    forward = {n: up_along_cross(obs[n]) @ unit(obs[n, 3:6]) for n in (5, 10)}
    rng = np.random.default_rng(t)
    safe, late = programme(2 * t), 2 * t > 400
    return np.array([
        [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [-1, 0, 0], forward[5], rng.normal(size=3) + [1, 0, 0],
        rng.normal(size=3), [-1, 0, 0] if 2 * t > 200 else [1, 0, 0], [-1, 0, 0] if late else safe,
        -forward[10] if late else safe, [-1, 0.3, 0] if 2 * t > 800 else safe,
    ])  # fmt: skip


@pytest.mark.parametrize("env_id, table_isp", [(FIXED, False), (CUTOFF, True)])
def test_every_observation_lies_in_the_space(env_id, table_isp):
    envs = make(env_id, 12, action_frame="local", table_isp=table_isp)
    space, crashes = envs.single_observation_space, np.zeros(12, dtype=int)
    assert np.isfinite(space.low).all() and np.isfinite(space.high).all() and space.dtype == np.float64
    obs, _ = envs.reset()
    with np.errstate(invalid="raise", over="raise", divide="raise"):
        for t in range(490):
            assert envs.observation_space.contains(obs)
            obs, rewards, terminated, _, info = envs.step(hostile(obs, t))
            assert np.isfinite(rewards).all()
            if terminated.any():
                assert np.isin(info["final_obs"][:, 8], [0, 1 / 3, 2 / 3, 1]).all()
                assert envs.observation_space.contains(info["final_obs"])
                assert all(np.isfinite(v).all() for v in info["final_info"].values())
                crashed = info["final_info"]["crashed"] & terminated
                altitude = np.linalg.norm(info["final_obs"][:, :3], axis=1) - RE
                np.testing.assert_array_equal(crashed, terminated & (altitude < 0))
                crashes += crashed
    assert crashes[[1, 2, 3, 4, 7, 8, 9]].all() and not crashes[0]


@pytest.mark.parametrize("angle", [-10, -30, -60])
def test_plunge_at_orbital_speed_agrees_with_scipy(angle):
    up, along, _ = up_along_cross(START)
    path = math.cos(math.radians(angle)) * along + math.sin(math.radians(angle)) * up
    state = np.array([*(RE + 70e3) * up, *7800 * path, 12000.0])
    envs, step = make(FIXED), 300
    envs.reset()
    envs.unwrapped.y[:, 0] = state
    envs.unwrapped.t[:] = step
    slowest, terminated = 7800.0, [False]
    while not terminated[0]:
        obs, _, terminated, _, info = envs.step([-up])
        expected = integrate(state, 2.0 * step, 2.0 * step + 2, -up)
        if not terminated[0]:
            slowest = min(slowest, np.linalg.norm(obs[0, 3:6]))
            miss = np.abs(obs[0, :7] - expected)
            assert miss[:3].max() < 5 and miss[3:6].max() < 1 and miss[6] < 1e-6, (step, miss)
        state, step = obs[0, :7], step + 1
    final = info["final_info"]
    assert final["crashed"][0] and slowest < 4000 and np.isfinite(info["final_obs"]).all()
    assert envs.single_observation_space.contains(info["final_obs"][0])
    assert np.linalg.norm(info["final_obs"][0, 3:6]) < 7900


# --- the cut-off ------------------------------------------------------------------------------------------------------


def test_cutoff_of_many_flights_is_exact():
    envs, rng = make(CUTOFF, 64, action_frame="local"), np.random.default_rng(6)
    bias, running = rng.normal(scale=0.01, size=(64, 3)), np.ones(64, dtype=bool)
    cuts = 0
    envs.reset()
    for t in range(481):
        obs, _, terminated, _, info = envs.step(programme(2 * t) + bias)
        if terminated.any():
            final = info["final_info"]
            for n in np.flatnonzero(terminated & running & (t < 480)):
                assert energy(info["final_obs"][n]) == pytest.approx(GOAL_ENERGY, rel=1e-10)
                assert abs(final["a_km"][n] * 1e3 - GOAL[0]) < 1.0
                time = final["final_time_s"][n]
                assert 2 * t < time <= 2 * t + 2
                assert info["final_obs"][n, 6] == pytest.approx(23464 - 16820 / 700 * (time - 261), abs=1e-6)
                cuts += 1
            running &= ~terminated
        assert all(energy(s) < GOAL_ENERGY for s in obs[running]), "none goes on with more than the target's energy"
    assert cuts > 50


def test_nothing_is_cut_before_the_last_phase():
    low = replace(ROCKET, a=3.5e6)  # its energy is reached long before
    envs = [make(env_id, rocket=low, action_frame="local") for env_id in (CUTOFF, FIXED)]
    cut, whole = [fly(each, lambda obs, t: programme(2 * t)) for each in envs]
    assert energy(whole[0][100]) > -MU / (2 * 3.5e6), "reached in phase 3"
    assert 261 <= cut[2]["final_time_s"] < 264 and whole[2]["final_time_s"] == 961


# --- batch and autoreset ----------------------------------------------------------------------------------------------


def mixed(t, n, episode):
    """Environment n's direction: cut off, crash early (each second time earlier), go on to the end, crash late."""
    early_dive = [-1.0, 1.0, 0.0] if t > (20, 12)[episode % 2] else [1.0, 0.0, 0.0]
    late_dive = [-1.0, 0.0, 0.1] if t > 160 else programme(2 * t)
    return np.array([programme(2 * t), early_dive, [1.0, 0.01, 0.0], late_dive][n])


def test_single_environment_is_the_vector_environment():
    """Over the first episodes' ends into the next ones; the singles' next episode is flown by new environments."""
    options, steps = {"action_frame": "local", "table_isp": True}, 520
    envs = make(CUTOFF, 4, **options)
    obs, _ = envs.reset()
    singles, clock = [single(CUTOFF, **options) for _ in range(4)], np.zeros(4, dtype=int)
    sums, ends = np.zeros(4), [[] for _ in range(4)]
    for n, env in enumerate(singles):
        np.testing.assert_array_equal(env.reset()[0], obs[n])
    start = obs[0]
    for step in range(steps):
        actions = np.array([mixed(t, n, len(ends[n])) for n, t in enumerate(clock)])
        obs, rewards, terminated, truncated, info = envs.step(actions)
        clock += 1
        assert not truncated.any() and terminated.any() == bool(info)
        if info:
            for flag in (info["_final_obs"], info["_final_info"], info["final_info"]["_error"]):
                np.testing.assert_array_equal(flag, terminated)
            assert {k for k in info["final_info"] if k[0] != "_"} == KEYS
            assert {k for k in info["final_info"] if k[0] == "_"} == {f"_{k}" for k in KEYS}
        for n in range(4):
            single_obs, reward, ended, cut, single_info = singles[n].step(actions[n])
            sums[n] += reward
            assert (reward, ended, cut) == (pytest.approx(rewards[n], rel=0, abs=1e-9), terminated[n], False)
            # a matrix product in the local frame may round by the batch's size, hence not to the bit
            batch_obs = info["final_obs"][n] if ended else obs[n]
            np.testing.assert_allclose(single_obs, batch_obs, rtol=1e-12, atol=1e-8)
            assert set(single_info) == (KEYS if ended else set())
            for key, value in single_info.items():
                np.testing.assert_allclose(info["final_info"][key][n], value, rtol=1e-10, atol=1e-9, err_msg=key)
            if ended:
                np.testing.assert_array_equal(obs[n], start)
                assert single_info["episodic_return"] == pytest.approx(sums[n], rel=1e-12, abs=1e-10)
                ends[n].append((step + 1, single_info))
                singles[n], clock[n], sums[n] = single(CUTOFF, **options), 0, 0.0
                singles[n].reset()
    assert ends[0][0][1]["final_time_s"] < 961 and not ends[0][0][1]["crashed"] and len(ends[0]) == 1
    assert len(ends[1]) > 5 and all(end["crashed"] for _, end in ends[1])
    heights = [end["max_altitude_km"] for _, end in ends[1]]
    assert len({round(h, 6) for h in heights}) == 2 and heights[1] < heights[0], (
        "the same anew, nothing of the one before"
    )
    assert ends[2][0][0] == 481 and ends[2][0][1]["final_time_s"] == 961 and not ends[2][0][1]["crashed"]
    assert ends[3][0][1]["crashed"] and 162 < ends[3][0][0] < 480
    assert len({end[0][0] for end in ends}) == 4


@pytest.mark.parametrize(
    "env_id, steering, last",
    [
        (FIXED, "ascent", 481),
        (CUTOFF, "over the top", 481),
        (CUTOFF, "ascent", None),
        (FIXED, "late dive", None),
        (CUTOFF, "early crash", None),
    ],
)
def test_steps_outside_an_episode_are_refused(env_id, steering, last):
    """Before the first reset, after an end by the clock, by the cut-off and by a crash."""
    env = single(env_id, action_frame="local").unwrapped  # Gymnasium's wrapper refuses the first step by itself
    with pytest.raises(ResetNeeded, match=r"call reset\(\) first"):
        env.step(np.ones(3))
    for _ in range(2):
        obs, ended, t = env.reset()[0], False, 0
        while not ended:
            obs, _, ended, _, final = env.step(STEERING[steering](obs, t))
            t += 1
        assert (t == 481) == (last == 481) and final["crashed"] == (steering in ("late dive", "early crash"))
        for _ in range(2):
            with pytest.raises(ResetNeeded, match="again after an episode has ended"):
                env.step(np.ones(3))


@pytest.mark.parametrize("env_id", IDS)
def test_row_of_a_large_batch_is_a_batch_of_one(env_id):
    rng = np.random.default_rng(7)
    bias = rng.normal(scale=0.01, size=(1000, 3))
    large, rows, u = make(env_id, 1000), (0, 123, 999), reference(False)[0]
    one = [make(env_id) for _ in rows]
    for envs in (large, *one):
        envs.reset()
        envs.unwrapped.y[:] = reference(False)[1][440][:, None]
        envs.unwrapped.t[:] = 440
    for t in range(440, 460):
        obs, *_ = large.step(u[t] + bias)
        for envs, n in zip(one, rows):
            np.testing.assert_array_equal(envs.step((u[t] + bias[n])[None])[0][0], obs[n])


def advance_from(env_id, states, t, actions):
    envs = make(env_id, len(states))
    envs.reset()
    envs.unwrapped.y[:], envs.unwrapped.t[:] = np.array(states).T, t
    return envs.unwrapped.advance(np.array(actions))


def test_plunging_row_of_a_batch_is_a_batch_of_one():
    up, along, _ = up_along_cross(START)
    states = [[*(RE + h) * up, *v * (0.9 * along - 0.43 * up), 15000.0] for h, v in ((12e3, 7800), (3e3, 9000))]
    both = advance_from(FIXED, states, 200, [up, up])[0]
    for n in range(2):
        np.testing.assert_array_equal(advance_from(FIXED, states[n : n + 1], 200, [up])[0][0], both[n])


def test_cut_off_row_of_a_batch_is_a_batch_of_one():
    u, y, (time, _) = reference(False)
    last, rng = int(time // 2), np.random.default_rng(8)
    actions = u[last] + rng.normal(scale=0.5, size=(200, 3))
    states = np.repeat(y[last][None], 200, axis=0)
    states[:, 3:6] *= 1 + rng.uniform(-2e-5, 2e-5, (200, 1))
    obs, _, terminated, final = advance_from(CUTOFF, states, last, actions)
    cut = np.flatnonzero(terminated)
    assert len(cut) > 50
    for n in cut:
        one, _, _, one_final = advance_from(CUTOFF, states[n : n + 1], last, actions[n : n + 1])
        np.testing.assert_array_equal(one[0], obs[n])
        assert one_final["final_time_s"][0] == final["final_time_s"][n]


# --- reward -----------------------------------------------------------------------------------------------------------


def goal_errors(s):
    h = np.cross(s[:3], s[3:6])
    e = np.cross(s[3:6], h) / MU - s[:3] / np.linalg.norm(s[:3])
    return np.concatenate([PLANE.T @ h / GOAL_H - [0, 0, 1], PLANE.T @ e - [GOAL[1], 0, 0]])


def expected_parts(seen, u, final, mass_weight, trajectory_weight, guidance_weight, knots):
    """The five parts (K, 5) of each step of a flight, from the formulas' words, by a plain loop."""
    parts = np.zeros((len(u), 5))
    for k in range(len(u)):
        before, after, begin = seen[k], seen[k + 1], 2.0 * k
        end = final["final_time_s"] if k == len(u) - 1 else begin + 2
        altitude = np.linalg.norm(after[:3]) - RE
        parts[k, 0] = 10 * (np.abs(goal_errors(before)).sum() - np.abs(goal_errors(after)).sum())
        if begin < 261:
            parts[k, 1] = trajectory_weight * (energy(after) - energy(before)) / 1e6
        if knots and begin <= 150.4:
            pitch = math.radians(np.interp(begin, *knots))
            up, along, _ = up_along_cross(before)
            parts[k, 2] = -guidance_weight * (1 - u[k] @ (math.sin(pitch) * up + math.cos(pitch) * along))
        parts[k, 3] -= 40 * (altitude < 0)
        parts[k, 3] -= 0.024 * min(max((altitude - 245e3) / 100e3, 0), 1)
        if end > 300:
            parts[k, 3] -= 0.024 * min(max((110e3 - altitude) / 30e3, 0), 1)
        if k:
            parts[k, 3] -= 0.001 * np.linalg.norm(u[k] - u[k - 1])
        if begin > 261:
            parts[k, 3] -= mass_weight * (before[6] - after[6]) / 100
        if altitude < 0:
            parts[k, 3] -= mass_weight * min(after[6] - 6644, 16820) / 100
        if k == len(u) - 1:
            parts[k, 4] = -2 * math.log(1 + np.linalg.norm(goal_errors(after)) / 0.005)
    return parts


LINEAR = ([0, 150.4], [90, 40])
KNOTS = ([0, 10, 40, 75.2, 150.4], [90, 88, 72, 55, 35])
STEERING = {
    "ascent": lambda obs, t: programme(2 * t) + np.random.default_rng(t).normal(scale=0.05, size=3),
    "over the top": lambda obs, t: [1.0, 0.2, 0.0],
    "late dive": lambda obs, t: [-1.0, 0.1, 0.0] if t > 180 else programme(2 * t),
    "early crash": lambda obs, t: [-0.2, 1.0, 0.3],
}


ALL_WEIGHTS = {"guidance": "knots", "mass_weight": 0.3, "trajectory_weight": 0.7, "guidance_weight": 0.2}


@pytest.mark.parametrize(
    "env_id, steering, weights, knots",
    [
        (CUTOFF, "ascent", ALL_WEIGHTS, KNOTS),
        (FIXED, "ascent", {"guidance": "linear"}, LINEAR),
        (FIXED, "over the top", ALL_WEIGHTS, KNOTS),
        (FIXED, "over the top", {}, None),
        (CUTOFF, "late dive", ALL_WEIGHTS, KNOTS),
        (FIXED, "early crash", {}, None),
    ],
)
def test_rewards_follow_the_formulas(env_id, steering, weights, knots):
    envs = make(env_id, action_frame="local")
    defaults = {"mass_weight": 0.0, "trajectory_weight": 0.0, "guidance_weight": 0.1}
    for name, value in defaults.items():
        assert getattr(envs.unwrapped, name) == value
    assert envs.unwrapped.guidance == "none"
    for name, value in weights.items():
        setattr(envs.unwrapped, name, value)
    actions = []
    steer = lambda obs, t: actions.append(STEERING[steering](obs, t)) or actions[-1]  # noqa: E731
    seen, rewards, final = fly(envs, steer)
    u = np.array([np.array(a) / np.linalg.norm(a) @ up_along_cross(s) for a, s in zip(actions, seen)])
    numbers = {name: weights.get(name, value) for name, value in defaults.items()}
    parts = expected_parts(seen, u, final, **numbers, knots=knots)
    np.testing.assert_allclose(rewards, parts.sum(axis=1), rtol=1e-10, atol=1e-11)
    got = [final[name] for name in PARTS]
    np.testing.assert_allclose(got, parts.sum(axis=0), rtol=1e-10, atol=1e-10)
    assert final["episodic_return"] == pytest.approx(rewards.sum(), abs=1e-10)
    assert final["episodic_return"] == pytest.approx(sum(got), abs=1e-10)
    first, last = (np.abs(goal_errors(seen[k])).sum() for k in (0, -1))
    assert final["R_orbital"] == pytest.approx(10 * (first - last), abs=1e-10)
    if knots is None:
        assert final["R_guidance"] == final["R_trajectory"] == 0
    else:
        assert final["R_guidance"] < 0 and (parts[76:, 2] == 0).all()
    assert final["crashed"] == (steering in ("late dive", "early crash"))
    assert (parts[-1, 3] <= -40) == final["crashed"]
    # what is reported besides
    error = terminal_error(seen[-1])
    np.testing.assert_allclose(final["error"], error, rtol=1e-12, atol=1e-15)
    assert final["error_norm"] == pytest.approx(math.sqrt((error**2).sum()))
    d = final["error_norm"]
    assert final["points"] == pytest.approx(2000 * (d < 0.02) + 1600 * (math.exp(-d / 0.01) + math.exp(-d / 0.001)))
    elements = orbital_elements(seen[-1])
    np.testing.assert_allclose(
        [final["a_km"], final["e"], *(final[f"{name}_deg"] for name in ("i", "raan", "argp"))],
        [elements.a / 1e3, elements.e, *np.degrees([elements.i, elements.raan, elements.argp])],
    )
    heights = np.linalg.norm(seen[1:, :3], axis=1) - RE
    assert final["max_altitude_km"] == pytest.approx(max(heights.max(), 0) / 1e3, abs=1e-9)


@pytest.mark.parametrize("guidance", ["none", "linear", "knots"])
def test_guidance_is_exactly_zero_after_the_second_boosters(guidance):
    """Two flights, with and without: what they pay for each step is the same to the bit from 150.4 s on."""
    pay = []
    for name in (guidance, "none"):
        envs = make(FIXED, action_frame="local")
        envs.unwrapped.guidance, envs.unwrapped.end_time = name, 400.0
        pay.append(fly(envs, lambda obs, t: programme(2 * t))[1])
    different = np.flatnonzero(pay[0] != pay[1])
    assert (GRID[different] < 150.4).all() and (len(different) > 70) == (guidance != "none")
    assert set(REFERENCE_PITCH) == {"none", "linear", "knots"}


def test_reward_functions_at_points_computed_by_hand():
    assert orbital_reward(1.5, 1.2) == pytest.approx(3.0)
    assert trajectory_reward(-60e6, -58e6, 2, 0.5) == pytest.approx(1.0)
    assert trajectory_reward(-60e6, -58e6, 3, 0.5) == 0 and trajectory_reward(-60e6, -58e6, 0, 0.0) == 0
    frame, u = np.eye(3)[:, :, None], np.array([[0.6], [0.0], [0.8]])
    for pitch, expected in ((90, -0.04), (0, -0.1), (30, -0.07), (np.nan, 0.0)):
        got = guidance_reward(u, *frame[:2], np.radians([pitch]), 0.1)
        assert got[0] == pytest.approx(expected, abs=1e-15)
    hand = [  # altitude, time, turn, burnt, left, mass weight; value
        ((200e3, 500, 0.0, 0.0, 9e3, 0.0), 0.0),
        ((-1.0, 10, 0.0, 0.0, 9e3, 0.0), -40.0),
        ((0.0, 10, 0.0, 0.0, 9e3, 1.0), 0.0),
        ((245e3, 500, 0.0, 0.0, 9e3, 0.0), 0.0),
        ((295e3, 100, 0.0, 0.0, 9e3, 0.0), -0.012),
        ((400e3, 500, 0.0, 0.0, 9e3, 0.0), -0.024),
        ((95e3, 500, 0.0, 0.0, 9e3, 0.0), -0.012),
        ((95e3, 300, 0.0, 0.0, 9e3, 0.0), 0.0),
        ((50e3, 302, 0.0, 0.0, 9e3, 0.0), -0.024),
        ((-1.0, 500, 2.0, 50.0, 1e3, 0.4), -40 - 0.024 - 0.002 - 0.2 - 4),
        ((200e3, 500, 0.5, 48.0, 1e3, 1.0), -0.0005 - 0.48),
    ]
    columns = [np.array(column) for column in zip(*(arguments for arguments, _ in hand))]
    np.testing.assert_allclose(penalties(*columns), [value for _, value in hand], rtol=0, atol=1e-15)
    logs = [0, -2 * math.log(2), -2 * math.log(100)]
    np.testing.assert_allclose(terminal_reward(np.array([0.0, 0.005, 0.495])), logs)
    np.testing.assert_allclose(terminal_reward(np.array([0.0, 0.001, 0.099]), 0.001), logs)
    got = precision_points(np.array([0.0, 0.01, 0.02, 1.0]))
    expected = [5200, 2000 + 1600 * (math.exp(-1) + math.exp(-10)), 1600 * math.exp(-2), 0]
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-5)


def test_weights_of_the_single_environment():
    returns = {}
    changes = {"mass_weight": 2.0, "trajectory_weight": 0.5, "guidance": "knots", "guidance_weight": 5.0}
    for name, value in changes.items():
        env = single(FIXED, action_frame="local")
        if name == "guidance_weight":
            env.unwrapped.guidance = "knots"
        setattr(env.unwrapped, name, value)
        assert getattr(env.unwrapped, name) == value
        env.unwrapped.end_time = 400.0
        env.reset()
        steps = [env.step(programme(2 * t)) for t in range(200)]
        returns[name] = steps[-1][4]
        assert steps[-1][4]["episodic_return"] == pytest.approx(sum(step[1] for step in steps), abs=1e-10)
    envs = make(FIXED, action_frame="local")
    envs.unwrapped.end_time = 400.0
    plain = fly(envs, lambda obs, t: programme(2 * t))[2]
    burnt = 16820 / 700 * (400 - 262)  # by steps that begin after 261 s
    assert returns["mass_weight"]["R_penalties"] - plain["R_penalties"] == pytest.approx(-2 * burnt / 100, abs=1e-9)
    assert returns["trajectory_weight"]["R_trajectory"] > 1
    assert returns["guidance_weight"]["R_guidance"] == pytest.approx(50 * returns["guidance"]["R_guidance"])
    for changed, final in returns.items():
        for part in PARTS:
            affected = {"mass_weight": "R_penalties", "trajectory_weight": "R_trajectory"}.get(changed, "R_guidance")
            assert (final[part] == plain[part]) == (part != affected), (changed, part)


@pytest.mark.parametrize("env_id, steering", [(FIXED, "early crash"), (CUTOFF, "ascent")])
def test_terminal_scale_changes_only_the_last_reward(env_id, steering):
    pay, finals = [], []
    for scale in (0.005, 0.0005, 0.02):
        envs = make(env_id, action_frame="local")
        assert envs.unwrapped.terminal_scale == 0.005
        envs.unwrapped.terminal_scale = scale
        _, rewards, final = fly(envs, STEERING[steering])
        pay.append(rewards)
        finals.append(final)
    d = finals[0]["error_norm"]
    assert finals[0]["R_terminal"] == pytest.approx(-2 * math.log(1 + d / 0.005))
    for rewards, final, scale in zip(pay, finals, (0.005, 0.0005, 0.02)):
        np.testing.assert_array_equal(rewards[:-1], pay[0][:-1])
        paid = rewards[-1] - pay[0][-1]
        assert paid == pytest.approx(2 * math.log(1 + d / 0.005) - 2 * math.log(1 + d / scale), abs=1e-10)
        for key, value in final.items():
            np.testing.assert_array_equal(value, finals[0][key])


def test_terminal_scale_in_a_batch_that_ends_at_different_times():
    """Each environment is paid at its own end, by the scale that is set then."""
    envs, plain = make(FIXED, 2), make(FIXED, 2)
    envs.unwrapped.terminal_scale = 0.05
    envs.reset(), plain.reset()
    outward = plain.unwrapped.rocket.x0[:3]
    differ, ended = [], []
    for t in range(481):
        action = np.array([outward, -outward if t < 30 else outward])  # the second falls back and crashes
        differ.append(envs.step(action)[1] - plain.step(action)[1])
        ended.append(plain.unwrapped.t == 0)
    np.testing.assert_array_equal(np.array(differ) > 0, ended)
    assert ended[-1][0] and sum(row[0] for row in ended) == 1 and sum(row[1] for row in ended) >= 1


@pytest.mark.parametrize("maker", [make, single])
@pytest.mark.parametrize("scale", [0.0, -0.005, math.nan, math.inf])
def test_bad_terminal_scales_are_refused(maker, scale):
    env = maker(FIXED)
    env.unwrapped.terminal_scale = scale
    with pytest.raises(ValueError, match=f"terminal_scale is {scale}; it must be positive and finite"):
        env.reset()


# --- end time ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "end_time, steps", [(924.139, 463), (2.0, 1), (1.0, 1), (76.0, 38), (75.2, 38), (262.0, 131), (3, 2), (961.0, 481)]
)
@pytest.mark.parametrize("alone", [False, True])
def test_end_time(end_time, steps, alone):
    u, y, _ = reference(False)
    env = single(FIXED) if alone else make(FIXED)
    assert env.unwrapped.end_time == 961
    env.unwrapped.end_time = end_time
    assert env.unwrapped.end_time == end_time
    assert (env.unwrapped.batch if alone else env.unwrapped).episode_steps == steps
    if alone:
        env.reset()
        flown = [env.step(u[t]) for t in range(steps)]
        assert [step[2] for step in flown] == [False] * (steps - 1) + [True]
        obs, final = flown[-1][0], flown[-1][4]
    else:
        seen, rewards, final = fly(env, lambda obs, t: u[t])
        assert len(rewards) == steps
        obs = seen[-1]
    assert final["final_time_s"] == end_time
    expected = integrate(y[steps - 1], 2.0 * steps - 2, end_time, u[steps - 1])
    assert_states_agree(obs[:7], expected)
    assert obs[7] == pytest.approx(1 - end_time / 961, abs=1e-15)


@pytest.mark.parametrize("value", [0, -1, math.nan, 962, math.inf, -math.inf])
def test_bad_end_times_are_refused(value):
    for env in (make(FIXED, 2), gym.make(CUTOFF)):
        with pytest.raises(ValueError, match=rf"end_time is {value} "):
            env.unwrapped.end_time = value
        assert env.unwrapped.end_time == 961


@pytest.mark.parametrize("value", [1e-10, 2e-9])
def test_tiny_end_time_is_one_step_or_refused(value):
    envs = make(FIXED)
    try:
        envs.unwrapped.end_time = value
    except ValueError as error:
        assert "end_time is" in str(error)
    assert envs.unwrapped.episode_steps == (1 if envs.unwrapped.end_time == value else 481)


@pytest.mark.parametrize("end_time", [100.0, 200.0])
def test_short_flights_know_no_last_phase(end_time):
    """Neither the mass term nor the cut-off act before 261 s, where the training ends the episode before."""
    envs = make(CUTOFF, action_frame="local", rocket=replace(ROCKET, a=3.3e6))
    envs.unwrapped.end_time, envs.unwrapped.mass_weight = end_time, 1.0
    *_, final = fly(envs, lambda obs, t: programme(2 * t))
    assert final["final_time_s"] == end_time
    assert final["R_penalties"] > -1


def test_end_time_changes_between_episodes():
    envs = make(FIXED, action_frame="local")
    for end_time, steps in ((100.0, 50), (424.139, 213), (961.0, 481)):
        envs.unwrapped.end_time = end_time
        seen, rewards, final = fly(envs, lambda obs, t: programme(2 * t))
        assert (len(rewards), final["final_time_s"]) == (steps, end_time)
        assert final["episodic_return"] == pytest.approx(rewards.sum(), abs=1e-10)


# --- bad and odd input ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [[0.0, 0.0, 0.0], [-0.0, 0.0, 0.0], [1.0, np.nan, 0.0], [np.inf, 0.0, 0.0],
                                 [0.0, 0.0, -np.inf]])  # fmt: skip
@pytest.mark.parametrize("action_frame", ["eci", "local"])
def test_bad_actions_name_environment_and_step(bad, action_frame):
    envs = make(FIXED, 4, action_frame=action_frame)
    envs.reset()
    good = np.tile([1.0, 0.0, 0.5], (4, 1))
    first = envs.step(good)[0]
    actions = good.copy()
    actions[2] = bad
    with pytest.raises(ValueError, match="env 2 at step 1 "):
        envs.step(actions)
    np.testing.assert_array_equal(envs.unwrapped.y.T, first[:, :7])
    env = gym.make(FIXED, action_frame=action_frame)
    env.reset()
    with pytest.raises(ValueError, match="env 0 at step 0 "):
        env.step(np.array(bad))


@pytest.mark.parametrize("action_frame", ["eci", "local"])
def test_only_the_direction_of_an_action_counts(action_frame):
    lengths = np.array([1.0, 1e-320, 1e-300, 1e300, 1.7e308, 7.0])
    envs = make(FIXED, len(lengths), action_frame=action_frame)
    envs.reset()
    for direction in ([1.0, 1.0, 1.0], [0.0, 1.0, 0.0], [1.0, -1.0, 0.0]):
        with np.errstate(over="raise", invalid="raise", divide="raise"):
            obs = envs.step(lengths[:, None] * direction)[0]
        np.testing.assert_allclose(obs, [obs[0]] * len(lengths), rtol=1e-15, atol=1e-9)
    expected = np.array([1.0, -1.0, 0.0]) / math.sqrt(2)
    if action_frame == "eci":
        np.testing.assert_allclose(envs.unwrapped.u.T, [expected] * len(lengths), atol=1e-15)
    with_zeros = make(FIXED).unwrapped
    with_zeros.reset()
    with_zeros.step([[1e300, 1e-320, -0.0]])
    np.testing.assert_array_equal(with_zeros.u[:, 0], [1, 0, 0])


def test_other_bad_input_is_refused():
    for maker in (make, gym.make):
        with pytest.raises(ValueError, match="action_frame is 'ned'; it must be one of eci, local"):
            maker(FIXED, action_frame="ned")
    with pytest.raises(ValueError, match="reset options"):
        make(FIXED).reset(options={"x0": np.zeros((1, 7))})
    with pytest.raises(ValueError, match="reset options"):
        gym.make(FIXED).reset(options={"x0": np.zeros(7)})
    make(FIXED).reset(options={})
    envs = make(FIXED, 2)
    envs.reset()
    with pytest.raises(ValueError, match=r"shape \(3,\); expected \(2, 3\)"):
        envs.step(np.ones(3))
    with pytest.raises(ValueError, match="num_envs is 0"):
        RocketVectorEnv(0)


# --- the gymnasium interface ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("action_frame", ["eci", "local"])
@pytest.mark.parametrize("table_isp", [False, True])
@pytest.mark.parametrize("observe_phase", [True, False])
def test_check_env(env_id, action_frame, table_isp, observe_phase):
    env = gym.make(env_id, action_frame=action_frame, table_isp=table_isp, observe_phase=observe_phase)
    assert env.spec.max_episode_steps is None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    assert not [str(w.message) for w in caught if "symmetric and normalized" not in str(w.message)]


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("num_envs", [1, 1000])
def test_vector_environment_is_native(env_id, num_envs):
    envs = gym.make_vec(env_id, num_envs=num_envs)
    assert isinstance(envs.unwrapped, RocketVectorEnv)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP and envs.spec.max_episode_steps is None
    assert envs.unwrapped.episode_steps == 481
    obs, _ = envs.reset(seed=0)
    assert obs.shape == (num_envs, 9) and obs.dtype == np.float64 and envs.observation_space.contains(obs)
    for _ in range(3):
        obs, rewards, terminated, truncated, info = envs.step(np.tile([1.0, 0.0, 0.5], (num_envs, 1)))
    assert rewards.shape == terminated.shape == truncated.shape == (num_envs,) and info == {}
    assert obs.dtype == rewards.dtype == np.float64 and envs.observation_space.contains(obs)
    assert (obs == obs[0]).all() and envs.single_action_space.shape == (3,)
