"""What answers of a file that is still being written: all that is whole, and nothing else."""

from collections.abc import Iterator
from functools import cache
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.handover_file import Counting, Handover, Overlap, write_handover
from ros2_memory.core.model import BagState, TimeWindow
from ros2_memory.history.context import Call, Memory, QuerySettings
from ros2_memory.history.view import View
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, mcap_content, odom, set_mtime
from tests.support.clocks import SettableClock
from tests.support.mcap_surgery import spoil_chunk
from tests.support.memories import asked, each_way, memory_of, with_store

S = 10**9
T0 = 1_784_023_200 * S
TENTH = S // 10
LIVE = QuerySettings(include_active=True)
LAYOUTS = (
    McapLayout(chunk_size=4096, compression=CompressionType.ZSTD),
    McapLayout(chunk_size=4096),
    McapLayout(chunk_size=None),
)
EVERYTHING = TimeWindow.everything()
SCRATCH = TemporaryDirectory()


def driven(first: int, count: int, late: int = 0) -> list[Msg]:
    """Messages of a robot that drives 0.1 m in each tenth of a second, `late` in being logged."""
    return [
        odom(T0 + n * TENTH, n * 0.1, 0.0, log_time=T0 + n * TENTH + late)
        for n in range(first, first + count)
    ]


@cache
def split(layout: McapLayout) -> tuple[bytes, tuple[tuple[int, int], ...]]:
    """A closed split of 10 s, and of each of its chunks the end and the messages up to there."""
    content = mcap_content(driven(0, 100), layout)
    summary = make_reader(BytesIO(content)).get_summary()
    assert summary is not None
    ends, count = [], 0
    for chunk in summary.chunk_indexes:
        count += round((chunk.message_end_time - chunk.message_start_time) / TENTH) + 1
        ends.append((chunk.chunk_start_offset + chunk.chunk_length, count))
    return content, tuple(ends)


@cache
def closed(layout: McapLayout) -> Memory:
    """The memory over that split alone."""
    folder = Path(mkdtemp(dir=SCRATCH.name))
    (folder / "rec_0.mcap").write_bytes(split(layout)[0])
    return memory_of(folder)


class Tail:
    """A memory that answers from what is being written; the clock is that of the newest file."""

    def __init__(self, bag_dir: Path, **more: Any) -> None:
        self.bag_dir = bag_dir
        self.clock = SettableClock(T0)
        self.memory = memory_of(
            bag_dir, clock=self.clock, limits=LIVE, **{"include_active": True} | more
        )

    def write(self, name: str, content: bytes, at: int = 0) -> Path:
        """Has a file hold this, its inode unchanged, `at` nanoseconds after T0."""
        path = self.bag_dir / name
        path.parent.mkdir(exist_ok=True)
        with path.open("r+b" if path.exists() else "wb") as stream:
            stream.write(content)
            stream.truncate()
        self.clock.at = T0 + at
        set_mtime(path, T0 + at)
        return path

    def ticks(self, view: View | None = None) -> list[int]:
        """Which messages a question about all of time finds, by their publish times."""
        found = (view or View(self.memory, Call())).stream.messages(["/odom"], EVERYTHING)
        return [round((each.record.publish_time - T0) / TENTH) for each in found]

    def states(self) -> list[BagState]:
        return [bag.state for bag in self.memory.index.refresh().bags]

    def asked(self, name: str, **arguments: object) -> Any:
        return asked(self.memory, name, **arguments)


@pytest.fixture
def tail(tmp_path: Path) -> Tail:
    return Tail(tmp_path)


