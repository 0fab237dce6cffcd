"""Builds the adapters that the configuration chooses.

Apart from `bootstrap` and `upkeep`, so that the recorder daemon does without what answers, and
what answers without what repairs and deletes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeVar

from hydra.errors import HydraException
from hydra.utils import instantiate

from ros2_memory.core.errors import ConfigError
from ros2_memory.core.timebase import ns_from_unix
from ros2_memory.recorder.base import Recorder
from ros2_memory.retention.policy import RetentionLimits
from ros2_memory.storage.base import BagReader

if TYPE_CHECKING:
    from ros2_memory.config import AdapterNode, Settings

GB: Final = 10**9

_Port = TypeVar("_Port")


def build_reader(settings: Settings) -> BagReader:
    """The bag reader that the configuration chooses.

    Raises:
        ConfigError: it cannot be built.
    """
    return _built("storage", settings.storage, BagReader)  # type: ignore[type-abstract]  # not built


def build_recorder(settings: Settings, **collaborators: object) -> Recorder:
    """The recorder that the configuration chooses.

    `collaborators` are what its constructor takes besides plain values.

    Raises:
        ConfigError: it cannot be built.
    """
    node = settings.recorder
    return _built("recorder", node, Recorder, **collaborators)  # type: ignore[type-abstract]  # as above


def retention_limits(settings: Settings) -> RetentionLimits:
    """How much the recorder keeps."""
    kept = settings.retention
    return RetentionLimits(
        max_total_bytes=round(kept.max_total_gb * GB),
        max_age_ns=ns_from_unix(kept.max_age_h * 3600),
        min_free_bytes=round(kept.min_free_gb * GB),
        keeps_foreign=kept.foreign == "keep",
    )


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
