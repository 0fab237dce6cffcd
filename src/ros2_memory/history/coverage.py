"""Coverage: notes in an answer on data of its window that could not be read.

The newest of a kind is named, or the first few are, and the others counted:

- files that were not read at all: damaged, or of a kind that is not read here. The times of such a
  file are estimated by its recording and its mtime (see `index.snapshot`), so that an old one is
  not noted in every answer for ever. If the answer is that there is nothing, it counts unless it
  certainly lies elsewhere;
- missing splits that a metadata.yaml lists, for searches and answers that there is nothing;
- the file that is being written, from its last readable message on, or from the end of the split
  before it;
- bags that a crash left open, from their last message up to their mtime;
- closed bags that may lack messages;
- gaps, and times before the memory begins, in which retention deleted what was recorded;
- messages that the recorder found to be missing (`bag_dir.state_files`);
- intervals that `recording.exclude_when` excluded;
- bags that a wrong clock dated, unless the answer is that there is nothing.
"""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from decimal import Decimal
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
    NONE_LOST,
    READ_WITHOUT_INDEXES,
)
from ros2_memory.core.model import BagFile, BagState, SetAside, TimeWindow
from ros2_memory.core.spans import Spans, enclosing, overlaps_any, united, without
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
from ros2_memory.index.split_order import split_of

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence
    from pathlib import Path

    from ros2_memory.history.view import View
    from ros2_memory.index.clock_faults import ClockFault
    from ros2_memory.index.snapshot import Snapshot

