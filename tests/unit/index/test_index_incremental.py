"""What a walk of the bag directory finds; an index that followed every change finds that, too."""

import os
import shutil
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest
import zstandard
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ros2_memory.bag_dir.heartbeat import HEARTBEAT_FILE
from ros2_memory.index.bag_rows import BagRows
from ros2_memory.index.scan import ScanResult, Tree
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.recorder.index_manager import IndexManager
from ros2_memory.storage.mcap_reader import McapReader
from tests.support.bags import odom, set_mtime, write_mcap
from tests.support.clocks import SettableClock
from tests.support.examples import examples
from tests.support.heartbeats import beat
from tests.support.memories import Remember, asked, memory_of
from tests.support.plain_text_bags import PlainReader, close, grow, plain
from tests.unit.core.test_deep_directories import within

S = 10**9
NOW = 1_800_000_000 * S
FOLDERS = (".", "rec_1", "rec_2", "day/rec_3", ".trash")

NAMES = (
    "a.mcap",
    "b.mcap",
    "a.mcap.zstd",
    "rec_1_0.mcap",
    "rec_1_0.mcap.zstd",
    "c.db3",
    "d.db3.zstd",
    "notes.txt",
)

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
            set_mtime(other, self.clock.at)
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
            set_mtime(path, self.clock.at)
        for folder in path.parents:
            if folder.is_relative_to(self.root) and folder.is_dir():
                set_mtime(folder, self.clock.at)


@settings(max_examples=examples(300))
@given(script=st.lists(steps, max_size=40))
@example(
    script=[
        ("open", "rec_1/a.mcap", 0),
        ("beat", "./a.mcap", 0),
        ("wait", "", WAITS_S.index(2.0)),
        ("scan", "", 0),
        ("beat", "./a.mcap", 1),
    ]
)
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
            assert [*other.bags] == [*fresh.bags]
        again = _without_growth(world.index.refresh())
        assert replace(again, scanned_at=0) == replace(_without_growth(fresh), scanned_at=0)


def _without_growth(snapshot: Snapshot) -> Snapshot:
    """Without what only somebody knows who looked twice: that a file grew."""
    return replace(snapshot, active=tuple(replace(each, growing=False) for each in snapshot.active))


LONG_AGO = NOW - 3600 * S


def put(path: Path, text: str = "x") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    set_mtime(path, LONG_AGO)
    return path


def aged(root: Path) -> Path:
    """Gives every directory an mtime that proves that nothing came or went since."""
    for folder in (root, *(path for path in root.rglob("*") if path.is_dir())):
        set_mtime(folder, LONG_AGO)
    return root


def scanned_names(scanned: ScanResult) -> list[str]:
    return sorted(Path(path).name for path in scanned.stamps)


def test_a_watched_file_that_left_and_came_back_within_one_tick_is_found(tmp_path: Path) -> None:
    path = put(tmp_path / "a.mcap")
    tree = Tree(aged(tmp_path))
    tree.scan(NOW, ())
    path.unlink()
    aged(tmp_path)
    assert tree.scan(NOW, [str(path)]).gone == {str(path)}
    put(path)
    aged(tmp_path)
    assert scanned_names(tree.scan(NOW, ())) == ["a.mcap"]


def test_links_are_named_and_not_followed(tmp_path: Path) -> None:
    put(tmp_path / "elsewhere" / "a.mcap")
    bags = tmp_path / "bags"
    put(bags / "rec" / "b.mcap")
    (bags / "latest").symlink_to(bags / "rec", target_is_directory=True)
    (bags / "up").symlink_to(tmp_path, target_is_directory=True)
    (bags / "c.mcap").symlink_to(tmp_path / "elsewhere" / "a.mcap")
    (bags / "broken.mcap").symlink_to(tmp_path / "nowhere")
    (bags / "README").symlink_to(put(tmp_path / "readme.txt"))
    (bags / ".hidden").symlink_to(tmp_path, target_is_directory=True)
    tree = Tree(aged(bags))
    first, second = tree.scan(NOW, ()), tree.scan(NOW, ())
    assert scanned_names(first) == ["b.mcap"]
    for scanned in (first, second):
        reasons = {each.path.name: each.reason for each in scanned.links}
        assert reasons.keys() == {"broken.mcap", "c.mcap", "latest", "up"}
        assert all("not followed" in reason for reason in reasons.values())


