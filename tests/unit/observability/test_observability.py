"""The adapters of the telemetry port: figures for Prometheus, spans for OpenTelemetry.

Gauges of a memory are measured without a look at its bags.
"""

import errno
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, cast
from unittest.mock import Mock

import pytest
from mcp import Client, MCPError
from opentelemetry.sdk.trace import ReadableSpan
from prometheus_client.metrics_core import Metric
from structlog.testing import capture_logs

from ros2_memory import package_version
from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.core.errors import ConfigError, NoDataError, NoDataReason
from ros2_memory.core.telemetry import UNKNOWN_TOOL, Answered, Telemetry
from ros2_memory.core.timebase import NS_PER_S
from ros2_memory.history.context import Call
from ros2_memory.results import Answer
from ros2_memory.serving.mcp_server import EpisodicServer
from tests.support.bags import text, write_mcap
from tests.support.clocks import SettableClock
from tests.support.heartbeats import beat
from tests.support.memories import memory_of
from tests.unit.serving.test_dispatch import served, tool, value

pytest.importorskip("prometheus_client", reason="needs the extra observability")
pytest.importorskip("opentelemetry.sdk", reason="needs the extra observability")

from opentelemetry import trace
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from prometheus_client import (
    CollectorRegistry,
    Counter,
    enable_created_metrics,
    generate_latest,
)
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.parser import text_string_to_metric_families

from ros2_memory.observability.opentelemetry import (
    Traces,
    provider_to,
    traces_from_environment,
)
from ros2_memory.observability.prometheus import MemoryGauges, Metrics

T0 = 1_700_000_000 * NS_PER_S
Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


async def scraped(metrics: Metrics) -> Samples:
    shown = await metrics.exposition()
    assert shown.content_type == "text/plain; version=0.0.4; charset=utf-8"
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(shown.body.decode())
        for sample in family.samples
    }


def at(found: Samples, name: str, **labels: str) -> float:
    return found[f"ros2_memory_{name}", frozenset(labels.items())]


async def test_whatever_clients_call_their_tools_labels_stay_few_and_whole() -> None:
    metrics = Metrics(lambda: ())
    full = tool("full", lambda _: value(7))
    dispatcher = served(full, telemetry=Telemetry((metrics,))).dispatcher
    hostile = ['a"} 1\nup 0\n#', "\\", "\x00", "\ud800", "x" * 100_000, "full\n", "", "{"]
    await dispatcher.answer("full", {})
    for n in range(200):
        name = hostile[n % len(hostile)] + str(n)
        await dispatcher.answer(name, {name: name})
    assert len((await metrics.exposition()).body) < 20_000
    found = await scraped(metrics)
    tool_labels = {dict(labels).get("tool") for _, labels in found}
    assert tool_labels == {None, "full", UNKNOWN_TOOL}
    asked = {"tool": UNKNOWN_TOOL, "outcome": "invalid_arguments", "reason": ""}
    assert at(found, "answers_total", **asked) == 200
    dispatcher.stop()


async def test_a_disk_that_hangs_costs_the_figures_of_the_memory_alone() -> None:
    freed = threading.Event()

    def hanging() -> list[Metric]:
        freed.wait()
        return [GaugeMetricFamily("ros2_memory_bags", "Bags.", 3)]

    metrics = Metrics(hanging, timeout_s=0.01)
    metrics.answered(Answered("ask", "ok", 0.03, 12, "abc", {}))
    try:
        for _ in range(2):
            found = await scraped(metrics)
            assert at(found, "answers_total", tool="ask", outcome="ok", reason="") == 1
            assert "ros2_memory_bags" not in {name for name, _ in found}
    finally:
        freed.set()
        metrics.stop()


