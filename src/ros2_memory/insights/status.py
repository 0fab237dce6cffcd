"""The memory's status: what records, how fresh and how complete the memory is."""

from __future__ import annotations

from contextlib import suppress
from itertools import takewhile
from typing import TYPE_CHECKING, Final, TypeAlias

from ros2_memory.analysis.silences import length_in
from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState
from ros2_memory.bag_dir.layout import is_thinned
from ros2_memory.bag_dir.state_files import describe_leaving, read_thinned
from ros2_memory.core.bag_summary import READ_WITHOUT_INDEXES
from ros2_memory.core.errors import BagError, NotInLakeError, RefusedError, UndecodableError
from ros2_memory.core.memo import Key
from ros2_memory.core.model import BagFile, BagState, SetAside, TimeWindow
from ros2_memory.core.spans import united
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import MIN_NS, NS_PER_MS, NS_PER_S, Ns, Span, unix_from_ns
from ros2_memory.history.clock_steps import clock_steps
from ros2_memory.history.coverage import (
    cut_spans,
    deleted_between,
    describe_cut,
    describe_excluded,
    describe_gaps,
    describe_lost,
    excluded_spans,
    unexcluded,
    unix_text,
)
from ros2_memory.history.no_data import are_unlisted, nothing_here
from ros2_memory.history.robots import describe_mixed
from ros2_memory.history.view import View
from ros2_memory.index.file_state import HELD_BACK
from ros2_memory.index.listed_splits import describe_absent
from ros2_memory.insights.saved_moments import newest_moments
from ros2_memory.insights.silences import silences_of
from ros2_memory.recorder.policies import OWN_TOPICS
from ros2_memory.results import ANOTHER, Budget, Gap, SilentTopic, Status, Undecodable
from ros2_memory.retention.inventory import state_bytes_in
from ros2_memory.things.unseen import describe_hung

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Sequence

    from ros2_memory.history.context import Call, Latching, Memory
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.storage.base import Channel

_ByTopicAndType: TypeAlias = "dict[tuple[str, str], list[Channel]]"
_CHANNELS: Final[Key[dict[tuple[str, bool], _ByTopicAndType]]] = Key()
"""Of a view: the channels of a bag, by its path and whether the store has them."""
SILENT_AFTER_NS: Final[Ns] = 10 * NS_PER_S
_UNHEARD_NS: Final[Ns] = 30 * NS_PER_S
"""The shortest time without messages that is a problem: as long as the shortest silence."""
DIED: Final = "died"
MAX_MOMENTS: Final = 5
"""Saved moments in a status; the resource has more."""
_SILENT_PERIODS: Final = 10
"""A topic falls silent after this many of its usual periods without a message."""
_MIN_MESSAGES: Final = 5
"""A topic with fewer messages has no usual period."""
_GROWTH_NS: Final[Ns] = 24 * 3600 * NS_PER_S
"""Growth is measured over the newest day."""
_SHORTEST_RATED_NS: Final[Ns] = 10 * NS_PER_MS
_RATE_WINDOW_NS: Final[Ns] = 3600 * NS_PER_S
_LEAST_GROWTH_NS: Final[Ns] = NS_PER_S
"""Of less data no growth is reported: some latched messages would make terabytes a day."""


