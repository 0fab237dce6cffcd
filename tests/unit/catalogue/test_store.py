"""The catalogue keeps what digests say, and never does harm."""

from __future__ import annotations

import random
import sqlite3
import threading
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import structlog

from ros2_memory.catalogue.digest import Digester
from ros2_memory.catalogue.digest_config import DigestConfig
from ros2_memory.catalogue.store import FILE, FOLDER, Catalogue
from ros2_memory.columns.database import RETRY_S
from ros2_memory.columns.store import BagKey, relative
from ros2_memory.core.model import BagFile, BagState
from tests.support.bags import boolean, detections, odom, tf, transform
from tests.support.fakes import FakeReader

if TYPE_CHECKING:
    from ros2_memory.catalogue.digest import Digest
    from tests.support.bags import Msg

S = 10**9
T0 = 1_700_000_000 * S
KEY = BagKey("rec/rec_0.mcap", 1234, T0, 0)


def digest_of(*messages: Msg) -> Digest:
    reader = FakeReader()
    path = reader.add(Path("bag.mcap"), messages)
    return Digester(reader).digest(path)


DIGEST = digest_of(
    tf(T0, transform(T0, "base_link", "laser", (0.1, 0.0, 0.2)), topic="/tf_static"),
    odom(T0, 1.0, 2.0, 0.3, vx=0.5),
    odom(T0 + S, 2.0, 2.0, 0.3, vx=0.5),
    odom(T0 + 2 * S, 2.0, 2.0, 0.3, vx=0.5),
    odom(T0 + 3 * S, 2.0, 2.0, 0.3, vx=0.5),
    boolean(T0, False),
    detections(T0 + S, ["cup", "person"]),
    boolean(T0 + S, True),
)


CONFIG = DigestConfig("config")


def catalogue_in(folder: Path, base: str = "config", **entries: str) -> Catalogue:
    return Catalogue([folder / FOLDER / FILE], DigestConfig(base, entries))


def test_a_text_is_stored_until_the_newest_entry_is_deleted(tmp_path: Path) -> None:
    catalogue = catalogue_in(tmp_path)
    catalogue.store_text("name", "of no entry")
    assert catalogue.text("name") is None
    assert catalogue.put(KEY, DIGEST)
    for each in ("one", "zw\u00f6lf"):
        catalogue.store_text("name", each)
        assert catalogue.text("name") == each
    assert catalogue.text("another") is None
    catalogue.forget([KEY.path])
    assert catalogue.text("name") is None


def test_an_entry_that_was_replaced_does_not_exist(tmp_path: Path) -> None:
    catalogue = catalogue_in(tmp_path)
    assert catalogue.put(KEY, DIGEST)
    [before] = catalogue.find([KEY])
    assert before is not None
    assert catalogue.existing([before, before + 1]) == {before}
    assert catalogue.put(KEY, DIGEST)
    assert catalogue.existing([before]) == set()


def made(folder: Path) -> None:
    catalogue = catalogue_in(folder)
    assert catalogue.path is not None
    catalogue.close()


def holds(catalogue: Catalogue, key: BagKey = KEY) -> bool:
    return catalogue.find([key]) != [None]


def test_what_was_put_comes_back_as_it_was_also_from_another_process_later(tmp_path: Path) -> None:
    first = catalogue_in(tmp_path)
    assert first.put(KEY, DIGEST)
    first.close()
    again = catalogue_in(tmp_path)
    [number] = again.find([KEY])
    assert number is not None
    path = str(tmp_path / KEY.path)
    summary, (_, size, mtime_ns, sidecar_ns) = DIGEST.summary, KEY
    content = (summary, summary.start, summary.end)
    file = BagFile(path, size, mtime_ns, BagState.CLOSED, *content, sidecar_ns, number)
    assert again.known_files(tmp_path) == {path: file}
    for held in DIGEST.topics:
        assert again.relatched(held.topic, [number]) == {number: held.relatched}
        assert again.undecodable(held.topic, [number]) == {number: dict(held.undecodable)}


