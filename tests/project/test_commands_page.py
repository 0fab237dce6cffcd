"""The commands of "From the command line" and of docs/how-to/forget.md run."""

import re
import shlex
from pathlib import Path

import pytest

from ros2_memory import cli
from ros2_memory.bootstrap import exclusions_of
from ros2_memory.config import load_settings
from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import odom, text, write_mcap
from tests.support.housekeepers import own_all
from tests.support.memories import ROOT

FORGET = (ROOT / "docs/how-to/forget.md").read_text(encoding="utf-8")
PAGE = (ROOT / "docs/reference/commands.md").read_text(encoding="utf-8")
SECTION = PAGE.partition("## From the command line\n")[2].partition("\n## ")[0]
SHELL = "".join(re.findall(r"```sh\n(.*?)```", SECTION + FORGET, re.DOTALL))
COMMANDS = [shlex.split(line, comments=True) for line in SHELL.splitlines()]
T0 = 1_795_161_600 * NS_PER_S
MORE = {"watch": ["--count", "1"], "forget": ["--yes", "data.places_file=places.yaml"]}
NOT_HERE = ("ros2-memory --install-completion", "ros2-memory-recorder")


@pytest.fixture(autouse=True)
def memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot's bag, of which the clock and the words fit what the pages ask."""
    names = ("/vision/scene/scene_objects", "/camera/front", "/mic")
    messages = [odom(T0 + n * NS_PER_S // 10, n / 10, 0.0) for n in range(101)]
    messages += [text(T0 + NS_PER_S, "scissors", name) for name in names]
    write_mcap(tmp_path / "bags" / "rec_0" / "rec_0.mcap", messages)
    own_all(tmp_path / "bags")
    write_mcap(tmp_path / "bags" / "old-bags" / "old_0.mcap", [odom(T0 - NS_PER_S, 0.0, 0.0)])
    places = "places:\n  bathroom: {frame: odom, x: [3.0, 5.0], y: [-1.0, 1.0]}\n"
    (tmp_path / "places.yaml").write_text(places)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MEMORY_BAG_DIR", str(tmp_path / "bags"))
    monkeypatch.setenv("MEMORY_DEPLOYMENT", "robot")
    monkeypatch.setenv("MEMORY_CONFIG_OVERRIDES", "data.now=latest server.port=1")


@pytest.mark.parametrize(
    "words", [words for words in COMMANDS if not " ".join(words).startswith(NOT_HERE)], ids=" ".join
)
def test_every_command_runs(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    program, command, *given = words
    assert program == "ros2-memory"
    # There is no ROS here, which the doctor reports by its code; bags that nobody made stay.
    codes = {"doctor": {2}, "forget": {0, 1}}.get(command, {0})
    assert cli.main([command, *given, *MORE.get(command, [])]) in codes
    shown = capsys.readouterr()
    assert shown.out or shown.err


def test_the_rule_of_the_page_is_one_of_a_recorder(tmp_path: Path) -> None:
    rule = re.search(r"^```yaml\n# (\S+)\n(.*?)^```$", FORGET, re.MULTILINE | re.DOTALL)
    [command] = [words for words in COMMANDS if words[0] == "ros2-memory-recorder"]
    assert rule is not None
    (tmp_path / rule[1]).write_text(rule[2])
    (tmp_path / "topics.yaml").write_text("topics: [/odom, /privacy_mode]")
    [excluded] = exclusions_of(load_settings(["recording.topics_file=topics.yaml", *command[1:]]))
    assert (excluded.name, excluded.topic) == ("privacy mode", "/privacy_mode")
    assert (excluded.margin, excluded.stale) == (NS_PER_S, 10 * NS_PER_S)
    assert excluded.excludes_unknown