def memory_status(memory: Memory, call: Call) -> Status:
    """Returns what the recorder does, how old the newest data is, and what is silent or faulty."""
    wall = memory.clock.now()
    view = View(memory, call, wall)
    view.bags.track_all_sources()
    snapshot, heartbeat = view.snapshot, memory.heartbeat()
    latest = snapshot.dating.latest
    now = memory.now(latest, call)
    live = heartbeat is not None and heartbeat.is_live(wall)
    heard = _last_heard(snapshot) if live else latest
    recorder = ANOTHER if any(bag.growing for bag in snapshot.active) else None
    if heartbeat is not None:
        recorder = state_of(heartbeat, live=live)
    mixed = describe_mixed(memory, call)
    gaps = [*unexcluded(view, view.gaps(TimeWindow.everything()))]
    stalls = {*gaps} & {pause.span for pause in snapshot.suspects}
    moments = None
    try:
        moments = newest_moments(memory, now, MAX_MOMENTS)
        for note in moments.notes:
            view.notes.add(note)
    except RefusedError as error:
        view.notes.add(str(error))
    return Status(
        now=now,
        earliest=snapshot.dating.earliest,
        latest=latest,
        heard=heard,
        recorder=recorder,
        live=live,
        restarts=0 if heartbeat is None else heartbeat.restarts,
        missing=() if heartbeat is None else heartbeat.missing,
        never_heard=() if heartbeat is None else _never_heard(snapshot, heartbeat),
        lost={} if heartbeat is None or not live else heartbeat.lost,
        fell_silent=tuple(_fallen_silent(memory, snapshot)),
        silences=tuple(
            silence
            for silence in silences_of(memory, snapshot)
            if not (silence.goes_on and are_unlisted(memory, [silence.topic]))
        ),
        clock_steps=clock_steps(view),
        gaps=gaps_with_deleted(view, gaps),
        stalled=(len(stalls), sum(end - start for start, end in stalls)),
        damaged=len(snapshot.damaged),
        incomplete=snapshot.timeline.disk_use[1] + len(read_thinned(view.bag_dir).left_open),
        unread=len(snapshot.unread),
        budget=budget_of(memory, snapshot, heartbeat, wall),
        moments=moments,
        problems=tuple(_status_problems(view, heartbeat, heard, mixed, wall)),
        notes=tuple(_status_notes(view, heartbeat, mixed, live=live)),
    )


def _status_problems(
    view: View, heartbeat: Heartbeat | None, heard: Ns | None, mixed: Sequence[str], wall: Ns
) -> Iterator[str]:
    """Yields what is wrong. `mixed` are the sentences on recordings of several robots."""
    latest, bag_dir = view.snapshot.dating.latest, view.bag_dir
    until_now = TimeWindow(MIN_NS, max(wall, latest or wall) + 1)
    yield from problems_of(view.snapshot, heartbeat, wall)
    if heard is not None and latest is not None and latest - heard > _UNHEARD_NS:
        yield (
            f"no message since {unix_text(heard)} but on topics that the recorder publishes "
            "itself, such as /rosout"
        )
    yield from missing_data(view)
    yield from describe_hung(view, until_now)
    yield from dict.fromkeys(f"{sentence.partition(':')[0]} (see notes)" for sentence in mixed)
    yield from describe_gaps(view, until_now, explained=True)
    yield from describe_lost(bag_dir, TimeWindow.everything())


def _status_notes(
    view: View, heartbeat: Heartbeat | None, mixed: Sequence[str], *, live: bool
) -> Iterator[str]:
    """Yields what explains a status, and is no problem."""
    bag_dir, everything = view.bag_dir, TimeWindow.everything()
    yield from view.notes.sentences()
    if heartbeat is not None and live:
        # What is kept too long while the clock may be wrong, and what no lake has.
        yield from filter(None, (heartbeat.age_held, heartbeat.unshipped))
    leaving = describe_leaving(bag_dir)
    if leaving:
        yield leaving
    yield from mixed
    yield from describe_excluded(bag_dir, everything)
    yield from describe_cut(bag_dir, everything)


def gaps_with_deleted(view: View, gaps: Iterable[Span]) -> tuple[Gap, ...]:
    """Returns gaps, each with how much of it (ns) retention deleted."""
    deleted = deleted_between(view, TimeWindow.everything())
    return tuple(Gap(start, end, length_in(deleted, start, end)) for start, end in gaps)


def state_of(heartbeat: Heartbeat, *, live: bool) -> str:
    """Returns the recorder's state; `died` if it ended without saying so."""
    if live or heartbeat.state is RecorderState.STOPPED:
        return str(heartbeat.state)
    return DIED


def _never_heard(snapshot: Snapshot, heartbeat: Heartbeat) -> tuple[str, ...]:
    """Returns the topics that a recorder hears nothing of, and that no bag has, either."""
    recorded = {*snapshot.timeline.topics()}
    return tuple(topic for topic in heartbeat.silent if topic not in recorded)


def _last_heard(snapshot: Snapshot) -> Ns | None:
    """Returns the newest time (ns) on the robot's own topics; on any topic without these.

    The recorder logs at each split, so its topics go on when the robot is dead.
    """
    times = [
        totals.last
        for topic in snapshot.timeline.topics()
        if topic not in OWN_TOPICS
        for totals in snapshot.totals(topic)
    ]
    latest = snapshot.dating.latest
    return latest if latest is None or not times else min(max(times), latest)


