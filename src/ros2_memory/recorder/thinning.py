"""Which messages of a topic stay when its bags are deleted, by their columns, and what else. Pure.

A message that stays is as it was recorded. Those go that say again what others say:

- What moves has a pose a second (`STEP_NS`), and one in two while it stands: standstills are found,
  and where poses are farther apart none was recorded.
- Of a boolean, a status or a name every message stays that changes it, and the last one before. An
  integer is a status in five minutes in which it has few values, or does not change often.
- Of the detections of a second, and of the transforms of a slot, as few messages stay as show all
  labels and frames, each label with its highest score (`_STEPS`), and the most of one at once.
- Of numbers one of each slot stays, and their least and greatest of five minutes.

No topic is silent for longer than a slot and its own period: what counts as a silence, was one.

Bags also show silences, pauses, steps of the clock and crashes. Those messages are too few to show
them: `memory/thinned.json` states them.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field, fields, is_dataclass, replace
from math import ceil, isnan, log2, nan
from operator import itemgetter
from typing import TYPE_CHECKING, Final, TypeGuard

import numpy as np

from ros2_memory.analysis.clock_steps import SHORTEST_STEP_NS, STAMPS_BESIDE_NS
from ros2_memory.analysis.intervals import THINNED_NS
from ros2_memory.analysis.silences import Silence
from ros2_memory.bag_dir.layout import utc_day
from ros2_memory.bag_dir.state_files import Thinned
from ros2_memory.columns.plan import fields_at, is_time
from ros2_memory.columns.steps import Step, step_of
from ros2_memory.columns.table import Column, Elements, Numbers, Table, Texts
from ros2_memory.core.arrays import numbered
from ros2_memory.core.model import BagState
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
    from ros2_memory.storage.base import IntArray

    Name = tuple[str, int]
    Scored = tuple[float, float]  # the step of a score, and the score
    _Value = tuple[float, Ns]  # and its log time
    Points = NDArray[np.float64]

_RELATIVE_BITS: Final = 20
"""2 to the minus 20 is a millionth."""


def rounded(message: object, definition: Definition | None, path: str = "") -> object:
    """Returns a decoded message with rounded numbers; integers, texts and times are as they were.

    Args:
        message: the message, or what is at `path` in one.
        definition: of the whole message.
        path: as `pose.pose.position`.
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
    """Yields the fields of a decoded message, by name; none of an object that is no message."""
    if is_dataclass(node) and not isinstance(node, type):
        for member in fields(node):
            yield member.name, getattr(node, member.name)


def _rounded(numbers: Points, step: Step) -> Points:
    with np.errstate(invalid="ignore", over="ignore"):
        if step.per_unit:
            units = 2.0 ** ceil(log2(step.per_unit))
            return np.rint(numbers * units) / units
        if step.relative:
            parts, exponents = np.frexp(numbers)
            whole = np.rint(parts * 2.0**_RELATIVE_BITS)
            return np.asarray(np.ldexp(whole, exponents - _RELATIVE_BITS))
    return numbers


STEP_NS: Final[Ns] = NS_PER_S
STANDING_NS: Final[Ns] = 2 * NS_PER_S
PAUSE_NS: Final[Ns] = 3 * NS_PER_S
"""With a slot of 7 s no more than the 10 s of a silence lie between two messages that stay."""
MINUTE_NS: Final[Ns] = 60 * NS_PER_S
EXTREMES_NS: Final[Ns] = 300 * NS_PER_S
_MOVED: Final = 0.05
"""In metres; also of each component of a unit quaternion, which is then a turn by 6 degrees."""
_FEW: Final = 8
_OFTEN: Final = 7
"""Integers of more than `_FEW` values that change more often in a slot are measurements."""
_STEPS: Final = 20
"""Of a unit of scores: one of 0.52 may stay for one of 0.54. Above 0.5 both are found."""
_HIGHEST: Final = 1e6
_SINGLE: Final = 1e-6
"""What a number of 32 bits may be less than what was meant."""
_UNSCORED: Final = (0.0, 0.0)
_LONG: Final = 64
"""Messages with longer arrays are samples: scans, maps, sound, features of faces."""
_DEGREE_M: Final = 111_320.0
"""Metres of a degree of latitude."""
_FRAME: Final = "child_frame_id"
_TURNS: Final = {"position": "orientation", "translation": "rotation"}
_MORE_NAMES: Final = frozenset({"location", "serial_number"})


