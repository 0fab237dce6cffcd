"""Compares two recordings that overlapped, so that what either of them holds counts, and once.

A cut gives each message to one of two recordings. Where the one that it belongs to had stalled, the
message is in the other alone, and the cut hides it. So the files on both sides are compared once
they are closed: a message is the same by topic, publish time and payload, and counts as often as in
the recording that holds it most often. The sidecars then list the messages for which the cut is not
the answer; mostly there are none.

What `recording.exclude_when` holds back counts as still being written: what is excluded of it must
not be listed.

The cut alone decides where messages have no publish time of their own (it is 0, or the log time),
and not at all on latched channels, whose repeats are recognised in queries.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import structlog

from ros2_memory.bag_dir.handover_file import (
    Counting,
    Handover,
    MessageList,
    handover_to_change,
    message_id,
    write_handovers,
)
from ros2_memory.bag_dir.state_files import OPEN_GATE, read_gate
from ros2_memory.core.errors import BagError, BagUnreachableError, RecorderError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S, Ns
from ros2_memory.storage.base import Closing

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.storage.base import BagReader, Record

STALL_NS: Final[Ns] = 5 * NS_PER_S
"""How much later than the other one a recorder may log a message."""
FRESH_NS: Final[Ns] = NS_PER_S
"""A latched message logged later than this after it was published was received before."""
MOST_LISTED: Final = 10_000
"""More messages are not listed in a sidecar: then all count, and queries leave out duplicates."""

_log: structlog.typing.FilteringBoundLogger = structlog.get_logger(__name__)

_Key: TypeAlias = "tuple[str, str]"


class _Copies(NamedTuple):
    """How often the files of a recording hold one message: where the cut counts it, and not."""

    counted: Counter[str]
    excluded: Counter[str]


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
        return min(each.start for each in self.bags.values())

    @property
    def end(self) -> Ns:
        """The last log time."""
        return max(each.end for each in self.bags.values())


def compare_recordings(
    old: Path, new: Path, reader: BagReader, running: Collection[str] = ()
) -> bool:
    """Lists in the sidecars of two recordings what counts against the cut between them.

    `running` names the recordings that are being written; the reader must ignore sidecars.

    Returns:
        Whether that is done: False while a file that may hold such messages is being written.

    Raises:
        RecorderError: the recordings cannot be read, or the sidecars cannot be written.
    """
    after = handover_to_change(new)
    if after.compared is not False or after.previous != old.name:
        return True
    ends_first = new if after.state is Counting.VOID else old
    gate = read_gate(old.parent)
    running = {*running, *(each.name for each in (old, new) if gate.holds_some(each.name))}
    if after.state is Counting.PENDING or ends_first.name in running:
        return False
    try:
        one, other = _sides(old, new, reader, running)
        ended, lasting = (one, other) if ends_first is old else (other, one)
        if lasting.recording.name in running and (
            not lasting.bags or (ended.bags and lasting.end < ended.end + STALL_NS)
        ):
            return False
        found = _differences(one, other, reader)
    except OSError as error:
        raise RecorderError(f"{error.filename}: {error.strerror or error}") from error
    except BagUnreachableError as error:
        # What the disk cannot show at present must not be taken for missing.
        raise RecorderError(str(error)) from error
    _write(one, other, found)
    return True


class _Lists(NamedTuple):
    """What one sidecar is to list: files, topics and messages."""

    also_counts: dict[str, dict[str, set[str]]]
    counts_elsewhere: dict[str, dict[str, set[str]]]

    @property
    def messages(self) -> int:
        """How many messages are listed."""
        return sum(
            len(ids) for each in self for by_topic in each.values() for ids in by_topic.values()
        )


def _sides(
    old: Path, new: Path, reader: BagReader, running: Collection[str]
) -> tuple[_Side, _Side]:
    before, after = handover_to_change(old), handover_to_change(new)
    before_cut = Handover(counts_until=before.counts_until, end=before.end)
    if before.next != new.name:
        before_cut = Handover()
    after_cut = Handover(state=after.state, counts_from=after.counts_from, begin=after.begin)
    one, other = (
        dict(bags_of(each, reader, only_closed=each.name in running)) for each in (old, new)
    )
    return _Side(old, before, before_cut, one), _Side(new, after, after_cut, other)


def _differences(old: _Side, new: _Side, reader: BagReader) -> tuple[_Lists, _Lists]:
    """Returns what counts against the cut, for both sidecars."""
    window = TimeWindow.everything()
    if old.bags and new.bags:
        start, end = max(old.start, new.start), min(old.end, new.end)
        window = TimeWindow(start - STALL_NS, end + STALL_NS + 1)
    # The cut does not apply to latched channels, but all of a recording without effect is hidden.
    latched = new.handover.state is Counting.VOID
    of_old, of_new = (_copies(each, window, reader, latched=latched) for each in (old, new))
    lists = _Lists({}, {}), _Lists({}, {})
    for key in of_old.keys() | of_new.keys():
        of_one, of_other = (of_side.get(key, _NONE) for of_side in (of_old, of_new))
        if of_one is None or of_other is None:
            continue
        copies = of_one, of_other
        counted = [each.counted.total() for each in copies]
        held = [each.counted.total() + each.excluded.total() for each in copies]
        # Where both hold it as often, the cut decides.
        best = max((0, 1), key=lambda side: (held[side], counted[side]))
        for side in (0, 1):
            wrong = copies[side].excluded if side == best else copies[side].counted
            for file in wrong:
                listed = lists[side][side != best].setdefault(file, {})
                listed.setdefault(key[0], set()).add(key[1])
    return lists


_NONE: Final = _Copies(Counter(), Counter())


def _copies(
    side: _Side, window: TimeWindow, reader: BagReader, *, latched: bool
) -> dict[_Key, _Copies | None]:
    """Returns what a recording holds in a window, by topic and identity.

    None stands for a message without a publish time of its own.
    """
    found: dict[_Key, _Copies | None] = {}
    for name, summary in side.bags.items():
        topics = [each.topic for each in summary.topics]
        if not window.overlaps(summary.start, summary.end):
            continue
        rule = side.cut.rule(name)
        for record in _readable(reader.records(side.recording / name, topics, window)):
            published, logged = record.publish_time, record.log_time
            if record.channel.latched and not (latched and logged - published <= FRESH_NS):
                continue
            key = record.channel.topic, message_id(published, record.payload)
            copies = found.setdefault(key, _Copies(Counter(), Counter()))
            if published in {0, logged}:
                found[key] = None
            elif copies is not None:
                copies[rule is not None and not rule.counts(record)][name] += 1
    return found


def _readable(records: Iterator[Record]) -> Iterator[Record]:
    """Yields the messages that can be read: any other is not held."""
    while True:
        try:
            yield next(records)
        except StopIteration:
            return
        except BagUnreachableError:
            raise
        except BagError as error:
            if error.lost is None:
                return


def _write(old: _Side, new: _Side, found: tuple[_Lists, _Lists]) -> None:
    """Writes the sidecars that change, that of the new recording in any case.

    Raises:
        RecorderError: one cannot be written.
    """
    before, after = old.handover, new.handover
    messages = sum(lists.messages for lists in found)
    if messages <= MOST_LISTED:
        before, after = _with_lists(before, found[0]), _with_lists(after, found[1])
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


def _with_lists(handover: Handover, lists: _Lists) -> Handover:
    """Returns the sidecar with more messages listed."""
    return replace(
        handover,
        also_counts=_joined(handover.also_counts, lists.also_counts),
        counts_elsewhere=_joined(handover.counts_elsewhere, lists.counts_elsewhere),
    )


def _joined(known: MessageList, more: dict[str, dict[str, set[str]]]) -> MessageList:
    joined = {file: dict(by_topic) for file, by_topic in known.items()}
    for file, by_topic in more.items():
        of_file = joined.setdefault(file, {})
        for topic, ids in by_topic.items():
            of_file[topic] = tuple(sorted(ids.union(of_file.get(topic, ()))))
    return joined


def bags_of(
    recording: Path, reader: BagReader, *, only_closed: bool = False
) -> list[tuple[str, BagSummary]]:
    """Returns name and summary of each bag file that can be read and is not empty.

    With `only_closed`, of those that are closed and not held back.

    Raises:
        OSError: the recording cannot be listed.
        BagUnreachableError: the disk fails.
    """
    found: list[tuple[str, BagSummary]] = []
    gate = read_gate(recording.parent) if only_closed else OPEN_GATE
    for path in bag_files(recording, reader):
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
            found.append((path.name, summary))
    return found


def bag_files(recording: Path, reader: BagReader) -> list[Path]:
    """Returns the bag files of a recording by their names.

    Raises:
        OSError: the recording cannot be listed.
    """
    return sorted(each for each in recording.iterdir() if reader.reads(each))
