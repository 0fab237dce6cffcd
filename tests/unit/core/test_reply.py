from __future__ import annotations

from ros2_memory.core.reply import (
    AGO,
    LASTED,
    LOCAL,
    NAME,
    OBJECT,
    OBJECTS,
    PLAIN,
    SECONDS,
    TIME,
    YAW,
    Scope,
    an_object,
    digits,
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


@result(
    TIME("first_seen", "first"),
    LASTED("duration_s", "first", "last"),
    AGO("ago_s", "last"),
    YAW("yaw", "heading"),
    NAME("frame_id"),
    digits(2)("score").if_known,
    PLAIN("count").if_any,
    SECONDS("skipped_s").when("count"),
    OBJECT("row").if_known,
    OBJECTS("rows").first(2),
    LOCAL("local", "first", "last"),
    span=("first", "now"),
)
class Answer:
    first: Ns
    last: Ns
    now: Ns
    heading: float | None = None
    frame_id: str = ""
    score: float | None = None
    count: int = 0
    skipped: Ns = 0
    row: Row | None = None
    rows: tuple[Row, ...] = ()
    notes: tuple[str, ...] = ()


def test_an_object_of_its_own_holds_attributes_of_the_same_result() -> None:
    form = keys(an_object(keys("text", TIME("at")))("row", itself_if("text")).if_known)
    assert shown(Row(NS_PER_S, "a"), Scope(), form) == {"row": {"text": "a", "at": 1.0}}
    assert shown(type("Empty", (), {"text": None, "at": 0})(), Scope(), form) == {}


def test_a_part_of_a_path_that_is_none_makes_the_value_null() -> None:
    form = keys(PLAIN("text", "row.text"))
    assert shown(Answer(0, 0, 0), Scope(), form) == {"text": None}
    assert shown(Answer(0, 0, 0, row=Row(0, "a")), Scope(), form) == {"text": "a"}
