"""Reads a lake: DuckDB, inside of this process, over the files that its tables have now.

DuckDB is given the data files that hold what a question is about, and never looks at the lake's
catalogue itself. It loads no extension.
"""

from __future__ import annotations

import math
import re
import threading
import time
from collections import defaultdict
from contextlib import AbstractContextManager, contextmanager, nullcontext
from itertools import chain
from typing import TYPE_CHECKING, Final, TypeAlias

import duckdb
import pyarrow as pa
from pyiceberg.exceptions import NoSuchTableError
from pyiceberg.io.pyarrow import PyArrowFileIO

from ros2_memory.core.errors import BusyError, RefusedError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.timebase import Deadline
from ros2_memory.lake.select import SETTINGS, Select, TableFiles
from ros2_memory.lake.tables import NAMESPACE, TABLES
from ros2_memory.lake.warehouse import Partitions
from ros2_memory.storage.cache import ByteLru

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    from pyiceberg.catalog import Catalog as IcebergCatalog
    from pyiceberg.table import Table as IcebergTable

    from ros2_memory.core.model import Selected
    from ros2_memory.core.timebase import Ns
    from ros2_memory.lake.warehouse import Days, LakeFile

_AT_ONCE: Final = 2
"""Statements that are answered at once: each may take `memory_mb`."""
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
        settings = {**SETTINGS, "memory_limit": f"{memory_mb}MiB"}
        if threads:
            settings["threads"] = str(threads)
        self._database = duckdb.connect(config={**settings})
        self._memory_mb, self._threads = memory_mb, threads
        self._turns = threading.BoundedSemaphore(_AT_ONCE)
        self._catalog, self._translated = catalog, translated
        self.messages = ByteLru[bytes](_MESSAGE_BYTES)
        self.channels = ByteLru[object](_CHANNEL_BYTES)
        self._lock = threading.Lock()
        self._looked_at = -math.inf
        self._tables: dict[str, IcebergTable] = {}
        self._types: dict[str, Mapping[str, str]] = {}
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
            rows = self._files_of(name, files).rows(name, cursor)
            bound = {**(parameters or {})}
            return cursor.sql(f"WITH {name} AS ({rows}) {sql}", params=bound).to_arrow_table()

    def query(
        self,
        sql: str,
        robots: Collection[str] | None = None,
        *,
        most_rows: int | None = None,
        most_chars: int | None = None,
        deadline: Deadline | None = None,
    ) -> Selected:
        """Returns the rows of a SELECT, which anybody may have written, over the tables as of now.

        Those of all robots, or of some. `select.Select` has the limits.

        Raises:
            BusyError: its time was over before others were answered.
            InvalidArgumentsError: it is no SELECT over the tables; the sentence has the reason.
            QueryTimeoutError: its time was over.
            RefusedError: the lake cannot be read, or it needs more memory.
        """
        deadline = deadline or Deadline.never()
        self.refresh()
        tables: dict[str, TableFiles] = {}
        for name in TABLES:
            is_named = re.search(rf"\b{name}\b", sql, re.IGNORECASE)
            files = self._files_for(robots, name) if is_named else ()
            tables[name] = self._files_of(name, files, by_arrow=True)
        select = Select(sql, self._memory_mb, self._threads, most_rows, most_chars)
        left_s = max(0.0, min(deadline.left_s(), threading.TIMEOUT_MAX))
        if not self._turns.acquire(timeout=left_s):
            raise BusyError("other statements were not answered in time; ask again, or fewer")
        try:
            return select.run(tables, deadline)
        finally:
            self._turns.release()

    def columns(self) -> Mapping[str, Collection[str]]:
        """Returns the columns of each table."""
        return {name: table.columns.keys() for name, table in TABLES.items()}

    def shipped_until(self, robots: Collection[str] | None = None) -> Mapping[str, Ns]:
        """Returns the log time of the newest message that is there, of each robot, or of some.

        Raises:
            RefusedError: the lake cannot be read.
        """
        sql = "SELECT robot, max(end_ns) AS newest FROM bags GROUP BY robot ORDER BY robot"
        rows = self.select(sql, "bags", self._files_for(robots, "bags")).to_pylist()
        return {row["robot"]: row["newest"] for row in rows}

    def _files_for(self, robots: Collection[str] | None, name: str) -> Iterator[LakeFile]:
        """Yields the files of a table that have rows of some robots; None: of any."""
        for robot, days in self.days(name).items():
            if robots is None or robot in robots:
                yield from chain.from_iterable(days.values())

    def _files_of(
        self, name: str, files: Iterable[LakeFile], *, by_arrow: bool = False
    ) -> TableFiles:
        """Returns some files of a table. DuckDB reads local ones itself, within its limits.

        `by_arrow`: Arrow reads them, so that DuckDB needs to open none.
        """
        places = [PyArrowFileIO.parse_location(file.location) for file in files]
        paths = [path for *_, path in places]
        if {scheme for scheme, *_ in places} <= {"file"}:
            return TableFiles(self._types_of(name), paths, ("file", "", {}) if by_arrow else None)
        with self._looking():
            table = self._loaded_table(name)
        properties = {} if table is None else dict(table.io.properties)
        return TableFiles(self._types_of(name), paths, (*places[0][:2], properties))

    def _types_of(self, name: str) -> Mapping[str, str]:
        """Returns the type that DuckDB has for each column of a table."""
        if name not in self._types:
            with self._database.cursor() as cursor:
                cursor.register("rows", TABLES[name].arrow_schema.empty_table())
                described = cursor.execute("DESCRIBE rows").fetchall()
            self._types[name] = {column: kind for column, kind, *_ in described}
        return self._types[name]

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
