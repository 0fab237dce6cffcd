"""A query that nobody waits for any more stops: it reads no further than the bag it is in."""

import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Final

import pytest

from ros2_memory.bag_dir.bag_dir_reader import BagDirReader
from ros2_memory.core.errors import QueryTimeoutError
from ros2_memory.core.timebase import Deadline
from ros2_memory.history.context import Call, QuerySettings
from ros2_memory.storage.base import Batch, Record
from ros2_memory.storage.mcap_reader import McapReader
from ros2_memory.tools.build import build_tools
from tests.support.bags import detections, odom, tf, transform, write_splits
from tests.support.memories import clause, memory_of

S: Final = 10**9
BEGIN_S: Final = 1_784_000_000
BAGS: Final = 6
MESSAGES: Final = 300
"""Of each topic in each bag."""
AT_MOST: Final = 2 * MESSAGES
"""Messages that may still be read: those of a bag that is gone through at once."""
TOOLS: Final = {
    tool.name: tool for tool in build_tools(QuerySettings(), additions=True, writing=False)
}
SPAN: Final = {"start": BEGIN_S, "end": BEGIN_S + 4000}
LONG: Final[tuple[tuple[str, dict[str, Any]], ...]] = (
    ("trajectory_summary", SPAN),
    ("recap", SPAN),
    ("visits", {"x": 1e5, "y": 0.0}),
    ("list_frames", {}),
    ("find_matches", clause("/*", "contains", "never")),
    ("find_last_match", clause("/vision/*", "contains", "never")),
    (
        "find_last_match",
        clause("/odom", "above", 1e9, field="position.x"),
    ),
    (
        "get_value_when",
        {
            "value_topic": "/odom",
            "condition_topic": "/vision/*",
            "condition_type": "contains",
            "value": "never",
        },
    ),
)


class Watched(BagDirReader):
    """Counts the messages that are read."""

    read = 0

    def records(self, *args: Any, **named: Any) -> Iterator[Record]:
        for record in super().records(*args, **named):
            self.read += 1
            yield record

    def batches(self, *args: Any, **named: Any) -> Iterator[Batch]:
        for batch in super().batches(*args, **named):
            self.read += batch.log_times.size
            yield batch


@pytest.fixture(scope="module")
def bag_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, messages = tmp_path_factory.mktemp("bags"), []
    for n in range(BAGS * MESSAGES):
        at = BEGIN_S * S + n * S // 10
        moved = transform(at, "odom", "base_link", (n / 10, 0.0, 0.0))
        messages += [odom(at, n / 10, float(n % 7)), tf(at, moved), detections(at, ["cup"])]
    write_splits(folder, messages, MESSAGES / 10)
    return folder


@pytest.mark.parametrize(("name", "given"), LONG)
def test_a_query_that_nobody_waits_for_reads_no_further(
    bag_dir: Path, name: str, given: dict[str, Any]
) -> None:
    def read(leaves_after: int, ending: AbstractContextManager[object]) -> int:
        reader = Watched(McapReader(), bag_dir)
        memory = memory_of(bag_dir, reader=reader)
        call = Call(Deadline.after(25.0, lambda: math.inf if reader.read >= leaves_after else 0.0))
        with ending:
            TOOLS[name].question(given)(memory, call)
        return reader.read

    whole = read(1 << 60, nullcontext())
    assert whole > 2 * AT_MOST, "it must have something left to read"
    assert read(whole // 4, pytest.raises(QueryTimeoutError)) <= whole // 4 + AT_MOST