def is_said(table: Table) -> bool:
    """Returns whether messages say something in words: they have a text that names nothing."""
    return any(
        isinstance(column, Texts) and name not in NAMES_IN_MESSAGES | _MORE_NAMES
        for name, column in _columns(table.columns, table.elements)
    )


def has_numbers(table: Table) -> bool:
    """Returns whether messages are measurements: numbers with a fraction that are no pose."""
    measured = any(_is_measured(column) for column in table.columns.values())
    lists = any(inner.columns.keys() != {""} for inner in table.elements.values())
    return measured and not lists and not _poses(table.columns)


def _is_measured(column: Column) -> TypeGuard[Numbers]:
    return not isinstance(column, Texts) and column.dtype.kind == "f"


def _columns(
    columns: Mapping[str, Column], elements: Mapping[str, Elements]
) -> Iterator[tuple[str, Column]]:
    """Yields each column with the name of its field; an element without fields has its list's."""
    for path, column in columns.items():
        yield path.rpartition(".")[2], column
    for path, inner in elements.items():
        for name, column in _columns(inner.columns, inner.elements):
            yield name or path.rpartition(".")[2], column


@dataclass(slots=True)
class _Mover:
    """A frame or a robot, by the last pose of it that stays, and the last that was looked at.

    `kept` is the log time of the newest message that stays for it.
    """

    slot: int = -1
    stays: Points = field(default_factory=lambda: np.full(0, np.nan))
    before: Ns = 0
    kept: Ns = 0

    def moved(self, times: IntArray, poses: Points) -> Iterator[Ns]:
        """Yields the log times of the poses that stay, since it moved; also of those before it did.

        Args:
            times: log times, ascending.
            poses: a row for each, of metres and components of a unit quaternion.
        """
        steps = times // STEP_NS
        for nth in np.flatnonzero(np.diff(steps, prepend=self.slot)).tolist():
            pose, time = poses[nth], int(times[nth])
            if self.stays.size != pose.size or not (abs(pose - self.stays) < _MOVED).all():
                if self.before:
                    yield self.before
                yield time
                self.stays, self.kept = pose, time
            elif time - self.kept >= STANDING_NS:
                yield time
                self.kept = time
            self.before = time
        self.slot = int(steps[-1])


