"""Finds the rows of a table that meet a condition, from its columns alone.

It returns what `Condition.matches(extractor.exact(message))` returns for each message. A row is
unsure, never wrong, where the columns do not settle it: an array has no column, a float was
rounded, or the shape of the value differs from message to message. Then the bag decides.

Zones are looked at first, since they rule out tests without a column being unpacked.
"""

from __future__ import annotations

import math
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
from ros2_memory.columns.shown import (
    NOTHING,
    ByType,
    Listing,
    Node,
    Shape,
    at_field,
    leaves_of,
    texts_above,
)
from ros2_memory.columns.stored import StoredTable
from ros2_memory.columns.table import as_float
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
    unknown,
    within_limits,
    zones_of,
)
from ros2_memory.core.text import looks_like_json
from ros2_memory.messages.conversions import names_beside
from ros2_memory.messages.detections import parsed_json, without_low_scores

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.columns.stored import PartZones
    from ros2_memory.columns.table import Table
    from ros2_memory.columns.values import Numeric, ZonesOf
    from ros2_memory.extract import SchemaExtractor
    from ros2_memory.storage.base import Mask

_EXACT_BELOW: Final = 2**53
_ROUNDING: Final = 1e-9
"""How much a distance that numpy computes may differ, relative to the tolerance; far too much."""
_TINY_M: Final = 1e-150
"""The squares of shorter distances vanish."""

_Test: TypeAlias = "_LeafTest | _JsonTest | _PlaceTest"


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
        self._tests_of_part: dict[int, Sequence[_Test]] = {}

    def truth(self, table: Table) -> TruthValues:
        """Returns which rows of a table meet the condition."""
        plan, values = self._plans.of(table), Values(table)
        if plan is None:
            return unknown(values.rows)
        tests: Sequence[_Test] | None = None
        if isinstance(table, StoredTable):
            tests = self._tests_of_part.get(table.number)
        if tests is None:
            tests = _possible(plan.whole, values)
        if plan.counted is None or not tests:
            return _any_of(tests, values)
        counted = _any_of(_possible(plan.counted, values), values)
        leaves = [test.leaf for test in plan.counted if not isinstance(test, _PlaceTest)]
        if not may_be_json(values, [leaf for leaf in leaves if leaf.json_depth]):
            return counted
        # A text in which detections were left out is another text: both have to pass.
        whole = _any_of(tests, values)
        return TruthValues(counted.surely & whole.surely, counted.perhaps & whole.perhaps)

    def unstated(self, table: Table) -> Mask | None:
        """Returns which rows say nothing of the field; see `Condition.is_unstated`.

        None if the columns do not show it.
        """
        plan, values = self._plans.of(table), Values(table)
        if plan is None or plan.names is None:
            return np.zeros(values.rows, np.bool_)
        try:
            names, owners = values.texts(plan.names), values.elements(plan.names.level).owners
        except UnknownShapeError:
            return None
        is_asked = names.are(lambda word: word == plan.element)
        has_any, is_stated = np.zeros((2, values.rows), np.bool_)
        has_any[owners] = is_stated[owners[is_asked]] = True
        has_others_alone: Mask = has_any & ~is_stated
        return has_others_alone

    def may_match(self, parts: PartZones) -> bool | Mask:
        """Returns which parts may have a row that meets the condition, by their zones.

        Remembers the tests that rows of each part may pass, since `truth` would look at the zones
        of the part again, which takes as long as all this.
        """
        plan = self._plans.of(parts.topic)
        if plan is None:
            return True
        possible: list[Mask] = []
        for test in plan.whole:
            may_pass = test.may_match(lambda leaf: zones_of(leaf, parts.zone))
            if may_pass is True:
                return True
            possible.append(np.broadcast_to(may_pass, parts.numbers.size))
        if not possible:
            return False
        by_part = np.transpose(possible).tolist()
        for part, may_pass_tests in zip(parts.numbers.tolist(), by_part, strict=True):
            self._tests_of_part[part] = [*compress(plan.whole, may_pass_tests)]
        may_pass_any: Mask = np.any(possible, axis=0)
        return may_pass_any


