"""`clear_on_startup`: what is deleted, and what never is."""

import errno
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.bag_dir.layout import SCREENED_FILE, TIMED_FILES
from ros2_memory.bag_dir.state_files import ERASING, Erasure
from ros2_memory.core.errors import RecorderError
from ros2_memory.core.model import TimeWindow
from ros2_memory.retention.clear import clear_bags, remove_if_empty
from tests.support.screened_bags import ScreenedBags, off, on, words


def make(root: Path, *names: str) -> None:
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"12345")


def left(root: Path) -> list[str]:
    return sorted(str(path.relative_to(root)) for path in root.rglob("*"))


def test_bags_of_every_kind_go_with_what_lies_beside_them_in_a_directory_or_a_link_to_it(
    tmp_path: Path,
) -> None:
    (link := tmp_path / "link").symlink_to(tmp_path / "bags")
    make(
        tmp_path / "bags",
        "rec_1/rec_1_0.mcap",
        "rec_1/rec_1_1.mcap.zstd",
        "rec_1/metadata.yaml",
        "rec_1/handover.json",
        "old/session.db3",
        "old/session.db3-wal",
        "old/session.db3-shm",
        "deep/er/bag.db3.zstd",
        "loose.mcap",
        "recorder.json",
        "recorder.qos.yaml",
    )
    wiped = clear_bags(link)
    assert left(tmp_path / "bags") == ["deep"]
    assert (wiped.files, wiped.bytes, wiped.faults) == (5, 25, [])


def test_a_directory_that_cannot_be_listed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(tmp_path, "rec_1/rec_1_0.mcap", "rec_2/rec_2_0.mcap", "lost+found/x", ".trash/x")
    make(tmp_path, SCREENED_FILE)
    scandir = os.scandir

    def failing(path: str | int) -> object:
        if Path(str(path)).name in {"rec_1", "lost+found", ".trash"}:
            raise OSError(errno.EIO, "Input/output error", path)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", failing)
    wiped = clear_bags(tmp_path)
    assert wiped.faults == [f"{tmp_path / 'rec_1'} cannot be deleted: Input/output error"]
    assert wiped.files == 1
    assert (tmp_path / SCREENED_FILE).exists()


def test_what_it_does_not_know_stays_and_so_does_its_directory(tmp_path: Path) -> None:
    make(tmp_path, "rec_1/rec_1_0.mcap", "rec_1/notes.txt", "map.pgm", "metadata.yaml")
    make(tmp_path, "not_a_bag/metadata.yaml", "not_a_bag/handover.json", "x/recorder.json")
    make(tmp_path, ".cache/a.mcap", "lost+found/#12/a.mcap", "recorder.lock")
    before = left(tmp_path)
    clear_bags(tmp_path)
    assert [*set(before) - set(left(tmp_path))] == ["rec_1/rec_1_0.mcap"]


def test_of_the_next_simulation_nothing_is_excluded_by_the_times_of_the_last(
    tmp_path: Path,
) -> None:
    for begin, mode in ((0, on(0)), (3600, off(0))):  # by the wall clock
        clear_bags(tmp_path)
        bags = ScreenedBags(tmp_path)
        bags.split([mode, *words(0, 5)], of=bags.begin(begin))
        bags.end()
    assert bags.seconds() == [0.5, 1.5, 2.5, 3.5, 4.5]


@pytest.mark.parametrize(
    "folder", ["rec_1", "rec_20260921T130000Z", "moments/a/rec_20260921T130000Z"]
)
def test_what_is_known_by_log_times_stays_where_a_recording_is_left(
    tmp_path: Path, folder: str
) -> None:
    make(tmp_path, "rec_1/notes.txt", f"{folder}/notes.txt", *TIMED_FILES)
    clear_bags(tmp_path)
    is_left = [(tmp_path / name).exists() for name in sorted(TIMED_FILES)]
    assert is_left == [folder != "rec_1"] * len(TIMED_FILES)


def test_an_interrupted_erasure_takes_nothing_from_the_next_simulation(tmp_path: Path) -> None:
    make(tmp_path, "rec_1/rec_1_0.mcap")
    ERASING.write(tmp_path, Erasure.of(["/speech"], [TimeWindow(0, 10**9)], ()))
    clear_bags(tmp_path)
    assert ERASING.read(tmp_path) is None


def test_the_root_homes_what_holds_them_and_a_link_to_one_are_refused(tmp_path: Path) -> None:
    (link := tmp_path / "bags").symlink_to(Path.home())
    for path in (Path("/"), Path.home(), Path.home().parent, link):
        with pytest.raises(RecorderError, match="clear_on_startup refuses"):
            clear_bags(path)


@given(
    st.sets(
        st.from_regex(r"([a-c]/){0,2}[a-z]{1,3}\.(mcap|db3|txt|yaml|json)", fullmatch=True),
        max_size=12,
    )
)
def test_no_file_of_another_kind_is_ever_deleted(
    tmp_path_factory: pytest.TempPathFactory, names: set[str]
) -> None:
    root = tmp_path_factory.mktemp("bags")
    make(root, *sorted(names))
    clear_bags(root)
    kept = {name for name in left(root) if (root / name).is_file()}
    assert kept == {name for name in names if not name.endswith((".mcap", ".db3"))}


@pytest.mark.parametrize(
    ("name", "content"), [("rec_1_0.mcap", b"1"), ("notes.txt", b""), ("metadata.yaml", b"x: 1")]
)
def test_a_recording_with_anything_in_it_stays(tmp_path: Path, name: str, content: bytes) -> None:
    recording = tmp_path / "rec_1"
    recording.mkdir()
    (recording / "rec_1_1.mcap").touch()
    (recording / name).write_bytes(content)
    assert not remove_if_empty(recording)
    assert len(list(recording.iterdir())) == 2
