"""Random questions to the server's own dispatcher, and what brute force says of each answer.

A check returns None where the answer is right, else what is wrong with it. Times at the edge of a
window are right on either side within a microsecond, which is what float seconds resolve.
"""

import json
import math
from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any, Final

import anyio
import numpy as np
import yaml

from ros2_memory.bootstrap import build_backfill, build_dispatcher, build_memory
from ros2_memory.cli.maintenance.index import fill_store
from ros2_memory.config import load_settings
from tests.oracle.truth import EARLY_NS, SLACK_NS, History, Row, Topic, path_of, planar
from tests.oracle.worlds import World

NEAR_M: Final = 0.5
"""`data.position_tolerance_m` as shipped."""
TOLERANCE_NS: Final = 100_000_000
"""`data.time_tolerance_s` as shipped."""
STOP_ENDS_S: Final = 0.5
"""Of all stops in a window together: where noise hides when a robot began to move.

A robot that leaves with 0.2 m/s, the slowest here, is clear of four standard deviations of noise,
20 mm, after 0.1 s. Of all ends in 900 worlds one in a thousand was 0.13 s off, none 0.25 s. A
minute has ten at most, of which some are early and some late.
"""
COARSE: Final = 2e-4
"""Metres and units: replies round."""
MILLIMETRES: Final = 2e-3
"""Distances of `visits` have three decimals."""
TRACK_M: Final = 0.05
"""A place that the robot entered less deeply than this may be missed, says the explanation."""
FEWEST_POSES: Final = 16
"""Of fewer poses noise is not removed: the path is the plain sum of all steps."""
CALCULATED: Final = 0.0005
"""Beside numbers that replies calculate: their last digits are anybody's, so that no limit may be
one of them.
"""
FULL_CHARGE: Final = 1.05
"""What a full battery may state; a limit above it is in percent."""

SHOWN: Final[Mapping[str, Mapping[str, str]]] = {
    "nav_msgs/msg/Odometry": {
        "pose.pose.position": "position",
        "pose.pose.orientation": "orientation",
        "twist.twist.linear": "linear_velocity",
        "twist.twist.angular": "angular_velocity",
    },
    **{
        f"std_msgs/msg/{name}": {"data": "value"}
        for name in ("String", "Bool", "Float32", "Float64", "Int32", "UInt8", "UInt32")
    },
    "rcl_interfaces/msg/Log": {"level": "level", "name": "name", "msg": "msg"},
    "sensor_msgs/msg/BatteryState": {"percentage": "percentage", "voltage": "voltage"},
}
"""How the shipped schema map names fields: by type, path in the message -> name in a reply."""
LISTED: Final = frozenset(
    yaml.safe_load((Path(__file__).parents[2] / "config/message_schemas.yaml").read_text())[
        "schemas"
    ]
)
"""Types of which a reply shows some fields alone."""


@dataclass
class Report:
    """How many questions of each kind were asked, and every answer that is wrong."""

    asked: dict[str, int] = field(default_factory=dict)
    wrong: list[str] = field(default_factory=list)

    @property
    def total(self) -> int:
        """All questions."""
        return sum(self.asked.values())


class Server:
    """The dispatcher of a query server over a folder, in this process.

    Args:
        bag_dir: the folder, which is only read.
        stored: fill the store first, below the environment's cache folder.
    """

    def __init__(self, bag_dir: Path, world: World, *, stored: bool) -> None:
        settings = load_settings(
            [
                f"recording.bag_dir={bag_dir}",
                "recorder=none",
                f"storage={world.storage}",
                "data.now=latest",
                "server.max_reply_chars=400000",
                *world.settings,
            ],
            env={},
        )
        memory = build_memory(settings)
        if stored:
            fill_store(build_backfill(settings, memory))
        self._dispatcher = build_dispatcher(settings, memory)

    def ask(self, name: str, given: dict[str, Any]) -> Any:
        """The reply to one call, decoded."""
        return json.loads(anyio.run(self._dispatcher.answer, name, given).text)

    def stop(self) -> None:
        """Ends its threads."""
        self._dispatcher.stop()


