"""The detections of a topic as arrays, from its columns, else from its messages."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

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
from ros2_memory.history.scan import messages_of, of_columns
from ros2_memory.messages.conversions import nanoseconds
from ros2_memory.messages.detections import Detection, detections_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.columns.units import Rows
    from ros2_memory.columns.values import Mask
    from ros2_memory.columns.zones import PartZones
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import IntArray


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
    found = [
        part.found._replace(rows=place[part.found.rows])
        for place, part in zip(places, parts, strict=True)
    ]
    times = np.concatenate([part.times for part in parts])[order]
    frames = joined_texts([part.frames for part in parts]).rows(order)
    return Detected(log_times, times, joined_detections(found), frames)


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

    def of(self, rows: Rows) -> Detected:
        """Returns the detections of some rows; messages that cannot be decoded are left out."""
        found = of_columns(self._view, rows, self._held)
        return self._decoded(rows) if found is None else joined_detected(found)

    def _held(self, rows: Rows) -> Detected | None:
        """Returns the detections of some rows; None where their columns leave something open."""
        known = self._columns.of(rows.table)
        if known is None:
            return None
        found, stamps, frames = known
        if rows.index is not None:
            found, frames = found.at(rows.index), frames.rows(rows.index)
            stamps = None if stamps is None else stamps[rows.index]
        return _detected(rows.times, stamps, found, frames)

    def _decoded(self, rows: Rows) -> Detected:
        read = [one for found in messages_of(self._view, rows) for one in self._one(found)]
        # Those of a part come bag after bag, in the order in which bags were stored.
        read.sort(key=lambda one: one[0])
        log_times, stamps = (np.array([one[nth] for one in read], np.int64) for nth in (0, 1))
        frames = Texts.of([one[3] for one in read])
        return _detected(log_times, stamps, detections_by([one[2] for one in read]), frames)

    def _one(self, found: StoredMessage) -> list[tuple[Ns, Ns, list[Detection], str]]:
        """Returns log time, stamp, detections and frame of a message, if it can be decoded."""
        extractor, message = self._view.extractor, self._view.bags.decode(found)
        if message is None:
            return []
        frame = extractor.frame(message)
        stamp = nanoseconds(getattr(getattr(message, "header", None), "stamp", None))
        detections = [
            one if one.frame_id else one._replace(frame_id=frame)
            for one in detections_of(extractor.exact(message, found.type))
        ]
        return [(found.time, found.time if stamp is None else stamp, detections, frame)]


def _detected(
    log_times: IntArray, stamps: IntArray | None, found: Detections, frames: Texts
) -> Detected:
    times = log_times
    if stamps is not None:
        # A stamp of another clock cannot be compared with those of transforms.
        times = np.where(np.abs(stamps - log_times) <= AGREEMENT_NS, stamps, log_times)
    places = np.rint(found.places * METRES.per_unit) / METRES.per_unit
    return Detected(log_times, times, found._replace(places=places), frames)
