"""The questions of the demo: in words, as a tool call, and with the judge of the answer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ros2_memory.demo import judges, published_topics, robot
from ros2_memory.demo.judges import CallContext, Judge, WrongAnswerError, parsed

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ros2_memory.core.model import JsonValue
    from ros2_memory.demo.robot import Planar

LOOK_BACK_S: Final = 60
"""The longest window that a question is about."""


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
        return Exchange(question, reply, question.judge(parsed(reply), call), right=True)
    except WrongAnswerError as error:
        return Exchange(question, reply, str(error), right=False)


def _spot(place: Planar) -> JsonValue:
    pose = judges.in_odom(place)
    return {"x": round(pose.x, 3), "y": round(pose.y, 3)}


_CAMERA_TOPIC: Final = "/camera/image_raw"

QUESTIONS: Final = (
    Question("How far back do you remember?", "data_time_range", {}, judges.time_range),
    Question("What do you remember?", "list_recorded_topics", {}, judges.topics),
    Question(
        "Where was I 10 s ago?",
        "get_position_seconds_ago",
        {"seconds_ago": 10},
        judges.position(10),
    ),
    Question("And how fast?", "get_velocity_seconds_ago", {"seconds_ago": 10}, judges.velocity(10)),
    Question(
        "What objects did you see at the front door?",
        "get_value_when",
        {
            "value_topic": published_topics.SCENE_OBJECTS,
            "condition_topic": published_topics.ODOM,
            "condition_type": "near_position",
            "value": _spot(robot.FRONT_DOOR),
        },
        judges.seen_near(robot.FRONT_DOOR),
    ),
    Question(
        "When was the path last clear?",
        "find_last_match",
        {"topic": published_topics.PATH_CLEAR, "condition_type": "equals", "value": True},
        judges.path_clear,
    ),
    Question(
        "How far have I driven in the last minute?",
        "recent_trajectory_summary",
        {"seconds": LOOK_BACK_S},
        judges.driven(LOOK_BACK_S),
    ),
    Question(
        "When did you last see scissors?",
        "find_last_match",
        {"topic": "/vision/*/scene_objects", "condition_type": "contains", "value": "scissors"},
        judges.last_seen("scissors"),
    ),
    Question(
        "And where were you then?",
        "get_value_when",
        {
            "value_topic": published_topics.ODOM,
            "condition_topic": published_topics.SCENE_OBJECTS,
            "condition_type": "contains",
            "value": "scissors",
        },
        judges.where_seen("scissors"),
    ),
    Question(
        "When were you last at the kitchen counter?",
        "find_last_match",
        {
            "topic": published_topics.ODOM,
            "condition_type": "near_position",
            "value": _spot(robot.KITCHEN_COUNTER),
        },
        judges.last_near(robot.KITCHEN_COUNTER),
    ),
    Question(
        "Where in the flat was the camera 10 s ago?",
        "get_transform_seconds_ago",
        {"parent": "map", "child": "camera", "seconds_ago": 10},
        judges.camera_in_map(10),
    ),
    Question("Which frames do you know?", "list_frames", {}, judges.frames),
    Question(
        "How full was the battery half a minute ago?",
        "get_topic_seconds_ago",
        {
            "topic": published_topics.BATTERY,
            "seconds_ago": 30,
            "tolerance_s": 1.5,
            "fields": ["percentage"],
        },
        judges.battery(30),
    ),
    Question(
        "What did you say you saw in the last 20 s?",
        "get_topic_in_last",
        {"topic": published_topics.SCENE_DESCRIPTION, "seconds": 20, "max_samples": 4},
        judges.descriptions(20, 4),
    ),
    Question(
        "What did the camera's pictures show?",
        "get_topic_seconds_ago",
        {"topic": _CAMERA_TOPIC, "seconds_ago": 10},
        judges.nothing_on(_CAMERA_TOPIC),
    ),
)
