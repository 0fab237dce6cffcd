"""Where the messages of a type may have detections, and those of a table from its columns alone.

The same as `messages.detections.detections_of` finds in each extracted value: `sources_in` goes
where that goes, as deep, by the same names. Where the columns do not settle it (a shape that
differs from message to message) the messages have to be read.

`without_low` leaves of a value what `without_low_scores` leaves: null is in place of a detection of
a low score, or of one of its hypotheses. Where an object has no name in some messages, and so is no
detection there, the limits say that they do not know.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.columns.shown import UNKNOWN, ByType, Listing, Node, Shape, narrowed
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
    zone_of,
)
from ros2_memory.columns.walk import entries_of_codes
from ros2_memory.core.arrays import Floats, places_among
from ros2_memory.core.text import LISTS_OF_LABELS, looks_like_json
from ros2_memory.messages.detections import (
    MAX_DEPTH,
    POSITIONS,
    SCORES,
    Detection,
    detections_of,
    naming_fields,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from ros2_memory.columns.zones import PartZones
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import IntArray, Mask


class NamedScores(NamedTuple):
    """The name (blank: none) and the score (NaN: none) of each object, and the error of scores."""

    name: Texts
    score: Floats
    error: float

    @property
    def is_named(self) -> Mask:
        """Which objects have a name."""
        return np.array([bool(word.strip()) for word in self.name.words], np.bool_)[self.name.codes]

    def at(self, positions: IntArray) -> NamedScores:
        """Returns some of them."""
        name, score, error = self
        return NamedScores(Texts(name.codes[positions], name.words), score[positions], error)


class Scored(NamedTuple):
    """An object that may be a detection: what names it, in order, and what its score is.

    Attributes:
        level: where it lies.
        labels: texts and then whole numbers, the first of which that is not blank names it.
        scores: numbers, of which the first that is known is its score.
    """

    level: Level
    labels: tuple[Leaf, ...]
    scores: tuple[Leaf, ...]

    def read(self, values: Values) -> NamedScores:
        """Returns the names and scores of all; raises `UnknownShapeError` without columns."""
        name, *fallbacks = (_names(values, leaf) for leaf in self.labels)
        for fallback in fallbacks:
            name = or_else(name, fallback, blank=True)
        score, error = np.full(len(name), np.nan), 0.0
        for leaf in self.scores:
            column, leaf_error = values.floats(leaf)
            score, error = np.where(np.isnan(score), column, score), max(error, leaf_error)
        return NamedScores(name, score, error)


def _names(values: Values, leaf: Leaf) -> Texts:
    """Returns the texts of a leaf, or its whole numbers as such."""
    if leaf.kind is Kind.TEXT:
        return values.texts(leaf)
    return Texts.of([*map(str, values.numbers(leaf).values.tolist())])


def or_else(texts: Texts, fallback: Texts, *, blank: bool = False) -> Texts:
    """Returns each of some texts, or another where it is empty (or `blank`)."""
    is_none = [not (word.strip() if blank else word) for word in texts.words]
    if not any(is_none):
        return texts
    codes = np.where(np.array(is_none)[texts.codes], fallback.codes + len(texts.words), texts.codes)
    return Texts(codes.astype(np.uint32), (*texts.words, *fallback.words))


class Point(NamedTuple):
    """Numbers that may be the place of an object: x, y and z (m).

    `frames` are the texts beside it that may name its frame, the outermost first.
    """

    axes: tuple[Leaf, ...]
    frames: tuple[Leaf, ...]


class Labels(NamedTuple):
    """Objects that may be detections: what names them, and what else there is where nothing does.

    Attributes:
        scored: names and scores; of the hypotheses with `is_best`.
        otherwise: where detections are where the object is none.
        frames: that name the frame, outermost first.
        points: where they may have their place, first choice first; None where that depends on the
            message.
        is_best: they are named by the best of several hypotheses, which is what is scored.
    """

    scored: Scored
    otherwise: tuple[Source, ...]
    frames: tuple[Leaf, ...]
    points: tuple[Point, ...] | None
    is_best: bool = False

    @property
    def leaf(self) -> Leaf:
        """What names them first."""
        return self.scored.labels[0]

    @property
    def level(self) -> Level:
        """Where the objects lie."""
        level = self.scored.level
        return level.parent if self.is_best and level.parent else level

    def read(self, values: Values) -> tuple[IntArray, NamedScores]:
        """Returns what names the objects, and its positions in the level of `scored`.

        Raises:
            UnknownShapeError: columns lack it, or rounding may make another hypothesis the best.
        """
        named = self.scored.read(values)
        if not self.is_best:
            return np.arange(len(named.name)), named
        owners = values.elements(self.scored.level).owners
        # Without a score last; of those of one score the first.
        order = np.lexsort((-np.where(np.isnan(named.score), -np.inf, named.score), owners))
        begins = np.diff(owners[order], prepend=-1) != 0
        best = order[begins]
        if named.error:
            follows = np.flatnonzero(begins[:-1] & ~begins[1:])
            score, codes = named.score[order], named.name.codes[order]
            with np.errstate(invalid="ignore"):  # infinity less infinity
                is_close = score[follows] - score[follows + 1] <= 2 * named.error
            if (is_close & (codes[follows] != codes[follows + 1])).any():
                raise UnknownShapeError("another hypothesis may be the best")
        return best, named.at(best)

    def objects(self, values: Values, positions: IntArray) -> IntArray:
        """Returns the objects that are named at some positions in the level of `scored`."""
        return values.elements(self.scored.level).owners[positions] if self.is_best else positions


class Words(NamedTuple):
    """A list of labels."""

    leaf: Leaf


class Json(NamedTuple):
    """A text that may be JSON, and how deep detections are looked for in it."""

    leaf: Leaf
    depth: int
    frames: tuple[Leaf, ...]


Source: TypeAlias = Labels | Words | Json


def sources_in(value: Node) -> list[Source]:
    """Returns where detections may be in a value.

    Raises:
        UnknownShapeError: that depends on the message.
    """
    sources: list[Source] = []
    _walked(value, MAX_DEPTH, (), None, sources)
    if any(source.leaf.limits for source in sources):
        raise UnknownShapeError("an element of a list stands alone")
    return sources


def without_low(value: Node, least: float) -> Node:
    """Returns a value without the detections whose score is below a limit; raises likewise."""
    return _walked(value, MAX_DEPTH, (), least, [])


def _walked(
    node: Node, depth: int, frames: tuple[Leaf, ...], least: float | None, sources: list[Source]
) -> Node:
    """Adds where detections may be in a node; returns it without those of a score below `least`.

    `frames` name the frame, outermost first.
    """
    if node is UNKNOWN:
        raise UnknownShapeError("a part depends on the message")
    if depth == 0:
        return node
    if isinstance(node, Leaf) and node.kind is Kind.TEXT:
        sources.append(Json(node, depth, frames))
        return node._replace(json_depth=depth)
    if isinstance(node, Listing) and isinstance(node.element, dict):
        return Listing(node.level, _walked(node.element, depth - 1, frames, least, sources))
    if not isinstance(node, dict):  # lists are looked at for objects alone
        return node
    frames = (*frames, *_frame_leaves(node))
    inner: list[Source] = []
    fields: dict[str, Node] = {}
    for name, part in node.items():
        element = part.element if isinstance(part, Listing) else None
        if name in LISTS_OF_LABELS and isinstance(element, Leaf) and element.kind is Kind.TEXT:
            inner.append(Words(element))
        fields[name] = _walked(part, depth - 1, frames, least, inner)
    labels = _labels(node, tuple(inner), frames)
    if labels is None:
        sources += inner
        return type(node)(fields)
    sources.append(labels)
    return node if least is None else _limited(node, labels, least)


def _labels(
    fields: dict[str, Node], inner: tuple[Source, ...], frames: tuple[Leaf, ...]
) -> Labels | None:
    """Returns how an object may be a detection; None if none like it is one."""
    named, results = _scored(fields), fields.get("results")
    if named is not None:
        return Labels(named, inner, frames, _points(fields))
    if not isinstance(results, Listing) or not isinstance(results.element, dict):
        return None
    # The hypotheses of a detection (vision_msgs).
    hypothesis = results.element.get("hypothesis")
    named = _scored(hypothesis if isinstance(hypothesis, dict) else results.element)
    if named is None:
        return None
    of_best, own = _points(results.element), _points(fields)
    points = None if of_best is None or own is None else (*of_best, *own)
    return Labels(named, inner, frames, points, is_best=True)


def _limited(node: dict[str, Node], labels: Labels, least: float) -> Node:
    """Returns an object that may be a detection, where its score is not low."""

    def of_objects(values: Values) -> TruthValues:
        positions, named = labels.read(values)
        size = values.size(labels.level)
        surely, perhaps = np.zeros(size, np.bool_), np.ones(size, np.bool_)
        owners = labels.objects(values, positions)
        surely[owners] = named.is_named & ~(named.score < least + named.error)
        perhaps[owners] = ~(named.is_named & (named.score < least - named.error))
        return TruthValues(surely, perhaps)

    def find(values: Values, positions: IntArray) -> TruthValues:
        surely, perhaps = values.once(limit, of_objects)
        return TruthValues(surely[positions], perhaps[positions])

    limit = Limit(labels.level, find)
    results = node.get("results")
    if not labels.is_best or not isinstance(results, Listing):
        return narrowed(node, limit)

    def of_hypotheses(values: Values, positions: IntArray) -> TruthValues:
        named, owners = labels.scored.read(values), labels.objects(values, positions)
        # Where it is not sure that the detection is one, neither is what stays of it.
        is_detection, score = limit.kept(values, owners).surely, named.score[positions]
        surely, perhaps = (~(score < least + off) for off in (named.error, -named.error))
        return TruthValues(surely & is_detection, perhaps | ~is_detection)

    kept = narrowed(results, Limit(labels.scored.level, of_hypotheses))
    return narrowed({**node, "results": kept}, limit)


def _scored(fields: Mapping[str, Node]) -> Scored | None:
    """Returns how an object is named and scored; None if none like it is a detection."""
    names = tuple(naming_fields(fields.keys()))
    labels = _leaves(fields, names, Kind.TEXT) + _leaves(fields, names, Kind.INTEGER)
    scores = _leaves(fields, SCORES, Kind.INTEGER, Kind.REAL)
    return Scored(labels[0].level, labels, scores) if labels else None


def _leaves(fields: Mapping[str, Node], names: tuple[str, ...], *kinds: Kind) -> tuple[Leaf, ...]:
    nodes = [fields[name] for name in names if name in fields]
    return tuple(node for node in nodes if isinstance(node, Leaf) and node.kind in kinds)


def _frame_leaves(fields: Mapping[str, Node]) -> Iterator[Leaf]:
    header = fields.get("header")
    leaf = (header if isinstance(header, dict) else fields).get("frame_id")
    if isinstance(leaf, Leaf) and leaf.kind is Kind.TEXT:
        yield leaf


def _points(fields: dict[str, Node]) -> tuple[Point, ...] | None:
    """Returns where an object may have its place, first choice first; None: it depends."""
    points: list[Point] = []
    for path in POSITIONS:
        node: Node | None = fields
        frames: list[Leaf] = []
        for name in path:
            node = node.get(name) if isinstance(node, dict) else None
            if isinstance(node, dict):
                frames += _frame_leaves(node)
        if isinstance(node, dict):
            axes = [node[axis] for axis in "xyz" if axis in node]
        elif isinstance(node, list):
            axes = [*node]
        else:
            continue
        leaves = [axis for axis in axes if isinstance(axis, Leaf)]
        if len(leaves) < len(axes) or isinstance(node, Listing):
            return None
        if len(leaves) == 3 and all(leaf.is_number for leaf in leaves):
            points.append(Point(tuple(leaves), tuple(frames)))
    return tuple(points)


def may_be_json(values: Values, texts: Iterable[Leaf]) -> bool:
    """Returns whether one of these texts looks like JSON, or is not in the columns."""
    zones = ((leaf, values.zone(leaf)) for leaf in texts)
    possible = [leaf for leaf, zone in zones if zone is None or zone.may_be_json]
    try:
        return any(looks_like_json(word) for leaf in possible for word in values.texts(leaf).words)
    except UnknownShapeError:
        return True


Points: TypeAlias = "np.ndarray[tuple[int, int], np.dtype[np.float64]]"


class Detections(NamedTuple):
    """Detections by message, in a message in its order.

    Attributes:
        rows: the message of each, ascending.
        labels: their names.
        scores: their detector's own, in its own unit; NaN where it gives none.
        places: N x 3 (m), in the frame; NaN where the message has no place.
        frames: the frame of each, empty where the message names none.
    """

    rows: IntArray
    labels: Texts
    scores: Floats
    places: Points
    frames: Texts

    def at(self, rows: IntArray) -> Detections:
        """Returns those of some messages, which ascend and become the messages 0, 1, 2, ..."""
        message, is_among = places_among(self.rows, rows)
        return self._replace(rows=message).taken(is_among)

    def taken(self, which: IntArray | Mask) -> Detections:
        """Returns some of them."""
        rows, labels, scores, places, frames = self
        return Detections(
            rows[which],
            Texts(labels.codes[which], labels.words),
            scores[which],
            places[which],
            Texts(frames.codes[which], frames.words),
        )


class StampedDetections(NamedTuple):
    """The detections of some messages.

    Attributes:
        detections: by the place of their message among these.
        stamps: of the messages' headers (ns); None where they have none.
        frames: of the messages' headers, empty where they have none.
    """

    detections: Detections
    stamps: IntArray | None
    frames: Texts


class _Plan(NamedTuple):
    """Where a type has detections, and the frame and stamp (ns) of its header, one each at most."""

    sources: Sequence[Source]
    frames: Sequence[Leaf]
    stamps: Sequence[Leaf]

    @classmethod
    def of(cls, shape: Shape) -> _Plan:
        """Returns that of a type; raises `UnknownShapeError` where it depends on the message."""
        frame, stamp = (shape.at(("header", name)) for name in ("frame_id", "stamp"))
        frames = [frame] if isinstance(frame, Leaf) and frame.kind is Kind.TEXT else []
        is_time = isinstance(stamp, Leaf) and stamp.conversion is Conversion.SECONDS
        stamps = [Leaf(ROWS, ("header.stamp",), Kind.INTEGER)] if is_time else []
        return cls(sources_in(shape.value), frames, stamps)


class DetectionColumns:
    """Reads the detections of tables; remembers where they are in each type.

    Args:
        extractor: has the schema map.
    """

    def __init__(self, extractor: SchemaExtractor) -> None:
        self._plans = ByType(extractor, _Plan.of)

    def of(self, table: Table) -> StampedDetections | None:
        """Returns the detections of a table's messages; None where they have to be read."""
        plan, values = self._plans.of(table), Values(table)
        if plan is None:
            return None

        def read() -> StampedDetections:
            found = joined_detections(
                [part for source in plan.sources for part in found_in(values, source, places=True)]
            )
            frames = _frames_at(values, ROWS, np.arange(values.rows), plan.frames)
            own = Texts(frames.codes[found.rows], frames.words)
            found = found._replace(frames=or_else(found.frames, own))
            stamps = [values.numbers(leaf).values.astype(np.int64) for leaf in plan.stamps]
            return StampedDetections(found, stamps[0] if stamps else None, frames)

        try:
            return table.remember("detections", read, _bytes_of)
        except UnknownShapeError:
            return None

    def has_labels(self, table: Table) -> bool:
        """Returns whether the type of a table has fields for labels, not only texts."""
        plan = self._plans.of(table)
        return plan is None or any(not isinstance(source, Json) for source in plan.sources)

    def may_match(self, parts: PartZones) -> bool | Mask:
        """Returns in which parts a message may hold a detection, by their zones; or of all."""
        texts = self._only_texts(parts)
        if texts is None:
            return True
        possible: bool | Mask = False
        for leaf in texts:
            zone = zone_of(leaf, parts.zone)
            possible = possible | (True if zone is None else zone.may_be_json)
        return possible

    def may_have_any(self, table: Table) -> bool:
        """Returns whether a message of a table may hold a detection."""
        texts = self._only_texts(table)
        return texts is None or may_be_json(Values(table), texts)

    def _only_texts(self, table_or_parts: Table | PartZones) -> list[Leaf] | None:
        """Returns the texts of a type if it has detections in them alone; None if not so."""
        plan = self._plans.of(table_or_parts)
        if plan is None:
            return None
        texts = [source.leaf for source in plan.sources if isinstance(source, Json)]
        return texts if len(texts) == len(plan.sources) else None