_RESTART_NS: Final = 10 * NS_PER_S
"""Messages may be lost this long before an interruption, and this long after it."""
_EDGE_NS: Final = 20 * NS_PER_S
"""A window may begin this long before the memory, or end this long after it, without a note."""


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

    Args:
        view: of the call.
        window: of log time.
        nothing: whether the answer is that there is nothing.
        search: whether the answer is the result of a search.
        of: names the window in sentences without a time.
        gaps: whether there are notes on gaps; if not, the answer itself shows them.
    """
    if window.empty:
        return
    must_be_complete = nothing or search
    notes, bag_dir, snapshot = view.notes, view.bag_dir, view.snapshot
    if gaps:
        notes.add(*describe_gaps(view, window, explained=window.start <= MIN_NS))
    if must_be_complete:
        notes.add(*describe_thinned(snapshot, window))
    if os.path.lexists(bag_dir / OWN_FOLDER):
        deleted = [span_text(*span) for span in deleted_between(view, window)]
        if deleted:
            named = listed(deleted[-MAX_NAMED:], len(deleted))
            notes.add(f"recorded, and deleted since: {named}")
        notes.add(
            *(f"{of}{sentence}" for sentence in describe_lost(bag_dir, window)),
            *(f"{of}{sentence}" for sentence in describe_cut(bag_dir, window)),
            *describe_excluded(bag_dir, window),
        )
    if must_be_complete and _are_losses_hidden(bag_dir):
        notes.add_lack(f"{OWN_FOLDER} cannot be read: what was lost or deleted is not known")
    absent = _absent_files(view) if must_be_complete else ()
    notes.add(*_describe_unread(snapshot, window, absent, nothing=nothing))
    notes.add(*_describe_undated(view, window))
    _note_odd(view, window)


def _note_odd(view: View, window: TimeWindow) -> None:
    """Notes the bags of a window that may lack messages, in place of notes on reading them."""
    odd = [bag for bag in view.timeline.faulty(window) if not is_whole(bag)]
    view.notes.add(*describe_odd(odd))
    view.notes.add_remarks(odd)


def _describe_unread(
    snapshot: Snapshot, window: TimeWindow, absent: Sequence[SetAside], *, nothing: bool
) -> Iterator[str]:
    """Yields sentences on the files of a window, and missing ones, that were not read as a whole.

    `nothing`: whether the answer is that there is nothing.
    """
    if lost := lost_in(snapshot, window, nothing=nothing, absent=absent):
        files = _newest([(aside.path, aside.reason) for aside in lost])
        yield f"could not be read, so messages may be missing: {files}"
    active = being_written(snapshot, window, nothing=nothing)
    # Splits are not served before they were searched.
    if held := [short_name(aside.path) for aside in active if aside.reason == HELD_BACK]:
        yield f"{HELD_BACK}: {listed(held)}"
    if any(aside.reason != HELD_BACK for aside in active):
        yield _describe_active(snapshot, active, window)
    faults = [fault for fault in snapshot.misdated if fault.reaches_into(window)]
    if faults and not nothing:
        yield describe_misdated(faults)


def _describe_undated(view: View, window: TimeWindow) -> Iterator[str]:
    """Yields a sentence if gaps of a window may be when bags that a wrong clock dated were made."""
    snapshot = view.snapshot
    faults = [fault for fault in snapshot.misdated if fault.may_be_of(window)]
    if faults and any(is_missed(snapshot, window, *gap) for gap in view.gaps(window)):
        yield describe_misdated(faults, ", and may be of this time")


def _are_losses_hidden(bag_dir: Path) -> bool:
    """Whether the folder that records losses exists and cannot be read."""
    own = bag_dir / OWN_FOLDER
    return os.path.lexists(own) and not os.access(own, os.X_OK)


def describe_thinned(snapshot: Snapshot, window: TimeWindow) -> Iterator[str]:
    """Yields a sentence if a window has days of which only some messages stayed."""
    days = [bag for bag in snapshot.timeline.thinned if bag.reaches_into(window)]
    if days and overlaps_any(snapshot.timeline.thinned_times, window.start, window.stop - 1):
        span = f"{unix_text(days[0].start)} to {unix_text(max(bag.end for bag in days))}"
        yield (
            f"of {counted(len(days), 'day')} in {span} only some messages stayed: all that a topic "
            "changed to, saw and had as extremes, and no texts but those that memory.texts names"
        )


_LOST: Final = (
    ("lost before {they} recorded", ("counter", "rosbag2")),
    # A publisher that skips a message looks the same as a loss.
    ("missing by the cadence of header stamps (never published, or lost)", ("stamps",)),
)
_CUT: Final = (
    ("deleted by request", ("forgotten",)),
    ("deleted by retention (retention.topics)", ("expired",)),
)


def describe_cut(bag_dir: Path, window: TimeWindow) -> Iterator[str]:
    """Yields a sentence for each reason why messages of a window were cut out of bags."""
    return _count_losses(read_losses(bag_dir, window.start, window.stop), _CUT, window)


def _count_losses(
    losses: Sequence[Loss], kinds: Iterable[tuple[str, Collection[str]]], window: TimeWindow
) -> Iterator[str]:
    """Yields a sentence for each kind of loss in a window: how many messages of which topics.

    It has the times of losses that reach beyond the window: all of their messages are counted.
    """
    for what, causes in kinds:
        topics, spans = Counter[str](), list[Span]()
        for loss in losses:
            if loss.by in causes:
                topics[loss.topic] += loss.lost
                spans.append((loss.start, loss.stop - 1))
        if topics:
            span = enclosing(spans)
            when = "" if window.covers(*span) else f" from {span_text(*span)}"
            most_first = sorted(topics.items(), key=lambda item: (-item[1], item[0]))
            named = listed([f"{topic} ({count})" for topic, count in most_first])
            lost = topics.total()
            they = "it was" if lost == 1 else "they were"
            yield f"{counted(lost, 'message')} {what.format(they=they)}{when}: {named}"


def describe_lost(bag_dir: Path, window: TimeWindow) -> Iterator[str]:
    """Yields a sentence for each way in which messages of a window were lost."""
    losses = read_losses(bag_dir, window.start, window.stop)
    yield from _count_losses(losses, _LOST, window)
    refused = defaultdict[str, Spans](list)
    for loss in losses:
        if loss.by == "refused":
            refused[loss.topic].append((loss.start, loss.stop))
    topics_of = defaultdict[str, list[str]](list)
    for topic, spans in sorted(refused.items()):
        first, *others = (span_text(start, stop - 1) for start, stop in united(spans))
        more = counted(len(others), "more time")
        topics_of[f"{first}, and {more}, at last from {others[-1]}" if others else first] += [topic]
    for when, topics in topics_of.items():
        yield (
            f"messages of {listed(topics)} are missing from {when}, as the QoS or type of a "
            "publisher did not fit the subscription: how many is not known"
        )


def describe_gaps(view: View, window: TimeWindow, *, explained: bool) -> Iterator[str]:
    """Yields a sentence for each cause of gaps in a window, and one on gaps without a known cause.

    The latter is left out if only `explained` gaps are wanted. Times that were deleted or excluded
    are no gaps: they were recorded. An interruption after the newest data has a sentence, too.
    """
    bag_dir, snapshot = view.bag_dir, view.snapshot
    gaps = [gap for gap in view.gaps(window) if is_missed(snapshot, window, *gap)]
    interruptions = [
        loss for loss in read_losses(bag_dir, MIN_NS, MAX_NS) if loss.by in INTERRUPTIONS
    ]
    yield from _describe_open_end(view, window, interruptions)
    if not gaps or (explained and not interruptions):
        return
    gone = united([*deleted_spans(bag_dir), *excluded_spans(bag_dir)])
    absent = _absent_files(view)
    found = defaultdict[tuple[str, str], Spans](list)
    for part in chain.from_iterable(_unrecorded_parts(snapshot, gap, gone) for gap in gaps):
        first, last = part
        inside = TimeWindow(first + 1, last)
        is_unread = bool(lost_in(snapshot, inside, nothing=True, absent=absent))
        is_unexplained_noted = not explained and not being_written(snapshot, inside)
        margin = 0 if is_unread else _RESTART_NS
        for cause, start, end in _split_by_cause(part, interruptions, margin):
            is_remainder = not cause and (start, end) != part
            if is_remainder and end - start <= snapshot.shortest_gap:
                continue
            if window.overlaps(start, end) and (cause or is_unexplained_noted):
                what = "could be read" if is_unread and not cause else "was recorded"
                found[cause, what].append((start, end))
    for (cause, what), spans in found.items():
        longest = max(spans, key=lambda span: span[1] - span[0])
        times = f"from {span_text(*longest)}"
        if len(spans) > 1:
            times = f"{len(spans)} times, the longest {times}"
        because = f", because {INTERRUPTIONS[cause]}" if cause else ""
        yield f"nothing {what} {times}{because}"


def _split_by_cause(
    gap: Span, interruptions: Sequence[Loss], margin: Ns
) -> Iterator[tuple[str, Ns, Ns]]:
    """Yields the parts of a gap: cause, start and end. The cause is "" if it is not known.

    An interruption explains `margin` more on both sides: messages that had not reached the disk
    were lost as well, and a restart takes time. It begins or ends in the gap, or nearly: within a
    longer one bags were recorded, so the clock was set in it.
    """
    first, last = gap
    explained = defaultdict[str, Spans](list)
    for loss in interruptions:
        has_an_end = first - _RESTART_NS <= loss.start or loss.stop <= last + _RESTART_NS
        if loss.start < last and first < loss.stop and has_an_end:
            explained[loss.by].append((loss.start - margin, loss.stop + margin))
    unexplained = [gap]
    for cause, spans in explained.items():
        rest = without(unexplained, united(spans))
        for start, end in without(unexplained, rest):
            yield cause, start, end
        unexplained = rest
    for start, end in unexplained:
        yield "", start, end


def _describe_open_end(
    view: View, window: TimeWindow, interruptions: Sequence[Loss]
) -> Iterator[str]:
    """Yields a sentence if interruptions explain why messages are missing after the newest data.

    Not with `data.now=latest`: another clock dates the data of a simulation.
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


