"""Every command, JSON, YAML and SQL in README and docs/ is run, or compared with the code.

What cannot be run here stands in `NOT_RUN`, with the reason.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import anyio
import duckdb
import pytest
import yaml
from mcp import Client
from mcp.client.stdio import StdioServerParameters, stdio_client

from ros2_memory import cli
from ros2_memory.bootstrap import exclusions_of
from ros2_memory.config import load_settings
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.serving.web_app import STREAM_PATH
from tests.support.bags import along_x, odom, text, write_mcap
from tests.support.documented_history import START_S, write_history
from tests.support.forked_commands import write_command
from tests.support.housekeepers import own_all
from tests.support.memories import ROOT
from tests.support.served import env_without_ours

DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
PROGRAMS = Path(sys.executable).parent
ELSEWHERE = {
    "commands.md/From the command line",  # below
    "forget.md",
    "tools.md",  # test_reference.py
    "errors.md",
    "files.md",
    "metrics.md/Scraping",  # a configuration of Prometheus
    "tls.md/nginx",  # tests/integration/test_proxy.py
    "tls.md/Caddy",
}
"""Pages, or sections of them, whose blocks are held by another test."""
NOT_RUN = {
    r"ros2-memory serve ": "tests/integration/test_server_process.py runs it",
    r"ros2-memory up ": "tests/integration/test_up.py runs it",
    r"sudo |journalctl ": "changes the machine: systemd, for root",
    r"docker |.* docker compose ": "needs Docker",
    r"pip install |python3 -m venv |~/uv/bin/uv |\. ~/ros2-memory/bin/activate": (
        "installs from the network"
    ),
    r"curl ": "asks a server on another machine, or one that a service manager started",
    r"ros2-memory demo": "tests/integration/test_demo.py runs it",
    r"ros2-memory --install-completion": "writes into the user's shell configuration",
    r"(\w+=\d+ )?uv run ": "these are the tests, and measurements",
}
"""Lines that begin so are not run, for this reason."""
MAY_FAIL = {"ros2-memory doctor"}
"""Where the tests run there is no ROS, which the doctor reports by its exit code."""
BOUND_S = 240
"""How long a block may take where the machine is busy."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str
    section: str
    language: str
    text: str

    @property
    def lines(self) -> list[str]:
        """Its commands, a continued one in one line."""
        joined = self.text.replace("\\\n", " ")
        return [line for line in joined.splitlines() if line and not line.startswith("#")]


def blocks_of(path: Path) -> Iterator[Block]:
    heading = ""
    text = path.read_text()
    for found in re.finditer(
        r"^##+ ([^\n]+)$|^```(\w*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL
    ):
        if found[1]:
            heading = found[1]
        else:
            yield Block(path.name, heading, found[2], found[3])


BLOCKS = [block for path in DOCUMENTS for block in blocks_of(path)]


def of(language: str) -> list[Any]:
    return [
        pytest.param(block, id=f"{block.page}:{block.section}:{number}")
        for number, block in enumerate(BLOCKS)
        if block.language == language
        and ELSEWHERE.isdisjoint({block.page, f"{block.page}/{block.section}"})
    ]


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_history(tmp_path_factory.mktemp("history") / "bags")


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("commands")
    write_command(folder)
    return folder


@pytest.fixture
def home(tmp_path: Path, history: Path, commands: Path) -> Path:
    """A user's home with bags in it."""
    for place in ("bags", "robot", "fleet/r1", "fleet/r2"):
        shutil.copytree(history, tmp_path / place)
    (tmp_path / "commands").symlink_to(commands)
    return tmp_path


def environment(home: Path) -> dict[str, str]:
    kept = env_without_ours()
    programs = (str(home / "commands"), str(PROGRAMS), kept.get("PATH", ""))
    return {**kept, "HOME": str(home), "PATH": os.pathsep.join(programs)}


