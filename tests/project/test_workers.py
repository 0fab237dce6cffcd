"""Which tests share a worker, and which begin first."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

from tests.support.workers import GROUPS, TESTS, WORKERS, group_of, place, workers_for

HERE = "tests/project/test_workers.py"
LIVE = "tests/integration/test_live_memory.py"


def test_tests_of_one_resource_share_a_worker() -> None:
    assert group_of(LIVE) == group_of("tests/integration/test_live_faults.py") == "live"
    assert group_of("tests/integration/test_ros2_double.py") == "recorder"
    assert group_of("tests/integration/test_retention_process.py") == "recorder"


def test_every_test_of_ros_itself_is_in_a_group() -> None:
    files = {f"tests/integration/{path.name}" for path in (TESTS / "integration").glob("test_*.py")}
    with_ros = {file for file in files if "needs_ros" in (TESTS.parent / file).read_text()}
    assert len(with_ros) >= 5
    assert {file for file in with_ros if group_of(file) not in {"live", "recorder"}} == set()


def test_every_group_has_files() -> None:
    empty = {
        group
        for group, patterns in GROUPS.items()
        if not any(found for pattern in patterns for found in TESTS.glob(pattern))
    }
    assert empty <= {"heavy"}


def test_a_file_whose_fixture_outlives_a_test_is_a_group() -> None:
    lasting = "tests/unit/demo/test_recording.py"
    assert "scope=" in (TESTS.parent / lasting).read_text()
    assert group_of(lasting) == lasting


def test_every_lasting_fixture_is_written_so_that_it_is_seen() -> None:
    said = re.compile(r"""fixture\(.*scope=["'](?!function)""")
    files = [f"tests/{path.relative_to(TESTS)}" for path in TESTS.rglob("test_*.py")]
    lasting = [file for file in files if said.search((TESTS.parent / file).read_text())]
    assert len(lasting) > 5
    assert [file for file in lasting if group_of(file) is None] == []


def test_other_tests_run_anywhere() -> None:
    assert group_of("tests/unit/core/test_model.py") is None


@pytest.mark.parametrize("path", ["tests/fuzz/test_bags.py", "tests/faults/test_disk.py"])
def test_what_burns_processor_time_is_heavy_by_its_place(path: str) -> None:
    assert group_of(path) == "heavy"


def test_what_takes_longest_begins_first() -> None:
    lasting = "tests/unit/demo/test_recording.py::test_x"
    order = [f"{LIVE}::test_x[a]", "tests/fuzz/test_bags.py::test_x", lasting, f"{HERE}::test_x"]
    shuffled = order[::-1]
    assert sorted(shuffled, key=place) == order


@pytest.mark.parametrize(
    ("args", "workers"),
    [
        ([TESTS], WORKERS),
        ([TESTS / "unit", __file__], WORKERS),
        ([__file__], 0),
        ([f"{__file__}::test_what_takes_longest_begins_first"], 0),
    ],
)
def test_folders_are_run_by_several_workers_and_files_by_none(
    args: list[object], workers: int
) -> None:
    assert workers_for([str(arg) for arg in args]) == workers


def test_a_worker_gives_way_once_it_is_done_with_what_waits_for_real_time() -> None:
    program = (
        "import os\n"
        "from tests.support.workers import give_way\n"
        "first = os.nice(0)\n"
        f"for file in ({LIVE!r}, {HERE!r}, {HERE!r}):\n"
        "    give_way(f'{file}::test_x')\n"
        "    print(os.nice(0) - first)\n"
    )
    env = {**os.environ, "PYTEST_XDIST_WORKER": "gw0", "PYTHONPATH": str(TESTS.parent)}
    ran = subprocess.run(
        [sys.executable, "-c", program], env=env, check=True, capture_output=True, text=True
    )
    after = str(min(10, 19 - os.nice(0)))
    assert ran.stdout.split() == ["0", after, after]
