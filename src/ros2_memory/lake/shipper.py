"""Ships closed bags into a lake, each exactly once.

A bag is in the lake once it has a row in `bags`. For each batch, one transaction in each table
replaces the rows of the batch's bags, also those that an earlier attempt left. `bags` is committed
last, then the receipts are written. So every row is there once, even if a process is killed and
runs again. Only the lake itself is asked what it has.
"""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field
from functools import cache, partial
from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

import pyarrow as pa

from ros2_memory.bag_dir.layout import FORGOTTEN_FILE, MOMENTS_FOLDER, has_recorded, is_derived
from ros2_memory.bag_dir.state_files import (
    Receipt,
    append_receipts,
    is_shipped,
    read_forgettings,
    read_receipts,
)
from ros2_memory.columns.fill import is_settled
from ros2_memory.columns.forget import forget as forget_columns
from ros2_memory.columns.store import relative
from ros2_memory.columns.writing import PART_NS
from ros2_memory.core.errors import BagError, BusyError, EpisodicError, LakeError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import BagFile, BagState, TimeWindow
from ros2_memory.core.timebase import MAX_NS, NS_PER_DAY, Clock, Ns, utc_day
from ros2_memory.lake.rows import RowMaker, bag_id_of, sha256_of
from ros2_memory.lake.tables import TABLES, ShippedBag, bags_condition, window_condition
from ros2_memory.lake.upkeep import Tombstone, compact, expire, forget_in_lake

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.columns.fill import Batch, Filling
    from ros2_memory.history.context import Memory
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.lake.warehouse import LakeTables
    from ros2_memory.storage.base import BagReader

log = get_logger(__name__)

MOST_BAGS: Final = 2_000
"""Bags of one batch."""
MOST_BYTES: Final = 64 << 20
"""Bytes of one batch, whose rows are in memory until it is committed."""
_GROUP: Final = 64
"""Bags that are looked at together: messages read around one bag are needed for the next."""
PATIENCE_S: Final = 30.0
"""How long a bag directory may take to answer."""
_BESIDE_NS: Final[Ns] = NS_PER_DAY
"""The lake may have a bag with a begin or end so far away: more of its messages counted then."""


@dataclass(slots=True)
class Shipped:
    """What a pass did.

    Attributes:
        bags: how many bags were committed, with so many `rows`.
        forgotten: how many bags were deleted from the lake.
        waiting: how many bags are not shipped yet since they are open, or too new.
        problems: a sentence for each fault.
    """

    bags: int = 0
    forgotten: int = 0
    rows: int = 0
    waiting: int = 0
    problems: list[str] = field(default_factory=list)


class _KnownState(NamedTuple):
    """The id of a bag, while its size, mtime and sidecar are the same.

    `is_forgotten`: whether it has messages that were forgotten.
    """

    state: tuple[int, Ns, Ns]
    bag_id: str
    is_forgotten: bool


class _BagToShip(NamedTuple):
    """A bag, its row in `bags`, and the rows that it replaces, perhaps of other days and ids."""

    file: BagFile
    bag: ShippedBag
    replaced: Sequence[ShippedBag]


class _PreparedBags(NamedTuple):
    """Bags of one robot, and their rows."""

    robot: RobotBags
    bags: Sequence[_BagToShip]
    rows: Mapping[str, pa.Table]


