"""Reference optima of the landers by IPOPT: the least propellant if a flight's mass, gravity and failure are known.

Reading order: a flight as it is solved, the nonlinear program, the solve from a guess, one flight's optimum and its
replay by the environment, the references of many draws. CasADi is imported only where it is used.
"""

from __future__ import annotations

import sys
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from common.errors import NoOptimum
from common.ipopt import SolveClock, interruptible, limit
from common.workers import Workers
from landing.dynamics import TINY, burn
from landing.environment import PERIOD, LanderVectorEnv, make_lander_vector, state_of
from landing.lander import DRAW, Failure, Flights, Lander, draw_flights

# ---------------------------------------------------------------------------------------------------------------------
# A flight as it is solved
# ---------------------------------------------------------------------------------------------------------------------


class Descent(NamedTuple):
    """What is left of one flight, with all that is hidden."""

    state: np.ndarray  # (7,) r (m), v (m/s), m (kg) at the beginning
    gravity: np.ndarray  # (3,) m/s^2
    failed: np.ndarray  # (3,) effectiveness of each axis after the failure
    strike: float  # s after the beginning, when the failure strikes; infinite without one

    @classmethod
    def of(cls, flight: Flights) -> Descent:
        """The whole of one flight."""
        state = np.concatenate([flight.r[:, 0], flight.v[:, 0], flight.mass])
        strike = PERIOD * np.ceil(flight.strike[0] / PERIOD)  # the beginning of one of the environment's periods
        return cls(state, flight.gravity[:, 0], flight.failed[:, 0], float(strike))

    def effectiveness(self, begins: np.ndarray) -> np.ndarray:
        """The effectiveness (K, 3) of each axis in intervals that begin at these times (K,) in s."""
        has_struck = begins > self.strike - PERIOD / 2
        return np.where(has_struck[:, None], self.failed, 1.0)


class Trajectory(NamedTuple):
    """A guess or solution: states at some times, and the thrusts held between them."""

    t: np.ndarray  # (K+1,) s
    thrust: np.ndarray  # (K, 3) N, the thrust that acts on the lander
    y: np.ndarray  # (K+1, 7)

    @property
    def seconds(self) -> float:
        return float(self.t[-1])

    @property
    def fuel(self) -> float:
        """The propellant burnt, in kg."""
        return float(self.y[0, 6] - self.y[-1, 6])

    def thrust_at(self, times: np.ndarray) -> np.ndarray:
        """The thrusts (k, 3) at times (k,). The first and the last thrust are held beyond the ends."""
        interval = np.searchsorted(self.t, times, side="right") - 1
        return self.thrust[np.clip(interval, 0, len(self.thrust) - 1)]

    def state_at(self, times: np.ndarray) -> np.ndarray:
        """The states (k, 7) at times (k,), on straight lines between the states."""
        return np.column_stack([np.interp(times, self.t, column) for column in self.y.T])


# ---------------------------------------------------------------------------------------------------------------------
# The nonlinear program
# ---------------------------------------------------------------------------------------------------------------------

UNITS = np.array([1000.0] * 3 + [50.0] * 3 + [1000.0])  # m, m/s, kg; in these units a state is of order 1
HEIGHT, GRAVITY = 4000.0, 3.7114  # m, m/s^2: these units are for a `Lander.height` from `HEIGHT` to twice that
BOX = 20.0  # units of r and v, at least 2.5 `Lander.height`; it keeps IPOPT's first steps near the pad
TOUCHDOWN = np.array([0.0, 0.0, -1e-7, 0.0, 0.0, -0.01])  # m and m/s; at rest it might miss the ground by rounding
CLEARANCE = 0.1  # m at the ends of periods, because the path sags between them by up to 0.05 m
LAST_APPROACH = 1.0  # s before touchdown, in which the path may come nearer to the ground
SHORTEST, LONGEST = 0.02, 10.0  # s, the bounds of an interval's length
MAX_ITERATIONS = 300  # a landing that exists takes 14 to 90


