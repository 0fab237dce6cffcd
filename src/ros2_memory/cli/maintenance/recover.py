"""`ros2-memory recover`: repairs MCAP files that were left unfinished.

A recorder does the same when it starts. The command is for files that it does not repair: those
that another recorder wrote, copies on a laptop, files so large that a recorder would start late.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import accumulate
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
from ros2_memory.cli.output import print_json, print_line, progress_bar
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
    if not (yes or dry_run) and (others := foreign_unfinished(path)):
        if as_json:
            raise InvalidArgumentsError("--json asks nothing: give --yes or --dry-run, too")
        recover_files(path, print_line, force=force, dry_run=True)
        why = "was not made by this recorder" if len(others) == 1 else "were not made by it"
        typer.confirm(f"{listed([*map(str, others)])} {why}. Change this?", abort=True)
    lines: list[str] = []
    report = lines.append if as_json else print_line
    outcome = recover_files(path, report, force=force, dry_run=dry_run)
    if as_json:
        print_json({**asdict(outcome), "lines": lines[:-1]})
    return outcome.failed > 0


@dataclass(slots=True)
class RecoveryOutcome:
    """How many files were whole, repaired, removed or not repaired."""

    whole: int = 0
    repaired: int = 0
    removed: int = 0
    failed: int = 0
    messages: int = 0

    def __str__(self) -> str:
        """Returns one line for people."""
        return (
            f"MCAP files: {self.whole} whole, {self.repaired} repaired "
            f"({counted(self.messages, 'message')}), "
            f"{self.removed} empty and removed, {self.failed} not repaired"
        )


def recover_files(
    path: Path,
    report: Callable[[str], None],
    *,
    force: bool = False,
    dry_run: bool = False,
    clock: Clock | None = None,
) -> RecoveryOutcome:
    """Repairs one file, or every MCAP file below a directory.

    Args:
        path: the file or directory.
        report: takes a line for each file that was not whole, and one at the end.
        force: also repairs what changed in the last half minute.
        dry_run: changes nothing, and reports what would be changed.
        clock: the wall clock.

    Raises:
        RecorderError: there is no such file or directory.
    """
    clock = clock or WallClock()
    files, others = _files_below(path, clock)
    sizes = [size_of(file) for file in files]
    recovery = _Recovery(clock, force, build_repairer(), dry_run=dry_run)
    with progress_bar() as bar:
        task = bar.add_task("", total=max(sum(sizes), 1))
        for file, done in zip(files, accumulate(sizes, initial=0), strict=False):
            name = str(file if file == path else file.relative_to(path))
            bar.update(task, completed=done, description=name)

            def show(read: int, done: int = done) -> None:
                bar.update(task, completed=done + read)

            line = recovery.recover(file, show)
            if line is None and file == path:
                line = "whole already: there is nothing to repair"
            if line is not None:
                bar.stop()  # or the line would be printed into the bar
                report(f"{name}: {line}")
                bar.start()
    for folder in sorted(recovery.changed):
        if line := recovery.correct_metadata(folder):
            report(line)
    if others:
        left = counted(others, "bag file of another kind was", "bag files of other kinds were")
        report(f"{left} left alone: only MCAP files are repaired")
    seen = recovery.outcome
    report(
        f"nothing was changed: of the MCAP files {seen.whole} are whole, {seen.repaired} would "
        f"be repaired, {seen.removed} removed, and {seen.failed} not repaired"
        if dry_run
        else str(seen)
    )
    return seen


def foreign_unfinished(path: Path) -> tuple[Path, ...]:
    """Returns the folders with files to repair that are in no recorder's list of its recordings.

    Raises:
        RecorderError: there is no such file or directory.
    """
    repairer, unfinished = build_repairer(), set[Path]()
    for file in _files_below(path, WallClock())[0]:
        with suppress(BagError):
            if file.parent not in unfinished and not repairer.is_whole(file):
                unfinished.add(file.parent)
    foreign: list[Path] = []
    for folder in sorted(unfinished):
        above = folder.absolute().parents
        listing = next((root for root in above if (root / LIST_FILE).exists()), None)
        if listing is None or not OwnRecordings(listing).owns(folder.absolute()):
            foreign.append(folder)
    return tuple(foreign)


class _Recovery:
    """Repairs one file after the other, and counts what became of them.

    `changed` holds the folders in which a file was repaired or removed.
    """

    def __init__(self, clock: Clock, force: bool, repairer: Repairer, *, dry_run: bool) -> None:
        self._clock = clock
        self._dry_run = dry_run
        self._force = force
        self._repairer = repairer
        self._open_files = open_files()
        self.outcome = RecoveryOutcome()
        self.changed: set[Path] = set()

    def recover(self, file: Path, on_read: Callable[[int], None]) -> str | None:
        """Repairs a file, and returns what was done; None where it was whole."""
        outcome = self.outcome
        try:
            if self._repairer.is_whole(file):
                outcome.whole += 1
                return None
            self._require_unused(file)
            size = size_of(file)
            rewritten = None
            if not self._dry_run and (repaired := self._repairer.repair(file, on_read)):
                rewritten = repaired.rewritten
        except BagVanishedError:
            outcome.failed += 1
            return "NOT REPAIRED: it is not there any more"
        except BagError as error:
            outcome.failed += 1
            return f"NOT REPAIRED: {error.reason}"
        self.changed.add(file.parent)
        if rewritten is None and not (self._dry_run and size):
            outcome.removed += 1
            return f"empty, {'would be ' if self._dry_run else ''}removed"
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
        if self._dry_run:
            verb = "corrected" if existed else "written"
            is_written = existed or is_named_by_rosbag2(folder)
            return f"{path}: would be {verb} to match the files" if is_written else None
        try:
            if self._repairer.correct_metadata(folder):
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
        now = self._clock.now()
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
        if (status.st_dev, status.st_ino) in self._open_files:
            raise BagError(str(file), "a process has it open; end that first")
        age = now - status.st_mtime_ns
        if abs(age) < RECENT_NS and not self._force:
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
