"""The package's programs, each forked from one process that has done their imports.

It has read the shipped configuration, too. Imports take most of the processor time of a start: 0.6
of 0.8 s of a short command, 1.0 of 1.2 s of the server. A fork becomes the program with the
arguments, the environment, the working directory, the streams and the priority of the caller, who
learns its process number and how it ended. What tests the start of a program itself, or its memory,
starts it anew.
"""

import gc
import json
import os
import random
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

ROOT = Path(__file__).resolve().parents[2]
ADDRESS = "EPISODIC_FORKING"
"""The variable that tells workers the name of the socket, an abstract one without its NUL."""
_CALLER = """\
#!{python} -IS
import json, os, signal, socket, sys
with socket.socket(socket.AF_UNIX) as peer:
    peer.connect({address!r})
    socket.send_fds(peer, [b"!"], [0, 1, 2])
    program = os.path.basename(sys.argv[0])
    asked = [program, sys.argv[1:], os.getcwd(), dict(os.environ), os.nice(0)]
    peer.sendall(json.dumps(asked).encode())
    peer.shutdown(socket.SHUT_WR)
    told = peer.makefile()
    number = int(told.readline())
    signal.signal(signal.SIGTERM, lambda signal, frame: os.kill(number, signal))
    code = told.readline()
sys.exit(int(code) % 256)
"""


@contextmanager
def forking() -> Iterator[None]:
    """Within it programs can be forked; they outlive it. Its process imports with the first."""
    name = f"ros2-memory-tests-{os.getpid()}"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(f"\0{name}")
        listener.listen()
        server = subprocess.Popen(
            [sys.executable, "-m", __name__, str(listener.fileno())],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            pass_fds=[listener.fileno()],
        )
    os.environ[ADDRESS] = name
    try:
        yield
    finally:
        del os.environ[ADDRESS]
        # It ends with this pipe, also where whoever asked is killed.
        server.communicate()


def write_command(folder: Path) -> None:
    """Adds `ros2-memory` and `ros2-memory-server`, for PATH, to a folder: they are forked."""
    for name in ("ros2-memory", "ros2-memory-server"):
        program = folder / name
        program.write_text(_CALLER.format(python=sys.executable, address=_address()))
        program.chmod(0o755)


class Forked(subprocess.Popen[bytes]):
    """A program that was forked: what tests use of `Popen`.

    Args:
        program: its name: ros2-memory, ros2-memory-recorder or ros2-memory-server.
        arguments: those that follow.
        env: its environment.
        stderr: where it logs; what it prints elsewhere is lost.
    """

    def __init__(
        self, program: str, *arguments: str, env: Mapping[str, str], stderr: IO[bytes]
    ) -> None:
        self.args = [program, *arguments]
        self.stdin = self.stdout = self.stderr = None
        # As `Popen` has it, None while it runs.
        self.returncode: Any = None
        self._peer = socket.socket(socket.AF_UNIX)
        self._peer.connect(_address())
        with Path(os.devnull).open("r+b") as nothing:
            streams = [nothing.fileno(), nothing.fileno(), stderr.fileno()]
            socket.send_fds(self._peer, [b"!"], streams)
        asked = [program, arguments, str(Path.cwd()), dict(env), os.nice(0)]
        self._peer.sendall(json.dumps(asked).encode())
        self._peer.shutdown(socket.SHUT_WR)
        self._told = self._peer.makefile()
        self.pid = int(self._told.readline())

    def poll(self) -> int | None:
        return self._ended(0)

    def wait(self, timeout: float | None = None) -> int:
        code = self._ended(timeout)
        if code is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0)
        return code

    def communicate(
        self,
        input: bytes | None = None,  # noqa: A002
        timeout: float | None = None,
    ) -> tuple[bytes, bytes]:
        self.wait(timeout)
        return b"", b""

    def _ended(self, timeout_s: float | None) -> int | None:
        if self.returncode is None and select.select([self._peer], [], [], timeout_s)[0]:
            self.returncode = int(self._told.readline())
            self._told.close()
            self._peer.close()
        code: int | None = self.returncode
        return code


def _address() -> str:
    return f"\0{os.environ[ADDRESS]}"


def _serve(listener: socket.socket) -> None:
    programs: dict[str, Callable[[], int]] = {}
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    while sys.stdin not in select.select([listener, sys.stdin], [], [])[0]:
        peer, _ = listener.accept()
        programs = programs or _imported()
        with peer:
            if os.fork():
                continue
            listener.close()
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            streams = socket.recv_fds(peer, 1, 3)[1]
            with peer.makefile("rb") as said:
                program, arguments, folder, environment, niceness = json.load(said)
            number = os.fork()
            if number:
                for stream in streams:
                    os.close(stream)
                peer.sendall(f"{number}\n".encode())
                _, status = os.waitpid(number, 0)
                peer.sendall(f"{os.waitstatus_to_exitcode(status)}\n".encode())
                os._exit(0)
        for number, stream in enumerate(streams):
            os.dup2(stream, number)
            os.close(stream)
        os.chdir(folder)
        os.nice(max(0, niceness - os.nice(0)))
        os.environ.clear()
        os.environ.update(environment)
        time.tzset()
        random.seed()
        sys.argv = [program, *arguments]
        sys.exit(programs[program]())


def _imported() -> dict[str, Callable[[], int]]:
    from ros2_memory import bootstrap  # noqa: F401, PLC0415
    from ros2_memory.cli import ask, cat, doctor, export, info  # noqa: F401, PLC0415
    from ros2_memory.cli.__main__ import run  # noqa: PLC0415
    from ros2_memory.config import load_message_schemas, load_settings  # noqa: PLC0415
    from ros2_memory.recorder import __main__ as recorder  # noqa: PLC0415
    from ros2_memory.recorder import ros2bag  # noqa: F401, PLC0415
    from ros2_memory.server import main  # noqa: PLC0415
    from ros2_memory.serving import auth, mcp_server, web_app  # noqa: F401, PLC0415
    from tests.support.composed import shipped_once  # noqa: PLC0415

    shipped_once()
    load_message_schemas(load_settings(env={}))
    gc.freeze()
    return {
        "ros2-memory": run,
        "ros2-memory-recorder": recorder.main,
        "ros2-memory-server": main,
    }


if __name__ == "__main__":
    _serve(socket.socket(fileno=int(sys.argv[1])))
