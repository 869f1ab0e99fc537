"""Reference optima of the rockets: one nonlinear program, solved by IPOPT, then flown by the environment.

Reading order: the program (what is solved, its meshes, collocation, the solve), the references that the environments
fly. CasADi and SciPy are imported only where they are used: a stored reference needs neither.
"""

from __future__ import annotations

import json
import time
import warnings
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from common.errors import BadInput, NoOptimum
from common.files import DAMAGED_NPZ
from common.integration import rk4
from common.ipopt import LEAST, SolveClock, interruptible
from rocket.dynamics import ascent_dynamics
from rocket.environment import flown_mission, fly_rocket
from rocket.missions import PAPER_MISSION, ROCKETS, Mission
from rocket.orbits import local_frame, orbit_vectors, target_axes, target_orbit, terminal_error
from rocket.vehicle import ROCKET, Rocket, delta_v, launch_raan

# ---------------------------------------------------------------------------------------------------------------------
# Rocket ascent: one nonlinear program, transcribed by collocation or by the environment's own steps
# ---------------------------------------------------------------------------------------------------------------------

SEGMENTS = 80
MAX_ITERATIONS = 150  # an ascent that exists took 18 to 42; one that does not would take IPOPT's 3000
GAUSS_POINTS = (1 + np.polynomial.legendre.leggauss(4)[0]) / 2  # in (0, 1)


class AscentCase(NamedTuple):
    """What is solved: a vehicle, final time free (heaviest) or the table's (least turning), altitude bounds in m."""

    key: str
    rocket: Rocket
    free: bool = True
    ceiling: float = np.inf
    floor: float = 1.0  # m


PAPER_CEILING = PAPER_MISSION.ceiling  # the paper penalises an overshoot; the bound is ours
ASCENTS = {
    case.key: case
    for case in (
        AscentCase("free", ROCKET),
        AscentCase("free_table_isp", replace(ROCKET, table_isp=True)),
        AscentCase("fixed", ROCKET, free=False),
        AscentCase("fixed_capped", ROCKET, free=False, ceiling=PAPER_CEILING),
        AscentCase("drag_free", replace(ROCKET, Cd=0.0), floor=5.0),  # else its optimum, held, skims the ground
    )
}


class Mesh(NamedTuple):
    """Where an ascent is cut into n intervals, at every event at least. Times in s, for the guessed final time."""

    t: np.ndarray  # (n+1,) the intervals' ends
    stretch: np.ndarray  # (n+1,) how t moves per second of final time
    t_u: np.ndarray  # (m,) the times of the thrust directions
    column: np.ndarray  # which of them the intervals use, in order
    final_time: tuple[float, float]  # bounds
    points: int  # collocation points within an interval


def state_scale(rocket: Rocket):
    """Earth radius and circular speed at it, (6,): in these units r and v are of order 1."""
    return np.repeat([rocket.Re, np.sqrt(rocket.mu / rocket.Re)], 3)


def collocation_mesh(case: AscentCase, end: float, segments: int) -> Mesh:
    """About `segments` intervals of like length, a whole number in each arc; the last arc's stretch with the end."""
    arcs = [arc for arc in case.rocket.arcs() if arc[0] < end]
    start, stop = arcs[-1][0], min(arcs[-1][1], case.rocket.end_time)
    ends = [min(arc[1], end) for arc in arcs]
    pieces = [np.linspace(a[0], b, max(round(segments * (b - a[0]) / end), 1) + 1)[1:] for a, b in zip(arcs, ends)]
    t = np.concatenate([[0.0], *pieces])
    t_u = (t[:-1, None] + np.diff(t)[:, None] * GAUSS_POINTS).ravel()
    stretch = np.clip((t - start) / (end - start), 0.0, 1.0)
    return Mesh(t, stretch, t_u, np.arange(len(t_u)), (start, stop), len(GAUSS_POINTS))


