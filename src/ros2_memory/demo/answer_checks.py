"""Checks of answers: reads a reply's JSON, and knows which messages it may be about.

The memory answers from closed splits, and "ago" counts from the moment at which the server read
its clock. Neither is known to the client exactly, only between two bounds; so a question has a
few messages that it may rightly be answered with, and each of them has its one right value.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, TypeVar

from ros2_memory.core.timebase import (
    Ns,
    ns_from_unix,
    unix_from_ns,
    unix_rounded_up,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ros2_memory.core.model import JsonValue
    from ros2_memory.demo.published_topics import Message, MessageSchedule, Stream

T = TypeVar("T")

METRES: Final = 1e-3
DEGREES: Final = 0.05
"""The tolerance of an answer: its rounding, with some room."""

_SAME_MOMENT_S: Final = 2e-6


class WrongAnswerError(Exception):
    """The answer is wrong; the text has the expected one."""


@dataclass(frozen=True, slots=True)
class CallContext:
    """The circumstances of one call.

    Attributes:
        timeline: what the robot did when.
        before: the wall clock before the call.
        after: the wall clock after the call.
        known: up to which log time the memory may have reached: the end of the newest split that
            it must have known, and of each that was closed since.
    """

    timeline: MessageSchedule
    before: Ns
    after: Ns
    known: tuple[Ns, ...]

    def ago(self, stream: Stream, seconds: float) -> list[Message]:
        """Returns the messages that may be the newest so many seconds before now."""
        back = ns_from_unix(seconds)
        fits: list[Message] = []
        for message in self.timeline.newest_first(stream, self.after - back):
            fits.append(message)
            if message.log_time <= self.before - back:
                break
        return fits

    def newest_known(self, stream: Stream) -> list[Message]:
        """Returns the messages that may be the newest one that the memory knows."""
        return self.last_where(stream, lambda _: True)

    def last_where(self, stream: Stream, holds: Callable[[float], bool]) -> list[Message]:
        """Returns the messages that may be the newest known one for which `holds(t)` is true."""
        newest_first = (self.timeline.newest_first(stream, end) for end in self.known)
        fits = (next((one for one in some if holds(one.t)), None) for some in newest_first)
        return [message for message in fits if message is not None]

    def when(self, moment_s: float) -> str:
        """Formats a time (Unix seconds): its local time and how long ago it was."""
        local = datetime.fromtimestamp(moment_s, tz=UTC).astimezone()
        return f"{local:%H:%M:%S}, {self.age_s(moment_s):.1f} s ago"

    def age_s(self, moment_s: float) -> float:
        """Returns the age of a time (Unix seconds) when the answer came."""
        return unix_from_ns(self.after) - moment_s


def parsed(text: str) -> JsonValue:
    """Parses the JSON of a reply.

    Raises:
        WrongAnswerError: it is not JSON (NaN and infinities are not).
    """
    try:
        value: JsonValue = json.loads(text, parse_constant=_no_number)
    except ValueError as error:
        raise WrongAnswerError(f"expected JSON: {error}") from error
    return value


def at(value: JsonValue, *path: str | int) -> JsonValue:
    """Returns the value at a path of keys and indices.

    Raises:
        WrongAnswerError: nothing does.
    """
    here = value
    for step in path:
        match here, step:
            case dict(), str() if step in here:
                here = here[step]
            case list(), int() if -len(here) <= step < len(here):
                here = here[step]
            case _:
                raise WrongAnswerError(f"expected {step!r} in {_brief(here)}")
    return here


def number(value: JsonValue, *path: str | int) -> float:
    """Returns the number at a path.

    Raises:
        WrongAnswerError: there is none.
    """
    return float(_typed(value, path, "a number", int, float))


def text(value: JsonValue, *path: str | int) -> str:
    """Returns the string at a path.

    Raises:
        WrongAnswerError: there is none.
    """
    return _typed(value, path, "a string", str)


def items(value: JsonValue, *path: str | int) -> list[JsonValue]:
    """Returns the list at a path.

    Raises:
        WrongAnswerError: there is none.
    """
    return _typed(value, path, "a list", list)


def _typed(value: JsonValue, path: Sequence[str | int], what: str, *kinds: type[T]) -> T:
    found = at(value, *path)
    if isinstance(found, bool) or not isinstance(found, kinds):
        named = ".".join(map(str, path)) or "the top"
        raise WrongAnswerError(f"expected {what} at {named}, not {_brief(found)}")
    return found


def one_of(what: str, moment_s: float, moments: Sequence[Ns]) -> None:
    """Checks that a time (Unix seconds) is one of several.

    Raises:
        WrongAnswerError: it is not.
    """
    if not any(abs(unix_rounded_up(one) - moment_s) < _SAME_MOMENT_S for one in moments):
        right = " or ".join(f"{unix_rounded_up(one):.6f}" for one in moments[:4])
        raise WrongAnswerError(f"expected {what} {right or 'no moment'}, not {moment_s:.6f}")


def match_time(moment_s: float, candidates: Sequence[Message]) -> Message:
    """Returns the candidate with this log time (Unix seconds).

    Raises:
        WrongAnswerError: none of them.
    """
    one_of("the message of", moment_s, [message.log_time for message in candidates])
    return min(candidates, key=lambda one: abs(unix_rounded_up(one.log_time) - moment_s))


def near(what: str, got: float, expected: float, tolerance: float) -> None:
    """Checks that two numbers agree.

    Raises:
        WrongAnswerError: they do not.
    """
    if not abs(got - expected) <= tolerance:
        raise WrongAnswerError(f"expected {what} {expected:.4f}, not {got:.4f}")


def near_angle(
    what: str, got_deg: float, expected_rad: float, tolerance_deg: float = DEGREES
) -> None:
    """Checks that two angles are the same direction.

    Raises:
        WrongAnswerError: they are not.
    """
    expected = math.degrees(expected_rad)
    off = (got_deg - expected + 180.0) % 360.0 - 180.0
    if not abs(off) <= tolerance_deg:
        raise WrongAnswerError(f"expected {what} {expected:.2f} degrees, not {got_deg:.2f}")


def same(what: str, got: object, expected: object) -> None:
    """Checks that two values are equal.

    Raises:
        WrongAnswerError: they are not.
    """
    if got != expected:
        raise WrongAnswerError(f"expected {what} {expected}, not {got}")


def within(what: str, moment_s: float, bounds: tuple[Ns, Ns]) -> None:
    """Checks that a time (Unix seconds) is between two bounds, both included.

    Raises:
        WrongAnswerError: it does not.
    """
    first, last = map(unix_rounded_up, bounds)
    if not first - _SAME_MOMENT_S <= moment_s <= last + _SAME_MOMENT_S:
        raise WrongAnswerError(
            f"expected {what} between {first:.6f} and {last:.6f}, not {moment_s:.6f}"
        )


def _no_number(constant: str) -> float:
    raise ValueError(f"{constant} is not JSON")


def _brief(value: JsonValue) -> str:
    whole = json.dumps(value)
    return whole if len(whole) <= 60 else f"{whole[:57]}..."
