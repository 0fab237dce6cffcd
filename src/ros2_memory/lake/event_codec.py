"""Encodes the events of a topic in a bag as the bytes that a lake holds.

JSON, and packed numbers (little-endian); times count from the first message.
"""

from __future__ import annotations

import json
import struct
from functools import lru_cache
from typing import Final

from ros2_memory.analysis.intervals import IntervalTable, moved_rows
from ros2_memory.analysis.state_changes import NO_CHANGES, Change, Held, Report, StateChanges
from ros2_memory.analysis.topic_events import ReportedError, TopicEvents

_EVENTS: Final = struct.Struct("<qqqqqI")


def encode_topic_events(events: TopicEvents | None) -> bytes:
    """Encodes the events of a topic; None, where no message can be decoded, as no bytes."""
    if events is None:
        return b""
    first = events.first
    counts = (first, events.last - first, events.left_out, events.undecodable, events.beyond)
    # Paths, and times relative to the first message, are equal in many bags: _decode_text caches
    # them.
    known = [
        [each.name for each in events.known],
        [each.at - first for each in events.known],
        "".join(str(int(each.first) + 2 * each.last) for each in events.known),
    ]
    changes = events.changes
    rest = json.dumps(
        [
            events.visible.labels,
            known,
            [each[:3] for each in events.toggles],
            events.errors,
            *([] if changes is NO_CHANGES else [_parts(_since(-first, changes))]),
        ],
        ensure_ascii=False,
        separators=(",", ":"),
    )
    rows = moved_rows(events.visible.rows, -first)
    # A lone surrogate is not valid UTF-8, and JSON of a message may contain one.
    text = rest.encode("utf-8", "surrogatepass")
    return _EVENTS.pack(*counts, len(rows)) + rows + text


def decode_topic_events(packed: bytes) -> TopicEvents | None:
    """Decodes the events of a topic; None where no message can be decoded.

    Raises:
        ValueError: the bytes are not valid.
    """
    if not packed:
        return None
    try:
        first, lasted, left_out, undecodable, beyond, size = _EVENTS.unpack_from(packed)
        end = _EVENTS.size + size
        labels, (paths, after, values), flips, faults, relative = _decode_text(packed[end:])
        known = tuple(
            Held(path, first + at, value in "13", value in "23")
            for path, at, value in zip(paths, after, values, strict=True)
        )
        changes = _since(first, relative)
        rows = moved_rows(packed[_EVENTS.size : end], first)
    except (TypeError, struct.error) as error:
        raise ValueError(f"not the events of a topic: {error}") from error
    seen = IntervalTable(labels, rows)
    if not seen.is_sound:
        raise ValueError("not the events of a topic: a label is missing")
    last = first + lasted
    return TopicEvents(
        first, last, seen, known, flips, faults, left_out, undecodable, beyond, changes
    )


def _parts(changes: StateChanges) -> tuple[object, ...]:
    return changes.known, changes.changes, changes.reports, changes.left_out


def _since(since: int, relative: StateChanges) -> StateChanges:
    """Returns changes whose times are later by `since`."""
    if relative is NO_CHANGES:
        return relative
    return StateChanges(
        tuple(each._replace(at=each.at + since) for each in relative.known),
        tuple(each._replace(time=each.time + since) for each in relative.changes),
        tuple(
            each._replace(first=each.first + since, last=each.last + since)
            for each in relative.reports
        ),
        relative.left_out,
    )


@lru_cache(2048)
def _decode_text(
    text: bytes,
) -> tuple[
    tuple[str, ...],
    tuple[list[str], list[int], str],
    tuple[Change, ...],
    tuple[ReportedError, ...],
    StateChanges,
]:
    """Decodes labels, flags, toggles, errors and changes, whose times are relative.

    Cached, since those of many bags are equal.
    """
    labels, (paths, after, values), flips, faults, *changes = json.loads(
        text.decode("utf-8", "surrogatepass")
    )
    return (
        tuple(labels),
        (paths, after, values),
        tuple(Change(*each) for each in flips),
        tuple(ReportedError(*each) for each in faults),
        _decode_changes(*changes[0]) if changes else NO_CHANGES,
    )


def _decode_changes(
    known: list[tuple[str, int, int, int, str]],
    changes: list[tuple[str, int, int, str]],
    reports: list[tuple[str, int, int, int]],
    left_out: int,
) -> StateChanges:
    return StateChanges(
        tuple(Held(*each) for each in known),
        tuple(Change(*each) for each in changes),
        tuple(Report(*each) for each in reports),
        left_out,
    )
