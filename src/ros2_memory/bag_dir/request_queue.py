"""How the query server asks the recorder for something, though they share only a directory.

In `.episodic/requests`, where the server may write and nowhere else in the bag directory:

    <number>.json      a wish, put there whole by the server
    <number>.taken     the same, when the recorder has begun with it
    <number>.answer    what came of it; the server reads and deletes it

A wish that is still `.json` can be withdrawn, and then nothing comes of it. The recorder trusts
nothing here: whoever can write here can only ask.
"""

from __future__ import annotations

import json
import os
import re
import uuid
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple

import structlog

from ros2_memory.bag_dir.durable_write import own_folder, read_small_file
from ros2_memory.bag_dir.layout import REQUESTS_FOLDER
from ros2_memory.bag_dir.moment_file import FORMAT, SaveRequest, json_object, save_request_from
from ros2_memory.core import directories
from ros2_memory.core.timebase import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from ros2_memory.core.timebase import Ns

MOST_AT_ONCE: Final = 16
"""Wishes that the recorder takes at one look; it looks again some moments later."""
LARGEST: Final = 4096
STALE_NS: Final[Ns] = 60 * NS_PER_S
"""A wish this old was not withdrawn because its server died."""
_LEFT_NS: Final[Ns] = 600 * NS_PER_S
_ANEW: Final = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC | os.O_NOFOLLOW
_WISH: Final = re.compile(r"[0-9a-f]{32}\.(json|taken)")
_OURS: Final = re.compile(r"\.?[0-9a-f]{32}\.(json|taken|answer)(\.tmp)?")

_log: structlog.typing.FilteringBoundLogger = structlog.get_logger(__name__)


class Outcome(NamedTuple):
    """What came of a wish: the name of its moment, or why it was refused.

    `pending`: bags of it are still being written.
    """

    moment: str | None = None
    bags: int = 0
    pending: bool = False
    refused: str | None = None


class PendingRequest:
    """The server's side: one wish and its answer."""

    def __init__(self, bag_dir: Path, label: str, start: Ns, end: Ns, asked: Ns) -> None:
        self._folder = requests_of(bag_dir)
        self.wish = SaveRequest(uuid.uuid4().hex, label, start, end, asked)

    def post(self) -> None:
        """Asks.

        Raises:
            OSError: it cannot be written.
        """
        _make(self._folder)
        _put(self._named("json"), _written(self.wish))

    def outcome(self) -> Outcome | None:
        """What came of it; None as long as nothing has."""
        try:
            return _outcome_from(json_object(read_small_file(self._named("answer"))))
        except (OSError, ValueError, RecursionError):
            return None

    def withdraw(self) -> bool:
        """Asks no more; False where the recorder has begun with it, or answered."""
        try:
            self._named("json").unlink()
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Leaves nothing behind of a wish that was answered."""
        with suppress(OSError):
            self._named("answer").unlink(missing_ok=True)

    def _named(self, kind: str) -> Path:
        return self._folder / f"{self.wish.number}.{kind}"


class RequestQueue:
    """The recorder's side. Not for several threads at once."""

    def __init__(self, bag_dir: Path) -> None:
        self._bag_dir = bag_dir
        self._folder = requests_of(bag_dir)
        self._foreign = 0
        self._ignored: set[str] = set()

    def open(self) -> None:
        """Makes the folder, so that a server may be let into it alone. Raises nothing."""
        with suppress(OSError):
            _make(self._folder)

    def has_mail(self) -> bool:
        """Whether there are wishes."""
        try:
            with directories.opened(self._bag_dir, self._folder) as opened:
                names = os.listdir(opened)  # noqa: PTH208 - a descriptor has no path
        except OSError:
            return False
        return any(name.endswith((".json", ".taken")) and self._counts(name) for name in names)

    def take(self, now: Ns) -> Iterator[SaveRequest]:
        """The wishes, those that were begun with before first; what is no wish is reported.

        Raises:
            OSError: the folder cannot be listed, or written to.
        """
        names = sorted(path.name for path in self._folder.iterdir())
        self._tell_foreign(names)
        begun = [name for name in names if name.endswith(".taken") and self._counts(name)]
        come = [name for name in names if name.endswith(".json") and self._counts(name)]
        for name in [*begun, *come][:MOST_AT_ONCE]:
            wish = self._taken(name, now)
            if wish is not None:
                yield wish
        self._sweep(names, now)

    def answer(self, wish: SaveRequest, outcome: Outcome) -> None:
        """Says what came of a wish, and is done with it.

        Raises:
            OSError: it cannot be written.
        """
        target = self._folder / f"{wish.number}.answer"
        _put(target, {"format": FORMAT, **outcome._asdict()})
        self._drop(wish.number)

    def _taken(self, name: str, now: Ns) -> SaveRequest | None:
        number = name.partition(".")[0]
        path = self._folder / f"{number}.taken"
        try:
            if not name.endswith(".taken"):
                (self._folder / name).rename(path)
            wish = _read_wish(path)
            fault = _fault_of(wish, number, now)
        except FileNotFoundError:
            return None  # withdrawn
        except (OSError, ValueError, RecursionError) as error:
            wish, fault = None, str(error)
        if fault is None:
            return wish
        self._ignored.add(f"{number}.taken")
        _log.warning("request_ignored", path=str(path), reason=fault)
        self._drop(number)
        return None

    def _drop(self, number: str) -> None:
        with suppress(OSError):
            (self._folder / f"{number}.taken").unlink()

    def _counts(self, name: str) -> bool:
        """Whether a file is a wish by its name, and has not been found to be none."""
        return name not in self._ignored and _WISH.fullmatch(name) is not None

    def _tell_foreign(self, names: list[str]) -> None:
        foreign = sum(_OURS.fullmatch(name) is None for name in names)
        if foreign > self._foreign:
            _log.warning("requests_foreign", folder=str(self._folder), files=foreign)
        self._foreign = foreign

    def _sweep(self, names: list[str], now: Ns) -> None:
        """Deletes answers that nobody fetched, and wishes that were never whole."""
        for name in names:
            if _OURS.fullmatch(name) and name.endswith((".answer", ".tmp")):
                with suppress(OSError):
                    path = self._folder / name
                    if abs(now - path.lstat().st_mtime_ns) > _LEFT_NS:
                        path.unlink()


