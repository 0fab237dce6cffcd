"""Many bags read as one history."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ros2_memory.core.errors import BagError, QueryTimeoutError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import Deadline
from ros2_memory.history.context import Call
from ros2_memory.history.counting import pick
from ros2_memory.history.view import View
from ros2_memory.messages.to_json import evenly
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, boolean, odom, text, write_mcap
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


def test_splits_follow_each_other_by_time_and_not_by_name(tmp_path: Path) -> None:
    for split in (9, 10, 11):
        start = T0 + split * 10 * S
        write_mcap(
            tmp_path / "rec" / f"rec_{split}.mcap",
            [odom(start + n * S, n, 0.0) for n in range(10)],
        )
    seen = times(view_of(tmp_path), "/odom")
    assert len(seen) == 30
    assert seen == sorted(seen)
    assert times(view_of(tmp_path), "/odom", newest_first=True) == seen[::-1]


def test_a_message_in_two_overlapping_recordings_counts_once_at_its_earliest_time(
    tmp_path: Path,
) -> None:
    first = [odom(T0 + n * 50 * MS, n, 0.0) for n in range(100)]
    recorded(tmp_path, "a", first)
    second = [shifted(each, 24_000) for each in first[60:]]
    second += [odom(T0 + n * 50 * MS, n, 0.0) for n in range(100, 140)]
    recorded(tmp_path, "b", second)
    view = view_of(tmp_path)
    expected = [T0 + n * 50 * MS for n in range(140)]
    assert times(view, "/odom") == expected
    assert times(view, "/odom", newest_first=True) == expected[::-1]
    census = view.census("/odom")["nav_msgs/msg/Odometry"]
    assert (census.count, census.first, census.last) == (140, expected[0], expected[-1])
    total, chosen = pick(view, "/odom", TimeWindow.everything(), 1000)
    assert total == 140
    assert [each.time for each in chosen] == expected


def test_a_copy_just_inside_a_window_whose_original_lies_outside_does_not_count(
    tmp_path: Path,
) -> None:
    original = odom(T0, 1.0, 0.0)
    recorded(tmp_path, "a", [original])
    recorded(tmp_path, "b", [shifted(original, 500_000), odom(T0 + S, 2.0, 0.0)])
    view = view_of(tmp_path)
    window = TimeWindow(T0 + 1, T0 + 2 * S)
    assert [each.time for each in view.stream.messages(["/odom"], window)] == [T0 + S]


def test_alike_messages_inside_one_recording_are_not_copies(tmp_path: Path) -> None:
    recorded(tmp_path, "a", [boolean(T0, True), boolean(T0, True), boolean(T0 + S, True)])
    view = view_of(tmp_path)
    assert times(view, "/bumper") == [T0, T0, T0 + S]
    assert view.census("/bumper")["std_msgs/msg/Bool"].count == 3


def test_payload_alone_makes_no_copy(tmp_path: Path) -> None:
    recorded(tmp_path, "a", [boolean(T0 + n * S, True) for n in range(4)])
    recorded(tmp_path, "b", [boolean(T0 + n * S + 10 * MS, True) for n in range(4)])
    assert len(times(view_of(tmp_path), "/bumper")) == 8


def test_a_latched_message_received_again_counts_when_it_was_first_received(
    tmp_path: Path,
) -> None:
    docked = text(T0, "docked", "/dock")
    undocked = text(T0 + 700 * S, "undocked", "/dock")
    recorded(tmp_path, "a", [docked, odom(T0 + S, 0, 0)], latched=["/dock"])
    recorded(tmp_path, "b", [shifted(docked, 600 * S), undocked], latched=["/dock"])
    recorded(tmp_path, "c", [shifted(undocked, 500 * S)], latched=["/dock"])
    view = view_of(tmp_path)
    assert times(view, "/dock") == [T0, T0 + 700 * S]
    assert times(view, "/dock", newest_first=True) == [T0 + 700 * S, T0]
    found = view.stream.newest("/dock", TimeWindow.until(T0 + 650 * S))
    assert found is not None
    assert found.time == T0
    census = view.census("/dock")["std_msgs/msg/String"]
    assert (census.count, census.first, census.last) == (2, T0, T0 + 700 * S)
    assert pick(view, "/dock", TimeWindow.everything(), 10)[0] == 2


def test_where_the_first_copy_is_gone_the_next_one_counts(tmp_path: Path) -> None:
    docked = text(T0, "docked", "/dock")
    recorded(tmp_path, "b", [shifted(docked, 600 * S)], latched=["/dock"])
    recorded(tmp_path, "c", [shifted(docked, 1200 * S)], latched=["/dock"])
    assert times(view_of(tmp_path), "/dock") == [T0 + 600 * S]


def test_several_topics_are_one_stream(tmp_path: Path) -> None:
    recorded(
        tmp_path,
        "a",
        [text(T0 + n * S, str(n), "/a" if n % 2 else "/b") for n in range(10)],
    )
    found = list(view_of(tmp_path).stream.messages(["/a", "/b"], TimeWindow.everything()))
    assert [each.time for each in found] == [T0 + n * S for n in range(10)]


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


def test_a_bag_deleted_under_a_question_is_named(tmp_path: Path) -> None:
    gone = recorded(tmp_path, "a", [odom(T0, 0, 0)])
    recorded(tmp_path, "b", [odom(T0 + 60 * S, 1, 0)])
    view = view_of(tmp_path)
    gone.unlink()
    assert times(view, "/odom") == [T0 + 60 * S]
    assert view.notes.sentences() == ("a/a_0.mcap was deleted before it could be read",)


def test_a_question_past_its_deadline_gives_up(tmp_path: Path) -> None:
    recorded(tmp_path, "a", [odom(T0, 0, 0)])
    over = Deadline.after(0.0, monotonic=lambda: 5.0)
    view = View(memory_of(tmp_path), Call(over))
    with pytest.raises(QueryTimeoutError, match="shorter window"):
        view.stream.newest("/odom", TimeWindow.everything())


def test_picked_samples_are_evenly_spaced_over_the_messages_of_many_splits(
    tmp_path: Path,
) -> None:
    for split in range(5):
        write_mcap(
            tmp_path / "rec" / f"rec_{split}.mcap",
            [odom(T0 + (split * 20 + n) * S, n, 0.0) for n in range(20)],
        )
    total, chosen = pick(view_of(tmp_path), "/odom", TimeWindow(T0 + 3 * S, T0 + 98 * S), 7)
    assert total == 95
    assert [each.time for each in chosen] == [T0 + (3 + index) * S for index in evenly(95, 7)]


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
