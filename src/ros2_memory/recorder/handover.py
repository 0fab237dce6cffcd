"""One recording takes over from another without losing or doubling a message.

The new recorder is started beside the old one, and waits until it has subscribed to all topics of
the old one, but not for ever, since a publisher may be gone. Then both run for `BOTH_S`, since who
has subscribed receives nothing before the publishers discovered that. The cut lies in the middle of
those: messages published around it are in both recordings, so that a message in transit, or a clock
that is off by less than a second, loses and doubles nothing.

Each sidecar (`handover.json`) is written before it can matter: the old recording names the new one
before that is started, the new one is marked as not counting as soon as it exists, and the cut is
written to the new one first. So a crash leaves a pair of sidecars that can be settled: the old
recording counts up to its end, and the new one from there.

A recorder that stalled meanwhile lost what was published: where the recording that a message
belongs to had stalled, the message is in the other alone, and the cut hides it. So the files on
both sides are compared once they are closed: a message is the same by topic, publish time and
payload, and counts as often as in the recording that holds it most often. The sidecars then list
the messages for which the cut is not the answer; mostly there are none.

What `recording.exclude_when` holds back counts as still being written: what is excluded of it must
not be listed. The cut alone decides where messages have no publish time of their own (it is 0, or
the log time), and not at all on latched channels, whose repeats are recognised in queries.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, replace
from enum import Enum, auto
from itertools import groupby, islice
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

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
from ros2_memory.bag_dir.state_files import NOTHING_WITHHELD, read_withheld
from ros2_memory.core.directories import is_folder
from ros2_memory.core.errors import BagError, BagUnreachableError, RecorderError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import enclosing
from ros2_memory.core.timebase import MIN_NS, NS_PER_MS, NS_PER_S, Ns, Span
from ros2_memory.recorder.policies import ClockReading, set_back
from ros2_memory.storage.base import BagReader, Closing, Record, or_errors

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.recorder.sessions import Orders, RecordingSession

SUBSCRIBE_TIMEOUT_S: Final = 20.0
READY_TIMEOUT_S: Final = 120.0
"""A recorder that has not started to record after this time is given up."""
BOTH_S: Final = 5.0
"""Longer than the 3 s after which Fast DDS sends discovery again that was lost on the way."""
LATE_MESSAGES_NS: Final[Ns] = 30 * NS_PER_S
"""How long the old recorder may still receive messages after it was asked to end."""
JITTER_NS: Final[Ns] = 100 * NS_PER_MS
"""Two recorders differ by less than this in when they received one message."""
LONGEST_NS: Final[Ns] = 60 * NS_PER_S
"""Two recorders never run side by side for longer, whatever a clock that was set shows."""
STALL_NS: Final[Ns] = 5 * NS_PER_S
"""How much later than the other one a recorder may log a message."""
FRESH_NS: Final[Ns] = NS_PER_S
"""A latched message logged later than this after it was published was received before."""
SAMPLE: Final = 2000
"""Messages read to find out whether publish times differ from log times."""
MOST_LISTED: Final = 10_000
"""More messages are not listed in a sidecar: then all count, and queries leave out duplicates."""

_log = get_logger(__name__)


def pending(old_name: str) -> Handover:
    """Returns the new sidecar as soon as its directory exists: until the cut it does not count."""
    return Handover(state=Counting.PENDING, previous=old_name)


def void(old_name: str) -> Handover:
    """Returns the sidecar of a new recording that did not take over: the old one went on."""
    return Handover(state=Counting.VOID, previous=old_name, compared=False)


def intended(old: Handover, new_name: str | None) -> Handover:
    """Returns the old sidecar before the new recording is started, as a crash may come any time.

    None in place of its name withdraws it: the new recording did not take over.
    """
    return replace(old, next=new_name, counts_until=None, end=None)


def complete_sidecars(
    old: Handover,
    old_name: str,
    new_name: str,
    *,
    began: Ns,
    both: Ns,
    ended: Ns,
    old_files: Collection[str],
    new_files: Collection[str],
    simulated: bool,
    clock: CutClock,
) -> tuple[Handover, Handover]:
    """Returns the sidecars of the old and of the new recording after a complete handover.

    The new one must be written first.

    Args:
        old: the present sidecar of the old recording.
        old_name: the old recording.
        new_name: the new recording.
        began: when the new recorder was started.
        both: since when both recorders received.
        ended: until when they did; the cut lies between.
        old_files: the bag files of the old recording that were open at any time in it.
        new_files: the bag files of the new recording so far.
        simulated: whether log times are those of a simulated clock.
        clock: whether publish times differ from log times.
    """
    cut, notes = (both + ended) // 2, (LOG_CLOCK_NOTE,) * (clock is CutClock.LOG)
    begin = Overlap(began, ended, tuple(sorted(new_files)))
    end = Overlap(both, ended + LATE_MESSAGES_NS, tuple(sorted(old_files)))
    if simulated:
        begin, end = Overlap(None, None, begin.files), Overlap(None, None, end.files)
    all_notes = tuple(dict.fromkeys((*old.notes, *notes)))
    return (
        replace(old, clock=clock, next=new_name, counts_until=cut, end=end, notes=all_notes),
        Handover(
            clock=clock,
            previous=old_name,
            counts_from=cut,
            begin=begin,
            notes=notes,
            compared=False,
        ),
    )


class Step(Enum):
    """What a handover needs next."""

    WAIT = auto()
    COMPLETE = auto()
    # The new recorder does not begin, or the clock was set back: then no single cut separates the
    # messages published before it from those published after it.
    ABANDON = auto()


@dataclass(eq=False, repr=False)
class HandoverTransfer:
    """A handover from one running session to another.

    Args:
        old: the session that records.
        new: the session that takes over.
        began: the time just before the new recorder was started.
    """

    old: RecordingSession
    new: RecordingSession
    began: ClockReading
    orders: Orders

    def __post_init__(self) -> None:
        """Sets what is known at the beginning."""
        self.directories = self.old.splits.directory, self.new.splits.directory
        self._last = self.began
        # Since when both record.
        self._both_since: ClockReading | None = None
        self._marked = False
        self._closed_before = self.old.splits.closed_names

    @staticmethod
    def announce(old: RecordingSession, new_name: str) -> None:
        """Writes the name of the new recording, which is about to be started, into the old sidecar.

        Raises:
            RecorderError: it cannot be written, or the one before that was given up is not settled.
        """
        directory = old.splits.directory
        before = handover_to_change(directory)
        if before.next is not None:
            raise RecorderError(f"{directory}: its handover to {before.next} is not settled yet")
        write_handover(directory, intended(before, new_name))

    @property
    def missing(self) -> frozenset[str]:
        """Topics that the old recorder has subscribed to, and the new one has still to."""
        is_listed = self.orders.topics.selection.matches
        return frozenset(filter(is_listed, self.old.subscribed - self.new.subscribed))

    def advance(self, now: ClockReading) -> Step:
        """Returns the step that is due. Must be called several times a second.

        Raises:
            RecorderError: a sidecar cannot be written.
        """
        if not self._marked and self.new.splits.exists:
            write_handover(self.new.splits.directory, pending(self.old.name))
            self._marked = True
        before, self._last = self._last, now
        if set_back(before, now):
            return Step.ABANDON
        is_ready = self._marked and self.new.is_recording
        age_s = now.monotonic_s - self.began.monotonic_s
        if self.missing and age_s < SUBSCRIBE_TIMEOUT_S:
            # Also if a publisher appears while both run: what it sends before the new recorder has
            # subscribed is in the old recording alone, and must not lie after the cut.
            self._both_since = None
        elif self._both_since is None and is_ready:
            self._both_since = now
        if self._both_since is None:
            return Step.WAIT if is_ready or age_s < READY_TIMEOUT_S else Step.ABANDON
        is_over = now.monotonic_s - self._both_since.monotonic_s >= BOTH_S
        return Step.COMPLETE if is_over else Step.WAIT

    def complete(self, now: ClockReading) -> bool:
        """Writes the cut if both recorders receive; returns False while they do not overlap.

        Raises:
            RecorderError: a sidecar cannot be written.
        """
        if self._both_since is None:
            return False
        old, new = self.directories
        closed = self.old.splits.closed_names
        clock = cut_clock(old / max(closed), self.orders.reader) if closed else CutClock.PUBLISH
        if self.orders.simulated and clock is CutClock.LOG:
            # No time of the wall clock separates them: the old one counts up to its end.
            return True
        of_old, of_new = complete_sidecars(
            handover_to_change(old),
            self.old.name,
            self.new.name,
            began=self.began.wall,
            both=self._both_since.wall,
            ended=now.wall,
            old_files=self._old_files(),
            new_files=self.new.splits.names(),
            simulated=self.orders.simulated,
            clock=clock,
        )
        write_handovers({new: of_new, old: of_old})
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
    """Returns the old and the new recording of each handover that an earlier run left unsettled.

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
            # Retention may have deleted the one before: then there is nothing to compare, and what
            # waits for it would never count.
            if handover.compared is False if is_folder(previous) else handover.hides_all:
                pairs.append((previous, directory))
    return pairs


