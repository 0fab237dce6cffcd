"""The file of the catalogue: opened, made, or set aside where it is not what is known here."""

from __future__ import annotations

import errno
import os
import sqlite3
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Final

from ros2_memory.core.logging_setup import get_logger

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

VERSION: Final = 4
"""Of the tables below and of what stands in them; a file of any other is set aside."""

BUSY_S: Final = 1.0
"""How long another program that holds the file is waited for."""

_SHORT_MS: Final = 20
"""How long one attempt may wait: whoever asks a question waits for it too."""
_PASSING: Final = frozenset(
    {
        sqlite3.SQLITE_BUSY,
        sqlite3.SQLITE_LOCKED,
        sqlite3.SQLITE_FULL,
        sqlite3.SQLITE_IOERR,
        sqlite3.SQLITE_CANTOPEN,
        sqlite3.SQLITE_READONLY,
        sqlite3.SQLITE_PERM,
        sqlite3.SQLITE_NOMEM,
        sqlite3.SQLITE_PROTOCOL,
    }
)
"""Faults of the machine, or of the moment: the file may be whole."""
_BESIDE: Final = ("-wal", "-shm")
_FIRST_ROWS: Final = """
SELECT (SELECT 1 FROM bags), (SELECT 1 FROM held), (SELECT 1 FROM tales), (SELECT 1 FROM kept),
  (SELECT 1 FROM payloads), (SELECT 1 FROM channels), (SELECT 1 FROM edges), (SELECT 1 FROM shapes)
"""
_TABLES: Final = """
CREATE TABLE bags (id INTEGER PRIMARY KEY AUTOINCREMENT, config TEXT NOT NULL, path TEXT NOT NULL,
  size INTEGER NOT NULL, mtime INTEGER NOT NULL, sidecar INTEGER NOT NULL,
  shape INTEGER NOT NULL, counts BLOB NOT NULL, UNIQUE (config, path));
CREATE TABLE shapes (id INTEGER PRIMARY KEY, text TEXT NOT NULL UNIQUE);
CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE);
CREATE TABLE held (topic INTEGER NOT NULL, bag INTEGER NOT NULL, flags INTEGER NOT NULL,
  words TEXT, low REAL NOT NULL, high REAL NOT NULL, numbers TEXT,
  min_x REAL, max_x REAL, min_y REAL, max_y REAL, min_z REAL, max_z REAL,
  poses BLOB, edges INTEGER, first_stamp INTEGER, last_stamp INTEGER, kept INTEGER,
  undecodable TEXT,
  PRIMARY KEY (topic, bag)) WITHOUT ROWID;
CREATE TABLE tales (topic INTEGER NOT NULL, bag INTEGER NOT NULL, rests BLOB, story BLOB,
  PRIMARY KEY (topic, bag)) WITHOUT ROWID;
CREATE TABLE edges (id INTEGER PRIMARY KEY, pairs TEXT NOT NULL UNIQUE);
CREATE TABLE kept (bag INTEGER NOT NULL, topic INTEGER NOT NULL, nth INTEGER NOT NULL,
  log_time INTEGER NOT NULL, publish_time INTEGER NOT NULL, channel INTEGER NOT NULL,
  payload INTEGER NOT NULL, PRIMARY KEY (topic, bag, nth)) WITHOUT ROWID;
CREATE TABLE channels (id INTEGER PRIMARY KEY, hash BLOB NOT NULL UNIQUE, topic TEXT NOT NULL,
  encoding TEXT NOT NULL, latched INTEGER NOT NULL, schema_name TEXT NOT NULL,
  schema_encoding TEXT NOT NULL, schema_text BLOB NOT NULL);
CREATE TABLE remembered (question TEXT PRIMARY KEY, oldest INTEGER NOT NULL, answer TEXT NOT NULL);
CREATE TABLE payloads (id INTEGER PRIMARY KEY, hash BLOB NOT NULL UNIQUE, bytes BLOB NOT NULL);
"""

log = get_logger(__name__)


