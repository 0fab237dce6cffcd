"""The page's data about a moment, about a stretch of time, and about a label seen in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.core.reply import (
    PAIRS,
    PLAIN,
    POSE_KEYS,
    TENTHS_OF_S,
    JsonObject,
    Scope,
    an_object,
    digits,
    keys,
    shown,
)
from ros2_memory.history.conditions import Sought
from ros2_memory.history.view import TimeRange, open_span
from ros2_memory.insights.changes_before import recap_before
from ros2_memory.insights.recap import events_by_topic, recap
from ros2_memory.insights.sightings import find_matches
from ros2_memory.serving.page.span import EVENT, SUMMARY
from ros2_memory.things.labels import Labels

if TYPE_CHECKING:
    from ros2_memory.core.model import JsonValue
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.results import Recap, Sightings

AROUND_S: Final = 1.0
"""How long before and after a moment counts as seen at it: a detector reports once a second."""
MOST_SEEN: Final = 60
MOST_SIGHTINGS: Final = 30
_CHANGES_S: Final = 10.0
"""How long before a moment a change is shown."""
_IN_VIEW: Final = " in view"
_CHANGE: Final = keys("text", TENTHS_OF_S("before_s", "before"))
_ROBOT: Final = keys(
    an_object(POSE_KEYS)("robot"),
    PLAIN("frame", "robot.frame_id"),
    digits(2)("speed", "speed_mps"),
    PAIRS("state"),
)


def moment_shown(memory: Memory, call: Call, at_s: float) -> JsonObject:
    """Returns where the robot was at a moment (Unix s), what it saw and what had changed.

    Raises:
        NoDataError: nothing is recorded.
        QueryTimeoutError: the call's time is over.
    """
    preceding = recap_before(memory, call, at_s, _CHANGES_S, None)
    around = recap(
        memory,
        call,
        TimeRange(at_s - AROUND_S, at_s + AROUND_S),
        most_events=MOST_SEEN,
        with_changes=False,
    )
    changes = [*preceding.changes, *preceding.after]
    return {
        "t": at_s,
        **_ROBOT.render(preceding),
        "changes": [_CHANGE.render(change) for change in changes],
        "seen": _seen(around),
        "notes": [*dict.fromkeys([*preceding.notes, *around.notes])],
    }


def stretch_shown(memory: Memory, call: Call, start_s: float, end_s: float) -> JsonObject:
    """Returns how far the robot drove in a stretch of time, what it saw and what happened.

    Raises:
        NoDataError: nothing is recorded.
        QueryTimeoutError: the call's time is over.
    """
    summary = recap(
        memory, call, TimeRange(start_s, end_s), most_events=MOST_SEEN, with_changes=False
    )
    others = [event for event in summary.events if event.kind != "thing"]
    return {
        "start": start_s,
        "end": end_s,
        **SUMMARY.render(summary),
        "seen": _seen(summary),
        "events": [EVENT.render(event) for event in others],
        "notes": [*summary.notes],
    }


def _seen(summary: Recap) -> list[JsonValue]:
    """Returns the labels in view, each once; first those that were in view all the time."""
    rows: dict[str, JsonObject] = {label: {"label": label} for label in summary.throughout}
    for event in summary.events:
        label = event.text.removesuffix(_IN_VIEW)
        if event.kind == "thing" and label not in rows:
            rows[label] = {**EVENT.render(event), "label": label}
    return [*rows.values()]


def sightings_shown(
    memory: Memory, call: Call, label: str, start_s: float, end_s: float
) -> JsonObject:
    """Returns the newest sightings of a label in all its spellings, over all detectors.

    Raises:
        NoDataError: nothing is recorded.
        QueryTimeoutError: the call's time is over.
    """
    span = TimeRange(start_s, end_s)
    view, window = open_span(memory, call, span)
    key_of = Labels(memory.limits.labels).key
    spellings = [
        (topic, spelling)
        for topic, events in events_by_topic(view, window).items()
        if events.visible.size
        for spelling in sorted({label, *events.visible.labels})
        if key_of(spelling) == key_of(label)
    ]
    answers: list[Sightings] = []
    for topic, spelling in spellings:
        # The name of a class may be its number, which coordinates may equal.
        kind = "contains_word" if spelling.isdecimal() else "equals"
        sought = Sought(topic, kind, spelling)
        answers.append(find_matches(memory, call, sought, span=span, limit=MOST_SIGHTINGS))
    found = [sighting for answer in answers for sighting in answer.sightings]
    found.sort(key=lambda sighting: sighting.last, reverse=True)
    scope = Scope(now=max((answer.now for answer in answers), default=0))
    totals = [answer.total for answer in answers if answer.total is not None]
    return {
        "label": label,
        "start": start_s,
        "end": end_s,
        "sightings": [shown(sighting, scope) for sighting in found[:MOST_SIGHTINGS]],
        "total": sum(totals) if len(totals) == len(answers) else None,
        "notes": [*dict.fromkeys(note for answer in answers for note in answer.notes)],
    }
