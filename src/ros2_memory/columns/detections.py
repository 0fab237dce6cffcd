"""The detections in the messages of a table, from its columns alone.

The same as `messages.detections.detections_of` finds in each extracted value: it goes where that
goes. Where the columns do not settle it (a shape that differs from message to message) the messages
have to be read.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.columns.plan import fields_at
from ros2_memory.columns.scores import NamedScores, Scored, hypotheses, or_else, ranked, scored
from ros2_memory.columns.shown import (
    ByType,
    Items,
    Listing,
    Narrowed,
    Node,
    Nothing,
    Object,
    is_object,
)
from ros2_memory.columns.table import Table, Texts, joined_texts
from ros2_memory.columns.values import ROWS, Kind, Leaf, UnknownShapeError, Values, zone_of
from ros2_memory.columns.walk import entries_of_codes
from ros2_memory.core.text import LISTS_OF_LABELS
from ros2_memory.messages.detections import MAX_DEPTH, POSITIONS, Detection, detections_of
from ros2_memory.storage.base import Definition

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ros2_memory.columns.values import Floats, Ints, Level, Mask
    from ros2_memory.columns.zones import PartZones
    from ros2_memory.extract import SchemaExtractor

Points: TypeAlias = "np.ndarray[tuple[int, int], np.dtype[np.float64]]"
_STAMP: Final = "builtin_interfaces/msg/Time"


class Detections(NamedTuple):
    """Detections by message, in a message in its order.

    Attributes:
        rows: the message of each, ascending.
        labels: their names.
        scores: their detector's own, in its own unit; NaN where it gives none.
        places: N x 3 (m), in the frame; NaN where the message has no place.
        frames: the frame of each, empty where the message names none.
    """

    rows: Ints
    labels: Texts
    scores: Floats
    places: Points
    frames: Texts

    def at(self, rows: Ints) -> Detections:
        """Returns those of some messages, which ascend and become the messages 0, 1, 2, ..."""
        message = np.searchsorted(rows, self.rows)
        is_among = message < rows.size
        is_among[is_among] = rows[message[is_among]] == self.rows[is_among]
        return self._replace(rows=message).taken(is_among)

    def taken(self, which: Ints | Mask) -> Detections:
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
    stamps: Ints | None
    frames: Texts


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


class Words(NamedTuple):
    """A list of labels."""

    leaf: Leaf


class Json(NamedTuple):
    """A text that may be JSON, and how deep detections are looked for in it."""

    leaf: Leaf
    depth: int
    frames: tuple[Leaf, ...]


Source: TypeAlias = Labels | Words | Json


class DetectionColumns:
    """Reads the detections of tables; remembers where they are in each type.

    Args:
        extractor: has the schema map.
    """

    def __init__(self, extractor: SchemaExtractor) -> None:
        self._sources = ByType(extractor, lambda shape: tuple(sources_in(shape.value)))

    def of(self, table: Table) -> StampedDetections | None:
        """Returns the detections of a table's messages; None where they have to be read."""
        definition, sources = table.definition, self._sources.of(table)
        if definition is None or sources is None:
            return None

        def found() -> StampedDetections:
            values = Values(table)
            header_frames = _header_frames(definition)
            detections = joined_detections(
                [part for source in sources for part in found_in(values, source, places=True)]
            )
            frames = _frames_at(values, ROWS, detections.rows, header_frames)
            return StampedDetections(
                detections._replace(frames=or_else(detections.frames, frames)),
                _stamps(values, definition),
                _frames_at(values, ROWS, np.arange(values.rows), header_frames),
            )

        try:
            return table.remember("detections", found, _bytes_of)
        except UnknownShapeError:
            return None

    def has_labels(self, table: Table) -> bool:
        """Returns whether the type of a table has fields for labels, not only texts."""
        sources = self._sources.of(table)
        return sources is None or any(not isinstance(source, Json) for source in sources)

    def may_match(self, table_or_parts: Table | PartZones) -> bool | Mask:
        """Returns whether a message may hold a detection, as known without reading a column.

        Of several parts for each of them, or for all.
        """
        sources = self._sources.of(table_or_parts)
        possible: bool | Mask = sources is None
        for source in sources or ():
            if not isinstance(source, Json):
                return True
            possible = possible | _may_be_json(table_or_parts, source.leaf)
        return possible


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