def test_digests_are_read_from_a_file_that_replaced_another(
    tmp_path: Path,
) -> None:
    catalogue = catalogue_in(tmp_path)
    catalogue.put(KEY, DIGEST)
    [former] = catalogue.find([KEY])
    assert catalogue.path is not None
    catalogue.path.unlink()
    catalogue.look_after()
    assert catalogue.put(KEY, DIGEST)
    [number] = catalogue.find([KEY])
    assert former is not None
    assert number is not None
    assert catalogue.relatched("/tf_static", [former, number]) == {number: False}


@pytest.mark.parametrize(
    "other",
    [
        KEY._replace(size=1235),
        KEY._replace(mtime_ns=T0 + 1),
        KEY._replace(sidecar_ns=T0),
        KEY._replace(path="rec/rec_1.mcap"),
    ],
)
def test_an_entry_is_of_one_file_as_it_looked_then(tmp_path: Path, other: BagKey) -> None:
    catalogue = catalogue_in(tmp_path)
    catalogue.put(KEY, DIGEST)
    assert holds(catalogue)
    assert not holds(catalogue, other)


def test_an_entry_of_another_configuration_is_not_seen(tmp_path: Path) -> None:
    catalogue_in(tmp_path, "one").put(KEY, DIGEST)
    other = catalogue_in(tmp_path, "two")
    assert not holds(other)
    other.put(KEY, DIGEST)
    assert holds(other)
    assert holds(catalogue_in(tmp_path, "one"))


def test_of_other_configurations_the_last_to_write_remains(tmp_path: Path) -> None:
    one, two, three = (catalogue_in(tmp_path, name) for name in ("one", "two", "three"))
    for catalogue in (one, two, three):
        catalogue.put(KEY, DIGEST)
    two.put(KEY._replace(path="rec/rec_1.mcap"), DIGEST)
    three.forget_older_configurations()
    assert [holds(each) for each in (one, two, three)] == [False, True, True]
    two.forget_older_configurations()
    assert [holds(each) for each in (one, two, three)] == [False, True, True]


def test_a_changed_schema_entry_concerns_the_bags_with_that_type_alone(tmp_path: Path) -> None:
    states, poses = digest_of(boolean(T0, True)), digest_of(odom(T0, 1.0, 2.0, 0.3))
    of_states, of_poses = KEY, KEY._replace(path="rec/rec_1.mcap")
    before = catalogue_in(tmp_path, **{"std_msgs/msg/Bool": "data"})
    assert before.put_all([(of_states, states), (of_poses, poses)])
    after = catalogue_in(tmp_path, **{"std_msgs/msg/Bool": "value", "a/msg/Type": "field"})
    assert [holds(after, key) for key in (of_states, of_poses)] == [False, True]
    assert [*after.known_files(tmp_path)] == [str(tmp_path / of_poses.path)]
    assert after.put(of_states, states)
    assert [holds(each, of_states) for each in (before, after)] == [True, True]


def test_of_the_last_to_write_bags_of_all_types_remain(tmp_path: Path) -> None:
    states, poses = KEY, KEY._replace(path="rec/rec_1.mcap")
    for base in ("older", "last"):
        catalogue = catalogue_in(tmp_path, base)
        catalogue.put(states, digest_of(boolean(T0, True)))
        catalogue.put(poses, digest_of(odom(T0, 1.0, 2.0, 0.3)))
    catalogue_in(tmp_path, "now").forget_older_configurations()
    for base, stays in (("older", False), ("last", True)):
        assert [holds(catalogue_in(tmp_path, base), key) for key in (states, poses)] == [stays] * 2


def test_alone_in_a_catalogue_a_configuration_keeps_what_it_found(tmp_path: Path) -> None:
    catalogue = catalogue_in(tmp_path)
    catalogue.put(KEY, DIGEST)
    catalogue.forget_older_configurations()
    assert holds(catalogue)


def test_a_changed_file_takes_the_place_of_its_entry_under_a_new_number(tmp_path: Path) -> None:
    catalogue = catalogue_in(tmp_path)
    catalogue.put(KEY, DIGEST)
    [before] = catalogue.find([KEY])
    changed = KEY._replace(size=99)
    catalogue.put(changed, digest_of(boolean(T0, False)))
    [after] = catalogue.find([changed])
    assert before is not None
    assert after is not None
    assert after > before
    assert catalogue.newest() == after
    assert not holds(catalogue)
    assert catalogue.relatched("/tf_static", [before, after]) == {}


