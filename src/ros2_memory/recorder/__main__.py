"""The recorder daemon: `ros2-memory-recorder [KEY=VALUE ...]`.

It locks the bag directory, puts it in order, records until a signal comes, and then ends the
recording.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.lock import BagDirLock
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bootstrap import (
    build_housekeeper,
    build_reader,
    build_recorder,
    exclusions_of,
)
from ros2_memory.config import (
    NullRecorderNode,
    Settings,
    exit_on_config_error,
    files_in_use,
    load_settings,
    unused_config,
)
from ros2_memory.core.errors import ConfigError, EpisodicError
from ros2_memory.core.logging_setup import configure_logging, get_logger
from ros2_memory.core.malloc import return_large_at_once, share_one_arena
from ros2_memory.core.sd_notify import READY, STOPPING, notify
from ros2_memory.recorder.background import Background
from ros2_memory.recorder.process.topics import load_topics
from ros2_memory.recorder.supervisor import make_bag_dir
from ros2_memory.retention.clear import clear_bags, refuse_homes
from ros2_memory.retention.policy import SMALL_BUDGET_GB, small_budget

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from ros2_memory.recorder.base import Recorder
    from ros2_memory.recorder.housekeeping import Housekeeping

PROGRAM: Final = "ros2-memory-recorder"
FAILED: Final = 1
INTERRUPTED: Final = 130
TICK_S: Final = 0.2
CACHE_MB: Final = 1
"""Every bag is read once: a larger cache of chunks would only take memory."""
ENDING_SIGNALS: Final = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)

_log = get_logger(__name__)


def main(argv: Sequence[str] | None = None) -> int:
    """Records until a signal comes, and returns the exit code.

    0: stopped by a signal, or there is nothing to record (`recorder=none`); 1: recording cannot
    begin; 2: the configuration or the command line is refused; 130: interrupted before it began.
    """
    overrides: list[str] = _parser().parse_args(argv).overrides
    try:
        with exit_on_config_error(PROGRAM):
            return _run(overrides)
    except KeyboardInterrupt:
        pass  # it came before the signal handlers were set
    return INTERRUPTED


def _run(overrides: Sequence[str]) -> int:
    """Loads the configuration, and records; returns the exit code.

    Raises:
        ConfigError: the configuration is refused.
    """
    settings = load_settings(overrides)
    configure_logging(settings.logging.level, settings.logging.format)
    if isinstance(settings.recorder, NullRecorderNode):
        _log.info("nothing_to_record", reason="recorder=none: bags come from elsewhere")
        # A service manager restarts a program for ever that ends before it is ready.
        notify(READY)
        return 0
    try:
        share_one_arena()
        return_large_at_once()
        _record(settings)
    except ConfigError:
        raise
    except EpisodicError as error:
        _log.error("cannot_record", reason=str(error))
        sys.stderr.write(f"{PROGRAM} cannot record: {error}\n")
        return FAILED
    return 0


def _record(settings: Settings) -> None:
    # Nothing is deleted before the list of topics and the environment proved fit for recording.
    recording = settings.recording
    load_topics(recording.topics_file)
    _warn_of_settings(settings)
    bag_dir = recording.bag_dir.absolute()
    reader = BagDirReader(build_reader(settings, cache_mb=CACHE_MB), bag_dir, every_message=True)
    own = OwnRecordings(bag_dir)
    background = Background()
    housekeeper = build_housekeeper(settings, bag_dir, reader, own, background)
    if recording.clear_on_startup:
        refuse_homes(bag_dir)
    make_bag_dir(bag_dir)
    lock = BagDirLock.acquire(bag_dir)
    excluding = {
        rule.topic: f"the rule {rule.name!r} of recording.exclude_when"
        for rule in exclusions_of(settings)
    }
    try:
        recorder = build_recorder(
            settings,
            reader=reader,
            housekeeper=housekeeper,
            own=own,
            background=background,
            keep_open=(lock.descriptor,),
            excluding=excluding,
        )
        recorder.check()
        own.claim()
        if recording.clear_on_startup:
            _clear(bag_dir, own if settings.retention.foreign == "keep" else None)
        _prepare(housekeeper)
    except BaseException:
        lock.release()
        raise
    # From here on the lock is held until the process ends: threads may still be writing at the end.
    _log.info("starting", bag_dir=str(bag_dir), files=files_in_use(settings))
    if unused := unused_config():
        _log.warning("config_unused", reason=unused)
    _record_until_signal(recorder, lock)
    _log.info("stopped")


def _warn_of_settings(settings: Settings) -> None:
    recording = settings.recording
    if recording.split_duration_s > recording.session_duration_s:
        _log.warning(
            "split_longer_than_session",
            reason=f"recording.split_duration_s ({recording.split_duration_s}) is longer than "
            f"recording.session_duration_s ({recording.session_duration_s:g}), which ends splits "
            "earlier",
        )
    if settings.retention.max_total_gb < SMALL_BUDGET_GB:
        _log.warning("budget_small", reason=small_budget(settings.retention.max_total_gb))


def _prepare(housekeeper: Housekeeping) -> None:
    try:
        housekeeper.prepare()
    except (EpisodicError, OSError) as error:
        # Only reported: a recorder that can record must not be kept from it.
        _log.error("not_prepared", task="prepare", reason=str(error))


def _clear(bag_dir: Path, own: OwnRecordings | None) -> None:
    """Deletes the bags in the bag directory; with a list of own recordings only those."""
    cleared = clear_bags(bag_dir, own)
    _log.warning("bags_cleared", files=cleared.files, bytes=cleared.bytes)
    for fault in cleared.faults:
        _log.error("not_cleared", reason=fault)
    if cleared.more:
        _log.error("not_cleared", reason=f"{cleared.more} more cannot be deleted")


def _record_until_signal(recorder: Recorder, lock: BagDirLock) -> None:
    """Records until SIGTERM, SIGINT or SIGHUP comes, then ends the recordings.

    Takes the lock again if its file has gone. Call it from the main thread: child processes die
    with the thread that starts them.

    Raises:
        EpisodicError: recording cannot begin, or another recorder took the bag directory.
    """
    with _ending_signals() as received:
        try:
            recorder.start()
            notify(READY)
            while not received:
                # A signal does not cut this short: Python runs its handler and sleeps on (PEP 475).
                time.sleep(TICK_S)
                recorder.tick()
                if lock.renew():
                    _log.warning("lock_renewed", reason="its file had gone from the bag directory")
            _log.info("signal_received", signal=signal.Signals(received[0]).name)
        finally:
            notify(STOPPING)
            recorder.stop()


@contextmanager
def _ending_signals() -> Iterator[list[int]]:
    """Yields a list that receives the numbers of ending signals; they interrupt nothing.

    sigwait(3) does not do: a thread that a library started earlier would receive the signals, and
    they would end the program.
    """
    received: list[int] = []
    with ExitStack() as restore:
        for number in ENDING_SIGNALS:
            before = signal.signal(number, lambda number, _frame: received.append(number))
            restore.callback(signal.signal, number, before)
        yield received


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
