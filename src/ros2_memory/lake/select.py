"""Answers one SELECT over the tables of a lake, in a process of its own.

The statement may be anybody's. Inside of a server `repeat('x', 1e9)` would take memory that DuckDB
does not count, and not end when it is interrupted. This process has a limit of its address space,
no disk to spill to, and ends when its time is up. It may open the files that it is given, and no
others; whoever asks may read all of these.

What a statement names is taken from its parse tree: tables of the lake, its own common table
expressions, and functions that make rows of numbers or lists.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from dataclasses import asdict, dataclass
from decimal import Decimal
from itertools import chain
from typing import TYPE_CHECKING, Final, TypeAlias

import duckdb

from ros2_memory.core.errors import (
    EpisodicError,
    InvalidArgumentsError,
    QueryTimeoutError,
    RefusedError,
)
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import Selected
from ros2_memory.core.text import abbreviate

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    import pyarrow as pa
    import pyarrow.dataset as ds

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.timebase import Deadline

SETTINGS: Final = {
    "autoinstall_known_extensions": "false",
    "autoload_known_extensions": "false",
    "python_enable_replacements": "false",
}
"""DuckDB loads no extension, and takes no variable of Python for a table."""
_PROGRAM_MB: Final = 1024
"""Address space that Python, Arrow and the stacks of threads take beside DuckDB's memory."""
_LOOKED_AGAIN_S: Final = 0.1
_BATCH_ROWS: Final = 256
_TABLE_FUNCTIONS: Final = frozenset({"unnest", "range", "generate_series"})
_OTHERS: Final = frozenset({"PIVOT", "COLUMN_DATA", "DELIM_GET", "BOUND_TABLE_REF"})
"""Kinds of nodes that name what else there is."""
_OF_THE_ENGINE: Final = ("current_setting", "pg_")
"""Functions that begin so tell of this process, not of the lake."""

_ERRORS: Final[Mapping[str, type[EpisodicError]]] = {
    error.code: error for error in (InvalidArgumentsError, RefusedError)
}
_LOGGED: Final = "the server's log has the reason"

Node: TypeAlias = "dict[str, JsonValue]"
"""A node of a parse tree."""

log = get_logger(__name__)


@dataclass(frozen=True, slots=True)
class TableFiles:
    """The rows of a table that a statement may read.

    Attributes:
        columns: the type that DuckDB has for each; a file that lacks one has nulls there.
        paths: of the files.
        store: where they are unless on this machine: scheme, host, and settings of the store.
    """

    columns: Mapping[str, str]
    paths: Sequence[str]
    store: tuple[str, str, Mapping[str, str]] | None = None

    def rows(self, name: str, connection: duckdb.DuckDBPyConnection) -> str:
        """Returns the select of these rows, for one connection."""
        typed = (f'CAST(NULL AS {kind}) AS "{column}"' for column, kind in self.columns.items())
        select = f"SELECT {', '.join(typed)} WHERE false"
        if not self.paths:
            return select
        if self.store is None:
            # DuckDB reads local files itself, within its limits.
            quoted = ", ".join("'{}'".format(path.replace("'", "''")) for path in self.paths)
            of_files = f"read_parquet([{quoted}], union_by_name = true, hive_partitioning = false)"
        else:
            of_files = f"{name}_in_store"
            schema = connection.sql(select).to_arrow_table().schema
            connection.register(of_files, _in_store(self.paths, schema, *self.store))
        return f"{select} UNION ALL BY NAME SELECT * FROM {of_files}"  # noqa: S608 - texts of ours


def _in_store(
    paths: Sequence[str], schema: pa.Schema, scheme: str, host: str, properties: Mapping[str, str]
) -> ds.Dataset:
    # A second to import, which a lake on this machine does not need.
    from pyarrow import dataset  # noqa: PLC0415
    from pyiceberg.io.pyarrow import PyArrowFileIO  # noqa: PLC0415

    store = PyArrowFileIO({**properties}).fs_by_scheme(scheme, host)
    return dataset.dataset([*paths], schema, format="parquet", filesystem=store)


