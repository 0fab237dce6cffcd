"""The tools beyond the specification: what happened, where and when, in one call each."""

from __future__ import annotations

from ros2_memory.counts.matches import count_matches
from ros2_memory.counts.robot import count_visits
from ros2_memory.insights.compare import compare
from ros2_memory.insights.fields import describe_type
from ros2_memory.insights.recap import recap_or_before
from ros2_memory.insights.saved_moments import list_moments, remember_moment, show_moment
from ros2_memory.insights.sightings import find_matches
from ros2_memory.insights.status import memory_status
from ros2_memory.places.visits import visits
from ros2_memory.things.find import find_things
from ros2_memory.tools.arguments import (
    CompareArguments,
    LastOrWindow,
    MatchesArguments,
    MomentArguments,
    NoArguments,
    RecapArguments,
    RecapTime,
    SaveMomentArguments,
    ThingsArguments,
    TypeArguments,
    VisitsArguments,
    Window,
)
from ros2_memory.tools.declaration import ToolDeclaration, ToolName

_SIGHTINGS = ToolDeclaration(
    (ToolName("find_matches", "Sightings", LastOrWindow, drawn=True),),
    "When, where, how often and how long a condition was true, newest first. "
    "Consecutive matches are one sighting; in a log each message is one, on /_action/status each "
    "goal: failed, aborted, "
    "succeeded. contains_word: whole "
    "words (pot, not potato; knife -butter). Texts such as /task hold until "
    "the next, an empty one ends them: {{topic, episodes: [{{start, end, seconds, value, previous, "
    "next: {{value, start}}, with, robot}}]}}. "
    "Reply: {{topic, sightings: [{{first_seen, last_seen, "
    "duration_s, ago_s, count, matched: texts at last_seen, or value: its fields, robot: its "
    "position (at when), place: of the thing, score}}], total, unknown_s}}.",
    MatchesArguments,
    find_matches,
    blocking=True,
    instead={"by": count_matches},
)
_RECAP = ToolDeclaration(
    (ToolName("recap", "What happened", RecapTime, drawn=True),),
    "What happened {when}: path, stops, speed drops, things in view, toggled booleans, goals, "
    "errors, low batteries, gaps, silences. Reply: {{distance_m, max_speed, stood_s, events: "
    "[{{timestamp, ago_s, duration_s, text, in, score, before: changes 10 s before}}], counts}}. "
    "With around: {{before: [{{text, s_before}}], after (5 s), looked_at, robot, state}}.",
    RecapArguments,
    recap_or_before,
    blocking=True,
)
_STATUS = ToolDeclaration(
    (ToolName("memory_status", "Memory state"),),
    "Whether the recorder runs, age of the newest data, topics that fell silent, "
    "damaged files, days the disk budget holds, newest saved moments.",
    NoArguments,
    memory_status,
)
_VISITS = ToolDeclaration(
    (ToolName("visits", "Visits", Window, drawn=True),),
    "When, how long, how often the robot was in a place (where, or near x, y), newest first, in "
    "{map_frame} if known, else {pose_topic}'s; without one, "
    "all named. Reply: {{frame_id, there_now, visits: [{{arrived, departed, duration_s, "
    "ago_s}}], total, entries (seen to begin), exits, minutes, unknown_s}} or "
    "{{places: [{{place, minutes, entries}}]}}.",
    VisitsArguments,
    visits,
    blocking=True,
    instead={"by": count_visits},
)
_THINGS = ToolDeclaration(
    (ToolName("find_things", "Things", Window, drawn=True),),
    "Which things there are and where: how many chairs, what is in a place or near X, where X is, "
    "since when, where before, likely now; as of end. Reply: {{things: [{{label, place, in, "
    "first_seen, last_seen, ago_s, count, seen_from, still_there, moved: [{{from, to, place, "
    "times}}], usually}}], total, labels}}.",
    ThingsArguments,
    find_things,
    blocking=True,
)
_COMPARE = ToolDeclaration(
    (ToolName("compare", "Differences", drawn=True),),
    "Between two windows: things moved, appeared, not seen again; "
    "path, standstills, minutes in places, errors, silences. Things go from the earlier "
    "to the later. Within a tenth is equal. Reply: "
    "{{things: {{moved: [{{label, was, is}}], appeared, not_seen_where_expected, not_looked_at, "
    "more_or_fewer, movers}}, way: {{name: {{this, with}}}}, stood_at: [{{x, y, in, this, with}}], "
    "minutes, errors, silent_s}}.",
    CompareArguments,
    compare,
    blocking=True,
)
TYPE = ToolDeclaration(
    (ToolName("describe_type", "Fields of a message type"),),
    "The fields that replies show of a message type.",
    TypeArguments,
    describe_type,
)
MOMENTS = ToolDeclaration(
    (ToolName("list_moments", "Saved moments"),),
    "Moments saved by remember_moment or a rule, newest first.",
    NoArguments,
    list_moments,
)
MOMENT = ToolDeclaration(
    (ToolName("show_moment", "A saved moment"),), "One saved moment.", MomentArguments, show_moment
)
_SAVE_MOMENT = ToolDeclaration(
    (ToolName("remember_moment", "Save a moment"),),
    "Saves the bags around now from deletion. Reply: {{moment, bags, pending: the rest is "
    "still being written}}.",
    SaveMomentArguments,
    remember_moment,
    blocking=True,
    writes=True,
)
DECLARATIONS = (_SIGHTINGS, _THINGS, _COMPARE, _RECAP, _VISITS, _STATUS, _SAVE_MOMENT)
"""The tools, in the order in which clients see them."""
READABLE = (TYPE, MOMENTS, MOMENT)
"""Declared like tools, but offered as resources."""
