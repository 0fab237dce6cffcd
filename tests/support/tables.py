"""Replies that count `by` something, as dictionaries."""

from typing import Any


def table(reply: Any) -> dict[str, dict[str, Any]]:
    """The rows by their names, and that of "all", each by the names of its columns."""
    rows = {name: values for name, *values in reply["rows"]}
    assert len(rows) == len(reply["rows"])
    rows["all"] = reply["all"]
    return {name: dict(zip(reply["columns"][1:], row, strict=True)) for name, row in rows.items()}
