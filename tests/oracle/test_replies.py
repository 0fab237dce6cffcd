"""Replies are those that were recorded; UPDATE_REPLIES=1 records what is replied instead."""

import os
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Final

import pytest

from tests.oracle.replies.fixture import Record
from tests.oracle.replies.recording import compare, renew, sample
from tests.oracle.replies.worlds import WORLDS
from tests.support.examples import LONG

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
    return {name: Record.read(name) for name, world in WORLDS.items() if LONG or not world.long}


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
    world, record = WORLDS[name], records()[name]
    if os.environ.get("UPDATE_REPLIES"):
        renew(world, record)
    chosen = None if LONG else short_sample()[name]
    different = compare(world, record, stored=stored, chosen=chosen)
    assert not different, "\n".join(different[:10])


@pytest.mark.parametrize("name", ASKED)
def test_replies_from_bags_are_those_recorded(name: str) -> None:
    held(name, stored=False)


@pytest.mark.parametrize("name", ASKED if LONG else ["session_zstd", "damaged", "resets"])
def test_replies_with_a_store_are_those_recorded(name: str) -> None:
    held(name, stored=True)