def requests_of(bag_dir: Path) -> Path:
    """The folder of the wishes."""
    return bag_dir / REQUESTS_FOLDER


def _make(folder: Path) -> None:
    """Makes the folder, and none above the bag directory: that may be on a disk that is away."""
    own_folder(folder.parent)
    own_folder(folder)


def _put(target: Path, content: Mapping[str, object]) -> None:
    """Writes a file that is there whole or not at all, and that another user may read.

    Raises:
        OSError: it cannot be written.
    """
    beside = target.with_name(f".{target.name}.tmp")
    try:
        with os.fdopen(os.open(beside, _ANEW, 0o644), "w", encoding="utf-8") as stream:
            os.fchmod(stream.fileno(), 0o644)
            json.dump(content, stream)
        beside.rename(target)
    except OSError:
        with suppress(OSError):
            beside.unlink(missing_ok=True)
        raise


def _read_wish(path: Path) -> SaveRequest:
    if path.lstat().st_size > LARGEST:
        raise ValueError(f"it is larger than {LARGEST} bytes")
    return save_request_from(json_object(read_small_file(path)))


def _fault_of(wish: SaveRequest, number: str, now: Ns) -> str | None:
    if wish.number != number:
        return "it has the number of another"
    if abs(now - wish.asked) > STALE_NS:
        return "it was asked for too long ago, or in the future"
    return None


def _written(wish: SaveRequest) -> dict[str, object]:
    return {
        "format": FORMAT,
        "request": wish.number,
        "label": wish.label,
        "start_ns": wish.start,
        "end_ns": wish.end,
        "requested_ns": wish.asked,
    }


def _outcome_from(fields: dict[object, object]) -> Outcome:
    moment, refused = (fields.get(key) for key in ("moment", "refused"))
    bags = fields.get("bags")
    return Outcome(
        None if moment is None else str(moment),
        bags if isinstance(bags, int) else 0,
        fields.get("pending") is True,
        None if refused is None else str(refused),
    )
