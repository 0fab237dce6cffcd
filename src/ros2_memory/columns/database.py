"""An SQLite file of derived data, which repairs itself.

The file may be deleted, replaced, overwritten, locked or on a full disk at any moment. None of that
raises an error here. A file that is damaged or of another version is renamed and created again. One
that is busy or full is tried again later; until then nothing can be read from it.
"""

from __future__ import annotations

import errno
import os
import sqlite3
import threading
import time
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeVar

from ros2_memory.columns.pack import FORMAT
from ros2_memory.core.errors import sqlite_code
from ros2_memory.core.logging_setup import get_logger

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path


PRAGMAS: Final = (
    "page_size = 4096",
    "cache_size = -64",  # KiB: a server may have hundreds open, and the kernel has their pages
    "auto_vacuum = INCREMENTAL",
    "secure_delete = ON",
)
"""Of each connection, before anything else: deleted rows are overwritten, and pages that become
free go back to the disk."""
TABLES: Final = (
    "bag",
    "summary",
    "topic",
    "definition",
    "part",
    "part_column",
    "zone",
    "fragment",
    "fragment_part",
    "listing",
    "deletion",
)
STATEMENTS: Final = """
CREATE TABLE bag (id INTEGER PRIMARY KEY AUTOINCREMENT, path TEXT NOT NULL UNIQUE,
  size INTEGER NOT NULL, mtime_ns INTEGER NOT NULL, sidecar_ns INTEGER NOT NULL,
  first_ns INTEGER NOT NULL, last_ns INTEGER NOT NULL, messages INTEGER NOT NULL,
  hashed INTEGER NOT NULL, definitions TEXT NOT NULL, summary INTEGER NOT NULL,
  counts BLOB NOT NULL);
CREATE TABLE summary (id INTEGER PRIMARY KEY, topics TEXT NOT NULL UNIQUE);
CREATE TABLE topic (id INTEGER PRIMARY KEY AUTOINCREMENT, name TEXT NOT NULL,
  encoding TEXT NOT NULL, latched INTEGER NOT NULL, definition INTEGER NOT NULL,
  layout TEXT NOT NULL,
  UNIQUE (name, encoding, latched, definition, layout));
CREATE TABLE definition (id INTEGER PRIMARY KEY, type TEXT NOT NULL, encoding TEXT NOT NULL,
  text BLOB NOT NULL, UNIQUE (type, encoding, text));
CREATE TABLE part (id INTEGER PRIMARY KEY AUTOINCREMENT, topic INTEGER NOT NULL,
  first_ns INTEGER NOT NULL, last_ns INTEGER NOT NULL, messages INTEGER NOT NULL,
  bags TEXT NOT NULL, dropped TEXT NOT NULL, bytes INTEGER NOT NULL, level INTEGER NOT NULL);
CREATE INDEX part_of_topic ON part (topic, first_ns, last_ns);
CREATE INDEX part_of_level ON part (level);
CREATE TABLE part_column (part INTEGER NOT NULL, path TEXT NOT NULL, same TEXT,
  data BLOB, UNIQUE (part, path));
CREATE TABLE zone (topic INTEGER NOT NULL, path TEXT NOT NULL, part INTEGER NOT NULL,
  codec TEXT NOT NULL, count INTEGER NOT NULL, error REAL NOT NULL, least, greatest,
  nulls INTEGER NOT NULL, words TEXT, PRIMARY KEY (topic, path, part)) WITHOUT ROWID;
CREATE TABLE fragment (id INTEGER PRIMARY KEY AUTOINCREMENT, kind TEXT NOT NULL,
  settings TEXT NOT NULL, start_ns INTEGER NOT NULL, parts TEXT NOT NULL, data BLOB NOT NULL,
  UNIQUE (kind, settings, start_ns, parts));
CREATE TABLE fragment_part (part INTEGER NOT NULL, fragment INTEGER NOT NULL,
  PRIMARY KEY (part, fragment)) WITHOUT ROWID;
CREATE TABLE listing (folder TEXT PRIMARY KEY, listed TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE deletion (id INTEGER PRIMARY KEY AUTOINCREMENT);
"""
"""Separated by semicolons."""


