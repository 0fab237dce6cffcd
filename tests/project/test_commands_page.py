"""The commands of "From the command line" run."""

from __future__ import annotations

import re
import shlex
from typing import TYPE_CHECKING

import pytest

from ros2_memory import cli
from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import odom, text, write_mcap
from tests.support.housekeepers import own_all
from tests.support.memories import ROOT

if TYPE_CHECKING:
    from pathlib import Path

PAGE = (ROOT / "docs/reference/commands.md").read_text(encoding="utf-8")
SECTION = PAGE.partition("## From the command line\n")[2].partition("\n## ")[0]
T0 = 1_795_161_600 * NS_PER_S
NOT_RUN = {"--install-completion": "it writes into the user's shell configuration"}
CODES = {"doctor": {2}}
"""Where the tests run there is no ROS, so the doctor finds something."""


SHELL = re.search(r"```sh\n(.*?)```", SECTION, re.DOTALL)
assert SHELL, "the section has no sh"
COMMANDS = [shlex.split(line, comments=True) for line in SHELL[1].splitlines()]


@pytest.fixture(autouse=True)
def memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot's bag, of which the clock and the words fit what the page asks."""
    messages = [odom(T0 + n * NS_PER_S // 10, n / 10, 0.0) for n in range(101)]
    messages.append(text(T0 + NS_PER_S, "scissors", "/vision/scene/scene_objects"))
    write_mcap(tmp_path / "bags" / "rec_0" / "rec_0.mcap", messages)
    own_all(tmp_path / "bags")
    write_mcap(tmp_path / "bags" / "old-bags" / "old_0.mcap", [odom(T0 - NS_PER_S, 0.0, 0.0)])
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MEMORY_BAG_DIR", str(tmp_path / "bags"))
    monkeypatch.setenv("MEMORY_DEPLOYMENT", "robot")
    monkeypatch.setenv("MEMORY_CONFIG_OVERRIDES", "data.now=latest server.port=1")


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_command_runs(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    program, *given = words
    assert program == "ros2-memory"
    if given[0] in NOT_RUN:
        pytest.skip(NOT_RUN[given[0]])
    more = ["--count", "1"] if given == ["watch"] else []
    assert cli.main([*given, *more]) in CODES.get(given[0], {0})
    shown = capsys.readouterr()
    assert shown.out or shown.err
