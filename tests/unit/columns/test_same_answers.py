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
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.history.view import AtTime, TimeRange, View
from ros2_memory.index import timeline
from ros2_memory.insights.recap import recap, recap_or_before
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, boolean, odom, write_mcap
from tests.support.examples import LONG, examples
from tests.support.memories import memory_of, with_store
from tests.support.random_histories import S, write_history

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from random import Random

    import pytest


Question = tuple[str, "Callable[[Memory, Call], object]"]

EXAMPLES = 200 if LONG else 10
"""Histories for each clock, others in every run; some dozens of questions are asked of each."""


def questions(moments: list[int], draw: Random) -> Iterator[Question]:
    yield "topics", queries.list_recorded_topics
    yield "range", queries.data_time_range
    yield "frames", queries.frames
    for at in [(each + draw.choice([0, S // 3])) / 1e9 for each in draw.sample(moments, 2)]:
        moment = AtTime(at_s=at)
        for topic in ("/odom", "/dock", "/mixed", "/status"):
            yield f"{topic} at {at}", partial(_value, topic, moment)
        yield f"position {at}", partial(_position, moment)
        yield f"velocity {at}", partial(_velocity, moment)
        for child in ("laser", "base_link"):
            yield f"{child} {at}", partial(_transform, child, moment)
    most = min(moments) - 600 * S, max(moments) + 600 * S
    for first, last in (sorted(draw.sample(moments, 2)), (min(moments), max(moments)), most):
        span = TimeRange(start_s=first / 1e9, end_s=last / 1e9)
        for topic in ("/odom", "/chatter", "/dock"):
            yield f"{topic} in {span}", partial(_range, topic, span)
            yield f"way of {topic} in {span}", partial(_way, topic, span)
        yield f"recap of {span}", partial(_recap, span)
        at = draw.choice([first, last])
        around = TimeRange(around_s=at / 1e9, before_s=draw.choice([1.0, 10.0, 60.0]))
        yield f"before {around}", partial(_before, around)


def _value(topic: str, moment: AtTime, memory: Memory, call: Call) -> object:
    return queries.topic_value(memory, call, topic, moment, tolerance_s=2.0)


def _position(moment: AtTime, memory: Memory, call: Call) -> object:
    return queries.position(memory, call, moment)


def _velocity(moment: AtTime, memory: Memory, call: Call) -> object:
    return queries.velocity(memory, call, moment)


def _transform(child: str, moment: AtTime, memory: Memory, call: Call) -> object:
    return queries.transform(memory, call, "odom", child, moment)


def _range(topic: str, span: TimeRange, memory: Memory, call: Call) -> object:
    return queries.topic_range(memory, call, topic, span, max_samples=5)


def _recap(span: TimeRange, memory: Memory, call: Call) -> object:
    return recap(memory, call, span)


def _before(span: TimeRange, memory: Memory, call: Call) -> object:
    return recap_or_before(memory, call, span)


def _way(topic: str, span: TimeRange, memory: Memory, call: Call) -> object:
    return queries.trajectory_summary(memory, call, span, topic=topic)


def answer(memory: Memory, ask: Callable[[Memory, Call], object]) -> str:
    try:
        return repr(ask(memory, Call()))
    except EpisodicError as error:
        said = getattr(error, "reason", ""), str(error), getattr(error, "notes", ())
        return f"{type(error).__name__}: {said}"


@settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    clock=st.sampled_from(["auto", "stamp"]),
    seed=st.integers(0, 2**32),
    part=st.sampled_from([1.0, 1.0, 0.5]),
)
@example(clock="auto", seed=572545084, part=1.0)
@example(clock="stamp", seed=246, part=1.0)
@example(clock="auto", seed=11445, part=1.0)
def test_every_question_is_answered_as_without_a_store(clock: str, seed: int, part: float) -> None:
    draw = random.Random(seed)
    with TemporaryDirectory() as folder:
        bag_dir = Path(folder)
        moments = write_history(bag_dir, draw).moments
        limits = QuerySettings(tf_clock=clock)  # type: ignore[arg-type]
        plain = memory_of(bag_dir, reader=BagDirReader(McapReader()), limits=limits)
        recalled = with_store(plain, bag_dir, part=part)
        for asked, ask in questions(moments, draw):
            assert answer(recalled, ask) == answer(plain, ask), (seed, part, asked)


@settings(
    max_examples=EXAMPLES // 2,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
@given(seed=st.integers(0, 2**32), size=st.integers(1, 4))
def test_what_is_stored_of_many_bags_changes_no_answer(
    seed: int, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timeline, "SEGMENT_BAGS", size)
    draw = random.Random(seed)
    with TemporaryDirectory() as folder:
        bag_dir = Path(folder)
        moments = write_history(bag_dir, draw).moments
        plain = memory_of(bag_dir, reader=BagDirReader(McapReader()))
        filling = with_store(plain, bag_dir)
        assert filling.columns is not None
        # As another process: nothing is in memory.
        recalled = replace(plain, columns=Scanner(filling.columns.store, bag_dir))
        spans = [(min(moments), max(moments)), sorted(draw.sample(moments, 2))]
        for first, last in spans:
            span = TimeRange(start_s=first / 1e9, end_s=last / 1e9)
            for what in (_recap, partial(_way, "/odom"), partial(_range, "/odom")):
                ask = partial(what, span)
                assert answer(recalled, ask) == answer(plain, ask), (seed, size, span)


@settings(max_examples=examples(30), deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**32))
def test_the_newest_message_is_the_first_of_the_stream_that_is_newest_first(seed: int) -> None:
    draw = random.Random(seed)
    with TemporaryDirectory() as folder:
        bag_dir = Path(folder)
        moments = write_history(bag_dir, draw).moments
        plain = memory_of(bag_dir, reader=BagDirReader(McapReader()))
        recalled = with_store(plain, bag_dir)
        for _ in range(60):
            stop = draw.choice(moments) + draw.choice([0, 1, 10**6])
            start = draw.choice([MIN_NS, stop - draw.choice([1, 10**8, 3 * 10**9, 10**11])])
            for memory in (plain, recalled):
                asked = View(memory, Call())
                assume(asked.snapshot.timeline.topics())  # not where each bag was spoilt
                topic = draw.choice(asked.snapshot.timeline.topics())
                window = TimeWindow(start, stop)
                first = View(memory, Call()).stream.first([topic], window, newest_first=True)
                assert asked.stream.newest(topic, window) == first, (seed, topic, window)


def test_a_latched_message_received_again_is_no_event_with_a_store_either(
    tmp_path: Path,
) -> None:
    """What one bag says of such a topic alone is not what counts in it."""
    layout = McapLayout(latched=frozenset({"/docked"}))
    first = [boolean(S, False, "/docked"), boolean(5 * S, True, "/docked")]
    write_mcap(tmp_path / "a" / "a_0.mcap", first, layout)
    again = [
        replace(each, log_time=600 * S + n, publish_time=each.log_time)
        for n, each in enumerate(first)
    ]
    write_mcap(
        tmp_path / "b" / "b_0.mcap", [odom(600 * S, 0, 0), *again, odom(601 * S, 0, 0)], layout
    )
    plain = memory_of(tmp_path)
    recalled = with_store(plain, tmp_path)
    told = [
        recap(memory, Call(), TimeRange(start_s=600.0, end_s=610.0)) for memory in (plain, recalled)
    ]
    assert told[0] == told[1]
    assert told[0].events == ()
    flipped = recap(recalled, Call(), TimeRange(start_s=0.0, end_s=610.0)).events
    assert [each.start for each in flipped if each.kind == "flip"] == [5 * S]
