"""Which bags are stored, when, and for how long; nothing that is in doubt is."""

from __future__ import annotations

import json
import os
import random
import sqlite3
from contextlib import closing
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from ros2_memory.bag_dir.handover_file import Handover, Overlap, write_handover
from ros2_memory.bag_dir.layout import ERASING_FILE, HANDOVER_FILE
from ros2_memory.columns import decode, fill
from ros2_memory.columns.decode import Group, undecoded
from ros2_memory.columns.fill import StoreLimits
from ros2_memory.columns.forget import forget
from ros2_memory.columns.stored import StoredTable
from ros2_memory.columns.walk import LevelColumns, walked
from ros2_memory.columns.writing import ReadBag
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Call
from ros2_memory.history.scan import scan
from ros2_memory.history.view import View
from ros2_memory.storage.mcap import bulk
from tests.support.bags import McapLayout, Msg, odom, text, write_mcap
from tests.support.column_worlds import EVERYTHING, World, check_all, store_file, times
from tests.support.mcap_surgery import raw_mcap
from tests.support.screened_bags import ScreenedBags, mode, words

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from mcap.writer import Writer

    from ros2_memory.columns.plan import Plan
    from ros2_memory.columns.table import Table
    from ros2_memory.storage.base import BagReader, Batch, Channel

S = NS_PER_S
STRING = "std_msgs/msg/String"
T0 = 1_700_000_400 * S
"""The begin of ten minutes."""


