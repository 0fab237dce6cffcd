"""The robots of a fleet, each with a memory of its own."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeVar

from ros2_memory.core.errors import (
    InvalidArgumentsError,
    LakeError,
    NoDataError,
    NotInLakeError,
    QueryTimeoutError,
    RefusedError,
)
from ros2_memory.core.text import abbreviate, listed
from ros2_memory.core.timebase import MIN_NS, Clock

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
        notes: what else was not looked at, or is not exact.
    """

    latest: Ns | None
    notes: tuple[str, ...] = ()


class LakeSource(Protocol):
    """What a lake has of one robot."""

    @property
    def memory(self) -> Memory:
        """The robot's memory over its rows, always the same one."""

    @property
    def latest(self) -> Ns | None:
        """The log time of the newest message that was shipped; None if there is none."""

    def notes(self, begin: Ns | None = None) -> Iterable[str]:
        """Returns the notes for the answer that this thread has just computed.

        `begin` is from when (log time) the answer is; None for one that is of all days.
        """


class Robot:
    """One robot of a fleet. Its memory is built when it is first needed; no bag is read for that.

    Args:
        name: as replies and arguments have it; never a path.
        bag_dir: the bag directory, which need not exist.
        build: what builds its memory.
        lake: what a lake has of it, which is asked first.
        is_mounted: whether there is a memory besides that of the lake.

    Attributes:
        name: see above.
        bag_dir: see above.
        is_mounted: see above.
    """

    def __init__(
        self,
        name: str,
        bag_dir: Path,
        build: Callable[[], Memory],
        *,
        lake: LakeSource | None = None,
        is_mounted: bool = True,
    ) -> None:
        self.name = name
        self.bag_dir = bag_dir
        self.is_mounted = is_mounted
        self._build = build
        self._lake_source = lake
        self._lock = threading.Lock()
        self._memory: Memory | None = None

    def memory(self) -> Memory:
        """Returns the robot's memory, always the same one."""
        with self._lock:
            if self._memory is None:
                self._memory = self._build()
            return self._memory

    @property
    def lake_memory(self) -> Memory | None:
        """Its memory over what was shipped to a lake; None without one."""
        return None if self._lake_source is None else self._lake_source.memory

    def asked(
        self,
        ask: Callable[[Memory], T],
        *,
        lake: bool,
        begin_of: Callable[[T, Ns], Ns | None] = lambda *_: None,
    ) -> tuple[T, FromLake | None]:
        """Returns what `ask` finds in a memory, and what to report with it if that is a lake's.

        With `lake` the memory of the lake comes first, where it has anything of the robot; the
        mounted one answers what needs messages that the lake does not have. Without `lake` the
        mounted one comes first, unless it has no bag; the lake answers where it has no data, as
        retention deletes bags. `begin_of` returns from when an answer is, by it and the newest log
        time.

        Raises:
            NoDataError: none of the two has an answer; it is that of the mounted one, if any.
            NotInLakeError: it needs such messages, and the robot has no bags of its own.
        """
        source = self._lake_source
        if source is None:
            return ask(self.memory()), None
        if not lake and self._has_bags():
            return self._own_first(source, ask, begin_of)
        try:
            found = _of_lake(source, ask, begin_of)
            if source.latest is not None or not self.is_mounted:
                return found
        except NoDataError:
            if source.latest is not None or not self.is_mounted:
                raise
        except NotInLakeError:
            if not self._has_bags():
                raise
        return ask(self.memory()), None

    def _own_first(
        self, source: LakeSource, ask: Callable[[Memory], T], begin_of: Callable[[T, Ns], Ns | None]
    ) -> tuple[T, FromLake | None]:
        """Returns what the mounted memory has; where it has no data, what the lake has."""
        try:
            return ask(self.memory()), None
        except NoDataError as error:
            try:
                return _of_lake(source, ask, begin_of)
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


def _of_lake(
    source: LakeSource, ask: Callable[[Memory], T], begin_of: Callable[[T, Ns], Ns | None]
) -> tuple[T, FromLake]:
    """Returns what `ask` finds in a lake, with its notes; raises what it raises."""
    begin: Ns | None = None
    try:
        try:
            found = ask(source.memory)
            if source.latest is not None:
                begin = begin_of(found, source.latest)
        finally:
            # Also of an answer that failed: they are not those of the next one.
            notes = (*source.notes(begin),)
    except NoDataError as error:
        raise NoDataError(error.reason, "; ".join((error.detail, *notes)), error.notes) from error
    return found, FromLake(source.latest, notes)


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
        self.robots: Mapping[str, Robot] = {each.name: each for each in robots}
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
            self.robots = {**self.robots, **{each.name: each for each in found}}
        return found

    def allowed(self, call: Call) -> list[Robot]:
        """Returns the robots that a call may ask about, in the order of the configuration."""
        robots = call.robots
        return [each for name, each in self.robots.items() if robots is None or name in robots]

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
        for each in allowed:
            if each.name == name:
                return each
        raise InvalidArgumentsError(
            f"there is no robot {abbreviate(name)}; there {names_of(allowed)}"
        )

    def the_one(self, tool: str, call: Call) -> Robot:
        """Returns the only robot that a call may ask about.

        Raises:
            InvalidArgumentsError: there are several; the sentence names them.
        """
        allowed = self.allowed(call)
        if len(allowed) == 1:
            return allowed[0]
        example = f", e.g. robot={allowed[0].name}" if allowed else ""
        raise InvalidArgumentsError(
            f"which robot? {tool} answers for one: pass robot{example}; there {names_of(allowed)}"
        )


def names_of(robots: Iterable[Robot]) -> str:
    """Returns the names of robots for a sentence."""
    names = [each.name for each in robots]
    if not names:
        return "is none"
    return f"{'is' if len(names) == 1 else 'are'} {listed(names, at_most=_MOST_NAMED)}"
