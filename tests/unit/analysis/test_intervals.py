import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.analysis.intervals import (
    FLICKER_NS,
    SILENCE_NS,
    IntervalTable,
    VisibleInterval,
    united_tables,
    visible_in,
)
from ros2_memory.core.spans import united
from ros2_memory.core.timebase import NS_PER_S

Messages = list[tuple[int, dict[str, float | None]]]
"""Their times (ns), and the score of each label."""

MESSAGES = st.lists(
    st.tuples(
        st.sampled_from([0, 1, NS_PER_S, FLICKER_NS, FLICKER_NS + 1, SILENCE_NS, SILENCE_NS + 1]),
        st.dictionaries(
            st.sampled_from("abc"), st.sampled_from([None, -0.5, 0.2, 0.7, 0.71234, 88.0])
        ),
    ),
    min_size=1,
    max_size=30,
)


@st.composite
def histories(draw: st.DrawFn) -> Messages:
    """Messages with silences and equal times."""
    time, messages = 0, []
    for wait, labels in draw(MESSAGES):
        time += wait
        messages.append((time, labels))
    return messages


def watched(messages: Messages) -> IntervalTable:
    labels = sorted({label for _, labels in messages for label in labels})
    seen = [
        (nth, labels.index(label), score)
        for nth, (_, some) in enumerate(messages)
        for label, score in some.items()
    ]
    rows, codes = np.array([each[:2] for each in seen], np.int64).reshape(-1, 2).T
    scores = np.array([score for *_, score in seen], np.float64)
    times = np.array([time for time, _ in messages], np.int64)
    return visible_in(times, rows, codes, scores, labels)


def by_hand(messages: Messages) -> list[VisibleInterval]:
    """By the definition of an interval."""
    found: list[VisibleInterval] = []
    for label in "abc":
        rows: list[list[int]] = []  # places of the messages of each interval
        for nth, (time, labels) in enumerate(messages):
            if label not in labels:
                continue
            last = rows[-1][-1] if rows else nth
            apart = time - messages[last][0]
            if rows and (apart <= FLICKER_NS or (last == nth - 1 and apart <= SILENCE_NS)):
                rows[-1].append(nth)
            else:
                rows.append([nth])
        for row in rows:
            scores = [score for nth in row if (score := messages[nth][1][label]) is not None]
            best = max(scores, default=None)
            found.append(VisibleInterval(label, messages[row[0]][0], messages[row[-1]][0], best))
    return sorted(found, key=lambda each: (each.first, each.label))


@given(histories())
def test_a_thing_is_in_view_as_long_as_it_is_missed_for_a_moment_only(messages: Messages) -> None:
    seen, expected = watched(messages), by_hand(messages)
    rounded = [
        each._replace(best=None if each.best is None else round(each.best, 4)) for each in expected
    ]
    assert [*seen.intervals()] == rounded
    assert [*seen.scoring(0.7).intervals()] == [
        each for each in rounded if each.best is None or each.best >= 0.7
    ]


@given(st.lists(histories(), min_size=1, max_size=3))
def test_of_several_topics_a_thing_is_in_view_while_one_of_them_has_it(
    topics: list[Messages],
) -> None:
    seen = [watched(messages) for messages in topics]
    every = [interval for table in seen for interval in table.intervals()]
    together = [*united_tables(seen).intervals()]
    for label in "abc":
        found, spans = (
            [(each.first, each.last) for each in some if each.label == label]
            for some in (together, every)
        )
        assert found == united(spans, FLICKER_NS)
