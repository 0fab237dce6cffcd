"""Readers in front of readers: what they leave alone is answered by the one beneath."""

from __future__ import annotations

from pathlib import Path

from ros2_memory.bag_dir.layered import LayeredReader
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.base import CdrLayout, Closing, Record
from tests.support.bags import odom, text
from tests.support.fakes import FakeReader

ASKED, OPEN, FULL = (Path(f"rec/rec_{n}.mcap") for n in range(3))
EVER = TimeWindow.everything()


class Fake(FakeReader):
    """Knows the layout of every message."""

    def __init__(self) -> None:
        super().__init__({"nav_msgs/msg/Odometry": "it is not wanted"})
        self.add(OPEN, [text(10, "open")], closing=Closing.OPEN)
        self.add(FULL, [text(1, "first"), text(2, "last"), odom(3, 0, 0)])

    def layout(self, record: Record) -> CdrLayout:
        return CdrLayout(len(record.payload), (), (), ())


class Elsewhere(LayeredReader):
    """Tells how one file is, and what another one holds."""

    def _looked_at(self, path: Path) -> Path:
        assert path == ASKED
        return OPEN

    def _read_from(self, path: Path) -> Path:
        assert path == ASKED
        return FULL


def test_how_a_file_is_and_what_it_holds_may_be_asked_of_two_files() -> None:
    reader = Elsewhere(Fake())
    assert reader.closing(ASKED) is Closing.OPEN
    assert reader.summarize(ASKED).count == 1
    assert [record.log_time for record in reader.records(ASKED, ["/chatter"], EVER)] == [1, 2]
    newest = reader.newest(ASKED, "/chatter", EVER)
    assert newest is not None
    assert newest.log_time == 2
    assert list(reader.log_times(ASKED, "/chatter", EVER)) == [1, 2]
    assert [channel.topic for channel in reader.channels(ASKED)] == ["/chatter", "/odom"]


def test_a_layer_that_adds_nothing_answers_as_the_reader_beneath() -> None:
    beneath = Fake()
    reader = LayeredReader(LayeredReader(beneath))
    assert [reader.reads(Path(name)) for name in ("a.mcap", "a.db3")] == [True, False]
    assert reader.closing(OPEN) is Closing.OPEN
    assert reader.summarize(FULL) == beneath.summarize(FULL)
    newest_first = reader.records(FULL, ["/chatter"], EVER, newest_first=True)
    assert [record.log_time for record in newest_first] == [2, 1]


def test_messages_are_understood_as_the_innermost_reader_does() -> None:
    beneath = Fake()
    reader = Elsewhere(LayeredReader(LayeredReader(beneath)))
    said, *_, driven = reader.records(ASKED, ["/chatter", "/odom"], EVER)
    assert reader.undecodable(said.channel) is None
    assert reader.undecodable(driven.channel) == "it is not wanted"
    assert getattr(reader.decode(said), "data", None) == "first"
    assert reader.layout(said) == beneath.layout(said)


def test_nothing_is_opened_before_the_first_message_is_asked_for() -> None:
    beneath = Fake()
    records = Elsewhere(beneath).records(ASKED, ["/chatter"], EVER)
    assert beneath.opened == []
    next(records)
    assert beneath.opened == [FULL]