_STATEMENTS_KEPT: Final = 16
"""Compiled statements that a connection keeps: the 128 of Python took 90 kB more of each store."""
BUSY_S: Final = 1.0
"""How long a write waits for another program that holds the file."""
RETRY_S: Final = 10.0
"""How often a file that could not be opened is tried again."""

_SHORT_MS: Final = 20
"""How long SQLite waits in one attempt; queries wait as long."""
_PAUSE_S: Final = 0.02
ROW_ID_BITS: Final = 40
"""Low bits of a row's number that have its id; the others tell which database the row is of.

So the number of a row in a lost file never means a row of the file that replaced it.
"""
_FEW_PAGES: Final = 256
"""Unused pages that stay in the file, for what is written next."""
_SUFFIXES: Final = ("-wal", "-shm")
"""The files that SQLite keeps beside one in WAL mode: the write-ahead log and its index."""
_FIRST_ROWS: Final = f"SELECT {', '.join(f'(SELECT 1 FROM {name})' for name in TABLES)}"
"""Looks where each table begins."""
T = TypeVar("T")

log = get_logger(__name__)


def row_id(number: int) -> int:
    """Returns the id, in its file, of the row with a number."""
    return number & (1 << ROW_ID_BITS) - 1


@dataclass(frozen=True, slots=True)
class OpenDatabase:
    """An open database.

    Attributes:
        connection: to it.
        path: of its file; None in memory.
        files: the paths of the file, of its write-ahead log and of the log's index.
        identities: device and inode of each of these when it was opened, which distinguish them
            from other files at the same paths.
    """

    connection: sqlite3.Connection
    path: Path | None = None
    files: tuple[str, ...] = ()
    identities: tuple[tuple[int, int] | None, ...] = ()

    def is_in_place(self) -> bool:
        """Whether the paths still lead to the open files; True if that cannot be found out."""
        try:
            return self.identities == _identities(self.files)
        except OSError:
            return True

    def is_mixed(self) -> bool:
        """Whether the file is in place but its write-ahead log is missing or another program's.

        Several programs that write to such files destroy the database.
        """
        now = _identities(self.files)
        return now[:1] == self.identities[:1] and now != self.identities


