"""Results about what happened: in a window, before a time, and while a value held."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.reply import (
    AGO,
    INSIDE,
    LASTED,
    LOCAL,
    MESSAGE,
    NAME,
    NAMES,
    OBJECTS,
    PAIRS,
    PLAIN,
    POSE,
    SECONDS,
    TENTHS_OF_S,
    TENTHS_OF_S_AGO,
    TIME,
    TOTAL,
    LocalTimes,
    an_object,
    digits,
    itself_if,
    keys,
    objects,
    result,
    unit,
)
from ros2_memory.core.timebase import Ns, unix_from_ns
from ros2_memory.results.base import AnswerWithNotes

if TYPE_CHECKING:
    from ros2_memory.core.model import JsonValue, Pose


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


def _first_change(answer: Changes) -> Ns | None:
    return answer.changes[0].first if answer.changes else None


def _last_until(answer: Changes) -> Ns | None:
    return answer.changes[-1].until if answer.changes else None


@result("topic", "type", TOTAL("total"), OBJECTS("changes"), span=(_first_change, _last_until))
class Changes(AnswerWithNotes):
    """The values that a topic held in a window, in order: the first of `total` of them.

    With `total` whether that is all of them.
    """

    topic: str
    type: str
    total: tuple[int, bool]
    changes: tuple[Spell, ...]


class PastChange(NamedTuple):
    """Something that changed, and how long before another event."""

    text: str
    before: Ns

    @property
    def after(self) -> Ns:
        """How long after the event it changed."""
        return -self.before


_CHANGES: Final = objects(keys("text", TENTHS_OF_S("s_before", "before")))


@result(
    unit(lambda at: round(unix_from_ns(at), 6))("around", "at").in_short,
    SECONDS("seconds_before", "length"),
    _CHANGES("before", "changes").in_short,
    PLAIN("more").if_any,
    objects(keys("text", TENTHS_OF_S("s_after", "after")))("after"),
    "looked_at",
    PLAIN("recorded_topics", "recorded"),
    an_object(
        keys(POSE("robot"), NAME("frame_id", "robot.frame_id"), digits(3)("speed_mps").if_known)
    )("robot", itself_if("robot")).if_known,
    PAIRS("state"),
)
class Before(AnswerWithNotes):
    """What changed before a time.

    Attributes:
        at: the moment.
        length: how long before it changes count.
        changes: nearest first.
        more: how many others there are.
        looked_at: the topics that would show a change and were recorded at the time.
        recorded: how many topics were recorded then in all.
        robot: where the robot was; None where that is not known.
        speed_mps: from its pose topic.
        state: booleans, statuses that are not ok and the goal of each action, at that time.
        after: the first changes in the seconds after, nearest first; their `before` is negative.
    """

    at: Ns
    length: Ns
    changes: tuple[PastChange, ...]
    more: int
    looked_at: tuple[str, ...]
    recorded: int
    robot: Pose | None
    speed_mps: float | None
    state: tuple[tuple[str, bool | str], ...]
    after: tuple[PastChange, ...] = ()


@result(
    TIME("timestamp", "start"),
    LOCAL("local", "start", "end"),
    TENTHS_OF_S_AGO("ago_s", "start"),
    "text",
    LASTED("duration_s", "start", "end", "skipped").when("end"),
    INSIDE("places"),
    digits(4)("score").if_known,
    _CHANGES("before").if_any,
    PLAIN("goes_on").if_any,
)
class Event:
    """Something that happened at `start`, and lasted until `end` if it took time.

    With `goes_on`, the real end is not known. `before`: what changed before, nearest first.
    `places`: the named places that the robot was in, the smallest first. `score`: the best one of a
    thing in view. `skipped`: how much of its time the clock skipped. `point`: where it happened
    (m), in the frame of the recap, where that is known of the robot itself.
    """

    kind: str
    start: Ns
    end: Ns | None
    text: str
    goes_on: bool = False
    before: tuple[PastChange, ...] = ()
    places: tuple[str, ...] = ()
    score: float | None = None
    skipped: Ns = 0
    point: tuple[float, float] | None = None


@result(
    TIME("start"),
    TIME("end"),
    PLAIN("local").if_known,
    LASTED("duration_s", "start", "end", "skipped").in_short,
    digits(3)("distance_m").in_short,
    digits(3)("max_speed"),
    SECONDS("stood_s").in_short,
    SECONDS("shortest_stop_s"),
    an_object(keys("where", "visits", SECONDS("inside_s"))).spread("where", itself_if("where")),
    NAME("frame_id"),
    OBJECTS("events"),
    NAMES("seen_throughout", "throughout").if_any,
    PAIRS("counts").in_short,
    digits(3)("path_sum_m").if_known,
    digits(3)("gap_m").if_known,
    span=("start", "end"),
)
class Recap(AnswerWithNotes):
    """What happened in a window.

    Attributes:
        start: of the window, inclusive.
        end: of the window, inclusive.
        now: what ages count from.
        distance_m: length of the driven path; None, as what follows, where no pose gives it.
        max_speed: in m/s.
        stood: how long the robot stood in all, in standstills of `shortest_stop` or longer. One
            that goes on outside of the window counts as far as it is inside, so the times of
            windows that follow each other add up. None where poses are there, but too noisy or too
            few to know.
        shortest_stop: shorter stops do not count.
        frame_id: of the places in texts.
        events: what happened, in order of time.
        throughout: things that a detector saw during the whole window at its usual rate.
        counts: how many events of each kind there were, also of those that are left out.
        path_sum_m: the plain sum of distances, if noise adds much to it.
        gap_m: the path across gaps in the recording, in straight lines; None without a gap.
        where: the region's name, or its bounds, where only what happened there was asked for.
        visits: how often the robot was there; `inside` is how long in all.
        skipped: how much of the window the clock skipped.
    """

    start: Ns
    end: Ns
    now: Ns
    distance_m: float | None
    max_speed: float | None
    stood: Ns | None
    shortest_stop: Ns
    frame_id: str | None
    events: tuple[Event, ...]
    throughout: tuple[str, ...]
    counts: tuple[tuple[str, int], ...] = ()
    path_sum_m: float | None = None
    gap_m: float | None = None
    where: JsonValue = None
    visits: int = 0
    inside: Ns = 0
    skipped: Ns = 0

    @property
    def local(self) -> str | None:
        """The window in local time, if it is long or long ago; events have that in a long one."""
        return LocalTimes(self.start, self.now).text(self.start, self.end)
