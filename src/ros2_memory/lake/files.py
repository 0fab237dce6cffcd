"""The data files of a lake's tables that hold what a question is about."""

from __future__ import annotations

import threading
from contextlib import nullcontext
from typing import TYPE_CHECKING, Final, cast

from pyiceberg.exceptions import NoSuchTableError
from pyiceberg.expressions import AlwaysTrue, And, GreaterThanOrEqual, In, LessThanOrEqual

from ros2_memory.core.errors import RefusedError
from ros2_memory.lake.engines.base import DataFiles
from ros2_memory.lake.tables import NAMESPACE, TABLES

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable
    from contextlib import AbstractContextManager
    from datetime import date

    import pyarrow as pa
    from pyiceberg.catalog import Catalog as IcebergCatalog
    from pyiceberg.expressions import BooleanExpression
    from pyiceberg.table import Table as IcebergTable

    from ros2_memory.lake.engines.base import LakeEngine, Parameters

# Their constructors are not those that Pydantic's plugin for mypy takes them to have.
_one_of: Final = cast("Callable[[str, object], BooleanExpression]", In)
_at_least: Final = cast("Callable[[str, object], BooleanExpression]", GreaterThanOrEqual)
_at_most: Final = cast("Callable[[str, object], BooleanExpression]", LessThanOrEqual)
_MOST_PLANS: Final = 256
"""Plans that stay in memory."""


def _as_they_are(_: str) -> AbstractContextManager[None]:
    return nullcontext()


class Lake:
    """The tables of a lake as they are now, and the engine that reads them. Thread-safe.

    Args:
        catalog: of the tables.
        engine: what runs selects.
        namespace: of the tables in the catalogue.
        translated: turns the errors of catalogues and stores into those of this program.
    """

    def __init__(
        self,
        catalog: IcebergCatalog,
        engine: LakeEngine,
        namespace: str = NAMESPACE,
        translated: Callable[[str], AbstractContextManager[None]] = _as_they_are,
    ) -> None:
        self._translated = translated
        self._catalog = catalog
        self._engine = engine
        self._namespace = namespace
        self._lock = threading.Lock()
        self._tables: dict[str, IcebergTable] = {}
        self._plans: dict[tuple[object, ...], DataFiles] = {}

    def refresh(self) -> int:
        """Looks for what was committed since, and returns the version of `bags`; 0 without one.

        `bags` is committed last, so nothing else changes for those who ask about its rows.
        """
        with self._lock, self._translated("looking into the lake"):
            self._tables = {}
            table = self._table("bags")
            snapshot = None if table is None else table.current_snapshot()
            return 0 if snapshot is None else snapshot.snapshot_id

    def robots(self) -> list[str]:
        """Returns the names of all robots that have bags, in order; no file of rows is read.

        Raises:
            RefusedError: the lake cannot be read.
        """
        with self._lock, self._translated("looking into the lake"):
            table = self._table("bags")
            tasks = () if table is None else table.scan().plan_files()
            # Partitioned by robot and day.
            return sorted({str(task.file.partition[0]) for task in tasks})

    def select(
        self,
        sql: str,
        tables: Iterable[str],
        parameters: Parameters | None = None,
        *,
        robots: Collection[str] | None = None,
        days: tuple[date, date] | None = None,
    ) -> pa.Table:
        """Returns the rows of a select (see `LakeEngine`) over tables by their names.

        Only files of these robots and days (inclusive) are read, and no row of others is in them:
        every table is partitioned so.

        Raises:
            RefusedError: the lake cannot be read.
        """
        with self._lock, self._translated("looking into the lake"):
            files = {name: self._files(name, robots, days) for name in tables}
        return self._engine.select(sql, files, parameters or {})

    def _table(self, name: str) -> IcebergTable | None:
        if name not in self._tables:
            try:
                self._tables[name] = self._catalog.load_table(f"{self._namespace}.{name}")
            except NoSuchTableError:
                return None
        return self._tables[name]

    def _files(
        self, name: str, robots: Collection[str] | None, days: tuple[date, date] | None
    ) -> DataFiles:
        table = self._table(name)
        snapshot = None if table is None else table.current_snapshot()
        if table is None or snapshot is None:
            return DataFiles(TABLES[name].arrow_schema(), (), {})
        among = None if robots is None else tuple(sorted(robots))
        key = (name, snapshot.snapshot_id, among, days)
        if key not in self._plans:
            if len(self._plans) >= _MOST_PLANS:
                self._plans.clear()
            self._plans[key] = _planned(table, name, _filter(among, days))
        return self._plans[key]


def _filter(robots: Collection[str] | None, days: tuple[date, date] | None) -> BooleanExpression:
    found: BooleanExpression = AlwaysTrue()
    if robots is not None:
        found = And(found, _one_of("robot", robots))
    if days is not None:
        first, last = days
        found = And(
            found,
            _at_least("day", first.isoformat()),
            _at_most("day", last.isoformat()),
        )
    return found


def _planned(table: IcebergTable, name: str, row_filter: BooleanExpression) -> DataFiles:
    tasks = [*table.scan(row_filter=row_filter).plan_files()]
    if any(task.delete_files for task in tasks):
        raise RefusedError(
            f"the lake's table {name} has delete files, which another program wrote: rewrite them "
            "into its data files first (copy-on-write)"
        )
    locations = tuple(task.file.file_path for task in tasks)
    return DataFiles(TABLES[name].arrow_schema(), locations, dict(table.io.properties))
