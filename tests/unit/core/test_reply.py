from __future__ import annotations

import math
from pathlib import Path

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
    render,
    result,
    shown,
)
from ros2_memory.core.timebase import NS_PER_S, Ns

BAGS = Path("/bags")


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


def answer(**given: object) -> dict[str, object]:
    whole = {"first": NS_PER_S, "last": 3 * NS_PER_S, "now": 10 * NS_PER_S, **given}
    return {**render(Answer(**whole), BAGS)}  # type: ignore[arg-type]


def test_keys_stand_in_the_order_of_their_declaration() -> None:
    assert answer() == {
        "first_seen": 1.0,
        "duration_s": 2.0,
        "ago_s": 7.0,
        "yaw_deg": None,
        "frame_id": None,
        "rows": [],
    }
    whole = answer(
        heading=math.pi, frame_id="map", score=0.123, count=2, row=Row(0, "a"), notes=("odd",)
    )
    assert [*whole] == [
        "first_seen", "duration_s", "ago_s", "yaw_deg", "frame_id", "score", "count", "skipped_s",
        "row", "rows", "notes",
    ]  # fmt: skip
    assert (whole["yaw_deg"], whole["score"], whole["row"]) == (180.0, 0.12, {"at": 0, "text": "a"})


def test_a_score_of_zero_is_known_and_one_that_is_no_number_is_null() -> None:
    assert answer(score=0.0)["score"] == 0.0
    assert answer(score=math.nan)["score"] is None
    assert "score" not in answer(score=None)


def test_an_object_of_its_own_holds_attributes_of_the_same_result() -> None:
    form = keys(an_object(keys("text", TIME("at")))("row", itself_if("text")).if_known)
    assert shown(Row(NS_PER_S, "a"), Scope(), form) == {"row": {"text": "a", "at": 1.0}}
    assert shown(type("Empty", (), {"text": None, "at": 0})(), Scope(), form) == {}


def test_a_part_of_a_path_that_is_none_makes_the_value_null() -> None:
    form = keys(PLAIN("text", "row.text"))
    assert shown(Answer(0, 0, 0), Scope(), form) == {"text": None}
    assert shown(Answer(0, 0, 0, row=Row(0, "a")), Scope(), form) == {"text": "a"}