def span_text(start: Ns, end: Ns, length: Ns | None = None) -> str:
    """Returns a span of log time, and how long it or what is in it lasts, for a sentence."""
    lasting = seconds(end - start if length is None else length)
    return f"{unix_text(start)} to {unix_text(end)} ({lasting})"


def _unrecorded_parts(snapshot: Snapshot, gap: Span, gone: Sequence[Span]) -> Sequence[Span]:
    """Returns a gap without the times `gone`, in which messages were recorded and removed."""
    parts = without([gap], gone)
    if parts == [gap]:
        return parts
    # Up to the first deleted message, and from the last on, a short pause is as usual as elsewhere.
    return [(start, end) for start, end in parts if end - start > snapshot.shortest_gap]


def deleted_between(view: View, window: TimeWindow) -> Spans:
    """Returns the spans that overlap a window and were deleted as a whole; see `deleted_by_gap`."""
    first, last = window.asked()
    return [
        (start, stop)
        for _, deleted in deleted_by_gap(view, window)
        for start, stop in deleted
        if start < last and first < stop
    ]


def deleted_by_gap(view: View, window: TimeWindow) -> Iterator[tuple[Ns, Spans]]:
    """Yields for each gap in a window its end, and the spans in it that were recorded and deleted.

    The time before the memory comes first, as a gap, unless the window is open there (`MIN_NS`).
    """
    snapshot, gone = view.snapshot, deleted_spans(view.bag_dir)
    if not gone:
        return
    gaps: list[tuple[Ns, Spans]] = []
    if window.start > MIN_NS and (earliest := snapshot.earliest) is not None:
        gaps.append((earliest, [(start, min(stop, earliest)) for start, stop in gone]))
    for gap in snapshot.gaps:
        first, last = gap
        if window.overlaps(first, last):
            gaps.append((last, without([gap], _unrecorded_parts(snapshot, gap, gone))))
    for end, parts in gaps:
        deleted = [(start, stop) for start, stop in parts if stop - start > snapshot.shortest_gap]
        if deleted:
            yield end, deleted


