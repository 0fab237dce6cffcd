"""Messages to the service manager through `NOTIFY_SOCKET` (sd_notify(3)); none if it is unset."""

from __future__ import annotations

import os
import socket
import time
from typing import Final

READY: Final = "READY=1"
WATCHDOG: Final = "WATCHDOG=1"
STOPPING: Final = "STOPPING=1"


def notify(*assignments: str) -> bool:
    """Sends assignments such as `READY` to systemd; returns whether they were sent."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return False
    if address.startswith("@"):
        address = "\0" + address[1:]  # the null byte of an abstract socket (unix(7))
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            sender.setblocking(False)
            sender.connect(address)
            sender.send("\n".join(assignments).encode())
    except OSError:
        return False
    return True


class Watchdog:
    """Keeps systemd's watchdog from ending this process (`WatchdogSec`)."""

    def __init__(self) -> None:
        self._every_s = watchdog_interval_s()
        self._due_s = 0.0

    def keep_alive(self) -> None:
        """Sends `WATCHDOG=1` if it is due; may be called at any rate."""
        if self._every_s is not None and time.monotonic() >= self._due_s:
            notify(WATCHDOG)
            self._due_s = time.monotonic() + self._every_s / 2


def watchdog_interval_s() -> float | None:
    """Returns half of the time after which systemd acts without a `WATCHDOG` (WATCHDOG_USEC).

    None if systemd expects no `WATCHDOG` of this process.
    """
    pid = os.environ.get("WATCHDOG_PID", str(os.getpid()))
    microseconds = os.environ.get("WATCHDOG_USEC", "")
    if not microseconds.isdecimal() or int(microseconds) == 0 or pid != str(os.getpid()):
        return None
    return int(microseconds) / 2e6
