"""Sightings of a text by what digests know of every message, without reading bags.

A sighting is as in `insights.sightings`: message after message that meets a condition. Which of a
bag's messages do is known by their texts (`catalogue.text_runs`), so that sightings are counted,
and the first or the last of them found, by some bits for each bag. The messages in which these
begin and end are read, and bags without such a digest, where they are few.
"""

from __future__ import annotations

from functools import partial
from itertools import chain, islice, pairwise, repeat
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.analysis.bulk_decode import BulkDecoder
from ros2_memory.analysis.conditions import leaves
from ros2_memory.analysis.intervals import SILENCE_NS
from ros2_memory.analysis.payload_templates import template_for
from ros2_memory.catalogue.text_runs import TextRunsBuilder, decode_text_runs, encode_text_runs
from ros2_memory.core.errors import UndecodableError
from ros2_memory.history.bag_fold import shares_of
from ros2_memory.history.bag_groups import DigestKind, StoredDigests, store_shared
from ros2_memory.history.reverse_search import possible_entries

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from ros2_memory.analysis.conditions import Condition
    from ros2_memory.analysis.payload_templates import Bytes, PayloadTemplate
    from ros2_memory.catalogue.text_runs import TextRuns
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.bag_fold import Share
    from ros2_memory.history.bag_groups import Group, Span
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.reverse_search import ReverseSearch
    from ros2_memory.history.view import View
    from ros2_memory.storage.base import Record

_MOST_READ: Final = 16
"""Groups of bags without a digest that are read: the search itself need not read them all."""
_MOST_AT_ONCE: Final = 1024

_TEXT_RUNS: Final = DigestKind(
    "texts",
    look_up=lambda digests, topic, among: digests.catalogue.text_runs(topic, among),
    encode=encode_text_runs,
    decode=decode_text_runs,
)


class KnownSighting(NamedTuple):
    """A sighting: its last message, the log time of its first one, and how many there are."""

    newest: StoredMessage
    first: Ns
    messages: int


class KnownSightings(NamedTuple):
    """The sightings that were asked for, in order; `total` is None if more were not counted."""

    sightings: tuple[KnownSighting, ...]
    total: int | None


class _Met(NamedTuple):
    """Which messages of a group of bags meet the condition.

    Attributes:
        group: of bags.
        first: log time of its first message.
        last: of its last one.
        size: how many messages there are; 1 where none of any number meets the condition.
        bits: of those that do, the first message's lowest.
        silent: the bit of each that comes after a silence.
    """

    group: Group
    first: Ns
    last: Ns
    size: int
    bits: int
    silent: int

    def runs(self) -> Iterator[tuple[int, int]]:
        """Yields the first and the last message (inclusive) of each run, in order."""
        begins = self.bits & (~(self.bits << 1) | self.silent)
        ends = self.bits & (~(self.bits >> 1) | self.silent >> 1)
        while begins:
            yield (begins & -begins).bit_length() - 1, (ends & -ends).bit_length() - 1
            begins &= begins - 1
            ends &= ends - 1

    @property
    def begins_met(self) -> bool:
        """Whether the first message meets the condition."""
        return bool(self.bits & 1)

    @property
    def ends_met(self) -> bool:
        """Whether the last message does."""
        return bool(self.bits >> (self.size - 1))


class _Sum(NamedTuple):
    """What consecutive groups add up to: how many runs, and what decides whether they go on."""

    runs: int
    first: Ns
    last: Ns
    begins_met: bool
    ends_met: bool


class _Run(NamedTuple):
    """A sighting: the groups and numbers of its first and its last message, and how many."""

    begin: tuple[_Met, int]
    end: tuple[_Met, int]
    messages: int


class _NotKnownError(Exception):
    """Digests do not show it."""


def known_sightings(
    view: View,
    search: ReverseSearch,
    condition: Condition,
    window: TimeWindow,
    limit: int,
    *,
    oldest_first: bool,
) -> KnownSightings | None:
    """Returns the newest or the oldest sightings in a window, `limit` at most.

    Of the oldest the total is exact; of the newest it is, if there are no more. None where there
    are none, and where digests do not show them: then bags are to be searched.

    Raises:
        QueryTimeoutError: the call's time is over.
    """
    if len(search.topics) != 1 or not condition.is_on_texts_alone:
        return None
    if not _can_match(view, search.topics[0], condition, window):
        return None
    runs = _Runs(view, search, condition, window)
    try:
        total = runs.total() if oldest_first else None
        if total == 0:
            return None
        found = [*islice(runs.oldest() if oldest_first else runs.newest(), limit + 1)]
        if not found:
            return None
        if total is None and len(found) <= limit:
            total = len(found)
        return KnownSightings(tuple(map(_sighting, found[:limit])), total)
    except _NotKnownError:
        return None


