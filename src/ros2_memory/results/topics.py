"""Results about topics: what was recorded, one message or many, when a condition held, counts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal, TypeAlias

from ros2_memory.core.reply import (
    AGO,
    INSIDE,
    LASTED,
    LOCAL,
    MESSAGE,
    NAME,
    OBJECT,
    OBJECTS,
    PAIRS,
    PLAIN,
    POSE,
    SECONDS,
    TIME,
    TOTAL,
    XYZ,
    Absent,
    JsonObject,
    LocalTimes,
    Scope,
    Unit,
    an_object,
    by_name,
    digits,
    itself_if,
    keys,
    moment,
    objects,
    result,
    rounded,
    texts,
    unit,
)
from ros2_memory.core.text import dotted, named, quote
from ros2_memory.core.timebase import NS_PER_S, Ns, local_time, unix_from_ns
from ros2_memory.results.base import AnswerWithNotes
from ros2_memory.results.recap import SAID, Episode, Spell

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from ros2_memory.core.model import JsonValue, Pose, Sample, Vector3

_MINUTE_S: Final = 60
_MOST_MATCHED: Final = 5
_LONGEST_MATCHED: Final = 200
"""Texts that matched in one message, and characters of each."""


@result("topic", "type", TIME("first_ts", "first"), TIME("last_ts", "last"), "count")
class TopicRow:
    """One topic under one type over all bags; each message counts once."""

    topic: str
    type: str
    first: Ns
    last: Ns
    count: int
    undecodable: str | None = None
    notes: tuple[str, ...] = ()


@result(
    "topic",
    "type",
    TIME("timestamp", "sample.time"),
    MESSAGE("value", "sample.value"),
    PLAIN("latched").if_any,
    SECONDS("age_s").if_known,
)
class TopicValue(AnswerWithNotes):
    """One message of one topic; with `latched` it is valid at any age.

    `age` counts back from now for a relative question, else from the time asked about. `frame_id`
    is that of the message's header; empty where it has none.
    """

    topic: str
    type: str
    sample: Sample
    age: Ns | None = None
    latched: bool = False
    frame_id: str = ""


@result(
    digits(6)("min", "least"),
    TIME("min_at", "least_at"),
    digits(6)("max", "most"),
    TIME("max_at", "most_at"),
    LOCAL("min_local", "least_at", "least_at"),
    LOCAL("max_local", "most_at", "most_at"),
)
class Extremes:
    """The minimum and maximum of a field, and the first time of each."""

    field: str
    least: float
    least_at: Ns
    most: float
    most_at: Ns


def _first_time(answer: TopicRange) -> Ns | None:
    return answer.samples[0].time if answer.samples else None


def _last_time(answer: TopicRange) -> Ns | None:
    return answer.samples[-1].time if answer.samples else None


@result(
    "topic",
    "type",
    "total",
    objects(keys(TIME("timestamp", "time"), LOCAL("local", "time", "time"), MESSAGE("value")))(
        "samples"
    ).unless("fields"),
    PLAIN("fields", "columns").when("fields"),
    PLAIN("rows").when("fields"),
    by_name(OBJECT)("extremes", "extremes_by_field").if_any,
    span=(_first_time, _last_time),
)
class TopicRange(AnswerWithNotes):
    """Samples of a window, evenly spaced over all `total` messages in it, with the first and last.

    Their values are objects by `fields`, if any were requested. `extremes` are those of all
    messages, for the requested numeric fields.
    """

    topic: str
    type: str
    total: int
    samples: tuple[Sample, ...]
    extremes: tuple[Extremes, ...] = ()
    fields: tuple[str, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of the table: a field that holds an object has one for each of its parts."""
        local = ["local"] * any(self._locals())
        return ("timestamp", *map(named, self._names()), *local)

    @property
    def rows(self) -> list[JsonValue]:
        """A row for each sample: its time and cells; null where a sample has no such part."""
        names, table = self._names(), zip(self.samples, self._cells(), self._locals(), strict=True)
        return [
            [
                moment(sample.time),
                *(quote(cells.get(name), name) for name in names),
                *([] if local is None else [local]),
            ]
            for sample, cells, local in table
        ]

    @property
    def extremes_by_field(self) -> list[tuple[str, Extremes]]:
        """The extremes, with the name of their field."""
        return [(extremes.field, extremes) for extremes in self.extremes]

    def _locals(self) -> list[str | None]:
        """Returns the local time of each sample, where they span so much that it is shown."""
        times = LocalTimes(_first_time(self), _last_time(self))
        return [times.text(sample.time) for sample in self.samples]

    def _names(self) -> Collection[str]:
        return dict.fromkeys(name for row in self._cells() for name in row).keys()

    def _cells(self) -> list[JsonObject]:
        return [
            dict(_parts("", sample.value) if isinstance(sample.value, dict) else ())
            for sample in self.samples
        ]


def _parts(path: str, value: JsonValue) -> Iterator[tuple[str, JsonValue]]:
    """Yields the parts of a value that are no objects with parts, by their dot-paths."""
    if not isinstance(value, dict) or not value:
        yield path, value
        return
    for name, part in value.items():
        yield from _parts(dotted(path, name), part)


