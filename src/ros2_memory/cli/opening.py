"""How a memory is opened for a command."""

from ros2_memory.bootstrap import build_memory
from ros2_memory.cli.running import busy
from ros2_memory.config import Settings
from ros2_memory.core.logging_setup import configure_logging
from ros2_memory.core.withheld import withhold_warnings
from ros2_memory.history.context import Memory


def opened(settings: Settings, *, verbose: bool = False) -> Memory:
    """The memory, whose bags have been looked through once.

    Log events are shown where that is asked for; else warnings are counted, for the end.

    Raises:
        ConfigError: it cannot be built.
    """
    configure_logging(settings.logging.level if verbose else "warning", settings.logging.format)
    if not verbose:
        withhold_warnings()
    memory = build_memory(settings)
    with busy(f"looking through {settings.recording.bag_dir}"):
        memory.index.refresh()
    return memory
