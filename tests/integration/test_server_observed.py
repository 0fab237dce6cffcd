"""The query server as its own process: who is answered, what is scraped, and spans."""

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import httpx2
import pytest
from mcp import Client
from mcp.client.sse import sse_client
from mcp.client.streamable_http import streamable_http_client

from tests.support.fleets import START_S, seeded, write_robot
from tests.support.processes import PATIENCE_S, http_server
from tests.support.robot_run import ask
from tests.support.served import Served, command, refusal, serving

GOOD = "kJ7-x._~+/0123456789=="
SHOWN = {"Authorization": f"Bearer {GOOD}"}
SWITCHES = {"server.metrics": "prometheus_client", "server.traces": "opentelemetry.sdk"}


@contextmanager
def collector() -> Iterator[tuple[str, list[bytes]]]:
    """Where spans are sent to, and the bodies that came."""
    bodies: list[bytes] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            bodies.append(self.rfile.read(int(self.headers["content-length"])))
            self.send_response(200)
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - its name
            """Tests have no log."""

    with http_server(Handler) as address:
        yield address, bodies


async def asked(served: Served) -> None:
    async with (
        httpx2.AsyncClient(headers=SHOWN) as shown,
        Client(streamable_http_client(served.url("/mcp"), http_client=shown)) as client,
    ):
        await ask(client, "data_time_range", {})
        await ask(client, "data_time_range", {})
        await ask(client, "get_position_at", {"timestamp": 5})
        await ask(client, "no_such_tool", {})


async def test_what_was_asked_and_what_is_known_is_scraped_by_whoever_shows_the_token(
    bag_dir: Path, tmp_path: Path
) -> None:
    parser = pytest.importorskip("prometheus_client.parser", reason="needs the extra observability")
    with serving(bag_dir, tmp_path / "log", "server.metrics=true", MEMORY_API_TOKEN=GOOD) as served:
        await asked(served)
        assert served.get("/metrics", {})[0] == 401
        assert served.get("/metrics", {"Authorization": "Bearer x"})[0] == 401
        assert served.get("/metrics", SHOWN | {"Host": "evil.example"})[0] == 421
        status, body = served.get("/metrics", SHOWN)
    assert status == 200
    found = {
        (sample.name, *sorted(sample.labels.items())): sample.value
        for family in parser.text_string_to_metric_families(body.decode())
        for sample in family.samples
    }
    assert all(name.startswith("ros2_memory_") for name, *_ in found)
    answered = {
        tuple(map(dict(labels).get, ("tool", "outcome", "reason"))): value
        for (name, *labels), value in found.items()
        if name == "ros2_memory_answers_total"
    }
    assert answered == {
        ("data_time_range", "ok", ""): 2,
        ("get_position_at", "no_data", "outside_range"): 1,
        ("unknown", "invalid_arguments", ""): 1,
    }
    assert found["ros2_memory_bags",] == 1
    assert found["ros2_memory_kept_bytes",] == (bag_dir / "run" / "run_0.mcap").stat().st_size
    assert found["ros2_memory_newest_data_age_seconds",] > 0
    assert found["ros2_memory_budget_bytes",] == 5e9


async def test_each_call_is_one_span_at_the_collector(bag_dir: Path, tmp_path: Path) -> None:
    pytest.importorskip("opentelemetry.sdk", reason="needs the extra observability")
    from opentelemetry.proto.collector.trace.v1 import trace_service_pb2  # noqa: PLC0415

    with collector() as (endpoint, bodies):
        more = {"OTEL_EXPORTER_OTLP_ENDPOINT": endpoint, "MEMORY_API_TOKEN": GOOD}
        with serving(bag_dir, tmp_path / "log", "server.traces=true", **more) as served:
            await asked(served)
            assert served.get("/metrics", SHOWN)[0] == 404
            # The last spans leave when it ends.
            served.process.terminate()
            assert served.process.wait(PATIENCE_S) == 0
    outcomes = []
    for body in bodies:
        for resource in trace_service_pb2.ExportTraceServiceRequest.FromString(body).resource_spans:
            named = {each.key: each.value.string_value for each in resource.resource.attributes}
            assert named["service.name"] == "ros2-memory-server"
            for scope in resource.scope_spans:
                for span in scope.spans:
                    if span.name.startswith("tools/call"):
                        output = {each.key: each.value.string_value for each in span.attributes}
                        outcomes.append((span.name, output.get("ros2_memory.outcome")))
    assert outcomes == [
        ("tools/call data_time_range", "ok"),
        ("tools/call data_time_range", "ok"),
        ("tools/call get_position_at", "no_data: outside_range"),
        ("tools/call no_such_tool", "invalid_arguments"),
    ]


