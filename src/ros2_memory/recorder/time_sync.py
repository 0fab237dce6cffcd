"""Asks the operating system whether its clock is synchronised with a time server.

Only then may its dates decide what is deleted: a clock that was set by hand, or that starts wrong
because its battery is empty, looks like any other.
"""

from __future__ import annotations

import ctypes
import os
from typing import Final

from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.process.child import run_bounded

TIMEOUT_S: Final = 5.0
"""How long `timedatectl` may take; the bus may have to start timedated."""
MAX_ERROR_US: Final = 16_000_000
"""The kernel's error bound where nothing disciplines the clock (NTP_PHASE_LIMIT, 16 s)."""

_ASK: Final = ("timedatectl", "show", "--property=NTPSynchronized", "--value")
_PASSED_ON: Final = ("PATH", "DBUS_SYSTEM_BUS_ADDRESS")


def is_synchronised() -> bool:
    """Whether timedated, or the kernel if there is no timedated, reports a synchronised clock.

    timedated comes first: the recorder's unit sets `ProtectClock=yes`, whose filter refuses
    adjtimex(2) and allows the system bus. Both report the kernel's error bound. chronyd, ntpd,
    ptp4l and systemd-timesyncd keep it small, any other step of the clock resets it, and it grows
    beyond 16 s about nine hours after the last of them ended.

    Takes up to some seconds. Raises nothing; False if neither answers.
    """
    answer = _ask_timedated()
    if answer is not None:
        return answer
    error_us = kernel_error()
    return error_us is not None and error_us < MAX_ERROR_US


def _ask_timedated() -> bool | None:
    env = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    try:
        finished = run_bounded(_ASK, {**env, "LC_ALL": "C"}, TIMEOUT_S)
    except (RecorderError, OSError):
        return None
    answer = finished.stdout.strip()
    return answer == b"yes" if not finished.returncode and answer in {b"yes", b"no"} else None


class _Timex(ctypes.Structure):
    """The start of `struct timex` (adjtimex(2)), and room for the rest."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("rest", ctypes.c_char * 512),
    )


def kernel_error() -> int | None:
    """Returns the kernel's bound on the clock's error in microseconds; None if it refuses.

    A structure whose `modes` are 0 only reads, adjtimex(2).
    """
    timex = _Timex()
    try:
        status: int = ctypes.CDLL(None).adjtimex(ctypes.byref(timex))
    except (OSError, AttributeError):
        return None
    return int(timex.maxerror) if status >= 0 else None
