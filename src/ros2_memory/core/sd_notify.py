"""Messages to the service manager over `NOTIFY_SOCKET` (sd_notify(3)); none where it is unset."""

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
    """Tells systemd how the daemon is. What cannot be delivered is dropped: it cannot be helped.

    `env` is the process's own environment where None.
    """

    def __init__(self, env: Mapping[str, str] | None = None) -> None:
        given = os.environ if env is None else env
        address = given.get("NOTIFY_SOCKET", "")
        # A leading @ stands for the null byte of an abstract socket (unix(7)).
        self._address = "\0" + address[1:] if address.startswith("@") else address

    def tell(self, *assignments: str) -> bool:
        """Sends assignments such as `READY`; whether they were delivered."""
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
    """How often systemd is to be told that the daemon lives: half of what it waits for.

    None where it does not ask for that, or asks another process.
    """
    given = os.environ if env is None else env
    pid = given.get("WATCHDOG_PID", str(os.getpid()))
    microseconds = given.get("WATCHDOG_USEC", "")
    if not microseconds.isdecimal() or int(microseconds) == 0 or pid != str(os.getpid()):
        return None
    return int(microseconds) / 2e6
