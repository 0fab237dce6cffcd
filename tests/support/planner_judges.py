"""What is true of the demo's robot at the moment at which a planner asks, and who judges replies.

Judges compare with the robot's closed form: places to 5 cm, times to the second or better.
"""

from __future__ import annotations

import math
from functools import cache
from itertools import groupby, pairwise, takewhile
from typing import TYPE_CHECKING, Final, TypeAlias

from ros2_memory.core.timebase import (
    NS_PER_S,
    Ns,
    ns_from_unix,
    unix_from_ns,
    unix_rounded_up,
)
from ros2_memory.demo import judges, published_topics, robot
from ros2_memory.demo.judges import (
    CallContext,
    at,
    items,
    near,
    near_angle,
    number,
    one_of,
    same,
    text,
)
from ros2_memory.demo.messages import description
from ros2_memory.demo.published_topics import STREAMS, Message, Stream
from ros2_memory.demo.robot import THINGS, Planar

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ros2_memory.core.model import JsonValue

Replies: TypeAlias = "Sequence[JsonValue]"
Arguments: TypeAlias = "Mapping[str, JsonValue]"
Judge: TypeAlias = "Callable[[Replies, CallContext], object]"

STARTED_S: Final = 1_784_023_200
"""When the robot started, in Unix seconds: it was on its dock."""
HEARD_AFTER_S: Final = 17
ASKED_AFTER_S: Final = 240.5
"""Seconds since then after which the recording begins, and the planner asks."""
ASKED_AT_S: Final = STARTED_S + ASKED_AFTER_S

PLACE_M: Final = 0.05
SECOND: Final = 1.0
STOP_S: Final = 0.2
"""The robot comes to a stop so slowly that where it stands begins within this time."""
SAME_S: Final = 2e-3

OBJECTS: Final = "/vision/*/scene_objects"
DOCK: Final = robot.MAP_TO_ODOM
_BY_TOPIC: Final = {stream.topic: stream for stream in STREAMS}
ODOM: Final = _BY_TOPIC[published_topics.ODOM]
SEEN: Final = _BY_TOPIC[published_topics.SCENE_OBJECTS]
CLEAR: Final = _BY_TOPIC[published_topics.PATH_CLEAR]
SAID: Final = _BY_TOPIC[published_topics.SCENE_DESCRIPTION]
BATTERY: Final = _BY_TOPIC[published_topics.BATTERY]


# What is true


@cache
def _known(asked: CallContext, stream: Stream) -> tuple[Message, ...]:
    """All messages that the memory knows."""
    end = asked.known[-1]
    return tuple(
        takewhile(lambda message: message.log_time <= end, asked.timeline.messages(stream))
    )


@cache
def _labels(t: float) -> frozenset[str]:
    return frozenset(thing.label for thing in robot.seen(t))


def _messages(asked: CallContext, stream: Stream, since_s: float = 0.0) -> list[Message]:
    """All messages that the memory knows, from so many Unix seconds on."""
    since = ns_from_unix(since_s)
    return [message for message in _known(asked, stream) if message.log_time >= since]


def _rows(
    asked: CallContext, stream: Stream, holds: Callable[[float], bool], since_s: float = 0.0
) -> list[list[Message]]:
    """Messages in a row at whose time (s) something holds, oldest first."""
    grouped = groupby(_messages(asked, stream, since_s), key=lambda message: holds(message.t))
    return [[*row] for held, row in grouped if held]


def sees(label: str) -> Callable[[float], bool]:
    return lambda t: label in _labels(t)


_pose_in_map: Final = cache(robot.pose_in_map)


def _near(place: Planar | tuple[float, float], radius: float) -> Callable[[float], bool]:
    def holds(t: float) -> bool:
        here = _pose_in_map(t)
        return math.hypot(here.x - place[0], here.y - place[1]) <= radius

    return holds


@cache
def _stands(t: float) -> bool:
    return abs(robot.twist(t)[0]) < 0.005


def _stops(asked: CallContext, since_s: float, least_s: float = 3.0) -> list[list[Message]]:
    """Where the robot stood for so long and more, as far as it is since then."""
    rows = _rows(asked, ODOM, _stands)
    since = ns_from_unix(since_s)
    long = (row for row in rows if row[-1].log_time - row[0].log_time >= least_s * NS_PER_S)
    inside = ([each for each in row if each.log_time >= since] for row in long)
    return [row for row in inside if len(row) > 1]


def _t(moment_s: float) -> float:
    return moment_s - STARTED_S


def _unix(message: Message) -> float:
    return unix_from_ns(message.log_time)


def _ago(moment: Ns) -> float:
    return ASKED_AT_S - unix_from_ns(moment)


