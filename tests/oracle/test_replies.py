"""Replies are those that were recorded; `python -m tests.oracle.replies record` renews them."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Final

import pytest

from tests.oracle.replies.comparison import Comparison, differing
from tests.oracle.replies.fixture import Record, path_of
from tests.oracle.replies.recording import compare, sample
from tests.oracle.replies.worlds import WORLDS
from tests.support.examples import LONG

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

pytestmark = pytest.mark.xdist_group("heavy")

ASKED: Final = [
    pytest.param(name, marks=[pytest.mark.shared(world.needs)] if world.needs else [])
    for name, world in WORLDS.items()
    if LONG or not world.long
]
FOR_EACH_WORLD: Final = 2
"""Calls of each world that a short run asks at least."""


@cache
def records() -> Mapping[str, Record]:
    asked = [name for name, world in WORLDS.items() if LONG or not world.long]
    return {name: Record.read(name) for name in asked if path_of(name).exists()}


@cache
def short_sample() -> Mapping[str, set[int]]:
    """Of worlds that short runs make: in each kind of them, each way and tool."""
    short = {name: record for name, record in records().items() if not WORLDS[name].long}
    return sample(short, FOR_EACH_WORLD)


@pytest.fixture(scope="module", autouse=True)
def _forgotten_afterwards() -> Iterator[None]:
    """Recorded replies are millions of objects, among which garbage would be looked for."""
    yield
    records.cache_clear()


def held(name: str, *, stored: bool) -> None:
    world, comparison = WORLDS[name], Comparison()
    if name not in records():
        pytest.skip(
            f"not recorded yet: python -m tests.oracle.replies record --world {name} --long"
        )
    chosen = None if LONG else short_sample()[name]
    asked = compare(world, records()[name], comparison, stored=stored, chosen=chosen)
    assert asked
    assert not comparison.differences, "\n".join(map(str, comparison.differences[:10]))


@pytest.mark.parametrize("name", ASKED)
def test_replies_from_bags_are_those_recorded(name: str) -> None:
    held(name, stored=False)


@pytest.mark.parametrize("name", ASKED if LONG else ["session_zstd", "damaged", "resets"])
def test_replies_with_a_store_are_those_recorded(name: str) -> None:
    held(name, stored=True)


def test_the_sample_asks_every_tool_and_way_in_every_kind_of_world() -> None:
    asked: dict[str, set[str]] = {}
    there: dict[str, set[str]] = {}
    for name, numbers in short_sample().items():
        if WORLDS[name].is_slow:
            continue
        kind, replies = WORLDS[name].kind, records()[name].replies
        asked.setdefault(kind, set()).update(replies[number].call.what for number in numbers)
        there.setdefault(kind, set()).update(replied.call.what for replied in replies)
    assert asked == there


def test_every_world_that_short_runs_ask_is_recorded() -> None:
    assert set(records()) >= {name for name, world in WORLDS.items() if not world.long}


@pytest.mark.parametrize(
    ("recorded", "got", "paths"),
    [
        ({"total": 3}, {"total": 4}, ["/total"]),
        ({"total": 3}, {"total": True}, ["/total"]),
        ({"total": 3}, {}, ["/total"]),
        ({"events": [1, 2]}, {"events": [1]}, ["/events"]),
        ({"x": 1.001}, {"x": 1.002}, []),
        ({"x": 1.001}, {"x": 1.003}, ["/x"]),
        ({"notes": ["a", "b"]}, {"notes": ["b", "a"]}, []),
        ({"notes": ["a", "b"]}, {"notes": ["a"]}, ["/notes"]),
        ({"text": "stood 7.1 s"}, {"text": "stood 7.2 s"}, []),
        ({"text": "stood 7.1 s"}, {"text": "stood 7.3 s"}, ["/text"]),
        ({"text": "at 10:00:07.1"}, {"text": "at 10:00:07.2"}, ["/text"]),
    ],
)
def test_a_difference_is_more_than_a_unit_of_the_last_decimal(
    recorded: Any, got: Any, paths: list[str]
) -> None:
    assert [path for path, _, _ in differing(recorded, got)] == paths
