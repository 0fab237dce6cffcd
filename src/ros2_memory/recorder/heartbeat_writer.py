"""Writes the heartbeat of a running recorder: what it is doing, every few seconds."""

from __future__ import annotations

import os
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, process_of, write_heartbeat
from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.shortfall import Shortfall

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ros2_memory.core.timebase import Clock
    from ros2_memory.recorder.base import HouseStatus
    from ros2_memory.recorder.event_log import EventLog
    from ros2_memory.recorder.process.topics import TopicsFile
    from ros2_memory.recorder.reception.reception import Reception
    from ros2_memory.recorder.sessions import RecordingSessions


class HeartbeatWriter:
    """Writes `recorder.json`.

    Args:
        bag_dir: the directory in which it is written.
        interval_s: how often it is written, in seconds.
        clock: the wall clock.
        events: where a heartbeat that cannot be written is reported.
        house: gives what the heartbeat shows of the housekeeper.
        topics: the list of topics to record.
        reception: knows what was lost.
        advice: says what to do where publishers are subscribed to and not heard.

    Attributes:
        offered: the topics that some publisher has offered since the start.
        gone: those that none offers any more; silent in the heartbeat, too.
        shortfall: the topics that are not recorded as they should be.
    """

    def __init__(
        self,
        bag_dir: Path,
        interval_s: float,
        clock: Clock,
        events: EventLog,
        *,
        house: Callable[[], HouseStatus],
        topics: TopicsFile,
        reception: Reception,
        advice: Callable[[], str] = str,
    ) -> None:
        self._advice = advice
        self._bag_dir = bag_dir
        self._interval_s = interval_s
        self._clock = clock
        self._events = events
        self._house = house
        self._topics = topics
        self._reception = reception
        self.offered = set[str]()
        self.gone = frozenset[str]()
        self.shortfall = Shortfall()
        self._state = RecorderState.STOPPED
        self._since = clock.now()
        self._written: Heartbeat | None = None

    def write(
        self, state: RecorderState, sessions: RecordingSessions, announced: str | None = None
    ) -> None:
        """Writes a heartbeat; one that cannot be written is reported and stops nothing.

        `announced` is a recording that is about to be begun.
        """
        self._write(self._heartbeat(state, sessions, announced))

    def write_if_changed(self, state: RecorderState, sessions: RecordingSessions) -> None:
        """Writes a heartbeat if more than its times and amounts changed."""
        heartbeat = self._heartbeat(state, sessions, None)
        if _without_amounts(heartbeat) != self._written:
            self._write(heartbeat)

    def _heartbeat(
        self, state: RecorderState, sessions: RecordingSessions, announced: str | None
    ) -> Heartbeat:
        now = self._clock.now()
        if state is not self._state:
            self._state, self._since = state, now
        names = [session.name for session in sessions.running]
        if announced is not None and announced not in names:
            names.append(announced)
        subscribed = frozenset[str]().union(*(each.subscribed for each in sessions.running))
        silent = frozenset() if sessions.current is None else sessions.current.silent_topics()
        return Heartbeat(
            pid=os.getpid(),
            updated=now,
            state=state,
            recordings=tuple(names),
            since=self._since,
            bytes_written=sessions.bytes_written,
            subscribed=tuple(sorted(subscribed)),
            silent=tuple(sorted(silent | self.gone)),
            last_error=self._events.last_error,
            last_error_at=self._events.last_error_at,
            recovered=self._events.recovered,
            interval_s=self._interval_s,
            restarts=sessions.restarts,
            missing=self.missing(sessions),
            lost=self._reception.lost_in_last_hour(now),
            waiting_for=sessions.waiting_for if state is RecorderState.WAITING else None,
            cut_short=tuple(sorted(self._reception.cut_short)),
            listed=self._topics.selection.listed,
            list_refused=self._topics.refused,
            process=process_of(os.getpid()),
            advice=self._advice() if self.shortfall.unheard else None,
            **asdict(self._house()),
            **asdict(self.shortfall),
        )

    def missing(self, sessions: RecordingSessions) -> tuple[str, ...]:
        """Returns the topics that no publisher has offered; none before a recorder has looked."""
        for session in sessions.running:
            self.offered |= session.subscribed | session.splits.received
        if not any(session.has_recorded for session in sessions.running):
            return ()
        unknown = (each.of_unknown_type for each in sessions.running)
        known = self.offered.union(self.shortfall.unknown_types, *unknown)
        return tuple(sorted({*self._topics.selection.exact} - known))

    def _write(self, heartbeat: Heartbeat) -> None:
        self._written = _without_amounts(heartbeat)
        try:
            write_heartbeat(self._bag_dir, heartbeat)
        except RecorderError as error:
            self._events.fail_once("heartbeat_not_written", "", str(error))
        else:
            self._events.resolve("heartbeat_not_written", "")


def _without_amounts(heartbeat: Heartbeat) -> Heartbeat:
    return replace(heartbeat, updated=0, bytes_written=0, counted_bytes=None, state_bytes=0)
