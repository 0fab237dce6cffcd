"""Saved moments: a request to save a span of time, and `moment.json` in the moment's folder.

The bags of a saved moment are hard links. Retention may delete the paths where they were recorded;
their content stays until somebody deletes the moment's folder. A bag lies under the path that it
has in the bag directory (`rec_A/rec_A_7.mcap`), beside a link to the sidecar of its recording.

`moment.json` exists before the first link. It is marked as `pending` while bags of the moment are
still being written, so that a restarted recorder continues it.

The query server sends requests to the recorder as files in `.episodic/requests`, the one folder of
the bag directory that the server writes to:

    <number>.json      a request, written atomically by the server
    <number>.taken     the request after the recorder has begun with it
    <number>.answer    its outcome; the server reads and deletes it

A request that is still `.json` can be withdrawn, and then has no effect. The recorder trusts no
file here: a program that can write here can only make requests.
"""

from __future__ import annotations

import json
import os
import re
import unicodedata
import uuid
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple, TypeAlias

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, StrictBool, TypeAdapter

from ros2_memory.bag_dir.durable_write import read_small_file, write_durably
from ros2_memory.bag_dir.json_files import READABLE, Count, parsed
from ros2_memory.bag_dir.layout import (
    MOMENT_FILE,
    MOMENTS_FOLDER,
    REQUESTS_FOLDER,
    bag_kind,
    utc_stamp,
)
from ros2_memory.core import directories
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.text import encodable
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Ns

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path


_log = get_logger(__name__)

FORMAT: Final = 1
MAX_LABEL_CHARS: Final = 120
MAX_MOMENTS: Final = 1000
"""No operator looks through more, and every scan lists the folder of each."""
_MAX_SLUG_CHARS: Final = 40
_INVISIBLE: Final = frozenset({"Cc", "Cf", "Co", "Cs", "Cn", "Zl", "Zp"})
"""Unicode categories of line ends, directions, surrogates and other control characters."""


def fault_of_label(label: str) -> str | None:
    """Returns what is wrong with a label, as "is ..." or "has ..."; None if it is valid."""
    if not label.strip():
        return "is empty"
    if len(label) > MAX_LABEL_CHARS:
        return f"is longer than {MAX_LABEL_CHARS} characters"
    if any(unicodedata.category(char) in _INVISIBLE for char in label):
        return "has characters that cannot be seen, such as line ends"
    return None


def _checked_label(label: str) -> str:
    if fault_of_label(label):
        raise ValueError("it must be a text of one line")
    return label


_Number: TypeAlias = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]
_Label: TypeAlias = Annotated[str, AfterValidator(_checked_label)]
_Time: TypeAlias = Annotated[int, Field(strict=True, gt=MIN_NS, lt=MAX_NS)]
_KEYS: Final = {"number": "request", "start": "start_ns", "end": "end_ns", "asked": "requested_ns"}


@dataclass(frozen=True, slots=True)
class SaveRequest:
    """A request to save the messages from `start` to `end` (log times, inclusive).

    `number` is a random id, `asked` the wall time of the request.
    """

    __pydantic_config__ = ConfigDict(
        alias_generator=lambda name: _KEYS.get(name, name), defer_build=True
    )

    number: _Number
    label: _Label
    start: _Time
    end: _Time
    asked: _Time

    def to_json(self) -> dict[str, object]:
        """Returns the keys of a request, which `moment.json` has as well."""
        return {"format": FORMAT, **REQUEST.dump_python(self, by_alias=True)}


def _checked_request(request: SaveRequest) -> SaveRequest:
    if request.end < request.start:
        raise ValueError("end_ns must not be before start_ns")
    return request


_Request: TypeAlias = Annotated[SaveRequest, AfterValidator(_checked_request)]
REQUEST: Final[TypeAdapter[SaveRequest]] = TypeAdapter(_Request)


@dataclass(frozen=True, slots=True)
class SavedMoment:
    """The content of `moment.json`; by default nothing is saved yet.

    Attributes:
        pending: whether the moment waits for bags that are still being written.
        missing: sentences on parts that were not saved.
        rule: the rule that asked for the moment; None if somebody requested it.
        matches: how often the rule fired in it.
    """

    __pydantic_config__ = ConfigDict(defer_build=True)

    request: _Request
    pending: StrictBool = True
    missing: tuple[str, ...] = ()
    rule: str | None = None
    matches: Count = 1


def _with_request(fields: dict[object, object]) -> dict[object, object]:
    return {**fields, "request": fields}  # the keys of both lie side by side in the file


_Moment: TypeAlias = Annotated[SavedMoment, BeforeValidator(_with_request)]
_MOMENT: Final[TypeAdapter[SavedMoment]] = TypeAdapter(_Moment)


