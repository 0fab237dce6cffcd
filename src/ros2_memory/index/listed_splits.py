"""What `metadata.yaml` of each recording lists, held against the files that lie beside it.

rosbag2 writes metadata.yaml at a clean end, with every file of the recording; versions 5 and later
give the messages of each file too (rosbag2_storage, `yaml.hpp`). Files that were lost since, or
never copied, leave no other trace.
"""

from __future__ import annotations

import os
import re
import stat
from collections import Counter
from functools import lru_cache
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.heartbeat import HEARTBEAT_FILE
from ros2_memory.bag_dir.layout import COMPRESSED, HANDOVER_FILE, METADATA_FILE, bag_kind
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.core.directories import opened
from ros2_memory.core.model import SetAside
from ros2_memory.core.text import MAX_NAMED, counted, listed
from ros2_memory.index.scan import settled

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.index.snapshot import Snapshot

_AS_IT_IS: Final = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | os.O_NOFOLLOW
_READ_AT_MOST: Final = 64 << 20
_AT_HAND: Final = 1024
_NOT_THERE: Final = "metadata.yaml lists it, and it is not there"
_NAME: Final = re.compile(r"^\s*(?:- )?(?:- |path:)\s*['\"]?([^'\"\n]+?)['\"]?\s*$", re.MULTILINE)
_FILES: Final = re.compile(r"^(\s*)files:\s*$", re.MULTILINE)
_FIELD: Final = re.compile(r"^\s*(?:- )?(path|message_count):\s*['\"]?([^'\"]+?)['\"]?\s*$")
_TOTAL: Final = re.compile(r"^ {2,4}message_count:\s*(\d+)\s*$", re.MULTILINE)


class Absent(NamedTuple):
    """What one recording's metadata.yaml lists and is not there.

    Attributes:
        folder: of the recording.
        files: names of the files that are not there.
        messages: how many messages it counts that no file here holds.
        unreadable: that it cannot be read, so that nothing of this was compared.
    """

    folder: str
    files: tuple[str, ...] = ()
    messages: int = 0
    unreadable: bool = False


class _Listing(NamedTuple):
    """Names in order, without `.zstd`; messages by name where they are given, and in all."""

    names: tuple[str, ...]
    messages: dict[str, int]
    total: int | None


class _Beside(NamedTuple):
    """A listing, and the names of the files (without `.zstd`) that lie beside it."""

    listing: _Listing | None
    present: frozenset[str]
    is_joined: bool


def absent_splits(snapshot: Snapshot, bag_dir: Path) -> list[Absent]:
    """What is not there of the recordings of a snapshot; nothing where all that is listed is.

    Where a recorder of ours deletes the oldest splits, those before the first one that is left
    are not counted: their recording's metadata.yaml still lists them.
    """
    if not snapshot.described:
        return []
    own = OwnRecordings(bag_dir)
    bags: Counter[str] = Counter()
    messages: Counter[str] = Counter()
    for run in snapshot.runs:
        for folder, tally in run.tallies.items():
            bags[folder] += tally.bags
            messages[folder] += tally.messages
    found = []
    for folder in snapshot.described:
        try:
            beside = _beside(bag_dir, Path(folder), snapshot.scanned_at)
        except FileNotFoundError:
            continue
        except (OSError, ValueError):
            found.append(Absent(folder, unreadable=True))
            continue
        if beside is None:
            continue
        is_ours = _may_be_deleted(own, bag_dir, Path(folder))
        absent = _absent(folder, beside, bags[folder], messages[folder], is_ours=is_ours)
        if absent.files or absent.messages or absent.unreadable:
            found.append(absent)
    return found


def absent_files(snapshot: Snapshot, bag_dir: Path) -> list[SetAside]:
    """The files that `absent_splits` finds missing, as closed files that cannot be read."""
    return [
        SetAside(Path(each.folder) / name, _NOT_THERE)
        for each in absent_splits(snapshot, bag_dir)
        for name in each.files
    ]


def _may_be_deleted(own: OwnRecordings, bag_dir: Path, folder: Path) -> bool:
    """Whether the recorder here deletes the oldest splits of a recording."""
    try:
        if own.exists():
            return own.owns(folder)
        # Versions before the list may have deleted any.
        return (bag_dir / HEARTBEAT_FILE).exists()
    except OSError:
        return True


