"""Folds the digests of a topic segment by segment, so that a week is not joined again each time.

What is joined from the bags of a whole segment is kept for as long as the segment is in use. Bags
that have no digest are read, the newest first, for a few seconds: what is older is left out then,
and reported.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeVar

from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.timebase import NS_PER_S, Deadline, Ns
from ros2_memory.history.bag_fold import shares_of
from ros2_memory.history.bag_groups import DigestKind, Group, StoredDigests
from ros2_memory.history.context import READING_S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from ros2_memory.core.errors import UndecodableError
    from ros2_memory.core.model import TimeWindow
    from ros2_memory.history.bag_fold import Share
    from ros2_memory.history.bag_groups import Span
    from ros2_memory.history.duplicates import StoredMessage
    from ros2_memory.history.view import View

T = TypeVar("T")
R = TypeVar("R")

_CUT_NS: Final[Ns] = 300 * NS_PER_S


class Digested(NamedTuple, Generic[T]):
    """The digest of some messages, and the times of the first and the last of them (inclusive)."""

    digest: T
    first: Ns
    last: Ns


@dataclass(frozen=True, slots=True)
class Folded(Generic[R]):
    """What was folded of a window, in order; what is before `since` was not read in time."""

    parts: tuple[R, ...]
    since: Ns | None = None


@dataclass(frozen=True, slots=True)
class SegmentFold(Generic[T, R]):
    """How digests of a topic are folded.

    Attributes:
        kind: of the digests.
        collect: makes a digest of messages, if they amount to one; with their times.
        reduce: joins digests in order; called with one at least.
        name: of what `reduce` returns; another one for everything that it depends on.
        edges: times at which groups are cut, since `reduce` needs to know what is where.
        cut_ns: how long a group is cut at least: it is read, since a digest does not show what of
            it is where.
        failures: where `collect` puts messages that cannot be decoded.
    """

    kind: DigestKind[T]
    collect: Callable[[Iterable[StoredMessage]], tuple[T | None, Span | None]]
    reduce: Callable[[Sequence[Digested[T]]], R]
    name: str
    edges: Sequence[Ns] = ()
    cut_ns: Ns = _CUT_NS
    failures: Sequence[UndecodableError] = ()

    def over(self, view: View, topic: str, window: TimeWindow) -> Folded[R]:
        """Folds a window.

        Raises:
            QueryTimeoutError: the call's time runs out before any result.
        """
        reading = _Reading(view)
        parts: list[R] = []
        since: Ns | None = None
        for share in reversed(shares_of(view, topic, window)):
            view.bags.check_deadline()
            part, since = self._share(view, topic, share, window, reading)
            if part is not None:
                parts.append(part)
            if since is not None:
                break
        if since is not None and not parts:
            view.bags.check_deadline()
            raise QueryTimeoutError(
                f"the question needs more time; {view.bags.backfill_progress()}"
                "ask about a shorter window"
            )
        return Folded(tuple(reversed(parts)), since)

    def _share(
        self, view: View, topic: str, share: Share, window: TimeWindow, reading: _Reading
    ) -> tuple[R | None, Ns | None]:
        """Returns what is folded of a share, and since when, if not all was read in time."""
        digests = view.bags.digests_of(share.segment)
        if digests is None or not share.is_covered_by(window):
            return self._fold(view, topic, share, window, reading)
        inner = [edge for edge in self.edges if share.first < edge <= share.last]
        # The type of a name is one: `name` is part of it.
        name = f"{self.name} {topic} {inner} {share.key}"
        known: list[R | None] = digests.derived(name, list)
        if known:
            return known[0], None
        with view.notes.isolated():
            folded, since = self._fold(view, topic, share, window, reading)
            if since is None and view.notes.complete and not self.failures:
                known.append(folded)
        return folded, since

    def _fold(
        self, view: View, topic: str, share: Share, window: TimeWindow, reading: _Reading
    ) -> tuple[R | None, Ns | None]:
        stored = StoredDigests(view, topic, self.kind, share.inside(window))
        found: list[Digested[T]] = []
        since: Ns | None = None
        for group, known in self._looked_up(view, topic, share.groups(view, topic, window), stored):
            if known is not None:
                found.append(known)
                continue
            if reading.is_over:
                since = group.last + 1
                break
            found.extend(reversed([*self._made(view, group, stored)]))
        return (self.reduce(found[::-1]) if found else None), since

    def _looked_up(
        self, view: View, topic: str, groups: Sequence[Group], stored: StoredDigests[T]
    ) -> Iterator[tuple[Group, Digested[T] | None]]:
        """Yields groups, the newest first, with what `_look_up` returns.

        One that would have to be read is taken apart into its bags, where that can be done.
        """
        for group in reversed(groups):
            known = self._look_up(group, stored)
            parts = [group] if known is not None else view.apart(topic, group)
            if len(parts) == 1:
                yield group, known
            else:
                yield from ((part, self._look_up(part, stored)) for part in reversed(parts))

    def _look_up(self, group: Group, stored: StoredDigests[T]) -> Digested[T] | None:
        """Returns what needs no reading."""
        if not group.is_whole or self._is_cut(group):
            return None
        known = stored.of(group)
        return None if known is None else Digested(known[0], *known[1])

    def _made(self, view: View, group: Group, stored: StoredDigests[T]) -> Iterator[Digested[T]]:
        """Yields the digest of a group that is read; several where it is cut."""
        if self._is_cut(group):
            for _, messages in groupby(group.messages(), key=lambda each: self._piece(each.time)):
                made, span = self.collect(messages)
                if made is not None and span is not None:
                    yield Digested(made, *span)
            return
        failed = len(self.failures)
        # What cannot be read of other groups does not matter to this one.
        with view.notes.isolated():
            made, span = self.collect(group.messages())
            if made is not None and span is not None:
                if group.is_whole and failed == len(self.failures):
                    stored.store(group, made, span)
                yield Digested(made, *span)

    def _is_cut(self, group: Group) -> bool:
        is_long = group.last - group.first > self.cut_ns
        return is_long and self._piece(group.first) != self._piece(group.last)

    def _piece(self, at: Ns) -> int:
        return bisect_right(self.edges, at)


class _Reading:
    """How long bags have been read; counted from the first one on."""

    def __init__(self, view: View) -> None:
        self._view = view
        self._deadline: Deadline | None = None

    @property
    def is_over(self) -> bool:
        """Whether no more bags are to be read."""
        if self._deadline is None:
            self._deadline = self._view.call.partial_after(READING_S)
        return self._deadline.expired() or self._view.call.deadline.expired()