def examine(world: World, history: History, server: Server, draw: Random, count: int) -> Report:
    """Asks `count` questions of kinds drawn at random."""
    report = Report()
    kinds = [*_kinds(world, history)]
    while report.total < count:
        kind = draw.choice(kinds)
        name, given, check = kind(draw)
        report.asked[name] = report.asked.get(name, 0) + 1
        answer = server.ask(name, given)
        wrong = check(answer)
        if wrong:
            shown = json.dumps(answer)[:600]
            report.wrong.append(
                f"{world.folder.name}: {name}({json.dumps(given)}): {wrong}: {shown}"
            )
    return report


Check = "Callable[[Any], str | None]"
Kind = "Callable[[Random], tuple[str, dict[str, Any], Check]]"


def _kinds(world: World, history: History) -> Iterator[Any]:
    paper = _Paper(world, history)
    yield paper.topics
    yield paper.span
    yield from [paper.value_at] * 3
    yield from [paper.values_in] * 3
    if paper.testable:
        yield from [paper.last_match] * 4
        yield from [paper.matches] * 2
        yield paper.when
    if any(name in history.topics for name in world.odometry):
        yield from [paper.position] * 2
        yield paper.velocity
        yield from [paper.near] * 2
        yield paper.closest
    if world.tf:
        yield from [paper.transform] * 2
    if world.moved is not None:
        yield from [paper.driven] * 2
    if world.stood is not None:
        yield from [paper.stood] * 2


