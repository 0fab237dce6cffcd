"""What detectors saw in a history: the sights of one stretch of the clock after the other.

A stretch is ten minutes, of one session: what is seen in it is placed by the transforms and poses
of that session then. So sights are the same however a history is cut into bags.

Which topics are of detectors shows in their messages: they hold detections, or their type is named
for them. Other messages of such a topic count as looks that saw nothing.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from hashlib import blake2b
from itertools import accumulate, chain, pairwise
from struct import Struct
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from ros2_memory.analysis.frames import Frames, multiply, static_at
from ros2_memory.analysis.motion.odometry import FARTHEST_M
from ros2_memory.analysis.poses import NO_POSES, Poses, headings, joined_poses
from ros2_memory.analysis.sights import AHEAD_MM, SLICE_NS, Seen, fixes_of, sights_of
from ros2_memory.bag_dir.layout import is_carried
from ros2_memory.columns.fragments import Fragment, FragmentKey, Kind
from ros2_memory.columns.sights import packed
from ros2_memory.core.errors import InvalidArgumentsError, UndecodableError
from ros2_memory.core.model import BagState, TimeWindow
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns
from ros2_memory.history.detections import DetectionRows, joined_detected
from ros2_memory.history.frames import frames_over
from ros2_memory.history.poses import pose_rows
from ros2_memory.history.scan import messages_of, scan
from ros2_memory.history.transforms import sessions_of, static_transforms

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from ros2_memory.analysis.frames import Rotations
    from ros2_memory.analysis.sights import Sights
    from ros2_memory.columns.units import Rows
    from ros2_memory.core.model import BagFile, StampedTransform
    from ros2_memory.history.detections import Detected
    from ros2_memory.history.sessions import Session
    from ros2_memory.history.view import View

    Ints = NDArray[np.int64]
    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]

VERSION: Final = 1
"""Of what sights follow from. Raise it with every change of what is seen in the same messages."""
STRETCH_NS: Final[Ns] = 60 * SLICE_NS
_SIZE: Final = Struct("<I")
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
    }
)
"""Packages whose messages hold no detections, so that nothing is looked for in them."""
_TEXT: Final = "std_msgs/msg/String"
_OF_DETECTORS: Final = ("detection", "recognizedobject")
_LOCALISER: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
_NEAR_NS: Final[Ns] = NS_PER_S
"""Farther from a pose, where the robot was is not known."""
_AROUND_NS: Final[Ns] = 12 * NS_PER_S
"""How far around a stretch poses and transforms bear on it."""
_FIX_NS: Final[Ns] = 2 * NS_PER_S
"""How far apart it is looked where odometry is in the map."""
_AHEAD_NS: Final[Ns] = 3 * _FIX_NS
"""How far beyond the last detection: a jump soon after it shows that localisation was off."""
_MOST_FIXES: Final = 2_000
_SAID_NS: Final[Ns] = NS_PER_S // 2
"""What a localiser says more often than that is not read."""
_SAME_M: Final = 0.1
"""What changes less from one look to the next is left out."""
_COVARIANCE: Final = 36


class Stretch(NamedTuple):
    """The sights of a session in ten minutes of the clock.

    Attributes:
        start: log time (ns).
        frame_id: of all places and poses: the map, or that of the robot's poses where no transforms
            lead to the map.
        session: its recordings; None where the frame is the map, which is the same for all.
        spots: how many spots there are.
        sights: packed, as `joined` takes them.
    """

    start: Ns
    frame_id: str
    session: Session | None
    spots: int
    sights: tuple[bytes, ...]


class Placed(NamedTuple):
    """What one session saw in a stretch.

    Attributes:
        nth: which of the sessions around the stretch, in the order of their names.
        frame_id: as of a `Stretch`.
        sights: of each topic.
    """

    nth: int
    frame_id: str
    sights: tuple[Sights, ...]


class _InBytes(NamedTuple):
    """What was seen in a stretch; see `in_bytes`. Empty where no detector published."""

    data: bytes

    @property
    def memory_bytes(self) -> int:
        """About how much memory it takes."""
        return 200 + len(self.data)

    @classmethod
    def of(cls, fragment: Fragment) -> _InBytes:
        """Returns what was stored."""
        return cls(fragment.arrays["sights"].tobytes())

    def fragment(self) -> Fragment:
        """Returns it as it is stored."""
        return Fragment("", {"sights": np.frombuffer(self.data, np.uint8)})


SIGHTS: Final = Kind("sights", _InBytes.fragment, _InBytes.of)
"""What detectors saw in a stretch."""


class _Placing(NamedTuple):
    """A session, and the one whose transforms hold for it: empty where none do.

    Attributes:
        slices: in which slices of the clock they hold; None: in all.
    """

    own: Session
    among: Session
    slices: tuple[int, ...] | None = None


class _Around(NamedTuple):
    """What the sights of a stretch follow from.

    Attributes:
        window: the stretch.
        bags: that reach into it, or nearly so.
        parts: the parts of their topics there; None where not all of their rows are in parts, or
            some of these do not count.
        sessions: those that the bags are of, in the order of their names.
    """

    window: TimeWindow
    bags: Sequence[BagFile]
    parts: tuple[int, ...] | None
    sessions: Sequence[_Placing]


def is_named_for_detections(type_name: str) -> bool:
    """Returns whether a type is one of a detector by its name."""
    name = type_name.rpartition("/")[2].casefold()
    return any(word in name for word in _OF_DETECTORS)


def may_have_detections(type_name: str) -> bool:
    """Returns whether messages of a type may hold detections, as far as its name tells."""
    return type_name == _TEXT or type_name.partition("/")[0] not in _NO_DETECTIONS


def in_bytes(placed: Sequence[Placed]) -> bytes:
    """Returns what was seen as bytes: of each session what there is, as JSON, then the sights."""
    parts = [[packed(sights) for sights in one.sights] for one in placed]
    head = [
        (one.nth, one.frame_id, sum(len(sights.spots) for sights in one.sights), [*map(len, own)])
        for one, own in zip(placed, parts, strict=True)
    ]
    described = json.dumps(head).encode()
    return b"".join((_SIZE.pack(len(described)), described, *chain.from_iterable(parts)))


class Watching:
    """Reads what detectors saw in the bags of a view.

    Args:
        view: has the bags.
    """

    def __init__(self, view: View) -> None:
        self._view = view
        self._rows = DetectionRows(view)
        self._sessions = sessions_of(view)
        self._of: dict[Path, Session] = {}
        timeline = view.snapshot.timeline
        self._topics = [
            topic
            for topic in timeline.topics()
            if any(map(may_have_detections, timeline.types_of(topic)))
        ]
        limits = view.memory.limits
        self._needed = (
            *self._topics,
            view.pose_topic,
            *limits.tf_topics,
            *(topic for topic in timeline.topics() if _LOCALISER in timeline.types_of(topic)),
        )
        self._lasts = not view.stream.may_be_relatched(self._topics)
        self._followed: tuple[object, str] = None, ""

    def newest_first(self) -> Iterator[list[Stretch]]:
        """Yields the sights of all sessions in each stretch that has some.

        Raises:
            QueryTimeoutError: while it is iterated, when the deadline has passed.
        """
        shipped = self._view.memory.sights
        if shipped is not None:
            yield from self._shipped(shipped)
            return
        for around in self._stretches_in(TimeWindow.everything()):
            sessions = [one.own for one in around.sessions]
            if found := self._unpacked(around.window.start, sessions, self._known(around)):
                yield found

    def make(self, window: TimeWindow) -> None:
        """Makes the sights that follow from the parts of a window; those of others are left out.

        Raises:
            QueryTimeoutError: the deadline has passed.
        """
        for around in self._stretches_in(window.widened(STRETCH_NS)):
            if around.parts is not None:
                self._known(around)

    def _stretches_in(self, window: TimeWindow) -> Iterator[_Around]:
        """Yields the stretches of a window in which there may be messages, the newest first."""
        if not self._topics:
            return
        bags = _Bags(self._view, self._topics, self._needed, window)
        for number in bags.stretches():
            self._view.bags.check_deadline()
            yield self._around(_window(number), *bags.around(_window(number).widened(_AROUND_NS)))

    def in_bag(self, bag: BagFile) -> list[Placed]:
        """Returns the sights of the messages of one bag that count, in each stretch.

        Raises:
            QueryTimeoutError: the deadline has passed.
        """
        own = self._session(bag)
        found: list[Placed] = []
        for number in _numbers_of(self._view, self._topics, bag):
            window = _window(number).intersect(TimeWindow(bag.start, bag.end + 1))
            rows = [
                (topic, some.some(positions))
                for topic, some in self._found(window)
                for each, positions in some.bag_rows()
                if each.file == bag.file
            ]
            found += self._placed(0, window, own, self._transforms_of(own, bag, window), rows)
        return found

    def _shipped(self, shipped: Callable[[BagFile], bytes]) -> Iterator[list[Stretch]]:
        """Yields the sights of the bags of a lake, each as a stretch."""
        for bag in reversed(self._view.snapshot.timeline.bags):
            self._view.bags.check_deadline()
            if found := self._unpacked(bag.start, [self._session(bag)], shipped(bag)):
                yield found

    def _unpacked(self, start: Ns, sessions: Sequence[Session], data: bytes) -> list[Stretch]:
        """Returns what was seen from its bytes; see `in_bytes`."""
        if not data:
            return []
        [size] = _SIZE.unpack_from(data)
        at = _SIZE.size + size
        found = []
        for nth, frame, spots, lengths in json.loads(data[_SIZE.size : at]):
            ends = [*accumulate(lengths, initial=at)]
            parts = tuple(data[begin:end] for begin, end in pairwise(ends))
            at = ends[-1]
            in_map = frame == self._view.memory.limits.map_frame
            found.append(Stretch(start, frame, None if in_map else sessions[nth], spots, parts))
        return found

    def _session(self, bag: BagFile) -> Session:
        if bag.recording not in self._of:
            self._of[bag.recording] = self._sessions.of(bag.recording)
        return self._of[bag.recording]

    def _around(
        self, window: TimeWindow, bags: Sequence[BagFile], parts: tuple[int, ...] | None
    ) -> _Around:
        first: dict[Session, BagFile] = {}
        for bag in bags:
            first.setdefault(self._session(bag), bag)
        sessions = [
            one
            for own, bag in first.items()
            for one in self._placings(own, bag, window, len(first))
        ]
        if len(first) > 1:
            sessions.sort(key=lambda one: (min(one.own), one.slices or ()))
        return _Around(window, bags, parts, sessions)

    def _placings(
        self, own: Session, bag: BagFile, window: TimeWindow, sessions: int
    ) -> Iterator[_Placing]:
        """Yields whose transforms hold for a session, of which a bag is, among so many sessions."""
        if sessions == 1 or self._sessions.has_all_kinds(own):
            yield _Placing(own, self._transforms_of(own, bag, window))
            return
        slices: dict[Session, list[int]] = defaultdict(list)
        for number in range(window.start // SLICE_NS, (window.stop - 1) // SLICE_NS + 1):
            middle = number * SLICE_NS + SLICE_NS // 2
            slices[self._sessions.lending_to(bag.recording, middle)].append(number)
        for among, some in slices.items():
            yield _Placing(own, among, tuple(some))

    def _transforms_of(self, own: Session, bag: BagFile, window: TimeWindow) -> Session:
        """Returns the session whose transforms hold for a bag's; empty where none has any."""
        if self._sessions.has_all_kinds(own):
            return own
        return self._sessions.lending_to(bag.recording, max(bag.start, window.start))

    def _known(self, around: _Around) -> bytes:
        """Returns what was seen in a stretch, in bytes; from memory where that is known."""
        scanner = self._view.memory.columns
        is_open = any(bag.state is BagState.ACTIVE for bag in around.bags)
        if scanner is None or is_open or not self._lasts:
            return self._read(around)
        before = self._view.notes.added
        followed = self._follows_from(around)
        if around.parts is not None:
            fragments = scanner.fragments(SIGHTS)
            part_key = FragmentKey(around.window.start, followed, around.parts)
            known = fragments.get(part_key)
            if known is None:
                known = _InBytes(self._read(around))
                if self._view.notes.added == before:
                    fragments.put(part_key, known)
            return known.data
        # Parts, as these, are of certain recordings.
        bags = [(bag.file, bag.size, bag.mtime_ns, bag.sidecar_ns) for bag in around.bags]
        key = (around.window.start, followed, tuple(bags))
        data = scanner.sights.get(key)
        if data is None:
            data = self._read(around)
            if self._view.notes.added == before:
                scanner.sights.put(key, data, 200 + len(data) + 100 * len(bags))
        return data

    def _follows_from(self, around: _Around) -> str:
        """Returns what tells apart the sights of other settings, static transforms or sessions."""
        window = around.window
        statics = [
            [
                (one, one.log_time if window.contains(one.log_time) else 0)
                for one in static_in(static_transforms(self._view, among), window)
            ]
            for _, among, _ in around.sessions
            if among
        ]
        near = sorted(map(self._sessions.folder, {bag.recording for bag in around.bags}))
        begin = window.start // SLICE_NS
        of = [
            ([(one in own, one in among) for one in near], [nth - begin for nth in slices or ()])
            for own, among, slices in around.sessions
        ]
        # Mostly they are those of the stretch before, object by object.
        if self._followed[0] != (statics, of):
            limits = self._view.memory.limits
            every = [
                [(one.parent, one.child, one.transform, time) for one, time in some]
                for some in statics
            ]
            settings = (limits.map_frame, self._view.pose_topic, limits.tf_topics, limits.tf_clock)
            digest = blake2b(repr((VERSION, settings, every, of)).encode(), digest_size=12)
            self._followed = (statics, of), digest.hexdigest()
        return self._followed[1]

    def _read(self, around: _Around) -> bytes:
        of_session: dict[Session, list[tuple[str, Rows]]] = defaultdict(list)
        for topic, rows in self._found(around.window):
            of_session[self._sessions.of(rows.recording)].append((topic, rows))
        placed: list[Placed] = []
        for nth, (own, among, slices) in enumerate(around.sessions):
            found = of_session[own]
            if slices is not None:
                found = [(topic, _in_slices(rows, slices)) for topic, rows in found]
            placed += self._placed(nth, around.window, own, among, found)
        return in_bytes(placed) if placed else b""

    def _found(self, window: TimeWindow) -> Iterator[tuple[str, Rows]]:
        """Yields the rows in a window that may have detections."""
        for topic in self._topics:
            for rows in scan(self._view, topic, window, may_match=self._rows.may_match):
                yield topic, rows

    def _placed(
        self,
        nth: int,
        window: TimeWindow,
        own: Session,
        among: Session,
        found: Sequence[tuple[str, Rows]],
    ) -> Iterator[Placed]:
        """Yields the sights of one session, if a detector published."""
        by_topic: dict[str, list[Rows]] = defaultdict(list)
        for topic, rows in sorted(found, key=_place_of):
            by_topic[topic].append(rows)
        detected: dict[str, Detected] = {}
        for topic, some in by_topic.items():
            all_of = joined_detected([self._rows.of(rows) for rows in some])
            named = any(is_named_for_detections(rows.table.channel.type) for rows in some)
            if all_of.found.rows.size or (named and all_of.log_times.size):
                detected[topic] = all_of
        if not detected:
            return
        poses = self._poses(own, window)
        target, frames = self._frames(among, window, poses)
        sights = [sights_of(topic, _seen(each, poses, frames)) for topic, each in detected.items()]
        if target == self._view.memory.limits.map_frame and len(poses):
            times = np.concatenate([each.log_times for each in detected.values()])
            fixes = self._fixes(own, poses.frames.words[0], frames, times)
            sights[0] = sights[0].with_fixes(fixes)
        yield Placed(nth, target, tuple(sights))

    def _poses(self, own: Session, window: TimeWindow) -> Poses:
        """Returns the robot's poses in the frame that most of them are in."""
        failures: list[UndecodableError] = []
        found = pose_rows(
            self._view,
            self._view.pose_topic,
            window.widened(2 * _NEAR_NS),
            failures,
            among=lambda recording: self._sessions.of(recording) == own,
        )
        try:
            poses = joined_poses([each.poses for each in found])
        except InvalidArgumentsError:  # the topic is of no poses
            return NO_POSES
        if not len(poses):
            return poses
        # Poses of one topic nearly always have one frame: those of others are left out.
        frame = int(np.bincount(poses.frames.codes).argmax())
        is_place = (np.abs(poses.positions) < FARTHEST_M).all(axis=1)
        is_one = (poses.frames.codes == frame) & is_place
        poses = poses.rows(np.flatnonzero(is_one))
        words = poses.frames.words[frame : frame + 1]
        return replace(
            poses, frames=poses.frames._replace(codes=poses.frames.codes * 0, words=words)
        )

    def _frames(self, among: Session, window: TimeWindow, poses: Poses) -> tuple[str, Frames]:
        """Returns the frame to place all in (the map if transforms lead there), and the frames."""
        own = poses.frames.words[0] if len(poses) else ""
        target = self._view.memory.limits.map_frame or own
        if not among:
            target = own if len(poses) else target
            return target, Frames((), {}, target)
        frames = frames_over(self._view, among, window, target)
        if not len(poses) or (own and (own == target or frames.reaches(own))):
            return target, frames
        return own, frames_over(self._view, among, window, own)

    def _fixes(self, own: Session, frame: str, frames: Frames, seen: Ints) -> Ints:
        """Returns where odometry was in the map around detections, where that changes."""
        first, last = int(seen.min()), int(seen.max()) + _AHEAD_NS
        step = max(1, (last - first) // (_MOST_FIXES * _FIX_NS)) * _FIX_NS
        most = MAX_NS // step
        begin, end = max(first // step - 1, -most), min(last // step + 2, most)
        times = np.arange(begin, end) * step
        around = TimeWindow(int(seen.min()), int(seen.max())).widened(_AROUND_NS)
        said, sigma = self._localised(own, around)
        found = frames.poses(frame, times) if frame != frames.target else None
        pose = np.zeros((len(times), 3))
        if found is not None:
            x, y, _ = found.translation
            pose = np.stack((x, y, _yaw(found.rotation)), axis=1)[found.valid]
            times = times[found.valid]
        elif not len(said):
            return fixes_of(times[:0], pose[:0], sigma[:0])
        known = np.append(sigma, [math.nan])[np.searchsorted(said, times, side="right") - 1]
        changed = np.abs(np.diff(pose, axis=0)).max(axis=1, initial=0.0) > _SAME_M
        changed |= np.abs(np.diff(np.nan_to_num(known, nan=-1.0))) > _SAME_M
        # One in each slice of the clock besides, however little changes.
        kept = times // SLICE_NS != (times - step) // SLICE_NS
        kept[1:] |= changed
        kept[:-1] |= changed
        kept &= (times >= first - step) & (times <= last)
        return fixes_of(times[kept], pose[kept], known[kept])

    def _localised(self, own: Session, window: TimeWindow) -> tuple[Ints, Floats]:
        """Returns what the localiser said: when, and its standard deviation (m)."""
        timeline = self._view.snapshot.timeline
        topics = [topic for topic in timeline.topics() if _LOCALISER in timeline.types_of(topic)]
        found = sorted(each for topic in topics for each in self._covariances(topic, own, window))
        times = np.array([time for time, _ in found], np.int64)
        return times, np.array([sigma for _, sigma in found], np.float64)

    def _covariances(
        self, topic: str, own: Session, window: TimeWindow
    ) -> Iterator[tuple[Ns, float]]:
        """Yields what a localiser says, now and then: covariances have no columns."""
        memory = self._view.memory
        for rows in scan(self._view, topic, window):
            if self._sessions.of(rows.recording) != own:
                continue
            numbers = rows.times // _SAID_NS
            first = np.flatnonzero(np.diff(numbers, prepend=numbers[:1] - 1))
            for found in messages_of(self._view, rows.some(first)):
                try:
                    message = memory.reader.decode(found.record)
                except UndecodableError:
                    continue
                frame = memory.extractor.frame(message).lstrip("/")
                sigma = _sigma_ahead(getattr(getattr(message, "pose", None), "covariance", None))
                if sigma is not None and frame == memory.limits.map_frame:
                    yield found.time, sigma


class _Bags:
    """The bags of a view in a window, and what is stored of them, as arrays.

    Without those of carried messages that nothing is seen by: they reach over all of the history.

    Args:
        view: has the bags.
        topics: those that may have detections.
        needed: all topics on which sights depend.
        window: the window.
    """

    def __init__(
        self, view: View, topics: Sequence[str], needed: Sequence[str], window: TimeWindow
    ) -> None:
        self._view = view
        self._topics = topics
        self._window = window
        around = window.widened(_AROUND_NS)
        self._bags = [
            bag
            for bag in view.snapshot.timeline.overlapping(around)
            if not is_carried(bag.file) or any(map(bag.summary.of, needed))
        ]
        count = len(self._bags)
        self._starts = np.fromiter((bag.start for bag in self._bags), np.int64, count)
        self._ends = np.fromiter((bag.end for bag in self._bags), np.int64, count)
        self._latest = np.maximum.accumulate(self._ends)
        self._parts = _Parts.of(view, needed, around, self._bags)

    def stretches(self) -> list[int]:
        """Returns the numbers of the stretches in which there may be messages, the newest first."""
        first, last = self._starts // STRETCH_NS, self._ends // STRETCH_NS
        long = np.flatnonzero(last - first > 1)
        more = [_numbers_of(self._view, self._topics, self._bags[nth]) for nth in long.tolist()]
        every = np.concatenate([first, last, *(np.array([*some], np.int64) for some in more)])
        numbers: list[int] = np.unique(every)[::-1].tolist()
        return [nth for nth in numbers if not _window(nth).intersect(self._window).empty]

    def around(self, window: TimeWindow) -> tuple[list[BagFile], tuple[int, ...] | None]:
        """Returns the bags that reach into a window, and the parts; see `_Around`."""
        begin = int(np.searchsorted(self._latest, window.start))
        end = int(np.searchsorted(self._starts, window.stop))
        here = begin + np.flatnonzero(self._ends[begin:end] >= window.start)
        bags = [self._bags[nth] for nth in here.tolist()]
        return bags, None if self._parts is None else self._parts.around(window, here)


class _Parts(NamedTuple):
    """The parts of some topics in a window, as arrays.

    Attributes:
        is_merged: of each bag, whether it is in parts.
        firsts: of each part, the first log time, ascending.
        lasts: likewise the last one.
        latest: the latest of the parts so far.
        numbers: of the parts.
        all_count: whether all rows of the part do.
    """

    is_merged: Flags
    firsts: Ints
    lasts: Ints
    latest: Ints
    numbers: Ints
    all_count: Flags

    @classmethod
    def of(
        cls, view: View, topics: Sequence[str], window: TimeWindow, bags: Sequence[BagFile]
    ) -> _Parts | None:
        """Returns the parts of some topics, and which bags are in parts; None without a store."""
        scanner = view.memory.columns
        if scanner is None or scanner.store is None:
            return None
        # Before the parts: what becomes a part meanwhile is in none of those that are known.
        splits = scanner.store.splits()
        coverage = scanner.coverage(view.snapshot.timeline)
        if coverage is None:
            return None
        merged = {
            bag.file
            for part in coverage.segments
            if window.overlaps(part.segment.bags[0].start, part.segment.latest)
            for bag, number in zip(part.segment.bags, part.numbers.tolist(), strict=True)
            if number >= 0 and number not in splits
        }
        heads = [head for topic in {*topics} for head in scanner.parts(topic, window, coverage)]
        heads.sort(key=lambda head: head.first)
        firsts = np.array([head.first for head in heads], np.int64)
        lasts = np.array([head.last for head in heads], np.int64)
        count = [coverage.among(head.bags).size == head.bags.size for head in heads]
        return cls(
            np.fromiter((bag.file in merged for bag in bags), np.bool_, len(bags)),
            firsts,
            lasts,
            np.maximum.accumulate(lasts),
            np.array([head.number for head in heads], np.int64),
            np.array(count, np.bool_),
        )

    def around(self, window: TimeWindow, bags: Ints) -> tuple[int, ...] | None:
        """Returns the parts in a window; None where not all rows of its bags are there, or count.

        `bags` are the positions of the bags.
        """
        if not self.is_merged[bags].all():
            return None
        begin = int(np.searchsorted(self.latest, window.start))
        end = int(np.searchsorted(self.firsts, window.stop))
        here = begin + np.flatnonzero(self.lasts[begin:end] >= window.start)
        return tuple(np.sort(self.numbers[here]).tolist()) if self.all_count[here].all() else None


def _in_slices(rows: Rows, slices: Sequence[int]) -> Rows:
    return rows.some(np.flatnonzero(np.isin(rows.times // SLICE_NS, slices)))


def _window(number: int) -> TimeWindow:
    """Returns when a stretch is."""
    begin = number * STRETCH_NS
    return TimeWindow(max(begin, MIN_NS), min(begin + STRETCH_NS, MAX_NS))


def _numbers_of(view: View, topics: Sequence[str], bag: BagFile) -> Sequence[int]:
    """Returns the numbers of the stretches in which a bag may have messages of some topics."""
    numbers = range(bag.start // STRETCH_NS, bag.end // STRETCH_NS + 1)
    if len(numbers) <= _MANY:
        return numbers
    # Its times are odd: centuries may lie between two messages.
    window = TimeWindow(bag.start, bag.end).widened(1)
    every = [rows.times // STRETCH_NS for topic in topics for rows in scan(view, topic, window)]
    found: list[int] = np.unique(np.concatenate([np.empty(0, np.int64), *every])).tolist()
    return found


def _place_of(found: tuple[str, Rows]) -> tuple[Ns, Ns, str]:
    """Returns what orders tables, however they are stored."""
    _, rows = found
    return rows.first, rows.last, str(rows.recording)


def static_in(static: Sequence[StampedTransform], window: TimeWindow) -> list[StampedTransform]:
    """Returns the static transforms of a session that hold in a window."""
    return static_at(static, window.start) + [
        one for one in static if window.contains(one.log_time)
    ]


def _seen(detected: Detected, poses: Poses, frames: Frames) -> Seen:
    """Returns messages with the robot's poses and the detections placed in the target frame."""
    found = detected.found
    places = np.full(found.places.shape, math.nan)
    has_place = ~np.isnan(found.places).any(axis=1)
    for code, frame in enumerate(found.frames.words):
        some = np.flatnonzero(has_place & (found.frames.codes == code))
        known = (
            frames.poses(frame, detected.times[found.rows[some]]) if frame and len(some) else None
        )
        if known is not None:
            x, y, z = found.places[some].T
            placed = np.stack(known.points((x, y, z)), axis=1)
            places[some] = np.where(known.valid[:, None], placed, math.nan)
    robot = _robot_at(poses, detected.times, frames)
    labels = found.labels.codes.astype(np.int64), found.labels.words
    return Seen(detected.log_times, robot, found.rows, *labels, places, found.scores)


def _robot_at(poses: Poses, times: Ints, frames: Frames) -> Floats:
    """Returns x, y (m) and heading (rad) of the robot at some times; NaN where not known.

    That is farther than 1 s from a pose, or where no transform leads from its frame.
    """
    robot = np.full((len(times), 3), math.nan)
    placed = frames.poses(poses.frames.words[0], times) if len(poses) else None
    if placed is None:
        return robot
    last = len(poses) - 1
    after = np.searchsorted(poses.times, times, side="right")
    before, after = np.clip(after - 1, 0, last), np.clip(after, 0, last)
    start, stop = poses.times[before], poses.times[after]
    ratio = np.clip((times - start) / np.maximum(stop - start, 1), 0.0, 1.0)
    is_known = np.minimum(np.abs(times - start), np.abs(stop - times)) <= _NEAR_NS
    is_known &= (stop - start <= 2 * _NEAR_NS) & placed.valid
    a, b = poses.positions[before], poses.positions[after]
    x, y, z = (a + (b - a) * ratio[:, None]).T
    heading = headings(poses.turns)
    turn = np.remainder(heading[after] - heading[before] + np.pi, 2 * np.pi) - np.pi
    half = (heading[before] + turn * ratio) / 2
    level = np.zeros(len(times))
    x, y, _ = placed.points((x, y, z))
    yaw = _yaw(multiply(placed.rotation, (level, level, np.sin(half), np.cos(half))))
    return np.where(is_known[:, None], np.stack((x, y, yaw), axis=1), math.nan)


def _yaw(rotation: Rotations) -> Floats:
    x, y, z, w = rotation
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _sigma_ahead(covariance: object) -> float | None:
    """Returns the standard deviation (m) of a point `AHEAD_MM` before a pose; None if unknown."""
    if not isinstance(covariance, Sequence | np.ndarray) or len(covariance) != _COVARIANCE:
        return None
    x, y, yaw = (float(covariance[nth]) for nth in (0, 7, 35))
    variance = max(x, y) + yaw * (AHEAD_MM / 1000) ** 2
    return math.sqrt(variance) if variance >= 0 and math.isfinite(variance) else None
