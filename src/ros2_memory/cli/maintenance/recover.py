"""`ros2-memory recover`: repairs MCAP files that were left unfinished.

A recorder does the same when it starts. The command is for files that it does not repair: those
that another recorder wrote, copies on a laptop, files so large that a recorder would start late.
"""

from collections.abc import Collection
from dataclasses import KW_ONLY, asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Final

import typer

from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.layout import LIST_FILE, METADATA_FILE
from ros2_memory.bag_dir.metadata_yaml import is_named_by_rosbag2
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
    dry_run: Annotated[bool, "Show what would be changed, and change nothing."] = False,
    as_json: AsJson = False,
) -> bool:
    """Repair MCAP files that a crash, a full disk or a power cut left unfinished.

    Rewrites each file in place from everything that can be read of it, and keeps the original until
    the new file has been read back and is on the disk. Removes MCAP files of 0 bytes. Then writes
    or corrects the metadata.yaml of the recordings that it changed.

    Shows what it would change and asks first, where another program made the recording.
    """
    if not (yes or dry_run):
        planned = recover_files(path, force=force, dry_run=True)
        if others := [*filter(is_foreign, sorted(planned.changed))]:
            if as_json:
                raise InvalidArgumentsError("--json asks nothing: give --yes or --dry-run, too")
            print_line("\n".join(planned.lines))
            why = "was not made by this recorder" if len(others) == 1 else "were not made by it"
            typer.confirm(f"{listed([*map(str, others)])} {why}. Change this?", abort=True)
    outcome = recover_files(path, force=force, dry_run=dry_run)
    if as_json:
        shown = asdict(outcome)
        del shown["changed"]
        print_json(shown)
    else:
        print_line("\n".join(outcome.lines))
    return outcome.failed > 0


@dataclass(slots=True)
class RecoveryOutcome:
    """How many files were whole, repaired, removed or not repaired; and a line on each change.

    `changed` holds the folders in which a file was repaired or removed.
    """

    whole: int = 0
    repaired: int = 0
    removed: int = 0
    failed: int = 0
    messages: int = 0
    lines: list[str] = field(default_factory=list, compare=False)
    changed: set[Path] = field(default_factory=set, compare=False)

    def summary(self, *, dry_run: bool) -> str:
        """Returns one line for people."""
        if dry_run:
            return (
                f"nothing was changed: of the MCAP files {self.whole} are whole, {self.repaired} "
                f"would be repaired, {self.removed} removed, and {self.failed} not repaired"
            )
        return (
            f"MCAP files: {self.whole} whole, {self.repaired} repaired "
            f"({counted(self.messages, 'message')}), "
            f"{self.removed} empty and removed, {self.failed} not repaired"
        )


def recover_files(
    path: Path, *, force: bool = False, dry_run: bool = False, clock: Clock | None = None
) -> RecoveryOutcome:
    """Repairs one file, or every MCAP file below a directory.

    Args:
        path: the file or directory.
        force: also repairs what changed in the last half minute.
        dry_run: changes nothing, and reports what would be changed.
        clock: the wall clock.

    Raises:
        RecorderError: there is no such file or directory.
    """
    clock = clock or WallClock()
    files, others = _files_below(path, clock)
    recovery = _Recovery(clock, build_repairer(), force=force, dry_run=dry_run)
    done = recovery.outcome
    with spinner("repairing") as show:
        for nth, file in enumerate(files, start=1):
            name = str(file if file == path else file.relative_to(path))
            show(f"repairing {name} ({nth} of {len(files)})")
            line = recovery.recover(file)
            if line is None and file == path:
                line = "whole already: there is nothing to repair"
            if line is not None:
                done.lines.append(f"{name}: {line}")
    done.lines += filter(None, map(recovery.correct_metadata, sorted(done.changed)))
    if others:
        left = counted(others, "bag file of another kind was", "bag files of other kinds were")
        done.lines.append(f"{left} left alone: only MCAP files are repaired")
    done.lines.append(done.summary(dry_run=dry_run))
    return done


def is_foreign(folder: Path) -> bool:
    """Returns whether a folder is in no recorder's list of its recordings."""
    path = folder.absolute()
    listing = next((root for root in path.parents if (root / LIST_FILE).exists()), None)
    return listing is None or not OwnRecordings(listing).owns(path)


@dataclass
class _Recovery:
    """Repairs one file after the other, and counts what became of them."""

    clock: Clock
    repairer: Repairer
    _: KW_ONLY
    force: bool
    dry_run: bool
    opened: Collection[tuple[int, int]] = field(default_factory=open_files)
    outcome: RecoveryOutcome = field(default_factory=RecoveryOutcome)

    def recover(self, file: Path) -> str | None:
        """Repairs a file, and returns what was done; None where it was whole."""
        outcome = self.outcome
        try:
            if self.repairer.is_whole(file):
                outcome.whole += 1
                return None
            self._require_unused(file)
            size = size_of(file)
            repaired = None if self.dry_run else self.repairer.repair(file)
        except BagVanishedError:
            outcome.failed += 1
            return "NOT REPAIRED: it is not there any more"
        except BagError as error:
            outcome.failed += 1
            return f"NOT REPAIRED: {error.reason}"
        rewritten = None if repaired is None else repaired.rewritten
        outcome.changed.add(file.parent)
        if rewritten is None and not (self.dry_run and size):
            outcome.removed += 1
            return f"empty, {'would be ' if self.dry_run else ''}removed"
        outcome.repaired += 1
        if rewritten is None:
            return f"would be repaired ({counted(size, 'byte')})"
        outcome.messages += rewritten.messages
        return (
            f"repaired: {counted(rewritten.messages, 'message')}, {rewritten.describe_loss()} "
            f"({size} bytes before, {size_of(file)} now)"
            f"{''.join(f'; {note}' for note in rewritten.notes)}"
        )

    def correct_metadata(self, folder: Path) -> str | None:
        """Makes metadata.yaml describe the files of the recording; returns what was done."""
        path = folder / METADATA_FILE
        existed = size_of(path) > 0
        if self.dry_run:
            verb = "corrected" if existed else "written"
            is_written = existed or is_named_by_rosbag2(folder)
            return f"{path}: would be {verb} to match the files" if is_written else None
        try:
            if self.repairer.correct_metadata(folder):
                return f"{path}: {'rewritten' if existed else 'written'} to match the files"
        except BagError as error:
            return f"{path} NOT CORRECTED: {error.path}: {error.reason}"
        except (OSError, ValueError) as error:
            return f"{path} NOT CORRECTED: {error}"
        if existed or not any(folder.glob(f"*{_MCAP}")):
            return None
        return (
            f"{folder} has no {METADATA_FILE}, and none is written, since its files are not named "
            f"after it as {folder.name}_0{_MCAP}: `ros2 bag reindex {folder}` makes one"
        )

    def _require_unused(self, file: Path) -> None:
        """Checks that nothing writes a file, as far as that can be known.

        Raises:
            BagError: something does or may write it, or its name is not that of an MCAP file.
            BagVanishedError: it is gone.
        """
        now = self.clock.now()
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
        if (status.st_dev, status.st_ino) in self.opened:
            raise BagError(str(file), "a process has it open; end that first")
        age = now - status.st_mtime_ns
        if abs(age) < RECENT_NS and not self.force:
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
