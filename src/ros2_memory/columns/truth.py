"""Which rows of a table meet a condition, from its columns alone.

The same as `Condition.matches(extractor.exact(message))` for each message. Where the columns do not
settle it (an array that is not held, a float that was rounded, a shape that differs from message to
message) a row is unsure, never wrong: then the bag decides.

What is known without unpacking a column (its zone) is looked at first.
"""

from __future__ import annotations

import math
from contextlib import suppress
from itertools import compress
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np

from ros2_memory.analysis.conditions import (
    Beyond,
    Condition,
    Contains,
    Equals,
    NearPosition,
    points,
)
from ros2_memory.columns.detections import may_be_json, without_low
from ros2_memory.columns.shown import NOTHING, ByType, Listing, Node, Shape, at_field, leaves_of
from ros2_memory.columns.stored import StoredTable
from ros2_memory.columns.table import MAX_NUMBERS, as_float
from ros2_memory.columns.values import (
    ROWS,
    Kind,
    Leaf,
    LeafNumbers,
    Level,
    Limit,
    TruthValues,
    UnknownShapeError,
    Values,
    nowhere,
    placed,
    unknown,
    zone_of,
)
from ros2_memory.core.text import looks_like_json
from ros2_memory.messages.conversions import names_beside
from ros2_memory.messages.detections import without_low_scores

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.columns.table import Table
    from ros2_memory.columns.values import Numeric, ZoneOf
    from ros2_memory.columns.zones import PartZones
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import Mask

_EXACT_BELOW: Final = 2**53
_ROUNDING: Final = 1e-9
"""How much a distance that numpy computes may differ, relative to the tolerance; far too much."""
_SHORT: Final = 200
_MOST_DECIDED: Final = 4_096
"""So many texts are remembered with whether they pass."""
_TINY_M: Final = 1e-150
"""The squares of shorter distances vanish."""

_Test: TypeAlias = "_LeafTest | _PlaceTest"


class ColumnCondition:
    """Tests one condition on tables; remembers what it means for each type that it met.

    Args:
        condition: what is asked.
        extractor: has the schema map.
    """

    def __init__(self, condition: Condition, extractor: SchemaExtractor) -> None:
        self._plans = ByType(
            extractor, lambda shape: _Plan.of(condition.of_type(shape.type, extractor), shape)
        )
        self._possible: dict[int, Sequence[_Test]] = {}

    def truth(self, table: Table) -> TruthValues:
        """Returns which rows of a table meet the condition."""
        plan, values = self._plans.of(table), Values(table)
        if plan is None:
            return unknown(values.rows)
        known = self._possible.get(table.number) if isinstance(table, StoredTable) else None
        whole = _possible(plan.whole, values) if known is None else known
        if plan.counted is None or not whole:
            return _any_of(whole, values)
        texts = tuple(
            t.leaf for t in plan.counted if isinstance(t, _LeafTest) and t.leaf.json_depth
        )
        counted = _any_of(_possible(plan.counted, values), values)
        if not may_be_json(values, texts):
            return counted
        # A text in which detections were left out is another text: both have to pass.
        met = _any_of(whole, values)
        return TruthValues(counted.surely & met.surely, counted.perhaps & met.perhaps)

    def unstated(self, table: Table) -> Mask:
        """Returns which rows say nothing of the field; see `Condition.is_unstated`.

        None of them where the columns do not show it.
        """
        plan, values = self._plans.of(table), Values(table)
        if plan is not None and plan.names is not None:
            with suppress(UnknownShapeError):
                names, elements = values.texts(plan.names), values.elements(plan.names.level)
                is_named = np.array([word == plan.element for word in names.words], np.bool_)
                counts = np.bincount(elements.owners, minlength=values.rows)
                own = np.bincount(elements.owners[is_named[names.codes]], minlength=values.rows)
                is_other: Mask = (counts > 0) & (own == 0)
                return is_other
        return np.zeros(values.rows, np.bool_)

    def may_match(self, parts: PartZones) -> bool | Mask:
        """Returns which parts may have a row that meets the condition, by their zones.

        By which of its tests is remembered: to look at the zones of one part takes as long.
        """
        plan = self._plans.of(parts)
        if plan is None:
            return True
        possible: list[Mask] = []
        for test in plan.whole:
            may_pass = test.may_match(lambda leaf: zone_of(leaf, parts.zone))
            if may_pass is True:
                return True
            possible.append(np.broadcast_to(may_pass, parts.numbers.size))
        if not possible:
            return False
        tests = ([*compress(plan.whole, passes)] for passes in np.transpose(possible).tolist())
        self._possible.update(zip(parts.numbers.tolist(), tests, strict=True))
        some: Mask = np.any(possible, axis=0)
        return some


