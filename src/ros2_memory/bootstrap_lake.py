"""The composition root of a lake: where it is, and what reads it."""
# ruff: noqa: PLC0415 - the lake is an extra, and loads what nothing else needs

from __future__ import annotations

import atexit
import gc
from contextlib import ExitStack
from importlib.util import find_spec
from typing import TYPE_CHECKING

import yaml

from ros2_memory.bootstrap import instantiated
from ros2_memory.core.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

    from ros2_memory.config import DuckdbNode, Settings
    from ros2_memory.lake.engines.base import LakeEngine
    from ros2_memory.lake.files import Lake
    from ros2_memory.lake.warehouse import LakeLocation


def lake_location(settings: Settings) -> LakeLocation:
    """Returns where the lake is.

    Raises:
        ConfigError: no warehouse is given, its secrets cannot be read, or the extra is missing.
    """
    for name in ("pyarrow", "pyiceberg"):
        if find_spec(name) is None:
            raise ConfigError(
                f"a lake needs the optional part of this package (no {name}): pip install '.[lake]'"
            )
    from ros2_memory.lake.warehouse import LakeLocation, location_of

    lake = settings.lake
    if lake.warehouse is None:
        raise ConfigError(
            "lake.warehouse: must name where the lake is, such as lake.warehouse=/srv/lake or "
            "lake.warehouse=s3://bucket/lake"
        )
    try:
        warehouse, state_dir = location_of(lake.warehouse, lake.state_dir)
    except ValueError as error:
        raise ConfigError(f"lake.warehouse: {error}") from error
    secrets = {} if lake.secrets_file is None else _secrets_of(lake.secrets_file)
    return LakeLocation(
        warehouse, state_dir, lake.catalog, lake.uri, dict(lake.properties), secrets
    )


def _secrets_of(path: Path) -> dict[str, str]:
    """Returns the settings in a file of secrets; no error shows any of it.

    Raises:
        ConfigError: it cannot be read, or has something else.
    """
    try:
        found: object = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"lake.secrets_file: {path}: {error.strerror}") from None
    except (ValueError, yaml.YAMLError):
        found = None
    if not isinstance(found, dict) or not all(
        isinstance(text, str) for pair in found.items() for text in pair
    ):
        raise ConfigError(
            f'lake.secrets_file: {path} must have lines like s3.access-key-id: "...", names and '
            "texts alone"
        )
    return {str(name): str(value) for name, value in found.items()}


def open_lake(settings: Settings, node: DuckdbNode) -> Lake:
    """Returns the lake with an engine of the settings, open until this process ends.

    Raises:
        ConfigError: its place or an extra is missing.
        LakeError: it cannot be opened.
    """
    location = lake_location(settings)
    engine = engine_of(node)
    from ros2_memory.lake.files import Lake

    opened = ExitStack()
    atexit.register(opened.close)
    # DuckDB complains at the end about objects that the garbage collector may not look at.
    opened.callback(gc.unfreeze)
    opened.callback(engine.close)
    catalog = opened.enter_context(location.opened())
    return Lake(catalog, engine, location.translated)


def engine_of(node: DuckdbNode) -> LakeEngine:
    """Returns the engine of the settings.

    Raises:
        ConfigError: its extra is missing, or it cannot be built.
    """
    if find_spec("duckdb") is None:
        raise ConfigError(
            "lake: duckdb needs the optional part of this package (no duckdb): "
            "pip install '.[lake]'"
        )
    from ros2_memory.lake.engines.base import LakeEngine

    return instantiated("lake.engine", node, LakeEngine)  # type: ignore[type-abstract]  # only compared with