def cut_spans(bag_dir: Path, topic: str, window: TimeWindow) -> Sequence[Span]:
    """Returns the spans of a window in which messages of a topic were cut out of their bags.

    They are half-open (log time) and united. Messages are cut by request, or by `retention.topics`.
    """
    losses = read_losses(bag_dir, window.start, window.stop)
    gone = (loss for loss in losses if loss.topic == topic and loss.by in {"forgotten", "expired"})
    return united((loss.start, loss.stop) for loss in gone)


def excluded_spans(bag_dir: Path, window: TimeWindow | None = None) -> Spans:
    """Returns the intervals (log time, half-open) that were excluded and overlap a window."""
    start, stop = (MIN_NS, MAX_NS) if window is None else (window.start, window.stop)
    return united(excluded_between(bag_dir, start, stop))


def unexcluded(view: View, gaps: Iterable[Span]) -> Iterator[Span]:
    """Yields the parts of gaps that were not excluded."""
    excluded = excluded_spans(view.bag_dir)
    for gap in gaps:
        yield from _unrecorded_parts(view.snapshot, gap, excluded)


def was_removed(view: View, window: TimeWindow) -> bool:
    """Whether some of a window was deleted by retention, or excluded."""
    excluded = excluded_between(view.bag_dir, window.start, window.stop)
    return bool(excluded or deleted_between(view, window))


def describe_excluded(bag_dir: Path, window: TimeWindow) -> Iterator[str]:
    """Yields a sentence if intervals of a window were excluded."""
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
        if not any(fault.reaches_into(before) for fault in snapshot.misdated):
            view.notes.add(f"the memory begins at {unix_text(earliest)}")
    if snapshot.latest is None or not _ends_after(window, snapshot.latest):
        return
    if snapshot.active:
        view.notes.add(_nothing_after(snapshot.active, snapshot.latest))
    else:
        view.notes.add(f"the memory ends at {unix_text(snapshot.latest)}")


