"""A world without processes for the recorder's supervision: time is moved, recorders are played.

The recorders write real MCAP files. On each topic one message is published at every quarter of a
second; all recorders that have subscribed receive it, each a little later.
"""

import json
import os
from collections import Counter
from collections.abc import Callable, Collection, MutableMapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml
from structlog.testing import capture_logs

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.heartbeat import HEARTBEAT_FILE
from ros2_memory.bag_dir.own_recordings import OwnRecordings
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.model import TimeWindow
from ros2_memory.core.timebase import NS_PER_S, Clock
from ros2_memory.recorder.background import Background
from ros2_memory.recorder.housekeeping import Housekeeping, HouseStatus
from ros2_memory.recorder.process.child import Child
from ros2_memory.recorder.process.topics import TopicsFile
from ros2_memory.recorder.reception import Reception
from ros2_memory.recorder.sessions import Orders, Required
from ros2_memory.recorder.supervisor import Supervisor
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import McapLayout, Msg, boolean, write_mcap

T0 = 1_795_150_800 * NS_PER_S
PERIOD = NS_PER_S // 4
MCAP_MAGIC = b"\x89MCAP0\r\n"
TOPICS = ("/bumper", "/door")
ANY_TOPIC = ("/*", "/*/*", "/*/*/*")


@dataclass
class PlayedRecorder(Child):
    """A `ros2 bag record` as far as its supervision sees it."""

    pid: int
    world: "World"
    directory: Path
    ready_s: float = 0.5
    subscribe_s: float = 1.0
    obeys_after: int = 1
    topics: tuple[str, ...] = TOPICS
    heard: tuple[str, ...] = TOPICS
    status: int | None = None
    ends_with: int = 0
    lines: list[str] = field(default_factory=list)
    asked_to_end: int = 0
    splits: int = 0
    patience_s: float = 15.0
    deaf: bool = False
    buffers: bool = False
    """Whether an open file does not grow."""
    _age_s: float = 0.0
    _subscribed: bool = False
    _held: list[Msg] = field(default_factory=list)

    def take_lines(self) -> list[str]:
        taken, self.lines = self.lines, []
        return taken

    def exit_status(self) -> int | None:
        return self.status

    def end(self) -> int | None:
        self.asked_to_end += 1
        if self.status is None and self.asked_to_end > self.obeys_after:
            if self.directory.is_dir():
                self._write(finish=True)
                (self.directory / "metadata.yaml").write_text("{}")
            self.status = self.ends_with
        return self.status

    def die(self, status: int = -9) -> None:
        """Ends at once, and leaves its last split open."""
        self._write(finish=False)
        self.status = status

    def live(self, seconds: float) -> None:
        if self.status is not None:
            return
        before, self._age_s = self._age_s, self._age_s + seconds
        if before == 0.0:
            self.directory.mkdir(parents=True)
            (self.directory / self._file).touch()
        if before < self.ready_s <= self._age_s:
            self.lines.append("[INFO] [1.0] [rosbag2_recorder]: Recording...")
        if before < self.subscribe_s <= self._age_s:
            self._subscribed = True
            self.lines += [
                f"[INFO] [1.0] [rosbag2_recorder]: Subscribed to topic '{topic}'"
                for topic in self.topics
            ]

    def receive(self, published: int) -> None:
        if self.status is not None or not self._subscribed or self.deaf:
            return
        logged = published + 20_000 + self.pid * 1_000
        if (
            self._held
            and logged - self._held[0].log_time > self.world.orders.split_duration_s * 1e9
        ):
            self._write(finish=True)
            self.splits += 1
            self._held = []
        for topic in self.heard:
            message = boolean(published, True, topic)
            self._held.append(replace(message, log_time=logged, publish_time=published))
        if self.directory.is_dir():
            self._grow(0 if self.world.disk_full or self.buffers else 50 * len(self._held))

    def _grow(self, size: int) -> None:
        """Has an open file of a size; what is in it matters when its recorder dies.

        It is not written anew, which file systems flush.
        """
        opened = os.open(self.directory / self._file, os.O_RDWR | os.O_CREAT, 0o644)
        if size and not os.fstat(opened).st_size:
            os.write(opened, MCAP_MAGIC)
        os.ftruncate(opened, size and len(MCAP_MAGIC) + size)
        os.close(opened)

    @property
    def _file(self) -> str:
        return f"{self.directory.name}_{self.splits}.mcap"

    def _write(self, *, finish: bool) -> None:
        if not self.directory.is_dir():
            return
        if self.world.disk_full:
            (self.directory / self._file).write_bytes(b"")
            return
        layout = McapLayout(chunk_size=None, finish=finish)
        write_mcap(self.directory / self._file, self._held, layout)