def test_compacting_gives_back_what_was_deleted(tmp_path: Path) -> None:
    catalogue = catalogue_in(tmp_path)
    other = KEY._replace(path="rec/rec_1.mcap")
    assert catalogue.put_all([(KEY, DIGEST), (other, DIGEST)])
    [number] = catalogue.find([other])
    assert number is not None
    assert catalogue.path is not None
    catalogue.cache_answer("long", [number], random.Random(1).randbytes(200_000).hex())
    catalogue.compact()
    before = catalogue.path.stat().st_size
    catalogue.forget([other.path])
    catalogue.compact()
    assert catalogue.path.stat().st_size < before - 100_000
    assert holds(catalogue)


def test_what_entries_add_up_to_is_kept_only_while_all_of_them_are_there(tmp_path: Path) -> None:
    catalogue = catalogue_in(tmp_path)
    keys = [KEY, KEY._replace(path="rec/rec_1.mcap"), KEY._replace(path="rec/rec_2.mcap")]
    assert catalogue.put_all([(each, digest_of(boolean(T0, True))) for each in keys])
    numbers = [each for each in catalogue.find(keys) if each is not None]
    catalogue.forget([keys[2].path])
    catalogue.cache_answer("what", numbers[:2], "kept")
    catalogue.cache_answer("what", numbers, "late")
    assert catalogue.cached_answer("what", numbers[:2]) == "kept"
    assert catalogue.cached_answer("what", numbers) is None


def test_what_is_computed_from_nothing_is_not_stored_and_what_is_refused_is_counted(
    tmp_path: Path,
) -> None:
    catalogue = catalogue_in(tmp_path)
    catalogue.cache_answer("what", [], "nothing")
    assert (catalogue.cached_answer("what", []), catalogue.refusals) == (None, 0)

    def refuse(_: sqlite3.Connection) -> None:
        raise ValueError("too large")

    assert not catalogue.write(refuse)
    assert (catalogue.refusals, catalogue.refused_for) == (1, "too large")


def test_what_is_forgotten_leaves_nothing_behind(tmp_path: Path) -> None:
    catalogue = catalogue_in(tmp_path)
    catalogue.put(KEY, DIGEST)
    catalogue.forget([KEY.path])
    catalogue.close()
    with closing(sqlite3.connect(tmp_path / FOLDER / FILE)) as base:
        for table in ("bags", "held"):
            assert base.execute(f"SELECT count(*) FROM {table}").fetchone() == (0,)  # noqa: S608


