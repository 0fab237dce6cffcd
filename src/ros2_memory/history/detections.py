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
from ros2_memory.core.arrays import merged_times
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.scan import messages_of, of_columns
from ros2_memory.messages.conversions import nanoseconds
from ros2_memory.messages.detections import Detection, detections_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.columns.units import Rows
    from ros2_memory.columns.zones import PartZones
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.stored_message import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import IntArray, Mask

_LONGEST_LATENCY_NS: Final[Ns] = 10 * NS_PER_S
"""So long a large model may look at an image before it says what is in it."""


class Detected(NamedTuple):
    """Messages of one topic in order of log time, and the detections in them.

    Attributes:
        log_times: of the messages (ns).
        times: in the clock of the transforms, as far as is known: of their stamps where these agree
            with the log times, else those.
        found: by the place of their message; places are rounded to 0.1 mm, as the store has them.
        frames: of the messages, empty where their headers name none.
    """

    log_times: IntArray
    times: IntArray
    found: Detections
    frames: Texts


def joined_detected(parts: Sequence[Detected]) -> Detected:
    """Returns messages of tables of one topic together; `parts` is not empty."""
    if len(parts) == 1:
        return parts[0]
    log_times, order, places = merged_times([part.log_times for part in parts])
    detections = [
        part.found._replace(rows=place[part.found.rows])
        for place, part in zip(places, parts, strict=True)
    ]
    times = np.concatenate([part.times for part in parts])[order]
    frames = joined_texts([part.frames for part in parts]).rows(order)
    return Detected(log_times, times, joined_detections(detections), frames)


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
        return _with_times(rows.times, stamps, detections, frames)

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
        return _with_times(
            np.array([log_time for log_time, *_ in messages], np.int64),
            np.array([stamp for _, stamp, *_ in messages], np.int64),
            detections_by([detections for *_, detections, _ in messages]),
            Texts.of([frame for *_, frame in messages]),
        )


def seen_at(view: View, stored: StoredMessage) -> Ns:
    """Returns when what a message detects was seen, as `Detected.times` has it."""
    stamp = _stamp_of(view.bags.decode(stored))
    if stamp is None:
        return stored.time
    return int(_seen_at(np.array([stored.time]), np.array([stamp]))[0])


def _stamp_of(message: object) -> Ns | None:
    return nanoseconds(getattr(getattr(message, "header", None), "stamp", None))


def _seen_at(log_times: IntArray, stamps: IntArray) -> IntArray:
    # A stamp of another clock cannot be compared with those of transforms.
    latency = log_times - stamps
    is_of_this_clock = (latency >= -AGREEMENT_NS) & (latency <= _LONGEST_LATENCY_NS)
    return np.where(is_of_this_clock, stamps, log_times)


def _with_times(
    log_times: IntArray, stamps: IntArray | None, detections: Detections, frames: Texts
) -> Detected:
    times = log_times if stamps is None else _seen_at(log_times, stamps)
    places = METRES.nearest(detections.places)
    return Detected(log_times, times, detections._replace(places=places), frames)