@pytest.mark.parametrize("fault", [RuntimeError("a bug"), OSError(errno.EIO, "no disk")])
async def test_a_measurement_that_fails_is_logged_and_costs_the_figures_of_the_memory_alone(
    fault: Exception,
) -> None:
    metrics = Metrics(Mock(side_effect=fault))
    metrics.answered(Answered("ask", "ok", 0.03, 12, "abc", {}))
    with capture_logs() as captured:
        found = await scraped(metrics)
    assert at(found, "answers_total", tool="ask", outcome="ok", reason="") == 1
    assert [event["event"] for event in captured] == ["metrics_not_measured"]
    metrics.stop()
    # As a scrape may find it while the server ends.
    assert at(await scraped(metrics), "build_info", version=package_version()) == 1


def test_metrics_of_other_libraries_stay_as_they_are() -> None:
    enable_created_metrics()  # type: ignore[no-untyped-call]
    registry = CollectorRegistry()
    Counter("other", "Of another library.", registry=registry)
    Metrics(lambda: ()).stop()
    assert "other_created" in generate_latest(registry).decode()


def measured(gauges: MemoryGauges) -> dict[str, float]:
    """The values of this moment, by name and label."""
    return {
        " ".join((sample.name.removeprefix("ros2_memory_"), *sample.labels.values())): sample.value
        for family in gauges()
        for sample in family.samples
    }


def test_the_bag_directory_is_not_scanned_for_them(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a" / "a_0.mcap", [text(T0, "x")])
    memory = memory_of(tmp_path)
    gauges = MemoryGauges(memory)
    assert measured(gauges) == {}
    memory.index.refresh()
    first = measured(gauges)
    write_mcap(tmp_path / "b" / "b_0.mcap", [text(T0, "x")])
    (tmp_path / "broken.mcap").write_bytes(b"x" * 1000)
    again = measured(gauges)
    assert (first["bags"], again["bags"], again["files_set_aside damaged"]) == (1, 1, 0)
    memory.index.refresh()
    last = measured(gauges)
    assert (last["bags"], last["kept_bytes"] > first["kept_bytes"]) == (2, True)
    aside = [last[f"files_set_aside {state}"] for state in ("active", "damaged", "unread")]
    assert aside == [0, 1, 0]


def test_they_show_what_the_recorder_reports_and_whether_it_is_another_one(tmp_path: Path) -> None:
    clock = SettableClock(T0 + 9 * NS_PER_S)
    gauges = MemoryGauges(memory_of(tmp_path, clock=clock))
    told = {"pid": 7, "since": T0, "bytes_written": 700, "silent": ("/b",), "lost": {"/odom": 3}}
    beat(tmp_path, T0 + 5 * NS_PER_S, RecorderState.PAUSED, **told)
    found = measured(gauges)
    states = [each for each in RecorderState if found[f"recorder_state {each}"]]
    assert states == [RecorderState.PAUSED]
    expected = {
        "live": 1,
        "heartbeat_age_seconds": 4.0,
        "written_bytes_total": 700,
        "silent_topics": 1,
        "restarts_total": 0,
        "state_since_timestamp_seconds": T0 / NS_PER_S,
        "lost_messages /odom": 3,
    }
    assert {name: found[f"recorder_{name}"] for name in expected} == expected
    for pid, restarts in ((7, 0), (8, 1), (8, 1), (9, 2)):
        beat(tmp_path, T0, RecorderState.PAUSED, pid=pid)
        assert measured(gauges)["recorder_restarts_total"] == restarts
    clock.at += 3600 * NS_PER_S
    assert measured(gauges)["recorder_live"] == 0


@pytest.fixture
def spans(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[InMemorySpanExporter]:
    """Spans of the MCP library, and of a server that `traced` builds.

    The provider of a process can be set once, so the library is given one here instead.
    """
    exporter = InMemorySpanExporter()
    arguments = getattr(request, "param", True)
    provider = provider_to(SimpleSpanProcessor(exporter), arguments=arguments)
    monkeypatch.setattr("mcp.shared._otel._tracer", provider.get_tracer("mcp-python-sdk"))
    monkeypatch.setattr(trace, "get_tracer_provider", lambda: provider)
    yield exporter
    provider.shutdown()


def asking(name: str, call: Call) -> Answer:
    with call.stages.timed("read"):
        if name == "empty":
            raise NoDataError(NoDataReason.GAP, "a hole")
        return value(7)


def traced() -> EpisodicServer:
    tools = [tool(name, partial(asking, name)) for name in ("full", "empty")]
    provider: Any = trace.get_tracer_provider()
    return served(*tools, telemetry=Telemetry((Traces(provider),)))


def reply(exporter: InMemorySpanExporter, outcome: str) -> ReadableSpan:
    """The one span that has this outcome."""
    [span] = [
        each
        for each in exporter.get_finished_spans()
        if (each.attributes or {}).get("ros2_memory.outcome") == outcome
    ]
    return span


@pytest.mark.parametrize("over_mcp", [True, False])
async def test_a_call_has_one_span_of_its_length_with_its_outcome_and_stages(
    spans: InMemorySpanExporter, over_mcp: bool
) -> None:
    server, given = traced(), {"secret": "s3cret"}
    if over_mcp:
        async with Client(server) as client:
            await client.call_tool("full", {})
            await client.call_tool("empty", given)
    else:
        await server.dispatcher.answer("full", {})
        await server.dispatcher.answer("other", given)
    full = reply(spans, "ok")
    attributes = full.attributes or {}
    assert full.name == "tools/call full"
    assert full.start_time is not None
    assert full.end_time is not None
    assert full.end_time > full.start_time
    assert full.status.status_code is trace.StatusCode.UNSET
    assert float(cast("float", attributes["ros2_memory.stage.read_ms"])) >= 0
    assert attributes["ros2_memory.reply_chars"]
    assert attributes["ros2_memory.correlation_id"]
    if over_mcp:
        assert attributes["gen_ai.tool.name"] == "full"
        assert attributes["mcp.method.name"] == "tools/call"
        assert reply(spans, "no_data: gap").name == "tools/call empty"
    else:
        refused = reply(spans, "invalid_arguments")
        assert refused.status.status_code is trace.StatusCode.ERROR
    assert "s3cret" not in "".join(each.to_json() for each in spans.get_finished_spans())


@pytest.mark.parametrize("spans", [False], indirect=True)
async def test_without_arguments_nothing_that_a_client_chose_is_in_a_span(
    spans: InMemorySpanExporter,
) -> None:
    async with Client(traced()) as client:
        await client.call_tool("full", {"s3cret": "s3cret"})
        await client.call_tool("s3cret", {"s3cret": "s3cret"})
        for ask in (client.get_prompt, client.read_resource):
            with pytest.raises(MCPError):
                await ask("file:///s3cret")
    served = [each for each in spans.get_finished_spans() if each.kind is trace.SpanKind.SERVER]
    assert "s3cret" not in "".join(each.to_json() for each in served)
    names = {each.name for each in served}
    assert {"tools/call full", "tools/call unknown", "prompts/get", "resources/read"} <= names


async def test_whatever_a_client_sends_spans_stay_small(spans: InMemorySpanExporter) -> None:
    long = "x" * 100_000
    async with Client(traced()) as client:
        await client.call_tool(long, {long: long})
        for ask in (client.get_prompt, client.read_resource):
            with pytest.raises(MCPError):
                await ask(f"file:///{long}")
    sizes = [len(each.to_json()) for each in spans.get_finished_spans()]
    assert len(sizes) >= 3
    assert max(sizes) < 4000


def test_an_environment_that_cannot_be_used_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OTEL_SPAN_EVENT_COUNT_LIMIT", "many")
    with pytest.raises(ConfigError, match=r"server\.traces: .* OTEL_SPAN_EVENT_COUNT_LIMIT"):
        traces_from_environment(arguments=True)


def test_stopping_does_not_wait_for_an_exporter_that_hangs() -> None:
    freed = threading.Event()

    class Hanging(InMemorySpanExporter):
        def shutdown(self) -> None:
            freed.wait()

    Traces(provider_to(SimpleSpanProcessor(Hanging()))).stop()
    freed.set()
