"""Classical guidance on dispersed flights, and the optimum that knows each draw: a policy's opponents.

    open_loop        the optimum's directions
    tvlqr            time-varying LQR about the optimum
    Replanning       open loop through the air, then IPOPT from the measured state, every 20 s: with the nominal model,
                     or with the thrust and flow that the last step's change of velocity shows
    drawn_optima     the optimum of each flight's own vehicle and air: an upper bound on the mass, not a guidance law

A guidance law is a function policy(obs (m, obs), t) -> actions (m, 3), directions in ECI. `evaluate_dispersed` flies it
with `action_frame="eci"`. A law sees what a policy sees: r and v, the flight computer's mass, time and phase, but never
the draw. With navigation noise it sees the same noise as a policy, or estimates (`kalman.py`). `comparison.py` flies,
compares and prints the laws.

Reading order: open loop, LQR, the program of the remaining ascent, the measured engine, replanning, the optimum that
knows the draw. CasADi is imported only where it solves.
"""

from __future__ import annotations

import time
from functools import cache
from typing import NamedTuple

import numpy as np

from common.errors import NoOptimum
from common.ipopt import interruptible
from common.workers import Workers
from rocket.dispersion import Vehicles, arc_masses, draw_vehicles, nominal_vehicles
from rocket.dynamics import ascent_dynamics
from rocket.flight import Fleet, fly_step, steps_at, steps_until, unit_directions
from rocket.missions import ROCKETS, Mission
from rocket.optimum import (
    GAUSS_POINTS,
    MAX_ITERATIONS,
    box_of,
    collocation,
    interpolate,
    kept_reference,
    orbit_defect,
    state_scale,
)
from rocket.orbits import orbit_vectors, specific_energy, target_axes, target_orbit, terminal_error
from rocket.vehicle import Rocket

# ---------------------------------------------------------------------------------------------------------------------
# Open loop
# ---------------------------------------------------------------------------------------------------------------------


def nominal_optimum(env_id: str) -> dict:
    """The optimum of the nominal vehicle as the environment flies it: t, u, y and more."""
    return kept_reference(env_id, ROCKETS[env_id])


def open_loop(env_id: str):
    """The law that flies the optimum's directions in ECI by time, and holds the last one in a longer flight."""
    u = nominal_optimum(env_id)["u"]

    def policy(obs, t):
        return np.repeat(u[None, min(t, len(u) - 1)], len(obs), axis=0)

    return policy


# ---------------------------------------------------------------------------------------------------------------------
# Time-varying LQR about the optimum
# ---------------------------------------------------------------------------------------------------------------------

STEERING_WEIGHT = 1e-8  # R, the cost of a radian of steering for a second, in squares of the terminal error
LARGEST_TILT = 0.1  # rad, the most that each of the two angles may turn a direction from the optimum's


def turned(u, axes, angles):
    """The directions u (m, 3) turned by angles (m, 2) rad towards axes (m, 2, 3), which are at right angles to u."""
    w = u + (np.tan(angles)[..., None] * axes).sum(axis=-2)
    return w / np.linalg.norm(w, axis=1, keepdims=True)


def normal_axes(u):
    """Two unit vectors at right angles to each direction u (K, 3) and to each other, (K, 2, 3)."""
    smallest = np.eye(3)[np.abs(u).argmin(axis=1)]
    first = np.cross(u, smallest)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(u, first)], axis=1)


