"""`ros2-memory sql`: a select over the tables of a lake."""

from typing import TYPE_CHECKING, Annotated, cast

import typer

from ros2_memory.bootstrap_fleet import open_lake
from ros2_memory.cli.csv_line import csv_line
from ros2_memory.cli.options import AsJson, Overrides, load_for
from ros2_memory.cli.output import print_exactly, print_line, print_reply, with_plain_numbers
from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.tools.reply_size import to_json_text

if TYPE_CHECKING:
    from ros2_memory.config import DuckdbNode
    from ros2_memory.core.model import JsonValue


def sql(
    select: Annotated[
        str, typer.Argument(metavar="SELECT", help="Such as 'SELECT count(*) FROM bags'.")
    ],
    overrides: Overrides = None,
    *,
    as_csv: Annotated[bool, "--csv", "Print CSV."] = False,
    as_json: AsJson = False,
) -> None:
    """Answer a SELECT over the tables of a lake, as they are now.

    DuckDB answers it in a process of its own, within lake.engine.memory_mb, and reads the files of
    the tables that it names. docs/reference/lake.md has their columns. Needs lake.warehouse, and
    ros2-memory[lake].
    """
    if as_csv and as_json:
        raise InvalidArgumentsError("give --csv or --json, not both")
    settings = load_for(None, ["deployment=query_only", "lake=duckdb", *(overrides or ())])
    lake = open_lake(settings, cast("DuckdbNode", settings.lake.engine))
    if not lake.days("bags"):
        raise InvalidArgumentsError(f"{settings.lake.warehouse}: there is no lake, or no bag in it")
    table = lake.query(select)
    if as_csv:
        print_exactly([csv_line(table.columns), *map(csv_line, table.rows)])
        return
    if len(set(table.columns)) < len(table.columns):
        raise InvalidArgumentsError("two columns have one name: give one another with AS, or --csv")
    answer: list[JsonValue] = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    if as_json:
        print_line(to_json_text(answer))
    else:
        print_reply(with_plain_numbers(answer))