def write_bag(bag_dir: Path, number: int, *, rows: int = 20, hz: int = 4) -> Path:
    """A minute of a recording, of which the robot moves without any order."""
    start, draw = T0 + number * 60 * S, random.Random(number)
    messages = [
        odom(start + n * S // hz, draw.uniform(-9, 9), draw.uniform(-9, 9)) for n in range(rows)
    ]
    messages.append(text(start + S, f"word {number}"))
    path = write_mcap(bag_dir / "rec" / f"rec_{number}.mcap", messages)
    os.utime(path, ns=(T0, T0 + number))
    return path


def write_foreign(path: Path) -> None:
    """A bag with a message whose definition it does not have."""

    def fill_bag(writer: Writer) -> None:
        schema = writer.register_schema("nobody_msgs/msg/Grip", "", b"")
        channel = writer.register_channel("/gripper", "cdr", schema)
        writer.add_message(channel, T0, b"\x00\x01\x00\x00abcd", T0)

    path.parent.mkdir(parents=True)
    raw_mcap(path, fill_bag, profile="ros2")


def count(world: World, table: str, where: str = "1") -> int:
    path = world.store.path
    assert path is not None
    with closing(sqlite3.connect(path)) as base:
        sql = f"SELECT count(*) FROM {table} WHERE {where}"  # noqa: S608 - constants
        return int(base.execute(sql).fetchone()[0])


def test_the_newest_bag_comes_first_and_parts_are_made_of_ten_minutes(tmp_path: Path) -> None:
    paths = [write_bag(tmp_path, number) for number in range(13)]
    world = World.of(tmp_path)
    timeline = world.memory.index.snapshot().timeline
    assert [bag.path for bag in world.filling.waiting(timeline)] == paths[::-1]
    assert world.fill() == 13
    assert world.filling.waiting(timeline) == []
    assert (count(world, "part"), count(world, "part", "NOT whole")) == (4, 0)
    assert check_all(world) == 13 * 21


def test_a_message_that_cannot_be_decoded_takes_the_columns_of_its_bag_alone(
    tmp_path: Path,
) -> None:
    paths = [write_bag(tmp_path, number) for number in range(4)]
    broken = [text(T0 + 120 * S, "word"), Msg("/chatter", STRING, T0 + 121 * S, b"\x00\x01")]
    write_mcap(paths[2], [odom(T0 + 120 * S, 1.0, 2.0), *broken])
    world = World.of(tmp_path)
    assert world.fill() == 4
    bags_of = {}
    with closing(sqlite3.connect(store_file(tmp_path))) as base:
        for bags, has_columns in base.execute(
            "SELECT bags, EXISTS (SELECT 1 FROM zone WHERE zone.part = part.id AND path = 'data')"
            " FROM part JOIN topic ON topic.id = part.topic WHERE name = '/chatter'"
        ):
            bags_of[has_columns] = len(json.loads(bags))
    assert bags_of == {1: 3, 0: 1}
    check_all(world)


def test_bags_that_cannot_be_stored_together_are_stored_alone_but_for_the_faulty(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(4):
        write_bag(tmp_path, number)
    world = World.of(tmp_path)

    def failing(plan: Plan, batch: Batch) -> LevelColumns:
        if (batch.log_times // (60 * S) == T0 // (60 * S) + 2).any():
            raise ValueError("of a test")
        return walked(plan, batch)

    with monkeypatch.context() as patched:
        patched.setattr(decode, "walked", failing)
        world.fill()
    assert world.stored() == {f"rec/rec_{number}.mcap" for number in (0, 1, 3)}
    check_all(world)


def test_a_bag_whose_name_is_no_text_is_stored(tmp_path: Path) -> None:
    path = write_bag(tmp_path, 0)
    path.rename(path.with_name("rec\udcff_0.mcap"))
    world = World.of(tmp_path)
    assert world.fill() == 1
    assert count(world, "bag") == 1
    assert world.fill() == 0
    assert check_all(world) == 21


def test_what_other_definitions_may_decode_is_stored_for_these_alone(tmp_path: Path) -> None:
    write_foreign(tmp_path / "rec" / "rec_0.mcap")
    write_bag(tmp_path, 1)
    one = World.of(tmp_path, definitions="one")
    assert one.fill() == 2
    assert World.of(tmp_path, definitions="two").stored() == {"rec/rec_1.mcap"}
    assert World.of(tmp_path, definitions="one").stored() == one.stored()


def test_a_bag_that_comes_beside_another_recording_is_stored_again(tmp_path: Path) -> None:
    write_bag(tmp_path, 0)
    world = World.of(tmp_path)
    world.fill()
    assert count(world, "bag", "hashed") == 0
    again = [odom(T0 + n * S // 4, n / 7, 0.0, log_time=T0 + n * S // 4 + 99) for n in range(9)]
    write_mcap(tmp_path / "rec_b" / "rec_b_0.mcap", again)
    check_all(world)
    timeline = world.memory.index.snapshot().timeline
    assert len(world.filling.waiting(timeline)) == 2
    assert world.fill() == 2
    assert count(world, "bag", "hashed") == 2
    check_all(world)


def test_of_a_part_only_the_bags_beside_another_recording_are_hashed(tmp_path: Path) -> None:
    """The first of three bags has copies in another recording, and later so has the second."""
    for number in range(3):
        write_bag(tmp_path, number)
    world = World.of(tmp_path)

    def copy(number: int) -> None:
        copied = write_bag(tmp_path / "copy", number)
        path = tmp_path / f"rec_{number + 4}" / f"rec_{number + 4}_0.mcap"
        path.parent.mkdir()
        copied.rename(path)

    def hashed() -> list[str]:
        with closing(sqlite3.connect(store_file(tmp_path))) as base:
            return [
                path for (path,) in base.execute("SELECT path FROM bag WHERE hashed ORDER BY 1")
            ]

    copy(0)
    assert world.fill() == 4
    assert hashed() == ["rec/rec_0.mcap", "rec_4/rec_4_0.mcap"]
    assert check_all(world) == 3 * 21
    copy(1)
    assert check_all(world) == 3 * 21  # what was stored unhashed is read
    assert world.fill() == 2
    assert hashed() == [
        "rec/rec_0.mcap",
        "rec/rec_1.mcap",
        "rec_4/rec_4_0.mcap",
        "rec_5/rec_5_0.mcap",
    ]
    assert check_all(world) == 3 * 21


def test_copies_of_a_long_bag_are_recognised_before_it_is_stored_again(tmp_path: Path) -> None:
    """Its parts of ten minutes have some of its messages each."""
    poses = [odom(T0 + n * 5 * S, n / 7, 0.0) for n in range(300)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", poses)
    world = World.of(tmp_path)
    world.fill()
    assert count(world, "part") == 3
    again = [
        odom(T0 + n * 5 * S, n / 7, 0.0, log_time=T0 + n * 5 * S + 99) for n in range(150, 160)
    ]
    write_mcap(tmp_path / "rec_b" / "rec_b_0.mcap", again)
    assert check_all(world) == 300


def test_columns_beyond_the_share_are_dropped_and_times_and_zones_stay(tmp_path: Path) -> None:
    for number in range(3):
        write_bag(tmp_path, number, rows=2000, hz=100)
    world = World.of(tmp_path, limits=StoreLimits(max_share=0.0))
    world.fill()
    assert count(world, "zone", "codec = 'dropped' AND path = 'pose.pose.position.x'") == 1
    assert count(world, "zone", "codec = 'dropped' AND path GLOB '#*'") == 0
    assert times(world, "/odom") == times(world.unstored(), "/odom")
    view = View(world.memory, Call())
    [rows] = scan(view, "/odom", EVERYTHING)
    assert "pose.pose.position.x" not in rows.table.columns
    assert "max_share" in rows.table.left_out["pose.pose.position.x"]
    assert isinstance(rows.table, StoredTable)
    zone = rows.table.zone("pose.pose.position.x")
    assert zone is not None
    assert zone.high > 8.9
    assert len(times(world, "/chatter")) == 3


# Erasing, screening


def test_nothing_is_stored_while_messages_are_taken_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bag(tmp_path, 0)
    world = World.of(tmp_path)
    assert world.store.path is not None
    erasing = tmp_path / ERASING_FILE

    def then_erasing(
        reader: BagReader, path: Path, *, hashed: Callable[[Channel], bool], number: int
    ) -> Iterator[Group]:
        yield from undecoded(reader, path, hashed=hashed, number=number)
        erasing.write_text("{}")

    monkeypatch.setattr(fill, "undecoded", then_erasing)
    assert world.fill() == 0
    assert count(world, "bag") == 0
    assert world.fill() == 0
    monkeypatch.setattr(fill, "undecoded", undecoded)
    erasing.unlink()
    assert world.fill() == 1


def test_a_bag_that_goes_while_its_ten_minutes_are_read_leaves_nothing_in_their_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [write_bag(tmp_path, number) for number in range(4)]
    world = World.of(tmp_path)

    def gone_meanwhile(reader: BagReader, path: Path, **options: object) -> Iterator[Group]:
        if path == paths[3]:
            paths[1].unlink()
        return undecoded(reader, path, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(fill, "undecoded", gone_meanwhile)
    assert world.fill() == 3
    assert (count(world, "bag"), count(world, "part")) == (3, 2)
    assert count(world, "zone", "words LIKE '%word 1%'") == 0
    assert count(world, "zone", "words LIKE '%word 2%'") == 1
    assert check_all(world) == 3 * 21


def test_a_split_that_is_not_released_is_not_stored(tmp_path: Path) -> None:
    screened = ScreenedBags(tmp_path)
    recording = screened.begin(0)
    screened.split(recording, [mode(0, False), *words(0, 10)])
    screened.split(recording, [mode(12, True), *words(10, 20)])
    screened.split(recording, [mode(22, False), *words(20, 30)])
    world = World.of(tmp_path)
    assert world.fill() == 0
    for _ in range(4):
        screened.step()
        world.fill()
        served = {str(path.relative_to(tmp_path)) for path in screened.served()}
        assert {*world.store.paths()} <= served
    screened.end()
    world.fill()
    assert world.stored() == {str(path.relative_to(tmp_path)) for path in screened.served()}
    assert [(time - 1_790_000_000 * S) / S for time in times(world, "/chatter")] == (
        screened.seconds()
    )
    assert 15.5 not in screened.seconds()


# Retention


def test_rows_of_deleted_bags_do_not_count_and_a_part_goes_with_its_last(tmp_path: Path) -> None:
    paths = [write_bag(tmp_path, number) for number in range(12)]
    world = World.of(tmp_path)
    world.fill()
    for nth, path in enumerate(paths[:10], start=1):
        path.unlink()
        assert len(times(world, "/chatter")) == 12 - nth
        assert check_all(world) == (12 - nth) * 21
        world.prune()
        assert check_all(world) == (12 - nth) * 21
        assert count(world, "part") == (4 if nth < 10 else 2)
    assert count(world, "bag") == 2


def test_nothing_is_deleted_where_the_bag_directory_is_empty(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    write_bag(bag_dir, 0)
    world = World.of(bag_dir, file=tmp_path / "cache" / "columns.sqlite")
    world.fill()
    bag_dir.rename(tmp_path / "away")
    bag_dir.mkdir()
    world.prune()
    assert count(world, "bag") == 1


def test_in_a_cache_folder_the_oldest_bags_go_and_are_not_stored_again(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    for number in range(40):
        write_bag(bag_dir, number, rows=150)
    cache = tmp_path / "cache" / "columns.sqlite"
    whole = World.of(bag_dir, file=cache)
    empty = whole.store.used_bytes()
    whole.fill()
    limits = StoreLimits(max_bytes=empty + (whole.store.used_bytes() - empty) // 2)
    whole.store.close()
    world = World.of(bag_dir, file=cache, limits=limits)
    world.fill()
    assert world.store.used_bytes() <= limits.max_bytes
    kept = sorted(int(path[8:-5]) for path in world.stored())
    assert kept == [*range(40 - len(kept), 40)]
    assert 10 <= len(kept) < 40
    # Another process, which has not seen what was deleted.
    again = World.of(bag_dir, file=cache, limits=limits)
    again.fill()
    before = again.stored()
    assert again.fill() == 0
    assert World.of(bag_dir, file=cache, limits=limits).fill() == 0
    assert again.store.used_bytes() <= limits.max_bytes
    for first in range(40, 80, 10):
        for number in range(first, first + 10):
            write_bag(bag_dir, number, rows=150)
        again.fill()
    assert again.store.used_bytes() <= limits.max_bytes
    assert "rec/rec_79.mcap" in again.stored()
    assert min(before) not in again.stored()
    assert times(again, "/odom") == times(again.unstored(), "/odom")


def test_beside_the_bags_the_store_has_no_limit_of_its_own(tmp_path: Path) -> None:
    for number in range(3):
        write_bag(tmp_path, number)
    world = World.of(tmp_path, limits=StoreLimits(max_bytes=1))
    assert world.fill() == 3
    assert len(world.stored()) == 3


def test_a_bag_that_is_larger_than_the_store_may_be_is_not_tried(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    write_bag(bag_dir, 0, rows=900)
    limits = StoreLimits(max_bytes=20_000)
    world = World.of(bag_dir, file=tmp_path / "cache" / "columns.sqlite", limits=limits)
    assert world.fill() == 0
    assert check_all(world) == 901


# Long bags


def decode_in_groups(patch: pytest.MonkeyPatch) -> None:
    """Has bags decoded in several goes, as those of many gigabytes are."""
    patch.setattr(decode, "GROUP_BYTES", 1)
    patch.setattr(bulk, "BATCH_BYTES", 4000)


@pytest.fixture
def small_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    decode_in_groups(monkeypatch)


def write_long_bag(bag_dir: Path, rows: int = 60) -> Path:
    messages = [odom(T0 + n * 60 * S, n / 7, 0.0) for n in range(rows)]
    messages += [text(T0 + n * 60 * S + 5, f"word {n}") for n in range(rows)]
    messages.sort(key=lambda message: message.log_time)
    path = write_mcap(bag_dir / "rec" / "rec_0.mcap", messages, McapLayout(chunk_size=2000))
    os.utime(path, ns=(T0, T0))
    return path


@pytest.mark.usefixtures("small_groups")
def test_a_bag_of_several_groups_becomes_parts_at_once(tmp_path: Path) -> None:
    write_long_bag(tmp_path)
    world = World.of(tmp_path)
    assert world.fill() == 1
    assert count(world, "part", "NOT whole") == 0
    assert count(world, "part") >= 12
    assert check_all(world) == 120
    assert check_all(World.of(tmp_path)) == 120


def test_bags_may_take_what_others_left_of_their_share(tmp_path: Path) -> None:
    def moving(name: str, share: float, *, quiet: bool) -> World:
        bag_dir = tmp_path / name
        if quiet:
            texts = [text(T0 + n * S, "a" * 20_000) for n in range(100)]
            path = write_mcap(bag_dir / "quiet" / "quiet_0.mcap", texts)
            os.utime(path, ns=(T0, T0))
            World.of(bag_dir).fill()
        write_bag(bag_dir, 20, rows=2000, hz=100)
        world = World.of(bag_dir, limits=StoreLimits(max_share=share))
        world.fill()
        return world

    whole = moving("whole", 1.0, quiet=False)
    in_bags, needed = whole.store.merged_bytes()
    share = 0.9 * needed / in_bags
    assert count(moving("alone", share, quiet=False), "part", "dropped <> ''") > 0
    assert count(moving("beside", share, quiet=True), "part", "dropped <> ''") == 0


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_what_one_part_drops_is_room_for_the_next(tmp_path: Path, share: float) -> None:
    def dropped(name: str, *, together: bool) -> int:
        for slot in range(3):
            write_bag(tmp_path / name, slot * 10, rows=2000, hz=100)
        world = World.of(tmp_path / name, limits=StoreLimits(max_share=1.0))
        world.fill()
        in_bags, needed = world.store.merged_bytes()
        parts = world.store.parts("/odom")
        shares = [([part.number], 0) for part in parts]
        assert len(shares) == 3
        for some in [shares] if together else [[each] for each in shares]:
            assert world.store.thin(some, share * needed / in_bags)
        return count(world, "part", "dropped <> ''")

    at_once = dropped("together", together=True)
    assert at_once == dropped("alone", together=False)
    assert at_once == {0.0: 3, 0.6: 2}[share]


def test_the_topic_that_is_the_largest_in_all_parts_is_dropped_first(tmp_path: Path) -> None:
    draw = random.Random(1)
    for number in range(4):
        begin = T0 + number * 600 * S
        messages = [odom(begin + n * S // 40, draw.uniform(-9, 9), 0.0) for n in range(1200)]
        # In the oldest bag, which is stored last, there is more of them than of odometry.
        said = [f"{draw.getrandbits(2000):x}" for _ in range(20 if number == 0 else 1)]
        messages += [text(begin + n * S + 7, word) for n, word in enumerate(said)]
        messages.sort(key=lambda message: message.log_time)
        path = write_mcap(tmp_path / f"rec_{number}" / "rec_0.mcap", messages)
        os.utime(path, ns=(T0, T0))
    # No share: 200 bytes a second are for either of them.
    assert World.of(tmp_path, limits=StoreLimits(max_share=0.0)).fill() == 4
    with closing(sqlite3.connect(store_file(tmp_path))) as base:
        rows = base.execute(
            "SELECT name, part.first_ns / 600000000000, bytes, dropped <> '' FROM part"
            " JOIN topic ON topic.id = topic ORDER BY 1, 2"
        ).fetchall()
    assert [dropped for name, *_, dropped in rows if name == "/chatter"] == [0, 0, 0, 0]
    assert [dropped for name, *_, dropped in rows if name == "/odom"] == [1, 0, 0, 0]
    odometry, said_then = (
        next(row[2] for row in rows if row[0] == name) for name in ("/odom", "/chatter")
    )
    assert odometry < said_then


@pytest.mark.usefixtures("small_groups")
@pytest.mark.parametrize("fault", ["undecodable", "erasing"])
def test_half_a_bag_is_never_used_and_its_rows_go(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    write_long_bag(tmp_path)
    world = World.of(tmp_path)
    halves: list[int] = []

    def with_fault(reader: BagReader, path: Path, **options: object) -> Iterator[Group]:
        for nth, group in enumerate(undecoded(reader, path)):
            if nth == 3:
                halves.append(count(world, "part"))
                assert world.stored() == set()
                check_all(world)
                if fault == "undecodable":
                    raise ValueError("of a test")
                (tmp_path / ERASING_FILE).write_text("{}")
            yield group

    monkeypatch.setattr(fill, "undecoded", with_fault)
    world.fill()
    assert halves[0] > 0
    assert (count(world, "part"), count(world, "part_column"), count(world, "bag")) == (0, 0, 0)
    check_all(world)


@pytest.mark.usefixtures("small_groups")
def test_what_another_program_deletes_while_it_is_stored_stays_deleted(tmp_path: Path) -> None:
    write_long_bag(tmp_path)
    one = World.of(tmp_path)
    [bag] = one.memory.index.snapshot().bags
    groups = map(Group.tables, undecoded(one.memory.reader, bag.path))

    def deleted_meanwhile() -> Iterator[list[Table]]:
        yield next(groups)
        forget(store_file(tmp_path), tmp_path, ["rec/rec_0.mcap"])
        yield from groups

    to_store = ReadBag(one.filling._key(bag), bag)
    assert not one.store.put_long(to_store, deleted_meanwhile(), budget=10**6)
    assert (count(one, "part"), count(one, "bag")) == (0, 0)


def test_numbers_that_are_rounded_to_one_come_back(tmp_path: Path) -> None:
    messages = [odom(T0 + n * S, 1.0 + n * 1e-6, 0.0) for n in range(9)]
    path = write_mcap(tmp_path / "rec" / "rec_0.mcap", messages)
    os.utime(path, ns=(T0, T0))
    world = World.of(tmp_path)
    assert world.fill() == 1
    assert count(world, "zone", "codec GLOB '* flat 0'") == 1
    assert check_all(world) == 9


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


def test_a_bag_is_known_as_stored_at_once_by_whichever_program(tmp_path: Path) -> None:
    for number in range(4):
        write_mcap(tmp_path / "rec" / f"{number}.mcap", [odom(T0 + number * 10 * S, 0.0, 0.0)])
    worlds = World.of(tmp_path), World.of(tmp_path)
    bags = worlds[0].memory.index.snapshot().timeline.bags
    known: set[str] = set()
    for nth in (2, 0, 3, 1):
        worlds[nth % 2].fill_alone([bags[nth]])
        known.add(f"rec/{bags[nth].path.name}")
        assert [world.stored() for world in worlds] == [known, known]
