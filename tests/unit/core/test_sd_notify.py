"""What is sent to the service manager, over a real socket."""

import os
import socket

import pytest

from ros2_memory.core.sd_notify import STOPPING, notify, watchdog_interval_s


def test_it_is_told_over_an_abstract_socket_too(monkeypatch: pytest.MonkeyPatch) -> None:
    name = f"\0ros2-memory-test-{os.getpid()}"
    monkeypatch.setenv("NOTIFY_SOCKET", name.replace("\0", "@"))
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.settimeout(5)
        listener.bind(name)
        assert notify(STOPPING, "STATUS=over")
        assert listener.recv(100) == b"STOPPING=1\nSTATUS=over"


@pytest.mark.parametrize(
    "env",
    [
        {},
        {"WATCHDOG_USEC": ""},
        {"WATCHDOG_USEC": "soon"},
        {"WATCHDOG_USEC": "0"},
        {"WATCHDOG_USEC": "30000000", "WATCHDOG_PID": "1"},
    ],
)
def test_it_is_not_told_what_it_does_not_ask_for(
    env: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "environ", env)
    assert watchdog_interval_s() is None
