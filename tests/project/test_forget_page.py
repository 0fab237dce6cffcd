"""The commands of docs/how-to/forget.md run, and delete what the page says of each."""

from __future__ import annotations

import os
import re
import shlex
import time
from datetime import datetime
from typing import TYPE_CHECKING, Final, NamedTuple

import pytest

from ros2_memory import cli
from ros2_memory.bootstrap import exclusions_of
from ros2_memory.config import load_settings
from ros2_memory.core.timebase import NS_PER_S as S
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import odom, text, write_mcap
from tests.support.column_worlds import EVERYTHING
from tests.support.housekeepers import own_all
from tests.support.memories import ROOT

if TYPE_CHECKING:
    from pathlib import Path

PAGE: Final = (ROOT / "docs/how-to/forget.md").read_text(encoding="utf-8")
LINES: Final = [
    line
    for block in re.findall(r"^```sh\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    for line in block.splitlines()
]
COMMANDS: Final = [line for line in LINES if line.startswith("ros2-memory forget ")]
TOPICS: Final = ("/odom", "/camera/front", "/mic")
SECONDS: Final = 240
"""The robot drives along x at 0.05 m/s, and the bathroom is from 3 m to 5 m."""


class Gone(NamedTuple):
    """Which messages a command deletes: of these topics, from one second to another.

    At the edges of a place `slack` seconds more may go.
    """

    topics: tuple[str, ...]
    first: int
    last: int
    slack: int = 0


DELETED: Final = {
    "--dry-run": Gone((), 0, 0),
    "--topic '/camera/*' --topic /mic --start": Gone(TOPICS[1:], 0, SECONDS),
    "--where bathroom --start": Gone(TOPICS, 59, 101, slack=1),
    "--where bathroom --topic '/camera/*' --last": Gone(TOPICS[1:2], 59, 101, slack=1),
    "--topic '*' --start": Gone(TOPICS, 70, 200),
}
"""By what a command has that no other has."""


def write_drive(bag_dir: Path, begin: int) -> None:
    """Four bags of a minute each, which nobody has written to for long."""
    for minute in range(SECONDS // 60):
        messages = []
        for second in range(60 * minute, 60 * minute + 60):
            at = begin + second * S
            messages += [
                odom(at, second / 20, 0.0),
                *(text(at, "hum", name) for name in TOPICS[1:]),
            ]
        path = write_mcap(bag_dir / "rec" / f"rec_{minute}.mcap", messages)
        os.utime(path, ns=(begin, begin))
    own_all(bag_dir)


def stored(bag_dir: Path, begin: int) -> set[tuple[str, int]]:
    """The topic and the second of each message that is left."""
    return {
        (record.channel.topic, (record.log_time - begin) // S)
        for path in bag_dir.rglob("*.mcap")
        for record in McapReader().records(path, TOPICS, EVERYTHING)
    }


def test_each_command_of_the_page_is_known_here() -> None:
    assert [[words for words in DELETED if words in line] for line in COMMANDS] == [
        [words] for words in DELETED
    ]


@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_deletes_what_the_page_says(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    begin = round(datetime(2026, 11, 20, 8).astimezone().timestamp()) * S
    if "--last" in line:
        begin = round(time.time() - 1000) * S
    bag_dir, places = tmp_path / "bags", tmp_path / "places.yaml"
    write_drive(bag_dir, begin)
    places.write_text("places:\n  bathroom: {frame: odom, x: [3.0, 5.0], y: [-1.0, 1.0]}\n")
    monkeypatch.setenv("MEMORY_BAG_DIR", str(bag_dir))
    monkeypatch.setenv("MEMORY_DEPLOYMENT", "robot")
    assert cli.main(["index"]) == 0
    before = stored(bag_dir, begin)
    assert len(before) == len(TOPICS) * SECONDS
    program, *words = shlex.split(line, comments=True)
    assert program == "ros2-memory"
    assert cli.main([*words, "--yes", f"data.places_file={places}"]) == 0
    gone = before - stored(bag_dir, begin)
    [expected] = [deleted for key, deleted in DELETED.items() if key in line]
    must, may = (
        {
            (topic, second)
            for topic, second in before
            if topic in expected.topics
            and expected.first + within <= second <= expected.last - within
        }
        for within in (expected.slack, -expected.slack)
    )
    assert must <= gone <= may
    assert ("would be deleted: 4 bags" in capsys.readouterr().out) == ("--dry-run" in line)


def test_the_rule_of_the_page_is_one_of_a_recorder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rule = re.search(r"^```yaml\n# (\S+)\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    [command] = [line for line in LINES if line.startswith("ros2-memory-recorder ")]
    assert rule is not None
    (tmp_path / rule[1]).write_text(rule[2])
    (tmp_path / "topics.yaml").write_text("topics: [/odom, /privacy_mode]")
    monkeypatch.chdir(tmp_path)
    given = ["recording.topics_file=topics.yaml", *shlex.split(command)[1:]]
    [excluded] = exclusions_of(load_settings(given))
    assert (excluded.name, excluded.topic) == ("privacy mode", "/privacy_mode")
    assert (excluded.margin, excluded.stale, excluded.excludes_unknown) == (S, 10 * S, True)
