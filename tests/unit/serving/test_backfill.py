"""The catalogue is filled bag by bag, and nothing that is in doubt gets into it."""

from __future__ import annotations

import logging
import os
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import anyio
import anyio.lowlevel
import pytest
import structlog

from ros2_memory import queries
from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.handover_file import Handover, Overlap, write_handover
from ros2_memory.bag_dir.layout import HANDOVER_FILE
from ros2_memory.catalogue.digest import Digester
from ros2_memory.catalogue.digest_config import DigestConfig
from ros2_memory.catalogue.lookup import DigestCache
from ros2_memory.catalogue.store import FILE, FOLDER, Catalogue
from ros2_memory.cli import main
from ros2_memory.cli.doctor import check_catalogue
from ros2_memory.cli.maintenance.index import describe_progress, fill_store
from ros2_memory.columns.store import BagKey
from ros2_memory.core.errors import BagError
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Call
from ros2_memory.serving.backfill import BACKLOG, Backfill, Progress, keep_backfilled
from ros2_memory.serving.health import Health
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, odom, text, write_mcap
from tests.support.clocks import SettableClock
from tests.support.housekeepers import recorded_before
from tests.support.memories import memory_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.catalogue.digest import Digest
    from ros2_memory.history.context import Memory

T0 = 1_700_000_000 * NS_PER_S


def bag(bag_dir: Path, number: int, *, finish: bool = True) -> Path:
    start = T0 + number * 10 * NS_PER_S
    messages = [odom(start + n * NS_PER_S, number + n / 10, 0.0) for n in range(10)]
    path = bag_dir / "rec" / f"rec_{number}.mcap"
    return write_mcap(path, messages, McapLayout(finish=finish, chunk_size=300))


def recalling(bag_dir: Path, clock: SettableClock | None = None) -> Memory:
    recall = DigestCache(Catalogue([bag_dir / FOLDER / FILE], DigestConfig("test")), bag_dir)
    reader = BagDirReader(McapReader(), bag_dir)
    return replace(memory_of(bag_dir, clock=clock, reader=reader), recall=recall)


def backfill_of(memory: Memory, bag_dir: Path, digester: Digester | None = None) -> Backfill:
    made = digester or Digester(memory.reader)
    return Backfill(memory, made, bag_dir)


def test_the_newest_bag_comes_first(tmp_path: Path) -> None:
    paths = [bag(tmp_path, number) for number in range(3)]
    backfill = backfill_of(recalling(tmp_path), tmp_path)
    assert [each.path for each in backfill.waiting()] == paths[::-1]


def test_when_all_is_digested_nothing_waits(tmp_path: Path) -> None:
    for number in range(3):
        bag(tmp_path, number)
    backfill = backfill_of(recalling(tmp_path), tmp_path)
    assert backfill.progress() == Progress(3, 3, 0)
    assert fill_store(backfill) == Progress(3, 0, 0)
    assert fill_store(backfill_of(recalling(tmp_path), tmp_path)) == Progress(3, 0, 0)


def test_what_another_server_digested_as_well_does_not_wait(tmp_path: Path) -> None:
    for number in range(3):
        bag(tmp_path, number)
    one, other = (backfill_of(recalling(tmp_path), tmp_path) for _ in range(2))
    both = other.waiting()
    assert fill_store(one) == Progress(3, 0, 0)
    for each in both:
        assert other.digest(each)
    assert one.waiting() == []
    assert other.waiting() == []


def test_a_bag_that_a_crash_left_open_is_never_digested(tmp_path: Path) -> None:
    bag(tmp_path, 0)
    bag(tmp_path, 1, finish=False)
    assert fill_store(backfill_of(recalling(tmp_path), tmp_path)) == Progress(1, 0, 0)


def test_a_bag_that_changed_a_moment_ago_waits(tmp_path: Path) -> None:
    bag(tmp_path, 0)
    clock = SettableClock(time.time_ns())
    backfill = backfill_of(recalling(tmp_path, clock), tmp_path)
    [waiting] = backfill.waiting()
    assert not backfill.digest(waiting)
    clock.at += 3 * NS_PER_S
    assert backfill.digest(waiting)


def test_a_changed_bag_or_sidecar_has_the_bag_digested_again(tmp_path: Path) -> None:
    path = bag(tmp_path, 0)
    memory = recalling(tmp_path)
    fill_store(backfill_of(memory, tmp_path))
    write_handover(path.parent, Handover())
    assert len(backfill_of(recalling(tmp_path), tmp_path).waiting()) == 1
    fill_store(backfill_of(recalling(tmp_path), tmp_path))
    path.write_bytes(bag(tmp_path, 1).read_bytes())
    assert path in [each.path for each in backfill_of(recalling(tmp_path), tmp_path).waiting()]


class Counting(Digester):
    """Knows which bags it digested."""

    names: list[str]

    def digest(self, path: Path) -> Digest:
        self.names = [*getattr(self, "names", ()), path.name]
        return super().digest(path)