def zero_order_hold_mesh(rocket: Rocket, end: float, free: bool = False) -> Mesh:
    """The environment's steps until `end`, cut at the events, with one direction each.

    With a free end the last interval stretches, within its step and the rocket's time.
    """
    t_u = rocket.dt * np.arange(np.ceil(end / rocket.dt - 1e-9))
    t = np.unique([*t_u, *(arc[1] for arc in rocket.arcs() if arc[1] < end), end])
    column = np.searchsorted(t_u, t[:-1], side="right") - 1
    stretch = np.zeros(len(t))
    final_time = (end, end)
    if free:
        stretch[-1] = 1.0
        final_time = (t[-2], min(t_u[-1] + rocket.dt, rocket.end_time))
    return Mesh(t, stretch, t_u, column, final_time, 0)


def collocation(rocket: Rocket, in_wind: bool = False):
    """Interval of Gauss-Legendre collocation: CasADi function (x, z, u, (m, T, flow, dt)) -> (defects, x at the end).

    The scaled r, v are the polynomial through x (6,) at the start and z (6, points) at the Gauss points; a defect is
    its derivative there minus the dynamics' ("derivative form", e.g. Garg et al., Automatica 46, 2010). With `in_wind`
    the engine's four numbers are followed by the air's: the factor on the drag, the wind towards east and north (m/s).
    """
    import casadi as ca

    tau = GAUSS_POINTS
    C, D, _ = ca.collocation_coeff(tau)  # derivative at the points, value at the end
    scale = ca.DM(state_scale(rocket))
    x, z, u = ca.SX.sym("x", 6), ca.SX.sym("z", 6, len(tau)), ca.SX.sym("u", 3, len(tau))
    mass, thrust, flow, dt = engine = ca.vertsplit(ca.SX.sym("engine", 4))
    air = ca.vertsplit(ca.SX.sym("air", 3)) if in_wind else []
    drag, *wind = air or [None]
    rates = []
    for j in range(len(tau)):
        state, control = (
            (*ca.vertsplit(scale * z[:, j]), mass - flow * tau[j] * dt),
            (*ca.vertsplit(u[:, j]), thrust, flow),
        )
        rates.append(ca.vertcat(*ascent_dynamics(state, control, rocket, wind or None, drag)[:6]) / scale)
    nodes = ca.horzcat(x, z)
    defects = nodes @ C - dt * ca.horzcat(*rates)
    parameters = ca.vertcat(*engine, *air)
    return ca.Function("collocation", [x, z, u, parameters], [defects, nodes @ D])


def zero_order_hold_step(rocket: Rocket):
    """Interval of multiple shooting, as `collocation` but without points: the environment's step, u held."""
    import casadi as ca

    scale = ca.DM(state_scale(rocket))
    x, u = ca.SX.sym("x", 6), ca.SX.sym("u", 3)
    mass, thrust, flow, dt = engine = ca.vertsplit(ca.SX.sym("engine", 4))
    state, control = (*ca.vertsplit(scale * x), mass), (*ca.vertsplit(u), thrust, flow)
    x_next = rk4(lambda x, u: ascent_dynamics(x, u, rocket), state, control, dt)
    none = ca.SX(6, 0)
    return ca.Function("zoh_step", [x, none, u, ca.vertcat(*engine)], [none, ca.vertcat(*x_next[:6]) / scale])


def burning(rocket: Rocket, t):
    """Thrust (N) and flow (kg/s) from times t (n,) on, the start (s) of that arc and the mass (kg) there, each (n,)."""
    start, end, thrust, flow, dropped = np.array(rocket.arcs()).T
    mass = rocket.x0[6] - np.append(0.0, np.cumsum(flow * (end - start) + dropped)[:-1])
    arc = np.searchsorted(end, t, side="right")
    return thrust[arc], flow[arc], start[arc], mass[arc]


def orbit_defect(rocket: Rocket, x, h_target, e_target):
    """Five independent numbers that are 0 where a state x (r, v; a CasADi symbol) is on the orbit of these vectors.

    e is normal to h: once h is the target's, two components of e are left, in the plane of the rocket's target.
    """
    import casadi as ca

    h, e = (ca.vertcat(*vector) for vector in orbit_vectors(ca.vertsplit(x), rocket.mu))
    return ca.vertcat((h - h_target) / ca.norm_2(h_target), ca.DM(target_axes(rocket)[:2]) @ (e - e_target))


