"""A housekeeper over a folder of bags, as the recorder's daemon has one."""

import hashlib
import json
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.heartbeat import RecorderState
from ros2_memory.bag_dir.layout import DELETED_FILE, LIST_FILE, MOMENT_FILE, OWN_FOLDER
from ros2_memory.bag_dir.metadata_yaml import Contents, describing
from ros2_memory.bag_dir.moment_file import (
    Outcome,
    PendingRequest,
    SavedMoment,
    SaveRequest,
    write_saved_moment,
)
from ros2_memory.bag_dir.own_recordings import OwnRecordings, folders_with_bags
from ros2_memory.core.directories import identity_of
from ros2_memory.core.timebase import NS_PER_S, Clock
from ros2_memory.recorder.background import Background
from ros2_memory.recorder.housekeeping import Housekeeping
from ros2_memory.retention.collect import GarbageCollector
from ros2_memory.retention.policy import RetentionLimits
from ros2_memory.retention.saved_moments import MomentKeeper
from ros2_memory.storage.base import BagReader, BagWriter
from ros2_memory.storage.mcap.writer import McapWriter
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, odom, write_mcap
from tests.support.clocks import SettableClock
from tests.support.heartbeats import beat

PLENTY = 10**15
HOUR = 3600 * NS_PER_S


class Direct(Background):
    """Runs each job at once, and raises what it raises."""

    def add(self, task: str, job: Callable[[], object]) -> None:
        del task
        job()


def keeper_of(
    bag_dir: Path,
    *,
    max_bytes: int = PLENTY,
    max_age_h: float = 10**6,
    min_free_bytes: int = 0,
    keeps_foreign: bool = False,
    require_shipped: bool = False,
    clock: Clock | None = None,
    reader: BagReader | None = None,
    writer: BagWriter | None = None,
    **how: Any,
) -> Housekeeping:
    """A housekeeper, mostly of all bags, its own or not (retention.foreign=delete).

    Its clock is right, and an hour later unless one is given.
    """
    limits = RetentionLimits(
        max_bytes, round(max_age_h * HOUR), min_free_bytes, keeps_foreign, require_shipped
    )
    given: dict[str, Any] = {
        "is_synchronised": lambda: True,
        "static_topics": ("/tf_static",),
        "measure_free": lambda _: PLENTY,
    }
    of_house = {name: how.pop(name) for name in ("screening", "background") if name in how}
    own = how.pop("own", None) or OwnRecordings(bag_dir)
    bags, writer = BagDirReader(reader or McapReader()), writer or McapWriter()
    clock = clock or later()
    moments = MomentKeeper(
        bag_dir, how.pop("moments_bytes", PLENTY), clock, own, how.pop("rule_bytes", {})
    )
    watch = how.pop("watch", None)
    return Housekeeping(
        bag_dir,
        bags,
        writer,
        clock,
        GarbageCollector(bag_dir, bags, writer, limits, own, **given | how),
        moments,
        own=own,
        split_duration_s=10.0,
        triggers=None if watch is None else watch(moments),
        **{"background": Direct(), **of_house},
    )


def later(seconds: int = 3600) -> SettableClock:
    return SettableClock(time.time_ns() + seconds * NS_PER_S)


def recording_now(bag_dir: Path, *recordings: str, clock: Clock | None = None) -> None:
    """Has a recorder say that it is writing these recordings."""
    beat(bag_dir, (clock or later()).now(), recordings=recordings)


def recorded_before(bag_dir: Path) -> Path:
    """A bag directory in which a recorder was at work, long ago."""
    bag_dir.mkdir(parents=True, exist_ok=True)
    beat(bag_dir, NS_PER_S, RecorderState.STOPPED)
    return bag_dir


@contextmanager
def recorder_at_work(bag_dir: Path, clock: Clock) -> Iterator[None]:
    """A recorder that looks for wishes again and again, as the daemon does."""
    house, over = keeper_of(bag_dir, clock=clock), threading.Event()

    def work() -> None:
        while not over.wait(0.01):
            house.keep_moments()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def files_in(bag_dir: Path) -> list[str]:
    """Every file and directory, relative to the bag directory, but what lists them."""
    found = {path.relative_to(bag_dir).as_posix() for path in bag_dir.rglob("*")}
    found -= {DELETED_FILE, LIST_FILE}
    if not any(each.startswith(f"{OWN_FOLDER}/") for each in found):
        found.discard(OWN_FOLDER)
    return sorted(found)


def size_of(bag_dir: Path) -> int:
    """The bytes of all files that the budget counts, each inode once."""
    files = (path for path in bag_dir.rglob("*") if path.is_file())
    sizes = {
        path.stat().st_ino: path.stat().st_size for path in files if path != bag_dir / DELETED_FILE
    }
    return sum(sizes.values())


