import io
import os
from collections import Counter
from functools import partial
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rich.console import Console
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.cli import output
from ros2_memory.cli.maintenance.recover import RecoveryOutcome, is_foreign, recover_files
from ros2_memory.core.directories import identity_of
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, along_x, typestore, write_db3, write_mcap
from tests.support.housekeepers import copied, files_in, later, recording_now
from tests.support.program import Program
from tests.support.shared_bags import RECORDED, needs_recorded

S = 10**9
T0 = 1_790_000_000 * S
ODOMETRY = "nav_msgs/msg/Odometry"
MESSAGES = along_x(T0, 5, mps=1, hz=20)


def left_open(path: Path) -> Path:
    return write_mcap(path, MESSAGES, McapLayout(chunk_size=2000, finish=False))


def recovered(
    path: Path, *, seconds_later: int = 60, force: bool = False
) -> tuple[RecoveryOutcome, list[str]]:
    outcome = recover_files(path, force=force, clock=later(seconds_later))
    return outcome, outcome.lines


def test_every_unfinished_file_below_a_directory_is_repaired(tmp_path: Path) -> None:
    whole = write_mcap(tmp_path / "a/a_0.mcap", MESSAGES)
    cut = left_open(tmp_path / "a/a_1.mcap")
    (tmp_path / "b").mkdir()
    (tmp_path / "b/b_0.mcap").write_bytes(b"")
    (tmp_path / "c_0.mcap").write_bytes(b"a letter")
    write_db3(tmp_path / "d_0.db3", MESSAGES)
    before = whole.stat().st_ino, whole.stat().st_mtime_ns, whole.read_bytes()
    count = McapReader().summarize(cut).count
    outcome, printed = recovered(tmp_path)
    assert outcome == RecoveryOutcome(whole=1, repaired=1, removed=1, failed=1, messages=count)
    assert McapReader().summarize(cut).complete
    assert (whole.stat().st_ino, whole.stat().st_mtime_ns, whole.read_bytes()) == before
    assert (tmp_path / "c_0.mcap").read_bytes() == b"a letter"
    left = ["a", "a/a_0.mcap", "a/a_1.mcap", "a/metadata.yaml", "b", "c_0.mcap", "d_0.db3"]
    assert files_in(tmp_path) == left
    told, repaired, removed, metadata, summary = printed
    assert told == "c_0.mcap: NOT REPAIRED: not an MCAP file: it does not begin as one"
    assert repaired.startswith(f"a/a_1.mcap: repaired: {count} messages")
    assert removed == "b/b_0.mcap: empty, removed"
    assert metadata == f"{tmp_path}/a/metadata.yaml: made to match the files"
    assert summary == outcome.summary()


def test_a_file_that_is_finished_while_the_user_is_asked_is_whole(tmp_path: Path) -> None:
    file = left_open(tmp_path / "a/a_0.mcap")

    def finish(_folders: object) -> None:
        write_mcap(file, MESSAGES)

    outcome = recover_files(tmp_path, confirm=finish, clock=later(60))
    assert outcome == RecoveryOutcome(whole=1)
    assert file.exists()
    assert not [line for line in outcome.lines if "removed" in line and line != outcome.summary()]


def test_a_recording_is_own_by_whatever_path_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = [tmp_path / "old" / name for name in ("run1", "run2")]
    for folder in folders:
        folder.mkdir(parents=True)
    own = OwnRecordings(tmp_path)
    own.claim()
    known = {f"old/{folder.name}": identity_of(folder) for folder in folders}
    own.adopt({name: identity for name, identity in known.items() if identity})
    monkeypatch.chdir(folders[0])
    assert not is_foreign(Path("../run2"))
    assert is_foreign(Path("../run3"))


