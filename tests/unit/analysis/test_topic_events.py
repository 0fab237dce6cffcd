from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis import topic_events
from ros2_memory.analysis.intervals import IntervalBuilder, IntervalTable
from ros2_memory.analysis.topic_events import (
    EMPTY_STATE,
    KnownFlag,
    ReportedError,
    State,
    Toggle,
    TopicEvents,
    TopicEventsBuilder,
    state_of,
)
from ros2_memory.catalogue.codec import decode_topic_events, encode_topic_events
from ros2_memory.core.model import JsonValue
from ros2_memory.core.timebase import NS_PER_S

Messages = list[tuple[int, State]]


def told(messages: Messages, at_most: int | None = None) -> TopicEvents | None:
    builder = TopicEventsBuilder()
    for time, state in messages:
        builder.add(time, state)
    return builder.events(at_most)


def seeing(*labels: str) -> State:
    return State(labels) if labels else EMPTY_STATE


def each_second(*states: State) -> Messages:
    return [(nth * NS_PER_S, state) for nth, state in enumerate(states)]


STATES = st.builds(
    lambda labels, flags, faults: State(tuple(sorted(labels)), flags, faults),
    st.sets(st.sampled_from("abc")),
    st.sampled_from([(), (("x", True),), (("x", False),), (("x", True), ("y", False))]),
    st.sampled_from([(), ("hot",), ("cold",), ("hot", "cold")]),
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


def _comparable(story: TopicEvents | None) -> object:
    """Flips of several booleans at one time stand in no order."""
    assert story is not None
    flips = sorted(story.toggles, key=lambda flip: (flip.time, flip.path))
    known = sorted(story.known)
    seen = story.visible.intervals()
    return (story.first, story.last, seen, known, flips, story.errors, story.left_out)


def _glimpse(label: str, at: int) -> IntervalTable:
    watcher = IntervalBuilder(1)
    watcher.add(at, [label])
    part = watcher.part()
    assert part is not None
    return part.visible


@given(histories())
def test_where_a_history_is_cut_into_bags_changes_nothing(
    history: tuple[Messages, list[int]],
) -> None:
    messages, cuts = history
    builder = TopicEventsBuilder()
    for begin, end in zip([0, *cuts], [*cuts, len(messages)], strict=True):
        part = told(messages[begin:end])
        if part is not None:
            builder.join(part)
    assert _comparable(builder.events()) == _comparable(told(messages))


def test_a_boolean_that_flips_is_told_with_its_new_value() -> None:
    flags = [State(flags=(("value", value),)) for value in (False, False, True, False)]
    story = told(each_second(*flags))
    assert story is not None
    assert story.toggles == (
        Toggle("value", 2 * NS_PER_S, True),
        Toggle("value", 3 * NS_PER_S, False),
    )


def test_an_error_that_is_reported_again_is_told_once_with_its_count() -> None:
    hot = State(errors=("motor: hot",))
    story = told(each_second(hot, EMPTY_STATE, hot, hot))
    assert story is not None
    assert story.errors == (ReportedError("motor: hot", 0, 3 * NS_PER_S, 3),)


def test_what_is_beyond_the_limit_is_counted() -> None:
    blinking = [seeing("cup") if nth % 4 == 0 else seeing() for nth in range(40)]
    story = told(each_second(*blinking), at_most=3)
    assert story is not None
    assert [each.first for each in story.visible.intervals()] == [0, 4 * NS_PER_S, 8 * NS_PER_S]
    assert story.left_out == 7


def test_a_week_of_changes_is_counted_beyond_what_memory_may_hold(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(topic_events, "MAX_HELD", 10)
    monkeypatch.setattr(topic_events, "MAX_SEEN", 10)
    builder = TopicEventsBuilder()
    for nth in range(15):
        at = nth * 100 * NS_PER_S
        known = [KnownFlag(path, at, first=False, last=True) for path in ("x", "y")]
        builder.join(
            TopicEvents(
                at,
                at + NS_PER_S,
                visible=_glimpse(f"cup {nth}", at),
                known=tuple(known),
                toggles=tuple(Toggle(each.path, at + 1, True) for each in known),
                errors=(ReportedError(f"error {nth}", at, at, 1),),
            )
        )
    story = builder.events()
    assert story is not None
    assert story.visible.size == len(story.toggles) == len(story.errors) == 10
    assert story.visible.intervals()[0].label == "cup 0"
    flips = 2 * 15 + 2 * 14
    assert story.left_out == (15 - 10) + (flips - 10) + (15 - 10)


def test_messages_that_say_nothing_make_a_story_that_says_nothing() -> None:
    story = told(each_second(EMPTY_STATE, EMPTY_STATE))
    assert story is not None
    assert story.is_empty
    assert told([]) is None


def test_labels_booleans_and_errors_are_found_in_values() -> None:
    assert state_of({"detections": [{"label": "cup"}, {"label": "cup"}]}, "x/msg/Y") == State(
        ("cup",)
    )
    assert state_of({"value": True}, "std_msgs/msg/Bool").flags == (("value", True),)
    assert state_of({"a": {"b": False, "list": [True]}}, "x/msg/Y").flags == (("a.b", False),)
    log: dict[str, JsonValue] = {"level": 40, "name": "planner", "msg": "no path"}
    assert state_of(log, "rcl_interfaces/msg/Log").errors == ("planner: no path",)
    assert state_of({**log, "level": 30}, "rcl_interfaces/msg/Log") is EMPTY_STATE
    status: list[JsonValue] = [
        {"level": 0, "name": "lidar", "message": "fine"},
        {"level": 2, "name": "motor", "message": "hot"},
        {"level": 3, "name": "imu", "message": "stale"},
    ]
    found = state_of({"status": status}, "diagnostic_msgs/msg/DiagnosticArray")
    assert found.errors == ("motor: hot",)
    assert state_of({"value": 3.5}, "std_msgs/msg/Float64") is EMPTY_STATE


@given(histories(), st.integers(0, 700))
def test_a_story_comes_back_from_its_bytes_as_it_was(
    history: tuple[Messages, list[int]], booleans: int
) -> None:
    messages, _ = history
    at = messages[-1][0]
    many = State(flags=tuple((f"flag_{nth}", nth % 3 == 0) for nth in range(booleans)), beyond=3)
    story = told([*messages, (at, many), (at + 1, EMPTY_STATE)])
    assert story is not None
    assert decode_topic_events(encode_topic_events(story)) == story
