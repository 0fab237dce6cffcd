"""Temporary folders that a process locks: those of programs that were killed are deleted."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
import time
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

_HIDDEN: Final = ".ros2-memory-writing-"
_UNLOCKED_S: Final = 60
"""A folder of less age may be of a program that is about to lock it."""


@contextmanager
def hidden_folder(parent: Path) -> Iterator[Path]:
    """Yields a new hidden folder inside another one, and deletes it after the block.

    Those that killed programs left there are deleted before.

    Raises:
        OSError: it cannot be made.
    """
    delete_abandoned(parent, _HIDDEN)
    with ExitStack() as stack:
        made = tempfile.TemporaryDirectory(dir=parent, prefix=_HIDDEN, ignore_cleanup_errors=True)
        folder = Path(stack.enter_context(made))
        with suppress(OSError):  # where nothing can be locked, nobody else deletes it
            stack.callback(os.close, lock_folder(folder))
        yield folder


def delete_abandoned(parent: Path, prefix: str) -> None:
    """Deletes the folders of programs that were killed: no process has them locked any more."""
    for folder in parent.glob(f"{prefix}*"):
        with suppress(OSError):  # of another user, or in use
            if time.time() - folder.stat().st_mtime > _UNLOCKED_S:
                descriptor = lock_folder(folder)
                shutil.rmtree(folder, ignore_errors=True)
                os.close(descriptor)


def lock_folder(folder: Path) -> int:
    """Locks a folder while this process lives, and returns its descriptor.

    Raises:
        OSError: another has it, or it cannot be locked.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor
