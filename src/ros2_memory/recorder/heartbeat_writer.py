"""Writes the heartbeat of a running recorder: what it is doing, every few seconds."""

from __future__ import annotations

import os
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, process_of, write_heartbeat
from ros2_memory.core.errors import RecorderError

if TYPE_CHECKING:
    from collections.abc import Callable

    from ros2_memory.core.timebase import Clock
    from ros2_memory.recorder.base import HouseStatus
    from ros2_memory.recorder.event_log import EventLog
    from ros2_memory.recorder.process.topics import TopicsFile
    from ros2_memory.recorder.reception.reception import Reception
    from ros2_memory.recorder.sessions import Orders, RecordingSessions
    from ros2_memory.recorder.shortfall import TopicWatch


class HeartbeatWriter:
    """Writes `recorder.json`.

    Args:
        orders: what is recorded, and where.
        interval_s: how often it is written, in seconds.
        clock: the wall clock.
        events: where a heartbeat that cannot be written is reported.
        house: gives what the heartbeat shows of the housekeeper.
        topics: the list of topics to record.
        reception: knows what was lost.
        sessions: the recordings.
        watch: knows which topics are not recorded as they should be.
    """

    def __init__(
        self,
        orders: Orders,
        interval_s: float,
        clock: Clock,
        events: EventLog,
        *,
        house: Callable[[], HouseStatus],
        topics: TopicsFile,
        reception: Reception,
        sessions: RecordingSessions,
        watch: TopicWatch,
    ) -> None:
        self._orders = orders
        self._interval_s = interval_s
        self._clock = clock
        self._events = events
        self._house = house
        self._topics = topics
        self._reception = reception
        self._sessions = sessions
        self._watch = watch
        self._state = RecorderState.STOPPED
        self._since = clock.now()
        self._shown: Heartbeat | None = None

    def write(
        self, state: RecorderState, announced: str | None = None, *, only_changes: bool = False
    ) -> None:
        """Writes a heartbeat; one that cannot be written is reported and stops nothing.

        Args:
            state: what the recorder does.
            announced: a recording that is about to be begun.
            only_changes: write nothing unless more than times and amounts changed.
        """
        heartbeat = self._heartbeat(state, announced)
        shown = replace(heartbeat, updated=0, bytes_written=0, counted_bytes=None, state_bytes=0)
        if only_changes and shown == self._shown:
            return
        self._shown = shown
        try:
            write_heartbeat(self._orders.bag_dir, heartbeat)
        except RecorderError as error:
            self._events.fail_once("heartbeat_not_written", "", str(error))
        else:
            self._events.resolve("heartbeat_not_written", "")

    def _heartbeat(self, state: RecorderState, announced: str | None) -> Heartbeat:
        now, sessions, watch = self._clock.now(), self._sessions, self._watch
        if state is not self._state:
            self._state, self._since = state, now
        names = [session.name for session in sessions.running]
        if announced is not None and announced not in names:
            names.append(announced)
        subscribed = set[str]().union(*(session.subscribed for session in sessions.running))
        silent = frozenset() if sessions.current is None else sessions.current.silent_topics()
        return Heartbeat(
            pid=os.getpid(),
            updated=now,
            state=state,
            recordings=tuple(names),
            since=self._since,
            bytes_written=sessions.bytes_written,
            subscribed=tuple(sorted(subscribed)),
            silent=tuple(sorted(silent | watch.gone)),
            last_error=self._events.last_error,
            last_error_at=self._events.last_error_at,
            recovered=self._events.recovered,
            interval_s=self._interval_s,
            restarts=sessions.restarts,
            missing=watch.missing(sessions),
            lost=self._reception.lost_in_last_hour(now),
            waiting_for=watch.waiting_for if state is RecorderState.WAITING else None,
            cut_short=tuple(sorted(self._reception.cut_short)),
            listed=self._topics.selection.listed,
            list_refused=self._topics.refused,
            process=process_of(os.getpid()),
            advice=self._orders.advice() if watch.shortfall.unheard else None,
            **asdict(self._house()),
            **asdict(watch.shortfall),
        )
