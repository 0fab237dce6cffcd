"""One child process: started without a shell, read line by line, ended within a bounded time.

A child is a session and a process group of its own. It dies with the thread that started it
(PR_SET_PDEATHSIG), so only the main thread may start one. A thread reads its output, so that it
never blocks on a full pipe; lines that are not taken are dropped in time. No signal ever reaches a
process that was not started here: a child's exit is noticed without reaping it (WNOWAIT), and no
other process gets its number until it is reaped.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Final, NamedTuple

from ros2_memory.core.errors import RecorderError

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

LAUNCHER: Final = Path(__file__).with_name("launch.py")
MAX_LINE: Final = 4096
"""Characters of one line that are kept."""
MAX_LINES: Final = 10_000
"""Lines that wait to be taken; of more, the oldest are dropped."""
UNKNOWN_STATUS: Final = 255
"""The exit status of a child that the system reaped, as it does where SIGCHLD is ignored."""

_READER_PATIENCE_S: Final = 1.0
_POLL_S: Final = 0.02


class Patience(NamedTuple):
    """How long to wait for an ending child after each signal, in seconds."""

    interrupt_s: float = 8.0
    terminate_s: float = 4.0
    kill_s: float = 3.0

    def signal_due(self, since_s: float) -> signal.Signals:
        """Returns the strongest signal that is due `since_s` seconds after the first."""
        if since_s < self.interrupt_s:
            return signal.SIGINT
        if since_s < self.interrupt_s + self.terminate_s:
            return signal.SIGTERM
        return signal.SIGKILL


class Child:
    """A running program, and the lines that it printed. Use it from one thread.

    Attributes:
        pid: the number of its process, and of its group.
        patience_s: for how many seconds to call `end`; not even SIGKILL ends a process that waits
            for a disk.
    """

    def __init__(self, process: subprocess.Popen[bytes], patience: Patience) -> None:
        self._process = process
        self._patience = patience
        self.pid = process.pid
        self.patience_s = sum(patience)
        self._lines: deque[str] = deque(maxlen=MAX_LINES)
        self._status: int | None = None
        self._ending_since: float | None = None
        self._sent: signal.Signals | None = None
        self._reader = threading.Thread(
            target=_read,
            args=(process.stdout, self._lines),
            name=f"output of {process.pid}",
            daemon=True,
        )
        self._reader.start()

    @classmethod
    def start(
        cls,
        argv: Sequence[str],
        env: Mapping[str, str],
        *,
        keep_open: Collection[int] = (),
        patience: Patience | None = None,
        stderr: int | None = subprocess.STDOUT,
    ) -> Child:
        """Starts a program without a shell.

        Args:
            argv: the path of the program, and its arguments.
            env: its whole environment.
            keep_open: file descriptors that it inherits besides its output.
            patience: how long to wait for it after each signal.
            stderr: where its stderr goes; None leaves it to this program's stderr.

        Raises:
            RecorderError: the program cannot be started.
        """
        if threading.current_thread() is not threading.main_thread():
            raise RecorderError("a child must be started from the main thread: it dies with it")
        launched = [sys.executable, "-I", "-S", str(LAUNCHER), str(os.getpid()), *argv]
        process = _spawn(launched, env, subprocess.PIPE, stderr, keep_open)
        return cls(process, patience or Patience())

    def take_lines(self) -> list[str]:
        """Returns the lines that it printed since the last call, oldest first."""
        # Only those of this moment: the reading thread may add lines without end.
        return [self._lines.popleft() for _ in range(len(self._lines))]

    def exit_status(self) -> int | None:
        """Returns None while it runs, then its exit code, or minus the number of a signal.

        The rest of its group is killed first. `take_lines` then returns all its output.
        `UNKNOWN_STATUS` stands for a child that was reaped elsewhere.
        """
        if self._status is not None:
            return self._status
        try:
            if os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
                return None
            self._signal_group(signal.SIGKILL)
        except ChildProcessError:
            # Already reaped: the number may belong to another process by now.
            self._process.returncode = UNKNOWN_STATUS
        self._status = self._process.wait()
        self._reader.join(_READER_PATIENCE_S)
        return self._status

    def end(self) -> int | None:
        """Asks it to end, without waiting. Call it again until it returns an exit status.

        The first call sends SIGINT, later ones SIGTERM and SIGKILL as the patience runs out.
        """
        status = self.exit_status()
        if status is not None:
            return status
        now = time.monotonic()
        if self._ending_since is None:
            self._ending_since = now
        due = self._patience.signal_due(now - self._ending_since)
        if due is not self._sent:
            self._sent = due
            self._signal_group(due)
        return None

    def _signal_group(self, number: signal.Signals) -> None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, number)


def end_all(children: Collection[Child]) -> list[Child]:
    """Ends all children at once; returns those that still run after their patience."""
    patience_s = max((child.patience_s for child in children), default=0.0)
    give_up = time.monotonic() + patience_s
    while True:
        left = [child for child in children if child.end() is None]
        if not left or time.monotonic() >= give_up:
            return left
        time.sleep(_POLL_S)


def run_bounded(
    argv: Sequence[str], env: Mapping[str, str], timeout_s: float
) -> subprocess.CompletedProcess[bytes]:
    """Runs a program to its end, without waiting for processes that it leaves running.

    Its output goes to files, in memory: `subprocess.run` would wait until every copy of a pipe is
    closed.

    Raises:
        RecorderError: the program cannot be started, or runs for longer than `timeout_s`.
    """
    with (
        os.fdopen(os.memfd_create("output"), "rb") as output,
        os.fdopen(os.memfd_create("errors"), "rb") as errors,
    ):
        process = _spawn(argv, env, output.fileno(), errors.fileno(), ())
        try:
            status = process.wait(timeout_s)
        except subprocess.TimeoutExpired as error:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            raise RecorderError(
                f"{' '.join(argv[:3])} ... did not come to an end within {timeout_s:g} s"
            ) from error
        output.seek(0)
        errors.seek(0)
        return subprocess.CompletedProcess(argv, status, output.read(), errors.read())


def _spawn(
    argv: Sequence[str],
    env: Mapping[str, str],
    stdout: int,
    stderr: int | None,
    keep_open: Collection[int],
) -> subprocess.Popen[bytes]:
    try:
        return subprocess.Popen(  # noqa: S603 - an argv list, and never a shell
            list(argv),
            env=dict(env),
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
            start_new_session=True,
            pass_fds=tuple(keep_open),
        )
    except (OSError, ValueError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise RecorderError(f"{argv[0]} cannot be started: {reason}") from error


def _read(stream: IO[bytes], lines: deque[str]) -> None:
    """Reads lines until every copy of the pipe is closed."""
    with stream:
        while piece := stream.readline(MAX_LINE):
            lines.append(piece.decode("utf-8", errors="replace").rstrip("\r\n"))