def problems_of(snapshot: Snapshot, heartbeat: Heartbeat | None, wall: Ns) -> Iterator[str]:
    """Yields why answers may be missing something.

    That a recorder was stopped is no problem. That it does not record otherwise is one.
    """
    if snapshot.problem:
        yield snapshot.problem
    if snapshot.damaged:
        damaged = counted(len(snapshot.damaged), "damaged bag file")
        yield f"{damaged}; data_time_range lists them"
    if snapshot.dating.note:
        yield snapshot.dating.note
    if heartbeat is None or heartbeat.state is RecorderState.STOPPED:
        return
    if not heartbeat.is_live(wall):
        yield "the recorder died"
        return
    reason = _why_not_recording(heartbeat)
    if reason is not None:
        yield reason
    if heartbeat.held_back is not None:
        yield heartbeat.held_back
    yield from required_missing(heartbeat)
    yield from unrecorded(heartbeat)


def _why_not_recording(heartbeat: Heartbeat) -> str | None:
    """Returns why a live recorder does not record; None if it does, or if it only just started."""
    error = heartbeat.last_error
    match heartbeat.state:
        case RecorderState.PAUSED:
            return f"the recorder is paused: {error or 'it gives no reason'}"
        case RecorderState.WAITING:
            return f"the recorder waits: {heartbeat.waiting_for or 'it gives no reason'}"
        case RecorderState.STARTING if error is not None and not heartbeat.recovered:
            return f"the recorder does not record yet: {error}"
        case _:
            return None


def required_missing(heartbeat: Heartbeat) -> Iterator[str]:
    """Yields that topics of `recording.required` are not recorded, if any."""
    if heartbeat.required_missing:
        yield f"required, and not recorded: {listed(heartbeat.required_missing)}"


def unrecorded(heartbeat: Heartbeat) -> Iterator[str]:
    """Yields a sentence for each reason why offered topics are not recorded."""
    if unknown := heartbeat.unknown_types:
        why = "ros2 bag record does not know the type, or knows several"
        yield f"not recorded, since {why}: {listed(unknown)}"
    if heartbeat.unheard:
        advice = f"; {heartbeat.advice}" if heartbeat.advice else ""
        yield f"offered for 30 s, and no message has come: {listed(heartbeat.unheard)}{advice}"
    if heartbeat.fell_silent:
        yield f"regular until now, and silent: {listed(heartbeat.fell_silent)}"


def missing_data(view: View) -> Iterator[str]:
    """Yields the kinds of data known to be missing from answers, each with its count.

    Damaged files and a directory that cannot be read are among `problems_of`.
    """
    snapshot = view.snapshot
    if snapshot.problem is None and not snapshot.bags:
        yield nothing_here(snapshot)
    undecided = [bag for bag in snapshot.active if not bag.growing and bag.reason != HELD_BACK]
    if undecided:
        files = counted(len(undecided), "file has", "files have")
        yield f"{files} no end yet: being written, or left by a crash"
    _, left_open_bags = snapshot.timeline.disk_use
    if left_open_bags:
        bags = counted(left_open_bags, "bag was", "bags were")
        yield f"{bags} left open by a crash: unwritten messages are lost"
    if snapshot.unread:
        files = counted(len(snapshot.unread), "file is", "files are")
        yield f"{files} not read; data_time_range says why"
    contradictory = bags_with_remarks(snapshot)
    if contradictory:
        bags = counted(len(contradictory), "bag is", "bags are")
        yield f"{bags} incomplete or contradictory; data_time_range has the details"
    broken = [
        bag
        for bag, reason in view.memory.scanner.damaged_parts(snapshot.bags)
        if not reason.endswith(READ_WITHOUT_INDEXES)
    ]
    if broken:
        bags = counted(len(broken), "bag", "bags")
        yield f"{bags} could not be read whole; data_time_range names what is damaged"
    if snapshot.dating.misdated:
        bags = counted(len(snapshot.dating.misdated), "bag is", "bags are")
        yield f"{bags} dated by a wrong clock; data_time_range has the details"
    yield from describe_absent(view.memory.absent_splits(snapshot))
    alone = [topic for topic in view.timeline.topics() if _has_times_alone(view, topic)]
    if alone:
        topics = counted(len(alone), "topic")
        yield f"of {topics} there are only the times here: {listed(alone)}"
    undecodable = {row.topic for row in undecodable_topics(view)}
    if undecodable:
        topics = counted(len(undecodable), "topic")
        yield f"{topics} cannot be decoded: {listed(sorted(undecodable))}"


