"""Answers one SELECT over the tables of a lake, in a process of its own.

The statement is not trusted. In a server, `repeat('x', 1e9)` would take memory that DuckDB does not
count, and would not end when it is interrupted. This process has a limit of its address space,
cannot write files, and ends when its time is up. DuckDB may open no file there: Arrow reads the
files of the robots that the client may ask about.

The parse tree of a statement is checked. It may read tables of the lake, its own common table
expressions, and functions that make rows of numbers or lists.
"""

from __future__ import annotations

import json
import math
import os
import pickle
import resource
import signal
import subprocess
import sys
from dataclasses import dataclass
from decimal import Decimal
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import duckdb
from pyarrow import dataset, fs, types

from ros2_memory.core.errors import (
    EpisodicError,
    InvalidArgumentsError,
    QueryTimeoutError,
    RefusedError,
)
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.text import abbreviate, shortened
from ros2_memory.core.timebase import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    import pyarrow as pa

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.timebase import Deadline

_SETTINGS: Final = {
    "autoinstall_known_extensions": "false",
    "autoload_known_extensions": "false",
    "python_enable_replacements": "false",
}
"""DuckDB loads no extension, and takes no variable of Python for a table."""
_PROGRAM_MB: Final = 1024
"""Address space that Python, Arrow and the stacks of threads take beside DuckDB's memory."""
_PROGRAM: Final = f"from {__name__} import main; main()"
ALLOCATORS: Final = {"ARROW_DEFAULT_MEMORY_POOL": "system", "MALLOC_ARENA_MAX": "2"}
"""The default allocators of Arrow and of C reserve 2 GB of addresses for the threads."""
_WITHOUT_MEMORY: Final = (signal.SIGABRT, signal.SIGBUS, signal.SIGKILL, signal.SIGSEGV)
"""Signals that end C code which gets no memory, or come from a system that has none left."""
_LONGEST_S: Final = 86_400.0
"""How long a statement without a time limit may take."""
_BATCH_ROWS: Final = 256
_VIEWS_OF_ENGINE: Final = (
    "SELECT view_name FROM duckdb_views() WHERE internal AND schema_name <> 'information_schema'"
)
"""Lists DuckDB's own views that a name without a schema finds."""
_MOST_REASON_CHARS: Final = 500
_TABLE_FUNCTIONS: Final = frozenset({"unnest", "range", "generate_series"})
_OF_THE_ENGINE: Final = (
    *("current_setting", "getvariable", "pg_", "duckdb_", "has_", "in_search_path"),
    *("json_serialize", "json_deserialize", "json_execute", "nextval", "currval", "setval"),
    *("sleep_ms", "write_log", "txid_", "current_query", "current_transaction", "current_conn"),
)
"""Beginnings of the names of functions that are about this process, not about the lake."""
_NODES: Final = frozenset(
    {
        *("SELECT_NODE", "SET_OPERATION_NODE", "RECURSIVE_CTE_NODE", "CTE_NODE", "SHOW_REF"),
        *("BASE_TABLE", "TABLE_FUNCTION", "SUBQUERY", "JOIN", "EXPRESSION_LIST", "EMPTY"),
        *("ORDER_MODIFIER", "LIMIT_MODIFIER", "LIMIT_PERCENT_MODIFIER", "DISTINCT_MODIFIER"),
        *("ORDER_DEFAULT", "ASCENDING", "DESCENDING"),
    }
)
"""Types of nodes, besides expressions, in a SELECT; others write, or read something else."""

_ERRORS: Final[Mapping[str, type[EpisodicError]]] = {
    error.code: error for error in (InvalidArgumentsError, RefusedError)
}
_LOGGED: Final = "the server's log has the reason"

_OF_TEXT: Final = (duckdb.ParserException, duckdb.BinderException, duckdb.CatalogException)
"""Errors about the text of a statement; others may be about a value."""
_OF_VALUES: Final = (OverflowError, RecursionError, TypeError, ValueError)
"""Errors about values that Python or JSON does not have."""

Node: TypeAlias = "dict[str, JsonValue]"
"""A node of a parse tree."""

log = get_logger(__name__)


class Selected(NamedTuple):
    """The rows that a SELECT selected.

    Attributes:
        columns: the names of the columns.
        rows: the values of each row as JSON; times and lengths of time are texts.
        is_cut: whether there are more rows.
    """

    columns: list[str]
    rows: list[list[JsonValue]]
    is_cut: bool = False