@given(st.sampled_from(LAYOUTS), st.data())
def test_wherever_the_file_ends_all_whole_chunks_answer_and_nothing_that_is_not_whole(
    layout: McapLayout, data: st.DataObject
) -> None:
    content, ends = split(layout)
    cut = data.draw(st.integers(0, len(content) - 1))
    with TemporaryDirectory() as folder:
        tail = Tail(Path(folder))
        tail.write("rec/rec_0.mcap", content[:cut], at=10 * S)
        ticks = tail.ticks()
        snapshot = tail.memory.index.snapshot()
        [aside] = snapshot.active
        assert ticks == list(range(len(ticks)))
        assert len(ticks) >= max((count for end, count in ends if end <= cut), default=0)
        assert [bag.state for bag in snapshot.bags] == [BagState.ACTIVE] * bool(ticks)
        assert aside.until == (T0 + (len(ticks) - 1) * TENTH if ticks else None)
        for tick in {*ticks[:1], *ticks[-1:]}:
            live = tail.asked("get_position_at", timestamp=T0 / S + tick / 10)
            whole = asked(closed(layout), "get_position_at", timestamp=T0 / S + tick / 10)
            assert live.pop("from_active") is True
            assert {**live, "notes": None} == {**whole, "notes": None}


@each_way
def test_what_is_amiss_inside_is_reported_before_the_split_closes(
    tail: Tail, recalls: bool
) -> None:
    content, ends = split(LAYOUTS[0])
    path = tail.write("rec/rec_0.mcap", content, at=10 * S)
    spoil_chunk(path, 1)
    tail.write("rec/rec_0.mcap", path.read_bytes()[: ends[3][0]], at=10 * S)
    if recalls:
        tail.memory = with_store(tail.memory, tail.bag_dir)
    reply = tail.asked("get_topic_in_range", topic="/odom", start=T0 / S, end=T0 / S + 10)
    assert reply["total"] == ends[3][1] - (ends[1][1] - ends[0][1])
    assert "rec/rec_0.mcap (left out: 1 damaged record" in str(reply["notes"])
    assert "crash" not in str(reply["notes"])


def growth() -> Iterator[tuple[str, bytes]]:
    """What two splits of a recording look like one after another: file by file, as it grows.

    The second one is there before the footer of the first.
    """
    first, second = (mcap_content(driven(at, 100), LAYOUTS[0]) for at in (0, 100))
    for cut in range(0, len(first), 4096):
        yield "rec/rec_0.mcap", first[:cut]
    yield "rec/rec_1.mcap", b""
    yield "rec/rec_0.mcap", first
    for cut in range(4096, len(second), 4096):
        yield "rec/rec_1.mcap", second[:cut]
    yield "rec/rec_1.mcap", second


def test_as_splits_grow_and_close_nothing_is_missing_and_nothing_doubled(tail: Tail) -> None:
    reach, closed = 0, 0
    for step, (name, content) in enumerate(growth()):
        held = View(tail.memory, Call())
        before = tail.ticks(held)
        tail.write(name, content, at=step * TENTH)
        # Whoever asked before sees what there was, even where the file has changed since.
        assert tail.ticks(held) == before == list(range(reach))
        now = tail.ticks()
        assert now == list(range(len(now)))
        assert len(now) >= reach
        reach = len(now)
        closed += tail.states().count(BagState.CLOSED)
    assert reach == 200
    assert tail.states() == [BagState.CLOSED] * 2
    assert closed > 2


def test_splits_that_overlap_while_one_recording_takes_over_count_once(tmp_path: Path) -> None:
    tail = Tail(tmp_path, reader=BagDirReader(McapReader()))
    old = mcap_content(driven(0, 80), LAYOUTS[0])
    new = mcap_content(driven(50, 80, late=100_000), LAYOUTS[0])
    tail.write("a/a_0.mcap", old[:-300], at=8 * S)
    tail.write("b/b_0.mcap", new[:-300], at=8 * S)
    assert tail.states() == [BagState.ACTIVE] * 2
    assert tail.ticks() == list(range(tail.ticks()[-1] + 1))
    write_handover(tmp_path / "b", Handover(state=Counting.PENDING, previous="a"))
    assert tail.ticks() == list(range(80))
    cut = T0 + 60 * TENTH
    write_handover(tmp_path / "a", Handover(next="b", counts_until=cut))
    write_handover(tmp_path / "b", Handover(previous="a", counts_from=cut))
    assert tail.ticks() == list(range(tail.ticks()[-1] + 1))