class StoredMoment(NamedTuple):
    """A saved moment and its folder; `files` has the sizes of its bags (bytes) by inode."""

    folder: Path
    moment: SavedMoment
    files: Mapping[int, int]


class UnreadableMoment(NamedTuple):
    """A folder whose `moment.json` cannot be read, and why; `files` as in a `StoredMoment`."""

    folder: Path
    problem: str
    files: Mapping[int, int]


class StoredMoments(NamedTuple):
    """The saved moments by the names of their folders, sorted; and those that cannot be read."""

    readable: dict[str, StoredMoment]
    unreadable: dict[str, UnreadableMoment]


def folder_name(request: SaveRequest) -> str:
    """Returns the name of a moment's folder: the time of the request (UTC) and its label."""
    ascii_label = unicodedata.normalize("NFKD", request.label).encode("ascii", "ignore").decode()
    words = re.findall(r"[a-z0-9]+", ascii_label.lower())
    slug = "-".join(words)[:_MAX_SLUG_CHARS].strip("-") or "moment"
    return f"{utc_stamp(request.asked)}-{slug}"


def make_moment_folder(bag_dir: Path, request: SaveRequest) -> Path:
    """Makes a folder for a moment, with a number if its name is taken.

    Raises:
        OSError: the folder cannot be made.
    """
    moments = bag_dir / MOMENTS_FOLDER
    if moments.is_symlink():
        raise OSError(f"{moments} is a symbolic link, which is not followed: remove it")
    moments.mkdir(exist_ok=True)
    name = folder_name(request)
    for number in range(1, MAX_MOMENTS + 2):
        folder = moments / (name if number == 1 else f"{name}_{number}")
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise OSError(f"{moments / name} and every number behind it is taken")


def write_saved_moment(folder: Path, moment: SavedMoment) -> None:
    """Replaces a moment's file atomically and flushes it.

    Raises:
        OSError: the file cannot be written.
    """
    content = {
        **moment.request.to_json(),
        "pending": moment.pending,
        "complete": not (moment.pending or moment.missing),
        "missing": list(moment.missing),
    }
    if moment.rule is not None:
        content |= {"rule": moment.rule, "matches": moment.matches}
    text = encodable(json.dumps(content, indent=1, ensure_ascii=False)) + "\n"
    write_durably(folder / MOMENT_FILE, text)


def read_saved_moment(folder: Path) -> SavedMoment | None:
    """Returns the moment of a folder; None if it has no `moment.json`.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is damaged.
    """
    try:
        text = read_small_file(folder / MOMENT_FILE)
    except (FileNotFoundError, NotADirectoryError):
        return None
    return parsed(_MOMENT, text, FORMAT)