class Database:
    """An SQLite database whose file may be lost and is then created again. Thread-safe.

    Args:
        paths: where the file may lie, in order of preference, or a function that returns that. If
            none of them can be written, the database is in memory.
        sources: other files that may be copied to a path that has none yet; only read.
        waits_for: a directory; while it does not exist, nothing is opened or created.
    """

    def __init__(
        self,
        paths: Sequence[Path] | Callable[[], Sequence[Path]],
        *,
        sources: Sequence[Path] = (),
        waits_for: Path | None = None,
    ) -> None:
        self._candidate_paths = paths if callable(paths) else lambda: paths
        self._sources = tuple(sources)
        self._waits_for = waits_for
        self._lock = threading.Lock()
        self._opened: OpenDatabase | None = None
        self._databases = 0
        self._closed = False
        self._tried_s = 0.0
        self.trouble: str | None = None
        """What is wrong, as the end of a sentence about the database, or None."""
        self.is_failing = False
        """Whether it failed, and has not been written since."""
        self.failures = 0
        """How often it could not be read; answers given meanwhile may lack something."""
        self.refusals = 0
        """How often SQLite could not represent what was to be written."""
        self.refused_for: str | None = None
        """The error of the last refusal."""

    @property
    def path(self) -> Path | None:
        """Path of the file; None in memory, and before it is opened."""
        with self._lock:
            opened = self._open_if_needed()
        return None if opened is None else opened.path

    @property
    def offset(self) -> int:
        """The difference between a row's number and its id in the open database."""
        return self._databases << ROW_ID_BITS

    def is_current(self, number: int) -> bool:
        """Returns whether a row is of the open database, and not of a lost one."""
        return number >> ROW_ID_BITS == self._databases

    def close(self) -> None:
        """Closes the connection for good; afterwards nothing can be read or written."""
        with self._lock:
            self._closed = True
            if self._opened is not None:
                self._opened.connection.close()
                self._opened = None

    def read(self, ask: Callable[[sqlite3.Connection], T], unknown: T) -> T:
        """Returns what `ask` reads in one transaction; `unknown` if the database cannot be read."""
        with self._lock:
            opened = self._open_if_needed()
            if opened is None:
                self.failures += 1
                return unknown
            try:
                # In one: packed bytes must be read with the codec that they were packed with.
                with _transaction(opened.connection, "BEGIN"):
                    answer = ask(opened.connection)
            # Rows of a damaged file can hold anything, so decoding them can raise any of these.
            except (sqlite3.Error, ValueError, TypeError, LookupError, MemoryError) as error:
                self.failures += 1
                self._handle(error)
                return unknown
            # Checked afterwards: if another program has replaced the log meanwhile, SQLite has read
            # pages that were never written.
            return unknown if self._close_if_lost(opened) else answer

    def write(self, write: Callable[[sqlite3.Connection], bool | None]) -> bool:
        """Writes all or nothing; returns False if nothing was written or `write` said False."""
        give_up_s = time.monotonic() + BUSY_S
        while True:
            with self._lock:
                opened = self._open_if_needed()
                if opened is None or self._close_if_lost(opened):
                    return False
                try:
                    with _transaction(opened.connection, "BEGIN IMMEDIATE"):
                        answer = write(opened.connection)
                        if self.is_failing:  # without a change nothing would touch the disk
                            opened.connection.execute(f"PRAGMA user_version = {FORMAT:d}")
                except (sqlite3.Error, MemoryError) as error:
                    if not is_busy(error) or time.monotonic() >= give_up_s:
                        self._handle(error)
                        return False
                # A number or text that SQLite cannot store: the bags stay without an entry.
                except (ValueError, OverflowError) as error:
                    self.refusals += 1
                    self.refused_for = str(error)
                    log.warning("database_refused", path=str(opened.path), reason=str(error))
                    return False
                else:
                    if self.is_failing:
                        self.trouble, self.is_failing = None, False
                        log.info("database_works_again", path=str(opened.path))
                    return not self._close_if_lost(opened) and answer is not False
            # Outside the lock, so that readers do not wait for another program's writes.
            time.sleep(_PAUSE_S)

    def give_up(self, row: int, error: Exception) -> None:
        """Sets the database of a row aside, because data read of it turned out to be damaged."""
        with self._lock:
            if self.is_current(row):  # else another thread has, and the present one is sound
                self._handle(error)

    def write_again(self) -> None:
        """Writes nothing to a database that failed, to find out whether its disk works again.

        Another program may have written what was to be written.
        """
        if self.is_failing:
            self.write(lambda _: None)

    def release_pages(self) -> None:
        """Returns unused pages to the disk, but for a few."""
        while self._release_some_pages():
            # Else this thread would take the lock again before those that wait for it.
            time.sleep(_PAUSE_S)

    def _release_some_pages(self) -> bool:
        """Returns some unused pages to the disk; returns False if there are few."""
        with self._lock, suppress(sqlite3.Error):
            opened = self._open_if_needed()
            if opened is not None and opened.path is not None and not self._close_if_lost(opened):
                unused = _unused_pages(opened.connection)
                if unused > _FEW_PAGES:
                    # A script: a statement alone would free one page, whatever it asks for.
                    opened.connection.executescript(f"PRAGMA incremental_vacuum({_FEW_PAGES})")
                    return _unused_pages(opened.connection) < unused
        return False

    def look_after(self, *, thorough: bool = False) -> None:
        """Closes a file that was deleted, replaced or damaged; the next read or write reopens it.

        If a preferred path can be written now, the database moves there with all of its content.
        This may take a while, so no question should wait for it.

        Args:
            thorough: whether the whole file is read to check that it is intact.
        """
        with self._lock:
            opened = self._opened
            if opened is None or not self._may_open() or self._close_if_lost(opened):
                return
        if time.monotonic() - self._tried_s >= RETRY_S:
            self._move_to_preferred_path(opened)
        if opened.path is None or self._opened is not opened:
            return
        # SQLite's page cache hides that the file was overwritten, so another connection looks.
        fault = _fault_of(opened.path, thorough=thorough)
        if fault is not None and not is_transient(fault):
            with self._lock:
                if self._opened is opened:
                    self._handle(fault)

    # The methods below run under the lock, except `_move_to_preferred_path`.

    def _may_open(self) -> bool:
        exists = self._waits_for is None or os.path.isdir(self._waits_for)
        return not self._closed and exists

    def _open_if_needed(self) -> OpenDatabase | None:
        """Returns the open database, opened first if need be; None if that is not allowed."""
        if self._opened is None and self._may_open():
            self._tried_s = time.monotonic()
            paths = self._candidate_paths()
            opened = open_file(paths, sources=self._sources)
            self._opened = _in_memory() if isinstance(opened, str) else opened
            self.trouble = None
            if isinstance(opened, str) and paths:
                self.trouble = f"is kept in memory: {opened}"
        return self._opened

    def _move_to_preferred_path(self, before: OpenDatabase) -> None:
        """Opens the file at a path that is preferred to the present one, if it can be written now.

        The content of a file is copied there first. The content of memory is not: it is derived
        again.
        """
        self._tried_s = time.monotonic()
        paths = tuple(self._candidate_paths())
        # It stays at a path that is no longer a candidate.
        if before.path is not None:
            paths = paths[: paths.index(before.path)] if before.path in paths else ()
        opened = open_file(paths, again=True, previous=before.path) if paths else ""
        if isinstance(opened, str):
            return
        with self._lock:
            if self._closed or self._opened is not before:
                opened.connection.close()
                return
            before.connection.close()
            self._opened = opened
            self._databases += 1
            self.trouble, self.is_failing = None, False
            if before.path is None:
                log.info("database_in_file_again", path=str(opened.path))
            else:
                log.info("database_moved", path=str(opened.path))

    def _close_if_lost(self, opened: OpenDatabase) -> bool:
        """Closes the database if other files, or none, are in its place; returns whether it did."""
        if opened.is_in_place() or not self._may_open():
            return False
        self._close_lost("its file was deleted or replaced", aside=opened.is_mixed())
        return True

    def _handle(self, error: Exception) -> None:
        """Sets a damaged database aside; only notes that one is busy or full."""
        if not is_transient(error):
            self._close_lost(f"it is damaged: {error}", aside=True)
            return
        trouble = f"cannot be used: {error}"
        if trouble != self.trouble:
            path = None if self._opened is None else self._opened.path
            log.warning("database_failed", path=str(path), reason=str(error))
        self.trouble, self.is_failing = trouble, True

    def _close_lost(self, reason: str, *, aside: bool) -> None:
        """Closes the open database; the next read or write opens or creates another one.

        Args:
            reason: for the log.
            aside: whether the file is renamed.
        """
        opened, self._opened = self._opened, None
        self.failures += 1
        self._databases += 1
        if opened is None:
            return
        with suppress(sqlite3.Error):
            opened.connection.close()
        if opened.path is None or not aside:
            log.warning("database_lost", path=str(opened.path), reason=reason)
            return
        try:
            _set_aside(opened.path, reason)
        except OSError as error:
            log.warning("database_not_set_aside", path=str(opened.path), reason=str(error))


