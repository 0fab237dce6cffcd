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
from ros2_memory.index.segment import Tally

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from ros2_memory.core.timebase import Ns
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


class _Stamp(NamedTuple):
    """Of a metadata.yaml; the mtime of its folder shows names that were added and deleted."""

    mtime_ns: Ns
    size: int
    folder_mtime_ns: Ns


class _FolderListing(NamedTuple):
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


Listings: TypeAlias = "dict[str, tuple[_Stamp, _FolderListing]]"
"""By folder: how it was when its metadata.yaml was read, and what that listed."""


def listing_to_json(stamp: _Stamp, listing: _FolderListing) -> str:
    """Returns what was read of a folder as one line."""
    return json.dumps([stamp, listing])


def listing_from_json(text: str) -> tuple[_Stamp, _FolderListing]:
    """Returns what was read of a folder.

    Raises:
        ValueError, TypeError, OverflowError: the text is nothing of that kind.
    """
    (mtime, size, folder), (first, later, bags, messages, is_total) = json.loads(text)
    return _Stamp(mtime, size, folder), _FolderListing(
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
    for folder, listing in _folder_listings(snapshot, bag_dir, known):
        if listing is None or listing.bags is None:
            absent.append(Absent(folder, unreadable=True))
            continue
        # Asked only where the first file is missing: it takes longer than all else here.
        is_own = bool(listing.first) and _may_be_deleted(own, bag_dir, Path(folder))
        of_recording = deleted.get(folder.removeprefix(f"{bag_dir}/"))
        gone = frozenset[str]() if of_recording is None else frozenset(of_recording.files)
        present = Tally(bags[folder], messages[folder])
        absent.append(_absent_from(folder, listing, present, gone, is_own=is_own))
    return [
        recording
        for recording in absent
        if recording.files or recording.messages or recording.unreadable
    ]


def absent_files(absent: Sequence[Absent]) -> list[SetAside]:
    """Returns missing files as closed files that cannot be read."""
    return [
        SetAside(Path(recording.folder) / name, _MISSING)
        for recording in absent
        for name in recording.files
    ]


def describe_absent(absent: Sequence[Absent]) -> Iterator[str]:
    """Yields sentences on what is missing: counted, with the first few recordings named."""
    missing = [recording for recording in absent if not recording.unreadable]
    if missing:
        parts = []
        if files := sum(len(recording.files) for recording in missing):
            parts.append(counted(files, "missing file", "missing files"))
        if messages := sum(recording.messages for recording in missing):
            parts.append(f"{counted(messages, 'message')} that no file here contains")
        yield f"metadata.yaml of {_names(missing)} lists {' and '.join(parts)}"
    unreadable = [recording for recording in absent if recording.unreadable]
    if unreadable:
        yield f"metadata.yaml of {_names(unreadable)} cannot be read: what it lists is not compared"


def _names(absent: Sequence[Absent]) -> str:
    names = [PurePosixPath(recording.folder).name for recording in absent]
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


def _absent_from(
    folder: str, listing: _FolderListing, present: Tally, gone: Collection[str], *, is_own: bool
) -> Absent:
    """Returns what a folder lists and its bags do not hold.

    `gone` are names of files that retention deleted.
    """
    expected = listing.later if is_own else (*listing.first, *listing.later)
    missing = [(name, count) for name, count in expected if name not in gone]
    lost = sum(count for _, count in missing)
    # A bag that is damaged or cut by a handover holds fewer that count, and is not compared. Nor is
    # the number of all files together, where some were deleted.
    is_comparable = present.bags == listing.bags and not (listing.is_total and (is_own or gone))
    if listing.messages is not None and is_comparable:
        lost += max(listing.messages - present.messages, 0)
    return Absent(folder, tuple(name for name, _ in missing), lost)


def _folder_listings(
    snapshot: Snapshot, bag_dir: Path, known: Listings
) -> Iterator[tuple[str, _FolderListing | None]]:
    """Yields the folders with a metadata.yaml that is not being written, and what that lists.

    None where the folder or the file cannot be read. What was read is added to `known`.
    """
    now = snapshot.scanned_at
    for folder in snapshot.metadata_folders:
        try:
            stamp = _stamp_of(folder)
            if not settled(stamp.mtime_ns, now):
                continue
            read_at, listing = known.get(folder, (None, None))
            if listing is None or read_at != stamp:
                listing = _read_listing(bag_dir, folder)
        except FileNotFoundError:
            continue
        except (OSError, ValueError):
            yield folder, None
            continue
        # A folder that changed just now may change again within the same mtime.
        if settled(stamp.folder_mtime_ns, now):
            known[folder] = stamp, listing
        yield folder, listing
    if len(known) > _MAX_CACHED_FOLDERS:
        known.clear()


def _stamp_of(folder: str) -> _Stamp:
    # As texts: a path for each folder takes longer than to look at it.
    status = os.lstat(f"{folder}/{METADATA_FILE}")
    changed = os.stat(folder).st_mtime_ns  # noqa: PTH116
    return _Stamp(status.st_mtime_ns, status.st_size, changed)


def _read_listing(bag_dir: Path, folder: str) -> _FolderListing:
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
        return _FolderListing()
    counts = listing.messages
    there = [name for name in names if name in present]
    missing = [(name, counts.get(name, 0)) for name in names if name not in present]
    begun = names.index(there[0]) if there else len(names)
    messages = sum(counts.get(name, 0) for name in there) if counts else listing.total
    return _FolderListing(
        tuple(missing[:begun]),
        tuple(missing[begun:]),
        bags=sum(counts.get(name, 1) > 0 for name in there),
        messages=None if HANDOVER_FILE in files else messages,
        is_total=not counts,
    )
