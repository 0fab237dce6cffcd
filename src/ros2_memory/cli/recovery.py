"""`ros2-memory recover`: repairs bags that were left open, by hand.

What a recorder does by itself when it starts, for any MCAP file that was cut short: one that
another recorder wrote, a copy on a laptop, one that is too large for a recorder to wait for.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.hard_links import HardLinks
from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.layout import METADATA_FILE
from ros2_memory.bootstrap import build_repairer
from ros2_memory.core import directories
from ros2_memory.core.errors import BagError, BagVanishedError, RecorderError
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import NS_PER_S, Ns, WallClock, unix_from_ns
from ros2_memory.index.scan import Tree
from ros2_memory.retention.repair import open_files

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TextIO

    from ros2_memory.core.timebase import Clock
    from ros2_memory.retention.repair import Repaired

STILL_NS: Final[Ns] = 30 * NS_PER_S
"""A file that changed since may be being written, by something that does not tell."""

_MCAP: Final = ".mcap"
_BAR: Final = 30


@dataclass(slots=True)
class Outcome:
    """What became of the files."""

    whole: int = 0
    repaired: int = 0
    removed: int = 0
    failed: int = 0
    messages: int = 0

    def __str__(self) -> str:
        """One line for people."""
        return (
            f"MCAP files: {self.whole} whole, {self.repaired} repaired "
            f"({counted(self.messages, 'message')}), "
            f"{self.removed} empty and removed, {self.failed} not repaired"
        )


def recover(
    path: Path,
    say: Callable[[str], None],
    *,
    force: bool = False,
    stream: TextIO | None = None,
    clock: Clock | None = None,
) -> Outcome:
    """Repairs one file, or every MCAP file below a directory.

    Args:
        path: the file or directory.
        say: is told a line for each file that was not whole, and one at the end.
        force: repairs also what changed a moment ago.
        stream: where a progress bar is shown, if it is a terminal (stderr).
        clock: the wall clock.

    Raises:
        RecorderError: there is no such file or directory.
    """
    clock = clock or WallClock()
    files, others = _files(path, clock)
    recovery = _Recovery(path, _Bar(stream or sys.stderr, files), say, clock, force=force)
    for file in files:
        recovery.take(file)
    recovery.correct_metadata()
    for folder in recovery.without_metadata():
        say(f"{folder} has no {METADATA_FILE}: `ros2 bag reindex {folder}` makes one")
    if others:
        left = counted(others, "bag file of another kind was", "bag files of other kinds were")
        say(f"{left} left alone: only MCAP files are repaired")
    say(str(recovery.outcome))
    return recovery.outcome


class _Recovery:
    """Takes one file after the other."""

    def __init__(
        self, root: Path, bar: _Bar, say: Callable[[str], None], clock: Clock, *, force: bool
    ) -> None:
        self._root = root
        self._bar = bar
        self._say = say
        self._clock = clock
        self._force = force
        self._repairer = build_repairer()
        self._held = open_files()
        self._folders: set[Path] = set()
        self.outcome = Outcome()

    def take(self, file: Path) -> None:
        """Repairs a file, if it must be and may be."""
        name = str(file) if file == self._root else str(file.relative_to(self._root))
        self._bar.begin(name)
        line = self._line(file)
        self._bar.end(file)
        if line is not None:
            self._say(f"{name}: {line}")

    def correct_metadata(self) -> None:
        """Writes metadata.yaml anew where a file of the recording was repaired or removed."""
        for folder in sorted(self._folders):
            path = folder / METADATA_FILE
            try:
                if self._repairer.correct_metadata(folder):
                    self._say(f"{path}: written anew, with what the files hold")
            except BagError as error:
                self._say(f"{path} NOT CORRECTED: {error.path}: {error.reason}")
            except (OSError, ValueError) as error:
                self._say(f"{path} NOT CORRECTED: {error}")

    def without_metadata(self) -> list[Path]:
        """Directories with a repaired bag whose recorder never wrote what stands in them."""
        return [folder for folder in sorted(self._folders) if _lacks_metadata(folder)]

    def _line(self, file: Path) -> str | None:
        outcome = self.outcome
        try:
            if self._repairer.is_whole(file):
                outcome.whole += 1
                return None if file != self._root else "whole already: there is nothing to repair"
            self._require_left(file)
            repaired = self._repairer.repair(file, self._bar.show)
        except BagVanishedError:
            outcome.failed += 1
            return "NOT REPAIRED: it is not there any more"
        except BagError as error:
            outcome.failed += 1
            return f"NOT REPAIRED: {error.reason}"
        if repaired is None or repaired.rewritten is None:
            outcome.removed += 1
            self._folders.add(file.parent)
            return "empty, removed"
        outcome.repaired += 1
        outcome.messages += repaired.rewritten.messages
        self._folders.add(file.parent)
        return _told(repaired)

    def _require_left(self, file: Path) -> None:
        """Refuses a file that may be being written.

        Raises:
            BagError: it may, and why.
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
        if (status.st_dev, status.st_ino) in self._held:
            raise BagError(str(file), "a process has it open; end that first")
        age = now - status.st_mtime_ns
        if abs(age) < STILL_NS and not self._force:
            since = f"{unix_from_ns(abs(age)):.0f} s ago"
            reason = f"it changed {since}; if nothing writes it any more, try again with --force"
            raise BagError(str(file), reason)


