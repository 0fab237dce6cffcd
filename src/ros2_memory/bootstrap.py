"""Builds what answers: a memory over the adapters, and the dispatcher of questions to it."""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ros2_memory import PACKAGE, package_version
from ros2_memory.adapters import build_reader, retention_limits
from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.layout import has_recorded
from ros2_memory.catalogue.digest import DIGEST_VERSION, Digester
from ros2_memory.catalogue.lookup import DigestCache
from ros2_memory.catalogue.store import FILE, FOLDER, Catalogue
from ros2_memory.config import NullRecorderNode, load_message_schemas
from ros2_memory.core import directories
from ros2_memory.core.errors import ConfigError
from ros2_memory.core.telemetry import SILENT, Telemetry
from ros2_memory.core.timebase import WallClock
from ros2_memory.extract import SchemaExtractor
from ros2_memory.history.context import Memory, QuerySettings
from ros2_memory.observability.gauges import Measuring
from ros2_memory.recorder.index_manager import IndexManager
from ros2_memory.serving.backfill import Backfill
from ros2_memory.serving.dispatch import Dispatcher
from ros2_memory.tools.replies import Replies
from ros2_memory.tools.spec_tools import build_tools, readable_tools

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from ros2_memory.config import Settings
    from ros2_memory.core.telemetry import Observer


def build_memory(settings: Settings) -> Memory:
    """The memory over `recording.bag_dir`, which need not exist yet. Reads no bag.

    Raises:
        ConfigError: the reader cannot be built, or the schema map is refused.
    """
    clock = WallClock()
    schemas = load_message_schemas(settings)
    extractor = SchemaExtractor(schemas, settings.data.max_array_length)
    bag_dir = settings.recording.bag_dir
    reader = BagDirReader(build_reader(settings), bag_dir)
    reading = catalogue_fingerprint(settings, schemas)
    places = partial(catalogue_paths, settings)
    catalogue = Catalogue(places, reading, waits_for=bag_dir)
    index = IndexManager(
        bag_dir,
        reader,
        clock,
        refresh_s=settings.reader.index_refresh_s,
        split_duration_s=settings.recording.split_duration_s,
        known=partial(catalogue.summaries, bag_dir),
        include_active=settings.reader.include_active,
        trusts_mtime=not isinstance(settings.recorder, NullRecorderNode),
    )
    recall = DigestCache(catalogue, bag_dir)
    return Memory(index, reader, extractor, clock, query_settings_of(settings), recall)


def catalogue_paths(settings: Settings) -> tuple[Path, ...]:
    """Where the catalogue may lie now, best first.

    Beside the bags only where a recorder has been at work, and may be again: a folder of other
    people's bags is left as it is.
    """
    bag_dir = settings.recording.bag_dir
    records = not isinstance(settings.recorder, NullRecorderNode) and has_recorded(bag_dir)
    places = (bag_dir / FOLDER / FILE,) if records else ()
    given = os.environ.get("XDG_CACHE_HOME")
    try:
        cache = Path(given) if given else Path.home() / ".cache"
    except RuntimeError:  # a user without a home
        return places
    name = hashlib.sha256(os.fsencode(bag_dir.absolute())).hexdigest()[:16]
    return (*places, cache / PACKAGE / name / FILE) if cache.is_absolute() else places


def catalogue_fingerprint(settings: Settings, schemas: Mapping[str, Mapping[str, str]]) -> str:
    """A hash of all that digests depend on besides the bags: settings, definitions, this program.

    `schemas` is the schema map of these settings.
    """
    folders = [str(folder) for folder in settings.storage.custom_msg_paths]
    definitions = [
        (str(path.relative_to(folder)), path.stat().st_size, path.stat().st_mtime_ns)
        for folder in settings.storage.custom_msg_paths
        for path in sorted(directories.files_below(Path(folder), ".msg"))
    ]
    depends_on = (
        package_version(),
        DIGEST_VERSION,
        settings.storage.target,
        settings.reader.max_chunk_mb,
        folders,
        definitions,
        {name: dict(fields) for name, fields in schemas.items()},
        settings.data.max_array_length,
        settings.data.max_plausible_speed_mps,
    )
    return hashlib.sha256(json.dumps(depends_on).encode()).hexdigest()[:16]


def build_backfill(settings: Settings, memory: Memory) -> Backfill:
    """What fills the catalogue of a memory."""
    limit = memory.limits.max_plausible_speed_mps
    return Backfill(
        memory, Digester(memory.reader, memory.extractor, limit), settings.recording.bag_dir
    )


def query_settings_of(settings: Settings) -> QuerySettings:
    """What questions need of the configuration."""
    data = settings.data
    records = not isinstance(settings.recorder, NullRecorderNode)
    return QuerySettings(
        position_tolerance_m=data.position_tolerance_m,
        time_tolerance_s=data.time_tolerance_s,
        pose_topic=data.pose_topic,
        map_frame=data.map_frame,
        tf_topics=data.tf_topics,
        tf_static_topics=data.tf_static_topics,
        now=data.now,
        tf_clock=data.tf_clock,
        max_plausible_speed_mps=data.max_plausible_speed_mps,
        split_duration_s=settings.recording.split_duration_s,
        include_active=settings.reader.include_active,
        kept=retention_limits(settings) if records else None,
        latched_topics=data.latched_topics.include,
        never_latched_topics=data.latched_topics.exclude,
    )


def build_telemetry(settings: Settings, memory: Memory) -> Telemetry:
    """Who is told of answers, as the configuration wants it; nobody by default.

    Raises:
        ConfigError: the optional part of the package is missing, there is no HTTP to show metrics
            on, or the environment describes no exporter.
    """
    observers: list[Observer] = []
    exposition = None
    if settings.server.metrics:
        if settings.server.transport == "stdio":
            raise ConfigError(
                "server.metrics: true is not allowed with server.transport=stdio, which has no "
                "/metrics; choose server.transport=sse or leave it out"
            )
        with _optional("server.metrics"):
            from ros2_memory.observability.prometheus import Metrics  # noqa: PLC0415 - an extra
        metrics = Metrics(Measuring(memory), package_version())
        observers.append(metrics)
        exposition = metrics.exposition
    if settings.server.traces:
        with _optional("server.traces"):
            from ros2_memory.observability import opentelemetry  # noqa: PLC0415 - an extra
        observers.append(
            opentelemetry.traces_from_environment(arguments=settings.logging.arguments)
        )
    return Telemetry(tuple(observers), exposition)


@contextmanager
def _optional(key: str) -> Iterator[None]:
    """Around the import of what few install."""
    try:
        yield
    except ImportError as error:
        raise ConfigError(
            f"{key}: true needs the optional part of this package (no {error.name}): "
            "pip install 'ros2-memory[observability]'"
        ) from error


def build_dispatcher(
    settings: Settings, memory: Memory, telemetry: Telemetry = SILENT
) -> Dispatcher:
    """What answers tool calls from a memory."""
    served = settings.server
    tools = build_tools(
        memory.limits,
        served.call_timeout_s,
        additions=served.tools == "all",
        writing=served.write_tools,
    )
    return Dispatcher(
        memory,
        tools,
        Replies(settings.recording.bag_dir, served.max_reply_chars),
        call_timeout_s=served.call_timeout_s,
        readable=readable_tools(memory.limits),
        telemetry=telemetry,
        log_arguments=settings.logging.arguments,
    )
