"""The heartbeat of a running recorder: what it is doing, written every few seconds."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING

from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, write_heartbeat
from ros2_memory.core.errors import RecorderError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from ros2_memory.core.timebase import Clock
    from ros2_memory.recorder.event_log import EventLog
    from ros2_memory.recorder.sessions import RecordingSessions


class HeartbeatWriter:
    """Writes `recorder.json`; `interval_s` is how often it is asked to.

    `expected` gives the topics that are to be recorded by name, `age_held` which bags age leaves.
    """

    def __init__(
        self,
        bag_dir: Path,
        interval_s: float,
        clock: Clock,
        journal: EventLog,
        *,
        expected: Callable[[], Sequence[str]] = tuple,
        age_held: Callable[[], str | None] = lambda: None,
    ) -> None:
        self._bag_dir = bag_dir
        self._interval_s = interval_s
        self._clock = clock
        self._journal = journal
        self._expected = expected
        self._age_held = age_held
        self._offered = set[str]()
        self._state = RecorderState.STOPPED
        self._since = clock.now()
        self._announced: tuple[str, ...] = ()
        self._told: Heartbeat | None = None

    def announce(self, name: str) -> None:
        """Names a recording that is about to be begun, in every heartbeat until `arrived`."""
        self._announced = (name,)

    def arrived(self) -> None:
        """The recording that was announced is one of the crew's, or does not come."""
        self._announced = ()

    def beat(self, state: RecorderState, crew: RecordingSessions) -> None:
        """Writes a heartbeat. One that cannot be written is reported, and stops nothing."""
        self._write(self._heartbeat(state, crew))

    def beat_if_news(self, state: RecorderState, crew: RecordingSessions) -> None:
        """Writes a heartbeat where it would say something new, besides times and amounts."""
        heartbeat = self._heartbeat(state, crew)
        if _news(heartbeat) != self._told:
            self._write(heartbeat)

    def _heartbeat(self, state: RecorderState, crew: RecordingSessions) -> Heartbeat:
        now = self._clock.now()
        if state is not self._state:
            self._state, self._since = state, now
        sessions = crew.sessions
        names = (*(session.name for session in sessions), *self._announced)
        subscribed = frozenset[str]().union(*(session.subscribed for session in sessions))
        silent = frozenset() if crew.current is None else crew.current.silent()
        return Heartbeat(
            pid=os.getpid(),
            updated=now,
            state=state,
            recordings=tuple(dict.fromkeys(names)),
            since=self._since,
            bytes_written=crew.bytes_written,
            subscribed=tuple(sorted(subscribed)),
            silent=tuple(sorted(silent)),
            last_error=self._journal.last_error,
            interval_s=self._interval_s,
            restarts=crew.restarts,
            missing=self._missing(crew),
            age_held=self._age_held(),
        )

    def _missing(self, crew: RecordingSessions) -> tuple[str, ...]:
        """What no publisher has offered; nothing before the first recorder has looked around."""
        for session in crew.sessions:
            self._offered |= session.subscribed | session.splits.heard
        if not any(session.ready for session in crew.sessions):
            return ()
        return tuple(sorted({*self._expected()} - self._offered))

    def _write(self, heartbeat: Heartbeat) -> None:
        self._told = _news(heartbeat)
        try:
            write_heartbeat(self._bag_dir, heartbeat)
        except RecorderError as error:
            self._journal.fail_once("heartbeat_not_written", "", str(error))
        else:
            self._journal.over("heartbeat_not_written", "")


def _news(heartbeat: Heartbeat) -> Heartbeat:
    return replace(heartbeat, updated=0, bytes_written=0)