@pytest.mark.parametrize(
    "content", [b"not a database at all" * 500, b"SQLite format 3\x00" + b"\xff" * 5000]
)
def test_a_damaged_file_is_set_aside_and_made_anew(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / FOLDER / FILE
    path.parent.mkdir()
    path.write_bytes(content)
    with structlog.testing.capture_logs() as logs:
        catalogue = catalogue_in(tmp_path)
        assert catalogue.newest() == 0
    assert [event["event"] for event in logs] == ["database_set_aside"]
    assert path.with_name(f"{FILE}.aside").read_bytes() == content
    assert catalogue.put(KEY, DIGEST)
    assert holds(catalogue_in(tmp_path))


def test_a_file_that_turns_out_damaged_while_it_is_asked_is_set_aside_then(tmp_path: Path) -> None:
    catalogue = catalogue_in(tmp_path)
    catalogue.put(KEY, DIGEST)
    [number] = catalogue.find([KEY])
    assert number is not None
    with closing(sqlite3.connect(tmp_path / FOLDER / FILE)) as base:
        base.execute("UPDATE held SET undecodable = '{'")
        base.commit()
    catalogue.undecodable("/odom", [number])
    assert not holds(catalogue)
    assert catalogue.put(KEY, DIGEST)
    assert holds(catalogue)


def test_a_file_of_a_newer_version_is_set_aside(tmp_path: Path) -> None:
    made(tmp_path)
    path = tmp_path / FOLDER / FILE
    with closing(sqlite3.connect(path)) as base:
        base.execute("PRAGMA user_version = 99")
    with structlog.testing.capture_logs() as logs:
        catalogue = catalogue_in(tmp_path)
        assert catalogue.newest() == 0
    assert [event["event"] for event in logs] == ["database_set_aside"]
    assert "version 99" in logs[0]["reason"]
    assert catalogue.path == path
    assert catalogue.put(KEY, DIGEST)


def test_a_locked_file_is_left_alone_and_memory_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ros2_memory.columns.database.BUSY_S", 0.01)
    made(tmp_path)
    path = tmp_path / FOLDER / FILE
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        with structlog.testing.capture_logs() as logs:
            catalogue = catalogue_in(tmp_path)
            assert catalogue.newest() == 0
        assert [event["event"] for event in logs] == ["database_locked"]
        assert catalogue.path is None
        assert catalogue.put(KEY, DIGEST)
        assert holds(catalogue)
    assert path.exists()
    assert not holds(catalogue_in(tmp_path))


def test_where_the_first_place_cannot_be_written_the_next_one_is_used(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("a file, and no folder")
    refused = tmp_path / "file" / FOLDER / FILE
    second = tmp_path / "cache" / FILE
    assert Catalogue([refused, second], CONFIG).path == second
    nowhere = Catalogue([refused], CONFIG)
    assert nowhere.path is None
    assert nowhere.put(KEY, DIGEST)
    assert holds(nowhere)


def test_two_catalogues_over_one_file_see_each_others_entries(tmp_path: Path) -> None:
    one, two = catalogue_in(tmp_path), catalogue_in(tmp_path)
    before = two.newest()
    one.put(KEY, DIGEST)
    assert two.newest() > before
    assert holds(two)


def test_threads_share_a_catalogue(tmp_path: Path) -> None:
    catalogue = catalogue_in(tmp_path)
    keys = [KEY._replace(path=f"rec/rec_{n}.mcap") for n in range(40)]

    def put(part: list[BagKey]) -> None:
        for key in part:
            catalogue.put(key, DIGEST)
            assert holds(catalogue, key)

    threads = [threading.Thread(target=put, args=(keys[n::4],)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert None not in catalogue.find(keys)


def test_a_closed_catalogue_knows_nothing_and_complains_of_nothing(tmp_path: Path) -> None:
    catalogue = catalogue_in(tmp_path)
    catalogue.close()
    assert catalogue.find([KEY]) == [None]
    assert not catalogue.put(KEY, DIGEST)
    assert catalogue.newest() == 0


def test_a_name_that_is_no_text_can_be_kept(tmp_path: Path) -> None:
    odd = tmp_path / "rec" / "bag\udcff.mcap"
    key = KEY._replace(path=relative(str(odd), str(tmp_path)))
    catalogue = catalogue_in(tmp_path)
    assert catalogue.put(key, DIGEST)
    assert holds(catalogue, key)


def test_nothing_is_made_before_the_bag_directory_exists(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    catalogue = Catalogue([bag_dir / FOLDER / FILE], CONFIG, waits_for=bag_dir)
    assert not catalogue.put(KEY, DIGEST)
    assert catalogue.path is None
    assert not bag_dir.exists()
    bag_dir.mkdir()
    assert catalogue.put(KEY, DIGEST)
    assert holds(catalogue)


class TestAPlaceThatComesUp:
    """As when a recorder comes to bags whose catalogue lies in the cache."""

    def catalogue(self, places: list[Path], monotonic: list[float]) -> Catalogue:
        return Catalogue(lambda: places, CONFIG, monotonic=lambda: monotonic[0])

    def test_the_content_at_the_previous_path_is_copied(self, tmp_path: Path) -> None:
        beside, cache = tmp_path / "bags" / FILE, tmp_path / "cache" / FILE
        places, now = [cache], [0.0]
        catalogue = self.catalogue(places, now)
        assert catalogue.put(KEY, DIGEST)
        [number] = catalogue.find([KEY])
        places.insert(0, beside)
        catalogue.look_after()
        assert catalogue.path == cache, "it is tried now and then"
        now[0] = RETRY_S
        catalogue.look_after()
        assert catalogue.path == beside
        assert holds(catalogue)
        assert number is not None
        assert not catalogue.is_current(number)
        other = KEY._replace(path="rec/later.mcap")
        assert catalogue.put(other, DIGEST)
        assert not holds(Catalogue([cache], CONFIG), other)
        assert [path.name for path in beside.parent.iterdir() if path.name.startswith(".")] == []

    def test_it_takes_the_place_of_none_that_lies_there(self, tmp_path: Path) -> None:
        beside, cache = tmp_path / "bags" / FILE, tmp_path / "cache" / FILE
        other = KEY._replace(path="rec/other.mcap")
        assert Catalogue([beside], CONFIG).put(other, DIGEST)
        assert Catalogue([cache], CONFIG).put(KEY, DIGEST)
        catalogue = Catalogue([beside, cache], CONFIG)
        assert (holds(catalogue, other), holds(catalogue)) == (True, False)

    def test_one_that_is_none_of_this_version_is_not_taken_along(self, tmp_path: Path) -> None:
        beside, cache = tmp_path / "bags" / FILE, tmp_path / "cache" / FILE
        with closing(Catalogue([cache], CONFIG)) as older:
            assert older.put(KEY, DIGEST)
        with closing(sqlite3.connect(cache)) as base:
            base.execute("PRAGMA user_version = 1")
        before = cache.read_bytes()
        catalogue = Catalogue([beside, cache], CONFIG)
        assert (catalogue.path, holds(catalogue)) == (beside, False)
        assert cache.read_bytes() == before
        cache.write_bytes(b"no catalogue at all")
        third = Catalogue([tmp_path / "third" / FILE, cache], CONFIG)
        assert third.put(KEY, DIGEST)

    def test_a_new_one_starts_with_what_another_holds_and_leaves_that_alone(
        self, tmp_path: Path
    ) -> None:
        beside, cache = tmp_path / "bags" / FILE, tmp_path / "cache" / FILE
        with closing(Catalogue([beside], CONFIG)) as other:
            assert other.put(KEY, DIGEST)
        before = {each: each.read_bytes() for each in beside.parent.iterdir()}
        with closing(Catalogue([cache], CONFIG, sources=[beside])) as catalogue:
            assert (catalogue.path, holds(catalogue)) == (cache, True)
            assert catalogue.put(KEY._replace(path="rec/later.mcap"), DIGEST)
        assert {each: each.read_bytes() for each in beside.parent.iterdir()} == before

    def test_a_new_one_starts_with_what_another_program_writes(self, tmp_path: Path) -> None:
        beside, cache = tmp_path / "bags" / FILE, tmp_path / "cache" / FILE
        other = Catalogue([beside], CONFIG)
        assert other.put(KEY, DIGEST)
        assert holds(Catalogue([cache], CONFIG, sources=[beside]))

    def test_it_is_not_left_where_it_may_no_longer_be_made(self, tmp_path: Path) -> None:
        beside, cache = tmp_path / "bags" / FILE, tmp_path / "cache" / FILE
        places, now = [beside, cache], [0.0]
        catalogue = self.catalogue(places, now)
        assert catalogue.put(KEY, DIGEST)
        del places[0]
        now[0] = RETRY_S
        catalogue.look_after()
        assert catalogue.path == beside
        assert holds(catalogue)

    def test_where_it_cannot_be_written_the_former_one_goes_on(self, tmp_path: Path) -> None:
        (tmp_path / "bags").write_text("a file, and no folder")
        cache = tmp_path / "cache" / FILE
        places, now = [cache], [0.0]
        catalogue = self.catalogue(places, now)
        assert catalogue.put(KEY, DIGEST)
        places.insert(0, tmp_path / "bags" / FILE)
        for now[0] in (RETRY_S, 3 * RETRY_S):
            catalogue.look_after()
            assert catalogue.path == cache
            assert holds(catalogue)
