"""Requests of the query server to the recorder, as files in `.episodic/requests`.

The programs share only a directory, and this is the one folder of it that the server writes to:

    <number>.json      a request, written atomically by the server
    <number>.taken     the same, when the recorder has begun with it
    <number>.answer    its outcome; the server reads and deletes it

A request that is still `.json` can be withdrawn, and then has no effect. The recorder trusts
nothing here: a program that can write here can only make requests.
"""

from __future__ import annotations

import json
import os
import re
import uuid
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

import structlog
from pydantic import StrictBool, TypeAdapter

from ros2_memory.bag_dir.durable_write import read_small_file, write_durably
from ros2_memory.bag_dir.json_files import READABLE, Count, parsed
from ros2_memory.bag_dir.layout import REQUESTS_FOLDER
from ros2_memory.bag_dir.moment_file import FORMAT, REQUEST, SaveRequest
from ros2_memory.core import directories
from ros2_memory.core.timebase import NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


MAX_AT_ONCE: Final = 16
"""Requests that the recorder takes in one turn; the next turn comes moments later."""
MAX_REQUEST_BYTES: Final = 4096
STALE_NS: Final[Ns] = 60 * NS_PER_S
"""An older request was not withdrawn because its server died."""
_KEEP_ANSWER_NS: Final[Ns] = 600 * NS_PER_S
_REQUEST_NAME: Final = re.compile(r"[0-9a-f]{32}\.(json|taken)")
_OWN_NAME: Final = re.compile(r"\.?[0-9a-f]{32}\.(json|taken|answer)(\.tmp)?")

_log: structlog.typing.FilteringBoundLogger = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a request: the folder of its moment, or why it was refused.

    `pending`: bags of it are still being written.
    """

    moment: str | None = None
    bags: Count = 0
    pending: StrictBool = False
    refused: str | None = None


_OUTCOME: Final = TypeAdapter(Outcome)


class PendingRequest:
    """One request and its answer, for the query server."""

    def __init__(self, bag_dir: Path, label: str, start: Ns, end: Ns, asked: Ns) -> None:
        self._bag_dir = bag_dir
        self._folder = bag_dir / REQUESTS_FOLDER
        self.request = SaveRequest(uuid.uuid4().hex, label, start, end, asked)

    def post(self) -> None:
        """Writes the request.

        Raises:
            OSError: it cannot be written.
        """
        directories.make(self._bag_dir, self._folder)
        write_durably(self._path("json"), json.dumps(self.request.to_json()), mode=READABLE)

    def outcome(self) -> Outcome | None:
        """Returns the outcome; None while there is none."""
        with suppress(OSError, ValueError):
            return parsed(_OUTCOME, read_small_file(self._path("answer")), FORMAT)
        return None

    def withdraw(self) -> bool:
        """Withdraws the request; False where the recorder has begun with it, or answered."""
        try:
            self._path("json").unlink()
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Deletes the answer."""
        with suppress(OSError):
            self._path("answer").unlink(missing_ok=True)

    def _path(self, suffix: str) -> Path:
        return self._folder / f"{self.request.number}.{suffix}"


class RequestQueue:
    """All requests, for the recorder. Not for several threads at once."""

    def __init__(self, bag_dir: Path) -> None:
        self._bag_dir = bag_dir
        self._folder = bag_dir / REQUESTS_FOLDER
        self._foreign = 0
        self._ignored: set[str] = set()

    def open(self) -> None:
        """Makes the folder, so that the server needs access to nothing else. Raises nothing."""
        with suppress(OSError):
            directories.make(self._bag_dir, self._folder)

    def has_requests(self) -> bool:
        """Returns whether there are requests."""
        try:
            with directories.opened(self._bag_dir, self._folder) as descriptor:
                names = os.listdir(descriptor)  # noqa: PTH208 - a descriptor has no path
        except OSError:
            return False
        return any(self._is_request(name) for name in names)

    def take(self, now: Ns) -> Iterator[SaveRequest]:
        """Yields requests, those begun earlier first; invalid ones are logged and deleted.

        Raises:
            OSError: the folder cannot be listed, or written to.
        """
        names = sorted(path.name for path in self._folder.iterdir())
        self._report_foreign(names)
        requests = [name for name in names if self._is_request(name)]
        requests.sort(key=lambda name: not name.endswith(".taken"))
        for name in requests[:MAX_AT_ONCE]:
            request = self._take(name, now)
            if request is not None:
                yield request
        self._delete_left_over(names, now)

    def answer(self, request: SaveRequest, outcome: Outcome) -> None:
        """Writes the outcome of a request, and removes the request.

        Raises:
            OSError: it cannot be written.
        """
        text = json.dumps({"format": FORMAT, **asdict(outcome)})
        write_durably(self._folder / f"{request.number}.answer", text, mode=READABLE)
        self._delete(request.number)

    def _take(self, name: str, now: Ns) -> SaveRequest | None:
        number = name.partition(".")[0]
        path = self._folder / f"{number}.taken"
        try:
            if not name.endswith(".taken"):
                (self._folder / name).rename(path)
            return _read_request(path, number, now)
        except FileNotFoundError:
            return None  # withdrawn
        except (OSError, ValueError) as error:
            self._ignored.add(path.name)
            _log.warning("request_ignored", path=str(path), reason=str(error))
            self._delete(number)
            return None

    def _delete(self, number: str) -> None:
        with suppress(OSError):
            (self._folder / f"{number}.taken").unlink()

    def _is_request(self, name: str) -> bool:
        """Returns whether a file is a request by its name, and was not found to be invalid."""
        return name not in self._ignored and _REQUEST_NAME.fullmatch(name) is not None

    def _report_foreign(self, names: list[str]) -> None:
        foreign = sum(_OWN_NAME.fullmatch(name) is None for name in names)
        if foreign > self._foreign:
            _log.warning("requests_foreign", folder=str(self._folder), files=foreign)
        self._foreign = foreign

    def _delete_left_over(self, names: list[str], now: Ns) -> None:
        """Deletes answers that were never fetched, and unfinished files."""
        for name in names:
            if _OWN_NAME.fullmatch(name) and name.endswith((".answer", ".tmp")):
                with suppress(OSError):
                    path = self._folder / name
                    if abs(now - path.lstat().st_mtime_ns) > _KEEP_ANSWER_NS:
                        path.unlink()


def _read_request(path: Path, number: str, now: Ns) -> SaveRequest:
    """Returns the request in a file.

    Raises:
        OSError: it cannot be read.
        ValueError: it is invalid, or too old.
    """
    if path.lstat().st_size > MAX_REQUEST_BYTES:
        raise ValueError(f"it is larger than {MAX_REQUEST_BYTES} bytes")
    request = parsed(REQUEST, read_small_file(path), FORMAT)
    if request.number != number:
        raise ValueError("it has the number of another")
    if abs(now - request.asked) > STALE_NS:
        raise ValueError("its time is too long ago, or in the future")
    return request
