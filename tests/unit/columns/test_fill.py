"""Which bags are stored, when, and for how long; nothing that is in doubt is."""

import os
import random
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import pytest

from ros2_memory.bag_dir.handover_file import Handover, Overlap, write_handover
from ros2_memory.bag_dir.layout import ERASING_FILE, HANDOVER_FILE
from ros2_memory.columns import decode, fill
from ros2_memory.columns.decode import Group, undecoded
from ros2_memory.columns.fill import StoreLimits
from ros2_memory.columns.forget import forget
from ros2_memory.columns.plan import Plan
from ros2_memory.columns.table import Table
from ros2_memory.columns.walk import LevelColumns, read_columns
from ros2_memory.columns.writing import ReadBag
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.storage.base import BagReader, Batch
from ros2_memory.storage.mcap import bulk
from tests.support.bags import McapLayout, odom, set_mtime, text, write_mcap
from tests.support.clocks import SettableClock
from tests.support.column_worlds import World, check_all, store_file, times

S = NS_PER_S
T0 = 1_700_000_400 * S
"""The begin of ten minutes."""


def write_bag(bag_dir: Path, number: int, *, rows: int = 20) -> Path:
    """A minute of a recording, of which the robot moves without any order."""
    start, draw = T0 + number * 60 * S, random.Random(number)
    messages = [odom(start + n * S // 4, draw.uniform(-9, 9), draw.random()) for n in range(rows)]
    messages.append(text(start + S, f"word {number}"))
    path = write_mcap(bag_dir / "rec" / f"rec_{number}.mcap", messages)
    os.utime(path, ns=(T0, T0 + number))
    return path


def count(bag_dir: Path, table: str) -> int:
    with closing(sqlite3.connect(store_file(bag_dir))) as base:
        query = f"SELECT count(*) FROM {table}"  # noqa: S608 - constants
        return int(base.execute(query).fetchone()[0])


def test_bags_that_cannot_be_stored_together_are_stored_alone_but_for_the_faulty(
    tmp_path: Path,
) -> None:
    for number in range(4):
        write_bag(tmp_path, number)
    world = World.of(tmp_path)

    def failing(plan: Plan, batch: Batch) -> LevelColumns:
        if (batch.log_times // (60 * S) == T0 // (60 * S) + 2).any():
            raise ValueError("of a test")
        return read_columns(plan, batch)

    with patch.object(decode, "read_columns", failing):
        world.fill()
    assert world.stored() == {f"rec/rec_{number}.mcap" for number in (0, 1, 3)}
    check_all(world)


def test_bags_of_which_messages_are_torn_in_different_places_have_one_topic_and_parts_together(
    tmp_path: Path,
) -> None:
    """A week of them would have a topic and parts for each bag, which every question looks at."""
    for number in range(4):
        said = [text(T0 + (number * 60 + n) * S, "word") for n in range(3)]
        torn = replace(said[-1], body=said[-1].payload[: 5 + number])
        write_mcap(tmp_path / "rec" / f"rec_{number}.mcap", [*said, torn])
    world = World.of(tmp_path)
    assert world.fill() == 4
    assert (count(tmp_path, "topic"), count(tmp_path, "part")) == (1, 1)


@pytest.mark.parametrize("others", [[], [10**6]])
def test_bags_have_parts_together_also_beside_one_of_a_clock_that_was_ahead(
    tmp_path: Path, others: list[int]
) -> None:
    for number in others:
        write_bag(tmp_path, number)
    clock = SettableClock(T0)
    world = World.of(tmp_path, clock=clock)
    for number in range(20):
        write_bag(tmp_path, number)
        clock.at = T0 + (number + 1) * 60 * S
        world.memory.index.refresh()
        world.fill()
    tables = 2  # of poses, and of texts
    assert count(tmp_path, "part") == tables * (2 + len(others))


@pytest.mark.parametrize("inside", ["bags", "."])
def test_in_a_cache_folder_the_oldest_bags_go_and_are_not_stored_again(
    tmp_path: Path, inside: str
) -> None:
    """Also in one below the bags, as where these lie in a home folder."""
    bag_dir = tmp_path / inside
    for number in range(40):
        write_bag(bag_dir, number, rows=150)
    cache = tmp_path / "cache" / "columns.sqlite"
    whole = World.of(bag_dir, files=[cache])
    empty = whole.store.used_bytes()
    whole.fill()
    limits = StoreLimits(max_bytes=empty + (whole.store.used_bytes() - empty) // 2)
    whole.store.close()
    world = World.of(bag_dir, files=[cache], limits=limits)
    world.fill()
    assert world.store.used_bytes() <= limits.max_bytes
    before = world.stored()
    assert before == {f"rec/rec_{number}.mcap" for number in range(40 - len(before), 40)}
    assert 10 <= len(before) < 40
    # Another process, which has not seen what was deleted.
    again = World.of(bag_dir, files=[cache], limits=limits)
    assert again.fill() == 0
    for number in range(40, 60):
        write_bag(bag_dir, number, rows=150)
        if number % 10 == 9:
            again.fill()
    assert again.store.used_bytes() <= limits.max_bytes
    assert "rec/rec_59.mcap" in again.stored()
    assert min(before) not in again.stored()
    assert times(again, "/odom") == times(again.unstored(), "/odom")


def test_a_bag_that_is_larger_than_the_store_may_be_is_not_tried(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    write_bag(bag_dir, 0, rows=900)
    limits = StoreLimits(max_bytes=20_000)
    world = World.of(bag_dir, files=[tmp_path / "cache" / "columns.sqlite"], limits=limits)
    assert world.fill() == 0
    assert check_all(world) == 901


def test_a_bag_in_which_the_clock_was_set_ahead_by_years_fits_into_a_cache_folder(
    tmp_path: Path,
) -> None:
    """A computer without a battery dates its first messages years before the others of the file."""
    bag_dir = tmp_path / "bags"
    years = 7 * 365 * 86_400 * S
    messages = [odom(at + n * S, n / 10, 0.0) for at in (T0 - years, T0) for n in range(60)]
    path = write_mcap(bag_dir / "rec" / "rec_0.mcap", messages)
    set_mtime(path, T0)
    world = World.of(bag_dir, files=[tmp_path / "cache" / "columns.sqlite"], limits=StoreLimits())
    world.fill()
    assert world.stored() == {"rec/rec_0.mcap"}
    assert times(world, "/odom") == times(world.unstored(), "/odom")


def decode_in_groups(patch: pytest.MonkeyPatch) -> None:
    """Has bags decoded in several goes, as those of many gigabytes are."""
    patch.setattr(decode, "GROUP_BYTES", 1)
    patch.setattr(bulk, "BATCH_BYTES", 4000)


def write_long_bag(bag_dir: Path) -> None:
    messages = [
        message
        for at in range(T0, T0 + 3600 * S, 60 * S)
        for message in (odom(at, at / S, 0.0), text(at + 5, f"word {at}"))
    ]
    path = write_mcap(bag_dir / "rec" / "rec_0.mcap", messages, McapLayout(chunk_size=2000))
    set_mtime(path, T0)


@pytest.fixture
def long_bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a long bag."""
    decode_in_groups(monkeypatch)
    write_long_bag(tmp_path)
    return tmp_path


@pytest.mark.parametrize("fault", ["undecodable", "erasing"])
def test_half_a_bag_is_never_used_and_its_rows_go(
    long_bag: Path, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    world = World.of(long_bag)
    halves: list[int] = []
    erasing = long_bag / ERASING_FILE

    def with_fault(reader: BagReader, path: Path, **options: object) -> Iterator[Group]:
        for nth, group in enumerate(undecoded(reader, path)):
            if nth == 3:
                halves.append(count(long_bag, "part"))
                assert world.stored() == set()
                check_all(world)
                if fault == "undecodable":
                    raise ValueError("of a test")
                erasing.write_text("{}")
            yield group

    monkeypatch.setattr(fill, "undecoded", with_fault)
    assert world.fill() == 0
    assert halves[0] > 0
    assert {count(long_bag, table) for table in ("part", "part_column", "bag")} == {0}
    check_all(world)
    monkeypatch.setattr(fill, "undecoded", undecoded)
    if fault == "erasing":  # nothing is stored while messages are taken out
        assert world.fill() == 0
        erasing.unlink()
        assert world.fill() == 1


def replace_store(bag_dir: Path) -> None:
    """Another program finds no store, makes one, and stores another bag first."""
    for path in store_file(bag_dir).parent.glob(f"{store_file(bag_dir).name}*"):
        path.unlink()
    path = write_mcap(bag_dir / "other" / "other_0.mcap", [odom(T0 + 10**6 * S, 0, 0)])
    set_mtime(path, T0)
    other = World.of(bag_dir)
    bags = other.memory.index.snapshot().bags
    other.fill_alone([bag for bag in bags if bag.path == path])
    other.store.close()


@pytest.mark.parametrize("fault", ["deleted", "replaced", "replaced, and asked meanwhile"])
def test_a_bag_is_not_stored_on_where_another_program_deleted_or_replaced_what_was(
    long_bag: Path, fault: str
) -> None:
    one = World.of(long_bag)
    [bag] = one.memory.index.snapshot().bags
    groups = map(Group.tables, undecoded(one.memory.reader, bag.path))

    def interrupted() -> Iterator[list[Table]]:
        yield next(groups)
        if fault == "deleted":
            forget(store_file(long_bag), long_bag, ["rec/rec_0.mcap"])
        else:
            replace_store(long_bag)
        if fault.endswith("meanwhile"):
            one.store.read(lambda connection: connection.execute("SELECT 1 FROM bag"), None)
        yield from groups

    to_store = ReadBag(one.filling._key(bag), bag)
    assert not one.store.put_long(to_store, interrupted(), budget=10**6)
    again = World.of(long_bag)
    assert again.stored() == (set() if fault == "deleted" else {"other/other_0.mcap"})
    assert count(long_bag, "part") == count(long_bag, "bag") == len(again.stored())
    check_all(again)


def test_a_handover_has_only_those_bags_stored_again_that_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [write_bag(tmp_path, number) for number in range(4)]
    folder, cut = paths[0].parent, T0 + 3 * 60 * S + 2 * S
    begun = Handover(next="later")
    ended = replace(begun, counts_until=cut, end=Overlap(None, None, (paths[3].name,)))
    compared = replace(ended, counts_elsewhere={paths[1].name: {"/odom": ("1 00000000",)}})
    steps: list[tuple[Handover | None, list[int]]] = [
        (None, [3, 2, 1, 0]),
        (begun, []),
        (ended, [3]),
        (compared, [3, 1]),  # a rule concerns these
        (Handover(), [3]),  # nothing was hidden of the other one
    ]
    names: list[str] = []

    def counting(reader: BagReader, path: Path, **options: object) -> Iterator[Group]:
        names.append(path.name)
        return undecoded(reader, path, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(fill, "undecoded", counting)
    for number, (handover, stored) in enumerate(steps):
        if handover is not None:
            write_handover(folder, handover)
            os.utime(folder / HANDOVER_FILE, ns=(T0, T0 + number * S))
        names.clear()
        world = World.of(tmp_path)
        world.fill_alone()
        assert names == [paths[nth].name for nth in stored]
        assert len(world.stored()) == 4
        assert check_all(world) > 0
        world.store.close()


def test_beside_a_link_in_place_of_a_handover_bags_are_stored(tmp_path: Path) -> None:
    path = write_bag(tmp_path, 0)
    (path.parent / HANDOVER_FILE).symlink_to(path)
    assert World.of(tmp_path).fill() == 1
