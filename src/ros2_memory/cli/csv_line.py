"""Rows of CSV, as `cat` and `sql` print them."""

import csv
import json
from collections.abc import Iterable
from io import StringIO

from ros2_memory.core.model import JsonValue
from ros2_memory.tools.reply_size import to_json_text


def csv_line(cells: Iterable[JsonValue]) -> str:
    """Returns a row of CSV, without the line's end: texts as they are, all else as JSON."""
    line = StringIO()
    csv.writer(line, lineterminator="").writerow(map(_csv_cell, cells))
    return line.getvalue()


def _csv_cell(value: JsonValue) -> str | None:
    if isinstance(value, str | None):
        return value
    return to_json_text(value) if isinstance(value, list | dict) else json.dumps(value)
