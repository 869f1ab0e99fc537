"""Errors that end in one line, and the checks that raise them."""

from __future__ import annotations

from dataclasses import fields

import numpy as np


class BadInput(ValueError):
    """A value or file that a user gave and nothing can be done with; its message is the one line that is shown."""


class NoOptimum(RuntimeError):
    """A reference that was not found, or does not fly as it was solved; its message is one line."""


def refuse_unless(possible, field: str, value, allowed: str):
    """BadInput with one line that names the field, the value and what is allowed."""
    if not possible:
        raise BadInput(f"{field} is {value}; it {allowed}")


def is_finite(value) -> bool:
    """Whether it is a number, and not infinite."""
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value))


def refuse_unless_finite(whose: str, table):
    """BadInput for the first number of a dataclass that is not one, or is infinite."""
    for field in fields(table):
        value = getattr(table, field.name)
        if field.type == "float":
            refuse_unless(is_finite(value), f"{whose} {field.name}", value, "must be a finite number")
