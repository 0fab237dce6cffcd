"""What the server tells a planner before it calls any tool."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from ros2_memory.memory import Limits

_TEXT: Final = """\
What a robot saw and did in the past, from its recordings. For what it sees right now, ask \
elsewhere: the newest {split} s or so are still being written and answer not_closed_yet.
- Times are Unix seconds; data_time_range tells the span recorded and what time it is. For "10 s \
ago" or "in the last minute" take the tools named _seconds_ago, _in_last or recent_: they need no \
clock. A timestamp from a reply can be passed to any other tool.
- Use topic names as list_recorded_topics spells them. Only find_last_match and get_value_when \
take globs (/vision/*/scene_objects).
- "At" a time means the newest message at or before it, at most tolerance_s old ({tolerance} s by \
default). Most topics are slower: the detail of no_data says which tolerance_s finds the message.
- "When did you last see X?": find_last_match with contains on the vision topics. "Where were you \
then?": get_position_at with the timestamp it gives.
- Positions are metres, yaw_deg is counter-clockwise from x, both in frame_id (for {pose_topic} \
usually where the robot was switched on, not a map). get_transform_* relates any two frames.
- Having nothing is an answer, no failure: {{"error": "no_data", "reason", "detail"}}. The detail \
says what there is and what to ask instead; do not repeat the same call. invalid_arguments names \
the argument and what it takes.
- notes in a reply say what was thinned, skipped or estimated: pass on what matters. Narrow large \
values with fields, or ask for a shorter window.
- Tools marked Blocking search long stretches of history: ask one at a time.
"""


def instructions(limits: Limits) -> str:
    """The rules whose neglect makes most wrong calls, with this deployment's defaults.

    Clients cut instructions at about 2,000 characters; these stay below.
    """
    return _TEXT.format(
        split=f"{limits.split_duration_s:g}",
        pose_topic=limits.pose_topic,
        tolerance=f"{limits.time_tolerance_s:g}",
    )
