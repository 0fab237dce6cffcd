"""What the commands that look at bags say where the configuration is that of a fleet."""

from pathlib import Path

import pytest

from tests.support.fleets import seeded, write_robot
from tests.support.program import Program, exits

__all__ = ["exits"]


@pytest.fixture
def robots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The setting with a robot that is there and one that is not."""
    monkeypatch.setenv("MEMORY_DEPLOYMENT", "fleet")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_robot(seeded("r1"), tmp_path / "r1")
    return f"fleet.robots={{r1: {tmp_path}/r1, away: {tmp_path}/away}}"


def test_doctor_and_info_are_about_each_robot(robots: str, exits: Program) -> None:
    findings = exits(1, "doctor --json", robots).json["findings"]
    found = [each for each in findings if each["about"] == "robot"]
    assert [each["level"] for each in found] == ["ok", "warning"]
    assert found[0]["seen"].startswith("r1: 2 bag files are readable")
    assert "away" in found[1]["seen"]
    assert "from fleet.robots" in found[1]["seen"]
    told = exits(0, "info --json", robots).json
    assert {name: each["held"]["bags"] for name, each in told.items()} == {"r1": 2, "away": 0}
    shown = exits(0, "info", robots).out
    assert shown.index("r1\n") < shown.index("messages") < shown.index("away\n")


def test_what_looks_at_one_robot_asks_which(robots: str, tmp_path: Path, exits: Program) -> None:
    refused = exits(2, "topics", robots).err
    assert f"--bag-dir {tmp_path}/r1 for r1" in refused
    assert "r1, away" in refused
    assert "/is_docked" in exits(0, f"topics --json --bag-dir {tmp_path}/r1", robots).out


def test_ask_counts_times_from_the_newest_data_of_the_robots_asked(
    robots: str, exits: Program
) -> None:
    for robot in (["robot=r1"], ["robot=r1, away"], []):
        words = [robots, "data.now=latest", *robot]
        told = exits(0, "ask recap --json start=10s end=now", *words).json
        rows = [row for row in told.get("robots", [told]) if row.get("robot_name") != "away"]
        assert [row["distance_m"] > 0 for row in rows] == [True]
    asked = exits(0, "ask get_position_at --json timestamp=10s robot=r1", robots, "data.now=latest")
    assert (asked.json["timestamp"], asked.err) == (seeded("r1").end_s - 10, "")
