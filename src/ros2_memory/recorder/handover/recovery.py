"""Completes handovers that a crash interrupted, by reading both recordings.

The old recording names the new one before that is started, so nothing is inferred from times: only
for a pair that is known to have overlapped is the end of the old one read. Its messages count up to
there, and those of the new one from then on, but for what `union` finds.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

import structlog

from ros2_memory.bag_dir.handover_file import (
    LOG_CLOCK_NOTE,
    Counting,
    CutClock,
    Handover,
    Overlap,
    handover_to_change,
    read_handover,
    write_handover,
)
from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.core.errors import BagError, BagUnreachableError, RecorderError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_MS, NS_PER_S, Ns
from ros2_memory.recorder.handover.plan import Sidecars, intended
from ros2_memory.recorder.handover.union import bag_files, bags_of, compare_recordings

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from ros2_memory.core.bag_summary import BagSummary
    from ros2_memory.storage.base import BagReader, Record

JITTER_NS: Final[Ns] = 100 * NS_PER_MS
"""Two recorders differ by less than this in when they received one message."""
LONGEST_NS: Final[Ns] = 60 * NS_PER_S
"""Two recorders never run side by side for longer, whatever a clock that was set shows."""
SAMPLE: Final = 2000
"""Messages read to find out whether publish times differ from log times."""

_log: structlog.typing.FilteringBoundLogger = structlog.get_logger(__name__)


def recover_handovers(bag_dir: Path, reader: BagReader, running: Collection[str] = ()) -> None:
    """Completes every handover below the bag directory; reports those that it cannot complete.

    `running` are recordings that are being written, which may still complete theirs.

    Raises:
        OSError: the bag directory cannot be listed.
    """
    for directory in sorted(each for each in bag_dir.iterdir() if _is_folder(each)):
        handover = read_handover(directory).handover
        try:
            if (
                handover.next is not None
                and handover.counts_until is None
                and directory.name not in running
            ):
                recover_handover(directory, bag_dir / handover.next, reader)
                compare_recordings(directory, bag_dir / handover.next, reader, running)
            # Retention may have deleted the one before, and then there is nothing to compare.
            if (
                handover.previous is not None
                and handover.compared is False
                and _is_folder(bag_dir / handover.previous)
            ):
                compare_recordings(bag_dir / handover.previous, directory, reader, running)
        except RecorderError as error:
            _log.error("handover_not_settled", recording=directory.name, reason=str(error))


def recover_unwritten(bag_dir: Path, reader: BagReader) -> None:
    """Completes the handovers of recordings that the heartbeat does not name as being written.

    Raises:
        OSError: the bag directory cannot be listed.
    """
    recover_handovers(bag_dir, reader, read_heartbeat(bag_dir).recordings)


def settle_handover(old: Path, new: Path, reader: BagReader, running: Collection[str]) -> bool:
    """Completes the handover between two recordings as far as these have ended, and compares them.

    Returns:
        Whether nothing is left to do.

    Raises:
        RecorderError: the recordings cannot be read, or the sidecars cannot be written.
    """
    if not _is_folder(new):
        if _is_folder(old) and incomplete_handover(old) == new.name:
            write_handover(old, intended(handover_to_change(old), None))
        return True
    if not _is_folder(old):
        if handover_to_change(new).hides_all:
            write_handover(new, Handover())
        return True
    if incomplete_handover(old) == new.name:
        if old.name in running:
            return False
        recover_handover(old, new, reader)
    return compare_recordings(old, new, reader, running)


def _is_folder(path: Path) -> bool:
    """Whether it is a directory, and not a link to one elsewhere."""
    return path.is_dir() and not path.is_symlink()


def incomplete_handover(recording: Path) -> str | None:
    """Returns the recording that this one was handing over to when it was interrupted, or None."""
    handover = read_handover(recording).handover
    return handover.next if handover.counts_until is None else None


def recover_handover(old: Path, new: Path, reader: BagReader) -> None:
    """Writes which messages of two overlapping recordings count, after both have ended.

    Raises:
        RecorderError: the recordings cannot be read, or the sidecars cannot be written.
    """
    try:
        _complete(old, new, reader)
    except OSError as error:
        raise RecorderError(f"{error.filename}: {error.strerror or error}") from error
    except BagUnreachableError as error:
        # Files that the disk cannot show at present must not be recorded as missing.
        raise RecorderError(str(error)) from error
    _log.info("handover_settled", recording=old.name, next=new.name)


def _complete(old: Path, new: Path, reader: BagReader) -> None:
    before = handover_to_change(old)
    if not _is_folder(new):
        write_handover(old, intended(before, None))
        return
    after = handover_to_change(new)
    if after.state is Counting.VOID:
        write_handover(old, intended(before, None))
    elif after.state is Counting.COUNTS and after.counts_from is not None:
        # The crash came between the two sidecars of a complete handover.
        start = after.begin.log_from if after.begin is not None else None
        files = tuple(name for name, summary in bags_of(old, reader) if _reaches(summary, start))
        end = Overlap(start, None, files)
        write_handover(old, replace(before, counts_until=after.counts_from, end=end))
    else:
        _cut_at_the_end(old, new, Sidecars(before, after), reader)


def cut_clock(bag: Path, reader: BagReader) -> CutClock:
    """Finds out whether a bag file has publish times of their own; yes if it is empty.

    Raises:
        RecorderError: the disk fails.
    """
    try:
        records = list(islice(_records(bag, reader), SAMPLE))
    except BagUnreachableError as error:
        raise RecorderError(str(error)) from error
    except BagError:
        return CutClock.PUBLISH
    equal = bool(records) and all(each.publish_time in {0, each.log_time} for each in records)
    return CutClock.LOG if equal else CutClock.PUBLISH


class _End(NamedTuple):
    publish_time: Ns
    log_time: Ns


def _cut_at_the_end(old: Path, new: Path, found: Sidecars, reader: BagReader) -> None:
    """Has the old recording count up to its end, and the new one from there.

    The new one may itself have handed over since, if this could not be written at once: what its
    sidecar records about its own end is kept.
    """
    before, after = found
    last = _end_of(old, reader)
    if last is None:
        write_handover(new, replace(after, state=Counting.COUNTS, previous=old.name, compared=True))
        write_handover(old, intended(before, None))
        return
    bags = bags_of(new, reader)
    first = min((summary.start for _, summary in bags), default=last.log_time)
    cut, until = last.publish_time + 1, min(last.log_time + JITTER_NS, first + LONGEST_NS)
    later = {name for name, summary in bags if summary.start >= until}
    # A file that cannot be read yet is still being written.
    files = tuple(path.name for path in bag_files(new, reader) if path.name not in later)
    begin = Overlap(None, until, files)
    clock = cut_clock(new / bags[0][0], reader) if bags else CutClock.PUBLISH
    start = replace(
        after,
        state=Counting.COUNTS,
        clock=clock,
        previous=old.name,
        counts_from=cut,
        begin=begin,
        notes=(LOG_CLOCK_NOTE,) if clock is CutClock.LOG else (),
        compared=False,
    )
    write_handover(new, start)
    write_handover(old, replace(before, counts_until=cut, end=Overlap(None, None, ())))


def _end_of(recording: Path, reader: BagReader) -> _End | None:
    """Returns the newest publish time and log time in the last bag file that is not empty."""
    bags = bags_of(recording, reader)
    if not bags:
        return None
    name, _ = max(bags, key=lambda each: each[1].end)
    newest: _End | None = None
    try:
        for record in _records(recording / name, reader):
            published, logged = newest or (MIN_NS, MIN_NS)
            # A publish time of 0 means that there is none.
            latest = max(published, record.publish_time or record.log_time)
            newest = _End(latest, max(logged, record.log_time))
    except BagUnreachableError:
        raise
    except BagError:
        pass  # what could be read of it counts
    return newest


def _records(bag: Path, reader: BagReader) -> Iterator[Record]:
    """Yields messages of topics that are not latched: latched ones may be published long before."""
    topics = [each.topic for each in reader.summarize(bag).topics if not each.latched]
    return reader.records(bag, topics, TimeWindow(MIN_NS, MAX_NS))


def _reaches(summary: BagSummary, start: Ns | None) -> bool:
    return start is None or summary.end >= start
