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
    NUMBER,
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
    AnswerWithNotes,
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
from ros2_memory.core.text import leaves, named, quote
from ros2_memory.core.timebase import NS_PER_S, Ns, local_time, unix_from_ns
from ros2_memory.results.recap import SAID, Episode, Spell

if TYPE_CHECKING:
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
    """One message of one topic.

    Attributes:
        sample: its log time and value.
        age: before now for a relative question, else before the time asked about.
        latched: whether it is valid at any age.
        frame_id: of the message's header; empty if it has none.
    """

    topic: str
    type: str
    sample: Sample
    age: Ns | None = None
    latched: bool = False
    frame_id: str = ""


@result(
    NUMBER("min", "least", "largest"),
    TIME("min_at", "least_at"),
    NUMBER("max", "most", "largest"),
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

    @property
    def largest(self) -> float:
        """The largest absolute number of the two."""
        return max(abs(self.least), abs(self.most))


def _times(answer: TopicRange) -> list[Ns]:
    extremes = [at for one in answer.extremes for at in (one.least_at, one.most_at)]
    return [sample.time for sample in answer.samples] + extremes


def _first_time(answer: TopicRange) -> Ns | None:
    return min(_times(answer), default=None)


def _last_time(answer: TopicRange) -> Ns | None:
    return max(_times(answer), default=None)


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
    """Samples of a window, evenly spaced over its messages, with the first and the last.

    Attributes:
        total: how many messages the window has.
        samples: if `fields` were requested, their values are objects by field.
        extremes: of all messages, for the requested numeric fields.
        fields: the requested fields.
    """

    topic: str
    type: str
    total: int
    samples: tuple[Sample, ...]
    extremes: tuple[Extremes, ...] = ()
    fields: tuple[str, ...] = ()

    @property
    def columns(self) -> list[str]:
        """The columns of the table; a field with an object has a column for each of its parts."""
        columns, _ = self._table()
        return columns

    @property
    def rows(self) -> list[JsonValue]:
        """A row for each sample: its time and cells; None in a column that a sample lacks."""
        _, rows = self._table()
        return rows

    @property
    def extremes_by_field(self) -> list[tuple[str, Extremes]]:
        """The extremes by field."""
        return [(extremes.field, extremes) for extremes in self.extremes]

    def _table(self) -> tuple[list[str], list[JsonValue]]:
        """Returns the names of the columns, and the rows; samples of a long time have `local`."""
        times = LocalTimes(_first_time(self), _last_time(self))
        cells = [
            dict(leaves(sample.value)) if isinstance(sample.value, dict) else {}
            for sample in self.samples
        ]
        names = dict.fromkeys(name for row in cells for name in row)
        columns = ["timestamp", *map(named, names)]
        rows: list[JsonValue] = []
        for sample, row in zip(self.samples, cells, strict=True):
            local = times.text(sample.time)
            shown = [moment(sample.time), *(quote(row.get(name), name) for name in names)]
            rows.append(shown if local is None else [*shown, local])
        # All samples have a local time, or none has.
        if times.text(times.first) is not None:
            columns.append("local")
        return columns, rows


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
    """The newest message that met a condition; None after a search without a match.

    A search without a match was not complete if there are `notes`.
    """

    found: TopicValue | None

    @property
    def seen_at(self) -> Ns | None:
        """The time from which the age of the match counts."""
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
    """A match on one topic, and the value of another topic then; None if it had none yet."""

    matched: TopicValue
    value: TopicValue | None = None

    @property
    def value_age(self) -> Ns:
        """The age of the value at the match."""
        return 0 if self.value is None else self.value.age or 0


@result(XYZ.spread("position"), INSIDE("inside"), NAME("frame_id"))
class LabelledPlace:
    """A place (m) in a frame, and the named places around it; `label` names what is there."""

    label: str
    position: Vector3
    frame_id: str
    inside: tuple[str, ...] = ()


def _other_topic(topic: str, scope: Scope) -> JsonValue | Absent:
    """Returns a topic, unless it is that of the whole reply."""
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
    PLAIN("ended").when("goes_on"),
    SAID,
)
class Sighting:
    """Consecutive messages of one topic that met a condition.

    Attributes:
        topic: of the messages.
        first: log time of the first message; of the earliest message read if not `begun`.
        last: log time of the last message.
        until: log time of the next message, which does not match. As `last` for a thing, and if
            there is no such message.
        messages: how many there are; 0 for a goal of an action.
        begun: whether the message before the first is known not to match.
        robot: the pose of the robot at the first message if `robot_at_first`, else at the last one:
            for a thing, for a goal, and if not `begun`.
        thing: where the thing itself was at the last message, if the message has that.
        matched: the texts of the last message that met a condition on texts.
        value: the requested fields of the last message; None without fields. For a goal its id and
            its status.
        score: the best score of the detections.
        skipped: how much of the time from `first` to `until` the clock skipped.
        robot_at_first: whether `robot` is of the first message.
        said: values of another topic meanwhile; None if they were not asked for.
        ended: whether a message ended it at `until`; also True for a thing, a line of a log, and a
            rare text, which are of the moments of their messages.
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
    ended: bool = True

    @property
    def robot_time_key(self) -> str:
        """The key of the time at which the robot was there."""
        return "first_seen" if self.robot_at_first else "last_seen"

    @property
    def began_earlier(self) -> bool:
        """Whether the sighting may have begun before its first message."""
        return not self.begun

    @property
    def goes_on(self) -> bool:
        """Whether no message ended it at `until`."""
        return not self.ended


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
    """Sightings in the requested order.

    Attributes:
        more: whether there are others.
        total: how many there are; None if the search ended before all were counted.
        start, end: of the time that was searched.
        unknown: for how long it is not known, though something was recorded, whether matches count.
        topic: of all sightings; empty if several topics were searched.
        of_texts: whether there are `episodes` in place of sightings.
        episodes: of texts that hold until the next text.
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
        """How many there are, and whether all were counted."""
        shown = len(self.sightings) + len(self.episodes)
        return (shown, False) if self.total is None else (self.total, True)


