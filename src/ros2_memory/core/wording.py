"""Counts and names as sentences have them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

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


@dataclass(frozen=True, slots=True)
class Reason:
    """What is wrong with several things, for one sentence on all of them.

    Attributes:
        what: the sentence after its subject; `many` where that differs for several.
        noun: what the things are; `plural` where that is not `noun` with an s.
        of: what stands before the noun or the name, such as "messages of ".
    """

    what: str
    noun: str
    plural: str | None = None
    of: str = ""
    many: str | None = None

    def sentence(self, things: Mapping[str, str]) -> str:
        """The sentence on these things; each has a detail of its own, or an empty one."""
        [name, detail], *others = sorted(things.items())
        if not others:
            return f"{self.of}{name} {self.what}" + (f": {detail}" if detail else "")
        named = [f"{each} ({why})" if why else each for each, why in sorted(things.items())]
        subject = f"{self.of}{counted(len(things), self.noun, self.plural)}"
        return f"{subject} {self.many or self.what}: {listed(named)}"


def shortened(text: str) -> str:
    """The text, cut where it would fill a sentence."""
    return text if len(text) <= _LONGEST else text[: _LONGEST - 1] + _CUT