class _Plan(NamedTuple):
    """What a condition tests on values of one type.

    Attributes:
        whole: tests of the value.
        counted: tests of the value without detections of a low score; None if all count.
        names: the names of the elements, if the field asks for an `element` by its name.
        element: that name.
    """

    whole: Sequence[_Test]
    counted: Sequence[_Test] | None
    names: Leaf | None
    element: str

    @classmethod
    def of(cls, condition: Condition, shape: Shape) -> _Plan:
        """Returns what a condition tests on values of a type.

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
    """Returns the tests that some row may pass, by the zones of the columns."""
    return [test for test in tests if test.may_match(values.zones)]


def _any_of(tests: Sequence[_Test], values: Values) -> TruthValues:
    """Returns which rows pass any of the tests."""
    surely, perhaps = nowhere(values.rows)
    for test in tests if values.rows else ():
        try:
            for passing in test.passing(values):
                rows = passing.rows(values)
                surely |= rows.surely
                perhaps |= rows.perhaps
        except UnknownShapeError:
            return TruthValues(surely, unknown(values.rows).perhaps)
        if surely.all():
            break
    return TruthValues(surely, perhaps | surely)


class _Passing(NamedTuple):
    """Which elements of a level, or rows, pass a test.

    Attributes:
        level: of the elements.
        truth: of each element, whether it passes.
        limits: which elements are in the value at all.
    """

    level: Level
    truth: TruthValues
    limits: tuple[Limit, ...]

    def rows(self, values: Values) -> TruthValues:
        """Returns which rows have an element that passes."""
        if self.level is ROWS and not self.limits:
            return self.truth
        certain, possible = map(np.flatnonzero, self.truth)
        _, surely = within_limits(values, self.level, certain, self.limits, surely=True)
        _, perhaps = within_limits(values, self.level, possible, self.limits, surely=False)
        rows = nowhere(values.rows)
        rows.surely[surely] = True
        rows.perhaps[perhaps] = True
        return rows


def _tests(condition: Condition, value: Node) -> list[_Test]:
    """Returns the tests of the leaves of a value, or of those at the condition's field."""
    test, field = condition.test, condition.field
    targets = [value] if field is None else at_field(value, field)
    tests: list[_Test] = []
    for text, rest in () if field is None else texts_above(value, field):
        tests.append(_JsonTest(Condition(test, rest), text, condition.least_score))
    for target in targets:
        leaves = leaves_of(target)
        if isinstance(test, NearPosition):
            tests += _place_tests(test, target)
            continue
        # Elements of lists have no name of their own.
        elements = [] if field is None else leaves_of(target, in_objects=False)
        for leaf in leaves:
            leaf_test = _LeafTest(test, leaf, leaf in elements, condition.least_score)
            if leaf_test.is_needed:
                tests.append(leaf_test)
    return tests


class _JsonTest(NamedTuple):
    """A condition on the JSON in a text; of its detections only those with `least_score` count."""

    condition: Condition
    leaf: Leaf
    least_score: float

    def may_match(self, zones_of: ZonesOf[Leaf]) -> bool | Mask:
        """Returns which parts may have a text that passes; True if all may."""
        zones = zones_of(self.leaf)
        return True if zones is None else zones.may_be_json

    def passing(self, values: Values) -> Iterator[_Passing]:
        """Yields which rows or elements pass.

        Raises:
            UnknownShapeError: the table cannot say.
        """
        truth = TruthValues.known(values.texts(self.leaf).are(self._passes_text))
        yield _Passing(self.leaf.level, truth, self.leaf.limits)

    def _passes_text(self, word: str) -> bool:
        if not looks_like_json(word):
            return False
        depth = self.leaf.json_depth
        text = str(without_low_scores(word, self.least_score, depth)) if depth else word
        return self.condition.matches(parsed_json(text))


