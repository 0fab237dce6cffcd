"""The questions of the demo: in words, as a tool call, and with the judge of the answer.

A judge checks that the reply's time is one that was asked for, and compares the reply with the
robot's closed form at that time. It returns the answer as a sentence, or raises `WrongAnswerError`.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, TypeAlias

from ros2_memory.core.timebase import NS_PER_S, Ns, ns_from_unix, unix_from_ns
from ros2_memory.demo import robot
from ros2_memory.demo.messages import BATTERY, ODOM, PATH_CLEAR, SCENE_OBJECTS, STREAMS
from ros2_memory.demo.robot import Planar, room_at

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.reply import JsonObject

NEAR_M: Final = 0.5
"""The radius of a place: the server's default `data.position_tolerance_m`."""
_ROUNDED: Final = 1e-3
"""How much (m, m/s) a right number may be off: its rounding, with some room."""
_LATE_S: Final = 1.5
"""How much older a message may be than the asked time: the battery reports once a second."""
LOOK_BACK_S: Final = 60
"""The longest window that a question is about."""
_AGO_S: Final = 10
_CAMERA_TOPIC: Final = "/camera/image_raw"
_PERIODS: Final = {stream.topic: stream.period for stream in STREAMS}


class WrongAnswerError(Exception):
    """The answer is wrong; the text has the expected one."""


@dataclass(frozen=True, slots=True)
class CallContext:
    """When the robot started (`t0`), and the wall clock before and after a call."""

    t0: Ns
    before: Ns
    after: Ns

    def robot_time(self, moment_s: float, topic: str) -> float:
        """Returns the robot's time (s) that a message describes, by its log time (Unix s)."""
        period = _PERIODS[topic]
        return (ns_from_unix(moment_s) - self.t0) // period * period / NS_PER_S

    def age_s(self, moment_s: float) -> float:
        """Returns the age of a time (Unix s) when the answer came."""
        return unix_from_ns(self.after) - moment_s

    def require_ago(self, moment_s: float, seconds: float) -> None:
        """Checks that a time (Unix s) lies `seconds` before the call.

        Raises:
            WrongAnswerError: it does not.
        """
        first_s, last_s = (unix_from_ns(at) - seconds for at in (self.before, self.after))
        if not first_s - _LATE_S <= moment_s <= last_s + _ROUNDED:
            raise WrongAnswerError(f"expected a time {seconds:g} s ago, not {moment_s:.6f}")


Judge: TypeAlias = "Callable[[JsonValue, CallContext], str]"
Expected: TypeAlias = "Callable[[float], JsonObject]"
"""Returns the right reply at a time t of the robot (s)."""


@dataclass(frozen=True, slots=True)
class Question:
    """One question; its judge takes the reply and the context of the call."""

    words: str
    tool: str
    arguments: Mapping[str, JsonValue]
    judge: Judge


@dataclass(frozen=True, slots=True)
class Exchange:
    """A question and its reply; `sentence` is the answer if it is right, else what was expected."""

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
        return Exchange(question, reply, question.judge(json.loads(reply), call), right=True)
    except (ValueError, WrongAnswerError) as error:
        return Exchange(question, reply, str(error), right=False)


def _number(reply: JsonValue, key: str) -> float:
    """Returns the number at a key of a reply.

    Raises:
        WrongAnswerError: there is no number.
    """
    number = reply.get(key) if isinstance(reply, dict) else None
    if not isinstance(number, int | float):
        raise WrongAnswerError(f"expected a number at {key}, not {number}")
    return number


def _require(
    reply: JsonValue,
    expected: Mapping[str, JsonValue],
    *,
    off: float = _ROUNDED,
    off_deg: float = 0.05,
) -> None:
    """Checks that a reply has the expected keys and values; it may have more keys.

    A number may differ by `off`, an angle (a key in `_deg`) by `off_deg` and by whole turns.

    Raises:
        WrongAnswerError: it has another value.
    """
    for key, right in expected.items():
        got = reply.get(key) if isinstance(reply, dict) else None
        if isinstance(right, dict):
            _require(got, right, off=off, off_deg=off_deg)
        elif isinstance(right, list) and isinstance(got, list) and len(got) == len(right):
            for item, right_item in zip(got, right, strict=True):
                _require({key: item}, {key: right_item}, off=off, off_deg=off_deg)
        elif isinstance(right, float):
            difference, tolerance = _number(reply, key) - right, off
            if key.endswith("_deg"):
                difference, tolerance = (difference + 180.0) % 360.0 - 180.0, off_deg
            if not abs(difference) <= tolerance:  # NaN is wrong, too
                raise WrongAnswerError(f"expected {key} {right:.4f}, not {got}")
        elif got != right:
            raise WrongAnswerError(f"expected {key} {right}, not {got}")


