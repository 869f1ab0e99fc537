"""Reference optima of the rockets: one nonlinear program, solved by IPOPT and then flown by the environment.

Reading order: the program (what is solved, its meshes, collocation, the solve), then the references that the
environments fly. CasADi and SciPy are imported only where they are used. A stored reference needs neither.
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
from common.registration import say_remarks
from rocket.dynamics import ascent_dynamics
from rocket.environment import flown_mission, fly_rocket
from rocket.missions import PAPER_MISSION, ROCKETS, Mission
from rocket.orbits import local_frame, orbit_vectors, target_axes, target_orbit, terminal_error
from rocket.vehicle import ROCKET, Rocket, delta_v, launch_raan

# ---------------------------------------------------------------------------------------------------------------------
# Rocket ascent: one nonlinear program, transcribed by collocation or by the environment's own steps
# ---------------------------------------------------------------------------------------------------------------------

SEGMENTS = 80
MAX_ITERATIONS = 150  # an ascent that exists takes 18 to 42; one that does not would take IPOPT's 3000
GAUSS_POINTS = (1 + np.polynomial.legendre.leggauss(4)[0]) / 2  # in (0, 1)


class AscentCase(NamedTuple):
    """What is solved: the ascent of one vehicle."""

    key: str
    rocket: Rocket
    free: bool = True  # free final time, for the most mass; else the table's final time, for the least turning
    ceiling: float = np.inf  # m, upper bound of the altitude
    floor: float = 1.0  # m, lower bound of the altitude


ASCENTS = {
    case.key: case
    for case in (
        AscentCase("free", ROCKET),
        AscentCase("free_table_isp", replace(ROCKET, table_isp=True)),
        AscentCase("fixed", ROCKET, free=False),
        AscentCase("fixed_capped", ROCKET, free=False, ceiling=PAPER_MISSION.ceiling),  # the bound is ours
        AscentCase("drag_free", replace(ROCKET, Cd=0.0), floor=5.0),  # with a lower floor the flight skims the ground
    )
}


class AscentMesh(NamedTuple):
    """An ascent cut into n intervals, at least at every event. Times are in s, for the guessed final time."""

    t: np.ndarray  # (n+1,) the intervals' ends
    stretch: np.ndarray  # (n+1,) how far t moves for each second of final time
    t_u: np.ndarray  # (m,) the times of the thrust directions
    column: np.ndarray  # the indices of the directions that the intervals use, in order
    final_time: tuple[float, float]  # bounds of the final time
    points: int  # collocation points within an interval


def state_scale(rocket: Rocket):
    """The units (6,) of r and v: the Earth's radius (m) and the circular speed there (m/s)."""
    return np.repeat([rocket.Re, np.sqrt(rocket.mu / rocket.Re)], 3)


BOX = 2.0  # units of every state and direction, which keeps IPOPT's first steps near the Earth
RISE = 0.8  # of the circular speed at the ground; no ascent moves away faster than that on average


def box_of(rocket: Rocket, states: int, directions: int) -> np.ndarray:
    """The bounds of a program's states (6 each) and directions (3 each): `BOX`, and more for r on a far orbit.

    r may be as far as a little above the target's apogee, if the flight is long enough to come there.
    """
    units = state_scale(rocket)
    apogee = 1.2 * rocket.a * (1 + rocket.e) / units[0]
    risen = 1 + RISE * rocket.end_time * units[3] / units[0]
    far = max(BOX, min(apogee, risen))
    state = np.array([far] * 3 + [BOX] * 3)
    return np.append(np.tile(state, states), np.full(3 * directions, BOX))


def collocation_mesh(case: AscentCase, end: float, segments: int) -> AscentMesh:
    """About `segments` intervals of like length, a whole number in each arc. The last arc's stretch with the end."""
    arcs = [arc for arc in case.rocket.arcs() if arc[0] < end]
    start = arcs[-1][0]
    stop = min(arcs[-1][1], case.rocket.end_time)
    pieces = []
    for arc in arcs:
        arc_end = min(arc[1], end)
        intervals = max(round(segments * (arc_end - arc[0]) / end), 1)
        pieces.append(np.linspace(arc[0], arc_end, intervals + 1)[1:])
    t = np.concatenate([[0.0], *pieces])
    t_u = (t[:-1, None] + np.diff(t)[:, None] * GAUSS_POINTS).ravel()
    stretch = np.clip((t - start) / (end - start), 0.0, 1.0)
    return AscentMesh(t, stretch, t_u, np.arange(len(t_u)), (start, stop), len(GAUSS_POINTS))


