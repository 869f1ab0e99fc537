"""A number that may change during a training."""

from __future__ import annotations

import numpy as np


class Schedule:
    """One number, or points "place:value place:value ...". Place 0 is a training's first update, place 1 the last.

    Lines join the points. If two points have one place, the second counts from there on. `values` are the numbers that
    the points have. `has_points` tells a schedule of points from one number, which is constant.

    str() gives back the words. Raises ValueError if the words are no schedule.
    """

    def __init__(self, words):
        self.words = str(words)
        self.has_points = ":" in self.words
        points = self.words.split() if self.has_points else [f"0:{self.words}"]
        try:
            pairs = [point.split(":") for point in points]
            self.places = [float(place) for place, _ in pairs]
            self.values = [float(value) for _, value in pairs]
            rises = self.places == sorted(self.places)
            if not rises or not all(0 <= place <= 1 for place in self.places):
                raise ValueError
        except ValueError:
            allowed = "must be a number, or points as 0:-1 0.4:-2 1:-6 whose places rise from 0 to 1"
            given = self.words or "nothing"
            raise ValueError(f"{given}: {allowed}") from None

    def at(self, progress: float) -> float:
        """The value at a progress, which is 0 in the first update and 1 in the last."""
        return float(np.interp(progress, self.places, self.values))

    def over(self, updates: int) -> np.ndarray:
        """The values (updates,) of all updates of a training."""
        return np.interp(np.arange(updates) / max(updates - 1, 1), self.places, self.values)

    def replaced(self, value: float, other: float) -> Schedule:
        """The same schedule with `other` where it has `value`."""
        values = [other if old == value else old for old in self.values]
        if not self.has_points:
            return Schedule(values[0])
        points = zip(self.places, values)
        return Schedule(" ".join(f"{place:.15g}:{value:.15g}" for place, value in points))

    @property
    def plain(self) -> int | float | str:
        """What a file holds: the number, or the points' words. `Schedule` reads it again."""
        if self.has_points:
            return self.words
        return int(self.words) if self.words.isdigit() else float(self.words)

    def __str__(self):
        return self.words

    def __repr__(self):
        return f"Schedule({self.plain!r})"

    def __eq__(self, other):
        if not isinstance(other, Schedule):
            return NotImplemented
        same_points = (self.places, self.values) == (other.places, other.values)
        return same_points and self.has_points == other.has_points

    def __hash__(self):
        return hash((tuple(self.places), tuple(self.values), self.has_points))