# Where a type has detections


def sources_in(
    node: Node, depth: int = MAX_DEPTH, frames: tuple[Leaf, ...] = ()
) -> Iterator[Source]:
    """Yields where detections may be in a value; it goes where `detections_of` goes.

    Raises:
        UnknownShapeError: that depends on the message.
    """
    if depth == 0:
        return
    if isinstance(node, Narrowed):
        raise UnknownShapeError("an element of a list stands alone")
    if isinstance(node, Leaf):
        if node.kind is Kind.TEXT:
            yield Json(node, depth, frames)
    elif isinstance(node, Listing):
        if is_object(node.element) or isinstance(node.element, Narrowed):
            yield from sources_in(node.element, depth - 1, frames)
    elif is_object(node):
        yield from _sources_in_object(node.fields, depth, frames)


def _sources_in_object(
    fields: Mapping[str, Node], depth: int, frames: tuple[Leaf, ...]
) -> Iterator[Source]:
    named, several, results = scored(fields), hypotheses(fields), fields.get("results")
    frames = (*frames, *_frame_leaves(fields))
    inner = tuple(_sources_in_fields(fields, depth, frames))
    if named is not None:
        yield Labels(named, inner, frames, _points(fields))
    elif several is not None and isinstance(results, Listing) and is_object(results.element):
        best_points, points = _points(results.element.fields), _points(fields)
        is_known = best_points is not None and points is not None
        both = (*(best_points or ()), *(points or ())) if is_known else None
        yield Labels(several, inner, frames, both, is_best=True)
    else:
        yield from inner


def _sources_in_fields(
    fields: Mapping[str, Node], depth: int, frames: tuple[Leaf, ...]
) -> Iterator[Source]:
    for name, node in fields.items():
        element = node.element if isinstance(node, Listing) else None
        if name in LISTS_OF_LABELS and isinstance(element, Leaf) and element.kind is Kind.TEXT:
            yield Words(element)
        yield from sources_in(node, depth - 1, frames)


def _frame_leaves(fields: Mapping[str, Node]) -> Iterator[Leaf]:
    header = fields.get("header")
    leaf = (header.fields if isinstance(header, Object) else fields).get("frame_id")
    if isinstance(leaf, Leaf) and leaf.kind is Kind.TEXT:
        yield leaf


def _points(fields: Mapping[str, Node]) -> tuple[Point, ...] | None:
    """Returns where an object may have its place, first choice first; None: it depends."""
    points: list[Point] = []
    for path in POSITIONS:
        node: Node | None = Object(fields)
        frames: list[Leaf] = []
        for name in path:
            node = node.fields.get(name) if is_object(node) else None
            if is_object(node):
                frames += _frame_leaves(node.fields)
        if node is None or isinstance(node, Leaf | Nothing):
            continue
        if isinstance(node, Items):
            axes: list[Node] = [*node.items]
        elif isinstance(node, Object):
            axes = [node.fields[axis] for axis in "xyz" if axis in node.fields]
        else:
            return None
        leaves = [axis for axis in axes if isinstance(axis, Leaf)]
        if len(leaves) < len(axes):
            return None
        if len(leaves) == 3 and all(leaf.is_number for leaf in leaves):
            points.append(Point(tuple(leaves), tuple(frames)))
    return tuple(points)


# What a table holds


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
    return _detections_at(values, leaf.level, texts, positions, np.full(len(texts), math.nan))


