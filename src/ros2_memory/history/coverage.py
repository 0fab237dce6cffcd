"""What a question's window touched and could not be read: part of the answer, never passed over.

Named are, the first few of each and the others counted:

- files that were not read at all: damaged, or of a kind that is not read here. Such a file says
  nothing of its times, so it counts where its recording and its own date have it lie (see
  `recorder.whereabouts`): an old one that nobody removes is not part of every answer for ever.
  Where the answer is that there is nothing, it counts unless it is known to lie elsewhere.
- splits that the metadata.yaml of a recording lists and that are not there, beside searches and
  answers that there is nothing.
- the file that is still being written, from the end of the split before it on, or, where what is
  whole of it answers, from there on;
- bags that a crash left open, on to the last time that their files were written to;
- closed bags of which parts could not be read, or that contradict themselves;
- bags that a wrong clock dated, where the answer is not that there is nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.bag_dir.handover_file import LOG_CLOCK_NOTE
from ros2_memory.core.bag_summary import (
    DOUBTS,
    MESSAGES_MISSING,
    READ_WITHOUT_INDEXES,
)
from ros2_memory.core.model import BagState, TimeWindow
from ros2_memory.core.text import MAX_NAMED, counted, listed, shortened
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    START_SLACK_NS,
    unix_rounded_up,
)
from ros2_memory.history.notes import short_name
from ros2_memory.index.listed_splits import absent_files

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.core.model import BagFile, SetAside
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.view import View
    from ros2_memory.index.clock_faults import ClockFault
    from ros2_memory.index.snapshot import Snapshot


def note_unread(
    view: View, window: TimeWindow, *, nothing: bool = False, search: bool = False
) -> None:
    """Notes what of a window could not be read.

    `nothing`: the answer is that there is nothing. Then, and after a `search`, splits that are
    listed and not there count too.
    """
    if window.empty:
        return
    absent = _absent(view) if nothing or search else ()
    odd = [bag for bag in view.snapshot.odd(window) if not _is_noted(view, bag)]
    for sentence in unread_spans(view.snapshot, window, nothing=nothing, absent=absent, odd=odd):
        view.notes.add(sentence)
    # Of more than are named a reason is not given for each.
    if len({bag.summary.remarks for bag in odd}) <= MAX_NAMED:
        view.notes.add_remarks(odd)


def note_edges(view: View, window: TimeWindow) -> None:
    """Says where a window was asked to reach past what the memory can answer."""
    snapshot = view.snapshot
    asked_from, asked_to = window.asked()
    earliest = snapshot.earliest
    if earliest is not None and asked_from < earliest:
        before = TimeWindow(asked_from, earliest)
        if not any(before.overlaps(each.bag.start, each.bag.end) for each in snapshot.misdated):
            view.notes.add(f"the memory begins at {_moment(earliest)}")
    if snapshot.latest is None or asked_to <= snapshot.latest:
        return
    if snapshot.active:
        view.notes.add(nothing_after(snapshot.active, snapshot.latest))
    else:
        view.notes.add(f"the memory ends at {_moment(snapshot.latest)}")


def nothing_after(active: Sequence[SetAside], latest: Ns) -> str:
    """The sentence on a window that reaches past the newest message, while files are written."""
    if all(aside.answers for aside in active):
        return f"nothing after {_moment(latest)} is on disk yet"
    return f"the split being written is not included: nothing after {_moment(latest)}"


def _moment(at: Ns) -> str:
    return f"{unix_rounded_up(at):.6f}"


def is_searched(view: View, window: TimeWindow) -> bool:
    """Whether a search of a window that found nothing read all that closed files hold of it.

    That one is being written is no reason to doubt it, or a robot that records would never be told
    that something was not there.
    """
    lost = lost_in(view.snapshot, window, nothing=True, absent=_absent(view))
    return view.notes.complete and not lost and not any(map(_may_lack, view.snapshot.odd(window)))


def _is_noted(view: View, bag: BagFile) -> bool:
    """Whether the notes have what is amiss of a bag; that it was left open they have not."""
    return bag.state is not BagState.INCOMPLETE and view.notes.has_remarks(bag)


def _absent(view: View) -> Sequence[SetAside]:
    return absent_files(view.snapshot, view.memory.index.bag_dir)


def _may_lack(bag: BagFile) -> bool:
    """Whether not all messages of a bag could be read."""
    return bag.state is BagState.INCOMPLETE or not all(map(_is_whole, bag.summary.notes))


def _is_whole(note: str) -> bool:
    """Whether all messages of a bag were read of which this note says what is odd."""
    if note.startswith(DOUBTS):
        return not note.endswith(MESSAGES_MISSING)
    return note.endswith(READ_WITHOUT_INDEXES) or note == LOG_CLOCK_NOTE


def unread_spans(
    snapshot: Snapshot,
    window: TimeWindow,
    *,
    nothing: bool = False,
    absent: Sequence[SetAside] = (),
    odd: Sequence[BagFile] | None = None,
) -> Iterator[str]:
    """The sentences for a window; none where all of it was read.

    `odd`: the bags to name of those of which something is amiss; all where it is not given.
    """
    if lost := lost_in(snapshot, window, nothing=nothing, absent=absent):
        yield not_read(lost)
    active = _being_written(snapshot, window)
    if active:
        yield _still_written(snapshot, active, window)
    faults = [
        fault for fault in snapshot.misdated if window.overlaps(fault.bag.start, fault.bag.end)
    ]
    if faults and not nothing:
        yield misdated(faults)
    yield from amiss(snapshot.odd(window) if odd is None else odd)


def lost_in(
    snapshot: Snapshot,
    window: TimeWindow,
    *,
    nothing: bool = False,
    absent: Sequence[SetAside] = (),
) -> list[SetAside]:
    """The files, also `absent` ones, that were not read at all and probably hold some of a window.

    With `nothing` all that may.
    """
    places = snapshot.bounds if nothing else snapshot.places
    if absent:
        places = {**snapshot.bounds_of(absent), **places}
    return [
        aside
        for aside in (*absent, *snapshot.damaged, *snapshot.unread)
        if _touches(places[aside], window, unknown=nothing)
    ]


def may_be_written(snapshot: Snapshot, window: TimeWindow) -> bool:
    """Whether a file that is still being written may hold messages of a window unseen."""
    return bool(_being_written(snapshot, window))


def not_read(files: Sequence[SetAside]) -> str:
    """The sentence on files that no question can look into, the latest ones named."""
    names = [f"{short_name(each.path)} ({shortened(each.reason)})" for each in files[-MAX_NAMED:]]
    what = counted(len(files), "bag file")
    return f"{what} could not be read and may hold more: {listed(names, len(files))}"


def _being_written(snapshot: Snapshot, window: TimeWindow) -> list[SetAside]:
    return [
        aside for aside in snapshot.active if _touches(snapshot.places[aside], window, unknown=True)
    ]


def _touches(place: TimeWindow | None, window: TimeWindow, *, unknown: bool) -> bool:
    if place is None:
        return unknown
    # Without what the bounds were widened by: a window up to a split's end does not touch the next.
    stop = max(window.stop - AT_OR_BEFORE_SLACK_NS, window.start + 1)
    return place.start < stop - 1 and window.start + START_SLACK_NS < place.stop


def _still_written(snapshot: Snapshot, active: Sequence[SetAside], window: TimeWindow) -> str:
    latest = snapshot.latest
    if latest is not None and window.stop - 1 - AT_OR_BEFORE_SLACK_NS > latest:
        return nothing_after(snapshot.active, latest)
    lacking = [short_name(each.path) for each in active if not each.answers]
    if lacking:
        return f"still being written and not included: {listed(lacking)}"
    names = [short_name(each.path) for each in active]
    return f"still being written and not all on disk yet: {listed(names)}"


def _left_open(bags: Sequence[BagFile]) -> Iterator[str]:
    if bags:
        names = [_with_notes(bag) for bag in bags[-MAX_NAMED:]]
        yield (
            f"{counted(len(bags), 'bag')} left open by a crash; what is readable is used: "
            f"{listed(names, len(bags))}"
        )


def _odd(bags: Sequence[BagFile]) -> Iterator[str]:
    yield from by_remark([(bag, "; ".join(bag.summary.remarks)) for bag in bags], MAX_NAMED)


def by_remark(bags: Sequence[tuple[BagFile, str]], most: int) -> Iterator[str]:
    """One sentence for each remark that bags have in common, those of the newest bags alone."""
    names: dict[str, list[str]] = {}
    for bag, remark in reversed(bags):
        names.setdefault(shortened(remark), []).append(short_name(bag.path))
    told = [*names.items()][:most]
    for remark, [name, *others] in reversed(told):
        subject = f"{len(others) + 1} bags ({listed([name, *others])})" if others else name
        yield f"{subject}: {remark}"
    more = len(bags) - sum(len(each) for _, each in told)
    if more:
        yield f"{counted(more, 'older bag is', 'older bags are')} odd too"


def amiss(bags: Sequence[BagFile]) -> Iterator[str]:
    """The sentences on bags that are not whole or contradict themselves."""
    if bags:
        yield from _left_open([bag for bag in bags if bag.state is BagState.INCOMPLETE])
        yield from _odd([bag for bag in bags if bag.state is not BagState.INCOMPLETE])


def misdated(faults: Sequence[ClockFault]) -> str:
    """The sentence on bags that a wrong clock dated, the last ones named."""
    names = [f"{short_name(fault.bag.path)} ({fault.told})" for fault in faults[-MAX_NAMED:]]
    return f"{counted(len(faults), 'bag')} dated by a wrong clock: {listed(names, len(faults))}"


def _with_notes(bag: BagFile) -> str:
    name = short_name(bag.path)
    return f"{name} ({shortened('; '.join(bag.summary.remarks))})" if bag.summary.remarks else name