def zero_order_hold_mesh(rocket: Rocket, end: float, free: bool = False) -> AscentMesh:
    """The environment's steps until `end`, cut at the events, with one direction for each step.

    With a free end the last interval stretches, within its step and up to the rocket's end_time.
    """
    t_u = rocket.dt * np.arange(np.ceil(end / rocket.dt - 1e-9))
    t = np.unique([*t_u, *(arc[1] for arc in rocket.arcs() if arc[1] < end), end])
    column = np.searchsorted(t_u, t[:-1], side="right") - 1
    stretch = np.zeros(len(t))
    final_time = (end, end)
    if free:
        stretch[-1] = 1.0
        final_time = (t[-2], min(t_u[-1] + rocket.dt, rocket.end_time))
    return AscentMesh(t, stretch, t_u, column, final_time, 0)


def collocation(rocket: Rocket, in_wind: bool = False):
    """Interval of Gauss-Legendre collocation: CasADi function (x, z, u, (m, T, flow, dt)) -> (defects, x at the end).

    The scaled r and v follow the polynomial through x (6,) at the start and z (6, points) at the Gauss points. A defect
    is the polynomial's derivative at a Gauss point minus that of the dynamics ("derivative form", e.g. Garg et al.,
    Automatica 46, 2010). With `in_wind` three more parameters follow: the factor on the drag, and the wind towards east
    and north (m/s).
    """
    import casadi as ca

    tau = GAUSS_POINTS
    C, D, _ = ca.collocation_coeff(tau)  # derivative at the points, value at the end
    scale = ca.DM(state_scale(rocket))
    x = ca.SX.sym("x", 6)
    z = ca.SX.sym("z", 6, len(tau))
    u = ca.SX.sym("u", 3, len(tau))
    engine = ca.vertsplit(ca.SX.sym("engine", 4))
    mass, thrust, flow, dt = engine
    air = ca.vertsplit(ca.SX.sym("air", 3)) if in_wind else []
    drag, *wind = air or [None]
    rates = []
    for j in range(len(tau)):
        state = (*ca.vertsplit(scale * z[:, j]), mass - flow * tau[j] * dt)
        control = (*ca.vertsplit(u[:, j]), thrust, flow)
        rates.append(ca.vertcat(*ascent_dynamics(state, control, rocket, wind or None, drag)[:6]) / scale)
    nodes = ca.horzcat(x, z)
    defects = nodes @ C - dt * ca.horzcat(*rates)
    parameters = ca.vertcat(*engine, *air)
    return ca.Function("collocation", [x, z, u, parameters], [defects, nodes @ D])


def zero_order_hold_step(rocket: Rocket):
    """An interval of multiple shooting, with the arguments of `collocation` but no points: the environment's step."""
    import casadi as ca

    scale = ca.DM(state_scale(rocket))
    x = ca.SX.sym("x", 6)
    u = ca.SX.sym("u", 3)
    engine = ca.vertsplit(ca.SX.sym("engine", 4))
    mass, thrust, flow, dt = engine
    state = (*ca.vertsplit(scale * x), mass)
    control = (*ca.vertsplit(u), thrust, flow)
    x_next = rk4(lambda x, u: ascent_dynamics(x, u, rocket), state, control, dt)
    none = ca.SX(6, 0)
    return ca.Function("zoh_step", [x, none, u, ca.vertcat(*engine)], [none, ca.vertcat(*x_next[:6]) / scale])


def burning(rocket: Rocket, t):
    """Thrust (N) and flow (kg/s) from times t (n,) on, the start (s) of their arc and the mass (kg) then, (n,) each."""
    start, end, thrust, flow, dropped = np.array(rocket.arcs()).T
    mass = rocket.x0[6] - np.append(0.0, np.cumsum(flow * (end - start) + dropped)[:-1])
    arc = np.searchsorted(end, t, side="right")
    return thrust[arc], flow[arc], start[arc], mass[arc]


