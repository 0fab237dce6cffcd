"""The query server as its own process: its start, each transport, progress, and its end."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import anyio
import httpx2
import pytest
from mcp import Client
from mcp.client.sse import sse_client
from mcp.client.stdio import StdioServerParameters, stdio_client
from mcp.types import TextContent

from ros2_memory.server import _show_page, main
from tests.soak.clients import hostile_bodies, opening
from tests.soak.wire import call
from tests.support.examples import LONG
from tests.support.forked_commands import write_command
from tests.support.processes import PATIENCE_S, service_manager
from tests.support.robot_run import CALLS, T0_S, ask, ask_everything, write_run
from tests.support.served import PROGRAM, Served, command, environment, refusal, serving
from tests.timing import in_time

BETWEEN_ATTEMPTS_S = 0.05
ENDS_WITHIN_S = 5.0
"""Far above the second that it should take; more would be a service manager's patience."""


def test_serve_and_a_path_need_nothing_else(bag_dir: Path, tmp_path: Path) -> None:
    beside = tmp_path / "config"
    beside.mkdir()
    (beside / "places.yaml").write_text("places: {}\n")
    (beside / "config.yaml").write_text("server: {page: false}\n")
    (tmp_path / "mcp.py").write_text("raise SystemExit('another mcp')\n")
    env = environment(tmp_path / "elsewhere", MCP_PORT="0", DISPLAY=":99", BROWSER="false")
    del env["MEMORY_BAG_DIR"]
    program = [sys.executable, "-m", "ros2_memory.cli", "serve", str(bag_dir)]
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(
            program, env=env, stdout=subprocess.PIPE, stderr=log, text=True, cwd=tmp_path
        )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("the page of this memory: http://127.0.0.1:")
        served = Served(process, int(line.rstrip("/\n").rpartition(":")[2]), tmp_path / "log")
        status, page = served.get("/")
        assert (status, b"<html" in page) == (200, True)
        (starting,) = (each for each in served.events() if each["event"] == "starting")
        assert starting["bag_dir"] == str(bag_dir)
        assert str(beside / "places.yaml") in starting["files"]
        (unused,) = (each for each in served.events() if each["event"] == "config_unused")
        assert str(beside / "config.yaml") in unused["reason"]
    finally:
        process.kill()
        process.communicate()


def test_a_page_that_is_not_served_is_not_announced(bag_dir: Path, tmp_path: Path) -> None:
    write_command(tmp_path)
    program = [str(tmp_path / "ros2-memory"), "serve", str(bag_dir), "server.page=false"]
    with serving(bag_dir, tmp_path / "log", program=program) as served:
        assert served.get("/")[0] == 404
        served.process.terminate()
        served.process.wait(PATIENCE_S)
        assert served.process.stdout is not None
        assert served.process.stdout.read() == b""


@pytest.mark.parametrize(
    ("how", "display", "is_terminal", "opened"),
    [
        ("open", ":0", True, 1),
        ("open", ":0", False, 0),
        ("open", "", True, 0),
        ("print", ":0", True, 0),
    ],
)
def test_the_browser_opens_where_somebody_sits_at_a_display(
    monkeypatch: pytest.MonkeyPatch, how: str, display: str, is_terminal: bool, opened: int
) -> None:
    seen: list[str] = []
    monkeypatch.setattr("webbrowser.open", seen.append)
    monkeypatch.setattr("threading.Thread.start", lambda thread: thread.run())
    monkeypatch.setattr("sys.stdout.isatty", lambda: is_terminal, raising=False)
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    _show_page(how, "http://127.0.0.1:1")
    assert seen == ["http://127.0.0.1:1/"] * opened


def clients_of(served: Served) -> tuple[Client, ...]:
    """Of each transport over HTTP."""
    streamed, events = served.url("/mcp"), sse_client(served.url("/sse"), timeout=PATIENCE_S)
    return Client(streamed), Client(streamed, mode="legacy"), Client(events)


