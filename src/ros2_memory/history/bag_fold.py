"""Joins what bags hold of a topic: whole bags by their digests, the others by their messages.

What is joined from consecutive bags of one segment serves every later question, so that a week need
not be joined again.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from itertools import count, groupby
from typing import TYPE_CHECKING, Final, Generic, TypeAlias, TypeVar
from weakref import WeakKeyDictionary, ref

from ros2_memory.core.model import TimeWindow
from ros2_memory.core.spans import COPY_HORIZON_NS
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.history.bag_groups import DigestKind, Group, Span, StoredDigests, groups_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from ros2_memory.catalogue.lookup import SegmentDigests
    from ros2_memory.core.errors import UndecodableError
    from ros2_memory.history.duplicates import BagSpan, StoredMessage
    from ros2_memory.history.view import View
    from ros2_memory.index.segment import Segment
    from ros2_memory.index.timeline import Timeline

T = TypeVar("T")
R = TypeVar("R")

_Crossings: TypeAlias = "dict[tuple[str, Segment], tuple[BagSpan, ...]]"
_CROSSINGS: Final[WeakKeyDictionary[Timeline, _Crossings]] = WeakKeyDictionary()
_NUMBERS: Final[WeakKeyDictionary[Timeline, int]] = WeakKeyDictionary()
_COUNTER: Final = count()
JOINED_VERSION: Final = 1
"""Version of how digests are joined and encoded; when it changes, they are joined again."""


@dataclass(frozen=True, slots=True)
class Share:
    """The groups of bags whose first bag is of one segment.

    Attributes:
        segment: the segment.
        first: log time of the first message of its bags.
        last: of the last one of all groups.
        begins_in: its bags that belong to a group of the segment before.
        ends_in: bags of the next segment that belong to its last group.
        timeline: names the timeline where bags of other segments decide what is in these.
    """

    segment: Segment
    first: Ns
    last: Ns
    begins_in: tuple[BagSpan, ...] = ()
    ends_in: tuple[BagSpan, ...] = ()
    timeline: str = ""

    @property
    def key(self) -> str:
        """All that what is in the groups depends on besides the bags of the segment."""
        crossing = [
            [f"{each.bag.file} {each.bag.size}" for each in bags]
            for bags in (self.begins_in, self.ends_in)
        ]
        return f"{crossing} {self.timeline}"

    def is_covered_by(self, window: TimeWindow) -> bool:
        """Returns whether all groups lie in a window."""
        return window.covers(self.first, self.last)

    def inside(self, window: TimeWindow) -> TimeWindow:
        """Returns the part of a window that holds the groups.

        Wide enough to see the bags before that a group may have begun with.
        """
        begin = max(self.first - COPY_HORIZON_NS, MIN_NS)
        return window.intersect(TimeWindow(begin, self.last + 1))

    def groups(self, view: View, topic: str, window: TimeWindow) -> list[Group]:
        """Returns the groups with messages in a window, in order."""
        segment_of = view.snapshot.timeline.segment_of
        return [
            group
            for group in groups_of(view.stream, topic, self.inside(window))
            if segment_of(group.bags[0].bag) is self.segment
        ]


def shares_of(view: View, topic: str, window: TimeWindow) -> list[Share]:
    """Returns the shares of all segments with a topic in a window, in order."""
    timeline = view.snapshot.timeline
    number = _NUMBERS.setdefault(timeline, next(_COUNTER))
    shares: list[Share] = []
    for segment in timeline.segments:
        span = segment.spans.get(topic)
        if span is None or not window.overlaps(*span):
            continue
        crossing = _crossing(view, topic, segment) if shares else ()
        if crossing:
            before = shares[-1]
            last = max(before.last, *(each.last for each in crossing))
            shares[-1] = replace(before, last=last, ends_in=crossing)
            shares.append(Share(segment, *span, begins_in=crossing))
        else:
            shares.append(Share(segment, *span))
        if _may_hold_relatched(view, topic, segment):
            # Any bag may hold the original of a duplicate in these, and in the group before.
            which = f"timeline {number}"
            shares[-1] = replace(shares[-1], timeline=which)
            if crossing:
                shares[-2] = replace(shares[-2], timeline=which)
    return shares


def _may_hold_relatched(view: View, topic: str, segment: Segment) -> bool:
    if not view.stream.may_be_relatched([topic]):
        return False
    digests = view.bags.digests_of(segment)
    known = {} if digests is None else digests.relatched(topic)
    return len(known) < len(segment.bags_with(topic)) or any(known.values())


def _entries_of(
    view: View, digests: SegmentDigests, share: Share
) -> tuple[Sequence[int], ...] | None:
    """Returns the numbers of the entries that decide what is in a share.

    Those of its segment, then of the bags at either end that belong to two segments. None where one
    of these has none, where more decides, and where the segment is still to change.
    """
    is_settled = digests.whole and view.snapshot.timeline.is_settled(share.segment)
    if share.timeline or not is_settled:
        return None
    before = view.bags.entry_numbers(share.begins_in)
    after = view.bags.entry_numbers(share.ends_in)
    if before is None or after is None:
        return None
    return [*digests.numbers.values()], before, after


@dataclass(frozen=True, slots=True)
class _Count:
    """How many messages of a topic a share holds, each counted once.

    Attributes:
        messages: the number.
        since: from this log time on, bags decide which of them count.
    """

    messages: int
    since: Ns


_Searched: TypeAlias = "tuple[ref[Segment], ...]"
_Counts: TypeAlias = "dict[tuple[str, str], tuple[_Count, _Searched]]"
_COUNTS: Final[WeakKeyDictionary[Segment, _Counts]] = WeakKeyDictionary()
"""By segment, topic and key of a share: its count, and the segments that decided it."""


def counted_once(view: View, topic: str) -> int:
    """Returns how many messages of a topic there are; one that was received again counts once.

    For this, messages are read. So what each segment holds stays in memory and in the catalogue for
    as long as the bags stay in which the originals were searched for: a robot that records adds a
    bag every few seconds.
    """
    everything = TimeWindow.everything()
    total = 0
    for each in shares_of(view, topic, everything):
        share = replace(each, timeline="")
        segment, key = share.segment, (topic, share.key)
        known = _COUNTS.get(segment, {}).get(key)
        is_known = known is not None and _searched(view, share, known[0]) == known[1]
        if known is not None and is_known and not view.call.stores_joined:
            total += known[0].messages
            continue
        view.bags.check_deadline()
        is_sure, count = _stored_count(view, topic, share) or _read_count(view, topic, share)
        if is_sure:
            _COUNTS.setdefault(segment, {})[key] = count, _searched(view, share, count)
        total += count.messages
    return total


def _searched(view: View, share: Share, count: _Count) -> _Searched:
    """Returns the segments with bags that decide what of a share counts."""
    window = TimeWindow(min(count.since, share.first), share.last + 1)
    return tuple(map(ref, view.snapshot.timeline.segments_in(window)))


def _read_count(view: View, topic: str, share: Share) -> tuple[bool, _Count]:
    """Counts the messages of a share; returns also whether all of it could be read."""
    before = view.notes.added
    view.stream.originals_since = MAX_NS
    with view.notes.isolated():
        groups = share.groups(view, topic, TimeWindow.everything())
        messages = sum(group.count() for group in groups)
        is_whole = view.notes.complete and view.notes.added == before
    count = _Count(messages, view.stream.originals_since)
    is_sure = is_whole and not view.call.used_active
    asked = _count_asked(view, topic, share)
    if is_sure and asked is not None and view.call.stores_joined:
        name, digests, entries = asked
        deciding = _entries_hash(view, share, count)
        if deciding:
            stored = json.dumps([count.messages, count.since, deciding]).encode()
            digests.catalogue.store_joined(name, entries, stored)
    return is_sure, count


def _stored_count(view: View, topic: str, share: Share) -> tuple[bool, _Count] | None:
    """Returns the count of a share that the catalogue has, where the same bags decide it still."""
    asked = _count_asked(view, topic, share)
    if asked is None:
        return None
    name, digests, entries = asked
    stored = digests.catalogue.joined(name, entries)
    try:
        messages, since, deciding = json.loads(stored or b"")
        count = _Count(int(messages), int(since))
    # A damaged file can hold anything.
    except (ValueError, TypeError):
        return None
    return (True, count) if deciding == _entries_hash(view, share, count) else None


def _count_asked(
    view: View, topic: str, share: Share
) -> tuple[str, SegmentDigests, Sequence[Sequence[int]]] | None:
    """Returns under which name and entries the catalogue stores a share's count, if it does."""
    digests = view.bags.digests_of(share.segment)
    entries = None if digests is None else _entries_of(view, digests, share)
    if digests is None or entries is None:
        return None
    return f"counted {JOINED_VERSION} {topic}", digests, entries


