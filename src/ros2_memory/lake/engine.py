"""Reads a lake: the files that its tables have now.

Arrow reads the files that hold what a question is about, for itself and for DuckDB, which answers
statements in a process of its own and never looks at the lake's catalogue.
"""

from __future__ import annotations

import math
import re
import threading
import time
from collections import defaultdict
from contextlib import AbstractContextManager, contextmanager, nullcontext
from itertools import chain
from typing import TYPE_CHECKING, Final

import pyarrow as pa
from pyarrow.dataset import ParquetFragmentScanOptions
from pyiceberg.exceptions import NoSuchTableError
from pyiceberg.io.pyarrow import PyArrowFileIO

from ros2_memory.core.errors import BusyError, RefusedError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.timebase import Deadline
from ros2_memory.lake.select import Select, TableFiles
from ros2_memory.lake.tables import NAMESPACE, TABLES
from ros2_memory.lake.warehouse import Partitions
from ros2_memory.storage.cache import ByteLru

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    import pyarrow.compute as pc
    from pyiceberg.catalog import Catalog as IcebergCatalog
    from pyiceberg.table import Table as IcebergTable

    from ros2_memory.core.model import Selected
    from ros2_memory.core.timebase import Ns
    from ros2_memory.lake.warehouse import Days, LakeFile

_AT_ONCE: Final = 2
"""Statements that are answered at once: each may take `memory_mb`."""
_FEW_ROWS: Final = 16
_PAGE_BY_PAGE: Final = ParquetFragmentScanOptions(
    use_buffered_stream=True, buffer_size=4 << 20, pre_buffer=False
)
"""How a column is read of which a group of rows may be larger than memory."""
_MESSAGE_BYTES: Final = 16 << 20
_CHANNEL_BYTES: Final = 8 << 20

log = get_logger(__name__)


class Lake:
    """The tables of a lake as they are now. Thread-safe.

    Args:
        catalog: of the tables.
        translated: turns the errors of catalogues and stores into those of this program.
        memory_mb: how much memory DuckDB may use for a statement.
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
        self._memory_mb, self._threads = memory_mb, threads
        self._turns = threading.BoundedSemaphore(_AT_ONCE)
        self._catalog, self._translated = catalog, translated
        self.messages = ByteLru[bytes](_MESSAGE_BYTES)
        self.channels = ByteLru[object](_CHANNEL_BYTES)
        self._lock = threading.Lock()
        self._looked_at = -math.inf
        self._tables: dict[str, IcebergTable] = {}
        self._partitions: defaultdict[str, Partitions] = defaultdict(Partitions)

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

    def rows(
        self,
        name: str,
        files: Iterable[LakeFile],
        columns: Sequence[str],
        condition: pc.Expression | None = None,
    ) -> pa.Table:
        """Returns the rows of a table in some of its files, if any, in no order.

        A column that a file lacks is null there. `condition`: of which rows; None: of all.

        Raises:
            RefusedError: a file cannot be read; the log has why.
        """
        try:
            rows, wanted = self._files_of(name, files).dataset(), [*columns]
            if "packed" not in columns:
                return rows.to_table(wanted, filter=condition)
            return rows.to_table(
                wanted,
                filter=condition,
                batch_size=_FEW_ROWS,
                batch_readahead=1,
                fragment_readahead=1,
                fragment_scan_options=_PAGE_BY_PAGE,
            )
        except (OSError, pa.ArrowException) as error:
            # The error leaves out its sentence, as it may have a path or a key.
            kind = type(error).__name__
            log.warning("lake_engine_failed", reason=f"{kind}: {error}")
            text = f"the lake cannot be read ({kind}); the server's log has the reason"
            raise RefusedError(text) from error

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
            tables[name] = self._files_of(name, files)
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
        rows = self.rows("bags", self._files_for(robots, "bags"), ("robot", "end_ns"))
        newest = rows.group_by("robot").aggregate([("end_ns", "max")]).sort_by("robot")
        return dict(zip(newest["robot"].to_pylist(), newest["end_ns_max"].to_pylist(), strict=True))

    def _files_for(self, robots: Collection[str] | None, name: str) -> Iterator[LakeFile]:
        """Yields the files of a table that have rows of some robots; None: of any."""
        for robot, days in self.days(name).items():
            if robots is None or robot in robots:
                yield from chain.from_iterable(days.values())

    def _files_of(self, name: str, files: Iterable[LakeFile]) -> TableFiles:
        """Returns some files of a table, and what reads them."""
        places = [PyArrowFileIO.parse_location(file.location) for file in files]
        paths, schema = [path for *_, path in places], TABLES[name].arrow_schema
        if {scheme for scheme, *_ in places} <= {"file"}:
            return TableFiles(schema, paths)
        with self._looking():
            table = self._loaded_table(name)
        properties = {} if table is None else dict(table.io.properties)
        return TableFiles(schema, paths, *places[0][:2], properties)

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