@dataclass(frozen=True, slots=True)
class OpenDatabase:
    """An open base, and its file; None in memory.

    `file` and `beside` tell the file, its write-ahead log and the index of that from others of the
    same names.
    """

    base: sqlite3.Connection
    path: Path | None
    file: tuple[int, int] | None = None
    beside: tuple[tuple[int, int] | None, ...] = ()

    def is_in_place(self) -> bool:
        """Whether the names still lead to what is open; also where that cannot be told."""
        if self.path is None:
            return True
        try:
            return self.file == _identity(self.path) and not self.is_mixed()
        except OSError:
            return True

    def is_mixed(self) -> bool:
        """Whether the file lies there, and what belongs to it is another's, or gone.

        What several programs make of that is no base.
        """
        if self.path is None or self.file != _identity(self.path):
            return False
        return self.beside != _identities(self.path)


def open_file(
    places: Sequence[Path], *, again: bool = False, former: Path | None = None
) -> OpenDatabase | str:
    """The base at the first place that can be written; why not where none can.

    Args:
        places: where it may lie, in order of preference.
        again: that this was tried before: what is as it was is not told once more.
        former: where it lay until now. What lies there, or else at the next place, is copied to
            where there is no file yet.
    """
    reason = ""
    for nth, path in enumerate(places, start=1):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            _refuse_links(path)
            if not path.exists():
                _copy_one_of((former,) if former else places[nth:], path)
            base = _ready(path)
            base.execute(f"PRAGMA busy_timeout = {_SHORT_MS:d}")
            return OpenDatabase(base, path, _identity(path), _identities(path))
        except _LockedError:
            tell = log.debug if again else log.warning
            tell("catalogue_locked", path=str(path), instead="memory")
            return "another program holds its file"
        except (OSError, sqlite3.Error) as error:
            tell = log.debug if again else log.info
            tell("catalogue_place_refused", path=str(path), reason=str(error))
            reason = str(error.strerror if isinstance(error, OSError) else error)
    return f"no file can be written for it ({reason})"


def _copy_one_of(sources: Sequence[Path], path: Path) -> None:
    """Makes a catalogue from the first of these that is one; none where there is none.

    It is there whole or not at all, and takes the place of none that another program made.
    """
    for source in sources:
        beside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            if not source.is_file():
                continue
            beside.unlink(missing_ok=True)
            _refuse_links(source)
            address = f"{source.absolute().as_uri()}?mode=ro"
            with (
                closing(sqlite3.connect(address, uri=True, timeout=BUSY_S)) as base,
                closing(sqlite3.connect(beside)) as copy,
            ):
                if base.execute("PRAGMA user_version").fetchone()[0] != VERSION:
                    continue
                base.backup(copy)
            with suppress(FileExistsError):
                os.link(beside, path)
        except (OSError, sqlite3.Error) as error:
            log.debug("catalogue_not_copied", path=str(source), reason=str(error))
        else:
            return
        finally:
            for name in (beside, *(_beside(beside, suffix) for suffix in _BESIDE)):
                with suppress(OSError):
                    name.unlink(missing_ok=True)


def _refuse_links(path: Path) -> None:
    """Refuses a file that lies elsewhere: it would be written, or set aside, where it lies.

    Raises:
        OSError: the file, one that goes with it, or its folder is a link.
    """
    for each in (path.parent, path, *(_beside(path, suffix) for suffix in _BESIDE)):
        if each.is_symlink():
            raise OSError(errno.ELOOP, f"{each.name} is a symbolic link, which is not followed")


def fault_of(path: Path, *, thorough: bool = False) -> sqlite3.Error | None:
    """What is wrong with a base that is open, as another program would find it in its file.

    Args:
        path: where it lies.
        thorough: whether all of it is read; else only where its tables begin.
    """
    # Not made where it has just gone.
    address = f"{path.absolute().as_uri()}?mode=rw"
    try:
        with closing(sqlite3.connect(address, uri=True, timeout=_SHORT_MS / 1000)) as base:
            base.execute(_FIRST_ROWS).fetchall()
            found = base.execute("PRAGMA quick_check(1)").fetchone()[0] if thorough else "ok"
    except sqlite3.Error as error:
        return error
    return None if found == "ok" else sqlite3.DatabaseError(found)


