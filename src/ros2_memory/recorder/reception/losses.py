"""Adds up what is missing in closed splits, across splits and overlapping recordings.

A hole counts once the next split has been measured, and the other recording of a handover up to
there: until then that one may turn out to have its messages. One at the end of a split waits for
the next one, too: the messages there tell it from a late one. After a split that does not show
what it has of a topic, the topic is followed from the start.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.state_files import Loss
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.recorder.reception.continuity import Hole, Kind, Position, holes

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

HOUR_NS: Final[Ns] = 3600 * NS_PER_S
_RECENT: Final = 6
"""How many splits are compared, and after how many a recording is not waited for any more."""


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
    found_at: int
    """How many splits had been measured before."""
    missed: int
    """How many are missing in this recording."""


class LossCounter:
    """What is missing in the splits of one bag directory, measured one after the other."""

    def __init__(self) -> None:
        self._measured = 0
        # Of each recording, how many splits had been measured when it was last heard of.
        self._heard: dict[str, int] = {}
        # Up to which log time each recording has been measured.
        self._reached: dict[str, Ns] = {}
        # The values of the newest splits by topic, ascending.
        self._recent: deque[tuple[str, Mapping[str, array[int]]]] = deque(maxlen=_RECENT)
        # By recording and topic: the newest messages, from the first gap on that may still close.
        self._ends: dict[tuple[str, str], Sequence[Position]] = {}
        self._pending: list[_Pending] = []
        self._lately: deque[Loss] = deque(maxlen=10_000)
        self.counted: set[str] = set()

    def begun(self, recording: str) -> None:
        """Notes that a recording begins, which may have what another one misses."""
        self._heard[recording] = self._measured

    def unclear(self, recording: str, topics: Collection[str] | None = None) -> None:
        """Notes that the next split does not show what it has of these topics; None: of any."""
        self._ends = {
            key: end
            for key, end in self._ends.items()
            if key[0] != recording or (topics is not None and key[1] not in topics)
        }

    def measured(self, recording: str, split: Mapping[str, Progress]) -> list[Loss]:
        """Takes the next split of a recording; returns the losses that are certain by now."""
        values = {
            topic: array("q", sorted(each.value for each in found.positions))
            for topic, found in split.items()
        }
        self._measured += 1
        self._heard[recording] = self._measured
        ends = [found.positions[-1].log_time for found in split.values()]
        self._reached[recording] = max([self._reached.get(recording, 0), *ends])
        self._pending = [each for each in self._pending if self._remains(each, recording, values)]
        due = [each for each in self._pending if self._is_settled(each)]
        self._pending = [each for each in self._pending if each not in due]
        for topic, found in split.items():
            new = self._new_holes(recording, topic, found)
            if new is None:
                continue
            self.counted.add(topic)
            for hole in new:
                pending = _Pending(recording, topic, found.kind, hole, self._measured, hole.missing)
                if all(self._remains(pending, *each) for each in self._recent):
                    known = [*self._pending, *due]
                    pending.hole = replace(
                        pending.hole, missing=pending.hole.missing - _shared(pending, known)
                    )
                    if pending.hole.missing > 0:
                        self._pending.append(pending)
        self._recent.append((recording, values))
        for name, heard in [*self._heard.items()]:
            if self._measured - heard >= _RECENT:
                del self._heard[name]
                self._reached.pop(name, None)
                self.unclear(name)
        return self._certain(due)

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

    def _new_holes(self, recording: str, topic: str, found: Progress) -> list[Hole] | None:
        """Returns the holes that the next split of a recording adds; None without a cadence."""
        end, positions = self._ends.get((recording, topic), ()), found.positions
        if end and end[-1].value >= positions[0].value:
            return holes(positions, found.kind)
        positions = [*end, *positions]
        self._ends[recording, topic] = positions[-1:]
        new = holes(positions, found.kind)
        if new is None:
            return None
        still_open = next((hole.before for hole in new if hole.is_open), None)
        if still_open is not None:
            self._ends[recording, topic] = positions[positions.index(still_open) :]
        if not end:
            return new
        self._look_again(recording, topic, end[0], new)
        return [hole for hole in new if hole.before.value >= end[-1].value]

    def _look_again(
        self, recording: str, topic: str, first: Position, found: Sequence[Hole]
    ) -> None:
        """Corrects the open holes of a topic, from a first message on, by what was found since."""
        now = {hole.before: hole for hole in found}
        for each in self._pending:
            if (each.recording, each.topic) != (recording, topic) or not each.hole.is_open:
                continue
            if each.hole.before.value < first.value:
                continue
            hole = now.get(each.hole.before)
            missed = 0 if hole is None else hole.missing
            missing = each.hole.missing + missed - each.missed
            is_open = hole is not None and hole.is_open
            each.hole, each.missed = replace(each.hole, missing=missing, is_open=is_open), missed
        self._pending = [each for each in self._pending if each.hole.missing > 0]

    def _is_settled(self, pending: _Pending) -> bool:
        """Whether nothing more can show that less is missing."""
        if pending.hole.is_open and self._measured - pending.found_at < _RECENT:
            return False
        return all(
            self._reached.get(name, 0) >= pending.hole.after.log_time
            for name, heard in self._heard.items()
            if self._measured - max(heard, pending.found_at) < _RECENT
        )

    def _remains(self, pending: _Pending, recording: str, values: Mapping[str, array[int]]) -> bool:
        """Takes from a hole what another recording has; returns whether anything is left."""
        if pending.recording == recording or pending.topic not in values:
            return True
        known, hole = values[pending.topic], pending.hole
        inside = bisect_left(known, hole.after.value) - bisect_right(known, hole.before.value)
        pending.hole = replace(hole, missing=hole.missing - inside)
        return inside < hole.missing

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


def _shared(pending: _Pending, others: Sequence[_Pending]) -> int:
    """Returns how much of a hole was found in another recording, too, where both miss it."""
    hole = pending.hole
    return max(
        (
            each.hole.missing
            for each in others
            if each.topic == pending.topic
            and each.recording != pending.recording
            and each.hole.before.value < hole.after.value
            and hole.before.value < each.hole.after.value
        ),
        default=0,
    )