def stored_moments_in(bag_dir: Path) -> StoredMoments:
    """Returns the saved moments.

    Raises:
        OSError: the folder of the moments cannot be listed.
    """
    stored = StoredMoments({}, {})
    moments = bag_dir / MOMENTS_FOLDER
    try:
        folders = [] if moments.is_symlink() else sorted(moments.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return stored
    for folder in folders:
        try:
            moment = None if folder.is_symlink() else read_saved_moment(folder)
        except (OSError, ValueError) as error:
            problem = (error.strerror if isinstance(error, OSError) else None) or str(error)
            unreadable = UnreadableMoment(folder, problem, _bag_sizes(folder))
            stored.unreadable[folder.name] = unreadable
        else:
            if moment is not None:
                stored.readable[folder.name] = StoredMoment(folder, moment, _bag_sizes(folder))
    return stored


def _bag_sizes(folder: Path) -> dict[int, int]:
    """Returns the sizes of the bags below a folder (bytes), by inode."""
    sizes: dict[int, int] = {}
    for _, entries in directories.walk(folder):
        for entry in entries:
            if bag_kind(entry.name):
                with suppress(FileNotFoundError):
                    status = entry.stat(follow_symlinks=False)
                    sizes[status.st_ino] = status.st_size
    return sizes


# Requests.

MAX_AT_ONCE: Final = 16
"""The recorder takes so many requests in one turn; the next turn comes a second later."""
MAX_REQUEST_BYTES: Final = 4096
STALE_NS: Final[Ns] = 60 * NS_PER_S
"""An older request is refused: its server died before it could withdraw it."""
_KEEP_ANSWER_NS: Final[Ns] = 600 * NS_PER_S
_REQUEST_NAME: Final = re.compile(r"[0-9a-f]{32}\.(json|taken)")
_OWN_NAME: Final = re.compile(r"\.?[0-9a-f]{32}\.(json|taken|answer)(\.tmp)?")


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a request: the folder of its moment, or why it was refused.

    `pending`: whether bags of the moment are still being written.
    """

    __pydantic_config__ = ConfigDict(defer_build=True)

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
            OSError: the request cannot be written.
        """
        directories.make(self._bag_dir, self._folder)
        write_durably(self._path("json"), json.dumps(self.request.to_json()), mode=READABLE)

    def outcome(self) -> Outcome | None:
        """Returns the outcome; None before the recorder has answered."""
        with suppress(OSError, ValueError):
            return parsed(_OUTCOME, read_small_file(self._path("answer")), FORMAT)
        return None

    def withdraw(self) -> bool:
        """Withdraws the request.

        Returns False if it cannot be withdrawn, mostly because the recorder has begun with it.
        """
        with suppress(OSError):
            self._path("json").unlink()
            return True
        return False

    def close(self) -> None:
        """Deletes the answer."""
        with suppress(OSError):
            self._path("answer").unlink(missing_ok=True)

    def _path(self, suffix: str) -> Path:
        return self._folder / f"{self.request.number}.{suffix}"


class RequestQueue:
    """All requests to the recorder. Not for several threads at once."""

    def __init__(self, bag_dir: Path) -> None:
        self._bag_dir = bag_dir
        self._folder = bag_dir / REQUESTS_FOLDER
        self._ignored: set[str] = set()

    def open(self) -> None:
        """Makes the folder: the server needs write access to no other. Raises nothing."""
        with suppress(OSError):
            directories.make(self._bag_dir, self._folder)

    def has_requests(self) -> bool:
        """Whether there are requests."""
        try:
            with directories.opened(self._bag_dir, self._folder) as descriptor:
                names = os.listdir(descriptor)  # noqa: PTH208 - a descriptor has no path
        except OSError:
            return False
        return any(self._is_request(name) for name in names)

    def take(self, now: Ns) -> Iterator[SaveRequest]:
        """Yields requests; those that the recorder began before come first.

        Requests that are invalid or cannot be read are logged, and refused in their answer.

        Raises:
            OSError: the folder cannot be listed, or written to.
        """
        names = sorted(path.name for path in self._folder.iterdir())
        requests = [name for name in names if self._is_request(name)]
        requests.sort(key=lambda name: not name.endswith(".taken"))
        for name in requests[:MAX_AT_ONCE]:
            request = self._claim(name, now)
            if request is not None:
                yield request
        self._delete_left_over(names, now)

    def _claim(self, name: str, now: Ns) -> SaveRequest | None:
        number = name.partition(".")[0]
        path = self._folder / f"{number}.taken"
        try:
            if not name.endswith(".taken"):
                (self._folder / name).rename(path)
            return _read_request(path, number, now)
        except FileNotFoundError:
            return None  # withdrawn
        except (OSError, ValueError) as error:
            self._ignored |= {name, path.name}
            _log.warning("request_ignored", path=str(path), reason=str(error))
            refused = f"the recorder cannot read the request: {error}"
            with suppress(OSError):
                self.answer(number, Outcome(refused=refused))
            return None

    def answer(self, number: str, outcome: Outcome) -> None:
        """Writes the outcome of a request, and removes the request.

        Raises:
            OSError: the outcome cannot be written.
        """
        text = json.dumps({"format": FORMAT, **asdict(outcome)})
        write_durably(self._folder / f"{number}.answer", text, mode=READABLE)
        with suppress(OSError):
            (self._folder / f"{number}.taken").unlink()

    def _is_request(self, name: str) -> bool:
        """Whether a file has the name of a request, and was not refused before."""
        return name not in self._ignored and _REQUEST_NAME.fullmatch(name) is not None

    def _delete_left_over(self, names: list[str], now: Ns) -> None:
        """Deletes old answers that no server fetched, and unfinished files."""
        for name in names:
            path = self._folder / name
            is_left_over = _OWN_NAME.fullmatch(name) and name.endswith((".answer", ".tmp"))
            with suppress(OSError):
                if is_left_over and abs(now - path.lstat().st_mtime_ns) > _KEEP_ANSWER_NS:
                    path.unlink()


def _read_request(path: Path, number: str, now: Ns) -> SaveRequest:
    """Returns the request in a file.

    Raises:
        OSError: the file cannot be read.
        ValueError: the request is invalid, or too old.
    """
    if path.lstat().st_size > MAX_REQUEST_BYTES:
        raise ValueError(f"it is larger than {MAX_REQUEST_BYTES} bytes")
    request = parsed(REQUEST, read_small_file(path), FORMAT)
    if request.number != number:
        raise ValueError("it has the number of another")
    if abs(now - request.asked) > STALE_NS:
        raise ValueError("its time is too long ago, or in the future")
    return request