def _bytes_of(stamped: StampedDetections) -> int:
    return 1000 + 60 * len(stamped.detections.rows) + 12 * len(stamped.frames)


def detections_by(by_message: Sequence[Sequence[Detection]]) -> Detections:
    """Returns the detections of messages that were read one by one."""
    numbered = [(row, found) for row, several in enumerate(by_message) for found in several]
    nowhere, none = (math.nan,) * 3, math.nan
    places = [nowhere if found.place is None else found.place for _, found in numbered]
    scores = [none if found.score is None else found.score for _, found in numbered]
    return Detections(
        np.array([row for row, _ in numbered], np.int64),
        Texts.of([found.label for _, found in numbered]),
        np.array(scores, np.float64),
        np.array(places, np.float64).reshape(-1, 3),
        Texts.of([found.frame_id for _, found in numbered]),
    )


def joined_detections(parts: Sequence[Detections]) -> Detections:
    """Returns the detections of all parts, by their messages."""
    if len(parts) == 1:
        return parts[0]
    if not parts:
        return detections_by(())
    rows = np.concatenate([part.rows for part in parts])
    order = np.argsort(rows, kind="stable")
    return Detections(
        rows[order],
        joined_texts([part.labels for part in parts]).rows(order),
        np.concatenate([part.scores for part in parts])[order],
        np.concatenate([part.places for part in parts])[order],
        joined_texts([part.frames for part in parts]).rows(order),
    )


