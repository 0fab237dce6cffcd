"""What `ros2-memory doctor` looks at, and what it says of it: one function for each concern.

A finding that is not in order says what to do. Nothing here changes anything.
"""

from __future__ import annotations

import getpass
import os
import shutil
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from enum import IntEnum
from typing import TYPE_CHECKING, Final

from ros2_memory.bag_dir.heartbeat import RecorderState, read_heartbeat
from ros2_memory.bootstrap import build_recorder, query_settings_of
from ros2_memory.cli.oddities import counted_as_active, merged
from ros2_memory.config import NullRecorderNode
from ros2_memory.core import directories
from ros2_memory.core.errors import BagError, EpisodicError
from ros2_memory.core.text import MAX_NAMED, counted, listed
from ros2_memory.core.timebase import NS_PER_S, iso_local, unix_from_ns
from ros2_memory.history.context import Call
from ros2_memory.index.clock_faults import FIRST_BAGS_NS, FUTURE_NS
from ros2_memory.index.listed_splits import absent_splits, describe_absent
from ros2_memory.insights.status import nothing_here, odd_bags
from ros2_memory.queries import data_time_range
from ros2_memory.recorder.process.topics import TopicSelection, load_topics
from ros2_memory.retention.policy import GB
from ros2_memory.storage.base import Closing

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from ros2_memory.bag_dir.heartbeat import Heartbeat
    from ros2_memory.config import Settings
    from ros2_memory.core.model import JsonValue, SetAside
    from ros2_memory.core.timebase import Ns
    from ros2_memory.history.context import Latching, Memory
    from ros2_memory.index.snapshot import Snapshot
    from ros2_memory.storage.base import BagReader

LATELY_NS: Final = 3600 * NS_PER_S
"""A topic that is not in the newest data of this length is not recorded just now."""

_MSG_FOLDERS: Final = "reader.custom_msg_paths"
_NOT_DECODED: Final = "nothing decodes them here: record them as ROS 2 messages (CDR) or as JSON"
_NOT_REPAIRED: Final = "copy them anew from where they were recorded, or delete them"
_UNOFFERED: Final = "no publisher has offered it since the recorder started"


class Level(IntEnum):
    """How bad it is, and the exit code that follows."""

    OK = 0
    WARNING = 1
    ERROR = 2


@dataclass(frozen=True, slots=True)
class Finding:
    """What was seen of one concern; `do` says what to do about it."""

    level: Level
    about: str
    seen: str
    do: str = ""

    def as_json(self) -> dict[str, JsonValue]:
        """For programs."""
        return {
            "level": self.level.name.lower(),
            "about": self.about,
            "seen": self.seen,
            "do": self.do or None,
        }


def of_bag_dir(settings: Settings, foreign_bytes: int = 0) -> Iterator[Finding]:
    """Whether the bag directory is there, may be used by this user, and has room.

    `foreign_bytes` is what bags take that its recorder did not make, and keeps.
    """
    bag_dir, about = settings.recording.bag_dir.absolute(), "bag_dir"
    records = not isinstance(settings.recorder, NullRecorderNode)
    if not bag_dir.is_dir():
        if not records:
            do = "name the directory of the bags: MEMORY_BAG_DIR, or recording.bag_dir=DIR"
            yield Finding(Level.ERROR, about, f"{bag_dir} is no directory", do)
            return
        yield Finding(
            Level.WARNING,
            about,
            f"{bag_dir} is not there",
            "the recorder makes it when it starts; is its disk mounted?",
        )
    else:
        yield from _permissions(bag_dir, records=records)
    if records:
        yield from _room(settings, bag_dir, foreign_bytes)


def _permissions(bag_dir: Path, *, records: bool) -> Iterator[Finding]:
    user = _user()
    wanted = os.R_OK | os.X_OK
    if not os.access(bag_dir, wanted):
        do = "give this user the right to read it, or run as the user of the services"
        yield Finding(Level.ERROR, "bag_dir", f"{user} may not read {bag_dir}", do)
    elif records and not os.access(bag_dir, wanted | os.W_OK):
        yield Finding(
            Level.WARNING,
            "bag_dir",
            f"{user} may read {bag_dir}, and not write there",
            "fine if the recorder runs as another user, who may: "
            "sudo -u USER ros2-memory doctor looks as that one",
        )
    else:
        may = "read and write" if records else "read"
        yield Finding(Level.OK, "bag_dir", f"{bag_dir}, where {user} may {may}")


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container's user without an entry
        return f"user {os.getuid()}"


