"""What the heartbeat counts and names besides the state: restarts, topics that nobody offers."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from tests.support.simulated_recorders import PlayedHousekeeper, World

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(autouse=True)
def no_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing here is about power cuts, and flushing takes most of the time."""
    monkeypatch.setattr(os, "fsync", lambda _descriptor: None)


def test_recorders_that_had_to_be_restarted_are_counted_and_rotations_are_not(
    tmp_path: Path,
) -> None:
    world = World(tmp_path, session_duration_s=20).started(60)
    assert len(world.recorders) > 1
    assert world.heartbeat()["restarts"] == 0
    for times in (1, 2):
        world.running[0].die()
        world.run(10)
        assert world.heartbeat()["restarts"] == times


def test_one_that_does_not_begin_to_record_counts_when_it_is_given_up(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.defaults |= {"ready_s": 1e9, "subscribe_s": 1e9}
    world.supervisor.start()
    world.run(100)
    assert world.heartbeat()["restarts"] == 0
    world.run(30)
    assert world.heartbeat()["restarts"] == 1


def test_topics_that_nobody_has_offered_are_named_once_a_recorder_has_looked(
    tmp_path: Path,
) -> None:
    world = World(tmp_path, expected=("/odom", "/gone", "/bumper"))
    world.defaults["topics"] = ("/bumper",)
    world.supervisor.start()
    assert world.heartbeat()["missing"] == []
    world.run(7)
    assert world.heartbeat()["missing"] == ["/gone", "/odom"]
    world.defaults["topics"] = ("/odom",)
    world.running[0].die()
    world.run(10)
    assert world.heartbeat()["missing"] == ["/gone"]


def test_an_error_has_its_time_and_is_past_once_recording_goes_on(tmp_path: Path) -> None:
    world = World(tmp_path).started(20)
    world.running[0].die()
    world.run(0.25)
    beat = world.heartbeat()
    assert "was killed" in beat["last_error"]
    assert (beat["last_error_at"], beat["recovered"]) == (world.wall, False)
    world.run(20)
    later = world.heartbeat()
    assert (later["last_error"], later["recovered"]) == (beat["last_error"], True)
    assert later["last_error_at"] == beat["last_error_at"]


def test_an_error_that_lasts_is_not_past(tmp_path: Path) -> None:
    housekeeper = PlayedHousekeeper()
    world = World(tmp_path, housekeeper=housekeeper).started()
    housekeeper.failed = {"apply": "the list cannot be read"}
    world.run(30)
    assert (world.heartbeat()["last_error"], world.heartbeat()["recovered"]) == (
        "the list cannot be read",
        False,
    )
    housekeeper.failed = {}
    world.run(10)
    assert world.heartbeat()["recovered"] is True
