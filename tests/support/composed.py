"""The shipped configuration, composed once for each choice of its groups.

Hydra takes 70 ms of processor time for it; what is assigned to single keys it adds at the end.
"""

from __future__ import annotations

from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hydra import compose
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser

from tests.support.measured import untraced

if TYPE_CHECKING:
    from collections.abc import Sequence

    from omegaconf import DictConfig

SHIPPED: Final = Path(__file__).resolve().parents[2] / "config"


@untraced
def composed_once(config_name: str, overrides: Sequence[str]) -> DictConfig:
    """As Hydra's `compose`, whose place it takes in `ros2_memory.config`."""
    if _folder() != SHIPPED:
        return compose(config_name, list(overrides))
    keys = [text for text in overrides if text.startswith("++")]
    composed = deepcopy(_composed(config_name, *(text for text in overrides if text not in keys)))
    parsed = OverridesParser.create().parse_overrides(keys)
    ConfigLoaderImpl._apply_overrides_to_config(parsed, composed)
    return composed


@cache
def _composed(config_name: str, *choices: str) -> DictConfig:
    return compose(config_name, list(choices))


def _folder() -> Path:
    """The configuration directory that Hydra was given."""
    paths = GlobalHydra.instance().config_loader().get_search_path().get_path()
    [main] = [each.path for each in paths if each.provider == "main"]
    return Path(main.removeprefix("file://"))