# Judges


def only(judge: judges.Judge) -> Judge:
    """A judge of the only reply."""
    return lambda replies, asked: judge(replies[-1], asked)


def _sighting(found: JsonValue, row: Sequence[Message], until: Message, *, of_thing: bool) -> None:
    """A row of messages as a sighting; of a thing from where it was seen last."""
    first, last = row[0], row[-1]
    one_of("first seen", number(found, "first_seen"), [first.log_time])
    one_of("last seen", number(found, "last_seen"), [last.log_time])
    near("how long", number(found, "duration_s"), _unix(until) - _unix(first), SAME_S)
    near("how long ago", number(found, "ago_s"), _ago(last.log_time), SAME_S)
    same("count", number(found, "count"), len(row))
    same("robot at", text(found, "robot", "at"), "last_seen" if of_thing else "first_seen")
    here = robot.pose_in_map(last.t if of_thing else first.t)
    near("x", number(found, "robot", "x"), here.x, PLACE_M)
    near("y", number(found, "robot", "y"), here.y, PLACE_M)
    same("frame", text(found, "robot", "frame_id"), "map")


def sighting_of(
    stream: Stream,
    holds: Callable[[float], bool],
    *,
    nth: int = -1,
    place: str | None = None,
) -> Judge:
    """The newest sighting, or the nth from the start or (negative) the end."""

    def judge(replies: Replies, asked: CallContext) -> None:
        found = at(replies[-1], "sightings", 0 if nth >= 0 else -1 - nth)
        same("topic", text(replies[-1], "topic"), stream.topic)
        row, of_thing = _rows(asked, stream, holds)[nth], stream is SEEN
        # A state lasts until a message says otherwise.
        later = [each for each in _messages(asked, stream) if each.log_time > row[-1].log_time]
        until = later[0] if later and not of_thing else row[-1]
        _sighting(found, row, until, of_thing=of_thing)
        if place is not None:
            for axis, expected in zip("xyz", THINGS[place], strict=True):
                near(f"{axis} of the {place}", number(found, "place", axis), expected, PLACE_M)
            same("frame", text(found, "place", "frame_id"), "map")

    return judge


def how_often(stream: Stream, holds: Callable[[float], bool], last_s: float = math.inf) -> Judge:
    def judge(replies: Replies, asked: CallContext) -> None:
        since = 0.0 if math.isinf(last_s) else ASKED_AT_S - last_s
        same("total", number(replies[-1], "total"), len(_rows(asked, stream, holds, since)))

    return judge


def visited(place: Planar | tuple[float, float], radius: float = 0.5) -> Judge:
    """The newest visit, how many there were, and whether it is there now."""

    def judge(replies: Replies, asked: CallContext) -> None:
        rows = _rows(asked, ODOM, _near(place, radius))
        newest = _messages(asked, ODOM)[-1]
        there = rows[-1][-1].log_time == newest.log_time
        found = at(replies[-1], "visits", 0)
        same("frame", text(replies[-1], "frame_id"), "map")
        same("there now", at(replies[-1], "there_now"), there)
        same("visits", number(replies[-1], "total"), len(rows))
        one_of("arrival", number(found, "arrived"), [rows[-1][0].log_time])
        if there:
            same("departure", at(found, "departed"), None)
        else:
            one_of("departure", number(found, "departed"), [rows[-1][-1].log_time])
            near("how long ago", number(found, "ago_s"), _ago(rows[-1][-1].log_time), SAME_S)
        stayed = (rows[-1][-1].log_time - rows[-1][0].log_time) / 1e9
        near("how long", number(found, "duration_s"), stayed, SAME_S)
        here = [robot.pose_in_map(message.t) for message in rows[-1]]
        closest = min(math.hypot(each.x - place[0], each.y - place[1]) for each in here)
        near("how near", number(found, "closest_m"), closest, PLACE_M)

    return judge


def never(replies: Replies, _asked: CallContext) -> None:
    reply = replies[-1]
    same("found", items(reply, "visits" if "visits" in str(reply) else "sightings"), [])
    same("total", number(reply, "total"), 0)


def no_error(replies: Replies, _asked: CallContext) -> None:
    found = [text(event, "text") for event in items(replies[-1], "events")]
    same("errors", [each for each in found if each.startswith("error")], [])
    same("gaps", [each for each in found if each == "nothing was recorded"], [])


def pose_at(moment_s: float) -> Judge:
    def judge(replies: Replies, _asked: CallContext) -> None:
        truth = robot.pose(_t(moment_s))
        near("x", number(replies[-1], "x"), truth.x, PLACE_M)
        near("y", number(replies[-1], "y"), truth.y, PLACE_M)
        near_angle("yaw", number(replies[-1], "yaw_deg"), truth.yaw, tolerance_deg=5.0)
        near("time", number(replies[-1], "timestamp"), moment_s, SECOND)

    return judge


