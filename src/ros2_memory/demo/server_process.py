"""Runs the real query server as a child process on the loopback address."""

from __future__ import annotations

import errno
import http.client
import json
import os
import shlex
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final

import yaml

from ros2_memory.core.errors import ConfigError, EpisodicError
from ros2_memory.demo.floor_plan import ROOMS
from ros2_memory.recorder.process.child import LAUNCHER

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

HOST: Final = "127.0.0.1"
LOG_NAME: Final = "server.log"
PLACES_NAME: Final = "places.yaml"
_OURS: Final = ("MEMORY_", "MCP_", "ROS_VISION_INTERFACES_PATH", "CREDENTIALS_DIRECTORY")
_UP_WITHIN_S: Final = 300.0
"""As long as it may take on a machine with much else to do; one that fails ends at once."""
_SAID_AFTER_S: Final = 5.0
_DOWN_WITHIN_S: Final = 5.0
_LOG_LINES_SHOWN: Final = 8
_LONGEST_REPORT: Final = 1_000_000
_ANOTHER_PORT: Final = "choose another with --port, or --port 0 for any"


def free_port(wanted: int) -> int:
    """Returns the port to serve on: `wanted`, or any free one if that is 0.

    Raises:
        ConfigError: the port cannot be had; says why and what to do.
    """
    if not 0 <= wanted <= 65535:
        raise ConfigError(f"port {wanted} does not exist; give --port a number from 0 to 65535")
    try:
        with socket.create_server((HOST, wanted)) as probe:
            port: int = probe.getsockname()[1]
            return port
    except OSError as error:
        in_use = error.errno == errno.EADDRINUSE
        why = "is in use by another program" if in_use else f"cannot be opened ({error})"
        raise ConfigError(f"port {wanted} on {HOST} {why}; {_ANOTHER_PORT}") from error


def server_environment(
    environment: Mapping[str, str],
    bag_dir: Path,
    port: int,
    split_duration_s: float,
    cache: str,
) -> dict[str, str]:
    """Returns the environment of a server of `bag_dir`, without the caller's settings."""
    kept = {name: value for name, value in environment.items() if not name.startswith(_OURS)}
    return kept | {
        "MCP_TRANSPORT": "sse",
        "MCP_HOST": HOST,
        "MCP_PORT": str(port),
        "MEMORY_BAG_DIR": str(bag_dir),
        "XDG_CACHE_HOME": cache,
        "MEMORY_CONFIG_OVERRIDES": (
            f"recorder=none storage=mcap reader.index_refresh_s=1 "
            f"recording.split_duration_s={split_duration_s:g} "
            f"{shlex.quote(f'data.places_file={bag_dir / PLACES_NAME}')}"
        ),
    }


@contextmanager
def running_server(
    bag_dir: Path,
    port: int,
    say: Callable[[str], object],
    *,
    split_duration_s: float,
    verbose: bool = False,
) -> Iterator[subprocess.Popen[bytes]]:
    """Yields a server that answers, and ends it after the block; says what it waits for.

    Its log goes to `server.log` in the bag directory, or to stderr where `verbose`; its columns
    into a folder that is removed at the end: no one else uses it. The rooms of the flat are written
    to `places.yaml` in the bag directory.

    Raises:
        ConfigError: another server answers on the port.
        EpisodicError: it did not come up; the sentence ends with the last lines of its log.
    """
    log_path = bag_dir / LOG_NAME
    places = {
        name: {"x": [from_x, to_x], "y": [from_y, to_y]}
        for name, (from_x, to_x, from_y, to_y) in ROOMS.items()
    }
    (bag_dir / PLACES_NAME).write_text(yaml.safe_dump({"places": places}, sort_keys=False))
    with TemporaryDirectory(prefix="ros2-memory-demo-cache-", ignore_cleanup_errors=True) as cache:
        environment = server_environment(os.environ, bag_dir, port, split_duration_s, cache)
        with log_path.open("wb") as log:
            process = subprocess.Popen(  # noqa: S603 - an argv list, and never a shell
                [
                    # It ends with this program, also where that is killed.
                    *(sys.executable, "-I", "-S", str(LAUNCHER), str(os.getpid())),
                    *(sys.executable, "-m", "ros2_memory.server"),
                ],
                stdin=subprocess.DEVNULL,
                stdout=None if verbose else log,
                stderr=None if verbose else log,
                cwd=bag_dir,
                env=environment,
                # A Ctrl-C reaches the whole process group of a terminal; the order in which things
                # end is ours to choose.
                process_group=0,
            )
        try:
            _wait_until_up(process, port, log_path, say)
            yield process
        finally:
            process.terminate()
            try:
                process.wait(_DOWN_WITHIN_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _wait_until_up(
    process: subprocess.Popen[bytes], port: int, log_path: Path, say: Callable[[str], object]
) -> None:
    begun = time.monotonic()
    has_said = False
    while (answering := _answering(port)) != process.pid:
        if answering is not None:
            raise ConfigError(f"port {port} on {HOST} is in use by another server; {_ANOTHER_PORT}")
        code = process.poll()
        if code is not None:
            raise EpisodicError(f"the server ended with exit code {code}{_last_words(log_path)}")
        waited_s = time.monotonic() - begun
        if waited_s > _SAID_AFTER_S and not has_said:
            has_said = True
            say(f"waiting up to {_UP_WITHIN_S:g} s for the server to answer on port {port}")
        if waited_s > _UP_WITHIN_S:
            raise EpisodicError(
                f"the server did not answer on port {port} within {_UP_WITHIN_S:g} s"
                f"{_last_words(log_path)}"
            )
        time.sleep(0.05)


def _answering(port: int) -> int | None:
    """Returns the process id that the server on a port reports, 0 if it reports none.

    Returns None if no server answers.
    """
    connection = http.client.HTTPConnection(HOST, port, timeout=2.0)
    try:
        connection.request("GET", "/health")
        report = json.loads(connection.getresponse().read(_LONGEST_REPORT))
        return int(report["pid"])
    except (OSError, http.client.HTTPException):
        return None
    except (ValueError, KeyError, TypeError):
        return 0
    finally:
        connection.close()


def _last_words(log_path: Path) -> str:
    lines = log_path.read_text(errors="replace").splitlines()[-_LOG_LINES_SHOWN:]
    return "".join(f"\n  {line}" for line in (": its last words are", *lines)) if lines else ""
