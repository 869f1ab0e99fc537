"""The rocket's five rewards, with both vehicles: step by step against the formulas' words in plain loops, by hand."""

import math

import numpy as np
import pytest
from rocket_oracle import (
    CUTOFF,
    FIXED,
    LEO,
    PARTS,
    RE,
    VEHICLES,
    fly,
    make,
    single,
)

from envs import ROCKETS, BadInput, Mission
from rocket.rewards import (
    penalties,
)


def expected_parts(v, floor, seen, u, final, propellant_price, knots):
    """The five parts (K, 5) of each step of a flight, from the formulas' words, by a plain loop."""
    parts = np.zeros((len(u), 5))
    for k in range(len(u)):
        before, after, begin = seen[k], seen[k + 1], 2.0 * k
        end = final["final_time_s"] if k == len(u) - 1 else begin + 2
        altitude = np.linalg.norm(after[:3]) - RE
        parts[k, 0] = 10 * (np.abs(v.goal_errors(before)).sum() - np.abs(v.goal_errors(after)).sum())
        if knots and begin <= v.guided_until:
            pitch = math.radians(np.interp(begin, *knots))
            up, along, _ = v.up_along_cross(before)
            parts[k, 2] = -0.1 * (1 - u[k] @ (math.sin(pitch) * up + math.cos(pitch) * along))
        parts[k, 3] -= 40 * (altitude < 0) * (2 - end / v.end)
        parts[k, 3] -= 0.024 * min(max((altitude - v.ceiling + 5e3) / 100e3, 0), 1)
        if end > 300:
            parts[k, 3] -= 0.024 * min(max((floor - altitude) / 30e3, 0), 1)
        if k:
            parts[k, 3] -= 0.001 * np.linalg.norm(u[k] - u[k - 1])
        if begin >= v.last_ignition:
            parts[k, 3] -= propellant_price * (before[6] - after[6]) / v.mass_unit
        if altitude < 0:
            parts[k, 3] -= propellant_price * min(after[6] - v.dry_mass, v.last_propellant) / v.mass_unit
        if k == len(u) - 1:
            parts[k, 4] = -2 * math.log(1 + np.linalg.norm(v.goal_errors(after)) / 0.005)
    return parts


KNOTS = ([0, 10, 40, 75.2, 150.4], [90, 88, 72, 55, 35])
KNOTS_OF_TWO_STAGES = ([0, 10.77127660, 43.08510638, 81, 162], [90, 88, 72, 55, 35])  # its 162 s for the paper's 150.4
ALL_WEIGHTS = {"guidance": True, "propellant_price": 0.3}


@pytest.mark.slow
@pytest.mark.parametrize(
    "env_id, steering, weights, knots",
    [
        (CUTOFF, "ascent", ALL_WEIGHTS, KNOTS),
        (FIXED, "over the top", ALL_WEIGHTS, KNOTS),
        (CUTOFF, "late dive", ALL_WEIGHTS, KNOTS),
        (FIXED, "early crash", {}, None),
        (LEO, "ascent", ALL_WEIGHTS, KNOTS_OF_TWO_STAGES),
    ],
)
def test_rewards_follow_the_formulas(env_id, steering, weights, knots):
    v = VEHICLES[env_id]
    envs = make(env_id, action_frame="local")
    actions = []
    steer = lambda obs, t: actions.append(v.steering[steering](obs, t)) or actions[-1]  # noqa: E731
    seen, rewards, final = fly(envs, steer, **weights)
    u = np.array([np.array(a) / np.linalg.norm(a) @ v.up_along_cross(s) for a, s in zip(actions, seen)])
    floor = 130e3 if env_id == FIXED else 110e3
    parts = expected_parts(v, floor, seen, u, final, weights.get("propellant_price", 0.0), knots)
    np.testing.assert_allclose(rewards, parts.sum(axis=1), rtol=1e-10, atol=1e-11)
    got = [final[name] for name in PARTS]
    np.testing.assert_allclose(got, parts.sum(axis=0), rtol=1e-10, atol=1e-10)
    assert final["episodic_return"] == pytest.approx(rewards.sum(), abs=1e-10)
    assert final["episodic_return"] == pytest.approx(sum(got), abs=1e-10)
    if knots is None:
        assert final["R_guidance"] == final["R_trajectory"] == 0
    else:
        assert final["R_guidance"] < 0 and (parts[math.floor(v.guided_until / 2) + 1 :, 2] == 0).all()
    assert final["crashed"] == (steering in ("late dive", "early crash"))
    assert (parts[-1, 3] <= -40) == final["crashed"]
    # what is reported besides
    assert final["error_norm"] == pytest.approx(np.linalg.norm(v.goal_errors(seen[-1])), rel=1e-9)
    heights = np.linalg.norm(seen[1:, :3], axis=1) - RE
    assert final["max_altitude_km"] == pytest.approx(max(heights.max(), 0) / 1e3, abs=1e-9)


def test_penalties_are_the_missions_by_hand():
    """No ceiling: no altitude is too high. A mass unit of its own, or 6 % of the dry mass; another floor, late."""
    rows, mission = [(400e3, 500, 0, 0, 0, 1), (4e7, 500, 0, 36.0, 0, 1), (-1, 9, 0, 0, 72, 2)], ROCKETS[LEO]
    args, crash = [np.array(column) for column in zip(*rows)], -40 * (2 - 9 / mission.rocket.end_time)
    np.testing.assert_allclose(penalties(mission, *args), [0, -0.025, crash - 2 * 0.05], rtol=0, atol=1e-15)
    own = Mission(mission.rocket, ceiling_km=420.0, mass_unit=72.0, floor_km=80.0, floor_from=100.0)
    np.testing.assert_allclose(penalties(own, *args), [0, -0.024 - 0.5, crash - 2], rtol=0, atol=1e-15)
    height, time = np.array([465e3, 415e3, 65e3, 65e3, 85e3]), np.array([99.0, 99.0, 99.0, 101.0, 101.0])
    got = penalties(own, height, time, 0.0, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(got, [-0.012, 0, 0, -0.012, 0], rtol=0, atol=1e-15)


def test_terminal_scale_changes_only_the_last_reward():
    v = VEHICLES[LEO]
    flights = []
    for scale in (0.005, 0.0005):
        flights.append(fly(make(LEO, action_frame="local"), v.steering["ascent"], terminal_scale=scale))
    (_, pay, final), (_, scaled_pay, scaled) = flights
    np.testing.assert_array_equal(scaled_pay[:-1], pay[:-1])
    d = final["error_norm"]
    expected = 2 * math.log(1 + d / 0.005) - 2 * math.log(1 + d / 0.0005)
    assert scaled_pay[-1] - pay[-1] == pytest.approx(expected, abs=1e-10)
    for key, value in final.items():
        np.testing.assert_array_equal(scaled[key], value)


@pytest.mark.parametrize("maker", [make, single])
@pytest.mark.parametrize("scale", [0.0, -0.005, math.nan, math.inf])
def test_bad_terminal_scales_are_refused(maker, scale):
    env = maker(FIXED)
    with pytest.raises(BadInput, match=f"terminal_scale is {scale}; it must be a number of at least 1e-12"):
        env.reset(options={"training": {"terminal_scale": scale}})