class _Paper:
    """The questions about one history."""

    def __init__(self, world: World, history: History) -> None:
        self._world = world
        self._history = history
        self._topics = [each for each in history.topics.values() if each.rows]
        self._edges = history.edges(world.tf)
        self._odometry = [history.topics[each] for each in world.odometry if each in history.topics]
        self._scalars = {each.name: history.scalars(each.name) for each in self._topics}
        named = {each.name: self._fields(each) for each in self._topics}
        self.testable = {name: paths for name, paths in named.items() if paths}

    # -- what is there

    def topics(self, draw: Random) -> Any:
        def check(answer: Any) -> str | None:
            rows = {row["topic"]: row for row in answer}
            for topic in self._topics:
                row = rows.get(topic.name)
                if row is None or row["count"] != self._history.counts[topic.name]:
                    return f"{topic.name} has {self._history.counts[topic.name]} messages"
                if not _same_time(row["first_ts"], int(topic.times[0])):
                    return f"{topic.name} begins at {topic.times[0]}"
                if not _same_time(row["last_ts"], int(topic.times[-1])):
                    return f"{topic.name} ends at {topic.times[-1]}"
            return None

        return "list_recorded_topics", {}, check

    def span(self, draw: Random) -> Any:
        def check(answer: Any) -> str | None:
            right = _same_time(answer["earliest"], self._history.start) and _same_time(
                answer["latest"], self._history.end
            )
            return None if right else f"[{self._history.start}, {self._history.end}]"

        return "data_time_range", {}, check

    # -- values

    def value_at(self, draw: Random) -> Any:
        topic = draw.choice(self._topics)
        at = self._moment(draw, topic)
        given: dict[str, Any] = {"topic": topic.name, "timestamp": at / 1e9}
        asked = draw.choice([None, 10**9, 0])
        if asked is not None:
            given["tolerance_s"] = asked / 1e9
        unasked = at if topic.latched else TOLERANCE_NS
        tolerance = unasked if asked is None else asked
        names = [*self._scalars[topic.name]]
        if names:
            given["fields"] = draw.sample(names, min(2, len(names)))

        def check(answer: Any) -> str | None:
            return _one_of(answer, _candidates(topic, at, tolerance), given.get("fields", []))

        return "get_topic_at_time", given, check

    def values_in(self, draw: Random) -> Any:
        topic = draw.choice(self._topics)
        start, end = sorted((self._moment(draw, topic), self._moment(draw, topic)))
        if start == end:
            end += 10**9
        names = [name for name, kind in self._scalars[topic.name].items() if kind in {int, float}]
        chosen = draw.sample(names, min(2, len(names)))
        given = {"topic": topic.name, "start": start / 1e9, "end": end / 1e9, "max_samples": 7}
        if chosen:
            given["fields"] = chosen

        def check(answer: Any) -> str | None:
            inner, outer = topic.bounds(start, end)
            if _is_missing(answer):
                return f"{len(inner)} messages are there" if inner else None
            if not len(inner) <= answer["total"] <= len(outer):
                return f"total is {len(inner)} to {len(outer)}"
            times = (
                [row[0] for row in answer["rows"]]
                if chosen
                else [sample["timestamp"] for sample in answer["samples"]]
            )
            if times != sorted(times) or len(times) > max(7, 1):
                return "samples are not in order"
            if not all(_recorded(time, outer) for time in times):
                return "a sample is no recorded message"
            for name in chosen:
                told = answer.get("extremes", {}).get(name)
                wrong = _extremes(told, name, inner, outer)
                if wrong:
                    return wrong
            return None

        return "get_topic_in_range", given, check

    # -- conditions

    def last_match(self, draw: Random) -> Any:
        topic, given, holds = self._condition(draw)
        refused = _refused_limit(topic, given)
        before = self._moment(draw, topic) if draw.random() < 0.4 else None
        if before is not None:
            given["before"] = before / 1e9

        def check(answer: Any) -> str | None:
            if refused is not None:
                return _refusal(answer, refused)
            return _last(answer, topic.rows, holds, before)

        return "find_last_match", given, check

    def near(self, draw: Random) -> Any:
        topic = draw.choice(self._odometry)
        where = planar([draw.choice(topic.rows)])[0] + [draw.uniform(-2, 2), draw.uniform(-2, 2)]
        at = {"x": round(float(where[0]), 3), "y": round(float(where[1]), 3)}
        given = {"topic": topic.name, "condition_type": "near_position", "value": at}

        def far(row: Row) -> float:
            place = row.body.pose.pose.position
            return math.hypot(place.x - at["x"], place.y - at["y"])

        def check(answer: Any) -> str | None:
            surely = _last(answer, topic.rows, lambda row: far(row) <= NEAR_M - 1e-6, None)
            return surely and _last(answer, topic.rows, lambda row: far(row) <= NEAR_M + 1e-6, None)

        return "find_last_match", given, check

    def matches(self, draw: Random) -> Any:
        topic, given, holds = self._condition(draw)
        refused = _refused_limit(topic, given)
        start, end = sorted((self._moment(draw, topic), self._moment(draw, topic) + 10**9))
        given |= {"start": start / 1e9, "end": end / 1e9, "limit": 100}

        def check(answer: Any) -> str | None:
            bounds = topic.bounds(start, end)
            if refused is not None and any(bounds):
                return _refusal(answer, refused)
            inner, outer = ([row for row in rows if holds(row)] for rows in bounds)
            if _is_missing(answer):
                return f"{len(inner)} messages match" if inner else None
            found = answer["sightings"]
            if answer.get("more"):
                return None
            total = sum(each["count"] for each in found)
            if not len(inner) <= total <= len(outer):
                return f"{len(inner)} to {len(outer)} messages match, {total} are counted"
            edges = [each[key] for each in found for key in ("first_seen", "last_seen")]
            if not all(_recorded(edge, outer) for edge in edges):
                return "a sighting begins or ends where nothing matches"
            return None

        return "find_matches", given, check

    def when(self, draw: Random) -> Any:
        topic, condition, holds = self._condition(draw)
        refused = _refused_limit(topic, condition)
        value = draw.choice(self._topics)
        given = {
            "value_topic": value.name,
            "condition_topic": condition["topic"],
            **{key: condition[key] for key in condition if key != "topic"},
        }

        def check(answer: Any) -> str | None:
            if refused is not None:
                return _refusal(answer, refused)
            if answer is not None and answer.get("error") == "no_data":
                return None  # no value near the match
            return _last(answer, topic.rows, holds, None)

        return "get_value_when", given, check

    def _condition(self, draw: Random) -> tuple[Topic, dict[str, Any], Callable[[Row], bool]]:
        """A topic, the arguments of a condition on one of its fields, and the condition."""
        topic = draw.choice([each for each in self._topics if each.name in self.testable])
        path, kind, shown = draw.choice(self.testable[topic.name])
        value = path_of(draw.choice(topic.rows).body, path)
        given: dict[str, Any] = {"topic": topic.name, "field": shown}
        if kind is float and not math.isfinite(value):
            value = 0.0
        if kind is bool:
            wanted = draw.random() < 0.5
            given |= {
                "condition_type": "equals",
                "value": draw.choice([wanted, int(wanted), str(wanted).lower()]),
            }
            return topic, given, lambda row: bool(path_of(row.body, path)) is wanted
        if kind is str:
            if value and draw.random() < 0.8:
                first = draw.randrange(len(value))
                needle = value[first : first + draw.randint(1, 6)].strip() or value
            else:
                needle = "never recorded"
            given |= {"condition_type": "contains", "value": needle}
            folded = needle.casefold()
            return topic, given, lambda row: folded in path_of(row.body, path).casefold()
        is_stated = path in self._scalars[topic.name]
        if is_stated and draw.random() < 0.3:
            given |= {"condition_type": "equals", "value": value}
            return topic, given, lambda row: path_of(row.body, path) == value
        above = draw.random() < 0.5
        limit = value + draw.choice([0, 0.25, -0.25, 40, -40]) + (0 if is_stated else CALCULATED)
        given |= {"condition_type": "above" if above else "below", "value": limit}
        if above:
            return topic, given, lambda row: path_of(row.body, path) > limit
        return topic, given, lambda row: path_of(row.body, path) < limit

    def _fields(self, topic: Topic) -> list[tuple[str, type, str]]:
        """The path of each scalar that replies show, its type, and the name that it has there."""
        shown = SHOWN.get(topic.rows[0].type)
        found = []
        for path, kind in self._history.scalars(topic.name, as_shown=True).items():
            if shown is None and topic.rows[0].type not in LISTED:
                found.append((path, kind, path))
            for field_, name in (shown or {}).items():
                if path == field_ or path.startswith(f"{field_}."):
                    found.append((path, kind, name + path.removeprefix(field_)))
        return found

    # -- the robot

    def position(self, draw: Random) -> Any:
        topic = draw.choice(self._odometry)
        at = self._moment(draw, topic)

        def check(answer: Any) -> str | None:
            rows = _candidates(topic, at, TOLERANCE_NS)
            if _is_missing(answer):
                return None if None in rows else "a pose is there"
            places = [(*planar([row])[0], row.log_ns) for row in rows if row is not None]
            for x, y, log_ns in places:
                apart = math.hypot(answer["x"] - x, answer["y"] - y)
                if apart < COARSE and _same_time(answer["timestamp"], log_ns):
                    return None
            return f"expected one of {places}"

        return "get_position_at", {"topic": topic.name, "timestamp": at / 1e9}, check

    def velocity(self, draw: Random) -> Any:
        topic = draw.choice(self._odometry)
        at = self._moment(draw, topic)

        def check(answer: Any) -> str | None:
            rows = _candidates(topic, at, TOLERANCE_NS)
            if _is_missing(answer):
                return None if None in rows else "a velocity is there"
            known = [row.body.twist.twist.linear.x for row in rows if row is not None]
            right = any(abs(answer["linear"]["x"] - each) < COARSE for each in known)
            return None if right else f"expected one of {known}"

        return "get_velocity_at", {"topic": topic.name, "timestamp": at / 1e9}, check

    def closest(self, draw: Random) -> Any:
        topic = self._odometry[0]
        where = planar([draw.choice(topic.rows)])[0] + [draw.uniform(-1, 1), draw.uniform(-1, 1)]
        x, y = (round(float(each), 3) for each in where)
        radius = draw.choice([0.3, 1.0, 2.5])
        frame = topic.rows[0].body.header.frame_id
        given = {"x": x, "y": y, "frame_id": frame, "radius_m": radius, "limit": 100}

        apart = np.hypot(*(planar(topic.rows) - [x, y]).T)

        def check(answer: Any) -> str | None:
            known = (apart <= radius - TRACK_M).any()
            if _is_missing(answer) or answer["total"] == 0:
                return f"the closest pose is {apart.min():.4f} m away" if known else None
            for visit in answer["visits"]:
                wrong = self._closest_of(topic, visit, apart)
                if wrong:
                    return wrong
            nearest = min(each["closest_m"] for each in answer["visits"])
            if not known or answer["total"] > len(answer["visits"]):
                return None
            return self._nearest(nearest, apart)

        return "visits", given, check

    def driven(self, draw: Random) -> Any:
        topic = self._odometry[0]
        start, end = sorted(draw.sample(range(int(topic.times[0]), int(topic.times[-1])), 2))

        def check(answer: Any) -> str | None:
            if len(topic.within(start, end)) < 2:
                return None
            if _is_missing(answer):
                return "poses are there"
            told = answer["distance_m"]
            lengths = [self._length(rows) for rows in topic.bounds(start, end) if rows]
            if any(abs(told - length) <= allowed for length, allowed in lengths):
                return None
            return f"it drove {lengths[0][0]:.3f} m"

        return "trajectory_summary", {"start": start / 1e9, "end": end / 1e9}, check

    def stood(self, draw: Random) -> Any:
        topic = self._odometry[0]
        start, end = sorted(draw.sample(range(int(topic.times[0]), int(topic.times[-1])), 2))
        stood = self._world.stood
        assert stood is not None

        def check(answer: Any) -> str | None:
            inside = topic.within(start, end)
            if len(inside) < 2:
                return None
            told = answer.get("stood_s")
            if told is None:
                return "stood_s is not told"
            least, most = stood(inside[0].log_ns, inside[-1].log_ns)
            right = least - STOP_ENDS_S <= told <= most + STOP_ENDS_S
            return None if right else f"it stood for {least:.3f} to {most:.3f} s"

        return "recap", {"start": start / 1e9, "end": end / 1e9}, check

    def transform(self, draw: Random) -> Any:
        edge = draw.choice([*self._edges.values()])
        lasts = [each for each in self._edges.values() if not each.static]
        stamps = draw.choice(lasts).stamps if edge.static else edge.stamps
        at = draw.randint(min(stamps), max(stamps))
        given = {"parent": edge.parent, "child": edge.child, "timestamp": at / 1e9}

        def check(answer: Any) -> str | None:
            known = edge.at(at)
            if _is_missing(answer):
                lost = edge.static or known is None or edge.neighbours_apart(at) > 1
                return None if lost else "there is a transform"
            if known is None:
                return "there is no transform"
            shift, turn = known
            told = np.array([answer["translation"][axis] for axis in "xyz"])
            if np.abs(told - shift).max() > COARSE:
                return f"the translation is {shift}"
            rotated = [answer["rotation"][axis] for axis in "xyzw"]
            apart = abs(float(np.dot(rotated, turn.as_quat())))
            return None if apart > 1 - 1e-6 else f"the rotation is {turn.as_quat()}"

        return "get_transform_at", given, check

    def _length(self, rows: Sequence[Row]) -> tuple[float, float]:
        """How far (m) the robot drove from the first to the last of some poses, and a tolerance."""
        if self._world.noisy and len(rows) < FEWEST_POSES:
            return float(np.hypot(*np.diff(planar(rows), axis=0).T).sum()), 10 * COARSE
        assert self._world.moved is not None
        length = self._world.moved(rows[0].log_ns, rows[-1].log_ns)
        return length, self._world.path_tolerance * length + 0.06

    def _closest_of(self, topic: Topic, visit: Any, apart: Any) -> str | None:
        """What is wrong with the closest pose of a visit; `apart` has how far (m) all poses are."""
        first_s, last_s = visit["arrived"], visit["departed"]
        last = self._history.end if last_s is None else round(last_s * 1e9)
        ends = [round(first_s * 1e9) - EARLY_NS, last + SLACK_NS + 1]
        inside = slice(*np.searchsorted(topic.times, ends))
        at = [_same_time(visit["closest_at"], int(time)) for time in topic.times[inside]]
        if not any(abs(visit["closest_m"] - far) <= MILLIMETRES for far in apart[inside][at]):
            return f"no pose is so near at closest_at of {visit}"
        return self._nearest(visit["closest_m"], apart[inside])

    def _nearest(self, told_m: float, apart: Any) -> str | None:
        """What is wrong with the distance (m) of the closest of some poses.

        The track, to 5 cm, shows around which time it is, which matters where poses are noisy.
        """
        allowed = MILLIMETRES + (TRACK_M if self._world.noisy else 0)
        right = abs(told_m - apart.min()) <= allowed
        return None if right else f"the closest pose is {apart.min():.4f} m away"

    # -- moments

    def _moment(self, draw: Random, topic: Topic) -> int:
        """A time to ask about: at, beside or between messages, now and then far off; never < 0."""
        at = int(draw.choice(topic.times))
        moved = draw.choice([0, 0, 1, -1, 10**6, 7 * 10**7, -(10**8), 10**9, 20 * 10**9])
        return max(at + moved * draw.randint(1, 3), 0)


