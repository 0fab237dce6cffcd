"""When nothing recorded may stay, over what recordings heard alone."""

from collections.abc import Sequence
from typing import NamedTuple

from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.conditions import parse_condition
from ros2_memory.bag_dir.state_files import ConditionInterval, Excluded
from ros2_memory.core.spans import lies_inside, united, without
from ros2_memory.triggers.exclusion import (
    Cut,
    ExclusionRule,
    RecordingConditions,
    add_message,
    excluded_intervals,
)

LAST = 40
STALE = 3
MOST_MARGIN = 2


class Past(NamedTuple):
    """A recording with its messages; `end` is that of its last message."""

    start: int
    end: int
    said: tuple[tuple[int, bool | None], ...]
    live: bool = False


def rule(*, margin: int = 0, excludes_unknown: bool = True) -> ExclusionRule:
    return ExclusionRule(
        name="privacy",
        topic="/privacy_mode",
        condition=parse_condition("equals", True, 0.5),
        margin=margin,
        stale=STALE,
        excludes_unknown=excludes_unknown,
    )


def heard_by(past: Past, *, latched: bool, nth: int = 0) -> RecordingConditions:
    """The `nth` recording, which took over from the one before it."""
    heard: list[ConditionInterval] = []
    for time, holds in past.said:
        add_message(heard, time, holds, latched=latched, stale=STALE)
    end = None if past.live else past.end
    return RecordingConditions(past.start, end, heard, (), f"rec_{nth}", f"rec_{nth - 1}")


def heard_in(*pasts: Past) -> list[RecordingConditions]:
    """Recordings of a latched topic, each of which took over from the one before it."""
    return [heard_by(past, latched=True, nth=nth) for nth, past in enumerate(pasts)]


def knows(past: Past, time: int, *, latched: bool) -> bool | None:
    """What a recording itself knows at a time."""
    said = [each for each in past.said if each[0] <= time]
    if not said or not (latched or time - said[-1][0] < STALE):
        return None
    return said[-1][1]


def is_held(pasts: Sequence[Past], time: int, *, latched: bool) -> bool:
    for at, past in enumerate(pasts):
        if past.start <= time <= past.end and knows(past, time, latched=latched):
            return True
        if past.live or not knows(past, past.end, latched=latched):
            continue
        later = pasts[at + 1 :]
        until = max(later[0].start, past.end + 1) + STALE if later else 0
        since = past.end
        while knows(past, since - 1, latched=latched):
            since -= 1
        for nth, each in enumerate(later):
            start = each.start if nth else max(since, each.start)
            if start <= time < until and not any(when <= time for when, _ in each.said):
                return True
            if each.said:
                break
    return False


def is_free(pasts: Sequence[Past], time: int, nth: int, *, latched: bool) -> bool:
    """Whether a recording, or the one before or after it, knows that it does not hold."""
    for at, past in enumerate(pasts):
        if abs(at - nth) > 1:
            continue
        if past.start <= time <= past.end and knows(past, time, latched=latched) is False:
            return True
        if past.live or knows(past, past.end, latched=latched) is not False or time <= past.end:
            continue
        taken = any(each.start <= past.end < each.end for each in pasts[at + 1 :])
        since = past.end + 1 if latched else past.said[-1][0]
        if taken and time < since + STALE:
            return True
    return False


@st.composite
def histories(draw: st.DrawFn) -> list[Past]:
    """Recordings, one after the other or overlapping, the last one perhaps being written."""
    pasts: list[Past] = []
    start = draw(st.integers(0, 3))
    for _ in range(draw(st.integers(1, 3))):
        end = start + draw(st.integers(1, 12))
        times = draw(st.lists(st.integers(start, end), max_size=6, unique=True).map(sorted))
        said = tuple((time, draw(st.sampled_from([True, False, False, None]))) for time in times)
        pasts.append(Past(start, end, said))
        # No more than two recorders run at once.
        ended = pasts[-2].end + 1 if len(pasts) > 1 else start
        start = draw(st.integers(max(start, ended), max(end, ended) + 6))
    if draw(st.booleans()):
        # What is written now goes on beyond what is looked at, by the greatest margin.
        pasts[-1] = pasts[-1]._replace(live=True, end=LAST + MOST_MARGIN)
    return pasts