def _entries_hash(view: View, share: Share, count: _Count) -> str:
    """Returns a hash of the entries that decide what of a share counts; empty without them all."""
    numbers: list[list[int]] = []
    for each in _searched(view, share, count):
        segment = each()
        digests = None if segment is None else view.bags.digests_of(segment)
        if digests is None or not digests.whole:
            return ""
        numbers.append([*digests.catalogue.row_ids([*digests.numbers.values()])])
    return sha256(json.dumps(numbers).encode()).hexdigest()


def _crossing(view: View, topic: str, segment: Segment) -> tuple[BagSpan, ...]:
    """Returns the bags from a segment on that belong to a group which begins before it."""
    known = _CROSSINGS.setdefault(view.snapshot.timeline, {})
    key = (topic, segment)
    if key not in known:
        known[key] = _found_crossing(view, topic, segment)
    return known[key]


def _found_crossing(view: View, topic: str, segment: Segment) -> tuple[BagSpan, ...]:
    timeline = view.snapshot.timeline
    begin = segment.spans[topic][0]
    end = begin

    def crosses(group: Group) -> bool:
        inside = [timeline.segment_of(each.bag) is segment for each in group.bags]
        return any(inside) and not all(inside)

    while True:
        near = TimeWindow(
            max(begin - COPY_HORIZON_NS, MIN_NS), min(end + COPY_HORIZON_NS + 1, MAX_NS)
        )
        group = next(filter(crosses, groups_of(view.stream, topic, near)), None)
        if group is None:
            return ()
        last = group.last
        if last <= end:
            return tuple(each for each in group.bags if each.first >= begin)
        end = last


