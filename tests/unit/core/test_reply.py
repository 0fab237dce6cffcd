from __future__ import annotations

from ros2_memory.core.reply import (
    PLAIN,
    TIME,
    Scope,
    an_object,
    itself_if,
    keys,
    result,
    shown,
)
from ros2_memory.core.timebase import NS_PER_S, Ns


@result(TIME("at"), "text")
class Row:
    at: Ns
    text: str


@result("text")
class Answer:
    row: Row | None = None


def test_an_object_of_its_own_holds_attributes_of_the_same_result() -> None:
    form = keys(an_object(keys("text", TIME("at")))("row", itself_if("text")).if_known)
    assert shown(Row(NS_PER_S, "a"), Scope(), form) == {"row": {"text": "a", "at": 1.0}}
    assert shown(type("Empty", (), {"text": None, "at": 0})(), Scope(), form) == {}


def test_a_part_of_a_path_that_is_none_makes_the_value_null() -> None:
    form = keys(PLAIN("text", "row.text"))
    assert shown(Answer(), Scope(), form) == {"text": None}
    assert shown(Answer(Row(0, "a")), Scope(), form) == {"text": "a"}