@dataclass(slots=True)
class TopicThinning:
    """Chooses the messages of a topic that stay; its tables are added in order of time.

    `detections` finds what was seen in a table. Of measurements one message stays in
    `numbers_ns`.
    """

    detections: DetectionColumns
    numbers_ns: Ns = THINNED_NS
    _last: Ns | None = None
    _stays: list[IntArray] = field(default_factory=list)
    _slot: int = -1
    _named: dict[Name, Scored] = field(default_factory=dict)
    _values: dict[str, tuple[object, Ns]] = field(default_factory=dict)
    _movers: dict[tuple[str, str], _Mover] = field(default_factory=dict)
    _extremes: dict[tuple[str, int], tuple[_Value, _Value]] = field(default_factory=dict)
    """The least and the greatest value of a column in some minutes."""
    _changes: defaultdict[tuple[str, int], list[tuple[Numbers, IntArray, IntArray]]] = field(
        default_factory=lambda: defaultdict(list)
    )
    """Of integers, likewise: their values, up to one more than are few, and the log times before
    each change, and of each."""

    def add(self, table: Table) -> None:
        """Adds the messages of a bag, at least one."""
        times, named = table.log_times, self._labels(table)
        has_labels = any(named)
        for path, column in table.columns.items():
            if isinstance(column, Texts):
                # A text with detections differs in each message, and is none that holds.
                if not has_labels:
                    self._stays += self._changed(path, column.codes, column.values(), times)
            elif _is_measured(column) or not _is_time(table, path):
                if not _is_measured(column):
                    self._add_integers(path, column, times)
                self._add_extremes(path, column, times)
        self._add_moves("", times, _poses(table.columns))
        for path, inner in table.elements.items():
            self._add_frames(inner, times, named)
            self._add_states(path, inner, times)
        slot_ns = self.numbers_ns if has_numbers(table) else THINNED_NS
        if slot_ns == THINNED_NS:
            self._add_pauses(times)
        slot_ns = STEP_NS if has_labels else slot_ns
        slots = times // slot_ns
        starts = np.flatnonzero(np.diff(slots, prepend=-1)).tolist()
        for start, stop in zip(starts, [*starts[1:], times.size], strict=True):
            self._add_slot(int(slots[start]), times[start:stop], named[start:stop])

    def _add_slot(self, slot: int, times: IntArray, named: Sequence[Mapping[Name, Scored]]) -> None:
        """Adds few messages of a slot that show all labels and frames in it; at least one."""
        is_new = slot != self._slot
        if is_new:
            self._slot = slot
            self._named.clear()
        rows = _covering(named, self._named) or ([0] if is_new else [])
        self._stays.append(times[np.array(rows, np.int64)])

    def _add_pauses(self, times: IntArray) -> None:
        """Adds the messages before and after each time without one."""
        before = times[:1] if self._last is None else [self._last]
        around = np.concatenate([before, times]).astype(np.int64)
        after = np.flatnonzero(np.diff(around) > PAUSE_NS)
        self._stays += [around[after], around[after + 1]]
        self._last = int(times[-1])

    def _labels(self, table: Table) -> list[dict[Name, Scored]]:
        """Returns the labels of the detections in each message, also in JSON, with their number."""
        in_table = self.detections.of(table)
        labels: list[tuple[int, str, float]] = []
        if in_table is not None:
            detections = in_table.detections
            rows, scores = detections.rows.tolist(), detections.scores.tolist()
            labels += zip(rows, detections.labels.values(), scores, strict=True)
        for column in table.columns.values():
            if isinstance(column, Texts) and looks_like_json(column.words[0]):
                for row, text in enumerate(column.values()):
                    labels += [
                        (row, detection.label, nan if detection.score is None else detection.score)
                        for detection in detections_of(text)
                    ]
        named: list[dict[Name, Scored]] = [{} for _ in range(len(table))]
        counts = Counter[tuple[int, str]]()
        for row, label, score in labels:
            scored = _stepped(score)
            named[row][label, 0] = max(scored, named[row].get((label, 0), scored))
            if repeat := counts[row, label]:
                named[row][label, repeat] = _UNSCORED
            counts[row, label] += 1
        return named

    def times(self) -> IntArray:
        """Returns the log times (ns) of the messages that stay, ascending."""
        extremes = [extreme[1] for both in self._extremes.values() for extreme in both]
        stays, most = [*self._stays, np.array(extremes, np.int64)], EXTREMES_NS // self.numbers_ns
        for parts in self._changes.values():
            values, before, after = map(np.concatenate, zip(*parts, strict=True))
            if np.unique(values).size <= _FEW or after.size <= most * _OFTEN:
                stays += [before, after]
        return np.unique(np.concatenate(stays))

    def _changed(
        self, path: str, codes: Numbers, values: Sequence[object], times: IntArray
    ) -> tuple[IntArray, IntArray]:
        """Returns the log times before each change of a value, and of each change.

        `codes` differ where `values` do.
        """
        last, at = self._values.get(path, (values[0], int(times[0])))
        self._values[path] = values[-1], int(times[-1])
        later = np.flatnonzero(codes[1:] != codes[:-1])
        before, after = times[later], times[later + 1]
        if last != values[0]:
            return np.append(before, at), np.append(after, times[0])
        return before, after

    def _add_integers(self, path: str, column: Numbers, times: IntArray) -> None:
        before, after = self._changed(path, column, column.tolist(), times)
        slots, slots_after = times // EXTREMES_NS, after // EXTREMES_NS
        for slot in np.unique(slots).tolist():
            inside = slots_after == slot
            values = np.unique(column[slots == slot])[: _FEW + 1]
            self._changes[path, slot].append((values, before[inside], after[inside]))

    def _add_extremes(self, path: str, numbers: Numbers, times: IntArray) -> None:
        slots, is_finite = times // EXTREMES_NS, np.isfinite(numbers)
        for slot in np.unique(slots).tolist():
            rows = np.flatnonzero((slots == slot) & is_finite)
            samples = [
                *self._extremes.get((path, slot), ()),
                *zip(numbers[rows].tolist(), times[rows].tolist(), strict=True),
            ]
            if samples:
                # Of equal ones the earliest.
                greatest = max(samples, key=itemgetter(0))
                self._extremes[path, slot] = min(samples), greatest

    def _add_moves(self, name: str, times: IntArray, poses: Mapping[str, Points]) -> None:
        for path, rows in poses.items():
            mover = self._movers.setdefault((path, name), _Mover())
            self._stays.append(np.array([*mover.moved(times, rows)], np.int64))

    def _add_states(self, path: str, inner: Elements, times: IntArray) -> None:
        """Adds the messages in which the states of a list change, as those of goals."""
        states = [
            column.tolist()
            for column in inner.columns.values()
            if not isinstance(column, Texts)
            if column.dtype.itemsize == 1 and np.unique(column).size <= _FEW
        ]
        if not states:
            return
        rows: list[tuple[object, ...]] = [()] * times.size
        for owner, *values in zip(inner.owners.tolist(), *states, strict=True):
            rows[owner] = (*rows[owner], *values)
        _, codes = numbered(rows)
        self._stays += self._changed(path, codes, rows, times)

    def _add_frames(
        self, inner: Elements, times: IntArray, named: Sequence[dict[Name, Scored]]
    ) -> None:
        """Adds the moves of the frames of transforms, and to `named` the frames in each message."""
        column = inner.columns.get(_FRAME)
        if not isinstance(column, Texts):
            return
        for row, frame in zip(inner.owners.tolist(), column.values(), strict=True):
            named[row][frame, 0] = _UNSCORED
        poses = _poses(inner.columns)
        for code, frame in enumerate(column.words):
            rows = np.flatnonzero(column.codes == code)
            own = {path: points[rows] for path, points in poses.items()}
            self._add_moves(frame, times[inner.owners[rows]], own)


