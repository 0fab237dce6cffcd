"""`ros2-memory recover`: repairs MCAP files that were left unfinished.

A recorder does the same when it starts. The command is for files that it does not repair: those
that another recorder wrote, copies on a laptop, files so large that a recorder would start late.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Final

import typer

from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.layout import LIST_FILE, METADATA_FILE
from ros2_memory.bag_dir.moment_file import HardLinks
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bootstrap import build_repairer
from ros2_memory.cli.options import AsJson
from ros2_memory.cli.output import print_json, print_line, spinner
from ros2_memory.core import directories
from ros2_memory.core.errors import BagError, BagVanishedError, InvalidArgumentsError, RecorderError
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import NS_PER_S, Clock, Ns, WallClock, unix_from_ns
from ros2_memory.index.scan import Tree
from ros2_memory.retention.delete import size_of
from ros2_memory.retention.repair import Repairer, open_files

RECENT_NS: Final[Ns] = 30 * NS_PER_S
"""A file that changed so lately may be being written by a program that is not known here."""

_MCAP: Final = ".mcap"


def recover(
    path: Annotated[
        Path, typer.Argument(metavar="PATH", help="An MCAP file, or a folder of recordings.")
    ],
    force: Annotated[
        bool, "Also repair files that changed in the last 30 s. Make sure nothing writes them."
    ] = False,
    yes: Annotated[bool, "Do not ask where another program made the recording."] = False,
    as_json: AsJson = False,
) -> bool:
    """Repair MCAP files that a crash, a full disk or a power cut left unfinished.

    Rewrites each file in place from everything that can be read of it, and keeps the original until
    the new file has been read back and is on the disk. Removes MCAP files of 0 bytes. Then writes
    or corrects the metadata.yaml of the recordings that it changed.

    Asks first, where another program made the recording.
    """

    def confirm(folders: Sequence[Path]) -> None:
        if others := [] if yes else [*filter(is_foreign, folders)]:
            if as_json:
                raise InvalidArgumentsError("--json asks nothing: give --yes, too")
            why = "was not made by this recorder" if len(others) == 1 else "were not made by it"
            typer.confirm(f"{listed([*map(str, others)])} {why}. Change this?", abort=True)

    outcome = recover_files(path, force=force, confirm=confirm)
    if as_json:
        print_json(asdict(outcome))
    else:
        print_line("\n".join(outcome.lines))
    return outcome.failed > 0


@dataclass(slots=True)
class RecoveryOutcome:
    """How many files were whole, repaired, removed or not repaired; and a line on each change."""

    whole: int = 0
    repaired: int = 0
    removed: int = 0
    failed: int = 0
    messages: int = 0
    lines: list[str] = field(default_factory=list, compare=False)

    def refuse(self, name: str, error: BagError) -> None:
        """Counts a file that is not repaired."""
        self.failed += 1
        self.lines.append(f"{name}: NOT REPAIRED: {error.reason}")

    def summary(self) -> str:
        """Returns one line for people."""
        return (
            f"MCAP files: {self.whole} whole, {self.repaired} repaired "
            f"({counted(self.messages, 'message')}), "
            f"{self.removed} empty and removed, {self.failed} not repaired"
        )


def recover_files(
    path: Path,
    *,
    force: bool = False,
    confirm: Callable[[Sequence[Path]], None] = lambda _: None,
    clock: Clock | None = None,
) -> RecoveryOutcome:
    """Repairs one file, or every MCAP file below a directory.

    `force`: also what changed in the last half minute. `confirm` is shown the folders in which
    files will change; it raises where they must not.

    Raises:
        RecorderError: there is no such file or directory.
    """
    clock = clock or WallClock()
    files, others = _files_below(path, clock)
    repairer, opened, done = build_repairer(), open_files(), RecoveryOutcome()
    names = {file: str(file if file == path else file.relative_to(path)) for file in files}
    unfinished: list[Path] = []
    for file in files:
        try:
            if repairer.is_whole(file):
                done.whole += 1
            else:
                _require_unused(file, clock.now(), opened, force=force)
                unfinished.append(file)
        except BagError as error:
            done.refuse(names[file], error)
    folders = sorted({file.parent for file in unfinished})
    confirm(folders)
    with spinner("repairing") as show:
        for nth, file in enumerate(unfinished, start=1):
            show(f"repairing {names[file]} ({nth} of {len(unfinished)})")
            try:
                done.lines.append(f"{names[file]}: {_repair(file, repairer, done)}")
            except BagError as error:
                done.refuse(names[file], error)
    done.lines += filter(None, (_correct_metadata(folder, repairer) for folder in folders))
    if others:
        left = counted(others, "bag file of another kind was", "bag files of other kinds were")
        done.lines.append(f"{left} left alone: only MCAP files are repaired")
    done.lines.append(done.summary())
    return done


def _repair(file: Path, repairer: Repairer, done: RecoveryOutcome) -> str:
    """Repairs one file, and returns what was done.

    Raises:
        BagError: it cannot be repaired.
    """
    size, repaired = size_of(file), repairer.repair(file)
    rewritten = None if repaired is None else repaired.rewritten
    if rewritten is None:
        done.removed += 1
        return "empty, removed"
    done.repaired += 1
    done.messages += rewritten.messages
    return (
        f"repaired: {counted(rewritten.messages, 'message')}, {rewritten.describe_loss()} "
        f"({size} bytes before, {size_of(file)} now)"
        f"{''.join(f'; {note}' for note in rewritten.notes)}"
    )


def is_foreign(folder: Path) -> bool:
    """Returns whether a folder is in no recorder's list of its recordings."""
    path = folder.resolve()
    listing = next((root for root in path.parents if (root / LIST_FILE).exists()), None)
    return listing is None or not OwnRecordings(listing).owns(path)


