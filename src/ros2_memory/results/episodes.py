"""Results about values that hold until the next: what a robot did, and a topic's changes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.core.reply import (
    AGO,
    LASTED,
    LOCAL,
    MESSAGE,
    NAME,
    OBJECTS,
    PLAIN,
    POSE,
    TIME,
    an_object,
    itself_if,
    keys,
    result,
)
from ros2_memory.results.base import AnswerWithNotes

if TYPE_CHECKING:
    from ros2_memory.core.model import JsonValue, Pose
    from ros2_memory.core.timebase import Ns

MOST_SAID: Final = 30
"""Values of another topic that are listed for one interval; of more there is their number."""


@result(
    TIME("start", "first"),
    LOCAL("local", "first", "until"),
    LASTED("seconds", "first", "until", "skipped"),
    MESSAGE("value"),
    PLAIN("ended").when("goes_on"),
)
class Spell:
    """A value that held from `first`, of the message that says so, to `until`.

    `ended`: whether a message says otherwise then; else no more is known. `skipped` is how much of
    that the clock skipped.
    """

    value: JsonValue
    first: Ns
    until: Ns
    ended: bool = True
    skipped: Ns = 0

    @property
    def goes_on(self) -> bool:
        """Whether no message says that it ended."""
        return not self.ended


BESIDE: Final = an_object(
    keys(MESSAGE("value"), TIME("start", "first"), LOCAL("local", "first", "first"))
)
SAID: Final = OBJECTS("with", "said").if_known.first(MOST_SAID)


@result(
    TIME("start", "spell.first"),
    TIME("end", "spell.until"),
    LOCAL("local", "spell.first", "spell.until"),
    LASTED("seconds", "spell.first", "spell.until", "skipped"),
    AGO("ago_s", "spell.until"),
    MESSAGE("value", "spell.value"),
    PLAIN("ended", "spell.ended").when("spell.goes_on"),
    an_object(keys(POSE("robot"), NAME("frame_id", "robot.frame_id")))(
        "robot", itself_if("robot")
    ).if_known,
    BESIDE("previous").if_known,
    BESIDE("next", "following").if_known,
    SAID,
)
class Episode:
    """A text that held, the texts before and after it, and where the robot was when it began.

    Attributes:
        spell: when it held.
        previous: the text before; None where there is none, or it was not reached in time.
        following: the text after, likewise.
        robot: its pose then, where it is known.
        said: what another topic said meanwhile, if that was asked.
        skipped: how much of the time that it held the clock skipped.
    """

    spell: Spell
    previous: Spell | None
    following: Spell | None
    robot: Pose | None = None
    said: tuple[Spell, ...] | None = None
    skipped: Ns = 0

    @property
    def first(self) -> Ns:
        """When it began."""
        return self.spell.first

    @property
    def until(self) -> Ns:
        """Until when it held."""
        return self.spell.until


def _first(answer: Changes) -> Ns | None:
    return answer.changes[0].first if answer.changes else None


def _until(answer: Changes) -> Ns | None:
    return answer.changes[-1].until if answer.changes else None


@result("topic", "type", "total", OBJECTS("changes"), span=(_first, _until))
class Changes(AnswerWithNotes):
    """The values that a topic held in a window, in order: the first of `total` of them."""

    topic: str
    type: str
    total: int
    changes: tuple[Spell, ...]
