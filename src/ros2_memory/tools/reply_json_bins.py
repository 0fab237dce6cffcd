"""Replies that count over time: a table of bins."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING

from ros2_memory import results
from ros2_memory.core.timebase import NS_PER_S, Ns, unix_from_ns
from ros2_memory.tools.reply_json import moment, render, rounded, with_notes

if TYPE_CHECKING:
    from ros2_memory.core.model import JsonValue
    from ros2_memory.results import BinColumn
    from ros2_memory.tools.reply_size import JsonObject

_MINUTE_S = 60


@render.register(results.Bins)
def _bins(answer: results.Bins) -> JsonObject:
    kinds = [kind for _, kind in answer.columns]
    times = [at for at, kind in enumerate(kinds) if kind == "time"]

    def row(name: str, values: tuple[float | None, ...]) -> list[JsonValue]:
        cells = [_cell(value, kind) for value, kind in zip(values, kinds, strict=True)]
        exact = [values[at] for at in times]
        return [name, *cells, *(None if at is None else moment(int(at)) for at in exact)]

    about: list[JsonValue] = [*answer.about]
    reply: JsonObject = {
        "topic": about[0] if len(about) == 1 else about,
        "columns": [
            answer.by,
            *(name for name, _ in answer.columns),
            *(f"{answer.columns[at][0]}_unix" for at in times),
        ],
        "rows": [row(name, values) for name, values in answer.rows],
        "all": row("all", answer.all)[1:],
        "start": moment(answer.start),
        "end": moment(answer.end),
    }
    for key, usual in (("usual_first", answer.usual), ("usual_exit", answer.usual_exit)):
        if usual is not None:
            reply[key] = {
                "median": _clock(usual.median_s),
                "earliest": _clock(usual.earliest_s),
                "latest": _clock(usual.latest_s),
                "days": usual.days,
                "of_days": usual.of_days,
            }
    return with_notes(reply, answer.notes)


def _cell(value: float | None, kind: BinColumn) -> JsonValue:
    if value is None:
        return None
    match kind:
        case "count":
            return int(value)
        case "duration" | "minutes":
            seconds = unix_from_ns(int(value))
            return round(seconds, 1) if kind == "duration" else round(seconds / _MINUTE_S, 2)
        case "metres":
            return rounded(value, 2)
        case "number":
            return rounded(value, 6)
        case "time":
            return _local(int(value))


def _local(at: Ns) -> str:
    """Returns local time, which arguments take as it is."""
    local = datetime.fromtimestamp(at // NS_PER_S, tz=UTC).astimezone()
    return local.replace(tzinfo=None).isoformat(sep=" ")


def _clock(second: int) -> str:
    """Returns a time of day."""
    hours, rest = divmod(second, _MINUTE_S * _MINUTE_S)
    return f"{hours:02d}:{rest // _MINUTE_S:02d}:{rest % _MINUTE_S:02d}"
