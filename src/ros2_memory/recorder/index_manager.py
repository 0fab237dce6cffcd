"""Keeps what is known of the bag directory: which bags answer, and what was set aside.

A scan looks at what changed, judges each file (see `standing`), and swaps a whole new `Snapshot`
in: a query that holds one sees one consistent index for as long as it likes. No thread is started:
whoever asks a question, or calls `refresh` now and then, scans. Nothing is written or deleted,
unless it was built to dispose of bags, as the recorder's daemon alone does.
"""

from __future__ import annotations

import gc
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import structlog

from ros2_memory.errors import BagVanishedError
from ros2_memory.model import BagState
from ros2_memory.recorder.disposal import Disposed
from ros2_memory.recorder.dormant import Dormant
from ros2_memory.recorder.heartbeat import read_heartbeat
from ros2_memory.recorder.inventory import Known
from ros2_memory.recorder.kept_names import KeptNames
from ros2_memory.recorder.scan import COMPRESSED, Tree, other_form
from ros2_memory.recorder.snapshot import Snapshot, Timeline
from ros2_memory.recorder.standing import FileNotes, Scene, Standing, judge
from ros2_memory.timebase import ms_from_ns, ns_from_unix

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from structlog.typing import FilteringBoundLogger

    from ros2_memory.model import BagFile, SetAside
    from ros2_memory.recorder.disposal import Disposal
    from ros2_memory.recorder.heartbeat import Heartbeat
    from ros2_memory.recorder.scan import Stamp, Walked
    from ros2_memory.recorder.standing import FormerFile, Verdict
    from ros2_memory.storage.base import BagReader
    from ros2_memory.timebase import Clock, Ns

__all__ = ["IndexManager", "Snapshot"]

SPLITS_OF_PATIENCE: Final = 3
"""A file that lay still for so many splits is not being written, unless a heartbeat says so."""
PATROL: Final = 256
"""Closed files looked at in each scan, in turn: one overwritten in place changes no directory."""


class _Oddities(NamedTuple):
    """What a walk finds besides files."""

    damaged: tuple[SetAside, ...] = ()
    links: tuple[SetAside, ...] = ()
    problem: str | None = None


