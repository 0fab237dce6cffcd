"""Which recordings in a bag directory its recorder made: `.episodic/recordings.jsonl`.

Only those are deleted. One JSON object a line:

    {"bag_dir_id": "5f0c..."}                                       random, of this bag directory
    {"recording": "rec_A"}                                          before its child is started
    {"recording": "rec_A", "inode": 7, "generation": 9}             the child made the directory
    {"recording": "old/run1", "inode": 8, "adopted": true}          `ros2-memory adopt`, or an
                                                                    upgrade from before the list

The last line on a name counts. A directory is the recorder's own while it lies under its name and
is the very directory that was listed. An inode number alone does not prove that: ext4 gives a
directory that was deleted and restored the number that it had. So the inode's generation is listed
too, which ext4, XFS, Btrfs and F2FS choose anew for each (FS_IOC_GETVERSION); elsewhere the number
has to do. No clock is asked.

Lines are appended and flushed, so that a power cut leaves at most a part of the last one, which no
reader takes for a line and the next writer ends. Writers take turns by `flock`. Once most lines are
of recordings that have gone the list is written anew without them.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import stat
import struct
import threading
import time
import uuid
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import structlog

from ros2_memory.bag_dir.durable_write import flush, open_plain, write_durably
from ros2_memory.bag_dir.handover_file import read_handover
from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.layout import CARRY_FOLDER, LIST_FILE, MOMENTS_FOLDER, bag_kind
from ros2_memory.core.errors import RecorderError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
    from typing import TypeAlias

    CustomDataOf: TypeAlias = Callable[[Path], Mapping[str, str] | None]
    """What `ros2 bag record` embedded in a bag file; None where that cannot be known.

    May raise OSError.
    """

RECORDED_BY: Final = "recorded_by"
BAG_DIR_ID: Final = "bag_dir_id"
PROGRAM: Final = "ros2-memory"

_NAMED_BY_TIME: Final = re.compile(r"rec_\d{8}T\d{6}Z(_\d+)?")
_GETVERSION: Final = 0x80087601  # _IOR('v', 1, long), linux/fs.h
_GENERATION: Final = struct.Struct("=I4x")  # it fills the first 4 bytes of that long
_LARGEST: Final = 64 << 20
_SPARE_LINES: Final = 1000
_NAMED: Final = 5
_PATIENCE_S: Final = 2.0
_POLL_S: Final = 0.01
_APPEND: Final = os.O_RDWR | os.O_APPEND | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK

_log: structlog.typing.FilteringBoundLogger = structlog.get_logger(__name__)


def has_own_name(name: str) -> bool:
    """Whether a directory is named as this program names a recording."""
    return _NAMED_BY_TIME.fullmatch(name) is not None


class Identity(NamedTuple):
    """Which directory a name means on its disk; `generation` is None where none is known."""

    inode: int
    generation: int | None = None

    def is_that_of(self, listed: Identity | None) -> bool:
        """Whether this is the directory that was listed."""
        if listed is None or self.inode != listed.inode:
            return False
        return listed.generation is None or self.generation == listed.generation


def identity_of(directory: Path | str) -> Identity | None:
    """The identity of a directory; None where there is none of that name, or a link.

    Raises:
        OSError: it cannot be looked at.
    """
    flags = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW
    try:
        if stat.S_ISLNK(os.lstat(directory).st_mode):
            return None
        descriptor = os.open(directory, flags)
    except (FileNotFoundError, NotADirectoryError):
        return None
    try:
        return identity_at(descriptor)
    finally:
        os.close(descriptor)


def identity_at(descriptor: int) -> Identity:
    """The identity of an open directory."""
    return Identity(os.fstat(descriptor).st_ino, _generation(descriptor))


def _generation(descriptor: int) -> int | None:
    try:
        (generation,) = _GENERATION.unpack(fcntl.ioctl(descriptor, _GETVERSION, bytes(8)))
    except OSError:  # a file system that has none, as tmpfs
        return None
    return int(generation)


class _Entry(NamedTuple):
    """One line on a recording."""

    name: str
    identity: Identity | None = None
    adopted: bool = False


@dataclass(slots=True)
class _Content:
    """What the lines of a list say. `damaged` counts lines that say nothing."""

    bag_dir_id: str | None = None
    entries: dict[str, _Entry] = field(default_factory=dict)
    lines: int = 0
    damaged: int = 0

    @classmethod
    def of(cls, data: bytes) -> _Content:
        """The content of a file, whatever stands in it."""
        content = cls()
        for line in filter(None, data.split(b"\n")):
            content.lines += 1
            try:
                fields: object = json.loads(line)
                content._take_line(fields if isinstance(fields, dict) else {})
            # json raises RecursionError for a line of nothing but brackets.
            except (ValueError, RecursionError):
                content.damaged += 1
        return content

    def take(self, entry: _Entry) -> None:
        """Takes in one entry, in place of an earlier one of that name."""
        self.entries[entry.name] = entry

    def text(self) -> str:
        """All of it as lines, each name once."""
        return (
            json.dumps({BAG_DIR_ID: self.bag_dir_id})
            + "\n"
            + "".join(map(_line, self.entries.values()))
        )

    def _take_line(self, fields: Mapping[object, object]) -> None:
        number, name = fields.get(BAG_DIR_ID), fields.get("recording")
        if isinstance(number, str) and re.fullmatch(r"[0-9a-f]{8,64}", number):
            self.bag_dir_id = number
            return
        if not isinstance(name, str) or not _may_be_listed(name):
            raise ValueError("it names no recording")
        inode, generation = _number(fields, "inode"), _number(fields, "generation")
        identity = None if inode is None else Identity(inode, generation)
        self.take(_Entry(name, identity, adopted=fields.get("adopted") is True))


def _number(fields: Mapping[object, object], key: str) -> int | None:
    value = fields.get(key)
    if value is not None and (isinstance(value, bool) or not isinstance(value, int)):
        raise ValueError(f"{key} is no whole number")
    return value


def _may_be_listed(name: str) -> bool:
    """Whether a name is that of a directory below the bag directory, where recordings may lie."""
    parts = name.split("/")
    return "\0" not in name and not {"", ".", ".."}.intersection(parts)


def _line(entry: _Entry) -> str:
    fields: dict[str, str | int | bool] = {"recording": entry.name}
    if entry.identity is not None:
        fields["inode"] = entry.identity.inode
        if entry.identity.generation is not None:
            fields["generation"] = entry.identity.generation
    if entry.adopted:
        fields["adopted"] = True
    return json.dumps(fields) + "\n"


class OwnRecordings:
    """The list of one bag directory. Safe for several threads at once.

    Whoever only asks writes nothing. The recorder's own is told of every recording, and writes the
    list anew where it was deleted meanwhile.
    """

    def __init__(self, bag_dir: Path) -> None:
        self._bag_dir = bag_dir
        self._path = bag_dir / LIST_FILE
        self._lock = threading.RLock()
        self._content = _Content()
        self._stamp: tuple[int, ...] | None = None
        self._most_lines = _SPARE_LINES
        self._told_damaged = 0

    def exists(self) -> bool:
        """Whether there is a list.

        Raises:
            OSError: it is there and cannot be read.
        """
        with self._lock:
            return self._read()

    def names(self) -> Collection[str]:
        """The recordings that are listed, whether their directories are those that were listed.

        What was known stays known where the list has been deleted.

        Raises:
            OSError: the list is there and cannot be read.
        """
        with self._lock:
            self._read()
            return self._content.entries.keys()

    def owns(self, directory: Path) -> bool:
        """Whether a directory is a recording of this bag directory's recorder.

        One that may not be looked into is none.

        Raises:
            OSError: the list is there and cannot be read.
        """
        with self._lock:
            self._read()
            name = self.name_of(directory)
            if name not in self._content.entries:
                return False
            try:
                identity = identity_of(directory)
            except OSError:
                return False
            return self.lists(name, identity)

    def lists(self, name: str, identity: Identity | None) -> bool:
        """Whether the list, as it was last read, has a directory of this identity by this name."""
        entry = self._content.entries.get(name)
        return entry is not None and identity is not None and identity.is_that_of(entry.identity)

    def name_of(self, directory: Path | str) -> str:
        """The name of a directory in the list; empty where it lies elsewhere."""
        root, path = f"{self._bag_dir}/", str(directory)
        return path.removeprefix(root) if path.startswith(root) else ""

    @property
    def stamp(self) -> object:
        """Another one when the list has been read anew."""
        return self._stamp

    @property
    def bag_dir_id(self) -> str | None:
        """The random id of this bag directory, which recordings carry; None before there is one."""
        return self._content.bag_dir_id

    def former(self, custom_data: CustomDataOf) -> tuple[dict[str, Identity], dict[str, str]]:
        """The recordings that a version from before the list made here, which are adopted once.

        Those lie in the bag directory itself, under a name that this program gives, and either
        `recorder.json` or a `handover.json` names them, or every file of them that holds a byte
        carries what our child embedded. One that carries an id is of a version with the list: it
        was restored or copied, or the list has gone. So one is not adopted either of which a file
        cannot be read so far: it may carry an id.

        Returns:
            The directories of those, by name, and why others of such a name are not among them.

        Raises:
            OSError: the bag directory cannot be listed.
        """
        folders = [
            each
            for each in sorted(self._bag_dir.iterdir())
            if has_own_name(each.name) and not each.is_symlink() and each.is_dir()
        ]
        heartbeat = read_heartbeat(self._bag_dir).heartbeat
        named = set(heartbeat.recordings if heartbeat else ())
        for folder in folders:
            handover = read_handover(folder).handover
            named.update(name for name in (handover.previous, handover.next) if name)
        found: dict[str, Identity] = {}
        left: dict[str, str] = {}
        for folder in folders:
            try:
                identity = identity_of(folder)
                reason = _why_not_former(folder, custom_data, is_named=folder.name in named)
            except OSError as error:
                left[folder.name] = f"it cannot be looked into: {error.strerror or error}"
                continue
            if reason is not None:
                left[folder.name] = reason
            elif identity is not None:
                found[folder.name] = identity
        return found, left

    def suppose(self, custom_data: CustomDataOf) -> None:
        """Knows, where there is no list yet, the recordings that `claim` would adopt.

        Raises:
            OSError: the list cannot be read, or the bag directory cannot be listed.
        """
        with self._lock:
            if not self._read():
                found, _ = self.former(custom_data)
                for name, identity in found.items():
                    self._content.take(_Entry(name, identity, adopted=True))

    # What follows is for the recorder, which holds the lock of the bag directory, and for
    # `ros2-memory adopt`.

    def claim(self, custom_data: CustomDataOf) -> None:
        """Puts the list in order before anything is recorded.

        Where there is none it is made, with the recordings of versions before it. Else entries of
        recordings that have gone are dropped, and those that a kill left without a directory are
        completed where every file that holds a byte carries what our child embedded, with the id of
        this bag directory. What cannot be written is known all the same, so that room can be made
        on a full disk; the next recording writes it.

        Raises:
            RecorderError: the list cannot be read, or the bag directory cannot be listed.
        """
        with self._lock:
            try:
                there = self._read()
                adopted, left = ({}, {}) if there else self.former(custom_data)
            except OSError as error:
                raise _unwritable(self._path, error, "read") from error
            content = self._content
            completed = self._completed(custom_data)
            for name, identity in adopted.items():
                content.take(_Entry(name, identity, adopted=True))
            for name, identity in completed.items():
                content.take(_Entry(name, identity))
            if adopted:
                names = sorted(adopted)[:_NAMED]
                _log.info("recordings_adopted", recordings=len(adopted), names=names)
            if left:
                reasons = [f"{name}: {left[name]}" for name in sorted(left)[:_NAMED]]
                _log.warning(
                    "recordings_not_adopted", recordings=len(left), reasons=reasons, advice=_ADVICE
                )
            for name, entry in content.entries.items():
                if entry.identity is None and (self._bag_dir / name).is_dir():
                    _log.warning("recording_not_claimed", recording=name, reason=_UNCLAIMED)
            if there and not completed and not self._gone(content.entries) and content.bag_dir_id:
                return
            try:
                self._rewrite()
            except OSError as error:
                _log.error("recordings_not_listed", reason=str(_unwritable(self._path, error)))

    def begin(self, name: str) -> None:
        """Lists a recording that is about to be begun; that is on the disk when this returns.

        Raises:
            RecorderError: it cannot be listed: then it must not be begun.
        """
        self._list([_Entry(name)])

    def complete(self, name: str) -> bool:
        """Adds to its entry which directory the child made; False while it has made none.

        Raises:
            RecorderError: it cannot be written.
        """
        try:
            identity = identity_of(self._bag_dir / name)
        except OSError as error:
            raise RecorderError(f"{self._bag_dir / name}: {error.strerror or error}") from error
        if identity is None:
            return False
        self._list([_Entry(name, identity)])
        return True

    def adopt(self, identities: Mapping[str, Identity]) -> None:
        """Lists directories that another program made, as the recorder's own from now on.

        Raises:
            RecorderError: they cannot be listed.
        """
        self._list([_Entry(name, each, adopted=True) for name, each in sorted(identities.items())])

    def _list(self, entries: Collection[_Entry]) -> None:
        try:
            with self._lock:
                self._append(entries)
        except OSError as error:
            raise _unwritable(self._path, error) from error

    def _completed(self, custom_data: CustomDataOf) -> dict[str, Identity]:
        """Of the entries without a directory those of which one is there that our child made."""
        found: dict[str, Identity] = {}
        for name, entry in self._content.entries.items():
            if entry.identity is None:
                with suppress(OSError):
                    identity = identity_of(self._bag_dir / name)
                    if identity is None:
                        continue
                    files = _held(self._bag_dir / name)
                    embedded = [custom_data(path) or {} for path in files]
                    if _all_ours(embedded, self._content.bag_dir_id):
                        found[name] = identity
        return found

    def _gone(self, names: Iterable[str]) -> list[str]:
        """The recordings of which nothing lies in the bag directory any more."""
        gone = []
        for name in names:
            try:
                os.lstat(self._bag_dir / name)
            except (FileNotFoundError, NotADirectoryError):
                gone.append(name)
            except OSError:
                continue  # a disk that fails hides what is there
        return gone

    def _read(self) -> bool:
        """Takes in what the file says, where it changed; whether there is one."""
        if self._path.parent.is_symlink():
            raise OSError(f"{self._path.parent} is a symbolic link, which is not followed")
        try:
            status = os.lstat(self._path)
            stamp = (status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
            if stamp == self._stamp:
                return True
            with open_plain(self._path) as stream:
                data = stream.read(_LARGEST)
        except (FileNotFoundError, NotADirectoryError):
            self._stamp = None
            return False
        except ValueError as error:
            raise OSError(f"{self._path}: {error}") from error
        self._content, self._stamp = _Content.of(data), stamp
        if self._content.damaged > self._told_damaged:
            self._told_damaged = self._content.damaged
            _log.warning("recordings_list_damaged", path=str(self._path), lines=self._told_damaged)
        return True

    def _append(self, entries: Collection[_Entry]) -> None:
        """Adds entries, to a list of everything that is known where there is none."""
        there = self._read()
        if not there or self._content.lines > self._most_lines or self.bag_dir_id is None:
            self._rewrite(entries)
            return
        with self._alone() as descriptor:
            _append_whole(descriptor, "".join(map(_line, entries)).encode())
        for entry in entries:
            self._content.take(entry)

    def _rewrite(self, entries: Collection[_Entry] = ()) -> None:
        """Writes the list anew with these entries, and without what has gone."""
        known = self._content
        try:
            with self._alone() as descriptor:
                if descriptor is not None:
                    # What another program appended meanwhile.
                    self._stamp = None
                    self._read()
                content = _Content(self._content.bag_dir_id or known.bag_dir_id or uuid.uuid4().hex)
                for entry in (*known.entries.values(), *self._content.entries.values()):
                    if entry.identity or entry.name not in content.entries:
                        content.take(entry)
                for name in self._gone(content.entries):
                    del content.entries[name]
                for entry in entries:
                    content.take(entry)
                folder = self._path.parent
                if not folder.is_dir():
                    folder.mkdir(exist_ok=True)
                    _belongs_to_owner_of(self._bag_dir, folder)
                    flush(folder.parent)
                write_durably(self._path, content.text())
                _belongs_to_owner_of(self._bag_dir, self._path)
        except OSError:
            self._content = known
            raise
        self._most_lines = 2 * len(content.entries) + _SPARE_LINES
        self._content, self._stamp = content, None

    @contextmanager
    def _alone(self) -> Iterator[int | None]:
        """The list, open and locked; None where there is none.

        Raises:
            OSError: it cannot be opened, or another program holds it.
        """
        give_up = time.monotonic() + _PATIENCE_S
        while True:
            try:
                descriptor = os.open(self._path, _APPEND)
            except FileNotFoundError:
                yield None
                return
            try:
                if _locked(descriptor) and _is_file(self._path, descriptor):
                    yield descriptor
                    return
            finally:
                os.close(descriptor)
            if time.monotonic() >= give_up:
                raise BlockingIOError(f"another program holds {self._path}")
            time.sleep(_POLL_S)


_UNCLAIMED: Final = (
    "its recorder was killed before it noted which directory it had made, and what lies there does "
    "not carry the id of this bag directory; it is kept until `ros2-memory adopt` takes it"
)
_ADVICE: Final = "they are kept until `ros2-memory adopt` takes them"


def folders_with_bags(folder: Path) -> Iterator[Path]:
    """A directory and those below it in which bag files lie. Links are no files, nor followed.

    Raises:
        OSError: one of them cannot be listed.
    """

    def fail(error: OSError) -> None:
        raise error

    for root, names, files in os.walk(folder, onerror=fail):
        names[:] = sorted(name for name in names if not name.startswith("."))
        if any(bag_kind(name) and is_regular(Path(root, name)) for name in files):
            yield Path(root)


def is_regular(path: Path) -> bool:
    """Whether it is a regular file, and no link to one.

    Raises:
        OSError: it cannot be looked at.
    """
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except FileNotFoundError:
        return False


def is_kept_apart(name: str) -> bool:
    """Whether a name in the bag directory is that of moments or carried messages, in no list."""
    return name.partition("/")[0] in {MOMENTS_FOLDER, CARRY_FOLDER}


def _held(folder: Path) -> Iterator[Path]:
    """The bag files in a directory that hold a byte.

    Raises:
        OSError: the directory cannot be listed, or a file not be looked at.
    """
    for path in sorted(folder.iterdir()):
        if bag_kind(path.name) and (path.is_symlink() or path.stat().st_size):
            yield path


def _why_not_former(folder: Path, custom_data: CustomDataOf, *, is_named: bool) -> str | None:
    """Why a directory is not taken for a recording of a version from before the list.

    Raises:
        OSError: it cannot be listed, or a file cannot be read.
    """
    without_proof = not is_named
    for path in _held(folder):
        embedded = custom_data(path)
        if embedded is None:
            return f"{path.name} cannot be read as far as to know which bag directory it is of"
        if BAG_DIR_ID in embedded:
            return f"{path.name} carries the id of a bag directory, of which the list is not here"
        if embedded and dict(embedded) != {RECORDED_BY: PROGRAM}:
            return f"{path.name} carries what another program embedded"
        if not (embedded or is_named):
            return (
                f"{path.name} does not carry {RECORDED_BY}={PROGRAM}, and no recorder.json or "
                "handover.json names the recording"
            )
        without_proof = False
    return "no file of it holds a byte" if without_proof else None


def _all_ours(embedded: Collection[Mapping[str, str]], bag_dir_id: str | None) -> bool:
    return bool(embedded) and all(
        each.get(RECORDED_BY) == PROGRAM and each.get(BAG_DIR_ID) == bag_dir_id for each in embedded
    )


def _append_whole(descriptor: int | None, data: bytes) -> None:
    """Appends all of it or nothing, on a line of its own, and has it on the disk.

    Raises:
        OSError: it cannot be written.
    """
    if descriptor is None:
        raise FileNotFoundError("the list of recordings has gone")
    size = os.fstat(descriptor).st_size
    if size and os.pread(descriptor, 1, size - 1) != b"\n":
        data = b"\n" + data
    try:
        while data:
            data = data[os.write(descriptor, data) :]
        os.fsync(descriptor)
    except OSError:
        with suppress(OSError):
            os.ftruncate(descriptor, size)
        raise


def _belongs_to_owner_of(bag_dir: Path, path: Path) -> None:
    """Where root ran a command, the recorder must be able to write what it made."""
    with suppress(OSError):
        owner = bag_dir.stat()
        if path.lstat().st_uid != owner.st_uid:
            os.chown(path, owner.st_uid, owner.st_gid, follow_symlinks=False)


def _locked(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _is_file(path: Path, descriptor: int) -> bool:
    """Whether the path still names the open file, which another program may have replaced."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _unwritable(path: Path, error: OSError, verb: str = "written") -> RecorderError:
    return RecorderError(
        f"{path} cannot be {verb}: {error.strerror or error}; the recorder notes there which "
        "recordings are its own, and must be able to write into recording.bag_dir"
    )
