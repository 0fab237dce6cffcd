"""Rewrites a bag without some of its messages: replaces the old file, and syncs it."""

from __future__ import annotations

import os
import stat
from collections import Counter
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from ros2_memory.bag_dir.durable_write import flush
from ros2_memory.bag_dir.layout import bag_kind
from ros2_memory.bag_dir.metadata_yaml import bare_name, recounted
from ros2_memory.core import directories
from ros2_memory.core.errors import BagError
from ros2_memory.retention.delete import repair_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from ros2_memory.core.timebase import Ns
    from ros2_memory.storage.base import BagReader, BagWriter

Identity = tuple[int, int]


@contextmanager
def beside(path: Path) -> Iterator[Path]:
    """Yields a name beside a bag for its new content; nothing has that name after the block.

    Raises:
        OSError: what an interrupted block left under that name cannot be deleted.
    """
    new = path.with_name(repair_name(path.name))
    new.unlink(missing_ok=True)
    try:
        yield new
    finally:
        with suppress(OSError):
            new.unlink(missing_ok=True)


def give_attributes(new: Path, before: os.stat_result, mtime_ns: Ns) -> None:
    """Gives a file the mode and, where that is allowed, the owner of another; and its times."""
    new.chmod(stat.S_IMODE(before.st_mode))
    with suppress(OSError):
        os.chown(new, before.st_uid, before.st_gid)
    os.utime(new, ns=(before.st_atime_ns, mtime_ns))


@contextmanager
def rewritten(
    bag_dir: Path,
    path: Path,
    before: os.stat_result,
    writer: BagWriter,
    *,
    takes: Callable[[str, Ns, Ns], bool],
    expected: Counter[str],
    left_of: Mapping[str, Counter[str]],
) -> Iterator[Path]:
    """Yields the new file, beside the old one; it takes the name of the old one after the block.

    Args:
        bag_dir: the bag directory, behind no link in which the file must lie.
        path: the old file.
        before: its status; the file must still be the same at the end.
        writer: rewrites it.
        takes: whether a message goes, by topic, log time and publish time.
        expected: how many messages go, by topic.
        left_of: what every file of the recording holds afterwards, see `recounted`.

    Raises:
        EpisodicError: it cannot be rewritten; nothing is changed.
        OSError: likewise, or it is another file now.
    """
    with directories.opened(bag_dir, path.parent) as folder:
        here = Path(f"/proc/self/fd/{folder}", path.name)
        with beside(here) as new:
            taken = writer.cut(here, new, takes, lambda text: recounted(text, left_of))
            if taken != expected:
                raise BagError(str(path), "its contents changed meanwhile")
            # A nanosecond later: nobody may take the new file for the old one.
            give_attributes(new, before, before.st_mtime_ns + 1)
            yield new
            replace_file(new, here, (before.st_dev, before.st_ino))


def replace_file(new: Path, path: Path, inode: Identity) -> None:
    """Gives a file the name of another, which must still be the one that was read.

    Raises:
        OSError: it is not, or has gone.
    """
    status = path.lstat()
    if (status.st_dev, status.st_ino) != inode:
        raise OSError(f"{path.name} is not the file that was read")
    new.replace(path)
    flush(path.parent)


def left_in(
    recording: Path, reader: BagReader, gone: Mapping[Path, Counter[str]]
) -> dict[str, Counter[str]]:
    """Returns how many messages of each topic are left in each file that can be read, by name."""
    files: dict[str, Counter[str]] = {}
    for path in filter(lambda each: bag_kind(each.name), recording.iterdir()):
        with suppress(BagError):
            counts = Counter[str]()
            for topic in reader.summarize(path).topics:
                counts[topic.topic] += topic.count
            files[bare_name(path.name)] = counts - gone.get(path, Counter())
    return files
