"""SIGKILL of the server at any moment, while clients ask and its helper stores bags.

`FAULTS_KILLS` is how many more than one (1 unless given).
"""

import os
import random
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

from tests.faults.running import children_of, is_alive, load, serving
from tests.faults.world import write_bags
from tests.support.column_worlds import store_file
from tests.support.processes import until

KILLS = int(os.environ.get("FAULTS_KILLS", "1"))
COUNT = 60
"""Bags: more than the server stores by itself, so that its helper runs."""
MOST_ANSWERS = 100
"""Answers before a kill: about as many as clients get in two seconds."""


def gone(number: int) -> bool:
    return not is_alive(number)


def has_answered(answered: Sequence[str], least: int) -> bool:
    return len(answered) >= least


def sound(bag_dir: Path) -> bool:
    path = store_file(bag_dir)
    if not path.exists():
        return True
    with closing(sqlite3.connect(path)) as base:
        return base.execute("PRAGMA integrity_check").fetchall() == [("ok",)]


def test_after_a_kill_at_any_moment_the_next_start_answers_the_same(tmp_path: Path) -> None:
    bag_dir, log = tmp_path / "bags", tmp_path / "log"
    write_bags(bag_dir, COUNT)
    shutil.copytree(bag_dir, tmp_path / "untouched")
    with serving(tmp_path / "untouched", log) as running:
        right = running.ask_all(COUNT)
    draw = random.Random(COUNT)
    for nth in range(KILLS + 1):
        with serving(bag_dir, log) as running:
            if nth:
                assert running.ask_all(COUNT) == right
            with load(running, COUNT) as answered:
                until(partial(has_answered, answered, draw.randint(0, MOST_ANSWERS)))
                helpers = children_of(bag_dir)
                running.kill()
        assert set(answered) <= set(right)
        for helper in helpers:
            until(partial(gone, helper))
        assert sound(bag_dir), nth
        if nth % 2:
            # So that there is something to store when it is killed again.
            shutil.rmtree(store_file(bag_dir).parent, ignore_errors=True)


def test_the_helper_that_stores_bags_dies_with_its_server(tmp_path: Path) -> None:
    bag_dir = tmp_path / "bags"
    write_bags(bag_dir, COUNT)
    with serving(bag_dir, tmp_path / "log"):
        helpers = until(lambda: children_of(bag_dir))
    for helper in helpers:
        until(partial(gone, helper))


def test_a_helper_whose_server_is_gone_before_it_begins_does_nothing(tmp_path: Path) -> None:
    write_bags(tmp_path, 1)
    command = [sys.executable, "-m", "ros2_memory.cli", "index", "--for-server", str(1 << 22)]
    environment = os.environ | {"MEMORY_BAG_DIR": str(tmp_path)}
    ended = subprocess.run(command, env=environment, capture_output=True, check=False)
    assert ended.returncode == 2
    assert not store_file(tmp_path).parent.exists()
