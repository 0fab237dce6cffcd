"""The address that the server listens on."""

from __future__ import annotations

import errno
import ipaddress
import socket
from dataclasses import dataclass
from typing import Final

BACKLOG: Final = 128
"""Connections that may wait to be accepted."""


class CannotListenError(Exception):
    """The address cannot be listened on; the message says why and what to do."""


@dataclass(frozen=True, slots=True)
class Address:
    """An address to listen on, and the host name or address that was asked for."""

    host: str
    family: socket.AddressFamily
    ip: str
    port: int

    @property
    def is_loopback(self) -> bool:
        """Returns whether only programs on this machine can reach it.

        The resolved address decides, because a name may resolve to any.
        """
        try:
            return ipaddress.ip_address(self.ip.partition("%")[0]).is_loopback
        except ValueError:
            return False


def resolve(host: str, port: int) -> Address:
    """Returns the address that a host resolves to; the IPv4 address if it has both kinds.

    Raises:
        CannotListenError: it resolves to none.
    """
    try:
        candidates = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
    except (OSError, UnicodeError) as error:
        raise CannotListenError(_why_not(host, port, error)) from error
    family, *_, address = min(candidates, key=lambda candidate: candidate[0] is not socket.AF_INET)
    return Address(host, family, str(address[0]), port)


def listen(address: Address) -> socket.socket:
    """Returns a socket that listens on the address.

    Raises:
        CannotListenError: the address is in use, not this machine's, or not allowed.
    """
    try:
        listening = socket.create_server(
            (address.ip, address.port), family=address.family, backlog=BACKLOG
        )
    except OSError as error:
        raise CannotListenError(_why_not(address.host, address.port, error)) from error
    # asyncio sets this only on sockets that it creates itself. Accepted sockets inherit it; without
    # it each reply on a kept connection waits 40 ms for the client's delayed acknowledgement.
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listening


def _why_not(host: str, port: int, error: OSError | UnicodeError) -> str:
    number = error.errno if isinstance(error, OSError) else None
    if number == errno.EADDRINUSE:
        return (
            f"port {port} on {host} is in use by another program; "
            "stop that one, or choose another port with MCP_PORT"
        )
    if number == errno.EACCES:
        return f"port {port} on {host} is not allowed; choose one from 1024 up with MCP_PORT"
    reason = error.strerror if isinstance(error, OSError) else None
    return (
        f"{host} port {port} cannot be listened on ({reason or error}); "
        "give an address of this machine with MCP_HOST"
    )
