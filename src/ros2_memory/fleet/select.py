"""The tool that answers one SELECT about many robots, grouped where their rows lie: in a lake.

The other tools ask robot after robot; this one asks the lake once.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import NoDataError, NoDataReason
from ros2_memory.core.reply import with_notes
from ros2_memory.core.text import named, quote
from ros2_memory.fleet.replies import shipped_to
from ros2_memory.fleet.robots import LakeReport
from ros2_memory.results import OfFleet
from ros2_memory.tools.arguments import SelectArguments
from ros2_memory.tools.declaration import ToolDeclaration, ToolName

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.core.model import JsonValue
    from ros2_memory.core.reply import JsonObject
    from ros2_memory.fleet.robots import Fleet
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.lake.engine import Lake
    from ros2_memory.tools.declaration import Tool

QUERY_LAKE: Final = "query_lake"
_ROOM: Final = 0.8
"""The part of a reply that rows may take; the rest is for names and notes."""


def select_tools(fleet: Fleet, max_chars: int) -> Iterator[Tool]:
    """Yields the tool, if the fleet has a lake. `max_chars`: how long a reply may be."""
    if (lake := fleet.tables) is None:
        return
    columns = "; ".join(f"{name}({', '.join(of)})" for name, of in lake.columns().items())
    declared = ToolDeclaration(
        (ToolName(QUERY_LAKE, "SELECT about robots"),),
        "Sums, counts and comparisons of many robots: one SELECT of DuckDB over what was shipped "
        "to the lake. *_ns are log times in ns; m, rad, s. poses are the track, events: stop, "
        f"drop, flip, error, thing. Tables: {columns}. Reply: {{{{fields, rows: [[...]], more}}}}.",
        SelectArguments,
        partial(_answer, fleet, lake, max_chars),
        blocking=True,
        shows_example=True,
    )
    yield from declared.tools({})


def _answer(
    fleet: Fleet,
    lake: Lake,
    max_chars: int,
    memory: Memory,
    call: Call,
    *,
    select: str,
    robot: str | None,
    limit: int,
) -> OfFleet:
    """Returns the rows, with a note on the time up to which each robot's bags were shipped.

    Raises:
        EpisodicError: nothing was shipped, or there is no answer; see `Lake.query`.
    """
    del memory
    fleet.add_shipped()
    names = [chosen.name for chosen in fleet.chosen(robot, call)]
    latest = lake.shipped_until(names)
    if not latest:
        raise NoDataError(NoDataReason.EMPTY_MEMORY, "nothing was shipped to the lake", ())
    found = lake.query(
        select, names, most_rows=limit, most_chars=int(max_chars * _ROOM), deadline=call.deadline
    )
    # Short texts are names, dates and times.
    rows: list[JsonValue] = [
        [named(cell) if isinstance(cell, str) else quote(cell) for cell in row]
        for row in found.rows
    ]
    notes = shipped_to({name: LakeReport(latest.get(name)) for name in names})
    more: JsonObject = {}
    if found.is_cut:
        more = {"more": True}
        do = "group them, select fewer columns, or raise limit (up to 1000)"
        notes.append(f"the first {len(rows)} rows: {do}")
    return OfFleet(with_notes({"fields": [*found.columns], "rows": rows, **more}, notes))