class _Plan(NamedTuple):
    """What is tested on a value, and on the value without detections of a low score.

    Attributes:
        whole: on the value.
        counted: on the value without these; None where all detections count.
        names: of the elements where the field asks for an `element` by its name.
    """

    whole: Sequence[_Test]
    counted: Sequence[_Test] | None
    names: Leaf | None
    element: str

    @classmethod
    def of(cls, condition: Condition, shape: Shape) -> _Plan:
        """Returns what a condition tests on the value of a type.

        Raises:
            UnknownShapeError: it depends on the message.
        """
        whole, counted = _tests(condition, shape.value), None
        if condition.min_score > 0:
            counted = _tests(condition, without_low(shape.value, condition.least_score))
        listing = names_beside(shape.value, condition.field or "")
        names = listing.element if isinstance(listing, Listing) else None
        leaf = names if isinstance(names, Leaf) and names.kind is Kind.TEXT else None
        return cls(whole, counted, leaf, condition.element)


def _possible(tests: Sequence[_Test], values: Values) -> list[_Test]:
    """Returns the tests that some row may pass, as known without reading a column."""
    return [test for test in tests if test.may_match(values.zone)]


def _any_of(tests: Sequence[_Test], values: Values) -> TruthValues:
    """Returns which rows pass any of the tests."""
    surely, perhaps = nowhere(values.rows)
    for test in tests if values.rows else ():
        try:
            for level, passing, limits in test.passing(values):
                if level is ROWS and not limits:
                    surely |= passing.surely
                    perhaps |= passing.perhaps
                    continue
                certain, possible = map(np.flatnonzero, passing)
                surely[placed(values, level, certain, limits, surely=True)[1]] = True
                perhaps[placed(values, level, possible, limits, surely=False)[1]] = True
        except UnknownShapeError:
            return TruthValues(surely, unknown(values.rows).perhaps)
        if surely.all():
            break
    return TruthValues(surely, perhaps | surely)


def _tests(condition: Condition, value: Node) -> list[_Test]:
    test, field = condition.test, condition.field
    targets = [value] if field is None else at_field(value, field)
    tests: list[_Test] = []
    for target in targets:
        leaves = leaves_of(target)
        if isinstance(test, NearPosition):
            tests += _place_tests(test, target)
            continue
        # Elements of lists have no name of their own.
        elements = [] if field is None else leaves_of(target, in_objects=False)
        leaf_tests = (
            _LeafTest(test, leaf, leaf in elements, condition.least_score, {}) for leaf in leaves
        )
        tests += (leaf_test for leaf_test in leaf_tests if leaf_test.is_needed)
    return tests