def in_map(seconds_ago: float) -> Judge:
    def judge(replies: Replies, _asked: CallContext) -> None:
        truth = robot.pose_in_map(_t(ASKED_AT_S - seconds_ago))
        near("x", number(replies[-1], "translation", "x"), truth.x, PLACE_M)
        near("y", number(replies[-1], "translation", "y"), truth.y, PLACE_M)
        near_angle("yaw", number(replies[-1], "yaw_deg"), truth.yaw, tolerance_deg=1.0)

    return judge


def way_of_recap(last_s: float) -> Judge:
    """Distance, top speed and time stood of a recap, as far as it is in closed files."""

    def judge(replies: Replies, asked: CallContext) -> None:
        reply, driven = replies[-1], _messages(asked, ODOM, ASKED_AT_S - last_s)
        way = robot.driven(driven[-1].t) - robot.driven(driven[0].t)
        near("distance", number(reply, "distance_m"), way, PLACE_M)
        fastest = max(abs(robot.twist(message.t)[0]) for message in driven)
        near("top speed", number(reply, "max_speed"), fastest, 2e-3)
        stops = _stops(asked, ASKED_AT_S - last_s)
        stood = sum(row[-1].log_time - row[0].log_time for row in stops) / 1e9
        near("stood", number(reply, "stood_s"), stood, 2 * STOP_S * len(stops))

    return judge


def stopped(last_s: float) -> Judge:
    """Every stop of a recap: when, where, how long, and whether it goes on."""

    def judge(replies: Replies, asked: CallContext) -> None:
        found = _of_kind(replies[-1], "stood at")
        same("number of stops", number(replies[-1], "counts", "stops"), len(found))
        stops = _stops(asked, ASKED_AT_S - last_s)
        same("stops", len(found), len(stops))
        for event, row in zip(found, stops, strict=True):
            _stop(event, row)

    return judge