def _has_times_alone(view: View, topic: str) -> bool:
    """Returns whether the first bag of a topic lacks its payloads: in a lake the oldest bags do."""
    first = (view.timeline.bag_with(topic, name) for name in view.timeline.types_of(topic))
    with suppress(BagError):  # it was deleted just now
        return any(topic in view.memory.reader.times_alone(bag.path) for bag in first)
    return False


def _fallen_silent(memory: Memory, snapshot: Snapshot) -> Iterator[SilentTopic]:
    """Yields topics that had messages often, and have none in the newest data.

    A topic from before a long gap does not count: it may be another robot's. Nor does a topic that
    was silent for as long before, such as those of a robot that is docked at times, nor one that
    the recorder no longer records.
    """
    latest, latching = snapshot.dating.latest, memory.limits.latching
    begin = snapshot.newest_stretch
    if latest is None or begin is None:
        return
    for topic in snapshot.timeline.topics():
        if snapshot.timeline.is_on_events(topic) or latching.is_latched(snapshot, topic):
            continue
        parts = snapshot.totals(topic)
        messages = sum(totals.messages for totals in parts)
        last = max((totals.last for totals in parts), default=begin - 1)
        if messages < _MIN_MESSAGES or last < begin:
            continue
        first = min(totals.first for totals in parts)
        recorded = last - first - length_in(snapshot.gaps, first, last)
        usual_period = recorded // (messages - 1)
        longest = max(_SILENT_PERIODS * usual_period, snapshot.longest_silence(topic))
        longest = max(SILENT_AFTER_NS, longest)
        if latest - last <= longest:
            continue  # as most topics: what was excluded or cut is not looked at
        since = TimeWindow(last + 1, latest + 1)
        unrecorded = united([*excluded_spans(memory.bag_dir, since), *snapshot.gaps])
        silent = latest - last - length_in(unrecorded, last, latest)
        is_cut = bool(cut_spans(memory.bag_dir, topic, since))
        if silent > longest and not is_cut and not are_unlisted(memory, [topic]):
            yield SilentTopic(topic, last)


def budget_of(memory: Memory, snapshot: Snapshot, heartbeat: Heartbeat | None, wall: Ns) -> Budget:
    """Returns what counts in the budget, how fast that grows, and how much may be kept.

    Growth is only predicted while a live recorder records. Without a configured recorder there is
    no budget.
    """
    kept = memory.limits.kept
    used, _ = snapshot.timeline.disk_use
    if kept is None:
        return Budget(used, None, None, None)
    foreign = memory.foreign(snapshot)
    state = state_bytes_in(memory.bag_dir)
    used += state - (0 if foreign is None else foreign.bag_bytes)
    per_day = None
    recording = heartbeat is not None and heartbeat.state is RecorderState.RECORDING
    if heartbeat is not None and recording and heartbeat.is_live(wall):
        if heartbeat.counted_bytes is not None:
            used, state = heartbeat.counted_bytes, heartbeat.state_bytes
        per_day = _growth_per_day(snapshot, frozenset() if foreign is None else foreign.files)
    foreign_bytes = None if foreign is None else foreign.total_bytes
    return Budget(used, kept.max_total_bytes, per_day, kept.max_age_ns, foreign_bytes, state)


def _growth_per_day(snapshot: Snapshot, foreign: Collection[str]) -> int | None:
    """Returns how many bytes the bags of the newest day grow per day; None if they span too little.

    `foreign` are the files that the recorder did not make.
    """
    latest = snapshot.dating.latest or 0
    recent = takewhile(lambda bag: bag.end >= latest - _GROWTH_NS, reversed(snapshot.bags))
    own = [
        bag
        for bag in recent
        if bag.start <= latest and not (bag.file in foreign or is_thinned(bag.file))
    ]
    span = latest - min((bag.start for bag in own), default=latest)
    if span < _LEAST_GROWTH_NS:
        return None
    return sum(bag.size for bag in own) * _GROWTH_NS // span


def left_open(snapshot: Snapshot) -> tuple[SetAside, ...]:
    """Returns the bags that a crash left open, with what is lost of each."""
    return tuple(
        SetAside(bag.path, "; ".join(bag.summary.remarks) or "left open by a crash")
        for bag in snapshot.timeline.faulty(TimeWindow.everything())
        if bag.state is BagState.INCOMPLETE
    )


