"""Spans of tool calls for OpenTelemetry, sent over OTLP (HTTP).

The MCP library begins a span for every request, `tools/call NAME` for a tool, as a child of the
client's where that sends its trace context. It goes nowhere until a provider is set. So none is
begun here beside it: it is told what became of the call. Arguments and replies are in no span.
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Final

from opentelemetry import trace
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import SERVICE_NAME, Resource
from opentelemetry.sdk.trace import ReadableSpan, SpanLimits, SpanProcessor, TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor
from opentelemetry.trace import SpanKind, Status, StatusCode

from ros2_memory.core.errors import ConfigError
from ros2_memory.core.telemetry import Observer
from ros2_memory.core.timebase import ns_from_unix

if TYPE_CHECKING:
    from opentelemetry.context import Context
    from opentelemetry.sdk.trace import Span

    from ros2_memory.core.telemetry import Answered

SERVICE: Final = "ros2-memory-server"
LONGEST: Final = 256
"""Characters of a name or a value: of what clients send, some is shown, and nothing grows."""

_ENDS_WITHIN_S: Final = 1.0
_UNNAMED: Final = "unknown_service"
_NO_FAULT: Final = frozenset({"ok", "no_data"})


class Traces(Observer):
    """Tells the span of each call its outcome, and how long it spent in which stage."""

    def __init__(self, provider: TracerProvider) -> None:
        self._provider = provider
        self._tracer = provider.get_tracer("ros2_memory")

    def answered(self, call: Answered) -> None:
        """A call is over; where no span was begun for it, it gets one."""
        attributes = _attributes(call)
        span = trace.get_current_span()
        if span.get_span_context().is_valid:
            # Also where it is not sampled: then there is none of the call.
            span.set_attributes(attributes)
            return
        end = time.time_ns()
        own = self._tracer.start_span(
            f"tools/call {call.tool}",
            kind=SpanKind.SERVER,
            attributes=attributes,
            start_time=end - ns_from_unix(call.duration_s),
        )
        if call.code not in _NO_FAULT:
            own.set_status(Status(StatusCode.ERROR))
        own.end(end)

    def stop(self) -> None:
        """Sends what waits, as far as that takes no longer than a second."""
        # Neither the provider nor its exporter can be told how long they may take.
        ending = threading.Thread(target=self._provider.shutdown, name="last-spans", daemon=True)
        ending.start()
        ending.join(_ENDS_WITHIN_S)


class Bounded(SpanProcessor):
    """Passes spans on whose names and sentences are of bounded length, as their attributes are.

    A client may call a tool or a method whatever it likes, and the MCP library repeats that in the
    name and the status of a span.

    Args:
        processor: what they are passed on to.
        arguments: whether texts that a client chose may be shown, cut short.
    """

    def __init__(self, processor: SpanProcessor, *, arguments: bool) -> None:
        self._processor = processor
        self._arguments = arguments

    def on_start(self, span: Span, parent_context: Context | None = None) -> None:
        """Passes it on."""
        self._processor.on_start(span, parent_context)

    def on_end(self, span: ReadableSpan) -> None:
        """Passes on what may be shown of it."""
        attributes = dict(span.attributes or {})
        name, description, events = span.name, span.status.description, span.events
        if not self._arguments:
            attributes.pop("gen_ai.prompt.name", None)
            tool = attributes.get("gen_ai.tool.name")
            name = str(attributes.get("mcp.method.name", name)) + (f" {tool}" if tool else "")
            description, events = None, ()
        self._processor.on_end(
            ReadableSpan(
                name=name if len(name) <= LONGEST else f"{name[: LONGEST - 3]}...",
                context=span.context,
                parent=span.parent,
                resource=span.resource,
                attributes=attributes,
                events=events,
                links=span.links,
                kind=span.kind,
                status=Status(
                    span.status.status_code, None if description is None else description[:LONGEST]
                ),
                start_time=span.start_time,
                end_time=span.end_time,
                instrumentation_scope=span.instrumentation_scope,
            )
        )

    def shutdown(self) -> None:
        """Passes it on."""
        self._processor.shutdown()

    def force_flush(self, timeout_millis: int = 30000) -> bool:
        """Passes it on."""
        return self._processor.force_flush(timeout_millis)


def provider_to(processor: SpanProcessor, *, arguments: bool = True) -> TracerProvider:
    """A provider whose spans are of bounded size; sampler and resource are the environment's.

    `arguments`: whether texts that a client chose, such as a tool's name, may be in them.

    It is named `ros2-memory-server` unless `OTEL_SERVICE_NAME` or `OTEL_RESOURCE_ATTRIBUTES` name
    it.
    """
    resource = Resource.create()
    if str(resource.attributes.get(SERVICE_NAME, _UNNAMED)).startswith(_UNNAMED):
        resource = resource.merge(Resource({SERVICE_NAME: SERVICE}))
    limits = SpanLimits(max_attribute_length=LONGEST, max_span_attribute_length=LONGEST)
    provider = TracerProvider(resource=resource, span_limits=limits, shutdown_on_exit=False)
    provider.add_span_processor(Bounded(processor, arguments=arguments))
    return provider


def traces_from_environment(*, arguments: bool) -> Traces:
    """Sets the provider of this process, to which the MCP library's spans go too.

    `arguments` is as for `provider_to`.

    Where spans are sent to, and how, is said by the standard `OTEL_*` variables.

    Raises:
        ConfigError: one of them holds what cannot be used.
    """
    try:
        provider = provider_to(BatchSpanProcessor(OTLPSpanExporter()), arguments=arguments)
    except ValueError as error:
        raise ConfigError(
            f"server.traces: an OTEL_* variable of the environment cannot be used: {error}"
        ) from error
    trace.set_tracer_provider(provider)
    return Traces(provider)


def _attributes(call: Answered) -> dict[str, str | int | float]:
    stages = {f"ros2_memory.stage.{name}_ms": spent for name, spent in call.stages_ms.items()}
    return {
        "gen_ai.tool.name": call.tool,
        "ros2_memory.outcome": call.outcome,
        "ros2_memory.reply_chars": call.chars,
        "ros2_memory.correlation_id": call.correlation_id,
        **stages,
    }
