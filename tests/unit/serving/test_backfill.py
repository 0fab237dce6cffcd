"""The store of columns is filled bag by bag."""

import os
import sqlite3
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import anyio
import anyio.lowlevel
import pytest

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.layout import OWN_FOLDER
from ros2_memory.cli.maintenance.index import fill_store
from ros2_memory.columns.fill import Batch, Filling, StoreLimits
from ros2_memory.columns.scanner import Scanner
from ros2_memory.columns.store import FILE, ColumnStore
from ros2_memory.columns.writing import Level
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Memory
from ros2_memory.serving.backfill import BACKLOG, Backfill, keep_backfilled
from ros2_memory.serving.health import Health
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, boolean, detections, odom, text, write_mcap
from tests.support.clocks import SettableClock
from tests.support.memories import memory_of

T0 = 1_700_000_000 * NS_PER_S


def bag(bag_dir: Path, number: int) -> Path:
    start = T0 + number * 10 * NS_PER_S
    messages = [odom(start + n * NS_PER_S, number + n / 10, 0.0) for n in range(10)]
    path = bag_dir / "rec" / f"rec_{number}.mcap"
    return write_mcap(path, messages, McapLayout(chunk_size=300))


def storing(
    bag_dir: Path, clock: SettableClock | None = None, *, reading: str = ""
) -> tuple[Memory, Backfill]:
    """A memory as a new process has it, and what fills its store."""
    memory = memory_of(bag_dir, clock=clock, reader=BagDirReader(McapReader(), bag_dir))
    store = ColumnStore([bag_dir / OWN_FOLDER / FILE], memory.reader.definition)
    scanner = Scanner(store, bag_dir, reading)
    filling = Filling(scanner, memory.reader, bag_dir, memory.clock, StoreLimits())
    memory = replace(memory, scanner=scanner)
    return memory, Backfill(memory, filling)


def outlines_in(bag_dir: Path) -> list[tuple[int, str]]:
    with closing(sqlite3.connect(bag_dir / OWN_FOLDER / FILE)) as base:
        query = "SELECT id, settings FROM fragment WHERE kind LIKE 'outline %' ORDER BY id"
        return base.execute(query).fetchall()


def stored(memory: Memory) -> list[str]:
    assert memory.scanner.store is not None
    return sorted(memory.scanner.store.paths())


def test_what_followed_under_other_settings_is_made_again_a_few_slices_a_round(
    tmp_path: Path,
) -> None:
    for number in range(6):
        bag(tmp_path, 1080 * number)  # with three hours between them
    earlier = storing(tmp_path, reading="before")[1]
    fill_store(earlier)
    while earlier.follow():
        pass
    outlines = outlines_in(tmp_path)
    memory, backfill = storing(tmp_path, reading="after")
    before = len(memory.scanner.fragments_of_others())
    assert backfill.follow()
    assert 0 < len(memory.scanner.fragments_of_others()) < before
    while backfill.follow():
        pass
    assert memory.scanner.fragments_of_others() == []
    # They depend on no settings.
    assert outlines_in(tmp_path) == outlines != []
    assert storing(tmp_path, reading="before")[0].scanner.fragments_of_others() == []


def test_bags_that_a_crash_left_open_keep_nothing_from_being_joined(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("columns.scan", "serving.backfill"):
        monkeypatch.setattr(f"ros2_memory.{module}.STRETCH_NS", 4 * 3600 * NS_PER_S)
    joined = []
    for name in ("whole", "crashed"):
        bag_dir = tmp_path / name
        bag(bag_dir, 0)
        bag(bag_dir, 2000)  # behind the stretch of the first
        if name == "crashed":
            messages = [text(T0 + n * NS_PER_S, str(n)) for n in range(20, 60)]
            layout = McapLayout(finish=False, chunk_size=300)
            write_mcap(bag_dir / "other" / "other_0.mcap", messages, layout)
        clock = SettableClock(T0 + 86_400 * NS_PER_S)
        memory, backfill = storing(bag_dir, clock)
        fill_store(backfill)
        assert len(memory.index.snapshot().bags) == (3 if name == "crashed" else 2)
        with closing(sqlite3.connect(bag_dir / OWN_FOLDER / FILE)) as base:
            query = "SELECT kind, start_ns FROM fragment WHERE kind LIKE 'path-joined%'"
            joined.append(base.execute(query).fetchall())
    assert joined[0] == joined[1] != []


def test_poses_that_cannot_be_decoded_keep_nothing_else_from_being_joined(tmp_path: Path) -> None:
    poses = [replace(odom(T0 + n * NS_PER_S, 0.0, 0.0), body=b"") for n in range(10)]
    bumps = [boolean(T0 + n * NS_PER_S, n > 5) for n in range(10)]
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [*poses, *bumps])
    _, backfill = storing(tmp_path)
    fill_store(backfill)
    assert outlines_in(tmp_path) != []


