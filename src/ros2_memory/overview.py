"""What the memory holds as a whole: topics, times, holes, and the files that do not answer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from ros2_memory import results
from ros2_memory.core.model import BagState, SetAside, TimeWindow
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import Ns, ns_from_unix
from ros2_memory.history.coverage import require_bags
from ros2_memory.history.unseen import amiss, by_remark, misdated
from ros2_memory.history.view import View
from ros2_memory.index.listed_splits import absence_told, absent_splits

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ros2_memory.core.model import BagFile
    from ros2_memory.history.context import Call, Memory
    from ros2_memory.index.snapshot import Snapshot

_ODD_BAGS: Final = 5


def list_recorded_topics(memory: Memory, call: Call) -> tuple[results.TopicRow, ...]:
    """Every topic that was heard, under each of its types; empty for an empty memory.

    A row has notes where its numbers are of bags that are not whole, or that a wrong clock dated.

    Raises:
        NoDataError: the bag directory is not there, or its disk: what was heard is not known.
    """
    view = View(memory, call, memory.clock.now())
    if view.snapshot.problem is not None:
        require_bags(view)
    notes = _notes_by_topic(view.snapshot)
    rows = []
    for topic in view.snapshot.topics():
        reasons = _undecodable_types(view, topic)
        for type_name, census in sorted(view.census(topic).items()):
            rows.append(
                results.TopicRow(
                    topic,
                    type_name,
                    census.first,
                    census.last,
                    census.count,
                    reasons.get(type_name),
                    notes.get(topic, ()),
                )
            )
    return tuple(rows)


def data_time_range(memory: Memory, call: Call) -> results.DataTimeRange:
    """What the memory spans, where it has holes, and which files do not answer.

    Bags that a wrong clock dated are listed, and neither begin nor end the span or a hole in it.
    """
    now = memory.clock.now()
    view = View(memory, call, now if memory.limits.now == "wall" else None)
    view.count_all()
    snapshot = view.snapshot
    if memory.limits.now == "latest" and snapshot.latest is not None:
        now = snapshot.latest
    if snapshot.problem:
        view.note(snapshot.problem)
    if snapshot.dating.note:
        view.note(snapshot.dating.note)
    _note_odd_bags(view)
    for sentence in absence_told(absent_splits(snapshot, memory.index.bag_dir)):
        view.note(sentence)
    undecodable = undecodable_topics(view)
    return results.DataTimeRange(
        earliest=snapshot.dating.earliest,
        latest=snapshot.dating.latest,
        now=now,
        bags=len(snapshot.bags),
        gaps=_gaps(view),
        incomplete=left_open(snapshot),
        active=snapshot.active,
        damaged=snapshot.damaged,
        unread=snapshot.unread,
        silent_topics=len(snapshot.silent_topics),
        notes=view.notes,
        undecodable=undecodable,
        clock_faults=clock_faults(snapshot),
    )


def left_open(snapshot: Snapshot) -> tuple[SetAside, ...]:
    """The bags that a crash left open, each with what is lost of it."""
    return tuple(
        SetAside(bag.path, "; ".join(bag.summary.remarks) or "left open by a crash")
        for bag in snapshot.odd(TimeWindow.everything())
        if bag.state is BagState.INCOMPLETE
    )


def odd_bags(snapshot: Snapshot) -> list[BagFile]:
    """The bags of which something is amiss, be it no crash and no clock, in bag order."""
    bags = snapshot.odd(TimeWindow.everything())
    return [bag for bag in bags if bag.state is not BagState.INCOMPLETE and bag.summary.notes]


def nothing_here(snapshot: Snapshot) -> str:
    """The sentence on a bag directory of which no bag answers."""
    if snapshot.active:
        return "no bag answers yet: the first one is still being written"
    if snapshot.empty:
        return (
            f"no message is recorded here: {counted(snapshot.empty, 'bag holds', 'bags hold')} none"
        )
    if snapshot.damaged or snapshot.unread:
        return "no bag answers"
    return "no bag is here: nothing is recorded yet, or it is recorded elsewhere"


def clock_faults(snapshot: Snapshot) -> tuple[SetAside, ...]:
    """The bags that a wrong clock dated, each with how that is known."""
    return tuple(SetAside(fault.bag.path, fault.reason) for fault in snapshot.dating.faults)


def undecodable_topics(view: View) -> tuple[results.Undecodable, ...]:
    """The topics of which messages are recorded that cannot be decoded, under which types."""
    return tuple(
        results.Undecodable(topic, type_name, reason)
        for topic in view.snapshot.topics()
        for type_name, reason in sorted(_undecodable_types(view, topic).items())
    )


def _notes_by_topic(snapshot: Snapshot) -> dict[str, tuple[str, ...]]:
    """What is amiss in the bags that hold a topic, for the topics of which something is."""
    odd: dict[str, list[BagFile]] = {}
    for bag in snapshot.odd(TimeWindow.everything()):
        for heading in bag.summary.shape.topics:
            odd.setdefault(heading.topic, []).append(bag)
    notes = {topic: list(amiss(bags)) for topic, bags in odd.items()}
    if snapshot.misdated:
        named = {fault.bag.file: fault for fault in snapshot.misdated}
        held: dict[str, list[str]] = {}
        for fault in snapshot.misdated:
            for heading in fault.bag.summary.shape.topics:
                held.setdefault(heading.topic, []).append(fault.bag.file)
        for topic, files in held.items():
            faults = [named[file] for file in dict.fromkeys(files)]
            notes.setdefault(topic, []).append(misdated(faults))
    return {topic: tuple(sentences) for topic, sentences in notes.items()}


def _undecodable_types(view: View, topic: str) -> dict[str, str]:
    """Why messages of the topic cannot be decoded, by type; from one bag for each type."""
    reasons: dict[str, str] = {}
    for type_name in view.snapshot.types_of(topic):
        reason = _why_undecodable(view, topic, type_name)
        if reason:
            reasons[type_name] = reason
    return reasons


def _why_undecodable(view: View, topic: str, type_name: str) -> str | None:
    bag = view.snapshot.first_with(topic, type_name)
    entry = view.entry(bag)
    known = None if entry is None else entry[0].undecodable(topic, entry[1])
    if known is not None:
        return known.get(type_name)
    reasons = [
        view.memory.reader.undecodable(channel)
        for channel in view.channels(bag)
        if channel.topic == topic and channel.type == type_name
    ]
    return next(filter(None, reversed(reasons)), None)


def _note_odd_bags(view: View) -> None:
    """Says of the newest bags that are odd, not left open, and no fault of a clock, in what way."""
    odd = [(bag, "; ".join(bag.summary.notes)) for bag in odd_bags(view.snapshot)]
    for sentence in by_remark(odd, _ODD_BAGS):
        view.note(sentence)


def _gaps(view: View) -> tuple[results.Gap, ...]:
    """Holes of more than two splits between one bag's end and the next one's start."""
    longest = 2 * ns_from_unix(view.memory.limits.split_duration_s)
    return tuple(_holes(view.snapshot, longest))


def _holes(snapshot: Snapshot, longest: Ns) -> Iterator[results.Gap]:
    reach: Ns | None = None
    left_out = snapshot.dating.misdated
    for bag in snapshot.bags:
        if bag.file in left_out:
            continue
        if reach is not None and bag.start - reach > longest:
            yield results.Gap(reach, bag.start)
        reach = bag.end if reach is None else max(reach, bag.end)
