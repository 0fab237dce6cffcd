"""What many messages say of the robot's motion, for less than decoding each of them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.bulk_decode import template_for
from ros2_memory.core.errors import UndecodableError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.analysis.bulk_decode import PayloadTemplate
    from ros2_memory.core.model import Pose
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import BagReader, Record

_FEW: Final = 48
"""So many messages are decoded one by one: looking for their mould costs as much."""
_MOST_MOULDS: Final = 4


class MotionSample(NamedTuple):
    """What one message says: its pose and the speed that it states; None where it has none."""

    pose: Pose | None
    speed_mps: float | None


class MotionDecoder:
    """Looks at messages of one topic; what it learns of their moulds serves the next ones.

    What it gives of a message is what the extractor gives of the decoded one.
    """

    def __init__(self, reader: BagReader, extractor: SchemaExtractor) -> None:
        self._reader = reader
        self._extractor = extractor
        self._moulds: list[tuple[PayloadTemplate, Record]] = []
        self._more_moulds = _MOST_MOULDS

    def of(self, records: Sequence[Record]) -> list[MotionSample | UndecodableError]:
        """What each of the messages says, or why it cannot be decoded."""
        seen: dict[int, MotionSample | UndecodableError] = {}
        for mould, first in self._moulds:
            self._cast(mould, first, records, seen)
        for at, record in enumerate(records):
            if at in seen:
                continue
            seen[at] = self._decoded(record)
            if isinstance(seen[at], MotionSample) and len(records) - len(seen) > _FEW:
                self._learn(record, records, seen)
        return [seen[at] for at in range(len(records))]

    def _decoded(self, record: Record) -> MotionSample | UndecodableError:
        type_name = record.channel.type
        try:
            message = self._reader.decode(record)
        except UndecodableError as error:
            # One that was raised keeps all that was on the way, the message with it.
            return UndecodableError(error.topic, error.type_name, error.reason)
        pose = self._extractor.pose(message, type_name)
        twist = self._extractor.twist(message, type_name)
        return MotionSample(pose, None if twist is None else math.hypot(*twist.linear))

    def _learn(
        self,
        record: Record,
        records: Sequence[Record],
        seen: dict[int, MotionSample | UndecodableError],
    ) -> None:
        """Makes the mould of a message, and casts the others that are of it."""
        if not self._more_moulds:
            return
        self._more_moulds -= 1
        mould = template_for(self._reader, self._extractor, record)
        if mould is not None:
            self._moulds.append((mould, record))
            self._cast(mould, record, records, seen)

    @staticmethod
    def _cast(
        mould: PayloadTemplate,
        first: Record,
        records: Sequence[Record],
        seen: dict[int, MotionSample | UndecodableError],
    ) -> None:
        rest = [at for at in range(len(records)) if at not in seen]
        chosen, rows = mould.matching(first, records, rest)
        if not chosen:
            return
        velocities = mould.velocities(rows)
        for at, pose, velocity in zip(chosen, mould.poses(rows), velocities, strict=True):
            seen[at] = MotionSample(pose, None if velocity is None else math.hypot(*velocity))
