"""DuckDB, inside of this process, runs SQL over data files of a lake. It loads no extension.

It is given the data files that hold what a question is about, and never looks at the lake's
catalogue itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import duckdb
import pyarrow as pa
import pyarrow.dataset as ds
from pyiceberg.io.pyarrow import PyArrowFileIO

from ros2_memory.core.errors import RefusedError
from ros2_memory.core.logging_setup import get_logger

if TYPE_CHECKING:
    from ros2_memory.lake.warehouse import DataFiles, Parameters

_SETTINGS: Final = {
    "autoinstall_known_extensions": "false",
    "autoload_known_extensions": "false",
    "python_enable_replacements": "false",
}
_LOCAL: Final = (
    " UNION ALL BY NAME"
    " SELECT * FROM read_parquet($local, union_by_name = true, hive_partitioning = false)"
)

log = get_logger(__name__)


class DuckdbEngine:
    """Reads local files itself, within its limits, and those of a store through Arrow.

    Safe to use from several threads at once.

    Args:
        memory_mb: how much memory it may use.
        threads: how many threads; None for one for each core.
    """

    def __init__(self, memory_mb: int = 1024, threads: int | None = None) -> None:
        settings = {**_SETTINGS, "memory_limit": f"{memory_mb}MiB"}
        if threads:
            settings["threads"] = str(threads)
        self._connection = duckdb.connect(config={**settings})

    def select(self, sql: str, table: str, files: DataFiles, parameters: Parameters) -> pa.Table:
        """Returns the rows of one select `FROM` the table, in no order without `ORDER BY`.

        A column that a file lacks is null there, and the table may have no file at all. `$name` is
        the parameter of that name, whose text is never SQL; a list is for `IN $name`.

        Raises:
            RefusedError: a file cannot be read; the log has why.
        """
        bound: dict[str, object] = {**parameters}
        try:
            # A cursor of its own, which alone knows the table.
            with self._connection.cursor() as cursor:
                rows, local = _opened(files)
                cursor.register("in_store", rows)
                source = "SELECT * FROM in_store"
                if local:
                    source += _LOCAL
                    bound["local"] = local
                query = f"WITH {table} AS ({source}) {sql}"
                return cursor.sql(query, params=bound).to_arrow_table()
        except (duckdb.Error, OSError, pa.ArrowException) as error:
            # Its sentence alone: a traceback with variables would show the keys of a store.
            kind = type(error).__name__
            log.warning("lake_engine_failed", reason=f"{kind}: {error}")
            # The error may name a path or a key: the client does not see it.
            text = f"the lake cannot be read ({kind}); the server's log has the reason"
            raise RefusedError(text) from error

    def close(self) -> None:
        """Closes the database, which is in memory."""
        self._connection.close()


def _opened(files: DataFiles) -> tuple[pa.Table | ds.Dataset, list[str]]:
    """Returns the rows of files that are in a store, and the paths of those that are not.

    All columns of the table are in the former, also where no file is in a store.
    """
    places = [PyArrowFileIO.parse_location(location) for location in files.locations]
    paths = [path for *_, path in places]
    if {scheme for scheme, *_ in places} <= {"file"}:
        return files.schema.empty_table(), paths
    store = PyArrowFileIO(dict(files.store)).fs_by_scheme(*places[0][:2])
    return ds.dataset(paths, schema=files.schema, format="parquet", filesystem=store), []
