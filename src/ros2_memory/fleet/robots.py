"""The robots of a fleet, each with a memory of its own."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from ros2_memory.core.errors import (
    InvalidArgumentsError,
    LakeError,
    NoDataError,
    NotInLakeError,
    QueryTimeoutError,
    RefusedError,
)
from ros2_memory.core.text import abbreviate, listed
from ros2_memory.core.timebase import MAX_NS, MIN_NS, NS_PER_S, Clock

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.context import Call, Memory

T = TypeVar("T")

_MOST_NAMED = 50


@dataclass(frozen=True, slots=True)
class StoppedClock(Clock):
    """The time at which a question was asked, so that it is one question to all robots."""

    at: Ns

    def now(self) -> Ns:
        """Returns that time."""
        return self.at


class FromLake(NamedTuple):
    """What a reply has to report of an answer from a lake.

    Attributes:
        latest: the log time of the newest message that was shipped; None if there is none.
        older: up to which log time (inclusive) there is more, which was not looked at; None if not.
    """

    latest: Ns | None
    older: Ns | None = None

    @classmethod
    def of(cls, lake: Memory, call: Call) -> FromLake:
        """Returns what is to be reported of a call that a lake has answered."""
        published = lake.index.published
        latest = None if published is None else published.latest
        return cls(latest, None if call.older == MAX_NS else call.older)

    def since(self, begin: Ns | None) -> FromLake:
        """Returns that of an answer from a log time on; None stands for all times."""
        is_whole = self.older is None or (begin is not None and begin > self.older)
        return self._replace(older=None) if is_whole else self

    @property
    def notes(self) -> tuple[str, ...]:
        """The note on days that the answer would need, if any."""
        if self.older is None:
            return ()
        since = datetime.fromtimestamp((self.older + 1) // NS_PER_S, tz=UTC).date()
        note = (
            f"the lake has days before {since}, which were not looked at: an end (or before, or a "
            "time) there has them looked at"
        )
        return (note,)


class Robot:
    """One robot of a fleet. Its memory is built when it is first needed; no bag is read for that.

    Args:
        name: as replies and arguments have it; never a path.
        bag_dir: the bag directory, which need not exist.
        build: what builds its memory.
        lake: its memory over what was shipped to a lake.
        is_mounted: whether there is a memory besides that of the lake.

    Attributes:
        name: see above; likewise `bag_dir`, `lake` and `is_mounted`.
    """

    def __init__(
        self,
        name: str,
        bag_dir: Path,
        build: Callable[[], Memory],
        *,
        lake: Memory | None = None,
        is_mounted: bool = True,
    ) -> None:
        self.name = name
        self.bag_dir = bag_dir
        self.lake = lake
        self.is_mounted = is_mounted
        self._build = build
        self._lock = threading.Lock()
        self._memory: Memory | None = None

    def memory(self) -> Memory:
        """Returns the robot's memory, always the same one."""
        with self._lock:
            if self._memory is None:
                self._memory = self._build()
            return self._memory

    def asked(
        self, ask: Callable[[Memory, Call], T], call: Call, *, lake_first: bool
    ) -> tuple[T, FromLake | None]:
        """Returns what `ask` finds in a memory, and what to report with it if that is a lake's.

        With `lake_first` the lake answers, where it has anything of the robot; the mounted memory
        does where that needs messages that the lake does not have. Without, the mounted one does,
        unless it has no bag, and the lake where that has no data, as retention deletes bags.

        Raises:
            NoDataError: none of the two has an answer; it is that of the mounted one, if any.
            NotInLakeError: it needs such messages, and the robot has no bags of its own.
        """
        lake = self.lake
        if lake is None:
            return ask(self.memory(), call), None
        if lake_first or not self._has_bags():
            if not self.is_mounted or lake.index.snapshot().latest is not None:
                try:
                    return _of_lake(lake, ask, call)
                except NotInLakeError:
                    if not self._has_bags():
                        raise
            return ask(self.memory(), call), None
        try:
            return ask(self.memory(), call), None
        except NoDataError as error:
            try:
                return _of_lake(lake, ask, call)
            except NoDataError:
                raise error from None
            except (RefusedError, LakeError, QueryTimeoutError) as failure:
                notes = (*error.notes, f"the lake has no answer either: {failure}")
                raise NoDataError(error.reason, error.detail, notes) from failure

    def _has_bags(self) -> bool:
        """Returns whether there are bags besides those of the lake, or may be."""
        if not self.is_mounted:
            return False
        snapshot = self.memory().index.snapshot()
        return bool(snapshot.bags) or snapshot.problem is not None

    def latest_known(self) -> Ns:
        """Returns the log time of its newest data as of the last scan; the least before the first.

        Nothing is scanned for it.
        """
        published = None if self._memory is None else self._memory.index.published
        latest = None if published is None else published.latest
        return MIN_NS if latest is None else latest


