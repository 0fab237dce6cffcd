"""A fleet of six robots: three that are well, one damaged, one offline, one a year ahead.

The questions are those that a planner asks about one robot.
"""

from __future__ import annotations

import json
import os
import time
from typing import TYPE_CHECKING, Any

import anyio
import httpx2
import pytest
from mcp import Client
from mcp.client.sse import sse_client
from mcp.client.streamable_http import streamable_http_client
from mcp.types import ResourceTemplateReference

from ros2_memory.bootstrap import build_memory, build_server
from ros2_memory.bootstrap_fleet import build_fleet
from ros2_memory.config import load_settings
from tests.integration.test_server_process import serving
from tests.support.fleets import START_S, SeededRobot, seeded, write_robot
from tests.support.robot_run import ask

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ros2_memory.serving.mcp_server import EpisodicServer

WELL = ("r1", "r2", "r3")
NAMES = (*WELL, "ahead", "damaged", "offline")
YEAR_S = 365 * 86_400
MUG = {"topic": "/vision/*/scene_objects", "condition_type": "contains", "value": "mug"}


class Robots:
    """The six robots' folder, and what the five with bags saw."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        shift = int(time.time()) - 3600 - START_S
        self.of: dict[str, SeededRobot] = {
            name: seeded(name, shift_s=shift + (YEAR_S if name == "ahead" else 0))
            for name in NAMES
            if name != "offline"
        }
        for name, robot in self.of.items():
            write_robot(robot, folder / name / "bags")
        whole = folder / "damaged" / "bags" / "rec" / "rec_1.mcap"
        whole.write_bytes(b"no bag " * 100)
        old = (time.time() - 1800,) * 2
        os.utime(whole, old)
        self.overrides = [
            "fleet.robots={" + ", ".join(f"{n}: {folder}/{n}/bags" for n in NAMES) + "}"
        ]

    def last(self, name: str, label: str) -> float | None:
        """When a robot last saw a label, as far as its bags can be read."""
        robot = self.of[name]
        until = robot.start_s + 30 if name == "damaged" else robot.end_s + 1
        return max(
            (float(at) for at, what in robot.seen if what == label and at < until), default=None
        )


@pytest.fixture(scope="module")
def robots(tmp_path_factory: pytest.TempPathFactory) -> Robots:
    return Robots(tmp_path_factory.mktemp("robots"))


@pytest.fixture(scope="module")
def server(robots: Robots) -> Iterator[EpisodicServer]:
    settings = load_settings(robots.overrides, {"MEMORY_DEPLOYMENT": "fleet"})
    fleet = build_fleet(settings)
    assert fleet is not None
    server = build_server(settings, build_memory(settings), fleet=fleet)
    yield server
    server.dispatcher.stop()


def reply(server: EpisodicServer, tool: str, **given: Any) -> Any:
    async def answer() -> str:
        return (await server.dispatcher.answer(tool, given)).text

    return json.loads(anyio.run(answer))


def test_which_robot_last_saw_it(server: EpisodicServer, robots: Robots) -> None:
    found = reply(server, "find_last_match", **MUG)
    truth = {name: robots.last(name, "mug") for name in robots.of}
    assert {row["robot_name"]: row["timestamp"] for row in found["matches"]} == {
        name: at for name, at in truth.items() if at is not None
    }
    times = [row["timestamp"] for row in found["matches"] if row["robot_name"] != "ahead"]
    assert times == sorted(times, reverse=True)
    assert found["matches"][-1]["robot_name"] == "ahead"


def test_trouble_is_named_and_spoils_nobody_elses_answer(server: EpisodicServer) -> None:
    notes = reply(server, "find_matches", **MUG)["notes"]
    for name, words in (
        ("offline", "does not exist"),
        ("ahead", "clock that ran ahead"),
        ("damaged", "rec/rec_1.mcap"),
    ):
        assert any(name in note and words in note for note in notes), (name, notes)


def test_never_is_claimed_of_those_alone_whose_bags_were_read(server: EpisodicServer) -> None:
    found = reply(server, "find_last_match", **(MUG | {"value": "elephant"}))
    assert found["matches"] == []
    assert {*found["never"]} == {*WELL, "ahead"}


def test_where_it_was_then_is_asked_of_the_robot_that_is_named(
    server: EpisodicServer, robots: Robots
) -> None:
    newest = reply(server, "find_last_match", **MUG)["matches"][0]
    name, at = newest["robot_name"], newest["timestamp"]
    position = reply(server, "get_position_at", timestamp=at, robot=name)
    assert (position["robot_name"], position["timestamp"]) == (name, at)
    assert position["y"] == pytest.approx(0.1 * (at - robots.of[name].start_s))
    refused = reply(server, "get_position_at", timestamp=at)
    assert ", ".join(NAMES) in refused["detail"]


def test_what_there_is_and_what_happened_is_told_of_each(server: EpisodicServer) -> None:
    things = reply(server, "find_things", label="mug")["things"]
    assert {row["robot_name"] for row in things} >= {*WELL}
    rows = reply(server, "recap", last_s=2 * 3600)["robots"]
    distances = {row["robot_name"]: row["distance_m"] for row in rows if row["robot_name"] in WELL}
    assert len(distances) == 3
    assert len({*distances.values()}) == 1
    status = {row["robot_name"]: row for row in reply(server, "memory_status")["robots"]}
    assert status.keys() == {*NAMES}
    assert status["damaged"]["damaged"] == 1
    assert "does not exist" in status["offline"]["doubts"]
    assert status["r1"]["doubts"] == "no loss or fault was found"


async def test_a_token_decides_about_whom_is_answered(robots: Robots, tmp_path: Path) -> None:
    site, office = "s" * 20, "o" * 20
    (tmp_path / "site").write_text(site + "\n")
    tokens = f"fleet.tokens={{{tmp_path}/site: [r1, r3]}}"
    more = {
        "MEMORY_DEPLOYMENT": "fleet",
        "MEMORY_API_TOKEN": office,
        "XDG_CACHE_HOME": str(tmp_path),
    }
    log = tmp_path / "log"
    with serving(tmp_path / "none", log, *robots.overrides, tokens, **more) as served:
        for token, names in ((site, {"r1", "r3"}), (office, {*NAMES})):
            headers = {"Authorization": f"Bearer {token}"}
            async with (
                httpx2.AsyncClient(headers=headers) as shown,
                Client(streamable_http_client(served.url("/mcp"), http_client=shown)) as client,
            ):
                found = await ask(client, "memory_status", {})
                assert {row["robot_name"] for row in found[0]["robots"]} == names
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
                    await client.complete(
                        ResourceTemplateReference(uri="episodic://schema/{type}"),
                        {"name": "type", "value": ""},
                    ),
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
