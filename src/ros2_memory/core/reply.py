"""A result's class declares its JSON, once: the keys of its reply, their units, and their order.

    @result("topic", TIME("first_seen", "first"), AGO("ago_s", "last"), digits(3)("score").if_known)
    class Sighting:

A key is the name of an attribute, which is shown as it is; or a unit, called with the name of the
key and with its source: an attribute, a dot-path, or a function of the result. The default source
is the attribute with the key's name without its unit. Timestamps are Unix seconds, rounded up to
whole microseconds: a timestamp that is passed back finds its own message. Metres and metres per
second are rounded to 1e-4, degrees to 1e-2, durations to 1e-3 s, unless `digits` says otherwise.
Unknown values and numbers that are not finite are null. Replies that span more than half a day
have `local` (`LocalTimes`); replies with notes have `notes` (`render`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from operator import attrgetter
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    ClassVar,
    Final,
    Never,
    Protocol,
    TypeAlias,
    TypeVar,
    cast,
    dataclass_transform,
)

from ros2_memory.core.geometry import normalised, yaw
from ros2_memory.core.text import named, quote, shortened
from ros2_memory.core.timebase import (
    FUTURE_NS,
    NS_PER_S,
    Ns,
    iso_local,
    local_text,
    unix_from_ns,
    unix_rounded_up,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from ros2_memory.core.model import JsonValue, Pose

T = TypeVar("T")

JsonObject: TypeAlias = "dict[str, JsonValue]"
Source: TypeAlias = "str | Callable[[Never], object]"
"""Where the value of a key comes from: a dot-path of attributes, or a function of the result."""

LOCAL_BEYOND_NS: Final[Ns] = 12 * 3600 * NS_PER_S
"""Shorter spans have no local times."""
_DAY_CHARS: Final = len("Tue 2026-11-17 ")


def moment(at: Ns | None) -> float | None:
    """Returns a time in Unix seconds, or None."""
    return None if at is None else unix_rounded_up(at)


def seconds(duration: Ns) -> float:
    """Returns a duration in seconds, rounded to 1e-3 s."""
    return round(unix_from_ns(duration), 3)


def rounded(number: float, places: int) -> float | None:
    """Returns a rounded number; None if it is not finite."""
    return round(number, places) if math.isfinite(number) else None


def rounded_beside(number: float, largest: float) -> float:
    """Returns a finite number of unknown unit with six decimals, or more if all are tiny.

    Args:
        number: to be rounded.
        largest: the largest absolute number beside it, which keeps five digits.
    """
    exponent = math.floor(math.log10(largest)) if largest else 0
    return round(number, max(6, 4 - exponent))


def degrees(angle: float | None) -> float | None:
    """Returns an angle (rad) in degrees, or None."""
    return None if angle is None else rounded(math.degrees(angle), 2)


def file_name(path: Path | str, bag_dir: Path) -> str:
    """Returns a bag's path relative to the bag directory; of a bag outside of it the name alone."""
    bag = Path(path)
    return str(bag.relative_to(bag_dir)) if bag.is_relative_to(bag_dir) else bag.name


@dataclass(frozen=True, slots=True)
class LocalTimes:
    """Local times beside Unix seconds, for a reply that spans more than half a day.

    Attributes:
        first: the oldest time of the reply.
        last: the present, if the reply counts ages; else its newest time.
    """

    first: Ns | None
    last: Ns | None

    def text(self, start: Ns | None, end: Ns | None = None) -> str | None:
        """Returns the local time of a moment (`start`) or a stretch, either end of it unknown.

        None if both are unknown, or the reply spans half a day or less.
        """
        first, last = self.first, self.last
        if first is None or last is None or last - first <= LOCAL_BEYOND_NS:
            return None
        begins = None if start is None else local_text(start)
        ends = None if end is None else local_text(end)
        if ends is None or begins == ends:
            return begins
        if begins is None:
            return f"- {ends}"
        day = begins[:_DAY_CHARS]
        return f"{begins} - {ends.removeprefix(day)}"


@dataclass(frozen=True, slots=True)
class Scope:
    """What the JSON of a row depends on besides the row.

    Attributes:
        answer: the answer that the row belongs to.
        now: the time that ages count from.
        bag_dir: the directory that names of files are relative to.
        local: the local times of the reply.
        days: the days of which a row has shown a local time (`LOCAL_OF_DAYS`).
        notes: notes on what was left out, which are added while rows are rendered.
    """

    answer: object = None
    now: Ns = 0
    bag_dir: Path = Path()
    local: LocalTimes = LocalTimes(None, None)
    days: set[str] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)


class Absent(Enum):
    """A unit returns `ABSENT` for a value whose key is left out."""

    ABSENT = auto()