class TableFiles(NamedTuple):
    """The Parquet files of a table whose rows a statement sees.

    Attributes:
        schema: the columns of the table; a column that a file lacks is null in its rows.
        paths: the paths of the files in their store.
        store: where the files are.
    """

    schema: pa.Schema
    paths: Sequence[str]
    store: fs.FileSystem

    def dataset(self) -> dataset.Dataset:
        """Returns the rows as a dataset, which reads the files when rows are taken."""
        return dataset.dataset([*self.paths], self.schema, format="parquet", filesystem=self.store)


@dataclass(frozen=True, slots=True)
class Select:
    """A statement and its limits.

    Attributes:
        sql: the statement.
        memory_mb: how much memory DuckDB may use.
        most_rows: how many rows are returned at most.
        most_chars: how long the JSON of all rows may be.
    """

    sql: str
    memory_mb: int
    most_rows: float = math.inf
    most_chars: float = math.inf

    def run(self, tables: Mapping[str, TableFiles], deadline: Deadline) -> Selected:
        """Returns the rows, computed by a process that ends with the deadline at the latest.

        Raises:
            InvalidArgumentsError: it is no SELECT over these tables; the sentence has the reason.
            QueryTimeoutError: the time was over.
            RefusedError: a file cannot be read, or the statement needs more memory.
        """
        left_s = min(deadline.left_s(), _LONGEST_S)
        try:
            process = subprocess.run(  # noqa: S603 - this program
                [sys.executable, "-P", "-c", _PROGRAM],
                input=pickle.dumps((self, tables, left_s)),
                stdout=subprocess.PIPE,
                env={**os.environ, **ALLOCATORS},
                timeout=left_s,
                check=False,
            )
        except subprocess.TimeoutExpired:
            do = "ask about fewer robots, days or columns"
            reason = f"the select needs more than {deadline.budget_s:.3g} s: {do}"
            raise QueryTimeoutError(reason) from None
        if process.returncode:
            log.warning("lake_select_failed", reason=f"exit code {process.returncode}")
            lacks_memory = -process.returncode in _WITHOUT_MEMORY
            reason = _memory_sentence(self.memory_mb) if lacks_memory else f"it failed; {_LOGGED}"
            raise RefusedError(reason)
        answer = json.loads(process.stdout)
        if "error" not in answer:
            return Selected(**answer)
        if cause := answer["cause"]:
            log.warning("lake_select_failed", reason=cause)
        raise _ERRORS[answer["error"]](answer["reason"])

    def rows(self, tables: Mapping[str, TableFiles]) -> Selected:
        """Returns the rows, computed in this process.

        Raises:
            EpisodicError: see `run`.
        """
        settings = {**_SETTINGS, "memory_limit": f"{self.memory_mb}MiB", "temp_directory": ""}
        with duckdb.connect(config={**settings}) as connection:
            try:
                check_select(self.sql, tables, connection)
                for name, files in tables.items():
                    connection.register(name, files.dataset())
                connection.execute("SET enable_external_access = false")
                connection.execute("SET lock_configuration = true")
                return self._read_rows(connection.sql(self.sql))
            except (duckdb.Error, OSError, *_OF_VALUES, MemoryError) as error:
                raise self._error_for(error, tables) from error

    def _error_for(self, error: Exception, tables: Mapping[str, TableFiles]) -> EpisodicError:
        """Returns this program's error for one of DuckDB, Arrow or Python, without file names."""
        if isinstance(error, duckdb.OutOfMemoryException | MemoryError):
            return RefusedError(_memory_sentence(self.memory_mb))
        paths = (path for files in tables.values() for path in files.paths)
        is_of_sql = isinstance(error, (duckdb.ProgrammingError, duckdb.DataError, *_OF_VALUES))
        if not is_of_sql or any(path in str(error) for path in paths):
            return RefusedError(f"the lake cannot be read ({type(error).__name__}); {_LOGGED}")
        if isinstance(error, _OF_TEXT):
            # Further paragraphs are advice on DuckDB.
            reason, *_ = str(error).split("\n\n")
            return InvalidArgumentsError(f"{_short(reason)}; {_tables_clause(tables)}")
        # The sentence may repeat a recorded text.
        do = "cast it to VARCHAR, use TRY_CAST, or leave its row out"
        return InvalidArgumentsError(f"a value cannot be converted ({type(error).__name__}): {do}")

    def _read_rows(self, relation: duckdb.DuckDBPyRelation) -> Selected:
        """Returns the first rows, within the limits.

        Raises:
            InvalidArgumentsError: not even the names of the columns are.
        """
        reader = relation.to_arrow_reader(_BATCH_ROWS)
        rows: list[list[JsonValue]] = []
        chars = sum(map(len, reader.schema.names))
        if chars > self.most_chars:
            raise InvalidArgumentsError("the names of the columns are longer than a reply may be")
        # By position: two columns may have one name.
        for row in chain.from_iterable(map(_rows_in, reader)):
            text = json.dumps(row, default=_as_json)
            chars += len(text) + 1
            if chars > self.most_chars or len(rows) == self.most_rows:
                return Selected(reader.schema.names, rows, is_cut=True)
            rows.append(json.loads(text))
        return Selected(reader.schema.names, rows)