@given(histories(), st.booleans(), st.booleans(), st.integers(0, MOST_MARGIN))
def test_nothing_stays_while_it_holds_or_is_not_known(
    pasts: list[Past], latched: bool, unknown: bool, margin: int
) -> None:
    stretches = excluded_intervals(
        rule(margin=margin, excludes_unknown=unknown),
        [heard_by(past, latched=latched, nth=nth) for nth, past in enumerate(pasts)],
    )
    wrong = {
        time
        for time in range(-margin, LAST + margin + 1)
        if is_held(pasts, time, latched=latched)
        or any(
            unknown
            and past.start <= time <= past.end
            and not is_free(pasts, time, nth, latched=latched)
            for nth, past in enumerate(pasts)
        )
    }
    goes = {time + by for time in wrong for by in range(-margin, margin + 1)}
    for time in range(LAST + 1):
        if any(past.start <= time <= past.end for past in pasts):
            found = any(each.start <= time < each.stop for each in stretches)
            assert found == (time in goes), time


def test_after_a_restart_with_an_earlier_clock_what_was_known_is_not_and_what_held_holds() -> None:
    one, other = heard_in(Past(0, 600, ((0, False),)), Past(400, 700, ((450, False),)))
    assert excluded_intervals(rule(), [one, other]) == []
    found = excluded_intervals(rule(), [one, other._replace(previous=None)])
    assert found == [Excluded(400, 450, held=False)]
    # To a time inside of the recording before, in which it did not hold yet.
    before = Past(0, 600, ((0, False), (450, True)))
    one, other = heard_in(before, Past(400, 700, ((420, True), (430, False))))
    stepped = one._replace(unclear=[(500, 520)])
    for pair in ([one, other._replace(previous=None)], [stepped, other]):
        assert Excluded(400, 430, held=True) in excluded_intervals(rule(), pair)


def test_a_value_out_of_order_only_adds() -> None:
    heard: list[ConditionInterval] = []
    for time, holds in ((1, False), (5, False), (4, True), (6, False), (5, False)):
        add_message(heard, time, holds, latched=True, stale=STALE)
    recording = RecordingConditions(0, 9, heard)
    assert excluded_intervals(rule(), [recording]) == [Excluded(4, 6, True), Excluded(0, 1, False)]


def test_latched_messages_go_by_when_they_were_published() -> None:
    held, unknown, older = Excluded(10, 20), Excluded(30, 40, False), Excluded(1, 3)
    cut = Cut([held, unknown], [older, Excluded(5, 7, False)], {"/map"})
    plain = [time for time in range(50) if cut.takes("/odom", time, 0)]
    assert plain == [*range(10, 20), *range(30, 40)]
    # Received again, in a stretch and after it, by when it was published.
    for at, published in (
        (18, {2: True, 6: True, 8: False, 15: True}),
        (35, {35: True, 0: True, 25: False}),
        (45, {2: True, 6: False, 8: False, 15: True, 35: False, 0: False}),
    ):
        assert {then: cut.takes("/map", at, then) for then in published} == published


SPANS = st.lists(
    st.tuples(st.integers(0, 30), st.integers(1, 8)).map(lambda each: (each[0], sum(each)))
)


@given(SPANS, SPANS)
def test_spans_are_sets_of_moments(
    spans: list[tuple[int, int]], others: list[tuple[int, int]]
) -> None:
    def moments(of: Sequence[tuple[int, int]]) -> set[int]:
        return {at for start, stop in of for at in range(start, stop)}

    one, other = united(spans), united(others)
    assert moments(one) == moments(spans) == {at for at in range(50) if lies_inside(one, at)}
    assert moments(without(one, other)) == moments(spans) - moments(others)