def _room(settings: Settings, bag_dir: Path, foreign_bytes: int) -> Iterator[Finding]:
    there = next(each for each in (bag_dir, *bag_dir.parents) if each.is_dir())
    try:
        disk = shutil.disk_usage(there)
    except OSError as error:
        yield Finding(
            Level.ERROR, "disk", f"{there} cannot be measured: {error}", "look after the disk"
        )
        return
    mount = next(each for each in (there, *there.parents) if os.path.ismount(each))
    kept = settings.retention
    free, used = disk.free / GB, max(_size(bag_dir) - foreign_bytes, 0) / GB
    seen = f"{free:.1f} GB free on {mount}; {used:.1f} of {kept.max_total_gb:g} GB used"
    if foreign_bytes:
        seen += (
            f"; bags that this recorder did not make take {foreign_bytes / GB:.2g} GB more, and "
            "are neither deleted nor counted: `ros2-memory adopt DIR` takes those of a directory"
        )
    if free < kept.min_free_gb:
        do = (
            f"recording pauses below retention.min_free_gb={kept.min_free_gb:g}; delete what else "
            "lies on this disk"
        )
        yield Finding(Level.ERROR, "disk", seen, do)
    elif free - kept.min_free_gb < kept.max_total_gb - used:
        do = (
            "the disk is full before the budget is: lower retention.max_total_gb to "
            f"{max(free - kept.min_free_gb + used, 0):.1f}, or make room"
        )
        yield Finding(Level.WARNING, "disk", seen, do)
    else:
        yield Finding(Level.OK, "disk", seen)


def _size(folder: Path) -> int:
    """The bytes of all files below a folder, as far as they can be seen; two names count once."""
    sizes: dict[tuple[int, int], int] = {}
    for _, entries in directories.walk(folder):
        for entry in entries:
            with suppress(OSError):
                if not entry.is_dir(follow_symlinks=False):
                    status = entry.stat(follow_symlinks=False)
                    sizes[status.st_dev, status.st_ino] = status.st_size
    return sum(sizes.values())


def of_clock(snapshot: Snapshot, now: Ns) -> Iterator[Finding]:
    """Whether this machine's clock can be right, and those that dated the bags."""
    do = "set the clock (timedatectl, chrony); bags keep the dates they were given"
    latest = snapshot.dating.latest
    if now < FIRST_BAGS_NS:
        yield Finding(Level.ERROR, "clock", f"it says {iso_local(now)}: it was never set", do)
    elif latest is not None and latest > now + FUTURE_NS:
        seen = f"the newest data is dated {unix_from_ns(latest - now):.0f} s after the present"
        yield Finding(Level.ERROR, "clock", seen, do)
    elif snapshot.dating.faults:
        faults = counted(len(snapshot.dating.faults), "bag was", "bags were")
        seen = f"{faults} dated by a wrong clock: `ros2-memory info` lists them"
        yield Finding(Level.WARNING, "clock", seen, do)
    else:
        yield Finding(Level.OK, "clock", f"it says {iso_local(now)}")


def of_bags(settings: Settings, memory: Memory) -> Iterator[Finding]:
    """Whether all bags can be read, and all messages in them understood."""
    told = data_time_range(memory, Call())
    snapshot = memory.index.snapshot()
    if snapshot.problem:
        do = "see bag_dir above; is the disk mounted?"
        yield Finding(Level.ERROR, "bags", snapshot.problem, do)
        return
    newest = "" if told.latest is None else f", the newest from {iso_local(told.latest)}"
    answering = counted(told.bags, "bag answers", "bags answer")
    if told.bags or told.active:
        yield Finding(Level.OK, "bags", f"{answering}{newest}")
    else:
        do = "recording.bag_dir=DIR names another directory; a recorder fills this one"
        yield Finding(Level.WARNING, "bags", nothing_here(snapshot), do)
    left = (*told.damaged, *told.incomplete)
    if left:
        yield Finding(
            Level.WARNING,
            "bags",
            f"{len(told.damaged)} damaged and {len(told.incomplete)} unfinished: "
            f"{listed([f'{each.path.name} ({each.reason})' for each in left])}",
            _how_to_repair(left, memory.reader, settings.recording.bag_dir),
        )
    if told.unread:
        names = listed([each.path.name for each in told.unread])
        do = "storage=rosbag2 reads sqlite and compressed bags, too"
        files = counted(len(told.unread), "file is", "files are")
        yield Finding(Level.WARNING, "bags", f"{files} not read: {names}", do)
    odd = odd_bags(snapshot)
    if odd:
        seen = counted(len(odd), "bag is not whole", "bags are not whole")
        names = listed([f"{each.path.name} ({'; '.join(each.summary.notes)})" for each in odd])
        do = "what is readable of them answers; record or copy them anew for the rest"
        yield Finding(Level.WARNING, "bags", f"{seen}: {names}", do)
    for sentence in describe_absent(absent_splits(snapshot, memory.index.bag_dir)):
        do = "copy what is missing from where it was recorded"
        yield Finding(Level.WARNING, "bags", sentence, do)
    if told.undecodable:
        # Those that a configured folder would mend say so themselves.
        lacking = [each for each in told.undecodable if _MSG_FOLDERS in each.reason]
        others = [each for each in told.undecodable if _MSG_FOLDERS not in each.reason]
        name_them = f"name the folder with the .msg files in {_MSG_FOLDERS}"
        for some, do in ((lacking, name_them), (others, _NOT_DECODED)):
            if some:
                topics = listed([f"{each.topic} ({each.reason})" for each in some])
                seen = f"{counted(len(some), 'topic')} cannot be decoded: {topics}"
                yield Finding(Level.WARNING, "bags", seen, do)