# -- comparing ---------------------------------------------------------------------------------


def _refused_limit(topic: Topic, condition: Mapping[str, Any]) -> float | None:
    """The limit that percent of a charge should have been, where all messages state fractions.

    There a limit above 1 is true of all messages, or of none: the server refuses it.
    """
    limit = condition["value"]
    if topic.rows[0].type != "sensor_msgs/msg/BatteryState" or condition["field"] != "percentage":
        return None
    if condition["condition_type"] not in {"above", "below"} or limit <= FULL_CHARGE:
        return None
    charges = [row.body.percentage for row in topic.rows]
    is_fraction = any(each > 0 for each in charges) and not any(
        each > FULL_CHARGE for each in charges
    )
    return limit / 100 if is_fraction else None


def _refusal(answer: Any, meant: float) -> str | None:
    refused = answer is not None and answer.get("error") == "invalid_arguments"
    right = refused and answer["detail"].endswith(f"is {meant:g}")
    return None if right else f"the charges are fractions, {meant:g} is meant"


def _is_missing(answer: Any) -> bool:
    """Whether the answer is that there is no such data; no other error may be one here."""
    assert answer.get("error") in {None, "no_data"}, answer
    return "error" in answer


def _same_time(told_s: float | None, at: int) -> bool:
    return told_s is not None and abs(told_s * 1e9 - at) <= 2 * SLACK_NS


