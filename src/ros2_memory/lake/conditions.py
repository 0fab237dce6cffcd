"""Conditions on rows, as Iceberg takes them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, cast

from pyiceberg.expressions import (
    And,
    EqualTo,
    GreaterThanOrEqual,
    In,
    IsNull,
    LessThan,
    LessThanOrEqual,
    Or,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence
    from datetime import date

    from pyiceberg.expressions import BooleanExpression

    from ros2_memory.core.timebase import Ns

    Predicate = Callable[[str, object], BooleanExpression]

# Their constructors are not those that Pydantic's plugin for mypy takes them to have.
equal: Final = cast("Predicate", EqualTo)
_at_least: Final = cast("Predicate", GreaterThanOrEqual)
_at_most: Final = cast("Predicate", LessThanOrEqual)
_below: Final = cast("Predicate", LessThan)
_is_null: Final = cast("Callable[[str], BooleanExpression]", IsNull)
_one_of: Final = cast("Predicate", In)


def any_of(conditions: Sequence[BooleanExpression]) -> BooleanExpression:
    """Returns the condition that one of some conditions holds, of which there is at least one."""
    return Or(*conditions) if len(conditions) > 1 else conditions[0]


def of_day(robot: str, day: date) -> BooleanExpression:
    """Returns the condition on rows of one partition."""
    return And(equal("robot", robot), equal("day", day.isoformat()))


def of_bags(ids: Mapping[tuple[str, date], Collection[str]]) -> BooleanExpression:
    """Returns the condition on rows of bags, given by robot and day.

    The bounds of the ids let Iceberg pass over the files of other times.
    """
    return any_of(
        [
            And(
                of_day(robot, day),
                _at_least("bag_id", min(of_one)),
                _at_most("bag_id", max(of_one)),
                _one_of("bag_id", of_one),
            )
            for (robot, day), of_one in ids.items()
        ]
    )


def between(robot: str, column: str, start: Ns, stop: Ns) -> BooleanExpression:
    """Returns the condition on rows of a robot whose time is in `[start, stop)`."""
    return And(equal("robot", robot), _at_least(column, start), _below(column, stop))


def overlapping(robot: str, columns: tuple[str, str], start: Ns, stop: Ns) -> BooleanExpression:
    """Returns the condition on rows of a robot whose span reaches into `[start, stop)`.

    `columns` have its first and last time (inclusive); a last time that is null is the first.
    """
    first, last = columns
    ends = Or(_at_least(last, start), And(_is_null(last), _at_least(first, start)))
    return And(equal("robot", robot), _below(first, stop), ends)