class _LeafTest(NamedTuple):
    """`contains`, `equals`, `above` or `below`, on one leaf of a value.

    Attributes:
        test: what is asked.
        leaf: on which leaf.
        is_element: whether it is what a field leads to, or an element of that.
        least_score: for texts that are JSON.
        decided: whether texts pass that many parts have.
    """

    test: Contains | Equals | Beyond
    leaf: Leaf
    is_element: bool
    least_score: float
    decided: dict[str, bool]

    @property
    def numbers(self) -> tuple[int | float, ...]:
        """The numbers that are equal to a number of the leaf's kind."""
        if isinstance(self.test, Contains):
            equal = self.test.equal if self.is_element else None
        else:
            equal = self.test if isinstance(self.test, Equals) else None
        if equal is None:
            return ()
        return equal.numbers if self.leaf.kind is Kind.REAL else equal.integers

    @property
    def is_needed(self) -> bool:
        """Whether any value of the leaf's kind can pass."""
        if self.leaf.kind is Kind.TEXT:
            return self._folded is not None
        if self.leaf.kind is Kind.BOOLEAN:
            return self.passes(value=True) or self.passes(value=False)
        return isinstance(self.test, Beyond) or bool(self.numbers)

    def passes(self, value: bool | str) -> bool:
        """Returns whether a boolean or a text passes."""
        if self.test.passes(value):
            return True
        return isinstance(self.test, Contains) and self.is_element and self.test.equal.passes(value)

    def may_match(self, zone_of: ZoneOf[Leaf]) -> bool | Mask:
        """Returns whether some value may pass, as far as it is known without reading any."""
        zone = zone_of(self.leaf)
        if zone is None:
            return True
        if self.leaf.kind is Kind.TEXT:
            has = zone.may_have(self._folded or "")
            return has | zone.may_be_json if self.leaf.json_depth else has
        if self.leaf.kind is not Kind.BOOLEAN and isinstance(self.test, Beyond):
            return zone.reaches(self.test.limit, above=self.test.above)
        numbers: Sequence[float] = self.numbers
        if self.leaf.kind is Kind.BOOLEAN:
            numbers = [value for value in (False, True) if self.passes(value=value)]
        possible: bool | Mask = False
        for number in numbers:
            possible = possible | zone.spans(number)
        return possible

    def passing(self, values: Values) -> Iterator[tuple[Level, TruthValues, tuple[Limit, ...]]]:
        """Yields which rows or elements of a level pass.

        Raises:
            UnknownShapeError: the table cannot say.
        """
        leaf, around = self.leaf, self.leaf.level.parent
        if leaf.kind is Kind.TEXT:
            yield leaf.level, self._passing_texts(values), leaf.limits
        elif not leaf.is_of_array or around is None:
            yield leaf.level, self._passing_numbers(values.numbers(leaf)), leaf.limits
        else:
            is_held = values.numeric(leaf.level, "") is not None
            if is_held:
                yield leaf.level, self._passing_numbers(values.numbers(leaf)), leaf.limits
            yield from self._in_long_arrays(values, around, is_part=is_held)

    @property
    def _folded(self) -> str | None:
        return None if isinstance(self.test, Beyond) else self.test.folded

    def _passing_texts(self, values: Values) -> TruthValues:
        may = values.letters(self.leaf, self._folded or "")
        is_word = isinstance(self.test, Contains) and self.test.is_one_word
        if may is not None and (not may.any() or (is_word and not self.leaf.json_depth)):
            return TruthValues.known(may)
        try:
            codes, words = (texts := values.texts(self.leaf)).codes, texts.words
        except UnknownShapeError:
            if may is None:
                raise
            return TruthValues(np.zeros_like(may), may)
        if may is None:
            flags = [*map(self.decided.get, words)]
            if None in flags:  # else no call is needed for each
                flags = [*map(self._passes_text, words)]
        else:
            used = np.bincount(codes[may], minlength=len(words)) > 0
            flags = [
                is_used and self._passes_text(word)
                for word, is_used in zip(words, used.tolist(), strict=True)
            ]
        return TruthValues.known(np.array(flags, np.bool_)[codes])

    def _passes_text(self, word: str) -> bool:
        passes = self.decided.get(word)
        if passes is None:
            passes = self.passes(_without_low(word, self.least_score, self.leaf.json_depth))
            if len(word) <= _SHORT and len(self.decided) < _MOST_DECIDED:
                self.decided[word] = passes
        return passes

    def _passing_numbers(self, numbers: LeafNumbers) -> TruthValues:
        column, error, exactly = numbers
        if column.dtype.kind == "b":
            if_false, if_true = self.passes(value=False), self.passes(value=True)
            return TruthValues.known(np.where(column, if_true, if_false))
        passed = self._passing_exactly(column)
        if isinstance(error, float) and error == 0.0:
            return TruthValues.known(passed)
        is_near = np.isinf(error) | np.zeros(len(column), np.bool_)
        for bound in self._bounds:
            with np.errstate(invalid="ignore"):  # infinity less infinity
                is_near |= (np.abs(column - as_float(bound)) <= error) & (error > 0.0)
        if exactly is None:
            return TruthValues(passed & ~is_near, passed | is_near)
        unsettled = np.flatnonzero(is_near)
        passed[unsettled] = self._passing_exactly(exactly(unsettled))
        return TruthValues.known(passed)

    @property
    def _bounds(self) -> tuple[int | float, ...]:
        """The numbers next to which the test comes out differently."""
        if not isinstance(self.test, Beyond):
            return self.numbers
        return (self.test.limit, self.test.stored)

    def _passing_exactly(self, column: Numeric) -> Mask:
        if not isinstance(self.test, Beyond):
            return equal_to_any(column, self.numbers)
        passed = beyond(column, self.test.limit, above=self.test.above)
        if self.leaf.kind is Kind.REAL:
            passed &= ~equal_to_any(column, (self.test.stored,))
        return passed

    def _in_long_arrays(
        self, values: Values, level: Level, *, is_part: bool
    ) -> Iterator[tuple[Level, TruthValues, tuple[Limit, ...]]]:
        """Yields the rows or elements whose arrays are too long to be held, by what is known."""
        path = self.leaf.level.name
        lengths = values.numeric(level, f"{path}.length")
        if lengths is None:
            if is_part:
                return
            raise UnknownShapeError(f"{path} is not held")
        is_long = lengths > (MAX_NUMBERS if is_part else 0)
        if not is_long.any():
            return
        least, greatest = (values.numeric(level, f"{path}.{end}") for end in ("least", "greatest"))
        kept = unknown(len(lengths))
        if least is not None and greatest is not None and self.leaf.kind is not Kind.BOOLEAN:
            ends = [level.full(f"{path}.{end}") for end in ("least", "greatest")]
            error = max(values.table.error(end) for end in ends)
            kept = self._between(least, greatest, error)
        leaf = self.leaf
        limits = tuple(limit for limit in leaf.limits if limit.level != leaf.level)
        # Of one that is picked from an array, what is known of all says only what it may be.
        surely = is_long & kept.surely & (len(limits) == len(leaf.limits))
        yield level, TruthValues(surely, is_long & kept.perhaps), limits

    def _between(self, least: Numeric, greatest: Numeric, error: float) -> TruthValues:
        """Returns in which arrays a number passes, by their least and greatest finite ones.

        NaN where those are not known. Integers of more than 53 bits were rounded.
        """
        is_real = self.leaf.kind is Kind.REAL
        surely, perhaps = np.zeros(len(least), np.bool_), np.isnan(least)
        is_rounded = np.maximum(np.abs(least), np.abs(greatest)) >= _EXACT_BELOW
        if not is_real:
            perhaps |= is_rounded
        if isinstance(self.test, Beyond):
            limit, above = self.test.limit, self.test.above
            surely = np.logical_and.reduce(
                [
                    beyond(greatest - error if above else least + error, bound, above=above)
                    for bound in (self._bounds if is_real else (limit,))
                ]
            )
            perhaps |= beyond(greatest + error if above else least - error, limit, above=above)
            perhaps |= is_real  # infinities are not among the finite ones
        for number in self.numbers:
            at = as_float(number)
            if error == 0.0:
                surely |= equal_to_any(least, (number,)) | equal_to_any(greatest, (number,))
            perhaps |= (least - error <= at) & (at <= greatest + error)
            perhaps |= is_real and math.isinf(at)
        if not is_real:
            surely &= ~is_rounded
        return TruthValues(surely, perhaps | surely)


