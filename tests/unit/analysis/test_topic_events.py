import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis import topic_events
from ros2_memory.analysis.facts import (
    ERROR,
    FLAG,
    LABEL,
    REPORT,
    STATUS,
    Fact,
    State,
    Word,
    joined_stated,
    stated_by,
)
from ros2_memory.analysis.intervals import IntervalTable
from ros2_memory.analysis.topic_events import Change, KnownState, Report, TopicEvents, joined_events
from ros2_memory.analysis.topic_events import events_of as events_of_stated
from ros2_memory.core.timebase import NS_PER_S

Messages = list[tuple[int, State]]


def events_of(messages: Messages) -> TopicEvents | None:
    return events_of_stated(
        stated_by([time for time, _ in messages], [state for _, state in messages])
    )


def seeing(*labels: str) -> State:
    return State(tuple((Word(LABEL, label), math.nan) for label in labels))


def some_of(*words: Word, values: tuple[float, ...] = (math.nan,)) -> st.SearchStrategy[list[Fact]]:
    """Some facts, each of another name."""
    fact = st.tuples(st.sampled_from(words), st.sampled_from(values))
    return st.lists(fact, max_size=2, unique_by=lambda fact: fact[0].name)


STATES = st.tuples(
    some_of(*(Word(LABEL, label) for label in "abc")),
    some_of(Word(FLAG, "x"), Word(FLAG, "y"), values=(0, 1)),
    some_of(Word(ERROR, "hot"), Word(ERROR, "cold")),
    some_of(Word(STATUS, "x"), Word(STATUS, "y", "hot"), values=(0, 1, 2)),
    some_of(*(Word(REPORT, text) for text in ("late by 3 s", "late by 14 s", "no way"))),
).map(lambda kinds: State(tuple(fact for facts in kinds for fact in facts)))


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
    """Changes of several states at one time stand in no order."""
    assert events is not None
    changes = sorted(events.changes, key=lambda change: (change.time, change[:2]))
    known = sorted(events.known)
    seen = events.visible.intervals()
    said = events.errors, events.reports
    return (events.first, events.last, seen, known, changes, said, events.left_out)


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


def test_a_week_of_changes_is_counted_beyond_what_memory_may_hold(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(topic_events, "MAX_HELD", 10)
    monkeypatch.setattr(topic_events, "MAX_SEEN", 10)
    parts = []
    for nth in range(15):
        at = nth * 100 * NS_PER_S
        known = [KnownState(FLAG, path, at, 0, 1) for path in ("x", "y")]
        parts.append(
            TopicEvents(
                at,
                at + NS_PER_S,
                visible=_glimpse(f"cup {nth}", at),
                known=tuple(known),
                changes=tuple(Change(FLAG, each.name, at + 1, 1) for each in known),
                errors=(Report(f"error {nth}", at, at, 1),),
            )
        )
    events = joined_events(parts)
    assert events is not None
    assert events.visible.size == len(events.changes) == len(events.errors) == 10
    assert events.visible.intervals()[0].label == "cup 0"
    flips = 2 * 15 + 2 * 14
    assert events.left_out == (15 - 10) + (flips - 10) + (15 - 10)
