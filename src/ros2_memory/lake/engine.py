"""Reads a lake: DuckDB, inside of this process, over the files that its tables have now.

DuckDB is given the data files that hold what a question is about, and never looks at the lake's
catalogue itself. It loads no extension.
"""

from __future__ import annotations

import math
import threading
import time
from collections import defaultdict
from contextlib import AbstractContextManager, contextmanager, nullcontext
from itertools import chain
from typing import TYPE_CHECKING, Final, TypeAlias

import duckdb
import pyarrow as pa
import pyarrow.dataset as ds
from pyiceberg.exceptions import NoSuchTableError
from pyiceberg.io.pyarrow import PyArrowFileIO

from ros2_memory.core.errors import InvalidArgumentsError, RefusedError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.lake.tables import NAMESPACE, TABLES
from ros2_memory.lake.warehouse import Partitions
from ros2_memory.storage.cache import ByteLru

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from pyiceberg.catalog import Catalog as IcebergCatalog
    from pyiceberg.table import Table as IcebergTable

    from ros2_memory.lake.warehouse import Days, LakeFile

_SETTINGS: Final = {
    "autoinstall_known_extensions": "false",
    "autoload_known_extensions": "false",
    "python_enable_replacements": "false",
}
_LOCAL: Final = (
    " UNION ALL BY NAME"
    " SELECT * FROM read_parquet([{}], union_by_name = true, hive_partitioning = false)"
)
_MESSAGE_BYTES: Final = 16 << 20
_CHANNEL_BYTES: Final = 8 << 20

log = get_logger(__name__)


Parameters: TypeAlias = "Mapping[str, str | int | float | Sequence[str]]"


class Lake:
    """The tables of a lake as they are now, and DuckDB, which reads them. Thread-safe.

    Args:
        catalog: of the tables.
        translated: turns the errors of catalogues and stores into those of this program.
        memory_mb: how much memory DuckDB may use.
        threads: how many threads; None for one for each core.

    Attributes:
        messages: packed ones that were read last, of all robots.
        channels: those of the bags that were read last.
    """

    def __init__(
        self,
        catalog: IcebergCatalog,
        translated: Callable[[str], AbstractContextManager[None]] = lambda _: nullcontext(),
        memory_mb: int = 1024,
        threads: int | None = None,
    ) -> None:
        settings = {**_SETTINGS, "memory_limit": f"{memory_mb}MiB"}
        if threads:
            settings["threads"] = str(threads)
        self._database = duckdb.connect(config={**settings})
        self._catalog, self._translated = catalog, translated
        self.messages = ByteLru[bytes](_MESSAGE_BYTES)
        self.channels = ByteLru[object](_CHANNEL_BYTES)
        self._lock = threading.Lock()
        self._looked_at = -math.inf
        self._tables: dict[str, IcebergTable] = {}
        self._partitions: defaultdict[str, Partitions] = defaultdict(Partitions)

    def close(self) -> None:
        """Closes DuckDB's database, which is in memory."""
        self._database.close()

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
        """Returns the rows of one select `FROM` a table, in no order without `ORDER BY`.

        It is over some files of the table, if any; a column that a file lacks is null there.
        `$name` is the parameter of that name, whose text is never SQL; a list is for `IN $name`.

        Raises:
            RefusedError: a file cannot be read; the log has why.
        """
        # A cursor of its own, which alone knows the table.
        with _reported(), self._database.cursor() as cursor:
            rows = self._rows_of(name, files, cursor)
            bound = {**(parameters or {})}
            return cursor.sql(f"WITH {name} AS ({rows}) {sql}", params=bound).to_arrow_table()

    def query(self, sql: str) -> pa.Table:
        """Returns the rows of a select over the tables as they are now, each by its name.

        Raises:
            InvalidArgumentsError: DuckDB refuses it; the sentence has its reason.
            RefusedError: the lake cannot be read.
        """
        self.refresh()
        with _reported(), self._database.cursor() as cursor:
            try:
                for name in TABLES.keys() & cursor.get_table_names(sql):
                    files = chain.from_iterable(days.values() for days in self.days(name).values())
                    rows = self._rows_of(name, chain.from_iterable(files), cursor)
                    cursor.execute(f"CREATE TEMP VIEW {name} AS {rows}")
                return cursor.sql(sql).to_arrow_table()
            except (duckdb.ProgrammingError, duckdb.DataError) as error:
                tables = f"the tables are {', '.join(TABLES)}"
                raise InvalidArgumentsError(f"{error}; {tables}") from error

    def _rows_of(
        self, name: str, files: Iterable[LakeFile], cursor: duckdb.DuckDBPyConnection
    ) -> str:
        """Returns the select of all rows in some files of a table, for one cursor."""
        with self._looking():
            table = self._loaded_table(name)
        properties = {} if table is None else dict(table.io.properties)
        places = [PyArrowFileIO.parse_location(file.location) for file in files]
        paths = [path for *_, path in places]
        rows: pa.Table | ds.Dataset = TABLES[name].arrow_schema.empty_table()
        local = ""
        if not {scheme for scheme, *_ in places} <= {"file"}:
            store = PyArrowFileIO(properties).fs_by_scheme(*places[0][:2])
            rows = ds.dataset(paths, rows.schema, format="parquet", filesystem=store)
        elif paths:
            # DuckDB reads local files itself, within its limits.
            local = _LOCAL.format(
                ", ".join("'{}'".format(path.replace("'", "''")) for path in paths)
            )
        cursor.register(f"{name}_in_store", rows)
        return f"SELECT * FROM {name}_in_store{local}"  # noqa: S608 - texts of ours

    @contextmanager
    def _looking(self) -> Iterator[None]:
        with self._lock, self._translated("looking into the lake"):
            yield

    def _loaded_table(self, name: str) -> IcebergTable | None:
        if name not in self._tables:
            try:
                self._tables[name] = self._catalog.load_table(f"{NAMESPACE}.{name}")
            except NoSuchTableError:
                return None
        return self._tables[name]


@contextmanager
def _reported() -> Iterator[None]:
    """Logs why files cannot be read; the error leaves it out, as it may have a path or a key."""
    try:
        yield
    except (duckdb.Error, OSError, pa.ArrowException) as error:
        # Its sentence alone: a traceback with variables would show the keys of a store.
        kind = type(error).__name__
        log.warning("lake_engine_failed", reason=f"{kind}: {error}")
        text = f"the lake cannot be read ({kind}); the server's log has the reason"
        raise RefusedError(text) from error