@dataclass(frozen=True, slots=True)
class Fold(Generic[T, R]):
    """How the messages of a topic and the digests of whole bags are joined into one result.

    Attributes:
        kind: the digests.
        add: adds messages; returns the times of the first and the last of them, if any.
        collect: makes a digest of messages, if they amount to one; their times as for `add`.
        join: adds a digest, or what `reduce` returned.
        reduce: joins consecutive digests, at least one, as far as that can be done for whatever
            comes before and after them. It stays in memory, so later questions need not.
        encode: what `reduce` returned as bytes.
        decode: reads the value from bytes; ValueError if they are invalid.
        failures: where `add` and `collect` put messages that cannot be decoded; a digest without
            these is not stored.
        name: of what `reduce` depends on besides the kind.
    """

    kind: DigestKind[T]
    add: Callable[[Iterable[StoredMessage]], Span | None]
    collect: Callable[[Iterable[StoredMessage]], tuple[T | None, Span | None]]
    join: Callable[[T | R, Span], None]
    reduce: Callable[[Sequence[tuple[T, Span]]], Sequence[tuple[T | R, Span]]]
    encode: Callable[[T | R], bytes]
    decode: Callable[[bytes], T | R]
    failures: Sequence[UndecodableError] = ()
    name: str = ""

    def over(self, view: View, topic: str, window: TimeWindow) -> Span | None:
        """Folds a window: groups that lie in it by their digests, the others by their messages.

        Returns the times of the first and the last message; None if there is none.
        """
        spans: list[Span] = []
        for share in shares_of(view, topic, window):
            view.bags.check_deadline()
            digests = view.bags.digests_of(share.segment)
            stored = StoredDigests(view, topic, self.kind, share.inside(window))
            known = None
            if digests is not None and share.segment.is_closed and share.is_covered_by(window):
                groups = partial(share.groups, view, topic, window)
                known = self._of_share(view, digests, share, stored, groups)
            if known is not None:
                spans += self._joined(known)
                continue
            for is_whole, run in groupby(share.groups(view, topic, window), _is_whole):
                if is_whole:
                    spans += self._whole(view, digests, f"{topic} {share.timeline}", stored, [*run])
                    continue
                found = [self.add(group.messages()) for group in run]
                spans += [span for span in found if span is not None]
        return (spans[0][0], spans[-1][1]) if spans else None

    def _whole(
        self,
        view: View,
        digests: SegmentDigests | None,
        name: str,
        stored: StoredDigests[T],
        run: Sequence[Group],
    ) -> Iterator[Span]:
        """Folds consecutive groups that lie in the window, of bags that no crash cut short."""
        known = None
        if digests is not None and len(run) > 1:
            # Bags of other segments decide which bags are one group.
            name = f"{name} {run[0].bags[0].bag.file} {[len(each.bags) for each in run]}"
            known = self._reduced(digests, name, stored, partial(iter, run))
        if known is None:
            found = [self._digest(view, stored, group) for group in run]
            # Reduced as above, so that rounding does not depend on what is stored.
            known = self.reduce([each for each in found if each is not None]) if any(found) else ()
        yield from self._joined(known)

    def _digest(self, view: View, stored: StoredDigests[T], group: Group) -> tuple[T, Span] | None:
        """Returns the digest of a whole group, made from its messages where none is stored."""
        known = stored.of(group)
        if known is not None:
            return known
        failed = len(self.failures)
        with view.notes.isolated():
            made, span = self.collect(group.messages())
            if made is None or span is None:
                return None
            if failed == len(self.failures):
                stored.store(group, made, span)
        return made, span

    def _of_share(
        self,
        view: View,
        digests: SegmentDigests,
        share: Share,
        stored: StoredDigests[T],
        groups: Callable[[], Iterable[Group]],
    ) -> Sequence[tuple[T | R, Span]] | None:
        """Returns what is joined from a whole share; None where some digest is not stored.

        It is in the catalogue, too, where it follows from entries: joining a week takes seconds of
        a process's first answer.
        """
        name = f"{stored.topic} {share.key}"
        entries = _entries_of(view, digests, share)
        if entries is None:
            return self._reduced(digests, name, stored, groups)
        question = f"joined {JOINED_VERSION} {self.kind.name} {self.name} {stored.topic}"
        look_up = partial(digests.catalogue.joined, question, entries)
        known = self._reduced(digests, name, stored, groups, look_up)
        if view.call.stores_joined and known is not None and not look_up():
            digests.catalogue.store_joined(question, entries, self._encoded(known))
        return known

    def _encoded(self, known: Sequence[tuple[T | R, Span]]) -> bytes:
        parts = [self.encode(each) for each, _ in known]
        spans = [[len(part), *span] for part, (_, span) in zip(parts, known, strict=True)]
        return b"".join((json.dumps(spans).encode(), b"\n", *parts))

    def _decoded(self, packed: bytes) -> Sequence[tuple[T | R, Span]] | None:
        """Returns what `_encoded` encoded; None where a damaged file holds something else."""
        head, _, body = packed.partition(b"\n")
        found: list[tuple[T | R, Span]] = []
        at = 0
        try:
            for size, first, last in json.loads(head):
                found.append((self.decode(body[at : at + size]), (first, last)))
                at += size
        except (ValueError, TypeError, LookupError, AttributeError):
            return None
        return found

    def _reduced(
        self,
        digests: SegmentDigests,
        name: str,
        stored: StoredDigests[T],
        groups: Callable[[], Iterable[Group]],
        in_catalogue: Callable[[], bytes | None] = lambda: None,
    ) -> Sequence[tuple[T | R, Span]] | None:
        """Returns what is joined from groups of a segment; None where some digest is not stored."""

        def compute() -> Sequence[tuple[T | R, Span]] | None:
            packed = in_catalogue()
            known = self._decoded(packed) if packed else None
            return join_anew() if known is None else known

        def join_anew() -> Sequence[tuple[T | R, Span]] | None:
            found: list[tuple[T, Span]] = []
            for group in groups():
                known = stored.of(group) if _is_whole(group) else None
                if known is None:
                    return None
                found.append(known)
            return self.reduce(found) if found else ()

        # The type of a name is one: it begins with the kind of the digests.
        return digests.derived(f"{self.kind.name} joined {self.name} {name}", compute)

    def _joined(self, known: Iterable[tuple[T | R, Span]]) -> Iterator[Span]:
        for digest, span in known:
            self.join(digest, span)
            yield span


def _is_whole(group: Group) -> bool:
    return group.is_whole
