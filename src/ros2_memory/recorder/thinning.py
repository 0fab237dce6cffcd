"""Chooses the messages of a topic that stay when its bags are deleted. Pure.

A message that stays is as it was recorded. A message goes if another one says the same:

- Poses: one a second stays while the frame or robot moves (`STEP_NS`), one in two seconds while it
  stands. So standstills are found, and poses that are farther apart mean that none was recorded.
- Booleans, statuses and names: every message that changes the value stays, and the one before it.
  An integer or a JSON text is a status in five minutes in which it has few values, or does not
  change often.
- Detections of a second, and transforms of a slot: as few messages stay as show all labels and
  frames, each label with its highest score (`_STEPS`), and the most of a label at once.
- Other numbers: one message a slot stays, and the least and the greatest value of five minutes.

No topic is silent for longer than a slot and its own period: a longer silence was a silence.

Bags also show silences, pauses, steps of the clock and crashes. The messages that stay are too few
to show them, so `memory/thinned.json` states them.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field, fields, is_dataclass, replace
from math import ceil, isnan, log2, nan
from operator import itemgetter
from typing import TYPE_CHECKING, Final, NamedTuple, TypeGuard

import numpy as np

from ros2_memory.analysis.clock_steps import SHORTEST_STEP_NS, STAMPS_BESIDE_NS
from ros2_memory.analysis.intervals import THINNED_NS
from ros2_memory.analysis.silences import Silence
from ros2_memory.bag_dir.layout import utc_day
from ros2_memory.bag_dir.state_files import Thinned
from ros2_memory.columns.pack import Step, step_of
from ros2_memory.columns.plan import fields_at, is_time
from ros2_memory.columns.table import Column, Elements, Numbers, Table, Texts
from ros2_memory.core.arrays import numbered, run_starts
from ros2_memory.core.model import BagState
from ros2_memory.core.spans import lies_inside, united
from ros2_memory.core.text import NAMES_IN_MESSAGES, looks_like_json
from ros2_memory.core.timebase import NS_PER_S, Ns, Span
from ros2_memory.index.clock_faults import FaultyClock
from ros2_memory.messages.detections import detections_of
from ros2_memory.storage.base import Definition

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from ros2_memory.columns.detections import DetectionColumns
    from ros2_memory.core.model import BagFile
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.storage.base import Field, IntArray

    Name = tuple[str, int]  # a label or frame, and its number in the message
    Points = NDArray[np.float64]

_RELATIVE_BITS: Final = 20
"""2 to the minus 20 is a millionth."""
_MAX_FLOAT32: Final = float(np.finfo(np.float32).max)


def rounded(message: object, definition: Definition | None, path: str = "") -> object:
    """Returns a decoded message with rounded numbers; integers, texts and times stay exact.

    Args:
        message: the message, or the value at `path` in one.
        definition: the definition of the whole message.
        path: the path of the value, such as `pose.pose.position`.
    """
    if isinstance(message, float):
        return float(_rounded(np.array(message), step_of(path, definition)))
    if isinstance(message, np.ndarray) and message.dtype.kind == "f":
        return _rounded(message, step_of(path, definition)).astype(message.dtype)
    if isinstance(message, list):
        return [rounded(member, definition, path) for member in message]
    if not is_dataclass(message) or isinstance(message, type):
        return message
    values = {
        name: rounded(value, definition, f"{path}.{name}".lstrip("."))
        for name, value in fields_in(message)
    }
    return replace(message, **values)


def fields_in(node: object) -> Iterator[tuple[str, object]]:
    """Yields the name and value of each field of a decoded message; none of any other object."""
    if is_dataclass(node) and not isinstance(node, type):
        for member in fields(node):
            yield member.name, getattr(node, member.name)


def _rounded(numbers: Points, step: Step) -> Points:
    """Returns multiples of a power of two, which is no coarser than the step: they compress.

    A number stays as it is where its multiple is too large for its type: FLT_MAX says "no limit".
    """
    with np.errstate(invalid="ignore", over="ignore"):
        if step.per_unit:
            units = 2.0 ** ceil(log2(step.per_unit))
            near = np.rint(numbers * units) / units
        elif step.relative:
            parts, exponents = np.frexp(numbers)
            near = np.ldexp(np.rint(parts * 2.0**_RELATIVE_BITS), exponents - _RELATIVE_BITS)
        else:
            return numbers
    # A single number of a float32 field comes as a float64.
    is_too_large = np.isinf(near) | ((abs(numbers) <= _MAX_FLOAT32) & (abs(near) > _MAX_FLOAT32))
    return np.where(is_too_large, numbers, near)


STEP_NS: Final[Ns] = NS_PER_S
"""One pose stays in so long."""
STANDING_NS: Final[Ns] = 2 * NS_PER_S
"""One pose stays in so long while it does not change."""
PAUSE_NS: Final[Ns] = 3 * NS_PER_S
"""With a slot of 7 s, at most the 10 s of a silence lie between two messages that stay."""
MINUTE_NS: Final[Ns] = 60 * NS_PER_S
EXTREMES_NS: Final[Ns] = 300 * NS_PER_S
_MOVED: Final = 0.05
"""In metres; also of each component of a unit quaternion, which is then a turn by 6 degrees."""
_FEW: Final = 8
_OFTEN: Final = 7
"""Integers of more than `_FEW` values that change more often in a slot are measurements, and JSON
texts have a stamp or measurements in them."""
_STEPS: Final = 20
"""Steps of a unit of scores: a score of 0.52 may stand for one of 0.54."""
_HIGHEST: Final = 1e6
_SINGLE: Final = 1e-6
"""By so much a number of 32 bits may be too small."""


class Scored(NamedTuple):
    """A score, and the step of scores that it lies in."""

    step: float
    score: float


_UNSCORED: Final = Scored(0.0, 0.0)
_LONG: Final = 64
"""Messages with longer arrays are samples: scans, maps, sound, features of faces."""
_DEGREE_M: Final = 111_320.0
"""Metres in a degree of latitude."""
_FRAME: Final = "child_frame_id"
_TURNS: Final = {"position": "orientation", "translation": "rotation"}
_MORE_NAMES: Final = frozenset({"location", "serial_number"})


def has_speech(table: Table) -> bool:
    """Whether messages have a text that is not a name: speech, descriptions, logs."""
    return any(
        isinstance(column, Texts) and name not in NAMES_IN_MESSAGES | _MORE_NAMES
        for name, column in _named_columns(table.columns, table.elements)
    )


def has_numbers(table: Table) -> bool:
    """Whether messages are measurements: floating-point numbers that are not a pose."""
    measured = any(_is_measured(column) for column in table.columns.values())
    lists = any(inner.columns.keys() != {""} for inner in table.elements.values())
    return measured and not lists and not _poses(table.columns)


def _is_measured(column: Column) -> TypeGuard[Numbers]:
    return not isinstance(column, Texts) and column.dtype.kind == "f"


def _named_columns(
    columns: Mapping[str, Column], elements: Mapping[str, Elements]
) -> Iterator[tuple[str, Column]]:
    """Yields each column with its field's name, or its list's if elements have no fields."""
    for path, column in columns.items():
        yield path.rpartition(".")[2], column
    for path, inner in elements.items():
        for name, column in _named_columns(inner.columns, inner.elements):
            yield name or path.rpartition(".")[2], column


@dataclass(slots=True)
class _Mover:
    """A frame or a robot.

    Attributes:
        slot: the second of the newest pose, in units of `STEP_NS`.
        pose: the newest pose that stays for its place.
        seen: the log time of the newest pose that was compared; 0 before the first.
        stayed: the log time of the newest pose that stays.
    """

    slot: int = -1
    pose: Points = field(default_factory=lambda: np.full(0, np.nan))
    seen: Ns = 0
    stayed: Ns = 0

    def staying_times(self, times: IntArray, poses: Points) -> Iterator[Ns]:
        """Yields the log times of the poses that stay: when it moved, and the pose before.

        Args:
            times: log times, ascending.
            poses: a row for each time, of metres and components of a unit quaternion.
        """
        slots = times // STEP_NS
        for row in np.flatnonzero(np.diff(slots, prepend=self.slot)).tolist():
            pose, time = poses[row], int(times[row])
            if self.pose.size != pose.size or not (abs(pose - self.pose) < _MOVED).all():
                if self.seen:
                    yield self.seen
                yield time
                self.pose, self.stayed = pose, time
            elif time - self.stayed >= STANDING_NS:
                yield time
                self.stayed = time
            self.seen = time
        self.slot = int(slots[-1])


class _Extremes(NamedTuple):
    """The least and the greatest value of a column in a slot, each with its log time."""

    least: tuple[float, Ns]
    greatest: tuple[float, Ns]


class _Changes(NamedTuple):
    """The changes of an integer or a JSON text in a slot: the log times before and after each.

    `values` are its values, at most one more than `_FEW`.
    """

    values: set[object]
    before: IntArray
    after: IntArray


@dataclass(slots=True)
class TopicThinning:
    """Chooses the messages of a topic that stay. Add its tables in order of time.

    Args:
        detections: finds the detections in a table.
        numbers_ns: the slot in which one message of measurements stays.
    """

    detections: DetectionColumns
    numbers_ns: Ns = THINNED_NS
    _last: Ns | None = None
    _staying: list[IntArray] = field(default_factory=list)
    _slot: int = -1
    _seen: dict[Name, Scored] = field(default_factory=dict)
    _values: dict[str, tuple[object, Ns]] = field(default_factory=dict)
    _movers: dict[tuple[str, str], _Mover] = field(default_factory=dict)
    _extremes: dict[tuple[str, int], _Extremes] = field(default_factory=dict)
    _changes: defaultdict[tuple[str, int], list[_Changes]] = field(
        default_factory=lambda: defaultdict(list)
    )

    def add(self, table: Table) -> None:
        """Adds the messages of a bag, at least one."""
        times = table.log_times
        for path, column in table.columns.items():
            if isinstance(column, Texts):
                self._add_texts(path, column, times)
            elif _is_measured(column):
                self._add_extremes(path, column, times)
            elif not _is_time(table, path):
                self._add_changes(path, column, column.tolist(), times)
                self._add_extremes(path, column, times)
        self._add_poses("", times, _poses(table.columns))
        labels = self._labels(table)
        shown = [{**names} for names in labels]  # labels, and below the frames
        for path, inner in table.elements.items():
            self._add_frames(inner, times, shown)
            self._add_states(path, inner, times)
        slot_ns = self.numbers_ns if has_numbers(table) else THINNED_NS
        if slot_ns == THINNED_NS:
            self._add_pauses(times)
        self._add_slots(times, shown, STEP_NS if any(labels) else slot_ns)

    def _add_slots(
        self, times: IntArray, names: Sequence[Mapping[Name, Scored]], slot_ns: Ns
    ) -> None:
        """Adds at least one message of each slot, and as many as show all labels and frames."""
        slots = times // slot_ns
        starts = run_starts(slots).tolist()
        for start, stop in zip(starts, [*starts[1:], times.size], strict=True):
            is_new = slots[start] != self._slot
            if is_new:
                self._slot = int(slots[start])
                self._seen.clear()
            missing = _missing(names[start:stop], self._seen)
            self._seen |= missing
            rows = _covering_rows(names[start:stop], missing) if missing else []
            if is_new and not rows:
                rows = [0]
            self._staying.append(times[start:stop][np.array(rows, np.int64)])

    def _add_pauses(self, times: IntArray) -> None:
        """Adds the messages before and after each time without one."""
        before = times[:1] if self._last is None else [self._last]
        around = np.concatenate([before, times]).astype(np.int64)
        after = np.flatnonzero(np.diff(around) > PAUSE_NS)
        self._staying += [around[after], around[after + 1]]
        self._last = int(times[-1])

    def _labels(self, table: Table) -> list[dict[Name, Scored]]:
        """Returns the scores of the labels in each message; JSON texts have labels, too.

        The key is a label and a number: a message with two cups has `cup` 0 and 1.
        """
        labels: list[tuple[int, str, float]] = []
        in_table = self.detections.of(table)
        if in_table is not None:
            detections = in_table.detections
            rows, scores = detections.rows.tolist(), detections.scores.tolist()
            labels += zip(rows, detections.labels.values(), scores, strict=True)
        labels += _json_labels(table)
        names: list[dict[Name, Scored]] = [{} for _ in range(len(table))]
        counts = Counter[tuple[int, str]]()
        for row, label, score in labels:
            scored = _stepped(score)
            names[row][label, 0] = max(scored, names[row].get((label, 0), scored))
            number = counts[row, label]
            if number:
                names[row][label, number] = _UNSCORED
            counts[row, label] += 1
        return names

    def times(self) -> IntArray:
        """Returns the log times (ns) of the messages that stay, ascending."""
        extremes = [time for slot in self._extremes.values() for _, time in slot]
        staying = [*self._staying, np.array(extremes, np.int64)]
        most = EXTREMES_NS // self.numbers_ns * _OFTEN
        for changes in self._changes.values():
            values = set[object]().union(*[change.values for change in changes])
            count = sum(change.after.size for change in changes)
            if len(values) <= _FEW or count <= most:
                staying += [change.before for change in changes]
                staying += [change.after for change in changes]
        return np.unique(np.concatenate(staying))

    def _changed(
        self, path: str, codes: Numbers, values: Sequence[object], times: IntArray
    ) -> tuple[IntArray, IntArray]:
        """Returns the log times before and after each change of a value.

        `codes` differ where `values` do.
        """
        last_value, last_time = self._values.get(path, (values[0], int(times[0])))
        self._values[path] = values[-1], int(times[-1])
        rows = np.flatnonzero(codes[1:] != codes[:-1])
        before, after = times[rows], times[rows + 1]
        if last_value != values[0]:
            return np.append(before, last_time), np.append(after, times[0])
        return before, after

    def _add_texts(self, path: str, column: Texts, times: IntArray) -> None:
        values = column.values()
        if looks_like_json(column.words[0]):  # with a stamp it differs in each message
            self._add_changes(path, column.codes, values, times)
        else:
            self._staying += self._changed(path, column.codes, values, times)

    def _add_changes(
        self, path: str, codes: Numbers, values: Sequence[object], times: IntArray
    ) -> None:
        """Adds the changes of a value, which stay where it is a status."""
        before, after = self._changed(path, codes, values, times)
        slots, slots_after = times // EXTREMES_NS, after // EXTREMES_NS
        for slot in np.unique(slots).tolist():
            inside = slots_after == slot
            rows = np.flatnonzero(slots == slot)
            _, firsts = np.unique(codes[rows], return_index=True)
            few = {values[row] for row in rows[firsts[: _FEW + 1]].tolist()}
            self._changes[path, slot].append(_Changes(few, before[inside], after[inside]))

    def _add_extremes(self, path: str, numbers: Numbers, times: IntArray) -> None:
        slots, is_finite = times // EXTREMES_NS, np.isfinite(numbers)
        for slot in np.unique(slots).tolist():
            rows = np.flatnonzero((slots == slot) & is_finite)
            samples = [
                *self._extremes.get((path, slot), ()),
                *zip(numbers[rows].tolist(), times[rows].tolist(), strict=True),
            ]
            if samples:
                # The earliest of equal values.
                greatest = max(samples, key=itemgetter(0))
                self._extremes[path, slot] = _Extremes(min(samples), greatest)

    def _add_poses(self, name: str, times: IntArray, poses: Mapping[str, Points]) -> None:
        for path, points in poses.items():
            mover = self._movers.setdefault((path, name), _Mover())
            self._staying.append(np.array([*mover.staying_times(times, points)], np.int64))

    def _add_states(self, path: str, inner: Elements, times: IntArray) -> None:
        """Adds the messages in which the states of a list change, such as the states of goals."""
        states = [
            column.tolist()
            for column in inner.columns.values()
            if not isinstance(column, Texts)
            if column.dtype.itemsize == 1 and np.unique(column).size <= _FEW
        ]
        if not states:
            return
        of_messages: list[list[object]] = [[] for _ in range(times.size)]
        for owner, *values in zip(inner.owners.tolist(), *states, strict=True):
            of_messages[owner] += values
        by_message = [*map(tuple, of_messages)]
        _, codes = numbered(by_message)
        self._staying += self._changed(path, codes, by_message, times)

    def _add_frames(
        self, inner: Elements, times: IntArray, names: Sequence[dict[Name, Scored]]
    ) -> None:
        """Adds the poses of the frames of transforms, and to `names` the frames in each message."""
        column = inner.columns.get(_FRAME)
        if not isinstance(column, Texts):
            return
        for row, frame in zip(inner.owners.tolist(), column.values(), strict=True):
            names[row][frame, 0] = _UNSCORED
        poses = _poses(inner.columns)
        for code, frame in enumerate(column.words):
            rows = np.flatnonzero(column.codes == code)
            of_frame = {path: points[rows] for path, points in poses.items()}
            self._add_poses(frame, times[inner.owners[rows]], of_frame)


def _json_labels(table: Table) -> Iterator[tuple[int, str, float]]:
    """Yields the labels in JSON texts: the row of the message, the label, and the score or NaN."""
    for column in table.columns.values():
        if isinstance(column, Texts) and looks_like_json(column.words[0]):
            for row, text in enumerate(column.values()):
                for detection in detections_of(text):
                    yield row, detection.label, nan if detection.score is None else detection.score


def has_samples(table: Table) -> bool:
    """Whether messages have a long array of numbers, other than a covariance."""
    return any(
        not isinstance(column, Texts) and column.size and column.max() > _LONG
        for path, column in table.columns.items()
        if "covariance" not in path and _is_of_lengths(table, path)
    )


def _is_of_lengths(table: Table, path: str) -> bool:
    """Whether a column has the lengths of arrays, and not a field of that name."""
    array = path.removesuffix(".length")
    if array == path:
        return False
    around = _field_at(table, array)
    return around is None or around.length is not None


def _stepped(score: float) -> Scored:
    """Returns a score with its step; a missing score (NaN) is the lowest."""
    score = -_HIGHEST if isnan(score) else max(-_HIGHEST, min(score, _HIGHEST))
    return Scored((score + _SINGLE) * _STEPS // 1, score)


def _missing(
    messages: Sequence[Mapping[Name, Scored]], seen: Mapping[Name, Scored]
) -> dict[Name, Scored]:
    """Returns the names that messages add to `seen`, or have with a higher step of the score."""
    missing: dict[Name, Scored] = {}
    for names in messages:
        for name, score in names.items():
            if name not in seen or seen[name].step < score.step:
                missing[name] = max(score, missing.get(name, score))
    return missing


def _covering_rows(
    messages: Sequence[Mapping[Name, Scored]], missing: Mapping[Name, Scored]
) -> list[int]:
    """Returns few rows of messages that have all missing names, each with its highest step.

    Greedy: it takes the message with the most names, of several the one with the highest scores.
    """
    uncovered: list[dict[Name, float]] = []
    for names in messages:
        uncovered.append({})
        for name, (step, score) in names.items():
            if name in missing and missing[name].step == step:
                uncovered[-1][name] = score
    rows: list[int] = []
    while any(uncovered):
        sizes = [(len(scores), sum(scores.values())) for scores in uncovered]
        row = sizes.index(max(sizes))
        rows.append(row)
        for name in [*uncovered[row]]:
            for scores in uncovered:
                scores.pop(name, None)
    return rows


def _is_time(table: Table, path: str) -> bool:
    found = _field_at(table, path)
    return found is not None and isinstance(found.kind, Definition) and is_time(found.kind)


def _field_at(table: Table, path: str) -> Field | None:
    names = path.split(".")
    along = fields_at(table.definition, names)
    return along[-1] if len(along) == len(names) else None


def _poses(columns: Mapping[str, Column]) -> dict[str, Points]:
    """Returns the poses in columns, by the path of their point: metres, then the quaternion."""
    poses: dict[str, Points] = {}
    for path in columns:
        point = path.removesuffix(".x")
        parent, _, name = point.rpartition(".")
        if point != path and name in _TURNS:
            turn = f"{parent}.{_TURNS[name]}".lstrip(".")
            names = [f"{point}.{axis}" for axis in "xyz"] + [f"{turn}.{axis}" for axis in "xyzw"]
            poses |= _stacked(point, [columns[name] for name in names if name in columns])
    if {"x", "y", "theta"} <= columns.keys():  # geometry_msgs/msg/Pose2D, turtlesim/msg/Pose
        poses |= _stacked("", [columns[name] for name in ("x", "y", "theta")])
    if {"latitude", "longitude"} <= columns.keys():
        degrees = _stacked("latitude", [columns["latitude"], columns["longitude"]])
        poses |= {path: points * _DEGREE_M for path, points in degrees.items()}
    return poses


def _stacked(path: str, columns: Sequence[Column]) -> dict[str, Points]:
    """Returns columns of numbers as the rows at a path; nothing if a column is of texts."""
    numbers = [column for column in columns if not isinstance(column, Texts)]
    if len(numbers) < len(columns):
        return {}
    return {path: np.stack([np.asarray(column, np.float64) for column in numbers], axis=1)}


_MOST_PAUSES: Final = 32
"""So many pauses of a day are remembered; the messages beside each stay."""


def with_shown_by(known: Thinned, snapshot: Snapshot, bags: Sequence[BagFile]) -> Thinned:
    """Returns `known` with the silences, pauses, clock steps and crashes that bags show.

    Args:
        known: the content of `thinned.json`.
        snapshot: the index of all bags.
        bags: the bags of the snapshot that are about to be deleted, at least one.
    """
    times = united((bag.start, bag.end + 1) for bag in bags)
    silences = [snapshot.prolonged(Silence._make(silence)) for silence in known.silences]
    silences += [silence for silence in snapshot.silences if lies_inside(times, silence.start)]
    by_start = {(silence.topic, silence.start): (*silence,) for silence in silences}
    steps = [
        (fault.at, fault.by)
        for fault in snapshot.dating.faults
        if fault.kind is FaultyClock.SET_BACK
        if fault.by >= SHORTEST_STEP_NS and lies_inside(times, fault.at)
    ]
    pauses = [pause.span for pause in snapshot.suspects if lies_inside(times, pause.start)]
    left_open = [bag.end for bag in bags if bag.state is BagState.INCOMPLETE]
    since = bags[0].start if known.since is None else known.since
    if since > snapshot.scanned_at:  # by a clock that was ahead
        since = min(since, bags[0].start)
    return Thinned(
        since,
        tuple(sorted(by_start.values(), key=itemgetter(1))),
        tuple(_first_of_each_day([*known.pauses, *pauses])),
        tuple(sorted({*known.set_back, *steps})),
        tuple(sorted({*known.left_open, *left_open})),
    )


def _first_of_each_day(pauses: Iterable[Span]) -> Iterator[Span]:
    """Yields the first `_MOST_PAUSES` pauses of each day, in order of time and each once."""
    counts = Counter[str]()
    for start, end in sorted({*pauses}):
        day = utc_day(start)
        counts[day] += 1
        if counts[day] <= _MOST_PAUSES:
            yield start, end


def times_near(pauses: Iterable[Span], times: IntArray) -> IntArray:
    """Returns the log times (ns) that lie so near a pause that they may show a step of a clock."""
    near = np.zeros(times.size, bool)
    for start, end in pauses:
        near |= (times >= start - STAMPS_BESIDE_NS) & (times <= end + STAMPS_BESIDE_NS)
    return times[near]
