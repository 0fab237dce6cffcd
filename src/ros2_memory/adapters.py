"""Builds the adapters that the configuration chooses.

The only place that sees the configuration and the adapters together. Apart from `bootstrap`, so
that the recorder daemon, which answers nobody, does without the libraries of the server.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from hydra.errors import HydraException
from hydra.utils import instantiate

from ros2_memory.errors import ConfigError
from ros2_memory.recorder.base import Recorder
from ros2_memory.storage.base import BagReader

if TYPE_CHECKING:
    from ros2_memory.settings import AdapterNode, Settings

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