class LandingMesh(NamedTuple):
    """The intervals of a program. Some have a fixed length, the free ones share one unknown length."""

    fixed: np.ndarray  # (K,) s, the fixed lengths, 0 for free intervals
    is_free: np.ndarray  # (K,) which intervals are free
    longest: float  # s, upper bound of the unknown length

    @classmethod
    def stretched(cls, lander: Lander, count: int, seconds: float, strike: float = 0.0) -> LandingMesh:
        """Intervals of about like length for a landing that takes `seconds`. Those before the strike (s) are fixed.

        All together they may last as long as the lander's longest flight.
        """
        before = 0
        if strike > 0:
            before = min(max(round(count * strike / seconds), 1), count - 1)
        is_free = np.arange(count) >= before
        longest = max(LONGEST, lander.longest / count)
        return cls(np.where(is_free, 0.0, strike / max(before, 1)), is_free, longest)

    @classmethod
    def periods(cls, count: int) -> LandingMesh:
        """The environment's periods. The last one is cut short."""
        is_last = np.arange(count) == count - 1
        return cls(np.where(is_last, 0.0, PERIOD), is_last, PERIOD)

    def times(self, length: float) -> np.ndarray:
        """The ends (K+1,) of the intervals in s, if the free ones have this length."""
        return np.append(0.0, np.cumsum(self.fixed + self.is_free * length))

    def length(self, seconds: float) -> float:
        """The length of the free intervals with which all together last `seconds`, clipped to its bounds."""
        return float(np.clip((seconds - self.fixed.sum()) / self.is_free.sum(), SHORTEST, self.longest))


def units_of(lander: Lander) -> np.ndarray:
    """The units (7,) of r (m), v (m/s) and m (kg) in a lander's program.

    r grows with the lander's height, in powers of two, so that landers of about one size share their units. v grows as
    in a fall, with the square root of r times gravity.
    """
    length = 2.0 ** np.floor(np.log2(lander.height / HEIGHT))
    speed = np.sqrt(length * lander.gravity / GRAVITY)
    return UNITS * np.array([length] * 3 + [speed] * 3 + [1.0])


def interval_of(lander: Lander):
    """An interval as a CasADi function, in `units_of` the lander and units of the greatest thrust.

    (y, thrust, seconds, gravity, effectiveness) -> (y at its end, |thrust|^2, |command|^2)
    """
    import casadi as ca

    y = ca.SX.sym("y", 7)
    thrust = ca.SX.sym("thrust", 3)
    seconds = ca.SX.sym("seconds")
    gravity = ca.SX.sym("gravity", 3)
    effectiveness = ca.SX.sym("effectiveness", 3)
    units = ca.DM(units_of(lander))
    state = y * units
    norm = ca.sqrt(ca.sumsqr(thrust) + 1e-16)  # the root has no derivative at 0
    flow = lander.greatest_thrust * norm / lander.exhaust
    motion = state[:3], state[3:6], state[6], thrust / norm, flow, gravity, seconds
    after = ca.vertcat(*burn(*motion, lander.exhaust, log1p=ca.log1p)) / units
    norms = ca.sumsqr(thrust), ca.sumsqr(thrust / effectiveness)
    return ca.Function("interval", [y, thrust, seconds, gravity, effectiveness], [after, *norms])


@lru_cache(maxsize=100)  # of 5 MB each
def landing_solver(lander: Lander, count: int, has_cone: bool):
    """IPOPT for a landing in `count` intervals, built once per process.

    - unknowns: the thrusts (3, count), the states (7, count) at the intervals' ends, the length of the free intervals
    - parameters: state, gravity, effectiveness (3, count), `fixed` and `is_free` of the mesh, the glide slope's tangent
    - cost: the propellant
    - constraints: continuous states (7 count, = 0), |thrust|^2 and |command|^2 (count each, bounded), and with
      `has_cone` the heights above the cone at the ends of all intervals but the last (count - 1)
    """
    import casadi as ca

    thrust = ca.MX.sym("thrust", 3, count)
    y = ca.MX.sym("y", 7, count)
    length = ca.MX.sym("length")
    state = ca.MX.sym("state", 7)
    gravity = ca.MX.sym("gravity", 3)
    tangent = ca.MX.sym("tangent")
    effectiveness = ca.MX.sym("effectiveness", 3, count)
    fixed = ca.MX.sym("fixed", 1, count)
    is_free = ca.MX.sym("is_free", 1, count)
    before = ca.horzcat(state, y[:, :-1])
    held = thrust, fixed + is_free * length, ca.repmat(gravity, 1, count), effectiveness
    after, thrusts, commands = interval_of(lander).map(count)(before, *held)
    constraints = [y - after, thrusts, commands]
    if has_cone:
        run = ca.sqrt(ca.sum1(y[:2, :-1] ** 2) + 1e-12)  # the root has no derivative above the pad
        constraints.append(y[2, :-1] - tangent * run)
    program = {
        "x": ca.veccat(thrust, y, length),
        "p": ca.veccat(state, gravity, effectiveness, fixed, is_free, tangent),
        "f": state[6] - y[6, -1],
        "g": ca.veccat(*constraints),
    }
    options = {
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.tol": 1e-10,
        "ipopt.bound_relax_factor": 0,  # the default lets commands exceed the engine's limits
        "ipopt.max_iter": MAX_ITERATIONS,
        "ipopt.max_wall_time": limit["seconds"],
    }
    return ca.nlpsol("landing", "ipopt", program, options)


