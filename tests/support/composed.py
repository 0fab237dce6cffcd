"""The shipped configuration, composed once for each set of overrides.

Hydra takes 60 ms of processor time for it, and most tests want the same one for another folder of
bags.
"""

from __future__ import annotations

import re
from copy import deepcopy
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hydra import compose
from hydra.core.global_hydra import GlobalHydra

from tests.support.measured import untraced

if TYPE_CHECKING:
    from collections.abc import Sequence

    from omegaconf import DictConfig

SHIPPED: Final = Path(__file__).resolve().parents[2] / "config"
_BAG_DIR: Final = re.compile(r"\+\+recording\.bag_dir=(?:'(/[\w/.-]+)'|(/[\w/.-]+))")
_COMPOSED: Final[dict[tuple[str, ...], DictConfig]] = {}


@untraced
def composed_once(config_name: str, overrides: Sequence[str]) -> DictConfig:
    """As Hydra's `compose`, whose place it takes in `ros2_memory.config`."""
    found = [_BAG_DIR.fullmatch(each) for each in overrides]
    rest = tuple(each for each, is_it in zip(overrides, found, strict=True) if is_it is None)
    whole = any(re.match(r"\W*recording\W*=", each) for each in rest)
    if whole or _folder() != SHIPPED:
        return compose(config_name, list(overrides))
    if rest not in _COMPOSED:
        _COMPOSED[rest] = compose(config_name, list(rest))
    composed = deepcopy(_COMPOSED[rest])
    for bag_dir in found:
        if bag_dir is not None:
            composed.recording.bag_dir = bag_dir[1] or bag_dir[2]
    return composed


def _folder() -> Path:
    """The configuration directory that Hydra was given."""
    paths = GlobalHydra.instance().config_loader().get_search_path().get_path()
    [main] = [each.path for each in paths if each.provider == "main"]
    return Path(main.removeprefix("file://"))