class _Bar:
    """A progress bar over the bytes of some files; shown on a terminal only."""

    def __init__(self, stream: TextIO, files: list[Path]) -> None:
        self._stream = stream
        self._on = stream.isatty()
        self._sizes = {file: _size(file) for file in files}
        self._total = max(sum(self._sizes.values()), 1)
        self._done = 0
        self._name = ""
        self._shown = ""

    def begin(self, name: str) -> None:
        """A file is looked at."""
        self._name = name
        self.show(0)

    def show(self, read: int) -> None:
        """So many bytes of the file have been read."""
        share = min((self._done + read) / self._total, 1.0)
        text = f"[{'#' * round(share * _BAR):<{_BAR}}] {share:4.0%} {self._name}"
        if self._on and text != self._shown:
            self._stream.write(f"\r\x1b[K{text}")
            self._stream.flush()
            self._shown = text

    def end(self, file: Path) -> None:
        """The file is done with; the line is free for others."""
        self._done += self._sizes.get(file, 0)
        if self._shown:
            self._stream.write("\r\x1b[K")
            self._stream.flush()
            self._shown = ""


def _files(path: Path, clock: Clock) -> tuple[list[Path], int]:
    """The MCAP files to look at, and how many bags of other kinds lie there.

    Raises:
        RecorderError: there is nothing of that name, it lies behind a symbolic link, or it cannot
            be listed.
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
    walked = Tree(path).walk(clock.now(), ())
    if walked.problem is not None:
        raise RecorderError(f"{path} cannot be listed: {walked.problem}")
    # What a moment keeps is a second name of a bag that was whole.
    kept = HardLinks(path)
    found = sorted(Path(each) for each in walked.looked_at if not kept.is_saved(each))
    files = [file for file in found if file.suffix == _MCAP]
    return files, len(found) - len(files)


def _told(repaired: Repaired) -> str:
    rewritten = repaired.rewritten
    if rewritten is None:
        return "empty, removed"
    notes = f"; {'; '.join(rewritten.notes)}" if rewritten.notes else ""
    return (
        f"repaired: {counted(rewritten.messages, 'message')}, "
        f"{counted(rewritten.lost_bytes, 'byte')} lost "
        f"({repaired.was_bytes} bytes before, {repaired.is_bytes} now){notes}"
    )


def _lacks_metadata(folder: Path) -> bool:
    """Whether MCAP files lie in a folder, and no metadata.yaml, or an empty one."""
    return any(folder.glob(f"*{_MCAP}")) and not _size(folder / METADATA_FILE)


def _size(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:
        return 0