def _rows_in(batch: pa.RecordBatch) -> Iterator[tuple[object, ...]]:
    columns: list[Iterable[object]] = []
    for column in batch.columns:
        values = column.to_pylist(maps_as_pydicts="lossy")
        columns.append(map(_duration, values) if types.is_interval(column.type) else values)
    return zip(*columns, strict=True)


def _duration(value: pa.MonthDayNano | None) -> str | None:
    """Returns the length of an interval as ISO 8601 has it, such as `P0M1DT2.5S`."""
    if value is None:
        return None
    return f"P{value.months}M{value.days}DT{value.nanoseconds / NS_PER_S:.10g}S"


def check_select(sql: str, tables: Collection[str], connection: duckdb.DuckDBPyConnection) -> None:
    """Checks that a text is one SELECT over the tables.

    Raises:
        InvalidArgumentsError: the text is something else; the sentence says what.
    """
    parsed = connection.execute("SELECT json_serialize_sql(?)", [sql]).fetchone()
    tree = json.loads(parsed[0]) if parsed else {}
    if tree.get("error") and tree["error_type"] != "not implemented":
        raise InvalidArgumentsError(f"{_short(tree['error_message'])}; {_tables_clause(tables)}")
    # DuckDB has no tree of other statements.
    if len(tree.get("statements", ())) != 1:
        raise InvalidArgumentsError(f"one SELECT is answered; {_tables_clause(tables)}")
    nodes = [*_nodes(tree["statements"])]
    names = {str(name).lower() for node in nodes for name in _expressions_of(node)}
    # Outside of its scope, the name of a common table expression may be that of DuckDB's own view.
    names.difference_update(name for (name,) in connection.execute(_VIEWS_OF_ENGINE).fetchall())
    names.update(tables)
    for node in nodes:
        if refusal := _refusal_of(node, names):
            raise InvalidArgumentsError(f"{refusal}; {_tables_clause(tables)}")


def _nodes(tree: JsonValue) -> Iterator[Node]:
    """Yields all objects of a parse tree."""
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


def _refusal_of(node: Node, names: Collection[str]) -> str | None:
    """Returns why a node is refused, as a clause; None if it may be executed."""
    kind, function = node.get("type"), str(node.get("function_name", "")).lower()
    if function.startswith(_OF_THE_ENGINE):
        return f"{abbreviate(function)} is not offered"
    # An expression has a class, a literal the type of its value.
    if "class" in node or not isinstance(kind, str) or kind.endswith("_TYPE_INFO"):
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
    lists_tables = kind == "SHOW_REF" and not node.get("query")
    return f"{kind} is not offered" if lists_tables or kind not in _NODES else None


def _tables_clause(tables: Collection[str]) -> str:
    return f"the tables are {', '.join(tables)}"


def _memory_sentence(memory_mb: int) -> str:
    return (
        f"the select needs more than {memory_mb} MiB (lake.engine.memory_mb): ask about fewer "
        "robots, days or columns"
    )


def _short(reason: str) -> str:
    return shortened(reason, _MOST_REASON_CHARS)


def _as_json(value: object) -> float | str:
    """Returns a value of SQL as JSON has it: decimals, bytes in hexadecimal, times as text."""
    if isinstance(value, Decimal):
        # The sum of integers is a decimal, which a float would round.
        return int(value) if value == value.to_integral_value() else float(value)
    return value.hex() if isinstance(value, bytes) else str(value)


def main() -> None:
    """Answers the request on standard input, as JSON on standard output."""
    select, tables, left_s = pickle.load(sys.stdin.buffer)  # noqa: S301 - of `Select.run`
    space = (select.memory_mb + _PROGRAM_MB) << 20
    for limit, most in (
        (resource.RLIMIT_AS, space),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
    ):
        resource.setrlimit(limit, (most, most))
    # If the parent is killed, nobody else ends this process.
    signal.setitimer(signal.ITIMER_REAL, max(left_s, 0.0) + 1.0)
    try:
        answer = select.rows(tables)._asdict()
    except EpisodicError as error:
        # The cause may name a path: it is only for the log.
        cause = _short(str(error.__cause__ or "")) if isinstance(error, RefusedError) else ""
        answer = {"error": error.code, "reason": str(error), "cause": cause}
    json.dump(answer, sys.stdout)
