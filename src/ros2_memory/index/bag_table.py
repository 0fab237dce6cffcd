"""Looks at a bag directory again and again, and judges what changed since the last look."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.hard_links import HardLinks
from ros2_memory.bag_dir.layout import other_form
from ros2_memory.core.errors import BagVanishedError
from ros2_memory.index.file_state import FileNotes, FileState, classify
from ros2_memory.index.scan import Tree
from ros2_memory.index.snapshot import Snapshot, Timeline
from ros2_memory.index.unchanged_bags import UnchangedBags
from ros2_memory.index.verdicts import CountedBags

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping

    from ros2_memory.core.model import BagFile, SetAside
    from ros2_memory.core.timebase import Ns
    from ros2_memory.index.file_state import Classification, KnownFile, ScanContext
    from ros2_memory.index.scan import Stamp, Walked
    from ros2_memory.storage.base import BagReader

PATROL: Final = 256
"""Closed files looked at in each scan, in turn: one overwritten in place changes no directory."""


@dataclass(frozen=True, slots=True)
class KnownBags:
    """What the index knows of the bag directory, by path.

    `counted` are the verdicts on bags, of two forms of one only that which answers; `hidden` are
    the other forms; `kept` are all files in moments, whether they answer or not. `named` are the
    recordings that the recorder last said it is writing.
    """

    counted: Mapping[str, Classification]
    hidden: Collection[str]
    files: Mapping[str, FileNotes]
    named: Collection[str]
    now: Ns
    kept: Collection[str] = ()


class TableChange(NamedTuple):
    """What a look found otherwise than the one before: the bags that left and those that came.

    `news`: whether anything is otherwise, be it no bag. With the first look everything is.
    """

    removed: list[BagFile]
    added: list[BagFile]
    news: bool


class _Oddities(NamedTuple):
    """What a walk finds besides files."""

    damaged: tuple[SetAside, ...] = ()
    links: tuple[SetAside, ...] = ()
    problem: str | None = None
    described: tuple[str, ...] = ()


class BagTable:
    """What is known of the files of one bag directory. Not for several threads at once.

    `known` tells, by path, of closed files that were read earlier: they are not read again while
    they look as they did. `all_awake`: no bag is kept dormant, since more is asked of it than its
    answers.
    """

    def __init__(
        self,
        bag_dir: Path,
        reader: BagReader,
        *,
        known: Callable[[], Mapping[str, KnownFile]] | None,
        all_awake: bool,
    ) -> None:
        self._reader = reader
        self._known = known
        self._all_awake = all_awake
        self._tree = Tree(bag_dir)
        self._dormant = UnchangedBags()
        self._files: dict[str, FileNotes] = {}
        self._names = HardLinks(bag_dir)
        self._verdicts = CountedBags(self._files, self._dormant, self._names)
        self._watched: set[str] = set()
        self._patrol: list[str] = []
        self._odd: _Oddities | None = None
        self._timeline = Timeline()

    def look(self, scene: ScanContext, *, patrolling: bool) -> TableChange:
        """Looks at what may have changed; `patrolling`: and at some of what lies still.

        Where it raises, some of what the walk has shown is lost: then a new survey has to begin.
        """
        patrol = self._next_on_patrol() if patrolling else ()
        walked = self._tree.walk(scene.now, [*self._watched, *patrol])
        self._rouse(walked, scene)
        known = self._known_at_first()
        recalled = self._recall(walked.looked_at, known, scene)
        changed = self._forget(walked.gone) | self._examine(walked.looked_at, known, scene)
        hidden = frozenset(self._verdicts.hidden)
        removed, added = self._verdicts.recount(changed | hidden, scene)
        changed |= hidden - self._verdicts.hidden
        added = [*recalled, *added]
        self._timeline = self._timeline.changed(removed, added)
        before, self._odd = self._odd, _oddities(walked)
        return TableChange(removed, added, bool(changed or recalled) or self._odd != before)

    def snapshot(self, now: Ns) -> Snapshot:
        """What the last look left known."""
        timeline, odd = self._timeline, self._odd or _Oddities()
        aside: dict[FileState, list[SetAside]] = {}
        silent = set(timeline.silent)
        empty = 0
        for verdict in self._verdicts.set_aside.values():
            if verdict.aside is not None:
                aside.setdefault(verdict.standing, []).append(verdict.aside)
            else:
                empty += 1
                silent.update(verdict.silent)
        return Snapshot(
            bags=timeline.recorded,
            active=_by_path(aside.get(FileState.ACTIVE, ())),
            damaged=_by_path([*aside.get(FileState.DAMAGED, ()), *odd.damaged]),
            unread=_by_path([*aside.get(FileState.UNREAD, ()), *odd.links]),
            empty=empty,
            silent_topics=frozenset(silent - timeline.types.keys()),
            scanned_at=now,
            problem=odd.problem,
            described=odd.described,
            timeline=timeline,
        )

    def known(self, named: Collection[str], now: Ns) -> KnownBags:
        """What deletion weighs; `named`: the recordings that the recorder last said it writes."""
        verdicts = self._verdicts
        return KnownBags(
            verdicts.counted, verdicts.hidden, self._files, named, now, self._names.known
        )

    def _next_on_patrol(self) -> list[str]:
        if not self._patrol:
            self._patrol = [*self._files, *self._dormant]
        following = self._patrol[-PATROL:]
        del self._patrol[-PATROL:]
        return [path for path in following if path in self._files or path in self._dormant]

    def _known_at_first(self) -> Mapping[str, KnownFile]:
        """What was known earlier, where the scan begins anew."""
        begun = self._files or self._dormant
        return {} if self._known is None or begun else self._known()

    def _recall(
        self, stamps: dict[str, Stamp], known: Mapping[str, KnownFile], scene: ScanContext
    ) -> list[BagFile]:
        """The bags of files that look as they are known, which need no further look."""
        if self._all_awake or not known:
            return []
        # Which of a bag's names answers is to be weighed.
        kept = {path: stamps.pop(path) for path in self._names.saved_among(stamps)}
        bags = self._dormant.take(stamps, known, self._reader, scene)
        stamps.update(kept)
        return bags

    def _rouse(self, walked: Walked, scene: ScanContext) -> None:
        """Wakes the files that went, look otherwise, or have got another form."""
        if not self._dormant:
            return
        for path, stamp in [*walked.looked_at.items()]:
            if self._dormant.is_undisturbed(path, stamp, scene.now):
                del walked.looked_at[path]
            else:
                self._wake(path, scene)
                self._wake(other_form(path), scene)
        for path in walked.gone:
            self._wake(path, scene)

    def _wake(self, path: str, scene: ScanContext) -> None:
        woken = self._dormant.wake(path, scene.now)
        if woken is not None:
            self._files[path], verdict = woken
            self._verdicts.wake(path, verdict)

    def _forget(self, paths: Iterable[str]) -> set[str]:
        """Drops what is known of these files; gives those that had a verdict."""
        forgotten = set()
        for path in paths:
            self._watched.discard(path)
            self._files.pop(path, None)
            self._names.discard(path)
            if self._verdicts.drop(path):
                forgotten.add(path)
        return forgotten

    def _examine(
        self, stamps: dict[str, Stamp], known: Mapping[str, KnownFile], scene: ScanContext
    ) -> set[str]:
        """Judges these files; gives those of which the verdict changed."""
        changed = set()
        for path, stamp in stamps.items():
            notes = self._files.get(path)
            if notes is None:
                notes = FileNotes.first(Path(path), stamp, scene.now)
                self._files[path] = notes
                self._names.add(path)
                file = known.get(path)
                if file is not None and notes.trusted and file.looks_like(stamp):
                    notes.recall(file.summary)
            elif not notes.look(stamp, scene.now) and path not in self._watched:
                continue
            try:
                verdict = classify(notes, self._reader, scene)
            except BagVanishedError:
                self._tree.distrust(path)
                changed |= self._forget([path])
                continue
            if notes.must_be_watched(verdict, scene):
                self._watched.add(path)
            else:
                self._watched.discard(path)
            if self._verdicts.give(path, verdict):
                changed.add(path)
        return changed


def _oddities(walked: Walked) -> _Oddities:
    described = tuple(sorted(walked.described))
    return _Oddities(_by_path(walked.damaged), _by_path(walked.links), walked.problem, described)


def _by_path(asides: Iterable[SetAside]) -> tuple[SetAside, ...]:
    return tuple(sorted(asides, key=lambda each: each.path))
