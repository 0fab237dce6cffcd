"""Coverage: notes in an answer on data of its window that could not be read.

The first few of each kind are named, and the others counted:

- files that were not read at all: damaged, or of a kind that is not read here. Such a file has no
  readable times, so it counts where its recording and its own date place it (see
  `index.snapshot`): an old one that nobody removes is not part of every answer for ever.
  Where the answer is that there is nothing, it counts unless it is known to lie elsewhere.
- splits that the metadata.yaml of a recording lists and that are missing, for searches and answers
  that there is nothing.
- the file that is still being written, from the end of the split before it on, or, where what is
  on disk of it answers, from the end of that on;
- bags that a crash left open, up to the last time that their files were written to;
- closed bags of which parts could not be read, or that contradict themselves;
- gaps, and times before the memory begins, of which retention deleted what was recorded;
- messages that the recorder found to be missing (`bag_dir.state_files`);
- stretches that `recording.exclude_when` excluded;
- bags that a wrong clock dated, except where the answer is that there is nothing.
"""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from itertools import chain
from typing import TYPE_CHECKING, Final

from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.analysis.silences import LONGEST_OFF_NS
from ros2_memory.bag_dir.handover_file import LOG_CLOCK_NOTE
from ros2_memory.bag_dir.layout import OWN_FOLDER, is_carried
from ros2_memory.bag_dir.state_files import (
    INTERRUPTIONS,
    Loss,
    deleted_spans,
    excluded_between,
    read_losses,
)
from ros2_memory.core.bag_summary import (
    DOUBTS,
    MESSAGES_MISSING,
    READ_WITHOUT_INDEXES,
)
from ros2_memory.core.model import BagFile, BagState, SetAside, TimeWindow
from ros2_memory.core.spans import Spans, overlaps_any, united, without
from ros2_memory.core.text import MAX_NAMED, counted, listed, shortened
from ros2_memory.core.timebase import (
    AT_OR_BEFORE_SLACK_NS,
    MAX_NS,
    MIN_NS,
    NS_PER_S,
    NS_PER_US,
    START_SLACK_NS,
    Ns,
    Span,
    unix_from_ns,
    unix_rounded_up,
)
from ros2_memory.history.context import short_name
from ros2_memory.index.file_state import HELD_BACK
from ros2_memory.index.listed_splits import absent_files

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.history.view import View
    from ros2_memory.index.clock_faults import ClockFault
    from ros2_memory.index.snapshot import Snapshot

_RESTART_NS: Final = 10 * NS_PER_S
"""What an interruption costs may begin so much earlier, and end so much later."""
_EDGE_NS: Final = 20 * NS_PER_S
"""So much of a window may lie before or after the memory without a note on what was recorded."""


def note_unread(
    view: View,
    window: TimeWindow,
    *,
    nothing: bool = False,
    search: bool = False,
    of: str = "",
    gaps: bool = True,
) -> None:
    """Adds notes on data of a window that could not be read.

    With `nothing` the answer is that there is nothing. Then, and after a `search`, splits that are
    listed and missing count too. `of` says which window it is, for sentences without a time.
    Without `gaps` none is on times in which nothing was recorded: what is returned shows them.
    """
    if window.empty:
        return
    absent = _absent(view) if nothing or search else ()
    odd = [
        bag
        for bag in view.timeline.faulty(window)
        # There is no note about bags that a crash left open.
        if bag.state is BagState.INCOMPLETE or not view.notes.notes_cover_remarks(bag)
    ]
    view.notes.add(*describe_gaps(view, window, explained=window.start <= MIN_NS) if gaps else ())
    if nothing or search:
        view.notes.add(*describe_thinned(view.snapshot, window))
    bag_dir = view.bag_dir
    if os.path.lexists(bag_dir / OWN_FOLDER):
        view.notes.add(
            *describe_deleted(view, window),
            *(f"{of}{sentence}" for sentence in describe_lost(bag_dir, window)),
            *(f"{of}{sentence}" for sentence in describe_cut(bag_dir, window)),
            *describe_excluded(bag_dir, window),
        )
    if (nothing or search) and _are_losses_hidden(bag_dir):
        view.notes.add_lack(f"{OWN_FOLDER} cannot be read: what was lost or deleted is not known")
    view.notes.add(*unread_spans(view.snapshot, window, nothing=nothing, absent=absent, odd=odd))
    # Where there are more kinds of remarks than are named, not every bag's remark is in a sentence.
    if len({bag.summary.remarks for bag in odd}) <= MAX_NAMED:
        view.notes.add_remarks(odd)