def _judge_time_range(reply: JsonValue, call: CallContext) -> str:
    """Judges the range of the data: all that was recorded, without gaps or damage."""
    earliest, latest = _number(reply, "earliest"), _number(reply, "latest")
    _require(reply, {fault: [] for fault in ("gaps", "damaged", "incomplete", "unread")})
    return (
        f"{latest - earliest:.0f} s, in {_number(reply, 'bags'):.0f} closed bag files, up to "
        f"{call.age_s(latest):.1f} s ago. What is being written joins them as its file closes."
    )


def _message_judge(
    topic: str,
    expected: Expected,
    sentence: str,
    *,
    ago: float | None = None,
    holds: Callable[[float], bool] = lambda _: True,
    value_topic: str | None = None,
    off: float = _ROUNDED,
) -> Judge:
    """Returns a judge of a reply about one message.

    Args:
        topic: of the message.
        expected: the right reply at a time of the robot.
        sentence: the answer, with the fields of `_sentence`.
        ago: how many seconds before the call the message must be, if that was asked.
        holds: whether the asked condition holds at a time of the robot.
        value_topic: the topic whose value was asked for, if it is another one.
        off: how much a number may be off.
    """

    def judge(reply: JsonValue, call: CallContext) -> str:
        moment_s = _number(reply, "timestamp")
        if ago is not None:
            call.require_ago(moment_s, ago)
        t = call.robot_time(moment_s, topic)
        if not holds(t):
            raise WrongAnswerError(f"expected a time at which it was so, not {moment_s:.6f}")
        if value_topic is not None:
            t = call.robot_time(_number(reply, "value_timestamp"), value_topic)
        _require(reply, expected(t), off=off)
        return _sentence(sentence, t, moment_s, call)

    return judge


def _sentence(template: str, t: float, moment_s: float, call: CallContext) -> str:
    """Fills a template with what the robot does and sees at its time t, and when (Unix s)."""
    local = datetime.fromtimestamp(moment_s, tz=UTC).astimezone()
    x, y, yaw = robot.pose(t)
    forward, turning = robot.twist(t)
    way, rate = "backwards" if forward < 0 else "forwards", math.degrees(turning)
    turn = "straight on"
    if abs(rate) >= 1:
        turn = f"turning {'left' if rate > 0 else 'right'} at {abs(rate):.0f} degrees/s"
    text = template.format(
        when=f"at {local:%H:%M:%S}, {call.age_s(moment_s):.1f} s ago",
        place=f"in the {robot.place(t)}, at x {_metres(x)}, y {_metres(y)} in odom",
        facing=f"{math.degrees(yaw):.0f} degrees",
        motion=f"{abs(forward):.2f} m/s {way}, {turn}",
        charge=f"{robot.battery(t):.1%}",
        objects=", ".join(thing.label for thing in robot.seen(t)) or "nothing",
    )
    return text[0].upper() + text[1:]


def _metres(value: float) -> str:
    return f"{round(value, 2) + 0.0:.2f} m"  # adding 0.0 turns -0.0 into 0.0


def _position(t: float) -> JsonObject:
    x, y, _ = robot.pose(t)
    return {"x": x, "y": y, "z": 0.0}


def _at_position(t: float) -> JsonObject:
    return {"value": {"position": _position(t)}}


def _pose(t: float) -> JsonObject:
    yaw = math.degrees(robot.pose(t).yaw)
    return {"frame_id": "odom", **_position(t), "yaw_deg": yaw}


def _twist(t: float) -> JsonObject:
    forward, turning = robot.twist(t)
    return {"linear": {"x": forward}, "angular": {"z": turning}}


def _objects(t: float) -> JsonObject:
    return {"value": {"detections": [{"label": thing.label} for thing in robot.seen(t)]}}


def _judge_distance(reply: JsonValue, call: CallContext) -> str:
    """Judges the distance driven in the last `LOOK_BACK_S`, so far as files are closed."""
    start_s, end_s = _number(reply, "start"), _number(reply, "end")
    call.require_ago(start_s - _LATE_S, LOOK_BACK_S)
    before, after = (robot.driven(call.robot_time(at, ODOM)) for at in (start_s, end_s))
    metres = after - before
    _require(reply, {"distance_m": metres}, off=0.01 * (1 + metres))
    return (
        f"{metres:.2f} m, at up to {_number(reply, 'max_speed'):.2f} m/s, in the "
        f"{end_s - start_s:.1f} s of it that are in closed files."
    )


def _judge_camera(reply: JsonValue, call: CallContext) -> str:
    """Judges the pose of the camera in `map` `_AGO_S` ago, through four frames."""
    moment_s = _number(reply, "timestamp")
    call.require_ago(moment_s, _AGO_S)
    t = (ns_from_unix(moment_s) - call.t0) / NS_PER_S
    ahead, aside, height = robot.CAMERA
    x, y, yaw = robot.pose_in_map(t).then(Planar(ahead, aside, 0.0))
    position: JsonValue = {"x": x, "y": y, "z": height}
    expected = {"translation": position, "yaw_deg": math.degrees(yaw)}
    _require(reply, expected, off=5e-3, off_deg=0.2)  # between two transforms
    return (
        f"In the {room_at(x)}, {x:.2f} m east and {y:.2f} m north of the flat's corner, "
        f"{height:.2f} m high."
    )


