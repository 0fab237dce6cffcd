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
from ros2_memory.bag_dir.layout import LIST_FILE, METADATA_FILE, is_saved
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bootstrap import build_repairer
from ros2_memory.cli.options import AsJson
from ros2_memory.cli.output import print_json, print_line, spinner
from ros2_memory.core import directories
from ros2_memory.core.errors import BagError, BagVanishedError, InvalidArgumentsError, RecorderError
from ros2_memory.core.model import MCAP
from ros2_memory.core.text import counted, listed
from ros2_memory.core.timebase import NS_PER_S, Clock, Ns, WallClock, unix_from_ns
from ros2_memory.index.scan import Tree
from ros2_memory.retention.repair import Repaired, Repairer, open_files

RECENT_NS: Final[Ns] = 30 * NS_PER_S
"""An unknown program may still write a file that changed so lately."""


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
        foreign = [str(folder) for folder in folders if is_foreign(folder)]
        if yes or not foreign:
            return
        if as_json:
            raise InvalidArgumentsError("--json asks nothing: give --yes, too")
        why = "was not made by this recorder" if len(foreign) == 1 else "were not made by it"
        typer.confirm(f"{listed(foreign)} {why}. Change this?", abort=True)

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

    def add_failure(self, name: str, error: BagError) -> None:
        """Counts a file that is not repaired."""
        self.failed += 1
        self.lines.append(f"{name}: NOT REPAIRED: {error.reason}")

    def add_repair(self, name: str, repaired: Repaired | None) -> None:
        """Counts a file by what became of it; None: it was finished before its turn came."""
        if repaired is None:
            self.whole += 1
            return
        rewritten = repaired.rewritten
        notes = "".join(f"; {note}" for note in repaired.notes)
        if rewritten is None:
            self.removed += 1
            self.lines.append(f"{name}: empty, removed{notes}")
            return
        self.repaired += 1
        self.messages += rewritten.messages
        self.lines.append(
            f"{name}: repaired: {counted(rewritten.messages, 'message')}, "
            f"{rewritten.describe_loss()} "
            f"({repaired.was_bytes} bytes before, {repaired.is_bytes} now){notes}"
        )

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

    With `force` also files that changed in the last half minute. `confirm` is called with the
    folders in which files will change, and raises if they must not.

    Raises:
        RecorderError: there is no such file or directory.
    """
    clock = clock or WallClock()
    files = _files_below(path, clock)
    repairer, opened, outcome = build_repairer(), open_files(), RecoveryOutcome()
    names = {file: str(file if file == path else file.relative_to(path)) for file in files}
    unfinished: list[Path] = []
    for file in files:
        try:
            if repairer.is_whole(file):
                outcome.whole += 1
            else:
                _require_unused(file, clock.now(), opened, force=force)
                unfinished.append(file)
        except BagError as error:
            outcome.add_failure(names[file], error)
    folders = sorted({file.parent for file in unfinished})
    confirm(folders)
    with spinner("repairing") as show:
        for number, file in enumerate(unfinished, start=1):
            show(f"repairing {names[file]} ({number} of {len(unfinished)})")
            try:
                outcome.add_repair(names[file], repairer.repair(file))
            except BagError as error:
                outcome.add_failure(names[file], error)
    for folder in folders:
        if line := _correct_metadata(folder, repairer):
            outcome.lines.append(line)
    outcome.lines.append(outcome.summary())
    return outcome


def is_foreign(folder: Path) -> bool:
    """Returns whether no recorder has listed a recording as its own."""
    path = folder.resolve()
    bag_dir = next((parent for parent in path.parents if (parent / LIST_FILE).exists()), None)
    return bag_dir is None or not OwnRecordings(bag_dir).owns(path)


def _correct_metadata(folder: Path, repairer: Repairer) -> str | None:
    """Makes metadata.yaml describe the files of a recording; returns a line if something is new."""
    path = folder / METADATA_FILE
    try:
        return f"{path}: made to match the files" if repairer.correct_metadata(folder) else None
    except (BagError, OSError, ValueError) as error:
        return f"{path} NOT CORRECTED: {error}"


def _require_unused(
    file: Path, now: Ns, opened: Collection[tuple[int, int]], *, force: bool
) -> None:
    """Checks that nothing writes a file, as far as that can be known.

    `opened` has the device and inode of each file that a process has open.

    Raises:
        BagError: a process writes it, or may; or it is empty and its name is not that of MCAP.
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
    if not status.st_size and file.suffix != MCAP:
        raise BagError(str(file), f"it is empty, and its name does not end in {MCAP}")
    if (status.st_dev, status.st_ino) in opened:
        raise BagError(str(file), "a process has it open; end that first")
    age = now - status.st_mtime_ns
    if abs(age) < RECENT_NS and not force:
        since = f"{unix_from_ns(abs(age)):.0f} s ago"
        reason = f"it changed {since}; if nothing writes it any more, try again with --force"
        raise BagError(str(file), reason)


def _files_below(path: Path, clock: Clock) -> list[Path]:
    """Returns the MCAP files at or below a path.

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
        return [path]
    if not path.is_dir():
        raise RecorderError(f"{path}: there is no such file or directory")
    tree = Tree(path).scan(clock.now(), ())
    if tree.problem is not None:
        raise RecorderError(f"{path} cannot be listed: {tree.problem}")
    # A saved moment has hard links to bags, which were whole when it was saved.
    bags = (Path(name) for name in tree.stamps if not is_saved(path, name))
    return sorted(bag for bag in bags if bag.suffix == MCAP)
