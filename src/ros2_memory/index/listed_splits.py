"""Files that a recording's `metadata.yaml` lists and that are not there.

rosbag2 writes metadata.yaml at a clean end, with every file of the recording. Files that were lost
since, or never copied, leave no other trace.
"""

from __future__ import annotations

import os
from collections import Counter
from functools import lru_cache
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.heartbeat import HEARTBEAT_FILE
from ros2_memory.bag_dir.layout import HANDOVER_FILE, METADATA_FILE, bag_kind
from ros2_memory.bag_dir.metadata_yaml import Listing, bare_name, read_listing
from ros2_memory.bag_dir.state.own_recordings import OwnRecordings
from ros2_memory.core.directories import opened
from ros2_memory.core.model import SetAside
from ros2_memory.core.text import MAX_NAMED, counted, listed
from ros2_memory.index.scan import settled

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.index.snapshot import Snapshot

_MAX_CACHED_FOLDERS: Final = 8192
_MISSING: Final = "metadata.yaml lists it, but it is missing"


class Absent(NamedTuple):
    """What one recording's metadata.yaml lists and is not there.

    Attributes:
        folder: the recording's.
        files: names of the missing files.
        messages: how many messages it counts that no file here holds.
        unreadable: it cannot be read, so nothing was compared.
    """

    folder: str
    files: tuple[str, ...] = ()
    messages: int = 0
    unreadable: bool = False


class _Folder(NamedTuple):
    """A recording's folder: what its metadata.yaml lists, and which bag files lie there.

    Names are without `.zstd`.
    """

    listing: Listing
    present: frozenset[str]
    has_handover: bool


def absent_splits(snapshot: Snapshot, bag_dir: Path) -> list[Absent]:
    """Returns what is missing of the recordings of a snapshot.

    A recorder of ours deletes the oldest splits of its recordings, whose metadata.yaml still lists
    them: those before the first split that is left are not missing.
    """
    if not snapshot.metadata_folders:
        return []
    own = OwnRecordings(bag_dir)
    bags: Counter[str] = Counter()
    messages: Counter[str] = Counter()
    for segment in snapshot.timeline.segments:
        for name, tally in segment.tallies.items():
            bags[name] += tally.bags
            messages[name] += tally.messages
    absent = []
    for path in snapshot.metadata_folders:
        try:
            folder = _folder(bag_dir, path, snapshot.scanned_at)
        except FileNotFoundError:
            continue
        except (OSError, ValueError):
            absent.append(Absent(path, unreadable=True))
            continue
        if folder is not None:
            # Asked only where the first file is missing: it takes longer than all else here.
            begins = folder.present.issuperset(folder.listing.names[:1])
            is_own = not begins and _may_be_deleted(own, bag_dir, Path(path))
            absent.append(_compare(path, folder, bags[path], messages[path], is_own=is_own))
    return [each for each in absent if each.files or each.messages or each.unreadable]


def absent_files(snapshot: Snapshot, bag_dir: Path) -> list[SetAside]:
    """Returns the missing files of `absent_splits`, as closed files that cannot be read."""
    return [
        SetAside(Path(each.folder) / name, _MISSING)
        for each in absent_splits(snapshot, bag_dir)
        for name in each.files
    ]


def describe_absent(absent: Sequence[Absent]) -> Iterator[str]:
    """Yields sentences on what is missing: counted, with the first few recordings named."""
    missing = [each for each in absent if not each.unreadable]
    if missing:
        parts = []
        if files := sum(len(each.files) for each in missing):
            parts.append(counted(files, "missing file", "missing files"))
        if messages := sum(each.messages for each in missing):
            noun, plural = (
                "message that no file here contains",
                "messages that no file here contains",
            )
            parts.append(counted(messages, noun, plural))
        yield f"metadata.yaml of {_names(missing)} lists {' and '.join(parts)}"
    unreadable = [each for each in absent if each.unreadable]
    if unreadable:
        yield f"metadata.yaml of {_names(unreadable)} cannot be read: what it lists is not compared"


def _names(absent: Sequence[Absent]) -> str:
    names = [PurePosixPath(each.folder).name for each in absent]
    return listed(names[:MAX_NAMED], len(names))


def _may_be_deleted(own: OwnRecordings, bag_dir: Path, folder: Path) -> bool:
    """Returns whether the recorder of the bag directory deletes splits of a recording."""
    try:
        if own.exists():
            return own.owns(folder)
        # Versions before the list of own recordings may have deleted any.
        return (bag_dir / HEARTBEAT_FILE).exists()
    except OSError:
        return True


def _compare(path: str, folder: _Folder, bags: int, messages: int, *, is_own: bool) -> Absent:
    """Compares a listing with the files beside it: `bags` bags, which hold `messages` messages."""
    listing = folder.listing
    if not listing.names:
        return Absent(path, unreadable=True)
    names = listing.names
    deleted = takewhile(lambda name: name not in folder.present, names) if is_own else ()
    expected = names[len([*deleted]) :]
    missing = [name for name in expected if name not in folder.present]
    there = [name for name in names if name in folder.present]
    lost = sum(listing.messages.get(name, 0) for name in missing)
    # A bag that is damaged or cut by a handover holds fewer that count, and is not compared.
    if not folder.has_handover and bags == sum(listing.messages.get(name, 1) > 0 for name in there):
        if listing.messages:
            lost += max(sum(listing.messages.get(name, 0) for name in there) - messages, 0)
        elif listing.total is not None and expected == names:
            lost += max(listing.total - messages, 0)
    return Absent(path, tuple(missing), lost)


def _folder(bag_dir: Path, folder: str, now: int) -> _Folder | None:
    """Reads a folder with a metadata.yaml; None while that is being written.

    Raises:
        OSError: the folder or the file cannot be read.
        ValueError: metadata.yaml is not a regular file.
    """
    # As texts: a path for each folder takes longer than to look at it.
    status = os.lstat(f"{folder}/{METADATA_FILE}")
    changed = os.stat(folder).st_mtime_ns  # noqa: PTH116
    if not settled(status.st_mtime_ns, now):
        return None
    # A folder that changed just now may change again within the same mtime: it is not cached.
    read = _read_folder if settled(changed, now) else _read_folder.__wrapped__
    return read(bag_dir, folder, (status.st_mtime_ns, status.st_size, changed))


@lru_cache(maxsize=_MAX_CACHED_FOLDERS)
def _read_folder(bag_dir: Path, folder: str, _stamp: tuple[int, int, int]) -> _Folder:
    with opened(bag_dir, Path(folder)) as descriptor:
        names = os.listdir(descriptor)  # noqa: PTH208 - of a descriptor
        listing = read_listing(METADATA_FILE, descriptor)
    present = frozenset(bare_name(name) for name in names if bag_kind(name))
    unique = tuple(dict.fromkeys(map(bare_name, listing.names)))
    return _Folder(listing._replace(names=unique), present, HANDOVER_FILE in names)
