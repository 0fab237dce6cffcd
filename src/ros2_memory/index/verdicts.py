"""The verdicts on the files of a bag directory, and which of them count.

One bag may lie there in two forms, `x.mcap` and what it is compressed to, and under several names:
where it was recorded, and in the moments that keep it. Of all these one counts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ros2_memory.bag_dir.layout import COMPRESSED, other_form
from ros2_memory.index.file_state import FileState

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from ros2_memory.bag_dir.hard_links import HardLinks
    from ros2_memory.core.model import BagFile
    from ros2_memory.index.file_state import Classification, FileNotes, ScanContext
    from ros2_memory.index.unchanged_bags import UnchangedBags


class CountedBags:
    """The verdict on each file that is awake, by path. Not for several threads at once.

    `files`, `dormant` and `names` are what their owner knows of the same files; they are looked at.

    Attributes:
        counted: of all forms and names of a bag the one that answers.
        set_aside: those of `counted` that are not only bags.
        hidden: the other form answers for these, for the time being.
    """

    def __init__(
        self, files: Mapping[str, FileNotes], dormant: UnchangedBags, names: HardLinks
    ) -> None:
        self._files = files
        self._dormant = dormant
        self._names = names
        self._verdicts: dict[str, Classification] = {}
        self.counted: dict[str, Classification] = {}
        self.set_aside: dict[str, Classification] = {}
        self.hidden: set[str] = set()

    def give(self, path: str, verdict: Classification) -> bool:
        """Takes in a verdict; gives whether it is another one than before."""
        if verdict == self._verdicts.get(path):
            return False
        self._verdicts[path] = verdict
        return True

    def drop(self, path: str) -> bool:
        """Forgets the verdict on a file; gives whether there was one."""
        return self._verdicts.pop(path, None) is not None

    def wake(self, path: str, verdict: Classification) -> None:
        """Takes in the verdict on a file that was dormant, and counted."""
        self._verdicts[path] = self.counted[path] = verdict

    def recount(
        self, changed: Iterable[str], scene: ScanContext
    ) -> tuple[list[BagFile], list[BagFile]]:
        """Brings what counts up to date; gives the bags that left it and those that came."""
        removed, added = [], []
        forms = {form for each in changed for form in (each, other_form(each))}
        if self._names.known:
            forms.update(name for each in [*forms] for name in self._names.of(each))
        for path in forms:
            before, after = self.counted.pop(path, None), self._verdict_that_counts(path, scene)
            self.set_aside.pop(path, None)
            if after is not None:
                self.counted[path] = after
                if after.bag is None or after.aside is not None:
                    self.set_aside[path] = after
            if before == after:
                continue
            if before is not None and before.bag is not None:
                removed.append(before.bag)
            if after is not None and after.bag is not None:
                added.append(after.bag)
        return removed, added

    def _verdict_that_counts(self, path: str, scene: ScanContext) -> Classification | None:
        """The file's verdict; None where it is unknown, or its other form answers for it.

        While a split is compressed `x.mcap` and `x.mcap.zstd` both lie there: one bag, twice. Two
        whole ones that have lain there for three splits are two files that somebody keeps.
        """
        self.hidden.discard(path)
        if any(self._is_same_file(path, name) for name in self._names.before(path)):
            return None
        own, other = self._verdicts.get(path), self._verdicts.get(other_form(path))
        if own is None or other is None or own.standing > other.standing:
            return own
        kept = not self._being_compressed(path, scene)
        if kept and own.standing is FileState.UNREAD:
            return own
        if own.standing == other.standing and (
            (kept and own.standing is FileState.CLOSED) or not path.endswith(COMPRESSED)
        ):
            return own
        self.hidden.add(path)
        return None

    def _is_same_file(self, path: str, name: str) -> bool:
        """Whether a known file's other name is known, too, and means the same file."""
        notes = self._files.get(name)
        stamp = self._dormant.stamp(name) if notes is None else notes.stamp
        own = self._files.get(path)
        return (
            stamp is not None
            and own is not None
            and (own.stamp.size, own.stamp.mtime_ns, own.stamp.inode)
            == (stamp.size, stamp.mtime_ns, stamp.inode)
        )

    def _being_compressed(self, path: str, scene: ScanContext) -> bool:
        forms = [self._files[form] for form in (path, other_form(path)) if form in self._files]
        return any(notes.grew_lately(scene) for notes in forms)