def ascent_program(case: AscentCase, mesh: Mesh):
    """The nonlinear program as CasADi symbols: unknowns x (6, n) at the intervals' ends, z, u (3, m), final time.

    Minimises the final time (the mass left falls with it), or sum |u_{k+1} - u_k|^2 where that is fixed. Constraints:
    the defects, x continuous, |u| = 1, the target orbit by five independent numbers (= 0), |r| / Re at x (bounded).
    """
    import casadi as ca

    ca.GlobalOptions.setNumpyMode(1)  # np.exp of a symbol is a symbol, without the warning that it was not always so
    rocket, n = case.rocket, len(mesh.t) - 1
    scale, end = state_scale(rocket), ca.MX.sym("end")
    x, z, u = ca.MX.sym("x", 6, n), ca.MX.sym("z", 6, n * mesh.points), ca.MX.sym("u", 3, len(mesh.t_u))
    t = ca.DM(mesh.t).T + (end - mesh.t[-1]) * ca.sparsify(ca.DM(mesh.stretch)).T
    thrust, flow, start, mass = (ca.DM(column).T for column in burning(rocket, mesh.t[:-1]))
    engine = ca.vertcat(mass - flow * (t[:-1] - start), thrust, flow, t[1:] - t[:-1])
    x0 = rocket.x0[:6] / scale
    x0[3] += 1e-16  # |v_rel| has no derivative where it is 0, as it is on the ground
    interval = collocation(rocket) if mesh.points else zero_order_hold_step(rocket)
    defects, ends = interval.map(n)(ca.horzcat(x0, x[:, :-1]), z, u[:, mesh.column.tolist()], engine)
    target = (ca.DM(vector) for vector in target_orbit(rocket.target, rocket.mu))
    orbit = orbit_defect(rocket, ca.DM(scale) * x[:, -1], *target)
    constraints = ca.veccat(defects, x - ends, ca.sum1(u**2) - 1, orbit, ca.sqrt(ca.sum1(x[:3, :] ** 2)))
    cost = end / (scale[0] / scale[3]) if case.free else ca.sumsqr(u[:, 1:] - u[:, :-1])
    return {"x": ca.veccat(x, z, u, end), "f": cost, "g": constraints}


def interpolate(times, t, values):
    """Columns of `values` (k, d) at t (k,), linearly at `times` (m,): (m, d)."""
    return np.column_stack([np.interp(times, t, column) for column in values.T])


@interruptible()
def solve_from_guess(case: AscentCase, mesh: Mesh, guess: dict, clock: SolveClock) -> dict:
    """Solve `ascent_program` from a guess with t (s), y (its states, at least r and v), t_u (s), u (directions).

    Returns the same of the optimum (y (n+1, 6)), `status`, `final_time`, `final_mass`, and `costate` (m, 3), the
    multipliers of the velocity defects: in collocation the velocity's costate times the weight of the quadrature.
    Raises RuntimeError where IPOPT finds no optimum.
    """
    import casadi as ca

    rocket, n, points = case.rocket, len(mesh.t) - 1, mesh.points
    program, scale = ascent_program(case, mesh), state_scale(rocket)
    options = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10}
    options |= {"ipopt.bound_relax_factor": 0, "ipopt.max_iter": MAX_ITERATIONS}
    options |= {"ipopt.max_wall_time": max(clock.seconds_left(), LEAST), "iteration_callback": clock.callback(program)}
    solve = ca.nlpsol("ascent", "ipopt", program, options)
    times = np.append(mesh.t[1:], mesh.t_u if points else [])  # of x and z
    states = interpolate(times, guess["t"], guess["y"][:, :6]) / scale
    start = np.concatenate([states.ravel(), interpolate(mesh.t_u, guess["t_u"], guess["u"]).ravel(), mesh.t[-1:]])
    box = np.full(len(start) - 1, 2.0)  # far from any ascent; it keeps IPOPT's first steps near the Earth
    equal = np.zeros(program["g"].numel() - n)
    low, high = (np.append(equal, np.full(n, 1 + h / rocket.Re)) for h in (case.floor, case.ceiling))
    lbx, ubx = np.append(-box, mesh.final_time[0]), np.append(box, mesh.final_time[1])
    solution = solve(x0=start, lbx=lbx, ubx=ubx, lbg=low, ubg=high)
    status = solve.stats()["return_status"]
    if status == "Maximum_WallTime_Exceeded":
        raise NoOptimum(f"rocket ascent {case.key}: not solved within {clock.seconds():.0f} s (--solve-seconds)")
    if status != "Solve_Succeeded":
        raise NoOptimum(f"rocket ascent {case.key}: IPOPT stopped with {status} after {clock.seconds():.0f} s")
    w, end = solution["x"].full()[:-1, 0], float(solution["x"][-1])
    y = np.vstack([rocket.x0[:6], w[: 6 * n].reshape(n, 6) * scale])
    shift = end - mesh.t[-1]
    t, t_u = mesh.t + shift * mesh.stretch, mesh.t_u + shift * np.interp(mesh.t_u, mesh.t, mesh.stretch)
    _, flow, since, mass = burning(rocket, mesh.t[-2])
    found = {"t": t, "y": y, "t_u": t_u, "u": w[6 * n * (1 + points) :].reshape(-1, 3), "status": status}
    costate = solution["lam_g"].full()[: 6 * n * points].reshape(-1, 6)[:, 3:]
    return found | {"final_time": end, "final_mass": mass - flow * (end - since), "costate": costate}


