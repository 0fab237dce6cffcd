"""Runs the recordings: one at most times, two during a handover, and those that are ending.

This module does each step; `supervisor` decides when. Nothing here waits, except `stop`. Only the
end of a bag file shows whether it is closed: distributions number splits differently, and a new
file appears some milliseconds before the old one is closed.
"""

from __future__ import annotations

import os
import signal
from collections import Counter, defaultdict, deque
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from enum import Enum, auto
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.durable_write import flush_bags
from ros2_memory.bag_dir.layout import METADATA_FILE, bag_kind, recording_name
from ros2_memory.bag_dir.state_files import read_deleted
from ros2_memory.core.errors import BagError, EpisodicError, RecorderError
from ros2_memory.core.timebase import MAX_NS, Clock, Ns
from ros2_memory.recorder.handover import (
    READY_TIMEOUT_S,
    HandoverTransfer,
    Step,
    give_up,
    settle_handover,
    unsettled_handovers,
)
from ros2_memory.recorder.policies import SETTLE_S, ClockReading, describe_death
from ros2_memory.recorder.process.child import Child, end_all
from ros2_memory.recorder.process.command import MESSAGES_LOST
from ros2_memory.recorder.process.output import Line, LineKind, parse_line
from ros2_memory.retention.clear import remove_if_empty

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.bag_dir.state_files import Interruption
    from ros2_memory.recorder.background import Background
    from ros2_memory.recorder.event_log import EventLog
    from ros2_memory.recorder.process.topics import TopicSelection, TopicsFile
    from ros2_memory.recorder.reception import Reception
    from ros2_memory.storage.base import BagReader


MAX_DISTINCT: Final = 200
"""So many different warnings of a kind are reported of one recording."""
REPEATED_S: Final = 5.0
"""What the child reports again and again is over if it has not reported it for so long."""
EMPTY_GRACE_S: Final = 5.0
"""A file that is still 0 bytes so long after a newer one appeared was lost to a full disk."""
_LAST_LINES: Final = 6
"""So many lines of a child are quoted when it dies."""


class SplitChanges(NamedTuple):
    """The changes in a recording since the last observation.

    Attributes:
        closed: names of the splits that were closed, in the order in which they were recorded.
        empty: names of the splits that will stay empty, since a newer one was started.
        gone: whether the directory, which existed, is missing.
        faults: a sentence for each file that cannot be read, or for the directory: "".
    """

    closed: tuple[str, ...] = ()
    empty: tuple[str, ...] = ()
    gone: bool = False
    faults: Mapping[str, str] = MappingProxyType({})


@dataclass(slots=True)
class _Split:
    first_seen_s: float
    size: int = 0
    closed: bool = False
    stays_empty: bool = False
    start: Ns = MAX_NS


