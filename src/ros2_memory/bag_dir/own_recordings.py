"""Which recordings and bags in a bag directory are its recorder's: `.episodic/recordings.jsonl`.

Only those are ever deleted. The file has one JSON object a line:

    {"recording": "rec_A"}                                          before its child is started
    {"recording": "rec_A", "inode": 7, "generation": 9, "splits": 3}    what the child has made
    {"recording": "rec_A", "inode": 7, ..., "splits": 60, "ended": true}
    {"recording": "old/run1", "inode": 8, "adopted": true, "bags": ["x.db3"]}   `ros2-memory adopt`
    {"recording": "moments/m/rec_A", ..., "adopted": true, "splits": 0, "bags": ["rec_A_7.mcap"]}

The last line of a recording counts. A directory is the recorder's own while it lies under its name
and is the very directory that was listed (see `directories.Identity`). A bag in it is the
recorder's own by its name, see `ListRow.holds`.

Lines are appended and flushed, so a power cut leaves at most a part of the last line, which readers
ignore and the next writer ends. Writers take turns by `flock`. Once most lines are of recordings
that have gone, the list is written again without them.
"""

from __future__ import annotations

import fcntl
import os
import stat
import threading
import time
from bisect import bisect_left
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from pydantic import AfterValidator, StrictBool

from ros2_memory.bag_dir.durable_write import (
    append_lines,
    flush,
    is_open_file,
    write_durably,
)
from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.json_files import Count, Int64, JsonLog, give_to_owner, state_path
from ros2_memory.bag_dir.layout import (
    LIST_FILE,
    LOST_AND_FOUND,
    bag_kind,
    bags_in,
    has_own_name,
    is_kept_apart,
    split_name,
    split_number,
)
from ros2_memory.core.directories import (
    Identity,
    identity_of,
    is_folder,
    known_identity,
    mode_of,
)
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import COMPRESSED

if TYPE_CHECKING:
    from collections.abc import (
        Callable,
        Collection,
        Container,
        Iterable,
        Iterator,
        Mapping,
        Sequence,
    )

_SPARE_LINES: Final = 1000
_MAX_NAMED: Final = 5
_LOCK_WAIT_S: Final = 2.0
_POLL_S: Final = 0.01
_APPEND: Final = os.O_RDWR | os.O_APPEND | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK

_log = get_logger(__name__)


def _checked_name(name: str) -> str:
    if "\0" in name or {"", ".", ".."}.intersection(name.split("/")):
        raise ValueError("it must be the path of a directory below the bag directory")
    return name


@dataclass(frozen=True, slots=True)
class ListRow:
    """One line of the list: a recording.

    `splits`: its child made the files with lower numbers; None in lines of versions before 0.1,
    and of adopted recordings. `ended`: it makes no more. `bags`: the other bags of an adopted
    directory, sorted; None: all that lie there. Directories of saved moments and of carried
    messages are listed like adopted ones.
    """

    recording: Annotated[str, AfterValidator(_checked_name)] = ""
    inode: Int64 | None = None
    generation: Int64 | None = None
    adopted: StrictBool = False
    bags: tuple[str, ...] | None = None
    splits: Count | None = None
    ended: StrictBool = False

    def holds(self, file: str) -> bool:
        """Returns whether a file of the recording's directory is one of its bags, by its name."""
        if self.adopted and self.bags is None:
            return True
        name, bags = file.removesuffix(COMPRESSED), self.bags or ()
        at = bisect_left(bags, name)
        is_listed = at < len(bags) and bags[at] == name
        number = split_number(self.recording, name)
        is_split = number is not None and (self.splits is None or number < self.splits)
        return is_split or is_listed

    def with_bags(self, files: Iterable[str]) -> ListRow:
        """Returns the line of the directory with these bags adopted."""
        others = {file.removesuffix(COMPRESSED) for file in files if not self.holds(file)}
        return replace(self, adopted=True, bags=(*sorted({*others, *(self.bags or ())}),))

    def counted(self, files: Container[str]) -> int:
        """Returns how many splits the recording has, where these files were seen."""
        splits = self.splits or 0
        while split_name(self.recording, splits) in files:
            splits += 1
        return splits

    @property
    def identity(self) -> Identity | None:
        """The directory of the recording; None until its child has made it."""
        return None if self.inode is None else Identity(self.inode, self.generation)

    def lists(self, identity: Identity | None) -> bool:
        """Returns whether a directory is that of the recording."""
        listed = self.identity
        return identity is not None and listed is not None and identity.matches(listed)


