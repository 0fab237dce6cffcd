"""What no sound client writes on stdin: the server answers what can be answered, and goes on."""

import json
import os
import subprocess
import threading
from pathlib import Path
from typing import IO

from tests.soak.clients import hostile_bodies, opening
from tests.soak.wire import call
from tests.support.forked_commands import write_command
from tests.support.processes import PATIENCE_S
from tests.support.robot_run import T0_S, write_run

GARBAGE = (b"", b"\x00", b"\xff\xff", b'"x"', b"[]", b"7", b"{", b"[" * 100_000)
DEEP = '{"timestamp": ' + "[" * 500 + "]" * 500 + "}"
UNPARSED = (
    call("find_things", '{"label": "\\ud800 \\"id\\": 7"}', 50),
    call("get_position_at", DEEP, 51),
    b'{"method": "ping", "params": {"name": "\\ud800", "id": 7}, "jsonrpc": "2.0", "id": "a"}',
    b'{"jsonrpc": "2.0", "id": 52, "method": "tools/call", "params": [1]}',
)
LAST = 99


def test_stdio_survives_whatever_is_written_to_it(tmp_path: Path) -> None:
    write_run(tmp_path / "bags")
    ours = ("MEMORY_", "MCP_", "ROS_")
    env = {name: text for name, text in os.environ.items() if not name.startswith(ours)}
    bodies = (*opening(), *(body for body, _ in hostile_bodies()), *GARBAGE, *UNPARSED)
    lines = (*bodies, call("data_time_range", "{}", LAST))
    write_command(tmp_path)
    process = subprocess.Popen(
        [str(tmp_path / "ros2-memory-server"), "data.now=latest"],
        env=env | {"MEMORY_BAG_DIR": str(tmp_path / "bags")},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        # Beside reading: neither pipe takes in all of it at once.
        written = b"".join(line + b"\n" for line in lines)
        writer = threading.Thread(target=_write, args=(process.stdin, written))
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
    assert {50, 51, "a", 52} <= refused.keys()
    assert "hex escape" in refused[50]
    assert "recursion limit" in refused[51]
    assert len(errors) >= 15
    assert set(errors) == {"invalid_arguments"}


def _write(pipe: IO[bytes], data: bytes) -> None:
    pipe.write(data)
    pipe.flush()
