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
from opentelemetry.sdk.trace import SpanLimits, SpanProcessor, TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor
from opentelemetry.trace import SpanKind, Status, StatusCode

from ros2_memory.errors import ConfigError
from ros2_memory.telemetry import Observer
from ros2_memory.timebase import ns_from_unix

if TYPE_CHECKING:
    from opentelemetry.context import Context
    from opentelemetry.sdk.trace import Span

    from ros2_memory.telemetry import Answered

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


class ShortNames(SpanProcessor):
    """Shortens the names of spans: a client may call a tool whatever it likes."""

    def on_start(self, span: Span, parent_context: Context | None = None) -> None:
        """Before anything is kept of it."""
        del parent_context
        if len(span.name) > LONGEST:
            span.update_name(f"{span.name[: LONGEST - 3]}...")


def provider_to(processor: SpanProcessor) -> TracerProvider:
    """A provider whose spans are of bounded size; sampler and resource are the environment's.

    It is named `ros2-memory-server` unless `OTEL_SERVICE_NAME` or `OTEL_RESOURCE_ATTRIBUTES` name
    it.
    """
    resource = Resource.create()
    if str(resource.attributes.get(SERVICE_NAME, _UNNAMED)).startswith(_UNNAMED):
        resource = resource.merge(Resource({SERVICE_NAME: SERVICE}))
    limits = SpanLimits(max_attribute_length=LONGEST, max_span_attribute_length=LONGEST)
    provider = TracerProvider(resource=resource, span_limits=limits, shutdown_on_exit=False)
    provider.add_span_processor(ShortNames())
    provider.add_span_processor(processor)
    return provider


def traces_from_environment() -> Traces:
    """Sets the provider of this process, to which the MCP library's spans go too.

    Where spans are sent to, and how, is said by the standard `OTEL_*` variables.

    Raises:
        ConfigError: one of them holds what cannot be used.
    """
    try:
        provider = provider_to(BatchSpanProcessor(OTLPSpanExporter()))
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