def content(catalogue: Catalogue, bag_dir: Path) -> dict[str, list[object]]:
    """Returns all that a catalogue knows of each bag, by its path below the directory."""
    files = catalogue.known_files(bag_dir)
    keys = {file: BagKey.of(bag, bag_dir) for file, bag in files.items()}
    numbers = dict(zip(keys, catalogue.find([*keys.values()]), strict=True))
    assert None not in numbers.values()
    return {
        os.path.relpath(file, bag_dir): [
            files[file].summary,
            *(
                each(topic, [number]).get(number)
                for topic in sorted({each.topic for each in files[file].summary.topics})
                for each in (
                    catalogue.relatched,
                    catalogue.undecodable,
                )
            ),
        ]
        for file, number in numbers.items()
        if number is not None
    }


def test_a_handover_has_only_those_bags_digested_again_that_it_changes(tmp_path: Path) -> None:
    bags = tmp_path / "bags"
    paths = [bag(bags, number) for number in range(4)]
    folder, cut = paths[0].parent, T0 + 35 * NS_PER_S
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
    for number, (handover, digested) in enumerate(steps):
        if handover is not None:
            write_handover(folder, handover)
            at = paths[0].stat().st_mtime + number
            os.utime(folder / HANDOVER_FILE, (at, at))
        memory = recalling(bags)
        digester = Counting(memory.reader)
        backfill = backfill_of(memory, bags, digester)
        assert fill_store(backfill) == Progress(4, 0, 0)
        assert getattr(digester, "names", []) == [paths[each].name for each in digested]
        copy = tmp_path / f"copy_{number}"
        shutil.copytree(bags, copy, ignore=shutil.ignore_patterns(FOLDER))
        fresh = backfill_of(recalling(copy), copy)
        fill_store(fresh)
        assert content(backfill.catalogue, bags) == content(fresh.catalogue, copy)
        assert backfill.waiting() == []
        backfill.catalogue.close()


class Meddling(Digester):
    """Something happens to the bag while it is read."""

    def digest(self, path: Path) -> Digest:
        found = super().digest(path)
        write_handover(path.parent, Handover())
        return found


class Failing(Digester):
    def digest(self, path: Path) -> Digest:
        raise BagError(str(path), "damaged in the middle")


def test_what_changed_while_it_was_read_is_not_kept(tmp_path: Path) -> None:
    bag(tmp_path, 0)
    memory = recalling(tmp_path)
    backfill = backfill_of(memory, tmp_path, Meddling(memory.reader))
    [waiting] = backfill.waiting()
    assert not backfill.digest(waiting)
    assert memory.recall is not None
    assert memory.recall.catalogue.paths() == []


def test_a_bag_that_cannot_be_digested_is_told_of_and_not_tried_for_ever(tmp_path: Path) -> None:
    bag(tmp_path, 0)
    memory = recalling(tmp_path)
    backfill = backfill_of(memory, tmp_path, Failing(memory.reader))
    assert fill_store(backfill) == Progress(1, 0, 1)
    assert len(queries.list_recorded_topics(memory, Call())) == 1


def test_entries_of_bags_that_are_gone_are_dropped(tmp_path: Path) -> None:
    paths = [bag(tmp_path, number) for number in range(3)]
    memory = recalling(tmp_path)
    fill_store(backfill_of(memory, tmp_path))
    paths[0].unlink()
    backfill_of(memory, tmp_path).prune()
    assert memory.recall is not None
    assert sorted(memory.recall.catalogue.paths()) == ["rec/rec_1.mcap", "rec/rec_2.mcap"]


def test_a_bag_directory_that_is_gone_for_a_while_keeps_its_entries(tmp_path: Path) -> None:
    bag_dir, elsewhere = tmp_path / "bags", tmp_path / "elsewhere"
    bag(bag_dir, 0)
    recall = DigestCache(Catalogue([tmp_path / FILE], DigestConfig("test")), bag_dir)
    memory = replace(memory_of(bag_dir), recall=recall)
    fill_store(backfill_of(memory, bag_dir))
    bag_dir.rename(elsewhere)
    backfill_of(memory, bag_dir).prune()
    assert recall.catalogue.paths() == ["rec/rec_0.mcap"]


async def test_in_the_background_what_closes_is_digested(tmp_path: Path) -> None:
    bag(tmp_path, 0)
    backfill = backfill_of(recalling(tmp_path), tmp_path)
    with anyio.fail_after(30):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(keep_backfilled, backfill, ["/no/such/program"], 0.001)
            while backfill.progress().waiting:
                await anyio.lowlevel.checkpoint()
            bag(tmp_path, 1)
            while backfill.progress() != Progress(2, 0, 0):
                await anyio.lowlevel.checkpoint()
            tasks.cancel_scope.cancel()


