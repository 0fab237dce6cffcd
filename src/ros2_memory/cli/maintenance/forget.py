"""`ros2-memory forget`: deletes the bags of a time window, or some messages of them.

Whole bags are deleted as retention deletes them: first it is decided which go and which stay, then
latched messages that later answers need are carried forward, then the files are deleted.

Messages of some topics, or from when the robot was in a place, are taken out of their bags
(`retention.eraser`).
"""

import shlex
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
    THINNED_FILE,
    is_thinned,
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
from ros2_memory.core.model import MCAP, BagFile, BagState, SetAside, TimeWindow
from ros2_memory.core.spans import united
from ros2_memory.core.text import counted, listed, match_topics
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns, unix_from_ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import open_view
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.places.where import known_track_for, parse_where
from ros2_memory.retention.delete import remove_bag, remove_emptied
from ros2_memory.retention.eraser import Eraser, Survey
from ros2_memory.retention.latched_carry import Carrier
from ros2_memory.retention.repair import correct_metadata_files, reason_of
from ros2_memory.storage.mcap.writer import McapWriter

PLACE_MARGIN_NS: Final[Ns] = NS_PER_S
"""Forgetting a place includes so long before the robot entered it, and after it left."""


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
        settings = load_for(bag_dir, overrides)
        require_recorder(settings)
        if not times.are_bounded:
            raise InvalidArgumentsError(f"give a time window: {BOUNDED}")
        memory = open_memory(settings, verbose=verbose)
        if problem := memory.snapshot().problem:
            raise RecorderError(problem)
        window = times.window(memory)
        work = _Forget(settings, memory, dry_run=dry_run)
        work.finish_erasure()
        if topic or where is not None:
            work.erase(work.plan_erasure(window, topic or (), where), asks=not yes)
        else:
            work.delete_bags(window, asks=not yes)
        return work.leaves_some


