"""The questions of the demo: in words, as a tool call, and with the judge of the answer.

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
from typing import TYPE_CHECKING, Final, TypeAlias

from ros2_memory.core.timebase import (
    NS_PER_MS,
    NS_PER_S,
    Ns,
    ns_from_unix,
    unix_from_ns,
    unix_rounded_up,
)
from ros2_memory.demo import robot
from ros2_memory.demo.messages import (
    BATTERY,
    ODOM,
    PATH_CLEAR,
    SCENE_OBJECTS,
    STREAMS,
    Message,
    MessageSchedule,
    Stream,
)
from ros2_memory.demo.robot import Planar, room_at

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from ros2_memory.core.model import JsonValue

NEAR_M: Final = 0.5
"""The radius of a place: the server's default `data.position_tolerance_m`."""
_ROUNDED: Final = 1e-3
"""Metres or m/s that a right number may be off by its rounding, with some room."""
_SAME_MOMENT_S: Final = 2e-6
_FAULTS: Final = ("gaps", "damaged", "incomplete", "unread")
_BY_TOPIC: Final = {stream.topic: stream for stream in STREAMS}


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

    def last_where(
        self, stream: Stream, holds: Callable[[float], bool] = lambda _: True
    ) -> list[Message]:
        """Returns the messages that may be the newest known one for which `holds(t)` is true."""
        newest_first = (self.timeline.newest_first(stream, end) for end in self.known)
        fits = (
            next((message for message in messages if holds(message.t)), None)
            for messages in newest_first
        )
        return [message for message in fits if message is not None]

    def begun(self, seconds: float, stream: Stream) -> tuple[Ns, Ns]:
        """Returns the bounds of the first message in a window of so many seconds up to now."""
        window = ns_from_unix(seconds)
        return self.before - window, self.after - window + stream.period + NS_PER_MS

    def age_s(self, moment_s: float) -> float:
        """Returns the age of a time (Unix seconds) when the answer came."""
        return unix_from_ns(self.after) - moment_s


Judge: TypeAlias = "Callable[[JsonValue, CallContext], str]"
Expected: TypeAlias = "Callable[[float], dict[str, JsonValue]]"
"""What a reply has of the robot at a time t."""


@dataclass(frozen=True, slots=True)
class Question:
    """One question; its judge takes the reply and the context of the call."""

    words: str
    tool: str
    arguments: Mapping[str, JsonValue]
    judge: Judge


@dataclass(frozen=True, slots=True)
class Exchange:
    """One question and its answer: a sentence if it is right, else what was expected."""

    question: Question
    reply: str
    sentence: str
    right: bool


def judge_reply(
    question: Question, reply: str, call: CallContext, *, is_error: bool = False
) -> Exchange:
    """Compares a reply with what the robot did."""
    if is_error:
        return Exchange(question, reply, "expected an answer, not an error", right=False)
    try:
        parsed = json.loads(reply, parse_constant=_no_number)
        return Exchange(question, reply, question.judge(parsed, call), right=True)
    except WrongAnswerError as error:
        return Exchange(question, reply, str(error), right=False)
    except ValueError as error:
        return Exchange(question, reply, f"expected JSON: {error}", right=False)


def _no_number(constant: str) -> float:
    raise ValueError(f"{constant} is not JSON")


def _at(value: JsonValue, key: str) -> JsonValue:
    """Returns what an object of a reply has at a key.

    Raises:
        WrongAnswerError: there is nothing.
    """
    if not isinstance(value, dict) or key not in value:
        raise WrongAnswerError(f"expected {key!r} in {_brief(value)}")
    return value[key]


def _number(value: JsonValue, key: str) -> float:
    """Returns the number at a key; raises likewise."""
    number = _at(value, key)
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise WrongAnswerError(f"expected a number at {key}, not {_brief(number)}")
    return number


def _items(value: JsonValue) -> list[JsonValue]:
    """Returns a list; raises likewise."""
    if not isinstance(value, list):
        raise WrongAnswerError(f"expected a list, not {_brief(value)}")
    return value


