"""The specification's 17 tools: their names, what planners read, and the query of each.

A pair of tools (`_at` and `_seconds_ago`, `_in_range` and `_in_last`) is declared once; only the
`ToolName`s differ. The order of the declarations is the order in which clients see the tools.
"""

from __future__ import annotations

from ros2_memory import queries
from ros2_memory.counts.numbers import count_range
from ros2_memory.counts.robot import count_path
from ros2_memory.insights.episodes import topic_changes
from ros2_memory.places.driven_inside import driven_inside
from ros2_memory.tools.arguments import (
    Ago,
    At,
    Between,
    Last,
    LastMatchArguments,
    MotionArguments,
    NoArguments,
    PositionArguments,
    RecordedTimesArguments,
    TopicAtArguments,
    TopicListArguments,
    TopicRangeArguments,
    TrajectoryArguments,
    TransformArguments,
    ValueWhenArguments,
    Window,
)
from ros2_memory.tools.declaration import ToolDeclaration, ToolName


def _at_and_ago(name: str, title: str, at: str = "at") -> tuple[ToolName, ...]:
    return (
        ToolName(f"get_{name}_{at}", f"{title} at a time", At),
        ToolName(f"get_{name}_seconds_ago", f"{title} some seconds ago", Ago),
    )


DECLARATIONS = (
    ToolDeclaration(
        (ToolName("list_recorded_topics", "Recorded topics"),),
        "Lists every recorded topic. Call it first if unsure of a name. "
        "Reply: [{{topic, type, first_ts, last_ts, count}}], times in Unix s; of too many "
        "the busiest.",
        TopicListArguments,
        queries.list_recorded_topics,
    ),
    ToolDeclaration(
        (ToolName("data_time_range", "Recorded times", Window),),
        "The recorded range; gaps, silences and steps of the clock, of all or a window. "
        "Reply: {{earliest, latest, now, gaps, ...}} or null.",
        RecordedTimesArguments,
        queries.data_time_range,
    ),
    ToolDeclaration(
        _at_and_ago("topic", "Topic", at="at_time"),
        "A topic's value {when}: its newest message at or before then, at most tolerance_s old "
        "(default {tolerance}, too little for slow topics; latched: any age). "
        "Reply: {{topic, type, timestamp, value}}.",
        TopicAtArguments,
        queries.topic_value,
    ),
    ToolDeclaration(
        (
            ToolName("get_topic_in_range", "Topic over a window", Between),
            ToolName("get_topic_in_last", "Topic over the last seconds", Last),
        ),
        "A topic's messages {when}: all, or max_samples, evenly spaced; "
        "start and end alike: that minute. changes: what "
        "held, [{{start, seconds, value}}]. Reply: {{topic, type, total, samples: [{{timestamp, "
        "value}}]}}; "
        "with fields {{..., fields, rows: [[timestamp, ...]], extremes: {{field: {{min, min_at, "
        "max, max_at}}}} of all messages}}.",
        TopicRangeArguments,
        queries.topic_range,
        instead={"by": count_range, "changes": topic_changes},
    ),
    ToolDeclaration(
        _at_and_ago("position", "Position"),
        "Where the robot was {when}, from {pose_topic}. Reply: {{x, y, z (m), yaw_deg "
        "(counter-clockwise from x), timestamp, topic, frame_id, in, also_in (room)}}; "
        "NavSatFix: latitude, longitude, altitude; x, y, z null.",
        PositionArguments,
        queries.position,
    ),
    ToolDeclaration(
        _at_and_ago("velocity", "Velocity"),
        "How fast the robot moved {when}, from {pose_topic}. Reply: {{linear: {{x, y, z}} (m/s), "
        "angular: {{x, y, z}} (rad/s), timestamp, topic, frame_id}}. In the robot's own frame "
        "x is forward, positive angular z turns left.",
        MotionArguments,
        queries.velocity,
    ),
    ToolDeclaration(
        _at_and_ago("transform", "Transform"),
        "The pose of frame child in frame parent {when}, through any chain of frames, "
        "interpolated. Reply: {{translation (m), rotation (quaternion), yaw_deg, timestamp, "
        "parent, child, clock}}.",
        TransformArguments,
        queries.transform,
    ),
    ToolDeclaration(
        (ToolName("list_frames", "Frames"),),
        "Every recorded coordinate frame. Reply: {{frames, transforms: [{{parent, child, "
        "static}}]}}.",
        NoArguments,
        queries.frames,
        blocking=True,
    ),
    ToolDeclaration(
        (ToolName("find_last_match", "Last match"),),
        "When a condition was last true, in any closed bag. Reply: {{timestamp, value, topic, "
        "type, frame_id, age_s}}, or null if never ({{timestamp: null, value: null, notes}} if a "
        "bag was unread or recording broke off).",
        LastMatchArguments,
        queries.find_last_match,
        blocking=True,
        shows_example=True,
    ),
    ToolDeclaration(
        (ToolName("get_value_when", "Topic when another matched"),),
        "The value of value_topic when condition_topic last met a condition, "
        "e.g. where the robot last saw scissors. Reply: {{timestamp, matched, value, "
        "value_timestamp, condition_topic, value_topic, frame_id}}, or null as find_last_match.",
        ValueWhenArguments,
        queries.value_when,
        blocking=True,
    ),
    ToolDeclaration(
        (
            ToolName("trajectory_summary", "Driven path", Between, drawn=True),
            ToolName("recent_trajectory_summary", "Recent path", Last),
        ),
        "How far and where the robot drove {when}, from {pose_topic}. Reply: {{distance_m, "
        "avg_speed, max_speed (m/s), duration_s, waypoints: [{{timestamp, x, y, z, yaw_deg}}], "
        "...}}; with where: only the path inside it, and visits.",
        TrajectoryArguments,
        queries.trajectory_summary,
        blocking=True,
        instead={"by": count_path, "where": driven_inside, "during": driven_inside},
    ),
)