def settle_handover(old: Path, new: Path, reader: BagReader, running: Collection[str] = ()) -> bool:
    """Completes the handover between two recordings as far as these have ended, and compares them.

    `running` names the recordings that are being written; the reader must ignore sidecars.

    Returns:
        Whether nothing is left to do: not while a file that may matter is being written.

    Raises:
        RecorderError: the recordings cannot be read, or the sidecars cannot be written.
    """
    try:
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
    except OSError as error:
        raise RecorderError(f"{error.filename}: {error.strerror or error}") from error
    except BagUnreachableError as error:
        # What the disk cannot show at present must not be taken for missing.
        raise RecorderError(str(error)) from error


def give_up(old: Path, new: Path) -> None:
    """Marks a new recording as not counting: it did not take over, and the old one goes on.

    Raises:
        RecorderError: a sidecar cannot be written.
        OSError: it is not known whether there is a recording.
    """
    if is_folder(new):
        write_handover(new, void(old.name))
    if is_folder(old):
        write_handover(old, intended(handover_to_change(old), None))


def _write_cut(old: Path, new: Path, reader: BagReader) -> None:
    """Writes the cut of a handover that was interrupted, after the old recording has ended.

    The new one may itself have handed over since, if this could not be written at once: what its
    sidecar records about its own end is kept.
    """
    before = handover_to_change(old)
    after = handover_to_change(new) if is_folder(new) else void(old.name)
    if after.state is Counting.COUNTS and after.counts_from is not None:
        # The crash came between the two sidecars of a complete handover.
        start = None if after.begin is None else after.begin.log_from
        bags = bags_of(old, reader).items()
        files = tuple(name for name, bag in bags if start is None or bag.end >= start)
        end = Overlap(start, None, files)
        write_handover(old, replace(before, counts_until=after.counts_from, end=end))
        return
    last = None if after.state is Counting.VOID else _end_of(old, reader)
    if last is not None:
        published, logged = last
        cut = replace(after, previous=old.name, counts_from=published + 1)
        write_handover(new, _with_begin(cut, new, logged, reader))
        end = Overlap(None, None, ())
        write_handover(old, replace(before, counts_until=published + 1, end=end))
        return
    if after.state is not Counting.VOID:
        counts = replace(after, state=Counting.COUNTS, previous=old.name, compared=True)
        write_handover(new, counts)
    write_handover(old, intended(before, None))