def bags_with_remarks(snapshot: Snapshot) -> list[BagFile]:
    """Returns the bags with remarks on anything but a crash or a clock, in bag order."""
    bags = snapshot.timeline.faulty(TimeWindow.everything())
    return [bag for bag in bags if bag.state is not BagState.INCOMPLETE and bag.summary.notes]


def clock_faults(snapshot: Snapshot) -> tuple[SetAside, ...]:
    """Returns the bags that a wrong clock dated, with how that is known."""
    return tuple(SetAside(fault.bag.path, fault.reason) for fault in snapshot.dating.faults)


def undecodable_topics(view: View) -> tuple[Undecodable, ...]:
    """Returns the topics with messages that cannot be decoded, with type and reason."""
    return tuple(
        Undecodable(topic, type_name, reason)
        for topic in view.timeline.topics()
        for type_name, reason in sorted(undecodable_types(view, topic).items())
    )


def undecodable_types(view: View, topic: str) -> dict[str, str]:
    """Returns why messages of a topic cannot be decoded, by type."""
    reasons = {}
    for type_name in view.timeline.types_of(topic):
        reason = _why_undecodable(view, topic, type_name)
        if reason:
            reasons[type_name] = reason
    return reasons


def _why_undecodable(view: View, topic: str, type_name: str) -> str | None:
    """Returns why the first bag with a topic of a type cannot be decoded; None if it can."""
    bag = view.timeline.bag_with(topic, type_name)
    why = view.memory.reader.undecodable
    channels = _channels_of(view, bag, are_stored=True).get((topic, type_name), [])
    # Other bags are stored, too, also deleted ones: if they differ in this, the bag itself is read.
    if len({*map(why, channels)}) != 1:
        channels = _channels_of(view, bag, are_stored=False).get((topic, type_name), [])
    reason = next(filter(None, map(why, reversed(channels))), None)
    if reason is None and any(not channel.schema.text.strip() for channel in channels):
        return _why_first_undecodable(view, topic, type_name)
    return reason


def _why_first_undecodable(view: View, topic: str, type_name: str) -> str | None:
    """Returns why the first message of a topic cannot be decoded; None if it can.

    A type with an empty definition may have no fields, or was not found by the recorder: the
    message shows which.
    """
    failures: list[UndecodableError] = []
    with suppress(BagError, NotInLakeError):
        first = view.stream.first([topic], TimeWindow.everything())
        if first is not None and first.type == type_name:
            view.bags.decode(first, failures)
    return next((failure.reason for failure in failures), None)


def _channels_of(view: View, bag: BagFile, *, are_stored: bool) -> _ByTopicAndType:
    """Returns the channels of a bag by topic and type, from the store or from the bag itself."""
    known, key = view.memo.of(_CHANNELS, dict), (bag.file, are_stored)
    if key not in known:
        scanner = view.memory.scanner
        channels = scanner.channels(view.timeline, bag) if are_stored else view.bags.channels(bag)
        known[key] = {}
        for channel in channels:
            known[key].setdefault((channel.topic, channel.type), []).append(channel)
    return known[key]


def usual_rate(snapshot: Snapshot, topic: str, latching: Latching) -> float | None:
    """Returns the rate (Hz) of a topic in its newest hour, without the gaps between bags.

    None for latched topics, and for logs, whose lines come when something happens. None as well if
    no bag has two messages, or all came at once. Thinned days show no rate.
    """
    if latching.is_latched(snapshot, topic) or snapshot.timeline.is_log(topic):
        return None
    last = max((total.last for total in snapshot.timeline.totals(topic).values()), default=0)
    window = TimeWindow.before(last, _RATE_WINDOW_NS)
    intervals = duration = 0
    for segment in snapshot.timeline.segments_in(window):
        whole = segment.unthinned
        column = None if whole is None else whole.column(topic)
        if column is not None:
            rows = window.overlapping(column.firsts, column.lasts)
            intervals += int((column.messages[rows] - 1).sum())
            duration += int((column.lasts - column.firsts)[rows].sum())
    if not intervals or duration < _SHORTEST_RATED_NS:
        return None
    return round(intervals / unix_from_ns(duration), 2)
