"""The detections of a topic as arrays, from its columns, else from its messages."""

from __future__ import annotations

from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.frames import AGREEMENT_NS
from ros2_memory.columns.detections import (
    DetectionColumns,
    Detections,
    detections_by,
    joined_detections,
)
from ros2_memory.columns.steps import METRES
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
    from ros2_memory.columns.zones import PartZones
    from ros2_memory.history.stored_message import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import IntArray, Mask

_LONGEST_LATENCY_NS: Final = 10 * NS_PER_S
"""So long a large model may look at an image before it says what is in it."""


class Detected(NamedTuple):
    """Messages of one topic in order of log time, and the detections in them.

    Attributes:
        log_times: of the messages (ns).
        stamps: of their headers (ns); the log times where they have none.
        found: by the place of their message; places are rounded to 0.1 mm, as the store has them.
        frames: of the messages, empty where their headers name none.
    """

    log_times: IntArray
    stamps: IntArray
    found: Detections
    frames: Texts

    @property
    def times(self) -> IntArray:
        """In the clock of the transforms (ns), as far as is known.

        Those of their stamps where these agree with the log times, else those.
        """
        latency = self.log_times - self.stamps
        # A stamp of another clock cannot be compared with those of transforms.
        agrees = (latency >= -AGREEMENT_NS) & (latency <= _LONGEST_LATENCY_NS)
        return np.where(agrees, self.stamps, self.log_times)

    def new_since(self, time: Ns) -> Detected:
        """Returns the messages from a log time (ns) on that do not repeat the one before.

        A detector that hangs may publish one message again and again: with the stamp, the frame and
        the detections of the one before it is no new look. A stamp of 0 is none.
        """
        rows, labels, scores, places, frames = self.found
        columns = np.column_stack((labels.codes, frames.codes, scores, places))
        begins = begins_of(rows, len(self.log_times)).tolist()
        said: dict[tuple[Ns, int], bytes] = {}
        is_new = self.log_times >= time
        headers = zip(self.stamps.tolist(), self.frames.codes.tolist(), strict=True)
        for nth, (stamp, frame) in enumerate(headers):
            found = columns[begins[nth] : begins[nth + 1]].tobytes()
            if stamp and said.get((stamp, frame)) == found:
                is_new[nth] = False
            said[stamp, frame] = found
        which = np.flatnonzero(is_new)
        return Detected(
            self.log_times[which],
            self.stamps[which],
            self.found.at(which),
            self.frames.rows(which),
        )


def joined_detected(parts: Sequence[Detected]) -> Detected:
    """Returns messages of tables of one topic together; `parts` is not empty."""
    if len(parts) == 1:
        return parts[0]
    log_times, order, places = merged_times([part.log_times for part in parts])
    detections = [
        part.found._replace(rows=place[part.found.rows])
        for place, part in zip(places, parts, strict=True)
    ]
    stamps = np.concatenate([part.stamps for part in parts])[order]
    frames = joined_texts([part.frames for part in parts]).rows(order)
    return Detected(log_times, stamps, joined_detections(detections), frames)


class DetectionRows:
    """Reads the detections of rows by their columns, else by their messages.

    Args:
        view: has the bags.
    """

    def __init__(self, view: View) -> None:
        self._view = view
        self._columns = DetectionColumns(view.extractor)

    def may_match(self, parts: PartZones) -> bool | Mask:
        """Returns in which parts some message may hold a detection, by their zones."""
        return self._columns.may_match(parts)

    def may_have_any(self, rows: Rows) -> bool:
        """Returns whether a message in the table of some rows may hold a detection."""
        return self._columns.may_have_any(rows.table)

    def have_labels(self, rows: Rows) -> bool:
        """Returns whether the type of some rows has fields for labels, not only texts."""
        return self._columns.has_labels(rows.table)

    def of(self, rows: Rows) -> Detected:
        """Returns the detections of some rows; messages that cannot be decoded are left out."""
        detected = of_columns(self._view, rows, self._by_columns)
        return self._by_messages(rows) if detected is None else joined_detected(detected)

    def _by_columns(self, rows: Rows) -> Detected | None:
        """Returns the detections of some rows; None where their columns leave something open."""
        columns = self._columns.of(rows.table)
        if columns is None:
            return None
        detections, stamps, frames = columns
        if rows.index is not None:
            detections, frames = detections.at(rows.index), frames.rows(rows.index)
            stamps = None if stamps is None else stamps[rows.index]
        stamps = rows.times if stamps is None else stamps
        return _rounded(Detected(rows.times, stamps, detections, frames))

    def _by_messages(self, rows: Rows) -> Detected:
        extractor = self._view.extractor
        messages: list[tuple[Ns, Ns, list[Detection], str]] = []
        for stored in messages_of(self._view, rows):
            message = self._view.bags.decode(stored)
            if message is not None:
                frame, stamp = extractor.frame(message), _stamp_of(message)
                detections = [
                    detection if detection.frame_id else detection._replace(frame_id=frame)
                    for detection in detections_of(extractor.exact(message, stored.type))
                ]
                stamp = stored.time if stamp is None else stamp
                messages.append((stored.time, stamp, detections, frame))
        # Those of a part come bag after bag, in the order in which bags were stored.
        messages.sort(key=itemgetter(0))
        return _rounded(
            Detected(
                np.array([log_time for log_time, *_ in messages], np.int64),
                np.array([stamp for _, stamp, *_ in messages], np.int64),
                detections_by([detections for *_, detections, _ in messages]),
                Texts.of([frame for *_, frame in messages]),
            )
        )


def seen_at(view: View, stored: StoredMessage) -> Ns:
    """Returns when what a message detects was seen: as `Detected.times` has it.

    Where it repeats the stamp of the message before, as that of a detector that hangs, by that
    stamp if the first one that had it agrees with its log time.
    """
    topic, stamp = stored.topic, _stamp(view, stored)
    if -AGREEMENT_NS <= stored.time - stamp <= _LONGEST_LATENCY_NS:
        return stamp
    before = view.stream.last(topic, stored.time)
    if before is not None and _stamp(view, before) == stamp:
        soon = TimeWindow(stamp - AGREEMENT_NS, stamp + _LONGEST_LATENCY_NS + 1)
        if any(_stamp(view, each) == stamp for each in view.stream.messages([topic], soon)):
            return stamp
    return stored.time


def hung_since(view: View, topic: str, window: TimeWindow) -> Ns | None:
    """Returns the stamp (ns) of an old message that a topic's newest ones in a window repeat.

    None where the newest one is not the one before again, is no older than an image that is still
    looked at, or has no stamp.
    """
    newest = view.stream.newest(topic, window)
    stamp = None if newest is None else _stamp_of(view.bags.decode(newest))
    if newest is None or not stamp or newest.time - stamp <= _LONGEST_LATENCY_NS:
        return None
    before = view.stream.newest(topic, TimeWindow(window.start, newest.time))
    repeats = before is not None and before.record.payload == newest.record.payload
    return stamp if repeats else None


def _stamp(view: View, stored: StoredMessage) -> Ns:
    """Returns the stamp of a message, or its log time where it has none."""
    stamp = _stamp_of(view.bags.decode(stored))
    return stored.time if stamp is None else stamp


def _stamp_of(message: object) -> Ns | None:
    return nanoseconds(getattr(getattr(message, "header", None), "stamp", None))


def _rounded(detected: Detected) -> Detected:
    places = METRES.nearest(detected.found.places)
    return detected._replace(found=detected.found._replace(places=places))
