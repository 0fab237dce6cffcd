"""Adds up what is missing in closed splits, across splits and overlapping recordings.

A hole counts once the next split has been measured: until then the other recording of a handover
may turn out to have its messages.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.lost_file import Loss
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.recorder.reception.continuity import Hole, Kind, Position, holes

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

HOUR_NS: Final[Ns] = 3600 * NS_PER_S
_RECORDINGS: Final = 3
"""How many recordings are compared: two of a handover, and one more."""


@dataclass(frozen=True, slots=True)
class Progress:
    """The messages of a topic in one split, at least one, by log time, and what shows holes."""

    kind: Kind
    positions: Sequence[Position]


@dataclass(slots=True)
class _Pending:
    recording: str
    topic: str
    kind: Kind
    hole: Hole


class LossCounter:
    """What is missing in the splits of one bag directory, measured one after the other."""

    def __init__(self) -> None:
        # By recording and topic, the newest split's values, ascending.
        self._newest: dict[str, dict[str, list[int]]] = {}
        self._last: dict[tuple[str, str], Position] = {}
        self._pending: list[_Pending] = []
        self._lately: deque[Loss] = deque(maxlen=10_000)
        self.counted: set[str] = set()

    def measured(self, recording: str, split: Mapping[str, Progress]) -> list[Loss]:
        """Takes the next split of a recording; returns the losses that are certain by now."""
        values = {
            topic: sorted(each.value for each in found.positions) for topic, found in split.items()
        }
        due = [self._reduced(each, recording, values) for each in self._pending]
        self._pending = []
        for topic, found in split.items():
            last = self._last.get((recording, topic))
            positions = found.positions
            if last is None or last.value < positions[0].value:
                positions = positions if last is None else [last, *positions]
                self._last[recording, topic] = positions[-1]
            new = holes(positions, found.kind)
            if new is None:
                continue
            self.counted.add(topic)
            for hole in new:
                pending: _Pending | None = _Pending(recording, topic, found.kind, hole)
                for other, known in self._newest.items():
                    if pending is not None:
                        pending = self._reduced(pending, other, known)
                if pending is not None:
                    self._pending.append(pending)
        self._newest.pop(recording, None)
        self._newest[recording] = values
        for name in [*self._newest][:-_RECORDINGS]:
            del self._newest[name]
            self._last = {key: at for key, at in self._last.items() if key[0] != name}
        return self._certain([each for each in due if each is not None])

    def flush(self) -> list[Loss]:
        """Returns what no further split will fill."""
        due, self._pending = self._pending, []
        return self._certain(due)

    def reported(self, topic: str, start: Ns, stop: Ns, lost: int) -> list[Loss]:
        """Takes rosbag2's own count of a topic; returns it where nothing else counts the topic."""
        if topic in self.counted:
            return []
        loss = Loss(topic, start, stop, lost, "rosbag2")
        self._lately.append(loss)
        return [loss]

    def in_last_hour(self, now: Ns) -> dict[str, int]:
        """Returns how many messages of each topic are missing of the last hour."""
        found: dict[str, int] = {}
        for loss in self._lately:
            if loss.stop > now - HOUR_NS:
                found[loss.topic] = found.get(loss.topic, 0) + loss.lost
        return found

    def _reduced(
        self, pending: _Pending, recording: str, values: Mapping[str, list[int]]
    ) -> _Pending | None:
        """Returns what is missing of a hole beside what another recording has."""
        if pending.recording == recording or pending.topic not in values:
            return pending
        known, hole = values[pending.topic], pending.hole
        inside = bisect_left(known, hole.after.value) - bisect_right(known, hole.before.value)
        if inside >= hole.missing:
            return None
        pending.hole = replace(hole, missing=hole.missing - inside)
        return pending

    def _certain(self, due: Sequence[_Pending]) -> list[Loss]:
        losses = [
            Loss(
                each.topic,
                each.hole.before.log_time,
                each.hole.after.log_time,
                each.hole.missing,
                each.kind,
            )
            for each in due
        ]
        self._lately += losses
        return losses