def test_a_folder_that_cannot_be_listed_is_damaged_and_hides_no_other(tmp_path: Path) -> None:
    put(tmp_path / "rec" / "a.mcap")
    deep = "d" * 250
    with within(tmp_path, 18, deep):  # longer than any path may be
        pass
    tree = Tree(tmp_path)
    first, second = tree.scan(NOW, ()), tree.scan(NOW, ())
    assert scanned_names(first) == ["a.mcap"]
    assert second.gone == set()
    for scanned in (first, second):
        assert [each.path.parts[len(tmp_path.parts)] for each in scanned.damaged] == [deep]
        assert scanned.damaged[0].reason == "the directory cannot be listed: File name too long"


@pytest.mark.parametrize("kind", ["missing", "file"])
def test_a_root_that_is_no_directory_is_a_problem_and_empties_the_tree(
    tmp_path: Path, kind: str
) -> None:
    bags = tmp_path / "bags"
    path = put(bags / "rec" / "a.mcap")
    tree = Tree(aged(bags))
    tree.scan(NOW, ())
    bags.rename(tmp_path / "aside")
    if kind == "file":
        bags.write_text("")
    scanned = tree.scan(NOW, [str(path)])
    assert scanned.gone == {str(path)}
    assert scanned.stamps == {}
    words = "does not exist (yet): check" if kind == "missing" else "is a file, not a directory"
    assert words in (scanned.problem or "")
    assert (scanned.problem or "").endswith("recording.bag_dir (MEMORY_BAG_DIR)")
    named = Tree(bags, setting="fleet.robots").scan(NOW, ()).problem or ""
    assert named.endswith(" fleet.robots")
    bags.unlink(missing_ok=True)
    (tmp_path / "aside").rename(bags)
    assert scanned_names(tree.scan(NOW, ())) == ["a.mcap"]


def write_odometry(path: Path, speed: float, later: int = 0) -> Path:
    begin = 1_784_000_000 * S
    poses = [odom(begin + later + n * S, speed * n, 0.0) for n in range(10)]
    write_mcap(path, poses)
    set_mtime(path, begin)
    return path


