"""The data files of a lake's tables by robot and day, and selects over them.

A plan of pyiceberg reads all manifests that can have a day, again for each day; over years that
takes most of an answer. Manifests never change, so each is read once.
"""

from __future__ import annotations

import math
import threading
import time
from collections import defaultdict
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from datetime import date, timedelta
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from pyiceberg.exceptions import NoSuchTableError
from pyiceberg.manifest import ManifestContent, ManifestFile
from pyiceberg.transforms import IdentityTransform

from ros2_memory.core.errors import RefusedError
from ros2_memory.lake.engines.base import DataFiles, LakeEngine, Parameters
from ros2_memory.lake.tables import NAMESPACE, TABLES
from ros2_memory.storage.cache import ByteLru

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    import pyarrow as pa
    from pyiceberg.catalog import Catalog as IcebergCatalog
    from pyiceberg.table import Table as IcebergTable


_EPOCH: Final = date(1970, 1, 1)
_LAST: Final = "\U0010ffff"
"""After all ids of bags."""
_MESSAGE_BYTES: Final = 64 << 20


class LakeFile(NamedTuple):
    """A Parquet file, how many rows it has, and its size (bytes).

    No id of a bag in it is before `first`, nor after `last`.
    """

    location: str
    rows: int
    size: int = 0
    first: str = ""
    last: str = _LAST


Days: TypeAlias = "Mapping[date, Sequence[LakeFile]]"
"""The files of one robot in one table by day, in order of the days."""


class Partitions:
    """The files of the versions of one table that it was last shown. Not thread-safe."""

    def __init__(self) -> None:
        self._snapshot: int | None = None
        self._read: dict[str, Sequence[tuple[str, date, LakeFile]]] = {}
        self._robots: dict[str, dict[date, list[LakeFile]]] = {}

    def look(self, table: IcebergTable) -> Mapping[str, Days]:
        """Returns the files of a table's current version, by robot.

        Raises:
            RefusedError: another program wrote what cannot be read by robot and day.
        """
        snapshot = table.current_snapshot()
        if snapshot is None or snapshot.snapshot_id == self._snapshot:
            return self._robots
        read = {}
        for manifest in snapshot.manifests(table.io):
            path = manifest.manifest_path
            read[path] = self._read.get(path) or [*_files(table, manifest)]
        robots: dict[str, dict[date, list[LakeFile]]] = {}
        for robot, day, file in sorted(chain.from_iterable(read.values())):
            robots.setdefault(robot, {}).setdefault(day, []).append(file)
        self._read, self._robots, self._snapshot = read, robots, snapshot.snapshot_id
        return robots


def _files(table: IcebergTable, manifest: ManifestFile) -> Iterator[tuple[str, date, LakeFile]]:
    name = f"the lake's table {table.name()[-1]}"
    entries = manifest.fetch_manifest_entry(table.io, discard_deleted=True)
    if entries and manifest.content is ManifestContent.DELETES:
        do = "rewrite them into its data files first (copy-on-write)"
        raise RefusedError(f"{name} has delete files, which another program wrote: {do}")
    spec, schema = table.specs()[manifest.partition_spec_id], table.schema()
    positions = {
        schema.find_column_name(part.source_id): position
        for position, part in enumerate(spec.fields)
        if isinstance(part.transform, IdentityTransform)
    }
    for column in ("robot", "day"):
        if column not in positions:
            why = f"has files that are not of one {column}, which another program wrote"
            raise RefusedError(f"{name} {why}: partition it by robot and day again")
    bag_id = schema.find_field("bag_id").field_id
    for data in (entry.data_file for entry in entries):
        day = _EPOCH + timedelta(days=data.partition[positions["day"]])
        first, last = (
            bytes((bounds or {}).get(bag_id) or b"").decode()
            for bounds in (data.lower_bounds, data.upper_bounds)
        )
        of_file = data.file_path, data.record_count, data.file_size_in_bytes
        file = LakeFile(*of_file, first, last or _LAST)
        yield str(data.partition[positions["robot"]]), day, file


@dataclass(eq=False, repr=False)
class Lake:
    """The tables of a lake as they are now, and the engine that reads them. Thread-safe.

    Attributes:
        catalog: of the tables.
        engine: what runs selects.
        translated: turns the errors of catalogues and stores into those of this program.
        messages: packed ones that were read last, of all robots.
    """

    catalog: IcebergCatalog
    engine: LakeEngine
    translated: Callable[[str], AbstractContextManager[None]] = lambda _: nullcontext()
    messages: ByteLru[bytes] = field(default_factory=lambda: ByteLru(_MESSAGE_BYTES), init=False)
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False)
    _looked_at: float = field(default=-math.inf, init=False)
    _tables: dict[str, IcebergTable] = field(default_factory=dict, init=False)
    _partitions: defaultdict[str, Partitions] = field(
        default_factory=lambda: defaultdict(Partitions), init=False
    )

    def refresh(self, within_s: float = 0.0) -> None:
        """Looks for what was committed since, unless that was done within so many seconds.

        `bags` is committed last, so nothing else changes for those who ask about its rows.

        Raises:
            RefusedError: the lake cannot be read; so do all others.
        """
        with self._looking():
            if time.monotonic() - self._looked_at >= within_s:
                # Other tables are looked up later, and have the rows of these bags by then.
                self._tables = {}
                self._loaded_table("bags")
                self._looked_at = time.monotonic()

    def days(self, name: str) -> Mapping[str, Days]:
        """Returns the files of a table by robot, in order; no file of rows is read.

        In those of a robot no row of another one is.
        """
        with self._looking():
            table = self._loaded_table(name)
            return {} if table is None else self._partitions[name].look(table)

    def select(
        self, sql: str, name: str, files: Iterable[LakeFile], parameters: Parameters | None = None
    ) -> pa.Table:
        """Returns the rows of a select (see `LakeEngine`) over some files of a table."""
        with self._looking():
            table = self._loaded_table(name)
        store = {} if table is None else dict(table.io.properties)
        locations = tuple(file.location for file in files)
        data_files = DataFiles(TABLES[name].arrow_schema, locations, store)
        return self.engine.select(sql, name, data_files, parameters or {})

    @contextmanager
    def _looking(self) -> Iterator[None]:
        with self._lock, self.translated("looking into the lake"):
            yield

    def _loaded_table(self, name: str) -> IcebergTable | None:
        if name not in self._tables:
            try:
                self._tables[name] = self.catalog.load_table(f"{NAMESPACE}.{name}")
            except NoSuchTableError:
                return None
        return self._tables[name]
