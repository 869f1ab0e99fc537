"""The rockets' problems typed once more and integrated by SciPy: what the rocket's tests measure the code against.

The numbers of the paper's rocket are the benchmark's, those of the second vehicle are its file's, both typed here.
Nothing of the project is imported but what flies: `make`, `single`, and a vehicle of one burn.
"""

import math
from dataclasses import replace
from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from envs import ROCKETS, Burn, Engine, Rocket, RocketEnv, RocketVectorEnv, launch_raan

MU, RE, OMEGA, SEA_LEVEL_G = 3.986012e14, 6378145.0, 7.29211585e-5, 9.80665
FIXED, CUTOFF, LEO = "RocketAscent-v0", "RocketAscentCutoff-v0", "TwoStageLEO-v0"
LEO_FIXED = "TwoStageLEO-v0 without its cut-off"  # of these tests only
PARTS = ["R_orbital", "R_trajectory", "R_guidance", "R_penalties", "R_terminal"]
ATOL = [1e-5] * 3 + [1e-8] * 3 + [1e-8]


def rotation(axis, angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array({"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}[axis])


def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def unit(a):
    length = math.hypot(*a)
    return [component / length for component in a]


def energy(s):
    return (s[3] ** 2 + s[4] ** 2 + s[5] ** 2) / 2 - MU / math.sqrt(s[0] ** 2 + s[1] ** 2 + s[2] ** 2)


def between_events(rows, derivative, s, begin, end, before=(), after=(), events=None):
    """State at `end`, by DOP853 through rows (start, end, thrust, flow, kg dropped); (time, state) at a first event.

    derivative(t, s, *before, thrust, flow, *after).
    """
    for start, stop, thrust, flow, dropped in rows:
        a, b = max(begin, start), min(end, stop)
        if a < b:
            options = {"rtol": 1e-11, "atol": ATOL, "first_step": b - a, "args": (*before, thrust, flow, *after)}
            solution = solve_ivp(derivative, (a, b), s, "DOP853", events=events, **options)
            if events and len(solution.t_events[0]):
                return solution.t_events[0][0], solution.y_events[0][0]
            s = solution.y[:, -1].copy()
            s[6] -= dropped if stop <= end else 0
    return s


class Vehicle:
    """A rocket's numbers and what follows from them. `engines`: name -> (total kg, propellant kg, N, Isp s, burn s);
    `burns`: rows of end (s), engines that burn and engines dropped then, both as {name: number}."""

    latitude = math.radians(28.5)

    def __init__(self, name, fixed, cutoff, engines, burns, payload, area, goal, pitch, **rules):
        self.name, self.fixed, self.cutoff, self.engines, self.burns = name, fixed, cutoff, engines, burns
        self.payload, self.area, self.pitch = payload, area, pitch
        self.goal = (*goal[:2], *map(math.radians, goal[2:]))  # a, e, i, RAAN, argp
        self.a, self.e = goal[:2]
        self.ceiling, self.guided_until, self.mass_unit = (rules[k] for k in ("ceiling", "guided_until", "mass_unit"))
        self.end, self.stagings = burns[-1][0], [burn[0] for burn in burns[:-1]]
        self.last_ignition = self.stagings[-1]
        aboard = [*(item for burn in burns for item in burn[2].items()), *burns[-1][1].items()]
        self.start_mass = payload + sum(n * engines[e][0] for e, n in aboard)
        self.last_propellant = sum(n * engines[e][1] for e, n in burns[-1][1].items())
        self.dry_mass = payload + sum(n * engines[e][0] for e, n in burns[-1][1].items()) - self.last_propellant
        self.last_flow = self.last_propellant / (self.end - self.last_ignition)
        ground = OMEGA * RE * math.cos(self.latitude)
        self.start = [RE * math.cos(self.latitude), 0.0, RE * math.sin(self.latitude), 0.0, ground, 0.0]
        self.start.append(self.start_mass)
        self.goal_energy, self.goal_h = -MU / (2 * self.a), math.sqrt(MU * self.a * (1 - self.e**2))
        # columns: perigee, a right angle ahead of it, normal
        self.plane = rotation("z", self.goal[3]) @ rotation("x", self.goal[2]) @ rotation("z", self.goal[4])
        self.grid = np.append(np.arange(0.0, self.end, 2.0), self.end)
        self.steps = len(self.grid) - 1
        self.programme, self.reference = cache(self._programme), cache(self._reference)
        late = int(0.375 * self.steps)
        self.steering = {
            "ascent": lambda obs, t: self.programme(2 * t) + np.random.default_rng(t).normal(scale=0.05, size=3),
            "over the top": lambda obs, t: [1.0, 0.2, 0.0],
            "late dive": lambda obs, t: [-1.0, 0.1, 0.0] if t > late else self.programme(2 * t),
            "early crash": lambda obs, t: [-0.2, 1.0, 0.3],
        }

    def __repr__(self):
        return self.name

    def flow(self, burning, table_isp):
        rows = [(n, *self.engines[e]) for e, n in burning.items()]
        return sum(n * (T / (SEA_LEVEL_G * isp) if table_isp else fuel / s) for n, _, fuel, T, isp, s in rows)

    def stretches(self, table_isp):
        """Rows of start, end, thrust, flow and mass dropped at the end; with the table's Isp it runs dry early."""
        rows, start = [], 0.0
        for end, burning, dropped in self.burns:
            thrust = sum(n * self.engines[e][2] for e, n in burning.items())
            shed = sum(n * (self.engines[e][0] - self.engines[e][1]) for e, n in dropped.items())
            rows.append((start, end, thrust, self.flow(burning, table_isp), shed))
            start = end
        if table_isp:
            start, end, thrust, flow, _ = rows.pop()
            dry = start + self.last_propellant / flow
            rows += [(start, dry, thrust, flow, 0), (dry, end, 0.0, 0.0, 0)]
        return rows

    def derivative(self, t, s, u, thrust, flow, drag_factor=1.0, wind=(0.0, 0.0)):
        """Of the state; the wind blows towards east and north, at its most 12 km up."""
        x, y, z, vx, vy, vz, m = s
        r = math.sqrt(x * x + y * y + z * z)
        wx, wy, wz = vx + OMEGA * y, vy - OMEGA * x, vz  # v - omega x r
        if any(wind):
            east, north = (speed * math.exp(-(((r - RE - 12000) / 5000) ** 2)) for speed in wind)
            level = math.hypot(x, y)
            wx -= -east * y / level - north * z / r * x / level
            wy -= east * x / level - north * z / r * y / level
            wz -= north * level / r
        pressure = 0.5 * 1.225 * math.exp(-(r - RE) / 7200.0) * 0.5 * self.area * drag_factor
        drag = pressure * math.sqrt(wx * wx + wy * wy + wz * wz)
        g = MU / r**3
        return [
            vx, vy, vz,
            -g * x + (thrust * u[0] - drag * wx) / m,
            -g * y + (thrust * u[1] - drag * wy) / m,
            -g * z + (thrust * u[2] - drag * wz) / m,
            -flow,
        ]  # fmt: skip

    def at_goal_energy(self, t, s, u, thrust, flow):
        return (energy(s) - self.goal_energy) / 1e6

    def integrate(self, s, begin, end, u, table_isp=False, events=None):
        """State at `end`, by DOP853 between the vehicle's events; with `events` (time, state) at the first of them."""
        return between_events(self.stretches(table_isp), self.derivative, s, begin, end, (u,), events=events)

    def up_along_cross(self, s):
        up = unit([float(component) for component in s[:3]])
        along = unit(cross(self.plane[:, 2].tolist(), up))
        return np.array([up, along, cross(up, along)])

    def _programme(self, t):
        """A sensible ascent: direction by (up, along, across) at time t, pitching over, with some yaw to and fro."""
        pitch = math.radians(np.interp(t, *self.pitch))
        yaw = math.radians(3) * math.sin(t / 80)
        return np.array([math.sin(pitch), math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw)])

    def _reference(self, table_isp):
        """The programme flown by SciPy: directions u (K, 3), states y (K + 1, 7), and (time, state) of the cut-off."""
        u, y, cut = [], [np.array(self.start)], None
        for begin, end in zip(self.grid[:-1], self.grid[1:]):
            u.append(self.programme(begin) @ self.up_along_cross(y[-1]))
            y.append(self.integrate(y[-1], begin, end, u[-1], table_isp))
            if cut is None and energy(y[-1]) >= self.goal_energy:
                cut = self.integrate(y[-2], begin, end, u[-1], table_isp, self.at_goal_energy)
        return np.array(u), np.array(y), cut

    def on_goal_orbit(self, anomaly):
        """State on the target orbit at an angle from its perigee, by the orbit's equation in its own plane."""
        p, c, s = self.a * (1 - self.e**2), math.cos(anomaly), math.sin(anomaly)
        r = p / (1 + self.e * c)
        v = math.sqrt(MU / p)
        return np.concatenate([self.plane @ [r * c, r * s, 0], self.plane @ [-v * s, v * (self.e + c), 0]])

    def goal_errors(self, s):
        """The terminal error in the target's axes, (6,)."""
        h = np.cross(s[:3], s[3:6])
        e = np.cross(s[3:6], h) / MU - s[:3] / np.linalg.norm(s[:3])
        return np.concatenate([self.plane.T @ h / self.goal_h - [0, 0, 1], self.plane.T @ e - [self.e, 0, 0]])


PAPER = Vehicle(
    "paper", FIXED, CUTOFF,
    {"solid": (19290, 17010, 628500, 284.0, 75.2), "first": (104380, 95550, 1083100, 301.7, 261.0),
     "second": (19300, 16820, 110094, 462.4, 700.0)},
    [(75.2, {"solid": 6, "first": 1}, {"solid": 6}), (150.4, {"solid": 3, "first": 1}, {"solid": 3}),
     (261.0, {"first": 1}, {"first": 1}), (961.0, {"second": 1}, {})],
    payload=4164, area=4 * math.pi, goal=(24361140.0, 0.7308, 28.5, 269.8, 130.5),
    pitch=([0, 10, 40, 75, 150, 261, 400, 600, 800, 961], [90, 88, 72, 42, 24, 11, 8, 1, 0, 5]),
    ceiling=250e3, guided_until=150.4, mass_unit=100.0,
)  # fmt: skip
# a normal orthogonal to the launch site: sin RAAN sin i cos 28.5 = - cos i sin 28.5
NODE = math.degrees(math.asin(math.tan(math.radians(28.5)) / math.tan(math.radians(51.6))))
TWO_STAGE = Vehicle(
    "two stages", LEO_FIXED, LEO,
    {"first": (433e3, 411e3, 7.6e6, 306.0, 162.0), "second": (111.5e3, 107.5e3, 934e3, 348.0, 393.0)},
    [(162.0, {"first": 1}, {"first": 1}), (555.0, {"second": 1}, {})],
    payload=20e3, area=10.5, goal=(6778145.0, 0.0, 51.6, 360 - NODE, 0.0),
    pitch=([0, 10, 40, 80, 162, 250, 350, 450, 555], [90, 88, 70, 52, 33, 26, 15, 4, -6]),
    ceiling=math.inf, guided_until=162.0, mass_unit=1440.0,
)  # fmt: skip
VEHICLES = {FIXED: PAPER, CUTOFF: PAPER, LEO_FIXED: TWO_STAGE, LEO: TWO_STAGE}
both = pytest.mark.parametrize("v", [PAPER, TWO_STAGE], ids=repr)


def without_cutoff(rocket):
    return replace(ROCKETS[LEO], cutoff=False, **({"rocket": rocket} if rocket else {}))


def make(env_id, num_envs=1, rocket=None, **options):
    if env_id == LEO_FIXED:
        return RocketVectorEnv(num_envs, without_cutoff(rocket), **options)
    return gym.make_vec(env_id, num_envs=num_envs, **options, **({"rocket": rocket} if rocket else {}))


def single(env_id, **options):
    if env_id == LEO_FIXED:
        return RocketEnv(make(env_id, **options))
    return gym.make(env_id, disable_env_checker=True, **options)  # it would take half of the time


def fly(envs, policy, **training):
    """One episode of a batch of one through its public interface: observations (K+1, 9), rewards (K,), final info."""
    obs, info = envs.reset(options={"training": training})
    seen, rewards = [obs[0]], []
    while "final_obs" not in info:
        obs, reward, terminated, truncated, info = envs.step(np.asarray(policy(seen[-1], len(rewards)))[None])
        assert not truncated.any() and terminated[0] == ("final_obs" in info)
        seen.append(info["final_obs"][0] if terminated[0] else obs[0])
        rewards.append(reward[0])
    return np.array(seen), np.array(rewards), {k: v[0] for k, v in info["final_info"].items() if k[0] != "_"}


def assert_states_agree(got, expected, relative=1e-6):
    """Position, velocity and mass, each by the length of the difference."""
    for part in (slice(0, 3), slice(3, 6), slice(6, 7)):
        miss = np.linalg.norm(got[..., part] - expected[..., part], axis=-1)
        np.testing.assert_array_less(miss, relative * np.linalg.norm(expected[..., part], axis=-1))


def single_burn(**changes):
    """One stage of 36.5 t of propellant and 2.5 t dry for 1 t to a low circle; no staging, no phase but the last."""
    stage = Engine(total_mass=39e3, propellant=36.5e3, thrust=640e3, isp=450.0, burn_time=250.0)
    options = {"burns": (Burn(250.0, ((1, stage),)),), "payload": 1e3, "end_time": 250.0, "a": 6.6e6, "e": 0.0}
    return Rocket(**options | {"i": 40.0, "raan": launch_raan(28.5, 40.0), "argp": 0.0, "S": 5.0} | changes)