@dataclass(frozen=True, slots=True)
class Unit:
    """How the values of a kind are shown.

    Attributes:
        convert: converts a value to JSON.
        suffix: the end of the names of keys in this unit.
        is_spread: whether the value is an object whose keys take the place of its own key.
        takes_none: whether None is converted, too; else it is null.
    """

    convert: Callable[[Never, Scope], JsonValue | Absent]
    suffix: str = ""
    is_spread: bool = False
    takes_none: bool = False

    def __call__(self, name: str, *sources: Source) -> Key:
        """Returns a key in this unit; its value is a tuple if it has several sources."""
        getters = [_getter(source) for source in sources or (name.removesuffix(self.suffix),)]
        if len(getters) == 1:
            return Key(name, self, getters[0])
        return Key(name, self, lambda owner: tuple(get(owner) for get in getters))

    @property
    def spread(self) -> Unit:
        """The unit, for objects that are shown without a key of their own."""
        return replace(self, is_spread=True)


def _getter(source: Source) -> Callable[[object], object]:
    """Returns a function that reads a source; None if a part of a dot-path is None."""
    if not isinstance(source, str):
        return cast("Callable[[object], object]", source)
    if "." not in source:
        return attrgetter(source)
    parts = source.split(".")

    def get(owner: object) -> object:
        value = owner
        for part in parts:
            value = None if value is None else getattr(value, part)
        return value

    return get


def _always(_: object) -> bool:
    return True


