"""Reads detections from the columns of a table, without its messages.

It finds what `messages.detections.detections_of` finds in each extracted value: `sources_in` visits
the same fields, equally deep, by the same names. Where the shape of a value differs from message to
message, the columns do not settle it, and the messages have to be read.

`without_low` does to a value what `without_low_scores` does: it puts null in place of a detection,
or of one of its hypotheses, with a low score. An object that has no name in some messages is no
detection there; then the limits say that they do not know.
"""

from __future__ import annotations

import math
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.columns.shown import UNKNOWN, ByType, Listing, Node, Shape, with_limit
from ros2_memory.columns.table import Table, Texts, joined_texts
from ros2_memory.columns.values import (
    ROWS,
    Conversion,
    Kind,
    Leaf,
    Level,
    Limit,
    TruthValues,
    UnknownShapeError,
    Values,
    unknown,
    zones_of,
)
from ros2_memory.core.arrays import (
    Floats,
    entries_of_codes,
    places_among,
    range_numbers,
    stable_order,
)
from ros2_memory.core.text import looks_like_json
from ros2_memory.messages.detections import (
    IDS,
    MAX_DEPTH,
    POSITIONS,
    SAYS_ABSENT,
    SCORES,
    Detection,
    detections_of,
    has_more_content,
    hypotheses_field,
    lists_of_seen,
    naming_fields,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from ros2_memory.columns.stored import PartZones, Topic
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import IntArray, Mask


class NamedScores(NamedTuple):
    """The names and scores of objects.

    Attributes:
        name: of each object; blank if it has none.
        score: of each object; NaN if it has none.
        error: the greatest error of any score.
    """

    name: Texts
    score: Floats
    error: float

    @property
    def is_named(self) -> Mask:
        """Which objects have a name."""
        return self.name.are(str.strip)

    def at(self, positions: IntArray) -> NamedScores:
        """Returns the names and scores of the objects at some positions."""
        return NamedScores(self.name.at(positions), self.score[positions], self.error)


def _names(values: Values, leaf: Leaf) -> Texts:
    """Returns the texts of a leaf, or the names of its whole numbers, else these as texts."""
    if leaf.kind is Kind.TEXT:
        return values.texts(leaf)
    names: Mapping[float, str] = dict(leaf.names)
    numbers = values.numbers(leaf).values.tolist()
    return Texts.of([names.get(number) or str(number) for number in numbers])


def _texts_or(texts: Texts, fallback: Texts, *, replace_blank: bool = False) -> Texts:
    """Returns the texts, and the fallback of each row whose text is empty.

    With `replace_blank` also of rows whose text has nothing but spaces.
    """
    is_empty = [not (word.strip() if replace_blank else word) for word in texts.words]
    if not any(is_empty):
        return texts
    both = joined_texts([texts, fallback])
    codes, fallback_codes = np.split(both.codes, 2)
    return Texts(np.where(np.array(is_empty)[texts.codes], fallback_codes, codes), both.words)


class Point(NamedTuple):
    """Where the place of an object may be.

    Attributes:
        axes: x, y and z (m).
        frames: texts beside them that may name the frame, the outermost first.
    """

    axes: tuple[Leaf, ...]
    frames: tuple[Leaf, ...]


class Labels(NamedTuple):
    """Objects that may be detections.

    Attributes:
        level: where names and scores are: in the objects; with `is_best` in their hypotheses.
        names: texts, then whole numbers: the first that is not blank is the name.
        scores: numbers: the first that is not NaN is the score.
        inner: where detections may be inside an object that has no name.
        frames: texts that may name the frame, the outermost first.
        points: where their place may be, the first choice first; None if it depends on the message.
        ids: what may tell the objects from others of their name, the last choice first.
        is_best: whether the best of several hypotheses names an object.
        flags: booleans, each with the value that says that there is no such object.
    """

    level: Level
    names: tuple[Leaf, ...]
    scores: tuple[Leaf, ...]
    inner: tuple[Source, ...]
    frames: tuple[Leaf, ...]
    points: tuple[Point, ...] | None
    ids: tuple[Leaf, ...]
    is_best: bool
    flags: tuple[tuple[Leaf, bool], ...]

    @property
    def leaf(self) -> Leaf:
        """The first choice for the name."""
        return self.names[0]

    @property
    def level_of_objects(self) -> Level:
        """Where the objects lie."""
        return self.level.parent if self.is_best and self.level.parent else self.level

    def read_all(self, values: Values) -> NamedScores:
        """Returns the name and score of each object or hypothesis.

        Raises:
            UnknownShapeError: the table has no column for one of them.
        """
        name = _names(values, self.names[0])
        for leaf in self.names[1:]:
            name = _texts_or(name, _names(values, leaf), replace_blank=True)
        for leaf, absent in self.flags:
            is_absent = values.numbers(leaf).values == absent
            codes = np.where(is_absent, len(name.words), name.codes).astype(np.uint32)
            name = Texts(codes, (*name.words, ""))
        score, error = np.full(len(name), np.nan), 0.0
        for leaf in self.scores:
            column, leaf_error = values.floats(leaf)
            score, error = np.where(np.isnan(score), column, score), max(error, leaf_error)
        return NamedScores(name, score, error)

    def read(self, values: Values) -> tuple[IntArray, NamedScores]:
        """Returns the name and score of each object, behind their positions in `level`.

        Raises:
            UnknownShapeError: the table has no column for one of them, or scores were rounded so
                that another hypothesis may be the best.
        """
        named = self.read_all(values)
        if not self.is_best:
            return np.arange(len(named.name)), named
        best = _best_hypotheses(named, values.elements(self.level).owners)
        return best, named.at(best)

    def objects(self, values: Values, positions: IntArray) -> IntArray:
        """Returns the objects that are named at some positions in `level`."""
        return values.elements(self.level).owners[positions] if self.is_best else positions

    def not_below(self, values: Values, least: float) -> TruthValues:
        """Returns which objects are no detection with a score below `least`.

        Raises:
            UnknownShapeError: as for `read`.
        """
        positions, named = self.read(values)
        owners = self.objects(values, positions)
        surely, perhaps = unknown(values.size(self.level_of_objects))
        surely[owners] = named.is_named & ~(named.score < least + named.error)
        perhaps[owners] = ~(named.is_named & (named.score < least - named.error))
        return TruthValues(surely, perhaps)


def _best_hypotheses(named: NamedScores, owners: IntArray) -> IntArray:
    """Returns the position of the best hypothesis of each object; the first of equal ones.

    Args:
        named: the names and scores of all hypotheses.
        owners: the object of each hypothesis, ascending.

    Raises:
        UnknownShapeError: scores were rounded, so that another one may be the best.
    """
    # A hypothesis without a score comes last.
    order = np.lexsort((-np.where(np.isnan(named.score), -np.inf, named.score), owners))
    is_best: Mask = np.diff(owners[order], prepend=-1) != 0
    if named.error:
        best = np.flatnonzero(is_best[:-1] & ~is_best[1:])  # those that have a second
        score, codes = named.score[order], named.name.codes[order]
        with np.errstate(invalid="ignore"):  # infinity less infinity
            is_close = score[best] - score[best + 1] <= 2 * named.error
        if (is_close & (codes[best] != codes[best + 1])).any():
            raise UnknownShapeError("another hypothesis may be the best")
    best_of_all: IntArray = order[is_best]
    return best_of_all


class Words(NamedTuple):
    """A list of labels."""

    leaf: Leaf


class Json(NamedTuple):
    """A text that may be JSON with detections.

    Attributes:
        leaf: the text, with the depth to which detections are looked for in it.
        frames: texts that may name the frame, the outermost first.
        is_beside: whether the message has other content beside it.
    """

    leaf: Leaf
    frames: tuple[Leaf, ...]
    is_beside: bool = False


Source: TypeAlias = Labels | Words | Json


def sources_in(value: Node) -> list[Source]:
    """Returns where detections may be in a value.

    Raises:
        UnknownShapeError: that depends on the message.
    """
    sources = _walk(value, MAX_DEPTH, (), None).sources
    if any(source.leaf.limits for source in sources):
        raise UnknownShapeError("an element of a list stands alone")
    return [*sources]


def without_low(value: Node, least: float) -> Node:
    """Returns a value without the detections whose score is below `least`.

    Raises:
        UnknownShapeError: that depends on the message.
    """
    return _walk(value, MAX_DEPTH, (), least).node


class _Walked(NamedTuple):
    """A node after a walk.

    Attributes:
        node: without the detections that have a low score.
        sources: where it may have detections.
    """

    node: Node
    sources: tuple[Source, ...] = ()


def _walk(node: Node, depth: int, frames: tuple[Leaf, ...], least: float | None) -> _Walked:
    """Looks for detections in a node.

    Args:
        node: part of a value.
        depth: how many lists, objects and texts deep to look.
        frames: texts around it that may name the frame, the outermost first.
        least: detections with a lower score are left out; None to keep all.
    """
    if node is UNKNOWN:
        raise UnknownShapeError("a part depends on the message")
    if depth == 0:
        return _Walked(node)
    if isinstance(node, Leaf) and node.kind is Kind.TEXT:
        text = node._replace(json_depth=depth)
        return _Walked(text, (Json(text, frames),))
    if isinstance(node, Listing) and isinstance(node.element, dict):
        walked = _walk(node.element, depth - 1, frames, least)
        return _Walked(Listing(node.level, walked.node), walked.sources)
    if not isinstance(node, dict):  # lists are looked at for objects alone
        return _Walked(node)
    frames += _frame_leaves(node)
    inner: list[Source] = []
    fields: dict[str, Node] = {}
    seen = lists_of_seen(node)
    for name, part in node.items():
        element = part.element if isinstance(part, Listing) else None
        if name in seen and isinstance(element, Leaf) and element.kind is Kind.TEXT:
            inner.append(Words(element))
        fields[name], sources = _walk(part, depth - 1, frames, least)
        if isinstance(part, Leaf) and has_more_content(node):
            sources = tuple(
                source._replace(is_beside=True) if isinstance(source, Json) else source
                for source in sources
            )
        inner += sources
    labels = _labels(node, tuple(inner), frames)
    if labels is None:
        return _Walked(type(node)(fields), tuple(inner))
    return _Walked(node if least is None else _without_low_object(node, labels, least), (labels,))


def _labels(
    fields: dict[str, Node], inner: tuple[Source, ...], frames: tuple[Leaf, ...]
) -> Labels | None:
    """Returns how an object with these fields may be a detection; None if it never is."""
    named, points, is_best = fields, _points(fields), False
    field = hypotheses_field(fields)
    results = None if field is None else fields[field]
    element = results.element if isinstance(results, Listing) else None
    if isinstance(element, dict) and not _naming_leaves(fields):
        is_best, hypothesis, of_best = True, element.get("hypothesis"), _points(element)
        named = hypothesis if isinstance(hypothesis, dict) else element
        points = None if of_best is None or points is None else of_best + points
    names, scores = _naming_leaves(named), _leaves(named, SCORES, Kind.INTEGER, Kind.REAL)
    if not names:
        return None
    ids = _leaves(fields, IDS, Kind.TEXT, Kind.INTEGER)
    flags = tuple(
        (leaf, absent)
        for flag, absent in SAYS_ABSENT.items()
        for leaf in _leaves(named, (flag,), Kind.BOOLEAN)
    )
    return Labels(names[0].level, names, scores, inner, frames, points, ids, is_best, flags)


def _without_low_object(node: dict[str, Node], labels: Labels, least: float) -> Node:
    """Returns an object without the rows in which it is a detection with a score below `least`."""

    def find_objects(values: Values, positions: IntArray) -> TruthValues:
        surely, perhaps = values.once(limit, lambda values: labels.not_below(values, least))
        return TruthValues(surely[positions], perhaps[positions])

    def find_hypotheses(values: Values, positions: IntArray) -> TruthValues:
        named, owners = labels.read_all(values), labels.objects(values, positions)
        score = named.score[positions]
        surely, perhaps = ~(score < least + named.error), ~(score < least - named.error)
        # Where it is not sure that the detection is one, neither is what stays of it.
        is_detection = limit.truth(values, owners).surely
        return TruthValues(surely & is_detection, perhaps | ~is_detection)

    limit = Limit(labels.level_of_objects, find_objects)
    if labels.is_best:
        field = hypotheses_field(node) or ""
        node = {**node, field: with_limit(node[field], Limit(labels.level, find_hypotheses))}
    return with_limit(node, limit)


def _naming_leaves(fields: Mapping[str, Node]) -> tuple[Leaf, ...]:
    """Returns the fields that name an object: texts, then whole numbers."""
    names = tuple(naming_fields(fields.keys()))
    return _leaves(fields, names, Kind.TEXT) + _leaves(fields, names, Kind.INTEGER)


def _leaves(fields: Mapping[str, Node], names: tuple[str, ...], *kinds: Kind) -> tuple[Leaf, ...]:
    """Returns the fields with these names that are leaves of one of these kinds."""
    nodes = [fields[name] for name in names if name in fields]
    return tuple(node for node in nodes if isinstance(node, Leaf) and node.kind in kinds)


def _frame_leaves(fields: Mapping[str, Node]) -> tuple[Leaf, ...]:
    """Returns the text with which an object names its frame, if it has one."""
    header = fields.get("header")
    named = header if isinstance(header, dict) else fields
    return _leaves(named, ("frame_id",), Kind.TEXT)


def _points(fields: dict[str, Node]) -> tuple[Point, ...] | None:
    """Returns where an object may have its place, the first choice first.

    Returns None if that depends on the message.
    """
    points: list[Point] = []
    for path in POSITIONS:
        node, frames = _position_at(fields, path)
        if isinstance(node, dict):
            axes = [node[axis] for axis in "xyz" if axis in node]
        elif isinstance(node, list):
            axes = [*node]
        else:
            continue
        leaves = tuple(axis for axis in axes if isinstance(axis, Leaf))
        if len(leaves) < len(axes) or isinstance(node, Listing):
            return None
        if len(leaves) == 3 and all(leaf.is_number for leaf in leaves):
            points.append(Point(leaves, frames))
    return tuple(points)


def _position_at(
    fields: dict[str, Node], path: tuple[str, ...]
) -> tuple[Node | None, tuple[Leaf, ...]]:
    """Returns what is at a path, and the texts on the way that may name its frame."""
    node: Node | None = fields
    frames: tuple[Leaf, ...] = ()
    for name in path:
        node = node.get(name) if isinstance(node, dict) else None
        if isinstance(node, dict):
            frames += _frame_leaves(node)
    return node, frames


def may_be_json(values: Values, texts: Iterable[Leaf]) -> bool:
    """Returns whether one of these texts looks like JSON, or has no column."""
    for leaf in texts:
        zones = values.zones(leaf)
        if zones is not None and not zones.may_be_json:
            continue
        try:
            if any(map(looks_like_json, values.texts(leaf).words)):
                return True
        except UnknownShapeError:
            return True
    return False


Points: TypeAlias = "np.ndarray[tuple[int, int], np.dtype[np.float64]]"


class Detections(NamedTuple):
    """Detections in the order of their messages, those of one message in its order.

    Attributes:
        rows: the message of each detection, ascending.
        labels: the names.
        scores: in the detector's own unit; NaN without one.
        places: N x 3 (m), in `frames`; NaN without one.
        frames: the frame of each place; empty if the message names none.
        ids: what tells objects of one label apart; empty if nothing does.
    """

    rows: IntArray
    labels: Texts
    scores: Floats
    places: Points
    frames: Texts
    ids: Texts

    def at(self, rows: IntArray) -> Detections:
        """Returns the detections of some messages, which become the messages 0, 1, 2, ...

        Args:
            rows: the messages, ascending.
        """
        message, is_among = places_among(self.rows, rows)
        return self._replace(rows=message).select(is_among)

    def select(self, which: IntArray | Mask) -> Detections:
        """Returns the detections at some positions, or those that a mask picks."""
        rows, labels, scores, places, frames, ids = self
        return Detections(
            rows[which],
            labels.at(which),
            scores[which],
            places[which],
            frames.at(which),
            ids.at(which),
        )


class StampedDetections(NamedTuple):
    """The detections of the messages of a table, and what the headers of the messages say.

    Attributes:
        detections: their `rows` are those of the table.
        stamps: of each message (ns); None if the type has no stamps.
        frames: of each message; empty if it names none.
    """

    detections: Detections
    stamps: IntArray | None
    frames: Texts


class _Plan(NamedTuple):
    """Where a type has detections, and what its header says.

    Attributes:
        sources: where detections may be.
        frames: the frame of the header, if it has one.
        stamp: of the header (ns).
    """

    sources: Sequence[Source]
    frames: Sequence[Leaf]
    stamp: Leaf | None

    @classmethod
    def of(cls, shape: Shape) -> _Plan:
        """Returns the plan of a type.

        Raises:
            UnknownShapeError: it depends on the message.
        """
        frame, stamp = shape.at(("header", "frame_id")), shape.at(("header", "stamp"))
        is_time = isinstance(stamp, Leaf) and stamp.conversion is Conversion.SECONDS
        return cls(
            sources_in(shape.value),
            [frame] if isinstance(frame, Leaf) and frame.kind is Kind.TEXT else [],
            Leaf(ROWS, ("header.stamp",), Kind.INTEGER) if is_time else None,
        )


class DetectionColumns:
    """Reads the detections of tables; remembers where they are in each type.

    Args:
        extractor: has the schema map.
    """

    def __init__(self, extractor: SchemaExtractor) -> None:
        self._plans = ByType(extractor, _Plan.of)

    def of(self, table: Table) -> StampedDetections | None:
        """Returns the detections of a table; None if its messages have to be read."""
        plan = self._plans.of(table)
        if plan is None:
            return None
        try:
            return table.remember("detections", lambda: _read_stamped(table, plan), _bytes_of)
        except UnknownShapeError:
            return None

    def has_labels(self, table: Table) -> bool:
        """Returns whether the type of a table has fields for labels, not only texts."""
        plan = self._plans.of(table)
        return plan is None or any(not isinstance(source, Json) for source in plan.sources)

    def may_match(self, parts: PartZones) -> bool | Mask:
        """Returns which parts may have a detection, by their zones; True if all may."""
        texts = self._only_texts(parts.topic)
        if texts is None:
            return True
        possible: bool | Mask = False
        for leaf in texts:
            zones = zones_of(leaf, parts.zone)
            possible = possible | (True if zones is None else zones.may_be_json)
        return possible

    def may_have_any(self, table: Table) -> bool:
        """Returns whether a message of a table may have a detection."""
        texts = self._only_texts(table)
        return texts is None or may_be_json(Values(table), texts)

    def _only_texts(self, rows: Table | Topic) -> list[Leaf] | None:
        """Returns the texts that may be JSON; None if a type has detections elsewhere, too."""
        plan = self._plans.of(rows)
        if plan is None:
            return None
        texts = [source.leaf for source in plan.sources if isinstance(source, Json)]
        return texts if len(texts) == len(plan.sources) else None


def _read_stamped(table: Table, plan: _Plan) -> StampedDetections:
    """Returns the detections of a table; raises as `detections_in`."""
    values = Values(table)
    detections = joined_detections(
        [part for source in plan.sources for part in detections_in(values, source, places=True)]
    )
    frames = _texts_at(values, ROWS, np.arange(values.rows), plan.frames)
    header_frames = frames.at(detections.rows)
    return StampedDetections(
        detections._replace(frames=_texts_or(detections.frames, header_frames)),
        None if plan.stamp is None else values.numbers(plan.stamp).values.astype(np.int64),
        frames,
    )


def _bytes_of(stamped: StampedDetections) -> int:
    return 1000 + 60 * len(stamped.detections.rows) + 12 * len(stamped.frames)


def detections_by(by_message: Sequence[Sequence[Detection]]) -> Detections:
    """Returns the detections of messages as columns; each message has a list of its own."""
    detections = [detection for of_message in by_message for detection in of_message]
    nowhere = (math.nan, math.nan, math.nan)
    return Detections(
        range_numbers([*map(len, by_message)]),
        Texts.of([detection.label for detection in detections]),
        np.array([detection.score for detection in detections], np.float64),  # of None: NaN
        np.array([detection.place or nowhere for detection in detections]).reshape(-1, 3),
        Texts.of([detection.frame_id for detection in detections]),
        Texts.of([detection.id for detection in detections]),
    )


def joined_detections(parts: Sequence[Detections]) -> Detections:
    """Returns the detections of several parts of the same messages as one."""
    if len(parts) == 1:
        return parts[0]
    if not parts:
        return detections_by(())
    rows = np.concatenate([part.rows for part in parts])
    order = stable_order(rows)
    return Detections(
        rows[order],
        joined_texts([part.labels for part in parts])[order],
        np.concatenate([part.scores for part in parts])[order],
        np.concatenate([part.places for part in parts])[order],
        joined_texts([part.frames for part in parts])[order],
        joined_texts([part.ids for part in parts])[order],
    )


def detections_in(values: Values, source: Source, *, places: bool) -> Iterator[Detections]:
    """Yields the detections that one source has in the messages of a table.

    Args:
        values: of the table.
        source: where to look.
        places: whether places and frames are read, too.

    Raises:
        UnknownShapeError: the messages have to be read.
    """
    if isinstance(source, Json):
        yield from _in_json(values, source)
    elif isinstance(source, Words):
        yield _in_labels(values, source.leaf)
    else:
        yield _in_objects(values, source, places=places)


def _in_labels(values: Values, leaf: Leaf) -> Detections:
    """Returns the texts of lists of labels, but for empty ones, without a score."""
    texts = values.texts(leaf)
    positions = np.flatnonzero(texts.are(bool))
    named = NamedScores(texts, np.full(len(texts), math.nan), 0.0)
    return _detections_at(values, leaf.level, positions, named.at(positions))


def _in_objects(values: Values, source: Labels, *, places: bool) -> Detections:
    """Returns the objects that have a name, with their scores; raises as `detections_in`."""
    positions, named = source.read(values)
    is_named = np.flatnonzero(named.is_named)
    if is_named.size < values.size(source.level_of_objects):
        inside = chain(*(detections_in(values, inner, places=False) for inner in source.inner))
        if any(detections.rows.size for detections in inside):
            raise UnknownShapeError("some objects are detections, others have some inside")
    positions = positions[is_named]
    detections = _detections_at(values, source.level, positions, named.at(is_named))
    return _with_places(values, source, positions, detections) if places else detections


def _detections_at(
    values: Values, level: Level, positions: IntArray, named: NamedScores
) -> Detections:
    """Returns the objects at some positions of a level as detections without a place."""
    return Detections(
        _owners_at(values, level, positions, ROWS),
        named.name,
        named.score,
        np.full((positions.size, 3), math.nan),
        _no_texts(positions.size),
        _no_texts(positions.size),
    )


def _no_texts(count: int) -> Texts:
    return Texts(np.zeros(count, np.uint32), ("",))


def _in_json(values: Values, source: Json) -> Iterator[Detections]:
    """Yields the detections in texts that are JSON; each distinct text is parsed once."""
    if not may_be_json(values, [source.leaf]):
        return
    texts, depth = values.texts(source.leaf), source.leaf.json_depth
    parsed = values.table.remember(
        f"JSON of depth {depth} in {source.leaf.level.full(source.leaf.sources[0])}",
        lambda: detections_by(
            [detections_of(word, depth=depth, is_beside=source.is_beside) for word in texts.words]
        ),
        lambda detections: 1000 + 100 * detections.rows.size,
    )
    if not parsed.rows.size:
        return
    counts, nth = entries_of_codes(parsed.rows, texts.codes.astype(np.int64))
    positions = range_numbers(counts)
    rows = _owners_at(values, source.leaf.level, positions, ROWS)
    detections = parsed.select(nth)
    frames = _texts_at(values, source.leaf.level, positions, source.frames)
    yield detections._replace(rows=rows, frames=_texts_or(detections.frames, frames))


def _with_places(
    values: Values, source: Labels, positions: IntArray, detections: Detections
) -> Detections:
    """Returns detections with their id and place: the first point of each that is valid."""
    if source.points is None:
        raise UnknownShapeError("points are of another shape in each message")
    level, places = source.level, detections.places
    frames = _texts_at(values, level, positions, source.frames)
    for point in source.points:
        at = _owners_at(values, level, positions, point.axes[0].level)
        axes = [values.numbers(leaf).values[at] for leaf in point.axes]
        place = np.stack(axes, axis=1).astype(np.float64)
        # All zeros means that nobody filled it in.
        is_valid = np.isfinite(place).all(axis=1) & place.any(axis=1)
        is_new = is_valid & np.isnan(places[:, 0])
        places = np.where(is_new[:, None], place, places)
        point_frames = _texts_at(values, level, positions, point.frames)
        codes = np.where(is_new, point_frames.codes + 1, 0).astype(np.uint32)
        frames = _texts_or(Texts(codes, ("", *point_frames.words)), frames)
    ids = _texts_at(values, level, positions, source.ids)
    return detections._replace(places=places, frames=frames, ids=ids)


def _texts_at(values: Values, level: Level, positions: IntArray, leaves: Sequence[Leaf]) -> Texts:
    """Returns the text at some positions of a level, as a frame: the last one that is not empty."""
    texts = _no_texts(positions.size)
    for leaf in leaves:
        words = _names(values, leaf).at(_owners_at(values, level, positions, leaf.level))
        texts = _texts_or(words, texts)
    return texts


def _owners_at(values: Values, level: Level, positions: IntArray, outer: Level) -> IntArray:
    """Returns the elements or rows of an outer level that some elements of a level lie in."""
    while level != outer and level.parent is not None:
        positions, level = values.elements(level).owners[positions], level.parent
    return positions
