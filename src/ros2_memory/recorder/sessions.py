"""Runs the recordings: mostly one, two during a handover, and those that are ending.

This module does each step; `supervisor` decides when. Nothing here waits, except `stop`.
"""

from __future__ import annotations

import signal
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.durable_write import flush_bags
from ros2_memory.bag_dir.layout import METADATA_FILE, recording_name
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.text import counted
from ros2_memory.recorder.handover import (
    READY_TIMEOUT_S,
    HandoverTransfer,
    Step,
    give_up,
    settle_handover,
    unsettled_handovers,
)
from ros2_memory.recorder.policies import ClockReading, describe_death
from ros2_memory.recorder.process.child import Child, end_all
from ros2_memory.recorder.process.output import LineKind
from ros2_memory.recorder.session import RecordingSession, SessionState, SplitChanges, Splits
from ros2_memory.retention.clear import remove_if_empty

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.bag_dir.state_files import Interruption
    from ros2_memory.core.timebase import Clock, Ns
    from ros2_memory.recorder.background import Background
    from ros2_memory.recorder.event_log import EventLog
    from ros2_memory.recorder.process.topics import TopicsFile
    from ros2_memory.recorder.reception import Reception
    from ros2_memory.storage.base import BagReader


class Required(NamedTuple):
    """An entry of `recording.required`: a name or a glob, and the least messages a second."""

    topic: str
    min_hz: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Orders:
    """What to record, and with what. Durations are in seconds.

    Attributes:
        session_duration_s: how long a recording lasts before the next takes over.
        min_free_bytes: what must be free on the disk for recording to continue.
        start_child: starts the `ros2 bag record` of a recording, given its name and directory.
        simulated: log times come from a simulated clock.
        advice: says what to do where publishers are subscribed to and not heard.
    """

    bag_dir: Path
    split_duration_s: float
    session_duration_s: float
    min_free_bytes: int
    start_child: Callable[[str, Path], Child]
    reader: BagReader
    clock: Clock
    topics: TopicsFile
    own: OwnRecordings
    reception: Reception
    background: Background
    required: Sequence[Required] = ()
    simulated: bool = False
    advice: Callable[[], str] = str


SETTLE_S: Final = 5.0
"""A recording this young writes its headers and latched messages, which do not end a silence."""
WHOLE_RECORDING_S: Final = 15.0
"""A recording that lived for less is too short to report topics without messages."""