@pytest.mark.parametrize("key", SWITCHES)
def test_without_the_extra_it_does_not_start_and_says_what_to_install(
    bag_dir: Path, key: str
) -> None:
    absent = SWITCHES[key]
    hidden = (
        f"import sys; sys.modules[{absent!r}] = None; from ros2_memory.server import main; "
        f"sys.exit(main(['server.transport=sse', 'server.port=0', '{key}=true']))"
    )
    output = refusal([sys.executable, "-c", hidden], bag_dir)
    assert len(output.splitlines()) == 2
    assert f"{key}: true needs the optional part of this package" in output
    assert "pip install '.[observability]'" in output


def test_there_are_no_metrics_over_stdio(bag_dir: Path) -> None:
    output = refusal(command("server.metrics=true"), bag_dir)
    assert len(output.splitlines()) == 2
    assert "server.transport=sse" in output


EVERYWHERE = ".".join("0000")


def test_it_does_not_start_without_a_token_where_others_can_reach_it(bag_dir: Path) -> None:
    said = refusal(command("server.transport=sse", "server.port=0"), bag_dir, MCP_HOST=EVERYWHERE)
    assert "MEMORY_API_TOKEN: missing" in said
    assert repr(EVERYWHERE) in said
    assert len(said.splitlines()) == 2


async def test_whoever_shows_the_token_is_answered_and_nobody_else(
    bag_dir: Path, tmp_path: Path
) -> None:
    credentials = tmp_path / "credentials"
    credentials.mkdir()
    (credentials / "memory_api_token").write_text(GOOD + "\n")
    more = {"MCP_HOST": EVERYWHERE, "CREDENTIALS_DIRECTORY": str(credentials)}
    with serving(bag_dir, tmp_path / "log", "logging.level=debug", **more) as served:
        async with Client(
            sse_client(served.url("/sse"), headers=SHOWN, timeout=PATIENCE_S)
        ) as client:
            assert (await ask(client, "data_time_range", {}))[0]["bags"] == 1
        async with (
            httpx2.AsyncClient(headers=SHOWN) as shown,
            Client(streamable_http_client(served.url("/mcp"), http_client=shown)) as client,
        ):
            assert (await ask(client, "data_time_range", {}))[0]["bags"] == 1
        for path in ("/sse", "/mcp", "/messages/"):
            for headers in ({}, {"Authorization": "Bearer " + GOOD[:-1]}):
                assert served.get(path, headers, "POST")[0] == 401
        assert json.loads(served.get("/health")[1]) == {"status": "ok"}
        assert json.loads(served.get("/health", SHOWN)[1])["bags"] == 1
        _leave_traces(served)
    output = (tmp_path / "log").read_text()
    assert '"event": "tool_call"' in output
    for secret in (GOOD, GOOD[:-2], "in-a-query"):
        assert secret not in output


def _leave_traces(served: Served) -> None:
    """Shows the token, and another, in every place that somebody may put into a log."""
    for path in (f"/sse?token={GOOD}", f"/mcp?access_token={GOOD}", "/health?token=in-a-query"):
        for headers in ({}, SHOWN | {"Host": "evil.example"}, SHOWN | {"Content-Length": "x"}):
            served.get(path, headers, "POST")
    served.get(f"/messages/?session_id={GOOD}", SHOWN, "POST")
    served.get(f"/messages/{GOOD}?session_id=in-a-query", SHOWN, "POST")


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
            async with httpx2.AsyncClient(headers=headers) as shown:
                streamed = streamable_http_client(served.url("/mcp"), http_client=shown)
                for each in (streamed, sse_client(served.url("/sse"), headers=headers)):
                    async with Client(each) as client:
                        found, _ = await ask(client, "memory_status", {})
                        assert {row["robot_name"] for row in found["robots"]} == names
                        found, _ = await ask(client, "find_last_match", MUG)
                        rows = {row["robot_name"]: row["timestamp"] for row in found["matches"]}
                        assert rows == {name: at for name, at in last.items() if name in names}
                        refused, _ = await ask(client, "list_frames", {"robot": "r2"})
                        assert ("error" in refused) is (token == site)
                        status = await client.read_resource("episodic://status")
                        assert ("r2" in str(status.contents)) is (token == office)
                        listed = [
                            await client.list_tools(),
                            await client.list_resources(),
                            await client.list_resource_templates(),
                            await client.list_prompts(),
                            await client.get_prompt("use_memory"),
                        ]
                        assert "r2" not in str(listed)
                health = json.loads((await shown.get(served.url("/health"))).text)
                assert ("robots" in health) is (token == office)
                for path in ("/page/span", "/metrics", "/"):
                    other = await shown.get(served.url(path))
                    assert other.status_code == (403 if token == site else 404)
        assert served.get("/mcp")[0] == 401
    output = log.read_text()
    assert site not in output
    assert office not in output
