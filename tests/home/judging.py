"""Judges an answer: each of its fields against what is true, within a tolerance.

An answer is an object with a value for each field that the question names. Times may be Unix
seconds or ISO 8601 (UTC without an offset), texts are compared without case.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Protocol, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ros2_memory.core.model import JsonValue

_NOTHING = ("none", "nothing", "no reason", "not recorded", "unknown", "not known")
_NO = "no "
_NO_WAY = "no way"
"""An answer that begins so gives a reason; one that begins with another "no" gives none."""

Answer: TypeAlias = "Mapping[str, JsonValue]"


class Expected(Protocol):
    """What is true of one field of an answer."""

    def accepts(self, given: JsonValue) -> bool:
        """Returns whether a value is right."""
        ...

    def as_json(self) -> dict[str, JsonValue]:
        """Returns it in plain values."""
        ...


@dataclass(frozen=True, slots=True)
class Number:
    """A number, right within a tolerance."""

    value: float
    within: float = 0.0

    def accepts(self, given: JsonValue) -> bool:
        """Returns whether a number is near enough."""
        if isinstance(given, bool) or not isinstance(given, int | float):
            return False
        return abs(given - self.value) <= self.within + 1e-9

    def as_json(self) -> dict[str, JsonValue]:
        """Returns `number` and `within`."""
        return {"number": round(self.value, 3), "within": round(self.within, 3)}


@dataclass(frozen=True, slots=True)
class Time:
    """A moment between two others."""

    earliest: float
    latest: float

    def accepts(self, given: JsonValue) -> bool:
        """Returns whether a moment lies between them."""
        at = unix_of(given)
        return at is not None and self.earliest <= at <= self.latest

    def as_json(self) -> dict[str, JsonValue]:
        """Returns `earliest` and `latest`."""
        return {"earliest": round(self.earliest, 3), "latest": round(self.latest, 3)}


@dataclass(frozen=True, slots=True)
class Words:
    """A text that holds one of some words, if there are any, and none of others.

    `or_none`: it is a short word, or says that there is none.
    """

    any_of: tuple[str, ...] = ()
    none_of: tuple[str, ...] = ()
    or_none: bool = False

    def accepts(self, given: JsonValue) -> bool:
        """Returns whether the text is right."""
        if not isinstance(given, str):
            return False
        text = given.casefold().strip()
        if not self.any_of and _says_none(text):
            return True
        if any(word in text for word in self.none_of):
            return False
        return not self.any_of or any(word in text for word in self.any_of)

    def as_json(self) -> dict[str, JsonValue]:
        """Returns `any_of` and `none_of`."""
        return {"any_of": [*self.any_of], "none_of": [*self.none_of]}


@dataclass(frozen=True, slots=True)
class YesNo:
    """Yes or no."""

    value: bool

    def accepts(self, given: JsonValue) -> bool:
        """Returns whether it is the same."""
        return given is self.value

    def as_json(self) -> dict[str, JsonValue]:
        """Returns `is`."""
        return {"is": self.value}


@dataclass(frozen=True, slots=True)
class Names:
    """A set of names: all of some, and besides them none but those of others."""

    all_of: frozenset[str]
    maybe: frozenset[str] = frozenset()

    def accepts(self, given: JsonValue) -> bool:
        """Returns whether the set is right; names may come twice, and in any order."""
        if not isinstance(given, list):
            return False
        named = {str(each).casefold() for each in given}
        return self.all_of <= named <= self.all_of | self.maybe

    def as_json(self) -> dict[str, JsonValue]:
        """Returns `all_of` and `maybe`."""
        return {"all_of": [*sorted(self.all_of)], "maybe": [*sorted(self.maybe)]}


@dataclass(frozen=True, slots=True)
class Series:
    """A value for each of some names; a name that is left out counts as 0."""

    values: Mapping[str, Expected]

    def accepts(self, given: JsonValue) -> bool:
        """Returns whether every value is right, and no other name has one but 0."""
        if not isinstance(given, dict):
            return False
        named = {name.casefold(): value for name, value in given.items()}
        extra = [value for name, value in named.items() if name not in self.values]
        if any(extra):
            return False
        return all(expected.accepts(named.get(name, 0)) for name, expected in self.values.items())

    def as_json(self) -> dict[str, JsonValue]:
        """Returns `series`."""
        return {"series": {name: each.as_json() for name, each in self.values.items()}}


@dataclass(frozen=True, slots=True)
class Order:
    """Names in order."""

    names: tuple[str, ...]

    def accepts(self, given: JsonValue) -> bool:
        """Returns whether they are the same in the same order."""
        return isinstance(given, list) and [str(each).casefold() for each in given] == [*self.names]

    def as_json(self) -> dict[str, JsonValue]:
        """Returns `in_order`."""
        return {"in_order": [*self.names]}


def right(truth: Mapping[str, Expected], answer: Answer) -> bool:
    """Returns whether every field of an answer is right."""
    return not wrong_fields(truth, answer)


def wrong_fields(truth: Mapping[str, Expected], answer: Answer) -> Sequence[str]:
    """Returns the names of the fields that are wrong or absent."""
    return [
        name
        for name, expected in truth.items()
        if name not in answer or not expected.accepts(answer[name])
    ]


def _says_none(text: str) -> bool:
    is_no = text.startswith(_NO) and not text.startswith(_NO_WAY)
    return is_no or text in {"", "no"} or text.startswith(_NOTHING)


def unix_of(given: JsonValue) -> float | None:
    """Returns a time as Unix seconds; None where it is none."""
    if isinstance(given, bool):
        return None
    if isinstance(given, int | float):
        return float(given)
    if not isinstance(given, str):
        return None
    try:
        at = datetime.fromisoformat(given)
    except ValueError:
        return None
    return (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()