def _are_losses_hidden(bag_dir: Path) -> bool:
    own = bag_dir / OWN_FOLDER
    return os.path.lexists(own) and not os.access(own, os.X_OK)


def describe_thinned(snapshot: Snapshot, window: TimeWindow) -> Iterator[str]:
    """Yields a sentence on days of a window of which only some messages stayed, if there are."""
    days = [bag for bag in snapshot.timeline.thinned if bag.reaches_into(window)]
    if days and overlaps_any(snapshot.timeline.thinned_times, window.start, window.stop - 1):
        span = f"{unix_text(days[0].start)} to {unix_text(max(bag.end for bag in days))}"
        yield (
            f"of {counted(len(days), 'day')} in {span} only some messages stayed: all that a topic "
            "changed to, saw and had as extremes, and no texts but those that memory.texts names"
        )


_LOST: Final = (
    ("lost before {they} recorded", ("counter", "rosbag2")),
    # A publisher that skipped one leaves the same mark as a loss.
    ("missing by the cadence of header stamps (never published, or lost)", ("stamps",)),
)
_CUT: Final = (
    ("deleted by request", ("forgotten",)),
    ("deleted by retention (retention.topics)", ("expired",)),
)


def describe_cut(bag_dir: Path, window: TimeWindow) -> Iterator[str]:
    """Yields a sentence for each reason for which messages of a window were cut out of bags."""
    return _counted_losses(read_losses(bag_dir, window.start, window.stop), _CUT)


def _counted_losses(
    losses: Iterable[Loss], kinds: Iterable[tuple[str, Collection[str]]]
) -> Iterator[str]:
    """Yields how many messages of which topics some kinds of losses have."""
    for what, by in kinds:
        topics = Counter[str]()
        for loss in losses:
            if loss.by in by:
                topics[loss.topic] += loss.lost
        if topics:
            most = sorted(topics.items(), key=lambda item: (-item[1], item[0]))
            named = listed([f"{topic} ({count})" for topic, count in most])
            lost = topics.total()
            they = "it was" if lost == 1 else "they were"
            yield f"{counted(lost, 'message')} {what.format(they=they)}: {named}"


def describe_lost(bag_dir: Path, window: TimeWindow) -> Iterator[str]:
    """Yields a sentence for each way in which messages of a window are known to be missing."""
    losses = read_losses(bag_dir, window.start, window.stop)
    yield from _counted_losses(losses, _LOST)
    refused = defaultdict[str, Spans](list)
    for loss in losses:
        if loss.by == "refused":
            refused[loss.topic].append((loss.start, loss.stop - 1))
    for topic in sorted(refused)[:MAX_NAMED]:
        spans = [_span_text(*span) for span in united(refused[topic], _EDGE_NS)]
        yield (
            f"messages of a publisher of {topic} were not recorded from "
            f"{listed(spans[-MAX_NAMED:], len(spans))}, as its QoS or type did not fit the "
            "subscription: how many is not known"
        )


