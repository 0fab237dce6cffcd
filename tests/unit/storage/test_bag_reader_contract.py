"""What `storage/base.py` promises of a `BagReader`, checked with every adapter."""

import os
import tempfile
from collections.abc import Collection, Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby
from operator import itemgetter
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.core.errors import BagError, BagVanishedError, EpisodicError
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.base import BagReader, Batch, Record
from tests.support.bags import Msg, boolean, odom, text, tf_of
from tests.support.examples import examples
from tests.support.reader_cases import FILES, Shelf

on_every_shelf = pytest.mark.parametrize("shelf", FILES, ids=str)

EVERYTHING = TimeWindow.everything()
MS = 10**6
STRING, BOOL = "std_msgs/msg/String", "std_msgs/msg/Bool"


def seen(record: Record) -> tuple[object, ...]:
    """A record as far as every format keeps it."""
    return record.channel.topic, record.channel.type, record.log_time, record.payload


def expected(
    messages: list[Msg], topics: Collection[str], span: TimeWindow = EVERYTHING
) -> list[tuple[object, ...]]:
    """By the contract: inside the window, by log time, ties in file order."""
    return [
        (each.topic, each.type, each.log_time, each.payload)
        for each in sorted(messages, key=lambda each: each.log_time)
        if each.topic in topics and span.start <= each.log_time < span.stop
    ]


def read(reader: BagReader, path: Path, topics: Collection[str]) -> list[tuple[object, ...]]:
    return [*map(seen, reader.records(path, topics, EVERYTHING))]


def batched(batches: Iterable[Batch]) -> list[Record]:
    """The messages of batches, by log time, ties by place.

    Batches of one buffer follow each other, and lie inside of it.
    """
    batches = [*batches]
    found = [
        (int(batch.log_times[nth]), int(batch.places[nth]), batch.record(nth))
        for batch in batches
        for nth in range(batch.sizes.size)
    ]
    for batch in batches:
        ends = batch.starts + batch.sizes
        assert batch.starts.min() >= 0
        assert ends.max() <= len(batch.buffer)
    buffers = [key for key, _ in groupby(id(batch.buffer) for batch in batches)]
    assert len(buffers) == len({*buffers})
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
@settings(max_examples=examples(40))
@given(messages=_messages(), topics=_some_topics, window=_windows, bare=_some_topics)
def test_records_batches_and_the_summary_hold_the_messages_in_their_order(
    shelf: Shelf, messages: list[Msg], topics: set[str], window: TimeWindow, bare: set[str]
) -> None:
    """By log time, ties in file order; newest first is exactly the reverse."""
    with tempfile.TemporaryDirectory() as folder:
        reader, path = shelf.stocked(Path(folder), messages)
        for span in (window, EVERYTHING):
            records = list(reader.records(path, topics, span))
            assert [*map(seen, records)] == expected(messages, topics, span)
            assert [*reader.records(path, topics, span, newest_first=True)] == records[::-1]
            for topic in TOPICS:
                newest = next(reader.records(path, [topic], span, newest_first=True), None)
                last = expected(messages, [topic], span)[-1:]
                assert [seen(newest)] == last if newest is not None else not last
            assert batched(reader.batches(path, topics, span)) == records
            without = batched(reader.batches(path, topics, span, bare=bare))
            assert [record[:2] for record in without] == [record[:2] for record in records]
            kept = [record for record in records if record.channel.topic not in bare]
            assert [each for each in without if each.channel.topic not in bare] == kept
        summary = reader.summarize(path)
    times: dict[tuple[str, str], list[int]] = {}
    for message in messages:
        times.setdefault((message.topic, message.type), []).append(message.log_time)
    found = {(t.topic, t.type): (t.count, t.first, t.last) for t in summary.topics}
    assert found == {key: (len(at), min(at), max(at)) for key, at in times.items()}
    assert len(summary.topics) == len(found)
    assert (summary.complete, summary.notes) == (True, ())


@on_every_shelf
def test_what_channels_declare_and_publish_times_are_kept(shelf: Shelf, tmp_path: Path) -> None:
    """Publish times where the format has them; a topic may have no message."""
    silent = [("/quiet", STRING), ("/still", BOOL)]
    messages = [
        tf_of(1, "base_link", "laser", (0.1, 0.0, 0.2), topic="/tf_static"),
        odom(5, 0.0, 0.0, log_time=7),
        odom(6, 0.0, 0.0, log_time=9),
    ]
    reader, path = shelf.stocked(tmp_path, messages, declared=silent)
    summary, channels = reader.summarize(path), reader.channels(path)
    assert summary.schema.silent == ("/quiet", "/still")
    assert {t.topic: t.latched for t in summary.topics} == {"/tf_static": True, "/odom": False}
    recorded = {(m.topic, m.type) for m in messages}
    assert {(c.topic, c.type) for c in channels} == {*recorded, *silent}
    assert [c.topic for c in channels if c.latched] == ["/tf_static"]
    records = reader.records(path, ["/odom", "/quiet"], EVERYTHING)
    published = [5, 6] if shelf.keeps_publish_time else [7, 9]
    assert [(r.log_time, r.publish_time) for r in records] == [*zip([7, 9], published, strict=True)]


