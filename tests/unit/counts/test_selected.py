"""One element of a list, selected by what one of its fields says: `status[name=left].level`."""

import json
from typing import Any

import pytest

from ros2_memory.history.context import Memory
from ros2_memory.messages.conversions import Selector, segments_of
from tests.support.bags import Msg, diagnostics, text
from tests.support.memories import Remember, asked

T0_S = 1_700_000_000
S = 10**9
RIGHT = {"start": T0_S, "end": T0_S + 100}


def health(second: int, left: int, right: int) -> Msg:
    return diagnostics((T0_S + second) * S, left=(left, "m"), right=(right, "m"))


def shelf(second: int, **stock: int) -> Msg:
    items = [{"name": name.replace("_", " "), "stock": count} for name, count in stock.items()]
    return text((T0_S + second) * S, json.dumps({"items": items}), "/shelf")


@pytest.fixture
def messages() -> list[Msg]:
    """The left one is in ERROR from 30 to 49 s, the right one warns from 10 to 89 s."""
    levels = (health(n, 2 * (30 <= n < 50), int(10 <= n < 90)) for n in range(100))
    stocks = (shelf(n, oat_milk=max(4 - n // 20, 0), bread=7) for n in range(0, 100, 5))
    return sorted([*levels, *stocks], key=lambda message: message.log_time)


@pytest.fixture
def memory(remember: Remember, messages: list[Msg]) -> Memory:
    return remember(messages)


def spans(memory: Memory, topic: str, **condition: Any) -> list[tuple[int, int]]:
    found = asked(memory, "find_matches", topic=topic, **condition, **RIGHT)
    return [
        (round(each["first_seen"]) - T0_S, round(each["last_seen"]) - T0_S)
        for each in found["sightings"]
    ]


def test_a_condition_is_tested_on_the_selected_element_alone(memory: Memory) -> None:
    warns = {"condition_type": "above", "value": 0}
    assert spans(memory, "/diagnostics", field="status[name=left].level", **warns) == [(30, 49)]
    for right in ("status[name=right].level", "status[name='right'].level", "status[-1].level"):
        assert spans(memory, "/diagnostics", field=right, **warns) == [(10, 89)]
    assert spans(memory, "/diagnostics", field="status.level", **warns) == [(10, 89)]
    error = {"condition_type": "equals", "value": "left"}
    assert spans(memory, "/diagnostics", field="status[level=2].name", **error) == [(30, 49)]
    assert spans(memory, "/diagnostics", field="status[name=none].level", **warns) == []


def test_json_has_selected_elements_too(memory: Memory) -> None:
    gone = {"condition_type": "equals", "value": 0}
    assert spans(memory, "/shelf", field="data.items[name=oat milk].stock", **gone) == [(80, 95)]
    assert spans(memory, "/shelf", field="data.items[name=bread].stock", **gone) == []
    out = {"condition_type": "contains", "value": "milk"}
    assert spans(memory, "/shelf", field="data.items[stock=0].name", **out) == [(80, 95)]


def test_fields_show_the_selected_elements(memory: Memory) -> None:
    given = {"timestamp": T0_S + 40, "fields": ["status[name=left].level", "status[level=1].name"]}
    reply = asked(memory, "get_topic_at_time", topic="/diagnostics", **given)
    assert [*reply["value"].values()] == [2, "right"]
    given["fields"] = ["status[-1].level", "status[name='left'].level", "status[-3].level"]
    reply = asked(memory, "get_topic_at_time", topic="/diagnostics", **given)
    assert [*reply["value"].values()] == [1, 2, None]
    given["fields"] = ["data.items[-1].name", 'data.items[name="bread"].stock']
    reply = asked(memory, "get_topic_at_time", topic="/shelf", **given)
    assert [*reply["value"].values()] == ["bread", 7]
    assert "notes" not in reply
    stock = ["data.items[name=oat milk].stock"]
    by_hour = asked(memory, "get_topic_in_range", topic="/shelf", fields=stock, by="hour", **RIGHT)
    [row] = by_hour["rows"]
    cells = dict(zip(by_hour["columns"], row, strict=True))
    greatest = next(cells[name] for name in cells if name.endswith("stock.max"))
    least = next(cells[name] for name in cells if name.endswith("stock.min"))
    assert (least, greatest) == (0, 4)


def test_never_says_which_elements_there_are_if_none_is_selected(memory: Memory) -> None:
    asking = {"condition_type": "above", "value": 0, "field": "status[name=lift].level"}
    [note] = asked(memory, "find_last_match", topic="/diagnostics", **asking)["notes"]
    lack = "/diagnostics: no element of its newest message has name=lift, but left, right"
    assert note == lack
    assert lack in asked(memory, "find_matches", topic="/diagnostics", **asking, **RIGHT)["notes"]
    asking["field"] = "data.items[name=salt].stock"
    reply = asked(memory, "find_last_match", topic="/shelf", **asking)
    assert "has name=salt, but oat milk, bread" in reply["notes"][0]


@pytest.mark.parametrize(
    ("path", "segments"),
    [
        ("status[name=a.b].level", ["status", "[name=a.b]", "level"]),
        ("status.[name=a].level", ["status", "[name=a]", "level"]),
        ("[id=7].x", ["[id=7]", "x"]),
        ("a..b.-1", ["a", "", "b", "-1"]),
    ],
)
def test_a_path_is_split_at_dots_and_before_what_selects(path: str, segments: list[str]) -> None:
    assert segments_of(path) == segments


@pytest.mark.parametrize(
    ("wanted", "value", "is_selected"),
    [
        ("7", 7, True),
        ("7", 7.0, True),
        ("7", "7", True),
        ("0.5", 0.5, True),
        ("1234567890123456788", 1234567890123456789, False),
        ("true", True, True),
        ("1", True, False),
        ("7", None, False),
        ("x", [7], False),
        ("Left", "left", False),
    ],
)
def test_an_element_is_selected_by_a_text_a_number_or_a_boolean(
    wanted: str, value: object, is_selected: bool
) -> None:
    assert Selector("id", wanted).accepts(value) is is_selected


def test_a_field_that_no_element_has_is_refused(memory: Memory) -> None:
    asking = {"condition_type": "above", "value": 0, "field": "status[name=left].height"}
    refused = asked(memory, "find_matches", topic="/diagnostics", **asking, **RIGHT)
    assert refused["error"] == "invalid_arguments"
    assert "status.level" in refused["detail"]