def _recorded(told_s: float, rows: Sequence[Row]) -> bool:
    at = round(told_s * 1e9)
    first = bisect_left(rows, at - 2 * SLACK_NS, key=lambda row: row.log_ns)
    return first < len(rows) and _same_time(told_s, rows[first].log_ns)


def _candidates(topic: Topic, at: int, tolerance: int) -> list[Row | None]:
    """Every message that may be the answer; with None where there may be none."""
    found: list[Row | None] = []
    for slack in (-SLACK_NS, 0, SLACK_NS):
        for reach in (-SLACK_NS, 0, SLACK_NS, EARLY_NS):
            rows = topic.newest(at + slack, max(tolerance + slack + reach, 0))
            found.extend(rows or [None])
    return found


def _one_of(answer: Any, rows: Sequence[Row | None], paths: Sequence[str]) -> str | None:
    if _is_missing(answer):
        return None if None in rows else "a message is there"
    for row in rows:
        if row is None or not _same_time(answer["timestamp"], row.log_ns):
            continue
        if all(_same(answer["value"].get(path), path_of(row.body, path)) for path in paths):
            return None
    return f"expected one of {[row.log_ns for row in rows if row is not None][:3]}"


def _same(told: Any, value: Any) -> bool:
    if isinstance(value, float):
        if not math.isfinite(value):
            return told is None
        return isinstance(told, int | float) and abs(told - value) <= max(COARSE, 1e-5 * abs(value))
    return bool(told == value)


