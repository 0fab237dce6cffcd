"""Reads what detectors saw in a history, stretch by stretch of the clock.

A stretch is ten minutes of one session. Its sights are placed by the transforms and poses of that
session then, so that they do not depend on how the history is cut into bags. Sights that follow
from parts of the store alone are stored beside these parts, and made only once.
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
from ros2_memory.columns.sights import pack_sights, unite_sights
from ros2_memory.core.arrays import bounds_of, in_ranges
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.spans import spans_of
from ros2_memory.core.timebase import MAX_NS, MIN_NS, Ns
from ros2_memory.history.robots import times_recorded_twice
from ros2_memory.history.scan import open_scan, remembered, scan
from ros2_memory.things.placing import AROUND_NS, LOCALISER, NEAR_NS, Placer

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.analysis.sights import Sights
    from ros2_memory.columns.scan import Scan
    from ros2_memory.columns.units import Rows
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View
    from ros2_memory.index.timeline import Timeline
    from ros2_memory.storage.base import IntArray


S = TypeVar("S")

VERSION: Final = 17
"""The version of stored sights. Raise it with every change of what is seen in the same messages."""
SIGHTS_NS: Final[Ns] = 60 * SLICE_NS
_TOGETHER_NS: Final[Ns] = 36 * SIGHTS_NS
"""Sights of this time are taken from the store at once: the older ones are asked for next."""
_MANY: Final = 64
"""A bag that spans more stretches may have odd times."""
_NO_DETECTIONS: Final = frozenset(
    {
        "action_msgs",
        "actionlib_msgs",
        "builtin_interfaces",
        "control_msgs",
        "controller_manager_msgs",
        "diagnostic_msgs",
        "geometry_msgs",
        "lifecycle_msgs",
        "map_msgs",
        "moveit_msgs",
        "nav2_msgs",
        "nav_msgs",
        "px4_msgs",
        "rcl_interfaces",
        "rosgraph_msgs",
        "sensor_msgs",
        "shape_msgs",
        "statistics_msgs",
        "std_msgs",
        "stereo_msgs",
        "tf2_msgs",
        "trajectory_msgs",
        "unique_identifier_msgs",
        "vision_msgs/msg/LabelInfo",
    }
)
"""Packages and types whose messages hold no detections: they are not read."""
_TEXT: Final = "std_msgs/msg/String"


class SeenStretch(NamedTuple, Generic[S]):
    """The sights of a session in ten minutes of the clock, or of several sessions in `STRETCH_NS`.

    A section of the sights has one session and ten minutes.

    Attributes:
        sessions: the session of each section; in the store its number, see `Seen.with_sessions`.
        starts: where the ten minutes of each section begin (log time, ns), in order.
        frame_id: of all places and poses: the map, or the frame of the robot's poses if no
            transforms lead to the map.
        spots: how many spots there are.
        sights: the sights of each topic.
    """

    sessions: tuple[S, ...]
    starts: tuple[Ns, ...]
    frame_id: str
    spots: int
    sights: tuple[TopicSights, ...]


class TopicSights(NamedTuple):
    """The sights of a topic in a stretch.

    Attributes:
        topics: the topic; none for the sights with the fixes.
        detects: whether this stretch shows that the topic is a detector's. Others may show it.
        packed: the sights as `columns.sights.join_sights` takes them.
    """

    topics: tuple[str, ...]
    detects: bool
    packed: bytes


class Seen(NamedTuple):
    """What was seen in a stretch, with numbers for sessions."""

    stretches: tuple[SeenStretch[int], ...]

    @property
    def memory_bytes(self) -> int:
        """About how much memory the sights take."""
        topics = [topic for stretch in self.stretches for topic in stretch.sights]
        return 200 + sum(200 + len(topic.packed) for topic in topics)

    def with_sessions(self, sessions: Sequence[Session]) -> list[SeenStretch[Session]]:
        """Returns the stretches with sessions in place of their numbers."""
        return [
            SeenStretch(tuple(sessions[number] for number in numbers), starts, frame, spots, sights)
            for numbers, starts, frame, spots, sights in self.stretches
        ]


SIGHTS: Final[FragmentKind[Seen]] = FragmentKind("sights", (Seen, SeenStretch, TopicSights))
"""What detectors saw in a stretch."""


class _Lending(NamedTuple):
    """A session, and the session whose transforms hold for it.

    Attributes:
        lender: empty if no transforms hold.
        slices: the slices of the clock in which they hold; None for all.
    """

    session: Session
    lender: Session
    slices: tuple[int, ...] | None = None


class _Surroundings(NamedTuple):
    """What the sights of a stretch follow from.

    Attributes:
        window: the stretch.
        folders: the folders of the recordings in the stretch, or just beside it.
        sessions: the sessions of these recordings, in the order of their names.
    """

    window: TimeWindow
    folders: Sequence[str]
    sessions: Sequence[_Lending]


def may_have_detections(type_name: str) -> bool:
    """Returns whether messages of a type may hold detections, as far as the type's name tells."""
    names = {type_name, type_name.partition("/")[0]}
    return type_name == _TEXT or _NO_DETECTIONS.isdisjoint(names)


