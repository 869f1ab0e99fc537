"""The flight of drawn or nominal vehicles without an environment: step times, the way between events, the cut-off.

These are pure functions. The environment flies by them, and the LQR is linearised along them. n is the number of
flights, A the number of arcs of `Vehicles`. An event is the end of a burn, a stage that runs dry, or the strike of a
failure. An arc is the time between two events.

Reading order: steps, the flight of a step, the flight of an arc, the cut-off.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from common.integration import rk4
from rocket.dispersion import Vehicles
from rocket.dynamics import ascent_dynamics
from rocket.orbits import specific_energy
from rocket.vehicle import Rocket

STIFF = 0.25  # a step is cut where rho Cd S |v| / m times the step, drag's derivative by the speed, exceeds this


class Fleet(NamedTuple):
    """N vehicles of one rocket, and the air around them."""

    rocket: Rocket
    vehicles: Vehicles
    has_own_air: bool  # whether each vehicle meets its own wind and drag; if not, they are the nominal ones


class Steps(NamedTuple):
    """The steps that n flights fly, or what is left of the steps after an event."""

    begin: np.ndarray  # (n,) s, when the step begins, or the arc that begins within it
    end: np.ndarray  # (n,) s, when the whole step ends
    arc: np.ndarray  # (n,) the arc at `begin`, from 0 to A - 1
    who: np.ndarray  # (n,) the indices of the vehicles

    def of(self, chosen) -> Steps:
        """The steps of the chosen flights, indices or a mask of n."""
        return Steps(*(column[chosen] for column in self))


def steps_until(latest: np.ndarray, dt: float) -> np.ndarray:
    """The numbers of steps (N,) of flights that end at `latest` (N,) s. The last step is shorter if dt does not fit."""
    return np.maximum(np.ceil(latest / dt - 1e-9), 1.0).astype(np.int64)


def steps_at(t, vehicles: Vehicles, latest: np.ndarray, count: np.ndarray, dt: float) -> Steps:
    """The steps t (N,) of flights that end at `latest` (N,) s, after `count` = `steps_until(latest, dt)` steps.

    After a flight's last step its arc keeps its value.
    """
    begin = np.where(t >= count, latest, dt * t)
    end = np.where(t + 1 >= count, latest, dt * (t + 1))
    arc = (vehicles.end <= dt * np.minimum(t, count - 1)).sum(axis=0)
    return Steps(begin, end, arc, np.arange(len(arc)))


def unit_directions(actions):
    """The unit vectors (3, n) along actions (n, 3) of any length but 0."""
    u = actions.T / np.abs(actions).max(axis=1)  # so that squares neither overflow nor underflow
    return u / np.sqrt((u * u).sum(axis=0))


def fly_step(fleet: Fleet, y, u, steps: Steps, duration):
    """The states (7, n) at `duration` (n,) s after the begin of these steps.

    y (7, n) are the states at the begin, u (3, n) the directions in ECI, which are held. Each round flies to the next
    event or to the end of the duration. Flights that met an event drop their mass and go on in the next arc.
    """
    vehicles = fleet.vehicles
    flown, flying = None, None  # (7, n), and its columns that are still flying; None: all of them
    while True:
        event = vehicles.end[steps.arc, steps.who]
        until_event = event - steps.begin
        y = fly_arc(fleet, y, u, steps, np.minimum(duration, until_event))
        if flown is None:
            flown = y
        else:
            flown[:, flying] = y
        met = np.flatnonzero(event <= steps.end)
        if len(met):
            # durations are rounded; an event at the very end of the step counts as met, as in the next step
            met = met[(duration >= until_event - 1e-9)[met]]
        if not len(met):
            return flown
        flying = met if flying is None else flying[met]
        y = y[:, met]
        y[6] -= vehicles.dropped[steps.arc[met], steps.who[met]]
        u = u[:, met]
        duration = np.maximum((duration - until_event)[met], 0.0)
        steps = Steps(begin=event[met], end=steps.end[met], arc=steps.arc[met] + 1, who=steps.who[met])


def fly_arc(fleet: Fleet, y, u, steps: Steps, dt):
    """The states (7, n) after dt (n,) seconds without an event, by one RK4 step.

    A plunge into dense air takes several RK4 steps, because drag is stiff there. Its rate times the step, at the lowest
    altitude that the step can reach, is kept below `STIFF`. No ascent comes near this limit. Without it a crash at
    orbital speed would end in meaningless numbers.
    """
    rocket, vehicles, arc, who = fleet.rocket, fleet.vehicles, steps.arc, steps.who
    controls = (*u, vehicles.thrust[arc, who], vehicles.flow[arc, who])
    air = ()
    if fleet.has_own_air:
        air = vehicles.wind[:, who], vehicles.drag[who]
    # with the state as one component (7, n), rk4 takes a seventh of the array operations
    f = lambda x, u: (np.array(ascent_dynamics(x[0], u, rocket, *air)),)  # noqa: E731
    speed = np.sqrt((y[3:6] ** 2).sum(axis=0))
    lowest = np.maximum(np.sqrt((y[:3] ** 2).sum(axis=0)) - rocket.Re - speed * dt, 0.0)
    rate = rocket.rho0 * np.exp(-lowest / rocket.H) * rocket.Cd * rocket.S * speed / y[6]
    if air:
        rate = air[1] * rate
    (y_next,) = rk4(f, (y,), controls, dt)
    stiff = np.flatnonzero(rate * dt > STIFF)
    if len(stiff):
        n = np.ceil((rate * dt)[stiff] / STIFF)  # each flight's own number, which no other flight changes
        y_sub = y[:, stiff]
        controls = tuple(c[stiff] for c in controls)
        dt = dt[stiff] / n
        air = tuple(column[..., stiff] for column in air)
        for k in range(int(n.max())):
            aloft = (y_sub[:3] ** 2).sum(axis=0) >= rocket.Re**2  # a flight below the ground stays there
            y_sub = np.where(aloft & (k < n), rk4(f, (y_sub,), controls, dt)[0], y_sub)
        y_next[:, stiff] = y_sub
    return y_next


def cut_off(fleet: Fleet, before, after, u, steps: Steps, duration, target_energy):
    """The states (7, n) and times (n,), in s after the begin of the steps, at which the energy is the target's.

    before and after (7, n) are the states at the begin and `duration` (n,) s later, when the energy has been passed.
    The target_energy (J/kg) is one for all or (n,). The method is regula falsi with the Illinois change (Dowell and
    Jarratt, 1971): if the same end of the bracket is replaced twice, the other end's value is halved. The energy grows
    almost linearly in a step, so four evaluations reach rounding. All rows take six, so that no row depends on the rest
    of the batch.
    """

    def excess(y):
        return specific_energy(y, fleet.rocket.mu) - target_energy

    low, high = np.zeros(len(duration)), duration
    f_low = np.minimum(excess(before), -1e-300)  # a flight that begins beyond the energy is cut off there
    f_high = excess(after)
    replaced_high = np.full(len(duration), -1)  # whether the last round replaced `high`; -1 before the first
    y, time = after, duration
    for _ in range(6):
        time = low - f_low * (high - low) / (f_high - f_low)
        y = fly_step(fleet, before, u, steps, time)
        f = excess(y)
        above = f >= 0
        divisor = 1 + (above == replaced_high)
        f_low = np.where(above, f_low / divisor, f)
        f_high = np.where(above, f, f_high / divisor)
        low = np.where(above, low, time)
        high = np.where(above, time, high)
        replaced_high = above
    return y, time