def _how_to_repair(left: Sequence[SetAside], reader: BagReader, bag_dir: Path) -> str:
    """What mends bags that were left open or are damaged, as far as anything does."""
    others = sum(not _is_repairable(each.path, reader) for each in left)
    if others == len(left):
        return _NOT_REPAIRED
    rest = f"; {others} of them it cannot repair: {_NOT_REPAIRED}" if others else ""
    return f"ros2-memory recover {bag_dir}{rest}"


def _is_repairable(path: Path, reader: BagReader) -> bool:
    """Whether `ros2-memory recover` takes a file: MCAP that its writer did not finish."""
    try:
        return path.suffix == ".mcap" and reader.closing(path) is Closing.OPEN
    except BagError:
        return False


def of_what_lies_there(memory: Memory, snapshot: Snapshot) -> Iterator[Finding]:
    """Whether what lies in the directory is one history, and whether all of it is told of."""
    pairs = merged(snapshot)
    for pair in pairs[:MAX_NAMED]:
        seen = (
            f"recordings {pair.first} and {pair.second} overlap from {iso_local(pair.start)} to "
            f"{iso_local(pair.end)}, and are answered together"
        )
        do = "give the bags of each robot or run a folder of their own, and a server each"
        yield Finding(Level.WARNING, "bags", seen, do)
    if len(pairs) > MAX_NAMED:
        seen = f"{counted(len(pairs) - MAX_NAMED, 'more pair overlaps', 'more pairs overlap')}"
        do = "`ros2-memory info` lists them all"
        yield Finding(Level.WARNING, "bags", seen, do)
    for path, until in counted_as_active(memory, snapshot):
        seen = (
            f"{path.parent.name}/{path.name} has no end and was written lately: until "
            f"{iso_local(until)} it counts as still being written"
        )
        do = "if nobody writes it, as a copy, wait until then: what is whole of it answers"
        yield Finding(Level.WARNING, "bags", seen, do)


def of_recorder(settings: Settings, now: Ns) -> Iterator[Finding]:
    """What the recorder last said of itself."""
    about = "recorder"
    if isinstance(settings.recorder, NullRecorderNode):
        yield Finding(Level.OK, about, "recorder=none: nothing is recorded here")
        return
    start = "start it: ros2-memory-recorder, or systemctl start ros2-memory-recorder"
    heartbeat, reason = read_heartbeat(settings.recording.bag_dir)
    if heartbeat is None:
        yield Finding(Level.ERROR, about, str(reason), start)
        return
    age = f"{unix_from_ns(abs(now - heartbeat.updated)):.0f} s ago"
    if heartbeat.state is RecorderState.STOPPED:
        yield Finding(Level.WARNING, about, f"it was stopped {age}", start)
    elif not heartbeat.is_live(now):
        do = "journalctl -u ros2-memory-recorder says why it ended; " + start
        yield Finding(Level.ERROR, about, f"it was last heard of {age}, and never said why", do)
    elif heartbeat.state is RecorderState.PAUSED:
        why = heartbeat.last_error or "it does not say why"
        yield Finding(Level.ERROR, about, f"it is paused: {why}", "see disk above")
    else:
        yield Finding(
            Level.OK,
            about,
            f"{heartbeat.state}, {counted(len(heartbeat.subscribed), 'topic')} subscribed",
        )
        yield from _troubles(heartbeat)


