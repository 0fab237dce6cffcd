from __future__ import annotations

import json
import math
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ros2_memory.tools.reply_size import fit_reply, to_json_text

FLOATS = st.floats(allow_nan=True, allow_infinity=True)
SCALARS = st.none() | st.booleans() | st.integers() | FLOATS | st.text(max_size=60)
VALUES: st.SearchStrategy[Any] = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=60) | st.dictionaries(st.text(max_size=30), inner, max_size=40)
    ),
    max_leaves=30,
)
REPLIES = st.dictionaries(
    st.sampled_from(["topic", "value", "samples", "waypoints", "frames", "detail"]), VALUES
)
NOTES = st.lists(st.text(max_size=300), max_size=20)


def strict(text: str) -> Any:
    def refuse(name: str) -> Any:
        raise AssertionError(f"{name} is not JSON")

    return json.loads(text, parse_constant=refuse)


def samples(count: int, value: Any = None) -> dict[str, Any]:
    return {
        "topic": "/odom",
        "total": count,
        "samples": [{"timestamp": 1.5 + n, "value": value or {"x": n}} for n in range(count)],
    }


@given(VALUES)
def test_any_value_becomes_valid_json_without_spaces(value: Any) -> None:
    text = to_json_text(value)
    strict(text)
    assert text.encode("utf-8").decode("utf-8") == text
    assert text == json.dumps(strict(text), separators=(",", ":"), ensure_ascii=False)


def test_what_json_cannot_carry_does_not_leave() -> None:
    value: Any = {"a": [math.nan, math.inf, -math.inf, -0.0], "b": "\ud800 ä", "\udfff": 1}
    assert to_json_text(value) == '{"a":[null,null,null,0.0],"b":"? ä","?":1}'


@given(REPLIES, NOTES, st.integers(500, 5000))
def test_a_reply_never_passes_the_cap_and_is_always_valid(
    reply: dict[str, Any], notes: list[Any], cap: int
) -> None:
    text = fit_reply({**reply, "notes": notes}, cap)
    assert len(text) <= cap
    assert isinstance(strict(text), dict)


@given(st.integers(2, 3000), st.integers(1000, 30_000))
def test_a_thinned_range_keeps_its_ends_and_stays_in_order(count: int, cap: int) -> None:
    kept = strict(fit_reply(samples(count), cap))["samples"]
    times = [row["timestamp"] for row in kept]
    assert times[0] == 1.5
    assert times[-1] == 0.5 + count
    assert times == sorted(set(times))


@given(st.integers(40, 3000), st.integers(1500, 30_000))
def test_a_thinned_range_is_evenly_spaced_and_uses_the_room(count: int, cap: int) -> None:
    reply = samples(count)
    shown = strict(fit_reply(reply, cap))
    kept = [row["timestamp"] for row in shown["samples"]]
    gaps = [after - before for before, after in pairwise(kept)]
    assert max(gaps) - min(gaps) <= 1
    if len(kept) < count:
        assert len(to_json_text(shown)) > cap - 800


@given(st.integers(2, 300), st.integers(1, 60), st.integers(600, 6000))
def test_a_thinned_table_keeps_its_ends_and_every_cell_of_its_columns(
    count: int, columns: int, cap: int
) -> None:
    names: list[Any] = ["timestamp", *(f"field_{n}" for n in range(columns))]
    rows: list[Any] = [[1.5 + at, *(at + n for n in range(columns))] for at in range(count)]
    shown = strict(fit_reply({"fields": names, "rows": rows, "notes": []}, cap))
    if "rows" not in shown:
        return  # two rows are more than fits
    assert shown["fields"] == names
    assert shown["rows"][0] == rows[0]
    assert shown["rows"][-1] == rows[-1]
    assert all(row in rows for row in shown["rows"])


def test_long_cells_of_a_table_are_cut_and_stay_in_their_columns() -> None:
    rows: list[Any] = [[1.5, "x" * 3000, list(range(900)), 7], [2.5, "y" * 3000, [], 8]]
    reply: dict[str, Any] = {"fields": ["timestamp", "text", "ranges", "id"], "rows": rows}
    shown = strict(fit_reply(reply, 2500))
    assert [(len(row), row[0], row[3]) for row in shown["rows"]] == [(4, 1.5, 7), (4, 2.5, 8)]
    assert "text (texts cut)" in shown["notes"][0]


@pytest.mark.parametrize("cap", [1_000, 3_000, 6_000])
@pytest.mark.parametrize("in_windows", [False, True])
def test_counts_keep_every_cell_of_their_columns(cap: int, in_windows: bool) -> None:
    names: list[Any] = ["day", *(f"{nth:02}" for nth in range(60))]
    table = {"rows": [[f"2026-11-{day}", *range(60)] for day in range(10, 30)], "all": [*range(60)]}
    parts: dict[str, Any] = {"windows": [table] * 9} if in_windows else table
    shown = strict(fit_reply({"columns": names, **parts, "notes": []}, cap))
    assert len(shown["columns"]) == 61 if "columns" in shown else "does not fit" in str(shown)
    for each in shown.get("windows", [shown]):
        assert all(row[1:] == [*range(60)] for row in each.get("rows", ()))
        assert each.get("all", [*range(60)]) == [*range(60)]


def test_lists_that_are_not_along_time_keep_their_beginning() -> None:
    shown = strict(fit_reply({"frames": [f"frame_{n:03}" for n in range(500)]}, 1000))
    kept = shown["frames"]
    assert kept == [f"frame_{n:03}" for n in range(len(kept))]
    assert shown["notes"][0].startswith(f"frames: {len(kept)} of 500 kept, from the beginning")


def test_a_single_huge_text_is_cut_with_a_note_and_fills_the_room() -> None:
    shown = strict(fit_reply({"topic": "/log", "value": {"msg": "ab" * 50_000}}, 2000))
    assert shown["topic"] == "/log"
    assert shown["value"]["msg"].startswith("abab")
    assert shown["value"]["msg"].endswith("…")
    assert len(shown["value"]["msg"]) > 1000
    assert "msg (texts cut)" in shown["notes"][0]


def test_a_wide_object_loses_keys_with_a_note() -> None:
    shown = strict(fit_reply({"value": {f"key_{n:05}": n for n in range(9000)}}, 2000))
    assert "key_00000" in shown["value"]
    assert "value (keys left out: 50 of 9000 kept)" in shown["notes"][0]


def test_what_cannot_be_shortened_leaves_what_it_is_about() -> None:
    tree: Any = 1
    for _ in range(5):
        tree = {f"branch_{n}": tree for n in range(5)}
    shown = strict(fit_reply({"topic": "/tree", "timestamp": 1.5, "value": tree}, 1000))
    assert (shown["topic"], shown["timestamp"]) == ("/tree", 1.5)
    assert "value" not in shown
    assert "does not fit into 1000 characters" in shown["notes"][0]


def test_a_long_note_does_not_drive_out_the_answer() -> None:
    shown = strict(fit_reply({"value": 1, "notes": ["n" * 3000] * 50}, 24_000))
    assert shown["value"] == 1
    assert shown["notes"][-1] == "and 38 more notes"
