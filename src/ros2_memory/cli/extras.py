"""Whether the optional parts of the package are there that the configuration asks for."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Final

from ros2_memory.cli.findings import Finding, Level

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ros2_memory.config import Settings

_METRICS: Final = ("prometheus_client",)
_TRACES: Final = ("opentelemetry.sdk", "opentelemetry.exporter.otlp.proto.http")
_PARQUET: Final = ("pyarrow",)
_ABOUT: Final = "extras"


def of_extras(settings: Settings) -> Iterator[Finding]:
    """What `server.metrics` and `server.traces` need, and whether Parquet can be exported."""
    wanted = {
        key: modules
        for key, modules, asked in (
            ("server.metrics", _METRICS, settings.server.metrics),
            ("server.traces", _TRACES, settings.server.traces),
        )
        if asked
    }
    do = "pip install 'ros2-memory[observability]', or set it to false: the server does not start"
    for key, modules in wanted.items():
        missing = _missing(modules)
        if missing:
            seen = f"{key}=true needs {', '.join(missing)}, which cannot be imported"
            yield Finding(Level.ERROR, _ABOUT, seen, do)
        else:
            yield Finding(Level.OK, _ABOUT, f"what {key}=true needs is installed")
    if settings.server.metrics and settings.server.transport == "stdio":
        yield Finding(
            Level.ERROR,
            _ABOUT,
            "server.metrics=true with server.transport=stdio, which has no /metrics",
            "choose server.transport=sse, or set server.metrics to false",
        )
    if _missing(_PARQUET):
        seen = "export --parquet is not installed: pip install 'ros2-memory[parquet]' adds it"
        yield Finding(Level.OK, _ABOUT, seen)
    else:
        yield Finding(Level.OK, _ABOUT, "export --parquet is installed")


def _missing(modules: Sequence[str]) -> list[str]:
    """Those of the modules that are not installed; none of them is imported."""
    missing = []
    for name in modules:
        try:
            found = find_spec(name) is not None
        except (ImportError, ValueError):  # a package above it is missing
            found = False
        if not found:
            missing.append(name)
    return missing