def _troubles(heartbeat: Heartbeat) -> Iterator[Finding]:
    if heartbeat.silent:
        do = (
            "is their publisher running? Under another user it is heard over the network alone: "
            "FASTDDS_BUILTIN_TRANSPORTS=UDPv4 for the recorder"
        )
        seen = f"subscribed and never heard: {listed(heartbeat.silent)}"
        yield Finding(Level.WARNING, "recorder", seen, do)
    if heartbeat.age_held:
        do = "have the clock synchronised: timedatectl set-ntp true, or chrony; the budget holds"
        yield Finding(Level.WARNING, "recorder", heartbeat.age_held, do)
    if heartbeat.last_error:
        seen = f"its last error: {heartbeat.last_error}"
        if heartbeat.restarts:
            times = counted(heartbeat.restarts, "time")
            seen = f"it had to start ros2 bag record anew {times}; {seen}"
        yield Finding(Level.WARNING, "recorder", seen, "its log has more of it")


def of_ros(settings: Settings, reader: BagReader) -> Iterator[Finding]:
    """Whether `ros2 bag record` can be run, in the environment that the recorder gives it."""
    if isinstance(settings.recorder, NullRecorderNode):
        return
    try:
        build_recorder(settings, reader=reader).check()
    except EpisodicError as error:
        reason, _, do = str(error).partition("; ")
        yield Finding(Level.ERROR, "ros", reason, do or "correct recorder.setup_files")
    else:
        named = ", ".join(str(each) for each in settings.recorder.setup_files)
        seen = f"ros2 bag record can be run{f' after {named}' if named else ''}"
        yield Finding(Level.OK, "ros", seen)


def of_topics(settings: Settings, snapshot: Snapshot, now: Ns) -> Iterator[Finding]:
    """Whether what `topics.yaml` names has been recorded lately."""
    if isinstance(settings.recorder, NullRecorderNode):
        return
    try:
        selection = load_topics(settings.recording.topics_file)
    except EpisodicError as error:
        yield Finding(Level.ERROR, "topics", str(error), "correct recording.topics_file")
        return
    missing = never_heard(selection, snapshot, query_settings_of(settings).latching)
    heartbeat = read_heartbeat(settings.recording.bag_dir).heartbeat
    live = heartbeat is not None and heartbeat.is_live(now)
    unoffered = [*heartbeat.missing] if live and heartbeat is not None else []
    listed_there = counted(len(selection.entries), "entry", "entries")
    file = settings.recording.topics_file
    if not snapshot.bags:
        seen = f"{file} lists {listed_there}; nothing is recorded yet"
        yield Finding(Level.OK, "topics", seen)
    elif not missing and not unoffered:
        seen = f"{listed_there} of {file}: all are in the newest hour of data, or latched"
        yield Finding(Level.OK, "topics", seen)
    for entry, near in missing.items():
        hint = f"is it {' or '.join(near)}? " if near else ""
        why = f"; {_UNOFFERED}" if entry in unoffered else ""
        yield Finding(
            Level.WARNING,
            "topics",
            f"{entry} is in {file}, and not in the newest hour of data{why}",
            f"{hint}compare with `ros2 topic list`; a name that nobody publishes is recorded by "
            "nobody",
        )

    for entry in unoffered:
        if entry not in missing:
            do = "is its publisher running? compare with `ros2 topic list`"
            yield Finding(Level.WARNING, "topics", f"{entry} is in {file}; {_UNOFFERED}", do)


def never_heard(
    selection: TopicSelection, snapshot: Snapshot, latching: Latching
) -> Mapping[str, list[str]]:
    """The entries of which nothing was recorded lately, with recorded names that are like them."""
    latest = snapshot.dating.latest
    heard = []
    for topic in snapshot.topics():
        last = max(each.last for each in snapshot.stated(topic).values())
        waits = latching.is_latched(snapshot, topic) or snapshot.is_log(topic)
        if latest is None or waits or last > latest - LATELY_NS:
            heard.append(topic)
    if not snapshot.bags:
        return {}
    return {
        entry: get_close_matches(entry, snapshot.topics(), n=2)
        for entry in selection.entries
        if not any(TopicSelection((entry,)).matches(topic) for topic in heard)
    }
