"""What `storage/base.py` promises of a `BagReader`, checked with every adapter."""

from __future__ import annotations

import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.core.errors import (
    BagError,
    BagVanishedError,
    EpisodicError,
)
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.base import BagReader, Batch, Closing, Record
from tests.support.bags import Msg, boolean, odom, text, tf, transform
from tests.support.examples import examples
from tests.support.reader_cases import FILES, Shelf

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable


on_every_shelf = pytest.mark.parametrize("shelf", FILES, ids=str)

EVERYTHING = TimeWindow.everything()
STRING, BOOL = "std_msgs/msg/String", "std_msgs/msg/Bool"


class Seen(NamedTuple):
    """A record, or a message written, as far as every format keeps it."""

    topic: str
    type: str
    log_time: int
    payload: bytes


def seen(record: Record) -> Seen:
    return Seen(record.channel.topic, record.channel.type, record.log_time, record.payload)


def expected(
    messages: list[Msg], topics: Collection[str], window: TimeWindow | None = None
) -> list[Seen]:
    """By the contract: inside the window, by log time, ties in file order."""
    span = window or EVERYTHING
    wanted = [m for m in messages if m.topic in topics and span.start <= m.log_time < span.stop]
    return [
        Seen(m.topic, m.type, m.log_time, m.payload)
        for m in sorted(wanted, key=lambda message: message.log_time)
    ]


def read(
    reader: BagReader,
    path: Path,
    topics: Collection[str],
    window: TimeWindow | None = None,
    *,
    newest_first: bool = False,
) -> list[Seen]:
    span = window or EVERYTHING
    return [seen(r) for r in reader.records(path, topics, span, newest_first=newest_first)]


def batched(batches: Iterable[Batch]) -> list[Record]:
    """The messages of batches, by log time, ties by place."""
    found = [
        (int(batch.log_times[nth]), int(batch.places[nth]), batch.record(nth))
        for batch in batches
        for nth in range(batch.sizes.size)
    ]
    assert len({place for _, place, _ in found}) == len(found)
    return [record for _, _, record in sorted(found, key=itemgetter(0, 1))]


TOPICS = ("/a", "/b", "/c")
# Few distinct times, so that ties are common; drawn out of order.
_times = st.one_of(st.integers(0, 12), st.integers(10**18, 10**18 + 3))


@st.composite
def _messages(draw: st.DrawFn) -> list[Msg]:
    entries = draw(st.lists(st.tuples(st.sampled_from(TOPICS), _times, st.booleans()), max_size=30))
    return [
        boolean(time, place % 2 == 0, topic)
        if as_boolean
        else text(time, f"message {place}", topic)
        for place, (topic, time, as_boolean) in enumerate(entries)
    ]


_some_topics = st.sets(st.sampled_from((*TOPICS, "/not/recorded")))
_windows = st.tuples(st.integers(-1, 14), st.integers(-1, 14)).map(lambda ends: TimeWindow(*ends))