async def replies(client: Client) -> list[tuple[str, str, bool]]:
    """Every tool's reply, and every kind of refusal, to the letter."""
    results = [(name, await client.call_tool(name, given)) for name, given in CALLS]
    return [(name, str(result.content), bool(result.is_error)) for name, result in results]


async def test_every_transport_gives_the_same_replies(bag_dir: Path, tmp_path: Path) -> None:
    program, *arguments = command("logging.level=debug")
    alone = StdioServerParameters(command=program, args=arguments, env=environment(bag_dir))
    with (tmp_path / "stdio").open("w") as log:
        async with Client(stdio_client(alone, errlog=log)) as client:
            await ask_everything(client)
            expected = await replies(client)
    with serving(bag_dir, tmp_path / "log") as served:
        for each in clients_of(served):
            async with each as client:
                assert await replies(client) == expected
        called = [each for each in served.events() if each["event"] == "tool_call"]
        assert len(called) == 3 * len(CALLS)
        assert all(each["correlation_id"] and each["duration_ms"] > 0 for each in called)


async def test_an_empty_memory_answers_and_a_directory_that_comes_later_is_found(
    bag_dir: Path, tmp_path: Path
) -> None:
    later = tmp_path / "later"
    with serving(later, tmp_path / "log", "reader.index_refresh_s=0.05") as served:
        async with Client(served.url("/mcp")) as client:
            reply, is_error = await ask(client, "get_position_seconds_ago", {"seconds_ago": 1})
            assert (reply["error"], reply["reason"], is_error) == ("no_data", "empty_memory", False)
            span, _ = await ask(client, "data_time_range", {})
            assert span["earliest"] is None
            bag_dir.rename(later)
            with anyio.fail_after(PATIENCE_S):
                while not span["bags"]:
                    await anyio.sleep(BETWEEN_ATTEMPTS_S)
                    span, _ = await ask(client, "data_time_range", {})
            assert span["earliest"] == T0_S


@pytest.mark.parametrize("number", [signal.SIGTERM, *LONG * [signal.SIGINT]])
def test_a_signal_ends_it_with_clients_connected(
    bag_dir: Path, tmp_path: Path, number: signal.Signals
) -> None:
    in_time(lambda: anyio.run(_end_with_clients, bag_dir, tmp_path, number))


async def _end_with_clients(bag_dir: Path, tmp_path: Path, number: signal.Signals) -> None:
    with serving(bag_dir, tmp_path / "log", program=PROGRAM) as served:
        connected = anyio.Event()

        async def stay() -> None:
            async with Client(sse_client(served.url("/sse"), timeout=PATIENCE_S)) as client:
                await ask(client, "data_time_range", {})
                connected.set()
                await anyio.sleep_forever()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(stay)
            await connected.wait()
            served.process.send_signal(number)
            stdout, _ = await anyio.to_thread.run_sync(
                lambda: served.process.communicate(timeout=ENDS_WITHIN_S)
            )
            tasks.cancel_scope.cancel()
        assert served.process.returncode == 0
        assert stdout == b""
        assert served.events()[-1]["event"] == "stopped"
        assert not [each for each in served.events() if each["level"] == "error"]