def is_sampled(table: Table) -> bool:
    """Returns whether messages have a long array of numbers, other than a covariance."""
    return any(
        not isinstance(column, Texts) and column.size and column.max() > _LONG
        for path, column in table.columns.items()
        if path.endswith(".length") and "covariance" not in path
    )


def _stepped(score: float) -> tuple[float, float]:
    """Returns a score with its step; one that a detector does not give is the lowest."""
    score = -_HIGHEST if isnan(score) else max(-_HIGHEST, min(score, _HIGHEST))
    return (score + _SINGLE) * _STEPS // 1, score


def _covering(named: Sequence[Mapping[Name, Scored]], seen: dict[Name, Scored]) -> list[int]:
    """Returns few rows with all names that were not `seen`, or not so high, and adds these to them.

    Each name is in one of them with its highest score, to a step.
    """
    missing: dict[Name, Scored] = {}
    for names in named:
        for name, score in names.items():
            if name not in seen or seen[name][0] < score[0]:
                missing[name] = max(score, missing.get(name, score))
    seen |= missing
    shown = [
        {
            name: score
            for name, (step, score) in names.items()
            if name in missing and missing[name][0] == step
        }
        for names in named
    ]
    rows: list[int] = []
    while missing:
        best = max(range(len(shown)), key=lambda row: (len(shown[row]), sum(shown[row].values())))
        rows.append(best)
        for name in [*shown[best]]:
            del missing[name]
            for left in shown:
                left.pop(name, None)
    return rows


