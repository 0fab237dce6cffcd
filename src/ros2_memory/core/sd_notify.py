"""Messages to the service manager through `NOTIFY_SOCKET` (sd_notify(3)); none if it is unset."""

from __future__ import annotations

import os
import socket
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

READY: Final = "READY=1"
WATCHDOG: Final = "WATCHDOG=1"
STOPPING: Final = "STOPPING=1"


class ServiceManager:
    """Notifies systemd of the state of this process. Messages that cannot be sent are dropped.

    `env` is the process's own environment where None.
    """

    def __init__(self, env: Mapping[str, str] | None = None) -> None:
        address = (os.environ if env is None else env).get("NOTIFY_SOCKET", "")
        # A leading @ is the null byte of an abstract socket (unix(7)).
        self._address = "\0" + address[1:] if address.startswith("@") else address

    def notify(self, *assignments: str) -> bool:
        """Sends assignments such as `READY`; returns whether they were sent."""
        if not self._address:
            return False
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
                sender.setblocking(False)
                sender.connect(self._address)
                sender.send("\n".join(assignments).encode())
        except OSError:
            return False
        return True


def watchdog_interval_s(env: Mapping[str, str] | None = None) -> float | None:
    """Returns how often to send `WATCHDOG`: half of the time after which systemd acts.

    None where systemd does not expect it, or expects it of another process.
    """
    given = os.environ if env is None else env
    pid = given.get("WATCHDOG_PID", str(os.getpid()))
    microseconds = given.get("WATCHDOG_USEC", "")
    if not microseconds.isdecimal() or int(microseconds) == 0 or pid != str(os.getpid()):
        return None
    return int(microseconds) / 2e6
