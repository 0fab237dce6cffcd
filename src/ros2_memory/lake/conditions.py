"""Conditions on rows, as Iceberg takes them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, cast

from pyiceberg.expressions import (
    AlwaysFalse,
    And,
    EqualTo,
    GreaterThanOrEqual,
    In,
    LessThan,
    LessThanOrEqual,
    Or,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable
    from datetime import date

    from pyiceberg.expressions import BooleanExpression

    from ros2_memory.core.timebase import Ns

    Predicate = Callable[[str, object], BooleanExpression]

# Their constructors are not those that Pydantic's plugin for mypy takes them to have.
_equal: Final = cast("Predicate", EqualTo)
_at_least: Final = cast("Predicate", GreaterThanOrEqual)
_at_most: Final = cast("Predicate", LessThanOrEqual)
_below: Final = cast("Predicate", LessThan)
_one_of: Final = cast("Predicate", In)


def of_topics(topics: Collection[str]) -> BooleanExpression:
    """Returns the condition on rows of some topics."""
    return _one_of("topic", topics)


def of_robots(robots: Collection[str], day: date) -> BooleanExpression:
    """Returns the condition on rows of one day of some robots."""
    return And(_one_of("robot", robots), _equal("day", day.isoformat()))


def of_ids(robot: str, ids: Collection[str]) -> BooleanExpression:
    """Returns the condition on rows of bags of a robot, of any day.

    The bounds of the ids let Iceberg pass over the files of other times.
    """
    bounds = And(_at_least("bag_id", min(ids)), _at_most("bag_id", max(ids)))
    return And(_equal("robot", robot), bounds, _one_of("bag_id", ids))


def of_bags(bags: Iterable[tuple[str, date, str]]) -> BooleanExpression:
    """Returns the condition on rows of bags, given by robot, day and id."""
    ids: dict[tuple[str, date], set[str]] = {}
    for robot, day, bag_id in bags:
        ids.setdefault((robot, day), set()).add(bag_id)
    found: BooleanExpression = AlwaysFalse()
    for (robot, day), some in ids.items():
        found = Or(found, And(of_robots([robot], day), of_ids(robot, some)))
    return found


def overlapping(robot: str, columns: tuple[str, str], start: Ns, stop: Ns) -> BooleanExpression:
    """Returns the condition on rows of a robot whose span reaches into `[start, stop)`.

    `columns` have its first and last time (inclusive).
    """
    first, last = columns
    return And(_equal("robot", robot), _below(first, stop), _at_least(last, start))