class Inline(Background):
    """Runs each job at once."""

    def add(self, task: str, job: Callable[[], object]) -> None:
        self.run(task, job)


class WorldClock(Clock):
    def __init__(self, world: "World") -> None:
        self._world = world

    def now(self) -> int:
        return self._world.wall


class World:
    """Time, a bag directory, its house unless another is given, and the recorders started there."""

    def __init__(
        self,
        bag_dir: Path,
        *,
        housekeeper: Housekeeping | None = None,
        expected: Sequence[str] = (),
        required: Sequence[Required] = (),
        keep_alive: Callable[[], None] | None = None,
        background: Background | None = None,
        silent: bool = False,
        defaults: dict[str, object] | None = None,
        **orders: object,
    ) -> None:
        self.bag_dir = bag_dir
        self.mono = 1_000.0
        self.wall = T0
        self.silent = silent
        self.disk_full = False
        self.free = 10**12
        self.unmeasurable_after = 10**9
        """How often what is free can still be measured."""
        self.device = 1
        self.refuse = ""
        self.before_start: Callable[[Path], object] = bool
        self.recorders: list[PlayedRecorder] = []
        self.house = PlayedHousekeeper(self)
        self.defaults = defaults or {}
        plan: dict[str, object] = {
            "bag_dir": bag_dir,
            "split_duration_s": 5,
            "session_duration_s": 1000,
            "min_free_bytes": 1000,
        }
        self.reader = McapReader()
        self.background = background or Inline()
        self.topics_path = bag_dir.with_name(f"{bag_dir.name}.topics.yaml")
        self.list_topics(*expected)
        topics = TopicsFile(self.topics_path)
        topics.load()
        self.orders = Orders(
            start_child=self._start,
            reader=self.reader,
            clock=WorldClock(self),
            topics=topics,
            own=OwnRecordings(bag_dir),
            reception=Reception(self.reader, 2**26, bag_dir=bag_dir, background=self.background),
            background=self.background,
            required=required,
            **(plan | orders),  # type: ignore[arg-type]
        )
        self.supervisor = Supervisor(
            self.orders,
            housekeeper or self.house,
            monotonic=lambda: self.mono,
            free_bytes_of=self._free_bytes,
            device=lambda _directory: self.device,
            keep_alive=keep_alive,
        )

    def _free_bytes(self, directory: Path) -> int:
        if not self.unmeasurable_after:
            raise OSError(5, "the disk does not tell", str(directory))
        self.unmeasurable_after -= 1
        return self.free

    def list_topics(self, *names: str) -> None:
        """Writes the list of topics: these, and whatever else the recorders know."""
        self.topics_path.write_text(yaml.safe_dump({"topics": [*names, *ANY_TOPIC]}))

    def _start(self, name: str, directory: Path) -> PlayedRecorder:
        self.before_start(directory)
        if self.refuse:
            raise RecorderError(self.refuse)
        recorder = PlayedRecorder(100 + len(self.recorders), self, directory)
        for key, value in self.defaults.items():
            setattr(recorder, key, value)
        self.recorders.append(recorder)
        return recorder

    def started(self, run_s: float = 0.0) -> "World":
        """Starts the supervisor and lets time pass; returns this world."""
        self.supervisor.start()
        self.run(run_s)
        return self

    def run(self, seconds: float) -> None:
        """Lets time pass in steps of a quarter of a second."""
        for _ in range(round(seconds * 4)):
            self.mono += 0.25
            self.wall += PERIOD
            for recorder in self.recorders:
                recorder.live(0.25)
            published = self.wall - self.wall % PERIOD
            if not self.silent:
                for recorder in self.recorders:
                    recorder.receive(published)
            self.supervisor.tick()

    def logged(self, seconds: float, event: str) -> list[MutableMapping[str, Any]]:
        """Lets time pass; returns what is logged under this name meanwhile."""
        with capture_logs() as logs:
            self.run(seconds)
        return events(logs, event)

    def set_clock(self, seconds: float) -> None:
        """Steps the wall clock."""
        self.wall += round(seconds * NS_PER_S)

    @property
    def running(self) -> list[PlayedRecorder]:
        return [recorder for recorder in self.recorders if recorder.status is None]

    def heartbeat(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.bag_dir / HEARTBEAT_FILE).read_text())
        return content

    def published(self, *, counting: bool) -> Counter[int]:
        """How often each publish time of `/bumper` stands in the bags, or counts in them."""
        return published(self.bag_dir, "/bumper", counting=counting)


