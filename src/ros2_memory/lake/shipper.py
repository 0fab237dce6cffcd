"""Ships closed bags into a lake, each exactly once.

A bag is in the lake once it has a row in `bags`. For each batch, each table is overwritten where
its rows are of the batch's bags, in one transaction: what an earlier attempt left there is replaced
by the same rows. `bags` is committed last, then come the receipts. So a process that is killed
anywhere, and one that runs again, leave every row once; only the lake is asked what is there.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import timedelta
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.layout import (
    FORGOTTEN_FILE,
    MOMENTS_FOLDER,
    has_recorded,
    is_carried,
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
from ros2_memory.core.spans import united
from ros2_memory.core.timebase import MAX_NS
from ros2_memory.lake.conditions import any_of, of_bags, overlapping
from ros2_memory.lake.forgetting import forget_in_lake
from ros2_memory.lake.rows import ShippedBag, bag_id_of, made_of, rows_of, sha256_of
from ros2_memory.lake.tables import TABLES, day_of, end_of
from ros2_memory.lake.tombstones import Tombstone, append_tombstone
from ros2_memory.lake.upkeep import compact, expire
from ros2_memory.lake.warehouse import quiet_deletes

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
    from datetime import date
    from pathlib import Path

    import pyarrow as pa
    from pyiceberg.expressions import BooleanExpression
    from pyiceberg.table import Table as IcebergTable

    from ros2_memory.core.model import BagFile
    from ros2_memory.core.timebase import Clock, Ns
    from ros2_memory.history.context import Memory
    from ros2_memory.lake.tables import Row
    from ros2_memory.lake.warehouse import LakeLocation

log = get_logger(__name__)

MOST_BAGS: Final = 2_000
MOST_ROWS: Final = 200_000
"""Of one batch: they are in memory until it is committed."""


@dataclass(frozen=True, slots=True)
class RobotBags:
    """One robot whose bags are shipped.

    Attributes:
        name: the robot.
        memory: over its bag directory.
        first_in: returns the log time of the first message in a file, whether it counts or not.
        config: names the settings that rows depend on.
    """

    name: str
    memory: Memory
    first_in: Callable[[Path], Ns]
    config: str

    @property
    def bag_dir(self) -> Path:
        """The bag directory."""
        return self.memory.index.bag_dir


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
        days: of which the lake was asked, with those beside them.
        known: the bags of these days that are in the lake, by their ids.
        seen: the newest state of each, by its path.
        receipts: by path; None before they were read.
    """

    days: frozenset[date] = frozenset()
    known: dict[str, ShippedBag] = field(default_factory=dict)
    seen: dict[str, _Seen] = field(default_factory=dict)
    receipts: dict[str, Receipt] | None = None


@dataclass(frozen=True, slots=True)
class _Ready:
    """A bag of a batch, its rows, and the days and ids under which older ones of it may lie."""

    robot: RobotBags
    known: ShippedBag
    rows: Mapping[str, Sequence[Row]]
    replaced: tuple[ShippedBag, ...]