def describe_gaps(view: View, window: TimeWindow, *, explained: bool) -> Iterator[str]:
    """Yields a sentence for each reason for which nothing was recorded in a part of a window.

    What was deleted or excluded was recorded; what files have that cannot be read may have been.
    And one where recording ended unexpectedly after the newest data, which no gap shows yet.
    Without a reason where none is known, unless only gaps that are `explained` are asked for.
    """
    bag_dir, snapshot, touched = view.bag_dir, view.snapshot, view.gaps(window)
    interruptions = [
        loss for loss in read_losses(bag_dir, MIN_NS, MAX_NS) if loss.by in INTERRUPTIONS
    ]
    yield from _describe_open_end(view, window, interruptions)
    if not touched:
        return
    if explained and not interruptions:
        return
    texts = defaultdict[tuple[str, str], list[str]](list)
    gone = united([*deleted_spans(bag_dir), *excluded_spans(bag_dir)])
    absent = _absent(view)
    for part in chain.from_iterable(_unrecorded(snapshot, gap, gone) for gap in touched):
        inside = TimeWindow(part[0] + 1, part[1])
        may_hold = bool(lost_in(snapshot, inside, nothing=True, absent=absent))
        may_come = being_written(snapshot, inside)
        for by, start, end in _by_cause(part, interruptions, 0 if may_hold else _RESTART_NS):
            if (start, end) != part and not by and end - start <= snapshot.shortest_gap:
                continue
            if window.overlaps(start, end) and (by or not (explained or may_come)):
                what = "could be read" if may_hold and not by else "was recorded"
                texts[by, what].append(_span_text(start, end))
    for (by, what), spans in texts.items():
        named = listed(spans[-MAX_NAMED:], len(spans))
        because = f", because {INTERRUPTIONS[by]}" if by else ""
        yield f"nothing {what} from {named}{because}"


def _by_cause(
    part: Span, interruptions: Sequence[Loss], around: Ns
) -> Iterator[tuple[str, Ns, Ns]]:
    """Yields the interruptions in a part of a gap, and what is left of it, with "" for the cause.

    One of it reaches up to `around` farther: what had not reached the disk before it was lost as
    well, and the next start takes time.
    """
    left = [part]
    for loss in interruptions:
        if not (loss.start < part[1] and part[0] < loss.stop):
            continue
        rest = without(left, [(loss.start - around, loss.stop + around)])
        yield from ((loss.by, start, end) for start, end in without(left, rest))
        left = rest
    yield from (("", start, end) for start, end in left)


def _describe_open_end(
    view: View, window: TimeWindow, interruptions: Sequence[Loss]
) -> Iterator[str]:
    """Yields why messages may be missing after the newest data, if it is known.

    Not in a simulation, whose data is dated by another clock.
    """
    latest = view.snapshot.latest
    if latest is None or view.limits.now == "latest" or window.stop <= latest:
        return
    causes = dict.fromkeys(
        INTERRUPTIONS[loss.by]
        for loss in interruptions
        if latest < loss.stop and loss.start < window.stop
    )
    if causes:
        yield f"after {unix_text(latest)} messages may be missing, because {', and '.join(causes)}"


def _span_text(start: Ns, end: Ns) -> str:
    return f"{unix_text(start)} to {unix_text(end)} ({seconds(end - start)})"


def _unrecorded(snapshot: Snapshot, gap: Span, gone: Sequence[Span]) -> Sequence[Span]:
    """Returns the parts of a gap in which nothing was recorded that was deleted since."""
    parts = without([gap], gone)
    if parts == [gap]:
        return parts
    # Before the first message that was deleted, and after the last, is as little as between others.
    return [(start, end) for start, end in parts if end - start > snapshot.shortest_gap]


def deleted_between(view: View, window: TimeWindow) -> Spans:
    """Returns the spans in a window, or around its ends, that retention deleted since.

    Those in gaps, and those before the memory begins unless the window is open there (`MIN_NS`).
    """
    first, last = window.asked()
    return [
        (start, stop)
        for _, deleted in deleted_by_gap(view, window)
        for start, stop in deleted
        if start < last and first < stop
    ]


def deleted_by_gap(view: View, window: TimeWindow) -> Iterator[tuple[Ns, Spans]]:
    """Yields the end of each gap that a window overlaps and retention deleted some of, with that.

    First that of the time before the memory, unless the window is open there (`MIN_NS`).
    """
    snapshot, gone = view.snapshot, deleted_spans(view.bag_dir)
    if not gone:
        return
    gaps: list[tuple[Ns, Spans]] = []
    if window.start > MIN_NS and (earliest := snapshot.earliest) is not None:
        gaps.append((earliest, [(start, min(stop, earliest)) for start, stop in gone]))
    gaps += (
        (gap[1], without([gap], _unrecorded(snapshot, gap, gone)))
        for gap in snapshot.gaps
        if window.overlaps(*gap)
    )
    for end, parts in gaps:
        deleted = [(start, stop) for start, stop in parts if stop - start > snapshot.shortest_gap]
        if deleted:
            yield end, deleted


