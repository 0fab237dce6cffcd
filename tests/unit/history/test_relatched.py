"""Messages that a new recording received again count once, whatever the catalogue knows."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.scan import pick
from ros2_memory.history.view import TimeRange, View
from ros2_memory.index import timeline
from ros2_memory.insights.recap import recap
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, log_entry, odom, write_mcap
from tests.support.examples import examples
from tests.support.memories import memory_of, with_store

if TYPE_CHECKING:
    from collections.abc import Sequence


S = 10**9
TOPIC = "/rosout"
LAYOUT = McapLayout(latched=frozenset({TOPIC}))
SPLIT = 10 * S

Stored = tuple[int, int, str, int]
"""Log time, publish time, text, and the number of the recording."""


def write_recordings(root: Path, draw: random.Random, *, stamped: bool = True) -> list[Stored]:
    """Recordings one after the other, each of which begins with messages received again.

    Where they are not stamped, all were published at 0, as some bridges have it: when is unknown.
    """
    stored: list[Stored] = []
    published: list[tuple[int, str]] = []
    at = 1_000 * S
    for number in range(draw.randint(2, 4)):
        messages: list[tuple[int, int, str]] = []
        start = at
        again = draw.sample(published, min(len(published), draw.choice([0, 1, 5, 12])))
        for nth, (was, said) in enumerate(sorted(again)):
            messages.append((start + S + nth * 10**6, was, said))
        for _ in range(draw.randint(3, 25)):
            at += draw.choice([S // 5, S, 4 * S])
            said = draw.choice(["ready", "blocked", "lost"])
            messages.append((at, at if stamped else 0, said))
            published.append((at if stamped else 0, said))
        if draw.random() < 0.3 and again:  # a publisher that was lost for a while
            was, said = draw.choice(again)
            messages.append((at + S, was, said))
        at = max(at, *(each[0] for each in messages))
        for log_time, was, said in sorted(messages):
            stored.append((log_time, was or log_time, said, number))
        write_splits(root / f"rec{number}", sorted(messages), start, at)
        at += draw.choice([5, 60, 400]) * S
    return stored


def write_splits(
    folder: Path, messages: Sequence[tuple[int, int, str]], start: int, stop: int
) -> None:
    for nth, begin in enumerate(range(start, stop + 1, SPLIT)):
        inside = [
            replace(said(log_time, text, was), log_time=log_time, publish_time=was)
            for log_time, was, text in messages
            if begin <= log_time < begin + SPLIT
        ]
        poses = [odom(begin, 0.0, 0.0), odom(min(begin + SPLIT - 1, stop), 1.0, 0.0)]
        write_mcap(folder / f"{folder.name}_{nth}.mcap", [*inside, *poses], LAYOUT)


def said(log_time: int, text: str, was: int) -> Msg:
    return log_entry(was, 40 if text == "lost" else 20, "nav", text)


def once(stored: Sequence[Stored]) -> list[Stored]:
    """The messages that count, by a look at each pair: not where another recording was first."""
    return [
        each
        for each in stored
        if each[0] - each[1] <= S
        or min(other for other in stored if other[1:3] == each[1:3])[3] == each[3]
    ]


def texts(memory: Memory, window: TimeWindow) -> list[tuple[int, int]]:
    stream = View(memory, Call()).stream
    return [(each.time, each.record.publish_time) for each in stream.messages([TOPIC], window)]


def picked(memory: Memory, window: TimeWindow) -> list[int]:
    total, chosen = pick(View(memory, Call()), TOPIC, window, 10_000)
    times = [each.time for each in chosen]
    assert len(times) == total
    return times


@settings(
    max_examples=examples(12),
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(seed=st.integers(0, 10**6), part=st.sampled_from([0.0, 0.5, 1.0]), stamped=st.booleans())
@example(seed=3, part=1.0, stamped=True)
def test_each_message_counts_once_whatever_the_catalogue_knows(
    seed: int, part: float, *, stamped: bool
) -> None:
    draw = random.Random(seed)
    with TemporaryDirectory() as folder:
        root = Path(folder)
        stored = write_recordings(root, draw, stamped=stamped)
        counted = once(stored)
        memory = with_store(memory_of(root, reader=McapReader()), root, part=part)
        edges = sorted(draw.choice(stored)[0] + draw.choice([0, 1]) for _ in range(2))
        for window in (TimeWindow.everything(), TimeWindow(edges[0], edges[1] + 1)):
            inside = [each for each in counted if window.contains(each[0])]
            assert texts(memory, window) == [each[:2] for each in inside]
            assert picked(memory, window) == [each[0] for each in inside]
        [census] = View(memory, Call()).census(TOPIC).values()
        assert (census.first, census.last, census.count) == (
            counted[0][0],
            counted[-1][0],
            len(counted),
        )
        last = View(memory, Call()).stream.newest(TOPIC, TimeWindow.everything())
        assert last is not None
        assert last.time == counted[-1][0]


@settings(max_examples=examples(6), deadline=None)
@given(seed=st.integers(0, 10**6), part=st.sampled_from([0.0, 1.0]))
def test_what_was_counted_before_is_right_after_bags_come_and_go(seed: int, part: float) -> None:
    draw = random.Random(seed)
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr(timeline, "SEGMENT_BAGS", 2)
        root, aside = Path(folder) / "bags", Path(folder) / "aside"
        write_recordings(root, draw)
        aside.mkdir()
        bags = sorted(root.glob("*/*.mcap"), key=lambda each: (each.parent, int(each.stem[5:])))
        for bag in bags[-3:]:
            bag.rename(aside / bag.name)
        memory = with_store(memory_of(root, reader=McapReader()), root, part=part)

        def check() -> None:
            census = View(memory, Call()).census(TOPIC)
            found = texts(memory, TimeWindow.everything())
            assert sum(each.count for each in census.values()) == len(found)
            fresh = memory_of(root, reader=McapReader())
            assert found == texts(fresh, TimeWindow.everything())
            assert census == View(fresh, Call()).census(TOPIC)

        check()
        for bag in bags[-3:]:
            (aside / bag.name).rename(bag)
            check()
        for bag in bags[:3]:
            bag.unlink()
            check()


def test_what_was_an_original_no_longer_matters_once_its_recording_is_gone(tmp_path: Path) -> None:
    """No joined answer outlives the bags that it depends on."""
    write_splits(tmp_path / "a", [(1_001 * S, 1_001 * S, "lost")], 1_000 * S, 1_005 * S)
    write_splits(
        tmp_path / "b",
        [(2_001 * S, 1_001 * S, "lost"), (2_120 * S, 2_120 * S, "lost")],
        2_000 * S,
        2_125 * S,
    )
    memory = with_store(memory_of(tmp_path, reader=McapReader()), tmp_path)

    def errors() -> list[int]:
        events = recap(memory, Call(), TimeRange(0.0, 1e5)).events
        return [each.start // S for each in events if each.kind == "error"]

    before = errors()
    (tmp_path / "a" / "a_0.mcap").unlink()
    memory.index.refresh()
    assert (before, errors()) == ([1_001], [2_001])