@on_every_shelf
@settings(max_examples=examples(30))
@given(messages=_messages(), topics=_some_topics, window=_windows)
def test_messages_come_by_log_time_and_newest_first_is_exactly_the_reverse(
    shelf: Shelf, messages: list[Msg], topics: set[str], window: TimeWindow
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        reader, path = shelf.stocked(Path(folder), messages)
        for span in (window, EVERYTHING):
            found = read(reader, path, topics, span)
            assert found == expected(messages, topics, span)
            assert read(reader, path, topics, span, newest_first=True) == found[::-1]
            for topic in TOPICS:
                newest = reader.newest(path, topic, span)
                last = expected(messages, [topic], span)[-1:]
                assert [seen(newest)] == last if newest is not None else not last


@on_every_shelf
@settings(max_examples=examples(30))
@given(messages=_messages(), topics=_some_topics, window=_windows, bare=_some_topics)
def test_batches_hold_the_messages_of_the_records_and_their_order(
    shelf: Shelf, messages: list[Msg], topics: set[str], window: TimeWindow, bare: set[str]
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        reader, path = shelf.stocked(Path(folder), messages)
        for span in (window, EVERYTHING):
            whole = batched(reader.batches(path, topics, span))
            assert whole == list(reader.records(path, topics, span))
            without = batched(reader.batches(path, topics, span, bare=bare))
            assert [record[:2] for record in without] == [record[:2] for record in whole]
            kept = [record for record in whole if record.channel.topic not in bare]
            assert [each for each in without if each.channel.topic not in bare] == kept


@on_every_shelf
def test_batches_of_one_buffer_follow_each_other_and_lie_inside_of_it(
    shelf: Shelf, tmp_path: Path
) -> None:
    messages = [text(time, f"{time:0100d}", TOPICS[time % 3]) for time in range(60)]
    reader, path = shelf.stocked(tmp_path, messages)
    batches = list(reader.batches(path, TOPICS, EVERYTHING))
    for batch in batches:
        assert batch.starts.min() >= 0
        assert (batch.starts + batch.sizes).max() <= len(batch.buffer)
    buffers = [id(batch.buffer) for batch in batches]
    assert [key for key, _ in groupby(buffers)] == list(dict.fromkeys(buffers))


@on_every_shelf
@settings(max_examples=examples(20))
@given(messages=_messages())
def test_a_summary_counts_what_the_messages_say(shelf: Shelf, messages: list[Msg]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        reader, path = shelf.stocked(Path(folder), messages)
        summary = reader.summarize(path)
    times: dict[tuple[str, str], list[int]] = {}
    for message in messages:
        times.setdefault((message.topic, message.type), []).append(message.log_time)
    found = {(t.topic, t.type): (t.count, t.first, t.last) for t in summary.topics}
    assert found == {key: (len(at), min(at), max(at)) for key, at in times.items()}
    assert len(summary.topics) == len(found)
    assert summary.complete
    assert summary.notes == ()


@on_every_shelf
def test_topics_without_messages_are_declared_and_silent(shelf: Shelf, tmp_path: Path) -> None:
    silent = [("/quiet", STRING), ("/still", BOOL)]
    reader, path = shelf.stocked(tmp_path, [text(1, "x")], declared=silent)
    summary = reader.summarize(path)
    assert [topic.topic for topic in summary.topics] == ["/chatter"]
    assert summary.silent == ("/quiet", "/still")
    channels = reader.channels(path)
    assert {(c.topic, c.type) for c in channels} == {("/chatter", STRING), *silent}
    assert read(reader, path, ["/quiet"]) == []


@on_every_shelf
def test_a_topic_offered_as_transient_local_is_latched(shelf: Shelf, tmp_path: Path) -> None:
    static = tf(1, transform(1, "base_link", "laser", (0.1, 0.0, 0.2)), topic="/tf_static")
    reader, path = shelf.stocked(tmp_path, [static, odom(2, 0.0, 0.0)])
    assert {t.topic: t.latched for t in reader.summarize(path).topics} == {
        "/tf_static": True,
        "/odom": False,
    }
    assert {c.topic: c.latched for c in reader.channels(path)} == {
        "/tf_static": True,
        "/odom": False,
    }


@on_every_shelf
def test_publish_times_are_kept_where_the_format_keeps_them(shelf: Shelf, tmp_path: Path) -> None:
    messages = [odom(5, 0.0, 0.0, log_time=7), odom(6, 0.0, 0.0, log_time=9)]
    reader, path = shelf.stocked(tmp_path, messages)
    records = list(reader.records(path, ["/odom"], EVERYTHING))
    published = [5, 6] if shelf.keeps_publish_time else [7, 9]
    assert [(r.log_time, r.publish_time) for r in records] == list(
        zip([7, 9], published, strict=True)
    )


@on_every_shelf
def test_a_bag_that_is_gone_has_vanished_for_every_question(shelf: Shelf, tmp_path: Path) -> None:
    reader, path = shelf.stocked(tmp_path, [text(1, "x")])
    list(reader.records(path, ["/chatter"], EVERYTHING))
    path.unlink()
    lazy = reader.records(path, ["/chatter"], EVERYTHING)
    lazy_batches = reader.batches(path, ["/chatter"], EVERYTHING)
    questions = (
        lambda: next(lazy),
        lambda: next(lazy_batches),
        lambda: reader.summarize(path),
        lambda: reader.closing(path),
        lambda: reader.channels(path),
    )
    for question in questions:
        with pytest.raises(BagVanishedError) as caught:
            question()
        assert caught.value.path == str(path)


@on_every_shelf
def test_what_is_no_bag_counts_as_closed_and_its_fault_is_reported(
    shelf: Shelf, tmp_path: Path
) -> None:
    reader, path = shelf.stocked(tmp_path, [text(1, "x")])
    path.write_bytes(b"FROM ros:jazzy\nRUN true\n" * 30)
    assert reader.closing(path) is Closing.CLOSED
    questions = (
        lambda: reader.summarize(path),
        lambda: reader.channels(path),
        lambda: list(reader.records(path, ["/chatter"], EVERYTHING)),
        lambda: list(reader.batches(path, ["/chatter"], EVERYTHING)),
    )
    for question in questions:
        with pytest.raises(BagError) as caught:
            question()
        assert not isinstance(caught.value, BagVanishedError)
        assert caught.value.path == str(path)
        assert caught.value.reason


@on_every_shelf
def test_an_empty_file_is_open_and_nothing_had_reached_the_disk(
    shelf: Shelf, tmp_path: Path
) -> None:
    reader, path = shelf.stocked(tmp_path, [])
    path.write_bytes(b"")
    assert reader.closing(path) is Closing.OPEN
    with pytest.raises(BagError, match="empty file: nothing had reached the disk"):
        reader.summarize(path)


@on_every_shelf
@pytest.mark.parametrize("make", [os.mkdir, os.mkfifo])
def test_a_folder_or_a_pipe_in_place_of_a_bag_is_an_error_that_names_it(
    shelf: Shelf, tmp_path: Path, make: Callable[[Path], None]
) -> None:
    path = tmp_path / f"odd{shelf.suffix}"
    make(path)
    with pytest.raises(BagError, match="not a regular file"):
        shelf.make_reader().summarize(path)
    with pytest.raises(EpisodicError):
        shelf.make_reader().closing(path)


@on_every_shelf
def test_a_bag_deleted_while_it_is_read_still_answers_to_the_end(
    shelf: Shelf, tmp_path: Path
) -> None:
    messages = [text(time, f"{time:0100d}") for time in range(50)]
    reader, path = shelf.stocked(tmp_path, messages)
    records = reader.records(path, ["/chatter"], EVERYTHING)
    first = seen(next(records))
    path.unlink()
    assert [first, *map(seen, records)] == expected(messages, ["/chatter"])


@on_every_shelf
def test_a_bag_rewritten_in_place_is_read_anew(shelf: Shelf, tmp_path: Path) -> None:
    reader, path = shelf.stocked(tmp_path, [text(1, "old")])
    assert reader.summarize(path).count == 1
    path.unlink()
    later = [text(2, "new"), text(3, "newer")]
    shelf.write(path, later, ())
    assert reader.summarize(path).count == 2
    assert read(reader, path, ["/chatter"]) == expected(later, ["/chatter"])


@on_every_shelf
def test_threads_that_read_at_once_all_get_the_same(shelf: Shelf, tmp_path: Path) -> None:
    messages = [text(time, f"{time:0100d}", TOPICS[time % 3]) for time in range(60)]
    reader, path = shelf.stocked(tmp_path, messages)

    def ask(turn: int) -> list[Seen]:
        return read(reader, path, TOPICS, newest_first=turn % 2 == 1)

    with ThreadPoolExecutor(max_workers=4) as pool:
        answers = list(pool.map(ask, range(16)))
    whole = expected(messages, TOPICS)
    assert answers == [whole if turn % 2 == 0 else whole[::-1] for turn in range(16)]


@on_every_shelf
def test_kinds_are_judged_by_name_alone(shelf: Shelf) -> None:
    reader = shelf.make_reader()
    assert reader.reads(Path(f"/nowhere/bag{shelf.suffix}"))
    for name in ("metadata.yaml", "bag.mcap.part", "bag.zstd", "mcap", ".mcap", ".db3.zstd"):
        assert not reader.reads(Path("/nowhere") / name), name