LIST: Final = JsonLog(LIST_FILE, ListRow, is_brief=True)


def _by_recording(rows: Iterable[ListRow]) -> dict[str, ListRow]:
    return {row.recording: row for row in rows}


class OwnRecordings:
    """The list of one bag directory. Safe for several threads at once.

    Queries write nothing. The recorder's own object is notified of every recording, and writes the
    list again where it was deleted meanwhile.
    """

    def __init__(self, bag_dir: Path) -> None:
        self._bag_dir = bag_dir
        self._path = bag_dir / LIST_FILE
        self._lock = threading.RLock()
        self._rows: dict[str, ListRow] = {}
        self._lines = 0
        self._stamp: tuple[int, ...] | None = None
        self._unwritten: dict[str, ListRow] = {}
        self._max_lines = _SPARE_LINES
        self._reported_damaged = 0
        self._begun = ""

    def exists(self) -> bool:
        """Returns whether there is a list.

        Raises:
            OSError: there is one that cannot be read.
        """
        with self._lock:
            return self._read_if_changed()

    def names(self) -> Collection[str]:
        """Returns the listed recordings, whatever lies under their names; no saved moments.

        Those that were known remain known if the list is deleted.

        Raises:
            OSError: the list cannot be read.
        """
        return [name for name in self._current_rows() if not is_kept_apart(name)]

    def in_order(self) -> Sequence[str]:
        """Returns the listed recordings in the order in which they began; no adopted ones.

        Raises:
            OSError: the list cannot be read.
        """
        return [name for name, row in self._current_rows().items() if not row.adopted]

    def owns_bag(self, path: Path) -> bool:
        """Returns whether a bag file is the recorder's: see `judge`.

        Raises:
            OSError: the list cannot be read.
        """
        self._current_rows()
        return self.judge_of(str(path.parent))(path.name)

    def judge_of(self, directory: str) -> Callable[[str], bool]:
        """Returns `judge` of the directory that has this path now."""
        return self.judge(self.name_of(directory), known_identity(directory))

    def judge(self, folder: str, identity: Identity | None) -> Callable[[str], bool]:
        """Returns what decides, by its name, whether a bag file in a directory is the recorder's.

        Those are the bags that the list, as last read, has by name or number. A folder of moments
        or carried messages that was restored is in no list.

        Args:
            folder: the directory's name in the list.
            identity: shows whether it is the one that was listed.
        """
        row = self._rows.get(folder)
        return row.holds if row and row.lists(identity) else lambda _: False

    def owns(self, directory: Path) -> bool:
        """Returns whether a directory is a recording of this bag directory's recorder.

        Bags of others may lie in it all the same. One that must not be opened is left out.

        Raises:
            OSError: the list cannot be read.
        """
        name = self.name_of(directory)
        if name in self._current_rows():
            with suppress(OSError):
                return self.lists(name, identity_of(directory))
        return False

    def began(self, directory: Path) -> bool:
        """Returns whether a recording was to begin there, and no directory was listed for it.

        Raises:
            OSError: the list cannot be read.
        """
        row = self._current_rows().get(self.name_of(directory))
        return row is not None and row.identity is None

    def lists(self, name: str, identity: Identity | None) -> bool:
        """Returns whether the list, as last read, has a directory of this name and identity."""
        row = self._rows.get(name)
        return row is not None and row.lists(identity)

    def name_of(self, directory: Path | str) -> str:
        """Returns a path relative to the bag directory; empty where it lies elsewhere."""
        root, path = f"{self._bag_dir}/", str(directory)
        return path.removeprefix(root) if path.startswith(root) else ""

    @property
    def stamp(self) -> object:
        """A value that changes when the list is read again."""
        return self._stamp

    # What follows is for the recorder, which holds the lock of the bag directory, and for
    # `ros2-memory adopt`.

    def claim(self) -> None:
        """Brings the list up to date before anything is recorded.

        Without a list it makes one, and names what looks like recordings: nothing shows whether
        they were restored or copied. Else it drops entries of recordings that have gone, completes
        those that a kill left without a directory, and counts the splits of those that a kill
        ended (see `_left_by_kill`). What cannot be written is known all the same, so that space can
        be freed on a full disk; the next recording writes it.

        Raises:
            RecorderError: the list cannot be read, or the bag directory cannot be listed.
        """
        with self._lock:
            try:
                exists = self._read_if_changed()
                paths = () if exists else self._bag_dir.iterdir()
                left = sorted(
                    path.name for path in paths if has_own_name(path.name) and is_folder(path)
                )
            except OSError as error:
                raise self._failure(error, "read") from error
            rows = self._left_by_kill()
            self._add(rows)
            if left:
                names, count = left[:_MAX_NAMED], len(left)
                _log.warning(
                    "recordings_not_adopted", recordings=count, names=names, advice=_ADVICE
                )
            for name, row in self._rows.items():
                if row.identity is None and (self._bag_dir / name).is_dir():
                    _log.warning("recording_not_claimed", recording=name, reason=_NOT_CLAIMED)
            if exists and not (rows or self._missing_on_disk(self._rows)):
                return
            try:
                self._rewrite(rows)
            except OSError as error:
                self._remember_unwritten(rows)
                _log.error("recordings_not_listed", reason=str(self._failure(error)))

    def begin(self, name: str) -> None:
        """Lists a recording that is about to begin, and flushes the list.

        Raises:
            RecorderError: it cannot be listed: then it must not begin.
        """
        self._begun = name
        self._append([ListRow(recording=name)])

    def complete(self, name: str) -> bool:
        """Lists the directory that the child made for a recording; False while there is none.

        Raises:
            RecorderError: it cannot be written.
        """
        try:
            identity = identity_of(self._bag_dir / name)
        except OSError as error:
            raise RecorderError(f"{self._bag_dir / name}: {error.strerror or error}") from error
        if identity is None:
            return False
        self._append([ListRow(name, *identity, splits=0)])
        return True

    def note(self, name: str, files: Container[str], *, ended: bool = False) -> None:
        """Notes which splits the child of a recording has made, of the files that were seen.

        Raises:
            RecorderError: it cannot be written. It is known all the same, so that space can be
                freed on a full disk, and is written with the next split.
        """
        with self._lock:
            row = self._rows.get(name)
            if row is None or row.identity is None or row.splits is None:
                return
            noted = replace(row, splits=row.counted(files), ended=ended)
            try:
                if noted == row and self._read_if_changed():
                    return
                self._append([noted])
            except OSError as error:
                raise self._failure(error) from error
            except RecorderError:
                self._remember_unwritten([noted])
                raise

    def adopt(self, identities: Mapping[str, Identity]) -> None:
        """Lists directories with the bags in them, as the recorder's own from now on.

        Raises:
            RecorderError: they cannot be listed.
        """
        with self._lock:
            rows: list[ListRow] = []
            for name, identity in sorted(identities.items()):
                row = self._row_of(name, identity)
                with suppress(OSError):
                    row = row.with_bags(path.name for path in bags_in(self._bag_dir / name))
                rows.append(row)
            self._append(rows)

    def _row_of(self, name: str, identity: Identity) -> ListRow:
        """Returns the line of a directory, one of the list or another."""
        row = self._rows.get(name)
        if row is not None and row.lists(identity):
            return row
        row = ListRow(name, *identity)
        return replace(row, splits=0, ended=True) if is_kept_apart(name) else row

    def hold(self, directory: Path, bags: Iterable[str]) -> None:
        """Lists bags that the recorder puts into a directory of a moment or of carried messages.

        What cannot be written is known all the same, and is written with the next recording.

        Raises:
            OSError: the list or the directory cannot be read.
        """
        with self._lock:
            self._read_if_changed()
            name, identity = self.name_of(directory), identity_of(directory)
            if identity is None:
                raise FileNotFoundError(f"{directory} is not there any more")
            row = self._row_of(name, identity).with_bags(bags)
            if row == self._rows.get(name):
                return
            try:
                self._append([row])
            except RecorderError as error:
                self._remember_unwritten([row])
                _log.error("recordings_not_listed", reason=str(error))

    def _remember_unwritten(self, rows: Sequence[ListRow]) -> None:
        """Counts rows as listed that cannot be written; the next one that is written takes them."""
        self._unwritten |= _by_recording(rows)
        self._add(rows)

    def _add(self, rows: Iterable[ListRow]) -> None:
        # A new dictionary: another thread may iterate over this one.
        self._rows = self._rows | _by_recording(rows)

    def _left_by_kill(self) -> list[ListRow]:
        """Returns what a kill kept from being listed.

        Entries without a directory whose directory our child made after all: those that the last
        heartbeat names, which named them before the child was started. And the splits of recordings
        that did not end.
        """
        named = read_heartbeat(self._bag_dir).recordings
        left: list[ListRow] = []
        for name, row in self._rows.items():
            with suppress(OSError):
                directory = self._bag_dir / name
                if row.identity is None and name in named and (found := identity_of(directory)):
                    row = ListRow(name, *found, splits=0)  # noqa: PLW2901 - as it is now
                    left.append(row)
                if row.identity is not None and row.splits is not None and not row.ended:
                    files = {path.name for path in bags_in(directory)}
                    left.append(replace(row, splits=row.counted(files), ended=True))
        return left

    def _missing_on_disk(self, names: Iterable[str]) -> list[str]:
        """Returns the recordings that are no longer in the bag directory."""
        gone = []
        for name in names:
            with suppress(OSError):  # a disk that fails hides what is there
                if not mode_of(self._bag_dir / name):
                    gone.append(name)
        return gone

    def _current_rows(self) -> Mapping[str, ListRow]:
        """Returns the lines of recordings, read again if the file has changed.

        Raises:
            OSError: the list cannot be read.
        """
        with self._lock:
            self._read_if_changed()
            return self._rows

    def _read_if_changed(self) -> bool:
        """Reads the file if it has changed; returns whether there is one."""
        try:
            status = os.lstat(state_path(self._bag_dir, LIST_FILE))
            stamp = (status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
            if stamp == self._stamp:
                return True
            lines = [*LIST.lines(self._bag_dir)]
        except FileNotFoundError:
            self._stamp = None
            return False
        except ValueError as error:
            raise OSError(f"{self._path}: {error}") from error
        rows = [line.row for line in lines if line.row is not None]
        listed = _by_recording(row for row in rows if row.recording)
        self._rows, self._lines, self._stamp = listed | self._unwritten, len(lines), stamp
        damaged = len(lines) - len(rows)
        if damaged > self._reported_damaged:
            self._reported_damaged = damaged
            _log.warning("recordings_list_damaged", path=str(self._path), lines=damaged)
        return True

    def _append(self, rows: Sequence[ListRow]) -> None:
        """Appends entries, or writes the whole list where there is none or most of it is gone."""
        rows = [*self._unwritten.values(), *rows]
        try:
            with self._lock:
                exists = self._read_if_changed()
                if not exists or self._lines > self._max_lines:
                    self._rewrite(rows)
                else:
                    with self._locked() as descriptor:
                        if descriptor is None:
                            raise FileNotFoundError("the list of recordings is missing")
                        append_lines(descriptor, LIST.text(rows))
                    self._add(rows)
                self._unwritten.clear()
        except OSError as error:
            raise self._failure(error) from error

    def _rewrite(self, rows: Iterable[ListRow]) -> None:
        """Writes the list again with these entries, and without recordings that have gone."""
        before = self._rows
        try:
            with self._locked() as descriptor:
                if descriptor is not None:
                    # Another program may have appended meanwhile.
                    self._stamp = None
                    self._read_if_changed()
                # What was known and what is listed now, but for what has no directory yet.
                merged = before | {
                    name: row
                    for name, row in self._rows.items()
                    if row.identity or name not in before
                }
                for name in self._missing_on_disk(merged):
                    if name != self._begun:  # its child has not made it yet
                        del merged[name]
                merged |= _by_recording(rows)
                folder = self._path.parent
                if not folder.is_dir():
                    folder.mkdir(exist_ok=True)
                    give_to_owner(folder, self._bag_dir)
                    flush(folder.parent)
                write_durably(self._path, LIST.text(merged.values()))
                give_to_owner(self._path, self._bag_dir)
        except OSError:
            # What others appended is read again.
            self._rows, self._stamp = before, None
            raise
        self._max_lines = 2 * len(merged) + _SPARE_LINES
        self._rows, self._stamp = merged, None

    @contextmanager
    def _locked(self) -> Iterator[int | None]:
        """Yields a descriptor of the list, locked; None if there is none.

        Raises:
            OSError: it cannot be opened, or another program holds the lock.
        """
        give_up = time.monotonic() + _LOCK_WAIT_S
        while True:
            try:
                descriptor = os.open(self._path, _APPEND)
            except FileNotFoundError:
                yield None
                return
            try:
                with suppress(BlockingIOError):
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    # Another program may have replaced the file before it was locked.
                    if is_open_file(self._path, descriptor):
                        yield descriptor
                        return
            finally:
                os.close(descriptor)
            if time.monotonic() >= give_up:
                raise BlockingIOError(f"another program has locked {self._path}")
            time.sleep(_POLL_S)

    def _failure(self, error: OSError, verb: str = "written") -> RecorderError:
        return RecorderError(
            f"{self._path} cannot be {verb}: {error.strerror or error}; the recorder notes there "
            "which recordings are its own, and must be able to write into recording.bag_dir"
        )


_NOT_CLAIMED: Final = (
    "its recorder was killed before it listed the directory that it made, and the heartbeat does "
    "not name it; it is kept until `ros2-memory adopt` takes it"
)
_ADVICE: Final = (
    "nothing lists them as made here: after an upgrade from a version without recordings.jsonl, a "
    "restore or a copy, `ros2-memory adopt DIR` lets the recorder delete them; until then they are "
    "kept, and no limit counts them"
)


def folders_with_bags(folder: Path) -> Iterator[Path]:
    """Yields a directory and those below it that hold bag files; follows no link below it.

    Hidden directories are left out, and `lost+found`.

    Raises:
        OSError: one of them cannot be listed.
    """

    def fail(error: OSError) -> None:
        raise error

    for root, names, files in os.walk(folder, onerror=fail):
        names[:] = sorted(
            name for name in names if not name.startswith(".") and name != LOST_AND_FOUND
        )
        if any(bag_kind(name) and is_regular(Path(root, name)) for name in files):
            yield Path(root)


def is_regular(path: Path) -> bool:
    """Returns whether a path is a regular file, and no link to one.

    Raises:
        OSError: it cannot be looked up.
    """
    return stat.S_ISREG(mode_of(path))
