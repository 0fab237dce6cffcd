"""Saved moments: a request to save a span of time, and `moment.json` in the moment's folder.

The bags of a saved moment are hard links: retention may delete the paths where they were recorded,
and their content stays until somebody deletes the moment's folder. Each lies under the path that it
has in the bag directory (`rec_A/rec_A_7.mcap`), beside a link to the sidecar of its recording.

`moment.json` exists before the first link. While bags of the moment are still being written it is
marked as `pending`, so that a restarted recorder continues it.
"""

from __future__ import annotations

import json
import re
import unicodedata
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple, TypeAlias

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, StrictBool, TypeAdapter

from ros2_memory.bag_dir.durable_write import read_small_file, write_durably
from ros2_memory.bag_dir.json_files import Count, parsed
from ros2_memory.bag_dir.layout import MOMENT_FILE, MOMENTS_FOLDER, bag_kind, utc_stamp
from ros2_memory.core import directories
from ros2_memory.core.timebase import MAX_NS, MIN_NS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path


FORMAT: Final = 1
MAX_LABEL_CHARS: Final = 120
MAX_MOMENTS: Final = 1000
"""More than an operator would look through, and each is a folder that every scan lists."""
_MAX_SLUG_CHARS: Final = 40
_INVISIBLE: Final = frozenset({"Cc", "Cf", "Co", "Cs", "Cn", "Zl", "Zp"})
"""Unicode categories of line ends, directions, surrogates and other controls."""


def fault_of_label(label: str) -> str | None:
    """Returns what is wrong with a label, as `is ...`; None where it is valid."""
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
    """A request to save what was recorded from `start` to `end` (log times, inclusive).

    `number` is its random id, `asked` the wall clock time of the request.
    """

    __pydantic_config__ = ConfigDict(alias_generator=lambda name: _KEYS.get(name, name))

    number: _Number
    label: _Label
    start: _Time
    end: _Time
    asked: _Time

    def to_json(self) -> dict[str, object]:
        """Returns the request as both kinds of file hold it."""
        return {"format": FORMAT, **REQUEST.dump_python(self, by_alias=True)}


def _checked_request(request: SaveRequest) -> SaveRequest:
    if request.end < request.start:
        raise ValueError("end_ns must not be before start_ns")
    return request


_Request: TypeAlias = Annotated[SaveRequest, AfterValidator(_checked_request)]
REQUEST: Final[TypeAdapter[SaveRequest]] = TypeAdapter(_Request)


@dataclass(frozen=True, slots=True)
class SavedMoment:
    """A moment as its file describes it.

    `pending`: it waits for bags that are still being written. `missing` are sentences on parts that
    were not saved. By default nothing is saved yet. `rule` is the rule that asked for it, and
    `matches` how often that fired in it; None for a moment that was requested.
    """

    request: _Request
    pending: StrictBool = True
    missing: tuple[str, ...] = ()
    rule: str | None = None
    matches: Count = 1


def _with_request(fields: dict[object, object]) -> dict[object, object]:
    return {**fields, "request": fields}  # whose keys lie among those of the moment


_Moment: TypeAlias = Annotated[SavedMoment, BeforeValidator(_with_request)]
_MOMENT: Final[TypeAdapter[SavedMoment]] = TypeAdapter(_Moment)


class StoredMoment(NamedTuple):
    """A saved moment and its folder; `files` are the sizes of its bags by inode."""

    folder: Path
    moment: SavedMoment
    files: Mapping[int, int]


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
    if moment.rule is not None:
        content |= {"rule": moment.rule, "matches": moment.matches}
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    write_durably(folder / MOMENT_FILE, text)


def read_saved_moment(folder: Path) -> SavedMoment | None:
    """Returns the moment of a folder; None where there is no file, or no valid one."""
    with suppress(OSError, ValueError):
        return parsed(_MOMENT, read_small_file(folder / MOMENT_FILE), FORMAT)
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
