"""How a bag file stands, and files that the recorder holds back: no index serves these."""

from dataclasses import replace
from itertools import count
from pathlib import Path
from unittest.mock import Mock

import pytest

from ros2_memory.core.errors import BagVanishedError
from ros2_memory.core.model import BAG_KINDS, TimeWindow
from ros2_memory.history.context import Call, QuerySettings, SnapshotSource
from ros2_memory.history.coverage import describe_excluded, note_unread
from ros2_memory.history.no_data import nothing_here
from ros2_memory.history.view import View
from ros2_memory.index.file_state import (
    HELD_BACK,
    RETRY_NS,
    Classification,
    FileNotes,
    FileState,
    ScanContext,
    classify,
)
from ros2_memory.index.scan import Stamp
from ros2_memory.index.snapshot import Snapshot
from ros2_memory.retention.policy import RetentionLimits
from ros2_memory.tools.instructions import instructions
from tests.support.bags import McapLayout, set_mtime
from tests.support.clocks import SettableClock
from tests.support.memories import asked, memory_of
from tests.support.plain_text_bags import PlainReader, close, grow, plain
from tests.support.screened_bags import T0, S, ScreenedBags, mode, words

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

ACTIVE, CLOSED, INCOMPLETE = FileState.ACTIVE, FileState.CLOSED, FileState.INCOMPLETE


class RepeatedScan:
    """Scans one file again and again."""

    def __init__(self, root: Path, *, trusts_mtime: bool = True) -> None:
        self.root = root
        self.reader = PlainReader(*BAG_KINDS)
        self.trusts_mtime = trusts_mtime
        self.notes: FileNotes | None = None
        self.classification: Classification | None = None
        self.is_watched = False

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
            set_mtime(path, now - round(age_s * S))
        stamp = Stamp.of(path.lstat())
        if self.notes is None:
            self.notes = FileNotes.first(str(path), stamp, now)
        else:
            self.notes.update(stamp, now)
        recordings = None if names is None else frozenset(names)
        context = ScanContext(
            self.root, now, THREE_SPLITS, recordings, trusts_mtime=self.trusts_mtime
        )
        self.classification = classify(self.notes, self.reader, context)
        self.is_watched = self.notes.must_be_watched(self.classification, context)
        return self.classification.state


@pytest.fixture
def scan(tmp_path: Path) -> RepeatedScan:
    return RepeatedScan(tmp_path)


@pytest.mark.parametrize(
    ("name", "closed", "age_s", "names", "state"),
    [
        # Without a heartbeat an open bag is active while its mtime is within three splits.
        *(("rec/rec_0.mcap", False, age_s, None, ACTIVE) for age_s in (0, 30, -1.9)),
        *(("rec/rec_0.mcap", False, age_s, None, INCOMPLETE) for age_s in (30.001, -2, -3600)),
        # One that the heartbeat names is active however still it lies.
        *(("day/rec_1/0.mcap", False, age_s, {"day/rec_1", "b"}, ACTIVE) for age_s in (31, -9e4)),
        ("rec_0.mcap", False, 3600, {"."}, ACTIVE),
        # A young db3 is active, but where a heartbeat names other recordings, or metadata lists it.
        ("rec/rec_0.db3", True, 5, {"rec"}, ACTIVE),
        ("rec/rec_0.db3", True, 5, None, ACTIVE),
        ("rec/rec_0.db3", True, 5, {"rec_2"}, CLOSED),
        ("rec/rec_0.db3", True, 31, {"rec"}, CLOSED),
        *((f"listed/rec_{nth}.db3", True, 0, None, CLOSED) for nth in range(3)),
        *((f"listed/{name}_3.db3", True, 0, None, ACTIVE) for name in ("rec", "c")),
        # A compressed bag is closed as soon as its frame is whole.
        *((f"rec_0{kind}.zstd", False, 0, None, ACTIVE) for kind in (".mcap", ".db3")),
        *((f"rec_0{kind}.zstd", True, 0, None, CLOSED) for kind in (".mcap", ".db3")),
    ],
    ids=count(),
)
def test_a_file_is_written_closed_or_left_by_a_crash(
    scan: RepeatedScan,
    tmp_path: Path,
    name: str,
    closed: bool,
    age_s: float,
    names: set[str] | None,
    state: FileState,
) -> None:
    path = plain(tmp_path / name, [1, 2], closed=closed)
    if name.startswith("listed/"):
        path.with_name("metadata.yaml").write_text(METADATA)
    assert scan.run(path, age_s=age_s, names=names) is state
    assert scan.is_watched or state is CLOSED
    assert scan.is_watched or names != {"rec_2"}


