"""`ros2-memory` for scripts of tests that call it over and over, without a program's start.

Imports take most of the processor time of a short command (0.6 of 0.8 s). Here one process has them
done, and becomes the command in a fork for each call: with the arguments, the environment, the
working directory and the streams of the caller, who waits and ends with its exit code.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT: Final = Path(__file__).resolve().parents[2]
_CALLER: Final = """\
#!{python} -IS
import json, os, socket, sys
with socket.socket(socket.AF_UNIX) as peer:
    peer.connect({address!r})
    socket.send_fds(peer, [b"!"], [0, 1, 2])
    peer.sendall(json.dumps([sys.argv[1:], os.getcwd(), dict(os.environ)]).encode())
    peer.shutdown(socket.SHUT_WR)
    code = peer.recv(1)
sys.exit(code[0])
"""


@contextmanager
def forked_commands(folder: Path) -> Iterator[Path]:
    """A folder with `ros2-memory` for PATH, while the context is open.

    Args:
        folder: an empty folder; its path must be a short one, since a socket is made in it.
    """
    address, program = folder / "socket", folder / "bin" / "ros2-memory"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(address))
        listener.listen()
        program.parent.mkdir()
        program.write_text(_CALLER.format(python=sys.executable, address=str(address)))
        program.chmod(0o755)
        server = subprocess.Popen(
            [sys.executable, "-m", __name__, str(listener.fileno())],
            cwd=ROOT,
            pass_fds=[listener.fileno()],
        )
    with server:
        try:
            yield program.parent
        finally:
            server.kill()


def _serve(listener: socket.socket) -> None:
    from ros2_memory import bootstrap  # noqa: F401, PLC0415
    from ros2_memory.cli import ask, cat, doctor, export, info  # noqa: F401, PLC0415  # noqa: F401, PLC0415
    from ros2_memory.cli.__main__ import run  # noqa: PLC0415

    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    while True:
        peer, _ = listener.accept()
        with peer:
            if os.fork():
                continue
            listener.close()
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            streams = socket.recv_fds(peer, 1, 3)[1]
            with peer.makefile("rb") as said:
                argv, folder, environment = json.load(said)
            command = os.fork()
            if command:
                _, status = os.waitpid(command, 0)
                peer.sendall(bytes([os.waitstatus_to_exitcode(status) % 256]))
                os._exit(0)
        for number, stream in enumerate(streams):
            os.dup2(stream, number)
            os.close(stream)
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(environment)
        time.tzset()
        sys.argv = ["ros2-memory", *argv]
        sys.exit(run())


if __name__ == "__main__":
    _serve(socket.socket(fileno=int(sys.argv[1])))
