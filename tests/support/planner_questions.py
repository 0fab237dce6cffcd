"""What a planner asks about the demo's robot: in words, the calls that answer it, and the judge.

Each answer is a value that stands in a reply as it is, or the choice among a few; what a second
call is given was copied from the reply to the first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ros2_memory.demo import judges, published_topics, robot
from tests.support.planner_judges import (
    ASKED_AT_S,
    BATTERY,
    CLEAR,
    DOCK,
    OBJECTS,
    ODOM,
    SAID,
    SEEN,
    STARTED_S,
    Arguments,
    Judge,
    Replies,
    between_stops,
    came_into_view,
    charge_when_seen,
    commanded,
    counted,
    driven_between_stops,
    flips_of_path,
    how_often,
    in_map,
    last_stay,
    later,
    lowest_charge,
    nearest_wall,
    never,
    no_error,
    none_kept,
    only,
    pose_at,
    said_last,
    seen_there,
    sees,
    sighting_of,
    standing_since,
    stopped,
    trusted,
    visited,
    way_of_recap,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from ros2_memory.core.model import JsonValue
    from ros2_memory.demo.robot import Planar


@dataclass(frozen=True, slots=True)
class Step:
    """One call; `given` may be copied from the replies so far."""

    tool: str
    given: Arguments | Callable[[Replies], Arguments]

    def arguments(self, replies: Replies) -> Arguments:
        """What the tool is given."""
        return self.given(replies) if callable(self.given) else self.given


@dataclass(frozen=True, slots=True)
class Planned:
    """A question in words, the calls that a planner makes, and the judge of the replies."""

    words: str
    steps: tuple[Step, ...]
    judge: Judge


def _see(label: str, **more: JsonValue) -> Step:
    given: Arguments = {"topic": OBJECTS, "condition_type": "contains", "value": label, "limit": 1}
    return Step("find_matches", {**given, **more})


def _place(x: float, y: float, **more: JsonValue) -> Step:
    return Step("visits", {"x": x, "y": y, **more})


def _spot(place: Planar) -> JsonValue:
    there = judges.in_odom(place)
    return {"x": round(there.x, 2), "y": round(there.y, 2)}


_BLOCKED: Final[Arguments] = {
    "topic": published_topics.PATH_CLEAR,
    "condition_type": "equals",
    "value": False,
    "limit": 1,
}
_KITCHEN, _DOOR = robot.KITCHEN_COUNTER, robot.FRONT_DOOR
_THEN_S: Final = STARTED_S + 100.0


def _asked(words: str, tool: str, given: Arguments, judge: Judge) -> Planned:
    return Planned(words, (Step(tool, given),), judge)


QUESTIONS: Final = (
    _asked("How far back do you remember?", "data_time_range", {}, only(judges.time_range)),
    _asked("What do you remember at all?", "list_recorded_topics", {}, only(judges.topics)),
    _asked(
        "How many odometry messages do you have?",
        "list_recorded_topics",
        {"pattern": published_topics.ODOM},
        counted(published_topics.ODOM),
    ),
    _asked(
        "Where was I 10 s ago?",
        "get_position_seconds_ago",
        {"seconds_ago": 10},
        only(judges.position(10)),
    ),
    _asked(
        "Which way were you facing 40 s ago?",
        "get_position_seconds_ago",
        {"seconds_ago": 40},
        pose_at(ASKED_AT_S - 40),
    ),
    _asked(
        f"Where were you at {_THEN_S:.0f}?",
        "get_position_at",
        {"timestamp": _THEN_S},
        pose_at(_THEN_S),
    ),
    _asked(
        "How fast were you, and were you turning, half a minute ago?",
        "get_velocity_seconds_ago",
        {"seconds_ago": 30},
        only(judges.velocity(30)),
    ),
    _asked(
        "Where in the flat were you 25 s ago?",
        "get_transform_seconds_ago",
        {"parent": "map", "child": "base_link", "seconds_ago": 25},
        in_map(25),
    ),
    _asked(
        "Where in the flat was the camera 10 s ago?",
        "get_transform_seconds_ago",
        {"parent": "map", "child": "camera", "seconds_ago": 10},
        only(judges.camera_in_map(10)),
    ),
    _asked("Which frames do you know?", "list_frames", {}, only(judges.frames)),
    _asked(
        "How far have I driven in the last minute, and along which way?",
        "recent_trajectory_summary",
        {"seconds": 60},
        only(judges.driven(60)),
    ),
    _asked(
        "How fast were you at most in the last half minute, and how long did you stand?",
        "recap",
        {"last_s": 30},
        way_of_recap(30),
    ),
    _asked(
        "How far have you driven since you remember anything?",
        "recap",
        {"last_s": 86_400},
        way_of_recap(86_400),
    ),
    _asked(
        "Where did you stop in the last minute, when, and for how long?",
        "recap",
        {"last_s": 60},
        stopped(60),
    ),
    _asked("How long have you been standing here?", "recap", {"last_s": 30}, standing_since),
    _asked("What came into view in the last 40 s?", "recap", {"last_s": 40}, came_into_view(40)),
    _asked(
        "Did anything go wrong between these two times?",
        "recap",
        {"start": _THEN_S, "end": _THEN_S + 20},
        no_error,
    ),
    _asked(
        "When did the path become clear or blocked in the last minute?",
        "recap",
        {"last_s": 60},
        flips_of_path,
    ),
    Planned(
        "How far did you drive between your last two stops?",
        (Step("recap", {"last_s": 60}), Step("recap", between_stops)),
        driven_between_stops,
    ),
    _asked(
        "When did you last see scissors?",
        "find_last_match",
        {"topic": OBJECTS, "condition_type": "contains", "value": "scissors"},
        only(judges.last_seen("scissors")),
    ),
    Planned(
        "Where were you when you last saw the umbrella?",
        (_see("umbrella"),),
        sighting_of(SEEN, sees("umbrella")),
    ),
    Planned("Where is the cup?", (_see("cup"),), sighting_of(SEEN, sees("cup"), place="cup")),
    Planned(
        "How long was the television in view, the last time?",
        (_see("television"),),
        sighting_of(SEEN, sees("television")),
    ),
    Planned(
        "And when had you seen the scissors before the last time?",
        (_see("scissors", limit=2),),
        sighting_of(SEEN, sees("scissors"), nth=-2),
    ),
    Planned(
        "When did you see the fridge for the first time?",
        (_see("fridge", oldest_first=True),),
        sighting_of(SEEN, sees("fridge"), nth=0),
    ),
    Planned(
        "How often have you seen the sofa?",
        (_see("sofa", oldest_first=True),),
        how_often(SEEN, sees("sofa")),
    ),
    Planned(
        "Did you see the toy car or the plant last?",
        (_see("toy car"), _see("plant")),
        later("toy car", "plant"),
    ),
    Planned("Have you ever seen a dog?", (_see("dog"),), never),
    _asked(
        "What objects did you see at the front door?",
        "get_value_when",
        {
            "value_topic": published_topics.SCENE_OBJECTS,
            "condition_topic": published_topics.ODOM,
            "condition_type": "near_position",
            "value": _spot(_DOOR),
        },
        only(judges.seen_near(_DOOR)),
    ),
    _asked(
        "When was the path last clear?",
        "find_last_match",
        {"topic": published_topics.PATH_CLEAR, "condition_type": "equals", "value": True},
        only(judges.path_clear),
    ),
    _asked(
        "When was the path last blocked, where, and for how long?",
        "find_matches",
        _BLOCKED,
        sighting_of(CLEAR, lambda t: not robot.path_clear(t)),
    ),
    _asked(
        "How often was the path blocked in the last two minutes?",
        "find_matches",
        {**_BLOCKED, "seconds": 120, "oldest_first": True},
        how_often(CLEAR, lambda t: not robot.path_clear(t), last_s=120),
    ),
    _asked(
        "How full was the battery half a minute ago?",
        "get_topic_seconds_ago",
        {
            "topic": published_topics.BATTERY,
            "seconds_ago": 30,
            "tolerance_s": 1.5,
            "fields": ["percentage"],
        },
        only(judges.battery(30)),
    ),
    _asked(
        "How full was the battery when you last saw the table?",
        "get_value_when",
        {
            "value_topic": published_topics.BATTERY,
            "condition_topic": OBJECTS,
            "condition_type": "contains",
            "value": "table",
            "fields": ["percentage"],
        },
        charge_when_seen("table"),
    ),
    _asked(
        "When did the battery last fall below 85 %, and where?",
        "find_matches",
        {
            "topic": published_topics.BATTERY,
            "condition_type": "below",
            "value": 0.85,
            "field": "percentage",
            "limit": 1,
        },
        sighting_of(BATTERY, lambda t: robot.battery(t) < 0.85),
    ),
    _asked(
        "When did you last drive faster than 1 m/s?",
        "find_matches",
        {
            "topic": published_topics.ODOM,
            "condition_type": "above",
            "value": 1.0,
            "field": "linear_velocity.x",
            "limit": 1,
        },
        sighting_of(ODOM, lambda t: robot.twist(t)[0] > 1.0),
    ),
    _asked(
        "How low was the battery in the last minute, and when?",
        "get_topic_in_last",
        {
            "topic": published_topics.BATTERY,
            "seconds": 60,
            "max_samples": 1,
            "fields": ["percentage"],
        },
        lowest_charge(60),
    ),
    _asked(
        "How near was the nearest wall in the last 20 s?",
        "get_topic_in_last",
        {"topic": published_topics.SCAN, "seconds": 20, "max_samples": 1, "fields": ["ranges"]},
        nearest_wall(20),
    ),
    Planned(
        "When were you last at the kitchen counter, how often, and for how long?",
        (_place(_KITCHEN.x, _KITCHEN.y),),
        visited(_KITCHEN),
    ),
    Planned("Are you on the dock, and since when?", (_place(DOCK.x, DOCK.y),), visited(DOCK)),
    Planned(
        "What did you see while you were last at the kitchen counter?",
        (_place(_KITCHEN.x, _KITCHEN.y), Step("recap", last_stay)),
        seen_there(_KITCHEN),
    ),
    Planned("Have you been in that corner, at 0.5, 3.5?", (_place(0.5, 3.5),), never),
    _asked(
        "When were you last in the kitchen, and for how long?",
        "find_matches",
        {
            "topic": published_topics.SCENE_DESCRIPTION,
            "condition_type": "contains",
            "value": "in the kitchen",
            "limit": 1,
        },
        sighting_of(SAID, lambda t: robot.place(t) == "kitchen"),
    ),
    _asked(
        "What did you last say you saw?",
        "get_topic_in_last",
        {"topic": published_topics.SCENE_DESCRIPTION, "seconds": 20, "max_samples": 1},
        said_last,
    ),
    _asked(
        "What were you told to do 20 s ago?",
        "get_topic_seconds_ago",
        {"topic": published_topics.CMD_VEL, "seconds_ago": 20},
        commanded(20),
    ),
    _asked("Can I trust what you remember just now?", "memory_status", {}, trusted),
    _asked("Which moments were you told to keep?", "memory_status", {}, none_kept),
    _asked(
        "What did the camera's pictures show?",
        "get_topic_seconds_ago",
        {"topic": "/camera/image_raw", "seconds_ago": 10},
        only(judges.nothing_on("/camera/image_raw")),
    ),
)
