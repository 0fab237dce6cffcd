"""Opens a lake: its Iceberg catalogue and its files, for one writer.

The catalogue is an SQLite file in the state directory, or a REST service. Its errors become a
`LakeError` whose sentence has no secret.

Each file is recorded in the state directory before it is written: pyiceberg deletes no file, and a
killed process leaves files that no version refers to (see `upkeep`).

A commit of pyiceberg compares and swaps, so two writers would neither lose nor repeat a bag. But
only one of them would know what was forgotten, and the SQLite catalogue of another state directory
would be a second lake in the same files. So a lake belongs to one state directory, which a file in
the warehouse names (`claim`). The state directory has a lock, which the system releases when its
holder dies.
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
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, TypeAlias

from pyiceberg.catalog.rest import RestCatalog
from pyiceberg.catalog.sql import SqlCatalog
from pyiceberg.exceptions import CommitFailedException, ValidationException
from pyiceberg.io import FileIO, load_file_io
from pyiceberg.io.pyarrow import PyArrowFile, PyArrowFileIO
from pyiceberg.manifest import ManifestContent, ManifestFile
from pyiceberg.table import Transaction
from pyiceberg.transforms import IdentityTransform
from pyiceberg.utils.datetime import days_to_date
from sqlalchemy import URL

from ros2_memory.bag_dir.durable_write import write_durably
from ros2_memory.bag_dir.json_files import Int64, JsonLog
from ros2_memory.bag_dir.lock import read_holder, write_holder
from ros2_memory.core.errors import LakeError, RefusedError
from ros2_memory.core.timebase import NS_PER_MS, Ns, WallClock
from ros2_memory.lake.tables import NAMESPACE, TABLES, open_tables

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from datetime import date

    import pyarrow as pa
    from pyiceberg.catalog import Catalog as IcebergCatalog
    from pyiceberg.expressions import BooleanExpression
    from pyiceberg.table import Table as IcebergTable
    from pyiceberg.table.metadata import TableMetadata
    from pyiceberg.table.update import TableUpdate


_LOCK_FILE: Final = "writer.lock"
_OWNER_FILE: Final = "writer.json"
_ID_FILE: Final = "writer.id"
_MAX_TEXT: Final = 1 << 16
CATALOGUE_FILE: Final = "catalogue.sqlite"
WRITTEN_FILE: Final = "written.jsonl"
RECORD: Final = "ros2-memory.written"
"""The setting of a `RecordingFileIO` that names the folder of its record."""
_MOST_CHARS: Final = 500
_ATTEMPTS: Final = 5
"""Attempts at a commit that conflicts with another one; pyiceberg repeats only some itself."""
_MASK: Final = "********"
_LAST: Final = "\U0010ffff"
"""A text after all ids of bags."""


@dataclass(frozen=True, slots=True)
class Written:
    """The URI of a file, and the time (ns) at which it was about to be written."""

    file: str
    at: Int64


WRITTEN: Final = JsonLog(WRITTEN_FILE, Written, most_bytes=sys.maxsize)


class RecordingFileIO(PyArrowFileIO):
    """Records each file durably before it is written."""

    def new_output(self, location: str) -> PyArrowFile:
        """Returns a file to be written."""
        record = self.properties.get(RECORD)
        if record:
            # With a REST catalogue nothing else is there before the first table.
            Path(record).mkdir(parents=True, exist_ok=True)
            WRITTEN.append(Path(record), [Written(location, WallClock().now())])
        return super().new_output(location)


class _Transaction(Transaction):
    """Makes the metadata of its table once after each update.

    pyiceberg makes it each time that it looks, thirty times a commit, and each time it copies all
    versions of the table: half of the time of a commit.
    """

    _made: tuple[TableMetadata, tuple[TableUpdate, ...], TableMetadata] | None = None

    @property
    def table_metadata(self) -> TableMetadata:
        """The metadata with the updates so far; nobody changes it."""
        base, updates = self._table.metadata, self._updates
        if self._made is None or self._made[0] is not base or self._made[1] is not updates:
            self._made = base, updates, super().table_metadata
        return self._made[2]


@dataclass(frozen=True, slots=True)
class LakeLocation:
    """Where a lake is.

    Attributes:
        warehouse: the URI of the folder of its files: `file:///...`, `s3://...`.
        state_dir: the folder of the writer's lock, and of the SQLite catalogue if there is one.
        catalog: the type of the catalogue.
        uri: the URI of a REST catalogue, or of another database; None for the SQLite file.
        properties: settings of the catalogue and of the file store, as pyiceberg names them.
        secrets: more of these settings, which are never shown.
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
            LakeError: the block failed; `what` says what it was doing.
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
        # pyiceberg logs each file that it opens as info, and warns of deletes that match no row, as
        # most deletes before a commit do.
        logging.getLogger("pyiceberg").setLevel(logging.WARNING)
        warnings.filterwarnings("ignore", "Delete operation did not match", UserWarning)
        kind = RestCatalog if self.catalog == "rest" else SqlCatalog
        with self.translated("opening the lake's catalogue"):
            if self._is_file:
                self.state_dir.mkdir(parents=True, exist_ok=True)
            file = self.state_dir.absolute() / CATALOGUE_FILE
            # In a raw path SQLAlchemy decodes `%41`, and `?` ends it.
            sqlite = URL.create("sqlite", database=os.fspath(file))
            required = {
                "py-io-impl": f"{RecordingFileIO.__module__}.{RecordingFileIO.__name__}",
                RECORD: os.fspath(file.parent),
                "warehouse": self.warehouse,
                "uri": str(sqlite) if self._is_file else self.uri or "",
            }
            catalog = kind("lake", **{**self.properties, **self.secrets, **required})
        with closing(catalog):
            yield catalog

    @contextmanager
    def writable(self) -> Iterator[LakeTables]:
        """Opens the tables, and creates missing ones.

        Raises:
            LakeError: they cannot be opened.
        """
        with self.opened() as catalog:
            with self.translated("opening the lake's tables"):
                tables = open_tables(catalog, TABLES)
            yield LakeTables(self, tables)

    def claim(self) -> None:
        """Makes this state directory the owner of the lake, unless it has another one.

        A store has no locks, so of two that claim it at the same moment both may succeed, until one
        fails to claim it again before its next commit. Of two commits at once a table takes one.

        Raises:
            LakeError: another state directory owns the lake; or the lake cannot be reached.
        """
        path, own_id = f"{self.warehouse}/{NAMESPACE}/{_OWNER_FILE}", _id_in(self.state_dir)
        folder, host = os.fspath(self.state_dir.absolute()), socket.gethostname()
        own: dict[str, object] = {"id": own_id, "host": host, "state_dir": folder}
        with self.translated("looking whose the lake is"):
            store = load_file_io({**self.properties, **self.secrets}, path)
            if not _owner_in(store, path):
                with closing(store.new_output(path).create(overwrite=True)) as stream:
                    stream.write(json.dumps(own).encode())
            owner = _owner_in(store, path) or own
        if owner["id"] != own_id:
            whose = f"lake.state_dir={owner.get('state_dir')} on {owner.get('host')}"
            do = "share that folder, which alone knows what was forgotten"
            lost = f"if it is lost for good, delete {path}"
            raise LakeError(f"this lake has another writer, with {whose}: {do}; {lost}")

    def last_change(self) -> Ns | None:
        """Returns when the bags of the lake last changed; None if it has none. Creates no file.

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
            if newest is None or (newest.summary and newest.summary["total-records"] == "0"):
                return None
            return newest.timestamp_ms * NS_PER_MS


@dataclass(frozen=True, slots=True)
class LakeTables:
    """The tables of an open lake: all of `TABLES`. Each call reads their newest versions.

    A commit compares and swaps, in one transaction. If it conflicts with another one, it is made
    again from the newest version.
    """

    location: LakeLocation
    tables: Mapping[str, IcebergTable]

    @property
    def lake_id(self) -> str:
        """The id of the lake: another one where its tables were created again."""
        return str(self.tables["bags"].metadata.table_uuid)

    @contextmanager
    def _newest(self, name: str, doing: str) -> Iterator[IcebergTable]:
        """Yields the newest version of a table, for what the block is doing with it.

        Raises:
            LakeError: the lake cannot be read or written; all other methods raise it, too.
        """
        with self.location.translated(f"{doing} the lake's {name}"):
            yield self.tables[name].refresh()

    def days(self, name: str) -> Mapping[str, Days]:
        """Returns the files of a table by robot; see `Partitions`."""
        with self._newest(name, "looking into") as table:
            return Partitions().read(table)

    def rows(
        self, name: str, condition: BooleanExpression, columns: tuple[str, ...] = ("*",)
    ) -> pa.Table:
        """Returns the rows that meet a condition."""
        with self._newest(name, "reading") as table:
            return table.scan(condition, selected_fields=columns).to_arrow()

    def replace(
        self, name: str, condition: BooleanExpression, rows: pa.Table | None = None
    ) -> None:
        """Replaces the rows that meet a condition, in one transaction.

        Without `rows`, the same rows are written into few files.
        """

        def write(table: IcebergTable) -> None:
            if rows is not None and not rows.num_rows and not [*table.scan(condition).plan_files()]:
                return  # A version with no change would be one more to read, and to delete.
            # Read from the version that is replaced, so that no row is lost.
            whole = table.scan(condition).to_arrow() if rows is None else rows
            with _Transaction(table) as transaction:
                transaction.overwrite(TABLES[name].sort(whole), overwrite_filter=condition)

        self._commit(name, "writing", write)

    def delete(self, name: str, condition: BooleanExpression) -> None:
        """Deletes rows from the newest version; `expire` deletes earlier versions."""

        def write(table: IcebergTable) -> None:
            with _Transaction(table) as transaction:
                transaction.delete(condition)
            # A version lists the files that it deleted, with texts of their rows as bounds. The
            # next version does not have this list.
            if _lists_deleted(table):
                with _Transaction(table) as transaction:
                    transaction.append(table.schema().as_arrow().empty_table())

        self._commit(name, "deleting from", write)

    def _commit(self, name: str, doing: str, write: Callable[[IcebergTable], object]) -> None:
        for attempt in range(_ATTEMPTS):
            with self._newest(name, doing) as table:
                try:
                    write(table)
                except (CommitFailedException, ValidationException):
                    # Nothing was committed. Another program committed; or threads of pyiceberg,
                    # which share the place of a manifest's rows, mixed up two manifests.
                    if attempt == _ATTEMPTS - 1:
                        raise
                else:
                    return


def _lists_deleted(table: IcebergTable) -> bool:
    """Returns whether the newest version of a table may list files that are not in it."""
    newest = table.current_snapshot()
    manifests = [] if newest is None else newest.manifests(table.io)
    return any(manifest.deleted_files_count != 0 for manifest in manifests)


def location_of(warehouse: str, state_dir: Path | None) -> tuple[str, Path]:
    """Returns the URI of a warehouse, which may be given as a path, and the state directory.

    Raises:
        ValueError: the warehouse is in a store, and there is no state directory; or no URI can have
            its path.
    """
    scheme, colon, rest = warehouse.partition("://")
    if colon and scheme != "file":
        if state_dir is None:
            raise ValueError(f"a warehouse in {scheme} needs lake.state_dir, a local folder")
        return warehouse, state_dir
    folder = Path(rest if colon else warehouse).expanduser().absolute()
    if not {"?", "#"}.isdisjoint(str(folder)):
        raise ValueError(f"{folder} has ? or #, which end the path in the URI of a table")
    # Not `as_uri`: pyiceberg and Arrow take the path as it stands, and would make a folder `%20`.
    return f"file://{folder}", folder / ".ros2-memory" if state_dir is None else state_dir


@contextmanager
def writing_alone(state_dir: Path) -> Iterator[None]:
    """Holds the lock of a lake; the file of the lock names this process.

    Raises:
        LakeError: another process holds the lock; or the folder cannot be written, or has no locks.
    """
    path, flags = state_dir / _LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
    with ExitStack() as opened:
        try:
            state_dir.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(path, flags, 0o644)
            opened.callback(os.close, descriptor)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            write_holder(descriptor)
        except BlockingIOError:
            pid, host = read_holder(descriptor)
            holder = "another process" if pid is None else f"process {pid} on {host}"
            do = "a lake has one writer: stop that process first"
            raise LakeError(f"{holder} writes into this lake; {do}") from None
        except OSError as error:
            do = "lake.state_dir must be a folder of this user, on a file system that has locks"
            raise LakeError(f"{path} cannot be opened or locked: {error.strerror}; {do}") from error
        yield


def _owner_in(store: FileIO, path: str) -> dict[str, object]:
    """Returns the content of the owner file; an empty dict if it is missing or damaged."""
    owner: object = None
    file = store.new_input(path)
    if file.exists():
        with file.open() as stream, suppress(ValueError):
            owner = json.loads(stream.read(_MAX_TEXT))
    return owner if isinstance(owner, dict) and isinstance(owner.get("id"), str) else {}


def _id_in(state_dir: Path) -> str:
    """Returns the id of a state directory; the first call creates it.

    Raises:
        LakeError: the id cannot be read or written.
    """
    path = state_dir / _ID_FILE
    try:
        if not path.exists():
            write_durably(path, uuid.uuid4().hex)
        return path.read_text(encoding="utf-8").strip()
    except OSError as error:
        raise LakeError(f"{path} cannot be read or written: {error.strerror}") from error


class LakeFile(NamedTuple):
    """A Parquet file with rows of one robot and day, as lists of files are sorted.

    Attributes:
        location: its URI.
        rows: the number of its rows.
        size: in bytes.
        first: the least id of its bags, or a text before it.
        last: the greatest id of its bags, or a text after it.
    """

    robot: str
    day: date
    location: str
    rows: int
    size: int
    first: str
    last: str


Days: TypeAlias = "Mapping[date, Sequence[LakeFile]]"
"""The files of one robot in one table by day, in order of the days."""


class Partitions:
    """The files of one table by robot and day, as of the version read last. Not thread-safe."""

    def __init__(self) -> None:
        self._snapshot: int | None = None
        self._by_manifest: dict[str, Sequence[LakeFile]] = {}
        self._robots: dict[str, dict[date, list[LakeFile]]] = {}

    def read(self, table: IcebergTable) -> Mapping[str, Days]:
        """Returns the files of a table's current version; known manifests are not read again.

        Raises:
            RefusedError: another program wrote files that are not of one robot and day.
        """
        snapshot = table.current_snapshot()
        snapshot_id = None if snapshot is None else snapshot.snapshot_id
        if snapshot_id == self._snapshot:
            return self._robots
        by_manifest: dict[str, Sequence[LakeFile]] = {}
        for manifest in [] if snapshot is None else snapshot.manifests(table.io):
            path = manifest.manifest_path
            by_manifest[path] = self._by_manifest.get(path) or [*_files_in(manifest, table)]
        robots: dict[str, dict[date, list[LakeFile]]] = {}
        for file in sorted(chain.from_iterable(by_manifest.values())):
            robots.setdefault(file.robot, {}).setdefault(file.day, []).append(file)
        self._by_manifest, self._robots = by_manifest, robots
        self._snapshot = snapshot_id
        return robots


def _files_in(manifest: ManifestFile, table: IcebergTable) -> Iterator[LakeFile]:
    """Yields the data files that a manifest of a table lists.

    Raises:
        RefusedError: another program wrote delete files, or files of several robots or days.
    """
    name = f"the lake's table {table.name()[-1]}"
    entries = manifest.fetch_manifest_entry(table.io, discard_deleted=True)
    if entries and manifest.content is ManifestContent.DELETES:
        do = "rewrite them into its data files first (copy-on-write)"
        raise RefusedError(f"{name} has delete files, which another program wrote: {do}")
    spec, schema = table.specs()[manifest.partition_spec_id], table.schema()
    parts = [
        schema.find_column_name(part.source_id) if part.transform == IdentityTransform() else None
        for part in spec.fields
    ]
    if not {"robot", "day"}.issubset(parts):
        why = "has files that are not of one robot and day, which another program wrote"
        raise RefusedError(f"{name} {why}: partition it by robot and day again")
    robot, day = parts.index("robot"), parts.index("day")
    bag_id = schema.find_field("bag_id").field_id
    for entry in entries:
        data = entry.data_file
        yield LakeFile(
            str(data.partition[robot]),
            days_to_date(data.partition[day]),
            data.file_path,
            data.record_count,
            data.file_size_in_bytes,
            _bound_of(bag_id, data.lower_bounds),
            _bound_of(bag_id, data.upper_bounds) or _LAST,
        )


def _bound_of(field_id: int, bounds: Mapping[int, bytes] | None) -> str:
    """Returns the bound of a column of texts; an empty text if it is not known."""
    return bytes((bounds or {}).get(field_id) or b"").decode()