class _Forget:
    """Forgets bags, or messages of them, and prints what is done.

    Attributes:
        leaves_some: whether something stays that was to go.
        stays: lines on what stays, which are to be printed.
    """

    def __init__(self, settings: Settings, memory: Memory, *, dry_run: bool) -> None:
        self.leaves_some = False
        self.stays: list[str] = []
        self._settings = settings
        self._memory = memory
        self._dry_run = dry_run
        self._bag_dir = settings.recording.bag_dir
        self._reader = build_reader(settings)  # `memory.reader` hides messages that do not count
        self._recorder: str | None = None  # a sentence, if a recorder holds the bag directory
        if (self._bag_dir / LOCK_FILE).exists():  # locking would make the file
            with _recorder_locked_out(self._bag_dir) as self._recorder:
                pass
        self._unreadable: set[Path] = set()
        snapshot = memory.snapshot()
        self._written = {
            aside.path: self._span_written(aside, snapshot) for aside in snapshot.active
        }
        recordings = OwnRecordings(self._bag_dir)
        self._own = recordings if settings.retention.foreign == "keep" else None
        static_topics = settings.data.tf_static_topics
        writer = McapWriter(settings.reader.max_chunk_mb)
        self._carrier = Carrier(self._bag_dir, memory.reader, writer, static_topics, recordings)
        self._eraser = Eraser(
            self._bag_dir,
            self._reader,
            writer,
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
            (first, _), (_, stop) = begun.windows[0], begun.windows[-1]
            span = _describe_span(*TimeWindow(first, stop).asked())
            print_line(f"an earlier forget was interrupted: {listed(begun.topics)} {span}")
            self.erase(begun, asks=False)

    def plan_erasure(self, window: TimeWindow, globs: Sequence[str], place: str | None) -> Erasure:
        """Decides which messages go, and prints which of those asked for stay.

        Raises:
            InvalidArgumentsError: no such place is named, or no topic matches.
        """
        windows = [window] if place is None else self._windows_in(place, window)
        with spinner("looking which topics there are"):
            recorded = self._eraser.topics()
        latched = recorded.intersection(self._carrier.topics(self._memory.index.snapshot()))
        if globs:
            missing = [glob for glob in globs if not match_topics(recorded, glob)]
            not_recorded = f"no recorded topic is named {listed(missing)}"
            if len(missing) == len(globs):
                raise InvalidArgumentsError(not_recorded)
            if missing:
                print_line(not_recorded)
            topics = {name for glob in globs for name in match_topics(recorded, glob)}
        else:
            topics = {*recorded} - latched
            if latched and windows:
                print_line(
                    "latched messages stay, because they are valid later, too (name a topic to "
                    f"forget it): {listed(sorted(latched))}"
                )
        latched &= topics
        if self._recorder is not None and latched:
            what = f"{listed(sorted(latched))}: latched messages, which the recorder carries on"
            self.stays.append(f"{what}: {self._recorder}; stop the recorder, and forget again")
            topics, latched = topics - latched, frozenset()
        self._print_stays()
        return Erasure.of(topics, windows, latched)

    def _windows_in(self, name: str, window: TimeWindow) -> list[TimeWindow]:
        """Returns when the robot was in a named place; times when nobody knows stay."""
        with spinner(f"looking when the robot was in {name}"):
            view = open_view(self._memory, Call(), None)
            place = parse_where(self._memory.limits, name)
            stays = known_track_for(view, place, window).inside(place.region, window)
        around = (TimeWindow(stay.start, stay.stop + 1).widened(PLACE_MARGIN_NS) for stay in stays)
        self.stays += [f"what is not known: {note}" for note in view.notes.sentences()]
        return [time.intersect(window) for time in around]

    def erase(self, erasure: Erasure, *, asks: bool) -> None:
        """Takes messages out of bags, with `asks` after confirmation."""
        survey = Survey((), ())
        if erasure.topics and erasure.windows:
            with spinner("looking which bags hold some"):
                survey = self._eraser.survey(erasure)
        self.stays += survey.kept
        self._print_stays()
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
            self._request_of_lake(
                [Forgetting(*window, erasure.topics) for window in erasure.windows]
            )
            result = self._eraser.erase(erasure, survey, self._forget_derived_of)
        is_all = not result.kept
        print_line(f"deleted: {counts.total()} messages" if is_all else "not all is deleted")
        self.stays += result.kept
        self._print_stays()
        for note in result.notes:
            print_line(note)

    def delete_bags(self, window: TimeWindow, *, asks: bool) -> None:
        """Deletes the bags that lie inside a window, with `asks` after confirmation."""
        bags = self._plan_deletion(window)
        has_reasons = bool(self.stays)
        self.stays += self._copies_that_stay(bags, window)
        self._print_stays()
        if not bags:
            why = "no closed bag has messages in the window"
            if has_reasons:
                why = "each bag with messages in the window stays, for the reason above"
            print_line(f"nothing to delete: {why}")
            self._forget_derived(())
            return
        first, last = min(bag.start for bag in bags), max(bag.end for bag in bags)
        size = sum(bag.size for bag in bags)
        what = f"{counted(len(bags), 'bag')}, {format_size(size)}, {_describe_span(first, last)}"
        if self._confirmed(what, map(self._name, bags) if self._dry_run else (), asks=asks):
            self._delete(bags)

    def _confirmed(self, what: str, rows: Iterable[str], *, asks: bool) -> bool:
        """Prints what is to go, and returns whether it goes: not in a dry run.

        Raises:
            typer.Abort: the user answered no.
        """
        print_line(f"{'would' if self._dry_run else 'to'} be deleted: {what}")
        for row in rows:
            print_line(f"  {row}")
        if asks and not self._dry_run:
            typer.confirm("Delete them? This cannot be undone.", abort=True)
        return not self._dry_run

    def _print_stays(self) -> None:
        """Prints what stays, and remembers that something does."""
        for line in self.stays:
            self.leaves_some = True
            print_line(f"{STAYS}{line}")
        self.stays.clear()

    def _plan_deletion(self, window: TimeWindow) -> list[BagFile]:
        """Returns the bags of a window that go.

        Reads only bags that have messages which do not count.
        """
        bags: list[BagFile] = []
        snapshot = self._memory.index.snapshot()
        for bag in self._bags_as_on_disk(snapshot):
            if not bag.reaches_into(window):
                continue
            if reason := self._reason_to_keep(bag, window):
                self.stays.append(f"{self._name(bag)}: {reason}")
            else:
                bags.append(bag)
        deleted_too = {other_form(bag.file) for bag in bags}
        for aside, reason in self._unread_in(window, snapshot):
            if str(aside.path) not in deleted_too:
                self.stays.append(f"{self._name(aside)}: {reason}")
        return bags

    def _unread_in(self, window: TimeWindow, snapshot: Snapshot) -> Iterator[tuple[SetAside, str]]:
        """Yields the files that are not read and may have messages in a window, each with why."""
        for aside, bounds in {**snapshot.unread_spans, **snapshot.unread_bounds}.items():
            span = self._written.get(aside.path, bounds)
            if span is None:
                yield aside, f"when it was recorded is unknown ({aside.reason})"
            elif aside.until is None and span.overlaps(window.start, window.stop - 1):
                yield aside, aside.reason

    def _span_written(self, aside: SetAside, snapshot: Snapshot) -> TimeWindow | None:
        """Returns the times that a file being written may hold: from its first message on."""
        with suppress(BagError):
            summary = self._reader.summarize(aside.path)
            if not summary.empty:
                return TimeWindow(summary.start, MAX_NS)
        return snapshot.unread_bounds[aside]

    def _bags_as_on_disk(self, snapshot: Snapshot) -> Iterator[BagFile]:
        """Yields the bags with all messages in their files, whether the messages count or not."""
        handover_of = cache(read_handover)
        for bag in (*snapshot.bags, *snapshot.copies):
            if not bag.sidecar_ns or not handover_of(bag.recording).handover.rule(bag.path.name):
                yield bag  # all of its messages count
                continue
            try:
                summary = self._reader.summarize(bag.path)
            except BagError:
                self._unreadable.add(bag.path)
                yield bag
            else:
                yield bag._replace(summary=summary, start=summary.start, end=summary.end)
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
                adopt = f"`ros2-memory adopt {shlex.quote(folder)}` first"
            return f"this recorder did not make it; to forget it, {adopt}"
        if bag.state is BagState.INCOMPLETE:
            closes = "; ros2-memory recover closes it" if bag.path.suffix == MCAP else ""
            return f"a crash left it open{closes}"
        if bag.path.is_relative_to(self._bag_dir / MOMENTS_FOLDER):
            return "it belongs to a saved moment; delete the moment's folder to forget it"
        return None

    def _copies_that_stay(self, bags: Sequence[BagFile], window: TimeWindow) -> Iterator[str]:
        """Yields where messages of the window remain readable after the bags are deleted."""
        with suppress(BagError):
            carried = [
                topic.topic
                for topic in self._memory.reader.summarize(self._carrier.path).topics
                if window.overlaps(topic.first, topic.last)
            ]
            if carried:
                where = f"in {self._carrier.path}: {', '.join(carried)}"
                yield f"latched messages that later answers need, {where}"
        if linked := _with_other_links(bags):
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
            bags = self._unchanged(planned, snapshot)
            carried, paths = None, {bag.file for bag in bags}
            if recorder is None:
                carried = self._carrier.carry(snapshot, paths, _with_other_links(bags))
            else:  # it carries messages and writes days, and two programs must not do so at a time
                held = {bag.path for bag in self._carrier.with_latched(snapshot, paths)}
                held.update(bag.path for bag in bags if is_thinned(bag.file))
                bags = [bag for bag in bags if bag.path not in held]
                self.stays += [
                    f"{self._name(path)}: it has latched messages, or is a day of memory/, which "
                    f"only the recorder may copy forward or change while it runs: {recorder}; stop "
                    "the recorder, and forget again"
                    for path in sorted(held)
                ]
            self._ask_lake(bags)
            self._note_deletions(bags)
            deleted, freed = self._delete_files(bags)
            recordings = {bag.recording for bag in deleted}
            self._remove_emptied(recordings)
            self._forget_days(deleted)
            try:
                self._forget_derived(map(self._name, deleted))
            except BagError as error:
                self.stays.append(error.reason)
            notes = correct_metadata_files(self._bag_dir, recordings, self._reader)
        also = ""
        if carried is not None:
            messages = counted(carried, "latched message is", "latched messages are")
            also = f"; {messages} carried on"
        print_line(f"deleted: {counted(len(deleted), 'bag')}, {format_size(freed)}{also}")
        self._print_stays()
        for note in notes:
            print_line(note)

    def _unchanged(self, planned: Sequence[BagFile], snapshot: Snapshot) -> list[BagFile]:
        """Returns the planned bags that are as they were; others stay, or are gone meanwhile."""
        present = {_stamp(bag) for bag in self._bags_as_on_disk(snapshot)}
        bags: list[BagFile] = []
        for bag in planned:
            is_own = self._own is None or self._own.owns_bag(bag.path)
            if _stamp(bag) in present and is_own:
                bags.append(bag)
            elif bag.path.exists() or Path(other_form(bag.file)).exists():
                self.stays.append(f"{self._name(bag)}: it has changed meanwhile; forget again")
        return bags

    def _ask_lake(self, bags: Sequence[BagFile]) -> None:
        """Asks the lake to forget what it has of bags."""
        requested, times = list[ForgottenBag](), list[Ns]()
        for bag in bags:
            if bag.path in self._unreadable:
                self.stays.append(f"what a lake has of {self._name(bag)}, which cannot be read")
                continue
            start = bag.summary.start
            requested.append(ForgottenBag(bag.recording.name, bag.path.name, start))
            times += (start, bag.start, bag.end + 1)
        if requested:
            request = Forgetting(min(times), max(times), bags=tuple(requested))
            self._request_of_lake([request])

    def _note_deletions(self, bags: Sequence[BagFile]) -> None:
        """Writes down what is about to be deleted, so that answers do not call it unrecorded."""
        splits: dict[Path, list[tuple[str, Ns, Ns]]] = {}
        for bag in bags:
            split = bare_name(bag.path.name), bag.start, bag.end
            splits.setdefault(bag.recording, []).append(split)
        deleted = [deleted_of(self._name(path), of_path) for path, of_path in splits.items()]
        try:
            append_deleted(self._bag_dir, deleted)
        except OSError as error:
            self.stays.append(f"the list of deleted bags: {reason_of(error)}")

    def _delete_files(self, bags: Sequence[BagFile]) -> tuple[list[BagFile], int]:
        """Deletes bags, plain and compressed; returns those that are gone, and the bytes freed."""
        staying, freed = set[Path](), 0
        for bag in bags:
            for path in (bag.path, Path(other_form(bag.file))):
                try:
                    status = path.lstat()
                    freed += remove_bag(self._bag_dir, path, (status.st_dev, status.st_ino))
                except FileNotFoundError:
                    continue
                except OSError as error:
                    self.stays.append(f"{self._name(path)}: {reason_of(error)}")
                    staying.add(path)
        return [bag for bag in bags if bag.path not in staying], freed

    def _remove_emptied(self, recordings: Iterable[Path]) -> None:
        """Removes the folders of recordings without bags."""
        open_recordings = read_heartbeat(self._bag_dir).recordings
        for recording in {*recordings} - {self._bag_dir / name for name in open_recordings}:
            try:
                remove_emptied(self._bag_dir, recording)
            except OSError as error:
                self.stays.append(f"{self._name(recording)}: {reason_of(error)}")

    def _forget_days(self, deleted: Iterable[BagFile]) -> None:
        """Deletes what `memory/` has of its deleted days besides their messages."""
        spans = united((bag.start, bag.end + 1) for bag in deleted if is_thinned(bag.file))
        try:
            if spans:
                self._eraser.forget_thinned(spans)
        except (BagError, OSError) as error:
            self.stays.append(f"{THINNED_FILE}: {reason_of(error)}")

    def _request_of_lake(self, forgettings: Sequence[Forgetting]) -> None:
        """Stores what a lake has to forget."""
        if not forgettings:
            return
        try:
            FORGOTTEN.append(self._bag_dir, forgettings)
        except OSError as error:
            first_s = min(forgetting.start for forgetting in forgettings) // NS_PER_S
            last_s = -(-max(forgetting.stop for forgetting in forgettings) // NS_PER_S)
            self.stays.append(
                f"what a lake has of it: {self._bag_dir / FORGOTTEN_FILE} cannot be written "
                f"({reason_of(error)}); if these bags are shipped, run `ros2-memory ship "
                f"--forget ROBOT --start {first_s} --end {last_s}` where that is done"
            )
            return
        if (self._bag_dir / SHIPPED_FILE).exists():
            print_line("the next pass of ros2-memory ship deletes it from the lake, too")

    def _forget_derived_of(self, erasure: Erasure) -> None:
        self._memory.index.refresh()
        self._forget_derived(erasure.files)

    def _forget_derived(self, files: Iterable[str]) -> None:
        """Deletes what is derived from bags: those of these names, and those deleted earlier.

        Raises:
            BagError: some of it may still be there.
        """
        if not self._dry_run:
            names = [*files]
            for path in column_paths(self._settings):
                # Each robot of a fleet whose bags lie in one folder has a store of its own.
                for store in (path, *path.parent.glob(f"*/{path.name}")):
                    forget_columns(store, self._bag_dir, names)

    def _name(self, bag: BagFile | SetAside | Path) -> str:
        """Returns a path relative to the bag directory; one outside of it as it is."""
        path = bag if isinstance(bag, Path) else bag.path
        return str(path).removeprefix(f"{self._bag_dir}/")


def _stamp(bag: BagFile) -> tuple[str, int, Ns]:
    return bag.file, bag.size, bag.mtime_ns


def _describe_span(first: Ns, last: Ns) -> str:
    return f"from {format_time(unix_from_ns(first))} to {format_time(unix_from_ns(last))}"


def _with_other_links(bags: Sequence[BagFile]) -> set[str]:
    """Returns the bags that have further hard links, as saved moments have."""
    linked = set[str]()
    for bag in bags:
        with suppress(OSError):
            if bag.path.lstat().st_nlink > 1:
                linked.add(bag.file)
    return linked


@contextmanager
def _recorder_locked_out(bag_dir: Path) -> Iterator[str | None]:
    """Keeps recorders from starting during the block.

    Yields None; or, if a recorder holds the lock already, a sentence that says so.
    """
    try:
        lock = BagDirLock.acquire(bag_dir, patience_s=0.0)
    except RecorderError as error:
        yield str(error)
        return
    try:
        yield None
    finally:
        lock.release()
