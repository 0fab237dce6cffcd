"""What is asked of the recorder to keep, and what it keeps: `moment.json` in a moment's folder.

A moment is a span of time with a label. Its bags are hard links: retention may delete where they
were recorded, and what they hold stays until somebody deletes the moment's folder. Each stands
under the name that it has in the bag directory (`rec_A/rec_A_7.mcap`), beside a link to the sidecar
of its recording.

`moment.json` is there before the first link. While bags of the moment are still being written it
says `pending`, so whatever stops the recorder, the next one goes on with it.
"""

from __future__ import annotations

import json
import re
import unicodedata
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.durable_write import read_small_file, write_durably
from ros2_memory.bag_dir.layout import MOMENT_FILE, MOMENTS_FOLDER, bag_kind
from ros2_memory.core import directories
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from ros2_memory.core.timebase import Ns

FORMAT: Final = 1
LONGEST_LABEL: Final = 120
MOST_MOMENTS: Final = 1000
"""More than an operator would look through, and each is a folder that every look lists."""
_LONGEST_SLUG: Final = 40
_UNSEEN: Final = frozenset({"Cc", "Cf", "Co", "Cs", "Cn", "Zl", "Zp"})
"""Unicode's categories of what controls text or is none: line ends, directions, half characters."""


class SaveRequest(NamedTuple):
    """What is asked for: to keep what was recorded from `start` to `end` (inclusive)."""

    number: str
    label: str
    start: Ns
    end: Ns
    asked: Ns


@dataclass(frozen=True, slots=True)
class SavedMoment:
    """A moment, as its file says.

    `number` is that of the wish. `pending`: it waits for bags that are still being written.
    `missing` are sentences on what of it is not kept.
    """

    number: str
    label: str
    start: Ns
    end: Ns
    asked: Ns
    pending: bool = True
    missing: tuple[str, ...] = ()

    @classmethod
    def of(cls, wish: SaveRequest) -> SavedMoment:
        """A moment of which nothing is kept yet."""
        return cls(*wish)


class StoredMoment(NamedTuple):
    """A moment in its folder; `files` are its bags' links: by inode their sizes."""

    folder: Path
    keepsake: SavedMoment
    files: Mapping[int, int]


def fault_of_label(label: str) -> str | None:
    """What is wrong with a label: `is ...`; None where nothing is."""
    if not label.strip():
        return "is empty"
    if len(label) > LONGEST_LABEL:
        return f"is longer than {LONGEST_LABEL} characters"
    if any(unicodedata.category(char) in _UNSEEN for char in label):
        return "has characters that cannot be seen, such as line ends"
    return None


def folder_name(wish: SaveRequest) -> str:
    """What a moment's folder is called: when it was asked for (UTC), and its label in ASCII."""
    plain = unicodedata.normalize("NFKD", wish.label).encode("ascii", "ignore").decode().lower()
    slug = "-".join(re.findall(r"[a-z0-9]+", plain))[:_LONGEST_SLUG].strip("-") or "moment"
    return f"{datetime.fromtimestamp(wish.asked // NS_PER_S, tz=UTC):%Y%m%dT%H%M%SZ}-{slug}"


def make_folder(bag_dir: Path, wish: SaveRequest) -> Path:
    """A new folder for a moment, with a number behind its name where that is taken.

    Raises:
        OSError: it cannot be made.
    """
    moments = moments_of(bag_dir)
    if moments.is_symlink():
        raise OSError(f"{moments} is a symbolic link, which is not followed: remove it")
    moments.mkdir(exist_ok=True)
    name = folder_name(wish)
    for number in range(1, MOST_MOMENTS + 2):
        folder = moments / (name if number == 1 else f"{name}_{number}")
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise OSError(f"{moments / name} and every number behind it is taken")


def moments_of(bag_dir: Path) -> Path:
    """The folder of the moments."""
    return bag_dir / MOMENTS_FOLDER


def write_saved_moment(folder: Path, keepsake: SavedMoment) -> None:
    """Replaces a moment's file at once, and has it on the disk.

    Raises:
        OSError: it cannot be written.
    """
    content = {
        "format": FORMAT,
        "request": keepsake.number,
        "label": keepsake.label,
        "start_ns": keepsake.start,
        "end_ns": keepsake.end,
        "requested_ns": keepsake.asked,
        "pending": keepsake.pending,
        "complete": not (keepsake.pending or keepsake.missing),
        "missing": list(keepsake.missing),
    }
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    write_durably(folder / MOMENT_FILE, text)


def read_saved_moment(folder: Path) -> SavedMoment | None:
    """What a moment's file says; None where there is none, or it says something else."""
    try:
        fields = json_object(read_small_file(folder / MOMENT_FILE))
        wish = save_request_from(fields)
        pending, missing = fields.get("pending"), fields.get("missing")
        if not isinstance(pending, bool) or not isinstance(missing, list):
            return None
        return SavedMoment(*wish, pending, tuple(str(each) for each in missing))
    except (OSError, ValueError, RecursionError):
        return None


def stored_moments_in(bag_dir: Path) -> Iterator[StoredMoment]:
    """The moments that are kept, in the order of their folders' names.

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
        keepsake = None if folder.is_symlink() else read_saved_moment(folder)
        if keepsake is not None:
            yield StoredMoment(folder, keepsake, _files_in(folder))


def json_object(text: str) -> dict[object, object]:
    """The object that a JSON text says, of a format that is known.

    Raises:
        ValueError: it says none.
    """
    value: object = json.loads(text)
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise ValueError(f"it is no JSON object of format {FORMAT}")
    return value


def save_request_from(fields: Mapping[object, object]) -> SaveRequest:
    """The wish in an object.

    Raises:
        ValueError: it is none.
    """
    number, label = fields.get("request"), fields.get("label")
    if not isinstance(number, str) or not re.fullmatch(r"[0-9a-f]{32}", number):
        raise ValueError("request must be 32 hexadecimal digits")
    if not isinstance(label, str) or fault_of_label(label):
        raise ValueError("label must be a text of one line")
    start, end, asked = (_moment(fields, f"{key}_ns") for key in ("start", "end", "requested"))
    if end < start:
        raise ValueError("end_ns must not be before start_ns")
    return SaveRequest(number, label, start, end, asked)


def _moment(fields: Mapping[object, object], key: str) -> Ns:
    value = fields.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not MIN_NS < value < MAX_NS:
        raise ValueError(f"{key} must be nanoseconds")
    return value


def _files_in(folder: Path) -> dict[int, int]:
    """The bags below a moment's folder, by inode, with their sizes."""
    files: dict[int, int] = {}
    for _, entries in directories.walk(folder):
        for entry in entries:
            if bag_kind(entry.name) and not entry.name.startswith("."):
                with suppress(FileNotFoundError):
                    status = entry.stat(follow_symlinks=False)
                    files[status.st_ino] = status.st_size
    return files
