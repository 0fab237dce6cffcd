"""Replaces itself by another program, after resetting what a child inherits. Run as a script.

    python -I -S launch.py PARENT_PID PROGRAM [ARGUMENT ...]

It is a program of its own because this must happen between fork and exec, where a process with
threads must not run Python. It imports nothing of this package, so that it starts in milliseconds,
and ignores the environment that it passes on (-I), which may be meant for another Python.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from contextlib import suppress

_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_CANNOT_RUN = 127


def become(parent: int, argv: list[str]) -> None:
    """Replaces this process by `argv`, whose first element is the program's path.

    Every signal gets its default handler and none is blocked (a recorder started where SIGINT is
    ignored would always ignore it). The program receives SIGINT when its parent dies.
    """
    for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
        # The C library reserves some real-time signals.
        with suppress(OSError, ValueError):
            signal.signal(number, signal.SIG_DFL)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGINT, 0, 0, 0) != 0:
        sys.exit(f"prctl: {os.strerror(ctypes.get_errno())}")
    if os.getppid() != parent:
        sys.exit("the parent has died already")
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    try:
        os.execv(argv[0], argv)  # noqa: S606 - no shell is the point
    except OSError as error:
        sys.stderr.write(f"{argv[0]}: {error.strerror}\n")
        sys.exit(_CANNOT_RUN)


if __name__ == "__main__":
    become(int(sys.argv[1]), sys.argv[2:])