def found_in(values: Values, source: Source, *, places: bool) -> Iterator[Detections]:
    """Yields the detections at one place of the messages of a table.

    Without `places` neither places nor frames are read.

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
    """Returns the labels of lists that are not empty, without a score."""
    texts = values.texts(leaf)
    is_label = np.array([bool(word) for word in texts.words], np.bool_)
    positions = np.flatnonzero(is_label[texts.codes])
    named = NamedScores(texts, np.full(len(texts), math.nan), 0.0)
    return _detections_at(values, leaf.level, positions, named.at(positions))


def _in_objects(values: Values, source: Labels, *, places: bool) -> Detections:
    """Returns the objects that have a name, with their scores; raises as `found_in`."""
    positions, named = source.read(values)
    which = np.flatnonzero(named.is_named)
    if which.size < values.size(source.level) and any(
        detections.rows.size
        for inner in source.otherwise
        for detections in found_in(values, inner, places=False)
    ):
        raise UnknownShapeError("some objects are detections, and some have such in them")
    positions = positions[which]
    detections = _detections_at(values, source.scored.level, positions, named.at(which))
    return _placed(values, source, positions, detections) if places else detections


def _detections_at(
    values: Values, level: Level, positions: IntArray, named: NamedScores
) -> Detections:
    """Returns the detections at some positions of a level, by their rows, without a place."""
    return Detections(
        _owners_at(values, level, positions, ROWS),
        named.name,
        named.score,
        np.full((positions.size, 3), math.nan),
        _no_frames(positions.size),
    )


def _no_frames(count: int) -> Texts:
    return Texts(np.zeros(count, np.uint32), ("",))


def _in_json(values: Values, source: Json) -> Iterator[Detections]:
    """Yields the detections in texts that are JSON, each of which is parsed once."""
    if not may_be_json(values, [source.leaf]):
        return
    texts = values.texts(source.leaf)
    parsed = values.table.remember(
        f"JSON of depth {source.depth} in {source.leaf.level.full(source.leaf.sources[0])}",
        lambda: detections_by([detections_of(word, depth=source.depth) for word in texts.words]),
        lambda detections: 1000 + 100 * detections.rows.size,
    )
    if not parsed.rows.size:
        return
    counts, nth = entries_of_codes(parsed.rows, texts.codes.astype(np.int64))
    positions = np.repeat(np.arange(len(texts)), counts)
    rows = _owners_at(values, source.leaf.level, positions, ROWS)
    found = parsed.taken(nth)._replace(rows=rows)
    frames = _frames_at(values, source.leaf.level, positions, source.frames)
    yield found._replace(frames=or_else(found.frames, frames))


def _placed(
    values: Values, source: Labels, positions: IntArray, detections: Detections
) -> Detections:
    """Returns detections at the first valid point of each; NaN where it has none."""
    if source.points is None:
        raise UnknownShapeError("points are of another shape in each message")
    level, places = source.scored.level, detections.places
    frames = _frames_at(values, level, positions, source.frames)
    for point in source.points:
        at = _owners_at(values, level, positions, point.axes[0].level)
        axes = [values.numbers(leaf).values[at] for leaf in point.axes]
        place = np.stack(axes, axis=1).astype(np.float64)
        # All zeros means that nobody filled it in.
        is_given = np.isfinite(place).all(axis=1) & place.any(axis=1)
        is_given &= np.isnan(places[:, 0])
        places = np.where(is_given[:, None], place, places)
        own = _frames_at(values, level, positions, point.frames)
        codes = np.where(is_given, own.codes + 1, 0).astype(np.uint32)
        frames = or_else(Texts(codes, ("", *own.words)), frames)
    return detections._replace(places=places, frames=frames)


def _frames_at(values: Values, level: Level, positions: IntArray, leaves: Sequence[Leaf]) -> Texts:
    """Returns the frame of each detection: what the innermost object around it names."""
    frames = _no_frames(positions.size)
    for leaf in leaves:
        texts = values.texts(leaf)
        codes = texts.codes[_owners_at(values, level, positions, leaf.level)]
        frames = or_else(Texts(codes, texts.words), frames)
    return frames


def _owners_at(values: Values, level: Level, positions: IntArray, outer: Level) -> IntArray:
    """Returns, of some elements of a level, the elements or rows around them."""
    while level != outer and level.parent is not None:
        positions, level = values.elements(level).owners[positions], level.parent
    return positions
