"""The recorders that run: mostly one, two during a handover, and those that are ending.

What each step does; when it is taken is `supervisor`'s business. Nothing here waits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.durable_write import flush_bags
from ros2_memory.bag_dir.layout import METADATA_FILE, recording_name
from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.handover.plan import READY_TIMEOUT_S, HandoverPlan, Step
from ros2_memory.recorder.handover.transfer import HandoverTransfer
from ros2_memory.recorder.process.child import end_all
from ros2_memory.recorder.session import RecordingSession
from ros2_memory.recorder.split_watcher import Splits
from ros2_memory.recorder.watchdog import silence_told
from ros2_memory.retention.clear import remove_if_empty

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.recorder.event_log import EventLog
    from ros2_memory.recorder.handover.plan import ClockReading
    from ros2_memory.recorder.ports import RecorderProcess
    from ros2_memory.recorder.split_watcher import Changes
    from ros2_memory.storage.base import BagReader

WHOLE_RECORDING_S: Final = 15.0
"""A recording that lived for less says nothing of topics that brought no message."""


class RecordingSessions:
    """The sessions of one bag directory; `restarts` is how often one had to be begun anew.

    Args:
        bag_dir: where recordings lie.
        start_child: starts the recorder of a recording, given its name and directory.
        announce: is told the name of a recording before anything of it exists.
        reader: reads splits that are closed.
        journal: where everything is reported.
        own: the list of recordings that were made here.
        simulated: whether log times come from a simulated clock.
        subscribe_timeout_s: how long a new recorder is waited for in a handover.
        both_s: how long both record then.
    """

    def __init__(
        self,
        bag_dir: Path,
        start_child: Callable[[str, Path], RecorderProcess],
        announce: Callable[[str], None],
        reader: BagReader,
        journal: EventLog,
        *,
        own: OwnRecordings,
        simulated: bool,
        subscribe_timeout_s: float,
        both_s: float,
    ) -> None:
        self._bag_dir = bag_dir
        self._start_child = start_child
        self._announce = announce
        self._own = own
        self._unlisted: set[str] = set()
        self._reader = reader
        self._journal = journal
        self._simulated = simulated
        self._subscribe_timeout_s = subscribe_timeout_s
        self._both_s = both_s
        self.current: RecordingSession | None = None
        self.takeover: HandoverTransfer | None = None
        self._leaving: list[RecordingSession] = []
        self._completed: list[HandoverTransfer] = []
        self._retired_bytes = 0
        self.restarts = 0

    @property
    def sessions(self) -> tuple[RecordingSession, ...]:
        """All sessions whose recorders have not ended, the current one first."""
        current = () if self.current is None else (self.current,)
        incoming = () if self.takeover is None else (self.takeover.new,)
        return (*current, *incoming, *self._leaving)

    @property
    def bytes_written(self) -> int:
        """By all recordings since the start."""
        return self._retired_bytes + sum(each.splits.bytes_written for each in self.sessions)

    def begin(self, now: ClockReading) -> None:
        """Starts a recording when there is none.

        Raises:
            RecorderError: it cannot be started.
        """
        self.current = self._launch(recording_name(now.wall, self._bag_dir), now)

    def begin_takeover(self, now: ClockReading) -> None:
        """Starts a recording that is to take over from the current one.

        Raises:
            RecorderError: it cannot be started; the current one goes on.
        """
        old = self.current
        if old is None or self.takeover is not None:
            return
        name = recording_name(now.wall, self._bag_dir)
        HandoverTransfer.announce(old, name)
        passage = HandoverPlan(
            now, subscribe_timeout_s=self._subscribe_timeout_s, both_s=self._both_s
        )
        try:
            new = self._launch(name, now)
        except RecorderError:
            HandoverTransfer.withdraw(old)
            raise
        self.takeover = HandoverTransfer(old, new, passage, self._reader, simulated=self._simulated)
        self._journal.note("rotation_begun", recording=old.name, next=name)

    def look(self, now: ClockReading) -> bool:
        """Takes in what the recorders said and wrote; whether a split was closed."""
        closed = False
        for session in self.sessions:
            self._journal.tell(session.name, session.hear())
            changes = session.splits.look(now.monotonic_s)
            self._list(session)
            closed = closed or bool(changes.closed)
            self._report(session, changes)
            if changes.gone and session not in self._leaving:
                self._has_vanished(session)
        return closed

    def advance_takeover(self, now: ClockReading) -> Step:
        """Takes a handover further; COMPLETE or ABANDON when it is over."""
        takeover = self.takeover
        if takeover is None:
            return Step.WAIT
        try:
            step = takeover.advance(now)
            if step is Step.COMPLETE:
                self._complete(takeover, now)
        except RecorderError as error:
            self._journal.fail("rotation_failed", str(error), recording=takeover.old.name)
            step = Step.ABANDON
        if step is Step.ABANDON:
            self._abandon(takeover)
        return step

    def handle_exits(self, now: ClockReading) -> list[float]:
        """Deals with recorders that died; for how long each had lived, in seconds.

        Where the current one died during a handover the new one is the current one from then on.
        """
        lived: list[float] = []
        takeover = self.takeover
        if takeover is not None and takeover.new.child.exit_status() is not None:
            lived.append(self._has_died(takeover.new, now))
            self._abandon(takeover)
        current = self.current
        if current is not None and current.child.exit_status() is not None:
            lived.append(self._has_died(current, now))
            self._lose_current()
        return lived

    def give_up(self, now: ClockReading) -> bool:
        """Ends a current recorder that does not begin to record; whether there was one."""
        current = self.current
        if current is None or current.ready:
            return False
        if now.monotonic_s - current.began.monotonic_s < READY_TIMEOUT_S:
            return False
        sentence = f"ros2 bag record does not begin to record: {current.last_words}"
        self._journal.fail("recorder_not_ready", sentence, recording=current.name)
        self.restarts += 1
        self._leave(current)
        self.current = None
        return True

    def collect_ended(self, now: ClockReading) -> None:
        """Reminds those that are ending, and lets go of those that have ended."""
        for session in tuple(self._leaving):
            if session.child.end() is not None:
                self._leaving.remove(session)
                self._retire(session, now)

    def dismiss(self, now: ClockReading) -> None:
        """Has all recorders end; `collect_ended` then lets go of them."""
        takeover = self.takeover
        if takeover is not None:
            try:
                if takeover.complete(now):
                    self._completed.append(takeover)
                    self._leave(takeover.new)
                    self.takeover = None
                else:
                    self._abandon(takeover)
            except RecorderError as error:
                self._journal.fail("rotation_failed", str(error), recording=takeover.old.name)
                self._abandon(takeover)
        if self.current is not None:
            self._leave(self.current)
            self.current = None

    def end(self, now: ClockReading) -> None:
        """Has all recorders end, and waits for it, within the patience of the children."""
        self.dismiss(now)
        for child in end_all([session.child for session in self._leaving]):
            self._journal.fail("recorder_not_ended", f"process {child.pid} cannot be ended")
        self.collect_ended(now)
        self._leaving.clear()

    def _launch(self, name: str, now: ClockReading) -> RecordingSession:
        self._own.begin(name)
        self._announce(name)
        directory = self._bag_dir / name
        try:
            child = self._start_child(name, directory)
        except OSError as error:
            raise RecorderError(f"ros2 bag record cannot be started: {error}") from error
        self._unlisted.add(name)
        self._journal.note("recorder_started", recording=name, pid=child.pid)
        return RecordingSession(name, child, Splits(directory, self._reader), now)

    def _list(self, session: RecordingSession) -> None:
        """Notes which directory the child has made, as soon as it has; a fault is tried again."""
        if session.name not in self._unlisted:
            return
        try:
            if self._own.complete(session.name):
                self._unlisted.remove(session.name)
        except RecorderError as error:
            self._journal.fail_once("recording_not_listed", session.name, str(error))
        else:
            self._journal.over("recording_not_listed", session.name)

    def _report(self, session: RecordingSession, changes: Changes) -> None:
        for name in changes.closed:
            self._journal.note("split_closed", recording=session.name, file=name)
        if changes.closed:
            for fault in flush_bags(session.splits.directory, changes.closed):
                self._journal.warn("not_flushed", fault, recording=session.name)
        for name in changes.empty:
            sentence = f"{session.name}/{name} is empty although a newer split was begun"
            self._journal.fail("split_empty", sentence, recording=session.name)
        for fault in changes.faults:
            self._journal.fail_once("unreadable", session.name, fault, recording=session.name)

    def _complete(self, takeover: HandoverTransfer, now: ClockReading) -> None:
        if takeover.missing:
            missing = ", ".join(sorted(takeover.missing))
            self._journal.warn(
                "rotated_without", f"not subscribed by the new recorder in time: {missing}"
            )
        takeover.complete(now)
        self._completed.append(takeover)
        self._leave(takeover.old)
        self.current, self.takeover = takeover.new, None
        self._journal.note("rotated", recording=takeover.old.name, next=takeover.new.name)

    def _abandon(self, takeover: HandoverTransfer) -> None:
        """Ends the new recorder; the old one goes on."""
        self.takeover = None
        try:
            takeover.abandon()
        except RecorderError as error:
            self._journal.fail("rotation_failed", str(error), recording=takeover.old.name)
        self._leave(takeover.new)

    def _lose_current(self) -> None:
        """The current recorder is gone; the one that was to take over does so, if there is one."""
        takeover = self.takeover
        self.current, self.takeover = None, None
        if takeover is None:
            return
        self.current = takeover.new
        try:
            takeover.settle()
        except RecorderError as error:
            self._journal.fail("rotation_failed", str(error), recording=takeover.old.name)

    def _has_vanished(self, session: RecordingSession) -> None:
        sentence = f"the directory of recording {session.name} has gone; a new one is begun"
        self._journal.fail("recording_vanished", sentence, recording=session.name)
        self.restarts += 1
        if self.takeover is not None and session is self.takeover.new:
            self._abandon(self.takeover)
        elif session is self.current:
            self._leave(session)
            self._lose_current()

    def _has_died(self, session: RecordingSession, now: ClockReading) -> float:
        self._journal.tell(session.name, session.hear())
        lived_s = now.monotonic_s - session.began.monotonic_s
        status = session.child.exit_status()
        sentence = f"ros2 bag record ended by itself with status {status}: {session.last_words}"
        self._journal.fail("recorder_died", sentence, recording=session.name, lived_s=lived_s)
        self.restarts += 1
        if session is self.current:
            self._retire(session, now)
        return lived_s

    def _leave(self, session: RecordingSession) -> None:
        if session not in self._leaving:
            self._leaving.append(session)
            session.child.end()

    def _retire(self, session: RecordingSession, now: ClockReading) -> None:
        """The recorder of this session has ended: looks at what it left a last time."""
        self._journal.tell(session.name, session.hear())
        self._report(session, session.splits.look(now.monotonic_s))
        for takeover in [each for each in self._completed if each.old is session]:
            self._completed.remove(takeover)
            try:
                takeover.old_has_ended()
            except RecorderError as error:
                self._journal.fail("rotation_failed", str(error), recording=session.name)
        self._list(session)
        self._unlisted.discard(session.name)
        splits = session.splits
        if remove_if_empty(splits.directory):
            self._journal.note("recording_empty", recording=session.name)
        faults = [*flush_bags(splits.directory, [METADATA_FILE]), *flush_bags(self._bag_dir, [])]
        for fault in faults:
            self._journal.warn("not_flushed", fault, recording=session.name)
        self._retired_bytes += splits.bytes_written
        lived_s = now.monotonic_s - session.began.monotonic_s
        silence = silence_told(session.subscribed, splits.heard)
        if silence is not None and lived_s >= WHOLE_RECORDING_S:
            self._journal.warn("topics_silent", silence, recording=session.name)
        self._journal.note(
            "recording_ended",
            recording=session.name,
            splits=len(splits.closed_names),
            messages=splits.messages,
            bytes=splits.bytes_written,
            lived_s=round(lived_s, 3),
        )
