"""The call that answers each kind of question, and what its reply says: one call a question."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any, Final

from tests.episodes.questions import (
    AFTER,
    AGO,
    BEFORE,
    DID,
    ENDS,
    EXACT,
    LISTED,
    LONG,
    OFTEN,
    USING,
    Question,
    date_of,
    unix,
)
from tests.episodes.world import ACTION, TASK, day_start

_MOST: Final = 100


def call_for(asked: Question) -> tuple[str, dict[str, Any]]:
    """Returns the tool, and its arguments."""
    window: dict[str, Any] = {}
    if asked.day is not None:
        last = asked.day + asked.days - 1
        # A day alone is meant as a whole; of several the last one ends where the next begins.
        end = date_of(last) if asked.days == 1 else f"{date_of(last)}T23:59:59.999"
        window = {"start": date_of(asked.day), "end": end}
    if asked.kind == LISTED:
        return "get_topic_in_range", {"topic": TASK, "changes": True, **window}
    if asked.kind == EXACT and asked.at:
        minute = {"start": asked.at, "end": asked.at}
        return "get_topic_in_range", {"topic": TASK, "changes": True, **minute}
    given: dict[str, Any] = {
        "topic": asked.topic,
        "condition_type": "equals",
        "value": asked.what,
        **window,
    }
    if asked.kind == USING:
        given |= {"topic": ACTION, "condition_type": "contains_word", "with": TASK}
        return "find_matches", given | {"limit": 1 if asked.day is None else _MOST}
    if asked.kind == ENDS or (asked.kind == LONG and asked.day is not None):
        return "find_matches", given | {"by": "value"}
    if asked.kind in {OFTEN, DID} or asked.day is not None:
        # One more: the first may have begun in the evening before.
        return "find_matches", given | {"oldest_first": True, "limit": max(asked.nth + 2, 1)}
    return "find_matches", given | {"limit": 1}


def answer_of(asked: Question, reply: Any) -> Any:
    """Returns what a reply says, in the form of the question's true answer."""
    if "changes" in reply:
        values = [row["value"] for row in reply["changes"]]
        return values if asked.kind == LISTED else set(values)
    if asked.kind in {OFTEN, DID}:
        return reply["total"] if asked.kind == OFTEN else reply["total"] > 0
    if asked.kind == USING:
        return {row["value"] for each in reply["episodes"] for row in each["with"]}
    if "rows" in reply:
        [row] = reply["rows"]
        cells = dict(zip(reply["columns"], row, strict=True))
        return cells["seconds"] if asked.kind == LONG else (cells["first_unix"], cells["last_unix"])
    rows = reply["episodes"]
    if asked.kind == EXACT and asked.day is not None:
        rows = [row for row in rows if row["start"] >= unix(day_start(asked.day))]
    return _of_episode(asked, rows[asked.nth])


def _of_episode(asked: Question, row: Any) -> Any:
    if asked.kind in {AFTER, BEFORE}:
        beside = row.get("next" if asked.kind == AFTER else "previous")
        return None if beside is None else (beside["value"], beside["start"])
    if asked.kind == AGO:
        now = datetime.fromtimestamp(row["end"] + row["ago_s"], UTC)
        return (now.date() - datetime.fromtimestamp(row["start"], UTC).date()).days
    return row["start"] if asked.kind == EXACT else (row["start"], row["seconds"])
