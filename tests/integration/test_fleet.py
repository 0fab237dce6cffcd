"""A server of several robots, as a process: what its clients are told, and about whom."""

import json
import time
from pathlib import Path

import httpx2
from mcp import Client
from mcp.client.sse import sse_client
from mcp.client.streamable_http import streamable_http_client

from tests.support.fleets import START_S, seeded, write_robot
from tests.support.robot_run import ask
from tests.support.served import serving

NAMES = ("r1", "r2", "r3", "offline")
MUG = {"topic": "/vision/*/scene_objects", "condition_type": "contains", "value": "mug"}


async def test_a_token_decides_about_whom_is_answered(tmp_path: Path) -> None:
    shift_s = int(time.time()) - 3600 - START_S
    robots = {name: seeded(name, shift_s=shift_s) for name in NAMES[:3]}
    for name, robot in robots.items():
        write_robot(robot, tmp_path / name / "bags")
    last = {
        name: max(at for at, what in robot.seen if what == "mug") for name, robot in robots.items()
    }
    folders = ", ".join(f"{name}: {tmp_path}/{name}/bags" for name in NAMES)
    site, office = "s" * 20, "o" * 20
    (tmp_path / "site").write_text(site + "\n")
    given = (f"fleet.robots={{{folders}}}", f"fleet.tokens={{{tmp_path}/site: [r1, r3]}}")
    more = {
        "MEMORY_DEPLOYMENT": "fleet",
        "MEMORY_API_TOKEN": office,
        "XDG_CACHE_HOME": str(tmp_path),
    }
    log = tmp_path / "log"
    with serving(tmp_path / "none", log, *given, **more) as served:
        for token, names in ((site, {"r1", "r3"}), (office, {*NAMES})):
            headers = {"Authorization": f"Bearer {token}"}
            async with (
                httpx2.AsyncClient(headers=headers) as shown,
                Client(streamable_http_client(served.url("/mcp"), http_client=shown)) as client,
            ):
                found = await ask(client, "memory_status", {})
                assert {row["robot_name"] for row in found[0]["robots"]} == names
                found = await ask(client, "find_last_match", MUG)
                rows = {row["robot_name"]: row["timestamp"] for row in found[0]["matches"]}
                assert rows == {name: at for name, at in last.items() if name in names}
                status = await client.read_resource("episodic://status")
                assert ("r2" in str(status.contents)) is (token == office)
                refused, _ = await ask(client, "list_frames", {"robot": "r2"})
                assert ("error" in refused) is (token == site)
                health = json.loads((await shown.get(served.url("/health"))).text)
                assert ("robots" in health) is (token == office)
                for path in ("/page/span", "/metrics", "/"):
                    other = await shown.get(served.url(path))
                    assert other.status_code == (403 if token == site else 404)
                listed = [
                    await client.list_tools(),
                    await client.list_resources(),
                    await client.list_resource_templates(),
                    await client.list_prompts(),
                    await client.get_prompt("use_memory"),
                ]
                assert "r2" not in str(listed)
            async with Client(sse_client(served.url("/sse"), headers=headers)) as client:
                found = await ask(client, "data_time_range", {})
                assert {row["robot_name"] for row in found[0]["robots"]} == names
                refused, _ = await ask(client, "list_frames", {"robot": "r2"})
                assert ("error" in refused) is (token == site)
        assert served.get("/mcp")[0] == 401
    output = log.read_text(encoding="utf-8")
    assert site not in output
    assert office not in output