def orbit_defect(rocket: Rocket, x, h_target, e_target, axes):
    """Five independent numbers that are 0 if a state x (r, v; a CasADi symbol) is on the orbit of these vectors.

    e is normal to h. So when h is the target's, only two components of e are left, along axes (2, 3) in its plane.
    """
    import casadi as ca

    h, e = (ca.vertcat(*vector) for vector in orbit_vectors(ca.vertsplit(x), rocket.mu))
    return ca.vertcat((h - h_target) / ca.norm_2(h_target), axes @ (e - e_target))


def ascent_program(case: AscentCase, mesh: AscentMesh):
    """The nonlinear program as CasADi symbols: unknowns x (6, n) at the intervals' ends, z, u (3, m) and final time.

    It minimises the final time, with which the mass left falls, or sum |u_{k+1} - u_k|^2 if the final time is fixed.
    The constraints are the defects, a continuous x, |u| = 1, the target orbit (`orbit_defect` = 0), and bounds of
    |r| / Re at x.
    """
    import casadi as ca

    ca.GlobalOptions.setNumpyMode(1)  # np.exp of a symbol is a symbol; without this CasADi warns
    rocket = case.rocket
    n = len(mesh.t) - 1
    scale = state_scale(rocket)
    end = ca.MX.sym("end")
    x = ca.MX.sym("x", 6, n)
    z = ca.MX.sym("z", 6, n * mesh.points)
    u = ca.MX.sym("u", 3, len(mesh.t_u))
    t = ca.DM(mesh.t).T + (end - mesh.t[-1]) * ca.sparsify(ca.DM(mesh.stretch)).T
    thrust, flow, start, mass = (ca.DM(column).T for column in burning(rocket, mesh.t[:-1]))
    engine = ca.vertcat(mass - flow * (t[:-1] - start), thrust, flow, t[1:] - t[:-1])
    x0 = rocket.x0[:6] / scale
    x0[3] += 1e-16  # |v_rel| has no derivative where it is 0, as it is on the ground
    interval = collocation(rocket) if mesh.points else zero_order_hold_step(rocket)
    defects, ends = interval.map(n)(ca.horzcat(x0, x[:, :-1]), z, u[:, mesh.column.tolist()], engine)
    h, e = (ca.DM(vector) for vector in target_orbit(rocket.target, rocket.mu))
    orbit = orbit_defect(rocket, ca.DM(scale) * x[:, -1], h, e, ca.DM(target_axes(rocket)[:2]))
    constraints = ca.veccat(defects, x - ends, ca.sum1(u**2) - 1, orbit, ca.sqrt(ca.sum1(x[:3, :] ** 2)))
    cost = end / (scale[0] / scale[3]) if case.free else ca.sumsqr(u[:, 1:] - u[:, :-1])
    return {"x": ca.veccat(x, z, u, end), "f": cost, "g": constraints}


def interpolate(times, t, values):
    """The columns of `values` (k, d) at t (k,), interpolated linearly at `times` (m,): (m, d)."""
    return np.column_stack([np.interp(times, t, column) for column in values.T])


