"""The recorder daemon and the query server over real DDS: real processes, and what they say.

The robot is `tests/support/robot_publishers.py`. A message of `/odom` carries its tick
(T0 + tick / hz) in its header, so each one is known by name, however often and wherever it stands.
"""

import json
import os
import random
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import anyio
from mcp import Client
from mcp.client.sse import sse_client

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.bag_dir.heartbeat import Heartbeat, RecorderState, read_heartbeat
from ros2_memory.core.errors import BagError
from ros2_memory.core.model import TimeWindow
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.forked_commands import Forked
from tests.support.processes import PATIENCE_S, until
from tests.support.real_recorder import RealRecorder, env_without_ros
from tests.support.robot_run import ask
from tests.support.ros_processes import ros_environment, running
from tests.support.served import Served, serving

RECORDED_TOPICS = (
    "/odom",
    "/tf",
    "/tf_static",
    "/cmd_vel",
    "/bumper",
    "/battery_state",
    "/vision/scene/scene_objects",
)
NS_PER_S = 10**9
_OURS = ("MEMORY_", "MCP_", "ROS_VISION")
_OF_THE_MACHINE = ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOG_DIR")


class Child(NamedTuple):
    """A recorder process, and the recording that it writes."""

    pid: int
    recording: str


class Killed(NamedTuple):
    """When processes were killed, when none of them was left (ns), and what they recorded."""

    at: int
    gone: int
    recordings: tuple[str, ...]


@dataclass
class LiveRecorder:
    """A recorder daemon that runs, or ran, and its bag directory."""

    bag_dir: Path
    log: Path
    process: subprocess.Popen[bytes]

    def all_events(self) -> list[dict[str, Any]]:
        """What it logged so far."""
        lines = self.log.read_text(errors="replace").splitlines()
        # The last one may be on its way; what is no event was said by Python.
        return [json.loads(line) for line in lines if line[:1] == "{" and line[-1:] == "}"]

    def events(self, name: str) -> list[dict[str, Any]]:
        """What it logged under this name so far."""
        return [event for event in self.all_events() if event["event"] == name]

    def wait_for(self, name: str, count: int = 1, **values: object) -> list[dict[str, Any]]:
        """Events of this name with these values, as soon as there are `count`."""

        def come() -> list[dict[str, Any]] | None:
            found = [e for e in self.events(name) if values.items() <= e.items()]
            if len(found) >= count:
                return found
            assert self.process.poll() is None, f"it ended before {name}:\n{self.log.read_text()}"
            return None

        return until(come)

    def wait_for_state(self, state: RecorderState) -> None:
        self.wait_for_beat(
            lambda beat: beat.state is state and beat.pid == self.process.pid, f"state {state}"
        )

    def wait_for_beat(self, says: Callable[[Heartbeat], bool], what: str) -> Heartbeat:
        """The first heartbeat that says so."""

        def said() -> Heartbeat | None:
            assert self.process.poll() is None, f"it ended before {what}"
            beat = read_heartbeat(self.bag_dir).heartbeat
            return beat if beat is not None and says(beat) else None

        return until(said, what)

    def wait_for_subscriptions(self) -> None:
        """Returns once its newest recorder runs and has subscribed to everything."""

        def all_there() -> bool:
            running = self.children()
            return bool(running) and running[-1].recording in self.subscribed_all()

        until(all_there, "all subscriptions", alive=self.process)

    def subscribed_all(self) -> dict[str, int]:
        """The recordings that subscribed to all of `RECORDED_TOPICS`, and when they had (ns)."""
        times: dict[str, dict[str, int]] = {}
        for event in self.events("subscribed"):
            times.setdefault(event["recording"], {})[event["topic"]] = moment_of(event)
        return {
            name: max(topics.values())
            for name, topics in times.items()
            if topics.keys() >= set(RECORDED_TOPICS)
        }

    @property
    def heartbeat(self) -> Heartbeat:
        beat = read_heartbeat(self.bag_dir).heartbeat
        assert beat is not None
        return beat

    def children(self) -> list[Child]:
        """Its recorders that run, the newest last."""
        started = [Child(int(e["pid"]), e["recording"]) for e in self.events("recorder_started")]
        return [child for child in started if _parent_of(child.pid) == self.process.pid]

    def kill_child(self, chance: random.Random | None = None) -> Killed:
        """SIGKILL to one of its recorders, by chance or the newest. Returns when it noticed."""
        children = until(lambda: self.children() or None)
        child = children[-1] if chance is None else chance.choice(children)
        at = time.time_ns()
        os.kill(child.pid, signal.SIGKILL)
        self.wait_for("recorder_died", recording=child.recording)
        return Killed(at, time.time_ns(), (child.recording,))

    def kill(self, *, with_children: bool) -> Killed:
        """SIGKILL to the daemon, and to its recorders in the same moment.

        Returns when none of them is there any more: recorders that were not killed end by
        themselves.
        """
        children = self.children()
        at = time.time_ns()
        self.process.send_signal(signal.SIGKILL)
        for child in children if with_children else ():
            with suppress(ProcessLookupError):
                os.kill(child.pid, signal.SIGKILL)
        self.process.wait(timeout=PATIENCE_S)
        until(lambda: not any(_is_running(child.pid) for child in children), "their end")
        return Killed(at, time.time_ns(), tuple(child.recording for child in children))

    @property
    def child(self) -> int:
        """The process number of its newest recorder."""
        return int(self.wait_for("recorder_started")[-1]["pid"])

    def recordings(self) -> list[Path]:
        return sorted(path for path in self.bag_dir.glob("rec_*") if path.is_dir())

    def stop(self, number: int = signal.SIGTERM) -> None:
        """Has it end, as a service manager does."""
        self.process.send_signal(number)
        code = self.process.wait(timeout=PATIENCE_S)
        assert code == 0, f"the recorder ended with {code}:\n{self.log.read_text()}"

    def discard(self) -> None:
        """Leaves nothing of it running."""
        children = self.children()
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait(timeout=PATIENCE_S)
        for child in children:
            with suppress(ProcessLookupError):
                os.kill(child.pid, signal.SIGKILL)


