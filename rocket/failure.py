"""A hidden loss of thrust: in half of the flights one group of engines gives less thrust from some moment on.

Thrust and propellant flow fall together, so the engines burn for longer. Only the flight itself shows the failure. The
groups that may fail are those of `engine_groups`: engines of one type that are dropped together. The paper's rocket has
four: six boosters, three boosters, stage 1 and stage 2. All groups are equally likely to fail. A failure strikes at a
random moment between the group's ignition and its burn-out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from common.errors import is_finite, refuse_unless
from rocket.vehicle import Rocket, engine_groups

WHEN = {"random": "from a random moment of a burn on", "ignition": "from the last stage's ignition on"}
FAILURE_TIMES = tuple(WHEN)
LARGEST_FAILURE = 0.3  # share of thrust
FAILURE_PROBABILITY = 0.5
# uniform numbers from 0 to 1; a flight fails if the first is below `FAILURE_PROBABILITY`
FAILURE_DRAW = ("failure", "failed_group", "moment", "share")
HEALTHY_DRAW = (1.0, 0.0, 0.0, 0.0)
NEEDS_CUTOFF = "must be 0 where flights end at a fixed time: engines that burn for longer need an id with cut-off"


def check_failure(failure: float, failure_time: str, cutoff: bool):
    """Raise BadInput for failures that cannot be drawn, or for a mission whose flights all end at one time."""
    possible = is_finite(failure) and 0 <= failure <= LARGEST_FAILURE
    refuse_unless(possible, "failure", repr(failure), f"must be a number from 0 to {LARGEST_FAILURE}")
    allowed = f"must be one of {', '.join(FAILURE_TIMES)}"
    refuse_unless(failure_time in FAILURE_TIMES, "failure_time", repr(failure_time), allowed)
    refuse_unless(cutoff or not failure, "failure", failure, NEEDS_CUTOFF)


class Losses(NamedTuple):
    """The losses of N flights: a share of thrust and flow of each of the G groups of engines, from some moment on.

    Seconds are counted while the group burns.
    """

    after: np.ndarray  # (G, N) s that the group has burnt when the failure strikes; infinite if it stays healthy
    share: np.ndarray  # (G, N) the share lost from then on

    def lasts(self, g: int, seconds):
        """The time (N,) in s for which group g burns what a healthy group would burn in `seconds` (N,)."""
        after = self.after[g]
        return np.minimum(seconds, after) + np.maximum(seconds - after, 0.0) / (1 - self.share[g])

    def spent(self, g: int, seconds):
        """The time (N,) in s for which a healthy group g would burn what this one burns in `seconds` (N,)."""
        after = self.after[g]
        return np.minimum(seconds, after) + np.maximum(seconds - after, 0.0) * (1 - self.share[g])

    def strike(self, groups, end: np.ndarray) -> np.ndarray:
        """The times (N,) in s at which failures strike, infinite without one. end (B, N) in s are the burns' ends."""
        begin = np.vstack([np.zeros_like(end[:1]), end[:-1]])
        strike = np.full(end.shape[1], np.inf)
        for g, group in enumerate(groups):
            lit = np.zeros_like(strike)  # s until the burn begins
            for k in sorted(group.burns):
                until_strike = self.after[g] - lit
                is_here = (until_strike >= 0) & (until_strike < end[k] - begin[k])
                strike = np.where(is_here, begin[k] + until_strike, strike)
                lit = lit + (end[k] - begin[k])
        return strike


def no_losses(groups, n: int) -> Losses:
    """The losses of n healthy flights: none."""
    return Losses(np.full((len(groups), n), np.inf), np.zeros((len(groups), n)))


def failing_groups(rocket: Rocket, failure_time: str) -> list[int]:
    """The groups that may fail, as indices of `engine_groups`: all with thrust, or only the last with "ignition"."""
    with_thrust = [g for g, group in enumerate(engine_groups(rocket)) if group.burns and group.engine.thrust]
    return with_thrust if failure_time == "random" else with_thrust[-1:]


def group_names(rocket: Rocket) -> list[str]:
    """The groups of engines in words, by their number and when they leave: "6 until 75.2 s"."""
    groups = engine_groups(rocket)
    return [f"{group.number} until {rocket.burns[group.dropped_after].end:g} s" for group in groups]


def drawn_losses(
    rocket: Rocket, draw: np.ndarray, failure: float, failure_time: str, seconds_lit: np.ndarray
) -> Losses:
    """The losses of draws (N, 4), which have the numbers of `FAILURE_DRAW`. The largest share is `failure`.

    seconds_lit (G, N) is how long the groups burn in these flights if they stay healthy.
    """
    has_failed, which, moment, share = draw.T
    groups = failing_groups(rocket, failure_time)
    group = np.array(groups)[np.minimum((which * len(groups)).astype(int), len(groups) - 1)]
    losses = no_losses(seconds_lit, len(draw))
    flights = np.flatnonzero(has_failed < FAILURE_PROBABILITY)
    failed = group[flights], flights
    losses.after[failed] = (moment * (failure_time == "random"))[flights] * seconds_lit[failed]
    losses.share[failed] = failure * share[flights]
    return losses


def failure_scores(rng: np.random.Generator, n: int, in_pairs: bool = False) -> np.ndarray:
    """The failures of n draws (n, 4). With `in_pairs` they are x and 1 - x, so one flight of each pair fails."""
    if not in_pairs:
        return rng.random((n, len(FAILURE_DRAW)))
    half = rng.random((-(-n // 2), len(FAILURE_DRAW)))
    return np.stack([half, 1 - half], axis=1).reshape(-1, len(FAILURE_DRAW))[:n]


def largest_failures(rocket: Rocket, failure_time: str) -> np.ndarray:
    """The failures (F, 4) with the longest burns: each group that may fail loses the most, from its ignition on."""
    count = len(failing_groups(rocket, failure_time))
    which = (np.arange(count) + 0.5) / count
    zeros = np.zeros(count)
    return np.column_stack([zeros, which, zeros, zeros + 1])