def test_bags_with_pauses_of_their_own_share_what_they_say_of_topics(
    tmp_path: Path, remember: Remember
) -> None:
    """Else 6,000 bags of a robot that stalls in each take 30 MB in place of 10, and gaps 8 s."""
    for split in range(2):
        begin = (1_784_000_000 + 10 * split) * S
        poses = [odom(begin + n * S // 10, 0.0) for n in range(90) if not 20 < n < 40 + split]
        write_mcap(tmp_path / "rec" / f"rec_{split}.mcap", poses)
    timeline = remember().index.snapshot().timeline
    one, other = (bag.summary.schema for bag in timeline.bags)
    assert one.pauses != other.pauses
    assert one.topics is other.topics
    assert one.positions is other.positions


def test_a_copy_of_a_bag_beside_it_counts_once(tmp_path: Path, remember: Remember) -> None:
    path = write_odometry(tmp_path / "rec" / "rec_0.mcap", 0.1)
    for name in ("rec_0 (copy).mcap", "another.mcap"):
        shutil.copy2(path, path.with_name(name))
    memory = remember()
    assert [bag.file for bag in memory.index.snapshot().bags] == [str(path)]
    for file in (path, path.with_name("another.mcap")):
        [odometry] = asked(memory, "list_recorded_topics")
        assert odometry["count"] == 10
        file.unlink()


def test_a_copy_of_the_second_of_two_runs_with_equal_times_counts_once(
    tmp_path: Path, remember: Remember
) -> None:
    """As of a simulation: the copy is compared with both, not with the first alone."""
    runs = [
        write_odometry(tmp_path / "runs" / f"{name}.mcap", 0.1 + n) for n, name in enumerate("ab")
    ]
    assert runs[0].stat().st_size == runs[1].stat().st_size
    shutil.copy2(runs[1], runs[1].with_name("b (copy).mcap"))
    memory = remember()
    assert [bag.path for bag in memory.index.snapshot().bags] == runs
    [odometry] = asked(memory, "list_recorded_topics")
    assert odometry["count"] == 20


def test_another_bag_written_over_one_of_its_size_and_mtime_is_read_anew(
    tmp_path: Path, remember: Remember
) -> None:
    path = write_odometry(tmp_path / "rec" / "rec_0.mcap", 0.1)
    memory = remember()

    def driven() -> float:
        of_all = {"start": 1_784_000_000, "end": 1_784_000_099}
        return float(asked(memory, "trajectory_summary", **of_all)["distance_m"])

    assert driven() == 0.9
    before, other = path.stat(), write_odometry(tmp_path / "other", 0.2, later=S).read_bytes()
    with path.open("r+b") as stream:
        stream.write(other)
    set_mtime(path, before.st_mtime_ns)
    assert path.stat()[:7] == before[:7]
    memory.index.refresh()
    assert driven() == 1.8


@pytest.mark.parametrize("dated", ["rec_1.mcap", "handover.json"])
def test_a_file_dated_after_2262_hides_no_bag(
    tmp_path: Path, remember: Remember, dated: str
) -> None:
    paths = [tmp_path / "rec" / f"rec_{number}.mcap" for number in range(2)]
    for path in paths:
        write_odometry(path, 0.1, later=int(path == paths[1]) * 10 * S)
    put(tmp_path / "rec" / "handover.json", '{"format": 1}')
    os.utime(tmp_path / "rec" / dated, ns=(LONG_AGO, 10_413_792_000 * S))
    [odometry] = asked(remember(), "list_recorded_topics")
    assert odometry["count"] == 20


@pytest.mark.parametrize("now", [NOW, 1000 * S])
def test_there_are_no_notes_on_closed_bags_even_if_the_clock_is_not_set_yet(
    tmp_path: Path, now: int
) -> None:
    """A robot without a battery-backed clock starts in 1970, with a week of bags."""
    path = write_mcap(tmp_path / "rec" / "rec_0.mcap", [odom(NOW - 7200 * S, 0.0, 0.0)])
    set_mtime(path, LONG_AGO)
    clock = SettableClock(now)
    index = IndexManager(tmp_path, McapReader(), clock, refresh_s=0.0, split_duration_s=10.0)
    with index.undisturbed() as snapshot:
        assert [bag.path for bag in snapshot.bags] == [path]
        assert not index.known_bags((), snapshot).files
    path.unlink()
    assert not index.refresh().bags


@pytest.mark.parametrize(("name", "bags"), [("rec_1", 1), ("sample", 2)])
def test_a_split_that_a_kill_left_in_both_forms_counts_once(
    tmp_path: Path, name: str, bags: int
) -> None:
    """The recorder was killed after it had compressed a split, before it deleted the other form."""
    path = write_mcap(
        tmp_path / "rec" / f"{name}.mcap", [odom(n * S, 0.1 * n, 0.0) for n in range(9)]
    )
    packed = path.with_name(f"{path.name}.zstd")
    packed.write_bytes(zstandard.compress(path.read_bytes()))
    for file in (path, packed):
        set_mtime(file, LONG_AGO)
    memory = memory_of(tmp_path, storage="rosbag2")
    [odometry] = asked(memory, "list_recorded_topics")
    assert odometry["count"] == 9 * bags
    path.unlink()
    assert [bag.path for bag in memory.index.refresh().bags] == [packed]
