"""The sixty questions about a home's first days, much later: their bags are gone.

A day a year later; EPISODIC_LONG=1 has every day of that year, for some hours.
"""

from __future__ import annotations

import shutil
import sys
import time
from typing import TYPE_CHECKING, Final

import pytest

from tests.home import asking
from tests.home.days import Scale
from tests.home.questions import questions
from tests.home.year import Year, about, write_later_days
from tests.support.examples import LONG

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.xdist_group("home"), pytest.mark.usefixtures("in_utc")]

SCALE = Scale()
FIRST_LATER: Final = 2 if LONG else 364
YEAR: Final = 365
ASKED: Final = {1: "an hour", 7: "a week", 31: "a month", YEAR: "a year"}
"""When is asked: at the end of a day (0 is the first)."""
OF_ALL_DAYS: Final = {"crash"}
"""Later days have crashes of their own."""


def test_questions_are_answered_alike_when_bags_are_gone(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(home, tmp_path / "world")
    bag_dir, later = tmp_path / "world" / "bags", tmp_path / "later"
    write_later_days(SCALE, FIRST_LATER, YEAR + 1 - FIRST_LATER, later, monkeypatch)
    size = sum(path.stat().st_size for path in bag_dir.rglob("*.mcap"))
    settings = asking.settings_for(tmp_path / "world", SCALE.split_s)
    asked = [about(question, SCALE) for question in questions(SCALE)]
    year = Year(bag_dir, SCALE.split_s)
    for day in [1, *range(FIRST_LATER, YEAR + 1)]:
        if day >= FIRST_LATER:
            year.add(later, day)
        year.age(day)
        if day not in ASKED:
            continue
        server, begun = asking.server_over(settings), time.process_time()
        outcomes = asking.ask_all(server, asked)
        took = time.process_time() - begun
        sys.stdout.write(f"after {ASKED[day]}: {took:.2f} s of the processor, {year.size} bytes\n")
        missed = {each.question.id: each.why for each in outcomes if each.result != asking.RIGHT}
        # Where one of two messages a second stays, what a detector mistakes may weigh too much.
        assert len(missed.keys() - OF_ALL_DAYS) <= (0 if day == 1 else 2), (ASKED[day], missed)
        if day == 1:
            assert not missed
            assert year.size < size / 12
