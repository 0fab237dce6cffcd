"""A housekeeper over a folder of bags, as the recorder's daemon has one."""

from __future__ import annotations

import shutil
import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, write_heartbeat
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.recorder.housekeeping import Housekeeping
from ros2_memory.retention.policy import RetentionLimits
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.rosbag2_reader import Rosbag2Reader
from tests.support.clocks import SettableClock

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from ros2_memory.core.timebase import Clock
    from ros2_memory.storage.base import BagReader, BagWriter

PLENTY = 10**15
HOUR = 3600 * NS_PER_S


def keeper_of(
    bag_dir: Path,
    *,
    max_bytes: int = PLENTY,
    max_age_h: float = 10**6,
    clock: Clock | None = None,
    reader: BagReader | None = None,
    writer: BagWriter | None = None,
    grace_s: float = 0.0,
    moments_bytes: int = PLENTY,
    monotonic: Callable[[], float] = time.monotonic,
    measure_free: Callable[[Path], int] = lambda _: PLENTY,
    is_synchronised: Callable[[], bool] = lambda: True,
    keeps_foreign: bool = False,
) -> Housekeeping:
    """A housekeeper, mostly of all bags, whoever made them (retention.foreign=delete).

    Its clock is right, and an hour later unless one is given.
    """
    return Housekeeping(
        bag_dir,
        BagDirReader(reader or McapReader()),
        writer or McapWriter(),
        clock or later(),
        RetentionLimits(max_bytes, round(max_age_h * HOUR), keeps_foreign=keeps_foreign),
        is_synchronised=is_synchronised,
        split_duration_s=10.0,
        moments_bytes=moments_bytes,
        static_topics=("/tf_static",),
        grace_s=grace_s,
        monotonic=monotonic,
        measure_free=measure_free,
    )


def reader_of_both() -> BagReader:
    """Reads either plugin's files."""
    return Rosbag2Reader()


def later(seconds: int = 3600) -> SettableClock:
    return SettableClock(time.time_ns() + seconds * NS_PER_S)


def recording_now(bag_dir: Path, *recordings: str, clock: Clock | None = None) -> None:
    """Has a recorder say that it is writing these recordings."""
    now = (clock or later()).now()
    write_heartbeat(
        bag_dir,
        Heartbeat(1, now, RecorderState.RECORDING, recordings, now, 0, (), (), None, 2.0),
    )


def recorded_before(bag_dir: Path) -> Path:
    """A bag directory in which a recorder was at work, long ago."""
    bag_dir.mkdir(parents=True, exist_ok=True)
    beat = Heartbeat(1, NS_PER_S, RecorderState.STOPPED, (), NS_PER_S, 0, (), (), None, 2.0)
    write_heartbeat(bag_dir, beat)
    return bag_dir


@contextmanager
def recorder_at_work(bag_dir: Path, clock: Clock) -> Iterator[None]:
    """A recorder that looks for wishes again and again, as the daemon does."""
    house, over = keeper_of(bag_dir, clock=clock), threading.Event()

    def work() -> None:
        while not over.wait(0.01):
            house.keep_moments()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def files_in(bag_dir: Path) -> list[str]:
    """Every file and directory, relative to the bag directory."""
    return sorted(path.relative_to(bag_dir).as_posix() for path in bag_dir.rglob("*"))


def size_of(bag_dir: Path) -> int:
    """The bytes of all files, each inode once."""
    sizes = {
        path.stat().st_ino: path.stat().st_size for path in bag_dir.rglob("*") if path.is_file()
    }
    return sum(sizes.values())


def copied(source: Path, target: Path) -> Path:
    """A copy of a folder that may be changed."""
    shutil.copytree(source, target)
    for path in (target, *target.rglob("*")):
        path.chmod(0o755 if path.is_dir() else 0o644)
    return target