def _of_lake(lake: Memory, ask: Callable[[Memory, Call], T], call: Call) -> tuple[T, FromLake]:
    """Returns what `ask` finds in a lake, with what to report; raises what it raises."""
    call.older = MAX_NS
    try:
        found = ask(lake, call)
    except NoDataError as error:
        detail = "; ".join((error.detail, *FromLake.of(lake, call).notes))
        raise NoDataError(error.reason, detail, error.notes) from error
    return found, FromLake.of(lake, call)


class Fleet:
    """The robots that one server answers for.

    Args:
        robots: all of them; no two have one name.
        clock: the wall clock, read once for a question to several.
        shared_map: whether coordinates mean the same place for all of them.
        join: returns the robots that a lake has besides those of some names, where there is one.
            It looks there, unless it did so a moment ago.

    Attributes:
        robots: by their names.
        clock: see above.
        shared_map: see above.
        grows: whether robots may join.
    """

    def __init__(
        self,
        robots: Iterable[Robot],
        clock: Clock,
        *,
        shared_map: bool = False,
        join: Callable[[Collection[str]], Iterable[Robot]] | None = None,
    ) -> None:
        self.robots: Mapping[str, Robot] = {robot.name: robot for robot in robots}
        self.clock = clock
        self.shared_map = shared_map
        self.grows = join is not None
        self._join = join
        self._lock = threading.Lock()

    def joined(self) -> Sequence[Robot]:
        """Returns the robots that were shipped to the lake for the first time since; adds them.

        Raises:
            EpisodicError: the lake cannot be read.
        """
        if self._join is None:
            return ()
        with self._lock:
            found = [*self._join(self.robots)]
            # A new dict: other threads iterate over the old one.
            self.robots = {**self.robots, **{robot.name: robot for robot in found}}
        return found

    def allowed(self, call: Call) -> list[Robot]:
        """Returns the robots that a call may ask about, in the order of the configuration."""
        robots = call.robots
        return [robot for name, robot in self.robots.items() if robots is None or name in robots]

    def named(self, name: object, call: Call) -> Robot:
        """Returns the robot of a name.

        Raises:
            InvalidArgumentsError: there is none, or the call may not ask about it, which the
                sentence does not tell apart.
            EpisodicError: the lake, which may have it, cannot be read.
        """
        if isinstance(name, str) and name not in self.robots and call.robots is None:
            self.joined()
        allowed = self.allowed(call)
        for robot in allowed:
            if robot.name == name:
                return robot
        raise InvalidArgumentsError(
            f"there is no robot {abbreviate(name)}; there {names_of(allowed)}"
        )


def names_of(robots: Iterable[Robot]) -> str:
    """Returns the names of robots for a sentence."""
    names = [robot.name for robot in robots]
    if not names:
        return "is none"
    return f"{'is' if len(names) == 1 else 'are'} {listed(names, at_most=_MOST_NAMED)}"
