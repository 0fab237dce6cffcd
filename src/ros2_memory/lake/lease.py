"""One writer for one lake: a lock that the system releases when its holder dies.

The lock is a file in the lake's state directory. Two machines that write one lake must share that
directory, on a file system that supports locks.
"""

from __future__ import annotations

import fcntl
import json
import os
import socket
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import LakeError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

LEASE_FILE: Final = "writer.lock"
_FLAGS: Final = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
_MAX_TEXT: Final = 1000


@contextmanager
def writing_alone(state_dir: Path) -> Iterator[None]:
    """Holds the lock of a lake.

    Raises:
        LakeError: another process holds it, which the sentence names; or nothing can be locked.
    """
    path = state_dir / LEASE_FILE
    try:
        state_dir.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, _FLAGS, 0o644)
    except OSError as error:
        raise LakeError(f"{path} cannot be opened: {error.strerror}") from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise LakeError(
                f"{_holder(descriptor)} writes into this lake; a lake has one writer: stop that "
                "process first"
            ) from None
        except OSError as error:
            raise LakeError(
                f"{path} cannot be locked: {error.strerror}; lake.state_dir must be on a file "
                "system that supports locks"
            ) from error
        text = json.dumps({"pid": os.getpid(), "host": socket.gethostname()}) + "\n"
        with suppress(OSError):  # a full disk: the lock holds all the same
            os.ftruncate(descriptor, os.pwrite(descriptor, text.encode(), 0))
        yield
    finally:
        os.close(descriptor)


def holder_of(state_dir: Path) -> str | None:
    """Returns who holds the lock of a lake; None where nobody does. Writes nothing.

    Raises:
        LakeError: that cannot be found out.
    """
    path = state_dir / LEASE_FILE
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise LakeError(f"{path} cannot be opened: {error.strerror}") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return _holder(descriptor)
    except OSError as error:
        raise LakeError(f"{path} cannot be locked: {error.strerror}") from error
    else:
        return None
    finally:
        os.close(descriptor)


def _holder(descriptor: int) -> str:
    try:
        value: object = json.loads(os.pread(descriptor, _MAX_TEXT, 0))
    except (OSError, ValueError):
        value = None
    if not isinstance(value, dict):
        return "another process"
    return f"process {value.get('pid')} on {value.get('host')}"
