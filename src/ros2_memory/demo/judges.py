"""Judges, one for each kind of answer, and what they check with.

A judge compares a reply with the robot's closed form at the reply's own time, checks that this time
is the right one, and returns the answer as a sentence. It raises `WrongAnswerError` otherwise.

The memory answers from closed splits, and "ago" counts from the moment at which the server read
its clock. Neither is known to the client exactly, only between two bounds; so a question has a
few messages that it may rightly be answered with, and each of them has its one right value.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Final, TypeAlias, TypeVar

from ros2_memory.core.timebase import (
    NS_PER_MS,
    NS_PER_S,
    Ns,
    ns_from_unix,
    unix_from_ns,
    unix_rounded_up,
)
from ros2_memory.demo import robot
from ros2_memory.demo.messages import description, listed_in_words
from ros2_memory.demo.published_topics import (
    BATTERY,
    ODOM,
    PATH_CLEAR,
    SCENE_DESCRIPTION,
    SCENE_OBJECTS,
    STREAMS,
    Message,
    MessageSchedule,
    Stream,
)
from ros2_memory.demo.robot import Planar, room_at

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ros2_memory.core.model import JsonValue


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
        fits = (
            next((message for message in messages if holds(message.t)), None)
            for messages in newest_first
        )
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
    item = at(value, *path)
    if isinstance(item, bool) or not isinstance(item, kinds):
        named = ".".join(map(str, path)) or "the top"
        raise WrongAnswerError(f"expected {what} at {named}, not {_brief(item)}")
    return item


def one_of(what: str, moment_s: float, moments: Sequence[Ns]) -> None:
    """Checks that a time (Unix seconds) is one of several.

    Raises:
        WrongAnswerError: it is not.
    """
    if not any(abs(unix_rounded_up(moment) - moment_s) < _SAME_MOMENT_S for moment in moments):
        right = " or ".join(f"{unix_rounded_up(moment):.6f}" for moment in moments[:4])
        raise WrongAnswerError(f"expected {what} {right or 'no moment'}, not {moment_s:.6f}")


def match_time(moment_s: float, candidates: Sequence[Message]) -> Message:
    """Returns the candidate with this log time (Unix seconds).

    Raises:
        WrongAnswerError: none of them.
    """
    one_of("the message of", moment_s, [message.log_time for message in candidates])
    return min(candidates, key=lambda message: abs(unix_rounded_up(message.log_time) - moment_s))


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


Judge: TypeAlias = "Callable[[JsonValue, CallContext], str]"
Tell: TypeAlias = "Callable[[JsonValue, Message, str], str]"
"""Checks what a reply has of a message, and returns the answer in words, with its time in words."""

NEAR_M: Final = 0.5
"""The radius of a place: the server's default `data.position_tolerance_m`."""

_MPS: Final = 1e-3
_SHARE_OF_PATH: Final = 1e-3
_INTERPOLATED_M: Final = 5e-3
_BY_TOPIC: Final = {stream.topic: stream for stream in STREAMS}


def in_odom(place: Planar) -> Planar:
    """Returns a place of the flat in `odom`, the frame of the robot's poses."""
    return robot.MAP_TO_ODOM.inverse().then(place)


def time_range(reply: JsonValue, call: CallContext) -> str:
    """Judges the range: all that was recorded, without gaps or damage, and an active file."""
    first = next(call.timeline.everything()).log_time
    earliest, latest = number(reply, "earliest"), number(reply, "latest")
    one_of("earliest", earliest, [first])
    one_of("latest", latest, call.known)
    for kind in ("gaps", "damaged", "incomplete", "unread"):
        same(kind, items(reply, kind), [])
    if not items(reply, "active"):
        same("active files", 0, 1)
    return (
        f"{latest - earliest:.0f} s, in {number(reply, 'bags'):.0f} closed bag files, up to "
        f"{call.age_s(latest):.1f} s ago. What is being written joins them as its file closes."
    )


def topics(reply: JsonValue, call: CallContext) -> str:
    """Judges the list of topics: the type, the count and the newest message of each."""
    counts: dict[str, int] = {}
    rows = items(reply)
    same("topics", sorted(text(row, "topic") for row in rows), sorted(_BY_TOPIC))
    for row in rows:
        stream = _BY_TOPIC[text(row, "topic")]
        same(f"type of {stream.topic}", text(row, "type"), stream.type)
        newest = match_time(number(row, "last_ts"), call.newest_known(stream))
        counts[stream.topic] = call.timeline.count(stream, newest.log_time)
        same(f"count of {stream.topic}", number(row, "count"), counts[stream.topic])
    total = sum(counts.values())
    of_odom = counts[ODOM]
    return f"{total:,} messages on {len(counts)} topics, {of_odom:,} on /odom."


