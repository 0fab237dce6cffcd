"""Sights: what the detectors of one bag saw, and from where, as small tables of integers.

A *spot* is where a detector saw one label: the mean of detections that lie together, never two of
one message. A *look* is a cell of the robot's pose (`CELL_MM`, `CELL_DECIDEG`) from which a
detector published, whether it saw anything or not. A *hit* counts how often a spot was seen in a
look. So it is known what was not seen, too.

Lengths are in mm, angles in tenths of a degree, times in ns of log time, scores in thousandths:
integers, so that sums do not depend on their order. Tables of several bags are joined by
`joined`, which is associative.

A bag of more than a minute is several *slices*, each with the tables of a short bag: the sum over
an hour does not show whether a thing was missed before or after it was last seen. So things are
the same, whether a history is one file or many.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import chain, combinations
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from ros2_memory.core.timebase import MAX_NS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from ros2_memory.core.model import Vector3
    from ros2_memory.core.timebase import Ns

Ints: TypeAlias = NDArray[np.int64]
Bytes: TypeAlias = NDArray[np.uint8]
K = TypeVar("K")

CELL_MM: Final = 250
CELL_DECIDEG: Final = 100
SCORE_BINS: Final = 20
"""Scores are counted in bins of 0.05, what lies above 1 in the last one."""

_GATE_SQUARED: Final = 750.0**2
"""A detection farther from a spot is of another thing: 30 cm of noise, two and a half times."""
_SAME_M: Final = 0.5
"""Spots that grew this near to each other were one, unless messages have both."""
_TOGETHER_SHARE: Final = 0.05
_BESIDE_MM: Final = 600
"""Another label this near in the same message is not this one under a wrong name."""
_MAX_SPOTS: Final = 64
_MAX_LABELS: Final = 512
_MAX_LABEL_CHARS: Final = 120
_MAX_COMPARED: Final = 32
_MAX_AWAY_M: Final = 1e6
_MAX_SCORE: Final = 1e6
_NS_PER_US: Final = 1_000
_TOGETHER_MESSAGES: Final = 3
_SLICE_NS: Final = 10_000_000_000
"""A slice is about this long: `recording.split_duration_s` as shipped."""
_UNDIVIDED_NS: Final = 64_000_000_000
"""A bag of at most this length is one slice: for a split of a minute six take thrice the bytes."""


class Spot(IntEnum):
    """Columns of `Sights.spots`.

    `DEV` is the root mean square distance of the detections in the plane; `BEST` is -1 without
    scores; `TOGETHER` is how many of the label at least three messages had at once, or all had.
    """

    BAG = 0
    TOPIC = 1
    LABEL = 2
    N = 3
    X = 4
    Y = 5
    Z = 6
    DEV = 7
    FIRST = 8
    LAST = 9
    BEST = 10
    TOGETHER = 11


class Look(IntEnum):
    """Columns of `Sights.looks`: the mean pose in one cell, and the number of messages."""

    BAG = 0
    TOPIC = 1
    X = 2
    Y = 3
    YAW = 4
    N = 5
    FIRST = 6
    LAST = 7


class Hit(IntEnum):
    """Columns of `Sights.hits`: how many messages of a look have a detection of a spot."""

    SPOT = 0
    LOOK = 1
    N = 2


class Score(IntEnum):
    """Columns of `Sights.scores`: how many detections of a spot have a score in a bin."""

    SPOT = 0
    BIN = 1
    N = 2


class Beside(IntEnum):
    """Columns of `Sights.beside`: detections of a spot that had another label beside them."""

    SPOT = 0
    LABEL = 1
    N = 2


class Unplaced(IntEnum):
    """Columns of `Sights.unplaced`: detections of a label without a place."""

    BAG = 0
    TOPIC = 1
    LABEL = 2
    N = 3
    FIRST = 4
    LAST = 5


class Fix(IntEnum):
    """Columns of `Sights.fixes`: where odometry was in the map, and how exactly that was known.

    `SIGMA` is what the localiser says, for a point `AHEAD_MM` before the robot; -1 if it does not.
    """

    BAG = 0
    TIME = 1
    X = 2
    Y = 3
    YAW = 4
    SIGMA = 5


AHEAD_MM: Final = 2_000
"""Things are about so far away: so much do errors of heading weigh."""
_TABLES: Final = (Spot, Look, Hit, Score, Beside, Unplaced, Fix)
_TIMES: Final = (
    (Spot.FIRST, Spot.LAST),
    (Look.FIRST, Look.LAST),
    (),
    (),
    (),
    (Unplaced.FIRST, Unplaced.LAST),
    (Fix.TIME,),
)


class PlacedDetection(NamedTuple):
    """A detection in the frame of the sights: `place` (m) is None where that is not known."""

    label: str
    place: Vector3 | None
    score: float | None = None


@dataclass(frozen=True, slots=True)
class Sights:
    """What detectors saw in one bag, or in several: column 0 of most tables numbers their slices.

    `bags` is the number of slices, each of which counts as a bag. `frame_id` is the frame of all
    places and poses; empty where bags of several are joined.
    """

    topics: tuple[str, ...]
    labels: tuple[str, ...]
    tables: tuple[Ints, ...]
    bags: int = 1
    frame_id: str = ""

    @property
    def spots(self) -> Ints:
        """Where labels were seen (`Spot`)."""
        return self.tables[0]

    @property
    def looks(self) -> Ints:
        """From where detectors published (`Look`)."""
        return self.tables[1]

    @property
    def hits(self) -> Ints:
        """How often a spot was seen in a look (`Hit`)."""
        return self.tables[2]

    @property
    def scores(self) -> Ints:
        """The scores of spots (`Score`)."""
        return self.tables[3]

    @property
    def beside(self) -> Ints:
        """Which other labels were beside a spot in the same message (`Beside`)."""
        return self.tables[4]

    @property
    def unplaced(self) -> Ints:
        """Detections without a place (`Unplaced`)."""
        return self.tables[5]

    @property
    def fixes(self) -> Ints:
        """Where odometry was in the map (`Fix`)."""
        return self.tables[6]

    def __eq__(self, other: object) -> bool:
        """Returns whether all tables are equal."""
        return (
            isinstance(other, Sights)
            and (self.topics, self.labels, self.bags) == (other.topics, other.labels, other.bags)
            and self.frame_id == other.frame_id
            and all(np.array_equal(a, b) for a, b in zip(self.tables, other.tables, strict=True))
        )

    __hash__ = None  # type: ignore[assignment]  # compared by arrays, so not hashable


def no_sights() -> Sights:
    """Returns the sights of a bag in which no detector published."""
    return Sights((), (), tuple(np.zeros((0, len(each)), np.int64) for each in _TABLES))


def _count_up(counts: dict[K, int], more: Mapping[K, int]) -> None:
    for key, count in more.items():
        counts[key] = counts.get(key, 0) + count


class _Cluster:
    """A spot while it grows; `cx` and `cy` are its mean (mm)."""

    __slots__ = (
        "beside",
        "best",
        "cx",
        "cy",
        "first",
        "hits",
        "last",
        "n",
        "scores",
        "squares",
        "x",
        "y",
        "z",
    )

    def __init__(self, time: Ns) -> None:
        self.n = self.x = self.y = self.z = self.squares = 0
        self.cx = self.cy = 0.0
        self.first = self.last = time
        self.best = -1
        self.hits: dict[int, int] = {}
        self.scores: dict[int, int] = {}
        self.beside: dict[str, int] = {}

    def add(self, seen: _Placed, time: Ns, look: int) -> None:
        x, y = seen.x, seen.y
        self.n = n = self.n + 1
        self.x += x
        self.y += y
        self.z += seen.z
        self.cx, self.cy = self.x / n, self.y / n
        self.squares += x * x + y * y
        self.last = time
        for label in seen.beside or ():
            self.beside[label] = self.beside.get(label, 0) + 1
        self.hits[look] = self.hits.get(look, 0) + 1
        score = seen.score
        if score is not None:
            score = min(max(score, 0.0), _MAX_SCORE)
            thousandths = round(score * 1000)  # float32 has 0.7 as 0.69999999
            self.best = max(self.best, thousandths)
            nth = min(thousandths * SCORE_BINS // 1000, SCORE_BINS - 1)
            self.scores[nth] = self.scores.get(nth, 0) + 1

    def squared_to(self, x: float, y: float) -> float:
        dx, dy = self.cx - x, self.cy - y
        return dx * dx + dy * dy

    def absorb(self, other: _Cluster) -> None:
        self.n += other.n
        self.x += other.x
        self.y += other.y
        self.z += other.z
        self.squares += other.squares
        self.cx, self.cy = self.x / self.n, self.y / self.n
        self.first, self.last = min(self.first, other.first), max(self.last, other.last)
        self.best = max(self.best, other.best)
        _count_up(self.hits, other.hits)
        _count_up(self.scores, other.scores)
        _count_up(self.beside, other.beside)

    def dev(self) -> int:
        n = self.n
        # Exact integers: squares of millimetres lose their last digits as floats.
        return math.isqrt(max(0, n * self.squares - self.x * self.x - self.y * self.y)) // n


class _Placed:
    """A detection in whole millimetres; `beside` are the other labels beside it."""

    __slots__ = ("beside", "label", "score", "x", "y", "z")

    def __init__(self, label: str, x: int, y: int, z: int, score: float | None) -> None:
        self.label, self.x, self.y, self.z, self.score = label, x, y, z, score
        self.beside: set[str] | None = None


class _Seen:
    """The clusters of one label on one topic, and how many of it messages had at once."""

    __slots__ = ("at_once", "clusters", "together", "unplaced")

    def __init__(self) -> None:
        self.clusters: list[_Cluster] = []
        self.together: dict[tuple[int, int], int] = {}
        self.at_once: dict[int, int] = {}
        self.unplaced: tuple[int, Ns, Ns] | None = None

    def add(self, time: Ns, look: int, detections: Sequence[_Placed | None]) -> None:
        """Adds what one message has of the label: each to the nearest spot, no two to one."""
        count = len(detections)
        self.at_once[count] = self.at_once.get(count, 0) + 1
        if count == 1:
            [only] = detections
            if only is None:
                self._skip(time)
            else:
                self._add_to(self._nearest(only), only, time, look)
            return
        placed = [each for each in detections if each is not None]
        for _ in range(count - len(placed)):
            self._skip(time)
        pairs = sorted(
            (squared, nth, which)
            for nth, each in enumerate(placed)
            for which, cluster in enumerate(self.clusters)
            if (squared := cluster.squared_to(each.x, each.y)) <= _GATE_SQUARED
        )
        taken: dict[int, int] = {}
        for _, nth, which in pairs:
            if nth not in taken and which not in taken.values():
                taken[nth] = which
        chosen = [
            self._add_to(taken.get(nth, -1), each, time, look) for nth, each in enumerate(placed)
        ]
        for pair in combinations(sorted(which for which in chosen if which >= 0), 2):
            self.together[pair] = self.together.get(pair, 0) + 1

    def _nearest(self, seen: _Placed) -> int:
        """Returns the nearest spot within the gate, or -1."""
        best, least, x, y = -1, _GATE_SQUARED, seen.x, seen.y
        for nth, each in enumerate(self.clusters):
            dx, dy = each.cx - x, each.cy - y
            squared = dx * dx + dy * dy
            if squared <= least:
                best, least = nth, squared
        return best

    def _add_to(self, which: int, seen: _Placed, time: Ns, look: int) -> int:
        """Adds a detection to a spot, to a new one for -1; returns it, -1 where it is full."""
        if which < 0:
            if len(self.clusters) >= _MAX_SPOTS:
                self._skip(time)
                return -1
            which = len(self.clusters)
            self.clusters.append(_Cluster(time))
        self.clusters[which].add(seen, time, look)
        return which

    def _skip(self, time: Ns) -> None:
        n, first, _ = self.unplaced or (0, time, time)
        self.unplaced = (n + 1, first, time)

    def most(self) -> int:
        """Returns how many of the label at least three messages had at once, or all had."""
        left = _TOGETHER_MESSAGES
        for count in sorted(self.at_once, reverse=True):
            left -= self.at_once[count]
            if left <= 0:
                return count
        return min(self.at_once, default=0)

    def merge_near(self) -> None:
        """Joins spots that lie together and that messages do not have both of."""
        clusters, limit = self.clusters, (_SAME_M * 1000) ** 2
        gone: set[int] = set()
        for one, other in combinations(range(len(clusters)), 2):
            if one in gone or other in gone:
                continue
            a, b = clusters[one], clusters[other]
            both = self.together.get((one, other), 0)
            if both <= _TOGETHER_SHARE * min(a.n, b.n) and (a.squared_to(b.cx, b.cy) < limit):
                a.absorb(b)
                gone.add(other)
        self.clusters = [each for nth, each in enumerate(clusters) if nth not in gone]


class SightsBuilder:
    """Builds the sights of one bag from its messages, in log-time order on each topic."""

    def __init__(self) -> None:
        self._topics: dict[str, int] = {}
        self._labels: dict[str, int] = {}
        self._seen: dict[tuple[int, int], _Seen] = {}
        self._looks: dict[tuple[int, int, int, int], list[int]] = {}
        self._look_numbers: dict[tuple[int, int, int, int], int] = {}
        self._fixes: list[tuple[int, ...]] = []

    def add_fix(self, time: Ns, pose: tuple[float, float, float], sigma_m: float | None) -> None:
        """Adds where odometry was in the map (m, rad), and the localiser's standard deviation."""
        x, y, yaw = pose
        sigma = -1 if sigma_m is None else round(min(sigma_m, _MAX_AWAY_M) * 1000)
        place = (round(x * 1000), round(y * 1000), round(math.degrees(yaw) * 10))
        self._fixes.append((0, _rounded(time), *place, sigma))

    def add(
        self,
        topic: str,
        time: Ns,
        robot: tuple[float, float, float] | None,
        things: Sequence[PlacedDetection],
    ) -> None:
        """Adds a message; `robot` is the robot's x, y (m) and yaw (rad), if that is known."""
        number = self._topics.setdefault(topic, len(self._topics))
        look = -1 if robot is None else self._look(number, time, robot)
        if not things:
            return
        by_label: dict[str, list[_Placed | None]] = {}
        placed: list[_Placed] = []
        for label, place, score in things:
            name = label[:_MAX_LABEL_CHARS]
            found = None
            if place is not None and _is_near(place):
                x, y, z = place
                found = _Placed(name, round(x * 1000), round(y * 1000), round(z * 1000), score)
                placed.append(found)
            by_label.setdefault(name, []).append(found)
        _find_beside(placed)
        for name, detections in by_label.items():
            nth = self._labels.get(name)
            if nth is None:
                if len(self._labels) == _MAX_LABELS:
                    continue
                nth = self._labels[name] = len(self._labels)
            seen = self._seen.get((number, nth))
            if seen is None:
                seen = self._seen[number, nth] = _Seen()
            seen.add(time, look, detections)

    def _look(self, topic: int, time: Ns, robot: tuple[float, float, float]) -> int:
        x, y = round(robot[0] * 1000), round(robot[1] * 1000)
        yaw = round(math.degrees(robot[2]) * 10) % 3600
        cell = (topic, x // CELL_MM, y // CELL_MM, yaw // CELL_DECIDEG)
        look = self._looks.get(cell)
        if look is None:
            self._look_numbers[cell] = len(self._looks)
            self._looks[cell] = [x, y, yaw, 1, time, time]
        else:
            look[0] += x
            look[1] += y
            look[2] += yaw
            look[3] += 1
            look[5] = time
        return self._look_numbers[cell]

    def sights(self, frame_id: str = "") -> Sights:
        """Returns the sights so far, which are in this frame; the builder is used up."""
        spots: list[tuple[int, ...]] = []
        hits: list[tuple[int, int, int]] = []
        scores: list[tuple[int, int, int]] = []
        beside: list[tuple[int, int, int]] = []
        unplaced: list[tuple[int, ...]] = []
        for (topic, label), seen in self._seen.items():
            seen.merge_near()
            most = seen.most()
            for each in seen.clusters:
                number, n = len(spots), each.n
                place = (each.x // n, each.y // n, each.z // n)
                times = (_rounded(each.first), _rounded(each.last))
                spots.append((0, topic, label, n, *place, each.dev(), *times, each.best, most))
                hits += [(number, look, count) for look, count in sorted(each.hits.items())]
                scores += [(number, score, count) for score, count in sorted(each.scores.items())]
                beside += [
                    (number, self._labels[name], count)
                    for name, count in sorted(each.beside.items())
                    if name in self._labels
                ]
            if seen.unplaced is not None:
                n, first, last = seen.unplaced
                unplaced.append((0, topic, label, n, _rounded(first), _rounded(last)))
        looks = [
            (0, cell[0], x // n, y // n, yaw // n, n, _rounded(first), _rounded(last))
            for cell, (x, y, yaw, n, first, last) in self._looks.items()
        ]
        rows = (spots, looks, hits, scores, beside, unplaced, self._fixes)
        return Sights(
            tuple(self._topics),
            tuple(self._labels),
            tuple(
                np.array(each, np.int64).reshape(-1, len(columns))
                for each, columns in zip(rows, _TABLES, strict=True)
            ),
            frame_id=frame_id,
        )


class SlicedSights:
    """Collects the sights of one bag, slice by slice.

    Args:
        span: log times of the first and the last message (ns).
    """

    def __init__(self, span: tuple[Ns, Ns]) -> None:
        self._first, last = span
        length = last - self._first
        slices = 1 if length <= _UNDIVIDED_NS else length // _SLICE_NS
        self._width = length // slices + 1
        self._slices: dict[int, SightsBuilder] = {}

    def at(self, time: Ns) -> SightsBuilder:
        """Returns what collects the messages of a log time."""
        number = (time - self._first) // self._width
        found = self._slices.get(number)
        if found is None:
            found = self._slices[number] = SightsBuilder()
        return found

    def sights(self, frame_id: str = "") -> Sights:
        """Returns the sights of all slices, which are in this frame; the builder is used up."""
        parts = [self._slices[number].sights() for number in sorted(self._slices)]
        return replace(joined(parts), frame_id=frame_id)


def _rounded(time: Ns) -> Ns:
    """Rounds up to 1 us: a message is at or before the time that is stored of it."""
    # The last microsecond is not whole: its end is no time.
    return min(-(-time // _NS_PER_US), MAX_NS // _NS_PER_US) * _NS_PER_US


def _is_near(place: Vector3) -> bool:
    x, y, z = place
    return abs(x) < _MAX_AWAY_M and abs(y) < _MAX_AWAY_M and abs(z) < _MAX_AWAY_M


def _find_beside(placed: Sequence[_Placed]) -> None:
    """Finds for each detection of a message the other labels that lie beside it."""
    if not 1 < len(placed) <= _MAX_COMPARED:
        return
    for nth, one in enumerate(placed):
        x, y, label = one.x, one.y, one.label
        for other in placed[nth + 1 :]:
            if (
                -_BESIDE_MM < other.x - x < _BESIDE_MM
                and -_BESIDE_MM < other.y - y < _BESIDE_MM
                and other.label != label
            ):
                for each, name in ((one, other.label), (other, label)):
                    if each.beside is None:
                        each.beside = {name}
                    else:
                        each.beside.add(name)


def joined(parts: Iterable[Sights]) -> Sights:
    """Returns the sights of bags one after the other, with one table of names."""
    topics: dict[str, int] = {}
    labels: dict[str, int] = {}
    tables: tuple[list[Ints], ...] = tuple([] for _ in _TABLES)
    bags = spots = looks = 0
    for part in parts:
        topic = np.array([topics.setdefault(each, len(topics)) for each in part.topics], np.int64)
        label = np.array([labels.setdefault(each, len(labels)) for each in part.labels], np.int64)
        spot, look, hit, score, beside, unplaced, fix = copies = [
            each.copy() for each in part.tables
        ]
        fix[:, 0] += bags
        for table in (spot, look, unplaced):
            table[:, 0] += bags
            table[:, 1] = topic[table[:, 1]]
        for table in (spot, unplaced):
            table[:, Spot.LABEL] = label[table[:, Spot.LABEL]]
        hit[:, Hit.LOOK] += np.where(hit[:, Hit.LOOK] < 0, 0, looks)
        hit[:, Hit.SPOT] += spots
        score[:, Score.SPOT] += spots
        beside[:, Beside.SPOT] += spots
        beside[:, Beside.LABEL] = label[beside[:, Beside.LABEL]]
        for gathered, table in zip(tables, copies, strict=True):
            gathered.append(table)
        bags, spots, looks = bags + part.bags, spots + len(spot), looks + len(look)
    whole = tuple(
        np.concatenate(each) if each else np.zeros((0, len(columns)), np.int64)
        for each, columns in zip(tables, _TABLES, strict=True)
    )
    return Sights(tuple(topics), tuple(labels), whole, bags)


def encode_sights(sights: Sights) -> bytes:
    """Encodes the sights of one bag; empty if there are none."""
    if not sights.topics and not len(sights.fixes):
        return b""
    base = min(
        (
            int(table[:, column].min())
            for table, columns in zip(sights.tables, _TIMES, strict=True)
            for column in columns
            if len(table)
        ),
        default=0,
    )
    blocks, shapes = [], []
    for table, columns in zip(sights.tables, _TIMES, strict=True):
        changed = table.copy()
        for column in columns:
            changed[:, column] = (changed[:, column] - base) // _NS_PER_US
        changed[1:] = np.diff(changed, axis=0)
        zigzag = (changed << 1) ^ (changed >> 63)
        size = int(np.min_scalar_type(int(zigzag.max(initial=0))).itemsize)
        planes = zigzag.T.astype(f"<u{size}").reshape(-1, 1).view(np.uint8).T
        blocks.append(planes.tobytes())
        shapes.append((len(table), size))
    head = json.dumps([base, sights.frame_id, sights.topics, sights.labels, shapes])
    return b"\n".join((head.encode(), b"".join(blocks)))


def decode_joined(packed: Sequence[bytes]) -> tuple[Sights, list[int], list[str]]:
    """Decodes the sights of many bags, joined as by `joined`; bags without any are left out.

    Returns with them the bag and the frame of each slice: much faster than one by one.

    Raises:
        ValueError: the bytes of some bag are invalid.
    """
    which = [nth for nth, each in enumerate(packed) if each]
    try:
        return _decoded([packed[nth] for nth in which], which)
    except (TypeError, KeyError, IndexError, OverflowError) as error:
        raise ValueError(f"not sights: {error}") from error


def _decoded(packed: Sequence[bytes], which: list[int]) -> tuple[Sights, list[int], list[str]]:
    heads = _heads(packed)
    counts, sizes = heads.shapes[:, :, 0], heads.shapes[:, :, 1]
    starts, stored = heads.starts.copy(), np.frombuffer(b"".join(packed), np.uint8)
    tables: list[Ints] = []
    for at, (columns, times) in enumerate(zip(_TABLES, _TIMES, strict=True)):
        rows = counts[:, at]
        zigzag = _values(stored, starts, rows, sizes[:, at], len(columns))
        tables.append(_summed(zigzag, rows))
        starts += rows * len(columns) * sizes[:, at]
        for column in times:
            base = np.repeat(heads.base, rows)
            tables[-1][:, column] = tables[-1][:, column] * _NS_PER_US + base
    topics, labels = _Names(heads.topics), _Names(heads.labels)
    slices = _slices_of(tables, counts)
    _renumber(tables, counts, slices, topics, labels)
    whole = Sights((*topics.numbers,), (*labels.numbers,), tuple(tables), int(slices.sum()))
    of = np.repeat(np.arange(len(packed)), slices).tolist()
    return whole, [which[nth] for nth in of], [heads.frames[nth] for nth in of]


def _slices_of(tables: Sequence[Ints], counts: Ints) -> Ints:
    """Returns how many slices each bag has."""
    last = np.zeros(len(counts), np.int64)
    for at in (0, 1, 5, 6):
        if tables[at][:, 0].any():
            of = np.repeat(np.arange(len(counts)), counts[:, at])
            np.maximum.at(last, of, tables[at][:, 0])
    return last + 1


class _Names:
    """The names of many bags, each with its own list, numbered throughout.

    Attributes:
        of: the number of each name of each bag, one bag after the other; `first` is where each
            bag's begin.
    """

    def __init__(self, by_bag: Sequence[Sequence[str]]) -> None:
        every = [*chain.from_iterable(by_bag)]
        self.numbers = {name: number for number, name in enumerate(dict.fromkeys(every))}
        self.of = np.array([*map(self.numbers.__getitem__, every)], np.int64)
        counts = np.array([*map(len, by_bag)], np.int64)
        self.first: Ints = np.cumsum(counts) - counts


def _renumber(
    tables: Sequence[Ints], counts: Ints, slices: Ints, topics: _Names, labels: _Names
) -> None:
    """Numbers slices, spots, looks, topics and labels of many bags throughout."""
    spot, look, hit, score, beside, unplaced, fix = tables

    def each(at: int, values: Ints) -> Ints:
        return np.repeat(values, counts[:, at])

    for at, table in ((0, spot), (1, look), (5, unplaced), (6, fix)):
        table[:, 0] += each(at, np.cumsum(slices) - slices)
    for at, table in ((0, spot), (1, look), (5, unplaced)):
        table[:, 1] = topics.of[table[:, 1] + each(at, topics.first)]
    for at, table in ((0, spot), (5, unplaced)):
        table[:, Spot.LABEL] = labels.of[table[:, Spot.LABEL] + each(at, labels.first)]
    beside[:, Beside.LABEL] = labels.of[beside[:, Beside.LABEL] + each(4, labels.first)]
    spots, looks = (np.cumsum(counts[:, at]) - counts[:, at] for at in (0, 1))
    hit[:, Hit.LOOK] += np.where(hit[:, Hit.LOOK] < 0, 0, each(2, looks))
    for at, table in ((2, hit), (3, score), (4, beside)):
        table[:, 0] += each(at, spots)


class _Heads(NamedTuple):
    """What precedes the tables in the bytes of the sights of bags.

    Attributes:
        base: the times of each bag count from this (ns).
        shapes: of each bag and table, the number of rows, and of bytes of a number.
        starts: where each bag's tables begin in the bytes of all bags together.
    """

    base: Ints
    frames: list[str]
    topics: list[list[str]]
    labels: list[list[str]]
    shapes: Ints
    starts: Ints


_WIDTHS: Final = np.array([len(each) for each in _TABLES], np.int64)
_SIZES: Final = (1, 2, 4, 8)
"""Of the numbers of a table, in bytes."""
_FIELDS: Final = 5
"""Base, frame, topics, labels, shapes: what precedes the tables of a bag."""


def _heads(packed: Sequence[bytes]) -> _Heads:
    """Decodes what precedes the tables of each.

    Raises:
        ValueError: something else does, or tables are missing.
    """
    ends = [each.find(b"\n") for each in packed]
    texts = [each[:end] for each, end in zip(packed, ends, strict=True)]
    # As one text: a call for each of thousands takes four times as long.
    decoded = json.loads(b"[" + b",".join(texts) + b"]")
    if len(decoded) != len(packed) or any(len(each) != _FIELDS for each in decoded):
        raise ValueError("not sights: something else precedes the tables")
    base, frames, topics, labels, shapes = (
        [each[nth] for each in decoded] for nth in range(_FIELDS)
    )
    if any(len(each) != len(_WIDTHS) for each in shapes):
        raise ValueError("not sights: tables are missing")
    of_tables = np.array(shapes, np.int64).reshape(len(packed), len(_WIDTHS), 2)
    rows, sizes = of_tables[:, :, 0], of_tables[:, :, 1]
    if (rows < 0).any() or not np.isin(sizes, _SIZES).all():
        raise ValueError("not sights: no table has such a shape")
    lengths = np.array([*map(len, packed)], np.int64)
    bodies = np.array(ends, np.int64) + 1
    if (bodies + (rows * sizes * _WIDTHS).sum(axis=1) != lengths).any():
        raise ValueError("not sights: some of them are missing")
    starts = np.cumsum(lengths) - lengths + bodies
    return _Heads(np.array(base, np.int64), frames, topics, labels, of_tables, starts)


def _values(stored: Bytes, starts: Ints, rows: Ints, sizes: Ints, columns: int) -> Ints:
    """Returns the zigzag numbers of one table of all bags, a row for each column.

    Each bag has so many rows of so many columns, all first bytes first, of numbers of its own size.
    """
    found = np.zeros((columns, int(rows.sum())), np.int64)
    begins = np.cumsum(rows) - rows
    # All bags of one size at once: there are thousands, with some rows each.
    for size in np.unique(sizes[rows > 0]).tolist():
        of = np.flatnonzero((sizes == size) & (rows > 0))
        n = rows[of]
        nth = np.arange(int(n.sum())) - np.repeat(np.cumsum(n) - n, n)
        to, step = np.repeat(begins[of], n) + nth, np.repeat(n, n)
        at = np.repeat(starts[of], n) + nth
        for column in found:
            values = stored[at].astype(np.int64)
            for plane in range(1, size):
                values |= stored[at + plane * columns * step].astype(np.int64) << 8 * plane
            column[to] = values
            at += step
    return found


def _summed(zigzag: Ints, counts: Ints) -> Ints:
    """Returns the rows of a table of several bags, whose steps start again with each."""
    # Summed where the numbers of a column lie together, which is several times as fast.
    sums = np.cumsum((zigzag >> 1) ^ -(zigzag & 1), axis=1)
    before = np.concatenate((np.zeros((len(sums), 1), np.int64), sums), axis=1)
    rows: Ints = (sums - np.repeat(before[:, np.cumsum(counts) - counts], counts, axis=1)).T
    return rows


def decode_sights(packed: bytes) -> Sights:
    """Decodes the sights of one bag.

    Raises:
        ValueError: the bytes are invalid.
    """
    if not packed:
        return no_sights()
    found, _, frames = decode_joined([packed])
    return replace(found, frame_id=frames[0])
