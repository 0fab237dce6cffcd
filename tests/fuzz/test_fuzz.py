"""A few mutants of every class, the same in each run; more of those whose indexes lie.

EPISODIC_LONG=1 tries over a hundred times as many; so does `python -m tests.fuzz`, with a table.
"""

from __future__ import annotations

import asyncio
import random
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

from tests.fuzz.campaign import Child, Tally, campaign
from tests.fuzz.classes import CLASSES, Job
from tests.fuzz.good import goods, sqlites
from tests.fuzz.holding import hold, truth_of
from tests.fuzz.indexes import agreed
from tests.fuzz.mutant import mutant_of
from tests.fuzz.trial import World
from tests.support.examples import LONG

if TYPE_CHECKING:
    from tests.fuzz.oracle import Readable

SEED: Final = 1
OF_EACH: Final = 300 if LONG else 2
OF_INDEXES: Final = 1200 if LONG else 4
_INDEXES: Final = ("message_indexes", "chunk_indexes", "statistics", "sqlite_indexes")
UNKNOWN: Final = "no_such_class"


@pytest.fixture(scope="module")
def tallies() -> dict[str, Tally]:
    """What became of all mutants, tried by one child: each spends seconds on its imports."""
    mutants = {UNKNOWN: 1, **dict.fromkeys(CLASSES, OF_EACH), **dict.fromkeys(_INDEXES, OF_INDEXES)}
    found = campaign(mutants, SEED)
    assert [(tally.name, tally.mutants) for tally in found] == [*mutants.items()]
    return {tally.name: tally for tally in found}


@pytest.mark.parametrize("name", CLASSES)
def test_whatever_a_bag_is_it_answers_or_says_why_not_and_disturbs_no_other(
    tallies: dict[str, Tally], name: str
) -> None:
    tally = tallies[name]
    found = [
        f"{verdict['number']} {verdict.get('mutation')} of {verdict.get('good')}: {fault}"
        for verdict in tally.found
        for fault in verdict["faults"]
    ]
    assert not found, "\n".join(found)
    assert tally.questions == 7 * tally.mutants


@pytest.mark.parametrize("name", _INDEXES)
def test_whatever_an_index_says_every_answer_is_what_can_be_read(
    tallies: dict[str, Tally], name: str
) -> None:
    assert tallies[name].held >= OF_INDEXES // 4


@pytest.mark.parametrize("kind", ["small chunks", "unchunked", "db3"])
def test_the_oracle_agrees_with_a_good_bag_and_misses_a_message(tmp_path: Path, kind: str) -> None:
    [good] = [each for each in goods() if each.kind == kind]
    mutant = mutant_of(good, good.plain)
    truth = truth_of(mutant, good)
    assert truth is not None
    world = World(tmp_path, "rosbag2", stored=False)
    path = mutant.place(world.bag_dir, 0)
    memory, server = world.serving()
    [bag] = [each for each in memory.index.snapshot().bags if each.path == path]

    def faults(said: list[Readable]) -> list[str]:
        return asyncio.run(hold(memory, server, bag, said, random.Random(1)))

    assert faults(truth) == []
    assert len({each.topic for each in truth}) == 7
    for topic in ("/odom", "/chatter"):
        one = next(each for each in truth if each.topic == topic)
        assert faults([each for each in truth if each is not one])
        assert faults([*truth, one._replace(time=one.time + 30_000_000)])


def test_a_chunk_that_lies_wholly_before_the_one_before_it_is_found_out(tmp_path: Path) -> None:
    [good] = [each for each in goods() if each.kind == "small chunks"]
    chunks = 55
    for nth in (chunks - 2, chunks // 2):
        plain = agreed(good.plain, nth, lambda time: time - 600_000_000)
        mutant = mutant_of(good, plain)
        folder = tmp_path / str(nth)
        folder.mkdir()
        world = World(folder, "mcap", stored=False)
        path = mutant.place(world.bag_dir, 0)
        memory, _ = world.serving()
        [bag] = [each for each in memory.index.snapshot().bags if each.path == path]
        assert any("contradict" in note or "without" in note for note in bag.summary.notes)


def test_of_damaged_content_the_oracle_knows_no_right_answer() -> None:
    good = goods()[0]
    assert truth_of(mutant_of(good, good.plain[:-1]), good) is None
    assert truth_of(mutant_of(good, good.plain.replace(b"step 3 of", b"step 8 of")), good) is None
    db3 = sqlites()[0]
    assert truth_of(mutant_of(db3, db3.plain[:4096]), db3) is None


def test_a_child_that_dies_is_counted_as_a_crash(tmp_path: Path) -> None:
    child = Child(tmp_path)
    child.kill()
    verdict = child.try_one(Job("bit_flips", 0, SEED))
    assert verdict["died"] == "crash"
    assert verdict["faults"]


def test_a_mutant_that_cannot_be_made_is_a_fault_and_does_not_end_the_run(
    tallies: dict[str, Tally],
) -> None:
    [verdict] = tallies[UNKNOWN].found
    assert "could not be tried" in verdict["faults"][0]
    assert {(tally.crashes, tally.hangs) for tally in tallies.values()} == {(0, 0)}