@dataclass
class Machine:
    """Where recorders and servers are started: the environment of a test's ROS, and a folder."""

    folder: Path
    env: Mapping[str, str]
    recorders: list[LiveRecorder] = field(default_factory=list)

    def record(
        self,
        name: str,
        *overrides: str,
        topics: Sequence[str] = RECORDED_TOPICS,
        bag_dir: Path | None = None,
        through: Sequence[str] = (),
    ) -> LiveRecorder:
        """Starts the recorder that keeps `name`'s bags; it may be the next one to do so.

        It has ROS from a setup file. `through` is a program that becomes the recorder.
        """
        shelf = self.folder / name
        shelf.mkdir(exist_ok=True)
        listed = shelf / "topics.yaml"
        listed.write_text("topics:\n" + "".join(f"  - {topic}\n" for topic in topics))
        bags = bag_dir or self.bag_dir(name)
        log = shelf / f"recorder{len(self.recorders)}.log"
        given = [
            f"recording.bag_dir={bags}",
            f"recording.topics_file={listed}",
            f"recorder.setup_files=[{self.env['ROS2_LIVE_SETUP']}]",
            "retention.min_free_gb=0",
            *overrides,
        ]
        known = self.plain_env
        with log.open("wb") as stream:
            if through:
                program = shutil.which("ros2-memory-recorder", path=Path(sys.executable).parent)
                assert program is not None, "the package is not installed in this environment"
                process = subprocess.Popen(
                    [*through, program, *given],
                    env=known,
                    stdin=subprocess.DEVNULL,
                    stderr=stream,
                )
            else:
                process = Forked("ros2-memory-recorder", *given, env=known, stderr=stream)
        recorder = LiveRecorder(bags, log, process)
        self.recorders.append(recorder)
        return recorder

    def bag_dir(self, name: str) -> Path:
        """Where `name`'s bags lie unless another place is chosen."""
        return self.folder / name / "bags"

    @property
    def plain_env(self) -> dict[str, str]:
        """An environment without ROS, but with its domain."""
        kept = {
            name: text for name, text in env_without_ros().items() if not name.startswith(_OURS)
        }
        return {**kept, **{name: self.env[name] for name in _OF_THE_MACHINE}}


@contextmanager
def machine(folder: Path, real: RealRecorder) -> Iterator[Machine]:
    """A machine with the real recorder, on which none is left running."""
    with ros_environment(folder, real=real) as env:
        site = Machine(folder, env)
        try:
            yield site
        finally:
            for recorder in site.recorders:
                recorder.discard()
                # Shown where a test failed: the files of a machine that runs tests are soon gone.
                sys.stdout.write(recorder.log.read_text(errors="replace")[-20_000:])