@dataclass(slots=True)
class Splits:
    """The splits of one recording, as of the last observation.

    Attributes:
        received: the topics that have a message in a closed split.
        messages: the number of messages in all closed splits.
    """

    directory: Path
    reader: BagReader
    exists: bool = False
    received: set[str] = field(default_factory=set)
    messages: int = 0
    _files: dict[str, _Split] = field(default_factory=dict)

    def observe(self, now_s: float) -> SplitChanges:
        """Reads the directory again. Raises nothing."""
        try:
            sizes = self._sizes()
        except (FileNotFoundError, NotADirectoryError):
            existed, self.exists = self.exists, False
            return SplitChanges(gone=existed)
        except OSError as error:
            return SplitChanges(faults={"": f"{self.directory}: {error.strerror or error}"})
        self.exists = True
        for name, size in sizes.items():
            split = self._files.setdefault(name, _Split(now_s))
            split.size = max(split.size, size)
        closed, faults = self._find_closed(sizes)
        empty = self._find_empty(sizes, now_s)
        return SplitChanges(tuple(closed), tuple(empty), faults=faults)

    @property
    def bytes_written(self) -> int:
        """The size of all splits in bytes, with deleted ones; it never shrinks."""
        return sum(split.size for split in self._files.values())

    @property
    def closed_names(self) -> frozenset[str]:
        """The splits that were closed at the last observation."""
        return frozenset(name for name, split in self._files.items() if split.closed)

    def newest_closed(self) -> Path | None:
        """Returns the path of the closed split that began last, of those that are still there."""
        closed = [
            (split.start, name)
            for name, split in self._files.items()
            if split.closed and split.start < MAX_NS
        ]
        paths = (self.directory / name for _, name in sorted(closed, reverse=True))
        return next((path for path in paths if path.exists()), None)

    @property
    def seen(self) -> Collection[str]:
        """The names of all splits that any observation found."""
        return self._files.keys()

    def names(self) -> frozenset[str]:
        """Returns the names of all splits, those observed and those present now."""
        with suppress(OSError):
            return frozenset(self._files).union(self._sizes())
        return frozenset(self._files)

    def _sizes(self) -> dict[str, int]:
        sizes: dict[str, int] = {}
        with os.scandir(self.directory) as entries:
            for entry in entries:
                if bag_kind(entry.name) and entry.is_file(follow_symlinks=False):
                    with suppress(FileNotFoundError):  # retention has just deleted it
                        sizes[entry.name] = entry.stat(follow_symlinks=False).st_size
        return sizes

    def _find_closed(self, names: Iterable[str]) -> tuple[list[str], dict[str, str]]:
        """Returns the newly closed splits, in the order of their start, and faults by file."""
        closed: list[str] = []
        faults: dict[str, str] = {}
        for name in names:
            split, path = self._files[name], self.directory / name
            if split.closed or not split.size:
                continue
            try:
                if self.reader.is_finished(path):
                    split.closed = True
                    closed.append(name)
                    summary = self.reader.summarize(path)
                    split.start = MAX_NS if summary.empty else summary.start
                    self.received.update(topic.topic for topic in summary.topics)
                    self.messages += summary.count
            except BagError as error:
                if split.closed:  # an open file need not be readable yet
                    faults[name] = str(error)
            except OSError as error:
                faults[name] = f"{path}: {error.strerror or error}"
        closed.sort(key=lambda name: (self._files[name].start, name))
        return closed, faults

    def _find_empty(self, sizes: Mapping[str, int], now_s: float) -> list[str]:
        """Returns the splits that are newly known to stay empty."""
        newest_s = max((split.first_seen_s for split in self._files.values()), default=now_s)
        if now_s - newest_s < EMPTY_GRACE_S:
            return []
        empty: list[str] = []
        for name, size in sizes.items():
            split = self._files[name]
            if not size and not split.stays_empty and split.first_seen_s < newest_s:
                split.stays_empty = True
                empty.append(name)
        return empty


class SessionState(Enum):
    """The state of a session."""

    STARTING = auto()
    RECORDING = auto()
    ENDING = auto()
    ENDED = auto()


