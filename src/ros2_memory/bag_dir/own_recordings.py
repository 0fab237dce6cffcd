"""The list of the recorder's own recordings and bags: `.episodic/recordings.jsonl`.

Nothing else is ever deleted. The file has one JSON object a line:

    {"recording": "rec_A"}                                          before its child is started
    {"recording": "rec_A", "inode": 7, "generation": 9, "splits": 3}    what the child has made
    {"recording": "rec_A", "inode": 7, ..., "splits": 60, "ended": true}
    {"recording": "old/run1", "inode": 8, "adopted": true, "bags": ["x.db3"]}   `ros2-memory adopt`
    {"recording": "moments/m/rec_A", ..., "adopted": true, "splits": 0, "bags": ["rec_A_7.mcap"]}

The last line of a recording counts. A directory is the recorder's own if its name and its identity
are listed (see `directories.Identity`), and a bag in it by its name (see `ListRow.holds`).

Lines are appended and flushed, so a power cut leaves at most a part of the last line, which readers
ignore and the next writer ends. Writers take turns by `flock`. Once most lines are of recordings
that have gone, the list is written again without them.
"""

from __future__ import annotations

import os
import stat
import threading
from bisect import bisect_left
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from pydantic import AfterValidator, StrictBool

from ros2_memory.bag_dir.durable_write import append_lines, flush, locked
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

_log = get_logger(__name__)


def _checked_name(name: str) -> str:
    if "\0" in name or {"", ".", ".."}.intersection(name.split("/")):
        raise ValueError("it must be the path of a directory below the bag directory")
    return name


@dataclass(frozen=True, slots=True)
class ListRow:
    """One line of the list: a recording. Saved moments and carried messages are listed as adopted.

    Attributes:
        adopted: whether `ros2-memory adopt` listed the directory.
        bags: the other bags of an adopted directory, sorted; None for all bags in it.
        splits: the number of splits that the child has made; None in lines of versions before 0.1,
            and of adopted recordings.
        ended: whether the child makes no more splits.
    """

    recording: Annotated[str, AfterValidator(_checked_name)] = ""
    inode: Int64 | None = None
    generation: Int64 | None = None
    adopted: StrictBool = False
    bags: tuple[str, ...] | None = None
    splits: Count | None = None
    ended: StrictBool = False

    def holds(self, file: str) -> bool:
        """Whether a file in the recording's directory is one of its bags, by its name."""
        if self.adopted and self.bags is None:
            return True
        name, bags = file.removesuffix(COMPRESSED), self.bags or ()
        number = split_number(self.recording, name)
        if number is not None and (self.splits is None or number < self.splits):
            return True
        index = bisect_left(bags, name)
        return index < len(bags) and bags[index] == name

    def with_bags(self, files: Iterable[str]) -> ListRow:
        """Returns the line with these bags of the directory adopted."""
        bags = set(self.bags or ())
        bags.update(file.removesuffix(COMPRESSED) for file in files if not self.holds(file))
        return replace(self, adopted=True, bags=tuple(sorted(bags)))

    def count_splits(self, files: Container[str]) -> int:
        """Returns the number of splits that the child has made, given the files that were seen."""
        splits = self.splits or 0
        while split_name(self.recording, splits) in files:
            splits += 1
        return splits

    @property
    def identity(self) -> Identity | None:
        """The directory of the recording; None until its child has made it."""
        return None if self.inode is None else Identity(self.inode, self.generation)

    def lists(self, identity: Identity | None) -> bool:
        """Whether a directory with this identity is the recording's."""
        listed = self.identity
        return identity is not None and listed is not None and identity.matches(listed)


LIST: Final = JsonLog(LIST_FILE, ListRow, is_brief=True)


def _by_recording(rows: Iterable[ListRow]) -> dict[str, ListRow]:
    return {row.recording: row for row in rows}


