"""`ros2-memory adopt`: takes recordings that another program made for the recorder's own."""

import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Annotated

import typer

from ros2_memory.bag_dir.directory_identity import Identity, identity_of
from ros2_memory.bag_dir.layout import bag_kind, is_kept_apart
from ros2_memory.bag_dir.lock import BagDirLock
from ros2_memory.bag_dir.own_recordings import OwnRecordings, folders_with_bags, is_regular
from ros2_memory.bootstrap import claim
from ros2_memory.cli.options import (
    EXIT_NEGATIVE,
    BagDir,
    Sets,
    load_for,
    print_line,
    reported_errors,
)
from ros2_memory.config import NullRecorderNode
from ros2_memory.core.errors import (
    ConfigError,
    InvalidArgumentsError,
    RecorderError,
)
from ros2_memory.core.text import counted

_MB = 1_000_000
_NAMED = 5
_INSTEAD = "move or mount the bags into the bag directory"


def adopt(
    directories: Annotated[
        list[Path],
        typer.Argument(metavar="DIR", help="Directories of bags, in the bag directory."),
    ],
    sets: Sets = None,
    bag_dir: BagDir = None,
) -> None:
    """Let the recorder delete bags that it did not make, as if it had made them.

    Takes the bags in each directory and below it: copies, restored recordings, those of other
    programs. From then on retention counts them in its budget and deletes them by its limits, and
    `forget` deletes them too. Nothing is deleted or changed here.
    """
    with reported_errors("adopt"):
        settings = load_for(bag_dir, sets)
        if isinstance(settings.recorder, NullRecorderNode):
            raise ConfigError(
                "recorder=none: nothing is deleted here, so there is nothing to adopt; choose the "
                "deployment that records here, such as deployment=robot"
            )
        root = settings.recording.bag_dir
        own = OwnRecordings(root)
        places = [_place(each, root) for each in directories]
        found = {name: path for each in places for name, path in _folders(each, own)}
        _require_list(root, own)
        new = {name: path for name, path in found.items() if not own.owns(path)}
        own.adopt({name: _identity(path) for name, path in new.items()})
    for name, path in new.items():
        files, size = _taken(path)
        print_line(f"adopted: {name} ({counted(files, 'bag file')}, {size / _MB:.1f} MB)")
    already = len(found) - len(new)
    if already:
        print_line(
            f"{counted(already, 'directory is', 'directories are')} the recorder's own already"
        )
    if new:
        print_line("retention deletes them from now on, by its limits, oldest first")
    if not found:
        print_line("no bag files lie there")
        for link in islice(_links(places), _NAMED):
            print_line(
                f"{link.relative_to(root)} is a symbolic link, which is not followed: {_INSTEAD}"
            )
        raise typer.Exit(EXIT_NEGATIVE)


def _place(directory: Path, root: Path) -> Path:
    """The directory to adopt, given by its path or by its name in the bag directory.

    Raises:
        InvalidArgumentsError: it is no directory below the bag directory.
    """
    for given in (directory, root / directory):
        place = Path(os.path.abspath(given))  # noqa: PTH100 - follows no link
        base = Path(os.path.abspath(root))  # noqa: PTH100
        if not place.is_dir() or not place.is_relative_to(base):
            continue
        inside = root / place.relative_to(base)
        link = next((each for each in (inside, *inside.parents) if _is_link(each, root)), None)
        if link is not None:
            raise InvalidArgumentsError(f"{link} is a symbolic link, which is not followed")
        return inside
    raise InvalidArgumentsError(
        f"{directory} is no directory below {root}: move the bags there, then adopt them"
    )


def _folders(place: Path, own: OwnRecordings) -> Iterator[tuple[str, Path]]:
    """By name the directories to adopt.

    Raises:
        OSError: one cannot be listed.
    """
    for path in folders_with_bags(place):
        name = own.name_of(path)
        if name and not is_kept_apart(name):
            yield name, path


def _links(places: Iterable[Path]) -> Iterator[Path]:
    """The links that might lead to bags."""
    for place in places:
        for folder, folders, files in os.walk(place):
            for name in sorted((*folders, *filter(bag_kind, files))):
                path = Path(folder, name)
                if path.is_symlink() and not name.startswith("."):
                    yield path


def _is_link(path: Path, root: Path) -> bool:
    return path != root and path.is_relative_to(root) and path.is_symlink()


def _require_list(root: Path, own: OwnRecordings) -> None:
    """Makes the list where there is none, as the recorder does before it records.

    Raises:
        RecorderError: a recorder of a version without a list records there, or it cannot be made.
    """
    if own.exists():
        return
    lock = BagDirLock.acquire(root, patience_s=0.0)
    try:
        claim(own)
    finally:
        lock.release()


def _identity(path: Path) -> Identity:
    identity = identity_of(path)
    if identity is None:
        raise RecorderError(f"{path} is not there any more")
    return identity


def _taken(folder: Path) -> tuple[int, int]:
    """How many bag files lie in a directory, and their bytes."""
    files = size = 0
    for path in folder.iterdir():
        if bag_kind(path.name):
            with suppress(OSError):
                if is_regular(path):
                    size += path.lstat().st_size
                    files += 1
    return files, size
