"""What a script's flags may be, beside their fields in `Args`.

A field's type tells what its flag takes: a `Range` of numbers or the `Words` of a text. `Policy` tells whether a
policy's file decides the flag. `facts` finds them.
"""

from __future__ import annotations

from dataclasses import fields
from enum import Enum
from typing import Annotated, Any, NamedTuple, TypeVar, get_args, get_type_hints

import tyro

from common.schedule import Schedule


class Range(NamedTuple):
    """The lowest and highest number. NaN and infinity are out of range."""

    low: float
    high: float


class Words(NamedTuple):
    """The words that a text may be."""

    words: tuple[str, ...]


class Policy(Enum):
    """What the file of a policy says of a flag. It says nothing of a flag without this mark."""

    FIXES = "the file decides, and another value on the command line is refused"
    SUGGESTS = "the file decides unless the flag is typed, or the recipe of a further training names it"


Recipe = Annotated[str, Words(("ours", "paper"))]
Natural = Annotated[int, Range(0, 2**31 - 1)]
Count = Annotated[int, Range(1, 10**6)]
Starts = Annotated[int, Range(10, 10**6)]
Threads = Annotated[int, Range(0, 256)]
Share = Annotated[float, Range(0.0, 1.0)]
Decay = Annotated[float, Range(0.0, 0.99999)]
Weight = Annotated[float, Range(0.0, 1e3)]
Positive = Annotated[float, Range(1e-9, 1e9)]
ShareSchedule = Annotated[Schedule, Range(0.0, 1.0)]
WeightSchedule = Annotated[Schedule, Range(0.0, 1e3)]
CountSchedule = Annotated[Schedule, Range(1, 10**6)]
Numbers = Annotated[
    list | None,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs="*",
        metavar="NUMBER ...",
        instance_from_str=lambda words: [float(word) for word in " ".join(words).split()],
        is_instance=lambda value: value is None or isinstance(value, list),
        str_from_instance=lambda value: [str(number) for number in value or ()],
    ),
]
LogStd = Annotated[Schedule, Range(-8.0, 0.5)]

# of a policy: its network, and what it observes
Blocks = Annotated[int, Range(0, 64), Policy.FIXES]
Width = Annotated[int, Range(1, 8192), Policy.FIXES]
Length = Annotated[int, Range(0, 8192), Policy.FIXES]
Observed = Annotated[bool, Policy.FIXES]

Fact = TypeVar("Fact")


def facts(kind: type, wanted: type[Fact]) -> dict[str, Fact]:
    """{field: its Range, Words or Policy} of the fields of an Args that have one. `wanted` is one of the three."""
    hints = get_type_hints(kind, include_extras=True)
    found = {name: [fact for fact in noted(hint) if isinstance(fact, wanted)] for name, hint in hints.items()}
    return {name: facts[0] for name, facts in found.items() if facts}


def noted(hint: Any) -> list:
    """All that is annotated to a type or, as in `Share | None`, to a part of it."""
    found = list(getattr(hint, "__metadata__", ()))
    for part in get_args(hint):
        found += noted(part)
    return found


def parse_schedules(args) -> None:
    """Replace the number or words of each schedule by the Schedule. Raises ValueError with words that are none."""
    for field in fields(args):
        if isinstance(field.default, Schedule):
            try:
                schedule = Schedule(getattr(args, field.name))
            except ValueError as error:
                raise ValueError(f"{field.name}: {error}") from None
            setattr(args, field.name, schedule)


def plain_args(args) -> dict[str, Any]:
    """The arguments as a file holds them: a schedule is a number or words. Args(**plain_args(args)) == args."""
    return {name: value.plain if isinstance(value, Schedule) else value for name, value in vars(args).items()}
