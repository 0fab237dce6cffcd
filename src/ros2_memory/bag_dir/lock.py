"""One recorder for one bag directory: a lock that the system lets go of when its holders die.

The recorder's child inherits the lock. A daemon that was killed leaves a child that needs a moment
to close its files, and nobody may repair or record there before it has.
"""

from __future__ import annotations

import fcntl
import json
import os
import socket
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.layout import LOCK_FILE
from ros2_memory.core.errors import RecorderError

if TYPE_CHECKING:
    from pathlib import Path

CHILD_PATIENCE_S: Final = 15.0
"""How long the child of a recorder that died is waited for."""
_POLL_S: Final = 0.1
_FLAGS: Final = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
_MAX_TEXT: Final = 1000


class BagDirLock:
    """The lock of one bag directory, held until `release` and by children that inherit it."""

    def __init__(self, descriptor: int, path: Path) -> None:
        self.descriptor = descriptor
        self._path = path

    @classmethod
    def acquire(cls, bag_dir: Path, patience_s: float = CHILD_PATIENCE_S) -> BagDirLock:
        """Takes the lock.

        Raises:
            RecorderError: another recorder holds it, and the sentence says who; or there can be
                no lock in this directory.
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
            _take(descriptor, path, patience_s)
        except BaseException:
            os.close(descriptor)
            raise
        _sign(descriptor)
        return cls(descriptor, path)

    def renew(self) -> bool:
        """Takes the lock anew where its file is not in the bag directory any more.

        Somebody emptied the directory, moved it, or mounted another: what is locked then keeps
        nobody out. The descriptor stays the same number, so that children inherit what it holds.
        Gives whether it was taken anew. Where that cannot be done, this time nothing is. On another
        disk than before no file is made: it may be what lies below the one that was unmounted.

        Raises:
            RecorderError: another recorder has taken it since, and the sentence says who.
        """
        try:
            if not self._path.parent.is_dir() or _is_file(self._path, self.descriptor):
                return False
            at_home = self._path.parent.stat().st_dev == os.fstat(self.descriptor).st_dev
            flags = _FLAGS if at_home else _FLAGS & ~os.O_CREAT
            descriptor = os.open(self._path, flags, 0o644)
        except OSError:
            return False
        try:
            _take(descriptor, self._path, 0.0)
            os.dup2(descriptor, self.descriptor, inheritable=False)
        finally:
            os.close(descriptor)
        _sign(self.descriptor)
        return True

    def release(self) -> None:
        """Lets go of it; the file stays, since deleting it would let two in."""
        with suppress(OSError):
            os.close(self.descriptor)


def _take(descriptor: int, path: Path, patience_s: float) -> None:
    give_up = time.monotonic() + patience_s
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            pid, host = _holder(descriptor)
            alive = host != socket.gethostname() or pid is None or _is_alive(pid)
            if alive or time.monotonic() >= give_up:
                raise RecorderError(_refusal(path, pid, host, alive=alive)) from None
            time.sleep(_POLL_S)
        except OSError as error:
            raise RecorderError(
                f"{path} cannot be locked: {error.strerror}; recording.bag_dir must lie on a file "
                "system with locks"
            ) from error
        else:
            return


def _refusal(path: Path, pid: int | None, host: str | None, *, alive: bool) -> str:
    who = f"process {pid} on {host}" if pid is not None else "a process that left no name"
    if alive:
        return f"{path.parent} is being recorded into by {who}; two recorders cannot share it"
    return (
        f"{path.parent}: {who} has died, and a ros2 bag record of its that still runs does not "
        "end; end that process"
    )


def _sign(descriptor: int) -> None:
    """Says in the file who holds it. A full disk keeps nobody from that who may make room."""
    text = json.dumps({"pid": os.getpid(), "host": socket.gethostname()}) + "\n"
    with suppress(OSError):
        # In place, and shortened then: what is there already needs no room.
        written = os.pwrite(descriptor, text.encode(), 0)
        os.ftruncate(descriptor, written)


def _is_file(path: Path, descriptor: int) -> bool:
    """Whether the path still names the open file; also where that cannot be told."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
    except OSError:
        return True


def _holder(descriptor: int) -> tuple[int | None, str | None]:
    """Who says to hold the lock."""
    try:
        value: object = json.loads(os.pread(descriptor, _MAX_TEXT, 0))
    except (OSError, ValueError):
        return None, None
    if not isinstance(value, dict):
        return None, None
    fields: dict[object, object] = value
    pid, host = fields.get("pid"), fields.get("host")
    if not isinstance(pid, int) or isinstance(pid, bool) or not isinstance(host, str):
        return None, None
    return pid, host


def _is_alive(pid: int) -> bool:
    if pid == os.getpid():
        return False  # a container that was started anew: the one before it had the same number
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True
