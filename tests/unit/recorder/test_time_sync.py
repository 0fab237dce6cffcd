"""Whether the clock is synchronised: asked of timedated, and of the kernel where there is none."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from ros2_memory.recorder import time_sync
from ros2_memory.recorder.time_sync import is_synchronised, kernel_error

DISCIPLINED, UNDISCIPLINED = 4_000, 16_000_000


def timedatectl(folder: Path, script: str) -> dict[str, str]:
    """An environment in which `timedatectl` is this script."""
    program = folder / "timedatectl"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    return {"PATH": f"{folder}:/usr/bin:/bin"}


@pytest.mark.parametrize(("answer", "expected"), [("yes", True), ("no", False)])
@pytest.mark.parametrize("error_us", [DISCIPLINED, UNDISCIPLINED, None])
def test_timedated_is_believed_before_the_kernel(
    tmp_path: Path, answer: str, error_us: int | None, expected: bool
) -> None:
    env = timedatectl(tmp_path, f"echo {answer}")
    assert is_synchronised(env, lambda: error_us) is expected


def test_it_is_asked_for_the_one_property_and_inherits_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = tmp_path / "asked"
    env = timedatectl(tmp_path, f'echo "$@" > {asked}; env >> {asked}; echo yes')
    assert is_synchronised({**env, "MEMORY_API_TOKEN": "secret"})
    assert asked.read_text().startswith("show --property=NTPSynchronized --value\n")
    assert "secret" not in asked.read_text()


@pytest.mark.parametrize(
    "script",
    ["exit 1", "echo yes; exit 1", "echo perhaps", "true", "kill -9 $$"],
    ids=["fails", "fails after all", "says something else", "says nothing", "is killed"],
)
@pytest.mark.parametrize(
    ("error_us", "expected"), [(DISCIPLINED, True), (UNDISCIPLINED, False), (None, False)]
)
def test_where_timedated_cannot_say_the_kernel_does(
    tmp_path: Path, script: str, error_us: int | None, expected: bool
) -> None:
    env = timedatectl(tmp_path, script)
    assert is_synchronised(env, lambda: error_us) is expected


def test_without_systemd_the_kernel_is_asked(tmp_path: Path) -> None:
    env = {"PATH": str(tmp_path)}
    assert is_synchronised(env, lambda: DISCIPLINED)
    assert not is_synchronised(env, lambda: None)


def test_one_that_hangs_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_sync, "TIMEOUT_S", 0.2)
    env = timedatectl(tmp_path, "exec sleep 60")
    assert not is_synchronised(env, lambda: None)


def test_the_kernel_of_this_machine_says_something_or_nothing() -> None:
    error_us = kernel_error()
    assert error_us is None or 0 <= error_us <= UNDISCIPLINED