class _LeafTest(NamedTuple):
    """`contains`, `equals`, `above` or `below`, on one leaf of a value.

    Attributes:
        test: what is asked.
        leaf: what is tested.
        is_element: whether the field leads to the leaf, or to the list that it is an element of.
        least_score: detections in JSON with a lower score are left out.
    """

    test: Contains | Equals | Beyond
    leaf: Leaf
    is_element: bool
    least_score: float

    @property
    def numbers(self) -> tuple[int | float, ...]:
        """The numbers to which a number of the leaf's kind has to be equal."""
        named = tuple(number for number, name in self.leaf.names if self.passes(name))
        if isinstance(self.test, Contains):
            equal = self.test.equal if self.is_element else None
        else:
            equal = self.test if isinstance(self.test, Equals) else None
        if equal is None:
            return named
        return named + (equal.numbers if self.leaf.kind is Kind.REAL else equal.integers)

    @property
    def is_needed(self) -> bool:
        """Whether any value of the leaf's kind can pass."""
        if self.leaf.kind is Kind.TEXT:
            return self.test.folded is not None
        if self.leaf.kind is Kind.BOOLEAN:
            return self.passes(value=True) or self.passes(value=False)
        return isinstance(self.test, Beyond) or bool(self.numbers)

    def passes(self, value: bool | str) -> bool:
        """Returns whether a boolean or a text passes."""
        if self.test.passes(value):
            return True
        return isinstance(self.test, Contains) and self.is_element and self.test.equal.passes(value)

    def may_match(self, zones_of: ZonesOf[Leaf]) -> bool | Mask:
        """Returns which parts may have a value that passes; True if all may."""
        zones = zones_of(self.leaf)
        if zones is None:
            return True
        if self.leaf.kind is Kind.TEXT:
            may_have = zones.may_have(self.test.folded or "")
            return may_have | zones.may_be_json if self.leaf.json_depth else may_have
        if self.leaf.kind is not Kind.BOOLEAN and isinstance(self.test, Beyond):
            return zones.reaches(self.test.limit, above=self.test.above)
        numbers: Sequence[float] = self.numbers
        if self.leaf.kind is Kind.BOOLEAN:
            numbers = [value for value in (False, True) if self.passes(value=value)]
        possible: bool | Mask = False
        for number in numbers:
            possible = possible | zones.spans(number)
        return possible

    def passing(self, values: Values) -> Iterator[_Passing]:
        """Yields which rows or elements pass.

        Raises:
            UnknownShapeError: the table cannot say.
        """
        leaf, around = self.leaf, self.leaf.level.parent
        if leaf.kind is Kind.TEXT:
            yield _Passing(leaf.level, self._passing_texts(values), leaf.limits)
            return
        is_of_array = leaf.is_of_array and around is not None
        has_column = not is_of_array or values.numeric(leaf.level, "") is not None
        if has_column:
            truth = self._passing_numbers(values.numbers(leaf))
            yield _Passing(leaf.level, truth, leaf.limits)
        if is_of_array and around is not None:
            yield from self._in_long_arrays(values, around, has_short=has_column)

    def _passing_texts(self, values: Values) -> TruthValues:
        may_pass = values.letters(self.leaf, self.test.folded or "")
        if may_pass is None:
            return TruthValues.known(values.texts(self.leaf).are(self._passes_text))
        is_one_word = isinstance(self.test, Contains) and self.test.is_one_word
        if not may_pass.any() or (is_one_word and not self.leaf.json_depth):
            return TruthValues.known(may_pass)
        try:
            texts = values.texts(self.leaf)
        except UnknownShapeError:
            return TruthValues(np.zeros_like(may_pass), may_pass)
        passes = np.zeros(len(texts.words), np.bool_)
        for code in np.unique(texts.codes[may_pass]).tolist():
            passes[code] = self._passes_text(texts.words[code])
        return TruthValues.known(passes[texts.codes])

    def _passes_text(self, word: str) -> bool:
        depth = self.leaf.json_depth
        is_json = depth and looks_like_json(word)
        return self.passes(
            str(without_low_scores(word, self.least_score, depth)) if is_json else word
        )

    def _passing_numbers(self, numbers: LeafNumbers) -> TruthValues:
        column, errors, exactly = numbers
        if column.dtype.kind == "b":
            if_false, if_true = self.passes(value=False), self.passes(value=True)
            return TruthValues.known(np.where(column, if_true, if_false))
        passed = self._passing_exactly(column)
        if not errors.any():
            return TruthValues.known(passed)
        is_near: Mask = np.isinf(errors)
        for bound in self._bounds:
            with np.errstate(invalid="ignore"):  # infinity less infinity
                is_near |= (np.abs(column - as_float(bound)) <= errors) & (errors > 0.0)
        if exactly is None:
            return TruthValues(passed & ~is_near, passed | is_near)
        unsettled = np.flatnonzero(is_near)
        passed[unsettled] = self._passing_exactly(exactly(unsettled))
        return TruthValues.known(passed)

    @property
    def _bounds(self) -> tuple[int | float, ...]:
        """The numbers at which the outcome of the test changes."""
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
        self, values: Values, level: Level, *, has_short: bool
    ) -> Iterator[_Passing]:
        """Yields which arrays have a number that passes, of those too long to have a column.

        Args:
            values: of the table.
            level: of the arrays.
            has_short: whether short arrays have elements; else all count as long.
        """
        path = self.leaf.level.name
        lengths = values.numeric(level, f"{path}.length")
        if lengths is None:
            raise UnknownShapeError(f"{path}.length has no column")
        is_long = lengths > (values.counts(self.leaf.level) if has_short else 0)
        if not is_long.any():
            return
        least, greatest = (values.numeric(level, f"{path}.{end}") for end in ("least", "greatest"))
        truth = unknown(len(lengths))
        if least is not None and greatest is not None and self.leaf.kind is not Kind.BOOLEAN:
            ends = [level.full(f"{path}.{end}") for end in ("least", "greatest")]
            error = max(values.table.error(end) for end in ends)
            truth = self._passing_between(least, greatest, error)
        limits = tuple(limit for limit in self.leaf.limits if limit.level != self.leaf.level)
        is_picked = len(limits) < len(self.leaf.limits)
        # Of one element that is picked from an array, the others only say what it may be.
        surely = np.zeros_like(is_long) if is_picked else is_long & truth.surely
        yield _Passing(level, TruthValues(surely, is_long & truth.perhaps), limits)

    def _passing_between(self, least: Numeric, greatest: Numeric, error: float) -> TruthValues:
        """Returns which arrays have a number that passes.

        Args:
            least: the least finite number of each array; NaN if that is not known.
            greatest: the greatest finite number of each array.
            error: the most by which these are off.
        """
        if isinstance(self.test, Beyond):
            surely, perhaps = self._beyond_between(self.test, least, greatest, error)
        else:
            surely, perhaps = nowhere(len(least))
            for number in self.numbers:
                at = as_float(number)
                if error == 0.0:
                    surely |= equal_to_any(least, (number,)) | equal_to_any(greatest, (number,))
                # Infinities are not among the finite numbers.
                perhaps |= math.isinf(at) | ((least - error <= at) & (at <= greatest + error))
        perhaps |= np.isnan(least)
        if self.leaf.kind is not Kind.REAL:
            # Integers of more than 53 bits were rounded to floats.
            is_rounded = np.maximum(np.abs(least), np.abs(greatest)) >= _EXACT_BELOW
            perhaps |= is_rounded
            surely &= ~is_rounded
        return TruthValues(surely, perhaps | surely)

    def _beyond_between(
        self, test: Beyond, least: Numeric, greatest: Numeric, error: float
    ) -> TruthValues:
        """Returns which arrays have a number beyond a limit; as `_passing_between`."""
        if test.above:
            certain, possible = greatest - error, greatest + error
        else:
            certain, possible = least + error, least - error
        surely = beyond(certain, test.limit, above=test.above)
        if self.leaf.kind is not Kind.REAL:
            return TruthValues(surely, beyond(possible, test.limit, above=test.above))
        surely &= beyond(certain, test.stored, above=test.above)
        # Infinities are not among the finite numbers.
        return TruthValues(surely, np.ones(len(least), np.bool_))


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
    """`near_position`, on one position of a value.

    Attributes:
        test: what is asked.
        leaves: x, y and perhaps z of the position.
    """

    test: NearPosition
    leaves: Sequence[Leaf]

    def may_match(self, zones_of: ZonesOf[Leaf]) -> bool | Mask:
        """Returns which parts may have a position that is near; True if all may."""
        reach = self.test.tolerance_m * (1 + _ROUNDING) + _TINY_M
        possible: bool | Mask = True
        for leaf, center in zip(self.leaves, self._center, strict=False):
            zones = zones_of(leaf)
            if zones is not None:
                possible = possible & zones.may_be_near(center, reach)
        return possible

    def passing(self, values: Values) -> Iterator[_Passing]:
        """Yields which rows or elements are near; raises as `_LeafTest.passing`."""
        columns = [values.numbers(leaf) for leaf in self.leaves[: len(self._center)]]
        first = self.leaves[0]
        yield _Passing(first.level, self._near(columns), first.limits)

    @property
    def _center(self) -> tuple[float, ...]:
        test = self.test
        return (test.x, test.y) if test.z is None else (test.x, test.y, test.z)

    def _near(self, columns: Sequence[LeafNumbers]) -> TruthValues:
        tolerance = self.test.tolerance_m
        axes = [column.values.astype(np.float64, copy=False) for column in columns]
        errors = np.add.reduce([column.errors for column in columns])
        with np.errstate(all="ignore"):
            squares = [(axis - at) ** 2 for axis, at in zip(axes, self._center, strict=True)]
            distance = np.sqrt(np.add.reduce(squares))
            is_near = distance <= tolerance
            if not errors.any():
                return TruthValues.known(is_near)
            # The sum of the errors, not the root of their squares: that of 1e-200 is 0.
            is_doubtful = np.abs(distance - tolerance) <= errors + tolerance * _ROUNDING
            is_doubtful |= distance < _TINY_M
        return TruthValues(is_near & ~is_doubtful, is_near | is_doubtful)


def _place_tests(test: NearPosition, target: Node) -> Iterator[_PlaceTest]:
    """Yields a test for each position in a part of a value."""

    def is_axis(node: Node) -> bool:
        return node is NOTHING or (isinstance(node, Leaf) and node.kind is not Kind.TEXT)

    for point in points(target, is_axis):
        axes = [point.get(axis) for axis in "xyz"]
        leaves = [axis for axis in axes if isinstance(axis, Leaf) and axis.is_number]
        # A missing z is NaN, which is near nothing.
        if all(axis in leaves for axis in axes[:2]) and (test.z is None or len(leaves) == 3):
            yield _PlaceTest(test, leaves)