def _ends_after(window: TimeWindow, latest: Ns) -> bool:
    """Whether a window ends after the newest data. Replies round times up to a microsecond."""
    return window.asked()[1] >= latest + NS_PER_US


def seconds(duration: Ns) -> str:
    """Returns a duration for a sentence: with three digits, or in days if longer than a week."""
    length = unix_from_ns(duration)
    if duration > LONGEST_OFF_NS:
        return f"{length / 86_400:.0f} days"
    if length >= 100:
        return f"{length:.0f} s"
    # Without an exponent, which .3g has below 0.1 ms.
    return f"{Decimal(f'{length:.3g}'):f} s"


def unix_text(at: Ns) -> str:
    """Returns a log time as Unix seconds, rounded up so that a query at that time finds it."""
    return f"{unix_rounded_up(at):.6f}"


def not_covered(view: View, topics: Collection[str], window: TimeWindow) -> tuple[str, ...]:
    """Returns why a search of topics in a window was not complete; empty if it was.

    It was complete if all closed files could be read, and nothing in the window was deleted,
    excluded or cut out. A file that is being written does not count: else no search of a robot that
    records would be complete.
    """
    is_incomplete = (
        not view.notes.complete
        or not all(map(is_whole, view.timeline.faulty(window)))
        or _are_losses_hidden(view.bag_dir)
        or lost_in(view.snapshot, window, nothing=True, absent=_absent_files(view))
        or was_removed(view, window)
        or any(cut_spans(view.bag_dir, topic, window) for topic in topics)
        or any(describe_thinned(view.snapshot, window))
    )
    if not is_incomplete:
        return ()
    note_unread(view, window, nothing=True)
    return view.notes.sentences()


def _absent_files(view: View) -> Sequence[SetAside]:
    return absent_files(view.memory.absent_splits(view.snapshot))


def is_whole(bag: BagFile) -> bool:
    """Whether all messages of a bag with notes could be read."""
    notes = bag.summary.notes
    if bag.state is BagState.INCOMPLETE and not notes:
        return False
    for note in notes:
        if note.startswith(DOUBTS):
            is_harmless = not note.endswith(MESSAGES_MISSING)
        else:
            is_harmless = note.endswith((READ_WITHOUT_INDEXES, NONE_LOST)) or note == LOG_CLOCK_NOTE
        if not is_harmless:
            return False
    return True


def lost_in(
    snapshot: Snapshot,
    window: TimeWindow,
    *,
    nothing: bool = False,
    absent: Sequence[SetAside] = (),
) -> list[SetAside]:
    """Returns the unread files, and `absent` ones, that probably have messages in a window.

    With `nothing`, files that possibly have some. The newest is the last.
    """
    spans = snapshot.unread_bounds if nothing else snapshot.unread_spans
    if absent:
        spans = {**snapshot.bounds_of(absent), **spans}
    lost = (
        aside
        for aside in (*absent, *snapshot.damaged, *snapshot.unread)
        if _touches(spans[aside], window, unknown=nothing)
    )

    def order(aside: SetAside) -> tuple[Ns, int]:
        span, (_, number) = spans[aside], split_of(str(aside.path)) or ("", 0)
        return MIN_NS if span is None else span.start, number

    return sorted(lost, key=order)


def being_written(
    snapshot: Snapshot, window: TimeWindow, *, nothing: bool = False
) -> list[SetAside]:
    """Returns the files still being written that probably have messages in a window.

    With `nothing`, files that possibly have some.
    """
    spans = snapshot.unread_bounds if nothing else snapshot.unread_spans
    return [aside for aside in snapshot.active if _touches(spans[aside], window, unknown=True)]


