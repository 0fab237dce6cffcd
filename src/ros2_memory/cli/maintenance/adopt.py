"""`ros2-memory adopt`: lists recordings of other programs as the recorder's own."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from ros2_memory.bag_dir.layout import bags_in, is_kept_apart
from ros2_memory.bag_dir.lock import BagDirLock
from ros2_memory.bag_dir.own_recordings import OwnRecordings, folders_with_bags, is_regular
from ros2_memory.cli.options import MB, AsJson, BagDir, Sets, load_for, require_recorder
from ros2_memory.cli.output import print_json, print_line
from ros2_memory.core.directories import Identity, identity_of
from ros2_memory.core.errors import InvalidArgumentsError, RecorderError
from ros2_memory.core.text import counted
from ros2_memory.retention.delete import size_of


def adopt(
    directories: Annotated[
        list[Path], typer.Argument(metavar="DIR", help="Folders of bags, inside the bag directory.")
    ],
    sets: Sets = None,
    as_json: AsJson = False,
    bag_dir: BagDir = None,
) -> bool:
    """Let the recorder delete bags that it did not make, as if it had made them.

    Adopts the bags in each folder and below it: copies, restored recordings, bags of other
    programs. From then on retention counts them in its budget and deletes them by its limits, and
    `forget` deletes them too. adopt itself deletes and changes nothing.
    """
    settings = load_for(bag_dir, sets)
    require_recorder(settings)
    root = settings.recording.bag_dir
    own = OwnRecordings(root)
    bags_by_name: dict[str, list[Path]] = {}
    for directory in [_inside(root, directory) for directory in directories]:
        for folder in folders_with_bags(directory):
            if name := own.name_of(folder):
                bags_by_name[name] = [*filter(is_regular, bags_in(folder))]
    if not own.exists():  # as the recorder does when it starts
        lock = BagDirLock.acquire(root, patience_s=0.0)
        try:
            own.claim()
        finally:
            lock.release()
    adopted = _adopt_folders(root, own, bags_by_name)
    already = len(bags_by_name) - len(adopted)
    if as_json:
        print_json({"adopted": [row._asdict() for row in adopted], "already": already})
        return not bags_by_name
    for row in adopted:
        files = counted(row.bags, "bag file")
        print_line(f"adopted: {row.directory} ({files}, {row.size_mb:.1f} MB)")
    if already:
        folders = counted(already, "directory is", "directories are")
        print_line(f"{folders} the recorder's own already")
    if not all(is_kept_apart(row.directory) for row in adopted):
        print_line("retention deletes them from now on, by its limits, oldest first")
    if not bags_by_name:
        print_line(
            "there are no bag files: links are not followed, so move or mount the bags there"
        )
    return not bags_by_name


class _Adopted(NamedTuple):
    directory: str
    bags: int
    size_mb: float


def _adopt_folders(
    root: Path, own: OwnRecordings, bags_by_name: Mapping[str, Sequence[Path]]
) -> list[_Adopted]:
    """Adopts the folders with bags that are not the recorder's own yet, and returns them.

    Raises:
        RecorderError: a folder is gone; none is adopted then.
    """
    identities: dict[str, Identity] = {}
    adopted: list[_Adopted] = []
    for name, bags in bags_by_name.items():
        if all(map(own.owns_bag, bags)):
            continue
        identity = identity_of(root / name)
        if identity is None:
            raise RecorderError(f"{root / name} is not there any more")
        identities[name] = identity
        adopted.append(_Adopted(name, len(bags), sum(map(size_of, bags)) / MB))
    own.adopt(identities)
    return adopted


def _inside(root: Path, directory: Path) -> Path:
    """Returns the path of a directory inside the bag directory, without following links.

    `directory` is a path, or a name in the bag directory.

    Raises:
        InvalidArgumentsError: it is not a directory inside the bag directory, or behind a link.
    """
    base = Path(os.path.abspath(root))  # noqa: PTH100 - `resolve` would follow links
    for given in (directory, root / directory):
        path = Path(os.path.abspath(given))  # noqa: PTH100 - as above
        if not path.is_dir() or not path.is_relative_to(base):
            continue
        inside = root
        for name in path.relative_to(base).parts:  # the bag directory itself may be a link
            inside /= name
            if inside.is_symlink():
                raise InvalidArgumentsError(f"{inside} is a symbolic link, which is not followed")
        return inside
    raise InvalidArgumentsError(
        f"{directory} is not a directory below {root}: move the bags there, then adopt them"
    )
