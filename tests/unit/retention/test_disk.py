"""The disk under the bag directory, and how it is known again."""

import os
from pathlib import Path
from unittest.mock import Mock

import pytest

from ros2_memory.core.errors import BagError, BagUnreachableError
from ros2_memory.retention.disk import RETRIED_S, FailingFiles, HomeDisk, device_of
from tests.support.housekeepers import A, B, keeper_of, recording


def test_a_directory_that_is_not_there_lies_where_it_would_be_made(tmp_path: Path) -> None:
    assert device_of(tmp_path / "a" / "b") == tmp_path.stat().st_dev
    assert device_of(Path("/proc")) != tmp_path.stat().st_dev


def test_it_is_known_by_its_recordings_under_another_number(tmp_path: Path) -> None:
    device = Mock(return_value=1)
    home = HomeDisk(tmp_path, device)
    home.remember()
    assert not home.is_away(["rec_a"])
    device.return_value = 2
    assert home.is_away([])
    (tmp_path / "rec_a").mkdir()
    device.return_value = 3
    assert not home.is_away([])
    (tmp_path / "rec_a").rmdir()
    assert not home.is_away([])
    # What is recorded on another disk makes it none of its own.
    device.return_value = 4
    assert home.is_away([])
    (tmp_path / "rec_b").mkdir()
    assert home.is_away(["rec_b"])


def test_a_file_is_given_up_after_a_day_unless_it_was_read_meanwhile() -> None:
    path, fault = Path("a_0.mcap"), BagUnreachableError("a_0.mcap", "Input/output error")
    clock = Mock(side_effect=[hour * RETRIED_S / 24 for hour in (*range(25), 72, 73)])
    files = FailingFiles(clock)
    found = [files.may_recover(path, fault) for _ in range(27)]
    assert found == [True] * 24 + [False, True, True]
    assert not files.may_recover(path, BagError("a_0.mcap", "it is damaged"))


class OnAnotherDevice:
    """The status of a file, but for its device."""

    def __init__(self, status: os.stat_result) -> None:
        self._status = status
        self.st_dev = status.st_dev + 1

    def __getattr__(self, name: str) -> object:
        return getattr(self._status, name)


def test_bags_are_deleted_after_their_disk_came_back_under_another_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = recording(tmp_path, A, 0)
    house = keeper_of(tmp_path, max_age_h=1)
    with monkeypatch.context() as patched:
        stat = Path.stat
        patched.setattr(Path, "stat", lambda path, **how: OnAnotherDevice(stat(path, **how)))
        house.apply()
        house.apply()
    assert all(path.exists() for path in old)
    recording(tmp_path, B, 2 * 3600)
    house.apply()
    assert not any(path.exists() for path in old)
