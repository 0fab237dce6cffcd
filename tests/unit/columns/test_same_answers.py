"""With a store of columns every question is answered as without one."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.columns.scanner import Scanner
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MIN_NS
from ros2_memory.history import reverse_search
from ros2_memory.history.context import Call, QuerySettings
from ros2_memory.history.view import View
from ros2_memory.index import timeline
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.examples import LONG, examples
from tests.support.memories import asked, assert_same_counts, memory_of, with_store
from tests.support.random_histories import MS, S, write_history
from tests.unit.history.test_any_cut import questions

if TYPE_CHECKING:
    import pytest


SEGMENT = timeline.SEGMENT_BAGS
EXAMPLES = 200 if LONG else 5
"""Histories for each clock, others in every run; some dozens of questions are asked of each."""


@settings(
    max_examples=EXAMPLES,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
@given(
    clock=st.sampled_from(["auto", "stamp"]),
    seed=st.integers(0, 2**32),
    part=st.sampled_from([1.0, 1.0, 0.5]),
    size=st.sampled_from([1, 2, 4, SEGMENT]),
    share=st.sampled_from([1.0, 0.0]),
    anew=st.booleans(),
    tick=st.sampled_from([MS, MS, 5 * S]),
)
@example(clock="auto", seed=572545084, part=1.0, size=SEGMENT, share=1.0, anew=False, tick=MS)
@example(clock="stamp", seed=246, part=1.0, size=SEGMENT, share=1.0, anew=False, tick=MS)
@example(clock="auto", seed=36354, part=1.0, size=1, share=1.0, anew=False, tick=MS)
@example(clock="auto", seed=11445, part=1.0, size=SEGMENT, share=1.0, anew=False, tick=MS)
def test_every_question_is_answered_as_without_a_store(
    clock: str,
    seed: int,
    part: float,
    size: int,
    share: float,
    tick: int,
    monkeypatch: pytest.MonkeyPatch,
    *,
    anew: bool,
) -> None:
    monkeypatch.setattr(timeline, "SEGMENT_BAGS", size)
    monkeypatch.setattr(reverse_search, "MOST_UNSURE", 1)
    draw = random.Random(seed)
    with TemporaryDirectory() as folder:
        bag_dir = Path(folder)
        moments = write_history(bag_dir, draw, tick).moments
        limits = QuerySettings(tf_clock=clock)  # type: ignore[arg-type]
        plain = memory_of(bag_dir, reader=BagDirReader(McapReader()), limits=limits)
        recalled = with_store(plain, bag_dir, part=part, share=share)
        if anew:  # as another process: nothing is in memory
            recalled = replace(plain, scanner=Scanner(recalled.scanner.store, bag_dir))
        # Who fills a store reads all of a bag, and so knows of its damage earlier.
        monkeypatch.setattr(Scanner, "damaged_parts", lambda *_: [])
        topics = plain.index.snapshot().timeline.topics()
        for tool, given_ in questions(draw, topics, moments, most=25):
            expected = asked(plain, bag_dir, tool, **given_)
            assert_same_counts(asked(recalled, bag_dir, tool, **given_), expected, of_means=0.02)


@settings(max_examples=examples(30), deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32))
def test_the_newest_message_is_the_first_of_the_stream_that_is_newest_first(seed: int) -> None:
    draw = random.Random(seed)
    with TemporaryDirectory() as folder:
        bag_dir = Path(folder)
        moments = write_history(bag_dir, draw).moments
        plain = memory_of(bag_dir, reader=BagDirReader(McapReader()))
        recalled = with_store(plain, bag_dir)
        for _ in range(30):
            stop = draw.choice(moments) + draw.choice([0, 1, 10**6])
            start = draw.choice([MIN_NS, stop - draw.choice([1, 10**8, 3 * 10**9, 10**11])])
            for memory in (plain, recalled):
                view = View(memory, Call())
                assume(view.snapshot.timeline.topics())  # not where each bag was spoilt
                topic = draw.choice(view.snapshot.timeline.topics())
                window = TimeWindow(start, stop)
                first = View(memory, Call()).stream.first([topic], window, newest_first=True)
                assert view.stream.newest(topic, window) == first, (seed, topic, window)