def _without_low(word: str, least: float, depth: int) -> str:
    """Returns a text without detections of a low score, which are looked for so deep in it."""
    if not depth or not looks_like_json(word):
        return word
    return str(without_low_scores(word, least, depth))


def beyond(column: Numeric, limit: float, *, above: bool) -> Mask:
    """Returns which numbers lie beyond a limit, compared as Python does: exactly."""
    if column.dtype.kind in "iu" and math.isfinite(as_float(limit)):
        whole = math.floor(limit) if above else math.ceil(limit)
        return column > whole if above else column < whole
    # Not a Python float, to which float32 would be compared as float32.
    nearest = as_float(limit)
    bound = np.float64(nearest)
    if above:
        return column >= bound if nearest > limit else column > bound
    return column <= bound if nearest < limit else column < bound


def equal_to_any(column: Numeric, numbers: Sequence[float]) -> Mask:
    """Returns which numbers equal one of these, compared as Python does: exactly."""
    is_equal = np.zeros(len(column), np.bool_)
    for number in numbers:
        nearest = as_float(number)
        if column.dtype.kind in "iu":
            if math.isfinite(nearest) and number == math.floor(number):
                is_equal |= column == int(number)
        elif nearest == number:
            is_equal |= column == np.float64(nearest)
    return is_equal


