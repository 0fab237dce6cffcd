"""Builds the adapters that the configuration chooses, and what is made of them.

The only place that sees the configuration and the adapters together. Apart from `bootstrap`, so
that the recorder daemon, which answers nobody, does without the libraries of the server.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeVar

from hydra.errors import HydraException
from hydra.utils import instantiate

from ros2_memory.errors import ConfigError
from ros2_memory.recorder.base import Recorder
from ros2_memory.recorder.counting import CountingReader
from ros2_memory.recorder.housekeeping import Housekeeping, InBackground
from ros2_memory.recorder.repair import Repairer
from ros2_memory.recorder.retention import RetentionLimits
from ros2_memory.storage.base import BagReader
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.storage.mcap_writer import McapWriter
from ros2_memory.timebase import WallClock, ns_from_unix

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.recorder.ports import Housekeeper
    from ros2_memory.settings import AdapterNode, Settings

GB: Final = 10**9

_Port = TypeVar("_Port")


def build_reader(settings: Settings) -> BagReader:
    """The bag reader that the configuration chooses.

    Raises:
        ConfigError: it cannot be built.
    """
    return _built("storage", settings.storage, BagReader)  # type: ignore[type-abstract]


def build_recorder(settings: Settings, **collaborators: object) -> Recorder:
    """The recorder that the configuration chooses.

    `collaborators` are what its constructor takes besides plain values.

    Raises:
        ConfigError: it cannot be built.
    """
    return _built("recorder", settings.recorder, Recorder, **collaborators)  # type: ignore[type-abstract]


def retention_limits(settings: Settings) -> RetentionLimits:
    """How much the recorder keeps."""
    kept = settings.retention
    return RetentionLimits(
        max_total_bytes=round(kept.max_total_gb * GB),
        max_age_ns=ns_from_unix(kept.max_age_h * 3600),
        min_free_bytes=round(kept.min_free_gb * GB),
    )


def moments_bytes(settings: Settings) -> int:
    """What moments may take; never more than half the budget, so that there is room for today."""
    kept = settings.retention
    return round(min(kept.max_moments_gb, kept.max_total_gb / 2) * GB)


def build_housekeeper(settings: Settings, bag_dir: Path, reader: BagReader) -> Housekeeper:
    """What repairs and deletes in the bag directory of the recorder; nobody else may delete."""
    limits = retention_limits(settings)
    return InBackground(
        Housekeeping(
            bag_dir,
            CountingReader(reader),
            McapWriter(settings.reader.max_chunk_mb),
            WallClock(),
            limits,
            split_duration_s=settings.recording.split_duration_s,
            moments_bytes=moments_bytes(settings),
            static_topics=settings.data.tf_static_topics,
            grace_s=settings.reader.index_refresh_s + settings.server.call_timeout_s,
        )
    )


def build_repairer() -> Repairer:
    """What repairs single MCAP files."""
    return Repairer(McapReader(), McapWriter())


def _built(key: str, node: AdapterNode, port: type[_Port], **collaborators: object) -> _Port:
    try:
        # `all`: the adapter receives plain lists, not the configuration library's. `partial`:
        # what is no plain value never enters a configuration, where it would be copied.
        partial: object = instantiate(
            {"_target_": node.target, "_convert_": "all", "_partial_": True}, **node.arguments
        )
    except HydraException as error:
        raise ConfigError(f"{key}: {node.target} cannot be built: {error}") from error
    built: object = partial(**collaborators) if callable(partial) else None
    if not isinstance(built, port):
        raise ConfigError(f"{key}: {node.target} is not a {port.__name__}")
    return built
