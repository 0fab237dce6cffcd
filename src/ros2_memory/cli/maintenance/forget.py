"""`ros2-memory forget`: deletes the bags of a time window, or some messages of them.

Whole bags are deleted as retention deletes them. What is deleted and what is kept is decided first,
without reading a bag. Then the bags are deleted, after the latched messages that later answers need
were carried forward.

Messages of topics, or of the time in which the robot was in a place, are taken out of the bags that
hold them (`retention.eraser`).
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import typer

from ros2_memory.bag_dir.handover_file import Handover, read_handover
from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.layout import (
    ERASING_FILE,
    FORGOTTEN_FILE,
    LOCK_FILE,
    METADATA_FILE,
    MOMENTS_FOLDER,
    SHIPPED_FILE,
    other_form,
)
from ros2_memory.bag_dir.lock import BagDirLock
from ros2_memory.bag_dir.metadata_yaml import take_out
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bag_dir.state_files import ERASING, FORGOTTEN, Erasure, Forgetting, ForgottenBag
from ros2_memory.bootstrap import build_reader, column_paths, delete_catalogues
from ros2_memory.cli.options import (
    EXIT_NEGATIVE,
    MB,
    AsJson,
    BagDir,
    Overrides,
    Times,
    Verbose,
    collect_lines,
    load_for,
    open_memory,
    print_line,
    require_recorder,
    spinner,
)
from ros2_memory.cli.output import format_time
from ros2_memory.columns.forget import forget as forget_columns
from ros2_memory.config import Settings
from ros2_memory.core import directories
from ros2_memory.core.errors import (
    BagError,
    InvalidArgumentsError,
    RecorderError,
)
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.text import counted, listed, match_topics
from ros2_memory.core.timebase import MAX_NS, NS_PER_S, Ns, unix_from_ns
from ros2_memory.history.context import Call, Memory
from ros2_memory.history.view import open_view
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.places.scope import times_in_region
from ros2_memory.places.where import parse_where
from ros2_memory.retention.delete import remove_bag, remove_emptied
from ros2_memory.retention.eraser import Eraser, Survey
from ros2_memory.retention.latched_carry import Carrier
from ros2_memory.storage.base import BagReader
from ros2_memory.storage.mcap.writer import McapWriter

PLACE_MARGIN_NS: Final[Ns] = NS_PER_S
"""Messages so long before the robot entered a place, and after it left, go too."""


def forget(
    overrides: Overrides = None,
    *,
    times: Times,
    topic: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GLOB", help="Delete only messages of these topics, from all bags; repeatable."
        ),
    ] = None,
    where: Annotated[
        str | None,
        typer.Option(
            metavar="PLACE", help="Delete only messages from when the robot was in a named place."
        ),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show what would be deleted, and delete nothing.")
    ] = False,
    as_json: AsJson = False,
    bag_dir: BagDir = None,
    verbose: Verbose = False,
) -> None:
    """Delete the closed bags that lie wholly inside a time window, after confirmation.

    All messages in a file count, also copies that another recording has.

    With --topic or --where, forget removes messages from the bags instead, and every other message
    stays as it is. If it is interrupted, the next `forget` finishes the work and says so.

    Kept, and named: bags that reach beyond the window, bags being written, and bags that this
    deployment's recorder did not make (unless retention.foreign=delete). Latched messages (maps,
    static transforms) that later answers need are copied forward. Works only where this deployment
    records.
    """
    collect_lines(as_json, is_answered=yes or dry_run)
    settings = load_for(bag_dir, overrides)
    require_recorder(settings)
    if times.last is None and None in (times.start, times.end):
        raise InvalidArgumentsError("give a time window: --start and --end, or --last")
    memory = open_memory(settings, verbose=verbose)
    snapshot = memory.index.snapshot()
    if snapshot.problem:
        raise RecorderError(snapshot.problem)
    window = times.window(memory)
    taking = _Taking(settings, memory, _recorder_of(settings.recording.bag_dir), dry_run=dry_run)
    interrupted = taking.finish()
    if topic or where is not None:
        wanted, lines = taking.wanted(window, topic or (), where)
        if taking.take(wanted, lines, ask=not yes) or interrupted:
            raise typer.Exit(EXIT_NEGATIVE)
        return
    plan = plan_deletion(settings, memory.index.snapshot(), window, build_reader(settings))
    carrier = taking.carrier
    kept = [*plan.kept, *_kept_elsewhere(memory, carrier, plan, window)]
    _print_kept(kept)
    if not plan.to_delete:
        print_line(
            "nothing to delete: each bag with messages in the window stays, for the reason above"
            if plan.kept
            else "nothing to delete: no closed bag has messages in the window"
        )
        # Of bags that retention deleted, something derived may be left.
        _forget_derived(settings, (), dry_run=dry_run)
    elif dry_run:
        print_line(f"would be deleted: {_describe(plan)}")
        for bag in plan.to_delete:
            print_line(f"  {_name(bag.path, plan.bag_dir)}")
    else:
        print_line(f"to be deleted: {_describe(plan)}")
        if not yes:
            typer.confirm("Delete them? This cannot be undone.", abort=True)
        contents = _contents(build_reader(settings), plan.to_delete)
        kept += _delete(settings, memory, plan, carrier, contents)
    if kept or interrupted:
        raise typer.Exit(EXIT_NEGATIVE)


class _Taking:
    """Takes messages out of bags.

    Args:
        settings: of this deployment.
        memory: over its bags.
        recorder: why a recorder holds the bag directory; None where none does.
        dry_run: whether it only reports what it would do.
    """

    def __init__(
        self, settings: Settings, memory: Memory, recorder: str | None, *, dry_run: bool
    ) -> None:
        self._settings = settings
        self._memory = memory
        self._recorder = recorder
        self._dry_run = dry_run
        self._bag_dir = settings.recording.bag_dir
        snapshot = memory.index.snapshot()
        written = {aside.path: snapshot.unread_spans[aside] for aside in snapshot.active}
        for bag in snapshot.bags:
            if bag.state is BagState.ACTIVE:
                written[bag.path] = TimeWindow(bag.start, MAX_NS)
        own = OwnRecordings(self._bag_dir)
        self.carrier = Carrier(
            self._bag_dir, memory.reader, McapWriter(), settings.data.tf_static_topics, own
        )
        self._eraser = Eraser(
            self._bag_dir,
            build_reader(settings),
            McapWriter(),
            own if settings.retention.foreign == "keep" else None,
            written=written,
            recorder=recorder,
        )

    def finish(self) -> bool:
        """Finishes an erasure that was interrupted; returns whether something of it stays."""
        try:
            begun = ERASING.read(self._bag_dir)
        except ValueError as error:
            raise RecorderError(
                f"{self._bag_dir / ERASING_FILE}: {error}; an earlier forget was interrupted: "
                "delete the file, and forget again what was to go"
            ) from error
        if begun is None:
            return False
        print_line(f"an earlier forget was interrupted: {_describe_erasure(begun)}")
        return self.take(begun, [], ask=False)

    def wanted(
        self, window: TimeWindow, globs: Sequence[str], where: str | None
    ) -> tuple[Erasure, list[str]]:
        """Returns what is asked for, and a line for each part of it that stays.

        Raises:
            InvalidArgumentsError: no such place is named, or no topic matches.
        """
        lines: list[str] = []
        windows = [window]
        if where is not None:
            with spinner(f"looking when the robot was in {where}"):
                view = open_view(self._memory, Call(), None)
                place = parse_where(self._memory.limits, where)
                times = times_in_region(view, place, window)
            around = [
                TimeWindow(each.start - PLACE_MARGIN_NS, each.stop + PLACE_MARGIN_NS + 1)
                for each in times
            ]
            windows = [each.intersect(window) for each in around]
            lines += [f"what is not known: {each}" for each in view.notes.sentences()]
        with spinner("looking which topics there are"):
            known = self._eraser.topics()
        latched = known.intersection(self.carrier.topics(self._memory.index.snapshot()))
        if globs:
            topics = {each for glob in globs for each in match_topics(known, glob)}
            if not topics:
                raise InvalidArgumentsError(f"no recorded topic is named {listed([*globs])}")
        else:
            topics = {*known} - latched
            if latched and windows:
                print_line(
                    "latched messages stay, because they are valid later, too (name a topic to "
                    f"forget it): {listed(sorted(latched))}"
                )
        if self._recorder is not None and topics & latched:
            lines.append(
                f"{listed(sorted(topics & latched))}: latched messages, which the recorder carries "
                f"on: {self._recorder}; stop the recorder, and forget again"
            )
            topics -= latched
        return Erasure.of(topics, windows, topics & latched), lines

    def take(self, erasure: Erasure, lines: Sequence[str], *, ask: bool) -> bool:
        """Takes messages out, after asking; returns whether something of them stays."""
        kept = [*lines]
        survey = Survey((), ())
        if erasure.topics and erasure.windows:
            with spinner("looking which bags hold some"):
                survey = self._eraser.survey(erasure)
        kept += survey.kept
        _print_kept(kept)
        if not survey.holders and not erasure.files:
            print_line("no such message is in the window")
            # Of bags that retention deleted, something derived may be left.
            _forget_derived(self._settings, (), dry_run=self._dry_run)
            return bool(kept)
        size = sum(path.stat().st_size for path in {each.paths[0] for each in survey.holders})
        what = (
            f"{counted(survey.counts.total(), 'message')} of "
            f"{counted(len(survey.counts), 'topic')}, by rewriting "
            f"{counted(len(survey.holders), 'bag')} ({size / MB:.1f} MB)"
        )
        print_line(f"would be deleted: {what}" if self._dry_run else f"to be deleted: {what}")
        for topic, count in sorted(survey.counts.items()):
            print_line(f"  {topic}: {counted(count, 'message')}")
        if self._dry_run:
            return bool(kept)
        if ask:
            typer.confirm("Delete them? This cannot be undone.", abort=True)
        with spinner("deleting"), _recorder_locked_out(self._bag_dir) as recorder:
            if recorder is not None and self._recorder is None:
                raise RecorderError(f"nothing was deleted: {recorder}; forget again")
            kept_by_lake = _request_of_lake(
                self._bag_dir, [Forgetting(*each, erasure.topics) for each in erasure.windows]
            )
            result = self._eraser.erase(erasure, survey, self._forget_derived)
        print_line(
            "not all is deleted" if result.kept else f"deleted: {survey.counts.total()} messages"
        )
        _print_kept([*result.kept, *kept_by_lake])
        for note in result.notes:
            print_line(note)
        return bool(kept or result.kept or kept_by_lake)

    def _forget_derived(self, erasure: Erasure) -> None:
        self._memory.index.refresh()
        _forget_derived(self._settings, erasure.files)


def _forget_derived(settings: Settings, files: Sequence[str], *, dry_run: bool = False) -> None:
    """Deletes what is derived from bags, and from those that retention deleted before.

    Args:
        settings: of this deployment.
        files: the bags, by their paths in the bag directory.
        dry_run: whether nothing is to be deleted.

    Raises:
        BagError: some of it may still be there.
    """
    if dry_run:
        return
    delete_catalogues(settings)
    for path in column_paths(settings):
        forget_columns(path, settings.recording.bag_dir, files)


def _describe_erasure(erasure: Erasure) -> str:
    first, last = erasure.windows[0][0], erasure.windows[-1][1]
    span = TimeWindow(first, last)
    ends = [format_time(unix_from_ns(each)) for each in span.asked()]
    return f"{listed(erasure.topics)} from {ends[0]} to {ends[1]}"


@dataclass(frozen=True, slots=True)
class Plan:
    """The bags of a window that are deleted, and a line with the reason for each that is kept.

    `own` are the recordings of which bags may be deleted; None: all.
    """

    bag_dir: Path
    own: OwnRecordings | None
    to_delete: tuple[BagFile, ...]
    kept: tuple[str, ...]


def plan_deletion(
    settings: Settings, snapshot: Snapshot, window: TimeWindow, reader: BagReader
) -> Plan:
    """Decides what is deleted of a window; `reader` reads files as they are.

    Only bags are read of which some messages do not count.
    """
    bag_dir = settings.recording.bag_dir
    own = OwnRecordings(bag_dir) if settings.retention.foreign == "keep" else None
    to_delete: list[BagFile] = []
    kept: list[str] = []
    for bag in _raw_bags(snapshot, reader):
        if not window.overlaps(bag.start, bag.end):
            continue
        reason = _reason_to_keep(bag, window, bag_dir, own)
        if reason is None:
            to_delete.append(bag)
        else:
            kept.append(f"{_name(bag.path, bag_dir)}: {reason}")
    deleted_too = {other_form(bag.file) for bag in to_delete}
    for aside, span in {**snapshot.unread_spans, **snapshot.unread_bounds}.items():
        if str(aside.path) in deleted_too:
            continue
        name = _name(aside.path, bag_dir)
        if span is None:
            kept.append(f"{name}: when it was recorded is unknown ({aside.reason})")
        elif span.overlaps(window.start, window.stop - 1) and not aside.answers:
            kept.append(f"{name}: {aside.reason}")
    return Plan(bag_dir, own, tuple(to_delete), tuple(kept))


def _raw_bags(snapshot: Snapshot, reader: BagReader) -> Iterator[BagFile]:
    """Yields the bags with the times of all messages in them, also of those that do not count."""
    handovers: dict[Path, Handover] = {}
    for bag in snapshot.bags:
        folder = bag.recording
        if bag.sidecar_ns and folder not in handovers:
            handovers[folder] = read_handover(folder).handover
        if bag.sidecar_ns and handovers[folder].rule(bag.path.name) is not None:
            with suppress(BagError):
                summary = reader.summarize(bag.path)
                yield bag._replace(start=summary.start, end=summary.end)
                continue
        yield bag
    for path in snapshot.empty:
        with suppress(BagError, OSError):
            summary, status = reader.summarize(path), path.lstat()
            if not summary.empty:
                stamp = str(path), status.st_size, status.st_mtime_ns
                yield BagFile(*stamp, BagState.CLOSED, summary, summary.start, summary.end)


def _reason_to_keep(
    bag: BagFile, window: TimeWindow, bag_dir: Path, own: OwnRecordings | None
) -> str | None:
    if bag.state is BagState.ACTIVE:
        return "it is being written"
    if not window.covers(bag.start, bag.end):
        return "it reaches beyond the window"
    if not _may_delete(bag, own):
        folder = own.name_of(bag.path.parent) if own is not None else ""
        if folder:
            adopt = f"`ros2-memory adopt {folder}` first"
        else:
            adopt = (
                "move it into a directory of its own in the bag directory and let "
                "`ros2-memory adopt` take that"
            )
        return f"this recorder did not make it; to forget it, {adopt}"
    if bag.state is BagState.INCOMPLETE:
        closes = "; ros2-memory recover closes it" if bag.path.suffix == ".mcap" else ""
        return f"a crash left it open{closes}"
    if bag.path.is_relative_to(bag_dir / MOMENTS_FOLDER):
        return "it belongs to a saved moment; delete the moment's folder to forget it"
    return None


def _may_delete(bag: BagFile, own: OwnRecordings | None) -> bool:
    """Returns whether the recorder made a bag, or keeps it (carried messages, saved moments)."""
    return own is None or own.owns_bag(bag.path)


def _name(path: Path, bag_dir: Path) -> str:
    """Returns a path as people know it: relative to the bag directory, if it is in there."""
    return str(path.relative_to(bag_dir)) if path.is_relative_to(bag_dir) else str(path)


def _print_kept(lines: Sequence[str]) -> None:
    for line in lines:
        print_line(f"stays: {line}")


def _describe(plan: Plan) -> str:
    first, last = min(bag.start for bag in plan.to_delete), max(bag.end for bag in plan.to_delete)
    size = sum(bag.size for bag in plan.to_delete)
    return (
        f"{counted(len(plan.to_delete), 'bag')}, {size / MB:.1f} MB, from "
        f"{format_time(unix_from_ns(first))} to {format_time(unix_from_ns(last))}"
    )


def _kept_elsewhere(
    memory: Memory, carrier: Carrier, plan: Plan, window: TimeWindow
) -> Iterator[str]:
    """Yields what of the window remains readable without the bags that are deleted."""
    with suppress(BagError):
        carried = [
            topic.topic
            for topic in memory.reader.summarize(carrier.path).topics
            if window.overlaps(topic.first, topic.last)
        ]
        if carried:
            topics = ", ".join(carried)
            yield f"latched messages that later answers need, in {carrier.path}: {topics}"
    linked = _with_other_links(plan.to_delete)
    if linked:
        yield (
            f"{counted(len(linked), 'bag')} of these, also in saved moments or "
            "under other names: delete the moment's folder to forget it"
        )


def _with_other_links(bags: Sequence[BagFile]) -> set[Path]:
    """Returns the bags that have further hard links, as saved moments have."""
    linked = set()
    for bag in bags:
        with suppress(OSError):
            if bag.path.lstat().st_nlink > 1:
                linked.add(bag.path)
    return linked


def _contents(
    reader: BagReader, bags: Sequence[BagFile]
) -> tuple[dict[Path, Counter[str]], dict[Path, Ns]]:
    """Returns the messages of each topic in each file, and the log time of its first message.

    Also those that do not count in answers: `metadata.yaml` lists them. A file that cannot be read
    is left out.
    """
    counts: dict[Path, Counter[str]] = {}
    firsts: dict[Path, Ns] = {}
    for bag in bags:
        with suppress(BagError):
            in_file = counts.setdefault(bag.path, Counter())
            summary = reader.summarize(bag.path)
            for topic in summary.topics:
                in_file[topic.topic] += topic.count
            if not summary.empty:
                firsts[bag.path] = summary.start
    return counts, firsts


def _delete(
    settings: Settings,
    memory: Memory,
    plan: Plan,
    carrier: Carrier,
    contents: tuple[Mapping[Path, Counter[str]], Mapping[Path, Ns]],
) -> list[str]:
    """Deletes the planned bags that are still there; returns a line for each that is kept.

    A live recorder carries latched messages itself, and two programs must not do so at a time.
    Bags with such messages are kept then.

    Raises:
        BagError: latched messages cannot be carried; nothing is deleted then.
    """
    kept: list[str] = []
    counts, firsts = contents
    with spinner("deleting"), _recorder_locked_out(plan.bag_dir) as recorder:
        snapshot = memory.index.refresh()
        present = {bag[:3] for bag in _raw_bags(snapshot, build_reader(settings))}
        bags = [bag for bag in plan.to_delete if bag[:3] in present and _may_delete(bag, plan.own)]
        carried = None
        if recorder is None:
            paths = {bag.path for bag in bags}
            carried = carrier.carry(snapshot, paths, _with_other_links(bags))
        else:
            latched = {*carrier.with_latched(snapshot, {bag.path for bag in bags})}
            bags = [bag for bag in bags if bag not in latched]
            kept = [
                f"{_name(bag.path, plan.bag_dir)}: it has latched messages, which only the "
                f"recorder may copy forward while it runs: {recorder}; stop the recorder, and "
                "forget again"
                for bag in sorted(latched)
            ]
        kept += [
            f"what a lake has of {_name(bag.path, plan.bag_dir)}, which cannot be read"
            for bag in bags
            if bag.path not in firsts
        ]
        kept += _request_of_lake(plan.bag_dir, [*_forgetting_of(bags, firsts)])
        deleted, freed = _delete_files(plan.bag_dir, bags, kept)
        reported_open = read_heartbeat(plan.bag_dir).recordings
        open_recordings = {plan.bag_dir / name for name in reported_open}
        for recording in {bag.recording for bag in deleted} - open_recordings:
            try:
                remove_emptied(plan.bag_dir, recording)
            except OSError as error:
                kept.append(f"{recording}: {error}")
        try:
            _forget_derived(settings, [_name(bag.path, plan.bag_dir) for bag in deleted])
        except BagError as error:
            kept.append(error.reason)
        notes = [*_correct_metadata(plan, deleted, open_recordings, counts)]
    line = f"deleted: {counted(len(deleted), 'bag')}, {freed / MB:.1f} MB"
    if carried is not None:
        messages = counted(carried, "latched message is", "latched messages are")
        line += f"; {messages} carried on"
    print_line(line)
    _print_kept(kept)
    for note in notes:
        print_line(note)
    return kept


def _forgetting_of(bags: Sequence[BagFile], firsts: Mapping[Path, Ns]) -> Iterator[Forgetting]:
    known = [bag for bag in bags if bag.path in firsts]
    if known:
        yield Forgetting(
            min(min(firsts[bag.path], bag.start) for bag in known),
            max(bag.end for bag in known) + 1,
            bags=tuple(
                ForgottenBag(bag.recording.name, bag.path.name, firsts[bag.path]) for bag in known
            ),
        )


def _request_of_lake(bag_dir: Path, forgettings: Sequence[Forgetting]) -> list[str]:
    """Stores what a lake has to forget; returns a line on what the lake keeps if it cannot."""
    if not forgettings:
        return []
    try:
        FORGOTTEN.append(bag_dir, forgettings)
    except OSError as error:
        first = min(each.start for each in forgettings) // NS_PER_S
        last = -(-max(each.stop for each in forgettings) // NS_PER_S)
        line = (
            f"what a lake has of it: {bag_dir / FORGOTTEN_FILE} cannot be written "
            f"({error.strerror or error}); if these bags are shipped, run `ros2-memory ship "
            f"--forget ROBOT --start {first} --end {last}` where that is done"
        )
        return [line]
    if (bag_dir / SHIPPED_FILE).exists():
        print_line("the next pass of ros2-memory ship deletes it from the lake, too")
    return []


def _recorder_of(bag_dir: Path) -> str | None:
    """Returns why a recorder holds the bag directory; None where none does. Writes nothing."""
    if not (bag_dir / LOCK_FILE).exists():
        return None
    with _recorder_locked_out(bag_dir) as recorder:
        return recorder


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


def _delete_files(
    bag_dir: Path, bags: Sequence[BagFile], kept: list[str]
) -> tuple[list[BagFile], int]:
    """Deletes bags in every form; returns those deleted and their bytes, adds faults to `kept`."""
    deleted, freed = [], 0
    for bag in bags:
        try:
            for path in (bag.path, Path(other_form(bag.file))):
                with suppress(FileNotFoundError):
                    status = path.lstat()
                    freed += remove_bag(bag_dir, path, (status.st_dev, status.st_ino))
        except OSError as error:
            kept.append(f"{bag.path}: {error}")
        else:
            deleted.append(bag)
    return deleted, freed


def _correct_metadata(
    plan: Plan,
    deleted: Sequence[BagFile],
    open_recordings: Collection[Path],
    counts: Mapping[Path, Counter[str]],
) -> Iterator[str]:
    """Takes deleted bags out of each recording's metadata.yaml; yields a line for each.

    That of an open recording is left to its recorder, which writes it at the end.
    """
    for recording in sorted({bag.recording for bag in deleted}):
        name = f"{_name(recording, plan.bag_dir)}/{METADATA_FILE}"
        if recording in open_recordings and not (recording / METADATA_FILE).exists():
            yield f"{name} will list deleted bags: the recorder writes it at the end"
            continue
        of_recording = {
            bag.path.name: counts.get(bag.path, Counter[str]())
            for bag in deleted
            if bag.recording == recording
        }
        try:
            with directories.opened(plan.bag_dir, recording):
                is_listed = take_out(recording, of_recording)
            if is_listed:
                yield f"{name} lists the remaining bags"
        except FileNotFoundError:
            continue  # the recording was deleted, and its metadata.yaml with it
        except (OSError, ValueError) as error:
            yield (
                f"{name} still lists deleted bags ({error}); rosbag2 opens the folder "
                f"after `ros2 bag reindex {recording}`"
            )
