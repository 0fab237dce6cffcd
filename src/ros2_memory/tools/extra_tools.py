"""The tools beyond the specification: what happened, where and when, in one call each."""

from __future__ import annotations

from ros2_memory.insights.recap import recap
from ros2_memory.insights.saved_moments import list_moments, remember_moment
from ros2_memory.insights.sightings import find_matches
from ros2_memory.insights.status import memory_status
from ros2_memory.insights.type_fields import describe_type
from ros2_memory.insights.visits import visits
from ros2_memory.tools.arguments import (
    Between,
    Last,
    MatchesArguments,
    NoArguments,
    SaveMomentArguments,
    TypeArguments,
    VisitsArguments,
    WindowArguments,
)
from ros2_memory.tools.declaration import ToolDeclaration, ToolName

_SIGHTINGS = ToolDeclaration(
    (ToolName("find_matches", "Sightings"),),
    "When, where, how often and how long a condition (as in find_last_match) held, newest first; "
    "matches in a row are one sighting. Reply: {{sightings: [{{topic, first_seen, last_seen, "
    "duration_s, ago_s, count, robot: where it was at last_seen, place: of the thing}}], total}}.",
    MatchesArguments,
    lambda memory, call, given: find_matches(
        memory,
        call,
        given.topic,
        given.condition_type,
        given.value,
        field=given.field,
        start_s=given.start,
        end_s=given.end,
        last_s=given.seconds,
        oldest_first=given.oldest_first,
        limit=given.limit,
    ),
    blocking=True,
)
_RECAP = ToolDeclaration(
    (
        ToolName("recap", "What happened", Between, "between two Unix times"),
        ToolName("recap_last", "What happened lately", Last, "in the last seconds"),
    ),
    "What happened {when}: way, stops, things in view, flips of booleans, errors, gaps. Reply: "
    "{{distance_m, max_speed, stood_s, events: [{{timestamp, ago_s, duration_s, text}}], counts}}.",
    WindowArguments,
    lambda memory, call, given: recap(memory, call, given.span),
    blocking=True,
)
_STATUS = ToolDeclaration(
    (ToolName("memory_status", "How far to trust the memory"),),
    "Whether the recorder is alive, how old the newest data is, which topics fell silent, what is "
    "damaged, and for how long the disk lasts.",
    NoArguments,
    lambda memory, call, _: memory_status(memory, call),
)
_VISITS = ToolDeclaration(
    (ToolName("visits", "Visits to a place"),),
    "When, how long and how often the robot was near a place, newest first, in {map_frame} where "
    "transforms lead there, else in the frame of {pose_topic}. Reply: {{frame_id, there_now, "
    "visits: [{{arrived, departed, duration_s, closest_m, ago_s}}], total}}.",
    VisitsArguments,
    lambda memory, call, given: visits(
        memory,
        call,
        given.x,
        given.y,
        frame_id=given.frame_id,
        radius_m=given.radius_m,
        limit=given.limit,
    ),
    blocking=True,
)
TYPE = ToolDeclaration(
    (ToolName("describe_type", "Fields of a message type"),),
    "The fields that replies show of a message type.",
    TypeArguments,
    lambda memory, call, given: describe_type(memory, call, given.type),
)
_MOMENTS = ToolDeclaration(
    (ToolName("list_moments", "Kept moments"),),
    "Moments kept by remember_moment, newest first.",
    NoArguments,
    lambda memory, call, _: list_moments(memory, call),
)
_SAVE_MOMENT = ToolDeclaration(
    (ToolName("remember_moment", "Keep a moment"),),
    "Keeps what is recorded around now from deletion. Reply: {{moment, bags, pending: the rest is "
    "being written}}.",
    SaveMomentArguments,
    lambda memory, call, given: remember_moment(
        memory,
        call,
        given.label,
        seconds_before=given.seconds_before,
        seconds_after=given.seconds_after,
    ),
    blocking=True,
    writes=True,
)
DECLARATIONS = (_SIGHTINGS, _RECAP, _VISITS, _STATUS, _MOMENTS, _SAVE_MOMENT)
