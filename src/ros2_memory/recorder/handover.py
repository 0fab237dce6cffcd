"""One recording takes over from another without losing or doubling a message.

The new recorder is started beside the old one, and waits until it has subscribed to all topics of
the old one, but not for ever, since a publisher may be gone. Then both run for `BOTH_S`, since who
has subscribed receives nothing before the publishers discovered that, and the old one ends.

Each sidecar (`handover.json`) is written before it can matter: the old recording names the new one
before that is started, the new one is marked as not counting as soon as it exists, and then as
counting from the moment at which the old one is asked to end. When that has ended, by itself or
not, it counts up to its last message, and the new one from there: the cut. So a crash at any moment
leaves a pair of sidecars that are settled in the same way.

A recorder that stalled lost what was published, and a message may be in transit at the cut: then it
is in the other recording alone, and the cut hides it. So the files on both sides are compared once
they are closed: a message is the same by topic, publish time and payload, and counts as often as in
the recording that holds it most often. The sidecars then list the messages for which the cut is not
the answer; mostly there are none.

What `recording.exclude_when` holds back counts as still being written: what is excluded of it must
not be listed. The cut alone decides where messages have no publish time of their own (it is 0, or
the log time), and not at all on latched channels, whose repeats are recognised in queries.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from enum import Enum, auto
from itertools import groupby
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

from ros2_memory.bag_dir.handover_file import (
    LOG_CLOCK_NOTE,
    Counting,
    Handover,
    MessageList,
    Overlap,
    handover_to_change,
    message_id,
    read_handover,
    write_handover,
    write_handovers,
)
from ros2_memory.bag_dir.state_files import read_withheld
from ros2_memory.core.directories import is_folder
from ros2_memory.core.errors import BagError, BagUnreachableError, RecorderError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_MS, NS_PER_S, Ns
from ros2_memory.recorder.policies import ClockReading, set_back
from ros2_memory.storage.base import BagReader, Closing, Record, or_errors

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.recorder.process.topics import TopicsFile
    from ros2_memory.recorder.session import RecordingSession

SUBSCRIBE_TIMEOUT_S: Final = 20.0
READY_TIMEOUT_S: Final = 120.0
"""A recorder that has not started to record after this time is given up."""
BOTH_S: Final = 5.0
"""Longer than the 3 s after which Fast DDS sends discovery again that was lost on the way."""
JITTER_NS: Final[Ns] = 100 * NS_PER_MS
"""Two recorders differ by less than this in when they received one message."""
LONGEST_NS: Final[Ns] = 60 * NS_PER_S
"""Two recorders never run side by side for longer, whatever a clock that was set shows."""
STALL_NS: Final[Ns] = 5 * NS_PER_S
"""How much later than the other one a recorder may log a message."""
FRESH_NS: Final[Ns] = NS_PER_S
"""A latched message logged later than this after it was published was received before."""
MOST_LISTED: Final = 10_000
"""More messages are not listed in a sidecar: then all count, and queries leave out duplicates."""

_log = get_logger(__name__)


def pending(old_name: str) -> Handover:
    """Returns the new sidecar as soon as its directory exists: until the cut it does not count."""
    return Handover(state=Counting.PENDING, previous=old_name)


def taking_over(old_name: str, now: Ns, files: Collection[str]) -> Handover:
    """Returns the new sidecar while the old recorder ends: what is published from now on counts."""
    begin = Overlap(None, None, tuple(sorted(files)))
    return Handover(previous=old_name, counts_from=now, begin=begin)


def void(old_name: str) -> Handover:
    """Returns the sidecar of a new recording that did not take over: the old one went on."""
    return Handover(state=Counting.VOID, previous=old_name, compared=False)


def intended(old: Handover, new_name: str | None) -> Handover:
    """Returns the old sidecar before the new recording is started, as a crash may come any time.

    None in place of its name withdraws it: the new recording did not take over.
    """
    return replace(old, next=new_name, counts_until=None, end=None)


class Step(Enum):
    """What a handover needs next."""

    WAIT = auto()
    COMPLETE = auto()
    # The new recorder does not begin, or the clock was set back: then no single cut separates the
    # messages published before it from those published after it.
    ABANDON = auto()


class HandoverTransfer:
    """A handover from one running session to another.

    Args:
        old: the session that records.
        new: the session that takes over.
        began: the time just before the new recorder was started.
        topics: what to record.

    Attributes:
        directories: the old and the new recording.
    """

    def __init__(
        self, old: RecordingSession, new: RecordingSession, began: ClockReading, topics: TopicsFile
    ) -> None:
        self._topics = topics
        self.old = old
        self.new = new
        self.directories = old.splits.directory, new.splits.directory
        self._began = self._last = began
        self._both_since_s: float | None = None
        self._marked = False

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
        is_listed = self._topics.selection.matches
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
        age_s = now.monotonic_s - self._began.monotonic_s
        if self.missing and age_s < SUBSCRIBE_TIMEOUT_S:
            # Also if a publisher appears while both run: what it sends before the new recorder has
            # subscribed is in the old recording alone, and must not lie after the cut.
            self._both_since_s = None
        elif self._both_since_s is None and is_ready:
            self._both_since_s = now.monotonic_s
        if self._both_since_s is None:
            return Step.WAIT if is_ready or age_s < READY_TIMEOUT_S else Step.ABANDON
        is_over = now.monotonic_s - self._both_since_s >= BOTH_S
        return Step.COMPLETE if is_over else Step.WAIT


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
        # Retention may have deleted the one before, and then there is nothing to compare.
        if handover.previous is not None and handover.compared is False:
            previous = bag_dir / handover.previous
            pairs += [(previous, directory)] * is_folder(previous)
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
        begun = read_handover(old).handover
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
    """Writes the cut between two recordings, the old one of which has ended.

    The new one may itself have handed over since, if this could not be written at once: what its
    sidecar records about its own end is kept.
    """
    before = handover_to_change(old)
    after = handover_to_change(new) if is_folder(new) else void(old.name)
    is_void = after.state is Counting.VOID
    end = None if is_void else _end_of(old, reader)
    counts = replace(after, state=Counting.COUNTS, previous=old.name)
    if end is None:
        if not is_void:
            write_handover(new, replace(counts, counts_from=None, begin=None, compared=True))
        write_handover(old, intended(before, None))
        return
    cut = end.published + 1
    after = replace(
        counts,
        counts_from=cut,
        begin=_begin_of(new, end.logged, reader),
        notes=(LOG_CLOCK_NOTE,) * end.is_by_log,
        compared=False,
    )
    settled = replace(before, counts_until=cut, end=Overlap(None, None, ()))
    write_handovers({new: after, old: settled})


def _begin_of(new: Path, logged: Ns, reader: BagReader) -> Overlap:
    """Returns where the cut applies in a new recording.

    `logged` is the last log time of the old one.
    """
    bags = _bags_of(new, reader)
    first = min((bag.start for bag in bags.values()), default=logged)
    until = min(logged + JITTER_NS, first + LONGEST_NS)
    later = {name for name, bag in bags.items() if bag.start >= until}
    # A file that cannot be read yet is still being written.
    names = (path.name for path in _bag_files(new, reader))
    return Overlap(None, until, tuple(name for name in names if name not in later))


class _End(NamedTuple):
    """The newest publish time and log time of a recording, and whether they are of one clock."""

    published: Ns
    logged: Ns
    is_by_log: bool


def _end_of(recording: Path, reader: BagReader) -> _End | None:
    """Returns how far a recording reaches; None if it has nothing but latched messages.

    Those may be published long before, and received at any time.
    """
    files = sorted(_bag_files(recording, reader), key=lambda path: path.stat().st_mtime_ns)
    newest = next(
        (
            (path, lasts)
            for path, bag in _summaries(reversed(files), reader)
            if (lasts := {topic.topic: topic.last for topic in bag.topics if not topic.latched})
        ),
        None,
    )
    if newest is None:
        return None
    path, lasts = newest
    logged = max(lasts.values())
    # A publish time of 0 means that there is none.
    times = [
        (record.publish_time or record.log_time, record.log_time)
        for record in _readable(
            reader.records(path, lasts, TimeWindow(logged - FRESH_NS, logged + 1))
        )
    ]
    return _End(
        max((published for published, _ in times), default=logged),
        logged,
        is_by_log=bool(times) and all(published == logged for published, logged in times),
    )


_Copies: TypeAlias = "Counter[tuple[str, bool]]"
"""How often a recording holds one message, by file, and by whether the cut counts it there."""
_Wrong: TypeAlias = "dict[bool, set[tuple[str, str, str]]]"
"""Messages for which the cut is wrong, as file, topic and identity, by whether they count."""


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

    def copies(
        self, window: TimeWindow, reader: BagReader, *, latched: bool
    ) -> dict[tuple[str, str], _Copies | None]:
        """Returns what the recording holds in a window, by topic and identity.

        None stands for a message without a publish time of its own.
        """
        by_message: dict[tuple[str, str], _Copies | None] = {}
        for name, bag in self.bags.items():
            if not window.overlaps(bag.start, bag.end):
                continue
            topics, rule = [topic.topic for topic in bag.topics], self.cut.rule(name)
            for record in _readable(reader.records(self.recording / name, topics, window)):
                published, logged = record.publish_time, record.log_time
                if record.channel.latched and not (latched and logged - published <= FRESH_NS):
                    continue
                key = record.channel.topic, message_id(published, record.payload)
                copies = by_message.setdefault(key, Counter())
                if published in {0, logged}:
                    by_message[key] = None
                elif copies is not None:
                    copies[name, rule is None or rule.counts(record)] += 1
        return by_message


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
        _Side(path, cut, _bags_of(path, reader, only_closed=path in written))
        for path, cut in ((old, old_cut), (new, new_cut))
    )
    ended, lasting = (new_side, old_side) if is_void else (old_side, new_side)
    if lasting.recording in written and (
        not lasting.bags or (ended.bags and lasting.end < ended.end + STALL_NS)
    ):
        return False
    of_old, of_new = _against_the_cut(old_side, new_side, reader, is_void=is_void)
    messages = sum(map(len, (*of_old.values(), *of_new.values())))
    if messages <= MOST_LISTED:
        settled, after = _with_listed(before, of_old), _with_listed(after, of_new)
    else:
        # Without a cut all of both count.
        settled, after = before, replace(after, state=Counting.COUNTS, begin=None)
    changed = {new: replace(after, compared=True)}
    write_handovers(changed if settled == before else {**changed, old: settled})
    if messages:
        _log.info("handover_compared", recording=old.name, next=new.name, messages=messages)
    return True


def _against_the_cut(
    old: _Side, new: _Side, reader: BagReader, *, is_void: bool
) -> tuple[_Wrong, _Wrong]:
    """Returns what counts against the cut, for the sidecars of the old and the new recording.

    Of latched messages, to which the cut does not apply, only where all of the new one is hidden.
    """
    of_old: _Wrong = {True: set(), False: set()}
    of_new: _Wrong = {True: set(), False: set()}
    if not new.bags:
        return of_old, of_new
    last = new.end if is_void or not old.bags else min(old.end, new.start + LONGEST_NS)
    window = TimeWindow(new.start - STALL_NS, max(last, new.start) + STALL_NS + 1)
    in_old, in_new = (side.copies(window, reader, latched=is_void) for side in (old, new))
    for message in in_old.keys() | in_new.keys():
        old_copies, new_copies = (side.get(message, Counter()) for side in (in_old, in_new))
        if old_copies is None or new_copies is None:
            continue
        is_old = old_copies.total() >= new_copies.total()
        for wrong, copies, counts in (
            (of_old, old_copies, is_old),
            (of_new, new_copies, not is_old),
        ):
            wrong[counts].update((file, *message) for file, by_cut in copies if by_cut != counts)
    return of_old, of_new


def _with_listed(handover: Handover, wrong: _Wrong) -> Handover:
    """Returns a sidecar that lists those messages, too."""
    return replace(
        handover,
        also_counts=_merged(handover.also_counts, wrong[True]),
        counts_elsewhere=_merged(handover.counts_elsewhere, wrong[False]),
    )


def _merged(listed: MessageList, more: Collection[tuple[str, str, str]]) -> MessageList:
    before = {
        (file, topic, message)
        for file, by_topic in listed.items()
        for topic, messages in by_topic.items()
        for message in messages
    }
    merged: MessageList = {}
    for (file, topic), of_topic in groupby(sorted(before.union(more)), itemgetter(0, 1)):
        merged.setdefault(file, {})[topic] = tuple(message for _, _, message in of_topic)
    return merged


def _readable(records: Iterator[Record]) -> Iterator[Record]:
    """Yields the messages that can be read."""
    for record in or_errors(records):
        if isinstance(record, BagUnreachableError):
            raise record
        if not isinstance(record, BagError):
            yield record


def _bags_of(
    recording: Path, reader: BagReader, *, only_closed: bool = False
) -> dict[str, BagSummary]:
    """Returns the bag files that can be read and are not empty, by name.

    With `only_closed`, of those that are closed and not held back.

    Raises:
        OSError: the recording cannot be listed.
        BagUnreachableError: the disk fails.
    """
    files = _bag_files(recording, reader)
    if only_closed:
        withheld = read_withheld(recording.parent)
        files = [path for path in files if not withheld.holds(recording.name, path.name)]
    summaries = _summaries(files, reader, only_closed=only_closed)
    return {path.name: bag for path, bag in summaries}


def _summaries(
    files: Iterable[Path], reader: BagReader, *, only_closed: bool = False
) -> Iterator[tuple[Path, BagSummary]]:
    """Yields those bag files that can be read and are not empty, with their summaries."""
    for path in files:
        try:
            if only_closed and reader.closing(path) is not Closing.CLOSED:
                continue
            summary = reader.summarize(path)
        except BagUnreachableError:
            raise
        except BagError:
            continue
        if not summary.empty:
            yield path, summary


def _bag_files(recording: Path, reader: BagReader) -> list[Path]:
    return sorted(path for path in recording.iterdir() if reader.reads(path))