# ---------------------------------------------------------------------------------------------------------------------
# Rocket ascent: references, flown by the environment
# ---------------------------------------------------------------------------------------------------------------------

FIXED, CUTOFF = "RocketAscent-v0", "RocketAscentCutoff-v0"
STORED = {CUTOFF: "free", FIXED: "fixed_capped"}  # the keys of the paper's references; any other's is its id
RESULTS = Path(__file__).parents[1] / "results"
MISS_TOLERANCE = 2e-5  # terminal error of a stored reference in flight, unless it flew worse when it was solved
HOLD_TOLERANCE = 2e-4  # of a spline's flight where the steps themselves cannot be solved
IN_PLANE = 1e-3  # rad, below which an optimum's yaw is the solver's rounding


def mission_case(key: str, mission: Mission) -> AscentCase:
    """What a mission's policy is measured against: with cut-off the heaviest, else the least turning below its ceiling.

    With free time no ceiling is imposed: what is left of the mass is then a bound for every flight.
    """
    return AscentCase(key, mission.rocket, mission.cutoff, np.inf if mission.cutoff else mission.ceiling)


def ascent_guesses(rocket: Rocket) -> list[tuple[float, float]]:
    """Final times and times in which to tilt from straight up to the horizon, s each, in the order they are tried.

    Each final time is well within the last burn: an optimum is looked for in the arc that its guess ends in.
    """
    last = rocket.end_time
    earliest = min((rocket.last_ignition + last) / 2, last)
    end = max(min(900.0, 0.94 * last), earliest)
    return [(end, min(280.0, 0.5 * end)), (end, 0.8 * end), (max(0.8 * end, earliest), 0.4 * end)]


def pitch_times(rocket: Rocket, end: float):
    """The times (s) of `nine_pitch_angles`: the start, 30 s, every staging, quarters of the longest burn, the `end`.

    Nine for four burns; with fewer, the longest intervals are halved until there are nine.
    """
    ends = [*(burn.end for burn in rocket.burns[:-1]), end]
    begins = [0.0, *ends[:-1]]
    burns = [(begin, stop) for begin, stop, burn in zip(begins, ends, rocket.burns) if not burn.is_coast]
    longest = max(burns, key=lambda burn: burn[1] - burn[0])
    times = np.array(sorted({0.0, 30.0, *ends, *np.linspace(*longest, 5)}))
    while len(times) < 9:
        longest = int(np.argmax(np.diff(times)))
        times = np.insert(times, longest + 1, times[longest : longest + 2].mean())
    return times


def fly_directions(env_id: str, rocket: Rocket, u, end: float) -> dict:
    """`fly_rocket` of the directions u (K, 3) in ECI, held over the steps until `end` (s)."""
    return fly_rocket(env_id, lambda obs, k: u[k, None], end_time=end, rocket=rocket)


