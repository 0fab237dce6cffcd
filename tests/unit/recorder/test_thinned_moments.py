"""Moments whose day is thinned: their bags have all messages, and answer alone."""

import shutil
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ros2_memory.bag_dir.moment_file import Outcome
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.recorder.housekeeping import Housekeeping
from tests.support import housekeepers
from tests.support.bags import odom, write_mcap
from tests.support.housekeepers import own_all
from tests.support.memories import reply_over
from tests.unit.recorder.test_days import DAY_FILE, T0, T0_S, days_of, house, messages_in, split

S = NS_PER_S
NEWEST = T0 + 20 * 3600 * S


def window(first: int, stop: int) -> dict[str, float]:
    return {"start": T0_S + 60 * first, "end": T0_S + 60 * stop - 0.1}


def saved(keeper: Housekeeping, bag_dir: Path, start: int, end: int) -> Outcome:
    """Asks for the time between so many seconds after `T0`."""
    since = (T0 - housekeepers.T0) // S
    return housekeepers.kept(keeper, bag_dir, since + start, since + end, at=NEWEST)


class Bags(NamedTuple):
    """A folder before its day is thinned and after it, and who thinned it."""

    whole: Path
    thinned: Path
    keeper: Housekeeping

    def ask(self, tool: str, **given: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        return reply_over(self.whole, tool, **given), reply_over(self.thinned, tool, **given)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Bags:
    """Splits of ten minutes of a day, of which two moments have two each; and the next morning."""
    folder = tmp_path_factory.mktemp("bags")
    for nth in range(16, 26):
        split(folder, 60 * nth, labels=("mug", f"thing{nth}"))
    write_mcap(folder / "rec_B" / "rec_B_0.mcap", [odom(NEWEST + n * S, n, 1.0) for n in range(9)])
    own_all(folder)
    keeper = house(folder, NEWEST, max_age_h=12, memory=days_of(folder))
    for start, end in ((1205, 1315), (1445, 1500)):
        assert saved(keeper, folder, start, end).bags == 2
    whole = shutil.copytree(folder, tmp_path_factory.mktemp("whole") / "bags")
    keeper.apply()
    assert not (folder / "rec_A").exists()
    return Bags(whole, folder, keeper)


def test_a_moment_answers_its_time_and_the_day_what_is_around_it(bags: Bags) -> None:
    assert len([*(bags.thinned / "moments").rglob("*.mcap")]) == 4
    times = {record.log_time for record in messages_in(bags.thinned / DAY_FILE)}
    assert not [at for at in times if T0 + 1200 * S <= at < T0 + 1320 * S]
    for tool, given in (
        ("get_topic_in_range", {"topic": "/odom", **window(20, 22)}),
        ("get_position_at", {"timestamp": T0_S + 1250}),
        ("get_topic_at_time", {"topic": "/chatter", "timestamp": T0_S + 1208}),
    ):
        before, after = bags.ask(tool, **given)
        assert after == before
    # Across its edges nothing is counted twice, and nothing is missing.
    before, after = bags.ask("recap", **window(17, 26))
    assert after["from"] == "memory"
    assert after["distance_m"] == pytest.approx(before["distance_m"], rel=0.01)
    for label in ("thing19", "thing20", "thing21", "thing22"):
        seen = {"topic": "/vision/*", "condition_type": "contains", "value": label}
        assert [each["total"] for each in bags.ask("find_matches", **seen)] == [1, 1]
    # Several moments of a recording and the day around them are of one robot.
    assert "several robots" not in str(after)
    assert "mixed" not in str(reply_over(bags.thinned, "memory_status"))


def test_nothing_can_be_saved_of_a_time_of_which_a_thinned_day_alone_is_left(bags: Bags) -> None:
    assert "deleted" in str(saved(bags.keeper, bags.thinned, 1000, 1030).refused)


def test_a_moment_that_was_deleted_by_hand_leaves_no_memory_of_its_time(
    bags: Bags, tmp_path: Path
) -> None:
    folder = shutil.copytree(bags.thinned, tmp_path / "bags")
    shutil.rmtree(folder / "moments")
    assert reply_over(folder, "get_position_at", timestamp=T0_S + 1250)["error"] == "no_data"
    assert reply_over(folder, "get_position_at", timestamp=T0_S + 1150)["from"] == "memory"
