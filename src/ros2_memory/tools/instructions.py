"""The instructions that a planner receives before it calls any tool, and the prompt."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from ros2_memory.history.context import QuerySettings

_RULES: Final = """\
What a robot saw and did in the past, from its recordings. For what it sees right now, ask \
elsewhere: {newest} answer not_closed_yet.
1. Times are Unix seconds{or_text}. For "10 s ago" or "in the last minute" {relative} need no \
clock. Times of replies can be passed on as they are; timestamps asks about several at once: \
{{results: [...]}}.
2. Use topic names as list_recorded_topics spells them; only find_* and get_value_when take globs \
(/vision/*/scene_objects). "At" a time means the newest message at or before it, at most \
tolerance_s old ({tolerance} s by default: give 2 for a topic that speaks once a second).
3. Having nothing is an answer, no failure: {{"error": "no_data", "reason", "detail"}}. The detail \
says what there is and what to ask instead; do not repeat the same call.
4. Conditions: contains (part of a text anywhere in the message, or an element of the list that \
field names), equals (boolean, number, whole text; 1 is true), above, below (number; field says \
which), near_position ({{"x": m, "y": m}}, within {near} m in the frame of the topic). Case is of \
no matter; detections that score below min_score do not count.
"""
_SEEN: Final = """\
- "When did you last see X, and where?": find_last_match with contains on the vision topics, then \
get_position_at with the timestamp it gives.
"""
_HAPPENED: Final = """\
- "Where is X, how many?": find_things. "When did you see X?": find_matches, with oldest_first for \
the first time. "What happened?": recap; "why then?": with around. "What changed?": compare. "Have \
you been here?": visits. "How low was it?": get_topic_in_last with fields and max_samples 1. \
"Usually? Each day or room?": by. "Can I trust this?": memory_status.
- where: a place's name, {{x, y, radius_m}} or {{"x": [from, to], "y": [from, to]}}.
"""
_REST: Final = """\
- Positions are metres, yaw_deg is counter-clockwise from x, in frame_id ({pose_topic}: usually \
where the robot was switched on, not a map). get_transform_* relates frames.
- notes say what was thinned, skipped or estimated: pass on what matters. Narrow large values with \
fields. Ask tools marked Blocking one at a time.
"""


def instructions(settings: QuerySettings, *, additions: bool = True) -> str:
    """Returns the rules that prevent most wrong calls, with this deployment's defaults.

    Clients cut instructions at about 2,000 characters; these are shorter. `additions`: whether the
    tools beyond the specification are offered.
    """
    return (_RULES + (_HAPPENED if additions else _SEEN) + _REST).format(
        or_text=" or ISO 8601 (2026-11-20T14:05; local without offset)" if additions else "",
        newest="the newest 3 s or so are not on disk yet and"
        if settings.include_active
        else f"the newest {settings.split_duration_s:g} s or so are still being written and",
        relative="*_seconds_ago, *_last, recent_* and last_s"
        if additions
        else "*_seconds_ago, *_last and recent_*",
        near=f"{settings.position_tolerance_m:g}",
        pose_topic=settings.pose_topic,
        tolerance=f"{settings.time_tolerance_s:g}",
    )


_ANSWERS: Final = """\
Which question answers what, in one call each:
- Where was I 10 s ago, at a time: get_position_seconds_ago, get_position_at. How fast: \
get_velocity_*. Another frame, such as the camera in the map: get_transform_*.
- Where is X, since when, where was it before, is it still there, how many are there, what is in a \
place: find_things.
- What changed since yesterday, what differs between two runs: compare.
- When did you last see X, where were you, where was it, since when: find_matches with contains \
on the vision topics. When first, how often: with oldest_first and limit 1. When was a number \
beyond a limit: above or below, with field.
- What happened in the last minutes, how far did I drive, where did I stop, was there an error: \
recap with last_s, or between start and end. Why then: recap with around. The shape of the way: \
recent_trajectory_summary.
- Have I been here, when was I at a place, for how long, how near: visits, with the frame_id \
that x and y are of.
- What did a topic say: get_topic_seconds_ago, get_topic_in_last. How low or high was a \
number: the extremes there, with fields and max_samples 1. What did it say when something \
else held: get_value_when.
- When do you usually, how often, how far, how low on each day, weekday or hour, or in each named \
place: by, of find_matches, visits, trajectory_summary and get_topic_in_range.
- What do you remember at all, and how well: data_time_range, memory_status, list_recorded_topics.
"""
_SPEC_ANSWERS: Final = """\
Which question answers what:
- Where was I 10 s ago, at a time: get_position_seconds_ago, get_position_at. How fast: \
get_velocity_*. Another frame, such as the camera in the map: get_transform_*.
- When did you last see X, where were you: find_last_match with contains on the vision topics, \
then get_position_at with the timestamp it gives. What did a topic say when something else held: \
get_value_when.
- How far and where did I drive: recent_trajectory_summary, trajectory_summary.
- What did a topic say: get_topic_seconds_ago, get_topic_in_last. How low or high was a number: \
the extremes there, with fields and max_samples 1.
- What do you remember at all: data_time_range, list_recorded_topics.
"""
_AS_THEY_STAND: Final = """\
Answer with the figures of the reply as they stand: ages, durations and distances are in it.
"""


def prompt(*, additions: bool = True) -> str:
    """Returns the text that the prompt appends to the instructions; `additions`: as there."""
    return (_ANSWERS if additions else _SPEC_ANSWERS) + _AS_THEY_STAND