def in_memory() -> OpenDatabase:
    """An empty base in memory."""
    base = _connected(":memory:")
    base.executescript(_TABLES)
    return OpenDatabase(base, None)


def is_passing(error: Exception) -> bool:
    """Whether the base may work again as it is."""
    return isinstance(error, MemoryError) or _code(error) in _PASSING


def is_busy(error: Exception) -> bool:
    """Whether another program holds the base."""
    return _code(error) in {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}


def _code(error: Exception) -> int:
    """SQLite's primary code; 0 where the error is not of SQLite itself."""
    code: object = getattr(error, "sqlite_errorcode", 0)
    return code & 0xFF if isinstance(code, int) else 0


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    return status.st_dev, status.st_ino


def _identities(path: Path) -> tuple[tuple[int, int] | None, ...]:
    return tuple(_identity(_beside(path, suffix)) for suffix in _BESIDE)


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)


class _LockedError(Exception):
    """Another program holds the file: it is left alone."""


class _OtherError(Exception):
    """The file is not a catalogue of this version; the sentence says what it is."""


def _ready(path: Path) -> sqlite3.Connection:
    """The base in a file that can be written, with its tables.

    Raises:
        _LockedError: another program holds it.
        OSError: it cannot be set aside, or another version of this program uses it: each setting
            the other's file aside, they would digest all bags for ever.
        sqlite3.Error: it cannot be opened, or not be written.
    """
    for _ in range(2):
        base = _connected(str(path))
        try:
            _prepare(base)
        except _OtherError as error:
            is_used = _is_used(base)
            base.close()
            if is_used:
                reason = f"another version of this program uses it: {error}"
                raise OSError(errno.EBUSY, reason) from error
            set_aside(path, str(error))
            continue
        except sqlite3.OperationalError as error:
            base.close()
            if is_busy(error):
                raise _LockedError from error
            raise
        except sqlite3.DatabaseError as error:
            base.close()
            set_aside(path, f"it is damaged: {error}")
            continue
        return base
    raise sqlite3.OperationalError("another program replaces it again and again")


def _connected(target: str) -> sqlite3.Connection:
    return sqlite3.connect(target, timeout=BUSY_S, isolation_level=None, check_same_thread=False)


def _prepare(base: sqlite3.Connection) -> None:
    """Makes the tables of a new base, and looks whether an old one can be used."""
    base.execute("PRAGMA journal_mode = WAL")
    base.execute("PRAGMA synchronous = NORMAL")
    base.execute("BEGIN IMMEDIATE")
    version = base.execute("PRAGMA user_version").fetchone()[0]
    tables = base.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
    if version == 0 and tables == 0:
        for statement in _TABLES.split(";"):
            base.execute(statement)
        base.execute(f"PRAGMA user_version = {VERSION:d}")
    base.execute("COMMIT")
    if tables and version != VERSION:
        raise _OtherError(f"it is of version {version}, and {VERSION} is what is known")
    if tables and _declared(base) != _expected():
        raise _OtherError("its tables are not those of this version")
    base.execute(_FIRST_ROWS).fetchall()


def _declared(base: sqlite3.Connection) -> dict[str, str]:
    """The tables of a base, each as it was declared."""
    rows = base.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'").fetchall()
    return {
        name: " ".join(str(sql).split()) for name, sql in rows if not name.startswith("sqlite_")
    }


@cache
def _expected() -> dict[str, str]:
    with closing(in_memory().base) as base:
        return _declared(base)


def _is_used(base: sqlite3.Connection) -> bool:
    """Whether another connection is open to the file: only the last may leave the WAL mode."""
    try:
        mode = base.execute("PRAGMA journal_mode = DELETE").fetchone()[0]
    except sqlite3.OperationalError:
        return True
    return bool(mode != "delete")


def set_aside(path: Path, reason: str) -> None:
    """Makes room for a new file; the old one stays beside it for whoever wants to look."""
    aside = path.with_name(f"{path.name}.aside")
    log.warning("catalogue_set_aside", path=str(path), reason=reason, renamed_to=aside.name)
    for suffix in _BESIDE:
        _beside(path, suffix).unlink(missing_ok=True)
    path.rename(aside)