@interruptible()
def solve_from_guess(case: AscentCase, mesh: AscentMesh, guess: dict, clock: SolveClock) -> dict:
    """Solve `ascent_program` from a guess with t (s), y (states, at least r and v), t_u (s) and u (directions).

    Returns the same of the optimum, with y (n+1, 6), and `status`, `final_time` (s), `final_mass` (kg) and `costate`
    (m, 3). `costate` has the multipliers of the velocity defects. In collocation they are the velocity's costate times
    the weight of the quadrature. Raises NoOptimum if IPOPT finds no optimum.
    """
    import casadi as ca

    rocket = case.rocket
    n = len(mesh.t) - 1
    points = mesh.points
    program = ascent_program(case, mesh)
    scale = state_scale(rocket)
    options = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-10}
    options |= {"ipopt.bound_relax_factor": 0, "ipopt.max_iter": MAX_ITERATIONS}
    options |= {"ipopt.max_wall_time": max(clock.seconds_left(), LEAST), "iteration_callback": clock.callback(program)}
    solve = ca.nlpsol("ascent", "ipopt", program, options)
    times = np.append(mesh.t[1:], mesh.t_u if points else [])  # of x and z
    states = interpolate(times, guess["t"], guess["y"][:, :6]) / scale
    start = np.concatenate([states.ravel(), interpolate(mesh.t_u, guess["t_u"], guess["u"]).ravel(), mesh.t[-1:]])
    box = box_of(rocket, len(times), len(mesh.t_u))
    equal = np.zeros(program["g"].numel() - n)
    low, high = (np.append(equal, np.full(n, 1 + h / rocket.Re)) for h in (case.floor, case.ceiling))
    lbx = np.append(-box, mesh.final_time[0])
    ubx = np.append(box, mesh.final_time[1])
    solution = solve(x0=start, lbx=lbx, ubx=ubx, lbg=low, ubg=high)
    status = solve.stats()["return_status"]
    if status == "Maximum_WallTime_Exceeded":
        raise NoOptimum(f"rocket ascent {case.key}: not solved within {clock.seconds():.0f} s (--solve-seconds)")
    if status != "Solve_Succeeded":
        raise NoOptimum(f"rocket ascent {case.key}: IPOPT stopped with {status} after {clock.seconds():.0f} s")
    w = solution["x"].full()[:-1, 0]
    end = float(solution["x"][-1])
    y = np.vstack([rocket.x0[:6], w[: 6 * n].reshape(n, 6) * scale])
    shift = end - mesh.t[-1]
    t = mesh.t + shift * mesh.stretch
    t_u = mesh.t_u + shift * np.interp(mesh.t_u, mesh.t, mesh.stretch)
    _, flow, since, mass = burning(rocket, mesh.t[-2])
    found = {"t": t, "y": y, "t_u": t_u, "u": w[6 * n * (1 + points) :].reshape(-1, 3), "status": status}
    costate = solution["lam_g"].full()[: 6 * n * points].reshape(-1, 6)[:, 3:]
    return found | {"final_time": end, "final_mass": mass - flow * (end - since), "costate": costate}


# ---------------------------------------------------------------------------------------------------------------------
# Rocket ascent: references, flown by the environment
# ---------------------------------------------------------------------------------------------------------------------

FIXED, CUTOFF = "RocketAscent-v0", "RocketAscentCutoff-v0"
# the keys of the paper's references; another id is its own key
STORED = {CUTOFF: "free", "RocketAscentAnyOrbit-v0": "free", FIXED: "fixed_capped"}
RESULTS = Path(__file__).parents[1] / "results"
MISS_TOLERANCE = 2e-5  # of a spline in flight; a stored reference may miss by 1.01 times its miss when it was solved
HOLD_TOLERANCE = 2e-4  # largest terminal error of a spline's flight, if the steps themselves cannot be solved
IN_PLANE = 1e-3  # rad; a smaller yaw of an optimum is the solver's rounding


def mission_case(key: str, mission: Mission) -> AscentCase:
    """The case that a mission's policy is measured against.

    With cut-off it is the ascent with the most mass, without a ceiling, so that its mass is a bound for every flight.
    Without cut-off it is the ascent that turns least below the mission's ceiling.
    """
    return AscentCase(key, mission.rocket, mission.cutoff, np.inf if mission.cutoff else mission.ceiling)


def ascent_guesses(rocket: Rocket) -> list[tuple[float, float]]:
    """Guesses of the final time (s) and of the time (s) to tilt from straight up to the horizon, in the order to try.

    An optimum is looked for in the arc that its guess ends in. So each final time is well within the last burn.
    """
    last = rocket.end_time
    earliest = min((rocket.ignitions[-1] + last) / 2, last)
    end = max(min(900.0, 0.94 * last), earliest)
    return [(end, min(280.0, 0.5 * end)), (end, 0.8 * end), (max(0.8 * end, earliest), 0.4 * end)]