def _with_begin(cut: Handover, new: Path, logged: Ns, reader: BagReader) -> Handover:
    """Returns the sidecar of a new recording with the files and times in which its cut applies.

    `logged` is the last log time of the old recording.
    """
    bags = bags_of(new, reader)
    first = min((bag.start for bag in bags.values()), default=logged)
    until = min(logged + JITTER_NS, first + LONGEST_NS)
    later = {name for name, bag in bags.items() if bag.start >= until}
    # A file that cannot be read yet is still being written.
    names = tuple(path.name for path in _bag_files(new, reader) if path.name not in later)
    clock = cut_clock(new / next(iter(bags)), reader) if bags else CutClock.PUBLISH
    return replace(
        cut,
        state=Counting.COUNTS,
        clock=clock,
        begin=Overlap(None, until, names),
        notes=(LOG_CLOCK_NOTE,) * (clock is CutClock.LOG),
        compared=False,
    )


def _end_of(recording: Path, reader: BagReader) -> tuple[Ns, Ns] | None:
    """Returns the newest publish time and log time in the last bag file that is not empty."""
    bags = bags_of(recording, reader)
    if not bags:
        return None
    last = recording / max(bags, key=lambda name: bags[name].end)
    published = logged = MIN_NS
    for record in _readable(_unlatched_records(last, reader)):
        # A publish time of 0 means that there is none.
        published = max(published, record.publish_time or record.log_time)
        logged = max(logged, record.log_time)
    return None if logged == MIN_NS else (published, logged)