def linearise_flight(mission: Mission, flight: dict, axes):
    """A (K, 6, 6) and B (K, 6, 2) of dx_{k+1} = A_k dx_k + B_k da_k along a flight, for the environment's own steps.

    x is r (m) and v (m/s). a are the two angles (rad) towards axes (K, 2, 3). The derivatives are central differences
    of the nominal vehicle's steps with their events. The 16 neighbours of a state fly together.
    """
    h = np.repeat([10.0, 0.01, 1e-4], [3, 3, 2])
    shifts = np.concatenate([np.diag(h), -np.diag(h)])  # (16, 8)
    dt = mission.rocket.dt
    fleet = Fleet(mission.rocket, nominal_vehicles(mission.rocket, len(shifts)), has_own_air=False)
    latest = np.full(len(shifts), flight["t"][-1])
    count = steps_until(latest, dt)
    jacobians = []
    for k, (y, u) in enumerate(zip(flight["y"], flight["u"])):
        steps = steps_at(k, fleet.vehicles, latest, count, dt)
        y_near = y[:, None] + np.pad(shifts[:, :6], ((0, 0), (0, 1))).T
        u_near = unit_directions(turned(u, axes[k], shifts[:, 6:]))
        y_next = fly_step(fleet, y_near, u_near, steps, steps.end - steps.begin)
        ahead, behind = y_next[:6, :8], y_next[:6, 8:]
        jacobians.append((ahead - behind) / (2 * h))
    AB = np.array(jacobians)
    return AB[..., :6], AB[..., 6:]


def error_jacobian(rocket: Rocket, y):
    """Derivatives of the terminal error (6, 6) and of the specific energy (6,) by r, v of a state y (7,)."""
    h = np.repeat([10.0, 0.01], 3)
    states = y[:6] + np.concatenate([np.diag(h), -np.diag(h)])
    values = np.column_stack([terminal_error(states, rocket), specific_energy(states.T, rocket.mu)])  # (12, 7)
    *error, energy = ((values[:6] - values[6:]) / (2 * h[:, None])).T
    return np.array(error), energy


def cutoff_jacobian(rocket: Rocket, y, rate):
    """Derivative (6, 6) of the terminal error at the cut-off by r, v of a state y (7,) that moves at `rate` (6,).

    The engine stops at the target's energy, which is dt = -E_x dx / (E_x rate) later than planned. So a state that is
    ahead or behind on the trajectory costs nothing. Only a state beside the trajectory does.
    """
    error, energy = error_jacobian(rocket, y)
    return error @ (np.eye(6) - np.outer(rate, energy) / (energy @ rate))


def lqr_gains(mission: Mission, flight: dict):
    """Gains G_k (K, 2, 6) of da_k = -G_k dx_k and the axes (K, 2, 3) of the angles, by the backward Riccati recursion.

    They minimise |terminal error|^2 + sum of R dt |da|^2 along the linearised flight (e.g. Anderson and Moore, Optimal
    Control, 1990). The terminal error is that at the cut-off, or at the fixed time. States on the way have no weight,
    because only the end counts. The mass has none either. Near the heaviest flight it depends on the steering only in
    second order, which R keeps small.
    """
    axes = normal_axes(flight["u"])
    A, B = linearise_flight(mission, flight, axes)
    last = flight["y"][-2:]
    dt = np.diff(flight["t"])
    if mission.cutoff:
        C = cutoff_jacobian(mission.rocket, last[1], (last[1] - last[0])[:6] / dt[-1])
    else:
        C, _ = error_jacobian(mission.rocket, last[1])
    P = C.T @ C
    gains = np.empty((len(B), 2, 6))
    for k in reversed(range(len(B))):
        gains[k] = np.linalg.solve(STEERING_WEIGHT * dt[k] * np.eye(2) + B[k].T @ P @ B[k], B[k].T @ P @ A[k])
        P = A[k].T @ P @ (A[k] - B[k] @ gains[k])
        P = (P + P.T) / 2
    return gains, axes


class Tracked(NamedTuple):
    """A flight of K steps, and what LQR needs to track it."""

    y: np.ndarray  # (K+1, 7)
    u: np.ndarray  # (K, 3)
    gains: np.ndarray  # (K, 2, 6)
    axes: np.ndarray  # (K, 2, 3)
    ignition: int  # the step in which the last burn begins
    energy: np.ndarray  # (K+1 - ignition,) J/kg from the ignition on, without the falls that rounding makes


def tracked(mission: Mission, flight: dict) -> Tracked:
    """A flight (t, u, y) of a mission with its gains."""
    gains, axes = lqr_gains(mission, flight)
    y, u = flight["y"], flight["u"]
    # the last step is cut short, so its own gain is far too large for a whole step
    gains[-1] = gains[-2]
    axes[-1] = axes[-2]
    ignition = int(np.searchsorted(flight["t"], mission.rocket.ignitions[-1]))
    energy = np.maximum.accumulate(specific_energy(y[ignition:].T, mission.rocket.mu))
    return Tracked(y, u, gains, axes, ignition, energy)