class IndexManager:
    """Keeps the snapshot of one bag directory. Safe for several threads at once.

    `refresh_s` is how old a snapshot may become before a question has it renewed;
    `split_duration_s` is how long the recorder writes one file. `disposal` deletes bags by its
    limits when it is told to; without it nothing here deletes anything. `known` tells, by path, of
    closed files that were read earlier: a scan that begins anew does not read them again while they
    look as they did. `include_active`: what is whole of a file that is being written answers, too;
    not where bags are disposed of, repaired or kept, which is for those that are finished.

    Attributes:
        bag_dir: the bag directory.
        published: what the last scan gave, however old; None before the first has ended.
    """

    def __init__(
        self,
        bag_dir: Path,
        reader: BagReader,
        clock: Clock,
        *,
        refresh_s: float,
        split_duration_s: float,
        disposal: Disposal | None = None,
        known: Callable[[], Mapping[str, FormerFile]] | None = None,
        include_active: bool = False,
    ) -> None:
        self.bag_dir = bag_dir
        self._known = known
        self._include_active = include_active
        self._disposal = disposal
        self._reader = reader
        self._clock = clock
        self._refresh: Ns = ns_from_unix(refresh_s)
        self._three_splits: Ns = ns_from_unix(SPLITS_OF_PATIENCE * split_duration_s)
        self._log: FilteringBoundLogger = structlog.get_logger()
        self._lock = threading.Lock()
        self.published: Snapshot | None = None
        self._start_over()

    def snapshot(self, reach: Ns | None = None) -> Snapshot:
        """The current snapshot, scanned anew where it may not do.

        That is: it is older than `refresh_s`, or `reach`, the latest log time that the question is
        about, lies past the end of the newest bag. Callers that come while a scan runs wait for it
        and share its result.
        """
        current = self.published
        if current is not None and not self._is_stale(current, reach):
            return current
        with self._lock:
            if self.published is not None and self.published is not current:
                return self.published
            # A question waits for what changes by itself, the newest bags; `refresh` patrols.
            return self._scan(patrolling=False)

    def refresh(self) -> Snapshot:
        """Scans now, and gives the result."""
        with self._lock:
            return self._scan()

    @contextmanager
    def undisturbed(self) -> Iterator[Snapshot]:
        """The result of a scan, and nothing is deleted while it is looked at."""
        with self._lock:
            yield self._scan(patrolling=False)

    def apply_retention(
        self, *, free_bytes: Callable[[], int] | None = None, min_free_bytes: int | None = None
    ) -> Disposed:
        """Scans, and deletes what the limits do not allow to keep; nothing without a `disposal`.

        `free_bytes` measures what the disk has left, where that is to count; `min_free_bytes` is
        what it must have, where that is not as the limits say.
        """
        if self._disposal is None:
            return Disposed()
        with self._lock:
            snapshot = self._scan()
            heartbeat = self.heartbeat()
            named = () if heartbeat is None else heartbeat.recordings
            known = Known(
                self._counted,
                self._hidden,
                self._files,
                named,
                snapshot.scanned_at,
                self._names.known,
            )
            done = self._disposal.apply(
                known, snapshot, free_bytes=free_bytes, min_free_bytes=min_free_bytes
            )
            if done.bags:
                self._scan()
            return done

    def heartbeat(self) -> Heartbeat | None:
        """What the recorder last wrote of itself, live or not; None where that cannot be read."""
        return read_heartbeat(self.bag_dir).heartbeat

    def _is_stale(self, snapshot: Snapshot, reach: Ns | None) -> bool:
        if not 0 <= self._clock.now() - snapshot.scanned_at < self._refresh:
            return True
        return reach is not None and (snapshot.latest is None or reach > snapshot.latest)

    # What follows runs under the lock.

    def _start_over(self) -> None:
        self._tree = Tree(self.bag_dir)
        self._dormant = Dormant()
        self._files: dict[str, FileNotes] = {}
        self._verdicts: dict[str, Verdict] = {}
        self._counted: dict[str, Verdict] = {}  # of x.mcap and x.mcap.zstd only one
        self._set_aside: dict[str, Verdict] = {}  # those of `_counted` that are not only bags
        self._hidden: set[str] = set()  # the other form answers for these, for the time being
        self._names = KeptNames(self.bag_dir)
        self._watched: set[str] = set()
        self._patrol: list[str] = []
        self._odd = _Oddities()
        self._timeline = Timeline()

    def _scan(self, *, patrolling: bool = True) -> Snapshot:
        if self.published is not None:
            return self._look_through(patrolling=patrolling)
        with _collector_resting():
            return self._look_through(patrolling=patrolling)

    def _look_through(self, *, patrolling: bool = True) -> Snapshot:
        begun = time.perf_counter_ns()
        scene = self._scene()
        try:
            patrol = self._next_on_patrol() if patrolling else ()
            walked = self._tree.walk(scene.now, [*self._watched, *patrol])
            self._rouse(walked, scene)
            known = self._known_at_first()
            recalled = self._recall(walked.looked_at, known, scene)
            changed = self._forget(walked.gone) | self._examine(walked.looked_at, known, scene)
            hidden = frozenset(self._hidden)
            removed, added = self._recount(changed | hidden, scene)
            changed |= hidden - self._hidden
            added = [*recalled, *added]
            self._timeline = self._timeline.changed(removed, added)
        except BaseException:
            # The walk does not show a second time what it has shown once.
            self._start_over()
            raise
        before, odd = self.published, _oddities(walked)
        if before is not None and not (changed or recalled) and odd == self._odd:
            self.published = replace(before, scanned_at=scene.now)
            return self.published
        self._odd = odd
        self.published = self._compose(scene.now)
        self._report(before, self.published, removed, added, begun)
        return self.published

    def _scene(self) -> Scene:
        now = self._clock.now()
        heartbeat = self.heartbeat()
        live = heartbeat is not None and heartbeat.is_live(now)
        named = frozenset(heartbeat.recordings) if heartbeat is not None and live else None
        return Scene(self.bag_dir, now, self._three_splits, named, self._include_active)

    def _next_on_patrol(self) -> list[str]:
        if not self._patrol:
            self._patrol = [*self._files, *self._dormant]
        following = self._patrol[-PATROL:]
        del self._patrol[-PATROL:]
        return [path for path in following if path in self._files or path in self._dormant]

    def _known_at_first(self) -> Mapping[str, FormerFile]:
        """What was known earlier, where the scan begins anew."""
        begun = self._files or self._dormant
        return {} if self._known is None or begun else self._known()

    def _recall(
        self, stamps: dict[str, Stamp], known: Mapping[str, FormerFile], scene: Scene
    ) -> list[BagFile]:
        """The bags of files that look as they are known, which need no further look.

        Disposal weighs more than bags, so with it all files stay awake.
        """
        if self._disposal is not None or not known:
            return []
        # Which of a bag's names answers is to be weighed.
        kept = {path: stamps.pop(path) for path in [*stamps] if self._names.is_kept(path)}
        bags = self._dormant.take(stamps, known, self._reader, scene)
        stamps.update(kept)
        return bags

    def _rouse(self, walked: Walked, scene: Scene) -> None:
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

    def _wake(self, path: str, scene: Scene) -> None:
        woken = self._dormant.wake(path, scene.now)
        if woken is not None:
            notes, verdict = woken
            self._files[path] = notes
            self._verdicts[path] = self._counted[path] = verdict

    def _forget(self, paths: Iterable[str]) -> set[str]:
        """Drops what is known of these files; gives those that had a verdict."""
        forgotten = set()
        for path in paths:
            self._watched.discard(path)
            self._files.pop(path, None)
            self._names.leave(path)
            if self._verdicts.pop(path, None) is not None:
                forgotten.add(path)
        return forgotten

    def _examine(
        self, stamps: dict[str, Stamp], known: Mapping[str, FormerFile], scene: Scene
    ) -> set[str]:
        """Judges these files; gives those of which the verdict changed."""
        changed = set()
        for path, stamp in stamps.items():
            notes = self._files.get(path)
            if notes is None:
                notes = FileNotes.first(Path(path), stamp, scene.now)
                self._files[path] = notes
                self._names.enter(path)
                file = known.get(path)
                if file is not None and notes.trusted and file.looks_like(stamp):
                    notes.recall(file.summary)
            elif not notes.look(stamp, scene.now) and path not in self._watched:
                continue
            try:
                verdict = judge(notes, self._reader, scene)
            except BagVanishedError:
                self._tree.distrust(path)
                changed |= self._forget([path])
                continue
            if notes.must_be_watched(verdict, scene):
                self._watched.add(path)
            else:
                self._watched.discard(path)
            if verdict != self._verdicts.get(path):
                self._verdicts[path] = verdict
                changed.add(path)
        return changed

    def _recount(self, changed: Iterable[str], scene: Scene) -> tuple[list[BagFile], list[BagFile]]:
        """Brings `_counted` up to date; gives the bags that left it and those that came."""
        removed, added = [], []
        forms = {form for each in changed for form in (each, other_form(each))}
        if self._names.known:
            forms.update(name for each in [*forms] for name in self._names.of(each))
        for path in forms:
            before, after = self._counted.pop(path, None), self._verdict_that_counts(path, scene)
            self._set_aside.pop(path, None)
            if after is not None:
                self._counted[path] = after
                if after.bag is None or after.aside is not None:
                    self._set_aside[path] = after
            if before == after:
                continue
            if before is not None and before.bag is not None:
                removed.append(before.bag)
            if after is not None and after.bag is not None:
                added.append(after.bag)
        return removed, added

    def _verdict_that_counts(self, path: str, scene: Scene) -> Verdict | None:
        """The file's verdict; None where it is unknown, or its other form answers for it.

        While a split is compressed `x.mcap` and `x.mcap.zstd` both lie there: one bag, twice. Two
        whole ones that have lain there for three splits are two files that somebody keeps.
        """
        self._hidden.discard(path)
        if any(self._is_same_file(path, name) for name in self._names.before(path)):
            return None
        own, other = self._verdicts.get(path), self._verdicts.get(other_form(path))
        if own is None or other is None or own.standing > other.standing:
            return own
        kept = not self._being_compressed(path, scene)
        if kept and own.standing is Standing.UNREAD:
            return own
        if own.standing == other.standing and (
            (kept and own.standing is Standing.CLOSED) or not path.endswith(COMPRESSED)
        ):
            return own
        self._hidden.add(path)
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

    def _being_compressed(self, path: str, scene: Scene) -> bool:
        forms = [self._files[form] for form in (path, other_form(path)) if form in self._files]
        return any(notes.grew_lately(scene) for notes in forms)

    def _compose(self, now: Ns) -> Snapshot:
        timeline = self._timeline
        aside: dict[Standing, list[SetAside]] = {}
        silent = set(timeline.silent)
        empty = 0
        for verdict in self._set_aside.values():
            if verdict.aside is not None:
                aside.setdefault(verdict.standing, []).append(verdict.aside)
            else:
                empty += 1
                silent.update(verdict.silent)
        return Snapshot(
            bags=timeline.recorded,
            active=_by_path(aside.get(Standing.ACTIVE, ())),
            damaged=_by_path([*aside.get(Standing.DAMAGED, ()), *self._odd.damaged]),
            unread=_by_path([*aside.get(Standing.UNREAD, ()), *self._odd.links]),
            empty=empty,
            silent_topics=frozenset(silent - timeline.types.keys()),
            scanned_at=now,
            problem=self._odd.problem,
            timeline=timeline,
        )

    def _report(
        self,
        before: Snapshot | None,
        after: Snapshot,
        removed: Sequence[BagFile],
        added: Sequence[BagFile],
        begun: Ns,
    ) -> None:
        known = set() if before is None else set(before.damaged)
        for each in after.damaged:
            if each not in known:
                self._log.warning("bag_damaged", path=str(each.path), reason=each.reason)
        # One that grows and answers does so with every question.
        grew = removed and all(bag.state is BagState.ACTIVE for bag in (*removed, *added))
        (self._log.debug if grew else self._log.info)(
            "index_scanned",
            bag_dir=str(self.bag_dir),
            bags=len(after.bags),
            added=len(added),
            removed=len(removed),
            active=len(after.active),
            damaged=len(after.damaged),
            unread=len(after.unread),
            empty=after.empty,
            problem=after.problem,
            duration_ms=round(ms_from_ns(time.perf_counter_ns() - begun), 3),
        )


@contextmanager
def _collector_resting() -> Iterator[None]:
    """Within the block no garbage is looked for, and afterwards not among what it made.

    What the first scan makes of a week's files stays, and looking through all of it again and
    again takes longer than making it.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        # From the youngest generation into the oldest, which is seldom looked through.
        gc.freeze()
        gc.unfreeze()
        gc.enable()


def _oddities(walked: Walked) -> _Oddities:
    return _Oddities(_by_path(walked.damaged), _by_path(walked.links), walked.problem)


def _by_path(asides: Iterable[SetAside]) -> tuple[SetAside, ...]:
    return tuple(sorted(asides, key=lambda each: each.path))