def _judge_pictures(reply: JsonValue, _call: CallContext) -> str:
    """Judges the reply that a topic was never recorded, which is an answer, too."""
    _require(reply, {"error": "no_data", "reason": "topic_not_recorded"})
    return f"{_CAMERA_TOPIC} was never recorded, and the answer says so."


def _is_near(place: Planar) -> Callable[[float], bool]:
    """Returns a function that tells whether the robot is within `NEAR_M` of a place of the flat."""
    centre = _in_odom(place)

    def holds(t: float) -> bool:
        pose = robot.pose(t)
        return math.hypot(pose.x - centre.x, pose.y - centre.y) <= NEAR_M

    return holds


def _sees_scissors(t: float) -> bool:
    return any(thing.label == "scissors" for thing in robot.seen(t))


def _in_odom(place: Planar) -> Planar:
    """Returns a place of the flat in `odom`, the frame of the robot's poses."""
    return robot.MAP_TO_ODOM.inverse().then(place)


def _near_condition(place: Planar) -> Mapping[str, JsonValue]:
    """Returns the arguments of a tool for the condition that the robot is at a place."""
    x, y, _ = _in_odom(place)
    return {"condition_type": "near_position", "value": {"x": round(x, 3), "y": round(y, 3)}}


_SCISSORS: Final = {"condition_type": "contains", "value": "scissors"}

QUESTIONS: Final = (
    Question("How far back do you remember?", "data_time_range", {}, _judge_time_range),
    Question(
        "Where was I 10 s ago?",
        "get_position_seconds_ago",
        {"seconds_ago": _AGO_S},
        _message_judge(ODOM, _pose, "{place}, facing {facing}.", ago=_AGO_S),
    ),
    Question(
        "And how fast?",
        "get_velocity_seconds_ago",
        {"seconds_ago": _AGO_S},
        _message_judge(ODOM, _twist, "{motion}.", ago=_AGO_S),
    ),
    Question(
        "What objects did you see at the front door?",
        "get_value_when",
        {
            "value_topic": SCENE_OBJECTS,
            "condition_topic": ODOM,
            **_near_condition(robot.FRONT_DOOR),
        },
        _message_judge(
            ODOM,
            _objects,
            "{objects}, {when}.",
            holds=_is_near(robot.FRONT_DOOR),
            value_topic=SCENE_OBJECTS,
        ),
    ),
    Question(
        "When was the path last clear?",
        "find_last_match",
        {"topic": PATH_CLEAR, "condition_type": "equals", "value": True},
        _message_judge(
            PATH_CLEAR, lambda _: {"value": {"value": True}}, "{when}.", holds=robot.path_clear
        ),
    ),
    Question(
        "How far have I driven in the last minute?",
        "recent_trajectory_summary",
        {"seconds": LOOK_BACK_S},
        _judge_distance,
    ),
    Question(
        "When did you last see scissors?",
        "find_last_match",
        {"topic": "/vision/*/scene_objects", **_SCISSORS},
        _message_judge(
            SCENE_OBJECTS,
            lambda t: {"topic": SCENE_OBJECTS, **_objects(t)},
            "{when}; in view: {objects}.",
            holds=_sees_scissors,
        ),
    ),
    Question(
        "And where were you then?",
        "get_value_when",
        {"value_topic": ODOM, "condition_topic": SCENE_OBJECTS, **_SCISSORS},
        _message_judge(
            SCENE_OBJECTS,
            _at_position,
            "{place}, {when}.",
            holds=_sees_scissors,
            value_topic=ODOM,
        ),
    ),
    Question(
        "When were you last at the kitchen counter?",
        "find_last_match",
        {"topic": ODOM, **_near_condition(robot.KITCHEN_COUNTER)},
        _message_judge(ODOM, _at_position, "{when}.", holds=_is_near(robot.KITCHEN_COUNTER)),
    ),
    Question(
        "Where in the flat was the camera 10 s ago?",
        "get_transform_seconds_ago",
        {"parent": "map", "child": "camera", "seconds_ago": _AGO_S},
        _judge_camera,
    ),
    Question(
        "How full was the battery half a minute ago?",
        "get_topic_seconds_ago",
        {"topic": BATTERY, "seconds_ago": 30, "tolerance_s": 1.5, "fields": ["percentage"]},
        _message_judge(
            BATTERY,
            lambda t: {"value": {"percentage": robot.battery(t)}},
            "{charge}.",
            ago=30,
            off=1e-6,
        ),
    ),
    Question(
        "What did the camera's pictures show?",
        "get_topic_seconds_ago",
        {"topic": _CAMERA_TOPIC, "seconds_ago": _AGO_S},
        _judge_pictures,
    ),
)
