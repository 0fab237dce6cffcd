"""With a store of columns every question is answered as without one."""

from __future__ import annotations

import random
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from ros2_memory import queries
from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.columns.scanner import Scanner
from ros2_memory.core.errors import EpisodicError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MIN_NS
from ros2_memory.history import reverse_search
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.history.view import AtTime, TimeRange, View
from ros2_memory.index import timeline
from ros2_memory.insights.recap import recap, recap_or_before
from ros2_memory.insights.sightings import find_matches
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.examples import LONG, examples
from tests.support.memories import memory_of, with_store
from tests.support.random_histories import MS, S, write_history

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from random import Random

    import pytest

    from ros2_memory.core.model import JsonValue


Question = tuple[str, "Callable[[Memory, Call], object]"]

SEARCHES: list[tuple[str, str, JsonValue]] = [
    ("/odom", "near_position", {"x": 0.5, "y": 0.5}),
    ("/odom", "above", 0.9),
    ("/vision/*", "contains", "cup"),
]
SEGMENT = timeline.SEGMENT_BAGS
EXAMPLES = 200 if LONG else 5
"""Histories for each clock, others in every run; some dozens of questions are asked of each."""


def questions(moments: list[int], draw: Random) -> Iterator[Question]:
    yield "topics", queries.list_recorded_topics
    yield "range", queries.data_time_range
    yield "frames", queries.frames
    for topic, condition, value in SEARCHES:
        yield (
            f"last of {topic} {condition} {value}",
            partial(queries.find_last_match, topic=topic, condition_type=condition, value=value),
        )
    for at in [(each + draw.choice([0, S // 3])) / 1e9 for each in draw.sample(moments, 2)]:
        moment = AtTime(at_s=at)
        for topic in ("/odom", "/dock", "/mixed", "/status"):
            yield (
                f"{topic} at {at}",
                partial(queries.topic_value, topic=topic, moment=moment, tolerance_s=2.0),
            )
        yield f"position {at}", partial(queries.position, moment=moment)
        yield f"velocity {at}", partial(queries.velocity, moment=moment)
        for child in ("laser", "base_link"):
            yield (
                f"{child} {at}",
                partial(queries.transform, parent="odom", child=child, moment=moment),
            )
    most = min(moments) - 600 * S, max(moments) + 600 * S
    for first, last in (sorted(draw.sample(moments, 2)), (min(moments), max(moments)), most):
        span = TimeRange(start_s=first / 1e9, end_s=last / 1e9)
        for topic in ("/odom", "/chatter", "/dock"):
            yield (
                f"{topic} in {span}",
                partial(queries.topic_range, topic=topic, span=span, max_samples=5),
            )
            yield (
                f"way of {topic} in {span}",
                partial(queries.trajectory_summary, span=span, topic=topic),
            )
        yield f"recap of {span}", partial(recap, span=span)
        for topic, condition, value in SEARCHES:
            search = partial(find_matches, topic=topic, condition_type=condition, value=value)
            bounds = {"start_s": first / 1e9, "end_s": last / 1e9}
            yield f"{topic} {condition} {value} in {span}", partial(search, **bounds)
        at = draw.choice([first, last])
        around = TimeRange(around_s=at / 1e9, before_s=draw.choice([1.0, 10.0, 60.0]))
        yield f"before {around}", partial(recap_or_before, span=around)


def answer(memory: Memory, ask: Callable[[Memory, Call], object]) -> str:
    try:
        return repr(ask(memory, Call()))
    except EpisodicError as error:
        said = getattr(error, "reason", ""), str(error), getattr(error, "notes", ())
        return f"{type(error).__name__}: {said}"


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
        for asked, ask in questions(moments, draw):
            assert answer(recalled, ask) == answer(plain, ask), (seed, part, size, tick, asked)


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
                asked = View(memory, Call())
                assume(asked.snapshot.timeline.topics())  # not where each bag was spoilt
                topic = draw.choice(asked.snapshot.timeline.topics())
                window = TimeWindow(start, stop)
                first = View(memory, Call()).stream.first([topic], window, newest_first=True)
                assert asked.stream.newest(topic, window) == first, (seed, topic, window)
