from __future__ import annotations

import re

import pytest

from ros2_memory.core import errors
from ros2_memory.core.errors import (
    EpisodicError,
    NoDataReason,
)


def _tree() -> list[type[EpisodicError]]:
    found, waiting = [], [EpisodicError]
    while waiting:
        error = waiting.pop()
        found.append(error)
        waiting.extend(error.__subclasses__())
    return [error for error in found if error.__module__ == errors.__name__]


@pytest.mark.parametrize("error", _tree(), ids=lambda error: error.__name__)
def test_the_drawn_tree_shows_every_error_with_its_code(error: type[EpisodicError]) -> None:
    drawing = errors.__doc__ or ""
    line = next(line for line in drawing.splitlines() if re.search(rf"\b{error.__name__}\b", line))
    assert error is EpisodicError or error.code in line


def test_the_drawn_tree_shows_nothing_else() -> None:
    drawn = set(re.findall(r"-- (\w+)", errors.__doc__ or "")) | {"EpisodicError"}
    assert drawn == {error.__name__ for error in _tree()}


def test_the_reasons_for_no_data_are_those_that_a_client_knows() -> None:
    assert {str(reason) for reason in NoDataReason} == {
        "topic_not_recorded",
        "outside_range",
        "gap",
        "deleted",
        "between_messages",
        "not_closed_yet",
        "undecodable",
        "frame_unknown",
        "frames_not_connected",
        "empty_memory",
        "mixed",
    }
