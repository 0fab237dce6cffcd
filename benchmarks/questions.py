"""The questions: a fixed list over a world, each drawn by the seed.

A question knows how the server is asked, and, where plain rosbags can answer it, how they are.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from operator import attrgetter, eq, gt, lt
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar, cast

import numpy as np

from benchmarks.plain import Scan

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from ros2_memory.core.model import JsonValue

NEVER: Final = "xylograph quibble"
"""A text that no world contains."""
_Meets: TypeAlias = "Callable[[object], bool]"
_Value = TypeVar("_Value")
_HOUR: Final = 3600.0
_AROUND_S: Final = 2.0
_DAY: Final = 24 * _HOUR
_SPEED: Final = "linear_velocity.x"


class Question(NamedTuple):
    """A call of a tool, in words of its own."""

    words: str
    tool: str
    arguments: Mapping[str, JsonValue]
    plain: Scan | None = None


@dataclass
class Facts:
    """What a world was drawn to be (`world.json`), and where in it questions are asked."""

    facts: Mapping[str, JsonValue]
    chance: np.random.Generator
    start: float = field(init=False)
    end: float = field(init=False)

    def __post_init__(self) -> None:
        self.start, self.end = self.number("start"), self.number("end")

    def number(self, name: str) -> float:
        """Returns a number of the world."""
        return cast("float", self.facts[name])

    def text(self, name: str) -> str:
        """Returns a text of the world."""
        return cast("str", self.facts[name])

    def point(self, name: str) -> dict[str, JsonValue]:
        """Returns a place of the world as `{x, y}`."""
        x, y = cast("list[float]", self.facts[name])
        return {"x": round(x, 3), "y": round(y, 3)}

    def topic(self, role: str) -> str:
        """Returns the name of the topic with a role."""
        return cast("dict[str, str]", self.facts["topics"])[role]

    def state(self, doing: str) -> str:
        """Returns the status text while the robot does something."""
        return cast("dict[str, str]", self.facts["states"])[doing]

    def drawn(self, name: str) -> str:
        """Returns one of a list of names, or of the keys of a table."""
        return str(self.chance.choice(sorted(cast("list[str]", self.facts[name]))))

    def moment(self) -> float:
        """Returns a time in the middle of the world at which the robot was on."""
        off = cast("list[list[float]]", self.facts["off"])
        while True:
            share = self.chance.uniform(0.15, 0.85)
            at = round(self.start + share * (self.end - self.start), 3)
            if not any(first - _AROUND_S < at < last + _AROUND_S for first, last in off):
                return at

    def window(self, seconds: float) -> dict[str, JsonValue]:
        """Returns a window of so long, or of the whole world where it is shorter."""
        long = min(seconds, self.end - self.start)
        start = self.start + self.chance.uniform(0.0, 1.0) * (self.end - self.start - long)
        return {"start": round(start, 3), "end": round(start + long, 3)}

    def scan(
        self,
        role: str,
        meets: _Meets = lambda _: True,
        window: Mapping[str, JsonValue] | None = None,
        *,
        is_last: bool = False,
    ) -> Scan:
        """Returns what plain rosbags are asked; over all time, where no window is given."""
        times = [cast("float", (window or {}).get(name, math.inf)) for name in ("start", "end")]
        start, stop = (int(t * 1e9) if t < math.inf else None for t in times)
        return Scan(self.topic(role), start or 0, stop or 2**63 - 1, meets, is_last)


def questions(told: Mapping[str, JsonValue], seed: int) -> list[Question]:
    """Returns the questions of a world of a drawn robot, or of one of strangers."""
    facts = Facts(told, np.random.default_rng([seed, 7])) if "topics" in told else None
    if facts is None:
        return [*_about_all(None), *_of_strangers()]
    return [
        *_at_a_time(facts),
        *_last_match(facts),
        *_matches(facts),
        *_ranges(facts),
        *_motion(facts),
        *_about_all(facts),
    ]


def _at_a_time(facts: Facts) -> Iterator[Question]:
    at = facts.moment()
    ns = int(at * 1e9)
    before = Scan(facts.topic("odom"), ns - 10**9, ns + 1, is_last=True)
    place: dict[str, JsonValue] = {"timestamp": at, "tolerance_s": 5}
    yield Question("position at a time", "get_position_at", place, before)
    in_map: dict[str, JsonValue] = {**place, "timestamp": facts.moment(), "frame_id": "map"}
    yield Question("position in map at a time", "get_position_at", in_map)
    value: dict[str, JsonValue] = {
        "topic": facts.topic("battery"),
        "timestamp": at,
        "tolerance_s": 30,
    }
    scan = Scan(facts.topic("battery"), ns - 30 * 10**9, ns + 1, is_last=True)
    yield Question("value at a time", "get_topic_at_time", value, scan)
    frames = cast("list[str]", facts.facts["frames"])
    arguments: dict[str, JsonValue] = {"parent": frames[0], "child": frames[-1]}
    arguments["timestamp"] = facts.moment()
    yield Question("transform at a time", "get_transform_at", arguments)


def _last_match(facts: Facts) -> Iterator[Question]:
    def asked(
        words: str, role: str, kind: str, value: JsonValue, meets: _Meets,
        **more: JsonValue,
    ) -> Question:  # fmt: skip
        condition = {"topic": facts.topic(role), "condition_type": kind, "value": value, **more}
        return Question(
            f"last match: {words}",
            "find_last_match",
            condition,
            facts.scan(role, meets, is_last=True),
        )

    number = round(float(facts.chance.uniform(0.45, 0.7)), 9)
    yield asked("text, never", "rosout", "contains", NEVER, _has("msg", NEVER))
    yield asked("label, never", "objects", "contains", NEVER, _sees(NEVER))
    yield asked("label", "objects", "contains", label := facts.drawn("labels"), _sees(label))
    outside, inside = "number outside its range, never", "number inside its range, never"
    yield asked(outside, "odom", "above", 9.0, _is(gt, "twist.twist.linear.x", 9.0), field=_SPEED)
    yield asked(
        inside, "battery", "equals", number, _is(eq, "percentage", number), field="percentage"
    )
    never, dock = facts.point("never_there"), facts.point("dock")
    yield asked("place, never", "odom", "near_position", never, _near(never))
    yield asked("place, often", "odom", "near_position", dock, _near(dock))
    rare = facts.text("rare")
    yield asked("text, rare", "speech", "contains", rare, _has("data", rare))
    driving = facts.state("driving")
    yield asked("text, often", "status", "equals", driving, _is(eq, "data", driving))


def _matches(facts: Facts) -> Iterator[Question]:
    label, state = facts.drawn("labels"), facts.state("looking")
    logged = facts.text("logged")
    conditions: list[tuple[str, str, str, JsonValue, dict[str, JsonValue], _Meets]]
    conditions = [
        ("text", "rosout", "contains", logged, {}, _has("msg", logged)),
        ("state", "status", "equals", state, {}, _is(eq, "data", state)),
        ("label", "objects", "contains", label, {}, _sees(label)),
        ("boolean", "docked", "equals", True, {}, _is(eq, "data", True)),
        ("number", "battery", "below", 0.4, {"field": "percentage"}, _is(lt, "percentage", 0.4)),
    ]
    for words, role, kind, value, more, meets in conditions:
        condition: dict[str, JsonValue] = {"topic": facts.topic(role), "condition_type": kind}
        condition |= {"value": value, **more}
        for by in ("day", "hour"):
            arguments: dict[str, JsonValue] = {**condition, "by": by}
            scan = facts.scan(role, meets)
            yield Question(f"{words} by {by}", "find_matches", arguments, scan)
    docked: JsonValue = {"topic": facts.topic("docked"), "condition_type": "equals", "value": False}
    seen: dict[str, JsonValue] = {
        "topic": facts.topic("objects"),
        "condition_type": "contains",
        "value": label,
    }
    yield Question("label while not docked", "find_matches", {**seen, "while": docked})
    yield Question("label in a room", "find_matches", {**seen, "where": facts.drawn("rooms")})
    day = facts.window(_DAY)
    scan = facts.scan("objects", _sees(label), day)
    yield Question("label of a day", "find_matches", {**seen, **day}, scan)


def _ranges(facts: Facts) -> Iterator[Question]:
    tool, whole = "get_topic_in_range", facts.window(math.inf)
    hour, day = facts.window(_HOUR), facts.window(_DAY)
    odom, battery = facts.topic("odom"), facts.topic("battery")
    only: dict[str, JsonValue] = {"topic": battery, "fields": ["percentage"]}
    speed: dict[str, JsonValue] = {"topic": odom, "fields": [_SPEED]}
    scan = facts.scan("odom", window=hour)
    yield Question("100 samples of an hour", tool, {"topic": odom, **hour}, scan)
    yield Question("a field of a day", tool, {**only, **day}, facts.scan("battery", window=day))
    yield Question("a field by hour", tool, {**only, **whole, "by": "hour"}, facts.scan("battery"))
    yield Question("speed by hour", tool, {**speed, **whole, "by": "hour"}, facts.scan("odom"))


def _motion(facts: Facts) -> Iterator[Question]:
    week = facts.window(math.inf)
    spans: dict[str, dict[str, JsonValue]]
    spans = {"hour": facts.window(_HOUR), "day": facts.window(_DAY), "week": week}
    for words, span in spans.items():
        scan = facts.scan("odom", window=span)
        yield Question(f"trajectory of {_a(words)}", "trajectory_summary", span, scan)
    yield Question("trajectory by day", "trajectory_summary", {**week, "by": "day"})
    for words, span in spans.items():
        yield Question(f"recap of {_a(words)}", "recap", span)
    yield Question("visits: a place, often", "visits", facts.point("dock"))
    yield Question("visits: a place, never", "visits", facts.point("never_there"))
    yield Question("visits: a room", "visits", {"where": facts.drawn("rooms")})
    yield Question("visits: all rooms", "visits", {})
    last = max(facts.end - 2.0 * _DAY, facts.start)
    half = (facts.end - last) / 2.0
    days: dict[str, JsonValue] = {"start": last + half, "end": facts.end}
    days |= {"with_start": last, "with_end": last + half}
    yield Question("compare two days", "compare", days)
    yield Question("find_things", "find_things", {})
    yield Question("find_things: a label", "find_things", {"label": facts.drawn("labels")})
    where: JsonValue = facts.drawn("rooms")
    yield Question("find_things: a room", "find_things", {"where": where})


def _about_all(facts: Facts | None) -> Iterator[Question]:
    topics = Scan("", 0, 2**63 - 1) if facts else None
    yield Question("list topics", "list_recorded_topics", {}, topics)
    yield Question("data_time_range", "data_time_range", {}, topics)
    yield Question("memory_status", "memory_status", {})


def _of_strangers() -> Iterator[Question]:
    """Yields questions that need no knowledge of the bags."""
    ever: dict[str, JsonValue] = {"start": 0.0, "end": 4e9}
    text: dict[str, JsonValue] = {"topic": "*", "condition_type": "contains", "value": NEVER}
    number: dict[str, JsonValue] = {"topic": "/odom", "condition_type": "above", "value": 9e9}
    number |= {"field": _SPEED}
    logged: dict[str, JsonValue] = {**text, "topic": "/rosout", "value": "a"}
    yield Question("last match: text of any topic, never", "find_last_match", text)
    yield Question("last match: a number of /odom, never", "find_last_match", number)
    yield Question("text", "find_matches", logged)
    yield Question("trajectory of everything", "trajectory_summary", ever)
    yield Question("recap of everything", "recap", ever)
    yield Question("visits: a place", "visits", {"x": 0.0, "y": 0.0, "frame_id": "odom"})
    yield Question("find_things", "find_things", {})


def _a(noun: str) -> str:
    return f"an {noun}" if noun == "hour" else f"a {noun}"


def _has(name: str, needle: str) -> _Meets:
    read, folded = attrgetter(name), needle.casefold()
    return lambda message: folded in cast("str", read(message)).casefold()


def _is(compare: Callable[[_Value, _Value], bool], name: str, value: _Value) -> _Meets:
    read = attrgetter(name)
    return lambda message: compare(read(message), value)


def _near(place: Mapping[str, JsonValue]) -> _Meets:
    read, (x, y) = attrgetter("pose.pose.position"), cast("list[float]", [*place.values()])
    return lambda message: math.hypot(read(message).x - x, read(message).y - y) <= 0.5


def _sees(label: str) -> _Meets:
    """Whether an array of detections, or a JSON text, has a label that contains this one."""
    label_of, class_of = attrgetter("label"), attrgetter("results")

    def meets(message: object) -> bool:
        text = getattr(message, "data", None)
        if isinstance(text, str):
            return any(label in cast("str", one["label"]) for one in json.loads(text)["found"])
        for one in cast("list[object]", attrgetter("detections")(message)):
            named = (
                [attrgetter("hypothesis.class_id")(kind) for kind in class_of(one)]
                if hasattr(one, "results")
                else [label_of(one)]
            )
            if any(label in name for name in named):
                return True
        return False

    return meets
