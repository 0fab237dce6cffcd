from __future__ import annotations

import io
from typing import TYPE_CHECKING

import pytest

from ros2_memory import cli
from ros2_memory.errors import RecorderError
from ros2_memory.recovery import Outcome, recover
from ros2_memory.storage.mcap_reader import McapReader
from tests.bags import McapLayout, odom, write_db3, write_mcap
from tests.keeping import copied, files_in, later, recording_now
from tests.limits import files_limited_to
from tests.shared_bags import RECORDED, needs_recorded

if TYPE_CHECKING:
    from pathlib import Path

S = 10**9
T0 = 1_790_000_000 * S
MESSAGES = [odom(T0 + n * S // 20, n / 20, 0.0) for n in range(100)]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def left_open(path: Path) -> Path:
    return write_mcap(path, MESSAGES, McapLayout(chunk_size=2000, finish=False))


def recovered(path: Path, *, seconds_later: int = 60, **more: bool) -> tuple[Outcome, list[str]]:
    said: list[str] = []
    outcome = recover(path, said.append, stream=io.StringIO(), clock=later(seconds_later), **more)
    return outcome, said


def test_every_unfinished_file_below_a_directory_is_repaired(tmp_path: Path) -> None:
    whole = write_mcap(tmp_path / "a/a_0.mcap", MESSAGES)
    cut = left_open(tmp_path / "a/a_1.mcap")
    (tmp_path / "b").mkdir()
    (tmp_path / "b/b_0.mcap").write_bytes(b"")
    before = whole.stat(), whole.read_bytes()
    count = McapReader().summarize(cut).count
    outcome, said = recovered(tmp_path)
    assert outcome == Outcome(whole=1, repaired=1, removed=1, failed=0, messages=count)
    assert McapReader().summarize(cut).complete
    stat, content = before
    after = whole.stat()
    assert (after.st_ino, after.st_mtime_ns) == (stat.st_ino, stat.st_mtime_ns)
    assert whole.read_bytes() == content
    assert files_in(tmp_path) == ["a", "a/a_0.mcap", "a/a_1.mcap", "b"]
    assert said[0].startswith(f"a/a_1.mcap: repaired: {count} messages")
    assert said[1] == "b/b_0.mcap: empty, removed"
    assert "ros2 bag reindex" in said[2]
    assert said[-1] == str(outcome)


def test_a_single_file_is_repaired_whatever_its_name(tmp_path: Path) -> None:
    path = left_open(tmp_path / "field trip.bag")
    outcome, _ = recovered(path)
    assert outcome.repaired == 1
    assert McapReader().summarize(path).complete


def test_a_whole_file_is_said_to_be(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a_0.mcap", MESSAGES)
    outcome, said = recovered(path)
    assert outcome == Outcome(whole=1)
    assert said[0].endswith("whole already: there is nothing to repair")


def test_what_is_no_mcap_file_is_said_to_be_none_and_stays(tmp_path: Path) -> None:
    path = tmp_path / "a_0.mcap"
    path.write_bytes(b"a letter")
    outcome, said = recovered(tmp_path)
    assert outcome == Outcome(failed=1)
    assert said[0] == "a_0.mcap: NOT REPAIRED: not an MCAP file: it does not begin as one"
    assert path.read_bytes() == b"a letter"


def test_an_empty_file_that_may_be_anything_stays(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_bytes(b"")
    outcome, said = recovered(path)
    assert outcome.failed == 1
    assert "its name does not end in .mcap" in said[0]
    assert path.exists()


def test_what_a_recorder_is_writing_is_left_alone(tmp_path: Path) -> None:
    path = left_open(tmp_path / "rec/rec_0.mcap")
    recording_now(tmp_path, "rec", clock=later(60))
    for asked in (tmp_path, path.parent, path):
        outcome, said = recovered(asked, force=True)
        assert outcome.failed == 1
        assert "the recorder (process 1) is writing it" in said[0]
    assert not McapReader().summarize(path).complete


def test_what_a_process_has_open_is_left_alone(tmp_path: Path) -> None:
    path = left_open(tmp_path / "rec/rec_0.mcap")
    with path.open("rb"):
        outcome, said = recovered(path, force=True)
    assert outcome.failed == 1
    assert "a process has it open" in said[0]


def test_what_changed_a_moment_ago_is_left_alone_unless_that_is_forced(tmp_path: Path) -> None:
    path = left_open(tmp_path / "rec/rec_0.mcap")
    outcome, said = recovered(path, seconds_later=3)
    assert outcome.failed == 1
    assert "--force" in said[0]
    outcome, _ = recovered(path, seconds_later=3, force=True)
    assert outcome.repaired == 1


def test_bags_of_other_kinds_are_counted_and_left_alone(tmp_path: Path) -> None:
    write_db3(tmp_path / "a/a_0.db3", MESSAGES)
    outcome, said = recovered(tmp_path)
    assert outcome == Outcome()
    assert said[0].startswith("1 bag file of another kind was left alone")


def test_what_is_not_there_cannot_be_repaired(tmp_path: Path) -> None:
    with pytest.raises(RecorderError, match="no such file or directory"):
        recovered(tmp_path / "gone")


def test_on_a_full_disk_the_original_stays(tmp_path: Path) -> None:
    path = left_open(tmp_path / "a_0.mcap")
    before = path.read_bytes()
    with files_limited_to(1000):
        outcome, said = recovered(path)
    assert outcome.failed == 1
    assert "cannot be written" in said[0]
    assert path.read_bytes() == before


def test_a_terminal_sees_how_far_it_is_and_then_a_clean_line(tmp_path: Path) -> None:
    for name in ("a/a_0.mcap", "a/a_1.mcap"):
        left_open(tmp_path / name)
    terminal = Terminal()
    recover(tmp_path, lambda _: None, stream=terminal, clock=later(60))
    shown = terminal.getvalue()
    assert "  0% a/a_0.mcap" in shown
    assert " 50% a/a_1.mcap" in shown
    assert shown.endswith("\r\x1b[K")


def test_nothing_but_a_terminal_sees_it(tmp_path: Path) -> None:
    left_open(tmp_path / "a_0.mcap")
    stream = io.StringIO()
    recover(tmp_path, lambda _: None, stream=stream, clock=later(60))
    assert stream.getvalue() == ""


class TestTheProgram:
    def test_exits_0_where_nothing_is_left_unfinished(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        left_open(tmp_path / "a_0.mcap")
        assert cli.main(["recover", str(tmp_path), "--force"]) == 0
        assert "1 repaired" in capsys.readouterr().out

    def test_exits_1_where_a_file_could_not_be_repaired(self, tmp_path: Path) -> None:
        (tmp_path / "a_0.mcap").write_bytes(b"a letter")
        assert cli.main(["recover", str(tmp_path)]) == 1

    def test_exits_2_where_there_is_nothing(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert cli.main(["recover", str(tmp_path / "gone")]) == 2
        assert "ros2-memory recover: " in capsys.readouterr().err


@needs_recorded
def test_what_killed_recorders_left(tmp_path: Path) -> None:
    for name in ("session_killed", "session_killed_chunk64k", "extra/full_truncated"):
        copied(RECORDED / name, tmp_path / name.rpartition("/")[2])
    outcome, _ = recovered(tmp_path, force=True)
    assert outcome == Outcome(whole=4, repaired=2, removed=1, messages=251 + 94)