@pytest.mark.parametrize(
    ("kind", "closed", "state"), [(".mcap", False, INCOMPLETE), (".db3", True, CLOSED)]
)
def test_where_nothing_is_recorded_a_young_mtime_may_be_that_of_a_copy(
    tmp_path: Path, kind: str, closed: bool, state: FileState
) -> None:
    def run(name: str, *ages_s: float) -> FileState:
        times = [NOW - round(age_s * S) for age_s in ages_s]
        path = plain(tmp_path / f"{name}{kind}", times, closed=closed)
        return RepeatedScan(tmp_path, trusts_mtime=False).run(path, age_s=0)

    assert {run(f"copy{old_s}", old_s) for old_s in (31, 3600, -3600, 1.8e9)} == {state}
    assert run("of another program", 3600, 5) is ACTIVE


@pytest.mark.parametrize("trusts_mtime", [True, False])
def test_a_growth_that_was_seen_counts_for_three_splits_and_not_for_a_file_put_in_its_place(
    tmp_path: Path, trusts_mtime: bool
) -> None:
    scan = RepeatedScan(tmp_path, trusts_mtime=trusts_mtime)
    path = plain(tmp_path / "rec_0.mcap", [1], closed=False)
    scan.run(path, age_s=3600)
    plain(tmp_path / "other", [1, 2, 3], closed=False).rename(path)
    assert scan.run(path, age_s=3600) is INCOMPLETE
    grow(path, 2)
    assert scan.run(path, age_s=3600) is ACTIVE
    assert scan.run(path, now=NOW + THREE_SPLITS) is ACTIVE
    assert scan.run(path, now=NOW + THREE_SPLITS + 1) is INCOMPLETE
    plain(tmp_path / "other", [1, 2, 3, 4, 5], closed=False).rename(path)
    assert scan.run(path, age_s=3600) is INCOMPLETE
    close(path)
    assert scan.run(path, age_s=3600) is CLOSED


def test_what_is_damaged_or_not_read_says_why_and_what_to_do(tmp_path: Path) -> None:
    empty = plain(tmp_path / "rec_0.mcap", silent=["/scan"], closed=False)
    capitals = plain(tmp_path / "REC_0.MCAP", [1])
    for path, state, said in (
        (empty, FileState.DAMAGED, "no message in it counts; ros2-memory recover"),
        (capitals, FileState.UNREAD, "must end in .mcap, in lower case: rename it"),
    ):
        scan = RepeatedScan(tmp_path)
        assert scan.run(path, age_s=3600) is state
        assert said in str(scan.classification)


def test_a_damaged_file_is_tried_again_when_it_changed_or_after_ten_minutes(
    scan: RepeatedScan, tmp_path: Path
) -> None:
    path = tmp_path / "rec_0.mcap"
    path.write_text("junk")
    scan.run(path, age_s=100)
    for later, tries in ((RETRY_NS - 1, 1), (RETRY_NS, 2)):
        scan.run(path, now=NOW + later)
        assert scan.reader.summaries.total() == tries
    path.chmod(0o600)
    scan.run(path, now=NOW + RETRY_NS + 1)
    assert scan.reader.summaries.total() == 3
    plain(path, [1])
    assert scan.run(path, age_s=100) is CLOSED


def test_a_file_that_vanishes_while_it_is_read_is_not_classified(
    scan: RepeatedScan, tmp_path: Path
) -> None:
    path = plain(tmp_path / "rec_0.mcap", [1])
    scan.reader.before_summary = Path.unlink
    with pytest.raises(BagVanishedError):
        scan.run(path, age_s=0)


