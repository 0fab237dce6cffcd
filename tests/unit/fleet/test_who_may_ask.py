"""Who may ask about some robots never learns of another.

The oracle is a fleet that does not have the other one: every reply is the same, byte for byte.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, cast

import anyio
import pytest

from ros2_memory.core.large_reads import LargeReads
from ros2_memory.fleet.tools import fleet_tools
from ros2_memory.history.context import Memory, QuerySettings
from ros2_memory.serving.dispatch import Dispatcher
from ros2_memory.tools.build import build_tools
from ros2_memory.tools.replies import Replies
from tests.support.fleets import CALLS, TOOLS, fleet_over, seeded, write_robot

OTHER = "zq7"
MINE = ("r1", "r3")
HOSTILE: tuple[object, ...] = (
    OTHER,
    f"../{OTHER}",
    f"r1/../{OTHER}",
    f"/{OTHER}",
    "*",
    "?q7",
    "[z]q7",
    f"r1,{OTHER}",
    f"{OTHER}\0",
    f" {OTHER}",
    OTHER.upper(),
    "\uff5a\uff517",
    "zq\uff17",
    f"{OTHER}\u200b",
    [OTHER],
    ["r1", OTHER],
    {OTHER: 1},
    "",
    0,
    True,
    "." * 5000 + OTHER,
)
_opened: list[str] | None = None


def _note(event: str, details: tuple[Any, ...]) -> None:
    if _opened is not None and event in {"open", "os.listdir", "os.scandir", "sqlite3.connect"}:
        _opened.append(str(details[0]))


@contextmanager
def opened() -> Iterator[list[str]]:
    """The paths that are opened or listed meanwhile, by anybody."""
    global _opened  # noqa: PLW0603 - an audit hook cannot be removed
    paths = _opened = []
    yield paths
    _opened = None


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Dispatcher, Dispatcher]]:
    """What answers for all three, and what answers for the two alone."""
    folder = tmp_path_factory.mktemp("fleet")
    for name in (*MINE, OTHER):
        write_robot(seeded(name), folder / name)
    sys.addaudithook(_note)

    def over(names: tuple[str, ...]) -> Dispatcher:
        tools = fleet_tools(build_tools(QuerySettings()), fleet_over(folder, names), 24_000)
        # The memory is that of no robot.
        nobody = cast("Memory", SimpleNamespace(large=LargeReads()))
        return Dispatcher(nobody, tools, Replies(folder / "none", 24_000), call_timeout_s=60)

    both = over(("r1", OTHER, "r3")), over(MINE)
    yield both
    for each in both:
        each.stop()


def replies(
    pair: tuple[Dispatcher, Dispatcher], tool: str, given: dict[str, object]
) -> tuple[str, str]:
    """The reply to who may ask about two of three, and that of a fleet of two."""

    async def both() -> tuple[str, str]:
        limited = await pair[0].answer(tool, given, robots=frozenset(MINE))
        return limited.text, (await pair[1].answer(tool, given)).text

    return anyio.run(both)


@pytest.mark.parametrize("tool", TOOLS)
def test_a_reply_is_that_of_a_fleet_without_the_other(
    pair: tuple[Dispatcher, Dispatcher], tool: str
) -> None:
    given = CALLS.get(tool, {})
    with opened() as paths:
        for more in ({}, {"robot": "r1"}, {"robot": "r3", "limit": 1}, {"by": "hour"}):
            limited, alone = replies(pair, tool, {**given, **more})
            assert limited == alone
            assert OTHER not in limited
    assert any("/r1/" in path for path in paths)
    assert not [path for path in paths if OTHER in path]


@pytest.mark.parametrize("tool", TOOLS)
def test_whatever_is_passed_as_robot_is_no_path_and_names_nobody(
    pair: tuple[Dispatcher, Dispatcher], tool: str
) -> None:
    given = CALLS.get(tool, {})
    with opened() as paths:
        for robot in HOSTILE:
            limited, alone = replies(pair, tool, {**given, "robot": robot})
            assert limited == alone, robot
            assert '"error"' in limited, robot
    assert not [path for path in paths if OTHER in path.casefold() or "q7" in path]
