"""When rules fire, over streams of messages alone."""

from __future__ import annotations

from itertools import accumulate
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.bag_dir.state_files import RunRecord
from tests.support.watched_bags import SILENT, S, rule

if TYPE_CHECKING:
    from collections.abc import Sequence

Stream = list[tuple[int, bool | None]]

STEPS = st.tuples(
    st.sampled_from([S // 2, S, 4 * S, 11 * S]), st.sampled_from([True, True, False, None])
)


def stream_of(steps: list[tuple[int, bool | None]]) -> Stream:
    times = accumulate(step for step, _ in steps)
    return [(time, matches) for time, (_, matches) in zip(times, steps, strict=True)]


STREAMS = st.lists(STEPS, max_size=30).map(stream_of)
HOLDS = st.sampled_from([0, S, 5 * S, 20 * S])


def fired(
    stream: Stream, hold: int, cuts: Sequence[int] = (), *, latched: bool = False, end: int = 0
) -> list[int]:
    """When the rule fires, if the stream is looked at in pieces that end at these times."""
    times: list[int] = []
    runs: dict[str, RunRecord] = {}
    for until in (*sorted(cuts), max(end, stream[-1][0] + 1 if stream else 0)):
        piece = [each for each in stream if each[0] < until]
        stream = stream[len(piece) :]
        watched = rule(hold=hold)
        for time, matches in piece:
            found = watched.take(runs, "/bumper", time, matches=matches, latched=latched)
            times += [] if found is None else [found.at]
        times += [each.at for each in watched.reach(runs, until)]
    return times


def expected(stream: Stream, hold: int) -> list[int]:
    """The same from the whole stream: every run of matches, then how long it held."""
    runs: list[list[int]] = []
    previous: tuple[int, bool] | None = None
    for time, matches in stream:
        if previous is not None and time - previous[0] > SILENCE_NS:
            previous = None
        in_run = previous is not None and previous[1]
        if matches and not in_run:
            runs.append([])
        if matches:
            runs[-1].append(time)
        # A message that cannot be decoded keeps a match alive, and says nothing.
        previous = (time, in_run if matches is None else matches)
    return [run[0] + hold for run in runs if run[-1] - run[0] >= hold]


@given(STREAMS, HOLDS, st.lists(st.integers(0, 200).map(lambda n: n * S // 2), max_size=8))
def test_however_the_stream_is_cut_a_rule_fires_at_the_same_times(
    stream: Stream, hold: int, cuts: list[int]
) -> None:
    assert fired(stream, hold, cuts) == expected(stream, hold)


@given(STREAMS, HOLDS, st.lists(st.integers(0, 200).map(lambda n: n * S // 2), max_size=8))
def test_on_a_latched_topic_a_value_holds_until_the_next_one(
    stream: Stream, hold: int, cuts: list[int]
) -> None:
    end = 500 * S
    known = [each for each in stream if each[1] is not None]
    times, begun = [], None
    for time, value in [*known, (end, None)]:
        if begun is not None and time - begun >= hold and (value is not True or time == end):
            times.append(begun + hold)
        if value is False:
            begun = None
        elif value and begun is None:
            begun = time
    assert fired(stream, hold, cuts, latched=True, end=end) == times


@given(st.lists(st.integers(1, 30), max_size=20), st.lists(st.integers(0, 400), max_size=8))
def test_a_silence_fires_once_and_again_after_the_topic_spoke(
    pauses: list[int], cuts: list[int]
) -> None:
    hold, end = 9 * S, 1000 * S
    times = [sum(pauses[: n + 1]) * S for n in range(len(pauses))]
    found: list[int] = []
    runs: dict[str, RunRecord] = {}
    left = times
    for until in (*sorted(cut * S for cut in cuts), end):
        watched = rule(hold=hold, **SILENT)
        for time in [each for each in left if each < until]:
            fire = watched.take(runs, "/bumper", time, matches=False)
            found += [] if fire is None else [fire.at]
        left = [each for each in left if each >= until]
        found += [each.at for each in watched.reach(runs, until)]
    gaps = zip(times, [*times[1:], end], strict=True) if times else ()
    assert found == [last + hold for last, after in gaps if after - last >= hold]


@pytest.mark.parametrize("latched", [True, False])
def test_a_clock_that_was_set_back_ends_what_goes_on(*, latched: bool) -> None:
    watched, runs = rule(hold=5 * S), dict[str, RunRecord]()
    assert watched.take(runs, "/bumper", 100 * S, matches=True, latched=latched) is None
    assert watched.take(runs, "/bumper", 50 * S, matches=True, latched=latched) is None
    fire = watched.take(runs, "/bumper", 55 * S, matches=True, latched=latched)
    assert fire is not None
    assert fire.at == 55 * S
