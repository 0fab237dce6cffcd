"""Walking the bag directory."""

import os
import shutil
from pathlib import Path

import pytest

from ros2_memory.bag_dir.layout import bag_kind
from ros2_memory.index.scan import ScanResult, Tree
from tests.support.bags import odom, write_mcap
from tests.support.memories import asked, each_way, memory_of
from tests.unit.core.test_deep_directories import within

S = 10**9
NOW = 1_800_000_000 * S
LONG_AGO = NOW - 3600 * S


def _file(path: Path, text: str = "x", *, at: int = LONG_AGO) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    os.utime(path, ns=(at, at))
    return path


def _aged(root: Path, at: int = LONG_AGO) -> Path:
    """Gives every directory an mtime that proves that nothing came or went since."""
    for folder in (root, *(path for path in root.rglob("*") if path.is_dir())):
        os.utime(folder, ns=(at, at))
    return root


def _names(scanned: ScanResult) -> list[str]:
    return sorted(Path(path).name for path in scanned.stamps)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("rec_0.mcap", ".mcap"),
        ("rec_0.db3", ".db3"),
        ("rec_0.mcap.zstd", ".mcap.zstd"),
        ("rec_0.db3.zstd", ".db3.zstd"),
        ("REC_0.MCAP", ".mcap"),
        (".rec_0.mcap", None),
        ("rec_0.db3-wal", None),
        ("rec_0.mcap.tmp", None),
    ],
)
def test_a_bag_is_known_by_the_end_of_its_name(name: str, kind: str | None) -> None:
    assert bag_kind(name) == kind


def test_a_watched_file_that_left_and_came_back_within_one_tick_is_found(tmp_path: Path) -> None:
    path = _file(tmp_path / "a.mcap")
    tree = Tree(_aged(tmp_path))
    tree.scan(NOW, ())
    path.unlink()
    _aged(tmp_path)
    assert tree.scan(NOW, [str(path)]).gone == {str(path)}
    _file(path)
    _aged(tmp_path)
    assert _names(tree.scan(NOW, ())) == ["a.mcap"]


def test_links_are_named_and_not_followed(tmp_path: Path) -> None:
    _file(tmp_path / "elsewhere" / "a.mcap")
    bags = tmp_path / "bags"
    _file(bags / "rec" / "b.mcap")
    (bags / "latest").symlink_to(bags / "rec", target_is_directory=True)
    (bags / "up").symlink_to(tmp_path, target_is_directory=True)
    (bags / "c.mcap").symlink_to(tmp_path / "elsewhere" / "a.mcap")
    (bags / "broken.mcap").symlink_to(tmp_path / "nowhere")
    (bags / "README").symlink_to(_file(tmp_path / "readme.txt"))
    (bags / ".hidden").symlink_to(tmp_path, target_is_directory=True)
    tree = Tree(_aged(bags))
    first, second = tree.scan(NOW, ()), tree.scan(NOW, ())
    assert _names(first) == ["b.mcap"]
    for scanned in (first, second):
        assert sorted(each.path.name for each in scanned.links) == [
            "broken.mcap",
            "c.mcap",
            "latest",
            "up",
        ]
        assert all("not followed" in each.reason for each in scanned.links)


def test_a_folder_that_cannot_be_listed_is_damaged_and_hides_no_other(tmp_path: Path) -> None:
    _file(tmp_path / "rec" / "a.mcap")
    deep = "d" * 250
    with within(tmp_path, 18, deep):  # longer than any path may be
        pass
    tree = Tree(tmp_path)
    first, second = tree.scan(NOW, ()), tree.scan(NOW, ())
    assert _names(first) == ["a.mcap"]
    assert second.gone == set()
    for scanned in (first, second):
        assert [each.path.parts[len(tmp_path.parts)] for each in scanned.damaged] == [deep]
        assert scanned.damaged[0].reason == "the directory cannot be listed: File name too long"


@pytest.mark.parametrize("kind", ["missing", "file"])
def test_a_root_that_is_no_directory_is_a_problem_and_empties_the_tree(
    tmp_path: Path, kind: str
) -> None:
    bags = tmp_path / "bags"
    path = _file(bags / "rec" / "a.mcap")
    tree = Tree(_aged(bags))
    tree.scan(NOW, ())
    bags.rename(tmp_path / "aside")
    if kind == "file":
        bags.write_text("", encoding="utf-8")
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
    assert _names(tree.scan(NOW, ())) == ["a.mcap"]


def write_odometry(path: Path, speed: float, later: int = 0) -> Path:
    begin = 1_784_000_000 * S
    poses = [odom(begin + later + n * S, speed * n, 0.0) for n in range(10)]
    write_mcap(path, poses)
    os.utime(path, ns=(begin, begin))
    return path


@each_way
def test_a_copy_of_a_bag_beside_it_counts_once(tmp_path: Path, recalls: bool) -> None:
    path = write_odometry(tmp_path / "rec" / "rec_0.mcap", 0.1)
    for name in ("rec_0 (copy).mcap", "another.mcap"):
        shutil.copy2(path, path.with_name(name))
    memory = memory_of(tmp_path, recalls=recalls)
    [odometry] = asked(memory, tmp_path, "list_recorded_topics")
    assert odometry["count"] == 10
    assert [bag.file for bag in memory.index.snapshot().bags] == [str(path)]
    path.unlink()
    [odometry] = asked(memory, tmp_path, "list_recorded_topics")
    assert odometry["count"] == 10


@each_way
def test_another_bag_written_over_one_of_its_size_and_mtime_is_read_anew(
    tmp_path: Path, recalls: bool
) -> None:
    path = write_odometry(tmp_path / "rec" / "rec_0.mcap", 0.1)
    memory = memory_of(tmp_path, recalls=recalls)

    def driven() -> float:
        of_all = {"start": 1_784_000_000, "end": 1_784_000_099}
        return float(asked(memory, tmp_path, "trajectory_summary", **of_all)["distance_m"])

    assert driven() == 0.9
    before, other = path.stat(), write_odometry(tmp_path / "other", 0.2, later=S).read_bytes()
    with path.open("r+b") as stream:
        stream.write(other)
    os.utime(path, ns=(before.st_mtime_ns, before.st_mtime_ns))
    assert path.stat()[:7] == before[:7]
    memory.index.refresh()
    assert driven() == 1.8


@each_way
@pytest.mark.parametrize("dated", ["rec_1.mcap", "handover.json"])
def test_a_file_dated_after_2262_hides_no_bag(tmp_path: Path, recalls: bool, dated: str) -> None:
    paths = [tmp_path / "rec" / f"rec_{number}.mcap" for number in range(2)]
    for path in paths:
        write_odometry(path, 0.1, later=int(path == paths[1]) * 10 * S)
    _file(tmp_path / "rec" / "handover.json", '{"format": 1}')
    os.utime(tmp_path / "rec" / dated, ns=(LONG_AGO, 10_413_792_000 * S))
    [odometry] = asked(memory_of(tmp_path, recalls=recalls), tmp_path, "list_recorded_topics")
    assert odometry["count"] == 20
