"""What is forgotten is gone from every byte of the lake, and no late copy brings it back."""

import os
import shutil
from collections import Counter
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pyiceberg.avro.file import AvroFile
from pyiceberg.catalog.sql import SqlCatalog
from pyiceberg.io.pyarrow import PyArrowFileIO
from pyiceberg.table import Transaction
from pyiceberg.typedef import Record

from ros2_memory import cli
from ros2_memory.bag_dir.layout import FORGOTTEN_FILE
from ros2_memory.columns.store import FILE
from ros2_memory.core.errors import LakeError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.lake.shipper import Shipped
from ros2_memory.lake.tables import TABLES, unpacked_messages
from ros2_memory.lake.upkeep import (
    TOMBSTONES_FILE,
    Forgotten,
    Tombstone,
    append_tombstone,
    compact,
    expire,
    forget_in_lake,
    read_tombstones,
)
from ros2_memory.lake.warehouse import WRITTEN
from ros2_memory.storage.base import Channel, Schema
from tests.support.bags import Msg, detections, odom, text, write_mcap
from tests.support.clocks import FixedClock
from tests.support.fakes import broken
from tests.support.fleets import START_S
from tests.support.housekeepers import own_all
from tests.support.lakes import (
    LATER,
    lake_column,
    location,
    robot_bags,
    ship,
    ship_from,
    write_bag,
)

MARKER = "zyxwv-9876"
"""Short enough for the bounds of a column, which are cut after 16 characters."""
DAY_NS = 86_400 * NS_PER_S
CHANNEL = Channel("/any", "cdr", Schema("any"))


def secret_bag(bag_dir: Path, number: int = 7, *more: Msg) -> Path:
    first = (START_S + 10 * number) * NS_PER_S
    messages = [detections(first, [MARKER]), text(first + NS_PER_S, MARKER), *more]
    return write_mcap(bag_dir / "rec" / f"rec_{number}.mcap", messages)


TOMBSTONE = Tombstone("hall", (START_S + 70) * NS_PER_S, (START_S + 75) * NS_PER_S)


def forget(lake: Path, what: Tombstone) -> Forgotten:
    where = location(lake)
    with where.writable() as tables:
        return forget_in_lake(tables, what)


def ship_again(lake: Path) -> Shipped:
    """One pass of a process that knows what was forgotten."""
    known = {*read_tombstones(location(lake).state_dir)}
    return ship(lake, [robot_bags("hall", lake.parent / "hall")], tombstones=known)


def files_with(lake: Path, secret: str) -> list[Path]:
    """The files that hold a text, compressed or not, as what reads them sees it."""
    return [path for path in lake.rglob("*") if path.is_file() and secret in _content(path)]


def _content(path: Path) -> str:
    plain = path.read_bytes().decode("latin-1")
    if path.suffix == ".parquet":
        rows = pq.read_table(path, partitioning=None).to_pylist()
        packed = [row["packed"] for row in rows if "packed" in row]
        payloads = b"".join(unpacked_messages(each, CHANNEL).buffer for each in packed)
        return plain + str(rows) + payloads.decode("latin-1")
    if path.suffix == ".avro" and not path.name.startswith("snap-"):
        entries: AvroFile[Record]
        with AvroFile[Record](PyArrowFileIO().new_input(str(path))) as entries:
            return plain + "".join(repr(each._data) for each in entries)
    return plain


def test_what_is_forgotten_is_in_no_byte_of_the_lake_and_comes_back_with_no_copy(
    tmp_path: Path,
) -> None:
    bag_dir, lake = tmp_path / "hall", tmp_path / "lake"
    write_bag(bag_dir, 0)
    kept = secret_bag(bag_dir)
    late = shutil.copy(kept, tmp_path / "late.mcap")
    ship_from(tmp_path)
    suffixes = {path.suffix for path in files_with(lake, MARKER)}
    assert suffixes == {".parquet", ".avro"}  # so the scan finds it where it is
    kept.unlink()
    gone = forget(lake, TOMBSTONE)
    assert (gone.bags, gone.kept_by) == (1, ())
    assert files_with(lake, MARKER) == []
    assert len(lake_column(lake, "messages", "texts")) == 3
    shutil.copy(late, kept)
    done = ship_again(lake)
    assert done.bags == 0
    assert "forgotten" in done.problems[0]
    assert files_with(lake, MARKER) == []
    # Without the messages it comes again.
    write_mcap(kept, [text((START_S + 76) * NS_PER_S, "after")])
    assert ship_again(lake).bags == 1


