"""Asks the operating system whether its clock is synchronised with a time server."""

from __future__ import annotations

import ctypes
import os
from typing import TYPE_CHECKING, Final

from ros2_memory.core.errors import RecorderError
from ros2_memory.recorder.process.child import run_bounded
from ros2_memory.retention.time_sync import TimeSync

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

TIMEOUT_S: Final = 5.0
"""How long `timedatectl` may take; the bus may have to start timedated."""
MAX_ERROR_US: Final = 16_000_000
"""The kernel's error bound where nobody disciplines the clock (NTP_PHASE_LIMIT, 16 s)."""

_ASK: Final = ("timedatectl", "show", "--property=NTPSynchronized", "--value")
_PASSED_ON: Final = ("PATH", "DBUS_SYSTEM_BUS_ADDRESS")


class SystemTimeSync(TimeSync):
    """Asks systemd's timedated, and the kernel where there is no timedated.

    timedated first: the recorder's unit sets `ProtectClock=yes`, whose filter refuses adjtimex(2),
    while the system bus is a socket that it may connect to. Both report the same: the kernel's
    error bound, which chronyd, ntpd, ptp4l and systemd-timesyncd keep small, which any other step
    of the clock resets, and which grows beyond 16 s about nine hours after the last of them ended.

    Args:
        environment: what `timedatectl` is looked up in.
        kernel_error_us: the kernel's error bound in microseconds; None where it is not known.
    """

    def __init__(
        self,
        environment: Mapping[str, str] | None = None,
        kernel_error_us: Callable[[], int | None] | None = None,
    ) -> None:
        self._environment = os.environ if environment is None else environment
        self._kernel_error_us = kernel_error_us or kernel_error

    def is_synchronised(self) -> bool:
        """Whether timedated says so, or the kernel where timedated cannot be asked."""
        reported = self._timedated()
        if reported is not None:
            return reported
        error_us = self._kernel_error_us()
        return error_us is not None and error_us < MAX_ERROR_US

    def _timedated(self) -> bool | None:
        env = {name: self._environment[name] for name in _PASSED_ON if name in self._environment}
        try:
            finished = run_bounded(_ASK, {**env, "LC_ALL": "C"}, TIMEOUT_S)
        except (RecorderError, OSError):
            return None
        answer = finished.output.strip()
        return answer == b"yes" if not finished.status and answer in {b"yes", b"no"} else None


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
    """The kernel's bound on the clock's error (us); None where the kernel does not let it be read.

    Modes of 0 only read.
    """
    timex = _Timex()
    try:
        status: int = ctypes.CDLL(None).adjtimex(ctypes.byref(timex))
    except (OSError, AttributeError):
        return None
    return int(timex.maxerror) if status >= 0 else None