def _correct_metadata(folder: Path, repairer: Repairer) -> str | None:
    """Makes metadata.yaml describe the files of the recording; returns what was done."""
    path = folder / METADATA_FILE
    existed = size_of(path) > 0
    try:
        if repairer.correct_metadata(folder):
            return f"{path}: {'rewritten' if existed else 'written'} to match the files"
    except (BagError, OSError, ValueError) as error:
        return f"{path} NOT CORRECTED: {error}"
    if existed or not any(folder.glob(f"*{_MCAP}")):
        return None
    return (
        f"{folder} has no {METADATA_FILE}, and none is written, since its files are not named "
        f"after it as {folder.name}_0{_MCAP}: `ros2 bag reindex {folder}` makes one"
    )


def _require_unused(
    file: Path, now: Ns, opened: Collection[tuple[int, int]], *, force: bool
) -> None:
    """Checks that nothing writes a file, as far as that can be known.

    Raises:
        BagError: something does or may write it, or its name is not that of an MCAP file.
        BagVanishedError: it is gone.
    """
    for folder in file.absolute().parents:
        heartbeat = read_heartbeat(folder).heartbeat
        if heartbeat is None or not heartbeat.is_live(now):
            continue
        if any(file.absolute().is_relative_to(folder / name) for name in heartbeat.recordings):
            reason = f"the recorder (process {heartbeat.pid}) is writing it; stop that first"
            raise BagError(str(file), reason)
    try:
        status = file.lstat()
    except OSError as error:
        raise BagVanishedError(str(file), "it is not there any more") from error
    if not status.st_size and file.suffix != _MCAP:
        raise BagError(str(file), f"it is empty, and its name does not end in {_MCAP}")
    if (status.st_dev, status.st_ino) in opened:
        raise BagError(str(file), "a process has it open; end that first")
    age = now - status.st_mtime_ns
    if abs(age) < RECENT_NS and not force:
        since = f"{unix_from_ns(abs(age)):.0f} s ago"
        reason = f"it changed {since}; if nothing writes it any more, try again with --force"
        raise BagError(str(file), reason)


def _files_below(path: Path, clock: Clock) -> tuple[list[Path], int]:
    """Returns the MCAP files to look at, and how many bags of other kinds are beside them.

    Raises:
        RecorderError: the path does not exist, is behind a symbolic link, or cannot be listed.
    """
    link = directories.link_in(path)
    if link is not None:
        raise RecorderError(
            f"{path}: {link} is a symbolic link, and nothing behind one is repaired; "
            f"give the path itself: {path.resolve()}"
        )
    if path.is_file():
        return [path], 0
    if not path.is_dir():
        raise RecorderError(f"{path}: there is no such file or directory")
    walked = Tree(path).scan(clock.now(), ())
    if walked.problem is not None:
        raise RecorderError(f"{path} cannot be listed: {walked.problem}")
    # A saved moment has hard links to bags, which were whole when it was saved.
    links = HardLinks(path)
    bags = sorted(Path(name) for name in walked.stamps if not links.is_saved(name))
    files = [bag for bag in bags if bag.suffix == _MCAP]
    return files, len(bags) - len(files)
