"""The recorder daemon's life: lock, put in order, record until a signal comes, end."""

from __future__ import annotations

import select
import signal
import socket
import time
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Final, Self

import structlog

from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.lock import BagDirLock
from ros2_memory.core.errors import EpisodicError, RecorderError
from ros2_memory.core.sd_notify import (
    READY,
    STOPPING,
    WATCHDOG,
    watchdog_interval_s,
)
from ros2_memory.recorder.handover.recovery import recover_handovers
from ros2_memory.retention.clear import clear_bags, refuse_homes

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from types import FrameType

    from ros2_memory.bag_dir.own_recordings import OwnRecordings
    from ros2_memory.core.sd_notify import ServiceManager
    from ros2_memory.recorder.base import Housekeeper, Recorder
    from ros2_memory.storage.base import BagReader

TICK_S: Final = 0.2
SETTLE_EVERY_S: Final = 60.0
ENDING: Final = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)

_log: structlog.typing.FilteringBoundLogger = structlog.get_logger(__name__)


def lock_bag_dir(bag_dir: Path, *, clear: bool) -> BagDirLock:
    """Takes the bag directory, which is made where it does not exist.

    `clear`: whether its bags are to be deleted.

    Raises:
        RecorderError: another recorder holds the directory, it cannot be written into, or it must
            not be cleared.
    """
    if clear:
        refuse_homes(bag_dir)
    try:
        bag_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecorderError(
            f"{bag_dir} cannot be made: {error.strerror}; correct recording.bag_dir"
        ) from error
    return BagDirLock.acquire(bag_dir)


def put_in_order(
    bag_dir: Path,
    reader: BagReader,
    housekeeper: Housekeeper,
    *,
    clear: bool,
    own: OwnRecordings | None = None,
) -> None:
    """Puts a bag directory in order whose lock the caller holds; clears it before, where asked to.

    That deletes the recorder's `own` recordings alone, unless None; and moments.
    Bags that a crash left open are repaired, and handovers that it cut short are settled. What
    fails of that is reported, and recording begins all the same.

    Raises:
        RecorderError: it must not be cleared.
    """
    if clear:
        wiped = clear_bags(bag_dir, own)
        _log.warning("bags_cleared", files=wiped.files, bytes=wiped.bytes)
        for fault in wiped.faults:
            _log.error("not_cleared", reason=fault)
        if wiped.more:
            _log.error("not_cleared", reason=f"{wiped.more} more cannot be deleted")
    _prepare(bag_dir, reader, housekeeper)


class Upkeep:
    """What is seen to while the bag directory is recorded into, in the thread that records.

    The lock is taken anew where its file has gone. A handover that could not be brought to its end,
    as on a full disk, is tried again: until then what its new recording holds does not count.
    """

    def __init__(self, bag_dir: Path, reader: BagReader, lock: BagDirLock) -> None:
        self._bag_dir = bag_dir
        self._reader = reader
        self._lock = lock
        self._settle_at_s = time.monotonic() + SETTLE_EVERY_S

    def tick(self) -> None:
        """Does what is due.

        Raises:
            RecorderError: another recorder took the bag directory.
        """
        if self._lock.renew():
            _log.warning("lock_renewed", reason="its file had gone from the bag directory")
        if time.monotonic() >= self._settle_at_s:
            self._settle_at_s = time.monotonic() + SETTLE_EVERY_S
            self.settle()

    def settle(self) -> None:
        """Settles what is left of recordings that nobody writes any more."""
        heartbeat = read_heartbeat(self._bag_dir).heartbeat
        running = heartbeat.recordings if heartbeat else ()
        # A directory that cannot be listed is the recorder's to report.
        with suppress(OSError):
            recover_handovers(self._bag_dir, self._reader, running)


def record_until_told(recorder: Recorder, manager: ServiceManager, upkeep: Upkeep) -> None:
    """Records until SIGTERM, SIGINT or SIGHUP comes, and ends what it started.

    It must be called from the main thread, which the recorder's processes die with.

    Raises:
        EpisodicError: recording cannot begin, or another recorder took the bag directory.
    """
    interval_s = watchdog_interval_s()
    next_sign_s = 0.0
    with EndingSignals() as signals:
        try:
            recorder.start()
            manager.tell(READY)
            while signals.wait(TICK_S):
                recorder.tick()
                upkeep.tick()
                if interval_s is not None and time.monotonic() >= next_sign_s:
                    manager.tell(WATCHDOG)
                    next_sign_s = time.monotonic() + interval_s / 2
        finally:
            manager.tell(STOPPING)
            recorder.stop()


class EndingSignals:
    """While it is entered, the ending signals are noted, and interrupt nothing.

    They are not blocked and waited for: a thread that a library started before would take them,
    and they would end the program. The end of children is not ignored either, or the system would
    reap them, and their numbers would be taken by others.
    """

    def __init__(self) -> None:
        self._received: int | None = None
        self._readable, self._writable = socket.socketpair()
        self._put_back = ExitStack()

    def __enter__(self) -> Self:
        """Installs the handlers. Only in the main thread."""
        for end in (self._readable, self._writable):
            end.setblocking(False)
            self._put_back.enter_context(end)
        before = signal.set_wakeup_fd(self._writable.fileno(), warn_on_full_buffer=False)
        self._put_back.callback(signal.set_wakeup_fd, before)
        for number in ENDING:
            handler = signal.signal(number, self._note)
            self._put_back.callback(signal.signal, number, handler)
        handler = signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        self._put_back.callback(signal.signal, signal.SIGCHLD, handler)
        return self

    def __exit__(self, *_: object) -> None:
        """Puts back what was installed before."""
        self._put_back.close()

    def wait(self, seconds: float) -> bool:
        """Waits for so long, or until a signal comes; whether none has come yet."""
        if self._received is None:
            select.select([self._readable], [], [], seconds)
            with suppress(BlockingIOError):
                self._readable.recv(64)
        if self._received is None:
            return True
        _log.info("signal_received", signal=signal.Signals(self._received).name)
        return False

    def _note(self, number: int, _frame: FrameType | None) -> None:
        self._received = number


def _prepare(bag_dir: Path, reader: BagReader, housekeeper: Housekeeper) -> None:
    tasks: dict[str, Callable[[], None]] = {
        "repair": housekeeper.repair,
        "settle": lambda: recover_handovers(bag_dir, reader),
        "apply": housekeeper.apply,
    }
    for name, task in tasks.items():
        try:
            task()
        except (EpisodicError, OSError) as error:
            _log.error("not_prepared", task=name, reason=str(error))
