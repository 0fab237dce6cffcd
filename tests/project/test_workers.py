"""Which tests share a worker, and which begin first."""

from __future__ import annotations

import re

from tests.support.workers import GROUPS, TESTS, group_of, place

HERE = "tests/project/test_workers.py"
LIVE = "tests/integration/test_live_memory.py"


def test_every_test_of_ros_itself_is_in_a_group() -> None:
    files = {f"tests/integration/{path.name}" for path in (TESTS / "integration").glob("test_*.py")}
    names = re.compile("installation|real_or_double|real_recorder")
    with_ros = {file for file in files if names.search((TESTS.parent / file).read_text())}
    assert len(with_ros) >= 5
    assert {file for file in with_ros if group_of(file) not in {"live", "recorder"}} == set()


def test_every_group_has_files() -> None:
    empty = {
        group
        for group, patterns in GROUPS.items()
        if not any(found for pattern in patterns for found in TESTS.glob(pattern))
    }
    assert empty <= {"heavy"}


def test_every_lasting_fixture_is_written_so_that_it_is_seen() -> None:
    said = re.compile(r"""fixture\(.*scope=["'](?!function)""")
    files = [f"tests/{path.relative_to(TESTS)}" for path in TESTS.rglob("test_*.py")]
    lasting = [file for file in files if said.search((TESTS.parent / file).read_text())]
    assert len(lasting) > 5
    assert [file for file in lasting if group_of(file) is None] == []


def test_what_takes_longest_begins_first() -> None:
    lasting = "tests/unit/demo/test_recording.py::test_x"
    order = [f"{LIVE}::test_x[a]", "tests/fuzz/test_bags.py::test_x", lasting, f"{HERE}::test_x"]
    shuffled = order[::-1]
    assert sorted(shuffled, key=place) == order
