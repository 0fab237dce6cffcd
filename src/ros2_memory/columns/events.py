"""How the events that the messages of a part report are stored as a fragment."""

from __future__ import annotations

import json
from typing import Final

import numpy as np

from ros2_memory.analysis.intervals import IntervalTable
from ros2_memory.analysis.state_changes import NO_CHANGES, Change, Held, Report, StateChanges
from ros2_memory.analysis.topic_events import ReportedError, TopicEvents
from ros2_memory.columns.fragments import Fragment, Kind


def _fragment(events: TopicEvents) -> Fragment:
    changes = events.changes
    head = {
        "span": (events.first, events.last),
        "labels": events.visible.labels,
        "known": events.known,
        "toggles": events.toggles,
        "errors": events.errors,
        "counts": (events.left_out, events.undecodable, events.beyond),
        "levels": (changes.known, changes.changes, changes.reports, changes.left_out),
    }
    return Fragment(json.dumps(head), {"visible": np.frombuffer(events.visible.rows, np.uint8)})


def _events(fragment: Fragment) -> TopicEvents:
    head = json.loads(fragment.head)
    known, changed, reports, left_out = head["levels"]
    changes = StateChanges(
        tuple(Held(*row) for row in known),
        tuple(Change(*row) for row in changed),
        tuple(Report(*row) for row in reports),
        left_out,
    )
    first, last = head["span"]
    more, undecodable, beyond = head["counts"]
    return TopicEvents(
        first,
        last,
        IntervalTable(tuple(head["labels"]), fragment.arrays["visible"].tobytes()),
        tuple(Held(*row) for row in head["known"]),
        tuple(Change(*row) for row in head["toggles"]),
        tuple(ReportedError(*row) for row in head["errors"]),
        more,
        undecodable,
        beyond,
        NO_CHANGES if changes == NO_CHANGES else changes,
    )


EVENTS: Final = Kind("events", _fragment, _events)
"""What came into view, toggled, changed or failed on a topic in a part."""