@result("type", "topics", PAIRS("fields"))
class TypeFields(AnswerWithNotes):
    """The fields that replies show of a message type, and the topics recorded under it."""

    type: str
    topics: tuple[str, ...]
    fields: tuple[tuple[str, str], ...]


@result(
    TIME("timestamp", "found.sample.time"),
    LOCAL("local", "found.sample.time", "found.sample.time"),
    MESSAGE("value", "found.sample.value"),
    PLAIN("topic", "found.topic").if_known,
    PLAIN("type", "found.type").if_known,
    NAME("frame_id", "found.frame_id").if_any,
    SECONDS("age_s", "found.age").if_known,
    span=("found.sample.time", "seen_at"),
)
class Match(AnswerWithNotes):
    """The newest message that met a condition; `found` is None after a search without a match.

    Where `found` is None and there are `notes`, the search was not complete.
    """

    found: TopicValue | None

    @property
    def seen_at(self) -> Ns | None:
        """The time that the age of the match counts from."""
        return None if self.found is None else self.found.sample.time + (self.found.age or 0)


@result(
    TIME("timestamp", "matched.sample.time"),
    MESSAGE("matched", "matched.sample.value"),
    MESSAGE("value", "value.sample.value"),
    TIME("value_timestamp", "value.sample.time"),
    PLAIN("condition_topic", "matched.topic"),
    PLAIN("value_topic", "value.topic"),
    NAME("matched_frame_id", "matched.frame_id").if_any,
    NAME("frame_id", "value.frame_id").if_any,
    PLAIN("value_latched", "value.latched").if_any,
    SECONDS("value_age_s").when("value.latched"),
    SECONDS("age_s", "matched.age").if_known,
)
class ValueWhen(AnswerWithNotes):
    """A match on one topic, and the value of another at that time; None if it had none yet."""

    matched: TopicValue
    value: TopicValue | None = None

    @property
    def value_age(self) -> Ns:
        """The age of the value; 0 where the message is of the same time."""
        return 0 if self.value is None else self.value.age or 0


@result(XYZ.spread("position"), INSIDE("inside"), NAME("frame_id"))
class LabelledPlace:
    """A place (m) in a frame, and the named places around it; `label` names what is there."""

    label: str
    position: Vector3
    frame_id: str
    inside: tuple[str, ...] = ()


def _other_topic(topic: str, scope: Scope) -> JsonValue | Absent:
    """Returns a topic that is not that of the whole reply."""
    return Absent.ABSENT if topic == getattr(scope.answer, "topic", None) else topic


@result(
    Unit(_other_topic)("topic"),
    TIME("first_seen", "first"),
    TIME("last_seen", "last"),
    LOCAL("local", "first", "last"),
    LASTED("duration_s", "first", "until", "skipped"),
    AGO("ago_s", "last"),
    PLAIN("count", "messages").if_any,
    an_object(
        keys(PLAIN("at", "robot_time_key"), POSE("robot"), NAME("frame_id", "robot.frame_id"))
    )("robot", itself_if("robot")),
    texts(_LONGEST_MATCHED)("matched").first(_MOST_MATCHED).if_any,
    PLAIN("value").if_known,
    OBJECT("place", "thing").if_known,
    digits(3)("score").if_known,
    PLAIN("began_earlier").if_any,
    SAID,
)
class Sighting:
    """Consecutive messages of one topic that met a condition.

    Attributes:
        topic: of the messages.
        first: log time of the first of them; of the earliest one read where `begun` is False.
        last: of the last.
        until: of the next one, which says otherwise; as `last` where none does, and of a thing.
        messages: how many there are; 0 for a goal of an action.
        begun: whether the message before the first is known not to belong.
        robot: where the robot was at the first; at the last where that is the sighting of a thing,
            a goal, or began before what was read.
        thing: where the thing itself was then, if the message has that.
        matched: the texts of the last message that met the condition, where that is on texts.
        value: the requested fields of the last message; None where none were, or it has none. Of a
            goal its id and its status.
        score: of the detection, if the message has that; the best of several.
        skipped: how much of the time from the first to `until` the clock skipped.
        robot_at_first: whether `robot` is of the first message.
        said: what another topic said meanwhile, if that was asked.
    """

    topic: str
    first: Ns
    last: Ns
    until: Ns
    messages: int
    begun: bool
    robot: Pose | None
    thing: LabelledPlace | None
    matched: tuple[str, ...] = ()
    value: JsonValue = None
    score: float | None = None
    skipped: Ns = 0
    robot_at_first: bool = False
    said: tuple[Spell, ...] | None = None

    @property
    def robot_time_key(self) -> str:
        """The key of the time that `robot` is of."""
        return "first_seen" if self.robot_at_first else "last_seen"

    @property
    def began_earlier(self) -> bool:
        """Whether it may have begun before the first message."""
        return not self.begun