def bounds_of(
    lander: Lander,
    mesh: LandingMesh,
    glide_slope: float | None,
    limits: tuple[float, float],
    target: np.ndarray,
) -> dict:
    """The bounds of a program's unknowns and constraints, for CasADi's `nlpsol`. `limits` of the thrust are in N."""
    count = len(mesh.fixed)
    units = units_of(lander)
    low = np.full((count, 7), -BOX)
    high = np.full((count, 7), BOX)
    low[:, 6] = lander.dry_mass / units[6]
    high[:, 6] = np.inf
    if glide_slope is not None:
        times = mesh.times(SHORTEST)
        left = times[-1] - times[1:]  # s that are left at least
        low[:, 2] = np.where(left > LAST_APPROACH, CLEARANCE / units[2], 0.0)
    low[-1, :6] = high[-1, :6] = target / units[:6]
    ones = np.ones(3 * count)
    least, greatest = (np.array(limits) / lander.greatest_thrust) ** 2
    lbg = np.concatenate([np.zeros(7 * count), np.full(count, least), np.full(count, -np.inf)])
    ubg = np.concatenate([np.zeros(7 * count), np.full(count, np.inf), np.full(count, greatest)])
    if glide_slope:
        lbg = np.append(lbg, np.zeros(count - 1))
        ubg = np.append(ubg, np.full(count - 1, np.inf))
    return {
        "lbx": np.concatenate([-ones, low.ravel(), [SHORTEST]]),
        "ubx": np.concatenate([ones, high.ravel(), [mesh.longest]]),
        "lbg": lbg,
        "ubg": ubg,
    }


# ---------------------------------------------------------------------------------------------------------------------
# The solve from a guess
# ---------------------------------------------------------------------------------------------------------------------

NEWTON_STEPS = 25  # 8 are enough for almost all flights; a bisection halves the bracket of the others


def energy_optimal_time(r, v, gravity: float) -> np.ndarray:
    """The time to go (n,) in s of the energy-optimal landing from r and v (n, 3). gravity is |g| in m/s^2.

    It is the positive root t of an equation by D'Souza, "An optimal guidance law for planetary landing" (AIAA 97-3709):

        g^2/2 t^4 - 2 v.v t^2 - 12 v.r t - 18 r.r = 0,  which is  g t^2 / 2 = |3 r + v t|.

    The second form has no differences of large numbers. There is one root if v^2 is below 6 g |r|, as on all our
    descents. We find it by Newton's method from above. A step that leaves the bracket is replaced by its middle.
    """
    distance = np.linalg.norm(r, axis=1)
    speed = np.linalg.norm(v, axis=1)
    low = np.zeros(len(r))
    high = (speed + np.sqrt(speed**2 + 6 * gravity * distance)) / gravity  # the root of g t^2 / 2 = 3 |r| + |v| t
    t = high
    for _ in range(NEWTON_STEPS):
        aim = 3 * r + v * t[:, None]
        size = np.linalg.norm(aim, axis=1) + TINY
        excess = gravity / 2 * t**2 - size
        slope = gravity * t - (v * aim).sum(axis=1) / size
        high = np.where(excess >= 0, t, high)
        low = np.where(excess < 0, t, low)
        step = t - excess / np.where(slope > 0, slope, TINY)
        t = np.where((step >= low) & (step <= high), step, (low + high) / 2)
    return t


