"""The robots of a fleet, each with a memory of its own."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ros2_memory.core.errors import InvalidArgumentsError
from ros2_memory.core.text import abbreviate, listed
from ros2_memory.core.timebase import MIN_NS, Clock

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.context import Call, Memory

_MOST_NAMED = 50


@dataclass(frozen=True, slots=True)
class StoppedClock(Clock):
    """The time at which a question was asked, so that it is one question to all robots."""

    at: Ns

    def now(self) -> Ns:
        """Returns that time."""
        return self.at


class Robot:
    """One robot of a fleet. Its memory is built when it is first needed; no bag is read for that.

    Attributes:
        name: as replies and arguments have it; never a path.
        bag_dir: the bag directory, which need not exist.
    """

    def __init__(self, name: str, bag_dir: Path, build: Callable[[], Memory]) -> None:
        self.name = name
        self.bag_dir = bag_dir
        self._build = build
        self._lock = threading.Lock()
        self._memory: Memory | None = None

    def memory(self) -> Memory:
        """Returns the robot's memory, always the same one."""
        with self._lock:
            if self._memory is None:
                self._memory = self._build()
            return self._memory

    def latest_known(self) -> Ns:
        """Returns the log time of its newest data as of the last scan; the least before the first.

        Nothing is scanned for it.
        """
        published = None if self._memory is None else self._memory.index.published
        latest = None if published is None else published.latest
        return MIN_NS if latest is None else latest


class Fleet:
    """The robots that one server answers for.

    Args:
        robots: all of them; no two have one name.
        clock: the wall clock, read once for a question to several.
        shared_map: whether coordinates mean the same place for all of them.
    """

    def __init__(self, robots: Iterable[Robot], clock: Clock, *, shared_map: bool = False) -> None:
        self.robots = {each.name: each for each in robots}
        self.clock = clock
        self.shared_map = shared_map

    def allowed(self, call: Call) -> list[Robot]:
        """Returns the robots that a call may ask about, in the order of the configuration."""
        robots = call.robots
        return [each for name, each in self.robots.items() if robots is None or name in robots]

    def named(self, name: object, call: Call) -> Robot:
        """Returns the robot of a name.

        Raises:
            InvalidArgumentsError: there is none, or the call may not ask about it, which the
                sentence does not tell apart.
        """
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