@result(
    PLAIN("topic").if_any,
    OBJECTS("sightings").unless("of_texts").along("last_seen"),
    OBJECTS("episodes").when("of_texts").along("end"),
    TOTAL("total", "counted").added,
    SECONDS("unknown_s").if_any.added,
    TIME("searched_from", "start"),
    TIME("searched_to", "end"),
    LOCAL("local", "start", "end"),
    PLAIN("more").if_any,
    span=("oldest", "now"),
)
class Sightings(AnswerWithNotes):
    """Sightings in the requested order; `more`: there are others. `start` and `end` were searched.

    `topic` is that of all, where one alone was searched. With `of_texts` there are `episodes` in
    their place: of its texts, which hold until the next.

    `total` is how many there are; None if the search ended before it had counted all. `unknown` is
    for how long something was recorded, and it is not known whether matches count.
    """

    sightings: tuple[Sighting, ...]
    more: bool
    total: int | None
    start: Ns | None
    end: Ns | None
    now: Ns
    unknown: Ns = 0
    topic: str = ""
    of_texts: bool = False
    episodes: tuple[Episode, ...] = ()

    @property
    def oldest(self) -> Ns | None:
        """The oldest time of the reply."""
        firsts = [row.first for rows in (self.sightings, self.episodes) for row in rows]
        return min(firsts, default=self.start)

    @property
    def counted(self) -> tuple[int, bool]:
        """How many there are, and whether these are all."""
        shown = len(self.sightings) + len(self.episodes)
        return (shown, False) if self.total is None else (self.total, True)


BinColumn: TypeAlias = Literal["count", "duration", "minutes", "metres", "number", "time"]
"""What the values of a column are: whole numbers, nanoseconds (shown in seconds, or in minutes),
metres, plain numbers, log times."""


def _clock(second: int) -> str:
    """Returns a time of day."""
    hours, rest = divmod(second, _MINUTE_S * _MINUTE_S)
    return f"{hours:02d}:{rest // _MINUTE_S:02d}:{rest % _MINUTE_S:02d}"


@result(
    unit(_clock)("median", "median_s"),
    unit(_clock)("earliest", "earliest_s"),
    unit(_clock)("latest", "latest_s"),
    "days",
    "of_days",
)
class Usual:
    """The usual first time of a day, in seconds since local midnight, over `days` days.

    `of_days` is the number of days with recorded data.
    """

    median_s: int
    earliest_s: int
    latest_s: int
    days: int
    of_days: int


@result(
    PLAIN("topic"),
    PLAIN("columns", "header"),
    PLAIN("rows", "table"),
    PLAIN("all", "sums"),
    TIME("start"),
    TIME("end"),
    OBJECT("usual_first", "usual").if_known,
    OBJECT("usual_exit").if_known,
)
class Bins(AnswerWithNotes):
    """Counts for each bin of a window.

    Attributes:
        by: the kind of the bins.
        about: the topics or the place that was counted.
        start: of the window, as far as the memory reaches; inclusive.
        end: of the window, likewise.
        columns: the name of each column after that of the bin, and what its values are.
        rows: for each bin its name and its values; None if there is none.
        all: the values of all bins together.
        usual: the usual time of the first beginning in a day, where beginnings are counted.
        usual_exit: of the first exit in a day, where visits are counted.
    """

    by: str
    about: tuple[str, ...]
    start: Ns
    end: Ns
    columns: tuple[tuple[str, BinColumn], ...]
    rows: tuple[tuple[str, tuple[float | None, ...]], ...]
    all: tuple[float | None, ...]
    usual: Usual | None = None
    usual_exit: Usual | None = None

    @property
    def topic(self) -> JsonValue:
        """What was counted: a name where it is one."""
        return self.about[0] if len(self.about) == 1 else [*self.about]

    @property
    def header(self) -> tuple[str, ...]:
        """The names of the table's columns; a time has two, the second in Unix seconds."""
        unix = (f"{name}_unix" for name, kind in self.columns if kind == "time")
        return (self.by, *(name for name, _ in self.columns), *unix)

    @property
    def table(self) -> list[JsonValue]:
        """The rows: the bin, and a cell for each column."""
        return [[name, *self._cells(values)] for name, values in self.rows]

    @property
    def sums(self) -> list[JsonValue]:
        """The cells of all bins together."""
        return self._cells(self.all)

    def _cells(self, values: tuple[float | None, ...]) -> list[JsonValue]:
        kinds = [kind for _, kind in self.columns]
        shown = [
            None if value is None else _cell(value, kind)
            for value, kind in zip(values, kinds, strict=True)
        ]
        times = (at for at, kind in zip(values, kinds, strict=True) if kind == "time")
        return [*shown, *(None if at is None else moment(int(at)) for at in times)]


def _cell(value: float, kind: BinColumn) -> JsonValue:
    match kind:
        case "count":
            return int(value)
        case "duration":
            return round(unix_from_ns(int(value)), 1)
        case "minutes":
            return round(unix_from_ns(int(value)) / _MINUTE_S, 2)
        case "metres":
            return rounded(value, 2)
        case "number":
            return rounded(value, 6)
        case "time":
            # As arguments take it: all of the second, of which the Unix time beside it is exact.
            return local_time(int(value) // NS_PER_S * NS_PER_S).isoformat(sep=" ")