def cut_clock(bag: Path, reader: BagReader) -> CutClock:
    """Finds out whether a bag file has publish times of their own; yes if it is empty.

    Raises:
        RecorderError: the disk fails.
    """
    try:
        records = list(islice(_unlatched_records(bag, reader), SAMPLE))
    except BagUnreachableError as error:
        raise RecorderError(str(error)) from error
    except BagError:
        return CutClock.PUBLISH
    equal = bool(records) and all(record.publish_time in {0, record.log_time} for record in records)
    return CutClock.LOG if equal else CutClock.PUBLISH


def _unlatched_records(bag: Path, reader: BagReader) -> Iterator[Record]:
    """Yields messages of topics that are not latched: latched ones may be published long before."""
    topics = [topic.topic for topic in reader.summarize(bag).topics if not topic.latched]
    return reader.records(bag, topics, TimeWindow.everything())


_Copies: TypeAlias = "Counter[tuple[str, bool]]"
"""How often a recording holds one message, by file, and by whether the cut counts it there."""
_Wrong: TypeAlias = "tuple[Path, bool, str, str, str]"
"""A message for which the cut is wrong: its recording, whether it counts, file, topic, identity."""


class _Side(NamedTuple):
    """One of the two recordings.

    `cut` is as much of its sidecar as is about these two: what that says about the recording before
    or after them is another comparison's. `bags` are those that are not empty, by file name.
    """

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
        """Yields between which log times the cut may hide messages, both included."""
        for name, bag in self.bags.items():
            rule = self.cut.rule(name)
            for _, logged in () if rule is None else rule.exclusions:
                span = max(bag.start, logged.start), min(bag.end, logged.stop)
                if span[0] <= span[1]:
                    yield span

    def records(
        self, window: TimeWindow, reader: BagReader, *, latched: bool
    ) -> Iterator[tuple[str, bool, Record]]:
        """Yields the messages in a window, each with its file and whether the cut counts it."""
        for name, bag in self.bags.items():
            if not window.overlaps(bag.start, bag.end):
                continue
            topics, rule = [topic.topic for topic in bag.topics], self.cut.rule(name)
            for record in _readable(reader.records(self.recording / name, topics, window)):
                late = record.log_time - record.publish_time > FRESH_NS
                if not record.channel.latched or (latched and not late):
                    yield name, rule is None or rule.counts(record), record


def _compare(old: Path, new: Path, reader: BagReader, running: Collection[str]) -> bool:
    """Lists in the sidecars of two recordings what counts against the cut between them."""
    before, after = handover_to_change(old), handover_to_change(new)
    if after.compared is not False or after.previous != old.name:
        return True
    withheld, is_void = read_withheld(old.parent), after.state is Counting.VOID
    written = [
        path for path in (old, new) if path.name in running or withheld.holds_some(path.name)
    ]
    if after.state is Counting.PENDING or (new if is_void else old) in written:
        return False
    old_cut = Handover()
    if before.next == new.name:
        old_cut = Handover(counts_until=before.counts_until, end=before.end)
    new_cut = Handover(state=after.state, counts_from=after.counts_from, begin=after.begin)
    old_side, new_side = (
        _Side(path, cut, bags_of(path, reader, only_closed=path in written))
        for path, cut in ((old, old_cut), (new, new_cut))
    )
    ended, lasting = (new_side, old_side) if is_void else (old_side, new_side)
    if lasting.recording in written and (
        not lasting.bags or (ended.bags and lasting.end < ended.end + STALL_NS)
    ):
        return False
    wrong = _against_the_cut(old_side, new_side, reader, latched=is_void)
    changed = {new: _with_listed(after, new, wrong), old: _with_listed(before, old, wrong)}
    if len(wrong) > MOST_LISTED:
        # Without a cut all of both count.
        begin = None if after.begin is None else replace(after.begin, files=())
        changed = {new: replace(after, state=Counting.COUNTS, begin=begin), old: before}
        if before.end is not None and before.next == new.name:
            changed[old] = replace(before, end=replace(before.end, files=()))
    changed[new] = replace(changed[new], compared=True)
    if changed[old] == before:
        del changed[old]
    write_handovers(changed)
    if wrong:
        _log.info("handover_compared", recording=old.name, next=new.name, messages=len(wrong))
    return True