def absence_told(absent: Sequence[Absent]) -> Iterator[str]:
    """The sentences on what is not there: counted, and the first few recordings named."""
    lacking = [each for each in absent if not each.unreadable]
    if lacking:
        files = sum(len(each.files) for each in lacking)
        messages = sum(each.messages for each in lacking)
        parts = [
            *([counted(files, "file that is not there", "files that are not there")] * (files > 0)),
            *(
                [
                    counted(
                        messages,
                        "message that no file here holds",
                        "messages that no file here holds",
                    )
                ]
                * (messages > 0)
            ),
        ]
        yield f"metadata.yaml of {_named(lacking)} lists {' and '.join(parts)}"
    unreadable = [each for each in absent if each.unreadable]
    if unreadable:
        yield f"metadata.yaml of {_named(unreadable)} cannot be read: what it lists is not compared"


def _named(absent: Sequence[Absent]) -> str:
    names = [PurePosixPath(each.folder).name for each in absent]
    return listed(names[:MAX_NAMED], len(names))


def _absent(folder: str, beside: _Beside, bags: int, held: int, *, is_ours: bool) -> Absent:
    """Compares a listing with the files beside it, which hold `held` messages in `bags` bags."""
    listing = beside.listing
    if listing is None:
        return Absent(folder, unreadable=True)
    absent = [name for name in listing.names if name not in beside.present]
    there = [name for name in listing.names if name in beside.present]
    deleted: Iterable[str] = ()
    if is_ours:
        deleted = takewhile(lambda name: name not in beside.present, listing.names)
    missing = sorted({*absent} - {*deleted}, key=absent.index)
    lost = sum(listing.messages.get(name, 0) for name in missing)
    # A bag that is damaged or cut by a handover holds fewer that count, and is not compared.
    if not beside.is_joined and bags == sum(listing.messages.get(name, 1) > 0 for name in there):
        if listing.messages:
            lost += max(sum(listing.messages.get(name, 0) for name in there) - held, 0)
        elif listing.total is not None and len(missing) == len(absent):
            lost += max(listing.total - held, 0)
    return Absent(folder, tuple(missing), lost)


def _beside(root: Path, folder: Path, now: int) -> _Beside | None:
    """What lies in a folder with a metadata.yaml; None where that is being written.

    Raises:
        OSError: it cannot be looked at.
        ValueError: it is no regular file.
    """
    status = os.lstat(folder / METADATA_FILE)
    changed = folder.stat().st_mtime_ns
    if not settled(status.st_mtime_ns, now):
        return None
    look = _looked_at if settled(changed, now) else _looked_at.__wrapped__
    return look(root, folder, (status.st_mtime_ns, status.st_size, changed))


@lru_cache(maxsize=_AT_HAND)
def _looked_at(root: Path, folder: Path, _stamp: tuple[int, int, int]) -> _Beside:
    with opened(root, folder) as directory:
        names = os.listdir(directory)  # noqa: PTH208 - of a descriptor
        descriptor = os.open(METADATA_FILE, _AS_IT_IS, dir_fd=directory)
        with os.fdopen(descriptor, "rb") as stream:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise ValueError(f"{METADATA_FILE} is not a regular file")
            text = stream.read(_READ_AT_MOST).decode("utf-8", errors="replace")
    present = frozenset(name.removesuffix(COMPRESSED) for name in names if bag_kind(name))
    return _Beside(_listing(text), present, HANDOVER_FILE in names)


def _listing(text: str) -> _Listing | None:
    """What a metadata.yaml lists, or None where it lists no file.

    Only the lines that matter are looked at: parsing the YAML of a long recording takes seconds.
    """
    names = dict.fromkeys(_bare(each[1]) for each in _NAME.finditer(text) if bag_kind(each[1]))
    if not names:
        return None
    total = _TOTAL.search(text)
    return _Listing(tuple(names), _messages(text), None if total is None else int(total[1]))


def _messages(text: str) -> dict[str, int]:
    """How many messages each file holds, as its entry under `files` says."""
    begin = _FILES.search(text)
    if begin is None:
        return {}
    indent = len(begin[1])
    entry: dict[str, str] = {}
    messages: dict[str, int] = {}
    for line in text[begin.end() :].lstrip("\n").splitlines():
        depth = len(line) - len(line.lstrip())
        is_entry = line.lstrip().startswith("- ")
        if depth < indent or (depth == indent and not is_entry):
            break
        if is_entry:
            entry = {}
        if field := _FIELD.match(line):
            entry[field[1]] = field[2]
        if len(entry) == 2 and entry["message_count"].isdecimal():
            messages[_bare(entry["path"])] = int(entry["message_count"])
    return messages


def _bare(path: str) -> str:
    return PurePosixPath(path).name.removesuffix(COMPRESSED)