@dataclass(eq=False, repr=False)
class Shipper:
    """Ships the bags of several robots into one lake, whose lock the caller holds.

    Args:
        lake: the tables of the lake.
        robots: the robots whose bags are shipped.
        clock: dates the receipts.
        tombstones: the forgotten times; a bag with a forgotten message is not shipped.
        before_commit: called with whether the batch is full; may wait with a small batch.
        alive: called for each bag.
        most_bags: how many bags a commit may have.
        patience_s: a bag directory that takes longer to answer is passed over.

    Attributes:
        done: what the current pass has done, or the last one.
    """

    lake: LakeTables
    robots: Sequence[RobotBags]
    clock: Clock
    _: KW_ONLY
    tombstones: set[Tombstone] = field(default_factory=set)
    before_commit: Callable[[bool], object] = lambda _: None
    alive: Callable[[], object] = lambda: None
    most_bags: int = MOST_BAGS
    patience_s: float = PATIENCE_S

    def __post_init__(self) -> None:
        """Takes the robots over, and forgets what an earlier shipper knew of them."""
        self.done = Shipped()
        for robot in self.robots:
            robot.shipper = self
        self.look_again()

    def look_again(self) -> None:
        """Makes the next pass look at all bags again, in the directories and in the lake."""
        for robot in self.robots:
            robot.look_again()

    def run(self) -> Shipped:
        """Ships all new bags, in one pass over all robots.

        Raises:
            LakeError: the lake cannot be read or written; the next pass tries again.
        """
        self.done = Shipped()
        batch: list[_PreparedBags] = []
        size = bags = 0
        robots = [robot for robot in self.robots if self._forget(robot)]
        for prepared in chain.from_iterable(robot.prepare() for robot in robots):
            batch.append(prepared)
            bags += len(prepared.bags)
            size += sum(rows.nbytes for rows in prepared.rows.values())
            if bags >= self.most_bags or size >= MOST_BYTES:
                self._commit(batch, is_full=True)
                batch, size, bags = [], 0, 0
        if batch:
            self._commit(batch, is_full=False)
        return self.done

    def keep_up(self, grace: Ns) -> None:
        """Compacts closed days, and deletes files that no version of `grace` ago or later needs.

        Stored columns of bags that are gone are deleted, too.

        Raises:
            LakeError: the lake cannot be read or written.
        """
        for robot in self.robots:
            if robot.answers(self.patience_s):
                robot.keep_up()
        now = self.clock.now()
        compact(self.lake, now, self.alive)
        expire(self.lake, now - grace if grace else MAX_NS)

    def _forget(self, robot: RobotBags) -> bool:
        """Deletes from the lake the messages that were forgotten in a robot's bag directory.

        Returns False if these are not known: then nothing of the robot may be shipped.

        Raises:
            LakeError: the lake cannot be written; it is finished when the lake is opened again.
        """
        if not robot.answers(self.patience_s):
            why = "does not answer: is its disk reachable? Until it does, nothing of it is shipped"
            robot.report(f"{robot.bag_dir} {why}")
            return False
        try:
            wanted = [*map(partial(Tombstone.of, robot.name), read_forgettings(robot.bag_dir))]
        except (OSError, ValueError) as error:
            why = "until it is repaired, since what was forgotten could come back"
            file = f"{robot.bag_dir / FORGOTTEN_FILE}: {error}"
            robot.report(f"{file}; nothing of this robot is shipped {why}")
            return False
        new = [tombstone for tombstone in wanted if tombstone not in self.tombstones]
        # Before the tombstones: after a kill these repeat the deletion in the lake, not this one.
        self.done.problems += robot.forget([tombstone.window for tombstone in new])
        for tombstone in new:
            self.alive()
            gone = forget_in_lake(self.lake, tombstone)
            self.done.forgotten += gone.bags
            for name in gone.kept_by:
                robot.report(f"a branch or tag keeps what was forgotten: {name}")
            self.tombstones.add(tombstone)
        if new:
            self.look_again()
        return True

    def _commit(self, batch: Sequence[_PreparedBags], *, is_full: bool) -> None:
        """Commits a batch.

        Raises:
            LakeError: the lake cannot be written; it is not known how far that came.
        """
        self.before_commit(is_full)
        to_ship = [to_ship for prepared in batch for to_ship in prepared.bags]
        bags = [bag for one in to_ship for bag in (one.bag, *one.replaced)]
        condition = bags_condition({(bag.robot, bag.day, bag.bag_id) for bag in bags})
        rows = 0
        try:
            for name in TABLES:
                whole = pa.concat_tables([prepared.rows[name] for prepared in batch])
                rows += whole.num_rows
                self.lake.replace(name, condition, whole)
        except LakeError:
            self.look_again()
            raise
        self.done.bags += len(to_ship)
        self.done.rows += rows
        log.info("bags_shipped", bags=len(to_ship), rows=rows)
        for prepared in batch:
            robot = prepared.robot
            for one in prepared.bags:
                for bag in one.replaced:
                    robot.known.pop(bag.bag_id, None)
            robot.confirm([one.bag for one in prepared.bags])


