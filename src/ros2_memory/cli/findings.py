"""What `ros2-memory doctor` finds: how bad it is, what was seen, and what to do about it.

And its checks of a lake: on a robot that waits for it, and where it is written. Nothing is changed:
where there is no lake yet, none is made.
"""

from __future__ import annotations

import os
from enum import IntEnum
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

from ros2_memory.bag_dir.heartbeat import Heartbeat, read_heartbeat
from ros2_memory.bag_dir.layout import (
    MOMENTS_FOLDER,
    OWN_FOLDER,
    SHIPPED_FILE,
    has_recorded,
    is_carried,
)
from ros2_memory.bag_dir.state_files import is_shipped, read_receipts
from ros2_memory.bootstrap_fleet import lake_location
from ros2_memory.columns.store import relative
from ros2_memory.config import NullRecorderNode, Settings
from ros2_memory.core.errors import ConfigError, LakeError
from ros2_memory.core.model import BagState
from ros2_memory.core.text import counted
from ros2_memory.core.timebase import NS_PER_S, Ns, iso_local

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ros2_memory.history.context import Memory
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.lake.warehouse import LakeLocation

_LATE_NS: Final[Ns] = 3600 * NS_PER_S
"""A hub that is reached has confirmed closed bags after this time."""


class Examined(NamedTuple):
    """The robot that a check looks at; `now` is the wall clock's time."""

    settings: Settings
    memory: Memory
    snapshot: Snapshot
    now: Ns

    @property
    def records(self) -> bool:
        """Whether bags are recorded there."""
        return not isinstance(self.settings.recorder, NullRecorderNode)

    @property
    def live(self) -> Heartbeat | None:
        """The heartbeat of a recorder that is at work."""
        heartbeat = read_heartbeat(self.settings.recording.bag_dir).heartbeat
        return heartbeat if heartbeat and heartbeat.is_live(self.now) else None


class Level(IntEnum):
    """How bad a finding is; its value is the exit code."""

    OK = 0
    WARNING = 1
    ERROR = 2

    def __str__(self) -> str:
        """Returns it in small letters."""
        return self.name.lower()


class Finding(NamedTuple):
    """What was seen, and what to do about it; nothing where all is in order.

    `about` is empty where it is the concern of the check.
    """

    level: Level
    about: str
    seen: str
    do: str | None = None


ok: Final = partial(Finding, Level.OK, "")
warning: Final = partial(Finding, Level.WARNING, "")
error: Final = partial(Finding, Level.ERROR, "")


def check_shipping(robot: Examined) -> Iterator[Finding]:
    """Checks, where age waits until bags are shipped, whether they are."""
    settings, _, snapshot, now = robot
    if not settings.retention.require_shipped:
        return
    bag_dir = settings.recording.bag_dir
    try:
        receipts = read_receipts(bag_dir)
    except OSError as problem:
        seen = f"{bag_dir / SHIPPED_FILE} cannot be read: {problem.strerror or problem}"
        yield error(seen, "correct its permissions: until then no bag is shipped")
        return
    closed = [
        (name, bag)
        for bag in snapshot.bags
        if bag.state is BagState.CLOSED and not is_carried(bag.path)
        if not (name := relative(bag.file, str(bag_dir))).startswith(f"{MOMENTS_FOLDER}/")
    ]
    waiting = [bag for name, bag in closed if not is_shipped(receipts, name, bag.size)]
    newest = max((receipt.at for receipt in receipts.values()), default=None)
    seen = f"{len(waiting)} of {counted(len(closed), 'closed bag')} not shipped"
    if newest is None:
        seen += ", and there is no receipt: no bag is deleted for its age"
    else:
        seen += f"; the newest receipt is from {iso_local(newest)}"
    latest = now - _LATE_NS
    if min((bag.end for bag in waiting), default=now) < latest and (newest or 0) < latest:
        do = "does ros2-memory ship run, and may it write here? `doctor` there looks after it"
        yield warning(seen, do)
    else:
        yield ok(seen)


def check_lake(settings: Settings) -> Iterator[Finding]:
    """Checks, where bags are shipped, whether that can work; and whether the lake is reached."""
    if settings.lake.warehouse is None:
        return
    try:
        location = lake_location(settings)
        committed = location.last_commit()
    except (ConfigError, LakeError) as problem:
        do = "correct lake.warehouse, lake.uri or what leads there; nothing is lost meanwhile"
        yield error(str(problem), do)
        return
    if committed is None:
        do = "ros2-memory ship makes it; was it there before, is its disk mounted?"
        yield warning(f"{location.warehouse} has no bag yet", do)
    else:
        yield ok(f"{location.warehouse}; its newest commit is from {iso_local(committed)}")
    # A server that asks the lake ships nothing.
    if settings.lake.engine is None:
        yield from _check_writer(location, has_bags=committed is not None)
        for name, bag_dir in settings.fleet.robots.items():
            yield from _check_receipts(name, bag_dir)


def _check_writer(location: LakeLocation, *, has_bags: bool) -> Iterator[Finding]:
    # The extra is there now.
    from ros2_memory.lake.warehouse import WRITTEN_FILE, holder_of  # noqa: PLC0415

    if has_bags and not (location.state_dir / WRITTEN_FILE).exists():
        seen = (
            f"{location.state_dir} (lake.state_dir) has no {WRITTEN_FILE}, though the lake has "
            "bags: another machine or folder was used to write it"
        )
        do = "share that folder: the lock of the one writer is there, and what was forgotten"
        yield warning(seen, do)
    try:
        holder = holder_of(location.state_dir)
    except LakeError as problem:
        yield error(str(problem), "choose another lake.state_dir")
        return
    yield ok(f"{holder or 'no process'} writes into it now")


def _check_receipts(name: str, bag_dir: Path) -> Iterator[Finding]:
    """Checks whether receipts can be written for a robot's recorder."""
    if not has_recorded(bag_dir):
        return
    own, file = bag_dir / OWN_FOLDER, bag_dir / SHIPPED_FILE
    for path in (file, own, bag_dir):
        if path.exists():
            if not os.access(path, os.W_OK):
                seen = (
                    f"{name}: {path} is read-only here: no receipts can be written, so "
                    "retention.require_shipped can never work on that robot"
                )
                do = "mount it writable for the user of ros2-memory ship, or do not require it"
                yield warning(seen, do)._replace(about="robot")
            return