def describe_deleted(view: View, window: TimeWindow) -> Iterator[str]:
    """Yields a sentence on what was deleted whole of a window, if some was, and around that."""
    if spans := [_span_text(*span) for span in deleted_between(view, window)]:
        yield f"recorded, and deleted since: {listed(spans[-MAX_NAMED:], len(spans))}"


def cut_spans(bag_dir: Path, topic: str, window: TimeWindow) -> Sequence[Span]:
    """Returns when messages of a topic were deleted, and others of their bags were not.

    By request, or by `retention.topics`. Those intervals (log time, half-open) that overlap the
    window, in order, joined where they overlap.
    """
    losses = read_losses(bag_dir, window.start, window.stop)
    gone = (loss for loss in losses if loss.topic == topic and loss.by in {"forgotten", "expired"})
    return united((loss.start, loss.stop) for loss in gone)


def excluded_spans(bag_dir: Path, window: TimeWindow | None = None) -> Spans:
    """Returns the intervals (log time, half-open) that overlap a window and were excluded."""
    start, stop = (MIN_NS, MAX_NS) if window is None else (window.start, window.stop)
    excluded = excluded_between(bag_dir, start, stop)
    return united(stretch.span for stretch in excluded)


def unexcluded(view: View, gaps: Iterable[Span]) -> Iterator[Span]:
    """Yields the gaps of the recording without what was excluded."""
    excluded = excluded_spans(view.bag_dir)
    for gap in gaps:
        yield from _unrecorded(view.snapshot, gap, excluded)


def was_removed(view: View, window: TimeWindow) -> bool:
    """Whether some of a window was deleted by retention, or excluded."""
    excluded = excluded_between(view.bag_dir, window.start, window.stop)
    return bool(excluded or deleted_between(view, window))


def describe_excluded(bag_dir: Path, window: TimeWindow) -> Iterator[str]:
    """Yields a sentence on the intervals of a window that were excluded."""
    if spans := excluded_spans(bag_dir, window):
        named = [f"{unix_text(start)} to {unix_text(stop)}" for start, stop in spans[-MAX_NAMED:]]
        yield (
            "excluded by the rules of recording.exclude_when, so there is no data of it: "
            f"{listed(named, len(spans))}"
        )


def note_edges(view: View, window: TimeWindow) -> None:
    """Adds a note if a window reaches past the begin or the end of the recorded data."""
    snapshot = view.snapshot
    asked_from, _ = window.asked()
    earliest = snapshot.earliest
    if earliest is not None and asked_from < earliest:
        before = TimeWindow(asked_from, earliest)
        if not any(fault.bag.reaches_into(before) for fault in snapshot.misdated):
            view.notes.add(f"the memory begins at {unix_text(earliest)}")
    if snapshot.latest is None or not _ends_after(window, snapshot.latest):
        return
    if snapshot.active:
        view.notes.add(_nothing_after(snapshot.active, snapshot.latest))
    else:
        view.notes.add(f"the memory ends at {unix_text(snapshot.latest)}")


def _ends_after(window: TimeWindow, latest: Ns) -> bool:
    """Whether a window was asked to end after the newest data, whose time replies round up."""
    return window.asked()[1] >= latest + NS_PER_US


def seconds(duration: Ns) -> str:
    """Returns a duration for a sentence: three digits, and to the second or better up to a week."""
    length = unix_from_ns(duration)
    if duration > LONGEST_OFF_NS:
        return f"{length / 86_400:.0f} days"
    return f"{length:.0f} s" if length >= 100 else f"{length:.3g} s"


def unix_text(at: Ns) -> str:
    """Returns a log time as Unix seconds, rounded up so that a query at that time finds it."""
    return f"{unix_rounded_up(at):.6f}"


