"""Opponents of a policy that flies any orbit: the nearest of K solved targets, flown to another one.

    python evaluate.py opponents results/rocket_any_orbit

Reading order: the solved targets, the laws, the comparison and its table.

- open loop flies the directions of the nearest solved optimum until the energy of the flight's own target
- LQR flies about that optimum. Its terminal cost is the error from the flight's own target, so it knows where that is
- IPOPT solves each flight's own target, and flies the directions of the optimum

The nearest solved target is the one whose orbit has the smallest `terminal_error` from the flight's target.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from common.checkpoints import read_checkpoint
from common.files import write_json
from common.flying import fly_until_ended
from common.policies import competitors, fly_by_script
from common.tables import lines_of
from rocket import guidance
from rocket.any_orbit import masses, solve_targets, target_masses
from rocket.comparison import recorded_flights
from rocket.metrics import AT_ONCE, fly_batches, inside_box, targets_of
from rocket.missions import ROCKETS, Mission
from rocket.orbits import specific_energy, target_orbit, terminal_error
from rocket.rescue import Failing
from rocket.targets import ELEMENTS, elements_of
from rocket.vehicle import Rocket

PROCESSES = 2  # that solve
SIZES = (10, 100, 1000)  # of the sets of solved targets
LARGEST_TILT = 0.3  # rad, three times that of an LQR to its own target, because the end lies elsewhere
SOLVED_SEED = 2**31 + 1  # of the solved targets, which no evaluation flies


# ---------------------------------------------------------------------------------------------------------------------
# Solved targets
# ---------------------------------------------------------------------------------------------------------------------


class Flights(NamedTuple):
    """The optima of K targets, flown by the environment. They fly on after their ends, so that others can end later."""

    targets: np.ndarray  # (K, 5)
    u: np.ndarray  # (K, T, 3)
    y: np.ndarray  # (K, T+1, 7), the last state repeated after it
    steps: np.ndarray  # (K,) the number of steps of each


def flown_optima(env_id: str, targets: np.ndarray, optima: list) -> Flights:
    """The flights of the optima that were found, among those of targets (K, 5).

    After an optimum's end its last direction is held, up to an energy above that of all targets of the range.
    """
    found = [k for k, optimum in enumerate(optima) if optimum]
    targets = targets[found]
    mission = ROCKETS[env_id]
    times = guidance.middles(mission.rocket)
    u = np.stack([guidance.directions_at(optima[k], times) for k in found])  # (K, steps, 3)
    beyond = targets.copy()
    beyond[:, 0] = 1.1 * mission.ranges.corners(mission.rocket)[:, 0].max()
    beyond[:, 1] = 1 - targets[:, 0] * (1 - targets[:, 1]) / beyond[:, 0]  # the same perigee
    batch: Any = gym.make_vec(env_id, num_envs=len(found))
    obs, _ = batch.reset(options={"target": beyond})
    y, flew = [batch.y.T.copy()], []

    def record(step):
        flew.append(step.flew)
        y.append(np.where(step.flew[:, None], batch.y.T, y[-1]))

    fly_until_ended(batch, lambda obs, step: u[:, step], obs, record)
    return Flights(targets, u[:, : len(flew)], np.stack(y, axis=1), np.sum(flew, axis=0))


def nearest(solved: np.ndarray, targets: np.ndarray, rocket: Rocket) -> np.ndarray:
    """The indices (n,) of the solved targets (K, 5) that are nearest to targets (n, 5)."""
    h, e = target_orbit(elements_of(solved), rocket.mu)
    h_target, e_target = target_orbit(elements_of(targets), rocket.mu)
    of_momentum = (h - h_target[:, None]) / np.linalg.norm(h_target, axis=1)[:, None, None]
    of_eccentricity = e - e_target[:, None]
    return ((of_momentum**2).sum(axis=-1) + (of_eccentricity**2).sum(axis=-1)).argmin(axis=1)


# ---------------------------------------------------------------------------------------------------------------------
# The laws
# ---------------------------------------------------------------------------------------------------------------------


def open_loops(flights: Flights, chosen: np.ndarray):
    """The law that flies each of m flights by the directions of the `chosen` (m,) solved flights."""

    def policy(obs, t):
        return flights.u[chosen, min(t, flights.u.shape[1] - 1)]

    return policy


class Linear(NamedTuple):
    """A solved flight, linearised: what LQR about it needs, whatever its target."""

    y: np.ndarray  # (K+1, 7)
    u: np.ndarray  # (K, 3)
    axes: np.ndarray  # (K, 2, 3)
    A: np.ndarray  # (K, 6, 6)
    B: np.ndarray  # (K, 6, 2)
    ignition: int  # the step in which the last burn begins
    energy: np.ndarray  # (K+1 - ignition,) J/kg from the ignition on, without the falls that rounding makes


def linear(mission: Mission, flights: Flights, k: int) -> Linear:
    """Flight k, linearised."""
    steps = flights.steps[k]
    u, y = flights.u[k, :steps], flights.y[k, : steps + 1]
    axes = guidance.normal_axes(u)
    A, B = guidance.linearise_flight(mission, {"t": mission.rocket.dt * np.arange(steps + 1), "u": u, "y": y}, axes)
    ignition = int(np.ceil(mission.rocket.ignitions[-1] / mission.rocket.dt))
    energy = np.maximum.accumulate(specific_energy(y[ignition:].T, mission.rocket.mu))
    return Linear(y, u, axes, A, B, ignition, energy)


def gains_to(mission: Mission, about: Linear, target: np.ndarray):
    """Gains G (K, 2, 6) and turns F (K, 2) of da_k = -G_k dx_k - F_k, by the backward Riccati recursion.

    They minimise |C x + d|^2 + sum of R dt |da|^2, as `guidance.lqr_gains`, where d is the terminal error from `target`
    (5,) with which the flight itself passes the target's energy. So the value is x^T P x + 2 s^T x.
    """
    rocket = replace(mission.rocket, **dict(zip(ELEMENTS, map(float, target))))
    dt = rocket.dt
    place = np.interp(rocket.target_energy, about.energy, np.arange(about.ignition, len(about.y)))
    steps = min(int(np.ceil(place)), len(about.u))
    before, after = about.y[steps - 1], about.y[steps]
    end = before + (place - (steps - 1)) * (after - before)
    C = guidance.cutoff_jacobian(rocket, end, (after - before)[:6] / dt)
    P, s = C.T @ C, C.T @ terminal_error(end, rocket)
    gains, turns = np.empty((steps, 2, 6)), np.empty((steps, 2))
    for k in reversed(range(steps)):
        A, B = about.A[k], about.B[k]
        inverse = np.linalg.inv(guidance.STEERING_WEIGHT * dt * np.eye(2) + B.T @ P @ B)
        gains[k] = inverse @ B.T @ P @ A
        turns[k] = inverse @ B.T @ s
        closed = A - B @ gains[k]
        P = A.T @ P @ closed
        P = (P + P.T) / 2
        s = closed.T @ s
    gains[-1], turns[-1] = gains[-2], turns[-2]  # the last step is cut short
    return gains, turns


class NearestLQR:
    """The law that flies each of m flights by an LQR about its chosen flight, to its own target.

    It follows the chosen flight by time, and from the last ignition on by the specific energy.
    """

    def __init__(self, mission: Mission, flights: Flights, chosen: np.ndarray, targets: np.ndarray):
        self.mission = mission
        self.about = {k: linear(mission, flights, k) for k in np.unique(chosen)}
        self.chosen = chosen
        laws = [gains_to(mission, self.about[k], target) for k, target in zip(chosen, targets)]
        self.last = np.array([len(turns) - 1 for _, turns in laws])
        longest = self.last.max() + 1
        self.gains = np.stack([np.pad(gains, ((0, longest - len(gains)), (0, 0), (0, 0))) for gains, _ in laws])
        self.turns = np.stack([np.pad(turns, ((0, longest - len(turns)), (0, 0))) for _, turns in laws])
        self.phi_last = min(len(mission.rocket.burns) - 1, 1)

    def __call__(self, obs, t):
        actions = np.empty((len(obs), 3))
        for k, about in self.about.items():
            mine = np.flatnonzero(self.chosen == k)
            actions[mine] = self.fly(about, obs[mine], mine, t)
        return actions

    def fly(self, about: Linear, obs, flights, t):
        """The directions (m, 3) of flights with the same chosen one."""
        count = len(about.u)
        place = np.full(len(obs), min(t, count - 1.0))  # along the chosen flight, in its steps
        places = np.arange(about.ignition, len(about.y))
        now = np.interp(specific_energy(obs.T, self.mission.rocket.mu), about.energy, places)
        place = np.where(obs[:, 8] >= self.phi_last, now, place)
        step = np.minimum(place.astype(int), count - 1)
        part = (place - step)[:, None]
        near = np.minimum(np.rint(place).astype(int), count - 1)
        dx = obs[:, :6] - (1 - part) * about.y[step, :6] - part * about.y[step + 1, :6]
        own = np.minimum(near, self.last[flights])
        angles = np.einsum("mai,mi->ma", self.gains[flights, own], dx) + self.turns[flights, own]
        return guidance.turned(about.u[near], about.axes[near], -angles.clip(-LARGEST_TILT, LARGEST_TILT))


# ---------------------------------------------------------------------------------------------------------------------
# Policies and opponents to the same targets
# ---------------------------------------------------------------------------------------------------------------------


def ended(ends: dict, best: np.ndarray, rocket: Rocket) -> dict:
    """The numbers of a competitor's flights: errors, share in the box, and mass over the optimum's `best` (s,) kg."""
    errors = np.linalg.norm(ends["error"], axis=1)
    ratio = (ends["final_mass_kg"][: len(best)] / best[: len(errors)])[errors[: len(best)] < 0.01]
    numbers = {f"error_{name}": np.percentile(errors, p) for name, p in (("median", 50), ("p95", 95), ("max", 100))}
    numbers |= {"box_rate": inside_box(ends, rocket).mean(), "flights": len(errors)}
    if len(ratio):
        numbers["mass_ratio_mean"] = np.nanmean(ratio)
    return {key: float(value) for key, value in numbers.items()}


class Opponents:
    """The laws that know K solved targets, flown to the n targets of a seed."""

    def __init__(self, env_id: str, eval_seed: int, n: int, sizes=SIZES):
        self.env_id = env_id
        self.mission = ROCKETS[env_id]
        self.targets = targets_of(self.mission, eval_seed, n)
        solved = targets_of(self.mission, SOLVED_SEED, max(sizes))
        began = time.perf_counter()
        optima = solve_targets(env_id, self.mission, solved, PROCESSES)
        self.seconds_each = (time.perf_counter() - began) * PROCESSES / len(solved)
        self.flights = flown_optima(env_id, solved, optima)

    def first(self, size: int) -> Flights:
        """The first `size` solved flights."""
        return Flights(*(values[:size] for values in self.flights))

    def fly(self, size: int, law: str) -> dict:
        """The ends of all flights by `law`, "open loop" or "LQR", about the nearest of the first `size` targets."""
        flights = self.first(size)
        parts = []
        for first in range(0, len(self.targets), AT_ONCE):
            targets = self.targets[first : first + AT_ONCE]
            chosen = nearest(flights.targets, targets, self.mission.rocket)
            fly = open_loops(flights, chosen)
            if law == "LQR":
                fly = NearestLQR(self.mission, flights, chosen, targets)
            parts.append(fly_batches(self.env_id, fly, 0, {"target": targets}))
        return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def fly_own_optima(env_id: str, targets: np.ndarray) -> tuple[dict, np.ndarray, float]:
    """The ends of flights by their own optima, open loop, the optima's masses (kg), and the seconds of one solve."""
    mission = ROCKETS[env_id]
    began = time.perf_counter()
    optima = solve_targets(env_id, mission, targets, PROCESSES)
    seconds = (time.perf_counter() - began) * PROCESSES / len(targets)
    fly = guidance.fly_optima(env_id, optima)
    return fly_batches(env_id, fly, 0, {"target": targets}, at_once=len(targets)), masses(optima), seconds


