"""The port for engines that run SQL over a lake.

The docstrings are the contract; one test suite holds every adapter to it. An engine is given the
data files that hold what a question is about, and never looks at the lake's catalogue itself. It is
safe to use from several threads at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pyarrow as pa

Parameters: TypeAlias = "Mapping[str, str | int | float | Sequence[str]]"


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
    def select(self, sql: str, table: str, files: DataFiles, parameters: Parameters) -> pa.Table:
        """Returns the rows of one select over some files of a table.

        Its subset is what every engine takes: `FROM` the table, with `WHERE`, comparisons and `IN`,
        count, sum, min and max by `GROUP BY`, and `ORDER BY`. A column that a file lacks is null
        there, and the table may have no file at all. `$name` is the parameter of that name, whose
        text is never SQL; a list is for `IN $name`. Integers come back as integers of any width,
        sums of them only where they are cast to BIGINT. Without `ORDER BY` the rows are in no
        order.

        Raises:
            RefusedError: a file cannot be read, or the engine cannot be reached; the log has why.
        """

    def close(self) -> None:  # noqa: B027 - most have nothing to release
        """Releases what the engine holds."""
