"""What retention deleted is known as deleted: it is not missing, nor was it never recorded."""

import errno
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from structlog.testing import capture_logs

from ros2_memory.bag_dir import state_files
from ros2_memory.bag_dir.layout import DELETED_FILE
from ros2_memory.bag_dir.state_files import (
    DELETED,
    EVERY_TOPIC,
    Loss,
    append_deleted,
    append_losses,
    deleted_of,
    deleted_spans,
    read_deleted,
)
from ros2_memory.retention import collect
from tests.support.clocks import SettableClock
from tests.support.fakes import broken, killed_at
from tests.support.housekeepers import (
    NOW,
    T0,
    A,
    B,
    S,
    described,
    house_of,
    kept,
    own_all,
    recording,
    size_of,
)
from tests.support.memories import asked, memory_of

T0_S = T0 // S
TRUE = {"topic": "/odom", "condition_type": "above", "value": 1e6, "field": "position.x"}


def listed(bag_dir: Path, name: str, start: int) -> list[Path]:
    """A recording with the metadata.yaml that rosbag2 writes at its end."""
    made = recording(bag_dir, name, start)
    described(bag_dir / name)
    return made


@pytest.fixture(scope="module")
def deleted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the recording of a minute, the moment at 10 to 30 s is left; another one follows later."""
    folder = tmp_path_factory.mktemp("bags")
    listed(folder, A, 0)
    split = listed(folder, B, 100)[0].stat().st_size
    kept(house_of(folder), folder, 12, 28)
    house_of(folder, max_bytes=size_of(folder) - 4 * split + split // 2).apply()
    assert len([*(folder / A).glob("*.mcap")]) == 2
    return folder


@pytest.fixture
def bag_dir(deleted: Path, tmp_path: Path) -> Path:
    return shutil.copytree(deleted, tmp_path / "bags")


def ask(bag_dir: Path, tool: str, **given: object) -> Any:
    return asked(memory_of(bag_dir, clock=SettableClock(NOW)), tool, **given)


def test_splits_that_retention_deleted_around_a_moment_are_not_missing(bag_dir: Path) -> None:
    memory = memory_of(bag_dir, clock=SettableClock(NOW))
    assert memory.absent_splits(memory.index.snapshot()) == []
    assert ask(bag_dir, "memory_status")["doubts"] == "no loss or fault was found"
    # A file that somebody else deleted is.
    (bag_dir / B / f"{B}_3.mcap").unlink()
    assert "lists 1 missing file and 10 messages" in ask(bag_dir, "memory_status")["doubts"]


def test_a_gap_that_retention_made_is_named_so_by_every_tool(bag_dir: Path) -> None:
    [gap] = ask(bag_dir, "data_time_range")["gaps"]
    assert (gap["start"] - T0_S, gap["end"] - T0_S, gap["deleted_s"]) == (29, 100, 30)
    at = ask(bag_dir, "get_position_at", timestamp=T0_S + 45)
    told = f"since: {T0_S + 29}.000000 to {T0_S + 59}.000001 (30 s)"
    assert (at["reason"], told in at["notes"][0]) == ("deleted", True)
    inside = {"topic": "/odom", "start": T0_S + 32, "end": T0_S + 57}
    around = {"start": T0_S + 15, "end": T0_S + 120}
    for tool, given, told in (
        ("get_topic_in_range", inside, "'reason': 'deleted'"),
        ("get_topic_in_range", inside, "recorded, and deleted since"),
        ("trajectory_summary", around, "recorded, and deleted since"),
        ("recap", around, "nothing is here: 30.0 of 71.0 s were deleted"),
    ):
        assert told in str(ask(bag_dir, tool, **given))


def test_a_search_across_what_was_deleted_says_so(bag_dir: Path) -> None:
    told = ask(bag_dir, "find_last_match", **TRUE)
    assert told["timestamp"] is None
    assert any("recorded, and deleted since" in note for note in told["notes"])
    # The memory begins later than what was deleted before, which a search of all leaves out.
    (bag_dir / "moments").rename(bag_dir / ".moments")
    shutil.rmtree(bag_dir / A)
    assert ask(bag_dir, "find_last_match", **TRUE) is None
    early = ask(bag_dir, "get_topic_in_range", topic="/odom", start=T0_S + 31, end=T0_S + 40)
    assert (early["reason"], "deleted since" in str(early)) == ("outside_range", True)


def test_what_was_recorded_and_deleted_did_not_end_with_the_recorder(bag_dir: Path) -> None:
    died = Loss(EVERY_TOPIC, T0 + 59 * S, T0 + 99 * S, 0, "unclean")
    append_losses(bag_dir, [died])
    doubts = ask(bag_dir, "memory_status")["doubts"]
    assert doubts == (
        f"nothing was recorded from {T0_S + 59}.000001 to {T0_S + 100}.000000 (41 s), because the "
        "recorder ended without a shutdown"
    )


def test_a_deletion_is_written_down_before_it_happens(tmp_path: Path) -> None:
    listed(tmp_path, A, 0)
    listed(tmp_path, B, 3 * 3600)
    with killed_at(collect, "remove_bag"):
        house_of(tmp_path, max_age_h=1).apply()
    assert read_deleted(tmp_path)[A].files[:1] == (f"{A}_0.mcap",)
    # What was not deleted after all answers as ever.
    assert ask(tmp_path, "get_position_at", timestamp=T0_S + 45)["x"] == 45
    assert ask(tmp_path, "get_position_at", timestamp=T0_S + 3000)["reason"] == "gap"


def test_a_kill_before_the_directory_goes_with_its_last_bag_leaves_it_to_the_next_run(
    tmp_path: Path,
) -> None:
    listed(tmp_path, A, 0)
    listed(tmp_path, B, 3 * 3600)
    own_all(tmp_path)
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "metadata.yaml").touch()
    limits: dict[str, Any] = {"max_age_h": 1, "keeps_foreign": True}
    with killed_at(collect, "remove_emptied"):
        house_of(tmp_path, **limits).apply()
    assert not [*(tmp_path / A).glob("*.mcap")]
    house = house_of(tmp_path, **limits)
    house.prepare()
    house.apply()
    assert not (tmp_path / A).exists()
    assert (tmp_path / "theirs" / "metadata.yaml").exists()


def test_a_list_that_cannot_be_written_stops_no_deletion_and_is_written_once_there_is_room(
    tmp_path: Path,
) -> None:
    old = listed(tmp_path, A, 0)
    listed(tmp_path, B, 3 * 3600)
    house = house_of(tmp_path, max_age_h=1)

    with broken(DELETED, "append"), capture_logs() as captured:
        house.apply()
    assert "deletions_not_written" in {each["event"] for each in captured}
    assert not any(path.exists() for path in old)
    for path in listed(tmp_path, A, 30):
        assert path.exists()
    house.apply()
    assert deleted_spans(tmp_path) == ((T0, T0 + 89 * S + 1),)


@patch.object(state_files, "_MOST_DELETED_BYTES", 4_000)
def test_times_of_files_that_the_list_has_no_room_for_are_known_as_deleted(tmp_path: Path) -> None:
    """As of a recording of a day, of which every split is deleted but the last."""
    recording(tmp_path, A, 2_000)
    recording(tmp_path, B, 3_000)
    own_all(tmp_path)
    for at in range(0, 2_000, 10):
        split = f"{A}_{at // 10}.mcap", T0 + at * S, T0 + (at + 9) * S
        append_deleted(tmp_path, [deleted_of(A, [split])])
    for number in range(2):
        append_deleted(tmp_path, [deleted_of(B, [(f"{B}_{number}.mcap", T0, T0 + S)])])
    reply = ask(tmp_path, "get_topic_at_time", topic="/odom", timestamp=T0_S + 900)
    told = f"recorded, and deleted since: {T0_S}.000000 to {T0_S + 1999}.000001 (1999 s)"
    assert reply["notes"] == [told]
    assert (tmp_path / DELETED_FILE).stat().st_size < 4_500
    assert read_deleted(tmp_path)[B].files == (f"{B}_0.mcap", f"{B}_1.mcap")


@patch.object(state_files, "_MOST_DELETED_BYTES", 300)
def test_a_list_that_cannot_be_read_when_it_is_too_long_loses_nothing(tmp_path: Path) -> None:

    starts = [T0 + n * 100 * S for n in range(5)]
    gone = [deleted_of(f"rec_{at}", [("a_0.mcap", at, at + 9 * S)]) for at in starts]
    with broken(DELETED, "rows", errno.EMFILE):
        for each in gone[:4]:
            append_deleted(tmp_path, [each])
    assert [start for start, _ in deleted_spans(tmp_path)] == starts[:4]
    append_deleted(tmp_path, gone[4:])
    assert [*read_deleted(tmp_path)] == [""]
    assert [start for start, _ in deleted_spans(tmp_path)] == starts


def test_a_split_in_which_the_clock_was_set_shows_no_time(tmp_path: Path) -> None:
    splits = [("a_0.mcap", 0, T0), ("a_1.mcap", T0, T0 + 9 * S), ("a_2.mcap", 5, 4)]
    append_deleted(tmp_path, [deleted_of("a", splits)])
    assert deleted_spans(tmp_path) == ((T0, T0 + 9 * S + 1),)
    assert len(read_deleted(tmp_path)["a"].files) == 3