BinColumn: TypeAlias = Literal["count", "duration", "minutes", "metres", "number", "time"]
"""The kind of the values of a column: whole numbers, nanoseconds (shown as seconds or as minutes),
metres, numbers that are finite and rounded, log times."""


def _clock(second: int) -> str:
    """Returns a second of a day as `14:05:09`."""
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
    """When something first happens on a day, in seconds since local midnight.

    Attributes:
        median_s, earliest_s, latest_s: over the days on which it happened.
        days: how many these are.
        of_days: how many days have recorded data.
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
)
class Bins(AnswerWithNotes):
    """Counts for each bin of a window.

    Attributes:
        by: the kind of the bins.
        about: the topics, or the place, that the counts are about.
        start, end: of the window as far as the memory reaches; inclusive.
        columns: name and kind of each column after that of the bin.
        rows: name and values of each bin; None for a missing value.
        all: the values of all bins together.
        usual: when the first one of a day begins, if beginnings are counted.
    """

    by: str
    about: tuple[str, ...]
    start: Ns
    end: Ns
    columns: tuple[tuple[str, BinColumn], ...]
    rows: tuple[tuple[str, tuple[float | None, ...]], ...]
    all: tuple[float | None, ...]
    usual: Usual | None = None

    @property
    def topic(self) -> JsonValue:
        """The topics or the place that the counts are about; a single one as its name."""
        return self.about[0] if len(self.about) == 1 else [*self.about]

    @property
    def header(self) -> tuple[str, ...]:
        """The names of the columns; a time has a second column at the end, in Unix seconds."""
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
        cells: list[JsonValue] = []
        unix: list[JsonValue] = []
        for value, (_, kind) in zip(values, self.columns, strict=True):
            cells.append(None if value is None else _cell(value, kind))
            if kind == "time":
                unix.append(None if value is None else moment(int(value)))
        return [*cells, *unix]


def _cell(value: float, kind: BinColumn) -> JsonValue:
    """Returns a value as it is shown; a time as local time."""
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
            return value
        case "time":
            # To the second, as arguments take it: the Unix time beside it is exact.
            return local_time(int(value) // NS_PER_S * NS_PER_S).isoformat(sep=" ")
