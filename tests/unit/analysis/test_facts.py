import math
from dataclasses import replace

import pytest

from ros2_memory.analysis import topic_events
from ros2_memory.analysis.facts import (
    FLAG,
    LABEL,
    State,
    Word,
    stated_by,
)
from ros2_memory.analysis.topic_events import (
    Change,
    KnownState,
    Report,
    events_of,
    joined_events,
)
from ros2_memory.core.timebase import NS_PER_S


def test_a_week_of_changes_is_counted_beyond_what_memory_may_hold(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(topic_events, "MAX_EVENTS", 10)
    monkeypatch.setattr(topic_events, "MAX_INTERVALS", 10)
    parts = []
    for nth in range(15):
        at = nth * 100 * NS_PER_S
        glimpse = events_of(stated_by([at], [State(((Word(LABEL, f"cup {nth}"), math.nan),))]))
        assert glimpse is not None
        parts.append(
            replace(
                glimpse,
                last=at + NS_PER_S,
                known=tuple(KnownState(FLAG, path, at, 0, 1) for path in ("x", "y")),
                changes=tuple(Change(FLAG, path, at + 1, 1) for path in ("x", "y")),
                errors=(Report(f"error {nth}", at, at, 1),),
            )
        )
    events = joined_events(parts)
    assert events is not None
    assert events.visible.size == len(events.changes) == len(events.errors) == 10
    assert events.visible.intervals()[0].label == "cup 0"
    flips = 2 * 15 + 2 * 14
    assert events.left_out == (15 - 10) + (flips - 10) + (15 - 10)