def fly_angles(env_id: str, pitch, yaw, end: float, **options) -> dict:
    """`fly_rocket` at the angles `pitch` above the horizon and `yaw` out of the target's plane, (K,) rad each."""
    ahead = np.cos(yaw)
    u = np.stack([np.sin(pitch) * ahead, np.cos(pitch) * ahead, np.sin(yaw)], axis=1)
    return fly_rocket(env_id, lambda obs, k: u[k, None], end_time=end, action_frame="local", **options)


def cold_start(case: AscentCase, end: float, tilt_time: float) -> dict:
    """The guess: a flight that tilts evenly from straight up to the horizon and stays there."""
    t = case.rocket.dt * np.arange(np.ceil(end / case.rocket.dt))
    pitch = np.pi / 2 * np.clip(1 - t / tilt_time, 0.0, 1.0)
    flight = fly_angles(FIXED, pitch, np.zeros_like(pitch), end, rocket=case.rocket)
    return flight | {"t_u": flight["t"][:-1]}


def refuse_too_weak(case: AscentCase):
    """RuntimeError where all the delta-v at once, on the ground and eastwards, has not the target's energy."""
    rocket = case.rocket
    speed = delta_v(rocket) + np.linalg.norm(rocket.x0[3:6])
    if speed**2 / 2 - rocket.mu / rocket.Re < rocket.target_energy:
        needs = np.sqrt(2 * (rocket.target_energy + rocket.mu / rocket.Re))
        has = f"delta-v and the Earth's turning are {speed:.0f} m/s, its orbit needs {needs:.0f} m/s and losses"
        raise NoOptimum(f"rocket ascent {case.key}: {has}; look at its payload, {rocket.payload} kg")


def optimise_ascent(case: AscentCase, segments: int = SEGMENTS) -> dict:
    """The optimum from the first of `ascent_guesses` that IPOPT takes there: what `solve_from_guess` returns.

    With free final time by direct collocation, else by the environment's own steps. Raises RuntimeError that says what
    to look at where there is none.
    """
    rocket = case.rocket
    refuse_too_weak(case)
    clock = SolveClock(f"rocket ascent {case.key}")
    for end, tilt_time in ascent_guesses(rocket):
        end = end if case.free else rocket.end_time
        mesh = collocation_mesh(case, end, segments) if case.free else zero_order_hold_mesh(rocket, end)
        try:
            found = solve_from_guess(case, mesh, cold_start(case, end, tilt_time), clock)
        except NoOptimum as error:
            failure = error
        else:
            refuse_early_orbit(case, found["final_time"])
            return found
        if not clock.seconds_left():
            break
    raise NoOptimum(f"{failure}: the rocket may not reach its orbit; look at {suspects(case)}")


def refuse_early_orbit(case: AscentCase, end: float):
    """NoOptimum where the optimum uses nothing of the last burn: in it the engine is to be cut off."""
    begins = case.rocket.last_ignition
    if case.free and len(case.rocket.burns) > 1 and end < begins + 1e-3:
        todo = "leave that burn out, or give it more payload or a higher orbit"
        raise NoOptimum(
            f"rocket ascent {case.key}: the orbit is reached before the last burn begins, {begins:g} s; {todo}"
        )


def suspects(case: AscentCase) -> str:
    """What is usually wrong where no optimum is found, with its values."""
    rocket = case.rocket
    north = launch_raan(rocket.latitude, rocket.i)
    planes = f"{north:.4f} towards the north and {(180 - north) % 360:.4f} towards the south"
    perigee, apogee = (rocket.a * (1 + sign * rocket.e) - rocket.Re for sign in (-1, 1))
    look = f"its raan, {rocket.raan:.8g} degrees (the launch site's plane at t = 0 has {planes})"
    look += f", its argp, {rocket.argp:g} degrees, its a and e, {perigee / 1e3:.4g} km by {apogee / 1e3:.6g} km"
    look += f", its payload, {rocket.payload} kg, its i, {rocket.i}, and its end_time, {rocket.end_time} s"
    return look + (f", below {case.ceiling / 1e3:g} km" if np.isfinite(case.ceiling) else "")


