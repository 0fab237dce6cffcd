"""The recorder daemon's life: lock, put in order, record until a signal comes, end."""

from __future__ import annotations

import signal
import time
from typing import TYPE_CHECKING, Final, Protocol, runtime_checkable

import structlog

from ros2_memory.errors import EpisodicError, RecorderError
from ros2_memory.recorder.lock import BagDirLock
from ros2_memory.recorder.notify import READY, STOPPING, WATCHDOG, watchdog_interval_s
from ros2_memory.recorder.settle import settle_all
from ros2_memory.recorder.wipe import clear_bags

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from ros2_memory.recorder.notify import ServiceManager
    from ros2_memory.recorder.ports import Housekeeper
    from ros2_memory.storage.base import BagReader

TICK_S: Final = 0.2
ENDING: Final = frozenset({signal.SIGTERM, signal.SIGINT, signal.SIGHUP})

_log: structlog.typing.FilteringBoundLogger = structlog.get_logger(__name__)


@runtime_checkable
class Ticking(Protocol):
    """A recorder that works while it is ticked."""

    def start(self) -> None:
        """Begins to record."""

    def tick(self) -> None:
        """Does what is due."""

    def stop(self) -> None:
        """Ends."""


def lock_and_prepare(
    bag_dir: Path, reader: BagReader, housekeeper: Housekeeper, *, clear: bool
) -> BagDirLock:
    """Takes the bag directory, which is made where it does not exist, and puts it in order.

    Bags that a crash left open are repaired, and handovers that it cut short are settled. What
    fails of that is reported, and recording begins all the same.

    Raises:
        RecorderError: another recorder holds the directory, it cannot be written into, or it must
            not be cleared.
    """
    try:
        bag_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecorderError(
            f"{bag_dir} cannot be made: {error.strerror}; correct recording.bag_dir"
        ) from error
    lock = BagDirLock.acquire(bag_dir)
    try:
        if clear:
            wiped = clear_bags(bag_dir)
            _log.warning("bags_cleared", files=wiped.files, bytes=wiped.bytes)
            for fault in wiped.faults:
                _log.error("not_cleared", reason=fault)
        _prepare(bag_dir, reader, housekeeper)
    except BaseException:
        lock.release()
        raise
    return lock


def record_until_told(
    recorder: Ticking, manager: ServiceManager, *, pause: Callable[[float], bool] | None = None
) -> None:
    """Records until SIGTERM, SIGINT or SIGHUP comes, and ends what it started.

    `pause` waits for so many seconds and says whether to go on; where None, until a signal comes.
    It must be called from the main thread, which the recorder's processes die with.

    Raises:
        EpisodicError: recording cannot begin.
    """
    wait = pause or wait_for_signal
    # From here on a signal is waited for, and interrupts nothing. A child resets this for itself.
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    # A child whose end is ignored would be reaped by the system, and its number taken by another.
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    interval_s = watchdog_interval_s()
    try:
        recorder.start()
        manager.tell(READY)
        next_sign_s = 0.0
        while wait(TICK_S):
            recorder.tick()
            if interval_s is not None and time.monotonic() >= next_sign_s:
                manager.tell(WATCHDOG)
                next_sign_s = time.monotonic() + interval_s / 2
    finally:
        manager.tell(STOPPING)
        recorder.stop()


def wait_for_signal(seconds: float) -> bool:
    """Waits; False when one of the ending signals has come. They must be blocked."""
    info = signal.sigtimedwait(ENDING, seconds)
    if info is not None:
        _log.info("signal_received", signal=signal.Signals(info.si_signo).name)
    return info is None


def _prepare(bag_dir: Path, reader: BagReader, housekeeper: Housekeeper) -> None:
    tasks: dict[str, Callable[[], None]] = {
        "repair": lambda: housekeeper.repair(bag_dir),
        "settle": lambda: settle_all(bag_dir, reader),
        "apply": lambda: housekeeper.apply(bag_dir),
    }
    for name, task in tasks.items():
        try:
            task()
        except (EpisodicError, OSError) as error:
            _log.error("not_prepared", task=name, reason=str(error))