def published(bag_dir: Path, topic: str, *, counting: bool) -> Counter[int]:
    """How often each publish time of a topic stands in the bags, or counts in them."""
    reader = BagDirReader(McapReader()) if counting else McapReader()
    found: Counter[int] = Counter()
    for path in sorted(bag_dir.glob("*/*.mcap")):
        if path.stat().st_size:
            records = reader.records(path, [topic], TimeWindow.everything())
            found.update(record.publish_time for record in records)
    return found


def rotating(bag_dir: Path, run_s: float = 0.0, **given: Any) -> World:
    """A world that has run for some time, whose recordings are over after 20 s."""
    return World(bag_dir, session_duration_s=20, **given).started(run_s)


def events(logs: list[MutableMapping[str, Any]], name: str) -> list[MutableMapping[str, Any]]:
    return [each for each in logs if each["event"] == name]


def assert_what_stands_counts_once(world: World) -> None:
    """Once it was stopped, whatever stands in any bag counts exactly once."""
    world.supervisor.stop()
    stands, counts = world.published(counting=False), world.published(counting=True)
    assert counts == dict.fromkeys(stands, 1)


def assert_each_counts_once(world: World) -> None:
    """Whatever stands in any bag counts exactly once, and nothing is missing in between."""
    assert_what_stands_counts_once(world)
    stands = world.published(counting=False)
    assert len(stands) == (max(stands) - min(stands)) // PERIOD + 1


class PlayedHousekeeper(Housekeeping):
    """Records what it is asked for, and frees what the test sets."""

    def __init__(self, world: World | None = None) -> None:
        self.asked: list[str] = []
        self.world = world
        self.frees_to = 0
        self.making = False
        self.recorded: list[tuple[tuple[str, ...], int, float]] = []
        self.held: str | None = None
        self.restarts: list[tuple[int, str]] = []

    def make_room(self, free_bytes_wanted: int) -> None:
        self.asked.append(f"room {free_bytes_wanted}")
        if self.world is not None:
            self.world.free = max(self.world.free, self.frees_to)

    def is_making_room(self) -> bool:
        return self.making

    def apply(self) -> None:
        self.asked.append("apply")

    def keep_moments(self) -> None:
        """None are asked for."""

    def note_restart(self, first: int, how: str) -> None:
        self.restarts.append((first, how))

    def note_recorded(
        self, recordings: Collection[str], bytes_written: int, monotonic_s: float
    ) -> None:
        self.recorded.append((tuple(recordings), bytes_written, monotonic_s))

    def status(self) -> HouseStatus:
        return HouseStatus(age_held=self.held)

    def announce(self, recording: str) -> None:
        """Nothing is excluded."""

    def screen(self, live: Collection[str]) -> None:
        """Nothing is excluded."""

    def finish(self) -> None:
        """Nothing is under way."""

    def excluded_latched(self) -> frozenset[str]:
        return frozenset()
