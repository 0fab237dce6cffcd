"""The shipped configuration, composed once for each choice of its groups, and its files read once.

Hydra takes 70 ms of processor time for it; what is assigned to single keys it adds at the end. The
file of message schemas takes 50 ms.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import IO, Any
from unittest.mock import patch

from hydra import compose
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, ListConfig, OmegaConf

from tests.support.measured import untraced

SHIPPED = Path(__file__).resolve().parents[2] / "config"


def shipped_once() -> ExitStack:
    """Within it the package composes the shipped configuration, and reads its files, once."""
    stack = ExitStack()
    stack.enter_context(patch("ros2_memory.config.compose", composed_once))
    stack.enter_context(patch("ros2_memory.config.OmegaConf", _LoadedOnce))
    return stack


class _LoadedOnce(OmegaConf):
    @staticmethod
    def load(file_: str | Path | IO[Any]) -> DictConfig | ListConfig:
        if isinstance(file_, Path) and file_.is_relative_to(SHIPPED):
            return _loaded(file_)
        return OmegaConf.load(file_)


@cache
def _loaded(path: Path) -> DictConfig | ListConfig:
    return OmegaConf.load(path)


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
