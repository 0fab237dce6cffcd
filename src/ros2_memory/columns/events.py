"""How the events that the messages of a part report are stored as a fragment."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final

import numpy as np

from ros2_memory.analysis.intervals import IntervalTable
from ros2_memory.analysis.topic_events import (
    Change,
    KnownState,
    Report,
    TopicEvents,
    joined_events,
)
from ros2_memory.columns.fragments import Fragment, Kind

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.core.model import JsonValue


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
    words: dict[str, str] = {}

    def rows(name: str) -> list[list[JsonValue]]:
        """Returns the rows of a list; equal words are one object, as there are thousands."""
        return [
            [words.setdefault(one, one) if isinstance(one, str) else one for one in row]
            for row in head[name]
        ]

    return TopicEvents(
        first,
        last,
        IntervalTable(tuple(head["labels"]), fragment.arrays["visible"].tobytes()),
        tuple(map(KnownState._make, rows("known"))),
        tuple(map(Change._make, rows("changes"))),
        tuple(map(Report._make, rows("errors"))),
        tuple(map(Report._make, rows("reports"))),
        *head["counts"],
    )


def _joined(found: Sequence[TopicEvents]) -> Sequence[TopicEvents]:
    whole = joined_events(found)
    return [] if whole is None else [whole]


# Named anew where the same messages report something else: what was stored before does not count.
EVENTS: Final = Kind("events2", _fragment, _events, _joined)
"""What came into view, changed or failed on a topic in a part."""