def straight_line(lander: Lander, descent: Descent, seconds: float, count: int) -> Trajectory:
    """A guess in which r, v and m change evenly, under the thrust that stops the lander in `seconds`."""
    share = np.linspace(0, 1, count + 1)
    thrust = descent.state[6] * (-descent.state[3:6] / seconds - descent.gravity)
    norm = np.linalg.norm(thrust)
    possible = np.clip(norm, 1.2 * lander.least_thrust, 0.8 * lander.greatest_thrust)
    left = descent.state[6] - seconds * possible / lander.exhaust
    end = np.append(TOUCHDOWN, max(left, 1.01 * lander.dry_mass))
    y = descent.state + share[:, None] * (end - descent.state)
    return Trajectory(seconds * share, np.tile(thrust * (possible / norm), (count, 1)), y)


def straight_lines(lander: Lander, descent: Descent, shares: tuple[float, ...], count: int) -> list[Trajectory]:
    """The guesses that take these shares of the energy-optimal time, in `count` intervals each."""
    r = descent.state[None, :3]
    v = descent.state[None, 3:6]
    seconds = float(energy_optimal_time(r, v, lander.gravity)[0])
    return [straight_line(lander, descent, share * seconds, count) for share in shares]


def suspects(lander: Lander) -> str:
    """The fields that are usually wrong if no landing is found, in words."""
    causes = "greatest_thrust too small, start too low or too fast, too little propellant (mass, dry_mass)"
    full, dry = (mass * lander.gravity for mass in (lander.mass, lander.dry_mass))
    if lander.least_thrust <= dry:
        return f"{causes}, or longest too short"
    weight = f"the weight is {full:.0f} N at first and {dry:.0f} N at dry_mass, and the engine is never off"
    return f"{causes}, longest too short, or least_thrust, {lander.least_thrust:g} N, too great: {weight}"


@interruptible()
def solve_from_guess(
    lander: Lander,
    descent: Descent,
    guess: Trajectory,
    mesh: LandingMesh,
    glide_slope: float | None = 0.0,
    limits: tuple[float, float] | None = None,
    target: np.ndarray | None = None,
) -> Trajectory:
    """The path of least propellant to the pad, within the thrust `limits` (N), by default the engine's.

    It ends with r (m) and v (m/s) of `target` (6,), by default at rest on the pad. The path stays above a cone on the
    pad, with the angle `glide_slope` in degrees. 0 keeps it above the ground, None allows any path. The failure strikes
    at the beginning of an interval. Raises NoOptimum if IPOPT finds none.
    """
    count = len(mesh.fixed)
    units = units_of(lander)
    length = mesh.length(guess.seconds)
    t = mesh.times(length)
    thrust = guess.thrust_at((t[:-1] + t[1:]) / 2)
    y = guess.state_at(t[1:])
    unknowns = [(thrust / lander.greatest_thrust).ravel(), (y / units).ravel(), [length]]
    effectiveness = descent.effectiveness(t[:-1])
    tangent = np.tan(np.radians(glide_slope or 0.0))
    parameters = [descent.state / units, descent.gravity, effectiveness.ravel(), mesh.fixed, mesh.is_free, [tangent]]
    solve = landing_solver(lander, count, bool(glide_slope))
    limits = limits or (lander.least_thrust, lander.greatest_thrust)
    bounds = bounds_of(lander, mesh, glide_slope, limits, TOUCHDOWN if target is None else target)
    solution = solve(x0=np.concatenate(unknowns), p=np.concatenate(parameters), **bounds)
    status = solve.stats()["return_status"]
    if status != "Solve_Succeeded":
        raise NoOptimum(f"landing: IPOPT stopped with {status}; it may be {suspects(lander)}")
    found = solution["x"].full()[:, 0]
    thrust = found[: 3 * count].reshape(count, 3) * lander.greatest_thrust
    y = np.vstack([descent.state, found[3 * count : -1].reshape(count, 7) * units])
    return Trajectory(mesh.times(found[-1]), thrust, y)


# ---------------------------------------------------------------------------------------------------------------------
# The optimum of one flight, and its replay
# ---------------------------------------------------------------------------------------------------------------------

INTERVALS = 60  # intervals of the first solve, which finds out how long the flight is
DURATIONS = (0.8, 1.2, 0.6)  # guessed durations, in units of the energy-optimal time
PERIODS_TRIES = 6  # numbers of periods that are tried, until the last period is within its bounds
POSITION_TOLERANCE = 0.01  # m
SPEED_TOLERANCE = 0.02  # m/s
FUEL_TOLERANCE = 0.05  # kg
TOUCHDOWN_TOLERANCE = 0.004  # s; what full thrust burns in it is tolerated, too


