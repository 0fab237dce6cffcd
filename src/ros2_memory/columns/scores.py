"""Values without the detections of a low score, as trees over columns.

The same as `messages.detections.without_low_scores` leaves of each value: it goes as deep, knows
the same names, and puts null in place of a detection (or of one of its hypotheses). Where the
messages of a type differ in whether an object is a detection at all (its label is empty in some),
and more would have to be looked at then, the limits say that they do not know.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, TypeGuard

import numpy as np

from ros2_memory.columns.shown import (
    Choice,
    Group,
    Listing,
    Message,
    Narrowed,
    Node,
    Spot,
    TruthValues,
    children,
    leaves_below,
    opened,
    unknown,
)
from ros2_memory.columns.table import Texts
from ros2_memory.columns.values import Kind, Leaf, Level
from ros2_memory.messages.detections import MAX_DEPTH, SCORES, looks_like_json, naming

if TYPE_CHECKING:
    from collections.abc import Mapping

    from ros2_memory.columns.values import Floats, Ints, Mask, Values

Object: TypeAlias = Message | Group


class NamedScores(NamedTuple):
    """The name (blank: none) and the score (NaN: none) of each object, and the error of scores."""

    name: Texts
    score: Floats
    error: float


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """An object that may be a detection: what names it, in order, and what its score is.

    Attributes:
        level: where it lies.
        labels: texts and then whole numbers, the first of which that is not blank names it.
        scores: numbers, of which the first that is known is its score.
    """

    level: Level
    labels: tuple[Leaf, ...]
    scores: tuple[Leaf, ...]

    def read(self, values: Values) -> NamedScores | None:
        """Returns the names and scores of all; None where the table does not hold them."""
        name, *fallbacks = (_names(values, leaf) for leaf in self.labels)
        for fallback in fallbacks:
            name = None if name is None or fallback is None else or_else(name, fallback, blank=True)
        if name is None:
            return None
        score, error = np.full(len(name), np.nan), 0.0
        for leaf in self.scores:
            numbers = values.numbers(leaf)
            if numbers is None or not isinstance(numbers.error, float):
                return None
            column = numbers.values.astype(np.float64, copy=False)
            score = np.where(np.isnan(score), column, score)
            error = max(error, numbers.error)
        return NamedScores(name, score, error)


def _names(values: Values, leaf: Leaf) -> Texts | None:
    """Returns the texts of a leaf, or its whole numbers as such; None where they are not held."""
    if leaf.kind is Kind.TEXT:
        return values.texts(leaf)
    numbers = values.numbers(leaf)
    return None if numbers is None else Texts.of([*map(str, numbers.values.tolist())])


def or_else(texts: Texts, fallback: Texts, *, blank: bool = False) -> Texts:
    """Returns each of some texts, or another where it is empty (or `blank`)."""
    is_none = [not (word.strip() if blank else word) for word in texts.words]
    if not any(is_none):
        return texts
    codes = np.where(np.array(is_none)[texts.codes], fallback.codes + len(texts.words), texts.codes)
    return Texts(codes.astype(np.uint32), (*texts.words, *fallback.words))


@dataclass(frozen=True, slots=True, eq=False)
class _ScoreLimit(ABC):
    """Which detections of a level stay; that is found once for each table."""

    level: Level
    scored: Scored
    least: float
    texts: tuple[Leaf, ...]
    has_inner: bool

    def kept(self, values: Values, positions: Ints) -> TruthValues:
        """Returns where the detection stays."""
        if self not in values.kept:
            values.kept[self] = self._all_kept(values)
        surely, perhaps = values.kept[self]
        return TruthValues(surely[positions], perhaps[positions])

    @abstractmethod
    def _all_kept(self, values: Values) -> TruthValues:
        """Returns where the detections of a table stay."""


class _OwnScoreLimit(_ScoreLimit):
    """Which detections score enough."""

    def _all_kept(self, values: Values) -> TruthValues:
        named = self.scored.read(values)
        if named is None:
            return unknown(values.size(self.level) or 0)
        name, score, error = named
        is_labelled = _has_label(name)
        surely = ~(is_labelled & (score < self.least + error))
        perhaps = ~(is_labelled & (score < self.least - error))
        if self.has_inner or may_be_json(values, self.texts):
            surely &= is_labelled
        return TruthValues(surely, perhaps)


class _BestScoreLimit(_ScoreLimit):
    """Which detections stay that are named by the best of several hypotheses (vision_msgs)."""

    def _all_kept(self, values: Values) -> TruthValues:
        size = values.size(self.level) or 0
        named, results = self.scored.read(values), values.elements(self.scored.level)
        if named is None or results is None or named.error:
            return unknown(size)  # also with rounded scores, of which another may be the best
        is_labelled = _has_label(named.name)
        order, begins = ranked(named.score, results.owners)
        best = order[begins]
        detections = results.owners[best]
        surely, perhaps = np.ones(size, np.bool_), np.ones(size, np.bool_)
        if self.has_inner or may_be_json(values, self.texts):
            surely[:] = False
        is_low = named.score[best] < self.least
        surely[detections] = is_labelled[best] & ~is_low
        perhaps[detections] = ~(is_labelled[best] & is_low)
        return TruthValues(surely, perhaps)


@dataclass(frozen=True, slots=True, eq=False)
class _HypothesisLimit:
    """Which of several hypotheses stay, in a detection that stays."""

    best: _BestScoreLimit

    @property
    def level(self) -> Level:
        """The level of the hypotheses."""
        return self.best.scored.level

    def kept(self, values: Values, positions: Ints) -> TruthValues:
        """Returns where the hypothesis stays."""
        named, results = self.best.scored.read(values), values.elements(self.level)
        if named is None or named.error or results is None:
            return unknown(len(positions))
        # Where it is not sure that the detection is one, neither is what stays of it.
        is_detection = self.best.kept(values, results.owners[positions]).surely
        is_low = named.score[positions] < self.best.least
        return TruthValues(~is_low & is_detection, ~is_low | ~is_detection)


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
        return replace(node, json_depth=depth)
    return _object_without_low(node, least, depth) if is_object(node) else node


def is_object(node: Node) -> TypeGuard[Object]:
    """Returns whether a node is an object that may be a detection, or have some in it."""
    return isinstance(node, Message) or (isinstance(node, Group) and node.turned is None)


def _object_without_low(node: Object, least: float, depth: int) -> Node:
    fields = dict(children(node))
    single = scored(fields)
    if single is not None:
        return Narrowed(
            _OwnScoreLimit(single.level, single, least, *_inner_detections(fields, depth)), node
        )
    results, several = fields.get("results"), hypotheses(fields)
    if isinstance(results, Listing) and several is not None:
        others = {name: child for name, child in fields.items() if name != "results"}
        texts, has_inner = _inner_detections(others, depth)
        best = _BestScoreLimit(
            several.level.parent or several.level, several, least, texts, has_inner
        )
        kept = Narrowed(_HypothesisLimit(best), results.element)
        return Narrowed(best, Group({**fields, "results": Listing(results.level, kept)}))
    kept_fields = {name: without_low(child, least, depth - 1) for name, child in fields.items()}
    return replace(node, fields=kept_fields) if isinstance(node, Group) else Group(kept_fields)


def hypotheses(fields: Mapping[str, Node]) -> Scored | None:
    """Returns how the hypotheses of a detection are named and scored (vision_msgs); None: none."""
    results = fields.get("results")
    if not isinstance(results, Listing) or not isinstance(results.element, Message | Group):
        return None
    inner = dict(children(results.element))
    named = inner.get("hypothesis")
    return scored(dict(children(named)) if isinstance(named, Message | Group) else inner)


def scored(fields: Mapping[str, Node]) -> Scored | None:
    """Returns how an object is named and scored; None if none like it is a detection."""
    names = naming(fields.keys())
    labels = _leaves(fields, names, Kind.TEXT) + _leaves(fields, names, Kind.INTEGER)
    scores = _leaves(fields, SCORES, Kind.INTEGER, Kind.REAL)
    return Scored(labels[0].level, labels, scores) if labels else None


def _leaves(fields: Mapping[str, Node], names: tuple[str, ...], *kinds: Kind) -> tuple[Leaf, ...]:
    nodes = [fields[name] for name in names if name in fields]
    return tuple(node for node in nodes if isinstance(node, Leaf) and node.kind in kinds)


def _inner_detections(fields: Mapping[str, Node], depth: int) -> tuple[tuple[Leaf, ...], bool]:
    """Returns the texts in an object that may be JSON, and whether there are detections in it.

    No texts where there are: they decide nothing then.
    """
    texts: list[Leaf] = []
    for node in fields.values():
        # Any limit on scores will do: where one is shows where a detection is.
        limited = without_low(node, 0.0, depth - 1)
        for _, leaf, limits in leaves_below(Spot(limited)):
            if any(isinstance(limit, _ScoreLimit) for limit in limits):
                return (), True
            if leaf.json_depth:
                texts.append(leaf)
    return tuple(texts), False


def may_be_json(values: Values, texts: tuple[Leaf, ...]) -> bool:
    """Returns whether one of these texts looks like JSON, or is not held."""
    columns = [values.texts(leaf) for leaf in texts]
    return any(column is None or any(map(looks_like_json, column.words)) for column in columns)


def ranked(score: Floats, owners: Ints) -> tuple[Ints, Mask]:
    """Returns the order of hypotheses by detection, the best first, and which begin one there.

    Of those of one score the first comes first; without a score, last.
    """
    rank = np.where(np.isnan(score), -np.inf, score)
    order = np.lexsort((-rank, owners))
    return order, np.diff(owners[order], prepend=-1) != 0


def _has_label(name: Texts) -> Mask:
    return np.array([bool(word.strip()) for word in name.words], np.bool_)[name.codes]
