"""The lock that admits one recorder to a bag directory. It is free when its holders have died.

The recorder's child inherits the lock. The child of a killed recorder needs time to close its
files, and nobody may repair or record in the directory before.
"""

from __future__ import annotations

import fcntl
import json
import os
import socket
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.durable_write import is_open_file
from ros2_memory.bag_dir.heartbeat import runs
from ros2_memory.bag_dir.layout import LOCK_FILE
from ros2_memory.core.errors import RecorderError

if TYPE_CHECKING:
    from pathlib import Path

CHILD_EXIT_S: Final = 15.0
"""How long to wait for the child of a recorder that died."""
_POLL_S: Final = 0.1
_FLAGS: Final = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
_MAX_TEXT: Final = 1000


@dataclass(eq=False, repr=False)
class BagDirLock:
    """The lock of one bag directory. Children that inherit it hold it, too."""

    descriptor: int
    path: Path

    @classmethod
    def acquire(cls, bag_dir: Path, patience_s: float = CHILD_EXIT_S) -> BagDirLock:
        """Acquires the lock.

        Raises:
            RecorderError: another recorder, which the sentence names, holds the lock; or no file
                can be locked in this directory.
        """
        path = bag_dir / LOCK_FILE
        try:
            descriptor = os.open(path, _FLAGS, 0o644)
        except OSError as error:
            raise RecorderError(
                f"{path} cannot be opened: {error.strerror}; the recorder must be able to write "
                "into recording.bag_dir"
            ) from error
        try:
            _lock(descriptor, path, patience_s)
        except BaseException:
            os.close(descriptor)
            raise
        write_holder(descriptor)
        return cls(descriptor, path)

    def renew(self) -> bool:
        """Acquires the lock again if its file is not in the bag directory any more.

        If somebody emptied, moved or mounted over the directory, the locked file keeps nobody out.
        The number of the descriptor stays, so that children inherit the new lock. On another disk
        than before no file is made: the directory may be the mount point of an unmounted disk.

        Returns:
            Whether the lock was acquired again.

        Raises:
            RecorderError: another recorder, which the sentence names, has acquired the lock since.
        """
        try:
            if not self.path.parent.is_dir() or is_open_file(self.path, self.descriptor):
                return False
            is_same_disk = self.path.parent.stat().st_dev == os.fstat(self.descriptor).st_dev
            flags = _FLAGS if is_same_disk else _FLAGS & ~os.O_CREAT
            descriptor = os.open(self.path, flags, 0o644)
        except OSError:
            return False
        try:
            _lock(descriptor, self.path, 0.0)
            os.dup2(descriptor, self.descriptor, inheritable=False)
        finally:
            os.close(descriptor)
        write_holder(self.descriptor)
        return True

    def release(self) -> None:
        """Releases the lock; the file stays, since deleting it would let two recorders in."""
        with suppress(OSError):
            os.close(self.descriptor)


def _lock(descriptor: int, path: Path, patience_s: float) -> None:
    give_up = time.monotonic() + patience_s
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            pid, host = read_holder(descriptor)
            who = f"process {pid} on {host}" if pid is not None else "a process that left no name"
            # In a restarted container this process may have the number of the one before.
            is_other = pid != os.getpid()
            if pid is None or host != socket.gethostname() or (is_other and runs(pid)):
                raise RecorderError(
                    f"{path.parent} is being recorded into by {who}; two recorders cannot share it"
                ) from None
            if time.monotonic() >= give_up:
                raise RecorderError(
                    f"{path.parent}: {who} has died, and a ros2 bag record of its that still runs "
                    "does not end; end that process"
                ) from None
            time.sleep(_POLL_S)
        except OSError as error:
            raise RecorderError(
                f"{path} cannot be locked: {error.strerror}; recording.bag_dir must be on a file "
                "system that supports locks"
            ) from error
        else:
            return


def write_holder(descriptor: int) -> None:
    """Writes this process into the lock file, except on a full disk: that stops no recorder."""
    text = json.dumps({"pid": os.getpid(), "host": socket.gethostname()}) + "\n"
    with suppress(OSError):
        # Written in place and truncated afterwards: existing blocks need no free space.
        written = os.pwrite(descriptor, text.encode(), 0)
        os.ftruncate(descriptor, written)


def read_holder(descriptor: int) -> tuple[int | None, str | None]:
    """Returns the process id and the host in the lock file; None for both if it has none."""
    try:
        value: object = json.loads(os.pread(descriptor, _MAX_TEXT, 0))
    except (OSError, ValueError):
        return None, None
    fields: dict[object, object] = value if isinstance(value, dict) else {}
    pid, host = fields.get("pid"), fields.get("host")
    return (pid, host) if isinstance(pid, int) and isinstance(host, str) else (None, None)
