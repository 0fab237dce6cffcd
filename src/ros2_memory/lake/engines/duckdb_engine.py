"""DuckDB, inside of this process: the default engine. It loads no extension."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import duckdb
import pyarrow as pa
import pyarrow.dataset as ds
from pyiceberg.io.pyarrow import PyArrowFileIO

from ros2_memory.core.errors import RefusedError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.lake.engines.base import LakeEngine

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ros2_memory.lake.engines.base import DataFiles, Parameters

_SETTINGS: Final = {
    "autoinstall_known_extensions": "false",
    "autoload_known_extensions": "false",
    "python_enable_replacements": "false",
}

log = get_logger(__name__)


class DuckdbEngine(LakeEngine):
    """Reads files through Arrow, wherever they are.

    Args:
        memory_mb: how much memory it may use.
        threads: how many threads; None for one for each core.
    """

    def __init__(self, memory_mb: int = 1024, threads: int | None = None) -> None:
        settings: dict[str, str | bool | int | float | list[str]] = {
            **_SETTINGS,
            "memory_limit": f"{memory_mb}MiB",
        }
        if threads:
            settings["threads"] = str(threads)
        self._connection = duckdb.connect(config=settings)

    def select(self, sql: str, tables: Mapping[str, DataFiles], parameters: Parameters) -> pa.Table:
        """Runs the select in a cursor of its own, which alone knows the tables."""
        try:
            with self._connection.cursor() as cursor:
                for name, files in tables.items():
                    cursor.register(name, _rows_of(files))
                return cursor.sql(sql, params=dict(parameters)).to_arrow_table()
        except (duckdb.Error, OSError, pa.ArrowException) as error:
            # Its sentence alone: a traceback with variables would show the keys of a store.
            log.warning("lake_engine_failed", reason=f"{type(error).__name__}: {error}")
            # Who asked is told nothing that may name a path or a key.
            raise RefusedError(
                f"the lake cannot be read ({type(error).__name__}); the server's log has the reason"
            ) from error

    def close(self) -> None:
        """Closes the database, which is in memory."""
        self._connection.close()


def _rows_of(files: DataFiles) -> ds.Dataset | pa.Table:
    if not files.locations:
        return files.schema.empty_table()
    found = [PyArrowFileIO.parse_location(location) for location in files.locations]
    scheme, netloc, _ = found[0]
    store = PyArrowFileIO(dict(files.store)).fs_by_scheme(scheme, netloc)
    paths = [path for *_, path in found]
    return ds.dataset(paths, schema=files.schema, format="parquet", filesystem=store)