@dataclass(frozen=True, slots=True)
class Key:
    """One key of a reply.

    Attributes:
        name: the key in JSON.
        unit: how its values are shown.
        get: reads the value of a result.
        applies: tells whether a result has the key at all.
        is_shown: tells whether the key is shown, by its value.
        most: how many items of a list are shown: the first ones, or the last ones if negative; 0
            for all. The number of a longer list is in the key `<name>_<counted>`; a note says that
            the last ones are shown.
        counted: see `most`; empty for no such key.
        is_added: whether the values of several robots are added up.
        row_time: the key of a row's time, if the rows of several robots are merged by it.
        is_short: whether the key stays in a short reply.
    """

    name: str
    unit: Unit
    get: Callable[[object], object]
    applies: Callable[[object], bool] = _always
    is_shown: Callable[[object], bool] = _always
    most: int = 0
    counted: str = "count"
    is_added: bool = False
    row_time: str = ""
    is_short: bool = False

    @property
    def if_known(self) -> Key:
        """The key, left out if its value is None."""
        return replace(self, is_shown=lambda value: value is not None)

    @property
    def if_any(self) -> Key:
        """The key, left out if its value is None, empty, zero or false."""
        return replace(self, is_shown=bool)

    def when(self, attribute: str) -> Key:
        """Returns the key, left out if an attribute is None, empty, zero or false."""
        get = _getter(attribute)
        return replace(self, applies=lambda owner: bool(get(owner)))

    def unless(self, attribute: str) -> Key:
        """Returns the key, left out unless an attribute is None, empty, zero or false."""
        get = _getter(attribute)
        return replace(self, applies=lambda owner: not get(owner))

    @property
    def in_short(self) -> Key:
        """The key, also of a short reply."""
        return replace(self, is_short=True)

    def first(self, most: int, counted: str = "count") -> Key:
        """Returns the key with the first `most` items of its list; see `Key.counted`."""
        return replace(self, most=most, counted=counted)

    def last(self, most: int, counted: str = "count") -> Key:
        """Returns the key with the last `most` items of its list; see `Key.counted`."""
        return replace(self, most=-most, counted=counted)

    @property
    def added(self) -> Key:
        """The key, whose numbers, or numbers by name, are added up over several robots."""
        return replace(self, is_added=True)

    def along(self, row_time: str) -> Key:
        """Returns the key, whose rows of several robots are merged in order of a time."""
        return replace(self, row_time=row_time)

    def add_to(self, reply: JsonObject, owner: object, scope: Scope) -> None:
        """Adds the key to a reply, if it is shown."""
        if not self.applies(owner):
            return
        value = self.get(owner)
        if not self.is_shown(value):
            return
        total = 0
        if self.most and isinstance(value, tuple):
            total = len(value)
            value = value[: self.most] if self.most > 0 else value[self.most :]
        converted: JsonValue | Absent = None
        if value is not None or self.unit.takes_none:
            convert = cast("Callable[[object, Scope], JsonValue | Absent]", self.unit.convert)
            converted = convert(value, scope)
        if isinstance(converted, Absent):
            return
        if not self.unit.is_spread:
            reply[self.name] = converted
        elif isinstance(converted, dict):
            reply |= converted
        if total > abs(self.most) and self.counted:
            reply[f"{self.name}_{self.counted}"] = total
            if self.most < 0:
                scope.notes.append(f"{self.name}: the last {-self.most} of {total} are listed")


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of an object, in order.

    Attributes:
        keys: all of them.
        span: reads the oldest and the newest time, which decide whether there are local times.
    """

    keys: tuple[Key, ...]
    span: Callable[[object], object] | None = None

    @property
    def short(self) -> Keys:
        """The keys that stay in a short reply."""
        return replace(self, keys=tuple(key for key in self.keys if key.is_short))

    def render(self, owner: object, scope: Scope | None = None) -> JsonObject:
        """Returns the JSON of a result by these keys; without a scope, of one that needs none."""
        scope = scope or Scope()
        if self.span is not None:
            first, last = cast("tuple[Ns | None, Ns | None]", self.span(owner))
            now = getattr(owner, "now", scope.now)
            scope = replace(scope, now=now, local=LocalTimes(first, last))
        reply: JsonObject = {}
        for key in self.keys:
            key.add_to(reply, owner, scope)
        return reply


class Declared(Protocol):
    """A result that declares its JSON."""

    reply: ClassVar[Keys]


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerWithNotes:
    """The base of most answers.

    `notes` are sentences on what was downsampled, left out, clamped or could not be read.
    """

    notes: tuple[str, ...] = ()

    reply: ClassVar[Keys]


def keys(*declared: str | Key, span: tuple[Source, Source] | None = None) -> Keys:
    """Returns the keys of an object; a text declares the attribute of that name, shown as it is.

    `span` are the sources of the oldest and the newest time of the reply.
    """
    all_keys = tuple(PLAIN(key) if isinstance(key, str) else key for key in declared)
    if span is None:
        return Keys(all_keys)
    # The two times are read as the value of a key with two sources.
    return Keys(all_keys, PLAIN("span", *span).get)


@dataclass_transform(frozen_default=True)
def result(
    *declared: str | Key, span: tuple[Source, Source] | None = None
) -> Callable[[type[T]], type[T]]:
    """Returns a decorator that makes a class an immutable dataclass with these keys."""
    form = keys(*declared, span=span)

    def declare(cls: type[T]) -> type[T]:
        model = dataclass(frozen=True, slots=True)(cls)
        cast("type[Declared]", model).reply = form
        return model

    return declare


def render(answer: object, bag_dir: Path, form: Keys | None = None) -> JsonObject:
    """Returns the JSON of an answer with its notes last; `form` replaces the keys it declares."""
    scope = Scope(answer, getattr(answer, "now", 0), bag_dir)
    reply = shown(answer, scope, form)
    return with_notes(reply, [*getattr(answer, "notes", ()), *scope.notes])


def shown(owner: object, scope: Scope | None = None, form: Keys | None = None) -> JsonObject:
    """Returns the JSON of a result; `form` replaces the keys that it declares."""
    return (form or cast("Declared", owner).reply).render(owner, scope)


def with_notes(reply: JsonObject, notes: Sequence[str]) -> JsonObject:
    """Returns a reply with its notes, if there are any."""
    return {**reply, "notes": [*notes]} if notes else reply


def itself_if(attribute: str) -> Source:
    """Returns the source of an object made of several attributes; None if `attribute` is None."""
    get = _getter(attribute)
    return lambda owner: None if get(owner) is None else owner


def unit(convert: Callable[[Never], JsonValue], suffix: str = "") -> Unit:
    """Returns a unit whose values do not depend on the scope."""
    any_convert = cast("Callable[[object], JsonValue]", convert)
    return Unit(lambda value, _: any_convert(value), suffix)


def digits(places: int) -> Unit:
    """Returns the unit of numbers that are rounded to some decimal places."""
    return unit(lambda number: rounded(number, places))


def objects(form: Keys | None = None) -> Unit:
    """Returns the unit of lists of objects, with the keys of `form` or those they declare."""

    def convert(rows: Iterable[object], scope: Scope) -> JsonValue:
        return [shown(row, scope, form) for row in rows]

    return Unit(convert)


def an_object(form: Keys | None = None) -> Unit:
    """Returns the unit of an object, with the keys of `form` or those it declares."""
    return Unit(lambda owner, scope: shown(owner, scope, form))


def by_name(value_unit: Unit, longest: int = 1000) -> Unit:
    """Returns the unit of (name, value) pairs, shown as one object; long names are cut."""
    convert = cast("Callable[[object, Scope], JsonValue]", value_unit.convert)

    def convert_pairs(pairs: Iterable[tuple[str, object]], scope: Scope) -> JsonValue:
        return {shortened(name, longest): convert(value, scope) for name, value in pairs}

    return Unit(convert_pairs)


def vector(axes: str, places: int) -> Unit:
    """Returns the unit of vectors as objects by axis; parts beyond the named axes are left out."""

    def convert(parts: Sequence[float]) -> JsonValue:
        return {axis: rounded(part, places) for axis, part in zip(axes, parts, strict=False)}

    return unit(convert)


def texts(longest: int) -> Unit:
    """Returns the unit of lists of texts; a longer text is cut."""

    def convert(lines: Iterable[str]) -> JsonValue:
        return [shortened(line, longest) for line in lines]

    return unit(convert)


def _heading(pose: Pose) -> float | None:
    if pose.orientation is None:
        return None
    orientation = normalised(pose.orientation)
    return None if orientation is None else yaw(orientation)


def _plain(value: JsonValue | tuple[JsonValue, ...]) -> JsonValue:
    return [*value] if isinstance(value, tuple) else value


def _name(name: str) -> str | None:
    return named(name) or None


def _names(names: Iterable[str]) -> JsonValue:
    return [*map(named, names)]


def _counts(counts: Iterable[tuple[str, JsonValue]]) -> JsonValue:
    return {named(name): count for name, count in counts}


def _inside(places: Sequence[str]) -> JsonValue:
    """Returns the smallest of the named places that a point is in, and those around it."""
    if not places:
        return {}
    smallest, *around = places
    return {"in": smallest, "also_in": [*around]} if around else {"in": smallest}


def _counted(count: tuple[int, bool]) -> JsonValue:
    number, is_all = count
    return {"total" if is_all else "at_least": number}


def _ago(at: Ns | None, scope: Scope) -> float | Absent:
    """Returns how long ago a time was (s): 0 if it is None and goes on; absent if it lies ahead."""
    if at is None:
        return 0.0
    return Absent.ABSENT if at > scope.now + FUTURE_NS else seconds(scope.now - at)


def _tenths_ago(at: Ns, scope: Scope) -> float | Absent:
    ago_s = _ago(at, scope)
    return ago_s if isinstance(ago_s, Absent) else round(ago_s, 1)


def _lasted(times: Sequence[Ns]) -> float | None:
    start, end, *skipped = times
    return seconds(end - start - sum(skipped))


def _local(times: Sequence[Ns | None], scope: Scope) -> JsonValue | Absent:
    return scope.local.text(*times) or Absent.ABSENT


def _local_of_days(at: Sequence[Ns | None] | Ns | None, scope: Scope) -> JsonValue | Absent:
    """Returns the local time of a row that is the first one of its day, and notes the day."""
    times = (at,) if at is None or isinstance(at, int) else at
    texts = (scope.local.text(at) for at in times if at is not None)
    days = {text[:_DAY_CHARS] for text in texts if text is not None}
    if days <= scope.days:
        return Absent.ABSENT
    scope.days.update(days)
    return _local(times, scope)


PLAIN: Final = unit(_plain)
MESSAGE: Final = unit(quote)
"""A value of a message, or a part of it: its texts are quoted (`core/text.py`)."""
NAME: Final = unit(_name)
"""The name of a frame or a label, quoted if it has more than two words; so in the next two."""
NAMES: Final = unit(_names)
COUNTS_BY_NAME: Final = unit(_counts)
PAIRS: Final = unit(dict)
TIME: Final = unit(unix_rounded_up)
ISO_LOCAL: Final = unit(iso_local, "_local")
LOCAL: Final = Unit(_local)
"""The local times of the two ends of a stretch."""
LOCAL_OF_DAYS: Final = Unit(_local_of_days)
"""The same in the first row of each day only: for long lists of rows."""
SECONDS: Final = unit(seconds, "_s")
TENTHS_OF_S: Final = unit(lambda duration: round(seconds(duration), 1), "_s")
MINUTES: Final = unit(lambda duration: round(duration / 60e9, 2))
NUMBER: Final = unit(lambda pair: rounded_beside(*pair))
"""A number of unknown unit, behind it the largest one beside it."""
AGO: Final = Unit(_ago, takes_none=True)
TENTHS_OF_S_AGO: Final = Unit(_tenths_ago)
YAW: Final = Unit(lambda angle, _: {"yaw_deg": degrees(angle)}, is_spread=True, takes_none=True)
"""An angle (rad), under the key `yaw_deg`."""
XYZ: Final = vector("xyz", 4)
INSIDE: Final = unit(_inside).spread
"""The named places around something, the smallest first."""
TOTAL: Final = unit(_counted).spread
"""A number, and whether all were counted: `total`, or else `at_least`."""
FILE: Final = Unit(lambda path, scope: file_name(path, scope.bag_dir))
LASTED: Final = unit(_lasted)
"""The duration from the first time to the second, less the time that did not count (third)."""
OBJECT: Final = an_object()
OBJECTS: Final = objects()
POSE_KEYS: Final = keys(XYZ.spread("position"), YAW("yaw", _heading), INSIDE("places"))
"""A position, its yaw, and the named places around it."""
POSE: Final = an_object(POSE_KEYS).spread
