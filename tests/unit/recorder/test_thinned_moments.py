"""Moments whose day is thinned: their bags have all messages, and answer alone."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.bag_dir.moment_file import Outcome, PendingRequest, stored_moments_in
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.recorder.housekeeping import Housekeeping
from tests.support.bags import odom, write_mcap
from tests.support.housekeepers import own_all
from tests.support.memories import reply_over
from tests.support.program import exits
from tests.unit.recorder.test_days import (
    DAY_FILE,
    T0,
    T0_S,
    days_of,
    house,
    messages_in,
    split,
)

__all__ = ["exits"]

S = NS_PER_S
NEWEST = T0 + 20 * 3600 * S


def window(first: int, stop: int) -> dict[str, float]:
    return {"start": T0_S + 60 * first, "end": T0_S + 60 * stop - 0.1}


def saved(keeper: Housekeeping, bag_dir: Path, start: int, end: int, now: int) -> Outcome:
    """Asks for the time between so many seconds after `T0`."""
    pending = PendingRequest(bag_dir, "spilled", T0 + start * S, T0 + end * S, now)
    pending.post()
    keeper.keep_moments()
    outcome = pending.outcome()
    pending.close()
    assert outcome is not None
    return outcome


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Splits of ten minutes of a day, and one of the next morning."""
    folder = tmp_path_factory.mktemp("bags")
    for nth in range(16, 26):
        split(folder, 60 * nth, labels=("mug", f"thing{nth}"))
    write_mcap(folder / "rec_B" / "rec_B_0.mcap", [odom(NEWEST + n * S, n, 1.0) for n in range(9)])
    return folder


@pytest.fixture
def bag_dir(tmp_path: Path, recorded: Path) -> Path:
    """Of these a moment has two."""
    folder = shutil.copytree(recorded, tmp_path / "bags")
    own_all(folder)
    keeper = house(folder, NEWEST, max_age_h=12, memory=days_of(folder))
    assert saved(keeper, folder, 1205, 1315, NEWEST).bags == 2
    return folder


def test_a_moment_answers_its_time_and_the_day_what_is_around_it(
    bag_dir: Path, tmp_path: Path
) -> None:
    whole = shutil.copytree(bag_dir, tmp_path / "whole")
    house(bag_dir, NEWEST, max_age_h=12, memory=days_of(bag_dir)).apply()
    assert not (bag_dir / "rec_A").exists()
    linked = [*(bag_dir / "moments").rglob("*.mcap")]
    assert len(linked) == 2
    times = {record.log_time for record in messages_in(bag_dir / DAY_FILE)}
    assert not [at for at in times if T0 + 1200 * S <= at < T0 + 1320 * S]

    def both(tool: str, **given: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        return reply_over(whole, tool, **given), reply_over(bag_dir, tool, **given)

    before, after = both("get_topic_in_range", topic="/odom", **window(20, 22))
    assert after == before
    before, after = both("get_position_at", timestamp=T0_S + 1250)
    assert after == before
    before, after = both("get_topic_at_time", topic="/chatter", timestamp=T0_S + 1208)
    assert after == before
    # Across its edges nothing is counted twice, and nothing is missing.
    before, after = both("recap", **window(17, 26))
    assert after["from"] == "memory"
    assert after["distance_m"] == pytest.approx(before["distance_m"], rel=0.01)
    for label in ("thing19", "thing20", "thing21", "thing22"):
        seen = {"topic": "/vision/*", "condition_type": "contains", "value": label}
        before, after = both("find_matches", **seen)
        assert after["total"] == before["total"] == 1
    [listed] = stored_moments_in(bag_dir)
    assert listed.moment.request.label == "spilled"


def test_several_moments_of_a_recording_and_the_day_around_them_are_of_one_robot(
    bag_dir: Path,
) -> None:
    keeper = house(bag_dir, NEWEST, max_age_h=12, memory=days_of(bag_dir))
    assert saved(keeper, bag_dir, 1445, 1500, NEWEST).bags == 2
    whole = reply_over(bag_dir, "recap", **window(17, 26))
    keeper.apply()
    thinned = reply_over(bag_dir, "recap", **window(17, 26))
    assert thinned["distance_m"] == pytest.approx(whole["distance_m"], rel=0.01)
    assert "several robots" not in str(thinned)
    assert "mixed" not in str(reply_over(bag_dir, "memory_status"))


def test_a_moment_that_was_deleted_by_hand_leaves_no_memory_of_its_time(bag_dir: Path) -> None:
    house(bag_dir, NEWEST, max_age_h=12, memory=days_of(bag_dir)).apply()
    shutil.rmtree(bag_dir / "moments")
    gone = reply_over(bag_dir, "get_position_at", timestamp=T0_S + 1250)
    assert gone["error"] == "no_data", gone
    around = reply_over(bag_dir, "get_position_at", timestamp=T0_S + 1150)
    assert around["from"] == "memory"


def test_nothing_can_be_saved_of_a_time_of_which_a_thinned_day_alone_is_left(
    bag_dir: Path,
) -> None:
    keeper = house(bag_dir, NEWEST, max_age_h=12, memory=days_of(bag_dir))
    keeper.apply()
    refused = saved(keeper, bag_dir, 1000, 1030, NEWEST).refused
    assert "deleted" in str(refused)