@dataclass(eq=False, repr=False)
class RecordingSession:
    """One recording: its name, its child process and its splits.

    Attributes:
        is_listed: whether the list of own recordings has its directory.
        is_beside: whether it has not taken over: another session has all of its messages, too.
        has_recorded: whether the child has ever reported that it records.
        grew_at: when the splits last grew (wall time).
        subscribed: topics that the child has subscribed to, whether it receives them or not.
        of_unknown_type: topics of an unknown type, as the child reports them: one of each type.
        of_several_types: topics whose publishers disagree on the type, and when the child last
            reported that, by the monotonic clock: it does so ten times a second.
    """

    name: str
    child: Child
    splits: Splits
    began: ClockReading

    def __post_init__(self) -> None:
        self.state = SessionState.STARTING
        self.is_listed = False
        self.is_beside = False
        self.has_recorded = False
        self.grew_at = self.began.wall
        self.subscribed: set[str] = set()
        self.of_unknown_type: set[str] = set()
        self.of_several_types: dict[str, float] = {}
        self._reported = defaultdict[LineKind, set[tuple[str | None, str]]](set)
        self._last_lines: deque[str] = deque(maxlen=_LAST_LINES)
        self._lost, self._lost_before = Counter[str](), Counter[str]()

    @property
    def is_recording(self) -> bool:
        """Whether the child records, and was not asked to end."""
        return self.state is SessionState.RECORDING

    @property
    def last_output(self) -> str:
        """The last warnings and errors of the child that name no topic, at most 600 characters."""
        return " | ".join(self._last_lines)[-600:]

    def age_s(self, now: ClockReading) -> float:
        """Returns how long ago the recording began, in seconds."""
        return now.monotonic_s - self.began.monotonic_s

    def end(self) -> None:
        """Asks the child to end. A second call does nothing."""
        if self.state in {SessionState.STARTING, SessionState.RECORDING}:
            self.state = SessionState.ENDING
            self.child.end()

    def new_lines(self, now: ClockReading, listed: TopicSelection) -> Sequence[Line]:
        """Returns the lines since the last call that are worth reporting, each warning once.

        Some recorders repeat a warning ten times a second.
        """
        lines: list[Line] = []
        for raw in self.child.take_lines():
            line = parse_line(raw)
            if line.text and line.topic is None and "[INFO]" not in raw:
                self._last_lines.append(line.text)
            if self._note(line, now, listed):
                lines.append(line)
        return lines

    def _note(self, line: Line, now: ClockReading, listed: TopicSelection) -> bool:
        """Notes what a line says; returns whether it is worth reporting."""
        topic = line.topic or ""
        match line.kind:
            case LineKind.OTHER:
                return False
            case LineKind.READY:
                was_recording = self.has_recorded
                self._note_recording()
                return not was_recording
            case LineKind.SUBSCRIBED:
                # Distributions report in different words that they record; all report this.
                self._note_recording()
                # A recorder's own topic does not show that it hears the robot.
                if topic == MESSAGES_LOST:
                    return False
                self.subscribed.add(topic)
                return True
            case LineKind.TOPIC_LOST:
                # The child counts from the beginning of the recording.
                self._lost[topic] = line.count or 0
            case LineKind.UNKNOWN_TYPE:
                self.of_unknown_type.add(topic)
            case LineKind.SEVERAL_TYPES:
                if not listed.matches(topic):
                    return False  # it reports topics that it would not record, too
                self.of_several_types[topic] = now.monotonic_s
        return self._is_new(line)

    def take_lost(self) -> Mapping[str, int]:
        """Returns how many messages of each topic the child has lost since the last call."""
        more, self._lost_before = self._lost - self._lost_before, self._lost.copy()
        return more

    def several_types_since(self, monotonic_s: float) -> set[str]:
        """Returns the topics that the child has reported since then to have several types."""
        return {topic for topic, at_s in self.of_several_types.items() if at_s > monotonic_s}

    def refused_types(self, now: ClockReading) -> set[str]:
        """Returns the topics that the child does not subscribe to because of their types."""
        several = self.several_types_since(now.monotonic_s - REPEATED_S)
        return self.of_unknown_type | several - self.subscribed

    def silent_topics(self) -> frozenset[str]:
        """Returns subscribed topics that no closed split has; none before a split is closed."""
        if not self.splits.closed_names:
            return frozenset()
        return frozenset(self.subscribed - self.splits.received)

    def _note_recording(self) -> None:
        self.has_recorded = True
        if self.state is SessionState.STARTING:
            self.state = SessionState.RECORDING

    def _is_new(self, line: Line) -> bool:
        without_numbers = "".join(char for char in line.text if not char.isdigit())
        key = (line.topic, without_numbers)
        reported = self._reported[line.kind]
        if key in reported or len(reported) >= MAX_DISTINCT:
            return False
        reported.add(key)
        return True


