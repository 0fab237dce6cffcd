"""The list of a bag directory's own recordings: whatever stops the recorder, and wherever."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from structlog.testing import capture_logs

from ros2_memory.bag_dir import json_files, own_recordings
from ros2_memory.bag_dir.durable_write import locked
from ros2_memory.bag_dir.handover_file import Handover, write_handover
from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.bag_dir.layout import LIST_FILE
from ros2_memory.bag_dir.own_recordings import LIST, ListRow, OwnRecordings
from ros2_memory.core.directories import Identity, identity_of
from ros2_memory.core.errors import RecorderError
from ros2_memory.retention.repair import Repairer
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.fakes import broken, failing
from tests.support.heartbeats import beat
from tests.support.housekeepers import embedding, lines, own_all
from tests.support.log_lines import with_checks
from tests.support.simulated_recorders import World, events, rotating

A, B, C = "rec_20260921T101320Z", "rec_20260921T102320Z", "rec_20260921T103320Z"


def claimed(bag_dir: Path) -> OwnRecordings:
    """The list after a start of the recorder."""
    own = OwnRecordings(bag_dir)
    own.claim()
    return own


def named_in_heartbeat(bag_dir: Path, *names: str) -> None:
    beat(bag_dir, 1, RecorderState.STOPPED, recordings=names)


def test_a_recorder_lists_its_name_before_the_child_starts_and_its_directory_once_it_is_there(
    tmp_path: Path,
) -> None:
    world, started = World(tmp_path), list[object]()
    world.before_start = lambda made: started.append((made.exists(), lines(tmp_path)))
    world.started(2)
    [recorder] = world.recorders
    assert started == [(False, [{"recording": recorder.directory.name}])]
    assert lines(tmp_path)[-1]["inode"] == recorder.directory.stat().st_ino
    assert OwnRecordings(tmp_path).owns(recorder.directory)


def test_a_list_that_is_deleted_while_recording_is_written_again_whole(tmp_path: Path) -> None:
    world = rotating(tmp_path, 5)
    shutil.rmtree(tmp_path / ".episodic")
    world.run(40)
    world.supervisor.stop()
    made = [each.directory for each in world.recorders if each.directory.exists()]
    assert len(made) > 1
    assert all(map(OwnRecordings(tmp_path).owns, made))


@patch.object(own_recordings, "_SPARE_LINES", 20)
def test_the_list_stays_small_over_years(tmp_path: Path) -> None:
    own, made = OwnRecordings(tmp_path), [tmp_path / f"rec_{number}" for number in range(80)]
    for number, path in enumerate(made):
        own.begin(path.name)
        path.mkdir()
        own.complete(path.name)
        if number >= 3:
            made[number - 3].rmdir()
        assert len(lines(tmp_path)) <= 2 * 20
    assert all(map(own.owns, made[-3:]))


@patch.object(own_recordings, "_SPARE_LINES", 5)
def test_two_programs_that_write_lose_nothing(tmp_path: Path) -> None:
    own_all(tmp_path)
    made = [tmp_path / f"rec_{number}" for number in range(60)]
    for path in made:
        path.mkdir()

    def write(paths: list[Path]) -> None:
        own = OwnRecordings(tmp_path)
        for path in paths:
            own.complete(path.name)

    with ThreadPoolExecutor() as pool:
        [*pool.map(write, (made[::3], made[1::3], made[2::3]))]
    assert all(map(OwnRecordings(tmp_path).owns, made))


# The steps of a recording: list it, start the child, which makes it, list its directory.


def test_a_directory_that_was_not_listed_is_ours_where_the_heartbeat_names_it(
    tmp_path: Path,
) -> None:
    claimed(tmp_path).begin(A)
    embedding(tmp_path / A / f"{A}_0.mcap")
    named_in_heartbeat(tmp_path)
    with capture_logs() as logs:
        assert not claimed(tmp_path).owns(tmp_path / A)
    [event] = events(logs, "recording_not_claimed")
    assert (event["recording"], "ros2-memory adopt" in event["reason"]) == (A, True)
    named_in_heartbeat(tmp_path, A)
    (tmp_path / A / f"{A}_1.mcap").touch()
    own = OwnRecordings(tmp_path)
    assert not own.owns(tmp_path / A)
    # A list that cannot be written is known all the same.
    with broken(json_files, "write_durably"), capture_logs() as logs:
        own.claim()
        assert events(logs, "recordings_not_listed")
        assert own.owns(tmp_path / A)
        no_append = broken(own_recordings, "append_lines")
        with no_append, pytest.raises(RecorderError, match="No space left"):
            own.begin(B)
    own.begin(B)
    assert [each.get("recording") for each in lines(tmp_path)] == [A, A, B]
    assert OwnRecordings(tmp_path).owns(tmp_path / A)


@pytest.mark.parametrize(
    "line",
    [
        {"recording": "../x", "inode": 1},
        {"recording": "", "inode": 1},
        {"recording": "/x", "inode": 1},
        {"recording": "a//b", "inode": 1},
        {"recording": "a", "inode": True},
        {"recording": "a", "inode": "1"},
        {"recording": 5},
        [],
        None,
    ],
)
def test_a_line_that_says_nothing_is_left_out_and_told(tmp_path: Path, line: Any) -> None:
    own_all(tmp_path)
    with (tmp_path / LIST_FILE).open("a") as stream:
        stream.write(with_checks(json.dumps(line)))
    with capture_logs() as logs:
        assert not OwnRecordings(tmp_path).names()
    assert events(logs, "recordings_list_damaged")


@patch.object(own_recordings, "_SPARE_LINES", 0)
def test_a_recording_that_is_about_to_begin_stays_listed_when_the_list_is_written_again(
    tmp_path: Path,
) -> None:
    own = claimed(tmp_path)
    own.begin(A)
    (tmp_path / A).mkdir()
    own.complete(A)
    own.begin(B)
    named_in_heartbeat(tmp_path, A, B)
    for splits in range(10):
        own.note_splits(A, {f"{A}_{number}.mcap" for number in range(splits)})
    (tmp_path / B).mkdir()  # by the child; then the power goes
    assert claimed(tmp_path).owns(tmp_path / B)


def test_what_another_program_listed_is_known_where_the_list_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(own_recordings, "_SPARE_LINES", 0)
    own = claimed(tmp_path)
    own.begin(A)
    (tmp_path / "old").mkdir()
    old = identity_of(tmp_path / "old")
    assert old

    def adopting_first(path: Path) -> AbstractContextManager[int]:
        patched.setattr(own_recordings, "locked", locked)
        # Another program has the lock, so this one waits.
        OwnRecordings(tmp_path).adopt({"old": old})
        patched.setattr(json_files, "write_durably", failing())
        return locked(path)

    with monkeypatch.context() as patched:
        patched.setattr(own_recordings, "locked", adopting_first)
        with pytest.raises(RecorderError, match="No space left"):
            own.begin(B)
    assert own.owns(tmp_path / "old")


def test_a_restored_directory_is_foreign_until_it_is_adopted(tmp_path: Path) -> None:
    bags, copied = tmp_path / "bags", tmp_path / "copied"
    embedding(bags / A / f"{A}_0.mcap")
    own = own_all(bags)
    assert own.owns(bags / A)
    shutil.copytree(bags, copied)
    assert not claimed(copied).owns(copied / A)
    # ext4 gives it the same inode number: the generation tells, where there is one.
    shutil.rmtree(bags / A)
    shutil.copytree(copied / A, bags / A)
    if identity_of(bags / A) == Identity((bags / A).stat().st_ino):
        pytest.skip("this file system has no generations, so numbers alone may be equal")
    assert not own.owns(bags / A)
    own_all(bags)
    assert own.owns(bags / A)


# Whether bags are from before the list, restored or copied: nothing shows it.


# Adopted at the start until 0.1: a folder that was restored without its list holds the same
# handover.json, recorder.json and custom data, and the budget deleted all of it.
def test_without_a_list_recordings_are_foreign_and_the_start_says_so(tmp_path: Path) -> None:
    for name in (A, B):
        embedding(tmp_path / name / f"{name}_0.mcap")
    embedding(tmp_path / "session_mcap" / "s_0.mcap")
    named_in_heartbeat(tmp_path, A)
    write_handover(tmp_path / A, Handover(next=B, counts_until=1))
    write_handover(tmp_path / B, Handover(previous=A, counts_from=1))
    with capture_logs() as logs:
        own = claimed(tmp_path)
    assert not own.names()
    [event] = events(logs, "recordings_not_adopted")
    assert (event["log_level"], event["recordings"], event["names"]) == ("warning", 2, [A, B])
    assert "ros2-memory adopt" in event["advice"]


# Which files in a recording are the recorder's.


def test_a_recorder_notes_each_split(tmp_path: Path) -> None:
    world = World(tmp_path, session_duration_s=40).started(25)
    foreign = embedding(world.recorders[0].directory / "x_0.mcap")
    last = embedding(foreign.with_name(f"{foreign.parent.name}_99.mcap"))
    world.run(40)
    world.supervisor.stop()
    own = OwnRecordings(tmp_path)
    for each in world.recorders:
        bags = [*each.directory.glob("*.mcap")]
        assert {path for path in bags if not own.owns_bag(path)} == {foreign, last} & {*bags}
        assert lines(tmp_path)[-1]["ended"] is True


def test_after_a_kill_the_next_start_counts_what_was_not_noted(tmp_path: Path) -> None:
    own = claimed(tmp_path)
    own.begin(A)
    files = [embedding(tmp_path / A / f"{A}_{n}.mcap") for n in range(4)]
    files[3].write_bytes(files[3].read_bytes()[:-300])
    own.complete(A)
    own.note_splits(A, {files[0].name})
    foreign = embedding(tmp_path / A / f"{A}_9.mcap")
    own = claimed(tmp_path)
    assert all(map(own.owns_bag, files))
    assert Repairer(McapReader(), McapWriter()).repair(files[3])
    assert own.owns_bag(files[3])
    assert not own.owns_bag(foreign)
    later = embedding(tmp_path / A / f"{A}_4.mcap")
    assert not claimed(tmp_path).owns_bag(later)


def test_a_recording_of_an_earlier_version_holds_all_named_after_it(tmp_path: Path) -> None:
    path, other = (embedding(tmp_path / A / name) for name in (f"{A}_12.mcap", "x_0.mcap"))
    own = claimed(tmp_path)
    identity = identity_of(tmp_path / A)
    assert identity is not None
    LIST.append(tmp_path, [ListRow(A, identity.inode, identity.generation)])
    for each in (own, claimed(tmp_path)):
        assert (each.owns_bag(path), each.owns_bag(other)) == (True, False)


def test_an_adopted_folder_holds_what_lay_there_and_one_of_an_earlier_version_everything(
    tmp_path: Path,
) -> None:
    path = embedding(tmp_path / "runs" / "x_0.mcap")
    own = own_all(tmp_path)
    later = embedding(tmp_path / "runs" / "y_0.mcap")
    assert (own.owns_bag(path), own.owns_bag(later)) == (True, False)
    LIST.replace(tmp_path, [replace(row, bags=None) for row in LIST.rows(tmp_path)])
    assert OwnRecordings(tmp_path).owns_bag(later)
