"""What a call read is freed as the call ends: a small machine cannot wait for the collector."""

import asyncio
import gc
from collections.abc import Iterator

import pytest

from ros2_memory.bootstrap import build_dispatcher
from ros2_memory.history.context import Memory
from ros2_memory.history.view import View
from ros2_memory.serving.dispatch import Dispatcher
from tests.support.clocks import SettableClock
from tests.support.documented_history import CALLS, NOW, START_S, write_history
from tests.support.memories import memory_of, shipped_settings, with_store

EXTREMES: dict[str, tuple[str, dict[str, object]]] = {
    "each message of a condition": ("find_matches", {**CALLS["find_matches"], "by": "day"}),
    "texts of a topic": (
        "get_topic_in_range",
        {"topic": "/odom", "start": START_S, "end": START_S + 9, "fields": ["pose.covariance"]},
    ),
    "a moment without poses among others": (
        "get_position_at",
        {"timestamps": [START_S + 5.0, START_S - 90.0]},
    ),
    "a topic that is not recorded": (
        "find_last_match",
        {"topic": "/rosout", "condition_type": "contains", "value": "x"},
    ),
    "a time before the memory": (
        "find_last_match",
        {**CALLS["find_last_match"], "before": START_S - 90.0},
    ),
    "a frame that is not there": ("get_position_at", {"timestamp": START_S, "frame_id": "moon"}),
}
"""Calls that find nothing, or too much, by what is asked."""
ASKED = {**{tool: (tool, arguments) for tool, arguments in CALLS.items()}, **EXTREMES}


@pytest.fixture(scope="module", params=["plain", "stored"])
def dispatcher(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Dispatcher:
    bag_dir = write_history(tmp_path_factory.mktemp("bags"))
    memory: Memory = memory_of(bag_dir, clock=SettableClock(NOW))
    if request.param == "stored":
        memory = with_store(memory, bag_dir)
    return build_dispatcher(shipped_settings(bag_dir), memory)


@pytest.fixture
def _no_collector() -> Iterator[None]:
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@pytest.mark.parametrize("what", ASKED)
@pytest.mark.usefixtures("_no_collector")
def test_a_call_leaves_no_view_to_the_garbage_collector(dispatcher: Dispatcher, what: str) -> None:
    tool, arguments = ASKED[what]
    assert asyncio.run(dispatcher.answer(tool, arguments)).text
    views = [found for found in gc.get_objects() if type(found) is View]
    assert not views, [type(holder) for holder in gc.get_referrers(*views)]