def topics_with_detections(timeline: Timeline) -> list[str]:
    """Returns the topics that may have detections."""
    return [
        topic
        for topic in timeline.topics()
        if any(map(may_have_detections, timeline.types_of(topic)))
    ]


class SightReader:
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
        """Yields the sights of all sessions, stretch by stretch, up to a log time (ns).

        A stretch without sights is left out. The stretches of one `STRETCH_NS` come at once, except
        the newest, and except where that would lead to `most` spots or more.

        Raises:
            QueryTimeoutError: while it is iterated, when the deadline has passed.
        """
        spots, window = 0, TimeWindow(MIN_NS, until)
        self._scans = self._open_scans(window)
        for nth, stretches in enumerate(self._stretches_in(window)):
            joined = self._joined_sights(stretches) if nth else None
            if joined is not None and spots + spots_in(joined) < most:
                parts: Iterable[list[SeenStretch[Session]]] = [joined]
            else:
                parts = map(self._seen_in, stretches)
            for part in parts:
                if part:
                    spots += spots_in(part)
                    yield part

    def make_sights(self, window: TimeWindow, *, is_joined: bool = False) -> Iterator[Ns]:
        """Makes and stores the sights of a window that follow from parts of the store alone.

        With `is_joined` it joins the stored sights of each whole `STRETCH_NS`. Yields where each
        stretch begins (log time, ns), the newest first.

        Raises:
            QueryTimeoutError: while it is iterated, when the deadline has passed.
        """
        reach = window.widened(SIGHTS_NS)
        self._scans = self._open_scans(reach)
        for stretches in self._stretches_in(reach):
            start = stretches[0].start // STRETCH_NS * STRETCH_NS
            if is_joined and window.covers(start, start + STRETCH_NS - 1):
                self._joined_sights(stretches)
            for stretch in stretches:
                if not is_joined and self._parts_around(stretch) is not None:
                    self._seen_in(stretch)
                yield stretch.start

    def _open_scans(self, window: TimeWindow) -> list[Scan]:
        """Returns a scan of each topic that sights follow from; none without a store."""
        if not self._topics or self._view.memory.scanner.store is None:
            return []
        reach = window.widened(AROUND_NS + SIGHTS_NS)
        return [
            open_scan(self._view, topic, reach, copies=topic not in self._topics)
            for topic in self._needed
        ]

    def _stretches_in(self, window: TimeWindow) -> Iterator[list[TimeWindow]]:
        """Yields the stretches of each `STRETCH_NS` that may have messages, the newest first."""
        if not self._topics:
            return
        is_inside = (self._firsts < window.stop) & (self._lasts >= window.start)
        numbers = self._numbers_of(self._firsts[is_inside], self._lasts[is_inside])
        stretches = map(_stretch_window, reversed(numbers))
        inside = (stretch for stretch in stretches if not stretch.intersect(window).empty)
        for _, neighbours in groupby(inside, lambda stretch: stretch.start // STRETCH_NS):
            yield [*neighbours]

    def _numbers_of(self, starts: IntArray, ends: IntArray) -> list[int]:
        """Returns the numbers of the stretches in which bags may have messages.

        `starts` and `ends` are the log times (ns) of the bags' first and last messages.
        """
        first, last = starts // SIGHTS_NS, ends // SIGHTS_NS
        sizes = last - first + 1
        is_odd = sizes > _MANY
        numbers = [in_ranges(first[~is_odd], sizes[~is_odd])]
        for start, end in spans_of(starts[is_odd], ends[is_odd]):
            # Centuries may lie between two messages of such a bag: look which stretches have any.
            window = TimeWindow(start, end).widened(1)
            for topic in self._topics:
                numbers += [rows.times // SIGHTS_NS for rows in scan(self._view, topic, window)]
        distinct: list[int] = np.unique(np.concatenate(numbers)).tolist()
        return distinct

    def _parts_around(self, window: TimeWindow) -> tuple[int, ...] | None:
        """Returns the parts of all topics that the sights of a window follow from.

        None if they follow from more than whole parts of the store.
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

    def sights_by_bag(self, bags: Sequence[BagFile]) -> Iterator[tuple[BagFile, str, Sights]]:
        """Yields each bag with its sights in each stretch, and the frame of their places.

        Only messages that count are seen. The sights do not have the robot's poses.

        Raises:
            QueryTimeoutError: while it is iterated, when the deadline has passed.
        """
        files = {bag.file for bag in bags}
        spans = bounds_of((bag.start, bag.end) for bag in bags)
        for number in self._numbers_of(*spans):
            window = _stretch_window(number)
            units_by_lender: dict[tuple[Session, Session], dict[BagFile, list[Rows]]] = {}
            for rows in self._rows(window):
                for bag, positions in rows.bag_rows(files):
                    session = self._sessions.session_of(bag.recording)
                    lender = self._lender_to(session, bag, window)
                    units_of_bags = units_by_lender.setdefault((session, lender), {})
                    units_of_bags.setdefault(bag, []).append(rows.some(positions))
            for (session, lender), units_of_bags in units_by_lender.items():
                yield from self._placer.sights_by_bag(window, session, lender, units_of_bags)

    def _surroundings(self, window: TimeWindow) -> _Surroundings:
        """Returns the recordings and sessions in a stretch, and which session lends transforms."""
        self._view.bags.check_deadline()
        near = window.widened(AROUND_NS)
        begin, end = self._latest.searchsorted(near.start), self._firsts.searchsorted(near.stop)
        reaching = begin + np.flatnonzero(self._lasts[begin:end] >= near.start)
        _, firsts = np.unique(self._folder_of[reaching], return_index=True)
        first_bags: dict[Session, BagFile] = {}
        folders = set[str]()
        for row in self._bags[reaching[np.sort(firsts)]].tolist():
            bag = self._view.timeline.bags[row]
            first_bags.setdefault(self._sessions.session_of(bag.recording), bag)
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
        """Yields a session with each session that lends it transforms in a window.

        `bag` is any bag of the session. `is_alone`: the window has no other session.
        """
        if is_alone or self._sessions.has_all_kinds(session):
            yield _Lending(session, self._lender_to(session, bag, window))
            return
        slices: dict[Session, list[int]] = defaultdict(list)
        for number in range(window.start // SLICE_NS, (window.stop - 1) // SLICE_NS + 1):
            middle = number * SLICE_NS + SLICE_NS // 2
            slices[self._sessions.lending_to(bag.recording, middle)].append(number)
        for lender, numbers in slices.items():
            yield _Lending(session, lender, tuple(numbers))

    def _lender_to(self, session: Session, bag: BagFile, window: TimeWindow) -> Session:
        """Returns the session whose transforms hold for a bag's session; empty if none has any."""
        if self._sessions.has_all_kinds(session):
            return session
        return self._sessions.lending_to(bag.recording, max(bag.start, window.start))

    def _joined_sights(self, stretches: Sequence[TimeWindow]) -> list[SeenStretch[Session]] | None:
        """Returns the sights in all stretches of a `STRETCH_NS`, joined as if of one stretch.

        None if that time is not over, or if the sights follow from more than whole parts.
        """
        start = stretches[-1].start // STRETCH_NS * STRETCH_NS
        whole = TimeWindow(start, start + STRETCH_NS)
        parts = self._parts_around(whole) if whole.stop <= self._newest else None
        if parts is None:
            return None
        surroundings = [self._surroundings(whole)]
        lendings = surroundings[0].sessions
        if not all(self._sessions.has_all_kinds(lending.session) for lending in lendings):
            # Who lends to whom differs from one stretch to the next.
            surroundings = [*map(self._surroundings, stretches)]
            lendings = [*chain.from_iterable(around.sessions for around in surroundings)]
        sessions = sorted(dict.fromkeys(lending.session for lending in lendings), key=min)
        numbers = {session: number for number, session in enumerate(sessions)}
        follows_from = []
        for around in surroundings:
            numbers_around = [numbers[lending.session] for lending in around.sessions]
            follows_from.append((around.window.start, self._digest(around), numbers_around))
        key = FragmentKey(start, _hashed(follows_from), parts)
        [seen] = remembered(
            self._view, joining(SIGHTS), key, lambda: self._join_sights(stretches, numbers)
        ).fragments
        return seen.with_sessions(sessions)

    def _join_sights(
        self, stretches: Sequence[TimeWindow], numbers: Mapping[Session, int]
    ) -> Joined[Seen]:
        """Joins the sights of stretches that have the same frame and topics.

        Topics stay apart, since only all of a history shows which of them are detectors'.
        """
        alike: dict[tuple[str, tuple[tuple[str, ...], ...]], list[SeenStretch[Session]]] = {}
        for stretch in reversed(stretches):
            for part in self._seen_in(stretch):
                kind = part.frame_id, tuple(of_topic.topics for of_topic in part.sights)
                alike.setdefault(kind, []).append(part)
        return Joined([Seen(tuple(_united(alike[kind], numbers) for kind in sorted(alike)))])

    def _seen_in(self, stretch: TimeWindow) -> list[SeenStretch[Session]]:
        """Returns what each session saw in a stretch."""
        around = self._surroundings(stretch)
        return self._seen(around).with_sessions([lending.session for lending in around.sessions])

    def _seen(self, around: _Surroundings) -> Seen:
        """Returns what was seen in a stretch: from the store or the cache, if it can be there."""
        bags = self._view.timeline.overlapping(around.window.widened(AROUND_NS))
        if any(bag.state is BagState.ACTIVE for bag in bags):
            return self._read(around)
        start, digest = around.window.start, self._digest(around)
        parts = self._parts_around(around.window)
        if parts is not None:
            return remembered(
                self._view,
                SIGHTS,
                FragmentKey(start, digest, parts),
                lambda: self._read(around),
                also_before=_TOGETHER_NS,
            )
        if self._may_be_repeated:
            return self._read(around)
        # Parts, as these, are of certain recordings.
        key = (start, digest, tuple(bag.identity for bag in bags))
        cache = self._view.memory.scanner.caches.sights
        cached = cache.get(key)
        if cached is not None:
            return cast("Seen", cached)
        with self._view.bags.watched() as reading:
            seen = self._read(around)
        if reading.is_final:
            cache.put(key, seen, seen.memory_bytes + 100 * len(bags))
        return seen

    def _digest(self, around: _Surroundings) -> str:
        """Returns a hash of the settings, static transforms and sessions behind the sights."""
        window = around.window
        transforms = []
        for lending in around.sessions:
            if not lending.lender:
                continue
            in_window = static_in(self._view.sessions.static(lending.lender), window)
            transforms.append(
                [
                    (
                        *(static.parent, static.child, static.transform),
                        static.log_time if window.contains(static.log_time) else 0,
                    )
                    for static in in_window
                ]
            )
        first_slice = window.start // SLICE_NS
        sessions = []
        for session, lender, slices in around.sessions:
            members = [(folder in session, folder in lender) for folder in around.folders]
            sessions.append((members, [number - first_slice for number in slices or ()]))
        limits, body = self._view.limits, self._placer.body
        placed_by = body or self._view.pose_topic
        settings = (limits.map_frame, placed_by, limits.tf_topics, limits.tf_clock)
        twice = [(folder.name, at.start, at.stop) for folder, at in self._twice_in(window)]
        return _hashed((VERSION, settings, transforms, sessions, twice))

    def _twice_in(self, window: TimeWindow) -> list[tuple[Path, TimeWindow]]:
        """Returns the recordings that have times around a window twice, with these times.

        Which poses belong to what was seen then is not known.
        """
        reach = window.widened(AROUND_NS)
        pairs = times_recorded_twice(self._view, reach)
        return [(pair.first, pair.span.widened(NEAR_NS).intersect(reach)) for pair in pairs]

    def _read(self, around: _Surroundings) -> Seen:
        """Returns what was seen in a stretch by its messages."""
        units_by_session: dict[Session, list[Rows]] = defaultdict(list)
        start = around.window.start
        for rows in self._rows(TimeWindow(max(start - AROUND_NS, MIN_NS), around.window.stop)):
            units_by_session[self._sessions.session_of(rows.recording)].append(rows)
        stretches: list[SeenStretch[int]] = []
        for number, (session, lender, slices) in enumerate(around.sessions):
            units = units_by_session[session]
            if slices is not None:
                units = [_rows_in_slices(rows, slices, start) for rows in units]
            placed = self._placer.place(around.window, session, lender, units)
            if placed is None:
                continue
            spots = sum(len(sights.spots) for sights in placed.sights)
            topics = tuple(
                TopicSights(
                    sights.topics,
                    not placed.detectors.isdisjoint(sights.topics),
                    pack_sights(sights),
                )
                for sights in placed.sights
            )
            stretches.append(SeenStretch((number,), (start,), placed.frame_id, spots, topics))
        return Seen(tuple(stretches))

    def _rows(self, window: TimeWindow) -> Iterator[Rows]:
        """Yields the rows in a window that may have detections, but not of times that are twice."""
        twice = self._twice_in(window)
        for topic in self._topics:
            scanned = scan(self._view, topic, window, may_match=self._placer.rows.columns.may_match)
            for rows in filter(self._placer.rows.may_have_any, scanned):
                once = _rows_once(rows, twice)
                if len(once):
                    yield once


def _rows_once(rows: Rows, twice: Sequence[tuple[Path, TimeWindow]]) -> Rows:
    """Returns the rows without those of times that their recording has twice."""
    for recording, span in twice:
        if recording == rows.recording:
            rows = rows.some(np.flatnonzero(~span.holding(rows.times)))
    return rows


def _rows_in_slices(rows: Rows, slices: Sequence[int], start: Ns) -> Rows:
    """Returns the rows in slices of the clock, and all rows before a time (ns)."""
    is_inside = np.isin(rows.times // SLICE_NS, slices) | (rows.times < start)
    return rows.some(np.flatnonzero(is_inside))


def _united(
    stretches: Sequence[SeenStretch[Session]], numbers: Mapping[Session, int]
) -> SeenStretch[int]:
    """Returns stretches with the same topics and frame as one, with numbers for sessions."""
    topics = tuple(
        TopicSights(
            of_topic[0].topics,
            any(sights.detects for sights in of_topic),
            unite_sights([sights.packed for sights in of_topic]),
        )
        for of_topic in zip(*(stretch.sights for stretch in stretches), strict=True)
    )
    sessions = tuple(numbers[session] for stretch in stretches for session in stretch.sessions)
    starts = tuple(start for stretch in stretches for start in stretch.starts)
    return SeenStretch(sessions, starts, stretches[0].frame_id, spots_in(stretches), topics)


def spots_in(stretches: Iterable[SeenStretch[S]]) -> int:
    """Returns how many spots there are in stretches."""
    return sum(stretch.spots for stretch in stretches)


def _hashed(value: object) -> str:
    return blake2b(repr(value).encode(), digest_size=12).hexdigest()


def _stretch_window(number: int) -> TimeWindow:
    """Returns the ten minutes of the stretch with a number."""
    begin = number * SIGHTS_NS
    return TimeWindow(max(begin, MIN_NS), min(begin + SIGHTS_NS, MAX_NS))