def reached_optimum(flight: dict, rocket: Rocket = ROCKET) -> dict:
    """The optimum with free final time, as `optimise_ascent`, for the orbit that a flight reached, not the target.

    Of `flight` its five elements are read: `a_km e i_deg raan_deg argp_deg`. Raises RuntimeError where IPOPT finds no
    optimum.
    """
    angles = {name: float(flight[f"{name}_deg"]) for name in ("i", "raan", "argp")}
    with warnings.catch_warnings():  # an inclination that misses the launch latitude by a hair is no dog-leg
        warnings.simplefilter("ignore")
        try:
            rocket = replace(rocket, a=1e3 * float(flight["a_km"]), e=float(flight["e"]), **angles)
        except BadInput as error:  # an orbit that meets the ground
            raise NoOptimum(f"rocket ascent reached: {error}") from error
        return optimise_ascent(AscentCase("reached", rocket))


def nine_pitch_angles(env_id: str, flight: dict, rocket: Rocket) -> dict:
    """The opponent: a cubic spline through a flight's pitch at nine times (`pitch_times`), flown without feedback.

    Where the flight steers out of the target's plane by more than `IN_PLANE`, its yaw at these times, too. Returns what
    `fly_rocket` does. The times are ours: close together where the pitch turns fast.
    """
    from scipy.interpolate import CubicSpline

    t, u = flight["t"], flight["u"].T
    frame = local_frame(flight["y"][:-1].T, target_axes(rocket)[2])
    up, along, cross = ((u * axis).sum(axis=0) for axis in frame)
    pitch, yaw, middle = np.arctan2(up, along), np.arcsin(np.clip(cross, -1, 1)), (t[:-1] + t[1:]) / 2
    knots, burns = pitch_times(rocket, t[-1]), burning(rocket, middle)[0] > 0  # in a coast a direction means nothing
    pitch, yaw = (CubicSpline(knots, np.interp(knots, middle[burns], angle[burns]))(middle) for angle in (pitch, yaw))
    if np.abs(np.arcsin(np.clip(cross, -1, 1))).max() <= IN_PLANE:
        yaw = np.zeros_like(pitch)
    return fly_angles(env_id, pitch, yaw, t[-1], rocket=rocket)


def hold_steps(case: AscentCase, collocated: dict) -> dict:
    """The optimum of the environment's own steps with free final time, from a collocation; as `solve_from_guess`.

    It takes a little longer than the collocation's, and so may end in the step after.
    """
    rocket, end = case.rocket, collocated["final_time"]
    clock = SolveClock(f"rocket ascent {case.key}, held steps")
    next_step = rocket.dt * (np.floor(end / rocket.dt + 1e-9) + 1)
    for guessed_end in (end, min(next_step + rocket.dt / 2, rocket.end_time)):
        mesh = zero_order_hold_mesh(rocket, guessed_end, free=True)
        try:
            return solve_from_guess(case, mesh, collocated, clock)
        except NoOptimum as error:
            failure = error
        if not clock.seconds_left():
            break
    raise failure


@cache
def solve_and_fly(case: AscentCase):
    """One ascent: its numbers, its flight by the environment, and the collocation (None if the time is fixed).

    With free final time the collocation's directions at mid-step are held over the environment's steps. Where that
    flight misses by more than `MISS_TOLERANCE` (across a jump of the direction a spline means nothing), the steps are
    solved themselves, as with fixed time. Raises NoOptimum where the flight misses by more than `HOLD_TOLERANCE`.
    """
    from scipy.interpolate import CubicSpline

    begin, rocket = time.perf_counter(), case.rocket
    solution = optimise_ascent(case)
    optimum = solution if case.free else None
    if case.free:
        t = np.append(rocket.dt * np.arange(np.ceil(solution["final_time"] / rocket.dt)), solution["final_time"])
        directions = CubicSpline(solution["t_u"], solution["u"])((t[:-1] + t[1:]) / 2)
    else:
        directions = solution["u"]
    flight = fly_directions(FIXED, rocket, directions, solution["final_time"])
    if case.free and not flight["error_norm"] <= MISS_TOLERANCE:
        try:
            solution = hold_steps(case, solution)
        except NoOptimum:
            if not flight["error_norm"] <= HOLD_TOLERANCE:
                raise
        else:
            flight = fly_directions(FIXED, rocket, solution["u"], solution["final_time"])
    seconds = time.perf_counter() - begin
    if not flight["error_norm"] <= HOLD_TOLERANCE:
        raise NoOptimum(f"rocket ascent {case.key}: flown by the environment it misses by {flight['error_norm']:.3g}")
    numbers = {"final_mass_kg": solution["final_mass"], "final_time_s": solution["final_time"]}
    numbers |= {"error_norm": np.linalg.norm(terminal_error(solution["y"][-1], rocket))}
    numbers |= {f"replay_{name}": flight[name] for name in ("error_norm", "final_mass_kg", "final_time_s")}
    numbers |= {"turning": (np.diff(flight["u"], axis=0) ** 2).sum(), "max_altitude_km": flight["max_altitude_km"]}
    numbers |= {"solve_seconds": seconds, "status": solution["status"]}
    return {name: value if name == "status" else float(value) for name, value in numbers.items()}, flight, optimum


