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
    NotIn,
    Or,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Sequence
    from datetime import date

    from pyiceberg.expressions import BooleanExpression

    from ros2_memory.core.timebase import Ns

    Predicate = Callable[[str, object], BooleanExpression]

# Their constructors are not those that Pydantic's plugin for mypy takes them to have.
_equal: Final = cast("Predicate", EqualTo)
_at_least: Final = cast("Predicate", GreaterThanOrEqual)
_at_most: Final = cast("Predicate", LessThanOrEqual)
_below: Final = cast("Predicate", LessThan)
_is_null: Final = cast("Callable[[str], BooleanExpression]", IsNull)
_one_of: Final = cast("Predicate", In)
_none_of: Final = cast("Predicate", NotIn)


def any_of(conditions: Sequence[BooleanExpression]) -> BooleanExpression:
    """Returns the condition that one of some conditions holds, of which there is at least one."""
    return Or(*conditions) if len(conditions) > 1 else conditions[0]


def except_bags(condition: BooleanExpression, ids: Collection[str]) -> BooleanExpression:
    """Returns a condition without the rows of some bags."""
    return And(condition, _none_of("bag_id", ids)) if ids else condition


def of_topics(condition: BooleanExpression, topics: Collection[str]) -> BooleanExpression:
    """Returns a condition on rows of some topics alone."""
    return And(condition, _one_of("topic", topics))


def of_robots(robots: Collection[str], day: date) -> BooleanExpression:
    """Returns the condition on rows of one day of some robots."""
    return And(_one_of("robot", robots), _equal("day", day.isoformat()))


def of_bags(bags: Iterable[tuple[str, date, str]]) -> BooleanExpression:
    """Returns the condition on rows of bags, at least one, given by robot, day and id.

    The bounds of the ids let Iceberg pass over the files of other times.
    """
    ids: dict[tuple[str, date], set[str]] = {}
    for robot, day, bag_id in bags:
        ids.setdefault((robot, day), set()).add(bag_id)
    return any_of(
        [And(of_robots([robot], day), of_ids(robot, some)) for (robot, day), some in ids.items()]
    )


def of_ids(robot: str, ids: Collection[str]) -> BooleanExpression:
    """Returns the condition on rows of bags of a robot, of any day."""
    return And(
        _equal("robot", robot),
        _at_least("bag_id", min(ids)),
        _at_most("bag_id", max(ids)),
        _one_of("bag_id", ids),
    )


def overlapping(robot: str, columns: tuple[str, str], start: Ns, stop: Ns) -> BooleanExpression:
    """Returns the condition on rows of a robot whose span reaches into `[start, stop)`.

    `columns` have its first and last time (inclusive); a last time that is null is the first.
    """
    first, last = columns
    ends = Or(_at_least(last, start), And(_is_null(last), _at_least(first, start)))
    return And(_equal("robot", robot), _below(first, stop), ends)