class OwnRecordings:
    """The list of one bag directory. Safe for several threads at once.

    Queries write nothing. The recorder adds every recording, and writes the list again if somebody
    has deleted it.
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
        """Whether there is a list.

        Raises:
            OSError: the list cannot be read.
        """
        with self._lock:
            return self._read_if_changed()

    def names(self) -> Collection[str]:
        """Returns the listed recordings, without saved moments, whether they still exist or not.

        Known recordings remain known if the list is deleted.

        Raises:
            OSError: the list cannot be read.
        """
        return [name for name in self._current_rows() if not is_kept_apart(name)]

    def in_order(self) -> Sequence[str]:
        """Returns the recordings that the recorder made, in the order in which they began.

        Bags that were put into one of them may be adopted.

        Raises:
            OSError: the list cannot be read.
        """
        rows = self._current_rows().items()
        made = (name for name, row in rows if not row.adopted or row.splits is not None)
        return [name for name in made if not is_kept_apart(name)]

    def owns_bag(self, path: Path) -> bool:
        """Whether a bag file is the recorder's own, see `judge`.

        Raises:
            OSError: the list cannot be read.
        """
        self._current_rows()
        return self.judge_of(str(path.parent))(path.name)

    def judge_of(self, directory: str) -> Callable[[str], bool]:
        """Returns `judge` for the directory that has this path now."""
        return self.judge(self.name_of(directory), known_identity(directory))

    def judge(self, folder: str, identity: Identity | None) -> Callable[[str], bool]:
        """Returns a function that tells whether a bag file, by its name, is the recorder's own.

        It uses the list as last read. A restored folder of moments or carried messages is in no
        list.

        Args:
            folder: the directory of the file, by its name in the list.
            identity: the identity of the directory, which must be the listed one.
        """
        row = self._rows.get(folder)
        return row.holds if row and row.lists(identity) else lambda _: False

    def owns(self, directory: Path) -> bool:
        """Whether a directory is one of the recorder's own recordings.

        It may hold foreign bags all the same. False if the directory must not be opened.

        Raises:
            OSError: the list cannot be read.
        """
        self._current_rows()
        return self.lists(self.name_of(directory), known_identity(str(directory)))

    def is_announced(self, directory: Path) -> bool:
        """Whether a recording of this name is listed, and not yet its directory.

        Raises:
            OSError: the list cannot be read.
        """
        row = self._current_rows().get(self.name_of(directory))
        return row is not None and row.identity is None

    def lists(self, name: str, identity: Identity | None) -> bool:
        """Whether the list, as last read, has a directory of this name and identity."""
        row = self._rows.get(name)
        return row is not None and row.lists(identity)

    def name_of(self, directory: Path | str) -> str:
        """Returns a path relative to the bag directory; an empty text if it lies elsewhere."""
        root, path = f"{self._bag_dir}/", str(directory)
        return path.removeprefix(root) if path.startswith(root) else ""

    @property
    def stamp(self) -> object:
        """A value that changes whenever the list is read again."""
        return self._stamp

    # The methods below are for the recorder, which holds the lock of the bag directory, and for
    # `ros2-memory adopt`.

    def claim(self) -> None:
        """Brings the list up to date. Call it before anything is recorded.

        If there is no list, an empty one is made, and recordings that look like own ones are
        reported: they may have been restored or copied. Otherwise recordings that are gone are
        dropped, and those that a kill left incomplete are completed (see `_left_by_kill`). Changes
        that a full disk refuses count all the same, so that space can be freed; the next recording
        writes them.

        Raises:
            RecorderError: the list cannot be read, or the bag directory cannot be listed.
        """
        with self._lock:
            try:
                exists = self._read_if_changed()
                unlisted = [] if exists else self._recordings_on_disk()
            except OSError as error:
                raise self._failure(error, "read") from error
            rows = self._left_by_kill()
            self._add(rows)
            if unlisted:
                count, names = len(unlisted), unlisted[:_MAX_NAMED]
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

    def _recordings_on_disk(self) -> list[str]:
        paths = self._bag_dir.iterdir()
        return sorted(path.name for path in paths if has_own_name(path.name) and is_folder(path))

    def begin(self, name: str) -> None:
        """Lists a recording that is about to begin.

        Raises:
            RecorderError: the list cannot be written, so the recording must not begin.
        """
        self._begun = name
        self._append([ListRow(recording=name)])

    def complete(self, name: str) -> bool:
        """Lists the directory that the child made for a recording; returns False if there is none.

        Raises:
            RecorderError: the list cannot be written.
        """
        try:
            identity = identity_of(self._bag_dir / name)
        except OSError as error:
            raise RecorderError(f"{self._bag_dir / name}: {error.strerror or error}") from error
        if identity is None:
            return False
        self._append([ListRow(name, *identity, splits=0)])
        return True

    def note_splits(self, name: str, files: Container[str], *, ended: bool = False) -> None:
        """Lists the splits that the child of a recording has made.

        Args:
            name: the recording.
            files: the names of all files of the recording that were ever seen.
            ended: whether the child makes no more splits.

        Raises:
            RecorderError: the list cannot be written. The splits count all the same, so that space
                can be freed on a full disk, and are written with the next one.
        """
        with self._lock:
            row = self._rows.get(name)
            if row is None or row.identity is None or row.splits is None:
                return
            new = replace(row, splits=row.count_splits(files), ended=ended)
            try:
                if new == row and self._read_if_changed():
                    return
                self._append([new])
            except OSError as error:
                raise self._failure(error) from error
            except RecorderError:
                self._remember_unwritten([new])
                raise

    def adopt(self, identities: Mapping[str, Identity]) -> None:
        """Lists directories and the bags in them as the recorder's own.

        Raises:
            RecorderError: the list cannot be written.
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
        """Returns the line of a directory, a new one if the directory is not listed."""
        row = self._rows.get(name)
        if row is not None and row.lists(identity):
            return row
        row = ListRow(name, *identity)
        return replace(row, splits=0, ended=True) if is_kept_apart(name) else row

    def add_bags(self, directory: Path, bags: Iterable[str]) -> None:
        """Lists bags that the recorder puts into a folder of moments, days or carried messages.

        If the list cannot be written, the bags count all the same; the next recording writes them.

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

    def forget(self, folder: Path) -> None:
        """Drops a removed folder and those that were in it; if the disk refuses, a later call does.

        Folders that are still there stay listed.
        """
        with self._lock:
            name = self.name_of(folder)
            gone = self._missing_on_disk(
                row for row in self._rows if f"{row}/".startswith(f"{name}/")
            )
            for row in gone:
                self._unwritten.pop(row, None)
            if gone:
                with suppress(OSError):
                    self._rewrite(())

    def _remember_unwritten(self, rows: Sequence[ListRow]) -> None:
        """Adds rows that cannot be written now; they are written with the next row."""
        self._unwritten |= _by_recording(rows)
        self._add(rows)

    def _add(self, rows: Iterable[ListRow]) -> None:
        # A new dictionary: another thread may iterate over this one.
        self._rows = self._rows | _by_recording(rows)

    def _left_by_kill(self) -> list[ListRow]:
        """Returns the lines that a kill kept from being written.

        Its child may have made the directory of an announced recording: the heartbeat, which is
        written before the child is started, names the recording. And a recording that did not end
        may have more splits.
        """
        named = read_heartbeat(self._bag_dir).recordings
        left: list[ListRow] = []
        for name, row in self._rows.items():
            with suppress(OSError):
                directory = self._bag_dir / name
                if row.identity is None and name in named:
                    identity = identity_of(directory)
                    if identity is not None:
                        row = ListRow(name, *identity, splits=0)  # noqa: PLW2901 - as it is now
                        left.append(row)
                if row.identity is not None and row.splits is not None and not row.ended:
                    files = {path.name for path in bags_in(directory)}
                    left.append(replace(row, splits=row.count_splits(files), ended=True))
        return left

    def _missing_on_disk(self, names: Iterable[str]) -> list[str]:
        """Returns the recordings that are not in the bag directory any more."""
        gone: list[str] = []
        for name in names:
            with suppress(OSError):  # on a failing disk the recording may still exist
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
        """Reads the list if it has changed; returns whether there is one."""
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
        """Appends lines; rewrites the list if it is missing, or most of its recordings are gone."""
        rows = [*self._unwritten.values(), *rows]
        try:
            with self._lock:
                exists = self._read_if_changed()
                if not exists or self._lines > self._max_lines:
                    self._rewrite(rows)
                else:
                    with locked(self._path) as descriptor:
                        append_lines(descriptor, LIST.text(rows))
                    self._add(rows)
                self._unwritten.clear()
        except OSError as error:
            raise self._failure(error) from error

    def _rewrite(self, rows: Iterable[ListRow]) -> None:
        """Replaces the list by one with these lines, and without recordings that are gone."""
        before = self._rows
        try:
            with locked(self._path) if os.path.lexists(self._path) else nullcontext():
                # Another program may have appended meanwhile.
                self._stamp = None
                self._read_if_changed()
                # A line that announces a recording must not replace the one with its directory.
                merged = before | {
                    name: row
                    for name, row in self._rows.items()
                    if row.identity or name not in before
                }
                # The child of the newest recording may not have made the directory yet.
                for name in self._missing_on_disk(merged.keys() - {self._begun}):
                    del merged[name]
                merged |= _by_recording(rows)
                self._write(merged.values())
        except OSError:
            # The lines that others appended are read again.
            self._rows, self._stamp = before, None
            raise
        self._max_lines = 2 * len(merged) + _SPARE_LINES
        self._rows, self._stamp = merged, None

    def _write(self, rows: Iterable[ListRow]) -> None:
        is_new = not is_folder(self._path.parent)
        LIST.replace(self._bag_dir, rows)
        if is_new:
            give_to_owner(self._path.parent, self._bag_dir)
            flush(self._bag_dir)

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
    """Yields the directories with bag files, the given one and those below it.

    Follows no link below it, and leaves out hidden directories and `lost+found`.

    Raises:
        OSError: a directory cannot be listed.
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
    """Whether a path is a regular file, and not a link to one.

    Raises:
        OSError: the disk fails.
    """
    return stat.S_ISREG(mode_of(path))
