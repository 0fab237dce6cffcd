"""How the events that the messages of a part report are stored as a fragment."""

from __future__ import annotations

import json
from typing import Final

import numpy as np

from ros2_memory.analysis.intervals import IntervalTable
from ros2_memory.analysis.topic_events import Change, KnownState, Report, TopicEvents
from ros2_memory.columns.fragments import Fragment, Kind


def _fragment(events: TopicEvents) -> Fragment:
    head = {
        "span": (events.first, events.last),
        "labels": events.visible.labels,
        "known": events.known,
        "changes": events.changes,
        "errors": events.errors,
        "reports": events.reports,
        "counts": (events.left_out, events.undecodable, events.beyond),
    }
    return Fragment(json.dumps(head), {"visible": np.frombuffer(events.visible.rows, np.uint8)})


def _events(fragment: Fragment) -> TopicEvents:
    head = json.loads(fragment.head)
    first, last = head["span"]
    return TopicEvents(
        first,
        last,
        IntervalTable(tuple(head["labels"]), fragment.arrays["visible"].tobytes()),
        tuple(KnownState(*row) for row in head["known"]),
        tuple(Change(*row) for row in head["changes"]),
        tuple(Report(*row) for row in head["errors"]),
        tuple(Report(*row) for row in head["reports"]),
        *head["counts"],
    )


EVENTS: Final = Kind("events", _fragment, _events)
"""What came into view, changed or failed on a topic in a part."""