def compare_targets(env_id: str, folder: Path, n: int, solved: int, eval_seed: int, also=()):
    """Compare a results folder's policy, and those of `also` (name, path), with the laws that know solved targets.

    Prints the table and writes opponents.json. Raises OSError or ValueError for bad input.
    """
    script = Path(__file__).parents[1] / "ppo_gtrxl_rocket.py"
    rocket = ROCKETS[env_id].rocket
    checkpoints = competitors(env_id, folder, also, {})
    best = target_masses(env_id, ROCKETS[env_id], eval_seed, min(solved, n))
    report = {"env_id": env_id, "eval_seed": eval_seed, "laws": {}}
    for name, path in checkpoints.items():
        metrics, arrays = fly_by_script(script, path, {"eval_starts": n, "eval_seed": eval_seed})
        ends = recorded_flights(arrays, rocket, Failing()) | {"error": arrays["final_error"]}
        about = {"seconds_before": read_checkpoint(path)["counters"]["wall_seconds"], "solved": 0}
        report["laws"][name] = about | ended(ends, best, rocket)
    opponents = Opponents(env_id, eval_seed, n)
    for size in SIZES:
        for law in ("open loop", "LQR"):
            about = {"seconds_before": size * opponents.seconds_each, "solved": size}
            report["laws"][f"{law}, nearest of {size}"] = about | ended(opponents.fly(size, law), best, rocket)
    ends, own_best, seconds = fly_own_optima(env_id, opponents.targets[:solved])
    report["laws"]["IPOPT for each"] = {"seconds_each": seconds, "solved": solved} | ended(ends, own_best, rocket)
    write_json(folder / "opponents.json", report)
    print(opponents_table(report))


def opponents_table(report: dict) -> str:
    """opponents.json as a table: a line for each competitor."""
    rows: list[tuple[str, ...]] = [
        ("", "flights", "median", "p95", "worst", "in the box", "mass", "solves", "s before", "s each")
    ]
    for name, row in report["laws"].items():
        errors = [f"{row[f'error_{part}']:.6f}" for part in ("median", "p95", "max")]
        mass = f"{row['mass_ratio_mean']:.4%}" if "mass_ratio_mean" in row else "-"
        seconds = [f"{row[key]:.2f}" if key in row else "-" for key in ("seconds_before", "seconds_each")]
        rows.append(
            (name, f"{row['flights']:.0f}", *errors, f"{row['box_rate']:.2%}", mass, str(row["solved"]), *seconds)
        )
    about = f"{report['env_id']}: the targets of eval seed {report['eval_seed']}, nominal vehicles; ||error||"
    below = (
        "  mass: mean of the optimum's, of the flights with an error below 0.01. s before: of one core, the policy's"
    )
    return "\n".join([about, *lines_of(rows), below, "  training or the K solves."])
