"""Ships closed bags into a lake, each exactly once.

A bag is in the lake once it has a row in `bags`. For each batch, each table is overwritten where
its rows are of the batch's bags, in one transaction: what an earlier attempt left there is replaced
by the same rows. `bags` is committed last, then come the receipts. So a process that is killed
anywhere, and one that runs again, leave every row once; only the lake is asked what is there.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.layout import (
    FORGOTTEN_FILE,
    MOMENTS_FOLDER,
    has_recorded,
    is_carried,
    is_thinned,
)
from ros2_memory.bag_dir.state_files import (
    Receipt,
    append_receipts,
    is_shipped,
    read_forgettings,
    read_receipts,
)
from ros2_memory.columns.fill import is_settled
from ros2_memory.columns.store import relative
from ros2_memory.core.errors import BagError, LakeError
from ros2_memory.core.logging_setup import get_logger
from ros2_memory.core.model import BagState
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S
from ros2_memory.lake.conditions import of_bags, overlapping
from ros2_memory.lake.forgetting import Tombstone, append_tombstone, forget_in_lake
from ros2_memory.lake.rows import ShippedBag, bag_id_of, made_of, rows_of, sha256_of
from ros2_memory.lake.tables import TABLES, day_of
from ros2_memory.lake.upkeep import compact, expire

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Clock, Ns
    from ros2_memory.history.context import Memory
    from ros2_memory.lake.tables import Row
    from ros2_memory.lake.warehouse import LakeTables
    from ros2_memory.storage.base import BagReader

log = get_logger(__name__)

MOST_BAGS: Final = 2_000
MOST_ROWS: Final = 200_000
"""Of one batch: they are in memory until it is committed."""
_BESIDE_NS: Final[Ns] = 86_400 * NS_PER_S
"""A bag lies in the lake up to so far from where it begins and ends now: more of it counted."""


@dataclass(frozen=True, slots=True)
class RobotBags:
    """One robot whose bags are shipped.

    Attributes:
        name: the robot.
        memory: over its bag directory.
        reader: reads whole files, also messages that count in another recording.
        config: names the settings that rows depend on.
    """

    name: str
    memory: Memory
    reader: BagReader
    config: str

    @property
    def bag_dir(self) -> Path:
        """The bag directory."""
        return self.memory.index.bag_dir

    def name_of(self, bag: BagFile) -> str:
        """Returns the path of a bag below the bag directory."""
        return relative(bag.file, str(self.bag_dir))

    def is_moment(self, bag: BagFile) -> bool:
        """Returns whether a bag is a copy in a saved moment."""
        return self.name_of(bag).startswith(f"{MOMENTS_FOLDER}/")


@dataclass(slots=True)
class Shipped:
    """What a pass did: bags that were committed, forgotten, that wait, and what went wrong."""

    bags: int = 0
    forgotten: int = 0
    rows: int = 0
    waiting: int = 0
    problems: list[str] = field(default_factory=list)


@dataclass(slots=True)
class _Seen:
    """A bag as it was: its file, and the sidecars that decide which of its messages count.

    `is_forgotten`: whether it has messages that were forgotten; None before it was read for that.
    """

    state: tuple[int, Ns, Ns]
    bag_id: str
    is_forgotten: bool | None = None


@dataclass(slots=True)
class _OfRobot:
    """What is known of the bags that a robot has, and no longer of those that it had.

    Attributes:
        seen: the newest state of each, by its path.
        known: what the lake has of them, by id.
        receipts: by path; None before they were read.
    """

    seen: dict[str, _Seen] = field(default_factory=dict)
    known: dict[str, ShippedBag] = field(default_factory=dict)
    receipts: dict[str, Receipt] | None = None


@dataclass(frozen=True, slots=True)
class _Ready:
    """A bag of a batch, its rows, and what the lake has of it, under other days and ids perhaps."""

    robot: RobotBags
    bag: ShippedBag
    rows: Mapping[str, Sequence[Row]]
    replaced: tuple[ShippedBag, ...]


class Shipper:
    """Ships the bags of several robots into one lake, whose lock the caller holds.

    Args:
        lake: its tables.
        robots: whose bags are shipped.
        clock: dates receipts.
        messages: topics whose messages are shipped whole.
        tombstones: what was forgotten; a bag with a message of it is not shipped.
        pause: called before each commit; waits until another one is allowed.
        alive: called for each bag.
        most_bags: of one commit.
    """

    def __init__(
        self,
        lake: LakeTables,
        robots: Sequence[RobotBags],
        clock: Clock,
        *,
        messages: Sequence[str] = (),
        tombstones: Collection[Tombstone] = (),
        pause: Callable[[], object] = lambda: None,
        alive: Callable[[], object] = lambda: None,
        most_bags: int = MOST_BAGS,
    ) -> None:
        self._lake = lake
        self._robots = robots
        self._clock = clock
        self._messages = messages
        self._tombstones = set(tombstones)
        self._pause = pause
        self._alive = alive
        self._most_bags = most_bags
        self._of = {robot.name: _OfRobot() for robot in robots}
        self._refused: set[str] = set()

    def run(self) -> Shipped:
        """Ships what is new: one pass over all robots.

        Raises:
            LakeError: the lake cannot be read or written; what is not committed is tried again.
        """
        done = Shipped()
        batch: list[_Ready] = []
        rows = 0
        for robot in [robot for robot in self._robots if self._forget(robot, done)]:
            for ready in self._ready(robot, done):
                batch.append(ready)
                rows += sum(map(len, ready.rows.values()))
                if len(batch) >= self._most_bags or rows >= MOST_ROWS:
                    self._commit(batch, done)
                    batch, rows = [], 0
        if batch:
            self._commit(batch, done)
        return done

    def keep_up(self, grace: Ns) -> None:
        """Puts closed days together, and deletes files that nothing needed for longer than `grace`.

        Raises:
            LakeError: the lake cannot be read or written.
        """
        now = self._clock.now()
        compact(self._lake, now, self._alive)
        expire(self._lake, now - grace if grace else MAX_NS)

    def _forget(self, robot: RobotBags, done: Shipped) -> bool:
        """Forgets what the robot's bag directory asks for; returns whether that is known.

        Raises:
            LakeError: the lake cannot be written; what is left is done when it is opened again.
        """
        try:
            wanted = [Tombstone.of(robot.name, one) for one in read_forgettings(robot.bag_dir)]
        except (OSError, ValueError) as error:
            done.problems.append(
                f"{robot.name}: {robot.bag_dir / FORGOTTEN_FILE}: {error}; nothing of this robot "
                "is shipped until it is repaired, since what was forgotten could come back"
            )
            return False
        new = [tombstone for tombstone in wanted if tombstone not in self._tombstones]
        for tombstone in new:
            append_tombstone(self._lake.location.state_dir, tombstone, done=False)
        for tombstone in new:
            self._alive()
            gone = forget_in_lake(self._lake, tombstone)
            done.forgotten += gone.bags
            done.problems += [
                f"{robot.name}: a branch or tag keeps what was forgotten: {kept}"
                for kept in gone.kept_by
            ]
            self._tombstones.add(tombstone)
        if new:
            self._look_again()
        return True

    def _look_again(self) -> None:
        """Has everything looked at again, in the bag directories and in the lake."""
        self._of = {robot.name: _OfRobot() for robot in self._robots}

    def _ready(self, robot: RobotBags, done: Shipped) -> Iterator[_Ready]:
        """Yields the bags of a robot that are to be shipped, the oldest first, with their rows."""
        snapshot = robot.memory.index.refresh()
        if snapshot.problem is not None:
            done.problems.append(f"{robot.name}: {snapshot.problem}")
            return
        now = robot.memory.clock.now()
        closed = [
            bag
            for bag in snapshot.bags
            if bag.state is BagState.CLOSED
            if not is_carried(bag.path) and not is_thinned(bag.path)
        ]
        bags = [bag for bag in closed if is_settled(bag, robot.bag_dir, now)]
        open_bags = [bag for bag in snapshot.bags if bag.state is BagState.INCOMPLETE]
        done.waiting += len(closed) - len(bags) + len(open_bags)
        done.problems += [
            f"{robot.name}: {bag.file} was left open by a crash: ros2-memory recover closes it"
            for bag in open_bags
        ]
        done.problems += [f"{robot.name}: {file.path}: {file.reason}" for file in snapshot.damaged]
        known = self._look_up(robot, bags)
        by_file = {shipped.file: shipped for shipped in known.values()}
        ids: set[str] = set()
        confirmed: list[ShippedBag] = []
        # A saved moment's copy of a bag counts where the bag itself is gone.
        for bag in sorted(bags, key=lambda bag: (robot.is_moment(bag), bag.start)):
            self._alive()
            try:
                seen = self._look(robot, bag)
                before = known.get(seen.bag_id)
                is_again = before is not None and robot.is_moment(bag)
                if seen.bag_id in ids or is_again or self._is_forgotten(robot, bag, seen, done):
                    continue
                ids.add(seen.bag_id)
                shipped = self._described(robot, bag, seen.bag_id, before)
                if before is not None and _is_same(before, shipped):
                    known[shipped.bag_id] = shipped
                    confirmed.append(shipped)
                    continue
                if _is_cut(robot, bag, by_file.get(shipped.file)):
                    continue
                rows = rows_of(robot.memory, bag, shipped, self._messages)
            except (BagError, OSError, ValueError) as error:
                done.problems.append(f"{robot.name}: {error}")
                continue
            older = {before, by_file.get(shipped.file)} - {None}
            replaced = (one for one in older if one and (one is before or _holds(one, shipped)))
            yield _Ready(robot, shipped, rows, tuple(replaced))
        self._confirm(robot, confirmed, done)
        self._drop_gone(robot, bags)

    def _look_up(self, robot: RobotBags, bags: Sequence[BagFile]) -> dict[str, ShippedBag]:
        """Returns what the lake has of a robot's bags; it is asked about the time of new ones.

        Raises:
            LakeError: the lake cannot be read.
        """
        of_robot = self._of[robot.name]
        new = [bag for bag in bags if bag.file not in of_robot.seen]
        if new:
            begin = max(min(bag.start for bag in new) - _BESIDE_NS, MIN_NS)
            stop = min(max(bag.end for bag in new) + _BESIDE_NS, MAX_NS)
            condition = overlapping(robot.name, ("start_ns", "end_ns"), begin, stop)
            for row in self._lake.rows("bags", condition, ShippedBag._fields).to_pylist():
                shipped = ShippedBag(**row)
                of_robot.known.setdefault(shipped.bag_id, shipped)
        return of_robot.known

    def _drop_gone(self, robot: RobotBags, bags: Sequence[BagFile]) -> None:
        """Drops what is known of bags that the robot has no longer: a hub runs for years."""
        of_robot = self._of[robot.name]
        names = {bag.file: robot.name_of(bag) for bag in bags}
        of_robot.seen = {file: seen for file, seen in of_robot.seen.items() if file in names}
        ids, own = {seen.bag_id for seen in of_robot.seen.values()}, {*names.values()}
        of_robot.known = {
            bag_id: shipped
            for bag_id, shipped in of_robot.known.items()
            if bag_id in ids or shipped.file in own
        }
        if of_robot.receipts is not None:
            receipts = of_robot.receipts.items()
            of_robot.receipts = {name: receipt for name, receipt in receipts if name in own}

    def _look(self, robot: RobotBags, bag: BagFile) -> _Seen:
        """Returns a state of a bag, which is read once."""
        state, known = (bag.size, bag.mtime_ns, bag.sidecar_ns), self._of[robot.name].seen
        seen = known.get(bag.file)
        if seen is None or seen.state != state:
            summary = robot.reader.summarize(bag.path)
            if summary.empty:
                raise BagError(bag.file, "it holds no message")
            seen = _Seen(state, bag_id_of(robot.name, bag, summary.start))
            known[bag.file] = seen
        return seen

    def _is_forgotten(self, robot: RobotBags, bag: BagFile, seen: _Seen, done: Shipped) -> bool:
        """Returns, and reports, whether a bag has a message that was forgotten."""
        if seen.is_forgotten is None:
            reader = robot.memory.reader
            seen.is_forgotten = any(
                tombstone.forbids(reader, robot.name, bag, seen.bag_id)
                for tombstone in self._tombstones
            )
        if seen.is_forgotten:
            done.problems.append(
                f"{robot.name}: {bag.file} has messages that were forgotten in the lake; it is "
                "not shipped: delete it, or the messages, with ros2-memory forget"
            )
        return seen.is_forgotten

    def _described(
        self, robot: RobotBags, bag: BagFile, bag_id: str, before: ShippedBag | None
    ) -> ShippedBag:
        """Returns what a bag would be known as."""
        is_read = before is not None and (before.size, before.mtime_ns) == (bag.size, bag.mtime_ns)
        return ShippedBag(
            robot=robot.name,
            bag_id=bag_id,
            day=day_of(bag.start),
            file=robot.name_of(bag),
            size=bag.size,
            sha256=before.sha256 if before is not None and is_read else sha256_of(bag.path),
            mtime_ns=bag.mtime_ns,
            made_of=made_of(robot.memory, bag, robot.config, self._messages),
            start_ns=bag.start,
            end_ns=bag.end,
        )

    def _commit(self, batch: Sequence[_Ready], done: Shipped) -> None:
        """Commits a batch.

        Raises:
            LakeError: the lake cannot be written; it is not known how far that came.
        """
        self._pause()
        # Few files have to be looked at for it.
        condition = of_bags(
            (bag.robot, bag.day, bag.bag_id)
            for ready in batch
            for bag in (ready.bag, *ready.replaced)
        )
        rows = 0
        try:
            for name, table in TABLES.items():
                filled = table.filled([row for ready in batch for row in ready.rows[name]])
                rows += filled.num_rows
                self._lake.replace(name, condition, filled)
        except LakeError:
            self._look_again()
            raise
        for ready in batch:
            known = self._of[ready.robot.name].known
            for old in ready.replaced:
                known.pop(old.bag_id, None)
            known[ready.bag.bag_id] = ready.bag
        done.bags += len(batch)
        done.rows += rows
        log.info("bags_shipped", bags=len(batch), rows=rows)
        for robot in self._robots:
            self._confirm(robot, [ready.bag for ready in batch if ready.robot is robot], done)

    def _confirm(self, robot: RobotBags, bags: Iterable[ShippedBag], done: Shipped) -> None:
        """Writes receipts into the robot's bag directory, for its recorder, if it has one."""
        if not has_recorded(robot.bag_dir):
            return
        try:
            of_robot, lake = self._of[robot.name], self._lake.lake_id
            if of_robot.receipts is None:
                of_robot.receipts = read_receipts(robot.bag_dir)
            known = of_robot.receipts
            missing = [
                Receipt(bag.file, bag.bag_id, bag.size, bag.sha256, lake, self._clock.now())
                for bag in bags
                if not (is_shipped(known, bag.file, bag.size) and known[bag.file].lake == lake)
            ]
            if missing:
                append_receipts(robot.bag_dir, missing)
                known.update((receipt.bag, receipt) for receipt in missing)
            self._refused.discard(robot.name)
        except OSError as error:
            problem = (
                f"{robot.name}: no receipts can be written into {robot.bag_dir} "
                f"({error.strerror or error}): its recorder cannot wait for shipping"
            )
            if robot.name not in self._refused:
                log.warning("receipts_not_written", robot=robot.name, reason=str(error))
                self._refused.add(robot.name)
            done.problems.append(problem)


def _is_cut(robot: RobotBags, bag: BagFile, before: ShippedBag | None) -> bool:
    """Returns whether only retention took messages out of a bag after it was shipped.

    The lake keeps those, as it keeps the bags that retention deletes.
    """
    if before is None or before.size == bag.size:
        return False
    receipt = read_receipts(robot.bag_dir).get(before.file)
    return receipt is not None and (receipt.sha256, receipt.size) == (before.sha256, bag.size)


def _is_same(before: ShippedBag, now: ShippedBag) -> bool:
    """Returns whether the rows of a bag would be the same; a copy has another path and mtime."""
    return before == now._replace(mtime_ns=before.mtime_ns, file=before.file)


def _holds(old: ShippedBag, new: ShippedBag) -> bool:
    """Returns whether a bag of the same path is an older state of another one.

    As where its first messages were deleted by request: what is left lies within it.
    """
    return old.start_ns <= new.start_ns and new.end_ns <= old.end_ns