def _against_the_cut(old: _Side, new: _Side, reader: BagReader, *, latched: bool) -> set[_Wrong]:
    """Returns the messages of two recordings for which the cut is wrong.

    `latched`: also of latched messages. The cut does not apply to them, but all of a recording
    without effect is hidden.
    """
    spans = [*old.hidden(), *new.hidden()]
    if old.bags and new.bags and (start := max(old.start, new.start)) <= min(old.end, new.end):
        spans.append((start, min(old.end, new.end)))
    if not spans:
        return set()
    first, last = enclosing(spans)
    window = TimeWindow(first - STALL_NS, last + STALL_NS + 1)
    by_message: defaultdict[tuple[str, str], tuple[_Copies, _Copies]] = defaultdict(
        lambda: (Counter(), Counter())
    )
    undecided: set[tuple[str, str]] = set()  # without a publish time of their own
    for nth, side in enumerate((old, new)):
        for file, counts, record in side.records(window, reader, latched=latched):
            message = record.channel.topic, message_id(record.publish_time, record.payload)
            by_message[message][nth][file, counts] += 1
            if record.publish_time in {0, record.log_time}:
                undecided.add(message)
    wrong: set[_Wrong] = set()
    for message in by_message.keys() - undecided:
        of_old, of_new = by_message[message]
        # Where both hold it as often, the cut decides.
        is_old = _weight(of_old) >= _weight(of_new)
        for side, copies, counts in ((old, of_old, is_old), (new, of_new, not is_old)):
            wrong.update(
                (side.recording, counts, file, *message)
                for file, by_cut in copies
                if by_cut != counts
            )
    return wrong


def _weight(copies: _Copies) -> tuple[int, int]:
    """Returns how often a recording holds a message, and how often the cut counts it there."""
    return copies.total(), sum(times for (_, counts), times in copies.items() if counts)


def _with_listed(handover: Handover, recording: Path, wrong: Collection[_Wrong]) -> Handover:
    """Returns the sidecar of a recording that lists those messages of it, too."""

    def merged(listed: MessageList, counts: bool) -> MessageList:
        messages = {
            (file, topic, message)
            for file, by_topic in listed.items()
            for topic, of_topic in by_topic.items()
            for message in of_topic
        }
        messages |= {message[2:] for message in wrong if message[:2] == (recording, counts)}
        lists: MessageList = {}
        for (file, topic), of_topic in groupby(sorted(messages), itemgetter(0, 1)):
            lists.setdefault(file, {})[topic] = tuple(message for _, _, message in of_topic)
        return lists

    return replace(
        handover,
        also_counts=merged(handover.also_counts, counts=True),
        counts_elsewhere=merged(handover.counts_elsewhere, counts=False),
    )


def _readable(records: Iterator[Record]) -> Iterator[Record]:
    """Yields the messages that can be read."""
    for record in or_errors(records):
        if isinstance(record, BagUnreachableError):
            raise record
        if not isinstance(record, BagError):
            yield record


def bags_of(
    recording: Path, reader: BagReader, *, only_closed: bool = False
) -> dict[str, BagSummary]:
    """Returns the bag files that can be read and are not empty, by name.

    With `only_closed`, of those that are closed and not held back.

    Raises:
        OSError: the recording cannot be listed.
        BagUnreachableError: the disk fails.
    """
    summaries: dict[str, BagSummary] = {}
    withheld = read_withheld(recording.parent) if only_closed else NOTHING_WITHHELD
    for path in _bag_files(recording, reader):
        try:
            if only_closed and (
                withheld.holds(recording.name, path.name)
                or reader.closing(path) is not Closing.CLOSED
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


def _bag_files(recording: Path, reader: BagReader) -> list[Path]:
    return sorted(path for path in recording.iterdir() if reader.reads(path))
