"""Whether the clock is synchronised: asked of timedated, and of the kernel where there is none."""

from pathlib import Path

import pytest

from ros2_memory.recorder import time_sync
from ros2_memory.recorder.time_sync import is_synchronised

DISCIPLINED, UNDISCIPLINED = 4_000, 16_000_000


def asked(
    monkeypatch: pytest.MonkeyPatch, folder: Path, script: str, error_us: int | None = None
) -> bool:
    """What is answered where `timedatectl` is this script, and the kernel says that."""
    program = folder / "timedatectl"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")
    monkeypatch.setattr(time_sync, "kernel_error", lambda: error_us)
    return is_synchronised()


def test_it_is_asked_for_the_one_property_and_inherits_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard = tmp_path / "heard"
    monkeypatch.setenv("MEMORY_API_TOKEN", "secret")
    assert asked(monkeypatch, tmp_path, f'echo "$@" > {heard}; env >> {heard}; echo yes')
    assert heard.read_text().startswith("show --property=NTPSynchronized --value\n")
    assert "secret" not in heard.read_text()


@pytest.mark.parametrize(
    ("script", "error_us", "expected"),
    [
        ("echo yes", UNDISCIPLINED, True),
        ("echo no", DISCIPLINED, False),
        ("true", DISCIPLINED, True),
        ("true", UNDISCIPLINED, False),
        ("true", None, False),
        *((script, DISCIPLINED, True) for script in ("exit 1", "echo no; exit 1", "kill -9 $$")),
        ("echo yes; exit 1", None, False),
    ],
)
def test_timedated_is_believed_before_the_kernel_which_is_asked_where_it_cannot_say(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    script: str,
    error_us: int | None,
    expected: bool,
) -> None:
    assert asked(monkeypatch, tmp_path, script, error_us) is expected


def test_one_that_hangs_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_sync, "TIMEOUT_S", 0.2)
    assert not asked(monkeypatch, tmp_path, "exec sleep 60")