def _can_match(view: View, topic: str, condition: Condition, window: TimeWindow) -> bool:
    """Returns whether some bag of the window may hold a match, by what whole segments can hold."""
    timeline = view.snapshot.timeline
    for segment in timeline.segments_in(window):
        digests = view.bags.digests_of(segment)
        if digests is None or not digests.whole:
            return True
        is_settled = timeline.is_settled(segment)
        if possible_entries(digests, topic, condition, is_settled=is_settled):
            return True
    return False


class _Runs:
    """The sightings of one topic, from either end of a window."""

    def __init__(
        self, view: View, search: ReverseSearch, condition: Condition, window: TimeWindow
    ) -> None:
        self._view = view
        self._search = search
        [self._topic] = search.topics
        self._condition = condition
        self._window = window
        self._left = _MOST_READ
        self._meets: dict[str, bool] = {}

    def total(self) -> int:
        """Returns how many there are."""
        sums = map(self._sum, self._shares())
        return sum(each.runs for each in _summed(chain.from_iterable(sums)))

    def oldest(self) -> Iterator[_Run]:
        """Yields the sightings, the oldest first."""
        open_run: _Run | None = None
        last = 0
        for met in chain.from_iterable(map(self._met, self._shares())):
            for nth, (begin, end) in enumerate(met.runs()):
                run = _Run((met, begin), (met, end), end - begin + 1)
                if open_run is not None:
                    if nth == 0 and begin == 0 and met.first - last <= SILENCE_NS:
                        run = _joined(open_run, run)
                    else:
                        yield open_run
                open_run = run
            if open_run is not None and not met.ends_met:
                yield open_run
                open_run = None
            last = met.last
        if open_run is not None:
            yield open_run

    def newest(self) -> Iterator[_Run]:
        """Yields the sightings, the newest first."""
        open_run: _Run | None = None
        first = 0
        newest_first = partial(self._met, newest_first=True)
        for met in chain.from_iterable(map(newest_first, reversed(self._shares()))):
            for nth, (begin, end) in enumerate([*met.runs()][::-1]):
                run = _Run((met, begin), (met, end), end - begin + 1)
                if open_run is not None:
                    if nth == 0 and end == met.size - 1 and first - met.last <= SILENCE_NS:
                        run = _joined(run, open_run)
                    else:
                        yield open_run
                open_run = run
            if open_run is not None and not met.begins_met:
                yield open_run
                open_run = None
            first = met.first
        if open_run is not None:
            yield open_run

    def _shares(self) -> list[Share]:
        return shares_of(self._view, self._topic, self._window)

    def _sum(self, share: Share) -> Sequence[_Sum]:
        """Returns what the groups of a share add up to, if there is any; remembered if whole."""
        view = self._view
        view.bags.check_deadline()
        digests = view.bags.digests_of(share.segment)
        if digests is None or not share.is_covered_by(self._window):
            return _summed(map(_sum_of, self._met(share)))
        name = f"sightings {self._topic} {self._condition!r} {share.key}"
        # A list of none or one: what cannot be read now is looked at again.
        known: list[Sequence[_Sum]] = digests.derived(name, list)
        if not known:
            with view.notes.isolated():
                found = _summed(map(_sum_of, self._met(share)))
                if not view.notes.complete:
                    return found
                known.append(found)
        return known[0]

    def _met(self, share: Share, *, newest_first: bool = False) -> Iterator[_Met]:
        """Yields the groups of a share with a message in the window, in order."""
        stored = StoredDigests(self._view, self._topic, _TEXT_RUNS, share.inside(self._window))
        groups = share.groups(self._view, self._topic, self._window)
        for each in reversed(groups) if newest_first else groups:
            met = self._of_group(each, stored)
            if met is not None:
                yield met

    def _of_group(self, group: Group, stored: StoredDigests[TextRuns]) -> _Met | None:
        if group.is_whole:
            if not group.may_be_relatched and not self._may_match(group):
                first = group.first
                last = group.last
                return _Met(group, first, last, 1, 0, 0)
            known = stored.of(group)
            if known is not None:
                runs, (first, last) = known
                return _Met(group, first, last, runs.size, self._bits(runs), runs.silent)
            if len(group.bags) == 1 and self._view.bags.entry(group.bags[0].bag) is not None:
                raise _NotKnownError  # its texts are too many, as those of others will be
        return self._read(group)

    def _may_match(self, group: Group) -> bool:
        """Returns whether some bag may have a message that meets the condition."""
        for each in group.bags:
            entry = self._view.bags.entry(each.bag)
            if entry is None or entry[1] in possible_entries(
                entry[0], self._topic, self._condition
            ):
                return True
        return False

    def _bits(self, runs: TextRuns) -> int:
        bits = 0
        for text, having in runs.texts.items():
            if text not in self._meets:
                self._meets[text] = self._condition.test.matches(text)
            if self._meets[text]:
                bits |= having
        return bits

    def _read(self, group: Group) -> _Met | None:
        """Reads the messages of a group that has no digest; None where it has none."""
        if not self._left:
            raise _NotKnownError
        self._left -= 1
        messages = [*group.messages()]
        # The newest first, as a search reports what it cannot decode.
        met = [self._search.matches(each) for each in reversed(messages)][::-1]
        if None in met:
            raise _NotKnownError
        if not messages:
            return None
        times = [each.time for each in messages]
        bits = sum(1 << at for at, each in enumerate(met) if each)
        silent = sum(
            1 << at
            for at, (before, after) in enumerate(pairwise(times), 1)
            if after - before > SILENCE_NS
        )
        return _Met(group, times[0], times[-1], len(times), bits, silent)


