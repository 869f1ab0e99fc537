"""The lines of printed tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def lines_of(rows: Sequence[Iterable[str]]) -> list[str]:
    """A line for each row (label, cell, ...): labels to the left, as wide as the longest, cells to the right."""
    width = max(len(label) for label, *_ in rows)
    return [f"  {label:<{width}}{''.join(f' {cell:>11}' for cell in cells)}".rstrip() for label, *cells in rows]
