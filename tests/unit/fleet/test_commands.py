"""What the commands that look at bags say where the configuration is that of a fleet."""

import json
from pathlib import Path

import pytest

from ros2_memory import cli
from tests.support.fleets import seeded, write_robot


@pytest.fixture
def robots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The setting with a robot that is there and one that is not."""
    monkeypatch.setenv("MEMORY_DEPLOYMENT", "fleet")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_robot(seeded("r1"), tmp_path / "r1")
    return f"fleet.robots={{r1: {tmp_path}/r1, away: {tmp_path}/away}}"


def test_doctor_checks_each_robot(robots: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", "--json", robots]) == 1
    told = json.loads(capsys.readouterr().out)
    found = [each for each in told["findings"] if each["about"] == "robot"]
    assert [each["level"] for each in found] == ["ok", "warning"]
    assert found[0]["seen"].startswith("r1: 2 bag files are readable")
    assert "away" in found[1]["seen"]
    assert "from fleet.robots" in found[1]["seen"]


def test_info_is_about_each_robot(robots: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["info", "--json", robots]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {name: each["held"]["bags"] for name, each in told.items()} == {"r1": 2, "away": 0}
    assert cli.main(["info", robots]) == 0
    shown = capsys.readouterr().out
    assert shown.index("r1 ") < shown.index("messages") < shown.index("away ")


def test_what_looks_at_one_robot_asks_which(
    robots: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["topics", robots]) == 2
    refused = capsys.readouterr().err
    assert f"--bag-dir {tmp_path}/r1 for r1" in refused
    assert "r1, away" in refused
    assert cli.main(["topics", "--json", "--bag-dir", str(tmp_path / "r1"), robots]) == 0
    assert "/is_docked" in capsys.readouterr().out