def not_covered(view: View, topics: Collection[str], window: TimeWindow) -> tuple[str, ...]:
    """Returns why a search of topics in a window was not complete; empty where it was.

    It was where all that closed files hold of the window was read, and nothing of the topics was
    deleted out of bags, nor by retention between two bags. A file that is being written
    does not count: or else no search of a robot that records would be complete.
    """
    is_complete = view.notes.complete and all(map(is_whole, view.timeline.faulty(window)))
    if is_complete and not (
        _are_losses_hidden(view.bag_dir)
        or lost_in(view.snapshot, window, nothing=True, absent=_absent(view))
        or excluded_between(view.bag_dir, window.start, window.stop)
        or any(cut_spans(view.bag_dir, topic, window) for topic in topics)
        or deleted_between(view, window)
        or any(describe_thinned(view.snapshot, window))
    ):
        return ()
    note_unread(view, window, nothing=True)
    return view.notes.sentences()


def _absent(view: View) -> Sequence[SetAside]:
    return absent_files(view.memory.absent_splits(view.snapshot))


def is_whole(bag: BagFile) -> bool:
    """Whether all messages of an odd bag could be read."""
    return bag.state is not BagState.INCOMPLETE and all(
        not note.endswith(MESSAGES_MISSING)
        if note.startswith(DOUBTS)
        else note.endswith(READ_WITHOUT_INDEXES) or note == LOG_CLOCK_NOTE
        for note in bag.summary.notes
    )


def unread_spans(
    snapshot: Snapshot,
    window: TimeWindow,
    *,
    nothing: bool,
    absent: Sequence[SetAside],
    odd: Sequence[BagFile],
) -> Iterator[str]:
    """Yields the sentences for a window; none where all of it was read.

    `odd` are the bags to name of those that are not whole.
    """
    if lost := lost_in(snapshot, window, nothing=nothing, absent=absent):
        names = [
            f"{short_name(aside.path)} ({shortened(aside.reason)})" for aside in lost[-MAX_NAMED:]
        ]
        files = counted(len(lost), "bag file")
        yield f"{files} could not be read and may hold more: {listed(names, len(lost))}"
    active = being_written(snapshot, window, nothing=nothing)
    # Splits are not served before they were searched.
    if held := [short_name(aside.path) for aside in active if aside.reason == HELD_BACK]:
        yield f"{HELD_BACK}: {listed(held)}"
    if any(aside.reason != HELD_BACK for aside in active):
        yield _describe_active(snapshot, active, window)
    faults = [fault for fault in snapshot.misdated if fault.bag.reaches_into(window)]
    if faults and not nothing:
        yield describe_misdated(faults)
    yield from describe_odd(odd)


def lost_in(
    snapshot: Snapshot,
    window: TimeWindow,
    *,
    nothing: bool = False,
    absent: Sequence[SetAside] = (),
) -> list[SetAside]:
    """Returns the files, `absent` ones included, that probably hold some of a window.

    None of them was read at all. With `nothing`, those that may hold some.
    """
    spans = snapshot.unread_bounds if nothing else snapshot.unread_spans
    if absent:
        spans = {**snapshot.bounds_of(absent), **spans}
    return [
        aside
        for aside in (*absent, *snapshot.damaged, *snapshot.unread)
        if _touches(spans[aside], window, unknown=nothing)
    ]


def being_written(
    snapshot: Snapshot, window: TimeWindow, *, nothing: bool = False
) -> list[SetAside]:
    """Returns the files still being written that probably hold some of a window.

    With `nothing`, those that may hold some.
    """
    spans = snapshot.unread_bounds if nothing else snapshot.unread_spans
    return [aside for aside in snapshot.active if _touches(spans[aside], window, unknown=True)]


def _touches(span: TimeWindow | None, window: TimeWindow, *, unknown: bool) -> bool:
    if span is None:
        return unknown
    # Without what the bounds were widened by: a window up to a split's end does not touch the next.
    stop = max(window.stop - AT_OR_BEFORE_SLACK_NS, window.start + 1)
    return span.start < stop - 1 and window.start + START_SLACK_NS < span.stop


def _describe_active(snapshot: Snapshot, active: Sequence[SetAside], window: TimeWindow) -> str:
    latest = snapshot.latest
    if latest is not None and _ends_after(window, latest):
        return _nothing_after(snapshot.active, latest)
    excluded = [
        short_name(aside.path)
        for aside in active
        if not aside.answers and aside.reason != HELD_BACK
    ]
    if excluded:
        return f"still being written and not included: {listed(excluded)}"
    names = [short_name(aside.path) for aside in active]
    return f"still being written and not all on disk yet: {listed(names)}"


