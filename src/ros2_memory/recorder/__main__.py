"""The recorder daemon: `ros2-memory-recorder [KEY=VALUE ...]`."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Final

import structlog

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bootstrap import build_housekeeper, build_reader, build_recorder, claim
from ros2_memory.config import NullRecorderNode, exit_on_config_error, load_settings
from ros2_memory.core.errors import ConfigError, EpisodicError
from ros2_memory.core.logging_setup import configure_logging
from ros2_memory.core.sd_notify import ServiceManager
from ros2_memory.recorder.daemon import (
    Upkeep,
    lock_bag_dir,
    put_in_order,
    record_until_told,
)
from ros2_memory.recorder.process.topics import load_topics

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ros2_memory.config import Settings

PROGRAM: Final = "ros2-memory-recorder"
FAILED: Final = 1
INTERRUPTED: Final = 130

_log: structlog.typing.FilteringBoundLogger = structlog.get_logger(__name__)


def main(argv: Sequence[str] | None = None) -> int:
    """Records until it is told to stop, and returns the exit code.

    0: stopped by a signal, or there is nothing to record (`recorder=none`); 1: recording cannot
    begin; 2: the configuration or the command line is refused; 130: interrupted before it began.
    """
    overrides: list[str] = _parser().parse_args(argv).overrides
    with exit_on_config_error(PROGRAM):
        settings = load_settings(overrides)
        configure_logging(settings.logging.level, settings.logging.format)
        if isinstance(settings.recorder, NullRecorderNode):
            _log.info("nothing_to_record", reason="recorder=none: bags come from elsewhere")
            return 0
        try:
            _record(settings)
        except ConfigError:
            raise
        except EpisodicError as error:
            _log.error("cannot_record", reason=str(error))
            sys.stderr.write(f"{PROGRAM} cannot record: {error}\n")
            return FAILED
        except KeyboardInterrupt:
            # It came while the bag directory was put in order, which can be broken off.
            return INTERRUPTED
    return 0


def _record(settings: Settings) -> None:
    # A list that is refused stops it before anything is deleted.
    load_topics(settings.recording.topics_file)
    bag_dir = settings.recording.bag_dir.absolute()
    reader = BagDirReader(build_reader(settings), bag_dir, every_message=True)
    own = OwnRecordings(bag_dir)
    housekeeper = build_housekeeper(settings, bag_dir, reader, own)
    clear = settings.recording.clear_on_startup
    lock = lock_bag_dir(bag_dir, clear=clear)
    try:
        recorder = build_recorder(
            settings,
            reader=reader,
            housekeeper=housekeeper,
            own=own,
            keep_open=(lock.descriptor,),
        )
        # So does an environment in which nothing can be recorded.
        recorder.check()
        claim(own)
        keeps_foreign = settings.retention.foreign == "keep"
        put_in_order(bag_dir, reader, housekeeper, clear=clear, own=own if keeps_foreign else None)
        _log.info("starting", bag_dir=str(bag_dir))
        record_until_told(recorder, ServiceManager(), Upkeep(bag_dir, reader, lock))
        _log.info("stopped")
    finally:
        lock.release()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Records a robot's topics with ros2 bag record, and keeps it recording.",
        epilog="Environment: MEMORY_BAG_DIR, MEMORY_DEPLOYMENT, MEMORY_CONFIG_DIR, "
        "MEMORY_CONFIG_OVERRIDES, ROS_DOMAIN_ID, and what else ros2 reads.",
    )
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="key=value",
        help="settings that take precedence over the configuration, e.g. recording.bag_dir=/bags",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
