"""Settles what counts of two recordings that overlapped: what either of them holds, and once.

A cut gives each message to one of two recordings. The recorder that wrote both wrote the cut, too,
unless a crash interrupted it: then the old recording, which names the new one before that is
started, counts up to its end, and the new one from there.

Where the recording that a message belongs to had stalled, the message is in the other alone, and
the cut hides it. So the files on both sides are compared once they are closed: a message is the
same by topic, publish time and payload, and counts as often as in the recording that holds it most
often. The sidecars then list the messages for which the cut is not the answer; mostly there are
none.

What `recording.exclude_when` holds back counts as still being written: what is excluded of it must
not be listed.

The cut alone decides where messages have no publish time of their own (it is 0, or the log time),
and not at all on latched channels, whose repeats are recognised in queries.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import structlog

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
from ros2_memory.bag_dir.state_files import OPEN_GATE, read_gate
from ros2_memory.core.directories import is_folder
from ros2_memory.core.errors import BagError, BagUnreachableError, RecorderError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MIN_NS, NS_PER_MS, NS_PER_S, Ns
from ros2_memory.storage.base import BagReader, Closing, Record, or_errors

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary

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

_log: structlog.typing.FilteringBoundLogger = structlog.get_logger(__name__)

_Copies: TypeAlias = "Counter[tuple[str, bool]]"
"""How often a recording holds one message, by file, and by whether the cut counts it there."""


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


def void(old_name: str) -> Handover:
    """Returns the sidecar of a new recording that did not take over: the old one went on."""
    return Handover(state=Counting.VOID, previous=old_name, compared=False)


def intended(old: Handover, new_name: str | None) -> Handover:
    """Returns the old sidecar before the new recording is started, as a crash may come any time.

    None in place of its name withdraws it: the new recording did not take over.
    """
    return replace(old, next=new_name, counts_until=None, end=None)


def _write_cut(old: Path, new: Path, reader: BagReader) -> None:
    """Writes the cut of a handover that was interrupted, after the old recording has ended.

    The new one may itself have handed over since, if this could not be written at once: what its
    sidecar records about its own end is kept.
    """
    before = handover_to_change(old)
    after = handover_to_change(new) if is_folder(new) else Handover(Counting.VOID)
    last = None if after.state is Counting.VOID else _end_of(old, reader)
    if after.state is Counting.COUNTS and after.counts_from is not None:
        # The crash came between the two sidecars of a complete handover.
        start = None if after.begin is None else after.begin.log_from
        bags = bags_of(old, reader).items()
        files = tuple(name for name, bag in bags if start is None or bag.end >= start)
        end = Overlap(start, None, files)
        write_handover(old, replace(before, counts_until=after.counts_from, end=end))
    elif last is None:
        if after.state is not Counting.VOID:
            counts = replace(after, state=Counting.COUNTS, previous=old.name, compared=True)
            write_handover(new, counts)
        write_handover(old, intended(before, None))
    else:
        published, logged = last
        cut = replace(after, previous=old.name, counts_from=published + 1)
        write_handover(new, _with_begin(cut, new, logged, reader))
        end = Overlap(None, None, ())
        write_handover(old, replace(before, counts_until=published + 1, end=end))


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
        notes=(LOG_CLOCK_NOTE,) if clock is CutClock.LOG else (),
        compared=False,
    )


def _end_of(recording: Path, reader: BagReader) -> tuple[Ns, Ns] | None:
    """Returns the newest publish time and log time in the last bag file that is not empty."""
    bags = bags_of(recording, reader)
    if not bags:
        return None
    last = recording / max(bags, key=lambda name: bags[name].end)
    newest: tuple[Ns, Ns] | None = None
    for record in _readable(_unlatched_records(last, reader)):
        published, logged = newest or (MIN_NS, MIN_NS)
        # A publish time of 0 means that there is none.
        latest = max(published, record.publish_time or record.log_time)
        newest = latest, max(logged, record.log_time)
    return newest


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


class _Side(NamedTuple):
    """One of the two recordings.

    `handover` is its sidecar, and `cut` as much of that as is about these two: what it says about
    the recording before or after them is another comparison's. `bags` are those that are not
    empty, by file name.
    """

    recording: Path
    handover: Handover
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


class _AgainstCut(NamedTuple):
    """What is to be listed of one recording, as file, topic and message."""

    also_counts: set[tuple[str, str, str]]  # where the cut says that they do not
    counts_elsewhere: set[tuple[str, str, str]]  # where it says that they count

    def add(self, message: tuple[str, str], copies: _Copies, *, counts_here: bool) -> None:
        """Lists the copies of a message, by topic and identity, for which the cut is wrong."""
        listed = self.also_counts if counts_here else self.counts_elsewhere
        listed.update((file, *message) for file, counts in copies if counts is not counts_here)

    def added_to(self, handover: Handover) -> Handover:
        """Returns the sidecar of the recording with what is to be listed."""
        return replace(
            handover,
            also_counts=_merged(handover.also_counts, self.also_counts),
            counts_elsewhere=_merged(handover.counts_elsewhere, self.counts_elsewhere),
        )


def _compare(old: Path, new: Path, reader: BagReader, running: Collection[str]) -> bool:
    """Lists in the sidecars of two recordings what counts against the cut between them."""
    before, after = handover_to_change(old), handover_to_change(new)
    if after.compared is not False or after.previous != old.name:
        return True
    gate = read_gate(old.parent)
    running = {
        *running,
        *(recording.name for recording in (old, new) if gate.holds_some(recording.name)),
    }
    is_void = after.state is Counting.VOID
    if after.state is Counting.PENDING or (new if is_void else old).name in running:
        return False
    old_cut = Handover()
    if before.next == new.name:
        old_cut = Handover(counts_until=before.counts_until, end=before.end)
    new_cut = Handover(state=after.state, counts_from=after.counts_from, begin=after.begin)
    old_side = _Side(old, before, old_cut, bags_of(old, reader, only_closed=old.name in running))
    new_side = _Side(new, after, new_cut, bags_of(new, reader, only_closed=new.name in running))
    ended, lasting = (new_side, old_side) if is_void else (old_side, new_side)
    if lasting.recording.name in running and (
        not lasting.bags or (ended.bags and lasting.end < ended.end + STALL_NS)
    ):
        return False
    _write_lists(old_side, new_side, *_against_the_cut(old_side, new_side, reader))
    return True


def _against_the_cut(old: _Side, new: _Side, reader: BagReader) -> tuple[_AgainstCut, _AgainstCut]:
    """Returns what counts against the cut, for the sidecars of the old and the new recording."""
    of_old, of_new = _AgainstCut(set(), set()), _AgainstCut(set(), set())
    spans = [*_hidden_in(old), *_hidden_in(new)]
    if old.bags and new.bags and (start := max(old.start, new.start)) <= min(old.end, new.end):
        spans.append((start, min(old.end, new.end)))
    if not spans:
        return of_old, of_new
    first, last = min(start for start, _ in spans), max(end for _, end in spans)
    window = TimeWindow(first - STALL_NS, last + STALL_NS + 1)
    # The cut does not apply to latched channels, but all of a recording without effect is hidden.
    latched = new.handover.state is Counting.VOID
    in_old, in_new = (_copies(side, window, reader, latched=latched) for side in (old, new))
    for message in in_old.keys() | in_new.keys():
        old_copies, new_copies = in_old.get(message, _NOWHERE), in_new.get(message, _NOWHERE)
        if old_copies is None or new_copies is None:
            continue
        # Where both hold it as often, the cut decides.
        counts_in_old = _weight(old_copies) >= _weight(new_copies)
        of_old.add(message, old_copies, counts_here=counts_in_old)
        of_new.add(message, new_copies, counts_here=not counts_in_old)
    return of_old, of_new


def _hidden_in(side: _Side) -> Iterator[tuple[Ns, Ns]]:
    """Yields between which log times the cut may hide messages of a recording, both included."""
    for name, bag in side.bags.items():
        rule = side.cut.rule(name)
        for _, _, log_from, log_until in () if rule is None else rule.exclusions:
            span = max(bag.start, log_from), min(bag.end, log_until)
            if span[0] <= span[1]:
                yield span


def _weight(copies: _Copies) -> tuple[int, int]:
    """Returns how often a recording holds a message, and how often the cut counts it there."""
    return copies.total(), sum(times for (_, counts), times in copies.items() if counts)


_NOWHERE: Final[_Copies] = Counter()


def _copies(
    side: _Side, window: TimeWindow, reader: BagReader, *, latched: bool
) -> dict[tuple[str, str], _Copies | None]:
    """Returns what a recording holds in a window, by topic and identity.

    None stands for a message without a publish time of its own.
    """
    by_message: dict[tuple[str, str], _Copies | None] = {}
    for name, bag in side.bags.items():
        if not window.overlaps(bag.start, bag.end):
            continue
        topics = [topic.topic for topic in bag.topics]
        rule = side.cut.rule(name)
        for record in _readable(reader.records(side.recording / name, topics, window)):
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


def _readable(records: Iterator[Record]) -> Iterator[Record]:
    """Yields the messages that can be read."""
    for record in or_errors(records):
        if isinstance(record, BagUnreachableError):
            raise record
        if not isinstance(record, BagError):
            yield record


def _write_lists(old: _Side, new: _Side, of_old: _AgainstCut, of_new: _AgainstCut) -> None:
    """Writes the sidecars that change, that of the new recording in any case."""
    before, after = old.handover, new.handover
    messages = sum(map(len, (*of_old, *of_new)))
    if messages <= MOST_LISTED:
        before, after = of_old.added_to(before), of_new.added_to(after)
    else:
        # Without a cut all of both count.
        if before.end is not None and before.next == new.recording.name:
            before = replace(before, end=replace(before.end, files=()))
        begin = None if after.begin is None else replace(after.begin, files=())
        after = replace(after, state=Counting.COUNTS, begin=begin)
    changed = {new.recording: replace(after, compared=True)}
    if before != old.handover:
        changed[old.recording] = before
    write_handovers(changed)
    if messages:
        _log.info(
            "handover_compared",
            recording=old.recording.name,
            next=new.recording.name,
            messages=messages,
        )


def _merged(listed: MessageList, more: Collection[tuple[str, str, str]]) -> MessageList:
    merged = {
        file: {topic: {*messages} for topic, messages in by_topic.items()}
        for file, by_topic in listed.items()
    }
    for file, topic, message in more:
        merged.setdefault(file, {}).setdefault(topic, set()).add(message)
    return {
        file: {topic: tuple(sorted(messages)) for topic, messages in by_topic.items()}
        for file, by_topic in merged.items()
    }


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
    gate = read_gate(recording.parent) if only_closed else OPEN_GATE
    for path in _bag_files(recording, reader):
        try:
            if only_closed and (
                gate.holds(recording.name, path.name) or reader.closing(path) is not Closing.CLOSED
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