def _touches(span: TimeWindow | None, window: TimeWindow, *, unknown: bool) -> bool:
    """Whether a span overlaps a window; `unknown` if the span is not known."""
    if span is None:
        return unknown
    # Without the slack of the window: a window up to a split's end does not touch the next split.
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
    """Yields a sentence for each remark on bags in order of time, with the bags that share it.

    At most `most` remarks are shown, those of the newest bags.
    """
    names: dict[str, list[str]] = {}
    for bag, remark in reversed(bags):
        names.setdefault(shortened(remark), []).append(short_name(bag.path))
    shown = [*names.items()][:most]
    for remark, files in reversed(shown):
        yield f"{listed(files)}: {remark}"
    more = len(bags) - sum(len(files) for _, files in shown)
    if more:
        yield f"{counted(more, 'older bag is', 'older bags are')} odd too"


def describe_odd(bags: Sequence[BagFile]) -> Iterator[str]:
    """Yields sentences on bags that a crash left open, and on what else is wrong with bags."""
    left_open = [bag for bag in bags if bag.state is BagState.INCOMPLETE]
    if left_open:
        after, files = unix_text(left_open[-1].end), counted(len(left_open), "bag")
        yield f"messages after {after} may be missing, as a crash left {files} open"
    damaged = [bag for bag in bags if bag.summary.schema.faults]
    if damaged:
        files = _newest([(bag.path, "; ".join(bag.summary.schema.faults)) for bag in damaged])
        yield f"messages may be missing: {files}"


def describe_misdated(faults: Sequence[ClockFault], what: str = "") -> str:
    """Returns the sentence on bags that a wrong clock dated."""
    files = [(fault.bag.path, fault.description) for fault in faults]
    return f"dated by a wrong clock{what}: {_newest(files)}"


def _newest(files: Sequence[tuple[Path, str]]) -> str:
    """Returns the last of some files, with what is wrong with it, and the number of the others.

    `data_time_range` lists them all.
    """
    path, reason = files[-1]
    more = f" and {len(files) - 1} more" if len(files) > 1 else ""
    return f"{short_name(path)} ({shortened(reason)}){more}"


def gap_around(view: View, asked: TimeWindow) -> tuple[Ns | None, Ns | None] | None:
    """Returns the gap that a window lies in: when recording ended, and when it went on.

    The former is None before the memory, the latter after it. Without a gap, which is if something
    of the window was recorded, even by a misdated bag, returns None. An open end of the window is
    `MIN_NS` or `MAX_NS`.
    """
    snapshot = view.snapshot
    earliest, latest = snapshot.earliest, snapshot.latest
    if earliest is None or latest is None:
        return None
    misdated = (fault for fault in snapshot.dating.faults if fault.misleads)
    is_misdated = any(fault.reaches_into(asked) for fault in misdated)
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
    """Adds a note on how much of a window was recorded, if there are gaps in it.

    So there is one if the window reaches more than `_EDGE_NS` beyond the memory. Time after now
    does not count, unless the whole window is later. With an open end (`MAX_NS`), nor does time
    after the memory.
    """
    snapshot = view.snapshot
    first, last = recorded_reach(snapshot, asked)
    start, end = asked.asked()
    start = max(start, min(0, first))
    until = last if asked.stop >= MAX_NS else view.memory.now(snapshot.latest)
    if start < until:
        end = min(end, until)
    counted_window = TimeWindow(start, end)
    before, after = max(min(end, first) - start, 0), max(end - max(start, last), 0)
    gaps = sum(stop - begin for begin, stop in recording_gaps(view, counted_window))
    when = f"between {unix_text(start)} and {unix_text(end)}"
    deleted = was_removed(view, counted_window)
    if gap_around(view, asked) is not None:
        view.notes.add(why_nothing(when, deleted=deleted))
    elif gaps or max(before, after) > _EDGE_NS:
        length = end - start
        if view.skipped_in(counted_window):
            length = view.elapsed_in(counted_window).between(start, end)
        recorded = max(length - before - after - gaps, 0)
        digits = 0 if length >= 100 * NS_PER_S else 1
        recorded_s = f"{unix_from_ns(recorded):.{digits}f}"
        of_s = f"{unix_from_ns(length):.{digits}f}"
        what = "here are only" if deleted else "recorded only"
        if recorded_s != of_s:
            view.notes.add(f"{what} {recorded_s} of {of_s} s")


