"""What `ros2-memory up` refuses before it starts anything."""

import io
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, cast
from unittest.mock import patch

import pytest

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.cli.proposal import Offered
from ros2_memory.cli.up import Survey, survey_topics
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.recorder.process.topics import load_topics
from ros2_memory.storage.mcap_reader import McapReader
from tests.support import stub_ros2
from tests.support.bags import odom, text, write_mcap
from tests.support.memories import ROOT
from tests.support.program import Program

if TYPE_CHECKING:
    from ros2_memory.recorder.process.installation import Installation

T0 = 1_700_000_000 * NS_PER_S


@pytest.fixture(autouse=True)
def stub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A `ros2` that offers /odom, /tf and /tf_static, and no ROS installation."""
    (tmp_path / "bin").mkdir()
    stub_ros2.install(tmp_path / "bin" / "ros2")
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("STUB_OPTIONS", "--start-paused --include-hidden-topics --node-name")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("ros2_memory.cli.up.SECONDS", 0.3)
    monkeypatch.setattr("ros2_memory.cli.up.QUIET_S", 0.1)


@pytest.fixture
def surveyed(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the robot offers is known: two recordings take a second."""
    topic = Offered("/odom", "nav_msgs/msg/Odometry", messages=9, hz=9.0, payload_bytes=700.0)
    monkeypatch.setattr("ros2_memory.cli.up.survey_topics", lambda *_: Survey([topic], 0.5, 4000))


def test_a_deployment_that_does_not_record_is_refused(exits: Program, tmp_path: Path) -> None:
    for word in ("recorder=none", "storage=mcap", "deployment=replay"):
        said = exits(2, f"up --yes --bag-dir {tmp_path}/bags", word).err
        assert "`up` records, and serves over HTTP: choose deployment=robot" in said
    assert not (tmp_path / "bags").exists()


def test_a_folder_that_cannot_be_written_is_named(
    exits: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bags, access = tmp_path / "bags", os.access
    # Root, as which tests may run, may write everywhere.
    monkeypatch.setattr(os, "access", lambda path, mode: path != bags and access(path, mode))
    said = exits(2, f"up --yes --bag-dir {bags}").err
    assert f"{bags} cannot be written by this user; name another folder" in said


def test_a_domain_of_a_setup_file_is_checked_too(exits: Program, tmp_path: Path) -> None:
    setup = tmp_path / "setup.bash"
    setup.write_text("export ROS_DOMAIN_ID=kitchen\n")
    words = ["--bag-dir", tmp_path / "bags", f"recorder.setup_files=[{setup}]"]
    assert "ROS_DOMAIN_ID: 'kitchen' is not allowed" in exits(2, "up --yes", *words).err


def test_a_recorder_that_fails_is_named_with_its_last_words(
    exits: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STUB_OPTIONS", "--include-hidden-topics")
    said = exits(2, f"up --yes --bag-dir {tmp_path}/bags").err
    assert "ros2 bag record ended by itself (status 2)" in said
    assert "unrecognized arguments: --start-paused" in said
    assert "`ros2-memory doctor` checks the installation" in said


def test_a_message_that_comes_once_as_topics_are_measured_is_no_message_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """10 kB a second would be 0.9 GB a day, for which nothing else would be proposed."""
    messages = [odom(T0 + n * NS_PER_S // 10) for n in range(50)]
    messages.append(text(messages[-1].log_time, "x" * 10_000, "/plan"))
    look = write_mcap(tmp_path / "0.mcap", [], declared={(m.topic, m.type) for m in messages})
    bags = iter([look, write_mcap(tmp_path / "1.mcap", messages)])
    monkeypatch.setattr("ros2_memory.cli.up._record", lambda *_, **_options: next(bags))
    monkeypatch.setattr("ros2_memory.cli.up.SECONDS", 5.0)
    found = survey_topics(cast("Installation", None), BagDirReader(McapReader()), 1).topics
    assert {topic.topic: round(topic.hz, 2) for topic in found} == {"/odom": 10.0, "/plan": 0.2}


@pytest.mark.usefixtures("surveyed")
@patch.object(sys, "stdin", io.StringIO("n\n"))
def test_who_answers_no_has_nothing_written(exits: Program, tmp_path: Path) -> None:
    shown = exits(1, f"up --bag-dir {tmp_path}/bags").out
    assert "record /odom" in shown
    assert not (tmp_path / "bags" / "topics.yaml").exists()


@pytest.fixture
def became(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The programs that `up` becomes in the end, with their arguments."""
    programs: list[list[str]] = []

    def become(program: str, argv: list[str]) -> None:
        programs.append(argv)
        raise SystemExit(0)

    monkeypatch.setattr(os, "execvp", become)
    return programs


class Terminal(io.StringIO):
    """A person at a terminal, with what they type."""

    def isatty(self) -> bool:
        return True


@pytest.mark.usefixtures("became", "surveyed")
@pytest.mark.parametrize(
    ("typed", "flags", "before", "remembers"),
    [
        ("y\ny\n", "", False, True),
        ("y\n\n", "", False, False),
        ("", "--yes", False, False),
        ("", "--yes", True, True),
        ("", "--yes memory.keep=false", True, False),
    ],
)
def test_only_a_person_has_something_outlive_the_bags(
    exits: Program,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    typed: str,
    flags: str,
    before: bool,
    remembers: bool,
) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal(typed))
    if before:
        (tmp_path / "bags" / "memory").mkdir(parents=True)
    shown = exits(0, f"up {flags} --install --bag-dir {tmp_path}/bags").out
    assert ("memory.keep=true" in shown) is remembers


@pytest.mark.usefixtures("surveyed")
def test_what_is_to_outlive_the_bags_is_asked_once(
    exits: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[list[str]] = []

    def run(words: list[str], bag_dir: Path) -> bool:
        started.append(words)
        return False

    monkeypatch.setattr("ros2_memory.cli.up._run_programs", run)
    for typed in ("y\ny\n", ""):
        monkeypatch.setattr(sys, "stdin", Terminal(typed))
        exits(0, f"up --bag-dir {tmp_path}/bags")
    assert ["memory.keep=true" in words for words in started] == [True, True]


def test_install_hands_the_list_over_to_the_script_and_names_what_services_are_to_be_given(
    exits: Program, tmp_path: Path, became: list[list[str]]
) -> None:
    file = tmp_path / "bags" / "topics.yaml"
    flags = f"--yes --install --bag-dir {tmp_path}/bags"
    shown = exits(0, f"up retention.max_total_gb=50 {flags}").out
    script = str(ROOT / "deploy" / "install.sh")
    assert became[0][1:] == [f"PYTHON={sys.executable}", script, "--topics", str(file)]
    assert became[0][0] == ("sudo" if os.geteuid() else "env")
    given = "retention.max_total_gb=50 recorder.setup_files=[]"
    assert f"to be set in /etc/ros2-memory/environment: {given}\n" in shown
    assert load_topics(file).entries == ("/odom", "/tf", "/tf_static")