def _nothing_after(active: Sequence[SetAside], latest: Ns) -> str:
    if all(aside.answers for aside in active):
        return f"nothing after {unix_text(latest)} is on disk yet"
    return f"the split being written is left out: nothing after {unix_text(latest)}"


def by_remark(bags: Sequence[tuple[BagFile, str]], most: int) -> Iterator[str]:
    """Yields one sentence for each remark that bags share, for the remarks of the newest bags."""
    names: dict[str, list[str]] = {}
    for bag, remark in reversed(bags):
        names.setdefault(shortened(remark), []).append(short_name(bag.path))
    shown = [*names.items()][:most]
    for remark, [name, *others] in reversed(shown):
        subject = f"{len(others) + 1} bags ({listed([name, *others])})" if others else name
        yield f"{subject}: {remark}"
    more = len(bags) - sum(len(files) for _, files in shown)
    if more:
        yield f"{counted(more, 'older bag is', 'older bags are')} odd too"


def describe_odd(bags: Sequence[BagFile]) -> Iterator[str]:
    """Yields the sentences on bags that are not whole or contradict themselves."""
    remarked = [(bag, "; ".join(bag.summary.remarks)) for bag in bags]
    left_open = [(bag, remark) for bag, remark in remarked if bag.state is BagState.INCOMPLETE]
    if left_open:
        names = [
            f"{short_name(bag.path)} ({shortened(remark)})" if remark else short_name(bag.path)
            for bag, remark in left_open[-MAX_NAMED:]
        ]
        yield (
            f"{counted(len(left_open), 'unfinished bag')}; "
            f"{'its' if len(left_open) == 1 else 'their'} readable part is used: "
            f"{listed(names, len(left_open))}"
        )
    yield from by_remark(
        [(bag, remark) for bag, remark in remarked if bag.state is not BagState.INCOMPLETE],
        MAX_NAMED,
    )


def describe_misdated(faults: Sequence[ClockFault]) -> str:
    """Returns the sentence on bags that a wrong clock dated; the last ones are named."""
    names = [f"{short_name(fault.bag.path)} ({fault.description})" for fault in faults[-MAX_NAMED:]]
    return f"{counted(len(faults), 'bag')} dated by a wrong clock: {listed(names, len(faults))}"


def gap_around(view: View, asked: TimeWindow) -> tuple[Ns | None, Ns | None] | None:
    """Returns the gap that all of a window lies in: when recording ended, and when it went on.

    Before the memory it has no begin, after it no end: None. Returns None alone where something of
    the window was recorded, also by a bag that a wrong clock dated. An open end of the window is
    `MIN_NS` or `MAX_NS`.
    """
    snapshot = view.snapshot
    earliest, latest = snapshot.earliest, snapshot.latest
    if earliest is None or latest is None:
        return None
    misdated = (fault.bag for fault in snapshot.dating.faults if fault.misleads)
    is_misdated = any(bag.reaches_into(asked) for bag in misdated)
    if not is_misdated and (gaps := view.gaps(asked, around=True)):
        return gaps[0]
    segments = snapshot.timeline.segments_in(asked)
    bags = (bag for segment in segments for bag in segment.overlapping(asked))
    if not all(is_carried(bag.file) for bag in bags):
        return None
    start, end = asked.asked()
    if end < earliest:
        return None, earliest
    return (latest, None) if start > latest else None