def why_nothing(when: str, *, deleted: bool) -> str:
    """Returns a sentence on a time without messages: not recorded, or deleted since."""
    return f"what was recorded {when} was deleted" if deleted else f"nothing was recorded {when}"


def recorded_reach(snapshot: Snapshot, window: TimeWindow) -> Span:
    """Returns the first and the last log time of the memory; without bags, those of the window.

    Misdated bags count only if the window has no other: then their recordings alone do.
    """
    if snapshot.earliest is None or snapshot.latest is None:
        return window.asked()
    reach = snapshot.earliest, snapshot.latest
    if window.overlaps(*reach):
        return reach
    misdated = snapshot.misdated
    recordings = {fault.bag.recording for fault in misdated if fault.reaches_into(window)}
    if not recordings:
        return reach
    # The reach is that of whole recordings: it must not depend on where splits end.
    return enclosing(fault.span for fault in misdated if fault.bag.recording in recordings)


def shown_span(snapshot: Snapshot, window: TimeWindow) -> Span:
    """Returns the first and last moment of a window that the memory can show; see `recorded_reach`.

    The last is before the first if the memory can show nothing of the window.
    """
    start, end = window.asked()
    first, last = recorded_reach(snapshot, window)
    return max(start, first), min(end, last)


def shown_window(snapshot: Snapshot, window: TimeWindow) -> TimeWindow:
    """Returns the part of a window that the memory can show; see `recorded_reach`."""
    first, last = recorded_reach(snapshot, window)
    return window.intersect(TimeWindow(first, last + 1))


def is_missed(snapshot: Snapshot, window: TimeWindow, start: Ns, end: Ns) -> bool:
    """Returns whether a gap takes more of a window than an ordinary pause, or than a tenth of it.

    A window of an hour has no note on the gap that begins with its last message.
    """
    first, last = window.asked()
    begin, stop = max(start, first), min(end, last)
    least = min(snapshot.shortest_gap, (last - first) // 10)
    return stop - begin > least or (begin, stop) == (first, last)


def recording_gaps(view: View, window: TimeWindow | None = None) -> Iterator[Span]:
    """Yields the gaps (in a window, cut at its bounds); see `View.gaps`."""
    asked = window or TimeWindow.everything()
    for start, end in view.gaps(asked):
        yield max(start, asked.start), min(end, asked.stop)


def unknown_times(
    view: View, window: TimeWindow, known: Spans, what: str, *, mixed: Spans
) -> Spans:
    """Returns the recorded times of a window at which something is not known, in order.

    Args:
        view: of the call.
        window: of log time.
        known: when it is known. It stays known for up to `SILENCE_NS` between these times, and at
            the ends of recordings.
        what: names it, in a note if it is not known at any time of the window.
        mixed: when two robots say different things: then it is not known.
    """
    start, end = window.asked()
    first, last = recorded_reach(view.snapshot, window)
    around = (max(start - SILENCE_NS, first), min(end + SILENCE_NS, last))
    gaps = united([*recording_gaps(view), *view.skipped_in(window)])
    between = without([around], united([*known, *mixed, *gaps]))
    long = [(begin, stop) for begin, stop in between if stop - begin > SILENCE_NS]
    unknown: Spans = []
    shown = TimeWindow(max(start, first), min(end, last))
    for begin, stop in united([*long, *without(mixed, gaps)]):
        inside = TimeWindow(begin, stop).intersect(shown)
        if not inside.empty:
            unknown.append((inside.start, inside.stop))
    if unknown and not any(begin <= end and start <= stop for begin, stop in known):
        view.notes.add(f"{what} is not known at any time of the window")
    return unknown
