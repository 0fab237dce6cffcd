"""Questions with every tool about one robot, to ask its bags and a lake alike."""

from collections.abc import Iterator, Sequence
from random import Random

Question = tuple[str, dict[str, object]]


def every_question(
    topics: Sequence[str], start_s: float, end_s: float, label: str, seen: str
) -> Iterator[Question]:
    """Yields questions about a time with data, some of them at moments that are drawn.

    `label` is what detectors of the topics `seen`, a name or glob, may have seen.
    """
    draw = Random(f"{start_s}")
    whole: dict[str, object] = {"start": start_s, "end": end_s}
    middle = (start_s + end_s) / 2
    cut: dict[str, object] = {"start": middle - 13.3, "end": middle + 9.7}
    spot: dict[str, object] = {"where": {"x": 2.0, "y": 3.0, "radius_m": 1.5}}
    match: dict[str, object] = {"topic": seen, "condition_type": "contains", "value": label}
    for topic in topics:
        at = {"topic": topic, "timestamp": draw.uniform(start_s, end_s), "tolerance_s": 5}
        yield "get_topic_at_time", at
        yield "get_topic_seconds_ago", {"topic": topic, "seconds_ago": 540, "tolerance_s": 60}
        yield "get_topic_in_range", {"topic": topic, **cut, "max_samples": 4}
        yield "get_topic_in_range", {"topic": topic, **whole, "by": "minute"}
        yield "get_topic_in_last", {"topic": topic, "seconds": 590, "max_samples": 3}
    for each in (start_s + 1, middle, draw.uniform(start_s, end_s)):
        yield "get_position_at", {"timestamp": each}
        yield "get_position_at", {"timestamp": each, "frame_id": "odom"}
        yield "get_velocity_at", {"timestamp": each}
        yield "get_transform_at", {"parent": "map", "child": "base_link", "timestamp": each}
        yield "recap", {"around": each}
    ago: dict[str, object] = {"seconds_ago": 550, "tolerance_s": 60}
    yield "get_position_seconds_ago", ago
    yield "get_velocity_seconds_ago", ago
    yield "get_transform_seconds_ago", {"parent": "map", "child": "odom", "seconds_ago": 550}
    for window in (whole, cut):
        yield "recap", window
        yield "find_things", window
        yield "trajectory_summary", window
        yield "trajectory_summary", {**window, **spot, "max_waypoints": 0}
        yield "visits", {**spot, **window}
        for more in ({}, spot, {"oldest_first": True}, {"by": "hour"}, {"limit": 2}):
            yield "find_matches", {**match, **window, **more}
    yield "trajectory_summary", {**whole, "by": "hour"}
    yield "recent_trajectory_summary", {"seconds": 560}
    yield "compare", {**cut, "with_start": start_s, "with_end": middle}
    yield "find_last_match", match
    yield "find_last_match", {**match, "before": middle}
    yield "find_last_match", {**match, "value": "elephant"}
    yield (
        "get_value_when",
        {
            "value_topic": "/odom",
            "condition_topic": seen,
            "condition_type": "contains",
            "value": label,
        },
    )
    yield "find_things", {"label": label, "limit": 3}
    yield "visits", spot
    yield "visits", {**spot, "by": "hour"}
    for tool in ("list_recorded_topics", "data_time_range", "list_frames"):
        yield tool, {}
