"""Files that a recording's `metadata.yaml` lists and that are not there.

rosbag2 writes metadata.yaml at a clean end, with every file of the recording. Files that were lost
since, or never copied, leave no other trace.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.bag_dir.heartbeat import HEARTBEAT_FILE
from ros2_memory.bag_dir.layout import HANDOVER_FILE, METADATA_FILE, bag_kind
from ros2_memory.bag_dir.metadata_yaml import bare_name, read_listing
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bag_dir.state_files import read_deleted
from ros2_memory.core.directories import opened
from ros2_memory.core.model import SetAside
from ros2_memory.core.text import MAX_NAMED, counted, listed
from ros2_memory.index.scan import settled

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from ros2_memory.index.snapshot import Snapshot

_MAX_CACHED_FOLDERS: Final = 65_536
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


_Stamp: TypeAlias = "tuple[int, int, int]"
"""Mtime and size of a metadata.yaml, and mtime of its folder: of names added and deleted."""


class _Listed(NamedTuple):
    """A recording's metadata.yaml compared with the bag files in its folder.

    Attributes:
        first: names (without `.zstd`) and messages of the missing files before any that is there.
        later: those of all others that are missing.
        bags: how many of the files that are there hold a message by it; None: it lists no file.
        messages: of these, or of all files where `is_total`; None where that is not known.
        is_total: it has no number for each file.
    """

    first: tuple[tuple[str, int], ...] = ()
    later: tuple[tuple[str, int], ...] = ()
    bags: int | None = None
    messages: int | None = None
    is_total: bool = False


Listings: TypeAlias = "dict[str, tuple[_Stamp, _Listed]]"
"""By folder: how it was when its metadata.yaml was read, and what that listed."""


def listing_to_json(stamp: _Stamp, listed_there: _Listed) -> str:
    """Returns what was read of a folder as one line."""
    return json.dumps([stamp, listed_there])


def listing_from_json(text: str) -> tuple[_Stamp, _Listed]:
    """Returns what was read of a folder.

    Raises:
        ValueError, TypeError, OverflowError: the text is nothing of that kind.
    """
    (mtime, size, folder), (first, later, bags, messages, is_total) = json.loads(text)
    return (mtime, size, folder), _Listed(
        tuple((str(name), int(count)) for name, count in first),
        tuple((str(name), int(count)) for name, count in later),
        None if bags is None else int(bags),
        None if messages is None else int(messages),
        bool(is_total),
    )


def absent_splits(snapshot: Snapshot, bag_dir: Path, known: Listings) -> list[Absent]:
    """Returns what is missing of the recordings of a snapshot; `known` are listings of before.

    A recorder of ours deletes splits of its recordings, whose metadata.yaml still lists them. Those
    that it noted are not missing, nor are those before the first split that is left: versions
    before the notes deleted the oldest.
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
    absent, deleted = [], read_deleted(bag_dir)
    for path, listed_there in _listed(snapshot, bag_dir, known):
        if listed_there is None or listed_there.bags is None:
            absent.append(Absent(path, unreadable=True))
            continue
        # Asked only where the first file is missing: it takes longer than all else here.
        is_own = bool(listed_there.first) and _may_be_deleted(own, bag_dir, Path(path))
        noted = deleted.get(path.removeprefix(f"{bag_dir}/"))
        gone = frozenset[str]() if noted is None else frozenset(noted.files)
        absent.append(_compare(path, listed_there, bags[path], messages[path], gone, is_own=is_own))
    return [each for each in absent if each.files or each.messages or each.unreadable]


def absent_files(absent: Sequence[Absent]) -> list[SetAside]:
    """Returns missing files as closed files that cannot be read."""
    return [SetAside(Path(each.folder) / name, _MISSING) for each in absent for name in each.files]


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


def _compare(
    path: str, found: _Listed, bags: int, messages: int, gone: Collection[str], *, is_own: bool
) -> Absent:
    """Compares what is listed with the bags of a folder, which hold `messages` messages.

    `gone` are names of files that retention deleted.
    """
    every = found.later if is_own else (*found.first, *found.later)
    missing = [each for each in every if each[0] not in gone]
    lost = sum(count for _, count in missing)
    # A bag that is damaged or cut by a handover holds fewer that count, and is not compared. Nor is
    # the number of all files together, where some were deleted.
    is_comparable = bags == found.bags and not (found.is_total and (is_own or gone))
    if found.messages is not None and is_comparable:
        lost += max(found.messages - messages, 0)
    return Absent(path, tuple(name for name, _ in missing), lost)


def _listed(
    snapshot: Snapshot, bag_dir: Path, known: Listings
) -> Iterator[tuple[str, _Listed | None]]:
    """Yields the folders with a metadata.yaml that is not being written, and what that lists.

    None where the folder or the file cannot be read.
    """
    now = snapshot.scanned_at
    for path in snapshot.metadata_folders:
        try:
            stamp = _stamp(path)
            if not settled(stamp[0], now):
                continue
            listing = known.get(path)
            if listing is None or listing[0] != stamp:
                listing = stamp, _read(bag_dir, path)
        except FileNotFoundError:
            continue
        except (OSError, ValueError):
            yield path, None
            continue
        # A folder that changed just now may change again within the same mtime.
        if settled(stamp[2], now):
            known[path] = listing
        yield path, listing[1]
    if len(known) > _MAX_CACHED_FOLDERS:
        known.clear()


def _stamp(folder: str) -> _Stamp:
    # As texts: a path for each folder takes longer than to look at it.
    status = os.lstat(f"{folder}/{METADATA_FILE}")
    return status.st_mtime_ns, status.st_size, os.stat(folder).st_mtime_ns  # noqa: PTH116


def _read(bag_dir: Path, folder: str) -> _Listed:
    """Reads a folder with a metadata.yaml.

    Raises:
        OSError: the folder or the file cannot be read.
        ValueError: metadata.yaml is not a regular file.
    """
    with opened(bag_dir, Path(folder)) as descriptor:
        files = os.listdir(descriptor)  # noqa: PTH208 - of a descriptor
        listing = read_listing(METADATA_FILE, descriptor)
    present = {bare_name(name) for name in files if bag_kind(name)}
    names = tuple(dict.fromkeys(map(bare_name, listing.names)))
    if not names:
        return _Listed()
    counts = listing.messages
    there = [name for name in names if name in present]
    missing = [(name, counts.get(name, 0)) for name in names if name not in present]
    begun = names.index(there[0]) if there else len(names)
    messages = sum(counts.get(name, 0) for name in there) if counts else listing.total
    return _Listed(
        tuple(missing[:begun]),
        tuple(missing[begun:]),
        bags=sum(counts.get(name, 1) > 0 for name in there),
        messages=None if HANDOVER_FILE in files else messages,
        is_total=not counts,
    )
