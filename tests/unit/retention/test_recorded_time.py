"""How long was recorded after each recording, across restarts and full disks; on which disk."""

import errno
import os
from pathlib import Path
from unittest.mock import Mock, patch

import pytest
from structlog.testing import capture_logs

from ros2_memory.bag_dir.state_files import RECORDED
from ros2_memory.core.errors import BagError, BagUnreachableError
from ros2_memory.core.timebase import ns_from_unix
from ros2_memory.retention import recorded_time
from ros2_memory.retention.disk import RETRIED_S, FailingFiles, HomeDisk, device_of
from ros2_memory.retention.recorded_time import RecordedTime
from tests.support.fakes import broken
from tests.support.housekeepers import A, B, keeper_of, recording

S = 10**9
T0_S = 1_790_000_000.0
FILE = ".episodic/recorded.jsonl"


def recorded(time: RecordedTime, name: str, seconds: int, *, since_s: float = 0.0) -> float:
    """Has one recording grow every second; the monotonic time at its end."""
    for second in range(seconds + 1):
        at_s = since_s + second
        time.note([name], round(since_s) + second, at_s, ns_from_unix(T0_S + at_s))
    return since_s + seconds


def folders(bag_dir: Path, *names: str) -> None:
    for name in names:
        (bag_dir / name).mkdir()


@patch.object(recorded_time, "_SPARE_LINES", 10)
def test_recordings_that_are_gone_are_dropped_without_a_restart(tmp_path: Path) -> None:
    folders(tmp_path, "stays")
    time, end = RecordedTime(tmp_path), 0.0
    for name in ("stays", *map(str, range(50))):
        end = recorded(time, name, 60, since_s=end)
        assert len(RECORDED.rows(tmp_path)) < 25
    assert RecordedTime(tmp_path).since(["stays", "49"]) == {"stays": 3000 * S, "49": 0}


def test_silence_does_not_count_for_more_than_a_minute(tmp_path: Path) -> None:
    folders(tmp_path, "a", "b")
    time = RecordedTime(tmp_path)
    time.note(["a"], 0, 0.0, 0)
    for written, at_s, since_s in ((1, 1.0, 1), (1, 3000.0, 1), (2, 3600.0, 61)):
        time.note(["b"], written, at_s, 0)
        assert time.since(["a"]) == {"a": since_s * S}


def test_pauses_do_not_count_and_write_nothing(tmp_path: Path) -> None:
    folders(tmp_path, "a", "b")
    time = RecordedTime(tmp_path)
    time.note([], 0, 0.0, 0)
    assert not (tmp_path / ".episodic").exists()
    end = recorded(time, "a", 10)
    time.note([], 1000, end + 1, 0)
    recorded(time, "b", 5, since_s=end + 5000)
    assert time.since(["a"]) == {"a": 5 * S}


def test_without_a_file_no_date_is_doubtful_and_with_a_damaged_one_all_are(tmp_path: Path) -> None:
    folders(tmp_path, "a", "b")
    assert RecordedTime(tmp_path).doubtful("ab") == frozenset()
    (tmp_path / ".episodic").mkdir()
    (tmp_path / FILE).write_text('{"recording": "a", "recorded_s": 90, "clock_right": true}\n')
    time = RecordedTime(tmp_path)
    with capture_logs() as logs:
        assert time.doubtful("ab") == {"a", "b"}
    assert [(told["event"], told["lines"]) for told in logs] == [("recorded_time_damaged", [1])]
    recorded(time, "c", 20)
    assert RecordedTime(tmp_path).doubtful("ab") == {"a", "b"}


def test_a_disk_that_fails_to_read_it_for_a_while_makes_nothing_older(tmp_path: Path) -> None:
    folders(tmp_path, "a", "b", "c")
    end = recorded(RecordedTime(tmp_path), "gone", 1000)
    recorded(RecordedTime(tmp_path), "a", 100, since_s=end)
    before = (tmp_path / FILE).read_text()

    time = RecordedTime(tmp_path)
    with broken(RECORDED, "lines", errno.EMFILE), capture_logs() as captured:
        end = recorded(time, "b", 200)
        assert time.since("ab") == {"a": 0, "b": 0}
        assert time.doubtful("ab") == {"a", "b"}
        assert (tmp_path / FILE).read_text() == before
    told = ["recorded_time_not_read", "recorded_time_not_kept"]
    assert [each["event"] for each in captured] == told
    recorded(time, "c", 100, since_s=end)
    for each in (time, RecordedTime(tmp_path)):
        found = each.since("abc")
        assert found["a"] == pytest.approx(300 * S, abs=60 * S)
        assert found["b"] == pytest.approx(100 * S, abs=60 * S)


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
