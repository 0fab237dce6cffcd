"""The detections in the messages of a table, from its columns alone.

The same as `messages.detections.detections_of` finds in each extracted value: it goes where that
goes. Where the columns do not settle it (a shape that differs from message to message) the messages
have to be read.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.columns.shown import ByType, Shape
from ros2_memory.columns.sources import (
    Json,
    Labels,
    NamedScores,
    Source,
    Words,
    or_else,
    sources_in,
)
from ros2_memory.columns.table import Table, Texts, joined_texts
from ros2_memory.columns.values import (
    ROWS,
    Conversion,
    Kind,
    Leaf,
    UnknownShapeError,
    Values,
    zone_of,
)
from ros2_memory.columns.walk import entries_of_codes
from ros2_memory.core.arrays import Floats, places_among
from ros2_memory.messages.detections import Detection, detections_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.columns.values import Level
    from ros2_memory.columns.zones import PartZones
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import IntArray, Mask

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

    def may_match(self, table_or_parts: Table | PartZones) -> bool | Mask:
        """Returns whether a message may hold a detection, as known without reading a column.

        Of several parts for each of them, or for all.
        """
        plan = self._plans.of(table_or_parts)
        possible: bool | Mask = plan is None
        for source in () if plan is None else plan.sources:
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