def _judge_ago(topic: str, tell: Tell, seconds_ago: float) -> Judge:
    """Judges the message of a topic so long ago; `tell` checks what it holds."""

    def judge(reply: JsonValue, call: CallContext) -> str:
        candidates = call.ago(_BY_TOPIC[topic], seconds_ago)
        return tell(reply, match_time(number(reply, "timestamp"), candidates), "")

    return judge


def _pose(reply: JsonValue, message: Message, _when: str) -> str:
    same("frame", text(reply, "frame_id"), "odom")
    yaw = number(reply, "yaw_deg")
    near_angle("yaw", yaw, robot.pose(message.t).yaw)
    return f"{_at_place(reply, message)}, facing {yaw:.0f} degrees."


def _twist(reply: JsonValue, message: Message, _when: str) -> str:
    forward, turning = robot.twist(message.t)
    near("forward speed", number(reply, "linear", "x"), forward, _MPS)
    near("turning rate", number(reply, "angular", "z"), turning, _MPS)
    way, rate = "backwards" if forward < 0 else "forwards", math.degrees(turning)
    turn = f"turning {'left' if rate > 0 else 'right'} at {abs(rate):.0f} degrees/s"
    return f"{abs(forward):.2f} m/s {way}, {turn if abs(rate) >= 1 else 'straight on'}."


def _charge(reply: JsonValue, message: Message, _when: str) -> str:
    charge = number(reply, "value", "percentage")
    near("charge", charge, robot.battery(message.t), 1e-6)
    return f"{charge:.1%}."


position: Final = partial(_judge_ago, ODOM, _pose)
velocity: Final = partial(_judge_ago, ODOM, _twist)
battery: Final = partial(_judge_ago, BATTERY, _charge)


def _last(topic: str, holds: Callable[[float], bool], tell: Tell, then: str | None = None) -> Judge:
    """Judges when something last was so in the messages of a topic.

    `tell` checks what the reply has of that message, or of the one of the topic `then` at or before
    it.
    """

    def judge(reply: JsonValue, call: CallContext) -> str:
        moment = number(reply, "timestamp")
        matched = match_time(moment, call.last_where(_BY_TOPIC[topic], holds))
        if then is not None:
            newest = call.timeline.newest(_BY_TOPIC[then], matched.log_time)
            matched = match_time(number(reply, "value_timestamp"), [newest] if newest else [])
        return tell(reply, matched, f"at {call.when(moment)}")

    return judge


def _labels(reply: JsonValue, message: Message) -> str:
    """Checks the objects in view, and returns their names for a sentence."""
    labels = [text(detection, "label") for detection in items(reply, "value", "detections")]
    same("objects", sorted(labels), sorted(thing.label for thing in robot.seen(message.t)))
    return listed_in_words(labels)


def seen_near(place: Planar) -> Judge:
    """Judges what the camera saw when the robot last was at a place."""

    def tell(reply: JsonValue, message: Message, when: str) -> str:
        return f"{_labels(reply, message).capitalize()}, {when}."

    return _last(ODOM, _is_near(place), tell, SCENE_OBJECTS)


def last_near(place: Planar) -> Judge:
    """Judges when the robot last was at a place."""

    def tell(reply: JsonValue, message: Message, when: str) -> str:
        _at_place(at(reply, "value", "position"), message)
        return f"{when.capitalize()}."

    return _last(ODOM, _is_near(place), tell)


def _clear(reply: JsonValue, _message: Message, when: str) -> str:
    same("value", at(reply, "value", "value"), expected=True)
    return f"{when.capitalize()}."


path_clear: Final = _last(PATH_CLEAR, robot.path_clear, _clear)


def last_seen(label: str) -> Judge:
    """Judges when an object was last seen."""

    def tell(reply: JsonValue, message: Message, when: str) -> str:
        same("topic", text(reply, "topic"), SCENE_OBJECTS)
        return f"{when.capitalize()}; in view: {_labels(reply, message)}."

    return _last(SCENE_OBJECTS, _sees(label), tell)


def where_seen(label: str) -> Judge:
    """Judges where the robot was when it last saw an object."""

    def tell(reply: JsonValue, message: Message, when: str) -> str:
        return f"{_at_place(at(reply, 'value', 'position'), message)}, {when}."

    return _last(SCENE_OBJECTS, _sees(label), tell, ODOM)