class Shipper:
    """Ships the bags of several robots into one lake, whose lock the caller holds.

    Args:
        location: the lake.
        tables: its tables, all of `TABLES`.
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
        location: LakeLocation,
        tables: Mapping[str, IcebergTable],
        robots: Sequence[RobotBags],
        clock: Clock,
        *,
        messages: Sequence[str] = (),
        tombstones: Collection[Tombstone] = (),
        pause: Callable[[], object] = lambda: None,
        alive: Callable[[], object] = lambda: None,
        most_bags: int = MOST_BAGS,
    ) -> None:
        self._location = location
        self._tables = tables
        self._robots = robots
        self._clock = clock
        self._messages = messages
        self._tombstones = set(tombstones)
        self._pause = pause
        self._alive = alive
        self._most_bags = most_bags
        self._of = {each.name: _OfRobot() for each in robots}
        self._refused: set[str] = set()

    @property
    def lake_id(self) -> str:
        """The id of the lake: another one where its tables were created again."""
        return str(self._tables["bags"].metadata.table_uuid)

    def run(self) -> Shipped:
        """Ships what is new: one pass over all robots.

        Raises:
            LakeError: the lake cannot be read or written; what is not committed is tried again.
        """
        done = Shipped()
        robots = [each for each in self._robots if self._forget(each, done)]
        batch: list[_Ready] = []
        rows = 0
        for robot in robots:
            for ready in self._ready(robot, done):
                batch.append(ready)
                rows += sum(map(len, ready.rows.values()))
                if len(batch) >= self._most_bags or rows >= MOST_ROWS:
                    self._commit(batch, done)
                    batch, rows = [], 0
        if batch:
            self._commit(batch, done)
        return done

    def _forget(self, robot: RobotBags, done: Shipped) -> bool:
        """Forgets what the robot's bag directory asks for; returns whether that is known.

        Raises:
            LakeError: the lake cannot be written; what is left is done when it is opened again.
        """
        try:
            wanted = [Tombstone.of(robot.name, each) for each in read_forgettings(robot.bag_dir)]
        except (OSError, ValueError) as error:
            done.problems.append(
                f"{robot.name}: {robot.bag_dir / FORGOTTEN_FILE}: {error}; nothing of this robot "
                "is shipped until it is repaired, since what was forgotten could come back"
            )
            return False
        new = [each for each in wanted if each not in self._tombstones]
        for each in new:
            append_tombstone(self._location.state_dir, each, done=False)
        for each in new:
            self._alive()
            gone = forget_in_lake(self._location, self._tables, each, self._clock.now())
            done.forgotten += gone.bags
            done.problems += [
                f"{robot.name}: a branch or tag keeps what was forgotten: {kept}"
                for kept in gone.kept_by
            ]
            self._tombstones.add(each)
        if new:
            self._look_again()
        return True

    def _look_again(self) -> None:
        """Has the lake asked again what it has, and bags whether they were forgotten."""
        for each in self._of.values():
            each.days, each.known = frozenset(), {}
            for seen in each.seen.values():
                seen.is_forgotten = None

    def keep_up(self, grace: Ns) -> None:
        """Puts closed days together, and deletes files that nothing needed for longer than `grace`.

        Raises:
            LakeError: the lake cannot be read or written.
        """
        now = self._clock.now()
        compact(self._location, self._tables, now, self._alive)
        expire(self._location, self._tables, now, grace)

    def _ready(self, robot: RobotBags, done: Shipped) -> Iterator[_Ready]:
        """Yields the bags of a robot that are to be shipped, the oldest first, with their rows."""
        snapshot = robot.memory.index.refresh()
        if snapshot.problem is not None:
            done.problems.append(f"{robot.name}: {snapshot.problem}")
            return
        bags = [each for each in snapshot.bags if each.state is BagState.CLOSED]
        known = self._known_of(robot.name, bags)
        by_file = {each.file: each for each in known.values()}
        ids: set[str] = set()
        receipts: list[ShippedBag] = []
        # A saved moment's copy of a bag counts where the bag itself is gone.
        for bag in sorted(bags, key=lambda each: (self._is_moment(robot, each), each.start)):
            self._alive()
            if is_carried(bag.path):
                continue
            try:
                if not is_settled(bag, robot.bag_dir, robot.memory.clock.now()):
                    done.waiting += 1
                    continue
                seen = self._look(robot, bag)
                before = known.get(seen.bag_id)
                is_again = before is not None and self._is_moment(robot, bag)
                if seen.bag_id in ids or is_again or self._is_forgotten(robot, bag, seen, done):
                    continue
                ids.add(seen.bag_id)
                now = self._described(robot, bag, seen.bag_id, before)
                if before is not None and _is_same(before, now):
                    known[now.bag_id] = now
                    receipts.append(now)
                else:
                    yield self._made(robot, bag, now, before, by_file.get(now.file))
            except (BagError, OSError, ValueError) as error:
                done.problems.append(f"{robot.name}: {error}")
        self._confirm(robot, receipts, done)
        self._drop_gone(robot, bags)

    def _drop_gone(self, robot: RobotBags, bags: Sequence[BagFile]) -> None:
        """Drops what is known of bags that the robot has no longer: a hub runs for years."""
        of_robot, root = self._of[robot.name], str(robot.bag_dir)
        files = {each.file for each in bags}
        of_robot.seen = {file: each for file, each in of_robot.seen.items() if file in files}
        if of_robot.receipts is not None:
            names = {relative(file, root) for file in files}
            of_robot.receipts = {
                name: each for name, each in of_robot.receipts.items() if name in names
            }

    @staticmethod
    def _is_moment(robot: RobotBags, bag: BagFile) -> bool:
        return relative(bag.file, str(robot.bag_dir)).startswith(f"{MOMENTS_FOLDER}/")

    def _look(self, robot: RobotBags, bag: BagFile) -> _Seen:
        """Returns a state of a bag, which is read once."""
        state, known = (bag.size, bag.mtime_ns, bag.sidecar_ns), self._of[robot.name].seen
        seen = known.get(bag.file)
        if seen is None or seen.state != state:
            seen = _Seen(state, bag_id_of(robot.name, bag, robot.first_in(bag.path)))
            known[bag.file] = seen
        return seen

    def _made(
        self,
        robot: RobotBags,
        bag: BagFile,
        now: ShippedBag,
        before: ShippedBag | None,
        other: ShippedBag | None,
    ) -> _Ready:
        """Returns a bag with its rows; `other` was known under its path."""
        rows = rows_of(robot.memory, bag, now, self._messages)
        older = [] if before is None else [before]
        if other is not None and other is not before and _holds(other, now):
            older.append(other)
        return _Ready(robot, now, rows, tuple(older))

    def _is_forgotten(self, robot: RobotBags, bag: BagFile, seen: _Seen, done: Shipped) -> bool:
        """Returns, and reports, whether a bag has a message that was forgotten."""
        if seen.is_forgotten is None:
            reader = robot.memory.reader
            seen.is_forgotten = any(
                each.forbids(reader, robot.name, bag, seen.bag_id) for each in self._tombstones
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
        made = made_of(robot.memory, bag, robot.config, self._messages)
        same = before is not None and (before.size, before.mtime_ns) == (bag.size, bag.mtime_ns)
        sha256 = before.sha256 if before is not None and same else sha256_of(bag.path)
        file = relative(bag.file, str(robot.bag_dir))
        return ShippedBag(
            robot.name,
            bag_id,
            day_of(bag.start),
            file,
            bag.size,
            sha256,
            bag.mtime_ns,
            made,
            bag.start,
            bag.end,
        )

    def _known_of(self, robot: str, bags: Sequence[BagFile]) -> dict[str, ShippedBag]:
        """Returns what the lake has of the days of some bags; of each day it is asked once.

        And of the days beside them: another first message of a bag that counts moves its begin.
        """
        of_robot = self._of[robot]
        own = {day for bag in bags for day in (day_of(bag.start), day_of(bag.end))}
        days = frozenset(day + timedelta(beside) for day in own for beside in (-1, 0, 1))
        if missing := days - of_robot.days:
            found = {each.bag_id: each for each in self._read_known(robot, missing)}
            of_robot.known = {**found, **of_robot.known}
        if days != of_robot.days:
            of_robot.known = {
                bag_id: each
                for bag_id, each in of_robot.known.items()
                if any(each.day <= day <= day_of(each.end_ns) for day in days)
            }
            of_robot.days = days
        return of_robot.known

    def _read_known(self, robot: str, days: Iterable[date]) -> Iterator[ShippedBag]:
        """Yields the bags of a robot in the lake that have something of some days.

        Raises:
            LakeError: the lake cannot be read.
        """
        spans = united(
            (end_of(day - timedelta(1)) + 1, min(end_of(day) + 1, MAX_NS)) for day in days
        )
        reaching = any_of([overlapping(robot, TABLES["bags"].span, *span) for span in spans])
        with self._location.translated("reading the lake's bags"):
            bags = self._tables["bags"].refresh()
            found = bags.scan(reaching, selected_fields=ShippedBag._fields).to_arrow()
        for row in found.to_pylist():
            yield ShippedBag(**row)

    def _commit(self, batch: Sequence[_Ready], done: Shipped) -> None:
        """Commits a batch.

        Raises:
            LakeError: the lake cannot be written; it is not known how far that came.
        """
        self._pause()
        # Few files have to be looked at for it.
        condition = of_bags(
            (one.robot, one.day, one.bag_id)
            for each in batch
            for one in (each.known, *each.replaced)
        )
        rows = 0
        try:
            for name, table in TABLES.items():
                filled = table.filled([row for each in batch for row in each.rows[name]])
                rows += filled.num_rows
                self._overwrite(name, filled, condition)
        except LakeError:
            self._look_again()
            raise
        for each in batch:
            known = self._of[each.robot.name].known
            for old in each.replaced:
                known.pop(old.bag_id, None)
            known[each.known.bag_id] = each.known
        done.bags += len(batch)
        done.rows += rows
        log.info("bags_shipped", bags=len(batch), rows=rows)
        for robot in self._robots:
            self._confirm(robot, [each.known for each in batch if each.robot is robot], done)

    def _overwrite(self, name: str, rows: pa.Table, condition: BooleanExpression) -> None:
        """Replaces the rows of some bags in one table, in one transaction.

        Raises:
            LakeError: the lake cannot be written.
        """
        with self._location.translated(f"writing the lake's {name}"), quiet_deletes():
            self._tables[name].refresh().overwrite(rows, overwrite_filter=condition)

    def _confirm(self, robot: RobotBags, bags: Iterable[ShippedBag], done: Shipped) -> None:
        """Writes receipts into the robot's bag directory, for its recorder, if it has one."""
        if not has_recorded(robot.bag_dir):
            return
        try:
            of_robot, lake = self._of[robot.name], self.lake_id
            if of_robot.receipts is None:
                of_robot.receipts = read_receipts(robot.bag_dir)
            known = of_robot.receipts
            missing = [
                Receipt(each.file, each.bag_id, each.size, each.sha256, lake, self._clock.now())
                for each in bags
                if not (is_shipped(known, each.file, each.size) and known[each.file].lake == lake)
            ]
            if missing:
                append_receipts(robot.bag_dir, missing)
                known.update((each.bag, each) for each in missing)
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


def _is_same(before: ShippedBag, now: ShippedBag) -> bool:
    """Returns whether the rows of a bag would be the same; a copy has another path and mtime."""
    return before == now._replace(mtime_ns=before.mtime_ns, file=before.file)


def _holds(old: ShippedBag, new: ShippedBag) -> bool:
    """Returns whether a bag of the same path is an older state of another one.

    As where its first messages were deleted by request: what is left lies within it.
    """
    return old.start_ns <= new.start_ns and new.end_ns <= old.end_ns