@dataclass(eq=False, repr=False)
class RobotBags:
    """One robot whose bags are shipped, and what is known of its bags.

    `_states` has the newest state of each bag by its file, `known` the rows in the lake by id, and
    `_confirmed` the bags with a receipt. Bags that are gone are dropped: a hub runs for years.

    Attributes:
        name: the name of the robot.
        memory: the memory over its bag directory.
        reader: reads whole files, also messages that count in another recording.
        config: names the settings that rows depend on.
        messages: the topics whose messages are shipped whole.
        filling: stores the columns of bags, from which rows are made; None: each kind of row reads
            the bags anew.
        shipper: ships the bags at present.
    """

    name: str
    memory: Memory
    reader: BagReader
    config: str
    messages: Sequence[str] = ()
    filling: Filling | None = None
    shipper: Shipper = field(init=False)
    _looking: threading.Thread | None = field(default=None, init=False)

    def answers(self, patience_s: float) -> bool:
        """Returns whether the bag directory can be listed.

        A hanging mount, as of a robot that is gone, blocks one thread, however often it is asked.
        """
        if self._looking is None or not self._looking.is_alive():
            # A daemon: it must not keep the program from ending.
            self._looking = threading.Thread(target=_list_one, args=(self.bag_dir,), daemon=True)
            self._looking.start()
            self._looking.join(patience_s)
        return not self._looking.is_alive()

    @property
    def bag_dir(self) -> Path:
        """The bag directory."""
        return self.memory.bag_dir

    def report(self, problem: object) -> None:
        """Adds a problem of the robot to the pass, unless it is known."""
        sentence, problems = f"{self.name}: {problem}", self.shipper.done.problems
        if sentence not in problems:
            problems.append(sentence)

    def name_of(self, bag: BagFile) -> str:
        """Returns the path of a bag below the bag directory."""
        return relative(bag.file, str(self.bag_dir))

    def look_again(self) -> None:
        """Forgets the states and rows of all bags."""
        self._states: dict[str, _KnownState] = {}
        self.known: dict[str, ShippedBag] = {}
        self._confirmed: set[ShippedBag] = set()

    def keep_up(self) -> None:
        """Deletes stored columns of bags that are gone; tries a store again whose disk failed."""
        snapshot = self.memory.snapshot()
        if self.filling is not None and snapshot.problem is None:
            self.filling.store.look_after()
            self.filling.store.write_again()
            self.filling.prune(snapshot.timeline)

    def forget(self, times: Sequence[TimeWindow]) -> list[str]:
        """Deletes the stored columns of bags that reach into the windows.

        Returns a sentence on columns that may still be there.
        """
        if self.filling is None or not times:
            return []
        if not (self.answers(PATIENCE_S) and os.path.isdir(self.bag_dir)):
            do = "delete the cache folder of ros2-memory, which may have columns of it"
            return [f"{self.name}: {self.bag_dir} is not there: {do}"]
        try:
            if (path := self.filling.store.path) is not None:
                forget_columns(path, self.bag_dir, (), times)
        except BagError as error:
            return [f"{self.name}: {error}"]
        return []

    def prepare(self) -> Iterator[_PreparedBags]:
        """Yields the bags to ship, the oldest first, with their rows."""
        snapshot = self.memory.index.refresh()
        if snapshot.problem is not None:
            self.report(snapshot.problem)
            return
        bags = self._settled(snapshot)
        self._load_known(bags)
        batches = [] if self.filling is None else self.filling.batches(snapshot.timeline)
        waiting = {bag.file: batch for batch in batches for bag in batch.bags}
        group: list[_BagToShip] = []
        for to_ship in self._to_ship(bags):
            if group and not _fit_in_group([*group, to_ship], self.shipper.most_bags):
                yield from self._with_rows(group, waiting)
                group = []
            group.append(to_ship)
        if group:
            yield from self._with_rows(group, waiting)
        if self.filling is not None:
            self._cut_to_share(self.filling)
        self._drop_gone(bags)

    def _to_ship(self, bags: Sequence[BagFile]) -> Iterator[_BagToShip]:
        """Yields the bags to ship; confirms the bags in the lake at the end."""
        by_file = {shipped.file: shipped for shipped in self.known.values()}
        receipts = cache(partial(read_receipts, self.bag_dir))
        confirmed = list[ShippedBag]()
        for number, (bag, bag_id) in enumerate(self._identified_bags(bags)):
            if number % _GROUP == 0:
                maker = RowMaker(self.memory, self.config, self.messages)
            before, same_file = self.known.get(bag_id), by_file.get(self.name_of(bag))
            try:
                if same_file is not None and _is_cut(same_file, bag, receipts):
                    continue
                shipped = self._row_of(bag, bag_id, before, maker.made_of(bag))
            except (EpisodicError, OSError, ValueError) as error:
                self.report(error)
                continue
            # A copy with another path and mtime has the same rows.
            if before and before == shipped._replace(mtime_ns=before.mtime_ns, file=before.file):
                confirmed.append(shipped)
                continue
            replaced = {before} if before is not None else set()
            # It has another id if its first messages were forgotten; what is left lies within it.
            if same_file is not None and (
                same_file.start_ns <= shipped.start_ns and shipped.end_ns <= same_file.end_ns
            ):
                replaced.add(same_file)
            yield _BagToShip(bag, shipped, [*replaced])
        self.confirm(confirmed)

    def _identified_bags(self, bags: Sequence[BagFile]) -> Iterator[tuple[BagFile, str]]:
        """Yields the bags that may be in the lake with their ids, the oldest first, each bag once.

        A moment's copy of a bag is left out if the bag itself is there, or in the lake.
        """
        ids: set[str] = set()
        copies = {bag.file for bag in bags if self.name_of(bag).startswith(f"{MOMENTS_FOLDER}/")}
        for bag in sorted(bags, key=lambda bag: (bag.file in copies, bag.start)):
            self.shipper.alive()
            try:
                state = self._known_state(bag)
            except (EpisodicError, OSError, ValueError) as error:
                self.report(error)
                continue
            if state.bag_id in ids or (state.bag_id in self.known and bag.file in copies):
                continue
            if state.is_forgotten:
                do = "it is not shipped: delete it, or the messages, with ros2-memory forget"
                why = f"{bag.file} has messages that were forgotten in the lake; {do}"
                self.report(why)
                continue
            ids.add(state.bag_id)
            yield bag, state.bag_id

    def _with_rows(
        self, group: Sequence[_BagToShip], waiting: dict[str, Batch]
    ) -> Iterator[_PreparedBags]:
        """Yields bags with their rows; a bag whose rows cannot be made is reported.

        `waiting`: the batches whose columns are not stored yet, by the files of their bags.
        """
        if self.filling is not None:
            self._store(self.filling, [to_ship.file for to_ship in group], waiting)
        try:
            try:
                rows = self._rows(group)
            except BusyError:
                # Another program deleted stored columns, or they are damaged: they are set aside.
                rows = self._rows(group)
        except (EpisodicError, OSError, ValueError) as error:
            if len(group) == 1:
                self.report(error)
                return
            for alone in group:
                yield from self._with_rows([alone], waiting)
        else:
            yield _PreparedBags(self, group, rows)

    def _rows(self, group: Sequence[_BagToShip]) -> dict[str, pa.Table]:
        maker = RowMaker(self.memory, self.config, self.messages)
        return maker.rows({to_ship.file: to_ship.bag for to_ship in group})

    def _store(self, filling: Filling, bags: Sequence[BagFile], waiting: dict[str, Batch]) -> None:
        """Stores the columns of the batches that are `waiting` for these bags.

        It does not store them in memory, which many robots would fill, nor on a disk that fails.
        """
        if filling.store.path is None or filling.store.is_failing:
            return
        self._cut_to_share(filling)
        timeline = self.memory.snapshot().timeline
        for bag in bags:
            batch = waiting.get(bag.file)
            if batch is not None:
                filling.fill(batch, timeline)
                for stored in batch.bags:
                    waiting.pop(stored.file, None)

    def _cut_to_share(self, filling: Filling) -> None:
        """Deletes stored columns beyond their share of the disk."""
        filling.whole_since()
        filling.thin()
        filling.trim()

    def _settled(self, snapshot: Snapshot) -> Sequence[BagFile]:
        """Returns the closed bags that change no more; counts and reports the others."""
        now = self.memory.clock.now()
        closed = [
            bag
            for bag in snapshot.bags
            if bag.state is BagState.CLOSED and not is_derived(bag.path)
        ]
        bags = [bag for bag in closed if is_settled(bag, self.bag_dir, now)]
        open_bags = [bag for bag in snapshot.bags if bag.state is BagState.INCOMPLETE]
        self.shipper.done.waiting += len(closed) - len(bags) + len(open_bags)
        for bag in open_bags:
            why = "was left open by a crash: ros2-memory recover closes it"
            self.report(f"{bag.file} {why}")
        for file in snapshot.damaged:
            self.report(f"{file.path}: {file.reason}")
        return bags

    def _load_known(self, bags: Sequence[BagFile]) -> None:
        """Reads the rows that the lake has of the time of new bags.

        Raises:
            LakeError: the lake cannot be read.
        """
        new = [bag for bag in bags if bag.file not in self._states]
        if new:
            window = TimeWindow(min(bag.start for bag in new), max(bag.end for bag in new))
            beside = window.widened(_BESIDE_NS)
            of_time = window_condition(self.name, ("start_ns", "end_ns"), beside)
            for row in self.shipper.lake.rows("bags", of_time, ShippedBag._fields).to_pylist():
                self.known.setdefault(row["bag_id"], ShippedBag(**row))

    def _drop_gone(self, bags: Sequence[BagFile]) -> None:
        """Forgets the states and rows of bags that the robot no longer has."""
        names = {bag.file: self.name_of(bag) for bag in bags}
        self._states = {file: state for file, state in self._states.items() if file in names}
        ids, present = {state.bag_id for state in self._states.values()}, {*names.values()}
        shipped = [bag for bag in self.known.values() if bag.bag_id in ids or bag.file in present]
        self.known = {bag.bag_id: bag for bag in shipped}
        self._confirmed.intersection_update(shipped)

    def _known_state(self, bag: BagFile) -> _KnownState:
        """Returns a bag's id, and whether it has forgotten messages; reads each state once."""
        state = (bag.size, bag.mtime_ns, bag.sidecar_ns)
        known = self._states.get(bag.file)
        if known is None or known.state != state:
            # Without a handover all of its messages count.
            summary = self.reader.summarize(bag.path) if bag.sidecar_ns else bag.summary
            if summary.empty:
                raise BagError(bag.file, "it holds no message")
            bag_id = bag_id_of(self.name, bag.recording.name, bag.path.name, summary.start)
            is_forgotten = any(
                tombstone.forbids(self.memory.reader, bag, bag_id)
                for tombstone in self.shipper.tombstones
                if tombstone.robot == self.name
            )
            known = self._states[bag.file] = _KnownState(state, bag_id, is_forgotten)
        return known

    def _row_of(
        self, bag: BagFile, bag_id: str, before: ShippedBag | None, made_of: str
    ) -> ShippedBag:
        """Returns the row that a bag would have in `bags`. A file that has changed is hashed."""
        if before is not None and (before.size, before.mtime_ns) == (bag.size, bag.mtime_ns):
            sha256 = before.sha256
        else:
            sha256 = sha256_of(bag.path)
        return ShippedBag(
            robot=self.name,
            bag_id=bag_id,
            day=utc_day(bag.start),
            file=self.name_of(bag),
            size=bag.size,
            sha256=sha256,
            mtime_ns=bag.mtime_ns,
            made_of=made_of,
            start_ns=bag.start,
            end_ns=bag.end,
        )

    def confirm(self, bags: Sequence[ShippedBag]) -> None:
        """Remembers that bags are in the lake, and writes receipts if a recorder made them."""
        self.known |= {bag.bag_id: bag for bag in bags}
        new = [bag for bag in bags if bag not in self._confirmed]
        if not (new and has_recorded(self.bag_dir)):
            return
        try:
            receipts, lake = read_receipts(self.bag_dir), self.shipper.lake.lake_id
            missing = [
                Receipt(bag.file, bag.bag_id, bag.size, bag.sha256, lake, self.shipper.clock.now())
                for bag in new
                if not is_shipped(receipts, bag.file, bag.size) or receipts[bag.file].lake != lake
            ]
            if missing:
                append_receipts(self.bag_dir, missing)
            self._confirmed.update(new)
        except OSError as error:
            what = f"no receipts can be written into {self.bag_dir} ({error.strerror or error})"
            self.report(f"{what}: its recorder cannot wait for shipping")


def _is_cut(
    before: ShippedBag, bag: BagFile, receipts: Callable[[], Mapping[str, Receipt]]
) -> bool:
    """Returns whether retention alone took messages out of a bag after it was shipped.

    The lake keeps these messages, as it keeps the bags that retention deletes.
    """
    if before.size == bag.size:
        return False
    receipt = receipts().get(before.file)
    return receipt is not None and (receipt.sha256, receipt.size) == (before.sha256, bag.size)


def _fit_in_group(bags: Sequence[_BagToShip], most: int) -> bool:
    """Returns whether the rows of bags may be made at once: of one hour, few and small.

    The track of a bag is cut out of that of its hour.
    """
    return (
        len(bags) <= most
        and sum(to_ship.file.size for to_ship in bags) <= MOST_BYTES
        and len({to_ship.file.start // PART_NS for to_ship in bags}) == 1
    )


def _list_one(folder: Path) -> None:
    """Lists one entry of a folder; returns when its disk answers, even with an error."""
    with suppress(OSError), os.scandir(folder) as entries:
        next(entries, None)
