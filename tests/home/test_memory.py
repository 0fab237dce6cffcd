"""The sixty questions about a home's first days when their bags are gone."""

import shutil
from pathlib import Path

import pytest

from ros2_memory.bag_dir.layout import is_thinned
from tests.home import asking
from tests.home.days import Scale
from tests.home.questions import questions
from tests.home.year import Year, about, write_later_days
from tests.support.examples import LONG

pytestmark = [pytest.mark.xdist_group("home"), pytest.mark.usefixtures("in_utc")]

SCALE = Scale()
YEAR = 365
ASKED = (7, 31, YEAR)
"""At the end of which days is asked; 0 is the first."""
OF_ALL_DAYS = {"How many recordings were left open by a crash?"}
"""Later days have crashes of their own."""


def missed(world: Path) -> dict[str, object]:
    """The questions whose answer is not right, and why."""
    server = asking.server_over(asking.settings_for(world, SCALE.split_s))
    asked = [about(question, SCALE) for question in questions(SCALE)]
    return asking.missed(asked, asking.replies_to(server, asked))


def test_questions_are_answered_alike_when_bags_are_gone(home: Path, thinned_home: Path) -> None:
    bags = {path.relative_to(home): path.stat().st_size for path in home.rglob("*.mcap")}
    left = [path for path in bags if (thinned_home / path).exists()]
    assert left == [path for path in bags if path.parent == max(bags).parent]
    thinned = [path for path in thinned_home.rglob("*.mcap") if is_thinned(path)]
    assert sum(path.stat().st_size for path in thinned) < sum(bags.values()) / 12
    assert missed(thinned_home) == {}


@pytest.mark.skipif(not LONG, reason="every day of a year takes hours: EPISODIC_LONG=1")
def test_questions_are_answered_alike_for_a_year(home: Path, tmp_path: Path) -> None:
    world, later = tmp_path / "world", tmp_path / "later"
    shutil.copytree(home, world)
    write_later_days(SCALE, SCALE.days, YEAR + 1 - SCALE.days, later)
    year = Year(world / "bags", SCALE.split_s)
    for day in range(SCALE.days, YEAR + 1):
        year.add(later, day)
        year.age(day)
        if day in ASKED:
            wrong = missed(world)
            # Where one of two messages a second stays, what a detector mistakes may weigh too much.
            assert len(wrong.keys() - OF_ALL_DAYS) <= 2, (day, wrong)
