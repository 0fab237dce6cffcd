"""`ros2-memory adopt`: lists recordings of other programs as the recorder's own."""

import os
from pathlib import Path
from typing import Annotated

import typer

from ros2_memory.bag_dir.layout import bags_in, is_kept_apart
from ros2_memory.bag_dir.lock import BagDirLock
from ros2_memory.bag_dir.own_recordings import OwnRecordings, folders_with_bags, is_regular
from ros2_memory.cli.options import MB, AsJson, BagDir, Sets, load_for, require_recorder
from ros2_memory.cli.output import print_json, print_line
from ros2_memory.core.directories import identity_of
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
    settings, _ = load_for(bag_dir, sets)
    require_recorder(settings)
    root = settings.recording.bag_dir
    own = OwnRecordings(root)
    given = [_below(root, directory) for directory in directories]
    bags_by_name = {
        name: [*filter(is_regular, bags_in(path))]
        for directory in given
        for path in folders_with_bags(directory)
        if (name := own.name_of(path))
    }
    if not own.exists():  # as the recorder does when it starts
        lock = BagDirLock.acquire(root, patience_s=0.0)
        try:
            own.claim()
        finally:
            lock.release()
    new = {name: bags for name, bags in bags_by_name.items() if not all(map(own.owns_bag, bags))}
    identities = {name: identity_of(root / name) for name in new}
    for name, identity in identities.items():
        if identity is None:
            raise RecorderError(f"{root / name} is not there any more")
    own.adopt({name: identity for name, identity in identities.items() if identity})
    adopted = [(name, len(bags), sum(map(size_of, bags)) / MB) for name, bags in new.items()]
    already = len(bags_by_name) - len(new)
    if as_json:
        keys = ("directory", "bags", "size_mb")
        rows = [dict(zip(keys, row, strict=True)) for row in adopted]
        print_json({"adopted": rows, "already": already})
        return not bags_by_name
    for name, files, size_mb in adopted:
        print_line(f"adopted: {name} ({counted(files, 'bag file')}, {size_mb:.1f} MB)")
    if already:
        folders = counted(already, "directory is", "directories are")
        print_line(f"{folders} the recorder's own already")
    if not all(map(is_kept_apart, new)):
        print_line("retention deletes them from now on, by its limits, oldest first")
    if not bags_by_name:
        print_line(
            "there are no bag files: links are not followed, so move or mount the bags there"
        )
    return not bags_by_name


def _below(root: Path, directory: Path) -> Path:
    """Returns a directory, given by its path or its name in the bag directory, as a path below it.

    Raises:
        InvalidArgumentsError: it is not a directory below the bag directory, or behind a link.
    """
    base = Path(os.path.abspath(root))  # noqa: PTH100 - `resolve` would follow links
    for given in (directory, root / directory):
        path = Path(os.path.abspath(given))  # noqa: PTH100 - as above
        if not path.is_dir() or not path.is_relative_to(base):
            continue
        inside = root / path.relative_to(base)
        # The bag directory itself may be a link.
        parts = [part for part in (inside, *inside.parents) if part.is_relative_to(root)]
        link = next((part for part in parts if part != root and part.is_symlink()), None)
        if link is not None:
            raise InvalidArgumentsError(f"{link} is a symbolic link, which is not followed")
        return inside
    raise InvalidArgumentsError(
        f"{directory} is not a directory below {root}: move the bags there, then adopt them"
    )
