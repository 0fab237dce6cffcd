"""A disk that fails on writes: what lies there stands, answers stay right, and it is got over."""

import errno
import os
from pathlib import Path

import pytest
import structlog

from ros2_memory.bag_dir.durable_write import write_all_durably, write_durably
from ros2_memory.columns.fill import Progress
from tests.faults.test_store_faults import assert_sound
from tests.faults.world import fill_up, plainly, served, store_of, told, write_bags
from tests.support.column_worlds import store_file
from tests.support.fakes import broken, files_limited_to


@pytest.mark.parametrize("size", [4096, 20_000])
def test_a_store_that_cannot_be_written_costs_no_answer_and_is_filled_later(
    tmp_path: Path, size: int
) -> None:
    (tmp_path / "recorder.json").write_text("{}")
    write_bags(tmp_path, 3)
    memory, filler = served(tmp_path)
    fill_up(filler)
    write_bags(tmp_path, 3, first=3)
    right = plainly(tmp_path, count=6)
    with files_limited_to(size), structlog.testing.capture_logs() as logs:
        for _ in range(3):
            fill_up(filler)
        assert "cannot be used" in (store_of(filler).trouble or "")
        assert filler.progress() == Progress(6, 3, 3)
        assert told(memory, count=6) == right
    events = [each["event"] for each in logs if each["event"].startswith("database")]
    assert events == ["database_failed"]
    filler.look_after(thorough=True)
    fill_up(filler)
    assert store_of(filler).trouble is None
    assert filler.progress() == Progress(6, 6)
    assert told(memory, count=6) == right
    assert_sound(store_file(tmp_path), 6)


@pytest.mark.parametrize("function", ["fsync", "open", "replace"])
@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC, errno.EROFS])
def test_what_cannot_be_replaced_stands_and_leaves_nothing_behind(
    tmp_path: Path, function: str, number: int
) -> None:
    names = [tmp_path / "handover.json", tmp_path / "other.json"]
    for each in names:
        write_durably(each, "as it was")
    with broken(os, function, number), pytest.raises(OSError, match=os.strerror(number)):
        write_all_durably(dict.fromkeys(names, "anew"))
    assert [each.read_text() for each in names] == ["as it was"] * 2
    assert sorted(tmp_path.iterdir()) == sorted(names)
