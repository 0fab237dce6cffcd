"""Two servers on one bag directory: each answers as if it were alone, also when the other dies."""

import sqlite3
from contextlib import closing
from functools import partial
from pathlib import Path

from tests.faults.running import Running, load, serving
from tests.faults.test_store_faults import assert_sound
from tests.faults.world import write_bag, write_bags
from tests.support.column_worlds import store_file
from tests.support.processes import until

COUNT = 12


def is_ready(running: Running, count: int) -> bool:
    health = running.health()
    return (health["bags"], health["store"]["state"]) == (count, "ready")


def stored(path: Path) -> list[str]:
    with closing(sqlite3.connect(path)) as base:
        return [
            row[0] for row in base.execute("SELECT path FROM bag WHERE size >= 0 ORDER BY path")
        ]


def test_two_servers_share_a_directory_and_one_goes_on_without_the_other(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    write_bags(bag_dir, COUNT)
    (bag_dir / "recorder.json").write_text("{}")
    with serving(tmp_path / "bags", tmp_path / "first") as first:
        until(partial(is_ready, first, COUNT))
        right = first.ask_all(COUNT)
        with serving(bag_dir, tmp_path / "second") as second:
            assert second.ask_all(COUNT) == right
            write_bag(bag_dir, COUNT)
            for each in (first, second):
                until(partial(is_ready, each, COUNT + 1))
            right = first.ask_all(COUNT + 1)
            assert second.ask_all(COUNT + 1) == right
            with load(second, COUNT + 1):
                write_bag(bag_dir, COUNT + 1)
                second.kill()
            until(partial(is_ready, first, COUNT + 2))
        right = first.ask_all(COUNT + 2)
        for each in (first, second):
            assert each.logged("database_set_aside") == []
            assert each.logged("database_lost") == []
            assert each.logged("tool_failed") == []
    path = store_file(bag_dir)
    assert stored(path) == sorted({f"rec/rec_{n}.mcap" for n in range(COUNT + 2)})
    assert_sound(path, COUNT + 2)
    with serving(bag_dir, tmp_path / "third") as third:
        until(partial(is_ready, third, COUNT + 2))
        assert third.ask_all(COUNT + 2) == right