@on_every_shelf
def test_a_pause_of_all_topics_is_found_wherever_its_messages_lie(
    shelf: Shelf, tmp_path: Path
) -> None:
    """And none where a slower topic goes on."""
    begin, off = 1_784_000_000_000, [(3000, 3700), (5000, 5400), (6000, 8000)]

    def beats(topic: str, period: int, *off: tuple[int, int]) -> list[Msg]:
        times = [at for at in range(0, 10_000, period) if not any(a < at < b for a, b in off)]
        return [boolean((begin + at) * MS, True, topic) for at in times]

    messages = [*beats("/fast", 20, *off, (1000, 2500)), *beats("/slow", 100, *off)]
    reader, path = shelf.stocked(tmp_path, sorted(messages, key=lambda each: each.log_time))
    assert reader.summarize(path).schema.pauses == tuple(
        ((begin + start) * MS, (begin + stop) * MS) for start, stop in (off[0], off[2])
    )


def refusals(reader: BagReader, path: Path) -> list[BagError]:
    """What each question about a bag that cannot be read raises."""
    found = []
    for question in (
        lambda: reader.summarize(path),
        lambda: reader.channels(path),
        lambda: next(reader.records(path, ["/chatter"], EVERYTHING)),
        lambda: next(reader.batches(path, ["/chatter"], EVERYTHING)),
    ):
        with pytest.raises(BagError) as caught:
            question()
        found.append(caught.value)
    assert {error.path for error in found} == {str(path)}
    return found


@on_every_shelf
def test_what_is_gone_has_vanished_and_what_is_no_bag_is_closed_and_its_fault_reported(
    shelf: Shelf, tmp_path: Path
) -> None:
    reader, path = shelf.stocked(tmp_path, [text(1, "x")])
    assert len(read(reader, path, ["/chatter"])) == 1
    path.unlink()
    assert all(isinstance(error, BagVanishedError) for error in refusals(reader, path))
    with pytest.raises(BagVanishedError):
        reader.is_finished(path)
    path.write_bytes(b"FROM ros:jazzy\nRUN true\n" * 30)
    assert reader.is_finished(path)
    for error in refusals(reader, path):
        assert not isinstance(error, BagVanishedError)
        assert error.reason
    other = tmp_path / "notes.txt"
    with pytest.raises(BagVanishedError):
        reader.is_finished(other)
    other.touch()
    assert reader.is_finished(other)
    path.write_bytes(b"")
    assert not reader.is_finished(path)
    with pytest.raises(BagError, match="empty file: nothing had reached the disk"):
        reader.summarize(path)


@on_every_shelf
def test_a_folder_or_a_pipe_in_place_of_a_bag_is_an_error_that_names_it(
    shelf: Shelf, tmp_path: Path
) -> None:
    folder, pipe = (tmp_path / f"{name}{shelf.suffix}" for name in ("folder", "pipe"))
    folder.mkdir()
    os.mkfifo(pipe)
    for path in (folder, pipe):
        with pytest.raises(BagError, match="not a regular file"):
            shelf.make_reader().summarize(path)
        with pytest.raises(EpisodicError):
            shelf.make_reader().is_finished(path)


@on_every_shelf
def test_a_bag_that_is_deleted_or_rewritten_meanwhile_is_read_to_its_end_and_anew(
    shelf: Shelf, tmp_path: Path
) -> None:
    messages = [text(time, f"{time:0100d}") for time in range(50)]
    reader, path = shelf.stocked(tmp_path, messages)
    assert reader.summarize(path).count == 50
    records = reader.records(path, ["/chatter"], EVERYTHING)
    first = seen(next(records))
    path.unlink()
    assert [first, *map(seen, records)] == expected(messages, ["/chatter"])
    later = [text(2, "new"), text(3, "newer")]
    shelf.write(path, later, ())
    assert reader.summarize(path).count == 2
    assert read(reader, path, ["/chatter"]) == expected(later, ["/chatter"])


@on_every_shelf
def test_threads_that_read_at_once_all_get_the_same(shelf: Shelf, tmp_path: Path) -> None:
    messages = [text(time, f"{time:0100d}", TOPICS[time % 3]) for time in range(60)]
    reader, path = shelf.stocked(tmp_path, messages)
    with ThreadPoolExecutor(max_workers=4) as pool:
        answers = [*pool.map(lambda _: read(reader, path, TOPICS), range(8))]
    assert answers == [expected(messages, TOPICS)] * 8


@on_every_shelf
def test_kinds_are_judged_by_name_alone(shelf: Shelf) -> None:
    reader = shelf.make_reader()
    assert reader.reads(Path(f"/nowhere/bag{shelf.suffix}"))
    for name in ("metadata.yaml", "bag.mcap.part", "bag.zstd", "mcap", ".mcap", ".db3.zstd"):
        assert not reader.reads(Path("/nowhere") / name), name
