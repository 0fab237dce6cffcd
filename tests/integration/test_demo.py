"""`ros2-memory demo` as a user runs it: the whole program, its server and its client."""

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from mcp import Client
from mcp.client.sse import sse_client
from mcp.types import TextContent
from rosbags.rosbag2 import Reader

from ros2_memory.demo.questions import QUESTIONS
from ros2_memory.demo.run import run_demo
from tests.support.processes import PATIENCE_S, until

PROGRAM = [str(Path(sys.executable).with_name("ros2-memory")), "demo"]


def environment(scratch: Path) -> dict[str, str]:
    """Ours, with temporary folders where the test sees them, and settings that must not count.

    The proxy is one of an office, which nobody reaches here.
    """
    folders = {"TMPDIR": str(scratch), "XDG_CACHE_HOME": str(scratch / "cache")}
    wrong = ("MEMORY_DEPLOYMENT", "MEMORY_CONFIG_DIR", "ROS_VISION_INTERFACES_PATH")
    proxies = dict.fromkeys(("HTTP_PROXY", "ALL_PROXY"), "http://127.0.0.1:9")
    return {**os.environ, **folders, **proxies, **dict.fromkeys(wrong, "no-such-thing")}


@contextmanager
def demonstrating(scratch: Path, *options: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A demo that goes on, and the address that it invites to; none is left running."""
    with subprocess.Popen(
        [*PROGRAM, "--port", "0", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(scratch),
    ) as demo:
        try:
            yield demo, _invited(demo)
        finally:
            demo.kill()


def ended(scratch: Path, *options: str, **how: Any) -> subprocess.CompletedProcess[str]:
    """A demo that ends by itself."""
    return subprocess.run(
        [*PROGRAM, "--once", *options],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
        env=environment(scratch),
        **how,
    )


@pytest.fixture
def scratch(tmp_path: Path) -> Path:
    folder = tmp_path / "tmp"
    folder.mkdir()
    return folder


def test_once_it_answers_every_question_rightly_and_leaves_nothing_behind(
    tmp_path: Path, scratch: Path
) -> None:
    # What lies in the folder where somebody tries it is no part of it.
    (tmp_path / "mcp.py").write_text("raise SystemExit('another mcp')\n")
    done = ended(scratch, "--port", "0", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    for question in QUESTIONS:
        assert f". {question.words}\n" in done.stdout
    assert done.stdout.count("\n    => ") == len(QUESTIONS)
    assert "WRONG" not in done.stdout
    assert f"{len(QUESTIONS)} of {len(QUESTIONS)} answers are right" in done.stdout
    assert list(scratch.iterdir()) == []


def test_a_wrong_answer_is_told_and_is_the_exit_code() -> None:
    """The memory is asked about 20 s ago where the judge holds it to 10 s ago."""
    position = next(one for one in QUESTIONS if one.tool == "get_position_seconds_ago")
    falsified = replace(position, arguments={"seconds_ago": 20})
    output: list[str] = []
    code = run_demo(output.append, [position, falsified], once=True, port=0)
    assert code == 1
    assert "WRONG: expected a time 10 s ago" in output[-2]
    assert output[-1] == "1 of 2 answers are right."


async def test_it_stays_for_other_clients_and_leaves_a_closed_recording(
    tmp_path: Path, scratch: Path
) -> None:
    bag_dir = tmp_path / "bags"
    with demonstrating(scratch, "--bag-dir", str(bag_dir)) as (demo, url):
        async with Client(sse_client(url, timeout=PATIENCE_S)) as client:
            tools = (await client.list_tools()).tools
            result = await client.call_tool("get_position_seconds_ago", {"seconds_ago": 10})
        demo.send_signal(signal.SIGTERM)
        assert demo.wait(timeout=PATIENCE_S) == 0
    assert len(tools) >= 17
    (content,) = result.content
    assert isinstance(content, TextContent)
    assert '"frame_id":"odom"' in content.text
    (recording,) = bag_dir.glob("*/")
    with Reader(recording) as reader:
        assert {connection.topic for connection in reader.connections} >= {"/odom", "/tf_static"}
    assert not _listens(url)


def test_its_server_ends_with_it_where_it_is_killed(scratch: Path) -> None:
    with demonstrating(scratch) as (_, url):
        pass
    until(lambda: not _listens(url) or None)


def test_a_port_in_use_is_named_and_nothing_stays(scratch: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        refused = ended(scratch, "--port", str(port))
    assert refused.returncode == 2
    assert f"port {port} on 127.0.0.1 is in use" in refused.stderr
    assert list(scratch.iterdir()) == []


def test_it_says_so_when_its_server_is_ended_by_someone_else(scratch: Path) -> None:
    with demonstrating(scratch) as (demo, _):
        children = Path(f"/proc/{demo.pid}/task/{demo.pid}/children").read_text().split()
        os.kill(int(children[0]), signal.SIGKILL)
        _, output = demo.communicate(timeout=PATIENCE_S)
    assert demo.returncode == 2
    assert "the server ended by itself" in output
    assert list(scratch.iterdir()) == []


def _invited(demo: subprocess.Popen[str]) -> str:
    """Reads until the demo says how to connect; the address it gives."""
    assert demo.stdout is not None
    for line in demo.stdout:
        found = re.search(r'url: "(http://127\.0\.0\.1:\d+/sse)"', line)
        if found:
            return found[1]
    raise AssertionError("the demo ended without an invitation")


def _listens(url: str) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", urlsplit(url).port)) == 0