def _stop(event: JsonValue, row: Sequence[Message]) -> None:
    x, y = text(event, "text").removeprefix("stood at x ").split(", y ")
    middle = robot.pose_in_map(row[len(row) // 2].t)
    near("x", float(x), middle.x, PLACE_M)
    near("y", float(y), middle.y, PLACE_M)
    near("time", number(event, "timestamp"), unix_from_ns(row[0].log_time), STOP_S)
    near("how long ago", number(event, "ago_s"), _ago(row[0].log_time), STOP_S + 0.05)
    stood = (row[-1].log_time - row[0].log_time) / 1e9
    near("how long", number(event, "duration_s"), stood, 2 * STOP_S)


def _of_kind(reply: JsonValue, begins: str) -> list[JsonValue]:
    return [each for each in items(reply, "events") if text(each, "text").startswith(begins)]


def standing_since(replies: Replies, asked: CallContext) -> None:
    event = _of_kind(replies[-1], "stood at")[-1]
    _stop(event, _stops(asked, 0.0)[-1])
    same("still", at(event, "goes_on"), expected=True)


def came_into_view(last_s: float) -> Judge:
    """What was seen, by the names of things, and when each came into view."""

    def judge(replies: Replies, asked: CallContext) -> None:
        found = [
            (text(event, "text").removesuffix(" in view"), number(event, "timestamp"))
            for event in items(replies[-1], "events")
            if text(event, "text").endswith(" in view")
        ]
        since = ASKED_AT_S - last_s
        for label in THINGS:
            rows = _rows(asked, SEEN, sees(label), since)
            moments = [row[0].log_time for row in rows]
            mine = [moment for name, moment in found if name == label]
            same(f"whether the {label} was in view", bool(mine), bool(moments))
            for moment in mine:
                one_of(f"the {label} in view at", moment, moments)

    return judge


def seen_there(place: Planar) -> Judge:
    """What was in view while the robot was last at a place."""

    def judge(replies: Replies, asked: CallContext) -> None:
        row = _rows(asked, ODOM, _near(place, 0.5))[-1]
        there = [
            message
            for message in _messages(asked, SEEN)
            if row[0].log_time <= message.log_time <= row[-1].log_time
        ]
        expected = {thing.label for message in there for thing in robot.seen(message.t)}
        found = {
            text(event, "text").removesuffix(" in view")
            for event in items(replies[-1], "events")
            if text(event, "text").endswith(" in view")
        }
        same("things", found, expected)

    return judge


def flips_of_path(replies: Replies, asked: CallContext) -> None:
    found = [
        (number(event, "timestamp"), text(event, "text").rsplit(" ", 1)[1] == "true")
        for event in _of_kind(replies[-1], published_topics.PATH_CLEAR)
    ]
    some = _messages(asked, CLEAR, ASKED_AT_S - 60)
    pairs = pairwise(some)
    flips = [
        (unix_rounded_up(after.log_time), robot.path_clear(after.t))
        for before, after in pairs
        if robot.path_clear(before.t) != robot.path_clear(after.t)
    ]
    same("flips", found, flips)


def later(first: str, second: str) -> Judge:
    """Which of two things was seen last: a comparison of two moments."""

    def judge(replies: Replies, asked: CallContext) -> None:
        for label, reply in zip((first, second), replies, strict=True):
            row = _rows(asked, SEEN, sees(label))[-1]
            _sighting(at(reply, "sightings", 0), row, row[-1], of_thing=True)

    return judge


def charge_when_seen(label: str) -> Judge:
    def judge(replies: Replies, asked: CallContext) -> None:
        last = _rows(asked, SEEN, sees(label))[-1][-1]
        one_of("the match at", number(replies[-1], "timestamp"), [last.log_time])
        then = asked.timeline.newest(BATTERY, last.log_time)
        assert then is not None
        near("charge", number(replies[-1], "value", "percentage"), robot.battery(then.t), 1e-6)

    return judge


def driven_between_stops(replies: Replies, asked: CallContext) -> None:
    *_, before, last = _stops(asked, ASKED_AT_S - 60)
    way = robot.driven(last[0].t) - robot.driven(before[0].t)
    near("distance", number(replies[-1], "distance_m"), way, PLACE_M)


def between_stops(replies: Replies) -> Arguments:
    *_, before, last = _of_kind(replies[0], "stood at")
    return {"start": at(before, "timestamp"), "end": at(last, "timestamp")}


def last_stay(replies: Replies) -> Arguments:
    return {
        "start": at(replies[0], "visits", 0, "arrived"),
        "end": at(replies[0], "visits", 0, "departed"),
    }


def said_last(replies: Replies, asked: CallContext) -> None:
    newest = _messages(asked, SAID)[-1]
    found = at(replies[-1], "samples", -1)
    one_of("the words at", number(found, "timestamp"), [newest.log_time])
    same("words", text(found, "value", "value"), description(newest.t))


def commanded(seconds_ago: float) -> Judge:
    def judge(replies: Replies, _asked: CallContext) -> None:
        forward, turning = robot.twist(_t(number(replies[-1], "timestamp")))
        near("time", number(replies[-1], "timestamp"), ASKED_AT_S - seconds_ago, 0.2)
        found = at(replies[-1], "value")
        near("forward", number(found, "linear_velocity", "x"), forward, 5e-3)
        near("turning", number(found, "angular_velocity", "z"), turning, 5e-3)

    return judge


def lowest_charge(last_s: float) -> Judge:
    def judge(replies: Replies, asked: CallContext) -> None:
        known = _messages(asked, BATTERY, ASKED_AT_S - last_s)
        least = min(known, key=lambda message: robot.battery(message.t))
        found = at(replies[-1], "extremes", "percentage")
        near("charge", number(found, "min"), robot.battery(least.t), 2e-6)
        one_of("lowest at", number(found, "min_at"), [least.log_time])

    return judge


def nearest_wall(last_s: float) -> Judge:
    def judge(replies: Replies, asked: CallContext) -> None:
        scans = _messages(asked, _BY_TOPIC[published_topics.SCAN], ASKED_AT_S - last_s)
        nearest = min(float(robot.scan(message.t).min()) for message in scans)
        near("distance", number(replies[-1], "extremes", "ranges", "min"), nearest, PLACE_M)

    return judge


def trusted(replies: Replies, asked: CallContext) -> None:
    reply = replies[-1]
    # The newest split, which no recorder names here.
    young = "1 file has no end yet: being written, or left by a crash"
    same("doubts", text(reply, "doubts"), young)
    near("age", number(reply, "newest_age_s"), _ago(asked.known[-1]), SAME_S)
    same("silent topics", items(reply, "fell_silent"), [])
    same("damaged", number(reply, "damaged"), 0)


def none_kept(replies: Replies, _asked: CallContext) -> None:
    same("moments", items(replies[-1], "moments"), [])


def counted(topic: str) -> Judge:
    def judge(replies: Replies, asked: CallContext) -> None:
        [row] = items(replies[-1])
        same("topic", text(row, "topic"), topic)
        same("messages", number(row, "count"), len(_messages(asked, _BY_TOPIC[topic])))

    return judge
