"""The port for engines that run SQL over a lake.

The docstrings are the contract; one test suite holds every adapter to it. An engine is given the
data files that hold what a question is about, and never looks at the lake's catalogue itself. It is
safe to use from several threads at once.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, TypeAlias

from ros2_memory.core.errors import RefusedError
from ros2_memory.core.logging_setup import get_logger

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pyarrow as pa

Value: TypeAlias = "str | int | float"
Parameters: TypeAlias = "Mapping[str, Value | Sequence[str] | Sequence[int]]"

log = get_logger(__name__)

_PARAMETER: Final = re.compile(r"\$([a-z]\w*)")


@dataclass(frozen=True, slots=True)
class DataFiles:
    """Some data files of one table.

    Attributes:
        schema: all columns of the table; a file may be older, and lack some.
        locations: of the Parquet files, as URIs; files that are local have `file`.
        store: the properties by which pyiceberg opens them, where they are not local.
    """

    schema: pa.Schema
    locations: tuple[str, ...]
    store: Mapping[str, str] = field(repr=False)


class LakeEngine(ABC):
    """Runs SQL over data files."""

    @abstractmethod
    def select(self, sql: str, tables: Mapping[str, DataFiles], parameters: Parameters) -> pa.Table:
        """Returns the rows of one select.

        Its subset is what most engines take: no `WITH` and no `UNION`; joins, `IN`,
        `GROUP BY` with count, sum, min and max, `LIMIT`, `ORDER BY`, or `DISTINCT` without it. The
        tables it names are those given; a column that a file lacks is null there, and a table may
        have no file at all. `$name` is the parameter of that name, whose text is never SQL; of a
        list it is all values in parentheses, for `IN $name`. Integers come back as integers of any
        width, sums of them only where they are cast to BIGINT. Without `ORDER BY` the rows are in
        no order.

        Raises:
            RefusedError: a file cannot be read, or the engine cannot be reached; the log has why.
        """

    def close(self) -> None:  # noqa: B027 - most have nothing to release
        """Releases what the engine holds."""


def expanded(sql: str, parameters: Parameters) -> tuple[str, dict[str, Value]]:
    """Returns SQL with each list in parentheses, and the values of all parameters by their names.

    Each value of a list has a name of its own.
    """
    bound: dict[str, Value] = {}

    def parameter(found: re.Match[str]) -> str:
        name = found[1]
        value = parameters[name]
        if isinstance(value, str | int | float):
            bound[name] = value
            return found[0]
        several: Sequence[Value] = value
        each = {f"{name}_{nth}": one for nth, one in enumerate(several)}
        bound.update(each)
        # IN () is no SQL; nothing is equal to NULL.
        return f"({', '.join(f'${one}' for one in each) or 'NULL'})"

    return _PARAMETER.sub(parameter, sql), bound


def text_literal(text: str) -> str:
    """Returns a text as SQL has it."""
    return "'" + text.replace("'", "''") + "'"


def failed(error: Exception) -> RefusedError:
    """Returns the error for who asked, without what may name a path or a key; the log has that."""
    # Its sentence alone: a traceback with variables would show the keys of a store.
    log.warning("lake_engine_failed", reason=f"{type(error).__name__}: {error}")
    return RefusedError(
        f"the lake cannot be read ({type(error).__name__}); the server's log has the reason"
    )