class RecordingSessions:
    """The sessions of one bag directory.

    Args:
        announce: receives the name of a recording before anything of it exists.
        interrupted: receives when a recording last grew that ended unexpectedly (wall time), and
            how it ended.

    Attributes:
        running: all sessions whose children have not ended, oldest first.
        current: the session that records; None while none does.
        handover: the handover from the current session to the next; None mostly.
        restarts: how often a recording had to be started again.
        heard: the topics of which a closed split had a message.
        closed_s: when a split was last closed, by the monotonic clock.
        grew_s: when a recording last grew by more than its beginning, by that clock.
    """

    def __init__(
        self,
        orders: Orders,
        announce: Callable[[str], None],
        interrupted: Callable[[Ns, Interruption], None],
        events: EventLog,
    ) -> None:
        self._orders = orders
        self._bag_dir = orders.bag_dir
        self._announce = announce
        self._interrupted = interrupted
        self._events = events
        self.current: RecordingSession | None = None
        self.handover: HandoverTransfer | None = None
        self.running: tuple[RecordingSession, ...] = ()
        # By the old recording's name, until that has ended.
        self._completed: dict[str, HandoverTransfer] = {}
        # Old and new recordings whose sidecars may have to change.
        self._unsettled: list[tuple[Path, Path]] = []
        self._is_recovered = False
        self._ended_bytes = 0
        self.restarts = 0
        self.heard = set[str]()
        self.closed_s = 0.0
        self.grew_s = 0.0

    @property
    def bytes_written(self) -> int:
        """The bytes that all recordings wrote since the start."""
        return self._ended_bytes + sum(session.splits.bytes_written for session in self.running)

    def begin(self, now: ClockReading) -> None:
        """Starts a recording if none is running.

        Raises:
            RecorderError: it cannot be started.
        """
        self.current = self._launch(recording_name(now.wall, self._bag_dir), now)
        self.grew_s = max(self.grew_s, now.monotonic_s)

    def begin_handover(self, now: ClockReading) -> None:
        """Starts a recording that is to take over from the current one.

        Raises:
            RecorderError: it cannot be started; the current one continues.
        """
        old = self.current
        if old is None or self.handover is not None:
            return
        name = recording_name(now.wall, self._bag_dir)
        try:
            HandoverTransfer.announce(old, name)
            new = self._launch(name, now)
        except (RecorderError, OSError):
            self._unsettled.append((old.splits.directory, self._bag_dir / name))
            self.settle_handovers()
            raise
        self.handover = HandoverTransfer(old, new, now, self._orders)
        self._events.info("rotation_begun", recording=old.name, next=name)

    def observe(self, now: ClockReading) -> bool:
        """Reads what the children printed and wrote; returns whether a split was closed."""
        has_closed = False
        for session in self.running:
            changes = self._observe_session(session, now)
            self._update_list(session)
            has_closed |= bool(changes.closed)
            if changes.gone and session.state is not SessionState.ENDING:
                name = session.name
                sentence = f"the directory of recording {name} is missing; a new recording starts"
                self._events.fail("recording_vanished", sentence, recording=name)
                self.restarts += 1
                self._go_on_without(session)
        if has_closed:
            self.settle_handovers()
        return has_closed

    def advance_handover(self, now: ClockReading) -> Step:
        """Takes a handover further; returns COMPLETE or ABANDON when it is over."""
        handover = self.handover
        if handover is None:
            return Step.WAIT
        step = Step.ABANDON  # unless all goes well
        with self._reporting_failures(handover.old):
            due = handover.advance(now)
            if due is Step.COMPLETE:
                self._take_over(handover, now)
            step = due
        if step is Step.ABANDON:
            self._abandon(handover)
        return step

    def end_unready(self, now: ClockReading) -> bool:
        """Ends the current session if it does not begin to record; returns whether it did."""
        current = self.current
        if current is None or current.is_recording or current.age_s(now) < READY_TIMEOUT_S:
            return False
        said = current.last_output or "it prints no reason"
        sentence = f"ros2 bag record does not begin to record: {said}"
        self._events.fail("recorder_not_ready", sentence, recording=current.name)
        self.restarts += 1
        current.end()
        self.current = None
        return True

    def collect_ended(self, now: ClockReading) -> int:
        """Finalizes sessions that have ended; returns how many did so by themselves.

        Those that are ending are signalled again. If the current one died during a handover, the
        new one becomes the current one.
        """
        running, deaths = self.running, 0
        # The newest first: none that died as well takes over.
        for session in reversed(running):
            is_ending = session.state is SessionState.ENDING
            status = session.child.end() if is_ending else session.child.exit_status()
            if status is None:
                continue
            if not is_ending:
                deaths += 1
                self._report_death(session, status, now)
                self._go_on_without(session)
            elif session.has_recorded and status == -signal.SIGKILL:
                sentence = (
                    f"the ros2 bag record of {session.name} hung: it did not end when it was asked "
                    "to, and was killed (SIGKILL); what it had not written yet is lost"
                )
                self._events.fail("recorder_hung", sentence, recording=session.name)
                self.restarts += 1
                self._interrupted(session.grew_at, "hung")
            self._finalize(session, now)
        if self.running != running:
            self.settle_handovers()
        return deaths

    def end_all(self, now: ClockReading) -> None:
        """Asks all sessions to end; `collect_ended` finalizes them later."""
        handover = self.handover
        if handover is not None:
            with self._reporting_failures(handover.old):
                # Else the old one counts up to its end, and the new one from there.
                if handover.complete(now):
                    self._completed[handover.old.name] = handover
            self._unsettled.append(handover.directories)
        for session in self.running:
            session.end()
        self.current, self.handover = None, None

    def stop(self, now: ClockReading) -> None:
        """Ends all sessions, and waits for that within the patience of the children."""
        self.end_all(now)
        for child in end_all([session.child for session in self.running]):
            self._events.fail("recorder_not_ended", f"process {child.pid} cannot be ended")
        self.collect_ended(now)
        self.running = ()

    def _launch(self, name: str, now: ClockReading) -> RecordingSession:
        self._orders.own.begin(name)
        self._announce(name)
        directory = self._bag_dir / name
        try:
            child = self._orders.start_child(name, directory)
        except OSError as error:
            raise RecorderError(f"ros2 bag record cannot be started: {error}") from error
        self._events.info("recorder_started", recording=name, pid=child.pid)
        session = RecordingSession(name, child, Splits(directory, self._orders.reader), now)
        self.running += (session,)
        return session

    def _update_list(self, session: RecordingSession) -> None:
        """Lists the directory that the child made, and its splits; a fault is retried."""
        with self._events.lasting_if_refused("recording_not_listed", session.name):
            session.is_listed = session.is_listed or self._orders.own.complete(session.name)
            # Else another disk may lie there.
            if session.is_listed and session.splits.exists:
                has_ended = session.state is SessionState.ENDED
                self._orders.own.note(session.name, session.splits.seen, ended=has_ended)

    def _observe_session(self, session: RecordingSession, now: ClockReading) -> SplitChanges:
        self._report_output(session)
        before = session.splits.bytes_written
        changes = session.splits.observe(now.monotonic_s)
        if session.splits.bytes_written > before:
            session.grew_at = now.wall
            # The end of a file is written when its recording ends, too.
            if session.is_recording and session.age_s(now) >= SETTLE_S:
                self.grew_s = now.monotonic_s
        for name in changes.closed:
            self._events.info("split_closed", recording=session.name, file=name)
            self._orders.reception.learn(session.name, session.splits.directory / name)
        if changes.closed:
            self.heard |= session.splits.received
            self.closed_s = now.monotonic_s
            self._flush_later(session, session.splits.directory, changes.closed)
        for name in changes.empty:
            file = f"{session.name}/{name}"
            sentence = f"{file} is empty although a newer split was started"
            self._events.lasting("split_empty", file, sentence, recording=session.name)
        for fault in changes.faults:
            self._events.lasting("unreadable", session.name, fault, recording=session.name)
        return changes

    def _report_output(self, session: RecordingSession) -> None:
        lines = session.new_lines()
        self._events.report_output(session.name, lines)
        reception = self._orders.reception
        for line in lines:
            if line.topic is None:
                continue
            if line.kind is LineKind.QOS_REFUSED:
                # Of two policies that do not fit only one is named: a volatile publisher may be
                # best effort, but then another line says that.
                best_effort = "DURABILITY" not in line.text
                reception.refused(session.name, line.topic, best_effort=best_effort)
            elif line.kind is LineKind.SEVERAL_TYPES and line.topic in session.subscribed:
                reception.refused(session.name, line.topic, best_effort=None)
            elif line.kind is LineKind.TOPIC_LOST:
                reception.lost(session.name, line.topic, line.count or 0)

    def _flush_later(
        self, session: RecordingSession, directory: Path, names: tuple[str, ...]
    ) -> None:
        def flush() -> None:
            for fault in flush_bags(directory, names):
                self._events.warn("not_flushed", fault, recording=session.name)

        self._orders.background.add("flush", flush)

    def _take_over(self, handover: HandoverTransfer, now: ClockReading) -> None:
        if handover.missing:
            missing = ", ".join(sorted(handover.missing))
            self._events.remark(
                "rotated_without",
                f"the new recording does not subscribe to {missing} yet: their publishers have "
                "gone, or were not discovered in time",
                recording=handover.new.name,
            )
        handover.complete(now)
        self._completed[handover.old.name] = handover
        self._unsettled.append(handover.directories)
        handover.old.end()
        self.current, self.handover = handover.new, None
        self._events.info("rotated", recording=handover.old.name, next=handover.new.name)

    def _abandon(self, handover: HandoverTransfer) -> None:
        """Ends the new session; the old one continues."""
        self.handover = None
        self._unsettled.append(handover.directories)
        with self._reporting_failures(handover.old):
            give_up(*handover.directories)
        handover.new.end()

    def _go_on_without(self, session: RecordingSession) -> None:
        """Goes on without a session: with the other one of a handover, if there is one."""
        handover = self.handover
        if handover is not None and session is handover.new:
            self._abandon(handover)
        elif session is self.current:
            session.end()
            self.current, self.handover = None, None
            if handover is not None:
                self.current = handover.new
                self._unsettled.append(handover.directories)
                self.settle_handovers()

    def recover(self) -> None:
        """Settles what an earlier run left, which is looked for once, and what could not be yet.

        Raises:
            OSError: the bag directory cannot be listed.
        """
        if not self._is_recovered:
            self._unsettled = unsettled_handovers(self._bag_dir)
            self._is_recovered = True
        self.settle_handovers()

    def settle_handovers(self) -> None:
        """Completes handovers whose recordings have ended, and compares the two where they can be.

        What fails, as on a full disk, is reported and tried again with the next call.
        """
        running = {session.name for session in self.running}
        for old, new in [*self._unsettled]:
            name = old.name
            with self._events.lasting_if_refused("handover_not_settled", name, recording=name):
                if settle_handover(old, new, self._orders.reader, running):
                    self._unsettled.remove((old, new))

    def _report_death(self, session: RecordingSession, status: int, now: ClockReading) -> None:
        self._report_output(session)
        lived_s = session.age_s(now)
        sentence = describe_death(status, session.last_output)
        self._events.fail("recorder_died", sentence, recording=session.name, lived_s=lived_s)
        self.restarts += 1
        self._interrupted(session.grew_at, "died")

    def _finalize(self, session: RecordingSession, now: ClockReading) -> None:
        """Reads what an ended session left, and makes it durable."""
        session.state = SessionState.ENDED
        self.running = tuple(other for other in self.running if other is not session)
        self._observe_session(session, now)
        handover = self._completed.pop(session.name, None)
        if handover is not None:
            with self._reporting_failures(session):
                handover.add_late_splits()
        self._update_list(session)
        self._events.ended(session.name)
        splits = session.splits
        if remove_if_empty(splits.directory):
            self._events.info("recording_empty", recording=session.name)
        self._flush_later(session, splits.directory, (METADATA_FILE,))
        self._flush_later(session, self._bag_dir, ())
        self._ended_bytes += splits.bytes_written
        lived_s = session.age_s(now)
        if lived_s >= WHOLE_RECORDING_S:
            self._report_silent_topics(session)
        self._events.info(
            "recording_ended",
            recording=session.name,
            splits=len(splits.closed_names),
            messages=splits.messages,
            bytes=splits.bytes_written,
            lived_s=round(lived_s, 3),
        )

    def _report_silent_topics(self, session: RecordingSession) -> None:
        silent = sorted(session.subscribed - session.splits.received)
        if not silent:
            return
        sentence = f"subscribed, and no message in the whole recording: {', '.join(silent)}"
        if not session.splits.received:
            topics = counted(len(silent), "topic")
            sentence = f"subscribed to {topics} and received nothing from any of them; "
            sentence += self._orders.advice()
        self._events.warn("topics_silent", sentence, recording=session.name)

    @contextmanager
    def _reporting_failures(self, session: RecordingSession) -> Iterator[None]:
        """Reports an error of the handover from this session, and continues after the block."""
        try:
            yield
        except (RecorderError, OSError) as error:
            self._events.fail("rotation_failed", str(error), recording=session.name)
