"""The detections of a topic as arrays, from its columns, else from its messages."""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.frames import AGREEMENT_NS
from ros2_memory.columns.detections import (
    DetectionColumns,
    Detections,
    detections_by,
    joined_detections,
)
from ros2_memory.columns.pack import METRES
from ros2_memory.columns.table import Texts, joined_texts
from ros2_memory.core.arrays import begins_of, merged_times
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.history.scan import messages_of, of_columns
from ros2_memory.messages.conversions import nanoseconds
from ros2_memory.messages.detections import Detection, detections_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.columns.units import Rows
    from ros2_memory.history.bag_access import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import IntArray

LONGEST_LATENCY_NS: Final = 10 * NS_PER_S
"""A large model may look at an image for this long before it says what is in it."""


class Detected(NamedTuple):
    """Messages of one topic in order of log time, and the detections in them.

    Attributes:
        log_times: log time of each message (ns).
        stamps: header stamp of each message (ns), or its log time if it has no stamp or 0.
        found: the detections; `rows` says which message each is from. Places are rounded to 0.1 mm,
            as in the store.
        frames: frame of each message's header; empty if it names none.
    """

    log_times: IntArray
    stamps: IntArray
    found: Detections
    frames: Texts

    @property
    def times(self) -> IntArray:
        """When the detections were seen (ns): the stamps if they agree with the log times.

        Else the log times: a stamp of another clock cannot be compared with those of transforms.
        """
        latency = self.log_times - self.stamps
        agrees = (latency >= -AGREEMENT_NS) & (latency <= LONGEST_LATENCY_NS)
        return np.where(agrees, self.stamps, self.log_times)

    def new_since(self, time: Ns) -> Detected:
        """Returns the messages from a log time (ns) on, without repeated ones.

        A detector that hangs publishes its last message again and again: with equal stamp, frame
        and detections.
        """
        rows, labels, scores, places, frames, _ = self.found
        columns = np.column_stack((labels.codes, frames.codes, scores, places))
        begins = begins_of(rows, len(self.log_times)).tolist()
        last_content: dict[tuple[Ns, int], bytes] = {}
        is_new = self.log_times >= time
        headers = zip(self.stamps.tolist(), self.frames.codes.tolist(), strict=True)
        for message, (stamp, frame) in enumerate(headers):
            content = columns[begins[message] : begins[message + 1]].tobytes()
            if last_content.get((stamp, frame)) == content:
                is_new[message] = False
            last_content[stamp, frame] = content
        new = np.flatnonzero(is_new)
        return Detected(
            self.log_times[new],
            self.stamps[new],
            self.found.at(new),
            self.frames[new],
        )


def joined_detected(parts: Sequence[Detected]) -> Detected:
    """Returns the messages of several tables of one topic, in order; `parts` is not empty."""
    if len(parts) == 1:
        return parts[0]
    log_times, order, places = merged_times([part.log_times for part in parts])
    detections = [
        part.found._replace(rows=place[part.found.rows])
        for place, part in zip(places, parts, strict=True)
    ]
    stamps = np.concatenate([part.stamps for part in parts])[order]
    frames = joined_texts([part.frames for part in parts])[order]
    return Detected(log_times, stamps, joined_detections(detections), frames)


class DetectionRows:
    """Reads the detections of rows from their columns, else from their messages.

    Args:
        view: has the bags.

    Attributes:
        columns: reads the columns of a table.
    """

    def __init__(self, view: View) -> None:
        self._view = view
        self.columns = DetectionColumns(view.extractor)

    def may_have_any(self, rows: Rows) -> bool:
        """Returns whether the table of some rows may have a detection."""
        return self.columns.may_have_any(rows.table)

    def read(self, rows: Rows) -> Detected:
        """Returns the detections of rows, without messages that cannot be decoded."""
        parts = of_columns(self._view, rows, self._read_columns)
        detected = self._read_messages(rows) if parts is None else joined_detected(parts)
        places = METRES.nearest(detected.found.places)
        return detected._replace(found=detected.found._replace(places=places))

    def _read_columns(self, rows: Rows) -> Detected | None:
        """Returns the detections of rows; None if the columns do not have all of them."""
        columns = self.columns.of(rows.table)
        if columns is None:
            return None
        detections, stamps, frames = columns
        if rows.index is not None:
            detections = detections.at(rows.index)
        stamps = rows.times if stamps is None else stamps[rows.positions]
        stamps = np.where(stamps == 0, rows.times, stamps)
        return Detected(rows.times, stamps, detections, frames[rows.positions])

    def _read_messages(self, rows: Rows) -> Detected:
        extractor = self._view.extractor
        times: list[Ns] = []
        stamps: list[Ns] = []
        found: list[Sequence[Detection]] = []
        frames: list[str] = []
        # A part has bag after bag, in the order in which they were stored.
        messages = sorted(messages_of(self._view, rows), key=attrgetter("time"))
        for stored, message in self._view.bags.decoded(messages):
            frame, stamp = extractor.frame(message), stamp_of(message)
            detections = detections_of(extractor.exact(message, stored.type), frame)
            times.append(stored.time)
            stamps.append(stored.time if stamp is None else stamp)
            found.append(detections)
            frames.append(frame)
        columns = np.array(times, np.int64), np.array(stamps, np.int64)
        return Detected(*columns, detections_by(found), Texts.of(frames))


def seen_at(view: View, stored: StoredMessage) -> Ns:
    """Returns when the detections of a message were seen (ns), as `Detected.times` does.

    If it repeats the stamp of the message before it, as a detector that hangs does, the stamp
    counts if it agrees with the log time of the first message that has it.
    """
    topic, stamp = stored.topic, _stamp_or_log_time(view, stored)
    if -AGREEMENT_NS <= stored.time - stamp <= LONGEST_LATENCY_NS:
        return stamp
    before = view.stream.last(topic, stored.time)
    if before is not None and _stamp_or_log_time(view, before) == stamp:
        agreeing = TimeWindow(stamp - AGREEMENT_NS, stamp + LONGEST_LATENCY_NS + 1)
        for message in view.stream.messages([topic], agreeing):
            if _stamp_or_log_time(view, message) == stamp:
                return stamp
    return stored.time


def _stamp_or_log_time(view: View, stored: StoredMessage) -> Ns:
    stamp = stamp_of(view.bags.decode(stored))
    return stored.time if stamp is None else stamp


def stamp_of(message: object) -> Ns | None:
    """Returns the header stamp of a message (ns); None if it has none, or 0: not filled in."""
    return nanoseconds(getattr(getattr(message, "header", None), "stamp", None)) or None
