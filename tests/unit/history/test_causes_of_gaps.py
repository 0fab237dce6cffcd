"""An interruption explains what it cost, and no more of a gap."""

from pathlib import Path
from typing import Any

import pytest

from ros2_memory.bag_dir.state_files import (
    EVERY_TOPIC,
    SCREENED,
    Excluded,
    Loss,
    ScreenState,
    append_losses,
)
from tests.support.bags import odom, write_mcap
from tests.support.memories import asked, memory_of

S = 10**9
BEGIN = 1_784_000_000
DIED = "because ros2 bag record died"
UNCLEAN = "because the recorder ended without a shutdown"


def drive(bag_dir: Path, name: str, start: int, stop: int) -> Path:
    (bag_dir / name).mkdir()
    messages = [odom((BEGIN + second) * S, 1.0, 2.0) for second in range(start, stop)]
    return write_mcap(bag_dir / name / f"{name}_0.mcap", messages)


@pytest.fixture
def bag_dir(tmp_path: Path) -> Path:
    """Two recordings, with 80 s between them."""
    drive(tmp_path, "a", 0, 21)
    drive(tmp_path, "b", 100, 120)
    return tmp_path


def interrupted(bag_dir: Path, start: int, stop: int, by: Any = "died") -> None:
    append_losses(bag_dir, [Loss(EVERY_TOPIC, (BEGIN + start) * S, (BEGIN + stop) * S, 0, by)])


def ask(bag_dir: Path, tool: str, **given: object) -> Any:
    return asked(memory_of(bag_dir), bag_dir, tool, **given)


def notes(bag_dir: Path) -> list[str]:
    found = ask(bag_dir, "trajectory_summary", start=BEGIN + 10, end=BEGIN + 110)["notes"]
    told = [note for note in found if note.startswith("nothing ")]
    return [note.replace(str(BEGIN // 1000), "") for note in told]


def test_a_cause_is_said_of_the_interruption_and_not_of_the_whole_gap(bag_dir: Path) -> None:
    interrupted(bag_dir, 22, 30)
    assert notes(bag_dir) == [
        f"nothing was recorded from 020.000000 to 040.000000 (20 s), {DIED}",
        "nothing was recorded from 040.000000 to 100.000000 (60 s)",
    ]
    doubts = ask(bag_dir, "memory_status")["doubts"]
    assert "(20 s), because ros2 bag record died" in doubts
    assert "60 s" not in doubts


def test_what_was_excluded_was_recorded(bag_dir: Path) -> None:
    excluded = Excluded((BEGIN + 20) * S + 1, (BEGIN + 100) * S)
    SCREENED.write(bag_dir, ScreenState(excluded=[excluded]))
    interrupted(bag_dir, 98, 102, "unclean")
    assert notes(bag_dir) == []
    SCREENED.write(bag_dir, ScreenState(excluded=[Excluded(excluded.start, (BEGIN + 90) * S)]))
    assert f"nothing was recorded from 090.000000 to 100.000000 (10 s), {UNCLEAN}" in notes(bag_dir)


def test_what_may_be_in_a_file_that_cannot_be_read_is_not_said_to_be_unrecorded(
    bag_dir: Path,
) -> None:
    interrupted(bag_dir, 22, 30)
    (bag_dir / "a" / "a_1.mcap").write_bytes(b"no bag at all" * 100)
    assert notes(bag_dir) == [
        f"nothing was recorded from 022.000000 to 030.000000 (8 s), {DIED}",
        "nothing could be read from 030.000000 to 100.000000 (70 s)",
    ]
