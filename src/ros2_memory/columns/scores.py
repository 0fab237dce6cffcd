"""Values without the detections of a low score, as trees over columns.

The same as `messages.detections.without_low_scores` leaves of each value: it goes as deep, knows
the same names, and puts null in place of a detection (or of one of its hypotheses). Where the
messages of a type differ in whether an object is a detection at all (its label is empty in some),
and more would have to be looked at then, the limits say that they do not know.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ros2_memory.columns.shown import (
    Choice,
    Limit,
    Listing,
    Narrowed,
    Node,
    Object,
    Spot,
    TruthValues,
    is_object,
    leaves_below,
    opened,
)
from ros2_memory.columns.table import Texts
from ros2_memory.columns.values import Kind, Leaf, Level, UnknownShapeError
from ros2_memory.messages.detections import MAX_DEPTH, SCORES, looks_like_json, naming

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from ros2_memory.columns.values import Floats, Ints, Mask, Values


class NamedScores(NamedTuple):
    """The name (blank: none) and the score (NaN: none) of each object, and the error of scores."""

    name: Texts
    score: Floats
    error: float

    @property
    def is_named(self) -> Mask:
        """Which objects have a name."""
        return np.array([bool(word.strip()) for word in self.name.words], np.bool_)[self.name.codes]


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
        """Returns the names and scores of all; raises `UnknownShapeError` where not held."""
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


def _limit_of_all(level: Level, find: Callable[[Values], TruthValues]) -> Limit:
    """Returns a limit on the detections of a level, which is found once for each table."""

    def some(values: Values, positions: Ints) -> TruthValues:
        surely, perhaps = values.once(limit, find)
        return TruthValues(surely[positions], perhaps[positions])

    limit = Limit(level, some, is_of_scores=True)
    return limit


def _own_limit(objects: Scored, least: float, may_have_more: Callable[[Values], bool]) -> Limit:
    """Returns the limit to detections that score enough.

    Args:
        objects: that may be detections.
        least: the least score that is enough.
        may_have_more: whether there may be detections in those that are none.
    """

    def find(values: Values) -> TruthValues:
        named = objects.read(values)
        surely = ~(named.is_named & (named.score < least + named.error))
        if may_have_more(values):
            surely &= named.is_named
        return TruthValues(surely, ~(named.is_named & (named.score < least - named.error)))

    return _limit_of_all(objects.level, find)


def _best_limit(
    level: Level, results: Scored, least: float, may_have_more: Callable[[Values], bool]
) -> Limit:
    """Returns the limit to detections whose best hypothesis scores enough (vision_msgs)."""

    def find(values: Values) -> TruthValues:
        size = values.size(level)
        named, owners = _exact(values, results)
        order, begins = ranked(named.score, owners)
        best = order[begins]
        is_named, is_low = named.is_named[best], named.score[best] < least
        surely, perhaps = np.full(size, not may_have_more(values)), np.ones(size, np.bool_)
        surely[owners[best]] = is_named & ~is_low
        perhaps[owners[best]] = ~(is_named & is_low)
        return TruthValues(surely, perhaps)

    return _limit_of_all(level, find)


def _hypothesis_limit(best: Limit, results: Scored, least: float) -> Limit:
    """Returns the limit to hypotheses that score enough, in a detection that stays."""

    def find(values: Values, positions: Ints) -> TruthValues:
        named, owners = _exact(values, results)
        # Where it is not sure that the detection is one, neither is what stays of it.
        is_detection = best.kept(values, owners[positions]).surely
        is_low = named.score[positions] < least
        return TruthValues(~is_low & is_detection, ~is_low | ~is_detection)

    return Limit(results.level, find)


def _exact(values: Values, results: Scored) -> tuple[NamedScores, Ints]:
    """Returns hypotheses and their detections; raises `UnknownShapeError` where not exact."""
    named = results.read(values)
    if named.error:
        raise UnknownShapeError("with rounded scores another one may be the best")
    return named, values.elements(results.level).owners


def without_low(node: Node, least: float, depth: int = MAX_DEPTH) -> Node:
    """Returns a value's tree without the detections whose score is below a limit.

    Raises:
        UnknownShapeError: it depends on the message.
    """
    if depth == 0:
        return node
    if isinstance(node, Narrowed):
        return Narrowed(node.limit, without_low(node.node, least, depth))
    if isinstance(node, Choice):
        return Choice(tuple(without_low(case, least, depth) for case in node.cases), node.array)
    if isinstance(node, Listing):
        # In lists, `without_low_scores` looks at objects alone.
        has_objects = all(is_object(spot.node) for spot in opened(Spot(node.element)))
        inner = without_low(node.element, least, depth - 1) if has_objects else node.element
        return Listing(node.level, inner)
    if isinstance(node, Leaf) and node.kind is Kind.TEXT:
        return node._replace(json_depth=depth)
    return _object_without_low(node, least, depth) if is_object(node) else node


def _object_without_low(node: Object, least: float, depth: int) -> Node:
    fields = node.fields
    single, several, results = scored(fields), hypotheses(fields), fields.get("results")
    if single is not None:
        return Narrowed(_own_limit(single, least, _may_have_more(fields, depth)), node)
    if isinstance(results, Listing) and several is not None:
        others = {name: child for name, child in fields.items() if name != "results"}
        level = several.level.parent or several.level
        best = _best_limit(level, several, least, _may_have_more(others, depth))
        kept = Narrowed(_hypothesis_limit(best, several, least), results.element)
        shown = node._replace(fields={**fields, "results": Listing(results.level, kept)})
        return Narrowed(best, shown)
    inner = {name: without_low(child, least, depth - 1) for name, child in fields.items()}
    return node._replace(fields=inner)


def hypotheses(fields: Mapping[str, Node]) -> Scored | None:
    """Returns how the hypotheses of a detection are named and scored (vision_msgs); None: none."""
    results = fields.get("results")
    if not isinstance(results, Listing) or not isinstance(results.element, Object):
        return None
    inner = results.element.fields
    named = inner.get("hypothesis")
    return scored(named.fields if isinstance(named, Object) else inner)


def scored(fields: Mapping[str, Node]) -> Scored | None:
    """Returns how an object is named and scored; None if none like it is a detection."""
    names = naming(fields.keys())
    labels = _leaves(fields, names, Kind.TEXT) + _leaves(fields, names, Kind.INTEGER)
    scores = _leaves(fields, SCORES, Kind.INTEGER, Kind.REAL)
    return Scored(labels[0].level, labels, scores) if labels else None


def _leaves(fields: Mapping[str, Node], names: tuple[str, ...], *kinds: Kind) -> tuple[Leaf, ...]:
    nodes = [fields[name] for name in names if name in fields]
    return tuple(node for node in nodes if isinstance(node, Leaf) and node.kind in kinds)


def _may_have_more(fields: Mapping[str, Node], depth: int) -> Callable[[Values], bool]:
    """Returns what says whether there may be detections in the fields of an object."""
    texts: list[Leaf] = []
    for node in fields.values():
        # Any limit on scores will do: where one is shows where a detection is.
        limited = without_low(node, 0.0, depth - 1)
        for _, leaf, limits in leaves_below(Spot(limited)):
            if any(limit.is_of_scores for limit in limits):
                return lambda _: True
            if leaf.json_depth:
                texts.append(leaf)
    return lambda values: may_be_json(values, texts)


def may_be_json(values: Values, texts: Iterable[Leaf]) -> bool:
    """Returns whether one of these texts looks like JSON, or is not held."""
    try:
        return any(looks_like_json(word) for leaf in texts for word in values.texts(leaf).words)
    except UnknownShapeError:
        return True


def ranked(score: Floats, owners: Ints) -> tuple[Ints, Mask]:
    """Returns the order of hypotheses by detection, the best first, and which begin one there.

    Of those of one score the first comes first; without a score, last.
    """
    rank = np.where(np.isnan(score), -np.inf, score)
    order = np.lexsort((-rank, owners))
    return order, np.diff(owners[order], prepend=-1) != 0
