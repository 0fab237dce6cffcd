"""Many bags read as one history."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ros2_memory.core.errors import BagError
from ros2_memory.core.model import TimeWindow
from ros2_memory.history.context import Call
from ros2_memory.history.scan import pick
from ros2_memory.history.view import View
from ros2_memory.messages.to_json import evenly
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, boolean, odom, write_mcap
from tests.support.examples import examples
from tests.support.memories import memory_of

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from ros2_memory.storage.base import Record

T0 = 1_700_000_000 * 10**9
S = 10**9
MS = 10**6


def view_of(bag_dir: Path) -> View:
    return View(memory_of(bag_dir), Call())


def shifted(message: Msg, by: int) -> Msg:
    """The same message as another recording logged it."""
    return Msg(message.topic, message.type, message.log_time + by, message.body, message.published)


def recorded(
    bag_dir: Path, name: str, messages: list[Msg], *, latched: Collection[str] = ()
) -> Path:
    layout = McapLayout(latched=frozenset(latched))
    return write_mcap(bag_dir / name / f"{name}_0.mcap", messages, layout)


def times(view: View, topic: str, *, newest_first: bool = False) -> list[int]:
    found = view.stream.messages([topic], TimeWindow.everything(), newest_first=newest_first)
    return [each.time for each in found]


def test_a_copy_just_inside_a_window_whose_original_lies_outside_does_not_count(
    tmp_path: Path,
) -> None:
    original = odom(T0, 1.0, 0.0)
    recorded(tmp_path, "a", [original])
    recorded(tmp_path, "b", [shifted(original, 500_000), odom(T0 + S, 2.0, 0.0)])
    view = view_of(tmp_path)
    window = TimeWindow(T0 + 1, T0 + 2 * S)
    assert [each.time for each in view.stream.messages(["/odom"], window)] == [T0 + S]


def test_a_bag_that_fails_is_named_and_the_others_still_answer(tmp_path: Path) -> None:
    broken = recorded(tmp_path, "a", [odom(T0, 0, 0)])
    recorded(tmp_path, "b", [odom(T0 + 60 * S, 1, 0)])

    class Failing(McapReader):
        def records(
            self,
            path: Path,
            topics: Collection[str],
            window: TimeWindow,
            *,
            newest_first: bool = False,
        ) -> Iterator[Record]:
            if path == broken:
                raise BagError(str(path), "the disk returned an error")
            return super().records(path, topics, window, newest_first=newest_first)

    view = View(memory_of(tmp_path, reader=Failing()), Call())
    assert times(view, "/odom") == [T0 + 60 * S]
    [note] = view.notes.sentences()
    assert note == "a/a_0.mcap could not be read to its end: the disk returned an error"
    assert not view.notes.complete


@st.composite
def takeovers(draw: st.DrawFn) -> tuple[list[list[Msg]], list[int]]:
    """Recordings that take over from each other, and what they recorded, each message once."""
    gaps = draw(st.lists(st.integers(1, 400), min_size=1, max_size=60))
    published = [T0]
    for gap in gaps:
        published.append(published[-1] + gap * MS)
    recordings: list[list[Msg]] = []
    earliest: dict[int, int] = {}
    edges = sorted(draw(st.lists(st.integers(0, len(published)), min_size=1, max_size=3)))
    for start, stop in pairwise([0, *edges, len(published)]):
        reach = min(len(published), stop + draw(st.integers(0, 4)))
        messages = []
        for number in range(start, reach):
            late = draw(st.integers(0, 900)) * 1000
            messages.append(shifted(boolean(published[number], number % 3 == 0), late))
            known = earliest.get(number, published[number] + late)
            earliest[number] = min(known, published[number] + late)
        if messages:
            recordings.append(messages)
    return recordings, sorted(earliest.values())


@settings(
    max_examples=examples(60),
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(takeovers())
def test_every_message_counts_exactly_once_however_recordings_overlap(
    tmp_path_factory: pytest.TempPathFactory, case: tuple[list[list[Msg]], list[int]]
) -> None:
    recordings, expected = case
    bag_dir = tmp_path_factory.mktemp("bags")
    for number, messages in enumerate(recordings):
        recorded(bag_dir, f"r{number}", messages)
    view = view_of(bag_dir)
    assert times(view, "/bumper") == expected
    assert times(view, "/bumper", newest_first=True) == expected[::-1]
    assert view.census("/bumper")["std_msgs/msg/Bool"].count == len(expected)
    total, chosen = pick(view, "/bumper", TimeWindow.everything(), 8)
    assert total == len(expected)
    assert [each.time for each in chosen] == [expected[i] for i in evenly(total, 8)]