def reference_case(env_id: str, mission: Mission) -> AscentCase:
    """What `rocket_reference` solves; its key is the one under which results/ may hold it."""
    key = STORED.get(env_id, env_id)
    case = mission_case(key, mission)
    has_other_rules = key in ASCENTS and case != ASCENTS[key]  # neither the paper's rocket nor its ceiling
    return case._replace(key=env_id) if has_other_rules else case


def rocket_reference(env_id: str, **options) -> dict:
    """The reference of an environment id, flown by it: what `fly_rocket` returns, and three numbers beside it.

    `reference_mass_kg` and `reference_time_s` of the solve (see `mission_case`), `nine_pitch_error_norm` of
    `nine_pitch_angles`. `options` of the environment, `rocket` and `table_isp`, change what is solved. Read from
    results/rocket_reference.{json,npz} where it is there and still reaches the target, else solved, with CasADi.
    Raises ValueError on an unknown id, NoOptimum where a solve fails.
    """
    if env_id not in ROCKETS:
        raise ValueError(f"env_id is {env_id!r}; it must be one of {', '.join(ROCKETS)}")
    return mission_reference(env_id, flown_mission(ROCKETS[env_id], **options))


def mission_reference(env_id: str, mission: Mission) -> dict:
    """`rocket_reference` of a mission, which need not be the one that the id is registered for."""
    case = reference_case(env_id, mission)
    found = stored_reference(env_id, case) if mission == ROCKETS[env_id] else None
    if found is None:
        numbers, solved, _ = solve_and_fly(case)
        found = numbers, fly_directions(env_id, case.rocket, solved["u"], solved["t"][-1])
    numbers, flight = found
    return flight | {
        "reference_mass_kg": numbers["final_mass_kg"],
        "reference_time_s": numbers["final_time_s"],
        "nine_pitch_error_norm": nine_pitch_angles(env_id, flight, case.rocket)["error_norm"],
    }


kept_reference = lru_cache(maxsize=4)(mission_reference)  # evaluations during a training fly it again and again


def stored_reference(env_id: str, case: AscentCase) -> tuple[dict, dict] | None:
    """The numbers of a solve in results/ and its flight by the environment; None where none fits the case any more."""
    rocket = case.rocket
    try:
        numbers, u, end = stored_ascent(case.key)
        flight = fly_directions(env_id, rocket, u, end)
    except (OSError, LookupError, TypeError, *DAMAGED_NPZ):
        return None
    reaches_target = flight["error_norm"] <= max(MISS_TOLERANCE, 1.01 * numbers["replay_error_norm"])
    is_cut_off = end < rocket.end_time - 1e-6
    below_ceiling = not flight["max_altitude_km"] > case.ceiling / 1e3 + 0.5
    fits = reaches_target and is_cut_off == case.free and below_ceiling
    return (numbers, flight) if fits else None


def stored_ascent(key: str):
    """The numbers, directions (K, 3) and final time (s) of a solve in results/; many errors where it cannot be read."""
    numbers = json.loads((RESULTS / "rocket_reference.json").read_text())[key]
    numbers = {name: float(numbers[name]) for name in ("final_mass_kg", "final_time_s", "replay_error_norm")}
    with np.load(RESULTS / "rocket_reference.npz") as arrays:
        return numbers, arrays[f"{key}_u"], arrays[f"{key}_t"][-1]