OPEN = McapLayout(latched=frozenset({"/privacy_mode"}), finish=False, chunk_size=256)


def index_of(bags: ScreenedBags, *, include_active: bool = False) -> SnapshotSource:
    an_hour_later = SettableClock(T0 + 3600 * S)
    return memory_of(bags.bag_dir, clock=an_hour_later, include_active=include_active).index


def found_names(snapshot: Snapshot) -> list[str]:
    return [each.path.name for each in snapshot.bags]


@pytest.mark.parametrize("include_active", [False, True])
def test_a_split_is_found_once_it_is_released(tmp_path: Path, include_active: bool) -> None:
    bags = ScreenedBags(tmp_path / "bags")
    index = index_of(bags, include_active=include_active)
    name = bags.begin(0)
    bags.split([mode(-2, value=False), *words(0, 10)])
    growing = bags.split(words(10, 20), OPEN)
    assert found_names(index.snapshot()) == []
    assert [(each.path.name, each.reason, each.answers) for each in index.snapshot().active] == [
        (f"{name}_{n}.mcap", HELD_BACK, False) for n in range(2)
    ]
    growing.unlink()
    bags.split(words(20, 30))
    bags.step()
    assert found_names(index.snapshot()) == [f"{name}_0.mcap"]
    # What a crash left open is not served either: only the recorder repairs it.
    bags.split(words(30, 40), OPEN)
    bags.end()
    assert found_names(index.snapshot()) == [f"{name}_{n}.mcap" for n in (0, 2)]


def test_what_is_announced_while_a_directory_is_read_is_held_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bags = ScreenedBags(tmp_path / "bags")
    index = index_of(bags, include_active=True)
    context = index._context  # type: ignore[attr-defined]
    slow = Mock(side_effect=lambda: (context(), bags.split(words(0, 10)))[0])
    monkeypatch.setattr(index, "_context", slow)
    assert found_names(index.snapshot()) == []


def test_answers_say_what_was_excluded_and_what_is_held_back(tmp_path: Path) -> None:
    bags = ScreenedBags(tmp_path / "bags")
    name = bags.begin(0)
    bags.split([mode(-2, value=False), mode(5, value=True), *words(0, 10)])
    bags.split(words(10, 20))
    held_back = "no bag is served yet: recording.exclude_when has still to be applied to 2 splits"
    assert nothing_here(index_of(bags).snapshot()) == held_back
    limits = QuerySettings(kept=RetentionLimits(10**9, 0))
    memory = memory_of(bags.bag_dir, clock=SettableClock(T0 + 3600 * S), limits=limits)
    reply = asked(memory, "recap", start=T0 // S, end=T0 // S + 5)
    assert (reply["reason"], reply["detail"]) == (
        "not_closed_yet",
        f"{held_back}; ask again in 10 s",
    )
    bags.step()
    window = TimeWindow(T0, T0 + 30 * S)
    [excluded] = describe_excluded(bags.bag_dir, window)
    assert excluded == (
        "excluded by the rules of recording.exclude_when, so there is no data of it: "
        f"{T0 // S + 4}.000000 to {T0 // S + 10}.500001"
    )
    assert [*describe_excluded(bags.bag_dir, TimeWindow(T0, T0 + 3 * S))] == []
    view = View(replace(memory, fixed=index_of(bags).snapshot()), Call())
    note_unread(view, window)
    assert f"{HELD_BACK}: {name}/{name}_1.mcap" in view.notes.sentences()


def test_what_is_searched_first_answers_later_and_the_words_say_when(tmp_path: Path) -> None:
    bags = ScreenedBags(tmp_path / "bags")
    bags.split([mode(-2, value=False), *words(0, 10)])
    limits = QuerySettings(screened=True, include_active=True, kept=RetentionLimits(10**9, 0))
    memory = memory_of(bags.bag_dir, clock=SettableClock(T0 + 12 * S), limits=limits)
    at = {"topic": "/chatter", "timestamp": T0 // S + 5}
    assert "to 1 split; ask again in 25 s" in asked(memory, "get_topic_at_time", **at)["detail"]
    assert "the newest 25 s or so" in instructions(limits)
