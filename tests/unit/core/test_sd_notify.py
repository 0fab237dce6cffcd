"""What is sent to the service manager, over a real socket."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from ros2_memory.core.sd_notify import (
    READY,
    STOPPING,
    notify,
    watchdog_interval_s,
)


@pytest.fixture
def listener() -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    listener.settimeout(5)
    return listener


def set_only(monkeypatch: pytest.MonkeyPatch, env: dict[str, str]) -> None:
    for name in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"):
        monkeypatch.delenv(name, raising=False)
    for name, value in env.items():
        monkeypatch.setenv(name, value)


def test_it_is_told_over_a_socket_in_the_file_system(
    tmp_path: Path, listener: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    with listener:
        listener.bind(str(tmp_path / "notify"))
        assert notify(READY)
        assert listener.recv(100) == b"READY=1"


def test_it_is_told_over_an_abstract_socket(
    listener: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = f"ros2-memory-test-{os.getpid()}"
    monkeypatch.setenv("NOTIFY_SOCKET", "@" + name)
    with listener:
        listener.bind("\0" + name)
        assert notify(STOPPING, "STATUS=over")
        assert listener.recv(100) == b"STOPPING=1\nSTATUS=over"


def test_it_is_told_twice_as_often_as_it_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    set_only(monkeypatch, {"WATCHDOG_USEC": "30000000"})
    assert watchdog_interval_s() == 15
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    assert watchdog_interval_s() == 15


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
    set_only(monkeypatch, env)
    assert watchdog_interval_s() is None