def _require(
    reply: JsonValue,
    expected: Mapping[str, JsonValue],
    *,
    off: float = _ROUNDED,
    off_deg: float = 0.05,
) -> None:
    """Checks that a reply has what is expected; it may have more.

    A number may be `off`, an angle `off_deg`, in whatever turn.

    Raises:
        WrongAnswerError: it has not.
    """
    for key, right in expected.items():
        got = _at(reply, key)
        if isinstance(right, dict):
            _require(got, right, off=off, off_deg=off_deg)
        elif isinstance(right, list) and right and len(right) == len(_items(got)):
            for one, other in zip(_items(got), right, strict=True):
                _require({key: one}, {key: other}, off=off, off_deg=off_deg)
        elif isinstance(right, float):
            apart, may_be = _number(reply, key) - right, off
            if key.endswith("_deg"):
                apart, may_be = (apart + 180.0) % 360.0 - 180.0, off_deg
            if not abs(apart) <= may_be:
                raise WrongAnswerError(f"expected {key} {right:.4f}, not {_brief(got)}")
        elif got != right:
            raise WrongAnswerError(f"expected {key} {_brief(right)}, not {_brief(got)}")


def _one_of(what: str, moment_s: float, moments: Sequence[Ns]) -> int:
    """Returns which of several times this is (Unix seconds).

    Raises:
        WrongAnswerError: none of them.
    """
    for nth, moment in enumerate(moments):
        if abs(unix_rounded_up(moment) - moment_s) < _SAME_MOMENT_S:
            return nth
    right = " or ".join(f"{unix_rounded_up(moment):.6f}" for moment in moments[:4])
    raise WrongAnswerError(f"expected {what} {right or 'no moment'}, not {moment_s:.6f}")


def _message_of(moment_s: float, candidates: Sequence[Message | None]) -> Message:
    """Returns the candidate with this log time (Unix seconds); raises likewise."""
    messages = [message for message in candidates if message is not None]
    times = [message.log_time for message in messages]
    return messages[_one_of("the message of", moment_s, times)]


def _within(what: str, moment_s: float, bounds: tuple[Ns, Ns]) -> None:
    """Checks that a time (Unix seconds) is between two bounds, both included; raises likewise."""
    first, last = map(unix_rounded_up, bounds)
    if not first - _SAME_MOMENT_S <= moment_s <= last + _SAME_MOMENT_S:
        raise WrongAnswerError(
            f"expected {what} between {first:.6f} and {last:.6f}, not {moment_s:.6f}"
        )


def _brief(value: JsonValue) -> str:
    whole = json.dumps(value)
    return whole if len(whole) <= 60 else f"{whole[:57]}..."


def _time_range(reply: JsonValue, call: CallContext) -> str:
    """Judges the range: all that was recorded, without gaps or damage, and an active file."""
    earliest, latest = _number(reply, "earliest"), _number(reply, "latest")
    _one_of("earliest", earliest, [next(call.timeline.everything()).log_time])
    _one_of("latest", latest, call.known)
    _require(reply, {fault: [] for fault in _FAULTS})
    if not _items(_at(reply, "active")):
        raise WrongAnswerError("expected 1 active file, not 0")
    return (
        f"{latest - earliest:.0f} s, in {_number(reply, 'bags'):.0f} closed bag files, up to "
        f"{call.age_s(latest):.1f} s ago. What is being written joins them as its file closes."
    )


def _of_message(
    candidates: Callable[[CallContext], Sequence[Message]],
    expected: Expected,
    sentence: str,
    then: str | None = None,
    off: float = _ROUNDED,
) -> Judge:
    """Judges a reply from one of a few messages.

    `expected` and `sentence` are of that message, or of the one of the topic `then` at or before
    it; the sentence has what `_in_words` names. A number may be `off`.
    """

    def judge(reply: JsonValue, call: CallContext) -> str:
        moment = _number(reply, "timestamp")
        message = _message_of(moment, candidates(call))
        if then is not None:
            newest = call.timeline.newest(_BY_TOPIC[then], message.log_time)
            message = _message_of(_number(reply, "value_timestamp"), [newest])
        _require(reply, expected(message.t), off=off)
        local = datetime.fromtimestamp(moment, tz=UTC).astimezone()
        when = f"at {local:%H:%M:%S}, {call.age_s(moment):.1f} s ago"
        told = sentence.format(when=when, **_in_words(message.t))
        return told[0].upper() + told[1:]

    return judge


def _ago(
    topic: str, seconds_ago: float, expected: Expected, sentence: str, off: float = _ROUNDED
) -> Judge:
    """Judges what the message of a topic so long ago holds."""
    stream = _BY_TOPIC[topic]
    return _of_message(lambda call: call.ago(stream, seconds_ago), expected, sentence, off=off)