def test_what_the_older_of_two_recordings_has_yet_to_write_is_no_gap(tmp_path: Path) -> None:
    tail = Tail(tmp_path, reader=BagDirReader(McapReader()))
    old, chunks = split(LAYOUTS[0])
    new = mcap_content(driven(80, 80, late=100_000), LAYOUTS[0])
    behind, reach = max(chunk for chunk in chunks if chunk[1] < 80)
    tail.write("a/a_0.mcap", old[:behind], at=12 * S)
    tail.write("b/b_0.mcap", new[: len(new) * 9 // 10], at=12 * S)
    cut = T0 + 90 * TENTH
    write_handover(tmp_path / "a", Handover(next="b", counts_until=cut))
    begin = Overlap(None, None, ("b_0.mcap",))
    write_handover(tmp_path / "b", Handover(previous="a", counts_from=cut, begin=begin))
    missing = {"timestamp": T0 / S + 8.5, "tolerance_s": 0.2}
    within = {"topic": "/odom", "start": T0 / S + 8, "end": T0 / S + 8.8}
    assert tail.ticks() == [*range(reach), *range(90, tail.ticks()[-1] + 1)]
    for reply in (
        tail.asked("get_position_at", **missing),
        tail.asked("get_topic_in_range", **within),
    ):
        assert reply["reason"] == "not_closed_yet"
        assert reply["notes"] == ["still being written and not all on disk yet: a/a_0.mcap"]
        assert "again in 3 s" in reply["detail"]
    tail.write("a/a_0.mcap", old, at=12 * S)
    assert tail.asked("get_position_at", **missing)["x"] == pytest.approx(8.5)


def test_where_the_robot_was_2_s_ago_is_answered_and_says_from_what(tail: Tail) -> None:
    content, _ = split(LAYOUTS[0])
    tail.write("rec/rec_0.mcap", content, at=10 * S)
    later = mcap_content(driven(100, 100), LAYOUTS[0])
    tail.write("rec/rec_1.mcap", later[: len(later) * 6 // 10], at=12 * S)
    at = tail.memory.index.snapshot().latest
    assert at is not None
    tail.clock.at = at + 2 * S
    reply = tail.asked("get_position_seconds_ago", seconds_ago=2)
    assert reply["x"] == pytest.approx((at - T0) / S)
    assert reply["from_active"] is True
    assert "from_active" not in tail.asked("get_position_at", timestamp=T0 / S + 5)
    ranged = tail.asked("get_topic_in_range", topic="/odom", start=T0 / S, end=T0 / S + 5)
    assert "from_active" not in ranged


def test_past_what_is_on_disk_the_answer_says_where_that_ends(tail: Tail) -> None:
    tail.write("rec/rec_0.mcap", split(LAYOUTS[0])[0][:9000], at=5 * S)
    end = tail.memory.index.snapshot().latest
    assert end is not None
    sentence = f"nothing after {end / S:.6f} is on disk yet"
    tail.clock.at = end + 4 * S
    reply = tail.asked("get_position_seconds_ago", seconds_ago=1)
    assert (reply["reason"], reply["notes"]) == ("not_closed_yet", [sentence])
    assert "again in 3 s" in reply["detail"]
    assert "closes" not in reply["detail"]
    assert sentence in tail.asked("get_topic_in_last", topic="/odom", seconds=60)["notes"]
    before = (end - TENTH) / S
    inside = tail.asked("get_topic_in_range", topic="/odom", start=T0 / S, end=before)
    assert "notes" not in inside or sentence not in inside["notes"]


def test_a_first_split_of_which_nothing_is_on_disk_yet_is_no_empty_memory(tail: Tail) -> None:
    tail.write("rec/rec_0.mcap", b"", at=S)
    reply = tail.asked("get_position_seconds_ago", seconds_ago=1)
    detail = "nothing of the first split is on disk yet; ask again in 3 s"
    assert (reply["reason"], reply["detail"]) == ("not_closed_yet", detail)