@contextmanager
def publishing(env: Mapping[str, str], *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Publishers of numbered messages, with arguments of `integration/counting_publishers.py`."""
    with running(env, "tests.integration.counting_publishers", *arguments) as process:
        yield process
        sys.stdout.write(f"publishers: {process.poll()} (None: they ran)\n")


def number_of(payload: bytes) -> int:
    """The number of a message of the counting publishers: `x`, behind the text in the header."""
    frame = struct.unpack_from("<I", payload, 12)[0]
    return int(struct.unpack_from("<d", payload, 4 + (12 + frame + 7) // 8 * 8)[0])


def stall(recorder: LiveRecorder, seconds: float, *, every: bool = False) -> tuple[float, float]:
    """Stops its newest recorder's process for so long, or all that run; returns from when to when.

    In Unix seconds.
    """
    children = recorder.children() if every else recorder.children()[-1:]
    for child in children:
        os.kill(child.pid, signal.SIGSTOP)
    stopped_at = time.time()
    time.sleep(seconds)  # what is injected, not waited for
    continued_at = time.time()
    for child in children:
        os.kill(child.pid, signal.SIGCONT)
    return stopped_at, continued_at


@contextmanager
def answering(bag_dir: Path, log: Path, *overrides: str) -> Iterator[Served]:
    """The query server over this directory, over SSE; it looks for new bags five times a second."""
    with serving(bag_dir, log, "data.now=wall", "reader.index_refresh_s=0.2", *overrides) as served:
        yield served


class Answer(NamedTuple):
    """A reply, and between which moments (Unix s) it was asked for and came."""

    reply: Any
    asked: float
    answered: float


def answers(served: Served, *questions: tuple[str, dict[str, Any]]) -> list[Answer]:
    """What a client is answered over SSE."""

    async def go() -> list[Answer]:
        found: list[Answer] = []
        async with Client(sse_client(served.url("/sse"), timeout=PATIENCE_S)) as client:
            for tool, given in questions:
                asked = time.time_ns()
                reply, _ = await ask(client, tool, given)
                found.append(Answer(reply, asked / NS_PER_S, time.time_ns() / NS_PER_S))
        return found

    return anyio.run(go)


def answer(served: Served, tool: str, **given: object) -> Any:
    """The reply to one question."""
    return answers(served, (tool, given))[0].reply


def await_answerable(served: Served, moment: int) -> None:
    """Returns once the server has closed bags up to this moment (ns)."""
    await_moment(moment)

    def reaches() -> bool:
        latest = json.loads(served.get("/health")[1]).get("latest")
        return latest is not None and latest * NS_PER_S >= moment

    until(reaches, "bags that reach so far")


def await_moment(moment: int) -> None:
    """Returns at this moment (ns), or at once where it is past."""
    while (left_ns := moment - time.time_ns()) > 0:
        time.sleep(left_ns / NS_PER_S)


class Tick(NamedTuple):
    """One message of `/odom`, by the tick in its header."""

    number: int
    publish_time: int
    log_time: int


def ticks(files: Sequence[Path], t0: int, hz: float, *, counting: bool = True) -> list[Tick]:
    """The messages of `/odom` of one robot in these bag files, in the order of publication.

    Files without a readable message hold none. `counting`: only those that count where they stand.
    """
    plain = McapReader()
    reader = BagDirReader(plain) if counting else plain
    found: list[Tick] = []
    for path in files:
        with suppress(BagError):
            for record in reader.records(path, ["/odom"], TimeWindow.everything()):
                at = stamp_of(reader.decode(record))
                number = round((at - t0) * hz / NS_PER_S)
                found.append(Tick(number, record.publish_time, record.log_time))
    return sorted(found, key=lambda tick: tick.publish_time)


def stamp_of(message: object) -> int:
    """The time in a message's header, in ns."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return int(getattr(stamp, "sec", 0) * NS_PER_S + getattr(stamp, "nanosec", 0))


def bag_files(bag_dir: Path) -> list[Path]:
    """All of them, the empty ones too."""
    return sorted(bag_dir.glob("*/*.mcap"))


def closed_files(bag_dir: Path) -> list[Path]:
    """Those that are closed at this moment."""
    reader = McapReader()
    return [path for path in bag_files(bag_dir) if _is_closed(reader, path)]


def moment_of(event: Mapping[str, Any]) -> int:
    """When an event was logged, in ns."""
    return round(datetime.fromisoformat(event["timestamp"]).timestamp() * NS_PER_S)


def _is_closed(reader: McapReader, path: Path) -> bool:
    with suppress(BagError, FileNotFoundError):
        return path.stat().st_size > 0 and reader.is_finished(path)
    return False


def _parent_of(pid: int) -> int | None:
    fields = _stat_of(pid)
    return int(fields[1]) if fields and fields[0] != "Z" else None


def _is_running(pid: int) -> bool:
    fields = _stat_of(pid)
    return bool(fields) and fields[0] != "Z"


def _stat_of(pid: int) -> list[str]:
    """The fields of a process after its name: state, parent, ...; none where it is gone."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return []
    return text.rpartition(")")[2].split()
