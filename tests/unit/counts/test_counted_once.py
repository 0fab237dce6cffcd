"""What counts, and how long it held: flags in lists, numbers by value, two topics at once."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

from rosbags.typesys import get_types_from_msg

from ros2_memory.core.timebase import NS_PER_S
from tests.support.bags import Msg, battery, detections, make, typestore, write_mcap
from tests.support.memories import asked, memory_of

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

T: Final = 1_790_000_000


def counted(folder: Path, messages: Iterable[Msg], topic: str, **given: object) -> dict[str, Any]:
    ordered = sorted(messages, key=lambda each: each.log_time)
    write_mcap(folder / "run" / "run_0.mcap", ordered)
    condition = {"topic": topic, "start": T, "end": T + 300, "by": "day", **given}
    reply = asked(memory_of(folder), folder, "find_matches", **condition)
    return dict(zip(reply["columns"][1:], reply["all"], strict=True))


def test_a_boolean_in_a_list_counts_beside_one_that_is_in_none(tmp_path: Path) -> None:
    store = typestore()
    store.register(get_types_from_msg("bool pressed\n", "acme_msgs/msg/Button"))
    panel = "bool enabled\nacme_msgs/Button[] buttons\n"
    store.register(get_types_from_msg(panel, "acme_msgs/msg/Panel"))
    button = store.types["acme_msgs/msg/Button"]
    messages = [
        Msg(
            "/panel",
            "acme_msgs/msg/Panel",
            (T + nth) * NS_PER_S,
            make("acme_msgs/msg/Panel", enabled=False, buttons=[button(pressed=20 <= nth < 40)]),
        )
        for nth in range(60)
    ]
    found = counted(tmp_path, messages, "/panel", condition_type="equals", value=True)
    assert (found["count"], found["seconds"]) == (1, 20.0)


def test_a_number_that_is_contained_counts_by_its_value(tmp_path: Path) -> None:
    kind = "std_msgs/msg/Int32"
    messages = [
        Msg("/level", kind, (T + nth) * NS_PER_S, make(kind, data=3 if nth > 100 else 1))
        for nth in range(200)
    ]
    condition = {"condition_type": "contains", "value": 3, "field": "data"}
    found = counted(tmp_path, messages, "/level", by="value", **condition)
    assert found["count"] == 1


def test_what_two_topics_show_at_once_lasts_once(tmp_path: Path) -> None:
    messages = [
        detections((T + nth) * NS_PER_S + late, ["person"], topic=topic)
        for nth in range(100)
        for topic, late in (("/cam1/objects", 0), ("/cam2/objects", 10**8))
    ]
    condition = {"condition_type": "contains", "value": "person"}
    found = counted(tmp_path, messages, "/cam*/objects", **condition)
    assert 99 <= found["seconds"] <= found["recorded_s"] + 1


def test_a_number_that_is_none_at_last_is_a_value_like_others(tmp_path: Path) -> None:
    charges = [0.5, 0.5, math.nan, 0.7, 0.7, math.nan]
    messages = [battery((T + n) * NS_PER_S, charge) for n, charge in enumerate(charges)]
    condition = {"condition_type": "above", "value": 0.1, "field": "percentage", "by": "value"}
    found = counted(tmp_path, messages, "/battery_state", **condition)
    assert (found["count"], found["seconds"]) == (2, 4.0)
    window = {"topic": "/battery_state", "fields": ["percentage"], "start": T, "end": T + 9}
    memory = memory_of(tmp_path)
    reply = asked(memory, tmp_path, "get_topic_in_range", **window, changes=True)
    assert [change["value"] for change in reply["changes"]] == [0.5, None, 0.7, None]
    reply = asked(memory, tmp_path, "get_topic_in_range", **window, by="value")
    assert {row[0]: row[1] for row in reply["rows"]} == {"0.5": 1, "0.7": 1, "null": 2}
