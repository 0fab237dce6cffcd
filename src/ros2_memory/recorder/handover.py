"""One recording takes over from another without losing or doubling a message.

The new recorder is started beside the old one. It waits, but not for ever, until it has subscribed
to all topics of the old one. Then both run for `BOTH_S`, since a new subscriber receives nothing
before the publishers have discovered it. The cut lies in the middle of that time. Messages
published around it are in both recordings, so a message in transit, or a clock that is off by less
than a second, loses and doubles nothing.

Each sidecar (`handover.json`) is written before it matters. The old recording names the new one
before that is started, the new one is marked as pending as soon as it exists, and the cut is
written to the new one first. So after a crash the pair of sidecars can be settled: the old
recording counts up to its end, and the new one from there.

If a recorder stalled, messages may be in the other recording alone, where the cut hides them. So
the files on both sides are compared once they are closed. Topic, publish time and payload identify
a message. It counts as often as in the recording that holds it most often. The sidecars then list
the messages that the cut gets wrong, which are few or none.

Files that `recording.exclude_when` holds back count as open: their excluded messages must not be
listed. The cut alone decides on messages without a publish time of their own (it is 0, or equal to
the log time). It does not apply to latched channels, whose repeats queries recognise.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, replace
from enum import Enum, auto
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.handover_file import (
    LOG_CLOCK_NOTE,
    Counting,
    CutClock,
    Handover,
    MessageList,
    Overlap,
    handover_to_change,
    message_id,
    read_handover,
    write_handover,
    write_handovers,
)
from ros2_memory.bag_dir.layout import bags_in
from ros2_memory.bag_dir.state_files import read_withheld
from ros2_memory.core.directories import is_folder
from ros2_memory.core.errors import BagError, BagUnreachableError, RecorderError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import enclosing
from ros2_memory.core.timebase import MIN_NS, NS_PER_MS, NS_PER_S, Ns, Span
from ros2_memory.recorder.policies import ClockReading, set_back
from ros2_memory.storage.base import BagReader, Record, errors_as_items

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.recorder.sessions import Orders, RecordingSession

SUBSCRIBE_TIMEOUT_S: Final = 20.0
READY_TIMEOUT_S: Final = 120.0
"""A recorder that has not started to record after this time is given up."""
BOTH_S: Final = 5.0
"""Longer than the 3 s after which Fast DDS sends discovery again that was lost on the way."""
LATE_MESSAGES_NS: Final[Ns] = 30 * NS_PER_S
"""The old recorder may still receive messages for so long after it was asked to end."""
JITTER_NS: Final[Ns] = 100 * NS_PER_MS
"""The log times of one message in two recordings differ by less."""
LONGEST_NS: Final[Ns] = 60 * NS_PER_S
"""Two recorders never run side by side for longer, even if a clock that was set says so."""
STALL_NS: Final[Ns] = 5 * NS_PER_S
"""A recorder may log a message so much later than the other one."""
FRESH_NS: Final[Ns] = NS_PER_S
"""A latched message that is logged later after its publication is a repeat."""
SAMPLE: Final = 2000
"""So many messages show whether publish times differ from log times."""
MOST_LISTED: Final = 10_000
"""A sidecar lists no more: then all messages count, and queries leave out duplicates."""

_log = get_logger(__name__)


def pending_sidecar(old_name: str) -> Handover:
    """Returns the sidecar of a recording that has begun to take over; it does not count yet."""
    return Handover(state=Counting.PENDING, previous=old_name)


def void_sidecar(old_name: str) -> Handover:
    """Returns the sidecar of a recording that did not take over: the old one went on."""
    return Handover(state=Counting.VOID, previous=old_name, compared=False)


def announcing_sidecar(old: Handover, new_name: str | None) -> Handover:
    """Returns the old sidecar with the name of the recording that is about to take over.

    None withdraws the name: the new recording did not take over.
    """
    return replace(old, next=new_name, counts_until=None, end=None)


def _notes_on(clock: CutClock) -> tuple[str, ...]:
    return (LOG_CLOCK_NOTE,) if clock is CutClock.LOG else ()


class Step(Enum):
    """The next step of a handover."""

    WAIT = auto()
    COMPLETE = auto()
    # The new recorder does not begin; or the clock was set back, so that no single cut separates
    # earlier messages from later ones.
    ABANDON = auto()


@dataclass(eq=False, repr=False)
class HandoverTransfer:
    """A handover from a session that records to one that takes over.

    Args:
        began: the time just before the new recorder was started.
    """

    old: RecordingSession
    new: RecordingSession
    began: ClockReading
    orders: Orders

    def __post_init__(self) -> None:
        self.directories = self.old.splits.directory, self.new.splits.directory
        self._last = self.began
        self._both_since: ClockReading | None = None
        self._marked = False
        self._closed_before = self.old.splits.closed_names

    @staticmethod
    def announce(old: RecordingSession, new_name: str) -> None:
        """Writes the name of the recording that is about to take over into the old sidecar.

        Raises:
            RecorderError: the sidecar cannot be written, or an earlier handover of the old
                recording, which was given up, is not settled yet.
        """
        directory = old.splits.directory
        before = handover_to_change(directory)
        if before.next is not None:
            raise RecorderError(f"{directory}: its handover to {before.next} is not settled yet")
        write_handover(directory, announcing_sidecar(before, new_name))

    @property
    def missing(self) -> frozenset[str]:
        """The listed topics that only the old recorder has subscribed to so far.

        The new one subscribes to none of several types, one of which may be the old one's alone.
        """
        is_listed, new = self.orders.topics.selection.matches, self.new
        others = self.old.subscribed - new.subscribed - new.of_several_types.keys()
        return frozenset(filter(is_listed, others))

    def advance(self, now: ClockReading) -> Step:
        """Returns the step that is due. Call it several times a second.

        Raises:
            RecorderError: a sidecar cannot be written.
        """
        if not self._marked and self.new.splits.exists:
            write_handover(self.new.splits.directory, pending_sidecar(self.old.name))
            self._marked = True
        before, self._last = self._last, now
        if set_back(before, now):
            return Step.ABANDON
        is_ready = self._marked and self.new.is_recording
        age_s = now.monotonic_s - self.began.monotonic_s
        if self.missing and age_s < SUBSCRIBE_TIMEOUT_S:
            # A publisher may appear while both run. Until the new recorder has subscribed, its
            # messages are in the old recording alone, and must not lie after the cut.
            self._both_since = None
        elif self._both_since is None and is_ready:
            self._both_since = now
        if self._both_since is None:
            return Step.WAIT if is_ready or age_s < READY_TIMEOUT_S else Step.ABANDON
        is_over = now.monotonic_s - self._both_since.monotonic_s >= BOTH_S
        return Step.COMPLETE if is_over else Step.WAIT

    def complete(self, now: ClockReading) -> bool:
        """Writes the cut; returns False if both recorders do not receive messages yet.

        The cut lies in the middle of the time in which they did. None is written if a simulated
        clock stamps both times of a message: the old recording counts up to its end.

        Raises:
            RecorderError: a sidecar cannot be written.
            BagUnreachableError: the disk fails.
        """
        if self._both_since is None:
            return False
        old, new = self.directories
        newest = self.old.splits.newest_closed()
        clock = cut_clock(newest, self.orders.reader) if newest else CutClock.PUBLISH
        if self.orders.simulated and clock is CutClock.LOG:
            return True
        both, ended = self._both_since.wall, now.wall
        cut, notes, before = (both + ended) // 2, _notes_on(clock), handover_to_change(old)
        begin = Overlap(self.began.wall, ended, tuple(sorted(self.new.splits.names())))
        end = Overlap(both, ended + LATE_MESSAGES_NS, tuple(sorted(self._old_files())))
        if self.orders.simulated:
            begin, end = Overlap(None, None, begin.files), Overlap(None, None, end.files)
        after = Handover(
            clock=clock,
            previous=self.old.name,
            counts_from=cut,
            begin=begin,
            notes=notes,
            compared=False,
        )
        before = replace(
            before,
            clock=clock,
            next=self.new.name,
            counts_until=cut,
            end=end,
            notes=tuple(dict.fromkeys((*before.notes, *notes))),
        )
        write_handovers({new: after, old: before})
        return True

    def add_late_splits(self) -> None:
        """Adds the splits that the old recorder opened after the cut, while it was ending.

        Raises:
            RecorderError: the sidecar cannot be written.
        """
        directory, _ = self.directories
        handover = handover_to_change(directory)
        if handover.end is not None:
            files = tuple(sorted(self._old_files().union(handover.end.files)))
            write_handover(directory, replace(handover, end=replace(handover.end, files=files)))

    def _old_files(self) -> frozenset[str]:
        return self.old.splits.names() - self._closed_before


def unsettled_handovers(bag_dir: Path) -> list[tuple[Path, Path]]:
    """Returns each handover that an earlier run left unsettled: the old and the new recording.

    Raises:
        OSError: the bag directory cannot be listed.
    """
    pairs: list[tuple[Path, Path]] = []
    for directory in sorted(filter(is_folder, bag_dir.iterdir())):
        handover = read_handover(directory).handover
        if handover.next is not None and handover.counts_until is None:
            pairs.append((directory, bag_dir / handover.next))
        if handover.previous is not None:
            previous = bag_dir / handover.previous
            # Where retention deleted the previous one, a recording that waits would never count.
            waits = handover.compared is False if is_folder(previous) else handover.hides_all
            if waits:
                pairs.append((previous, directory))
    return pairs


def settle_handover(old: Path, new: Path, reader: BagReader, running: Collection[str] = ()) -> bool:
    """Completes the handover between two recordings that have ended, and compares them.

    Args:
        old: the recording that handed over.
        new: the recording that took over.
        reader: a reader that ignores sidecars.
        running: the names of the recordings that are being written.

    Returns:
        True if nothing is left to do; False while a file that may matter is being written.

    Raises:
        RecorderError: a sidecar cannot be read or written.
        BagError: the disk cannot show the messages at present: they must not count as missing.
        OSError: the disk fails.
    """
    if not is_folder(old):
        if is_folder(new) and handover_to_change(new).hides_all:
            write_handover(new, Handover())
        return True
    begun = handover_to_change(old)
    if begun.next == new.name and begun.counts_until is None:
        if old.name not in running:
            _write_cut(old, new, reader)
            _log.info("handover_settled", recording=old.name, next=new.name)
        elif new.name in running:
            return False
        else:
            give_up(old, new)
    return not is_folder(new) or _compare(old, new, reader, running)


def give_up(old: Path, new: Path) -> None:
    """Marks a new recording as void: it did not take over, and the old one goes on.

    Raises:
        RecorderError: a sidecar cannot be written.
        OSError: the disk does not tell whether a recording exists.
    """
    if is_folder(new):
        write_handover(new, void_sidecar(old.name))
    if is_folder(old):
        write_handover(old, announcing_sidecar(handover_to_change(old), None))


def _write_cut(old: Path, new: Path, reader: BagReader) -> None:
    """Writes the cut of a handover that was interrupted, after the old recording has ended.

    The new recording may itself have handed over since: its own end in the sidecar stays.
    """
    before = handover_to_change(old)
    after = handover_to_change(new) if is_folder(new) else void_sidecar(old.name)
    if after.state is Counting.COUNTS and after.counts_from is not None:
        # The crash came between the two sidecars of a complete handover.
        start = None if after.begin is None else after.begin.log_from
        bags = readable_bags(old, reader).items()
        files = tuple(name for name, bag in bags if start is None or bag.end >= start)
        end = Overlap(start, None, files)
        write_handover(old, replace(before, counts_until=after.counts_from, end=end))
        return
    if after.state is not Counting.VOID:
        newest = _newest_times(old, reader)
        if newest is not None:
            published, logged = newest
            cut = published + 1
            begun = replace(after, previous=old.name, counts_from=cut)
            write_handover(new, _with_begin(begun, new, logged, reader))
            write_handover(old, replace(before, counts_until=cut))
            return
        counts = replace(after, state=Counting.COUNTS, previous=old.name, compared=True)
        write_handover(new, counts)
    write_handover(old, announcing_sidecar(before, None))


def _with_begin(begun: Handover, new: Path, logged: Ns, reader: BagReader) -> Handover:
    """Returns the sidecar of a new recording with the files and log times where its cut applies.

    Args:
        begun: the sidecar with the cut.
        new: the new recording.
        logged: the last log time of the old recording (ns).
        reader: a reader that ignores sidecars.
    """
    bags = readable_bags(new, reader)
    first = min((bag.start for bag in bags.values()), default=logged)
    until = min(logged + JITTER_NS, first + LONGEST_NS)
    later = {name for name, bag in bags.items() if bag.start >= until}
    # A file that cannot be read yet is still being written.
    names = tuple(path.name for path in bags_in(new) if path.name not in later)
    clock = cut_clock(new / next(iter(bags)), reader) if bags else CutClock.PUBLISH
    return replace(
        begun,
        state=Counting.COUNTS,
        clock=clock,
        begin=Overlap(None, until, names),
        notes=_notes_on(clock),
        compared=False,
    )


def _newest_times(recording: Path, reader: BagReader) -> tuple[Ns, Ns] | None:
    """Returns the newest publish time and log time in the last bag; None without a message."""
    bags = readable_bags(recording, reader)
    if not bags:
        return None
    last = recording / max(bags, key=lambda name: bags[name].end)
    published = logged = MIN_NS
    for record in _readable_records(_unlatched_records(last, reader)):
        # A publish time of 0 means that there is none.
        published = max(published, record.publish_time or record.log_time)
        logged = max(logged, record.log_time)
    return None if logged == MIN_NS else (published, logged)


def cut_clock(bag: Path, reader: BagReader) -> CutClock:
    """Returns LOG if all publish times in a bag file are 0 or equal to the log times.

    PUBLISH also for an empty or damaged file.

    Raises:
        BagUnreachableError: the disk fails.
    """
    try:
        records = list(islice(_unlatched_records(bag, reader), SAMPLE))
    except BagUnreachableError:
        raise
    except BagError:
        return CutClock.PUBLISH
    if records and not any(map(_has_publish_time, records)):
        return CutClock.LOG
    return CutClock.PUBLISH


def _has_publish_time(record: Record) -> bool:
    return record.publish_time not in {0, record.log_time}


def _unlatched_records(bag: Path, reader: BagReader) -> Iterator[Record]:
    """Yields messages of topics that are not latched: latched ones may be published long before."""
    topics = [topic.topic for topic in reader.summarize(bag).topics if not topic.latched]
    return reader.records(bag, topics, TimeWindow.everything())


class _Copy(NamedTuple):
    """A message in a file of a recording, and whether the cut counts it there."""

    file: str
    topic: str
    message_id: str
    counts: bool
    has_publish_time: bool


class _Side(NamedTuple):
    """One of the two recordings.

    Attributes:
        cut: the part of the sidecar that is about these two recordings.
        bags: the bags that are not empty, by file name.
    """

    reader: BagReader
    recording: Path
    cut: Handover
    bags: dict[str, BagSummary]

    @property
    def start(self) -> Ns:
        """The first log time."""
        return min(bag.start for bag in self.bags.values())

    @property
    def end(self) -> Ns:
        """The last log time."""
        return max(bag.end for bag in self.bags.values())

    def hidden(self) -> Iterator[Span]:
        """Yields the spans of log time, both ends included, in which the cut may hide messages."""
        for name, bag in self.bags.items():
            rule = self.cut.rule(name)
            for exclusion in () if rule is None else rule.exclusions:
                first = max(bag.start, exclusion.logged.start)
                last = min(bag.end, exclusion.logged.stop)
                if first <= last:
                    yield first, last

    def copies(
        self, window: TimeWindow, *, latched: bool
    ) -> defaultdict[tuple[str, str], Counter[_Copy]]:
        """Returns how often the recording holds each message of a window, by topic and id."""
        copies: defaultdict[tuple[str, str], Counter[_Copy]] = defaultdict(Counter)
        for file, bag in self.bags.items():
            if not window.overlaps(bag.start, bag.end):
                continue
            topics, rule = [topic.topic for topic in bag.topics], self.cut.rule(file)
            records = self.reader.records(self.recording / file, topics, window)
            for record in _readable_records(records):
                is_late = record.log_time - record.publish_time > FRESH_NS
                if record.channel.latched and (is_late or not latched):
                    continue
                topic = record.channel.topic
                identity = message_id(record.publish_time, record.payload)
                counts = rule is None or rule.counts(record)
                copy = _Copy(file, topic, identity, counts, _has_publish_time(record))
                copies[topic, identity][copy] += 1
        return copies


def _compare(old: Path, new: Path, reader: BagReader, running: Collection[str]) -> bool:
    """Compares two recordings, and lists in their sidecars the messages that the cut gets wrong.

    Returns:
        False while a file that may matter is being written.
    """
    before, after = handover_to_change(old), handover_to_change(new)
    if after.compared is not False or after.previous != old.name:
        return True
    withheld, is_void = read_withheld(old.parent), after.state is Counting.VOID
    written = {
        path for path in (old, new) if path.name in running or withheld.holds_some(path.name)
    }
    if after.state is Counting.PENDING or (new if is_void else old) in written:
        return False
    is_next = before.next == new.name
    old_cut = Handover(counts_until=before.counts_until, end=before.end) if is_next else Handover()
    new_cut = Handover(state=after.state, counts_from=after.counts_from, begin=after.begin)
    old_side = _Side(reader, old, old_cut, readable_bags(old, reader, only_closed=old in written))
    new_side = _Side(reader, new, new_cut, readable_bags(new, reader, only_closed=new in written))
    window = _compared_window(old_side, new_side)
    lasting = old_side if is_void else new_side
    if lasting.recording in written and (
        not lasting.bags or (window is not None and lasting.end < window.stop - 1)
    ):
        return False
    in_old, in_new = _miscounted(old_side, new_side, window, latched=is_void)
    count = len(in_old) + len(in_new)
    if count > MOST_LISTED:
        # Without a cut all messages of both recordings count.
        old_sidecar = replace(before, end=None) if is_next else before
        new_sidecar = replace(after, state=Counting.COUNTS, begin=None)
    else:
        old_sidecar, new_sidecar = _with_listed(before, in_old), _with_listed(after, in_new)
    changed = {new: replace(new_sidecar, compared=True)}
    if old_sidecar != before:
        changed[old] = old_sidecar
    write_handovers(changed)
    if count:
        _log.info("handover_compared", recording=old.name, next=new.name, messages=count)
    return True


def _miscounted(
    old: _Side, new: _Side, window: TimeWindow | None, *, latched: bool
) -> tuple[list[_Copy], list[_Copy]]:
    """Returns the messages of both recordings in a window that the cut gets wrong.

    `latched` includes latched messages. No cut applies to them, but a void recording hides them.
    """
    of_old: list[_Copy] = []
    of_new: list[_Copy] = []
    if window is None:
        return of_old, of_new
    copies_in_old, copies_in_new = (side.copies(window, latched=latched) for side in (old, new))
    for message in copies_in_old.keys() | copies_in_new.keys():
        in_old, in_new = copies_in_old[message], copies_in_new[message]
        if not all(copy.has_publish_time for copy in (*in_old, *in_new)):
            continue  # the cut alone decides
        # Where both hold it as often, the cut decides.
        is_old = _weight(in_old) >= _weight(in_new)
        of_old += [copy for copy in in_old if copy.counts is not is_old]
        of_new += [copy for copy in in_new if copy.counts is is_old]
    return of_old, of_new


def _compared_window(old: _Side, new: _Side) -> TimeWindow | None:
    """Returns the log times in which messages are compared; None if no message is hidden.

    After a clock was set back, the log times that both recordings have may be hours: they ran side
    by side in the first of these alone.
    """
    spans = [*old.hidden(), *new.hidden()]
    if old.bags and new.bags:
        first = max(old.start, new.start)
        last = min(old.end, new.end, first + LONGEST_NS)
        if first <= last:
            spans.append((first, last))
    if not spans:
        return None
    first, last = enclosing(spans)
    return TimeWindow(first - STALL_NS, last + STALL_NS + 1)


def _weight(copies: Counter[_Copy]) -> tuple[int, int]:
    """Returns how often a recording holds a message, and how often the cut counts it there."""
    counted = sum(times for copy, times in copies.items() if copy.counts)
    return copies.total(), counted


def _with_listed(handover: Handover, miscounted: Sequence[_Copy]) -> Handover:
    """Returns a sidecar that lists these messages as well."""
    counted = [copy for copy in miscounted if copy.counts]
    hidden = [copy for copy in miscounted if not copy.counts]
    return replace(
        handover,
        also_counts=_merged(handover.also_counts, hidden),
        counts_elsewhere=_merged(handover.counts_elsewhere, counted),
    )


def _merged(listed: MessageList, added: Sequence[_Copy]) -> MessageList:
    """Returns the list with more messages, sorted."""
    messages: defaultdict[tuple[str, str], set[str]] = defaultdict(set)
    for file, topics in listed.items():
        for topic, message_ids in topics.items():
            messages[file, topic].update(message_ids)
    for copy in added:
        messages[copy.file, copy.topic].add(copy.message_id)
    merged: MessageList = {}
    for file, topic in sorted(messages):
        merged.setdefault(file, {})[topic] = tuple(sorted(messages[file, topic]))
    return merged


def _readable_records(records: Iterator[Record]) -> Iterator[Record]:
    """Yields the messages that can be read.

    Raises:
        BagUnreachableError: the disk fails.
    """
    for record in errors_as_items(records):
        if isinstance(record, BagUnreachableError):
            raise record
        if not isinstance(record, BagError):
            yield record


def readable_bags(
    recording: Path, reader: BagReader, *, only_closed: bool = False
) -> dict[str, BagSummary]:
    """Returns the summaries of the bags that can be read and are not empty, by file name.

    `only_closed` leaves out bags that are open or held back.

    Raises:
        OSError: the recording cannot be listed.
        BagUnreachableError: the disk fails.
    """
    summaries: dict[str, BagSummary] = {}
    withheld = read_withheld(recording.parent)
    for path in bags_in(recording):
        try:
            if only_closed and (
                withheld.holds(recording.name, path.name) or not reader.is_finished(path)
            ):
                continue
            summary = reader.summarize(path)
        except BagUnreachableError:
            raise
        except BagError:
            continue
        if not summary.empty:
            summaries[path.name] = summary
    return summaries
