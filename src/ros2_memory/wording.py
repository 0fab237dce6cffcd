"""Counts and names as sentences have them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

NAMED: Final = 3
"""How many things a sentence names before it counts the rest."""
_LONGEST: Final = 160
_CUT: Final = "…"


def counted(count: int, singular: str, plural: str | None = None) -> str:
    """A number and what it counts: `1 jump`, `2 jumps`."""
    return f"{count} {singular if count == 1 else plural or singular + 's'}"


def listed(names: Sequence[str], count: int | None = None) -> str:
    """The first few names, and how many more there are of `count` (or of the names)."""
    more = (len(names) if count is None else count) - min(len(names), NAMED)
    shown = ", ".join(shortened(name) for name in names[:NAMED])
    return f"{shown} and {more} more" if more > 0 else shown


def shortened(text: str) -> str:
    """The text, cut where it would fill a sentence."""
    return text if len(text) <= _LONGEST else text[: _LONGEST - 1] + _CUT
