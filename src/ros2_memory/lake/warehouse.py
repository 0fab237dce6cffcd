"""Opens a lake: its Iceberg catalogue, its files, and its tables to be written by one at a time.

The catalogue is an SQLite file in the state directory, or a REST service. Whatever goes wrong there
becomes a `LakeError`, in whose sentence no secret is.

Each file is recorded in the state directory before it is written: pyiceberg deletes none, and a
process that is killed leaves files that no version ever had (`upkeep`).

There is one writer: a lock that the system releases when its holder dies, and a lease.

A commit of pyiceberg compares and swaps, so two writers would not lose a bag, nor have it twice.
But only one knows what was forgotten, and with the SQLite catalogue of another state directory
there would be a second lake in the same files. So there is one: by a lock in the lake's state
directory, on a file system that supports locks, and for those with another state directory by a
lease in the warehouse, whose holder renews its term. A state directory that has it goes on at once,
another one when the term is over.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import socket
import sys
import uuid
import warnings
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from pyiceberg.catalog.rest import RestCatalog
from pyiceberg.catalog.sql import SqlCatalog
from pyiceberg.io import load_file_io
from pyiceberg.io.pyarrow import PyArrowFile, PyArrowFileIO

from ros2_memory.bag_dir.durable_write import write_durably
from ros2_memory.bag_dir.json_files import Int64, JsonLog
from ros2_memory.bag_dir.lock import read_holder, write_holder
from ros2_memory.core.errors import LakeError
from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S, Clock, Ns, WallClock, iso_local
from ros2_memory.lake.tables import NAMESPACE, TABLES, open_tables

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    import pyarrow as pa
    from pyiceberg.catalog import Catalog as IcebergCatalog
    from pyiceberg.expressions import BooleanExpression
    from pyiceberg.table import Table as IcebergTable


LEASE_FILE: Final = "writer.lock"
TERM_NS: Final[Ns] = 600 * NS_PER_S
"""How long the lease in the warehouse holds: longer than any commit takes."""
_RENEWED_NS: Final = TERM_NS // 4
_ID_FILE: Final = "writer.id"
_MAX_TEXT: Final = 1000
CATALOGUE_FILE: Final = "catalogue.sqlite"
WRITTEN_FILE: Final = "written.jsonl"
RECORD: Final = "ros2-memory.written"
"""The setting of a `RecordingFileIO` that names the folder of its record."""
_MOST_CHARS: Final = 500
_MASK: Final = "********"


@dataclass(frozen=True, slots=True)
class Written:
    """A file, and when (ns) it was about to be written."""

    file: str
    at: Int64


WRITTEN: Final = JsonLog(WRITTEN_FILE, Written, most_bytes=sys.maxsize)


class RecordingFileIO(PyArrowFileIO):
    """Records each file durably before it is written."""

    def new_output(self, location: str) -> PyArrowFile:
        """Returns a file to be written."""
        from pathlib import Path  # noqa: PLC0415 - pyiceberg reads this class's annotations

        record = self.properties.get(RECORD)
        if record:
            # With a REST catalogue nothing else is there before the first table.
            Path(record).mkdir(parents=True, exist_ok=True)
            WRITTEN.append(Path(record), [Written(location, WallClock().now())])
        return super().new_output(location)


@dataclass(frozen=True, slots=True)
class LakeLocation:
    """Where a lake is.

    Attributes:
        warehouse: the URI below which its files lie: `file:///...`, `s3://...`.
        state_dir: the lock of its writer, and the catalogue where that is SQLite.
        catalog: what lists its tables.
        uri: of a REST catalogue, or of another database; None for the SQLite file.
        properties: of the catalogue and of the file store, as pyiceberg names them.
        secrets: likewise, and never shown.
    """

    warehouse: str
    state_dir: Path
    catalog: Literal["sql", "rest"] = "sql"
    uri: str | None = None
    properties: Mapping[str, str] = field(default_factory=dict)
    secrets: Mapping[str, str] = field(default_factory=dict, repr=False)

    @property
    def _is_file(self) -> bool:
        return self.catalog == "sql" and self.uri is None

    @contextmanager
    def translated(self, what: str) -> Iterator[None]:
        """Turns the errors of catalogues and stores into `LakeError`s without secrets.

        Raises:
            LakeError: it failed; `what` says what was being done.
        """
        try:
            yield
        except LakeError:
            raise
        except Exception as error:  # noqa: BLE001 - each store raises errors of its own
            text = f"{type(error).__name__}: {error}"
            for secret in sorted(filter(None, self.secrets.values()), key=len, reverse=True):
                text = text.replace(secret, _MASK)
            raise LakeError(f"{what} failed: {text[:_MOST_CHARS]}") from None

    @contextmanager
    def opened(self) -> Iterator[IcebergCatalog]:
        """Opens the catalogue.

        Raises:
            LakeError: it cannot be opened.
        """
        # It logs each file that it opens, at the level of our own events, and warns of deletes that
        # match no row: most repeat nothing.
        logging.getLogger("pyiceberg").setLevel(logging.WARNING)
        warnings.filterwarnings("ignore", "Delete operation did not match", UserWarning)
        kind = RestCatalog if self.catalog == "rest" else SqlCatalog
        with self.translated("opening the lake's catalogue"):
            if self._is_file:
                self.state_dir.mkdir(parents=True, exist_ok=True)
            file = self.state_dir.absolute() / CATALOGUE_FILE
            required = {
                "py-io-impl": f"{RecordingFileIO.__module__}.{RecordingFileIO.__name__}",
                RECORD: os.fspath(file.parent),
                "warehouse": self.warehouse,
                "uri": f"sqlite:///{file}" if self._is_file else self.uri or "",
            }
            catalog = kind("lake", **{**self.properties, **self.secrets, **required})
        with closing(catalog):
            yield catalog

    @contextmanager
    def writable(self) -> Iterator[LakeTables]:
        """Opens the tables, which are made where they are missing.

        Raises:
            LakeError: they cannot be opened.
        """
        with self.opened() as catalog:
            with self.translated("opening the lake's tables"):
                tables = open_tables(catalog, TABLES)
            yield LakeTables(self, tables)

    def last_commit(self) -> Ns | None:
        """Returns when a bag was last committed; None where none was. Makes nothing.

        Raises:
            LakeError: the lake cannot be read.
        """
        if self._is_file and not (self.state_dir / CATALOGUE_FILE).exists():
            return None
        with self.opened() as catalog, self.translated("looking into the lake"):
            name = f"{NAMESPACE}.bags"
            if not catalog.table_exists(name):
                return None
            newest = catalog.load_table(name).current_snapshot()
            return None if newest is None else newest.timestamp_ms * NS_PER_MS


@dataclass(frozen=True, slots=True)
class LakeTables:
    """The tables of an open lake: all of `TABLES`. Each call takes their newest versions.

    A commit is pyiceberg's: it compares and swaps, and what it replaces is one transaction.
    """

    location: LakeLocation
    tables: Mapping[str, IcebergTable]

    @property
    def lake_id(self) -> str:
        """The id of the lake: another one where its tables were created again."""
        return str(self.tables["bags"].metadata.table_uuid)

    def current(self, name: str) -> IcebergTable:
        """Returns a table as it is now.

        Raises:
            LakeError: the lake cannot be read; so do all others.
        """
        with self.location.translated(f"reading the lake's {name}"):
            return self.tables[name].refresh()

    def rows(
        self, name: str, condition: BooleanExpression, columns: tuple[str, ...] = ("*",)
    ) -> pa.Table:
        """Returns the rows of which a condition is true."""
        table = self.current(name)
        with self.location.translated(f"reading the lake's {name}"):
            return table.scan(condition, selected_fields=columns).to_arrow()

    def replace(self, name: str, condition: BooleanExpression, rows: pa.Table) -> None:
        """Replaces rows by others, in one transaction."""
        table = self.current(name)
        with self.location.translated(f"writing the lake's {name}"):
            table.overwrite(rows, overwrite_filter=condition)

    def delete(self, name: str, condition: BooleanExpression) -> None:
        """Deletes rows from the newest version; `expire` deletes those before."""
        table = self.current(name)
        with self.location.translated(f"deleting from the lake's {name}"):
            table.delete(condition)
            # The list of what a version deleted has the bounds of its columns, which are texts of
            # rows; the next version does not refer to it.
            table.append(table.schema().as_arrow().empty_table())


def location_of(warehouse: str, state_dir: Path | None) -> tuple[str, Path]:
    """Returns the URI of a warehouse that may be given as a path, and the state directory.

    Raises:
        ValueError: the warehouse is on no file system, and there is no state directory.
    """
    scheme, colon, rest = warehouse.partition("://")
    if colon and scheme != "file":
        if state_dir is None:
            raise ValueError(f"a warehouse in {scheme} needs lake.state_dir, a local folder")
        return warehouse, state_dir
    folder = Path(rest if colon else warehouse).expanduser().absolute()
    return folder.as_uri(), folder / ".ros2-memory" if state_dir is None else state_dir


@contextmanager
def writing_alone(state_dir: Path) -> Iterator[None]:
    """Holds the lock of a lake.

    Raises:
        LakeError: another process holds it, which the sentence names; or nothing can be locked.
    """
    with _locked(state_dir, os.O_RDWR | os.O_CREAT, fcntl.LOCK_EX) as (descriptor, holder):
        if holder is not None:
            do = "a lake has one writer: stop that process first"
            raise LakeError(f"{holder} writes into this lake; {do}")
        write_holder(descriptor)
        yield


def holder_of(state_dir: Path) -> str | None:
    """Returns who holds the lock of a lake; None where nobody does. Writes nothing.

    Raises:
        LakeError: that cannot be found out.
    """
    try:
        with _locked(state_dir, os.O_RDONLY, fcntl.LOCK_SH) as (_, holder):
            return holder
    except FileNotFoundError:
        return None


@contextmanager
def _locked(state_dir: Path, flags: int, lock: int) -> Iterator[tuple[int, str | None]]:
    """Locks the file, if nobody else has; yields its descriptor, and who has.

    Raises:
        FileNotFoundError: there is none, and it is not to be made.
        LakeError: it cannot be opened or locked.
    """
    path, holder = state_dir / LEASE_FILE, None
    with ExitStack() as opened:
        try:
            if flags & os.O_CREAT:
                state_dir.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(path, flags | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
            opened.callback(os.close, descriptor)
            fcntl.flock(descriptor, lock | fcntl.LOCK_NB)
        except BlockingIOError:
            pid, host = read_holder(descriptor)
            holder = "another process" if pid is None else f"process {pid} on {host}"
        except FileNotFoundError:
            raise
        except OSError as error:
            do = "lake.state_dir must be on a file system that supports locks"
            raise LakeError(f"{path} cannot be opened or locked: {error.strerror}; {do}") from error
        yield descriptor, holder


class WarehouseLease:
    """A lease in the warehouse of a lake, for those who do not share its state directory.

    A store has no locks, so two that take it at the same moment may both have it, until either
    looks at it before its next commit; of two commits at once a table takes only one.

    Args:
        location: the lake.
        clock: the wall clock, which must not differ between machines by as much as the term.
    """

    def __init__(self, location: LakeLocation, clock: Clock) -> None:
        self._location = location
        self._clock = clock
        self._file = f"{location.warehouse}/{NAMESPACE}/writer.json"
        self._store = load_file_io({**location.properties, **location.secrets}, self._file)
        self._id = _id_in(location.state_dir)
        self._until: Ns = 0

    def renew(self) -> None:
        """Takes the lease, or prolongs it where a quarter of its term is over.

        Raises:
            LakeError: another state directory has it, or the warehouse cannot be reached.
        """
        now = self._clock.now()
        if self._until - now <= TERM_NS - _RENEWED_NS:
            self._until = 0
            with self._location.translated("taking the lease of the lake"):
                self._write(now, now + TERM_NS)
                self._require_mine(now)
            self._until = now + TERM_NS

    def confirm(self) -> None:
        """Looks whether the lease is still held, and renews it: before each commit.

        Raises:
            LakeError: as `renew`.
        """
        self._until = 0
        self.renew()

    def close(self) -> None:
        """Ends the lease, if it is held; one that cannot be ended is over with its term."""
        if self._until:
            with suppress(LakeError), self._location.translated("ending the lease of the lake"):
                self._write(self._clock.now(), 0)

    def _require_mine(self, now: Ns) -> None:
        lease: object = None
        file = self._store.new_input(self._file)
        if file.exists():
            with file.open() as stream, suppress(ValueError):
                lease = json.loads(stream.read(_MAX_TEXT))
        if not isinstance(lease, dict) or lease.get("id") == self._id:
            return
        until = lease.get("until")
        if isinstance(until, int) and until > now:
            who = f"process {lease.get('pid')} on {lease.get('host')} writes into this lake"
            why = f"another lake.state_dir, until {iso_local(until)}"
            raise LakeError(f"{who}, with {why}: a lake has one writer, and one state_dir")

    def _write(self, now: Ns, until: Ns) -> None:
        self._require_mine(now)
        lease = {"id": self._id, "pid": os.getpid(), "host": socket.gethostname(), "until": until}
        with closing(self._store.new_output(self._file).create(overwrite=True)) as stream:
            stream.write(json.dumps(lease).encode())


def _id_in(state_dir: Path) -> str:
    """Returns the id of a state directory, which is made with the first call.

    Raises:
        LakeError: it cannot be read or written.
    """
    path = state_dir / _ID_FILE
    try:
        if not path.exists():
            write_durably(path, uuid.uuid4().hex)
        return path.read_text(encoding="utf-8").strip()
    except OSError as error:
        raise LakeError(f"{path} cannot be read or written: {error.strerror}") from error