def _extremes(told: Any, path: str, inner: Sequence[Row], outer: Sequence[Row]) -> str | None:
    values = [[path_of(row.body, path) for row in rows] for rows in (inner, outer)]
    finite = [[each for each in part if math.isfinite(each)] for part in values]
    if told is None:
        return f"{path} has numbers" if finite[0] else None
    for key, best in (("min", min), ("max", max)):
        known = [best(part) for part in finite if part]
        if not any(_same(told[key], each) for each in known):
            return f"the {key} of {path} is {known[0]}"
    return None


def _last(
    answer: Any, rows: Sequence[Row], holds: Callable[[Row], bool], before: int | None
) -> str | None:
    """Whether the answer is the newest row that holds; either side of `before` within slack."""
    found = set()
    for slack in (-SLACK_NS, 0, SLACK_NS):
        upto = [row for row in rows if before is None or row.log_ns <= before + slack]
        found.add(next((row.log_ns for row in reversed(upto) if holds(row)), None))
    if answer is None or answer.get("timestamp") is None:
        early = answer is not None and answer.get("error") == "no_data"
        # Coordinates may be those of another frame: the note says which one was compared.
        notes = [] if answer is None else answer.get("notes", [])
        is_first = before is not None and all(row.log_ns > before - SLACK_NS for row in rows)
        noted = all(
            note.startswith("near_position compared")
            or (is_first and note.endswith("nothing was searched"))
            for note in notes
        )
        told = answer is None or early or (notes and noted)
        return None if None in found and told else f"it held at {found}"
    right = any(each is not None and _same_time(answer["timestamp"], each) for each in found)
    return None if right else f"it last held at {found}"
