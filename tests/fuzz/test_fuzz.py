"""A few mutants of every class, the same in each run; `python -m tests.fuzz` tries more."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import pytest

from tests.fuzz.campaign import Child, campaign
from tests.fuzz.classes import CLASSES, Job

SEED: Final = 1
OF_EACH: Final = 3
_NAMES: Final = [*CLASSES]
_THIRDS: Final = [_NAMES[third::3] for third in range(3)]


@pytest.mark.parametrize("names", _THIRDS, ids=lambda names: names[0])
def test_whatever_a_bag_is_it_answers_or_says_why_not_and_disturbs_no_other(
    names: list[str],
) -> None:
    tallies = campaign(names, OF_EACH, SEED)
    found = [
        f"{verdict['name']} {verdict['number']}: {fault}"
        for tally in tallies
        for verdict in tally.found
        for fault in verdict["faults"]
    ]
    assert not found, "\n".join(found)
    assert [tally.mutants for tally in tallies] == [OF_EACH] * len(names)
    assert all(tally.questions == 7 * OF_EACH for tally in tallies)


@pytest.mark.parametrize("name", ["bit_flips", "odd_payloads", "lz4_bombs", "foreign_metadata"])
def test_the_same_job_makes_the_same_mutant(name: str) -> None:
    for number in range(4):
        one, other = Job(name, number, SEED).made(), Job(name, number, SEED).made()
        assert (one[0].bag, one[0].files, one[2]) == (other[0].bag, other[0].files, other[2])
    assert Job(name, 1, SEED).made()[0].files != Job(name, 1, SEED + 1).made()[0].files


def test_a_child_that_dies_is_counted_as_a_crash(tmp_path: Path) -> None:
    child = Child(tmp_path)
    child.kill()
    verdict = child.try_one(Job("bit_flips", 0, SEED))
    assert verdict["died"] == "crash"
    assert verdict["faults"]


def test_a_mutant_that_cannot_be_made_is_a_fault_and_does_not_end_the_run() -> None:
    [unknown, known] = campaign(["no_such_class", "truncation"], 1, SEED)
    assert "could not be tried" in unknown.found[0]["faults"][0]
    assert (known.mutants, known.crashes, known.hangs) == (1, 0, 0)
