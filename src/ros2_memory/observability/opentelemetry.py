"""Spans of tool calls for OpenTelemetry, sent over OTLP (HTTP).

The MCP library starts a span for every request, `tools/call NAME` for a tool, as a child of the
client's span if the client sends its trace context. `Traces` adds the outcome of a call to that
span. No span holds arguments or replies.
"""

from __future__ import annotations

import threading
import time
from typing import Final

from opentelemetry import trace
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import SERVICE_NAME, Resource
from opentelemetry.sdk.trace import (
    ReadableSpan,
    SpanLimits,
    SpanProcessor,
    SynchronousMultiSpanProcessor,
    TracerProvider,
)
from opentelemetry.sdk.trace.export import BatchSpanProcessor
from opentelemetry.trace import SpanKind, Status, StatusCode

from ros2_memory.core.errors import ConfigError
from ros2_memory.core.telemetry import Answered, Observer
from ros2_memory.core.timebase import ns_from_unix

SERVICE: Final = "ros2-memory-server"
MAX_CHARS: Final = 256
"""The longest name or value: clients choose some of them."""

_SHUTDOWN_S: Final = 1.0
_UNNAMED: Final = "unknown_service"
_SUCCESSFUL: Final = frozenset({"ok", "no_data"})


class Traces(Observer):
    """Adds to the span of each call its outcome, and the time spent in each stage."""

    def __init__(self, provider: TracerProvider) -> None:
        self._provider = provider
        self._tracer = provider.get_tracer("ros2_memory")

    def answered(self, call: Answered) -> None:
        """Adds the outcome of a call to its span; starts one where the library did not."""
        attributes = _attributes(call)
        span = trace.get_current_span()
        if span.get_span_context().is_valid:
            # A span that is not sampled is valid, too: the call gets no other.
            span.set_attributes(attributes)
            return
        end = time.time_ns()
        span = self._tracer.start_span(
            f"tools/call {call.tool}",
            kind=SpanKind.SERVER,
            attributes=attributes,
            start_time=end - ns_from_unix(call.duration_s),
        )
        if call.code not in _SUCCESSFUL:
            span.set_status(Status(StatusCode.ERROR))
        span.end(end)

    def stop(self) -> None:
        """Exports the remaining spans, for at most a second."""
        # `shutdown` of the provider and of its exporter takes no timeout.
        ending = threading.Thread(target=self._provider.shutdown, name="last-spans", daemon=True)
        ending.start()
        ending.join(_SHUTDOWN_S)


class BoundedSpanProcessor(SynchronousMultiSpanProcessor):
    """Passes spans on with names and descriptions of bounded length.

    The MCP library copies the names of tools and methods that a client sends, however long, into
    the name and the status of a span. `arguments`: whether spans may hold such texts, cut short.
    """

    def __init__(self, *, arguments: bool) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # has no types
        self._arguments = arguments

    def on_end(self, span: ReadableSpan) -> None:
        """Passes on a span, without texts that it must not show."""
        attributes = dict(span.attributes or {})
        name, events = span.name, span.events
        description = (span.status.description or "")[:MAX_CHARS] or None
        if not self._arguments:
            attributes.pop("gen_ai.prompt.name", None)
            tool = attributes.get("gen_ai.tool.name")
            name = str(attributes.get("mcp.method.name", name)) + (f" {tool}" if tool else "")
            description, events = None, ()
        super().on_end(
            ReadableSpan(
                name=name if len(name) <= MAX_CHARS else f"{name[: MAX_CHARS - 3]}...",
                context=span.context,
                parent=span.parent,
                resource=span.resource,
                attributes=attributes,
                events=events,
                links=span.links,
                kind=span.kind,
                status=Status(span.status.status_code, description),
                start_time=span.start_time,
                end_time=span.end_time,
                instrumentation_scope=span.instrumentation_scope,
            )
        )


def provider_to(processor: SpanProcessor, *, arguments: bool = True) -> TracerProvider:
    """Returns a provider of spans of bounded size, with the environment's sampler and resource.

    The service is `ros2-memory-server` unless `OTEL_SERVICE_NAME` or `OTEL_RESOURCE_ATTRIBUTES`
    names it.

    Args:
        processor: exports the spans.
        arguments: whether spans may hold texts that a client chose, such as a tool's name.
    """
    resource = Resource.create()
    if str(resource.attributes.get(SERVICE_NAME, _UNNAMED)).startswith(_UNNAMED):
        resource = resource.merge(Resource({SERVICE_NAME: SERVICE}))
    provider = TracerProvider(
        resource=resource,
        span_limits=SpanLimits(max_attribute_length=MAX_CHARS, max_span_attribute_length=MAX_CHARS),
        shutdown_on_exit=False,
        active_span_processor=BoundedSpanProcessor(arguments=arguments),
    )
    provider.add_span_processor(processor)
    return provider


def traces_from_environment(*, arguments: bool) -> Traces:
    """Sets the provider of this process, which receives the MCP library's spans as well.

    The standard `OTEL_*` variables set where and how spans are sent. See `provider_to` for
    `arguments`.

    Raises:
        ConfigError: one of the variables is invalid.
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
    return {
        "gen_ai.tool.name": call.tool,
        "ros2_memory.outcome": call.outcome,
        "ros2_memory.reply_chars": call.chars,
        "ros2_memory.correlation_id": call.correlation_id,
        **{f"ros2_memory.stage.{name}_ms": spent for name, spent in call.stages_ms.items()},
    }
