"""Where the messages of a type may have detections, as trees over columns.

`sources_in` goes where `messages.detections.detections_of` goes: as deep, by the same names.
`without_low` leaves of a value what `without_low_scores` leaves: null is in place of a detection of
a low score, or of one of its hypotheses. Where an object has no name in some messages, and so is no
detection there, the limits say that they do not know.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.columns.limits import Limit, TruthValues
from ros2_memory.columns.shown import UNKNOWN, Listing, Node, narrowed
from ros2_memory.columns.table import Texts
from ros2_memory.columns.values import Kind, Leaf, Level, UnknownShapeError
from ros2_memory.core.text import LISTS_OF_LABELS
from ros2_memory.messages.detections import MAX_DEPTH, POSITIONS, SCORES, looks_like_json, naming

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from ros2_memory.columns.values import Values
    from ros2_memory.core.arrays import Floats
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
    names = tuple(naming(fields.keys()))
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
    try:
        return any(looks_like_json(word) for leaf in texts for word in values.texts(leaf).words)
    except UnknownShapeError:
        return True