def tvlqr(env_id: str, by_energy: bool = False):
    """The law of an LQR about the optimum, by time, or from the last ignition on by the specific energy (`by_energy`).

    By time, the last direction and the last whole step's gain are held from the optimum's end until the cut-off. By
    energy, a flight is compared with the optimum's state of the same energy. The energy grows all through the last
    burn, so the last gain comes with the cut-off, whenever that is.

    We chose R and the tilt on 341 draws of eval seed 1, which are not the reported ones. A tilt of 0.3 rad gave the
    same errors. Median ||error|| by R:

        R       by time   by energy
        1e-7    2.5e-5    1.8e-5
        1e-8    1.7e-5    1.4e-5
        1e-9    1.9e-5    1.3e-5 (a greater p95)
    """
    mission = ROCKETS[env_id]
    y, u, gains, axes, ignition, energy = tracked(mission, nominal_optimum(env_id))
    phi_last = min(len(mission.rocket.burns) - 1, 1)  # as observed in the last burn

    def policy(obs, t):
        place = np.full(len(obs), min(t, len(u) - 1.0))  # along the optimum, in its steps
        if by_energy:
            now = np.interp(specific_energy(obs.T, mission.rocket.mu), energy, np.arange(ignition, len(y)))
            place = np.where(obs[:, 8] >= phi_last, now, place)
        step = np.minimum(place.astype(int), len(u) - 1)
        part = (place - step)[:, None]
        nearest = np.minimum(np.rint(place).astype(int), len(u) - 1)
        dx = obs[:, :6] - (1 - part) * y[step, :6] - part * y[step + 1, :6]
        angles = -np.einsum("mai,mi->ma", gains[nearest], dx).clip(-LARGEST_TILT, LARGEST_TILT)
        return turned(u[nearest], axes[nearest], angles)

    return policy


# ---------------------------------------------------------------------------------------------------------------------
# The remaining ascent, from any state in any vehicle and air: one nonlinear program, built once
# ---------------------------------------------------------------------------------------------------------------------

CALM = (1.0, 0.0, 0.0)  # nominal air: factor on the drag, wind towards east and north in m/s


class RemainingAscent(NamedTuple):
    """What is left of an ascent, in A arcs as in `Rocket.arcs`."""

    begin: float  # s
    state: np.ndarray  # (6,) r (m) and v (m/s) at the begin
    end: np.ndarray  # (A,) s; the last arc may end earlier
    thrust: np.ndarray  # (A,) N
    flow: np.ndarray  # (A,) kg/s
    mass: np.ndarray  # (A,) kg at each arc's begin
    h: np.ndarray  # (3,) m^2/s, angular momentum of the orbit to be reached
    e: np.ndarray  # (3,) eccentricity vector of this orbit
    air: tuple[float, float, float] = CALM
    axes: np.ndarray | None = None  # (2, 3) in the orbit's plane; without it those of the rocket's own target