def driven(seconds: float) -> Judge:
    """Judges the distance driven in the last seconds, as far as closed files have it."""
    window = ns_from_unix(seconds)

    def judge(reply: JsonValue, call: CallContext) -> str:
        stream = _BY_TOPIC[ODOM]
        start, end = number(reply, "start"), number(reply, "end")
        last = match_time(end, call.newest_known(stream))
        begun = (call.before - window, call.after - window + stream.period + NS_PER_MS)
        within("start", start, begun)
        newest = call.timeline.newest(stream, ns_from_unix(start) + NS_PER_MS)
        first = match_time(start, [newest] if newest else [])
        expected = robot.driven(last.t) - robot.driven(first.t)
        near("distance", number(reply, "distance_m"), expected, METRES + _SHARE_OF_PATH * expected)
        near("duration", number(reply, "duration_s"), end - start, 2e-3)
        near("mean speed", number(reply, "avg_speed"), expected / (end - start), _MPS)
        between = (call.timeline.message(stream, k).t for k in range(first.k, last.k + 1))
        fastest = max(abs(robot.twist(t)[0]) for t in between)
        near("top speed", number(reply, "max_speed"), fastest, _MPS)
        return (
            f"{expected:.2f} m, at up to {fastest:.2f} m/s, in the {end - start:.1f} s of it that "
            "are in closed files."
        )

    return judge


def camera_in_map(seconds_ago: float) -> Judge:
    """Judges the pose of the camera in `map` so long ago, through four frames."""

    def judge(reply: JsonValue, call: CallContext) -> str:
        moment = number(reply, "timestamp")
        back = ns_from_unix(seconds_ago)
        within("time", moment, (call.before - back, call.after - back))
        t = (ns_from_unix(moment) - call.timeline.t0) / NS_PER_S
        truth = robot.pose_in_map(t).then(Planar(robot.CAMERA[0], robot.CAMERA[1], 0.0))
        x, y, z = (number(reply, "translation", axis) for axis in "xyz")
        expected = truth.x, truth.y, robot.CAMERA[2]
        for axis, got, right in zip("xyz", (x, y, z), expected, strict=True):
            near(axis, got, right, _INTERPOLATED_M)
        near_angle("yaw", number(reply, "yaw_deg"), truth.yaw, tolerance_deg=0.2)
        return (
            f"In the {room_at(x)}, {x:.2f} m east and {y:.2f} m north of the flat's corner, "
            f"{z:.2f} m high."
        )

    return judge


def frames(reply: JsonValue, _call: CallContext) -> str:
    """Judges the frames, and which of them move."""
    rows = items(reply, "transforms")
    pairs = {(text(row, "parent"), text(row, "child")): at(row, "static") for row in rows}
    expected: dict[tuple[str, str], JsonValue] = {
        ("map", "odom"): True,
        ("odom", "base_link"): False,
        ("base_link", "camera"): True,
        ("base_link", "laser"): True,
    }
    same("frames", pairs, expected)
    return "map > odom > base_link > camera and laser; only base_link moves."


def descriptions(seconds: float, at_most: int) -> Judge:
    """Judges the descriptions of the last seconds, thinned to a few samples."""
    window = ns_from_unix(seconds)

    def judge(reply: JsonValue, call: CallContext) -> str:
        stream = _BY_TOPIC[SCENE_DESCRIPTION]
        samples = items(reply, "samples")
        total = int(number(reply, "total"))
        same("samples", len(samples), min(total, at_most))
        begun = (call.before - window, call.after - window + stream.period + NS_PER_MS)
        within("start", number(samples, 0, "timestamp"), begun)
        last = match_time(number(samples, -1, "timestamp"), call.newest_known(stream))
        first = call.timeline.message(stream, last.k - total + 1)
        match_time(number(samples, 0, "timestamp"), [first])
        between = [call.timeline.message(stream, k) for k in range(first.k, last.k + 1)]
        for sample in samples:
            message = match_time(number(sample, "timestamp"), between)
            same("words", text(sample, "value", "value"), description(message.t))
        return " ".join(text(sample, "value", "value") for sample in samples[-2:])

    return judge


def nothing_on(topic: str) -> Judge:
    """Judges the reply that a topic was never recorded, which is an answer, too."""

    def judge(reply: JsonValue, _call: CallContext) -> str:
        same("error", text(reply, "error"), "no_data")
        same("reason", text(reply, "reason"), "topic_not_recorded")
        return f"{topic} was never recorded, and the answer says so."

    return judge


def _is_near(place: Planar) -> Callable[[float], bool]:
    spot = in_odom(place)

    def holds(t: float) -> bool:
        pose = robot.pose(t)
        return math.hypot(pose.x - spot.x, pose.y - spot.y) <= NEAR_M

    return holds


def _sees(label: str) -> Callable[[float], bool]:
    return lambda t: any(thing.label == label for thing in robot.seen(t))


def _at_place(point: JsonValue, message: Message) -> str:
    """Checks a position in `odom`, and returns where in the flat it is."""
    truth = robot.pose(message.t)
    x, y, z = (number(point, axis) for axis in "xyz")
    for axis, got, expected in (("x", x, truth.x), ("y", y, truth.y), ("z", z, 0.0)):
        near(axis, got, expected, METRES)
    in_map = robot.MAP_TO_ODOM.then(Planar(x, y, 0.0))
    return f"In the {room_at(in_map.x)}, at x {x:.2f} m, y {y:.2f} m in odom"
