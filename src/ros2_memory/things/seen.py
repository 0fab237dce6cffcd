"""What detectors saw in a history: the sights of one stretch of the clock after the other.

A stretch is ten minutes, of one session: what is seen in it is placed by the transforms and poses
of that session then. So sights are the same however a history is cut into bags. They are made once,
where all that they follow from is in parts of the store: then they are stored beside these.
"""

from __future__ import annotations

import math
from collections import defaultdict
from hashlib import blake2b
from itertools import chain, groupby
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeVar, cast

import numpy as np

from ros2_memory.analysis.frames import static_in
from ros2_memory.analysis.sights import SLICE_NS
from ros2_memory.bag_dir.layout import is_carried
from ros2_memory.columns.fragments import FragmentKey, FragmentKind, Joined, joining
from ros2_memory.columns.scan import STRETCH_NS
from ros2_memory.columns.sights import packed, united
from ros2_memory.core.arrays import in_ranges
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.history.scan import open_scan, remembered, scan
from ros2_memory.things.placing import AROUND_NS, LOCALISER, Placer

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from ros2_memory.analysis.sights import Sights
    from ros2_memory.columns.scan import Scan
    from ros2_memory.columns.units import Rows
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View
    from ros2_memory.index.timeline import Timeline
    from ros2_memory.storage.base import IntArray


S = TypeVar("S")

VERSION: Final = 8
"""Of what sights follow from. Raise it with every change of what is seen in the same messages."""
SIGHTS_NS: Final[Ns] = 60 * SLICE_NS
_TOGETHER_NS: Final[Ns] = 36 * SIGHTS_NS
"""Sights of so long are taken from the store at once: the older ones are asked for next."""
_MANY: Final = 64
"""A bag that spans more stretches may have odd times."""
_NO_DETECTIONS: Final = frozenset(
    {
        "action_msgs",
        "actionlib_msgs",
        "builtin_interfaces",
        "diagnostic_msgs",
        "geometry_msgs",
        "map_msgs",
        "nav_msgs",
        "px4_msgs",
        "rcl_interfaces",
        "rosgraph_msgs",
        "sensor_msgs",
        "shape_msgs",
        "std_msgs",
        "stereo_msgs",
        "tf2_msgs",
        "trajectory_msgs",
        "vision_msgs/msg/LabelInfo",
    }
)
"""Packages and types whose messages hold no detections, so that nothing is looked for in them."""
_TEXT: Final = "std_msgs/msg/String"


class SeenStretch(NamedTuple, Generic[S]):
    """The sights of a session in ten minutes of the clock, or those of several in `STRETCH_NS`.

    Attributes:
        sessions: that of each section of the sights: its recordings; in the store their numbers,
            see `Seen.of`.
        starts: log time (ns) of the ten minutes of each section, in order.
        frame_id: of all places and poses: the map, or that of the robot's poses where no transforms
            lead to the map.
        spots: how many spots there are.
        sights: of each topic.
    """

    sessions: tuple[S, ...]
    starts: tuple[Ns, ...]
    frame_id: str
    spots: int
    sights: tuple[TopicSights, ...]


class TopicSights(NamedTuple):
    """The sights of a topic in a stretch, packed as `joined` takes them.

    Of `topics` there is one, or none of those that have the fixes. Where it `detects` nothing it
    may still be of a detector, which shows in other stretches.
    """

    topics: tuple[str, ...]
    detects: bool
    packed: bytes


class Seen(NamedTuple):
    """What was seen in a stretch, by the numbers of the sessions."""

    stretches: tuple[SeenStretch[int], ...]

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        topics = [topic for stretch in self.stretches for topic in stretch.sights]
        return 200 + sum(200 + len(topic.packed) for topic in topics)

    def of(self, sessions: Sequence[Session]) -> list[SeenStretch[Session]]:
        """Returns the stretches with these sessions in place of their numbers."""
        return [
            SeenStretch(tuple(sessions[number] for number in stretch[0]), *stretch[1:])
            for stretch in self.stretches
        ]


SIGHTS: Final[FragmentKind[Seen]] = FragmentKind("sights", (Seen, SeenStretch, TopicSights))
"""What detectors saw in a stretch."""


