"""Who can reach an address, and the error where the server cannot listen on it."""

import socket

import pytest

from ros2_memory.serving.listen import CannotListenError, bound, resolved


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("127.0.0.2", True),
        ("localhost", True),
        ("LOCALHOST", True),
        ("::1", True),
        ("127.1", True),
        (".".join("0000"), False),
        ("::", False),
        ("192.0.2.7", False),
        ("fe80::1", False),
        ("2001:db8::1", False),
    ],
)
def test_whether_others_can_reach_it_is_judged_by_the_address(host: str, loopback: bool) -> None:
    assert resolved(host, 9203).is_loopback is loopback


@pytest.mark.parametrize("host", ["nosuch.invalid", "a" * 300, "..", "robot lan"])
def test_a_host_without_an_address_is_told_with_what_to_do(host: str) -> None:
    with pytest.raises(CannotListenError, match="give an address of this machine with MCP_HOST"):
        resolved(host, 9203)


def test_what_is_judged_is_what_is_listened_on() -> None:
    address = resolved("localhost", 0)
    with bound(address) as listening:
        assert listening.getsockname()[0] == address.ip
        assert listening.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