class _PlaceTest(NamedTuple):
    """`near_position`, on one position of a value: the leaves of its x, y and perhaps z."""

    test: NearPosition
    leaves: Sequence[Leaf]

    def may_match(self, zone_of: ZoneOf[Leaf]) -> bool | Mask:
        """Returns whether some position may be near, as far as known without reading any."""
        reach = self.test.tolerance_m * (1 + _ROUNDING) + _TINY_M
        possible: bool | Mask = True
        for leaf, center in zip(self.leaves, self._center, strict=False):
            zone = zone_of(leaf)
            possible = possible if zone is None else possible & zone.may_be_near(center, reach)
        return possible

    def passing(self, values: Values) -> Iterator[tuple[Level, TruthValues, tuple[Limit, ...]]]:
        """Yields which rows or elements of a level are near; raises as that of `_LeafTest`."""
        columns = [values.numbers(leaf) for leaf in self.leaves[: len(self._center)]]
        yield self.leaves[0].level, self._near(columns), self.leaves[0].limits

    @property
    def _center(self) -> tuple[float, ...]:
        test = self.test
        return (test.x, test.y) if test.z is None else (test.x, test.y, test.z)

    def _near(self, columns: Sequence[LeafNumbers]) -> TruthValues:
        tolerance = self.test.tolerance_m
        axes = [column.values.astype(np.float64, copy=False) for column in columns]
        error = sum(column.error for column in columns)
        with np.errstate(all="ignore"):
            squared = [(axis - at) ** 2 for axis, at in zip(axes, self._center, strict=True)]
            apart = np.sqrt(np.add.reduce(squared))
            is_near = apart <= tolerance
            if not np.any(error):
                return TruthValues.known(is_near)
            # Their sum, which is no less than the root of their squares: of 1e-200 that is 0.
            is_doubtful = np.abs(apart - tolerance) <= error + tolerance * _ROUNDING
            is_doubtful |= apart < _TINY_M
        return TruthValues(is_near & ~is_doubtful, is_near | is_doubtful)


def _place_tests(test: NearPosition, target: Node) -> Iterator[_PlaceTest]:
    """Yields a test of each position in a part of a value."""

    def is_axis(node: Node) -> bool:
        return node is NOTHING or (isinstance(node, Leaf) and node.kind is not Kind.TEXT)

    for point in points(target, is_axis):
        axes = [point.get(axis) for axis in "xyz"]
        leaves = [axis for axis in axes if isinstance(axis, Leaf) and axis.is_number]
        # A missing z is NaN, which is near nothing.
        if all(axis in leaves for axis in axes[:2]) and (test.z is None or len(leaves) == 3):
            yield _PlaceTest(test, leaves)