def pitch_times(rocket: Rocket, end: float):
    """The times (s) of `nine_pitch_angles`: the start, 30 s, every staging, quarters of the longest burn, the `end`.

    With four burns they are nine. With fewer burns the longest intervals are halved until there are nine.
    """
    ends = [*(burn.end for burn in rocket.burns[:-1]), end]
    burns = [(begin, stop) for begin, stop, burn in zip(rocket.ignitions, ends, rocket.burns) if not burn.is_coast]
    longest = max(burns, key=lambda burn: burn[1] - burn[0])
    times = np.array(sorted({0.0, 30.0, *ends, *np.linspace(*longest, 5)}))
    while len(times) < 9:
        longest = int(np.argmax(np.diff(times)))
        times = np.insert(times, longest + 1, times[longest : longest + 2].mean())
    return times


def fly_directions(env_id: str, rocket: Rocket, u, end: float) -> dict:
    """`fly_rocket` with the directions u (K, 3) in ECI, held over the steps until `end` (s)."""
    return fly_rocket(env_id, lambda obs, k: u[k, None], end_time=end, rocket=rocket)


def fly_angles(env_id: str, pitch, yaw, end: float, **options) -> dict:
    """`fly_rocket` at the angles `pitch` above the horizon and `yaw` out of the target's plane, (K,) in rad each."""
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
    """Raise NoOptimum if all the delta-v at once, on the ground and eastwards, does not give the target's energy."""
    rocket = case.rocket
    speed = delta_v(rocket) + np.linalg.norm(rocket.x0[3:6])
    if speed**2 / 2 - rocket.mu / rocket.Re < rocket.target_energy:
        needs = np.sqrt(2 * (rocket.target_energy + rocket.mu / rocket.Re))
        *_, (_, _, thrust, flow, _) = (arc for arc in rocket.arcs() if arc[3])
        missing = rocket.dry_mass * np.expm1((needs - speed) * flow / thrust)
        has = f"delta-v and the Earth's turning are {speed:.0f} m/s, its orbit needs {needs:.0f} m/s and losses"
        lacks = f"at least {missing:.0f} kg of propellant are missing in the last burn"
        raise NoOptimum(f"rocket ascent {case.key}: {has}: {lacks}; look at its payload, {rocket.payload} kg")


def optimise_ascent(case: AscentCase, segments: int = SEGMENTS) -> dict:
    """The optimum that IPOPT finds from the first of `ascent_guesses` that leads to one, as `solve_from_guess` has it.

    With free final time it is solved by direct collocation, otherwise in the environment's own steps. Raises NoOptimum
    if there is none, with a line that says what to look at.
    """
    rocket = case.rocket
    refuse_too_weak(case)
    clock = SolveClock(f"rocket ascent {case.key}")
    for end, tilt_time in ascent_guesses(rocket):
        if case.free:
            mesh = collocation_mesh(case, end, segments)
        else:
            end = rocket.end_time
            mesh = zero_order_hold_mesh(rocket, end)
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
    """Raise NoOptimum if the optimum uses nothing of the last burn, in which the engine is to be cut off."""
    begins = case.rocket.ignitions[-1]
    if case.free and len(case.rocket.burns) > 1 and end < begins + 1e-3:
        todo = "leave that burn out, or give it more payload or a higher orbit"
        raise NoOptimum(
            f"rocket ascent {case.key}: the orbit is reached before the last burn begins, {begins:g} s; {todo}"
        )


def suspects(case: AscentCase) -> str:
    """The fields that are usually wrong if no optimum is found, with their values, in words."""
    rocket = case.rocket
    north = launch_raan(rocket.latitude, rocket.i)
    planes = f"{north:.4f} towards the north and {(180 - north) % 360:.4f} towards the south"
    perigee, apogee = (rocket.a * (1 + sign * rocket.e) - rocket.Re for sign in (-1, 1))
    look = f"its raan, {rocket.raan:.8g} degrees (the launch site's plane at t = 0 has {planes})"
    look += f", its argp, {rocket.argp:g} degrees, its a and e, {perigee / 1e3:.4g} km by {apogee / 1e3:.6g} km"
    look += f", its payload, {rocket.payload} kg, its i, {rocket.i}, and its end_time, {rocket.end_time} s"
    return look + (f", below {case.ceiling / 1e3:g} km" if np.isfinite(case.ceiling) else "")


