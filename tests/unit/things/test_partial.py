"""What is seen of detectors where the store is not complete, the time short, or a bag odd."""

from collections.abc import Callable, Hashable
from contextlib import suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TypeVar

import pytest

from ros2_memory.columns.scanner import Scanner
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.timebase import Deadline
from ros2_memory.history.context import Call, Memory
from ros2_memory.index.timeline import Timeline
from ros2_memory.storage.cache import ByteLru
from ros2_memory.things import known
from ros2_memory.things.find import find_things
from tests.support.bags import write_splits
from tests.support.memories import memory_of, with_store
from tests.unit.things.test_find import BEGIN, HERE, NAMED, looked

T = TypeVar("T")

APART_S = 600
"""Each bag is in ten minutes of its own, which are gathered together."""
THINGS = [(f"thing {number}", 3.0 + number % 3, number / 3) for number in range(8)]


def call(looks: int) -> Call:
    """A call whose time is over after so many looks at the clock."""
    return Call(Deadline.after(looks, map(float, count()).__next__))


def eight_bags(bag_dir: Path, part: float = 1.0) -> Memory:
    """A memory of eight bags, each with a thing of its own; a part of them is stored."""
    moments = [looked(APART_S * n, APART_S * n + 3, HERE, thing) for n, thing in enumerate(THINGS)]
    write_splits(bag_dir, [message for some in moments for message in some])
    return with_store(memory_of(bag_dir, limits=NAMED), bag_dir, part=part)


@pytest.fixture
def fresh(tmp_path: Path) -> Callable[[], Memory]:
    """Makes memories of eight bags, of which two are stored; none knows what another has read."""
    stored = eight_bags(tmp_path, 0.25).scanner
    assert stored is not None
    return lambda: replace(
        memory_of(tmp_path, limits=NAMED), scanner=Scanner(stored.store, tmp_path)
    )


def begin_of(nth: int) -> int:
    """When the ten minutes of a bag begin."""
    return (BEGIN + APART_S * nth) // APART_S * APART_S


def in_time(ask: Callable[[Call], T]) -> list[T]:
    """The answers after some numbers of looks at the clock, without the refusals."""
    answers = []
    for looks in (*range(1, 60, 16), *range(60, 600, 90), 100_000):
        with suppress(QueryTimeoutError):
            answers.append(ask(call(looks)))
    return answers


def test_find_things_answers_from_the_newest_bags_and_says_since_when(
    fresh: Callable[[], Memory],
) -> None:
    answers = in_time(lambda short: find_things(fresh(), short))
    assert len({each.total for each in answers} - {0}) > 2
    for answer in answers:
        newest = {label for label, *_ in THINGS[len(THINGS) - answer.total :]}
        assert {each.label for each in answer.things} == newest
        told = [note for note in answer.notes if "2 of 8 bags" in note]
        assert (answer.total < len(THINGS)) == bool(told)
        first = begin_of(len(THINGS) - answer.total)
        assert all(str(first) in note for note in told), told


@pytest.fixture
def crowded(tmp_path: Path) -> Memory:
    return eight_bags(tmp_path)


def labels_and_notes(memory: Memory) -> tuple[set[str], list[str]]:
    found = find_things(memory, Call(Deadline.after(60)))
    notes = [note for note in found.notes if "too many sightings" in note]
    assert found.all_counted == (not notes)
    return {each.label for each in found.things}, notes


class WithoutEstimates(ByteLru[tuple[Timeline, object]]):
    """Keeps only how many sightings can be compared in time."""

    def put(self, key: Hashable, value: tuple[Timeline, object], size: int) -> None:
        if not isinstance(value[1], known.KnownThings):
            super().put(key, value, size)


def test_where_a_machine_was_slow_for_a_while_all_are_compared_again(
    crowded: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    scanner = crowded.scanner
    assert scanner is not None
    caches = replace(scanner.caches, things=WithoutEstimates(1 << 20))
    monkeypatch.setattr(scanner, "caches", caches)
    monkeypatch.setattr(known, "_FEWER", 100)
    monkeypatch.setattr(known, "_ESTIMATING_S", 0.0)
    labels_and_notes(crowded)
    monkeypatch.setattr(known, "_ESTIMATING_S", 1e6)
    compared = [len(labels_and_notes(crowded)[0]) for _ in range(5)]
    assert compared == [1, 2, 4, 8, 8]


def test_of_a_window_before_what_was_compared_no_never_is_said(
    crowded: Memory, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(known, "_MOST_SPOTS", 3)
    start_s = float(begin_of(0))
    for labels, seen in (((), THINGS[2:5]), (("thing 0",), ()), (("thing 7",), ())):
        found = find_things(
            crowded, Call(Deadline.after(60)), labels, start_s=start_s, end_s=begin_of(5) - 1
        )
        assert {thing.label for thing in found.things} == {label for label, *_ in seen}
        assert not found.all_counted
        assert "too many sightings" in str(found.notes)
        text = " ".join(found.notes)
        assert "published nothing" not in text
        assert "not once" not in text
        assert "no detector reported" not in text or f'" from {begin_of(2)}' in text