class Required(NamedTuple):
    """An entry of `recording.required`: a name or a glob, and the least messages a second."""

    topic: str
    min_hz: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Orders:
    """What to record, and the parts that recording uses. Durations are in seconds.

    Attributes:
        session_duration_s: how long a recording lasts before the next one takes over.
        min_free_bytes: recording pauses while less is free on the disk.
        start_child: starts the `ros2 bag record` of a recording, given its name and directory.
        simulated: log times come from a simulated clock.
        advice: returns advice on publishers that are subscribed to and not received.
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


@dataclass(eq=False, repr=False)
class RecordingSessions:
    """The sessions of one bag directory.

    Args:
        announce: is called with the name of a recording before anything of it exists.
        interrupted: is called when a recording ended unexpectedly, unless it had not taken over,
            with the wall time at which it last grew, and with how it ended.

    Attributes:
        running: all sessions whose children have not ended, oldest first.
        current: the session that records; None while none does.
        handover: the handover from the current session to the next; None at most times.
        must_rotate: whether a new recording is due: the list of topics or the clock was changed, or
            a handover was given up. It stays until one is started.
        restarts: how often a recording had to be started again.
        heard: the topics that had a message in a closed split.
        closed_s: when a split was last closed, by the monotonic clock.
        grew_s: when a recording last grew by more than its beginning, by the monotonic clock.
    """

    orders: Orders
    announce: Callable[[str], None]
    interrupted: Callable[[Ns, Interruption], None]
    events: EventLog

    def __post_init__(self) -> None:
        self._bag_dir = self.orders.bag_dir
        self.current: RecordingSession | None = None
        self.handover: HandoverTransfer | None = None
        self.must_rotate = False
        self.running: tuple[RecordingSession, ...] = ()
        # By the old recording's name, until that has ended.
        self._completed: dict[str, HandoverTransfer] = {}
        # Pairs of an old and a new recording whose sidecars may have to change.
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

    @property
    def subscribed(self) -> set[str]:
        """The topics that any running child has subscribed to."""
        return set[str]().union(*(session.subscribed for session in self.running))

    def begin(self, now: ClockReading) -> None:
        """Starts a recording; none may be current.

        Raises:
            RecorderError: the recording cannot be started.
        """
        self.current = self._launch(self._name(now), now)
        self.grew_s = now.monotonic_s

    def _name(self, now: ClockReading) -> str:
        return recording_name(now.wall, self._bag_dir, read_deleted(self._bag_dir))

    def begin_handover(self, now: ClockReading) -> None:
        """Starts a recording that is to take over from the current one.

        Raises:
            RecorderError: the recording cannot be started; the current one continues.
        """
        old = self.current
        if old is None or self.handover is not None:
            return
        name = self._name(now)
        try:
            HandoverTransfer.announce(old, name)
            new = self._launch(name, now)
        except (RecorderError, OSError):
            self._unsettled.append((old.splits.directory, self._bag_dir / name))
            self.settle_handovers()
            raise
        new.is_beside = True
        self.handover = HandoverTransfer(old, new, now, self.orders)
        self.events.info("rotation_begun", recording=old.name, next=name)

    def observe(self, now: ClockReading) -> bool:
        """Reads the output and the splits of all children; returns whether a split was closed."""
        has_closed = False
        for session in self.running:
            changes = self._observe_session(session, now)
            self._update_list(session)
            if changes.closed:
                has_closed = True
            if changes.gone and session.state is not SessionState.ENDING:
                name = session.name
                sentence = f"the directory of recording {name} is missing; a new recording starts"
                self.events.fail("recording_vanished", sentence, recording=name)
                self.restarts += 1
                self._go_on_without(session)
        if has_closed:
            self.settle_handovers()
        return has_closed

    def advance_handover(self, now: ClockReading) -> Step:
        """Does the step of the handover that is due; returns COMPLETE or ABANDON at its end."""
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
        """Ends the current session if it never began to record; returns whether it did so."""
        current = self.current
        if current is None or current.is_recording or current.age_s(now) < READY_TIMEOUT_S:
            return False
        said = current.last_output or "it prints no reason"
        sentence = f"ros2 bag record does not begin to record: {said}"
        self.events.fail("recorder_not_ready", sentence, recording=current.name)
        self._note_interruption(current, "hung")
        current.end()
        self.current = None
        return True

    def collect_ended(self, now: ClockReading) -> int:
        """Finalizes sessions that have ended; returns how many died.

        Sessions that are ending are signalled again. If the current one died during a handover, the
        new one becomes the current one.
        """
        running, deaths = self.running, 0
        # The newest first, so that no dead one takes over.
        for session in reversed(running):
            is_ending = session.state is SessionState.ENDING
            status = session.child.end() if is_ending else session.child.exit_status()
            if status is None:
                continue
            if not is_ending:
                deaths += 1
                self._report_output(session, now)
                sentence = describe_death(status, session.last_output)
                lived_s = session.age_s(now)
                self.events.fail("recorder_died", sentence, recording=session.name, lived_s=lived_s)
                self._note_interruption(session, "died")
                self._go_on_without(session)
            elif session.has_recorded and status == -signal.SIGKILL:
                sentence = (
                    f"the ros2 bag record of {session.name} hung: it did not end when it was asked "
                    "to, and was killed (SIGKILL); what it had not written yet is lost"
                )
                self.events.fail("recorder_hung", sentence, recording=session.name)
                self._note_interruption(session, "hung")
            self._finalize(session, now)
        if self.running != running:
            self.settle_handovers()
        return deaths

    def _note_interruption(self, session: RecordingSession, how: Interruption) -> None:
        self.restarts += 1
        if not session.is_beside:
            self.interrupted(session.grew_at, how)

    def end_all(self, now: ClockReading) -> None:
        """Asks all sessions to end; `collect_ended` finalizes them later."""
        handover = self.handover
        if handover is not None:
            with self._reporting_failures(handover.old):
                # An incomplete one is settled later: the old recording counts up to its end.
                if handover.complete(now):
                    self._completed[handover.old.name] = handover
                    handover.new.is_beside = False
            self._unsettled.append(handover.directories)
        for session in self.running:
            session.end()
        self.current, self.handover = None, None

    def stop(self, now: ClockReading) -> None:
        """Ends all sessions, and waits for them as long as the children's patience lasts."""
        self.end_all(now)
        for child in end_all([session.child for session in self.running]):
            self.events.fail("recorder_not_ended", f"process {child.pid} cannot be ended")
        self.collect_ended(now)
        self.running = ()

    def _launch(self, name: str, now: ClockReading) -> RecordingSession:
        self.orders.own.begin(name)
        self.announce(name)
        directory = self._bag_dir / name
        try:
            child = self.orders.start_child(name, directory)
        except OSError as error:
            raise RecorderError(f"ros2 bag record cannot be started: {error}") from error
        self.events.info("recorder_started", recording=name, pid=child.pid)
        session = RecordingSession(name, child, Splits(directory, self.orders.reader), now)
        self.running += (session,)
        self.must_rotate = False
        return session

    def _update_list(self, session: RecordingSession) -> None:
        """Lists the directory and the splits that the child made; tried again after a fault."""
        with self.events.lasting_if_refused("recording_not_listed", session.name):
            session.is_listed = session.is_listed or self.orders.own.complete(session.name)
            # If the directory is missing, another disk may lie there.
            if session.is_listed and session.splits.exists:
                has_ended = session.state is SessionState.ENDED
                self.orders.own.note_splits(session.name, session.splits.seen, ended=has_ended)

    def _observe_session(self, session: RecordingSession, now: ClockReading) -> SplitChanges:
        """Reads the output and the splits of one child, and reports on them."""
        self._report_output(session, now)
        changes = self._observe_growth(session, now)
        self._learn_closed(session, changes.closed, now)
        for name in changes.empty:
            file = f"{session.name}/{name}"
            sentence = f"{file} is empty although a newer split was started"
            self.events.fail("split_empty", sentence, recording=session.name)
        self.events.lasting_faults("unreadable", session.name, changes.faults)
        return changes

    def _observe_growth(self, session: RecordingSession, now: ClockReading) -> SplitChanges:
        """Reads the splits of one child, and notes when they grew."""
        before = session.splits.bytes_written
        changes = session.splits.observe(now.monotonic_s)
        if session.splits.bytes_written > before:
            session.grew_at = now.wall
            # A recording that ends grows by the end of its file.
            if session.is_recording and session.age_s(now) >= SETTLE_S:
                self.grew_s = now.monotonic_s
        return changes

    def _learn_closed(
        self, session: RecordingSession, closed: Sequence[str], now: ClockReading
    ) -> None:
        """Counts what newly closed splits have received and lost, and flushes them."""
        of_types = session.several_types_since(self.closed_s)
        for name in closed:
            self.events.info("split_closed", recording=session.name, file=name)
            self.orders.reception.learn(session.name, session.splits.directory / name, of_types)
        if closed or session.state is SessionState.ENDED:
            # After `learn`: what a split itself shows to be missing is counted first.
            lived = session.began.wall, now.wall
            for topic, count in session.take_lost().items():
                self.orders.reception.note_lost(session.name, topic, count, lived)
        if closed:
            self.heard |= session.splits.received
            self.closed_s = now.monotonic_s
            self._flush_later(session, session.splits.directory, closed)

    def _report_output(self, session: RecordingSession, now: ClockReading) -> None:
        lines = session.new_lines(now, self.orders.topics.selection)
        self.events.report_output(session.name, lines)
        for line in lines:
            if line.kind is LineKind.QOS_REFUSED and line.topic is not None:
                # The line names one policy that does not fit; another line names the other.
                weak = "DURABILITY" not in line.text
                self.orders.reception.note_refused(session.name, line.topic, best_effort=weak)

    def _flush_later(
        self, session: RecordingSession, directory: Path, names: Sequence[str]
    ) -> None:
        def flush() -> None:
            for fault in flush_bags(directory, names):
                self.events.warn("not_flushed", fault, recording=session.name)

        self.orders.background.add("flush", flush)

    def _take_over(self, handover: HandoverTransfer, now: ClockReading) -> None:
        if handover.missing:
            missing = ", ".join(sorted(handover.missing))
            self.events.remark(
                "rotated_without",
                f"the new recording does not subscribe to {missing} yet: their publishers have "
                "gone, or were not discovered in time",
                recording=handover.new.name,
            )
        handover.complete(now)
        self._completed[handover.old.name] = handover
        self._unsettled.append(handover.directories)
        handover.old.end()
        self._make_current(handover.new)
        self.events.info("rotated", recording=handover.old.name, next=handover.new.name)

    def _make_current(self, session: RecordingSession) -> None:
        session.is_beside = False
        self.current, self.handover = session, None

    def _abandon(self, handover: HandoverTransfer) -> None:
        """Ends the new session of a handover; the old one continues."""
        self.handover, self.must_rotate = None, True
        self._unsettled.append(handover.directories)
        with self._reporting_failures(handover.old):
            give_up(*handover.directories)
        handover.new.end()

    def _go_on_without(self, session: RecordingSession) -> None:
        """Continues without a session, with the other one of its handover if there is one."""
        handover = self.handover
        if handover is not None and session is handover.new:
            self._abandon(handover)
        elif session is self.current:
            session.end()
            self.current = None
            if handover is not None:
                self._make_current(handover.new)
                self._unsettled.append(handover.directories)
                self.settle_handovers()

    def recover(self) -> None:
        """Settles the handovers that are still open; the first call finds those of an earlier run.

        Raises:
            OSError: the bag directory cannot be listed.
        """
        if not self._is_recovered:
            self._unsettled = unsettled_handovers(self._bag_dir)
            self._is_recovered = True
        self.settle_handovers()

    def settle_handovers(self) -> None:
        """Completes and compares the handovers whose recordings have ended.

        A failure, as on a full disk, is reported, and the next call tries again.
        """
        running = {session.name for session in self.running}
        for old, new in [*self._unsettled]:
            pair, name = f"{old.name}/{new.name}", old.name
            with self.events.lasting_if_refused("handover_not_settled", pair, recording=name):
                if settle_handover(old, new, self.orders.reader, running):
                    self._unsettled.remove((old, new))

    def _finalize(self, session: RecordingSession, now: ClockReading) -> None:
        """Notes the last splits of an ended session, makes them durable and reports on them."""
        session.state = SessionState.ENDED
        self.running = tuple(other for other in self.running if other is not session)
        self._observe_session(session, now)
        handover = self._completed.pop(session.name, None)
        if handover is not None:
            with self._reporting_failures(session):
                handover.add_late_splits()
        self._update_list(session)
        self.events.note_end(session.name)
        splits = session.splits
        if remove_if_empty(splits.directory):
            self.events.info("recording_empty", recording=session.name)
        self._flush_later(session, splits.directory, (METADATA_FILE,))
        self._flush_later(session, self._bag_dir, ())
        self._ended_bytes += splits.bytes_written
        self.events.info(
            "recording_ended",
            recording=session.name,
            splits=len(splits.closed_names),
            messages=splits.messages,
            bytes=splits.bytes_written,
            lived_s=round(session.age_s(now), 3),
        )

    @contextmanager
    def _reporting_failures(self, session: RecordingSession) -> Iterator[None]:
        """Reports an error of the session's handover, and continues after the block."""
        try:
            yield
        except (EpisodicError, OSError) as error:
            self.events.fail("rotation_failed", str(error), recording=session.name)
