"""Which tests share a worker: they run one after another, and their fixtures are made once.

All other tests run on whichever worker is free. Node ids stay as they are, for pytest-xdist's own
`--dist=loadgroup` goes by what it adds to them, which pytest 9.2 no longer takes up.
"""

import os
import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

from xdist.scheduler import LoadScopeScheduling
from xdist.workermanage import WorkerController

TESTS = Path(__file__).parents[1]
GROUPS: Mapping[str, Sequence[str]] = {
    "live": ("integration/test_live_*.py", "integration/test_recorder_triggers.py"),
    "stalls": (
        "integration/test_recorder_exclusion.py",
        "integration/test_recorder_stalls.py",
    ),
    "recorder": ("integration/test_recorder_*.py", "integration/test_retention_*.py"),
    "heavy": ("fuzz/*.py", "soak/*.py", "faults/*.py"),
}
"""Groups of files, which begin before all else, in this order.

The first three mostly wait for real time, for about the same time. "heavy" burns processor time:
one such test at a time leaves some to those that wait.
"""

WORKERS = 5
"""On two cores: three mostly wait for real time at first, and the others leave no core idle."""

PUNCTUAL = ("live", "stalls", "recorder")
"""Groups whose programs are to run when their time has come, whatever else there is to do."""

_MARK = re.compile(r'xdist_group\("(\w+)"\)')
_LASTING = re.compile(r'scope="(module|session)"')


def workers_for(args: Sequence[str]) -> int:
    """How many workers run what pytest was asked for; 0: none, for a few files they begin too late.

    Args:
        args: folders, files and node ids, as pytest takes them.
    """
    return WORKERS if any(Path(arg).is_dir() for arg in args) else 0


@cache
def group_of(path: str) -> str | None:
    """The group of a file of tests, by its path under the root; None: they run anywhere.

    By its place, else as the file says, `pytestmark = pytest.mark.xdist_group("heavy")`. A file
    with a fixture that outlives a test is a group of its own.
    """
    file = TESTS.parent / path
    for group, patterns in GROUPS.items():
        if any(file.relative_to(TESTS).match(pattern) for pattern in patterns):
            return group
    text = file.read_text()
    marked = _MARK.search(text)
    if marked:
        return marked[1]
    return path if _LASTING.search(text) else None


def place(nodeid: str) -> int:
    """When a test begins: a smaller number earlier."""
    group, order = group_of(_file(nodeid)), list(GROUPS)
    if group in order:
        return order.index(group)
    return len(order) + (group is None)


def give_way(nodeid: str) -> None:
    """Puts this worker behind those of the punctual groups, once a test of another one begins.

    It stays there, for priority is not given back; the punctual groups are over by then.
    """
    if "PYTEST_XDIST_WORKER" in os.environ and group_of(_file(nodeid)) not in PUNCTUAL:
        _be_nice()


@cache
def _be_nice() -> None:
    os.nice(10)


class Groups(LoadScopeScheduling):
    """Gives each group to one worker."""

    def _split_scope(self, nodeid: str) -> str:
        return group_of(_file(nodeid)) or nodeid

    def mark_test_complete(
        self, node: WorkerController, item_index: int, duration: float = 0
    ) -> None:
        """Forgets what is done: after each test all that its worker ever had would be counted."""
        scope = self._split_scope(self.registered_collections[node][item_index])
        super().mark_test_complete(node, item_index, duration)
        if all(self.assigned_work[node][scope].values()):
            del self.assigned_work[node][scope]


def _file(nodeid: str) -> str:
    return nodeid.partition("::")[0]
