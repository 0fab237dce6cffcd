"""Saved moments: a request to save a span of time, and `moment.json` in the moment's folder.

The bags of a saved moment are hard links: retention may delete the paths where they were recorded,
and their content stays until somebody deletes the moment's folder. Each lies under the path that it
has in the bag directory (`rec_A/rec_A_7.mcap`), beside a link to the sidecar of its recording.

`moment.json` exists before the first link. While bags of the moment are still being written it says
`pending`, so that a restarted recorder goes on with it.
"""

from __future__ import annotations

import json
import re
import unicodedata
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.durable_write import read_small_file, write_durably
from ros2_memory.bag_dir.json_fields import integer, json_object
from ros2_memory.bag_dir.layout import MOMENT_FILE, MOMENTS_FOLDER, bag_kind, utc_stamp
from ros2_memory.core import directories
from ros2_memory.core.timebase import MAX_NS, MIN_NS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from ros2_memory.core.timebase import Ns

FORMAT: Final = 1
MAX_LABEL_CHARS: Final = 120
MAX_MOMENTS: Final = 1000
"""More than an operator would look through, and each is a folder that every scan lists."""
_MAX_SLUG_CHARS: Final = 40
_INVISIBLE: Final = frozenset({"Cc", "Cf", "Co", "Cs", "Cn", "Zl", "Zp"})
"""Unicode categories of line ends, directions, surrogates and other controls."""


class SaveRequest(NamedTuple):
    """A request to save what was recorded from `start` to `end` (log times, inclusive).

    `number` is its random id, `asked` the wall clock time of the request.
    """

    number: str
    label: str
    start: Ns
    end: Ns
    asked: Ns

    def to_json(self) -> dict[str, object]:
        """Returns the request as both kinds of file hold it."""
        return {
            "format": FORMAT,
            "request": self.number,
            "label": self.label,
            "start_ns": self.start,
            "end_ns": self.end,
            "requested_ns": self.asked,
        }


@dataclass(frozen=True, slots=True)
class SavedMoment:
    """A moment as its file describes it.

    `pending`: it waits for bags that are still being written. `missing` are sentences on parts that
    were not saved. By default nothing is saved yet.
    """

    request: SaveRequest
    pending: bool = True
    missing: tuple[str, ...] = ()


class StoredMoment(NamedTuple):
    """A saved moment and its folder; `files` are the sizes of its bags by inode."""

    folder: Path
    moment: SavedMoment
    files: Mapping[int, int]


def fault_of_label(label: str) -> str | None:
    """Returns what is wrong with a label, as `is ...`; None where it is valid."""
    if not label.strip():
        return "is empty"
    if len(label) > MAX_LABEL_CHARS:
        return f"is longer than {MAX_LABEL_CHARS} characters"
    if any(unicodedata.category(char) in _INVISIBLE for char in label):
        return "has characters that cannot be seen, such as line ends"
    return None


def folder_name(request: SaveRequest) -> str:
    """Returns the name of a moment's folder: the time of the request (UTC), and its label."""
    ascii_label = unicodedata.normalize("NFKD", request.label).encode("ascii", "ignore").decode()
    words = re.findall(r"[a-z0-9]+", ascii_label.lower())
    slug = "-".join(words)[:_MAX_SLUG_CHARS].strip("-") or "moment"
    return f"{utc_stamp(request.asked)}-{slug}"


def make_moment_folder(bag_dir: Path, request: SaveRequest) -> Path:
    """Makes a folder for a moment, numbered where its name is taken.

    Raises:
        OSError: it cannot be made.
    """
    moments = moments_of(bag_dir)
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


def moments_of(bag_dir: Path) -> Path:
    """Returns the folder of the saved moments."""
    return bag_dir / MOMENTS_FOLDER


def write_saved_moment(folder: Path, moment: SavedMoment) -> None:
    """Replaces a moment's file atomically and flushes it.

    Raises:
        OSError: it cannot be written.
    """
    content = {
        **moment.request.to_json(),
        "pending": moment.pending,
        "complete": not (moment.pending or moment.missing),
        "missing": list(moment.missing),
    }
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    write_durably(folder / MOMENT_FILE, text)


def read_saved_moment(folder: Path) -> SavedMoment | None:
    """Returns the moment of a folder; None where there is no file, or no valid one."""
    try:
        fields = json_object(read_small_file(folder / MOMENT_FILE), FORMAT)
        request = save_request_from(fields)
        pending, missing = fields.get("pending"), fields.get("missing")
        if not isinstance(pending, bool) or not isinstance(missing, list):
            return None
        return SavedMoment(request, pending, tuple(str(each) for each in missing))
    except (OSError, ValueError, RecursionError):
        return None


def stored_moments_in(bag_dir: Path) -> Iterator[StoredMoment]:
    """Yields the saved moments in the order of their folders' names.

    Raises:
        OSError: the folder of the moments cannot be listed.
    """
    moments = moments_of(bag_dir)
    if moments.is_symlink():
        return
    try:
        folders = sorted(moments.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return
    for folder in folders:
        moment = None if folder.is_symlink() else read_saved_moment(folder)
        if moment is not None:
            yield StoredMoment(folder, moment, _bag_sizes(folder))


def save_request_from(fields: Mapping[object, object]) -> SaveRequest:
    """Returns the request in an object.

    Raises:
        ValueError: a key is missing or wrong.
    """
    number, label = fields.get("request"), fields.get("label")
    if not isinstance(number, str) or not re.fullmatch(r"[0-9a-f]{32}", number):
        raise ValueError("request must be 32 hexadecimal digits")
    if not isinstance(label, str) or fault_of_label(label):
        raise ValueError("label must be a text of one line")
    start, end, asked = (
        integer(fields, f"{key}_ns", MIN_NS + 1, MAX_NS - 1)
        for key in ("start", "end", "requested")
    )
    if end < start:
        raise ValueError("end_ns must not be before start_ns")
    return SaveRequest(number, label, start, end, asked)


def _bag_sizes(folder: Path) -> dict[int, int]:
    """Returns the sizes of the bags below a folder, by inode."""
    sizes: dict[int, int] = {}
    for _, entries in directories.walk(folder):
        for entry in entries:
            if bag_kind(entry.name):
                with suppress(FileNotFoundError):
                    status = entry.stat(follow_symlinks=False)
                    sizes[status.st_ino] = status.st_size
    return sizes