def _sum_of(met: _Met) -> _Sum:
    runs = sum(1 for _ in met.runs())
    return _Sum(runs, met.first, met.last, met.begins_met, met.ends_met)


def _summed(parts: Iterable[_Sum]) -> Sequence[_Sum]:
    """Returns what consecutive parts add up to: one, or none of none."""
    whole: _Sum | None = None
    for each in parts:
        if whole is None:
            whole = each
            continue
        goes_on = whole.ends_met and each.begins_met and each.first - whole.last <= SILENCE_NS
        runs = whole.runs + each.runs - goes_on
        whole = _Sum(runs, whole.first, each.last, whole.begins_met, each.ends_met)
    return () if whole is None else (whole,)


def _joined(before: _Run, after: _Run) -> _Run:
    return _Run(before.begin, after.end, before.messages + after.messages)


def _sighting(run: _Run) -> KnownSighting:
    """Reads the messages in which a run begins and ends."""
    (begun, begin), (ended, end) = run.begin, run.end
    newest = next(iter(ended.group.fetch([end])), None)
    if newest is None:
        raise _NotKnownError
    first = begun.first
    if begin:
        times = begun.group.times()
        if len(times) != begun.size:
            raise _NotKnownError
        first = times[begin]
    return KnownSighting(newest, first, run.messages)


def topics_with_texts(view: View) -> list[str]:
    """Returns the topics of whose newest bags it is known which texts each message has."""
    found: list[str] = []
    for topic in view.snapshot.timeline.topics():
        segment = next(
            (each for each in reversed(view.snapshot.timeline.segments) if topic in each.spans),
            None,
        )
        digests = None if segment is None else view.bags.digests_of(segment)
        if digests is not None and digests.catalogue.text_runs(topic, [*digests.numbers.values()]):
            found.append(topic)
    return found


def store_shared_texts(view: View, topic: str, window: TimeWindow) -> int:
    """Stores the texts in recordings that overlap; returns of how many groups of bags."""
    return store_shared(view, topic, _TEXT_RUNS, partial(_collected, view), window)


def _collected(
    view: View, messages: Iterable[StoredMessage]
) -> tuple[TextRuns | None, Span | None]:
    """Returns the texts of messages, and the first and the last of their times."""
    reader, extractor = view.memory.reader, view.memory.extractor

    def decode(record: Record) -> frozenset[str]:
        value = extractor.exact(reader.decode(record), record.channel.type)
        return frozenset(each for each in leaves(value) if isinstance(each, str))

    def template(record: Record, _: frozenset[str]) -> PayloadTemplate | None:
        return template_for(reader, extractor, record)

    def apply(
        _template: PayloadTemplate, first: frozenset[str], records: Sequence[Record], _rows: Bytes
    ) -> Iterable[frozenset[str]]:
        return repeat(first, len(records))

    decoder = BulkDecoder(decode, template, apply)
    builder = TextRunsBuilder()
    times: list[Ns] = []
    rest = iter(messages)
    while some := list(islice(rest, _MOST_AT_ONCE)):
        for found, texts in zip(some, decoder.decode([each.record for each in some]), strict=True):
            times.append(found.time)
            if isinstance(texts, UndecodableError):
                builder.give_up()
            else:
                builder.add(found.time, texts)
    return builder.runs(), (times[0], times[-1]) if times else None