def note_unrecorded(view: View, asked: TimeWindow) -> None:
    """Adds a note on how much of a window was not recorded, if some was not.

    It ends now at the latest, unless it begins later; or where the memory does if its end is open
    (`MAX_NS`).

    None where only pauses are missing that are no gap, and as little before and after the memory.
    """
    earliest, latest, memory = view.snapshot.earliest, view.snapshot.latest, view.memory
    if earliest is None or latest is None:
        return
    start, end = asked.asked()
    start = max(start, min(0, earliest))
    until = latest if asked.stop >= MAX_NS else memory.now(memory.clock.now(), latest)
    if start < until:
        end = min(end, until)
    until_end = TimeWindow(start, end)
    outside = (min(end, earliest) - start, end - max(start, latest))
    gaps = [last - first for first, last in recording_gaps(view, until_end)]
    length, missing = end - start, sum(max(span_ns, 0) for span_ns in (*outside, *gaps))
    when = f"between {unix_text(start)} and {unix_text(end)}"
    deleted = was_removed(view, until_end)
    if gap_around(view, asked) is not None:
        view.notes.add(why_nothing(when, deleted=deleted))
    elif gaps or max(outside) > _EDGE_NS:
        digits = 0 if length >= 100 * NS_PER_S else 1
        recorded_s, of_s = (
            f"{unix_from_ns(lasted):.{digits}f}" for lasted in (max(length - missing, 0), length)
        )
        what = "here are only" if deleted else "recorded only"
        if recorded_s != of_s:
            view.notes.add(f"{what} {recorded_s} of {of_s} s {when}")


def why_nothing(when: str, *, deleted: bool) -> str:
    """Returns that a time has no messages: none were recorded, or they were deleted since."""
    return f"what was recorded {when} was deleted" if deleted else f"nothing was recorded {when}"


def recorded_reach(snapshot: Snapshot, window: TimeWindow) -> Span | None:
    """Returns the first and the last moment of what the memory has that a window can show.

    Without bags that a wrong clock dated, unless the window has nothing else. None without a bag.
    """
    if snapshot.earliest is None or snapshot.latest is None:
        return None
    reach = snapshot.earliest, snapshot.latest
    if window.overlaps(*reach):
        return reach
    misdated = [fault.bag for fault in snapshot.misdated]
    shown = {bag.recording for bag in misdated if bag.reaches_into(window)}
    if not shown:
        return reach
    # Of whole recordings: where their bags end says nothing.
    faulty = [bag for bag in misdated if bag.recording in shown]
    return min(bag.start for bag in faulty), max(bag.end for bag in faulty)


def shown_span(snapshot: Snapshot, window: TimeWindow) -> Span:
    """Returns from when to when (inclusive) the memory can show a window, by `recorded_reach`.

    It ends before it begins where the memory shows nothing of it.
    """
    start, end = window.asked()
    first, last = recorded_reach(snapshot, window) or (start, end)
    return max(start, first), min(end, last)


def reached(snapshot: Snapshot, window: TimeWindow) -> TimeWindow:
    """Returns the part of a window that the memory can show, by `recorded_reach`."""
    first, last = recorded_reach(snapshot, window) or (window.start, window.stop - 1)
    return window.intersect(TimeWindow(first, last + 1))


def recording_gaps(view: View, window: TimeWindow | None = None) -> Iterator[Span]:
    """Yields where nothing was recorded, by `View.gaps`; of a window, the parts in it.

    A part that only the tolerance of its bounds reaches is left out.
    """
    asked = window or TimeWindow.everything()
    for start, end in view.gaps(asked):
        yield max(start, asked.start), min(end, asked.stop)


def unknown_times(
    view: View, window: TimeWindow, known: Spans, what: str, *, mixed: Spans
) -> Spans:
    """Returns the recorded times of a window in which something is not known, in order.

    `known` are the times in which it is: between these, and at the ends of recordings, up to
    `SILENCE_NS` may pass. It is not at any of the `mixed` times, of which there are two accounts.
    A note says if `what` is not known at any time.
    """
    start, end = window.asked()
    first, last = recorded_reach(view.snapshot, window) or (0, 0)
    around = (max(start - SILENCE_NS, first), min(end + SILENCE_NS, last))
    gaps = united(recording_gaps(view))
    left = without([around], united([*known, *mixed, *gaps]))
    long = [(begin, stop) for begin, stop in left if stop - begin > SILENCE_NS]
    uncut = united([*long, *without(mixed, gaps)])
    cut = [(max(begin, start, first), min(stop, end, last)) for begin, stop in uncut]
    unknown = [(begin, stop) for begin, stop in cut if begin < stop]
    if unknown and not any(begin <= end and start <= stop for begin, stop in known):
        view.notes.add(f"{what} is not known at any time of the window")
    return unknown
