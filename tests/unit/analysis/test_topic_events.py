from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis import topic_events
from ros2_memory.analysis.intervals import IntervalTable
from ros2_memory.analysis.state_changes import Change, Held, StateLevel
from ros2_memory.analysis.stated import events_of as events_of_stated
from ros2_memory.analysis.stated import joined_stated, stated_by
from ros2_memory.analysis.topic_events import (
    EMPTY_STATE,
    ReportedError,
    State,
    TopicEvents,
    joined_events,
    state_of,
)
from ros2_memory.columns.events import EVENTS
from ros2_memory.columns.fragments import Fragment
from ros2_memory.core.model import JsonValue
from ros2_memory.core.timebase import NS_PER_S

Messages = list[tuple[int, State]]


def events_of(messages: Messages) -> TopicEvents | None:
    return events_of_stated(
        stated_by([time for time, _ in messages], [state for _, state in messages])
    )


def seeing(*labels: str) -> State:
    return State(labels) if labels else EMPTY_STATE


def each_second(*states: State) -> Messages:
    return [(nth * NS_PER_S, state) for nth, state in enumerate(states)]


STATES = st.builds(
    lambda labels, flags, faults, levels, reports: State(
        tuple(sorted(labels)), flags, faults, levels=levels, reports=reports
    ),
    st.sets(st.sampled_from("abc")),
    st.sampled_from([(), (("x", True),), (("x", False),), (("x", True), ("y", False))]),
    st.sampled_from([(), ("hot",), ("cold",), ("hot", "cold")]),
    st.lists(
        st.builds(StateLevel, st.sampled_from("mn"), st.integers(0, 2)),
        max_size=2,
        unique_by=lambda level: level.name,
    ).map(tuple),
    st.sampled_from([(), ("late by 3 s",), ("late by 14 s",), ("no way",)]),
).map(lambda state: EMPTY_STATE if state.is_empty else state)


@st.composite
def histories(draw: st.DrawFn) -> tuple[Messages, list[int]]:
    """Messages with silences and equal times, and where they are cut into bags."""
    time = 0
    messages: Messages = []
    for wait, state in draw(
        st.lists(
            st.tuples(st.sampled_from([0, 1, NS_PER_S, 10 * NS_PER_S, 11 * NS_PER_S]), STATES),
            min_size=1,
            max_size=30,
        )
    ):
        time += wait
        messages.append((time, state))
    return messages, sorted(draw(st.sets(st.integers(1, len(messages)), max_size=6)))


def _comparable(events: TopicEvents | None) -> object:
    """Flips of several booleans at one time stand in no order."""
    assert events is not None
    flips = sorted(events.toggles, key=lambda flip: (flip.time, flip.name))
    known = sorted(events.known)
    seen = events.visible.intervals()
    state = events.changes
    levels = sorted(state.known), sorted(state.changes), state.reports, state.left_out
    return (events.first, events.last, seen, known, flips, events.errors, events.left_out, levels)


def _glimpse(label: str, at: int) -> IntervalTable:
    events = events_of([(at, seeing(label))])
    assert events is not None
    return events.visible


@given(histories())
def test_where_a_history_is_cut_into_bags_changes_nothing(
    history: tuple[Messages, list[int]],
) -> None:
    messages, cuts = history
    ends = zip([0, *cuts], [*cuts, len(messages)], strict=True)
    parts = [events_of(messages[begin:end]) for begin, end in ends]
    whole = joined_events([part for part in parts if part is not None])
    assert _comparable(whole) == _comparable(events_of(messages))


@given(histories())
def test_events_come_back_from_their_bytes(history: tuple[Messages, list[int]]) -> None:
    events = events_of(history[0])
    assert events is not None
    stored = EVENTS.store(events).to_bytes()
    assert EVENTS.load(Fragment.from_bytes(stored)) == events


@given(histories(), st.data())
def test_messages_of_tables_that_overlap_are_taken_as_those_of_one(
    history: tuple[Messages, list[int]], data: st.DataObject
) -> None:
    # Of equal times either may be first.
    messages = [(time + nth, state) for nth, (time, state) in enumerate(history[0])]
    tables = data.draw(st.lists(st.integers(0, 2), min_size=len(messages), max_size=len(messages)))
    parts = [
        [message for message, table in zip(messages, tables, strict=True) if table == nth]
        for nth in range(3)
    ]
    stated = [stated_by(*([*each] for each in zip(*part, strict=True))) for part in parts if part]
    assert _comparable(events_of_stated(joined_stated(stated))) == _comparable(events_of(messages))


def test_what_is_beyond_the_limit_is_counted() -> None:
    blinking = [seeing("cup") if nth % 4 == 0 else seeing() for nth in range(40)]
    whole = events_of(each_second(*blinking))
    assert whole is not None
    events = whole.limited(3, 3)
    assert [each.first for each in events.visible.intervals()] == [0, 4 * NS_PER_S, 8 * NS_PER_S]
    assert events.left_out == 7


def test_a_week_of_changes_is_counted_beyond_what_memory_may_hold(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(topic_events, "MAX_HELD", 10)
    monkeypatch.setattr(topic_events, "MAX_SEEN", 10)
    parts = []
    for nth in range(15):
        at = nth * 100 * NS_PER_S
        known = [Held(path, at, first=False, last=True) for path in ("x", "y")]
        parts.append(
            TopicEvents(
                at,
                at + NS_PER_S,
                visible=_glimpse(f"cup {nth}", at),
                known=tuple(known),
                toggles=tuple(Change(each.name, at + 1, True) for each in known),
                errors=(ReportedError(f"error {nth}", at, at, 1),),
            )
        )
    events = joined_events(parts)
    assert events is not None
    assert events.visible.size == len(events.toggles) == len(events.errors) == 10
    assert events.visible.intervals()[0].label == "cup 0"
    flips = 2 * 15 + 2 * 14
    assert events.left_out == (15 - 10) + (flips - 10) + (15 - 10)


def test_labels_booleans_and_errors_are_found_in_values() -> None:
    assert state_of({"detections": [{"label": "cup"}, {"label": "cup"}]}, "x/msg/Y") == State(
        ("cup",)
    )
    assert state_of({"value": True}, "std_msgs/msg/Bool").flags == (("value", True),)
    assert state_of({"a": {"b": False, "list": [True]}}, "x/msg/Y").flags == (("a.b", False),)
    log: dict[str, JsonValue] = {"level": 40, "name": "planner", "msg": "no path"}
    assert state_of(log, "rcl_interfaces/msg/Log").errors == ("planner: no path",)
    assert not state_of({**log, "level": 30}, "rcl_interfaces/msg/Log").errors
    assert state_of({**log, "level": 20}, "rcl_interfaces/msg/Log") is EMPTY_STATE
    status: list[JsonValue] = [
        {"level": 0, "name": "lidar", "message": "fine"},
        {"level": 2, "name": "motor", "message": "hot"},
        {"level": 3, "name": "imu", "message": "stale"},
    ]
    found = state_of({"status": status}, "diagnostic_msgs/msg/DiagnosticArray")
    assert found.errors == ("motor: hot",)
    assert state_of({"value": 3.5}, "std_msgs/msg/Float64") is EMPTY_STATE
