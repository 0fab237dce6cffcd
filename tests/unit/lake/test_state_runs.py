"""What messages state is the same after it was packed."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.state_changes import StateLevel
from ros2_memory.analysis.stated import events_of, stated_by
from ros2_memory.analysis.topic_events import EMPTY_STATE, State, TopicEvents
from ros2_memory.lake.memory.rows_as_messages import stated_in, states
from ros2_memory.lake.state_runs import (
    EmptyRuns,
    StateRuns,
    is_stated,
    unpacked,
    unpacked_empty,
)

STATES = (
    EMPTY_STATE,
    State(flags=(("value", True),)),
    State(flags=(("value", False),)),
    State(errors=("lidar: no scan",), levels=(StateLevel("status lidar", 2, "no scan"),)),
    State(levels=(StateLevel("goal 01", 4),)),
    State(reports=("warning of planner: no path",)),
    State(labels=("cup",), scores=(0.25,), flags=(("held", True),)),
    None,
)
MESSAGES = st.lists(
    st.tuples(st.integers(1, 5_000_000_000), st.sampled_from(STATES)), min_size=1, max_size=30
)


def added(stated: list[tuple[int, State | None]]) -> TopicEvents | None:
    return events_of(stated_by([time for time, _ in stated], [state for _, state in stated]))


@given(MESSAGES)
def test_all_that_follows_from_states_is_kept(steps: list[tuple[int, State | None]]) -> None:
    time, messages = 1_784_000_000 * 10**9, []
    for step, state in steps:
        time += step
        messages.append((time, state))
    runs = StateRuns()
    for each in messages:
        runs.add(*each)
    packed = runs.packed()
    assert packed is not None
    found = [
        (record.log_time, stated_in(record))
        for record in states("/state", "x/msg/X", unpacked(packed))
    ]
    assert [state for _, state in found] == [state for _, state in messages]
    assert [at for at, _ in found] == sorted(at for at, _ in found)
    before, expected = added(messages), added(found)
    assert before is not None
    assert expected is not None
    # Sights are told by the times of all messages, and are not asked of states alone.
    assert (before.toggles, before.errors, before.known, before.undecodable) == (
        expected.toggles,
        expected.errors,
        expected.known,
        expected.undecodable,
    )
    assert before.changes == expected.changes


@given(st.lists(st.tuples(st.integers(0, 10**9), st.booleans()), max_size=30))
def test_runs_without_a_detection_begin_and_end_with_a_message(
    steps: list[tuple[int, bool]],
) -> None:
    time, times, runs = 1_784_000_000 * 10**9, list[int](), EmptyRuns()
    for nth, (step, has_detection) in enumerate(steps):
        time += step
        times.append(time)
        if not has_detection:
            runs.add(nth, time)
    found = [*unpacked_empty(runs.packed())]
    inside = [each.nth + more for each in found for more in range(each.messages)]
    assert inside == [nth for nth, (_, has_detection) in enumerate(steps) if not has_detection]
    for each in found:
        assert each.first == times[each.nth]
        assert each.last == times[each.nth + each.messages - 1]


def test_a_topic_that_states_nothing_more_than_what_is_in_view_has_no_states() -> None:
    seen = added([(1, State(labels=("cup",)))])
    assert not is_stated(seen)
    assert is_stated(added([(1, State(flags=(("value", True),)))]))
    assert is_stated(added([(1, None)]))
    assert is_stated(None)


def test_what_a_hostile_bag_states_is_bounded() -> None:
    runs = StateRuns()
    for nth in range(30):
        names = [f"{nth} {at} {'x' * 100}" for at in range(512)]
        runs.add(nth, State(flags=tuple((name, True) for name in names)))
    assert runs.packed() is None
