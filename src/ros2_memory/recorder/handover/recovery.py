"""Handovers that a crash cut short: which recording has what, found by reading both.

The old recording names the new one before it is started, so nothing is inferred from times: only
of a pair that is known to have overlapped is it asked how far the old one reaches. What it holds
counts there, and the new one counts from then on.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple

import structlog

from ros2_memory.bag_dir.handover_file import (
    Counting,
    CutClock,
    Overlap,
    handover_to_change,
    read_handover,
    write_handover,
)
from ros2_memory.core.errors import BagError, BagUnreachableError, RecorderError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_MS, NS_PER_S, Ns
from ros2_memory.recorder.handover.plan import Sidecars, withdrawn

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from ros2_memory.core.model import BagSummary
    from ros2_memory.storage.base import BagReader, Record

JITTER_NS: Final[Ns] = 100 * NS_PER_MS
"""By less than this two recorders differ in when they received one message."""
LONGEST_NS: Final[Ns] = 60 * NS_PER_S
"""For longer than this two recorders never run side by side, whatever a clock that was set says."""
SAMPLE: Final = 2000
"""Messages looked at to tell whether publish times differ from log times."""

_log: structlog.typing.FilteringBoundLogger = structlog.get_logger(__name__)


def recover_handovers(bag_dir: Path, reader: BagReader, running: Collection[str] = ()) -> None:
    """Brings every handover below the bag directory to its end. Reports what it cannot settle.

    `running` are recordings that are being written: those may yet come to the end of theirs.

    Raises:
        OSError: the bag directory cannot be listed.
    """
    for directory in sorted(each for each in bag_dir.iterdir() if _is_folder(each)):
        new_name = None if directory.name in running else unsettled(directory)
        if new_name is None:
            continue
        try:
            recover_handover(directory, bag_dir / new_name, reader)
        except RecorderError as error:
            _log.error("handover_not_settled", recording=directory.name, reason=str(error))


def _is_folder(path: Path) -> bool:
    """Whether it is a directory itself, and not a link to one elsewhere."""
    return path.is_dir() and not path.is_symlink()


def unsettled(recording: Path) -> str | None:
    """The recording that this one was handing over to when it was cut short; None mostly."""
    handover = read_handover(recording).handover
    return handover.next if handover.counts_until is None else None


def recover_handover(old: Path, new: Path, reader: BagReader) -> None:
    """Writes down which of two overlapping recordings has what, after both have ended.

    Raises:
        RecorderError: the recordings cannot be looked at, or it cannot be written.
    """
    try:
        _settle(old, new, reader)
    except OSError as error:
        raise RecorderError(f"{error.filename}: {error.strerror or error}") from error
    except BagUnreachableError as error:
        # What a disk hides for the moment must not be written down as missing.
        raise RecorderError(str(error)) from error
    _log.info("handover_settled", recording=old.name, next=new.name)


def _settle(old: Path, new: Path, reader: BagReader) -> None:
    before = handover_to_change(old)
    if not _is_folder(new):
        write_handover(old, withdrawn(before))
        return
    after = handover_to_change(new)
    if after.state is Counting.VOID:
        write_handover(old, withdrawn(before))
    elif after.state is Counting.COUNTS and after.counts_from is not None:
        # The crash came between the two sidecars of a complete handover.
        start = after.begin.log_from if after.begin is not None else None
        files = tuple(name for name, summary in _bags(old, reader) if _reaches(summary, start))
        end = Overlap(start, None, files)
        write_handover(old, replace(before, counts_until=after.counts_from, end=end))
    else:
        _cut_at_the_end(old, new, Sidecars(before, after), reader)


def cut_clock(bag: Path, reader: BagReader) -> CutClock:
    """Whether publish times differ from log times in a bag file; they do where it is empty.

    Raises:
        RecorderError: the disk fails.
    """
    try:
        records = list(islice(_records(bag, reader), SAMPLE))
    except BagUnreachableError as error:
        raise RecorderError(str(error)) from error
    except BagError:
        return CutClock.PUBLISH
    equal = bool(records) and all(each.publish_time == each.log_time for each in records)
    return CutClock.LOG if equal else CutClock.PUBLISH


class _Reach(NamedTuple):
    publish_time: Ns
    log_time: Ns


def _cut_at_the_end(old: Path, new: Path, found: Sidecars, reader: BagReader) -> None:
    """The old recording counts as far as it reaches, the new one from there.

    The new one may have handed over itself since, where this could not be written down at once:
    what its sidecar says of its own end stands.
    """
    before, after = found
    reach = _reach(old, reader)
    if reach is None:
        write_handover(new, replace(after, state=Counting.COUNTS, previous=old.name))
        write_handover(old, withdrawn(before))
        return
    bags = _bags(new, reader)
    first = min((summary.start for _, summary in bags), default=reach.log_time)
    cut, until = reach.publish_time + 1, min(reach.log_time + JITTER_NS, first + LONGEST_NS)
    later = {name for name, summary in bags if summary.start >= until}
    # One that cannot be read yet is still being written.
    files = tuple(path.name for path in _files(new, reader) if path.name not in later)
    begin = Overlap(None, until, files)
    start = replace(after, state=Counting.COUNTS, previous=old.name, counts_from=cut, begin=begin)
    write_handover(new, start)
    write_handover(old, replace(before, counts_until=cut, end=Overlap(None, None, ())))


def _reach(recording: Path, reader: BagReader) -> _Reach | None:
    """The newest publish time and log time in the last bag file that holds anything."""
    bags = _bags(recording, reader)
    if not bags:
        return None
    name, _ = max(bags, key=lambda each: each[1].end)
    newest: _Reach | None = None
    try:
        for record in _records(recording / name, reader):
            if newest is None:
                newest = _Reach(record.publish_time, record.log_time)
            newest = _Reach(
                max(newest.publish_time, record.publish_time),
                max(newest.log_time, record.log_time),
            )
    except BagUnreachableError:
        raise
    except BagError:
        return newest
    return newest


def _bags(recording: Path, reader: BagReader) -> list[tuple[str, BagSummary]]:
    """The bag files with at least one message, by name."""
    found: list[tuple[str, BagSummary]] = []
    for path in _files(recording, reader):
        try:
            summary = reader.summarize(path)
        except BagUnreachableError:
            raise
        except BagError:
            continue
        if not summary.empty:
            found.append((path.name, summary))
    return found


def _files(recording: Path, reader: BagReader) -> list[Path]:
    return sorted(each for each in recording.iterdir() if reader.reads(each))


def _records(bag: Path, reader: BagReader) -> Iterator[Record]:
    """The messages on topics that are not latched: a latched one may be published long before."""
    topics = [each.topic for each in reader.summarize(bag).topics if not each.latched]
    return reader.records(bag, topics, TimeWindow(MIN_NS, MAX_NS))


def _reaches(summary: BagSummary, start: Ns | None) -> bool:
    return start is None or summary.end >= start
