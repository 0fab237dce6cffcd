"""Retention while a recorder records and questions are asked.

20 splits; EPISODIC_LONG=1 makes it 200.
"""

import json
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import pytest
from mcap.writer import CompressionType
from mcp import Client

from ros2_memory import queries
from ros2_memory.bag_dir.heartbeat import read_heartbeat
from ros2_memory.bag_dir.layout import is_carried
from ros2_memory.bag_dir.state_files import LEAVING, Leaving
from ros2_memory.core.errors import NoDataError
from ros2_memory.core.timebase import NS_PER_S, WallClock
from ros2_memory.history.context import Call, QuerySettings
from ros2_memory.history.view import AtTime, TimeRange
from ros2_memory.storage.mcap_reader import McapReader
from tests.integration.test_recorder_daemon import Site, sited
from tests.support.bags import McapLayout, Msg, mcap_content, odom, text, tf, transform, write_mcap
from tests.support.examples import LONG
from tests.support.heartbeats import beat
from tests.support.housekeepers import keeper_of, own_all, size_of, state
from tests.support.live_recorder import answer, answering
from tests.support.memories import memory_of
from tests.support.processes import PATIENCE_S, until
from tests.support.robot_run import ask_everything, write_run
from tests.support.served import serving

SPLIT = 10 * NS_PER_S
SPLITS_IN_RECORDING = 5
DOCK = "/docked"
LAYOUT = McapLayout(
    chunk_size=4096,
    compression=CompressionType.ZSTD,
    latched=frozenset({"/tf_static", DOCK}),
)


@dataclass
class SplitWriter:
    """Writes splits that are dated from `begin` on; the newest is open."""

    bag_dir: Path
    begin: int
    opened: list[Path] = field(default_factory=list)
    rest: bytes = b""

    def step(self) -> int:
        """Opens the next split, then closes the one before it; returns its size, once closed."""
        number, nth = divmod(len(self.opened), SPLITS_IN_RECORDING)
        start = self.begin + len(self.opened) * SPLIT
        name = f"rec_{number:04d}"
        messages = [*(self.latched(start) if nth == 0 else []), *driven(self.begin, start)]
        content = mcap_content(messages, LAYOUT)
        self.tell(name)
        path = self.bag_dir / name / f"{name}_{nth}.mcap"
        path.parent.mkdir(exist_ok=True)
        # It reaches the disk in two parts, as a recorder's does.
        cut = len(content) * 6 // 10
        path.write_bytes(content[:cut])
        self.close()
        self.opened.append(path)
        self.rest = content[cut:]
        return len(content)

    def latched(self, start: int) -> list[Msg]:
        """Published once, and received again by each recording."""
        at = self.begin
        where = text(at, "home", DOCK)
        fixed = transform(at, "base_link", "laser", (0.1, 0.0, 0.2))
        return [
            Msg(DOCK, where.type, start + 1, where.body, at),
            tf(at, fixed, topic="/tf_static", log_time=start + 2),
        ]

    def close(self) -> None:
        if self.opened:
            with self.opened[-1].open("ab") as stream:
                stream.write(self.rest)
            if len(self.opened) % SPLITS_IN_RECORDING == 0:
                metadata = self.opened[-1].with_name("metadata.yaml")
                metadata.write_text("rosbag2_bagfile_information: {}\n")

    def tell(self, *recordings: str) -> None:
        beat(self.bag_dir, WallClock().now(), recordings=recordings, interval_s=3600.0)