@dataclass(frozen=True, slots=True)
class Select:
    """A statement, and within what it is answered.

    Attributes:
        sql: the statement.
        memory_mb: how much memory DuckDB may use.
        threads: how many threads; None for one for each core.
        most_rows: how many rows are returned at most; None for all.
        most_chars: how long the JSON of them all may be.
    """

    sql: str
    memory_mb: int
    threads: int | None = None
    most_rows: int | None = None
    most_chars: int | None = None

    def run(self, tables: Mapping[str, TableFiles], deadline: Deadline) -> Selected:
        """Returns the rows, as a process finds them that ends with the deadline at the latest.

        Raises:
            InvalidArgumentsError: it is no SELECT over these tables; the sentence has the reason.
            QueryTimeoutError: its time was over.
            RefusedError: a file cannot be read, or it needs more memory.
        """
        request = json.dumps({"select": asdict(self), "tables": _as_dicts(tables)})
        command = [sys.executable, "-P", "-m", __name__]
        process = subprocess.Popen(  # noqa: S603 - this program
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        given: str | None = request
        with process:
            try:
                while True:
                    try:
                        text, _ = process.communicate(given, timeout=_LOOKED_AGAIN_S)
                        break
                    except subprocess.TimeoutExpired:
                        given = None
                    if deadline.expired():
                        raise QueryTimeoutError(
                            f"the select needs more than {deadline.budget_s:.3g} s: ask about "
                            "fewer robots, days or columns"
                        )
            finally:
                process.kill()
        if process.returncode:
            log.warning("lake_select_failed", reason=f"exit code {process.returncode}")
            # Code of C that gets no memory is ended by a signal.
            is_killed = process.returncode < 0
            raise RefusedError(_too_much(self.memory_mb) if is_killed else f"it failed; {_LOGGED}")
        answer = json.loads(text)
        if "error" not in answer:
            return Selected(**answer)
        if cause := answer["cause"]:
            log.warning("lake_select_failed", reason=cause)
        raise _ERRORS[answer["error"]](answer["reason"])

    def rows(self, tables: Mapping[str, TableFiles]) -> Selected:
        """Returns the rows, as found in this process; raises as `run`."""
        settings = {**SETTINGS, "memory_limit": f"{self.memory_mb}MiB", "temp_directory": ""}
        if self.threads:
            settings["threads"] = str(self.threads)
        paths = [path for files in tables.values() if not files.store for path in files.paths]
        with duckdb.connect(config={**settings}) as connection:
            try:
                check_select(self.sql, tables, connection)
                for name, files in tables.items():
                    connection.execute(f"CREATE TEMP VIEW {name} AS {files.rows(name, connection)}")
                connection.execute(f"SET allowed_paths = {paths}")
                connection.execute("SET enable_external_access = false")
                connection.execute("SET lock_configuration = true")
                return self._taken(connection.sql(self.sql))
            except (duckdb.Error, MemoryError, OverflowError, TypeError, ValueError) as error:
                raise self._explained(error, tables) from error

    def _explained(self, error: Exception, tables: Mapping[str, TableFiles]) -> EpisodicError:
        """Returns what to say of an error: what was asked is wrong, or it cannot be answered."""
        if isinstance(error, duckdb.OutOfMemoryException | MemoryError):
            return RefusedError(_too_much(self.memory_mb))
        is_engines = isinstance(error, duckdb.Error)
        is_asked = not is_engines or isinstance(error, duckdb.ProgrammingError | duckdb.DataError)
        if not is_asked or any(path in str(error) for of in tables.values() for path in of.paths):
            return RefusedError(f"the lake cannot be read ({type(error).__name__}); {_LOGGED}")
        # What follows is advice on DuckDB.
        reason, *_ = str(error).split("\n\n")
        if not is_engines:
            return InvalidArgumentsError(f"a value has no JSON ({reason}): cast it to VARCHAR")
        return InvalidArgumentsError(f"{reason}; {_there_are(tables)}")

    def _taken(self, found: duckdb.DuckDBPyRelation) -> Selected:
        """Returns the rows that there is room for."""
        reader = found.to_arrow_reader(_BATCH_ROWS)
        rows: list[list[JsonValue]] = []
        chars = 0
        # By position: two columns may have one name.
        for row in chain.from_iterable(map(_rows_in, reader)):
            text = json.dumps(row, default=_as_json)
            chars += len(text) + 1
            is_over = self.most_chars is not None and chars > self.most_chars
            if is_over or len(rows) == self.most_rows:
                return Selected(reader.schema.names, rows, is_cut=True)
            rows.append(json.loads(text))
        return Selected(reader.schema.names, rows)


def _rows_in(batch: pa.RecordBatch) -> Iterator[tuple[object, ...]]:
    columns = (column.to_pylist(maps_as_pydicts="lossy") for column in batch.columns)
    return zip(*columns, strict=True)


def check_select(sql: str, tables: Collection[str], connection: duckdb.DuckDBPyConnection) -> None:
    """Raises unless a text is one SELECT over some tables.

    Raises:
        InvalidArgumentsError: it is something else; the sentence names what.
    """
    parsed = connection.execute("SELECT json_serialize_sql(?)", [sql]).fetchone()
    tree = json.loads(parsed[0]) if parsed else {}
    if tree.get("error"):
        raise InvalidArgumentsError(f"{tree['error_message']}; {_there_are(tables)}")
    if len(tree["statements"]) != 1:
        raise InvalidArgumentsError(f"one SELECT is answered; {_there_are(tables)}")
    nodes = [*_nodes(tree["statements"])]
    own = {str(name).lower() for node in nodes for name in _expressions_of(node)}
    of_engine = connection.execute("SELECT view_name FROM duckdb_views() WHERE internal")
    # Outside of where it is defined, such a name would be that of DuckDB's own view.
    own.difference_update(name for (name,) in of_engine.fetchall())
    if refused := next(filter(None, (_refused(node, {*tables, *own}) for node in nodes)), None):
        raise InvalidArgumentsError(f"{refused}; {_there_are(tables)}")


def _nodes(tree: JsonValue) -> Iterator[Node]:
    pending = [tree]
    while pending:
        node = pending.pop()
        if isinstance(node, dict):
            yield node
            pending += node.values()
        elif isinstance(node, list):
            pending += node


def _expressions_of(node: Node) -> Iterator[JsonValue]:
    """Yields the names of a node's common table expressions."""
    named = node.get("cte_map")
    if isinstance(named, dict) and isinstance(entries := named.get("map"), list):
        yield from (entry["key"] for entry in entries if isinstance(entry, dict))


def _refused(node: Node, names: Collection[str]) -> str | None:
    """Returns what a node names that is no table of the lake, as a clause; None if it may stand."""
    kind, function = node.get("type"), str(node.get("function_name", "")).lower()
    if function.startswith(_OF_THE_ENGINE):
        return f"{function} is not offered"
    if "class" in node:  # an expression
        return None
    if kind == "BASE_TABLE":
        path = [str(node[key]) for key in ("catalog_name", "schema_name") if node.get(key)]
        name = str(node["table_name"])
        is_known = not path and name.lower() in names
        return None if is_known else f"there is no table {abbreviate('.'.join((*path, name)))}"
    if kind == "TABLE_FUNCTION":
        called = node["function"]
        name = str(called["function_name"]).lower() if isinstance(called, dict) else ""
        return None if name in _TABLE_FUNCTIONS else f"{abbreviate(name)} is not offered"
    if kind in _OTHERS or (kind == "SHOW_REF" and node.get("table_name")):
        return f"{kind} is not offered"
    return None


def _there_are(tables: Collection[str]) -> str:
    return f"the tables are {', '.join(tables)}"


def _too_much(memory_mb: int) -> str:
    return (
        f"the select needs more than {memory_mb} MiB (lake.engine.memory_mb): ask about fewer "
        "robots, days or columns"
    )


def _as_dicts(tables: Mapping[str, TableFiles]) -> dict[str, JsonValue]:
    return {name: asdict(files) for name, files in tables.items()}


def _as_json(value: object) -> float | str:
    """Returns a value of SQL that JSON has not: a decimal, bytes in hexadecimal, a time."""
    if isinstance(value, Decimal):
        return float(value)
    return value.hex() if isinstance(value, bytes) else str(value)


def main() -> None:
    """Answers the request on standard input, as JSON on standard output."""
    request = json.load(sys.stdin)
    select = Select(**request["select"])
    tables = {name: TableFiles(**files) for name, files in request["tables"].items()}
    space = (select.memory_mb + _PROGRAM_MB) << 20
    resource.setrlimit(resource.RLIMIT_AS, (space, space))
    try:
        answer = asdict(select.rows(tables))
    except EpisodicError as error:
        # A path is for the log alone.
        cause = str(error.__cause__ or "") if isinstance(error, RefusedError) else ""
        answer = {"error": error.code, "reason": str(error), "cause": cause}
    json.dump(answer, sys.stdout)


if __name__ == "__main__":
    main()