def _is_time(table: Table, path: str) -> bool:
    names = path.split(".")
    along = fields_at(table.definition, names)
    kind = along[-1].kind if len(along) == len(names) else ""
    return isinstance(kind, Definition) and is_time(kind)


def _poses(columns: Mapping[str, Column]) -> dict[str, Points]:
    """Returns the poses in columns by the path of their point: its numbers, and the turn's."""
    poses: dict[str, Points] = {}
    for path in columns:
        point = path.removesuffix(".x")
        around, _, name = point.rpartition(".")
        if point != path and name in _TURNS:
            names = [f"{point}.{axis}" for axis in "xyz"]
            names += [f"{around}.{_TURNS[name]}.{axis}".lstrip(".") for axis in "xyzw"]
            poses |= _stacked(point, [columns[one] for one in names if one in columns])
    if {"x", "y", "theta"} <= columns.keys():  # geometry_msgs/msg/Pose2D, turtlesim/msg/Pose
        poses |= _stacked("", [columns[name] for name in ("x", "y", "theta")])
    if {"latitude", "longitude"} <= columns.keys():
        degrees = _stacked("latitude", [columns["latitude"], columns["longitude"]])
        poses |= {path: points * _DEGREE_M for path, points in degrees.items()}
    return poses


def _stacked(path: str, columns: Sequence[Column]) -> dict[str, Points]:
    """Returns columns of numbers as rows, by a path; nothing where one is of texts."""
    numbers = [column for column in columns if not isinstance(column, Texts)]
    if len(numbers) < len(columns):
        return {}
    return {path: np.stack([np.asarray(column, np.float64) for column in numbers], axis=1)}


_MOST_PAUSES: Final = 32
"""Of a day; the messages beside each stay."""


def with_shown_by(known: Thinned, snapshot: Snapshot, bags: Sequence[BagFile]) -> Thinned:
    """Returns what is known, and what some bags of a snapshot show; at least one bag."""

    def is_in(at: Ns) -> bool:
        return any(bag.start <= at <= bag.end for bag in bags)

    silences = {
        (silence.topic, silence.start): (*silence,)
        for silence in (
            *map(snapshot.prolonged, map(Silence._make, known.silences)),
            *(silence for silence in snapshot.silences if is_in(silence.start)),
        )
    }
    steps = [
        (fault.at, fault.by)
        for fault in snapshot.dating.faults
        if fault.kind is FaultyClock.SET_BACK
        if fault.by >= SHORTEST_STEP_NS and is_in(fault.at)
    ]
    pauses = [pause.span for pause in snapshot.suspects if is_in(pause.start)]
    left_open = [bag.end for bag in bags if bag.state is BagState.INCOMPLETE]
    since = bags[0].start if known.since is None else known.since
    if since > snapshot.scanned_at:  # by a clock that was ahead
        since = min(since, bags[0].start)
    return Thinned(
        since,
        tuple(sorted(silences.values(), key=itemgetter(1))),
        (*_few_a_day([*known.pauses, *pauses]),),
        tuple(sorted({*known.set_back, *steps})),
        tuple(sorted({*known.left_open, *left_open})),
    )


def _few_a_day(pauses: Iterable[Span]) -> Iterator[Span]:
    """Yields pauses in order of time, each once: the first `_MOST_PAUSES` of a day."""
    counts = Counter[str]()
    for start, end in sorted({*pauses}):
        day = utc_day(start)
        counts[day] += 1
        if counts[day] <= _MOST_PAUSES:
            yield start, end


def times_near(pauses: Iterable[Span], times: IntArray) -> IntArray:
    """Returns those of some log times (ns) that lie so near a pause that they show a step."""
    near = np.zeros(times.size, bool)
    for start, end in pauses:
        near |= (times >= start - STAMPS_BESIDE_NS) & (times <= end + STAMPS_BESIDE_NS)
    return times[near]