@pytest.fixture
def shipped_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """A robot's bags in a lake, of which one has the marker."""
    bag_dir, lake = tmp_path / "hall", tmp_path / "lake"
    write_bag(bag_dir, 0)
    write_bag(bag_dir, 6)
    secret_bag(bag_dir, 7, odom((START_S + 72) * NS_PER_S, 0.0, 0.0))
    for path in bag_dir.rglob("*.mcap"):
        os.utime(path, (START_S, START_S))  # nobody writes it any more
    own_all(bag_dir)
    monkeypatch.setenv("MEMORY_BAG_DIR", str(bag_dir))
    monkeypatch.setenv("MEMORY_DEPLOYMENT", "robot")
    ship_from(tmp_path)
    assert files_with(lake, MARKER)
    return bag_dir, lake


def forget_on_robot(*more: str) -> int:
    start = START_S + 70
    return cli.main(["forget", "--yes", "--start", str(start), "--end", str(start + 5), *more])


def test_what_is_forgotten_on_the_robot_the_next_pass_takes_out_of_the_lake(
    shipped_robot: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    bag_dir, lake = shipped_robot
    assert forget_on_robot() == 0
    assert "next pass of ros2-memory ship" in capsys.readouterr().out
    done = ship_from(lake.parent)
    assert (done.forgotten, done.bags, done.problems) == (1, 0, [])
    assert files_with(lake, MARKER) == []
    assert len(lake_column(lake, "bags", "bag_id")) == 2
    # A bag of the same time that stayed is another one.
    write_bag(bag_dir, 8, at_s=START_S + 70)
    assert ship_again(lake).bags == 1


def test_what_is_forgotten_is_in_no_byte_of_the_columns_that_were_stored_to_ship_it(
    shipped_robot: tuple[Path, Path],
) -> None:
    """Also where the bag that had it was written again, and shares parts with others."""
    bag_dir, lake = shipped_robot
    cache = lake.parent / "cache" / FILE

    def ship_with_cache() -> Shipped:
        robot = robot_bags("hall", bag_dir, FixedClock(LATER), cache=[cache])
        return ship(lake.parent / "other", [robot], most_bags=100)

    assert ship_with_cache().bags == 3
    assert files_with(cache.parent, MARKER)
    [topic] = {str(topic) for topic in lake_column(lake, "sightings", "topic")}
    assert forget_on_robot("--topic", "/chatter", "--topic", topic) == 0
    assert files_with(cache.parent, MARKER)
    assert ship_with_cache().problems == []
    assert files_with(cache.parent, MARKER) == []
    assert len(lake_column(lake.parent / "other", "bags", "bag_id")) == 3


def test_columns_that_cannot_be_forgotten_are_named(tmp_path: Path) -> None:
    robot = robot_bags("hall", tmp_path / "hall", cache=[tmp_path / "cache" / FILE])
    assert robot.forget([]) == []
    assert robot.forget([TimeWindow(0, 1)]) == []
    (tmp_path / "hall").rmdir()
    [problem] = robot.forget([TimeWindow(0, 1)])
    assert "is not there: delete the cache folder" in problem
    # As a mount whose robot is gone: to look for it is an error.
    (tmp_path / "hall").symlink_to("x" * 300)
    assert robot.forget([TimeWindow(0, 1)]) == [problem]


def test_topics_forgotten_on_the_robot_leave_the_lake_and_the_rest_of_their_bag_comes_again(
    shipped_robot: tuple[Path, Path],
) -> None:
    bag_dir, lake = shipped_robot
    kept = bag_dir / "rec" / "rec_7.mcap"
    late = shutil.copy(kept, lake.parent / "late.mcap")
    [topic] = {str(topic) for topic in lake_column(lake, "sightings", "topic")}
    assert forget_on_robot("--topic", "/chatter", "--topic", topic) == 0
    done = ship_from(lake.parent)
    assert (done.forgotten, done.bags, done.problems) == (1, 1, [])
    assert len(lake_column(lake, "bags", "bag_id")) == 3
    assert files_with(lake, MARKER) == []
    shutil.copy(late, kept)
    assert any("rec_7" in problem for problem in ship_again(lake).problems)
    assert files_with(lake, MARKER) == []
    # Bags of that time without such a topic stay.
    cup = (START_S + 60) * NS_PER_S
    assert forget(lake, Tombstone("hall", cup, cup + 20 * NS_PER_S, (topic,))).bags == 1
    assert len(lake_column(lake, "bags", "bag_id")) == 2


def test_where_the_robot_cannot_write_it_down_the_lake_keeps_it_and_the_command_is_named(
    shipped_robot: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    (shipped_robot[0] / FORGOTTEN_FILE).mkdir()  # as on a read-only disk
    assert forget_on_robot() == 1
    told = capsys.readouterr().out
    assert f"--forget ROBOT --start {START_S + 70} --end {START_S + 73}`" in told


def test_a_list_of_what_was_forgotten_that_cannot_be_read_keeps_its_robot_from_being_shipped(
    tmp_path: Path,
) -> None:
    bag_dir, other = tmp_path / "hall", tmp_path / "kitchen"
    write_bag(bag_dir, 0)
    write_bag(other, 0)
    path = bag_dir / FORGOTTEN_FILE
    path.write_text('{"start": 1, "stop": 2}\n')
    done = ship(tmp_path / "lake", [robot_bags("hall", bag_dir), robot_bags("kitchen", other)])
    assert done.bags == 1
    assert "forgotten.jsonl: line 1" in done.problems[0]


def full_after(commits: int) -> AbstractContextManager[None]:
    left = iter(range(commits))
    return broken(SqlCatalog, "commit_table", where=lambda *_: next(left, None) is None)


def test_killed_while_shipping_and_while_forgetting_it_is_finished_later(tmp_path: Path) -> None:
    bag_dir, lake = tmp_path / "hall", tmp_path / "lake"
    write_bag(bag_dir, 0)
    ship_from(tmp_path)
    secret_bag(bag_dir)
    # Those commits succeed that come before: of tables with rows of the bag, besides `bags`.
    with full_after(4), pytest.raises(LakeError, match="No space left"):
        ship_from(tmp_path)
    # Its rows are there, but in `bags`.
    assert files_with(lake, MARKER)
    with full_after(3), pytest.raises(LakeError, match="No space left"):
        forget(lake, TOMBSTONE)
    assert tombstones(location(lake).state_dir) == [(TOMBSTONE, False)]
    assert forget(lake, TOMBSTONE).bags == 1
    assert tombstones(location(lake).state_dir) == [(TOMBSTONE, True)]
    assert files_with(lake, MARKER) == []


def test_a_tag_keeps_what_is_forgotten_and_is_named(tmp_path: Path) -> None:
    bag_dir, lake = tmp_path / "hall", tmp_path / "lake"
    secret_bag(bag_dir)
    ship_from(tmp_path)
    with location(lake).writable() as tables:
        table = tables.tables["messages"].refresh()
        snapshot = table.current_snapshot()
        assert snapshot is not None
        table.manage_snapshots().create_tag(snapshot.snapshot_id, "audit").commit()
    assert forget(lake, TOMBSTONE).kept_by == ("messages: audit",)
    assert files_with(lake, MARKER)


def test_files_of_others_and_young_ones_stay(tmp_path: Path) -> None:
    bag_dir, lake = tmp_path / "hall", tmp_path / "lake"
    write_bag(bag_dir, 0)
    ship_from(tmp_path)
    foreign = next(lake.rglob("messages/data/*/*/*.parquet")).with_name("foreign.parquet")
    foreign.write_bytes(b"of another program")
    write_bag(bag_dir, 0, most=2)
    ship_from(tmp_path)
    where = location(lake)
    files = {path for path in lake.rglob("*") if path.is_file()}
    now = max(each.at for each in WRITTEN.rows(where.state_dir)) + NS_PER_S
    with where.writable() as tables:
        assert expire(tables, now - DAY_NS) == 0
        assert {path for path in lake.rglob("*") if path.is_file()} == files
        assert expire(tables, now) > 10
    assert foreign.exists()
    assert len(lake_column(lake, "messages", "texts")) == 2


def test_a_closed_day_is_put_into_one_file_with_the_same_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That of all robots in one transaction; the day of one with few files stays as it is."""
    lake = tmp_path / "lake"
    monkeypatch.setattr("ros2_memory.lake.upkeep.FEW_FILES", 1)
    robots = {"hall": (2, 0), "roof": (1, 0), "wing": (2, 1), "yard": (2, 0)}
    for number in range(2):
        for robot, (bags, day) in robots.items():
            if number < bags:
                write_bag(tmp_path / robot, number, at_s=START_S + 86_400 * day + 10 * number)
        ship(lake, [robot_bags(robot, tmp_path / robot) for robot in robots])
    before = {name: lake_column(lake, name, "bag_id") for name in TABLES}
    values = lake_column(lake, "messages", "texts")
    with location(lake).writable() as tables:
        messages = tables.tables["messages"].refresh()
        versions = len(messages.snapshots())
        assert compact(tables, (START_S + 3600) * NS_PER_S) == 0
        assert compact(tables, (START_S + 3 * 86_400) * NS_PER_S) > 0
        files = Counter(task.file.partition[0] for task in messages.refresh().scan().plan_files())
        assert files == dict.fromkeys(robots, 1)
        # Of each day what was deleted, and what was written instead.
        assert len(messages.snapshots()) == versions + 4
        assert compact(tables, (START_S + 3 * 86_400) * NS_PER_S) == 0
    assert {name: lake_column(lake, name, "bag_id") for name in TABLES} == before
    assert lake_column(lake, "messages", "texts") == values


def test_what_another_program_writes_while_a_day_is_put_together_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lake, overwrite = tmp_path / "lake", Transaction.overwrite
    monkeypatch.setattr("ros2_memory.lake.upkeep.FEW_FILES", 1)
    for number in range(2):
        write_bag(tmp_path / "hall", number)
        ship_from(tmp_path)
    others: list[str] = []

    def overtaken(transaction: Transaction, rows: pa.Table, **how: Any) -> None:
        name = transaction._table.name()[-1]
        if name not in others:
            others.append(name)
            with location(lake).writable() as other:
                other.tables[name].append(rows.slice(0, 1))
        overwrite(transaction, rows, **how)

    before = {name: len(lake_column(lake, name, "bag_id")) for name in TABLES}
    monkeypatch.setattr(Transaction, "overwrite", overtaken)
    with location(lake).writable() as tables:
        assert compact(tables, (START_S + 3 * 86_400) * NS_PER_S) == len(others) > 1
        assert compact(tables, (START_S + 3 * 86_400) * NS_PER_S) == 0
    after = {name: len(lake_column(lake, name, "bag_id")) for name in TABLES}
    assert after == {name: rows + (name in others) for name, rows in before.items()}


def tombstones(state_dir: Path) -> list[tuple[Tombstone, bool]]:
    return [(row, row.done) for row in read_tombstones(state_dir)]


def test_a_damaged_tombstone_keeps_everything_from_being_shipped(tmp_path: Path) -> None:
    append_tombstone(tmp_path, TOMBSTONE, done=False)
    path = tmp_path / TOMBSTONES_FILE
    # A crash cut the last line short.
    path.write_text(path.read_text() + '{"robot": "ha')
    assert tombstones(tmp_path) == [(TOMBSTONE, False)]
    append_tombstone(tmp_path, TOMBSTONE, done=True)
    assert tombstones(tmp_path) == [(TOMBSTONE, True)]
    path.write_text('{"robot": 1}\n' + path.read_text())
    with pytest.raises(LakeError, match="line 1"):
        read_tombstones(tmp_path)
