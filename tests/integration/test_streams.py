"""The programs where stdin, stdout or stderr is closed, full, or a pipe that nobody reads."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.bags import odom, write_mcap

_NO_SPACE = "ros2-memory: No space left on device\n"


@pytest.fixture(scope="module")
def bag_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags")
    write_mcap(folder / "rec" / "rec_0.mcap", [odom(1_700_000_000 * 10**9, 1.0, 2.0)])
    return folder


def ended(bag_dir: Path, program: str, redirection: str) -> tuple[int, str]:
    """The exit code of a program, started anew with its streams redirected, and its stderr."""
    name, *words = program.format(bags=bag_dir).split()
    start = f"import sys; from ros2_memory import programs; sys.exit(programs.{name}())"
    env = {**os.environ, "XDG_CACHE_HOME": str(bag_dir / "cache")}
    env.pop("PYTHONUNBUFFERED", None)
    done = subprocess.run(
        ["sh", "-c", f'"$@" {redirection}', "sh", sys.executable, "-c", start, *words],
        env=env,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    ("program", "redirection", "code"),
    [
        ("memory cat /odom {bags}", ">&-", 0),
        ("memory info {bags}", "<&- >&- 2>&-", 0),
        ("memory info {bags}/gone", "2>&-", 2),
        ("server recording.bag_dir={bags}", "<&-", 0),
        ("server recording.bag_dir={bags}", ">&-", 0),
        ("server recording.bag_dir={bags} logging.format=pretty", "2>&-", 0),
        ("recorder no.such=1", "2>&-", 2),
    ],
)
def test_a_closed_stream_is_as_good_as_dev_null(
    bag_dir: Path, program: str, redirection: str, code: int
) -> None:
    exit_code, said = ended(bag_dir, program, redirection)
    assert "Traceback" not in said
    assert exit_code == code


@pytest.mark.parametrize(
    ("program", "redirection", "said"),
    [
        ("memory --version", ">/dev/full", _NO_SPACE),
        ("memory info {bags}", ">/dev/full", "ros2-memory info: No space left on device\n"),
        ("memory info {bags}/gone", "2>/dev/full", ""),
    ],
)
def test_what_cannot_be_written_is_said_once(
    bag_dir: Path, program: str, redirection: str, said: str
) -> None:
    assert ended(bag_dir, program, redirection) == (2, said)


def test_a_pipe_that_nobody_reads_gets_no_complaint(bag_dir: Path) -> None:
    # `true` has ended long before anything is printed.
    assert ended(bag_dir, "memory --version", "| true") == (0, "")
