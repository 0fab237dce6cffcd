"""How a bag file stands."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ros2_memory.core.errors import BagVanishedError
from ros2_memory.index.file_state import (
    RETRY_NS,
    Classification,
    FileNotes,
    FileState,
    ScanContext,
    classify,
)
from ros2_memory.index.scan import Stamp
from tests.support.plain_text_bags import PlainReader, close, grow, plain

S = 10**9
NOW = 1_800_000_000 * S
THREE_SPLITS = 30 * S
METADATA = """\
rosbag2_bagfile_information:
  version: 9
  relative_file_paths:
    - rec_0.db3
    - "old/rec_1.db3"
  files:
    - path: rec_2.db3
      message_count: 7
  topics_with_message_count:
    - topic_metadata: {name: /odom}
"""


class RepeatedScan:
    """Scans one file again and again."""

    def __init__(self, root: Path, *kinds: str) -> None:
        self.root = root
        self.reader = PlainReader(*(kinds or (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")))
        self.notes: FileNotes | None = None
        self.classification: Classification | None = None
        self.trusts_mtime = True
        self.context = ScanContext(root, NOW, THREE_SPLITS)

    def run(
        self,
        path: Path,
        *,
        age_s: float | None = None,
        now: int = NOW,
        names: set[str] | None = None,
    ) -> FileState:
        """The state at `now`, first giving the file an mtime; `names`: a live heartbeat."""
        if age_s is not None:
            mtime_ns = now - round(age_s * S)
            os.utime(path, ns=(mtime_ns, mtime_ns))
        stamp = Stamp.of(path.lstat())
        if self.notes is None:
            self.notes = FileNotes.first(str(path), stamp, now)
        else:
            self.notes.update(stamp, now)
        recordings = None if names is None else frozenset(names)
        self.context = ScanContext(
            self.root, now, THREE_SPLITS, recordings, trusts_mtime=self.trusts_mtime
        )
        self.classification = classify(self.notes, self.reader, self.context)
        return self.classification.state

    def reason(self) -> str:
        assert self.classification is not None
        assert self.classification.aside is not None
        return self.classification.aside.reason

    def is_watched(self) -> bool:
        assert self.notes is not None
        assert self.classification is not None
        return self.notes.must_be_watched(self.classification, self.context)


@pytest.fixture
def scan(tmp_path: Path) -> RepeatedScan:
    return RepeatedScan(tmp_path)


@pytest.mark.parametrize(
    ("age_s", "state"),
    [
        (0, FileState.ACTIVE),
        (30, FileState.ACTIVE),
        (30.001, FileState.INCOMPLETE),
        (3600, FileState.INCOMPLETE),
        (-1.9, FileState.ACTIVE),
        (-2, FileState.INCOMPLETE),
        (-3600, FileState.INCOMPLETE),
    ],
)
def test_without_a_heartbeat_an_open_bag_is_active_while_its_mtime_is_within_three_splits(
    scan: RepeatedScan, tmp_path: Path, age_s: float, state: FileState
) -> None:
    path = plain(tmp_path / "rec" / "rec_0.mcap", [1, 2], closed=False)
    assert scan.run(path, age_s=age_s) is state
    assert scan.is_watched()


@pytest.mark.parametrize("age_s", [0, 30.001, 86_400, -86_400])
def test_an_open_bag_of_a_recording_that_the_heartbeat_names_is_active_however_still_it_lies(
    scan: RepeatedScan, tmp_path: Path, age_s: float
) -> None:
    path = plain(tmp_path / "day" / "rec_1" / "rec_1_0.mcap", [1], closed=False)
    assert scan.run(path, age_s=age_s, names={"day/rec_1", "rec_2"}) is FileState.ACTIVE
    path = plain(tmp_path / "rec_0.mcap", [1], closed=False)
    assert RepeatedScan(tmp_path).run(path, age_s=age_s, names={"."}) is FileState.ACTIVE


def test_a_growth_that_was_seen_counts_for_three_splits_and_not_for_a_file_put_in_its_place(
    scan: RepeatedScan, tmp_path: Path
) -> None:
    path = plain(tmp_path / "rec_0.mcap", [1], closed=False)
    scan.run(path, age_s=3600)
    plain(tmp_path / "other", [1, 2, 3], closed=False).rename(path)
    assert scan.run(path, age_s=3600) is FileState.INCOMPLETE
    grow(path, 2)
    assert scan.run(path, age_s=3600) is FileState.ACTIVE
    assert scan.run(path, now=NOW + THREE_SPLITS) is FileState.ACTIVE
    assert scan.run(path, now=NOW + THREE_SPLITS + 1) is FileState.INCOMPLETE
    plain(tmp_path / "other", [1, 2, 3, 4, 5], closed=False).rename(path)
    assert scan.run(path, age_s=3600) is FileState.INCOMPLETE


def test_a_bag_left_open_before_its_first_message_is_damaged(
    scan: RepeatedScan, tmp_path: Path
) -> None:
    path = plain(tmp_path / "rec_0.mcap", silent=["/scan"], closed=False)
    assert scan.run(path, age_s=3600) is FileState.DAMAGED
    assert "no message in it counts; ros2-memory recover" in scan.reason()


def test_a_name_in_capitals_is_not_read_and_says_what_to_do(
    scan: RepeatedScan, tmp_path: Path
) -> None:
    path = plain(tmp_path / "REC_0.MCAP", [1])
    assert scan.run(path, age_s=0) is FileState.UNREAD
    assert "must end in .mcap, in lower case: rename it" in scan.reason()


def test_a_damaged_file_is_tried_again_when_it_changed_or_after_ten_minutes(
    scan: RepeatedScan, tmp_path: Path
) -> None:
    path = tmp_path / "rec_0.mcap"
    path.write_text("junk", encoding="utf-8")
    scan.run(path, age_s=100)
    scan.run(path, now=NOW + RETRY_NS - 1)
    assert scan.reader.summaries.total() == 1
    scan.run(path, now=NOW + RETRY_NS)
    assert scan.reader.summaries.total() == 2
    path.chmod(0o600)
    scan.run(path, now=NOW + RETRY_NS + 1)
    assert scan.reader.summaries.total() == 3
    plain(path, [1])
    assert scan.run(path, age_s=100) is FileState.CLOSED


def test_a_file_that_vanishes_while_it_is_read_is_not_classified(
    scan: RepeatedScan, tmp_path: Path
) -> None:
    path = plain(tmp_path / "rec_0.mcap", [1])
    scan.reader.before_summary = Path.unlink
    with pytest.raises(BagVanishedError):
        scan.run(path, age_s=0)


@pytest.mark.parametrize("name", ["rec_0.db3", "rec_1.db3", "rec_2.db3", "rec_3.db3", "c_0.db3"])
def test_a_db3_that_metadata_mentions_is_closed_at_once(
    scan: RepeatedScan, tmp_path: Path, name: str
) -> None:
    path = plain(tmp_path / "rec" / name, [1])
    (path.parent / "metadata.yaml").write_text(METADATA, encoding="utf-8")
    state = FileState.CLOSED if name[:5] in {"rec_0", "rec_1", "rec_2"} else FileState.ACTIVE
    assert scan.run(path, age_s=0) is state


def test_a_young_db3_is_active_only_where_no_heartbeat_names_other_recordings(
    scan: RepeatedScan, tmp_path: Path
) -> None:
    path = plain(tmp_path / "rec" / "rec_0.db3", [1])
    assert scan.run(path, age_s=5, names={"rec"}) is FileState.ACTIVE
    assert scan.run(path, age_s=5, names={"rec_2"}) is FileState.CLOSED
    assert scan.is_watched()
    assert scan.run(path, age_s=5) is FileState.ACTIVE
    assert scan.run(path, age_s=31, names={"rec"}) is FileState.CLOSED


@pytest.mark.parametrize("kind", [".mcap.zstd", ".db3.zstd"])
def test_a_compressed_bag_is_closed_as_soon_as_its_frame_is_whole(
    scan: RepeatedScan, tmp_path: Path, kind: str
) -> None:
    path = plain(tmp_path / f"rec_0{kind}", [1], closed=False)
    assert scan.run(path, age_s=0) is FileState.ACTIVE
    close(path)
    assert scan.run(path, age_s=0) is FileState.CLOSED


class TestWhereNothingIsRecorded:
    """A young mtime may be that of a copy."""

    def run(self, path: Path, kind: str, *ages_s: float) -> list[FileState]:
        scan = RepeatedScan(path.parent, kind)
        scan.trusts_mtime = False
        return [scan.run(path, age_s=age_s) for age_s in ages_s]

    @pytest.mark.parametrize("old_s", [31, 3600, -3600, 1.8e9])
    @pytest.mark.parametrize(
        ("kind", "closed", "state"),
        [(".mcap", False, FileState.INCOMPLETE), (".db3", True, FileState.CLOSED)],
    )
    def test_a_copy_of_other_times_is_not_being_written(
        self, tmp_path: Path, old_s: float, kind: str, closed: bool, state: FileState
    ) -> None:
        path = plain(tmp_path / f"bag{kind}", [NOW - round(old_s * S)], closed=closed)
        assert self.run(path, kind, 0) == [state]

    @pytest.mark.parametrize(("kind", "closed"), [(".mcap", False), (".db3", True)])
    def test_the_recording_of_another_program_is(
        self, tmp_path: Path, kind: str, closed: bool
    ) -> None:
        path = plain(tmp_path / f"bag{kind}", [NOW - 3600 * S, NOW - 5 * S], closed=closed)
        assert self.run(path, kind, 0) == [FileState.ACTIVE]

    def test_so_is_one_that_was_seen_to_grow(self, tmp_path: Path) -> None:
        path = plain(tmp_path / "bag.mcap", [1], closed=False)
        scan = RepeatedScan(tmp_path)
        scan.trusts_mtime = False
        assert scan.run(path, age_s=0) is FileState.INCOMPLETE
        grow(path, 2)
        assert scan.run(path, age_s=0) is FileState.ACTIVE