@cache
def remaining_solver(rocket: Rocket, fixed: int, last: int):
    """IPOPT for `fixed` intervals with known ends and `last` intervals of the last arc, whose duration is unknown.

    The program is that of `optimum.ascent_program` with free final time, but its numbers are parameters. The rocket
    only gives the Earth and the drag's area.
    """
    import casadi as ca

    ca.GlobalOptions.setNumpyMode(1)  # as in ascent_program
    n = fixed + last
    points = len(GAUSS_POINTS)
    scale = ca.DM(state_scale(rocket))
    x = ca.MX.sym("x", 6, n)
    z = ca.MX.sym("z", 6, n * points)
    u = ca.MX.sym("u", 3, n * points)
    duration = ca.MX.sym("duration")
    start = ca.MX.sym("start", 6)
    engine = ca.MX.sym("engine", 4, fixed)
    burn, air, h, e = (ca.MX.sym(name, 3) for name in ("burn", "air", "h", "e"))
    mass, thrust, flow = ca.vertsplit(burn)
    dt, one = duration / last, ca.DM.ones(1, last)
    rows = ca.vertcat(mass - flow * dt * ca.DM(range(last)).T, thrust * one, flow * one, dt * one)
    parameters = ca.vertcat(ca.horzcat(engine, rows), ca.repmat(air, 1, n))
    defects, ends = collocation(rocket, in_wind=True).map(n)(ca.horzcat(start, x[:, :-1]), z, u, parameters)
    axes = ca.MX.sym("axes", 2, 3)
    orbit = orbit_defect(rocket, scale * x[:, -1], h, e, axes)
    constraints = ca.veccat(defects, x - ends, ca.sum1(u**2) - 1, orbit, ca.sqrt(ca.sum1(x[:3, :] ** 2)))
    program = {"x": ca.veccat(x, z, u, duration), "p": ca.veccat(start, engine, burn, air, h, e, axes)}
    program |= {"f": duration / (scale[0] / scale[3]), "g": constraints}
    options = {"expand": True, "print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-9}
    options |= {"ipopt.max_iter": MAX_ITERATIONS, "show_eval_warnings": False}
    return ca.nlpsol("remaining", "ipopt", program, options)


def remaining_grid(remaining: RemainingAscent, intervals, end: float):
    """Ends of the intervals (n+1,) and times of the directions (n * points,), in s, of an ascent that ends at `end`."""
    edges = [remaining.begin, *remaining.end[:-1], end]
    pieces = (np.linspace(a, b, k + 1)[1:] for a, b, k in zip(edges, edges[1:], intervals))
    t = np.concatenate([[remaining.begin], *pieces])
    return t, (t[:-1, None] + np.diff(t)[:, None] * GAUSS_POINTS).ravel()


def remaining_parameters(rocket: Rocket, remaining: RemainingAscent, intervals) -> np.ndarray:
    """The parameters of `remaining_solver`, in its order."""
    fixed = sum(intervals[:-1])
    t, _ = remaining_grid(remaining, intervals, remaining.end[-1])
    arc = np.repeat(np.arange(len(intervals)), intervals)
    mass = remaining.mass[arc] - remaining.flow[arc] * (t[:-1] - np.append(remaining.begin, remaining.end)[arc])
    engine = np.array([mass, remaining.thrust[arc], remaining.flow[arc], np.diff(t)])[:, :fixed]
    start = remaining.state / state_scale(rocket)
    start[3] += 1e-16  # as in ascent_program
    burn = remaining.mass[-1], remaining.thrust[-1], remaining.flow[-1]
    axes = target_axes(rocket)[:2] if remaining.axes is None else remaining.axes
    return np.concatenate([start, engine.T.ravel(), burn, remaining.air, remaining.h, remaining.e, axes.T.ravel()])


@interruptible()
def optimise_remaining(rocket: Rocket, remaining: RemainingAscent, guess: dict, intervals: tuple[int, ...]) -> dict:
    """The optimum of a remaining ascent, which ends with the most mass.

    `intervals` are the numbers of collocation intervals in the arcs. The guess has t (s), y (r, v), t_u (s) and u. The
    optimum has the same, and `final_time` (s), `final_mass` (kg) and `orbit_price` (5,): the kg that a unit of each
    number of `orbit_defect` saves. Raises NoOptimum if IPOPT finds none.
    """
    n = sum(intervals)
    points = len(GAUSS_POINTS)
    scale = state_scale(rocket)
    solve = remaining_solver(rocket, sum(intervals[:-1]), intervals[-1])
    ignition = np.append(remaining.begin, remaining.end)[-2]  # s, when the last arc begins
    if not remaining.end[-1] > ignition:  # a flow that is measured in dense air can even be negative
        raise NoOptimum(f"the remaining ascent from {remaining.begin} s: nothing is left to burn")
    t, t_u = remaining_grid(remaining, intervals, guess["t"][-1])
    states = interpolate(np.append(t[1:], t_u), guess["t"], guess["y"]) / scale
    directions = interpolate(t_u, guess["t_u"], guess["u"])
    w = np.concatenate([states.ravel(), directions.ravel(), [t[-1] - ignition]])
    box = box_of(rocket, n * (1 + points), len(t_u))
    equal = np.zeros(n * (7 * points + 6) + 5)
    radius = np.full(n, 1 + 1 / rocket.Re)
    bounds = {"lbx": np.append(-box, 0.0), "ubx": np.append(box, remaining.end[-1] - ignition)}
    bounds |= {"lbg": np.append(equal, radius), "ubg": np.append(equal, np.full(n, np.inf))}
    solution = solve(x0=w, p=remaining_parameters(rocket, remaining, intervals), **bounds)
    status = solve.stats()["return_status"]
    if status != "Solve_Succeeded":
        raise NoOptimum(f"the remaining ascent from {remaining.begin} s: IPOPT stopped with {status}")
    w = solution["x"].full()[:, 0]
    end = ignition + w[-1]
    t, t_u = remaining_grid(remaining, intervals, end)
    times = np.append(t[1:], t_u)
    states = w[: 6 * n * (1 + points)].reshape(-1, 6) * scale
    order = np.argsort(times)
    found = {"t": np.append(remaining.begin, times[order]), "y": np.vstack([remaining.state, states[order]])}
    found |= {"t_u": t_u, "u": w[6 * n * (1 + points) : -1].reshape(-1, 3), "status": status}
    seconds = scale[0] / scale[3]  # the program's unit of time
    price = remaining.flow[-1] * seconds * solution["lam_g"].full()[len(equal) - 5 : len(equal), 0]
    found |= {"final_time": end, "orbit_price": price}
    return found | {"final_mass": remaining.mass[-1] - remaining.flow[-1] * w[-1]}


# ---------------------------------------------------------------------------------------------------------------------
# The engine that plans are made with: the nominal one, or the one that the last step's change of velocity shows
# ---------------------------------------------------------------------------------------------------------------------


def nominal_exhaust(rocket: Rocket) -> float:
    """The exhaust velocity of the last burn in m/s, thrust over flow."""
    burn = rocket.burns[-1]
    return burn.thrust / burn.flow(rocket.table_isp)


def drawn_exhaust(rocket: Rocket, dispersion: float, z) -> np.ndarray:
    """The last burn's exhaust velocities (n,) in m/s for the draws z (n, k). No flight could know them."""
    vehicles = draw_vehicles(rocket, dispersion, z)
    last = len(rocket.burns) - 1
    return vehicles.thrust[last] / vehicles.flow[last]


def engine_off(rocket: Rocket, y) -> np.ndarray:
    """The acceleration (n, 3) of gravity and nominal drag alone at states y (n, 7) of r, v and m."""
    return np.array(ascent_dynamics(y.T, np.zeros(5), rocket)[3:6]).T


class NominalEngine:
    """Mass (kg), thrust (N) and flow (kg/s) of n last stages, (n,) each.

    Thrust and flow are the table's, the mass is the flight computer's.
    """

    def __init__(self, rocket: Rocket, n: int):
        burn = rocket.burns[-1]
        self.rocket = rocket
        self.mass = np.zeros(n)
        self.thrust = np.full(n, burn.thrust)
        self.flow = np.full(n, burn.flow(rocket.table_isp))

    def update(self, obs, u, is_lit):
        """Go a step on: to obs (n, 9), after the directions u (n, 3). is_lit (n,) says whether the last burn is on."""
        self.mass = obs[:, 6]


class MeasuredEngine(NominalEngine):
    """Mass, thrust and flow of n last stages by measurement: the velocity that a stage gained shows what it burnt.

    In a step of the last burn gravity and drag change the velocity. The engine adds exhaust ln(m before / m after)
    along the direction flown (Tsiolkovsky). So the ratio of the masses, flow over mass and thrust over mass follow from
    r, v and the exhaust velocity (m/s, one or (n,)). The drag is the nominal one, which is small where the last stage
    is lit.

    The first mass of the burn is the flight computer's, because nothing measures it. Its error makes thrust and flow
    wrong in the same proportion. The directions of a plan do not depend on this, only on the ratios to the mass.
    """

    def __init__(self, rocket: Rocket, exhaust, n: int):
        super().__init__(rocket, n)
        self.exhaust = np.broadcast_to(exhaust, n)
        self.y = np.zeros((n, 7))  # the states a step ago
        self.was_lit = np.zeros(n, dtype=bool)

    def update(self, obs, u, is_lit):
        self.mass = np.where(self.was_lit, self.mass, obs[:, 6])
        y = np.column_stack([obs[:, :6], self.mass])
        whole = is_lit & self.was_lit
        if whole.any():
            gain = ((y - self.y)[:, 3:6] - self._fall(y)) * u
            left = np.exp(-gain.sum(axis=1) / self.exhaust)  # of the mass
            burnt = np.where(whole, self.mass * (1 - left), 0.0)
            self.mass = self.mass - burnt
            self.flow = np.where(whole, burnt / self.rocket.dt, self.flow)
            self.thrust = np.where(whole, self.flow * self.exhaust, self.thrust)
        self.y, self.was_lit = y, is_lit

    def _fall(self, y) -> np.ndarray:
        """The velocity (n, 3) in m/s that gravity and drag added in the last step, by Simpson's rule."""
        dt = self.rocket.dt
        middle = (self.y + y) / 2
        middle[:, :3] += (self.y - y)[:, 3:6] * dt / 8  # of the cubic through r and v at both ends
        begin, between, end = (engine_off(self.rocket, state) for state in (self.y, middle, y))
        return dt / 6 * (begin + 4 * between + end)


# ---------------------------------------------------------------------------------------------------------------------
# Replanning: closed-loop explicit guidance
# ---------------------------------------------------------------------------------------------------------------------

REPLAN_EVERY = 20.0  # s
LAST_REPLAN = 20.0  # s before the planned cut-off, after which the last plan is flown open loop
CHANGE = 0.03  # relative change of the measured flow that is replanned at once, more than any drawn engine differs by
SURE = 6.0  # standard deviations of the noise that are no such change
SHORTEST = 4.0  # s, the shortest such plan, which has two held directions
LONGEST = 3.0  # the length of the table of directions, in nominal flights; an engine may have lost half of its thrust
REPLAN_INTERVALS = 8  # collocation intervals; 12 change the final mass by less than 1e-7 kg


def optimum_guess(env_id: str) -> dict:
    """The nominal optimum as a guess of `optimise_remaining`."""
    return guess_of(nominal_optimum(env_id))


def guess_of(flight: dict) -> dict:
    """A flight of `fly_rocket` as a guess of `optimise_remaining`."""
    middle = (flight["t"][:-1] + flight["t"][1:]) / 2
    return {"t": flight["t"], "y": flight["y"][:, :6], "t_u": middle, "u": flight["u"]}


def middles(rocket: Rocket):
    """The middles (s) of the steps of `LONGEST` nominal flights, because some vehicles burn longer."""
    return rocket.dt * (np.arange(np.ceil(LONGEST * rocket.end_time / rocket.dt)) + 0.5)


def directions_at(plan: dict, times):
    """A plan's directions (m, 3) at `times` (m,) in s. After its end they stay as they are there."""
    from scipy.interpolate import CubicSpline

    return CubicSpline(plan["t_u"], plan["u"])(np.minimum(times, plan["final_time"]))


def replan_one(job):
    """The plan of one flight, or None if IPOPT finds none, and the seconds that it took on one core.

    job is (rocket, remaining ascent, guess).
    """
    rocket, remaining, guess = job
    remaining_solver(rocket, 0, REPLAN_INTERVALS)  # built before the clock runs
    begin = time.process_time()
    try:
        plan = optimise_remaining(rocket, remaining, guess, (REPLAN_INTERVALS,))
    except NoOptimum:
        plan = None
    return plan, time.process_time() - begin


class Replanning:
    """The law that launchers fly: open loop until the last stage is lit, then explicit guidance.

    Every `REPLAN_EVERY` seconds the remaining ascent to the target orbit is solved again from the observed r and v, for
    the least propellant. Its directions are flown until the next plan, and those of the last plan until the cut-off. If
    IPOPT fails, the last plan is kept.

    Without `exhaust` the plans have the nominal engine and the flight computer's mass. With an `exhaust` velocity (m/s,
    one or one a flight) they have the thrust, flow and mass of `MeasuredEngine`. Launchers correct their engine's
    numbers by the measured acceleration in the same way. The last burn then ends at the latest when the propellant is
    burnt at the measured flow. If that flow differs from the plan's by `CHANGE`, an engine has failed, and the flight
    is replanned at once. Navigation noise of `velocity_noise` (m/s) disturbs the measured flow. A difference that this
    noise makes once in a billion steps counts as no failure.

    With a law `before`, that law flies until the first plan instead of the open loop.

    `processes` share the solves, which changes only the time. `failed` counts the solves without a plan. `seconds` has
    one number for each solve.

    On 60 draws of eval seed 1, which are not the reported ones, p95 of ||error|| with the nominal engine was:

        replanned every 20 s, until 20 s before the cut-off    0.00012
                        20 s,       30 s                       0.00014
                        20 s,       40 s                       0.00026
                        10 s,       10 s                       0.00004
                         4 s,       10 s                       0.00002
    """

    def __init__(self, env_id: str, processes: int = 1, exhaust=None, velocity_noise: float = 0.0, before=None):
        self.velocity_noise = velocity_noise
        self.before = before
        self.rocket = ROCKETS[env_id].rocket
        self.guess = optimum_guess(env_id)
        self.open_loop = open_loop(env_id)
        self.exhaust = exhaust
        self.middles = middles(self.rocket)
        self.target = target_orbit(self.rocket.target, self.rocket.mu)
        self.failed, self.seconds = 0, []
        self.workers = Workers(processes)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.workers.__exit__(*error)

    def __call__(self, obs, t):
        if t == 0:
            self.plans = [self.guess] * len(obs)
            self.ends = np.full(len(obs), self.guess["t"][-1])  # s, of the plans
            # (m, steps, 3) directions
            self.u = np.stack([self.open_loop(obs, step) for step in range(len(self.middles))], axis=1)
            self.engine = NominalEngine(self.rocket, len(obs))
            if self.exhaust is not None:
                self.engine = MeasuredEngine(self.rocket, self.exhaust, len(obs))
            self.planned_flow = self.engine.flow.copy()
            self.is_planned = np.full(len(obs), self.before is None)
            self.flown = self._planned(0)
        is_lit = obs[:, 8] >= min(len(self.rocket.burns) - 1, 1)  # the last burn
        self.engine.update(obs, self.flown, is_lit)
        left = self.ends - self.rocket.dt * t  # s, of the plans
        is_time = t % round(REPLAN_EVERY / self.rocket.dt) == 0
        gain = self.planned_flow / self.engine.mass * nominal_exhaust(self.rocket) * self.rocket.dt  # m/s in a step
        by_noise = SURE * np.sqrt(2) * self.velocity_noise / gain
        has_changed = np.abs(self.engine.flow / self.planned_flow - 1) > CHANGE + by_noise
        is_due = (is_time & (left > LAST_REPLAN)) | (has_changed & (left > SHORTEST))
        self._replan(obs, t, np.flatnonzero(is_lit & is_due))
        self.flown = self._planned(t)
        if self.before is not None:
            self.flown = np.where(self.is_planned[:, None], self.flown, self.before(obs, t))
        return self.flown

    def _planned(self, t):
        """The directions (m, 3) of step t."""
        return self.u[:, min(t, len(self.middles) - 1)]

    def _replan(self, obs, t, flights):
        """Make new plans from step t on for the chosen flights, indices of obs (m, 9)."""
        now = self.rocket.dt * t
        jobs = [(self.rocket, self._remaining_ascent(obs[k], now, k), self.plans[k]) for k in flights]
        self.planned_flow[flights] = self.engine.flow[flights]
        for k, (plan, seconds) in zip(flights, self.workers.map(replan_one, jobs)):
            self.seconds.append(seconds)
            if plan is None:
                self.failed += 1
                continue
            self.plans[k] = plan
            self.ends[k] = plan["t"][-1]
            self.is_planned[k] = True
            self.u[k, t:] = directions_at(plan, self.middles[t:])

    def _remaining_ascent(self, obs, now: float, k: int) -> RemainingAscent:
        """What is left of the last burn of flight k at `now` (s), when obs (9,) is observed."""
        mass = self.engine.mass[k]
        thrust = self.engine.thrust[k]
        flow = self.engine.flow[k]
        burn_out = now + (mass - self.rocket.dry_mass) / flow
        end, thrust, flow, mass = (np.array([value]) for value in (burn_out, thrust, flow, mass))
        return RemainingAscent(now, obs[:6], end, thrust, flow, mass, *self.target)


# ---------------------------------------------------------------------------------------------------------------------
# The optimum of each flight's own vehicle and air: it knows the draw
# ---------------------------------------------------------------------------------------------------------------------

DRAWN_SEGMENTS = 40  # collocation intervals; the nominal optimum's mass is within 1e-4 kg of that with 80


def vehicle_ascent(vehicle: Vehicles, begin: float, state, last_end: float, orbit) -> RemainingAscent:
    """What is left from `begin` (s) on of one vehicle's ascent to the orbit (h, e).

    Its last burn may go on until `last_end` (s). The vehicle's last arc, which has no thrust, is left out.
    """
    end, thrust, flow = (column[:-1, 0] for column in (vehicle.end, vehicle.thrust, vehicle.flow))
    left = end > begin
    ends = np.append(end[left][:-1], last_end)
    air = (vehicle.drag[0], vehicle.wind[0, 0], vehicle.wind[1, 0])
    h, e = orbit
    return RemainingAscent(begin, state, ends, thrust[left], flow[left], arc_masses(vehicle)[left], h, e, air)


def drawn_intervals(rocket: Rocket, end: float) -> tuple[int, ...]:
    """The number of collocation intervals in each burn of a flight that lasts until about `end` (s)."""
    ends = np.append([burn.end for burn in rocket.burns[:-1]], end)
    parts = np.diff(ends, prepend=0.0) / ends[-1]
    return tuple(max(round(DRAWN_SEGMENTS * part), 1) for part in parts)


def solve_drawn(job):
    """The optimum of one flight, or None if IPOPT finds none. job is (rocket, dispersion, z, orbit, guess)."""
    rocket, dispersion, z, orbit, guess = job
    vehicle = draw_vehicles(rocket, dispersion, np.asarray(z)[None])
    ascent = vehicle_ascent(vehicle, 0.0, rocket.x0[:6], vehicle.burn_out[0], orbit)
    intervals = drawn_intervals(rocket, guess["t"][-1])
    try:
        return optimise_remaining(rocket, ascent, guess, intervals)
    except NoOptimum:
        return None


def drawn_optima(env_id: str, dispersion: float, z, reached=None, processes: int = 1) -> list:
    """The optima that know their draws z (n, k), as `optimise_remaining` returns them; None if IPOPT finds none.

    They end on the target orbit, or on the orbits of the states `reached` (n, 6 or more). No guidance law that ends on
    such an orbit has more mass left, whatever it knows.
    """
    rocket, guess = ROCKETS[env_id].rocket, optimum_guess(env_id)
    orbits = [target_orbit(rocket.target, rocket.mu)] * len(z)
    if reached is not None:
        orbits = [np.array(orbit_vectors(y, rocket.mu)) for y in reached]
    jobs = [(rocket, dispersion, row, orbit, guess) for row, orbit in zip(z, orbits)]
    with Workers(processes) as workers:
        return workers.map(solve_drawn, jobs)


def fly_optima(env_id: str, optima: list, directions_at=directions_at):
    """The law that flies each of the m flights by its own optimum, open loop. Without one it flies the nominal optimum.

    The law knows the draws. It is flown to show that the optima's mass can be reached. `directions_at(optimum, times)`
    gives an optimum's directions.
    """
    nominal = open_loop(env_id)
    times = middles(ROCKETS[env_id].rocket)
    u = [directions_at(optimum, times) if optimum else None for optimum in optima]

    def policy(obs, t):
        actions = nominal(obs, t)
        for k, directions in enumerate(u):
            if directions is not None:
                actions[k] = directions[min(t, len(times) - 1)]
        return actions

    return policy