@contextmanager
def _transaction(connection: sqlite3.Connection, begin: str) -> Iterator[None]:
    """Runs a block in one transaction, which is rolled back if the block raises."""
    connection.execute(begin)
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        with suppress(sqlite3.Error):
            connection.execute("ROLLBACK")
        raise


def open_file(
    paths: Sequence[Path],
    *,
    again: bool = False,
    previous: Path | None = None,
    sources: Sequence[Path] = (),
) -> OpenDatabase | str:
    """Opens the database at the first path that can be written; returns the reason if none can.

    Args:
        paths: where it may lie, in order of preference.
        again: whether this was tried before: then failures are logged at debug level.
        previous: its path until now. A path that has no file yet gets a copy of that file; without
            it, of the first valid file among the later paths and `sources`.
        sources: other files that may be copied; only read.
    """
    reason = ""
    for nth, path in enumerate(paths, start=1):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            _refuse_links(path)
            if not path.exists():
                _copy_first_valid((previous,) if previous else (*paths[nth:], *sources), path)
            connection = _connect_and_check(path)
            connection.execute(f"PRAGMA busy_timeout = {_SHORT_MS:d}")
            files = tuple(map(str, files_of(path)))
            return OpenDatabase(connection, path, files, _identities(files))
        except (OSError, sqlite3.Error) as error:
            if is_busy(error):
                write_log = log.debug if again else log.warning
                write_log("database_locked", path=str(path), instead="memory")
                return "another program has locked its file"
            write_log = log.debug if again else log.info
            write_log("database_place_refused", path=str(path), reason=str(error))
            reason = str(error.strerror if isinstance(error, OSError) else error)
    return f"no file can be written for it ({reason})"