def _last(
    topic: str,
    holds: Callable[[float], bool],
    expected: Expected,
    sentence: str,
    then: str | None = None,
) -> Judge:
    """Judges when something last was so in the messages of a topic."""
    stream = _BY_TOPIC[topic]
    return _of_message(lambda call: call.last_where(stream, holds), expected, sentence, then)


def _in_words(t: float) -> dict[str, str]:
    """Returns what the robot does, and what there is, for sentences."""
    x, y, yaw = robot.pose(t)
    forward, turning = robot.twist(t)
    way, rate = "backwards" if forward < 0 else "forwards", math.degrees(turning)
    turn = f"turning {'left' if rate > 0 else 'right'} at {abs(rate):.0f} degrees/s"
    return {
        "place": f"in the {robot.place(t)}, at x {_metres(x)}, y {_metres(y)} in odom",
        "facing": f"{math.degrees(yaw):.0f} degrees",
        "motion": f"{abs(forward):.2f} m/s {way}, {turn if abs(rate) >= 1 else 'straight on'}",
        "charge": f"{robot.battery(t):.1%}",
        "objects": ", ".join(thing.label for thing in robot.seen(t)) or "nothing",
    }


def _metres(value: float) -> str:
    return f"{round(value, 2) + 0.0:.2f} m"  # nothing is -0.00 m


def _position(t: float) -> dict[str, JsonValue]:
    x, y, _ = robot.pose(t)
    return {"x": x, "y": y, "z": 0.0}


def _at_position(t: float) -> dict[str, JsonValue]:
    return {"value": {"position": _position(t)}}


def _pose(t: float) -> dict[str, JsonValue]:
    yaw = math.degrees(robot.pose(t).yaw)
    return {"frame_id": "odom", **_position(t), "yaw_deg": yaw}


def _twist(t: float) -> dict[str, JsonValue]:
    forward, turning = robot.twist(t)
    return {"linear": {"x": forward}, "angular": {"z": turning}}


def _objects(t: float) -> dict[str, JsonValue]:
    return {"value": {"detections": [{"label": thing.label} for thing in robot.seen(t)]}}


def _driven(seconds: float) -> Judge:
    """Judges the distance driven in the last seconds, as far as closed files have it."""

    def judge(reply: JsonValue, call: CallContext) -> str:
        stream = _BY_TOPIC[ODOM]
        start, end = _number(reply, "start"), _number(reply, "end")
        last = _message_of(end, call.last_where(stream))
        _within("start", start, call.begun(seconds, stream))
        newest = call.timeline.newest(stream, ns_from_unix(start) + NS_PER_MS)
        first = _message_of(start, [newest])
        metres = robot.driven(last.t) - robot.driven(first.t)
        between = (call.timeline.message(stream, k).t for k in range(first.k, last.k + 1))
        fastest = max(abs(robot.twist(t)[0]) for t in between)
        _require(reply, {"distance_m": metres}, off=_ROUNDED * (1 + metres))
        _require(reply, {"duration_s": end - start}, off=2 * _ROUNDED)
        _require(reply, {"avg_speed": metres / (end - start), "max_speed": fastest})
        return (
            f"{metres:.2f} m, at up to {fastest:.2f} m/s, in the {end - start:.1f} s of it that "
            "are in closed files."
        )

    return judge


def _camera_in_map(seconds_ago: float) -> Judge:
    """Judges the pose of the camera in `map` so long ago, through four frames."""

    def judge(reply: JsonValue, call: CallContext) -> str:
        moment = _number(reply, "timestamp")
        back = ns_from_unix(seconds_ago)
        _within("time", moment, (call.before - back, call.after - back))
        t = (ns_from_unix(moment) - call.timeline.t0) / NS_PER_S
        x, y, yaw = robot.pose_in_map(t).then(Planar(*robot.CAMERA[:2], 0.0))
        where: JsonValue = {"x": x, "y": y, "z": robot.CAMERA[2]}
        expected = {"translation": where, "yaw_deg": math.degrees(yaw)}
        _require(reply, expected, off=5e-3, off_deg=0.2)  # between two transforms
        return (
            f"In the {room_at(x)}, {x:.2f} m east and {y:.2f} m north of the flat's corner, "
            f"{robot.CAMERA[2]:.2f} m high."
        )

    return judge