def test_metadata_that_speaks_of_more_than_there_is_is_corrected(tmp_path: Path) -> None:
    with Writer(tmp_path / "rec", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        store = typestore()
        odometry = writer.add_connection("/odom", ODOMETRY, typestore=store)
        writer.add_connection("/quiet", "std_msgs/msg/String", typestore=store)
        for each in MESSAGES:
            writer.write(odometry, each.log_time, each.payload)
        writer.set_custom_data("robot", "seven")
    cut = left_open(tmp_path / "rec/rec.mcap")
    os.truncate(cut, cut.stat().st_size - 3000)
    (tmp_path / "rec/rec_1.mcap").write_bytes(b"")
    _, printed = recovered(tmp_path / "rec")
    assert any("metadata.yaml: made to match" in line for line in printed)
    held = McapReader().summarize(tmp_path / "rec/rec.mcap")
    assert 0 < held.count < 100
    assert counted(tmp_path / "rec") == {"/odom": held.count, "/quiet": 0}
    assert "robot: seven" in (tmp_path / "rec/metadata.yaml").read_text()
    with Reader(tmp_path / "rec") as reader:
        assert (reader.start_time, reader.end_time) == (held.start, held.end + 1)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "not YAML"),
        ("rosbag2_bagfile_information: {}", "not of the storage"),
        ("rosbag2_bagfile_information: {storage_identifier: sqlite3}", "not of the storage"),
        ("rosbag2_bagfile_information: {storage_identifier: mcap, version: 4}", "version 4"),
        (
            "rosbag2_bagfile_information: {storage_identifier: mcap, compression_mode: FILE}",
            "compression",
        ),
        ("[]", "holds no keys"),
    ],
)
def test_metadata_of_another_form_is_kept(tmp_path: Path, text: str, reason: str) -> None:
    left_open(tmp_path / "rec/rec_0.mcap")
    (tmp_path / "rec/metadata.yaml").write_text(text)
    _, printed = recovered(tmp_path)
    assert any("NOT CORRECTED" in line and reason in line for line in printed)
    assert (tmp_path / "rec/metadata.yaml").read_text() == text


@needs_recorded
@pytest.mark.parametrize("name", ["session_killed", "session_killed_chunk64k", "session_mcap"])
def test_metadata_of_a_recorded_session_is_as_plain_rosbags_reads_it(
    tmp_path: Path, name: str
) -> None:
    folder = tmp_path / name
    copied(RECORDED / name, folder)
    if name == "session_mcap":
        last = folder / f"{name}_6.mcap"
        last.write_bytes(last.read_bytes()[:-2000])
    outcome, _ = recovered(folder, force=True)
    assert outcome.failed == 0
    found = [McapReader().summarize(each) for each in folder.glob("*.mcap")]
    expected: Counter[str] = Counter()
    for summary in found:
        expected.update({each.topic: each.count for each in summary.topics})
    assert {topic: n for topic, n in counted(folder).items() if n} == expected
    for each in folder.glob("*.mcap"):
        with each.open("rb") as stream:
            plain = make_reader(stream).get_summary()
            assert plain is not None
            assert plain.statistics is not None
            assert plain.statistics.message_count == McapReader().summarize(each).count


def counted(recording: Path) -> dict[str, int]:
    """Messages by topic as plain rosbags states them, each of which it also yields."""
    with Reader(recording) as reader:
        stated = {each.topic: each.msgcount for each in reader.connections}
        read = Counter(connection.topic for connection, _, _ in reader.messages())
        assert reader.message_count == read.total()
        assert +Counter(stated) == read
    return stated


def test_what_a_recorder_is_writing_is_left_alone(tmp_path: Path) -> None:
    path = left_open(tmp_path / "rec/rec_0.mcap")
    recording_now(tmp_path, "rec", clock=later(60))
    for asked in (tmp_path, path.parent, path):
        outcome, printed = recovered(asked, force=True)
        assert outcome.failed == 1
        assert "the recorder (process 1) is writing it" in printed[0]
    assert not McapReader().summarize(path).complete


def test_what_is_open_or_changed_a_moment_ago_is_left_alone_unless_that_is_forced(
    tmp_path: Path,
) -> None:
    path = left_open(tmp_path / "rec/rec_0.mcap")
    with path.open("rb"):
        outcome, printed = recovered(path, force=True)
    assert (outcome.failed, "a process has it open" in printed[0]) == (1, True)
    outcome, printed = recovered(path, seconds_later=3)
    assert (outcome.failed, "--force" in printed[0]) == (1, True)
    assert recovered(path, seconds_later=3, force=True)[0].repaired == 1


def test_a_terminal_sees_which_file_is_repaired_and_then_a_clean_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left_open(tmp_path / "a/a_0.mcap")
    terminal = io.StringIO()
    monkeypatch.setattr(
        output, "Console", partial(Console, file=terminal, force_terminal=True, width=100)
    )
    recovered(tmp_path)
    shown = terminal.getvalue()
    assert "repairing a/a_0.mcap (1 of 1)" in shown
    assert "\x1b[2K" in shown.rpartition("repairing")[2]


@pytest.mark.parametrize("answer", ["n\n", ""])
def test_recover_asks_before_it_changes_what_another_program_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: str, exits: Program
) -> None:
    empty = tmp_path / "rec" / "rec_0.mcap"
    empty.parent.mkdir()
    empty.write_bytes(b"")
    monkeypatch.setattr("sys.stdin", io.StringIO(answer))
    exits(1, f"recover {tmp_path} --force")
    exits(2, f"recover {tmp_path} --force --json")
    assert empty.exists()
    exits(0, f"recover {tmp_path} --force --yes")
    assert not empty.exists()
