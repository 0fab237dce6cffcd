"""What a digest depends on besides its bag, so that every configuration that reads alike shares it.

The text of a bag's configuration names the types in the bag: entries of the schema map for other
types do not matter to it. Pure.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


@dataclass(frozen=True, slots=True)
class DigestConfig:
    """Settings and schema entries, as hashes.

    Attributes:
        base: hash of the settings and versions on which every digest depends.
        entries: by message type, the hash of its entry in the schema map.
    """

    base: str
    entries: Mapping[str, str] = field(default_factory=dict)

    def text(self, types: Iterable[str]) -> str:
        """Returns what identifies the configuration of a bag with messages of these types."""
        return json.dumps([self.base, {name: self._entry(name) for name in sorted({*types})}])

    def reads(self, text: str) -> bool:
        """Returns whether a digest stored under this text is the one made under this."""
        parsed = _parsed(text)
        if parsed is None:
            return False
        base, entries = parsed
        return base == self.base and all(self._entry(name) == entries[name] for name in entries)

    def _entry(self, type_name: str) -> str:
        return self.entries.get(type_name, "")


def may_be_one(text: str, other: str) -> bool:
    """Returns whether one configuration may have written digests under both texts."""
    parsed, others = _parsed(text), _parsed(other)
    if parsed is None or others is None:
        return text == other
    base, entries = parsed
    shared = entries.keys() & others[1].keys()
    return base == others[0] and all(entries[name] == others[1][name] for name in shared)


def _parsed(text: str) -> tuple[str, dict[str, str]] | None:
    """Returns the hash and the entries of a text; None for one that another program wrote."""
    with suppress(ValueError):
        match json.loads(text):
            case [str(base), dict(entries)]:
                return base, entries
    return None