def _nothing_on(topic: str) -> Judge:
    """Judges the reply that a topic was never recorded, which is an answer, too."""

    def judge(reply: JsonValue, _call: CallContext) -> str:
        _require(reply, {"error": "no_data", "reason": "topic_not_recorded"})
        return f"{topic} was never recorded, and the answer says so."

    return judge


def _is_near(place: Planar) -> Callable[[float], bool]:
    spot = _in_odom(place)

    def holds(t: float) -> bool:
        pose = robot.pose(t)
        return math.hypot(pose.x - spot.x, pose.y - spot.y) <= NEAR_M

    return holds


def _sees(label: str) -> Callable[[float], bool]:
    return lambda t: any(thing.label == label for thing in robot.seen(t))


def _in_odom(place: Planar) -> Planar:
    """Returns a place of the flat in `odom`, the frame of the robot's poses."""
    return robot.MAP_TO_ODOM.inverse().then(place)


def _near(place: Planar) -> Mapping[str, JsonValue]:
    """Returns the condition that the robot is at a place."""
    x, y, _ = _in_odom(place)
    return {"condition_type": "near_position", "value": {"x": round(x, 3), "y": round(y, 3)}}


LOOK_BACK_S: Final = 60
"""The longest window that a question is about."""
_CAMERA_TOPIC: Final = "/camera/image_raw"
_SCISSORS: Final = {"condition_type": "contains", "value": "scissors"}

QUESTIONS: Final = (
    Question("How far back do you remember?", "data_time_range", {}, _time_range),
    Question(
        "Where was I 10 s ago?",
        "get_position_seconds_ago",
        {"seconds_ago": 10},
        _ago(ODOM, 10, _pose, "{place}, facing {facing}."),
    ),
    Question(
        "And how fast?",
        "get_velocity_seconds_ago",
        {"seconds_ago": 10},
        _ago(ODOM, 10, _twist, "{motion}."),
    ),
    Question(
        "What objects did you see at the front door?",
        "get_value_when",
        {"value_topic": SCENE_OBJECTS, "condition_topic": ODOM, **_near(robot.FRONT_DOOR)},
        _last(ODOM, _is_near(robot.FRONT_DOOR), _objects, "{objects}, {when}.", SCENE_OBJECTS),
    ),
    Question(
        "When was the path last clear?",
        "find_last_match",
        {"topic": PATH_CLEAR, "condition_type": "equals", "value": True},
        _last(PATH_CLEAR, robot.path_clear, lambda _: {"value": {"value": True}}, "{when}."),
    ),
    Question(
        "How far have I driven in the last minute?",
        "recent_trajectory_summary",
        {"seconds": LOOK_BACK_S},
        _driven(LOOK_BACK_S),
    ),
    Question(
        "When did you last see scissors?",
        "find_last_match",
        {"topic": "/vision/*/scene_objects", **_SCISSORS},
        _last(
            SCENE_OBJECTS,
            _sees("scissors"),
            lambda t: {"topic": SCENE_OBJECTS, **_objects(t)},
            "{when}; in view: {objects}.",
        ),
    ),
    Question(
        "And where were you then?",
        "get_value_when",
        {"value_topic": ODOM, "condition_topic": SCENE_OBJECTS, **_SCISSORS},
        _last(SCENE_OBJECTS, _sees("scissors"), _at_position, "{place}, {when}.", ODOM),
    ),
    Question(
        "When were you last at the kitchen counter?",
        "find_last_match",
        {"topic": ODOM, **_near(robot.KITCHEN_COUNTER)},
        _last(ODOM, _is_near(robot.KITCHEN_COUNTER), _at_position, "{when}."),
    ),
    Question(
        "Where in the flat was the camera 10 s ago?",
        "get_transform_seconds_ago",
        {"parent": "map", "child": "camera", "seconds_ago": 10},
        _camera_in_map(10),
    ),
    Question(
        "How full was the battery half a minute ago?",
        "get_topic_seconds_ago",
        {"topic": BATTERY, "seconds_ago": 30, "tolerance_s": 1.5, "fields": ["percentage"]},
        _ago(BATTERY, 30, lambda t: {"value": {"percentage": robot.battery(t)}}, "{charge}.", 1e-6),
    ),
    Question(
        "What did the camera's pictures show?",
        "get_topic_seconds_ago",
        {"topic": _CAMERA_TOPIC, "seconds_ago": 10},
        _nothing_on(_CAMERA_TOPIC),
    ),
)