class _Lending(NamedTuple):
    """A session, and the one whose transforms hold for it: empty where none do.

    Attributes:
        slices: in which slices of the clock they hold; None: in all.
    """

    session: Session
    lender: Session
    slices: tuple[int, ...] | None = None


class _Surroundings(NamedTuple):
    """What the sights of a stretch follow from.

    Attributes:
        window: the stretch.
        folders: of the recordings that reach into it, or nearly so.
        sessions: those that the recordings are of, in the order of their names.
    """

    window: TimeWindow
    folders: Sequence[str]
    sessions: Sequence[_Lending]


def may_have_detections(type_name: str) -> bool:
    """Returns whether messages of a type may hold detections, as far as its name tells."""
    names = {type_name, type_name.partition("/")[0]}
    return type_name == _TEXT or _NO_DETECTIONS.isdisjoint(names)


def topics_with_detections(timeline: Timeline) -> list[str]:
    """Returns the topics that may have detections."""
    return [
        topic
        for topic in timeline.topics()
        if any(map(may_have_detections, timeline.types_of(topic)))
    ]


class Watching:
    """Reads what detectors saw in the bags of a view.

    Args:
        view: has the bags.
    """

    def __init__(self, view: View) -> None:
        self._view = view
        self._placer = Placer(view)
        self._sessions = view.sessions
        timeline = view.timeline
        self._topics = topics_with_detections(timeline)
        limits = view.limits
        localisers = (topic for topic in timeline.topics() if LOCALISER in timeline.types_of(topic))
        topics = (*self._topics, view.pose_topic, *limits.tf_topics, *localisers)
        self._needed = tuple(dict.fromkeys(topics))
        self._scans: list[Scan] = []
        self._may_be_repeated = view.stream.may_be_repeated(self._topics)
        is_asked = np.ones(len(timeline.bags), np.bool_)
        if any(segment.recorded is not segment for segment in timeline.segments):
            # Carried messages that nothing is seen by reach over all of the history.
            for row, bag in enumerate(timeline.bags):
                is_asked[row] = not is_carried(bag.file) or any(map(bag.summary.of, self._needed))
        self._bags = np.flatnonzero(is_asked)
        self._folder_of = timeline.folder_numbers[self._bags]
        self._firsts, self._lasts = timeline.starts[self._bags], timeline.ends[self._bags]
        self._latest = np.maximum.accumulate(self._lasts)
        self._newest = timeline.latest

    def newest_first(
        self, until: Ns = MAX_NS, most: float = math.inf
    ) -> Iterator[list[SeenStretch[Session]]]:
        """Yields the sights of all sessions in each stretch with some that begins before a time.

        In that of `STRETCH_NS` at once, if it is not the newest, and there are fewer than `most`
        spots up to its start.

        Raises:
            QueryTimeoutError: while it is iterated, when the deadline has passed.
        """
        spots = 0
        for nth, together in enumerate(self._stretches_in(TimeWindow(MIN_NS, until))):
            whole = self._joined(together) if nth else None
            is_whole = whole is not None and spots + spots_in(whole) < most
            for part in [whole] if is_whole else map(self._seen_in, together):
                if part:
                    spots += spots_in(part)
                    yield part

    def made(self, window: TimeWindow, *, is_joined: bool = False) -> Iterator[Ns]:
        """Makes the sights that follow from the parts of a window; those of others are left out.

        If `is_joined`, those of each `STRETCH_NS` at once. Yields the log time (ns) of each, the
        newest first.

        Raises:
            QueryTimeoutError: while it is iterated, when the deadline has passed.
        """
        for together in self._stretches_in(window.widened(SIGHTS_NS)):
            start = together[0].start // STRETCH_NS * STRETCH_NS
            if is_joined and window.covers(start, start + STRETCH_NS - 1):
                self._joined(together)
            for stretch in together:
                if not is_joined and self._parts_around(stretch) is not None:
                    self._seen_in(stretch)
                yield stretch.start

    def _stretches_in(self, window: TimeWindow) -> Iterator[list[TimeWindow]]:
        """Yields the stretches of a window in which there may be messages, the newest first.

        Those of each `STRETCH_NS` together.
        """
        if not self._topics:
            return
        if self._view.memory.scanner.store is not None:
            reach = window.widened(AROUND_NS + SIGHTS_NS)
            self._scans = [
                open_scan(self._view, topic, reach, copies=topic not in self._topics)
                for topic in self._needed
            ]
        is_asked = (self._firsts < window.stop) & (self._lasts >= window.start)
        spans = self._firsts[is_asked], self._lasts[is_asked]
        stretches = map(_window, reversed(self._numbers_of(*spans)))
        asked = (stretch for stretch in stretches if not stretch.intersect(window).empty)
        for _, together in groupby(asked, lambda stretch: stretch.start // STRETCH_NS):
            yield [*together]

    def _numbers_of(self, starts: IntArray, ends: IntArray) -> list[int]:
        """Returns the numbers of the stretches in which bags may have messages.

        Of each bag the log times of its first and last message are given.
        """
        first, last = starts // SIGHTS_NS, ends // SIGHTS_NS
        sizes = last - first + 1
        is_odd = sizes > _MANY
        numbers = [in_ranges(first[~is_odd], sizes[~is_odd])]
        for start, end in zip(starts[is_odd].tolist(), ends[is_odd].tolist(), strict=True):
            # Its times are odd: centuries may lie between two messages.
            window = TimeWindow(start, end).widened(1)
            for topic in self._topics:
                numbers += [rows.times // SIGHTS_NS for rows in scan(self._view, topic, window)]
        distinct: list[int] = np.unique(np.concatenate(numbers)).tolist()
        return distinct

    def _parts_around(self, window: TimeWindow) -> tuple[int, ...] | None:
        """Returns the parts that what is seen in a window follows from; None where not they alone.

        Those of all topics that places and looks need.
        """
        if not self._scans:
            return None
        numbers: set[int] = set()
        for opened in self._scans:
            parts = opened.whole_parts(window.widened(AROUND_NS))
            if parts is None:
                return None
            numbers.update(parts)
        return tuple(sorted(numbers))

    def by_bag(self, bags: Sequence[BagFile]) -> Iterator[tuple[BagFile, str, Sights]]:
        """Yields the sights of the messages of each of some bags that count, in each stretch.

        With the frame of their places, which the robot's poses decide; these are not in the sights.

        Raises:
            QueryTimeoutError: while it is iterated, when the deadline has passed.
        """
        files = {bag.file for bag in bags}
        spans = np.array([(bag.start, bag.end) for bag in bags], np.int64).reshape(-1, 2).T
        for number in self._numbers_of(*spans):
            window = _window(number)
            by_lender: dict[tuple[Session, Session], dict[BagFile, list[Rows]]] = {}
            for rows in self._rows(window):
                for bag, positions in rows.bag_rows(files):
                    session = self._sessions.of(bag.recording)
                    lender = self._transforms_of(session, bag, window)
                    of_bags = by_lender.setdefault((session, lender), {})
                    of_bags.setdefault(bag, []).append(rows.some(positions))
            for (session, lender), of_bags in by_lender.items():
                yield from self._placer.sights_by_bag(window, session, lender, of_bags)

    def _around(self, window: TimeWindow) -> _Surroundings:
        self._view.bags.check_deadline()
        near = window.widened(AROUND_NS)
        begin, end = self._latest.searchsorted(near.start), self._firsts.searchsorted(near.stop)
        reaching = begin + np.flatnonzero(self._lasts[begin:end] >= near.start)
        _, firsts = np.unique(self._folder_of[reaching], return_index=True)
        first_bags: dict[Session, BagFile] = {}
        folders = set[str]()
        for row in self._bags[reaching[np.sort(firsts)]].tolist():
            bag = self._view.timeline.bags[row]
            first_bags.setdefault(self._sessions.of(bag.recording), bag)
            folders.add(self._sessions.folder(bag.recording))
        is_alone = len(first_bags) == 1
        sessions = [
            lending
            for session, bag in first_bags.items()
            for lending in self._lendings(session, bag, window, is_alone=is_alone)
        ]
        if not is_alone:
            sessions.sort(key=lambda lending: (min(lending.session), lending.slices or ()))
        return _Surroundings(window, sorted(folders), sessions)

    def _lendings(
        self, session: Session, bag: BagFile, window: TimeWindow, *, is_alone: bool
    ) -> Iterator[_Lending]:
        """Yields whose transforms hold for a session, of which a bag is; it may be alone there."""
        if is_alone or self._sessions.has_all_kinds(session):
            yield _Lending(session, self._transforms_of(session, bag, window))
            return
        slices: dict[Session, list[int]] = defaultdict(list)
        for number in range(window.start // SLICE_NS, (window.stop - 1) // SLICE_NS + 1):
            middle = number * SLICE_NS + SLICE_NS // 2
            slices[self._sessions.lending_to(bag.recording, middle)].append(number)
        for lender, numbers in slices.items():
            yield _Lending(session, lender, tuple(numbers))

    def _transforms_of(self, session: Session, bag: BagFile, window: TimeWindow) -> Session:
        """Returns the session whose transforms hold for a bag's; empty where none has any."""
        if self._sessions.has_all_kinds(session):
            return session
        return self._sessions.lending_to(bag.recording, max(bag.start, window.start))

    def _joined(self, together: Sequence[TimeWindow]) -> list[SeenStretch[Session]] | None:
        """Returns what was seen in the stretches of a `STRETCH_NS`, as that of one; see `Seen`.

        None where it is not over, or does not follow from parts alone.
        """
        start = together[-1].start // STRETCH_NS * STRETCH_NS
        whole = TimeWindow(start, start + STRETCH_NS)
        parts = self._parts_around(whole) if whole.stop <= self._newest else None
        if parts is None:
            return None
        around = self._around(whole)
        surroundings = [around]
        if not all(self._sessions.has_all_kinds(session) for session, *_ in around.sessions):
            # Who lends to whom differs from one stretch to the next.
            surroundings = [*map(self._around, together)]
        of_all = chain.from_iterable(around.sessions for around in surroundings)
        sessions = sorted(dict.fromkeys(session for session, *_ in of_all), key=min)
        numbers = {session: number for number, session in enumerate(sessions)}
        follows_from = [
            (around.window.start, self._digest(around), [numbers[s] for s, *_ in around.sessions])
            for around in surroundings
        ]
        digest = _hashed(follows_from)

        def make() -> Joined[Seen]:
            # Which topics are of detectors shows in all of a history, so these stay apart.
            def kind(stretch: SeenStretch[Session]) -> tuple[str, list[tuple[str, ...]]]:
                return stretch.frame_id, [of_topic.topics for of_topic in stretch.sights]

            seen = [part for stretch in reversed(together) for part in self._seen_in(stretch)]
            by_kind = groupby(sorted(seen, key=kind), kind)
            return Joined([Seen(tuple(_as_one([*alike], numbers) for _, alike in by_kind))])

        key = FragmentKey(start, digest, parts)
        [seen] = remembered(self._view, joining(SIGHTS), key, make).fragments
        return seen.of(sessions)

    def _seen_in(self, stretch: TimeWindow) -> list[SeenStretch[Session]]:
        """Returns what each session saw in a stretch; from the cache where it is there."""
        around = self._around(stretch)
        return self._seen(around).of([lending.session for lending in around.sessions])

    def _seen(self, around: _Surroundings) -> Seen:
        scanner = self._view.memory.scanner
        bags = self._view.timeline.overlapping(around.window.widened(AROUND_NS))
        if any(bag.state is BagState.ACTIVE for bag in bags):
            return self._read(around)
        digest = self._digest(around)
        parts = self._parts_around(around.window)
        if parts is not None:
            part_key = FragmentKey(around.window.start, digest, parts)
            return remembered(
                self._view,
                SIGHTS,
                part_key,
                lambda: self._read(around),
                also_before=_TOGETHER_NS,
            )
        if self._may_be_repeated:
            return self._read(around)
        # Parts, as these, are of certain recordings.
        key = (around.window.start, digest, tuple(bag.identity for bag in bags))
        cached = scanner.caches.sights.get(key)
        if cached is not None:
            return cast("Seen", cached)
        before = self._view.notes.added
        seen = self._read(around)
        if self._view.notes.added == before:
            size = seen.memory_bytes + 100 * len(bags)
            scanner.caches.sights.put(key, seen, size)
        return seen

    def _digest(self, around: _Surroundings) -> str:
        """Returns what tells apart the sights of other settings, static transforms or sessions."""
        window = around.window
        transforms = [
            [
                (
                    *(static.parent, static.child, static.transform),
                    static.log_time if window.contains(static.log_time) else 0,
                )
                for static in static_in(self._view.sessions.static(lender), window)
            ]
            for _, lender, _ in around.sessions
            if lender
        ]
        begin = window.start // SLICE_NS
        sessions = [
            (
                [(folder in session, folder in lender) for folder in around.folders],
                [number - begin for number in slices or ()],
            )
            for session, lender, slices in around.sessions
        ]
        limits, body = self._view.limits, self._placer.body
        placed_by = body or self._view.pose_topic
        settings = (limits.map_frame, placed_by, limits.tf_topics, limits.tf_clock)
        return _hashed((VERSION, settings, transforms, sessions))

    def _read(self, around: _Surroundings) -> Seen:
        """Returns what was seen, by the messages."""
        by_session: dict[Session, list[Rows]] = defaultdict(list)
        start = around.window.start
        for rows in self._rows(TimeWindow(max(start - AROUND_NS, MIN_NS), around.window.stop)):
            by_session[self._sessions.of(rows.recording)].append(rows)
        stretches: list[SeenStretch[int]] = []
        for number, (session, lender, slices) in enumerate(around.sessions):
            units = by_session[session]
            if slices is not None:
                units = [
                    rows.some(
                        np.flatnonzero(
                            np.isin(rows.times // SLICE_NS, slices) | (rows.times < start)
                        )
                    )
                    for rows in units
                ]
            seen = self._placer.placed(around.window, session, lender, units)
            if seen is not None:
                frame_id, sights_of_topics, detectors = seen
                spots = sum(len(sights.spots) for sights in sights_of_topics)
                topics = tuple(
                    TopicSights(
                        sights.topics,
                        not detectors.isdisjoint(sights.topics),
                        packed(sights),
                    )
                    for sights in sights_of_topics
                )
                stretches.append(SeenStretch((number,), (start,), frame_id, spots, topics))
        return Seen(tuple(stretches))

    def _rows(self, window: TimeWindow) -> Iterator[Rows]:
        """Yields the rows in a window that may have detections."""
        for topic in self._topics:
            scanned = scan(self._view, topic, window, may_match=self._placer.rows.may_match)
            yield from filter(self._placer.rows.may_have_any, scanned)


def _as_one(
    stretches: Sequence[SeenStretch[Session]], numbers: Mapping[Session, int]
) -> SeenStretch[int]:
    """Returns stretches of the same topics and frame as one; sessions have numbers."""
    topics = tuple(
        TopicSights(
            of_topic[0].topics,
            any(sights.detects for sights in of_topic),
            united([sights.packed for sights in of_topic]),
        )
        for of_topic in zip(*(stretch.sights for stretch in stretches), strict=True)
    )
    sessions = tuple(numbers[session] for stretch in stretches for session in stretch.sessions)
    starts = tuple(start for stretch in stretches for start in stretch.starts)
    return SeenStretch(sessions, starts, stretches[0].frame_id, spots_in(stretches), topics)


def spots_in(stretches: Iterable[SeenStretch[S]]) -> int:
    """Returns how many spots there are in some stretches."""
    return sum(stretch.spots for stretch in stretches)


def _hashed(value: object) -> str:
    return blake2b(repr(value).encode(), digest_size=12).hexdigest()


def _window(number: int) -> TimeWindow:
    """Returns when a stretch is."""
    begin = number * SIGHTS_NS
    return TimeWindow(max(begin, MIN_NS), min(begin + SIGHTS_NS, MAX_NS))
