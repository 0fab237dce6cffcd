"""The configuration of a command."""

from collections.abc import Sequence
from pathlib import Path

from ros2_memory.config import Settings, load_explained
from ros2_memory.config_sources import Sources, quoted


def settings_for(bag_dir: Path | None, overrides: Sequence[str] | None) -> Settings:
    """The configuration, as the server would have it, with the bag directory that was asked for.

    Raises:
        ConfigError: it is refused.
    """
    return explained_for(bag_dir, overrides)[0]


def explained_for(
    bag_dir: Path | None, overrides: Sequence[str] | None
) -> tuple[Settings, Sources]:
    """As `settings_for`, and what tells of a key who set it.

    Raises:
        ConfigError: it is refused.
    """
    chosen = [] if bag_dir is None else [f"recording.bag_dir={quoted(str(bag_dir.absolute()))}"]
    return load_explained([*(overrides or ()), *chosen])