async def test_a_warm_up_begins_with_a_full_catalogue_and_ends_when_it_is_done(
    tmp_path: Path,
) -> None:
    bag(tmp_path, 0)
    backfill = backfill_of(recalling(tmp_path), tmp_path)
    begun: list[int] = []

    def warm_up() -> bool:
        begun.append(backfill.progress().waiting)
        return len(begun) == 2

    with anyio.fail_after(30):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(keep_backfilled, backfill, ["/no/such/program"], 0.001, warm_up)
            while len(begun) < 2:
                await anyio.lowlevel.checkpoint()
            bag(tmp_path, 1)
            while backfill.progress() != Progress(2, 0, 0):
                await anyio.lowlevel.checkpoint()
            tasks.cancel_scope.cancel()
    assert begun == [0, 0]


@pytest.mark.parametrize("helper", [["/no/such/program"], [sys.executable, "-c", "exit(3)"]])
async def test_a_backlog_is_worked_off_also_where_its_helper_fails(
    tmp_path: Path, helper: list[str]
) -> None:
    for number in range(BACKLOG + 2):
        bag(tmp_path, number)
    backfill = backfill_of(recalling(tmp_path), tmp_path)
    with anyio.fail_after(60):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(keep_backfilled, backfill, helper, 0.001)
            while backfill.progress().waiting:
                await anyio.lowlevel.checkpoint()
            tasks.cancel_scope.cancel()


async def test_health_tells_how_far_the_catalogue_is(tmp_path: Path) -> None:
    for number in range(3):
        bag(tmp_path, number)
    memory = recalling(tmp_path)
    backfill = backfill_of(memory, tmp_path)
    backfill.digest(backfill.waiting()[0])
    reply = await Health(memory, "1.2.3", backfill)()
    assert reply["catalogue"] == {"bags": 1, "waiting": 2, "refused": 0, "state": "filling"}
    backfill.catalogue.refusals, backfill.catalogue.refused_for = 2, "too large"
    reply = await Health(memory, "1.2.3", backfill)()
    assert reply["catalogue_refusals"] == {"count": 2, "reason": "too large"}
    (finding,) = check_catalogue(replace(memory, recall=DigestCache(backfill.catalogue, tmp_path)))
    assert "did not store 2 results (too large)" in finding.seen


# The command


@pytest.fixture
def own_logging() -> Iterator[None]:
    """Logging as it was before a command set it up."""
    root = logging.getLogger()
    level, handlers = root.level, root.handlers[:]
    root.handlers = []
    yield
    root.level, root.handlers = level, handlers
    logging.captureWarnings(capture=False)
    structlog.reset_defaults()


def test_the_last_line_counts_what_is_in_the_catalogue_and_what_cannot_be() -> None:
    shown = describe_progress(Progress(4, 0, 1))
    assert "3 of 4 bags are in the catalogue, 1 cannot be" in shown
    assert shown.count("#") == 30
    assert "0 of 0" in describe_progress(Progress(0, 0, 0))


@pytest.mark.usefixtures("own_logging")
def test_the_command_fills_the_catalogue_beside_the_bags(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MEMORY_BAG_DIR", str(recorded_before(tmp_path)))
    path = bag(tmp_path, 0)
    hour_ago = time.time_ns() - 3600 * NS_PER_S
    os.utime(path, ns=(hour_ago, hour_ago))
    assert main(["index"]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("1 of 1 bag is in the catalogue")
    assert (tmp_path / FOLDER / FILE).is_file()


@pytest.mark.usefixtures("own_logging")
def test_where_no_catalogue_can_be_written_the_command_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("MEMORY_BAG_DIR", str(tmp_path))
    (tmp_path / FOLDER).write_text("a file where a folder should be")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / FOLDER))
    assert main(["index"]) == 2
    assert "XDG_CACHE_HOME" in capsys.readouterr().err


@pytest.mark.usefixtures("own_logging")
def test_a_missing_bag_directory_is_what_the_command_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert main(["index", "--bag-dir", str(tmp_path / "gone")]) == 2
    assert "the bag directory does not exist" in capsys.readouterr().err


@pytest.mark.usefixtures("own_logging")
def test_the_command_counts_the_warnings_of_the_log_instead_of_showing_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "rec_0.mcap").touch()
    hour_ago = time.time_ns() - 3600 * NS_PER_S
    os.utime(tmp_path / "rec" / "rec_0.mcap", ns=(hour_ago, hour_ago))
    assert main(["index", "--bag-dir", str(tmp_path)]) == 0
    reply = capsys.readouterr().err
    assert "1 warning logged (bag_damaged)" in reply
    assert '"event"' not in reply


def test_texts_of_the_newest_bag_are_found_before_and_after_it_is_digested(tmp_path: Path) -> None:
    write_mcap(tmp_path / "rec" / "rec_0.mcap", [text(T0, "scissors")])
    memory = recalling(tmp_path)
    before = queries.find_last_match(memory, Call(), "/chatter", "contains", "scissors")
    fill_store(backfill_of(memory, tmp_path))
    assert queries.find_last_match(memory, Call(), "/chatter", "contains", "scissors") == before
    assert before.found is not None