def test_a_port_in_use_is_told_in_one_line(bag_dir: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        env = environment(bag_dir, MCP_TRANSPORT="sse", MCP_PORT=str(port))
        write_command(bag_dir.parent)
        program = [str(bag_dir.parent / "ros2-memory-server"), "logging.level=error"]
        ended = subprocess.run(program, env=env, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stdout == ""
    assert ended.stderr == (
        f"ros2-memory-server: port {port} on 127.0.0.1 is in use by another program; "
        "stop that one, or choose another port with MCP_PORT\n"
    )


def test_a_refused_configuration_is_told_on_stderr(bag_dir: Path) -> None:
    assert "server.prot" in refusal(command("server.prot=1"), bag_dir)


@pytest.mark.parametrize(("option", "reply"), [("--version", "0.1"), ("--help", "key=value")])
def test_version_and_help_are_printed(
    option: str, reply: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="0"):
        main([option])
    assert reply in capsys.readouterr().out


def stdio_process(bag_dir: Path) -> subprocess.Popen[bytes]:
    """The server over stdio, with its handshake done."""
    process = subprocess.Popen(
        command("logging.level=debug"),
        env=environment(bag_dir),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(opening()[0] + b"\n")
    process.stdin.flush()
    assert json.loads(process.stdout.readline())["result"]["serverInfo"]["name"] == "episodic"
    return process


@pytest.mark.parametrize("number", [None, signal.SIGINT, *LONG * [signal.SIGTERM]])
def test_the_end_of_stdin_or_a_signal_ends_it_and_nothing_but_the_wire_was_on_stdout(
    bag_dir: Path, number: signal.Signals | None
) -> None:
    def end() -> None:
        process = stdio_process(bag_dir)
        if number:
            process.send_signal(number)
            process.wait(timeout=ENDS_WITHIN_S)
        rest, _ = process.communicate(timeout=ENDS_WITHIN_S)
        assert (process.returncode, rest) == (0, b"")

    in_time(end)


def test_it_is_ready_when_it_listens_and_says_when_it_stops(tmp_path: Path) -> None:
    with service_manager(tmp_path / "notify") as manager:
        address = str(tmp_path / "notify")
        env = environment(tmp_path, NOTIFY_SOCKET=address, MCP_TRANSPORT="sse", MCP_PORT="0")
        write_command(tmp_path)
        argv = [str(tmp_path / "ros2-memory-server"), "recorder=none"]
        with subprocess.Popen(argv, env=env, stderr=subprocess.DEVNULL) as server:
            assert manager.recv(100) == b"READY=1"
            server.send_signal(signal.SIGTERM)
            assert manager.recv(100) == b"STOPPING=1"
            assert server.wait(PATIENCE_S) == 0


INTERRUPTING = """
import os, signal, sys
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == os.environ["INTERRUPTED_AT"]:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
"""


@pytest.mark.parametrize(
    ("program", "module"),
    [
        ("ros2-memory", "typer"),
        ("ros2-memory-recorder", "structlog"),
        ("ros2-memory-server", "structlog"),
    ],
)
def test_ctrl_c_while_a_program_imports_ends_it_without_a_traceback(
    tmp_path: Path, program: str, module: str
) -> None:
    (tmp_path / "sitecustomize.py").write_text(INTERRUPTING)
    path = shutil.which(program, path=Path(sys.executable).parent)
    assert path is not None
    ended = subprocess.run(
        [path, "--help"],
        env=os.environ | {"PYTHONPATH": str(tmp_path), "INTERRUPTED_AT": module},
        capture_output=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (-signal.SIGINT, b"", b"")


GARBAGE = (b"", b"\x00", b"\xff\xff", b'"x"', b"[]", b"7", b"{", b"[" * 100_000)
DEEP = '{"timestamp": ' + "[" * 500 + "]" * 500 + "}"
UNPARSED = (
    call("find_things", '{"label": "\\ud800 \\"id\\": 7"}', 50),
    call("get_position_at", DEEP, 51),
    b'{"method": "ping", "params": {"name": "\\ud800", "id": 7}, "jsonrpc": "2.0", "id": "a"}',
    b'{"jsonrpc": "2.0", "id": 52, "method": "tools/call", "params": [1]}',
    b'{"jsonrpc": "2.0", "id": "\\ud800", "method": "ping"}',
    b'{"jsonrpc": "2.0", "id": true, "method": 7}',
)
LAST = 99


def test_stdio_survives_whatever_is_written_to_it(tmp_path: Path) -> None:
    write_run(tmp_path / "bags")
    bodies = (*opening(), *(body for body, _ in hostile_bodies()), *GARBAGE, *UNPARSED)
    lines = (*bodies, call("data_time_range", "{}", LAST))
    write_command(tmp_path)
    process = subprocess.Popen(
        [str(tmp_path / "ros2-memory-server"), "data.now=latest"],
        env=environment(tmp_path / "bags"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        # Beside reading: neither pipe takes in all of it at once.
        written = [b"".join(line + b"\n" for line in lines)]
        writer = threading.Thread(target=process.stdin.writelines, args=(written,))
        writer.start()
        replies = []
        for line in process.stdout:
            replies.append(json.loads(line))
            if replies[-1]["id"] == LAST:
                break
        assert process.poll() is None
        writer.join()
        process.stdin.close()
        assert process.wait(timeout=PATIENCE_S) == 0
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    reply = json.loads(replies[-1]["result"]["content"][0]["text"])
    assert reply["earliest"] == T0_S
    errors = [
        json.loads(each["result"]["content"][0]["text"])["error"]
        for each in replies[1:-1]
        if "content" in each.get("result", {})
    ]
    refused = {each["id"]: each["error"]["message"] for each in replies if "error" in each}
    assert {50, 51, "a", 52, None} <= refused.keys()
    assert "hex escape" in refused[50]
    assert "recursion limit" in refused[51]
    assert len(errors) >= 15
    assert set(errors) == {"invalid_arguments"}


REPORTS = 2
SLOW = "list_frames"
REPORTING = f"""
import sys

import anyio

from ros2_memory import server
from ros2_memory.serving import mcp_server
from ros2_memory.serving.dispatch import Dispatcher

reported = 0
answer, report = Dispatcher.answer, mcp_server.EpisodicServer._report_progress

async def answer_late(self, name, *given, **options):
    global reported
    reported = 0
    while name == {SLOW!r} and reported < {REPORTS}:
        await anyio.sleep(0.001)
    return await answer(self, name, *given, **options)

async def count(self, send):
    async def counted(*progress):
        global reported
        await send(*progress)
        reported += 1
    await report(self, counted)

mcp_server.PROGRESS_EVERY_S = 0.001
Dispatcher.answer = answer_late
mcp_server.EpisodicServer._report_progress = count
sys.exit(server.main())
"""
"""The server, with a tool that answers once two reports of its progress were sent."""


async def asked_for_progress(client: Client) -> None:
    reports: list[float] = []
    received = anyio.Event()

    async def note(progress: float, total: float | None, message: str | None) -> None:
        del total, message
        reports.append(progress)
        if len(reports) == REPORTS:
            received.set()

    with anyio.fail_after(PATIENCE_S):
        result = await client.call_tool(SLOW, {}, progress_callback=note)
        await received.wait()
    [block] = result.content
    assert isinstance(block, TextContent)
    assert "frames" in json.loads(block.text)
    assert reports[:REPORTS] == [1, 2]


def posted(served: Served, name: str, accept: str, **meta: object) -> Any:
    call = {"name": name, "arguments": {}, **({"_meta": meta} if meta else {})}
    body = {"jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": call}
    return httpx2.post(
        served.url("/mcp"), json=body, headers={"accept": accept}, timeout=PATIENCE_S
    )


BOTH = "application/json, text/event-stream"


async def test_progress_reaches_clients_of_every_transport(bag_dir: Path, tmp_path: Path) -> None:
    with serving(
        bag_dir, tmp_path / "log", program=[sys.executable, "-c", REPORTING, "data.now=latest"]
    ) as served:
        for each in clients_of(served):
            async with each as client:
                await asked_for_progress(client)
        streamed = posted(served, SLOW, BOTH, progressToken="mine")
        assert streamed.headers["content-type"].startswith("text/event-stream")
        told = [json.loads(line[6:]) for line in streamed.text.splitlines() if line[:6] == "data: "]
        assert [each["params"]["progressToken"] for each in told[:-1]] == ["mine"] * (len(told) - 1)
        plain = posted(served, SLOW, "application/json", progressToken="mine")
        unasked = posted(served, "list_recorded_topics", BOTH)
        for each in (plain, unasked):
            assert each.headers["content-type"] == "application/json"
            assert each.json()["result"]["content"]
