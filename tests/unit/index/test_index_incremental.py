"""An index that followed every change, or begins with known bags, knows what a fresh one finds."""

import os
import shutil
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from ros2_memory.bag_dir.heartbeat import HEARTBEAT_FILE
from ros2_memory.core.model import TimeWindow
from ros2_memory.index.bag_rows import BagRows
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.recorder.index_manager import IndexManager
from tests.support.clocks import SettableClock
from tests.support.examples import examples
from tests.support.heartbeats import beat
from tests.support.plain_text_bags import PlainReader, close, grow, plain

S = 10**9
NOW = 1_800_000_000 * S

FOLDERS = (".", "rec_1", "rec_2", "day/rec_3", ".trash")
NAMES = ("a.mcap", "b.mcap", "a.mcap.zstd", "c.db3", "d.db3.zstd", "notes.txt")
WAITS_S = (0.0, 0.0, 0.001, 1.0, 2.0, 5.0, 14.0, 31.0, 700.0)

places = st.tuples(st.sampled_from(FOLDERS), st.sampled_from(NAMES)).map("/".join)
steps = st.one_of(
    st.tuples(st.sampled_from(["add", "open", "replace", "overwrite"]), places, st.integers(0, 99)),
    st.tuples(st.sampled_from(["empty", "zero", "junk", "grow", "close"]), places, st.just(0)),
    st.tuples(st.sampled_from(["delete", "rename", "link", "drop folder"]), places, st.just(0)),
    st.tuples(st.sampled_from(["metadata", "beat", "silence"]), places, st.integers(0, 3)),
    st.tuples(st.just("wait"), st.just(""), st.integers(0, len(WAITS_S) - 1)),
    st.tuples(st.just("scan"), st.just(""), st.integers(0, 1)),
)


class World:
    """A bag directory in which things happen; every mtime is that of the hand-moved clock.

    `held` keeps what was written open: the inode of a file that has gone would be the next one's,
    which then looks like the same file, grown. And who sees a file grow cannot tell that it grew
    long before, as a fresh index does by the mtime: no time passes before that is seen.
    """

    def __init__(self, root: Path, held: ExitStack) -> None:
        self.root = root
        self._held = held
        self._grown = False
        self.clock = SettableClock(NOW)
        self.known: list[BagRows] = []
        self.index = self.fresh_index()
        self.index.refresh()

    def fresh_index(self, known: Sequence[BagRows] = ()) -> IndexManager:
        return IndexManager(
            self.root,
            PlainReader(".mcap", ".mcap.zstd", ".db3"),
            self.clock,
            refresh_s=5.0,
            split_duration_s=10.0,
            known=lambda: known,
        )

    def do(self, deed: str, place: str, number: int) -> None:
        path = self.root / place
        assert path.is_relative_to(self.root)
        if deed == "scan" or (deed == "wait" and self._grown):
            self.known = [part.bags for part in self.index.refresh().timeline.segments]
            self._grown = False
        if deed == "scan" and number:
            self.index = self.fresh_index(self.known)
            self.index.refresh()
        if deed == "wait":
            self.clock.at += round(WAITS_S[number] * S)
        elif deed != "scan":
            self._grown |= deed in {"grow", "close", "overwrite"}
            path.parent.mkdir(parents=True, exist_ok=True)
            if deed in {"add", "open", "empty", "zero", "junk", "link", "delete"}:
                path.unlink(missing_ok=True)
                self._put(deed, path, number)
            elif path.is_file():
                self._change(deed, path, number)
            self._around(deed, path, number)
            self._stamp(path)

    def _put(self, deed: str, path: Path, number: int) -> None:
        """In place of what may have been there."""
        if deed in {"add", "open"}:
            topic = "/odom" if number % 2 else "/tf_static"
            times = [number, number + 5]
            plain(path, times, topic=topic, silent=["/scan"], closed=deed == "add")
        elif deed == "empty":
            plain(path, silent=["/idle"])
        elif deed == "link":
            path.symlink_to("elsewhere")
        elif deed != "delete":
            path.write_text("junk" if deed == "junk" else "")

    def _change(self, deed: str, path: Path, number: int) -> None:
        """Of a file that is there."""
        text = path.read_text()
        is_open = text.startswith("BAG") and not text.endswith("END")
        if deed == "overwrite":
            plain(path, [number])
        elif deed == "rename":
            path.rename(path.with_name(f"z_{path.name}"))
        elif deed == "grow" and is_open:
            grow(path, 100, 101)
        elif deed == "close" and is_open:
            close(path)

    def _around(self, deed: str, path: Path, number: int) -> None:
        """Beside a file, be it there or not."""
        if deed == "replace":
            other = plain(path.with_name("incoming"), [number], closed=number % 3 != 0)
            os.utime(other, ns=(self.clock.at,) * 2)
            other.rename(path)
        elif deed == "drop folder" and path.parent != self.root:
            shutil.rmtree(path.parent)
        elif deed == "metadata":
            text = f"files:\n  - path: {path.name}\n" if number else ""
            path.with_name("metadata.yaml").write_text(text)
        elif deed == "beat":
            beat(self.root, self.clock.at, recordings=FOLDERS[1 : number + 1], since=NOW)
        elif deed == "silence":
            (self.root / HEARTBEAT_FILE).unlink(missing_ok=True)

    def _stamp(self, path: Path) -> None:
        """The file system's clock is the test's: it stamps what was touched."""
        if path.is_file():
            self._held.enter_context(path.open("rb"))
            os.utime(path, ns=(self.clock.at,) * 2)
        for folder in path.parents:
            if folder.is_relative_to(self.root) and folder.is_dir():
                os.utime(folder, ns=(self.clock.at,) * 2)


@settings(max_examples=examples(300))
@given(script=st.lists(steps, max_size=40))
def test_an_index_that_followed_every_change_knows_what_a_fresh_one_finds(
    script: list[tuple[str, str, int]],
) -> None:
    with tempfile.TemporaryDirectory() as folder, ExitStack() as held:
        world = World(Path(folder), held)
        for deed in script:
            world.do(*deed)
        followed, fresh = world.index.refresh(), world.fresh_index().refresh()
        for other in (followed, world.fresh_index(world.known).refresh()):
            assert _without_growth(other) == _without_growth(fresh)
            assert _views(other) == _views(fresh)
        again = _without_growth(world.index.refresh())
        assert replace(again, scanned_at=0) == replace(_without_growth(fresh), scanned_at=0)


def _without_growth(snapshot: Snapshot) -> Snapshot:
    """Without what only somebody knows who looked twice: that a file grew."""
    return replace(snapshot, active=tuple(replace(each, growing=False) for each in snapshot.active))


def _views(snapshot: Snapshot) -> tuple[object, ...]:
    return (
        [*snapshot.bags],
        snapshot.earliest,
        snapshot.latest,
        snapshot.timeline.topics(),
        [
            [*snapshot.timeline.extents(topic, TimeWindow.everything())]
            for topic in snapshot.timeline.topics()
        ],
        [snapshot.timeline.types_of(topic) for topic in snapshot.timeline.topics()],
        snapshot.timeline.transient_local,
        snapshot.timeline.overlapping(TimeWindow(20, 60)),
    )
