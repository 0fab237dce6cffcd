"""The data files of a lake's tables that hold what a question is about."""

from __future__ import annotations

import math
import threading
import time
from contextlib import nullcontext
from typing import TYPE_CHECKING, Final

from pyiceberg.exceptions import NoSuchTableError

from ros2_memory.lake.engines.base import DataFiles
from ros2_memory.lake.partitions import Partitions
from ros2_memory.lake.tables import NAMESPACE, TABLES
from ros2_memory.storage.cache import ByteLru

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from contextlib import AbstractContextManager

    import pyarrow as pa
    from pyiceberg.catalog import Catalog as IcebergCatalog
    from pyiceberg.table import Table as IcebergTable

    from ros2_memory.lake.engines.base import LakeEngine, Parameters
    from ros2_memory.lake.partitions import Days, LakeFile

_MESSAGE_BYTES: Final = 64 << 20


def _as_they_are(_: str) -> AbstractContextManager[None]:
    return nullcontext()


class Lake:
    """The tables of a lake as they are now, and the engine that reads them. Thread-safe.

    Args:
        catalog: of the tables.
        engine: what runs selects.
        namespace: of the tables in the catalogue.
        translated: turns the errors of catalogues and stores into those of this program.

    Attributes:
        messages: packed ones that were read last, of all robots.
    """

    def __init__(
        self,
        catalog: IcebergCatalog,
        engine: LakeEngine,
        namespace: str = NAMESPACE,
        translated: Callable[[str], AbstractContextManager[None]] = _as_they_are,
    ) -> None:
        self.messages: ByteLru[bytes] = ByteLru(_MESSAGE_BYTES)
        self._translated = translated
        self._catalog = catalog
        self._engine = engine
        self._namespace = namespace
        self._lock = threading.Lock()
        self._looked_at = -math.inf
        self._tables: dict[str, IcebergTable] = {}
        self._partitions = {name: Partitions() for name in TABLES}

    def refresh(self, within_s: float = 0.0) -> None:
        """Looks for what was committed since, unless that was done within so many seconds.

        `bags` is committed last, so nothing else changes for those who ask about its rows.

        Raises:
            RefusedError: the lake cannot be read.
        """
        with self._lock, self._translated("looking into the lake"):
            if time.monotonic() - self._looked_at < within_s:
                return
            # Other tables are looked up later, and have the rows of these bags by then.
            self._tables = {}
            self._table("bags")
            self._looked_at = time.monotonic()

    def robots(self) -> list[str]:
        """Returns the names of all robots that have bags, in order; no file of rows is read.

        Raises:
            RefusedError: the lake cannot be read.
        """
        with self._lock, self._translated("looking into the lake"):
            return [*self._days("bags")]

    def days(self, name: str, robot: str) -> Days:
        """Returns the files of a robot in a table, in which no row of another one is.

        Raises:
            RefusedError: the lake cannot be read.
        """
        with self._lock, self._translated("looking into the lake"):
            return self._days(name).get(robot, {})

    def select(
        self, sql: str, name: str, files: Iterable[LakeFile], parameters: Parameters | None = None
    ) -> pa.Table:
        """Returns the rows of a select (see `LakeEngine`) over some files of a table.

        Raises:
            RefusedError: the lake cannot be read.
        """
        with self._lock, self._translated("looking into the lake"):
            table = self._table(name)
        store = {} if table is None else dict(table.io.properties)
        locations = tuple(each.location for each in files)
        found = DataFiles(TABLES[name].arrow_schema, locations, store)
        return self._engine.select(sql, {name: found}, parameters or {})

    def _table(self, name: str) -> IcebergTable | None:
        if name not in self._tables:
            try:
                self._tables[name] = self._catalog.load_table(f"{self._namespace}.{name}")
            except NoSuchTableError:
                return None
        return self._tables[name]

    def _days(self, name: str) -> Mapping[str, Days]:
        table = self._table(name)
        return {} if table is None else self._partitions[name].look(table)