@pytest.mark.parametrize("block", of("sh"))
def test_every_command_runs(block: Block, home: Path) -> None:
    script: list[str] = []
    for line in block.lines:
        if any(re.match(start, line) for start in NOT_RUN):
            continue
        if "ros2-memory-server" in line:
            serve([*script, f"exec env {line}"], home)
        elif "ros2-memory-recorder" in line:
            # No ROS here: what it is told is checked, and tests/integration runs it with a double.
            script.append(line.replace("ros2-memory-recorder", "ros2-memory config show"))
        elif line.partition("#")[0].strip() in MAY_FAIL:
            script.append(f"{line} || test $? -le 2")
        else:
            script.append(re.sub(r"(ros2-memory watch)\b", r"\1 --count 1", line))
    done = run(script, home)
    assert done.returncode == 0, done.stdout + done.stderr


IN_LINES = sorted(
    {
        words
        for path in DOCUMENTS
        for span in re.findall(r"`([^`\n]+)`", path.read_text())
        for words in [tuple(span.split())]
        if words[:1] == ("ros2-memory",) and len(words) > 1
    }
)
"""Commands within a sentence or a table."""


@pytest.mark.parametrize("words", IN_LINES, ids=" ".join)
def test_a_command_in_a_sentence_is_one_with_these_options(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    """Placeholders (`PATH`) stand for arguments, and `a|b` for several commands."""
    names = [each for word in words[1:] for each in word.split("|") if each.islower()]
    options = [each for each in words if each.startswith("--")]
    commands = [each for each in names if not each.startswith("-") and "." not in each]
    calls = [["plot", each] for each in commands[1:]] if commands[:1] == ["plot"] else [commands]
    for call in calls:
        assert cli.main([*call, "--help"]) == 0
        shown = capsys.readouterr().out
        assert [each for each in options if each not in shown] == []


def run(script: list[str], home: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-euc", "\n".join(script)],
        cwd=home,
        env=environment(home),
        capture_output=True,
        text=True,
        timeout=BOUND_S,
        check=False,
    )


def serve(script: list[str], home: Path) -> None:
    """Runs a server until it listens, on any port that is free, and ends it."""
    anywhere = re.sub(r" server\.port=\d+", "", "\n".join(script)) + " server.port=0"
    with subprocess.Popen(
        ["bash", "-euc", anywhere],
        cwd=home,
        env=environment(home),
        stderr=subprocess.PIPE,
        text=True,
    ) as server:
        assert server.stderr is not None
        said = []
        for line in server.stderr:
            said.append(line)
            if '"listening"' in line:
                break
        server.terminate()
        server.stderr.read()
        assert server.wait(BOUND_S) == 0, said
        assert '"listening"' in said[-1], said


@pytest.mark.parametrize("block", of("json"))
def test_every_server_that_a_desktop_client_is_told_of_starts_and_answers(
    block: Block, home: Path
) -> None:
    [(key, servers)] = json.loads(block.text.replace("/home/me", str(home))).items()
    assert key in {"mcpServers", "servers", "context_servers"}
    (home / "ros2-memory").mkdir()
    (home / "ros2-memory/bin").symlink_to(PROGRAMS)
    for name, entry in servers.items():
        if "command" not in entry:
            served = load_settings(["server.transport=sse"], env={}).server
            address = {entry.get("url"), entry.get("serverUrl")} - {None}
            assert address == {f"http://127.0.0.1:{served.port}/mcp"}
            assert entry.get("type", "http") == "http"
            continue
        env = {**environment(home), **entry.get("env", {})}
        env["PATH"] = f"{stand_ins(home)}{os.pathsep}{env['PATH']}"
        told = anyio.run(asked, entry["command"], entry.get("args", []), env)
        assert told["name"] == name
        assert told["reply"]["bags"] == 6


def stand_ins(home: Path) -> Path:
    """A folder with an `ssh` to this machine, without a network."""
    folder = home / "stand-ins"
    folder.mkdir(exist_ok=True)
    (folder / "ssh").write_text('#!/bin/sh\nshift\nexec sh -c "$*"\n')
    (folder / "ssh").chmod(0o755)
    return folder


async def asked(program: str, arguments: list[str], env: Mapping[str, str]) -> dict[str, Any]:
    server = StdioServerParameters(command=program, args=arguments, env=dict(env))
    with Path(os.devnull).open("w") as log:
        async with Client(stdio_client(server, errlog=log)) as client:
            result = await client.call_tool("data_time_range", {})
            [content] = result.content
            text: Any = content
            return {
                "name": client.server_info and client.server_info.name,
                "reply": json.loads(text.text),
            }


@pytest.mark.parametrize("block", of("yaml"))
def test_every_yaml_is_what_its_reader_takes(block: Block, tmp_path: Path) -> None:
    content = yaml.safe_load(block.text)
    if isinstance(content, list):
        served = load_settings(["server.transport=sse"], env={}).server
        for entry in content:
            assert entry["transport"] == "sse"
            # Behind a proxy with TLS it is the port of that.
            port = "" if entry["url"].startswith("https://") else f":{served.port}"
            assert re.fullmatch(rf"https?://[\w.-]+{port}{STREAM_PATH}", entry["url"])
        return
    [(key, value)] = content.items()
    shipped = {
        "topics": "topics.yaml",
        "schemas": "message_schemas.yaml",
        "labels": "labels.yaml",
        "rules": "triggers.yaml",
    }[key]
    like = yaml.safe_load((ROOT / "config" / shipped).read_text())[key]
    assert type(value) is type(like)
    if key == "schemas":
        assert value.items() <= like.items()


def test_the_queries_over_a_fleet_tell_what_each_robot_did(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocks = [block for block in BLOCKS if block.page == "fleet.md"]
    [export] = [block for block in blocks if "--parquet" in block.text]
    assert run(export.lines, home).returncode == 0
    monkeypatch.chdir(home)
    far, seen = (duckdb.execute(each.text).fetchall() for each in blocks if each.language == "sql")
    assert far == [("r1", pytest.approx(19.95)), ("r2", pytest.approx(19.95))]
    first, last = START_S + 22, START_S + 38
    assert seen == [("r1", first, last, 18), ("r2", first, last, 18)]


FORGET = (ROOT / "docs/how-to/forget.md").read_text()
PAGE = (ROOT / "docs/reference/commands.md").read_text()
SECTION = PAGE.partition("## From the command line\n")[2].partition("\n## ")[0]
SHELL = "".join(re.findall(r"```sh\n(.*?)```", SECTION + FORGET, re.DOTALL))
COMMANDS = [shlex.split(line, comments=True) for line in SHELL.splitlines()]
T0 = 1_795_161_600 * NS_PER_S
MORE = {"watch": ["--count", "1"], "forget": ["--yes", "data.places_file=places.yaml"]}
NOT_HERE = ("ros2-memory --install-completion", "ros2-memory-recorder")


@pytest.fixture
def terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot's bag, of which the clock and the words fit what the pages ask."""
    names = ("/vision/scene/scene_objects", "/camera/front", "/mic")
    messages = along_x(T0, 10.1, mps=1.0, hz=10)
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


@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize(
    "words", [words for words in COMMANDS if not " ".join(words).startswith(NOT_HERE)], ids=" ".join
)
def test_every_command_of_a_terminal_runs(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    program, command, *given = words
    assert program == "ros2-memory"
    # There is no ROS here, which the doctor reports by its code; bags that nobody made stay.
    codes = {"doctor": {2}, "forget": {0, 1}}.get(command, {0})
    assert cli.main([command, *given, *MORE.get(command, [])]) in codes
    shown = capsys.readouterr()
    assert shown.out or shown.err


@pytest.mark.usefixtures("terminal")
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
