"""What the service manager is told, over a real socket."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from ros2_memory.core.sd_notify import (
    READY,
    STOPPING,
    ServiceManager,
    watchdog_interval_s,
)


@pytest.fixture
def listener() -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    listener.settimeout(5)
    return listener


def test_it_is_told_over_a_socket_in_the_file_system(
    tmp_path: Path, listener: socket.socket
) -> None:
    with listener:
        listener.bind(str(tmp_path / "notify"))
        assert ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "notify")}).notify(READY)
        assert listener.recv(100) == b"READY=1"


def test_it_is_told_over_an_abstract_socket(listener: socket.socket) -> None:
    name = f"ros2-memory-test-{os.getpid()}"
    with listener:
        listener.bind("\0" + name)
        assert ServiceManager({"NOTIFY_SOCKET": "@" + name}).notify(STOPPING, "STATUS=over")
        assert listener.recv(100) == b"STOPPING=1\nSTATUS=over"


@pytest.mark.parametrize("env", [{}, {"NOTIFY_SOCKET": ""}, {"NOTIFY_SOCKET": "/nowhere/at/all"}])
def test_where_nobody_listens_nothing_happens(env: dict[str, str]) -> None:
    assert not ServiceManager(env).notify(READY)


def test_it_is_told_twice_as_often_as_it_asks() -> None:
    assert watchdog_interval_s({"WATCHDOG_USEC": "30000000"}) == 15
    mine = {"WATCHDOG_USEC": "30000000", "WATCHDOG_PID": str(os.getpid())}
    assert watchdog_interval_s(mine) == 15


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
def test_it_is_not_told_what_it_does_not_ask_for(env: dict[str, str]) -> None:
    assert watchdog_interval_s(env) is None