def _in_objects(values: Values, source: Labels, *, places: bool) -> Detections:
    """Returns the objects that have a name, with their scores; raises as `found_in`."""
    level, named = source.scored.level, source.scored.read(values)
    positions, size = np.arange(len(named.name)), len(named.name)
    if source.is_best:
        positions = _best_hypotheses(named, values.elements(level).owners)
        size = values.size(level.parent or level)
    positions = positions[named.is_named[positions]]
    if positions.size < size and any(
        detections.rows.size
        for inner in source.otherwise
        for detections in found_in(values, inner, places=False)
    ):
        raise UnknownShapeError("some objects are detections, and some have such in them")
    detections = _detections_at(values, level, named.name, positions, named.score)
    return _placed(values, source, positions, detections) if places else detections


def _detections_at(
    values: Values, level: Level, names: Texts, positions: Ints, scores: Floats
) -> Detections:
    """Returns the detections at some positions of a level, by their rows, without a place."""
    return Detections(
        _owners_at(values, level, positions, ROWS),
        Texts(names.codes[positions], names.words),
        scores[positions],
        np.full((positions.size, 3), math.nan),
        _no_frames(positions.size),
    )


def _no_frames(count: int) -> Texts:
    return Texts(np.zeros(count, np.uint32), ("",))


def _may_be_json(table_or_parts: Table | PartZones, leaf: Leaf) -> bool | Mask:
    """Returns whether a text may be JSON, by its zone, or in which parts by their zones."""
    zone = zone_of(leaf, table_or_parts.zone)
    return True if zone is None else zone.may_be_json


def _in_json(values: Values, source: Json) -> Iterator[Detections]:
    """Yields the detections in texts that are JSON, each of which is parsed once."""
    if not _may_be_json(values.table, source.leaf):
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


def _best_hypotheses(named: NamedScores, owners: Ints) -> Ints:
    """Returns the first of the hypotheses of the highest score, for each detection.

    Raises:
        UnknownShapeError: they were rounded, so that another may be the best.
    """
    order, begins = ranked(named.score, owners)
    best: Ints = order[begins]
    if named.error:
        follows = np.flatnonzero(begins[:-1] & ~begins[1:])
        score, codes = named.score[order], named.name.codes[order]
        with np.errstate(invalid="ignore"):  # infinity less infinity
            is_close = score[follows] - score[follows + 1] <= 2 * named.error
        if (is_close & (codes[follows] != codes[follows + 1])).any():
            raise UnknownShapeError("another hypothesis may be the best")
    return best


def _placed(values: Values, source: Labels, positions: Ints, detections: Detections) -> Detections:
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


def _frames_at(values: Values, level: Level, positions: Ints, leaves: Sequence[Leaf]) -> Texts:
    """Returns the frame of each detection: what the innermost object around it names."""
    frames = _no_frames(positions.size)
    for leaf in leaves:
        texts = values.texts(leaf)
        codes = texts.codes[_owners_at(values, level, positions, leaf.level)]
        frames = or_else(Texts(codes, texts.words), frames)
    return frames


def _owners_at(values: Values, level: Level, positions: Ints, outer: Level) -> Ints:
    """Returns, of some elements of a level, the elements or rows around them."""
    while level != outer and level.parent is not None:
        positions, level = values.elements(level).owners[positions], level.parent
    return positions


def _kind_at(definition: Definition, *path: str) -> str | Definition:
    """Returns what a field is; empty where there is no such field, or an array."""
    fields = fields_at(definition, path)
    is_there = len(fields) == len(path) and all(entry.length is None for entry in fields)
    return fields[-1].kind if is_there else ""


def _header_frames(definition: Definition) -> tuple[Leaf, ...]:
    """Returns the frame in a message's own header, if it has one."""
    if _kind_at(definition, "header", "frame_id") not in {"string", "wstring"}:
        return ()
    return (Leaf(ROWS, ("header.frame_id",), Kind.TEXT),)


def _stamps(values: Values, definition: Definition) -> Ints | None:
    kind = _kind_at(definition, "header", "stamp")
    if not isinstance(kind, Definition) or kind.type != _STAMP:
        return None
    stamps = values.numeric(ROWS, "header.stamp")
    if stamps is None:
        raise UnknownShapeError("stamps are not held")
    return stamps.astype(np.int64)
