"""Rules through kills at any step of what they store, and through a full disk."""

import os
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from ros2_memory.bag_dir import durable_write, json_files, moment_file
from ros2_memory.bag_dir.heartbeat import RecorderState
from tests.faults.small_disk import filled, needs_mounts, small_disk
from tests.support.watched_bags import T0, S, WatchedBags, flag, rule


class KilledError(BaseException):
    """Nothing after it is done, as after SIGKILL."""


class Steps:
    """Counts what changes the disk, and is killed before one of these steps."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, last: int) -> None:
        self.left = last
        for module, name in (
            (os, "link"),
            (os, "fsync"),
            (moment_file, "write_durably"),
            (moment_file, "make_moment_folder"),
            (json_files, "write_durably"),
            (durable_write, "flush"),
        ):
            monkeypatch.setattr(module, name, self.counting(getattr(module, name)))

    def counting(self, do: Callable[..., Any]) -> Callable[..., Any]:
        def step(*given: object, **named: object) -> Any:
            self.left -= 1
            if self.left < 0:
                raise KilledError
            return do(*given, **named)

        return step


def three_rotations(bag_dir: Path) -> WatchedBags:
    """Recordings of 20 s each; the bumper is hit, also in the seconds around a rotation."""
    robot = WatchedBags(bag_dir, [rule(before=12 * S, after=9 * S), rule("door", topic="/door")])
    for begin in range(0, 80, 20):
        old = robot.names[-1] if robot.names else None
        name = robot.begin(T0 + begin * S)
        if old is not None:
            robot.hand_over(old, name, T0 + begin * S, f"{old}_1.mcap")
        for at in (begin, begin + 10):
            hits = {19, 45, 46, 61}
            robot.split(
                [
                    *(flag(n, n in hits) for n in range(at, at + 10)),
                    *(flag(n + 0.5, n == 38, "/door") for n in range(at, at + 10)),
                ],
                name,
            )
    robot.clock.at = T0 + 200 * S
    robot.beat(state=RecorderState.STOPPED)
    return robot


def kept(robot: WatchedBags) -> list[tuple[object, ...]]:
    """All that moments hold, and what the rules counted."""
    moments = [
        (
            each.moment.rule,
            each.moment.request.start,
            each.moment.request.end,
            each.moment.matches,
            each.moment.pending,
            each.moment.missing,
            len(each.files),
        )
        for each in robot.moments()
    ]
    records = [(name, robot.record(name)) for name in ("bumper", "door")]
    return [*moments, *((name, each.fired, each.moments) for name, each in records)]


def test_a_kill_before_any_step_loses_and_doubles_nothing(tmp_path: Path) -> None:
    whole = three_rotations(tmp_path / "whole")
    whole.look()
    right = kept(whole)
    assert [each[0] for each in right[:-2]] == ["bumper", "bumper", "door"]
    for last in count(0, 3):
        robot = three_rotations(tmp_path / f"killed{last}")
        with pytest.MonkeyPatch.context() as broken:
            Steps(broken, last)
            try:
                robot.look()
            except KilledError:
                pass
            else:
                break  # it takes fewer steps than that
        robot.house = robot.new_house()
        robot.look()
        robot.house.keep_moments()
        assert kept(robot) == right, f"killed before step {last}"
    assert last >= 15


@needs_mounts
@pytest.mark.parametrize("killed", [False, True])
def test_on_a_full_disk_what_fired_waits_for_room(tmp_path: Path, *, killed: bool) -> None:
    with small_disk(tmp_path / "disk", "4m") as disk:
        robot = three_rotations(disk / "bags")
        with filled(disk):
            robot.look()
            robot.look()
        if killed:
            robot.house = robot.new_house()
        robot.look()
        robot.house.keep_moments()
        moments = robot.moments()
        assert [each.moment.rule for each in moments] == ["bumper", "bumper", "door"]
        assert all(not each.moment.pending for each in moments)
        # What could not be stored at first is whole now, or says what is missing.
        for each in moments:
            assert each.files
            assert each.moment.missing == ()