def state(folder: Path) -> dict[str, tuple[object, ...]]:
    """Everything of every file and directory but when it was last read."""
    found: dict[str, tuple[object, ...]] = {}
    for path in (folder, *sorted(folder.rglob("*"))):
        status = path.lstat()
        content = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
        found[str(path.relative_to(folder))] = (
            status.st_mode,
            status.st_ino,
            status.st_size,
            status.st_mtime_ns,
            status.st_ctime_ns,
            content,
        )
    return found


def copied(source: Path, target: Path) -> Path:
    """A copy of a folder that may be changed."""
    shutil.copytree(source, target)
    for path in (target, *target.rglob("*")):
        path.chmod(0o755 if path.is_dir() else 0o644)
    return target


S = 10**9


def own_all(bag_dir: Path) -> OwnRecordings:
    """Lists every directory that holds bags now."""
    own = OwnRecordings(bag_dir)
    found = {own.name_of(path): identity_of(path) for path in folders_with_bags(bag_dir)}
    own.adopt({name: identity for name, identity in found.items() if name and identity})
    return own


def list_ended(bag_dir: Path, name: str) -> OwnRecordings:
    """Lists a recording with its splits, as a recorder that was ended as it should leaves it."""
    own = OwnRecordings(bag_dir)
    own.begin(name)
    own.complete(name)
    own.note_splits(name, {path.name for path in (bag_dir / name).glob("*.mcap")}, ended=True)
    return own


def lines(bag_dir: Path) -> list[dict[str, Any]]:
    """What the list says, line by line, without their checks."""
    rows = [json.loads(line) for line in (bag_dir / LIST_FILE).read_text().splitlines()]
    return [{key: value for key, value in row.items() if key != "crc32"} for row in rows]


def embedding(path: Path, *, start: int = 1_790_000_000 * S) -> Path:
    """A split as rosbag2 writes it since Iron: its metadata right behind the header."""
    text = (
        "version: 9\nstorage_identifier: mcap\nrelative_file_paths:\n"
        f"  - {path.name}\ncustom_data: ~\nros_distro: jazzy\n"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=400)
        writer.start("ros2", "libmcap 1.3.0")
        writer.add_metadata("rosbag2", {"serialized_metadata": text})
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        channel = writer.register_channel("/chatter", "cdr", schema, {})
        for number in range(20):
            at = start + number * S // 4
            writer.add_message(channel, at, b"\0\1\0\0\2\0\0\0x\0", at, number)
        writer.finish()
    return path


T0 = 1_790_000_000 * S
NOW = T0 + 4 * 3600 * S
A, B = "rec_20260921T101320Z", "rec_20260921T102320Z"


def bag(path: Path, start: int, layout: McapLayout | None = None) -> Path:
    """A split of ten seconds; where the robot is tells the time."""
    times = [T0 + (start + n) * S for n in range(10)]
    return write_mcap(path, [odom(at, (at - T0) / S, 2.0) for at in times], layout)


def recording(bag_dir: Path, name: str, start: int, splits: int = 6) -> list[Path]:
    made = [bag(bag_dir / name / f"{name}_{n}.mcap", start + n * 10) for n in range(splits)]
    (bag_dir / name / "handover.json").write_text('{"format": 1}')
    return made


def described(recording: Path) -> Path:
    """Writes metadata.yaml of a recording, as its recorder would have left it."""
    reader, path = McapReader(), recording / "metadata.yaml"
    contents = {
        bag.name: Contents(reader.summarize(bag), reader.channels(bag))
        for bag in sorted(recording.glob("*.mcap"))
    }
    path.write_text(describing("", contents))
    return path


def asked(
    bag_dir: Path, start: int, end: int, label: str = "here", at: int = NOW
) -> PendingRequest:
    """Asks for what was recorded in these seconds."""
    pending = PendingRequest(bag_dir, label, T0 + start * S, T0 + end * S, at)
    pending.post()
    return pending


def kept(
    house: Housekeeping, bag_dir: Path, start: int, end: int, label: str = "here", at: int = NOW
) -> Outcome:
    pending = asked(bag_dir, start, end, label, at)
    house.keep_moments()
    outcome = pending.outcome()
    pending.close()
    assert outcome is not None
    return outcome


def house_of(bag_dir: Path, **limits: Any) -> Housekeeping:
    return keeper_of(bag_dir, **{"clock": SettableClock(NOW), **limits})


def in_moments(bag_dir: Path) -> list[str]:
    """The bags that are kept, each as moment and name."""
    return [
        path.relative_to(bag_dir / "moments").as_posix()
        for path in sorted((bag_dir / "moments").rglob("*.mcap"))
    ]


def made_moment(folder: Path, label: str = "here") -> Path:
    """Makes the folder of a saved moment, as the recorder does."""
    folder.mkdir(parents=True)
    request = SaveRequest(number="0" * 32, label=label, start=T0, end=T0 + S, asked=NOW)
    write_saved_moment(folder, SavedMoment(request, pending=False))
    return folder


def told_of(bag_dir: Path) -> dict[str, Any]:
    [path] = (bag_dir / "moments").glob(f"*/{MOMENT_FILE}")
    reported: dict[str, Any] = json.loads(path.read_text())
    return reported
