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
    AnswerWithNotes,
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

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import JsonValue, Pose
    from ros2_memory.core.timebase import Span


MOST_SAID: Final = 30
"""Values of another topic that are listed for one interval; further ones are counted."""


@result(
    TIME("start", "first"),
    LOCAL("local", "first", "until"),
    LASTED("seconds", "first", "until", "skipped"),
    MESSAGE("value"),
    PLAIN("ended").when("goes_on"),
)
class Spell:
    """A value that held for some time.

    Attributes:
        value: the value.
        first: log time of the message that says so.
        until: log time of the message that says otherwise; the last known time if not `ended`.
        ended: whether a message says otherwise.
        skipped: how much of the time the clock skipped.
    """

    value: JsonValue
    first: Ns
    until: Ns
    ended: bool = True
    skipped: Ns = 0

    @property
    def goes_on(self) -> bool:
        """Whether no message says that the value ended."""
        return not self.ended


BESIDE: Final = an_object(
    keys(MESSAGE("value"), TIME("start", "first"), LOCAL("local", "first", "first"))
)
SAID: Final = OBJECTS("with", "said").if_known.first(MOST_SAID)


@result(
    TIME("start", "first"),
    TIME("end", "until"),
    LOCAL("local", "first", "until"),
    LASTED("seconds", "first", "until", "skipped"),
    AGO("ago_s", "until"),
    MESSAGE("value", "spell.value"),
    PLAIN("began_earlier").if_any,
    PLAIN("ended").when("goes_on"),
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
        spell: the text, and when it held.
        parts: the first and the last log time of each part of that time in the place that was
            asked about, or while what was asked for held, in order; all of it without these.
        previous: the text before; None if there is none, or if time ran out before it was found.
        following: the text after; None as for `previous`.
        robot: its pose when the text began; None if it is not known.
        said: values of another topic meanwhile; None if they were not asked for.
        skipped: how much of the time from `first` to `until` the clock skipped, or is in no part.
    """

    spell: Spell
    parts: Sequence[Span]
    previous: Spell | None
    following: Spell | None
    robot: Pose | None = None
    said: tuple[Spell, ...] | None = None
    skipped: Ns = 0

    @property
    def first(self) -> Ns:
        """When it began, or was first known in a part."""
        first, _ = self.parts[0]
        return first

    @property
    def until(self) -> Ns:
        """Until when it held in the last part."""
        _, until = self.parts[-1]
        return until

    @property
    def began_earlier(self) -> bool:
        """Whether it began before its first part."""
        return self.first > self.spell.first

    @property
    def ended(self) -> bool:
        """Whether a message ended it at `until`."""
        return self.spell.ended and self.until == self.spell.until

    @property
    def goes_on(self) -> bool:
        """Whether no message ended it at `until`."""
        return not self.ended


def _first_change(answer: Changes) -> Ns | None:
    return answer.changes[0].first if answer.changes else None


def _last_until(answer: Changes) -> Ns | None:
    return answer.changes[-1].until if answer.changes else None


@result("topic", "type", TOTAL("total"), OBJECTS("changes"), span=(_first_change, _last_until))
class Changes(AnswerWithNotes):
    """The first values that a topic held in a window, in order.

    `total` is how many there are, and whether all were counted.
    """

    topic: str
    type: str
    total: tuple[int, bool]
    changes: tuple[Spell, ...]


class PastChange(NamedTuple):
    """A change in words, and how long before an event it happened (ns)."""

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
    an_object(
        keys(POSE("robot"), NAME("frame_id", "robot.frame_id"), digits(3)("speed_mps").if_known)
    )("robot", itself_if("robot")).if_known,
    PAIRS("state"),
)
class Before(AnswerWithNotes):
    """What changed before a time.

    Attributes:
        at: the time.
        length: how long before it changes are listed (ns).
        changes: the nearest first.
        more: how many others there are.
        looked_at: the topics that would show a change and were recorded at the time.
        robot: the pose of the robot; None if it is not known.
        speed_mps: from its pose topic.
        state: booleans, statuses that are not ok and the goal of each action, at that time.
        after: the first changes in the seconds after, nearest first; their `before` is negative.
    """

    at: Ns
    length: Ns
    changes: tuple[PastChange, ...]
    more: int
    looked_at: tuple[str, ...]
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
    """Something that happened.

    Attributes:
        kind: of the event.
        start: when it began.
        end: when it ended; None if it took no time.
        text: the event in words.
        goes_on: whether it had not ended at `end`.
        before: what changed before, nearest first.
        places: the named places that the robot was in, the smallest first.
        score: the best score of a thing in view.
        skipped: how much of its time the clock skipped.
        point: where the robot was (m), in the frame of the recap; None if that is not known.
        topic: whose message it is, of booleans; else empty.
        label: of a thing in view; else empty.
        times: how many sights of a thing it stands for.
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
    topic: str = ""
    label: str = ""
    times: int = 1

    @property
    def length(self) -> Ns:
        """How long it took (ns), also by a clock that skipped a part."""
        return (self.end or self.start) - self.start


@result(
    TIME("start"),
    TIME("end"),
    PLAIN("local").if_known,
    LASTED("duration_s", "start", "end", "skipped").in_short,
    digits(3)("distance_m").in_short,
    digits(3)("max_speed"),
    SECONDS("stood_s").in_short,
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
        distance_m: length of the driven path; None without poses.
        max_speed: in m/s; None without poses.
        stood: how long the robot stood in standstills that are no shorter than stops. A standstill
            counts as far as it is inside the window, so the times of successive windows add up.
            None without poses, and if they are too noisy or too few to know.
        frame_id: of the places in texts.
        events: what happened, in order of time.
        throughout: things that a detector saw during the whole window at its usual rate.
        counts: how many events of each kind there were, with those that are not listed.
        longest_sights: the longest sight of each other label, in order of time; of as many labels
            as there may be events.
        path_sum_m: the plain sum of distances, if noise adds much to it.
        gap_m: the path across gaps in the recording, in straight lines; None without a gap.
        where: the name or the bounds of the region that was asked about; None for everywhere.
        visits: how often the robot was in the region.
        inside: for how long it was in the region in all.
        skipped: how much of the window the clock skipped.
    """

    start: Ns
    end: Ns
    now: Ns
    distance_m: float | None
    max_speed: float | None
    stood: Ns | None
    frame_id: str | None
    events: tuple[Event, ...]
    throughout: tuple[str, ...]
    counts: tuple[tuple[str, int], ...] = ()
    longest_sights: tuple[Event, ...] = ()
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