def _copy_first_valid(sources: Sequence[Path], path: Path) -> None:
    """Copies to `path` the first of these files that is a database of this version.

    The copy appears at once, by a hard link, and never replaces a file of another program.
    """
    for source in sources:
        temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            if source.is_file() and _back_up(source, temporary):
                with suppress(FileExistsError):
                    os.link(temporary, path)
                return
        except (OSError, sqlite3.Error) as error:
            log.debug("database_not_copied", path=str(source), reason=str(error))
        finally:
            for file in files_of(temporary):
                with suppress(OSError):
                    file.unlink(missing_ok=True)


def _back_up(source: Path, temporary: Path) -> bool:
    """Copies a database to a temporary file; returns False if it is of another version."""
    temporary.unlink(missing_ok=True)
    _refuse_links(source)
    # Without a log no program has it open. Either way SQLite writes no file beside it.
    mode = "readonly_shm=1" if files_of(source)[1].exists() else "immutable=1"
    address = f"{source.absolute().as_uri()}?mode=ro&{mode}"
    with (
        closing(sqlite3.connect(address, uri=True, timeout=BUSY_S)) as original,
        closing(sqlite3.connect(temporary)) as copy,
    ):
        if original.execute("PRAGMA user_version").fetchone()[0] != FORMAT:
            return False
        original.backup(copy)
    return True


def _refuse_links(path: Path) -> None:
    """Refuses symbolic links, whose targets would be written or renamed.

    Raises:
        OSError: the file, its write-ahead log or its folder is a symbolic link.
    """
    for file in (path.parent, *files_of(path)):
        if file.is_symlink():
            raise OSError(errno.ELOOP, f"{file.name} is a symbolic link, which is not followed")


def _fault_of(path: Path, *, thorough: bool) -> sqlite3.Error | None:
    """Returns what is wrong with a file, seen through a connection of its own; None: nothing.

    Args:
        path: the file.
        thorough: whether all of it is read; else only the beginning of each table.
    """
    # rw and not rwc: a file that was just deleted is not created again.
    address = f"{path.absolute().as_uri()}?mode=rw"
    try:
        with closing(sqlite3.connect(address, uri=True, timeout=_SHORT_MS / 1000)) as connection:
            connection.execute(_FIRST_ROWS).fetchall()
            if not thorough:
                return None
            verdict = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
    except sqlite3.Error as error:
        return error
    return None if verdict == "ok" else sqlite3.DatabaseError(verdict)


def _in_memory() -> OpenDatabase:
    """Returns an empty database in memory."""
    connection = _connect(":memory:")
    connection.executescript(STATEMENTS)
    return OpenDatabase(connection)


def is_transient(error: Exception) -> bool:
    """Returns whether the database may work again as it is, without being created anew.

    Operational errors are faults of the machine or of the moment, such as a full disk. Three of
    them are faults of the content: a missing table (`SQLITE_ERROR`), text that is not UTF-8 (no
    code) and short pages (`SQLITE_IOERR_SHORT_READ`) of a write-ahead log that was overwritten.
    """
    if getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_IOERR_SHORT_READ:
        return False
    is_operational = isinstance(error, sqlite3.OperationalError)
    is_of_content = sqlite_code(error) in {0, sqlite3.SQLITE_ERROR}
    return isinstance(error, MemoryError) or (is_operational and not is_of_content)


