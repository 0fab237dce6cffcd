"""`ros2-memory forget`: deletes the bags of a time window, by the means of retention."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import typer

from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.layout import METADATA_FILE, MOMENTS_FOLDER, is_kept_apart, other_form
from ros2_memory.bag_dir.lock import BagDirLock
from ros2_memory.bag_dir.metadata_yaml import take_out
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.bootstrap import build_reader, supposed_own
from ros2_memory.catalogue.store import BagKey
from ros2_memory.cli.options import (
    EXIT_NEGATIVE,
    BagDir,
    End,
    Last,
    Overrides,
    Start,
    Verbose,
    load_for,
    open_memory,
    parse_window,
    print_line,
    reported_errors,
    spinner,
)
from ros2_memory.cli.output import format_time
from ros2_memory.config import NullRecorderNode
from ros2_memory.core import directories
from ros2_memory.core.errors import (
    BagError,
    ConfigError,
    InvalidArgumentsError,
    RecorderError,
)
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import unix_from_ns
from ros2_memory.history.context import Memory
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.retention.delete import remove_bag, remove_emptied
from ros2_memory.retention.latched_carry import Carrier
from ros2_memory.storage.base import BagReader
from ros2_memory.storage.mcap.writer import McapWriter

_MB = 1_000_000


def forget(
    overrides: Overrides = None,
    *,
    start: Start = None,
    end: End = None,
    last: Last = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only say what would be deleted.")
    ] = False,
    bag_dir: BagDir = None,
    verbose: Verbose = False,
) -> None:
    """Delete the closed bags that lie wholly inside a time window, after asking.

    What reaches beyond it stays, and so do what is being written and, unless
    retention.foreign=delete, bags that this deployment's recorder did not make; all are named.
    Latched messages (maps, static transforms) that later answers need are carried on. Only where
    this deployment records.
    """
    with reported_errors("forget"):
        settings = load_for(bag_dir, overrides)
        if isinstance(settings.recorder, NullRecorderNode):
            raise ConfigError(
                "recorder=none: bags that another program records are not deleted here; choose the "
                "deployment that records them, such as deployment=robot"
            )
        if last is None and (start is None or end is None):
            raise InvalidArgumentsError("say what to forget: --start and --end, or --last")
        memory = open_memory(settings, verbose=verbose)
        snapshot = memory.index.snapshot()
        if snapshot.problem:
            raise RecorderError(snapshot.problem)
        window = parse_window(memory, start, end, last)
        bag_root = settings.recording.bag_dir
        own = supposed_own(bag_root) if settings.retention.foreign == "keep" else None
        plan = planned(snapshot, window, bag_root, own)
        carrier = Carrier(
            settings.recording.bag_dir,
            memory.reader,
            McapWriter(),
            settings.data.tf_static_topics,
        )
        stays = [*plan.stays, *_beside(memory, carrier, plan, window)]
        for line in stays:
            print_line(f"stays: {line}")
        if not plan.doomed:
            print_line("no closed bag lies wholly inside the window")
        elif dry_run:
            print_line(f"would be deleted: {_told(plan)}")
            for bag in plan.doomed:
                print_line(f"  {_named(bag.path, settings.recording.bag_dir)}")
        else:
            print_line(f"to be deleted: {_told(plan)}")
            if not yes:
                typer.confirm("Delete them? This cannot be undone.", abort=True)
            counts = _counts(build_reader(settings), plan.doomed)
            stays += _forgotten(bag_root, memory, plan, carrier, counts)
    if stays:
        raise typer.Exit(EXIT_NEGATIVE)


@dataclass(frozen=True, slots=True)
class Plan:
    """What goes, and, each with its reason, what stays of the window.

    `own` are the recordings of which something may go; all where None.
    """

    doomed: tuple[BagFile, ...]
    stays: tuple[str, ...]
    own: OwnRecordings | None = None

    @property
    def size(self) -> int:
        """The bytes of what goes."""
        return sum(bag.size for bag in self.doomed)


def planned(
    snapshot: Snapshot, window: TimeWindow, bag_dir: Path, own: OwnRecordings | None = None
) -> Plan:
    """What a window's forgetting would delete: of the recordings that are its `own`, or of all.

    Reads no bag.
    """
    touched = snapshot.overlapping(window)
    doomed = tuple(
        bag
        for bag in touched
        if bag.state is BagState.CLOSED
        and window.covers(bag.start, bag.end)
        and not _is_kept(bag, bag_dir)
        and (own is None or is_own(bag.path, own))
    )
    plan = Plan(doomed, (), own)
    return replace(plan, stays=tuple(_staying(snapshot, window, bag_dir, plan)))


def is_own(bag: Path, own: OwnRecordings) -> bool:
    """Whether the recorder made a bag file, or keeps it as carried messages or as a moment."""
    return is_kept_apart(own.name_of(bag.parent)) or own.owns(bag.parent)


def _staying(snapshot: Snapshot, window: TimeWindow, bag_dir: Path, plan: Plan) -> Iterator[str]:
    doomed = frozenset(plan.doomed)
    for bag in snapshot.overlapping(window):
        if bag not in doomed:
            yield f"{_named(bag.path, bag_dir)}: {_reason(bag, bag_dir, plan.own)}"
    for aside, place in snapshot.unread_spans.items():
        if place is not None and place.overlaps(window.start, window.stop - 1):
            if not aside.answers:
                yield f"{_named(aside.path, bag_dir)}: {aside.reason}"
        elif place is None:
            yield f"{_named(aside.path, bag_dir)}: when it was recorded is unknown ({aside.reason})"


def _reason(bag: BagFile, bag_dir: Path, own: OwnRecordings | None) -> str:
    """Why a bag stays."""
    if bag.state is BagState.ACTIVE:
        return "it is being written"
    if own is not None and not is_own(bag.path, own):
        return _foreign(bag.path, own)
    if bag.state is BagState.INCOMPLETE:
        closes = "; ros2-memory recover closes it" if bag.path.suffix == ".mcap" else ""
        return f"a crash left it open{closes}"
    if _is_kept(bag, bag_dir):
        return "it was asked to be kept; delete the moment's folder to forget it"
    return "it reaches beyond the window"


def _foreign(bag: Path, own: OwnRecordings) -> str:
    folder = own.name_of(bag.parent)
    if not folder:
        return (
            "this recorder did not make it; to forget it, move it into a directory of its own in "
            "the bag directory and let `ros2-memory adopt` take that"
        )
    return f"this recorder did not make it; to forget it, `ros2-memory adopt {folder}` first"


def _is_kept(bag: BagFile, bag_dir: Path) -> bool:
    """Whether only a moment that was to be kept still has it."""
    return bag.path.is_relative_to(bag_dir / MOMENTS_FOLDER)


def _named(path: Path, bag_dir: Path) -> str:
    return str(path.relative_to(bag_dir)) if path.is_relative_to(bag_dir) else str(path)


def _counts(reader: BagReader, doomed: Sequence[BagFile]) -> dict[Path, Counter[str]]:
    """How many messages of which topic each file holds, also those that do not count.

    For metadata.yaml; of one that cannot be read there is nothing, and then that stays.
    """
    counts: dict[Path, Counter[str]] = {}
    for bag in doomed:
        with suppress(BagError):
            held = counts.setdefault(bag.path, Counter())
            for topic in reader.summarize(bag.path).topics:
                held[topic.topic] += topic.count
    return counts


def _forgotten(
    bag_dir: Path,
    memory: Memory,
    plan: Plan,
    carrier: Carrier,
    counts: Mapping[Path, Counter[str]],
) -> list[str]:
    """Deletes what was planned, as far as it is still so; what stays all the same, and why.

    A recorder that runs carries latched messages itself, and nobody else may beside it. Bags with
    such messages stay then.
    """
    stays = []
    with spinner("deleting"), _alone(bag_dir) as recorder:
        snapshot, own = memory.index.refresh(), plan.own
        there = {*snapshot.bags}
        doomed = [
            bag for bag in plan.doomed if bag in there and (own is None or is_own(bag.path, own))
        ]
        removal = _Removal(bag_dir, memory)
        carried = None
        if recorder is None:
            carried = removal.carry(carrier, snapshot, doomed)
        else:
            latched = {*carrier.with_latched(snapshot, {bag.path for bag in doomed})}
            doomed = [bag for bag in doomed if bag not in latched]
            stays = [
                f"{_named(bag.path, bag_dir)}: it has latched messages, which nobody else may "
                f"carry on beside a recorder: {recorder}; stop it for a moment, and forget again"
                for bag in sorted(latched)
            ]
        removal.remove(doomed)
        notes = removal.correct_metadata(counts)
    print_line(
        f"deleted: {counted(removal.bags, 'bag')}, {removal.freed / _MB:.1f} MB"
        f"{'' if carried is None else f'; {_carried(carried)} on'}"
    )
    stays += removal.faults
    for line in stays:
        print_line(f"stays: {line}")
    for line in notes:
        print_line(line)
    return stays


def _carried(messages: int) -> str:
    return counted(messages, "latched message is carried", "latched messages are carried")


@contextmanager
def _alone(bag_dir: Path) -> Iterator[str | None]:
    """Within the block no recorder begins; gives who records already, None where nobody does."""
    try:
        lock = BagDirLock.acquire(bag_dir, patience_s=0.0)
    except RecorderError as error:
        yield str(error)
        return
    try:
        yield None
    finally:
        lock.release()


def _told(plan: Plan) -> str:
    first, last = min(bag.start for bag in plan.doomed), max(bag.end for bag in plan.doomed)
    return (
        f"{counted(len(plan.doomed), 'bag')}, {plan.size / _MB:.1f} MB, from "
        f"{format_time(unix_from_ns(first))} to {format_time(unix_from_ns(last))}"
    )


def _beside(memory: Memory, carrier: Carrier, plan: Plan, window: TimeWindow) -> Iterator[str]:
    """What of the window outlives its bags elsewhere."""
    with suppress(BagError):
        held = [
            topic.topic
            for topic in memory.reader.summarize(carrier.path).topics
            if window.overlaps(topic.first, topic.last)
        ]
        if held:
            yield f"latched messages that later answers need, in {carrier.path}: {', '.join(held)}"
    kept = [bag for bag in plan.doomed if _names(bag.path) > 1]
    if kept:
        yield (
            f"{counted(len(kept), 'bag')} of these under other names too, as in moments that were "
            "to be kept: delete the moment's folder to forget it"
        )


def _names(path: Path) -> int:
    try:
        return path.lstat().st_nlink
    except OSError:
        return 0


@dataclass(slots=True)
class _Removal:
    """Removes bags, their other forms, their recordings, and what the catalogue knows of them."""

    bag_dir: Path
    memory: Memory
    bags: int = 0
    freed: int = 0
    faults: list[str] = field(default_factory=list)
    gone: list[BagFile] = field(default_factory=list)

    def carry(self, carrier: Carrier, snapshot: Snapshot, doomed: Sequence[BagFile]) -> int | None:
        """Carries latched messages on; how many, where their bag was written anew.

        Raises:
            BagError: that cannot be done; nothing is deleted then.
        """
        kept = {bag.path for bag in doomed if _names(bag.path) > 1}
        return carrier.carry(snapshot, {bag.path for bag in doomed}, kept)

    def remove(self, doomed: Sequence[BagFile]) -> None:
        """Deletes them; what cannot be deleted is among the faults."""
        gone = []
        for bag in doomed:
            try:
                self._delete(bag)
            except OSError as error:
                self.faults.append(f"{bag.path}: {error}")
            else:
                gone.append(bag)
        self.bags += len(gone)
        self.gone += gone
        heartbeat = read_heartbeat(self.bag_dir).heartbeat
        named = {self.bag_dir / name for name in heartbeat.recordings} if heartbeat else set()
        for recording in {bag.recording for bag in gone} - named:
            try:
                remove_emptied(self.bag_dir, recording)
            except OSError as error:
                self.faults.append(f"{recording}: {error}")
        if self.memory.recall is not None:
            paths = [BagKey.of(bag, self.bag_dir).path for bag in gone]
            self.memory.recall.catalogue.forget(paths)

    def correct_metadata(self, counts: Mapping[Path, Counter[str]]) -> list[str]:
        """Has metadata.yaml of each recording list what is left of it; what there is to say.

        That of a recording that is being written is its recorder's, who writes it at the end.
        """
        heartbeat = read_heartbeat(self.bag_dir).heartbeat
        open_ones = {self.bag_dir / name for name in heartbeat.recordings} if heartbeat else set()
        said = []
        for recording in sorted({bag.recording for bag in self.gone}):
            name = f"{_named(recording, self.bag_dir)}/{METADATA_FILE}"
            if recording in open_ones and not (recording / METADATA_FILE).exists():
                said.append(f"{name} will list what was deleted: its recorder writes it at the end")
                continue
            gone = {
                bag.path.name: counts.get(bag.path, Counter[str]())
                for bag in self.gone
                if bag.recording == recording
            }
            try:
                with directories.opened(self.bag_dir, recording):
                    lists = take_out(recording, gone)
                if lists:
                    said.append(f"{name} lists what is left")
            except FileNotFoundError:
                continue  # the recording has gone, and its metadata.yaml with it
            except (OSError, ValueError) as error:
                said.append(
                    f"{name} still lists what was deleted ({error}); rosbag2 opens the folder "
                    f"after `ros2 bag reindex {recording}`"
                )
        return said

    def _delete(self, bag: BagFile) -> None:
        for path in (bag.path, Path(other_form(bag.file))):
            with suppress(FileNotFoundError):
                status = path.lstat()
                inode = (status.st_dev, status.st_ino)
                self.freed += remove_bag(self.bag_dir, path, inode)
