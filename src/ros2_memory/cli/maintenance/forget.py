"""`ros2-memory forget`: deletes the bags of a time window, or some messages of them.

Whole bags are deleted as retention deletes them. What is deleted and what is kept is decided first,
without reading a bag. Then the bags are deleted, after the latched messages that later answers need
were carried forward.

Messages of topics, or of the time in which the robot was in a place, are taken out of the bags that
hold them (`retention.eraser`).
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Annotated, Final

import typer

from ros2_memory.bag_dir.handover_file import read_handover
from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.layout import (
    ERASING_FILE,
    FORGOTTEN_FILE,
    LOCK_FILE,
    MOMENTS_FOLDER,
    SHIPPED_FILE,
    other_form,
)
from ros2_memory.bag_dir.lock import BagDirLock
from ros2_memory.bag_dir.metadata_yaml import bare_name
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bag_dir.state_files import (
    ERASING,
    FORGOTTEN,
    Erasure,
    Forgetting,
    ForgottenBag,
    append_deleted,
    deleted_of,
)
from ros2_memory.bootstrap import build_reader, column_paths
from ros2_memory.cli.options import (
    BOUNDED,
    STAYS,
    AsJson,
    BagDir,
    Overrides,
    Times,
    Verbose,
    lines_as_json,
    load_for,
    open_memory,
    require_recorder,
)
from ros2_memory.cli.output import format_size, format_time, print_line, spinner
from ros2_memory.columns.forget import forget as forget_columns
from ros2_memory.config import Settings
from ros2_memory.core.errors import BagError, InvalidArgumentsError, RecorderError
from ros2_memory.core.model import BagFile, BagState, SetAside, TimeWindow
from ros2_memory.core.text import counted, listed, match_topics
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns, unix_from_ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import open_view
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.places.where import known_track_for, parse_where
from ros2_memory.retention.delete import remove_bag, remove_emptied
from ros2_memory.retention.eraser import Eraser, Survey
from ros2_memory.retention.latched_carry import Carrier
from ros2_memory.retention.repair import metadata_corrected
from ros2_memory.storage.mcap.writer import McapWriter

PLACE_MARGIN_NS: Final[Ns] = NS_PER_S
"""Messages so long before the robot entered a place, and after it left, go too."""


def forget(
    overrides: Overrides = None,
    *,
    times: Times,
    topic: Annotated[
        list[str] | None, "GLOB", "Delete only messages of these topics, from all bags; repeatable."
    ] = None,
    where: Annotated[
        str | None, "PLACE", "Delete only messages from when the robot was in a named place."
    ] = None,
    yes: Annotated[bool, "Do not ask for confirmation."] = False,
    dry_run: Annotated[bool, "Show what would be deleted, and delete nothing."] = False,
    as_json: AsJson = False,
    bag_dir: BagDir = None,
    verbose: Verbose = False,
) -> bool:
    """Delete the closed bags that lie wholly inside a time window, after confirmation.

    All messages in a file count, also copies that another recording has.

    With --topic or --where, forget removes messages from the bags instead, and every other message
    stays as it is. If it is interrupted, the next `forget` finishes the work and says so.

    Kept, and named: bags that reach beyond the window, bags being written, and bags that this
    deployment's recorder did not make (unless retention.foreign=delete). Latched messages (maps,
    static transforms) that later answers need are copied forward. Works only where this deployment
    records.
    """
    with lines_as_json(as_json, is_answered=yes or dry_run):
        settings, _ = load_for(bag_dir, overrides)
        require_recorder(settings)
        if not times.are_bounded:
            raise InvalidArgumentsError(f"give a time window: {BOUNDED}")
        memory = open_memory(settings, verbose=verbose)
        if problem := memory.index.snapshot().problem:
            raise RecorderError(problem)
        window = times.window(memory)
        work = _Forget(settings, memory, dry_run=dry_run)
        work.finish_erasure()
        if topic or where is not None:
            work.erase(work.wanted(window, topic or (), where), asks=not yes)
        else:
            work.delete_bags(window, asks=not yes)
        return work.leaves_some


class _Forget:
    """Forgets bags, or messages of them, and prints what is done.

    Attributes:
        leaves_some: whether something stays that was to go.
    """

    def __init__(self, settings: Settings, memory: Memory, *, dry_run: bool) -> None:
        self.leaves_some = False
        self._settings = settings
        self._memory = memory
        self._dry_run = dry_run
        self._bag_dir = settings.recording.bag_dir
        self._reader = build_reader(settings)  # reads files as they are
        self._recorder: str | None = None  # why one holds the bag directory
        if (self._bag_dir / LOCK_FILE).exists():  # else none does, and nothing is written
            with _recorder_locked_out(self._bag_dir) as self._recorder:
                pass
        self._unread: set[Path] = set()  # bags whose first messages are unknown
        snapshot = memory.index.snapshot()
        self._written = {aside.path: self._may_hold(aside, snapshot) for aside in snapshot.active}
        every = OwnRecordings(self._bag_dir)
        self._own = every if settings.retention.foreign == "keep" else None
        static_topics = settings.data.tf_static_topics
        self._carrier = Carrier(self._bag_dir, memory.reader, McapWriter(), static_topics, every)
        self._eraser = Eraser(
            self._bag_dir,
            self._reader,
            McapWriter(),
            self._own,
            written=self._written,
            recorder=self._recorder,
        )

    def finish_erasure(self) -> None:
        """Finishes an erasure that was interrupted."""
        try:
            begun = ERASING.read(self._bag_dir)
        except ValueError as error:
            raise RecorderError(
                f"{self._bag_dir / ERASING_FILE}: {error}; an earlier forget was interrupted: "
                "delete the file, and forget again what was to go"
            ) from error
        if begun is not None:
            ends = TimeWindow(begun.windows[0][0], begun.windows[-1][1]).asked()
            topics, span = listed(begun.topics), _span(*ends)
            print_line(f"an earlier forget was interrupted: {topics} {span}")
            self.erase(begun, asks=False)

    def wanted(self, window: TimeWindow, globs: Sequence[str], where: str | None) -> Erasure:
        """Returns which messages are to go, and prints which of those asked for stay.

        Raises:
            InvalidArgumentsError: no such place is named, or no topic matches.
        """
        windows, unknown = [window], list[str]()
        if where is not None:
            with spinner(f"looking when the robot was in {where}"):
                view = open_view(self._memory, Call(), None)
                place = parse_where(self._memory.limits, where)
                stays = known_track_for(view, place, window).inside(place.region, window)
            margin = PLACE_MARGIN_NS
            around = [TimeWindow(stay.start - margin, stay.stop + margin + 1) for stay in stays]
            windows = [time.intersect(window) for time in around]
            unknown = [f"what is not known: {note}" for note in view.notes.sentences()]
        with spinner("looking which topics there are"):
            known = self._eraser.topics()
        latched = known.intersection(self._carrier.topics(self._memory.index.snapshot()))
        topics = {name for glob in globs for name in match_topics(known, glob)}
        if globs and not topics:
            raise InvalidArgumentsError(f"no recorded topic is named {listed([*globs])}")
        if not globs:
            topics = {*known} - latched
            if latched and windows:
                print_line(
                    "latched messages stay, because they are valid later, too (name a topic to "
                    f"forget it): {listed(sorted(latched))}"
                )
        self._stays(unknown)
        if self._recorder is not None and topics & latched:
            line = (
                f"{listed(sorted(topics & latched))}: latched messages, which the recorder carries "
            )
            self._stays([f"{line}on: {self._recorder}; stop the recorder, and forget again"])
            topics -= latched
        return Erasure.of(topics, windows, topics & latched)

    def erase(self, erasure: Erasure, *, asks: bool) -> None:
        """Takes messages out of bags; `asks`: whether the user is asked before."""
        survey = Survey((), ())
        if erasure.topics and erasure.windows:
            with spinner("looking which bags hold some"):
                survey = self._eraser.survey(erasure)
        self._stays(survey.kept)
        if not survey.holders and not erasure.files:
            print_line("no such message is in the window")
            self._forget_derived(())
            return
        counts = survey.counts
        size = sum(path.stat().st_size for path in {holder.paths[0] for holder in survey.holders})
        what = (
            f"{counted(counts.total(), 'message')} of {counted(len(counts), 'topic')}, by "
            f"rewriting {counted(len(survey.holders), 'bag')} ({format_size(size)})"
        )
        rows = [f"{topic}: {counted(count, 'message')}" for topic, count in sorted(counts.items())]
        if not self._confirmed(what, rows, asks=asks):
            return
        with spinner("deleting"), _recorder_locked_out(self._bag_dir) as recorder:
            if recorder is not None and self._recorder is None:
                raise RecorderError(f"nothing was deleted: {recorder}; forget again")
            kept_by_lake = self._request_of_lake(
                [Forgetting(*window, erasure.topics) for window in erasure.windows]
            )
            result = self._eraser.erase(erasure, survey, self._refresh_and_forget)
        is_all = not result.kept
        print_line(f"deleted: {counts.total()} messages" if is_all else "not all is deleted")
        self._stays([*result.kept, *kept_by_lake])
        for note in result.notes:
            print_line(note)

    def delete_bags(self, window: TimeWindow, *, asks: bool) -> None:
        """Deletes the bags that lie inside a window; `asks` as above."""
        going, kept = self._planned(window)
        self._stays([*kept, *self._kept_elsewhere(going, window)])
        if not going:
            why = "no closed bag has messages in the window"
            if kept:
                why = "each bag with messages in the window stays, for the reason above"
            print_line(f"nothing to delete: {why}")
            self._forget_derived(())
            return
        first, last = min(bag.start for bag in going), max(bag.end for bag in going)
        size = sum(bag.size for bag in going)
        what = f"{counted(len(going), 'bag')}, {format_size(size)}, {_span(first, last)}"
        if self._confirmed(what, map(self._name, going) if self._dry_run else (), asks=asks):
            self._delete(going)

    def _confirmed(self, what: str, rows: Iterable[str], *, asks: bool) -> bool:
        """Prints what is to go, and returns whether it goes."""
        print_line(f"{'would' if self._dry_run else 'to'} be deleted: {what}")
        for row in rows:
            print_line(f"  {row}")
        if asks and not self._dry_run:
            typer.confirm("Delete them? This cannot be undone.", abort=True)
        return not self._dry_run

    def _stays(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.leaves_some = True
            print_line(f"{STAYS}{line}")

    def _planned(self, window: TimeWindow) -> tuple[list[BagFile], list[str]]:
        """Decides which bags of a window go, and gives a line with the reason for each other one.

        Only bags are read of which some messages do not count.
        """
        going: list[BagFile] = []
        kept: list[str] = []
        snapshot = self._memory.index.snapshot()
        for bag in self._raw_bags(snapshot):
            if bag.reaches_into(window):
                if reason := self._reason_to_keep(bag, window):
                    kept.append(f"{self._name(bag)}: {reason}")
                else:
                    going.append(bag)
        deleted_too = {other_form(bag.file) for bag in going}
        kept += (
            f"{self._name(aside)}: {reason}"
            for aside, reason in self._unread_in(window, snapshot)
            if str(aside.path) not in deleted_too
        )
        return going, kept

    def _unread_in(self, window: TimeWindow, snapshot: Snapshot) -> Iterator[tuple[SetAside, str]]:
        """Yields the files that may have messages in a window and are not read, each with why."""
        for aside, bounds in {**snapshot.unread_spans, **snapshot.unread_bounds}.items():
            span = self._written.get(aside.path, bounds)
            if span is None:
                yield aside, f"when it was recorded is unknown ({aside.reason})"
            elif aside.until is None and span.overlaps(window.start, window.stop - 1):
                yield aside, aside.reason

    def _may_hold(self, aside: SetAside, snapshot: Snapshot) -> TimeWindow | None:
        """Returns what a file may hold that is being written, from the first message in it."""
        with suppress(BagError):
            summary = self._reader.summarize(aside.path)
            if not summary.empty:
                return TimeWindow(summary.start, MAX_NS)
        return snapshot.unread_bounds[aside]

    def _raw_bags(self, snapshot: Snapshot) -> Iterator[BagFile]:
        """Yields the bags with all messages in them, also those that do not count."""
        handover_of = cache(read_handover)
        for bag in (*snapshot.bags, *snapshot.copies):
            if bag.sidecar_ns and handover_of(bag.recording).handover.rule(bag.path.name):
                try:
                    summary = self._reader.summarize(bag.path)
                except BagError:
                    self._unread.add(bag.path)
                else:
                    start, end = summary.start, summary.end
                    bag = bag._replace(summary=summary, start=start, end=end)  # noqa: PLW2901
            yield bag
        for path in snapshot.empty:
            with suppress(BagError, OSError):
                summary, status = self._reader.summarize(path), path.lstat()
                if not summary.empty:
                    stamp = str(path), status.st_size, status.st_mtime_ns
                    yield BagFile(*stamp, BagState.CLOSED, summary, summary.start, summary.end)

    def _reason_to_keep(self, bag: BagFile, window: TimeWindow) -> str | None:
        if bag.state is BagState.ACTIVE:
            return "it is being written"
        if not window.covers(bag.start, bag.end):
            return "it reaches beyond the window"
        if self._own is not None and not self._own.owns_bag(bag.path):
            adopt = (
                "move it into a directory of its own in the bag directory and let "
                "`ros2-memory adopt` take that"
            )
            if folder := self._own.name_of(bag.path.parent):
                adopt = f"`ros2-memory adopt {folder}` first"
            return f"this recorder did not make it; to forget it, {adopt}"
        if bag.state is BagState.INCOMPLETE:
            closes = "; ros2-memory recover closes it" if bag.path.suffix == ".mcap" else ""
            return f"a crash left it open{closes}"
        if bag.path.is_relative_to(self._bag_dir / MOMENTS_FOLDER):
            return "it belongs to a saved moment; delete the moment's folder to forget it"
        return None

    def _kept_elsewhere(self, going: Sequence[BagFile], window: TimeWindow) -> Iterator[str]:
        """Yields what of the window remains readable without the bags that are deleted."""
        with suppress(BagError):
            carried = [
                topic.topic
                for topic in self._memory.reader.summarize(self._carrier.path).topics
                if window.overlaps(topic.first, topic.last)
            ]
            if carried:
                where = f"in {self._carrier.path}: {', '.join(carried)}"
                yield f"latched messages that later answers need, {where}"
        if linked := _with_other_links(going):
            yield (
                f"{counted(len(linked), 'bag')} of these, also in saved moments or "
                "under other names: delete the moment's folder to forget it"
            )

    def _delete(self, planned: Sequence[BagFile]) -> None:
        """Deletes the planned bags that are still there, and prints which stay.

        Raises:
            BagError: latched messages cannot be carried; nothing is deleted then.
        """
        with spinner("deleting"), _recorder_locked_out(self._bag_dir) as recorder:
            snapshot = self._memory.index.refresh()
            present = {bag[:3] for bag in self._raw_bags(snapshot)}
            bags = [
                bag
                for bag in planned
                if bag[:3] in present and (self._own is None or self._own.owns_bag(bag.path))
            ]
            kept, carried, paths = list[str](), None, {bag.path for bag in bags}
            if recorder is None:
                carried = self._carrier.carry(snapshot, paths, _with_other_links(bags))
            else:  # it carries latched messages itself, and two programs must not do so at a time
                latched = {bag.path for bag in self._carrier.with_latched(snapshot, paths)}
                bags = [bag for bag in bags if bag.path not in latched]
                kept += [
                    f"{self._name(path)}: it has latched messages, which only the recorder may "
                    f"copy forward while it runs: {recorder}; stop the recorder, and forget again"
                    for path in sorted(latched)
                ]
            kept += self._ask_lake(bags)
            self._note_deletions(bags, kept)
            deleted, freed = self._delete_files(bags, kept)
            open_recordings = {
                self._bag_dir / name for name in read_heartbeat(self._bag_dir).recordings
            }
            recordings = {bag.recording for bag in deleted}
            for recording in recordings - open_recordings:
                try:
                    remove_emptied(self._bag_dir, recording)
                except OSError as error:
                    kept.append(f"{self._name(recording)}: {error.strerror or error}")
            try:
                self._forget_derived(map(self._name, deleted))
            except BagError as error:
                kept.append(error.reason)
            notes = [*metadata_corrected(self._bag_dir, recordings, self._reader)]
        also = ""
        if carried is not None:
            messages = counted(carried, "latched message is", "latched messages are")
            also = f"; {messages} carried on"
        print_line(f"deleted: {counted(len(deleted), 'bag')}, {format_size(freed)}{also}")
        self._stays(kept)
        for note in notes:
            print_line(note)

    def _ask_lake(self, bags: Sequence[BagFile]) -> list[str]:
        """Has a lake forget what it has of bags; returns a line on each thing that it keeps."""
        known, kept, times = list[ForgottenBag](), list[str](), list[Ns]()
        for bag in bags:
            if bag.path in self._unread:
                kept.append(f"what a lake has of {self._name(bag)}, which cannot be read")
                continue
            start = bag.summary.start
            known.append(ForgottenBag(bag.recording.name, bag.path.name, start))
            times += (start, bag.start, bag.end + 1)
        if known:
            kept += self._request_of_lake([Forgetting(min(times), max(times), bags=tuple(known))])
        return kept

    def _note_deletions(self, bags: Sequence[BagFile], kept: list[str]) -> None:
        """Writes down what is about to be deleted, so that answers do not call it unrecorded."""
        splits: dict[Path, list[tuple[str, Ns, Ns]]] = {}
        for bag in bags:
            named = bare_name(bag.path.name), bag.start, bag.end
            splits.setdefault(bag.recording, []).append(named)
        try:
            append_deleted(
                self._bag_dir, [deleted_of(self._name(path), of) for path, of in splits.items()]
            )
        except OSError as error:
            kept.append(f"the list of deleted bags: {error.strerror or error}")

    def _delete_files(self, bags: Sequence[BagFile], kept: list[str]) -> tuple[list[BagFile], int]:
        """Deletes bags in every form, and adds faults to `kept`.

        Returns those of which the form that counted is gone, and the bytes of all that is.
        """
        staying, freed = set[Path](), 0
        for path in (path for bag in bags for path in (bag.path, Path(other_form(bag.file)))):
            try:
                with suppress(FileNotFoundError):
                    status = path.lstat()
                    inode = status.st_dev, status.st_ino
                    freed += remove_bag(self._bag_dir, path, inode)
            except OSError as error:
                kept.append(f"{self._name(path)}: {error.strerror or error}")
                staying.add(path)
        return [bag for bag in bags if bag.path not in staying], freed

    def _request_of_lake(self, forgettings: Sequence[Forgetting]) -> list[str]:
        """Stores what a lake has to forget; returns a line on what the lake keeps if it cannot."""
        if not forgettings:
            return []
        try:
            FORGOTTEN.append(self._bag_dir, forgettings)
        except OSError as error:
            first = min(forgetting.start for forgetting in forgettings) // NS_PER_S
            last = -(-max(forgetting.stop for forgetting in forgettings) // NS_PER_S)
            line = (
                f"what a lake has of it: {self._bag_dir / FORGOTTEN_FILE} cannot be written "
                f"({error.strerror or error}); if these bags are shipped, run `ros2-memory ship "
                f"--forget ROBOT --start {first} --end {last}` where that is done"
            )
            return [line]
        if (self._bag_dir / SHIPPED_FILE).exists():
            print_line("the next pass of ros2-memory ship deletes it from the lake, too")
        return []

    def _refresh_and_forget(self, erasure: Erasure) -> None:
        self._memory.index.refresh()
        self._forget_derived(erasure.files)

    def _forget_derived(self, files: Iterable[str]) -> None:
        """Deletes what is derived from bags, by their names, and from those deleted before.

        Of bags that retention deleted, something may be left.

        Raises:
            BagError: some of it may still be there.
        """
        if not self._dry_run:
            names = [*files]
            for path in column_paths(self._settings):
                forget_columns(path, self._bag_dir, names)

    def _name(self, of: BagFile | SetAside | Path) -> str:
        """Returns a path as people know it: relative to the bag directory, if it is in there."""
        path = of if isinstance(of, Path) else of.path
        return str(path).removeprefix(f"{self._bag_dir}/")


def _span(first: Ns, last: Ns) -> str:
    return f"from {format_time(unix_from_ns(first))} to {format_time(unix_from_ns(last))}"


def _with_other_links(bags: Sequence[BagFile]) -> set[Path]:
    """Returns the bags that have further hard links, as saved moments have."""
    linked = set()
    for path in (bag.path for bag in bags):
        with suppress(OSError):
            linked |= {path} if path.lstat().st_nlink > 1 else set()
    return linked


@contextmanager
def _recorder_locked_out(bag_dir: Path) -> Iterator[str | None]:
    """Keeps recorders from starting within the block; yields why one holds the lock, or None."""
    try:
        lock = BagDirLock.acquire(bag_dir, patience_s=0.0)
    except RecorderError as error:
        yield str(error)
        return
    try:
        yield None
    finally:
        lock.release()
