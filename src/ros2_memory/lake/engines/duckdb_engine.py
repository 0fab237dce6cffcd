"""DuckDB, inside of this process: the default engine. It loads no extension."""
# ruff: noqa: S608 - tables are named by constants of the lake, and files as literals

from __future__ import annotations

from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

import duckdb
import pyarrow as pa
import pyarrow.dataset as ds
from pyiceberg.io.pyarrow import PyArrowFileIO

from ros2_memory.lake.engines.base import LakeEngine, expanded, failed, text_literal

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ros2_memory.lake.engines.base import DataFiles, Parameters

_SETTINGS: Final = {
    "autoinstall_known_extensions": "false",
    "autoload_known_extensions": "false",
    "python_enable_replacements": "false",
}


class DuckdbEngine(LakeEngine):
    """Reads local files itself, and those of a store through Arrow.

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
        """Runs the select in a cursor of its own."""
        text, bound = expanded(sql, parameters)
        try:
            with self._connection.cursor() as cursor:
                sources = [
                    f"{name} AS ({_source(cursor, name, files)})" for name, files in tables.items()
                ]
                query = f"WITH {', '.join(sources)} {text}"
                return cursor.sql(query, params=bound).to_arrow_table()
        except (duckdb.Error, OSError, pa.ArrowException) as error:
            raise failed(error) from error

    def close(self) -> None:
        """Closes the database, which is in memory."""
        self._connection.close()


def _source(cursor: duckdb.DuckDBPyConnection, name: str, files: DataFiles) -> str:
    """Returns a select of all rows of a table, with all columns."""
    # Iceberg's locations are no URLs: what looks like an escape is part of the name.
    local = [urlsplit(each) for each in files.locations]
    if any(each.scheme not in {"file", ""} for each in local):
        cursor.register(f"{name}_data", _dataset(files))
        return f"SELECT * FROM {name}_data"
    cursor.register(f"{name}_empty", files.schema.empty_table())
    empty = f"SELECT * FROM {name}_empty"
    if not local:
        return empty
    paths = ", ".join(text_literal(each.path) for each in local)
    read = f"read_parquet([{paths}], union_by_name = true, hive_partitioning = false)"
    return f"{empty} UNION ALL BY NAME SELECT * FROM {read}"


def _dataset(files: DataFiles) -> ds.Dataset:
    first = urlsplit(files.locations[0])
    store = PyArrowFileIO(dict(files.store)).fs_by_scheme(first.scheme, first.netloc)
    paths = [each.netloc + each.path for each in map(urlsplit, files.locations)]
    return ds.dataset(paths, schema=files.schema, format="parquet", filesystem=store)
