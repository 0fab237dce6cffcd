"""A disk that is mounted below the bag directory, and taken away under a memory."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from subprocess import CalledProcessError
from typing import Any

from structlog.testing import capture_logs

from ros2_memory.history.context import Memory
from ros2_memory.recorder.housekeeping import Housekeeping
from tests.faults.small_disk import mount, needs_mounts, small_disk, unmount
from tests.support.bags import Msg, boolean, write_mcap
from tests.support.clocks import SettableClock
from tests.support.housekeepers import keeper_of
from tests.support.memories import asked, each_way, memory_of

S = 10**9
T0 = 1_790_000_400 * S
pytestmark = needs_mounts


def write_minutes(folder: Path, first: int, last: int) -> None:
    """A recording of a bag for each minute; the bumper was pressed in the first second of each."""
    for minute in range(first, last):
        begin = T0 + 60 * minute * S
        messages: list[Msg] = [boolean(begin + n * S, n == 0) for n in range(60)]
        name = f"{folder.name}_{minute - first}.mcap"
        bag = write_mcap(folder / folder.name / name, messages)
        os.utime(bag, ns=(begin, begin + 60 * S))


def pressed(memory: Memory, minute: int) -> Any:
    begin = T0 / S + 60 * minute
    span = {"start": begin, "end": begin + 59}
    return asked(memory, "get_topic_in_range", topic="/bumper", max_samples=5, **span)


@contextmanager
def mounted_below(bag_dir: Path, disk: Path) -> Iterator[Path]:
    """A disk at a folder of the bag directory; who takes it away may mount it again."""
    ssd = bag_dir / "ssd"
    ssd.mkdir(parents=True)
    with small_disk(disk, "16m"):
        mount(ssd, "--bind", str(disk))
        try:
            yield ssd
        finally:
            with suppress(CalledProcessError):  # it is away
                unmount(ssd)


@each_way
def test_bags_whose_disk_is_away_are_neither_gone_nor_unrecorded(
    tmp_path: Path, recalls: bool
) -> None:
    bag_dir, disk = tmp_path / "bags", tmp_path / "disk"
    with mounted_below(bag_dir, disk) as ssd:
        write_minutes(ssd, 0, 3)
        write_minutes(bag_dir, 3, 5)
        memory = memory_of(bag_dir, clock=SettableClock(T0 + 3600 * S), recalls=recalls)
        right, whole = pressed(memory, 1), memory.index.snapshot()
        unmount(ssd)
        away = memory.index.snapshot()
        assert [bag.file for bag in away.bags] == [bag.file for bag in whole.bags]
        assert [*away.gaps] == [*whole.gaps] == []
        [aside] = away.damaged
        assert (aside.path, "unmounted" in aside.reason) == (ssd, True)
        told = pressed(memory, 1)
        assert "unmounted" in str(told)
        assert "deleted" not in str(told)
        assert "nothing was recorded" not in str(told)
        wanted = {"topic": "/bumper", "condition_type": "equals", "value": True}
        assert "unmounted" in str(asked(memory, "find_last_match", **wanted, before=T0 / S + 60))
        mount(ssd, "--bind", str(disk))
        assert pressed(memory, 1) == right
        assert [*memory.index.snapshot().damaged] == []
        unmount(ssd)
        ssd.rmdir()
        assert len(memory.index.snapshot().bags) == 5


def test_bags_whose_disk_is_away_are_not_deleted_for_others(tmp_path: Path) -> None:
    """They are the oldest, but nothing becomes free by deleting them, nor do they take room."""
    bag_dir, disk = tmp_path / "bags", tmp_path / "disk"

    def deleted(keeper: Housekeeping) -> list[int]:
        with capture_logs() as logs:
            keeper.apply()
        return [log["bags"] for log in logs if log["event"] == "retention_applied"]

    with mounted_below(bag_dir, disk) as ssd:
        write_minutes(ssd, 0, 3)
        write_minutes(bag_dir, 3, 5)
        size = sum(path.stat().st_size for path in bag_dir.rglob("*.mcap"))
        keeper = keeper_of(bag_dir, max_bytes=size + 100)
        assert deleted(keeper) == [0]
        unmount(ssd)
        write_minutes(bag_dir, 3, 9)
        assert deleted(keeper) == [1]
        assert not (bag_dir / "bags" / "bags_0.mcap").exists()
        mount(ssd, "--bind", str(disk))
        assert len([*ssd.rglob("*.mcap")]) == 3
        assert deleted(keeper) == [3]
        assert not [*ssd.rglob("*.mcap")]
