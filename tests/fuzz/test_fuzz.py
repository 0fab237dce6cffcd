"""A few mutants of every class, the same in each run; more of those whose indexes lie.

EPISODIC_LONG=1 tries over a hundred times as many, and EPISODIC_SEED others.
"""

import os
from pathlib import Path

import pytest

from tests.fuzz.campaign import Tally, campaign
from tests.fuzz.classes import CLASSES
from tests.fuzz.good import goods
from tests.fuzz.indexes import agreed
from tests.fuzz.mutant import mutant_of
from tests.fuzz.trial import World
from tests.support.examples import LONG

SEED = int(os.environ.get("EPISODIC_SEED", "1"))
OF_EACH = 300 if LONG else 2
OF_INDEXES = 1200 if LONG else 4
_INDEXES = ("message_indexes", "chunk_indexes", "statistics", "sqlite_indexes")


@pytest.fixture(scope="module")
def tallies() -> dict[str, Tally]:
    """What became of all mutants, tried by one child: each spends seconds on its imports."""
    return campaign(dict.fromkeys(CLASSES, OF_EACH) | dict.fromkeys(_INDEXES, OF_INDEXES), SEED)


@pytest.mark.parametrize("name", CLASSES)
def test_whatever_a_bag_is_it_answers_or_says_why_not_and_disturbs_no_other(
    tallies: dict[str, Tally], name: str
) -> None:
    tally = tallies[name]
    assert not tally.faults, "\n".join(tally.faults)
    assert tally.questions == 7 * tally.mutants > 0


@pytest.mark.parametrize("name", _INDEXES)
def test_whatever_an_index_says_every_answer_is_what_can_be_read(
    tallies: dict[str, Tally], name: str
) -> None:
    assert tallies[name].held >= OF_INDEXES // 4


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
