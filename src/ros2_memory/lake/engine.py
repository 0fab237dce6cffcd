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
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Final

import pyarrow as pa
from pyarrow.dataset import ParquetFragmentScanOptions
from pyiceberg.exceptions import NoSuchTableError
from pyiceberg.io.pyarrow import PyArrowFileIO

from ros2_memory.core.errors import BusyError, RefusedError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.timebase import Deadline
from ros2_memory.lake.select import Select, Selected, TableFiles
from ros2_memory.lake.tables import NAMESPACE, TABLES
from ros2_memory.lake.warehouse import Partitions
from ros2_memory.storage.cache import ByteLru

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

    import pyarrow.compute as pc
    from pyiceberg.catalog import Catalog as IcebergCatalog
    from pyiceberg.table import Table as IcebergTable

    from ros2_memory.core.timebase import Ns
    from ros2_memory.lake.warehouse import Days, LakeFile

_AT_ONCE: Final = 2
"""Statements that are answered at once: each may take `memory_mb`."""
_PAGE_BY_PAGE: Final[Mapping[str, object]] = {
    "batch_size": 16,
    "batch_readahead": 1,
    "fragment_readahead": 1,
    "fragment_scan_options": ParquetFragmentScanOptions(
        use_buffered_stream=True, buffer_size=4 << 20, pre_buffer=False
    ),
}
"""How a column is read whose group of rows may be larger than memory."""
_MESSAGE_BYTES: Final = 16 << 20
"""Packed messages that stay in memory."""
_CHANNEL_BYTES: Final = 8 << 20
"""Channels that stay in memory."""

log = get_logger(__name__)


@dataclass(eq=False, repr=False)
class Lake:
    """The tables of a lake as they are now. Thread-safe.

    Args:
        catalog: the catalogue of the tables.
        translated: turns the errors of catalogues and stores into those of this program.
        memory_mb: how much memory DuckDB may use for a statement.

    Attributes:
        messages: the packed messages that were read last, of all robots.
        channels: the channels that were read last, of all robots.
    """

    catalog: IcebergCatalog
    translated: Callable[[str], AbstractContextManager[None]] = lambda _: nullcontext()
    memory_mb: int = 1024

    def __post_init__(self) -> None:
        """Starts with nothing read."""
        self._turns = threading.BoundedSemaphore(_AT_ONCE)
        self.messages = ByteLru[bytes](_MESSAGE_BYTES)
        self.channels = ByteLru[object](_CHANNEL_BYTES)
        self._lock = threading.Lock()
        self._looked_at = -math.inf
        self._tables: dict[str, IcebergTable] = {}
        self._partitions: defaultdict[str, Partitions] = defaultdict(Partitions)

    def refresh(self, within_s: float = 0.0) -> None:
        """Looks for new commits, unless that was done less than `within_s` ago.

        `bags` is committed last, so the other tables have the rows of all bags that it lists.

        Raises:
            RefusedError: the lake cannot be read; all other methods raise it, too.
        """
        with self._looking():
            if time.monotonic() - self._looked_at >= within_s:
                # Other tables are loaded when they are asked for.
                self._tables = {}
                self._loaded_table("bags")
                self._looked_at = time.monotonic()

    def days(self, name: str) -> Mapping[str, Days]:
        """Returns the files of a table by robot and day, without reading them.

        Each file has rows of one robot and day.
        """
        with self._looking():
            table = self._loaded_table(name)
            return {} if table is None else self._partitions[name].read(table)

    def rows(
        self,
        name: str,
        files: Iterable[LakeFile],
        columns: Sequence[str],
        condition: pc.Expression | None = None,
    ) -> pa.Table:
        """Returns the rows of a table in the given files, in no order.

        A column that a file lacks is null there. Without a `condition` all rows are returned.

        Raises:
            RefusedError: a file cannot be read; the log has the reason.
        """
        options = _PAGE_BY_PAGE if "packed" in columns else {}
        try:
            dataset = self._files_of(name, files).dataset()
            return dataset.to_table([*columns], filter=condition, **options)
        except (OSError, pa.ArrowException) as error:
            # Only the log has the whole error: its text may have a path or a key.
            kind = type(error).__name__
            log.warning("lake_engine_failed", reason=f"{kind}: {error}")
            text = f"the lake cannot be read ({kind}); the server's log has the reason"
            raise RefusedError(text) from error

    def query(
        self,
        sql: str,
        robots: Collection[str] | None = None,
        *,
        most_rows: float = math.inf,
        most_chars: float = math.inf,
        deadline: Deadline | None = None,
    ) -> Selected:
        """Returns the rows of a SELECT over the current tables; `sql` need not be trusted.

        It sees the rows of the given robots, or of all. For the limits see `select.Select`.

        Raises:
            BusyError: the time was over before the statements of others were answered.
            InvalidArgumentsError: `sql` is no SELECT over the tables; the sentence has the reason.
            QueryTimeoutError: the time was over.
            RefusedError: the lake cannot be read, or the SELECT needs more memory.
        """
        deadline = deadline or Deadline.never()
        self.refresh()
        tables: dict[str, TableFiles] = {}
        for name in TABLES:
            is_named = re.search(rf"\b{name}\b", sql, re.IGNORECASE)
            files = self._files_for(robots, name) if is_named else ()
            tables[name] = self._files_of(name, files)
        select = Select(sql, self.memory_mb, most_rows, most_chars)
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
        """Returns the log time of the newest message of each robot, or of each given robot.

        Raises:
            RefusedError: the lake cannot be read.
        """
        rows = self.rows("bags", self._files_for(robots, "bags"), ("robot", "end_ns"))
        newest = rows.group_by("robot").aggregate([("end_ns", "max")]).sort_by("robot")
        return dict(zip(newest["robot"].to_pylist(), newest["end_ns_max"].to_pylist(), strict=True))

    def _files_for(self, robots: Collection[str] | None, name: str) -> Iterator[LakeFile]:
        """Yields the files of a table with rows of the given robots, or of all."""
        for robot, days in self.days(name).items():
            if robots is None or robot in robots:
                yield from chain.from_iterable(days.values())

    def _files_of(self, name: str, files: Iterable[LakeFile]) -> TableFiles:
        """Returns files of a table, with their store."""
        locations = [PyArrowFileIO.parse_location(file.location) for file in files]
        scheme, host, _ = next(iter(locations), ("file", "", ""))
        with self._looking():
            table = self._loaded_table(name)
            properties = {} if table is None else {**table.io.properties}
            store = PyArrowFileIO(properties).fs_by_scheme(scheme, host)
        return TableFiles(TABLES[name].arrow_schema, [path for _, _, path in locations], store)

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