def _unused_pages(connection: sqlite3.Connection) -> int:
    return int(connection.execute("PRAGMA freelist_count").fetchone()[0])


def is_busy(error: Exception) -> bool:
    """Returns whether another program holds the database."""
    return sqlite_code(error) in {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}


def files_of(path: Path) -> list[Path]:
    """Returns the file itself, its write-ahead log and the log's index."""
    return [path, *(path.with_name(path.name + suffix) for suffix in _SUFFIXES)]


def _identities(files: Sequence[str]) -> tuple[tuple[int, int] | None, ...]:
    """Returns device and inode of each file; None if there is none."""
    identities: list[tuple[int, int] | None] = []
    for file in files:
        try:
            status = os.stat(file)  # noqa: PTH116 - at each reading: a path takes three times as long
        except (FileNotFoundError, NotADirectoryError):
            identities.append(None)
        else:
            identities.append((status.st_dev, status.st_ino))
    return tuple(identities)


def _connect_and_check(path: Path) -> sqlite3.Connection:
    """Connects to a file; sets it aside first if it is damaged or of another version.

    Raises:
        OSError: it cannot be set aside, or another version of this program uses it. If both set the
            other's file aside, they would store all bags for ever.
        sqlite3.Error: it is busy, or cannot be opened or written.
    """
    for _ in range(2):
        connection = None
        try:
            connection = _connect(str(path))
            other = _create_or_compare_tables(connection)
            if other is None:
                return connection
            in_use = _is_used_elsewhere(connection)
        except sqlite3.DatabaseError as error:
            if connection is not None:
                connection.close()
            if is_transient(error):
                raise
            _set_aside(path, f"it is damaged: {error}")
            continue
        connection.close()
        if in_use:
            raise OSError(errno.EBUSY, f"another version of this program uses it: {other}")
        _set_aside(path, other)
    raise sqlite3.OperationalError("another program replaces it again and again")


def _connect(target: str) -> sqlite3.Connection:
    connection = sqlite3.connect(
        target,
        timeout=BUSY_S,
        isolation_level=None,
        check_same_thread=False,
        cached_statements=_STATEMENTS_KEPT,
    )
    try:
        for pragma in PRAGMAS:
            connection.execute(f"PRAGMA {pragma}")
    except sqlite3.Error:
        connection.close()
        raise
    return connection


def _create_or_compare_tables(connection: sqlite3.Connection) -> str | None:
    """Creates the tables of a new database; returns in which version an old one is, if in another.

    Raises:
        sqlite3.DatabaseError: it lacks a table, or is damaged.
    """
    connection.execute("PRAGMA journal_mode = WAL")
    connection.execute("PRAGMA synchronous = NORMAL")
    with _transaction(connection, "BEGIN IMMEDIATE"):
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        declared = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        if version == 0 and declared == 0:
            for statement in STATEMENTS.split(";"):
                connection.execute(statement)
            connection.execute(f"PRAGMA user_version = {FORMAT:d}")
    if declared and version != FORMAT:
        return f"it is of version {version}, and this program needs {FORMAT}"
    connection.execute(_FIRST_ROWS).fetchall()
    return None


def _is_used_elsewhere(connection: sqlite3.Connection) -> bool:
    """Returns whether another connection to the file is open: only the last can leave WAL mode."""
    try:
        mode = connection.execute("PRAGMA journal_mode = DELETE").fetchone()[0]
    except sqlite3.OperationalError:
        return True
    return bool(mode != "delete")


def _set_aside(path: Path, reason: str) -> None:
    """Renames a file so that a new one can be created; the old one stays for inspection."""
    aside = path.with_name(f"{path.name}.aside")
    log.warning("database_set_aside", path=str(path), reason=reason, renamed_to=aside.name)
    for file in files_of(path)[1:]:
        file.unlink(missing_ok=True)
    path.rename(aside)
