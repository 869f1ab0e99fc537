"""Errors that end in one line, and the checks that raise them."""

from __future__ import annotations

from dataclasses import fields

import numpy as np


class BadInput(ValueError):
    """A value or file of a user that cannot be used. Its message is the one line that is shown."""


class BadOption(BadInput, TypeError):
    """An option that an environment does not take. TorchRL tries options, and goes on without one at a TypeError."""


class NoOptimum(RuntimeError):
    """A reference that was not found, or that does not fly as it was solved. Its message is one line."""


def refuse_unless(possible, field: str, value, allowed: str):
    """Raise BadInput with one line that names the field, the value and what is allowed, unless `possible`."""
    if not possible:
        raise BadInput(f"{field} is {value}; it {allowed}")


def is_finite(value) -> bool:
    """Whether `value` is a finite number."""
    return isinstance(value, int | float | np.number) and bool(np.isfinite(value))


def refuse_unless_finite(whose: str, table):
    """Raise BadInput for the first float field of a dataclass that is not a finite number."""
    for field in fields(table):
        value = getattr(table, field.name)
        if field.type == "float":
            refuse_unless(is_finite(value), f"{whose} {field.name}", value, "must be a finite number")