def reached_optimum(flight: dict, rocket: Rocket = ROCKET) -> dict:
    """The optimum with free final time for the orbit that a flight reached, as `optimise_ascent` returns it.

    `flight` gives the five elements `a_km e i_deg raan_deg argp_deg`. Raises NoOptimum if IPOPT finds no optimum.
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

    If the flight steers out of the target's plane by more than `IN_PLANE`, a spline through its yaw is flown, too. The
    times are our choice. They are close together where the pitch turns fast. Returns what `fly_rocket` does.
    """
    from scipy.interpolate import CubicSpline

    t, u = flight["t"], flight["u"].T
    frame = local_frame(flight["y"][:-1].T, target_axes(rocket)[2])
    up, along, cross = ((u * axis).sum(axis=0) for axis in frame)
    pitch = np.arctan2(up, along)
    yaw = np.arcsin(np.clip(cross, -1, 1))
    middle = (t[:-1] + t[1:]) / 2
    knots = pitch_times(rocket, t[-1])
    thrust, *_ = burning(rocket, middle)
    burns = thrust > 0  # in a coast a direction means nothing

    def smooth(angle):
        at_knots = np.interp(knots, middle[burns], angle[burns])
        return CubicSpline(knots, at_knots)(middle)

    pitch = smooth(pitch)
    yaw = smooth(yaw)
    if np.abs(np.arcsin(np.clip(cross, -1, 1))).max() <= IN_PLANE:
        yaw = np.zeros_like(pitch)
    return fly_angles(env_id, pitch, yaw, t[-1], rocket=rocket)


def hold_steps(case: AscentCase, collocated: dict) -> dict:
    """The optimum of the environment's own steps with free final time, from the guess `collocated`.

    Its flight takes a little longer than the collocation's, so it may end in the next step. Returns what
    `solve_from_guess` does.
    """
    rocket = case.rocket
    end = collocated["final_time"]
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
    """One ascent: its numbers, its flight by the environment, and the collocation (None if the final time is fixed).

    With free final time the collocation's directions at mid-step are held over the environment's steps. A spline means
    nothing across a jump of the direction. So if that flight misses by more than `MISS_TOLERANCE`, the steps themselves
    are solved, as with fixed time. Raises NoOptimum if the flight misses by more than `HOLD_TOLERANCE`.
    """
    from scipy.interpolate import CubicSpline

    begin = time.perf_counter()
    rocket = case.rocket
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
    """The case that `rocket_reference` solves. results/ may hold its solution under its key."""
    key = STORED.get(env_id, env_id)
    case = mission_case(key, mission)
    has_other_rules = key in ASCENTS and case != ASCENTS[key]  # neither the paper's rocket nor its ceiling
    return case._replace(key=env_id) if has_other_rules else case


def rocket_reference(env_id: str, **options) -> dict:
    """The reference of an environment id, flown by its environment: what `fly_rocket` returns, and three numbers.

    The numbers are `reference_mass_kg` and `reference_time_s` of the solve (`mission_case`), and
    `nine_pitch_error_norm` of `nine_pitch_angles`. The environment's options `rocket` and `table_isp` change what is
    solved. A solution in results/rocket_reference.{json,npz} that still reaches the target is read; otherwise CasADi
    solves. Raises ValueError for an unknown id, and NoOptimum if a solve fails.
    """
    if env_id not in ROCKETS:
        raise ValueError(f"env_id is {env_id!r}; it must be one of {', '.join(ROCKETS)}")
    return mission_reference(env_id, flown_mission(ROCKETS[env_id], **options))


def mission_reference(env_id: str, mission: Mission) -> dict:
    """`rocket_reference` of a mission. The id may be registered for another mission."""
    say_remarks(env_id)
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
    """The numbers of a solve in results/, and its flight by the environment. None if no solve there fits the case."""
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
    """The numbers, directions (K, 3) and final time (s) of a solve in results/. A bad file raises many errors."""
    numbers = json.loads((RESULTS / "rocket_reference.json").read_text())[key]
    numbers = {name: float(numbers[name]) for name in ("final_mass_kg", "final_time_s", "replay_error_norm")}
    with np.load(RESULTS / "rocket_reference.npz") as arrays:
        return numbers, arrays[f"{key}_u"], arrays[f"{key}_t"][-1]