async def test_what_is_stored_of_many_deleted_bags_goes_with_the_next_round(tmp_path: Path) -> None:
    paths = [bag(tmp_path, number) for number in range(6)]
    memory, backfill = storing(tmp_path)
    await backfill.fill()
    assert len(stored(memory)) == 6
    for path in paths[:4]:
        path.unlink()
    memory.index.refresh()
    await backfill.fill()
    assert stored(memory) == ["rec/rec_4.mcap", "rec/rec_5.mcap"]


def test_that_a_stored_bag_has_changed_is_no_reason_to_look_for_deleted_ones_again(
    tmp_path: Path,
) -> None:
    path, _ = bag(tmp_path, 0), bag(tmp_path, 1)
    memory, backfill = storing(tmp_path)
    fill_store(backfill)
    assert not backfill.has_many_gone()
    os.utime(path, (1, 1))
    memory.index.refresh()
    assert backfill.has_many_gone()
    backfill.prune()
    assert len(stored(memory)) == 2
    assert not backfill.has_many_gone()


@pytest.mark.parametrize("helper", [["/no/such/program"], [sys.executable, "-c", "exit(3)"]])
async def test_a_backlog_is_worked_off_also_where_its_helper_fails(
    tmp_path: Path, helper: list[str]
) -> None:
    for number in range(BACKLOG + 2):
        bag(tmp_path, number)
    _, backfill = storing(tmp_path)
    backfill.helper = helper
    with anyio.fail_after(60):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(keep_backfilled, backfill, 0.001)
            while backfill.progress().waiting:
                await anyio.lowlevel.checkpoint()
            tasks.cancel_scope.cancel()


@patch("ros2_memory.serving.backfill._MERGED_HERE", 2)
async def test_much_that_is_put_together_is_left_to_the_helper(tmp_path: Path) -> None:
    for number in range(3):
        bag(tmp_path, number)
    _, backfill = storing(tmp_path)
    for waiting in backfill.waiting():
        backfill.store(Batch([waiting], Level.BAG))
    ran = tmp_path / "ran"
    backfill.helper = [sys.executable, "-c", f"open({str(ran)!r}, 'w')"]
    await backfill.fill()
    assert ran.exists()
    ran.unlink()
    await backfill.fill()  # what it left is put together here
    assert not ran.exists()


async def test_health_tells_how_much_is_stored(tmp_path: Path) -> None:
    for number in range(3):
        bag(tmp_path, number)
    memory, backfill = storing(tmp_path)
    backfill.store(Batch(backfill.waiting()[:1], Level.BAG))
    reply = await Health(memory, backfill)()
    assert reply["store"] == {"bags": 1, "waiting": 2, "refused": 0, "state": "filling"}
    assert backfill.filling is not None
    backfill.filling.store.refusals, backfill.filling.store.refused_for = 2, "too large"
    reply = await Health(memory, backfill)()
    assert reply["store_refusals"] == {"count": 2, "reason": "too large"}


async def test_without_a_store_health_names_topics_that_cannot_be_decoded_as_bags_come(
    tmp_path: Path,
) -> None:
    memory = memory_of(tmp_path)
    backfill = Backfill(memory, None)
    await backfill.fill()
    write_mcap(tmp_path / "a.mcap", [detections(T0, ["cup"])], McapLayout(definitions=False))
    memory.index.refresh()
    await backfill.fill()
    assert len(backfill.undecodable) == 1