def stretched_optimum(lander: Lander, descent: Descent, glide_slope: float | None, clock: SolveClock) -> Trajectory:
    """The optimum in `INTERVALS` that stretch, from the first guess that leads IPOPT to one.

    If the lander is down before the failure strikes, the failure does not matter. Otherwise the strike cuts the flight
    into two arcs. Raises NoOptimum if no guess leads to one.
    """
    is_healthy = descent.strike > 0
    known = descent._replace(strike=np.inf if is_healthy else 0.0)
    failure = NoOptimum("landing: no time to solve it")
    for line in straight_lines(lander, descent, DURATIONS, INTERVALS):
        try:
            path = solve_from_guess(
                lander, known, line, LandingMesh.stretched(lander, INTERVALS, line.seconds), glide_slope
            )
            if is_healthy and descent.strike < path.seconds:
                arcs = LandingMesh.stretched(lander, INTERVALS, path.seconds, descent.strike)
                path = solve_from_guess(lander, descent, path, arcs, glide_slope)
            return path
        except NoOptimum as error:
            failure = error
        clock.speak()
        if not clock.seconds_left():
            break
    raise failure


def held_optimum(
    lander: Lander, descent: Descent, guess: Trajectory, glide_slope: float | None, clock: SolveClock
) -> Trajectory:
    """The optimum in the environment's periods. If the last one ends at a bound, their number is changed by one."""
    count = int(guess.seconds / PERIOD) + 1
    tried: dict[int, Trajectory] = {}
    failure = NoOptimum("landing: no time to solve it")
    while count not in tried and len(tried) < PERIODS_TRIES and clock.seconds_left():
        if count * PERIOD > lander.longest + 1e-9:
            failure = NoOptimum(f"landing: it takes {guess.seconds:.1f} s, longer than a flight, {lander.longest:g} s")
            break
        try:
            tried[count] = solve_from_guess(lander, descent, guess, LandingMesh.periods(count), glide_slope)
        except NoOptimum as error:
            failure = error
            break
        last = np.diff(tried[count].t)[-1]
        count += int(last > PERIOD - 1e-4) - int(last < SHORTEST + 1e-4)
        clock.speak()
    if not tried:
        raise failure
    return min(tried.values(), key=lambda path: path.fuel)


def optimise_landing(lander: Lander, flight: Flights, glide_slope: float | None = 0.0) -> dict:
    """The landing of one flight with the least propellant, if its mass, gravity and failure are known.

    Returns u (T, 3) in N, commands held for a period each, `fuel_kg`, `final_time` (s), and t (T+1,) and y (T+1, 7) of
    the flight that the environment makes of them. `glide_slope` is that of `solve_from_guess`. A path that may go below
    ground (None) cannot be flown by the environment. It is shot through the dynamics instead. Raises NoOptimum if IPOPT
    finds none, or if the replay does not end at rest on the pad with the solution's propellant.
    """
    descent = Descent.of(flight)
    clock = SolveClock("landing")
    stretched = stretched_optimum(lander, descent, glide_slope, clock)
    path = held_optimum(lander, descent, stretched, glide_slope, clock)
    u = path.thrust / descent.effectiveness(path.t[:-1])
    if glide_slope is None:
        y, end = shot(lander, descent, path)
    else:
        y, end = replayed(lander, flight, u)
    position_error = np.linalg.norm(y[-1, :3])
    speed = np.linalg.norm(y[-1, 3:6])
    is_soft = position_error < POSITION_TOLERANCE and speed < SPEED_TOLERANCE
    tolerance = max(FUEL_TOLERANCE, TOUCHDOWN_TOLERANCE * lander.greatest_thrust / lander.exhaust)
    differs = len(y) != len(path.y) or not abs(path.y[-1, 6] - y[-1, 6]) < tolerance
    fuel = float(y[0, 6] - y[-1, 6])
    if differs or not is_soft:
        solved = f"a solution of {path.seconds:.2f} s and {path.fuel:.3f} kg"
        ends = f"after {end:.2f} s and {fuel:.3f} kg, {position_error:.2g} m from the pad with {speed:.2g} m/s"
        raise NoOptimum(f"landing: the replay of {solved} ends {ends}")
    return {"u": u, "fuel_kg": fuel, "final_time": end, "t": np.append(path.t[:-1], end), "y": y}


