"""Files that a recording's `metadata.yaml` lists and that are missing.

rosbag2 writes metadata.yaml at a clean end and lists every file of the recording. A file that was
lost since, or never copied, leaves no other trace.
"""

from __future__ import annotations

import json
import os
from collections import Counter, defaultdict
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

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
    """What one recording lacks of what its metadata.yaml lists.

    Attributes:
        folder: the path of the recording.
        files: names of the missing files.
        messages: how many of the counted messages no file here holds.
        unreadable: whether metadata.yaml cannot be read, so that nothing was compared.
    """

    folder: str
    files: tuple[str, ...] = ()
    messages: int = 0
    unreadable: bool = False


class _Stamp(NamedTuple):
    """The stat result of a metadata.yaml, and the mtime of its folder.

    The mtime of the folder changes when files are added or deleted.
    """

    mtime_ns: Ns
    size: int
    folder_mtime_ns: Ns


class _FolderListing(NamedTuple):
    """A recording's metadata.yaml compared with the bag files in its folder.

    Attributes:
        first: the missing files before the first file that is there: names without `.zstd`, and
            numbers of messages.
        later: the other missing files.
        bags: how many files that are there should hold a message; None if no file is listed.
        messages: how many messages these should hold; None if unknown.
        is_total: `messages` counts all files: metadata.yaml has no number for each file.
    """

    first: tuple[tuple[str, int], ...] = ()
    later: tuple[tuple[str, int], ...] = ()
    bags: int | None = None
    messages: int | None = None
    is_total: bool = False


Listings: TypeAlias = "dict[str, tuple[_Stamp, _FolderListing]]"
"""By folder: its stamp when its metadata.yaml was read, and the comparison."""


def listing_to_json(stamp: _Stamp, listing: _FolderListing) -> str:
    """Returns the listing of a folder as one line."""
    return json.dumps([stamp, listing])


def listing_from_json(text: str) -> tuple[_Stamp, _FolderListing]:
    """Returns the listing of a folder from its line.

    Raises:
        ValueError, TypeError, OverflowError: the text has another form.
    """
    stamp, (first, later, *others) = json.loads(text)
    listing = _FolderListing(tuple(map(tuple, first)), tuple(map(tuple, later)), *others)
    return _Stamp(*stamp), listing


def absent_splits(snapshot: Snapshot, bag_dir: Path, known: Listings) -> list[Absent]:
    """Returns what recordings of a snapshot lack; adds what it reads to the `known` listings.

    Our recorder deletes splits that metadata.yaml still lists. A split that it noted as deleted is
    not missing. Nor is one before the first split that is left: of a recording of many splits, it
    deletes the oldest first, and of too many it keeps no note.
    """
    if not snapshot.metadata_folders:
        return []
    own, deletions, present = OwnRecordings(bag_dir), read_deleted(bag_dir), _tallies(snapshot)
    empty = Counter(str(path.parent) for path in snapshot.empty)
    absent: list[Absent] = []
    for folder, listing in _folder_listings(snapshot, bag_dir, known):
        if listing is None or listing.bags is None:
            absent.append(Absent(folder, unreadable=True))
            continue
        # The slowest check of all, needed only if the first file is missing.
        is_own = bool(listing.first) and _may_be_own(own, Path(folder))
        deletion = deletions.get(folder.removeprefix(f"{bag_dir}/"))
        deleted = frozenset[str]() if deletion is None else frozenset(deletion.files)
        lack = _compare(folder, listing, present[folder], empty[folder], deleted, is_own=is_own)
        if lack.files or lack.messages:
            absent.append(lack)
    return absent


def _tallies(snapshot: Snapshot) -> dict[str, Tally]:
    """Returns by folder the number of its bags and of their messages."""
    tallies: dict[str, Tally] = defaultdict(Tally)
    for segment in snapshot.timeline.segments:
        for folder, (bags, messages) in segment.tallies.items():
            known = tallies[folder]
            tallies[folder] = Tally(known.bags + bags, known.messages + messages)
    return tallies


def absent_files(absent: Sequence[Absent]) -> list[SetAside]:
    """Returns the missing files as files that cannot be read."""
    return [
        SetAside(Path(recording.folder) / name, _MISSING)
        for recording in absent
        for name in recording.files
    ]


def describe_absent(absent: Sequence[Absent]) -> Iterator[str]:
    """Yields a sentence on missing files and messages, and one on unreadable listings.

    The first few recordings are named.
    """
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


def _may_be_own(own: OwnRecordings, folder: Path) -> bool:
    """Returns whether our recorder may have made a recording: if not, it deleted no split of it."""
    try:
        return own.owns(folder)
    except OSError:
        return True


def _compare(
    folder: str,
    listing: _FolderListing,
    present: Tally,
    empty: int,
    deleted: Collection[str],
    *,
    is_own: bool,
) -> Absent:
    """Returns what a folder lists and its bags do not hold.

    `present` counts its bags and their messages, `empty` its closed bags without a message;
    `deleted` names the files that retention deleted.
    """
    expected = listing.later if is_own else (*listing.first, *listing.later)
    missing = [(name, count) for name, count in expected if name not in deleted]
    lost = sum(count for _, count in missing)
    # A bag that is damaged, or cut by a handover, holds fewer messages than are listed. A total
    # also counts the files that were deleted.
    is_comparable = 0 <= (listing.bags or 0) - present.bags <= empty
    if listing.is_total and (is_own or deleted):
        is_comparable = False
    if listing.messages is not None and is_comparable:
        lost += max(listing.messages - present.messages, 0)
    return Absent(folder, tuple(name for name, _ in missing), lost)


def _folder_listings(
    snapshot: Snapshot, bag_dir: Path, known: Listings
) -> Iterator[tuple[str, _FolderListing | None]]:
    """Yields folders with a metadata.yaml that is not being written, and their listings.

    A listing is None if the folder or the file cannot be read. Others are added to `known`.
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
    # A `Path` for each folder would take longer than the system calls.
    status = os.lstat(f"{folder}/{METADATA_FILE}")
    changed = os.stat(folder).st_mtime_ns  # noqa: PTH116
    return _Stamp(status.st_mtime_ns, status.st_size, changed)


def _read_listing(bag_dir: Path, folder: str) -> _FolderListing:
    """Compares a folder with its metadata.yaml.

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