def driven(begin: int, start: int) -> list[Msg]:
    """Ten seconds of odometry, one metre a second, and a word a second."""
    times = [start + 10 + n * NS_PER_S // 5 for n in range(50)]
    moved = [odom(at, (at - begin) / NS_PER_S, 0.0, vx=1.0) for at in times]
    return [*moved, *(text(start + 20 + n * NS_PER_S, f"word {n}") for n in range(10))]


ROOT: Final = Path(__file__).resolve().parents[2]
SPLITS: Final = 200 if LONG else 20
KEPT_SPLITS: Final = 6
SLACK: Final = 8192
"""Bytes of the heartbeat, of metadata and of carried messages that are about to be counted."""


@dataclass
class Asker:
    """Asks one question after the other in a thread of its own, and keeps what went wrong."""

    bag_dir: Path
    begin: int
    rounds: int = 0
    wrong: list[str] = field(default_factory=list)
    _stop: threading.Event = field(default_factory=threading.Event)
    _round: threading.Condition = field(default_factory=threading.Condition)

    def __post_init__(self) -> None:
        limits = QuerySettings(now="latest", split_duration_s=10.0)
        self.memory = memory_of(self.bag_dir, clock=WallClock(), limits=limits)

    @contextmanager
    def asking(self) -> Iterator[None]:
        thread = threading.Thread(target=self._ask, daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._stop.set()
            thread.join()

    def _ask(self) -> None:
        now = AtTime(ago_s=0.0)
        questions: list[Callable[[], object]] = [
            lambda: queries.list_recorded_topics(self.memory, Call()),
            lambda: queries.data_time_range(self.memory, Call()),
            lambda: queries.position(self.memory, Call(), AtTime(ago_s=40.0)),
            lambda: queries.topic_range(self.memory, Call(), "/odom", TimeRange(last_s=60.0)),
            lambda: queries.trajectory_summary(self.memory, Call(), TimeRange(last_s=100.0)),
            lambda: queries.find_last_match(self.memory, Call(), "/chatter", "contains", "no such"),
            lambda: queries.frames(self.memory, Call()),
        ]
        try:
            while not self._stop.is_set():
                for question in questions:
                    with suppress(NoDataError):  # what it asks for may have been deleted
                        question()
                self._is_docked(now)
                self._is_placed(now)
                with self._round:
                    self.rounds += 1
                    self._round.notify_all()
        except Exception as error:
            self.wrong.append(repr(error))
            raise

    def wait_for_a_round(self) -> None:
        """Waits until every question was asked once more, by what is there at this moment."""
        with self._round:
            before = self.rounds
            asked = self._round.wait_for(lambda: self.rounds >= before + 2, PATIENCE_S)
            assert asked, self.wrong

    def _is_docked(self, moment: AtTime) -> None:
        reply = queries.topic_value(self.memory, Call(), DOCK, moment)
        if (reply.sample.time, reply.sample.value) != (self.begin + 1, {"value": "home"}):
            self.wrong.append(f"{reply.sample}")

    def _is_placed(self, moment: AtTime) -> None:
        reply = queries.transform(self.memory, Call(), "base_link", "laser", moment)
        if reply.transform.translation != (0.1, 0.0, 0.2):
            self.wrong.append(f"{reply.transform}")


def test_the_budget_is_held_while_it_is_recorded_and_asked(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    bag_dir.mkdir()
    begin = WallClock().now() - (SPLITS + 10) * 10 * NS_PER_S
    asker, writer = Asker(bag_dir, begin), SplitWriter(bag_dir, begin)
    split = max(writer.step(), writer.step())
    budget = KEPT_SPLITS * split
    keeper = keeper_of(
        bag_dir,
        max_bytes=budget,
        clock=WallClock(),
        grace_s=2.0,
        monotonic=lambda: float(asker.rounds),
    )
    with asker.asking():
        for _ in range(SPLITS - 2):
            writer.step()
            assert size_of(bag_dir) <= budget + split + SLACK
            keeper.apply()
            assert size_of(bag_dir) <= budget + SLACK
            asker.wait_for_a_round()
        deleted = [path for path in writer.opened if not path.exists()]
    assert asker.wrong == []
    writer.close()
    writer.tell()
    keeper.apply()
    left = sorted(path for path in bag_dir.rglob("*.mcap") if not is_carried(path))
    assert len(deleted) > SPLITS // 2
    assert len(left) >= KEPT_SPLITS - 2
    assert left[-1] == writer.opened[-1]
    assert {path.parent for path in left} == {
        path for path in bag_dir.iterdir() if path.is_dir() and path.name.startswith("rec_")
    }
    asker._is_docked(AtTime(ago_s=0.0))
    asker._is_placed(AtTime(ago_s=0.0))
    assert asker.wrong == []


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with sited(tmp_path) as site:
        yield site


def test_the_daemon_repairs_what_a_crash_left_and_keeps_its_budget(site: Site) -> None:
    hour_ago = WallClock().now() - 3600 * NS_PER_S
    for number in range(10):
        times = [hour_ago + number * 10 * NS_PER_S + n for n in range(20)]
        write_mcap(
            site.bag_dir / "rec_20260101T000000Z" / f"{number}.mcap",
            [odom(time, 1.0, 2.0) for time in times],
        )
    times = [hour_ago + 200 * NS_PER_S + n for n in range(20)]
    crashed = write_mcap(
        site.bag_dir / "rec_20260101T010000Z" / "0.mcap",
        [odom(time, 1.0, 2.0) for time in times],
        McapLayout(chunk_size=999, finish=False),
    )
    own_all(site.bag_dir)
    daemon = site.run("retention.max_total_gb=0.0001")
    (repaired,) = daemon.wait_for("bag_repaired")
    applied = daemon.wait_for("retention_applied")[0]
    daemon.stop()
    assert repaired["path"] == str(crashed)
    assert repaired["messages"] > 0
    assert applied["bags"] > 0
    assert applied["total_bytes"] <= 100_000
    assert McapReader().summarize(crashed).complete
    left = {path.name for path in (site.bag_dir / "rec_20260101T000000Z").glob("*.mcap")}
    assert left == {f"{number}.mcap" for number in range(10 - len(left), 10)}
    assert 0 < len(left) < 10


def age_held(bag_dir: Path) -> str | None:
    heartbeat = read_heartbeat(bag_dir).heartbeat
    assert heartbeat is not None
    return heartbeat.age_held


def test_a_clock_that_stepped_forward_deletes_nothing_before_it_is_synchronised(site: Site) -> None:
    """As the recorder finds it after a step of 150 h: its bags of a week look older than that."""
    site.synchronised.write_text("no\n")
    now = WallClock().now()
    kept = [
        write_mcap(
            site.bag_dir / f"rec_20260101T{n:06}Z" / "0.mcap",
            [odom(now - (149 + 2 * n) * 3600 * NS_PER_S + each, 1.0, 2.0) for each in range(20)],
        )
        for n in range(1, 20)
    ]
    daemon = site.run("retention.max_age_h=168", "retention.foreign=delete")
    (held,) = daemon.wait_for("age_held")
    assert held["bags"] == 10
    until(lambda: age_held(site.bag_dir) == held["reason"])
    with serving(site.bag_dir, site.folder / "server") as served:
        assert answer(served, "memory_status")["notes"] == [held["reason"]]
        assert json.loads(served.get("/health")[1])["recorder"]["age_held"] == held["reason"]
    assert all(path.exists() for path in kept)
    recorded = {path.name for path in daemon.recordings()} - {path.parent.name for path in kept}
    assert max(recorded) in (site.bag_dir / ".episodic/recorded.jsonl").read_text()

    site.synchronised.write_text("yes\n")
    daemon.wait_for("age_no_longer_held")
    assert [path.exists() for path in kept] == [True] * 9 + [False] * 10
    until(lambda: age_held(site.bag_dir) is None)
    daemon.stop()


@contextmanager
def read_only(folder: Path, at: Path) -> Iterator[Path]:
    """The folder mounted so that nobody can write, which rights alone do not do for root."""
    at.mkdir()
    made = [
        subprocess.run(command, capture_output=True, text=True, check=False)
        for command in (
            ["mount", "--bind", str(folder), str(at)],
            ["mount", "-o", "remount,ro,bind", str(at)],
        )
    ]
    try:
        if any(each.returncode for each in made):
            pytest.skip(f"no read-only mount can be made here: {made[0].stderr or made[1].stderr}")
        yield at
    finally:
        subprocess.run(["umount", str(at)], capture_output=True, check=False)


async def test_bags_on_a_read_only_mount_are_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_run(tmp_path / "bags")
    before = state(tmp_path / "bags")
    with read_only(tmp_path / "bags", tmp_path / "mount") as mount:
        with pytest.raises(OSError, match="Read-only"):
            (mount / "probe").write_text("x")
        with serving(mount, tmp_path / "log", "recorder=none") as served:
            async with Client(served.url("/mcp")) as client:
                await ask_everything(client)
    assert state(tmp_path / "bags") == before


def test_days_are_kept_by_the_recorder_and_go_with_the_setting(tmp_path: Path) -> None:
    two_days_ago = WallClock().now() - 48 * 3600 * NS_PER_S
    with sited(tmp_path) as site:
        for number in range(3):
            start = two_days_ago + number * 10 * NS_PER_S
            poses = [odom(start + n * NS_PER_S // 100, n / 400, 0.0) for n in range(1000)]
            write_mcap(site.bag_dir / "rec_old" / f"rec_old_{number}.mcap", poses)
        own_all(site.bag_dir)
        keeping = site.run("memory.keep=true", "retention.max_total_gb=0.0005")
        keeping.wait_for("memory_kept")
        until(lambda: not [*site.bag_dir.glob("rec_old/*.mcap")])
        keeping.stop()
        days = [*site.bag_dir.glob("memory/*.thinned.mcap")]
        assert days
        with answering(site.bag_dir, tmp_path / "served") as served:
            asked = two_days_ago / NS_PER_S + 5
            reply = answer(served, "get_position_at", timestamp=asked)
        assert reply["from"] == "memory"
        # One pose a second stayed: the newest until then, in whole microseconds.
        assert asked - 1.01 <= reply["timestamp"] <= asked + 1e-6
        moved_s = reply["timestamp"] - two_days_ago / NS_PER_S
        assert reply["x"] == pytest.approx(moved_s / 4, abs=0.005)
        leaving = site.run()
        [said] = leaving.wait_for("memory_leaves")
        leaving.stop()
        assert (said["days"], said["left_s"]) == (len(days), 86_400)
        assert [*site.bag_dir.glob("memory/*.thinned.mcap")] == days
        LEAVING.write(site.bag_dir, Leaving(0.0))  # the recorder has run for a day
        again = site.run()
        [deleted] = again.wait_for("memory_deleted")
        assert deleted["days"] == len(days)
        assert not [*site.bag_dir.glob("memory/*")]