def replayed(lander: Lander, flight: Flights, u: np.ndarray) -> tuple[np.ndarray, float]:
    """The states (T+1, 7) of one flight under the commands u (T, 3), by the environment, and its time of touchdown."""
    batch = LanderVectorEnv(lander)
    batch.reset(options={"x0": np.vstack([flight.r, flight.v]).T})
    batch.flights = flight
    batch.mass = flight.mass.copy()
    y = [state_of(batch)[0]]
    for command in u:
        batch.advance(command[None] / lander.greatest_thrust)
        y.append(state_of(batch)[0])
        if batch.down[0]:
            return np.array(y), float(batch.time[0])
    raise NoOptimum(f"landing: the replay of a solution is {y[-1][2]:.2g} m above ground at its end")


def shot(lander: Lander, descent: Descent, path: Trajectory) -> tuple[np.ndarray, float]:
    """The states (T+1, 7) that a path's thrusts lead to without any ground, and the path's duration in s."""
    y = [descent.state]
    for thrust, seconds in zip(path.thrust, np.diff(path.t)):
        norm = np.linalg.norm(thrust)
        state = y[-1]
        arguments = state[:3], state[3:6], state[6], thrust / norm, norm / lander.exhaust, descent.gravity, seconds
        r, v, mass = burn(*arguments, lander.exhaust)
        y.append(np.concatenate([r, v, [mass]]))
    return np.array(y), path.seconds


# ---------------------------------------------------------------------------------------------------------------------
# The references of many draws
# ---------------------------------------------------------------------------------------------------------------------


def references(env_id: str, draw: np.ndarray, processes: int = 1, **env_options) -> dict:
    """The fuel optima of draws (n, 13): `fuel_kg` and `final_time` (n,), u (n, T, 3), y (n, T+1, 7), `solved` (n,).

    Only the failure's options of the environment matter. u and y are NaN after a flight's last period. All is NaN where
    `solved` is False. Recent answers are remembered, in read-only arrays. `processes` share the solves, which changes
    only the time. Raises NoOptimum if no draw has an optimum.
    """
    batch = make_lander_vector(env_id, **env_options)
    rows = np.ascontiguousarray(draw, dtype=np.float64).tobytes()
    return dict(kept_references(batch.lander, rows, batch.failure, processes))


@lru_cache(maxsize=8)
def kept_references(lander: Lander, rows: bytes, failure: Failure, processes: int) -> dict:
    """`references` of draws that are given as the bytes of their array. Equal flights are solved once."""
    draw = np.frombuffer(rows).reshape(-1, len(DRAW))
    drawn = draw_flights(lander, draw, failure)
    _, first, of_draw = np.unique(np.vstack(drawn), axis=1, return_index=True, return_inverse=True)
    jobs = [(lander, drawn.one(k)) for k in first]
    if len(jobs) > 1:
        print(f"solving the optima of {len(jobs)} landings, once", file=sys.stderr, flush=True)
    with Workers(processes) as workers:
        found = workers.map(solve_job, jobs)
    optima = [found[k] for k in of_draw.ravel()]
    solved = [optimum for optimum in optima if isinstance(optimum, dict)]
    if not solved:
        raise optima[0]
    n, T = len(draw), max(len(optimum["u"]) for optimum in solved)
    arrays = {
        "fuel_kg": np.full(n, np.nan),
        "final_time": np.full(n, np.nan),
        "u": np.full((n, T, 3), np.nan),
        "y": np.full((n, T + 1, 7), np.nan),
        "solved": np.array([isinstance(optimum, dict) for optimum in optima]),
    }
    for k, optimum in zip(np.flatnonzero(arrays["solved"]), solved):
        arrays["fuel_kg"][k] = optimum["fuel_kg"]
        arrays["final_time"][k] = optimum["final_time"]
        arrays["u"][k, : len(optimum["u"])] = optimum["u"]
        arrays["y"][k, : len(optimum["y"])] = optimum["y"]
    for array in arrays.values():
        array.flags.writeable = False
    return arrays


def solve_job(job) -> dict | NoOptimum:
    """The optimum of the job (lander, flight), or the NoOptimum that says why there is none."""
    try:
        return optimise_landing(*job)
    except NoOptimum as error:
        return error
